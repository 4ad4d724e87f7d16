"""How often the filter is right where it believes with some probability that somebody is there: fitted to tracks.

The filter's probability is as true as its models of how people hide and leave. It is about right of people who
are detected for the first time, too modest of those who are detected again, and too sure of those who are not detected,
unless no camera looks where they are. So it is corrected by a logistic curve over its log odds for each of these. All
curves rise.

Source:
    J. Platt, "Probabilistic outputs for support vector machines and comparisons to regularized likelihood methods",
    Advances in Large Margin Classifiers, 1999 (a logistic curve over scores).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

FITTED = Path(__file__).with_name("existence.json")
SUREST = 1e-4  # least distance of the filter's probability from 0 and from 1


class Curve(NamedTuple):
    """A logistic curve over log odds.

    Attributes:
        odds: of somebody in whom the filter believes with 1/2.
        slope: log odds for each of the filter's, positive.
    """

    odds: float
    slope: float

    def of(self, believed: float) -> float:
        """Return the probability that somebody is there in whom the filter believes with some probability.

        >>> Curve(1.0, 1.0).of(0.75)
        0.75
        """
        odds = self.odds * ((believed + SUREST) / (1 - believed + SUREST)) ** self.slope
        return odds / (1 + odds)


class Trust(NamedTuple):
    """The curves of people who were detected once so far, and of others: whether or not in a sensor's latest record.

    The last one is that of people who were not detected where no camera looks.
    """

    once: Curve
    once_missed: Curve
    again: Curve
    again_missed: Curve
    unwatched: Curve

    def of(self, believed: float, detected: bool, count: float, watched: bool) -> float:
        """Return the probability that somebody is there.

        Args:
            believed: the filter's probability.
            detected: whether some sensor detected the person in its latest record.
            count: how often sensors have detected the person so far.
            watched: whether a camera looks where the person is.
        """
        missed = self.once_missed if count <= 1 else self.again_missed
        seen = self.once if count <= 1 else self.again
        return (seen if detected else missed if watched else self.unwatched).of(believed)


TRUST = Trust(*(Curve(**one) for one in json.loads(FITTED.read_text())["curves"].values()))
