"""Joint probabilistic data association by Stone Soup, an optional package."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avcli.formats.features import Feature
from avcli.tracking.model import Population, Track
from avcli.tracking.settings import Sensor

GATE = 0.9999
CONFIRM = 2  # detections before a track counts
GIVE_UP = 1.0  # s without any detection
NOISE = 0.5  # m / s^1.5, square root of the acceleration's power spectral density


@dataclass
class Life:
    """One track: Stone Soup's own, its label (None: not confirmed), how often and when it was detected."""

    track: Any
    last: float
    count: int = 1
    label: int | None = None


class JPDA:
    """Stone Soup's JPDA with constant-velocity Kalman filters (stonesoup 1.9); a `trackers.Tracker`.

    Source:
        Y. Bar-Shalom and X. R. Li, Multitarget-Multisensor Tracking: Principles and Techniques, 1995, section 6.2.
    """

    def __init__(self, population: Population) -> None:
        """Begin without tracks; of the population, area and speed are used.

        Raises:
            ValueError: Stone Soup is not installed.
        """
        try:
            from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
            from stonesoup.predictor.kalman import KalmanPredictor
        except ModuleNotFoundError:
            raise ValueError("--tracker jpda needs Stone Soup: pip install stonesoup") from None
        axis = ConstantVelocity(NOISE**2)
        self.predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))
        self.population = population
        self.sensors: list[Sensor] = []
        self.column: dict[str, int] = {}
        self.lives: list[Life] = []
        self.next_label, self.time = 0, 0.0

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)

    def predict(self, time: float) -> None:
        """Note the time (s); Stone Soup predicts where a state is asked for."""
        self.time = max(self.time, time)

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
        from stonesoup.dataassociator.probability import JPDA as Associator
        from stonesoup.hypothesiser.probability import PDAHypothesiser
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.types.detection import Detection
        from stonesoup.updater.kalman import KalmanUpdater

        self.predict(time)
        sensor = self.sensors[self.column[name]]
        now = _clock(self.time)
        detections = [
            Detection(position[:, None], timestamp=now, measurement_model=LinearGaussian(4, (0, 2), cov))
            for position, cov in zip(z, noise, strict=True)
        ]
        updater = KalmanUpdater(LinearGaussian(4, (0, 2), np.eye(2)))
        p_detect = sensor.detection * sensor.detectable()
        density = max(sensor.clutter, 1e-6) / self.population.surface
        hypothesiser = PDAHypothesiser(self.predictor, updater, density, prob_detect=p_detect, prob_gate=GATE)
        explained = np.zeros(len(detections))
        if self.lives and detections:
            at = {id(one): j for j, one in enumerate(detections)}
            tracks = [life.track for life in self.lives]
            chosen = Associator(hypothesiser=hypothesiser).associate(tracks, detections, now)
            for life in self.lives:
                self._update(life, chosen[life.track], updater, at, explained)
        self.lives = [life for life in self.lives if self.time - life.last < GIVE_UP]
        self._begin([detections[j] for j in np.flatnonzero(explained < 0.1)], noise[explained < 0.1], now)

    def _update(self, life: Life, hypotheses: Any, updater: Any, at: dict[int, int], explained: np.ndarray) -> None:
        from stonesoup.functions import gm_reduce_single
        from stonesoup.types.array import StateVectors
        from stonesoup.types.update import GaussianStateUpdate

        states, weights, hit = [], [], 0.0
        for hypothesis in hypotheses:
            weight = float(hypothesis.probability)
            if hypothesis:
                states.append(updater.update(hypothesis))
                explained[at[id(hypothesis.measurement)]] += weight
                hit += weight
            else:
                states.append(hypothesis.prediction)
            weights.append(weight)
        mean, cov = gm_reduce_single(
            StateVectors([s.state_vector for s in states]),
            np.stack([s.covar for s in states], axis=2),
            np.array(weights),
        )
        life.track.append(GaussianStateUpdate(mean, cov, hypotheses, hypotheses[0].prediction.timestamp))
        if hit > 0.5:
            life.last, life.count = self.time, life.count + 1
            if life.label is None and life.count >= CONFIRM:
                life.label, self.next_label = self.next_label, self.next_label + 1

    def _begin(self, detections: Sequence[Any], noise: np.ndarray, now: datetime.datetime) -> None:
        """Begin a track with each of the detections."""
        from stonesoup.types.state import GaussianState
        from stonesoup.types.track import Track as History

        speed = self.population.motion.models[0].speed() ** 2
        for one, cov in zip(detections, noise, strict=True):
            x, y = np.asarray(one.state_vector, float).ravel()
            spread = np.zeros((4, 4))
            spread[np.ix_((0, 2), (0, 2))] = cov
            spread[1, 1] = spread[3, 3] = speed
            history = History([GaussianState([[x], [0.0], [y], [0.0]], spread, timestamp=now)])
            self.lives.append(Life(history, self.time))

    def tracks(self, time: float) -> list[Track]:
        """Return the confirmed tracks at a time (s) not before the last record, by label."""
        self.predict(time)
        order, tracks = [0, 2, 1, 3], []
        for life in self.lives:
            if life.label is not None:
                state = self.predictor.predict(life.track[-1], timestamp=_clock(self.time))
                mean = np.asarray(state.state_vector, float).ravel()[order]
                cov = np.asarray(state.covar, float)[np.ix_(order, order)]
                tracks.append(Track(life.label, mean, cov, 1.0, last_seen=life.last))
        return sorted(tracks, key=lambda track: track.label)


def _clock(seconds: float) -> datetime.datetime:
    return datetime.datetime(2000, 1, 1) + datetime.timedelta(seconds=seconds)
