"""People of every kind that a motion model must be good for, one at a time: simulated, or of tracks of real people.

Simulated people stroll, turn back, walk straight, run, sit, stand in a group, push a wheelchair, or walk as those of
avsim-scene do. A path is (n, 2) m on a clock of 10 Hz.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_scenes import RATE, ROOM, Rng, waypoints

HALL = 20.0  # m, side of the square in which people run


def turns_back(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Walks straight, slows down at 1 m/s², and comes back at the same speed."""
    speed = rng.uniform(0.5, 1.3)
    away = np.abs(times - rng.uniform(0.2, 0.8) * times[-1])
    return _along(rng, np.where(away < speed, away**2 / 2, speed * (away - speed / 2)))


def straight_on(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Walks straight at constant speed."""
    return _along(rng, rng.uniform(0.5, 1.5) * times)


def runs(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Runs at 3 to 5.5 m/s from place to place, and changes the velocity by 4 m/s²."""
    speed, step = rng.uniform(3.0, 5.5), 0.02
    place, target = rng.uniform(0, HALL, (2, 2))
    velocity = speed * (target - place) / np.linalg.norm(target - place)
    fine, path = np.arange(0.0, times[-1] + step, step), []
    for _ in fine:
        path.append(place)
        while np.linalg.norm(target - place) < 2.0:
            target = rng.uniform(0, HALL, 2)
        change = speed * (target - place) / np.linalg.norm(target - place) - velocity
        velocity = velocity + change * min(1.0, 4.0 * step / max(float(np.linalg.norm(change)), 1e-9))
        place = place + velocity * step
    return _at(times, fine, np.array(path))


def sits(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Sits, and sways by 2 cm."""
    return rng.uniform(0, ROOM, 2) + _wander(rng, len(times), 1.5, 0.02)


def stands(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Stands as in a group: sways by 3 cm, and steps aside every 8 s."""
    path, now = rng.uniform(0, ROOM, 2) + _wander(rng, len(times), 1.0, 0.03), 0.0
    while (now := now + rng.exponential(8.0)) < times[-1]:
        path = path + np.clip((times - now) / 0.6, 0, 1)[:, None] * rng.normal(0, 0.25, 2)
    return path


def wheels(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Pushes a wheelchair: along smooth arcs at .5 to 1.3 m/s, with stops, and speeds up by .6 m/s²."""
    count = len(times)
    wanted = np.where(rng.random(count // 40 + 1) < 0.2, 0.0, rng.uniform(0.5, 1.3, count // 40 + 1)).repeat(40)
    heading = rng.uniform(0, 2 * math.pi) + np.cumsum(_wander(rng, count, 1.5, 0.35)[:, 0]) / RATE
    speed = wanted[:count].copy()
    for k in range(1, count):
        speed[k] = speed[k - 1] + np.clip(wanted[k] - speed[k - 1], -0.6 / RATE, 0.6 / RATE)
    steps = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]) / RATE
    return rng.uniform(0, ROOM, 2) + np.cumsum(steps, axis=0)


def of_avsim(rng: Rng, times: np.ndarray) -> np.ndarray:
    """Walks, stays and sits as somebody in a random scenario of avsim-scene."""
    from avcli.scene.load import load

    people = load("random", seed=int(rng.integers(2**31)), people=3, duration=float(times[-1])).people
    return people[int(rng.integers(3))].motion.position(times)


def real(name: str, root: Path) -> list[np.ndarray]:
    """Paths of the people of a set of tracks that may decide, see `walks.DATASETS`, at 10 Hz.

    Raises:
        ValueError: the set is one that judges.
    """
    from walks import DATASETS, inside, walks_of

    if not DATASETS[name].decides:
        raise ValueError(f"the set {name} judges the tracker: nothing may be fitted to it")
    walks, size = walks_of(name, root)
    last = max(times[-1] for times, _ in walks)
    return [path for _, path in inside(walks, size, 0, math.ceil(last * RATE))]


SIMULATED: dict[str, Callable[[Rng, np.ndarray], np.ndarray]] = {
    "strolls": waypoints,
    "avsim": of_avsim,
    "turns back": turns_back,
    "straight on": straight_on,
    "runs": runs,
    "sits": sits,
    "stands": stands,
    "wheels": wheels,
}


def _along(rng: Rng, way: np.ndarray) -> np.ndarray:
    """So far (n,) m from somewhere in some direction."""
    heading = rng.uniform(0, 2 * math.pi)
    return rng.uniform(0, ROOM, 2) + way[:, None] * [math.cos(heading), math.sin(heading)]


def _at(times: np.ndarray, fine: np.ndarray, path: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(times, fine, path[:, axis]) for axis in (0, 1)])


def _wander(rng: Rng, count: int, memory: float, spread: float) -> np.ndarray:
    """An Ornstein-Uhlenbeck process at 10 Hz: (count, 2), of so many seconds of memory and such a deviation."""
    keep, value, path = math.exp(-1 / (RATE * memory)), spread * rng.standard_normal(2), []
    for _ in range(count):
        path.append(value)
        value = keep * value + spread * math.sqrt(1 - keep**2) * rng.standard_normal(2)
    return np.array(path)
