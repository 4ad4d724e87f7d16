"""What a sensor's records say about the sensor itself: its clutter, its detection probability, its scores."""

import math
from collections.abc import Sequence

from avcli.tracking.settings import Sensor

BLIND, SIGHTED = 0.05, 0.5  # rates per second at which a sensor goes blind, and sees again
PRIOR_RECORDS, PRIOR_PEOPLE = 3.0, 60.0  # how many records and detectable people the stated values are worth
KEEP = 0.995  # weight of what was learnt before, for each record


class Rates:
    """A sensor's clutter, detection probability, blindness and typical score as estimated so far.

    Attributes:
        clutter: false detections expected in one record.
        detection: probability that it detects, in one record, a person who is detectable.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.clutter, self.detection, self.score_nats = sensor.clutter, sensor.detection, sensor.score_nats
        self.typical: float | None = None  # log odds of the scores of people
        self.clutter_sum, self.clutter_count = PRIOR_RECORDS * sensor.clutter, PRIOR_RECORDS
        self.hit_sum, self.hit_count = PRIOR_PEOPLE * sensor.detection, PRIOR_PEOPLE
        self.blind, self.goes_blind = 0.0, sensor.hide > 0
        self.time: float | None = None

    def blindness(self, time: float, ratio: float) -> float:
        """Update and return the probability that the sensor is blind: it sees nobody and reports clutter alone.

        Args:
            time: s, of its record.
            ratio: how much likelier the record is if the sensor is not blind.

        Returns:
            The probability; always 0 for a sensor from which people are never hidden.
        """
        if not self.goes_blind:
            return 0.0
        if self.time is not None:
            rest = BLIND / (BLIND + SIGHTED)
            self.blind = rest + (self.blind - rest) * math.exp(-(BLIND + SIGHTED) * max(time - self.time, 0.0))
        self.time = time
        self.blind = self.blind / (self.blind + (1 - self.blind) * max(ratio, 1e-300))
        return self.blind

    def learn(self, clutter: float, hits: float, misses: float) -> None:
        """Learn from one record: its expected false detections, people detected, detectable people missed."""
        self.clutter_sum, self.clutter_count = self.clutter_sum * KEEP + clutter, self.clutter_count * KEEP + 1
        self.hit_sum, self.hit_count = self.hit_sum * KEEP + hits, self.hit_count * KEEP + hits + misses
        self.clutter = min(max(self.clutter_sum / self.clutter_count, 1e-3), 1e3)
        self.detection = min(max(self.hit_sum / self.hit_count, 0.05), 0.99)

    def learn_score(self, odds: Sequence[float], real: Sequence[float]) -> None:
        """Learn the typical score of people from one record.

        Args:
            odds: log odds of the J scores (NaN: unknown).
            real: probabilities that the J detections are people.
        """
        known = [(odd, share) for odd, share in zip(odds, real, strict=True) if odd == odd]
        weight = math.fsum(share for _, share in known)
        if weight > 1e-3:
            share = 1.0 if self.typical is None else 0.1 * min(weight, 1.0)
            now = math.fsum(odd * real for odd, real in known) / weight
            self.typical = now if self.typical is None else self.typical + share * (now - self.typical)

    def clutter_factors(self, odds: Sequence[float]) -> list[float]:
        """Return how much likelier than usual each detection is clutter, by the log odds of its score (NaN: 1)."""
        typical = self.typical
        if typical is None:
            known = [odd for odd in odds if odd == odd]
            typical = math.fsum(known) / len(known) if known else 0.0
        return [math.exp(min(max(typical - odd, -1.0), self.score_nats)) if odd == odd else 1.0 for odd in odds]


def logit(score: float) -> float:
    """Return the log odds of a probability (NaN: NaN), which is held within 0.01 % and 99.99 %."""
    score = min(max(score, 1e-4), 1 - 1e-4)
    return math.log(score / (1 - score))
