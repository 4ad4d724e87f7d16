"""Furniture and clutter drawn by chance for each kind of room, and the seats and places that people take there."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avcli.scene.rooms import Size

_DOOR_M = 1.2  # in front of a door that stays free
_GAP_M = 0.06  # of furniture to the wall
LOW_CAMERA_M, BELOW_CAMERA_M = 2.5, 0.45
"""m; nobody stands nearer than the second below a camera lower than the first."""
_TRIES = 40
_WOODS = ((0.72, 0.53, 0.34), (0.56, 0.40, 0.26), (0.36, 0.24, 0.16), (0.80, 0.78, 0.74), (0.32, 0.33, 0.34),
          (0.62, 0.52, 0.42))  # fmt: skip
_CLOTHS = ((0.12, 0.13, 0.15), (0.20, 0.25, 0.36), (0.36, 0.36, 0.37), (0.34, 0.16, 0.15), (0.18, 0.29, 0.24),
           (0.52, 0.46, 0.38), (0.62, 0.60, 0.57))  # fmt: skip
_MACHINES = ((0.30, 0.42, 0.38), (0.55, 0.56, 0.55), (0.22, 0.27, 0.36), (0.62, 0.55, 0.35), (0.16, 0.17, 0.18))
_BRIGHTS = ((0.75, 0.16, 0.13), (0.86, 0.62, 0.12), (0.14, 0.36, 0.62), (0.18, 0.46, 0.27), (0.85, 0.84, 0.80))


@dataclass(frozen=True)
class Spot:
    """A place that somebody may take: (x, y) m, the way they face in degrees, and what they may do there.

    Spots of one `table` are taken by people who talk to each other.
    """

    place: tuple[float, float]
    heading_deg: float
    poses: tuple[str, ...]
    table: int = -1


@dataclass(frozen=True)
class FloorPose:
    """A place on the floor and the way that it faces: x ahead, y to the left."""

    x: float
    y: float
    turn_deg: float

    def at(self, dx: float, dy: float) -> tuple[float, float]:
        """The place in the room of a point of this frame, m."""
        turn = np.deg2rad(self.turn_deg)
        return float(self.x + np.cos(turn) * dx - np.sin(turn) * dy), float(
            self.y + np.sin(turn) * dx + np.cos(turn) * dy
        )


@dataclass
class Layout:
    """A room that is being furnished.

    Attributes:
        size: of the room, m.
        generator: of all chance.
        pieces: of furniture, as a scenario has them.
        seats, stands: places for people who sit, and for people who do something on their feet.
        taken: (x, y, half x, half y) of what is occupied.
    """

    size: Size
    generator: np.random.Generator
    pieces: list[dict[str, Any]] = field(default_factory=list)
    seats: list[Spot] = field(default_factory=list)
    stands: list[Spot] = field(default_factory=list)
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)
    tables: int = 0

    def one_of(self, colours: tuple[tuple[float, float, float], ...]) -> list[float]:
        """One of several colours, a little changed."""
        base = np.array(colours[int(self.generator.integers(len(colours)))]) * self.generator.uniform(0.85, 1.15)
        return [round(float(v), 3) for v in np.clip(base, 0.02, 0.97)]

    def chance(self, probability: float) -> bool:
        """Whether something of some probability happens."""
        return bool(self.generator.random() < probability)

    def put(
        self, kind: str, at: FloorPose, dx: float, dy: float, turn: float = 0.0, z: float = 0.0, **keys: Any
    ) -> None:
        """Add a piece at a place of a frame."""
        x, y = at.at(dx, dy)
        place = [round(x, 3), round(y, 3)] + ([] if kind in ("table", "chair") else [round(z, 3)])
        item = {"kind": kind, "position_m": place, **keys}
        if kind not in ("cylinder", "sphere"):
            item["rotation_deg"] = round((at.turn_deg + turn) % 360, 1)
        self.pieces.append(item)

    def spot(self, at: FloorPose, dx: float, dy: float, turn: float, poses: tuple[str, ...], table: int = -1) -> Spot:
        """A place for somebody at a place of a frame."""
        x, y = at.at(dx, dy)
        return Spot((round(x, 2), round(y, 2)), round((at.turn_deg + turn) % 360, 1), poses, table)

    def free(self, half: tuple[float, float], room: float = 0.0, *, square: bool = True) -> FloorPose | None:
        """Find a free rectangle of half sizes along its own axes, `room` m from the walls; None: there is none."""
        g = self.generator
        for _ in range(_TRIES):
            turn = 90.0 * int(g.integers(4))
            a, b = half if turn % 180 == 0 else half[::-1]
            low = np.array([a, b]) + room
            high = np.array(self.size[:2]) - low
            if (high < low).any():
                continue
            x, y = (float(v) for v in g.uniform(low, high))
            if self._claim(x, y, a, b):
                return FloorPose(x, y, turn if square else float(g.uniform(0, 360)))
        return None

    def at_wall(self, deep: float, wide: float) -> FloorPose | None:
        """Find a free place at a wall for something so deep (its own x) and wide, that faces into the room."""
        g = self.generator
        for _ in range(_TRIES):
            wall = int(g.integers(4))
            length, across = (self.size[1], self.size[0]) if wall % 2 == 0 else (self.size[0], self.size[1])
            if length < wide + 0.1 or across < deep + 0.8:
                continue
            along, off = float(g.uniform(wide / 2 + 0.05, length - wide / 2 - 0.05)), deep / 2 + _GAP_M
            x, y = ((off, along), (along, off), (self.size[0] - off, along), (along, self.size[1] - off))[wall]
            a, b = (deep / 2, wide / 2) if wall % 2 == 0 else (wide / 2, deep / 2)
            if self._claim(x, y, a, b):
                return FloorPose(x, y, 90.0 * wall)
        return None

    def _claim(self, x: float, y: float, a: float, b: float) -> bool:
        if any(abs(x - u) < a + c and abs(y - v) < b + d for u, v, c, d in self.taken):
            return False
        self.taken.append((x, y, a + 0.02, b + 0.02))
        return True


def furnish(
    name: str,
    size: Size,
    people: int,
    doors: list[dict[str, Any]],
    camera: tuple[float, float, float],
    generator: np.random.Generator,
) -> Layout:
    """Furnish a room.

    Args:
        name: of its kind, one of rooms.KINDS.
        size: (3,) m.
        people: how many will be there.
        doors: of room_config; the floor before them stays free.
        camera: (3,) m; nothing high stands below it, and nobody below a low one.
        generator: of all chance.

    Returns:
        The furnished room.
    """
    layout = Layout(size, generator)
    for door in doors:
        wall, at, wide = door["wall"], door["at_m"], door["width_m"] / 2 + 0.2
        off = 0.0 if wall[1] == "0" else size[0 if wall[0] == "x" else 1]
        layout.taken.append((off, at, _DOOR_M, wide) if wall[0] == "x" else (at, off, wide, _DOOR_M))
    if name != "meeting":
        layout.taken.append((camera[0], camera[1], 0.3, 0.3))
    _FURNISHERS[name](layout, people)
    _strew(layout, int(generator.integers(1, 4)) + int(size[0] * size[1] / 30))
    if camera[2] < LOW_CAMERA_M:
        layout.seats = [spot for spot in layout.seats if math.dist(spot.place, camera[:2]) > BELOW_CAMERA_M]
        layout.stands = [spot for spot in layout.stands if math.dist(spot.place, camera[:2]) > 2 * BELOW_CAMERA_M]
    return layout


# --- groups of furniture ----------------------------------------------------------------------------------------------


def _desk(layout: Layout, at: FloorPose) -> None:
    """A desk with chair, screen and what lies about; the frame is that of the desk, its user sits at -x."""
    g, deep, wide = layout.generator, 0.75, float(layout.generator.choice([1.2, 1.4, 1.6]))
    wood, table = layout.one_of(_WOODS), layout.tables
    layout.tables += 1
    layout.put("table", at, 0, 0, 90.0, size_m=[wide, deep, 0.74], color=wood)
    layout.put("office_chair", at, -deep / 2 - 0.2, 0.0, float(g.normal(0, 12)), color=layout.one_of(_CLOTHS))
    layout.seats.append(
        layout.spot(at, -deep / 2 - 0.2, 0.0, 0.0, ("type", "type", "write", "table", "recline"), table)
    )
    screens = int(g.choice([0, 1, 2], p=[0.2, 0.5, 0.3]))
    for k in range(screens):
        aside = (k - (screens - 1) / 2) * 0.6
        layout.put("screen", at, 0.18, aside, 180.0 - 25.0 * aside, 0.74, color=layout.one_of(_BRIGHTS))
    if screens:
        layout.put("keyboard", at, -0.16, float(g.normal(0, 0.04)), 180.0, 0.74, color=layout.one_of(_CLOTHS))
    else:
        layout.put("laptop", at, -0.08, 0.0, 0.0, 0.74)
    if layout.chance(0.6):
        layout.put("papers", at, -0.05, float(g.choice([-1, 1])) * 0.38, float(g.uniform(0, 360)), 0.74)
    if layout.chance(0.5):
        layout.put("crockery", at, 0.05, -0.42, float(g.uniform(0, 360)), 0.74, color=layout.one_of(_BRIGHTS))
    if layout.chance(0.55):
        layout.put("tower", at, 0.1, 0.4, 180.0, color=layout.one_of(_CLOTHS))
    if layout.chance(0.5):
        layout.put("cable", at, 0.2, -0.1, float(g.uniform(60, 120)))
    if layout.chance(0.35):
        layout.put("bag", at, 0.0, -0.4, float(g.uniform(0, 360)), color=layout.one_of(_CLOTHS))
    if layout.chance(0.3):
        layout.put("coat", at, -deep / 2 - 0.43, 0.0, 0.0, 1.0, color=layout.one_of(_CLOTHS))


def _dinner(layout: Layout, at: FloorPose, long: float, deep: float, poses: tuple[str, ...], *, ends: bool) -> None:
    """A table, its length along the frame's y, with chairs on both sides, and something on it."""
    g, table = layout.generator, layout.tables
    layout.tables += 1
    wood, cloth, soft = layout.one_of(_WOODS), layout.one_of(_CLOTHS), layout.chance(0.4)
    layout.put("table", at, 0, 0, 90.0, size_m=[round(long, 2), deep, 0.74], color=wood)
    count = max(int(long / 0.72), 1)
    places = [(side * (deep / 2 + 0.19), (k - (count - 1) / 2) * long / count, 90.0 - 90.0 * side + 90.0)
              for side in (-1, 1) for k in range(count)]  # fmt: skip
    places = [(x, y, 0.0 if x < 0 else 180.0) for x, y, _ in places]
    if ends:
        places += [(0.0, side * (long / 2 + 0.19), -90.0 * side) for side in (-1, 1)]
    for x, y, turn in places:
        off, kind = float(g.normal(0, 0.03)), "office_chair" if soft else "chair"
        layout.put(kind, at, x + off, y, turn + float(g.normal(0, 6)), color=cloth)
        layout.seats.append(layout.spot(at, x + off, y, turn, poses, table))
        inward = np.deg2rad(turn)
        dx, dy = x + 0.42 * np.cos(inward), y + 0.42 * np.sin(inward)
        thing = g.choice(["papers", "laptop", "crockery", ""], p=[0.25, 0.2, 0.25, 0.3])
        if thing:
            colour = {"color": layout.one_of(_BRIGHTS)} if thing == "crockery" else {}
            layout.put(str(thing), at, dx, dy, turn + (0.0 if thing == "laptop" else float(g.uniform(-20, 20))), 0.74,
                       **colour)  # fmt: skip
        if layout.chance(0.15):
            layout.put("coat", at, x - 0.22 * np.cos(inward), y - 0.22 * np.sin(inward), turn, 0.86,
                       color=layout.one_of(_CLOTHS))  # fmt: skip
        if layout.chance(0.15):
            layout.put("bag", at, x - 0.1 * np.sin(inward), y + 0.36 * np.cos(inward), turn,
                       color=layout.one_of(_CLOTHS))  # fmt: skip


