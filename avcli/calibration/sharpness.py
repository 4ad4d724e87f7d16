"""How blurred a picture of a board is, from the edges between its corners: out of focus, or smeared by motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

_SAMPLES = 41
_LINES = np.linspace(-0.12, 0.12, 3)
"""Profiles of an edge, at these fractions of its length from its middle."""
_LEAST_CONTRAST = 12.0
"""Grey levels between the sides of an edge."""
_LEAST_EDGES = 8
_GAUSSIAN = 1.349
"""From the quarter to the three quarters of a step that is blurred by a Gaussian, in standard deviations."""
_MOTION = 2.0
"""Length of a uniform motion over the distance from the quarter to the three quarters of a step across it."""


SMEARED_PX = 5.0
"""Smear from which a picture is named."""
TOO_SMEARED_PX = 10.0
"""Median smear from which no lens is believed: at 15 px the focal length errs by more than is stated."""


@dataclass(frozen=True)
class Blur:
    """The blur of a picture: standard deviations along the direction that is blurred most, and across it.

    Attributes:
        most_px, least_px: px, of the Gaussian that blurs an edge as much. A sharp picture has about 0.5.
        angle: rad, direction of the largest blur, clockwise from the u axis.
    """

    most_px: float
    least_px: float
    angle: float

    @property
    def smear_px(self) -> float:
        """Length of the motion during the exposure that explains why one direction is blurred more, px."""
        across = max(self.most_px**2 - self.least_px**2, 0.0)
        return float(_MOTION * _GAUSSIAN * np.sqrt(across))


def blur(grey: np.ndarray, cells: np.ndarray, pixels: np.ndarray, clear: float = 0.35) -> Blur | None:
    """Measure the blur at the edges between neighbouring corners; None where too few edges are clear.

    Each edge gives the width of its blur across itself, w. Blur is a covariance S in the picture, and an edge with the
    normal n has w² = n' S n; least squares over edges of all directions give S.

    Args:
        grey: (height, width) uint8.
        cells: (n, 2) whole numbers, column and row of each corner.
        pixels: (n, 2) px.
        clear: how far from an edge its two sides stay dark and bright, in squares.
    """
    middles, along, across = _edges(cells, pixels)
    if len(middles) < _LEAST_EDGES:
        return None
    tangent = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    reach = clear * np.abs((across * normal).sum(1))
    width = _width(grey, middles, along, normal, reach)
    good = np.isfinite(width)
    if good.sum() < _LEAST_EDGES:
        return None
    n, squared = normal[good], width[good] ** 2
    design = np.stack([n[:, 0] ** 2, 2 * n[:, 0] * n[:, 1], n[:, 1] ** 2], -1)
    weight, both = np.ones(len(n)), np.column_stack([design, squared])
    floor, ridge = 0.05 * np.median(squared), 1e-12 * np.eye(3)
    for _ in range(5):  # least absolute deviations: glare and shadows cross some edges
        equations = (design * weight[:, None]).T @ both
        S = np.linalg.solve(equations[:, :3] + ridge, equations[:, 3])
        weight = 1 / np.maximum(np.abs(squared - design @ S), floor)
    values, vectors = np.linalg.eigh(np.array([[S[0], S[1]], [S[1], S[2]]]))
    least, most = np.sqrt(np.maximum(values, 0.0))
    return Blur(float(most), float(least), float(np.arctan2(vectors[1, 1], vectors[0, 1])))


class HasBlur(Protocol):
    """Anything with a `blur`, as a view."""

    @property
    def blur(self) -> Blur | None: ...


def smears(views: Sequence[HasBlur]) -> np.ndarray:
    """Length of the motion in each view, (views,) px; NaN where it is not known."""
    return np.array([np.nan if view.blur is None else view.blur.smear_px for view in views])


def median_smear(views: Sequence[HasBlur]) -> float:
    """Median length of the motion, px; NaN where it is known of no view."""
    known = smears(views)
    return float(np.nanmedian(known)) if np.isfinite(known).any() else float("nan")


def refusals(views: Sequence[HasBlur]) -> tuple[str, ...]:
    """Say why the pictures are too blurred; empty where they are not."""
    median = median_smear(views)
    if not median > TOO_SMEARED_PX:
        return ()
    return (
        f"motion smears the pictures by {median:.0f} px (median): hold the board still, bring more light, or expose "
        "shorter",
    )


def advice(views: Sequence[HasBlur], names: Sequence[str]) -> list[str]:
    """Name the pictures that motion smears most."""
    length = np.nan_to_num(smears(views))
    worst = [i for i in np.argsort(-length, kind="stable") if length[i] > SMEARED_PX]
    if not worst:
        return []
    listed = ", ".join(f"{names[i]} ({length[i]:.0f} px)" for i in worst[:5])
    more = f" and {len(worst) - 5} more" if len(worst) > 5 else ""
    are = "picture is" if len(worst) == 1 else "pictures are"
    return [f"{len(worst)} {are} smeared by motion: {listed}{more}; hold the board still, or expose shorter"]


def _edges(cells: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles of the edges between neighbours, the way along each, and the way across to the next edge, (m, 2) px."""
    low = cells.min(0)
    columns, rows = (cells.max(0) - low + 1).tolist()
    grid = np.full((columns * rows + 1, 2), np.nan)
    grid[(cells - low) @ (rows, 1)] = pixels
    # (m, 3, 2, 2): an edge, the one after it and the one before it; both ends of each.
    ends = grid[_beside(columns, rows)]
    middles = (ends[:, :, 0] + ends[:, :, 1]) / 2
    after, before = middles[:, 1] - middles[:, 0], middles[:, 0] - middles[:, 2]
    nearer = np.nan_to_num((after**2).sum(-1), nan=np.inf) <= np.nan_to_num((before**2).sum(-1), nan=np.inf)
    across = np.where(nearer[:, None], after, before)
    along = ends[:, 0, 1] - ends[:, 0, 0]
    good = np.isfinite(along[:, 0] + across[:, 0])
    return middles[good, 0], along[good], across[good]


