"""Lens models that avcli.lens lacks, and the lens of another model that comes nearest to a given one.

Two lenses are compared along rays: the same rays are projected through both, and the distance of the pixels counts. The
rays cover the part of the picture that is known, as densely as its pixels do.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from avcli.lens import Lens
from avcli.pose import angle_from_axis

_ANGLES, _AZIMUTHS = 120, 96
_FITTED = 2000
"""Rays that take part in a fit; all take part in what is said of it."""
_STEPS = 60
_UNSEEN_PX = 100.0
"""Residual of a ray that the lens, as it stands in an iteration, does not image."""
_GROWTH = (0.35, 0.6, 0.8, 1.0)
"""Parts of the field that are fitted one after the other: far from the axis a polynomial has many wrong minima."""


class Projection(Protocol):
    """What takes points to pixels: a lens of avcli.lens, or `Foreign`."""

    @property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad."""

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3); NaN where they are not imaged."""


@dataclass(frozen=True)
class Foreign:
    """A lens model that avcli.lens lacks, known by its projection alone.

    Attributes:
        text: what its files call it.
        pixels: takes points (n, 3) in the camera frame to pixels (n, 2).
        theta_max: rad, the largest angle from the axis at which it is used.
    """

    text: str
    pixels: Callable[[np.ndarray], np.ndarray]
    theta_max: float

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3); NaN beyond `theta_max`."""
        near = angle_from_axis(points) <= self.theta_max
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return np.where(near[:, None], self.pixels(points), np.nan)


def up_to_fold(foreign: Foreign) -> Foreign:
    """The same with `theta_max` lowered to the angle up to which pixels move outwards along every azimuth."""
    angles = np.linspace(0, foreign.theta_max * (1 - 1e-9), 721)[1:]
    azimuths = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rays = _rays(*(a.ravel() for a in np.meshgrid(angles, azimuths)))
    pixels = foreign.project(rays).reshape(len(azimuths), len(angles), 2)
    outward = np.linalg.norm(pixels - foreign.project(np.array([[0.0, 0.0, 1.0]]))[0], axis=-1)
    with np.errstate(invalid="ignore"):
        grows = (np.diff(outward, axis=1, prepend=0) > 0).all(0)
    good = len(angles) if grows.all() else int(np.argmin(grows))
    return replace(foreign, theta_max=float(angles[good - 1]) if good else 0.0)


# --- rays -------------------------------------------------------------------------------------------------------------


class Samples(NamedTuple):
    """Rays over the known part of a picture.

    rays (n, 3), the pixels (n, 2) where a lens puts them, weights (n,) that sum to 1 and are proportional to the area
    of the picture that each stands for, angles (n,) rad from the axis, and the largest angle `theta`.
    """

    rays: np.ndarray
    pixels: np.ndarray
    weights: np.ndarray
    angles: np.ndarray
    theta: float


def sampled(source: Projection, size: tuple[int, int], theta_max: float = np.inf) -> Samples:
    """Sample what a lens images.

    Args:
        source: the lens.
        size: (width, height) px of its pictures.
        theta_max: rad, the largest angle at which it is known.

    Raises:
        ValueError: no pixel of the picture is imaged.
    """
    limit = min(source.theta_max * (1 - 1e-6), theta_max)
    middle = source.project(np.array([[0.0, 0.0, 1.0]]))[0]
    to_corners = np.array([[0, 0], [0, size[1] - 1], [size[0] - 1, 0], [size[0] - 1, size[1] - 1]]) - middle
    even = np.linspace(-np.pi, np.pi, _AZIMUTHS, endpoint=False)
    directions = np.unique(np.concatenate([even, np.arctan2(to_corners[:, 1], to_corners[:, 0])]))
    for _ in range(2):  # the second time up to the angle that the picture reaches
        edges = np.linspace(0, limit, _ANGLES + 1)
        angles, azimuths = np.meshgrid([*(edges[1:] + edges[:-1]) / 2, limit], directions)
        shape, rays = angles.shape, _rays(angles.ravel(), azimuths.ravel())
        pixels = source.project(rays)
        inside = np.isfinite(pixels).all(1) & (pixels > -0.5).all(1) & (pixels < np.array(size) - 0.5).all(1)
        if not inside.any():
            raise ValueError("the lens images no pixel of the picture; check its numbers and the picture's size")
        limit = min(limit, float(angles.ravel()[inside].max()) * 1.01)
    grid = pixels.reshape(*shape, 2)
    along = np.gradient(grid, angles[0], axis=1)
    around = np.roll(grid, -1, 0) - np.roll(grid, 1, 0)
    area = np.abs(along[..., 0] * around[..., 1] - along[..., 1] * around[..., 0])
    area[:, -1] = 0.0  # the rim, which has no width
    area = np.where(inside & np.isfinite(area.ravel()), area.ravel(), 0.0)
    if not area.any():
        raise ValueError("the lens images hardly a pixel of the picture; check its numbers and the picture's size")
    flat = angles.ravel()[inside]
    return Samples(rays[inside], pixels[inside], area[inside] / area.sum(), flat, float(flat.max()))


