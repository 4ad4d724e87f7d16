"""Ceiling cameras drawn by chance: the thesis's two lenses, and equidistant and equisolid fisheyes of any field."""

import math
from typing import Any

import numpy as np

from avcli.scene.settings import LENSES

_SQUARES = (640, 1024, 1280)  # px
_WIDE = ((1280, 720), (1920, 1080), (1280, 960))
_FIELD_DEG = (150.0, 220.0)
_BELOW_CEILING_M = (0.05, 0.35)
_HEIGHT_M = (2.2, 8.0)
_EQUISOLID = (-1 / 24, 1 / 1920, -1 / 322560, 1 / 92897280)
"""2 sin(theta / 2) as a series in theta: below 1e-7 of its value up to 110 degrees from the axis."""


def random_camera(
    generator: np.random.Generator,
    room: tuple[float, float, float],
    known: dict[str, dict[str, Any]],
    lens: str | None = None,
    height: float | None = None,
) -> dict[str, Any]:
    """Draw a camera that looks down from the ceiling.

    Args:
        generator: of all chance.
        room: (3,) m.
        known: camera_config of the lenses "real" and "thesis".
        lens: one of settings.LENSES; None: drawn.
        height: of the camera, m; None: drawn.

    Returns:
        A camera_config.
    """
    g, (x, y, z) = generator, room
    drawn = str(g.choice(LENSES, p=[0.2, 0.1, 0.4, 0.3]))
    lens = drawn if lens is None else lens
    below = float(np.clip(z - g.uniform(*_BELOW_CEILING_M), min(_HEIGHT_M[0], z - 0.02), _HEIGHT_M[1]))
    place = [float(side * g.uniform(0.4, 0.6)) for side in (x, y)]
    # The longer side of the picture lies along the longer side of the room, more or less.
    yaw = (0.0 if x >= y else 90.0) + 180.0 * int(g.integers(2)) + float(np.clip(g.normal(0, 6), -20, 20))
    tilt = float(np.clip(g.normal(0, 1.5), -5, 5))
    optics = _known(g, known[lens]) if lens in known else _fisheye(g, lens)
    return {
        "camera_position_m": [*(round(v, 3) for v in place), round(below, 3) if height is None else height],
        "camera_rotation_deg": [round(90.0 - tilt, 2), round(yaw % 360, 2), 0.0],
        "frame_rate_hz": 10.0,
        **optics,
    }


def _known(g: np.random.Generator, camera: dict[str, Any]) -> dict[str, Any]:
    """A lens of the thesis, with a sensor of as many pixels or fewer."""
    scale = float(g.choice([1.0, 2 / 3, 0.5]))
    changed = {key: round(camera[key] * scale, 4) for key in ("fx_px", "fy_px")}
    changed |= {key: round((camera[key] + 0.5) * scale - 0.5, 4) for key in ("cx_px", "cy_px")}
    return {**camera, **changed, **{key: round(camera[key] * scale) for key in ("image_width_px", "image_height_px")}}


def _fisheye(g: np.random.Generator, lens: str) -> dict[str, Any]:
    """A lens whose circle lies in a square or a wide picture, whole, cut on two sides, or beyond the corners."""
    widest = math.radians(g.uniform(*_FIELD_DEG)) / 2
    form = str(g.choice(["square", "whole", "cut", "full"], p=[0.4, 0.15, 0.25, 0.2]))
    if form == "square":
        width = height = int(g.choice(_SQUARES))
    else:
        width, height = (int(v) for v in _WIDE[int(g.integers(len(_WIDE)))])
    span = {"cut": width, "full": math.hypot(width, height)}.get(form, min(width, height))
    radius = 0.5 * span * g.uniform(0.93, 1.0)
    reach = widest if lens == "equidistant" else 2 * math.sin(widest / 2)
    cx, cy = ((side - 1) / 2 + g.normal(0, 0.006) * side for side in (width, height))
    focal = round(radius / reach, 3)
    terms = (0.0, 0.0, 0.0, 0.0) if lens == "equidistant" else _EQUISOLID
    optics = {
        "lens_model": "kannala_brandt", "fx_px": focal, "fy_px": focal, "cx_px": round(cx, 2), "cy_px": round(cy, 2),
        **{f"k{k + 1}": value for k, value in enumerate(terms)},
        "image_width_px": width, "image_height_px": height, "theta_max_valid_deg": round(math.degrees(widest), 3),
    }  # fmt: skip
    if form != "full":
        optics["image_circle_px"] = [round(cx, 2), round(cy, 2), round(radius, 2)]
    return optics
