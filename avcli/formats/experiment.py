"""An experiment: its config.json and the layout of its directory.

config.json keeps the thesis's keys (Listing .1) and adds others with defaults, so that the thesis's file loads as it
stands. A Config checks a key when it is first asked for: a command needs only the keys that it uses.
"""

import functools
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from avcli import lens, materials, pose
from avcli.formats import atomic, bounds, room_keys
from avcli.formats.descriptions import PROBABILITY, Format
from avcli.formats.records import format_timestamp
from avcli.formats.schema import (
    Boolean,
    Choice,
    Either,
    Invalid,
    Key,
    Kind,
    ListOf,
    MapOf,
    Number,
    Numbers,
    Object,
    Text,
    Written,
    refuse_depth,
    shown,
    syntax_error,
)
from avcli.formats.sensors import KINDS
from avcli.numeric import SPEED_OF_SOUND_M_S

DIRECTIVITIES = {"omni": 1.0, "subcardioid": 0.75, "cardioid": 0.5, "hypercardioid": 0.25, "bidirectional": 0.0}
"""Microphone patterns a + (1 − a) cos θ by their a; the thesis's file says "omni"."""

# --- what config.json may hold ----------------------------------------------------------------------------------------

_LENGTH = bounds.LENGTH
_COORDINATE, _PLACE = bounds.COORDINATE, bounds.VECTOR
_ANGLE = Number(0, most=360)
_HEIGHT = Number(0, most=100)

_COEFFICIENTS: dict[str, Kind] = {
    "xi": Number(above=-1, most=1),
    "alpha": Number(0, most=1),
    "beta": Number(above=0, most=100),
}
"""What a coefficient of a lens may be, where it is not any number."""


def _coefficient_keys() -> dict[str, Key]:
    """The keys of all coefficients of all lens models; each says whose it is."""
    of: dict[str, list[str]] = {}
    for name, model in lens.LENSES.items():
        for key in lens.TANGENTIAL.get(name, model).keys()[4:]:
            of.setdefault(key, []).append(name)
    return {
        key: Key(
            _COEFFICIENTS.get(key, _COORDINATE),
            f"coefficient of the lens model ({', '.join(models)})",
            default=None if key in _COEFFICIENTS else 0.0,
        )
        for key, models in of.items()
    }


_LENS_KEYS = {
    "lens_model": Key(
        Choice(tuple(lens.LENSES)),
        "the lens model; " + ", ".join(f"{name}: {model.text}" for name, model in lens.LENSES.items()),
        default="division",
    ),
    "fx_px": Key(_LENGTH, "focal length, px", required=True),
    "fy_px": Key(_LENGTH, "focal length, px", required=True),
    "cx_px": Key(_COORDINATE, "principal point, px; pixel (0, 0) is the centre of the top-left pixel", required=True),
    "cy_px": Key(_COORDINATE, "principal point, px", required=True),
    **_coefficient_keys(),
}
LENS_KEYS = tuple(key for key in _LENS_KEYS if key != "lens_model")
"""The keys of the parameters of all lens models."""
_CAMERA = Object(
    {
        **_LENS_KEYS,
        "camera_position_m": Key(
            _PLACE, "position of the camera in the room, m; required by commands that place things in the room"
        ),
        "camera_rotation_deg": Key(
            Numbers(3, bounds.DEGREES),
            "orientation: pitch, yaw, roll; [90, 0, 0] looks straight down with image right = +x and image up = +y",
            default=[90.0, 0.0, 0.0],
        ),
        "image_width_px": Key(bounds.PIXELS, "width of the image, px", default=1920),
        "image_height_px": Key(bounds.PIXELS, "height of the image, px", default=1080),
        "frame_rate_hz": Key(bounds.FRAME_RATE, "frames in a second, Hz", default=10.0),
        "depth_kind": Key(
            Choice(("radial", "z")),
            "meaning of depth: m along the pixel's ray (radial), or along the optical axis (z)",
            default="radial",
        ),
        "depth_step_m": Key(_LENGTH, "one step of a depth picture, m; value 0 means: no depth", default=1e-4),
        "background_depth": Key(Text(), "path of the empty room's depth picture, relative to the experiment directory"),
        "background_rgb": Key(
            Text(), "path of a colour picture of the empty room, relative to the experiment directory"
        ),
        "theta_max_observed_deg": Key(
            _ANGLE,
            "largest angle from the axis where the calibration saw corners; rays beyond it are not used, unless "
            "theta_max_trusted_deg is stated",
        ),
        "theta_max_trusted_deg": Key(
            _ANGLE,
            "largest angle from the axis up to which the lens is known to 0.25°; beyond it the lens is extrapolated: "
            "positions get larger covariances there",
        ),
        "theta_max_valid_deg": Key(
            _ANGLE, "largest angle at which the lens is one-to-one; rays beyond it are not used"
        ),
        "image_circle_px": Key(
            Numbers(3, _COORDINATE),
            "circle that the lens lights on the sensor: [x, y] of its middle and its radius, px; by default the whole "
            "picture. Pixels outside it are not used",
        ),
    }
)
_PATTERN = Choice(tuple(DIRECTIVITIES))


