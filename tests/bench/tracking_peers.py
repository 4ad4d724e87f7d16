"""Trackers that others use, on points in metres instead of boxes in pixels, to compare avfuse's with.

SORT, ByteTrack and OC-SORT are written here from their papers: distance in m stands for one minus the intersection over
union, seconds stand for frames, and each sensor's records are associated one after the other, the sharpest first. They
have constant-velocity Kalman filters and the noise that the detections state. `make` registers them beside avfuse's
own for the time of the bench; Stone Soup's associators are there where it is installed.

Their parameters are in tracking_peers.json, which fit_tracking_peers.py writes.
"""

import datetime
import importlib.util
import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from avcli.tracking.model import Population, Track
from avcli.tracking.settings import Sensor, Settings
from avcli.tracking.trackers import TRACKERS, Entry

SPEED = 0.7  # m/s, standard deviation of each velocity component of a new track
FAR = 1e6


@dataclass(frozen=True)
class Parameters:
    """What is tuned of a peer.

    Attributes:
        reach, ear: m, the farthest that a detection of the sharpest sensor, of another one, may be from its track.
        hits: records with detections before a track counts.
        doubt: s without a detection after which a track that does not count yet ends.
        age: s without a detection after which a track ends.
        shown: s without a detection for which a track is reported.
        noise: m / s^1.5, square root of the acceleration's power spectral density.
        momentum: weight of the change of direction, in OC-SORT.
    """

    reach: float = 1.0
    ear: float = 1.0
    hits: int = 3
    doubt: float = 0.15
    age: float = 1.0
    shown: float = 0.35
    noise: float = 0.5
    momentum: float = 0.2


FITTED = Path(__file__).with_suffix(".json")
TUNED = {name: Parameters(**one) for name, one in json.loads(FITTED.read_text())["parameters"].items()}


@dataclass
class Life:
    """One track.

    Attributes:
        mean, cov: (4,), (4, 4) of x, y, vx, vy, at the last record.
        last: s, of the last detection.
        anchor: time, mean and cov after it.
        observed: (time s, xy (2,) m) of its detections.
    """

    mean: np.ndarray
    cov: np.ndarray
    last: float
    hits: int = 1
    label: int | None = None
    observed: list[tuple[float, np.ndarray]] = field(default_factory=list)
    anchor: tuple[float, np.ndarray, np.ndarray] = (0.0, np.zeros(4), np.zeros((4, 4)))


