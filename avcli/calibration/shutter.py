"""Whether a rolling shutter bent the boards: a board or camera that moved while the rows of a picture were read."""

from dataclasses import dataclass

import numpy as np

from avcli.calibration import fit
from avcli.calibration.fit import Observations, Solution

CERTAIN = 1.7
"""Ratio from which the shutter is rolling: cameras at rest gave at most 1.25, a motion of 1 px gives 1.8."""
AT_REST = 1.25
"""The largest ratio of a camera at rest; a ratio must be above it by CLEAR standard deviations."""
CLEAR = 3.0
TOO_FAR_PX = 2.0
"""Median motion during the readout from which no lens is believed: at 2 px the focal length errs by 5 stated sd."""
_LEAST_CORNERS = 12


@dataclass(frozen=True)
class Shutter:
    """What a motion during the readout explains.

    Attributes:
        ratio: what a shift from row to row explains of the squared residuals, over what shifts with the square of the
            place do, for each unknown. Noise gives 1; errors of the lens and the board give both.
        sd: standard deviation of the ratio's logarithm, from how much the views disagree; infinite where too few tell.
        motion_px: (views,) how far the board moved between the first and the last row of the picture; noise adds to it.
            NaN where too few corners were seen.
    """

    ratio: float
    sd: float
    motion_px: np.ndarray

    @property
    def is_rolling(self) -> bool:
        """Whether the boards are bent as a rolling shutter bends them."""
        return bool(self.ratio > max(CERTAIN, AT_REST * np.exp(CLEAR * self.sd)))

    @property
    def typical_px(self) -> float:
        """Median of the motions, px; NaN where none is known."""
        return float(np.nanmedian(self.motion_px)) if np.isfinite(self.motion_px).any() else float("nan")


def unknown(views: int) -> Shutter:
    """Say nothing of the shutter of so many views."""
    return Shutter(float("nan"), float("inf"), np.full(views, np.nan))


def measure(observations: Observations, solution: Solution, height: int) -> Shutter:
    """Fit to each view a shift that grows with the row, beside its pose (Hedborg et al. 2012 fit the whole motion).

    A board that moves while the rows are read is sheared and stretched, which no pose does. Other errors of a lens or a
    board bend it in curves as well: they are the measure of what chance explains. Only the product of motion and
    readout time can be known, so no rows a millisecond are stated.

    Args:
        observations, solution: the corners that belong, and the fit to them.
        height: px, of the pictures.
    """
    residual, by_pose = fit.by_pose(observations, solution)
    length = np.linalg.norm(residual, axis=1) / observations.sigma
    root = np.sqrt(np.minimum(1.0, solution.delta_px / np.maximum(length, 1e-12))) / observations.sigma
    explained = np.zeros((observations.views, 2))
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
            explained[view, which] = np.sum((fitted.T @ left) ** 2) / max(fitted.shape[1], 1)
            if which == 0:
                change = np.linalg.lstsq(free, left, rcond=0.05)[0]
                motion[view] = np.linalg.norm(change) * height / place.std(0).max()
    return Shutter(*_ratio(explained), motion)


def _ratio(explained: np.ndarray) -> tuple[float, float]:
    """Ratio of the sums of the two columns (views, 2), and the sd of its logarithm by leaving out each view in turn."""
    told = explained[explained.all(1)]
    total, count = told.sum(0), len(told)
    if count < 2:
        return 1.0, float("inf")
    without = np.log(np.divide(*(total - told).T))
    return float(total[0] / total[1]), float(np.sqrt((count - 1) / count * ((without - without.mean()) ** 2).sum()))


def refusals(found: Shutter) -> tuple[str, ...]:
    """Say why a rolling shutter spoils the lens; empty where it does not."""
    if not (found.is_rolling and found.typical_px > TOO_FAR_PX):
        return ()
    return (
        f"the board moved by {found.typical_px:.1f} px (median) while the rows of a picture were read (rolling "
        "shutter): hold camera and board still",
    )


def advice(found: Shutter) -> list[str]:
    """Say that the shutter is rolling, if the pictures show it."""
    if not found.is_rolling:
        return []
    return [
        f"the shutter is rolling: the board moved by about {found.typical_px:.1f} px (median) while a picture was "
        "read; hold camera and board still"
    ]
