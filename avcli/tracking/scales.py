"""Whether the noise of a sensor is much larger than it is taken for, by all detections, also those far from everybody.

The noise is learnt from detections whose people are sure, see `errors`. Where it is far too small, most detections lie
outside every gate, are taken for clutter, and teach nothing. So two sensors are compared: one whose noise is as it is
taken for, and one with four times the variance. Each has its own clutter and its own detection probability.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import truediv
from typing import TYPE_CHECKING

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.densities import Densities
from avcli.tracking.settings import Sensor

if TYPE_CHECKING:
    from avcli.tracking.scan import Scan

WIDER = 4.0  # factor on the variance of the other sensor's noise
# Chosen on noise-untold, runners, clutter and cov-low of `make bench-tracking`, seeds 100 to 103.
CERTAIN, DOUBT = 20.0, -3.0  # nats from which the noise is larger; and at least, so that a later change is seen, too
RECORDS, PEOPLE = 3.0, 14.0  # what the stated clutter and detection probability are worth, see `rates`
SURE, FAST = 0.9, 2.5  # existence and m/s of the people who count: who runs turns more sharply than is expected
SELDOM = 8  # records of which one is looked at while little speaks for larger noise
LITTLE = 1.0  # nats above DOUBT: so much do records without a detection say, too
KEEP = 0.995  # weight of what was counted before, for each record


class Scales:
    """One sensor's evidence that its noise is `WIDER`.

    Attributes:
        nats: by how much its detections are likelier then.
    """

    def __init__(self, sensor: Sensor) -> None:
        self._sensor, self._count = sensor, 0
        self.begin()

    def begin(self) -> None:
        """Forget all evidence: the noise is taken for another one from now on."""
        self.nats = 0.0
        self._records, self._people = RECORDS, PEOPLE
        self._clutter, self._hits = [RECORDS * self._sensor.clutter] * 2, [PEOPLE * self._sensor.detection] * 2

    def due(self) -> bool:
        """Return whether the next record is to be looked at: one of some, while nothing speaks for larger noise."""
        self._count += 1
        return self.nats > DOUBT + LITTLE or self._count % SELDOM == 0

    def wider(self, scan: Scan, people: Densities, rows: Sequence[int], surface: float) -> bool:
        """Take in one record, and return whether the noise certainly is larger.

        Args:
            scan: the record.
            people: the densities before it.
            rows: of the known people.
            surface: m², over which false detections are spread.

        Source:
            R. P. S. Mahler, "Multitarget Bayes filtering via first-order multitarget moments", IEEE TAES 39(4), 2003
            (the likelihood of a record where people and clutter are Poisson).
        """
        some = [row for row in rows if scan.existence[row] > SURE]
        velocities = people.centres(some)[:, 2:].tolist()
        rows = [row for row, one in zip(some, velocities, strict=True) if math.hypot(*one) < FAST]
        if len(rows) < max(len(scan.z), 1) or scan.p_sensor < 1e-3:
            return False  # where more is detected than people are known, clutter or newcomers are near
        there = [scan.existence[row] * scan.p_detect[row] / scan.p_sensor for row in rows]
        caused: list[list[float]] = [[], []]  # densities per m² of the detections under each noise, if all are detected
        if len(scan.z):
            both = np.concatenate([scan.z, scan.z]), np.concatenate([scan.noise, WIDER * scan.noise])
            likelihood = np.exp(gaussian.loglikelihood(scan.expected.take(rows, 0), *both)[0])
            likelihood = (people.mode.take(rows, 0)[:, None] @ likelihood)[:, 0]
            caused = (np.array(there) @ likelihood).reshape(2, -1).tolist()
        present, nats = math.fsum(there), []
        for k, by_people in enumerate(caused):
            clutter, detection = self._clutter[k] / self._records, min(self._hits[k] / self._people, 0.99)
            false = [clutter / surface + one for one in scan.local]
            whole = [max(f + detection * one, 1e-300) for f, one in zip(false, by_people, strict=True)]
            nats.append(math.fsum(map(math.log, whole)) - clutter - detection * present)
            share = math.fsum(map(truediv, false, whole))
            self._clutter[k] = KEEP * self._clutter[k] + share
            self._hits[k] = KEEP * self._hits[k] + len(scan.z) - share
        self._records, self._people = KEEP * self._records + 1, KEEP * self._people + present
        self.nats = max(self.nats + nats[1] - nats[0], DOUBT)
        return self.nats > CERTAIN
