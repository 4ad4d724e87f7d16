"""Calibration boards: what is printed on them, and where its points are."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    import cv2

Kind = Literal["checkerboard", "charuco", "aprilgrid", "circles", "asymmetric"]


@dataclass(frozen=True)
class _Usual:
    """What a kind of board is called, what it counts, and what is usual: markers, ratio, size."""

    words: str
    unit: str
    dictionary: str
    ratio: float
    size: tuple[int, int]


MOST_COUNT = 100  # of squares, tags or circles each way
KINDS: dict[str, _Usual] = {
    "checkerboard": _Usual("checkerboard", "squares", "", 1.0, (7, 10)),
    "charuco": _Usual("ChArUco board", "squares", "5X5_250", 0.75, (7, 10)),
    "aprilgrid": _Usual("AprilGrid", "tags", "APRILTAG_36h11", 0.3, (6, 6)),
    "circles": _Usual("circle grid", "circles", "", 0.5, (7, 9)),
    "asymmetric": _Usual("asymmetric circle grid", "circles", "", 0.5, (4, 11)),
}
"""The kinds of board. `ratio` is the marker's side over the square's (ChArUco), the space between tags over the tag's
side (AprilGrid), or the circle's diameter over the distance between neighbours (circles)."""


@dataclass(frozen=True)
class Board:
    """A flat board of `columns` × `rows` squares, tags or circles.

    The board's frame has its origin in the middle of the board, x along the columns to the right, y down along the
    rows, z into the board, as the camera frame of someone who looks straight at it.

    Attributes:
        columns, rows: squares as printed; tags; or circles, as OpenCV counts them (of an asymmetric grid: in one row,
            and rows).
        square_m: m, the side of a square or tag, or the distance between circles in a row; of an asymmetric grid half
            that distance, which is the one between rows.
        kind: see KINDS.
        dictionary: of the markers, as OpenCV names it without "DICT_".
        ratio: see KINDS; 0 is the usual one.
        legacy: whether a ChArUco board with an even number of rows begins with a marker, as OpenCV drew it before 4.6.
        border_bits: cells in the black border of a tag: 2 as Kalibr draws them, or 1.
        scaled: whether `square_m` was measured; otherwise no length follows from the board.
        rows_known: whether the board has all of its rows; otherwise only those up to the last marker that is seen.
        ratio_known: whether `ratio` was given; an AprilGrid's otherwise is a first guess, which the fit improves.
    """

    columns: int
    rows: int
    square_m: float = 1.0
    kind: Kind = "checkerboard"
    dictionary: str = ""
    ratio: float = 0.0
    legacy: bool = False
    border_bits: int = 2
    scaled: bool = True
    ratio_known: bool = True
    rows_known: bool = True

    def __post_init__(self) -> None:
        usual = KINDS[self.kind]
        least = 3 if usual.unit == "squares" else 2
        if self.columns < least or self.rows < least:
            raise ValueError(f"a board of {self} {usual.unit} is too small; it needs at least {least}x{least}")
        if max(self.columns, self.rows) > MOST_COUNT:
            raise ValueError(f"a board of {self} {usual.unit} is too large; it may have up to {MOST_COUNT} each way")
        if not 0 < self.square_m < np.inf:
            raise ValueError(f"the side of a square must be above 0 mm and finite, found {self.square_m * 1000:g} mm")
        if self.markers:
            object.__setattr__(self, "dictionary", self.dictionary or usual.dictionary)
        elif self.dictionary:
            raise ValueError(f"a {usual.words} has no markers, so it has no dictionary")
        object.__setattr__(self, "ratio", self.ratio or usual.ratio)
        if not 0 < self.ratio <= 1 or (self.kind not in ("checkerboard", "aprilgrid") and self.ratio == 1):
            raise ValueError(f"the ratio of a {usual.words} must be above 0 and below 1, found {self.ratio:g}")

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    @property
    def words(self) -> str:
        """The board in words: "checkerboard of 6x8 squares"."""
        usual = KINDS[self.kind]
        markers = f" with markers of {self.dictionary}" if self.kind == "charuco" else ""
        old = " in the legacy layout" if self.legacy else ""
        return f"{usual.words} of {self} {usual.unit}{markers}{old}"

    @property
    def markers(self) -> bool:
        """Whether the board has markers, so that a part of it is enough."""
        return self.kind in ("charuco", "aprilgrid")

    @property
    def has_circles(self) -> bool:
        """Whether its points are the centres of circles."""
        return self.kind in ("circles", "asymmetric")

    @property
    def is_ambiguous(self) -> bool:
        """Whether the board looks the same when it is turned by 180 degrees."""
        if self.kind == "checkerboard":
            return self.columns % 2 == self.rows % 2
        return self.kind == "circles" or (self.kind == "asymmetric" and self.rows % 2 == 0)

    @property
    def inner(self) -> tuple[int, int]:
        """Inner corners of a checkerboard or ChArUco board along a row and along a column, as OpenCV counts them."""
        return self.columns - 1, self.rows - 1

    @cached_property
    def points(self) -> np.ndarray:
        """The points that are seen in pictures, (n, 2) m in the board's frame.

        Squares: inner corners, row by row from the top left. Circles: centres, row by row from the top left. AprilGrid:
        corners of the tags, row by row from the bottom left, as Kalibr numbers them.
        """
        columns, rows = (a.ravel() for a in self._lattice())
        if self.kind == "aprilgrid":
            pitch = 1 + self.ratio
            x, y = columns // 2 * pitch + columns % 2, -(rows // 2 * pitch + rows % 2)
        elif self.kind == "asymmetric":
            x, y = 2.0 * columns + rows % 2, rows.astype(float)
        else:
            x, y = columns.astype(float), rows.astype(float)
        middle = [(a.max() + a.min()) / 2 for a in (x, y)]
        return self.square_m * np.stack([x - middle[0], y - middle[1]], -1)

    def _lattice(self) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "aprilgrid":
            nx, ny = 2 * self.columns, 2 * self.rows
        else:
            nx, ny = (self.columns, self.rows) if self.has_circles else self.inner
        x, y = np.meshgrid(np.arange(nx), np.arange(ny))
        return x, y

    @property
    def half_extent(self) -> np.ndarray:
        """Half the distance between the outermost points, (2,) m."""
        return (self.points.max(0) - self.points.min(0)) / 2

    @property
    def printed_m(self) -> np.ndarray:
        """Width and height of what is printed, with the small squares around an AprilGrid, (2,) m."""
        if self.kind == "aprilgrid":
            around = 2 * self.ratio * self.square_m
        elif self.has_circles:
            around = self.diameter_m
        else:
            around = 2 * self.square_m
        return 2 * self.half_extent + around

    @property
    def diameter_m(self) -> float:
        """Diameter of the circles, m."""
        return self.ratio * self.square_m * (np.sqrt(2) if self.kind == "asymmetric" else 1.0)

    @property
    def clear(self) -> tuple[float, float]:
        """Around a corner, what of the print is a plain checkerboard corner.

        Returns:
            unit: m, the side of the squares that meet there.
            near: the part of it, from the nearer edge, that is free of markers.
        """
        if self.kind == "aprilgrid":
            gap = self.ratio * self.square_m
            cells = self.marker_cells(0).shape[0]
            return gap, min(1.0, 0.88 * self.border_bits * self.square_m / cells / gap)
        return self.square_m, 0.88 * (1 - self.ratio) / 2 if self.markers else 1.0

    @property
    def markers_needed(self) -> int:
        """How many markers are printed on a board that has some."""
        return self.columns * self.rows // (1 if self.kind == "aprilgrid" else 2)

    def aruco_dictionary(self) -> "cv2.aruco.Dictionary":
        """OpenCV's dictionary of the board's markers.

        Raises:
            ValueError: the dictionary is unknown, or it has too few markers for the board.
        """
        dictionary = dictionary_of(self.dictionary)
        there = len(dictionary.bytesList)
        if self.markers_needed > there:
            raise ValueError(
                f"a {self.words} needs {self.markers_needed} markers; the dictionary {self.dictionary} has {there}"
            )
        return dictionary

    def charuco(self) -> "cv2.aruco.CharucoBoard":
        """OpenCV's description of the same ChArUco board."""
        import cv2

        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.ratio * self.square_m, self.aruco_dictionary()
        )
        board.setLegacyPattern(self.legacy)
        return board

    def marker_cells(self, identity: int) -> np.ndarray:
        """The cells of a marker as it is printed, with its border, (n, n) bool, true where black.

        OpenCV's tags are AprilTag's (and Kalibr's) turned by 180 degrees.
        """
        import cv2

        dictionary, border = dictionary_of(self.dictionary), self.border_bits if self.kind == "aprilgrid" else 1
        cells = dictionary.markerSize + 2 * border
        black = cv2.aruco.generateImageMarker(dictionary, identity, cells, borderBits=border) == 0
        return np.rot90(black, 2) if self.kind == "aprilgrid" else black

    def tag_points(self) -> np.ndarray:
        """Which of an AprilGrid's points are the corners of each tag, in OpenCV's order, (columns × rows, 4)."""
        column, row = (2 * a.ravel() for a in np.meshgrid(np.arange(self.columns), np.arange(self.rows)))
        corners = [(1, 0), (0, 0), (0, 1), (1, 1)]  # of a tag that OpenCV sees upside down; rows run upwards
        return np.stack([(row + up) * 2 * self.columns + column + right for right, up in corners], -1)


def name_of_dictionary(name: str) -> str:
    """OpenCV's name of a dictionary of markers, without "DICT_", from the same in any case and with or without it.

    Raises:
        ValueError: there is none.
    """
    import cv2

    known = {key.removeprefix("DICT_") for key in dir(cv2.aruco) if key.startswith("DICT_")}
    wanted = name.upper().removeprefix("DICT_")
    found = sorted(key for key in known if key.upper() == wanted)
    if not found:
        raise ValueError(f"unknown dictionary {name!r}; known are {', '.join(sorted(known))}")
    return found[-1]  # "APRILTAG_36h11" rather than "APRILTAG_36H11"


def dictionary_of(name: str) -> "cv2.aruco.Dictionary":
    """OpenCV's dictionary of markers with this name ("5X5_250", "APRILTAG_36h11").

    Raises:
        ValueError: there is none.
    """
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name_of_dictionary(name)}"))


def parse_size(text: str) -> tuple[int, int]:
    """Read "6x8": squares along a row and along a column.

    Raises:
        ValueError: it is not two whole numbers with an x between.
    """
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"expected the board's squares as COLSxROWS, for example 6x8, found {text!r}")
    return int(parts[0]), int(parts[1])
