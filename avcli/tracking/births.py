"""Where detections may reveal new people: the Poisson process of people without a label, and the births from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.densities import NEVER, Densities
from avcli.tracking.model import Population
from avcli.tracking.places import Places
from avcli.tracking.scan import GATE, Scan
from avcli.tracking.settings import Sensor

BORN = -2  # in the place of a detection in a hypothesis's pairs: the row is that of a person who was just born
TENTATIVE = 1e-4  # least expected number of people in a tentative density
SHARES, RECURRING = (
    (0.0, *np.linspace(0.1, 0.9, 9).tolist(), 0.98),
    5.0,
)  # of tentative people; least log likelihood ratio
ALONE, FULL = 0.6, 10  # share and number of tentative people, farther than a body from others, of a room that is full
LEAST_HIDDEN = 0.06  # least probability that a camera misses somebody from the beginning: 1 of 23 in random worlds


class Birth(NamedTuple):
    """A person that one detection may reveal.

    Attributes:
        detection: its number in the record.
        source: row of the tentative density that was updated with it, -1: a person never detected before.
        number: expected number of people.
        existence: probability that the detection, if no known person's, is a person.
        placed: whether it is known where the person is, see `partial`.
    """

    detection: int
    source: int
    number: float
    existence: float
    placed: bool = True


class Undetected:
    """The uniform part of the Poisson process: people whom no sensor has detected yet.

    Attributes:
        expected: two numbers of them: anywhere, and near the walls.
        detectable: (S,) probability that each sensor can detect one of them.
    """

    def __init__(self, population: Population, entries: Places) -> None:
        self.population, self.entries = population, entries
        self.expected, self.detectable = [population.present, 0.0], np.zeros(0)
        self._rates = population.birth_rate.tolist()

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        self.detectable = np.append(self.detectable, sensor.detectable())

    def predict(self, dt: float) -> None:
        """Let people come and go for dt seconds."""
        stay = math.exp(-dt / self.population.stay)
        due = min(dt, self.population.stay) * self.entries.overall  # who came longer ago has left again
        self.expected = [stay * one + rate * due for one, rate in zip(self.expected, self._rates, strict=True)]

    def p_detect(self, scan: Scan) -> float:
        """Return the probability that the record's sensor detects one of them."""
        return scan.p_newcomer * self.detectable.item(scan.column)

    def due(self, scan: Scan) -> float:
        """Return how many of them a record should show."""
        return self.p_detect(scan) * sum(self.expected)

    def arriving(self, z: np.ndarray, detection: float, column: int) -> list[float]:
        """Return the densities, n per m², at positions (n, 2) m of detecting one of them."""
        if not len(z):
            return []
        able, (anywhere, near_walls) = detection * self.detectable.item(column), self.expected
        density = self.population.density(z, able * anywhere, able * near_walls)
        return (density * self.entries.at(z) / self.entries.overall).tolist()

    def relax(self, rest: np.ndarray, mix: np.ndarray) -> None:
        """Let them hide and show: (S,) probabilities in the long run, and shares (S,) of what is not forgotten."""
        self.detectable = rest + (self.detectable - rest) * mix

    def density(self, positions: np.ndarray) -> np.ndarray:
        """Return the expected number (n,) of them per m² at positions (n, 2) m."""
        return self.population.density(positions, *self.expected) * self.entries.at(positions) / self.entries.overall

    def detectable_at(self, positions: np.ndarray) -> np.ndarray:
        """Return the probabilities (n, S) that each sensor can detect one of them at positions (n, 2) m."""
        return np.tile(self.detectable, (len(positions), 1))

    def share_knowledge(self, one: int, others: list[int]) -> None:
        """Let other sensors detect the same ones of them as one sensor does."""
        self.detectable[others] = self.detectable[one]

    def update(self, scan: Scan) -> None:
        """Take those away whom a record's sensor has detected."""
        p_detect = self.p_detect(scan)
        self.expected = [one * (1 - p_detect) for one in self.expected]
        self.detectable[scan.column] *= (1 - scan.p_newcomer) / max(1 - p_detect, 1e-12)


