"""The detector: pictures of a ceiling camera in, people with positions in the room out."""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from avcli.detection.agreement import within
from avcli.detection.background import Background
from avcli.detection.bands import BandedNetwork, suited
from avcli.detection.body import Person, beyond_trust, boxes_of
from avcli.detection.depth import DepthDetector, place_centre
from avcli.detection.fitted import FAINT
from avcli.detection.following import FOLLOWED, Following
from avcli.detection.frozen import Frozen
from avcli.detection.gate import Gate
from avcli.detection.looks import Looks, feature
from avcli.detection.monocular import Fitted
from avcli.detection.mounting import Mounting
from avcli.detection.network import PAD, Boxes, ModelError, Network, own_model
from avcli.detection.settings import Settings
from avcli.detection.stillness import COME, Stillness, after
from avcli.detection.view import View
from avcli.detection.windows import WindowedNetwork
from avcli.formats.experiment import Config
from avcli.formats.media import MediaError, Shot, read_bytes
from avcli.formats.records import Detections
from avcli.formats.sensors import CAMERA

WALL_M = 0.3
"""m; a person found farther than this behind a wall is a reflection, or a wrong box."""

SURE = 3.0
"""Standard deviations by which a position that is hardly known must be farther than that."""

Picture = np.ndarray | Callable[[], np.ndarray]
"""A picture, or a function that reads it when it is needed."""

Timing = Callable[[str], contextlib.AbstractContextManager[Any]]
"""Makes a context manager around a step of the detector, given the step's name."""


def detect(
    config: Config,
    shots: Iterable[Shot],
    *,
    background: Picture | None = None,
    model: str | os.PathLike | None = None,
    **settings: Any,
) -> Iterator[Detections]:
    """Find the people in the pictures of a ceiling camera, one time step after another.

    Args:
        config: the camera, and the room's size if it is known.
        shots: the pictures in order of time; the next one is taken when its detections are asked for.
        background: (height, width) the empty room's depth picture, in steps of the camera's `depth_step_m`, or a
            function that reads it. The depth detector needs it; the network's people are checked against it.
        model: ONNX file of a YOLO export; None: the package's own network.
        settings: fields of `avcli.detection.settings.Settings`: detector="depth", monocular=True and so on.

    Yields:
        The detections of each shot: a point on each person's axis, its covariance, the score, the box, the height,
        and what the person wears (`avcli.detection.looks`).

    Raises:
        MediaError: a shot lacks the picture that the detector needs, or it has another size than config.json says.
        ModelError: `model` is not a person detector in ONNX.
        ValueError: the depth detector has no `background`.

    Something 1.1 m below a camera that looks straight down, where the empty room is 2.5 m away:

    >>> import numpy as np
    >>> from avcli.formats.experiment import Config
    >>> from avcli.formats.media import Shot
    >>> camera = {"lens_model": "kannala_brandt", "fx_px": 60, "fy_px": 60, "cx_px": 79.5, "cy_px": 59.5,
    ...           "image_width_px": 160, "image_height_px": 120, "camera_position_m": [2, 2, 2.5],
    ...           "camera_rotation_deg": [90, 0, 0], "depth_step_m": 0.001}
    >>> empty = np.full((120, 160), 2500, np.uint16)
    >>> depth = empty.copy()
    >>> depth[50:66, 90:106] = 1100
    >>> shot = Shot(0.0, None, depth)
    >>> found, = detect(Config({"camera_config": camera}), [shot], background=empty, detector="depth")
    >>> found.sensor, found.kind, found.positions.round(1).tolist()
    ('video', 'camera', [[2.3, 2.1, 0.9]])
    """
    detector = Detector(config, background=background, model=model, settings=Settings(**settings))
    for shot in shots:
        yield detections(shot.timestamp, detector.look(shot.rgb, shot.depth, shot.timestamp), detector.settings.sensor)


_NONE = np.full(5, np.nan)


def detections(timestamp: float, people: list[Person], sensor: str = Settings.sensor) -> Detections:
    """Collect the people found at one time, s, as detections of a named sensor."""
    return Detections(
        timestamp=timestamp,
        sensor=sensor,
        positions=np.array([person.position for person in people]).reshape(-1, 3),
        covariances=np.array([person.covariance for person in people]).reshape(-1, 3, 3),
        scores=np.array([person.score for person in people]),
        kind=CAMERA,
        boxes_px=boxes_of(people).round(2),
        heights=np.array([np.nan if person.height is None else person.height for person in people]),
        features=feature(people),
        turned_px=np.array([_NONE if person.turned_px is None else person.turned_px for person in people])
        .reshape(-1, 5)
        .round(2),
        explained=np.array([np.nan if person.explained else 0.0 for person in people]),
    )


