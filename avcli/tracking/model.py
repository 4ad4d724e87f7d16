"""What a tracker is told (sensors, settings) and what it tells (tracks)."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from avcli.tracking.coverage import Coverage
from avcli.tracking.motion import WALKING, Motion

WALK = 0.5  # m/s, the least pace of somebody who is walking


@dataclass(frozen=True)
class Sensor:
    """How one sensor sees people.

    name: as records say it.
    detection: probability that it finds, in one record, a person whom it can find.
    clutter: false detections expected in one record.
    sigma: (sx, sy) m, noise of detections that carry no covariance.
    floor: m, added (in squares) to the noise of those that do, for what their covariance does not know: body sway,
        calibration, sound and light that do not quite behave as modelled.
    hide, show: rates per second at which people become hidden from it (fall silent) and findable again; hide 0: never.
    lead: metres that what it localizes is in front of the body's axis (a mouth).
    doubt: how many nats a low score speaks against a detection at most. More than a single record can tell if false
        detections come again in the same place, as echoes do.
    coverage: Coverage, where it finds people at all; None: everywhere alike.
    """

    name: str
    detection: float = 0.9
    clutter: float = 0.05
    sigma: tuple = (0.15, 0.15)
    floor: float = 0.05
    hide: float = 0.2
    show: float = 1.0
    lead: float = 0.0
    doubt: float = 4.0
    coverage: Coverage | None = field(default=None, compare=False)

    def findable(self):
        """Long-run probability that a person can be found."""
        return self.show / (self.hide + self.show) if self.hide else 1.0


def sensor(name, **known):
    """The usual model of a sensor by its name: with "audio" in it, microphones that localize mouths; else a camera."""
    if "audio" in name:
        usual = {
            "detection": 0.8,
            "clutter": 0.2,
            "sigma": (0.25, 0.25),
            "floor": 0.1,
            "hide": 1.0,
            "show": 1.0,
            "lead": 0.1,
            "doubt": 6.0,
        }
    else:
        usual = {}
    return Sensor(name, **{**usual, **known})


@dataclass(frozen=True)
class Settings:
    """What a tracker believes about people and how much it may think.

    area: ((x0, y0), (x1, y1)) m, where people can be. walls: whether nobody who is inside walks out unseen.
    motion: Motion.
    stay: mean time in s that a person stays in the room while away from its walls; pass_by: the same of somebody who
        walks within `edge` metres of a wall, where the doors are; who hardly moves there stays as anywhere.
    arrivals: people that come per second, through the walls but for a share `appear`, which may turn up anywhere.
    present: people expected in the room before the first record.
    speed: standard deviation of each velocity component of someone first seen, m/s.
    body: m; nobody new is expected this near to a known person, or to another one who is new.
    birth: "poisson" (from the first unexplained detection) or "adaptive" (from the previous record's detections).
    adapt: whether clutter and detection probability are estimated on the way.
    newborn: with adaptive birth, people expected to be born in each record.
    hypotheses: joint hypotheses kept in each cluster of interacting people.
    evade: rate per second at which people who are about to walk into each other face to face stop.
    """

    area: tuple = ((0.0, 0.0), (4.66, 4.66))
    walls: bool = True
    motion: Motion = WALKING
    stay: float = 100.0
    pass_by: float = 10.0
    edge: float = 0.7
    arrivals: float = 0.05
    appear: float = 0.3
    present: float = 2.0
    speed: float = 0.7
    body: float = 0.2
    birth: str = "poisson"
    newborn: float = 0.05
    adapt: bool = True
    hypotheses: int = 40
    evade: float = 2.0

    @cached_property
    def corners(self):
        """The area's corners, (2, 2) m."""
        return np.array(self.area, float)

    @cached_property
    def centre(self):
        """The area's centre, (2,) m."""
        return self.corners.mean(0)

    @cached_property
    def half(self):
        """Half the sides of the area, (2,) m."""
        return (self.corners[1] - self.corners[0]) / 2

    @cached_property
    def coming(self):
        """People that come per second anywhere and through the walls, (2,)."""
        return self.arrivals * np.array([self.appear, 1 - self.appear])

    @cached_property
    def middle(self):
        """Half the sides of the part of the area that is not near the walls, (2,) m."""
        return self.half - self.edge

    def staying(self, states, dt):
        """Probability that people in these states, (n, 4) m and m/s, are still in the room dt seconds later: (n,)."""
        near = self._near_walls(states)
        if not np.count_nonzero(near):
            return np.full(len(states), math.exp(-dt / self.stay))
        walks = np.minimum(np.hypot(states[:, 2], states[:, 3]) * (near / WALK), 1.0)
        return np.exp(-dt * np.maximum(walks / self.pass_by, 1 / self.stay))

    def crowd(self, places, anywhere, near_walls):
        """Density per m^2, at places (n, 2) m, of so many people anywhere and so many near the walls: (n,)."""
        spread = anywhere / self.surface
        return np.where(self._near_walls(places), spread + near_walls / self.strip, spread)

    def _near_walls(self, places):
        away = abs(places[:, :2] - self.centre) > self.middle
        return away[:, 0] | away[:, 1]

    @cached_property
    def surface(self):
        """Size of the area, m^2."""
        (x0, y0), (x1, y1) = self.area
        return max((x1 - x0) * (y1 - y0), 1e-6)

    @cached_property
    def strip(self):
        """Size of the part of the area that is near the walls, m^2."""
        low, high = self.corners
        return max(self.surface - (high - low - 2 * self.edge).clip(0.0).prod(), 1e-6)


class Track(NamedTuple):
    """One person at one time.

    label: unique, never given twice. state: (4,) x, y m, vx, vy m/s. cov: (4, 4). existence: probability.
    found: sensor name -> probability that this sensor can find the person now (for microphones: that they speak).
    """

    label: int
    state: np.ndarray
    cov: np.ndarray
    existence: float
    found: dict = {}  # noqa: RUF012 (never written to)
