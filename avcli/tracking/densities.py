"""Densities of single people, each under one single-target hypothesis: one row each of some arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import accumulate
from operator import attrgetter
from typing import Any

import numpy as np

from avcli.tracking.smoothing import Node

NEVER = -math.inf  # s


@dataclass
class Densities:
    """Rows of single-person densities.

    Attributes:
        mean: (n, M, 4) m and m/s, of a mixture over the M motion models.
        cov: (n, M, 4, 4).
        mode: (n, M) probabilities of the models.
        existence: (n,) probability of existence, or of a tentative person the expected number.
        detectable: (n, S) probability that each sensor can detect the person.
        lean: (n, S) share of each sensor's lasting error that the position follows, see `errors`.
        seen: (n, S) s, when each sensor detected the person last, NEVER: never.
        place: (n, 2) m, where any sensor did so last.
        hits: (n, S) how often each sensor did so.
        told: (n,) nats by which these detections are likelier of one person than of clutter of 1 in a record.
        counted: (n, S) how many of these have counted as false, in learning each sensor's clutter.
        doubt: (n, S) probability that it is nobody by the best score of each sensor, 0: some have none; of a camera
            that has never detected the person, 1 or more: by so many times nobody is likelier for that reason.
        reach: (n,) m, how uncertain the position was then.
        common: (n, 2, 2) m², of the errors that a person's detections have in common, see `errors`.
        label: n integers, -1: none yet.
        node: n ends of histories, for smoothing.
        traits: (n, 5, D) what is known of each person's features, see `features`; D is 0 without features.
    """

    mean: np.ndarray
    cov: np.ndarray
    mode: np.ndarray
    existence: np.ndarray
    detectable: np.ndarray
    lean: np.ndarray
    seen: np.ndarray
    place: np.ndarray
    hits: np.ndarray
    told: np.ndarray
    counted: np.ndarray
    doubt: np.ndarray
    reach: np.ndarray
    common: np.ndarray
    label: list[int]
    node: list[Node | None]
    traits: np.ndarray = field(default_factory=lambda: np.zeros((0, 5, 0)))

    def __post_init__(self) -> None:
        if len(self.traits) != len(self.label):
            self.traits = np.zeros((len(self.label), 5, 0))

    @staticmethod
    def empty(models: int) -> Densities:
        """Return no rows, of so many motion models and no sensor."""
        return Densities(
            mean=np.zeros((0, models, 4)),
            cov=np.zeros((0, models, 4, 4)),
            mode=np.zeros((0, models)),
            existence=np.zeros(0),
            detectable=np.zeros((0, 0)),
            lean=np.zeros((0, 0)),
            seen=np.zeros((0, 0)),
            place=np.zeros((0, 2)),
            hits=np.zeros((0, 0)),
            told=np.zeros(0),
            counted=np.zeros((0, 0)),
            doubt=np.zeros((0, 0)),
            reach=np.zeros(0),
            common=np.zeros((0, 2, 2)),
            label=[],
            node=[],
        )

    def __len__(self) -> int:
        return len(self.label)

    def take(self, rows: Sequence[int]) -> Densities:
        """Return copies of the given rows, in that order."""
        at = np.array(rows, int)
        label, node = [self.label[i] for i in rows], [self.node[i] for i in rows]
        *columns, traits = [array.take(at, 0) for array in _arrays(self)]
        return Densities(*columns, label, node, traits)  # type: ignore[call-arg]  # mypy counts the list's items

    @staticmethod
    def join(parts: Sequence[Densities]) -> Densities:
        """Return all rows of several, one after another."""
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        labels = [label for part in parts for label in part.label]
        return Densities(label=labels, node=[node for part in parts for node in part.node], **columns)

    def centres(self, rows: Sequence[int] | None = None) -> np.ndarray:
        """Return the mean states (n, 4) of n rows, or of all."""
        if rows is None:
            return (self.mode[:, None] @ self.mean)[:, 0]
        at = np.array(rows, int)
        return (self.mode.take(at, 0)[:, None] @ self.mean.take(at, 0))[:, 0]

    def nobody(self, rows: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the probabilities (n,) that n rows are nobody, and whether (n,) a camera says so, too."""
        doubt = self.doubt.take(rows, 0)
        by_scores = np.multiply.reduce(np.minimum(doubt, 1.0), 1)
        against = np.multiply.reduce(np.maximum(doubt, 1.0), 1)
        odds = by_scores * against
        return odds / np.maximum(odds + 1 - by_scores, 1e-300), against > 1

    def merge(self, groups: Sequence[Sequence[int]], shares: Sequence[Sequence[float]]) -> None:
        """Give the first row of each group the moments of all its rows, model by model, weighted by their shares."""
        rows, first = [row for group in groups for row in group], [group[0] for group in groups]
        of = [k for k, group in enumerate(groups) for _ in group]
        begin = list(accumulate([len(group) for group in groups[:-1]], initial=0))
        totals = [math.fsum(some) for some in shares]
        share = np.array([one / total for some, total in zip(shares, totals, strict=True) for one in some])

        def mixed(values: np.ndarray, weight: np.ndarray = share) -> np.ndarray:
            weight = weight.reshape(weight.shape + (1,) * (values.ndim - weight.ndim))
            return np.add.reduceat(weight * values, begin, 0)

        modes, means = self.mode.take(rows, 0), self.mean.take(rows, 0)
        self.mode[first] = mode = mixed(modes)
        weight = share[:, None] * modes / mode.take(of, 0)
        self.mean[first] = mean = mixed(means, weight)
        away = means - mean.take(of, 0)
        self.cov[first] = mixed(self.cov.take(rows, 0) + away[..., None] * away[..., None, :], weight)
        for column in (self.existence, self.detectable, self.lean, self.common):
            column[first] = mixed(column.take(rows, 0))
        if self.traits.size:
            traits = self.traits.take(rows, 0)
            trait = mixed(traits)
            x, u = (traits - trait.take(of, 0))[:, :2].swapaxes(0, 1)
            trait[:, 2:] += mixed(np.stack([x * x, x * u, u * u], 1))
            self.traits[first] = trait


_ARRAYS = [one.name for one in fields(Densities) if one.name not in ("label", "node")]
_arrays = attrgetter(*_ARRAYS)
