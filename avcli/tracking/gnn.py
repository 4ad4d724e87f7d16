"""Global nearest neighbour: a Kalman filter for each track, the one cheapest assignment, m-of-n confirmation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from avcli.formats.features import Feature
from avcli.numeric import assign
from avcli.tracking import gaussian
from avcli.tracking.model import Population, Track
from avcli.tracking.settings import Sensor

GATE = 13.8  # chi-squared with two degrees of freedom, 0.1 % of a track's own detections lie outside
CONFIRM, OF = 2, 3  # detections within records of the sensors that have detected the track before
GIVE_UP = 1.0  # s without any detection


@dataclass(slots=True)
class Life:
    """One track: its label (None: not confirmed), whether the last records detected it, when and by which sensors."""

    last: float
    by: set[str]
    label: int | None = None
    hits: list[bool] = field(default_factory=lambda: [True])


class GNN:
    """The baseline that most people write first; a `trackers.Tracker`.

    Source:
        S. Blackman and R. Popoli, Design and Analysis of Modern Tracking Systems, 1999, chapter 6.
    """

    def __init__(self, population: Population) -> None:
        """Begin without tracks; of the population, motion and speed are used."""
        self.population = population
        self.sensors: list[Sensor] = []
        self.column: dict[str, int] = {}
        m = len(population.motion.models)
        self.mean, self.cov, self.mode = np.zeros((0, m, 4)), np.zeros((0, m, 4, 4)), np.zeros((0, m))
        self.lives: list[Life] = []
        self.time, self.next_label = -math.inf, 0

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)

    def predict(self, time: float) -> None:
        """Predict to a time (s); a time in the past counts as the present."""
        dt = round(time - self.time, 9) if self.lives else 0.0
        self.time = max(time, self.time)
        if dt > 0:
            step = gaussian.predict(self.mean, self.cov, self.mode, self.population.motion, dt)
            self.mean, self.cov, self.mode = step.mean, step.cov, step.mode

    def update(
        self,
        time: float,
        name: str,
        z: np.ndarray,
        noise: np.ndarray,
        score: np.ndarray | None = None,
        features: Mapping[str, Feature] | None = None,
    ) -> None:
        """Update with one record of one sensor, see `trackers.Tracker.update`; scores and features are not used."""
        self.predict(time)
        sensor = self.sensors[self.column[name]]
        pairs = self._assign(z, noise, sensor.mouth_offset)
        if pairs:
            rows, js = map(list, zip(*pairs, strict=True))
            expected = gaussian.innovation(self.mean[rows], self.cov[rows], sensor.mouth_offset)
            self.mean[rows], self.cov[rows], self.mode[rows] = gaussian.update(
                self.mean[rows], self.cov[rows], self.mode[rows], z[js], noise[js], expected
            )
        detected = {row for row, _ in pairs}
        for row, life in enumerate(self.lives):
            if row in detected:
                life.hits, life.last = [*life.hits, True][-OF:], self.time
                life.by.add(name)
            elif name in life.by:
                life.hits = [*life.hits, False][-OF:]
            if life.label is None and sum(life.hits) >= CONFIRM:
                life.label, self.next_label = self.next_label, self.next_label + 1
        self._end()
        self._begin(sorted(set(range(len(z))) - {j for _, j in pairs}), z, noise, name)

    def _assign(self, z: np.ndarray, noise: np.ndarray, mouth_offset: float) -> list[tuple[int, int]]:
        """Pairs (track, detection) of the cheapest assignment within the gate, confirmed tracks first."""
        if not len(z) or not self.lives:
            return []
        log, distance = gaussian.loglikelihood(gaussian.innovation(self.mean, self.cov, mouth_offset), z, noise)
        log = np.log((self.mode[:, None] @ np.exp(log))[:, 0] + 1e-300)
        inside = distance.min(1) < GATE
        pairs: list[tuple[int, int]] = []
        taken: set[int] = set()
        for new in (False, True):
            rows = [k for k, life in enumerate(self.lives) if (life.label is None) == new]
            columns = [j for j in range(len(z)) if j not in taken]
            if not rows or not columns:
                continue
            reward = np.where(inside, 1e3 + log, 0.0)[np.ix_(rows, columns)]
            cost = np.hstack([-reward, np.zeros((len(rows), len(rows)))])  # a track may go without
            for row, k in zip(rows, assign(cost)[1].tolist(), strict=True):
                if k < len(columns) and inside[row, columns[k]]:
                    pairs.append((row, columns[k]))
                    taken.add(columns[k])
        return pairs

    def _end(self) -> None:
        """Drop the tracks that were not detected for too long, or never confirmed."""
        keep = [
            row
            for row, life in enumerate(self.lives)
            if (self.time - life.last < GIVE_UP if life.label is not None else len(life.hits) < OF)
        ]
        self.mean, self.cov, self.mode = self.mean[keep], self.cov[keep], self.mode[keep]
        self.lives = [self.lives[row] for row in keep]

    def _begin(self, js: Sequence[int], z: np.ndarray, noise: np.ndarray, name: str) -> None:
        """Begin a track with each of the detections js."""
        mean, cov, mode = gaussian.begin(z[js], noise[js], self.population.motion)
        self.mean, self.cov = np.concatenate([self.mean, mean]), np.concatenate([self.cov, cov])
        self.mode = np.concatenate([self.mode, mode])
        self.lives += [Life(self.time, {name}) for _ in js]

    def tracks(self, time: float) -> list[Track]:
        """Return the confirmed tracks at a time (s) not before the last record, by label."""
        self.predict(time)
        confirmed = [(row, life.label, life.last) for row, life in enumerate(self.lives) if life.label is not None]
        if not confirmed:
            return []
        rows = [row for row, *_ in confirmed]
        mean, cov = gaussian.moments(self.mean[rows], self.cov[rows], self.mode[rows])
        tracks = [
            Track(label, mean[k], cov[k], math.exp(last - self.time), last_seen=last)
            for k, (_, label, last) in enumerate(confirmed)
        ]
        return sorted(tracks, key=lambda track: track.label)
