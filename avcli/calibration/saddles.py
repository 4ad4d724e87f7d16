"""Checkerboards of any size in a picture: saddle points of the brightness, joined into grids.

A corner of a checkerboard is a saddle point at which two edges cross: around it dark and bright take turns twice. Two
corners are neighbours if an edge of one leads to the other with dark on the side that both say. This needs no whole
board, no threshold on the picture and no search over sizes, so that a picture without a board costs no more than one
with one (compare Geiger et al. 2012, who grow boards from corner prototypes, and ROCHADE, Placht et al. 2014).
"""

import itertools
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration.pyramid import Pyramid

_MOST = 1500
"""Saddle points that are looked at: the strongest ones."""
_GRIDS = 6
"""Groups of corners that are grown into grids: the largest ones."""
_ASIDE = 0.35
"""rad, angle between an edge of a corner and where its neighbour lies, at most."""
_NEAREST, _CROWDED, _NEAREST_IN_CROWD = 20, 300, 8
"""Corners around a corner that may be its neighbours, and of more than so many corners, where they cost most."""
_JOINABLE, _SAMPLE = 400, 100
"""Of more corners only the strongest are joined, unless so many in their middle make a grid. The pictures of 22 real
sets have at most 280, and those of the board are among the first 180; texture has up to 1000."""
_BY_CHANCE = 60
"""In a picture full of corners chance joins some: groups with fewer than one in so many of them are not looked at."""
_JOINED = 0.8
"""Links between the corners of a group, over those of a square grid of as many, or it is no board. It is at least 0.87
for the boards of 22 real sets, however incompletely they are joined, and mostly less than 0.75 in texture."""
_LEAST_CONTRAST = 6.0
"""Grey levels between the dark and the bright side of a corner."""
_LEAST_SHOWN = 0.8
"""Share of a board's corners that must be found; glare or a finger may hide the others."""
_FULL_LINE = 0.7
"""Share of an outer row that must be found; less is an edge of the board, or clutter."""
_CUT_LINE = 0.4
"""Share of a line beyond a grid from which the grid counts as a part of a larger board. Edges and clutter beside the
boards of derlunz, dyf and fish_1 fill at most 0.33 of one."""
_BEYOND = 3
"""Corners by which a grid, with clutter beside it, may be longer than the board that is wanted and is still grown."""
_WIDTHS = (640, 1280, 320)
"""px; boards are looked for in pictures reduced to these widths: small ones are quick, and hide blur and noise."""
_QUICK_WIDTH, _LARGE = 320, 7.0
"""px; a whole board is looked for in a picture of this width first, and taken if its corners are so far apart there. It
costs a quarter. Of nearer corners one board of derlunz was misread."""
_CROWD = 3
"""Times a board's corners that may be in that picture: of more it costs too much to tell them from clutter."""
_UPRIGHT = 0.05
"""Sine of a row's angle to the vertical up to which it is close whether the row leads to the right or to the left."""
_BENT, _MOST_BENT, _SMOOTH = 0.15, 0.25, 0.6
"""What `_bend` gives at most for a board, or corners are none: at most 0.14 in 22 real sets, mostly more than 0.25 in
blotches. Near boards before a fisheye reach 0.19 (eaglez), but there the third differences are at most 0.53 times as
large; in blotches they are about as large."""
_TURNS = 0.95
"""Share of the comparisons between neighbouring squares in which dark and bright take turns, in a grid. It is at least
0.97 on derlunz, dyf and fish_1, and mostly below 0.9 in blotches."""
_COMPARED = 0.5
"""Share of the comparisons in a whole grid that must be right; where corners are hidden, squares are."""
_IN_SQUARE = np.array([[0.5, 0.5], [0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
"""Places in a square where it is compared with its neighbours, in sides."""
_BLUR, _RADIUS = 1.2, 4.0
"""px; what pictures are smoothed with, and the circle around a corner on which dark and bright must take turns."""
_RING = 32
"""Samples on the circle around a corner."""


@dataclass(frozen=True)
class Grid:
    """A grid of corners.

    Attributes:
        cells: (n, 2) whole numbers from 0, place in the grid along u and v, v being clockwise of u in the picture.
        pixels: (n, 2) px.
        columns, rows: extent of the grid along u and v.
        dark: whether the square between cells (0, 0) and (1, 1) is dark.
        is_cut: whether there are further corners, too few to be told from the edge of a board.
    """

    cells: np.ndarray
    pixels: np.ndarray
    columns: int
    rows: int
    dark: bool
    is_cut: bool

    def as_board(self, inner: tuple[int, int]) -> tuple[np.ndarray, np.ndarray] | None:
        """Number the corners as a board of `inner` corners along a row and a column does.

        The first square between corners is dark; where that leaves a choice, rows lead to the right.

        Returns:
            ids (n,) ascending, and pixels (n, 2); None where the grid is no such board, or more than a fifth is hidden.
        """
        if sorted((self.columns, self.rows)) != sorted(inner) or len(self.cells) < _LEAST_SHOWN * inner[0] * inner[1]:
            return None
        u, v = self.cells.T
        columns, rows = self.columns - 1, self.rows - 1
        ways = ((u, v), (v, columns - u), (columns - u, rows - v), (rows - v, u))
        choices = []
        for turn, (x, y) in enumerate(ways):
            if (self.columns, self.rows)[:: -1 if turn % 2 else 1] != inner:
                continue
            first = ((0, 0), (columns, 0), (columns, rows), (0, rows))[turn]
            # Squares between corners: the one at the first corner, seen from there.
            square = min(first[0], columns - 1), min(first[1], rows - 1)
            dark = self.dark == (sum(square) % 2 == 0)
            along = float((x - x.mean()) @ self.pixels[:, 0])  # the sign of the slope
            choices.append((dark, along, x, y))
        _, _, x, y = max(choices, key=lambda choice: choice[:2])
        ids = y * inner[0] + x
        order = np.argsort(ids)
        return ids[order], self.pixels[order]


@dataclass(frozen=True)
class _Corners:
    """Corners that stand by themselves.

    Attributes:
        pixels: (n, 2) px.
        arms: (n, 4) rad, directions of the four edges, ascending; dark lies between arms 0 and 1, and 2 and 3.
    """

    pixels: np.ndarray
    arms: np.ndarray


class _Room(threading.local):
    """Arrays that a thread uses again for each picture: new ones would cost more than what is computed in them."""

    def __init__(self) -> None:
        self.planes: np.ndarray = np.empty((0, 0, 0), np.float32)

    def of(self, shape: tuple[int, ...]) -> np.ndarray:
        """Six planes of this shape (height, width) float32."""
        if self.planes.shape[1:] != shape:
            self.planes = np.empty((6, *shape), np.float32)
        return self.planes


_ROOM = _Room()


class _Relief:
    """A smoothed picture, its derivatives and how much of a saddle each pixel is; valid until the thread's next one."""

    def __init__(self, grey: np.ndarray, blur: float):
        import cv2

        self.grey, self.xx, self.yy, self.xy, self.saddle, self._spare = _ROOM.of(grey.shape)
        self._spare[:] = grey
        cv2.GaussianBlur(self._spare, (7, 7), blur, dst=self.grey)
        cv2.Sobel(self.grey, cv2.CV_32F, 2, 0, dst=self.xx, ksize=3, scale=0.25)
        cv2.Sobel(self.grey, cv2.CV_32F, 0, 2, dst=self.yy, ksize=3, scale=0.25)
        cv2.Sobel(self.grey, cv2.CV_32F, 1, 1, dst=self.xy, ksize=3, scale=0.25)
        np.multiply(self.xx, self.yy, out=self._spare)
        np.multiply(self.xy, self.xy, out=self.saddle)
        self.saddle -= self._spare

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Brightness at places (n, m) px."""
        import cv2

        return cv2.remap(
            self.grey, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )

    def peaks(self) -> np.ndarray:
        """Local maxima of the saddle, the strongest first: (n, 2) whole px."""
        import cv2

        top = cv2.dilate(self.saddle, np.ones((5, 5), np.uint8), dst=self._spare)
        floor = (_LEAST_CONTRAST / 6) ** 2  # an ideal corner of this contrast, blurred by about 1.4 px
        y, x = np.divmod(np.flatnonzero((self.saddle >= top) & (self.saddle > floor)), self.grey.shape[1])
        inside = (x > 3) & (y > 3) & (x < self.grey.shape[1] - 4) & (y < self.grey.shape[0] - 4)
        x, y = x[inside], y[inside]
        order = np.argsort(-self.saddle[y, x], kind="stable")[:_MOST]
        return np.stack([x[order], y[order]], -1)

    def settled(self, peaks: np.ndarray) -> np.ndarray:
        """Places of the saddle points near whole pixels (n, 2), by one Newton step: (n, 2) px."""
        x, y = peaks.T
        g = self.grey
        gx, gy = (g[y, x + 1] - g[y, x - 1]) / 2, (g[y + 1, x] - g[y - 1, x]) / 2
        xx, yy, xy = self.xx[y, x], self.yy[y, x], self.xy[y, x]
        determinant = np.minimum(xx * yy - xy * xy, -1e-6)
        step = np.stack([-(yy * gx - xy * gy), -(xx * gy - xy * gx)], -1) / determinant[:, None]
        return peaks + np.clip(step, -1.5, 1.5)


def _verified(relief: _Relief, pixels: np.ndarray, radius: float | np.ndarray) -> tuple[_Corners, np.ndarray]:
    """Keep the places around which dark and bright take turns twice on a circle; also which they are, (n,) bool.

    The radius is in px, one for all or (n, 1).
    """
    turn = 2 * np.pi * np.arange(_RING) / _RING
    ring = relief.sample(pixels[:, :1] + radius * np.cos(turn), pixels[:, 1:] + radius * np.sin(turn))
    # Opposite samples agree around a saddle; their mean is free of a slope of the light.
    opposite = ring[:, _RING // 2 :]
    both = (ring[:, : _RING // 2] + opposite) / 2
    low, high = both.min(1), both.max(1)
    contrast = high - low
    skew = np.abs(ring[:, : _RING // 2] - opposite).mean(1)
    index = np.flatnonzero((contrast > _LEAST_CONTRAST) & (skew < 0.45 * contrast))
    ring, level = ring[index], (low[index] + high[index])[:, None] / 2
    bright = ring > level
    following = np.roll(bright, -1, 1)
    rising, falling = ~bright & following, bright & ~following
    good = (rising.sum(1) == 2) & (falling.sum(1) == 2)
    index, ring, level, rising, falling = (part[good] for part in (index, ring, level, rising, falling))
    n = len(ring)

    def crossings(where: np.ndarray) -> np.ndarray:
        row, at = np.nonzero(where)
        here, there = ring[row, at], ring[row, (at + 1) % _RING]
        return ((at + (level[row, 0] - here) / (there - here)) * 2 * np.pi / _RING).reshape(n, 2)

    up, down = crossings(rising), crossings(falling)
    # Dark begins where the circle falls and ends where it rises: arms (fall, rise, fall, rise).
    first, second = down[:, 0], down[:, 1]
    after = np.where(up > first[:, None], up, up + 2 * np.pi).min(1)
    between = np.where(up > second[:, None], up, up + 2 * np.pi).min(1)
    arms = np.stack([first, after, second, between], 1)
    straight = (_apart(arms[:, :2] + np.pi - arms[:, 2:]) < 0.5).all(1)
    chosen = np.zeros(len(pixels), bool)
    chosen[index[straight]] = True
    return _Corners(pixels[chosen], arms[straight]), chosen


def _apart(angle: np.ndarray) -> np.ndarray:
    """Size of an angle, rad, whole turns not counted; up to pi. The array is overwritten."""
    angle /= 2 * np.pi
    angle -= np.rint(angle)
    np.abs(angle, out=angle)
    angle *= 2 * np.pi
    return angle


def _neighbours(corners: _Corners) -> tuple[np.ndarray, np.ndarray]:
    """Which corner each of the four arms leads to, and with which of its arms that one leads back: (n, 4), -1 none."""
    n = len(corners.pixels)
    to, back = np.full((n, 4), -1), np.full((n, 4), -1)
    if n < 4:
        return to, back
    distance, other = _nearest(corners.pixels, min(_NEAREST if n <= _CROWDED else _NEAREST_IN_CROWD, n - 1))
    apart = corners.pixels[other] - corners.pixels[:, None]
    ways = np.stack([np.cos(corners.arms), np.sin(corners.arms)], 1)
    # Texture has hundreds of corners, but few of their pairs lie along an arm: only those are looked at closer.
    along = (apart @ ways).reshape(n, -1)
    near = np.where(distance > 3, np.cos(_ASIDE) * distance, np.inf)
    one, at = np.nonzero(along > np.repeat(near, 4, axis=1))
    at, arm = at // 4, at % 4
    there, away, distance = other[one, at], apart[one, at], distance[one, at]
    ahead = _aside(away, ways[one, :, arm])
    # An odd arm of one is an even arm of the next, since dark and bright change sides.
    first, second = 1 - arm % 2, 3 - arm % 2
    by_first, by_second = (_aside(-away, ways[there, :, its]) for its in (first, second))
    theirs, off = np.where(by_second < by_first, second, first), np.minimum(by_first, by_second)
    fits = off < _ASIDE
    one, arm, there, theirs = one[fits], arm[fits], there[fits], theirs[fits]
    cost = distance[fits] * (1 + 2 * (ahead[fits] + off[fits]))
    order = np.lexsort((cost, 4 * one + arm))[::-1]  # of many, the last one that is written stays: the cheapest
    to[one[order], arm[order]], back[one[order], arm[order]] = there[order], theirs[order]
    rows, arms = np.nonzero(to >= 0)
    mutual = (to[to[rows, arms], back[rows, arms]] == rows) & (back[to[rows, arms], back[rows, arms]] == arms)
    to[rows[~mutual], arms[~mutual]] = -1
    # A step that is far longer than the one on the other side has jumped over a corner.
    length = np.where(to >= 0, np.linalg.norm(corners.pixels[to] - corners.pixels[:, None], axis=2), np.inf)
    jumped = (length > 2.2 * np.roll(length, 2, 1)) & (to >= 0)
    rows, arms = np.nonzero(jumped)
    to[to[rows, arms], back[rows, arms]] = -1
    to[rows, arms] = -1
    return to, back


def _is_joined(links: np.ndarray) -> bool:
    """Whether corners with so many neighbours each (n,) may be a grid; most of those of texture hang on strings."""
    return bool(links.sum() >= 4 * _JOINED * (len(links) - np.sqrt(len(links))))


def _joinable(corners: _Corners) -> _Corners:
    """The corners, or of very many the strongest; if those in the middle make a grid, it is a large board."""
    if len(corners.pixels) > _JOINABLE:
        away = ((corners.pixels - np.median(corners.pixels, axis=0)) ** 2).sum(1)
        middle = np.argsort(away, kind="stable")[:_SAMPLE]
        to, _ = _neighbours(_Corners(corners.pixels[middle], corners.arms[middle]))
        if not _is_joined((to >= 0).sum(1)):
            return _Corners(corners.pixels[:_JOINABLE], corners.arms[:_JOINABLE])
    return corners


def _aside(away: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Angle, rad, between vectors (n, 2) and unit vectors (n, 2)."""
    (x, y), (u, v) = away.T, ways.T
    return np.abs(np.arctan2(u * y - v * x, u * x + v * y))


def _nearest(pixels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances of each of the pixels (n, 2) to the `count` nearest others, and which they are, (n, count)."""
    import cv2

    places = pixels.astype(np.float32)
    distance, other = cv2.batchDistance(places, places, cv2.CV_32F, normType=cv2.NORM_L2, K=count + 1)
    return distance[:, 1:], other[:, 1:]


def _labelled(to: np.ndarray, back: np.ndarray) -> list[dict[tuple[int, int], int]]:
    """Join neighbours into grids: for each a table from cell to corner, the largest first."""
    steps = ((1, 0), (0, 1), (-1, 0), (0, -1))
    grids = []
    links, returns, turn = to.tolist(), back.tolist(), [-1] * len(to)
    count = (to >= 0).sum(1)
    order = np.argsort(-count, kind="stable")
    for seed in order[: int((count >= 2).sum())].tolist():  # what is left makes pairs at most
        if turn[seed] >= 0:
            continue
        turn[seed] = 0
        cells, place, queue = {(0, 0): seed}, {seed: (0, 0)}, [seed]
        for one in queue:
            u, v = place[one]
            for arm in range(4):
                other = links[one][arm]
                if other < 0 or turn[other] >= 0:
                    continue
                way = (arm - turn[one]) % 4
                cell = u + steps[way][0], v + steps[way][1]
                if cell in cells:
                    continue
                turn[other] = (returns[one][arm] - way - 2) % 4
                cells[cell], place[other] = other, cell
                queue.append(other)
        grids.append(cells)
    return sorted(grids, key=len, reverse=True)


def _grown(relief: _Relief, cells: dict[tuple[int, int], np.ndarray], radius: float, most: float) -> None:
    """Look for further corners where the grid says that they must be, until there are none or it is too long."""
    for _ in range(12):
        if np.ptp(np.array(list(cells)), axis=0).max() >= most:
            return
        names, guesses, steps = _guessed(cells)
        which, places = _confirmed(relief, guesses, steps, radius)
        added = {}
        for index, at in zip(which, places, strict=True):
            u, v = names[index]
            around = [cells[near] for near in itertools.product((u - 1, u, u + 1), (v - 1, v, v + 1)) if near in cells]
            if (np.linalg.norm(np.array(around) - at, axis=1) > 0.4 * steps[index]).all():
                added[u, v] = at
        if not added:
            return
        cells.update(added)


def _bend(cells: dict[tuple[int, int], np.ndarray], order: int = 2) -> float:
    """Median of the second (or another) difference of corners in a line over the distance of the outer ones; 0 without.

    The lines of a print are smooth, however a lens bends them; those of mere texture are not.
    """
    if len(cells) < 3:
        return 0.0
    grid, found = _spread(cells), []
    for lines in (grid, grid.swapaxes(0, 1)):
        apart = np.maximum(np.linalg.norm(lines[order:] - lines[:-order], axis=2), 1e-9)
        off = np.linalg.norm(np.diff(lines, order, axis=0), axis=2) / apart
        found.append(off[np.isfinite(off)])
    bends = np.sort(np.concatenate(found))  # np.median takes five times as long for so few
    return float(bends[(len(bends) - 1) // 2] + bends[len(bends) // 2]) / 2 if len(bends) else 0.0


def _spread(cells: dict[tuple[int, int], np.ndarray]) -> np.ndarray:
    """The corners of a grid as an array (columns, rows, 2) px, NaN where there is none."""
    names = np.array(list(cells))
    low = names.min(0)
    grid = np.full((*(names.max(0) - low + 1), 2), np.nan)
    grid[tuple((names - low).T)] = list(cells.values())
    return grid


def _alternation(relief: _Relief, cells: dict[tuple[int, int], np.ndarray]) -> tuple[float, float]:
    """Tell whether the squares between the corners are dark and bright in turn.

    Returns:
        the share of the comparisons between neighbouring squares, at five places in each, that say so; and how many
        that are of those in a grid without a gap. A corner that is missing alone is where its square has it.
    """
    grid = _spread(cells)
    columns, rows = grid.shape[0] - 1, grid.shape[1] - 1
    if min(columns, rows) < 1:
        return 0.0, 0.0
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]])
    beside, opposite = corners[[3, 0, 1, 2]] + corners[[1, 2, 3, 0]], corners[[2, 3, 0, 1]]
    corners = np.where(np.isnan(corners), beside - opposite, corners)
    u, v = _IN_SQUARE.T
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], -1)
    x, y = (weights @ corners[..., axis].reshape(4, -1) for axis in (0, 1))
    value = np.where(np.isnan(x), np.nan, relief.sample(np.nan_to_num(x), np.nan_to_num(y)))
    value = value.reshape(-1, columns, rows)
    turn = 1 - 2 * (np.add.outer(np.arange(columns), np.arange(rows)) % 2)
    across, along = np.diff(value, axis=1) * turn[1:], np.diff(value, axis=2) * turn[:, 1:]
    steps = np.concatenate([across.ravel(), along.ravel()])
    compared = int(np.isfinite(steps).sum())
    right = max(int((steps > 0).sum()), int((steps < 0).sum()))
    return right / max(compared, 1), right / max(len(steps), 1)


def _guessed(cells: dict[tuple[int, int], np.ndarray]) -> tuple[list[tuple[int, int]], np.ndarray, np.ndarray]:
    """The free cells beside a grid, where they must be (n, 2) px, and how far that is from their neighbour (n,) px."""
    names = np.array(list(cells))
    low = names.min(0) - 3  # as far as is looked back
    spread = np.full((*(names.max(0) - low + 10), 2), np.nan)
    spread[tuple((names - low + 3).T)] = list(cells.values())
    columns, rows = spread.shape[0] - 6, spread.shape[1] - 6
    grid = spread[3:-3, 3:-3]
    free = np.isnan(grid[..., 0])
    nearest, guesses = np.full(free.shape, np.inf), grid
    for u, v in ((-1, 0), (0, -1), (1, 0), (0, 1)):
        here, before, further = (
            spread[3 + u * count : 3 + u * count + columns, 3 + v * count : 3 + v * count + rows] for count in (1, 2, 3)
        )
        guess = np.where(np.isnan(further), 2 * here - before, 2.5 * here - 2 * before + 0.5 * further)
        ahead = guess - here
        step = np.hypot(ahead[..., 0], ahead[..., 1])
        nearer = free & (step < nearest)
        nearest, guesses = np.where(nearer, step, nearest), np.where(nearer[..., None], guess, guesses)
    found = np.argwhere(np.isfinite(nearest))
    at = tuple(found.T)
    return [(u, v) for u, v in (found + low).tolist()], guesses[at], nearest[at]


def _confirmed(relief: _Relief, guesses: np.ndarray, steps: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of the guessed places (n, 2) px, each `steps` (n,) px from a neighbour, have a corner near, and where."""
    height, width = relief.grey.shape
    reach = np.maximum(2, np.rint(0.25 * steps))[:, None]
    middle = np.rint(guesses)
    low = np.maximum(middle - reach, 4).astype(int)
    high = np.minimum(middle + reach, [width - 5, height - 5]).astype(int)
    which, places = [], []
    for index, ((x0, y0), (x1, y1)) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        if x0 > x1 or y0 > y1:
            continue
        part = relief.saddle[y0 : y1 + 1, x0 : x1 + 1]
        row, column = divmod(int(part.argmax()), part.shape[1])
        if part[row, column] > 0:
            which.append(index)
            places.append((x0 + column, y0 + row))
    if not which:
        return np.zeros(0, int), np.zeros((0, 2))
    settled = relief.settled(np.array(places))
    twice = np.repeat([radius, 0.6 * radius], len(which))[:, None]
    good = _verified(relief, np.tile(settled, (2, 1)), twice)[1].reshape(2, -1).any(0)
    return np.array(which)[good], settled[good]


def _trimmed(cells: dict[tuple[int, int], np.ndarray]) -> tuple[dict[tuple[int, int], np.ndarray], bool]:
    """Take away outer rows and columns too little of which was found: an edge of the board may look like one.

    Returns:
        what is left, and whether much of a line was taken away.
    """
    every = list(cells)
    while cells:
        names = np.array(list(cells))
        low, high = names.min(0), names.max(0)
        sparse = None
        for axis in (0, 1):
            length = high[1 - axis] - low[1 - axis] + 1
            for end in (low[axis], high[axis]):
                count = int((names[:, axis] == end).sum())
                if count < _FULL_LINE * length and (sparse is None or count / length < sparse[2]):
                    sparse = axis, int(end), count / length
        if sparse is None:
            break
        cells = {cell: at for cell, at in cells.items() if cell[sparse[0]] != sparse[1]}
    return cells, bool(cells) and len(every) > len(cells) and _is_cut(np.array(every), np.array(list(cells)))


def _is_cut(every: np.ndarray, left: np.ndarray) -> bool:
    """Whether one of the lines next to the cells that are left (n, 2) holds many of all the cells (m, 2)."""
    low, high = left.min(0), left.max(0)
    for axis in (0, 1):
        along = every[(every[:, 1 - axis] >= low[1 - axis]) & (every[:, 1 - axis] <= high[1 - axis]), axis]
        length = high[1 - axis] - low[1 - axis] + 1
        counts = [int((along == line).sum()) for line in (low[axis] - 1, high[axis] + 1)]
        if max(counts) >= max(_CUT_LINE * length, 4):
            return True
    return False


def find_grids(
    grey: np.ndarray,
    *,
    blur: float = _BLUR,
    radius: float = _RADIUS,
    least: int = 9,
    most: float = np.inf,
    crowd: float = np.inf,
) -> list[Grid]:
    """Find the checkerboards in a picture, the largest first; parts of a board count as boards.

    Args:
        grey: (height, width) uint8, reduced to about 1000 px.
        blur: px, sd of the Gaussian that smooths the picture.
        radius: px, of the circle around a corner on which dark and bright must take turns twice.
        least: corners of a grid.
        most: corners along a grid from which it is not made longer.
        crowd: corners in the picture beyond which no grid is looked for.
    """
    relief = _Relief(grey, blur)
    corners = _standing(relief, radius)
    return [] if len(corners.pixels) > crowd else _joined(relief, corners, radius, least, most)


def _standing(relief: _Relief, radius: float) -> _Corners:
    """The corners in a picture, the strongest first."""
    peaks = relief.peaks()
    if len(peaks) < 4:
        return _Corners(np.zeros((0, 2)), np.zeros((0, 4)))
    return _verified(relief, relief.settled(peaks), radius)[0]


def _joined(relief: _Relief, corners: _Corners, radius: float, least: int, most: float) -> list[Grid]:
    """Join corners into grids, as `find_grids`."""
    count, corners = len(corners.pixels), _joinable(corners)
    out: list[Grid] = []
    largest = 0
    to, back = _neighbours(corners)
    links = (to >= 0).sum(1)
    for found in _labelled(to, back)[:_GRIDS]:
        if len(found) < max(4, least // 2, largest // 4, count // _BY_CHANCE):
            break
        if not _is_joined(links[list(found.values())]):
            continue
        cells = {cell: corners.pixels[index] for cell, index in found.items()}
        start = cells[(0, 0)]
        if any((np.abs(grid.pixels - start).max(1) < 2).any() for grid in out):
            continue
        turns = _alternation(relief, cells)
        if turns[0] < _TURNS:
            continue
        bend = _bend(cells)
        if bend > _MOST_BENT:
            continue
        joined = set(cells)
        _grown(relief, cells, radius, most)
        cells, is_cut = _trimmed(cells)
        if len(cells) < least:
            continue
        if cells.keys() != joined:
            turns, bend = _alternation(relief, cells), _bend(cells)
        if turns[0] < _TURNS or turns[1] < _COMPARED or bend > _MOST_BENT:
            continue
        if bend > _BENT and _bend(cells, 3) > _SMOOTH * bend:
            continue
        largest = max(largest, len(cells))
        names, pixels = np.array(list(cells)), np.array(list(cells.values()))
        low = names.min(0)
        names = names - low
        columns, rows = (names.max(0) + 1).tolist()
        order = np.lexsort((names[:, 0], names[:, 1]))
        out.append(Grid(names[order], pixels[order], columns, rows, bool(sum(low) % 2 == 0), is_cut))
    return sorted(out, key=lambda grid: -len(grid.pixels))


@dataclass(frozen=True)
class Found:
    """A board in a picture.

    Attributes:
        ids: (n,) of its corners, ascending.
        pixels: (n, 2) px.
        error: px, how far they may be off.
        quickly: whether it was found in a very small picture.
    """

    ids: np.ndarray
    pixels: np.ndarray
    error: float
    quickly: bool = False


def find_board(
    picture: np.ndarray | Pyramid, inner: tuple[int, int], *, thorough: bool = True, quickly: bool = True
) -> Found | None:
    """Find a checkerboard of `inner` corners along a row and a column, at least four fifths of it; None without one.

    Args:
        picture: (height, width) uint8.
        inner: of the whole board: a part of a larger one is not taken for it.
        thorough: look for small, oblique and blurred boards even where nothing speaks for one.
        quickly: take a large board, wholly seen, from a very small picture.
    """
    best: Found | None = None
    picture, total = Pyramid.of(picture), inner[0] * inner[1]
    if quickly:
        small, scale = picture.reduced(_QUICK_WIDTH)
        best = _largest(find_grids(small, crowd=_CROWD * total, **_wanted(inner)), inner, scale)
        if best is not None and len(best.ids) == total and _is_clear(best, inner[0], scale):
            return replace(best, error=scale / 2, quickly=True)
        best = None
    for width, scale in _widths(picture):
        grids = _grids_of(picture, width, **_wanted(inner))
        found = _largest(grids, inner, scale)
        if found is not None and (best is None or len(found.ids) > len(best.ids)):
            best = found
        if best is not None and len(best.ids) == total:
            break
        if not thorough and not grids:
            break
    return best


def _wanted(inner: tuple[int, int]) -> dict[str, int]:
    return {"least": max(6, inner[0] * inner[1] // 4), "most": max(inner) + _BEYOND}


def _grids_of(picture: Pyramid, width: int, least: int, most: float = np.inf) -> list[Grid]:
    """As `find_grids` in the picture reduced to a width, px; a picture that showed no grid is not searched again.

    One with more corners than are joined, and no grid, is not searched in other sizes: it would show more of the same.
    """
    if picture.crowded or picture.in_vain.get(width, least + 1) <= least:
        return []
    relief = _Relief(picture.reduced(width)[0], _BLUR)
    corners = _standing(relief, _RADIUS)
    grids = _joined(relief, corners, _RADIUS, least, most)
    if not grids:
        picture.in_vain[width], picture.crowded = least, len(corners.pixels) > _JOINABLE
    return grids


def _largest(grids: list[Grid], inner: tuple[int, int], scale: float) -> Found | None:
    """The most complete board of `inner` corners among grids of a picture that was reduced by `scale`."""
    boards = [board for grid in grids if (board := grid.as_board(inner)) is not None]
    if not boards:
        return None
    ids, pixels = max(boards, key=lambda board: len(board[0]))
    return Found(ids, (pixels + 0.5) * scale - 0.5, scale)


def _is_clear(found: Found, columns: int, scale: float) -> bool:
    """Whether the corners are far apart, and which way the rows lead is not close: the board may be alike both ways."""
    x, y = found.pixels.T
    squared = np.square(np.subtract.outer(x, x)) + np.square(np.subtract.outer(y, y))
    np.fill_diagonal(squared, np.inf)
    column = found.ids % columns
    way = (column - column.mean()) @ found.pixels
    return bool(squared.min() >= (_LARGE * scale) ** 2 and abs(way[0]) > _UPRIGHT * np.hypot(*way))


def _widths(picture: Pyramid) -> Iterator[tuple[int, float]]:
    """Each of the widths that makes another picture, and the factor back to the full one."""
    done: set[float] = set()
    for longest in _WIDTHS:
        scale = picture.reduced(longest)[1]
        if scale not in done:
            done.add(scale)
            yield longest, scale


def sizes(picture: np.ndarray | Pyramid, least: int = 9, *, thorough: bool = True) -> list[tuple[int, int]]:
    """Inner corners (along u, along v) of the whole checkerboards in a picture, the largest first.

    A grid that more corners join, though too few for a line of it, is a part of a larger board, and does not count.
    `thorough` is that of `find_board`.
    """
    picture = Pyramid.of(picture)
    for width, _ in _widths(picture):
        grids = _grids_of(picture, width, least)
        whole = [g for g in grids if len(g.pixels) == g.columns * g.rows >= least]
        whole = [g for g in whole if min(g.columns, g.rows) >= 2 and not g.is_cut]
        if whole:
            return [(g.columns, g.rows) for g in whole]
        if not thorough and not grids:
            break
    return []
