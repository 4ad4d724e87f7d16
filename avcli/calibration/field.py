"""How well a lens is known over its picture: expected errors, up to which angle, and a test of them by halves."""

from dataclasses import dataclass

import numpy as np

from avcli import pose
from avcli.calibration import fit, uncertainty
from avcli.calibration.blocks import Blocks
from avcli.calibration.circle import Circle
from avcli.calibration.uncertainty import Views
from avcli.lens import Lens

_ANCHORS = 1000
"""Corners from which the camera's turn is taken, at most."""
_EDGE = 0.995
"""Part of the lens's field in which its inverse is smooth."""
_SINGULAR = 1e-9
"""Ratio of a matrix's lengths below which it has no inverse."""
_RINGS = 90
"""Angles from the axis at which a lens is tried for trust."""


@dataclass(frozen=True)
class Field:
    """Expected errors of the projection over the picture, a turn of the camera as a whole not counted.

    Attributes:
        pixels: (rows, columns, 2) px.
        lit: (rows, columns) bool, whether light reaches the pixel.
        angle: (rows, columns) rad from the axis; NaN where the lens images nothing.
        sd_px: (rows, columns), the root of the summed variances of u and v; NaN where no light or no ray is.
    """

    pixels: np.ndarray
    lit: np.ndarray
    angle: np.ndarray
    sd_px: np.ndarray

    @property
    def mean_px(self) -> float:
        """Mean expected error over the lit picture, px; a pixel that the lens does not image counts as the worst that
        it does; infinite where nothing is known."""
        known = self.sd_px[self.lit]
        return float(np.nan_to_num(known, nan=np.nanmax(known)).mean()) if np.isfinite(known).any() else np.inf


