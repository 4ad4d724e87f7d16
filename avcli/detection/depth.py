"""People in a depth picture: everything nearer than the empty room, separated in a plan view of the room.

People who touch or hide each other in the picture still stand apart on the floor.

Source: M. Harville, "Stereo person tracking with adaptive plan-view templates of height and occupancy statistics",
Image and Vision Computing 22 (2004).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from avcli.detection.body import FLOOR_M, MID_BODY_M, Person, Surface, boxes_of, locate
from avcli.detection.fitted import SCORE, FaintLaw
from avcli.detection.heights import Heights
from avcli.detection.monocular import HEIGHT_M, Fitted, Places
from avcli.detection.network import Boxes
from avcli.detection.view import View

MARGIN_M = 0.08
"""m by which a surface must be nearer than the background; more than a sensor's noise, less than a limb."""

CAME_M = 0.2
"""m by which a surface is nearer than what the film has shown there before, if it has come during the film."""

CAME = 0.5
"""Least share of a body's surface that has come, of somebody who has come."""

TALLEST_M = 2.3
"""m; higher points do not belong to a person."""

LOW_M = 1.0
"""m; lower things with free space above them are furniture."""

LEAST_SURFACE_M2 = 0.02
"""m²; least visible surface of a body."""

CELL_M = 0.05
SPREAD_M = 0.08
"""m; standard deviation of the smoothing of the plan view: a head."""

APART_M = 0.30
"""m; the least distance of two people's axes."""

SHOULDER_M, REACH_M = 1.4, 0.45
"""m; a part lower than a shoulder, less than half as large as a body, and nearer to it than an elbow is a limb."""

Z_VARIANCE_M2 = 0.5**2
"""m²; z of a position may be any point of the body's axis: the variance over a standing adult."""


@dataclass(frozen=True)
class _Body:
    """One person's part of a depth picture: samples (rows, columns), points (n, 3) m and their surface (n,) m²."""

    rows: np.ndarray
    columns: np.ndarray
    points: np.ndarray
    surface: np.ndarray


