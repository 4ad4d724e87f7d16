"""How far a calibration can be trusted: held-out error, uncertainty over the picture, coverage, and a verdict."""

from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import fit
from avcli.lens import Lens

FIELD_SD_LIMIT_PX = 1.0
"""Mean standard deviation over the picture beyond which a lens counts as not observed."""
FOCAL_SD_LIMIT = 0.01
"""Standard deviation of the focal length, as a fraction of it, beyond which a lens counts as not observed."""
LEAST_VIEWS = 4
LEAST_SEEN = 0.5
"""Fraction of the angle that the picture shows to which corners must reach: no lens follows a polynomial further."""


def field_sd(solution: fit.Solution, width: int, height: int, step: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Expected error of the projection over the picture, a turn of the camera as a whole not counted.

    Returns:
        pixels (rows, columns, 2), and the standard deviation there in px (rows, columns): the root of the summed
        variances of u and v; NaN where the lens images nothing.
    """
    return _field_sd(solution.lens, solution.covariance[: -fit.SHAPE, : -fit.SHAPE], width, height, step)


def _field_sd(lens: Lens, covariance: np.ndarray, width: int, height: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    u = np.linspace(0, width - 1, max(2, round(width / step)))
    v = np.linspace(0, height - 1, max(2, round(height / step)))
    grid = np.stack(np.meshgrid(u, v), -1)
    pixels = grid.reshape(-1, 2)
    rays = lens.unproject(pixels)
    # At the very edge of the lens the inverse is not differentiable.
    seen = np.isfinite(rays).all(1) & (
        np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) < 0.995 * lens.theta_max
    )
    out = np.full(len(pixels), np.nan)
    if not seen.any() or not np.isfinite(covariance).all():
        out[seen] = np.inf
        return grid, out.reshape(grid.shape[:2])
    _, by_point, by_lens = lens.project_jacobian(rays[seen])
    turn = -by_point @ fit.cross_matrix(rays[seen])
    Q = np.linalg.qr(turn.reshape(-1, 3))[0]
    J = by_lens.reshape(-1, by_lens.shape[-1])
    J = (J - Q @ (Q.T @ J)).reshape(by_lens.shape)
    out[seen] = np.sqrt(np.maximum(np.einsum("nia,ab,nib->n", J, covariance, J), 0))
    return grid, out.reshape(grid.shape[:2])


def split_half(
    observations: fit.Observations, solution: fit.Solution, width: int, height: int, step: int = 40
) -> tuple[np.ndarray, np.ndarray]:
    """Where two lenses, each from every other view, put the same rays: what the model misses shows here too.

    Args:
        observations, solution: of the views that were kept.
        width, height: px, of the pictures.
        step: px between the points of the grid.

    Returns:
        pixels (rows, columns, 2), and the distance there in px (rows, columns) after the turn of the camera that suits
        best; NaN where either lens images nothing, and everywhere with fewer than six views.
    """
    u = np.linspace(0, width - 1, max(2, round(width / step)))
    v = np.linspace(0, height - 1, max(2, round(height / step)))
    grid = np.stack(np.meshgrid(u, v), -1)
    apart = np.full(grid.shape[:2], np.nan)
    if observations.views < 6:
        return grid, apart
    halves = []
    for odd in (0, 1):
        some = np.arange(observations.views) % 2 == odd
        start = solution.of_views(some)
        halves.append(fit.refine(observations.of_views(some), start, solution.free, solution.delta_px, 25).lens)
    one, other = halves
    rays = one.unproject(grid.reshape(-1, 2))
    seen = np.isfinite(rays).all(1)
    pixels, rays = grid.reshape(-1, 2)[seen], rays[seen]
    for _ in range(4):
        projected, by_point, _ = other.project_jacobian(rays)
        good = np.isfinite(projected).all(1) & np.isfinite(by_point).all((1, 2))
        by_turn = -by_point[good] @ fit.cross_matrix(rays[good])
        # Robust (Cauchy), so that a corner of the picture that no board reached does not turn the rest.
        off = (pixels - projected)[good]
        weight = 1 / (1 + (off**2).sum(1) / max(float(np.median((off**2).sum(1))), 1e-12))
        root = np.sqrt(weight)[:, None]
        turn = np.linalg.lstsq((by_turn * root[..., None]).reshape(-1, 3), (off * root).ravel(), rcond=None)[0]
        rays = rays @ fit.rotation_from_vector(turn[None])[0].T
    apart[seen.reshape(apart.shape)] = np.linalg.norm(pixels - other.project(rays), axis=1)
    return grid, apart


def seen_angles(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Angle from the optical axis of each pixel (n, 2), (n,) rad; NaN where the lens images nothing."""
    rays = lens.unproject(pixels)
    return np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])


