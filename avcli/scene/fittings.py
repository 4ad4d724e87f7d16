"""What is fitted into a room, as solids: doors, windows, lamps and skirting boards."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from avcli import materials
from avcli.formats.experiment import Room
from avcli.scene import furniture
from avcli.scene.furniture import BOX, CYLINDER, MATERIALS, Solids

LAMP_DEPTH_M = 0.05
_FRAME, _WHITE, _STEEL = (0.90, 0.90, 0.88), (1.0, 1.0, 1.0), (0.66, 0.67, 0.68)
_Part = tuple[Sequence[float], Sequence[float], str, Sequence[float]]
"""Middle and size in m, along a wall, up and into the room; material; colour."""


def wall_axes(face: str, dimensions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where a wall begins, (3,) m, and its axes: along the wall, up, and into the room, (3, 3)."""
    axis, far = "xy".index(face[0]), face[1] == "1"
    origin, inward = np.zeros(3), np.zeros(3)
    origin[axis], inward[axis] = dimensions[axis] * far, -1.0 if far else 1.0
    along = np.zeros(3)
    along[1 - axis] = 1.0
    return origin, np.stack([along, [0.0, 0.0, 1.0], inward])


def solids(room: Room) -> Solids:
    """Return the solids of a room's doors, windows, lamps and skirting boards."""
    fitted = room.fittings
    parts: list[Solids] = []
    for item in fitted.doors:
        parts += _on_wall(item["wall"], room.dimensions, _door(item))
    for item in fitted.windows:
        parts += _on_wall(item["wall"], room.dimensions, _window(item))
    if fitted.skirting_m > 0:
        for face in materials.FACES[:4]:
            parts += _on_wall(face, room.dimensions, _skirting(face, room))
    parts += [_lamp(lamp, room.dimensions[2]) for lamp in fitted.lights or ()]
    return furniture.join(parts)


def _on_wall(face: str, dimensions: np.ndarray, parts: Iterator[_Part]) -> list[Solids]:
    origin, own = wall_axes(face, dimensions)
    axes = own if np.linalg.det(own) > 0 else own * [[-1.0], [1.0], [1.0]]
    return [
        furniture.box(origin + np.array(middle) @ own, axes, np.array(size), material, np.array(colour))
        for middle, size, material, colour in parts
    ]


def _door(item: Mapping[str, Any]) -> Iterator[_Part]:
    wide, high, at = item["width_m"], item["height_m"], item["at_m"]
    colour = item["color"] or materials.table()[item["material"]].look.color
    yield (at, high / 2, 0.01), (wide, high, 0.02), item["material"], colour
    for side in (-1, 1):
        yield (at + side * (wide / 2 + 0.03), high / 2 + 0.03, 0.02), (0.06, high + 0.06, 0.04), "paint", _FRAME
    yield (at, high + 0.03, 0.02), (wide, 0.06, 0.04), "paint", _FRAME
    grip = at + 0.5 * wide - 0.08
    yield (grip, 1.05, 0.045), (0.02, 0.02, 0.05), "steel", _STEEL
    yield (grip - 0.05, 1.05, 0.07), (0.13, 0.02, 0.015), "steel", _STEEL


def _window(item: Mapping[str, Any]) -> Iterator[_Part]:
    wide, high, sill = item["width_m"], item["height_m"], item["sill_m"]
    at, middle = item["at_m"], sill + high / 2
    yield (at, middle, 0.004), (wide, high, 0.008), "window", _WHITE
    for side in (-1, 1):
        yield (at + side * (wide / 2 - 0.025), middle, 0.025), (0.05, high, 0.05), "paint", _FRAME
        yield (at, middle + side * (high / 2 - 0.025), 0.025), (wide, 0.05, 0.05), "paint", _FRAME
    yield (at, middle, 0.02), (0.05, high, 0.04), "paint", _FRAME
    yield (at, max(sill - 0.015, 0.015), 0.09), (wide + 0.1, 0.03, 0.18), "paint", _FRAME


def _skirting(face: str, room: Room) -> Iterator[_Part]:
    """The boards between a wall's doors."""
    length, high = room.dimensions[1 if face[0] == "x" else 0], room.fittings.skirting_m
    doors = sorted(
        (door["at_m"] - door["width_m"] / 2 - 0.06, door["at_m"] + door["width_m"] / 2 + 0.06)
        for door in room.fittings.doors
        if door["wall"] == face
    )
    start = 0.0
    for left, right in [*doors, (length, length)]:
        if left > start:
            yield ((start + left) / 2, high / 2, 0.0075), (left - start, high, 0.015), "paint", _FRAME
        start = max(start, right)


def _lamp(lamp: Mapping[str, Any], ceiling: float) -> Solids:
    """A lamp's body; its light comes from its lower face."""
    (x, y), (wide, deep) = lamp["position_m"], lamp["size_m"]
    top = ceiling if lamp["height_m"] is None else lamp["height_m"]
    half = np.array([wide, deep if lamp["shape"] == "panel" else wide, LAMP_DEPTH_M]) / 2
    kind = BOX if lamp["shape"] == "panel" else CYLINDER
    return Solids(
        np.array([kind]), np.array([[x, y, top - LAMP_DEPTH_M / 2]]), np.eye(3)[None], half[None],
        np.array([MATERIALS.index("lamp")]), np.array([lamp["color"]]),
    )  # fmt: skip