class DepthDetector:
    """Finds people as what stands nearer than the empty room, or measures the positions of a network's people.

    Args:
        view: the camera.
        background: (h, w) m, radial depth of the empty room at the view's samples, 0: unknown. None if it was not
            recorded; then only `place` can be used.
        room: (2,) m, size of the room; None if it is not known.
    """

    def __init__(self, view: View, background: np.ndarray | None, room: np.ndarray | None = None):
        self.heights = Heights()
        self._lie = False  # whether the last picture had a box that suits nobody upright
        self.view, self.room = view, room
        self.limit = None
        if background is not None:
            self._before = self._shown = np.zeros(background.shape, np.float32)
            self.limit = np.where(background > 0, background - np.float32(MARGIN_M), np.float32(np.inf))

    def detect(self, depth: np.ndarray) -> list[Person]:
        """Find the people in a depth picture (h, w), m radial at the view's samples; 0: unknown.

        Raises:
            ValueError: the detector has no background.
        """
        if self.limit is None:
            raise ValueError("people can be found in depth only with the depth picture of the empty room")
        return self._standing(depth, (depth > 0) & (depth < self.limit))

    def missed(
        self,
        depth: np.ndarray,
        found: Boxes,
        people: list[Person],
        law: FaintLaw | None,
        motion: Callable[[Person], float] = lambda _: 0.0,
    ) -> list[Person]:
        """Find the people of a film's next picture whom the network by itself has missed.

        Somebody who stands where earlier pictures showed what is farther away has come, as furniture does not. Others
        may be furniture that was brought in since the empty room was recorded: the network's faint boxes tell, and
        whether they move.

        Args:
            depth: (h, w) m radial at the view's samples, 0: unknown.
            found: what the network says of the picture, faint or not.
            people: who was found in it already.
            law: how probable people are by faint boxes; None: another network's tell nothing.
            motion: what the motion of a body tells, nats.

        Returns:
            Those who came, with the score that a body before the empty room has, and the others, with that of the law.

        Raises:
            ValueError: the detector has no background.
        """
        came, stayed, scores, others = self.strangers(depth, found, people)
        if law is None:
            return came
        faint = law.probability(scores, others, np.array([motion(one) for one in stayed]))
        return came + [replace(one, score=float(score)) for one, score in zip(stayed, faint, strict=True)]

    def strangers(
        self, depth: np.ndarray, found: Boxes, people: list[Person]
    ) -> tuple[list[Person], list[Person], np.ndarray, np.ndarray]:
        """Who came, and who may have been there before; the arguments are those of `missed`.

        Returns:
            those who came; the n others; and what a FaintLaw asks of these: (n,) the network's largest score there, 0
            where it says nothing, and (n,) bool, whether others stand of whom it says nothing.
        """
        if self.limit is None:
            raise ValueError("whom the network has missed can be found only with the depth picture of the empty room")
        near = (depth > 0) & (depth < self.limit)
        nearer = near & (depth < self._shown - CAME_M)
        self._shown = np.maximum(self._shown, np.minimum(depth, self._before))  # a sensor's flicker is not there twice
        self._before = depth
        for left, top, right, bottom in self._sample_boxes(boxes_of(people)):
            near[top:bottom, left:right] = False
        came, stayed = list[Person](), list[Person]()
        for stranger in self._standing(depth, near) if near.any() else ():
            if all(np.linalg.norm(stranger.position[:2] - one.position[:2]) > REACH_M for one in people):
                (came if self._share(stranger, nearer) >= CAME else stayed).append(stranger)
        scores = np.array([self._scores(one, found).max(initial=0.0) for one in stayed])
        unknown = scores == 0
        return came, stayed, scores, unknown.sum() > unknown

    def _share(self, person: Person, mask: np.ndarray) -> float:
        """The share of a body's surface that is in a mask (h, w) of samples."""
        surface = person.surface
        assert surface is not None  # depth has found it
        columns, rows = self.view.sample_indices(np.column_stack([surface.columns, surface.rows])).T
        return float(surface.areas[mask[rows, columns]].sum() / surface.areas.sum())

    def _scores(self, person: Person, found: Boxes) -> np.ndarray:
        """The network's scores (m,) of the boxes that hold at least half of a body."""
        surface = person.surface
        assert surface is not None  # depth has found it
        x, y = surface.columns[:, None], surface.rows[:, None]
        x0, y0, x1, y1 = found.boxes.T
        inside = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
        return found.scores[surface.areas @ inside >= 0.5 * surface.areas.sum()]

    def _standing(self, depth: np.ndarray, mask: np.ndarray) -> list[Person]:
        """The bodies in the samples of a mask (h, w), without small ones and low furniture."""
        people = []
        for body in self._bodies(depth, mask):
            surface = body.surface.sum()
            if surface < LEAST_SURFACE_M2:
                continue
            person = self._person(body, depth, float(surface / (surface + SCORE.surface_m2)))
            if person and not (body.points[:, 2].max() < LOW_M and self._free_above(person, depth)):
                people.append(person)
        return people

    def place(self, found: Boxes, depth: np.ndarray | None, time: float | None = None) -> list[Person]:
        """Measure the positions of the people that a network has found.

        Each box takes the body in it that is nearest to the position by the box alone. A box without a body is dropped
        if its depth shows the empty room, and placed by the box alone if its depth is unknown.

        Args:
            found: the network's people, px of the full picture.
            depth: (h, w) m radial at the view's samples, 0: unknown; None without a depth picture.
            time: of the picture, s, so that heights seen before help where there is no depth; None: unknown.
        """
        if not len(found):
            return []

        @cache
        def by_boxes() -> Places:
            boxes, turns = found.boxes, None
            if found.turned is not None:
                middle, half, turns = found.turned[:, :2], found.turned[:, 2:4] / 2, found.turned[:, 4]
                boxes = np.concatenate([middle - half, middle + half], axis=1)
            bodies = Fitted(boxes, self.view, found.parts, turns, self.room, scores=found.scores, lie=self._lie)
            self._lie = bodies.lie
            if depth is not None or time is None:
                return bodies.places()
            return self.heights.place(found.boxes, time, bodies.places)

        bodies, empty = [], np.zeros(len(found), bool)
        if depth is not None:
            inside = np.zeros((len(found), *depth.shape), bool)
            for index, (left, top, right, bottom) in enumerate(self._sample_boxes(found.boxes)):
                inside[index, top:bottom, left:right] = True
            near = (depth > 0) & np.isfinite(depth)
            if self.limit is not None:
                empty = np.array([near[box].mean() > 0.5 if box.any() else False for box in inside])
                near &= depth < self.limit
            bodies = [
                body for body in self._bodies(depth, near & inside.any(axis=0)) if body.surface.sum() > LEAST_SURFACE_M2
            ]
        people, free = [], list(range(len(bodies)))
        for index in range(len(found)):
            chosen = self._choose([bodies[k] for k in free], inside[index], by_boxes, index) if bodies else None
            person = None
            if chosen is not None and depth is not None:
                body = bodies[free.pop(chosen)]
                person = self._person(body, depth, float(found.scores[index]))
            elif not empty[index] and by_boxes().seen[index]:
                person = _person_by_box(by_boxes(), index, float(found.scores[index]))
            if person is not None:
                box = np.clip(found.boxes[index], 0, [*self.view.size, *self.view.size])
                turned = None if found.turned is None else found.turned[index] * [1, 1, 1, 1, 180 / np.pi]
                people.append(replace(person, bbox_px=box, turned_px=turned))
        return people

    def _bodies(self, depth: np.ndarray, mask: np.ndarray) -> list[_Body]:
        rows, columns = np.nonzero(mask & (self.view.solid_angles > 0))
        near = depth[rows, columns].astype(float)
        points = self.view.origin + near[:, None] * self.view.rays[rows, columns]
        surface = near**2 * self.view.solid_angles[rows, columns]
        keep = (points[:, 2] > (0.1 if self.limit is not None else FLOOR_M)) & (points[:, 2] < TALLEST_M)
        rows, columns, points, surface = rows[keep], columns[keep], points[keep], surface[keep]
        return [
            _Body(rows[member], columns[member], points[member], surface[member])
            for member in separate(points, surface)
        ]

    def _choose(self, bodies: list[_Body], inside: np.ndarray, by_boxes: Callable[[], Places], box: int) -> int | None:
        """Index of the body that a box most likely means, of those that are mostly inside it; None if there is none."""
        amounts = {}
        for index, body in enumerate(bodies):
            amount = body.surface[inside[body.rows, body.columns]].sum()
            if amount > 0 and amount >= 0.5 * body.surface.sum():
                amounts[index] = amount
        if len(amounts) > 1 and by_boxes().explained[box]:
            for index in amounts:
                middle = np.average(bodies[index].points[:, :2], axis=0, weights=bodies[index].surface)
                away = middle - by_boxes().positions[box]
                amounts[index] *= np.exp(-0.5 * (away @ away) / 0.4**2)
        return max(amounts, key=lambda index: amounts[index]) if amounts else None

    def _free_above(self, person: Person, depth: np.ndarray) -> bool:
        """Whether the camera sees through the space that the upper body of a standing person would fill."""
        heights = np.array([LOW_M, LOW_M + 0.25])
        body = np.column_stack([np.tile(person.position[:2], (2, 1)), heights])
        pixels = self.view.project(body)
        if not self.view.inside(pixels).all():
            return False
        columns, rows = self.view.sample_indices(pixels).T
        return bool((depth[rows, columns] > np.linalg.norm(body - self.view.origin, axis=1)).all())

    def _sample_boxes(self, boxes: np.ndarray) -> np.ndarray:
        height, width = self.view.rays.shape[:2]
        return np.clip(np.rint(boxes / self.view.stride), 0, [width, height, width, height]).astype(int)

    def _person(self, body: _Body, depth: np.ndarray, score: float) -> Person | None:
        found = locate(body.points, body.surface, self.view, depth)
        if found is None:
            return None
        centre, covariance, fraction = found
        box = np.array([body.columns.min(), body.rows.min(), body.columns.max() + 1, body.rows.max() + 1])
        return Person(
            position=np.array([*centre, MID_BODY_M]),
            covariance=_with_height(covariance),
            score=score,
            bbox_px=np.minimum(box * float(self.view.stride), [*self.view.size, *self.view.size]),
            height=self._height(body, centre),
            method="depth",
            visible=fraction,
            surface=Surface(
                *self.view.sample_pixels(body.rows, body.columns), heights=body.points[:, 2], areas=body.surface
            ),
        )

    def _height(self, body: _Body, centre: np.ndarray) -> float | None:
        """Height, m, of the highest point; None if the border of the picture cuts the head off."""
        top = float(body.points[:, 2].max())
        above = self.view.project(np.array([[*centre, top + 0.05]]))
        return top if self.view.inside(above)[0] else None


