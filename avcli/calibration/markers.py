"""Boards with markers (ChArUco, AprilGrid): finding their corners, and telling which board a picture shows."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from avcli.calibration.pyramid import Pyramid
from avcli.calibration.target import Board, Kind, dictionary_of

if TYPE_CHECKING:
    import cv2

_FAMILIES = (
    *((f"{n}X{n}", (50, 100, 250)) for n in (4, 5, 6, 7)),
    *((name, ()) for name in ("ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h11", "APRILTAG_36h10")),
    ("ARUCO_MIP_36h12", ()),
)
"""Dictionaries in which an unknown board's markers are searched. Those of one row begin with the same markers."""
_SEARCH_WIDTH = 1920
"""px; larger pictures are reduced to this before tags are searched."""
_MOST = 250
"""Markers of a dictionary that are considered: no board has more."""
_ALL, _FEW = (3, 53, 10), (13, 33, 20)
"""px; squares by which dark is told from bright: from, to, and by how much they grow."""
_WRONG_BITS = 1
"""Cells of a tag that may be misread."""
_LEAST_PAIRS, _AGREE = 4, 0.8
"""How many pairs of neighbouring markers a layout needs, and how many of them it must explain."""


@dataclass(frozen=True)
class Markers:
    """Markers in a picture.

    Attributes:
        dictionary: as in Board.
        ids: (n,) which markers; each once.
        corners: (n, 4, 2) px, clockwise from the marker's top left as OpenCV draws it.
        border_bits: cells in the black border.
    """

    dictionary: str
    ids: np.ndarray
    corners: np.ndarray
    border_bits: int


