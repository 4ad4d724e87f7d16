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

import numpy as np
import orjson

from avcli import lens, pose
from avcli.formats import atomic
from avcli.formats.records import format_timestamp
from avcli.formats.sensors import KINDS
from avcli.numeric import SPEED_OF_SOUND_M_S

DIRECTIVITIES = {"omni": 1.0, "subcardioid": 0.75, "cardioid": 0.5, "hypercardioid": 0.25, "bidirectional": 0.0}
"""Microphone patterns a + (1 − a) cos θ by their a; the thesis's file says "omni"."""


class ConfigError(ValueError):
    """A key of config.json that is missing or wrong."""


@dataclass(frozen=True)
class Camera:
    """The camera of an experiment.

    Attributes:
        lens: avcli.lens model; camera frame x right, y down, z forward, pixels from the first pixel's centre.
        T_room_camera: (4, 4) maps camera coordinates to the room's, m.
        width_px, height_px: image size, px.
        frame_rate_hz: Hz.
        depth_kind: "radial" (along the ray) or "z" (along the optical axis).
        depth_step_m: m of one step of a depth picture.
        background_depth: path of the empty room's depth picture, None where there is none.
        theta_max: largest angle from the axis at which the lens may be believed, rad.
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


@dataclass(frozen=True)
class Microphones:
    """The microphones of an experiment.

    Attributes:
        positions: (m, 3) m, in the order of the channels.
        sample_rate_hz: Hz.
        bit_depth: bits of a sample.
        directivities: (m,) a of the pattern a + (1 − a) cos θ; 1 is omnidirectional.
        orientations: (m, 3) unit vectors in which each microphone looks.
    """

    positions: np.ndarray
    sample_rate_hz: int
    bit_depth: int
    directivities: np.ndarray
    orientations: np.ndarray


@dataclass(frozen=True)
class Room:
    """The room of an experiment.

    Attributes:
        dimensions: (3,) m.
        reverberation_time_s: T60 in s, None where it is not stated.
        absorption: (6,) energy absorption of the walls x0 x1 y0 y1 z0 z1, None where it is not stated.
        speed_of_sound_m_s: m/s.
    """

    dimensions: np.ndarray
    reverberation_time_s: float | None
    absorption: np.ndarray | None
    speed_of_sound_m_s: float


class Config:
    """A config.json; `raw` is the JSON object as it was read.

    `camera`, `microphones` and `room` raise ConfigError, naming file and key, where a key that they need is wrong.
    """

    def __init__(self, raw: Mapping, name: str = "config.json"):
        if not isinstance(raw, Mapping):
            raise ConfigError(f"{name}: expected a JSON object")
        self.raw, self.name = raw, name

    @functools.cached_property
    def camera(self) -> Camera:
        section = _Section(self, "camera_config")
        width, height = section.count("image_width_px", 1920), section.count("image_height_px", 1080)
        depth_kind = section.choice("depth_kind", ("radial", "z"), "radial")
        optics = lens_from_config(section.values, name=self.name, width_px=width, height_px=height)
        limits = [section.number(f"theta_max_{kind}_deg", 180.0, least=0.0) for kind in ("observed", "valid")]
        return Camera(
            lens=optics,
            T_room_camera=pose.camera_pose(
                section.vector("camera_position_m"), section.vector("camera_rotation_deg", default=(90.0, 0.0, 0.0))
            ),
            width_px=width,
            height_px=height,
            frame_rate_hz=self.frame_rate_hz,
            depth_kind=depth_kind,
            depth_step_m=section.number("depth_step_m", 1e-4, above=0.0),
            background_depth=section.text("background_depth", None),
            theta_max=min(optics.theta_max, math.radians(min(limits))),
        )

    @functools.cached_property
    def frame_rate_hz(self) -> float:
        """The camera's frame rate, Hz (10 where it is not stated, as in the thesis)."""
        return _Section(self, "camera_config", needed=False).number("frame_rate_hz", 10.0, above=0.0)

    @functools.cached_property
    def microphones(self) -> Microphones:
        section = _Section(self, "microphone_config")
        listed = section.get("mic_positions_m")
        if not isinstance(listed, list) or not listed:
            section.refuse("mic_positions_m", "expected a list of microphones")
        positions = np.array(
            [
                section.check_vector(f"mic_positions_m[{i}]", item.get("position") if isinstance(item, dict) else item)
                for i, item in enumerate(listed)
            ]
        )
        count = len(positions)
        kinds = section.get("directivities", section.get("mic_directivity", "omni"))
        kinds = kinds if isinstance(kinds, list) else [kinds] * count
        if len(kinds) != count or not all(isinstance(kind, str) and kind in DIRECTIVITIES for kind in kinds):
            section.refuse("directivities", f"expected one for each microphone of {', '.join(DIRECTIVITIES)}")
        looks = section.get("orientations", [[0.0, 0.0, -1.0]] * count)
        if not isinstance(looks, list) or len(looks) != count:
            section.refuse("orientations", f"expected {count} vectors")
        orientations = np.array([section.check_vector(f"orientations[{i}]", v) for i, v in enumerate(looks)])
        lengths = np.linalg.norm(orientations, axis=1, keepdims=True)
        if (lengths == 0).any():
            section.refuse("orientations", "a vector of length 0 looks nowhere")
        return Microphones(
            positions=positions,
            sample_rate_hz=section.count("audio_sample_rate_hz", 44100),
            bit_depth=section.count("audio_bit_depth", 32),
            directivities=np.array([DIRECTIVITIES[kind] for kind in kinds]),
            orientations=orientations / lengths,
        )

    @functools.cached_property
    def sensors(self) -> dict[str, str]:
        """What each named sensor is: name -> "camera" or "microphones"."""
        listed = self.raw.get("sensors", {})
        if not isinstance(listed, Mapping):
            raise ConfigError(f'{self.name}: "sensors" must be an object')
        kinds = {}
        for name, known in listed.items():
            kind = known.get("kind") if isinstance(known, Mapping) else None
            if kind not in KINDS:
                raise ConfigError(f"{self.name}: sensors.{name}.kind must be one of {', '.join(KINDS)}")
            kinds[name] = kind
        return kinds

    @functools.cached_property
    def room(self) -> Room:
        section = _Section(self, "room_config")
        dimensions = section.vector("room_dimensions_m")
        if (dimensions <= 0).any():
            section.refuse("room_dimensions_m", f"expected three lengths above 0, found {dimensions.tolist()}")
        absorption = section.get("absorption", None)
        if absorption is not None:
            listed = absorption if isinstance(absorption, list) else [absorption] * 6
            if len(listed) != 6 or not all(_is_number(a) and 0 <= a <= 1 for a in listed):
                section.refuse("absorption", "expected one number from 0 to 1, or six in the order x0 x1 y0 y1 z0 z1")
            absorption = np.array(listed, dtype=float)
        return Room(
            dimensions=dimensions,
            reverberation_time_s=section.number("reverberation_time_s", None, least=0.0),
            absorption=absorption,
            speed_of_sound_m_s=section.number("speed_of_sound_m_s", SPEED_OF_SOUND_M_S, above=0.0),
        )


