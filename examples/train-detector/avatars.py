"""People as skinned meshes with painted clothes, faces and hair: the avatars of VALID, in the postures of meshes.py.

Each file of the folder is one avatar in glTF 2.0's binary form, with a skin whose joints have the names of Mixamo's
(Hips, Spine, LeftArm ...) and surfaces compressed by EXT_meshopt_compression. VALID's 210 avatars are under the MIT
licence (copyright 2022 Tiffany Do) and no part of this project: github.com/c-frame/valid-avatars-glb, folder `avatars`.
Needs meshoptimizer. Textures are read at the vertices, since a person is some hundred pixels tall for the network.

Source:
    T. D. Do, S. Zelenty, M. Gonzalez-Franco and R. P. McMahan, "VALID: a perceptually validated virtual avatar library
    for inclusion and diversity", Frontiers in Virtual Reality 4, 2023.
"""

import functools
import json
import struct
from pathlib import Path

import cv2
import meshoptimizer
import numpy as np
from meshes import SEGMENTS, Figure, colour_of_cloth, settled

_BONES = {
    "pelvis": "Hips", "waist": "Spine", "chest": "Spine1", "neck": "Neck", "head": "Head",
    "upperarm": "Arm", "lowerarm": "ForeArm", "hand": "Hand", "thigh": "UpLeg", "shank": "Leg", "foot": "Foot",
}  # fmt: skip
"""The joint at which each part begins; those of arms and legs have a side before their names."""

_INSIDE = ("gland", "Teeth")
"""How the names of surfaces that nobody sees go on."""

_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

_TEXTURE = 256
"""px, the side to which a texture is reduced before it is read at the vertices."""


