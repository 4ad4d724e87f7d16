"""Furniture as textured meshes: the models of two robot worlds, in the pictures of random worlds.

The furniture of avsim-scene is made of boxes, so that a network that has seen nothing else takes chairs, screens and
shelves of real rooms for people. The models are under MIT-0 and no part of this project:

    FOLDER/house       github.com/aws-robotics/aws-robomaker-small-house-world, checked out
    FOLDER/hospital    github.com/aws-robotics/aws-robomaker-hospital-world, checked out

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
_EDGE_M = 0.05
"""The longest edge of a triangle: its corners carry the texture's colours."""


@dataclass
class Piece:
    """A piece of furniture on the floor: vertices (n, 3) m, triangles (t, 3), sRGB fractions (n, 3)."""

    vertices: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray

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
    colours = np.full((len(rows), 3), 0.5)
    if known and texture is not None:
        height, width = texture.shape[:2]
        column, row = (rows[:, 3] % 1 * (width - 1)).astype(int), ((1 - rows[:, 4] % 1) * (height - 1)).astype(int)
        colours = cv2.blur(texture, (5, 5))[row, column] / 255.0
    return rows[:, :3], triangles, colours


def pieces(folder: Path) -> list[Piece]:
    """Read the furniture below a folder, each standing on the floor about the origin."""
    out = []
    for path in sorted(folder.glob("*/models/*/meshes/*")):
        if path.suffix.lower() != ".dae" or "visual" not in path.stem.lower() or path.stem.lower().endswith("low"):
            continue
        if any(word in path.stem.lower() for word in _NO_FURNITURE):
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load(path, force="scene")
        scale = 0.01 if np.max(scene.extents) > 4.5 else 1.0
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
        out.append(Piece(vertices, triangles, np.concatenate([part[2] for part in parts])))
    if not out:
        raise FileNotFoundError(f"{folder}: no furniture")
    return out


def _changed(rng: np.random.Generator, piece: Piece) -> Piece:
    """Another size, another colour, turned about the vertical."""
    size = rng.uniform(0.8, 1.2) * rng.uniform(0.85, 1.15, 3)
    turn = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    vertices = piece.vertices * size @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    colours = piece.colours * rng.uniform(0.35, 1.15)
    if rng.random() < 0.5:
        grey = colours.mean(1, keepdims=True)
        colours = grey + rng.uniform(0, 1) * (colours - grey)
    if rng.random() < 0.3:
        colours = colours * rng.uniform(0.4, 1.0, 3)
    return Piece(vertices, piece.triangles, np.clip(colours, 0, 1))


def furnish(
    rng: np.random.Generator,
    painter: Painter,
    known: list[Piece],
    picture: np.ndarray,
    depth: np.ndarray,
    view: View,
    places: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw furniture into a picture of a room, with smaller things on it.

    Args:
        picture: (height, width, 3) float in 0 to 1.
        depth: (height, width) m along each ray.
        places: (n, 2) m on the floor.

    Returns:
        the picture and the depth.
    """
    things = [one for one in known if one.size.max() < 0.75]
    meshes = []

    def put(piece: Piece, at: np.ndarray) -> None:
        vertices = piece.vertices + at
        meshes.append((vertices, piece.triangles, lit(rng, vertices, piece.triangles, piece.colours, folds=False)))

    # Small ones and those of the size of a person come most often, high ones never below the camera.
    footprint = np.array([one.size[:2].max() for one in known])
    height = np.array([one.size[2] for one in known])
    for place in places:
        odds = 1 / (0.5 + footprint**2)
        odds[height > max(0.4 * view.origin[2], np.hypot(*(place - view.origin[:2])) - 0.5)] = 0.0
        if not odds.any():
            continue
        base = _changed(rng, known[rng.choice(len(known), p=odds / odds.sum())])
        put(base, np.append(place, 0.0))
        top = base.vertices[:, 2].max()
        if things and base.size[:2].min() > 0.4 and 0.4 < top < 1.3:
            for _ in range(int(rng.integers(0, 4))):
                spot = place + rng.uniform(-0.35, 0.35, 2) * base.size[:2]
                put(_changed(rng, things[rng.integers(len(things))]), np.append(spot, top))
    colour, share, _, drawn = painter.draw(meshes, view, depth)
    light = rng.uniform(0.7, 1.15) * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    out = picture * (1 - share[..., None]) + np.clip(colour * light, 0, 1)
    return out.astype(np.float32), np.where(share > 0.5, drawn, depth).astype(np.float32)
