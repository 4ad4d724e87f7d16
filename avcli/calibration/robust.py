"""A fit that leaves out corners, not pictures: outliers, corners that start again from the lens, held-out error.

A corner belongs if its residual is within eight times what is common in its view. One that was found at the wrong place
starts again from where the lens expects it, and is looked for there (`polished`). A view is left out only if most of
its corners are bad.
"""

from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import circles, corners, fit
from avcli.calibration.blocks import Blocks
from avcli.calibration.corners import View
from avcli.calibration.fit import Observations, Solution
from avcli.calibration.target import Board

OUTLIER = 8.0
"""Residual, in standard deviations of one axis, beyond which a corner does not belong. Boards and lenses reach 5."""
_FOREIGN = 5.0
"""A view whose common corner is this many times as bad as that of all views does not belong."""
_LEAST_SHARE = 0.5
"""Share of a view's corners that must belong."""
_LEAST_CORNERS = 6
_WORSE = 2.0
"""A view may be this much worse than the common one before its corners are judged by the common one."""
FOLDS = 5
"""Parts of the views that are held out in turn; view i is in part i mod FOLDS."""
_SMOOTH = 4
"""Degree of the smooth field of displacements that a lens model may miss."""
_RADIAL = 3
"""Degree, in the square of the distance from the middle, of the displacements along it that a lens model may miss."""
_SIGMA_FLOOR_PX = 1e-6