def place_centre(found: Boxes, depth: np.ndarray, view: View) -> list[Person]:
    """Place people as the thesis does: at the surface that the middle pixel of each box shows.

    Args:
        found: the network's people, px of the full picture.
        depth: (h, w) m radial at the view's samples, 0: unknown; a person whose middle pixel is unknown is dropped.
        view: the camera.
    """
    middles = found.boxes.reshape(-1, 2, 2).mean(axis=1) - 0.5
    rays = view.unproject(middles)
    people = []
    for index in np.flatnonzero(view.inside(middles) & np.isfinite(rays).all(axis=1)):
        column, row = view.sample_indices(middles[index])
        if depth[row, column] > 0:
            people.append(
                Person(
                    position=view.origin + float(depth[row, column]) * rays[index],
                    covariance=_with_height(0.2**2 * np.eye(2)),
                    score=float(found.scores[index]),
                    bbox_px=np.clip(found.boxes[index], 0, [*view.size, *view.size]),
                    height=None,
                    method="depth",
                )
            )
    return people


def _person_by_box(places: Places, index: int, score: float) -> Person:
    explained = bool(places.explained[index])
    height = float(places.heights[index]) if explained else None
    return Person(
        position=np.array([*places.positions[index], MID_BODY_M / HEIGHT_M * (height or HEIGHT_M)]),
        covariance=_with_height(places.covariances[index]),
        score=score,
        bbox_px=np.zeros(4),
        height=height,
        method="monocular",
        explained=explained,
    )


