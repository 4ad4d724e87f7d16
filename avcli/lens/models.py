"""The lens models: what all share, two families, and one short class a model. `avcli.lens` names them.

All are radial: the distance of a pixel from the centre depends on the angle of its ray alone; `avcli.lens.tangential`
adds to them what is not. Across the axis a point lies in the direction e = (x, y) / r; the lens takes a variable s of
the ray (its angle, or its slope) to a radius m in the image plane, and the pixel is c + scale * m e.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cache, cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from avcli.lens.radial import (
    KNOTS,
    Radial,
    cubics,
    first_sign_change,
    fold_of_odd_polynomial,
    odd_polynomial,
    odd_powers,
)

_FINE_KNOTS = 8192  # of a table that no Newton step follows
_FOLD_KNOTS = 8  # of it next to a fold, where slopes are known less well
FARTHEST_SLOPE = 1e8  # of a ray that a perspective lens images: 1e-8 rad short of 90 degrees
_CHUNK = 1 << 14  # samples of an inversion that stay in the cache together
_PIXELS = ("fx", "fy", "cx", "cy")
_SIZE = ("width", "height")  # fields of a model that depends on the image's size: no parameters


class Across(NamedTuple):
    """Where points lie across the axis: x, y and their length r, the lens's variable s, and whether it images them."""

    x: np.ndarray
    y: np.ndarray
    r: np.ndarray
    s: np.ndarray
    seen: np.ndarray

    @property
    def direction(self) -> tuple[np.ndarray, np.ndarray]:
        """The unit vector e = (x, y) / r, 0 on the axis."""
        return np.where(self.r > 0, self.x / self.r, 0.0), np.where(self.r > 0, self.y / self.r, 0.0)


