"""What several stages compute: FFT lengths, the speed of sound, a clock's rate, medians, optimal assignment.

It imports numpy alone.
"""

import functools
import itertools
import math
import sys
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence

import numpy as np

SPEED_OF_SOUND_M_S = 343.0
"""m/s, where neither a speed nor a temperature is stated; the thesis's Table 5.1."""

_ALIKE = 0.25
"""Share by which steps differ that are one step of a clock."""
_MOST = 2 / 3
"""Share of the steps that are alike where a clock is regular."""
_OFF, _NEARLY_ALL = 0.1, 0.9
"""By how many steps of a clock a multiple may be off, and the share of the steps that are multiples."""
_FEWEST, _SHORTEST = 0.1, 0.05
"""The step of a clock with missing records is at least this share of all steps, and this share of the commonest one: so
two records of one moment, whose times are rounded to milliseconds, are no clock of 1000 Hz."""
_NTSC_HZ = [rate for whole in (12, 15, 24, 30, 48, 60, 120) for rate in (whole / 1.001, round(whole / 1.001, 3))]
"""Frame rates of television, as they are and as they are written: 29.97003 and 29.97."""

_WORK_WORTH_SCIPY = 3_000_000
"""Inner steps of `assign` that take as long as the import of scipy.optimize (about 0.15 s)."""


class TooLittle(ValueError):
    """There is too little data to tell what was asked."""


def median(values: np.ndarray) -> np.ndarray:
    """Medians (...) over the last axis of finite values (..., n), as np.median, which takes several times as long."""
    half, odd = divmod(values.shape[-1], 2)
    parted = np.partition(values, half if odd else (half - 1, half), axis=-1)
    return np.asarray(parted[..., half] if odd else parted[..., half - 1] / 2 + parted[..., half] / 2)


Assignment = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@functools.lru_cache(maxsize=64)
def fft_length(least: int) -> int:
    """Return the smallest even length of at least `least` whose FFT is fast: 2^a 3^b 5^c with a > 0.

    scipy.fft.next_fast_len knows more factors and odd lengths too, but its import takes 0.15 s, which is a third of the
    time that a command needs for a short scene; numpy.fft, with which we transform, is as fast for these lengths.
    """
    best = 1 << max(1, int(least - 1).bit_length())
    five = 1
    while five < best:
        three = five
        while three < best:
            length = three * 2
            while length < least:
                length *= 2
            best = min(best, length)
            three *= 3
        five *= 5
    return best


def speed_of_sound(temperature_c: float) -> float:
    """Return the speed of sound in dry air, m/s, at a temperature in °C (343.2 at 20 °C; ISO 9613-1:1993).

    Raises:
        ValueError: the temperature is not a number above absolute zero.
    """
    if not -273.15 < temperature_c < math.inf:
        raise ValueError(f"the temperature must be above -273.15 °C, not {temperature_c}")
    return 343.2 * math.sqrt((temperature_c + 273.15) / 293.15)


def rate_of(steps: Sequence[Sequence[float]]) -> float:
    """Return the rate in Hz of the clock that sensors keep, some records of which may be missing.

    Its step is the commonest one, like which most others are, or a shorter one of which all are multiples: many
    detectors write nothing where they find nobody. Time stamps are rounded, and sensors are late by more or less. So
    the rate is that of the mean of these steps, and the roundest number that is as near as the mean is uncertain:
    30 Hz, since a clock of 30.001 Hz soon runs away. The rates of television, 30 / 1.001 Hz and its kin, are as round
    as those with one decimal.

    Args:
        steps: s between successive records, of each sensor that has some.

    >>> rate_of([[0.033, 0.034, 0.033]])
    30.0
    >>> rate_of([[0.7, 0.5, 0.6, 0.5, 0.2, 0.3, 0.1, 0.4, 0.1]])
    10.0
    """
    usual, short, _ = _usual(steps)
    best: tuple[list[float], list[int]] = [], []
    for own in steps:  # of sensors that are nearly as fast, one
        if short:
            ticks = [max(round(step / short), 1) for step in own]
            known = [(step, n) for step, n in zip(own, ticks, strict=True) if abs(step - n * short) <= _OFF * short]
        else:
            known = [(step, 1) for step in own if abs(step - usual) <= _ALIKE * usual]
        if len(known) > len(best[0]):
            best = [step for step, _ in known], [n for _, n in known]
    mean, uncertain = _clock(*best)
    for round_ones in ([round(1 / mean)], [round(1 / mean, 1), *_NTSC_HZ], [round(1 / mean, 2)]):
        off, rate = min((abs(rate * mean - 1), rate) for rate in round_ones)
        if off <= uncertain:
            return float(rate)
    return 1 / mean


def is_regular(steps: Sequence[Sequence[float]]) -> bool:
    """Tell whether most steps, s of each sensor, are one step of a clock, or nearly all are multiples of it.

    >>> is_regular([[0.7, 0.5]]), is_regular([[0.1, 0.1, 0.2]])
    (False, True)
    """
    return bool(steps) and _usual(steps)[2]


