"""The fit of a lens: focal scan, poses from rays, and robust Levenberg-Marquardt with the poses eliminated.

A board's point (x, y) lies at (x, y (1 + b2), b0 (1 - (x / X)²) + b1 (1 - (y / Y)²)) of its own frame, X and Y being
the board's half extents: b0 and b1 (m) let it be bowed, b2 lets it be printed larger along one side. The lens is any
model of avcli.lens, which names its parameters and gives its own derivatives. Its centre moves (see
avcli.calibration.pupil). Whoever takes that for 0 where the pictures do not tell it states too small errors: the pupil
is always fitted, and held to what is known of lenses. That is weighed against what the views tell, which is less than
what as many independent corners would: their likelihood is tempered (Holmes and Walker 2017, Assigning a value to a
power likelihood in a general Bayesian model). The fit has six unknowns a view and P common ones: the lens's parameters
in the order of `Lens.names` (fx fy cx cy k1 k2 k3 k4 of most), then b0 b1 b2 and the pupil, always last.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from avcli import pose
from avcli.calibration import uncertainty
from avcli.calibration.blocks import Blocks, damped
from avcli.calibration.pupil import PUPIL, from_pupil, project_jacobian
from avcli.calibration.uncertainty import Views
from avcli.lens import KannalaBrandt, Lens, variants

SHAPE = 3
"""Number of the board's shape terms b0 b1 b2."""
BESIDE = SHAPE + 1
"""Number of the common unknowns beside those of the lens as config.json has it: b0 b1 b2 and the pupil, the last."""
BOARD_ERROR = 0.01
"""Standard deviation of a corner's place on the board, in squares, before it is seen."""
_HAS_A_SAY = 0.1
"""Part of PUPIL.sd: where the views tell the pupil better, what is known before weighs less than 1 % beside them."""
_BEGUN = 16
"""Corners of each view at most with which a fit begins."""
_SCANNED = 8
"""Views at most from which the focal length is guessed."""
_NARROWEST, _WIDEST = np.deg2rad(25), np.deg2rad(250)
"""rad; what is guessed of the longer and of the shorter side of a picture: the field that they show."""
DELTA = 3.0
"""Standard deviations of a corner's error beyond which it counts less."""
_WIDE = 1e3
"""Size of a picture, in focal lengths, that bounds no lens."""
_UNSEEN_PX = 100.0
"""Residual of a corner that the lens, as it stands in an iteration, does not image."""


