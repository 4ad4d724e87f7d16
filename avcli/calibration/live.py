"""Hints while someone films a board."""

import numpy as np

from avcli.calibration import fit, quality
from avcli.calibration.calibrate import observe
from avcli.calibration.corners import View
from avcli.calibration.target import Board


class Guide:
    """What is known of the lens so far, and what to film next.

    Attributes:
        quality: of the fit to the views so far; None before the fourth.
        counts: (rows, columns) corners seen in each cell of the picture; None before the first view.
        hint: the last thing that was said.
    """

    def __init__(self):
        self.quality: quality.Quality | None = None
        self.counts: np.ndarray | None = None
        self.hint = "hold the board before the camera"
        self._known = 0
        self._solution: fit.Solution | None = None

    @property
    def mean_px(self) -> float:
        """Mean expected error over the picture, px; infinite before it is known."""
        return float(np.nanmean(self.quality.field_sd_px)) if self.quality else float("inf")

    def take(self, board: Board, views: list[View], found: bool) -> str | None:
        """Learn from the views so far; say something when there is something new.

        Args:
            board: the board.
            views: all views that differ, in order.
            found: whether the newest picture shows a board.
        """
        if len(views) == self._known:
            said = "hold the board elsewhere" if found else self.hint
            self.hint = said if found else self.hint
            return None
        self._known = len(views)
        width, height = views[0].width, views[0].height
        seen = observe(board, views)
        self.counts = quality.coverage(seen.pixels, width, height)
        hit = 100 * float((self.counts > 0).mean())
        if len(views) < quality.LEAST_VIEWS:
            self.hint = f"{len(views)} views, {hit:.0f} % of the picture seen: now elsewhere, and tilted"
            return self.hint
        try:
            solution, kept = fit.fit_robustly(seen, width, height)
        except fit.NoFit:
            return None
        some = seen.of_views(kept)
        self.quality = quality.assess(some, solution, width, height, float("nan"))
        self.hint = f"{len(views)} views, {hit:.0f} % of the picture seen: {quality.next_view(self.quality)}"
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
