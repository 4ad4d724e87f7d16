"""Densities of single people, each under one single-target hypothesis: one row each of some arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from avcli.tracking.smoothing import Node


class Densities:
    """Rows of single-person densities.

    Attributes:
        mean: (n, M, 4) m and m/s, of a mixture over the M motion models.
        cov: (n, M, 4, 4).
        mode: (n, M) probabilities of the models.
        existence: (n,) probability of existence, or of a tentative person the expected number.
        detectable: (n, S) probability that each sensor can detect the person.
        lean: (n, S) share of each sensor's lasting error that the position follows, see `errors`.
        label: n integers, -1: none yet.
        node: n ends of histories, for smoothing.
    """

    def __init__(
        self,
        mean: np.ndarray,
        cov: np.ndarray,
        mode: np.ndarray,
        existence: np.ndarray,
        detectable: np.ndarray,
        lean: np.ndarray,
        label: list[int],
        node: list[Node | None],
    ) -> None:
        self.mean, self.cov, self.mode, self.existence, self.detectable = mean, cov, mode, existence, detectable
        self.lean, self.label, self.node = lean, label, node

    @staticmethod
    def empty(models: int) -> Densities:
        """Return no rows, of so many motion models and no sensor."""
        m = models
        return Densities(
            np.zeros((0, m, 4)),
            np.zeros((0, m, 4, 4)),
            np.zeros((0, m)),
            np.zeros(0),
            np.zeros((0, 0)),
            np.zeros((0, 0)),
            [],
            [],
        )

    def __len__(self) -> int:
        return len(self.label)

    def take(self, rows: Sequence[int]) -> Densities:
        """Return copies of the given rows, in that order."""
        at = np.array(rows, int)
        return Densities(
            self.mean.take(at, 0),
            self.cov.take(at, 0),
            self.mode.take(at, 0),
            self.existence.take(at, 0),
            self.detectable.take(at, 0),
            self.lean.take(at, 0),
            [self.label[i] for i in rows],
            [self.node[i] for i in rows],
        )

    @staticmethod
    def join(parts: Sequence[Densities]) -> Densities:
        """Return all rows of several, one after another."""
        return Densities(
            np.concatenate([part.mean for part in parts]),
            np.concatenate([part.cov for part in parts]),
            np.concatenate([part.mode for part in parts]),
            np.concatenate([part.existence for part in parts]),
            np.concatenate([part.detectable for part in parts]),
            np.concatenate([part.lean for part in parts]),
            [label for part in parts for label in part.label],
            [node for part in parts for node in part.node],
        )

    def centres(self, rows: Sequence[int]) -> np.ndarray:
        """Return the mean states (n, 4) of n rows."""
        return (self.mode.take(rows, 0)[:, None] @ self.mean.take(rows, 0))[:, 0]

    def merge(self, rows: Sequence[int], shares: Sequence[float]) -> None:
        """Give the first of n rows the moments of all, model by model, weighted by n shares."""
        share, first = np.array(shares) / math.fsum(shares), rows[0]
        modes = self.mode.take(rows, 0)
        self.mode[first] = mode = share @ modes
        weight = (share[:, None] * modes / mode).T[:, None]  # (M, 1, n)
        means = self.mean.take(rows, 0).swapaxes(0, 1)
        self.mean[first] = mean = (weight @ means)[:, 0]
        away = (means - mean[:, None]) * np.sqrt(weight).swapaxes(1, 2)
        covs = self.cov.take(rows, 0).reshape(len(rows), -1, 16).swapaxes(0, 1)
        self.cov[first] = (weight @ covs).reshape(-1, 4, 4) + away.swapaxes(1, 2) @ away
        self.existence[first] = share @ self.existence.take(rows)
        self.detectable[first] = share @ self.detectable.take(rows, 0)
        self.lean[first] = share @ self.lean.take(rows, 0)
