"""Global nearest neighbour: a Kalman filter for each track, the one cheapest assignment, m-of-n confirmation."""

import math

import numpy as np

from avcli.numeric import assign
from avcli.tracking import gaussian
from avcli.tracking.model import Track

GATE = 13.8  # chi-squared with two degrees of freedom, 0.1 % of a track's own detections lie outside
CONFIRM, OF = 2, 3  # detections within looks of the sensors that have found the track before
GIVE_UP = 1.0  # s without any detection


class GNN:
    """The baseline that most people write first (Blackman and Popoli 1999, chapter 6); the interface of `glmb.GLMB`."""

    def __init__(self, settings, sensors=()):
        """settings: Settings, of which motion and speed are used; sensors: Sensor of each that may report."""
        self.settings, self.sensors, self.column = settings, [], {}
        m = len(settings.motion.models)
        self.mean, self.cov, self.mode = np.zeros((0, m, 4)), np.zeros((0, m, 4, 4)), np.zeros((0, m))
        self.lives = []  # per track: [label or None, results of the last looks, time last found, sensors that found it]
        self.time, self.next_label = None, 0
        for one in sensors:
            self.add(one)

    def add(self, sensor):
        """Let another sensor report from now on."""
        self.column[sensor.name] = len(self.sensors)
        self.sensors.append(sensor)

    def advance(self, time):
        """Predict to a time (s); a time in the past counts as the present."""
        dt = 0.0 if self.time is None else round(time - self.time, 9)
        self.time = time if self.time is None else max(time, self.time)
        if dt > 0 and self.lives:
            motion = self.settings.motion
            self.mean, self.cov, self.mode, *_ = gaussian.predict(self.mean, self.cov, self.mode, motion, dt)

    def scan(self, time, name, z, noise, score=None):
        """Update with one record of one sensor; arguments as those of `GLMB.scan`, the scores are not used."""
        self.advance(time)
        sensor = self.sensors[self.column[name]]
        pairs = self._assign(z, noise, sensor.lead)
        if pairs:
            rows, js = map(list, zip(*pairs, strict=True))
            self.mean[rows], self.cov[rows], self.mode[rows] = gaussian.update(
                self.mean[rows], self.cov[rows], self.mode[rows], z[js], noise[js], sensor.lead
            )
        found = {row for row, _ in pairs}
        for row, life in enumerate(self.lives):
            if row in found:
                life[1], life[2] = [*life[1], True][-OF:], self.time
                life[3].add(name)
            elif name in life[3]:
                life[1] = [*life[1], False][-OF:]
            if life[0] is None and sum(life[1]) >= CONFIRM:
                life[0], self.next_label = self.next_label, self.next_label + 1
        self._bury()
        self._start(sorted(set(range(len(z))) - {j for _, j in pairs}), z, noise, name)

    def _assign(self, z, noise, lead):
        """Pairs (track, detection) of the cheapest assignment within the gate, confirmed tracks first."""
        if not len(z) or not self.lives:
            return []
        log, distance = gaussian.loglikelihood(self.mean, self.cov, z, noise, lead)
        log = np.log((self.mode[:, None] @ np.exp(log))[:, 0] + 1e-300)
        inside = distance.min(1) < GATE
        pairs, taken = [], set()
        for rows in ([k for k, s in enumerate(self.lives) if (s[0] is None) == new] for new in (False, True)):
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

    def _bury(self):
        keep = [
            row
            for row, (label, looks, last, _) in enumerate(self.lives)
            if (self.time - last < GIVE_UP if label is not None else len(looks) < OF)
        ]
        self.mean, self.cov, self.mode = self.mean[keep], self.cov[keep], self.mode[keep]
        self.lives = [self.lives[row] for row in keep]

    def _start(self, js, z, noise, name):
        n, m = len(js), len(self.settings.motion.models)
        mean, cov = np.zeros((n, m, 4)), np.zeros((n, m, 4, 4))
        mean[..., :2] = z[js, None]
        cov[..., :2, :2] = noise[js, None]
        cov[..., 2:, 2:] = self.settings.speed**2 * np.eye(2)
        self.mean, self.cov = np.concatenate([self.mean, mean]), np.concatenate([self.cov, cov])
        self.mode = np.concatenate([self.mode, np.tile(self.settings.motion.stationary(), (n, 1))])
        self.lives += [[None, [True], self.time, {name}] for _ in js]

    def tracks(self, time):
        """The confirmed tracks at a time (s) not before the last record: a list of Track by label."""
        self.advance(time)
        rows = [row for row, life in enumerate(self.lives) if life[0] is not None]
        if not rows:
            return []
        mean, cov = gaussian.moments(self.mean[rows], self.cov[rows], self.mode[rows])
        return sorted(
            (
                Track(self.lives[row][0], mean[k], cov[k], math.exp(self.lives[row][2] - self.time))
                for k, row in enumerate(rows)
            ),
            key=lambda track: track.label,
        )