def _usual(steps: Sequence[Sequence[float]]) -> tuple[float, float, bool]:
    """Find the step of a clock.

    Returns:
        The commonest step, s; a shorter one of which nearly all are multiples, s, or 0; and whether one of the two is
        clearly the clock's.
    """
    every = sorted(itertools.chain.from_iterable(steps))

    def alike(step: float) -> int:
        return bisect_right(every, step * (1 + _ALIKE)) - bisect_left(every, step * (1 - _ALIKE))

    usual = max(every, key=lambda step: (alike(step), -step))
    least = max(2.0, _FEWEST * len(every))
    first = next((step for step in every if step > _SHORTEST * usual and alike(step) >= least), usual)
    own = [step for step in every if abs(step - first) <= _ALIKE * first]
    short = math.fsum(own) / len(own)
    off = np.array(every) / short
    multiples = bool(np.mean(abs(off - np.maximum(off.round(), 1)) <= _OFF) >= _NEARLY_ALL)
    is_shorter = multiples and short < (1 - _ALIKE) * usual
    return usual, short if is_shorter else 0.0, multiples or alike(usual) >= _MOST * len(every)


def _clock(steps: Sequence[float], ticks: Sequence[int]) -> tuple[float, float]:
    """Return the step of a clock, s, and the share by which it is uncertain, from times that last some ticks each."""
    mean = math.fsum(steps) / sum(ticks)
    each = [step - (n - 1) * mean for step, n in zip(steps, ticks, strict=True)]
    spread = max(each) - min(each)
    for quantum in (1e-3, 1e-4):
        if 0.5 < spread / quantum < 1.5 and all(abs(step / quantum - round(step / quantum)) < 0.01 for step in steps):
            # 33 and 34 ms: nothing but the rounding of the times, whose errors do not add up; three standard deviations
            number = np.cumsum([0.0, *ticks])
            number -= number.mean()
            slope = float(number @ np.cumsum([0.0, *steps]) / (number @ number))
            return slope, 3.0 * quantum / (len(steps) ** 0.5 * sum(ticks) * slope)
    return mean, spread / mean / math.sqrt(len(steps)) + 1e-9


def assignment_solver(work: float) -> Assignment:
    """Choose the assignment solver that is sooner done with a given amount of work.

    Both give the same answer on the same cost matrix, so the choice is one of time alone.

    Args:
        work: sum over the problems of rows * columns * min(rows, columns).

    Returns:
        A function from a finite cost matrix (n, m) to row and column indices (min(n, m),) each, rows ascending.
    """
    if work < _WORK_WORTH_SCIPY and "scipy.optimize" not in sys.modules:
        return assign
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment


def assign(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign rows to columns at the least total cost, by shortest augmenting paths in plain Python.

    Ties are broken as scipy breaks them (columns are scanned from the last to the first, a later scanned one wins only
    when it is free), and the sums are taken in its order, so that results agree where TrackEval, which uses scipy, is
    the reference.

    Args:
        cost: finite costs (n, m).

    Returns:
        Row indices and column indices, int (min(n, m),) each, rows ascending.

    Source: D. F. Crouse, "On implementing 2D rectangular assignment algorithms", IEEE TAES 52(4), 2016, section III.
    """
    rows, columns = cost.shape
    if columns < rows:
        assigned, by_row = assign(cost.T)
        order = np.argsort(by_row)
        return by_row[order], assigned[order]
    costs = cost.tolist()
    row_dual = [0.0] * rows
    column_dual = [0.0] * columns
    row_of = [-1] * columns
    column_of = [-1] * rows
    for start in range(rows):
        distance = [np.inf] * columns
        parent = [-1] * columns
        open_columns = list(range(columns - 1, -1, -1))
        tree_rows, tree_columns = [], []
        row, reached, sink = start, 0.0, -1
        while sink < 0:
            tree_rows.append(row)
            costs_of_row, dual = costs[row], row_dual[row]
            best, nearest = -1, np.inf
            for k, column in enumerate(open_columns):
                through = reached + costs_of_row[column] - dual - column_dual[column]
                if through < distance[column]:
                    distance[column] = through
                    parent[column] = row
                length = distance[column]
                if length < nearest or (length == nearest and row_of[column] < 0):
                    best, nearest = k, length
            reached = nearest
            column = open_columns[best]
            tree_columns.append(column)
            open_columns[best] = open_columns[-1]
            open_columns.pop()
            if row_of[column] < 0:
                sink = column
            else:
                row = row_of[column]
        row_dual[start] += reached
        for row in tree_rows[1:]:
            row_dual[row] += reached - distance[column_of[row]]
        for column in tree_columns:
            column_dual[column] -= reached - distance[column]
        column = sink
        while True:
            row = parent[column]
            row_of[column] = row
            column_of[row], column = column, column_of[row]
            if row == start:
                break
    return np.arange(rows), np.array(column_of, dtype=int)
