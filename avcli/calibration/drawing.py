"""Drawings of calibration boards to print at true size: SVG, PDF, PNG."""

import re
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from avcli.calibration.target import KINDS, Board
from avcli.formats.media import MOST_PIXELS
from avcli.formats.png import encode_png

PAPERS_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
"""Paper sizes (ISO 216; ANSI/ASME Y14.1 and legal), width and height in mm."""

_DOTS_PER_INCH = 300


@dataclass(frozen=True)
class Drawing:
    """A page in mm from its top left, black on white.

    Attributes:
        width_mm, height_mm: of the page.
        rectangles: (n, 4) x, y, width, height.
        circles: (n, 3) x and y of the centre, radius.
        texts: x, y, size, words.
    """

    width_mm: float
    height_mm: float
    rectangles: np.ndarray
    circles: np.ndarray
    texts: tuple[tuple[float, float, float, str], ...]


def paper_mm(paper: str) -> tuple[float, float]:
    """Return width and height in mm of a paper: a name in PAPERS_MM, in small letters or large, or its size in mm.

    Raises:
        ValueError: it is neither.

    >>> paper_mm("a4"), paper_mm("500x700")
    ((210.0, 297.0), (500.0, 700.0))
    """
    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    if paper.lower() in known:
        return known[paper.lower()]
    size = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", paper)
    if size is None or not all(10 <= float(side) <= 10000 for side in size.groups()):
        raise ValueError(f"--paper {paper}: must be {', '.join(PAPERS_MM)}, or a size in mm such as 500x700")
    return float(size[1]), float(size[2])


def draw(board: Board, paper: str | None = None) -> Drawing:
    """Draw a board to print, with a ruler along two sides and, where there is room, a quiet border of a square.

    Args:
        board: its squares have their true size.
        paper: see `paper_mm`, turned as the board needs it; None makes the page as large as the board needs.

    Raises:
        ValueError: the paper is not known, the board does not fit on it, or its dictionary has too few markers.
    """
    side, unit = 1000 * board.square_m, KINDS[board.kind].unit
    wide, high = 1000 * board.printed_m
    ruler = 14.0
    if paper is None:
        quiet = max(1000 * board.clear[0] if board.kind == "aprilgrid" else side, ruler)
        page = wide + 2 * quiet, high + 2 * quiet
    else:
        short, long = sorted(paper_mm(paper))
        page = (short, long) if wide <= high else (long, short)
        if wide + 2 * ruler > page[0] or high + 2 * ruler > page[1]:
            largest = side * min((page[0] - 2 * ruler) / wide, (page[1] - 2 * ruler) / high)
            what = f"{board} {unit} of {side:g} mm" if not board.has_circles else f"{board} circles {side:g} mm apart"
            fit = f"{unit} that fit have" if not board.has_circles else "distance that fits is"
            raise ValueError(
                f"{what} need {wide + 2 * ruler:.0f} × {high + 2 * ruler:.0f} mm and do not fit on {paper}; "
                f"the largest {fit} {np.floor(largest):.0f} mm"
            )
    x0, y0 = (page[0] - wide) / 2, (page[1] - high) / 2
    rectangles, circles = np.zeros((0, 4)), np.zeros((0, 3))
    if board.has_circles:
        centres = 1000 * board.points + np.array(page) / 2
        circles = np.column_stack([centres, np.full(len(centres), 500 * board.diameter_m)])
    elif board.kind == "aprilgrid":
        rectangles = _tags(board, x0, y0)
    else:
        rectangles = _squares(board, x0, y0)
    horizontal, labels_x = _ruler(wide, x0, y0 + high + ruler - 5.0, along_x=True)
    vertical, labels_y = _ruler(high, y0, x0 - ruler + 5.0, along_x=False)
    return Drawing(
        *page,
        np.concatenate([rectangles, horizontal, vertical]),
        circles,
        (*labels_x, *labels_y, (x0, y0 - ruler + 8.0, 3.0, _caption(board))),
    )