def _at_walls(layout: Layout, kinds: dict[str, tuple[float, float, float]], count: int) -> None:
    """Stand so many things at the walls, of kinds with their sizes."""
    for _ in range(count):
        kind = str(layout.generator.choice(list(kinds)))
        a, b, c = kinds[kind]
        c = min(c, layout.size[2] - 0.2)
        at = layout.at_wall(a + (0.5 if kind in ("shelf", "cabinet") else 0.0), b)
        if at is None:
            continue
        back = -0.25 if kind in ("shelf", "cabinet") else 0.0
        keys: dict[str, Any] = {"size_m": [a, b, c]}
        if kind in ("shelf", "cabinet", "bench", "sofa"):
            keys["color"] = layout.one_of(_CLOTHS if kind == "sofa" else _WOODS)
        layout.put(kind, at, back, 0.0, 0.0, 0.9 if kind == "whiteboard" else 0.0, **keys)
        if kind in ("shelf", "cabinet"):
            layout.stands.append(layout.spot(at, a / 2 + 0.25, 0.0, 180.0, ("crouch", "bend", "raise", "stand")))
        elif kind == "bench":
            layout.seats += [layout.spot(at, 0.02, dy, 0.0, ("sit", "sit", "recline")) for dy in (-0.4, 0.4)]
        elif kind == "whiteboard":
            layout.stands.append(layout.spot(at, 0.5, 0.0, 180.0, ("raise", "stand", "fold")))


