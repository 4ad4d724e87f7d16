"""Whether the sensors of a run agree on where people are and when: a wrong clock or camera looks right by itself."""

from __future__ import annotations

import math
from collections import deque
from itertools import combinations
from operator import itemgetter

import numpy as np

from avcli.formats.records import Detections
from avcli.tracking.clocks import REACH, offset
from avcli.tracking.frames import CIRCLE, Transform, transform, turn

MEMORY = 120.0  # s of detections that are compared
FIRST, SELDOM = 10.0, 600.0  # s until the first comparison, and at most between two of them
MOST = 100  # detections of a record that are compared, so that time is bounded


class Agreement:
    """Where the sensors of a run detected people lately, and what that says of their clocks and frames."""

    def __init__(self) -> None:
        self._places: dict[str, deque[tuple[float, np.ndarray]]] = {}  # of each sensor: s and (n, 3) m
        self._ways: dict[str, deque[tuple[float, np.ndarray, np.ndarray]]] = {}  # s, origins and directions (n, 3)
        self._begin, self._due = math.inf, math.inf  # s, of the first record, and of the next comparison
        self._pairs: list[tuple[str, str]] = []  # that are still to be compared
        self._said: set[frozenset[str]] = set()

    def take(self, time: float, name: str, found: Detections) -> None:
        """Note what a sensor found at a time in s."""
        if math.isinf(self._begin):
            self._begin, self._due = time, time + FIRST
        places = found.positions[:MOST]
        if found.shows_less():
            ways = found.directions[:MOST]
            places = np.where(np.isfinite(ways[:, :1]), np.nan, places)  # what stands beside a direction is a guess
            if np.isfinite(ways[:, 0]).any():
                self._ways.setdefault(name, deque()).append((time, found.origins[:MOST], ways))
        self._places.setdefault(name, deque()).append((time, places))
        for records in (self._places, self._ways):
            while name in records and records[name] and records[name][0][0] < time - MEMORY:
                records[name].popleft()

    def news(self, now: float) -> list[str]:
        """Return a sentence on two sensors that surely disagree, once; one pair a call, so that no step waits.

        now: s.
        """
        if now >= self._due:
            self._due = now + min(now - self._begin, SELDOM)
            pairs = combinations(sorted(self._places, key=self._found), 2)
            self._pairs = [pair for pair in pairs if frozenset(pair) not in self._said]
        if not self._pairs:
            return []
        pair = self._pairs.pop()
        said = self._turned(*pair) or self._apart(*pair)
        self._said |= {frozenset(pair)} if said else set()
        return said

    def _turned(self, *pair: str) -> list[str]:
        """Return a sentence on a sensor of directions that is turned against one of places."""
        for one, other in (pair, pair[::-1]):
            if self._ways.get(one) and not self._ways.get(other):
                ways, places = (
                    sorted(self._ways[one], key=itemgetter(0)),
                    sorted(self._places[other], key=itemgetter(0)),
                )
                found = turn(ways, places)
                return [_said(one, other, found, f"{math.degrees(REACH / CIRCLE):.0f} degrees")] if found else []
        return []

    def _apart(self, first: str, second: str) -> list[str]:
        """Return a sentence on two sensors that find people at other times or in other places."""
        few, many = (sorted(self._places[name], key=itemgetter(0)) for name in (first, second))
        late, moved = offset(few, many), transform(few, many)
        if late is not None and (moved is None or late.fits >= moved.fits):
            before, after = (first, second) if late.seconds > 0 else (second, first)
            return [
                f"sensor {after!r} finds people where {before!r} found them {abs(late.seconds):.1f} s before "
                f"({late.fits:.0%} within {REACH:g} m; at the same time {late.at_once:.0%}): do the clocks agree?"
            ]
        return [_said(first, second, moved, f"{REACH:g} m")] if moved else []

    def _found(self, name: str) -> tuple[int, str]:
        """Return how many detections of a sensor are kept: of two, those of the one that finds fewer are looked for."""
        return sum([len(positions) for _, positions in self._places[name]]), name


def _said(first: str, second: str, found: Transform, within: str) -> str:
    return (
        f"sensor {second!r} finds people where {first!r} finds them, {found.words()} "
        f"({found.fits:.0%} within {within}; as they are {found.as_it_is:.0%}): do their coordinates agree?"
    )
