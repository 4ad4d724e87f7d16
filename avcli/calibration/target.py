"""Calibration boards: their geometry, and drawings of them to print at true size."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import cv2

PAPERS_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
"""Paper sizes (ISO 216), width and height in mm."""

MARKER_RATIO = 0.75
"""Side of a ChArUco marker over the side of its square."""


@dataclass(frozen=True)
class Board:
    """A flat board of `columns` × `rows` squares of `square_m` metres; with markers it is a ChArUco board.

    The board's frame has its origin in the middle of the board, x along the columns to the right, y down along the
    rows, z into the board, as the camera frame of someone who looks straight at it. A checkerboard whose counts are
    both even or both odd looks the same when turned by 180 degrees.
    """

    columns: int
    rows: int
    square_m: float = 1.0
    markers: bool = False

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise ValueError(f"a board of {self} squares is too small; it needs at least 3x3")
        if not 0 < self.square_m < np.inf:
            raise ValueError(f"the side of a square must be above 0 mm and finite, found {self.square_m * 1000:g} mm")

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    @property
    def is_ambiguous(self) -> bool:
        """Whether the board looks the same when it is turned by 180 degrees."""
        return not self.markers and self.columns % 2 == self.rows % 2

    @property
    def inner(self) -> tuple[int, int]:
        """Inner corners along a row and along a column, as OpenCV counts a board."""
        return self.columns - 1, self.rows - 1

    @property
    def points(self) -> np.ndarray:
        """Inner corners, row by row, (n, 2) m in the board's frame."""
        nx, ny = self.inner
        x, y = np.meshgrid(np.arange(nx) - (nx - 1) / 2, np.arange(ny) - (ny - 1) / 2)
        return self.square_m * np.stack([x.ravel(), y.ravel()], -1)

    @property
    def half_extent(self) -> np.ndarray:
        """Half the distance between the outermost inner corners, (2,) m."""
        return self.square_m * (np.array(self.inner) - 1) / 2

    def charuco(self) -> "cv2.aruco.CharucoBoard":
        """OpenCV's description of the same board with markers (dictionary 5X5_250)."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
        if self.columns * self.rows // 2 > 250:
            raise ValueError(f"a board of {self} squares needs more than the dictionary's 250 markers")
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, MARKER_RATIO * self.square_m, dictionary
        )


def parse_size(text: str) -> tuple[int, int]:
    """Read "6x8": squares along a row and along a column.

    Raises:
        ValueError: it is not two whole numbers with an x between.
    """
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"expected the board's squares as COLSxROWS, for example 6x8, found {text!r}")
    return int(parts[0]), int(parts[1])


@dataclass(frozen=True)
class Drawing:
    """A page in mm from its top left: black rectangles (n, 4) x y width height, and texts (x, y, size, words)."""

    width_mm: float
    height_mm: float
    rectangles: np.ndarray
    texts: tuple[tuple[float, float, float, str], ...]


def draw(board: Board, paper: str | None = None) -> Drawing:
    """Draw a board to print, with a ruler along two sides and, where there is room, a quiet border of a square.

    Args:
        board: its squares have their true size.
        paper: a name in PAPERS_MM, turned as the board needs it; None makes the page as large as the board needs.

    Raises:
        ValueError: the board does not fit on the paper.
    """
    square = 1000 * board.square_m
    wide, high = board.columns * square, board.rows * square
    ruler = 14.0
    need = wide + 2 * ruler, high + 2 * ruler
    if paper is None:
        page = wide + 2 * max(square, ruler), high + 2 * max(square, ruler)
    else:
        if paper not in PAPERS_MM:
            raise ValueError(f"unknown paper {paper!r}; known are {', '.join(PAPERS_MM)}")
        page = PAPERS_MM[paper] if wide <= high else PAPERS_MM[paper][::-1]
        if need[0] > page[0] or need[1] > page[1]:
            largest = min((page[0] - 2 * ruler) / board.columns, (page[1] - 2 * ruler) / board.rows)
            raise ValueError(
                f"{board} squares of {square:g} mm need {need[0]:.0f} × {need[1]:.0f} mm and do not fit on {paper}; "
                f"the largest squares that fit have {np.floor(largest):.0f} mm"
            )
    x0, y0 = (page[0] - wide) / 2, (page[1] - high) / 2
    rows, columns = np.nonzero(np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2 == 0)
    squares = np.stack(
        [x0 + columns * square, y0 + rows * square, np.full(len(rows), square), np.full(len(rows), square)], -1
    )
    parts = [squares]
    if board.markers:
        parts.append(_marker_cells(board, x0, y0, square))
    horizontal, labels_x = _ruler(wide, x0, y0 + high + ruler - 5.0, along_x=True)
    vertical, labels_y = _ruler(high, y0, x0 - ruler + 5.0, along_x=False)
    kind = "ChArUco (DICT_5X5_250)" if board.markers else "checkerboard"
    caption = f"{board} squares of {square:g} mm, {kind}. Print at 100 % and measure both rulers."
    return Drawing(
        *page,
        np.concatenate([*parts, horizontal, vertical]),
        (*labels_x, *labels_y, (x0, y0 - ruler + 8.0, 3.0, caption)),
    )


def _marker_cells(board: Board, x0: float, y0: float, square: float) -> np.ndarray:
    """The black cells of all markers, (n, 4) mm; horizontal neighbours are joined so that no hairlines show."""
    import cv2

    dictionary = board.charuco().getDictionary()
    cells = dictionary.markerSize + 2
    cell = MARKER_RATIO * square / cells
    margin = (1 - MARKER_RATIO) / 2 * square
    found = []
    whites = [(r, c) for r in range(board.rows) for c in range(board.columns) if (r + c) % 2]
    for identity, (row, column) in enumerate(whites):
        black = cv2.aruco.generateImageMarker(dictionary, identity, cells) == 0
        for y, line in enumerate(black):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
            for begin, end in edges.reshape(-1, 2):
                left, top = x0 + column * square + margin, y0 + row * square + margin
                found.append((left + begin * cell, top + y * cell, (end - begin) * cell, cell))
    return np.array(found)


def _ruler(
    length: float, start: float, place: float, *, along_x: bool
) -> tuple[np.ndarray, list[tuple[float, float, float, str]]]:
    """Ticks every 10 mm over the whole centimetres in `length`, and their labels every 50 mm."""
    ticks = np.arange(0, length + 1e-9, 10.0)
    long = np.where(ticks % 50 == 0, 4.0, 2.0)
    thin = 0.3
    boxes = np.stack([start + ticks - thin / 2, np.full(len(ticks), place), np.full(len(ticks), thin), long], -1)
    boxes = np.concatenate([boxes, [[start, place, ticks[-1], thin]]])
    marks = [(start + t, place + 7.0, 2.5, f"{t:.0f} mm" if t else "0") for t in ticks[ticks % 50 == 0]]
    if not along_x:
        boxes = boxes[:, [1, 0, 3, 2]]
        boxes[:, 0] -= np.append(long, 0)  # ticks point away from the board
        marks = [
            (place + 1.0, x + 1.0, size, text.removesuffix(" mm")) for x, _, size, text in marks
        ]  # towards the board
    return boxes, marks


def to_svg(drawing: Drawing) -> str:
    """Write a drawing as SVG whose user unit is a millimetre."""
    path = "".join(
        f"M{_short(x)} {_short(y)}h{_short(w)}v{_short(h)}h{_short(-w)}z" for x, y, w, h in drawing.rectangles
    )
    texts = "".join(
        f'<text x="{_short(x)}" y="{_short(y)}" font-size="{_short(size)}">{text}</text>\n'
        for x, y, size, text in drawing.texts
    )
    width, height = _short(drawing.width_mm), _short(drawing.height_mm)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}" shape-rendering="crispEdges">\n'
        f'<rect width="{width}" height="{height}" fill="#fff"/>\n<path d="{path}"/>\n'
        f'<g font-family="Helvetica, Arial, sans-serif">\n{texts}</g>\n</svg>\n'
    )


def to_pdf(drawing: Drawing) -> bytes:
    """Write a drawing as a PDF page at true size (ISO 32000-1; no time in it, so the same board is the same file)."""
    scale = 72 / 25.4

    def at(x: float, y: float) -> str:
        return f"{_short(x * scale, 4)} {_short((drawing.height_mm - y) * scale, 4)}"

    lines = [
        f"{at(x, y + h)} {_short(w * scale, 4)} {_short(h * scale, 4)} re" for x, y, w, h in drawing.rectangles
    ] + ["f"]
    for x, y, size, text in drawing.texts:
        escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        lines.append(f"BT /F1 {_short(size * scale, 4)} Tf {at(x, y)} Td ({escaped}) Tj ET")
    content = "\n".join(lines).encode("latin-1")
    box = f"[0 0 {_short(drawing.width_mm * scale, 4)} {_short(drawing.height_mm * scale, 4)}]"
    bodies = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    out, offsets = b"%PDF-1.4\n", []
    for number, body in enumerate(bodies, 1):
        offsets.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    size = len(bodies) + 1
    return out + b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (
        size,
        table,
        size,
        len(out),
    )


def _short(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if round(value, digits) else "0"
