"""What does not move: boxes, cylinders, balls and meshes, and the tables and chairs that are made of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avcli import materials
from avcli.formats import bounds
from avcli.formats.room_keys import COLOR, MATERIAL
from avcli.formats.schema import Invalid, Key, Numbers, Object, Text, Variants
from avcli.scene import pieces

BOX, CYLINDER, BALL, TRIANGLE = range(4)
PAINT, WOOD, PLASTIC, METAL, CLOTH, CARD = range(6)
_PLAIN = ("paint", "wood", "plastic", "metal", "cloth", "card")  # which have the colour of their piece alone
MATERIALS = (*_PLAIN, *(name for name in materials.table() if name not in _PLAIN))
"""The names of all materials, in the order of the numbers that Solids have."""
_LUMINOUS = (MATERIALS.index("window"), MATERIALS.index("lamp"))
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""Of a box, in its half sides, (8, 3)."""
_LARGEST_MESH = 200_000
_GREY, _WOOD = (0.62, 0.63, 0.62), (0.72, 0.53, 0.34)
_LENGTH = bounds.LENGTH
_CASTING_M2 = 0.02  # a part of a piece casts a shadow if a quarter of its largest face is larger
_STEP_OVER_M = 0.05  # rugs, cables, papers: they stand in nobody's way


def _kind(place: tuple[int, str], material: str, turns: str = "", **own: Key) -> Object:
    """Describe a kind of furniture: where it stands, its own keys, and those that it shares with others."""
    keys = {"position_m": Key(Numbers(place[0], bounds.COORDINATE), f"position {place[1]}, m", required=True), **own}
    if turns:
        keys["rotation_deg"] = Key(bounds.DEGREES, turns, default=0.0)
    keys["material"] = Key(MATERIAL, "material of its surface", default=material)
    keys["color"] = Key(COLOR, "colour, sRGB fractions; default: that of the material")
    return Object(keys, closed=True)


_TURNS = "rotation, counterclockwise seen from above"
_SIZE = "size along its own axes, m"
PIECE = Variants(
    {
        "table": _kind(
            (2, "on the floor"), "wood", _TURNS, size_m=Key(Numbers(3, _LENGTH), _SIZE, default=[1.4, 0.7, 0.74])
        ),
        "chair": _kind((2, "on the floor"), "plastic", f"{_TURNS}; at 0 it faces +x"),
        "box": _kind((3, "of its middle"), "paint", _TURNS, size_m=Key(Numbers(3, _LENGTH), _SIZE, required=True)),
        "panel": _kind(
            (3, "of its middle"), "card", _TURNS, size_m=Key(Numbers(3, _LENGTH), _SIZE, default=[0.8, 0.8, 0.02])
        ),
        "cylinder": _kind(
            (3, "of its middle"),
            "paint",
            radius_m=Key(_LENGTH, "radius, m", required=True),
            height_m=Key(_LENGTH, "height, m", required=True),
        ),
        "sphere": _kind((3, "of its middle"), "plastic", radius_m=Key(_LENGTH, "radius, m", required=True)),
        "mesh": _kind(
            (3, "of its origin"),
            "paint",
            _TURNS,
            path=Key(Text(), "path of a file that trimesh reads, relative to the scenario's file", required=True),
            scale=Key(_LENGTH, "length of its unit, m", default=1.0),
        ),
        **{
            name: _kind(
                (3, f"of the foot of {kind.text}"),
                kind.material,
                f"{_TURNS}; at 0 it faces +x",
                size_m=Key(Numbers(3, _LENGTH), _SIZE, default=list(kind.size)),
            )
            for name, kind in pieces.KINDS.items()
        },
    }
)
"""Every kind of furniture that a scenario may have, with its keys."""


_Box = tuple[tuple[float, float, float], tuple[float, float, float], int, Sequence[float] | np.ndarray]
"""Centre and size in m, material, colour."""


@dataclass(frozen=True)
class Solids:
    """n solids, room frame, metres.

    Attributes:
        kind: (n,) BOX, CYLINDER (about its third axis), BALL or TRIANGLE.
        centre: (n, 3); a triangle's first corner.
        axes: (n, 3, 3) rows are a solid's own axes; rows 0 and 1 of a triangle are its other corners.
        half: (n, 3) half sizes along these axes.
        material: (n,) index into MATERIALS.
        colour: (n, 3) sRGB fractions.
        casts: (n,) bool, whether it casts a shadow; what is small does not, since each that does costs time. Empty: all
            do.
    """

    kind: np.ndarray
    centre: np.ndarray
    axes: np.ndarray
    half: np.ndarray
    material: np.ndarray
    colour: np.ndarray
    casts: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        if len(self.casts) != len(self.kind):
            object.__setattr__(self, "casts", np.ones(len(self.kind), bool))

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, which: slice | np.ndarray) -> "Solids":
        return Solids(*(getattr(self, name)[which] for name in _FIELDS))