def lens_from_config(values: Mapping, *, name: str = "config.json", width_px: int = 1920, height_px: int = 1080):
    """Make the lens that a camera_config describes (no "lens_model": the thesis's virtual camera, "division").

    Raises:
        ConfigError: a key is missing or wrong.
    """
    section = _Section(Config({"camera_config": values}, name), "camera_config")
    model = section.choice("lens_model", tuple(lens.LENSES), "division")
    fx, fy = section.number("fx_px", above=0.0), section.number("fy_px", above=0.0)
    cx, cy = section.number("cx_px"), section.number("cy_px")
    k = [section.number(f"k{i}", 0.0) for i in (1, 2, 3, 4)]
    return lens.LENSES[model].of_image([fx, fy, cx, cy, *k], width_px, height_px)


def read_config(path: str | os.PathLike) -> Config:
    """Read a config.json.

    Raises:
        ConfigError: it is not a JSON object.
        OSError: it cannot be read.
    """
    try:
        return Config(orjson.loads(Path(path).read_bytes()), str(path))
    except orjson.JSONDecodeError as error:
        raise ConfigError(f"{path}:{error.lineno}:{error.colno}: invalid JSON: {error.msg}") from None


def write_config(path: str | os.PathLike, raw: Mapping) -> None:
    """Write a config.json, whole or not at all."""
    atomic.write_bytes(path, orjson.dumps(raw, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))


class _Section:
    """One section of a config, with checks that name file and key."""

    def __init__(self, config: Config, key: str, *, needed: bool = True):
        self.name, self.key = config.name, key
        values = config.raw.get(key, None if needed else {})
        if not isinstance(values, Mapping):
            raise ConfigError(f'{config.name}: "{key}" is missing or no object')
        self.values = values

    def refuse(self, key: str, reason: str):
        raise ConfigError(f"{self.name}: {self.key}.{key}: {reason}")

    def get(self, key: str, *default):
        if key not in self.values and not default:
            self.refuse(key, "is missing")
        return self.values.get(key, *default)

    def number(self, key: str, *default, least: float = -math.inf, above: float = -math.inf) -> float | None:
        value = self.get(key, *default)
        if value is None and default:
            return default[0]
        if not _is_number(value) or value < least or value <= above:
            bound = f" above {above:g}" if above > -math.inf else f" of at least {least:g}" if least > -math.inf else ""
            self.refuse(key, f"expected a number{bound}, found {_shown(value)}")
        return float(value)

    def count(self, key: str, *default: int) -> int:
        value = self.get(key, *default)
        if not _is_number(value) or value != int(value) or value < 1:
            self.refuse(key, f"expected a whole number above 0, found {_shown(value)}")
        return int(value)

    def text(self, key: str, *default) -> str | None:
        value = self.get(key, *default)
        if value is not None and not isinstance(value, str):
            self.refuse(key, f"expected text, found {_shown(value)}")
        return value

    def choice(self, key: str, choices: tuple[str, ...], *default: str) -> str:
        value = self.get(key, *default)
        if value not in choices:
            self.refuse(key, f"expected one of {', '.join(choices)}, found {_shown(value)}")
        return value

    def vector(self, key: str, default=None) -> np.ndarray:
        return self.check_vector(key, self.get(key) if default is None else self.get(key, list(default)))

    def check_vector(self, key: str, value) -> np.ndarray:
        if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
            self.refuse(key, f"expected three numbers, found {_shown(value)}")
        return np.array(value, dtype=float)


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value) -> str:
    text = orjson.dumps(value).decode()
    return text if len(text) <= 60 else text[:57] + "..."


@dataclass(frozen=True)
class Layout:
    """Where things lie in an experiment directory; media paths are relative to it, as records name them."""

    directory: Path

    config = property(lambda self: self.directory / "config.json")
    groundtruth = property(lambda self: self.directory / "groundtruth_sources.jsonl")
    localization = property(lambda self: self.directory / "localization")
    tracking = property(lambda self: self.directory / "tracking")

    background_depth = "video/depth/Depth_background.png"

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
