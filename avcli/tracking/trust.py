"""How often the filter is right where it believes with some probability that somebody is there: fitted to tracks.

The filter's probability is as true as its models of how people hide, leave and walk. So it is corrected by a logistic
law. Its terms are the log odds that the person exists, and those that the person is near the place if so, each with a
slope of its own: real people who are not seen for a second turn, stop and leave the picture more often than models say.
Of people who are not detected two more terms say what a run sees itself:

- records in which nobody detected the person: one miss seldom comes alone, so the filter, for which each speaks
  against the person anew, believes too little after many;
- how many people have come back in this run after they had been missed for longer, against how many have left: this
  tells a room with things to hide behind from one with an open door.

People who were detected for the first time, and people who are where no camera looks, have coefficients of their own.

Source:
    J. Platt, "Probabilistic outputs for support vector machines and comparisons to regularized likelihood methods",
    Advances in Large Margin Classifiers, 1999 (a logistic curve over scores).
"""

from __future__ import annotations

import json
from bisect import bisect_right, insort
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

FITTED = Path(__file__).with_name("existence.json")
SUREST = 1e-4  # least distance of the filter's probabilities from 0 and from 1
MOST = 1000  # absences, and times of records, that are kept
MISSED = 1.5  # times a sensor's interval since the last detection: a record was missed between


class Grounds(NamedTuple):
    """What is known of one person now.

    Attributes:
        existence, near: the filter's probabilities that the person is in the room, and if so near the place.
        detected: whether some sensor detected the person in its latest record.
        hits: how often sensors have detected the person so far.
        watched: whether a camera looks where the person is.
        missed: records since then, at different times.
        returned: see `Absences.returned`.
    """

    existence: float
    near: float
    detected: bool
    hits: float
    watched: bool = True
    missed: int = 0
    returned: float = 1.0


class Law(NamedTuple):
    """Odds that somebody is there: a product of powers.

    Attributes:
        odds: of somebody in whom the filter believes with 1/2, and whose place it knows with 1/2.
        existence, near: powers of the filter's odds, not negative.
        missed: power of the number of records without a detection.
        returned: power of the ratio of people who came back to those who left.
    """

    odds: float
    existence: float
    near: float
    missed: float = 0.0
    returned: float = 0.0

    def of(self, grounds: Grounds) -> float:
        """Return the probability that somebody is there.

        >>> round(Law(1.0, 1.0, 0.0).of(Grounds(0.75, 1.0, True, 2)), 3)
        0.75
        """
        odds = self.odds * odds_of(grounds.existence) ** self.existence * odds_of(grounds.near) ** self.near
        odds *= max(grounds.missed, 1) ** self.missed * grounds.returned**self.returned
        return odds / (1 + odds)


def odds_of(probability: float) -> float:
    """Return the odds of a probability, which is held off 0 and 1."""
    return (probability + SUREST) / (1 - probability + SUREST)


class Trust(NamedTuple):
    """The laws of people who were detected once so far, and of others: whether or not in a sensor's latest record.

    The last one is that of people who were not detected where no camera looks.
    """

    once: Law
    once_missed: Law
    again: Law
    again_missed: Law
    unwatched: Law

    def of(self, grounds: Grounds) -> float:
        """Return the probability that somebody is there."""
        return self[self.group(grounds)].of(grounds)

    @staticmethod
    def group(grounds: Grounds) -> int:
        """Return which law holds for a person."""
        if not grounds.detected and not grounds.watched:
            return 4
        return 2 * (grounds.hits > 1) + (not grounds.detected)


class Absences:
    """How long the people of this run were not detected before they came back, and how many never did.

    Attributes:
        gaps: s, ascending.
        left: people who have left.
        times: s, of the latest records, each once.
    """

    def __init__(self) -> None:
        self.gaps: list[float] = []
        self.left = 0.0
        self.times: list[float] = []

    def record(self, now: float) -> None:
        """Note that there is a record of some sensor at a time in s."""
        if not self.times or now > self.times[-1]:
            self.times.append(now)
            if len(self.times) > 2 * MOST:
                del self.times[:MOST]

    def back(self, gaps: Iterable[float], dt: float) -> None:
        """Note that people were detected again after so many s each, by a sensor whose last record is dt s ago."""
        for gap in gaps:
            if gap > MISSED * dt:
                insort(self.gaps, gap)
        if len(self.gaps) > MOST:  # what is long ago counts half
            del self.gaps[::2]
            self.left /= 2

    def returned(self, since: float) -> float:
        """Return how many came back after more than so many s against how many left, with one more of each."""
        return (1 + len(self.gaps) - bisect_right(self.gaps, since)) / (1 + max(self.left, 0.0))

    def grounds(
        self, existence: float, near: float, detected: bool, hits: float, watched: bool, last: float, now: float
    ) -> Grounds:
        """Return what is known of a person now who was detected last at a time; see `Grounds`, times in s."""
        if detected:
            return Grounds(existence, near, detected, hits, watched)
        missed = len(self.times) - bisect_right(self.times, last)
        return Grounds(existence, near, detected, hits, watched, missed, self.returned(now - last))


TRUST = Trust(*(Law(**one) for one in json.loads(FITTED.read_text())["laws"].values()))
