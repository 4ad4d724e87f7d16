"""What the network and the depth say of random worlds, whose empty rooms are as recorded, or had less in them then.

World k is `avsim-scene random --seed k`, with 1 to 5 people by turns. Each picture is looked at twice: with the depth
of the empty room, and with one that lacks three of ten pieces of furniture, which then stand there like people.
"""

import moderngl
import numpy as np
from judge import overlaps
from renders import seen_people

from avcli.detection.depth import DepthDetector
from avcli.detection.network import PAD, Boxes, Network, own_model
from avcli.detection.view import View
from avcli.scene import interior, load, render, scenario, sensor
from avcli.scene.people import pose
from avcli.scene.settings import Drawing, Effects, with_sensor
from avcli.scene.worlds import Wishes

CAME = 0.3
"""Share of the furniture that came since the empty room was recorded."""

LEAST = 0.02
"""Least score of the network's boxes."""

SURE = 0.3
"""Score from which the network finds people by itself."""

NEAR_M = 0.5
"""m; a body farther from everybody is no person's."""

Said = tuple[float, bool, bool]
"""Of a body that is none of the network's people: the score of a faint box that holds it, whether another body stands
of which the network says nothing, and whether it is a person."""


BoxSample = tuple[np.ndarray, np.ndarray, View, np.ndarray, float]
"""Of a body that the network found: box (4,) px, parts (3, 2) px, camera, the true position (2,) m, and the score."""

FOUND, SAME = 0.5, 0.3
"""Least score of somebody who was found, and least intersection over union of the box and the true one."""


def of_people(found: Boxes, boxes: np.ndarray, places: np.ndarray, view: View) -> list[BoxSample]:
    """The samples of the people whom a network found, the surest first, of those with boxes (n, 4) px at (n, 2) m."""
    samples: list[BoxSample] = []
    taken = np.zeros(len(boxes), bool)
    if found.parts is None or not len(boxes):
        return samples
    for index in np.flatnonzero(found.scores >= FOUND):
        overlap = np.where(taken, 0.0, overlaps(found.boxes[index], boxes))
        best = int(overlap.argmax())
        if overlap[best] >= SAME:
            taken[best] = True
            samples.append((found.boxes[index], found.parts[index], view, places[best], float(found.scores[index])))
    return samples


def looked_at(seed: int, frames: int, context: moderngl.Context) -> tuple[list[Said], list[BoxSample]]:
    """What is said of a world's bodies in pictures at random times, before either empty room; and whom it found."""
    rng = np.random.default_rng([seed, 11])
    raw = load.named("random", seed, Wishes(people=seed % 5 + 1), 10.0)
    scene = scenario.parse(raw)
    camera, room = scene.config.camera, scene.config.room.dimensions
    size = camera.width_px, camera.height_px
    _, effects = with_sensor(scene.sensor, Drawing(samples=2), Effects())
    dressed = interior.interior(scene.config.room, scene.solids)
    artist = render.Renderer(camera, room, scene.solids, None, 2, context, dressed)
    view = View(
        camera.lens, camera.T_room_camera, size, camera.theta_max, theta_trusted=camera.theta_trusted,
        circle=camera.circle,
    )  # fmt: skip
    came = np.random.default_rng([seed, 12]).random(len(raw["furniture"])) < CAME
    kept = [piece for piece, new in zip(raw["furniture"], came, strict=True) if not new]
    before = scenario.parse(raw | {"furniture": kept, "people": []}).solids
    earlier = render.Renderer(camera, room, before, artist.depth_step, 1, context, colour=False)
    empty = [view.radial_depth(one.room_depth, one.depth_step) for one in (artist, earlier)]
    network = Network(own_model(), confidence=LEAST, picture=size)
    times = np.sort(rng.uniform(0, 10, frames))
    bodies = pose(scene.people, times)
    drawn = artist.prepare(bodies)
    found: list[Said] = []
    placed: list[BoxSample] = []
    full = View(camera.lens, camera.T_room_camera, size, camera.theta_max, 1)
    for k, t in enumerate(times.tolist()):
        frame = artist.draw(drawn, k)
        assert frame.rgb is not None  # it is drawn in colour
        places = np.array([one.motion.position(np.array([t]))[0] for one in scene.people]).reshape(-1, 2)
        picture = sensor.expose(frame.rgb, effects, (camera.lens.cx, camera.lens.cy), rng, t)
        boxes = network.detect(view.lit(picture, PAD))
        rows = seen_people(frame, bodies, k, full, places)
        if rows:
            placed += of_people(boxes, np.array([row[3] for row in rows]), np.array([row[0] for row in rows]), view)
        depth = view.radial_depth(frame.depth, artist.depth_step)
        for background in empty:  # each picture is a film of its own, so that nobody has come
            detector = DepthDetector(view, background, room=np.asarray(room[:2], float))
            found += _of(boxes, depth, detector, places)
    return found, placed


def _of(boxes: Boxes, depth: np.ndarray, detector: DepthDetector, places: np.ndarray) -> list[Said]:
    people = detector.place(boxes.take(boxes.scores >= SURE), depth)
    _, stayed, scores, others = detector.strangers(depth, boxes, people)
    right = [bool((np.linalg.norm(places - one.position[:2], axis=1) < NEAR_M).any()) for one in stayed]
    return list(zip(scores.tolist(), others.tolist(), right, strict=True))
