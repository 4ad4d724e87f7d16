"""Training pictures for the embedded detector, drawn on the fly: people from above, through any lens, in any room.

The people are those of avsim-scene (avcli.scene.people: walking, standing and sitting bodies of rounded cones), drawn
here by convex hulls in painter's order, which takes some ten milliseconds a picture. Everything else is random: looks,
lenses, heights and tilts of the camera, rooms, furniture, things that are no people, light, noise, compression.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from backdrops import Backdrops, blend, dimmed

from avcli.detection.monocular import PART_HEIGHTS
from avcli.detection.view import View
from avcli.lens import Division, KannalaBrandt
from avcli.pose import camera_pose
from avcli.scene.motion import Motion
from avcli.scene.people import pose
from avcli.scene.person import KNIT, PLAID, STRIPES, Look, Person

WIDTH, HEIGHT = 640, 384
PAD = 114


def _sphere(count: int) -> np.ndarray:
    """`count` unit vectors spread evenly (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


BALL = _sphere(26)


@dataclass
class Cones:
    """A thing made of rounded cones: ends a, b (p, 3) m about its own axis, radii, flattening, colours (p, 3)."""

    a: np.ndarray
    b: np.ndarray
    ra: np.ndarray
    rb: np.ndarray
    axis: np.ndarray
    flat: np.ndarray
    colour: np.ndarray
    height: float

    def turned(self, yaw: float, place: np.ndarray) -> "Cones":
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        shift = np.array([place[0], place[1], 0.0])
        return Cones(
            self.a @ turn + shift, self.b @ turn + shift, self.ra, self.rb, self.axis @ turn, self.flat, self.colour,
            self.height,
        )  # fmt: skip


@dataclass
class Sample:
    """A picture (HEIGHT, WIDTH, 3) uint8 RGB and its people.

    boxes (n, 4), parts (n, 3, 2): torso, head, foot, anchors (n, 2): where the score belongs, all px; visible (n,);
    people (HEIGHT, WIDTH) uint8: 1 where a person is seen, where that is known.
    """

    picture: np.ndarray
    boxes: np.ndarray
    parts: np.ndarray
    anchors: np.ndarray
    visible: np.ndarray
    people: np.ndarray | None = None


def anchor(rows: np.ndarray, columns: np.ndarray, torso: np.ndarray) -> np.ndarray:
    """The torso (2,) px where it is seen, else the pixel that is nearest to the middle of what is seen of the body."""
    if ((columns == int(torso[0])) & (rows == int(torso[1]))).any():
        return torso
    pixels = np.column_stack([columns, rows]) + 0.5
    return pixels[((pixels - pixels.mean(axis=0)) ** 2).sum(axis=1).argmin()]


# --- bodies -----------------------------------------------------------------------------------------------------------


def _colour(rng) -> tuple:
    """A colour of cloth: often dull, sometimes bright."""
    hue, saturation, value = rng.uniform(0, 180), rng.beta(1.2, 1.8), rng.beta(1.5, 1.5)
    hsv = np.array([[[hue, 255 * saturation, 255 * (0.06 + 0.9 * value)]]], np.uint8)
    return tuple(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0] / 255.0)


def random_look(rng: np.random.Generator, height: float) -> Look:
    """Clothes, hair and build of somebody."""
    cuts = ["short", "long", "cropped", "bun", "receding", "curly", "beard", "ponytail", "bald", "scarf"]
    tone = rng.uniform(0.25, 1.0)
    skin = tuple(np.clip(tone * np.array([0.93, 0.73, 0.60]) + rng.normal(0, 0.02, 3), 0, 1))
    hair = tuple(np.clip(rng.choice([0.1, 0.3, 0.6, 0.8]) * np.array([1.0, 0.75, 0.5]) * rng.uniform(0.5, 1), 0, 1))
    cloth = [KNIT, KNIT, STRIPES, PLAID][rng.integers(4)]
    return Look(
        _colour(rng), _colour(rng), skin, hair, _colour(rng), cuts[rng.integers(len(cuts))], cloth,
        sleeve=rng.uniform(0.6, 2.0), legs=rng.uniform(1.2, 2.0), girth=rng.uniform(0.88, 1.25),
        shoulders=rng.uniform(0.88, 1.12), height=height, second=_colour(rng),
    )  # fmt: skip


