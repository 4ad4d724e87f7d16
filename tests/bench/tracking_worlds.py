"""Worlds that are hard for a tracker, by seed: people who leave, halls, occlusions, wrong noise, crowds, meetings.

Sensors are those of tracking_scenes.py unless a world says otherwise. People who walk are steered to their goals by the
social force model (Helbing and Molnar 1995, eq. 2 to 4): they speed up and slow down, turn in curves, and evade.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from tracking_scenes import (
    AUDIO,
    EASY,
    RATE,
    ROOM,
    VIDEO,
    Look,
    Rng,
    Scene,
    Stay,
    clock,
    hidden,
    perceived,
    room,
    turns,
    waypoints,
)

from avcli.formats.experiment import Config

RELAX = 0.5  # s in which people reach the velocity they want
PUSH, REACH = 7.0, 0.3  # m/s² and m, of the repulsion between people
ARRIVED = 0.3  # m from a goal
FINE = 0.05  # s, longest step of the simulation


# --- paths ------------------------------------------------------------------------------------------------------------


def steered(
    rng: Rng,
    n: int,
    size: tuple[float, float],
    seconds: float,
    rate: float = RATE,
    speed: tuple[float, float] = (0.7, 1.5),
    pause: float = 0.2,
    relax: float = RELAX,
) -> np.ndarray:
    """n people who walk between random goals in a room of a size (m) at a wanted speed (m/s): (n, frames, 2) m.

    pause: probability of standing for .5 to 4 s at a goal.
    """
    low, high = np.full(2, 0.4), np.array(size) - 0.4
    place, goal, want = rng.uniform(low, high, (n, 2)), rng.uniform(low, high, (n, 2)), rng.uniform(*speed, n)
    velocity, wait, out = np.zeros((n, 2)), np.zeros(n), []
    inner = max(math.ceil(1 / rate / FINE), 1)
    dt = 1 / rate / inner
    for _ in range(round(seconds * rate) + 1):
        out.append(place.copy())
        for _ in range(inner):
            way = goal - place
            far = np.linalg.norm(way, axis=1)
            there = (far < ARRIVED) & (wait <= 0)
            stops = there & (rng.random(n) < pause)
            wait = np.where(stops, rng.uniform(0.5, 4.0, n), wait - dt)
            goal = np.where(there[:, None], rng.uniform(low, high, (n, 2)), goal)
            wanted = np.where(wait > 0, 0.0, want / np.maximum(far, 1e-9))[:, None] * way
            velocity += dt * ((wanted - velocity) / relax + pushed(place))
            fast = np.linalg.norm(velocity, axis=1) / (1.3 * want)
            velocity /= np.maximum(fast, 1.0)[:, None]
            place = np.clip(place + dt * velocity, 0.15, np.array(size) - 0.15)
    return np.array(out).swapaxes(0, 1)


def pushed(place: np.ndarray) -> np.ndarray:
    """Repulsion of people at places (n, 2) m by one another: (n, 2) m/s²."""
    away = place[:, None] - place[None]
    far = np.linalg.norm(away, axis=2) + 1e-9
    force = np.where(np.eye(len(place), dtype=bool), 0.0, PUSH * np.exp(-far / REACH) / far)
    return (force[..., None] * away).sum(1)


def walk(start: np.ndarray, goals: list[np.ndarray], speed: float, rate: float = RATE) -> np.ndarray:
    """One person who walks from a place by way of goals to the last of them, in m: (n, 2)."""
    place, velocity, out = np.array(start, float), np.zeros(2), []
    for goal in goals:
        while np.linalg.norm(goal - place) > max(speed / rate, 0.05):
            out.append(place.copy())
            way = goal - place
            velocity += (speed * way / np.linalg.norm(way) - velocity) * (1 - math.exp(-1 / rate / RELAX))
            place = place + velocity / rate
    return np.array(out)


def rolled(rng: Rng, size: tuple[float, float], seconds: float) -> np.ndarray:
    """Somebody in a wheelchair: .4 to .9 m/s, curves of 1 m radius or more, stops; (n, 2) m."""
    place, heading, speed, out = rng.uniform(1.5, np.array(size) - 1.5), rng.uniform(0, 2 * math.pi), 0.0, []
    goal, want, wait = place, rng.uniform(0.4, 0.9), 0.0
    for _ in range(round(seconds * RATE) + 1):
        out.append(place)
        if np.linalg.norm(goal - place) < 1.2:
            goal = rng.uniform(1.0, np.array(size) - 1.0)
            wait = rng.uniform(1.0, 6.0) if rng.random() < 0.3 else 0.0
        wait -= 1 / RATE
        speed += np.clip((0.0 if wait > 0 else want) - speed, -0.8 / RATE, 0.4 / RATE)
        turn = (math.atan2(*(goal - place)[::-1]) - heading + math.pi) % (2 * math.pi) - math.pi
        heading += float(np.clip(turn, -speed / RATE, speed / RATE))
        place = np.clip(
            place + speed / RATE * np.array([math.cos(heading), math.sin(heading)]), 0.3, np.array(size) - 0.3
        )
    return np.array(out)


def whole(rng: Rng, paths: np.ndarray, rate: float = RATE) -> list[Stay]:
    """People who are there all the time, of paths (n, frames, 2) m, and who talk now and then."""
    return [Stay(0, xy, turns(rng, len(xy), rate=rate), np.zeros(len(xy), bool)) for xy in paths]


def sensors(
    size: tuple[float, float], video: float = VIDEO.sigma, rate: float = RATE, merge: float = 0.0
) -> tuple[Look, Look]:
    """Both sensors of a room of a size in m."""
    return (
        Look("audio", AUDIO.sigma, AUDIO.detection, AUDIO.clutter, rate, size),
        Look("video", video, VIDEO.detection, VIDEO.clutter, rate, size, merge),
    )


# --- worlds -----------------------------------------------------------------------------------------------------------


def leavers(rng: Rng, where: str, video_only: bool = False) -> Scene:
    """People come in through a wall one after the other, cross 8 x 6 m, and leave: by a wall, a door, the middle.

    The next one comes about then, or after 8 to 20 s.
    """
    size, stays, begin, seconds = (8.0, 6.0), [], 0.0, 90.0
    while begin < seconds - 8.0:
        sides = rng.permutation(4)[:2]
        places = [on_wall(rng, size, int(side)) for side in sides]
        end = {
            "wall": places[1],
            "door": np.array([5.6, 3.2]),
            "middle": rng.uniform([2.5, 2.0], [5.5, 4.0]),
        }[where]
        path = walk(places[0], [rng.uniform([2.0, 1.5], [6.0, 4.5]), end], rng.uniform(0.8, 1.5))
        first = round(begin * RATE)
        path = path[: round(seconds * RATE) + 1 - first]
        stays.append(Stay(first, path, turns(rng, len(path)), np.zeros(len(path), bool)))
        begin += len(path) / RATE + (rng.uniform(-2.0, 3.0) if rng.random() < 0.5 else rng.uniform(8.0, 20.0))
    looks = sensors(size)[1:] if video_only else sensors(size)
    return perceived(rng, stays, clock(seconds), looks, room(*size))


def on_wall(rng: Rng, size: tuple[float, float], side: int) -> np.ndarray:
    """A place at one of the four walls of a room, m."""
    along = rng.uniform(0.5, np.array(size) - 0.5)
    along[side % 2] = 0.05 if side < 2 else size[side % 2] - 0.05
    return along


def hall(rng: Rng, video_only: bool = True) -> Scene:
    """A hall of 30 x 20 m with twelve people, of which a camera 6 m above its middle sees 5.6 x 5.6 m."""
    size, height, across = (30.0, 20.0), 6.0, 3.0  # across: m of the floor that the picture holds each way
    camera = {
        "lens_model": "brown_conrady",
        **dict.fromkeys(("fx_px", "fy_px"), 500 * height / across),
        **dict.fromkeys(("cx_px", "cy_px"), 499.5),
        **dict.fromkeys(("image_width_px", "image_height_px"), 1000),
        "camera_position_m": [15.0, 10.0, height],
    }
    config = Config({"room_config": {"room_dimensions_m": [*size, height + 0.5]}, "camera_config": camera})

    def detection(xy: np.ndarray) -> np.ndarray:
        """A person is found where the picture holds a quarter of the body: up to .45 m above the floor."""
        far = abs(xy - [15.0, 10.0]).max(1)
        return VIDEO.detection * np.clip((across * (1 - 0.1 / height) - far) / 0.15, 0.0, 1.0)

    half = across * (1 - 0.45 / height)
    seen = ((15 - half, 10 - half), (15 + half, 10 + half))
    eye = replace(VIDEO, corner=seen[0], area=seen[1])
    stays = whole(rng, steered(rng, 12, size, 120.0))
    looks = (eye,) if video_only else (sensors(size)[0], eye)
    return replace(perceived(rng, stays, clock(120.0), looks, config, detection=detection), seen=seen)


def occluded(rng: Rng) -> Scene:
    """Six people in 8 x 6 m for 40 s, each hidden now and then; two within .35 m are one detection half the time."""
    size = (8.0, 6.0)
    stays = whole(rng, steered(rng, 6, size, 40.0))
    for one in stays:
        one.unseen = hidden(rng, len(one.xy))
    return perceived(rng, stays, clock(40.0), sensors(size, merge=0.35), room(*size))


def duplicates(rng: Rng) -> Scene:
    """Two people, each found up to five times in a record with .1 m between the detections."""
    size = (6.0, 6.0)
    audio, video = sensors(size)
    looks = (audio, replace(video, copies=5))
    return perceived(rng, whole(rng, steered(rng, 2, size, 20.0)), clock(20.0), looks, room(*size))


def strollers(rng: Rng, n: int, seconds: float, looks: tuple[Look, ...], rate: float = RATE) -> Scene:
    """People between waypoints as in the bench's first cases, with other sensors."""
    paths = np.array([waypoints(rng, clock(seconds, rate)) for _ in range(n)])
    return perceived(rng, whole(rng, paths, rate), clock(seconds, rate), looks)


