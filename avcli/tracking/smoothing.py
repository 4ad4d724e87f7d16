"""Smoothing: what later records say about earlier times, along the history of each density.

A density's history is a chain of nodes, one for each time. Between two of them the joint Gaussian of the state before
and after is that of the whole model mixture, so the Rauch-Tung-Striebel step is its linear regression. Existence is
smoothed with it: a person who is detected again was there all the time, one who is not has probably left earlier.

Source:
    H. E. Rauch, F. Tung and C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal
    3(8), 1965.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.model import BLUR, NEAR, REPORT, THERE, Track

if TYPE_CHECKING:
    from avcli.tracking.densities import Densities
    from avcli.tracking.trackers import Smoothable

FORGET_EVERY = 8  # steps


class Node:
    """One density at one time.

    Attributes:
        time: s.
        prev: the node before, or None.
        mean, cov, existence, detectable, seen, reach: (4,), (4, 4), probability, (S,), s and m (the last two of the
            last detection, see `Densities`): filtered, written when the next step begins.
        lasting: (2, 2) m², of the position by errors that last, which `cov` leaves out.
        gain: (4, 4), of the regression of the state before on the state now.
        predicted, predicted_cov: (4,) and (4, 4), of the state now.
        survival: probability of surviving the step.
    """

    __slots__ = (
        "cov",
        "detectable",
        "existence",
        "gain",
        "lasting",
        "mean",
        "predicted",
        "predicted_cov",
        "prev",
        "reach",
        "seen",
        "survival",
        "time",
    )

    mean: np.ndarray
    cov: np.ndarray
    existence: float
    detectable: np.ndarray
    seen: float
    reach: float
    lasting: np.ndarray
    gain: np.ndarray
    predicted: np.ndarray
    predicted_cov: np.ndarray
    survival: float

    def __init__(self, time: float) -> None:
        self.time = time
        self.prev: Node | None = None

    @staticmethod
    def fork(node: Node | None, time: float) -> Node:
        """Return a node of its own for a density that a record has just made from another (None: from nothing)."""
        new = Node(time)
        if node is not None and node.prev is not None:
            new.prev, new.gain, new.predicted = node.prev, node.gain, node.predicted
            new.predicted_cov, new.survival = node.predicted_cov, node.survival
        return new

    def note(self, people: Densities, row: int, lasting: np.ndarray) -> None:
        """Write what a track says beside its state, by a row of `people`; lasting: (2, 2) m², see `Node`."""
        self.detectable, self.lasting = people.detectable[row], lasting
        self.seen, self.reach = float(people.seen[row].max(initial=-math.inf)), float(people.reach[row])

    @staticmethod
    def steps(
        people: Densities,
        before: Sequence[np.ndarray],
        step: gaussian.Prediction,
        survival: np.ndarray,
        lasting: np.ndarray,
        time: float,
    ) -> list[Node | None]:
        """Close the nodes of all densities and open those of the next time.

        Args:
            people: predicted densities whose existence and node are still those before.
            before: mean, cov and mode before.
            step: what `gaussian.predict` returned.
            survival: (n,) probabilities.
            lasting: (n, 2, 2) m², see `Node`, before.
            time: s, the next time.

        Returns:
            The n new nodes.
        """
        mean, cov = gaussian.moments(*before)
        predicted, predicted_cov = gaussian.moments(people.mean, people.cov, people.mode)
        weight = people.mode[..., None]
        cross = (weight[..., None] * step.cross).sum(1)
        if people.mode.shape[1] > 1:
            away = (step.mixed - mean[:, None]) * weight
            cross = cross + away.swapaxes(1, 2) @ (people.mean - predicted[:, None])
        gain = np.linalg.solve(predicted_cov, cross.swapaxes(1, 2)).swapaxes(1, 2)
        nodes: list[Node | None] = []
        for i, old in enumerate(people.node):
            if old is None:
                raise ValueError("a density without a node cannot be smoothed")
            old.mean, old.cov, old.existence = mean[i], cov[i], min(float(people.existence[i]), 1.0)
            old.note(people, i, lasting[i])
            new = Node(time)
            new.prev, new.gain, new.predicted = old, gain[i], predicted[i]
            new.predicted_cov, new.survival = predicted_cov[i], survival[i]
            nodes.append(new)
        return nodes


class End(NamedTuple):
    """The latest end of one person's history.

    Attributes:
        label: of the person.
        meant: probability that the label's first detection was a person at all, who may have left since.
        node: the last node.
        mean: (4,), the estimate at its time.
        cov: (4, 4).
        existence: probability, if the label is meant.
        doubt: probability that it is nobody by the sensors' scores, see `Densities.nobody`.
        contested: whether a camera says so, too.
    """

    label: int
    meant: float
    node: Node
    mean: np.ndarray
    cov: np.ndarray
    existence: float
    doubt: float
    contested: bool


def backwards(
    node: Node, mean: np.ndarray, cov: np.ndarray, existence: float
) -> Iterator[tuple[Node, np.ndarray, np.ndarray, float]]:
    """Yield smoothed estimates at the node's time and at each one before, latest first.

    Args:
        node: where to begin.
        mean: (4,), the estimate at its time.
        cov: (4, 4).
        existence: probability.

    Yields:
        node, mean, cov, existence.
    """
    yield node, mean, cov, existence
    while (prev := node.prev) is not None:
        mean = prev.mean + node.gain @ (mean - node.predicted)
        cov = prev.cov + node.gain @ (cov - node.predicted_cov) @ node.gain.T
        cov = (cov + cov.T) / 2
        left = prev.existence * (1 - node.survival)
        existence = existence + (1 - existence) * left / (left + 1 - prev.existence + 1e-300)
        node = prev
        yield node, mean, cov, existence


class Delayed:
    """Tracks of a filter some steps ago, smoothed by all that came since."""

    def __init__(self, tracker: Smoothable, steps: float) -> None:
        """Delay the tracks of a tracker by so many steps; math.inf: all tracks come at the end."""
        self.tracker, self.steps = tracker, steps
        self.times: list[float] = []
        self.pushed = 0

    def push(self, time: float) -> list[tuple[float, list[Track]]]:
        """Note that the tracker has seen everything up to a step's time (s).

        Returns:
            [(time, tracks)] of the steps that are due: none or one.
        """
        self.tracker.predict(time)
        self.times.append(time)
        self.pushed += 1
        if len(self.times) <= self.steps:
            return []
        due = self.times.pop(0)
        tracks = self._collect([due])
        if self.pushed % FORGET_EVERY == 0:
            self.tracker.forget(due)
        return tracks

    def finish(self) -> list[tuple[float, list[Track]]]:
        """Return the steps that are left, as `push` returns them."""
        times, self.times = self.times, []
        return self._collect(times)

    def _collect(self, times: Sequence[float]) -> list[tuple[float, list[Track]]]:
        wanted: dict[float, dict[int, Track]] = {round(time, 6): {} for time in times}
        earliest = min(wanted, default=-math.inf)
        for end in self.tracker.ends():
            for node, mean, cov, existence in backwards(end.node, end.mean, end.cov, end.existence):
                now = round(node.time, 6)
                if now < earliest:
                    break
                if now in wanted and end.meant * existence > REPORT:
                    there = min(end.meant * existence, 1.0)
                    spread = cov.copy()
                    spread[:2, :2] += node.lasting
                    near = _within(max(NEAR, BLUR * node.reach), cov)
                    if node.time > node.seen:
                        there *= near
                    believed = there * (1 - end.doubt)
                    if (believed if end.contested else there) > THERE:
                        detectable = dict(zip(self.tracker.column, node.detectable.tolist(), strict=False))
                        believed *= min(gaussian.near(spread[None, :2, :2], NEAR).item() / near, 1.0)
                        track = Track(end.label, mean, spread, believed, detectable, node.seen)
                        other = wanted[now].setdefault(end.label, track)  # of who was recognised before that one left
                        if other.existence < believed:
                            wanted[now][end.label] = track
        return [(time, [one for _, one in sorted(wanted[round(time, 6)].items())]) for time in times]


def _within(radius: float, cov: np.ndarray) -> float:
    """Return the probability that a position of covariance (4, 4), as if isotropic, is within a radius in m."""
    return -math.expm1(-radius * radius / max(cov[0, 0] + cov[1, 1], 1e-9))


def cut(nodes: Sequence[Node | None], time: float) -> None:
    """Cut histories before a time in s, so that memory does not grow."""
    for end in nodes:
        node = end
        while node is not None and node.time >= time - 1e-6:
            node = node.prev
        if node is not None:
            node.prev = None
