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
    centre, half, colours = (np.array(one, float) for one in zip(*boxes, strict=True))
    # Each face has corners of its own, so that edges stay sharp in the light.
    faces = np.concatenate([np.roll([[s, a, b] for a, b in _AROUND], k, axis=1) for k in range(3) for s in (-1, 1)])
    inward = np.repeat([-1, 1] * 3, 2)[:, None] < 0
    two = np.arange(0, 24, 4)[:, None, None] + [[0, 1, 2], [0, 2, 3]]
    two = np.where(inward, two.reshape(-1, 3)[:, ::-1], two.reshape(-1, 3))
    vertices = centre[:, None] + half[:, None] * faces
    triangles = np.arange(len(boxes))[:, None, None] * 24 + two
    return Piece(vertices.reshape(-1, 3), triangles.reshape(-1, 3), np.repeat(colours, 24, axis=0))


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
