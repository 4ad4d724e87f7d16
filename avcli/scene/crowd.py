"""Random scenarios: people who walk between places of their choice, sit, and take turns to speak."""

import numpy as np

from avcli.scene.people import LOOKS

_APART_M = 0.5  # that two walkers keep
_CLEAR_M = 0.3  # that a walker keeps from furniture and walls
_STEP_S = 0.1


def random(people, duration, generator, room=(4.66, 4.66, 3.0)):
    """Make a random scenario.

    Args:
        people: how many; who finds no free way stands still.
        duration: s.
        generator: numpy Generator.
        room: (3,) m.

    Returns:
        A scenario's JSON object.
    """
    width, depth, _ = room
    tables, chairs = _furnish(width, depth, generator)
    obstacles = [(*t["position_m"], 0.5 * t["size_m"][0], 0.5 * t["size_m"][1]) for t in tables]
    obstacles += [(*c["position_m"], 0.23, 0.23) for c in chairs]
    times = np.arange(0.0, duration + _STEP_S, _STEP_S)
    tracks, persons = [], []
    names = list(LOOKS)
    order = generator.permutation(max(people, 1))
    for number in range(people):
        look = names[int(order[number]) % len(names)]
        person = {"object_id": number, "look": look}
        person["height_m"] = round(float(np.clip(generator.normal(LOOKS[look].height, 0.04), 1.5, 1.95)), 2)
        if number < len(chairs) and number % 3 == 2:
            chair = chairs[number]
            person["waypoints"] = [
                {
                    "position_m": chair["position_m"],
                    "heading_deg": chair["rotation_deg"],
                    "pose": "sit",
                    "stay_s": duration,
                }
            ]
            tracks.append(np.tile(chair["position_m"], (len(times), 1)))
        else:
            person["waypoints"], track = _wander(times, tracks, obstacles, width, depth, generator)
            tracks.append(track)
        persons.append(person)
    for person, turns in zip(persons, _turns(people, duration, generator), strict=True):
        person["speech_s"] = turns
    return {
        "name": "random",
        "duration_s": float(duration),
        "room_config": {"room_dimensions_m": [float(v) for v in room], "reverberation_time_s": 0.35},
        "furniture": [*tables, *chairs],
        "people": persons,
    }


def _furnish(width, depth, generator):
    """Tables along two walls, and chairs at their ends."""
    tables, chairs = [], []
    for y in (0.45, depth - 0.45):
        length = round(float(generator.uniform(1.0, 1.5)), 2)
        x = round(float(generator.uniform(0.8 + length / 2, width - 0.8 - length / 2)), 2)
        tables.append({"kind": "table", "position_m": [x, y], "size_m": [length, 0.62, 0.74]})
        side = 1 if x < width / 2 else -1
        place = [round(x + side * (length / 2 + 0.28), 2), y]
        chairs.append({"kind": "chair", "position_m": place, "rotation_deg": 180.0 if side > 0 else 0.0})
    chairs.append({"kind": "chair", "position_m": [0.4, round(depth / 2, 2)], "rotation_deg": 0.0})
    return tables, chairs


def _wander(times, tracks, obstacles, width, depth, generator):
    """Waypoints of one walk that keeps clear of furniture and of the tracks so far, and its track (n, 2)."""
    low, high = [_CLEAR_M, _CLEAR_M], [width - _CLEAR_M, depth - _CLEAR_M]
    starts = np.round(generator.uniform(low, high, (200, 2)), 2)
    place = max(starts, key=lambda p: _clearance(p[None], np.zeros(1, int), tracks, obstacles))
    waypoints = [{"position_m": place.tolist(), "t_s": 0.0}]
    track, clock, filled = np.tile(place, (len(times), 1)), 0.0, 1
    while filled < len(times):
        best = None
        for attempt in range(60):
            # Now and then one stays for a moment; who finds no way waits for a second.
            waits = attempt == 0 and generator.uniform() < 0.3
            target = place if waits else np.round(generator.uniform(low, high), 2)
            distance = float(np.linalg.norm(target - place))
            if not waits and distance < 0.8:
                continue
            speed = float(np.clip(generator.normal(1.05, 0.25), 0.5, 1.7))
            arrival = round(clock + (generator.uniform(0.5, 2.0) if waits else distance / speed), 2)
            index = np.arange(filled, min(int(arrival / _STEP_S) + 1, len(times)))
            way = place + ((times[index] - clock) / (arrival - clock))[:, None] * (target - place)
            clearance = _clearance(way, index, tracks, obstacles)
            if best is None or clearance > best[0]:
                best = clearance, target, arrival, index, way
            if clearance > _APART_M:
                break
        _, place, clock, index, way = best
        track[index] = way
        track[index[-1] + 1 if len(index) else filled :] = place
        filled = index[-1] + 1 if len(index) else filled
        waypoints.append({"position_m": place.tolist(), "t_s": clock})
    return waypoints, track


def _clearance(way, index, tracks, obstacles):
    """The least distance that a way (n, 2) at times of the given index keeps from other tracks, -1 in furniture."""
    for x, y, half_x, half_y in obstacles:
        if (np.maximum(np.abs(way[:, 0] - x) - half_x, np.abs(way[:, 1] - y) - half_y) < _CLEAR_M).any():
            return -1.0
    return min((float(np.linalg.norm(way - track[index], axis=1).min(initial=9.0)) for track in tracks), default=9.0)


def _turns(people, duration, generator):
    """Who speaks when: one after another, with short pauses and now and then an overlap."""
    turns = [[] for _ in range(people)]
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
