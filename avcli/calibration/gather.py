"""The boards of many pictures, and what became of each picture."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from avcli.calibration import calibrate, corners
from avcli.calibration.corners import View
from avcli.calibration.target import Board

_THREADS = 4
_MISSES = 8
"""Pictures without a board that are kept, to guess another board's size from."""


def look(image: np.ndarray, board: Board, thorough: bool) -> tuple[np.ndarray, View | None]:
    """Find the board in a picture as a camera gives it: the grey picture, and the view if there is one."""
    grey = corners.to_grey(image)
    view = corners.find(grey, board, thorough=thorough)
    if view is not None and not board.markers and not corners.is_whole(grey, view.pixels, board.inner):
        view = None
    return grey, view


def look_ahead(pictures: Iterable, board: Callable[[], Board], thorough: bool, *, eager: bool) -> Iterator[tuple]:
    """Yield (picture, grey, view or None) in order, several pictures looked at in threads.

    OpenCV lets go of Python's lock, so that threads help.

    Args:
        pictures: things with an `image`.
        board: says which board to look for, asked anew for every picture.
        thorough: see corners.find.
        eager: give each result before the next picture is waited for, as hints while filming need it.
    """
    with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
        waiting = deque()
        try:
            for picture in pictures:
                waiting.append((picture, pool.submit(look, picture.image, board(), thorough)))
                if eager or len(waiting) >= _THREADS:
                    picture, found = waiting.popleft()
                    yield picture, *found.result()
            while waiting:
                picture, found = waiting.popleft()
                yield picture, *found.result()
        finally:
            for _, future in waiting:
                future.cancel()


class Seen:
    """What became of each picture, in order.

    Attributes:
        board: the board that was looked for.
        views: those that can be used.
        names: what the picture of each of them is called.
        misses: some pictures without a board, reduced.
        size: (width, height) px of all pictures; None before the first.
        sample: (height, width) uint8, a picture with a board; None before the first.
    """

    def __init__(self, board: Board):
        self.board = board
        self.views: list[View] = []
        self.names: list[str] = []
        self.misses: list[np.ndarray] = []
        self.size: tuple[int, int] | None = None
        self.sample: np.ndarray | None = None
        self._pictures: list[dict] = []

    def __len__(self) -> int:
        """Count the pictures."""
        return len(self._pictures)

    def take(self, name: str, timestamp: float, grey: np.ndarray, view: View | None) -> None:
        """Add a picture (height, width) uint8 and the view in it.

        Raises:
            ValueError: it has another size than those before.
        """
        size = grey.shape[::-1]
        self.size = self.size or size
        if size != self.size:
            raise ValueError(
                f"{name} is {size[0]} × {size[1]} px and the pictures before it are {self.size[0]} × {self.size[1]} "
                "px: one lens has one size"
            )
        why = None
        if view is None:
            why = "no board"
            if len(self.misses) < _MISSES:
                self.misses.append(corners.shrunk(grey)[0])
        elif calibrate.is_duplicate(view, self.views):
            why = "duplicate"
        else:
            self.views.append(view)
            self.names.append(name)
            self.sample = grey if self.sample is None else self.sample
        index = None if why else len(self.views) - 1
        self._pictures.append({"timestamp": timestamp, "picture": name, "why": why, "view": index})

    def count(self, why: str) -> int:
        """Count the pictures that were left out for a reason, "no board" or "duplicate"."""
        return sum(picture["why"] == why for picture in self._pictures)

    @property
    def few(self) -> bool:
        """Whether the board was found so seldom that it may have another size."""
        return bool(self._pictures) and self.count("no board") > 0.7 * len(self)

    def records(self, result: calibrate.Calibration | None) -> Iterator[dict]:
        """Yield a record a picture; one that was used has its corners and its residual under `result`."""
        for number, picture in enumerate(self._pictures):
            row = {"timestamp": picture["timestamp"], "frame_number": number, "picture": picture["picture"]}
            index, why, kept = picture["view"], picture["why"], False
            if index is not None:
                view, why = self.views[index], "no fit"
                row["corner_ids"], row["corners_px"] = view.ids, view.pixels
                if result is not None:
                    kept = bool(result.kept[index])
                    row["rms_px"] = float(result.view_rms_px[index])
                    why = None if kept else "does not fit"
            yield {**row, "kept": kept, "why": why}
