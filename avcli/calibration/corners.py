"""Board corners in a picture: found small, refined on the full picture, and polished once the lens is known.

A picture is (height, width) uint8 here; `to_grey` makes one of any other.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from avcli.calibration.target import Board

if TYPE_CHECKING:
    import cv2

_SEARCH_WIDTH = 960
_KEEP_WIDTH = 1280
"""px; pictures up to this width are searched as they are: on coarser ones the corners start too far from the truth."""
PATCH = 12
"""px; half the side of the square around each corner that is kept for `polish`."""


@dataclass(frozen=True)
class View:
    """The corners of one picture.

    Attributes:
        ids: (n,) which of the board's corners.
        pixels: (n, 2) px.
        patches: (n, 2 PATCH + 1, 2 PATCH + 1) uint8, the picture around each corner.
        origins: (n, 2) px, the pixel of each patch's middle.
        width, height: px, of the picture.
    """

    ids: np.ndarray
    pixels: np.ndarray
    patches: np.ndarray
    origins: np.ndarray
    width: int
    height: int


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


def find(grey: np.ndarray, board: Board, *, thorough: bool = True) -> View | None:
    """Find a board's corners; None where there is no board.

    Args:
        grey: (height, width) uint8.
        board: a checkerboard must be whole in the picture; of a ChArUco board six corners are enough.
        thorough: also search without the check that is quick to give a picture up (half a second on mere noise).
    """
    if min(grey.shape) < 32:
        return None
    found = _find_charuco(grey, board) if board.markers else _find_checkerboard(grey, board.inner, thorough)
    if found is None:
        return None
    ids, pixels = found
    return view_of(grey, ids, pixels)


def view_of(grey: np.ndarray, ids: np.ndarray, pixels: np.ndarray) -> View:
    """Make a view of corners (n, 2) px with the picture around each."""
    import cv2

    padded = cv2.copyMakeBorder(grey, PATCH, PATCH, PATCH, PATCH, cv2.BORDER_REPLICATE)
    height, width = grey.shape
    origins = np.clip(np.rint(pixels), 0, [width - 1, height - 1]).astype(int)
    patches = np.stack([padded[y : y + 2 * PATCH + 1, x : x + 2 * PATCH + 1] for x, y in origins])
    return View(ids, pixels, patches, origins, width, height)


# --- checkerboards ----------------------------------------------------------------------------------------------------


def _find_checkerboard(
    grey: np.ndarray, inner: tuple[int, int], thorough: bool
) -> tuple[np.ndarray, np.ndarray] | None:
    import cv2

    small, scale = shrunk(grey)
    base = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(small, inner, flags=base | cv2.CALIB_CB_FAST_CHECK)
    if not found and thorough:  # the quick check gives dim and oblique boards up
        found, corners = cv2.findChessboardCorners(small, inner, flags=base)
    if not found:
        found, corners = cv2.findChessboardCornersSB(small, inner, flags=0)
    if not found:
        return None
    corners = corners.reshape(-1, 2).astype(np.float64)
    if len(corners) != inner[0] * inner[1] or not np.isfinite(corners).all():
        return None
    spread = _spacing(corners, inner)
    if not (spread > 1.5).all():
        return None
    if scale != 1:
        corners = (_subpixel(small, corners, spread) + 0.5) * scale - 0.5
        spread = spread * scale
    pixels = _in_order(grey, _subpixel(grey, corners, spread), inner)
    return np.arange(len(pixels)), pixels


def _in_order(grey: np.ndarray, pixels: np.ndarray, inner: tuple[int, int]) -> np.ndarray:
    """Number the corners as the board does: rows to the right of columns, and, where the colours tell, upright.

    The square between the first four corners is black. In a board with one odd and one even count it is white when the
    board is read upside down.
    """
    grid = pixels.reshape(inner[1], inner[0], 2)
    along, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if (inner[0] + inner[1]) % 2:
        middles = np.rint((grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4).astype(int)
        height, width = grey.shape
        value = grey[middles[:, :, 1].clip(0, height - 1), middles[:, :, 0].clip(0, width - 1)].astype(float)
        black = np.add.outer(np.arange(inner[1] - 1), np.arange(inner[0] - 1)) % 2 == 0
        if value[black].mean() > value[~black].mean():
            grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid.reshape(-1, 2))


def shrunk(grey: np.ndarray) -> tuple[np.ndarray, float]:
    """The picture at the size in which boards are searched, and the factor back to the full picture."""
    import cv2

    height, width = grey.shape
    longest = max(height, width)
    if longest <= _KEEP_WIDTH:
        return grey, 1.0
    scale = longest / _SEARCH_WIDTH
    return cv2.resize(grey, (round(width / scale), round(height / scale)), interpolation=cv2.INTER_AREA), scale


def _spacing(corners: np.ndarray, inner: tuple[int, int]) -> np.ndarray:
    """Distance of each corner of a whole grid to its nearest neighbour in the grid, (n,) px."""
    grid = corners.reshape(inner[1], inner[0], 2)
    nearest = np.full(grid.shape[:2], np.inf)
    along, across = np.linalg.norm(np.diff(grid, axis=1), axis=2), np.linalg.norm(np.diff(grid, axis=0), axis=2)
    nearest[:, 1:] = np.minimum(nearest[:, 1:], along)
    nearest[:, :-1] = np.minimum(nearest[:, :-1], along)
    nearest[1:] = np.minimum(nearest[1:], across)
    nearest[:-1] = np.minimum(nearest[:-1], across)
    return nearest.ravel()


def _subpixel(grey: np.ndarray, corners: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Förstner's corner (cv2.cornerSubPix) in a window that suits each corner.

    A fixed window of 11 px, as in every tutorial, walks onto the neighbours near the rim.
    """
    import cv2

    windows = np.clip(np.rint(0.38 * spacing), 2, 15).astype(int)
    refined = corners.copy()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    for window in np.unique(windows):
        rows = windows == window
        points = np.ascontiguousarray(corners[rows, None, :], np.float32)
        refined[rows] = cv2.cornerSubPix(grey, points, (int(window), int(window)), (-1, -1), criteria)[:, 0]
    lost = np.linalg.norm(refined - corners, axis=1) > windows
    refined[lost] = corners[lost]
    return refined


