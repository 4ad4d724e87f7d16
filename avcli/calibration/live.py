"""Hints while someone films a board."""

from collections.abc import Callable

import numpy as np

from avcli.calibration import fit, quality, robust
from avcli.calibration.calibrate import observe
from avcli.calibration.corners import View
from avcli.calibration.gather import Seen
from avcli.calibration.target import Board


class Guide:
    """What is known of the lens so far, and what to film next.

    Attributes:
        quality: of the fit to the views so far; None before the fourth.
        counts: (rows, columns) corners seen in each cell of the picture; None before the first view.
        hint: the newest hint.
    """

    def __init__(
        self,
        enough_px: float | None = None,
        say: Callable[[str], None] = lambda _: None,
        show: Callable[[np.ndarray], None] | None = None,
    ):
        """Start without knowledge.

        Args:
            enough_px: mean expected error over the picture that is good enough; None: none is.
            say: gets each new hint.
            show: gets each picture (height, width, 3) uint8 RGB with corners, coverage and hint drawn into it.
        """
        self.quality: quality.Quality | None = None
        self.counts: np.ndarray | None = None
        self.hint = "hold the board in front of the camera"
        self._enough_px, self._say, self._show = enough_px, say, show
        self._known = 0

    def after(self, seen: Seen, grey: np.ndarray, view: View | None) -> bool:
        """Learn from the newest picture, (height, width) uint8, and tell whether enough is known."""
        hint = self.take(seen.board, seen.views, view is not None)
        if hint:
            self._say(hint)
        if self._show:
            self._show(overlay(grey, view, self))
        good = self.quality is not None and not self.quality.refusals
        return good and self._enough_px is not None and self.mean_px <= self._enough_px

    @property
    def mean_px(self) -> float:
        """Mean expected error over the picture, px; infinite before it is known."""
        return self.quality.mean_sd_px if self.quality else float("inf")

    def take(self, board: Board, views: list[View], found: bool) -> str | None:
        """Learn from the views so far; return a hint when something is new.

        Args:
            board: the board.
            views: all views that differ, in order.
            found: whether the newest picture shows a board.
        """
        if len(views) == self._known:
            if found:
                self.hint = "hold the board somewhere else"
            return None
        self._known = len(views)
        width, height = views[0].width, views[0].height
        seen = observe(board, views)
        self.counts = quality.coverage(seen.pixels, width, height)
        hit = 100 * float((self.counts > 0).mean())
        progress = f"{len(views)} view{'s' if len(views) > 1 else ''}, {hit:.0f} % of the picture covered"
        if len(views) < quality.LEAST_VIEWS:
            self.hint = f"{progress}: hold the board somewhere else, and tilt it"
            return self.hint
        try:
            solution, good = robust.fit_robustly(seen, width, height)
        except fit.NoFit:
            return None
        some = seen.of_corners(good)
        self.quality = quality.assess(some, solution, width, height, float("nan"))
        self.hint = f"{progress}: {quality.next_view(self.quality)}"
        return self.hint


def overlay(grey: np.ndarray, view: View | None, guide: Guide, width: int = 960) -> np.ndarray:
    """Draw corners, coverage and the hint into a picture.

    Args:
        grey: (height, width) uint8.
        view: the board in it.
        guide: what is known so far.
        width: px, of what is returned.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    import cv2

    scale = width / grey.shape[1]
    small = cv2.cvtColor(
        cv2.resize(grey, (width, round(grey.shape[0] * scale)), interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB
    )
    if guide.counts is not None:
        seen = (guide.counts > 0).astype(np.uint8)
        cells = cv2.resize(seen, small.shape[1::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
        small[cells, 1] = np.minimum(small[cells, 1].astype(int) + 45, 255)
        small[~cells, 0] = np.minimum(small[~cells, 0].astype(int) + 30, 255)
    if view is not None:
        for u, v in (view.pixels + 0.5) * scale - 0.5:
            cv2.circle(small, (round(float(u)), round(float(v))), 3, (255, 220, 0), 1, cv2.LINE_AA)
    cv2.rectangle(small, (0, small.shape[0] - 28), (width, small.shape[0]), (0, 0, 0), -1)
    hint = guide.hint.encode("ascii", "replace").decode()
    cv2.putText(small, hint, (8, small.shape[0] - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return small
