"""Scenarios: who walks where and says what, in which room, seen by which camera. One JSON format, checked in full.

A scenario has the config.json sections `camera_config`, `microphone_config` and `room_config` (each may be left out:
the thesis's laboratory), and `furniture` and `people`. man/avcli-formats.5 lists every key.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avcli.formats import experiment
from avcli.scene import furniture
from avcli.scene.motion import Motion
from avcli.scene.people import LOOKS, Person

_MICROPHONES = (
    (0.115, 4.545, 2.493), (2.401, 4.498, 2.385), (4.545, 4.545, 2.484), (4.498, 2.342, 2.380),
    (4.545, 0.115, 2.489), (2.395, 0.162, 2.378), (0.115, 0.115, 2.489), (2.386, 2.253, 2.489),
)  # fmt: skip

LABORATORY = {
    "camera_config": {
        "camera_position_m": [2.33, 2.33, 2.5],
        "camera_rotation_deg": [90.0, 0.0, 0.0],
        "lens_model": "kannala_brandt",
        "fx_px": 862.27,
        "fy_px": 862.70,
        "cx_px": 1049.47,
        "cy_px": 552.76,
        "k1": -0.0269,
        "k2": -0.0038,
        "k3": 0.0016,
        "k4": -0.0006,
        "image_width_px": 1920,
        "image_height_px": 1080,
        "frame_rate_hz": 10.0,
    },
    "microphone_config": {
        "audio_sample_rate_hz": 44100,
        "audio_bit_depth": 32,
        "mic_positions_m": [{"object_id": i + 1, "position": list(p)} for i, p in enumerate(_MICROPHONES)],
        "mic_directivity": "omni",
    },
    "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0], "reverberation_time_s": 0.35},
}
"""The thesis's laboratory and its real camera: what a scenario that leaves a section out gets."""

CAMERAS = {
    "real": {
        key: value
        for key, value in LABORATORY["camera_config"].items()
        if key not in ("camera_position_m", "camera_rotation_deg", "frame_rate_hz")
    },
    "thesis": {
        "lens_model": "division",
        "fx_px": 596.43,
        "fy_px": 596.43,
        "cx_px": 960.0,
        "cy_px": 540.0,
        "k1": -0.2,
        "k2": 0.0,
        "k3": 0.0,
        "k4": 0.0,
        "image_width_px": 1920,
        "image_height_px": 1080,
    },
}
"""The thesis's two cameras: its real one as it was calibrated, and the virtual one of its Listings .1 and .3."""

_KEYS = ("name", "duration_s", "camera_config", "microphone_config", "room_config", "furniture", "people")
_PERSON_KEYS = ("object_id", "look", "height_m", "waypoints", "speech_s", "gestures")
_WAYPOINT_KEYS = ("position_m", "t_s", "speed_m_s", "stay_s", "pose", "heading_deg")
_FASTEST_M_S = 12.0  # faster than anyone ran: taken, with a warning


class ScenarioError(ValueError):
    """What is wrong with a scenario, and where in it."""


@dataclass(frozen=True)
class Scenario:
    """A scene to simulate.

    Attributes:
        raw: the JSON object with every default filled in; parsing it gives the same scenario.
        name: of the scenario.
        duration: s; the last frame is the last one at or before it.
        config: the experiment's Config (camera, microphones, room).
        solids: furniture.Solids, all that does not move.
        people: tuple of Person.
        warnings: sentences on what is odd but can be simulated.
    """

    raw: Mapping
    name: str
    duration: float
    config: experiment.Config
    solids: furniture.Solids
    people: tuple
    warnings: tuple

    @property
    def times(self):
        """Times of the frames, (n,) s."""
        rate = self.config.camera.frame_rate_hz
        return np.arange(math.floor(self.duration * rate + 1e-6) + 1) / rate


