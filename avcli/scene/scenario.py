"""Scenarios: who walks where and speaks when, in which room, seen by which camera. One JSON format, checked in full.

A scenario has the config.json sections `camera_config`, `microphone_config` and `room_config` (each may be left out:
the thesis's laboratory), and `furniture` and `people`. `SCENARIO` describes every key: a new key is added there, and
`parse` finds its value. The schema and man/avcli-formats.5 are written from it (`make formats`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avcli.formats import bounds, experiment
from avcli.formats.descriptions import Format
from avcli.formats.schema import (
    IDENTITY,
    Boolean,
    Choice,
    Either,
    Invalid,
    Key,
    ListOf,
    Number,
    Numbers,
    Object,
    Text,
    shown,
)
from avcli.scene import doorways, fittings, furniture, viewpoint
from avcli.scene.looks import LOOK, look_of
from avcli.scene.motion import Motion
from avcli.scene.people import LOOKS, Person
from avcli.scene.postures import LOADS, POSTURES, SEATED
from avcli.scene.settings import SENSORS

_MICROPHONES = (
    (0.115, 4.545, 2.493), (2.401, 4.498, 2.385), (4.545, 4.545, 2.484), (4.498, 2.342, 2.380),
    (4.545, 0.115, 2.489), (2.395, 0.162, 2.378), (0.115, 0.115, 2.489), (2.386, 2.253, 2.489),
)  # fmt: skip

LABORATORY: dict[str, dict[str, Any]] = {
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
"""The thesis's laboratory and its real camera: what a scenario that leaves a key out gets.

