"""Hints while someone films a board: what is known, what is missing, where to hold it next, when it is enough."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from avcli.calibration import field, fit, nextview, quality, robust, uncertainty
from avcli.calibration.calibrate import calibrate_views, observe
from avcli.calibration.circle import Circle
from avcli.calibration.corners import View
from avcli.calibration.gather import Seen, is_duplicate
from avcli.calibration.settings import FitSettings
from avcli.calibration.target import Board
from avcli.formats.footage import Picture
from avcli.lens import LENSES, KannalaBrandt, Lens

ENOUGH = 1 / 6400
"""Mean expected error over the lit picture that is enough, over the picture's width: 0.3 px of 1920."""
ENOUGH_RAD = np.deg2rad(0.02)
"""The same as an angle on the axis, 1 mm at 3 m, which is enough where it is more px: of a lens of long focal length
0.3 px are less than that, and take more pictures than a person films."""
ENOUGH_PART = 0.8
"""Part of the lit picture in which the lens must be trusted: whole boards do not get into the corners."""
LEAST_VIEWS = 8
"""Views before which nothing is enough, whatever the fit says of itself."""
_AFRESH = 8
"""Every so many views the fit begins from nothing, so that views that were left out early get another chance."""
_SMALL_GAIN = 0.02
"""Fraction by which the next view must lower the expected error; below it, more pictures are hardly worth it."""
_APART = 0.02
"""How far the corners must be from those of each other view (RMS over the picture's width) to be a view of its own."""
_STILL = 0.03
"""Speed of the corners up to which a board is held still, in picture widths a second: the rows of most sensors are read
within 1/30 s of each other, so that the picture of a faster board is sheared by more than its corners' error."""
_GAP_S = 0.5
"""s between two pictures beyond which nothing is known of the board's speed."""
_BLUR = 1.6
"""How many times the sharpest view's edges may be as wide."""
_PATIENCE = 60
"""Looks after which another place is proposed, because the board was not seen at this one."""
_THERE = 0.06
"""Distance from the proposed place (RMS over the picture's width) at which the board has arrived."""


@dataclass(frozen=True)
class Bar:
    """How much of something is reached.

    Attributes:
        name: one word.
        value: from 0 to 1, which is enough.
        text: the figure behind it.
    """

    name: str
    value: float
    text: str


@dataclass(frozen=True)
class State:
    """What a person who films needs to see.

    Attributes:
        hint: what to do next.
        views: how many were taken.
        bars: progress.
        found: whether the newest picture shows the board.
        there: whether the board is where it was asked for.
        enough: whether the filming can end.
    """

    hint: str
    views: int
    bars: tuple[Bar, ...]
    found: bool
    there: bool
    enough: bool

    def record(self) -> dict:
        """Return the state as JSON's types."""
        bars = [{"name": bar.name, "value": round(bar.value, 3), "text": bar.text} for bar in self.bars]
        return {**self.__dict__, "bars": bars}


