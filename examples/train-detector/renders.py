"""Random scenes drawn by avsim-scene's own renderer: to learn from, and, with other seeds, to be judged by."""

import dataclasses

import numpy as np
from generate import HEIGHT, PAD, WIDTH, Sample, _camera_effects, _colour, _flipped, anchor, random_look

from avcli.detection.monocular import PART_HEIGHTS
from avcli.detection.view import View
from avcli.scene import layout, render, scenario
from avcli.scene.people import Bodies, pose

PANELS = 0.18
"""Share of rooms in which something large hangs."""

SHAPES = [(640, 360), (640, 360), (640, 360), (640, 384), (512, 384), (384, 384)]


def random_scenario(
    rng: np.random.Generator, width: int, height: int, people: int | None = None, pieces: int | None = None,
    furnished: float = 0.0, panels: float = PANELS,
) -> dict:  # fmt: skip
    """A scenario of random room, camera, `pieces` of furniture and walks, for pictures of width × height px; 10 s.

    A share of `furnished` of the rooms also has what random worlds have, one of `panels` something large that hangs.
    """
    room = [*rng.uniform(3.6, 7.5, 2), rng.uniform(2.5, 4.2)]
    top = min(rng.uniform(2.2, 3.2) if rng.random() < 0.8 else rng.uniform(3.2, 4.0), room[2] - 0.1)
    eye = [room[0] / 2 + rng.normal(0, 0.3), room[1] / 2 + rng.normal(0, 0.3), top]
    scale = width / 1920
    camera = {"camera_position_m": eye, "image_width_px": width, "image_height_px": height, "frame_rate_hz": 10}
    kind = rng.random()
    if kind < 0.2:
        focal = rng.uniform(0.24, 0.42) * width
        lens = {"lens_model": "division", "fx_px": focal, "fy_px": focal, "cx_px": width / 2, "cy_px": height / 2,
                "k1": rng.uniform(-0.3, -0.05)}  # fmt: skip
    elif kind < 0.5 and width == 640:
        focal = 862.27 * scale * rng.uniform(0.9, 1.1)
        lens = {"lens_model": "kannala_brandt", "fx_px": focal, "fy_px": focal, "cx_px": 1049.47 * scale,
                "cy_px": 552.76 * scale, "k1": -0.0269, "k2": -0.0038, "k3": 0.0016, "k4": -0.0006}  # fmt: skip
    else:
        focal = rng.uniform(0.32, 0.6) * width
        lens = {"lens_model": "kannala_brandt", "fx_px": focal, "fy_px": focal, "cx_px": width / 2 + rng.normal(0, 10),
                "cy_px": height / 2 + rng.normal(0, 6), "k1": rng.uniform(-0.05, 0.03)}  # fmt: skip
    tilt = rng.normal(0, 3) if rng.random() < 0.75 else rng.normal(0, 12)
    camera |= lens | {"camera_rotation_deg": [90.0 - tilt, rng.uniform(0, 360), 0.0]}

    def place(margin=0.35):
        return [float(rng.uniform(margin, side - margin)) for side in room[:2]]

    furniture = []
    for _ in range(rng.integers(0, 6) if pieces is None else pieces):
        kind = ["table", "chair", "chair", "box", "cylinder", "sphere", "panel"][rng.integers(7)]
        item = {"kind": kind, "rotation_deg": rng.uniform(0, 360), "color": [float(c) for c in _colour(rng)]}
        if kind in ("table", "chair"):
            item["position_m"] = place()
            if kind == "table":
                item["size_m"] = [rng.uniform(0.8, 1.8), rng.uniform(0.6, 0.9), rng.uniform(0.68, 0.78)]
        elif kind == "box":
            size = [rng.uniform(0.2, 1.0), rng.uniform(0.2, 0.6), rng.uniform(0.2, 1.9)]
            item |= {"position_m": [*place(), size[2] / 2], "size_m": size}
        elif kind == "cylinder":
            tall = rng.uniform(0.1, 1.2)
            item |= {"position_m": [*place(), tall / 2], "radius_m": rng.uniform(0.08, 0.35), "height_m": tall}
        elif kind == "sphere":
            radius = rng.uniform(0.08, 0.35)
            item |= {"position_m": [*place(), radius], "radius_m": radius}
        elif rng.random() < 0.3:
            item |= {"position_m": [*place(), min(top - 0.3, 2.1)], "size_m": [*rng.uniform(0.2, 0.8, 2), 0.02]}
        else:
            continue
        furniture.append({key: value for key, value in item.items() if key != "color" or kind != "mesh"})
    if furnished and rng.random() < furnished:
        furniture += furniture_of_a_world(rng, room, eye)
    if rng.random() < panels:
        furniture.append(hanging(rng, eye, top))
    walkers = []
    crowd = rng.choice([0, 1, 2, 3, 4, 5], p=[0.22, 0.16, 0.16, 0.16, 0.15, 0.15]) if people is None else people
    for index in range(int(crowd)):
        walk = [{"t_s": 0.0, "position_m": place(), "heading_deg": rng.uniform(0, 360)}]
        if rng.random() < 0.15:
            walk[0] |= {"pose": "sit", "stay_s": 10.0}
        elif rng.random() < 0.8:
            walk += [{"position_m": place(), "speed_m_s": rng.uniform(0.5, 1.6)} for _ in range(rng.integers(1, 4))]
        height_m = float(np.clip(rng.normal(1.71, 0.11), 1.3, 2.0))
        speech_s = [[0, 5]] if rng.random() < 0.4 else []
        walkers.append({"object_id": index, "waypoints": walk, "height_m": height_m, "speech_s": speech_s})
    return {
        "name": "random", "duration_s": 10.0, "camera_config": camera,
        "room_config": {"room_dimensions_m": room}, "furniture": furniture, "people": walkers,
    }  # fmt: skip