def _strew(layout: Layout, count: int) -> None:
    """Leave things on the floor: bags, boxes, cables, bins."""
    g = layout.generator
    for _ in range(count):
        kind = str(g.choice(["bag", "box", "cable", "bin", "papers", "sphere"], p=[0.25, 0.25, 0.2, 0.2, 0.06, 0.04]))
        at = layout.free((0.25, 0.25), 0.05, square=False)
        if at is None:
            return
        if kind == "box":
            a, b, c = (round(float(v), 2) for v in g.uniform([0.25, 0.25, 0.15], [0.45, 0.4, 0.45]))
            layout.put("box", at, 0, 0, 0.0, c / 2, size_m=[a, b, c], material="card", color=[0.62, 0.49, 0.33])
        elif kind == "sphere":
            layout.put("sphere", at, 0, 0, 0.0, 0.12, radius_m=0.12, color=layout.one_of(_BRIGHTS))
        elif kind in ("cable", "papers"):
            layout.put(kind, at, 0, 0)
        else:
            layout.put(kind, at, 0, 0, color=layout.one_of(_CLOTHS))


# --- kinds of rooms ---------------------------------------------------------------------------------------------------


def _office(layout: Layout, people: int) -> None:
    most = max(int(layout.size[0] * layout.size[1] / 7), 1)
    for _ in range(min(most, people + int(layout.generator.integers(0, 3)))):
        at = layout.free((0.95, 0.85), 0.08)
        if at is None:
            break
        _desk(layout, FloorPose(*at.at(0.45, 0.0), at.turn_deg))
    _at_walls(
        layout,
        {
            "shelf": (0.32, 0.9, 1.9),
            "cabinet": (0.42, 0.9, 1.2),
            "plant": (0.6, 0.6, 1.3),
            "whiteboard": (0.03, 1.6, 1.0),
        },
        3 + int(layout.size[0] * layout.size[1] / 18),
    )


