"""Where in the room each sensor detects people: from a camera's lens and pose, or as config.json states it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from avcli.formats.experiment import Camera, Config, ConfigError
from avcli.formats.sensors import CAMERA
from avcli.pose import angle_from_axis

if TYPE_CHECKING:
    from avcli.tracking.model import Corners
    from avcli.tracking.settings import Sensor

STEP, CELLS = 0.1, 100  # m, wider where a side of the room would have more cells than that
HEIGHTS = np.arange(0.1, 1.75, 0.1)  # m, of points on a standing person's axis
NOTHING, ENOUGH = 0.05, 0.25  # shares of them in the picture with which nobody is detected, and everybody
LEAST = (
    0.001  # left where nobody should be detected (arms, a lens not quite as stated), hardly telling who is not there
)
WATCHED = 0.5  # share of its detection probability from which a sensor looks at a place
EDGE = 0.15  # m, standard deviation of where a field ends: lens, pose, height of the person (seeds 100 to 105 of hall)
AROUND = 3**0.5 * EDGE * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])  # m, five points of a Gaussian
WEIGHTS = np.array([2, 1, 1, 1, 1]) / 6


@dataclass(frozen=True)
class Coverage:
    """How well a sensor detects a person who stands at each place, on a grid.

    Attributes:
        low: (2,) m, the grid's corner.
        step: m, of the grid.
        share: (nx, ny), of the detection probability in full view.
    """

    low: np.ndarray
    step: float
    share: np.ndarray

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return the shares (n,) at positions (n, 2) m; outside the grid they are those of its border."""
        last = np.array(self.share.shape) - 1
        cells = np.minimum(np.maximum((positions - self.low) / self.step, 0), last).astype(int)
        return self.share[cells[:, 0], cells[:, 1]]

    def about(self, positions: np.ndarray) -> np.ndarray:
        """Return the expected shares (...) at positions (..., 2) m, for where it ends is known to `EDGE` alone.

        Source:
            S. J. Julier and J. K. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92(3), 2004
            (the points and their weights).
        """
        points = positions[..., None, :] + AROUND
        return self.at(points.reshape(-1, 2)).reshape(points.shape[:-1]) @ WEIGHTS

    @cached_property
    def whole(self) -> bool:
        """Whether it is the same everywhere."""
        return bool(self.share.min() >= 1.0)

    @cached_property
    def surface(self) -> float:
        """Size of what it covers, m²."""
        return float(self.share.sum()) * self.step**2


def of_camera(camera: Camera, area: Corners) -> Coverage:
    """Compute where a camera detects people: where its picture holds a quarter of them or more, as its detectors need.

    Args:
        camera: its lens and pose.
        area: two corners of the floor in m.

    Returns:
        The share of the detection probability at each place.
    """
    low, step, x, y = _grid(area)
    points = np.stack(np.meshgrid(x, y, HEIGHTS, indexing="ij"), -1)
    rotation, position = camera.T_room_camera[:3, :3], camera.T_room_camera[:3, 3]
    seen = (points - position) @ rotation
    with np.errstate(all="ignore"):
        u, v = np.moveaxis(camera.lens.project(seen.reshape(-1, 3)).reshape(*seen.shape[:-1], 2), -1, 0)
        inside = (u > -0.5) & (u < camera.width_px - 0.5) & (v > -0.5) & (v < camera.height_px - 0.5)
        if camera.circle is not None:
            inside &= np.hypot(u - camera.circle[0], v - camera.circle[1]) <= camera.circle[2]
    inside &= angle_from_axis(seen) <= camera.theta_max
    share = (inside.mean(-1) - NOTHING) / (ENOUGH - NOTHING)
    return Coverage(low, step, np.minimum(np.maximum(share, LEAST), 1.0))


def of_place(covers: Mapping[str, Any], area: Corners) -> Coverage:
    """Return the coverage that config.json states: a polygon or a disc on the floor.

    Args:
        covers: "polygon_m", (k, 2) corners in m, or "disc_m", x, y and radius in m; the other is None.
        area: two corners of the floor in m.
    """
    low, step, x, y = _grid(area)
    at = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    if covers["polygon_m"] is None:
        *centre, radius = covers["disc_m"]
        inside = np.hypot(*np.moveaxis(at - centre, -1, 0)) <= radius
    else:
        inside = np.zeros(at.shape[:2], bool)
        corners = np.array(covers["polygon_m"])
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, 0), strict=True):
            between = (ay <= at[..., 1]) != (by <= at[..., 1])  # crossings of a ray along x, even or odd
            with np.errstate(divide="ignore", invalid="ignore"):
                inside ^= between & (at[..., 0] < ax + (at[..., 1] - ay) / (by - ay) * (bx - ax))
    return Coverage(low, step, np.where(inside, 1.0, LEAST))


def of_config(config: Config, area: Corners) -> tuple[dict[str, Coverage], list[str]]:
    """Return where the sensors of a config.json detect people.

    Args:
        config: its camera is that of all cameras that state none.
        area: two corners of the floor in m.

    Returns:
        Name of a sensor, or "camera" for all other cameras, -> coverage; and a sentence for each that is not known.
    """
    found: dict[str, Coverage] = {}
    notes = []
    for name, known in {CAMERA: None, **config.known_sensors}.items():
        try:
            if known is None:
                if "camera_config" in config.raw:
                    found[name] = of_camera(config.camera, area)
            elif known["covers"] is not None:
                found[name] = of_place(known["covers"], area)
            elif (camera := config.camera_of(name)) is not None:
                found[name] = of_camera(camera, area)
        except ConfigError as error:
            whose = "the camera's coverage" if known is None else f"the coverage of sensor {name!r}"
            notes.append(f"{whose} of the room is not known: {error}")
    return found, notes


def covered(positions: np.ndarray, sensors: Sequence[Sensor]) -> np.ndarray:
    """Return the shares (n, S) with which S sensors detect people at positions (n, 2) m, of that in full view."""
    shares = np.ones((len(positions), len(sensors)))
    for k, sensor in enumerate(sensors):
        if sensor.coverage is not None and not sensor.coverage.whole:
            shares[:, k] = sensor.coverage.at(positions)
    return shares


def watched(positions: np.ndarray, sensors: Sequence[Sensor]) -> list[bool]:
    """Return whether a camera, or any sensor where there are no cameras, looks at each of n positions (n, 2) m."""
    cameras = [sensor for sensor in sensors if sensor.kind == CAMERA] or sensors
    return (covered(positions, cameras).max(1) >= WATCHED).tolist()


def _grid(area: Corners) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return the corner, the step and the centres along x and y of the cells of an area."""
    low, high = np.array(area, float)
    step = max(STEP, float((high - low).max()) / CELLS)
    x, y = (a + step * (np.arange(max(int(np.ceil((b - a) / step)), 1)) + 0.5) for a, b in zip(low, high, strict=True))
    return low, step, x, y
