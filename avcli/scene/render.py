"""The renderer: any lens, ray cast on the graphics card or on llvmpipe, headless.

The room is drawn once. A frame draws only people: every rounded cone as a quadrangle of pixels in which each pixel's
ray is intersected exactly, then passes over the tiles where people are or were: shade what is seen, put it before the
room, smooth the outlines.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from avcli.formats.experiment import Camera
from avcli.scene import furniture, people, shaders
from avcli.scene.canvas import Canvas, NoGraphics, farthest, open_context, put
from avcli.scene.interior import Interior
from avcli.scene.outlines import SHADOW_PITCH, SHADOW_REACH, SHAPE_PITCH, TILE, Outlines, Sheet
from avcli.scene.room_cache import RoomCache
from avcli.scene.room_pass import RoomPicture, draw_room
from avcli.scene.settings import Drawing

if TYPE_CHECKING:
    import moderngl

__all__ = ["Frame", "NoGraphics", "Renderer", "farthest", "open_context"]

_CONE = "2f 4f 4f 4f 4f 4f", ("origin", "edges", "ball_a", "ball_b", "bulge", "middle")  # layout and names of a cone
_UNITS = {"seen": 0, "room_seen": 1, "room_colour": 2, "cones": 3, "shadow": 4, "balls": 5, "painted": 6, "probes": 8}
"""Where the shaders of a frame find their textures."""


Shape = tuple[np.ndarray, tuple[int, int]]
"""A person's whole silhouette, (rows, columns) bool on a grid, and the image place (x, y) of its first sample."""


