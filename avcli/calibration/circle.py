"""The circle that a fisheye's light fills on the sensor, found from the pictures themselves."""

from dataclasses import dataclass

import numpy as np

from avcli.calibration.pyramid import Pyramid

_WIDTH = 320
"""Longest side of the mean picture in which the circle is searched, px."""
_RAYS = 360
_DARK = 0.15
"""Height of the edge: fraction of the way from the black border to the lit picture."""
_OFF = 0.015
"""Distance from the circle, as a fraction of its radius, within which a point of the edge lies on it."""


@dataclass(frozen=True)
class Circle:
    """Where light reaches the picture: a circle with its middle (x, y) and its radius, px."""

    x: float
    y: float
    radius: float

    def holds(self, pixels: np.ndarray) -> np.ndarray:
        """Tell which pixels (..., 2) are inside; NaN is not."""
        with np.errstate(invalid="ignore"):
            return np.hypot(pixels[..., 0] - self.x, pixels[..., 1] - self.y) <= self.radius

    def edge(self, count: int = 180) -> np.ndarray:
        """Points (count, 2) px on it."""
        turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
        return np.array([self.x, self.y]) + self.radius * np.stack([np.cos(turn), np.sin(turn)], -1)


class Light:
    """The mean of the pictures so far, from which the circle is found.

    In the mean, what stands before the camera blurs, and the border stays black.
    """

    def __init__(self) -> None:
        self._sum: np.ndarray = np.zeros((0, 0))
        self._count = 0
        self._scale = 1.0

    def take(self, picture: np.ndarray | Pyramid) -> None:
        """Add a picture (height, width) uint8; one of another size than the first is left out."""
        small, self._scale = Pyramid.of(picture).reduced(_WIDTH)
        if not self._count:
            self._sum = np.zeros(small.shape)
        if small.shape == self._sum.shape:
            self._sum += small
            self._count += 1

    @property
    def circle(self) -> Circle | None:
        """The circle, px of the full pictures; None where the border is lit as the rest, or no circle fits it."""
        if not self._count:
            return None
        found = find(self._sum / self._count)
        if found is None:
            return None
        x, y = ((value + 0.5) * self._scale - 0.5 for value in (found.x, found.y))
        return Circle(x, y, found.radius * self._scale)


def find(mean: np.ndarray) -> Circle | None:
    """Find the circle in the mean picture (height, width) of many; None where there is none.

    The border must be black, the edge sharp, and most of its points must lie on one circle. Things that are dark at the
    rim, and glare beyond it, leave points elsewhere: the circle is the one on which most points lie (RANSAC, Fischler
    and Bolles 1981, over triples of points about a third of them apart, so that there is no chance in it).
    """
    height, width = mean.shape
    if min(height, width) < 16:
        return None
    side = max(2, min(height, width) // 30)
    ends = slice(0, side), slice(-side, None)
    black = float(np.median([np.median(mean[y, x]) for y in ends for x in ends]))
    bright = float(np.median(mean[height // 4 : -(height // 4), width // 4 : -(width // 4)]))
    if not black < 0.35 * bright:
        return None
    points = _edge_points(mean, black + _DARK * (bright - black))
    if len(points) < _RAYS // 8:
        return None
    circle, on = _most_agreed(points, max(height, width))
    if circle is None or on.sum() < max(0.5 * len(points), _RAYS // 8) or not _is_sharp(mean, circle, black, bright):
        return None
    return circle


def _edge_points(mean: np.ndarray, level: float) -> np.ndarray:
    """The outermost points (n, 2) px as bright as `level`, on rays from the middle that end in the dark."""
    import cv2

    height, width = mean.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    turn = np.linspace(0, 2 * np.pi, _RAYS, endpoint=False)
    ahead = np.stack([np.cos(turn), np.sin(turn)], -1)
    with np.errstate(divide="ignore"):
        reach = np.min(np.abs(middle / np.where(np.abs(ahead) > 1e-9, ahead, 1e-9)), axis=1)
    steps = np.linspace(1.0, 0.2, 2 * max(height, width))
    at = middle + (reach[:, None] * steps)[..., None] * ahead[:, None]
    x, y = np.moveaxis(at.astype(np.float32), -1, 0)
    values = cv2.remap(mean.astype(np.float32), x, y, cv2.INTER_LINEAR)
    bright = values >= level
    first = bright.argmax(1)
    # A point at the picture's own border is where the circle leaves it.
    good = bright.any(1) & (first > max(2, len(steps) // 100))
    return at[np.flatnonzero(good), first[good]]


def _most_agreed(points: np.ndarray, size: int) -> tuple[Circle | None, np.ndarray]:
    """The circle on which most of the points (n, 2) lie, and which of them do."""
    n = len(points)
    first = np.arange(n)
    triples = np.concatenate(
        [
            np.stack([first, (first + n // 3 + k) % n, (first + 2 * n // 3 - k) % n], -1)
            for k in (0, n // 11, -(n // 13))
        ]
    )
    a, b, c = (points[triples[:, i]] for i in range(3))
    p, q = b - a, c - a
    twice = 2 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        pp, qq = (p**2).sum(1), (q**2).sum(1)
        off = np.stack([q[:, 1] * pp - p[:, 1] * qq, p[:, 0] * qq - q[:, 0] * pp], -1) / twice[:, None]
    radius = np.linalg.norm(off, axis=1)
    good = np.isfinite(radius) & (radius > 0.2 * size) & (radius < 0.8 * size)
    if not good.any():
        return None, np.zeros(n, bool)
    middle, radius = (a + off)[good], radius[good]
    distance = np.abs(np.linalg.norm(points[None] - middle[:, None], axis=2) - radius[:, None]) / radius[:, None]
    best = int(np.argmax((distance < _OFF).sum(1)))
    on = distance[best] < _OFF
    for _ in range(3):  # Kåsa's least squares over those that agree
        design = np.column_stack([2 * points[on], np.ones(on.sum())])
        x, y, rest = np.linalg.lstsq(design, (points[on] ** 2).sum(1), rcond=None)[0]
        found = Circle(float(x), float(y), float(np.sqrt(max(rest + x * x + y * y, 0))))
        off_circle = np.abs(np.hypot(*(points - [x, y]).T) - found.radius) / max(found.radius, 1e-9)
        on = off_circle < _OFF
        if on.sum() < 8:
            return None, on
    return found, on


def _is_sharp(mean: np.ndarray, circle: Circle, black: float, bright: float) -> bool:
    """Whether the picture is lit just inside the circle and black just outside, as it is not where a lens vignettes."""
    import cv2

    height, width = mean.shape

    def level(part: float) -> float:
        at = Circle(circle.x, circle.y, part * circle.radius).edge(_RAYS)
        inside = ((at >= 0) & (at <= [width - 1, height - 1])).all(1)
        if inside.sum() < _RAYS // 12:
            return float("nan")
        x, y = at[inside].astype(np.float32).T
        return float(np.median(cv2.remap(mean.astype(np.float32), x[None], y[None], cv2.INTER_LINEAR)))

    within, beyond = level(0.92), level(1.06)
    return within - black > 0.4 * (bright - black) and (np.isnan(beyond) or beyond - black < 0.15 * (bright - black))
