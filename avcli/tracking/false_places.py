"""Places at which a sensor falsely detects somebody again and again: a reflection, a fan, a coat on a chair.

Such a place is found by how its detections come: independently of each other, at a fixed place, though nobody went
there. A person sits still, too, but is detected as steadily as others are, or hidden for a while. So each place where
a track begins is a candidate, with two explanations of what each record shows there: the tracker's own (people, new
people, uniform clutter), and false detections at a constant rate, of which only a beta prior is known. The ratio of
their likelihoods decides how much the candidate adds to the density of clutter, against which people must prove
themselves; its rate is an honest one, so that somebody who is detected more often than that is a person all the same.

A place cannot be told from a person who is detected so steadily that chance might do it. Nothing is learnt of a place
while somebody is there who went there: that person may sit down where a sensor hardly sees people.

Source:
    R. E. Krichevsky and V. K. Trofimov, "The performance of universal encoding", IEEE Trans. Information Theory 27(2),
    1981 (the probability of independent events of unknown rate);
    D. Musicki, R. Evans and S. Stankovic, "Integrated probabilistic data association", IEEE Trans. Automatic Control
    39(6), 1994 (clutter maps in the existence of tracks).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from avcli.tracking.association import Group
    from avcli.tracking.densities import Densities
    from avcli.tracking.scan import Scan

# Chosen on false-place, found30, s3 and s4 (`make bench-tracking`, seeds from 110): with more doubt at first a place is
# learnt later (found in 30 % of the records: after 3 s, with -7 after 2 s), and fewer people who stand where they are
# hardly found are taken for one.
DOUBT, CERTAIN = -12.0, 15.0  # log odds of a place that it is false, at first and at most
SURE = 3.0  # from which the user is told
GIVEN_UP = -17.0  # log odds below which a candidate is dropped
MOST = 16  # candidates of a sensor
PRIOR_HITS, PRIOR_MISSES = 0.5, 4.5  # records that the prior of its rate is worth
ENOUGH = 50.0  # false detections, beyond which earlier ones are forgotten
GATE = 9.0  # squared distance in standard deviations
WENT, NEAR = 1.0, 0.5  # m from a place: of somebody who was detected first elsewhere, or has left; who is there
TELLS = 5.0  # nats that one record tells at most


@dataclass(slots=True)
class FalsePlace:
    """One place that may be false.

    Attributes:
        x, y: m.
        variance: m² per axis, of its detections.
        hits, misses: records with and without one, with the prior's worth.
        odds: log odds that it is false.
        label: of the track that is there, -1: none.
        told: whether `FalsePlaces.news` has named it, or another run has.
        idle: records in which nothing was there, neither a detection nor a person, and that do not count yet.
    """

    x: float
    y: float
    variance: float
    hits: float = PRIOR_HITS
    misses: float = PRIOR_MISSES
    odds: float = DOUBT
    label: int = -1
    told: bool = False
    idle: int = 0

    @property
    def rate(self) -> float:
        """Probability of a false detection in one record, if it is false."""
        return self.hits / (self.hits + self.misses)

    @property
    def probability(self) -> float:
        """Probability that it is false."""
        return 1 / (1 + math.exp(-self.odds))

    def count(self, hit: bool) -> None:
        """Learn the rate from one record."""
        self.hits, self.misses = self.hits + hit, self.misses + (not hit)
        if self.hits > ENOUGH:
            keep = ENOUGH / self.hits
            self.hits, self.misses = self.hits * keep, self.misses * keep

    def settle(self) -> None:
        """Count the idle records, all at once."""
        if self.idle:
            n, whole = self.idle, self.hits + self.misses
            lost = math.lgamma(self.misses + n) - math.lgamma(self.misses)
            self.odds += lost - math.lgamma(whole + n) + math.lgamma(whole)
            self.misses, self.idle = self.misses + n, 0

    def weigh(self, nats: float) -> None:
        """Take in by how many nats a record is likelier if the place is false."""
        self.odds = min(self.odds + min(max(nats, -TELLS), TELLS), CERTAIN)


class FalsePlaces:
    """The places of each sensor that may be false, in order of the tracker's columns."""

    def __init__(self, learn: bool) -> None:
        """Begin without any; learn: whether to find some."""
        self.learns = learn
        self.of: list[list[FalsePlace]] = []
        self._at: list[np.ndarray] = []  # of each sensor: (n,) m, x + iy of its places
        self._found: list[tuple[int, FalsePlace]] = []
        self.first: dict[int, tuple[float, float]] = {}  # label -> where it was detected first, m

    def add(self) -> None:
        """Let another sensor report from now on."""
        self._keep(len(self.of), [])

    def state(self, column: int) -> list[dict[str, Any]]:
        """Return the places of a sensor that are probably false, as `restore` takes them and people read them."""
        return [
            {
                "position": [one.x, one.y],
                "variance": one.variance,
                "hits": one.hits,
                "misses": one.misses,
                "log_odds": one.odds,
            }
            for one in self._settled(column, 0.0)
            if one.odds > 0
        ]

    def restore(self, column: int, state: Iterable[Mapping[str, Any]]) -> None:
        """Go on from what another run has found of a sensor."""
        places = [
            FalsePlace(x, y, one["variance"], one["hits"], one["misses"], one["log_odds"], told=True)
            for one in state
            for x, y in [one["position"]]
        ]
        self._keep(column, places)

    def _keep(self, column: int, places: list[FalsePlace]) -> None:
        self.of[column : column + 1] = [places]
        self._at[column : column + 1] = [np.array([complex(one.x, one.y) for one in places])]

    def _settled(self, column: int, least: float) -> list[FalsePlace]:
        """Return the places of a sensor whose log odds are more than that, all records counted."""
        found = [one for one in self.of[column] if one.odds > least]  # idle records only make them less
        for one in found:
            one.settle()
        return found

    def news(self, names: Sequence[str]) -> list[str]:
        """Return a sentence on each place that has become rather sure since the last call; names: of the sensors."""
        found, self._found = self._found, []
        return [
            f"sensor {names[column]!r}: detections at ({one.x:.2f}, {one.y:.2f}) m come as if by chance, in "
            f"{one.rate:.0%} of its records, and nobody went there: taken for false ones"
            for column, one in found
        ]

    def forget(self, labels: Iterable[int]) -> None:
        """Forget about labels other than these."""
        wanted = set(labels)
        self.first = {label: place for label, place in self.first.items() if label in wanted}

    def doubts(self) -> dict[int, float]:
        """Return label -> probability that it is no person, but a false place; only of those where that may be."""
        doubts: dict[int, float] = {}
        for column in range(len(self.of)):
            for one in self._settled(column, DOUBT):
                if one.label >= 0 and not self._went(one.label, one):
                    doubts[one.label] = max(one.probability, doubts.get(one.label, 0.0))
        return doubts

    def died(self, label: int) -> float:
        """Note that a label hardly exists any more; returns the probability that it was no person, see `doubts`."""
        doubt = self.doubts().get(label, 0.0)
        for places in self.of:
            for one in places:
                one.label = -1 if one.label == label else one.label
        return doubt

    def elsewhere(self, label: int, place: Sequence[float]) -> bool:
        """Return whether a place (2,) m is far from where a label was detected first."""
        first = self.first.get(label)
        return first is not None and (place[0] - first[0]) ** 2 + (place[1] - first[1]) ** 2 > WENT**2

    def density(self, column: int, z: np.ndarray) -> list[float]:
        """Return the density (J,) per m² of false detections at positions (J, 2) m by these places."""
        places = self._settled(column, DOUBT) if len(z) else []
        if not places:
            return [0.0] * len(z)
        variance = np.array([one.variance for one in places])
        share = np.array([one.probability * one.rate for one in places]) / (2 * math.pi * variance)
        square = np.square(z[:, None] - np.array([(one.x, one.y) for one in places])).sum(2)
        return (share * np.exp(-square / (2 * variance))).sum(1).tolist()

    def began(self, column: int, label: int, place: Sequence[float], variance: float, new: bool) -> None:
        """Note that a label begins, or comes back, with a detection at a place (2,) m of a variance in m² per axis."""
        x, y = place
        if new:
            self.first[label] = x, y
        if not self.learns:
            return
        near = [one for one in self.of[column] if _apart(one, x, y) < GATE * one.variance]
        if near:
            min(near, key=lambda one: _apart(one, x, y)).label = label
            return
        places = self._settled(column, -math.inf)
        if len(places) >= MOST:
            places.remove(min(places, key=lambda one: one.odds))
        self._keep(column, [*places, FalsePlace(x, y, variance, label=label)])

    def learn(
        self,
        scan: Scan,
        people: Densities,
        likely: Sequence[int],
        birth: Sequence[float],
        groups: Iterable[Group],
    ) -> None:
        """Learn from one record.

        Args:
            scan: the record.
            people: the densities before it.
            likely: rows of known people.
            birth: J densities per m² of detections of new people.
            groups: the joint hypotheses after it.
        """
        places = self.of[scan.column]
        others = [one for k, of in enumerate(self.of) if k != scan.column for one in of if one.label >= 0]
        if others:
            self._confirm(scan, people, others, groups)
        if not places:
            return
        points = np.concatenate([scan.z, people.mean[:, 0, :2].take(likely, 0)]).view(complex)[:, 0]
        apart = abs(self._at[scan.column][:, None] - points)
        far = max(NEAR, math.sqrt(GATE * max(one.variance for one in places)))
        busy, n, lost = np.logical_or.reduce(apart < far, 1).tolist(), len(scan.z), False
        for k, one in enumerate(places):
            if not busy[k] and one.label < 0:
                one.idle += 1
                continue
            one.settle()
            near = apart[k].tolist()
            self._look(one, scan, people, likely, birth, near[:n], near[n:])
            lost = lost or one.odds < GIVEN_UP
            if one.odds > SURE and not one.told:
                one.told = True
                self._found.append((scan.column, one))
        if lost:
            self._keep(scan.column, [one for one in places if one.odds >= GIVEN_UP])
        elif any(busy):
            self._keep(scan.column, places)

    def _look(
        self,
        one: FalsePlace,
        scan: Scan,
        people: Densities,
        likely: Sequence[int],
        birth: Sequence[float],
        shown: Sequence[float],
        away: Sequence[float],
    ) -> None:
        """Weigh what a record shows at a place, unless somebody is there who went there.

        Args:
            one: the place.
            scan, people, likely, birth: see `learn`.
            shown: J distances in m of the detections.
            away: distances in m of the likely people.
        """
        row = -1
        for i, apart in zip(likely, away, strict=True):
            mine = one.label >= 0 and people.label[i] == one.label
            if mine and apart > WENT:  # whoever was there is a person, who has left
                one.label = -1
                one.odds = one.odds if one.odds > 0 else min(one.odds, DOUBT)
            elif (mine or apart < NEAR) and self._went(people.label[i], one):
                return
            elif mine:
                row = i
        self._weigh(one, scan, people, likely, birth, row, shown)

    def _weigh(
        self,
        one: FalsePlace,
        scan: Scan,
        people: Densities,
        likely: Sequence[int],
        birth: Sequence[float],
        row: int,
        shown: Sequence[float],
    ) -> None:
        """Weigh what a record shows at a place.

        Args:
            one: the place.
            scan, people, likely, birth: see `learn`.
            row: of the person who may be there, -1: none.
            shown: J distances in m of the detections.
        """
        apart, j = min((apart, j) for j, apart in enumerate(shown)) if shown else (math.inf, -1)
        square = apart * apart
        if square >= GATE * one.variance:
            one.weigh(math.log(1 - one.rate) - (_beside(scan, row, likely, birth) if row >= 0 else 0.0))
            one.count(False)
            return
        density = _normal(square, one.variance)
        usual, owner, most = scan.clutter[j] - scan.local[j] + birth[j], -1, 0.0
        for k in likely:
            gain = float(scan.gain[k, j])
            if gain > 0:  # who sits there is as still as the place
                caused = scan.existence[k] * scan.p_detect[k] * (max(gain, density) if k == row else gain)
                usual += caused
                if caused > most:
                    owner, most = k, caused
        one.weigh(math.log(one.rate * density) - math.log(max(usual, 1e-300)))
        one.count(True)
        _move(one, scan.z[j].tolist(), square, float(scan.noise[j, 0, 0] + scan.noise[j, 1, 1]) / 2)
        if owner >= 0 and not self._went(people.label[owner], one):
            one.label = people.label[owner]

    @staticmethod
    def _confirm(scan: Scan, people: Densities, places: Sequence[FalsePlace], groups: Iterable[Group]) -> None:
        """Weigh that another sensor detects somebody where these places are: that speaks for a person."""
        for group in groups:
            for label, (row, j) in zip(group.labels, group.hypotheses[0].pairs, strict=True):
                if j >= 0:
                    for one in [one for one in places if one.label == label]:
                        if _apart(one, *people.centres([row])[0, :2].tolist()) > NEAR**2:
                            continue
                        likelier = scan.p_detect[row] * float(scan.gain[row, j]) / scan.clutter[j]
                        one.weigh(-math.log(max(likelier, 1.0)))

    def _went(self, label: int, one: FalsePlace) -> bool:
        """Return whether a person went to a place."""
        first = self.first.get(label)
        return first is None or _apart(one, *first) > WENT**2


