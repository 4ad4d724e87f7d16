"""Lens models, exact both ways: Kannala-Brandt (OpenCV's fisheye), Brown-Conrady, and the thesis's division model.

A lens maps points in the camera frame (x right, y down, z forward) to pixels, (0, 0) being the centre of the top-left
one. Angles from the optical axis are atan2(hypot(x, y), z), so that rays at and beyond 90 degrees are legal, and what
a lens does not image is NaN. Every model here is radial: one strictly increasing function g of one variable s, inverted
once per lens into a table that one Newton step makes exact.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

_KNOTS = 1024
_FINE_KNOTS = 8192  # of a table that no Newton step follows
_FOLD_KNOTS = 8  # of it next to a fold, where slopes are known less well
_FARTHEST_SLOPE = 1e8  # of a ray that a perspective lens images: 1e-8 rad short of 90 degrees
_CHUNK = 1 << 14  # samples of an inversion that stay in the cache together


@dataclass(frozen=True)
class KannalaBrandt:
    """The KB-8 fisheye of OpenCV: u = fx d(theta) x / r + cx, d = theta (1 + k1 theta^2 + ... + k4 theta^8).

    fx, fy, cx, cy in pixels; k1..k4 without unit. Kannala and Brandt (2006), eq. 6, as cv2.fisheye has it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @cached_property
    def theta_max(self):
        """The largest angle from the axis that is imaged, in radians: where d(theta) stops growing, at most pi."""
        slope = [1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4]
        return min(math.sqrt(_first_sign_change(slope)), math.pi)

    @cached_property
    def _radial(self):
        return _Radial(lambda s: _odd_polynomial(s, self.k1, self.k2, self.k3, self.k4), self.theta_max)

    @property
    def radius_max(self):
        """Radius of the imaged field in the image plane of focal length 1 (infinite fields: 1e8 and more)."""
        return self._radial.y_max

    def project(self, points):
        """Project points (n, 3) of the camera frame, any length unit, to pixels (n, 2); NaN where not imaged."""
        x, y, z = _columns(points, 3)
        r, theta, seen = self._angles(x, y, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r > 0, self._radial.g(theta)[0] / r, 1.0)
        return _where_seen(seen, self.cx + self.fx * scale * x, self.cy + self.fy * scale * y)

    def unproject(self, pixels):
        """Turn pixels (n, 2) into unit rays (n, 3) of the camera frame; NaN where the lens images nothing."""
        return _piecewise(self._rays, pixels)

    def _rays(self, u, v):
        mx, my = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        m = np.sqrt(mx * mx + my * my)
        if m.size < _KNOTS or self._half_sines is None:
            theta = self._radial.inverse(m)
            sine, cosine = np.sin(theta), np.cos(theta)
        else:
            square = self._half_sine(m) ** 2
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
    def _half_sines(self):
        """Cubics (knots, 4) of sin(theta / 2) in the variable of the inverse's table; None where they are no good.

        Towards 180 degrees the cosine cannot be had from the sine.
        """
        if self._radial.goes_far or self.theta_max > 3.0:
            return None
        theta, slope = self._radial.knots(_FINE_KNOTS)
        return _cubics(np.sin(0.5 * theta), 0.5 * np.cos(0.5 * theta) * slope)

    def _half_sine(self, m):
        """sin(theta / 2) of radii m (n,) in the image plane: no Newton step and no cosine, 1e-13 from exact."""
        with np.errstate(invalid="ignore"):
            w = np.sqrt(1 - m / self._radial.y_max)
        w *= _FINE_KNOTS
        outside = ~(w >= 0)
        w[outside] = 0.0
        index = np.minimum(w.astype(np.intp), _FINE_KNOTS - 1)
        w -= index
        c = np.take(self._half_sines, index, axis=0)
        half = ((c[:, 3] * w + c[:, 2]) * w + c[:, 1]) * w + c[:, 0]
        half[outside] = np.nan
        near_fold = (index < _FOLD_KNOTS) & ~outside
        if near_fold.any():
            half[near_fold] = np.sin(0.5 * self._radial.inverse(m[near_fold]))
        return half

    def project_jacobian(self, points):
        """Project points (n, 3) and differentiate; NaN where not imaged.

        Returns pixels (n, 2), their derivatives to the point (n, 2, 3) in px per unit of length, and to the
        parameters fx, fy, cx, cy, k1..k4 (n, 2, 8).
        """
        x, y, z = _columns(points, 3)
        r, theta, seen = self._angles(x, y, z)
        d, slope = self._radial.g(theta)
        square = r * r + z * z
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r > 0, d / r, 1.0 / z)
            ex, ey = np.where(r > 0, x / r, 0.0), np.where(r > 0, y / r, 0.0)
            across = slope * z / square  # d(d(theta)) / dr at constant z
            dxy = ex * ey * (across - scale)
            rows_x = [scale + ex * ex * (across - scale), dxy, -x * slope / square]
            rows_y = [dxy, scale + ey * ey * (across - scale), -y * slope / square]
            powers = [theta**n for n in (3, 5, 7, 9)]
        return _assemble(
            self, seen, x * scale, y * scale, rows_x, rows_y, [ex * p for p in powers], [ey * p for p in powers]
        )

    def _angles(self, x, y, z):
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        return r, theta, (theta <= self.theta_max) & ((r > 0) | (z > 0))