def find(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Find the corners of a board with markers; None where fewer than six are seen.

    Args:
        grey: (height, width) uint8.
        board: a ChArUco board or an AprilGrid.

    Returns:
        Which of the board's points (n,) in rising order, their pixels (n, 2) to about a pixel, and the width of the
        plain checkerboard corner around each (n,) px.
    """
    found = _find_tags(grey, board) if board.kind == "aprilgrid" else _find_charuco(grey, board)
    if found is None or not (np.isfinite(found[1]).all() and (found[2] > 0).all()):
        return None
    return found


# --- ChArUco ----------------------------------------------------------------------------------------------------------


def _find_charuco(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    corners, ids, _, seen = _charuco_detector(board).detectBoard(grey)
    if ids is None or len(ids) < 6:
        return None
    ids = ids.ravel().astype(int)
    order = np.argsort(ids)
    if not board.rows_known:  # OpenCV would extrapolate corners below the last row of markers
        last = _places(np.arange(int(seen.max()) + 1), board.columns, board.kind, board.legacy)[-1, 1]
        order = order[ids[order] // board.inner[0] < last]
        if len(order) < 6:
            return None
    ids, pixels = ids[order], corners.reshape(-1, 2)[order].astype(np.float64)
    columns, rows = ids % board.inner[0], ids // board.inner[0]
    if len(np.unique(columns)) < 2 or len(np.unique(rows)) < 2:
        return None
    between = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    steps = np.hypot(columns[:, None] - columns[None], rows[:, None] - rows[None])
    spacing = np.where(steps > 0, between / np.maximum(steps, 1), np.inf).min(1)
    if not (spacing > 6).all():
        return None
    # Around a corner only a part of a square is free of markers.
    return ids, pixels, 0.4 * spacing


def _charuco_detector(board: Board) -> "cv2.aruco.CharucoDetector":
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMax = 53
    charuco = cv2.aruco.CharucoParameters()
    charuco.minMarkers = 1
    return cv2.aruco.CharucoDetector(board.charuco(), charuco, parameters)


# --- AprilGrid --------------------------------------------------------------------------------------------------------


def _find_tags(grey: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    small, scale = _reduced(grey)
    reader = _Reader(small, _quads(small, touching=True))
    seen = _identified(reader, board.dictionary, board.border_bits, wrong=_WRONG_BITS)
    known = seen.ids < board.columns * board.rows
    ids, corners = seen.ids[known], (seen.corners[known] + 0.5) * scale - 0.5
    if len(ids) < 2:
        return None
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(1)
    points, pixels = board.tag_points()[ids].ravel(), corners.reshape(-1, 2)
    gap = np.repeat(board.ratio * sides, 4)
    large = gap > 3
    order = np.argsort(points[large])
    points, pixels, gap = points[large][order], pixels[large][order], gap[large][order]
    # A window of cv2.cornerSubPix may reach a little beyond the square and into the tag's border.
    border = gap / board.ratio * board.border_bits / board.marker_cells(0).shape[0]
    return (points, pixels, np.minimum(1.6 * gap, 2.4 * border)) if len(points) >= 6 else None


def _reduced(grey: np.ndarray) -> tuple[np.ndarray, float]:
    """A picture in which tags are searched, and the factor back to the full one."""
    return (grey, 1.0) if max(grey.shape) < 1.25 * _SEARCH_WIDTH else Pyramid(grey).reduced(_SEARCH_WIDTH)


def _quads(grey: np.ndarray, *, touching: bool, thresholds: tuple[int, int, int] = _ALL) -> np.ndarray:
    """Black four-sided shapes in a picture, (n, 4, 2) px, clockwise.

    Args:
        grey: (height, width) uint8.
        touching: whether shapes may touch at their corners, as an AprilGrid's tags touch the squares between them. They
            are separated by a pixel of white before the search, and that pixel is added again.
        thresholds: px, the least and the largest square around a pixel against whose mean it is dark, and the step.
    """
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = thresholds[:2]
    parameters.adaptiveThreshWinSizeStep = thresholds[2]
    parameters.minMarkerPerimeterRate = 0.02
    detector = cv2.aruco.ArucoDetector(_nothing(), parameters)
    searched = cv2.dilate(grey, np.ones((3, 3), np.uint8)) if touching else grey
    found, _, rejected = detector.detectMarkers(searched)
    every = [np.reshape(quad, (4, 2)) for quad in (*found, *rejected)]
    quads = np.array(every, np.float64).reshape(-1, 4, 2)
    # OpenCV's outlines run through the middles of the outermost pixels.
    outward = quads - quads.mean(1, keepdims=True)
    lost = np.sqrt(2) * (1.0 if touching else 0.5)
    return quads + lost * outward / np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-9)


@cache
def _nothing() -> "cv2.aruco.Dictionary":
    """A dictionary of one marker: the quads matter, not what OpenCV reads in them."""
    import cv2

    whole = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.Dictionary(whole.bytesList[:1], whole.markerSize, 0)


def _identified(reader: "_Reader", dictionary: str, border_bits: int, *, wrong: int = 0) -> Markers:
    """Which of a reader's quads are markers of a dictionary; a marker that is seen twice is left out.

    Args:
        reader: of the picture and the quads.
        dictionary, border_bits: as in Board.
        wrong: bits that may differ.
    """
    codes, size = _codes(dictionary)
    black, good = reader.cells(size + 2 * border_bits)
    inside = black[:, border_bits : border_bits + size, border_bits : border_bits + size]
    border = np.ones(black.shape[1:], bool)
    border[border_bits:-border_bits, border_bits:-border_bits] = False
    good = good & (black[:, border].mean(1) >= 1 - wrong / border.sum())
    ids, corners = [], []
    for quad, bits in zip(reader.quads[good], inside[good], strict=True):
        turned = np.stack([np.rot90(~bits, turn).ravel() for turn in range(4)])
        differ = (turned[:, None] != codes[None]).sum(2)
        turn, marker = np.unravel_index(np.argmin(differ), differ.shape)
        if differ[turn, marker] <= wrong:
            ids.append(int(marker))
            corners.append(np.roll(quad, -int(turn), axis=0))
    names, counts = np.unique(np.array(ids, int), return_counts=True)
    once = [ids.index(name) for name in names[counts == 1]]
    return Markers(dictionary, names[counts == 1], np.array([corners[i] for i in once]).reshape(-1, 4, 2), border_bits)


class _Reader:
    """Reads quads of a picture as black and white cells, each number of cells once.

    Args:
        grey: (height, width) uint8.
        quads: (n, 4, 2) px, clockwise.
    """

    def __init__(self, grey: np.ndarray, quads: np.ndarray) -> None:
        self.quads, self._grey = quads, grey
        self._of_square = _from_unit_square(quads)
        self._read: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def cells(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The cells of each quad, (n, count, count) bool, true where black, and whether there is contrast, (n,)."""
        if count not in self._read:
            self._read[count] = self._cells(count)
        return self._read[count]

    def _cells(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        if not len(self.quads):
            return np.zeros((0, count, count), bool), np.zeros(0, bool)
        middles = (np.arange(count) + 0.5) / count
        x, y = (a.ravel() for a in np.meshgrid(middles, middles))
        u, v, w = np.moveaxis(self._of_square @ np.stack([x, y, np.ones(len(x))]), 1, 0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of shapes that no square maps to
            x, y = (u / w).astype(np.float32), (v / w).astype(np.float32)
        value = cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        low, high = np.quantile(value, [0.05, 0.95], axis=1)
        black = value < ((low + high) / 2)[:, None]
        return black.reshape(-1, count, count), high - low > 20


def _from_unit_square(quads: np.ndarray) -> np.ndarray:
    """The projective maps from the unit square to quads (n, 4, 2), (n, 3, 3) (P. S. Heckbert, 1989, section 2.2.3)."""
    first, second, third, fourth = np.moveaxis(quads, 1, 0)
    one, other, rest = second - third, fourth - third, first - second + third - fourth
    area = one[:, 0] * other[:, 1] - other[:, 0] * one[:, 1]
    area = np.where(area == 0, np.inf, area)  # three corners in a line: no map leads there
    g = (rest[:, 0] * other[:, 1] - other[:, 0] * rest[:, 1]) / area
    h = (one[:, 0] * rest[:, 1] - rest[:, 0] * one[:, 1]) / area
    along, across = second - first + g[:, None] * second, fourth - first + h[:, None] * fourth
    maps = np.empty((len(quads), 3, 3))
    maps[:, :2, 0], maps[:, :2, 1], maps[:, :2, 2] = along, across, first
    maps[:, 2, 0], maps[:, 2, 1], maps[:, 2, 2] = g, h, 1.0
    return maps


@cache
def _codes(name: str) -> tuple[np.ndarray, int]:
    """The bits of a dictionary's first markers, (n, size²) bool, true where white; and the size."""
    dictionary = dictionary_of(name)
    size = dictionary.markerSize
    whole = np.asarray(dictionary.bytesList[:_MOST], np.uint8).reshape(-1, 4, (size * size + 7) // 8)[:, 0]
    bits = np.unpackbits(whole, axis=1)
    rest = size * size % 8  # the last byte holds the remaining bits at its low end
    if rest:
        bits = np.concatenate([bits[:, : size * size - rest], bits[:, -rest:]], 1)
    return bits.astype(bool), size


def known_markers(dictionary: str) -> int:
    """How many markers of a dictionary are considered."""
    return len(_codes(dictionary)[0])


def smallest_of(board: Board) -> str:
    """The smallest dictionary that begins with the same markers and has enough for a board."""
    family = board.dictionary.rpartition("_")[0]
    sizes = dict(_FAMILIES).get(family, ())
    return next((f"{family}_{size}" for size in sizes if board.markers_needed <= size), board.dictionary)


# --- which board ------------------------------------------------------------------------------------------------------


def recognise(grey: np.ndarray, kind: Kind | None = None, dictionary: str = "") -> Board | None:
    """Tell which board with markers a picture shows; None where there is none.

    The dictionary is the one that has the most of the markers. The layout is the one in which neighbouring markers
    stand as they are numbered. Rows beyond those that are seen are unknown.

    Args:
        grey: (height, width) uint8.
        kind: "charuco" or "aprilgrid"; None looks for both.
        dictionary: the only one to consider; none given: all that OpenCV knows.
    """
    grey = _reduced(grey)[0]
    best: tuple[int, Board] | None = None
    for touching in (False, True):
        if kind == ("aprilgrid" if not touching else "charuco"):
            continue
        # Texture has hundreds of outlines. Where a few thresholds show no marker, all of them show no board.
        few = _quads(grey, touching=touching, thresholds=_FEW)
        if not any(len(seen.ids) for seen in _readings(grey, few, dictionary, touching)):
            continue
        for seen in _readings(grey, _quads(grey, touching=touching), dictionary, touching):
            board = _layout(seen, "aprilgrid" if touching else "charuco")
            if board is not None and (best is None or len(seen.ids) > best[0]):
                best = len(seen.ids), board
    return best[1] if best else None


def _readings(grey: np.ndarray, quads: np.ndarray, dictionary: str, touching: bool) -> Iterator[Markers]:
    if not len(quads):
        return
    reader = _Reader(grey, quads)
    if touching:
        for border_bits in (2, 1):
            yield _identified(reader, dictionary or "APRILTAG_36h11", border_bits)
        return
    if dictionary:
        yield _identified(reader, dictionary, 1)
        return
    for family, sizes in _FAMILIES:
        seen = _identified(reader, f"{family}_{sizes[-1]}" if sizes else family, 1)
        if sizes and len(seen.ids):
            smallest = next(size for size in sizes if seen.ids.max() < size)
            seen = Markers(f"{family}_{smallest}", seen.ids, seen.corners, 1)
        yield seen


def _layout(seen: Markers, kind: Kind) -> Board | None:
    """The board on which neighbouring markers stand as they do in the picture."""
    if len(seen.ids) < 3:
        return None
    offsets, pairs = _neighbours(seen.corners)
    if len(pairs) < _LEAST_PAIRS:
        return None
    best: tuple[float, Board] | None = None
    first, second = seen.ids[pairs[:, 0]], seen.ids[pairs[:, 1]]
    for columns in range(2 if kind == "aprilgrid" else 3, min(int(seen.ids.max()) * 2 + 3, 40)):
        for legacy in (False, True) if kind == "charuco" else (False,):
            place = _places(np.arange(seen.ids.max() + 1), columns, kind, legacy)
            step = place[second] - place[first]
            unit = float((step * offsets).sum() / max((step * step).sum(), 1e-9))
            wanted = (1.02, 2.0) if kind == "aprilgrid" else (1.02, 3.0)
            if not wanted[0] < unit < wanted[1]:
                continue
            off = np.linalg.norm(offsets - unit * step, axis=1)
            agree = float((off < 0.3 * unit).mean())
            rows = round(float(np.ptp(place[:, 1]))) + 1
            rows += rows % 2 if legacy else 0
            if agree < _AGREE or rows < (2 if kind == "aprilgrid" else 3):
                continue
            ratio = unit - 1 if kind == "aprilgrid" else 1 / unit
            if best is None or agree > best[0] + 0.02:  # of equals the plain layout with fewer columns
                best = (
                    agree,
                    Board(
                        columns,
                        rows,
                        kind=kind,
                        dictionary=seen.dictionary,
                        ratio=round(float(np.clip(ratio, 0.02, 0.98)), 3),
                        legacy=legacy,
                        border_bits=seen.border_bits if kind == "aprilgrid" else 2,
                        scaled=False,
                    ),
                )
    return best[1] if best else None


def _places(ids: np.ndarray, columns: int, kind: Kind, legacy: bool) -> np.ndarray:
    """Where markers stand on a board, in squares (ChArUco) or tags with a gap (AprilGrid), (n, 2).

    x is along the top edge of a marker as OpenCV draws it, y down: an AprilGrid's tags stand upside down.
    """
    if kind == "aprilgrid":
        return np.stack([-(ids % columns), ids // columns], -1).astype(float)
    rows = 2 * (len(ids) // columns) + 4
    colour = np.add.outer(np.arange(rows), np.arange(columns)) % 2
    return np.argwhere(colour != (1 if legacy else 0))[ids][:, ::-1].astype(float)


def _neighbours(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets from markers to their nearest neighbours, in sides of the marker: (m, 2), and which pairs (m, 2)."""
    import cv2

    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    middles = corners.mean(1).astype(np.float32)
    offsets, pairs = [], []
    for i, quad in enumerate(corners):
        side = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).max()
        near = np.argsort(np.linalg.norm(middles - middles[i], axis=1))[1:7]
        near = near[np.linalg.norm(middles[near] - middles[i], axis=1) < 4 * side]
        if len(near):
            to_unit = cv2.getPerspectiveTransform(quad.astype(np.float32), unit)
            offsets.append(cv2.perspectiveTransform(middles[near][None], to_unit)[0] - 0.5)
            pairs.append(np.column_stack([np.full(len(near), i), near]))
    if not offsets:
        return np.zeros((0, 2)), np.zeros((0, 2), int)
    return np.concatenate(offsets).astype(np.float64), np.concatenate(pairs)
