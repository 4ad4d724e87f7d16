"""What does not move: boxes, cylinders, balls and meshes, and the tables and chairs that are made of them."""

from dataclasses import dataclass

import numpy as np

BOX, CYLINDER, BALL, TRIANGLE = range(4)
PAINT, WOOD, PLASTIC, METAL, CLOTH, CARD = range(6)
_MATERIALS = {"paint": PAINT, "wood": WOOD, "plastic": PLASTIC, "metal": METAL, "cloth": CLOTH, "card": CARD}
_LARGEST_MESH = 200_000
_KINDS = ("table", "chair", "box", "panel", "cylinder", "sphere", "mesh")
_KEYS = {
    "table": ("position_m", "size_m", "rotation_deg", "color"),
    "chair": ("position_m", "rotation_deg", "color"),
    "box": ("position_m", "size_m", "rotation_deg", "color", "material"),
    "panel": ("position_m", "size_m", "rotation_deg", "color", "material"),
    "cylinder": ("position_m", "radius_m", "height_m", "color", "material"),
    "sphere": ("position_m", "radius_m", "color", "material"),
    "mesh": ("position_m", "rotation_deg", "path", "scale", "color", "material"),
}


@dataclass(frozen=True)
class Solids:
    """n solids, room frame, metres.

    Attributes:
        kind: (n,) BOX, CYLINDER (about its third axis), BALL or TRIANGLE.
        centre: (n, 3); a triangle's first corner.
        axes: (n, 3, 3) rows are a solid's own axes; rows 0 and 1 of a triangle are its other corners.
        half: (n, 3) half sizes along these axes.
        material: (n,) PAINT, WOOD...
        colour: (n, 3) sRGB fractions.
    """

    kind: np.ndarray
    centre: np.ndarray
    axes: np.ndarray
    half: np.ndarray
    material: np.ndarray
    colour: np.ndarray

    def __len__(self):
        return len(self.kind)


def join(solids):
    """Join several Solids (a list, may be empty) into one."""
    empty = Solids(
        np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3))
    )
    names = ("kind", "centre", "axes", "half", "material", "colour")
    return Solids(*(np.concatenate([getattr(s, name) for s in [empty, *solids]]) for name in names))


def blockers(solids):
    """What casts shadows in the room: the solids, and in place of meshes a box within each mesh's bounds."""
    kept = solids.kind != TRIANGLE
    plain = Solids(*(getattr(solids, f)[kept] for f in ("kind", "centre", "axes", "half", "material", "colour")))
    boxes = []
    for start, end in _runs(~kept):
        corners = np.concatenate([solids.centre[start:end], *solids.axes[start:end, :2].transpose(1, 0, 2)])
        low, high = corners.min(0), corners.max(0)
        boxes.append(_solid(BOX, (low + high) / 2, np.eye(3), 0.4 * (high - low), PAINT, np.zeros(3)))
    return join([plain, *boxes])


