"""Clusters of joint hypotheses: which single-target hypothesis of each label goes with which of the others.

A row is a row of `Densities`, one single-target hypothesis. A joint hypothesis is a tuple of rows, one for each label.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from avcli.tracking.densities import Densities
from avcli.tracking.features import Features
from avcli.tracking.smoothing import Node

ABSENT = -1  # in the place of a row: the label does not exist in this joint hypothesis
INDEPENDENT = 0.05  # total variation of two labels' joint weights from their product that passes for independence
ALIKE = np.array([0.14, 0.14, 0.6, 0.6])  # m, m/s; rows of one label as near as this are merged
TWINS = np.array([0.035, 0.035, 0.14, 0.14])  # m, m/s; rows of two labels as near as this are of the same person
# With features, chosen on parting-voice, seeds 100 to 131 and 200 to 231: HOTA 82 without EXCHANGE, 93.3 with 0.05,
# 94.6 with 0.2 to 0.5; parting-looks loses 0.1.
TELL = 0.2  # divergence of one look, see `Features.apart`; rows whose features are as far apart are neither
BESIDE, EXCHANGE = 0.3, 0.2  # m; least weight of the exchange of two people as near to each other as this
FEATURED = 0.001  # in place of INDEPENDENT: else an exchange that is improbable now is lost before features can tell
TWIN_DETECTABLE = 0.2  # as far as the probabilities that sensors can detect them are as near as this
GONE = 0.03  # existence of a row below which nobody is at its place

Joint = tuple[int, ...]


class Cluster:
    """Joint hypotheses about some labels.

    Attributes:
        labels: of people.
        hypotheses: each a tuple of one row per label (`ABSENT`: no such person).
        weights: their log weights, normalised; the first is the best.
        shares: their weights.
    """

    def __init__(self, labels: list[int], hypotheses: list[Joint], weights: list[float]) -> None:
        self.labels, self.hypotheses, self.weights = labels, hypotheses, weights
        self.shares = [math.exp(weight) for weight in weights]

    def marginals(self, at: int, existence: np.ndarray) -> tuple[dict[int, float], float]:
        """Return the marginal of one label.

        Args:
            at: its index in `labels`.
            existence: of each row.

        Returns:
            The probability of each of its rows, and the probability that the label exists.
        """
        if len(self.hypotheses) == 1:
            row = self.hypotheses[0][at]
            return {row: 1.0}, float(existence[row]) if row >= 0 else 0.0
        shares: dict[int, float] = {}
        for hypothesis, share in zip(self.hypotheses, self.shares, strict=True):
            row = hypothesis[at]
            shares[row] = shares.get(row, 0.0) + share
        return shares, min(1.0, math.fsum(share * existence[row] for row, share in shares.items() if row >= 0))

    def existences(self, existence: np.ndarray) -> list[float]:
        """Return the probability that each label exists, given that of each row."""
        if len(self.hypotheses) == 1:
            return [existence.item(row) if row >= 0 else 0.0 for row in self.hypotheses[0]]
        rows = np.array(self.hypotheses)
        found = np.array(self.shares) @ (existence.take(rows) * (rows >= 0))
        return np.minimum(found, 1.0).tolist()  # shares add up to 1 but for rounding

    def row_shares(self) -> dict[int, float]:
        """Return the weight of each row of all labels, where there are several hypotheses."""
        shares: dict[int, float] = {}
        if len(self.hypotheses) > 1:
            for joint, share in zip(self.hypotheses, self.shares, strict=True):
                for row in joint:
                    shares[row] = shares.get(row, 0.0) + share
            shares.pop(ABSENT, None)
        return shares

    def replaced(self, labels: list[int], hypotheses: Sequence[Joint]) -> Cluster:
        """Return the cluster of other hypotheses, one for each of this one's; equal ones become one."""
        shares: dict[Joint, float] = {}
        for hypothesis, share in zip(hypotheses, self.shares, strict=True):
            shares[hypothesis] = shares.get(hypothesis, 0.0) + share
        return _by_share(labels, shares)

    def only(self, indices: Sequence[int]) -> Cluster:
        """Return the cluster of some of the labels, by their indices in `labels`."""
        if not indices:
            return Cluster([], [()], [0.0])
        return self.split([indices])[0]

    def split(self, parts: Iterable[Sequence[int]]) -> list[Cluster]:
        """Return a cluster of each part of the labels, by their indices in `labels`."""
        columns = list(zip(*self.hypotheses, strict=True))
        return [
            self.replaced([self.labels[at] for at in part], list(zip(*[columns[at] for at in part], strict=True)))
            for part in parts
        ]

    def parts(self, independent: float = INDEPENDENT) -> list[list[int]]:
        """Return the indices of the labels in parts that are independent of each other, but for some variation."""
        count = len(self.labels)
        if len(self.hypotheses) == 1:
            return [[at] for at in range(count)]
        shares = np.array(self.shares)
        owners: list[int] = []
        own: list[int] = []
        for at, rows in enumerate(zip(*self.hypotheses, strict=True)):
            distinct = set(rows)
            if len(distinct) > 1:  # a label with the same row in all hypotheses depends on no other
                owners += [at] * len(distinct)
                own += sorted(distinct)
        held = (np.array(self.hypotheses).T[owners] == np.array(own)[:, None]).astype(float)
        owner = np.array(owners)[:, None] == np.arange(count)
        alone = held @ shares
        linked = (owner.T @ abs(held * shares @ held.T - alone[:, None] * alone) @ owner > 2 * independent).tolist()
        parts, left = [], set(range(count))
        while left:
            part = reach = {min(left)}
            while reach:
                left -= reach
                reach = {b for a in reach for b in left if linked[a][b]}
                part = part | reach
            parts.append(sorted(part))
        return parts

    def exchanged(self, people: Densities, features: Features) -> tuple[Cluster, Densities | None]:
        """Return the cluster with the exchange of any two people who stand together and whose features differ.

        Motion hardly tells who is who of two people who were in one place, and takes itself for sure; their next looks
        or words may tell. So the exchange never becomes less likely than EXCHANGE while they stand together.

        Returns:
            The cluster, and the densities that it needs after those of `people`; None: no others.
        """
        best = self.hypotheses[0]
        there = [at for at, row in enumerate(best) if row >= 0]
        rows = [best[at] for at in there]
        place = people.centres(rows)[:, :2]
        together = np.triu(np.hypot(*(place[:, None] - place).transpose(2, 0, 1)) < BESIDE, 1)
        if not together.any():
            return self, None
        together &= features.apart(people.traits.take(rows, 0)) >= TELL
        shares = dict(zip(self.hypotheses, self.shares, strict=True))
        new: list[Densities] = []
        for i, j in zip(*together.nonzero(), strict=True):
            lacking = (EXCHANGE - self._crossed(there[i], there[j], people)) / (1 - EXCHANGE)  # before they add up to 1
            if lacking <= 0:
                continue
            joint = list(best)
            for own, other in ((there[i], there[j]), (there[j], there[i])):
                row, who = people.take([best[other]]), best[own]
                node = people.node[who]  # of the same past, but a node of its own: each row writes into its node
                row.label, row.traits = [people.label[who]], people.traits[[who]]
                row.node = [node and Node.fork(node, node.time)]
                joint[own] = len(people) + len(new)
                new.append(row)
            shares[tuple(joint)] = lacking
        if not new:
            return self, None
        total = math.fsum(shares.values())
        return _by_share(self.labels, {h: share / total for h, share in shares.items()}), Densities.join(new)

    def _crossed(self, a: int, b: int, people: Densities) -> float:
        """Return the weight of hypotheses in which each of two labels is nearer to where the best has the other one."""
        rows = np.array(self.hypotheses)[:, [a, b]]
        place = people.centres(rows.ravel().tolist())[:, :2].reshape(-1, 2, 2)
        apart = np.linalg.norm(place[:, :, None] - place[0], axis=3)
        crossed = (apart[:, 0, 1] < apart[:, 0, 0]) & (apart[:, 1, 0] < apart[:, 1, 1]) & (rows >= 0).all(1)
        return float(np.array(self.shares) @ crossed)