def first_detections(
    scan: Scan,
    people: Densities,
    tentative: Sequence[int],
    known: Sequence[int],
    body: float,
    poisson: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the densities, at the detections, of detecting a person without a label.

    Args:
        scan: the record.
        people: all densities.
        tentative: T rows of tentative people.
        known: rows of known people, beside whom there is no room for another.
        body: m, see `Population.body`.
        poisson: whether these may be born from one detection.

    Returns:
        (T, J) per m² of each tentative person, and (J,) per m² of people never detected before.
    """
    z, count = scan.z, len(scan.z)
    if not count:
        return np.zeros((len(tentative), 0)), np.zeros(0)
    positions, spread = z, scan.noise
    if tentative:
        positions = np.concatenate([z, people.mean[:, 0, :2].take(tentative, 0)])
        spread = np.concatenate([spread, people.cov[:, 0, :2, :2].take(tentative, 0)])
    room = _elbow_room(positions, spread[:, 0, 0] + spread[:, 1, 1], people, known, body)
    number = room[count:] * [scan.existence[i] * scan.p_hit[i] for i in tentative]
    unseen = room[:count] * scan.newcomers if poisson else np.zeros(count)
    return number[:, None] * scan.gain[tentative], unseen


def _elbow_room(
    positions: np.ndarray, spread: np.ndarray, people: Densities, known: Sequence[int], body: float
) -> np.ndarray:
    """Probability (n,) that a new person at positions (n, 2) m is not inside a known person.

    spread: (n,) m², the sum of the variances along x and y of the positions.
    """
    if not known or not len(positions):
        return np.ones(len(positions))
    bodies, width = people.centres(known), -2 * body**2 - spread
    taken = squared_distance(positions, bodies)
    taken /= width[:, None]
    np.exp(taken, out=taken)
    taken *= people.existence.take(known)
    return np.multiply.reduce(1 - taken, 1)


def other_detections(
    scan: Scan, unclaimed: Sequence[float], real: Sequence[float], body: float
) -> tuple[list[float], list[float]]:
    """Compute what the other detections of a record say of each: they may be of the same person.

    Args:
        scan: the record.
        unclaimed: J probabilities that no known person caused the detection.
        real: J probabilities that it is a person in that case.
        body: m, see `Population.body`.

    Returns:
        J probabilities that there is room for another person beside those whom the other detections show, and J
        densities per m² of detecting one of those a second time.
    """
    z, noise = scan.z, scan.noise
    room, twice = [1.0] * len(z), [0.0] * len(z)
    if len(z) < 2:
        return room, twice
    apart, spread, body = squared_distance(z, z), noise[:, 0, 0] + noise[:, 1, 1], 2 * body**2
    near = apart < GATE * (body + 2 * max(spread.tolist()))
    near.ravel()[:: len(z) + 1] = False
    one, other = near.nonzero()
    if not len(one):
        return room, twice
    apart, width = apart[near], spread[one] + spread[other]
    free, shown = np.array(unclaimed), np.array(unclaimed) * real
    claimed = np.minimum((1 - free[other]) / np.maximum(free[one], 1e-9), 1.0)  # by somebody, if `one` is not
    claimed = np.where(one > other, np.maximum(claimed, shown[other]), claimed)  # the first of two new people counts
    beside, again = np.ones(len(z)), np.zeros(len(z))
    np.multiply.at(beside, one, 1 - claimed * np.exp(-apart / (body + spread[one])))
    np.add.at(again, one, scan.again / math.pi * np.exp(-apart / width) / width * claimed)
    return beside.tolist(), again.tolist()


def recurring(
    scan: Scan,
    unclaimed: Sequence[float],
    people: Densities,
    tentative: Sequence[int],
    known: Sequence[int],
    body: float,
) -> tuple[np.ndarray, float]:
    """Tell a full room from much clutter: people are detected again where they were, clutter is elsewhere.

    The detections of nobody known are a Poisson process: false ones anywhere, and people about a share of the tentative
    ones. The likeliest share is taken, where it is much likelier than none.

    Args:
        scan: the record.
        unclaimed: J probabilities that no known person caused the detection.
        people: all densities.
        tentative: T rows of tentative people.
        known: rows of known people.
        body: m, see `Population.body`.

    Returns:
        The probabilities (T,) that they exist, 0 where the detections do not tell; and the false detections then.
    """
    there, whole = np.zeros(len(tentative)), math.fsum(unclaimed)
    seen = [k for k, i in enumerate(tentative) if people.seen[i, scan.column] > NEVER]
    rows = [tentative[k] for k in seen]
    places = people.centres(rows)
    new = np.logical_and.reduce(squared_distance(places, people.centres(known)) >= body**2, axis=1)
    near, alone = squared_distance(places, places) < body**2, new.copy()
    for i in range(len(rows)):  # of those within a body of each other, the first counts
        alone[i] &= not (near[i, :i] & alone[:i]).any()
    if alone.sum() < max(ALONE * new.sum(), FULL):
        return there, whole
    hit = np.where(alone, [scan.p_hit[i] for i in rows], 0.0)
    weight, local = np.array(unclaimed), np.array(scan.local)
    about, expected = hit @ scan.gain[rows], float(hit.sum())
    usual = (np.array(scan.clutter) - local) / scan.expected_clutter
    best, share, false = -math.inf, 0.0, whole
    for one in SHARES:
        others = max(whole - one * expected, scan.sensor.clutter)
        density = np.maximum(others * usual + local + one * about, 1e-300)
        likely = float(weight @ np.log(density)) - others - one * expected - RECURRING * (one > 0.0)
        if likely > best:
            best, share, false = likely, one, others
    there[seen] = share * alone
    return there, false


def weighed(
    scan: Scan, unclaimed: Sequence[float], birth: Sequence[float], twice: Sequence[float], more: float = 1.0
) -> tuple[list[float], list[float], list[float]]:
    """Weigh the detections that no known person caused: new people, known ones a second time, or false.

    Args:
        scan: the record.
        unclaimed: J probabilities that no known person caused the detection.
        birth: J densities per m² of detecting a new person.
        twice: the same of one whom another detection shows, see `other_detections`.
        more: by what factor there is more clutter than the record took for usual, but for places that are false again
            and again.

    Returns:
        J probabilities that it is a new person if it is no known one, J that it is usual clutter, and J that it is
        a further detection of a person.
    """
    new, false, again = [], [], []
    for u, c, local, b, t in zip(unclaimed, scan.clutter, scan.local, birth, twice, strict=True):
        usual = (c - local) * more
        whole = usual + local + b + t
        new.append(b / whole)
        false.append(u * usual / whole)
        again.append(u * t / whole)
    return new, false, again


def births(
    unclaimed: Sequence[float],
    existence: Sequence[float],
    tentative: Sequence[int],
    from_tentative: np.ndarray,
    from_undetected: np.ndarray,
    newborn: float | None,
) -> list[Birth]:
    """Return the people that a record may reveal.

    Args:
        unclaimed: J probabilities that no known person caused the detection.
        existence: J probabilities that it is a person in that case.
        tentative: T rows of tentative people.
        from_tentative: (T, J) per m², see `first_detections`.
        from_undetected: (J,) per m².
        newborn: None: the Poisson process; else people are born for the next record, as many as that (adaptive birth).

    Source:
        A. Trezza, D. J. Bucci and P. K. Varshney, "Multi-sensor joint adaptive birth sampler for labeled random finite
        set tracking", IEEE TSP 70, 2022 (adaptive birth).
    """
    revealed = []
    for j, (u, e) in enumerate(zip(unclaimed, existence, strict=True)):
        if u * e > TENTATIVE:
            source = int(from_tentative[:, j].argmax()) if len(tentative) else -1
            known = source >= 0 and from_tentative[source, j] > from_undetected[j]
            if known or newborn is None:
                revealed.append(Birth(j, tentative[source] if known else -1, u * e, e))
    if newborn is not None:
        new = [u * (1 - e) for u, e in zip(unclaimed, existence, strict=True)]
        share = newborn / max(math.fsum(new), 1e-12)
        revealed += [Birth(j, -1, share * s, 0.0) for j, s in enumerate(new) if share * s > TENTATIVE]
    return revealed


def overlooked(able: np.ndarray, rest: np.ndarray, cameras: Sequence[bool]) -> np.ndarray:
    """Return by how many times (n, S) nobody is likelier than a person, since each camera has not detected them so far.

    Misses change the probability that somebody can be detected, and so that says how likely the misses were, by Bayes'
    rule. Ears say nothing by them, since people may be silent for long.

    Args:
        able: (n, S) probabilities that each sensor can detect one of n people, given the misses.
        rest: (S,) the same where nothing is known.
        cameras: S, whether each sensor is a camera that works, as far as is known.
    """
    likelier = np.ones(able.shape)
    if any(cameras):
        likelier[:, cameras] = np.maximum((1 - able[:, cameras]) / np.maximum(1 - rest[cameras], LEAST_HIDDEN), 1.0)
    return likelier


def newcomers(
    scan: Scan,
    js: Sequence[int],
    time: float,
    population: Population,
    detectable: np.ndarray,
    against: np.ndarray,
) -> Densities:
    """Return densities of people detected for the first time.

    Args:
        scan: the record.
        js: numbers of its detections.
        time: of the record, s.
        population: for how new people move.
        detectable: (n, S) probabilities that each sensor can detect one; changed.
        against: (n, S), see `overlooked`; changed.
    """
    n, able = len(js), detectable
    mean, cov, mode = gaussian.begin(scan.z[js], scan.noise[js] + scan.ahead**2 / 2 * np.eye(2), population.motion)
    able[:, scan.column] = 1.0
    seen, lean, hits, doubt = np.full(able.shape, NEVER), np.zeros(able.shape), np.zeros(able.shape), against
    seen[:, scan.column], lean[:, scan.column], hits[:, scan.column] = time, 1.0, 1.0
    doubt[:, scan.column] = 0.0 if scan.doubt is None else scan.doubt[js]
    return Densities(
        mean=mean,
        cov=cov,
        mode=mode,
        existence=np.ones(n),
        detectable=able,
        lean=lean,
        seen=seen,
        place=scan.z[js],
        hits=hits,
        told=np.zeros(n),
        counted=np.zeros(able.shape),
        doubt=doubt,
        reach=uncertainty(cov[:, 0]),
        common=np.zeros((n, 2, 2)) if scan.common is None else scan.common.take(js, 0),
        label=[-1] * n,
        node=[None] * n,
    )


def uncertainty(cov: np.ndarray) -> np.ndarray:
    """Return the root mean square error (n,) in m of positions, of covariances (n, 4, 4)."""
    return np.sqrt(cov[:, 0, 0] + cov[:, 1, 1])


def squared_distance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the squared distances (n, m) in m² of states or positions (n, 2 or more) and (m, 2 or more)."""
    dx, dy = one[:, :1] - other[:, 0], one[:, 1:2] - other[:, 1]
    dx *= dx
    dy *= dy
    dx += dy
    return dx


def as_complex(pairs: np.ndarray) -> np.ndarray:
    """Return pairs of coordinates along the last axis, (..., 2 k), as complex numbers (..., k)."""
    return np.ascontiguousarray(pairs).view(complex)