def hanging(rng: np.random.Generator, eye: list[float], top: float) -> dict:
    """Something large that hangs near a camera, below `top` m: of those behind it only an edge is seen."""
    spot = [float(value) for value in np.add(eye[:2], rng.normal(0, 0.5, 2))]
    item = {"kind": "panel", "rotation_deg": rng.uniform(0, 360), "color": [float(c) for c in _colour(rng)]}
    return item | {
        "position_m": [*spot, rng.uniform(min(1.8, top - 0.3), top - 0.2)], "size_m": [*rng.uniform(0.4, 1.8, 2), 0.02],
    }  # fmt: skip


def furniture_of_a_world(rng: np.random.Generator, room: list[float], eye: list[float]) -> list[dict]:
    """The furniture and clutter of an office, a living room and so on, as random worlds have it."""
    kind = str(rng.choice(["office", "meeting", "hall", "workshop", "living"]))
    size = room[0], room[1], room[2]
    pieces = layout.furnish(kind, size, int(rng.integers(0, 7)), [], (eye[0], eye[1], eye[2]), rng).pieces
    for _ in range(rng.integers(0, 3)):  # what is taken for people most often
        place = [*rng.uniform(0.3, np.array(room[:2]) - 0.3), 0.0]
        turn, wide, tall = rng.uniform(0, 360), rng.uniform(0.4, 0.9), rng.uniform(0.5, 1.6)
        pieces.append({"kind": "plant", "position_m": place, "rotation_deg": turn, "size_m": [wide, wide, tall]})
    return pieces


@dataclasses.dataclass
class Shot:
    """A frame of a random scene: picture, depth (m, radial), the empty room's depth, and its people.

    time, s; numbers (n,) of the scene's people, places (n, 2) m, tops (n,) m, visible fractions (n,), boxes (n, 4) px,
    parts (n, 3, 2) px, anchors (n, 2) px;
    people (height, width) uint8, 1 where one is seen.
    """

    picture: np.ndarray
    depth: np.ndarray
    background: np.ndarray
    view: View
    time: float
    numbers: np.ndarray
    places: np.ndarray
    tops: np.ndarray
    visible: np.ndarray
    boxes: np.ndarray
    parts: np.ndarray
    anchors: np.ndarray
    people: np.ndarray


def seen_people(frame: render.Frame, bodies: Bodies, k: int, view: View, stands: np.ndarray) -> list[tuple]:
    """Place, top, visible part, box, parts, anchor and number (`Shot`) of each person in the k-th frame."""
    rows = []
    for index in range(len(stands)):
        v, u = np.nonzero(frame.ids == index + 1)
        if len(v) < 8:
            continue
        own = bodies.person == index
        top = float(np.maximum(bodies.a[k, own, 2] + bodies.ra[own], bodies.b[k, own, 2] + bodies.rb[own]).max())
        middle = (bodies.a[k, own] + bodies.b[k, own]) / 2
        size = bodies.ra[own] * (bodies.ra[own] + np.linalg.norm(bodies.a[k, own] - bodies.b[k, own], axis=1))
        within = size[view.inside(view.project(middle))].sum() / size.sum()
        axis = np.column_stack([np.tile(stands[index], (3, 1)), PART_HEIGHTS * top])
        box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float)
        parts = view.project(axis) + 0.5
        if not np.isfinite(parts).all():
            parts = np.tile((box[:2] + box[2:]) / 2, (3, 1))
        whole = frame.shapes[index][0].sum() * render.Frame.pitch**2
        seen = min(len(v) / max(whole, 1), within)
        rows.append((stands[index], top, seen, box, parts, anchor(v, u, parts[0]), index))
    return rows