@dataclass(frozen=True)
class BrownConrady:
    """Perspective with four radial terms: u = fx x' (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + cx, x' = x / z.

    fx, fy, cx, cy in pixels; k1..k4 without unit, all radial (OpenCV's order k1, k2, p1, p2 differs). Brown (1966).
    Where the polynomial folds (k1 = -0.2: r = 1.29, 52 degrees) the lens ends: beyond, two rays share a pixel.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @cached_property
    def theta_max(self):
        """The largest angle from the axis that is imaged, in radians: the fold, else all but 1e-8 rad of 90 degrees."""
        return math.atan(self._radial.s_max)

    @cached_property
    def _radial(self):
        slope = [1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4]
        fold = math.sqrt(_first_sign_change(slope))
        return _Radial(lambda s: _odd_polynomial(s, self.k1, self.k2, self.k3, self.k4), min(fold, _FARTHEST_SLOPE))

    @property
    def radius_max(self):
        """Radius of the imaged field in the image plane of focal length 1 (infinite fields: 1e8 and more)."""
        return self._radial.y_max

    def project(self, points):
        """Project points (n, 3) of the camera frame, any length unit, to pixels (n, 2); NaN where not imaged."""
        x, y, square, seen = self._slopes(points)
        scale = self._factor(square)[0]
        return _where_seen(seen, self.cx + self.fx * scale * x, self.cy + self.fy * scale * y)

    def unproject(self, pixels):
        """Turn pixels (n, 2) into unit rays (n, 3) of the camera frame; NaN where the lens images nothing."""
        return _piecewise(self._rays, pixels)

    def _rays(self, u, v):
        mx, my = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        m = np.sqrt(mx * mx + my * my)
        r = self._radial.inverse(m)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(m == 0, 1.0, r / m)
        return _unit(mx * scale, my * scale)

    def project_jacobian(self, points):
        """Project points (n, 3) and differentiate; NaN where not imaged.

        Returns pixels (n, 2), their derivatives to the point (n, 2, 3) in px per unit of length, and to the
        parameters fx, fy, cx, cy, k1..k4 (n, 2, 8).
        """
        x, y, square, seen = self._slopes(points)
        z = _columns(points, 3)[2]
        scale, rate = self._factor(square)
        xx, xy, yy = scale + 2 * rate * x * x, 2 * rate * x * y, scale + 2 * rate * y * y
        with np.errstate(invalid="ignore", divide="ignore"):
            rows_x = [xx / z, xy / z, -(xx * x + xy * y) / z]
            rows_y = [xy / z, yy / z, -(xy * x + yy * y) / z]
        powers = [square**n for n in (1, 2, 3, 4)]
        return _assemble(
            self, seen, x * scale, y * scale, rows_x, rows_y, [x * p for p in powers], [y * p for p in powers]
        )

    def _slopes(self, points):
        x, y, z = _columns(points, 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = np.where(z > 0, z, np.nan)
            x, y = x / ahead, y / ahead
        square = x * x + y * y
        return x, y, square, square <= self._radial.s_max**2

    def _factor(self, square):
        """1 + k1 r^2 + ... and its derivative to r^2."""
        factor = 1 + square * (self.k1 + square * (self.k2 + square * (self.k3 + square * self.k4)))
        return factor, self.k1 + square * (2 * self.k2 + square * (3 * self.k3 + square * 4 * self.k4))


@dataclass(frozen=True)
class Division:
    """The thesis's Listing .3: a pinhole image pulled through x_u = x_d / (1 + k1 r_d^2 + ... + k4 r_d^8).

    fx, fy, cx, cy in pixels are those of the pinhole image; width and height in pixels are those of both images. x_d
    and x_u are counted in half widths (horizontally) and half heights (vertically) from (cx, cy). The listing paints
    black what lies outside the pinhole image; here it is NaN. Division models: Fitzgibbon (2001).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    width: float = 1920
    height: float = 1080

    @cached_property
    def theta_max(self):
        """The largest angle from the axis that is imaged, in radians: a corner of the pinhole image, or the fold."""
        across, down = 0.5 * self.width, 0.5 * self.height
        if math.hypot(1, 1) <= self._radial.y_max:
            return math.atan(math.hypot(across / self.fx, down / self.fy))
        return math.atan(self._radial.y_max * max(across / self.fx, down / self.fy))

    @cached_property
    def _radial(self):
        fold = _first_sign_change([1.0, -self.k1, -3 * self.k2, -5 * self.k3, -7 * self.k4])
        pole = _first_sign_change([1.0, self.k1, self.k2, self.k3, self.k4])
        limit = math.sqrt(min(fold, pole))
        return _Radial(self._source_radius, limit, math.inf if pole <= fold else None)

    @property
    def radius_max(self):
        """Radius of the invertible field in half image sizes; what the pinhole image holds may end before."""
        return self._radial.s_max

    def project(self, points):
        """Project points (n, 3) of the camera frame, any length unit, to pixels (n, 2); NaN where not imaged."""
        x, y, seen = self._source(points)
        r = np.hypot(x, y)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r > 0, self._radial.inverse(r) / r, 1.0)
        return _where_seen(seen, self.cx + 0.5 * self.width * scale * x, self.cy + 0.5 * self.height * scale * y)

    def unproject(self, pixels):
        """Turn pixels (n, 2) into unit rays (n, 3) of the camera frame; NaN where the lens images nothing."""
        return _piecewise(self._rays, pixels)

    def _rays(self, u, v):
        x, y = (u - self.cx) / (0.5 * self.width), (v - self.cy) / (0.5 * self.height)
        r = np.hypot(x, y)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r < self._radial.s_max, 1.0 / self._denominator(r), np.nan)
            x, y = x * scale, y * scale
            inside = (np.abs(x) <= 1) & (np.abs(y) <= 1)
        rays = _unit(0.5 * self.width / self.fx * x, 0.5 * self.height / self.fy * y)
        return np.where(inside[..., None], rays, np.nan)

    def project_jacobian(self, points):
        """Project points (n, 3) and differentiate; NaN where not imaged.

        Returns pixels (n, 2), their derivatives to the point (n, 2, 3) in px per unit of length, and to the
        parameters fx, fy, cx, cy, k1..k4 (n, 2, 8).
        """
        x, y, seen = self._source(points)
        z = _columns(points, 3)[2]
        r_u = np.hypot(x, y)
        r = self._radial.inverse(r_u)
        slope = self._source_radius(r)[1]
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r_u > 0, r / r_u, 1.0)
            ex, ey = np.where(r_u > 0, x / r_u, 0.0), np.where(r_u > 0, y / r_u, 0.0)
            bend = 1.0 / slope - scale
            xx, xy, yy = scale + ex * ex * bend, ex * ey * bend, scale + ey * ey * bend
            gx, gy = self.fx / (0.5 * self.width * z), self.fy / (0.5 * self.height * z)
            rows_x = [xx * gx, xy * gy, -(xx * x + xy * y) / z]
            rows_y = [xy * gx, yy * gy, -(xy * x + yy * y) / z]
            powers = [r ** (2 * n + 1) / (self._denominator(r) ** 2 * slope) for n in (1, 2, 3, 4)]
        pixels = _where_seen(seen, self.cx + 0.5 * self.width * scale * x, self.cy + 0.5 * self.height * scale * y)
        half = np.array([0.5 * self.width, 0.5 * self.height])[:, None]
        d_point = np.stack([np.stack(rows_x, -1), np.stack(rows_y, -1)], -2) * half
        d_parameters = np.zeros((*seen.shape, 2, 8))
        d_parameters[..., 0, 0], d_parameters[..., 0, 1] = xx * x / self.fx, xy * y / self.fy
        d_parameters[..., 1, 0], d_parameters[..., 1, 1] = xy * x / self.fx, yy * y / self.fy
        d_parameters[..., 0, 4:] = np.stack([ex * p for p in powers], -1)
        d_parameters[..., 1, 4:] = np.stack([ey * p for p in powers], -1)
        d_parameters *= half
        d_parameters[..., 0, 2] = d_parameters[..., 1, 3] = 1.0
        hidden = ~seen[..., None, None]
        return pixels, np.where(hidden, np.nan, d_point), np.where(hidden, np.nan, d_parameters)

    def _source(self, points):
        """Place of the points in the pinhole image, in half widths and half heights, and which ones it holds."""
        x, y, z = _columns(points, 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = np.where(z > 0, z, np.nan)
            x, y = self.fx * x / (0.5 * self.width * ahead), self.fy * y / (0.5 * self.height * ahead)
            inside = (np.abs(x) <= 1) & (np.abs(y) <= 1) & (np.hypot(x, y) <= self._radial.y_max)
        return np.where(inside, x, np.nan), np.where(inside, y, np.nan), inside

    def _denominator(self, r):
        t = r * r
        return 1 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4)))

    def _source_radius(self, r):
        t = r * r
        bottom = self._denominator(r)
        top = 1 - t * (self.k1 + t * (3 * self.k2 + t * (5 * self.k3 + t * 7 * self.k4)))
        return r / bottom, top / (bottom * bottom)