def condensed(clusters: Sequence[Cluster], people: Densities, features: Features | None = None) -> list[Cluster]:
    """Return the clusters with each label's rows that are ALIKE merged, in `people`, and so equal hypotheses.

    All clusters at once: they share no row, and a call of NumPy costs more than what it computes for one of them.
    """
    if max([len(cluster.hypotheses) for cluster in clusters], default=1) == 1:
        return list(clusters)
    states = (people.centres() / ALIKE).view(complex).tolist()
    several: list[list[int]] = []
    worth: list[list[float]] = []
    out = []
    for cluster in clusters:
        groups: list[list[int]] = []
        shares = cluster.row_shares()
        if len(shares) > len(cluster.labels):
            rows = sorted(shares, key=lambda row: (people.label[row], -shares[row], row))
            groups = [group for group in _alike(rows, states, people, features) if len(group) > 1]
        if groups:
            same = {row: group[0] for group in groups for row in group}
            cluster = cluster.replaced(
                cluster.labels, [tuple([same.get(row, row) for row in joint]) for joint in cluster.hypotheses]
            )
            several += groups
            worth += [[shares[row] for row in group] for group in groups]
        out.append(cluster)
    if several:
        people.merge(several, worth)
    return out


def decided(clusters: Sequence[Cluster], people: Densities, features: Features | None = None) -> list[Cluster]:
    """Return the clusters without hypotheses that differ from a likelier one only in which person has which label.

    Where the same people stand at the same positions under exchanged labels, no later record can tell which is
    right. The likelier labels stay, so that they do not come and go with the last digits of the weights. Of several who
    left, one may have come back: where the others are does not matter once they are hardly there. Else that one would
    never be shown, since each label has but a share of the person.
    """
    doubtful = [k for k, one in enumerate(clusters) if len(one.labels) > 1 and len(one.hypotheses) > 1]
    out = list(clusters)
    if doubtful:
        states = np.hstack([people.centres() / TWINS, people.detectable / TWIN_DETECTABLE])
        for k in doubtful:
            out[k] = _decided(clusters[k], states, people, features)
    return out


