"""Whether a sensor sees the people whom a record misses: it is blind, they have left, or they are hidden.

A sensor that suddenly detects none of several people is blind, or everybody has left at the same time (`Blindness`).
While it seems blind, a second account is kept of what else may be: it sees, and those whom it misses have left or are
hidden (`Spell`). If each record without them is weighed alone, each asks for an excuse anew. Together they ask for
one: who has left is missed by all later records at no further cost. A person who is detected again and again speaks
for a sensor that sees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avcli.tracking.densities import Densities
from avcli.tracking.scan import Likelihoods, plausibility

if TYPE_CHECKING:
    from avcli.tracking.rates import Rates

# Chosen on ETH hotel, UCY zara01 and zara02 and on generated scenes (`make bench-tracking`, seeds from 100).
BLIND, SIGHTED = 0.02, 0.5  # rates per second at which a sensor goes blind, and sees again
COMMON = 0.05  # probability that what blinds one sensor blinds another one, too
EMPTIED = 0.02  # odds, at first, that a sensor that suddenly sees nobody is not blind, but everybody left
TOGETHER = 0.05  # probability that, where one of several people leaves, the others leave at the same time
ONSET = 0.9  # probability of blindness from which it may be that everybody left
LOST = 5.0  # records, after which a person who was not detected is lost
SEES = 1e-5  # probability of blindness below which nobody's own part in it matters
# Chosen on ETH hotel (HOTA 90.9 to 91.2, 12 runs of 120 s); nothing changes in unseen, gaps, s2, occluded, duplicates,
# hall-both, comings-goings and the leave cases of `make bench-tracking`, seeds 100 to 107.
CERTAIN = math.log(100)  # log odds that the sensor sees from which it counts as seeing
MOST, LEAST = 1e3, 1e-300  # ratio by which one person speaks for it at most; what a logarithm is taken of at least


class Blindness:
    """Whether a sensor sees nobody and reports clutter alone, or everybody has left: a hidden state of its own.

    A sensor that suddenly detects none of several people is blind, or everybody has left at the same time. The longer
    it detects nobody, the likelier it is that they left. Which of the two it was earlier tells, too.

    Attributes:
        probability: that it is blind, or that everybody left; `before`: before the last record.
        left: probability of the latter in that case.
        returned, emptied: how often somebody was detected again after that, and nobody, with the prior's worth.
        spell: what else may be while it seems blind; None: it does not.
    """

    def __init__(self, ever: bool, tells: bool = True) -> None:
        """Begin with a sensor that is not blind.

        Args:
            ever: whether it ever is.
            tells: whether people who are not detected may have left (silence does not tell that).
        """
        self.ever, self.tells, self.probability, self.left, self._odds = ever, tells, 0.0, 0.0, EMPTIED
        self.before = 0.0
        self.spell: Spell | None = None
        self.returned, self.emptied = 1.0, EMPTIED
        self._records = 0  # since it sees again, with 1 where it does not; 0: that is long ago
        self._again = 0  # of these, in which known people are detected, from the first that it had lost

    def predicted(self, dt: float) -> float:
        """Return the probability of blindness dt s after the last record."""
        rest, stay = BLIND / (BLIND + SIGHTED), math.exp(-(BLIND + SIGHTED) * dt)
        return rest + (self.probability - rest) * stay

    def acquit(self) -> None:
        """Take in that it certainly saw all the time."""
        self.probability, self.left, self._odds, self._records, self._again = 0.0, 0.0, EMPTIED, 0, 0
        self.spell = None

    def update(self, dt: float, ratio: float) -> None:
        """Take in that a record, dt s after the last one, is so much likelier if the sensor is not blind."""
        if not self.ever:
            return
        self.before = blind = self.predicted(dt)
        self.probability = blind / (blind + (1 - blind) * max(ratio, 1e-300))

    def without(self, ratio: float) -> float:
        """Return the probability of blindness by the latest record but for one part of it, so much likelier without."""
        return self.probability / max(self.probability + (1 - self.probability) / max(ratio, 1e-300), 1e-300)

    def share(self, other: Blindness) -> None:
        """Take in that another sensor has just lost everybody: what blinds that one may blind this one, too."""
        if self.ever:
            self.probability += (1 - self.probability) * COMMON * (1 - other.left)

    def emptiness(self, leaving: float) -> float:
        """Return the odds, at first, that people whom it suddenly misses left; leaving: see `empty`."""
        return max(self.emptied / self.returned, TOGETHER * leaving / BLIND)

    def empty(self, dt: float, leaving: float) -> None:
        """Weigh whether everybody left, after `update`.

        Args:
            dt: s since the sensor's last record.
            leaving: the least of the rates, per second, at which they leave where they were seen last.
        """
        if not self.tells:
            return
        if self.probability < 0.5:
            self.left = 0.0
            self._records += self._records > 0
            if self._records > LOST:
                back = self._again > 1  # one may be a false detection where somebody was
                self.returned, self.emptied = self.returned + back, self.emptied + (not back)
                self._records = 0
            return
        self._records, self._again = min(self._records, 1), 0
        if self.left:
            self._odds = min(self._odds * math.exp(SIGHTED * min(dt, 100.0)), 1e9)
        elif self.probability < ONSET:
            return
        else:
            self._odds, self._records = self.emptiness(leaving), 1
        self.left = self._odds / (1 + self._odds)

    def learn(self, gaps: Sequence[float], dt: float) -> None:
        """Learn from people whom the sensor has detected again, n s after it did so last; dt: of its records."""
        if self._again or any(gap > LOST * dt for gap in gaps):
            self._again += 1


class Seen(NamedTuple):
    """A known person and a record, if the sensor sees.

    Attributes:
        there: probability of existence before the record.
        able: probability that the sensor can detect the person.
        leaving: rate per second at which the person leaves.
        detection: probability that the sensor detects the person if it can.
        found: density of the detections near the person against that of clutter; 0: there is none.
    """

    there: float
    able: float
    leaving: float
    detection: float
    found: float


class Spell:
    """One time for which a sensor seems blind, told as if it saw.

    Attributes:
        before: label -> probabilities of existence, and that the sensor can detect the person, if it sees; before the
            last record.
    """

    def __init__(self, blind: float, left: float) -> None:
        """Begin before the first record that speaks for a blind sensor.

        Args:
            blind: probability that the sensor is, by the records before.
            left: odds that people who are suddenly missed left together, against a blind sensor.
        """
        self.before: dict[int, tuple[float, float]] = {}
        self._after: dict[int, tuple[float, float]] = {}
        blind = min(max(blind, LEAST), 1 - 1e-12)
        self._odds = math.log((1 - blind) / blind)  # that it sees, but for what those who are missed say
        self._missed, self._together = 0.0, math.log(max(left * blind, LEAST))  # nats: what they say, and at least

    def follow(self, people: dict[int, Seen], others: float, blind: float, hide: float, show: float, dt: float) -> bool:
        """Take in one record, and return whether it shows that the sensor certainly sees: it detects somebody.

        Args:
            people: by label.
            others: by how many nats the record's detections are likelier with new people than of clutter alone.
            blind: log likelihood of the record if the sensor was blind when the spell began, against clutter alone.
            hide, show: rates per second at which the sensor loses people, and finds them again.
            dt: s since its last record.
        """
        rest, mix = show / (hide + show), math.exp(-(hide + show) * dt)
        after, self._after, self.before = self._after, {}, {}
        self._odds += others - blind
        known = 0.0  # what this record's detections of these people say
        for label, one in people.items():
            there, able = one.there, one.able
            if label in after:
                there, able = after[label]
                there, able = there * math.exp(-one.leaving * dt), rest + (able - rest) * mix
            self.before[label] = there, able
            hit = 1 - one.detection + one.detection * one.found  # of who is there and detectable
            either = 1 - able + able * hit  # of who is there
            whole = max(1 - there + there * either, LEAST)
            nats = math.log(min(whole, MOST))
            known, self._missed = known + max(nats, 0.0), self._missed + min(nats, 0.0)
            self._after[label] = there * either / whole, able * hit / max(either, LEAST)
        self._odds += known
        return known > 0 and self._odds + max(self._missed, self._together) > CERTAIN


class Record(NamedTuple):
    """One record of one sensor with J detections, and who is known before it.

    Attributes:
        column: of the sensor.
        time: s.
        dt: s since the sensor's last record.
        people: n densities; their existence and whether they are detectable change where people left together.
        labelled: rows of labelled people.
        likely: of those: rows of the best joint hypotheses.
        leaving: takes (k, 6) states to (k,) rates per second at which such people leave.
        covered: see `scan.Scan`.
        likelihoods: the same.
        clutter: the same.
        new: J densities per m² of detecting a person never detected before.
    """

    column: int
    time: float
    dt: float
    people: Densities
    labelled: Sequence[int]
    likely: list[int]
    leaving: Callable[[np.ndarray], np.ndarray]
    covered: np.ndarray | None
    likelihoods: Likelihoods
    clutter: list[float]
    new: list[float]

    def rates_of_leaving(self, rows: Sequence[int]) -> np.ndarray:
        """Return the rates per second at which the people of some rows leave."""
        return self.leaving(self.people.mean.take(rows, 0)[:, 0])

    def least_leaving(self, existence: Sequence[float]) -> float:
        """Return the least of these rates of those who are probably there; 0: nobody is."""
        rows = [row for row in self.likely if existence[row] > 0.5]
        return float(self.rates_of_leaving(rows).min()) if rows else 0.0


class Sight(NamedTuple):
    """What a record's sensor can detect, see `scan.Scan` for the attributes of these names."""

    existence: list[float]
    detectable: list[float]
    p_sensor: float
    p_newcomer: float
    newcomers: list[float]
    p_detect: list[float]
    p_hit: list[float]


