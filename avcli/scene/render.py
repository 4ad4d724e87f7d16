"""The renderer: any lens, ray cast on the graphics card or on llvmpipe, headless.

The room is drawn once. A frame draws only people: every rounded cone as a rectangle of pixels in which each pixel's ray
is intersected exactly, then one pass that shades what was seen and leaves the rest of the room as it is.
"""

from dataclasses import dataclass

import numpy as np

from avcli.lens import Division
from avcli.scene import shaders

_TERMS = 13  # of the polynomials by which the shaders turn pixels into rays
_TILE = 32  # px, the grain in which a frame is redrawn
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
        self.ctx = context or open_context()
        self.ctx.enable(self.ctx.DEPTH_TEST)
        self.width, self.height = camera.width_px, camera.height_px
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        if max(self.width, self.height) > limit:
            raise ValueError(f"an image of {self.width} x {self.height} px: this OpenGL draws up to {limit} px a side")
        self.T_camera_room = _inverse(camera.T_room_camera)
        self._lens = lens_uniforms(camera.lens, self.width, self.height)
        self._room_pass()
        self._people_buffers()
        self._compose(np.zeros((0, 20), "f4"), np.zeros((0, 8, 4)), self._stale)
        self.room_depth = self._read_depth()

    # The room

    def _program(self, vertex, fragment, **uniforms):
        program = self.ctx.program(vertex_shader=vertex, fragment_shader=fragment)
        _set(program, **self._lens, **uniforms)
        return program

    def _room_uniforms(self):
        T = self.camera.T_room_camera
        return {"to_room": tuple(T[:3, :3].T.ravel()), "eye": tuple(T[:3, 3]), "room": tuple(self.room)}

    def _room_pass(self):
        """Draw the room and the furniture: depth at the pixels' centres, colour antialiased."""
        self.solid_texture = self._table(_solid_rows(self.solids))
        rectangles = np.concatenate([[[0, 0, self.width, self.height]], self._solid_rectangles()]).astype("f4")
        index = np.arange(-1, len(self.solids), dtype="f4")[:, None]
        buffer = self.ctx.buffer(np.hstack([rectangles, index]).astype("f4").tobytes())
        program = self._program(shaders.ROOM_VERTEX, shaders.ROOM_FRAGMENT, **self._room_uniforms(), solids=0)
        array = self.ctx.vertex_array(program, [(buffer, "4f 1f/i", "rectangle", "solid")])
        self._draw_room = lambda: array.render(self.ctx.TRIANGLE_STRIP, 4, instances=len(rectangles))
        self._room_program = program
        size = (self.width, self.height)
        self.room_seen, room_surface = self.ctx.texture(size, 2, dtype="f4"), self.ctx.texture(size, 4, dtype="f2")
        fbo = self.ctx.framebuffer([self.room_seen, room_surface], self.ctx.depth_renderbuffer(size))
        fbo.use()
        fbo.clear(0, 0, 0, 0)
        self.solid_texture.use(0)
        _set(program, origin=(0, 0), size=size, corner=(0, 0), pitch=1.0)
        self._draw_room()
        self.room_surface = room_surface
        self.room_colour = self.ctx.texture(size, 4)
        fbo = self.ctx.framebuffer([self.room_colour])
        shade = self._program(
            shaders.RESOLVE_VERTEX, shaders.ROOM_SHADE, **self._room_uniforms(), seen=0, surface=1, solids=2
        )
        _set(shade, size=size)
        quad = self.ctx.buffer(np.array([0, 0, *size], "f4").tobytes())
        self.room_seen.use(0)
        room_surface.use(1)
        self.solid_texture.use(2)
        fbo.use()
        self.ctx.disable(self.ctx.DEPTH_TEST)
        self.ctx.vertex_array(shade, [(quad, "4f/i", "rectangle")]).render(self.ctx.TRIANGLE_STRIP, 4, instances=1)
        self.ctx.enable(self.ctx.DEPTH_TEST)

    def _solid_rectangles(self):
        """A rectangle of pixels around each solid, (n, 4)."""
        from avcli.scene.furniture import BALL, BOX, TRIANGLE

        s = self.solids
        if not len(s):
            return np.zeros((0, 4))
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        edges = np.array([(i, j) for i in range(8) for j in range(i) if np.sum(corners[i] != corners[j]) == 1])
        f = np.linspace(0, 1, 17)[:, None]
        unit = np.concatenate([corners[i] * (1 - f) + corners[j] * f for i, j in edges])
        points = s.centre[:, None] + (unit[None] * s.half[:, None]) @ s.axes
        flat = s.kind == TRIANGLE
        if flat.any():
            a, b, c = s.centre[flat], s.axes[flat, 0], s.axes[flat, 1]
            rim = np.concatenate([p[:, None] * (1 - f) + q[:, None] * f for p, q in ((a, b), (b, c), (c, a))], 1)
            points[flat] = np.resize(rim.transpose(1, 0, 2), (len(unit), flat.sum(), 3)).transpose(1, 0, 2)
        in_camera = points @ self.T_camera_room[:3, :3].T + self.T_camera_room[:3, 3]
        rectangles = _bounds(clamped_pixels(self.camera.lens, in_camera), 4.0)
        # Around a ball or a cylinder the box's edges are too wide; where the lens folds they may be too tight.
        lost = ~np.isfinite(rectangles).all(1) | ((s.kind != BOX) & (s.kind != TRIANGLE) & (s.kind != BALL) & False)
        rectangles[lost] = (0, 0, self.width, self.height)
        return _clip(rectangles, self.width, self.height)

    # People

    def _people_buffers(self):
        size = (self.width, self.height)
        ctx = self.ctx
        self.people_seen = ctx.texture(size, 2, dtype="f4")
        self._geometry = ctx.framebuffer([self.people_seen], ctx.depth_renderbuffer(size))
        self._colour, self._depth, self._ids = (
            ctx.texture(size, 4),
            ctx.texture(size, 1, dtype="u2"),
            ctx.texture(size, 1),
        )
        self._final = ctx.framebuffer([self._colour, self._depth, self._ids])
        self._cones = self._program(shaders.PEOPLE_VERTEX, shaders.PEOPLE_FRAGMENT, room_depth=0)
        _set(self._cones, size=size)
        self._shapes = self._program(shaders.SHAPE_VERTEX, shaders.SHAPE_FRAGMENT)
        _set(self._shapes, pitch=float(_SHAPE_PITCH))
        uniforms = self._room_uniforms()
        self._resolve = self._program(
            shaders.RESOLVE_VERTEX, shaders.RESOLVE, **uniforms, seen=0, room_seen=1, room_colour=2, cones=3
        )
        _set(self._resolve, size=size, per_step=1.0 / self.depth_step, samples=self.samples)
        self._stale = np.ones((-(-self.height // _TILE), -(-self.width // _TILE)), bool)
        self._last = None

    def prepare(self, bodies):
        """Everything about bodies (people.Bodies) at n times that the card needs; frames are then drawn by index."""
        return _Drawn(self, bodies)

    def draw(self, drawn, index):
        """Draw the frame of one time; returns Frame."""
        now = drawn.tiles(index)
        self._compose(drawn.instances(index), drawn.rows(index), now | self._stale)
        self._stale = now
        rgb = np.frombuffer(self._final.read(components=3, attachment=0), np.uint8).reshape(self.height, self.width, 3)
        ids = np.frombuffer(self._ids.read(), np.uint8).reshape(self.height, self.width)
        return Frame(rgb, self._read_depth(), ids, self._silhouettes(drawn, index), self.depth_step)

    def _read_depth(self):
        return np.frombuffer(self._depth.read(), np.uint16).reshape(self.height, self.width)

    def _compose(self, instances, rows, tiles):
        """Find what the cones hide, then colour the tiles."""
        ctx = self.ctx
        size = (self.width, self.height)
        self._geometry.use()
        self._geometry.clear(0, 0, 0, 0, depth=1.0)
        ctx.enable(ctx.DEPTH_TEST)
        if len(instances):
            buffer = ctx.buffer(instances.tobytes())
            self.room_seen.use(0)
            array = ctx.vertex_array(
                self._cones, [(buffer, "4f 4f 4f 4f 4f/i", "rectangle", "ball_a", "ball_b", "bulge", "middle")]
            )
            array.render(ctx.TRIANGLE_STRIP, 4, instances=len(instances))
            array.release()
            buffer.release()
        if tiles.any():
            table = self._table(rows if len(rows) else np.zeros((1, 8, 4)))
            y, x = np.nonzero(tiles)
            corners = np.stack([x, y, x + 1, y + 1], -1) * _TILE
            corners = np.minimum(corners, [*size, *size]).astype("f4")
            buffer = ctx.buffer(corners.tobytes())
            self._final.use()
            ctx.disable(ctx.DEPTH_TEST)
            for unit, texture in enumerate((self.people_seen, self.room_seen, self.room_colour, table)):
                texture.use(unit)
            array = ctx.vertex_array(self._resolve, [(buffer, "4f/i", "rectangle")])
            array.render(ctx.TRIANGLE_STRIP, 4, instances=len(corners))
            array.release()
            buffer.release()
            table.release()

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
        buffer = ctx.buffer(instances.tobytes())
        array = ctx.vertex_array(
            self._shapes, [(buffer, "4f 4f 4f 4f 4f 2f/i", "rectangle", "ball_a", "ball_b", "bulge", "middle", "place")]
        )
        array.render(ctx.TRIANGLE_STRIP, 4, instances=len(instances))
        covered = np.frombuffer(fbo.read(components=1, alignment=1), np.uint8).reshape(size[1], size[0]) > 0
        for item in (array, buffer, fbo, picture):
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
        self.rectangles = self._cone_rectangles(a, b)

    def _cone_rectangles(self, a, b):
        """Bounds (n, p, 4) in pixels of each cone: of balls along its axis, seen as cones of rays by the camera."""
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
                tangent = sine / np.sqrt(1 - sine**2) / np.cos(np.pi / 12)
                u = np.cross(way, np.where(np.abs(way[..., :1]) < 0.8, [1.0, 0, 0], [0, 1.0, 0]))
                u /= np.linalg.norm(u, axis=-1, keepdims=True)
                v = np.cross(way, u)
                ring = np.cos(angles)[:, None] * u[..., None, :] + np.sin(angles)[:, None] * v[..., None, :]
                points[:, :, k] = way[..., None, :] + tangent[..., None] * ring
        # A cone that holds the camera has no picture.
        points = points.reshape(n * p, 48, 3)
        return _bounds(clamped_pixels(self.renderer.camera.lens, points), 1.5).reshape(n, p, 4)

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
        """One row for each cone in the picture: rectangle and shape."""
        rectangles, inside = self._inside(index)
        return np.hstack([rectangles, self._geometry(index)])[inside].astype("f4")

    def rows(self, index):
        """All about each cone that shading wants, (p, 8, 4)."""
        bodies = self.bodies
        p = len(bodies.ra)
        rows = np.zeros((p, 8, 4))
        rows[:, :4] = self._geometry(index).reshape(p, 4, 4)
        rows[:, 3, 3] = bodies.person + 1
        rows[:, 4:6, :3] = linear(bodies.colours)
        rows[:, 4, 3], rows[:, 5, 3] = bodies.material, bodies.split
        rows[:, 6, :3], rows[:, 6, 3] = self.front[index], bodies.group[:, 0] if p else 0
        rows[:, 7, 0] = bodies.group[:, 1] if p else 0
        return rows

    def tiles(self, index):
        """Which tiles of the picture this frame's people touch, (rows, columns) bool."""
        r = self.renderer
        tiles = np.zeros((-(-r.height // _TILE), -(-r.width // _TILE)), bool)
        rectangles, inside = self._inside(index)
        for x0, y0, x1, y1 in (rectangles[inside] / _TILE).tolist():
            tiles[int(y0) : int(np.ceil(y1)), int(x0) : int(np.ceil(x1))] = True
        return tiles

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
            boxes = np.clip(
                self.rectangles[index][mine] / _SHAPE_PITCH + np.tile(shift, 2),
                [left, 0, left, 0],
                [left + wide, tall, left + wide, tall],
            )
            place = low - np.array([left, 0]) * _SHAPE_PITCH
            rows.append(np.hstack([boxes, geometry[mine], np.tile(place, (len(boxes), 1))]))
            tiles.append(((left, 0, left + wide, tall), (int(low[0]), int(low[1]))))
            left, height = left + wide, max(height, tall)
        instances = np.concatenate(rows) if rows else np.zeros((0, 22))
        instances = instances[np.isfinite(instances).all(1)]
        return instances.astype("f4"), tiles, (max(int(left), 1), max(int(height), 1))


def lens_uniforms(lens, width, height):
    """What the shaders need to turn pixels into rays: a polynomial each for the lateral and the axial part.

    Its variable is the squared radius, or, where the lens ends inside the polynomial's reach, the root of the distance
    to that end, in which the fold is smooth.
    """
    if isinstance(lens, Division):
        per_px = np.array([2.0 / lens.width, 2.0 / lens.height])
        stretch = np.array([0.5 * lens.width / lens.fx, 0.5 * lens.height / lens.fy])
    else:
        per_px, stretch = np.array([1.0 / lens.fx, 1.0 / lens.fy]), np.ones(2)
    x = np.maximum(abs(lens.cx + 0.5), abs(width - 0.5 - lens.cx)) * per_px[0]
    y = np.maximum(abs(lens.cy + 0.5), abs(height - 0.5 - lens.cy)) * per_px[1]
    top = min(1.5 * np.hypot(x, y), lens.radius_max)
    ends = top == lens.radius_max and not isinstance(lens, Division)
    node = 0.5 - 0.5 * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    m = top * np.sqrt((1 - node) * (1 + node)) if ends else top * np.sqrt(node)
    if isinstance(lens, Division):
        t = (m * (1 - 1e-9)) ** 2
        across = 1.0 / (1 + t * (lens.k1 + t * (lens.k2 + t * (lens.k3 + t * lens.k4))))
        ahead = np.ones_like(m)
    else:
        rays = lens.unproject(np.stack([lens.cx + lens.fx * m * (1 - 1e-13), np.full_like(m, lens.cy)], -1))
        across, ahead = rays[:, 0] / m, rays[:, 2]
    fits = []
    for values in (across, ahead):
        for degree in range(_TERMS):
            series = np.polynomial.Chebyshev.fit(node, values, degree, domain=[0, 1])
            if np.abs(series(node) - values).max() < 3e-8:
                break
        coefficients = series.convert(kind=np.polynomial.Polynomial).coef
        fits.append(np.pad(coefficients, (0, _TERMS - len(coefficients))))
    return {
        "centre": (lens.cx, lens.cy), "per_px": tuple(per_px), "stretch": tuple(stretch),
        "domain": (1.0 / top**2, float(ends), top**2, float(isinstance(lens, Division))),
        "across": fits[0].tolist(), "ahead": fits[1].tolist(),
    }  # fmt: skip


def clamped_pixels(lens, points):
    """Project points (..., 3), those outside the lens's field from the field's edge nearest to them."""
    x, y, z = np.moveaxis(points, -1, 0)
    if isinstance(lens, Division):
        ahead = np.maximum(z, 1e-6 * (np.hypot(x, y) + 1e-12))
        x = np.clip(x / ahead, -0.5 * lens.width / lens.fx, 0.5 * lens.width / lens.fx)
        y = np.clip(y / ahead, -0.5 * lens.height / lens.fy, 0.5 * lens.height / lens.fy)
        return lens.project(np.stack([x, y, np.ones_like(x)], -1) * (1 - 1e-12 * np.array([1, 1, 0])))
    r = np.hypot(x, y)
    theta = np.minimum(np.arctan2(r, z), lens.theta_max * (1 - 1e-9))
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(r > 0, np.sin(theta) / r, 0.0)
    return lens.project(np.stack([x * scale, y * scale, np.cos(theta)], -1))


def linear(srgb):
    """Linear light of sRGB fractions (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _bounds(pixels, margin):
    """Rectangles (n, 4) in pixel edges around pixels (n, m, 2); NaN where a pixel is."""
    low, high = pixels.min(1) + 0.5 - margin, pixels.max(1) + 0.5 + margin
    return np.concatenate([low, high], -1)


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
