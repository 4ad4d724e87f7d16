"""Where on the floor a pixel is: the importers of boxes ask it, since avcli scores people in metres."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avcli.formats.experiment import Camera, read_config


def places_below(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the places (n, 2) m on the floor that pixels (n, 2) of a camera show; NaN above the horizon."""
    rays = camera.lens.unproject(pixels) @ camera.T_room_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(rays[:, 2] < -1e-3, -camera.T_room_camera[2, 3] / rays[:, 2], np.nan)
    return camera.T_room_camera[:2, 3] + reach[:, None] * rays[:, :2]


@dataclass(frozen=True)
class Ground:
    """A floor under a picture: one of a calibrated camera, a homography, or a scale.

    Attributes:
        config: config.json of the calibrated camera.
        homography: (3, 3), of pixels to metres.
        scale: m of a pixel, where a camera looks straight down from far above.
    """

    config: Path | None = None
    homography: Path | None = None
    scale: float | None = None

    def places(self, pixels: np.ndarray) -> np.ndarray:
        """Return the places (n, 2) m of pixels (n, 2); NaN above the horizon.

        Raises:
            ValueError: the homography is not a matrix (3, 3).
        """
        pixels = np.asarray(pixels, float).reshape(-1, 2)
        if self.scale is not None:
            return pixels * [self.scale, -self.scale]  # y of a picture points down, y of a room up
        if self.homography is not None:
            matrix = np.loadtxt(self.homography)
            if matrix.shape != (3, 3):
                raise ValueError(f"{self.homography}: is no matrix of 3 rows and 3 columns")
            mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ matrix.T
            return mapped[:, :2] / mapped[:, 2:]
        return places_below(read_config(self.config or "").camera, pixels)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that tell the ground; one of them is needed."""
    ground = parser.add_mutually_exclusive_group(required=True)
    ground.add_argument("--config", type=Path, help="config.json with the calibrated camera")
    ground.add_argument("--homography", type=Path, help="text file of 3 x 3 numbers: pixels to m on the ground")
    ground.add_argument("--scale", type=float, help="m of a pixel, where the camera looks straight down from far above")


def ground_of(given: argparse.Namespace) -> Ground:
    """Return the ground that options tell."""
    return Ground(given.config, given.homography, given.scale)


def room_of(places: np.ndarray, margin: float = 1.0) -> tuple[np.ndarray, dict[str, Any]]:
    """Lay a room around places (n, 2) m: its corner (2,) m, and room_config.

    Raises:
        ValueError: no place is known.
    """
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        raise ValueError("no box stands on the ground: is the homography or the camera right?")
    corner = np.floor(places.min(axis=0) - margin)
    sides = np.ceil(places.max(axis=0) + margin) - corner
    return corner, {"room_dimensions_m": [*sides.tolist(), 3.0]}


def at_home(pixels: np.ndarray, ground: Ground) -> tuple[np.ndarray, dict[str, Any]]:
    """Places (n, 2) m in a room's frame, and config.json: the calibrated camera's, or a room around the places."""
    places = ground.places(pixels)
    if ground.config is not None:
        return places, dict(read_config(ground.config).raw)
    corner, room = room_of(places)
    return places - corner, {"room_config": room}