@lru_cache(64)
def _beside(columns: int, rows: int) -> np.ndarray:
    """Of a grid the edges between neighbours, each with the next and the last edge beside it, and the ends of each.

    Returns:
        (edges, 3, 2), places of corners in the grid, column by column; the one after the last where there is none.
    """
    places = np.full((columns + 2, rows + 2), columns * rows)
    places[1:-1, 1:-1] = np.arange(columns * rows).reshape(columns, rows)
    found = []
    for lattice in (places, places.T):  # edges along the first axis; their neighbours are along the second
        here, there = lattice[1:-2], lattice[2:-1]
        ends = np.stack([here, there], -1)
        found.append(np.stack([ends[:, 1:-1], ends[:, 2:], ends[:, :-2]], 2).reshape(-1, 3, 2))
    return np.concatenate(found)


def _width(
    grey: np.ndarray, middles: np.ndarray, along: np.ndarray, normal: np.ndarray, reach: np.ndarray
) -> np.ndarray:
    """Standard deviation of each edge's blur across it, px; NaN where there is no clear edge."""
    import cv2

    s = np.linspace(-1.0, 1.0, _SAMPLES)
    lines = middles[:, None] + _LINES[:, None] * along[:, None]
    away = reach[:, None] * s
    x, y = (
        (lines[:, :, axis, None] + (away * normal[:, axis, None])[:, None]).astype(np.float32).reshape(len(middles), -1)
        for axis in (0, 1)
    )
    value = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    step = value.reshape(-1, _SAMPLES).astype(np.float32)
    low, high = step[:, :6].mean(1, keepdims=True), step[:, -6:].mean(1, keepdims=True)
    rise = high - low  # negative where the edge falls
    step -= low
    step /= np.where(rise == 0, 1.0, rise)
    quarter, middle, last = _crossings(step, np.array([0.25, 0.5, 0.75], np.float32))
    fine = np.abs(rise)[:, 0] > _LEAST_CONTRAST
    fine &= (np.abs(middle - (_SAMPLES - 1) / 2) < 0.3 * _SAMPLES) & (last > quarter)
    width = np.sort(np.where(fine, last - quarter, np.nan).reshape(len(middles), -1), axis=1)
    median = np.where(np.isnan(width[:, -1]), np.nan, width[:, len(_LINES) // 2])
    return median * 2 * reach / (_SAMPLES - 1) / _GAUSSIAN


def _crossings(step: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Where each row (n, m), noisy but rising, passes levels (k,), (k, n) samples: mean of first and last passage."""
    above = step > levels[:, None, None]
    m = step.shape[1]
    first = np.clip(above.argmax(2), 1, m - 1)
    last = np.clip(m - 1 - (~above[:, :, ::-1]).argmax(2), 0, m - 2)
    index = np.stack([first - 1, last])
    rows = np.arange(len(step))
    a, b = step[rows, index], step[rows, index + 1]
    rise = b - a
    part = (levels[:, None] - a) / np.where(np.abs(rise) < 1e-9, 1e-9, rise)
    return (index + np.clip(part, 0.0, 1.0)).sum(0) / 2
