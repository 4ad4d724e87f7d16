"""The thesis's procedure with OpenCV's own fisheye calibration, for comparison."""

from dataclasses import replace

import numpy as np

from avcli import pose
from avcli.calibration import fit
from avcli.lens import KannalaBrandt, Lens


class OpenCVRefused(fit.NoFit):
    """OpenCV's calibration gave up, or its result leaves no picture."""


def calibrate(observations: fit.Observations, width: int, height: int, start: Lens | None = None) -> fit.Solution:
    """Calibrate with cv2.fisheye.calibrate, all views at once.

    Args:
        observations: the corners.
        width, height: px.
        start: a lens to start from; None leaves OpenCV its own start, f = max(width, height) / pi.

    Raises:
        OpenCVRefused: OpenCV ends in an assertion.
    """
    import cv2

    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
    K: np.ndarray = np.eye(3)
    D: np.ndarray = np.zeros((4, 1))
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        K[[0, 1, 0, 1], [0, 1, 2, 2]] = start.fx, start.fy, start.cx, start.cy
    flat = np.column_stack([observations.points, np.zeros(len(observations.points))])
    rows = np.split(np.arange(len(flat)), observations.starts[1:])
    objects = [np.ascontiguousarray(flat[r][None]) for r in rows]
    pixels = [np.ascontiguousarray(observations.pixels[r][None]) for r in rows]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-9)
    try:
        _, K, D, turns, places = cv2.fisheye.calibrate(
            objects, pixels, (width, height), K, D, flags=flags, criteria=criteria
        )
    except cv2.error as error:
        reason = str(error.err or error).strip()
        raise OpenCVRefused(
            f"OpenCV {cv2.__version__} cannot fit these corners ({reason}); use the procedure avcli, which finds its "
            "own start"
        ) from None
    lens = KannalaBrandt(*map(float, [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D.ravel()[:4]]))
    parameters = np.append(lens.parameters, np.zeros(fit.BESIDE))
    if not np.isfinite(parameters).all():
        raise OpenCVRefused(f"OpenCV {cv2.__version__} returns a lens that is not finite; use the procedure avcli")
    return fit.Solution(
        parameters,
        pose.rotation_from_vector(np.array(turns).reshape(-1, 3)),
        np.array(places).reshape(-1, 3),
        free=fit.free_parameters(lens),
        like=lens,
    )


def thesis_procedure(
    observations: fit.Observations, width: int, height: int, limit_px: float = 0.75
) -> tuple[fit.Solution, np.ndarray]:
    """Calibrate, drop the pictures above `limit_px` RMS, calibrate again (the thesis, section 4.1).

    Returns:
        the solution for the kept views with its covariance, and `kept` (views,) bool.

    Raises:
        OpenCVRefused: OpenCV gives up, or no picture is left.
    """
    first = calibrate(observations, width, height)
    rms = fit.view_rms(observations, first)
    kept = rms <= limit_px
    if not kept.any():
        raise OpenCVRefused(
            f"OpenCV's fit fails: every picture has an RMS residual above {limit_px:g} px (smallest {rms.min():.1f} "
            f"px, f = {first.parameters[0]:.1f} px). OpenCV starts from f = {max(width, height) / np.pi:.0f} px, far "
            "from many lenses; use the procedure avcli, which finds its own start"
        )
    few = observations.of_views(kept)
    second = calibrate(few, width, height)
    spread, sigma = fit.covariance(few, second)
    return replace(second, covariance=spread, sigma_px=sigma), kept
