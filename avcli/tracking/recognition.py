"""People who left, and whether somebody who comes is one of them, by features and by where and when they were seen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from avcli.tracking.features import Features

# Chosen by hand; a wrong recognition costs more than a missed one.
RECOGNISED = 0.9  # probability at which somebody who comes gets the label of a person who left
LASTING = 1.0  # s between the first and last detection of who is remembered: not a few false detections
WATCHED = 5.0  # s after their first detection for which people may be recognised
STRANGERS = 1.0  # people who were never here, as likely to come as so many who were
UNIFORM = 0.2  # probability that a scene's people are dressed alike, before any are compared
ALIKE = np.array([[0.2, 7.8], [9.0, 1.0]])  # pairs who pass for one, and who do not: elsewhere, where dressed alike
ABSENCE = 1800.0  # s in which a person who left becomes e times less likely to come back
FASTEST, SPREAD = 3.0, 0.7  # m/s: nobody comes back from farther away; growth of the region in which somebody is lost
PASSES, DIFFERS = 1.0, -2.0  # log ratio of one person's features to two people's: above, these pass for one
KEPT = 50  # people who are remembered


class Left(NamedTuple):
    """A person who is not tracked any more.

    Attributes:
        time: s, when last seen.
        place: (2,) m, where.
        traits: (5, D), see `features`.
        since: s, when first detected.
    """

    time: float
    place: np.ndarray
    traits: np.ndarray
    since: float = -math.inf


class Gallery:
    """The people who left, and those who came so lately that they may be one of them.

    Whether strangers pass for each other is learnt of the scene: in most, people are dressed differently, in some all
    wear the same. Until two people have been seen who differ, nobody is recognised by features that fit alone.

    Attributes:
        left: label -> person.
        fresh: label -> time in s of the first detection.
        since: label -> the same, of all who are tracked.
        pairs: two labels -> whether the two pass for one, and the probability that they are two people.
    """

    def __init__(self) -> None:
        self.left: dict[int, Left] = {}
        self.fresh: dict[int, float] = {}
        self.since: dict[int, float] = {}
        self.pairs: dict[tuple[int, int], tuple[bool, float]] = {}

    def leave(self, label: int, person: Left, features: Features) -> None:
        """Remember a person who is not tracked any more, if there is anything to know that person by."""
        self.fresh.pop(label, None)
        since = self.since.pop(label, -math.inf)
        if features.knows(person.traits) and person.time > since + LASTING:
            self.left[label] = person._replace(since=since)
        if len(self.left) > KEPT:
            del self.left[min(self.left, key=lambda one: self.left[one].time)]

    def come(self, label: int, time: float) -> None:
        """Watch a person who has just got a label, at a time in s, or has it back."""
        before = self.left.pop(label, None)
        self.since[label] = time if before is None else before.since
        if before is None and self.left:
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
            if self.left and label in people:
                chances = self._returned(label, people[label], since, list(self.left), surface, features)
                best = int(chances[:-1].argmax())
                if chances[best] > RECOGNISED:
                    found[label] = list(self.left)[best]
                    self.since[found[label]] = self.left[found[label]].since
                    del self.fresh[label], self.left[found[label]], self.since[label]
                elif time - since > WATCHED:
                    self._note(label, people[label], chances, features)
            if time - since > WATCHED and self.fresh.pop(label, None) is not None:
                self._unite(surface, features)
        return found

    def _returned(
        self, label: int, now: Left, since: float, before: list[int], surface: float, features: Features
    ) -> np.ndarray:
        """Return the probabilities that a label is each of those before it, or a stranger, as `returned` does."""
        left = [self.left[one] for one in before]
        return returned(now, since, left, surface, features, self.alike(label))

    def _compare(self, people: Mapping[int, Left], features: Features) -> None:
        """Compare people who are there at once, and so are not one person."""
        lasting = sorted(
            label for label, one in people.items() if one.time > self.since.get(label, -math.inf) + LASTING
        )
        for k, a in enumerate(lasting[:-1]):
            others = lasting[k + 1 :]
            same = features.same(people[a].traits, np.stack([people[b].traits for b in others]))
            for b, log in zip(others, same.tolist(), strict=True):
                self._count((a, b), log, 1.0)

    def _note(self, label: int, now: Left, chances: np.ndarray, features: Features) -> None:
        """Compare a person who was not recognised, of n + 1 chances, with the n who left."""
        faded = np.stack([features.faded(one.traits, now.time - one.time) for one in self.left.values()])
        same = features.same(now.traits, faded).tolist()
        for other, log, chance in zip(list(self.left), same, chances.tolist(), strict=False):
            self._count((min(label, other), max(label, other)), log, 1 - chance)

    def _count(self, pair: tuple[int, int], log: float, two: float) -> None:
        """Count a pair of labels with a log ratio of one person to two, which are two with a probability."""
        self.pairs.pop(pair, None)
        if log > PASSES or log < DIFFERS:
            self.pairs[pair] = log > PASSES, two
        if len(self.pairs) > KEPT * KEPT:
            del self.pairs[next(iter(self.pairs))]

    def _unite(self, surface: float, features: Features) -> None:
        """Forget who left and, as is known by now, was recognised too late: that person left again since."""
        for label in sorted(self.left, key=lambda one: self.left[one].since):
            now = self.left[label]
            before = [one for one in self.left if self.left[one].time < now.since]
            if before:
                chances = self._returned(label, now, now.since, before, surface, features)
                best = int(chances[:-1].argmax())
                if chances[best] > RECOGNISED:
                    self.left[label] = now._replace(since=self.left[before[best]].since)
                    del self.left[before[best]]
                    self.pairs = {pair: one for pair, one in self.pairs.items() if before[best] not in pair}

    def alike(self, doubted: int | None = None) -> float:
        """Return the probability that two different people pass for one, as far as this scene shows it.

        A mixture of two beta distributions, one for scenes whose people are dressed alike, after the pairs so far.

        Args:
            doubted: a label; that somebody passes for that person is what is asked, and so not counted.
        """
        passing, differing = (
            math.fsum(two for pair, (one, two) in self.pairs.items() if one == passes and not (one and doubted in pair))
            for passes in (True, False)
        )
        counts = ALIKE + np.array([passing, differing])
        log = np.log([1 - UNIFORM, UNIFORM])
        log += [
            _betaln(*after) - _betaln(*before) for after, before in zip(counts.tolist(), ALIKE.tolist(), strict=True)
        ]
        weight = np.exp(log - log.max())
        return float(weight @ (counts[:, 0] / counts.sum(1)) / weight.sum())


def _betaln(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def returned(now: Left, since: float, left: list[Left], surface: float, features: Features, alike: float) -> np.ndarray:
    """Return the probabilities (K + 1,) that a newcomer is each of K people who left, and the last: a stranger.

    Somebody who left is expected near the last place for a while and then anywhere; half of them anywhere at once.

    Args:
        now: the newcomer.
        since: s, of the newcomer's first detection.
        left: those who left.
        surface: of the area where people can be, m².
        features: for the meaning of traits.
        alike: probability that two different people pass for one.

    Source:
        D. Blackwell and J. B. MacQueen, "Ferguson distributions via Pólya urn schemes", Annals of Statistics 1(2),
        1973 (whom a stranger looks like).
    """
    gone = np.array([max(since - one.time, 0.0) for one in left])
    apart = np.linalg.norm(now.place - [one.place for one in left], axis=1)
    spread = np.square(0.5 + SPREAD * gone)
    near = surface * np.exp(-0.5 * np.square(apart) / spread) / (2 * math.pi * spread)
    prior = np.exp(-gone / ABSENCE) * (0.5 + 0.5 * near) * (apart < 1.0 + FASTEST * (now.time - since + gone))
    faded = np.stack([features.faded(one.traits, now.time - one.time) for one in left])
    same = features.same(now.traits, faded)
    new = 1 / alike - 1  # a look or voice that is new here, as likely as so many people's
    stranger = np.logaddexp(math.log(new), np.logaddexp.reduce(same)) - math.log(new + len(left))
    log = np.append(np.log(np.maximum(prior, 1e-300)) + same, math.log(STRANGERS) + stranger)
    chances = np.exp(log - log.max())
    return chances / chances.sum()
