"""People as skinned meshes: bodies, clothes and hair of MakeHuman, in the postures of avsim-scene's people.

The rounded cones of `generate.py` and of the renderer have no faces, hair, folds or shoulders, so that a network that
has seen nothing else misses who is near the camera or sits. MakeHuman's files are CC0 and no part of this project:

    FOLDER/core      github.com/makehumancommunity/makehuman, checked out
    FOLDER/assets    github.com/makehumancommunity/makehuman-assets, checked out

Colours and patterns are drawn at random, since shape and shade tell more than texture at the network's scale.

Source:
    N. Magnenat-Thalmann, R. Laperriere and D. Thalmann, "Joint-dependent local deformations for hand animation and
    object grasping", Graphics Interface 1988 (linear blend skinning).
"""

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import moderngl
import numpy as np
from generate import anchor, random_look
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from avcli.detection.monocular import PART_HEIGHTS
from avcli.detection.view import View
from avcli.scene.motion import Motion
from avcli.scene.person import Person
from avcli.scene.postures import LOADS, POSTURES, SEATED
from avcli.scene.skeleton import Skeleton, skeleton

BODY = 13380
"""Vertices of the base mesh that are the body; the others help to fit clothes."""
_SEGMENTS = (
    ("pelvis", ("root", "pelvis", "spine05")), ("waist", ("spine04", "spine03")),
    ("chest", ("spine02", "spine01", "breast", "clavicle", "shoulder01")),
    ("neck", ("neck",)), ("head", ()),
    *((f"{name}.{side}", bones) for side in "RL" for name, bones in (
        ("upperarm", ("upperarm",)), ("lowerarm", ("lowerarm",)), ("hand", ("wrist", "finger", "metacarpal")),
        ("thigh", ("upperleg",)), ("shank", ("lowerleg",)), ("foot", ("foot", "toe")),
    )),
)  # fmt: skip
"""The parts that move as one, and how the names of the rig's bones begin that belong to each; the rest is the head."""
SEGMENTS = [name for name, _ in _SEGMENTS]
"""Names of these parts."""
_HEADS = {
    "pelvis": "spine05", "waist": "spine04", "chest": "spine02", "neck": "neck01", "head": "head",
    "upperarm": "upperarm01", "lowerarm": "lowerarm01", "hand": "wrist",
    "thigh": "upperleg01", "shank": "lowerleg01", "foot": "foot",
}  # fmt: skip
_PARENTS = {
    "waist": "pelvis", "chest": "waist", "neck": "chest", "head": "neck", "upperarm": "chest", "lowerarm": "upperarm",
    "hand": "lowerarm", "thigh": "pelvis", "shank": "thigh", "foot": "shank",
}  # fmt: skip


def _room_axes(points: np.ndarray) -> np.ndarray:
    """MakeHuman's decimetres (left, up, front) in metres (front, left, up)."""
    return points[..., [2, 0, 1]] * 0.1


def _part_of(bone: str) -> int:
    side = bone[-2:] if bone[-2:] in (".L", ".R") else ""
    for index, (name, begins) in enumerate(_SEGMENTS):
        if bone.startswith(begins) and begins and (name[-2:] == side or "." not in name):
            return index
    return SEGMENTS.index("head")


@dataclass
class Mesh:
    """A surface that follows the base mesh.

    Attributes:
        triangles: (t, 3).
        corners: (n, 3) vertices of the base mesh that carry each vertex, by weights (n, 3).
        offsets: (n, 3) from there, MakeHuman's axes, in units of `scales`.
        scales: of each axis, two vertices of the base mesh and their distance: (3, 3).
        hides: (BODY,) bool, the vertices of the body that it covers.
        pieces: (n,) number of the connected piece each vertex belongs to, from the lowest to the highest.
    """

    triangles: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    offsets: np.ndarray
    scales: np.ndarray
    hides: np.ndarray
    pieces: np.ndarray

    def fitted(self, base: np.ndarray) -> np.ndarray:
        """Places (n, 3) on a body (vertices, 3)."""
        first, second, apart = self.scales[:, 0].astype(int), self.scales[:, 1].astype(int), self.scales[:, 2]
        scale = np.abs(base[first, range(3)] - base[second, range(3)]) / apart
        return np.einsum("nk,nkd->nd", self.weights, base[self.corners]) + self.offsets * scale