def parse(raw, name="scenario", load_mesh=None):
    """Check a scenario's JSON object and build it.

    Args:
        raw: the decoded JSON.
        name: of its file, for messages.
        load_mesh: function of a mesh's path that returns its triangles (n, 3, 3) in m.

    Raises:
        ScenarioError: something is wrong; the message says where and what.
    """
    top = _Reader(raw, name, "")
    top.object(_KEYS)
    sections = {}
    for key, default in LABORATORY.items():
        given = top.get(key, {})
        if not isinstance(given, Mapping):
            top.refuse(key, f"expected an object, found {_shown(given)}")
        # A lens is one thing: who names a part of it does not want the rest of another lens.
        own_lens = key == "camera_config" and {"lens_model", "fx_px", "fy_px", "k1"} & given.keys()
        kept = {k: v for k, v in default.items() if not (own_lens and k in ("lens_model", *_LENS_KEYS))}
        sections[key] = {**kept, **given}
    config = experiment.Config({"session_id": top.text("name", name), **sections}, name)
    try:
        camera, room = config.camera, config.room
        _ = config.microphones
    except experiment.ConfigError as error:
        raise ScenarioError(str(error)) from None
    warnings = []
    dimensions = room.dimensions
    position = camera.T_room_camera[:3, 3]
    if ((position <= 0) | (position >= dimensions)).any():
        raise ScenarioError(
            f"{name}: camera_config.camera_position_m: "
            f"{position.tolist()} is outside the room of {dimensions.tolist()} m"
        )
    if camera.width_px * camera.height_px > 1 << 26:
        raise ScenarioError(f"{name}: camera_config: an image of {camera.width_px} x {camera.height_px} is too large")
    duration = top.number("duration_s", 4.0, least=0.0)
    if duration * camera.frame_rate_hz > 1e7:
        raise ScenarioError(f"{name}: duration_s: {duration:g} s are more than 10 million frames")
    solids = [
        furniture.build(_Reader(item, name, f"furniture[{i}]"), load_mesh)
        for i, item in enumerate(top.list("furniture"))
    ]
    people = []
    for index, item in enumerate(top.list("people")):
        person = _person(_Reader(item, name, f"people[{index}]"), index, duration, dimensions, warnings)
        if any(other.object_id == person.object_id for other in people):
            raise ScenarioError(f"{name}: people[{index}].object_id: {person.object_id} is taken")
        people.append(person)
    if len(people) > 250:
        raise ScenarioError(f"{name}: people: {len(people)} are more than the 250 that a mask can tell apart")
    solids = furniture.join(solids)
    _warn_of_collisions(name, people, solids, duration, warnings)
    filled = {"name": config.raw["session_id"], "duration_s": duration, **sections}
    filled |= {"furniture": top.list("furniture"), "people": top.list("people")}
    return Scenario(filled, filled["name"], duration, config, solids, tuple(people), tuple(warnings))


_LENS_KEYS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "k4")


def with_camera(raw, camera_config):
    """Put another camera's lens, image size, and place where it states them, into a scenario's JSON object."""
    given = camera_config.get("camera_config", camera_config)
    if not isinstance(given, Mapping):
        raise ScenarioError("a camera config is a JSON object")
    old = {**LABORATORY["camera_config"], **raw.get("camera_config", {})}
    kept = {key: old[key] for key in ("camera_position_m", "camera_rotation_deg", "frame_rate_hz") if key in old}
    return {**raw, "camera_config": {**kept, **given}}


def at_height(raw, height):
    """Put a scenario's camera at another height, m."""
    section = {**LABORATORY["camera_config"], **raw.get("camera_config", {})}
    position = section["camera_position_m"]
    if isinstance(position, list) and len(position) == 3:
        position = [*position[:2], height]
    return {**raw, "camera_config": {**raw.get("camera_config", {}), "camera_position_m": position}}


def _person(reader, index, duration, dimensions, warnings):
    reader.object(_PERSON_KEYS)
    identity = reader.get("object_id", index)
    if not isinstance(identity, int) or isinstance(identity, bool):
        reader.refuse("object_id", f"expected a whole number, found {_shown(identity)}")
    names = list(LOOKS)
    look = LOOKS[reader.choice("look", names, names[index % len(names)])]
    height = reader.number("height_m", look.height, least=0.5, most=2.5)
    motion = _motion(reader, height, dimensions, warnings)
    turns = reader.get("speech_s", [])
    if turns is True:
        turns = [[0.0, max(duration, 1e-3)]]
    if not isinstance(turns, list):
        reader.refuse("speech_s", f"expected a list of [start, end] or true, found {_shown(turns)}")
    last = -math.inf
    for i, turn in enumerate(turns):
        if not isinstance(turn, list) or len(turn) != 2 or not all(map(_is_number, turn)) or not turn[0] < turn[1]:
            reader.refuse(f"speech_s[{i}]", f"expected [start, end] in seconds, start before end, found {_shown(turn)}")
        if turn[0] < last:
            reader.refuse(f"speech_s[{i}]", "begins before the turn before it ends")
        last = turn[1]
    gestures = reader.get("gestures", True)
    if not isinstance(gestures, bool):
        reader.refuse("gestures", f"expected true or false, found {_shown(gestures)}")
    return Person(identity, motion, look, height, np.array(turns, float).reshape(-1, 2), gestures)


