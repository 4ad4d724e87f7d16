"""Whether the sensors of a run agree on where people are and when: a wrong clock or camera looks right by itself."""

from __future__ import annotations

import math
from collections import deque
from itertools import combinations

import numpy as np

from avcli.tracking.clocks import REACH, offset
from avcli.tracking.frames import motion

MEMORY = 120.0  # s of detections that are compared
FIRST, SELDOM = 10.0, 600.0  # s until the first comparison, and at most between two of them
MOST = 100  # detections of a record that are compared, so that time is bounded


class Agreement:
    """Where the sensors of a run detected people lately, and what that says of their clocks and frames."""

    def __init__(self) -> None:
        self._records: dict[str, deque[tuple[float, np.ndarray]]] = {}  # of each sensor
        self._begin, self._due = math.inf, math.inf  # s, of the first record, and of the next comparison
        self._pairs: list[tuple[str, str]] = []  # that are still to be compared
        self._said: set[frozenset[str]] = set()

    def take(self, time: float, name: str, positions: np.ndarray) -> None:
        """Note what a sensor found: time in s, positions (n, 2 or more) m, NaN where unknown."""
        if math.isinf(self._begin):
            self._begin, self._due = time, time + FIRST
        records = self._records.setdefault(name, deque())
        records.append((time, positions[:MOST]))
        while records[0][0] < time - MEMORY:
            records.popleft()

    def news(self, now: float) -> list[str]:
        """Return a sentence on two sensors that surely disagree, once; one pair a call, so that no step waits.

        now: s.
        """
        if now >= self._due:
            self._due = now + min(now - self._begin, SELDOM)
            pairs = combinations(sorted(self._records, key=self._found), 2)
            self._pairs = [pair for pair in pairs if frozenset(pair) not in self._said]
        if not self._pairs:
            return []
        pair = self._pairs.pop()
        records = [sorted(self._records[name], key=lambda record: record[0]) for name in pair]
        late, moved = offset(*records), motion(*records)
        if late is None and moved is None:
            return []
        self._said.add(frozenset(pair))
        if late is not None and (moved is None or late.fits >= moved.fits):
            first, second = pair if late.seconds > 0 else pair[::-1]
            return [
                f"sensor {second!r} finds people where {first!r} found them {abs(late.seconds):.1f} s before "
                f"({late.fits:.0%} within {REACH:g} m; at the same time {late.at_once:.0%}): do the clocks agree?"
            ]
        assert moved is not None
        return [
            f"sensor {pair[1]!r} finds people where {pair[0]!r} finds them, {moved.words()} ({moved.fits:.0%} within "
            f"{REACH:g} m; as they are {moved.as_it_is:.0%}): do their coordinates agree?"
        ]

    def _found(self, name: str) -> tuple[int, str]:
        """Return how many detections of a sensor are kept: of two, those of the one that finds fewer are looked for."""
        return sum([len(positions) for _, positions in self._records[name]]), name
