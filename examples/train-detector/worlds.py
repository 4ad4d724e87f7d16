"""Draw random worlds with labels into a folder: python worlds.py --out DIR [--count N] [--seed N]

The worlds are those of `avsim-scene random`: six kinds of rooms, materials, clutter, lenses in square and wide
pictures, postures, and the picture of a webcam or an IP camera with its noise and time stamp. Each becomes one file
NAME.npz, which `train.py --worlds DIR` reads; a file that is there already is not drawn again. Run several at once,
with other seeds, where there are several processors. With --makehuman FOLDER the people are those of meshes.py, with
--avatars FOLDER those of avatars.py, dressed anew in each picture, and some more of them stand about; with --panoramas
FOLDER half of their rooms are photographed (backdrops.py). Pictures are stored whole; `cut` takes from them what one
look of the network shows.
"""

import argparse
import functools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from backdrops import Backdrops
from generate import HEIGHT, PAD, WIDTH, Sample
from meshes import Dress, Painter, Wardrobe, figure, paint_people, somebody
from pieces import Piece, furnish, pieces
from renders import hanging, seen_people

from avcli.detection.bands import BREADTH
from avcli.detection.view import View
from avcli.scene import interior, load, render, scenario, sensor
from avcli.scene.people import pose
from avcli.scene.settings import Drawing, Effects, with_sensor
from avcli.scene.worlds import Wishes

LONGEST = 640
"""px, of the longer side of the pictures: the scale at which the network looks."""

SHORTEST = 512
"""px, the least length of a band of a round picture."""

GREYED = 0.35
"""Share of worlds in which what the lens does not light is grey, as for a camera whose circle is known."""

BANDS = 0.75
"""Share of the looks at a square picture that are at a band across its middle; the others are anywhere."""

TABLES = ("meeting", "meeting", "office", "living")
"""Kinds of rooms in which people sit at tables."""