class _File:
    """A binary glTF file whose buffer views are compressed or not."""

    def __init__(self, path: Path):
        data = path.read_bytes()
        size = struct.unpack_from("<I", data, 12)[0]
        self.content = json.loads(data[20 : 20 + size])
        self._binary = data[28 + size :]
        self.view, self.picture = functools.cache(self._view), functools.cache(self._picture)

    def _view(self, index: int) -> bytes:
        """The bytes of a buffer view."""
        view = self.content["bufferViews"][index]
        packed = view.get("extensions", {}).get("EXT_meshopt_compression")
        if not packed:
            return self._binary[(start := view.get("byteOffset", 0)) : start + view["byteLength"]]
        start, count, stride = packed.get("byteOffset", 0), packed["count"], packed["byteStride"]
        raw = self._binary[start : start + packed["byteLength"]]
        if packed["mode"] == "TRIANGLES":
            return meshoptimizer.decode_index_buffer(count, 4, raw).astype(f"u{stride}").tobytes()
        return meshoptimizer.decode_vertex_buffer(count, stride, raw, dtype=np.dtype(f"V{stride}")).tobytes()

    def array(self, index: int) -> np.ndarray:
        """What an accessor holds (count, width), normalized integers as fractions."""
        made = self.content["accessors"][index]
        kind, width, count = np.dtype(_TYPES[made["componentType"]]), _WIDTHS[made["type"]], made["count"]
        stride = self.content["bufferViews"][made["bufferView"]].get("byteStride", kind.itemsize * width)
        data, start = self.view(made["bufferView"]), made.get("byteOffset", 0)
        out = np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))
        return np.maximum(out / np.iinfo(kind).max, -1.0) if made.get("normalized") else out

    def globals(self) -> list[np.ndarray]:
        """Each node's place (4, 4) in the scene."""
        nodes = self.content["nodes"]
        places: list[np.ndarray] = [np.eye(4)] * len(nodes)

        def walk(index: int, above: np.ndarray) -> None:
            node = nodes[index]
            x, y, z, w = node.get("rotation", (0, 0, 0, 1))
            turn = np.array([
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ])  # fmt: skip
            own = np.eye(4)
            own[:3, :3], own[:3, 3] = turn * node.get("scale", (1, 1, 1)), node.get("translation", (0, 0, 0))
            places[index] = above @ own
            for child in node.get("children", ()):
                walk(child, places[index])

        for root in self.content["scenes"][self.content.get("scene", 0)]["nodes"]:
            walk(root, np.eye(4))
        return places

    def colours(self, made: dict) -> np.ndarray:
        """The colours of a surface's vertices: (n, 3) sRGB fractions; grey where it is not painted."""
        count = self.content["accessors"][made["attributes"]["POSITION"]]["count"]
        painted = self.content["materials"][made["material"]].get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if not painted or "TEXCOORD_0" not in made["attributes"]:
            return np.full((count, 3), 0.4, np.float32)
        u, v = (self.array(made["attributes"]["TEXCOORD_0"]) % 1.0 * (_TEXTURE - 1)).astype(int).T
        return self.picture(painted["index"])[v, u]

    def _picture(self, texture: int) -> np.ndarray:
        """A texture, reduced: (side, side, 3) sRGB fractions."""
        made = self.content["textures"][texture]
        source = made.get("extensions", {}).get("EXT_texture_webp", made)["source"]
        coded = np.frombuffer(self.view(self.content["images"][source]["bufferView"]), np.uint8)
        picture = cv2.imdecode(coded, cv2.IMREAD_REDUCED_COLOR_2)[..., ::-1]
        return cv2.resize(picture, (_TEXTURE, _TEXTURE), interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def _bone_of(segment: str) -> str:
    stem, _, side = segment.partition(".")
    return {"R": "Right", "L": "Left", "": ""}[side] + _BONES[stem]


def _read(path: Path) -> Figure:
    """An avatar at rest, in the height in which it was made."""
    file = _File(path)
    nodes, places = file.content["nodes"], file.globals()
    index = {node.get("name"): k for k, node in enumerate(nodes)}
    begins = {index[_bone_of(name)]: k for k, name in enumerate(SEGMENTS)}
    parent = {child: k for k, node in enumerate(nodes) for child in node.get("children", ())}

    def segment(joint: int) -> int:
        while joint not in begins:
            joint = parent[joint]
        return begins[joint]

    parts, start = [], 0
    for node in nodes:
        if "mesh" not in node or any(word in node["name"] for word in _INSIDE):
            continue
        skin = file.content["skins"][node["skin"]]
        bind = file.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        moves = np.stack([places[joint] for joint in skin["joints"]]) @ bind
        own = np.array([segment(joint) for joint in skin["joints"]])
        for made in file.content["meshes"][node["mesh"]]["primitives"]:
            point = file.array(made["attributes"]["POSITION"])
            which, share = file.array(made["attributes"]["JOINTS_0"]), file.array(made["attributes"]["WEIGHTS_0"])
            share = share / share.sum(axis=1, keepdims=True)
            moved = np.einsum("nkij,nj->nki", moves[which][:, :, :3], np.column_stack([point, np.ones(len(point))]))
            vertices = np.einsum("nk,nki->ni", share, moved)[:, [2, 0, 1]]  # (left, up, front) to (front, left, up)
            weights = np.zeros((len(point), len(SEGMENTS)))
            np.add.at(weights, (np.arange(len(point))[:, None], own[which]), share)
            triangles = file.array(made["indices"]).reshape(-1, 3).astype(int) + start
            parts.append((vertices, weights, triangles, file.colours(made)))
            start += len(point)
    vertices, weights, triangles, colours = (np.concatenate(item) for item in zip(*parts, strict=True))
    spot = {name: places[index[name]][:3, 3][[2, 0, 1]] for name in index if name}
    return Figure(
        vertices, weights.astype(np.float32), triangles, colours, {name: spot[_bone_of(name)] for name in SEGMENTS},
        {"L": spot["LeftToeBase"], "R": spot["RightToeBase"]},
    )  # fmt: skip


class Avatars:
    """The avatars in a folder, read when they are first asked for.

    Args:
        folder: with the files, at any depth.
    """

    def __init__(self, folder: Path):
        self._paths = sorted(folder.rglob("*.glb"))
        if not self._paths:
            raise FileNotFoundError(f"{folder}: no avatars (*.glb)")
        self._read = functools.cache(_read)

    def __call__(self, rng: np.random.Generator, height: float) -> Figure:
        """A random avatar of a height in m, often in clothes of other colours."""
        made = settled(self._read(self._paths[rng.integers(len(self._paths))]), height)
        return made if rng.random() < 0.3 else redyed(rng, made)


def redyed(rng: np.random.Generator, made: Figure) -> Figure:
    """A figure whose clothes have other colours above and below the waist; skin, hair, folds and patterns stay."""
    index = {name: k for k, name in enumerate(SEGMENTS)}
    owner = made.weights.argmax(axis=1)
    bare = np.isin(owner, [index[name] for name in ("head", "neck", "hand.R", "hand.L")])
    skin = np.median(made.colours[np.isin(owner, [index["hand.R"], index["hand.L"]])], axis=0)
    hue = made.colours / np.maximum(made.colours.sum(axis=1, keepdims=True), 1e-3)
    like = np.abs(hue - skin / max(skin.sum(), 1e-3)).sum(axis=1) < 0.08
    like &= np.abs(made.colours.sum(axis=1) - skin.sum()) < 0.5
    low = np.isin(owner, [k for name, k in index.items() if name.startswith(("pelvis", "thigh", "shank"))])
    shoes = np.isin(owner, [index["foot.R"], index["foot.L"]])
    colours = made.colours.copy()
    for cloth in (~bare & ~like & low, ~bare & ~like & ~low & ~shoes):
        if cloth.any() and rng.random() < 0.8:
            bright = made.colours[cloth].mean(axis=1, keepdims=True)
            colours[cloth] = np.clip(colour_of_cloth(rng) * bright / max(float(bright.mean()), 0.02), 0, 1)
    return Figure(made.vertices, made.weights, made.triangles, colours, made.joints, made.toes)
