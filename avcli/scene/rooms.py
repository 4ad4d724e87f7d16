"""Rooms drawn by chance: their kind, their size by the number of people, their surfaces and doors."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

Size = tuple[float, float, float]
_ENDS_M = 3.0, 30.0  # shortest and longest side


@dataclass(frozen=True)
class Kind:
    """A kind of room.

    Attributes:
        area: m², least and most that is drawn for few people.
        each: m² for each person.
        height: m, least and most.
        long: longer over shorter side, least and most.
        narrow: m, most of the shorter side.
        floors, walls, ceilings: materials.
        windows: how many, least and most.
    """

    area: tuple[float, float]
    each: float
    height: tuple[float, float]
    long: tuple[float, float]
    floors: tuple[str, ...]
    walls: tuple[str, ...]
    ceilings: tuple[str, ...]
    windows: tuple[int, int]
    narrow: float = 30.0


KINDS: dict[str, Kind] = {
    "office": Kind((16, 60), 7.0, (2.5, 3.2), (1.0, 2.0),
                   ("carpet_tile", "carpet", "linoleum", "laminate"), ("plasterboard", "plaster", "wallpaper"),
                   ("acoustic_tile", "ceiling_plaster", "perforated_gypsum"), (1, 3)),
    "meeting": Kind((14, 40), 3.6, (2.5, 3.4), (1.0, 1.8),
                    ("carpet", "carpet_tile", "parquet", "wood_floor"), ("plasterboard", "wood_panel", "plaster"),
                    ("acoustic_tile", "perforated_gypsum"), (0, 3)),
    "corridor": Kind((18, 60), 4.0, (2.4, 3.2), (2.5, 8.0),
                     ("linoleum", "vinyl_tile", "terrazzo", "ceramic_tile"), ("plaster", "brick", "painted_brick"),
                     ("acoustic_tile", "ceiling_plaster"), (0, 2), narrow=4.0),
    "hall": Kind((70, 300), 4.0, (3.5, 8.5), (1.0, 2.0),
                 ("parquet", "terrazzo", "marble", "wood_floor"), ("plaster", "wood_panel", "brick", "curtain"),
                 ("ceiling_plaster", "perforated_gypsum", "metal_ceiling"), (0, 6)),
    "workshop": Kind((25, 150), 8.0, (3.0, 6.0), (1.0, 2.2),
                     ("concrete", "rough_concrete", "rubber"), ("block", "brick", "concrete", "painted_brick"),
                     ("metal_ceiling", "concrete"), (0, 4)),
    "living": Kind((14, 45), 4.5, (2.35, 3.0), (1.0, 1.7),
                   ("wood_floor", "laminate", "carpet", "ceramic_tile"), ("wallpaper", "plaster", "stucco"),
                   ("ceiling_plaster",), (1, 3)),
}  # fmt: skip
"""The kinds of rooms by name."""

_TONES = {
    "walls": ((0.93, 0.92, 0.89), (0.86, 0.85, 0.80), (0.74, 0.80, 0.83), (0.82, 0.76, 0.66), (0.62, 0.68, 0.62),
              (0.80, 0.66, 0.58), (0.52, 0.58, 0.66)),
    "floors": ((0.34, 0.35, 0.37), (0.45, 0.40, 0.34), (0.24, 0.28, 0.36), (0.55, 0.52, 0.48), (0.40, 0.30, 0.26)),
}  # fmt: skip
_PAINTABLE = ("plaster", "plasterboard", "wallpaper", "stucco", "painted_brick")
_DYED = ("carpet", "carpet_tile", "linoleum", "rubber", "curtain")


def random_kind(generator: np.random.Generator, people: int) -> str:
    """Draw a kind of room that holds so many people."""
    weights = np.array([1.0 if people * kind.each <= 2.5 * kind.area[1] else 0.0 for kind in KINDS.values()])
    weights[list(KINDS).index("hall")] = 1.0 if people > 4 else 0.5
    return str(generator.choice(list(KINDS), p=weights / weights.sum()))


def random_size(generator: np.random.Generator, name: str, people: int) -> Size:
    """Draw the size of a room of some kind for so many people: x, y and z, m."""
    kind, g = KINDS[name], generator
    area = max(float(np.exp(g.uniform(*np.log(kind.area)))), people * kind.each)
    short = float(np.clip(np.sqrt(area / g.uniform(*kind.long)), _ENDS_M[0], min(kind.narrow, _ENDS_M[1])))
    long = float(np.clip(area / short, short, _ENDS_M[1]))
    short = float(np.clip(area / long, _ENDS_M[0], _ENDS_M[1]))  # where the longer side was cut
    x, y = (long, short) if g.random() < 0.5 else (short, long)
    # Large rooms are high.
    low, high = kind.height
    z = low + (high - low) * g.uniform(0, 1) * min(1.0, area / 120 if high > 5 else 1.0)
    return round(x, 2), round(y, 2), round(float(z), 2)


def random_doors(generator: np.random.Generator, size: Size) -> list[dict[str, Any]]:
    """Draw one to three doors, as room_config has them, no two on one wall."""
    g, sides = generator, {"x0": size[1], "x1": size[1], "y0": size[0], "y1": size[0]}
    count = 1 + int(g.random() < 0.45) + int(size[0] * size[1] > 60)
    doors = []
    for wall in g.permutation(list(sides))[:count]:
        width = 1.6 if size[0] * size[1] > 80 and g.random() < 0.5 else 0.9
        at = round(float(g.uniform(width / 2 + 0.25, sides[str(wall)] - width / 2 - 0.25)), 2)
        door = {"wall": str(wall), "at_m": at, "width_m": width, "height_m": min(2.05, round(size[2] - 0.1, 2))}
        if g.random() < 0.6:
            door["color"] = _tone(g, "walls")
        doors.append(door)
    return doors


def random_surfaces(
    generator: np.random.Generator, name: str, size: Size, doors: list[dict[str, Any]]
) -> dict[str, Any]:
    """Draw what a room is made of: keys of room_config."""
    g, kind = generator, KINDS[name]
    floor, wall, ceiling = (str(g.choice(names)) for names in (kind.floors, kind.walls, kind.ceilings))
    surfaces: dict[str, Any] = {
        "floor": {"material": floor, "color": _tone(g, "floors")} if floor in _DYED and g.random() < 0.7 else floor,
        "walls": {"material": wall, "color": _tone(g, "walls")} if wall in _PAINTABLE and g.random() < 0.8 else wall,
        "ceiling": ceiling,
    }
    if g.random() < 0.3:  # one wall of another kind
        other = str(g.choice(["wood_panel", "brick", "curtain", "glass", "slats", "fabric_panel"]))
        surfaces[str(g.choice(["x0", "x1", "y0", "y1"]))] = other
    made: dict[str, Any] = {
        "surfaces": surfaces,
        "doors": doors,
        "windows": _windows(g, kind, size, doors),
        "lights": _lights(g, size),
        "daylight": round(float(g.choice([0.0, g.uniform(0.3, 1.6)], p=[0.2, 0.8])), 2),
    }
    if g.random() < 0.6:
        made["skirting_m"] = 0.08
    if g.random() < 0.35:
        made["sun_deg"] = [round(float(g.uniform(0, 360)), 1), round(float(g.uniform(15, 60)), 1)]
    return made


def _windows(g: np.random.Generator, kind: Kind, size: Size, doors: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Windows in one wall without a door, side by side."""
    count = int(g.integers(kind.windows[0], kind.windows[1] + 1))
    free = [wall for wall in ("x0", "x1", "y0", "y1") if wall not in {door["wall"] for door in doors}]
    if not count or not free:
        return []
    wall = str(g.choice(free))
    length = size[1] if wall[0] == "x" else size[0]
    width = round(float(g.uniform(0.9, 2.2)), 2)
    count = min(count, int(length / (width + 0.3)))
    sill = round(float(g.choice([0.0, 0.5, 0.9])), 2)
    height = round(float(min(g.uniform(1.1, 2.2), size[2] - sill - 0.2)), 2)
    gap = length / max(count, 1)
    return [
        {"wall": wall, "at_m": round((k + 0.5) * gap, 2), "width_m": width, "height_m": height, "sill_m": sill}
        for k in range(count)
    ]