def shots(
    rng: np.random.Generator,
    width: int,
    height: int,
    count: int,
    context=None,
    people=None,
    pieces=None,
    look=random_look,
    furnished=0.0,
    panels=PANELS,
):
    """Yield `count` frames at random times of one random scene, whose people `look(rng, height)` dresses."""
    scene = scenario.parse(random_scenario(rng, width, height, people, pieces, furnished, panels))
    actors = [
        dataclasses.replace(person, look=look(rng, person.height), gestures=bool(rng.random() < 0.8))
        for person in scene.people
    ]
    camera = scene.config.camera
    artist = render.Renderer(camera, scene.config.room.dimensions, scene.solids, samples=2, context=context)
    view = View(camera.lens, camera.T_room_camera, (width, height), camera.theta_max, 1)
    background = artist.room_depth.astype(np.float32) * np.float32(artist.depth_step)
    times = np.sort(rng.uniform(0, 10, count))
    bodies = pose(actors, times)
    drawn = artist.prepare(bodies)
    for k, t in enumerate(times):
        stands = np.array([actor.motion.position(np.array([t]))[0] for actor in actors]).reshape(-1, 2)
        apart = np.linalg.norm(stands[:, None] - stands[None], axis=2) + 9 * np.eye(len(actors))
        if (apart < 0.42).any():
            continue  # walks are random: bodies would pass through each other
        frame = artist.draw(drawn, k)
        rows = seen_people(frame, bodies, k, view, stands)
        yield Shot(
            frame.rgb.copy(), frame.depth * np.float32(artist.depth_step), background, view, float(t),
            np.array([row[6] for row in rows], int),
            np.array([row[0] for row in rows]).reshape(-1, 2), np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]), np.array([row[3] for row in rows]).reshape(-1, 4),
            np.array([row[4] for row in rows]).reshape(-1, 3, 2), np.array([row[5] for row in rows]).reshape(-1, 2),
            (frame.ids > 0).astype(np.uint8),
        )  # fmt: skip


class Library:
    """An endless stream of rendered training pictures, the same for the same seed.

    Args:
        seed: of all chance.
        each: frames of one scene.
        plain: leave out the camera's effects and the mirror (for judging).
        people: how many there are in each scene; None draws it.
        pieces: least and largest number of pieces of furniture; None draws a few, and for training many.
        furnished: share of the scenes with the furniture and clutter of random worlds.
        panels: share of the scenes in which something large hangs.
    """

    def __init__(
        self, seed: int, each: int = 12, plain: bool = False, people: int | None = None, pieces=None, furnished=0.0,
        panels: float = PANELS,
    ):  # fmt: skip
        self.rng, self.each, self.plain = np.random.default_rng([seed, 7]), each, plain
        self.people, self.pieces, self.furnished, self.panels = people, pieces, furnished, panels
        self.context = render.open_context()
        self.context.gc_mode = "auto"  # one scene after another: what the last one drew with goes with it
        self._shots = iter(())

    def __call__(self) -> Sample:
        shot = next(self._shots, None)
        while shot is None:
            size = SHAPES[self.rng.integers(len(SHAPES))]
            each, people, span = self.each, self.people, self.pieces
            if not self.plain and people is None:  # to learn what is furniture
                span = (0, 10)
                if self.rng.random() < 0.7:
                    each, people, span = 2, 0, (4, 11)
            pieces = None if span is None else int(self.rng.integers(*span))
            try:
                self._shots = shots(
                    self.rng, *size, each, self.context, people, pieces, furnished=self.furnished, panels=self.panels
                )
                shot = next(self._shots, None)
            except scenario.ScenarioError:
                continue
        height, width = shot.picture.shape[:2]
        picture = shot.picture
        if not self.plain:
            picture = _camera_effects(self.rng, picture.astype(np.float32) / 255)
        top, left = (HEIGHT - height) // 2, (WIDTH - width) // 2
        out = np.full((HEIGHT, WIDTH, 3), PAD, np.uint8)
        place = slice(top, top + height), slice(left, left + width)
        people = np.zeros((HEIGHT, WIDTH), np.uint8)
        out[place], people[place] = picture, shot.people
        shift = np.array([left, top])
        boxes = shot.boxes + np.tile(shift, 2)
        sample = Sample(out, boxes, shot.parts + shift, shot.anchors + shift, shot.visible, people)
        return sample if self.plain else _flipped(self.rng, sample)
