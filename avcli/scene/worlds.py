"""Random worlds: a room of some kind, its surfaces, its camera, its furniture, and the people in it."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from avcli.scene import furniture
from avcli.scene.crowd import Crowd, Ground
from avcli.scene.layout import Layout, furnish
from avcli.scene.looks import random_look
from avcli.scene.rooms import Size, random_doors, random_kind, random_size, random_surfaces
from avcli.scene.settings import LENSES

_SEATED = {"office": 0.65, "meeting": 0.75, "corridor": 0.15, "hall": 0.5, "workshop": 0.0, "living": 0.65}
_CHILDREN = {"office": 0.0, "meeting": 0.0, "corridor": 0.12, "hall": 0.08, "workshop": 0.0, "living": 0.2}
_TALKING = 4  # groups that talk at once, at most


@dataclass(frozen=True)
class Wishes:
    """What a random world has to be; None: drawn.

    Attributes:
        people: how many.
        kind: of room, one of settings.ROOM_KINDS.
        room: (3,) m.
        lens: one of settings.LENSES.
        camera_height: m.
    """

    people: int = 3
    kind: str | None = None
    room: Size | None = None
    lens: str | None = None
    camera_height: float | None = None


def random_world(
    wishes: Wishes, duration: float, generator: np.random.Generator, known: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Draw a world.

    Args:
        wishes: what is asked for.
        duration: s.
        generator: of all chance.
        known: camera_config of the lenses "real" and "thesis".

    Returns:
        A scenario's JSON object.
    """
    # A generator for each part: what is asked of one part leaves the others as they were.
    g_room, g_camera, g_things, g_people, g_places, g_talk = generator.spawn(6)
    kind = random_kind(g_room, wishes.people)
    kind = wishes.kind or kind
    size = random_size(g_room, kind, wishes.people) if wishes.room is None else wishes.room
    if wishes.room is None and wishes.camera_height is not None:
        size = size[0], size[1], max(size[2], round(wishes.camera_height + 0.1, 2))
    doors = random_doors(g_room, size)
    camera = _camera(g_camera, size, known, wishes.lens, wishes.camera_height)
    room = {"room_dimensions_m": [float(v) for v in size], **random_surfaces(g_room, kind, size, doors)}
    eye = camera["camera_position_m"]
    layout = furnish(kind, size, wishes.people, doors, eye, g_things)
    people = [_person(number, kind, g_people) for number in range(wishes.people)]
    solids = furniture.join([furniture.build(furniture.PIECE.read(piece), None) for piece in layout.pieces])
    crowd = Crowd.of(wishes.people, Ground(solids, size, doors, eye, g_places), duration, g_places)
    _settle(crowd, layout, people, kind, solids)
    groups = _talking(crowd, people, g_talk)
    for person, points, turns in zip(
        people, crowd.waypoints, _conversations(groups, len(people), duration, g_talk), strict=True
    ):
        person |= {"waypoints": points, "speech_s": turns}
    for number, group in enumerate(groups):
        for member in group:
            people[member]["group"] = f"group {number + 1}"
    return {
        "name": "random",
        "duration_s": float(duration),
        "sensor": str(g_camera.choice(["webcam", "ip-camera"])),
        "camera_config": camera,
        "room_config": room,
        "furniture": layout.pieces,
        "people": people,
    }


def _person(number: int, kind: str, g: np.random.Generator) -> dict[str, Any]:
    child = bool(g.random() < _CHILDREN[kind])
    height = float(g.uniform(0.95, 1.45)) if child else float(np.clip(g.normal(1.70, 0.10), 1.46, 2.0))
    person: dict[str, Any] = {
        "object_id": number, "look": random_look(g, height), "height_m": round(height, 2),
    }  # fmt: skip
    if kind == "workshop" and g.random() < 0.4:
        person["look"] |= {"hat": "helmet", "hat_colour": [0.9, 0.75, 0.1], "cut": "short"}
    return person


