"""Where a person is, which way they face, and where their feet stand: closed functions of time, with no state.

Feet are planned by distance along the path, so that a foot on the floor stays where it is at any speed.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

_TURN_S = 0.7  # a change of direction is spread over this time
_CHANGE_S = 0.9  # sitting down and standing up
_STEP_BOUNDS = (0.28, 0.55)  # length of a step over the body's height: slowest and fastest
_STEP_PER_ROOT_SPEED = 0.37  # that length at 1 m/s; it grows with the root of speed (Grieve and Gear, 1966)
_STANCE = 0.08  # of a step at its begin and at its end, in which both feet stand
_LIFT_M = 0.035  # of a swinging foot


@dataclass(frozen=True)
class Motion:
    """A person's way through waypoints.

    Attributes:
        times: (k,) s, increasing; before the first and after the last the person stands.
        places: (k, 2) m, where the person is then; straight and at constant speed in between.
        headings: (k,) rad counterclockwise from +x, the way the person faces while standing from that waypoint on;
            NaN: the way they came.
        seated: (k,) bool, whether the person sits while staying at that waypoint.
        height: of the person, m.
        postures: (k,) names of postures.POSTURES while staying there; empty: sits where `seated`, else stands.
    """

    times: np.ndarray
    places: np.ndarray
    headings: np.ndarray
    seated: np.ndarray
    height: float = field(default=1.75)
    postures: tuple[str, ...] = ()

    def position(self, t: np.ndarray) -> np.ndarray:
        """The point on the floor under the person at times t (n,) s: (n, 2) m."""
        return np.stack([np.interp(t, self.times, self.places[:, axis]) for axis in (0, 1)], -1)

    def speed(self, t: np.ndarray) -> np.ndarray:
        """Speed at times t (n,) s: (n,) m/s."""
        return np.append(np.append(0.0, self._leg_speeds), 0.0)[np.searchsorted(self.times, t, "right")]

    def heading(self, t: np.ndarray) -> np.ndarray:
        """Direction that the body faces at times t (n,) s: (n,) rad counterclockwise from +x."""
        legs = self._leg_headings
        x = np.clip((np.asarray(t, float)[:, None] - self.times) / _TURN_S, -0.5, 0.5)
        return legs[0] + (0.5 + x + np.sin(2 * np.pi * x) / (2 * np.pi)) @ np.diff(legs)

    def sitting(self, t: np.ndarray) -> np.ndarray:
        """How far the person sits at times t (n,) s: (n,), 0 stands, 1 sits."""
        return self._share(t, self._seats)

    def doing(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """How far the person has taken each posture that their way has, at times t (n,) s: (n,) each, 0..1."""
        return {name: self._share(t, stays) for name, stays in self._stays_of.items()}

    def _share(self, t: np.ndarray, stays: list[tuple[float, float]]) -> np.ndarray:
        t = np.asarray(t, float)
        amount = np.zeros_like(t)
        for begin, end in stays:
            rise = np.clip((t - begin) / _CHANGE_S, 0, 1) if np.isfinite(begin) else np.ones_like(t)
            fall = np.clip((end - t) / _CHANGE_S, 0, 1) if np.isfinite(end) else np.ones_like(t)
            amount = np.maximum(amount, np.minimum(rise, fall))
        return amount * amount * (3 - 2 * amount)

    def feet(self, t: np.ndarray, half_width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Place the feet.

        Args:
            t: (n,) s.
            half_width: m from the path to either foot.

        Returns:
            Places (n, 2, 3) m of the right and the left foot's sole, their headings (n, 2) rad, how far each is in its
            swing (n, 2), 0 on the floor, and how far ahead of the body each is in steps (n, 2).
        """
        t = np.asarray(t, float)
        sole, headings, swing, ahead = self.standing_feet(t, half_width)
        for walk in self._walks:
            now = (t >= walk.begin) & (t <= walk.end)
            if now.any():
                sole[now], headings[now], swing[now], ahead[now] = walk.feet(t[now], half_width)
        return sole, headings, swing, ahead

    def standing_feet(self, t: np.ndarray, half_width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `feet` at times (n,) s, of a person who stands or rolls: the feet are below the body, side by side."""
        heading = self.heading(t)
        side = np.array([-1.0, 1.0])  # right, left
        place = self.position(t)[:, None] + half_width * side[:, None] * _left(heading)[:, None]
        sole = np.concatenate([place, np.zeros((len(t), 2, 1))], -1)
        return sole, np.stack([heading] * 2, -1), np.zeros((len(t), 2)), np.zeros((len(t), 2))

    def travelled(self, t: np.ndarray) -> np.ndarray:
        """Length of the way at times t (n,) s: (n,) m."""
        lengths = np.linalg.norm(np.diff(self.places, axis=0), axis=1)
        return np.interp(t, self.times, np.append(0.0, np.cumsum(lengths)))

    @cached_property
    def _leg_speeds(self) -> np.ndarray:
        return np.linalg.norm(np.diff(self.places, axis=0), axis=1) / np.diff(self.times)

    @cached_property
    def _leg_headings(self) -> np.ndarray:
        """Unwrapped heading of each leg; leg 0 lies before the first waypoint, the last one after the last."""
        steps = np.diff(self.places, axis=0)
        moving = np.append(np.append(False, self._leg_speeds > 0), False)
        along = np.append(np.append(0.0, np.arctan2(steps[:, 1], steps[:, 0])), 0.0)
        asked = np.append(self.headings[:1], self.headings)
        headings = np.where(moving, along, asked)
        known = np.flatnonzero(np.isfinite(headings))
        if len(known) == 0:
            return np.zeros(len(headings))
        # Without a heading a person keeps the direction they came from, or looks where they will go.
        last = np.searchsorted(known, np.arange(len(headings)), "right") - 1
        return np.unwrap(headings[known[np.maximum(last, 0)]])

    @cached_property
    def _seats(self) -> list[tuple[float, float]]:
        """Times (begin, end) that the person spends seated, sitting down and getting up included."""
        return self._stays(self.seated)

    @cached_property
    def _stays_of(self) -> dict[str, list[tuple[float, float]]]:
        """Times (begin, end) that the person spends in each posture that is not standing or sitting alone."""
        names = np.array(self.postures)
        return {name: self._stays(names == name) for name in sorted({*self.postures} - {"stand", "sit"})}

    def _stays(self, there: np.ndarray) -> list[tuple[float, float]]:
        """Times (begin, end) that the person stays at waypoints of which `there` (k,) is true."""
        still = np.append(self._leg_speeds == 0, True) & there
        begins = [-np.inf if i == 0 else self.times[i] for i in np.flatnonzero(still)]
        ends = [self.times[i + 1] if i + 1 < len(self.times) else np.inf for i in np.flatnonzero(still)]
        merged: list[tuple[float, float]] = []
        for begin, end in zip(begins, ends, strict=True):
            if merged and merged[-1][1] == begin:
                merged[-1] = (merged[-1][0], end)
            else:
                merged.append((begin, end))
        return merged

    @cached_property
    def _walks(self) -> list["_Walk"]:
        moving = np.append(np.append(False, self._leg_speeds > 0), False).astype(int)
        begins, ends = np.flatnonzero(np.diff(moving) == 1), np.flatnonzero(np.diff(moving) == -1)
        return [_Walk(self, slice(b, e + 1)) for b, e in zip(begins, ends, strict=True)]


class _Walk:
    """The footsteps of one walk from stop to stop: it begins and ends with the feet side by side."""

    def __init__(self, motion: Motion, part: slice) -> None:
        self.motion = motion
        self.times, self.places = motion.times[part], motion.places[part]
        self.begin, self.end = self.times[0], self.times[-1]
        legs = np.linalg.norm(np.diff(self.places, axis=0), axis=1)
        self.lengths = np.append(0.0, np.cumsum(legs))
        total = self.lengths[-1]
        speed = total / (self.end - self.begin)
        wanted = motion.height * np.clip(_STEP_PER_ROOT_SPEED * np.sqrt(speed), *_STEP_BOUNDS)
        count = max(1, round(total / wanted))
        self.step = total / count
        falls = self.step * np.arange(count + 1)
        self.falls = np.concatenate([[0.0, 0.0], falls[1:], [total]])  # where the feet fall, alternating; two stand
        self.bounds = np.concatenate([[0.0], self.step * (np.arange(1, count + 1) - 0.5), [total]])

    def feet(self, t: np.ndarray, half_width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As `Motion.feet`, at times (n,) s within the walk."""
        s = np.interp(t, self.times, self.lengths)
        j = np.clip(np.searchsorted(self.bounds, s, "right"), 1, len(self.bounds) - 1)
        through = (s - self.bounds[j - 1]) / (self.bounds[j] - self.bounds[j - 1])
        u = np.clip((through - _STANCE) / (1 - 2 * _STANCE), 0, 1)
        eased = u * u * u * (10 + u * (6 * u - 15))
        stance_at, from_at, to_at = self.falls[j], self.falls[j - 1], self.falls[j + 1]
        sole, heading = np.empty((len(t), 2, 3)), np.empty((len(t), 2))
        swing, ahead = np.zeros((len(t), 2)), np.empty((len(t), 2))
        for foot, side in enumerate((-1.0, 1.0)):
            swings = (j % 2 == 1) == (foot == 0)
            stance = self._plant(stance_at, side * half_width)
            start, stop = self._plant(from_at, side * half_width), self._plant(to_at, side * half_width)
            e = eased[:, None]
            place = np.where(swings[:, None], start[0] * (1 - e) + stop[0] * e, stance[0])
            heading[:, foot] = np.where(swings, start[1] * (1 - eased) + stop[1] * eased, stance[1])
            swing[:, foot] = np.where(swings & (u < 1), u, 0.0)
            at = np.where(swings, from_at * (1 - eased) + to_at * eased, stance_at)
            ahead[:, foot] = (at - s) / self.step
            lift = np.where(swings, _LIFT_M * np.sin(np.pi * u) ** 2, 0.0)
            sole[:, foot] = np.concatenate([place, lift[:, None]], -1)
        return sole, heading, swing, ahead

    def _plant(self, s: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Place (n, 2) and heading (n,) of a foot that falls at distance s (n,)."""
        t = np.interp(s, self.lengths, self.times)
        heading = self.motion.heading(t)
        place = np.stack([np.interp(s, self.lengths, self.places[:, axis]) for axis in (0, 1)], -1)
        return place + offset * _left(heading), heading


def _left(heading: np.ndarray) -> np.ndarray:
    return np.stack([-np.sin(heading), np.cos(heading)], -1)
