"""What a sensor's records say about the sensor itself."""

import math

BLIND, SIGHTED = 0.05, 0.5  # rates per second at which a sensor loses sight of everybody, and finds people again


class Rates:
    """A sensor's clutter, detection probability and blindness as believed now; how sure its detections usually are."""

    def __init__(self, sensor):
        self.clutter, self.detection, self.doubtful = sensor.clutter, sensor.detection, sensor.doubt
        self.typical = None
        self.clutter_sum, self.clutter_count = 3.0 * sensor.clutter, 3.0
        self.hit_sum, self.hit_count = 60.0 * sensor.detection, 60.0
        self.blind, self.time, self.goes_blind = 0.0, None, sensor.hide > 0

    def blindness(self, time, ratio):
        """Probability that the sensor sees nobody now, whoever is there, and what it reports is all clutter.

        time: s, of its record; ratio: how much likelier the record is if it is not blind. A sensor from which nobody
        is ever hidden never goes blind either.
        """
        if not self.goes_blind:
            return 0.0
        if self.time is not None:
            rest = BLIND / (BLIND + SIGHTED)
            self.blind = rest + (self.blind - rest) * math.exp(-(BLIND + SIGHTED) * max(time - self.time, 0.0))
        self.time = time
        self.blind = self.blind / (self.blind + (1 - self.blind) * max(ratio, 1e-300))
        return self.blind

    def learn(self, clutter, hits, misses):
        """Take in one record: expected false detections, people found, findable people missed."""
        keep = 0.995
        self.clutter_sum, self.clutter_count = self.clutter_sum * keep + clutter, self.clutter_count * keep + 1
        self.hit_sum, self.hit_count = self.hit_sum * keep + hits, self.hit_count * keep + hits + misses
        self.clutter = min(max(self.clutter_sum / self.clutter_count, 1e-3), 1e3)
        self.detection = min(max(self.hit_sum / self.hit_count, 0.05), 0.99)

    def learn_score(self, odds, real):
        """Take in the scores' log odds, a list of J, of one record, each as far as it probably was a person: real."""
        known = [(odd, share) for odd, share in zip(odds, real, strict=True) if odd == odd]
        weight = math.fsum(share for _, share in known)
        if weight > 1e-3:
            share = 1.0 if self.typical is None else 0.1 * min(weight, 1.0)
            now = math.fsum(odd * real for odd, real in known) / weight
            self.typical = now if self.typical is None else self.typical + share * (now - self.typical)

    def doubt(self, odds):
        """How much more clutter than usual each detection stands for, by its log odds (NaN: 1) against people's."""
        typical = self.typical
        if typical is None:
            known = [odd for odd in odds if odd == odd]
            typical = math.fsum(known) / len(known) if known else 0.0
        return [math.exp(min(max(typical - odd, -1.0), self.doubtful)) if odd == odd else 1.0 for odd in odds]


def logit(score):
    """Log odds of a probability (NaN: NaN), held within 0.01 % and 99.99 %."""
    score = min(max(score, 1e-4), 1 - 1e-4)
    return math.log(score / (1 - score))