def _settle(crowd: Crowd, layout: Layout, people: list[dict[str, Any]], kind: str, solids: furniture.Solids) -> None:
    """Give everybody a place: a seat, something to do, a circle of people who talk, or a walk."""
    g = crowd.generator
    seats = [layout.seats[k] for k in g.permutation(len(layout.seats))]
    tables: dict[int, list[int]] = {}
    for number in crowd.unplaced():
        if people[number]["height_m"] > 1.3 and g.random() < _SEATED[kind]:
            seat = next((k for k, spot in enumerate(seats) if crowd.take(number, spot)), None)
            if seat is None:
                break
            tables.setdefault(seats.pop(seat).table, []).append(number)
    crowd.groups += [group for table, group in tables.items() if table >= 0 and len(group) > 1]
    stands = [layout.stands[k] for k in g.permutation(len(layout.stands))]
    reach = furniture.blocks(solids, np.array([spot.place for spot in stands]).reshape(-1, 2), 0.1, 1.8)
    inside = [all(0.2 < v < side - 0.2 for v, side in zip(s.place, layout.size, strict=False)) for s in stands]
    stands = [spot for spot, hit, fits in zip(stands, reach, inside, strict=True) if fits and not hit]
    for number in crowd.unplaced():
        if stands and g.random() < (0.6 if kind == "workshop" else 0.3):
            crowd.take(number, stands.pop())
        elif g.random() < 0.02 and crowd.duration > 0 and crowd.circle([number]):
            crowd.waypoints[number][0]["pose"] = "lie"
    left = crowd.unplaced()
    while len(left) > 2 and g.random() < 0.6:
        count = int(g.integers(2, 6))
        if crowd.circle(left[:count]):
            left = left[count:]
        else:
            break
    for number in left:
        if g.random() < 0.04:
            people[number]["wheelchair"] = True
        elif g.random() < 0.3 and people[number]["height_m"] > 1.3:
            people[number]["carries"] = str(g.choice(["box", "laptop", "tray", "phone", "bag"]))
    crowd.walk(left, 0.5)


def _talking(crowd: Crowd, people: list[dict[str, Any]], g: np.random.Generator) -> list[list[int]]:
    """Who talks to whom: those at one table or in one circle, and some walkers; few people are one group."""
    everybody = list(range(len(people)))
    if len(everybody) <= 4:
        return [everybody] if everybody else []
    grouped = {number for group in crowd.groups for number in group}
    walkers = [number for number in everybody if number not in grouped]
    groups = [*crowd.groups, *([walkers[:3]] if len(walkers) > 1 else [])]
    most = min(_TALKING, 1 + math.ceil(len(people) / 8))
    return [groups[k] for k in sorted(g.permutation(len(groups))[:most])]


# --- who speaks when: conversations of groups that run beside each other ----------------------------------------------

_GAP_S = 0.2, 0.35
"""s, mean and spread of the silence between two turns; negative: they overlap (Heldner and Edlund, 2010, figure 2)."""
_NODS = 0.25  # share of turns in which a listener puts in a word
_LAUGHS = 0.06  # share of turns after which all laugh


def _conversations(
    groups: list[list[int]], people: int, duration: float, g: np.random.Generator
) -> list[list[list[float]]]:
    """Turns [begin, end] in s to speak, in order, of each person; somebody in no group is silent.

    One of a group speaks after another, with short pauses and now and then an overlap; a listener puts in a word, and
    sometimes all laugh at once.
    """
    turns: list[list[list[float]]] = [[] for _ in range(people)]
    for group in groups:
        _converse(group, turns, duration, g)
    return turns


def _converse(group: list[int], turns: list[list[list[float]]], duration: float, g: np.random.Generator) -> None:
    clock, last = float(g.uniform(0.0, 0.5)), -1
    while group and clock < duration:
        last = int(g.choice([p for p in group if p != last] or group))
        length = float(np.clip(g.exponential(2.5), 0.8, 8.0))
        begin, end = round(clock, 2), round(min(clock + length, duration), 2)
        _speak(turns[last], begin, end)
        listeners = [p for p in group if p != last]
        if listeners and length > 1.5 and g.random() < _NODS:
            word = round(clock + float(g.uniform(0.5, length - 0.7)), 2)
            _speak(turns[int(g.choice(listeners))], word, round(min(word + float(g.uniform(0.3, 0.6)), duration), 2))
        clock = max(end + float(g.normal(*_GAP_S)), begin + 0.3)
        if len(group) > 1 and g.random() < _LAUGHS:
            for person in group:
                start = round(end + float(g.uniform(0.05, 0.4)), 2)
                stop = round(min(start + float(g.uniform(0.5, 1.2)), duration), 2)
                _speak(turns[person], start, stop)
            clock = end + 1.2


