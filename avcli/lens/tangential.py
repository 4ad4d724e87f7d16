"""Lenses whose elements are not centred on one axis: a radial model, and tangential (decentring) terms p1, p2.

A radial lens takes the undistorted point q = s e (s: the angle or the slope of the ray; e: its direction across the
axis) to m(s) e. Here the image point is F(q) = m(s) e + T(q), T(q) = |q|^2 a + 2 (p . q) q, p = (p2, p1). a is p, or
p + (sx1, sy1) behind a thin prism, such as a window that is tilted. The lens ends at the first angle at which the
symmetric part of F's Jacobian is not positive definite all around the axis. Up to there, by convexity, no two rays
share a pixel.

Source: Brown (1966), Decentering distortion of lenses; Conrady (1919), Decentred lens-systems; Weng, Cohen and Herniou
(1992), Camera calibration with distortion models, for the prism. On slopes the terms are those of OpenCV, on angles
those of COLMAP's THIN_PRISM_FISHEYE.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from avcli.lens.models import FARTHEST_SLOPE, BrownConrady, KannalaBrandt, Lens, Perspective, columns
from avcli.lens.radial import KNOTS, Radial, first_sign_change, fold_of_odd_polynomial

_STEPS = 6  # plain Newton steps
_MORE_STEPS = 60  # careful ones
_TURN = np.arange(24) * (np.pi / 12)  # directions in which it is looked for the angle at which a lens ends
_ROUNDS = 10  # of that search, each 63 times as fine
_ENOUGH = 1e-7  # a step of Newton's method after which its square is no error


@dataclass(frozen=True)
class Tangential(Lens):
    """What the tangential variants of the radial models share; mixed in before the model."""

    p1: float = 0.0
    p2: float = 0.0

    def _ray_of(self, qx: np.ndarray, qy: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Unit rays (n, 3) of undistorted points (qx, qy) of length s, which is the slope unless a model says else."""
        length = np.sqrt(1 + s * s)
        return np.stack([qx / length, qy / length, 1 / length], -1)

    @property
    def tangential_terms(self) -> tuple[float, float, float, float]:
        return self.p2, self.p1, self.p2, self.p1

    def image(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not any(self.tangential_terms):
            return super().image(x, y, z)
        across = self._across(x, y, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            ex, ey = across.direction
            m, s = self._radius(across.s)[0], across.s
            tx, ty = self._tangent(s * ex, s * ey)
            scale_x, scale_y = self.scale_px
            u, v = self.cx + scale_x * (m * ex + tx), self.cy + scale_y * (m * ey + ty)
        return np.where(across.seen, u, np.nan), np.where(across.seen, v, np.nan)

    def project_jacobian(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pixels, by_point, by_parameter = super().project_jacobian(points)
        x, y, z = columns(points, 3)
        across = self._across(x, y, z)
        s = across.s
        with np.errstate(invalid="ignore", divide="ignore"):
            ex, ey = across.direction
            _, rows_x, rows_y = self._by_point(across, z, ex, ey, s, np.ones_like(s))
            qx, qy = s * ex, s * ey
            tx, ty = self._tangent(qx, qy)
            xx, xy, yx, yy = self._tangent_slopes(qx, qy)
            scale = np.array(self.scale_px)
            turn = np.stack([np.stack([xx, xy], -1), np.stack([yx, yy], -1)], -2)
            by_point += scale[:, None] * (turn @ np.stack([np.stack(rows_x, -1), np.stack(rows_y, -1)], -2))
            pixels += scale * np.stack([tx, ty], -1)
            by_parameter[..., 0, 0] += tx
            by_parameter[..., 1, 1] += ty
            twice, square = 2 * qx * qy, qx * qx + qy * qy
            first = self.names().index("p1")
            by_parameter[..., first] = scale * np.stack([twice, square + 2 * qy * qy], -1)
            by_parameter[..., first + 1] = scale * np.stack([square + 2 * qx * qx, twice], -1)
            if by_parameter.shape[-1] > first + 2:  # sx1 and sy1
                by_parameter[..., first + 2 :] = scale[:, None] * (square[..., None, None] * np.eye(2))
        by_parameter[~across.seen] = np.nan
        return pixels, by_point, by_parameter

    def _tangent(self, qx: np.ndarray, qy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        px, py, ax, ay = self.tangential_terms
        along, square = 2 * (px * qx + py * qy), qx * qx + qy * qy
        return square * ax + along * qx, square * ay + along * qy

    def _tangent_slopes(self, qx: np.ndarray, qy: np.ndarray) -> tuple[np.ndarray, ...]:
        """Derivatives of T: x to x, x to y, y to x, y to y."""
        px, py, ax, ay = self.tangential_terms
        along = 2 * (px * qx + py * qy)
        return (
            along + 2 * (ax + px) * qx,
            2 * (ax * qy + py * qx),
            2 * (ay * qx + px * qy),
            along + 2 * (ay + py) * qy,
        )

    def _one_to_one(self, end: float) -> float:
        """The largest s up to the radial model's `end` below which F is one-to-one in all directions."""
        px, py, ax, ay = self.tangential_terms
        if not any(self.tangential_terms):
            return end
        c, d = np.cos(_TURN), np.sin(_TURN)
        outward = 2 * (ax + 2 * px) * c + 2 * (ay + 2 * py) * d  # over s: of T, along e by a step along e
        sideways = 2 * px * c + 2 * py * d  # across e by a step across e
        between = (ay + py) * c - (ax + px) * d  # the mean of the other two

        def least(s: np.ndarray) -> np.ndarray:
            """The least determinant over the directions of the symmetric part of dF/dq."""
            m, slope = self._radius(s)
            m, slope, s = (part[..., None] for part in (m / s, slope, s))
            return _least_of_waves((slope + s * outward) * (m + s * sideways) - (s * between) ** 2)

        s = np.append(np.geomspace(1e-6, 1, 500) * min(end, 1.0), np.linspace(min(end, 1.0), end, 2000)[1:])
        if end > 10:
            s = np.geomspace(1e-6, end, 4000)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for _ in range(_ROUNDS):
                bad = ~(least(s) > 0)
                if not bad.any():
                    return end
                first = int(np.argmax(bad))
                low, end = (0.0 if first == 0 else float(s[first - 1])), float(s[first])
                s = np.linspace(low, end, 64)[1:]
        return low

    def _rays(self, mx: np.ndarray, my: np.ndarray, m: np.ndarray) -> np.ndarray:
        if not any(self.tangential_terms):
            return super()._rays(mx, my, m)  # type: ignore[safe-super]
        radial = self._radial
        px, py, ax, ay = self.tangential_terms
        # No point of the field lies farther.
        reach = radial.y_max + (math.hypot(ax, ay) + 2 * math.hypot(px, py)) * radial.s_max**2
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            y = np.minimum(m, (1 - 1e-6) * radial.y_max)
            scale = np.where(m > 0, (radial.about(y) if y.size >= KNOTS else radial.inverse(y)) / m, 1.0)
            qx, qy = mx * scale, my * scale
            for steps in range(_STEPS):
                step_x, step_y, _, _ = self._newton(qx, qy, mx, my)
                qx, qy = qx - step_x, qy - step_y
                rough = ~(np.maximum(np.abs(step_x), np.abs(step_y)) < _ENOUGH)
                if steps and np.count_nonzero(rough) < 0.2 * rough.size:
                    break
            s = np.sqrt(qx * qx + qy * qy)
            rough = (rough | (s > radial.s_max)) & (m <= reach)
            if rough.any():
                qx[rough], qy[rough] = self._solved(mx[rough], my[rough], y[rough])
                s = np.sqrt(qx * qx + qy * qy)
            rays = self._ray_of(qx, qy, s)
            rays[~((s <= radial.s_max) & (m <= reach))] = np.nan
        return rays

    def _newton(
        self, qx: np.ndarray, qy: np.ndarray, wx: np.ndarray, wy: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The step -dq of Newton's method for F(q) = w, and the error F(q) - w, all (n,)."""
        px, py, ax, ay = self.tangential_terms
        square = qx * qx + qy * qy
        s = np.sqrt(square) + 1e-150  # no 0 / 0 on the axis
        m, slope = self._radius(s)
        factor = m / s
        bend = (slope - factor) / (s * s)
        common = factor + (2 * px * qx + 2 * py * qy)
        error_x, error_y = common * qx + ax * square - wx, common * qy + ay * square - wy
        turn_x, turn_y = bend * qx, bend * qy
        xx = common + qx * (turn_x + 2 * (ax + px))
        yy = common + qy * (turn_y + 2 * (ay + py))
        both = turn_x * qy
        xy, yx = both + 2 * (ax * qy + py * qx), both + 2 * (ay * qx + px * qy)
        inverse = 1.0 / (xx * yy - xy * yx)
        step_x, step_y = (yy * error_x - xy * error_y) * inverse, (xx * error_y - yx * error_x) * inverse
        return step_x, step_y, error_x, error_y

    def _solved(self, wx: np.ndarray, wy: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve F(q) = w (n,), starting where the radial lens has the radius y: careful steps where plain ones fail."""
        scale = self._radial.inverse(y) / np.maximum(np.hypot(wx, wy), 1e-300)
        qx, qy = wx * scale, wy * scale
        for _ in range(_STEPS):
            step_x, step_y, _, _ = self._newton(qx, qy, wx, wy)
            qx, qy = qx - step_x, qy - step_y
        lost = ~(np.abs(step_x) + np.abs(step_y) < _ENOUGH) | (np.hypot(qx, qy) > self._radial.s_max)
        if lost.any():
            qx[lost], qy[lost] = self._carefully(wx[lost] * scale[lost], wy[lost] * scale[lost], wx[lost], wy[lost])
        return qx, qy

    def _carefully(
        self, qx: np.ndarray, qy: np.ndarray, wx: np.ndarray, wy: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Newton's method that halves steps which leave the field or gain nothing; NaN where that ends nowhere."""
        limit = self._radial.s_max * (1 + 1e-12)
        shrink = np.minimum(1.0, 0.999 * limit / np.maximum(np.hypot(qx, qy), 1e-300))
        qx, qy = qx * shrink, qy * shrink
        for _ in range(_MORE_STEPS):
            step_x, step_y, error_x, error_y = self._newton(qx, qy, wx, wy)
            before, part = np.hypot(error_x, error_y), np.ones_like(qx)
            good = np.zeros(qx.shape, bool)
            for _ in range(30):
                trial_x, trial_y = qx - part * step_x, qy - part * step_y
                _, _, error_x, error_y = self._newton(trial_x, trial_y, wx, wy)
                good = (np.hypot(trial_x, trial_y) <= limit) & (np.hypot(error_x, error_y) < before)
                if good.all():
                    break
                part = np.where(good, part, 0.5 * part)
            qx, qy = np.where(good, trial_x, qx), np.where(good, trial_y, qy)
            if not good.any():
                break
        _, _, error_x, error_y = self._newton(qx, qy, wx, wy)
        found = np.hypot(error_x, error_y) <= 1e-12 * (1 + np.hypot(wx, wy))
        return np.where(found, qx, np.nan), np.where(found, qy, np.nan)


def _least_of_waves(values: np.ndarray) -> np.ndarray:
    """The least of functions of the direction with waves of one and two periods, from values (..., 24) at `_TURN`.

    Where that is clearly positive it is the least value, which may be too large by 4 % of the waves' height.
    """
    least = np.asarray(values.min(-1))
    some = ~(least > 0.1 * (values.max(-1) - least))
    values = values[some]
    _, first, second = np.moveaxis(np.fft.rfft(values)[..., :3], -1, 0) * (2 / len(_TURN))
    at = _TURN[np.argmin(values, -1)]
    for _ in range(3):  # Newton's method
        one, two = first * np.exp(1j * at), second * np.exp(2j * at)
        bend = -(one + 4 * two).real
        at = at + np.where(bend > 0, (one + 2 * two).imag / np.where(bend > 0, bend, 1.0), 0.0)
    one, two = first * np.exp(1j * at), second * np.exp(2j * at)
    least[some] = np.minimum(least[some], values.mean(-1) + (one + two).real)
    return least


@dataclass(frozen=True)
class TangentialKannalaBrandt(Tangential, KannalaBrandt):
    """`KannalaBrandt` with tangential terms of the equidistant point q = theta e, and a thin prism.

    sx1 and sy1 move the image point by |q|^2 (sx1, sy1).
    """

    sx1: float = 0.0
    sy1: float = 0.0

    @property
    def tangential_terms(self) -> tuple[float, float, float, float]:
        return self.p2, self.p1, self.p2 + self.sx1, self.p1 + self.sy1

    @cached_property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged in all directions, rad."""
        return self._one_to_one(min(fold_of_odd_polynomial(*self.radial_terms), math.pi))

    @property
    def radial(self) -> Lens:
        return KannalaBrandt(self.fx, self.fy, self.cx, self.cy, *self.radial_terms)

    def _ray_of(self, qx: np.ndarray, qy: np.ndarray, s: np.ndarray) -> np.ndarray:
        scale = np.where(s > 0, np.sin(s) / s, 1.0)
        return np.stack([qx * scale, qy * scale, np.cos(s)], -1)


@dataclass(frozen=True)
class TangentialBrownConrady(Tangential, BrownConrady):
    """`BrownConrady` with tangential terms: OpenCV's k1, k2, p1, p2, k3, and a fourth radial term."""

    @cached_property
    def _slope_max(self) -> float:
        return self._one_to_one(min(fold_of_odd_polynomial(*self.radial_terms), FARTHEST_SLOPE))

    @property
    def radial(self) -> Lens:
        return BrownConrady(self.fx, self.fy, self.cx, self.cy, *self.radial_terms)


@dataclass(frozen=True)
class _RadialRational(Perspective):
    """The radial part of `Rational`."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @cached_property
    def _radial_end(self) -> float:
        """The slope at which the radius folds or is infinite, or as far as a slope may go."""
        top, bottom = np.array([1.0, self.k1, self.k2, self.k3]), np.array([1.0, self.k4, self.k5, self.k6])
        power = np.arange(4)
        # The derivative's numerator in t = s^2: (s top)' bottom - s top bottom', both by the product rule.
        slope = np.convolve((1 + 2 * power) * top, bottom) - np.convolve(top, 2 * power * bottom)
        fold, pole = first_sign_change(slope.tolist()), first_sign_change(bottom.tolist())
        return min(math.sqrt(fold), math.sqrt(pole) * (1 - 1e-9), FARTHEST_SLOPE)

    @cached_property
    def _slope_max(self) -> float:
        return self._radial_end

    @cached_property
    def _radial(self) -> Radial:
        return Radial(self._radius, self._slope_max, steps=4)

    def _quotient(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """t = s^2, and the polynomials over and under the bar."""
        t = s * s
        top = 1 + t * (self.k1 + t * (self.k2 + t * self.k3))
        return t, top, 1 + t * (self.k4 + t * (self.k5 + t * self.k6))

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t, top, bottom = self._quotient(s)
        rise = t * (2 * self.k1 + t * (4 * self.k2 + t * 6 * self.k3))
        fall = t * (2 * self.k4 + t * (4 * self.k5 + t * 6 * self.k6))
        ratio = top / bottom
        return s * ratio, (top + rise - ratio * fall) / bottom

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        t, top, bottom = self._quotient(s)
        over = [s * t**n / bottom for n in (1, 2, 3)]
        return over + [-term * top / bottom for term in over]


@dataclass(frozen=True)
class Rational(Tangential, _RadialRational):
    """OpenCV's rational model: u = fx (x' (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + T) + cx.

    T has the tangential terms p1, p2. OpenCV's vector of coefficients has the order k1 k2 p1 p2 k3 k4 k5 k6.

    Source: OpenCV's calib3d, CALIB_RATIONAL_MODEL; Claus and Fitzgibbon (2005), A rational function lens distortion
    model for general cameras, for the idea.
    """

    text = "OpenCV's rational model"

    @cached_property
    def _slope_max(self) -> float:
        return self._one_to_one(self._radial_end)

    @property
    def radial(self) -> Lens:
        return replace(self, p1=0.0, p2=0.0)
