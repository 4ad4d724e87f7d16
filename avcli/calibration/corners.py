"""Board corners in a picture: found small, refined on the full picture, and polished once the lens is known.

A picture is (height, width) uint8 here; `to_grey` makes one of any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from avcli.calibration import circles, markers, saddles, sharpness
from avcli.calibration.pyramid import Pyramid
from avcli.calibration.sharpness import Blur
from avcli.calibration.target import Board

_KEEP_WIDTH = 1280
"""px; pictures without a board are kept reduced to this width."""
LEAST_GUESSED = 16
"""Inner corners of a checkerboard whose size is guessed: noise may look like a smaller one."""
_AT_ONCE = 128
"""Corners that are polished at once: what they need stays in the processor's cache."""
_PLANES = 19
"""Numbers a pixel while corners are polished. Their memory is used again: new memory would cost half the time."""
PATCH = 12
"""px; half the side of the square around each corner that is kept for `polish`."""
_REACH = 0.75
"""Squares from the corner that are used, less than 1."""
_STEEP = 1.2
"""An edge that is blurred by a Gaussian of sd 1 rises about as tanh(1.2 t)."""


@dataclass(frozen=True)
class View:
    """The corners of one picture.

    Attributes:
        ids: (n,) which of the board's corners.
        pixels: (n, 2) px.
        patches: (n, 2 PATCH + 1, 2 PATCH + 1) uint8, the picture around each corner.
        origins: (n, 2) px, the pixel of each patch's middle.
        width, height: px, of the picture.
        blur: of the edges between the corners; None where it cannot be told.
    """

    ids: np.ndarray
    pixels: np.ndarray
    patches: np.ndarray
    origins: np.ndarray
    width: int
    height: int
    blur: Blur | None = None

    @cached_property
    def middle(self) -> tuple[float, float]:
        """The mean of the corners, px."""
        x, y = self.pixels.mean(0).tolist()
        return x, y

    @cached_property
    def run(self) -> tuple[int, int]:
        """The first of the corners and how many there are, where none between the first and the last is missing."""
        return (int(self.ids[0]), len(self.ids)) if self.ids[-1] - self.ids[0] + 1 == len(self.ids) else (-1, 0)


def to_grey(image: np.ndarray) -> np.ndarray:
    """Turn a picture (height, width[, 1, 3 RGB or 4 RGBA]) of 8 or 16 bits or floats into (height, width) uint8.

    Pictures of more than 8 bits are stretched from black to their brightest pixel, since many hold 10 or 12 bits only.
    """
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] in (1, 2):
        image = image[:, :, 0]
    elif image.ndim == 3:
        red, green, blue = (image[:, :, i].astype(np.float32) for i in range(3))
        image = 0.299 * red + 0.587 * green + 0.114 * blue if image.dtype != np.uint8 else _grey_of_rgb(image)
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    top = float(np.nanmax(image)) if image.size else 0.0
    if not top > 0:
        return np.zeros(image.shape, np.uint8)
    return np.clip(np.nan_to_num(image.astype(np.float32)) * (255.0 / top) + 0.5, 0, 255).astype(np.uint8)


def _grey_of_rgb(image: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)