def _meeting(layout: Layout, people: int) -> None:
    x, y = layout.size[:2]
    wanted = max(people + 1, 4)
    while wanted > 0:
        seats = min(wanted, 14)
        turn = 0.0 if y >= x else 90.0
        deep = float(layout.generator.choice([0.9, 1.2, 1.4]))
        long = float(np.clip(0.75 * np.ceil((seats - 2) / 2), 1.4, max(max(x, y) - 2.6, 1.4)))
        half = (deep / 2 + 0.65, long / 2 + 0.65)
        if not layout.seats:
            a, b = half if turn == 0 else half[::-1]
            at: FloorPose | None = FloorPose(x / 2, y / 2, turn)
            layout.taken.append((x / 2, y / 2, a, b))
        else:
            at = layout.free(half, 0.3)
        if at is None:
            break
        _dinner(layout, at, long, deep, ("table", "write", "type", "recline", "sit"), ends=True)
        wanted -= seats
    _at_walls(layout, {"whiteboard": (0.03, 1.8, 1.1), "cabinet": (0.42, 1.2, 0.8), "plant": (0.6, 0.6, 1.4)}, 4)


def _corridor(layout: Layout, people: int) -> None:
    kinds = {
        "bench": (0.42, 1.5, 0.45), "plant": (0.5, 0.5, 1.3), "cabinet": (0.35, 0.8, 1.8), "bin": (0.3, 0.3, 0.6),
        "whiteboard": (0.03, 1.2, 0.9),
    }  # fmt: skip
    _at_walls(layout, kinds, 2 + int(max(layout.size[:2]) / 3))