@dataclass(frozen=True)
class Frame:
    """One rendered frame.

    Attributes:
        rgb: (height, width, 3) uint8; None where no colour is drawn.
        depth: (height, width) uint16 radial depth in steps of depth_step m; 0 none.
        ids: (height, width) uint8, index of the person + 1, 0 the room.
        shapes: people's whole silhouettes, one (rows, columns) bool array each on a grid of `pitch` px, and the image
            place (x, y) of its first sample.
    """

    rgb: np.ndarray | None
    depth: np.ndarray
    ids: np.ndarray
    shapes: list[Shape]
    depth_step: float = 1e-4
    pitch: int = SHAPE_PITCH
    known: dict[int, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What was found out about people in the frame, by their index: a frame may be that of many times."""


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
        colour: whether colours are drawn; depth alone is quicker.
        cache: keeps the colours of the empty room for another run; None: they are drawn.

    Attributes:
        drawn_share: sum over the frames of the share of the picture that was drawn for them.
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
        *,
        colour: bool = True,
        cache: RoomCache | None = None,
    ) -> None:
        self.depth_step, self.samples = depth_step or Drawing().depth_step_m(farthest(camera, room)), samples
        self.colour, self.drawn_share, self._dressed = colour, 0.0, dressed
        self.canvas = Canvas(camera, room, samples, context)
        if dressed is not None:
            self.canvas.surroundings |= dressed.uniforms
        cache, begin = cache if colour else None, perf_counter()
        known = cache.load(self.canvas.drawn_by, self.canvas.size) if cache else None
        self.room_seen, self._room_surface, self._room_colour, self._probes = self._room(solids, known)
        self._make_targets()  # while the room is being drawn
        self._make_programs()
        self.canvas.wait()
        took_s = perf_counter() - begin
        width, height = self.canvas.size
        self._outlines, self._index = self.prepare(people.pose([], np.zeros(1))), 0
        everywhere = np.ones((-(-height // TILE), -(-width // TILE)), bool)
        self._stale = ~everywhere, ~everywhere
        self._paint(self._outlines, 0, everywhere, ~everywhere)
        rgb = np.zeros((height, width, 3), np.uint8) if colour else None
        depth, ids = np.zeros((height, width), np.uint16), np.zeros((height, width), np.uint8)
        self._frame = self._read(Frame(rgb, depth, ids, [], self.depth_step), everywhere)
        self.room_depth = self._frame.depth
        if cache and known is None and self._frame.rgb is not None:
            cache.store(self.canvas.drawn_by, self._frame.rgb, took_s)

    def prepare(self, bodies: people.Bodies, still_px: float = 0.0) -> Outlines:
        """Compute what the card needs to draw bodies at n times; their frames are then drawn by index.

        Args:
            bodies: at n times.
            still_px: as `Outlines` has it; 0 draws every pose.
        """
        reach = SHADOW_REACH if self._dressed is None else self._dressed.uniforms["reach"]
        return Outlines(self.canvas, bodies, reach, still_px)

    def draw(self, outlines: Outlines, index: int) -> Frame:
        """Draw the frame of one time: the same object again where nobody has moved since the last one.

        Args:
            outlines: of `prepare`.
            index: of the time.
        """
        same = outlines is self._outlines
        known = same or not (outlines.held.size or self._outlines.held.size)
        moved = outlines.held[index] != outlines.held[self._index] if same else np.ones(outlines.held.shape[1], bool)
        everybody = np.ones_like(moved)
        bodies, shadows = outlines.tiles(index, everybody)
        before = outlines.tiles(self._index if same else index, moved) if known else self._stale
        found, darkened = (one | other for one, other in zip(outlines.tiles(index, moved), before, strict=True))
        painted = found | (darkened & bodies)
        dimmed = darkened & ~painted
        if (painted | dimmed).any():
            self._find(outlines.instances(index, found), found)
            self._paint(outlines, index, painted, dimmed)
            self.canvas.wait()
            self._frame = self._read(self._frame, painted | dimmed)
        if not known or moved.any():
            self._frame = replace(self._frame, shapes=self._silhouettes(outlines, index, moved))
        self._stale, self._outlines, self._index = (bodies, shadows), outlines, index
        self.drawn_share += (painted | dimmed).mean()
        return self._frame

    def _room(self, solids: furniture.Solids, known: np.ndarray | None) -> RoomPicture:
        """Draw the empty room, of which the colours (height, width, 3) uint8 may be known."""
        picture = draw_room(self.canvas, solids, self._dressed, colour=self.colour and known is None)
        if known is not None:
            picture.colour.write(np.dstack([known, np.full(known.shape[:2], 255, np.uint8)]).tobytes())
        return picture

    def _make_targets(self) -> None:
        """What is drawn into: the cones that are seen, their paint, shadows, and the frame itself."""
        ctx, size = self.canvas.ctx, self.canvas.size
        self.people_seen, marks = ctx.texture(size, 2, dtype="f4"), ctx.depth_renderbuffer(size)
        self._geometry = ctx.framebuffer([self.people_seen], marks)
        self._geometry.clear(0, 0, 0, 0, depth=1.0)
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
        self._blank = program(flat, shaders.BLANK, size=size, level=1.0)
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

    def _find(self, instances: np.ndarray, tiles: np.ndarray) -> None:
        """Find which cone each pixel of some tiles sees."""
        ctx = self.canvas.ctx
        self.canvas.use_rays()
        self._geometry.use()
        ctx.enable(ctx.DEPTH_TEST)
        ctx.depth_func = "1"
        self.canvas.quads(self._blank, _tile_corners(tiles, self.canvas.size), "4f/i", ("rectangle",))
        ctx.depth_func = "<"
        if len(instances):
            self.room_seen.use(0)
            layout, names = _CONE
            self.canvas.quads(self._cones, instances, f"{layout}/i", names)

    def _paint(self, outlines: Outlines, index: int, tiles: np.ndarray, dimmed: np.ndarray) -> None:
        """Draw depth and colour of the tiles in which people are or were, and the shadow on those where it falls."""
        canvas, ctx = self.canvas, self.canvas.ctx
        rows, balls = outlines.rows(index), outlines.balls(index)
        ball_table = canvas.table(balls[None] if len(balls) else np.zeros((1, 1, 4)))
        if self.colour:
            self._cast_shadows(ball_table, outlines.shadow_rectangles(index))
        cone_table = canvas.table(rows if len(rows) else np.zeros((1, 9, 4)))
        corners, aside = _tile_corners(tiles, canvas.size), _tile_corners(dimmed, canvas.size)
        inputs = (self.people_seen, self.room_seen, self._room_colour, cone_table, self._shadow, ball_table)
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        self._paint_of_people.use(_UNITS["painted"])
        if self._probes is not None:
            self._probes.use(_UNITS["probes"])
        peopled = bool(len(rows)) and self.colour
        ctx.enable(ctx.DEPTH_TEST)
        if peopled:
            ctx.depth_func = ">"
            self._painted.use()
            canvas.quads(self._shade, corners, "4f/i", ("rectangle",))
        self._final.use()
        ctx.depth_func = "1"
        canvas.quads(self._base, corners, "4f/i", ("rectangle",))
        if self.colour:
            ctx.disable(ctx.DEPTH_TEST)
            self._dimmed.use()
            canvas.quads(self._dim, aside, "4f/i", ("rectangle",))
        if peopled and self.samples > 1:
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

    def _silhouettes(self, outlines: Outlines, index: int, moved: np.ndarray) -> list[Shape]:
        """Draw the whole silhouettes of those who moved; those of all."""
        shapes = [
            (np.zeros((0, 0), bool), (0, 0)) if anew else self._frame.shapes[person]
            for person, anew in enumerate(moved.tolist())
        ]
        for sheet in outlines.sheets(index, moved):
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

    def _read(self, last: Frame, tiles: np.ndarray) -> Frame:
        """The last frame with the tiles that were drawn since then, read from the card."""
        rows, columns = np.flatnonzero(tiles.any(1)), np.flatnonzero(tiles.any(0))
        x0, y0 = int(columns[0]) * TILE, int(rows[0]) * TILE
        x1, y1 = np.minimum([(columns[-1] + 1) * TILE, (rows[-1] + 1) * TILE], self.canvas.size).tolist()
        place = x0, y0, x1 - x0, y1 - y0

        def renewed(old: np.ndarray, attachment: int, components: int) -> np.ndarray:
            kind = {"uint8": "f1", "uint16": "u2"}[old.dtype.name]
            read = self._final.read(place, components, attachment=attachment, alignment=1, dtype=kind)
            part = np.frombuffer(read, old.dtype).reshape(y1 - y0, x1 - x0, *old.shape[2:])
            if part.shape == old.shape:
                return part
            new = old.copy()
            new[y0:y1, x0:x1] = part
            new.flags.writeable = False  # the next frame begins with it
            return new

        rgb = None if last.rgb is None else renewed(last.rgb, 0, 3)
        return replace(last, rgb=rgb, depth=renewed(last.depth, 1, 1), ids=renewed(last.ids, 2, 1))


def _tile_corners(tiles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Corners (n, 4) px of the tiles (rows, columns) that are true, cut to the picture."""
    y, x = np.nonzero(tiles)
    return np.minimum(np.stack([x, y, x + 1, y + 1], -1) * TILE, [*size, *size])
