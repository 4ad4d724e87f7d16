"""Who is who by features: a model of each person's looks and voice, and how well a detection fits it.

Each component of a kind of feature is taken for independent of the others (a two-covariance model). A person's own
value x drifts slowly about the population's mean. A measurement is x plus an error, of which a share lasts from one
measurement to the next (pose, light, a vowel), so that forty looks in a second are not forty witnesses. Both are
estimated for each density by a Kalman filter with two states, x and the lasting error u in standard deviations.

Source:
    S. Ioffe, "Probabilistic linear discriminant analysis", ECCV 2006 (the two-covariance model);
    N. Brümmer and E. de Villiers, "The speaker partitioning problem", Odyssey 2010 (its likelihood ratios).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avcli.formats.features import Feature, Population, known

if TYPE_CHECKING:
    from avcli.tracking.association import Group
    from avcli.tracking.densities import Densities

# Chosen by hand so that a wrong vector decides nothing; no command fits them.
FOREIGN = 0.03  # share of vectors that are somebody else's, or in part
TOUCHING, NEAR = 0.3, 0.4  # share added where another person stands at the same place, in proportion less up to NEAR m
GARBAGE, WIDE = 0.01, 5.0  # share of vectors that are nobody's, and their standard deviation in the population's
SEEN = 0.5  # s since a person's last detection, up to which no vector says that somebody else took the place
MEMORY = 1000.0  # s in which what is known of a person fades to 1/e
SURE = math.log(0.9)  # log probability of an association from which noise is learnt
FIRST_LOOKS, KEEP, FARTHEST = 30.0, 0.999, 9.0  # looks that the told noise is worth; weight of the past; square in sd

MOST_LASTING = 0.99  # share of an error; two looks at the same time are never quite the same
KNOWN = 0.5  # share of the population's variance that is left of a component's, below which it is known

X, U, XX, XU, UU = range(5)  # rows of traits: means, variances and covariance of own value and lasting error

Numbers = Sequence[int] | np.ndarray


@dataclass
class Kind:
    """One kind of feature in this run.

    Attributes:
        part: its columns.
        population: what is known of it over people.
        scale: squared factor on the told standard deviations, as learnt, at least 1.
        looks: number of measurements from which the factor was learnt.
    """

    part: slice
    population: Population
    scale: float = 1.0
    looks: float = FIRST_LOOKS


class Evidence(NamedTuple):
    """What the features of one record say: J detections, D components, F kinds of features.

    Attributes:
        vectors, sds: (J, D) as measured, NaN: not measured; standard deviations without NaN.
        ratio: (n, J) factor on the likelihood of each detection under each density, 1 outside the gate.
        own: (n, J, F) probability that the vector is a look at that person, if the detection is.
        alone: (n, J) whether nobody else is near the detection.
    """

    vectors: np.ndarray
    sds: np.ndarray
    ratio: np.ndarray
    own: np.ndarray
    alone: np.ndarray


class Features:
    """All kinds of features of a run, as columns of `Densities.traits`.

    >>> Features().width
    0
    """

    def __init__(self, table: Callable[[str], Population | None] = known) -> None:
        """Begin without any kind; table: what is known of a kind by its name."""
        self.table = table
        self.kinds: dict[tuple[str, str, int], Kind] = {}
        self.ignored: dict[tuple[str, str, int], str] = {}  # those of which nothing is known, and why
        self._news: list[str] = []
        self.time: float | None = None
        self._gather()

    def _gather(self) -> None:
        """Join what is known of all kinds, component by component."""
        kinds = list(self.kinds.values())
        self.width = sum(len(kind.population.mean) for kind in kinds)
        populations = [kind.population for kind in kinds]
        self.mean, self.between, self.within = (
            np.concatenate([np.zeros(0), *[one[k] for one in populations]]) for k in range(3)
        )
        sizes = [len(one.mean) for one in populations]
        self.correlation = np.repeat([max(one.correlation_s, 1e-3) for one in populations], sizes)
        self.lasting = np.repeat([min(one.correlated, MOST_LASTING) for one in populations], sizes)
        self.member = np.repeat(np.eye(len(kinds)), sizes, axis=0)  # (D, F)
        prior = np.zeros((5, self.width))
        prior[X], prior[XX], prior[UU] = self.mean, self.between, 1.0
        self.prior = prior

    def _columns(self, given: Mapping[str, Feature], people: Densities) -> None:
        """Add the kinds that are new; nobody's features of those are known yet."""
        for name, one in sorted(given.items()):
            key = (name, one.kind, one.vectors.shape[1])
            if key in self.kinds or key in self.ignored:
                continue
            population = self.table(one.kind)
            if population is None or len(population.mean) != key[2]:
                self._ignore(key, population)
                continue
            self.kinds[key] = Kind(slice(self.width, self.width + key[2]), population)
            self._gather()
        self.fill(people)

    def _ignore(self, key: tuple[str, str, int], population: Population | None) -> None:
        """Leave a kind of features out from now on."""
        name, kind, length = key
        why = "nothing is known of this kind over people"
        if population is not None:
            why = f"the vectors have {length} numbers, and those of this kind have {len(population.mean)}"
        self.ignored[key] = why
        self._news.append(f"features {name!r} of kind {kind!r} are ignored: {why}")

    def news(self) -> list[str]:
        """Return a sentence for the user on each kind of features that is ignored since the last call."""
        news, self._news = self._news, []
        return news

    def fill(self, people: Densities) -> None:
        """Give densities the columns that they lack: people of whom no feature is known."""
        lacking = people.traits.shape[2]
        if lacking < self.width:
            unknown = np.tile(self.prior[:, lacking:], (len(people), 1, 1))
            people.traits = np.concatenate([people.traits, unknown], 2)

    def _predict(self, people: Densities, time: float) -> None:
        """Let lasting errors change, and what is known of people fade (an Ornstein-Uhlenbeck process each)."""
        dt, self.time = max(time - self.time, 0.0) if self.time is not None else 0.0, time
        if not dt or not len(people):
            return
        traits, lasts, stays = people.traits, np.exp(-dt / self.correlation), math.exp(-dt / MEMORY)
        traits[:, X] = self.mean + (traits[:, X] - self.mean) * stays
        traits[:, U] *= lasts
        traits[:, XX] = self.between + (traits[:, XX] - self.between) * stays**2
        traits[:, XU] *= lasts * stays
        traits[:, UU] = 1 + (traits[:, UU] - 1) * lasts**2

    # --- one record ---------------------------------------------------------------------------------------------------

    def weigh(
        self,
        people: Densities,
        likely: Sequence[int],
        time: float,
        z: np.ndarray,
        gain: np.ndarray,
        given: Mapping[str, Feature],
    ) -> Evidence | None:
        """Compute how much likelier than by its position alone each density's person caused each detection.

        Args:
            people: n densities; predicted to the time.
            likely: rows of known people.
            time: s.
            z: (J, 2) m.
            gain: (n, J) likelihoods of the positions, 0 outside the gate.
            given: the features of the J detections.

        Returns:
            The evidence; None where no kind of feature is known.
        """
        self._columns(given, people)
        if not self.width:
            return None
        self._predict(people, time)
        vectors, sds = self._measured(given, len(z))
        row, j = np.nonzero(gain)
        log = self._loglikelihood(*self._expected(people.traits[row], sds[j]), vectors[j]) @ self.member
        usual = self.between + sds * sds
        log_usual = self._loglikelihood(self.mean, usual, vectors) @ self.member
        log_wide = self._loglikelihood(self.mean, usual * WIDE**2, vectors) @ self.member
        log -= log_usual[j]
        best = np.zeros_like(log_usual)
        np.maximum.at(best, j, log)
        odds = np.clip(log_wide - log_usual - best, -500, 500)
        garbage = GARBAGE / (GARBAGE + (1 - GARBAGE) * np.exp(-odds))[j]
        touching = _touching(people, likely, z, row, j)
        foreign = (FOREIGN + TOUCHING * touching)[:, None]
        own = (1 - garbage) * (1 - foreign) * np.exp(np.clip(log, -500, 500))
        ratio = own + (1 - garbage) * foreign + garbage
        own_share, alone = np.zeros((*gain.shape, len(self.kinds))), np.zeros(gain.shape, bool)
        evidence = Evidence(vectors, sds, np.ones(gain.shape), own_share, alone)
        evidence.ratio[row, j] = ratio.prod(1)
        evidence.ratio[:] = _nobody_new(people, likely, time, gain, evidence.ratio)
        evidence.own[row, j] = own / ratio
        evidence.alone[row, j] = touching == 0
        return evidence

    def _measured(self, given: Mapping[str, Feature], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the vectors and standard deviations of a record's detections in the columns of all kinds."""
        vectors, sds = np.full((count, self.width), np.nan), np.tile(np.sqrt(self.within), (count, 1))
        for (name, label, width), kind in self.kinds.items():
            one = given.get(name)
            if one is None or (one.kind, one.vectors.shape[1]) != (label, width):
                continue
            vectors[:, kind.part] = one.vectors
            told = np.where(np.isnan(one.sds), sds[:, kind.part], one.sds)
            sds[:, kind.part] = told * math.sqrt(kind.scale)
        return vectors, sds

    def _expected(self, traits: np.ndarray, sds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return means and variances (k, D) of measurements with sds (k, D) of k people."""
        lasting = sds * np.sqrt(self.lasting)
        own_variance = traits[:, XX] + (2 * traits[:, XU] + lasting * traits[:, UU]) * lasting
        return traits[:, X] + lasting * traits[:, U], np.maximum(own_variance, 0.0) + sds * sds * (1 - self.lasting)

    @staticmethod
    def _loglikelihood(mean: np.ndarray, variance: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return Gaussian log densities (k, D), without the constant; 0 where a vector (k, D) is NaN."""
        log = -0.5 * (np.square(vectors - mean) / variance + np.log(variance))
        return np.where(np.isnan(vectors), 0.0, log)

    def update(self, traits: np.ndarray, evidence: Evidence, rows: Numbers, js: Numbers) -> np.ndarray:
        """Return the traits (k, 5, D) of k people after a look at each: traits k was caused by row k before it.

        A vector that may be somebody else's counts by the probability that it is not: the result has the moments of
        the mixture of both cases.
        """
        vectors, sds = evidence.vectors[js], evidence.sds[js]
        own = evidence.own[rows, js] @ self.member.T
        mean, variance = self._expected(traits, sds)
        lasting = sds * np.sqrt(self.lasting)
        off = vectors - mean
        own = np.where(np.isnan(off), 0.0, own)
        off = np.where(np.isnan(off), 0.0, off)
        kx = (traits[:, XX] + lasting * traits[:, XU]) / variance
        ku = (traits[:, XU] + lasting * traits[:, UU]) / variance
        shrink = own * ((1 - own) * off * off - variance)
        return np.stack(
            [
                traits[:, X] + own * kx * off,
                traits[:, U] + own * ku * off,
                traits[:, XX] + shrink * kx * kx,
                traits[:, XU] + shrink * kx * ku,
                traits[:, UU] + shrink * ku * ku,
            ],
            1,
        )

    def first(self, evidence: Evidence, js: Sequence[int]) -> np.ndarray:
        """Return the traits (k, 5, D) of people who were detected for the first time, by detections js."""
        unknown = np.tile(self.prior, (len(js), 1, 1))
        return self.update(unknown, evidence._replace(own=np.ones((1, *evidence.own.shape[1:]))), [0] * len(js), js)

    def learn(self, people: Densities, evidence: Evidence, groups: Iterable[Group]) -> None:
        """Learn from associations that are sure how much larger errors are than told.

        Args:
            people: densities before the record.
            evidence: of the record.
            groups: the joint hypotheses after it.
        """
        sure = [group.hypotheses[0] for group in groups if group.hypotheses[0].weight > SURE]
        pairs = [(row, j) for h in sure for row, j in h.pairs if j >= 0 and evidence.alone[row, j]]
        if not pairs:
            return
        rows, js = np.array(pairs).T
        mean, variance = self._expected(people.traits[rows], evidence.sds[js])
        off = np.minimum(np.square(evidence.vectors[js] - mean) / variance, FARTHEST)
        for kind in self.kinds.values():
            squares = off[:, kind.part]
            squares = squares[~np.isnan(squares)] * kind.scale
            looks = kind.looks * KEEP + len(squares) / len(kind.population.mean)
            total = kind.scale * kind.looks * KEEP + float(squares.sum()) / len(kind.population.mean)
            kind.scale, kind.looks = max(total / looks, 1.0), looks

    # --- people -------------------------------------------------------------------------------------------------------

    def apart(self, traits: np.ndarray) -> np.ndarray:
        """Return how well one look tells people (n, 5, D) apart: (n, n) Jeffreys divergences of what is expected of it.

        Of two well-known people that is their squared distance in standard deviations. Somebody of whom nothing is
        known differs from somebody who is known, too: the next look will hardly be as it was expected of the latter.
        """
        own = traits[:, X] - self.mean
        variance = np.maximum(traits[:, XX], 0.0) + self.within
        exact = 1 / variance
        squares, cross = np.square(own) @ exact.T, own @ (own * exact).T
        one_way = (variance @ exact.T + squares + (np.square(own) * exact).sum(1) - 2 * cross) / 2
        return np.maximum(one_way + one_way.T - traits.shape[2], 0.0)

    def knows(self, traits: np.ndarray) -> bool:
        """Tell whether half of what there is to know of some kind of a person's (5, D) features is known."""
        left = (traits[XX] / self.between[: traits.shape[1]]) @ self.member[: traits.shape[1]]
        return bool((left < KNOWN * self.member.sum(0)).any())

    def faded(self, traits: np.ndarray, dt: float) -> np.ndarray:
        """Return traits (5, D') of a person dt s later, with the columns that have come since."""
        later, keep = self.prior.copy(), math.exp(-dt / MEMORY)
        known_part = later[:, : traits.shape[1]]
        known_part[X] += (traits[X] - known_part[X]) * keep
        known_part[XX] += (traits[XX] - known_part[XX]) * keep**2
        return later

    def same(self, one: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return log likelihood ratios (n,): somebody with traits (5, D) is each of n people (n, 5, D), or a stranger.

        The two posteriors of one person's value are p(x | a) and p(x | b); the ratio is the integral of their product
        over the population's density.

        Source:
            N. Brümmer and E. de Villiers, "The speaker partitioning problem", Odyssey 2010, equation 13.
        """
        a, b, prior = 1 / one[XX], 1 / others[:, XX], 1 / self.between
        x, y = one[X] - self.mean, others[:, X] - self.mean
        both = a + b - prior
        log = np.log(a * b / (prior * both)) - x * x * a - y * y * b + np.square(x * a + y * b) / both
        by_kind = 0.5 * log @ self.member
        return np.logaddexp(math.log(1 - FOREIGN) + by_kind, math.log(FOREIGN)).sum(1)


def _nobody_new(
    people: Densities, likely: Sequence[int], time: float, gain: np.ndarray, ratio: np.ndarray
) -> np.ndarray:
    """Return the ratios (n, J) without what vectors say against all people who stand there, for somebody new.

    Wrong vectors last, and nobody appears in the place of somebody who was detected a moment ago. So a vector tells
    such people apart, but it is no evidence against all of them at once, nor for a person without a label.

    Args:
        people: n densities.
        likely: rows of known people.
        time: s.
        gain, ratio: (n, J), see `Features.weigh`.
    """
    seen = [row for row in likely if people.seen[row].max() > time - SEEN]
    by_place = gain[seen].sum(0)
    by_both = (gain[seen] * ratio[seen]).sum(0)
    more = np.where(by_both < by_place, by_place / np.maximum(by_both, 1e-300), 1.0)
    labels, label = {people.label[row] for row in seen}, people.label
    there, new = np.array([one in labels for one in label], bool), np.array([one < 0 for one in label], bool)
    most = np.where((by_place > 0) & new[:, None], 1.0, np.inf)
    return np.minimum(np.where(there[:, None], more, 1.0) * ratio, most)


def _touching(people: Densities, likely: Sequence[int], z: np.ndarray, rows: np.ndarray, js: np.ndarray) -> np.ndarray:
    """Return for pairs of rows and detections how near somebody else is to the detection: (k,) from 0 to 1."""
    if not len(likely):
        return np.zeros(len(rows))
    others = people.centres(likely)[:, :2]
    near = np.maximum(1 - np.hypot(*(z[:, None] - others).transpose(2, 0, 1)) / NEAR, 0.0)
    near *= np.minimum(people.existence.take(likely), 1.0)
    labels = np.array(people.label)
    return np.where(labels[rows][:, None] == labels[list(likely)], 0.0, near[js]).max(1)
