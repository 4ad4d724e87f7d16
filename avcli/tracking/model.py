"""What trackers believe about the people of a room, and what they say about each: `Population`, `Track`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from avcli.tracking.motion import WALKING, Model, Motion
from avcli.tracking.settings import Settings

WALK = 0.5  # m/s, the least speed of somebody who is walking
NEAR = 1.0  # m, from a track's position: as near as this the person is there
BLUR = 2.0  # times the error that the position had when the person was detected last, if that is more
SOONER = 35.0  # by this factor people who walk near a wall leave sooner
GONE = 5.0  # rate per second at which people leave who are where no detection is used any more
REPORT, THERE = 0.5, 0.35  # from which a person is reported: probability to be in the room, and to be there
AREA = ((0.0, 0.0), (4.66, 4.66))  # m, the thesis's room, where the room is not known

Corners = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Population:
    """How people come, move, stay and leave: survival, motion and birth of the multi-target model.

    Attributes:
        area: two corners in m, between which people can be.
        motion: how people move.
        stay: s, mean time that a person stays while away from the walls.
        pass_by: s, the same of a person who walks within `edge` of a wall, where the doors are; a person who hardly
            moves there stays as anywhere.
        edge: m.
        arrivals: people that come per second, through the walls but for a share `appear`, which may appear anywhere.
        appear: share from 0 to 1.
        present: people expected in the room before the first record.
        body: m; no new person is expected as near as this to a known one or to another new one.
        evade: rate per second at which people who are about to walk into each other face to face stop.
        margin: m beyond the area, from which nobody is detected any more.
    """

    area: Corners = AREA
    motion: Motion = WALKING
    stay: float = 70.0
    pass_by: float = 2.0
    edge: float = 0.7
    arrivals: float = 0.05
    appear: float = 0.1
    present: float = 2.0
    body: float = 0.2
    evade: float = 2.0
    margin: float = math.inf

    @staticmethod
    def of(settings: Settings, room: tuple[float, float] | None = None) -> Population:
        """Make the model that settings describe, in a room of a size (x, y) in m; None: of unknown size."""
        motion = WALKING if settings.motion == "imm" else Motion((Model(0.0, pulse=settings.process_noise),))
        area, margin = (AREA, math.inf) if room is None else (((0.0, 0.0), room), settings.room_margin)
        if settings.doors == "anywhere":
            return Population(area, motion, settings.stay, pass_by=settings.stay, appear=1.0, margin=margin)
        return Population(area, motion, settings.stay, pass_by=settings.stay / SOONER, margin=margin)

    @cached_property
    def corners(self) -> np.ndarray:
        """The area's corners, (2, 2) m."""
        return np.array(self.area, float)

    @cached_property
    def centre(self) -> np.ndarray:
        """The area's centre, (2,) m."""
        return self.corners.mean(0)

    @cached_property
    def half(self) -> np.ndarray:
        """Half the sides of the area, (2,) m."""
        return (self.corners[1] - self.corners[0]) / 2

    @cached_property
    def birth_rate(self) -> np.ndarray:
        """People that come per second, anywhere and through the walls, (2,)."""
        return self.arrivals * np.array([self.appear, 1 - self.appear])

    @cached_property
    def middle(self) -> np.ndarray:
        """Half the sides of the part of the area that is not near the walls, (2,) m."""
        return self.half - self.edge

    @cached_property
    def surface(self) -> float:
        """Size of the area, m²."""
        (x0, y0), (x1, y1) = self.area
        return min(max((x1 - x0) * (y1 - y0), 1e-6), 1e12)

    @cached_property
    def strip(self) -> float:
        """Size of the part of the area that is near the walls, m²."""
        low, high = self.corners
        return max(self.surface - (high - low - 2 * self.edge).clip(0.0).prod(), 1e-6)

    def leaving(self, states: np.ndarray) -> np.ndarray:
        """Return the rate (n,) per second at which people in states (n, 4) m and m/s leave the room."""
        rates = [1 / self.stay] * len(states)
        (cx, cy), (mx, my) = self._core
        for k, near in enumerate(self.near_walls(states)):
            if near:
                x, y, *velocity = states[k].tolist()
                walks = min(math.hypot(*velocity) / WALK, 1.0)
                beyond = max(abs(x - cx) - mx, abs(y - cy) - my) - self.edge
                rates[k] = GONE if beyond > self.margin else max(walks / self.pass_by, rates[k])
        return np.array(rates)

    def density(self, positions: np.ndarray, anywhere: float, near_walls: float) -> np.ndarray:
        """Return the density (n,) per m² at positions (n, 2) m of so many people anywhere and so many near walls."""
        spread = anywhere / self.surface
        near = spread + near_walls / self.strip
        return np.array([near if one else spread for one in self.near_walls(positions)])

    def near_walls(self, positions: np.ndarray) -> list[bool]:
        """Tell of n positions (n, 2 or more) m whether they are within `edge` of a wall, or beyond it."""
        (cx, cy), (mx, my) = self._core
        return [abs(x - cx) > mx or abs(y - cy) > my for x, y, *_ in positions.tolist()]

    @cached_property
    def _core(self) -> list[list[float]]:
        """Centre and half the sides of the part of the area that is not near the walls, m: numbers, not arrays."""
        return [self.centre.tolist(), self.middle.tolist()]


def unobserved(low: float, high: float) -> float:
    """Return the variance (m²) of a coordinate that was not observed, of an area from low to high m.

    It is that of the normal distribution whose density in the middle is the uniform distribution's over the area.
    """
    return (high - low) ** 2 / (2 * math.pi)


class Track(NamedTuple):
    """One person at one time.

    Attributes:
        label: unique, never given twice.
        state: (4,) x, y m, vx, vy m/s.
        cov: (4, 4).
        existence: probability that the person is there, within NEAR of the position.
        detectable: sensor name -> probability that this sensor can detect the person now (microphones: that the person
            speaks).
        last_seen: s, when a sensor detected the person last.
    """

    label: int
    state: np.ndarray
    cov: np.ndarray
    existence: float
    detectable: Mapping[str, float] = {}
    last_seen: float = -math.inf
