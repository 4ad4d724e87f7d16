"""Where in the room a camera can see people, from its lens and pose."""

from dataclasses import dataclass

import numpy as np

STEP, CELLS = 0.1, 100  # m, wider where a side of the room would have more cells than that
HEIGHTS = np.arange(0.1, 1.75, 0.1)  # m, of points on a standing person's axis
NOTHING, ENOUGH = 0.05, 0.25  # shares of them in the picture with which nobody is found, and everybody
LEAST = 0.02  # what is left where nobody should be found: arms, people who are tall, a lens that is not quite as said


@dataclass(frozen=True)
class Coverage:
    """How readily somebody is found who stands at each place, on a grid.

    low: (2,) m, its corner; step: m; share: (nx, ny), of the detection probability in full view.
    """

    low: np.ndarray
    step: float
    share: np.ndarray

    def at(self, places):
        """The shares at places (n, 2) m, those outside the grid as at its border: a list of n."""
        last = np.array(self.share.shape) - 1
        cells = np.minimum(np.maximum((places - self.low) / self.step, 0), last).astype(int)
        return self.share[cells[:, 0], cells[:, 1]].tolist()


def of_camera(camera, area):
    """Where a camera finds people: those of whom its picture holds a quarter or more, as its detectors do.

    camera: experiment.Camera; area: ((x0, y0), (x1, y1)) m. Returns Coverage.
    """
    low, high = np.array(area, float)
    step = max(STEP, (high - low).max() / CELLS)
    x, y = (a + step * (np.arange(max(int(np.ceil((b - a) / step)), 1)) + 0.5) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, y, HEIGHTS, indexing="ij"), -1)
    rotation, place = camera.T_room_camera[:3, :3], camera.T_room_camera[:3, 3]
    seen = (points - place) @ rotation
    with np.errstate(all="ignore"):
        u, v = np.moveaxis(camera.lens.project(seen.reshape(-1, 3)).reshape(*seen.shape[:-1], 2), -1, 0)
        inside = (u > -0.5) & (u < camera.width_px - 0.5) & (v > -0.5) & (v < camera.height_px - 0.5)
    inside &= np.arctan2(np.hypot(seen[..., 0], seen[..., 1]), seen[..., 2]) <= camera.theta_max
    share = (inside.mean(-1) - NOTHING) / (ENOUGH - NOTHING)
    return Coverage(low, step, np.minimum(np.maximum(share, LEAST), 1.0))