# --- what all lenses share --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lens(ABC):
    """A radial lens; the base of all models.

    Attributes:
        fx, fy: focal lengths, px.
        cx, cy: where the axis meets the image, px.
        text: of each model in `LENSES`, what it is: a few words for the schema and the manual.
        start: of each model, coefficients of a lens from which a fit may start; missing ones are 0.
        leading: of each model, the coefficient that a fit frees before the others.

    A model adds its own coefficients, without unit, as further fields. One with a default of 0 may be left out of
    config.json; one without a default may not.
    """

    text: ClassVar[str]
    start: ClassVar[tuple[float, ...]] = ()
    leading: ClassVar[str] = "k1"
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names of the parameters, in order: fx, fy, cx, cy, and the coefficients of the model."""
        return _names(cls)

    @classmethod
    def keys(cls) -> tuple[str, ...]:
        """The keys of the parameters in camera_config, in the order of `names`: fx_px, fy_px, cx_px, cy_px, k1, ..."""
        return tuple(f"{name}_px" if name in _PIXELS else name for name in cls.names())

    @classmethod
    def needed_keys(cls) -> tuple[str, ...]:
        """Those of `keys` that camera_config must have; the others are 0 where they are absent."""
        needed = {field.name for field in fields(cls) if field.default is MISSING}
        return tuple(key for name, key in zip(cls.names(), cls.keys(), strict=True) if name in needed)

    @classmethod
    def of_image(cls, parameters: Sequence[float], width: float, height: float) -> "Lens":
        """Make the lens from its parameters in the order of `names`; the image size in px matters to some models."""
        return cls(*parameters)

    @property
    def parameters(self) -> tuple[float, ...]:
        """The values of the parameters, in the order of `names`."""
        return tuple(getattr(self, name) for name in self.names())

    @property
    def is_possible(self) -> bool:
        """Whether the parameters are within the bounds of the model, so that the lens images anything."""
        return self.fx > 0 and self.fy > 0

    def project(self, points: ArrayLike) -> np.ndarray:
        """Project points to pixels.

        Args:
            points: (..., 3) in the camera frame, in any unit of length.

        Returns:
            (..., 2) px; NaN where the lens does not image the point.
        """
        return np.stack(self.image(*columns(points, 3)), -1)

    def image(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points whose x, y and z (...) are apart, as `project`, to columns and rows (...) px."""
        x, y, r, s, seen = self._across(x, y, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(r > 0, self._radius(s)[0] / r, 1.0)
        scale_x, scale_y = self.scale_px
        return _where_seen(seen, self.cx + scale_x * factor * x, self.cy + scale_y * factor * y)

    def unproject(self, pixels: ArrayLike) -> np.ndarray:
        """Turn pixels into rays.

        Args:
            pixels: (..., 2) px.

        Returns:
            (..., 3) unit vectors in the camera frame; NaN where the lens images nothing.
        """
        u, v = columns(pixels, 2)
        rays = np.empty((u.size, 3))
        flat_u, flat_v = u.reshape(-1), v.reshape(-1)
        scale_x, scale_y = self.scale_px
        for start in range(0, u.size, _CHUNK):
            piece = slice(start, start + _CHUNK)
            mx, my = (flat_u[piece] - self.cx) / scale_x, (flat_v[piece] - self.cy) / scale_y
            rays[piece] = self._rays(mx, my, np.sqrt(mx * mx + my * my))
        return rays.reshape(*u.shape, 3)

    def project_jacobian(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project points and differentiate.

        Args:
            points: (..., 3) in the camera frame, in any unit of length.

        Returns:
            Pixels (..., 2), their derivatives to the point (..., 2, 3) in px per unit of length, and to the parameters
            of `names` (..., 2, len(names)); NaN where the lens does not image the point.
        """
        x, y, z = columns(points, 3)
        across = self._across(x, y, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            m, slope = self._radius(across.s)
            ex, ey = across.direction
            factor, rows_x, rows_y = self._by_point(across, z, ex, ey, m, slope)
            by_k = self._by_coefficients(across.s)
            mx, my = across.x * factor, across.y * factor
            scale = self.scale_px
            pixels = np.stack(_where_seen(across.seen, self.cx + scale[0] * mx, self.cy + scale[1] * my), -1)
            by_point = np.empty((*across.seen.shape, 2, 3))
            for axis, rows in enumerate((rows_x, rows_y)):
                for i, row in enumerate(rows):
                    np.multiply(row, scale[axis], out=by_point[..., axis, i])
            by_parameter = np.zeros((*across.seen.shape, 2, len(self.names())))
            by_parameter[..., 0, 2] = by_parameter[..., 1, 3] = 1.0
            by_parameter[..., :2] = self._by_focal_lengths(x, y, mx, my, by_point)
            for i, k in enumerate(by_k, 4):
                np.multiply(scale[0] * ex, k, out=by_parameter[..., 0, i])
                np.multiply(scale[1] * ey, k, out=by_parameter[..., 1, i])
        if not across.seen.all():
            by_point[~across.seen] = by_parameter[~across.seen] = np.nan
        return pixels, by_point, by_parameter

    def project_clamped(self, points: np.ndarray) -> np.ndarray:
        """Project points (..., 3), those outside the field of view from the field's edge nearest to them; (..., 2)."""
        x, y, z = np.moveaxis(points, -1, 0)
        r = np.hypot(x, y)
        theta = np.minimum(np.arctan2(r, z), self.theta_max * (1 - 1e-9))
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(r > 0, np.sin(theta) / r, 0.0)
        return self.project(np.stack([x * factor, y * factor, np.cos(theta)], -1))

    # What a model, or its family, says of itself

    @property
    @abstractmethod
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad."""

    @property
    @abstractmethod
    def radius_max(self) -> float:
        """Radius of the imaged field in the image plane, in units of `scale_px` (infinite fields: 1e8 and more)."""

    @property
    def scale_px(self) -> tuple[float, float]:
        """Pixels of one unit of the image plane, across and down: the focal lengths."""
        return self.fx, self.fy

    @property
    @abstractmethod
    def _radial(self) -> Radial:
        """The radius m in the image plane as a function of the variable s of the ray, and its inverse."""

    @abstractmethod
    def _across(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Across: ...

    @abstractmethod
    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radius m in the image plane of the variable s, and dm/ds."""

    @abstractmethod
    def _rays(self, mx: np.ndarray, my: np.ndarray, m: np.ndarray) -> np.ndarray:
        """Unit rays (n, 3) of points (mx, my) of the image plane, of length m."""

    @abstractmethod
    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        """Derivatives of m to the model's radial coefficients, in their order, at the variable s."""

    @abstractmethod
    def _by_point(
        self, across: Across, z: np.ndarray, ex: np.ndarray, ey: np.ndarray, m: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """m / r, and the derivatives of the image plane's x and y to the point's x, y and z."""

    def _by_focal_lengths(
        self, x: np.ndarray, y: np.ndarray, mx: np.ndarray, my: np.ndarray, by_point: np.ndarray
    ) -> np.ndarray:
        """Derivatives (..., 2, 2) of the pixel to fx and fy."""
        out = np.zeros((*mx.shape, 2, 2))
        out[..., 0, 0], out[..., 1, 1] = mx, my
        return out

    # What the shaders need of it (avcli.lens.shader)

    @property
    def radial(self) -> "Lens":
        """The same lens without tangential terms."""
        return self

    @property
    def tangential_terms(self) -> tuple[float, float, float, float]:
        """px, py, ax, ay of T(q) = |q|^2 a + 2 (p . q) q (see avcli.lens.tangential)."""
        return 0.0, 0.0, 0.0, 0.0

    @property
    def slopes_per_unit(self) -> tuple[float, float]:
        """Slopes x / z, y / z of one unit of the undistorted image, where the shader's rays are counted in that."""
        return 1.0, 1.0

    @property
    def is_bounded(self) -> bool:
        """Whether the field ends at a rectangle of the undistorted image."""
        return False

    @property
    @abstractmethod
    def has_fold(self) -> bool:
        """Whether the ray goes as a square root of the radius at `radius_max`."""

    def ray_parts(self, m: np.ndarray) -> np.ndarray:
        """Lateral part over m, and axial part, (n, 2), of the rays at radii m (n,) > 0 of the image plane."""
        pixels = np.stack([self.cx + self.fx * m * (1 - 1e-13), np.full_like(m, self.cy)], -1)
        rays = self.unproject(pixels)
        return np.stack([rays[:, 0] / m, rays[:, 2]], -1)


@dataclass(frozen=True)
class Angular(Lens):
    """A lens whose image radius is a function of the ray's angle from the axis: fisheyes.

    A model gives `theta_max`, `_radius` (m and dm/dtheta of angles in rad) and `_by_coefficients`.
    """

    @cached_property
    def _radial(self) -> Radial:
        return Radial(self._radius, self.theta_max)

    @property
    def radius_max(self) -> float:
        return self._radial.y_max

    @cached_property
    def has_fold(self) -> bool:
        return float(self._radius(np.asarray(self.theta_max))[1]) < 1e-6

    def _across(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Across:
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        return Across(x, y, r, theta, (theta <= self.theta_max) & ((r > 0) | (z > 0)))

    def _rays(self, mx: np.ndarray, my: np.ndarray, m: np.ndarray) -> np.ndarray:
        if m.size < KNOTS or self._half_sines is None:
            theta = self._radial.inverse(m)
            sine, cosine = np.sin(theta), np.cos(theta)
        else:
            square = self._half_sine(self._half_sines, m) ** 2
            sine, cosine = 2 * np.sqrt(square - square * square), 1 - 2 * square
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = sine / m
        scale[m < 1e-12] = 1.0
        rays = np.empty((*m.shape, 3))
        np.multiply(mx, scale, out=rays[..., 0])
        np.multiply(my, scale, out=rays[..., 1])
        rays[..., 2] = cosine
        return rays

    @cached_property
    def _half_sines(self) -> np.ndarray | None:
        """Cubics (knots, 4) of sin(theta / 2) in the variable of the inverse's table; None where they are no good.

        Towards 180 degrees the cosine cannot be had from the sine.
        """
        if self._radial.goes_far or self.theta_max > 3.0:
            return None
        theta, slope = self._radial.knots(_FINE_KNOTS)
        return cubics(np.sin(0.5 * theta), 0.5 * np.cos(0.5 * theta) * slope)

    def _half_sine(self, table: np.ndarray, m: np.ndarray) -> np.ndarray:
        """sin(theta / 2) of radii m (n,) in the image plane: no Newton step and no cosine, 1e-13 from exact."""
        with np.errstate(invalid="ignore"):
            w = np.sqrt(1 - m / self._radial.y_max)
        w *= _FINE_KNOTS
        outside = ~(w >= 0)
        w[outside] = 0.0
        index = np.minimum(w.astype(np.intp), _FINE_KNOTS - 1)
        w -= index
        c = np.take(table, index, axis=0)
        half = ((c[:, 3] * w + c[:, 2]) * w + c[:, 1]) * w + c[:, 0]
        half[outside] = np.nan
        near_fold = (index < _FOLD_KNOTS) & ~outside
        if near_fold.any():
            half[near_fold] = np.sin(0.5 * self._radial.inverse(m[near_fold]))
        return half

    def _by_point(
        self, across: Across, z: np.ndarray, ex: np.ndarray, ey: np.ndarray, m: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        x, y, r, _, _ = across
        square = r * r + z * z
        factor = np.where(r > 0, m / r, slope / z)
        outward = slope * z / square  # dm/dr at constant z
        xy = ex * ey * (outward - factor)
        rows_x = [factor + ex * ex * (outward - factor), xy, -x * slope / square]
        rows_y = [xy, factor + ey * ey * (outward - factor), -y * slope / square]
        return factor, rows_x, rows_y


@dataclass(frozen=True)
class Perspective(Lens):
    """A lens whose image radius is a function of the slope hypot(x, y) / z: what lies at or behind 90 degrees is lost.

    A model gives `_slope_max`, `_radius` (m and dm/ds of slopes) and `_by_coefficients`. Slopes may be counted in units
    of `slopes_per_unit`.
    """

    @property
    @abstractmethod
    def _slope_max(self) -> float:
        """The largest slope that is imaged: the fold, else `FARTHEST_SLOPE`."""

    @cached_property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad: the fold, else all but 1e-8 rad of 90 degrees."""
        return math.atan(self._slope_max)

    @property
    def radius_max(self) -> float:
        return self._radial.y_max

    @property
    def has_fold(self) -> bool:
        return True

    @cached_property
    def _radial(self) -> Radial:
        return Radial(self._radius, self._slope_max)

    def _slope(self, m: np.ndarray) -> np.ndarray:
        """Slope of radii m (n,) in the image plane; NaN beyond the field."""
        return self._radial.inverse(m)

    def _across(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Across:
        unit_x, unit_y = self.slopes_per_unit
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = np.where(z > 0, z, np.nan)
            x, y = x / (unit_x * ahead), y / (unit_y * ahead)
            r = np.sqrt(x * x + y * y)
            seen = r <= self._slope_max
            if self.is_bounded:
                seen &= (np.abs(x) <= 1) & (np.abs(y) <= 1)
        return Across(x, y, r, r, seen)

    def _rays(self, mx: np.ndarray, my: np.ndarray, m: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(m == 0, 1.0, self._slope(m) / m)
            x, y = mx * factor, my * factor
            if self.is_bounded:
                inside = (np.abs(x) <= 1) & (np.abs(y) <= 1)
                x, y = np.where(inside, x, np.nan), np.where(inside, y, np.nan)
        unit_x, unit_y = self.slopes_per_unit
        x, y = unit_x * x, unit_y * y
        length = np.sqrt(1 + x * x + y * y)
        return np.stack([x / length, y / length, 1 / length], -1)

    def _by_point(
        self, across: Across, z: np.ndarray, ex: np.ndarray, ey: np.ndarray, m: np.ndarray, slope: np.ndarray
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        x, y, r, _, _ = across
        factor = np.where(r > 0, m / r, slope)
        bend = slope - factor
        xx, xy, yy = factor + ex * ex * bend, ex * ey * bend, factor + ey * ey * bend
        dx, dy = (1.0 / (unit * z) for unit in self.slopes_per_unit)
        rows_x = [xx * dx, xy * dy, -(xx * x + xy * y) / z]
        rows_y = [xy * dx, yy * dy, -(xy * x + yy * y) / z]
        return factor, rows_x, rows_y


# --- the models -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FourTerms(Lens):
    """What the models with a radial polynomial of four terms share: its coefficients k1, k2, k3, k4."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def radial_terms(self) -> tuple[float, float, float, float]:
        """k1, k2, k3, k4."""
        return self.k1, self.k2, self.k3, self.k4


@dataclass(frozen=True)
class KannalaBrandt(FourTerms, Angular):
    """The KB-8 fisheye of OpenCV: u = fx d(theta) x / r + cx, d = theta (1 + k1 theta^2 + ... + k4 theta^8).

    Source: Kannala and Brandt (2006), A generic camera model and calibration method, eq. 6, as cv2.fisheye has it.
    """

    text = "OpenCV's fisheye (KB-8)"

    @cached_property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad: where d(theta) stops growing, at most pi."""
        return min(fold_of_odd_polynomial(*self.radial_terms), math.pi)

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return odd_polynomial(s, *self.radial_terms)

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        return odd_powers(s)


@dataclass(frozen=True)
class BrownConrady(FourTerms, Perspective):
    """Perspective with four radial terms: u = fx x' (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + cx, x' = x / z.

    All four terms are radial (OpenCV's order k1, k2, p1, p2 differs). Where the polynomial folds (k1 = -0.2: r = 1.29,
    52 degrees) the lens ends: beyond, two rays share a pixel.

    Source: Brown (1966), Decentering distortion of lenses.
    """

    text = "an ordinary lens with four radial terms"

    @cached_property
    def _slope_max(self) -> float:
        return min(fold_of_odd_polynomial(*self.radial_terms), FARTHEST_SLOPE)

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return odd_polynomial(s, *self.radial_terms)

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        return odd_powers(s)


@dataclass(frozen=True)
class Division(FourTerms, Perspective):
    """The virtual lens of the thesis, Listing .3: a pinhole image pulled through x_u = x_d / (1 + k1 r_d^2 + ...).

    fx, fy, cx, cy are those of the pinhole image; width and height in px are those of both images. x_d and x_u are
    counted in half widths (horizontally) and half heights (vertically) from (cx, cy). The listing paints black what
    lies outside the pinhole image; here it is NaN.

    Source: Fitzgibbon (2001), Simultaneous linear estimation of multiple view geometry and lens distortion.
    """

    text = "the thesis's shader"

    width: float = 1920
    height: float = 1080

    @classmethod
    def of_image(cls, parameters: Sequence[float], width: float, height: float) -> "Division":
        fx, fy, cx, cy, k1, k2, k3, k4 = parameters
        return cls(fx, fy, cx, cy, k1, k2, k3, k4, width, height)

    @cached_property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad: a corner of the pinhole image, or the fold."""
        across, down = self.slopes_per_unit
        if math.hypot(1, 1) <= self._slope_max:
            return math.atan(math.hypot(across, down))
        return math.atan(self._slope_max * max(across, down))

    @property
    def radius_max(self) -> float:
        """Radius of the invertible field in half image sizes; what the pinhole image holds may end before."""
        return self._radial.s_max

    @property
    def scale_px(self) -> tuple[float, float]:
        return 0.5 * self.width, 0.5 * self.height

    @property
    def slopes_per_unit(self) -> tuple[float, float]:
        return 0.5 * self.width / self.fx, 0.5 * self.height / self.fy

    @property
    def is_bounded(self) -> bool:
        return True

    @property
    def has_fold(self) -> bool:
        return False  # the ray is a closed formula of the pixel

    @property
    def _slope_max(self) -> float:
        return self._radial.y_max

    @cached_property
    def _radial(self) -> Radial:
        """The undistorted radius as a function of the image's."""
        fold = first_sign_change([1.0, -self.k1, -3 * self.k2, -5 * self.k3, -7 * self.k4])
        pole = first_sign_change([1.0, *self.radial_terms])
        limit = math.sqrt(min(fold, pole))
        return Radial(self._undistorted, limit, math.inf if pole <= fold else None)

    def _denominator(self, m: np.ndarray) -> np.ndarray:
        t = m * m
        return 1 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4)))

    def _undistorted(self, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t = m * m
        bottom = self._denominator(m)
        top = 1 - t * (self.k1 + t * (3 * self.k2 + t * (5 * self.k3 + t * 7 * self.k4)))
        return m / bottom, top / (bottom * bottom)

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        m = self._radial.inverse(s)
        with np.errstate(invalid="ignore", divide="ignore"):
            return m, 1.0 / self._undistorted(m)[1]

    def _slope(self, m: np.ndarray) -> np.ndarray:
        return np.where(m < self._radial.s_max, m / self._denominator(m), np.nan)

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        m = self._radial.inverse(s)
        steepness = self._denominator(m) ** 2 * self._undistorted(m)[1]
        return [m ** (2 * n + 1) / steepness for n in (1, 2, 3, 4)]

    def _by_focal_lengths(
        self, x: np.ndarray, y: np.ndarray, mx: np.ndarray, my: np.ndarray, by_point: np.ndarray
    ) -> np.ndarray:
        return by_point[..., :2] * np.stack([x / self.fx, y / self.fy], -1)[..., None, :]

    def project_clamped(self, points: np.ndarray) -> np.ndarray:
        """Project points (..., 3), those outside the pinhole image from its edge nearest to them; (..., 2) px."""
        x, y, z = np.moveaxis(points, -1, 0)
        ahead = np.maximum(z, 1e-6 * (np.hypot(x, y) + 1e-12))
        across, down = self.slopes_per_unit
        x, y = np.clip(x / ahead, -across, across), np.clip(y / ahead, -down, down)
        return self.project(np.stack([x, y, np.ones_like(x)], -1) * (1 - 1e-12 * np.array([1, 1, 0])))

    def ray_parts(self, m: np.ndarray) -> np.ndarray:
        """Undistorted over distorted radius, and 1, (n, 2), at radii m (n,): the shader scales them to a unit ray."""
        return np.stack([1.0 / self._denominator(m * (1 - 1e-9)), np.ones_like(m)], -1)


@cache
def _names(kind: type[Lens]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind) if field.name not in _SIZE)


# --- arrays -----------------------------------------------------------------------------------------------------------


def columns(array: ArrayLike, width: int) -> np.ndarray:
    """The columns of an array (..., width): (width, ...)."""
    array = np.asarray(array, float)
    if array.shape[-1:] != (width,):
        raise ValueError(f"expected an array of shape (n, {width}), got {array.shape}")
    return np.moveaxis(array, -1, 0)


def _where_seen(seen: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (u, v) if seen.all() else (np.where(seen, u, np.nan), np.where(seen, v, np.nan))
