"""Materials of rooms and furniture: what each looks like, and how it absorbs and scatters sound.

`materials.json` is the table, with the source of each figure. A room names its materials in room_config; `surfaces`
reads them, and both senses read the same result:

    >>> from avcli.materials import surfaces
    >>> room = {"room_dimensions_m": [5, 4, 3], "surfaces": {"floor": "carpet", "walls": "brick"}}
    >>> heard = surfaces(room)
    >>> heard.materials[4].name, heard.absorption.shape, heard.absorption[4].tolist()
    ('carpet', (6, 7), [0.03, 0.09, 0.25, 0.31, 0.33, 0.44, 0.44])

The renderer takes `materials` and `colors`, the acoustics `absorption` and `scattering`: (6, 7), walls in the order
x0 x1 y0 y1 z0 z1, octave bands `BANDS_HZ`, each the mean over the wall's area with its windows and doors. A room
without `surfaces` has none (None): it looks and sounds as it did before there were materials.
"""

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

BANDS_HZ = (125, 250, 500, 1000, 2000, 4000, 8000)
"""Hz, the middles of the octave bands of all figures."""
FACES = ("x0", "x1", "y0", "y1", "floor", "ceiling")
"""The six surfaces of a room, in the order in which arrays have them."""
DEFAULTS = ("curtain", "curtain", "curtain", "curtain", "vinyl_tile", "ceiling_plaster")
"""What the surfaces that a room leaves out are made of: those of the thesis's laboratory."""
WINDOW: Mapping[str, float] = {"width_m": 1.4, "height_m": 1.4, "sill_m": 0.9}
DOOR: Mapping[str, float] = {"width_m": 0.9, "height_m": 2.05}
"""Sizes of the windows and doors that a room does not state."""

_SCATTERING_HZ = 707.0  # at which the table states scattering


@dataclass(frozen=True)
class Look:
    """How a material looks.

    Attributes:
        pattern: name of the procedure that paints it.
        color, second: (3,) sRGB fractions, its ground and its grain, joints, print or dirt.
        size_m: (2,) m, along and across, of what repeats: a tile, a board, a fold, the fibres.
        contrast: 0 to 1, strength of the pattern.
        gloss: 0 to 1, strength of reflected lamps.
    """

    pattern: str
    color: tuple[float, float, float]
    second: tuple[float, float, float]
    size_m: tuple[float, float]
    contrast: float
    gloss: float


@dataclass(frozen=True)
class Material:
    """A material.

    Attributes:
        name: by which configs and scenarios call it.
        text: what it is, in a few words.
        absorption: (7,) of energy, at random incidence, in the bands `BANDS_HZ`.
        scattering: share of the reflected energy that is not mirrored, at 707 Hz: an estimate; `scattering_in_bands`
            spreads it.
        look: how it looks.
        source: of its absorption: a key of the table's sources in brackets, and the row there.
    """

    name: str
    text: str
    absorption: tuple[float, ...]
    scattering: float
    look: Look
    source: str


@functools.cache
def table() -> Mapping[str, Material]:
    """Return all materials by name."""
    rows = json.loads(Path(__file__).with_name("materials.json").read_text("utf-8"))["materials"]
    return {
        name: Material(
            name, row["text"], tuple(row["absorption"]), row["scattering"],
            _look(row["look"]), row["source"],
        )
        for name, row in rows.items()
    }  # fmt: skip


def _look(row: Mapping[str, Any]) -> Look:
    red, green, blue = row["color"]
    second, (along, across) = row["second"], row["size_m"]
    return Look(
        row["pattern"], (red, green, blue), (second[0], second[1], second[2]), (along, across), row["contrast"],
        row["gloss"],
    )  # fmt: skip


def scattering_in_bands(material: Material) -> np.ndarray:
    """Return the scattering coefficients of a material in the bands `BANDS_HZ`, (7,).

    They grow with the root of the frequency, up to 0.99: an estimate of the curves that ODEON spreads a figure at
    707 Hz with (C. L. Christensen and G. Koutsouris, 2013).
    """
    return np.minimum(0.99, material.scattering * np.sqrt(np.array(BANDS_HZ) / _SCATTERING_HZ))


@dataclass(frozen=True)
class Surfaces:
    """What the six surfaces of a room are made of, in the order of `FACES`.

    Attributes:
        materials: of each.
        colors: (3,) sRGB fractions of each, or None: its material's.
        stated: whether the room names each, or it is one of `DEFAULTS`.
        absorption, scattering: (6, 7) in the bands `BANDS_HZ`, means over each surface with its windows and doors.
    """

    materials: tuple[Material, ...]
    colors: tuple[tuple[float, float, float] | None, ...]
    stated: tuple[bool, ...]
    absorption: np.ndarray
    scattering: np.ndarray


def surfaces(room_config: Mapping[str, Any]) -> Surfaces | None:
    """Return what a room's surfaces are made of, or None where its room_config has no `surfaces`.

    Args:
        room_config: the section of config.json, valid: its reader, `avcli.formats.experiment.Config.room`, checks it.
    """
    given = room_config.get("surfaces")
    if given is None:
        return None
    known = table()
    entries = [_entry(given, face) for face in FACES]
    names = [entry.get("material") or default for entry, default in zip(entries, DEFAULTS, strict=True)]
    materials = tuple(known[name] for name in names)
    colors = tuple(tuple(entry["color"]) if entry.get("color") is not None else None for entry in entries)
    sound = np.array([[m.absorption, scattering_in_bands(m)] for m in materials])
    for face, (area, material) in _openings(room_config):
        heard = np.array([material.absorption, scattering_in_bands(material)])
        sound[face] += area * (heard - [materials[face].absorption, scattering_in_bands(materials[face])])
    absorption, scattering = np.clip(sound, 0.0, 1.0).transpose(1, 0, 2)
    return Surfaces(materials, colors, tuple(bool(entry) for entry in entries), absorption, scattering)


def _entry(given: Mapping[str, Any], face: str) -> Mapping[str, Any]:
    """What a room states of one surface: its own entry, or that of all walls; empty where it states nothing."""
    entry = given.get(face)
    if entry is None and face not in ("floor", "ceiling"):
        entry = given.get("walls")
    return {} if entry is None else {"material": entry} if isinstance(entry, str) else entry


def _openings(room_config: Mapping[str, Any]) -> list[tuple[int, tuple[float, Material]]]:
    """The windows and doors: the index of the wall of each, the share of its area, and the material."""
    x, y, z = room_config["room_dimensions_m"]
    found = []
    for kind, usual in (("windows", WINDOW), ("doors", DOOR)):
        for item in room_config.get(kind) or ():
            wide, high = (item.get(key) or usual[key] for key in ("width_m", "height_m"))
            face = FACES.index(item["wall"])
            area = min(1.0, wide * high / ((y if face < 2 else x) * z))
            name = "window" if kind == "windows" else item.get("material") or "door"
            found.append((face, (area, table()[name])))
    return found