def _motion(reader, height, dimensions, warnings):
    points = reader.list("waypoints")
    if not points:
        reader.refuse("waypoints", "expected at least one")
    times, places, headings, seated = [], [], [], []
    for index, item in enumerate(points):
        point = _Reader(item, reader.name, f"{reader.where}.waypoints[{index}]")
        point.object(_WAYPOINT_KEYS)
        place = point.numbers("position_m", 2)
        if ((place <= 0) | (place >= dimensions[:2])).any():
            point.refuse("position_m", f"{place.tolist()} is outside the room of {dimensions[:2].tolist()} m")
        time = _arrival(point, times, places, place)
        if times:
            speed = np.linalg.norm(place - places[-1]) / (time - times[-1])
            if speed > _FASTEST_M_S:
                warnings.append(f"{point.name}: {point.where}: a walk at {speed:.3g} m/s")
        heading = math.radians(point.number("heading_deg", math.nan))
        sits = point.choice("pose", ("stand", "sit"), "stand") == "sit"
        stay = point.number("stay_s", 0.0, least=0.0)
        times.append(time)
        places.append(place)
        headings.append(heading)
        seated.append(sits)
        if stay > 0:
            times.append(time + stay)
            places.append(place)
            headings.append(heading)
            seated.append(sits and index == len(points) - 1)
    return Motion(np.array(times), np.array(places), np.array(headings), np.array(seated), height)


def _arrival(point, times, places, place):
    """The time at which the person reaches a waypoint: stated, or by the speed of the walk there."""
    if "t_s" in point.raw and "speed_m_s" in point.raw:
        point.refuse("speed_m_s", "t_s and speed_m_s exclude each other")
    if "t_s" in point.raw or not times:
        time = point.number("t_s", 0.0)
        if times and time <= times[-1]:
            point.refuse("t_s", f"{time:g} s is not after the waypoint before it, {times[-1]:g} s")
        return time
    speed = point.number("speed_m_s", 1.0, above=0.0)
    distance = float(np.linalg.norm(place - places[-1]))
    if distance == 0:
        point.refuse("position_m", "is where the person already is; state t_s, or stay_s at the waypoint before")
    return times[-1] + distance / speed


def _warn_of_collisions(name, people, solids, duration, warnings):
    """Say who walks through furniture, who through a wall, and who through whom."""
    t = np.arange(0.0, duration + 1e-9, 0.1)[:6000]
    tracks = [person.motion.position(t) for person in people]
    for index, (person, track) in enumerate(zip(people, tracks, strict=True)):
        seats = person.motion.places[person.motion.seated]
        standing = (np.linalg.norm(track[:, None] - seats, axis=-1) > 0.7).all(1)  # one's own chair is no obstacle
        inside = furniture.blocks(solids, track, 0.05, person.height) & standing
        if inside.any():
            warnings.append(f"{name}: people[{index}] walks through furniture at {t[inside.argmax()]:.1f} s")
        for other in range(index):
            near = np.linalg.norm(track - tracks[other], axis=1) < 0.3
            if near.any():
                warnings.append(f"{name}: people[{index}] and people[{other}] meet at {t[near.argmax()]:.1f} s")


class _Reader:
    """One object of a scenario, with checks that say where and what."""

    def __init__(self, raw, name, where):
        self.raw, self.name, self.where = raw, name, where

    def refuse(self, key, reason):
        place = ".".join(part for part in (self.where, key) if part)
        raise ScenarioError(f"{self.name}: {place}: {reason}" if place else f"{self.name}: {reason}")

    def object(self, keys):
        if not isinstance(self.raw, Mapping):
            self.refuse("", f"expected an object, found {_shown(self.raw)}")
        for key in self.raw:
            if key not in keys:
                self.refuse(key, f"is no key here; there are {', '.join(keys)}")

    def get(self, key, default):
        return self.raw.get(key, default)

    def text(self, key, default):
        value = self.get(key, default)
        if not isinstance(value, str):
            self.refuse(key, f"expected text, found {_shown(value)}")
        return value

    def list(self, key):
        value = self.get(key, [])
        if not isinstance(value, list):
            self.refuse(key, f"expected a list, found {_shown(value)}")
        return value

    def choice(self, key, choices, default):
        value = self.get(key, default)
        if value not in choices:
            self.refuse(key, f"expected one of {', '.join(choices)}, found {_shown(value)}")
        return value

    def number(self, key, default, least=-math.inf, above=-math.inf, most=math.inf):
        if key not in self.raw:
            return default
        value = self.raw[key]
        if not _is_number(value) or value < least or value <= above or value > most:
            low = f" above {above:g}" if above > -math.inf else f" of at least {least:g}" if least > -math.inf else ""
            high = f" and at most {most:g}" if most < math.inf else ""
            self.refuse(key, f"expected a number{low}{high}, found {_shown(value)}")
        return float(value)

    def numbers(self, key, count, default=None):
        value = self.raw.get(key, default)
        if value is None and key not in self.raw:
            self.refuse(key, "is missing")
        if not isinstance(value, list | tuple) or len(value) != count or not all(map(_is_number, value)):
            self.refuse(key, f"expected {count} numbers, found {_shown(value)}")
        return np.array(value, float)


def _is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value):
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
