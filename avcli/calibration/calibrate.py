"""From pictures of a board to a lens, with how far it can be trusted."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import corners, fit, gather, opencv, quality
from avcli.calibration.circle import Circle
from avcli.calibration.corners import View
from avcli.calibration.settings import FitSettings
from avcli.calibration.target import Board
from avcli.formats.footage import Picture
from avcli.lens import LENSES, Lens, lens_config

BOARD_GAIN = 0.02
"""The board's shape is fitted only where held-out views improve by at least this fraction."""

DEFAULTS = FitSettings()


@dataclass(frozen=True)
class Calibration:
    """A calibrated lens.

    Attributes:
        board: the board.
        views: that were given, with the corners in them.
        solution: the fit, of the kept views.
        observations: the kept views' corners.
        kept: (views,) bool, which views the fit used.
        view_rms_px: (views,) residual of each given view under the lens, kept or not.
        quality: the uncertainty: standard deviations, held-out error, expected error over the picture, advice.
        flat_px, shaped_px: held-out RMS without and with the board's shape; NaN where not tried.
    """

    board: Board
    views: tuple[View, ...]
    solution: fit.Solution
    observations: fit.Observations
    kept: np.ndarray
    view_rms_px: np.ndarray
    quality: quality.Quality
    flat_px: float = float("nan")
    shaped_px: float = float("nan")

    @property
    def lens(self) -> Lens:
        """The lens."""
        return self.solution.lens

    @property
    def width(self) -> int:
        """Width of the pictures, px."""
        return self.views[0].width

    @property
    def height(self) -> int:
        """Height of the pictures, px."""
        return self.views[0].height

    @property
    def bow_m(self) -> float:
        """How far the board's middle stands out of the plane of its corners, m; 0 for a flat one."""
        return float(self.solution.shape[:2].sum())

    @property
    def covariance(self) -> np.ndarray:
        """(parameters, parameters) of the lens's parameters in the order of its keys."""
        return self.solution.covariance[: -fit.SHAPE, : -fit.SHAPE]

    @property
    def inflation(self) -> float:
        """How many times larger the lens's errors are than those of corners whose errors are all their own."""
        return fit.inflation(self.observations, self.solution)

    @property
    def verdict(self) -> str:
        """One sentence on how far the calibration can be trusted."""
        return self.quality.verdict

    def camera_config(self) -> dict:
        """Return the calibration as the keys of config.json's camera_config."""
        lens, q = self.lens, self.quality
        return {
            **lens_config(lens),
            "image_width_px": self.width,
            "image_height_px": self.height,
            "theta_max_observed_deg": float(np.rad2deg(q.theta_max_observed)),
            "theta_max_trusted_deg": float(np.rad2deg(q.theta_max_trusted)),
            "theta_max_valid_deg": float(np.rad2deg(lens.theta_max)),
            **({} if q.circle is None else {"image_circle_px": [q.circle.x, q.circle.y, q.circle.radius]}),
            "calibration": {
                "rms_px": q.rms_px,
                "inlier_rms_px": q.inlier_rms_px,
                "held_out_rms_px": q.held_out_rms_px if np.isfinite(q.held_out_rms_px) else None,
                "field_sd_mean_px": _finite(q.mean_sd_px),
                "field_sd_max_px": _finite(np.nanmax(q.field_sd_px, initial=0.0) if q.trusted.any() else np.inf),
                "split_half_ratio": _finite(q.halves.ratio),
                "split_half_px": _finite(q.halves.actual_px),
                "sd": {key: _finite(sd) for key, sd in zip(lens.keys(), q.sd, strict=False)},
                "covariance": self.covariance.tolist() if np.isfinite(self.covariance).all() else None,
                "inflation": _finite(self.inflation),
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


def calibrate(
    pictures: Iterable[Picture | np.ndarray],
    *,
    board: Board | tuple[int, int] = (6, 8),
    square_m: float = 0.095,
    settings: FitSettings = DEFAULTS,
    say: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Find a camera's lens from pictures of a printed board that was held in many places.

    >>> from avcli.formats import footage
    >>> found = calibrate(footage.pictures(["boards"]), board=(6, 8), square_m=0.095)
    >>> print(f"{found.lens.fx:.0f} px, {int(found.kept.sum())} views, {found.quality.rms_px:.2f} px RMS")
    431 px, 8 views, 0.01 px RMS
    >>> found.verdict
    'trust this calibration up to 61.9° from the axis; beyond that it is extrapolated'

    Args:
        pictures: of one size; arrays (height, width[, 3 RGB or 4 RGBA]), or what `footage.pictures` reads. Pictures
            without the board are skipped.
        board: squares as printed, along a row and along a column; or a Board, which may have markers.
        square_m: side of a square, m, where `board` is a pair of counts.
        settings: how the lens is fitted, and which model: FitSettings(lens_model="brown_conrady").
        say: gets sentences for the user, such as that the board has another size.

    Returns:
        The calibration. Check `verdict` and `quality.refusals` before you use its lens.

    Raises:
        fit.NoFit: no picture shows the board, or the corners determine no lens.
        ValueError: the pictures differ in size.
    """
    if not isinstance(board, Board):
        board = Board(*board, square_m)
    seen = gather.collect(pictures, board, say=say)
    seen.require_views()
    return calibrate_views(seen.board, seen.views, settings, seen.light.circle)


def calibrate_views(
    board: Board, views: list[View], settings: FitSettings = DEFAULTS, circle: Circle | None = None
) -> Calibration:
    """Calibrate the lens that took the views.

    Args:
        board: what was filmed.
        views: at least one, all of one size, none a duplicate of another.
        settings: the procedure, and what it needs.
        circle: where light reaches the pictures; None: everywhere.

    Raises:
        fit.NoFit: there are fewer equations than unknowns, or OpenCV gives up.
        ValueError: the lens model is unknown.
    """
    if settings.lens_model not in LENSES:
        raise ValueError(f"unknown lens model {settings.lens_model!r}; known are {', '.join(LENSES)}")
    if settings.procedure == "thesis":
        everything = observe(board, views)
        solution, kept = opencv.thesis_procedure(everything, views[0].width, views[0].height, settings.max_rms_px)
        return judged(board, views, everything, solution, kept, circle=circle)
    return _calibrate_robustly(board, views, settings, circle)


def _calibrate_robustly(
    board: Board, views: list[View], settings: FitSettings, circle: Circle | None = None
) -> Calibration:
    everything = observe(board, views)
    solution, kept = fit.fit_robustly(everything, views[0].width, views[0].height, model=settings.lens_model)
    flat = quality.held_out_rms(everything.of_views(kept), solution)
    finer = polished(everything, solution, kept, board, views)
    better = fit.fit(finer.of_views(kept), solution)
    better, finer_kept = fit.refit_robustly(finer, better, kept)
    finer_flat = quality.held_out_rms(finer.of_views(finer_kept), better)
    if not finer_flat >= flat:  # a coarse or compressed picture may have no finer corners to give
        everything, solution, kept, flat = finer, better, finer_kept, finer_flat
    shaped = float("nan")
    if settings.board_shape == "yes" or (settings.board_shape == "auto" and kept.sum() >= 6):
        # From all views again: a flat board may have made good ones of a bowed board look bad.
        start = fit.fit(everything, _all_poses(everything, solution, kept), board_shape=True)
        bent, bent_kept = fit.refit_robustly(everything, start, np.ones(len(views), bool), board_shape=True)
        common = kept & bent_kept
        some = everything.of_views(common)
        flat = quality.held_out_rms(some, solution.of_views(common[kept]))
        shaped = quality.held_out_rms(some, bent.of_views(common[bent_kept]))
        if settings.board_shape == "yes" or shaped < (1 - BOARD_GAIN) * flat:
            solution, kept = bent, bent_kept
    held_out = shaped if solution.free[-fit.SHAPE :].any() else flat
    found = judged(board, views, everything, solution, kept, held_out, circle)
    return replace(found, flat_px=flat, shaped_px=shaped)


def observe(board: Board, views: list[View]) -> fit.Observations:
    """Stack the corners of all views."""
    return fit.Observations(
        view=np.repeat(np.arange(len(views)), [len(view.ids) for view in views]),
        points=np.concatenate([board.points[view.ids] for view in views]),
        pixels=np.concatenate([view.pixels for view in views]),
        sigma=np.ones(sum(len(view.ids) for view in views)),
        half_extent=board.half_extent,
    )


def judged(
    board: Board,
    views: list[View],
    everything: fit.Observations,
    solution: fit.Solution,
    kept: np.ndarray,
    held_out: float | None = None,
    circle: Circle | None = None,
) -> Calibration:
    """Put a solution for the kept views together with its uncertainty.

    Args:
        board, views: what was given.
        everything: the corners of all views.
        solution: the fit of the kept views.
        kept: (views,) bool.
        held_out: px, the held-out RMS; None computes it.
        circle: where light reaches the pictures; None: everywhere.
    """
    some = everything.of_views(kept)
    if held_out is None:
        held_out = quality.held_out_rms(some, solution)
    return Calibration(
        board=board,
        views=tuple(views),
        solution=solution,
        observations=some,
        kept=kept,
        view_rms_px=rms_of_all(everything, solution, kept),
        quality=quality.assess(some, solution, views[0].width, views[0].height, held_out, circle),
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
    unit, near = board.clear
    to_board = _board_offsets(everything, poses, unit)
    pixels, sd = corners.polish(
        np.concatenate([view.patches for view in views]),
        everything.pixels,
        np.concatenate([view.origins for view in views]),
        to_board,
        clear=near,
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


def check(board: Board, views: list[View], lens: Lens) -> dict:
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
