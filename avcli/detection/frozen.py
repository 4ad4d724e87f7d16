"""A camera that has stopped: its picture stays the same to the last bit, which no sensor's noise allows."""

from __future__ import annotations

import numpy as np

LONG_S = 30.0
"""s for which pictures are the same, until the camera counts as frozen; those of a compressed film can be equal for
some seconds where nothing moves."""
COARSE = 16
"""px between the rows that are compared."""


class Frozen:
    """Tells when pictures have been equal for long.

    Attributes:
        since: s, time of the first of the equal pictures.
        is_frozen: whether they have been equal for LONG_S.
    """

    def __init__(self) -> None:
        """Begin without pictures."""
        self._last: np.ndarray | None = None
        self.since, self.is_frozen = 0.0, False

    def see(self, picture: np.ndarray, time: float) -> None:
        """Take in a picture (height, width, ...) and its time, s."""
        some = picture[::COARSE].copy()
        if self._last is None or time < self.since or not np.array_equal(some, self._last):
            self._last, self.since, self.is_frozen = some, time, False
        elif time - self.since >= LONG_S:
            self.is_frozen = True