def _rays(angles: np.ndarray, azimuths: np.ndarray) -> np.ndarray:
    sine = np.sin(angles)
    return np.stack([sine * np.cos(azimuths), sine * np.sin(azimuths), np.cos(angles)], -1)


# --- the fit ----------------------------------------------------------------------------------------------------------


class Fitted(NamedTuple):
    """A lens near another: the lens, and its distance from that one, root mean square and largest, px."""

    lens: Lens
    rms_px: float
    max_px: float


def nearest(source: Projection, kind: type[Lens], seen: Samples, held: Mapping[str, float]) -> Fitted:
    """Fit a lens of another model to a lens (weighted least squares over the field, Levenberg-Marquardt).

    Args:
        source: the lens.
        kind: a model of avcli.lens.
        seen: where to compare, from `sampled`.
        held: coefficients that keep these values.

    Returns:
        The lens; the distances are infinite where it cannot image the whole field.
    """
    start = (*kind.start, *(0.0 for _ in kind.names()))[: len(kind.names()) - 4]
    unit = kind(1.0, 1.0, 0.0, 0.0, *start)
    tiny = np.array([[1e-4, 0.0, 1.0], [0.0, 1e-4, 1.0], [0.0, 0.0, 1.0]])
    near, ours = source.project(tiny), unit.project(tiny)
    fx = (near[0, 0] - near[2, 0]) / (ours[0, 0] - ours[2, 0])
    fy = (near[1, 1] - near[2, 1]) / (ours[1, 1] - ours[2, 1])
    lens = kind(fx, fy, *near[2], **{**dict(zip(kind.names()[4:], start, strict=True)), **held})
    free = np.array([name not in held for name in kind.names()])
    thin = np.arange(len(seen.rays)) % max(1, len(seen.rays) // _FITTED) == 0
    for part in _GROWTH:
        lens = _refined(lens, seen, thin & (seen.angles <= part * seen.theta), free)
    return Fitted(lens, *distance(lens, seen))


def distance(lens: Projection, seen: Samples) -> tuple[float, float]:
    """Root mean square and largest distance, px, of a lens's pixels from those of `seen`; infinite if one lacks."""
    apart = np.linalg.norm(lens.project(seen.rays) - seen.pixels, axis=1)
    if not np.isfinite(apart).all():
        return np.inf, np.inf
    return float(np.sqrt((seen.weights * apart**2).sum())), float(apart.max())


def _refined(lens: Lens, seen: Samples, rows: np.ndarray, free: np.ndarray) -> Lens:
    rays, pixels, weights = seen.rays[rows], seen.pixels[rows], seen.weights[rows] / seen.weights[rows].sum()

    def linear(lens: Lens) -> tuple[float, np.ndarray, np.ndarray]:
        projected, _, by_parameter = lens.project_jacobian(rays)
        off, J = pixels - projected, by_parameter[..., free]
        unseen = ~(np.isfinite(off).all(1) & np.isfinite(J).all((1, 2)))
        off[unseen], J[unseen] = [_UNSEEN_PX, 0.0], 0.0
        cost = float((weights * (off**2).sum(1)).sum())
        return cost, np.einsum("nia,nib,n->ab", J, J, weights, optimize=True), np.einsum("nia,ni,n->a", J, off, weights)

    cost, H, g = linear(lens)
    damping = 1e-3
    for _ in range(_STEPS):
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * np.outer(scale, scale) + damping * np.eye(len(H))
        values = np.array(lens.parameters)
        values[free] += scale * np.linalg.lstsq(scaled, g * scale, rcond=1e-15)[0]
        moved = type(lens)(*values.tolist())
        if moved.is_possible and (found := linear(moved))[0] < cost:
            gain = cost - found[0]
            lens, (cost, H, g) = moved, found
            damping = max(damping / 8, 1e-15)
            if gain < 1e-10 * cost or cost < 1e-24:
                break
        else:
            damping *= 8
            if damping > 1e8:
                break
    return lens


# --- models that avcli.lens lacks -------------------------------------------------------------------------------------


def opencv_extended(core: np.ndarray, d: np.ndarray) -> Foreign:
    """OpenCV's model with thin prisms and a tilted sensor.

    Args:
        core: (4,) fx, fy, cx, cy px.
        d: (14,) k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 and the tilts tx, ty (rad).

    Source: OpenCV, calib3d; the tilt after Louhichi et al. (2007).
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = d
    Rx = np.array([[1, 0, 0], [0, np.cos(tx), np.sin(tx)], [0, -np.sin(tx), np.cos(tx)]])
    Ry = np.array([[np.cos(ty), 0, -np.sin(ty)], [0, 1, 0], [np.sin(ty), 0, np.cos(ty)]])
    R = Ry @ Rx
    tilt = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R

    def pixels(points: np.ndarray) -> np.ndarray:
        x, y = (points[:, i] / points[:, 2] for i in (0, 1))
        t = x * x + y * y
        radial = (1 + t * (k1 + t * (k2 + t * k3))) / (1 + t * (k4 + t * (k5 + t * k6)))
        u = x * radial + 2 * p1 * x * y + p2 * (t + 2 * x * x) + t * (s1 + t * s2)
        v = y * radial + p1 * (t + 2 * y * y) + 2 * p2 * x * y + t * (s3 + t * s4)
        tilted = np.stack([u, v, np.ones_like(u)], -1) @ tilt.T
        return core[2:] + core[:2] * tilted[:, :2] / tilted[:, 2:]

    return up_to_fold(Foreign("OpenCV with thin prisms and tilt", pixels, np.deg2rad(89.0)))


def fov(core: np.ndarray, omega: float) -> Foreign:
    """The field-of-view model of Devernay and Faugeras (2001), Straight lines have to be straight, eq. 13."""

    def pixels(points: np.ndarray) -> np.ndarray:
        r = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(2 * r * np.tan(omega / 2), points[:, 2]) / omega
        factor = np.where(r > 1e-12, angle / r, 2 * np.tan(omega / 2) / omega / points[:, 2])
        return core[2:] + core[:2] * points[:, :2] * factor[:, None]

    return Foreign("FOV", pixels, np.pi / 2)


def omni(core: np.ndarray, xi: float, d: np.ndarray) -> Foreign:
    """The omnidirectional model of Mei and Rives (2007), Single view point omnidirectional camera calibration.

    Args:
        core: (4,) generalised focal lengths and principal point, px.
        xi: distance of the second centre.
        d: (4,) k1 k2 p1 p2, OpenCV's plain distortion of the point on the plane.
    """
    k1, k2, p1, p2 = d

    def pixels(points: np.ndarray) -> np.ndarray:
        below = points[:, 2] + xi * np.linalg.norm(points, axis=1)
        x, y = (points[:, i] / np.where(below > 0, below, np.nan) for i in (0, 1))
        t = x * x + y * y
        radial = 1 + t * (k1 + t * k2)
        u = x * radial + 2 * p1 * x * y + p2 * (t + 2 * x * x)
        v = y * radial + p1 * (t + 2 * y * y) + 2 * p2 * x * y
        return np.stack([core[2] + core[0] * u, core[3] + core[1] * v], -1)

    return up_to_fold(Foreign("omni with distortion", pixels, np.arccos(-1 / xi) if xi > 1 else np.arccos(-xi)))


# --- mrcal's splined stereographic model ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Splined:
    """mrcal's LENSMODEL_SPLINED_STEREOGRAPHIC of order 3: q = c + f (u + du(u)), u = 2 tan(theta / 2) (x, y) / r.

    du is a surface of uniform cubic B-splines whose knots are evenly spaced in u, the middle one at u = 0, and which
    spans `fov_deg` along x between the second knots from either end.

    Attributes:
        core: (4,) f_x, f_y, c_x, c_y px.
        knots: (Ny, Nx, 2) the control values of du.
        fov_deg: whole degrees.

    Source: mrcal 2.2, the documentation of its splined models.
    """

    core: np.ndarray
    knots: np.ndarray
    fov_deg: int

    @property
    def per_unit(self) -> float:
        """Knot intervals in one unit of u."""
        return (self.knots.shape[1] - 3) / (4 * np.tan(np.deg2rad(self.fov_deg) / 4))

    @property
    def theta_max(self) -> float:
        """The largest angle within the knots, rad; it is that of their corners."""
        intervals = np.array(self.knots.shape[:2]) - 3
        return float(2 * np.arctan(np.hypot(*intervals) / 2 / self.per_unit / 2))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3); NaN beyond the knots."""
        u = stereographic(points)
        places, weights = self.basis(u)
        moved = u + np.einsum("nk,nkc->nc", weights, self.knots.reshape(-1, 2)[places])
        return self.core[2:] + self.core[:2] * moved

    def basis(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The 16 knots around each u (n, 2) as flat indices (n, 16), and their weights; NaN beyond the knots."""
        count = np.array(self.knots.shape[1::-1])
        at = u * self.per_unit + (count - 1) / 2
        with np.errstate(invalid="ignore"):
            within: np.ndarray = (at > 1 - 1e-9) & (at < count - 2 + 1e-9)
        beyond = np.logical_not(np.all(within, axis=1))
        at = np.where(beyond[:, None], 1.0, at)
        cell = np.clip(np.floor(at).astype(int), 1, count - 3)
        wx, wy = (_cubic_weights(at[:, i] - cell[:, i]) for i in (0, 1))
        steps = np.arange(-1, 3)
        columns, rows = cell[:, 0, None] + steps, cell[:, 1, None] + steps
        places = rows[:, :, None] * count[0] + columns[:, None, :]
        weights = (wy[:, :, None] * wx[:, None, :]).reshape(-1, 16)
        return places.reshape(-1, 16), np.where(beyond[:, None], np.nan, weights)


def _cubic_weights(s: np.ndarray) -> np.ndarray:
    """Weights (n, 4) of a uniform cubic B-spline's four control values at s (n,) in [0, 1]."""
    return np.stack([(1 - s) ** 3, 3 * s**3 - 6 * s**2 + 4, -3 * s**3 + 3 * s**2 + 3 * s + 1, s**3], -1) / 6


def stereographic(points: np.ndarray) -> np.ndarray:
    """u = 2 tan(theta / 2) (x, y) / r of points (n, 3): (n, 2)."""
    length = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return 2 * points[:, :2] / (length + points[:, 2])[:, None]


_MOST_ROWS = 150
"""of knots, with 30 in each: a view five times as high as it is wide."""


def splined(source: Projection, seen: Samples, across: int = 30) -> tuple[Splined, float, float]:
    """mrcal's splined model of a lens, by linear least squares, and its distance from it (`distance`).

    Args:
        source: the lens.
        seen: where it is known, from `sampled`.
        across: knots along x.

    Raises:
        ValueError: the view is so much higher than wide that the knots would be too many.
    """
    near = source.project(np.array([[1e-4, 0.0, 1.0], [0.0, 1e-4, 1.0], [0.0, 0.0, 1.0]]))
    core = np.array([(near[0, 0] - near[2, 0]) / 1e-4, (near[1, 1] - near[2, 1]) / 1e-4, *near[2]])
    reach = np.abs(stereographic(seen.rays)).max(0)
    fov_deg = int(np.ceil(np.rad2deg(4 * np.arctan(reach[0] / 2)) + 0.5))
    shape = Splined(core, np.zeros((4, across, 2)), fov_deg)
    rows = int(np.ceil(2 * reach[1] * shape.per_unit * 1.01)) + 3
    if rows > _MOST_ROWS:
        raise ValueError(
            f"mrcal's splined model would need {rows} rows of knots; the view is too high and narrow for it"
        )
    shape = replace(shape, knots=np.zeros((rows, across, 2)))
    # Three points an interval of the knots.
    u, v = (np.linspace(-side, side, int(6 * side * shape.per_unit) + 6) for side in reach)
    flat = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    t = (flat**2).sum(1) / 4
    rays = np.column_stack([flat, 1 - t]) / (1 + t)[:, None]
    pixels = source.project(rays)
    margin = 0.02 * np.ptp(seen.pixels, axis=0)
    low, high = seen.pixels.min(0) - margin, seen.pixels.max(0) + margin
    with np.errstate(invalid="ignore"):
        good = ((pixels > low) & (pixels < high)).all(1)
    rays, pixels, flat = (np.concatenate(pair) for pair in ((rays[good], seen.rays), (pixels[good], seen.pixels),
                                                            (flat[good], stereographic(seen.rays))))  # fmt: skip
    places, weights = shape.basis(flat)
    design = np.zeros((len(flat), rows * across))
    np.put_along_axis(design, places, weights, axis=1)
    # Knots that no ray touches follow their neighbours.
    smooth = 1e-6 * _second_differences(rows, across)
    wanted = (pixels - core[2:]) / core[:2] - flat
    normal = design.T @ design + smooth.T @ smooth
    shape = replace(
        shape, knots=np.linalg.solve(normal + 1e-15 * np.eye(len(normal)), design.T @ wanted).reshape(rows, across, 2)
    )
    return shape, *distance(shape, seen)


def _second_differences(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    out = []
    for a, b, c in ((index[:, :-2], index[:, 1:-1], index[:, 2:]), (index[:-2], index[1:-1], index[2:])):
        block = np.zeros((a.size, index.size))
        row = np.arange(a.size)
        block[row, a.ravel()], block[row, b.ravel()], block[row, c.ravel()] = 1.0, -2.0, 1.0
        out.append(block)
    return np.concatenate(out)