def coverage(pixels: np.ndarray, width: int, height: int, columns: int = 8) -> np.ndarray:
    """How many corners (n, 2) px fall into each cell of a grid over the picture: (rows, columns) counts."""
    rows = max(2, round(columns * height / width))
    x = np.clip((pixels[:, 0] + 0.5) / width * columns, 0, columns - 1e-9).astype(int)
    y = np.clip((pixels[:, 1] + 0.5) / height * rows, 0, rows - 1e-9).astype(int)
    counts = np.zeros((rows, columns), int)
    np.add.at(counts, (y, x), 1)
    return counts


@dataclass(frozen=True)
class Quality:
    """What is known of a calibration beyond its RMS.

    Attributes:
        rms_px: over the corners of the kept views, as OpenCV counts: root of the mean of dx² + dy².
        inlier_rms_px: the same without corners beyond the robust fit's limit.
        held_out_rms_px: see robust.held_out; NaN where there are too few views.
        sd: (P,) standard deviations of fit.Solution.parameters: fx fy cx cy px, the lens's coefficients, b0 b1 m, b2.
        field_pixels, field_sd_px: see `field_sd`.
        counts: see `coverage`.
        theta_max_observed, theta_max_valid, theta_max_picture: rad; the largest angle at which a corner was seen, at
            which the lens stays one-to-one, and which the picture shows.
        tilt: rad, spread (RMS) of the boards' normals about their mean.
        refusals: sentences that say why the lens is not observable; empty where it is.
        advice: sentences that say what to film next.
    """

    rms_px: float
    inlier_rms_px: float
    held_out_rms_px: float
    sd: np.ndarray
    field_pixels: np.ndarray
    field_sd_px: np.ndarray
    counts: np.ndarray
    theta_max_observed: float
    theta_max_valid: float
    theta_max_picture: float
    tilt: float
    refusals: tuple[str, ...]
    advice: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """How far the calibration can be trusted, in words."""
        if self.refusals:
            return f"do not use this calibration: {'; '.join(self.refusals)}"
        if self.theta_max_observed < 0.9 * self.theta_max_picture:
            angle = np.rad2deg(self.theta_max_observed)
            return f"trust this calibration up to {angle:.1f}° from the axis; beyond that it is extrapolated"
        return "trust this calibration over the whole picture"


def assess(observations: fit.Observations, solution: fit.Solution, width: int, height: int, held_out: float) -> Quality:
    """Judge a fit by its covariance and by where its boards were, not by its RMS, which is small for bad sets too.

    Args:
        observations, solution: of the kept views.
        width, height: px, of the pictures.
        held_out: px, the held-out RMS.
    """
    lens = solution.lens
    error = np.linalg.norm(fit.residuals(observations, solution), axis=1)
    inlier = error <= solution.delta_px * observations.sigma
    grid, sd_px = field_sd(solution, width, height)
    angles = seen_angles(lens, observations.pixels)
    observed = float(np.nanmax(angles)) if np.isfinite(angles).any() else 0.0
    rim = seen_angles(lens, _border(width, height))
    shown = lens.theta_max if np.isnan(rim).any() else float(rim.max())
    normals = solution.rotations[:, :, 2]
    centre = normals.sum(0) / max(np.linalg.norm(normals.sum(0)), 1e-12)
    tilt = float(np.sqrt(np.mean(np.arccos(np.clip(normals @ centre, -1, 1)) ** 2)))
    quality = Quality(
        rms_px=_rms(error),
        inlier_rms_px=_rms(error[inlier]),
        held_out_rms_px=held_out,
        sd=np.sqrt(np.maximum(np.diag(solution.covariance), 0)),
        field_pixels=grid,
        field_sd_px=sd_px,
        counts=coverage(observations.pixels, width, height),
        theta_max_observed=observed,
        theta_max_valid=lens.theta_max,
        theta_max_picture=shown,
        tilt=tilt,
        refusals=(),
        advice=(),
    )
    refusals = _refusals(quality, observations, solution)
    return replace(quality, refusals=refusals, advice=_advice(quality, refusals))


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.nan_to_num(error, nan=100.0) ** 2))) if len(error) else float("nan")


def _border(width: int, height: int) -> np.ndarray:
    """Corners of the picture, (4, 2) px."""
    return np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)


