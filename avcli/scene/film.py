"""The film of a scenario: poses, frames and ground truth, drawn one after another as they are asked for."""

import contextlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from avcli.formats.experiment import Config, Layout
from avcli.formats.media import Shot
from avcli.formats.records import Identified, identified
from avcli.formats.sensors import CAMERA, MICROPHONES
from avcli.scene import annotations, contents, interior, load, people, render, sensor, worlds
from avcli.scene.room_cache import RoomCache
from avcli.scene.scenario import Scenario
from avcli.scene.settings import Drawing, Effects, with_sensor

_CHUNK = 100  # frames whose bodies are posed together: memory does not grow with the scene
_SHUTTER_PICTURES = 8  # that are averaged while the shutter is open, at most
_SHUTTER_STEP_PX = 3.0  # by which people move from one to the next; where they move by less, one is enough

_SENSORS = {"audio": {"kind": MICROPHONES}, "video": {"kind": CAMERA}}
"""What avdetect-audio and avdetect-video call themselves in their records, for config.json."""

Timing = Callable[[str], contextlib.AbstractContextManager]


@dataclass(frozen=True)
class Frame:
    """One frame of a film.

    Attributes:
        timestamp: s.
        record: the ground-truth record, without the paths of its media.
        picture: what was drawn (its `rgb` is without shutter and sensor effects); None where nothing is drawn.
        rgb: (height, width, 3) uint8, as the sensor gives it; None where no colour is drawn.
    """

    timestamp: float
    record: dict[str, Any]
    picture: render.Frame | None
    rgb: np.ndarray | None


@dataclass
class Account:
    """What was drawn, and what was not drawn twice.

    Attributes:
        drawn, again: how many frames were drawn, and how many are as the last one.
        share: sum over all frames of the share of the picture that was drawn.
    """

    drawn: int = 0
    again: int = 0
    share: float = 0.0

    def add(self, share: float, *, again: bool) -> None:
        """Count a frame; `share` is the sum up to it."""
        self.share = share
        self.again += again
        self.drawn += not again