def scaled(raw: dict) -> dict:
    """A scenario with its picture at the network's scale."""
    camera = dict(raw["camera_config"])
    scale = LONGEST / max(camera["image_width_px"], camera["image_height_px"])
    for key in ("image_width_px", "image_height_px"):
        camera[key] = round(camera[key] * scale)
    for key in ("fx_px", "fy_px"):
        camera[key] *= scale
    for key in ("cx_px", "cy_px"):
        camera[key] = (camera[key] + 0.5) * scale - 0.5
    if "image_circle_px" in camera:
        x, y, radius = camera["image_circle_px"]
        camera["image_circle_px"] = [(x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5, radius * scale]
    return raw | {"camera_config": camera}


def rounded(rng: np.random.Generator, raw: dict) -> dict:
    """A scenario under a fisheye whose circle fills a square picture, often aslant."""
    camera = {key: raw["camera_config"][key] for key in ("camera_position_m", "camera_rotation_deg", "frame_rate_hz")}
    if rng.random() < 0.4:
        camera["camera_rotation_deg"] = [90 - float(rng.normal(0, 7)), *camera["camera_rotation_deg"][1:]]
    widest, radius = np.deg2rad(rng.uniform(76, 95)), 0.5 * LONGEST * rng.uniform(0.93, 1.0)
    centre = [float(value) for value in (LONGEST - 1) / 2 + rng.normal(0, 0.006 * LONGEST, 2)]
    camera |= {
        "lens_model": "kannala_brandt", "fx_px": radius / widest, "fy_px": radius / widest, "cx_px": centre[0],
        "cy_px": centre[1], "k1": float(rng.uniform(-0.04, 0.0)), "k2": 0.0, "k3": 0.0, "k4": 0.0,
        "image_width_px": LONGEST, "image_height_px": LONGEST, "image_circle_px": [*centre, radius],
        "theta_max_valid_deg": float(np.rad2deg(widest)),
    }  # fmt: skip
    return raw | {"camera_config": camera}


def world(
    seed: int,
    people: int,
    count: int,
    context,
    *,
    seated: float = 0.0,
    panels: float = 0.0,
    circles: float = 0.0,
    chairs: float = 0.0,
    empty: bool = False,
    dress: Sequence[Dress] = (),
    furniture: list[Piece] | None = None,
    backdrops: Backdrops | None = None,
) -> Iterator[Sample]:
    """Yield `count` pictures of a random world, whole.

    An `empty` one is furnished for its people, who are not there. With `dress` the people are meshes, and with
    backdrops half of their rooms photographed. A share of `seated` are rooms with tables at which people sit, in a
    share of `panels` something large hangs near the camera, a share of `circles` more than else are round pictures, a
    share of `chairs` of the furniture are chairs.
    """
    rng = np.random.default_rng([seed, 17])
    kind = str(rng.choice(TABLES)) if rng.random() < seated else None
    raw = scaled(load.named("random", seed, Wishes(people=people, kind=kind), 10.0))
    if rng.random() < circles:
        raw = rounded(rng, raw)
    eye = raw["camera_config"]["camera_position_m"]
    if rng.random() < panels:
        raw["furniture"].append(hanging(rng, eye, eye[2]))
    if empty:
        raw["people"] = []
    scene = scenario.parse(raw)
    camera = scene.config.camera
    _, effects = with_sensor(scene.sensor, Drawing(samples=2), Effects())
    effects = fainter(effects, rng)
    size = camera.width_px, camera.height_px
    view = View(camera.lens, camera.T_room_camera, size, camera.theta_max, 1, circle=camera.circle)
    times = np.sort(rng.uniform(0, 10, count))
    photographed = dress and backdrops and rng.random() < 0.5

    def drawn_room() -> tuple[np.ndarray, np.ndarray]:
        frame = artist.draw(artist.prepare(pose([], times[:1])), 0)
        return frame.rgb.astype(np.float32) / 255, frame.depth * np.float32(artist.depth_step)

    if not photographed:
        dressed = interior.interior(scene.config.room, scene.solids)
        artist = render.Renderer(camera, scene.config.room.dimensions, scene.solids, None, 2, context, dressed)
    if dress:
        rooms = (_photograph(rng, backdrops, view) for _ in times) if photographed else [drawn_room()]
        painter, known = Painter(context), furniture or []
        yield from _with_meshes(rng, scene, rooms, view, effects, times, painter, dress, known, chairs)
        return
    bodies, greyed = pose(scene.people, times), rng.random() < GREYED
    drawn = artist.prepare(bodies)
    for k, t in enumerate(times.tolist()):
        frame = artist.draw(drawn, k)
        stands = np.array([one.motion.position(np.array([t]))[0] for one in scene.people]).reshape(-1, 2)
        rows = seen_people(frame, bodies, k, view, stands)
        picture = sensor.expose(frame.rgb, effects, (camera.lens.cx, camera.lens.cy), rng, t)
        picture = view.lit(picture, PAD) if greyed else picture
        yield Sample(
            picture, np.array([row[3] for row in rows]).reshape(-1, 4),
            np.array([row[4] for row in rows]).reshape(-1, 3, 2), np.array([row[5] for row in rows]).reshape(-1, 2),
            np.array([row[2] for row in rows]), (frame.ids > 0).astype(np.uint8),
        )  # fmt: skip


def _photograph(rng: np.random.Generator, backdrops: Backdrops, view: View) -> tuple[np.ndarray, np.ndarray]:
    """A photographed room (height, width, 3) in 0 to 1 as a camera sees it, and its depth (height, width) m."""
    walls, height = rng.uniform(1.8, 6.0, 4), view.origin[2]
    picture = backdrops.furnished(rng, view.rays[::2, ::2], height, walls, view.size)
    planes = ((0, walls[0]), (0, -walls[1]), (1, walls[2]), (1, -walls[3]), (2, -height))
    with np.errstate(divide="ignore"):
        reach = [place / view.rays[..., axis] for axis, place in planes]
    reach = [np.where(one > 0, one, np.inf) for one in reach]
    return picture, np.minimum.reduce(reach).astype(np.float32)


def _with_meshes(
    rng, scene, rooms: Iterable, view: View, effects: Effects, times, painter, dress, furniture, chairs
) -> Iterator[Sample]:
    """Empty rooms, the last for all that follow, with other people in each picture."""
    greyed = rng.random() < GREYED
    lens, source = scene.config.camera.lens, iter(rooms)
    for t in times.tolist():
        if (new := next(source, None)) is not None:
            bare = new
        if new is not None or not scene.people:  # nobody's room is furnished anew for each picture
            room, depth, sat = *bare, np.zeros((0, 3))
            if furniture:
                places = free_floor(rng, scene, view, depth, int(rng.integers(2, 14)))
                room, depth, sat = furnish(rng, painter, furniture, *bare, view, places, chairs)
        people = [one for one in scene.people if rng.random() < 0.8]
        if scene.people:
            people += [somebody(rng, place) for place in free_floor(rng, scene, view, depth, int(rng.integers(0, 4)))]
            people += [somebody(rng, place[:2], place[2]) for place in sat if rng.random() < 0.35]
        painted, owner, seen = paint_people(rng, painter, dress, room, depth, view, people, t)
        picture = (np.clip(painted, 0, 1) * 255).astype(np.uint8)
        picture = sensor.expose(picture, effects, (lens.cx, lens.cy), rng, t)
        picture = view.lit(picture, PAD) if greyed else picture
        yield Sample(picture, seen.boxes, seen.parts, seen.anchors, seen.visible, (owner > 0).astype(np.uint8))


def free_floor(rng, scene, view: View, depth: np.ndarray, count: int) -> np.ndarray:
    """At most `count` places (n, 2) m where the floor is seen and free, half of them near the camera."""
    size = scene.config.room.dimensions[:2]
    near = view.origin[:2] + rng.normal(0, 0.8, (4 * count, 2))
    places = np.where(rng.random((4 * count, 1)) < 0.5, near, rng.uniform(0, 1, (4 * count, 2)) * size)
    angle = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    ring = np.concatenate([[[0.0, 0.0]], 0.25 * np.column_stack([np.cos(angle), np.sin(angle)])])
    points = np.concatenate([places[:, None] + ring, np.zeros((len(places), 7, 1))], 2)
    pixels = view.project(points.reshape(-1, 3))
    inside = view.inside(pixels)
    column, row = np.rint(np.where(inside[:, None], pixels, 0)).astype(int).T
    away = np.linalg.norm(points.reshape(-1, 3) - view.origin, axis=1)
    free = inside & (np.abs(depth[row, column] - away) < 0.08)
    return places[free.reshape(-1, 7).all(1)][:count]


def fainter(effects: Effects, rng: np.random.Generator) -> Effects:
    """A sensor's effects in another light, and in part: they are those of a picture three times as large."""
    import dataclasses

    return dataclasses.replace(
        effects,
        exposure_ev=effects.exposure_ev + float(rng.normal(0, 0.5)),
        blur_px=effects.blur_px * float(rng.uniform(0.3, 1.0)),
        sharpening=effects.sharpening * float(rng.uniform(0, 1)),
        full_well_e=effects.full_well_e * float(2 ** rng.uniform(-2, 2)),
        jpeg_quality=int(rng.integers(50, 96)),
    )


def cut(rng: np.random.Generator, whole: Sample) -> Sample:
    """What the network is shown of a picture.

    A square one is turned by a right angle and made as long as a band may be, then HEIGHT rows of it are taken, mostly
    those of the band across its middle.
    """
    picture, people, boxes, parts, anchors = whole.picture, whole.people, whole.boxes, whole.parts, whole.anchors
    side, banded = picture.shape[1], False
    if picture.shape[0] == side:
        for _ in range(int(rng.integers(4))):
            picture, people = np.rot90(picture), np.rot90(people)  # (x, y) goes to (y, width - x)
            boxes = np.column_stack([boxes[:, 1], side - boxes[:, 2], boxes[:, 3], side - boxes[:, 0]])
            parts, anchors = (np.stack([p[..., 1], side - p[..., 0]], axis=-1) for p in (parts, anchors))
        length = int(rng.integers(SHORTEST, LONGEST + 1))
        scale, banded = length / side, rng.random() < BANDS
        picture = cv2.resize(picture, (length, length), interpolation=cv2.INTER_LINEAR)
        people = cv2.resize(people, (length, length), interpolation=cv2.INTER_NEAREST)
        boxes, parts, anchors = boxes * scale, parts * scale, anchors * scale
    if banded:
        rows = round(BREADTH * length)
        first = (length - rows) // 2
        picture, people = picture[first : first + rows], people[first : first + rows]
        boxes, parts, anchors = boxes - [0, first, 0, first], parts - [0, first], anchors - [0, first]
    spare = HEIGHT - picture.shape[0]
    shift = np.array([(WIDTH - picture.shape[1]) // 2, int(rng.integers(min(spare, 0), max(spare, 0) + 1))])
    out, mask = np.full((HEIGHT, WIDTH, 3), PAD, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    top, left = max(shift[1], 0), shift[0]
    low = max(-shift[1], 0)
    shown = picture[low : low + HEIGHT]
    place = slice(top, top + len(shown)), slice(left, left + picture.shape[1])
    out[place], mask[place] = shown, people[low : low + HEIGHT]
    boxes, parts, anchors = boxes + np.tile(shift, 2), parts + shift, anchors + shift
    limits = [left, top, left + picture.shape[1], top + len(shown)]
    clipped = np.clip(boxes, np.tile(limits[:2], 2), np.tile(limits[2:], 2))
    share = (clipped[:, 2:] - clipped[:, :2]).prod(axis=1) / np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1)
    kept = share > 0.05
    inside = np.clip(anchors, clipped[:, :2] + 0.5, clipped[:, 2:] - 0.5)
    return Sample(out, clipped[kept], parts[kept], inside[kept], (whole.visible * share)[kept], mask)


def write(samples: list[Sample], path: Path) -> None:
    """Write pictures as PNG and their labels into one file, which is whole or not there."""
    content = {"count": np.array(len(samples))}
    for k, one in enumerate(samples):
        coded = cv2.imencode(".png", one.picture[..., ::-1])[1]
        content |= {f"picture{k}": coded, f"boxes{k}": one.boxes, f"parts{k}": one.parts, f"anchors{k}": one.anchors}
        content |= {f"visible{k}": one.visible, f"people{k}": np.packbits(one.people)}
    new = path.with_suffix(".new.npz")
    np.savez(new, **content)
    os.replace(new, path)


def _sample(data, k: int) -> Sample:
    picture = cv2.imdecode(data[f"picture{k}"], cv2.IMREAD_COLOR)[..., ::-1]
    people = np.unpackbits(data[f"people{k}"])[: picture.shape[0] * picture.shape[1]]
    return Sample(
        picture, data[f"boxes{k}"], data[f"parts{k}"], data[f"anchors{k}"], data[f"visible{k}"],
        people.reshape(picture.shape[:2]),
    )  # fmt: skip


def read(path: Path) -> Iterator[Sample]:
    """Read the pictures that `write` wrote."""
    with np.load(path) as data:
        for k in range(int(data["count"])):
            yield _sample(data, k)


def read_one(rng: np.random.Generator, path: Path) -> Sample:
    """Read one of the pictures that `write` wrote."""
    with np.load(path) as data:
        return _sample(data, int(rng.integers(int(data["count"]))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=2000, help="worlds")
    parser.add_argument("--seed", type=int, default=1_000_000, help="of the first world")
    parser.add_argument("--each", type=int, default=6, help="pictures of a world; a third of them of an empty one")
    parser.add_argument("--empty", type=float, default=0.4, help="share of worlds without people")
    parser.add_argument("--seated", type=float, default=0.0, help="share of worlds made rooms with people at tables")
    parser.add_argument("--panels", type=float, default=0.0, help="share of worlds in which something large hangs")
    parser.add_argument("--round", type=float, default=0.0, help="share of worlds that are made round pictures")
    parser.add_argument("--makehuman", type=Path, help="folder of MakeHuman's files (meshes.py)")
    parser.add_argument("--avatars", type=Path, help="folder of avatars (avatars.py), half of all beside --makehuman")
    parser.add_argument("--pieces", type=Path, help="with either, folder of furniture as meshes (pieces.py)")
    parser.add_argument("--chairs", type=float, default=0.0, help="share of the furniture as meshes that are chairs")
    parser.add_argument("--panoramas", type=Path, help="with either, photographs all round (backdrops.py)")
    options = parser.parse_args()
    if options.pieces and not (options.makehuman or options.avatars):
        parser.error("--pieces wants --makehuman or --avatars")
    options.out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    context = render.open_context()
    context.gc_mode = "auto"
    dress: list[Dress] = []
    if options.makehuman:
        dress.append(functools.partial(figure, Wardrobe(options.makehuman)))
    if options.avatars:
        from avatars import Avatars  # which wants another package

        dress.append(Avatars(options.avatars))
    furniture = pieces(options.pieces) if options.pieces else None
    backdrops = Backdrops(options.panoramas) if options.panoramas else None
    for seed in range(options.seed, options.seed + options.count):
        path = options.out / f"{seed}.npz"
        if path.exists():
            continue
        rng = np.random.default_rng([seed, 23])
        empty, people = bool(rng.random() < options.empty), int(rng.integers(1, 9))
        try:
            drawn = world(
                seed, people, max(1, options.each // 3) if empty else options.each, context, seated=options.seated,
                panels=options.panels, circles=options.round, chairs=options.chairs, empty=empty, dress=dress,
                furniture=furniture, backdrops=backdrops,
            )  # fmt: skip
            samples = list(drawn)
        except scenario.ScenarioError:
            continue
        write(samples, path)


if __name__ == "__main__":
    main()
