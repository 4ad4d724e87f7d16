"""Synthetic detections of people in a room, with their truth: S1 to S4 and the cases that are hard for a tracker.

Video localizes the body's axis, audio the mouth of whoever speaks, 0.1 m in front of it. Unless a case says otherwise:
10 Hz, video sigma 0.12 m and detection probability 0.9, audio sigma 0.25 m and 0.85 while speaking, 0.02 and 0.05 false
detections a record, all in a room of 4.66 m x 4.66 m.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avcli.formats.experiment import Config
from avcli.formats.records import Detections
from avcli.formats.sensors import CAMERA, MICROPHONES

AHEAD = 0.1  # m, from the body's axis to the mouth
COPY = 0.1  # m, standard deviation of the detections of a person who is found several times

KIND = {"video": CAMERA, "audio": MICROPHONES}
ROOM = 4.66
RATE = 10.0

Record = tuple[float, str, np.ndarray, float, np.ndarray]
"""Time s, sensor, z (J, 2) m, sigma m, owner (J,): id or -1."""

Truth = list[tuple[float, np.ndarray, np.ndarray]]
"""Time s, ids (n,), xy (n, 2) m."""

Rng = np.random.Generator

TALK, TURN = 0.4, 2.0  # share of people who talk; drawn anew each so many s
HIDE, HIDDEN = 0.1, (0.2, 1.5)  # rate per second at which a person becomes hidden, for so many s


@dataclass
class Scene:
    """People at each time, and what sensors found.

    Attributes:
        truth: at each time of the output.
        records: in order of time.
        config: the room and its camera as avfuse is told them, None: the trackers' own default room.
        told: sensor -> by how much its detections state their sigma wrong, a factor; NaN: they do not state it.
        features: for each record name -> `Feature` of its detections; empty: none has any.
        ready: the records as avfuse takes them, with what the sensors say of each detection; None: `records` say all.
        seen: two corners of the rectangle that is scored, m, None: everywhere.
        unlooked: times, from s to s, of which nobody knows who was there, nor who of those afterwards was there before.
    """

    truth: Truth
    records: list[Record] = field(default_factory=list)
    config: Config | None = None
    told: Mapping[str, float] = field(default_factory=dict)
    features: list[dict[str, Any]] = field(default_factory=list)
    ready: list[tuple[float, str, Detections]] | None = None
    seen: tuple[tuple[float, float], tuple[float, float]] | None = None
    unlooked: Sequence[tuple[float, float]] = ()

    def only(self, *sensors: str) -> "Scene":
        """The same scene heard or seen by some sensors alone."""
        kept = [k for k, r in enumerate(self.records) if r[1] in sensors]
        features = [self.features[k] for k in kept] if self.features else []
        ready = None if self.ready is None else [r for r in self.ready if r[1] in sensors]
        return replace(self, records=[self.records[k] for k in kept], features=features, ready=ready)


def room(width: float, depth: float) -> Config:
    """The config of a room of a size in m."""
    return Config({"room_config": {"room_dimensions_m": [width, depth, 3.0]}})


def waypoints(
    rng: Rng, times: np.ndarray, start: np.ndarray | None = None, low: float = 0.4, high: float = ROOM - 0.4
) -> np.ndarray:
    """Someone who walks between random places at 0.5 to 1.3 m/s and stands still now and then: (n, 2) m."""
    here = rng.uniform(low, high, 2) if start is None else np.array(start, float)
    knots_t, knots = [float(times[0])], [here]
    while knots_t[-1] < times[-1]:
        if rng.random() < 0.2:
            knots_t.append(knots_t[-1] + rng.uniform(0.5, 3.0))
        else:
            there = rng.uniform(low, high, 2)
            knots_t.append(knots_t[-1] + float(np.linalg.norm(there - here)) / rng.uniform(0.5, 1.3) + 1e-3)
            here = there
        knots.append(here)
    corners = np.array(knots)
    return np.column_stack([np.interp(times, knots_t, corners[:, k]) for k in (0, 1)])


class People:
    """Paths on a fine clock, so that any sensor can look at any time: id -> (times, xy, speaks)."""

    def __init__(self) -> None:
        self.paths: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def add(self, times: np.ndarray, xy: np.ndarray, speaks: "bool | np.ndarray" = True) -> None:
        """One more person. times (n,) s, xy (n, 2) m, speaks: bool or (n,) bool."""
        self.paths[len(self.paths)] = (times, xy, np.broadcast_to(speaks, len(times)))

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """ids (n,), xy (n, 2), mouth (n, 2), speaks (n,) of those in the room at a time."""
        ids, rows = [], []
        for i, (times, xy, speaks) in self.paths.items():
            if times[0] - 1e-9 <= time <= times[-1] + 1e-9:
                here = np.array([np.interp(time, times, xy[:, k]) for k in (0, 1)])
                soon = np.array([np.interp(time + 0.05, times, xy[:, k]) for k in (0, 1)])
                past = np.array([np.interp(time - 0.05, times, xy[:, k]) for k in (0, 1)])
                step = soon - past
                length = np.linalg.norm(step)
                ahead = step / length if length > 1e-6 else np.array([1.0, 0.0])
                ids.append(i)
                turn = min(int(np.searchsorted(times, time)), len(times) - 1)
                rows.append((here, here + 0.1 * ahead, bool(speaks[turn])))
        place = np.array([r[0] for r in rows]).reshape(-1, 2)
        return (
            np.array(ids, int),
            place,
            np.array([r[1] for r in rows]).reshape(-1, 2),
            np.array([r[2] for r in rows], bool),
        )


@dataclass
class Look:
    """How a sensor of the bench looks: see the module's text."""

    name: str
    sigma: float
    detection: float
    clutter: float
    rate: float = RATE
    area: tuple[float, float] = (ROOM, ROOM)  # m, where false detections are, from `corner` on
    merge: float = 0.0  # m; two who are nearer to one another are found as one, between them, half the time
    corner: tuple[float, float] = (0.0, 0.0)
    copies: int = 1  # one person is found up to so many times, `COPY` m apart

    def record(
        self,
        rng: Rng,
        people: People,
        time: float,
        shown: float | None = None,
        hidden: Iterable[int] = (),
        detection: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Record:
        """One record at `shown` (default: time) of what is there at `time`; nobody in `hidden` is found."""
        shown = float(time if shown is None else shown)
        return self.of(rng, shown, *people.at(time), hidden=hidden, detection=detection)

    def of(
        self,
        rng: Rng,
        time: float,
        ids: np.ndarray,
        place: np.ndarray,
        mouth: np.ndarray,
        speaks: np.ndarray,
        hidden: Iterable[int] = (),
        detection: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Record:
        """One record of n people: ids (n,), place and mouth (n, 2) m, speaks (n,)."""
        if self.name == "audio":
            place, able = mouth, speaks
        else:
            able = np.ones(len(ids), bool)
        able = able & ~np.isin(ids, list(hidden))
        chance = np.full(len(ids), self.detection) if detection is None else detection(place)
        found = able & (rng.random(len(ids)) < chance)
        z = place[found] + self.sigma * rng.standard_normal((found.sum(), 2))
        owner = ids[found]
        if self.copies > 1:
            again = np.repeat(np.arange(len(z)), rng.integers(1, self.copies + 1, len(z)))
            z, owner = z[again] + COPY * rng.standard_normal((len(again), 2)), owner[again]
        if self.merge:
            z, owner = merged(rng, place[found], z, owner, self.merge)
        ghosts = rng.uniform(self.corner, self.area, (rng.poisson(self.clutter), 2))
        owner = np.r_[owner, np.full(len(ghosts), -1)].astype(int)
        z = np.vstack([z, ghosts])
        order = rng.permutation(len(z))
        return (time, self.name, z[order], self.sigma, owner[order])


def merged(
    rng: Rng, place: np.ndarray, z: np.ndarray, owner: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Detections z (n, 2) and owners (n,), of which pairs of people nearer than `reach` m are one half the time."""
    gone: set[int] = set()
    for a in range(len(z)):
        for b in range(a + 1, len(z)):
            near = np.linalg.norm(place[a] - place[b]) < reach
            if near and not gone & {a, b} and rng.random() < 0.5:
                z[a] = (z[a] + z[b]) / 2
                gone.add(b)
    keep = [k for k in range(len(z)) if k not in gone]
    return z[keep], owner[keep]


@dataclass
class Stay:
    """One person from coming to leaving, on the clock of a scene.

    Attributes:
        first: number of the first frame.
        xy: (n, 2) m.
        talks: (n,) whether the person talks.
        unseen: (n,) whether the person is hidden from the camera.
    """

    first: int
    xy: np.ndarray
    talks: np.ndarray
    unseen: np.ndarray


def turns(rng: Rng, n: int, share: float = TALK, rate: float = RATE) -> np.ndarray:
    """Whether somebody talks in each of n frames."""
    length = max(round(TURN * rate), 1)
    return np.repeat(rng.random(int(n / length) + 1) < share, length)[:n]


def hidden(rng: Rng, n: int, rate: float = RATE) -> np.ndarray:
    """Whether somebody who is hidden from the camera now and then is so in each of n frames."""
    out, k = np.zeros(n, bool), rng.exponential(1 / HIDE) * rate
    while k < n:
        length = rng.uniform(*HIDDEN) * rate
        out[int(k) : int(k + length)] = True
        k += length + rng.exponential(1 / HIDE) * rate
    return out


def mouths(xy: np.ndarray) -> np.ndarray:
    """Places (n, 2) m of the mouth of somebody who walks along xy (n, 2) m."""
    velocity = np.gradient(xy, axis=0) if len(xy) > 1 else np.zeros_like(xy)
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    return xy + AHEAD * np.where(speed > 1e-3, velocity / np.maximum(speed, 1e-9), [1.0, 0.0])


def perceived(
    rng: Rng,
    stays: list[Stay],
    times: np.ndarray,
    looks: Iterable[Look],
    config: Config | None = None,
    deaf: Callable[[float], bool] = lambda t: False,
    detection: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Scene:
    """A scene of stays on a clock (s), every sensor at each time, in the order of the names of `looks`.

    Args:
        deaf: tells whether no sensor finds anybody at a time.
        detection: the video's probability at places (n, 2) m, in place of the look's own.
    """
    frames: list[list[tuple[int, np.ndarray, np.ndarray, bool, bool]]] = [[] for _ in times]
    for i, one in enumerate(stays):
        for j, mouth in enumerate(mouths(one.xy)):
            frames[one.first + j].append((i, one.xy[j], mouth, bool(one.talks[j]), bool(one.unseen[j])))
    truth, records = [], list[Record]()
    for t, people in zip(times.tolist(), frames, strict=True):
        ids = np.array([one[0] for one in people], int)
        place, mouth = (np.array([one[c] for one in people]).reshape(-1, 2) for c in (1, 2))
        talks, unseen = (np.array([one[c] for one in people], bool) for c in (3, 4))
        truth.append((t, ids, place))
        for look in looks:
            away = ids if deaf(t) else ids[unseen] if look.name == "video" else ids[:0]
            chance = detection if look.name == "video" else None
            records.append(look.of(rng, t, ids, place, mouth, talks, away, chance))
    return Scene(truth, records, config)


VIDEO = Look("video", 0.12, 0.9, 0.02)
AUDIO = Look("audio", 0.25, 0.85, 0.05)


def clock(duration: float, rate: float = RATE) -> np.ndarray:
    """Times of a regular clock, both ends included, s."""
    return np.arange(round(duration * rate) + 1) / rate


def assemble(
    rng: Rng,
    people: People,
    duration: float,
    looks: Iterable[Look] = (VIDEO, AUDIO),
    hidden: Callable[[str, float], Iterable[int]] = lambda name, t: (),
    detection: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Scene:
    """Truth at 10 Hz and each sensor's records, in order of time."""
    times = clock(duration)
    truth = [(t, *people.at(t)[:2]) for t in times.tolist()]
    records = [
        look.record(rng, people, t, hidden=hidden(look.name, t), detection=detection)
        for look in looks
        for t in clock(duration, look.rate)
    ]
    return Scene(truth, sorted(records, key=lambda r: (r[0], r[1])))


def straight(y: float, backwards: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """One walk along x at 1 m/s for 4 s: times, xy."""
    t = clock(4.0)
    x = 4.33 - t if backwards else 0.33 + t
    return t, np.column_stack([x, np.full_like(t, y)])


def s1(rng: Rng, looks: Iterable[Look] = (VIDEO, AUDIO)) -> Scene:
    """One person who speaks."""
    people = People()
    people.add(*straight(2.33))
    return assemble(rng, people, 4.0, looks)


def s2(rng: Rng, looks: Iterable[Look] = (VIDEO, AUDIO)) -> Scene:
    """One person who speaks, hidden from the camera for 1.2 s."""
    people = People()
    people.add(*straight(2.33))
    return assemble(rng, people, 4.0, looks, lambda name, t: (0,) if name == "video" and 1.4 <= t < 2.6 else ())


def s3(rng: Rng, looks: Iterable[Look] = (VIDEO, AUDIO)) -> Scene:
    """Three people; the one in the middle walks the other way and speaks."""
    people = People()
    for y, back in ((1.33, False), (2.33, True), (3.33, False)):
        people.add(*straight(y, back), speaks=back)
    return assemble(rng, people, 4.0, looks)


def s4(rng: Rng, looks: Iterable[Look] = (VIDEO, AUDIO)) -> Scene:
    """As S3, speaking one after the other."""
    people = People()
    t = clock(4.0)
    for k, (y, back) in enumerate(((1.33, False), (2.33, True), (3.33, False))):
        people.add(*straight(y, back), speaks=(t >= k * 4 / 3) & (t < (k + 1) * 4 / 3))
    return assemble(rng, people, 4.0, looks)


def crossing(rng: Rng) -> Scene:
    """Two people who cross at a shallow angle at 0.76 m/s."""
    t = clock(6.0)
    along = 0.05 + 0.75 * t
    across = 0.12 * (t - 3.0)
    people = People()
    people.add(t, np.column_stack([along, 2.33 + across]))
    people.add(t, np.column_stack([along, 2.33 - across]), speaks=False)
    return assemble(rng, people, 6.0)


def turning_back(rng: Rng) -> Scene:
    """Two people who approach each other to 0.2 m at 0.7 m/s, slow down at 1 m/s^2 and turn back."""
    t = clock(6.0)
    away = np.abs(t - 3.0)
    x = np.where(away < 0.7, away**2 / 2, 0.7 * (away - 0.35))
    people = People()
    people.add(t, np.column_stack([2.23 - x, np.full_like(t, 2.33)]))
    people.add(t, np.column_stack([2.43 + x, np.full_like(t, 2.33)]), speaks=False)
    return assemble(rng, people, 6.0)


def strollers(rng: Rng, count: int, duration: float, talk: bool = True) -> People:
    """People between random waypoints; each speaks in turns of seconds."""
    people, t = People(), clock(duration)
    for _ in range(count):
        speaks = np.repeat(rng.random(len(t) // 20 + 1) < (0.4 if talk else 0.0), 20)[: len(t)]
        people.add(t, waypoints(rng, t), speaks)
    return people


def clutter(rng: Rng) -> Scene:
    """Three people among 10 + 5 false detections a frame."""
    people = strollers(rng, 3, 20.0)
    return assemble(rng, people, 20.0, (Look("video", 0.12, 0.9, 10.0), Look("audio", 0.25, 0.85, 5.0)))


def weak(rng: Rng) -> Scene:
    """Detection probability 0.3 in both sensors, 20 s, three people who all speak."""
    people, t = People(), clock(20.0)
    for _ in range(3):
        people.add(t, waypoints(rng, t))
    return assemble(rng, people, 20.0, (Look("video", 0.12, 0.3, 0.02), Look("audio", 0.25, 0.3, 0.05)))


def comings_and_goings(rng: Rng) -> Scene:
    """Six people within 30 s who each come in through a wall, stroll for 4 to 9 s and leave through a wall."""

    def doorway() -> np.ndarray:
        along, side = rng.uniform(0.3, ROOM - 0.3), rng.integers(4)
        across = 0.15 if side < 2 else ROOM - 0.15
        return np.array([across, along] if side % 2 else [along, across])

    people = People()
    for k in range(6):
        begin = 3.5 * k + rng.uniform(0.0, 2.5)
        stroll = begin + np.arange(0.0, rng.uniform(4.0, 9.0), 0.1)
        path = waypoints(rng, stroll, doorway())
        way = doorway() - path[-1]
        leave = np.arange(1, max(float(np.linalg.norm(way)) / 1.0 / 0.1, 1.0))[:, None] * 0.1
        path = np.vstack([path, path[-1] + leave * way / max(np.linalg.norm(way), 1e-9)])
        times = begin + 0.1 * np.arange(len(path))
        keep = times <= 30.0
        people.add(times[keep], path[keep], rng.random() < 0.5)
    return assemble(rng, people, 30.0)


def asynchronous(rng: Rng) -> Scene:
    """Audio 40 +- 20 ms off the video's clock, three straight walkers (S4)."""
    base = s4(rng)
    people, t = People(), clock(4.0)
    for k, (y, back) in enumerate(((1.33, False), (2.33, True), (3.33, False))):
        people.add(*straight(y, back), speaks=(t >= k * 4 / 3) & (t < (k + 1) * 4 / 3))
    late = [AUDIO.record(rng, people, min(u + 0.04 + rng.uniform(-0.02, 0.02), 4.0)) for u in t]
    records = [r for r in base.records if r[1] == "video"] + late
    return Scene(base.truth, sorted(records, key=lambda r: (r[0], r[1])))


def damaged(rng: Rng) -> Scene:
    """S4 with 10 % of the records dropped and 10 % repeated (the merging puts the order right before the filter)."""
    base = s4(rng)
    records = []
    for r in base.records:
        if rng.random() < 0.9:
            records += [r] * (2 if rng.random() < 0.1 else 1)
    return Scene(base.truth, records)


def gaps(rng: Rng) -> Scene:
    """Two people for 20 s; for 2 to 2.5 s no sensor finds anybody."""
    people = strollers(rng, 2, 20.0)
    begin = rng.uniform(6.0, 12.0)
    end = begin + rng.uniform(2.0, 2.5)
    return assemble(rng, people, 20.0, hidden=lambda name, t: (0, 1) if begin <= t < end else ())


def dim_edge(rng: Rng) -> Scene:
    """Detection probability 0.45 beyond 1.4 m from the room's centre; three people, 20 s."""
    people = strollers(rng, 3, 20.0)
    return assemble(
        rng, people, 20.0, detection=lambda xy: np.where(np.linalg.norm(xy - ROOM / 2, axis=1) > 1.4, 0.45, 0.9)
    )


def ten(rng: Rng) -> Scene:
    """Ten people for 60 s."""
    return assemble(rng, strollers(rng, 10, 60.0), 60.0)


def long_pair(rng: Rng) -> Scene:
    """Two people for 300 s."""
    return assemble(rng, strollers(rng, 2, 300.0), 300.0)


EASY: dict[str, Callable[..., Scene]] = {"s1": s1, "s2": s2, "s3": s3, "s4": s4}
HARD = {
    "crossing": crossing,
    "turning-back": turning_back,
    "clutter": clutter,
    "weak": weak,
    "comings-goings": comings_and_goings,
    "asynchronous": asynchronous,
    "damaged": damaged,
    "gaps": gaps,
    "dim-edge": dim_edge,
    "ten": ten,
    "long-pair": long_pair,
}