def clutter(rng: Rng) -> Scene:
    """Three people among 20 + 10 false detections a frame."""
    return strollers(rng, 3, 20.0, (Look("audio", 0.25, 0.85, 10.0), Look("video", 0.12, 0.9, 20.0)))


def flood(rng: Rng) -> Scene:
    """One second of 1000 false detections a frame in 20 x 20 m, and three people among them."""
    size = (20.0, 20.0)
    looks = (Look("video", 0.12, 0.9, 1000.0, area=size),)
    return perceived(rng, whole(rng, steered(rng, 3, size, 1.0)), clock(1.0), looks, room(*size))


def false_place(rng: Rng) -> Scene:
    """Two people who walk for 60 s, and a place where the video finds somebody falsely in 30 % of its records."""
    size = (8.0, 6.0)
    scene = perceived(rng, whole(rng, steered(rng, 2, size, 60.0)), clock(60.0), sensors(size), room(*size))
    place, records = rng.uniform([1.0, 1.0], [7.0, 5.0]), list(scene.records)
    for k, (t, name, z, sigma, owners) in enumerate(records):
        if name == "video" and rng.random() < 0.3:
            angle, away = rng.uniform(0, 2 * math.pi), 0.1 * math.sqrt(rng.random())
            false = place + away * np.array([math.cos(angle), math.sin(angle)])
            records[k] = (t, name, np.vstack([z, false]), sigma, np.append(owners, -1))
    return replace(scene, records=records)