@dataclass(frozen=True)
class Observations:
    """Corners seen in a number of images, sorted by image.

    Attributes:
        view: (n,) index of the image, 0 ... views - 1, ascending, none of them without a corner.
        points: (n, 2) m, the corner's place on the board, from the board's middle.
        pixels: (n, 2) px, where it was seen.
        sigma: (n,) expected error of `pixels` relative to that of a common corner.
        half_extent: (2,) m, see the module.
        errors: (n, 3) m, how far the corner is from where the board's shape puts it, in the board's frame.
    """

    view: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    sigma: np.ndarray
    half_extent: np.ndarray
    errors: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))

    @cached_property
    def corner(self) -> np.ndarray:
        """(n,) which of the board's corners that were seen each is, from 0."""
        return np.unique(self.points[:, 0] + 1j * self.points[:, 1], return_inverse=True)[1]

    @cached_property
    def square(self) -> float:
        """Distance between neighbouring corners of the board, m."""
        apart = np.diff(np.unique(self.points[:, 0] + 1j * self.points[:, 1]))
        return float(np.maximum(np.abs(apart.real), np.abs(apart.imag)).min())

    @property
    def views(self) -> int:
        """Number of images."""
        return int(self.view[-1]) + 1 if len(self.view) else 0

    @property
    def starts(self) -> np.ndarray:
        """(views,) index of the first corner of each image."""
        return np.searchsorted(self.view, np.arange(self.views))

    def of_views(self, keep: np.ndarray) -> "Observations":
        """The corners of some views only: `keep` (views,) bool, or indices."""
        chosen = np.zeros(self.views, bool)
        chosen[keep] = True
        return self.of_corners(chosen[self.view])

    def of_corners(self, keep: np.ndarray) -> "Observations":
        """Some corners only, `keep` (n,) bool, and only the views that have one of them, renumbered."""
        _, renumbered = np.unique(self.view[keep], return_inverse=True)
        return replace(
            self,
            view=renumbered,
            points=self.points[keep],
            pixels=self.pixels[keep],
            sigma=self.sigma[keep],
            errors=self.errors if len(self.errors) == 1 else self.errors[keep],
        )

    def views_of(self, keep: np.ndarray) -> np.ndarray:
        """Which views have one of the corners `keep` (n,) bool: (views,) bool."""
        return np.bincount(self.view, keep, self.views) > 0

    def per_view(self, values: np.ndarray) -> np.ndarray:
        """Sum (n, ...) values over the corners of each view: (views, ...)."""
        return np.add.reduceat(values, self.starts, axis=0)

    def gram(self, columns: np.ndarray) -> np.ndarray:
        """Products of (n, 2, m) columns with each other, summed over the corners of each view: (views, m, m)."""
        counts = np.bincount(self.view)
        most, m = int(counts.max()), columns.shape[2]
        if (counts == most).all():
            stacked = columns.reshape(self.views, 2 * most, m)
        else:
            stacked = np.zeros((self.views, most, 2, m))
            stacked[self.view, np.arange(len(self.view)) - self.starts[self.view]] = columns
            stacked = stacked.reshape(self.views, 2 * most, m)
        # A copy, or numpy takes BLAS's syrk, which needs twice as long for few columns.
        return np.ascontiguousarray(stacked.transpose(0, 2, 1)) @ stacked


@dataclass(frozen=True)
class Solution:
    """Where a fit stands.

    Attributes:
        parameters: (P,) of the lens (`Lens.names`: fx fy cx cy px, and its coefficients), then b0 b1 m, b2, pupil m.
        rotations, translations: (views, 3, 3) and (views, 3) m, board to camera.
        free: (P,) bool, which parameters were fitted.
        covariance: (P, P) of the parameters, 0 where not fitted; before the end of a fit one NaN.
        sigma_px: standard deviation of a common corner's error along one axis.
        delta_px: residual beyond which a corner counts less (Huber).
        doubt: how many times larger the standard deviation is with which the views tell the pupil, than if the error
            of each corner were its own. What is known of it before weighs so much more beside the corners. 1 where that
            has no say.
        like: any lens of the model that is fitted.
    """

    parameters: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    free: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.array(np.nan))
    sigma_px: float = np.nan
    delta_px: float = np.inf
    doubt: float = 1.0
    like: Lens = field(default_factory=lambda: KannalaBrandt(1.0, 1.0, 0.0, 0.0))

    @cached_property
    def lens(self) -> Lens:
        """The lens."""
        return replace(self.like, **dict(zip(self.like.names(), self.parameters.tolist(), strict=False)))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters, (P,): those of the lens, and b0, b1, b2, pupil."""
        return (*self.like.names(), "b0", "b1", "b2", "pupil")

    @property
    def shape(self) -> np.ndarray:
        """The board's shape terms b0, b1 (m) and b2."""
        return self.parameters[-BESIDE:-1]

    @property
    def pupil(self) -> float:
        """How far the centre of projection is ahead at 1 rad from the axis, m; as the square of the angle."""
        return float(self.parameters[-1])

    @property
    def beside(self) -> np.ndarray:
        """The parameters that are not the lens's, (BESIDE,)."""
        return self.parameters[-BESIDE:]

    @property
    def bends(self) -> bool:
        """Whether the board's shape was fitted."""
        return bool(self.free[-BESIDE:-1].any())

    def of_views(self, keep: np.ndarray) -> "Solution":
        """The poses of some views only: `keep` (views,) bool, or indices."""
        return replace(self, rotations=self.rotations[keep], translations=self.translations[keep])


