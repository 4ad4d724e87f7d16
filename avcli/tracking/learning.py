"""What a run learns of how people use the room: where they come and where they leave."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from operator import mul
from typing import Any

import numpy as np

from avcli.tracking.densities import Densities
from avcli.tracking.model import Population
from avcli.tracking.places import Places
from avcli.tracking.trust import Absences

# Expected events that the prior is worth, in the whole area and at one place.
EXITS, ENTRIES = (1.0, 0.2), (3.0, 1.0)
SURE_HITS, SURE = 3, 5.0  # detections, and nats, from which on a track certainly was a person
AT_START = 1.0  # s; who is detected first before was there already
PAUSE = 60.0  # s without a record, after which it is as at the start: who left and who came meanwhile, nobody knows
REFRESH = 1.0  # s between two computations of the maps
MEMORY = 1800.0  # s, over which what was learnt is forgotten


class Habits:
    """Where people come and leave: a prior of the population's, times factors learnt from tracks that begin and end.

    Attributes:
        exits: of the rate at which people leave.
        entries: of the rate at which they come; of that at which they are found, if `in_part`.
        in_part: whether sensors cover the area in part: who comes is found later, elsewhere, see `unseen`.
    """

    def __init__(self, population: Population, learn: bool) -> None:
        """Begin with the prior; with `learn` false it stays."""
        self.population, self.learn = population, learn
        self.exits, self.entries = Places(population.area, *EXITS), Places(population.area, *ENTRIES)
        self.absences = Absences()  # of this run
        self._fresh: dict[int, np.ndarray] = {}  # label -> where it began, until it certainly is a person
        self._came: dict[int, np.ndarray] = {}  # label -> where it was counted as having come
        self._gone: dict[int, np.ndarray] = {}  # label -> where it was counted as having left
        cells = self.entries.centres().reshape(-1, 2)
        self._arrivals = population.density(cells, *population.birth_rate).reshape(self.entries.shape)
        self._arrivals *= self.entries.step**2
        self.in_part = False
        self._begin: float | None = None
        self._waited = 0.0  # s, and below: states, and gaps in s; not yet in the maps
        self._stays: list[tuple[np.ndarray, list[float]]] = []
        self._now = 0.0
        self._refreshed = 0.0
        self.log_clutter: list[float] = []  # of false detections expected in a record of each sensor

    def state(self) -> dict[str, Any]:
        """Return what was learnt, as `restore` takes it."""
        self._enter()
        return {
            "area": self.population.corners.ravel().tolist(),
            "exits": self.exits.state(),
            "entries": self.entries.state(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what another run has learnt.

        Raises:
            ValueError: it was learnt in a room of another size.
        """
        if not np.allclose(state["area"], self.population.corners.ravel(), atol=0.01):
            raise ValueError("it was learnt in a room of another size")
        self.exits.restore(state["exits"])
        self.entries.restore(state["entries"])

    def leaving(self, states: np.ndarray) -> np.ndarray:
        """Return the rate (n,) per second at which people in states (n, 4) m and m/s leave the room."""
        return self.population.leaving(states) * self.exits.at(states[:, :2])

    def wait(self, time: float, dt: float) -> None:
        """Note that dt s have passed up to a time in s."""
        if self._begin is None:
            self._begin = self._refreshed = time - dt
        if dt > PAUSE:
            self._begin, dt = time, 0.0
            self._fresh.clear()
        self._now = time
        if not self.learn:
            return
        if not self.in_part:
            self._waited += dt
        past = time - self._refreshed
        if past >= REFRESH:
            self._enter()
            for places in (self.exits, self.entries):
                places.fade(math.exp(-past / MEMORY))
                places.refresh()
            self._refreshed = time

    def reveal(self, positions: np.ndarray, numbers: np.ndarray) -> None:
        """Note that a record should show so many people (n,) at positions (n, 2) m who were not detected before."""
        if self.learn and self._begin is not None and self._now > self._begin + AT_START:
            self.entries.expect(positions, numbers)

    def stayed(self, states: np.ndarray, gaps: list[float]) -> None:
        """Note that people in states (n, 4) m and m/s were there all the time since n gaps of s ago."""
        if self.learn:
            self._stays.append((states, gaps))

    def _enter(self) -> None:
        """Enter into the maps what was expected since the last time, all at once: that costs less."""
        self.entries.expected += self._arrivals * self._waited
        self._waited = 0.0
        if self._stays:
            states = np.concatenate([states for states, _ in self._stays])
            gaps = np.array([gap for _, gaps in self._stays for gap in gaps])
            self.exits.expect(states[:, :2], self.population.leaving(states) * gaps)
            self._stays = []

    def _happen(self, places: Places, place: np.ndarray, number: float = 1.0) -> None:
        self._enter()
        places.happen(place, number)

    def began(self, label: int, position: np.ndarray, time: float) -> None:
        """Note that a new track began at a position (2,) m and a time in s."""
        if self.learn and self._begin is not None and time > self._begin + AT_START:
            self._fresh[label] = position.copy()

    def sure(self, people: Densities, row: int, log_clutter: Sequence[float] | None = None) -> bool:
        """Return whether the detections of a row certainly were a person's, by what is known of clutter now.

        log_clutter: of false detections expected in a record of each sensor; None: as is known.
        """
        hits, log_clutter = people.hits[row].tolist(), self.log_clutter if log_clutter is None else log_clutter
        return sum(hits) >= SURE_HITS and float(people.told[row]) - sum(map(mul, hits, log_clutter)) > SURE

    def confirm(self, people: Densities, rows: Iterable[int]) -> None:
        """Count the arrival of those of some rows who are certainly people by now."""
        if not self._fresh:
            return
        for row in rows:
            if self.sure(people, row) and (place := self._fresh.pop(people.label[row], None)) is not None:
                self._came[people.label[row]] = place
                self._happen(self.entries, place)

    def ended(self, label: int, people: Densities, row: int) -> None:
        """Note that a label hardly exists any more, whose best density is a row."""
        self._fresh.pop(label, None)
        watched = self._begin is None or people.seen[row].max() >= self._begin
        if self.learn and watched and self.sure(people, row):
            self._gone[label] = people.place[row].copy()
            self.absences.left += 1
            self._happen(self.exits, self._gone[label])

    def was_false(self, label: int) -> None:
        """Note that a label was no person."""
        self._fresh.pop(label, None)
        if (place := self._came.pop(label, None)) is not None:
            self._happen(self.entries, place, -1.0)

    def came_back(self, label: int) -> None:
        """Note that somebody who was counted as having left was only hidden."""
        if (place := self._gone.pop(label, None)) is not None:
            self.absences.left -= 1
            self._happen(self.exits, place, -1.0)

    def forget(self, labels: Iterable[int]) -> None:
        """Forget about labels other than these."""
        wanted = set(labels)
        for noted in (self._fresh, self._came, self._gone):
            for label in noted.keys() - wanted:
                del noted[label]