def _faces(path: Path, group: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (t, 3) of a Wavefront file, or of one group's faces."""
    vertices, triangles, inside = [], [], group is None
    for line in path.read_text().splitlines():
        if line.startswith("v "):
            vertices.append([float(value) for value in line.split()[1:4]])
        elif line.startswith("g ") and group is not None:
            inside = line.split()[1] == group
        elif line.startswith("f ") and inside:
            corners = [int(corner.split("/")[0]) - 1 for corner in line.split()[1:]]
            triangles += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    return np.array(vertices), np.array(triangles)


def _mesh(path: Path) -> Mesh:
    """Read a piece of clothing or hair (.mhclo)."""
    carried, hides, scales, file, section = [], np.zeros(BODY, bool), np.zeros((3, 3)), "", ""
    for line in path.read_text().splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] in ("verts", "delete_verts", "weights"):
            section = words[0]
        elif words[0] in ("x_scale", "y_scale", "z_scale"):
            scales["xyz".index(words[0][0])] = [float(value) for value in words[1:4]]
        elif words[0] == "obj_file":
            file = words[1]
        elif section == "verts" and words[0].isdigit():
            row = [float(value) for value in words]
            carried.append(row if len(row) == 9 else [row[0]] * 3 + [1.0, 0, 0] + [0.0] * 3)
        elif section == "delete_verts" and words[0].isdigit():
            for part in " ".join(words).replace(" - ", "-").split():
                begin, _, end = part.partition("-")
                hides[int(begin) : int(end or begin) + 1] = True
    rows = np.array(carried)
    vertices, triangles = _faces(path.with_name(file))
    n = len(vertices)
    edges = coo_matrix((np.ones(len(triangles)), (triangles[:, 0], triangles[:, 1])), (n, n))
    edges += coo_matrix((np.ones(len(triangles)), (triangles[:, 1], triangles[:, 2])), (n, n))
    count, piece = connected_components(edges, directed=False)
    middle = np.bincount(piece, vertices[:, 1], count) / np.bincount(piece, minlength=count)
    order = np.argsort(np.argsort(middle))
    return Mesh(triangles, rows[:, :3].astype(int), rows[:, 3:6], rows[:, 6:9], scales, hides, order[piece])