class Film:
    """Draws a scenario.

    Args:
        scenario: what happens.
        drawing: how frames are drawn; None: nothing is drawn, the film is ground truth alone.
        effects: what the sensor does to the pictures, beside what the sensor's name says; None: nothing.
        sensor_name: one of `settings.SENSORS`; None: that of the scenario.
        seed: of the sensor's noise.
        rooms: folder that keeps the colours of empty rooms for other runs (`room_cache.folder()`); None: none does.
        timing: called with the name of each step, returns a context manager around it.

    Attributes:
        account: of the frames that were drawn last.
        cache: of the empty room; None without `rooms`.

    Raises:
        render.NoGraphics: this machine cannot draw.
    """

    def __init__(
        self,
        scenario: Scenario,
        drawing: Drawing | None,
        effects: Effects | None = None,
        *,
        sensor_name: str | None = None,
        seed: int = 0,
        rooms: Path | None = None,
        timing: Timing = lambda step: contextlib.nullcontext(),
    ) -> None:
        self.scenario, self.seed = scenario, seed
        self.drawing, self.effects = drawing, effects or Effects()
        if drawing:
            self.drawing, self.effects = with_sensor(sensor_name or scenario.sensor, drawing, self.effects)
        self._timing = timing
        self.account = Account()
        self.cache: RoomCache | None = None
        self._renderer: render.Renderer | None = None
        if drawing:
            camera, room = scenario.config.camera, scenario.config.room.dimensions
            step = drawing.depth_step_m(render.farthest(camera, room))
            with timing("open the renderer and draw the room"):
                sections = [scenario.raw[key] for key in ("camera_config", "room_config", "furniture")]
                self.cache = RoomCache(rooms, [*sections, drawing.samples], scenario.solids) if rooms else None
                dressed = interior.interior(scenario.config.room, scenario.solids)
                self._renderer = render.Renderer(
                    camera, room, scenario.solids, step, drawing.samples, dressed=dressed,
                    colour=drawing.pictures != "depth", cache=self.cache,
                )  # fmt: skip

    @property
    def background(self) -> np.ndarray | None:
        """Depth of the empty room, (height, width) uint16 in steps; None where nothing is drawn."""
        return self._renderer.room_depth if self._renderer else None

    @property
    def drawn_by(self) -> str:
        """Names of the OpenGL that draws; empty where nothing is drawn."""
        return self._renderer.canvas.drawn_by if self._renderer else ""

    def config(self, *, background: bool) -> dict[str, Any]:
        """The config.json of the film: the scenario's sections, and what a reader of the frames has to know.

        Args:
            background: whether to name the file of the empty room's depth.
        """
        raw = self.scenario.raw
        camera = dict(raw["camera_config"])
        camera.setdefault("theta_max_valid_deg", math.degrees(self.scenario.config.camera.lens.theta_max))
        if self._renderer:
            camera |= {"depth_kind": "radial", "depth_step_m": self._renderer.depth_step}
        if background:
            camera["background_depth"] = Layout.background_depth
        sections = {"microphone_config": raw["microphone_config"], "room_config": contents.room_heard(self.scenario)}
        return {"session_id": self.scenario.name, "camera_config": camera, **sections, "sensors": _SENSORS}

    def frames(self) -> Iterator[Frame]:
        """Draw the frames, one at a time; a second call draws the same film again."""
        generator = np.random.default_rng(self.seed)
        times = self.scenario.times
        self.account = account = Account()
        balance = sensor.WhiteBalance(self.effects.white_balance)
        last: render.Frame | None = None
        exposed = held = shown = None
        for start in range(0, len(times), _CHUNK):
            with self._timing("pose the people"):
                bodies = people.pose(self.scenario.people, times[start : start + _CHUNK])
                still = self.drawing.still_px if self.drawing else 0.0
                prepared = self._renderer.prepare(bodies, still) if self._renderer else None
            for index, time in enumerate(bodies.times.tolist()):
                if self._renderer is None or prepared is None:
                    yield Frame(time, annotations.truth(self.scenario, bodies, index), None, None)
                    continue
                with self._timing("draw"):
                    picture = self._renderer.draw(prepared, index)
                    account.add(self._renderer.drawn_share, again=picture is last)
                    last, rgb = picture, picture.rgb
                    if rgb is not None and self.drawing and self.drawing.shutter_s:
                        rgb = self._exposed(self._renderer, time, self.drawing.shutter_s)
                if rgb is not None:
                    with self._timing("sensor effects"):
                        lens = self.scenario.config.camera.lens
                        gains = balance.gains(rgb, time)
                        if rgb is not exposed or gains is not held or self.effects.differ_by_frame:
                            shown = sensor.expose(rgb, self.effects, (lens.cx, lens.cy), generator, time, gains)
                        exposed, held = rgb, gains
                with self._timing("annotate"):
                    record = annotations.truth(self.scenario, bodies, index, picture)
                yield Frame(time, record, picture, shown)

    def _exposed(self, renderer: render.Renderer, time: float, shutter: float) -> np.ndarray:
        """The mean light while the shutter is open: half its time before a frame's time, and half after."""
        instants = shutter * (np.arange(_SHUTTER_PICTURES) + 0.5) / _SHUTTER_PICTURES - shutter / 2
        prepared = renderer.prepare(people.pose(self.scenario.people, time + instants))
        count = int(np.clip(np.ceil(prepared.travel_px / _SHUTTER_STEP_PX), 1, _SHUTTER_PICTURES))
        middles = ((np.arange(count) + 0.5) * _SHUTTER_PICTURES / count).astype(int)
        pictures = (renderer.draw(prepared, k).rgb for k in middles.tolist())
        return sensor.blurred([picture for picture in pictures if picture is not None])


