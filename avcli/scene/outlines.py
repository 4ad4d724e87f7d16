"""Where bodies lie in the picture: what the passes that draw people need, for many times at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avcli import pose
from avcli.scene.canvas import Canvas, bounds, clip, linear
from avcli.scene.people import Bodies

TILE = 32  # px, the grain in which a frame is redrawn
SHADOW_PITCH = 8  # px, the grid on which people's shadows are computed
SHAPE_PITCH = 2  # px, the grid on which visible fractions are counted
SHADOW_REACH = 0.65  # m around a person, where their shadow has faded
_SHADOW_MARGIN_PX = 4.0
_OUTLINE_MARGIN_PX = 1.5
_BALLS = 0.0, 0.5, 1.0  # of a cone that are looked at, as fractions of its axis
_SLACK = 1.04  # by which a ball's outline may be larger than the ellipse through four of its points
_CONES_TOGETHER = 2048
_SEAM = 3.7  # between the patterns of two people's clothes, so that no two are painted alike

_SHEET_SAMPLES = 1 << 26  # of one picture of silhouettes, at most; a single larger one has a picture of its own


@dataclass
class Tile:
    """One person's part (x0, y0, x1, y1) of a sheet, and the image place (x, y) of its first sample."""

    person: int
    box: tuple[int, int, int, int]
    place: tuple[int, int]


@dataclass
class Sheet:
    """A picture of silhouettes that stand in rows: its size (width, height), its tiles, and their cones (m, 28)."""

    size: tuple[int, int]
    tiles: list[Tile]
    instances: np.ndarray