def _move(one: FalsePlace, z: Sequence[float], square: float, noise: float) -> None:
    """Learn from a detection where a place is, and how far its detections lie apart; square: m² between the two."""
    share = 1 / (one.hits + 1)
    one.x, one.y = one.x + share * (z[0] - one.x), one.y + share * (z[1] - one.y)
    one.variance = max(one.variance + share * (square / 2 - one.variance), noise)


def _beside(scan: Scan, row: int, likely: Sequence[int], birth: Sequence[float]) -> float:
    """Return by how many nats a record is likelier if somebody is there, whom it shows elsewhere or not at all."""
    present, elsewhere = scan.existence[row] * scan.p_detect[row], 0.0
    for j, gain in scan.likelihoods[row]:
        others = math.fsum(scan.existence[k] * scan.p_detect[k] * float(scan.gain[k, j]) for k in likely if k != row)
        elsewhere += present * gain / (scan.clutter[j] + birth[j] + others)
    return math.log(max(1 - present + elsewhere, 1e-12))


def _apart(one: FalsePlace, x: float, y: float) -> float:
    return (one.x - x) ** 2 + (one.y - y) ** 2


def _normal(square: float, variance: float) -> float:
    """Return the density per m² at a squared distance in m² from the mean."""
    return math.exp(-square / (2 * variance)) / (2 * math.pi * variance)