class Wardrobe:
    """Bodies and what they wear.

    Args:
        folder: with `core` and `assets`, see above.
    """

    def __init__(self, folder: Path):
        self._morphs: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._targets = folder / "core/makehuman/data/targets/macrodetails"
        self.base, self.skin = _faces(folder / "core/makehuman/data/3dobjs/base.obj", "body")
        rig = json.loads((folder / "core/makehuman/data/rigs/default.mhskel").read_text())
        self.joints = {
            name: np.array(rig["joints"][rig["bones"][bone]["head"]])
            for name, bone in _HEADS.items() if name in SEGMENTS
        } | {
            f"{name}{side}": np.array(rig["joints"][rig["bones"][f"{bone}{side}"]["head"]])
            for name, bone in _HEADS.items() for side in (".L", ".R") if f"{name}{side}" in SEGMENTS
        }  # fmt: skip
        self.toes = {side: np.array(rig["joints"][rig["bones"][f"foot.{side}"]["tail"]]) for side in "LR"}
        self.weights = np.zeros((len(self.base), len(SEGMENTS)))
        bones = json.loads((folder / "core/makehuman/data/rigs/default_weights.mhw").read_text())["weights"]
        for bone, rows in bones.items():
            vertices, shares = np.array(rows).reshape(-1, 2).T
            np.add.at(self.weights, (vertices.astype(int), _part_of(bone)), shares)
        self.weights /= np.maximum(self.weights.sum(1, keepdims=True), 1e-9)
        files = sorted((folder / "assets/base/clothes").glob("*/*.mhclo"))
        named = {path.stem: _mesh(path) for path in files}
        self.suits = {
            sex: [mesh for name, mesh in named.items() if name.startswith(f"{sex}_")] for sex in ("female", "male")
        }
        self.shoes = [mesh for name, mesh in named.items() if name.startswith("shoes")]
        self.hats = [mesh for name, mesh in named.items() if name.startswith("fedora")]
        self.hair = [_mesh(path) for path in sorted((folder / "assets/base/hair").glob("*/*.mhclo"))]

    def target(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (k,) of a morph and how far each moves (k, 3)."""
        if name not in self._morphs:
            lines = (self._targets / f"{name}.target").read_text().splitlines()
            rows = np.array([[float(v) for v in line.split()] for line in lines if line[:1].isdigit()]).reshape(-1, 4)
            self._morphs[name] = rows[:, 0].astype(int), rows[:, 1:]
        return self._morphs[name]

    def body(self, rng: np.random.Generator, sex: str) -> np.ndarray:
        """The vertices of a random body, of the base mesh and what helps to fit clothes: (n, 3) decimetres."""
        shares: dict[str, float] = {}
        races, age = rng.dirichlet([0.4, 0.4, 0.4]), float(np.clip(rng.beta(1, 2), 0, 1))
        for years, much in (("young", 1 - age), ("old", age)):
            for race, part in zip(("african", "asian", "caucasian"), races, strict=True):
                shares[f"{race}-{sex}-{years}"] = part * much
            for _ in range(2):
                muscle = rng.choice(["averagemuscle", "minmuscle", "maxmuscle"], p=[0.6, 0.25, 0.15])
                weight = rng.choice(["averageweight", "minweight", "maxweight"], p=[0.5, 0.2, 0.3])
                name = f"universal-{sex}-{years}-{muscle}-{weight}"
                shares[name] = shares.get(name, 0.0) + 0.5 * much
        out = self.base.copy()
        for name, share in shares.items():
            if share > 0.02 and (self._targets / f"{name}.target").exists():
                vertices, moves = self.target(name)
                out[vertices] += share * moves
        return out


@dataclass
class Figure:
    """A person in clothes, at rest: vertices (n, 3) m, weights (n, segments), triangles (t, 3), colours (n, 3)."""

    vertices: np.ndarray
    weights: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray
    joints: dict[str, np.ndarray]
    toes: dict[str, np.ndarray]


Dress = Callable[[np.random.Generator, float], Figure]
"""Makes a random person of a height in m."""


def colour_of_cloth(rng: np.random.Generator) -> np.ndarray:
    """Often black, grey, blue or white, sometimes any colour: (3,) sRGB fractions."""
    kind = rng.random()
    if kind < 0.35:
        return np.clip(rng.uniform(0.02, 0.16) + rng.normal(0, 0.012, 3), 0, 1)
    if kind < 0.55:
        return np.clip(rng.uniform(0.15, 0.9) + rng.normal(0, 0.02, 3), 0, 1)
    hue = rng.uniform(95, 125) if kind < 0.7 else rng.uniform(0, 180)
    hsv = np.array([[[hue, 255 * rng.beta(1.5, 1.5), 255 * (0.08 + 0.85 * rng.beta(1.3, 1.6))]]], np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0] / 255.0


def _waves(rng: np.random.Generator, points: np.ndarray, length: float, count: int = 5) -> np.ndarray:
    """Smooth noise (n,) of about unit variance at points (n, 3), of a wavelength in m."""
    ways = rng.normal(0, 2 * np.pi / length, (count, 3))
    return np.sin(points @ ways.T + rng.uniform(0, 6.3, count)).sum(1) / np.sqrt(count / 2)


def _cloth(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Colours (n, 3) of a piece of cloth: plain, striped, checked, printed or with sleeves of another colour."""
    colour, other = colour_of_cloth(rng), colour_of_cloth(rng)
    kind, amount = rng.random(), np.zeros(len(points))
    if kind < 0.12:
        amount = (np.sin(points[:, 2] * 2 * np.pi / rng.uniform(0.04, 0.15)) > 0).astype(float)
    elif kind < 0.2:
        side = rng.uniform(0.05, 0.12)
        amount = 0.5 * ((points[:, 2] // side + points[:, 1] // side) % 2)
    elif kind < 0.3:
        amount = np.clip(_waves(rng, points, rng.uniform(0.08, 0.3)), 0, 1)
    elif kind < 0.38:
        amount = (np.abs(points[:, 1]) > 0.2).astype(float)
    elif kind < 0.45:
        amount = ((points[:, 0] > 0) & (np.abs(points[:, 1]) < rng.uniform(0.03, 0.12))).astype(float)
    return colour + amount[:, None] * (other - colour)


def figure(wardrobe: Wardrobe, rng: np.random.Generator, height: float) -> Figure:
    """A random person of a height in m, in random clothes."""
    sex = str(rng.choice(["female", "male"]))
    body = wardrobe.body(rng, sex)
    tone = rng.uniform(0.2, 1.0)
    skin = np.clip(tone * np.array([0.93, 0.73, 0.60]) + rng.normal(0, 0.02, 3), 0, 1)
    worn = [wardrobe.suits[sex][rng.integers(len(wardrobe.suits[sex]))]]
    worn.append(wardrobe.shoes[rng.integers(len(wardrobe.shoes))])
    bald = rng.random() < 0.1
    if not bald:
        worn.append(wardrobe.hair[rng.integers(len(wardrobe.hair))])
    if rng.random() < 0.08 and wardrobe.hats:
        worn.append(wardrobe.hats[rng.integers(len(wardrobe.hats))])
    shade = rng.choice([0.06, 0.15, 0.35, 0.6, 0.75], p=[0.4, 0.25, 0.15, 0.1, 0.1])
    hair = np.clip(shade * np.array([1.0, rng.uniform(0.7, 1), rng.uniform(0.45, 1)]), 0, 1)
    hidden = functools.reduce(np.logical_or, [mesh.hides for mesh in worn])
    keep = ~hidden[wardrobe.skin].all(1)
    parts = [(body[:BODY], wardrobe.weights[:BODY], wardrobe.skin[keep], np.tile(skin, (BODY, 1)))]
    for index, mesh in enumerate(worn):
        places = mesh.fitted(body)
        weights = np.einsum("nk,nks->ns", mesh.weights, wardrobe.weights[mesh.corners])
        weights = np.maximum(weights, 0) / np.maximum(np.maximum(weights, 0).sum(1, keepdims=True), 1e-9)
        points, colours = _room_axes(places), np.zeros((len(places), 3))
        for piece in range(int(mesh.pieces.max()) + 1):
            own = mesh.pieces == piece
            colours[own] = hair if index == 2 and not bald else _cloth(rng, points[own])
        parts.append((places, weights, mesh.triangles, colours))
    starts = np.cumsum([0] + [len(part[0]) for part in parts])
    vertices = _room_axes(np.concatenate([part[0] for part in parts]))
    made = Figure(
        vertices, np.concatenate([part[1] for part in parts]),
        np.concatenate([part[2] + start for part, start in zip(parts, starts[:-1], strict=True)]),
        np.concatenate([part[3] for part in parts]),
        {name: _room_axes(body[rows].mean(0)) for name, rows in wardrobe.joints.items()},
        {side: _room_axes(body[rows].mean(0)) for side, rows in wardrobe.toes.items()},
    )  # fmt: skip
    return settled(made, height, _room_axes(body[:BODY])[:, 2])


def settled(made: Figure, height: float, levels: np.ndarray | None = None) -> Figure:
    """A figure on the floor and of a height in m, which is that of its vertices or of `levels` (n,)."""
    levels = made.vertices[:, 2] if levels is None else levels
    low, scale = np.array([0, 0, levels.min()]), height / np.ptp(levels)
    return Figure(
        (made.vertices - low) * scale, made.weights, made.triangles, made.colours,
        {name: (place - low) * scale for name, place in made.joints.items()},
        {side: (place - low) * scale for side, place in made.toes.items()},
    )  # fmt: skip


# --- postures ---------------------------------------------------------------------------------------------------------


def _aligned(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The least rotation (3, 3) that turns a vector's direction into another's (Rodrigues)."""
    a, b = one / np.linalg.norm(one), other / np.linalg.norm(other)
    v, c = np.cross(a, b), float(a @ b)
    if c < -0.9999:
        return np.eye(3)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c)


def _frame(front: np.ndarray, left: np.ndarray) -> np.ndarray:
    up = np.cross(front, left)
    U, _, V = np.linalg.svd(np.column_stack([front, left, up]))
    return U @ V


def _between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    U, _, V = np.linalg.svd(one + other)
    return U @ V


def posed(body: Figure, bones: Skeleton, k: int) -> np.ndarray:
    """The vertices (n, 3) m of a figure in the k-th posture of a skeleton, in the room."""
    trunk, joints = bones.trunk, body.joints
    turn = {
        "pelvis": _frame(trunk.pelvis_front[k], trunk.pelvis_left[k]),
        "chest": _frame(trunk.chest_front[k], trunk.chest_left[k]),
        "head": _frame(bones.head.front[k], bones.head.left[k]),
    }
    turn["waist"] = _between(turn["pelvis"], turn["chest"])
    turn["neck"] = _between(turn["chest"], turn["head"])
    for side, arm, leg in zip("RL", bones.arms, bones.legs, strict=True):
        chain = (
            ("upperarm", "lowerarm", "chest", arm.elbow - arm.shoulder),
            ("lowerarm", "hand", "upperarm", arm.wrist - arm.elbow),
            ("thigh", "shank", "pelvis", leg.knee - leg.hip),
            ("shank", "foot", "thigh", leg.ankle - leg.knee),
            ("foot", "", "shank", leg.toe - leg.ankle),
        )
        for name, after, before, way in chain:
            end = joints[f"{after}.{side}"] if after else body.toes[side]
            parent = turn[before if before in turn else f"{before}.{side}"]
            rest = parent @ (end - joints[f"{name}.{side}"])
            turn[f"{name}.{side}"] = _aligned(rest, way[k]) @ parent
        turn[f"hand.{side}"] = turn[f"lowerarm.{side}"]
    hips = (joints["thigh.R"] + joints["thigh.L"]) / 2
    place = {"pelvis": trunk.pelvis[k] + turn["pelvis"] @ (joints["pelvis"] - hips)}
    for name in SEGMENTS[1:]:
        stem, _, side = name.partition(".")
        before = _PARENTS[stem]
        before = before if before in place else f"{before}.{side}"
        place[name] = place[before] + turn[before] @ (joints[name] - joints[before])
    moved = np.stack([(body.vertices - joints[name]) @ turn[name].T + place[name] for name in SEGMENTS], 1)
    out = np.einsum("ns,nsd->nd", body.weights, moved)
    out[:, 2] -= min(out[:, 2].min(), 0.0) if bones.trunk.sit[k] > 0.5 else out[:, 2].min()
    return out


def somebody(rng: np.random.Generator, place: np.ndarray, seat: float | None = None) -> Person:
    """Somebody at a place (2,) m, who walks, stands, sits or does something, or looks from a `seat` (rad)."""
    height = float(np.clip(rng.normal(1.70, 0.12), 1.1, 2.0))
    kind, turn = rng.random(), rng.uniform(0, 2 * np.pi)
    postures = sorted(POSTURES)
    name = postures[rng.integers(len(postures))] if kind > 0.65 else ("sit" if kind > 0.55 else "stand")
    if seat is not None:
        kind, name, turn = 1.0, SEATED[rng.integers(len(SEATED))], seat + rng.normal(0, 0.2)
    walks = 10.0 * (rng.uniform(0.4, 1.8) if kind < 0.4 else 0.0)
    way = np.array([np.cos(turn), np.sin(turn)])
    places = place + np.array([[-0.5], [0.5]]) * walks * way
    motion = Motion(np.array([0.0, 10.0]), places, np.full(2, turn), np.full(2, name in SEATED), height, (name, name))
    carries = str(rng.choice(sorted(LOADS))) if kind < 0.55 and rng.random() < 0.25 else None
    speech = np.array([[0.0, 10.0]]) if rng.random() < 0.4 else np.empty((0, 2))
    return Person(int(rng.integers(1000)), motion, random_look(rng, height), height, speech, carries=carries)


# --- drawing ----------------------------------------------------------------------------------------------------------

_VERTEX = """
#version 330
in vec3 at; in vec3 colour; in float owner;
out vec3 paint; flat out float who;
void main() { gl_Position = vec4(at, 1.0); paint = colour; who = owner; }
"""
_FRAGMENT = """
#version 330
in vec3 paint; flat in float who;
layout(location = 0) out vec4 picture; layout(location = 1) out vec4 owner;
void main() { picture = vec4(paint, 1.0); owner = vec4(who / 255.0, 0.0, 0.0, 1.0); }
"""
_ROOM_VERTEX = """
#version 330
in vec2 at;
out vec2 place;
void main() { place = 0.5 * at + 0.5; gl_Position = vec4(at, 0.0, 1.0); }
"""
_ROOM_FRAGMENT = """
#version 330
uniform sampler2D depth;
in vec2 place;
layout(location = 0) out vec4 picture; layout(location = 1) out vec4 owner;
void main() { gl_FragDepth = texture(depth, place).r; picture = vec4(0.0); owner = vec4(0.0); }
"""
_FAR = 60.0
"""m; the depth that is 1."""
_FINE = 2
"""Samples a pixel along each side."""


class Painter:
    """Draws figures into pictures of rooms whose depth is known."""

    def __init__(self, context: moderngl.Context):
        self.context = context
        self._people = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._room = context.program(vertex_shader=_ROOM_VERTEX, fragment_shader=_ROOM_FRAGMENT)
        corners = context.buffer(np.array([-1, -1, 3, -1, -1, 3], np.float32).tobytes())
        self._whole = context.vertex_array(self._room, [(corners, "2f", "at")])
        self._size = (0, 0)

    def _target(self, size: tuple[int, int]) -> moderngl.Framebuffer:
        if size != self._size:
            self._size = size
            made = [self.context.texture(size, 4) for _ in range(2)]
            self._frame = self.context.framebuffer(made, self.context.depth_renderbuffer(size))
        return self._frame

    def draw(
        self, meshes: list[tuple[np.ndarray, np.ndarray, np.ndarray]], view: View, depth: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Draw figures: each its vertices (n, 3) m, triangles (t, 3) and colours (n, 3) of its surface in light.

        Args:
            meshes: of people or things.
            view: of the camera.
            depth: (height, width) m along each ray, of what may hide them; infinite where nothing does.

        Returns:
            colour (height, width, 3) float32, the share of figures in each pixel (height, width), which one it shows
            (height, width) uint8, 1 the first, and the depth (height, width) m with them.
        """
        width, height = view.size
        frame = self._target((_FINE * width, _FINE * height))
        frame.use()
        self.context.disable(moderngl.CULL_FACE | moderngl.BLEND)
        self.context.enable(moderngl.DEPTH_TEST)
        frame.clear(depth=1.0)
        known = np.where(np.isfinite(depth) & (depth > 0), np.clip(depth / _FAR, 0, 1), 1.0).astype(np.float32)
        texture = self.context.texture((width, height), 1, known.tobytes(), dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        texture.use(0)
        self.context.depth_func = "1"
        self._whole.render()
        self.context.depth_func = "<"
        for index, (vertices, triangles, colours) in enumerate(meshes):
            at, shown = projected(vertices, triangles, view)
            if not len(shown):
                continue
            rows = np.column_stack([at, colours, np.full(len(at), index + 1)]).astype(np.float32)
            buffers = self.context.buffer(rows.tobytes()), self.context.buffer(shown.astype(np.int32).tobytes())
            layout = [(buffers[0], "3f 3f 1f", "at", "colour", "owner")]
            array = self.context.vertex_array(self._people, layout, buffers[1])
            array.render()
            for made in (array, *buffers):
                made.release()
        texture.release()
        paint = np.frombuffer(frame.read(components=4, attachment=0), np.uint8).reshape(_FINE * height, -1, 4)
        owner = np.frombuffer(frame.read(components=4, attachment=1), np.uint8).reshape(_FINE * height, -1, 4)[..., 0]
        colour = cv2.resize(paint, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        share = colour[..., 3]
        reached = np.frombuffer(frame.read(components=1, attachment=-1, dtype="f4"), np.float32)
        reached = _FAR * reached.reshape(_FINE * height, -1)[::_FINE, ::_FINE]
        return colour[..., :3], share, np.ascontiguousarray(owner[::_FINE, ::_FINE]), reached


def projected(vertices: np.ndarray, triangles: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Places of vertices (n, 3) in the picture as the painter wants them, and the triangles that are wholly seen."""
    pixels = view.project(vertices)
    good = np.isfinite(pixels).all(1)
    away = np.linalg.norm(vertices - view.origin, axis=1)
    size = np.array(view.size)
    # Row 0 of what is read back is the picture's first one.
    place = 2 * (np.nan_to_num(pixels) + 0.5) / size - 1
    at = np.column_stack([place, 2 * np.clip(away / _FAR, 0, 1) - 1])
    return at, triangles[good[triangles].all(1)]


def lit(
    rng: np.random.Generator, vertices: np.ndarray, triangles: np.ndarray, colours: np.ndarray, folds: bool = True
) -> np.ndarray:
    """Colours (n, 3) of a surface in the light of a room: lamps above, and the folds of cloth."""
    edges = vertices[triangles[:, 1:]] - vertices[triangles[:, :1]]
    across = np.cross(edges[:, 0], edges[:, 1])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    if folds:
        waves = np.column_stack([_waves(rng, vertices, length) for length in (0.06, 0.12, 0.25)])
        normals = normals + rng.uniform(0.05, 0.3) * waves
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = 0.32 + 0.22 * normals[:, 2]
    for _ in range(int(rng.integers(1, 4))):
        way = np.append(rng.normal(0, 0.5, 2), 1.0)
        light = light + rng.uniform(0.15, 0.5) * np.maximum(normals @ (way / np.linalg.norm(way)), 0)
    low = np.clip(vertices[:, 2] / 1.2, 0, 1)
    light = light * (0.55 + 0.45 * low)  # the floor is darker below tables and people
    return np.clip(colours * light[:, None] * rng.uniform(0.8, 1.3), 0, 1)


@dataclass
class Seen:
    """Who is seen, see `generate.Sample`."""

    boxes: np.ndarray
    parts: np.ndarray
    anchors: np.ndarray
    visible: np.ndarray


def paint_people(
    rng: np.random.Generator,
    painter: Painter,
    dress: Sequence[Dress],
    picture: np.ndarray,
    depth: np.ndarray,
    view: View,
    people: Sequence[Person],
    t: float,
) -> tuple[np.ndarray, np.ndarray, Seen]:
    """Draw people into a picture of a room.

    Args:
        dress: makes the figures; each person's is one of them.
        picture: (height, width, 3) float in 0 to 1.
        depth: (height, width) m along each ray.
        people: each is dressed anew.
        t: s, when.

    Returns:
        the picture, whom each pixel shows (height, width) uint8, and the labels.
    """
    meshes = []
    for person in people:
        body = dress[rng.integers(len(dress))](rng, person.height)
        at = posed(body, skeleton(person, np.array([t])), 0)
        meshes.append((at, body.triangles, lit(rng, at, body.triangles, body.colours)))
    picture = picture * _shade(people, meshes, view, depth, rng)[..., None]
    colour, share, owner, _ = painter.draw(meshes, view, depth)
    light = rng.uniform(0.7, 1.15) * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    out = picture * (1 - share[..., None]) + np.clip(colour * light, 0, 1)
    boxes, parts, anchors, visible = [], [], [], []
    nothing = np.full(depth.shape, np.inf)
    for index, (person, mesh) in enumerate(zip(people, meshes, strict=True)):
        v, u = np.nonzero(owner == index + 1)
        if len(v) < 8:
            continue
        alone = painter.draw([mesh], view, nothing)[2]
        within = view.inside(view.project(mesh[0])).mean()
        stand = person.motion.position(np.array([t]))[0]
        axis = np.column_stack([np.tile(stand, (3, 1)), PART_HEIGHTS * mesh[0][:, 2].max()])
        box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float)
        points = view.project(axis) + 0.5
        if not np.isfinite(points).all():
            points = np.tile((box[:2] + box[2:]) / 2, (3, 1))
        boxes.append(box)
        parts.append(points)
        anchors.append(anchor(v, u, points[0]))
        visible.append(min(len(v) / max(int((alone > 0).sum()), 1), within))
    seen = Seen(
        np.array(boxes).reshape(-1, 4), np.array(parts).reshape(-1, 3, 2), np.array(anchors).reshape(-1, 2),
        np.array(visible),
    )  # fmt: skip
    return out.astype(np.float32), owner, seen


def _shade(people, meshes, view: View, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """How much darker (height, width) the floor is about people's feet."""
    dark = np.zeros(depth.shape, np.float32)
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    for mesh in meshes:
        low = mesh[0][mesh[0][:, 2] < 0.3]
        middle = (low if len(low) else mesh[0]).mean(0)
        ring = np.column_stack([middle[0] + 0.35 * np.cos(angle), middle[1] + 0.35 * np.sin(angle), np.zeros(16)])
        pixels = view.project(ring)
        if np.isfinite(pixels).all():
            cv2.fillConvexPoly(dark, (pixels * 16).astype(np.int32), 1.0, shift=4)
    size = max(3, min(dark.shape) // 24 * 2 + 1)
    return 1 - cv2.blur(dark, (size, size)) * np.float32(rng.uniform(0.1, 0.55))