def seen_angles(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Angle from the optical axis of each pixel (n, 2), (n,) rad; NaN where the lens images nothing."""
    return pose.angle_from_axis(lens.unproject(pixels))


def grid(width: int, height: int, step: float = 40) -> np.ndarray:
    """Pixels over the picture, from corner to corner and about `step` px apart, (rows, columns, 2)."""
    u = np.linspace(0, width - 1, max(2, round(width / step)))
    v = np.linspace(0, height - 1, max(2, round(height / step)))
    return np.stack(np.meshgrid(u, v), -1)


def lit(pixels: np.ndarray, circle: Circle | None) -> np.ndarray:
    """Tell which pixels (..., 2) light reaches: all of them without a circle."""
    return np.ones(pixels.shape[:-1], bool) if circle is None else circle.holds(pixels)


def measured(
    observations: fit.Observations,
    solution: fit.Solution,
    width: int,
    height: int,
    circle: Circle | None = None,
    step: float | None = None,
) -> Field:
    """Compute the expected error over the picture from a fit's covariance.

    The camera's turn is taken out where corners were seen: what nobody observed does not turn the rest.

    Args:
        observations, solution: of the kept views.
        width, height: px, of the pictures.
        circle: the picture's circle; None where the whole picture is lit.
        step: px between the points; None makes about 48 columns.
    """
    pixels = grid(width, height, step or max(width / 48, 1.0))
    flat, shape = pixels.reshape(-1, 2), pixels.shape[:2]
    light, theta = lit(flat, circle), seen_angles(solution.lens, flat)
    sd_px = np.full(len(flat), np.nan)
    with np.errstate(invalid="ignore"):
        some = light & (theta < _EDGE * solution.lens.theta_max)
    sd_px[some] = errors_px(solution, observations.pixels, solution.lens.unproject(flat[some]))
    return Field(pixels, *(part.reshape(shape) for part in (light, theta, sd_px)))


def errors_px(solution: fit.Solution, corners: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Expected error where rays (n, 3) are projected, px (n,): the root of the summed variances of u and v.

    Args:
        solution: with its covariance; where that is not finite, neither are the errors.
        corners: (m, 2) px, where corners were seen.
        rays: that the lens images.
    """
    return _errors(solution, sensitivity(solution.lens, corners, rays)[0])


def errors_rad(solution: fit.Solution, corners: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """The same of the rays themselves, rad (n,)."""
    moved, by_ray = sensitivity(solution.lens, corners, rays)
    across = np.cross(rays, np.eye(3)[np.abs(rays).argmin(1)])
    across /= np.linalg.norm(across, axis=1)[:, None]
    plane = by_ray @ np.stack([across, np.cross(rays, across)], -1)
    return _errors(solution, _inverses(plane) @ moved)


def _errors(solution: fit.Solution, moved: np.ndarray) -> np.ndarray:
    """Roots (n,) of the summed variances of what the lens's parameters move, (n, 2, parameters)."""
    count = moved.shape[-1]
    covariance = solution.covariance[:count, :count]
    if not np.isfinite(covariance).all():
        return np.full(len(moved), np.inf)
    flat = moved.reshape(len(moved), -1)
    return np.sqrt(np.maximum(np.einsum("na,na->n", flat, (moved @ covariance).reshape(flat.shape)), 0))


def _inverses(matrices: np.ndarray) -> np.ndarray:
    """Inverses of (n, 2, 2) matrices; the pseudo-inverse of a singular one."""
    a, b, c, d = matrices.reshape(-1, 4).T
    size = a * d - b * c
    singular = np.abs(size) <= _SINGULAR * (matrices**2).sum((1, 2))
    out = np.stack([d, -b, -c, a], -1) / np.where(singular, 1.0, size)[:, None]
    out = out.reshape(-1, 2, 2)
    out[singular] = np.linalg.pinv(matrices[singular], rcond=_SINGULAR)
    return out


def sensitivity(lens: Lens, corners: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How a lens's parameters move the pixels of rays (n, 3), the turn that suits best at the corners taken out.

    Args:
        lens: any model of avcli.lens.
        corners: (m, 2) px, where corners were seen.
        rays: that the lens images.

    Returns:
        (n, 2, parameters) px, and the pixels' derivative to the rays (n, 2, 3).
    """
    some = corners[:: max(1, -(-len(corners) // _ANCHORS))]
    anchors = lens.unproject(some)
    anchors = anchors[np.isfinite(anchors).all(1)]
    _, by_anchor, at_anchor = lens.project_jacobian(anchors)
    good = np.isfinite(by_anchor).all((1, 2)) & np.isfinite(at_anchor).all((1, 2))
    turn = -by_anchor[good] @ pose.cross_matrix(anchors[good])
    count = at_anchor.shape[-1]
    best = np.linalg.lstsq(turn.reshape(-1, 3), at_anchor[good].reshape(-1, count), rcond=None)[0]
    _, by_ray, at_ray = lens.project_jacobian(rays)
    return at_ray + by_ray @ pose.cross_matrix(rays) @ best, by_ray


def trusted_angle(solution: fit.Solution, corners: np.ndarray, limit: float) -> float:
    """The largest angle from the axis up to which every ring's expected error stays below a limit.

    Args:
        solution: with its covariance.
        corners: (m, 2) px, where corners were seen; no ring beyond the farthest is trusted.
        limit: rad.

    Returns:
        rad; 0 where nothing is known.
    """
    lens = solution.lens
    seen = seen_angles(lens, corners)
    if not np.isfinite(seen).any():
        return 0.0
    farthest = float(np.nanmax(seen))
    theta = np.linspace(0, 1, _RINGS + 1)[1:] * min(farthest, _EDGE * lens.theta_max)
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    s, c = np.sin(theta)[:, None], np.cos(theta)[:, None]
    rays = np.stack([s * np.cos(turn), s * np.sin(turn), c + 0 * turn], -1)
    sd = errors_rad(solution, corners, rays.reshape(-1, 3)).reshape(rays.shape[:2])
    ring = np.sqrt(np.mean(sd**2, axis=1))
    bad = ~(ring <= limit)
    if not bad.any():
        return farthest
    first = int(np.argmax(bad))
    return float(theta[first - 1]) if first else 0.0


@dataclass(frozen=True)
class Halves:
    """How far lenses of two halves of the views lie apart, beside what each half states of itself.

    Attributes:
        ratio: root of the mean square, over the splits, of the actual difference over the stated one; NaN with too few
            views. 1 where the stated uncertainty is true.
        actual_px, stated_px: root mean squares over splits and pixels.
        splits: how many.
    """

    ratio: float = np.nan
    actual_px: float = np.nan
    stated_px: float = np.nan
    splits: int = 0


LEAST_FOR_HALVES = 8
"""Views with which halves can be compared: of three views none states an uncertainty."""


def split_halves(
    observations: fit.Observations,
    solution: fit.Solution,
    pixels: np.ndarray,
    *,
    splits: int = 50,
    refit: bool = False,
    seed: int = 0,
    known: Blocks | None = None,
) -> Halves:
    """Test the stated uncertainty: fit the lens to random halves of the views, compare what they differ by and state.

    Each half states its uncertainty from its own views alone. Their difference is known from both together, so that
    Student's t has the degrees of freedom of both, as in the pooled test of two samples. That of each half alone would
    make true statements of four views each look 1.4 times too cautious. The camera's turn is taken out where corners
    were seen.

    Args:
        observations, solution: of the kept views.
        pixels: (n, 2) px at which the lenses are compared, such as those that light reaches and that are trusted.
        splits: how many random splits.
        refit: fit each half, and the board's errors, from the solution on until it stands; otherwise one Gauss-Newton
            step of both from it, which differs by a tenth of a standard deviation and costs milliseconds.
        seed: of the splits.
        known: fit.by_view of both; None computes it.

    Returns:
        Halves; its ratio is NaN with fewer than eight views, or without a pixel that the lens images.
    """
    rays = solution.lens.unproject(pixels)
    rays = rays[np.isfinite(rays).all(1)]
    if not splits or observations.views < LEAST_FOR_HALVES or not len(rays):
        return Halves()
    moved, _ = sensitivity(solution.lens, observations.pixels, rays)
    count = moved.shape[-1]
    lens_of_free = np.flatnonzero(solution.free) < count
    moved = moved[:, :, np.flatnonzero(solution.free)[lens_of_free]].reshape(-1, lens_of_free.sum())
    square = moved.T @ moved / len(rays)
    known = known or fit.by_view(observations, solution)
    every = known.views

    def refitted(keep: np.ndarray) -> tuple[np.ndarray, Views]:
        some, found = observations.of_views(keep), solution.of_views(keep)
        if known.held:
            some, found = fit.refine_with_errors(some, found, 25, 1e-8)
        else:
            found = fit.refine(some, found, solution.free, solution.delta_px, 25)
        return (found.parameters - solution.parameters)[solution.free], fit.by_view(some, found).views

    def stepped(keep: np.ndarray) -> tuple[np.ndarray, Views]:
        step, views = known.of(keep).solved()
        return step.common, views

    steps, spreads = [], []
    for half in map(np.array, zip(*uncertainty.halves(observations.views, splits, seed), strict=True)):
        if refit or known.held:
            found = [refitted(keep) if refit else stepped(keep) for keep in half]
            step, views = np.array([s for s, _ in found]), uncertainty.stacked([v for _, v in found])
        else:  # what a view says of the lens does not depend on the others
            views = every.of(half)
            step = views.step
        steps.append(step[:, lens_of_free])
        spreads.append(uncertainty.covariance(views, observations.views - 2)[:, lens_of_free][:, :, lens_of_free])
    difference = steps[0] - steps[1]
    actual = np.einsum("sa,ab,sb->s", difference, square, difference)
    stated = np.einsum("ab,sab->s", square, spreads[0] + spreads[1])
    good = np.isfinite(actual) & np.isfinite(stated) & (stated > 0)
    if not good.any():
        return Halves()
    actual, stated = actual[good], stated[good]
    ratio, apart_px, stated_px = (float(np.sqrt(part.mean())) for part in (actual / stated, actual, stated))
    return Halves(ratio, apart_px, stated_px, int(good.sum()))


def apart(observations: fit.Observations, solution: fit.Solution, pixels: np.ndarray) -> np.ndarray:
    """How far two lenses, each from every other view, lie apart at pixels (n, 2), the camera's turn not counted.

    Returns:
        (n,) px; NaN where either lens images nothing, and everywhere with too few views.
    """
    out = np.full(len(pixels), np.nan)
    if observations.views < LEAST_FOR_HALVES:
        return out
    one, other = (
        fit.refine(observations.of_views(some), solution.of_views(some), solution.free, solution.delta_px, 25).lens
        for some in (np.arange(observations.views) % 2 == odd for odd in (0, 1))
    )
    rays = one.unproject(pixels)
    seen = np.isfinite(rays).all(1)
    rays = turned_to(one, other, observations.pixels, rays[seen])
    out[seen] = np.linalg.norm(pixels[seen] - other.project(rays), axis=1)
    return out


def turned_to(one: Lens, other: Lens, corners: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Turn rays (n, 3) of one lens as suits another best, so that both put the corners (m, 2) px at one place."""
    at = one.unproject(corners)
    good = np.isfinite(at).all(1)
    corners, at, total = corners[good], at[good], np.eye(3)
    for _ in range(4):
        projected, by_point, _ = other.project_jacobian(at @ total.T)
        good = np.isfinite(projected).all(1) & np.isfinite(by_point).all((1, 2))
        by_turn = -by_point[good] @ pose.cross_matrix((at @ total.T)[good])
        turn = np.linalg.lstsq(by_turn.reshape(-1, 3), (corners - projected)[good].ravel(), rcond=None)[0]
        total = pose.rotation_from_vector(turn[None])[0] @ total
    return rays @ total.T
