"""Furniture and clutter made of several solids: office chairs, sofas, shelves, screens, plants, bags, coats, cables."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BOX, CYLINDER, BALL = range(3)
PAINT, WOOD, PLASTIC, METAL, CLOTH, CARD = "paint", "wood", "plastic", "metal", "upholstery", "card"
MAIN = ""
"""In place of a material: that which the piece names."""

Rgb = tuple[float, float, float]


class Solid(NamedTuple):
    """Kind, centre and half sizes in m in the piece's own frame (its foot at 0, it faces +x), material, colour.

    `turn` is by how much it is turned about the vertical, rad.
    """

    kind: int
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    material: str
    colour: Rgb
    turn: float = 0.0


@dataclass(frozen=True)
class Kind:
    """A kind of piece: what it is, its solids by size and colour, its usual size (3,) m, colour and material."""

    text: str
    solids: Callable[[Sequence[float], Rgb], list[Solid]]
    size: tuple[float, float, float]
    colour: Rgb
    material: str


_STEEL: Rgb = (0.30, 0.31, 0.33)
_BLACK: Rgb = (0.05, 0.05, 0.055)
_LEAVES = ((0.16, 0.30, 0.12), (0.22, 0.38, 0.16), (0.12, 0.24, 0.11))


def _box(
    x: float, y: float, z: float, a: float, b: float, c: float, material: str, colour: Rgb, turn: float = 0.0
) -> Solid:
    """A box by its middle and its size."""
    return Solid(BOX, (x, y, z), (a / 2, b / 2, c / 2), material, colour, turn)


def _post(x: float, y: float, z: float, radius: float, height: float, material: str, colour: Rgb) -> Solid:
    return Solid(CYLINDER, (x, y, z), (radius, radius, height / 2), material, colour)


def _ball(x: float, y: float, z: float, radius: float, material: str, colour: Rgb) -> Solid:
    return Solid(BALL, (x, y, z), (radius, radius, radius), material, colour)


def _office_chair(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    solids = [
        _box(0, 0, 0.46, 0.82 * a, 0.80 * b, 0.08, MAIN, colour),
        _box(-0.42 * a, 0, 0.78, 0.07, 0.72 * b, c - 0.55, MAIN, colour),
        _post(0, 0, 0.25, 0.03, 0.34, METAL, _STEEL),
    ]
    for side in (-1, 1):
        solids.append(_box(-0.02, 0.44 * b * side, 0.66, 0.26, 0.05, 0.03, PLASTIC, _BLACK))
        solids.append(_box(-0.02, 0.44 * b * side, 0.56, 0.04, 0.03, 0.18, PLASTIC, _BLACK))
    for k in range(5):
        angle = 2 * math.pi * k / 5
        x, y = 0.27 * math.cos(angle), 0.27 * math.sin(angle)
        solids.append(_box(0.5 * x, 0.5 * y, 0.09, 0.27, 0.045, 0.035, PLASTIC, _BLACK, angle))
        solids.append(_ball(x, y, 0.04, 0.035, PLASTIC, _BLACK))
    return solids


def _stool(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    legs = [_box(x * 0.38 * a, y * 0.38 * b, c / 2, 0.03, 0.03, c, METAL, _STEEL) for x in (-1, 1) for y in (-1, 1)]
    return [_post(0, 0, c - 0.02, a / 2, 0.04, MAIN, colour), *legs]


def _bench(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    ends = [_box(0, y * (b / 2 - 0.08), (c - 0.04) / 2, 0.8 * a, 0.06, c - 0.04, METAL, _STEEL) for y in (-1, 1)]
    return [_box(0, 0, c - 0.02, a, b, 0.04, MAIN, colour), *ends]


def _sofa(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    dark = (0.85 * colour[0], 0.85 * colour[1], 0.85 * colour[2])
    places = max(round((b - 0.3) / 0.65), 1)
    wide = (b - 0.3) / places
    cushions = [
        _box(0.08, (k - (places - 1) / 2) * wide, 0.37, a - 0.28, wide - 0.02, 0.14, MAIN, colour)
        for k in range(places)
    ]
    arms = [_box(0, side * (b / 2 - 0.08), 0.31, a, 0.16, 0.62, CLOTH, dark) for side in (-1, 1)]
    back = _box(-a / 2 + 0.11, 0, c / 2, 0.22, b, c, CLOTH, dark)
    return [_box(0, 0, 0.16, a, b, 0.28, CLOTH, dark), back, *arms, *cushions]


def _shelf(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    solids = [_box(0, side * (b / 2 - 0.01), c / 2, a, 0.02, c, MAIN, colour) for side in (-1, 1)]
    solids.append(_box(-a / 2 + 0.005, 0, c / 2, 0.01, b, c, MAIN, colour))
    levels = max(round(c / 0.38), 2)
    tones = ((0.42, 0.16, 0.14), (0.14, 0.22, 0.36), (0.7, 0.66, 0.58), (0.2, 0.32, 0.24), (0.1, 0.1, 0.12))
    for level in range(levels):
        z = c * level / levels + 0.02
        solids.append(_box(0, 0, z, a, b, 0.02, MAIN, colour))
        begin, k = -b / 2 + 0.05, 3 * level
        while begin < b / 2 - 0.25:  # books and boxes, in runs of one colour
            run = 0.10 + 0.11 * ((7 * k) % 5) / 4
            tall = 0.2 + 0.02 * ((3 * k) % 5)
            solids.append(_box(-0.02, begin + run / 2, z + 0.01 + tall / 2, 0.75 * a, run, tall, CARD, tones[k % 5]))
            begin, k = begin + run + 0.04 * ((5 * k) % 4), k + 1
    solids.append(_box(0, 0, c - 0.01, a, b, 0.02, MAIN, colour))
    return solids


def _cabinet(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    doors = max(round(b / 0.45), 1)
    grips = [
        _box(a / 2 + 0.012, (k + 0.85 - doors / 2) * b / doors, 0.55 * c, 0.02, 0.015, 0.12, METAL, _STEEL)
        for k in range(doors)
    ]
    seams = [_box(a / 2, (k - doors / 2) * b / doors, c / 2, 0.004, 0.006, c, PAINT, _BLACK) for k in range(1, doors)]
    return [_box(0, 0, c / 2, a, b, c, MAIN, colour), *grips, *seams]


def _screen(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    return [
        _box(0, 0, 0.01, 0.2, 0.24, 0.015, PLASTIC, _BLACK), _box(-0.03, 0, 0.10, 0.03, 0.05, 0.2, PLASTIC, _BLACK),
        _box(0, 0, 0.14 + c / 2, a, b, c, PLASTIC, _BLACK),
        _box(a / 2 + 0.001, 0, 0.14 + c / 2, 0.004, b - 0.03, c - 0.03, MAIN, colour),
    ]  # fmt: skip


def _keyboard(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    return [_box(0, 0, c / 2, a, b, c, MAIN, colour), _ball(0.02, -b / 2 - 0.1, 0.012, 0.032, MAIN, colour)]


def _laptop(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    return [
        _box(0, 0, 0.01, a, b, 0.018, MAIN, colour), _box(0, 0, 0.021, 0.5 * a, 0.85 * b, 0.004, PLASTIC, _BLACK),
        _box(a / 2 + 0.02, 0, c / 2, 0.01, b, c, MAIN, colour),
        _box(a / 2 + 0.013, 0, c / 2 + 0.01, 0.004, b - 0.02, c - 0.03, "screen", (0.35, 0.45, 0.6)),
    ]  # fmt: skip


def _tower(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    front = [_box(a / 2, 0, z * c, 0.006, 0.8 * b, 0.04, PLASTIC, _STEEL) for z in (0.8, 0.68)]
    return [_box(0, 0, c / 2, a, b, c, MAIN, colour), *front]


def _papers(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """Sheets that lie across each other."""
    a, b, c = size
    tones = [(colour[0] - 0.04 * k, colour[1] - 0.04 * k, colour[2] - 0.05 * k) for k in range(3)]
    places = ((-0.03, 0.0, 0.1), (0.05, -0.05, -0.5), (0.0, 0.06, 0.9))
    return [_box(x, y, c * (k + 0.5) / 3, a, b, c / 3, MAIN, tones[k], turn) for k, (x, y, turn) in enumerate(places)]


def _cable(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """A cable that winds over the floor, of short straight pieces."""
    a, b, c = size
    x = np.linspace(-a / 2, a / 2, 17)
    y = b / 2 * np.sin(10.6 * x / a + 1.0) * np.cos(4.2 * x / a)
    dx, dy = np.diff(x), np.diff(y)
    pieces = zip((x[:-1] + dx / 2).tolist(), (y[:-1] + dy / 2).tolist(), np.hypot(dx, dy).tolist(),
                 np.arctan2(dy, dx).tolist(), strict=True)  # fmt: skip
    return [_box(u, v, c / 2, length + c, c, c, MAIN, colour, turn) for u, v, length, turn in pieces]


def _bag(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, b, c = size
    dark = (0.7 * colour[0], 0.7 * colour[1], 0.7 * colour[2])
    return [
        _box(0, 0, 0.4 * c, a, b, 0.8 * c, MAIN, colour), _box(0, 0, 0.85 * c, 0.7 * a, 0.85 * b, 0.2 * c, CLOTH, dark),
        _box(0.52 * a, 0, 0.3 * c, 0.05, 0.7 * b, 0.45 * c, CLOTH, dark),
        _box(0, 0, c, 0.03, 0.4 * b, 0.02, CLOTH, dark),
    ]  # fmt: skip


def _coat(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """A coat over a chair's back: it hangs down on either side, with a sleeve."""
    a, b, c = size
    return [
        _box(-a / 2, 0, -0.5 * c, 0.05, b, c, MAIN, colour),
        _box(a / 2, 0, -0.3 * c, 0.04, 0.9 * b, 0.6 * c, MAIN, colour),
        _post(0, -0.36 * b, -0.01, 0.06, 0.08, MAIN, colour), _box(0, 0, 0.01, a + 0.05, b, 0.05, MAIN, colour),
        _box(-a / 2 - 0.03, 0.45 * b, -0.55 * c, 0.09, 0.10, 0.9 * c, MAIN, colour),
    ]  # fmt: skip


