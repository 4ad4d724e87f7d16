"""What the decisions before this one found, and for how long it counts."""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from avcli.localization.modulation import Course

UNKNOWN, CONFIRMED, FADE, SOUGHT = -4.0, 2.0, 1.0, 1.0
"""The bounds of what was confirmed of a trace, as logits, by how much it falls in a second, and from how much of it on
the trace is looked for again."""
FAMILIAR_M, FAMILIAR_S = 0.4, 1.5
"""Within so many m of a place what was heard counts for it, and after so many s by 1/e."""


@dataclass(frozen=True)
class Trace:
    """A peak of an earlier decision.

    Attributes:
        position: (3,) m.
        velocity: (3,) m/s, as the decisions so far have it, the latest counting most.
        lasting: how lasting it is, see `uncertainty.Law.remembered`.
        confirmed: the most that spoke for it lately, as a logit: who surely talked is likelier to be there again.
        course: how steadily it sounded in this decision and those before in which it was seen.
        heard: how surely a voice was heard there in that decision, see `uncertainty.Law.heard`.
        age: how many decisions ago it was seen.
    """

    position: np.ndarray
    velocity: np.ndarray
    lasting: float
    confirmed: float = UNKNOWN
    course: Course = field(default_factory=Course)
    heard: float = 0.0
    age: int = 1


class Memory:
    """The traces of earlier decisions, and how loud they were.

    Args:
        rate: decisions per second, Hz.
        max_speed: m/s, the fastest that a talker walks along x or y.
        kept: how much of a trace is left one decision later, 0 to 1.
    """

    def __init__(self, rate: float, max_speed: float, kept: float):
        self.rate, self.max_speed, self.kept = rate, max_speed, kept
        self.traces: list[Trace] = []
        self.levels: deque[float] = deque(maxlen=max(1, round(rate)))  # dB, of the last second of sound
        self.heard = np.zeros((0, 3))  # of all that was seen lately x and y in m, and how much it counts

    def forget(self) -> None:
        """Begin anew, as after a gap in the stream."""
        self.traces = []
        self.levels.clear()
        self.heard = self.heard[:0]

    def fall(self, power: float) -> float:
        """Take the power of a decision's sound, and return its level over the loudest of the last second, dB."""
        self.levels.append(10.0 * float(np.log10(max(power, 1e-30))))
        return self.levels[-1] - max(self.levels)

    def reach(self, trace: Trace) -> float:
        """Return how far, in m, its talker may seem to have moved since: people walk, and positions have errors."""
        return 0.2 + self.max_speed * trace.age / self.rate

    def known(self) -> list[Trace]:
        """Return the traces that are worth looking for again."""
        return [trace for trace in self.traces if trace.lasting > 0.5 or trace.confirmed > SOUGHT]

    def confirmed(self, before: float, own: float = UNKNOWN) -> float:
        """Return what is confirmed of a trace, by what was a decision before and by what speaks for it now alone."""
        return max(before - FADE / self.rate, min(own, CONFIRMED), UNKNOWN)

    def familiar(self, position: np.ndarray) -> float:
        """Return how often and how surely a voice was heard lately where a place (3,) m is, from 0 to 1.

        Who talks stays for seconds, while what is left of a first talker and his echoes peaks here and there.
        """
        near = np.hypot(*(self.heard[:, :2] - position[:2]).T) < FAMILIAR_M
        return min(float(self.heard[near, 2].sum()), 1.0)

    def keep(self, seen: list[Trace]) -> None:
        """Take what a decision saw, and keep what fades of those before it."""
        share = 1.0 / (self.rate * FAMILIAR_S)
        new = [[*one.position[:2], share * one.heard] for one in seen]
        heard = np.array([*self.heard, *new]).reshape(-1, 3) * [1.0, 1.0, np.exp(-share)]
        self.heard = heard[heard[:, 2] > 0.05 * share]
        self.traces = seen + [
            replace(
                trace,
                lasting=self.kept * trace.lasting,
                confirmed=self.confirmed(trace.confirmed),
                age=trace.age + 1,
            )
            for trace in self.traces
            if abs(trace.lasting) > 0.05
            and all(level_distance(trace.position, one.position) > self.reach(trace) for one in seen)
        ]


def level_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the distance in x and y, m, of two positions (3,)."""
    return float(np.hypot(*(one - other)[:2]))