class NoFit(ValueError):
    """The pictures do not determine a lens."""


# --- geometry ---------------------------------------------------------------------------------------------------------


def surface(points: np.ndarray, shape: np.ndarray, half_extent: np.ndarray) -> np.ndarray:
    """Points of the board in its frame, (n, 3) m, from their places (n, 2) and the shape terms b0, b1 (m) and b2."""
    x, y = points.T
    z = shape[0] * (1 - (x / half_extent[0]) ** 2) + shape[1] * (1 - (y / half_extent[1]) ** 2)
    return np.stack([x, y * (1 + shape[2]), z], -1)


def places(observations: Observations, solution: Solution) -> np.ndarray:
    """Where the corners are in the board's frame, (n, 3) m."""
    return surface(observations.points, solution.shape, observations.half_extent) + observations.errors


def pupil_unit(observations: Observations, solution: Solution) -> float:
    """The length that the pupil is known in, m: geometric mean of the board's square and its median distance."""
    return float(np.sqrt(observations.square * np.median(np.linalg.norm(solution.translations, axis=1))))


def residuals(observations: Observations, solution: Solution) -> np.ndarray:
    """Seen minus predicted, (n, 2) px; NaN where the lens does not image the corner."""
    inside = (solution.rotations[observations.view] @ places(observations, solution)[:, :, None])[:, :, 0]
    points = inside + solution.translations[observations.view]
    return observations.pixels - solution.lens.project(from_pupil(points, solution.pupil)[0])


