"""Fisheyes with two or three numbers: the unified, the extended unified, and the double sphere camera model.

A point is projected onto a sphere (an ellipsoid, two spheres), then from a second centre onto the image plane. The
inverse is a closed formula, so that `_rays` needs no table.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from avcli.lens.models import Angular

_SHORT_OF_A_POLE = 1e-7  # rad; the image radius is infinite at it


def _steepest(alpha: float, beta: float) -> float:
    """Cosine of the largest angle that the second projection images, from 0 to -1: its fold, or its pole."""
    ratio = min(alpha, 1 - alpha) / max(alpha, 1 - alpha)
    return -math.sqrt(ratio * ratio * beta / (1 - ratio * ratio * (1 - beta)))


class _Sphere(Angular):
    """What these models share: they fold where alpha is above one half."""

    alpha: float

    @cached_property
    def radius_max(self) -> float:
        return float(self._radius(np.asarray(self.theta_max))[0])

    @property
    def has_fold(self) -> bool:
        return self.alpha > 0.5


@dataclass(frozen=True)
class Unified(_Sphere):
    """The unified camera model: u = fx x / (alpha rho + (1 - alpha) z) + cx, rho being the distance of the point.

    alpha is from 0 (a pinhole) to 1 (an orthographic fisheye); 0.5 is stereographic. The omni model of Mei and Rives
    (2007) is the same: alpha = xi / (1 + xi), fx = gamma / (1 + xi).

    Source: Usenko, Demmel and Cremers (2018), The double sphere camera model, section 2.
    """

    text = "the unified camera model"
    start: ClassVar[tuple[float, ...]] = (0.5,)
    leading: ClassVar[str] = "alpha"

    alpha: float

    @property
    def _beta(self) -> float:
        return 1.0

    @property
    def is_possible(self) -> bool:
        return super().is_possible and 0 <= self.alpha <= 1 and self._beta > 0

    @cached_property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad: where the radius stops growing, or is infinite."""
        angle = math.acos(_steepest(self.alpha, self._beta))
        return angle if self.alpha > 0.5 else angle - _SHORT_OF_A_POLE

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sine, cosine = np.sin(s), np.cos(s)
        d = np.sqrt(self._beta * sine * sine + cosine * cosine)
        bottom = self.alpha * d + (1 - self.alpha) * cosine
        return sine / bottom, (1 - self.alpha + self.alpha * cosine / d) / (bottom * bottom)

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        sine, cosine = np.sin(s), np.cos(s)
        d = np.sqrt(self._beta * sine * sine + cosine * cosine)
        steepness = -sine / (self.alpha * d + (1 - self.alpha) * cosine) ** 2
        return [steepness * (d - cosine), steepness * self.alpha * sine * sine / (2 * d)][: len(self.names()) - 4]

    def _rays(self, mx: np.ndarray, my: np.ndarray, m: np.ndarray) -> np.ndarray:
        square = m * m
        rays = np.empty((*m.shape, 3))
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = _ahead(square, self.alpha, self._beta)
            scale = 1.0 / np.sqrt(square + ahead * ahead)
        np.multiply(mx, scale, out=rays[..., 0])
        np.multiply(my, scale, out=rays[..., 1])
        np.multiply(ahead, scale, out=rays[..., 2])
        return rays


def _ahead(square: np.ndarray, alpha: float, beta: float) -> np.ndarray:
    """z of the point of the image plane at the squared radius (n,), seen from the first centre; NaN past the fold."""
    root = np.sqrt(1 - (2 * alpha - 1) * beta * square)
    return (1 - beta * alpha * alpha * square) / (alpha * root + 1 - alpha)


@dataclass(frozen=True)
class ExtendedUnified(Unified):
    """The extended unified camera model: as `Unified`, with rho = sqrt(beta (x^2 + y^2) + z^2).

    Source: Khomutenko, Garcia and Martinet (2016), An enhanced unified camera model.
    """

    text = "the extended unified camera model"
    start: ClassVar[tuple[float, ...]] = (0.5, 1.0)

    beta: float

    @property
    def _beta(self) -> float:
        return self.beta


@dataclass(frozen=True)
class DoubleSphere(_Sphere):
    """The double sphere model: u = fx x / (alpha d + (1 - alpha) k) + cx, k = xi rho + z, d^2 = x^2 + y^2 + k^2.

    rho is the distance of the point. On the axis a pixel is (1 + xi) / fx rad wide. xi is above -1 and at most 1, alpha
    from 0 to 1.

    Source: Usenko, Demmel and Cremers (2018), The double sphere camera model, section 3.
    """

    text = "the double sphere model"
    start: ClassVar[tuple[float, ...]] = (0.0, 0.5)
    leading: ClassVar[str] = "alpha"

    xi: float
    alpha: float

    @property
    def is_possible(self) -> bool:
        return super().is_possible and -1 < self.xi <= 1 and 0 <= self.alpha <= 1

    @cached_property
    def theta_max(self) -> float:
        """The largest angle from the axis that is imaged, rad: where the radius stops growing, or is infinite."""
        second = math.acos(_steepest(self.alpha, 1.0))  # as seen from the second centre, xi behind the first
        angle = second + math.asin(self.xi * math.sin(second))
        return angle if self.alpha > 0.5 else angle - _SHORT_OF_A_POLE

    def _parts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """sin(s), k, d, and the denominator of the projection."""
        sine, k = np.sin(s), self.xi + np.cos(s)
        d = np.sqrt(sine * sine + k * k)
        return sine, k, d, self.alpha * d + (1 - self.alpha) * k

    def _radius(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sine, k, d, bottom = self._parts(s)
        bend = (1 - self.alpha + self.alpha * k / d) * (1 + self.xi * np.cos(s))
        return sine / bottom, bend / (bottom * bottom)

    def _by_coefficients(self, s: np.ndarray) -> Sequence[np.ndarray]:
        sine, k, d, bottom = self._parts(s)
        steepness = -sine / (bottom * bottom)
        return [steepness * (1 - self.alpha + self.alpha * k / d), steepness * (d - k)]

    def _rays(self, mx: np.ndarray, my: np.ndarray, m: np.ndarray) -> np.ndarray:
        square, xi = m * m, self.xi
        rays = np.empty((*m.shape, 3))
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead = _ahead(square, self.alpha, 1.0)
            length = ahead * ahead + square
            scale = (ahead * xi + np.sqrt(length - xi * xi * square)) / length
        np.multiply(mx, scale, out=rays[..., 0])
        np.multiply(my, scale, out=rays[..., 1])
        np.multiply(ahead, scale, out=rays[..., 2])
        rays[..., 2] -= xi
        return rays