def _caption(board: Board) -> str:
    side, unit = f"{1000 * board.square_m:g} mm", KINDS[board.kind].unit
    what = {
        "checkerboard": f"{board} {unit} of {side}, checkerboard",
        "charuco": f"{board} {unit} of {side}, ChArUco (DICT_{board.dictionary}, ratio {board.ratio:g}"
        f"{', legacy' if board.legacy else ''})",
        "aprilgrid": f"AprilGrid of {board} tags of {side}, ratio {board.ratio:g} ("
        f"{board.dictionary.replace('APRILTAG_', 'tag')}, as Kalibr's)",
        "circles": f"{board} circles, {side} apart",
        "asymmetric": f"{board} circles, asymmetric, rows {side} apart",
    }[board.kind]
    return f"{what}. Print at 100 % and measure both rulers."


def _squares(board: Board, x0: float, y0: float) -> np.ndarray:
    """The black squares of a checkerboard or ChArUco board and the cells of its markers, (n, 4) mm."""
    side = 1000 * board.square_m
    first = 1 if board.legacy and board.rows % 2 == 0 else 0
    colour = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
    rows, columns = np.nonzero(colour == first)
    black = np.stack([x0 + columns * side, y0 + rows * side, np.full(len(rows), side), np.full(len(rows), side)], -1)
    if board.kind == "checkerboard":
        return black
    board.aruco_dictionary()
    margin = (1 - board.ratio) / 2 * side
    cells = [
        _cells(board.marker_cells(identity), x0 + column * side + margin, y0 + row * side + margin, board.ratio * side)
        for identity, (row, column) in enumerate(np.argwhere(colour != first))
    ]
    return np.concatenate([black, *cells])


def _tags(board: Board, x0: float, y0: float) -> np.ndarray:
    """The cells of an AprilGrid's tags and the squares between their corners, (n, 4) mm."""
    board.aruco_dictionary()
    side, gap = 1000 * board.square_m, 1000 * board.square_m * board.ratio
    parts = []
    for row in range(board.rows):
        for column in range(board.columns):
            left, top = x0 + gap + column * (side + gap), y0 + gap + (board.rows - 1 - row) * (side + gap)
            parts.append(_cells(board.marker_cells(row * board.columns + column), left, top, side))
    columns, rows = (a.ravel() for a in np.meshgrid(np.arange(board.columns + 1), np.arange(board.rows + 1)))
    corner = np.full(len(columns), gap)
    parts.append(np.stack([x0 + columns * (side + gap), y0 + rows * (side + gap), corner, corner], -1))
    return np.concatenate(parts)


def _cells(black: np.ndarray, left: float, top: float, side: float) -> np.ndarray:
    """The black cells of a marker, (n, 4) mm; horizontal neighbours are joined so that no hairlines show."""
    cell = side / len(black)
    found = []
    for y, line in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        found += [
            (left + begin * cell, top + y * cell, (end - begin) * cell, cell) for begin, end in edges.reshape(-1, 2)
        ]
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
    discs = "".join(f'<circle cx="{_short(x)}" cy="{_short(y)}" r="{_short(r)}"/>\n' for x, y, r in drawing.circles)
    texts = "".join(
        f'<text x="{_short(x)}" y="{_short(y)}" font-size="{_short(size)}">{text}</text>\n'
        for x, y, size, text in drawing.texts
    )
    width, height = _short(drawing.width_mm), _short(drawing.height_mm)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}" shape-rendering="crispEdges">\n'
        f'<rect width="{width}" height="{height}" fill="#fff"/>\n<path d="{path}"/>\n'
        f'<g shape-rendering="geometricPrecision">\n{discs}</g>\n'
        f'<g font-family="Helvetica, Arial, sans-serif">\n{texts}</g>\n</svg>\n'
    )


def to_pdf(drawing: Drawing) -> bytes:
    """Write a drawing as a PDF page at true size (ISO 32000-1; no time in it, so the same board is the same file)."""
    scale = 72 / 25.4

    def at(x: float, y: float) -> str:
        return f"{_short(x * scale, 4)} {_short((drawing.height_mm - y) * scale, 4)}"

    lines = [f"{at(x, y + h)} {_short(w * scale, 4)} {_short(h * scale, 4)} re" for x, y, w, h in drawing.rectangles]
    k = 4 / 3 * (np.sqrt(2) - 1)  # a quarter of a circle as a Bézier curve, to 0.03 % of the radius
    for x, y, r in drawing.circles:
        lines.append(f"{at(x + r, y)} m")
        for (a, b), (c, d) in (((1, 0), (0, 1)), ((0, 1), (-1, 0)), ((-1, 0), (0, -1)), ((0, -1), (1, 0))):
            first, second = at(x + r * (a + k * c), y + r * (b + k * d)), at(x + r * (c + k * a), y + r * (d + k * b))
            lines.append(f"{first} {second} {at(x + r * c, y + r * d)} c")
    lines.append("f")
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


