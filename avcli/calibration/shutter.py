"""Whether a rolling shutter bent the boards: a board or camera that moved while the rows of a picture were read."""

from dataclasses import dataclass

import numpy as np

from avcli.calibration import fit
from avcli.calibration.blocks import POSE, damped
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
    u, v, reach = _places(observations)
    shapes = np.stack([v, u * u, u * v, v * v], -1)
    columns = np.concatenate(
        [by_pose, np.einsum("ns,ab->nasb", shapes, np.eye(2)).reshape(-1, 2, 8), residual[..., None]], 2
    )
    gram = observations.gram(columns * root[:, None, None])
    length_squared = np.einsum("vii->vi", gram)[:, POSE:-1].copy()
    gram = (
        gram[:, POSE:, POSE:]
        - gram[:, POSE:, :POSE] @ np.linalg.inv(damped(gram[:, :POSE, :POSE], 0.0)) @ gram[:, :POSE, POSE:]
    )
    enough = np.bincount(observations.view) >= _LEAST_CORNERS
    explained = np.zeros((observations.views, 2))
    for which, part in enumerate((slice(0, 2), slice(2, 8))):
        size, axes = np.linalg.eigh(gram[:, part, part])
        along = (axes.transpose(0, 2, 1) @ gram[:, part, -1:])[..., 0]
        told = size > 0.05**2 * length_squared[:, part].max(1, keepdims=True)
        gained = np.where(told, along**2 / np.where(told, size, 1.0), 0.0).sum(1)
        explained[:, which] = np.where(enough, gained / np.maximum(told.sum(1), 1), 0.0)
        if which == 0:
            told = size > 0.05**2 * size[:, -1:]
            change = (axes @ np.where(told, along / np.where(told, size, 1.0), 0.0)[..., None])[..., 0]
            motion = np.where(enough, np.linalg.norm(change, axis=1) * height / reach, np.nan)
    return Shutter(*_ratio(explained), motion)


def _places(observations: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of the corners (n,) across and down, from the middle of the view and over its larger sd (views,) px."""
    count = np.bincount(observations.view)[:, None]
    off = observations.pixels - (observations.per_view(observations.pixels) / count)[observations.view]
    reach = np.sqrt((observations.per_view(off**2) / count).max(1))
    u, v = (off / np.maximum(reach, 1e-9)[observations.view, None]).T
    return u, v, reach


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
