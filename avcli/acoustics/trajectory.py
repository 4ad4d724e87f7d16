"""The paths of speakers and microphones that move."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli.formats.records import Identified

FASTEST_M_S = 20.0
"""m/s; a faster speaker has jumped, and a faster microphone is refused."""
KNOTS_AROUND = 3
"""positions before and after one that decide on the velocity there."""


def cubic(
    u: np.ndarray, step: np.ndarray | float, p0: np.ndarray, v0: np.ndarray, p1: np.ndarray, v1: np.ndarray
) -> np.ndarray:
    """Return points of a cubic with given positions and velocities at its ends (Hermite), (n, 3) m.

    Args:
        u: (n, 1) share of the time between the ends, from 0 to 1.
        step: the time between the ends, s.
        p0, v0: position, m, and velocity, m/s, at u = 0.
        p1, v1: the same at u = 1.
    """
    return (
        p0 + u * step * v0 + u**2 * (3 * (p1 - p0) - step * (2 * v0 + v1)) + u**3 * (2 * (p0 - p1) + step * (v0 + v1))
    )


def knot_velocity(times_s: ArrayLike, positions_m: ArrayLike, knot: int) -> np.ndarray:
    """Return the velocity at a knot of a smooth path through positions, (3,) m/s; 0 beside two equal positions.

    It is that of the cubic spline through the knot and up to KNOTS_AROUND positions before and after it: a head that
    sways at 2 Hz and is told at 10 Hz is then 0.1 mm from its path where mean velocities (Catmull-Rom) leave 0.6 mm.

    Args:
        times_s: (k,) s, increasing.
        positions_m: (k, 3) m.
        knot: index.
    """
    first = max(knot - KNOTS_AROUND, 0)
    times = np.asarray(times_s, dtype=float)[first : knot + KNOTS_AROUND + 1]
    positions = np.asarray(positions_m, dtype=float)[first : knot + KNOTS_AROUND + 1]
    here, count = knot - first, len(times)
    if count < 2:
        return np.zeros(3)
    steps = np.diff(times)
    chords = np.diff(positions, axis=0) / steps[:, None]
    if not chords[max(here - 1, 0) : here + 1].any(axis=1).all():
        return np.zeros(3)
    slopes = np.zeros((count, count))
    wanted = np.empty((count, 3))
    for row, end, beside in ((0, 0, 1), (count - 1, -1, count - 2)):  # the first and last parts are parabolas
        slopes[row, [row, beside]] = 1.0
        wanted[row] = 2 * chords[end]
    inner = np.arange(1, count - 1)
    before, after = steps[:-1], steps[1:]
    slopes[inner, inner - 1], slopes[inner, inner], slopes[inner, inner + 1] = after, 2 * (before + after), before
    wanted[1:-1] = 3 * (after[:, None] * chords[:-1] + before[:, None] * chords[1:])
    return np.linalg.solve(slopes, wanted)[here] if count > 2 else chords[0]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The path of a microphone: cubics in time through its positions, with the velocities of a spline there.

    It rests between two times with the same position, before the first time and after the last.

    Attributes:
        times_s: (k,) s, increasing.
        positions_m: (k, 3) m.

    Raises:
        ValueError: the shapes differ, the times do not increase, or the microphone is faster than FASTEST_M_S.
    """

    times_s: np.ndarray
    positions_m: np.ndarray

    def __post_init__(self) -> None:
        if len(self.times_s) == 0 or self.positions_m.shape != (len(self.times_s), 3):
            raise ValueError("a trajectory needs a position in three coordinates for each of its times")
        steps = np.diff(self.times_s)
        if not (steps > 0).all():
            raise ValueError("the times of a trajectory must increase")
        speeds = np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1) / steps
        if (speeds > FASTEST_M_S).any():
            raise ValueError(
                f"moves at {speeds.max():.0f} m/s from {self.times_s[np.argmax(speeds)]:g} s on; "
                f"at most {FASTEST_M_S:g} m/s are possible"
            )

    @functools.cached_property
    def _velocities(self) -> np.ndarray:
        count = len(self.times_s)
        return np.array([knot_velocity(self.times_s, self.positions_m, knot) for knot in range(count)])

    @functools.cached_property
    def _fastest(self) -> np.ndarray:
        """An upper bound of its speed between two times, (k + 1,) m/s, by the control points of its velocity."""
        if len(self.times_s) < 2:
            return np.zeros(2)
        chords = np.diff(self.positions_m, axis=0) / np.diff(self.times_s)[:, None]
        begin, end = self._velocities[:-1], self._velocities[1:]
        middle = 3 * chords - begin - end
        controls = np.stack([begin, (begin + middle) / 2, (begin + 2 * middle + end) / 4, (middle + end) / 2, end])
        return np.concatenate([[0.0], np.linalg.norm(controls, axis=2).max(axis=0), [0.0]])

    def fastest(self, begin_s: float, end_s: float) -> float:
        """Return a speed that it does not exceed from one time to another, m/s."""
        first, last = np.searchsorted(self.times_s, [begin_s, end_s])
        return float(self._fastest[first : last + 1].max())

    def at(self, times_s: ArrayLike) -> np.ndarray:
        """Return its positions at some times, (n,) s: (n, 3) m."""
        times = np.clip(times_s, self.times_s[0], self.times_s[-1])
        i = np.clip(np.searchsorted(self.times_s, times, side="right") - 1, 0, max(len(self.times_s) - 2, 0))
        if len(self.times_s) < 2:
            return self.positions_m[i]
        step = (self.times_s[i + 1] - self.times_s[i])[:, None]
        u = (times - self.times_s[i])[:, None] / step
        return cubic(
            u, step, self.positions_m[i], self._velocities[i], self.positions_m[i + 1], self._velocities[i + 1]
        )


def trajectories_of(moments: Iterable[Identified]) -> dict[int, Trajectory]:
    """Return the paths of microphones from records whose ids are channels, from 0: channel -> path.

    Args:
        moments: positions in three coordinates, in the order of time.

    Raises:
        ValueError: a path is not one (see `Trajectory`); the message names the microphone, from 1.
    """
    paths: dict[int, tuple[list[float], list[np.ndarray]]] = {}
    for moment in moments:
        for channel, position in zip(moment.ids.tolist(), moment.positions, strict=True):
            times, positions = paths.setdefault(channel, ([], []))
            times.append(moment.timestamp)
            positions.append(position)
    trajectories = {}
    for channel, (times, positions) in paths.items():
        try:
            trajectories[channel] = Trajectory(np.array(times), np.array(positions))
        except ValueError as error:
            raise ValueError(f"microphone {channel + 1}: {error}") from None
    return trajectories