def weigh(record: Record, rates: Sequence[Rates]) -> Sight:
    """Weigh by a record whether its sensor is blind, and what it can detect then.

    Args:
        record: the record; the sensor's blindness takes it in.
        rates: of all sensors.
    """
    own, people, rows, new = rates[record.column], record.people, record.likely, record.new
    blindness, detection = own.blindness, own.detection
    told = record.likelihoods, record.clutter, new, detection
    existence, detectable, reach = _reached(record)
    ratio, known, parts = plausibility(rows, existence, reach, *told)
    if blindness.spell and _sees(blindness.spell, record, own, ratio, existence, blindness.predicted(record.dt)):
        existence, detectable, reach = _reached(record)
        ratio, known, parts = plausibility(rows, existence, reach, *told)
    before, existence = existence, _update(record, rates, ratio, existence)
    if blindness.probability < 0.5:
        blindness.spell = None
    elif not blindness.spell and blindness.tells:
        blindness.spell = Spell(blindness.before, blindness.emptiness(record.least_leaving(existence)))
        _sees(blindness.spell, record, own, ratio, before, 1.0)
    p_sensor = detection * (1 - blindness.probability)
    open_eyed = 1 - blindness.probability * (1 - blindness.left)
    p_detect = p_hit = [one * p_sensor for one in reach]
    newcomers = [one * open_eyed for one in new]
    if blindness.probability > SEES:  # else a detection says twice that the sensor sees: here, and as a person
        part_of = {people.label[row]: part for row, part in zip(rows, known, strict=True)}
        blind = [blindness.without(part_of.get(label, 1.0)) for label in people.label]
        p_hit = [one * detection * (1 - b) for one, b in zip(reach, blind, strict=True)]
        blind = [blindness.without(part) for part in parts]
        newcomers = [one * (1 - b * (1 - blindness.left)) for one, b in zip(new, blind, strict=True)]
    return Sight(existence, detectable, p_sensor, detection * open_eyed, newcomers, p_detect, p_hit)


