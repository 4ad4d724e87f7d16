"""The renderer: any lens, ray cast on the graphics card or on llvmpipe, headless.

The room is drawn once. A frame draws only people: every rounded cone as a quadrangle of pixels in which each pixel's
ray is intersected exactly, then passes over the tiles where people are or were: shade what is seen, put it before the
room, smooth the outlines.
"""

from dataclasses import dataclass

import numpy as np

from avcli.lens import shader as lens_shader
from avcli.scene import furniture, room_shaders, shaders

_TILE = 32  # px, the grain in which a frame is redrawn
_COARSE = 4  # px, the grid on which the room's light is computed
_SHADOW_PITCH = 8  # px, the grid on which people's shadows are computed
_SHADOW_REACH = 0.65  # m around a person, where their shadow has faded
_CONE_NAMES = ("origin", "edges", "ball_a", "ball_b", "bulge", "middle")
_RAYS_UNIT = 7  # where the shaders find the pixels' rays
_SHAPE_PITCH = 2  # px, the grid on which visible fractions are counted


class NoGraphics(RuntimeError):
    """There is no way to draw on this machine; the message says what to install."""


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
    shapes: list
    depth_step: float = 1e-4
    pitch: int = _SHAPE_PITCH


def open_context():
    """Open a headless OpenGL context.

    Raises:
        NoGraphics: there is no EGL or no driver.
    """
    import moderngl

    try:
        return moderngl.create_context(standalone=True, backend="egl", require=330)
    except Exception as error:
        raise NoGraphics(
            f"no headless OpenGL here ({error}); on Debian: apt-get install libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri"
        ) from None


def _finish():
    """glFinish, called so that other threads run Python meanwhile; moderngl's calls keep them waiting."""
    import ctypes

    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    return ctypes.CFUNCTYPE(None)(egl.eglGetProcAddress(b"glFinish"))


