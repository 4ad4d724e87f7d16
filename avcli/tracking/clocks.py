"""Whether the clocks of sensors agree, by where they detect people: who walks is at one place at one time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

LONGEST = 10.0  # s between two clocks
APART, REACH = 0.4, 0.5  # s between two records of one sensor that count; m within which it is one person
STEP, BROAD = 0.1, 3  # s, of the offsets that are tried; how many count together
PLATEAU = 0.95  # share of the best fit from which an offset fits as well

# Chosen on the cases of bench-tracking, hotel, zara01 and zara02 (seeds from 100): no false alarm in 112 runs.
ENOUGH, FITS = 20, 0.4  # records, and share of them that fits
SURE, LESS = 5.0, 0.5  # standard deviations by which that is more than usual; share of this that there may be at once
LEAST = 0.4  # s

Record = tuple[float, np.ndarray]  # s, and positions (n, 2 or more) m, NaN where unknown


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


def offset(first: Sequence[Record], second: Sequence[Record]) -> Offset | None:
    """Find by how much the clocks of two sensors certainly differ.

    Of each lag it is counted how often the second sensor finds somebody where the first one did. People who stay where
    they are fit at any time, and tell nothing.

    Args:
        first: records of one sensor, in order of time.
        second: those of the other one.

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
    looked = looks >= max(looks.max() / 2, 1)
    if not looked.any():
        return None
    share, lags = hits[looked] / looks[looked], (np.arange(len(looks)) - middle)[looked] * STEP
    nearest = abs(lags).min()  # of slow sensors no two records may be of one time
    best = int(share.argmax())
    fits, at_once = float(share[best]), float(share[abs(lags) < nearest + STEP / 2].max())
    worse = np.flatnonzero(share < PLATEAU * fits)  # who walks is within reach for a while: its middle is the offset
    alike = lags[np.append(-1, worse[worse < best])[-1] + 1 : np.append(worse[worse > best], len(lags))[0]]
    seconds, usual = float((alike[0] + alike[-1]) / 2), float(np.median(share))
    spread = math.sqrt((fits * (1 - fits) + at_once * (1 - at_once) + 0.02) / len(here))
    certain = fits >= FITS and fits - max(at_once, usual) > SURE * spread and abs(seconds) >= nearest + LEAST
    certain = certain and at_once - usual <= LESS * (fits - usual)
    return Offset(seconds, fits, at_once) if certain else None


def _one_of_each(records: Sequence[Record]) -> list[Record]:
    """Return one detection (2,) m of each record that has some, in turn, of records that lie APART."""
    out: list[Record] = []
    for time, positions in records:
        known = positions[np.isfinite(positions[:, :2]).all(1), :2]
        if len(known) and (not out or time - out[-1][0] >= APART):
            out.append((time, known[len(out) % len(known)]))
    return out
