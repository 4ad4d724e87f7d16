"""Random scenarios: people who walk between places of their choice, sit, and take turns to speak."""

import heapq
from typing import Any

import numpy as np

from avcli.scene.people import LOOKS

_APART_M = 0.5  # that two walkers keep, less in a crowd
_CLEAR_M = 0.3  # that a walker keeps from furniture and walls
_STEP_S = 0.1


def random(
    people: int,
    duration: float,
    generator: np.random.Generator,
    room: tuple[float, float, float] = (4.66, 4.66, 3.0),
) -> dict[str, Any]:
    """Make a random scenario.

    Args:
        people: how many; a person who finds no free way stands still.
        duration: s.
        generator: of all chance.
        room: (3,) m.

    Returns:
        A scenario's JSON object.
    """
    width, depth, _ = room
    tables, chairs = _furnish(width, depth, generator)
    obstacles = [(*t["position_m"], 0.5 * t["size_m"][0], 0.5 * t["size_m"][1]) for t in tables]
    obstacles += [(*c["position_m"], 0.23, 0.23) for c in chairs]
    persons: list[dict[str, Any]] = []
    seats = np.full((people, 2), np.nan)
    names = list(LOOKS)
    order = generator.permutation(max(people, 1))
    for number in range(people):
        look = names[int(order[number]) % len(names)]
        person: dict[str, Any] = {"object_id": number, "look": look}
        person["height_m"] = round(float(np.clip(generator.normal(LOOKS[look].height, 0.04), 1.5, 1.95)), 2)
        if number < len(chairs) and number % 3 == 2:
            chair = chairs[number]
            seats[number] = chair["position_m"]
            seat = {"position_m": chair["position_m"], "heading_deg": chair["rotation_deg"], "pose": "sit"}
            person["waypoints"] = [seat | {"stay_s": duration}]
        persons.append(person)
    for number, waypoints in _walks(seats, duration, obstacles, width, depth, generator).items():
        persons[number]["waypoints"] = waypoints
    for person, turns in zip(persons, _turns(people, duration, generator), strict=True):
        person["speech_s"] = turns
    return {
        "name": "random",
        "duration_s": float(duration),
        "room_config": {"room_dimensions_m": [float(v) for v in room], "reverberation_time_s": 0.35},
        "furniture": [*tables, *chairs],
        "people": persons,
    }


