"""Whether a config.json describes a whole installation: lens, limits, pose, room, microphones, doors, background."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avcli import pose
from avcli.formats import media
from avcli.formats.experiment import Config, ConfigError
from avcli.formats.footage import PICTURES
from avcli.lens import Lens

_LARGEST_RMS_PX = 5.0
"""RMS residual of a pose beyond which a point was mistaken."""
_STEEPEST = math.radians(60.0)
"""Angle between the axis and straight down up to which a camera counts as looking down."""


@dataclass(frozen=True)
class Part:
    """What is known of one part.

    Attributes:
        name: of the part.
        state: "measured"; "stated", there and plausible, but nothing says that it was measured; "missing", and needed;
            "absent", and not needed; or "wrong".
        text: why, or how it was measured.
    """

    name: str
    state: str
    text: str

    @property
    def is_good(self) -> bool:
        """Whether it can be worked with."""
        return self.state not in ("missing", "wrong")


class _Wrong(ValueError):
    """What is stated cannot be."""


def examine(config: Config, folder: Path, only: Collection[str] = ()) -> list[Part]:
    """Examine each part of an installation.

    Args:
        config: the file; one that holds a camera_config alone is read as such.
        only: names of the parts to examine; none: all.
        folder: of the experiment, whose pictures and sound must agree with the file.
    """
    if "fx_px" in config.raw:
        config = Config({"camera_config": config.raw}, config.name)
    examined = []
    for name, look in LOOKS.items():
        if only and name not in only:
            continue
        try:
            state, text = look(config, folder)
        except (_Wrong, ConfigError, media.MediaError, OSError) as error:
            state, text = "wrong", str(error).removeprefix(f"{config.name}: ")
        examined.append(Part(name, state, text))
    return examined


def record(parts: list[Part]) -> dict:
    """Return the parts as JSON's types."""
    return {part.name: {"state": part.state, "text": part.text} for part in parts}


def _section(config: Config, name: str) -> Mapping[str, Any]:
    values = config.raw.get(name)
    return values if isinstance(values, Mapping) else {}


def _lens_of(config: Config) -> Lens:
    """The lens, which needs no pose."""
    values = {**_section(config, "camera_config")}
    values.setdefault("camera_position_m", [0.0, 0.0, 0.0])
    return Config({"camera_config": values}, config.name).camera.lens


def _size(config: Config) -> tuple[int, int]:
    values = _section(config, "camera_config")
    return int(values.get("image_width_px", 1920)), int(values.get("image_height_px", 1080))


def _lens(config: Config, folder: Path) -> tuple[str, str]:
    values = _section(config, "camera_config")
    if "fx_px" not in values:
        return "missing", "there is no lens: avcalib live or avcalib calibrate finds it"
    lens, (width, height) = _lens_of(config), _size(config)
    if not (0.2 < lens.cx / width < 0.8 and 0.2 < lens.cy / height < 0.8):
        raise _Wrong(f"the principal point ({lens.cx:.0f}, {lens.cy:.0f}) px is far from the middle of the picture")
    found = _picture_size(folder)
    if found and found != (width, height):
        raise _Wrong(f"the lens is for {width} × {height} px, but the pictures are {found[0]} × {found[1]} px")
    known = values.get("calibration")
    if not isinstance(known, Mapping):
        return "stated", f"{values.get('lens_model', 'division')}, {width} × {height} px; nothing says how it was found"
    error = known.get("held_out_rms_px") or known.get("rms_px")
    shown = f", held-out residual {error:.2f} px" if isinstance(error, int | float) else ""
    return "measured", (
        f"{values.get('lens_model')}, {width} × {height} px, from {known.get('views_used', '?')} pictures{shown}"
    )


def _picture_size(folder: Path) -> tuple[int, int] | None:
    """(width, height) px of the first picture of the experiment; None where there is none."""
    pictures = folder / "video" / "rgb"
    paths = sorted(path for path in pictures.iterdir() if path.suffix.lower() in PICTURES) if pictures.is_dir() else []
    if not paths:
        return None
    shape = media.read_picture(paths[0]).shape
    return shape[1], shape[0]


