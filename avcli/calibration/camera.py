"""The camera_config of a camera, read from and written into a config.json or a file of its own."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from avcli.calibration.circle import Circle
from avcli.formats import experiment
from avcli.lens import Lens


@dataclass(frozen=True)
class KnownCamera:
    """A camera whose lens is known.

    Attributes:
        lens: a model of avcli.lens.
        size: (width, height) px of its pictures.
        values: the keys of its camera_config.
        name: the file it was read from.
    """

    lens: Lens
    size: tuple[int, int]
    values: Mapping[str, Any]
    name: str

    @property
    def theta_max(self) -> float:
        """Largest angle from the axis at which the lens is one-to-one, rad, as the camera_config states it."""
        return math.radians(float(self.values.get("theta_max_valid_deg", 180.0)))

    @property
    def theta_trusted(self) -> float:
        """Largest angle from the axis up to which the rays are known well, rad; `theta_max` where it is not stated."""
        return min(self.theta_max, math.radians(float(self.values.get("theta_max_trusted_deg", 180.0))))

    @property
    def circle(self) -> Circle | None:
        """Where the lens lights the pictures; None: everywhere."""
        stated = self.values.get("image_circle_px")
        return Circle(*stated) if stated else None

    @property
    def covariance(self) -> np.ndarray:
        """(parameters, parameters) of the lens's parameters, in the order of its keys; 0 where it is not stated."""
        count = len(self.lens.parameters)
        stated = self._calibration.get("covariance")
        found = np.zeros((count, count)) if stated is None else np.array(stated, float)
        return found if found.shape == (count, count) and np.isfinite(found).all() else np.zeros((count, count))

    @property
    def pupil_m(self) -> float:
        """How far the centre of projection is ahead at 1 rad from the axis, m (fit.Solution.pupil); 0 if not stated."""
        return float(self._calibration.get("pupil_m") or 0.0)

    @property
    def inflation(self) -> float:
        """How many times larger errors shared within a view made the lens's error; 1 where it is not stated."""
        return max(float(self._calibration.get("inflation") or 1.0), 1.0)

    @property
    def _calibration(self) -> Mapping[str, Any]:
        stated = self.values.get("calibration")
        return stated if isinstance(stated, Mapping) else {}

    def require_size(self, size: tuple[int, int] | None, name: str = "the pictures") -> None:
        """Check that pictures of `size` (width, height) px are this camera's.

        Raises:
            ValueError: they are not.
        """
        if size != self.size:
            found = f"{size[0]} × {size[1]} px" if size else "empty"
            raise ValueError(
                f"{name}: {found}, but {self.name} describes a camera of {self.size[0]} × {self.size[1]} px"
            )


def parse_camera(content: bytes, name: str) -> KnownCamera:
    """Read a camera from a config.json, or from the line that `avcalib calibrate` writes.

    Raises:
        ValueError: there is no camera_config in it, or a key of the lens is missing or wrong.
    """
    try:
        raw = orjson.loads(content)
        values = raw.get("camera_config", raw)
        width, height = int(values.get("image_width_px", 1920)), int(values.get("image_height_px", 1080))
    except (orjson.JSONDecodeError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected a config.json, or the output of avcalib calibrate ({error})") from None
    lens = experiment.lens_from_config(values, name=name, width_px=width, height_px=height)
    return KnownCamera(lens, (width, height), values, name)


OF_LENS = (
    *("lens_model", *experiment.LENS_KEYS, "image_width_px", "image_height_px", "calibration"),
    *("theta_max_observed_deg", "theta_max_trusted_deg", "theta_max_valid_deg", "image_circle_px"),
)
"""Keys of a camera_config that say what its lens is, and how well that is known."""


def write_camera(path: Path, found: Mapping[str, Any]) -> None:
    """Write keys of a camera_config into a config.json or into a file of its own, which keeps its other keys.

    Where a lens is written, nothing stays of what the file says of another one.
    """
    raw = dict(experiment.read_config(path).raw) if path.exists() else {}
    old = (
        raw if "fx_px" in raw else raw.get("camera_config", {})
    )  # or a camera_config by itself, as calibrate writes it
    new = {**{key: old[key] for key in old if "lens_model" not in found or key not in OF_LENS}, **found}
    raw = new if "fx_px" in raw else {**raw, "camera_config": new}
    path.parent.mkdir(parents=True, exist_ok=True)
    experiment.write_config(path, raw)


def with_microphones(
    raw: Mapping[str, Any], positions: list[list[float]], sd_m: float, channels: list[dict[str, Any]] | None
) -> dict[str, Any]:
    """Return a config.json that reads `raw` with microphones as they were measured.

    Args:
        raw: what the file has.
        positions: (m, 3) m.
        sd_m: how well they are known.
        channels: what is wrong with the channels, as microphone_config.channels has it; None: nothing.
    """
    section = {key: value for key, value in raw["microphone_config"].items() if key != "channels"}
    listed = [
        {**old, "position": new} if isinstance(old, Mapping) else new
        for old, new in zip(section["mic_positions_m"], positions, strict=True)
    ]
    section |= {"mic_positions_m": listed, "calibration": {"sd_m": sd_m}}
    return {**raw, "microphone_config": section | ({"channels": channels} if channels else {})}