class Guide:
    """What is known of the lens so far, and what to film next.

    Give `reason` and `after` to gather.collect.

    Attributes:
        quality: of the fit to the views so far; None before the fourth.
        mean_px: mean expected error over the lit picture, px; infinite before it is known. The larger of what the
            disagreement of the views says in each direction, and of what it says on average over them: who stops as
            soon as a figure is small meets those that are too small by chance.
        counts, lit_cells: (rows, columns) corners seen in each cell of the picture, and which of the cells light
            reaches; None before the first view.
        solution: the fit to the views so far; None before the first view.
        proposal: where to hold the board next; None before the first picture, and where no place is left.
        state: for the person.
    """

    def __init__(
        self,
        settings: FitSettings | None = None,
        enough_px: float | None = None,
        say: Callable[[str], None] = lambda _: None,
        show: Callable[[np.ndarray, State], None] | None = None,
        stops: bool = True,
    ):
        """Start without knowledge.

        Args:
            settings: of the fit that follows.
            enough_px: mean expected error over the picture that is good enough; None: `wanted_px`.
            say: gets each new hint.
            show: gets each picture (height, width, 3) uint8 RGB with corners, coverage and the place for the board
                drawn into it, and the state.
            stops: whether `after` ends the search when enough is known.
        """
        self.settings = settings or FitSettings()
        self.quality: quality.Quality | None = None
        self.mean_px = np.inf
        self.counts: np.ndarray | None = None
        self.lit_cells: np.ndarray | None = None
        self._circle: Circle | None = None
        self.proposal: nextview.Proposal | None = None
        self.state = State("hold the board in front of the camera", 0, (), found=False, there=False, enough=False)
        self._enough_px, self._say, self._show, self._stops = enough_px, say, show, stops
        self.solution: fit.Solution | None = None
        self._good = np.zeros(0, bool)
        self._board: Board | None = None
        self._known, self._looks, self._confirm_at = 0, 0, LEAST_VIEWS
        self._avoid: tuple[np.ndarray, ...] = ()
        self._last: tuple[float, View | None] | None = None
        self._why: str | None = None
        self._width_px, self._sharpest_px = np.nan, np.inf

    # --- which pictures to take

    def reason(self, seen: Seen, picture: Picture, view: View | None) -> str | None:
        """Tell why a view is not worth taking: "moving", "blurred" or "duplicate"; None where it is, or is none."""
        last, self._last = self._last, (picture.timestamp, view)
        self._why = None if view is None else self._reason(seen, picture.timestamp, view, last)
        return self._why

    def _reason(self, seen: Seen, now: float, view: View, last: tuple[float, View | None] | None) -> str | None:
        self._width_px = edge_width(view)
        self._sharpest_px = min(self._sharpest_px, self._width_px)
        if last and now - last[0] < _GAP_S:
            moved = np.inf if last[1] is None else _apart(view, last[1])
            if moved > _STILL * view.width * (now - last[0]):
                return "moving"
        if self._width_px > _BLUR * self._sharpest_px + 1.0:
            return "blurred"
        return "duplicate" if is_duplicate(view, seen.views, _APART * view.width) else None

    def after(self, seen: Seen, grey: np.ndarray, view: View | None) -> bool:
        """Learn from the newest picture, (height, width) uint8, and tell whether enough is known."""
        hint = self.take(seen.board, seen.views, view, grey.shape[1], grey.shape[0], seen.light.circle)
        if hint:
            self._say(hint)
        if self._show:
            self._show(overlay(grey, view, self), self.state)
        return self.state.enough and self._stops

    # --- what is known

    def take(
        self, board: Board, views: list[View], view: View | None, width: int, height: int, circle: Circle | None = None
    ) -> str | None:
        """Learn from the views so far; return a hint when something is new.

        Args:
            board: the board.
            views: all views that differ, in order.
            view: of the newest picture; None where it shows no board.
            width, height: px, of the pictures.
            circle: where light reaches them; None: everywhere.
        """
        self._looks, self._circle = self._looks + 1, circle
        if board != self._board:  # it has only now been recognised
            self._board, self.quality, self.solution, self._known = board, None, None, -1
            self.mean_px = np.inf
        new = len(views) != self._known
        if new:
            self._known, self._looks = len(views), 0
            if views:
                middle, near = views[-1].pixels.mean(0), nextview.NEAR * width
                self._avoid = tuple(place for place in self._avoid if np.linalg.norm(place - middle) > near)
                self._learn(board, views)
        elif self._looks > _PATIENCE and self.proposal is not None:
            self._avoid, self._looks = (*self._avoid, self.proposal.middle), 0
        if new or self._looks == 0 or self.proposal is None:
            self._propose(board, views, width, height)
        there = view is not None and self.proposal is not None and self._is_there(board, view)
        enough = self.state.enough or (new and self._is_enough(board, views, width))
        hint = self._hint(view, width, there=there, enough=enough)
        self.state = State(hint, len(views), self._bars(views, width), view is not None, there, enough)
        known = f", expected error {self.mean_px:.2f} px" if np.isfinite(self.mean_px) else ""
        covered = f"{100 * self._covered:.0f} % of the picture covered{known}"
        return f"{_count(len(views))}, {covered}: {hint}" if new and views else None

    def _learn(self, board: Board, views: list[View]) -> None:
        """Fit the views so far: from the fit before where there is one, since only one view is new."""
        width, height = views[0].width, views[0].height
        seen = observe(board, views)
        self.counts = quality.coverage(seen.pixels, width, height)
        self.lit_cells = quality.lit_cells(self.counts.shape, width, height, self._circle)
        try:
            if len(views) < quality.LEAST_VIEWS:
                self.solution = fit.scan_focal(seen, width, height, self._model)
                self._good = np.ones(len(seen.pixels), bool)
                return
            if self.quality is not None and len(views) % _AFRESH:
                self.solution, self._good = self._with_newest(seen)
            else:
                self.solution, self._good = robust.fit_robustly(seen, width, height, model=self._model)
        except fit.NoFit:
            return
        some = seen.of_corners(self._good)
        self.quality = quality.assess(some, self.solution, width, height, float("nan"), self._circle, 0)
        pooled = replace(self.solution, covariance=fit.covariance(some, self.solution, uncertainty.pooled)[0])
        fields = self.quality.field, field.measured(some, pooled, width, height, self._circle)
        self.mean_px = max(one.mean_px for one in fields)

    def _with_newest(self, seen: fit.Observations) -> tuple[fit.Solution, np.ndarray]:
        """Fit the views again from the fit of all but the newest."""
        assert self.solution is not None
        new = np.ones(len(seen.pixels) - len(self._good), bool)
        start = robust.posed(seen, self.solution, np.append(self._good, ~new))
        good = np.append(self._good, new)
        kept = start.of_views(seen.views_of(good))
        return robust.refit_robustly(seen, fit.fit(seen.of_corners(good), kept, roughly=True), good)

    @property
    def _model(self) -> str:
        return self.settings.lens_model if self.settings.lens_model in LENSES else "kannala_brandt"

    def _propose(self, board: Board, views: list[View], width: int, height: int) -> None:
        if self.solution is None:
            lens = KannalaBrandt(width / 2.1, width / 2.1, (width - 1) / 2, (height - 1) / 2)
            self.proposal = nextview.first(board, lens, width, height)
            return
        seen = observe(board, views).of_corners(self._good)
        circle, solution = self._circle, self.solution

        def propose() -> nextview.Proposal | None:
            return nextview.propose(
                board, solution, seen, width, height, lambda pixels: field.lit(pixels, circle), self._avoid
            )

        self.proposal = propose()
        if self.proposal is None and self._avoid:  # none was reached: begin again with the best one
            self._avoid = ()
            self.proposal = propose()

    def _is_there(self, board: Board, view: View) -> bool:
        assert self.proposal is not None
        asked = self.proposal.seen(board.points)
        if not np.isfinite(asked).all():
            return False
        turned = asked[::-1]
        far = min(float(np.sqrt(((view.pixels - one[view.ids]) ** 2).sum(1).mean())) for one in (asked, turned))
        return far < _THERE * view.width

    # --- when it is enough

    def _is_enough(self, board: Board, views: list[View], width: int) -> bool:
        """Tell whether the filming can end; what the lens will be used for, the whole fit, confirms it."""
        q = self.quality
        if q is None or q.refusals or self._known < self._confirm_at:
            return False
        limit = self._limit_px(width)
        known = self.mean_px <= limit and q.trusted_part >= ENOUGH_PART
        if not known and not self._is_saturated:
            return False
        whole = calibrate_views(board, views, self.settings, self._circle).quality
        if whole.refusals or (known and whole.field.mean_px > limit):
            self._confirm_at = self._known + 3
            return False
        return True

    @property
    def _is_saturated(self) -> bool:
        """Whether no place for the board would still teach much, those included that the person did not reach."""
        gain = 0.0 if self.proposal is None else self.proposal.gain
        return self._known >= 3 * LEAST_VIEWS and not self._avoid and gain < _SMALL_GAIN

    def _limit_px(self, width: int) -> float:
        return self._enough_px or wanted_px(self.solution.lens if self.solution else None, width)

    # --- in words

    def _hint(self, view: View | None, width: int, *, there: bool, enough: bool) -> str:
        if enough:
            error = f"the mean expected error over the picture is {self.mean_px:.2f} px"
            if self.mean_px <= self._limit_px(width):
                return f"enough: {error}"
            return f"you can stop, since more views would hardly help: {error}, {self._limit_px(width):.2f} was wanted"
        if view is not None and self._why == "blurred":
            return "hold the board still: the picture is blurred, or bring more light"
        if there and self._why == "moving":
            return "hold the board still there"
        if self.proposal is None:
            return "hold the board somewhere else"
        return f"hold the board {self.proposal.words}"

    def _bars(self, views: list[View], width: int) -> tuple[Bar, ...]:
        covered, trusted = self._covered, self.quality.trusted_part if self.quality else 0.0
        tilt = near = 0.0
        if self.solution is not None and len(self.solution.rotations) > 1:
            tilt = float(np.rad2deg(quality.tilt(self.solution.rotations)))
            away = np.linalg.norm(self.solution.translations, axis=1)
            near = float(away.max() / max(float(away.min()), 1e-12))
        limit, mean = self._limit_px(width), self.mean_px
        sharp = self._width_px if views and np.isfinite(self._width_px) else np.nan
        far = f"farthest {max(near, 1.0):.1f} times the nearest"
        return (
            Bar("coverage", min(covered / ENOUGH_PART, 1.0), f"corners in {100 * covered:.0f} % of the picture"),
            Bar("trust", min(trusted / ENOUGH_PART, 1.0), f"known in {100 * trusted:.0f} % of the picture"),
            Bar("tilt", min(tilt / 25.0, 1.0), f"± {tilt:.0f}° from the mean direction"),
            Bar("distance", min(np.log(max(near, 1.0)) / np.log(2.0), 1.0), far),
            Bar(
                "sharpness",
                0.0 if np.isnan(sharp) else float(np.clip((9.0 - sharp) / 6.0, 0.0, 1.0)),
                "unknown" if np.isnan(sharp) else f"edges {sharp:.1f} px wide",
            ),
            Bar(
                "certainty",
                float(np.clip(limit / mean, 0.0, 1.0)) if mean > 0 else 1.0,
                f"expected error {mean:.2f} px, wanted {limit:.2f}" if np.isfinite(mean) else "not known yet",
            ),
        )

    @property
    def _covered(self) -> float:
        """Fraction of the lit picture where corners were seen."""
        if self.counts is None or self.lit_cells is None or not self.lit_cells.any():
            return 0.0
        return float((self.counts[self.lit_cells] > 0).mean())