def _hall(layout: Layout, people: int) -> None:
    """Rows of chairs before a stage, or high tables to stand at, or little but pillars."""
    g, (x, y, z) = layout.generator, layout.size
    form = str(g.choice(["rows", "tables", "open"], p=[0.4, 0.4, 0.2]))
    if form == "rows":
        stage = layout.at_wall(2.4, min(5.0, 0.6 * min(x, y)))
        if stage is not None:
            wide = min(5.0, 0.6 * min(x, y))
            layout.put(
                "box", stage, 0, 0, 0.0, 0.15, size_m=[2.2, wide, 0.3], material="wood", color=layout.one_of(_WOODS)
            )
            ahead = (x if stage.turn_deg % 180 == 0 else y) - 2.5
            rows = int(min(np.ceil(0.7 * people / max(wide / 0.62, 1)) + 1, (0.55 * ahead) / 0.95))
            cloth = layout.one_of(_CLOTHS)
            for row in range(rows):
                for k in range(int(wide / 0.62)):
                    dx, dy = 2.9 + 0.95 * row, (k + 0.5) * 0.62 - wide / 2
                    layout.put("chair", stage, dx, dy, 180.0 + float(g.normal(0, 2)), color=cloth)
                    layout.seats.append(layout.spot(stage, dx, dy, 180.0, ("sit", "recline", "sit")))
            middle = stage.at(2.9 + 0.475 * (rows - 1), 0.0)
            a, b = 0.475 * rows + 0.3, wide / 2 + 0.2
            layout.taken.append((*middle, a, b) if stage.turn_deg % 180 == 0 else (*middle, b, a))
    elif form == "tables":
        for _ in range(int(min(x * y / 16, people / 3 + 2))):
            at = layout.free((0.9, 0.9), 0.3)
            if at is None:
                break
            colour = layout.one_of(_WOODS)
            layout.put("cylinder", at, 0, 0, 0.0, 1.08, radius_m=0.35, height_m=0.03, material="wood", color=colour)
            layout.put("cylinder", at, 0, 0, 0.0, 0.54, radius_m=0.04, height_m=1.06, material="metal")
            layout.put("crockery", at, -0.1, 0.1, float(g.uniform(0, 360)), 1.095, color=layout.one_of(_BRIGHTS))
            for k in range(3):
                turn = 120.0 * k + float(g.uniform(-20, 20))
                dx, dy = 0.72 * np.cos(np.deg2rad(turn)), 0.72 * np.sin(np.deg2rad(turn))
                layout.stands.append(layout.spot(at, dx, dy, turn + 180.0, ("stand", "fold", "hips"), layout.tables))
            layout.tables += 1
    for _ in range(int(g.integers(0, 4)) if x * y > 120 else 0):
        at = layout.free((0.3, 0.3), 1.0)
        if at is not None:
            layout.put("cylinder", at, 0, 0, 0.0, z / 2, radius_m=0.22, height_m=z, color=[0.75, 0.74, 0.72])
    _at_walls(layout, {"plant": (0.7, 0.7, 1.6), "bench": (0.42, 1.5, 0.45), "whiteboard": (0.03, 2.4, 1.4)}, 5)


