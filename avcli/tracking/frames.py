"""Whether the coordinate frames of sensors agree, by where they detect people at one time.

A camera that is turned by 90 degrees, a picture that is mirrored, a room whose corner is elsewhere: each sensor by
itself looks right. What one sensor finds, turned, moved or mirrored, is then what the other one finds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

REACH, AT_ONCE = 0.5, 0.25  # m and s within which it is one person at one time
NEAR = 0.1, 0.35  # m, from and to: how far the places of one person by two sensors are apart
APART, SPELLS = 0.4, 20  # s between two records that count; spells of time that find a transform and judge it in turn
CELL, STAYS = 0.5, 4  # m, and how many detections of one such cell count: who stays in a place tells little
ENOUGH, MOST = 24, 600  # cells with detections from which anything is said; detections that are compared
CIRCLE, AROUND = 2.0, 8  # m, radius of the circle on which directions are compared; cells of it from which
STEEP = 0.3  # horizontal part of a direction up to which it points nowhere on the floor
CROWD = 20  # people in a record from which somebody is near by chance
TRIED, BASE = 300, 1.0  # transforms that are tried, and m between the two places that give one

# Chosen on the cases of bench-tracking and eleven sets of real walks (seeds from 100): no false alarm in 189 runs.
MOVED, FITS, SURE = 0.3, 0.5, 4.5  # m on average; share that fits; standard deviations by which it fits better

PLAIN = 5.0  # degrees
MIRRORS = {
    0: "y runs the other way",
    45: "x and y are exchanged",
    90: "x runs the other way",
    135: "x and y are exchanged and run the other way",
    180: "y runs the other way",
}
"""Direction in degrees of the line of a mirror -> what it does."""

Record = tuple[float, np.ndarray]  # s, and positions (n, 2 or more) m, NaN where unknown


class Transform(NamedTuple):
    """How the places of one sensor become those of another one.

    Attributes:
        matrix: (2, 2) orthogonal: it turns, and mirrors where its determinant is -1.
        shift: (2,) m: place of the second sensor = matrix @ place of the first one + shift.
        middle: (2,) m, of the first one's places.
        moved: m between the two, on average.
        fits: share of the first one's places at which the second one finds somebody then.
        as_it_is: the same share without it.
    """

    matrix: np.ndarray
    shift: np.ndarray
    middle: np.ndarray
    moved: float
    fits: float
    as_it_is: float

    def words(self) -> str:
        """Return what it does, as a person who looks for the mistake would say it."""
        turned = math.degrees(math.atan2(self.matrix[1, 0], self.matrix[0, 0]))
        if np.linalg.det(self.matrix) < 0:
            axis = turned / 2 % 180
            for plain, meaning in MIRRORS.items():
                if abs(axis - plain) < PLAIN:
                    return f"mirrored: {meaning}"
            return f"mirrored about a line at {axis:.0f} degrees from x to y"
        if abs(turned) < PLAIN:
            x, y = self.matrix @ self.middle + self.shift - self.middle
            return f"moved by ({x:z.1f}, {y:z.1f}) m"
        x, y = np.linalg.solve(np.eye(2) - self.matrix, self.shift)
        return f"turned by {turned:.0f} degrees from x to y about ({x:z.1f}, {y:z.1f}) m"


def transform(first: Sequence[Record], second: Sequence[Record], least: int = ENOUGH) -> Transform | None:
    """Find how the coordinate frames of two sensors certainly differ.

    Two places of the first sensor and two of the second one that are as far apart give a transform, and its mirror
    image another one (Fischler and Bolles 1981). The best of many is refined on the nearest places (Kabsch 1976), and
    judged by other spells of time than those that found it: it must fit better than none, and better than what the
    second sensor finds at other times.

    Args:
        first: records of one sensor, in order of time.
        second: those of the other one, which finds at least as many people.
        least: cells with detections from which anything is said.

    Returns:
        None: they agree, or nobody can tell.
    """
    here, there = _at_once(first, second)
    cells = np.unique((here / CELL).round(), axis=0, return_inverse=True)[1]
    if not len(here) or cells.max() < least:
        return None
    often = np.bincount(cells)[cells]
    weights = np.minimum(often, STAYS) / often
    rng = np.random.default_rng(0)
    even = np.arange(len(here)) * min(SPELLS, len(here) // 2) // len(here) % 2 == 0
    still = np.eye(2), np.zeros(2)
    moved, away, as_it_is = (np.zeros(len(here)) for _ in range(3))
    then = np.zeros((3, len(here)))
    for finds in (even, ~even):
        tried = _tried(here[finds], there[finds], rng)
        if not tried:
            return None
        shares = [weights[finds] @ (_away(*one, here[finds], there[finds]) < REACH) for one in tried]
        found = _refined(*tried[int(np.argmax(shares))], here[finds], there[finds], weights[finds])
        rest, others = here[~finds], there[~finds]
        moved[~finds] = np.linalg.norm(rest @ found[0].T + found[1] - rest, axis=1)
        away[~finds], as_it_is[~finds] = _away(*found, rest, others), _away(*still, rest, others)
        for k, at_other_times in enumerate(then, 1):
            at_other_times[~finds] = _away(*found, rest, np.roll(others, k * len(others) // 4, 0))
    average = weights / weights.sum()
    result = Transform(
        *_refined(*found, here, there, weights), average @ here,
        float(average @ moved), float(average @ (away < REACH)), float(average @ (as_it_is < REACH)),
    )  # fmt: skip
    surer = min(_surer(away, other, weights) for other in (as_it_is, *then))
    return result if result.moved >= MOVED and result.fits >= FITS and surer > SURE else None


def turn(first: Sequence[tuple[float, np.ndarray, np.ndarray]], second: Sequence[Record]) -> Transform | None:
    """Find how a sensor of directions is turned or mirrored against one of places, see `transform`.

    Args:
        first: records of the sensor of directions, in order of time: s, origins and directions (n, 2 or more).
        second: those of the other one.

    Returns:
        None: they agree, or nobody can tell.
    """
    origins = np.concatenate([origins[:, :2] for _, origins, _ in first])
    if not np.isfinite(origins).all(1).any():
        return None
    origin = np.nanmedian(origins, axis=0)
    here = [(time, _on_circle(directions[:, :2], STEEP)) for time, _, directions in first]
    there = [(time, _on_circle(positions[:, :2] - origin, 0.0)) for time, positions in second]
    found = transform(here, there, AROUND)
    return found and found._replace(shift=origin - found.matrix @ origin, middle=origin)


def _on_circle(ways: np.ndarray, least: float) -> np.ndarray:
    """Return where ways (n, 2) meet the circle, (n, 2) m; NaN where they are shorter than `least`."""
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return np.asarray(CIRCLE * ways / np.where(length > least, length, np.nan))


def _surer(away: np.ndarray, other: np.ndarray, weights: np.ndarray) -> float:
    """Return by how many standard deviations distances (n,) m are those of one person rather than other ones."""
    near = np.clip(np.median(away[away < REACH]), *NEAR) if (away < REACH).any() else NEAR[1]
    gain = np.exp(-np.square(away / near) / 2) - np.exp(-np.square(other / near) / 2)
    mean = weights @ gain / weights.sum()
    return float(mean * weights.sum() / math.sqrt(np.square(weights) @ np.square(gain - mean) + 1e-9))


def _at_once(first: Sequence[Record], second: Sequence[Record]) -> tuple[np.ndarray, np.ndarray]:
    """Return places (n, 2) m of the first sensor, and those (n, m, 2) of the second one then, inf where none."""
    times = np.array([time for time, _ in second])
    here: list[np.ndarray] = []
    there: list[np.ndarray] = []
    last = -math.inf
    for time, positions in first:
        known = positions[np.isfinite(positions[:, :2]).all(1), :2]
        if not len(known) or not len(times) or time - last < APART:
            continue
        near = int(np.abs(times - time).argmin())
        found = second[near][1]
        found = found[np.isfinite(found[:, :2]).all(1), :2]
        if abs(times[near] - time) <= AT_ONCE and 0 < len(found) <= CROWD:
            here += list(known)
            there += [found] * len(known)
            last = time
    kept = slice(None, None, max(len(here) // MOST, 1))
    here, there = here[kept], there[kept]
    padded = np.full((len(here), max(map(len, there), default=1), 2), np.inf)
    for row, found in zip(padded, there, strict=True):
        row[: len(found)] = found
    return np.array(here).reshape(-1, 2), padded


def _tried(here: np.ndarray, there: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return transforms by two places each: matrices (2, 2), and shifts (2,) m."""
    out: list[tuple[np.ndarray, np.ndarray]] = []
    found = np.isfinite(there[:, :, 0]).sum(1)
    for i, j in rng.integers(len(here), size=(20 * TRIED, 2)):
        base = here[j] - here[i]
        a, b = there[i, rng.integers(found[i])], there[j, rng.integers(found[j])]
        length, other = math.hypot(*base), math.hypot(*(b - a))
        if length < BASE or abs(length - other) > REACH:
            continue
        for flip in (1.0, -1.0):
            angle = math.atan2(b[1] - a[1], b[0] - a[0]) - flip * math.atan2(base[1], base[0])
            c, s = math.cos(angle), math.sin(angle)
            matrix = np.array([[c, -s * flip], [s, c * flip]])
            out.append((matrix, (a + b) / 2 - matrix @ (here[i] + here[j]) / 2))
        if len(out) >= TRIED:
            break
    return out


def _away(matrix: np.ndarray, shift: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return how far (n,) m each place is from the nearest of the other sensor after a transform."""
    return np.asarray(np.sqrt(np.square(there - (here @ matrix.T + shift)[:, None]).sum(2).min(1)))


def _refined(
    matrix: np.ndarray, shift: np.ndarray, here: np.ndarray, there: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the transform that fits best, in the least squares, to the places that are within reach."""
    parity = round(np.linalg.det(matrix))
    for _ in range(5):
        away = np.square(there - (here @ matrix.T + shift)[:, None]).sum(2)
        nearest, fit = away.argmin(1), away.min(1) < REACH * REACH
        a, b, w = here[fit], there[fit, nearest[fit]], weights[fit] / max(weights[fit].sum(), 1e-9)
        u, _, v = np.linalg.svd((b - w @ b).T @ (w[:, None] * (a - w @ a)))
        matrix = u @ np.diag([1.0, parity * np.linalg.det(u) * np.linalg.det(v)]) @ v
        shift = w @ b - matrix @ (w @ a)
    return matrix, shift
