"""The positions of people from boxes in one colour picture, by the lens and the camera's pose.

Bodies of several kinds (standing, small, seated) whose position and height are unknown are fitted to each box, and to
the points of torso, head and foot where a network gives them: least squares over x, y and height, with a prior on the
height. Each is taken to be seen whole, or hidden on the side of the feet, by furniture or by whoever is nearer. The
picture's border cuts the modelled box as it cuts the real one. The kinds are weighed by how well they explain the box,
and the position is the mean over them, so that its covariance contains what cannot be told apart.

A box that no body explains (somebody who lies, reaches out, or is seen by a hand) is placed on its rays, between the
floor and the top of a head.

Of whom little is seen a network is less sure, and its boxes and points are worse. So its score tells how far the points
and the position are off, and how probable it is that the feet are hidden.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np

from avcli.detection.fitted import BOX, BoxLaw
from avcli.detection.view import View

HEIGHT_M, HEIGHT_SPREAD_M = 1.70, 0.12
"""m; mean and standard deviation of people's heights."""

PART_HEIGHTS = np.array([0.54, 0.93, 0.0])
"""Heights of torso, head and foot as parts of the body's."""

PART_SPREADS, PART_UNSURE = np.array([0.5, 1.0, 2.0]), np.array([3.0, 1.0, 1.0])
"""How much farther off a network's points of torso, head and foot are than the law's of parts says, and how much faster
that grows as the score falls. Of whom a network is sure, it puts the torso twice as well as the head; the foot is what
furniture hides. See examples/benchmarks/detection.md."""

SHARED = 0.5
"""A body explains a box if they share this fraction of their union."""

WALL_SPREAD_M = 0.2
"""m; standard deviation of a wall's place, for somebody who seems to be behind it."""

BODY_M = 0.15
"""m; half the depth of a body."""

TIGHT = 0.75
"""Where a standing or seated body and a box share less, people who lie are thought of too."""

_STEP_M, _MOST_STEPS, _LONGEST_M = 0.01, 6, 1.0
_INWARD = np.array([1.0, 1.0, -1.0, -1.0])

_TILT = 2 * np.pi * np.arange(12) / 12
_RING = np.stack([np.cos(_TILT), np.sin(_TILT)], axis=1)


@dataclass(frozen=True)
class Kind:
    """A kind of body.

    Attributes:
        share: of people, before anything is seen of them.
        height_m, spread_m: mean and standard deviation of the height of its top.
        outline: (m, 3) points of a body of height 1, m across.
    """

    share: float
    height_m: float
    spread_m: float
    outline: np.ndarray


def _rings(*rings: tuple[float, float]) -> np.ndarray:
    """Rings about the axis: part of the height, and the radius, m, that limbs reach there on average."""
    return np.concatenate([np.column_stack([radius * _RING, np.full(12, part)]) for part, radius in rings])


def _lying(azimuth: float) -> np.ndarray:
    along = np.array([np.cos(azimuth), np.sin(azimuth)])
    ends = np.concatenate([end * 0.62 * along + 0.22 * _RING for end in (-1, 0, 1)])
    return np.concatenate([np.column_stack([ends, np.full(36, part)]) for part in (0.1, 1.0)])


_UPRIGHT = ((0.02, 0.20), (0.25, 0.18), (0.5, 0.24), (0.80, 0.24), (0.90, 0.10), (1.0, 0.06))
KINDS = (
    Kind(0.85, HEIGHT_M, HEIGHT_SPREAD_M, _rings(*_UPRIGHT)),
    Kind(0.05, 1.20, 0.15, _rings(*((part, 0.75 * radius) for part, radius in _UPRIGHT))),
    Kind(0.10, 1.28, 0.08, _rings((0.02, 0.26), (0.40, 0.34), (0.5, 0.32), (0.76, 0.26), (0.88, 0.11), (1.0, 0.07))),
)
"""Standing adults; children; people who sit, also in a wheelchair: two of five in random worlds, elsewhere few."""

LYING = tuple(Kind(0.005, 0.28, 0.07, _lying(azimuth)) for azimuth in np.pi / 4 * np.arange(4))
"""People who lie, by azimuth."""

FEET_HIDDEN = 0.25
"""Share of people of whom something hides the side of the feet, where no score tells more. It is set by hand: on random
scenes with little furniture (seed 720000, which decided nothing) 0.08 gains 0.018 nats a box, with a standard error of
0.010."""

