"""The centre of a lens, which moves along its axis as the angle grows.

Seen at an angle of theta (rad) from the axis, a point is seen from `pupil` theta² (m) farther ahead, as the entrance
pupil of a wide lens does (Gennery 2006, Generalized camera calibration including fish-eye lenses, writes it as a series
in theta). Near boards tell it, far ones do not. What is known of it before is how it is spread over real lenses.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avcli.lens import Lens

FITTED = Path(__file__).with_name("pupil.json")


class Spread(NamedTuple):
    """How the pupil is spread over lenses, normally: mean and standard deviation, in fit.pupil_unit."""

    mean: float
    sd: float


_known = json.loads(FITTED.read_text())
PUPIL = Spread(_known["mean"], _known["sd"])
"""What is known of the pupil before anything is seen (pupil.json, by `make fit-pupil`). A fit knows no length of the
lens. The square of the board and its distance both stand for one, badly; their geometric mean is more likely."""


def from_pupil(points: np.ndarray, pupil: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) m of the camera's frame as the centre of projection sees them.

    Args:
        points: in the frame whose origin is the centre for rays along the axis.
        pupil: m, as in Solution.

    Returns:
        the points from the centre that they are seen from, (n, 3); how much less their z is for each m of `pupil`,
        (n,); and its derivative to the points, (n, 3) 1/m.
    """
    x, y, z = points.T
    off = np.hypot(x, y)
    theta = np.arctan2(off, z)
    less = theta**2
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = 2 * theta / (off**2 + z**2)
        across = np.where(off > 0, slope * z / off, 0.0)
    seen = points.copy()
    seen[:, 2] -= pupil * less
    return seen, less, np.stack([across * x, across * y, -slope * off], -1)


def project_jacobian(
    lens: Lens, points: np.ndarray, pupil: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Project points (n, 3) m of the camera's frame by a lens whose centre may move.

    Returns:
        pixels (n, 2), NaN where the lens images nothing, and their derivatives to the points (n, 2, 3) px/m, to the
        lens's parameters (n, 2, parameters) and to `pupil` (n, 2) px/m.
    """
    seen, less, slope = from_pupil(points, pupil)
    pixels, by_seen, by_lens = lens.project_jacobian(seen)
    by_point = by_seen - pupil * by_seen[:, :, 2:] * slope[:, None]
    return pixels, by_point, by_lens, -by_seen[:, :, 2] * less[:, None]