def _one_each(kind: Kind) -> ListOf:
    return ListOf(kind, most=bounds.MOST_CHANNELS)


_MICROPHONES = Object(
    {
        "mic_positions_m": Key(
            ListOf(
                Either(
                    (
                        _PLACE,
                        Object(
                            {
                                "object_id": Key(bounds.ANY_COUNT, "number of the microphone", read=False),
                                "position": Key(_PLACE, "position, m", required=True),
                            }
                        ),
                    )
                ),
                least=1,
                most=bounds.MOST_CHANNELS,
            ),
            "positions in the order of the channels, m: lists [x, y, z], or objects",
            required=True,
        ),
        "audio_sample_rate_hz": Key(bounds.SAMPLE_RATE, "sample rate, Hz", default=44100),
        "audio_bit_depth": Key(Choice((16, 24, 32)), "bits of a sample", default=32),
        "mic_directivity": Key(_PATTERN, "pattern of all microphones", default="omni"),
        "directivities": Key(_one_each(_PATTERN), "pattern of each microphone, in place of mic_directivity"),
        "orientations": Key(
            _one_each(bounds.VECTOR), "direction that each microphone faces, a vector of any length; default: down"
        ),
        "channels": Key(
            _one_each(
                Object(
                    {
                        "channel": Key(bounds.CHANNELS, "which channel of the sound it is, from 1", required=True),
                        "polarity": Key(Choice((1, -1)), "-1: the sound is turned over", default=1),
                        "delay_s": Key(Number(-0.1, most=0.1), "by how much it is late, s", default=0.0),
                        "usable": Key(Boolean(), "whether the channel is used", default=True),
                    }
                )
            ),
            "the channel of each microphone, as avcalib microphones found it; avdetect-audio puts the sound right. By "
            "default each has its own channel without a fault",
        ),
    }
)
_ROOM = Object(
    {
        "room_dimensions_m": Key(Numbers(3, bounds.SIDE), "size of the room along x, y and z, m", required=True),
        "reverberation_time_s": Key(bounds.REVERBERATION, "reverberation time T60, s"),
        "absorption": Key(
            Either((PROBABILITY, Numbers(6, PROBABILITY))),
            "energy absorption of all walls, or of each in the order x0 x1 y0 y1 z0 z1",
        ),
        "speed_of_sound_m_s": Key(bounds.SPEED_OF_SOUND, "speed of sound, m/s", default=SPEED_OF_SOUND_M_S),
        **room_keys.KEYS,
    }
)
_COVERS = Object(
    {
        "polygon_m": Key(ListOf(Numbers(2, _COORDINATE), 3, 1000), "corners on the floor in order, lists [x, y], m"),
        "disc_m": Key(Numbers(3, _COORDINATE), "a disc on the floor: [x, y] of its centre and its radius, m"),
    },
    needed=(("polygon_m",), ("disc_m",)),
    exclusive=("polygon_m", "disc_m"),
)
_SENSOR = Object(
    {
        "kind": Key(Choice(KINDS), "kind of the sensor", required=True),
        "camera_config": Key(_CAMERA, "the camera that it is, if it is not that of the file"),
        "covers": Key(_COVERS, "where it detects people, if the camera does not say it; by default everywhere"),
        "height_m": Key(_HEIGHT, "height above the floor of the point of a person that it localizes, m"),
        "height_sd_m": Key(_HEIGHT, "standard deviation of this height over people, m"),
    }
)
_SENSORS = MapOf(_SENSOR)
CONFIG = Format(
    "config",
    "config.json of an experiment (Listing .1 of the thesis, with more keys)",
    Object(
        {
            "session_id": Key(Text(), "any text", read=False),
            "camera_config": Key(_CAMERA, "the camera: its lens, its place, its pictures"),
            "microphone_config": Key(_MICROPHONES, "the microphones"),
            "room_config": Key(_ROOM, "the room"),
            "sensors": Key(
                _SENSORS,
                'the kind of each sensor, by its name: {"ceiling": {"kind": "camera"}, "ring": {"kind": '
                '"microphones"}}. A sensor whose kind is neither here nor in its records gets the kind that its name '
                "suggests",
            ),
            "written_by": Key(
                Written({"type": "object"}),
                "command that wrote the file; avsim-scene overwrites only directories that it wrote",
                read=False,
            ),
        }
    ),
)

