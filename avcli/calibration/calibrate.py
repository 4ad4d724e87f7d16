"""From the corners of many pictures to a lens that says how far it may be believed."""

from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import corners, fit, opencv, quality
from avcli.calibration.corners import View
from avcli.calibration.target import Board
from avcli.lens import KannalaBrandt

BOARD_GAIN = 0.02
"""The board's shape is fitted only where held-out views improve by at least this fraction."""


@dataclass(frozen=True)
class Calibration:
    """A calibrated lens.

    Attributes:
        board: the board.
        width, height: px, of the pictures.
        solution: the fit, of the kept views.
        observations: the kept views' corners.
        kept: (views,) bool, of the views that were given.
        view_rms_px: (views,) residual of each given view under the lens, kept or not.
        quality: what is known beyond the RMS.
        flat_px, shaped_px: held-out RMS without and with the board's shape; NaN where not tried.
    """

    board: Board
    width: int
    height: int
    solution: fit.Solution
    observations: fit.Observations
    kept: np.ndarray
    view_rms_px: np.ndarray
    quality: quality.Quality
    flat_px: float = float("nan")
    shaped_px: float = float("nan")

    @property
    def bow_m(self) -> float:
        """How far the board's middle stands out of the plane of its corners, m; 0 for a flat one."""
        return float(self.solution.shape[:2].sum())

    def camera_config(self) -> dict:
        """The calibration as the keys of config.json's camera_config."""
        lens, q = self.solution.lens, self.quality
        names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "k4")
        return {
            "lens_model": "kannala_brandt",
            **dict(zip(names, (float(v) for v in self.solution.parameters[: fit.LENS]), strict=True)),
            "image_width_px": self.width,
            "image_height_px": self.height,
            "theta_max_observed_deg": float(np.rad2deg(q.theta_max_observed)),
            "theta_max_valid_deg": float(np.rad2deg(lens.theta_max)),
            "calibration": {
                "rms_px": q.rms_px,
                "inlier_rms_px": q.inlier_rms_px,
                "held_out_rms_px": q.held_out_rms_px if np.isfinite(q.held_out_rms_px) else None,
                "field_sd_mean_px": _finite(np.nanmean(q.field_sd_px)),
                "field_sd_max_px": _finite(np.nanmax(q.field_sd_px)),
                "sd": {name: _finite(sd) for name, sd in zip(names, q.sd, strict=False)},
                "views_used": int(self.kept.sum()),
                "views_given": len(self.kept),
                "corners": len(self.observations.pixels),
                "board": str(self.board),
                "square_m": self.board.square_m,
                "board_shape_m": [float(v) for v in self.solution.shape],
            },
        }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def observe(board: Board, views: list[View]) -> fit.Observations:
    """Stack the corners of all views."""
    return fit.Observations(
        view=np.repeat(np.arange(len(views)), [len(view.ids) for view in views]),
        points=np.concatenate([board.points[view.ids] for view in views]),
        pixels=np.concatenate([view.pixels for view in views]),
        sigma=np.ones(sum(len(view.ids) for view in views)),
        half_extent=board.half_extent,
    )


def is_duplicate(view: View, others: list[View], motion_px: float = 1.0) -> bool:
    """Tell whether a board stood where it stood in one of the others: its corners moved less than `motion_px` (RMS)."""
    for other in others:
        if len(view.ids) != len(other.ids) or not np.array_equal(view.ids, other.ids):
            continue
        for pixels in (other.pixels, other.pixels[::-1]):  # a board may be read turned by 180 degrees
            if np.mean(((view.pixels - pixels) ** 2).sum(1)) < motion_px**2:
                return True
    return False


def calibrate(board: Board, views: list[View], *, board_shape: bool | None = None, polish: bool = True) -> Calibration:
    """Calibrate the lens that took the views.

    Args:
        board: what was filmed.
        views: at least one, all of one size, none a duplicate of another.
        board_shape: fit the board's bow and stretch; None lets held-out views decide.
        polish: refine the corners once more with the lens known, where held-out views become better by it.

    Raises:
        fit.NoFit: there are fewer equations than unknowns.
    """
    width, height = views[0].width, views[0].height
    everything = observe(board, views)
    solution, kept = fit.fit_robustly(everything, width, height)
    flat = quality.held_out_rms(everything.of_views(kept), solution)
    if polish:
        finer = polished(everything, solution, kept, board, views)
        better = fit.fit(finer.of_views(kept), solution)
        better, finer_kept = fit.refit_robustly(finer, better, kept)
        finer_flat = quality.held_out_rms(finer.of_views(finer_kept), better)
        if not finer_flat >= flat:  # a coarse or compressed picture may have no finer corners to give
            everything, solution, kept, flat = finer, better, finer_kept, finer_flat
    shaped = float("nan")
    if board_shape or (board_shape is None and kept.sum() >= 6):
        # From all views again: a flat board may have made good ones of a bowed board look bad.
        start = fit.fit(everything, _all_poses(everything, solution, kept), board_shape=True)
        bent, bent_kept = fit.refit_robustly(everything, start, np.ones(len(views), bool), board_shape=True)
        common = kept & bent_kept
        some = everything.of_views(common)
        flat = quality.held_out_rms(some, solution.of_views(common[kept]))
        shaped = quality.held_out_rms(some, bent.of_views(common[bent_kept]))
        if board_shape or shaped < (1 - BOARD_GAIN) * flat:
            solution, kept = bent, bent_kept
    held_out = shaped if solution.free[fit.LENS :].any() else flat
    return replace(judged(board, everything, solution, kept, width, height, held_out), flat_px=flat, shaped_px=shaped)