def join(solids: Sequence[Solids]) -> Solids:
    """Join several Solids, or none, into one."""
    empty = Solids(
        np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3))
    )
    return Solids(*(np.concatenate([getattr(s, name) for s in [empty, *solids]]) for name in _FIELDS))


_FIELDS = ("kind", "centre", "axes", "half", "material", "colour", "casts")


def blockers(solids: Solids) -> Solids:
    """Return what casts shadows in the room: the solids, and instead of meshes a box within each mesh's bounds."""
    kept = (solids.kind != TRIANGLE) & ~np.isin(solids.material, _LUMINOUS)
    plain = solids[kept]
    boxes = []
    for start, end in _runs(solids.kind == TRIANGLE):
        corners = np.concatenate([solids.centre[start:end], *solids.axes[start:end, :2].transpose(1, 0, 2)])
        low, high = corners.min(0), corners.max(0)
        boxes.append(_solid(BOX, (low + high) / 2, np.eye(3), 0.4 * (high - low), PAINT, np.zeros(3)))
    return join([plain[plain.casts], *boxes])


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and end index of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return list(zip(edges[::2], edges[1::2], strict=True))


def build(piece: Mapping[str, Any], load_mesh: Callable[[str], np.ndarray] | None) -> Solids:
    """Build one piece of furniture from its values as `PIECE` reads them.

    Raises:
        Invalid: a mesh cannot be used.
    """
    turn = np.deg2rad(piece.get("rotation_deg", 0.0))
    cos, sin = np.cos(turn), np.sin(turn)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    place, colour, material = np.array(piece["position_m"]), _colour(piece), MATERIALS.index(piece["material"])
    match piece["kind"]:
        case "table":
            return _table(place, axes, piece["size_m"], material, colour)
        case "chair":
            return _chair(place, axes, material, colour)
        case name if name in pieces.KINDS:
            return _several(pieces.KINDS[name].solids(piece["size_m"], tuple(colour.tolist())), place, axes, material)
    match piece["kind"]:
        case "cylinder":
            half = np.array([piece["radius_m"], piece["radius_m"], piece["height_m"] / 2])
            return _solid(CYLINDER, place, axes, half, material, colour)
        case "sphere":
            return _solid(BALL, place, axes, np.full(3, piece["radius_m"]), material, colour)
        case "mesh":
            corners = _triangles(piece["path"], load_mesh) * piece["scale"] @ axes + place
            return _mesh(corners, material, colour)
    return _solid(BOX, place, axes, np.array(piece["size_m"]) / 2, material, colour)


def _colour(piece: Mapping[str, Any]) -> np.ndarray:
    """The colour of a piece: its own, else its material's; the plain materials have one for each kind of piece."""
    if piece["color"] is not None:
        return np.array(piece["color"])
    usual = pieces.KINDS.get(piece["kind"])
    if usual is not None and piece["material"] == usual.material:
        return np.array(usual.colour)
    if piece["material"] not in _PLAIN:
        return np.array(materials.table()[piece["material"]].look.color)
    return np.array({"table": _WOOD, "chair": (0.17, 0.21, 0.28)}.get(piece["kind"], _GREY))


def blocks(solids: Solids, places: np.ndarray, margin: float, height: float) -> np.ndarray:
    """Tell which places on the floor are blocked for a walker.

    Args:
        solids: the furniture.
        places: (n, 2) m.
        margin: m that a walker keeps.
        height: of the walker, m.

    Returns:
        (n,) bool.
    """
    hit = np.zeros(len(places), bool)
    if not len(places):
        return hit
    low, high = places.min(0), places.max(0)
    far = np.linalg.norm(solids.half, axis=1) + margin
    # What is low is stepped over, and what is far from all places is not asked.
    asked = (solids.centre[:, 2] + solids.half[:, 2] > _STEP_OVER_M) | (solids.kind == TRIANGLE)
    asked &= (solids.centre[:, :2] + far[:, None] >= low).all(1) & (solids.centre[:, :2] - far[:, None] <= high).all(1)
    for kind, centre, axes, half in zip(
        solids.kind[asked], solids.centre[asked], solids.axes[asked], solids.half[asked], strict=True
    ):
        if kind == TRIANGLE or centre[2] - half[2] > height:
            continue
        local = np.abs((places - centre[:2]) @ axes[:2, :2].T) - half[:2] - margin
        hit |= (local < 0).all(1) if kind == BOX else np.linalg.norm(places - centre[:2], axis=1) < half[0] + margin
    return hit