def find(picture: np.ndarray | Pyramid, board: Board, *, thorough: bool = True, likely: bool = True) -> View | None:
    """Find a board's corners; None where there is no board.

    Args:
        picture: (height, width) uint8.
        board: a checkerboard must be in the picture with its four sides, up to a fifth of its corners hidden; a grid
            of circles wholly; of a board with markers six corners are enough.
        thorough: see saddles.find_board.
        likely: whether a checkerboard is likely to be there; it is then looked for in a very small picture first.
    """
    picture = Pyramid.of(picture)
    grey = picture.grey
    if min(grey.shape) < 32:
        return None
    if board.markers:
        coarse = markers.find(grey, board)
        found = coarse and (coarse[0], _subpixel(grey, *coarse[1:])[0])
    elif board.has_circles:
        found = circles.find(grey, board)
    else:
        found = _find_checkerboard(picture, board.inner, thorough, likely)
    if not found:
        return None
    view = view_of(grey, *found)
    if board.kind not in ("checkerboard", "charuco"):
        return view
    cells = np.stack([view.ids % board.inner[0], view.ids // board.inner[0]], -1)
    return replace(view, blur=sharpness.blur(grey, cells, view.pixels, min(0.35, board.clear[1])))


def view_of(grey: np.ndarray, ids: np.ndarray, pixels: np.ndarray) -> View:
    """Make a view of corners (n, 2) px with the picture around each."""
    height, width = grey.shape
    origins = np.clip(np.rint(pixels), 0, [width - 1, height - 1]).astype(int)
    columns, rows = origins.T
    side = 2 * PATCH + 1
    if min(origins.min(0)) >= PATCH and max(columns) < width - PATCH and max(rows) < height - PATCH:
        windows = np.lib.stride_tricks.sliding_window_view(grey, (side, side))
        patches = windows[rows - PATCH, columns - PATCH]
    else:
        span = np.arange(-PATCH, PATCH + 1)
        columns, rows = (np.clip(at[:, None] + span, 0, limit - 1) for at, limit in ((columns, width), (rows, height)))
        patches = grey[rows[:, :, None], columns[:, None, :]]
    return View(ids, pixels, patches, origins, width, height)


# --- checkerboards ----------------------------------------------------------------------------------------------------


def _find_checkerboard(
    picture: Pyramid, inner: tuple[int, int], thorough: bool, quickly: bool
) -> tuple[np.ndarray, np.ndarray] | None:
    found = saddles.find_board(picture, inner, thorough=thorough, quickly=quickly)
    if found is None:
        return None
    spacing = _spacing(found.ids, found.pixels, inner)
    if not (spacing > 1.5).all():
        return None
    pixels, lost = _subpixel(picture.grey, found.pixels, spacing, max(found.error, 1.5))
    if found.quickly and lost.any():  # a larger picture may show better where they are
        return _find_checkerboard(picture, inner, thorough, quickly=False)
    return found.ids, pixels


def shrunk(picture: Pyramid) -> Pyramid:
    """The picture at a size at which the size of a board can be guessed later, and what it does not show."""
    small = Pyramid(picture.reduced(_KEEP_WIDTH)[0])
    small.in_vain, small.crowded = dict(picture.in_vain), picture.crowded
    return small


def _spacing(ids: np.ndarray, pixels: np.ndarray, inner: tuple[int, int]) -> np.ndarray:
    """Distance of each corner (n,) to its nearest neighbour in the grid, (n,) px; infinite without one."""
    places = np.full((inner[1] * inner[0], 2), np.nan)
    places[ids] = pixels
    grid = places.reshape(inner[1], inner[0], 2)
    nearest = np.full(grid.shape[:2], np.inf)
    along, across = np.linalg.norm(np.diff(grid, axis=1), axis=2), np.linalg.norm(np.diff(grid, axis=0), axis=2)
    nearest[:, 1:] = np.fmin(nearest[:, 1:], along)
    nearest[:, :-1] = np.fmin(nearest[:, :-1], along)
    nearest[1:] = np.fmin(nearest[1:], across)
    nearest[:-1] = np.fmin(nearest[:-1], across)
    return nearest.ravel()[ids]


def _subpixel(
    grey: np.ndarray, corners: np.ndarray, spacing: np.ndarray, reach: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Förstner's corner (cv2.cornerSubPix) in a window that suits each corner, and which corners are lost, (n,) bool.

    A fixed window of 11 px, as in every tutorial, walks onto the neighbours near the rim. A corner that walks further
    than `reach` px, or out of its window, is lost: it stays where it was.
    """
    import cv2

    windows = np.clip(np.rint(0.38 * spacing), 2, 15).astype(int)
    refined = corners.copy()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    for window in np.unique(windows):
        rows = windows == window
        points = np.ascontiguousarray(corners[rows, None, :], np.float32)
        refined[rows] = cv2.cornerSubPix(grey, points, (int(window), int(window)), (-1, -1), criteria)[:, 0]
    lost = np.linalg.norm(refined - corners, axis=1) > np.minimum(windows, reach)
    refined[lost] = corners[lost]
    return refined, lost


def guess_board(pictures: Sequence[np.ndarray | Pyramid], board: Board) -> Board | None:
    """Find the size of the checkerboard that the pictures show; None where there is none.

    Someone may have counted inner corners for squares, or one row too many.

    Args:
        pictures: a few pictures (height, width) uint8, as `shrunk` makes them.
        board: as given.
    """
    votes: dict[tuple[int, int], int] = {}
    for small in pictures:
        for inner in saddles.sizes(small, LEAST_GUESSED, thorough=False)[:1]:
            few, many = sorted((inner[0] + 1, inner[1] + 1))
            size = (many, few) if board.columns > board.rows else (few, many)
            votes[size] = votes.get(size, 0) + 1
    if not votes:
        return None
    size, count = max(votes.items(), key=lambda item: (item[1], item[0][0] * item[0][1]))
    # One grid may be a tiled floor.
    if count < min(len(pictures), max(2, len(pictures) / 3)) or sorted(size) == sorted((board.columns, board.rows)):
        return None
    return Board(*size, board.square_m)


# --- polish -----------------------------------------------------------------------------------------------------------


def polish(
    patches: np.ndarray, pixels: np.ndarray, origins: np.ndarray, to_board: np.ndarray, clear: float
) -> tuple[np.ndarray, np.ndarray]:
    """Refine corners by fitting a picture of the corner to the pixels around each, the lens being roughly known.

    The lens and the pose give how a pixel's offset from the corner maps to the board, so that the fitted model
    (brightness, its slope, contrast, blur, and where the two edges cross) has straight edges on the board however bent
    they are in the picture. Only the place of the crossing is free: the lens decides what a corner looks like, not
    where it is (Datta, Kim and Kanade 2009 iterate for the same reason).

    Args:
        patches: (n, 2 PATCH + 1, 2 PATCH + 1) uint8.
        pixels: (n, 2) px, the corners now.
        origins: (n, 2) px, the patches' middles.
        to_board: (n, 2, 5) board offset in squares as a polynomial in the pixel offset (a, b): a, b, a², ab, b².
        clear: squares from the nearer edge that are used; less than 1 leaves out what is printed in the squares.

    Returns:
        pixels (n, 2), and the standard deviation of each corner's error along one axis, (n,) px; the corner as it was
        and infinity where the fit fails.
    """
    n = len(pixels)
    out, sd = pixels.copy(), np.full(n, np.inf)
    room = np.empty(_PLANES * min(n, _AT_ONCE) * _powers().shape[1], np.float32)
    for rounds, still in ((2, 0.01), (5, 0.05)):  # corners that have not settled take more
        left = np.flatnonzero(~np.isfinite(sd))
        for begin in range(0, len(left), _AT_ONCE):
            part = left[begin : begin + _AT_ONCE]
            out[part], sd[part] = _polish_some(
                room, patches[part], pixels[part], origins[part], to_board[part], clear, rounds, still
            )
    return out, sd


def _polish_some(
    room: np.ndarray,
    patches: np.ndarray,
    pixels: np.ndarray,
    origins: np.ndarray,
    to_board: np.ndarray,
    clear: float,
    rounds: int,
    still: float,
) -> tuple[np.ndarray, np.ndarray]:
    n = len(pixels)
    # Single precision is enough for grey levels; what is solved is double.
    base, coefficients = origins - pixels, np.moveaxis(to_board, 0, 1)
    shift, blur = np.zeros((n, 2)), np.full(n, 0.8)
    slope = np.hypot(to_board[:, :, 0], to_board[:, :, 1]).T  # (2, n)
    powers = _powers()
    count = powers.shape[1]
    planes = room[: _PLANES * n * count].reshape(_PLANES, n, count)
    at, by_a, by_b, edge, rise = planes[:10].reshape(5, 2, n, count)
    mask, columns = planes[10], planes[11:].reshape(n, 8, count)
    for number in range(rounds):
        # How far a pixel is from the edges, in widths of their slope, and how that follows its place: (2, n, pixels).
        width = np.maximum(blur * slope / _STEEP, 1e-12)  # 0 where the lens says nothing
        polynomials = _polynomials(coefficients, base - shift) / width[..., None]
        np.matmul(polynomials.astype(np.float32).reshape(-1, 6), powers, out=planes[:6].reshape(-1, count))
        if number == 0:
            (x, y), limit = np.abs(at, out=rise), _REACH / width[..., None].astype(np.float32)
            inside = (x < limit[0]) & (y < limit[1])
            if clear < _REACH:
                limit *= clear / _REACH
                inside &= (x < limit[0]) | (y < limit[1])
            mask[:] = inside
            used = mask.sum(1)
            # Columns: 1, a, b, saddle, its derivatives to the shift and to the blur, grey; all 0 where masked.
            np.multiply(powers[:3], mask[:, None], out=columns[:, :3])
            grey = patches.reshape(n, -1)
            np.subtract(grey, grey.mean(1, dtype=np.float32, keepdims=True), out=columns[:, 7])
            columns[:, 7] *= mask
        np.tanh(at, out=edge)
        np.multiply(edge, edge, out=rise)
        np.subtract(1, rise, out=rise)
        edge *= mask
        rise *= edge[::-1]
        np.multiply(edge[0], edge[1], out=columns[:, 3])
        for column, follows in ((4, by_a), (5, by_b), (6, at)):
            follows *= rise
            np.add(follows[0], follows[1], out=columns[:, column])
        # Not `columns` times itself: for that numpy takes BLAS's syrk, which needs four times as long for few columns.
        normal = np.empty((n, 8, 8))
        normal[:, :, 1:] = columns @ columns[:, 1:].transpose(0, 2, 1)
        normal[:, 0, 0], normal[:, 1:, 0] = used, normal[:, 0, 1:]
        light = normal[:, :4, :4] + 1e-9 * np.eye(4)
        followed = np.linalg.solve(light, normal[:, :4, 4:])
        gain, normal = followed[..., 3], normal[:, 4:, 4:] - normal[:, 4:, :4] @ followed
        # The derivatives are those of the saddle; the picture's are as many times larger as its contrast.
        scale = -gain[:, 3, None] * np.stack([np.ones(n), np.ones(n), 1 / blur], -1)
        rest, normal = normal[:, :3, 3] * scale, normal[:, :3, :3] * (scale[:, :, None] * scale[:, None])
        normal += (1e-9 * np.einsum("naa->na", normal)[..., None] + 1e-9) * np.eye(3)
        inverse = np.linalg.inv(normal)
        step = (inverse @ rest[..., None])[..., 0]
        shift += np.clip(step[:, :2], -0.5, 0.5)
        blur = np.clip(blur + np.clip(step[:, 2], -0.3, 0.3), 0.3, 4.0)
    left = edge[0]
    np.matmul(gain[:, None].astype(np.float32), columns[:, :4], out=left[:, None])
    left -= columns[:, 7]
    noise = np.sqrt(np.einsum("np,np->n", left, left) / np.maximum(used - 7, 1))
    settled = (np.linalg.norm(shift, axis=1) < 1.5) & (np.linalg.norm(step[:, :2], axis=1) < still)
    clear_enough = (used >= 24) & (np.abs(gain[:, 3]) > 3 * noise)
    sd = noise * np.sqrt((inverse[:, 0, 0] + inverse[:, 1, 1]) / 2)
    good = np.isfinite(sd) & settled & clear_enough
    return np.where(good[:, None], pixels + shift, pixels), np.where(good, sd, np.inf)


def _polynomials(to_board: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The board offset of a pixel, and its derivatives to the pixel's place, as polynomials about another middle.

    Args:
        to_board: (2, n, 5), along each axis of the board, as in `polish`.
        offset: (n, 2) px, of the new middle from the corner.

    Returns:
        (3, 2, n, 6): the offset, its derivatives to a and to b; of each the coefficients of `_powers`.
    """
    c, d, cc, cd, dd = np.moveaxis(to_board, 2, 0)
    a, b = offset.T
    out = np.zeros((3, *c.shape, 6))
    at, by_a, by_b = np.moveaxis(out, 3, 1)
    by_a[0], by_b[0] = c + 2 * cc * a + cd * b, d + cd * a + 2 * dd * b
    at[0] = (a * (by_a[0] + c) + b * (by_b[0] + d)) / 2  # Euler: of a polynomial of first and second degree
    at[1], at[2], at[3], at[4], at[5] = by_a[0], by_b[0], cc, cd, dd
    by_a[1], by_a[2], by_b[1], by_b[2] = 2 * cc, cd, cd, 2 * dd
    return out


@cache
def _powers() -> np.ndarray:
    """The powers 1, a, b, a², ab, b² of the offsets of a patch's pixels along u and v, (6, pixels)."""
    span = np.arange(-PATCH, PATCH + 1)
    b, a = (grid.ravel().astype(np.float32) for grid in np.meshgrid(span, span, indexing="ij"))
    return np.stack([np.ones_like(a), a, b, a * a, a * b, b * b])