In a room of another size the camera and the microphones stand at the same fractions of its sides; see `laboratory`.
"""

CAMERAS: dict[str, dict[str, Any]] = {
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

_WAYPOINT = Object(
    {
        "position_m": Key(
            Numbers(2, bounds.COORDINATE),
            "position on the floor, m; it may lie outside the room, behind a door",
            required=True,
        ),
        "t_s": Key(bounds.TIME, "time at which the person arrives, s; later than at the previous waypoint"),
        "speed_m_s": Key(
            Number(1e-6, most=bounds.FARTHEST_M),
            "speed of the walk to this waypoint, m/s, instead of t_s; 1 where neither is given",
        ),
        "stay_s": Key(bounds.DURATION, "time that the person stays, s", default=0.0),
        "pose": Key(Choice(tuple(POSTURES)), "posture while staying", default="stand"),
        "heading_deg": Key(
            bounds.DEGREES,
            "direction that the person faces while staying, counterclockwise from +x; default: that of the walk",
        ),
    },
    closed=True,
    exclusive=("t_s", "speed_m_s"),
)
_PERSON = Object(
    {
        "object_id": Key(IDENTITY, "identity of the person, different for each; default: the place in the list"),
        "look": Key(
            LOOK, "clothes, hair and build: a built-in look, or an object; default: one after another along the list"
        ),
        "height_m": Key(Number(least=0.5, most=2.5), "height to the top of the head, m; default: that of the look"),
        "waypoints": Key(ListOf(_WAYPOINT, 1), "points that the person walks through", required=True),
        "speech_s": Key(
            Either((Choice((True,)), ListOf(bounds.TIMES))),
            "turns to speak, each [start, end] in s, in order; true: all the time; default: never",
        ),
        "group": Key(
            Text(), "name of the people who talk with each other: heads turn to who speaks; default: with nobody"
        ),
        "gestures": Key(Boolean(), "whether the hands move while speaking", default=True),
        "carries": Key(Choice(tuple(LOADS)), "what the person carries; default: nothing"),
        "wheelchair": Key(Boolean(), "whether the person sits in a wheelchair, and rolls to waypoints", default=False),
    },
    closed=True,
)
_AS_CONFIG = (
    "section of config.json; keys that are left out have the values of the thesis's laboratory, and positions that are "
    "left out are scaled with the room"
)
SCENARIO = Format(
    "scenario",
    "A scenario of avsim-scene: who walks where and speaks when, in which room, seen by which camera",
    Object(
        {
            "name": Key(Text(), "name of the session (session_id in config.json); default: the name of the file"),
            "duration_s": Key(bounds.DURATION, "duration, s; the last frame is at or before it", default=4.0),
            "camera_config": Key(Object({}), _AS_CONFIG),
            "microphone_config": Key(Object({}), _AS_CONFIG),
            "room_config": Key(Object({}), _AS_CONFIG),
            "furniture": Key(ListOf(furniture.PIECE), "tables, chairs and other things that do not move"),
            "sensor": Key(
                Choice(tuple(SENSORS)),
                "name of the sensor's effects (noise, blur, compression); clean has none",
                default="clean",
            ),
            "people": Key(ListOf(_PERSON, 0, 250), "the people; a mask picture numbers at most 250"),
        },
        closed=True,
    ),
)
"""Every key of a scenario file."""

_FASTEST_M_S = 12.0  # faster than anyone ran: simulated, with a warning


class ScenarioError(ValueError):
    """An invalid scenario; the message names its file and the key."""


@dataclass(frozen=True)
class Scenario:
    """A scene to simulate.

    Attributes:
        raw: the JSON object with every default filled in; parsing it gives the same scenario.
        name: of the scenario.
        duration: s; the last frame is the last one at or before it.
        config: the experiment's Config (camera, microphones, room).
        solids: furniture.Solids, all that does not move.
        people: in the order of the file.
        warnings: sentences on what is odd but can be simulated.
        sensor: name of one of `settings.SENSORS`.
        pieces: the furniture among the solids, piece by piece.
    """

    raw: Mapping[str, Any]
    name: str
    duration: float
    config: experiment.Config
    solids: furniture.Solids
    people: tuple[Person, ...]
    warnings: tuple[str, ...]
    sensor: str = "clean"
    pieces: tuple[furniture.Solids, ...] = ()

    @property
    def times(self) -> np.ndarray:
        """Times of the frames, (n,) s."""
        return _frame_times(self.duration, self.config.camera.frame_rate_hz)


def _frame_times(duration: float, rate: float) -> np.ndarray:
    return np.arange(math.floor(duration * rate + 1e-6) + 1) / rate


def parse(raw: Any, name: str = "scenario", load_mesh: Callable[[str], np.ndarray] | None = None) -> Scenario:
    """Check a scenario's JSON object and build it.

    Args:
        raw: the decoded JSON.
        name: of its file, for messages.
        load_mesh: returns the triangles (n, 3, 3) in m of a mesh by its path; raises ValueError or OSError.

    Raises:
        ScenarioError: the scenario is invalid; the message says which key and why.
    """
    try:
        return _parsed(SCENARIO.content.read(raw), raw, name, load_mesh)
    except Invalid as error:
        raise ScenarioError(f"{name}: {error}") from None
    except experiment.ConfigError as error:
        raise ScenarioError(str(error)) from None


def _parsed(
    values: Mapping[str, Any], raw: Mapping[str, Any], name: str, load_mesh: Callable[[str], np.ndarray] | None
) -> Scenario:
    sections = _with_laboratory(raw)
    title = name if values["name"] is None else values["name"]
    config = experiment.Config({"session_id": title, **sections}, name)
    camera, dimensions, duration = config.camera, config.room.dimensions, values["duration_s"]
    position = camera.T_room_camera[:3, 3]
    if ((position <= 0) | (position >= dimensions)).any():
        raise _outside(position, dimensions).within("camera_config", "camera_position_m")
    for index, place in enumerate(config.microphones.positions):
        if ((place < 0) | (place > dimensions)).any():  # one on a wall is possible
            error = _outside(place, dimensions, f"microphone {index + 1} at ")
            raise error.within("microphone_config", "mic_positions_m", index)
    if camera.width_px * camera.height_px > 1 << 26:
        reason = f"has an image of {camera.width_px} x {camera.height_px}; at most {1 << 26} pixels can be simulated"
        raise Invalid(reason, ("camera_config",))
    if duration * camera.frame_rate_hz > 1e7:
        raise Invalid(f"must give at most 10 million frames, found {duration:g} s", ("duration_s",))
    pieces, warnings = [], [f"{name}: {text}" for text in viewpoint.odd(camera)]
    for index, piece in enumerate(values["furniture"] or ()):
        try:
            pieces.append(furniture.build(piece, load_mesh))
        except Invalid as error:
            raise error.within("furniture", index) from None
    people: list[Person] = []
    fast: list[str] = []
    for index, item in enumerate(values["people"] or ()):
        try:
            person, odd = _person(item, index, duration, config.room)
            if any(other.object_id == person.object_id for other in people):
                raise Invalid(f"must differ between people; {person.object_id} is used twice", ("object_id",))
        except Invalid as error:
            raise error.within("people", index) from None
        people.append(person)
        fast += [f"people[{index}].{text}" for text in odd]
    people = _heeding(people, [item["group"] for item in values["people"] or ()])
    times = _frame_times(duration, camera.frame_rate_hz)
    viewpoint.refuse_buried(camera, pieces, people, times)
    solids = furniture.join(pieces)
    oddities = [*_counted(fast, "walks are as fast"), *_collisions(people, solids, duration, dimensions)]
    warnings += [f"{name}: {text}" for text in oddities]
    solids = furniture.join([solids, fittings.solids(config.room)])
    filled = {"name": title, "duration_s": duration, **sections}
    filled |= {key: raw.get(key) or [] for key in ("furniture", "people")}
    filled["sensor"] = values["sensor"]
    return Scenario(
        filled, title, duration, config, solids, tuple(people), tuple(warnings), values["sensor"], tuple(pieces)
    )


def _with_laboratory(raw: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the sections of config.json, filled with the laboratory's values."""
    sections = {}
    for key, default in laboratory(raw).items():
        given = raw.get(key) or {}
        # A lens is one thing: a scenario that gives one part of it does not want the rest of another lens.
        own_lens = key == "camera_config" and {"lens_model", "fx_px", "fy_px", "k1"} & given.keys()
        # So is how a room sounds: one whose surfaces have materials does not want the laboratory's reverberation.
        own_sound = key == "room_config" and {"surfaces", "absorption"} & given.keys()
        unwanted = ("lens_model", *experiment.LENS_KEYS) if own_lens else ("reverberation_time_s",) if own_sound else ()
        kept = {k: v for k, v in default.items() if k not in unwanted}
        sections[key] = {**kept, **given}
    return sections


