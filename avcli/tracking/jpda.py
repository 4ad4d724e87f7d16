"""Joint probabilistic data association by Stone Soup, an optional package, in the interface of the other trackers."""

import datetime

import numpy as np

from avcli.tracking.model import Track

GATE = 0.9999
CONFIRM = 2  # detections before a track counts
GIVE_UP = 1.0  # s without any detection


class JPDA:
    """Stone Soup's JPDA with constant-velocity Kalman filters (Bar-Shalom and Li 1995; stonesoup 1.9)."""

    def __init__(self, settings, sensors=()):
        """settings: Settings, of which area, speed and the noise of the first motion model are used.

        Raises ValueError where Stone Soup is not installed.
        """
        try:
            from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
            from stonesoup.predictor.kalman import KalmanPredictor
        except ModuleNotFoundError:
            raise ValueError("--tracker jpda needs Stone Soup: pip install stonesoup") from None
        axis = ConstantVelocity(max(settings.motion.models[0].noise, 0.5) ** 2)
        self.predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([axis, axis]))
        self.settings, self.sensors, self.column = settings, [], {}
        self.lives, self.next_label, self.time = [], 0, 0.0
        for one in sensors:
            self.add(one)

    def add(self, sensor):
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)

    def scan(self, time, name, z, noise, score=None):
        """Update with one record of one sensor; arguments as those of `GLMB.scan`, the scores are not used."""
        from stonesoup.dataassociator.probability import JPDA as Associator
        from stonesoup.hypothesiser.probability import PDAHypothesiser
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.types.detection import Detection
        from stonesoup.updater.kalman import KalmanUpdater

        self.time = max(self.time, time)
        sensor = self.sensors[self.column[name]]
        now = _clock(self.time)
        found = [
            Detection(place[:, None], timestamp=now, measurement_model=LinearGaussian(4, (0, 2), cov))
            for place, cov in zip(z, noise, strict=True)
        ]
        updater = KalmanUpdater(LinearGaussian(4, (0, 2), np.eye(2)))
        chance = sensor.detection * sensor.findable()
        density = max(sensor.clutter, 1e-6) / self.settings.surface
        hypothesiser = PDAHypothesiser(self.predictor, updater, density, prob_detect=chance, prob_gate=GATE)
        explained = np.zeros(len(found))
        if self.lives and found:
            at = {id(one): j for j, one in enumerate(found)}
            chosen = Associator(hypothesiser=hypothesiser).associate([life["track"] for life in self.lives], found, now)
            for life in self.lives:
                self._update(life, chosen[life["track"]], updater, at, explained)
        self.lives = [life for life in self.lives if self.time - life["last"] < GIVE_UP]
        self._begin([found[j] for j in np.flatnonzero(explained < 0.1)], noise[explained < 0.1], now)

    def _update(self, life, hypotheses, updater, at, explained):
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
        life["track"].append(GaussianStateUpdate(mean, cov, hypotheses, hypotheses[0].prediction.timestamp))
        if hit > 0.5:
            life["last"], life["count"] = self.time, life["count"] + 1
            if life["label"] is None and life["count"] >= CONFIRM:
                life["label"], self.next_label = self.next_label, self.next_label + 1

    def _begin(self, found, noise, now):
        from stonesoup.types.state import GaussianState
        from stonesoup.types.track import Track as History

        speed = self.settings.speed**2
        for one, cov in zip(found, noise, strict=True):
            x, y = np.asarray(one.state_vector, float).ravel()
            spread = np.zeros((4, 4))
            spread[np.ix_((0, 2), (0, 2))] = cov
            spread[1, 1] = spread[3, 3] = speed
            track = History([GaussianState([[x], [0.0], [y], [0.0]], spread, timestamp=now)])
            self.lives.append({"track": track, "label": None, "count": 1, "last": self.time})

    def tracks(self, time):
        """The confirmed tracks at a time (s) not before the last record: a list of Track by label."""
        self.time = max(self.time, time)
        order, out = [0, 2, 1, 3], []
        for life in self.lives:
            if life["label"] is not None:
                state = self.predictor.predict(life["track"][-1], timestamp=_clock(self.time))
                mean = np.asarray(state.state_vector, float).ravel()[order]
                cov = np.asarray(state.covar, float)[np.ix_(order, order)]
                out.append(Track(life["label"], mean, cov, 1.0))
        return sorted(out, key=lambda track: track.label)


def _clock(seconds):
    return datetime.datetime(2000, 1, 1) + datetime.timedelta(seconds=seconds)