def is_enough(seen: Seen, settings: FitSettings) -> bool:
    """Whether the views so far tell the lens as well as `Guide` wants it, everywhere in the picture."""
    try:
        q = (result := calibrate_views(seen.board, seen.views, settings, seen.light.circle)).quality
    except fit.NoFit:
        return False
    certain = q.field.mean_px <= wanted_px(result.lens, result.width) and not q.halves.ratio > quality.HALVES_LIMIT
    complete = q.trusted_part >= ENOUGH_PART and q.empty <= 1 - ENOUGH_PART
    return certain and complete and not q.refusals and not q.missed > quality.MISSED_LIMIT


def wanted_px(lens: Lens | None, width: int) -> float:
    """The mean expected error over the lit picture that is enough, px, of a lens and a picture's width in px."""
    if lens is None:
        return ENOUGH * width
    on_axis = lens.project_jacobian(np.array([0.0, 0.0, 1.0]))[1][:, :2]
    return max(ENOUGH * width, ENOUGH_RAD * float(np.sqrt(np.abs(np.linalg.det(on_axis)))))


def _count(views: int) -> str:
    return f"{views} view{'s' if views != 1 else ''}"


def _apart(view: View, other: View) -> float:
    """How far the corners that two views share are apart, RMS in px; infinite where they share none."""
    ids, one, two = np.intersect1d(view.ids, other.ids, return_indices=True)
    if not len(ids):
        return float("inf")
    moved = view.pixels[one] - other.pixels[two]
    return float(np.sqrt((moved**2).sum(1).mean()))


