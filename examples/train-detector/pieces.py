"""Furniture as textured meshes: models of robot worlds, in the pictures of random worlds.

The furniture of avsim-scene is made of boxes, so that a network that has seen nothing else takes chairs, screens and
shelves of real rooms for people. FOLDER holds models in any folders below it (COLLADA, Wavefront, glTF), which are no
part of this project. The shipped network has seen those of the first line, no other ones:

    github.com/aws-robotics/aws-robomaker-small-house-world and -hospital-world: MIT-0
    github.com/aws-robotics/aws-robomaker-bookstore-world and -small-warehouse-world: MIT-0
    github.com/open-rmf/rmf_demos, rmf_demos_assets/models: Apache-2.0
    Poly Haven's furniture as github.com/RobotLocomotion/drake keeps it: CC0

Needs trimesh with pycollada and pillow.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from meshes import Painter, lit

from avcli.detection.view import View

_NO_FURNITURE = (
    "door", "wall", "window", "ceiling", "floor", "curtain", "elevator", "ramp", "carpet", "nurse", "chandelier",
    "rangehood", "lightc", "hospitalsign", "fitness", "airconditioner", "handle", "securitycamera",
)  # fmt: skip
_AROUND = ((-1, -1), (1, -1), (1, 1), (-1, 1))
"""The corners of a face, in turn."""
_EDGE_M = 0.05
"""The longest edge of a triangle: its corners carry the texture's colours."""