def body_bank(rng: np.random.Generator, count: int) -> list[Cones]:
    """Pose `count` people of random looks and builds: half of them walk, the others stand or sit."""
    bank = []
    while len(bank) < count:
        height = float(np.clip(rng.normal(1.71, 0.11), 1.2, 2.0))
        look = random_look(rng, height)
        kind = rng.choice(["walk", "stand", "sit"], p=[0.5, 0.25, 0.25])
        speed = rng.uniform(0.4, 1.8) if kind == "walk" else 0.0
        times = np.array([0.0, 10.0])
        motion = Motion(
            times, np.array([[0.0, 0.0], [10.0 * speed, 0.0]]), np.array([0.0, 0.0]), np.full(2, kind == "sit"), height
        )
        speech = np.array([[0.0, 10.0]]) if rng.random() < 0.4 else np.empty((0, 2))
        person = Person(int(rng.integers(1000)), motion, look, height, speech)
        t = np.sort(rng.uniform(2, 8, 6))
        bodies = pose([person], t)
        big = (np.maximum(bodies.ra, bodies.rb) > 0.02) | (np.arange(len(bodies.ra)) % 2 == 0)
        big &= np.maximum(bodies.ra, bodies.rb) > 0.009
        place = motion.position(t)
        for k in range(len(t)):
            shift = np.array([*place[k], 0.0])
            bank.append(_split_colours(bodies, k, big, shift))
    return bank[:count]


def _split_colours(bodies, k: int, keep: np.ndarray, shift: np.ndarray) -> Cones:
    """Cut each cone that changes colour on its way (a sleeve that ends) in two."""
    a, b = bodies.a[k, keep] - shift, bodies.b[k, keep] - shift
    ra, rb, axis, flat = bodies.ra[keep], bodies.rb[keep], bodies.flat_axis[k, keep], bodies.flat[keep]
    colours, split = bodies.colours[keep], np.clip(bodies.split[keep], 0.0, 1.0)
    middle, rm = a + split[:, None] * (b - a), ra + split * (rb - ra)
    near, far = split > 0.02, split < 0.98
    height = float(np.maximum(a[:, 2] + ra, b[:, 2] + rb).max())
    return Cones(
        np.concatenate([a[near], middle[far]]), np.concatenate([middle[near], b[far]]),
        np.concatenate([ra[near], rm[far]]), np.concatenate([rm[near], rb[far]]),
        np.concatenate([axis[near], axis[far]]), np.concatenate([flat[near], flat[far]]),
        np.concatenate([colours[near, 0], colours[far, 1]]), height,
    )  # fmt: skip


def _thing(rng) -> Cones:
    """Something round that is no person: a swivel chair, a bag, a plant, a lamp, a ball, a heap of clothes."""
    count = int(rng.integers(1, 7))
    top = rng.uniform(0.15, 1.3)
    a = np.column_stack([rng.normal(0, 0.14, (count, 2)), rng.uniform(0.05, top, count)])
    b = a + rng.normal(0, 1, (count, 3)) * rng.uniform(0.02, 0.25)
    b[:, 2] = np.abs(b[:, 2])
    radius = rng.uniform(0.03, 0.2, count)
    colour = np.clip(np.array(_colour(rng)) + rng.normal(0, 0.08, (count, 3)), 0, 1)
    axis = np.tile([0.0, 0.0, 1.0], (count, 1))
    flat = rng.choice([1.0, 0.3], count)
    return Cones(a, b, radius, radius * rng.uniform(0.6, 1.2), axis, flat, colour, top)


# --- cameras and rooms ------------------------------------------------------------------------------------------------