# --- its reader -------------------------------------------------------------------------------------------------------


class ConfigError(ValueError):
    """A key of config.json that is missing or invalid."""


@dataclass(frozen=True)
class Camera:
    """The camera of an experiment.

    Attributes:
        lens: maps points in the camera frame to pixels and back.
        T_room_camera: (4, 4) maps camera coordinates to the room's, m.
        width_px, height_px: image size, px.
        frame_rate_hz: Hz.
        depth_kind: "radial" (along the ray) or "z" (along the optical axis).
        depth_step_m: m of one step of a depth picture.
        background_depth: path of the empty room's depth picture, None where there is none.
        background_rgb: path of a colour picture of the empty room, None where there is none.
        theta_max: largest angle from the axis at which the lens is valid, rad.
        theta_trusted: largest angle from the axis up to which its rays are known well, rad.
        circle: (x, y, radius) px, of what the lens lights of the picture; None: all of it.
    """

    lens: lens.Lens
    T_room_camera: np.ndarray
    width_px: int
    height_px: int
    frame_rate_hz: float
    depth_kind: str
    depth_step_m: float
    background_depth: str | None
    theta_max: float
    theta_trusted: float = math.pi
    circle: tuple[float, float, float] | None = None
    background_rgb: str | None = None


@dataclass(frozen=True)
class Wiring:
    """Which channel of the sound is each microphone's, and what is wrong with it.

    Attributes:
        order: (m,) the channel, from 0.
        sign: (m,) its polarity, 1 or -1.
        delay: (m,) s by which it is late.
        usable: (m,) bool.
    """

    order: np.ndarray
    sign: np.ndarray
    delay: np.ndarray
    usable: np.ndarray


@dataclass(frozen=True)
class Microphones:
    """The microphones of an experiment.

    Attributes:
        positions: (m, 3) m, in the order of the channels.
        sample_rate_hz: Hz.
        bit_depth: bits of a sample.
        directivities: (m,) a of the pattern a + (1 − a) cos θ; 1 is omnidirectional.
        orientations: (m, 3) unit vectors in which each microphone looks.
        wiring: their channels, None where each has its own without a fault.
    """

    positions: np.ndarray
    sample_rate_hz: int
    bit_depth: int
    directivities: np.ndarray
    orientations: np.ndarray
    wiring: Wiring | None = None