FEET_UNSURE, FEET_MOST = 1.0, 0.9
"""Where a network gives points with a score of s, FEET_HIDDEN grows by the first times sqrt(1 - s), to at most the
second. Of people whom the package's own finds with a score of .5 to .8 half is seen on average, above .99 all but a
tenth. A start from 0.1 gains 0.05 nats more (seeds 750000 and 755000) and costs 5 points of S2 by colour alone."""

HEAD_TOLD = 0.7
"""Share of the people with hidden feet whose head a network's point marks. Of the others all points lie as those of a
smaller body that is seen whole. Chosen of 0.3, 0.5, 0.7 and 1 on 409 detections among large panels (seed 730000): 0.059
nats better than 1; who is seen by less than 0.3 is 21 cm off instead of 28. On 105 others (seed 740000, which
decided nothing) it gains 0.092 nats, and the mean squared error in standard deviations falls from 3.4 to 2.6."""


REMEMBERED, LOWER = 0.9, 1.0
"""Probability that a box shows the person whose height is known, in the same posture; and by how many standard
deviations of that height a box must look lower to be thought of as cut."""


class _Hypotheses:
    """Kinds of bodies, each seen whole and, if they are upright, also with the side of the feet hidden.

    Where a network gives points, those of whom the feet are hidden have a head that is marked, or one that is not.
    """

    def __init__(self, kinds: tuple[Kind, ...], *, upright: bool, points: bool = False):
        shares = {(False, True): 1.0}  # of those who are seen whole, and of those whose feet are hidden
        if upright:
            shares[True, True] = HEAD_TOLD if points else 1.0
        if upright and points:
            shares[True, False] = 1 - HEAD_TOLD
        self.kind = np.repeat(np.arange(len(kinds)), len(shares))
        self.hiding, self.told = (np.tile(column, len(kinds)) for column in np.array(list(shares)).T)
        self.upright = np.full(len(self.kind), upright)
        self.outlines = np.stack([kind.outline for kind in kinds])
        self.mean = np.array([kinds[kind].height_m for kind in self.kind])
        self.spread = np.array([kinds[kind].spread_m for kind in self.kind])
        self.kind_share = np.array([kinds[kind].share for kind in self.kind])
        self.log_share = np.log(self.kind_share)
        self.log_share += np.tile(np.log(list(shares.values())), len(kinds))

    def __len__(self) -> int:
        return len(self.kind)

    def beside(self, others: "_Hypotheses") -> "_Hypotheses":
        """These hypotheses, and others after them."""
        both = copy.copy(self)
        for name, mine in vars(self).items():
            setattr(both, name, np.concatenate([mine, getattr(others, name)]))
        both.kind[len(self) :] += len(self.outlines)
        return both


_MOST, _MOST_BY_POINTS = (_Hypotheses(KINDS, upright=True, points=points) for points in (False, True))
_REST = _Hypotheses(LYING, upright=False)
_ALL, _ALL_BY_POINTS = (some.beside(_REST) for some in (_MOST, _MOST_BY_POINTS))

_LEVELS = np.arange(0.1, 1.75, 0.2)
"""m; where what a box shows of somebody may be."""
_WITHIN = np.array([[0.5, 0.5], [0.25, 0.5], [0.75, 0.5], [0.5, 0.25], [0.5, 0.75]])
_EXTENT_M, _EXTENT_SPREAD = (0.25, 2.0), 0.3
"""m, extents that a part of a person may have; and the standard deviation of the logarithm beyond them."""


