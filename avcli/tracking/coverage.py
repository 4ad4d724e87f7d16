"""Where in the room a camera can see people, from its lens and pose."""

from dataclasses import dataclass

import numpy as np

from avcli.formats.experiment import Camera

STEP, CELLS = 0.1, 100  # m, wider where a side of the room would have more cells than that
HEIGHTS = np.arange(0.1, 1.75, 0.1)  # m, of points on a standing person's axis
NOTHING, ENOUGH = 0.05, 0.25  # shares of them in the picture with which nobody is detected, and everybody
LEAST = 0.02  # left where nobody should be detected: arms, tall people, a lens that is not quite as stated


@dataclass(frozen=True)
class Coverage:
    """How well a camera detects a person who stands at each place, on a grid.

    Attributes:
        low: (2,) m, the grid's corner.
        step: m, of the grid.
        share: (nx, ny), of the detection probability in full view.
    """

    low: np.ndarray
    step: float
    share: np.ndarray

    def at(self, positions: np.ndarray) -> list[float]:
        """Return the shares, n of them, at positions (n, 2) m; outside the grid they are those of its border."""
        last = np.array(self.share.shape) - 1
        cells = np.minimum(np.maximum((positions - self.low) / self.step, 0), last).astype(int)
        return self.share[cells[:, 0], cells[:, 1]].tolist()


def of_camera(camera: Camera, area: tuple[tuple[float, float], tuple[float, float]]) -> Coverage:
    """Compute where a camera detects people: where its picture holds a quarter of them or more, as its detectors need.

    Args:
        camera: its lens and pose.
        area: two corners of the floor in m.

    Returns:
        The share of the detection probability at each place.
    """
    low, high = np.array(area, float)
    step = max(STEP, (high - low).max() / CELLS)
    x, y = (a + step * (np.arange(max(int(np.ceil((b - a) / step)), 1)) + 0.5) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, y, HEIGHTS, indexing="ij"), -1)
    rotation, position = camera.T_room_camera[:3, :3], camera.T_room_camera[:3, 3]
    seen = (points - position) @ rotation
    with np.errstate(all="ignore"):
        u, v = np.moveaxis(camera.lens.project(seen.reshape(-1, 3)).reshape(*seen.shape[:-1], 2), -1, 0)
        inside = (u > -0.5) & (u < camera.width_px - 0.5) & (v > -0.5) & (v < camera.height_px - 0.5)
    inside &= np.arctan2(np.hypot(seen[..., 0], seen[..., 1]), seen[..., 2]) <= camera.theta_max
    share = (inside.mean(-1) - NOTHING) / (ENOUGH - NOTHING)
    return Coverage(low, step, np.minimum(np.maximum(share, LEAST), 1.0))
