"""The scene as triangles: for viewers (glTF), and for checking the renderer against another ray caster."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from avcli.scene import furniture
from avcli.scene.people import Bodies
from avcli.scene.scenario import Scenario


def rounded_cone(
    a: np.ndarray,
    b: np.ndarray,
    ra: float,
    rb: float,
    flat_axis: np.ndarray | None = None,
    flat: float = 1.0,
    segments: int = 32,
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate a rounded cone: the hull of two balls, flattened along one axis about its middle.

    Args:
        a, b: (3,) m, the ends of its axis.
        ra, rb: radii there, m.
        flat_axis: (3,) unit vector; None: z.
        flat: factor in (0, 1] along flat_axis.
        segments: number of meridians; half as many rings go from pole to pole.

    Returns:
        Vertices (n, 3) in m and faces (m, 3), counterclockwise from outside.
    """
    axis = np.array([0.0, 0.0, 1.0]) if flat_axis is None else flat_axis
    middle, swell = (a + b) / 2, (1.0 / flat - 1.0) * np.outer(axis, axis)
    a, b = (p + swell @ (p - middle) for p in (a, b))
    length = float(np.linalg.norm(b - a))
    if abs(ra - rb) >= length:  # one ball holds the other
        a, ra = (a, ra) if ra > rb else (b, rb)
        b, rb, length = a, ra, 0.0
    w = (b - a) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    u = np.cross(w, [1.0, 0, 0] if abs(w[0]) < 0.8 else [0, 1.0, 0])
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    # Where cone and balls meet, the normal leans by this angle; the rings of both balls end there.
    lean = np.arcsin((ra - rb) / length) if length > 0 else 0.0
    rings = segments // 4 + 1
    polar = np.concatenate([np.linspace(-np.pi / 2, lean, rings), np.linspace(lean, np.pi / 2, rings)])
    radius, centre = np.repeat([ra, rb], rings), np.repeat([a, b], rings, 0)
    turn = np.arange(segments) * 2 * np.pi / segments
    side = np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
    out = np.cos(polar)[:, None, None] * side + np.sin(polar)[:, None, None] * w
    vertices = (centre[:, None] + radius[:, None, None] * out).reshape(-1, 3)
    ring, k = np.meshgrid(np.arange(len(polar) - 1), np.arange(segments), indexing="ij")
    p, q = ring * segments + k, ring * segments + (k + 1) % segments
    faces = np.concatenate([np.stack([p, q, q + segments], -1), np.stack([p, q + segments, p + segments], -1)])
    shrink = np.eye(3) + (flat - 1.0) * np.outer(axis, axis)
    return middle + (vertices - middle) @ shrink, faces.reshape(-1, 3)


def bodies_triangles(bodies: Bodies, index: int, segments: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (n, 3, 3) in m of all people at one time, and the index of the cone that each belongs to, (n,)."""
    triangles = []
    for cone in range(len(bodies.ra)):
        vertices, faces = rounded_cone(
            bodies.a[index, cone], bodies.b[index, cone], bodies.ra[cone], bodies.rb[cone],
            bodies.flat_axis[index, cone], bodies.flat[cone], segments,
        )  # fmt: skip
        triangles.append(vertices[faces])
    owner = np.repeat(np.arange(len(triangles)), [len(t) for t in triangles])
    return np.concatenate([*triangles, np.zeros((0, 3, 3))]), owner


def solids_triangles(solids: furniture.Solids, segments: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (n, 3, 3) in m of furniture, and the index of the solid that each belongs to, (n,)."""
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    cube = furniture.CORNERS[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    turn = np.arange(segments + 1) * 2 * np.pi / segments
    rim = np.stack([np.cos(turn), np.sin(turn)], -1)
    low, high = (np.insert(rim, 2, z, axis=1) for z in (-1.0, 1.0))
    top, bottom = (np.tile([0.0, 0, z], (segments, 1)) for z in (1.0, -1.0))
    round_ = np.concatenate(
        [
            np.stack([low[:-1], low[1:], high[1:]], 1), np.stack([low[:-1], high[1:], high[:-1]], 1),
            np.stack([top, high[:-1], high[1:]], 1), np.stack([bottom, low[1:], low[:-1]], 1),
        ]
    )  # fmt: skip
    triangles = []
    for kind, centre, axes, half in zip(solids.kind, solids.centre, solids.axes, solids.half, strict=True):
        if kind == furniture.TRIANGLE:
            triangles.append(np.stack([centre, *axes[:2]])[None])
        elif kind == furniture.BALL:
            vertices, faces = rounded_cone(centre, centre, half[0], half[0], segments=segments)
            triangles.append(vertices[faces])
        else:
            triangles.append((cube if kind == furniture.BOX else round_) * half @ axes + centre)
    owner = np.repeat(np.arange(len(triangles)), [len(t) for t in triangles])
    return np.concatenate([*triangles, np.zeros((0, 3, 3))]), owner


def room_triangles(dimensions: ArrayLike, ceiling: bool = True) -> np.ndarray:
    """Triangles (12 or 10, 3, 3) in m of the room's floor, walls and, if asked for, ceiling, seen from inside."""
    size = np.asarray(dimensions, float)
    box = furniture.Solids(
        np.array([furniture.BOX]), size[None] / 2, np.eye(3)[None], size[None] / 2,
        np.zeros(1, int), np.zeros((1, 3)),
    )  # fmt: skip
    triangles = solids_triangles(box)[0][:, ::-1]
    return triangles if ceiling else triangles[~(triangles[..., 2] > 0.999 * size[2]).all(1)]


def glb(scenario: Scenario, bodies: Bodies, index: int) -> bytes:
    """Write a scene at one time as a binary glTF file, y up as glTF wants it.

    Args:
        scenario: its room, furniture and people; each of them is a node.
        bodies: the people, posed.
        index: of the time.

    Returns:
        The bytes of the file.
    """
    import trimesh

    scene = trimesh.Scene()
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

    def add(name: str, triangles: np.ndarray, colours: Any) -> None:
        mesh: Any = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
        rgba = np.concatenate([np.broadcast_to(colours, (len(triangles), 3)), np.ones((len(triangles), 1))], 1)
        mesh.visual.face_colors = np.round(255 * rgba).astype(np.uint8)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=y_up)

    room = scenario.config.room.dimensions
    add("room", room_triangles(room, ceiling=False), (0.62, 0.60, 0.57))
    triangles, owner = solids_triangles(scenario.solids)
    if len(triangles):
        add("furniture", triangles, scenario.solids.colour[owner])
    triangles, owner = bodies_triangles(bodies, index, 16)
    for number, person in enumerate(scenario.people):
        mine = bodies.person[owner] == number
        add(f"person {person.object_id}", triangles[mine], bodies.colours[owner[mine], 0])
    return scene.export(file_type="glb")