def moved(mean: np.ndarray, cov: np.ndarray, dt: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A constant-velocity state (4,) and covariance (4, 4) dt s later."""
    step = np.eye(4)
    step[0, 2] = step[1, 3] = dt
    q = noise**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    return step @ mean, step @ cov @ step.T + q


def corrected(mean: np.ndarray, cov: np.ndarray, z: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A state and covariance after a detection z (2,) with covariance noise (2, 2)."""
    gain = np.linalg.solve(cov[:2, :2] + noise, cov[:2]).T
    cov = cov - gain @ cov[:2]
    return mean + gain @ (z - mean[:2]), (cov + cov.T) / 2


def assigned(cost: np.ndarray, allowed: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (row, column) of the cheapest assignment with as many allowed pairs as can be: (n, m), (n, m)."""
    rows, columns = linear_sum_assignment(np.where(allowed, cost, FAR))
    return [(r, c) for r, c in zip(rows.tolist(), columns.tolist(), strict=True) if allowed[r, c]]


class Sort:
    """SORT: Bewley, Ge, Ott, Ramos, Upcroft, Simple online and realtime tracking, ICIP 2016."""

    name = "sort"

    def __init__(self, parameters: Parameters | None = None) -> None:
        self.parameters = parameters or TUNED[self.name]
        self.sensors: list[Sensor] = []
        self.column: dict[str, int] = {}
        self.lives: list[Life] = []
        self.time, self.labels = -math.inf, itertools.count()

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)

    def predict(self, time: float) -> None:
        """Predict to a time (s); a time in the past counts as the present."""
        dt = round(time - self.time, 9) if self.lives else 0.0
        self.time = max(time, self.time)
        if dt > 0:
            for life in self.lives:
                life.mean, life.cov = moved(life.mean, life.cov, dt, self.parameters.noise)

    def update(self, time: float, name: str, z: np.ndarray, noise: np.ndarray, *unused: Any) -> None:
        """Update with one record of one sensor, see avcli's `trackers.Tracker.update`; only positions are used."""
        self.predict(time)
        sharp = self.sensors[self.column[name]].sigma <= min(one.sigma for one in self.sensors)
        pairs = self.associate(z, sharp) if len(z) and self.lives else []
        for row, j in pairs:
            life = self.lives[row]
            self.revive(life, z[j], noise[j])
            life.mean, life.cov = corrected(life.mean, life.cov, z[j], noise[j])
            life.hits += life.last < self.time
            life.last, life.anchor = self.time, (self.time, life.mean, life.cov)
            life.observed = [*life.observed, (self.time, z[j])][-10:]
            if life.label is None and life.hits >= self.parameters.hits:
                life.label = next(self.labels)
        self.lives = [life for life in self.lives if self.time - life.last < self.patience(life)]
        if self.begins(sharp):
            for j in sorted(set(range(len(z))) - {j for _, j in pairs}):
                cov = np.zeros((4, 4))
                cov[:2, :2], cov[2:, 2:] = noise[j], SPEED**2 * np.eye(2)
                mean = np.array([*z[j], 0.0, 0.0])
                label = next(self.labels) if self.parameters.hits < 2 else None
                anchor = (self.time, mean, cov)
                self.lives.append(Life(mean, cov, self.time, 1, label, [(self.time, z[j])], anchor))

    def patience(self, life: Life) -> float:
        """Seconds without a detection after which a track ends."""
        return self.parameters.doubt if life.label is None else self.parameters.age

    def begins(self, sharp: bool) -> bool:
        """Whether tracks begin with detections of the sharpest sensor, or of another one."""
        return True

    def revive(self, life: Life, z: np.ndarray, noise: np.ndarray) -> None:
        """Prepare a track for a detection."""

    def distances(self, rows: Sequence[int], z: np.ndarray) -> np.ndarray:
        """Distances in m of tracks and detections, (n, J)."""
        return np.linalg.norm(np.array([self.lives[r].mean[:2] for r in rows])[:, None] - z[None], axis=2)

    def associate(self, z: np.ndarray, sharp: bool) -> list[tuple[int, int]]:
        """Pairs (track, detection)."""
        rows = range(len(self.lives))
        distance = self.distances(rows, z)
        return assigned(distance, distance < (self.parameters.reach if sharp else self.parameters.ear))

    def tracks(self, time: float) -> list[Track]:
        """The tracks that count, at a time (s) not before the last record, by label."""
        self.predict(time)
        return sorted(
            (
                Track(life.label, life.mean, life.cov, 1.0)
                for life in self.lives
                if life.label is not None and self.time - life.last <= self.parameters.shown + 1e-9
            ),
            key=lambda track: track.label,
        )


class ByteTrack(Sort):
    """ByteTrack: Zhang et al., ByteTrack: multi-object tracking by associating every detection box, ECCV 2022.

    Detections of a vaguer sensor are its detections with a low score: they keep tracks that were detected just now and
    are left over, and begin none.
    """

    name = "bytetrack"

    def begins(self, sharp: bool) -> bool:
        return sharp

    def associate(self, z: np.ndarray, sharp: bool) -> list[tuple[int, int]]:
        if sharp:
            rows = [k for k, life in enumerate(self.lives) if life.label is not None]
            pairs = self._within(rows, range(len(z)), z, self.parameters.reach)
            left = [j for j in range(len(z)) if j not in {j for _, j in pairs}]
            new = [k for k, life in enumerate(self.lives) if life.label is None]
            return pairs + self._within(new, left, z, self.parameters.reach)
        recent = self.parameters.doubt
        rows = [k for k, life in enumerate(self.lives) if self.time > life.last >= self.time - recent]
        return self._within(rows, range(len(z)), z, self.parameters.ear)

    def _within(self, rows: Sequence[int], js: Sequence[int], z: np.ndarray, reach: float) -> list[tuple[int, int]]:
        if not rows or not js:
            return []
        distance = self.distances(rows, z[list(js)])
        return [(rows[r], js[c]) for r, c in assigned(distance, distance < reach)]


class OcSort(Sort):
    """OC-SORT: Cao, Pang, Weng, Khirodkar, Kitani, Observation-centric SORT, CVPR 2023.

    With its momentum (section 4.2), its recovery from the last observation (appendix), and its re-update (4.1).
    """

    name = "oc-sort"
    before = 0.3  # s, over which a direction is measured

    def associate(self, z: np.ndarray, sharp: bool) -> list[tuple[int, int]]:
        rows, reach = range(len(self.lives)), self.parameters.reach if sharp else self.parameters.ear
        distance = self.distances(rows, z)
        turn = np.array([self._turn(life, z) for life in self.lives])
        pairs = assigned(distance / reach + self.parameters.momentum * turn, distance < reach)
        left = [r for r in rows if r not in {r for r, _ in pairs}]
        free = [j for j in range(len(z)) if j not in {j for _, j in pairs}]
        if left and free:
            last = np.array([self.lives[r].observed[-1][1] for r in left])
            distance = np.linalg.norm(last[:, None] - z[free][None], axis=2)
            pairs += [(left[r], free[c]) for r, c in assigned(distance, distance < reach)]
        return pairs

    def _turn(self, life: Life, z: np.ndarray) -> np.ndarray:
        """Change of direction that each detection (J, 2) means, from 0 to 1."""
        when, last = life.observed[-1]
        earlier = [xy for t, xy in life.observed if t <= when - self.before + 1e-9]
        if not earlier:
            return np.zeros(len(z))
        way, new = last - earlier[-1], z - earlier[-1]
        cosine = new @ way / np.maximum(np.linalg.norm(new, axis=1) * np.linalg.norm(way), 1e-9)
        return np.arccos(np.clip(cosine, -1, 1)) / math.pi

    def revive(self, life: Life, z: np.ndarray, noise: np.ndarray) -> None:
        """Track again from the last observation, through places between it and the new one."""
        begin, mean, cov = life.anchor
        steps = round((self.time - begin) / 0.1)
        if steps < 2:
            return
        dt, first = (self.time - begin) / steps, life.observed[-1][1]
        for k in range(1, steps):
            mean, cov = moved(mean, cov, dt, self.parameters.noise)
            mean, cov = corrected(mean, cov, first + (z - first) * k / steps, noise)
        life.mean, life.cov = moved(mean, cov, dt, self.parameters.noise)


class StoneSoupGnn(Sort):
    """Stone Soup's global nearest neighbour: its hypothesiser by Mahalanobis distance and its 2-D assignment.

    Barr et al., Stone Soup open source framework for tracking and state estimation: enhancements, SPIE 2022. Tracks
    begin and end as those of SORT here.
    """

    name = "sort"
    gate = 3.7  # 0.1 % of a track's own detections lie outside

    def associate(self, z: np.ndarray, sharp: bool) -> list[tuple[int, int]]:
        from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
        from stonesoup.hypothesiser.distance import DistanceHypothesiser
        from stonesoup.measures import Mahalanobis
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
        from stonesoup.predictor.kalman import KalmanPredictor
        from stonesoup.types.detection import Detection
        from stonesoup.types.state import GaussianState
        from stonesoup.types.track import Track as History
        from stonesoup.updater.kalman import KalmanUpdater

        now, axis = datetime.datetime(2000, 1, 1), ConstantVelocity(self.parameters.noise**2)
        predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))
        order = [0, 2, 1, 3]
        histories = [
            History([GaussianState(one.mean[order, None], one.cov[np.ix_(order, order)], timestamp=now)])
            for one in self.lives
        ]
        found = [
            Detection(one[:, None], timestamp=now, measurement_model=LinearGaussian(4, (0, 2), self.noise[j]))
            for j, one in enumerate(z)
        ]
        updater = KalmanUpdater(LinearGaussian(4, (0, 2), np.eye(2)))
        hypothesiser = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=self.gate)
        chosen = GNNWith2DAssignment(hypothesiser).associate(histories, found, now)
        at = {id(one): j for j, one in enumerate(found)}
        return [(row, at[id(chosen[one].measurement)]) for row, one in enumerate(histories) if chosen[one]]

    def update(self, time: float, name: str, z: np.ndarray, noise: np.ndarray, *unused: Any) -> None:
        self.noise = noise
        super().update(time, name, z, noise)


PEERS: dict[str, tuple[str, type[Sort]]] = {
    "sort": ("SORT", Sort),
    "bytetrack": ("ByteTrack", ByteTrack),
    "oc-sort": ("OC-SORT", OcSort),
}
if importlib.util.find_spec("stonesoup"):
    PEERS["stonesoup-gnn"] = ("Stone Soup's GNN", StoneSoupGnn)


def register() -> None:
    """Let `Fusion` know the peers by their names."""

    def made(kind: type[Sort]) -> Callable[[Settings, Population, bool, bool], Any]:
        return lambda settings, population, record, explain: kind()

    for name, (text, kind) in PEERS.items():
        TRACKERS[name] = Entry(text, made(kind))