def _table(place: np.ndarray, axes: np.ndarray, size: Sequence[float], material: int, colour: np.ndarray) -> Solids:
    length, depth, height = size
    top = 0.03
    rows: list[_Box] = [((0, 0, height - top / 2), (length, depth, top), material, colour)]
    steel = (0.28, 0.29, 0.31)
    for x in (-1, 1):
        for y in (-1, 1):
            leg = (x * (length / 2 - 0.05), y * (depth / 2 - 0.05), (height - top) / 2)
            rows.append((leg, (0.04, 0.04, height - top), METAL, steel))
        rows.append(((x * (length / 2 - 0.05), 0, height - top - 0.03), (0.03, depth - 0.14, 0.04), METAL, steel))
    return _boxes(rows, place, axes)


def _chair(place: np.ndarray, axes: np.ndarray, material: int, colour: np.ndarray) -> Solids:
    """A chair that faces its own +x, the seat's middle at its place."""
    steel = (0.30, 0.31, 0.33)
    rows: list[_Box] = [
        ((0, 0, 0.44), (0.42, 0.42, 0.04), material, colour),
        ((-0.20, 0, 0.70), (0.03, 0.40, 0.28), material, colour),
    ]
    for x in (-1, 1):
        for y in (-1, 1):
            top = 0.80 if x < 0 else 0.42
            rows.append(((x * 0.185, y * 0.185, top / 2), (0.025, 0.025, top), METAL, steel))
    return _boxes(rows, place, axes)


def _several(rows: Sequence[pieces.Solid], place: np.ndarray, axes: np.ndarray, main: int) -> Solids:
    """The solids of a piece, whose foot is at its place."""
    cos, sin = np.cos([row.turn for row in rows]), np.sin([row.turn for row in rows])
    none = np.zeros(len(rows))
    turned = np.stack([[cos, sin, none], [-sin, cos, none], [none, none, none + 1]]).transpose(2, 0, 1)
    half = np.array([row.half for row in rows])
    large = np.sort(half, axis=1)[:, 1:].prod(1) > _CASTING_M2
    named = [MATERIALS.index(row.material) if row.material else main for row in rows]
    return Solids(
        np.array([row.kind for row in rows]), np.array([row.centre for row in rows]) @ axes + place, turned @ axes,
        half, np.array(named), np.array([row.colour for row in rows]), large,
    )  # fmt: skip


def _boxes(rows: list[_Box], place: np.ndarray, axes: np.ndarray) -> Solids:
    """Join boxes whose centres are counted from a place on the floor, along its own axes."""
    origin = np.append(place, 0.0)
    return join(
        [
            _solid(BOX, origin + np.array(centre, float) @ axes, axes, np.array(size) / 2, material, np.array(colour))
            for centre, size, material, colour in rows
        ]
    )


def _triangles(path: str, load_mesh: Callable[[str], np.ndarray] | None) -> np.ndarray:
    if load_mesh is None:
        raise Invalid("cannot be read: meshes need a function that loads them", ("path",))
    try:
        triangles = np.asarray(load_mesh(path), float)
    except (ValueError, OSError) as error:
        raise Invalid(f"cannot be read: {error}", ("path",)) from None
    if triangles.ndim != 3 or not len(triangles):
        raise Invalid(f"{path} has no triangles", ("path",))
    if len(triangles) > _LARGEST_MESH:
        raise Invalid(f"{path} has {len(triangles)} triangles; at most {_LARGEST_MESH} are possible", ("path",))
    if not np.isfinite(triangles).all():
        raise Invalid(f"{path} has corners that are not finite", ("path",))
    return triangles


def _mesh(corners: np.ndarray, material: int, colour: np.ndarray) -> Solids:
    n = len(corners)
    axes = np.concatenate([corners[:, 1:], np.zeros((n, 1, 3))], 1)
    return Solids(
        np.full(n, TRIANGLE), corners[:, 0], axes, np.zeros((n, 3)), np.full(n, material), np.tile(colour, (n, 1))
    )


def box(centre: np.ndarray, axes: np.ndarray, size: np.ndarray, material: str, colour: np.ndarray) -> Solids:
    """Return one box.

    Args:
        centre: (3,) m.
        axes: (3, 3), rows are its own axes in the room.
        size: (3,) m along them.
        material: its name.
        colour: (3,) sRGB fractions.
    """
    return _solid(BOX, centre, axes, np.asarray(size) / 2, MATERIALS.index(material), colour)


def _solid(
    kind: int, centre: np.ndarray, axes: np.ndarray, half: np.ndarray, material: int, colour: np.ndarray | list[float]
) -> Solids:
    return Solids(
        np.array([kind]), centre[None], axes[None], half[None], np.array([material]), np.asarray(colour)[None]
    )