@dataclass(frozen=True)
class Room:
    """The room of an experiment.

    Attributes:
        dimensions: (3,) m.
        reverberation_time_s: T60 in s, None where it is not stated.
        absorption: (6,) energy absorption of the walls x0 x1 y0 y1 z0 z1, None where it is not stated.
        speed_of_sound_m_s: m/s.
        surfaces: what they are made of, None where it is not stated.
        contents_absorption_m2: (7,) m², equivalent absorption area of furniture and people in the bands
            `materials.BANDS_HZ`, None where it is not stated.
        fittings: windows, doors, lamps, skirting and daylight.
    """

    dimensions: np.ndarray
    reverberation_time_s: float | None
    absorption: np.ndarray | None
    speed_of_sound_m_s: float
    surfaces: materials.Surfaces | None
    contents_absorption_m2: np.ndarray | None
    fittings: room_keys.Fittings

    @property
    def heard_by_materials(self) -> bool:
        """Whether the surfaces give the absorption, and no number does.

        Of a room whose contents are stated too, the reverberation time is what follows from them.
        """
        told = self.reverberation_time_s is not None and self.contents_absorption_m2 is None
        return self.surfaces is not None and self.absorption is None and not told


class Config:
    """A config.json; `raw` is the JSON object as it was read.

    `camera`, `microphones`, `room` and `sensors` raise ConfigError, which names the file and the key, where a key that
    they need is missing or invalid.
    """

    def __init__(self, raw: Mapping[str, Any], name: str = "config.json"):
        if not isinstance(raw, Mapping):
            raise ConfigError(f"{name}: must be a JSON object, found {shown(raw)}")
        self.raw, self.name = raw, name

    @functools.cached_property
    def camera(self) -> Camera:
        """The camera: its lens, its place and its pictures."""
        return self._camera(self._section("camera_config", _CAMERA), "camera_config")

    def _camera(self, values: Mapping[str, Any], *where: str) -> Camera:
        if values["camera_position_m"] is None:
            raise self._error(Invalid("is missing", (*where, "camera_position_m")))
        width, height = values["image_width_px"], values["image_height_px"]
        if width * height > bounds.MOST_PIXELS:
            reason = f"must have at most {bounds.MOST_PIXELS} pixels, found {width} × {height}"
            raise self._error(Invalid(reason, where))
        try:
            optics = _lens(values, width, height)
        except Invalid as error:
            raise self._error(error.within(*where)) from None
        trusted, circle = values["theta_max_trusted_deg"], values["image_circle_px"]
        if circle is not None and not circle[2] > 0:
            raise self._error(Invalid(f"the radius must be above 0, found {circle[2]:g}", (*where, "image_circle_px")))
        limits = [
            values[f"theta_max_{kind}_deg"] for kind in (("valid",) if trusted is not None else ("observed", "valid"))
        ]
        return Camera(
            lens=optics,
            T_room_camera=pose.camera_pose(values["camera_position_m"], values["camera_rotation_deg"]),
            width_px=width,
            height_px=height,
            frame_rate_hz=values["frame_rate_hz"],
            depth_kind=values["depth_kind"],
            depth_step_m=values["depth_step_m"],
            background_depth=values["background_depth"],
            theta_max=min(optics.theta_max, *(math.radians(180.0 if limit is None else limit) for limit in limits)),
            theta_trusted=math.pi if trusted is None else math.radians(trusted),
            circle=None if circle is None else tuple(circle),
            background_rgb=values["background_rgb"],
        )

    @functools.cached_property
    def frame_rate_hz(self) -> float:
        """The camera's frame rate, Hz (10 where it is not stated, as in the thesis)."""
        rate = _CAMERA.only("frame_rate_hz")
        return self._section("camera_config", rate, needed=False)["frame_rate_hz"]

    @functools.cached_property
    def microphones(self) -> Microphones:
        """The microphones: their places, their format and their patterns."""
        values = self._section("microphone_config", _MICROPHONES)
        listed = values["mic_positions_m"]
        positions = np.array([item["position"] if isinstance(item, dict) else item for item in listed])
        patterns, looks = values["directivities"], values["orientations"]
        patterns = [values["mic_directivity"]] * len(listed) if patterns is None else patterns
        orientations = np.array([[0.0, 0.0, -1.0]] * len(listed) if looks is None else looks)
        channels = values["channels"]
        each = (("directivities", patterns), ("orientations", orientations), ("channels", channels))
        for key, given in each:
            if given is not None and len(given) != len(listed):
                reason = f"must be a list of {len(listed)}, one for each microphone, found {len(given)}"
                raise self._error(Invalid(reason, ("microphone_config", key)))
        lengths = np.linalg.norm(orientations, axis=1, keepdims=True)
        if (lengths == 0).any():
            reason = "must be a vector that is longer than 0"
            where = ("microphone_config", "orientations", int((lengths == 0).argmax()))
            raise self._error(Invalid(reason, where))
        return Microphones(
            positions=positions,
            sample_rate_hz=values["audio_sample_rate_hz"],
            bit_depth=values["audio_bit_depth"],
            directivities=np.array([DIRECTIVITIES[kind] for kind in patterns]),
            orientations=orientations / lengths,
            wiring=None if channels is None else self._wiring(channels),
        )

    def _wiring(self, channels: list[dict[str, Any]]) -> Wiring:
        """Return the channels of the microphones."""
        order = np.array([one["channel"] for one in channels]) - 1
        if sorted(order) != list(range(len(order))):
            reason = f"must name each channel from 1 to {len(order)} once"
            raise self._error(Invalid(reason, ("microphone_config", "channels")))
        sign, delay, usable = (np.array([one[key] for one in channels]) for key in ("polarity", "delay_s", "usable"))
        return Wiring(order, sign.astype(float), delay.astype(float), usable)

    @functools.cached_property
    def sensors(self) -> dict[str, str]:
        """What each named sensor is: name -> "camera" or "microphones"; empty where the file does not say it."""
        return {name: known["kind"] for name, known in self.known_sensors.items()}

    @functools.cached_property
    def known_sensors(self) -> dict[str, dict[str, Any]]:
        """What the file says of each named sensor: name -> keys of "sensors"; None where it does not say one."""
        return self._section("sensors", _SENSORS, needed=False)

    def camera_of(self, sensor: str) -> Camera | None:
        """Return the camera of its own that a named sensor has, None where the file states none."""
        values = self.known_sensors.get(sensor, {}).get("camera_config")
        return None if values is None else self._camera(values, "sensors", sensor, "camera_config")

    def placed_camera(self, sensor: str | None = None) -> Camera | None:
        """Return the camera of a sensor, by default the main one or the only one, where the file says its place."""
        if sensor is None and self.states("camera_config", "camera_position_m"):
            return self.camera
        cameras = {name: known.get("camera_config") or {} for name, known in self.known_sensors.items()}
        placed = [name for name, camera in cameras.items() if camera.get("camera_position_m") is not None]
        wanted = [name for name in placed if sensor in (None, name)]
        return self.camera_of(wanted[0]) if len(wanted) == 1 else None

    @functools.cached_property
    def room(self) -> Room:
        """The room: its size, its reverberation and its speed of sound."""
        values = self._section("room_config", _ROOM)
        absorption, contents = values["absorption"], values["contents_absorption_m2"]
        try:
            fittings = room_keys.fittings(values)
        except Invalid as error:
            raise self._error(error.within("room_config")) from None
        return Room(
            dimensions=np.array(values["room_dimensions_m"]),
            reverberation_time_s=values["reverberation_time_s"],
            absorption=None if absorption is None else np.broadcast_to(absorption, 6).astype(float),
            speed_of_sound_m_s=values["speed_of_sound_m_s"],
            surfaces=materials.surfaces(values),
            contents_absorption_m2=None if contents is None else np.array(contents, dtype=float),
            fittings=fittings,
        )

    def states(self, section: str, key: str) -> bool:
        """Tell whether the file states a key of a section, or the section is invalid, which its reader refuses."""
        values = self.raw.get(section)
        return values is not None and (not isinstance(values, Mapping) or values.get(key) is not None)

    def _section(self, key: str, kind: Object | MapOf, *, needed: bool = True) -> dict[str, Any]:
        values = self.raw.get(key)
        if values is None and needed:
            raise self._error(Invalid("is missing", (key,)))
        try:
            return kind.read({} if values is None else values)
        except Invalid as error:
            raise self._error(error.within(key)) from None

    def _error(self, error: Invalid) -> ConfigError:
        return ConfigError(f"{self.name}: {error}")