def to_png(drawing: Drawing, dots_per_inch: float = _DOTS_PER_INCH) -> bytes:
    """Write a drawing as a grey PNG at true size (pHYs chunk, RFC 2083), edges weighed by the area that they cover.

    Args:
        drawing: the page.
        dots_per_inch: pixels per 25.4 mm; rounded to whole pixels per metre, as the chunk has them.

    Raises:
        ValueError: the picture would have more pixels than a picture may have.
    """
    import cv2

    per_metre = round(dots_per_inch / 0.0254)
    scale = per_metre / 1000
    width, height = round(drawing.width_mm * scale), round(drawing.height_mm * scale)
    if width * height > MOST_PIXELS:
        raise ValueError(f"a PNG of {width} × {height} px is too large; take fewer dots per inch, SVG or PDF")
    page = np.full((height, width), 255, np.uint8)

    def shade(ink: np.ndarray, top: int, left: int) -> None:
        there = page[top : top + ink.shape[0], left : left + ink.shape[1]]
        there[:] = np.maximum(there - np.rint(255 * ink).astype(np.int16)[: there.shape[0], : there.shape[1]], 0)

    for x, y, w, h in drawing.rectangles * scale:
        left, top = int(x), int(y)
        across = np.arange(left, int(np.ceil(x + w)))
        down = np.arange(top, int(np.ceil(y + h)))
        shade(np.outer(_covered(down, y, y + h), _covered(across, x, x + w)), top, left)
    for x, y, r in drawing.circles * scale:
        left, top, size = int(x - r - 1), int(y - r - 1), int(np.ceil(2 * r + 3))
        across, down = np.arange(left, left + size) + 0.5 - x, np.arange(top, top + size) + 0.5 - y
        shade(np.clip(r + 0.5 - np.hypot(across, down[:, None]), 0, 1), top, left)
    for x, y, letters, text in drawing.texts:
        height_px = 0.72 * letters * scale  # of capital letters
        font = height_px / 21.0
        place = round(x * scale), round(y * scale)
        cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, font, 0, max(1, round(2 * font)), cv2.LINE_AA)
    content = encode_png(page)
    size_chunk = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    chunk = struct.pack(">I", 9) + size_chunk + struct.pack(">I", zlib.crc32(size_chunk))
    after_head = content.index(b"IDAT") - 4
    return content[:after_head] + chunk + content[after_head:]


def _covered(pixels: np.ndarray, begin: float, end: float) -> np.ndarray:
    """How much of each pixel lies between two places, 0 to 1."""
    return np.clip(np.minimum(pixels + 1, end) - np.maximum(pixels, begin), 0, 1)


def kalibr_yaml(board: Board) -> str:
    """Describe a board as Kalibr wants it (target.yaml).

    Raises:
        ValueError: Kalibr does not know such a board.
    """
    side = f"{board.square_m:.6g}"
    if board.kind == "aprilgrid":
        lines = [
            "target_type: 'aprilgrid'",
            f"tagCols: {board.columns}",
            f"tagRows: {board.rows}",
            f"tagSize: {side}",
            f"tagSpacing: {board.ratio:g}",
        ]
    elif board.kind == "checkerboard":
        lines = [
            "target_type: 'checkerboard'",
            f"targetCols: {board.inner[0]}",
            f"targetRows: {board.inner[1]}",
            f"rowSpacingMeters: {side}",
            f"colSpacingMeters: {side}",
        ]
    elif board.has_circles:
        lines = [
            "target_type: 'circlegrid'",
            f"targetCols: {board.columns}",
            f"targetRows: {board.rows}",
            f"spacingMeters: {side}",
            f"asymmetricGrid: {board.kind == 'asymmetric'}",
        ]
    else:
        raise ValueError(f"Kalibr does not know a {board.words}; it knows an AprilGrid, a checkerboard and circles")
    return "".join(f"{line}\n" for line in lines)


def _short(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if round(value, digits) else "0"
