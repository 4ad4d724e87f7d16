"""The pass that draws the room and its furniture, once a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avcli import pose
from avcli.scene import furniture, room_shaders, shaders
from avcli.scene.canvas import COARSE, Canvas, bounds, clip, linear, put
from avcli.scene.look_shaders import LATTICE

if TYPE_CHECKING:
    import moderngl

    from avcli.scene.interior import Interior

_EDGE_SAMPLES = 17  # along each edge of a solid, whose image is a curve
_MARGIN_PX = 4.0


class RoomPicture(NamedTuple):
    """The empty room: distance and solid of each pixel, surface, colour, and, where it is dressed, light in its air."""

    seen: moderngl.Texture
    surface: moderngl.Texture
    colour: moderngl.Texture
    probes: moderngl.Texture3D | None


def _lattice(canvas: Canvas) -> moderngl.Texture3D:
    """Random numbers that patterns interpolate between; the same for all rooms."""
    values = np.random.default_rng(0).random((LATTICE,) * 3, dtype=np.float32).astype("f2")
    return canvas.ctx.texture3d(values.shape, 1, values.tobytes(), dtype="f2")


def draw_room(
    canvas: Canvas, solids: furniture.Solids, dressed: Interior | None = None, *, colour: bool = True
) -> RoomPicture:
    """Draw the room and the furniture: depth at the pixels' centres, colour antialiased where surfaces meet.

    Args:
        canvas: to draw with.
        solids: the furniture.
        dressed: the room's looks and light, None where it states none.
        colour: whether the room is coloured; otherwise it is black.
    """
    ctx, uniforms = canvas.ctx, canvas.surroundings
    blockers = furniture.blockers(solids)
    table = canvas.table(np.concatenate([_solid_rows(solids), _blocker_rows(blockers)]))
    found = _surfaces(canvas, solids, table)
    picture = ctx.texture(canvas.size, 4)
    probes = None if dressed is None else _probes(canvas, blockers, dressed)
    if not colour:
        return RoomPicture(found["seen"], found["surface"], picture, probes)
    light = _light(canvas, blockers, found, room_shaders.ROOM_LIGHT if dressed is None else dressed.shaders.room_light)
    inputs: dict[str, moderngl.Texture | moderngl.Texture3D] = {**found, "light": light, "solids": table}
    room_shade, room_smooth = room_shaders.ROOM_SHADE, room_shaders.ROOM_SMOOTH
    if dressed is not None:
        room_shade, room_smooth = dressed.shaders.room_shade, dressed.shaders.room_smooth
        inputs |= {"looks": canvas.table(dressed.looks), "lattice": _lattice(canvas)}
        uniforms = {**uniforms, "blockers": len(blockers), "blockers_from": max(len(solids), 1)}
    shade = canvas.program(shaders.FLAT_VERTEX, room_shade, **uniforms)
    canvas.fill(shade, ctx.framebuffer([picture]), inputs)
    if uniforms["samples"] > 1:
        marks = ctx.depth_renderbuffer(canvas.size)
        target = ctx.framebuffer(depth_attachment=marks)
        target.clear(depth=1.0)
        ctx.depth_func = "1"
        canvas.fill(canvas.program(shaders.FLAT_VERTEX, room_shaders.ROOM_EDGES), target, found, depth=True)
        target = ctx.framebuffer([picture], marks)
        target.depth_mask = False
        ctx.depth_func = ">"
        smooth = canvas.program(shaders.FLAT_VERTEX, room_smooth, **uniforms, level=0.5)
        canvas.fill(smooth, target, inputs, depth=True)
        ctx.depth_func = "<"
    return RoomPicture(found["seen"], found["surface"], picture, probes)


def _surfaces(canvas: Canvas, solids: furniture.Solids, table: moderngl.Texture) -> dict[str, moderngl.Texture]:
    """What each pixel sees, and how far it is."""
    ctx, size = canvas.ctx, canvas.size
    rectangles = np.concatenate([[[0, 0, *size]], _rectangles(canvas, solids)])
    index = np.arange(-1, len(solids))[:, None]
    program = canvas.program(room_shaders.ROOM_VERTEX, room_shaders.ROOM_FRAGMENT, **canvas.surroundings, solids=0)
    put(program, size=size)
    seen, surface = ctx.texture(size, 2, dtype="f4"), ctx.texture(size, 4, dtype="f2")
    target = ctx.framebuffer([seen, surface], ctx.depth_renderbuffer(size))
    target.use()
    target.clear(0, 0, 0, 0)
    table.use(0)
    ctx.enable(ctx.DEPTH_TEST)
    canvas.quads(program, np.hstack([rectangles, index]), "4f 1f/i", ("rectangle", "solid"))
    return {"seen": seen, "surface": surface}


def _light(
    canvas: Canvas, blockers: furniture.Solids, found: dict[str, moderngl.Texture], shader: str
) -> moderngl.Texture:
    """How much light reaches each place past the furniture, on a coarse grid, blurred."""
    ctx, size = canvas.ctx, canvas.size
    grid = -(-size[0] // COARSE), -(-size[1] // COARSE)
    raw, smooth = ctx.texture(grid, 1, dtype="f2"), ctx.texture(grid, 4, dtype="f4")
    light = canvas.program(shaders.FLAT_VERTEX, shader, **canvas.surroundings, blockers=len(blockers))
    canvas.fill(light, ctx.framebuffer([raw]), {**found, "solids": canvas.table(_blocker_rows(blockers))})
    blur = canvas.program(shaders.FLAT_VERTEX, room_shaders.ROOM_BLUR, coarse=COARSE)
    canvas.fill(blur, ctx.framebuffer([smooth]), {**found, "light": raw})
    return smooth


def _probes(canvas: Canvas, blockers: furniture.Solids, dressed: Interior) -> moderngl.Texture3D:
    """Light in the room's air past the furniture, a cell a texel: six directions, one after another along z."""
    ctx = canvas.ctx
    nx, ny, nz = (int(n) for n in dressed.cells)
    sides = [ctx.texture((nx, ny * nz), 4, dtype="f4") for _ in range(6)]
    program = canvas.program(shaders.FLAT_VERTEX, dressed.shaders.probe, **canvas.surroundings, blockers=len(blockers))
    canvas.fill(program, ctx.framebuffer(sides), {"solids": canvas.table(_blocker_rows(blockers))})
    cells = np.stack([np.frombuffer(side.read(), np.float32).reshape(nz, ny, nx, 4) for side in sides])
    return ctx.texture3d((nx, ny, 6 * nz), 4, np.ascontiguousarray(cells).tobytes(), dtype="f4")