def _with_height(covariance: np.ndarray) -> np.ndarray:
    full = np.diag([0.0, 0.0, Z_VARIANCE_M2])
    full[:2, :2] = covariance
    return full


def separate(points: np.ndarray, surface: np.ndarray) -> list[np.ndarray]:
    """Separate points on people's bodies into persons by their plan view.

    Args:
        points: (n, 3) m in the room.
        surface: (n,) m² of surface that each point stands for.

    Returns:
        For each person the indices of its points, ordered by the person's x.
    """
    import cv2

    if not len(points):
        return []
    weights = surface * np.interp(points[:, 2], [0.3, 0.8, 1.25, 1.45], [0.1, 1.0, 1.0, 4.0])  # heads stand apart
    corner = points[:, :2].min(axis=0) - 3 * SPREAD_M
    cells = ((points[:, :2] - corner) / CELL_M).astype(int)
    shape = tuple(cells.max(axis=0) + 1 + int(3 * SPREAD_M / CELL_M))
    plan = np.bincount(cells[:, 0] * shape[1] + cells[:, 1], weights, minlength=shape[0] * shape[1]).reshape(shape)
    plan = cv2.GaussianBlur(plan, (0, 0), SPREAD_M / CELL_M, borderType=cv2.BORDER_CONSTANT)
    window = 2 * int(APART_M / 2 / CELL_M) + 1
    peaks = np.argwhere((plan == cv2.dilate(plan, np.ones((window, window), np.uint8))) & (plan > 1e-4))
    peaks = peaks[np.argsort(-plan[tuple(peaks.T)], kind="stable")]
    kept: list[np.ndarray] = []
    for peak in peaks:
        if all(_divided(plan, peak, other) for other in kept):
            kept.append(peak)
    if not kept:
        return []
    centres = np.array(sorted(map(tuple, kept)))
    nearest = ((cells[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2).argmin(axis=1)
    nearest = _with_their_limbs(nearest, centres, points[:, 2], surface)
    return [np.flatnonzero(nearest == index) for index in np.unique(nearest)]


def _with_their_limbs(nearest: np.ndarray, peaks: np.ndarray, heights: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Give low and small parts that stand apart (a leg behind, a hand in front) to the body beside them."""
    tops = np.array([heights[nearest == index].max(initial=0.0) for index in range(len(peaks))])
    sizes = np.bincount(nearest, surface, minlength=len(peaks))
    for limb in np.flatnonzero(tops < SHOULDER_M):
        away = np.linalg.norm(peaks - peaks[limb], axis=1) * CELL_M
        body = np.flatnonzero((away < REACH_M) & (sizes > 2 * sizes[limb]))
        if len(body):
            nearest = np.where(nearest == limb, body[away[body].argmin()], nearest)
    return nearest


def _divided(plan: np.ndarray, peak: np.ndarray, other: np.ndarray) -> bool:
    """Whether a valley lies between a peak of the plan view and a higher one."""
    steps = np.linspace(0, 1, 2 * int(np.abs(peak - other).max()) + 2)[:, None]
    between = np.rint(peak + steps * (other - peak)).astype(int)
    distance = np.linalg.norm(peak - other) * CELL_M
    lowest = plan[tuple(between.T)].min()
    return bool(distance >= APART_M and lowest < 0.75 * plan[tuple(peak)])