def _workshop(layout: Layout, people: int) -> None:
    g = layout.generator
    for _ in range(int(min(people + 2, layout.size[0] * layout.size[1] / 9))):
        at = layout.at_wall(1.5, 1.9) if layout.chance(0.6) else layout.free((0.85, 0.95), 0.3)
        if at is None:
            continue
        bench, table = FloorPose(*at.at(-0.38, 0.0), at.turn_deg), layout.tables
        layout.tables += 1
        layout.put("table", bench, 0, 0, 90.0, size_m=[1.7, 0.72, 0.9], color=layout.one_of(_WOODS))
        for dy in (-0.45, 0.4):
            if layout.chance(0.8):
                layout.put("tools", bench, 0.0, dy, float(g.uniform(0, 360)), 0.9, color=layout.one_of(_BRIGHTS))
        if layout.chance(0.4):
            layout.put("screen", bench, -0.2, 0.0, 0.0, 0.9)
        if layout.chance(0.5):
            layout.put("cable", bench, 0.6, 0.0, 90.0)
        layout.stands.append(layout.spot(bench, 0.62, 0.0, 180.0, ("lean", "lean", "bend", "stand"), table))
    for _ in range(int(g.integers(1, 4))):
        at = layout.free((0.7, 0.6), 0.2)
        if at is not None:
            a, b, c = (round(float(v), 2) for v in g.uniform([0.7, 0.6, 0.8], [1.2, 1.0, 1.8]))
            layout.put("box", at, 0, 0, 0.0, c / 2, size_m=[a, b, c], material="metal", color=layout.one_of(_MACHINES))
            layout.put(
                "box", at, a / 2, 0, 0.0, 0.7 * c, size_m=[0.03, 0.3, 0.2], material="plastic", color=[0.1, 0.1, 0.1]
            )
    _at_walls(
        layout,
        {"shelf": (0.5, 1.2, 2.0), "cabinet": (0.5, 1.0, 1.9), "bin": (0.55, 0.55, 0.9), "tower": (0.5, 0.4, 0.5)},
        4 + int(layout.size[0] * layout.size[1] / 20),
    )


def _living(layout: Layout, people: int) -> None:
    g = layout.generator
    at = layout.at_wall(3.4, 2.4)
    if at is not None:
        sofa, table = FloorPose(*at.at(-1.2, 0.0), at.turn_deg), layout.tables
        layout.tables += 1
        cloth = layout.one_of(_CLOTHS)
        rug = [round(float(v), 2) for v in g.uniform([1.6, 2.0], [2.2, 2.6])]
        layout.put(
            "box", sofa, 1.3, 0.0, 0.0, 0.006, size_m=[*rug, 0.012], material="cloth", color=layout.one_of(_CLOTHS)
        )
        layout.put("sofa", sofa, 0.0, 0.0, size_m=[0.9, 2.1, 0.8], color=cloth)
        layout.seats += [
            layout.spot(sofa, 0.12, dy, 0.0, ("sit", "recline", "recline"), table) for dy in (-0.62, 0.0, 0.62)
        ]
        layout.put("table", sofa, 1.15, 0.0, 90.0, size_m=[1.1, 0.6, 0.42], color=layout.one_of(_WOODS))
        layout.put("crockery", sofa, 1.1, 0.2, 0.0, 0.42, color=layout.one_of(_BRIGHTS))
        layout.put("papers", sofa, 1.2, -0.25, 30.0, 0.42)
        layout.put("sofa", sofa, 2.3, 0.7, 190.0, size_m=[0.85, 0.9, 0.8], color=cloth)
        layout.seats.append(layout.spot(sofa, 2.18, 0.7, 190.0, ("sit", "recline"), table))
    side = layout.free((1.2, 1.3), 0.2)
    if side is not None:
        _dinner(layout, side, 1.5, 0.85, ("table", "sit", "recline", "write"), ends=False)
    screen = layout.at_wall(0.5, 1.6)
    if screen is not None:
        layout.put("cabinet", screen, 0.0, 0.0, size_m=[0.42, 1.5, 0.5], color=layout.one_of(_WOODS))
        layout.put("screen", screen, 0.0, 0.0, 0.0, 0.5, size_m=[0.05, 1.2, 0.68])
    _at_walls(
        layout,
        {
            "shelf": (0.32, 0.9, 1.9),
            "plant": (0.6, 0.6, 1.4),
            "floor_lamp": (0.45, 0.45, 1.6),
            "cabinet": (0.45, 1.0, 0.9),
        },
        4,
    )


_FURNISHERS: dict[str, Callable[[Layout, int], None]] = {
    "office": _office, "meeting": _meeting, "corridor": _corridor, "hall": _hall, "workshop": _workshop,
    "living": _living,
}  # fmt: skip
