"""A strictly increasing function of one variable and its inverse: the arithmetic under all radial lenses.

The function is inverted once per lens into a table that one Newton step makes exact.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache

import numpy as np

KNOTS = 1024
_NEWTON_STEPS = 200  # a bisection alone needs about 60


class Radial:
    """A strictly increasing y = g(s) on [0, s_max], g(0) = 0, g'(0) = 1, and its inverse.

    The inverse starts from a cubic Hermite table and takes one Newton step; what that leaves inexact (the neighbourhood
    of a fold, far tails) is solved by bracketed Newton.

    Args:
        g: takes an array (...) and returns (value, slope), (...) each.
        s_max: end of the domain.
        y_max: g(s_max) where g cannot be evaluated there (a pole: infinity).
        steps: Newton steps that all samples share before the bracketed solver gets the rest; more than one pays where
            the slope of g goes up and down.
    """

    def __init__(
        self,
        g: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        s_max: float,
        y_max: float | None = None,
        steps: int = 1,
    ) -> None:
        self.g, self.s_max, self.steps = g, s_max, steps
        self.y_max = float(g(np.asarray(s_max, float))[0]) if y_max is None else y_max
        self.goes_far = self.y_max > 50
        self._asked = 0

    def knots(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Sample the inverse at count + 1 even knots of w, a variable from 0 to 1 in which it is smooth.

        Up to a fold, s goes as a square root there, so w = sqrt(1 - y / y_max); where y goes far, w = y / (1 + y) and
        s / (1 + s) stands in place of s.

        Returns:
            s and its slope ds/dw at the knots, (count + 1,) each.
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
    def _table(self) -> np.ndarray:
        return cubics(*self.knots(KNOTS))

    def inverse(self, y: np.ndarray) -> np.ndarray:
        """Solve g(s) = y for y (...) >= 0; NaN beyond y_max."""
        y = np.asarray(y, float)
        self._asked += y.size
        if self._asked < KNOTS:  # too few so far to pay for a table
            return self._bracketed_newton(y)
        s = self.about(y)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            for _ in range(self.steps):
                value, slope = self.g(s)
                step = (value - y) / slope
                s = np.clip(s - step, 0.0, self.s_max)
                # Newton squares the error: a step below 1e-8 leaves 1e-16, unless the slope is near 0.
                rough = ~((np.abs(step) < 1e-8 * (1 + s)) & (slope > 1e-3))
                if not rough.any():
                    break
        if rough.any():
            s[rough] = self._bracketed_newton(y[rough])
        return s

    def about(self, y: np.ndarray) -> np.ndarray:
        """The inverse at y (...) >= 0 to the few digits that the table has; anything beyond y_max."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            w = y / (1 + y) if self.goes_far else np.sqrt(1 - y / self.y_max)
            w = np.where(np.isfinite(w), w, 0.0) * KNOTS
            index = np.minimum(w.astype(np.intp), KNOTS - 1)
            w -= index
            c0, c1, c2, c3 = self._table.T
            s = c0[index] + w * (c1[index] + w * (c2[index] + w * c3[index]))
            return s / (1 - s) if self.goes_far else s

    def _bracketed_newton(self, y: np.ndarray) -> np.ndarray:
        """Newton's method that bisects where it leaves its bracket or gains less than half (rtsafe, Press et al.)."""
        y = np.asarray(y, float)
        seen = y <= self.y_max
        found = np.where(seen, y, 0.0).ravel()
        rows, target = np.arange(found.size), found.copy()
        low, high = np.zeros_like(target), np.full_like(target, self.s_max)
        s = np.minimum(target, 0.5 * high)
        last = high - low
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            for _ in range(_NEWTON_STEPS):
                value, slope = self.g(s)
                error = value - target
                low, high = np.where(error <= 0, s, low), np.where(error >= 0, s, high)
                newton = s - error / slope
                halve = ~((newton >= low) & (newton <= high) & (np.abs(2 * error) <= np.abs(last * slope)))
                following = np.where(halve, 0.5 * (low + high), newton)
                following = np.where(error == 0, s, following)
                last = np.abs(following - s)
                s = following
                going = last > 4.5e-16 * np.abs(s)
                if 4 * np.count_nonzero(going) <= 3 * len(s):  # few take long: those near a fold
                    found[rows[~going]] = s[~going]
                    rows, target, low, high, s, last = (part[going] for part in (rows, target, low, high, s, last))
                    if not len(s):
                        break
        found[rows] = s
        # The top of a fold is the one root that a bracket with a sign change cannot hold.
        found = np.where(y == self.y_max, self.s_max, found.reshape(y.shape))
        return np.where(seen, found, np.nan)


def cubics(values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Coefficients (n, 4) of the cubics between n + 1 even knots of [0, 1], from values and slopes there (Hermite)."""
    rise, d0, d1 = np.diff(values), slopes[:-1] / (len(values) - 1), slopes[1:] / (len(values) - 1)
    return np.stack([values[:-1], d0, 3 * rise - 2 * d0 - d1, d0 + d1 - 2 * rise], -1)


def odd_polynomial(s: np.ndarray, k1: float, k2: float, k3: float, k4: float) -> tuple[np.ndarray, np.ndarray]:
    """s (1 + k1 s^2 + k2 s^4 + k3 s^6 + k4 s^8) and its slope, of s (...)."""
    t = s * s
    value = s * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    return value, 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))


def odd_powers(s: np.ndarray) -> list[np.ndarray]:
    """s^3, s^5, s^7, s^9 of s (...): the derivatives of `odd_polynomial` to its coefficients."""
    square = s * s
    powers = [s * square]
    for _ in range(3):
        powers.append(powers[-1] * square)
    return powers


@lru_cache(64)
def fold_of_odd_polynomial(k1: float, k2: float, k3: float, k4: float) -> float:
    """The smallest s > 0 at which `odd_polynomial` stops growing; infinity where it never does."""
    return math.sqrt(first_sign_change([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))


def first_sign_change(coefficients: Sequence[float]) -> float:
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


def _horner(polynomial: Sequence[float], t: float) -> tuple[float, float]:
    value = slope = 0.0
    for c in polynomial[::-1]:
        value, slope = value * t + c, slope * t + value
    return value, slope