def is_whole(grey: np.ndarray, pixels: np.ndarray, inner: tuple[int, int]) -> bool:
    """Tell whether the grid of corners is the whole board and not a part of a larger one.

    One row further out on each side there must be no checkerboard corners. Their place is extrapolated from the grid,
    and the contrast between the two diagonal pairs of squares compared with that at the grid's own corners.
    """
    grid = pixels.reshape(inner[1], inner[0], 2)
    own = np.median(_saddle(grey, grid[1:-1, 1:-1], _grid_step(grid, 1)[1:-1, 1:-1], _grid_step(grid, 0)[1:-1, 1:-1]))
    if not own > 0:
        return True
    for turns in range(4):
        side = np.rot90(grid, turns) if turns else grid
        order = 3 if side.shape[0] > 2 else 2
        ring = 3 * side[0] - 3 * side[1] + side[2] if order == 3 else 2 * side[0] - side[1]
        along = np.gradient(ring, axis=0)
        outward = ring - side[0]
        height, width = grey.shape
        margin = 0.4 * np.maximum(np.linalg.norm(along, axis=1), np.linalg.norm(outward, axis=1))
        inside = (ring > margin[:, None]).all(1) & (ring < np.array([width, height]) - 1 - margin[:, None]).all(1)
        if inside.sum() >= max(3, len(ring) // 2):
            beyond = np.median(_saddle(grey, ring[inside], along[inside], outward[inside]))
            if beyond > 0.75 * own:
                return False
    return True


def _grid_step(grid: np.ndarray, axis: int) -> np.ndarray:
    return np.gradient(grid, axis=axis)


def _saddle(grey: np.ndarray, places: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Difference between the diagonal pairs of squares around each place, in grey levels."""
    import cv2

    places, along, across = (a.reshape(-1, 2) for a in (places, along, across))
    total = np.zeros(len(places))
    for x, y in ((0.3, 0.3), (-0.3, -0.3), (0.3, -0.3), (-0.3, 0.3)):
        at = (places + x * along + y * across).astype(np.float32)
        value = cv2.remap(grey, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += np.sign(x * y) * value[:, 0].astype(float)
    return np.abs(total)


def guess_board(pictures: list[np.ndarray], board: Board) -> Board | None:
    """Find the size of the checkerboard that the pictures show; None where there is none.

    Someone may have counted inner corners for squares, or one row too many.

    Args:
        pictures: a few pictures (height, width) uint8, as `shrunk` makes them.
        board: as given.
    """
    import cv2

    votes: dict[tuple[int, int], int] = {}
    for small in pictures:
        flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        found, corners, cells = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
        if not found:
            continue
        inner = cells.shape[1], cells.shape[0]
        if is_whole(small, corners.reshape(-1, 2).astype(np.float64), inner):
            size = tuple(sorted((inner[0] + 1, inner[1] + 1), reverse=board.columns > board.rows))
            votes[size] = votes.get(size, 0) + 1
    if not votes:
        return None
    size, count = max(votes.items(), key=lambda item: (item[1], item[0][0] * item[0][1]))
    # One grid may be a tiled floor.
    if count < min(len(pictures), max(2, len(pictures) / 3)) or sorted(size) == sorted((board.columns, board.rows)):
        return None
    return Board(*size, board.square_m)


# --- ChArUco ----------------------------------------------------------------------------------------------------------


def _find_charuco(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray] | None:
    detector = _charuco_detector(board)
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None or len(ids) < 6:
        return None
    ids = ids.ravel().astype(int)
    order = np.argsort(ids)
    ids, pixels = ids[order], corners.reshape(-1, 2)[order].astype(np.float64)
    columns, rows = ids % board.inner[0], ids // board.inner[0]
    if len(np.unique(columns)) < 2 or len(np.unique(rows)) < 2 or not np.isfinite(pixels).all():
        return None
    between = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    steps = np.hypot(columns[:, None] - columns[None], rows[:, None] - rows[None])
    spacing = np.where(steps > 0, between / np.maximum(steps, 1), np.inf).min(1)
    if not (spacing > 6).all():
        return None
    # Around a corner only (1 - MARKER_RATIO) / 2 of a square is free of markers.
    return ids, _subpixel(grey, pixels, 0.4 * spacing)


def _charuco_detector(board: Board) -> "cv2.aruco.CharucoDetector":
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMax = 53
    charuco = cv2.aruco.CharucoParameters()
    charuco.minMarkers = 1
    return cv2.aruco.CharucoDetector(board.charuco(), charuco, parameters)


# --- polish -----------------------------------------------------------------------------------------------------------


def polish(
    patches: np.ndarray,
    pixels: np.ndarray,
    origins: np.ndarray,
    to_board: np.ndarray,
    *,
    reach: float = 0.75,
    clear: float = 1.0,
    half: int = PATCH,
    rounds: int = 5,
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
        reach: squares from the corner that are used, less than 1.
        clear: squares from the nearer edge that are used; less than 1 leaves out what is printed in the squares.
        half: px from the corner that are used.
        rounds: Gauss-Newton steps.

    Returns:
        pixels (n, 2), and the standard deviation of each corner's error along one axis, (n,) px; the corner as it was
        and infinity where the fit fails.
    """
    n = len(pixels)
    out, sd = pixels.copy(), np.full(n, np.inf)
    for begin in range(0, n, 512):
        part = slice(begin, begin + 512)
        out[part], sd[part] = _polish_some(
            patches[part], pixels[part], origins[part], to_board[part], reach, clear, half, rounds
        )
    return out, sd


def _polish_some(
    patches: np.ndarray,
    pixels: np.ndarray,
    origins: np.ndarray,
    to_board: np.ndarray,
    reach: float,
    clear: float,
    half: int,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray]:
    n = len(pixels)
    span = np.arange(-half, half + 1)
    middle = slice(PATCH - half, PATCH + half + 1)
    grey = patches[:, middle, middle].reshape(n, -1).astype(np.float64)
    dv, du = (a.ravel().astype(float) for a in np.meshgrid(span, span, indexing="ij"))
    base = origins - pixels
    shift, blur = np.zeros((n, 2)), np.full(n, 0.8)
    mask = np.zeros(0)
    linear = to_board[:, :, :2]
    slope = np.linalg.norm(linear, axis=2)[:, :, None]
    for _ in range(rounds):
        a = du + (base - shift)[:, :1]
        b = dv + (base - shift)[:, 1:]
        terms = np.stack([a, b, a * a, a * b, b * b], 1)
        x, y = np.moveaxis(to_board @ terms, 1, 0)
        if not mask.size:
            near, far = np.minimum(np.abs(x), np.abs(y)), np.maximum(np.abs(x), np.abs(y))
            mask = ((far < reach) & (near < clear)).astype(float)
        width = blur[:, None] * slope[:, :, 0][..., None].transpose(1, 0, 2)
        ex, gx = _edge(x / width[0])
        ey, gy = _edge(y / width[1])
        saddle = ex * ey
        # Derivatives of the model to the board offsets and to the blur, then to the pixel shift.
        dx, dy = gx * ey / width[0], ex * gy / width[1]
        by_blur = -(gx * ey * x / width[0] + ex * gy * y / width[1]) / blur[:, None]
        jx = to_board[:, 0, :1] + 2 * to_board[:, 0, 2:3] * a + to_board[:, 0, 3:4] * b
        jy = to_board[:, 1, :1] + 2 * to_board[:, 1, 2:3] * a + to_board[:, 1, 3:4] * b
        kx = to_board[:, 0, 1:2] + to_board[:, 0, 3:4] * a + 2 * to_board[:, 0, 4:5] * b
        ky = to_board[:, 1, 1:2] + to_board[:, 1, 3:4] * a + 2 * to_board[:, 1, 4:5] * b
        light = np.stack([np.ones_like(a), a / half, b / half, saddle], 1)
        gain = _weighted_lstsq(light, grey, mask)
        contrast = gain[:, 3:]
        by_shift = np.stack([-(dx * jx + dy * jy) * contrast, -(dx * kx + dy * ky) * contrast], 1)
        design = np.concatenate([light, by_shift, (by_blur * contrast)[:, None]], 1)
        left = grey - np.einsum("nap,na->np", light, gain)
        weighted = design * mask[:, None]
        normal = np.einsum("nap,nbp->nab", weighted, design)
        normal += 1e-9 * np.einsum("naa->na", normal)[..., None] * np.eye(7) + 1e-9 * np.eye(7)
        step = np.linalg.solve(normal, np.einsum("nap,np->na", weighted, left)[..., None])[..., 0]
        shift += np.clip(step[:, 4:6], -0.5, 0.5)
        blur = np.clip(blur + np.clip(step[:, 6], -0.3, 0.3), 0.3, 4.0)
    count = mask.sum(1)
    noise = np.sqrt((mask * left**2).sum(1) / np.maximum(count - 7, 1))
    settled = (np.linalg.norm(shift, axis=1) < 1.5) & (np.linalg.norm(step[:, 4:6], axis=1) < 0.05)
    clear_enough = (count >= 24) & (np.abs(gain[:, 3]) > 3 * noise)
    inverse = np.linalg.inv(normal)
    sd = noise * np.sqrt((inverse[:, 4, 4] + inverse[:, 5, 5]) / 2)
    good = np.isfinite(sd) & settled & clear_enough
    return np.where(good[:, None], pixels + shift, pixels), np.where(good, sd, np.inf)


def _edge(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A blurred edge from -1 to 1 (tanh in place of the error function) and its slope."""
    value = np.tanh(1.2 * t)
    return value, 1.2 * (1 - value * value)


def _weighted_lstsq(design: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    weighted = design * weight[:, None]
    normal = np.einsum("nap,nbp->nab", weighted, design)
    normal += 1e-9 * np.eye(normal.shape[-1])
    return np.linalg.solve(normal, np.einsum("nap,np->na", weighted, target)[..., None])[..., 0]