def _decided(cluster: Cluster, states: np.ndarray, people: Densities, features: Features | None) -> Cluster:
    """Decide one cluster; states: (rows of `people`, 4 + S), in units of what tells two people apart."""
    rows = sorted({row for hypothesis in cluster.hypotheses for row in hypothesis if row >= 0})
    if len(rows) <= len(cluster.labels):
        return cluster
    state = states.take(rows, 0)
    apart = np.add.reduce(np.square(state[:, None] - state), 2)
    if features and features.width:
        apart += features.apart(people.traits.take(rows, 0)) / TELL
    twin = (apart < 1).argmax(1).tolist()
    gone = (people.existence.take(rows) < GONE).tolist()
    twin_of = {row: ABSENT if out else at for row, at, out in zip(rows, twin, gone, strict=True)} | {ABSENT: ABSENT}
    shares: dict[Joint, float] = {}
    first: dict[tuple[int, ...], Joint] = {}
    for hypothesis, share in zip(cluster.hypotheses, cluster.shares, strict=True):
        likelier = first.setdefault(tuple(sorted([twin_of[row] for row in hypothesis])), hypothesis)
        shares[likelier] = shares.get(likelier, 0.0) + share
    return cluster if len(shares) == len(cluster.hypotheses) else _by_share(cluster.labels, shares)


def _by_share(labels: list[int], shares: dict[Joint, float]) -> Cluster:
    hypotheses = sorted(shares, key=lambda hypothesis: -shares[hypothesis])
    return Cluster(labels, hypotheses, [math.log(shares[hypothesis]) for hypothesis in hypotheses])


def _alike(
    rows: Sequence[int], states: Sequence[Sequence[complex]], people: Densities, features: Features | None
) -> list[list[int]]:
    """Group rows, sorted by label and then by weight, with the likeliest row of their label that they are ALIKE.

    states: position and velocity of each row of `people`, in units of ALIKE.
    """
    unlike = (features.apart(people.traits.take(rows, 0)) / TELL).tolist() if features and features.width else None
    groups: list[list[int]] = []
    heads: list[tuple[complex, complex, list[int], int]] = []  # of one label: state, group and number of the likeliest
    label = None
    for at, row in enumerate(rows):
        position, velocity = states[row]
        if people.label[row] != label:
            heads, label = [], people.label[row]
        for its_position, its_velocity, group, head in heads:
            apart = abs(position - its_position) ** 2 + abs(velocity - its_velocity) ** 2
            if apart < 1 and not (unlike and apart + unlike[at][head] >= 1):
                group.append(row)
                break
        else:
            groups.append([row])
            heads.append((position, velocity, groups[-1], at))
    return groups