def lens_from_config(
    values: Mapping[str, Any], *, name: str = "config.json", width_px: int = 1920, height_px: int = 1080
) -> lens.Lens:
    """Make the lens that a camera_config describes (no "lens_model": the thesis's virtual camera, "division").

    Raises:
        ConfigError: a key is missing or invalid.
    """
    try:
        return _lens(_OPTICS.read(values), width_px, height_px)
    except Invalid as error:
        raise ConfigError(f"{name}: {error.within('camera_config')}") from None


_OPTICS = Object(_LENS_KEYS)


def _lens(values: Mapping[str, Any], width_px: int, height_px: int) -> lens.Lens:
    name = values["lens_model"]
    model = lens.LENSES[name]
    if any(values[key] for key in lens.OFF_CENTRE):
        model = lens.TANGENTIAL.get(name, model)
    keys = model.keys()
    for key in LENS_KEYS:
        if key not in keys and values[key]:
            raise Invalid(f"is no coefficient of the lens model {name}, which has {', '.join(keys)}", (key,))
        if key in model.needed_keys() and values[key] is None:
            raise Invalid(f"is missing; the lens model {name} needs it", (key,))
    return model.of_image([values[key] for key in keys], width_px, height_px)


def read_config(path: str | os.PathLike[str]) -> Config:
    """Read a config.json; its sections are checked when they are first used.

    Args:
        path: of the file.

    Returns:
        The config, whose `camera`, `microphones` and `room` are dataclasses of arrays.

    Raises:
        ConfigError: it is not a JSON object.
        OSError: it cannot be read.
    """
    with open(path, "rb") as stream:
        text = stream.read(bounds.LARGEST_JSON_FILE + 1)
    if len(text) > bounds.LARGEST_JSON_FILE:
        raise ConfigError(f"{path}: longer than {bounds.LARGEST_JSON_FILE >> 20} MiB, which is not a config.json")
    try:
        raw = orjson.loads(text)
        refuse_depth(raw)
        return Config(raw, str(path))
    except orjson.JSONDecodeError as error:
        raise ConfigError(f"{path}:{error.lineno}:{error.colno}: {syntax_error(error)}") from None
    except Invalid as error:
        raise ConfigError(f"{path}: {error}") from None