def _refusals(q: Quality, observations: fit.Observations, solution: fit.Solution) -> tuple[str, ...]:
    reasons = []
    fx, fy = solution.parameters[:2]
    if observations.views < LEAST_VIEWS:
        reasons.append(
            f"{observations.views} different view{'s' if observations.views != 1 else ''} of the board cannot "
            f"determine a lens: film at least {LEAST_VIEWS}, better 20, from different sides"
        )
    relative = max(q.sd[0] / fx, q.sd[1] / fy)
    if not relative <= FOCAL_SD_LIMIT:
        shown = f"± {100 * relative:.1f} %" if relative < 10 else "not known at all"
        reasons.append(
            f"the focal length is too uncertain ({shown}; the tilt of the boards varies by {np.rad2deg(q.tilt):.0f}°): "
            "tilt the board by 30 to 50° in all directions"
        )
    mean = float(np.nanmean(q.field_sd_px))
    seen, reach = np.rad2deg(q.theta_max_observed), np.rad2deg(q.theta_max_picture)
    unseen = f"no corner was seen beyond {seen:.0f}° from the axis, but the picture reaches {reach:.0f}°"
    if not mean <= FIELD_SD_LIMIT_PX:
        size = f"{mean:.1f} px" if mean < 1000 else "more than 1000 px"
        where = unseen if seen < 0.8 * reach else "the views of the board are too few or too similar"
        reasons.append(f"the expected error over the picture is {size}: {where}; film the board {_places(q)}")
    elif seen < LEAST_SEEN * reach:
        reasons.append(f"{unseen}; film the board {_places(q)}")
    if not q.rms_px <= 0.005 * np.hypot(*solution.parameters[2:4]) + 2.0:
        reasons.append(f"the fit failed: the corners are {q.rms_px:.1f} px (RMS) from where this lens projects them")
    return tuple(reasons)


def _advice(q: Quality, refusals: tuple[str, ...]) -> tuple[str, ...]:
    advice = []
    if q.theta_max_observed < 0.9 * q.theta_max_picture:
        advice.append(
            f"no corner was seen beyond {np.rad2deg(q.theta_max_observed):.0f}° from the axis, but the picture reaches "
            f"{np.rad2deg(q.theta_max_picture):.0f}°: film the board near the corners of the picture"
        )
    empty = float((q.counts == 0).mean())
    if empty > 0.2:
        advice.append(f"no corner was seen in {100 * empty:.0f} % of the picture: film the board {_places(q)}")
    if q.tilt < np.deg2rad(15):
        advice.append(f"the tilt of the boards varies by only {np.rad2deg(q.tilt):.0f}°: tilt the board more")
    if np.isfinite(q.held_out_rms_px) and q.held_out_rms_px > 1.2 * q.rms_px + 0.02:
        advice.append(
            f"the residual of pictures held out of the fit is {q.held_out_rms_px / q.rms_px:.1f} times as large: take "
            "more pictures"
        )
    return () if refusals and not advice else tuple(advice)


def _places(q: Quality) -> str:
    """Name the parts of the picture where corners are missing, in words."""
    rows, columns = q.counts.shape
    names = []
    for label, ys in (("top", slice(0, rows // 3 or 1)), ("bottom", slice(rows - (rows // 3 or 1), rows))):
        for side, xs in (("left", slice(0, columns // 3)), ("right", slice(columns - columns // 3, columns))):
            if (q.counts[ys, xs] == 0).mean() > 0.34:
                names.append(f"{label} {side}")
    if len(names) == 4 or not names:
        return "near the corners of the picture" if names else "closer, larger and more tilted"
    return f"at the {', the '.join(names[:-1])} and the {names[-1]}" if len(names) > 1 else f"at the {names[0]}"


def next_view(q: Quality) -> str:
    """Say where to hold the board next: where the projection is known worst."""
    rows = np.array_split(np.arange(q.field_sd_px.shape[0]), 3)
    columns = np.array_split(np.arange(q.field_sd_px.shape[1]), 3)
    names = [["top left", "top", "top right"], ["left", "middle", "right"], ["bottom left", "bottom", "bottom right"]]
    worst, place = -1.0, "middle"
    for i, ys in enumerate(rows):
        for j, xs in enumerate(columns):
            part = q.field_sd_px[np.ix_(ys, xs)]
            if np.isfinite(part).any() and np.nanmean(part) > worst:
                worst, place = float(np.nanmean(part)), names[i][j]
    lean = ", tilted" if q.tilt < np.deg2rad(25) else ""
    return f"hold the board at the {place}{lean} (expected error there {worst:.2f} px)"