@dataclass
class Piece:
    """A piece of furniture on the floor: vertices (n, 3) m, triangles (t, 3), sRGB fractions (n, 3).

    `front` is where who sits on it looks, rad from the x axis, None where nobody sits.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray
    front: float | None = None

    @property
    def size(self) -> np.ndarray:
        return np.ptp(self.vertices, axis=0)


def _texture(path: Path, image) -> np.ndarray | None:
    """The colours of a model, RGB."""
    if image is not None:
        return np.asarray(image.convert("RGB"))
    files = sorted((path.parent.parent / "materials/textures").glob("*.[pj][np]g"))
    named = [file for file in files if file.stem.lower() in path.stem.lower()] or files
    found = cv2.imread(str(named[0])) if named else None
    return None if found is None else found[..., ::-1]


def _painted(mesh: trimesh.Trimesh, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    uv = getattr(mesh.visual, "uv", None)
    material = getattr(mesh.visual, "material", None)
    known = uv is not None and len(uv) == len(mesh.vertices)
    rows = np.column_stack([mesh.vertices, uv if known else np.zeros((len(mesh.vertices), 2))])
    texture = _texture(path, getattr(material, "image", None) or getattr(material, "baseColorTexture", None))
    # Divided in five dimensions, places and texture together.
    rows, triangles = trimesh.remesh.subdivide_to_size(rows, mesh.faces, _EDGE_M, max_iter=9)
    plain = getattr(material, "main_color", None)
    colours = np.full((len(rows), 3), 0.5) if plain is None else np.tile(np.asarray(plain)[:3] / 255.0, (len(rows), 1))
    if known and texture is not None:
        height, width = texture.shape[:2]
        column, row = (rows[:, 3] % 1 * (width - 1)).astype(int), ((1 - rows[:, 4] % 1) * (height - 1)).astype(int)
        colours = cv2.blur(texture, (5, 5))[row, column] / 255.0
    return rows[:, :3], triangles, colours


def pieces(folder: Path) -> list[Piece]:
    """Read the furniture below a folder, each standing on the floor about the origin."""
    out = []
    for path in sorted(folder.rglob("*")):
        name, kind = path.stem.lower(), path.suffix.lower()
        if kind not in (".dae", ".obj", ".gltf") or (kind == ".dae" and "visual" not in name) or name.endswith("low"):
            continue
        if any(word in name for word in _NO_FURNITURE):
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                scene = trimesh.load(path, force="scene")
            except Exception as fault:  # whatever a parser says of a file that is cut off
                print(f"{path}: left out: {fault}")
                continue
        if kind == ".gltf":  # whose y axis points up
            scene.apply_transform(np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]))
        longest = np.max(scene.extents)
        scale = 1.0 if longest <= 4.5 else 0.01 if longest < 1000 else 0.001
        parts = []
        for mesh in scene.dump():
            mesh.apply_scale(scale)
            parts.append(_painted(mesh, path))
        starts = np.cumsum([0] + [len(part[0]) for part in parts])
        vertices = np.concatenate([part[0] for part in parts])
        low, high = vertices.min(0), vertices.max(0)
        if (high - low).max() > 4:
            continue
        vertices = vertices - np.append((low + high)[:2] / 2, low[2])
        triangles = np.concatenate([part[1] + start for part, start in zip(parts, starts[:-1], strict=True)])
        front = _front(vertices) if "chair" in name else None
        out.append(Piece(vertices, triangles, np.concatenate([part[2] for part in parts]), front))
    if not out:
        raise FileNotFoundError(f"{folder}: no furniture")
    return out


def _front(vertices: np.ndarray) -> float | None:
    """Where a chair looks: from its back to its seat."""
    level = vertices[:, 2] / vertices[:, 2].max()
    seat, back = vertices[(level > 0.3) & (level < 0.5), :2], vertices[level > 0.65, :2]
    if not len(seat) or not len(back):
        return None
    way = seat.mean(axis=0) - back.mean(axis=0)
    return float(np.arctan2(way[1], way[0])) if np.hypot(*way) > 0.08 else None


def stocked(rng: np.random.Generator) -> Piece:
    """A shelf full of goods, of which each stands there several times."""
    long, deep, high, boards = rng.uniform(0.8, 2.6), rng.uniform(0.3, 0.6), rng.uniform(0.9, 2.1), rng.integers(3, 7)
    frame, gap, boxes = rng.uniform(0.05, 0.9) * np.ones(3), high / boards, []  # centre, half size, colour
    for z in np.linspace(0, high, boards + 1):
        boxes += [((x, 0, z), (0.1, deep / 2, 0.012), frame) for x in np.arange(-long / 2, long / 2, 0.2) + 0.1]
    for x in (-long / 2, long / 2):
        boxes += [((x, 0, z), (0.012, deep / 2, 0.1), frame) for z in np.arange(0, high, 0.2) + 0.1]
    tone = rng.uniform(0, 1, 3)
    for z in np.arange(boards) * gap:
        x = -long / 2
        while x < long / 2 - 0.1:
            wide, tall, colour = rng.uniform(0.05, 0.3), rng.uniform(0.3, 0.95) * gap, rng.uniform(0, 1, 3)
            colour = colour + rng.uniform(0, 0.7) * (tone - colour)
            label = 1 - colour if rng.random() < 0.5 else rng.uniform(0, 1, 3)
            for _ in range(int(rng.integers(1, 6))):
                if x + wide > long / 2:
                    break
                shade, back = colour * rng.uniform(0.8, 1), rng.uniform(0.6, 0.98) * deep / 2
                boxes.append(((x + wide / 2, 0, z + tall / 2), (0.47 * wide, back, tall / 2), shade))
                boxes.append(((x + wide / 2, 0, z + tall * 0.55), (0.35 * wide, back + 0.004, 0.2 * tall), label))
                x += wide
            x += rng.uniform(0, 0.15) * (rng.random() < 0.3)
    return _boxes(boxes)


def _boxes(boxes: list[tuple]) -> Piece:
    """Boxes of a centre, half of a size, and a colour each."""
    centre, half, colours = (np.array(one, float) for one in zip(*boxes, strict=True))
    # Each face has corners of its own, so that edges stay sharp in the light.
    faces = np.concatenate([np.roll([[s, a, b] for a, b in _AROUND], k, axis=1) for k in range(3) for s in (-1, 1)])
    inward = np.repeat([-1, 1] * 3, 2)[:, None] < 0
    two = np.arange(0, 24, 4)[:, None, None] + [[0, 1, 2], [0, 2, 3]]
    two = np.where(inward, two.reshape(-1, 3)[:, ::-1], two.reshape(-1, 3))
    vertices = centre[:, None] + half[:, None] * faces
    triangles = np.arange(len(boxes))[:, None, None] * 24 + two
    return Piece(vertices.reshape(-1, 3), triangles.reshape(-1, 3), np.repeat(colours, 24, axis=0))


def _soft(rng: np.random.Generator, at, half, colour: np.ndarray, turn: float = 0.0) -> Piece:
    """A coat or a bag: a lump of half a size (3,) with dents, about a place `at`, not below the floor."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    waves = np.cos(ball.vertices @ rng.normal(0, 3, (3, 6)) + rng.uniform(0, 2 * np.pi, 6)).sum(axis=1)
    vertices = np.asarray(ball.vertices) * half * (1 + 0.1 * waves[:, None])
    c, s = np.cos(turn), np.sin(turn)
    vertices = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + at
    vertices[:, 2] = np.maximum(vertices[:, 2], 0)
    return Piece(vertices, ball.faces, np.clip(colour * (1 + 0.06 * waves[:, None]), 0, 1))