def found(rng: Rng, share: float) -> Scene:
    """Three people, found by each sensor in a share of the records, by microphones only while they talk."""
    return strollers(rng, 3, 20.0, (Look("audio", 0.25, share, 0.05), Look("video", 0.12, share, 0.02)))


def noisy(rng: Rng, worse: float, told: float) -> Scene:
    """Three people for 40 s, noise that is so many times worse, stated wrong by a factor (NaN: not stated)."""
    looks = (Look("audio", 0.25 * worse, 0.85, 0.05), Look("video", 0.12 * worse, 0.9, 0.02))
    return replace(strollers(rng, 3, 40.0, looks), told={"audio": told, "video": told})


def rate(rng: Rng, hertz: float) -> Scene:
    """Three people for 20 s at another rate of both sensors."""
    return strollers(rng, 3, 20.0, (Look("audio", 0.25, 0.85, 0.05), Look("video", 0.12, 0.9, 0.02)), hertz)


def crowd(rng: Rng, n: int, size: tuple[float, float], seconds: float) -> Scene:
    """Many people in a big room."""
    return perceived(rng, whole(rng, steered(rng, n, size, seconds)), clock(seconds), sensors(size), room(*size))


def runners(rng: Rng) -> Scene:
    """Three people who run at 4 to 5.5 m/s in 20 x 15 m."""
    size = (20.0, 15.0)
    paths = steered(rng, 3, size, 20.0, speed=(4.0, 5.5), pause=0.1, relax=0.8)
    return perceived(rng, whole(rng, paths), clock(20.0), sensors(size), room(*size))


def sitting(rng: Rng, seconds: float = 3600.0) -> Scene:
    """Two people who sit .45 m apart for an hour, at 1 Hz."""
    times = clock(seconds, 1.0)
    sway = np.zeros((2, len(times), 2))
    for k in range(1, len(times)):  # first-order autoregressive, 4 cm, over 10 s
        sway[:, k] = 0.905 * sway[:, k - 1] + 0.017 * rng.standard_normal((2, 2))
    paths = np.array([[2.2, 2.3], [2.65, 2.3]])[:, None] + sway
    looks = sensors((ROOM, ROOM), rate=1.0)
    return perceived(rng, whole(rng, paths, 1.0), times, looks, room(ROOM, ROOM))