def _limits(config: Config, _folder: Path) -> tuple[str, str]:
    values = _section(config, "camera_config")
    if "fx_px" not in values:
        return "missing", "there is no lens"
    lens, (width, height) = _lens_of(config), _size(config)
    x, y = np.array([0.0, width - 1.0]), np.array([0.0, height - 1.0])
    rays = lens.unproject(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    angles = np.degrees(pose.angle_from_axis(rays))
    reach = float(angles.max()) if np.isfinite(angles).all() else math.degrees(lens.theta_max)
    stated = [key for key in ("theta_max_trusted_deg", "theta_max_observed_deg") if values.get(key) is not None]
    if not stated:
        known = "calibration" in values
        return ("missing" if known else "stated"), (
            f"no angle is stated up to which the lens was observed; the picture reaches {reach:.0f}° from the axis"
        )
    limit = float(values[stated[0]])
    if limit < 0.4 * reach:
        raise _Wrong(f"the lens was observed up to {limit:.0f}° from the axis only; the picture reaches {reach:.0f}°")
    return "measured", f"the lens is known up to {limit:.0f}° from the axis; the picture reaches {reach:.0f}°"


def _room(config: Config, _folder: Path) -> tuple[str, str]:
    if not _section(config, "room_config"):
        return "missing", "room_config.room_dimensions_m: measure the room along x, y and z"
    size = config.room.dimensions
    if not (size.min() >= 1.0 and size.max() <= 200.0):
        raise _Wrong(f"room_dimensions_m {_triple(size)} m is no room")
    return "stated", f"{' × '.join(f'{side:g}' for side in size)} m"


def _pose(config: Config, _folder: Path) -> tuple[str, str]:
    values = _section(config, "camera_config")
    if values.get("camera_position_m") is None:
        return "missing", "where the camera hangs is not known: avcalib pose finds it"
    camera, size = config.camera, _room_size(config)
    T = camera.T_room_camera
    position, axis = T[:3, 3], T[:3, 2]
    if size is not None and not _is_within(position, size):
        raise _Wrong(f"the camera at {_triple(position)} m is outside the room of {_triple(size)} m")
    rms = values.get("pose_rms_px")
    if isinstance(rms, int | float) and rms > _LARGEST_RMS_PX:
        raise _Wrong(f"the pose does not fit: residual {rms:.1f} px; find it again with avcalib pose")
    lean = math.degrees(math.acos(float(np.clip(-axis[2], -1, 1))))
    text = f"at {_triple(position)} m, {lean:.0f}° from straight down"
    if size is not None:
        seen = _floor_seen(config, size)
        text += f", sees {100 * seen:.0f} % of the floor"
        if seen < 0.05:
            raise _Wrong(f"{text}: is camera_rotation_deg right?")
    if math.radians(lean) > _STEEPEST:
        text += "; a ceiling camera looks down"
    covariance = values.get("pose_covariance")
    if covariance is None:
        assumed = "; camera_rotation_deg is not stated, straight down is assumed"
        return "stated", text + ("" if "camera_rotation_deg" in values else assumed) + "; nothing says how it was found"
    spread = np.asarray(covariance, float)
    if spread.shape != (6, 6):
        raise _Wrong("pose_covariance must be 6 × 6")
    return "measured", f"{text}, ± {1000 * math.sqrt(max(float(np.trace(spread[3:, 3:])), 0)):.0f} mm"


def _room_size(config: Config) -> np.ndarray | None:
    try:
        return config.room.dimensions
    except ConfigError:
        return None


def _is_within(point: np.ndarray, size: np.ndarray) -> bool:
    return bool((point >= -1e-9).all() and (point <= size + 1e-9).all())


def _floor_seen(config: Config, size: np.ndarray) -> float:
    """Fraction of the floor that the picture shows, where the lens is valid."""
    camera = config.camera
    x, y = (np.linspace(0, side, 41)[1::2] for side in size[:2])
    floor = np.stack([*np.meshgrid(x, y), np.zeros((20, 20))], -1).reshape(-1, 3)
    T = camera.T_room_camera
    inside = (floor - T[:3, 3]) @ T[:3, :3]
    pixels = camera.lens.project(inside)
    angle = pose.angle_from_axis(inside)
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= -0.5) & (pixels <= np.array([camera.width_px, camera.height_px]) - 0.5)).all(1)
    return float((seen & (angle <= camera.theta_max)).mean())