class Renderer:
    """Draws one scene through one camera.

    Args:
        camera: experiment.Camera.
        room: (3,) m.
        solids: furniture.Solids.
        depth_step: m of one step of the depth picture.
        samples: colour samples in a pixel at silhouettes.

    Attributes:
        room_depth: (height, width) uint16, radial depth of the empty room in steps.
    """

    def __init__(self, camera, room, solids, depth_step=1e-4, samples=4, context=None):
        self.camera, self.room, self.solids = camera, np.asarray(room, float), solids
        self.depth_step, self.samples = depth_step, samples
        self.ctx, self._wait = context or open_context(), _finish()
        self.ctx.enable(self.ctx.DEPTH_TEST)
        self.width, self.height = camera.width_px, camera.height_px
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        if max(self.width, self.height) > limit:
            raise ValueError(f"an image of {self.width} x {self.height} px: this OpenGL draws up to {limit} px a side")
        self.T_camera_room = _inverse(camera.T_room_camera)
        self._lens = lens_shader.uniforms(camera.lens, self.width, self.height)
        x, y, z = self.room
        self._lamps = [(0.28 * x, 0.5 * y, z), (0.72 * x, 0.5 * y, z)]
        self._room_pass()
        self._people_buffers()
        self._find(np.zeros((0, 22)))
        self._paint(np.zeros((0, 9, 4)), np.zeros((0, 4)), np.zeros((0, 6)), *self._stale)
        self.room_depth = self._read_depth()

    # The room

    def _program(self, vertex, fragment, **uniforms):
        fragment = fragment.replace("TERMS", str(len(self._lens["series"])))
        program = self.ctx.program(vertex_shader=vertex, fragment_shader=fragment)
        _set(program, **self._lens, **uniforms, rays=_RAYS_UNIT)
        return program

    def _room_uniforms(self):
        T = self.camera.T_room_camera
        return {
            "to_room": tuple(T[:3, :3].T.ravel()), "eye": tuple(T[:3, 3]), "room": tuple(self.room),
            "lamps": self._lamps, "coarse": _COARSE, "samples": self.samples,
        }  # fmt: skip

    def _fill(self, program, target, depth=False, **textures):
        """Run a program over all of a target's pixels, or those that its depth lets pass."""
        _set(program, size=target.size, **{name: unit for unit, name in enumerate(textures)})
        for unit, texture in enumerate(textures.values()):
            texture.use(unit)
        target.use()
        (self.ctx.enable if depth else self.ctx.disable)(self.ctx.DEPTH_TEST)
        self._render(program, [[0, 0, *target.size]], "4f/i", ("rectangle",))

    def _room_pass(self):
        """Draw the room and the furniture: depth at the pixels' centres, colour antialiased where surfaces meet."""
        ctx, size, uniforms = self.ctx, (self.width, self.height), self._room_uniforms()
        self._rays = ctx.texture(size, 2, dtype="f4")
        self._fill(self._program(shaders.FLAT_VERTEX, shaders.RAYS), ctx.framebuffer([self._rays]))
        self._rays.use(_RAYS_UNIT)
        solids = self._table(_solid_rows(self.solids))
        rectangles = np.concatenate([[[0, 0, *size]], self._solid_rectangles()])
        index = np.arange(-1, len(self.solids))[:, None]
        buffer = ctx.buffer(np.hstack([rectangles, index]).astype("f4").tobytes())
        program = self._program(room_shaders.ROOM_VERTEX, room_shaders.ROOM_FRAGMENT, **uniforms, solids=0)
        _set(program, size=size)
        self.room_seen, self._room_surface = ctx.texture(size, 2, dtype="f4"), ctx.texture(size, 4, dtype="f2")
        target = ctx.framebuffer([self.room_seen, self._room_surface], ctx.depth_renderbuffer(size))
        target.use()
        target.clear(0, 0, 0, 0)
        solids.use(0)
        ctx.enable(ctx.DEPTH_TEST)
        array = ctx.vertex_array(program, [(buffer, "4f 1f/i", "rectangle", "solid")])
        array.render(ctx.TRIANGLE_STRIP, 4, instances=len(rectangles))
        seen = {"seen": self.room_seen, "surface": self._room_surface}
        grid = -(-self.width // _COARSE), -(-self.height // _COARSE)
        coarse = [ctx.texture(grid, 1, dtype="f2"), ctx.texture(grid, 4, dtype="f4")]
        blockers = self._table(_solid_rows(furniture.blockers(self.solids)))
        light = self._program(
            shaders.FLAT_VERTEX, room_shaders.ROOM_LIGHT, **uniforms, blockers=len(furniture.blockers(self.solids))
        )
        self._fill(light, ctx.framebuffer([coarse[0]]), **seen, solids=blockers)
        blur = self._program(shaders.FLAT_VERTEX, room_shaders.ROOM_BLUR, coarse=_COARSE)
        self._fill(blur, ctx.framebuffer([coarse[1]]), **seen, light=coarse[0])
        self._room_colour = ctx.texture(size, 4)
        inputs = {**seen, "light": coarse[1], "solids": solids}
        shade = self._program(shaders.FLAT_VERTEX, room_shaders.ROOM_SHADE, **uniforms)
        self._fill(shade, ctx.framebuffer([self._room_colour]), **inputs)
        if self.samples > 1:
            marks = ctx.depth_renderbuffer(size)
            target = ctx.framebuffer(depth_attachment=marks)
            target.clear(depth=1.0)
            ctx.depth_func = "1"
            self._fill(self._program(shaders.FLAT_VERTEX, room_shaders.ROOM_EDGES), target, depth=True, **seen)
            target = ctx.framebuffer([self._room_colour], marks)
            target.depth_mask = False
            ctx.depth_func = ">"
            smooth = self._program(shaders.FLAT_VERTEX, room_shaders.ROOM_SMOOTH, **uniforms, level=0.5)
            self._fill(smooth, target, depth=True, **inputs)
            ctx.depth_func = "<"

    def _solid_rectangles(self):
        """A rectangle of pixels around each solid, (n, 4)."""
        s = self.solids
        if not len(s):
            return np.zeros((0, 4))
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        edges = np.array([(i, j) for i in range(8) for j in range(i) if np.sum(corners[i] != corners[j]) == 1])
        f = np.linspace(0, 1, 17)[:, None]
        unit = np.concatenate([corners[i] * (1 - f) + corners[j] * f for i, j in edges])
        points = s.centre[:, None] + (unit[None] * s.half[:, None]) @ s.axes
        flat = s.kind == furniture.TRIANGLE
        if flat.any():
            a, b, c = s.centre[flat], s.axes[flat, 0], s.axes[flat, 1]
            rim = np.concatenate([p[:, None] * (1 - f) + q[:, None] * f for p, q in ((a, b), (b, c), (c, a))], 1)
            points[flat] = np.resize(rim.transpose(1, 0, 2), (len(unit), flat.sum(), 3)).transpose(1, 0, 2)
        in_camera = points @ self.T_camera_room[:3, :3].T + self.T_camera_room[:3, 3]
        rectangles = _bounds(self.camera.lens.project_clamped(in_camera), 4.0)
        lost = ~np.isfinite(rectangles).all(1)
        rectangles[lost] = (0, 0, self.width, self.height)
        return _clip(rectangles, self.width, self.height)

    # People

    def _people_buffers(self):
        size, ctx, uniforms = (self.width, self.height), self.ctx, self._room_uniforms()
        self.people_seen, marks = ctx.texture(size, 2, dtype="f4"), ctx.depth_renderbuffer(size)
        self._geometry = ctx.framebuffer([self.people_seen], marks)
        self._colour, self._depth = ctx.texture(size, 4), ctx.texture(size, 1, dtype="u2")
        self._ids = ctx.texture(size, 1)
        edges = ctx.depth_renderbuffer(size)
        self._final = ctx.framebuffer([self._colour, self._depth, self._ids], edges)
        self._smoothed = ctx.framebuffer([self._colour], edges)
        self._paint_of_people = ctx.texture(size, 4)
        self._painted = ctx.framebuffer([self._paint_of_people], marks)
        self._painted.depth_mask = self._smoothed.depth_mask = False
        self._shadow = ctx.texture((-(-self.width // _SHADOW_PITCH), -(-self.height // _SHADOW_PITCH)), 1)
        self._shade_target = ctx.framebuffer([self._shadow])
        self._cones = self._program(shaders.PEOPLE_VERTEX, shaders.PEOPLE_FRAGMENT, room_depth=0, size=size)
        self._shapes = self._program(shaders.SHAPE_VERTEX, shaders.SHAPE_FRAGMENT, pitch=float(_SHAPE_PITCH))
        self._shadows = self._program(
            shaders.SHADOW_VERTEX,
            shaders.SHADOW_FRAGMENT,
            **{**uniforms, "coarse": _SHADOW_PITCH},
            seen=0,
            surface=1,
            balls=2,
        )
        _set(self._shadows, size=self._shadow.size)
        units = {
            "seen": 0,
            "room_seen": 1,
            "room_colour": 2,
            "cones": 3,
            "shadow": 4,
            "balls": 5,
            "painted": 6,
            "size": size,
        }
        vertex, step = shaders.FLAT_VERTEX, 1.0 / self.depth_step
        base = shaders.BASE.replace("MARK", shaders.MARK if self.samples > 1 else "")
        self._base = self._program(vertex, base, **units, per_step=step)
        self._dim = self._program(vertex, shaders.DIM, **units)
        self._dimmed = ctx.framebuffer([self._colour])
        self._shade = self._program(vertex, shaders.SHADE, **uniforms, **units, level=0.9999)
        smooth = shaders.SMOOTH.replace("SAMPLES", str(self.samples))
        self._smooth = self._program(vertex, smooth, **units, level=0.5)
        everywhere = np.ones((-(-self.height // _TILE), -(-self.width // _TILE)), bool)
        self._stale = everywhere, everywhere

    def prepare(self, bodies):
        """Everything about bodies (people.Bodies) at n times that the card needs; frames are then drawn by index."""
        return _Drawn(self, bodies)

    def draw(self, drawn, index):
        """Draw the frame of one time; returns Frame."""
        bodies, shadows = drawn.tiles(index)
        self._find(drawn.instances(index))
        redrawn = bodies | self._stale[0], (shadows | self._stale[1]) & ~(bodies | self._stale[0])
        self._paint(drawn.rows(index), drawn.balls(index), drawn.shadow_rectangles(index), *redrawn)
        self._stale = bodies, shadows
        self._wait()
        rgb = np.frombuffer(self._final.read(components=3, attachment=0), np.uint8).reshape(self.height, self.width, 3)
        ids = np.frombuffer(self._ids.read(), np.uint8).reshape(self.height, self.width)
        return Frame(rgb, self._read_depth(), ids, self._silhouettes(drawn, index), self.depth_step)

    def _read_depth(self):
        return np.frombuffer(self._depth.read(), np.uint16).reshape(self.height, self.width)

    def _render(self, program, instances, layout, names):
        """Draw a quad for each row of instances (n, m)."""
        if not len(instances):
            return
        buffer = self.ctx.buffer(np.ascontiguousarray(instances, "f4").tobytes())
        array = self.ctx.vertex_array(program, [(buffer, layout, *names)])
        array.render(self.ctx.TRIANGLE_STRIP, 4, instances=len(instances))
        array.release()
        buffer.release()

    def _find(self, instances):
        """Find which cone each pixel sees."""
        self._rays.use(_RAYS_UNIT)
        self._geometry.use()
        self._geometry.clear(0, 0, 0, 0, depth=1.0)
        self.ctx.enable(self.ctx.DEPTH_TEST)
        if len(instances):
            self.room_seen.use(0)
            self._render(self._cones, instances, "2f 4f 4f 4f 4f 4f/i", _CONE_NAMES)

    def _paint(self, rows, balls, shadow_rectangles, tiles, dimmed):
        """Colour the tiles of the picture in which people are or were, and those on which their shadow falls."""
        ctx, size = self.ctx, (self.width, self.height)
        balls = self._table(balls[None] if len(balls) else np.zeros((1, 1, 4)))
        self._shade_target.use()
        self._shade_target.clear(1, 1, 1, 1)
        ctx.disable(ctx.DEPTH_TEST)
        if len(shadow_rectangles):
            for unit, texture in enumerate((self.room_seen, self._room_surface, balls)):
                texture.use(unit)
            ctx.enable(ctx.BLEND)
            ctx.blend_func = ctx.DST_COLOR, ctx.ZERO
            self._render(self._shadows, shadow_rectangles, "4f 2f/i", ("rectangle", "balls"))
            ctx.disable(ctx.BLEND)
        table = self._table(rows if len(rows) else np.zeros((1, 9, 4)))
        corners, aside = _tile_corners(tiles, size), _tile_corners(dimmed, size)
        inputs = (self.people_seen, self.room_seen, self._room_colour, table, self._shadow, balls)
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        if len(rows):
            ctx.enable(ctx.DEPTH_TEST)
            ctx.depth_func = ">"
            self._painted.use()
            self._render(self._shade, corners, "4f/i", ("rectangle",))
        self._paint_of_people.use(6)
        self._final.use()
        ctx.enable(ctx.DEPTH_TEST)
        ctx.depth_func = "1"
        self._render(self._base, corners, "4f/i", ("rectangle",))
        ctx.disable(ctx.DEPTH_TEST)
        self._dimmed.use()
        self._render(self._dim, aside, "4f/i", ("rectangle",))
        if len(rows) and self.samples > 1:
            ctx.enable(ctx.DEPTH_TEST)
            self._smoothed.use()
            ctx.depth_func = ">"
            self._render(self._smooth, corners, "4f/i", ("rectangle",))
        ctx.depth_func = "<"
        table.release()
        balls.release()

    def depth_m(self):
        """Radial depth of the frame that was drawn last, unrounded: (height, width) float32 m, 0 none."""
        shape = (self.height, self.width, 2)
        people = np.frombuffer(self.people_seen.read(), np.float32).reshape(shape)[..., 0]
        room = np.frombuffer(self.room_seen.read(), np.float32).reshape(shape)[..., 0]
        return np.where(people > 0, people, room)

    def _silhouettes(self, drawn, index):
        """Draw each person's whole silhouette into a tile; returns [(mask, (x, y) of its first sample)]."""
        instances, tiles, size = drawn.shape_instances(index)
        if not len(instances):
            return [(np.zeros((0, 0), bool), (0, 0)) for _ in tiles]
        ctx = self.ctx
        picture = ctx.texture(size, 1)
        fbo = ctx.framebuffer([picture])
        fbo.use()
        fbo.clear()
        ctx.disable(ctx.DEPTH_TEST)
        _set(self._shapes, size=size)
        self._render(self._shapes, instances, "2f 4f 4f 4f 4f 4f 2f 4f/i", (*_CONE_NAMES, "place", "tile"))
        covered = np.frombuffer(fbo.read(components=1, alignment=1), np.uint8).reshape(size[1], size[0]) > 0
        for item in (fbo, picture):
            item.release()
        return [(covered[y0:y1, x0:x1], place) for (x0, y0, x1, y1), place in tiles]

    def _table(self, rows):
        """A texture of floats that shaders look up: rows (n, m, 4)."""
        rows = np.ascontiguousarray(rows, "f4")
        texture = self.ctx.texture((rows.shape[1], max(len(rows), 1)), 4, rows.tobytes() or None, dtype="f4")
        texture.filter = (self.ctx.NEAREST, self.ctx.NEAREST)
        return texture


class _Drawn:
    """Bodies in the camera's frame, and the rectangles that they fill, for many times at once."""

    def __init__(self, renderer, bodies):
        self.renderer, self.bodies = renderer, bodies
        R, origin = renderer.T_camera_room[:3, :3], renderer.T_camera_room[:3, 3]
        a, b = bodies.a @ R.T + origin, bodies.b @ R.T + origin
        axis = bodies.flat_axis @ R.T
        self.front = bodies.front @ R.T
        self.middle = 0.5 * (a + b)
        bulge = (1.0 / bodies.flat - 1.0)[None, :, None]

        def swell(points):
            return points + bulge * axis * np.sum(axis * (points - self.middle), -1, keepdims=True)

        self.a, self.b = swell(a), swell(b)
        self.axis, self.bulge = axis, bulge
        self._shadow_bounds()
        self._outline(a, b)

    def _shadow_bounds(self):
        """Where in the picture a person darkens the room: around the place under them, (n, people, 4)."""
        r, bodies = self.renderer, self.bodies
        middle = bodies.balls[..., :2].mean(2)
        turn = np.arange(16) * np.pi / 8
        ring = _SHADOW_REACH * np.stack([np.cos(turn), np.sin(turn)], -1)
        floor = np.concatenate([middle[:, :, None] + ring, np.zeros((*middle.shape[:2], 16, 1))], -1)
        pixels = r.camera.lens.project_clamped(floor @ r.T_camera_room[:3, :3].T + r.T_camera_room[:3, 3])
        self.shadows = _bounds(pixels, 4.0)

    def _outline(self, a, b):
        """Around each cone in the picture: a rectangle (n, p, 4) and a parallelogram along its axis (n, p, 6).

        Both hold the outlines of balls along its axis, as the camera sees them: as cones of rays.
        """
        ra, rb = self.bodies.ra, self.bodies.rb
        n, p = a.shape[:2]
        points = np.empty((n, p, 4, 12, 3))
        angles = np.arange(12) * np.pi / 6
        with np.errstate(invalid="ignore", divide="ignore"):
            for k, f in enumerate((0.0, 1 / 3, 2 / 3, 1.0)):
                centre, radius = a + f * (b - a), ra + f * (rb - ra)
                distance = np.linalg.norm(centre, axis=-1, keepdims=True)
                way = centre / distance
                sine = radius[None, :, None] / distance
                # A ball that holds the camera has no outline: it is left out, as NaN.
                tangent = sine / np.sqrt(1 - sine**2) / np.cos(np.pi / 12)
                u = np.cross(way, np.where(np.abs(way[..., :1]) < 0.8, [1.0, 0, 0], [0, 1.0, 0]))
                u /= np.linalg.norm(u, axis=-1, keepdims=True)
                v = np.cross(way, u)
                ring = np.cos(angles)[:, None] * u[..., None, :] + np.sin(angles)[:, None] * v[..., None, :]
                points[:, :, k] = way[..., None, :] + tangent[..., None] * ring
        pixels = self.renderer.camera.lens.project_clamped(points.reshape(n * p, 48, 3)).reshape(n, p, 48, 2)
        self.rectangles = _bounds(pixels, 1.5)
        way = pixels[:, :, 36:].mean(2) - pixels[:, :, :12].mean(2)
        length = np.linalg.norm(way, axis=-1, keepdims=True)
        way = np.where(length > 1.0, way / np.maximum(length, 1e-9), [1.0, 0.0])
        across = np.stack([-way[..., 1], way[..., 0]], -1)
        along, aside = np.sum(pixels * way[:, :, None], -1), np.sum(pixels * across[:, :, None], -1)
        low_along, low_aside = along.min(-1, keepdims=True) - 1.5, aside.min(-1, keepdims=True) - 1.5
        long, wide = along.max(-1, keepdims=True) + 1.5 - low_along, aside.max(-1, keepdims=True) + 1.5 - low_aside
        origin = low_along * way + low_aside * across + 0.5
        self.quads = np.concatenate([origin, long * way, wide * across], -1)

    def _inside(self, index):
        r = self.renderer
        rectangles = _clip(self.rectangles[index], r.width, r.height)
        return rectangles, (rectangles[:, 2] > rectangles[:, 0]) & (rectangles[:, 3] > rectangles[:, 1])

    def _geometry(self, index):
        p = len(self.bodies.ra)
        number = np.arange(p)
        return np.concatenate(
            [
                self.a[index], self.bodies.ra[:, None], self.b[index], self.bodies.rb[:, None],
                self.axis[index], np.broadcast_to(self.bulge[0], (p, 1)), self.middle[index], number[:, None],
            ],
            1,
        )  # fmt: skip

    def instances(self, index):
        """One row for each cone in the picture: parallelogram and shape."""
        _, inside = self._inside(index)
        return np.hstack([self.quads[index], self._geometry(index)])[inside]

    def rows(self, index):
        """All about each cone that shading wants, (p, 9, 4)."""
        bodies = self.bodies
        p = len(bodies.ra)
        rows = np.zeros((p, 9, 4))
        rows[:, :4] = self._geometry(index).reshape(p, 4, 4)
        rows[:, 3, 3] = bodies.person + 1
        rows[:, 4:6, :3], rows[:, 7, :3] = linear(bodies.colours[:, :2]), linear(bodies.colours[:, 2])
        rows[:, 4, 3], rows[:, 5, 3] = bodies.material, bodies.split
        rows[:, 6, :3], rows[:, 6, 3] = self.front[index], 3.7 * bodies.person
        rows[:, 7, 3] = bodies.person * bodies.balls.shape[2]
        rows[:, 8] = bodies.touching
        return rows

    def balls(self, index):
        """The balls that cast soft shadows, (people * 20, 4)."""
        return self.bodies.balls[index].reshape(-1, 4)

    def shadow_rectangles(self, index):
        """Where each person darkens the room, in coarse pixels, and which balls are theirs: (people, 6)."""
        count, each = self.bodies.balls.shape[1:3]
        first = np.arange(count)[:, None] * each
        rectangles = self.shadows[index] / _SHADOW_PITCH + [-1, -1, 1, 1]
        rows = np.hstack([rectangles, first, first + each])
        return rows[np.isfinite(rows).all(1)]

    def tiles(self, index):
        """Which tiles of the picture this frame's people touch, and which their shadows, (rows, columns) bool each."""
        r = self.renderer
        rectangles, inside = self._inside(index)
        marked = []
        for group in (rectangles[inside], _clip(self.shadows[index], r.width, r.height)):
            tiles = np.zeros((-(-r.height // _TILE), -(-r.width // _TILE)), bool)
            for x0, y0, x1, y1 in (group / _TILE).tolist():
                tiles[int(y0) : int(np.ceil(y1)), int(x0) : int(np.ceil(x1))] = True
            marked.append(tiles)
        return marked

    def shape_instances(self, index):
        """Cones in tiles, one tile a person: (instances, [((x0, y0, x1, y1) in the picture, place)], picture size)."""
        r = self.renderer
        people = int(self.bodies.person.max()) + 1 if len(self.bodies.person) else 0
        tiles, rows, left, height = [], [], 0, 1
        geometry = self._geometry(index)
        for person in range(people):
            mine = self.bodies.person == person
            rectangles = self.rectangles[index][mine]
            rectangles = rectangles[np.isfinite(rectangles).all(1)]
            if not len(rectangles):
                tiles.append(((0, 0, 0, 0), (0, 0)))
                continue
            low = np.floor(rectangles[:, :2].min(0) / _SHAPE_PITCH) * _SHAPE_PITCH
            high = np.ceil(rectangles[:, 2:].max(0) / _SHAPE_PITCH) * _SHAPE_PITCH
            # What lies far outside the picture is counted on no grid larger than twice the picture.
            low = np.maximum(low, -2 * np.ceil([r.width / 2, r.height / 2]))
            high = np.minimum(high, [2 * r.width, 2 * r.height])
            wide, tall = np.maximum((high - low) / _SHAPE_PITCH, 0).astype(int)
            shift = np.array([left, 0]) - low / _SHAPE_PITCH
            quads = self.quads[index][mine] / _SHAPE_PITCH
            quads[:, :2] += shift
            place = low - np.array([left, 0]) * _SHAPE_PITCH
            rows.append(
                np.hstack(
                    [
                        quads,
                        geometry[mine],
                        np.tile(place, (len(quads), 1)),
                        np.tile([left, 0, left + wide, tall], (len(quads), 1)),
                    ]
                )
            )
            tiles.append(((left, 0, left + wide, tall), (int(low[0]), int(low[1]))))
            left, height = left + wide, max(height, tall)
        instances = np.concatenate(rows) if rows else np.zeros((0, 28))
        instances = instances[np.isfinite(instances).all(1)]
        return instances.astype("f4"), tiles, (max(int(left), 1), max(int(height), 1))


def linear(srgb):
    """Linear light of sRGB fractions (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _bounds(pixels, margin):
    """Rectangles (..., 4) in pixel edges around pixels (..., m, 2); NaN where a pixel is."""
    low, high = pixels.min(-2) + 0.5 - margin, pixels.max(-2) + 0.5 + margin
    return np.concatenate([low, high], -1)


def _tile_corners(tiles, size):
    y, x = np.nonzero(tiles)
    return np.minimum(np.stack([x, y, x + 1, y + 1], -1) * _TILE, [*size, *size])


def _clip(rectangles, width, height):
    kept = np.nan_to_num(rectangles, nan=0.0)
    return np.clip(np.concatenate([np.floor(kept[..., :2]), np.ceil(kept[..., 2:])], -1), 0, [width, height] * 2)


def _solid_rows(solids):
    """Texture rows (n, 5, 4) of solids: centre + kind, axes + half sizes, linear colour + material."""
    rows = np.zeros((max(len(solids), 1), 5, 4))
    if len(solids):
        rows[:, 0, :3], rows[:, 0, 3] = solids.centre, solids.kind
        rows[:, 1:4, :3], rows[:, 1:4, 3] = solids.axes, solids.half
        rows[:, 4, :3], rows[:, 4, 3] = linear(solids.colour), solids.material
    return rows


def _inverse(T):
    from avcli import pose

    return pose.inverse(T)


def _set(program, **values):
    for name, value in values.items():
        if name in program:
            program[name].value = value
