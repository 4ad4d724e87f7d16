"""What else may be while a sensor seems blind: it sees, and the people whom it misses have left or are hidden.

If each record without them is weighed alone, each asks for an excuse anew. Together they ask for one: who has left is
missed by all later records at no further cost. A person who is detected again and again speaks for a sensor that sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from avcli.tracking.densities import Densities
from avcli.tracking.scan import Likelihoods

# Chosen on ETH hotel (HOTA 90.9 to 91.2, 12 runs of 120 s); nothing changes in unseen, gaps, s2, occluded, duplicates,
# hall-both, comings-goings and the leave cases of `make bench-tracking`, seeds 100 to 107.
CERTAIN = math.log(100)  # log odds that the sensor sees from which it counts as seeing
MOST, LEAST = 1e3, 1e-300  # ratio by which one person speaks for it at most; what a logarithm is taken of at least


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


def seen(
    people: Densities,
    rows: Sequence[int],
    column: int,
    existence: Sequence[float],
    leaving: np.ndarray,
    detection: float,
    covered: np.ndarray | None,
    likelihoods: Likelihoods,
    clutter: Sequence[float],
) -> dict[int, Seen]:
    """Return what `Spell.follow` asks of known people, by label.

    Args:
        people: the densities before the record.
        rows: n of known people.
        column: of the sensor.
        existence: of each density.
        leaving: (n,) rates per second at which they leave.
        detection: probability that the sensor detects a person whom it can detect.
        covered: see `scan.Scan`.
        likelihoods: the same.
        clutter: the same.
    """
    share = np.ones(len(people)) if covered is None else (people.mode * covered).sum(1)
    return {
        people.label[row]: Seen(
            existence[row],
            people.detectable.item(row, column),
            rate,
            detection * share.item(row),
            math.fsum([g / clutter[j] for j, g in likelihoods[row]]),
        )
        for row, rate in zip(rows, leaving.tolist(), strict=True)
    }


def of_new_people(new: Sequence[float], clutter: Sequence[float]) -> float:
    """Return by how many nats J detections are likelier with new people, n per m², than of clutter alone."""
    return math.fsum([math.log(min(1 + b / c, MOST)) for c, b in zip(clutter, new, strict=True)])
