"""The detector: pictures of a ceiling camera in, people with positions in the room out."""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from importlib import resources
from typing import Any

import numpy as np

from avcli.detection.body import Person, beyond_trust
from avcli.detection.depth import DepthDetector, place_centre
from avcli.detection.gate import Gate
from avcli.detection.looks import Looks, feature
from avcli.detection.network import Boxes, ModelError, Network
from avcli.detection.settings import Settings
from avcli.detection.view import View
from avcli.formats.experiment import Config
from avcli.formats.media import MediaError, Shot, read_bytes
from avcli.formats.records import Detections
from avcli.formats.sensors import CAMERA

SENSOR = "video"
"""The sensor's name in records."""

WALL_M = 0.3
"""m; a person found farther than this behind a wall is a reflection, or a wrong box."""

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
        yield detections(shot.timestamp, detector.look(shot.rgb, shot.depth))


def detections(timestamp: float, people: list[Person]) -> Detections:
    """Collect the people found at one time, s, as detections of the sensor `SENSOR`."""
    return Detections(
        timestamp=timestamp,
        sensor=SENSOR,
        positions=np.array([person.position for person in people]).reshape(-1, 3),
        covariances=np.array([person.covariance for person in people]).reshape(-1, 3, 3),
        scores=np.array([person.score for person in people]),
        kind=CAMERA,
        boxes_px=np.array([person.bbox_px for person in people]).reshape(-1, 4).round(2),
        heights=np.array([np.nan if person.height is None else person.height for person in people]),
        features=feature(people),
    )


class Detector:
    """Finds the people in a ceiling camera's pictures, which must come in order of time.

    Args:
        config: the camera, and the room's size if it is known: people found outside the walls are dropped.
        background: the empty room's depth picture, see `detect`.
        model: ONNX file of a YOLO export; None: the package's own network.
        settings: how people are found and placed; None: the defaults.
        timing: is called with the name of each step and gives a context manager around it, to measure its time.

    Attributes:
        view: the camera in the room.
        network: the network, None for the depth detector.

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
        model: str | os.PathLike | None = None,
        settings: Settings | None = None,
        timing: Timing = contextlib.nullcontext,
    ):
        self.settings = settings or Settings()
        self._camera, self._name, self._timing = config.camera, config.name, timing
        self._size = self._camera.width_px, self._camera.height_px
        self._background = background
        camera = self._camera
        self.view = View(
            camera.lens,
            camera.T_room_camera,
            self._size,
            camera.theta_max,
            theta_trusted=camera.theta_trusted,
            circle=camera.circle,
        )
        self.network = self._network(model) if self.settings.detector == "net" else None
        if self.network is None and background is None:
            raise ValueError('the detector "depth" needs the depth picture of the empty room')
        self._gate, self._last = Gate(self.settings.refresh), list[Person]()
        described = self.settings.detector == "net" if self.settings.features is None else self.settings.features
        self._looks = Looks(self.view) if described else None
        known = config.states("room_config", "room_dimensions_m")
        self._room = config.room.dimensions if known else None

    def look(self, rgb: Picture | None, depth: Picture | None = None) -> list[Person]:
        """Find the people in the next pictures.

        Args:
            rgb: (height, width, 3) uint8, which the network needs; or a function that reads it.
            depth: (height, width) uint16 in steps of the camera's `depth_step_m`; or a function that reads it. The
                depth detector needs it. The network can do without, and asks for it where it finds somebody.
            With the setting `features` the depth detector needs the colour picture too.

        Raises:
            MediaError: the picture is missing, cannot be read, or has another size than config.json says.
        """
        if self.network is None:
            with self._timing("wait for pictures"):
                picture = self._read(depth, "depth")
            with self._timing("depth and positions"):
                standing = self._before_room.detect(self._metres(picture))
                people = [beyond_trust(one, self.view) for one in standing if self._in_room(one)]
            return people if self._looks is None else self._described(self._read(rgb, "colour"), people)
        with self._timing("wait for pictures"):
            picture = self._read(rgb, "colour")
        regions = self._gate.changes(picture)
        if len(regions):
            with self._timing("network"):
                found = self.network.detect(picture, regions)
            with self._timing("depth and positions"):
                placed = self._place(found, depth)
                people = [beyond_trust(person, self.view) for person in placed if self._in_room(person)]
            self._last = self._described(picture, people)
        return self._last

    def _described(self, picture: np.ndarray, people: list[Person]) -> list[Person]:
        if self._looks is None:
            return people
        with self._timing("looks"):
            described = self._looks.describe(picture, people)
            return [replace(person, looks=looks) for person, looks in zip(people, described, strict=True)]

    def _place(self, found: Boxes, depth: Picture | None) -> list[Person]:
        if not len(found):
            return []
        if depth is None or self.settings.monocular:
            return DepthDetector(self.view, None).place(found, None)
        metres = self._metres(self._read(depth, "depth"))
        if self.settings.position == "centre":
            return place_centre(found, metres, self.view)
        return self._before_room.place(found, metres)

    @cached_property
    def _before_room(self) -> DepthDetector:
        """The detector that knows the empty room, whose picture is read when a depth picture is compared with it."""
        if self._background is None:
            return DepthDetector(self.view, None)
        return DepthDetector(self.view, self._metres(self._read(self._background, "background")))

    def _in_room(self, person: Person) -> bool:
        x, y = person.position[:2]
        return self._room is None or bool(-WALL_M < x < self._room[0] + WALL_M and -WALL_M < y < self._room[1] + WALL_M)

    def _network(self, model: str | os.PathLike | None) -> Network:
        own = resources.files("avcli.detection") / "people.onnx"
        content = own.read_bytes() if model is None else read_bytes(model)
        chosen = self.settings
        try:
            return Network(content, chosen.imgsz, chosen.confidence, chosen.iou, chosen.threads)
        except ModelError as error:
            raise ModelError(f"{model}: {error}") from None

    def _metres(self, picture: np.ndarray) -> np.ndarray:
        return self.view.radial_depth(picture, self._camera.depth_step_m, self._camera.depth_kind)

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