@dataclass
class Camera:
    """A camera, its picture's place in the letterbox, and the rays of every other pixel (h, w, 3)."""

    view: View
    top: int
    left: int
    rays: np.ndarray


def random_camera(rng: np.random.Generator) -> Camera:
    """A ceiling camera of random lens, height, tilt and picture shape, at the scale at which the network looks."""
    width, height = [(640, 360), (640, 360), (640, 360), (512, 384), (384, 384), (640, 384)][rng.integers(6)]
    focal = rng.uniform(0.32, 0.62) * width if width == 640 else rng.uniform(0.32, 0.5) * width
    cx, cy = width / 2 + rng.normal(0, 12), height / 2 + rng.normal(0, 8)
    if width == 640 and rng.random() < 0.4:  # a part of a square picture, with the lens's circle
        height, focal, cy = HEIGHT, rng.uniform(0.28, 0.36) * width, HEIGHT / 2 + rng.uniform(-140, 140)
    kind = rng.random()
    if kind < 0.2:
        focal = rng.uniform(0.24, 0.42) * width
        lens = Division(focal, focal, cx, cy, rng.uniform(-0.3, -0.05), 0.0, 0.0, 0.0, width / 2, height / 2)
    elif kind < 0.5:
        lens = KannalaBrandt(862.27 / 3 * rng.uniform(0.85, 1.1), 862.7 / 3, 1049.47 / 3 * width / 640, cy,
                             -0.0269, -0.0038, 0.0016, -0.0006)  # fmt: skip
    else:
        lens = KannalaBrandt(focal, focal, cx, cy, rng.uniform(-0.06, 0.04), rng.uniform(-0.01, 0.01), 0.0, 0.0)
    z = rng.uniform(2.2, 3.2) if rng.random() < 0.8 else rng.uniform(3.2, 4.0)
    tilt = rng.normal(0, 3) if rng.random() < 0.7 else rng.normal(0, 12)
    T = camera_pose([0.0, 0.0, z], [90.0 - tilt, rng.uniform(0, 360), 0.0])
    view = View(lens, T, (width, height), np.deg2rad(88), stride=2)
    return Camera(view, (HEIGHT - height) // 2, (WIDTH - width) // 2, view.rays)


def _texture(rng) -> np.ndarray:
    """A texture (256, 256, 3) of one colour with grain, spots and, sometimes, joints of tiles or boards."""
    base = np.array(_colour(rng)) * 0.5 + rng.uniform(0.15, 0.5)
    out = np.tile(base, (256, 256, 1))
    for size in (8, 32, 128):
        spots = cv2.resize(rng.normal(0, 1, (size, size)), (256, 256), interpolation=cv2.INTER_CUBIC)
        out += spots[..., None] * rng.uniform(0, 0.05)
    style = rng.integers(4)
    if style in (1, 2):
        step = int(rng.choice([32, 64, 128]))
        shade = rng.uniform(0.6, 1.15)
        out[::step] *= shade
        if style == 1:
            out[:, ::step] *= shade
    elif style == 3:
        step = int(rng.choice([16, 32]))
        tiles = rng.normal(1, 0.12, (256 // step, 4))
        out *= cv2.resize(tiles, (256, 256), interpolation=cv2.INTER_NEAREST)[..., None]
    return out.astype(np.float32)


def _room(rng, camera: Camera, textures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Draw the empty room at half size and scale it up; returns the picture (float32) and the walls' places (4,)."""
    rays, z = camera.rays, camera.view.origin[2]
    walls = rng.uniform(1.4, 4.5, 4)  # distances of the walls at +x, -x, +y, -y
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = np.stack(
            [
                -z / np.minimum(rays[..., 2], -1e-6) + 1e6 * (rays[..., 2] >= 0),
                walls[0] / np.maximum(rays[..., 0], 1e-6),
                -walls[1] / np.minimum(rays[..., 0], -1e-6),
                walls[2] / np.maximum(rays[..., 1], 1e-6),
                -walls[3] / np.minimum(rays[..., 1], -1e-6),
            ]
        )
    plane = hits.argmin(axis=0)
    distance = hits.min(axis=0)
    points = rays * distance[..., None]
    out = np.zeros((*plane.shape, 3), np.float32)
    light = rng.uniform(-1.5, 1.5, 2)
    chosen = [textures[i] for i in rng.integers(len(textures), size=2)]
    for index, (first, second) in enumerate(((0, 1), (1, 2), (1, 2), (0, 2), (0, 2))):
        here = plane == index
        if not here.any():
            continue
        scale = 64.0
        u = np.nan_to_num(points[..., first][here] * scale).astype(int) & 255
        v = np.nan_to_num(points[..., second][here] * scale).astype(int) & 255
        out[here] = chosen[0 if index == 0 else 1][v, u] * (1.0 if index == 0 else rng.uniform(0.6, 1.1))
    far = ((points[..., :2] - light) ** 2).sum(axis=-1)
    out *= (rng.uniform(0.5, 1.0) + rng.uniform(0, 0.6) * np.exp(-far / 6.0))[..., None].astype(np.float32)
    out[~np.isfinite(rays[..., 0])] = 0.0
    size = camera.view.size
    return cv2.resize(out, size, interpolation=cv2.INTER_LINEAR), walls


def _box(rng, centre, half, yaw, colour) -> list[tuple]:
    """The visible faces of a box as (corners (16, 3), colour): the top and four sides."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    faces = []
    for face, shade in (((0, 1, 2), 1.0), ((0, 2, 1), 0.75), ((1, 2, 0), 0.6)):
        for sign in (1.0,) if face[2] == 2 else (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, face[0]], corners[:, face[1]] = [-1, 1, 1, -1], [-1, -1, 1, 1]
            corners[:, face[2]] = sign
            corners *= half
            steps = np.linspace(0, 1, 4, endpoint=False)[:, None]
            edge = np.concatenate([corners[i] + steps * (corners[(i + 1) % 4] - corners[i]) for i in range(4)])
            faces.append((edge @ turn + centre, np.array(colour) * shade * rng.uniform(0.9, 1.05)))
    return faces


def _furniture(rng) -> list[tuple]:
    """Tables with chairs, cabinets, screens that hang, boxes: faces as `_box` gives them."""
    faces = []
    for _ in range(rng.integers(0, 5)):
        place, yaw, wood = rng.uniform(-2.8, 2.8, 2), rng.choice([0, np.pi / 2, rng.uniform(0, 3.14)]), _colour(rng)
        kind = rng.integers(4)
        if kind <= 1:
            half = np.array([rng.uniform(0.4, 0.9), rng.uniform(0.3, 0.5), 0.02])
            for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                leg = np.array([x * (half[0] - 0.05), y * (half[1] - 0.05)])
                c, s = np.cos(yaw), np.sin(yaw)
                spot = place + leg @ np.array([[c, s], [-s, c]])
                faces += _box(rng, np.array([*spot, 0.36]), np.array([0.025, 0.025, 0.36]), yaw, [0.2, 0.2, 0.22])
            faces += _box(rng, np.array([*place, rng.uniform(0.68, 0.78)]), half, yaw, wood)
            seat = place + rng.uniform(-0.9, 0.9, 2)
            turn, colour = rng.uniform(0, 6.28), _colour(rng)
            faces += _box(rng, np.array([*seat, 0.44]), np.array([0.22, 0.22, 0.02]), turn, colour)
            back = seat + 0.21 * np.array([np.cos(turn), np.sin(turn)])
            faces += _box(rng, np.array([*back, 0.68]), np.array([0.02, 0.21, 0.2]), turn, colour)
        elif kind == 2:
            top = rng.uniform(0.3, 1.9)
            half = np.array([rng.uniform(0.15, 0.6), rng.uniform(0.15, 0.4), top / 2])
            faces += _box(rng, np.array([*place, top / 2]), half, yaw, wood)
        elif rng.random() < 0.3:
            half = np.array([rng.uniform(0.1, 0.45), rng.uniform(0.1, 0.45), 0.02])
            faces += _box(rng, np.array([*place, rng.uniform(1.9, 2.1)]), half, yaw, wood)
    return faces


# --- pictures ---------------------------------------------------------------------------------------------------------


def _project(view: View, points: np.ndarray) -> np.ndarray:
    pixels = view.project(points.reshape(-1, 3)).reshape(*points.shape[:-1], 2)
    return np.clip(pixels, -4000, 4000)


def _hulls(view: View, cones: Cones, light: np.ndarray) -> list[tuple]:
    """(distance, hull, colour) of each cone: dark where it turns from the light, then lit parts over it."""
    offsets = BALL[None] - (1 - cones.flat)[:, None, None] * (BALL @ cones.axis.T).T[..., None] * cones.axis[:, None]
    points = np.concatenate(
        [
            cones.a[:, None] + cones.ra[:, None, None] * offsets,
            cones.b[:, None] + cones.rb[:, None, None] * offsets,
        ],
        axis=1,
    )
    pixels = _project(view, points)
    distance = np.linalg.norm((cones.a + cones.b) / 2 - view.origin, axis=1) - np.maximum(cones.ra, cones.rb)
    lit = np.tile(BALL @ light, 2)
    layers = [(np.ones(len(lit), bool), 0.55), (lit > 0.0, 0.8), (lit > 0.5, 1.0)]
    out = []
    for index in range(len(distance)):
        if not np.isfinite(pixels[index]).all():
            continue
        size = np.ptp(pixels[index], axis=0).max()
        shapes = []
        for mask, shade in layers if size > 5 else layers[1:2]:
            part = pixels[index] if shade == 0.55 or size <= 5 else pixels[index][mask]
            hull = cv2.convexHull((part * 16).astype(np.int32))
            shapes.append((hull, cones.colour[index] * shade))
        out.append((distance[index], shapes))
    return out


def draw(
    rng: np.random.Generator,
    bank: list[Cones],
    textures: list[np.ndarray],
    camera: Camera,
    backdrops: Backdrops | None,
    empty: bool,
) -> Sample:
    """Draw one picture; three in four have a photographed room where there are any."""
    view = camera.view
    picture, walls = _room(rng, camera, textures)
    if backdrops and rng.random() < 0.75:
        picture = backdrops.furnished(rng, camera.rays, view.origin[2], walls, view.size)
    light = np.array([*rng.normal(0, 0.5, 2), 1.0])
    light /= np.linalg.norm(light)
    crowd = int(rng.choice([0, 1, 2, 3, 4, 5, 7], p=[0.12, 0.2, 0.2, 0.2, 0.13, 0.1, 0.05]))
    crowd = 0 if empty else crowd
    spots, things = [], []
    for _ in range(crowd):
        for _ in range(10):
            radius = rng.uniform(0, 3.4) if rng.random() < 0.8 else rng.uniform(0, 1.2)
            angle = rng.uniform(0, 2 * np.pi)
            spot = radius * np.array([np.cos(angle), np.sin(angle)])
            if rng.random() < 0.25 and spots:
                spot = spots[-1] + rng.normal(0, 0.45, 2)
            inside = -walls[1] + 0.2 < spot[0] < walls[0] - 0.2 and -walls[3] + 0.2 < spot[1] < walls[2] - 0.2
            if inside and all(np.linalg.norm(spot - other) > 0.38 for other in spots):
                spots.append(spot)
                break
    bodies = [bank[rng.integers(len(bank))].turned(rng.uniform(0, 2 * np.pi), spot) for spot in spots]
    for _ in range(rng.integers(0, 4)):
        spot = np.array([rng.uniform(-walls[1], walls[0]), rng.uniform(-walls[3], walls[2])])
        if all(np.linalg.norm(spot - other) > 0.4 for other in spots):
            things.append(_thing(rng).turned(rng.uniform(0, 6.28), spot))
    _shadows(rng, picture, view, spots)
    pieces = []
    for person, cones in enumerate(bodies + things):
        owner = person + 1 if person < len(bodies) else 0
        pieces += [(distance, owner, shapes) for distance, shapes in _hulls(view, cones, light)]
    for corners, colour in _furniture(rng):
        pixels = _project(view, corners)
        if np.isfinite(pixels).all():
            distance = np.linalg.norm(corners.mean(axis=0) - view.origin)
            pieces.append((distance, 0, [((pixels * 16).astype(np.int32), colour)]))
    pieces.sort(key=lambda piece: -piece[0])
    owners = np.zeros(picture.shape[:2], np.uint8)
    whole = np.zeros(len(bodies))
    alone = [np.zeros_like(owners) for _ in bodies]
    for _, owner, shapes in pieces:
        for layer, (hull, colour) in enumerate(shapes):
            fill = cv2.fillConvexPoly if owner else _fill
            fill(picture, hull, tuple(map(float, colour)), shift=4)
            if layer == 0:
                fill(owners, hull, owner, shift=4)
                if owner:
                    fill(alone[owner - 1], hull, 1, shift=4)
    whole = np.array([mask.sum() for mask in alone], float)
    return _labelled(rng, picture, owners, whole, bodies, spots, camera, worse=backdrops is not None)


def _fill(picture, hull, colour, shift):
    cv2.fillPoly(picture, [hull], colour, shift=shift)


def _shadows(rng, picture: np.ndarray, view: View, spots: list) -> None:
    """Darken the floor about the feet."""
    if not spots:
        return
    mask = np.zeros(picture.shape[:2], np.float32)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    for spot in spots:
        circle = np.column_stack([spot[0] + 0.28 * np.cos(angle), spot[1] + 0.28 * np.sin(angle), np.zeros(12)])
        pixels = _project(view, circle)
        if np.isfinite(pixels).all():
            cv2.fillConvexPoly(mask, (pixels * 16).astype(np.int32), 1.0, shift=4)
    mask = cv2.blur(mask, (15, 15)) * rng.uniform(0, 0.55)
    picture *= 1 - mask[..., None]


def _labelled(rng, picture, owners, whole, bodies, spots, camera: Camera, worse: bool) -> Sample:
    """Finish the picture as a camera would and read the labels off the map of owners."""
    view = camera.view
    boxes, parts, anchors, visible = [], [], [], []
    size = np.array(view.size)
    for index, (body, spot) in enumerate(zip(bodies, spots, strict=True)):
        rows, columns = np.nonzero(owners == index + 1)
        if len(rows) < 8:
            continue
        axis = np.column_stack([np.tile(spot, (3, 1)), PART_HEIGHTS * body.height])
        points = view.project(axis) + 0.5
        box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)
        if not np.isfinite(points).all():
            points = np.tile((box[:2] + box[2:]) / 2, (3, 1))
        # How much of the whole body is seen: what stands outside the picture counts as hidden.
        full = _project(view, np.concatenate([body.a, body.b]))
        full = full[np.isfinite(full).all(axis=1)]
        spread = np.ptp(full, axis=0).prod() if len(full) > 2 else 1.0
        cut = np.ptp(np.clip(full, 0, size), axis=0).prod() if len(full) > 2 else 1.0
        boxes.append(box)
        parts.append(points)
        anchors.append(anchor(rows, columns, points[0]))
        visible.append(len(rows) / max(whole[index], 1) * min(cut / max(spread, 1), 1.0))
    picture = _camera_effects(rng, dimmed(rng, picture) if worse else picture)
    out = np.full((HEIGHT, WIDTH, 3), PAD, np.uint8)
    out[camera.top : camera.top + size[1], camera.left : camera.left + size[0]] = picture
    shift = np.array([camera.left, camera.top])
    return Sample(
        out,
        np.array(boxes).reshape(-1, 4) + np.tile(shift, 2),
        np.array(parts).reshape(-1, 3, 2) + shift,
        np.array(anchors).reshape(-1, 2) + shift,
        np.array(visible),
    )


def _camera_effects(rng, picture: np.ndarray) -> np.ndarray:
    picture = np.clip(picture * rng.uniform(0.6, 1.35) * rng.uniform(0.9, 1.1, 3).astype(np.float32), 0, 1)
    picture = picture ** np.float32(rng.uniform(0.65, 1.4))
    if rng.random() < 0.6:
        picture = cv2.GaussianBlur(picture, (3, 3), rng.uniform(0.3, 1.2))
    if rng.random() < 0.08:
        picture = np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2)
    if rng.random() < 0.6:
        noise = rng.standard_normal((128, 256), dtype=np.float32) * np.float32(rng.uniform(0, 0.05))
        tall, wide = -(-picture.shape[0] // 128), -(-picture.shape[1] // 256)
        picture = picture + np.tile(noise, (tall, wide))[: picture.shape[0], : picture.shape[1], None]
    picture = (np.clip(picture, 0, 1) * 255).astype(np.uint8)
    if rng.random() < 0.2:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))]
        picture = cv2.imdecode(cv2.imencode(".jpg", picture, quality)[1], cv2.IMREAD_COLOR)
    return picture


class Generator:
    """An endless stream of pictures, the same for the same seed.

    Args:
        seed: of all chance.
        backdrops: photographed rooms, or None.
        empty: draw no people.
        bodies, cameras, textures: how many of each are made at a time; they are replaced one by one.
    """

    def __init__(
        self,
        seed: int,
        backdrops: Backdrops | None = None,
        empty: bool = False,
        bodies: int = 600,
        cameras: int = 60,
        textures: int = 40,
    ):
        self.rng, self.backdrops, self.empty = np.random.default_rng(seed), backdrops, empty
        self.bank = body_bank(self.rng, bodies)
        self.cameras = [random_camera(self.rng) for _ in range(cameras)]
        self.textures = [_texture(self.rng) for _ in range(textures)]

    def __call__(self) -> Sample:
        rng = self.rng
        if rng.random() < 0.05:
            self.cameras[rng.integers(len(self.cameras))] = random_camera(rng)
            self.textures[rng.integers(len(self.textures))] = _texture(rng)
        if rng.random() < 0.05:
            start = 6 * rng.integers(len(self.bank) // 6)
            self.bank[start : start + 6] = body_bank(rng, 6)
        camera = self.cameras[rng.integers(len(self.cameras))]
        return _flipped(rng, draw(rng, self.bank, self.textures, camera, self.backdrops, self.empty))

    def moved(self, sample: Sample) -> Sample:
        """The people of a picture in a photographed room, in another light."""
        rng, camera = self.rng, self.cameras[self.rng.integers(len(self.cameras))]
        walls = rng.uniform(1.4, 4.5, 4)
        height = camera.view.origin[2]
        behind = self.backdrops.furnished(rng, camera.rays, height, walls, (WIDTH, HEIGHT))
        blend(behind, sample.picture.astype(np.float32) / 255, sample.people)
        picture = _camera_effects(rng, dimmed(rng, behind))
        return Sample(picture, sample.boxes, sample.parts, sample.anchors, sample.visible, sample.people)


def _flipped(rng, sample: Sample) -> Sample:
    """Mirror the picture, or turn its colours into others, now and then."""
    picture, boxes = sample.picture, sample.boxes.copy()
    parts, anchors, people = sample.parts.copy(), sample.anchors.copy(), sample.people
    if rng.random() < 0.5:
        picture = picture[:, ::-1]
        people = None if people is None else people[:, ::-1]
        boxes[:, [0, 2]] = WIDTH - boxes[:, [2, 0]]
        parts[..., 0] = WIDTH - parts[..., 0]
        anchors[:, 0] = WIDTH - anchors[:, 0]
    if rng.random() < 0.15:
        picture = picture[..., rng.permutation(3)]
    return Sample(np.ascontiguousarray(picture), boxes, parts, anchors, sample.visible, people)