@dataclass
class Tally:
    """What became of the boxes that a network found.

    Attributes:
        by_box: placed by the box alone, without depth.
        unexplained: of these, boxes that no body explains, whose place is hardly known.
        nowhere: without a place: none of their rays reaches the room.
        outside: of people beyond the walls, who were left out.
        still: that show only the room as it was learnt, and were left out.
        followed: with a low score, of people who were found at the same place a moment before.
        came: with a low score, of people who came since the film began, and move.
        held_back: that would have been people, but keep too still.
        pictures, unchanged: pictures so far, and those of them in which nothing had moved.
        boxes: (4,) px, the first `MOST_BOXES` of those that were placed by the box alone.
    """

    by_box: int = 0
    unexplained: int = 0
    nowhere: int = 0
    outside: int = 0
    still: int = 0
    followed: int = 0
    came: int = 0
    held_back: int = 0
    pictures: int = 0
    unchanged: int = 0
    boxes: list[np.ndarray] = field(default_factory=list)


def _apart(boxes: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Which (n,) boxes (n, 4), the best first, are people by themselves: sure (n,), or not mostly in a better box."""
    apart, shares = np.ones(len(boxes), bool), within(boxes)
    for k in np.flatnonzero(~sure):
        apart[k] = not (shares[k, :k][apart[:k]] >= PART).any()
    return apart


def _motion(body: Person, people: list[Person], watched: Stillness) -> float:
    """What its motion tells of a body, nats; nothing where people who were found may be what moves there."""
    box, surface = body.bbox_px, body.surface
    assert surface is not None  # depth has found it
    others = boxes_of(people)
    shared = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    if (np.maximum(shared, 0.0).prod(axis=1) >= COVERED * (box[2:] - box[:2]).prod()).any():
        return 0.0
    return watched.motion(box, surface.columns, surface.rows)


PART = 0.5
"""Share of a faint box that lies in a better one, from which it shows a part of the same person."""

COVERED = 0.3
"""Share of a body's box in that of somebody who was found, from which it is unknown who moves there."""

STILL = 0.1
"""A box of which less differs from the room as it was learnt shows the room."""

HEIGHTS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4)
"""Heights at which a camera is tried, as parts of the stated one."""

CONFIDENCE, CONFIDENCE_BEFORE_ROOM = 0.5, 0.3
"""Least scores of a person: by the picture alone, and where the empty room's depth refuses boxes that show no more."""

FAINTEST, MISSED = 0.02, 0.7
"""Least score of the network's boxes that tell something of a body before the empty room, and least score of a person
whom the network by itself has missed. Chosen on random worlds (seeds 7000 to 7059): in a room as it was recorded hardly
anybody has a score between .5 and .7; where furniture came in since, half of those that have are furniture."""

FAINTEST_IN_FILMS = 1 / (1 + (1 / FOLLOWED - 1) * float(np.exp(COME)))
"""Least score of the network's boxes of which a film may still make people."""

MOST_BOXES = 200
"""Boxes from which the height of a camera is judged."""