def _together(parts: list[Piece]) -> Piece:
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    return Piece(*(np.concatenate(one) for one in (
        [part.vertices for part in parts], triangles, [part.colours for part in parts])))  # fmt: skip


def _cloth(rng: np.random.Generator) -> np.ndarray:
    """A colour, half of the time a dark one."""
    return rng.uniform(0.02, 0.15) * np.ones(3) if rng.random() < 0.5 else rng.uniform(0.05, 0.95, 3)


def _things(rng: np.random.Generator, count: int, length: float, depth: float, z: float) -> list[tuple]:
    """Boxes that lie about on a board at a height z."""
    half = rng.uniform(0.02, 0.17, (count, 3)) * [1, 1, 0.8]
    spots = rng.uniform(-0.45, 0.45, (count, 2)) * [length, depth]
    return [((*spot, z + size[2]), size, _cloth(rng)) for spot, size in zip(spots, half, strict=True)]


def _workbench(rng: np.random.Generator) -> list[Piece]:
    long, deep, high = rng.uniform(0.9, 2.4), rng.uniform(0.5, 0.9), rng.uniform(0.7, 1.0)
    board = rng.uniform(0.1, 0.9) * np.array([1, rng.uniform(0.7, 1), rng.uniform(0.4, 1)])
    tiles = np.linspace(-0.5, 0.5, 9)[:-1] + 1 / 16
    boxes = [((x * long, 0, high - 0.02), (long / 16, deep / 2, 0.02), board) for x in tiles]
    legs = [(x * long, y * deep, high / 2) for x in (-0.47, 0.47) for y in (-0.45, 0.45)]
    boxes += [(leg, (0.03, 0.03, high / 2), board / 2) for leg in legs]
    boxes += _things(rng, int(rng.integers(4, 30)), long, deep, high)
    if rng.random() < 0.5:  # a board above its back, with things, too
        z = high + rng.uniform(0.3, 0.6)
        boxes += [((x * long, 0.4 * deep, z), (long / 16, 0.12, 0.012), board) for x in tiles]
        raised = _things(rng, int(rng.integers(2, 15)), long, 0.2, z)
        boxes += [((at[0], at[1] + 0.4 * deep, at[2]), size, colour) for at, size, colour in raised]
    bags = [_soft(rng, (rng.uniform(-0.4, 0.4) * long, 0, high + 0.1), rng.uniform(0.08, 0.2, 3), _cloth(rng))]
    return [_boxes(boxes), *bags[: int(rng.integers(2))]]


def _cartons(rng: np.random.Generator) -> list[Piece]:
    boxes: list[tuple] = []
    kraft = np.array([0.7, 0.52, 0.34]) if rng.random() < 0.6 else _cloth(rng)
    for _ in range(int(rng.integers(1, 5))):
        spot, z = rng.uniform(-0.5, 0.5, 2), 0.0
        for _ in range(int(rng.integers(1, 5))):
            half, tape = rng.uniform(0.12, 0.3, 3), rng.uniform(0.3, 0.9) * np.ones(3)
            at = (*(spot + rng.normal(0, 0.03, 2)), z + half[2])
            boxes += [(at, half, kraft * rng.uniform(0.7, 1.2)), (at, (half[0] + 0.003, 0.03, half[2] + 0.003), tape)]
            z += 2 * half[2]
    return [_boxes(boxes)]