def edge_width(view: View) -> float:
    """Width of the board's edges in a view, px: contrast over steepest slope, along the direction that is blurred most.

    A board in focus has 2 to 3 px; motion widens the edges across it, and leaves the others as they are.
    """
    patches = view.patches.astype(np.float32)
    dy, dx = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]) / 2, (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]) / 2
    contrast = np.ptp(np.percentile(patches, [5, 95], axis=(1, 2)), axis=0)
    angles = np.arange(8) * np.pi / 8
    steepest = [
        np.percentile(np.abs(np.cos(a) * dx + np.sin(a) * dy).reshape(len(patches), -1), 98, axis=1) for a in angles
    ]
    return float(np.median(contrast / np.maximum(np.min(steepest, axis=0), 1e-3)))


# --- on the picture ---------------------------------------------------------------------------------------------------

_ASKED, _ARRIVED, _CORNER = (255, 150, 0), (60, 230, 90), (255, 220, 0)
_WIDTH = 960
"""px, of the picture."""


def overlay(grey: np.ndarray, view: View | None, guide: Guide) -> np.ndarray:
    """Draw corners, coverage and the place where the board is wanted into a picture.

    Args:
        grey: (height, width) uint8.
        view: the board in it.
        guide: what is known so far.

    Returns:
        (height, 960, 3) uint8 RGB.
    """
    import cv2

    scale = _WIDTH / grey.shape[1]
    small = cv2.cvtColor(
        cv2.resize(grey, (_WIDTH, round(grey.shape[0] * scale)), interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB
    )
    if guide.counts is not None:
        seen = (guide.counts > 0).astype(np.uint8)
        cells = cv2.resize(seen, small.shape[1::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
        small[cells, 1] = np.minimum(small[cells, 1].astype(int) + 28, 255)
    if view is not None:
        for u, v in _small(view.pixels, scale):
            cv2.circle(small, (u, v), 3, _CORNER, 1, cv2.LINE_AA)
    asked = guide.proposal
    if asked is not None and not guide.state.enough:
        colour = _ARRIVED if guide.state.there else _ASKED
        for line in asked.grid:
            cv2.polylines(small, [_small(line, scale)], False, colour, 1, cv2.LINE_AA)
        cv2.polylines(small, [_small(asked.outline, scale)], True, colour, 4, cv2.LINE_AA)
    return small


def _small(pixels: np.ndarray, scale: float) -> np.ndarray:
    limited = np.clip(np.nan_to_num((pixels + 0.5) * scale - 0.5, nan=-1e4), -1e4, 1e4)
    return np.rint(limited).astype(np.int32)