def _rectangles(canvas: Canvas, solids: furniture.Solids) -> np.ndarray:
    """A rectangle of pixels around each solid, (n, 4)."""
    if not len(solids):
        return np.zeros((0, 4))
    corners = furniture.CORNERS
    edges = np.array([(i, j) for i in range(8) for j in range(i) if np.sum(corners[i] != corners[j]) == 1])
    f = np.linspace(0, 1, _EDGE_SAMPLES)[:, None]
    unit = np.concatenate([corners[i] * (1 - f) + corners[j] * f for i, j in edges])
    points = solids.centre[:, None] + (unit[None] * solids.half[:, None]) @ solids.axes
    flat = solids.kind == furniture.TRIANGLE
    if flat.any():
        a, b, c = solids.centre[flat], solids.axes[flat, 0], solids.axes[flat, 1]
        rim = np.concatenate([p[:, None] * (1 - f) + q[:, None] * f for p, q in ((a, b), (b, c), (c, a))], 1)
        points[flat] = np.resize(rim.transpose(1, 0, 2), (len(unit), flat.sum(), 3)).transpose(1, 0, 2)
    inside = pose.apply(canvas.T_camera_room, points)
    rectangles = bounds(canvas.camera.lens.project_clamped(inside), _MARGIN_PX)
    lost = ~np.isfinite(rectangles).all(1)
    rectangles[lost] = (0, 0, *canvas.size)
    return clip(rectangles, canvas.size)


def _solid_rows(solids: furniture.Solids) -> np.ndarray:
    """Texture rows (n, 5, 4) of solids: centre + kind, axes + half sizes, linear colour + material."""
    rows = np.zeros((max(len(solids), 1), 5, 4))
    if len(solids):
        rows[:, 0, :3], rows[:, 0, 3] = solids.centre, solids.kind
        rows[:, 1:4, :3], rows[:, 1:4, 3] = solids.axes, solids.half
        rows[:, 4, :3], rows[:, 4, 3] = linear(solids.colour), solids.material
    return rows


def _blocker_rows(blockers: furniture.Solids) -> np.ndarray:
    """As `_solid_rows`, for what stands before the light: the last number is the radius of a ball around it."""
    rows = _solid_rows(blockers)
    if len(blockers):
        rows[:, 4, 3] = 1.001 * np.linalg.norm(blockers.half, axis=1)
    return rows
