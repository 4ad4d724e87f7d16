"""Whether the clocks of sensors agree, by where they detect people: who walks is at one place at one time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from operator import itemgetter
from typing import NamedTuple

import numpy as np

MEMORY, LONGEST = 120.0, 10.0  # s of detections that are compared, and between two clocks
FIRST, SELDOM = 10.0, 60.0  # s until the first comparison, and at most between two of them
APART, REACH = 0.4, 0.5  # s between two records of one sensor that count; m within which it is one person
STEP, BROAD = 0.1, 3  # s, of the offsets that are tried; how many count together
MOST = 100  # detections of a record that are compared, so that time is bounded

# Chosen on the cases of bench-tracking, hotel and zara (seeds from 100): no false alarm in 482 comparisons.
ENOUGH, FITS, SURE = (
    20,
    0.4,
    5.0,
)  # records; share that fits; standard deviations by which it is more than at other times
LESS, LEAST = 0.5, 0.4  # share of that "more" which there may be at one time; s


class Offset(NamedTuple):
    """By how much two sensors find people at the same places at different times.

    Attributes:
        seconds: later, by the second sensor.
        fits: share of the first one's records of which the second one finds somebody at the same place then.
        at_once: the same share without the offset.
    """

    seconds: float
    fits: float
    at_once: float


class Clocks:
    """Where the sensors of a run detected people lately, and what that says of their clocks."""

    def __init__(self) -> None:
        self._records: dict[str, list[tuple[float, np.ndarray]]] = {}  # of each sensor: s, and (n, 2 or more) m
        self._begin, self._due = math.inf, math.inf  # s, of the first record, and of the next comparison
        self._said: set[tuple[str, str]] = set()

    def take(self, time: float, name: str, positions: np.ndarray) -> None:
        """Note what a sensor found: time in s, positions (n, 2 or more) m, NaN where unknown."""
        if math.isinf(self._begin):
            self._begin, self._due = time, time + FIRST
        self._records.setdefault(name, []).append((time, positions[:MOST]))

    def news(self, now: float) -> list[str]:
        """Return a sentence on each two sensors whose clocks surely disagree, once; now: s."""
        if now < self._due:
            return []
        self._due = now + min(now - self._begin, SELDOM)
        for name, records in self._records.items():
            self._records[name] = sorted([one for one in records if one[0] > now - MEMORY], key=itemgetter(0))
        told = []
        for pair in combinations(sorted(self._records, key=self._found), 2):
            found = None if pair in self._said else offset(*[self._records[name] for name in pair])
            if found is not None:
                self._said |= {pair, pair[::-1]}
                first, second = pair if found.seconds > 0 else pair[::-1]
                told.append(
                    f"sensor {second!r} finds people where {first!r} found them {abs(found.seconds):.1f} s before "
                    f"({found.fits:.0%} within {REACH:g} m; at the same time {found.at_once:.0%}): do the clocks agree?"
                )
        return told

    def _found(self, name: str) -> tuple[int, str]:
        """Return how many detections of a sensor are kept: of two, those of the one that finds fewer are looked for."""
        return sum([len(positions) for _, positions in self._records[name]]), name


def offset(first: Sequence[tuple[float, np.ndarray]], second: Sequence[tuple[float, np.ndarray]]) -> Offset | None:
    """Find by how much the clocks of two sensors certainly differ.

    Of each lag it is counted how often the second sensor finds somebody where the first one did. People who stay where
    they are fit at any time, and tell nothing.

    Args:
        first: records of one sensor, in order of time: s, and positions (n, 2 or more) m.
        second: the same of the other one.

    Returns:
        None: they agree, or nobody can tell.
    """
    here = _one_of_each(first)
    times = np.array([time for time, _ in second])
    places = [positions[np.isfinite(positions[:, :2]).all(1), :2] for _, positions in second]
    owner = np.repeat(np.arange(len(second)), [len(one) for one in places])
    if len(here) < ENOUGH or not len(owner):
        return None
    there, middle = np.concatenate(places), round(LONGEST / STEP)
    looks, hits = np.zeros(2 * middle + 1), np.zeros(2 * middle + 1)
    for time, place in here:
        a, b = np.searchsorted(times, [time - LONGEST, time + LONGEST])
        lags = np.rint((times[a:b] - time) / STEP).astype(int) + middle
        looks += np.bincount(lags, minlength=len(looks))
        i, j = np.searchsorted(owner, [a, b])
        near = np.square(there[i:j] - place).sum(1) < REACH * REACH
        hits += np.bincount(lags[np.unique(owner[i:j][near]) - a], minlength=len(looks))
    looks, hits = (np.convolve(one, np.ones(BROAD), "same") for one in (looks, hits))
    share = np.where(looks >= looks.max() / 2, hits / np.maximum(looks, 1), 0.0)
    best = int(share.argmax())
    fits, at_once = float(share[best]), float(share[middle])
    seconds, usual = (best - middle) * STEP, float(np.median(share))
    spread = math.sqrt((fits * (1 - fits) + at_once * (1 - at_once) + 0.02) / len(here))
    certain = fits >= FITS and fits - max(at_once, usual) > SURE * spread and abs(seconds) >= LEAST
    certain = certain and at_once - usual <= LESS * (fits - usual)
    return Offset(seconds, fits, at_once) if certain else None


def _one_of_each(records: Sequence[tuple[float, np.ndarray]]) -> list[tuple[float, np.ndarray]]:
    """Return one detection (2,) m of each record that has some, in turn, of records that lie APART."""
    out: list[tuple[float, np.ndarray]] = []
    for time, positions in records:
        known = positions[np.isfinite(positions[:, :2]).all(1), :2]
        if len(known) and (not out or time - out[-1][0] >= APART):
            out.append((time, known[len(out) % len(known)]))
    return out
