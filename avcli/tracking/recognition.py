"""People who left, and whether somebody who comes is one of them, by features and by where and when they were seen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from avcli.tracking.features import Features

# Chosen by hand; a wrong recognition costs more than a missed one.
RECOGNISED, AT_ONCE = 0.9, 0.95  # probability for the label of a person who left, at the end of WATCHED and before
WATCHED = 5.0  # s after their first detection for which people may be recognised
STRANGERS = 1.0  # people who were never here, as likely to come as so many who were
ALIKE, PAIRS = 0.4, 8.0  # pairs of different people who pass for one, of so many pairs, before any is known
ABSENCE = 1800.0  # s in which a person who left becomes e times less likely to come back
FASTEST, SPREAD = 3.0, 0.7  # m/s: nobody comes back from farther away; growth of the region in which somebody is lost
PASSES = 1.0  # log ratio of the same person's features to two people's, above which these pass for one
KEPT = 50  # people who are remembered


class Left(NamedTuple):
    """A person who is not tracked any more.

    Attributes:
        time: s, when last seen.
        place: (2,) m, where.
        traits: (5, D), see `features`.
    """

    time: float
    place: np.ndarray
    traits: np.ndarray


class Gallery:
    """The people who left, and those who came so lately that they may be one of them.

    Attributes:
        left: label -> person.
        fresh: label -> time in s of the first detection.
        pairs: labels of two people who were there at once -> log ratio of the probabilities of what is known of both
            if they were one person and if they are two.
    """

    def __init__(self) -> None:
        self.left: dict[int, Left] = {}
        self.fresh: dict[int, float] = {}
        self.pairs: dict[tuple[int, int], float] = {}

    def leave(self, label: int, person: Left, features: Features) -> None:
        """Remember a person who is not tracked any more, if there is anything to know that person by."""
        self.fresh.pop(label, None)
        if features.knows(person.traits):
            self.left[label] = person
        if len(self.left) > KEPT:
            del self.left[min(self.left, key=lambda one: self.left[one].time)]

    def come(self, label: int, time: float) -> None:
        """Watch a person who has just got a label, at a time in s, or has it back."""
        if self.left.pop(label, None) is None and self.left:
            self.fresh[label] = time

    def recognise(self, people: Mapping[int, Left], time: float, surface: float, features: Features) -> dict[int, int]:
        """Return the labels of watched people who are recognised -> their labels of before.

        Args:
            people: label -> what is known now of those who are tracked.
            time: s, now.
            surface: of the area where people can be, m².
            features: for the meaning of traits.
        """
        found: dict[int, int] = {}
        self._compare(people, features)
        for label, since in list(self.fresh.items()):
            if time - since > WATCHED:
                del self.fresh[label]
            elif self.left and label in people:
                left = list(self.left.values())
                chances = returned(people[label], since, left, surface, features, self.alike())
                best = int(chances[:-1].argmax())
                if chances[best] > (AT_ONCE if time - since < WATCHED - 0.5 else RECOGNISED):
                    found[label] = list(self.left)[best]
                    del self.fresh[label], self.left[found[label]]
        return found

    def _compare(self, people: Mapping[int, Left], features: Features) -> None:
        """Compare people who are there at once, and so are not one person."""
        for a, one in people.items():
            others = [b for b in people if b > a]
            if others:
                same = features.same(one.traits, np.stack([people[b].traits for b in others]))
                self.pairs.update({(a, b): log for b, log in zip(others, same.tolist(), strict=True)})
        for pair in list(self.pairs)[: -KEPT * KEPT]:
            del self.pairs[pair]

    def alike(self) -> float:
        """Return the share of pairs of different people who pass for one, as far as this scene shows it."""
        return (ALIKE + sum(log > PASSES for log in self.pairs.values())) / (PAIRS + len(self.pairs))


def returned(now: Left, since: float, left: list[Left], surface: float, features: Features, alike: float) -> np.ndarray:
    """Return the probabilities (K + 1,) that a newcomer is each of K people who left, and the last: a stranger.

    Somebody who left is expected near the last place for a while and then anywhere; half of them anywhere at once.

    Args:
        now: the newcomer.
        since: s, of the newcomer's first detection.
        left: those who left.
        surface: of the area where people can be, m².
        features: for the meaning of traits.
        alike: share of strangers who pass for one of them.
    """
    gone = np.array([max(since - one.time, 0.0) for one in left])
    apart = np.linalg.norm(now.place - [one.place for one in left], axis=1)
    spread = np.square(0.5 + SPREAD * gone)
    near = surface * np.exp(-0.5 * np.square(apart) / spread) / (2 * math.pi * spread)
    prior = np.exp(-gone / ABSENCE) * (0.5 + 0.5 * near) * (apart < 1.0 + FASTEST * (now.time - since + gone))
    faded = np.stack([features.faded(one.traits, now.time - one.time) for one in left])
    same = features.same(now.traits, faded)
    stranger = np.logaddexp(math.log(1 - alike), math.log(alike) + np.logaddexp.reduce(same) - math.log(len(left)))
    log = np.append(np.log(np.maximum(prior, 1e-300)) + same, math.log(STRANGERS) + stranger)
    chances = np.exp(log - log.max())
    return chances / chances.sum()