def poses_from_rays(lens: Lens, observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Board poses from the rays of their corners, right beyond 90 degrees too.

    Solves ray × (H [x y 1]) = 0 for each view by least squares and takes the nearest rotation (Zhang 2000, section
    3.1, with rays in place of pixels).

    Returns:
        rotations (views, 3, 3) and translations (views, 3) m, board to camera.
    """
    rays = lens.unproject(observations.pixels)
    rays = np.where(np.isfinite(rays).all(1)[:, None], rays, 0.0)
    scale = np.abs(observations.points).max()
    plane = np.column_stack([observations.points / scale, np.ones(len(rays))])
    cross = np.zeros((len(rays), 3, 3))
    cross[:, [0, 1, 2], [1, 2, 0]] = -rays[:, [2, 0, 1]]
    cross[:, [1, 2, 0], [0, 1, 2]] = rays[:, [2, 0, 1]]
    rows = np.einsum("nij,nk->nijk", cross, plane).reshape(-1, 3, 9)
    normal = observations.per_view(np.einsum("nia,nib->nab", rows, rows))
    H = np.linalg.eigh(normal)[1][:, :, 0].reshape(-1, 3, 3)
    ahead = observations.per_view(np.einsum("ni,nij,nj->n", rays, H[observations.view], plane))
    H *= np.where(ahead < 0, -1.0, 1.0)[:, None, None]
    H[:, :, :2] /= scale
    lengths = np.linalg.norm(H[:, :, :2], axis=1).sum(1)
    H *= (2.0 / np.maximum(lengths, 1e-300))[:, None, None]
    frame = np.stack([H[:, :, 0], H[:, :, 1], np.cross(H[:, :, 0], H[:, :, 1])], -1)
    U, _, Vt = np.linalg.svd(frame)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt, H[:, :, 2]


# --- one step ---------------------------------------------------------------------------------------------------------


def _linearise(observations: Observations, solution: Solution) -> np.ndarray:
    """Whitened derivatives to the k free common unknowns and to the pose, and residuals, (n, 2, k + 6 + 1)."""
    o, s = observations, solution
    R = s.rotations[o.view]
    turned = np.einsum("nij,nj->ni", R, places(o, s))
    points = turned + s.translations[o.view]
    of_lens, of_shape = s.free[:-BESIDE], s.free[-BESIDE:-1]
    first, k = int(of_lens.sum()), int(s.free.sum())
    columns = np.empty((len(turned), 2, k + 7))
    if s.free[-1] or s.pupil:
        pixels, by_point, by_lens, by_pupil = project_jacobian(s.lens, points, s.pupil)
        if s.free[-1]:
            columns[:, :, k - 1] = by_pupil
    else:
        pixels, by_point, by_lens = s.lens.project_jacobian(points)
    columns[:, :, :first] = by_lens if of_lens.all() else by_lens[:, :, of_lens]
    if of_shape.any():
        u, v = (o.points / o.half_extent).T
        bend = np.stack([R[:, :, 2] * (1 - u**2)[:, None], R[:, :, 2] * (1 - v**2)[:, None]], -1)
        longer = (by_point @ R[:, :, 1:2]) * o.points[:, None, 1:]
        columns[:, :, first : first + of_shape.sum()] = np.concatenate([by_point @ bend, longer], 2)[:, :, of_shape]
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1)), k):  # the cross product of the point with the derivative
        columns[:, :, axis] = turned[:, None, i] * by_point[:, :, j] - turned[:, None, j] * by_point[:, :, i]
    columns[:, :, k + 3 : -1] = by_point
    np.subtract(o.pixels, pixels, out=columns[:, :, -1])
    if not np.isfinite(columns.sum()):
        unseen = ~np.isfinite(columns).all((1, 2))
        columns[unseen] = 0.0
        columns[unseen, 0, -1] = _UNSEEN_PX
    columns /= o.sigma[:, None, None]
    return columns


def by_pose(observations: Observations, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 2) px, and how the projections follow a turn (rad) and a shift (m) of the board, (n, 2, 6)."""
    columns = _linearise(replace(observations, sigma=np.ones(len(observations.sigma))), solution)
    return columns[:, :, -1], columns[:, :, -7:-1]


def _huber(residual: np.ndarray, delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Cost and weight of each residual vector (n, 2): quadratic up to `delta`, linear beyond (Huber 1964)."""
    size = np.linalg.norm(residual, axis=1)
    inside = size <= delta
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(inside, 1.0, delta / size)
        cost = np.where(inside, size**2, 2 * delta * size - delta**2) if np.isfinite(delta) else size**2
    return cost, weight


def blocks(
    observations: Observations,
    solution: Solution,
    used: np.ndarray | None = None,
    held: float = 0.0,
    beside: np.ndarray | None = None,
    newton: bool = False,
) -> Blocks:
    """The normal equations of `solution.free` and the poses, at the solution and with its robust weights.

    Args:
        observations, solution: where to linearise.
        used: (n,) bool, the corners that count; None: all.
        held: 1 / m²; where it is above 0 the corners' places on the board are unknown too, held at the print's.
        beside: (n, 2, m) px, what m more common unknowns do to the projections. They are 0 now, and held at it with a
            standard deviation of DELTA common corners' errors.
        newton: take the second derivatives of the robust cost in place of its weights. A residual beyond
            `solution.delta_px` bends the cost only across itself: half of its weight, its direction being chance. A
            weight is larger, so that steps are safe; but how far a solution moves with its corners follows from the
            second derivatives (Huber and Ronchetti 2009, section 6.3).
    """
    o, free = observations, solution.free
    prior, off, doubt = np.zeros(len(free)), solution.parameters.copy(), np.ones(len(free))
    if free[-1] and np.isfinite(solution.delta_px):
        prior[-1] = (solution.doubt * solution.delta_px / (DELTA * PUPIL.sd * pupil_unit(o, solution))) ** 2
        off[-1] -= PUPIL.mean * pupil_unit(o, solution)
        doubt[-1] = solution.doubt
    prior, off, doubt = prior[free], off[free], doubt[free]
    columns = _linearise(o, solution)
    if beside is not None:
        k, count = len(off), beside.shape[2]
        columns = np.concatenate([columns[:, :, :k], beside / o.sigma[:, None, None], columns[:, :, k:]], 2)
        prior, off = np.append(prior, np.full(count, DELTA**-2.0)), np.append(off, np.zeros(count))
        doubt = np.append(doubt, np.ones(count))
    cost, weight = _huber(columns[:, :, -1], solution.delta_px)
    if used is not None:
        cost, weight = cost * used, weight * used
    columns *= np.sqrt(weight)[:, None, None]
    counts = 2.0 * (np.bincount(o.view, used, o.views) if used is not None else np.bincount(o.view))
    size, corners = columns.shape[2], 0
    place, cross = np.zeros((o.views, 0, 3, 3)), np.zeros((o.views, 0, 3, size))
    errors = np.zeros((0, 3))
    if newton:  # half as much of the products of the derivatives; those with the residual stay
        far = np.sqrt(np.where(weight < 1, 0.5, 1.0))[:, None]
        columns[:, :, :-1] *= far[..., None]
        columns[:, :, -1] /= far
    if held:
        corner = o.corner
        corners = int(corner.max()) + 1
        by_place = columns[:, :, -4:-1] @ solution.rotations[o.view]
        place, cross = np.zeros((o.views, corners, 3, 3)), np.zeros((o.views, corners, 3, size))
        turned = np.swapaxes(by_place, 1, 2)
        place[o.view, corner] = turned @ by_place
        cross[o.view, corner] = turned @ columns
        errors = np.zeros((corners, 3))
        errors[corner] = o.errors
    return Blocks(o.gram(columns), o.per_view(cost), counts, place, cross, errors, held, prior, off, doubt)


def stepped(solution: Solution, common: np.ndarray, own: np.ndarray | None = None) -> Solution:
    """The solution after a step of the common unknowns that are free (k,), and of the poses (views, 6)."""
    parameters = solution.parameters.copy()
    parameters[solution.free] += common
    if own is None:
        return replace(solution, parameters=parameters)
    return replace(
        solution,
        parameters=parameters,
        rotations=pose.rotation_from_vector(own[:, :3]) @ solution.rotations,
        translations=solution.translations + own[:, 3:],
    )


def refine(
    observations: Observations, start: Solution, free: np.ndarray, delta: float, iterations: int, gain: float = 1e-8
) -> Solution:
    """Levenberg-Marquardt on the common unknowns in `free` (P,) and all poses, the poses eliminated (Schur).

    Stops when a step lowers the cost by less than `gain` of it.
    """
    return _refined(observations, replace(start, free=np.asarray(free, bool), delta_px=delta), 0.0, iterations, gain)[1]


def refine_with_errors(
    observations: Observations, start: Solution, iterations: int = 8, gain: float = 1e-4
) -> tuple[Observations, Solution]:
    """Levenberg-Marquardt on `start.free`, all poses, and where the corners really are on the board.

    Returns:
        the observations with their errors, and the solution for them.
    """
    errors = np.zeros((len(observations.view), 3)) if len(observations.errors) == 1 else observations.errors
    held = (start.sigma_px / error_prior(observations)) ** 2
    known, solution = _refined(replace(observations, errors=errors), start, held, iterations, gain)
    # The start's residuals contain the errors, which would then be held too tightly.
    return _refined(known, solution, holding(known, solution), iterations, gain)


def gauss_newton(observations: Observations, solution: Solution, held: float = 0.0) -> tuple[Observations, Solution]:
    """One step of `solution.free`, the poses, and (`held` as in `blocks`) the places of the corners on the board."""
    step = blocks(observations, solution, held=held).step()
    if held:
        observations = replace(observations, errors=observations.errors + step.errors[observations.corner])
    return observations, stepped(solution, step.common, step.own)


def _refined(
    observations: Observations, solution: Solution, held: float, iterations: int, gain: float
) -> tuple[Observations, Solution]:
    now, damping = blocks(observations, solution, held=held), 1e-5
    for _ in range(iterations):
        while True:
            step = now.step(damping)
            trial, moved = stepped(solution, step.common, step.own), observations
            if held:
                moved = replace(observations, errors=observations.errors + step.errors[observations.corner])
            if is_possible(trial):
                found = blocks(moved, trial, held=held)
                if found.total <= now.total:
                    break
            damping *= 6
            if damping > 1e10:
                return observations, solution
        drop = (now.total - found.total) / max(now.total, 1e-300)
        observations, solution, now = moved, trial, found
        damping = max(damping / 6, 1e-12)
        if drop < gain or now.total < 1e-18 * len(observations.pixels):
            break
    return observations, solution


def is_possible(solution: Solution) -> bool:
    """Whether a solution is finite and its lens images anything."""
    p = solution.parameters
    finite = np.isfinite(p).all() and np.isfinite(solution.rotations).all() and np.isfinite(solution.translations).all()
    return bool(finite and abs(solution.shape[2]) < 0.5 and solution.lens.is_possible)


def refine_poses(
    observations: Observations, start: Solution, iterations: int, delta: float = np.inf, gain: float = 1e-12
) -> Solution:
    """Levenberg-Marquardt on the poses alone, each view by itself, the lens and the board held.

    Stops when no step lowers the cost of its view by more than `gain` of it.
    """
    solution = replace(start, free=np.zeros(len(start.parameters), bool))
    damping = np.full(observations.views, 1e-3)

    def normal(trial: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        columns = _linearise(observations, trial)
        cost, weight = _huber(columns[:, :, -1], delta)
        columns *= np.sqrt(weight)[:, None, None]
        G = observations.gram(columns)
        return observations.per_view(cost), G[:, :6, :6], G[:, :6, 6]

    cost, C, h = normal(solution)
    for _ in range(iterations):
        step = np.linalg.solve(damped(C, damping), h[..., None])[..., 0]
        hoped = (step * h).sum(1)  # the drop of the cost that the step promises, or a little more
        trial = stepped(solution, np.zeros(0), step)
        found = normal(trial)
        better = found[0] < cost
        pick = better[:, None]
        solution = replace(
            solution,
            rotations=np.where(pick[..., None], trial.rotations, solution.rotations),
            translations=np.where(pick, trial.translations, solution.translations),
        )
        moved = better & (cost - found[0] > gain * cost)
        waiting = ~better & (damping <= 1e3) & (hoped > gain * cost)
        cost, h = np.where(better, found[0], cost), np.where(pick, found[2], h)
        C = np.where(pick[..., None], found[1], C)
        damping = np.where(better, damping / 6, damping * 6)
        if not moved.any() and not waiting.any():
            break
    return solution


def by_view(observations: Observations, solution: Solution) -> Blocks:
    """The normal equations of a fit that stands; the board's errors are unknowns if there are any."""
    return blocks(observations, solution, held=holding(observations, solution), newton=True)


def holding(observations: Observations, solution: Solution) -> float:
    """The weight (1 / m²) with which the board's errors are held at zero in a fit that stands; 0 where it has none."""
    if not observations.errors.any():
        return 0.0
    known = blocks(observations, solution)
    variance = float(known.cost.sum() / max(known.counts.sum() - 6 * len(known.cost), 1.0))
    return max(variance, 1e-300) / error_prior(observations) ** 2


def error_prior(observations: Observations) -> float:
    """Standard deviation of the board's errors along an axis, m."""
    return BOARD_ERROR * observations.square


def covariance(
    observations: Observations, solution: Solution, of: Callable[[Views], np.ndarray] = uncertainty.covariance
) -> tuple[np.ndarray, float]:
    """Covariance (P, P) of the common unknowns by views, 0 where not fitted, and a corner's error along an axis, px."""
    views = by_view(observations, solution).views
    out = np.zeros((len(solution.parameters),) * 2)
    out[np.ix_(solution.free, solution.free)] = of(views)
    return out, float(np.sqrt(views.variance))


# --- the whole fit ----------------------------------------------------------------------------------------------------


def free_parameters(lens: Lens, board_shape: bool = False, pupil: bool = False, few: bool = False) -> np.ndarray:
    """Which common unknowns to fit, (P,) bool: the lens's (a `few`: one coefficient), the board's shape, the pupil."""
    names = lens.names()
    freed = (*names[:4], lens.leading) if few else names
    return np.array([name in freed for name in names] + [board_shape] * SHAPE + [pupil])


def start_from_rays(observations: Observations, lens: Lens, beside: np.ndarray | None = None) -> Solution:
    """Poses from rays under a lens that is known or guessed, and what is known beside it, (BESIDE,) of Solution."""
    parameters = np.append(lens.parameters, np.zeros(BESIDE) if beside is None else beside)
    return Solution(parameters, *poses_from_rays(lens, observations), free=np.zeros(len(parameters), bool), like=lens)


def view_rms(observations: Observations, solution: Solution) -> np.ndarray:
    """RMS residual of each view, (views,) px; a corner that the lens does not image counts as 100 px."""
    squared = np.nan_to_num((residuals(observations, solution) ** 2).sum(1), nan=_UNSEEN_PX**2)
    return np.sqrt(observations.per_view(squared) / np.bincount(observations.view))


def scan_focal(observations: Observations, width: int, height: int, model: str = "kannala_brandt") -> Solution:
    """Find a start: the centred lens whose boards come out flattest, with the poses under it.

    OpenCV starts from max(width, height) / pi instead, which asserts or ends in nonsense on most wide lenses.
    """
    few = np.unique(np.linspace(0, observations.views - 1, min(observations.views, _SCANNED)).round().astype(int))
    sample = _thinned(observations.of_views(few), 9)
    middle = (np.array([width, height]) - 1) / 2
    kind = variants()[model]
    coefficients = [*kind.start, *[0.0] * (len(kind.names()) - 4 - len(kind.start))]
    unit = kind.of_image([1.0, 1.0, 0.0, 0.0, *coefficients], _WIDE, _WIDE)

    def scores(focal: np.ndarray) -> np.ndarray:
        """Median misfit of the views for each focal length, px: all at once, as views of one lens of 1 px."""
        tried, views = len(focal), sample.views
        every = Observations(
            np.add.outer(views * np.arange(tried), sample.view).ravel(),
            np.tile(sample.points, (tried, 1)),
            ((sample.pixels - middle) / focal[:, None, None]).reshape(-1, 2),
            np.ones(tried * len(sample.view)),
            sample.half_extent,
        )
        found = refine_poses(every, start_from_rays(every, unit), 2)
        return np.median(view_rms(every, found).reshape(tried, views), axis=1) * focal

    focal = np.geomspace(min(width, height) / _WIDEST, max(width, height) / _NARROWEST, 13)
    best = int(np.argmin(scores(focal)))
    focal = np.geomspace(focal[max(best - 1, 0)], focal[min(best + 1, len(focal) - 1)], 7)
    f = float(focal[np.argmin(scores(focal))])
    lens = kind.of_image([f, f, *middle, *coefficients], width, height)
    some = _thinned(observations, _BEGUN)
    return refine_poses(some, start_from_rays(some, lens), 3, gain=1e-2)


def _thinned(observations: Observations, most: int) -> Observations:
    """At most so many corners of each view, spread over the board."""
    keep = np.zeros(len(observations.view), bool)
    for start, count in zip(observations.starts, np.bincount(observations.view), strict=True):
        keep[start + np.linspace(0, count - 1, min(count, most)).round().astype(int)] = True
    return observations.of_corners(keep)


def fit(observations: Observations, start: Solution, *, board_shape: bool = False, roughly: bool = False) -> Solution:
    """Fit the lens, the pupil (and the board's shape) to all views, robustly, in stages of growing freedom.

    Args:
        observations, start: the corners, and where to begin.
        board_shape: fit the board's shape too.
        roughly: leave the last digits and the covariance for later (`settled`), as suits a fit whose corners change.

    Raises:
        NoFit: there are fewer equations than unknowns, or no lens images the corners.
    """
    lens_only, free = free_parameters(start.like), free_parameters(start.like, board_shape, pupil=True)
    if 2 * len(observations.pixels) <= free[:-1].sum() + 6 * observations.views:
        raise NoFit(
            f"{len(observations.pixels)} corners in {observations.views} views are too few to fit a lens; film more"
        )
    if not start.free.any():
        some = _thinned(observations, _BEGUN)
        start = refine(some, start, free_parameters(start.like, few=True), 5.0, 15, 1e-4)
        start = refine(some, start, lens_only, 2.0, 25, 1e-5)
        started = _reseeded(observations, start)
        if started is not start:
            start = refine(observations, started, lens_only, _delta(observations, started), 15, 1e-5)
    solution = start
    for _ in range(2 if roughly else 1):  # robust weights follow from where a fit stands
        solution = refine(observations, solution, free, _delta(observations, solution), 40, 1e-5)
    return solution if roughly else settled(observations, solution)


def settled(observations: Observations, solution: Solution) -> Solution:
    """Fit `solution.free` to the last digit from a rough fit, and state how uncertain it is."""
    free = solution.free
    solution = refine(observations, solution, free, _delta(observations, solution), 40)
    spread, sigma = covariance(observations, solution)
    if spread[-1, -1] > (_HAS_A_SAY * PUPIL.sd * pupil_unit(observations, solution)) ** 2:
        solution = replace(solution, doubt=_doubt(observations, solution))
        solution = refine(observations, solution, free, solution.delta_px, 40)
        spread, sigma = covariance(observations, solution)
    return replace(solution, covariance=spread, sigma_px=sigma)


def _doubt(observations: Observations, solution: Solution) -> float:
    """`Solution.doubt` of a fit that stands: by views, over that of independent corners; nothing else being known."""
    views = by_view(observations, solution).unheld().views
    known, least = uncertainty.covariance(views)[-1, -1], uncertainty.noise(views)[-1, -1]
    return float(np.sqrt(known / least)) if np.isfinite(known) and least > 0 else 1.0


def _reseeded(observations: Observations, solution: Solution) -> Solution:
    """Start the views that fit badly again from their rays, and keep what fits better."""
    rms = view_rms(observations, solution)
    bad = rms > max(5 * np.median(rms), 2.0)
    if not bad.any():
        return solution
    few = observations.of_views(bad)
    again = refine_poses(few, start_from_rays(few, solution.lens, solution.beside), 10)
    better = view_rms(few, again) < rms[bad]
    chosen = np.flatnonzero(bad)[better]
    rotations, translations = solution.rotations.copy(), solution.translations.copy()
    rotations[chosen], translations[chosen] = again.rotations[better], again.translations[better]
    return replace(solution, rotations=rotations, translations=translations)


def _delta(observations: Observations, solution: Solution) -> float:
    """Three standard deviations of the residuals' bulk: their median length is 1.177 of it (Rayleigh)."""
    length = np.linalg.norm(residuals(observations, solution), axis=1) / observations.sigma
    if not np.isfinite(length).any():
        raise NoFit("no lens explains the corners that were found: the pictures may not show the board")
    return max(DELTA * float(np.nanmedian(length)) / 1.1774, 1e-9)