def _plant(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """A pot, a stem and leaves, which stand on a spiral."""
    a, _, c = size
    pot = 0.3 * c
    solids = [
        _post(0, 0, pot / 2, 0.32 * a, pot, MAIN, colour), _post(0, 0, pot, 0.28 * a, 0.01, CLOTH, (0.12, 0.09, 0.07)),
        _post(0, 0, 0.5 * c, 0.015, 0.6 * c, WOOD, (0.3, 0.22, 0.14)),
    ]  # fmt: skip
    for k in range(16):
        angle, high = 2.39996 * k, pot + (c - pot) * (0.25 + 0.7 * k / 15)
        reach = 0.42 * a * (1.0 - 0.5 * k / 15)
        x, y = reach * math.cos(angle), reach * math.sin(angle)
        solids.append(_ball(x, y, high, 0.14 * a + 0.03 * a * (k % 3), "foliage", _LEAVES[k % 3]))
        solids.append(
            _box(1.3 * x, 1.3 * y, high - 0.03, 0.3 * a, 0.08 * a, 0.01, "foliage", _LEAVES[(k + 1) % 3], angle)
        )
    return solids


def _bin(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, _, c = size
    return [_post(0, 0, c / 2, a / 2, c, MAIN, colour), _post(0, 0, c, 0.42 * a, 0.006, PLASTIC, _BLACK)]


def _floor_lamp(size: Sequence[float], colour: Rgb) -> list[Solid]:
    a, _, c = size
    return [
        _post(0, 0, 0.012, 0.36 * a, 0.025, METAL, _STEEL), _post(0, 0, c / 2, 0.012, c, METAL, _STEEL),
        _post(0, 0, c - 0.12, a / 2, 0.24, MAIN, colour),
    ]  # fmt: skip


def _whiteboard(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """On the wall behind it; its foot is its lower edge."""
    a, b, c = size
    return [
        _box(0, 0, c / 2, a, b, c, MAIN, colour), _box(a, 0, 0, 0.06, 0.9 * b, 0.02, METAL, _STEEL),
        _box(0, 0, c, a + 0.01, b, 0.02, METAL, _STEEL),
    ]  # fmt: skip


def _crockery(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """A cup, a plate and a bottle."""
    _, _, c = size
    return [
        _post(0, 0, 0.045, 0.04, 0.09, MAIN, colour), _post(0.16, 0.05, 0.008, 0.11, 0.016, PAINT, (0.85, 0.84, 0.82)),
        _post(0.02, 0.17, c / 2, 0.034, c, PLASTIC, (0.25, 0.38, 0.4)),
    ]  # fmt: skip


def _tools(size: Sequence[float], colour: Rgb) -> list[Solid]:
    """What lies on a workbench: a vice, bars, tins."""
    a, b, c = size
    return [
        _box(0, 0, c / 2, 0.16, 0.12, c, MAIN, colour), _box(0.1, 0, 0.7 * c, 0.08, 0.1, 0.5 * c, METAL, _STEEL),
        _box(-0.5 * a, 0.25 * b, 0.015, 0.34, 0.03, 0.03, METAL, _STEEL),
        _box(-0.45 * a, -0.25 * b, 0.012, 0.05, 0.26, 0.024, WOOD, (0.5, 0.34, 0.2)),
        _post(0.45 * a, 0.3 * b, 0.06, 0.05, 0.12, METAL, (0.5, 0.16, 0.12)),
        _post(0.5 * a, -0.2 * b, 0.05, 0.045, 0.1, METAL, (0.2, 0.3, 0.44)),
    ]  # fmt: skip


KINDS: dict[str, Kind] = {
    "office_chair": Kind("a chair on castors", _office_chair, (0.54, 0.58, 1.0), (0.12, 0.13, 0.15), "upholstery"),
    "stool": Kind("a stool", _stool, (0.36, 0.36, 0.46), (0.55, 0.42, 0.28), "wood"),
    "bench": Kind("a bench", _bench, (0.42, 1.5, 0.45), (0.55, 0.42, 0.28), "wood"),
    "sofa": Kind("a sofa; an armchair where it is narrow", _sofa, (0.9, 1.9, 0.8), (0.4, 0.38, 0.35), "upholstery"),
    "shelf": Kind("an open shelf with books", _shelf, (0.32, 0.9, 1.9), (0.6, 0.5, 0.38), "wood"),
    "cabinet": Kind("a cabinet with doors", _cabinet, (0.42, 0.9, 1.2), (0.72, 0.72, 0.70), "paint"),
    "screen": Kind("a screen on its foot", _screen, (0.03, 0.55, 0.33), (0.25, 0.35, 0.5), "screen"),
    "keyboard": Kind("a keyboard and a mouse", _keyboard, (0.15, 0.43, 0.025), (0.1, 0.1, 0.11), "plastic"),
    "laptop": Kind("a laptop, open", _laptop, (0.23, 0.33, 0.22), (0.6, 0.61, 0.63), "metal"),
    "tower": Kind("a computer", _tower, (0.42, 0.19, 0.42), (0.09, 0.09, 0.1), "plastic"),
    "papers": Kind("some sheets of paper", _papers, (0.21, 0.297, 0.006), (0.93, 0.93, 0.91), "paper"),
    "cable": Kind("a cable on the floor", _cable, (1.6, 0.5, 0.012), (0.06, 0.06, 0.06), "plastic"),
    "bag": Kind("a bag", _bag, (0.18, 0.32, 0.42), (0.2, 0.22, 0.28), "cloth"),
    "coat": Kind("a coat that hangs over a chair's back", _coat, (0.1, 0.46, 0.5), (0.2, 0.18, 0.2), "cloth"),
    "plant": Kind("a plant in a pot", _plant, (0.7, 0.7, 1.3), (0.5, 0.34, 0.26), "paint"),
    "bin": Kind("a waste bin", _bin, (0.28, 0.28, 0.34), (0.2, 0.2, 0.21), "plastic"),
    "floor_lamp": Kind("a floor lamp", _floor_lamp, (0.42, 0.42, 1.6), (0.9, 0.85, 0.72), "lamp"),
    "whiteboard": Kind(
        "a board on the wall behind it", _whiteboard, (0.03, 1.8, 1.1), (0.93, 0.94, 0.94), "whiteboard"
    ),
    "crockery": Kind("a cup, a plate and a bottle", _crockery, (0.3, 0.3, 0.26), (0.8, 0.3, 0.2), "paint"),
    "tools": Kind("what lies on a workbench", _tools, (0.7, 0.4, 0.16), (0.16, 0.24, 0.34), "metal"),
}
"""The kinds by name."""
