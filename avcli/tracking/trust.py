"""How often the filter is right where it believes with some probability that somebody is there: fitted to tracks.

The filter's probability is as true as its models of how people hide and leave. Of people who were not detected for a
while it is too sure, and just after a miss it is too modest. So it is corrected by a logistic curve over its log odds
and the time in which sensors looked in vain. The curve rises with the filter's probability.

Source:
    J. Platt, "Probabilistic outputs for support vector machines and comparisons to regularized likelihood methods",
    Advances in Large Margin Classifiers, 1999 (a logistic curve over scores).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import NamedTuple

FITTED = Path(__file__).with_name("existence.json")
SUREST = 1e-4  # least distance of the filter's probability from 0 and from 1


class Trust(NamedTuple):
    """A logistic curve.

    Attributes:
        offset: log odds of somebody who is detected now and whom the filter believes in with 1/2.
        slope: log odds for each of the filter's, positive.
        unseen: log odds for each unit of log(1 + s in which sensors looked in vain), negative.
    """

    offset: float
    slope: float
    unseen: float

    def of(self, believed: float, unseen: float) -> float:
        """Return the probability that somebody is there.

        Args:
            believed: the filter's probability.
            unseen: s since any sensor detected the person, times the probability that a sensor was not blind.

        >>> Trust(0.0, 1.0, 0.0).of(0.75, 2.0)
        0.75
        """
        odds = (believed + SUREST) / (1 - believed + SUREST)
        return 1 / (1 + math.exp(-self.offset - self.unseen * math.log1p(unseen)) * odds**-self.slope)


TRUST = Trust(**json.loads(FITTED.read_text())["curve"])