@dataclass(frozen=True)
class Places:
    """Where the people of n boxes are.

    Attributes:
        positions: (n, 2) x, y m; NaN where none of a box's rays reaches the room.
        covariances: (n, 2, 2) m².
        heights: (n,) m; NaN where no body explains the box.
        explained: (n,) bool, whether some body does.
        alone: (n, 2) m, heights by the boxes alone, whatever was known before, and their standard deviations.
    """

    positions: np.ndarray
    covariances: np.ndarray
    heights: np.ndarray
    explained: np.ndarray
    alone: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Which boxes (n,) have a position."""
        return np.isfinite(self.positions[:, 0])


class Fitted:
    """Bodies fitted to boxes: `places` says where the people are, for whatever is known of their heights.

    Args:
        boxes: (n, 4) [x0, y0, x1, y1] px, corner-based; may reach over the picture's border.
        view: the camera.
        parts: (n, 3, 2) px of torso, head and foot; None if unknown.
        turns: (n,) rad, by which the axes of each box are turned about its middle, from x towards y; None: not at all.
        room: (2,) m, size of the room, whose walls nobody is behind; None if it is not known.
        law: the fitted errors of boxes and of positions by them.
        scores: (n,) of the network that gave the parts, from 0 to 1; None if unknown. Without parts they tell nothing,
            since each network has its own.
        lie: fit people who lie together with the others, and not only after them where these suit a box badly. It
            takes less time where some box is such a one, and more elsewhere; the positions are the same.

    Attributes:
        lie: whether people who lie were thought of.
    """

    def __init__(
        self,
        boxes: np.ndarray,
        view: View,
        parts: np.ndarray | None = None,
        turns: np.ndarray | None = None,
        room: np.ndarray | None = None,
        law: BoxLaw = BOX,
        scores: np.ndarray | None = None,
        lie: bool = False,
    ):
        boxes = np.asarray(boxes, float).reshape(-1, 4)
        self.lie = lie
        self._room, self._law, self._below = room, law, view.origin[:2]
        self._most, every = (_MOST, _ALL) if parts is None else (_MOST_BY_POINTS, _ALL_BY_POINTS)
        if not len(boxes):
            self._alone = Places(
                np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, bool), np.zeros((0, 2))
            )
            return
        self._unsure = None if parts is None or scores is None else np.sqrt(1 - np.clip(scores, 0.0, 1.0))
        count = len(self._most)
        fits = _fitted(boxes, view, parts, turns, self._unsure, law, every if lie else self._most)
        suits = np.where(fits.good[:, :count] & ~self._most.hiding, fits.shared[:, :count], 0.0).max(axis=1) >= TIGHT
        loose = np.flatnonzero(~suits)
        self.lie = len(loose) > 0
        if lie:
            fits.good[suits, count:] = False
        elif len(loose):
            some = [None if item is None else item[loose] for item in (parts, turns, self._unsure)]
            fits = fits.joined(_fitted(boxes[loose], view, some[0], some[1], some[2], law, _REST), loose)
        self._fits = fits
        self._alone = _before_walls(fits, room).merged(law)
        self._on_rays = {
            int(index): _on_rays(boxes[index], 0.0 if turns is None else float(turns[index]), view, room)
            for index in np.flatnonzero(~self._alone.explained)
        }

    def places(self, known: np.ndarray | None = None) -> Places:
        """Where the people are.

        Args:
            known: (n, 2) m, height that a person had before and its standard deviation; NaN if unknown.
        """
        places = self._alone
        if not len(places.positions):
            return places
        if known is not None:
            lower = np.flatnonzero(places.heights < known[:, 0] - LOWER * known[:, 1])
            if len(lower):
                again = _before_walls(self._fits.remembering(known[lower], lower, self._most), self._room)
                places = replace(again.merged(self._law), alone=places.alone)
        covariances = stated(places.covariances.copy(), places.positions - self._below, self._law, self._unsure)
        places = replace(places, positions=places.positions.copy(), covariances=covariances)
        for index, (position, covariance) in self._on_rays.items():
            places.positions[index], places.covariances[index] = position, covariance
        return places


def stated(covariances: np.ndarray, away: np.ndarray, law: BoxLaw, unsure: np.ndarray | None) -> np.ndarray:
    """The covariances (n, 2, 2) m² that a law states for positions with those of the fit (n, 2, 2).

    Args:
        covariances: of mixtures of fits.
        away: (n, 2) m, of the positions from the point below the camera.
        law: how much narrower points make them across the lines of sight, and how the score widens them.
        unsure: (n,) sqrt(1 - score) of a network that gives points; None: there are none.
    """
    if unsure is None:
        return covariances
    along = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    scale = law.across * np.eye(2) + (1 - law.across) * along[..., :, None] * along[..., None, :]
    scale = scale * (law.sure + law.unsure * unsure)[:, None, None]
    out = scale @ covariances @ scale
    return np.asarray((out + out.swapaxes(-1, -2)) / 2)


def _behind(xy: np.ndarray, room: np.ndarray) -> np.ndarray:
    """How far (..., 2) m bodies with axes at (..., 2) are behind the walls of a room (2,)."""
    return np.maximum(np.maximum(BODY_M - xy, xy - room[:2] + BODY_M), 0.0)


def _before_walls(fits: "_Judged", room: np.ndarray | None) -> "_Judged":
    """The fits, with those less probable that are behind a wall of a room (2,)."""
    if room is None:
        return fits
    behind = np.linalg.norm(_behind(fits.state[..., :2], room), axis=-1)
    return replace(fits, log_weight=fits.log_weight - (behind / WALL_SPREAD_M) ** 2 / 2)


@dataclass(frozen=True)
class _Judged:
    """Fits of k hypotheses to n boxes.

    Attributes:
        state: (n, k, 3) x, y and height, m.
        covariance: (n, k, 3, 3) m² of them by least squares.
        surplus: (n, k) factor on that, for what the fit does not explain.
        good: (n, k) whether the hypothesis explains the box.
        log_weight: (n, k) of the hypothesis, given the box.
        shared: (n, k) fraction of their union that the box and the body's share.
    """

    state: np.ndarray
    covariance: np.ndarray
    surplus: np.ndarray
    good: np.ndarray
    log_weight: np.ndarray
    shared: np.ndarray

    def joined(self, others: "_Judged", rows: np.ndarray) -> "_Judged":
        """These hypotheses and others, which were tried on some of the boxes."""
        both = []
        for mine, more in zip(vars(self).values(), vars(others).values(), strict=True):
            wide = np.zeros((len(mine), *more.shape[1:]), mine.dtype)
            wide[rows] = more
            both.append(np.concatenate([mine, wide], axis=1))
        return _Judged(*both)

    def remembering(self, known: np.ndarray, rows: np.ndarray, hypotheses: _Hypotheses) -> "_Judged":
        """Add that some boxes show people of known heights, whose feet may be hidden.

        A known height takes the place of the prior that the fit had. Who is seen whole stays where he or she is, since
        the box tells it; only the weight changes.

        Args:
            known: (m, 2) m, heights and their standard deviations.
            rows: (m,) the boxes.
            hypotheses: those that were fitted first.
        """
        count = len(hypotheses)
        mean, spread = hypotheses.mean, hypotheses.spread
        height, sd = known[:, :1], known[:, 1:]
        likely = np.log(hypotheses.kind_share / spread) - ((height - mean) / spread) ** 2 / 2
        use = (likely >= likely.max(axis=1, keepdims=True)) & (sd < spread)
        precision = np.where(use, 1 / sd**2 - 1 / spread**2, 1.0)  # of a Gaussian, new prior over old prior
        middle = (height / sd**2 - mean / spread**2) / precision
        scale = np.log(spread / sd) - ((middle - height) / sd) ** 2 / 2 + ((middle - mean) / spread) ** 2 / 2
        state, covariance = self.state[rows, :count], self.covariance[rows, :count]
        total = covariance[..., 2, 2] + 1 / precision
        away = middle - state[..., 2]
        gain = np.where(hypotheses.hiding[:, None], covariance[..., 2] / total[..., None], 0.0)
        told = scale - away**2 / total / 2 - np.log(precision * total) / 2
        more = _Judged(
            state + gain * away[..., None],
            covariance - gain[..., :, None] * covariance[..., None, 2, :],
            self.surplus[rows, :count],
            self.good[rows, :count] & use & (away**2 < 16 * total),
            self.log_weight[rows, :count] + told + np.log(REMEMBERED / hypotheses.kind_share),
            self.shared[rows, :count],
        )
        weight = self.log_weight.copy()
        weight[rows] += np.log(1 - REMEMBERED)
        return replace(self, log_weight=weight).joined(more, rows)

    def merged(self, law: BoxLaw) -> Places:
        """The mean over the hypotheses that explain each box, and the covariance of the mixture."""
        explained = self.good.any(axis=1)
        log_weight = np.where(self.good, self.log_weight, -np.inf)
        log_weight -= np.where(explained, log_weight.max(axis=1), 0.0)[:, None]
        weight = np.exp(log_weight)
        weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
        state = np.where(self.good[..., None], self.state, 0.0)
        mean = (weight[..., None] * state).sum(axis=1)
        away = state - mean[:, None]
        spread = self.covariance.copy()
        spread[..., :2, :2] = self.surplus[..., None, None] * spread[..., :2, :2] + law.floor_m**2 * np.eye(2)
        spread = np.where(self.good[..., None, None], spread + away[..., :, None] * away[..., None, :], 0.0)
        spread = (weight[..., None, None] * spread).sum(axis=1)
        heights = np.where(explained, mean[:, 2], np.nan)
        alone = np.column_stack([heights, np.sqrt(spread[:, 2, 2])])
        return Places(mean[:, :2], (spread + spread.mT)[:, :2, :2] / 2, heights, np.asarray(explained), alone)


def _fitted(
    boxes: np.ndarray,
    view: View,
    parts: np.ndarray | None,
    turns: np.ndarray | None,
    unsure: np.ndarray | None,
    law: BoxLaw,
    hypotheses: _Hypotheses,
) -> _Judged:
    each = np.repeat(np.arange(len(boxes)), len(hypotheses))
    known, turned, doubted = (None if item is None else item[each] for item in (parts, turns, unsure))
    fits = _Fits(boxes[each], view, known, turned, doubted, law, hypotheses)
    fits.run()
    judged = (fits.state, *fits.judge())
    return _Judged(*(item.reshape(len(boxes), len(hypotheses), *item.shape[1:]) for item in judged))


class _Fits:
    """Fits of bodies to boxes by Gauss and Newton's method, a row for each box and hypothesis.

    Arrays have the coordinate first and the rows next, since numpy is slow along short last axes.
    """

    def __init__(
        self,
        boxes: np.ndarray,
        view: View,
        parts: np.ndarray | None,
        turns: np.ndarray | None,
        unsure: np.ndarray | None,
        law: BoxLaw,
        hypotheses: _Hypotheses,
    ):
        rows = len(boxes)
        feet = (
            np.full(rows, FEET_HIDDEN) if unsure is None else np.minimum(FEET_HIDDEN + FEET_UNSURE * unsure, FEET_MOST)
        )
        self.unsure = np.zeros(rows) if unsure is None else unsure
        self.view, self.law, self.parts = view, law, parts is not None
        self._rows = np.arange(rows)
        which = self._rows % len(hypotheses)
        kind = hypotheses.kind[which]
        self._across = np.moveaxis(hypotheses.outlines[..., :2] @ view.rotation[:2], -1, 0)[:, kind]
        self._part = hypotheses.outlines[kind, :, 2]
        self.hiding, self.log_share = hypotheses.hiding[which], hypotheses.log_share[which]
        upright = hypotheses.upright[which]
        self.log_share += np.where(upright, np.log(np.where(self.hiding, feet, 1 - feet)), 0.0)
        self.mean, self.height_spread = hypotheses.mean[which], hypotheses.spread[which]
        self.middle = (boxes[:, :2] + boxes[:, 2:]) / 2
        self._turn = None if turns is None or not turns.any() else (np.cos(turns), np.sin(turns))  # picture to box
        if self._turn is None:
            boxes = np.clip(boxes, 0.0, [*view.size, *view.size])
        self.measured = boxes - np.tile(self.middle, 2)
        if parts is not None:
            along = np.stack(self._into_box(*np.moveaxis(parts, -1, 0)), axis=-1)
            self.measured = np.concatenate([self.measured, along.reshape(rows, 6)], axis=1)
        below = view.below
        inward = (
            np.zeros((rows, 2)) if below is None else np.stack(self._turned(*(below + 0.5 - self.middle).T), axis=1)
        )
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
        self.inward = inward
        inner = np.concatenate([inward < -0.3, inward > 0.3], axis=1)  # sides that face the point below the camera
        self._coverable = self.hiding[:, None] & inner
        marked = np.repeat([False, True, False], 2) & hypotheses.told[which][:, None]
        self._silent = np.where(self.hiding[:, None], ~marked, ~upright[:, None])  # of the parts
        self.valid = np.ones(rows, bool)
        self.state = self._start()
        parts_up = np.tile(PART_HEIGHTS if self.parts else [], (rows, 1))
        self._up = np.concatenate([np.zeros((rows, 4)), parts_up], axis=1)  # parts of the height; of sides, see predict
        self._steps = np.zeros((3, 4, *self._up.shape))
        self._steps[:, 1:3] = _STEP_M * view.rotation[:2].T[..., None, None]

    def _turned(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vectors (..., rows) px of the picture in the axes of their row's box."""
        if self._turn is None:
            return x, y
        cosine, sine = self._turn
        return cosine * x + sine * y, cosine * y - sine * x

    def _into_box(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (..., rows, m) px of the picture in the axes of their row's box."""
        x, y = self._turned((u - self.middle[:, :1]).swapaxes(-1, -2), (v - self.middle[:, 1:]).swapaxes(-1, -2))
        return x.swapaxes(-1, -2), y.swapaxes(-1, -2)

    def _start(self) -> np.ndarray:
        """Where the fits begin (rows, 3): the middle at half the height, or the outer side at the head's."""
        half = (self.measured[:, 2:4] - self.measured[:, :2]) / 2
        with np.errstate(divide="ignore"):
            reach = np.min(half / np.maximum(np.abs(self.inward), 1e-9), axis=1)
        outer = -self.inward * (0.9 * reach)[:, None]
        seed = np.where(self.hiding[:, None], outer, self.measured[:, 4:6] if self.parts else 0.0)
        if self._turn is not None:
            cosine, sine = self._turn
            seed = np.stack([cosine * seed[:, 0] - sine * seed[:, 1], sine * seed[:, 0] + cosine * seed[:, 1]], axis=1)
        height = np.where(self.hiding, 0.9, 0.54) * self.mean
        xy, good = _on_planes(seed + self.middle, self.view, height)
        self.valid &= good
        return np.column_stack([np.where(good[:, None], xy, self.view.origin[:2]), self.mean])

    def _cut(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (..., m) px, moved onto the lit picture."""
        width, height = self.view.size
        u, v = np.minimum(np.maximum(u, 0.0), width), np.minimum(np.maximum(v, 0.0), height)
        if self.view.circle is not None:
            x, y, radius = self.view.circle
            u, v = u - x - 0.5, v - y - 0.5
            beyond = np.maximum(np.hypot(u, v) / radius, 1.0)
            u, v = u / beyond + x + 0.5, v / beyond + y + 0.5
        return u, v

    def _areas(self) -> np.ndarray:
        """Areas (rows,) px² of the boxes of the bodies last predicted, not cut by the picture's border."""
        u, v = self._whole if self._turn is None else self._into_box(*self._whole)
        if self._unseen is not None:
            low, high = (np.where(self._unseen, end, [u, v]) for end in (np.inf, -np.inf))
        else:
            low = high = np.stack([u, v])
        span = high.max(axis=2) - low.min(axis=2)
        return np.where(np.isfinite(span), span, 0.0).prod(axis=0)

    def predict(self) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (rows, 4), and parts where they are known (6 more), of the bodies as the picture cuts them; Jacobians.

        The Jacobians (3, rows, 4 or 10) of sides and parts are those of the points that make the sides.
        """
        view, image = self.view, self.view.lens.image
        axis = ((self.state[:, :2] - view.origin[:2]) @ view.rotation[:2] - view.origin[2] * view.rotation[2]).T
        up = view.rotation[2][:, None, None]
        height = self.state[:, 2:]
        body = self._across + axis[..., None] + up * (height * self._part)
        u, v = image(*body)
        self._whole = u, v = u + 0.5, v + 0.5
        unseen = np.isnan(u)
        self._unseen = unseen if unseen.any() else None
        u, v = self._cut(u, v)
        if self._turn is not None:
            u, v = self._into_box(u, v)
        ends = np.stack([u, v, -u, -v])
        if self._unseen is not None:
            self.valid &= ~unseen.all(axis=1)
            ends[:, unseen] = np.inf
        corner = ends.argmin(axis=2).T  # x0, y0, x1, y1
        rows = self._rows[:, None]
        self._up[:, :4] = self._part[rows, corner]
        self._steps[:, 3] = _STEP_M * up * self._up
        points = np.empty((3, *self._up.shape))
        points[..., :4] = body[:, rows, corner]
        points[..., 4:] = axis[..., None] + up * (height * self._up[:, 4:])
        u, v = image(*(points[:, None] + self._steps))
        u, v = u + 0.5, v + 0.5
        u[..., :4], v[..., :4] = self._cut(u[..., :4], v[..., :4])
        u, v = self._into_box(u, v)
        values = np.empty((4, *self.measured.shape))
        values[..., 0:4:2], values[..., 1:4:2] = u[..., 0:4:2], v[..., 1:4:2]
        values[..., 4::2], values[..., 5::2] = u[..., 4:], v[..., 4:]
        return values[0], (values[1:] - values[0]) / _STEP_M

    def _measure(self, extent: np.ndarray) -> None:
        """Set the standard deviations (rows, 4 or 10) px of what was measured, of bodies with boxes of these sizes.

        Of whom is half hidden, the network takes torso and foot from the half that it sees: they tell nothing.
        """
        self.spread = np.repeat((self.law.side * extent + 1.0)[:, None], self.measured.shape[1], axis=1)
        if self.parts:
            doubted = 1 + self.law.part_unsure * np.multiply.outer(self.unsure, PART_UNSURE)
            self.spread[:, 4:] *= np.repeat(self.law.part * PART_SPREADS * doubted, 2, axis=1)
        self._usual = self.spread.copy()
        if self.parts:
            self._usual[:, 4:][self._silent] = np.inf

    def run(self) -> None:
        """Fit x, y and height of every row."""
        predicted, jacobian = self.predict()
        extent = np.sqrt(np.maximum(self._areas(), 1.0))
        self._measure(extent)
        prior = self.height_spread**-2.0
        legs, precision = self._legs(extent), self.law.short_spread**-2.0
        short = np.full(len(self.state), float(self.law.short))  # the fourth unknown, eliminated from the equations
        for step_number in range(_MOST_STEPS):
            if step_number:
                predicted, jacobian = self.predict()
            predicted = predicted - short[:, None] * legs
            error, slope = self.measured - predicted, -legs
            told = np.isfinite(predicted) & np.isfinite(jacobian).all(axis=0)
            if not told.all():
                jacobian, error, slope = (np.where(told, item, 0.0) for item in (jacobian, error, slope))
            doubt, covered = self._doubt(predicted, error)
            weights = 1.0 / np.maximum(np.abs(error / doubt) / 2.0, 1.0) / doubt**2  # Huber: an arm moves one side only
            columns = np.stack([*jacobian, error, slope], axis=1)
            products = (columns * weights[:, None]) @ columns.mT
            off = self.law.short - short
            own, own_pull = precision + products[:, 4, 4], precision * off + products[:, 4, 3]
            cross, share = products[:, :3, 4], products[:, :3, 4] / own[:, None]
            information = products[:, :3, :3] - share[:, :, None] * cross[:, None, :]  # Schur complement
            information += np.eye(3)
            information[:, 2, 2] += prior
            pull = products[:, :3, 3] - share * own_pull[:, None]
            pull[:, 2] += prior * (self.mean - self.state[:, 2])
            step = np.linalg.solve(information, pull[..., None])[..., 0]
            longest = np.abs(step).max(axis=1)
            step *= np.minimum(1.0, _LONGEST_M / np.maximum(longest, 1e-12))[:, None]
            self.state = self.state + step
            short += (own_pull - (cross * step).sum(axis=1)) / own
            if longest[self.valid].max(initial=0.0) < 2e-3:
                break
        self.predicted, self.area, self.error, self.doubt = predicted, self._areas(), error, doubt
        self.covered, self.told, self.weights, self.information = covered, told, weights, information
        self.surprise = precision * off**2 + np.log(own / precision)

    def _legs(self, extent: np.ndarray) -> np.ndarray:
        """How far (rows, 4 or 10) px sides and points are moved, were all of a box legs that the network overlooks.

        The legs are at the side that faces the point below the camera; the middle of the torso moves half as far.
        """
        if not self.parts:
            return np.zeros_like(self.measured)
        legs = self.inward * extent[:, None]
        return np.concatenate(
            [np.minimum(legs, 0.0), np.maximum(legs, 0.0), legs / 2, np.zeros_like(legs), legs], axis=1
        )

    def _doubt(self, predicted: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations of what was measured, and the sides (rows, 4) of bodies that something hides."""
        doubt = self._usual.copy()
        covered = self._coverable & (error[:, :4] * _INWARD > 0)
        if covered.any():
            length = np.tile(predicted[:, 2:4] - predicted[:, :2], (1, 2))
            doubt[:, :4] = np.where(covered, np.maximum(np.maximum(length, 1.0), doubt[:, :4]), doubt[:, :4])
        return doubt, covered

    def judge(self) -> tuple[np.ndarray, ...]:
        """All of _Judged but the states, by rows."""
        height = self.state[:, 2]
        good = self.valid & np.isfinite(self.state).all(axis=1)
        good &= np.abs(height - self.mean) < 3.5 * self.height_spread
        box = self.measured[:, :4]
        shown = np.where(self.covered, box, self.predicted[:, :4])
        least = np.full(len(good), SHARED)
        size = np.maximum(box[:, 2:] - box[:, :2], 0.0).prod(axis=1)
        if self.parts:  # a sitting person fills another box, but the parts fit
            off = np.sqrt(np.mean(self.error[:, 4:] ** 2, axis=1))
            least[(off < 0.1 * np.sqrt(size)) & ~self.hiding] = 0.4
        shared = _shared(shown, box)
        good &= (shared >= least) & (size >= 0.1 * self.area)  # a foot at the border says too little
        cost = (self.weights * self.error**2).sum(axis=1)
        told = (self.told & np.isfinite(self.doubt)).sum(axis=1)
        surplus = np.maximum(cost / np.maximum(told - 3, 1), 1.0)  # Birge (1932)
        inverse = np.linalg.inv(self.information)
        cost = cost + ((height - self.mean) / self.height_spread) ** 2 + 2 * np.log(self.height_spread)
        silent = np.isinf(self.doubt)  # tells nothing of the body: as likely as with any other
        cost = cost + (2 * np.log(np.where(silent, self.spread, self.doubt)) + silent).sum(axis=1) + self.surprise
        log_weight = self.log_share - cost / 2 + np.linalg.slogdet(inverse)[1] / 2
        return inverse, self.law.spread * surplus, good, log_weight, shared


def _shared(box: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The fraction (n,) of their union that boxes (n, 4) share."""
    shared = np.maximum(np.minimum(box[:, 2:], other[:, 2:]) - np.maximum(box[:, :2], other[:, :2]), 0).prod(axis=1)
    areas = (box[:, 2:] - box[:, :2]).prod(axis=1) + (other[:, 2:] - other[:, :2]).prod(axis=1)
    return shared / np.maximum(areas - shared, 1e-9)


def _on_planes(pixels: np.ndarray, view: View, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) m (n, 2) where the rays of corner-based pixels (n, 2) meet heights (n,); and whether (n,) they do."""
    rays = view.unproject(pixels - 0.5)
    fall = heights - view.origin[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = fall / rays[:, 2]
        good = (away > 0) & (np.abs(rays[:, 2]) > 1e-3)
        return view.origin[:2] + rays[:, :2] * away[:, None], good


def _on_rays(box: np.ndarray, turn: float, view: View, room: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (2,) m and covariance (2, 2) m² of somebody of whom a box shows what no body explains.

    What it shows may be at any height up to the top of a head, and is as large as a part of a person.
    """
    cosine, sine = np.cos(turn), np.sin(turn)
    extent = box[2:] - box[:2]
    away = (np.concatenate([_WITHIN, [[0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]]]) - 0.5) * extent
    pixels = (box[:2] + box[2:]) / 2 + away @ np.array([[cosine, sine], [-sine, cosine]])
    pixels = np.clip(pixels, 0.5, np.array(view.size) - 0.5)
    level, point = (item.ravel() for item in np.meshgrid(_LEVELS, np.arange(len(_WITHIN)), indexing="ij"))
    xy, good = _on_planes(pixels[point], view, level)
    rays = view.unproject(pixels - 0.5)
    good &= np.isfinite(xy).all(axis=1)
    if not good.any():
        return np.full(2, np.nan), np.full((2, 2), np.nan)
    ends = rays[len(_WITHIN) :]
    angles = np.arccos(np.clip([ends[0] @ ends[1], ends[2] @ ends[3]], -1, 1))
    angle = float(np.nanmax(angles)) if np.isfinite(angles).any() else 0.1
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.abs((level - view.origin[2]) / rays[point, 2]) * max(angle, 1e-6)
        beyond = np.maximum(np.log(_EXTENT_M[0] / size), 0.0) + np.maximum(np.log(size / _EXTENT_M[1]), 0.0)
    log_weight = np.where(good, -0.5 * (beyond / _EXTENT_SPREAD) ** 2, -np.inf)
    if room is not None:
        log_weight -= np.where(good, (np.linalg.norm(_behind(xy, room), axis=1) / WALL_SPREAD_M) ** 2 / 2, 0.0)
    weight = np.where(good, np.exp(log_weight - log_weight[good].max()), 0.0)
    weight /= weight.sum()
    xy = np.where(good[:, None], xy, 0.0)
    mean = weight @ xy
    spread = (xy - mean).T @ (weight[:, None] * (xy - mean)) + 0.2**2 * np.eye(2)
    return mean, (spread + spread.T) / 2