def groups(rng: Rng) -> Scene:
    """Three groups of two to four people who stand and walk together, .5 to .8 m from one another, for 40 s."""
    size, paths = (10.0, 8.0), []
    for centre in steered(rng, 3, size, 40.0, speed=(0.6, 1.1), pause=0.6):
        n = int(rng.integers(2, 5))
        ring = rng.uniform(0.5, 0.8) / (2 * math.sin(math.pi / n)) * np.exp(1j * (2 * math.pi * np.arange(n) / n))
        angle = np.cumsum(0.05 * rng.standard_normal(len(centre)))
        for place in ring:
            around = place * np.exp(1j * angle)
            wander = np.cumsum(0.02 * rng.standard_normal((len(centre), 2)), axis=0)
            wander -= np.linspace(0, 1, len(wander))[:, None] * wander[-1]
            paths.append(
                np.clip(centre + np.column_stack([around.real, around.imag]) + 0.3 * wander, 0.1, np.array(size) - 0.1)
            )
    return perceived(rng, whole(rng, np.array(paths)), clock(40.0), sensors(size), room(*size))


def wheelchairs(rng: Rng) -> Scene:
    """Two wheelchairs and one person who walks, 40 s."""
    size = (8.0, 6.0)
    paths = np.array([rolled(rng, size, 40.0), rolled(rng, size, 40.0), *steered(rng, 1, size, 40.0)])
    return perceived(rng, whole(rng, paths), clock(40.0), sensors(size), room(*size))


def meeting(rng: Rng) -> Scene:
    """Two people who meet within .2 m, stand there for .3 to 2 s and go apart again, either way."""
    size, middle = (10.0, 10.0), np.full(2, 5.0)
    speed, stand, side = rng.uniform(0.6, 1.2), rng.uniform(0.3, 2.0), rng.uniform(0, 2 * math.pi)
    times, paths = clock(12.0), []
    begin = 5.0 - stand / 2
    away = 2 * math.pi * rng.random() + np.array([0.0, math.pi + rng.uniform(-1.2, 1.2)])
    near = rng.uniform(0.15, 0.2) / 2
    for k, angle in enumerate((side, side + math.pi)):
        there = middle + near * np.array([math.cos(angle), math.sin(angle)])
        out = np.array([math.cos(away[k]), math.sin(away[k])])
        before = speed * eased(begin - times)[:, None] * np.array([math.cos(angle), math.sin(angle)])
        after = speed * eased(times - begin - stand)[:, None] * out
        paths.append(np.clip(there + before + after, 0.2, 9.8))
    return perceived(rng, whole(rng, np.array(paths)), times, sensors(size), room(*size))


def eased(t: np.ndarray) -> np.ndarray:
    """Way at a wanted speed of 1 m/s after t s (n,), speeding up within about half a second; 0 before 0."""
    late = np.maximum(t, 0.0)
    return late - RELAX * (1 - np.exp(-late / RELAX))


def unseen(rng: Rng) -> Scene:
    """Three people who walk straight for 7 s; from 2.5 to 5 s no sensor finds anybody."""
    paths = [np.column_stack([0.5 + clock(7.0), np.full(71, y)]) for y in (1.5, 3.0, 4.5)]
    paths[1][:, 0] = 8.0 - paths[1][:, 0]
    stays = [Stay(0, xy, np.full(71, k == 1), np.zeros(71, bool)) for k, xy in enumerate(paths)]
    size = (8.0, 6.0)
    return perceived(rng, stays, clock(7.0), sensors(size), room(*size), deaf=lambda t: 2.5 <= t < 5.0)


COARSE = {f"{name}-coarse": partial(make, looks=(replace(VIDEO, sigma=0.2), AUDIO)) for name, make in EASY.items()}

WORLDS: dict[str, Callable[[Rng], Scene]] = {
    **{f"leave-{where}": partial(leavers, where=where) for where in ("wall", "door", "middle")},
    **{f"leave-{where}-video": partial(leavers, where=where, video_only=True) for where in ("wall", "door", "middle")},
    "hall": hall,
    "hall-both": partial(hall, video_only=False),
    "occluded": occluded,
    "duplicates": duplicates,
    "clutter20": clutter,
    "flood": flood,
    "false-place": false_place,
    "found30": partial(found, share=0.3),
    "unseen": unseen,
    "noise-told": partial(noisy, worse=2.5, told=1.0),
    "noise-untold": partial(noisy, worse=2.5, told=math.nan),
    "noise-usual": partial(noisy, worse=1.0, told=1.0),
    "cov-low": partial(noisy, worse=1.0, told=0.25),
    "cov-high": partial(noisy, worse=1.0, told=2.0),
    **{f"{hertz}hz": partial(rate, hertz=hertz) for hertz in (2, 5, 30, 60)},
    "crowd30": partial(crowd, n=30, size=(12.0, 10.0), seconds=20.0),
    "crowd100": partial(crowd, n=100, size=(25.0, 18.0), seconds=10.0),
    "runners": runners,
    "sitting": sitting,
    "groups": groups,
    "wheelchairs": wheelchairs,
    "meeting": meeting,
    **COARSE,
}