class _Radial:
    """A strictly increasing y = g(s) on [0, s_max], g(0) = 0, g'(0) = 1, and its inverse.

    g takes an array and returns (value, slope). The inverse starts from a cubic Hermite table and takes one Newton
    step; what that leaves inexact (the neighbourhood of a fold, far tails) is solved by bracketed Newton.
    """

    def __init__(self, g, s_max, y_max=None):
        self.g, self.s_max = g, s_max
        self.y_max = float(g(np.float64(s_max))[0]) if y_max is None else y_max
        self.goes_far = self.y_max > 50

    def knots(self, count):
        """s and its slope at count + 1 even knots of w, a variable from 0 to 1 in which the inverse is smooth.

        Up to a fold, s goes as a square root there, so w = sqrt(1 - y / y_max); where y goes far, w = y / (1 + y) and
        s / (1 + s) stands in place of s.
        """
        w = np.linspace(0.0, 1.0, count + 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            y = w / (1 - w) if self.goes_far else self.y_max * (1 - w) * (1 + w)
            s = self._bracketed_newton(np.minimum(y, self.y_max))
            if self.goes_far:
                q = s / (1 + s)
                dq = ((1 + y) / (1 + s)) ** 2 / self.g(s)[1]
                dq[-1] = (3 * q[-1] - 4 * q[-2] + q[-3]) * count / 2
            else:
                q = s
                dq = -2 * self.y_max * w / self.g(s)[1]
                dq[0] = (-3 * q[0] + 4 * q[1] - q[2]) * count / 2
        return q, dq

    @cached_property
    def _table(self):
        return _cubics(*self.knots(_KNOTS))

    def inverse(self, y):
        """Solve g(s) = y for y (...) >= 0; NaN beyond y_max."""
        y = np.asarray(y, float)
        if y.size < _KNOTS:  # too few to pay for a table
            return self._bracketed_newton(y)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            w = y / (1 + y) if self.goes_far else np.sqrt(1 - y / self.y_max)
            w = np.where(np.isfinite(w), w, 0.0) * _KNOTS
            index = np.minimum(w.astype(np.intp), _KNOTS - 1)
            w -= index
            c0, c1, c2, c3 = self._table.T
            s = c0[index] + w * (c1[index] + w * (c2[index] + w * c3[index]))
            if self.goes_far:
                s = s / (1 - s)
            value, slope = self.g(s)
            step = (value - y) / slope
            s = np.clip(s - step, 0.0, self.s_max)
            # Newton squares the error: a step below 1e-8 leaves 1e-16, unless the slope is near 0.
            rough = ~((np.abs(step) < 1e-8 * (1 + s)) & (slope > 1e-3))
        if rough.any():
            s[rough] = self._bracketed_newton(y[rough])
        return s

    def _bracketed_newton(self, y):
        """Newton's method that bisects where it leaves its bracket or gains less than half (rtsafe, Press et al.)."""
        y = np.asarray(y, float)
        seen = y <= self.y_max
        target = np.where(seen, y, 0.0)
        low, high = np.zeros_like(target), np.full_like(target, self.s_max)
        s = np.minimum(target, 0.5 * high)
        last = high - low
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            for _ in range(200):
                value, slope = self.g(s)
                error = value - target
                low, high = np.where(error <= 0, s, low), np.where(error >= 0, s, high)
                newton = s - error / slope
                halve = ~((newton >= low) & (newton <= high) & (np.abs(2 * error) <= np.abs(last * slope)))
                following = np.where(halve, 0.5 * (low + high), newton)
                following = np.where(error == 0, s, following)
                last = np.abs(following - s)
                s = following
                if (last <= 2e-16 * np.abs(s)).all():
                    break
        # The top of a fold is the one root that a bracket with a sign change cannot hold.
        s = np.where(target == self.y_max, self.s_max, s)
        return np.where(seen, s, np.nan)


def _cubics(values, slopes):
    """Coefficients (n, 4) of the cubics between n + 1 even knots of [0, 1], from values and slopes there (Hermite)."""
    rise, d0, d1 = np.diff(values), slopes[:-1] / (len(values) - 1), slopes[1:] / (len(values) - 1)
    return np.stack([values[:-1], d0, 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise], -1)


def _odd_polynomial(s, k1, k2, k3, k4):
    """s (1 + k1 s^2 + k2 s^4 + k3 s^6 + k4 s^8) and its slope."""
    t = s * s
    value = s * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    return value, 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))