def _lights(g: np.random.Generator, size: Size) -> list[dict[str, Any]]:
    """Lamps in rows below the ceiling, of one kind; now and then some are off."""
    pitch = float(g.uniform(2.6, 4.0)) * max(1.0, float(np.sqrt(size[0] * size[1] / 40)))
    columns, rows = (max(1, min(3, round(side / pitch))) for side in size[:2])
    shape = str(g.choice(["panel", "disc"], p=[0.7, 0.3]))
    a, b = ((0.6, 0.6), (1.2, 0.3), (1.2, 0.6))[int(g.integers(3))] if shape == "panel" else (0.35, 0.35)
    warm = g.uniform(0, 1)
    colour = [1.0, round(1.0 - 0.14 * warm, 3), round(1.0 - 0.34 * warm, 3)]
    each = 2 * float(g.uniform(0.75, 1.5)) / math.sqrt(columns * rows)  # two of strength 1 light the usual room
    return [
        {
            "position_m": [round((i + 0.5) * size[0] / columns, 2), round((j + 0.5) * size[1] / rows, 2)],
            "shape": shape, "size_m": [a, b], "strength": round(each * float(g.uniform(0.9, 1.1)), 2), "color": colour,
        }
        for i in range(columns) for j in range(rows)
    ]  # fmt: skip


def _tone(g: np.random.Generator, of: str) -> list[float]:
    tones = _TONES[of]
    base = np.array(tones[int(g.integers(len(tones)))]) * g.uniform(0.85, 1.08)
    return [round(float(v), 3) for v in np.clip(base + g.normal(0, 0.015, 3), 0.02, 0.97)]
