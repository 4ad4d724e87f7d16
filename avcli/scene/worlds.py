"""Random worlds: a room of some kind, its surfaces, its camera, its furniture, and the people in it."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from avcli.scene import furniture
from avcli.scene.cameras import random_camera
from avcli.scene.crowd import Crowd, Ground
from avcli.scene.layout import Layout, furnish
from avcli.scene.looks import random_look
from avcli.scene.rooms import Size, random_doors, random_kind, random_size, random_surfaces
from avcli.scene.talk import conversations

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
    size = wishes.room or _tall_enough(random_size(g_room, kind, wishes.people), wishes.camera_height)
    doors = random_doors(g_room, size)
    camera = random_camera(g_camera, size, known, wishes.lens, wishes.camera_height)
    room = {"room_dimensions_m": [float(v) for v in size], **random_surfaces(g_room, kind, size, doors)}
    eye = camera["camera_position_m"]
    layout = furnish(kind, size, wishes.people, doors, eye, g_things)
    people = [_person(number, kind, g_people) for number in range(wishes.people)]
    solids = furniture.join([furniture.build(furniture.PIECE.read(piece), None) for piece in layout.pieces])
    crowd = Crowd.of(wishes.people, Ground(solids, size, doors, eye, g_places), duration, g_places)
    _settle(crowd, layout, people, kind, solids)
    groups = _talking(crowd, people, g_talk)
    for person, points, turns in zip(
        people, crowd.waypoints, conversations(groups, len(people), duration, g_talk), strict=True
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


def _tall_enough(size: Size, camera: float | None) -> Size:
    return size if camera is None else (size[0], size[1], max(size[2], round(camera + 0.1, 2)))


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