def _first_sign_change(coefficients):
    """The smallest t > 0 at which c0 + c1 t + c2 t^2 + ... (c0 = 1) turns negative; infinity where it never does."""
    inverse_roots = np.roots(coefficients)  # of 1 / t: led by c0, the smallest t are its best conditioned roots
    for root in sorted(1 / w.real for w in inverse_roots if w.real > 1e-16 and abs(w.imag) <= 1e-7 * abs(w)):
        value, slope = _horner(coefficients, root)
        for _ in range(3):
            if slope == 0:
                break
            root -= value / slope
            value, slope = _horner(coefficients, root)
        if root > 0 and _horner(coefficients, root * (1 + 1e-6))[0] < 0:
            return float(root)
    return math.inf


def _horner(polynomial, t):
    value = slope = 0.0
    for c in polynomial[::-1]:
        value, slope = value * t + c, slope * t + value
    return value, slope


def _piecewise(rays, pixels):
    """Rays (..., 3) of pixels (..., 2), computed in pieces that stay in the cache."""
    u, v = _columns(pixels, 2)
    out = np.empty((u.size, 3))
    flat_u, flat_v = u.reshape(-1), v.reshape(-1)
    for start in range(0, u.size, _CHUNK):
        piece = slice(start, start + _CHUNK)
        out[piece] = rays(flat_u[piece], flat_v[piece])
    return out.reshape(*u.shape, 3)


