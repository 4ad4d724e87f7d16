"""What stands around the people: the room, its doors, the microphones, and the camera with its exact lens."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import pi
from typing import Any

import numpy as np

from avcli import pose
from avcli.formats.experiment import Camera, Config, ConfigError

_ANGLES = 241
_TURNS = 72
_KERNEL_M, _PRIOR = 0.4, 0.02
"""How what happened in a cell counts for its neighbours in a picture of it, and events that the prior is worth."""


def surroundings(
    config: Config,
    furniture: Sequence[Mapping[str, Any]] = (),
    learnt: Mapping[str, Any] | None = None,
    sensor: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Describe room, microphones and camera for a page, as far as the config states them.

    Args:
        config: of the experiment.
        furniture: of each piece its "name" and its "outline", corners [x, y] in m.
        learnt: what avfuse has learnt of the room, as its file has it.
        sensor: whose camera took the pictures, see `Config.placed_camera`.
        say: is called with a sentence if something is missing or invalid.

    Returns:
        JSON's types, metres and pixels.
    """
    known: dict[str, Any] = {"furniture": list(furniture)}
    for read in (_room, _microphones, partial(_camera, sensor=sensor)):
        try:
            known |= read(config)
        except ConfigError as error:
            say(str(error))
    if learnt is not None:
        known["learnt"] = {key: _rates(learnt, key) for key in ("entries", "exits")} | {"area": learnt["area"]}
    return known


def _room(config: Config) -> dict[str, Any]:
    x, y, _ = config.room.dimensions.tolist()
    doors = []
    for door in config.room.fittings.doors:
        low, high = door["at_m"] - door["width_m"] / 2, door["at_m"] + door["width_m"] / 2
        at = {"x0": 0.0, "x1": x, "y0": 0.0, "y1": y}[door["wall"]]
        doors.append([at, low, at, high] if door["wall"][0] == "x" else [low, at, high, at])
    return {"room": config.room.dimensions.tolist(), "doors": doors}


def _microphones(config: Config) -> dict[str, Any]:
    if "microphone_config" not in config.raw:
        return {}
    return {"microphones": config.microphones.positions.round(3).tolist()}


def _camera(config: Config, sensor: str | None) -> dict[str, Any]:
    camera = config.placed_camera(sensor)
    if camera is None:
        return {}
    return {
        "camera": {
            "position": camera.T_room_camera[:3, 3].round(4).tolist(),
            "T_camera_room": pose.inverse(camera.T_room_camera)[:3].round(9).tolist(),
            "size": [camera.width_px, camera.height_px],
            "lens": lens_table(camera),
            "reach": _reach(camera).round(2).tolist(),
        }
    }


def lens_table(camera: Camera) -> dict[str, Any]:
    """Sample the lens, so that a page projects points without knowing its model.

    Args:
        camera: of the experiment.

    Returns:
        "step" in rad, "scale" and "centre" in px, and "along" and "across" (turns × angles): a ray at the angle θ from
        the axis and the turn φ about it is seen at centre + scale · R(φ) [along, across]. Between the samples linear
        interpolation is exact to about 0.05 px. A lens that is alike all around has one turn.
    """
    theta = np.linspace(0, min(camera.theta_max, pi), _ANGLES)
    phi = np.linspace(0, 2 * pi, _TURNS, endpoint=False)
    scale = np.array([camera.lens.fx, camera.lens.fy])
    centre = camera.lens.project(np.array([[0.0, 0.0, 1.0]]))[0]
    rays = np.stack(
        [
            np.sin(theta) * np.cos(phi)[:, None],
            np.sin(theta) * np.sin(phi)[:, None],
            np.broadcast_to(np.cos(theta), (_TURNS, _ANGLES)),
        ],
        axis=-1,
    )
    place = (camera.lens.project(rays.reshape(-1, 3)).reshape(_TURNS, _ANGLES, 2) - centre) / scale
    u, v, c, s = place[..., 0], place[..., 1], np.cos(phi)[:, None], np.sin(phi)[:, None]
    along, across = u * c + v * s, v * c - u * s
    same = np.ptp(along[:, :-1], axis=0).max() < 1e-5 and np.abs(across[:, :-1]).max() < 1e-5
    if same:
        along, across = along[:1], across[:1] * 0
    return {
        "step": float(theta[1]),
        "scale": scale.tolist(),
        "centre": centre.round(3).tolist(),
        "along": [[round(r, 6) if np.isfinite(r) else None for r in row] for row in along.tolist()],
        "across": [[round(r, 6) if np.isfinite(r) else None for r in row] for row in across.tolist()],
    }


def _reach(camera: Camera) -> np.ndarray:
    """Outline (n, 2) in m of what the picture shows of the floor; where it shows the horizon, points far away."""
    turns = np.linspace(0, 2 * pi, 180, endpoint=False)
    theta = np.linspace(0.005, min(camera.theta_max, pi) - 1e-6, 300)
    t, p = np.meshgrid(theta, turns)
    rays = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    pixels = camera.lens.project(rays.reshape(-1, 3)).reshape(*t.shape, 2)
    limit = np.array([camera.width_px, camera.height_px]) - 0.5
    seen = ((pixels >= -0.5) & (pixels <= limit)).all(axis=-1)
    if camera.circle is not None:
        seen &= np.linalg.norm(pixels - camera.circle[:2], axis=-1) <= camera.circle[2]
    last = np.cumprod(seen, axis=1).sum(axis=1).clip(1) - 1
    edge = rays[np.arange(len(turns)), last] @ camera.T_room_camera[:3, :3].T
    origin = camera.T_room_camera[:3, 3]
    far = 100.0 / np.maximum(np.hypot(edge[:, 0], edge[:, 1]), 1e-9)
    with np.errstate(divide="ignore"):
        down = np.where(edge[:, 2] < -1e-6, -origin[2] / np.minimum(edge[:, 2], -1e-6), far)
    return origin[:2] + np.minimum(down, far)[:, None] * edge[:, :2]


def _rates(learnt: Mapping[str, Any], key: str) -> list[list[float]]:
    """How much more often than expected it happened about each cell, along x, then y; 1 where nothing was learnt."""
    import cv2

    x0, _, x1, _ = learnt["area"]
    happened, expected = (np.array(learnt[key][part], dtype=float) for part in ("happened", "expected"))
    sigma = _KERNEL_M * happened.shape[0] / max(x1 - x0, 1e-9)
    happened, expected = (cv2.GaussianBlur(part, (0, 0), max(sigma, 0.5)) for part in (happened, expected))
    return ((happened + _PRIOR) / (expected + _PRIOR)).round(3).tolist()
