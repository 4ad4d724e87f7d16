"""What a sensor's records say about the sensor itself: clutter, detection, scores, how it loses people, blindness."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from avcli.formats.sensors import CAMERA
from avcli.tracking.blindness import Blindness
from avcli.tracking.settings import SENSORS, Sensor

# What the stated values are worth, in records, detectable people, and events. These were chosen on ETH hotel, UCY
# zara01 and zara02 and on generated scenes (`make bench-tracking`, seeds from 100).
PRIOR_RECORDS, PRIOR_AGAIN, PRIOR_EVENTS = 3.0, 14.0, 1.0
PRIOR_HITS = 4.0  # detectable people, of the detection probability; 14 cost found30 1.6 (seeds 100 to 129)
KEEP, EVENTS = 0.995, 40.0  # weight of what was learnt before, for each record; events from which they are forgotten
SURPRISE, REVISED = 3.0, 0.25  # standard deviations of clutter in a record, from which earlier ones count so much
CHECKED = 0.2  # s, until the next record, that tell a person from clutter: a newcomer walks as far as detections err
AGAIN = 0.05  # expected further detections of a person whom a sensor has detected in the same record already
MOST_AGAIN = 0.2  # of these, as far as it is believed: more would hide people in a crowd (12 people 0.25 m apart)
OFTEN = 0.15  # of these, from which a sensor finds people again and again


class Rates:
    """A sensor's clutter, detection probability and typical score as estimated so far.

    Attributes:
        clutter: false detections expected in one record.
        detection: probability that it detects, in one record, a person who is detectable.
        again: expected further detections of a person whom it has detected in the same record already.
        hiding: how it loses people and finds them again.
        blindness: how it loses everybody.
        proven: whether it has detected people who surely exist.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.clutter, self.detection, self.score_nats = sensor.clutter, sensor.detection, sensor.score_nats
        self.typical: float | None = None  # log odds of the scores of people
        self.clutter_sum, self.clutter_count = PRIOR_RECORDS * sensor.clutter, PRIOR_RECORDS
        self.hit_sum, self.hit_count = PRIOR_HITS * sensor.detection, PRIOR_HITS
        self.before: tuple[float, float] | None = None  # what was known of clutter before the last record
        self.unknown_sum, self.unknown_count = sensor.clutter, 1.0  # detections of nobody known, in so many records
        self.surprise, self.weight = False, 1.0  # of the last record; of what one record teaches of clutter
        self.again, self.again_sum, self.again_count = AGAIN, PRIOR_AGAIN * AGAIN, PRIOR_AGAIN
        self.hiding = Hiding(sensor)
        self.blindness = Blindness(sensor.hide > 0, tells=sensor.kind == CAMERA)
        self.proven = False
        self._stated = sensor.clutter

    def learn(self, clutter: float, hits: float, misses: float, again: float, unknown: float = 0.0) -> None:
        """Learn from one record.

        Args:
            clutter: false detections.
            hits, misses: people detected, and detectable ones who were missed.
            again: further detections of the same people.
            unknown: detections of nobody known.
        """
        self.unknown_sum, self.unknown_count = self.unknown_sum * KEEP + unknown, self.unknown_count * KEEP + 1
        surprises = clutter > self.clutter + SURPRISE * math.sqrt(self.clutter + 1)  # what was learnt cannot be right
        keep = REVISED if surprises else KEEP
        self.before, self.surprise = (self.clutter_sum, self.clutter_count), surprises
        self.clutter_sum, self.clutter_count = self.clutter_sum * keep + clutter, self.clutter_count * keep + 1
        self.hit_sum, self.hit_count = self.hit_sum * KEEP + hits, self.hit_count * KEEP + hits + misses
        self.again_sum, self.again_count = self.again_sum * KEEP + again, self.again_count * KEEP + hits
        self.proven = self.proven or hits > 0
        self._estimate()

    def settle(self, dt: float) -> None:
        """Weigh what the last record taught of clutter, now that the next one is there after dt s.

        A person who came walks on, and is known for one as long as the next record finds that person near. Later, new
        people look like false detections, and those count as much less as the area in which they may be is larger.
        """
        if self.before is None:
            return
        self.weight = (CHECKED / dt) ** 2 if dt > CHECKED else 1.0
        if self.weight == 1.0:
            return
        total, count = self.before
        self.clutter_sum = total + self.weight * (self.clutter_sum - total)
        self.clutter_count = count + self.weight * (self.clutter_count - count)
        self._estimate()

    def most_clutter(self) -> float:
        """Return the false detections in a record if all detections of nobody known were false."""
        return max(self.unknown_sum / self.unknown_count, 1e-9)

    def give_back(self, number: float) -> None:
        """Take back that so many detections counted as false: they were of a person who is certain by now."""
        self.clutter_sum = max(self.clutter_sum - number, 0.0)
        if self.before:
            self.before = max(self.before[0] - number, 0.0), self.before[1]
        self._estimate()

    def surprised(self, unclaimed: float, due: float) -> bool:
        """Return whether a record has many more detections of nobody known than new people and clutter explain.

        Args:
            unclaimed: expected number of these detections.
            due: the same before the record, of new people.
        """
        usual = due + self.clutter
        return unclaimed > usual + SURPRISE * math.sqrt(usual + 1)

    def doubtful(self) -> bool:
        """Return whether what is learnt of clutter may be people: it was a surprise, or is far more than is stated.

        Not where the sensor finds people again and again in one record: those come again in the same places, too.
        """
        much = self.clutter > self._stated + SURPRISE * math.sqrt(self._stated + 1)
        return self.surprise or (much and self.again < OFTEN)

    def take_back(self) -> None:
        """Forget what the last record taught of clutter: it was people."""
        if self.surprise and self.before:
            self.clutter_sum, self.clutter_count = self.before
            self._estimate()

    def clutter_with(self, more: float) -> float:
        """Return the false detections to expect in a record, if a further one has so many."""
        return (self.clutter_sum + self.weight * more) / (self.clutter_count + self.weight)

    def _estimate(self) -> None:
        self.clutter = min(max(self.clutter_sum / self.clutter_count, 1e-3), 1e3)
        self.detection = min(max(self.hit_sum / self.hit_count, 0.05), 0.99)
        self.again = min(self.again_sum / max(self.again_count, 1e-3), MOST_AGAIN)

    def learn_score(self, odds: Sequence[float], near: Sequence[float], real: Sequence[float]) -> None:
        """Learn the typical score of people from one record.

        Args:
            odds: log odds of the J scores (NaN: unknown).
            near: see `clutter_factors`; vague detections hardly count.
            real: probabilities that the J detections are people.
        """
        known = [(odd, share * q) for odd, share, q in zip(odds, real, near, strict=True) if odd == odd]
        weight = math.fsum([share for _, share in known])
        if weight > 1e-3:
            share = 1.0 if self.typical is None else 0.1 * min(weight, 1.0)
            now = math.fsum(odd * real for odd, real in known) / weight
            self.typical = now if self.typical is None else self.typical + share * (now - self.typical)

    def clutter_factors(self, odds: Sequence[float], near: Sequence[float]) -> list[float]:
        """Return how much likelier than usual each detection is clutter, by the log odds of its score (NaN: 1).

        A detection whose place is hardly known has a low score although it is of a person.

        Args:
            odds: log odds of the J scores.
            near: J odds, at most 1, that it is as near to its person as its score asks, see `Sensor.score_within`.
        """
        typical = self.typical
        if typical is None:
            known = [odd for odd in odds if odd == odd]
            typical = math.fsum(known) / len(known) if known else 0.0
        return [
            math.exp(min(max(typical + math.log(q) - odd, -1.0), self.score_nats)) if odd == odd else 1.0
            for odd, q in zip(odds, near, strict=True)
        ]

    def state(self) -> dict[str, Any]:
        """Return what was learnt, as `restore` takes it."""
        own = {name: getattr(self, name) for name in _LEARNT[Rates]}
        parts = {"hiding": self.hiding, "blindness": self.blindness}
        return own | {key: {name: getattr(one, name) for name in _LEARNT[type(one)]} for key, one in parts.items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what another run has learnt."""
        for one, values in ((self, state), (self.hiding, state["hiding"]), (self.blindness, state["blindness"])):
            for name in _LEARNT[type(one)]:
                setattr(one, name, values[name])
        self._estimate()


class Hiding:
    """How a sensor loses single people and finds them again: the rates of a two-state Markov chain, with gamma priors.

    Only a person who is detected again tells: one who is not may have left.

    Attributes:
        events: how often a person was hidden and came back, with the prior's worth.
        in_sight, hidden: s that people spent in each state.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.ever, self.events = sensor.hide > 0, PRIOR_EVENTS
        self.in_sight = PRIOR_EVENTS / (sensor.hide or SENSORS[sensor.kind].hide)
        self.hidden = PRIOR_EVENTS / sensor.show

    @property
    def hide(self) -> float:
        """Rate per second at which a person becomes undetectable."""
        return self.events / self.in_sight if self.ever else 0.0

    @property
    def show(self) -> float:
        """Rate per second at which the person becomes detectable again."""
        return self.events / self.hidden

    def detectable(self) -> float:
        """Return the long-run probability that a person in the room is detectable."""
        return self.show / (self.hide + self.show)

    def learn(self, detectable: Sequence[float], gaps: Sequence[float], sure: Sequence[float], dt: float) -> None:
        """Learn from people whom the sensor has detected again.

        Args:
            detectable: n probabilities, predicted, that it could.
            gaps: n s since it detected them last.
            sure: n probabilities that it was they.
            dt: s since its last record.
        """
        hide, show = self.hide, self.show
        rest, stay = show / (hide + show), math.exp(-(hide + show) * dt)
        before = [min(max((one - rest) / max(stay, 1e-300) + rest, 0.0), 1.0) for one in detectable]
        shown = [
            share * min((1 - hid) * rest * (1 - stay) / max(one, 1e-12), 1.0)
            for share, hid, one in zip(sure, before, detectable, strict=True)
        ]
        keep = KEEP if self.events > EVENTS else 1.0
        self.events = self.events * keep + math.fsum(shown)
        self.hidden = self.hidden * keep + math.fsum([s * gap for s, gap in zip(shown, gaps, strict=True)])
        in_sight = [(share - s) * gap for share, s, gap in zip(sure, shown, gaps, strict=True)]
        self.in_sight = self.in_sight * keep + math.fsum(in_sight)


_LEARNT: dict[type, tuple[str, ...]] = {
    Rates: ("typical", "clutter_sum", "clutter_count", "hit_sum", "hit_count", "again_sum", "again_count"),
    Hiding: ("events", "in_sight", "hidden"),
    Blindness: ("returned", "emptied"),
}


def logit(score: float) -> float:
    """Return the log odds of a probability (NaN: NaN), which is held within 0.01 % and 99.99 %."""
    score = min(max(score, 1e-4), 1 - 1e-4)
    return math.log(score / (1 - score))