def _microphones(config: Config, folder: Path) -> tuple[str, str]:
    values = _section(config, "microphone_config")
    if not values:
        return "missing", "microphone_config.mic_positions_m: measure where each microphone is"
    known, size = config.microphones, _room_size(config)
    positions = known.positions
    if size is not None:
        outside = [number for number, one in enumerate(positions, 1) if not _is_within(one, size)]
        if outside:
            numbers = ", ".join(map(str, outside))
            raise _Wrong(f"microphone {numbers} is outside the room of {_triple(size)} m")
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2) + 9.0 * np.eye(len(positions))
    if apart.min() < 0.005:
        one, other = np.unravel_index(int(apart.argmin()), apart.shape)
        raise _Wrong(f"microphones {one + 1} and {other + 1} are in one place")
    heard = _sound(folder)
    if heard and heard != (len(positions), known.sample_rate_hz):
        raise _Wrong(
            f"{len(positions)} microphones at {known.sample_rate_hz} Hz, but the sound has {heard[0]} channels at "
            f"{heard[1]} Hz"
        )
    text = f"{len(positions)} microphones, {known.sample_rate_hz} Hz"
    if len(positions) < 4:
        text += "; fewer than four do not tell a place"
    if known.wiring:
        text += f"; channels are put right, {int((~known.wiring.usable).sum())} are not used"
    found = values.get("calibration")
    if not isinstance(found, Mapping):
        return "stated", f"{text}; avcalib microphones measures the positions by sound"
    return "measured", f"{text}, found with avcalib microphones to ± {1000 * float(found.get('sd_m') or 0):.0f} mm"


def _sound(folder: Path) -> tuple[int, int] | None:
    """Channels and sample rate, Hz, of the first sound of the experiment; None where there is none."""
    sounds = folder / "audio" / "wav"
    paths = (
        sorted(path for path in sounds.iterdir() if path.suffix.lower() in (".wav", ".flac")) if sounds.is_dir() else []
    )
    if not paths:
        return None
    import soundfile

    about = soundfile.info(str(paths[0]))
    return about.channels, about.samplerate


def _doors(config: Config, _folder: Path) -> tuple[str, str]:
    doors = _section(config, "room_config").get("doors")
    if not doors:
        return "absent", "not stated; avfuse learns where people come and leave"
    return "stated", f"{len(doors)} doors" if isinstance(doors, list) else "doors"


def _background(config: Config, folder: Path) -> tuple[str, str]:
    camera = _section(config, "camera_config")
    readers = {"background_rgb": media.read_picture, "background_depth": media.read_depth}
    paths = {key: str(camera[key]) for key in readers if camera.get(key) is not None}
    if not paths:
        return "absent", "not stated; only avdetect-video --detector depth needs it"
    width, height = _size(config)
    for key, path in paths.items():
        shape = readers[key](folder / path).shape[:2]
        if shape != (height, width):
            raise _Wrong(f"{path} is {shape[1]} × {shape[0]} px, but the camera has {width} × {height} px")
    return "stated", " and ".join(paths.values())


def _triple(values: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.3g}' for value in values)}]"


LOOKS: dict[str, Callable[[Config, Path], tuple[str, str]]] = {
    "lens": _lens,
    "limits": _limits,
    "room": _room,
    "pose": _pose,
    "microphones": _microphones,
    "doors": _doors,
    "background": _background,
}
"""The parts, in the order in which they are found out, and what examines each."""
