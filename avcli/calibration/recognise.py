"""Telling which board the first pictures show, where the user did not say."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import circles, markers, saddles
from avcli.calibration.corners import LEAST_GUESSED, View
from avcli.calibration.pyramid import Pyramid
from avcli.calibration.target import KINDS, Board, Kind

_NOMINAL_M = 0.095
"""Side of a square where none was measured; the lens does not depend on it."""
_AGREE = 2
"""Pictures that must show the same board; one may show a tiled floor or another print."""
_MOST_ROWS = 40
_WIDTH, _QUICK_WIDTH, _CROWDED_WIDTH = 1280, 960, 640
"""px; markers and circles are looked for in pictures of this width: thoroughly, quickly, and circles in texture."""


@dataclass(frozen=True)
class Wanted:
    """What is known of a board before any picture is seen; the rest is read from the pictures.

    Attributes:
        size: columns and rows as in Board; None: unknown.
        kind, dictionary, ratio, legacy: as in Board; None, "" and 0: unknown.
        square_m: m, as in Board; None: not measured, so that no length follows.
    """

    size: tuple[int, int] | None = None
    kind: Kind | None = None
    dictionary: str = ""
    ratio: float = 0.0
    legacy: bool | None = None
    square_m: float | None = None

    @property
    def is_complete(self) -> bool:
        """Whether nothing is left to be read from pictures."""
        if self.size is None or self.kind is None:
            return False
        if self.kind == "charuco":
            return bool(self.dictionary and self.ratio)
        return self.kind != "aprilgrid" or bool(self.ratio and self.dictionary)

    def board(self, seen: Board | None = None) -> Board:
        """Return the board: what is known, then what was seen, then what is usual.

        Raises:
            ValueError: there is no such board.
        """
        kind = self.kind or (seen.kind if seen else "checkerboard")
        seen = seen if seen is not None and seen.kind == kind else None
        size = self.size or ((seen.columns, seen.rows) if seen else KINDS[kind].size)
        return Board(
            *size,
            self.square_m or _NOMINAL_M,
            kind,
            self.dictionary or (seen.dictionary if seen else ""),
            self.ratio or (seen.ratio if seen else 0.0),
            legacy=self.legacy if self.legacy is not None else bool(seen and seen.legacy),
            border_bits=seen.border_bits if seen else 2,
            scaled=self.square_m is not None,
            ratio_known=bool(self.ratio) or kind != "aprilgrid",
        )

    def searched(self, seen: Board) -> Board:
        """Return the board to look for: with as many rows as it may have, where only markers tell how many it has."""
        board = self.board(seen)
        if self.size is not None or not board.markers:
            return board
        family = board.dictionary if self.dictionary else largest_of(board.dictionary)
        per_row = board.columns if board.kind == "aprilgrid" else board.columns / 2
        rows = max(board.rows, min(_MOST_ROWS, int(markers.known_markers(family) / per_row)) // 2 * 2)
        return replace(board, rows=rows, dictionary=family, rows_known=False)


def largest_of(dictionary: str) -> str:
    """The largest dictionary that is searched and begins with the same markers."""
    family, _, count = dictionary.rpartition("_")
    return f"{family}_250" if count.isdigit() and int(count) < 250 else dictionary


def look(picture: np.ndarray | Pyramid, wanted: Wanted, *, thorough: bool = True) -> Board | None:
    """Tell which board a picture (height, width) uint8 shows; None where there is none, or not the wanted kind.

    Without `thorough`, the picture is looked at smaller, for a checkerboard only where something speaks for
    one, and for circles only where it is not full of texture.
    """
    kind = wanted.kind
    picture = Pyramid.of(picture)
    small = picture.reduced(_WIDTH if thorough else _QUICK_WIDTH)[0]
    if kind in (None, "charuco", "aprilgrid"):
        found = markers.recognise(small, kind, wanted.dictionary)
        if found is not None or kind is not None:
            return found
    if kind in (None, "checkerboard"):
        if wanted.size:
            inner = wanted.size[0] - 1, wanted.size[1] - 1
            if saddles.find_board(picture, inner, thorough=thorough) is not None:
                return Board(*wanted.size, scaled=False)
        for inner in saddles.sizes(picture, LEAST_GUESSED, thorough=thorough)[:1]:
            if min(inner) < 3:
                break
            return Board(min(inner) + 1, max(inner) + 1, scaled=False)
    if kind == "checkerboard" or (picture.crowded and not thorough):
        return None
    # In a picture full of texture the search for circles would cost most.
    found = circles.recognise(picture.reduced(_CROWDED_WIDTH)[0] if picture.crowded else small)
    return found if found is None or kind in (None, found.kind) else None


def look_in_mirror(picture: np.ndarray, wanted: Wanted) -> Board | None:
    """Tell which board with markers a picture (height, width) uint8 shows in a mirror; other boards tell no mirror."""
    if wanted.kind not in (None, "charuco", "aprilgrid"):
        return None
    small = Pyramid.of(np.ascontiguousarray(picture[:, ::-1])).reduced(_QUICK_WIDTH)[0]
    return markers.recognise(small, wanted.kind, wanted.dictionary)


def agreed(seen: Sequence[Board], *, at_last: bool = False) -> Board | None:
    """Return the board that two of the pictures show, with as many rows as any of them tells; None without one.

    Args:
        seen: what pictures show.
        at_last: there are no more pictures; one is enough.
    """
    if not seen:
        return None
    votes = Counter(map(_identity, seen))
    identity, count = max(votes.items(), key=lambda item: item[1])
    if count < (1 if at_last else _AGREE):
        return None
    same = [board for board in seen if _identity(board) == identity]
    ratio = float(np.median([board.ratio for board in same]))
    if same[0].kind == "charuco" and abs(ratio - round(ratio * 20) / 20) < 0.02:
        ratio = round(ratio * 20) / 20  # boards are drawn with round ratios; corners hardly depend on it
    return replace(max(same, key=lambda board: board.rows), ratio=round(ratio, 3))


def _identity(board: Board) -> tuple:
    rows = 0 if board.markers else board.rows
    return board.kind, board.columns, rows, largest_of(board.dictionary), board.legacy, board.border_bits


def trimmed(board: Board, views: Sequence[View]) -> Board:
    """Cut the rows of a board with markers that no view shows; what the views' corners are called stays.

    A row counts if two views show it, or the only one, since a marker may be misread.
    """
    if not views:
        return board
    width = 2 * board.columns if board.kind == "aprilgrid" else board.inner[0]
    last = sorted((int(view.ids.max()) // width for view in views), reverse=True)
    row = last[min(1, len(last) - 1)]
    rows = row // 2 + 1 if board.kind == "aprilgrid" else row + 2
    rows += rows % 2 if board.legacy else 0
    board = replace(board, rows=max(rows, 2 if board.kind == "aprilgrid" else 3), rows_known=True)
    return replace(board, dictionary=markers.smallest_of(board))


def within(view: View, board: Board) -> View:
    """Return the view without the corners that the board does not have."""
    have = view.ids < len(board.points)
    if have.all():
        return view
    return replace(
        view, ids=view.ids[have], pixels=view.pixels[have], patches=view.patches[have], origins=view.origins[have]
    )
