"""From detections of several sensors to tracks, step by step."""

import math

import numpy as np

from avcli.tracking.glmb import GLMB
from avcli.tracking.gnn import GNN
from avcli.tracking.model import sensor
from avcli.tracking.smoothing import Delayed

FLOOR, CEILING = 1e-6, 1e8  # m^2; a person's place is not defined to better than a millimetre


class Fusion:
    """A tracker with its sensors, its output delay and its numbering of people."""

    def __init__(self, settings, tracker="ms-glmb", lag=0, sensors=None, margin=None, explain=False):
        """settings: Settings. tracker: "ms-glmb", "lmb", "gnn" or "jpda". lag: steps of delay, math.inf: all at the
        end. sensors: name -> what is known of it (see `model.sensor`). margin: m beyond the area where detections are
        still taken, None: everywhere. explain: keep an account of every record, see `accounts`.
        """
        self.settings, self.margin = settings, margin
        self.known = {} if sensors is None else sensors
        if tracker in ("gnn", "jpda"):
            if lag or explain:
                raise ValueError(f"the {tracker} tracker can neither smooth nor explain")
            self.tracker = GNN(settings) if tracker == "gnn" else _jpda(settings)
        else:
            self.tracker = GLMB(settings, factorise=tracker == "lmb", record=lag > 0)
        if explain:
            self.tracker.journal = []
        self.delayed = Delayed(self.tracker, lag) if lag else None
        self.origin, self.numbers, self.outside = None, {}, 0

    def step(self, time, records):
        """Take in all records of one time step.

        time: s. records: [(time s, sensor name, Detections), ...] in order of time, not later than `time`.
        Returns [(time, [(number, Track), ...]), ...]: the steps that are due.
        """
        if self.origin is None:
            self.origin = time
        now = round(time - self.origin, 6)
        looks = {}
        for at, name, found in records:
            looks.setdefault((round(at - self.origin, 6), self._column(name)), []).append(found)
        sensors = self.tracker.sensors  # at one time the exact sensor first: where it sees nobody, a vague one doubts
        for (at, column), parts in sorted(looks.items(), key=lambda look: (look[0][0], max(sensors[look[0][1]].sigma))):
            self._scan(at, sensors[column], parts)
        if self.delayed:
            return [self._numbered(*due) for due in self.delayed.push(now)]
        return [self._numbered(now, self.tracker.tracks(now))]

    def finish(self):
        """The steps that are left at the end, as `step` returns them."""
        return [self._numbered(*due) for due in self.delayed.finish()] if self.delayed else []

    def accounts(self):
        """What each record since the last call meant to the tracker; labels get the tracks' numbers as `object_id`."""
        journal, self.tracker.journal = self.tracker.journal, []
        for account in journal:
            account["timestamp"] += self.origin
            for entry in (*account["people"], *account["born"], *account["died"]):
                entry["object_id"] = self.numbers.get(entry["label"])
        return journal

    def _column(self, name):
        if name not in self.tracker.column:
            self.tracker.add(sensor(name, **self.known.get(name, {})))
        return self.tracker.column[name]

    def _scan(self, at, model, parts):
        positions, covariances, scores = parts[0].positions, parts[0].covariances, parts[0].scores
        if len(parts) > 1:
            positions = np.concatenate([part.positions for part in parts])
            covariances = np.concatenate([part.covariances for part in parts])
            scores = np.concatenate([part.scores for part in parts])
        positions, covariances = positions[:, :2], covariances[:, :2, :2]
        if self.margin is not None:
            low, high = np.array(self.settings.area)
            inside = ((positions >= low - self.margin) & (positions <= high + self.margin)).all(1)
            self.outside += int((~inside).sum())
            positions, covariances, scores = positions[inside], covariances[inside], scores[inside]
        noise = noise_of(covariances, model.sigma, model.floor, self.settings.area)
        self.tracker.scan(at, model.name, positions, noise, scores)

    def _numbered(self, time, tracks):
        for track in tracks:
            if track.label not in self.numbers:
                self.numbers[track.label] = len(self.numbers)
        return self.origin + time, [(self.numbers[track.label], track) for track in tracks]


def _jpda(settings):
    from avcli.tracking.jpda import JPDA  # only who asks for it needs Stone Soup's module

    return JPDA(settings)


def noise_of(covariances, sigma, floor, area):
    """Measurement noise as the filter needs it.

    covariances: (J, 2, 2) m^2, NaN where not given; sigma: (sx, sy) m for those; floor: m, see `model.Sensor`. A
    variance of 0 means that the coordinate was not observed: it becomes the one whose density is that of a uniform
    distribution over the area.
    Returns (J, 2, 2) m^2, positive definite.
    """
    noise = []
    for (xx, xy), (yx, yy) in covariances.tolist():
        xx, yy, cross = xx + floor * floor * (xx > 0), yy + floor * floor * (yy > 0), (xy + yx) / 2
        if math.isnan(xx + yy + cross):
            xx, yy, cross = sigma[0] ** 2, sigma[1] ** 2, 0.0
        if not (xx and yy):
            cross = 0.0
            xx, yy = (v or (high - low) ** 2 / (2 * math.pi) for v, low, high in zip((xx, yy), *area, strict=True))
        xx, yy = min(max(xx, FLOOR), CEILING), min(max(yy, FLOOR), CEILING)
        most = 0.999 * math.sqrt(xx * yy)
        cross = min(max(cross, -most), most)
        noise.append(((xx, cross), (cross, yy)))
    return np.array(noise).reshape(-1, 2, 2)