def calibrate_as_thesis(board: Board, views: list[View], limit_px: float = 0.75) -> Calibration:
    """Calibrate with OpenCV as the thesis did, and judge the result as any other.

    Raises:
        opencv.OpenCVRefused: OpenCV gives up, or no picture is left.
    """
    width, height = views[0].width, views[0].height
    everything = observe(board, views)
    solution, kept = opencv.thesis_procedure(everything, width, height, limit_px)
    held_out = quality.held_out_rms(everything.of_views(kept), solution)
    return judged(board, everything, solution, kept, width, height, held_out)


def judged(
    board: Board,
    everything: fit.Observations,
    solution: fit.Solution,
    kept: np.ndarray,
    width: int,
    height: int,
    held_out: float,
) -> Calibration:
    """Put a solution for the kept views together with what can be said of it."""
    some = everything.of_views(kept)
    return Calibration(
        board=board,
        width=width,
        height=height,
        solution=solution,
        observations=some,
        kept=kept,
        view_rms_px=rms_of_all(everything, solution, kept),
        quality=quality.assess(some, solution, width, height, held_out),
        flat_px=held_out,
    )


def rms_of_all(everything: fit.Observations, solution: fit.Solution, kept: np.ndarray) -> np.ndarray:
    """Residual of each view, (views,) px; of those that were not kept with the best pose under the lens."""
    rms = np.zeros(everything.views)
    rms[kept] = fit.view_rms(everything.of_views(kept), solution)
    if not kept.all():
        rest = everything.of_views(~kept)
        rms[~kept] = fit.view_rms(rest, _posed(rest, solution))
    return rms


def _posed(observations: fit.Observations, solution: fit.Solution) -> fit.Solution:
    start = fit.start_from_rays(observations, solution.lens, solution.shape)
    return fit.refine_poses(observations, replace(start, free=solution.free), 15)


def polished(
    everything: fit.Observations, solution: fit.Solution, kept: np.ndarray, board: Board, views: list[View]
) -> fit.Observations:
    """Refine all corners with the lens known (corners.polish) and weigh them by how well they could be placed."""
    poses = _all_poses(everything, solution, kept)
    to_board = _board_offsets(everything, poses, board.square_m)
    pixels, sd = corners.polish(
        np.concatenate([view.patches for view in views]),
        everything.pixels,
        np.concatenate([view.origins for view in views]),
        to_board,
        clear=0.11 if board.markers else 1.0,
    )
    good = np.isfinite(sd)
    if good.mean() < 0.5:
        return everything
    # What the noise in the picture does not explain (print, lens, blur) adds the same to every corner.
    typical = float(np.median(sd[good]))
    sigma = np.sqrt(typical**2 + np.where(good, sd, 10 * typical) ** 2) / (np.sqrt(2) * typical)
    return replace(everything, pixels=pixels, sigma=np.clip(sigma, 0.7, 10.0))


def _all_poses(everything: fit.Observations, solution: fit.Solution, kept: np.ndarray) -> fit.Solution:
    rotations = np.zeros((everything.views, 3, 3))
    translations = np.zeros((everything.views, 3))
    rotations[kept], translations[kept] = solution.rotations, solution.translations
    if not kept.all():
        rest = _posed(everything.of_views(~kept), solution)
        rotations[~kept], translations[~kept] = rest.rotations, rest.translations
    return replace(solution, rotations=rotations, translations=translations)


def _board_offsets(observations: fit.Observations, solution: fit.Solution, square: float) -> np.ndarray:
    """Around each corner, board offset in squares as a quadratic in the pixel offset: (n, 2, 5), see corners.polish."""
    o, reach = observations, 6.0
    a, b = (g.ravel() * reach for g in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
    pixels = o.pixels[:, None] + np.stack([a, b], -1)
    rays = solution.lens.unproject(pixels.reshape(-1, 2)).reshape(len(o.pixels), 9, 3)
    R, t = solution.rotations[o.view], solution.translations[o.view]
    height = fit.surface(o.points, solution.shape, o.half_extent)[:, 2]
    normal = R[:, :, 2]
    distance = np.einsum("ni,ni->n", normal, t) + height
    with np.errstate(invalid="ignore", divide="ignore"):
        along = distance[:, None] / np.einsum("nki,ni->nk", rays, normal)
        met = np.einsum("nki,nij->nkj", along[:, :, None] * rays - t[:, None], R)[:, :, :2] / square
    design = np.stack([np.ones(9), a, b, a * a, a * b, b * b], -1)
    offsets = np.einsum("tk,nkj->njt", np.linalg.pinv(design), np.nan_to_num(met))[:, :, 1:]
    return np.where(np.isfinite(met).all((1, 2))[:, None, None], offsets, 0.0)


def check(board: Board, views: list[View], lens: KannalaBrandt) -> dict:
    """Score a lens on views that had no part in its calibration: only the board's poses are fitted, corners polished.

    Returns:
        views, corners, rms_px (of all corners), median_px, worst_px (of a view) and theta_max_seen_deg.
    """
    everything = observe(board, views)
    start = fit.start_from_rays(everything, lens)
    solution = fit.refine_poses(everything, start, 20)
    everything = polished(everything, solution, np.ones(len(views), bool), board, views)
    solution = fit.refine_poses(everything, solution, 20)
    each = fit.view_rms(everything, solution)
    corners_of = np.bincount(everything.view)
    return {
        "views": len(views),
        "corners": len(everything.pixels),
        "rms_px": float(np.sqrt((each**2 * corners_of).sum() / corners_of.sum())),
        "median_px": float(np.median(each)),
        "worst_px": float(each.max()),
        "theta_max_seen_deg": float(np.rad2deg(np.nanmax(quality.seen_angles(lens, everything.pixels)))),
    }
