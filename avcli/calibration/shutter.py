"""Whether a rolling shutter bent the boards: a board or camera that moved while the rows of a picture were read."""

from dataclasses import dataclass

import numpy as np

from avcli.calibration import fit
from avcli.calibration.fit import Observations, Solution

CERTAIN = 2.0
"""Rows must explain this many times as much of the residuals as columns do. Global shutters gave at most 1.5."""
_LEAST_CORNERS = 12


@dataclass(frozen=True)
class Shutter:
    """What motion during the readout explains.

    Attributes:
        ratio: of the squared residuals that a motion from row to row explains, over those that the same motion from
            column to column does; about 1 with a global shutter, whatever the noise and the errors of the lens model.
        motion_px: (views,) how far the board's corners moved between the first and the last row of the picture (RMS);
            noise adds to it. NaN where too few corners were seen.
    """

    ratio: float
    motion_px: np.ndarray

    @property
    def is_rolling(self) -> bool:
        """Whether the boards are bent as a rolling shutter bends them."""
        return self.ratio > CERTAIN


def measure(observations: Observations, solution: Solution, height: int) -> Shutter:
    """Fit a motion to each view: the pose changes in proportion to the row (Hedborg et al. 2012).

    A motion of the board as it is read shifts each corner by its derivative to the pose times the row. The same with
    columns in place of rows is no effect that a camera has: it tells how much six more unknowns a view explain by
    themselves. Motion and readout time have the same effect, so that neither is known alone.

    Args:
        observations, solution: the corners that belong, and the fit to them.
        height: px, of the pictures.
    """
    residual, by_pose = fit.by_pose(observations, solution)
    length = np.linalg.norm(residual, axis=1) / observations.sigma
    root = np.sqrt(np.minimum(1.0, solution.delta_px / np.maximum(length, 1e-12))) / observations.sigma
    explained = np.zeros(2)
    motion = np.full(observations.views, np.nan)
    for view, rows in enumerate(np.split(np.arange(len(length)), observations.starts[1:])):
        if len(rows) < _LEAST_CORNERS:
            continue
        weight = np.repeat(root[rows], 2)
        own = np.linalg.qr(by_pose[rows].reshape(-1, 6) * weight[:, None])[0]
        left = residual[rows].ravel() * weight
        left = left - own @ (own.T @ left)
        place = observations.pixels[rows]
        u, v = ((place - place.mean(0)) / place.std(0).max()).T
        for which, shapes in enumerate(((v,), (u * u, u * v, v * v))):
            design = np.concatenate([np.kron(shape[:, None], np.eye(2)) for shape in shapes], 1) * weight[:, None]
            free = design - own @ (own.T @ design)
            fitted, size, _ = np.linalg.svd(free, full_matrices=False)
            fitted = fitted[:, size > 0.05 * np.linalg.norm(design, axis=0).max()]
            explained[which] += np.sum((fitted.T @ left) ** 2) / max(fitted.shape[1], 1)
            if which == 0:
                change = np.linalg.lstsq(free, left, rcond=0.05)[0]
                motion[view] = np.linalg.norm(change) * height / place.std(0).max()
    return Shutter(float(explained[0] / explained[1]) if explained[1] > 0 else 1.0, motion)