def _speak(turns: list[list[float]], begin: float, end: float) -> None:
    """Add a turn, unless the person speaks already."""
    if end > begin and (not turns or begin >= turns[-1][1]):
        turns.append([begin, end])


# --- cameras: the two lenses of the thesis, and equidistant and equisolid fisheyes of any field -----------------------

_SQUARES = (640, 1024, 1280)  # px
_WIDE = ((1280, 720), (1920, 1080), (1280, 960))
_FIELD_DEG = (150.0, 220.0)
_BELOW_CEILING_M = (0.05, 0.35)
_HEIGHT_M = (2.2, 8.0)
_EQUISOLID = (-1 / 24, 1 / 1920, -1 / 322560, 1 / 92897280)
"""2 sin(theta / 2) as a series in theta: below 1e-7 of its value up to 110 degrees from the axis."""


def _camera(
    g: np.random.Generator, room: Size, known: dict[str, dict[str, Any]], lens: str | None, height: float | None
) -> dict[str, Any]:
    """A camera_config of a camera that looks down from the ceiling of a room (3,) m, as random_world is asked for."""
    x, y, z = room
    drawn = str(g.choice(LENSES, p=[0.2, 0.1, 0.4, 0.3]))
    lens = drawn if lens is None else lens
    below = float(np.clip(z - g.uniform(*_BELOW_CEILING_M), min(_HEIGHT_M[0], z - 0.02), _HEIGHT_M[1]))
    place = [float(side * g.uniform(0.4, 0.6)) for side in (x, y)]
    # The longer side of the picture lies along the longer side of the room, more or less.
    yaw = (0.0 if x >= y else 90.0) + 180.0 * int(g.integers(2)) + float(np.clip(g.normal(0, 6), -20, 20))
    tilt = float(np.clip(g.normal(0, 1.5), -5, 5))
    optics = _known(g, known[lens]) if lens in known else _fisheye(g, lens)
    return {
        "camera_position_m": [*(round(v, 3) for v in place), round(below, 3) if height is None else height],
        "camera_rotation_deg": [round(90.0 - tilt, 2), round(yaw % 360, 2), 0.0],
        "frame_rate_hz": 10.0,
        **optics,
    }


def _known(g: np.random.Generator, camera: dict[str, Any]) -> dict[str, Any]:
    """A lens of the thesis, with a sensor of as many pixels or fewer."""
    scale = float(g.choice([1.0, 2 / 3, 0.5]))
    changed = {key: round(camera[key] * scale, 4) for key in ("fx_px", "fy_px")}
    changed |= {key: round((camera[key] + 0.5) * scale - 0.5, 4) for key in ("cx_px", "cy_px")}
    return {**camera, **changed, **{key: round(camera[key] * scale) for key in ("image_width_px", "image_height_px")}}


def _fisheye(g: np.random.Generator, lens: str) -> dict[str, Any]:
    """A lens whose circle lies in a square or a wide picture, whole, cut on two sides, or beyond the corners."""
    widest = math.radians(g.uniform(*_FIELD_DEG)) / 2
    form = str(g.choice(["square", "whole", "cut", "full"], p=[0.4, 0.15, 0.25, 0.2]))
    if form == "square":
        width = height = int(g.choice(_SQUARES))
    else:
        width, height = (int(v) for v in _WIDE[int(g.integers(len(_WIDE)))])
    span = {"cut": width, "full": math.hypot(width, height)}.get(form, min(width, height))
    radius = 0.5 * span * g.uniform(0.93, 1.0)
    reach = widest if lens == "equidistant" else 2 * math.sin(widest / 2)
    cx, cy = ((side - 1) / 2 + g.normal(0, 0.006) * side for side in (width, height))
    focal = round(radius / reach, 3)
    terms = (0.0, 0.0, 0.0, 0.0) if lens == "equidistant" else _EQUISOLID
    optics = {
        "lens_model": "kannala_brandt", "fx_px": focal, "fy_px": focal, "cx_px": round(cx, 2), "cy_px": round(cy, 2),
        **{f"k{k + 1}": value for k, value in enumerate(terms)},
        "image_width_px": width, "image_height_px": height, "theta_max_valid_deg": round(math.degrees(widest), 3),
    }  # fmt: skip
    if form != "full":
        optics["image_circle_px"] = [round(cx, 2), round(cy, 2), round(radius, 2)]
    return optics