def _columns(array, width):
    array = np.asarray(array, float)
    if array.shape[-1:] != (width,):
        raise ValueError(f"expected an array of shape (n, {width}), got {array.shape}")
    return np.moveaxis(array, -1, 0)


def _where_seen(seen, u, v):
    return np.where(seen[..., None], np.stack([u, v], -1), np.nan)


def _unit(x, y):
    length = np.sqrt(1 + x * x + y * y)
    return np.stack([x / length, y / length, 1 / length], -1)


def _assemble(lens, seen, mx, my, rows_x, rows_y, terms_x, terms_y):
    """Pixels and derivatives from the image plane's coordinates m (focal length 1) and their derivatives."""
    pixels = _where_seen(seen, lens.cx + lens.fx * mx, lens.cy + lens.fy * my)
    d_point = np.stack([lens.fx * np.stack(rows_x, -1), lens.fy * np.stack(rows_y, -1)], -2)
    d_parameters = np.zeros((*seen.shape, 2, 8))
    d_parameters[..., 0, 0], d_parameters[..., 1, 1] = mx, my
    d_parameters[..., 0, 2] = d_parameters[..., 1, 3] = 1.0
    d_parameters[..., 0, 4:] = lens.fx * np.stack(terms_x, -1)
    d_parameters[..., 1, 4:] = lens.fy * np.stack(terms_y, -1)
    hidden = ~seen[..., None, None]
    return pixels, np.where(hidden, np.nan, d_point), np.where(hidden, np.nan, d_parameters)
