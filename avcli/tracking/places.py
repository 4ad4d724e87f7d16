"""What is learnt of a room's places: how often something happens there, against how often it was expected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from avcli.tracking.model import Corners

STEP, CELLS = 0.25, 60  # m, wider where a side of the area would have more cells than that
REACH = (2.0, 0.5)  # m, standard deviations of the kernels by which a place learns from those beside it


class Places:
    """A map of factors on expected rates, learnt from what happened: gamma-Poisson, smoothed by a kernel.

    The factor at a place is that of the whole area, times the place's own; both are 1 before anything happened. What
    was expected and what happened nearby count for a place by a Gaussian kernel of their distance.

    Attributes:
        happened, expected: (nx, ny) numbers of events in each cell, real and expected.
        factor: (nx, ny) at the last `refresh`.
    """

    def __init__(self, area: Corners, worth: float, worth_here: float) -> None:
        """Begin with nothing learnt.

        Args:
            area: two corners in m.
            worth: expected events that the prior is worth in the whole area.
            worth_here: the same at one place, once the whole area's factor is known.
        """
        low, high = np.array(area, float)
        self.low, self.step = low, max(STEP, float((high - low).max()) / CELLS)
        self.shape = tuple(np.maximum(np.ceil((high - low) / self.step - 1e-9), 1).astype(int).tolist())
        self._last = np.array(self.shape) - 1
        self._bounds = self.low.tolist(), self._last.tolist()
        self.worth, self.worth_here = worth, worth_here
        self.happened, self.expected = np.zeros(self.shape), np.zeros(self.shape)
        self.factor = np.ones(self.shape)
        self.overall = 1.0
        self._kernels = [[_kernel(n, self.step / reach) for n in self.shape] for reach in REACH]

    def state(self) -> dict[str, Any]:
        """Return what was noted, as `restore` takes it."""
        return {"happened": self.happened.round(4).tolist(), "expected": self.expected.round(6).tolist()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what another map of the same area has noted."""
        maps = [state["happened"], state["expected"]]
        if any([len(row) for row in one] != [self.shape[1]] * self.shape[0] for one in maps):
            raise ValueError("it was learnt in a room of another size")
        self.happened, self.expected = np.array(maps, float)
        self.refresh()

    def centres(self) -> np.ndarray:
        """Return the cells' centres, (nx, ny, 2) m."""
        axes = [low + self.step * (np.arange(n) + 0.5) for low, n in zip(self.low, self.shape, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1)

    def cells(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells (n,), (n,) of positions (n, 2) m; outside the area those of its border."""
        x, y = np.minimum(np.maximum((positions - self.low) / self.step, 0), self._last).astype(int).T
        return x, y

    def expect(self, positions: np.ndarray, numbers: np.ndarray) -> None:
        """Note that so many events (n,) were expected at positions (n, 2) m."""
        np.add.at(self.expected, self.cells(positions), numbers)

    def happen(self, position: np.ndarray, number: float = 1.0) -> None:
        """Note an event at a position (2,) m; a negative number takes one back."""
        self.happened[self.cells(position[None])] += number
        self.refresh()

    def refresh(self) -> None:
        """Compute the factors anew from what was noted."""
        happened, expected = self.happened.sum(), self.expected.sum()
        self.overall = (self.worth + max(happened, 0.0)) / (self.worth + expected)
        factor: np.ndarray | float = self.overall
        for across, along in self._kernels:
            here, due = (np.maximum(across @ one @ along, 0.0) for one in (self.happened, factor * self.expected))
            factor = factor * (self.worth_here + here) / (self.worth_here + due)
        self.factor = np.asarray(factor)

    def learnt(self) -> np.ndarray:
        """Return how much of each place's own factor is learnt, (nx, ny) from 0, the prior, to 1."""
        across, along = self._kernels[-1]
        here, due = (across @ one @ along for one in (self.happened, self.overall * self.expected))
        return 1 - self.worth_here / (self.worth_here + np.maximum(np.maximum(here, due), 0.0))

    def fade(self, keep: float) -> None:
        """Forget all but a share of what was noted."""
        self.happened *= keep
        self.expected *= keep

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Return the factors (n,) at positions (n, 2) m."""
        (x0, y0), (last_x, last_y), step, factor = *self._bounds, self.step, self.factor.item
        return np.array(
            [  # of a few positions a loop makes less work than arrays do
                factor(int(min(max((x - x0) / step, 0.0), last_x)), int(min(max((y - y0) / step, 0.0), last_y)))
                for x, y in positions.tolist()
            ]
        )


def _kernel(cells: int, step: float) -> np.ndarray:
    """Gaussian kernel (cells, cells) of the distance of cells, 1 at distance 0; step in standard deviations."""
    apart = np.subtract.outer(np.arange(cells), np.arange(cells)) * step
    return np.exp(-apart * apart / 2)
