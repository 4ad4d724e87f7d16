"""Where people are in a random world: seats, circles of people who talk, and walks round furniture and each other."""

import heapq
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avcli.scene import furniture
from avcli.scene.layout import BELOW_CAMERA_M, LOW_CAMERA_M, Spot

_APART_M = 0.5  # that two walkers keep, less in a crowd
_CLEAR_M = 0.3  # that a walker keeps from furniture and walls
_STEP_S = 0.1
_PITCH_M = 0.1  # of the grid of free floor
_NEAREST, _FARTHEST_M = 10, 7.0  # places that a place of the map is joined with
_INSIDE_M, _OUTSIDE_M = 0.55, 0.9  # from a door, where people turn and where they wait
_TRIES = 40
_AWAY = 1e4  # where somebody outside counts to be


class Ground:
    """The floor on which people can walk, and a map of ways over it.

    Args:
        solids: the furniture.
        size: (3,) of the room, m.
        doors: of room_config.
        camera: (3,) m; nobody walks below one that is low.
        generator: of all chance.

    Attributes:
        nodes: (n, 2) m, places of the map; the first are those inside the doors.
        outside: (doors, 2) m, places behind the doors.
    """

    def __init__(
        self, solids: furniture.Solids, size: tuple[float, float, float], doors: list[dict[str, Any]],
        camera: tuple[float, float, float], generator: np.random.Generator,
    ) -> None:  # fmt: skip
        self.size = np.array(size[:2])
        shape = np.ceil(self.size / _PITCH_M).astype(int)
        x, y = (np.arange(n) * _PITCH_M + _PITCH_M / 2 for n in shape)
        places = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
        walls = np.minimum(places, self.size - places).min(-1) >= _CLEAR_M
        self.grid = walls
        far = np.linalg.norm(solids.half, axis=1) + _CLEAR_M
        low = np.clip(np.floor((solids.centre[:, :2] - far[:, None]) / _PITCH_M), 0, shape).astype(int)
        high = np.clip(np.ceil((solids.centre[:, :2] + far[:, None]) / _PITCH_M), 0, shape).astype(int)
        for k, ((x0, y0), (x1, y1)) in enumerate(zip(low, high, strict=True)):  # what is near each
            window = places[x0:x1, y0:y1]
            hit = furniture.blocks(solids[k : k + 1], window.reshape(-1, 2), _CLEAR_M, 2.0)
            self.grid[x0:x1, y0:y1] &= ~hit.reshape(window.shape[:2])
        if camera[2] < LOW_CAMERA_M:
            self.grid &= np.linalg.norm(places - np.array(camera[:2]), axis=-1) > BELOW_CAMERA_M
        ways = [_doorway(door, size) for door in doors]
        ways = [(inside, outside) for inside, outside in ways if self.open(inside[None])[0]]
        self.outside = np.array([outside for _, outside in ways]).reshape(-1, 2)
        wanted = int(np.clip(1.5 * self.size.prod(), 40, 220))
        found = np.argwhere(self.grid)
        drawn = found[generator.permutation(len(found))[:wanted]] if len(found) else np.zeros((0, 2))
        free = np.round((drawn + 0.5) * _PITCH_M, 2)
        self.nodes = np.concatenate([np.array([inside for inside, _ in ways]).reshape(-1, 2), free])
        self._next = self._map()

    def open(self, places: np.ndarray) -> np.ndarray:
        """Which places (n, 2) m are free, (n,) bool."""
        at = np.floor(places / _PITCH_M).astype(int)
        inside: np.ndarray = np.all((at >= 0) & (at < self.grid.shape), axis=-1)
        at = np.clip(at, 0, np.array(self.grid.shape) - 1)
        return inside & self.grid[at[..., 0], at[..., 1]]

    def sees(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether the straight ways from a (n, 2) to b (n, 2) m are free, (n,) bool."""
        longest = np.linalg.norm(b - a, axis=-1).max(initial=0.0)
        part = np.linspace(0, 1, max(int(longest / 0.08), 2))[:, None, None]
        free: np.ndarray = np.all(self.open(a + part * (b - a)), axis=0)
        return free

    def way(self, start: int, goal: int) -> np.ndarray | None:
        """The shortest way between two nodes, (m, 2) m, straightened; None: there is none."""
        if self._next[start, goal] < 0:
            return None
        route = [start]
        while route[-1] != goal:
            route.append(int(self._next[route[-1], goal]))
        points = self.nodes[route]
        kept = [0]
        while kept[-1] < len(points) - 1:
            later = np.arange(len(points) - 1, kept[-1], -1)
            seen = self.sees(np.repeat(points[kept[-1]][None], len(later), 0), points[later])
            seen[-1] = True
            kept.append(int(later[seen.argmax()]))
        return points[kept]

    def _map(self) -> np.ndarray:
        """The node after each on the shortest way to each other, (n, n), -1 where there is no way (Floyd, 1962)."""
        n = len(self.nodes)
        apart = np.linalg.norm(self.nodes[:, None] - self.nodes, axis=-1)
        near = np.argsort(apart, 1, kind="stable")[:, 1 : _NEAREST + 1]
        i, j = np.repeat(np.arange(n), near.shape[1]), near.ravel()
        kept = apart[i, j] < _FARTHEST_M
        i, j = i[kept], j[kept]
        kept = self.sees(self.nodes[i], self.nodes[j]) if len(i) else np.zeros(0, bool)
        i, j = i[kept], j[kept]
        length, after = np.full((n, n), np.inf), np.full((n, n), -1)
        length[i, j] = length[j, i] = apart[i, j]
        after[i, j], after[j, i] = j, i
        np.fill_diagonal(length, 0.0)
        np.fill_diagonal(after, np.arange(n))
        for k in range(n):
            through = length[:, k, None] + length[k]
            shorter = through < length
            length = np.where(shorter, through, length)
            after = np.where(shorter, after[:, k, None], after)
        return after


def _doorway(door: dict[str, Any], size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Places inside and outside a door, (2,) m each."""
    axis = 0 if door["wall"][0] == "x" else 1
    wall, inward = (0.0, 1.0) if door["wall"][1] == "0" else (size[axis], -1.0)
    places = []
    for off in (_INSIDE_M, -_OUTSIDE_M):
        place = np.full(2, float(door["at_m"]))
        place[axis] = wall + inward * off
        places.append(np.round(place, 2))
    return places[0], places[1]


@dataclass
class Crowd:
    """People who are being placed.

    Attributes:
        ground: on which they walk.
        duration: s.
        generator: of all chance.
        waypoints: of each person, as a scenario has them; empty: not placed yet.
        tracks: (people, times, 2) m, where each is; NaN: not placed yet.
        groups: numbers of people who talk to each other.
    """

    ground: Ground
    duration: float
    generator: np.random.Generator
    waypoints: list[list[dict[str, Any]]]
    tracks: np.ndarray
    groups: list[list[int]] = field(default_factory=list)

    @classmethod
    def of(cls, people: int, ground: Ground, duration: float, generator: np.random.Generator) -> "Crowd":
        """So many people, none of whom has a place yet."""
        times = len(np.arange(0.0, duration + _STEP_S, _STEP_S))
        return cls(ground, duration, generator, [[] for _ in range(people)], np.full((people, times, 2), np.nan))

    @property
    def times(self) -> np.ndarray:
        """Times of the tracks, s."""
        return np.arange(self.tracks.shape[1]) * _STEP_S

    def unplaced(self) -> list[int]:
        """Who has no place yet."""
        return [number for number, points in enumerate(self.waypoints) if not points]

    def take(self, number: int, spot: Spot) -> bool:
        """Let somebody stay at a spot, if nobody is too near."""
        place = np.array(spot.place)
        if self._clearance(place[None, None], self.tracks[:, :1]) < 0.45:
            return False
        poses = [str(self.generator.choice(spot.poses))]
        if self.duration > 6 and self.generator.random() < 0.4:
            poses.append(str(self.generator.choice(spot.poses)))
        at = {"position_m": list(spot.place), "heading_deg": spot.heading_deg}
        self.waypoints[number] = [
            at | {"pose": pose, "t_s": round(k * self.duration / len(poses), 2)} for k, pose in enumerate(poses)
        ]
        self.waypoints[number][-1]["stay_s"] = round(self.duration, 2)
        self.tracks[number] = place
        return True

    def circle(self, numbers: list[int]) -> bool:
        """Let people stand in a circle, who face its middle and talk; False: there is no room."""
        count, g = len(numbers), self.generator
        radius = {1: 0.0, 2: 0.45, 3: 0.55, 4: 0.65}.get(count, 0.82)
        for _ in range(_TRIES):
            middle = g.uniform(0.6, np.maximum(self.ground.size - 0.6, 0.7))
            turn = g.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / count + g.uniform(-0.15, 0.15, count)
            ring = np.round(middle + radius * np.stack([np.cos(turn), np.sin(turn)], -1), 2)
            if not self.ground.open(ring).all():
                continue
            if self._clearance(ring[:, None, None].reshape(-1, 1, 2), self.tracks[:, :1]) < 0.75:
                continue
            for number, place, angle in zip(numbers, ring, turn, strict=True):
                pose = str(g.choice(["stand", "stand", "fold", "hips"]))
                heading = round(float(np.rad2deg(angle) + 180 + g.normal(0, 8)) % 360, 1)
                point = {"position_m": place.tolist(), "heading_deg": heading, "pose": pose, "t_s": 0.0}
                self.waypoints[number] = [point | {"stay_s": round(self.duration, 2)}]
                self.tracks[number] = place
            if count > 1:
                self.groups.append(list(numbers))
            return True
        return False

    def walk(self, numbers: list[int], doors: float) -> None:
        """Let people walk about, some of them through doors.

        Someone who has arrived chooses where to go next, in the order of arrival. All others are then on a way that
        they will keep to, or stand at its end, and the new way, with the stay at its end, keeps clear of them: no two
        people meet.

        Args:
            numbers: of the people.
            doors: probability that somebody comes in or goes out.
        """
        g = self.generator
        arrivals: list[tuple[float, int]] = []
        at: dict[int, int] = {}
        ways_out = len(self.ground.outside)
        leaving: dict[int, float] = {}
        for number in numbers:
            if ways_out and g.random() < doors / 2 and self.duration > 1.0:
                door = int(g.integers(ways_out))
                at[number] = -1 - door
                self._wait_outside(number, door)
                heapq.heappush(arrivals, (round(float(g.uniform(0.2, 0.6 * self.duration)), 2), number))
                continue
            at[number] = self._start(number)
            if ways_out and g.random() < doors / 2:
                leaving[number] = float(g.uniform(0.2, 0.8)) * self.duration
            heapq.heappush(arrivals, (0.0, number))
        still = 0.0  # from then on, as far as ways are chosen now, everybody stands
        while arrivals:
            clock, number = heapq.heappop(arrivals)
            if clock >= self.duration:
                continue
            out = leaving.get(number, np.inf) <= clock
            if at[number] == _NOWHERE or (not out and at[number] >= 0 and g.random() < 0.3):
                found = None
            else:
                found = self._leg(number, at[number], clock, still, out=out)
            if found is None:
                arrival = round(clock + float(g.uniform(0.5, 2.0)), 2)
                if at[number] == _NOWHERE:
                    arrival = round(self.duration + 1, 2)
                self._stay(number, arrival)
            else:
                at[number], arrival = found
                still = max(still, arrival)
                if out:
                    continue
            heapq.heappush(arrivals, (arrival, number))

    def _start(self, number: int) -> int:
        """Let somebody stand at the node that is farthest from all others."""
        nodes, ground = self.ground.nodes, self.ground
        doors = len(ground.outside)
        if len(nodes) <= doors:  # no free floor: they stand where it is least narrow
            place = np.round(self.generator.uniform(0.4, ground.size - 0.4), 2)
            self.tracks[number] = place
            self.waypoints[number] = [{"position_m": place.tolist(), "t_s": 0.0}]
            return _NOWHERE
        others = self.tracks[~np.isnan(self.tracks[:, 0, 0]), 0]
        drawn = doors + self.generator.integers(len(nodes) - doors, size=min(24, len(nodes) - doors))
        near = np.linalg.norm(nodes[drawn][:, None] - others, axis=-1).min(1, initial=9.0)
        if near.max() < _APART_M:
            drawn = np.arange(doors, len(nodes))
            near = np.linalg.norm(nodes[drawn][:, None] - others, axis=-1).min(1, initial=9.0)
        best = int(drawn[near.argmax()])
        self.tracks[number] = nodes[best]
        self.waypoints[number] = [{"position_m": nodes[best].tolist(), "t_s": 0.0}]
        return best

    def _wait_outside(self, number: int, door: int) -> None:
        self.tracks[number] = _AWAY * (number + 1)
        self.waypoints[number] = [{"position_m": self.ground.outside[door].tolist(), "t_s": 0.0}]

    def _stay(self, number: int, until: float) -> None:
        last = self.waypoints[number][-1]
        self.waypoints[number].append({"position_m": last["position_m"], "t_s": until})

    def _leg(self, number: int, start: int, clock: float, still: float, *, out: bool) -> tuple[int, float] | None:
        """Choose somebody's next way; returns the node and the time of arrival, or None where no way is free."""
        g, nodes, ground = self.generator, self.ground.nodes, self.ground
        others = np.delete(self.tracks, number, axis=0)
        others = others[~np.isnan(others[:, 0, 0])]
        first = int(np.ceil(clock / _STEP_S - 1e-9))
        doors = len(ground.outside)
        apart = min(_APART_M, 0.5 * float(np.sqrt(ground.size.prod() / max(len(self.tracks), 1))) - 0.1)
        inside = start if start >= 0 else -1 - start
        if start >= 0:
            apart = min(apart, self._clearance(nodes[start][None, None], others[:, first:]))
        for _ in range(_TRIES):
            goal = int(g.integers(doors)) if out else int(g.integers(doors, len(nodes))) if len(nodes) > doors else 0
            if goal == inside and not out:
                continue
            if not out and self._clearance(nodes[goal][None, None], others[:, -1:]) <= apart:
                continue
            way = ground.way(inside, goal)
            if way is None:
                continue
            if start < 0:
                way = np.concatenate([ground.outside[-1 - start][None], way])
            if out:
                way = np.concatenate([way, ground.outside[goal][None]])
            lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
            way, lengths = way[np.append(True, lengths > 1e-6)], lengths[lengths > 1e-6]
            if lengths.sum() < min(0.8, 2 * apart):
                continue
            speed = float(np.clip(g.normal(1.05, 0.25), 0.5, 1.7))
            ends = np.round(clock + np.cumsum(lengths) / speed, 2)
            if (np.diff(np.append(clock, ends)) < 0.02).any():
                continue
            last = min(int(np.ceil(max(ends[-1], still) / _STEP_S)) + 1, len(self.times))
            t = self.times[first:last]
            path = np.stack([np.interp(t, np.append(clock, ends), way[:, axis]) for axis in (0, 1)], -1)
            hidden = ((path < 0) | (path > ground.size)).any(-1)
            path[hidden] = _AWAY * (number + 1)
            if self._clearance(path[None], others[:, first:last]) <= apart:
                continue
            self.tracks[number, first:last] = path
            self.tracks[number, first:] = np.where(
                (np.arange(first, len(self.times)) >= last)[:, None],
                _AWAY * (number + 1) if out else way[-1], self.tracks[number, first:],
            )  # fmt: skip
            self._stay(number, clock) if self.waypoints[number][-1]["t_s"] < clock else None
            self.waypoints[number] += [
                {"position_m": [round(float(v), 2) for v in place], "t_s": float(end)}
                for place, end in zip(way[1:], ends, strict=True)
            ]
            return goal, float(ends[-1])
        return None

    def _clearance(self, path: np.ndarray, others: np.ndarray) -> float:
        """The least distance in m that tracks (m, n, 2) keep from others' (k, n, 2)."""
        others = others[~np.isnan(others[:, 0, 0])]
        if not len(others) or not path.shape[1]:
            return 9.0
        away = path[:, None] - others
        return float(np.sqrt((away**2).sum(-1).min(initial=81.0)))


_NOWHERE = -1_000_000
"""The node of somebody who cannot go anywhere."""
