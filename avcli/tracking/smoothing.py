"""Smoothing: what later records say about earlier times, along the history of each density.

A density's history is a chain of nodes, one for each time. Between two of them the joint Gaussian of the state before
and after is that of the whole model mixture, so the Rauch-Tung-Striebel step (1965) is its linear regression. Existence
is smoothed with it: whoever is found again was there all the time, whoever is not has probably left earlier.
"""

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.model import Track


class Node:
    """One density at one time.

    time: s. prev: the node before, or None. mean (4,), cov (4, 4), exist, found: filtered, written when the next step
    begins. gain (4, 4), ahead (4,), spread (4, 4), survive: regression of the state before on the state now.
    """

    __slots__ = ("ahead", "cov", "exist", "found", "gain", "mean", "prev", "spread", "survive", "time")

    def __init__(self, time):
        self.time, self.prev = time, None

    @staticmethod
    def fork(node, time):
        """A node of its own for a density that a record has just made from another (None: from nothing)."""
        new = Node(time)
        if node is not None and node.prev is not None:
            new.prev, new.gain, new.ahead = node.prev, node.gain, node.ahead
            new.spread, new.survive = node.spread, node.survive
        return new

    @staticmethod
    def steps(people, before, half, mixed, survive, time):
        """Close the nodes of all densities and open those of the next time, after `gaussian.predict`.

        people: predicted Densities whose exist and node are still the old ones; before: (mean, cov, mode) then; half
        (n, M, 4, 4), mixed (n, M, 4): as `predict` returns them. Returns the list of new nodes.
        """
        mean, cov = gaussian.moments(*before)
        ahead, spread = gaussian.moments(people.mean, people.cov, people.mode)
        weight = people.mode[..., None]
        cross = (weight[..., None] * half).sum(1)
        if people.mode.shape[1] > 1:
            away = (mixed - mean[:, None]) * weight
            cross = cross + away.swapaxes(1, 2) @ (people.mean - ahead[:, None])
        gain = np.linalg.solve(spread, cross.swapaxes(1, 2)).swapaxes(1, 2)
        nodes = []
        for i, old in enumerate(people.node):
            old.mean, old.cov, old.exist, old.found = mean[i], cov[i], min(float(people.exist[i]), 1.0), people.found[i]
            new = Node(time)
            new.prev, new.gain, new.ahead, new.spread, new.survive = old, gain[i], ahead[i], spread[i], survive[i]
            nodes.append(new)
        return nodes


def backwards(node, mean, cov, exist):
    """Smoothed estimates at the node's time and at each one before, latest first.

    node: Node; mean (4,), cov (4, 4), exist: the estimate at its time. Yields (node, mean, cov, exist).
    """
    yield node, mean, cov, exist
    while (prev := node.prev) is not None:
        mean = prev.mean + node.gain @ (mean - node.ahead)
        cov = prev.cov + node.gain @ (cov - node.spread) @ node.gain.T
        cov = (cov + cov.T) / 2
        left = prev.exist * (1 - node.survive)
        exist = exist + (1 - exist) * left / (left + 1 - prev.exist + 1e-300)
        node = prev
        yield node, mean, cov, exist


class Delayed:
    """Tracks of a filter some steps ago, smoothed by all that came since."""

    def __init__(self, tracker, steps):
        """tracker: GLMB that records; steps: how many steps ago, math.inf: all at the end."""
        self.tracker, self.steps, self.times = tracker, steps, []

    def push(self, time):
        """Take note that the tracker has seen everything up to a step's time (s).

        Returns [(time, [Track, ...])] of the steps that are due: none or one.
        """
        self.tracker.advance(time)
        self.times.append(time)
        if len(self.times) <= self.steps:
            return []
        due = self.times.pop(0)
        tracks = self._collect([due])
        if len(self.times) % 8 == 0 or self.tracker.scans % 8 == 0:
            self._forget(due)
        return tracks

    def finish(self):
        """The steps that are left, as `push` returns them."""
        times, self.times = self.times, []
        return self._collect(times)

    def _ends(self):
        """(label, probability of being meant, node, mean, cov, existence if meant) of each history's end."""
        tracker = self.tracker
        found = tracker.labelled()
        if found:
            rows = [leaf for _, leaf, *_ in found]
            people = tracker.people
            mean, cov = gaussian.moments(people.mean[rows], people.cov[rows], people.mode[rows])
            for k, (label, leaf, exist, meant) in enumerate(found):
                node = people.node[leaf]
                node.found = people.found[leaf]
                yield label, meant, node, mean[k], cov[k], min(exist / meant, 1.0)
        for label, (*end, meant) in tracker.retired.items():
            yield label, meant, *end

    def _collect(self, times):
        wanted = {round(time, 6): [] for time in times}
        earliest = min(wanted, default=0.0)
        for label, meant, *end in self._ends():
            for node, mean, cov, exist in backwards(*end):
                now = round(node.time, 6)
                if now < earliest:
                    break
                if now in wanted and meant * exist > 0.5:
                    found = dict(zip(self.tracker.column, node.found.tolist(), strict=False))
                    wanted[now].append(Track(label, mean, cov, min(meant * exist, 1.0), found))
        return [(time, sorted(wanted[round(time, 6)], key=lambda track: track.label)) for time in times]

    def _forget(self, time):
        """Cut all histories before a time, so that memory does not grow."""
        retired = self.tracker.retired
        for label in [label for label, end in retired.items() if end[0].time < time - 1e-6]:
            del retired[label]
        for node in [*self.tracker.people.node, *(end[0] for end in retired.values())]:
            while node is not None and node.time >= time - 1e-6:
                node = node.prev
            if node is not None:
                node.prev = None
