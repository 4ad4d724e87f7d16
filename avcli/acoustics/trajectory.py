"""Where a microphone is that moves."""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

FASTEST_M_S = 20.0
"""m/s; nothing here moves faster: a speaker who would have to has jumped, and a microphone is refused."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The way of a microphone: cubics in time through its places, with mean velocities there (Catmull-Rom).

    It rests between two times that have the same place, before the first time and after the last.

    Attributes:
        times_s: (k,) s, increasing.
        positions_m: (k, 3) m.

    Raises:
        ValueError: the shapes differ, the times do not increase, or it is faster than FASTEST_M_S.
    """

    times_s: np.ndarray
    positions_m: np.ndarray

    def __post_init__(self) -> None:
        if len(self.times_s) == 0 or self.positions_m.shape != (len(self.times_s), 3):
            raise ValueError("a trajectory has a position in three coordinates for each of its times")
        steps = np.diff(self.times_s)
        if not (steps > 0).all():
            raise ValueError("the times of a trajectory increase")
        speeds = np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1) / steps
        if (speeds > FASTEST_M_S).any():
            raise ValueError(
                f"{speeds.max():.0f} m/s from {self.times_s[np.argmax(speeds)]:g} s on; at most {FASTEST_M_S:g}"
            )

    @functools.cached_property
    def _velocities(self) -> np.ndarray:
        if len(self.times_s) < 2:
            return np.zeros_like(self.positions_m)
        steps = np.diff(self.times_s)[:, None]
        chords = np.diff(self.positions_m, axis=0) / steps
        inner = (chords[:-1] * steps[1:] + chords[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
        velocities = np.concatenate([chords[:1], inner, chords[-1:]])
        rests = ~chords.any(axis=1)
        velocities[:-1][rests] = velocities[1:][rests] = 0.0
        return velocities

    @functools.cached_property
    def _fastest(self) -> np.ndarray:
        """At most how fast it is between two times, (k + 1,) m/s: by the control points of its velocity, halved."""
        if len(self.times_s) < 2:
            return np.zeros(2)
        chords = np.diff(self.positions_m, axis=0) / np.diff(self.times_s)[:, None]
        begin, end = self._velocities[:-1], self._velocities[1:]
        middle = 3 * chords - begin - end
        controls = np.stack([begin, (begin + middle) / 2, (begin + 2 * middle + end) / 4, (middle + end) / 2, end])
        return np.concatenate([[0.0], np.linalg.norm(controls, axis=2).max(axis=0), [0.0]])

    def fastest(self, begin_s: float, end_s: float) -> float:
        """Return a speed that is not exceeded from one time to another, m/s."""
        first, last = np.searchsorted(self.times_s, [begin_s, end_s])
        return float(self._fastest[first : last + 1].max())

    def at(self, times_s: ArrayLike) -> np.ndarray:
        """Return where it is at some times, (n, 3) m."""
        times = np.clip(times_s, self.times_s[0], self.times_s[-1])
        i = np.clip(np.searchsorted(self.times_s, times, side="right") - 1, 0, max(len(self.times_s) - 2, 0))
        if len(self.times_s) < 2:
            return self.positions_m[i]
        step = (self.times_s[i + 1] - self.times_s[i])[:, None]
        u = (times - self.times_s[i])[:, None] / step
        p0, p1, v0, v1 = self.positions_m[i], self.positions_m[i + 1], self._velocities[i], self._velocities[i + 1]
        return (
            p0
            + u * step * v0
            + u**2 * (3 * (p1 - p0) - step * (2 * v0 + v1))
            + u**3 * (2 * (p0 - p1) + step * (v0 + v1))
        )