def _furnish(
    width: float, depth: float, generator: np.random.Generator
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Tables along two walls, and chairs at their ends."""
    tables: list[dict[str, Any]] = []
    chairs: list[dict[str, Any]] = []
    for y in (0.45, depth - 0.45):
        length = round(float(generator.uniform(1.0, 1.5)), 2)
        x = round(float(generator.uniform(0.8 + length / 2, width - 0.8 - length / 2)), 2)
        tables.append({"kind": "table", "position_m": [x, y], "size_m": [length, 0.62, 0.74]})
        side = 1 if x < width / 2 else -1
        place = [round(x + side * (length / 2 + 0.28), 2), y]
        chairs.append({"kind": "chair", "position_m": place, "rotation_deg": 180.0 if side > 0 else 0.0})
    chairs.append({"kind": "chair", "position_m": [0.4, round(depth / 2, 2)], "rotation_deg": 0.0})
    return tables, chairs


def _walks(
    seats: np.ndarray,
    duration: float,
    obstacles: list[tuple[float, ...]],
    width: float,
    depth: float,
    generator: np.random.Generator,
) -> dict[int, list[dict[str, Any]]]:
    """Waypoints of those without a seat (a row of NaN in seats (people, 2)), by number.

    A person who has arrived chooses where to go next, in the order of arrival. All others are then on a path that they
    will keep to, or stand at its end, and the new path, with the stay at its end, keeps clear of them: no two people
    meet.
    """
    low, high = [_CLEAR_M, _CLEAR_M], [width - _CLEAR_M, depth - _CLEAR_M]
    times = np.arange(0.0, duration + _STEP_S, _STEP_S)
    tracks = np.repeat(seats[:, None], len(times), axis=1)
    apart = min(_APART_M, 0.5 * np.sqrt(width * depth / max(len(seats), 1)) - 0.1)
    walks: dict[int, list[dict[str, Any]]] = {int(number): [] for number in np.flatnonzero(np.isnan(seats[:, 0]))}
    for number, waypoints in walks.items():
        starts = np.round(generator.uniform(low, high, (400, 2)), 2)
        others = tracks[~np.isnan(tracks[:, 0, 0]), :1]
        place = max(starts, key=lambda p: _clearance(p[None], others, obstacles))
        tracks[number] = place
        waypoints.append({"position_m": place.tolist(), "t_s": 0.0})
    arrivals = [(0.0, number) for number in walks]
    still = 0.0  # from then on, as far as paths are chosen now, everybody stands
    while arrivals:
        clock, number = heapq.heappop(arrivals)
        if clock >= duration:
            continue
        place, others = np.array(walks[number][-1]["position_m"], float), np.delete(tracks, number, axis=0)
        first = int(np.ceil(clock / _STEP_S - 1e-9))
        enough = min(apart, _clearance(place[None], others[:, first:], obstacles))
        arrival = round(
            clock + float(generator.uniform(0.5, 2.0)), 2
        )  # without a free path they wait, as some do anyway
        target = place
        for _ in range(0 if generator.uniform() < 0.3 else 60):
            goal = np.round(generator.uniform(low, high), 2)
            distance = float(np.linalg.norm(goal - place))
            if distance < min(0.8, 2 * apart) or _clearance(goal[None], others[:, -1:], obstacles) <= enough:
                continue
            speed = float(np.clip(generator.normal(1.05, 0.25), 0.5, 1.7))
            end = round(clock + distance / speed, 2)
            last = min(int(np.ceil(max(end, still) / _STEP_S)) + 1, len(times))
            part = np.clip((times[first:last] - clock) / (end - clock), 0, 1)[:, None]
            path = place + part * (goal - place)
            if _clearance(path, others[:, first:last], obstacles) > enough:
                target, arrival, still = goal, end, max(still, end)
                tracks[number, first:], tracks[number, first:last] = goal, path
                break
        walks[number].append({"position_m": target.tolist(), "t_s": arrival})
        heapq.heappush(arrivals, (arrival, number))
    return walks


def _clearance(path: np.ndarray, others: np.ndarray, obstacles: list[tuple[float, ...]]) -> float:
    """The least distance in m that a path (n, 2) keeps from others' tracks (m, n, 2), -1 in furniture."""
    for x, y, half_x, half_y in obstacles:
        if (np.maximum(np.abs(path[:, 0] - x) - half_x, np.abs(path[:, 1] - y) - half_y) < _CLEAR_M).any():
            return -1.0
    return float(np.sqrt(((path - others) ** 2).sum(axis=2).min(initial=81.0)))


def _turns(people: int, duration: float, generator: np.random.Generator) -> list[list[list[float]]]:
    """Turns [begin, end] of each person: one speaks after another, with short pauses and now and then an overlap."""
    turns: list[list[list[float]]] = [[] for _ in range(people)]
    clock, last = float(generator.uniform(0.0, 0.5)), -1
    while people and clock < duration:
        others = [p for p in range(people) if p != last] or [0]
        last = int(generator.choice(others))
        length = float(np.clip(generator.exponential(2.5), 0.8, 8.0))
        begin, end = round(clock, 2), round(min(clock + length, duration), 2)
        if end > begin and (not turns[last] or begin >= turns[last][-1][1]):
            turns[last].append([begin, end])
        clock = end + float(generator.normal(0.25, 0.35))
        clock = max(clock, begin + 0.3)
    return turns
