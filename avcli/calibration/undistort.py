"""Pictures without the fisheye: perspective, cylindrical, or the whole field at once."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from avcli.calibration.camera import KnownCamera
from avcli.calibration.circle import Circle
from avcli.calibration.settings import ProjectionSettings
from avcli.formats.footage import Picture
from avcli.lens import Lens
from avcli.pose import angle_from_axis

DEFAULTS = ProjectionSettings()
_WIDEST = np.deg2rad(80.0)
"""A perspective picture stretches by 1 / cos² of the angle; beyond this half angle there is nothing to see."""


@dataclass(frozen=True)
class Straightened:
    """Where each pixel of a straightened picture comes from.

    Attributes:
        sources: (height, width, 2) px in the fisheye picture; NaN where the lens sees nothing.
        projection: see ProjectionSettings.
        fov: rad, from the left edge to the right.
        focal_px: px; of a perspective picture its pinhole's focal length, of the others px a radian.
        is_cut: whether something that the fisheye picture shows stays black, since the lens is not trusted there.
    """

    sources: np.ndarray
    projection: str
    fov: float
    focal_px: float
    is_cut: bool = False

    def camera_config(self) -> dict:
        """Describe the straightened pictures; a perspective one as a camera_config of config.json."""
        height, width = self.sources.shape[:2]
        found = {
            "projection": self.projection,
            "fov_deg": float(np.rad2deg(self.fov)),
            "image_width_px": width,
            "image_height_px": height,
        }
        if self.projection != "perspective":
            return {**found, "px_per_rad": self.focal_px}
        return {
            **found,
            "lens_model": "brown_conrady",
            "fx_px": self.focal_px,
            "fy_px": self.focal_px,
            "cx_px": (width - 1) / 2,
            "cy_px": (height - 1) / 2,
        }


def straighten(
    lens: Lens,
    source_size: tuple[int, int],
    size: tuple[int, int],
    settings: ProjectionSettings = DEFAULTS,
    theta_max: float = np.inf,
    circle: Circle | None = None,
) -> Straightened:
    """Map a straightened picture's pixels to the fisheye picture's.

    "perspective" keeps straight lines straight; "cylindrical" keeps upright lines straight and goes around further;
    "whole" shows azimuth and elevation about the camera (equirectangular), past 90 degrees too.

    Args:
        lens: a model of avcli.lens.
        source_size, size: width and height of the fisheye and of the straightened picture, px.
        settings: the projection and its width.
        theta_max: rad; beyond it the lens is not trusted and the picture stays black.
        circle: where light reaches the fisheye picture; what lies outside stays black.

    Raises:
        ValueError: the field of view does not suit the projection.
    """
    projection, fov = settings.projection, None if settings.fov_deg is None else float(np.deg2rad(settings.fov_deg))
    limit = np.pi if projection == "perspective" else 2 * np.pi
    if fov is not None and not 0 < fov <= (0.99 * limit if projection == "perspective" else limit):
        most = 178 if projection == "perspective" else 360
        raise ValueError(f"a {projection} picture cannot be {np.rad2deg(fov):.0f} degrees wide, only up to {most}")
    if fov is None:
        if projection == "perspective":
            fov = 2 * np.arctan(_perspective_reach(lens, source_size, size, settings.balance, theta_max))
        else:
            fov = min(2 * min(_reach(lens, source_size), theta_max), 2 * np.pi)
    width, height = size
    x, y = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    if projection == "perspective":
        focal = width / 2 / np.tan(fov / 2)
        rays = np.stack([*np.meshgrid(x / focal, y / focal), np.ones((height, width))], -1)
    else:
        focal = width / fov
        azimuth, down = np.meshgrid(x / focal, y / focal)
        if projection == "cylindrical":
            rays = np.stack([np.sin(azimuth), down, np.cos(azimuth)], -1)
        else:
            elevation = np.clip(down, -np.pi / 2, np.pi / 2)
            rays = np.stack(
                [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], -1
            )
            rays[np.abs(down) > np.pi / 2] = np.nan
    flat = rays.reshape(-1, 3)
    sources = lens.project(flat)
    shown = (sources >= -0.5).all(1) & (sources <= np.array(source_size) - 0.5).all(1)
    if circle is not None:
        sources[~circle.holds(sources)] = np.nan
        shown &= np.isfinite(sources).all(1)
    outside = angle_from_axis(flat) > theta_max
    sources[outside] = np.nan
    cut = bool((shown & outside).any())
    return Straightened(sources.reshape(height, width, 2), projection, float(fov), float(focal), cut)


def straightened(
    pictures: Iterable[Picture], camera: KnownCamera, straight: Straightened, skip: Callable[[str], None] | None = None
) -> Iterator[tuple[Picture, np.ndarray]]:
    """Straighten the pictures of a camera one after another.

    Args:
        pictures: as the camera took them.
        camera: the camera.
        straight: see `straighten`.
        skip: gets a sentence for each picture that is not of the camera's size, which is then left out.

    Returns:
        each picture, and what it becomes (height, width[, channels]).

    Raises:
        ValueError: a picture is not of the camera's size; with `skip`, none is.
    """
    shown = 0
    for picture in pictures:
        try:
            camera.require_size((picture.image.shape[1], picture.image.shape[0]), picture.name)
        except ValueError as error:
            if skip is None:
                raise
            skip(str(error))
            continue
        shown += 1
        yield picture, resample(picture.image, straight)
    if skip and not shown:
        raise ValueError(f"no picture is of the size of {camera.name}, {camera.size[0]} × {camera.size[1]} px")


def resample(image: np.ndarray, straightened: Straightened) -> np.ndarray:
    """Straighten a picture (height, width[, channels]) uint8 or uint16; black where the lens sees nothing."""
    import cv2

    at = np.nan_to_num(straightened.sources, nan=-1e4).astype(np.float32)
    return cv2.remap(
        image, at[:, :, 0], at[:, :, 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0, 0)
    )


def _rim(size: tuple[int, int]) -> np.ndarray:
    """Pixels along the border of a picture, (n, 2)."""
    width, height = size
    x, y = np.linspace(0, width - 1, 101), np.linspace(0, height - 1, 101)
    return np.concatenate(
        [
            np.stack([x, 0 * x], -1),
            np.stack([x, 0 * x + height - 1], -1),
            np.stack([0 * y, y], -1),
            np.stack([0 * y + width - 1, y], -1),
        ]
    )


def _reach(lens: Lens, source_size: tuple[int, int]) -> float:
    """Largest angle that the picture shows, rad."""
    rays = lens.unproject(_rim(source_size))
    if not np.isfinite(rays).all():
        return float(lens.theta_max)
    return float(angle_from_axis(rays).max())


def _perspective_reach(
    lens: Lens, source_size: tuple[int, int], size: tuple[int, int], balance: float, theta_max: float
) -> float:
    """Half width of a perspective picture at distance 1: between the largest that is filled and all that is shown."""
    rim = _rim(size) - (np.array(size) - 1) / 2
    plane = np.column_stack([rim / (size[0] / 2), np.ones(len(rim))])

    def filled(reach: float) -> bool:
        if np.arctan(reach * np.hypot(*plane[:, :2].T).max()) > theta_max:
            return False
        seen = lens.project(plane * [reach, reach, 1])
        with np.errstate(invalid="ignore"):
            return bool(((seen >= -0.5) & (seen <= np.array(source_size) - 0.5)).all())

    low, high = 0.0, float(np.tan(_WIDEST))
    inner = high
    if not filled(high):
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if filled(middle) else (low, middle)
        inner = low
    rays = lens.unproject(_rim(source_size))
    theta = angle_from_axis(rays)
    outer = np.tan(_WIDEST)
    shown = np.isfinite(theta) & (theta < _WIDEST)
    if shown.all():
        aspect = size[1] / size[0]
        outer = max(np.abs(rays[:, 0] / rays[:, 2]).max(), np.abs(rays[:, 1] / rays[:, 2]).max() / aspect)
    if inner <= 0:
        inner = outer / 10
    return float(inner * (max(outer, inner) / inner) ** balance)
