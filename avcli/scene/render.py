"""The renderer: any lens, ray cast on the graphics card or on llvmpipe, headless.

The room is drawn once. A frame draws only people: every rounded cone as a quadrangle of pixels in which each pixel's
ray is intersected exactly, then passes over the tiles where people are or were: shade what is seen, put it before the
room, smooth the outlines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from avcli.formats.experiment import Camera
from avcli.scene import furniture, shaders
from avcli.scene.canvas import Canvas, NoGraphics, farthest, open_context, put
from avcli.scene.interior import Interior
from avcli.scene.outlines import SHADOW_PITCH, SHADOW_REACH, SHAPE_PITCH, TILE, Outlines, Sheet
from avcli.scene.people import Bodies
from avcli.scene.room_pass import draw_room
from avcli.scene.settings import Drawing

if TYPE_CHECKING:
    import moderngl

__all__ = ["Frame", "NoGraphics", "Renderer", "farthest", "open_context"]

_CONE = "2f 4f 4f 4f 4f 4f", ("origin", "edges", "ball_a", "ball_b", "bulge", "middle")  # layout and names of a cone
_UNITS = {"seen": 0, "room_seen": 1, "room_colour": 2, "cones": 3, "shadow": 4, "balls": 5, "painted": 6, "probes": 8}
"""Where the shaders of a frame find their textures."""


@dataclass(frozen=True)
class Frame:
    """One rendered frame.

    Attributes:
        rgb: (height, width, 3) uint8.
        depth: (height, width) uint16 radial depth in steps of depth_step m; 0 none.
        ids: (height, width) uint8, index of the person + 1, 0 the room.
        shapes: people's whole silhouettes, one (rows, columns) bool array each on a grid of `pitch` px, and the image
            place (x, y) of its first sample.
    """

    rgb: np.ndarray
    depth: np.ndarray
    ids: np.ndarray
    shapes: list[tuple[np.ndarray, tuple[int, int]]]
    depth_step: float = 1e-4
    pitch: int = SHAPE_PITCH


class Renderer:
    """Draws one scene through one camera.

    Args:
        camera: through which the scene is seen.
        room: (3,) m.
        solids: the furniture.
        depth_step: m of one step of the depth picture; None: the finest usual one that holds the room in 16 bits.
        samples: colour samples per pixel at outlines.
        context: to share; None opens one.
        dressed: the room's looks and light, None where it states none.

    Attributes:
        depth_step: m of one step of the depth pictures.
        room_depth: (height, width) uint16, radial depth of the empty room in steps.
        room_seen, people_seen: textures (height, width, 2) float32 of the room and of the people of the last frame:
            distance in m, 0 for none, and a number of what is seen.

    Raises:
        NoGraphics: there is no OpenGL on this machine.
        ValueError: the image is larger than this OpenGL draws.
    """

    def __init__(
        self,
        camera: Camera,
        room: np.ndarray,
        solids: furniture.Solids,
        depth_step: float | None = None,
        samples: int = 4,
        context: moderngl.Context | None = None,
        dressed: Interior | None = None,
    ) -> None:
        self.depth_step, self.samples = depth_step or Drawing().depth_step_m(farthest(camera, room)), samples
        self._dressed = dressed
        self.canvas = Canvas(camera, room, samples, context)
        if dressed is not None:
            self.canvas.surroundings |= dressed.uniforms
        self.room_seen, self._room_surface, self._room_colour, self._probes = draw_room(self.canvas, solids, dressed)
        self._make_targets()
        self._make_programs()
        width, height = self.canvas.size
        everywhere = np.ones((-(-height // TILE), -(-width // TILE)), bool)
        self._stale = everywhere, everywhere
        self._find(np.zeros((0, 22)))
        self._paint(np.zeros((0, 9, 4)), np.zeros((0, 4)), np.zeros((0, 6)), *self._stale)
        self.room_depth = self._read_depth()

    def prepare(self, bodies: Bodies) -> Outlines:
        """Compute what the card needs to draw bodies at n times; their frames are then drawn by index."""
        reach = SHADOW_REACH if self._dressed is None else self._dressed.uniforms["reach"]
        return Outlines(self.canvas, bodies, reach)

    def draw(self, outlines: Outlines, index: int) -> Frame:
        """Draw the frame of one time.

        Args:
            outlines: of `prepare`.
            index: of the time.
        """
        bodies, shadows = outlines.tiles(index)
        self._find(outlines.instances(index))
        redrawn = bodies | self._stale[0], (shadows | self._stale[1]) & ~(bodies | self._stale[0])
        self._paint(outlines.rows(index), outlines.balls(index), outlines.shadow_rectangles(index), *redrawn)
        self._stale = bodies, shadows
        self.canvas.wait()
        width, height = self.canvas.size
        rgb = np.frombuffer(self._final.read(components=3, attachment=0), np.uint8).reshape(height, width, 3)
        ids = np.frombuffer(self._ids.read(), np.uint8).reshape(height, width)
        return Frame(rgb, self._read_depth(), ids, self._silhouettes(outlines, index), self.depth_step)

    def _make_targets(self) -> None:
        """What is drawn into: the cones that are seen, their paint, shadows, and the frame itself."""
        ctx, size = self.canvas.ctx, self.canvas.size
        self.people_seen, marks = ctx.texture(size, 2, dtype="f4"), ctx.depth_renderbuffer(size)
        self._geometry = ctx.framebuffer([self.people_seen], marks)
        colour, self._depth, self._ids = ctx.texture(size, 4), ctx.texture(size, 1, dtype="u2"), ctx.texture(size, 1)
        edges = ctx.depth_renderbuffer(size)
        self._final = ctx.framebuffer([colour, self._depth, self._ids], edges)
        self._smoothed, self._dimmed = ctx.framebuffer([colour], edges), ctx.framebuffer([colour])
        self._paint_of_people = ctx.texture(size, 4)
        self._painted = ctx.framebuffer([self._paint_of_people], marks)
        self._painted.depth_mask = self._smoothed.depth_mask = False
        self._shadow = ctx.texture((-(-size[0] // SHADOW_PITCH), -(-size[1] // SHADOW_PITCH)), 1)
        self._shade_target = ctx.framebuffer([self._shadow])

    def _make_programs(self) -> None:
        size, program, flat = self.canvas.size, self.canvas.program, shaders.FLAT_VERTEX
        uniforms = self.canvas.surroundings
        self._cones = program(shaders.PEOPLE_VERTEX, shaders.PEOPLE_FRAGMENT, room_depth=0, size=size)
        self._shapes = program(shaders.SHAPE_VERTEX, shaders.SHAPE_FRAGMENT, pitch=float(SHAPE_PITCH))
        shadow_units = {"coarse": SHADOW_PITCH, "seen": 0, "surface": 1, "balls": 2, "size": self._shadow.size}
        shadow, shade = shaders.SHADOW_FRAGMENT, shaders.SHADE
        if self._dressed is not None:
            shadow, shade = self._dressed.shaders.shadow, self._dressed.shaders.people
        self._shadows = program(shaders.SHADOW_VERTEX, shadow, **{**uniforms, **shadow_units})
        units = {**_UNITS, "size": size}
        base = shaders.BASE.replace("MARK", shaders.MARK if self.samples > 1 else "")
        self._base = program(flat, base, **units, per_step=1.0 / self.depth_step)
        self._dim = program(flat, shaders.DIM, **units)
        self._shade = program(flat, shade, **uniforms, **units, level=0.9999)
        self._smooth = program(flat, shaders.SMOOTH.replace("SAMPLES", str(self.samples)), **units, level=0.5)

    def _find(self, instances: np.ndarray) -> None:
        """Find which cone each pixel sees."""
        ctx = self.canvas.ctx
        self.canvas.use_rays()
        self._geometry.use()
        self._geometry.clear(0, 0, 0, 0, depth=1.0)
        ctx.enable(ctx.DEPTH_TEST)
        if len(instances):
            self.room_seen.use(0)
            layout, names = _CONE
            self.canvas.quads(self._cones, instances, f"{layout}/i", names)

    def _paint(
        self, rows: np.ndarray, balls: np.ndarray, shadow_rectangles: np.ndarray, tiles: np.ndarray, dimmed: np.ndarray
    ) -> None:
        """Colour the tiles of the picture in which people are or were, and those on which their shadow falls."""
        canvas, ctx = self.canvas, self.canvas.ctx
        ball_table = canvas.table(balls[None] if len(balls) else np.zeros((1, 1, 4)))
        self._cast_shadows(ball_table, shadow_rectangles)
        cone_table = canvas.table(rows if len(rows) else np.zeros((1, 9, 4)))
        corners, aside = _tile_corners(tiles, canvas.size), _tile_corners(dimmed, canvas.size)
        inputs = (self.people_seen, self.room_seen, self._room_colour, cone_table, self._shadow, ball_table)
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        if self._probes is not None:
            self._probes.use(_UNITS["probes"])
        if len(rows):
            ctx.enable(ctx.DEPTH_TEST)
            ctx.depth_func = ">"
            self._painted.use()
            canvas.quads(self._shade, corners, "4f/i", ("rectangle",))
        self._paint_of_people.use(_UNITS["painted"])
        self._final.use()
        ctx.enable(ctx.DEPTH_TEST)
        ctx.depth_func = "1"
        canvas.quads(self._base, corners, "4f/i", ("rectangle",))
        ctx.disable(ctx.DEPTH_TEST)
        self._dimmed.use()
        canvas.quads(self._dim, aside, "4f/i", ("rectangle",))
        if len(rows) and self.samples > 1:
            ctx.enable(ctx.DEPTH_TEST)
            self._smoothed.use()
            ctx.depth_func = ">"
            canvas.quads(self._smooth, corners, "4f/i", ("rectangle",))
        ctx.depth_func = "<"
        cone_table.release()
        ball_table.release()

    def _cast_shadows(self, balls: moderngl.Texture, rectangles: np.ndarray) -> None:
        """Draw how much people darken the room, each in their rectangle; shadows multiply."""
        ctx = self.canvas.ctx
        self._shade_target.use()
        self._shade_target.clear(1, 1, 1, 1)
        ctx.disable(ctx.DEPTH_TEST)
        if len(rectangles):
            for unit, texture in enumerate((self.room_seen, self._room_surface, balls)):
                texture.use(unit)
            ctx.enable(ctx.BLEND)
            ctx.blend_func = ctx.DST_COLOR, ctx.ZERO
            self.canvas.quads(self._shadows, rectangles, "4f 2f/i", ("rectangle", "balls"))
            ctx.disable(ctx.BLEND)

    def _silhouettes(self, outlines: Outlines, index: int) -> list[tuple[np.ndarray, tuple[int, int]]]:
        """Draw each person's whole silhouette; returns [(mask, (x, y) of its first sample)]."""
        shapes = [(np.zeros((0, 0), bool), (0, 0)) for _ in range(outlines.bodies.balls.shape[1])]
        for sheet in outlines.sheets(index):
            covered = self._sheet(sheet)
            for tile in sheet.tiles:
                x0, y0, x1, y1 = tile.box
                shapes[tile.person] = covered[y0:y1, x0:x1], tile.place
        return shapes

    def _sheet(self, sheet: Sheet) -> np.ndarray:
        """Draw a picture of silhouettes, (height, width) bool."""
        ctx = self.canvas.ctx
        picture = ctx.texture(sheet.size, 1)
        target = ctx.framebuffer([picture])
        target.use()
        target.clear()
        ctx.disable(ctx.DEPTH_TEST)
        put(self._shapes, size=sheet.size)
        layout, names = _CONE
        self.canvas.quads(self._shapes, sheet.instances, f"{layout} 2f 4f/i", (*names, "place", "tile"))
        covered = np.frombuffer(target.read(components=1, alignment=1), np.uint8).reshape(sheet.size[::-1]) > 0
        target.release()
        picture.release()
        return covered

    def _read_depth(self) -> np.ndarray:
        width, height = self.canvas.size
        return np.frombuffer(self._depth.read(), np.uint16).reshape(height, width)


def _tile_corners(tiles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Corners (n, 4) px of the tiles (rows, columns) that are true, cut to the picture."""
    y, x = np.nonzero(tiles)
    return np.minimum(np.stack([x, y, x + 1, y + 1], -1) * TILE, [*size, *size])