class Outlines:
    """Bodies in the camera's frame, and the rectangles that they fill.

    Args:
        canvas: whose camera looks.
        bodies: at n times, p cones in all.
        shadow_reach: m around a person, where their shadow has faded.
        still_px: a person keeps the pose of an earlier time until a part of them has moved by more in the picture, px.

    Attributes:
        held: (n, people) index of the time whose pose each person has.
        travel_px: how far people's parts move in the picture from the first time to the last, at most.
    """

    def __init__(
        self, canvas: Canvas, bodies: Bodies, shadow_reach: float = SHADOW_REACH, still_px: float = 0.0
    ) -> None:
        self.canvas, self.bodies = canvas, bodies
        R, origin = canvas.T_camera_room[:3, :3], canvas.T_camera_room[:3, 3]
        a, b = bodies.a @ R.T + origin, bodies.b @ R.T + origin
        axis = bodies.flat_axis @ R.T
        self._front = bodies.front @ R.T
        self._middle = 0.5 * (a + b)
        bulge = (1.0 / bodies.flat - 1.0)[None, :, None]

        def swell(points: np.ndarray) -> np.ndarray:
            """The points in the space in which the cones are not flattened."""
            return points + bulge * axis * np.sum(axis * (points - self._middle), -1, keepdims=True)

        self._a, self._b = swell(a), swell(b)
        self._axis, self._bulge = axis, bulge
        self._first = np.searchsorted(bodies.person, np.arange(bodies.balls.shape[1]))  # cone of each person
        self._rectangles, self._quads, places = self._outline(a, b)
        way = places[-1] - places[0]
        self.travel_px = float(np.sqrt(np.nan_to_num(np.einsum("pki,pki->pk", way, way)).max(initial=0.0)))
        self.held = self._hold(places, still_px)
        self._balls = bodies.balls
        if (self.held != np.arange(len(bodies.times))[:, None]).any():
            self._keep_poses()
        self._shadows = self._shadow_rectangles(shadow_reach)

    def _hold(self, places: np.ndarray, still_px: float) -> np.ndarray:
        """Which time's pose each person has, (n, people), by the places (n, p, k, 2) px of their cones."""
        n, people = places.shape[0], self.bodies.balls.shape[1]
        held = np.zeros((n, people), int)
        if not people:
            return held
        last = places[0].copy()
        for index in range(1, n):
            step = places[index] - last
            far = np.einsum("pki,pki->pk", step, step).max(1)
            appeared = np.isnan(last).any((1, 2)) != np.isnan(places[index]).any((1, 2))
            moves = np.where(appeared, np.inf, np.nan_to_num(far, nan=0.0))
            moved = np.maximum.reduceat(moves, self._first) > still_px**2
            held[index] = np.where(moved, index, held[index - 1])
            mine = moved[self.bodies.person]
            last[mine] = places[index][mine]
        return held

    def _keep_poses(self) -> None:
        """Give everybody the pose that they have at each time."""
        cones = self.held[:, self.bodies.person], np.arange(len(self.bodies.person))
        for name in ("_a", "_b", "_axis", "_front", "_middle", "_rectangles", "_quads"):
            setattr(self, name, getattr(self, name)[cones])
        self._balls = self._balls[self.held, np.arange(self.held.shape[1])]

    def instances(self, index: int, tiles: np.ndarray | None = None) -> np.ndarray:
        """Parallelogram and shape of each cone in the picture at one time, (m, 22); only of those that touch tiles."""
        rectangles, inside = self._inside(index)
        if tiles is not None:
            total = np.pad(tiles.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
            x0, y0, x1, y1 = _tile_bounds(rectangles)
            inside &= total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0] > 0
        return np.hstack([self._quads[index], self._geometry(index)])[inside]

    def rows(self, index: int) -> np.ndarray:
        """What shading needs to know of each cone at one time, (p, 9, 4)."""
        bodies = self.bodies
        p = len(bodies.ra)
        rows = np.zeros((p, 9, 4))
        rows[:, :4] = self._geometry(index).reshape(p, 4, 4)
        rows[:, 3, 3] = bodies.person + 1
        rows[:, 4:6, :3], rows[:, 7, :3] = linear(bodies.colours[:, :2]), linear(bodies.colours[:, 2])
        rows[:, 4, 3], rows[:, 5, 3] = bodies.material, bodies.split
        rows[:, 6, :3], rows[:, 6, 3] = self._front[index], _SEAM * bodies.person
        rows[:, 7, 3] = bodies.person * bodies.balls.shape[2]
        rows[:, 8] = bodies.touching
        return rows

    def balls(self, index: int) -> np.ndarray:
        """The balls that cast soft shadows at one time, (people * 20, 4)."""
        return self._balls[index].reshape(-1, 4)

    def shadow_rectangles(self, index: int) -> np.ndarray:
        """Where each person darkens the room, in coarse pixels, and which balls are theirs: (people, 6)."""
        count, each = self.bodies.balls.shape[1:3]
        first = np.arange(count)[:, None] * each
        rectangles = self._shadows[index] / SHADOW_PITCH + [-1, -1, 1, 1]
        rows = np.hstack([rectangles, first, first + each])
        return rows[np.isfinite(rows).all(1)]

    def tiles(self, index: int, people: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which tiles of the picture some people (bool each) touch at one time, and which their shadows do.

        Returns:
            Two times (rows, columns) bool.
        """
        width, height = self.canvas.size
        rectangles, inside = self._inside(index)

        def marked(group: np.ndarray) -> np.ndarray:
            count = np.zeros((-(-height // TILE) + 1, -(-width // TILE) + 1), int)
            x0, y0, x1, y1 = _tile_bounds(group)
            for y, x, sign in ((y0, x0, 1), (y0, x1, -1), (y1, x0, -1), (y1, x1, 1)):
                np.add.at(count, (y, x), sign)
            tiles: np.ndarray = count.cumsum(0).cumsum(1)[:-1, :-1] > 0
            return tiles

        # A shadow is drawn a sample farther, and mixed with the next sample.
        reach = 2 * SHADOW_PITCH * np.array([-1, -1, 1, 1])
        shadows = clip(self._shadows[index] + reach, self.canvas.size)[people]
        return marked(rectangles[inside & people[self.bodies.person]]), marked(shadows)

    def sheets(self, index: int, people: np.ndarray) -> list[Sheet]:
        """Lay out some people's silhouettes at one time in rows, on as few pictures as this OpenGL can hold.

        People of whom nothing can be drawn have no tile.
        """
        packed = _packed([tile for tile in self._shape_boxes(index) if people[tile.person]], self.canvas.largest)
        return [Sheet(size, tiles, self._shape_instances(index, tiles)) for size, tiles in packed]

    def _shape_instances(self, index: int, tiles: list[Tile]) -> np.ndarray:
        """The cones (m, 28) of the people of some tiles: parallelogram in the sheet, shape, place and tile."""
        shift = np.full((len(self._first), 6), np.nan)
        where = np.zeros((len(shift), 6))
        for tile in tiles:
            place = np.array(tile.place) - np.array(tile.box[:2]) * SHAPE_PITCH
            shift[tile.person] = [*(-place / SHAPE_PITCH), 0, 0, 0, 0]
            where[tile.person] = [*place, *tile.box]
        person = self.bodies.person
        quads = self._quads[index] / SHAPE_PITCH + shift[person]
        instances = np.hstack([quads, self._geometry(index), where[person]])
        return instances[np.isfinite(instances).all(1)]

    def _shape_boxes(self, index: int) -> list[Tile]:
        """A tile for each silhouette, not yet laid out: its box begins at (0, 0)."""
        rectangles = self._rectangles[index]
        finite = np.isfinite(rectangles).all(1)[:, None]
        if not len(rectangles):
            return []
        low = np.minimum.reduceat(np.where(finite, rectangles[:, :2], np.inf), self._first)
        high = np.maximum.reduceat(np.where(finite, rectangles[:, 2:], -np.inf), self._first)
        # What lies far outside the picture is counted on no grid larger than twice the picture, or than can be drawn.
        size = np.array(self.canvas.size)
        beyond = np.minimum(2 * np.ceil(size / 2), np.floor((self.canvas.largest * SHAPE_PITCH - size) / 4) * 2)
        low = np.maximum(np.floor(low / SHAPE_PITCH) * SHAPE_PITCH, -beyond)
        high = np.minimum(np.ceil(high / SHAPE_PITCH), np.floor((size + beyond) / SHAPE_PITCH)) * SHAPE_PITCH
        kept = np.flatnonzero((high > low).all(1))
        extent = ((high - low)[kept] / SHAPE_PITCH).astype(int)
        places = low[kept].astype(int)
        return [
            Tile(person, (0, 0, wide, tall), (x, y))
            for person, (wide, tall), (x, y) in zip(kept.tolist(), extent.tolist(), places.tolist(), strict=True)
        ]

    def _shadow_rectangles(self, reach: float) -> np.ndarray:
        """Where in the picture a person darkens the room: around the place under them, (n, people, 4)."""
        middle = self._balls[..., :2].mean(2)
        turn = np.arange(16) * np.pi / 8
        ring = reach * np.stack([np.cos(turn), np.sin(turn)], -1)
        floor = np.concatenate([middle[:, :, None] + ring, np.zeros((*middle.shape[:2], 16, 1))], -1)
        inside = pose.apply(self.canvas.T_camera_room, floor)
        return bounds(self.canvas.camera.lens.project_clamped(inside), _SHADOW_MARGIN_PX)

    def _outline(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Around each cone in the picture: a rectangle (n, p, 4) and a parallelogram along its axis (n, p, 6).

        Third are the places of balls along the axis (n, p, balls, 2) px. Rectangle and parallelogram hold the
        outlines of these balls, as the camera sees them: as cones of rays.
        """
        n, p = a.shape[:2]
        rectangles, quads, places = np.empty((n, p, 4)), np.empty((n, p, 6)), np.empty((n, p, len(_BALLS), 2))
        together = max(1, _CONES_TOGETHER // max(p, 1))  # what fits into a processor's cache is many times faster
        for first in range(0, n, together):
            now = slice(first, first + together)
            ovals = self._ovals(a[now].reshape(-1, 3), b[now].reshape(-1, 3))
            found = _rectangles(*ovals), _parallelograms(*ovals), ovals[0]
            for whole, part in zip((rectangles, quads, places), found, strict=True):
                whole[now] = part.reshape(whole[now].shape)
        return rectangles, quads, places

    def _ovals(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The images of balls along the axes of m cones: middles (m, balls, 2) px, half diameters that are conjugate
        (m, balls, 2, 2) px, and by how much they may be larger for the bending of the lens (m, balls) px.
        """
        lengths = np.tile(np.stack([self.bodies.ra, self.bodies.rb]), len(a) // max(len(self.bodies.ra), 1))
        f = np.array(_BALLS)[:, None]
        centre = a[:, None] * (1 - f) + b[:, None] * f
        radius = lengths[0][:, None] * (1 - f[:, 0]) + lengths[1][:, None] * f[:, 0]
        square = np.einsum("mbi,mbi->mb", centre, centre)
        # A ball that holds the camera has no outline: it is left out, as NaN.
        with np.errstate(invalid="ignore", divide="ignore"):
            tangent = radius / np.sqrt(square - radius**2)
            direction = centre / np.sqrt(square)[..., None]
            x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
            upright = np.abs(x) < 0.8
            u = np.where(upright[..., None], np.stack([0 * x, z, -y], -1), np.stack([-z, 0 * x, x], -1))
            u *= (tangent / np.sqrt(np.einsum("mbi,mbi->mb", u, u)))[..., None]
            v = np.stack(
                [y * u[..., 2] - z * u[..., 1], z * u[..., 0] - x * u[..., 2], x * u[..., 1] - y * u[..., 0]], -1
            )
            points = np.stack([direction + u, direction - u, direction + v, direction - v], 2)
            pixels = self.canvas.camera.lens.project_clamped(points.reshape(-1, 3)).reshape(*points.shape[:3], 2)
        ends, others = pixels[:, :, ::2], pixels[:, :, 1::2]
        middles, halves = 0.5 * (ends + others), 0.5 * (ends - others)
        bent = np.linalg.norm(middles[:, :, 0] - middles[:, :, 1], axis=-1)
        return middles.mean(2), halves, bent

    def _inside(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Rectangles of the cones cut to the picture, and which of them are not empty."""
        rectangles = clip(self._rectangles[index], self.canvas.size)
        return rectangles, (rectangles[:, 2] > rectangles[:, 0]) & (rectangles[:, 3] > rectangles[:, 1])

    def _geometry(self, index: int) -> np.ndarray:
        """Shape of each cone as the shaders take it, (p, 16): two balls, bulge, middle and number."""
        p = len(self.bodies.ra)
        return np.concatenate(
            [
                self._a[index], self.bodies.ra[:, None], self._b[index], self.bodies.rb[:, None],
                self._axis[index], np.broadcast_to(self._bulge[0], (p, 1)), self._middle[index], np.arange(p)[:, None],
            ],
            1,
        )  # fmt: skip


def _tile_bounds(rectangles: np.ndarray) -> np.ndarray:
    """First and end column and row (4, m) of the tiles that rectangles (m, 4) px touch."""
    return np.concatenate([rectangles[:, :2] // TILE, -(-rectangles[:, 2:] // TILE)], 1).astype(int).T


def _reach(halves: np.ndarray, bent: np.ndarray, way: np.ndarray) -> np.ndarray:
    """How far ovals (m, balls) reach along unit vectors (m, 1, 2), px: an ellipse's projection, and a little more."""
    across = np.einsum("mbki,mbi->mbk", halves, np.broadcast_to(way, (*bent.shape, 2)))
    return _SLACK * np.sqrt(np.einsum("mbk,mbk->mb", across, across)) + bent + _OUTLINE_MARGIN_PX


def _rectangles(middles: np.ndarray, halves: np.ndarray, bent: np.ndarray) -> np.ndarray:
    """Rectangles (m, 4) in pixel edges around ovals; NaN where a ball holds the camera."""
    reach = np.stack([_reach(halves, bent, np.eye(2)[k]) for k in (0, 1)], -1)
    return np.concatenate([(middles - reach).min(1), (middles + reach).max(1)], -1) + 0.5


def _parallelograms(middles: np.ndarray, halves: np.ndarray, bent: np.ndarray) -> np.ndarray:
    """Origin and two edges (m, 6) of the rectangle around each cone's ovals, along its axis in the picture."""
    along = middles[:, -1:] - middles[:, :1]
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    along = np.where(length > 1.0, along / np.maximum(length, 1e-9), [1.0, 0.0])
    across = np.stack([-along[..., 1], along[..., 0]], -1)
    sides = []
    for way in (along, across):
        place, reach = np.sum(middles * way, -1), _reach(halves, bent, way)
        sides.append(((place - reach).min(1, keepdims=True), (place + reach).max(1, keepdims=True)))
    (near, far), (left, right) = sides
    along, across = along[:, 0], across[:, 0]
    origin = near * along + left * across + 0.5
    return np.concatenate([origin, (far - near) * along, (right - left) * across], -1)


def _packed(tiles: list[Tile], largest: int) -> list[tuple[tuple[int, int], list[Tile]]]:
    """Put tiles beside each other in rows of at most `largest` samples; returns the sheets' sizes and their tiles."""
    tallest = _SHEET_SAMPLES // largest
    sheets: list[tuple[tuple[int, int], list[Tile]]] = []
    placed: list[Tile] = []
    left = top = width = height = 0
    for tile in tiles:
        wide, tall = tile.box[2:]
        if left + wide > largest:
            left, top = 0, height
        if placed and top + tall > max(tallest, tall):
            sheets.append(((width, height), placed))
            placed, left, top, width, height = [], 0, 0, 0, 0
        placed.append(Tile(tile.person, (left, top, left + wide, top + tall), tile.place))
        left += wide
        width, height = max(width, left), max(height, top + tall)
    return [*sheets, ((width, height), placed)] if placed else sheets