class Detector:
    """Finds the people in a ceiling camera's pictures, which must come in order of time.

    Args:
        config: the camera, and the room's size if it is known: people found outside the walls are dropped.
        background: the empty room's depth picture, see `detect`.
        room_picture: (height, width, 3) uint8, the empty room in colour, with which the setting `learn_background`
            begins; None: it begins with the first pictures.
        model: ONNX file of a YOLO export; None: the package's own network.
        settings: how people are found and placed; None: the defaults.
        timing: is called with the name of each step and gives a context manager around it, to measure its time.

    Attributes:
        view: the camera in the room.
        network: the network, None for the depth detector.
        windows: the network in windows, None where it looks at the whole picture.
        sight: what looks at the pictures: the network, or its windows or bands; None for the depth detector, and before
            the first picture.
        tally: what became of the network's boxes so far.
        shown_m: heights above the floor, m, below which the half and a tenth lie of what the first depth picture shows.

    Raises:
        MediaError: `model` cannot be read.
        ModelError: it is not a person detector in ONNX.
        ValueError: the depth detector has no `background`.
    """

    def __init__(
        self,
        config: Config,
        *,
        background: Picture | None = None,
        room_picture: np.ndarray | None = None,
        model: str | os.PathLike | None = None,
        settings: Settings | None = None,
        timing: Timing = contextlib.nullcontext,
    ):
        self.settings = settings or Settings()
        camera = config.camera_of(self.settings.sensor) or config.camera
        self._camera, self._name, self._timing = camera, config.name, timing
        self._size = self._camera.width_px, self._camera.height_px
        self._background = background
        self.view = View(
            camera.lens,
            camera.T_room_camera,
            self._size,
            camera.theta_max,
            theta_trusted=camera.theta_trusted,
            circle=camera.circle,
        )
        chosen = self.settings
        self._before = background is not None and not chosen.monocular and chosen.position == "body"
        self._faint = FAINT if self._before and model is None and not chosen.learn_background else None
        self._least = self._least_score(model is None)
        self._following = Following() if chosen.confidence is None and not self._before else None
        self.network = self._network(model) if chosen.detector == "net" else None
        self.windows = self._windows(self.network) if self.network and self.settings.windows else None
        self.sight: Network | WindowedNetwork | BandedNetwork | None = self.windows
        if self.network is None and background is None:
            raise ValueError('the detector "depth" needs the depth picture of the empty room')
        self._gate, self._last = Gate(self.settings.refresh), list[Person]()
        self._stillness = Stillness() if self.settings.stillness else None
        self.shown_m: tuple[float, float] | None = None
        self._strangers = False  # bodies stand before the empty room of whom the network is not sure
        described = self.settings.detector == "net" if self.settings.features is None else self.settings.features
        self._looks = Looks(self.view) if described else None
        self.tally = Tally()
        self.frozen, self.mounting = Frozen(), Mounting()
        self._room_colours = Background(room_picture) if self.settings.learn_background else None
        known = config.states("room_config", "room_dimensions_m")
        self._room = np.asarray(config.room.dimensions[:2], float) if known else None

    def look(self, rgb: Picture | None, depth: Picture | None = None, time: float | None = None) -> list[Person]:
        """Find the people in the next pictures.

        Args:
            rgb: (height, width, 3) uint8, which the network needs; or a function that reads it.
            depth: (height, width) uint16 in steps of the camera's `depth_step_m`; or a function that reads it. The
                depth detector needs it. The network can do without, and asks for it where it finds somebody.
            With the setting `features` the depth detector needs the colour picture too.
            time: of the pictures, s; None: unknown, then who keeps still is not doubted.

        Raises:
            MediaError: the picture is missing, cannot be read, or has another size than config.json says.
        """
        if self.network is None:
            with self._timing("wait for pictures"):
                picture = self._read(depth, "depth")
            if time is not None:
                self.frozen.see(picture, time)
            with self._timing("depth and positions"):
                standing = self._before_room.detect(self._measured(picture))
                people = [beyond_trust(one, self.view) for one in standing if self._in_room(one)]
            return people if self._looks is None else self._described(self._read(rgb, "colour"), people)
        with self._timing("wait for pictures"):
            picture = self._read(rgb, "colour")
        if time is not None:
            self.frozen.see(picture, time)
            self.mounting.see(picture, time)
        regions = self._gate.changes(picture)
        self.tally.pictures += 1
        self.tally.unchanged += not len(regions)
        if self._room_colours is not None:
            self._room_colours.see(picture)
        doubts = self._by_colour(depth)
        watched = self._stillness if time is not None and (doubts or self._strangers) else None
        if len(regions):
            with self._timing("network"):
                shown = self.view.lit(picture, PAD)
                everything = self._lit(self._looking(self.network, shown).detect(shown, regions))
            told = moves = np.zeros(len(everything))
            if watched and time is not None:
                with self._timing("stillness"):
                    watched.see(picture, time, everything.boxes[everything.scores >= min(self._least, FOLLOWED)])
                    if doubts:
                        told, moves = watched.told(everything.boxes, self._matters(everything)).T
            found = self._moving(everything.take(self._found(everything, told, moves, time if doubts else None)))
            with self._timing("depth and positions"):
                placed = self._place(found, everything, depth, time)
                people = self._counted([beyond_trust(person, self.view) for person in placed], len(found))
            self._last = self._described(picture, people)
        elif time is not None:
            if self._following:
                self._following.unchanged(time)
            if watched:
                watched.see(picture, time, boxes_of(self._last))
        return self._doubted(self._last, watched) if watched and doubts else self._last

    def _by_colour(self, depth: Picture | None) -> bool:
        """Whether the colour picture alone tells who is there: no depth says what stands before the empty room."""
        return depth is None or self.settings.monocular or self._background is None

    def _matters(self, found: Boxes) -> np.ndarray:
        """Which (n,) of the network's people are found, or followed, unless they keep still."""
        sure = found.scores >= self._least
        return sure if self._following is None else sure | self._following.near(found.boxes)

    def _found(self, found: Boxes, told: np.ndarray, moves: np.ndarray, time: float | None) -> np.ndarray:
        """Which (n,) of the network's people are found: by their score, for having come, or followed; but not still.

        Args:
            found: all that the network says.
            told: (n,) nats, what the film says of each.
            moves: (n,) nats, what its motion says where somebody was found a moment before.
            time: of the picture, s; None: unknown, or no colour picture alone tells who is there.
        """
        sure = found.scores >= self._least
        if self._following is None or time is None:
            people = sure
        else:
            raised = after(found.scores, np.maximum(told, 0.0))
            order = np.argsort(-raised, kind="stable")
            order = order[_apart(found.boxes[order], sure[order])]
            people = np.zeros(len(found), bool)
            moving = after(found.scores, moves)[order]
            people[order] = self._following.found(found.boxes[order], raised[order], self._least, time, moving)
            self.tally.followed += int((people & (raised < self._least)).sum())
            self.tally.came += int((people & ~sure & (raised >= self._least)).sum())
        believed = after(found.scores, told) >= np.minimum(found.scores, self._least)
        self.tally.held_back += int((people & ~believed).sum())
        return people & believed

    def _doubted(self, people: list[Person], stillness: Stillness) -> list[Person]:
        """The people with the scores that their stillness leaves them."""
        scores = np.array([person.score for person in people])
        left = after(scores, stillness.evidence(boxes_of(people)))
        return [
            replace(person, score=float(score))
            for person, score in zip(people, left, strict=True)
            if score >= min(person.score, self._least)
        ]

    def _described(self, picture: np.ndarray, people: list[Person]) -> list[Person]:
        if self._looks is None:
            return people
        with self._timing("looks"):
            described = self._looks.describe(picture, people)
            return [replace(person, looks=looks) for person, looks in zip(people, described, strict=True)]

    def _place(self, found: Boxes, everything: Boxes, depth: Picture | None, time: float | None) -> list[Person]:
        if not len(found) and not self._before:
            return []
        if depth is None or self.settings.monocular:
            return self._by_box.place(found, None, time)
        metres = self._measured(self._read(depth, "depth"))
        if self.settings.position == "centre":
            return place_centre(found, metres, self.view)
        people = self._before_room.place(found, metres)
        if not self._before:
            return people
        watched = self._stillness if self._strangers and time is not None else None
        missed = self._before_room.missed(
            metres, everything, people, self._faint, lambda one: _motion(one, people, watched) if watched else 0.0
        )
        self._strangers |= bool(missed)
        return people + [one for one in missed if one.score >= max(self._least, MISSED)]

    @cached_property
    def _before_room(self) -> DepthDetector:
        """The detector that knows the empty room, whose picture is read when a depth picture is compared with it."""
        if self._background is None:
            return self._by_box
        return DepthDetector(self.view, self._metres(self._read(self._background, "background")), room=self._room)

    @cached_property
    def _by_box(self) -> DepthDetector:
        return DepthDetector(self.view, None, room=self._room)

    def _counted(self, people: list[Person], found: int) -> list[Person]:
        """Those who are in the room; all are counted."""
        by_box = [person for person in people if person.method == "monocular"]
        inside = [person for person in people if self._in_room(person)]
        self.tally.by_box += len(by_box)
        room = MOST_BOXES - len(self.tally.boxes)
        self.tally.boxes += [person.bbox_px for person in by_box[:room]]
        self.tally.unexplained += sum(not person.explained for person in by_box)
        if self.settings.monocular or self._background is None:
            self.tally.nowhere += found - len(people)
        self.tally.outside += len(people) - len(inside)
        return inside

    def explained_by_height(self) -> dict[float, float]:
        """Heights of the camera, m, and the share of the boxes placed without depth that a body would explain there.

        The share is largest near the true height, so it is a measurement of it, where the boxes show people who stand.
        """
        shares, boxes = {}, np.array(self.tally.boxes)
        for factor in HEIGHTS if len(boxes) else ():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = self.view.rotation, self.view.origin * [1, 1, factor]
            size, circle = self.view.size, self.view.circle
            view = View(self.view.lens, pose, size, self.view.theta_max, circle=circle)
            shares[float(pose[2, 3])] = float(Fitted(boxes, view).places().explained.mean())
        return shares

    def _in_room(self, person: Person) -> bool:
        """Whether a person may be in the room, as far as the position is known."""
        if self._room is None:
            return True
        beyond = np.maximum(np.maximum(-person.position[:2], person.position[:2] - self._room), 0.0)
        doubt = 0.0
        if person.method == "monocular":
            doubt = (
                SURE
                * float(np.sqrt(beyond @ person.covariance[:2, :2] @ beyond))
                / max(float(np.linalg.norm(beyond)), 1e-9)
            )
        return bool((beyond < WALL_M + doubt).all())

    def _moving(self, found: Boxes) -> Boxes:
        """The boxes that show something else than the room as it was learnt."""
        if self._room_colours is None:
            return found
        moving = self._room_colours.shares(found.boxes) >= STILL
        self.tally.still += int((~moving).sum())
        self._room_colours.learn(found.boxes[moving])
        return found.take(moving)

    def _windows(self, network: Network) -> WindowedNetwork:
        below = self.view.below
        centre = np.array(self._size) / 2 if below is None else below + 0.5
        return WindowedNetwork(network, self._size, centre, self.settings.windows or 1, self.view.circle)

    def _looking(self, network: Network, picture: np.ndarray) -> Network | WindowedNetwork | BandedNetwork:
        """What looks at the pictures, of which the first one says whether they are round."""
        if self.sight is None:
            whole = self._before or self.settings.imgsz is not None
            self.sight = network if whole else suited(network, picture)
        return self.sight

    def _lit(self, found: Boxes) -> Boxes:
        """The boxes whose middle is where the lens lights the picture."""
        return found.take(self.view.lights(found.boxes.reshape(-1, 2, 2).mean(axis=1) - 0.5))

    def _network(self, model: str | os.PathLike | None) -> Network:
        content = own_model() if model is None else read_bytes(model)
        chosen = self.settings
        try:
            shape = (1, 1) if chosen.windows else self._size
            fainter = FAINTEST if self._faint else FAINTEST_IN_FILMS if self._following else 1.0
            least = min(self._least, fainter)
            return Network(content, chosen.imgsz, least, chosen.iou, chosen.threads, shape)
        except ModelError as error:
            raise ModelError(f"{model}: {error}") from None

    def _least_score(self, own: bool) -> float:
        """The least score of a person: lower where boxes of the `own` network are compared with the room's depth."""
        if self.settings.confidence is not None:
            return self.settings.confidence
        return (
            CONFIDENCE_BEFORE_ROOM
            if own and self._background is not None and not self.settings.monocular
            else CONFIDENCE
        )

    def _metres(self, picture: np.ndarray) -> np.ndarray:
        return self.view.radial_depth(picture, self._camera.depth_step_m, self._camera.depth_kind)

    def _measured(self, depth: np.ndarray) -> np.ndarray:
        metres = self._metres(depth)
        if self.shown_m is None and (seen := metres > 0).any():
            heights = self.view.origin[2] + metres[seen] * self.view.rays[seen][:, 2]
            self.shown_m = float(np.median(heights)), float(np.quantile(heights, 0.1))
        return metres

    def _read(self, picture: Picture | None, kind: str) -> np.ndarray:
        if picture is None:
            raise MediaError(f"there is no {kind} picture, which the detector needs")
        image = picture() if callable(picture) else picture
        if image.shape[1::-1] != self._size:
            raise MediaError(
                f"the {kind} picture is {image.shape[1]} × {image.shape[0]} px, but {self._name} says "
                f"{self._size[0]} × {self._size[1]} px"
            )
        return image