def _runs(flags):
    """First and end index of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return list(zip(edges[::2], edges[1::2], strict=True))


def build(reader, load_mesh):
    """Build one piece of furniture from its checked reader (scenario._Reader); returns Solids."""
    reader.object(
        ("kind", "position_m", "size_m", "rotation_deg", "color", "material", "radius_m", "height_m", "path", "scale")
    )
    kind = reader.choice("kind", _KINDS, None)
    reader.object(("kind", *_KEYS[kind]))
    turn = np.deg2rad(reader.number("rotation_deg", 0.0))
    cos, sin = np.cos(turn), np.sin(turn)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    default_material = {"box": "paint", "panel": "card", "cylinder": "paint", "sphere": "plastic", "mesh": "paint"}
    material = _MATERIALS[reader.choice("material", list(_MATERIALS), default_material.get(kind, "paint"))]
    if kind == "table":
        return _table(reader, axes)
    if kind == "chair":
        return _chair(reader, axes)
    centre = reader.numbers("position_m", 3)
    colour = _colour(reader, (0.62, 0.63, 0.62))
    if kind in ("box", "panel"):
        half = _sizes(reader, "size_m", None if kind == "box" else [0.8, 0.8, 0.02]) / 2
        return _solid(BOX, centre, axes, half, material, colour)
    if kind == "cylinder":
        radius, height = (
            reader.number(key, None, above=0.0) or _missing(reader, key) for key in ("radius_m", "height_m")
        )
        return _solid(CYLINDER, centre, axes, np.array([radius, radius, height / 2]), material, colour)
    if kind == "sphere":
        radius = reader.number("radius_m", None, above=0.0) or _missing(reader, "radius_m")
        return _solid(BALL, centre, axes, np.full(3, radius), material, colour)
    return _mesh(reader, load_mesh, centre, axes, material, colour)


def blocks(solids, places, margin, height):
    """Which floor places (n, 2) have a solid within margin m of them that a walker of height m would hit."""
    hit = np.zeros(len(places), bool)
    for kind, centre, axes, half in zip(solids.kind, solids.centre, solids.axes, solids.half, strict=True):
        if kind == TRIANGLE or centre[2] - half[2] > height:
            continue
        local = np.abs((places - centre[:2]) @ axes[:2, :2].T) - half[:2] - margin
        hit |= (local < 0).all(1) if kind == BOX else np.linalg.norm(places - centre[:2], axis=1) < half[0] + margin
    return hit


def _table(reader, axes):
    place = reader.numbers("position_m", 2)
    length, depth, height = _sizes(reader, "size_m", [1.4, 0.7, 0.74])
    top = 0.03
    wood = _colour(reader, (0.72, 0.53, 0.34))
    rows = [((0, 0, height - top / 2), (length, depth, top), WOOD, wood)]
    steel = (0.28, 0.29, 0.31)
    for x in (-1, 1):
        for y in (-1, 1):
            leg = (x * (length / 2 - 0.05), y * (depth / 2 - 0.05), (height - top) / 2)
            rows.append((leg, (0.04, 0.04, height - top), METAL, steel))
        rows.append(((x * (length / 2 - 0.05), 0, height - top - 0.03), (0.03, depth - 0.14, 0.04), METAL, steel))
    return _boxes(rows, place, axes)


def _chair(reader, axes):
    """A chair that faces its own +x, the seat's middle at its place."""
    place = reader.numbers("position_m", 2)
    colour = _colour(reader, (0.17, 0.21, 0.28))
    steel = (0.30, 0.31, 0.33)
    rows = [
        ((0, 0, 0.44), (0.42, 0.42, 0.04), PLASTIC, colour),
        ((-0.20, 0, 0.70), (0.03, 0.40, 0.28), PLASTIC, colour),
    ]
    for x in (-1, 1):
        for y in (-1, 1):
            top = 0.80 if x < 0 else 0.42
            rows.append(((x * 0.185, y * 0.185, top / 2), (0.025, 0.025, top), METAL, steel))
    return _boxes(rows, place, axes)


def _boxes(rows, place, axes):
    origin = np.append(place, 0.0)
    return join(
        [
            _solid(BOX, origin + np.array(centre, float) @ axes, axes, np.array(size) / 2, material, np.array(colour))
            for centre, size, material, colour in rows
        ]
    )


def _mesh(reader, load_mesh, centre, axes, material, colour):
    path = reader.text("path", "")
    if load_mesh is None:
        reader.refuse("path", "meshes cannot be read here")
    try:
        triangles = np.asarray(load_mesh(path), float)
    except (ValueError, OSError) as error:
        reader.refuse("path", str(error))
    if triangles.ndim != 3 or not len(triangles):
        reader.refuse("path", f"{path}: no triangles in it")
    if len(triangles) > _LARGEST_MESH:
        reader.refuse("path", f"{path}: {len(triangles)} triangles, more than {_LARGEST_MESH}")
    if not np.isfinite(triangles).all():
        reader.refuse("path", f"{path}: corners that are not finite")
    corners = triangles * reader.number("scale", 1.0, above=0.0) @ axes + centre
    n = len(corners)
    axes = np.concatenate([corners[:, 1:], np.zeros((n, 1, 3))], 1)
    return Solids(
        np.full(n, TRIANGLE), corners[:, 0], axes, np.zeros((n, 3)), np.full(n, material), np.tile(colour, (n, 1))
    )


def _solid(kind, centre, axes, half, material, colour):
    return Solids(
        np.array([kind]), centre[None], axes[None], half[None], np.array([material]), np.asarray(colour)[None]
    )


def _sizes(reader, key, default):
    sizes = reader.numbers(key, 3, default)
    if (sizes <= 0).any():
        reader.refuse(key, f"expected lengths above 0, found {sizes.tolist()}")
    return sizes


def _colour(reader, default):
    colour = reader.numbers("color", 3, list(default))
    if ((colour < 0) | (colour > 1)).any():
        reader.refuse("color", f"expected three fractions from 0 to 1, found {colour.tolist()}")
    return colour


def _missing(reader, key):
    reader.refuse(key, "is missing")
