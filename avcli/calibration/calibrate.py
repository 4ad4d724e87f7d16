"""From pictures of a board to a lens, with how far it can be trusted."""

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avcli.calibration import choose, fit, gather, opencv, place, quality, robust, sharpness, shutter
from avcli.calibration.circle import Circle
from avcli.calibration.corners import View
from avcli.calibration.pupil import from_pupil
from avcli.calibration.recognise import Wanted
from avcli.calibration.settings import FitSettings
from avcli.calibration.target import Board
from avcli.formats.footage import Picture
from avcli.lens import Lens, lens_config, variants

BOARD_GAIN = 0.02
"""The board's shape and its corners' errors are fitted only where held-out views improve by at least this fraction."""

_WORTH_A_TEST = 1 - BOARD_GAIN / 2
"""What the shape or the errors promise (robust.foretold) at least, or they are not fitted and tested. On derlunz, dyf
and fish_1 a promise of more than 2 % was off by at most 0.06, one of less by 0.03 to the worse."""

LEAST_FOR_ERRORS = 8
"""Views from which the board's errors are looked for."""

_LEAST_CORNERS = 6
_LOST = 0.02
"""Share of the corners that another lens model may leave out beyond those of the first, or it is no better."""
DEFAULTS = FitSettings()


@dataclass(frozen=True)
class Calibration:
    """A calibrated lens.

    Attributes:
        board: the board.
        views: that were given, with the corners in them.
        solution: the fit, of the kept views.
        observations: the corners that the fit used, of the kept views.
        kept: (views,) bool, which views the fit used: those of which at least half of the corners fit.
        dropped: (views,) how many corners of each view the fit did not use.
        view_rms_px: (views,) residual of each given view under the lens: of the corners that the fit used, and of all
            corners where the view was not kept.
        quality: the uncertainty: standard deviations, held-out error, expected error over the picture, advice.
        shutter: what a rolling shutter explains.
        held_out: the error on views that took no part, of every corner of every view.
        flat_px, shaped_px: held-out RMS without and with the board's shape; NaN where not tried, and `shaped_px` only
            foretold (robust.foretold) where that is no better.
        printed_px: held-out RMS with the board's errors (robust.with_board_errors); NaN or foretold likewise.
        tried: the lens models that were tried, the best first; empty where the model was given.
    """

    board: Board
    views: tuple[View, ...]
    solution: fit.Solution
    observations: fit.Observations
    kept: np.ndarray
    dropped: np.ndarray
    view_rms_px: np.ndarray
    quality: quality.Quality
    shutter: shutter.Shutter
    held_out: robust.HeldOut
    flat_px: float = float("nan")
    shaped_px: float = float("nan")
    printed_px: float = float("nan")
    tried: tuple[choose.Tried, ...] = ()

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
    def near_m(self) -> float:
        """Distance, m, within which a point at the largest angle seen is farther off than quality.TRUST_LIMIT.

        The lens as config.json has it has one centre. If it moves, that is right for what is far.
        """
        theta = self.quality.theta_max_observed
        return abs(self.solution.pupil) * theta**2 * float(np.sin(min(theta, np.pi / 2))) / quality.TRUST_LIMIT

    @property
    def bow_m(self) -> float:
        """How far the board's middle stands out of the plane of its corners, m; 0 for a flat one."""
        return float(self.solution.shape[:2].sum())

    def _board_config(self) -> dict:
        """What is known of the board; a length only where the print was measured."""
        board, shape = self.board, [float(v) for v in self.solution.shape]
        known: dict = {"square_m": board.square_m, "board_shape_m": shape} if board.scaled else {"square_m": None}
        if board.scaled and self.solution.free[-1]:
            known |= {"pupil_m": self.solution.pupil, "pupil_sd_m": _finite(self.quality.sd[-1])}
        if board.kind != "checkerboard":
            known |= {"board_kind": board.kind, "board_ratio": board.ratio}
        if board.markers:
            known["board_dictionary"] = board.dictionary
        return known

    @property
    def covariance(self) -> np.ndarray:
        """(parameters, parameters) of the lens's parameters in the order of its keys."""
        return self.solution.covariance[: -fit.BESIDE, : -fit.BESIDE]

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
                "missed": _finite(q.missed),
                "sd": {key: _finite(sd) for key, sd in zip(lens.keys(), q.sd, strict=False)},
                "covariance": self.covariance.tolist() if np.isfinite(self.covariance).all() else None,
                "inflation": _finite(q.inflation),
                "held_out_all_px": _finite(self.held_out.all_px),
                "views_used": int(self.kept.sum()),
                "views_given": len(self.kept),
                "corners": len(self.observations.pixels),
                "smear_median_px": _finite(sharpness.median_smear(self.views)),
                "rolling_shutter_ratio": _finite(self.shutter.ratio),
                "readout_motion_px": _finite(self.shutter.typical_px),
                "corners_dropped": int(self.dropped[self.kept].sum()),
                **({"tried_rms_px": {one.name: one.held_out_px for one in self.tried}} if self.tried else {}),
                "board": str(self.board),
                "board_errors_squares": float(np.sqrt((self.observations.errors**2).sum(1).mean()))
                / self.board.square_m,
                **self._board_config(),
            },
        }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def calibrate(
    pictures: Iterable[Picture | np.ndarray],
    *,
    board: Board | Wanted | tuple[int, int] | None = None,
    square_m: float | None = None,
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
        board: a Board; a pair of counts, the squares of a checkerboard as printed along a row and along a column; or
            what is known of it. The rest is recognised in the pictures.
        square_m: side of a square, m, where `board` does not say it; None: not measured, so that no length is stated.
        settings: how the lens is fitted, and which model: FitSettings(lens_model="brown_conrady").
        say: gets sentences for the user, such as that the board has another size.

    Returns:
        The calibration. Check `verdict` and `quality.refusals` before you use its lens.

    Raises:
        fit.NoFit: no picture shows the board, or the corners determine no lens.
        ValueError: the pictures differ in size.
    """
    if isinstance(board, tuple):
        board = Wanted(board, "checkerboard", square_m=square_m).board()
    seen = gather.collect(pictures, board or Wanted(square_m=square_m), say=say)
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
    if settings.lens_model not in (*variants(), choose.AUTO, None):
        raise ValueError(
            f"unknown lens model {settings.lens_model!r}; known are {', '.join(variants())}, {choose.AUTO}"
        )
    if not board.ratio_known:
        some = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(12, len(views))).astype(int))]
        size = views[0].width, views[0].height
        board = _spaced(board, lambda board: observe(board, some), size, choose.first(settings.lens_model))
    if settings.procedure == "thesis":
        everything = observe(board, views)
        solution, kept = opencv.thesis_procedure(everything, views[0].width, views[0].height, settings.max_rms_px)
        return judged(board, views, everything, solution, kept[everything.view], circle=circle)
    found = _calibrate_robustly(board, views, settings, circle)
    if settings.lens_model is None and (found.quality.missed > choose.DOUBT or _rim_lost(found) > choose.RIM_LOST):
        return _others_tried(found, board, views, settings, circle)
    return found


def _rim_lost(found: Calibration) -> float:
    """Which share of the outer tenth of the corners does not fit: a lens model may fail at the rim of its picture."""
    away = np.linalg.norm(
        np.concatenate([view.pixels for view in found.views]) - found.solution.parameters[2:4], axis=1
    )
    return float((~found.held_out.good[away >= np.quantile(away, 0.9)]).mean())


def _others_tried(
    found: Calibration, board: Board, views: list[View], settings: FitSettings, circle: Circle | None
) -> Calibration:
    """The calibration `found`, or that with the model of choose.NEXT which held-out views tell to be better."""
    known = {choose.START: found}
    for name in choose.NEXT:
        if choose.can_be(name, found.quality.theta_max_observed):
            with contextlib.suppress(fit.NoFit, np.linalg.LinAlgError), np.errstate(all="ignore"):  # it may go astray
                other = _calibrate_robustly(board, views, replace(settings, lens_model=name), circle)
                kept, before = (int(one.held_out.good.sum()) for one in (other, found))
                same = choose.keeps_axis(found.lens, other.lens)
                if same and np.isfinite(other.held_out.all_px) and kept >= (1 - _LOST) * before:
                    known[name] = other
    if len(known) == 1:
        return found
    view = np.repeat(np.arange(len(views)), [len(view.ids) for view in views])
    everywhere = np.all([one.held_out.good for one in known.values()], axis=0)
    tried = choose.compared({name: one.held_out for name, one in known.items()}, view, everywhere)
    return replace(known[choose.simplest(tried)], tried=tried)


@dataclass(frozen=True)
class _Fitted:
    """Where the fit stands: the corners of all views, the solution for those in `good`, its error on views held out."""

    everything: fit.Observations
    solution: fit.Solution
    good: np.ndarray
    held_out: robust.HeldOut

    @cached_property
    def plain(self) -> float:
        """What robust.foretold says of no change."""
        return robust.foretold(self.everything, self.solution, self.good)

    def bent(self, *, certainly: bool = False) -> tuple["_Fitted", float, float]:
        """Let the board bend, if held-out views improve (BOARD_GAIN), or `certainly`.

        Returns:
            what stands then; and the held-out RMS without and with it, px, the latter only foretold where that is no
            better.
        """
        promised = robust.foretold(self.everything, self.solution, self.good, board_shape=True) / self.plain
        before = self.held_out.rms_px
        if not certainly and not promised < _WORTH_A_TEST:
            return self, before, promised * before
        # From all corners again: a flat board may have made good ones of a bowed board look bad.
        everywhere = robust.posed(self.everything, self.solution, self.good)
        start = fit.fit(self.everything, everywhere, board_shape=True, roughly=True)
        every = np.ones(len(self.good), bool)
        solution, good = robust.refit_robustly(self.everything, start, every, board_shape=True)
        found = _Fitted(self.everything, solution, good, robust.held_out(self.everything, solution, good))
        before, after = self.held_out.of(self.good & good), found.held_out.of(self.good & good)
        return (found if certainly or after < (1 - BOARD_GAIN) * before else self), before, after


def _calibrate_robustly(board: Board, views: list[View], settings: FitSettings, circle: Circle | None) -> Calibration:
    coarse = observe(board, views)
    size = views[0].width, views[0].height
    solution, good = robust.fit_robustly(coarse, *size, roughly=True, model=choose.first(settings.lens_model))
    everything, solution, good = robust.refined(coarse, solution, good, board, views)
    found = _Fitted(everything, solution, good, robust.held_out(everything, solution, good))
    flat_px, shaped_px = found.held_out.rms_px, float("nan")
    printed_px = float("nan")
    if settings.board_shape == "yes" or (settings.board_shape == "auto" and everything.views_of(good).sum() >= 6):
        found, flat_px, shaped_px = found.bent(certainly=settings.board_shape == "yes")
    solution, good, chosen = found.solution, found.good, found.held_out
    board_errors = False
    if settings.board_shape == "auto" and everything.views_of(good).sum() >= LEAST_FOR_ERRORS:
        promised = robust.foretold(everything, solution, good, board_errors=True) / found.plain
        printed_px = promised * chosen.rms_px
        if promised < _WORTH_A_TEST:
            printed = robust.held_out(everything, solution, good, board_errors=True)
            printed_px = printed.rms_px
            if printed_px < (1 - BOARD_GAIN) * chosen.rms_px:
                chosen, board_errors = printed, True
    tried: tuple[choose.Tried, ...] = ()
    if settings.lens_model == choose.AUTO:
        solution, chosen, tried = choose.choose(everything, solution, good, chosen, *size, board_errors=board_errors)
    if board_errors:
        everything, solution, good = robust.fit_board(everything, solution, good)
        chosen = replace(chosen, good=good)
        printed_px = chosen.rms_px
    return replace(
        judged(board, views, everything, solution, good, chosen, circle, print_tested=np.isfinite(printed_px)),
        flat_px=flat_px,
        shaped_px=shaped_px,
        printed_px=printed_px,
        tried=tried,
    )


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
    good: np.ndarray,
    held_out: robust.HeldOut | None = None,
    circle: Circle | None = None,
    *,
    print_tested: bool = False,
) -> Calibration:
    """Put a solution together with its uncertainty.

    Args:
        board, views: what was given.
        everything: the corners of all views.
        solution: the fit to the corners in `good`.
        good: (n,) bool.
        held_out: None computes it.
        circle: where light reaches the pictures; None: everywhere.
        print_tested: whether the print's own errors were looked for. If not, they would pass for a rolling shutter.
    """
    some = everything.of_corners(good)
    held_out = held_out or robust.held_out(everything, solution, good)
    kept = everything.views_of(good)
    everywhere = robust.posed(everything, solution, good)
    rms = fit.view_rms(everything, everywhere)
    rms[kept] = fit.view_rms(some, solution)
    measured = shutter.measure(some, solution, views[0].height) if print_tested else shutter.unknown(some.views)
    judgement = quality.assess(some, solution, views[0].width, views[0].height, held_out.rms_px, circle)
    moving = sharpness.refusals(views) + shutter.refusals(measured)
    return Calibration(
        board=board,
        views=tuple(views),
        solution=solution,
        observations=some,
        kept=kept,
        dropped=everything.per_view((~good).astype(int)),
        view_rms_px=rms,
        quality=replace(judgement, refusals=judgement.refusals + moving),
        shutter=measured,
        held_out=held_out,
        flat_px=held_out.rms_px,
    )


def check(board: Board, views: list[View], lens: Lens, theta_trusted: float = np.inf, pupil_m: float = 0.0) -> dict:
    """Score a lens on views that had no part in its calibration: only the board's poses are fitted, corners polished.

    Args:
        board, views: what was filmed.
        lens: to be scored.
        theta_trusted: rad; corners farther from the axis do not count, and their number is stated.
        pupil_m: how the lens's centre moves, see fit.Solution; as if it did not where the board's size is not known.

    Returns:
        views, corners, corners_beyond (where theta_trusted is stated), rms_px (of all corners up to there), median_px,
        worst_px (of a view), off_deg (of those corners, as an angle) and theta_max_seen_deg.

    Raises:
        fit.NoFit: no view has enough corners up to there.
    """
    everything = observe(board, views)
    beside = np.append(np.zeros(fit.SHAPE), pupil_m if board.scaled else 0.0)
    start = fit.start_from_rays(everything, lens, beside)
    solution = fit.refine_poses(everything, start, 20)
    everything = robust.polished(everything, solution, board, views)
    theta = quality.seen_angles(lens, everything.pixels)
    known = ~(theta > theta_trusted)
    if not known.all():
        enough = everything.per_view(known.astype(int)) >= _LEAST_CORNERS
        if not enough.any():
            raise fit.NoFit(
                f"no picture has {_LEAST_CORNERS} corners within the {np.rad2deg(theta_trusted):.1f} degrees from the "
                "axis up to which the lens is known"
            )
        everything, solution = everything.of_corners(known & enough[everything.view]), solution.of_views(enough)
    solution = fit.refine_poses(everything, solution, 20)
    each = fit.view_rms(everything, solution)
    corners_of = np.bincount(everything.view)
    return {
        "views": everything.views,
        "corners": len(everything.pixels),
        **({} if np.isinf(theta_trusted) else {"corners_beyond": int((~known).sum())}),
        "rms_px": float(np.sqrt((each**2 * corners_of).sum() / corners_of.sum())),
        "median_px": float(np.median(each)),
        "worst_px": float(each.max()),
        "off_deg": float(
            np.rad2deg(place.off_angle(lens.unproject(everything.pixels), _in_camera(everything, solution)))
        ),
        "theta_max_seen_deg": float(np.rad2deg(np.nanmax(theta))),
    }


def _in_camera(observations: fit.Observations, solution: fit.Solution) -> np.ndarray:
    """Where the corners are from the centre that they are seen from, in the camera's frame, (n, 3) m."""
    R, t = solution.rotations[observations.view], solution.translations[observations.view]
    board = fit.surface(observations.points, solution.shape, observations.half_extent)
    return from_pupil(np.einsum("nij,nj->ni", R, board) + t, solution.pupil)[0]


_STEPS = (0.04, 0.015, 0.005, 0.002)
"""Ratios that are compared with the one in hand, above and below it."""


def _spaced(board: Board, observe: Callable[[Board], fit.Observations], size: tuple[int, int], model: str) -> Board:
    """Return an AprilGrid with the ratio of the space between its tags that explains the corners best.

    A wrong ratio shifts every other corner, which no lens and no pose can imitate. So the lens is fitted with the ratio
    in hand, then the ratio with that lens (the minimum of a parabola through three ratios), and so on.

    Args:
        board: an AprilGrid whose ratio is roughly known.
        observe: the corners of some views, a dozen is enough, as those of a board with this ratio.
        size: width and height of the pictures, px.
        model: of the lens, a name in avcli.lens.LENSES.

    Raises:
        fit.NoFit: there are fewer equations than unknowns.
    """
    solution: fit.Solution | None = None
    for step in _STEPS:
        seen = observe(board)
        if solution is None:
            solution = fit.scan_focal(seen, *size, model)
        solution = fit.fit(seen, solution)
        below, here, above = (
            _misfit(observe(replace(board, ratio=board.ratio + change)), solution) for change in (-step, 0, step)
        )
        bend = below - 2 * here + above
        change = step * (below - above) / (2 * bend) if bend > 0 else float(np.sign(below - above)) * step
        ratio = board.ratio + float(np.clip(change, -2 * step, 2 * step))
        board = replace(board, ratio=round(float(np.clip(ratio, 0.01, 0.99)), 5))
    return board


def _misfit(seen: fit.Observations, solution: fit.Solution) -> float:
    posed = fit.refine_poses(seen, solution, 8)
    size = np.linalg.norm(fit.residuals(seen, posed), axis=1)
    return float(np.log1p(size**2).mean())  # corners that were misread count little