# --- the library's door -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A simulated scene.

    Attributes:
        config: of the experiment: camera, microphones and room.
        background: depth of the empty room, (height, width) uint16 in steps of `config.camera.depth_step_m`; None
            without video.
        warnings: sentences on what is odd in the scenario but can be simulated.
    """

    config: Config
    background: np.ndarray | None = field(repr=False)
    warnings: tuple[str, ...]
    _film: Film = field(repr=False)

    @cached_property
    def truth(self) -> list[Identified]:
        """Ground truth of every frame: positions, mouths, whose turn it is to speak. Nothing is drawn for it."""
        return [identified(frame.record) for frame in Film(self._film.scenario, None).frames()]

    def shots(self) -> Iterator[Shot]:
        """Draw what the camera sees, one frame at a time; every call begins anew and gives the same pictures.

        Raises:
            ValueError: the scene was simulated without video.
        """
        frames = self.frames()
        return (Shot(frame.timestamp, frame.rgb, frame.picture.depth if frame.picture else None) for frame in frames)

    def frames(self) -> Iterator[Frame]:
        """Draw the frames with all that is known of them: `record` has boxes, visible fractions and keypoints too.

        Raises:
            ValueError: the scene was simulated without video.
        """
        if not self._film.drawing:
            raise ValueError("the scene has no pictures: simulate it with video=True")
        return self._film.frames()


def simulate(
    scenario: str | os.PathLike | Mapping,
    *,
    seed: int = 0,
    video: bool = True,
    people: int = 3,
    wishes: worlds.Wishes | None = None,
    duration: float | None = None,
    camera: str | None = None,
    camera_config: Mapping | None = None,
    camera_height: float | None = None,
    drawing: Drawing | None = None,
    effects: Effects | None = None,
    sensor_name: str | None = None,
) -> Scene:
    """Simulate people who walk and talk in a room under a camera.

        >>> from avcli.scene.film import simulate
        >>> scene = simulate("s1")
        >>> len(scene.truth), scene.truth[10].positions
        (41, array([[1.33, 2.33, 0.  ]]))
        >>> shot = next(scene.shots())
        >>> shot.rgb.shape, bool((shot.depth < scene.background).any())  # the person is nearer than the empty room
        ((1080, 1920, 3), True)

    Args:
        scenario: a built-in name ("s1" to "s4"), "random", the path of a scenario file, or its JSON object.
        seed: of all chance: a random scenario, the sensor's noise.
        video: whether pictures can be drawn (OpenGL through EGL); they are drawn when `shots` is iterated.
        people: how many people a random scenario has.
        wishes: what else a random scenario has to be (its room, its lens), in place of `people`.
        duration: s, instead of the scenario's own.
        camera: "real" or "thesis": one of the thesis's two lenses instead of the scenario's.
        camera_config: a camera_config (or an object that holds one) instead of the scenario's.
        camera_height: m, instead of the scenario's.
        drawing: samples per pixel, depth resolution, shutter; None: the defaults.
        effects: what the sensor does to the pictures, beside what the sensor's name says; None: nothing.
        sensor_name: "webcam", "ip-camera" or "clean"; None: that of the scenario.

    Returns:
        The scene: `config`, `truth`, `shots()`.

    Raises:
        ScenarioError: something in the scenario is wrong; the message says where and what.
        FileNotFoundError: neither a known name nor a file.
        render.NoGraphics: `video` on a machine that cannot draw.
    """
    loaded = load.load(
        scenario, seed=seed, people=people, wishes=wishes, duration=duration, camera=camera,
        camera_config=camera_config, camera_height=camera_height,
    )  # fmt: skip
    film = Film(loaded, (drawing or Drawing()) if video else None, effects, sensor_name=sensor_name, seed=seed)
    config = Config(film.config(background=video), loaded.name)
    return Scene(config, film.background, tuple(loaded.warnings), film)
