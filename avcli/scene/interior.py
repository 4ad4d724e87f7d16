"""What a room that states its materials, windows or lamps is drawn with: the looks of its surfaces, and its light."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from avcli import materials
from avcli.formats.experiment import Room
from avcli.scene import fittings, look_shaders
from avcli.scene.canvas import linear
from avcli.scene.furniture import MATERIALS, Solids
from avcli.scene.light_shaders import MOST_LIGHTS, Shaders

SHADOW_REACH_M = 1.6
"""Around a person, where their shadow has faded."""
_OWN_SECOND = frozenset(
    {"brick", "slats", "glass", "daylight", "blinds", "perforated", "paper", "whiteboard", "screen", "acoustic_tile"}
)
"""Patterns whose second colour is another thing's (mortar, ink, a gap), so that it does not follow the first."""
_SKY = 2.0  # light of a window's area against that of a lamp
_SUN = 8.0  # light of the sun against the brightest place of a plain room; seen through haze, as cameras can hold it
_PLAIN_FLOOR = 0.37  # mean albedo of a plain room's floor
_ADAPTS = 0.8  # share of a room's brightness, in stops, that a camera's exposure takes back
_RAYS = 12  # to all lamps and windows from one place
_GLINTS = 6  # of the lamps that people reflect, at most
_PROBE_M, _MOST_PROBES = 0.3, 40


