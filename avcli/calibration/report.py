"""What a calibration says for itself: in words, in a picture, in an HTML page."""

import numpy as np

from avcli.calibration.calibrate import Calibration


def words(result: Calibration) -> list[str]:
    """Say how good a calibration is, in sentences without a full stop."""
    q, lens, parameters = result.quality, result.solution.lens, result.solution.parameters
    held_out = f"{q.held_out_rms_px:.3f} px" if np.isfinite(q.held_out_rms_px) else "unknown (too few)"
    pixels = zip(("fx", "fy", "cx", "cy"), parameters[:4], q.sd[:4], strict=True)
    terms = zip(("k1", "k2", "k3", "k4"), parameters[4:8], q.sd[4:8], strict=True)
    lines = [
        f"RMS {q.rms_px:.3f} px, {q.inlier_rms_px:.3f} px without outliers; pictures held out of the fit {held_out}",
        ", ".join(f"{name} {value:.2f} ± {sd:.2f}" for name, value, sd in pixels) + " px",
        ", ".join(f"{name} {value:.5f} ± {sd:.5f}" for name, value, sd in terms),
        f"expected error over the picture: mean {np.nanmean(q.field_sd_px):.3f} px, largest "
        f"{np.nanmax(q.field_sd_px):.3f} px",
        f"corners were seen to {_degrees(q.theta_max_observed)} from the axis; the lens is one-to-one to "
        f"{_degrees(lens.theta_max)}; the picture shows {_degrees(q.theta_max_picture)}",
    ]
    if result.solution.shape.any():
        lines.append(
            f"the board is bowed by {1000 * result.bow_m:.2f} mm and {100 * result.solution.shape[2]:+.3f} % longer "
            f"down than across (held out {result.flat_px:.3f} px without this, {result.shaped_px:.3f} with)"
        )
        if abs(result.bow_m) > 0.0005:
            lines.append("a bow of more than 0.5 mm: mount the board on something flat")
    lines += q.advice
    if q.refusals:
        lines += [f"not observable: {reason}" for reason in q.refusals]
    elif q.theta_max_observed < 0.9 * q.theta_max_picture:
        lines.append(f"verdict: to be believed up to {_degrees(q.theta_max_observed)}, extrapolated beyond")
    else:
        lines.append("verdict: to be believed over the whole picture")
    return lines


def _degrees(angle: float) -> str:
    return f"{np.rad2deg(angle):.1f}°"