def laboratory(raw: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return LABORATORY with the camera and the microphones scaled to the room of a scenario's JSON object.

    An invalid room scales nothing: its reader says what is wrong with it.
    """
    usual = np.array(LABORATORY["room_config"]["room_dimensions_m"])
    section = raw.get("room_config")
    given = section.get("room_dimensions_m") if isinstance(section, Mapping) else None
    try:
        scale = usual / usual if given is None else np.array(_DIMENSIONS.read(given)) / usual
    except Invalid:
        scale = usual / usual

    def scaled(position: Sequence[float]) -> list[float]:
        return np.round(position * scale, 6).tolist()

    camera, microphones = LABORATORY["camera_config"], LABORATORY["microphone_config"]
    places = [item | {"position": scaled(item["position"])} for item in microphones["mic_positions_m"]]
    return {
        "camera_config": camera | {"camera_position_m": scaled(camera["camera_position_m"])},
        "microphone_config": microphones | {"mic_positions_m": places},
        "room_config": LABORATORY["room_config"],
    }


_DIMENSIONS = Numbers(3, Number(above=0))


def _outside(
    position: np.ndarray, dimensions: np.ndarray, what: str = "", doors: Sequence[Mapping[str, Any]] = ()
) -> Invalid:
    hint = "; ways in and out lead straight through a door" if doors else ""
    return Invalid(f"{what}{position.tolist()} is outside the room of {dimensions.tolist()} m{hint}")


def with_camera(raw: Mapping[str, Any], camera_config: Mapping[str, Any]) -> dict[str, Any]:
    """Put another camera into a scenario's JSON object: its lens, its image size, and its place where it has one.

    Args:
        raw: the scenario.
        camera_config: a camera_config, or a config.json that has one.

    Raises:
        ScenarioError: the camera_config is not a JSON object.
    """
    given = camera_config.get("camera_config", camera_config) if isinstance(camera_config, Mapping) else camera_config
    if not isinstance(given, Mapping):
        raise ScenarioError(f"camera_config must be a JSON object, found {shown(given)}")
    own = raw.get("camera_config") or {}
    if not isinstance(own, Mapping):
        return dict(raw)  # `parse` says what is wrong
    old = {**laboratory(raw)["camera_config"], **own}
    kept = {key: old[key] for key in ("camera_position_m", "camera_rotation_deg", "frame_rate_hz")}
    return {**raw, "camera_config": {**kept, **given}}


def at_height(raw: Mapping[str, Any], height: float) -> dict[str, Any]:
    """Put a scenario's camera at another height, m."""
    own = raw.get("camera_config") or {}
    if not isinstance(own, Mapping):
        return dict(raw)  # `parse` says what is wrong
    position = own.get("camera_position_m", laboratory(raw)["camera_config"]["camera_position_m"])
    if isinstance(position, list) and len(position) == 3:
        position = [*position[:2], height]
    return {**raw, "camera_config": {**own, "camera_position_m": position}}


def _person(values: Mapping[str, Any], index: int, duration: float, room: experiment.Room) -> tuple[Person, list[str]]:
    """Return a person and warnings, which begin with the place within the person."""
    identity = index if values["object_id"] is None else values["object_id"]
    names = list(LOOKS)
    look = look_of(values["look"] or names[index % len(names)])
    height = values["height_m"] or look.height
    motion, warnings = _motion(values["waypoints"], height, room)
    turns = [[0.0, max(duration, 1e-3)]] if values["speech_s"] is True else values["speech_s"] or []
    last = -math.inf
    for i, (start, end) in enumerate(turns):
        if not start < end:
            raise Invalid(f"must start before it ends, found {shown([start, end])}", ("speech_s", i))
        if start < last:
            raise Invalid("begins before the previous turn ends", ("speech_s", i))
        last = end
    speech = np.array(turns, float).reshape(-1, 2)
    loads = values["carries"], values["wheelchair"]
    return Person(identity, motion, look, height, speech, values["gestures"], *loads), warnings


def _heeding(people: Sequence[Person], groups: Sequence[str | None]) -> list[Person]:
    """Let everybody heed the others of their group."""

    def others(person: Person, group: str | None) -> tuple[tuple[Motion, np.ndarray], ...]:
        together = [one for one, its in zip(people, groups, strict=True) if group is not None and its == group]
        return tuple((one.motion, one.speech) for one in together if one is not person and len(one.speech))

    return [replace(person, heeds=others(person, group)) for person, group in zip(people, groups, strict=True)]


def _motion(points: Sequence[Mapping[str, Any]], height: float, room: experiment.Room) -> tuple[Motion, list[str]]:
    times: list[float] = []
    places: list[np.ndarray] = []
    headings: list[float] = []
    postures: list[str] = []
    warnings = []
    for index, point in enumerate(points):
        place = np.array(point["position_m"])
        try:
            before = places[-1] if places else place
            if doorways.goes_through_wall(before, place, room.dimensions, room.fittings.doors):
                raise _outside(place, room.dimensions[:2], doors=room.fittings.doors).within("position_m")
            time = _arrival(point, times, places, place)
        except Invalid as error:
            raise error.within("waypoints", index) from None
        if times:
            speed = np.linalg.norm(place - places[-1]) / (time - times[-1])
            if speed > _FASTEST_M_S:
                warnings.append(f"waypoints[{index}]: a walk at {speed:.3g} m/s")
        heading = math.nan if point["heading_deg"] is None else math.radians(point["heading_deg"])
        stay = point["stay_s"]
        times.append(time)
        places.append(place)
        headings.append(heading)
        postures.append(point["pose"])
        if stay > 0:
            times.append(time + stay)
            places.append(place)
            headings.append(heading)
            postures.append(point["pose"] if index == len(points) - 1 else "stand")
    seated = np.array([name in SEATED for name in postures])
    return Motion(np.array(times), np.array(places), np.array(headings), seated, height, tuple(postures)), warnings


def _arrival(
    point: Mapping[str, Any], times: Sequence[float], places: Sequence[np.ndarray], place: np.ndarray
) -> float:
    """Return the time at which the person reaches a waypoint, s: the stated one, or by the speed of the walk there."""
    time = point["t_s"]
    if not times:
        return 0.0 if time is None else time
    if time is not None:
        if time <= times[-1]:
            raise Invalid(f"must be after the previous waypoint, {times[-1]:g} s, found {time:g}", ("t_s",))
        return time
    distance = float(np.linalg.norm(place - places[-1]))
    if distance == 0:
        reason = "is the position of the previous waypoint; give t_s, or stay_s at the previous waypoint"
        raise Invalid(reason, ("position_m",))
    return times[-1] + distance / (point["speed_m_s"] or 1.0)


def _collisions(
    people: Sequence[Person], solids: furniture.Solids, duration: float, dimensions: np.ndarray
) -> list[str]:
    """Say who walks through furniture and which two people meet: the first ones, and how many others there are."""
    t = np.arange(0.0, duration + 1e-9, 0.1)[:6000]
    tracks = [person.motion.position(t) for person in people]
    here = [doorways.is_inside(track, dimensions) for track in tracks]
    crossings: list[str] = []
    meetings: list[str] = []
    for index, (person, track) in enumerate(zip(people, tracks, strict=True)):
        seats = person.motion.places[person.motion.seated]
        standing = (np.linalg.norm(track[:, None] - seats, axis=-1) > 0.7).all(1)  # one's own chair is no obstacle
        inside = furniture.blocks(solids, track, 0.05, person.height) & standing & here[index]
        if inside.any():
            crossings.append(f"people[{index}] walks through furniture at {t[inside.argmax()]:.1f} s")
        for other in range(index):
            near = (np.linalg.norm(track - tracks[other], axis=1) < 0.3) & here[index] & here[other]
            if near.any():
                meetings.append(f"people[{index}] and people[{other}] meet at {t[near.argmax()]:.1f} s")
    return [*_counted(crossings, "people do"), *_counted(meetings, "pairs do")]


def _counted(sentences: Sequence[str], others: str) -> list[str]:
    """The first of several sentences that say the same, and how many others there are."""
    if len(sentences) < 2:
        return list(sentences)
    return [f"{sentences[0]}, and {len(sentences) - 1} other {others}"]