def write_config(path: str | os.PathLike[str], raw: Mapping[str, Any]) -> None:
    """Write a config.json, whole or not at all."""
    atomic.write_bytes(path, orjson.dumps(raw, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))


@dataclass(frozen=True)
class Layout:
    """Where things lie in an experiment directory; media paths are relative to it, as records name them."""

    directory: Path

    background_depth = "video/depth/Depth_background.png"
    background_rgb = "video/RGB_background.png"

    @property
    def config(self) -> Path:
        """The config.json."""
        return self.directory / "config.json"

    @property
    def groundtruth(self) -> Path:
        """The ground-truth records."""
        return self.directory / "groundtruth_sources.jsonl"

    @property
    def localization(self) -> Path:
        """The directory of the detectors' records."""
        return self.directory / "localization"

    @property
    def tracking(self) -> Path:
        """The directory of the tracks."""
        return self.directory / "tracking"

    @staticmethod
    def rgb(timestamp: float, extension: str = "png") -> str:
        """Path of a colour frame, relative to the experiment."""
        return f"video/rgb/RGB_frame_{format_timestamp(timestamp)}.{extension}"

    @staticmethod
    def depth(timestamp: float, extension: str = "png") -> str:
        """Path of a depth frame, relative to the experiment."""
        return f"video/depth/Depth_frame_{format_timestamp(timestamp)}.{extension}"

    @staticmethod
    def audio(timestamp: float, extension: str = "wav") -> str:
        """Path of a sound file, relative to the experiment."""
        return f"audio/wav/multichannel_audio_{format_timestamp(timestamp)}.{extension}"