def _printer(rng: np.random.Generator) -> list[Piece]:
    wide, deep, tall = rng.uniform(0.2, 0.35), rng.uniform(0.2, 0.35), rng.uniform(0.12, 0.5)
    low = rng.choice([0.0, rng.uniform(0.3, 0.8)])
    case = rng.choice([0.1, 0.35, 0.8]) * rng.uniform(0.7, 1.1) * np.ones(3)
    other = case * 0.3 if case[0] > 0.3 else _cloth(rng)
    z = low + 2 * tall
    boxes = [
        ((0, 0, low + tall), (wide, deep, tall), case),
        ((0, 0.2 * deep, z + 0.03), (0.9 * wide, 0.7 * deep, 0.03), other),
        ((0, -0.8 * deep, z + 0.02), (0.3 * wide, 0.15 * deep, 0.03), _cloth(rng)),
        ((0, -deep, low + tall), (0.7 * wide, rng.uniform(0.02, 0.2), 0.02), rng.uniform(0.5, 0.95) * np.ones(3)),
    ]  # fmt: skip
    if low:
        boxes.append(((0, 0, low / 2), (1.2 * wide, 1.2 * deep, low / 2), rng.uniform(0.1, 0.9, 3)))
    return [_boxes(boxes)]


def _bin(rng: np.random.Generator) -> list[Piece]:
    radius, high, colour = rng.uniform(0.12, 0.3), rng.uniform(0.25, 0.95), _cloth(rng)
    made = trimesh.creation.cylinder(radius, high, sections=int(rng.choice([4, 24])))
    vertices = np.asarray(made.vertices) + np.array([0, 0, high / 2])
    inside = _soft(rng, (0, 0, high), (0.85 * radius, 0.85 * radius, rng.uniform(0.02, 0.2)), _cloth(rng))
    return [Piece(vertices, made.faces, np.tile(colour, (len(vertices), 1))), inside]


def _bags(rng: np.random.Generator) -> list[Piece]:
    high = rng.choice([0.0, rng.uniform(0.4, 1.2)])
    parts = [_boxes([((0, 0, high / 2), (0.3, 0.3, high / 2), rng.uniform(0.1, 0.9, 3))])] if high else []
    for _ in range(int(rng.integers(1, 4))):
        half = rng.uniform(0.1, 0.3, 3)
        parts.append(_soft(rng, (*rng.normal(0, 0.15, 2), high + half[2]), half, _cloth(rng)))
    return parts


def _coat_stand(rng: np.random.Generator) -> list[Piece]:
    high, colour = rng.uniform(1.5, 1.9), rng.uniform(0.05, 0.8) * np.ones(3)
    boxes = [((0, 0, z), (0.02, 0.02, 0.1), colour) for z in np.arange(0.1, high, 0.2)]
    boxes += [((0, 0, 0.02), (0.25, 0.02, 0.02), colour), ((0, 0, 0.02), (0.02, 0.25, 0.02), colour)]
    parts = [_boxes(boxes)]
    for turn in rng.uniform(0, 2 * np.pi, int(rng.integers(0, 5))):
        long = rng.uniform(0.2, 0.5)
        at = np.array([0.15 * np.cos(turn), 0.15 * np.sin(turn), high - 0.1 - long])
        parts.append(_soft(rng, at, (rng.uniform(0.06, 0.13), rng.uniform(0.12, 0.24), long), _cloth(rng), turn))
    return parts


def clutter(rng: np.random.Generator) -> Piece:
    """What lies and stands about in a workroom, of plain shapes."""
    makers = (_workbench, _workbench, _cartons, _printer, _bin, _bags, _coat_stand)
    return _together(makers[rng.integers(len(makers))](rng))


def _coat(rng: np.random.Generator, chair: Piece) -> Piece:
    """What hangs over a chair's back or lies on its seat."""
    level = chair.vertices[:, 2] / chair.vertices[:, 2].max()
    if rng.random() < 0.7:
        half, shown = rng.uniform([0.06, 0.18, 0.15], [0.12, 0.3, 0.35]), level > 0.75
    else:
        half, shown = rng.uniform(0.1, 0.2, 3), (level > 0.3) & (level < 0.5)
    return _soft(rng, chair.vertices[shown].mean(axis=0), half, _cloth(rng), chair.front or 0.0)