class Interior:
    """A room's looks and light.

    Args:
        room: with its surfaces and fittings.
        solids: all that stands in it; their materials decide which patterns are painted.

    Attributes:
        looks: (rows, 3, 4), a table for the shaders: six faces, then every material.
        uniforms: of the lamps, by their names in the shaders.
        cells: (3,) number of cells of the grid of light in the air.
    """

    def __init__(self, room: Room, solids: Solids) -> None:
        self._room, self._solids = room, solids
        self.looks = _looks(room.surfaces)
        lamps = _lamps(room)
        middles, us, vs, lights = (np.array(column, float) for column in zip(*lamps, *_windows(room), strict=True))
        self._windows_from = len(lamps)
        self.cells = np.clip(np.round(room.dimensions / _PROBE_M), 2, _MOST_PROBES)
        area = 4 * np.linalg.norm(np.cross(us, vs), axis=1, keepdims=True)
        strength = lights * np.where(np.arange(len(lights))[:, None] < len(lamps), 1.0, area / 5.4)
        ambient = _bounced(room, self.looks, strength.sum(0) / 2.0)
        sun = room.fittings.sun_deg
        azimuth, elevation = np.deg2rad(sun if sun is not None else (0.0, -90.0))
        flat = np.cos(elevation)
        self.uniforms: dict[str, Any] = {
            "lamps": _padded(middles), "lamp_u": _padded(us), "lamp_v": _padded(vs), "lamp_light": _padded(lights),
            "lamp_count": len(middles), "first_window": len(lamps),
            "glints": min(len(middles), _GLINTS),
            "ambient": tuple(ambient), "outside": room.fittings.daylight, "cells": tuple(self.cells),
            "sun_way": (flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)),
            "sun_light": tuple(_SUN * room.fittings.daylight * np.array([1.0, 0.93, 0.80])),
            "exposure": self._exposure(middles, us, vs, lights, ambient), "reach": SHADOW_REACH_M,
        }  # fmt: skip

    @cached_property
    def shaders(self) -> Shaders:
        """The shaders that draw it."""
        surfaces, fitted = self._room.surfaces, self._room.fittings
        used = {MATERIALS[number] for number in np.unique(self._solids.material)}
        faces = zip(surfaces.materials, surfaces.stated, strict=True) if surfaces is not None else ()
        used |= {material.name for material, stated in faces if stated}
        sun = fitted.sun_deg is not None and fitted.sun_deg[1] > 0 and bool(fitted.windows) and fitted.daylight > 0
        patterns = {materials.table()[name].look.pattern for name in used}
        return Shaders(patterns, int(np.clip(_RAYS // self.uniforms["lamp_count"], 1, 4)), sun=sun)

    def _exposure(
        self, middles: np.ndarray, us: np.ndarray, vs: np.ndarray, lights: np.ndarray, ambient: np.ndarray
    ) -> float:
        """What a camera that adapts multiplies the light with: 1 where the floor is as bright as a plain room's."""
        x, y, _ = self._room.dimensions
        grid = np.stack(np.meshgrid([0.2 * x, 0.5 * x, 0.8 * x], [0.2 * y, 0.5 * y, 0.8 * y]), -1).reshape(-1, 2)
        floor = np.concatenate([grid, np.zeros((9, 1))], 1)
        seen = [_luma(arriving_light(floor, middles, us, vs, lights, self._windows_from) + 0.58 * ambient)]
        brightness = float(np.exp(np.log(np.maximum(seen, 1e-4)).mean()))
        albedo = _mean_albedo(self._room, self.looks)
        level = 1.3 * brightness * (float(_luma(albedo)) / _PLAIN_FLOOR) ** 0.8
        return float(np.clip(level, 1e-3, 1e3) ** -_ADAPTS)


def interior(room: Room, solids: Solids) -> Interior | None:
    """Return the interior of a room, None where it states nothing and its furniture is of plain materials alone."""
    stated = room.surfaces is not None or room.fittings != type(room.fittings)()
    patterns = {materials.table()[MATERIALS[number]].look.pattern for number in set(solids.material.tolist())}
    return Interior(room, solids) if stated or patterns & set(look_shaders.PATTERNS) else None


def arriving_light(
    places: np.ndarray, middles: np.ndarray, us: np.ndarray, vs: np.ndarray, lights: np.ndarray, windows_from: int
) -> np.ndarray:
    """Return the light on a level place that nothing shades, as the shaders compute it.

    Args:
        places: (n, 3) m.
        middles, us, vs: (m, 3) m, of lamps and windows, and their half edges.
        lights: (m, 3) of each.
        windows_from: index of the first window.

    Returns:
        (n, 3) linear light.
    """
    way = middles - places[:, None]
    square = np.maximum((way**2).sum(-1), 1e-6)
    cosine = way[..., 2] / np.sqrt(square)
    face = np.cross(us, vs)
    size = np.linalg.norm(face, axis=-1)
    leaving = np.maximum(-(way * face).sum(-1) / np.sqrt(square) / np.maximum(size, 1e-9), 0.0)
    lamp = 2.7 * np.maximum(cosine + 0.08, 0.0) / (square + 1.5)
    window = 4 * size * np.maximum(cosine, 0.0) * leaving / (square + size)
    return np.where(np.arange(len(middles)) < windows_from, lamp, window) @ lights


_Light = tuple[Any, Any, Any, Any]
"""Middle, two half edges in m, and light."""


def _lamps(room: Room) -> list[_Light]:
    x, y, z = room.dimensions
    disc = 0.31  # half the edge of a square as large as the disc of a plain room
    if room.fittings.lights is None:
        return [([share * x, 0.5 * y, z], [disc, 0, 0], [0, -disc, 0], [1.0, 1.0, 1.0]) for share in (0.28, 0.72)]
    rows: list[_Light] = []
    for lamp in room.fittings.lights:
        top = z if lamp["height_m"] is None else lamp["height_m"]
        wide, deep = lamp["size_m"] if lamp["shape"] == "panel" else [0.886 * lamp["size_m"][0]] * 2
        light = lamp["strength"] * linear(np.array(lamp["color"]))
        middle = [*lamp["position_m"], top - fittings.LAMP_DEPTH_M]
        rows.append((middle, [wide / 2, 0, 0], [0, -deep / 2, 0], light))
    return rows or [([0.5 * x, 0.5 * y, z], [disc, 0, 0], [0, -disc, 0], [0.0, 0.0, 0.0])]


def _padded(rows: np.ndarray) -> list[list[float]]:
    return np.concatenate([rows, np.zeros((MOST_LIGHTS - len(rows), 3))]).tolist()


def _windows(room: Room) -> list[_Light]:
    rows: list[_Light] = []
    for window in room.fittings.windows:
        origin, (along, up, inward) = fittings.wall_axes(window["wall"], room.dimensions)
        middle = origin + window["at_m"] * along + (window["sill_m"] + window["height_m"] / 2) * up
        u, v = along * window["width_m"] / 2, up * window["height_m"] / 2
        u = u if np.dot(np.cross(u, v), inward) > 0 else -u
        light = _SKY * room.fittings.daylight * np.array([0.90, 0.97, 1.08])
        rows.append((middle + 0.01 * inward, u, v, light))
    return rows


def _looks(surfaces: materials.Surfaces | None) -> np.ndarray:
    """The table of looks: ground + pattern, second + whether a factor, size + contrast + gloss.

    A pattern is -1 for a face that states none, and -2 and below for a plain material: -2 - its number.
    """
    table = materials.table()
    rows = np.zeros((6 + len(MATERIALS), 3, 4))
    rows[:, 0, 3] = -1.0
    for number, name in enumerate(MATERIALS):
        _fill(rows[6 + number], table[name], None)
    if surfaces is not None:
        for face, (material, colour, stated) in enumerate(
            zip(surfaces.materials, surfaces.colors, surfaces.stated, strict=True)
        ):
            if stated:
                _fill(rows[face], material, colour)
    return rows


def _fill(row: np.ndarray, material: materials.Material, colour: tuple[float, float, float] | None) -> None:
    look = material.look
    ground, second = linear(np.array(look.color)), linear(np.array(look.second))
    if look.pattern not in _OWN_SECOND:
        row[1] = [*(second / np.maximum(ground, 1e-3)), 1.0]
    else:
        row[1] = [*second, 0.0]
    row[0, :3] = ground if colour is None else linear(np.array(colour))
    known = look.pattern in look_shaders.PATTERNS
    row[0, 3] = look_shaders.PATTERNS.index(look.pattern) if known else -2.0 - MATERIALS.index(material.name)
    row[2] = [*look.size_m, look.contrast, look.gloss]


_PLAIN_ALBEDO = np.array([[0.065, 0.075, 0.10]] * 4 + [[0.40, 0.375, 0.345]])
"""Colours of the walls and the floor of a plain room, linear."""


def _mean_albedo(room: Room, looks: np.ndarray) -> np.ndarray:
    """The mean colour of the walls and the floor, (3,) linear, half of which is the floor."""
    stated = np.array(room.surfaces.stated if room.surfaces is not None else [False] * 6)[:5]
    return _half_floor(np.where(stated[:, None], looks[:5, 0, :3], _PLAIN_ALBEDO))


def _half_floor(albedo: np.ndarray) -> np.ndarray:
    return 0.5 * albedo[4] + 0.5 * albedo[:4].mean(0)


def _bounced(room: Room, looks: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """Light that comes from everywhere, (3,): more in a room of bright surfaces and of many lamps, in their colour.

    `strength` is that of all lamps, (3,), 1 in a plain room.
    """
    floor_area = max(room.dimensions[0] * room.dimensions[1] / 21.7, 0.2)  # of the laboratory
    albedo, plain = _mean_albedo(room, looks), _half_floor(_PLAIN_ALBEDO)
    tone = (0.4 + 0.6 * albedo / plain) / (0.4 + 0.6 * _luma(albedo / plain))
    level = (0.5 + 0.5 * np.clip(_luma(albedo) / _luma(plain), 0.3, 2.2)) * (0.03 + 0.97 * strength / floor_area**0.7)
    return np.clip(level * tone, 0.02, 50.0)


def _luma(colour: np.ndarray) -> np.ndarray:
    return colour @ np.array([0.30, 0.59, 0.11])