def _reached(record: Record) -> tuple[list[float], list[float], list[float]]:
    """Return of each density existence, and whether the sensor can detect the person anywhere and there."""
    people = record.people
    existence, able = people.existence.tolist(), people.detectable[:, record.column]
    detectable = able.tolist()
    if record.covered is None:
        return existence, detectable, detectable
    return existence, detectable, (able * (people.mode * record.covered).sum(1)).tolist()


def _sees(spell: Spell, record: Record, own: Rates, ratio: float, existence: Sequence[float], blind: float) -> bool:
    """Tell a spell of a record; returns whether the sensor sees: then who is missed has left or is hidden.

    blind: probability that it is blind before the record.
    """
    people, column, hiding = record.people, record.column, own.hiding
    otherwise = math.log(max(blind + (1 - blind) * ratio, LEAST))
    others = math.fsum([math.log(min(1 + b / c, MOST)) for c, b in zip(record.clutter, record.new, strict=True)])
    found = _seen(record, existence, own.detection)
    if not spell.follow(found, others, otherwise, hiding.hide, hiding.show, record.dt):
        return False
    for row in record.labelled:
        if people.label[row] in spell.before:
            people.existence[row], people.detectable[row, column] = spell.before[people.label[row]]
    own.blindness.acquit()
    return True


def _seen(record: Record, existence: Sequence[float], detection: float) -> dict[int, Seen]:
    """Return what `Spell.follow` asks of known people, by label."""
    people, rows, covered = record.people, record.likely, record.covered
    share = np.ones(len(people)) if covered is None else (people.mode * covered).sum(1)
    return {
        people.label[row]: Seen(
            existence[row],
            people.detectable.item(row, record.column),
            rate,
            detection * share.item(row),
            math.fsum([g / record.clutter[j] for j, g in record.likelihoods[row]]),
        )
        for row, rate in zip(rows, record.rates_of_leaving(rows).tolist(), strict=True)
    }


def _update(record: Record, rates: Sequence[Rates], ratio: float, existence: list[float]) -> list[float]:
    """Weigh whether the sensor is blind, or everybody left; returns the n probabilities of existence after that.

    ratio: how much likelier its record is if the sensor is not blind.
    """
    blindness, people = rates[record.column].blindness, record.people
    blindness.update(record.dt, ratio)
    if blindness.probability < 0.5:  # then nobody has left because of it
        blindness.empty(record.dt, 0.0)
        return existence
    before = max(one.blindness.left for one in rates)
    onset = not blindness.left
    asks = onset and blindness.probability >= ONSET
    blindness.empty(record.dt, record.least_leaving(existence) if asks else 0.0)
    if onset and blindness.left:
        for other in rates:
            if other.blindness is not blindness:
                other.blindness.share(blindness)
    left = max(one.blindness.left for one in rates)
    if left <= before:
        return existence
    stay = (1 - left) / (1 - before)
    seen = people.seen[:, record.column]
    lost = (people.seen.max(1) == seen) & (seen < record.time)  # no other sensor has detected them since
    people.existence = np.where(lost, people.existence * stay, people.existence)
    return people.existence.tolist()