def belonging(observations: Observations, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Judge each corner by its residual.

    Args:
        observations: the corners of all views.
        solution: with a pose for each of them.

    Returns:
        Which corners belong, (n,) bool, and which views have enough of them, (views,) bool.
    """
    o = observations
    length = np.linalg.norm(fit.residuals(o, solution), axis=1) / o.sigma
    length = np.where(np.isfinite(length), length, np.inf)
    counts = np.bincount(o.view)
    order = np.lexsort((length, o.view))
    middle = o.starts + (counts - 1) // 2
    spread = np.maximum(length[order][middle] / 1.1774, _SIGMA_FLOOR_PX)
    common = max(float(np.median(length)) / 1.1774, _SIGMA_FLOOR_PX)
    own = np.clip(spread, common, _WORSE * common)
    good = length <= OUTLIER * own[o.view]
    count = o.per_view(good.astype(int))
    views = count >= np.maximum(_LEAST_SHARE * counts, np.minimum(_LEAST_CORNERS, counts))
    views &= spread <= _FOREIGN * common
    if views.sum() < min(4, o.views):  # there is no majority to judge by
        views |= spread <= np.sort(spread)[:4][-1]
        good |= views[o.view] & (count < _LEAST_SHARE * counts)[o.view]
    return good & views[o.view], views


def fit_robustly(
    observations: Observations,
    width: int,
    height: int,
    *,
    board_shape: bool = False,
    roughly: bool = False,
    model: str = "kannala_brandt",
) -> tuple[Solution, np.ndarray]:
    """Fit from nothing, leaving out corners that do not belong.

    Args:
        observations: the corners.
        width, height: px, of the pictures.
        board_shape: fit the board's shape too.
        roughly: as in `fit.fit`.
        model: a name in avcli.lens.variants().

    Returns:
        the Solution for the views that have a corner left, and which corners are left, (n,) bool.

    Raises:
        NoFit: there are fewer equations than unknowns.
    """
    start = fit.scan_focal(observations, width, height, model)
    solution = fit.fit(observations, start, board_shape=board_shape, roughly=True)
    every = np.ones(len(observations.pixels), bool)
    return refit_robustly(observations, solution, every, board_shape=board_shape, roughly=roughly)


def refit_robustly(
    observations: Observations,
    solution: Solution,
    good: np.ndarray,
    *,
    board_shape: bool = False,
    roughly: bool = False,
) -> tuple[Solution, np.ndarray]:
    """Fit again from where a fit stands, at most four times, until the same corners are left out as before.

    Args:
        observations: all corners.
        solution: a fit to the corners in `good`, which may be a rough one.
        good: (n,) bool.
        board_shape: fit the board's shape too.
        roughly: as in `fit.fit`.

    Returns:
        as `fit_robustly`.
    """
    for _ in range(4):
        everywhere = posed(observations, solution, good)
        belongs, views = belonging(observations, everywhere)
        if np.array_equal(belongs, good):
            break
        good = belongs
        kept = observations.of_corners(good)
        solution = fit.fit(kept, everywhere.of_views(views), board_shape=board_shape, roughly=True)
    return (solution if roughly else fit.settled(observations.of_corners(good), solution)), good


def refined(
    observations: Observations, solution: Solution, good: np.ndarray, board: Board, views: list[View]
) -> tuple[Observations, Solution, np.ndarray]:
    """Refine all corners (`polished`) and fit again; the same as given where the corners come out no better.

    Args:
        observations: all corners.
        solution: a fit to the corners in `good`, which may be a rough one.
        good: (n,) bool.
        board, views: what was seen.
    """
    finer = polished(observations, posed(observations, solution, good), board, views, good)
    better = fit.fit(finer.of_corners(good), solution, roughly=True)
    better, finer_good = refit_robustly(finer, better, good, roughly=True)
    # A coarse or compressed picture may have no finer corners to give.
    if _typical(finer, better, finer_good) < _typical(observations, solution, good):
        observations, solution, good = finer, better, finer_good
    observations = weighed(observations, solution, good)
    return observations, fit.settled(observations.of_corners(good), solution), good


def weighed(observations: Observations, solution: Solution, good: np.ndarray) -> Observations:
    """Let views count less whose corners fit less well than is common: motion or a bend spoils all of a view alike.

    How much worse a view really is, its few shared errors tell poorly. So the variance that it gets is half-way, as
    factors go, between its own and the common one (examples/benchmarks/lenses.md).

    Args:
        observations: all corners.
        solution: a fit to the corners in `good`.
        good: (n,) bool.

    Returns:
        the same corners, with more sigma in such views.
    """
    some = observations.of_corners(good)
    squared = (fit.residuals(some, solution) ** 2).sum(1) / some.sigma**2
    rms = np.sqrt(some.per_view(squared) / np.bincount(some.view))
    worse = np.ones(observations.views)
    worse[observations.views_of(good)] = np.maximum(rms / np.median(rms), 1.0)
    return replace(observations, sigma=observations.sigma * np.sqrt(worse)[observations.view])


def _typical(observations: Observations, solution: Solution, good: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(fit.residuals(observations.of_corners(good), solution), axis=1)))


def posed(observations: Observations, solution: Solution, good: np.ndarray) -> Solution:
    """Give the solution a pose for every view: for those without a corner in `good` (n,) the one that suits best."""
    kept = observations.views_of(good)
    if kept.all():
        return solution
    rest = observations.of_views(~kept)
    there = fit.start_from_rays(rest, solution.lens, solution.beside)
    there = fit.refine_poses(rest, there, 15, solution.delta_px)
    rotations = np.zeros((observations.views, 3, 3))
    translations = np.zeros((observations.views, 3))
    rotations[kept], translations[kept] = solution.rotations, solution.translations
    rotations[~kept], translations[~kept] = there.rotations, there.translations
    return replace(solution, rotations=rotations, translations=translations)


# --- corners again ----------------------------------------------------------------------------------------------------


def polished(
    observations: Observations, everywhere: Solution, board: Board, views: list[View], good: np.ndarray | None = None
) -> Observations:
    """Refine all corners with the lens known (corners.polish) and weigh them by how well they could be placed.

    Args:
        observations: all corners.
        everywhere: a fit with a pose for each view.
        board, views: what was seen.
        good: (n,) bool; the others are looked for where the lens expects them, if that is in their patch.

    Circles stay where they were measured; what the lens and the view add to their centres is taken out.
    """
    if board.has_circles:
        R, t = everywhere.rotations[observations.view], everywhere.translations[observations.view]
        measured = np.concatenate([view.pixels for view in views])
        off = circles.offsets(fit.places(observations, everywhere), R, t, everywhere.lens, board.diameter_m / 2)
        return replace(observations, pixels=measured - off)
    seen, origins = observations.pixels, np.concatenate([view.origins for view in views])
    if good is not None and not good.all():
        expected = seen - np.nan_to_num(fit.residuals(observations, everywhere), nan=np.inf)
        near = (np.abs(expected - origins) <= corners.PATCH - 5).all(1)
        seen = np.where((~good & near)[:, None], expected, seen)
    unit, near = board.clear
    to_board = _board_offsets(replace(observations, pixels=seen), everywhere, unit)
    pixels, sd = corners.polish(np.concatenate([view.patches for view in views]), seen, origins, to_board, clear=near)
    fine = np.isfinite(sd)
    if fine.mean() < 0.5:
        return observations
    # What the noise in the picture does not explain (print, lens, blur) adds the same to every corner.
    typical = float(np.median(sd[fine]))
    sigma = np.sqrt(typical**2 + np.where(fine, sd, 10 * typical) ** 2) / (np.sqrt(2) * typical)
    pixels = np.where(fine[:, None], pixels, observations.pixels)
    return replace(observations, pixels=pixels, sigma=np.clip(sigma, 0.7, 10.0))


def _board_offsets(observations: Observations, solution: Solution, square: float) -> np.ndarray:
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


# --- the board's own errors -------------------------------------------------------------------------------------------


def with_board_errors(
    observations: Observations, solution: Solution, good: np.ndarray
) -> tuple[Observations, Solution]:
    """Find where the corners really are on the board, beside the lens (Strobl and Hirzinger 2011).

    No printer and no glue are exact. What the board does wrong is the same in every picture, so that many pictures tell
    it from the lens.

    Args:
        observations: all corners.
        solution: the fit to the corners in `good`.
        good: (n,) bool.

    Returns:
        the observations with their errors, 0 for a corner that no view shows, and the solution for those in `good`.
    """
    some, solution = fit.refine_with_errors(observations.of_corners(good), solution)
    errors = np.zeros((int(observations.corner.max()) + 1, 3))
    errors[observations.corner[good]] = some.errors
    return replace(observations, errors=errors[observations.corner]), solution


def fit_board(
    observations: Observations, solution: Solution, good: np.ndarray
) -> tuple[Observations, Solution, np.ndarray]:
    """Fit with the board's errors, and judge the corners again: until now these errors hid misplaced ones.

    Args:
        observations, solution, good: as in `with_board_errors`.

    Returns:
        all corners with the errors, the solution for those that are left, and which these are, (n,) bool.
    """
    learned, solution = with_board_errors(observations, solution, good)
    everywhere = posed(learned, solution, good)
    belongs, views = belonging(learned, everywhere)
    if not np.array_equal(belongs, good):
        good = belongs
        learned, solution = with_board_errors(observations, everywhere.of_views(views), good)
    return learned, fit.fit(learned.of_corners(good), solution, board_shape=solution.bends), good


# --- pictures held out ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HeldOut:
    """Error on pictures that took no part.

    Attributes:
        squared: (n,) squared residual of every corner; NaN where there are too few views.
        good: (n,) bool, which corners belong.
    """

    squared: np.ndarray
    good: np.ndarray

    @property
    def rms_px(self) -> float:
        """RMS residual of the corners that belong, px; NaN where there are too few views."""
        return self.of(self.good)

    @property
    def all_px(self) -> float:
        """RMS residual of every corner of every view, whatever is wrong with it, px."""
        return float(np.sqrt(self.squared.mean()))

    def of(self, some: np.ndarray) -> float:
        """RMS residual of some corners (n,) bool, px."""
        return float(np.sqrt(self.squared[some].mean())) if some.any() else float("nan")


def foretold(
    observations: Observations,
    solution: Solution,
    good: np.ndarray,
    *,
    board_shape: bool = False,
    board_errors: bool = False,
) -> float:
    """Foretell the robust held-out error with the board's shape or errors, by one step from a fit.

    It costs a tenth of `held_out`; compared with that of neither, it tells where that is worth while.

    Args:
        observations, solution, good: as in `held_out`.
        board_shape, board_errors: what to learn beside the lens.

    Returns:
        the root of the sum of the squared whitened residuals.
    """
    some = observations.of_corners(good)
    part = np.flatnonzero(observations.views_of(good)) % FOLDS
    free = solution.free.copy()
    free[-fit.BESIDE : -1] |= board_shape
    held = (solution.sigma_px / fit.error_prior(some)) ** 2 if board_errors else 0.0
    known = fit.blocks(some, replace(solution, free=free), held=held)
    return _crossed(known, part)


def _crossed(known: Blocks, part: np.ndarray) -> float:
    """The root of Blocks.crossed."""
    return float(np.sqrt(max(known.crossed(part), 1e-300)))


def missed(observations: Observations, solution: Solution) -> float:
    """Foretell what a lens that could bend anywhere would gain: the fraction by which the held-out RMS would fall.

    A smooth field of displacements over the picture is learnt beside the lens, and displacements away from its middle
    of higher degree, as a flat window asks for. Where the lens model describes the lens, they find nothing that the
    views share; it costs milliseconds.

    Args:
        observations, solution: of the kept views.

    Returns:
        at most 1, and mostly below 0 where the model is right; NaN with too few views.
    """
    if observations.views < 2 * FOLDS - 2:
        return np.nan
    low, high = observations.pixels.min(0), observations.pixels.max(0)
    x, y = (2 * (observations.pixels - low) / np.maximum(high - low, 1e-9) - 1).T
    across, down = (np.polynomial.legendre.legvander(at, _SMOOTH) for at in (x, y))
    terms = np.stack([across[:, i] * down[:, j] for i in range(_SMOOTH + 1) for j in range(_SMOOTH + 1 - i)], -1)
    displaced = np.einsum("nt,ab->natb", terms, np.eye(2)).reshape(len(x), 2, -1)
    away = observations.pixels - solution.parameters[2:4]
    away /= max(float(np.linalg.norm(away, axis=1).max()), 1e-9)
    radial = np.polynomial.legendre.legvander(2 * (away**2).sum(1) - 1, _RADIAL)[:, 2:]  # lower ones are in the field
    displaced = np.concatenate([displaced, away[:, :, None] * radial[:, None]], 2)
    part = np.arange(observations.views) % FOLDS
    free, lens = fit.blocks(observations, solution, beside=displaced), int(solution.free.sum())
    keep = np.r_[:lens, -7:0]
    plain = free._replace(
        gram=free.gram[:, keep[:, None], keep], prior=free.prior[:lens], off=free.off[:lens], doubt=free.doubt[:lens]
    )
    return 1 - _crossed(free, part) / _crossed(plain, part)


def held_out(
    observations: Observations, solution: Solution, good: np.ndarray, *, board_errors: bool = False
) -> HeldOut:
    """Measure the error on views that took no part: the lens from the others, the pose from the view itself, robustly.

    The lens of the others is two Gauss-Newton steps from that of all; where that is no lens, damped steps find it.

    Args:
        observations: the corners of every view that shows the board.
        solution: the fit to the corners in `good`.
        good: (n,) bool, the corners that belong. The others take no part in a fit, but they count in `all_px`.
        board_errors: also learn the board's errors (`with_board_errors`) from the other views.
    """
    folds = min(FOLDS, observations.views)
    if folds < 2:
        return HeldOut(np.full(len(good), np.nan), good)
    if board_errors:
        observations, solution = with_board_errors(observations, solution, good)
    everywhere = posed(observations, solution, good)
    kept = observations.views_of(good)
    part = np.arange(observations.views) % folds
    held = fit.holding(observations.of_corners(good), solution)
    known = fit.blocks(observations, everywhere, good, held)
    squared = np.zeros(len(good))
    for fold in range(folds):
        train, test = known.of((part != fold) & kept), part == fold
        if train.counts.sum() <= solution.free.sum() + 6 * len(train.counts):
            return HeldOut(np.full(len(good), np.nan), good)
        step = train.step()
        learned = fit.stepped(everywhere.of_views((part != fold) & kept), step.common, step.own)
        errors = observations.errors + step.errors[observations.corner] if held else observations.errors
        others = good & ~test[observations.view]
        some = replace(observations, errors=errors).of_corners(others)
        if fit.is_possible(learned):  # again, since robust weights change with the lens
            again, learned = fit.gauss_newton(some, learned, held)
        there = everywhere.of_views(test)
        if fit.is_possible(learned):
            some = again
            moved = (learned.parameters - solution.parameters)[solution.free]
            there = fit.stepped(there, moved, known.of(test).follow(moved))
        else:  # a lens that the others hardly tell needs damped steps
            learned = everywhere.of_views((part != fold) & kept)
            if held:
                some, learned = fit.refine_with_errors(some, learned)
            else:
                learned = fit.refine(some, learned, solution.free, solution.delta_px, 6, 1e-4)
        seen = observations.of_views(test)
        if held:
            place = np.zeros((int(observations.corner.max()) + 1, 3))
            place[observations.corner[others]] = some.errors
            seen = replace(seen, errors=place[observations.corner][test[observations.view]])
        there = replace(there, parameters=learned.parameters)
        there = fit.refine_poses(seen, there, 8, solution.delta_px, 1e-4)
        rest = (fit.residuals(seen, there) ** 2).sum(1)
        squared[test[observations.view]] = np.nan_to_num(rest, nan=100.0**2)
    return HeldOut(squared, good)
