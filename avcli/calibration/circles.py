"""Grids of circles: finding their centres, and what a lens makes of a circle's centre.

A circle's outline is not centred on the image of its centre: perspective and the lens push the two apart, the more the
larger the circle (Heikkilä and Silvén 1997 for perspective). What is measured is the centroid of the dark area;
`offsets` computes the difference once the lens is roughly known.
"""

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avcli.calibration.target import Board, Kind
from avcli.lens import Lens

_SEARCH_WIDTH = 1920
"""px; larger pictures are reduced to this before circles are searched."""
_REACH = 0.35
"""How far a neighbour may stand from where the lattice expects it, in steps."""
_LEAST_CIRCLES = 9
_LEAST_AREA = 16
"""px², of a circle."""
_LONGEST = 4.0
"""Longest over shortest axis of a circle's image."""
_BLOCKS = (40, 12, 4)
"""A pixel is dark against the mean of a square around it; the picture's longer side over the side of that square."""
_SEEDS = 4
"""Lattices that are looked for in one picture."""
_SURROUND = 1.7
"""Radius in which a circle's centroid is measured, in radii."""


def find(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the circles of a grid that is whole in the picture; None where it is not.

    Args:
        grey: (height, width) uint8.
        board: a grid of circles.

    Returns:
        which of the board's points, all in order, and the centroids of the circles (n, 2) px.
    """
    for found in _lattices(grey):
        for grid in _readings(found, board.kind):
            if grid.shape == (board.rows, board.columns):
                spots = found.spots[grid.ravel()]
                return np.arange(grid.size), _refined(grey, spots)
    return None


def recognise(grey: np.ndarray) -> Board | None:
    """Tell which grid of circles a picture (height, width) uint8 shows; None where there is none.

    A symmetric one has more rows.
    """
    kinds: tuple[Kind, ...] = ("circles", "asymmetric")
    for found in _lattices(grey):
        for kind in kinds:
            shapes = [grid.shape for grid in _readings(found, kind)]
            if shapes:
                rows, columns = max(shapes) if kind == "circles" else shapes[0]
                return Board(columns, rows, kind=kind, scaled=False)
    return None


def offsets(
    points: np.ndarray, rotations: np.ndarray, translations: np.ndarray, lens: Lens, radius_m: float
) -> np.ndarray:
    """Centroid of each circle's image minus the image of its centre, (n, 2) px; 0 where the lens does not see all.

    The outline is projected, and the centroid of the polygon is taken (Green's theorem).

    Args:
        points: (n, 3) m, the centres in the board's frame.
        rotations, translations: (n, 3, 3) and (n, 3) m, board to camera, for each point.
        lens: any model.
        radius_m: of the circles.
    """
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = radius_m * np.stack([np.cos(turn), np.sin(turn), np.zeros(48)], -1)
    around = np.einsum("nij,nkj->nki", rotations, points[:, None] + ring) + translations[:, None]
    seen = lens.project(around.reshape(-1, 3)).reshape(len(points), 48, 2)
    centre = lens.project(np.einsum("nij,nj->ni", rotations, points) + translations)
    u, v = np.moveaxis(seen - centre[:, None], 2, 0)
    u1, v1 = np.roll(u, -1, axis=1), np.roll(v, -1, axis=1)
    cross = u * v1 - u1 * v
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.stack([((u + u1) * cross).sum(1), ((v + v1) * cross).sum(1)], -1) / (3 * cross.sum(1))[:, None]
    return np.where(np.isfinite(off).all(1, keepdims=True), off, 0.0)


# --- the lattice ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Lattice:
    """Spots on a lattice of two basis vectors, the second clockwise of the first.

    Attributes:
        spots: (n, 5) x, y, and the covariance xx, xy, yy of each spot's area, px and px².
        cells: (n, 2) int, coordinates in the lattice.
    """

    spots: np.ndarray
    cells: np.ndarray


def _lattices(grey: np.ndarray) -> Iterator[_Lattice]:
    """Yield the lattices of dark spots in a picture, the largest first."""
    small, scale = grey, max(1.0, max(grey.shape) / _SEARCH_WIDTH)
    if scale > 1:
        import cv2

        size = round(grey.shape[1] / scale), round(grey.shape[0] / scale)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    spots = _spots(small)
    found = []
    free = np.ones(len(spots), bool)
    for _ in range(_SEEDS):
        if free.sum() < _LEAST_CIRCLES:
            break
        lattice = _grown(spots, free)
        members = np.array(list(lattice.values()))
        free[members] = False
        if len(members) >= _LEAST_CIRCLES:
            found.append(_Lattice(spots[members], np.array(list(lattice))))
    for one in sorted(found, key=lambda lattice: -len(lattice.cells)):
        places = (one.spots[:, :2] + 0.5) * scale - 0.5
        yield _Lattice(np.column_stack([places, one.spots[:, 2:] * scale**2]), one.cells)


def _spots(grey: np.ndarray) -> np.ndarray:
    """Dark elliptical spots, (n, 5) as in _Lattice: their second moments are those of a filled ellipse."""
    import cv2

    smooth, found = cv2.GaussianBlur(grey, (0, 0), 0.8), np.zeros((0, 5))
    half = cv2.resize(smooth, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    for part in _BLOCKS:
        # Spots that are too large for the least block are large in half the picture too, in a quarter of the time.
        times = 1 if part == max(_BLOCKS) else 2
        new = _dark_ellipses(smooth if times == 1 else half, max(7, int(max(grey.shape) / times / part) | 1))
        new[:, :2] = (new[:, :2] + 0.5) * times - 0.5
        new[:, 2:] *= times**2
        if len(found) and len(new):
            apart = np.linalg.norm(new[:, None, :2] - found[None, :, :2], axis=2).min(1)
            new = new[apart > 3]
        found = np.concatenate([found, new])
    return found


def _dark_ellipses(smooth: np.ndarray, block: int) -> np.ndarray:
    """Spots that are darker than the mean of a square of `block` px around them and smaller than it, as _spots."""
    import cv2

    dark = cv2.adaptiveThreshold(smooth, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, 10)
    _, labels, stats, middles = cv2.connectedComponentsWithStats(dark, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    possible = (area >= _LEAST_AREA) & (stats[:, cv2.CC_STAT_WIDTH] < block) & (stats[:, cv2.CC_STAT_HEIGHT] < block)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    possible &= (left > 1) & (top > 1) & (right < smooth.shape[1] - 1) & (bottom < smooth.shape[0] - 1)  # not cut
    possible[0] = False
    flat = np.flatnonzero(np.take(possible, np.asarray(labels, np.int32))).astype(np.int32)
    which, y = labels.ravel()[flat].astype(np.intp), flat // np.int32(smooth.shape[1])
    x_mean, y_mean = np.ascontiguousarray(middles.T)
    dx, dy = flat - y * np.int32(smooth.shape[1]) - x_mean[which], y - y_mean[which]
    moments = [np.bincount(which, a * b, len(area)) / np.maximum(area, 1) for a, b in ((dx, dx), (dx, dy), (dy, dy))]
    xx, xy, yy = moments[0] + 1 / 12, moments[1], moments[2] + 1 / 12
    spread = np.sqrt(np.maximum((xx - yy) ** 2 + 4 * xy**2, 0))
    long, short = (xx + yy + spread) / 2, np.maximum((xx + yy - spread) / 2, 1e-9)
    full = area / (4 * np.pi * np.sqrt(long * short))
    return np.column_stack([middles, xx, xy, yy])[possible & (np.abs(full - 1) < 0.1) & (long < _LONGEST**2 * short)]


def _grown(spots: np.ndarray, free: np.ndarray) -> dict[tuple[int, int], int]:
    """Grow a lattice from the free spot whose surroundings look most like one: cell -> spot."""
    import cv2

    places, sizes = spots[:, :2], np.sqrt(spots[:, 2] + spots[:, 4])
    members = np.flatnonzero(free)
    there = places[members]
    single = there.astype(np.float32)  # a tree would be quicker, but for the import of scipy.spatial: 0.25 s
    order = cv2.batchDistance(single, single, cv2.CV_32F, normType=cv2.NORM_L2, K=min(9, len(members)))[1]
    around = there[order[:, 1:]] - there[:, None]
    # In a lattice each neighbour has one on the other side.
    opposite = np.linalg.norm(around[:, :4, None] + around[:, None], axis=3).min(2)
    regular = (opposite / np.linalg.norm(around[:, :4], axis=2)).sum(1)
    seed = int(np.argmin(regular))
    first = around[seed, 0]
    across = np.abs(first[0] * around[seed, :, 1] - first[1] * around[seed, :, 0])
    aside = across > 0.5 * np.linalg.norm(first) * np.linalg.norm(around[seed], axis=1)
    start = int(members[seed])
    if not aside.any():
        return {(0, 0): start}
    second = around[seed, int(np.argmax(aside))]
    if first[0] * second[1] - first[1] * second[0] < 0:
        second = -second
    cells, taken = {(0, 0): start}, {start}
    steps = {(0, 0): np.stack([first, second])}
    waiting = deque([(0, 0)])
    while waiting:
        cell = waiting.popleft()
        at = places[cells[cell]]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            new = (cell[0] + sign * (axis == 0), cell[1] + sign * (axis == 1))
            if new in cells:
                continue
            step = sign * steps[cell][axis]
            off = np.hypot(*(there - (at + step)).T)
            index = int(off.argmin())
            distance, spot = float(off[index]), int(members[index])
            alike = 0.6 < sizes[spot] / sizes[cells[cell]] < 1.7
            if spot in taken or not alike or distance > _REACH * np.linalg.norm(steps[cell], axis=1).min():
                continue
            cells[new] = spot
            taken.add(spot)
            basis = steps[cell].copy()
            basis[axis] = sign * (places[spot] - at)
            steps[new] = basis
            waiting.append(new)
    return cells


def _readings(found: _Lattice, kind: Kind) -> list[np.ndarray]:
    """The ways to read a lattice as a whole grid: spots as (rows, columns) int; the most upright first."""
    count, grids = len(found.cells), {}
    for change in _CHANGES:
        cells = found.cells @ change.T
        if kind == "asymmetric":  # along the diagonals
            cells = np.stack([cells[:, 0] - cells[:, 1], cells[:, 0] + cells[:, 1]], -1)
        cells = cells - cells.min(0)
        columns, rows = cells.max(0) + 1
        if kind == "asymmetric":
            if columns % 2 or ((cells[:, 0] - cells[:, 1]) % 2).any():
                continue
            cells, columns = cells // [2, 1], columns // 2
        if min(columns, rows) < 2 or columns * rows != count:
            continue
        grid = np.full((rows, columns), -1)
        grid[cells[:, 1], cells[:, 0]] = np.arange(count)
        if (grid >= 0).all():
            grids[grid.tobytes()] = grid

    def upright(grid: np.ndarray) -> float:
        place = found.spots[grid][..., :2]
        along, down = place[:, -1].mean(0) - place[:, 0].mean(0), place[-1].mean(0) - place[0].mean(0)
        return float(along[0] / np.linalg.norm(along) + down[1] / np.linalg.norm(down))

    return sorted(grids.values(), key=upright, reverse=True)


_CHANGES = [
    np.array(rows).reshape(2, 2)
    for rows in itertools.product((-1, 0, 1), repeat=4)
    if rows[0] * rows[3] - rows[1] * rows[2] == 1
]
"""Other bases of the lattice, of the same handedness: a tilted grid's shortest steps may run along its diagonals."""


def _refined(grey: np.ndarray, spots: np.ndarray) -> np.ndarray:
    """Centroid of the darkness around each spot of the full picture, (n, 2) px."""
    height, width = grey.shape
    out = spots[:, :2].copy()
    for i, (x, y, xx, xy, yy) in enumerate(spots):
        inverse = np.linalg.inv([[xx, xy], [xy, yy]]) / 4  # of the ellipse: its variance is a quarter of radius²
        reach = 2 * _SURROUND * np.sqrt(max(xx, yy)) + 2
        left, right = max(int(x - reach), 0), min(int(x + reach) + 2, width)
        top, bottom = max(int(y - reach), 0), min(int(y + reach) + 2, height)
        value = grey[top:bottom, left:right].astype(float)
        for _ in range(2):
            dx, dy = np.arange(left, right) - out[i, 0], (np.arange(top, bottom) - out[i, 1])[:, None]
            radius = np.sqrt(inverse[0, 0] * dx * dx + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy * dy)
            inside, ring = radius < 0.6, (radius > 1.35) & (radius < _SURROUND)
            if inside.sum() < 3 or ring.sum() < 3:
                break
            light, dark = float(np.median(value[ring])), float(np.median(value[inside]))
            # Only the edge is measured: inside and outside, noise and uneven light do not count.
            darkness = np.clip(2 * (light - value) / max(light - dark, 1.0) - 0.5, 0, 1)
            weight = np.where(radius < 1.45, darkness, 0.0)
            total = weight.sum()
            if not total > 0:
                break
            out[i] += [float((weight * dx).sum() / total), float((weight * dy).sum() / total)]
    return out