def _changed(rng: np.random.Generator, piece: Piece, turn: float | None = None) -> Piece:
    """Another size, another colour, turned about the vertical; chairs are dark and grey more often."""
    size = rng.uniform(0.8, 1.2) * rng.uniform(0.85, 1.15, 3)
    turn = rng.uniform(0, 2 * np.pi) if turn is None else turn
    c, s = np.cos(turn), np.sin(turn)
    vertices = piece.vertices * size @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    colours = piece.colours * rng.uniform(0.35, 1.15)
    if rng.random() < 0.5:
        grey = colours.mean(1, keepdims=True)
        colours = grey + rng.uniform(0, 1) * (colours - grey)
    if rng.random() < 0.3:
        colours = colours * rng.uniform(0.4, 1.0, 3)
    if piece.front is None:
        return Piece(vertices, piece.triangles, np.clip(colours, 0, 1))
    if rng.random() < 0.5:
        colours = colours * (rng.uniform(0.08, 0.35) / max(float(colours.mean()), 0.05))
    return Piece(vertices, piece.triangles, np.clip(colours, 0, 1), piece.front + turn)


def furnish(
    rng: np.random.Generator,
    painter: Painter,
    known: list[Piece],
    picture: np.ndarray,
    depth: np.ndarray,
    view: View,
    places: np.ndarray,
    seats: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw furniture into a picture of a room, with smaller things on it.

    Args:
        picture: (height, width, 3) float in 0 to 1.
        depth: (height, width) m along each ray.
        places: (n, 2) m on the floor.
        seats: the share of places that take a chair, and of tables that have one.

    Returns:
        the picture, the depth, and of each chair where it stands, m, and where it looks, rad (n, 3).
    """
    things = [one for one in known if one.size.max() < 0.75]
    chairs = [one for one in known if one.front is not None]
    meshes, sat = [], []

    def put(piece: Piece, at: np.ndarray) -> None:
        vertices = piece.vertices + at
        meshes.append((vertices, piece.triangles, lit(rng, vertices, piece.triangles, piece.colours, folds=False)))

    def seat(chair: Piece, at: np.ndarray, turn: float | None = None) -> None:
        made = _changed(rng, chair, turn)
        put(made, np.append(at, 0.0))
        if rng.random() < 0.25:
            put(_coat(rng, made), np.append(at, 0.0))
        sat.append([*at, made.front])

    # Small ones and those of the size of a person come most often, high ones never below the camera.
    footprint = np.array([one.size[:2].max() for one in known])
    height = np.array([one.size[2] for one in known])
    for place in places:
        odds = 1 / (0.5 + footprint**2)
        odds[height > max(0.4 * view.origin[2], np.hypot(*(place - view.origin[:2])) - 0.5)] = 0.0
        if not odds.any():
            continue
        if rng.random() < 0.3 * seats and np.hypot(*(place - view.origin[:2])) > 1.2:
            put(_changed(rng, stocked(rng)), np.append(place, 0.0))
            continue
        if rng.random() < 0.6 * seats:
            put(_changed(rng, clutter(rng)), np.append(place, 0.0))
            continue
        if chairs and rng.random() < seats:
            seat(chairs[rng.integers(len(chairs))], place)
            continue
        base, turn = known[rng.choice(len(known), p=odds / odds.sum())], rng.uniform(0, 2 * np.pi)
        if chairs and 0.6 < base.size[2] < 1.3 and base.size[:2].max() > 0.9 and rng.random() < seats:
            way, chair = turn + rng.choice([-0.5, 0.5]) * np.pi, chairs[rng.integers(len(chairs))]
            at = place - (0.5 * base.size[:2].min() + 0.25) * np.array([np.cos(way), np.sin(way)])
            seat(chair, at, way - chair.front + rng.normal(0, 0.3))
        base = _changed(rng, base, turn)
        put(base, np.append(place, 0.0))
        top = base.vertices[:, 2].max()
        if things and base.size[:2].min() > 0.4 and 0.4 < top < 1.3:
            for _ in range(int(rng.integers(0, 4))):
                spot = place + rng.uniform(-0.35, 0.35, 2) * base.size[:2]
                put(_changed(rng, things[rng.integers(len(things))]), np.append(spot, top))
    colour, share, _, drawn = painter.draw(meshes, view, depth)
    light = rng.uniform(0.7, 1.15) * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    out = picture * (1 - share[..., None]) + np.clip(colour * light, 0, 1)
    return out.astype(np.float32), np.where(share > 0.5, drawn, depth).astype(np.float32), np.reshape(sat, (-1, 3))
