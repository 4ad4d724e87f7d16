"""Where people are whom no sensor has detected yet, on a grid: few in the fields of sensors, more outside.

They walk about, so that they come into a field at its border, and those whom a sensor would have detected are soon few
inside. Each cell holds an expected number, and for each sensor the expected number of those whom it can detect (who are
not occluded, not silent). All of it moves by diffusion, which the people of a room approach who walk here and there.

Source:
    J. L. Williams, "Marginal multi-Bernoulli filters", IEEE TAES 51(3), 2015 (undetected people).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.coverage import covered
from avcli.tracking.densities import Densities
from avcli.tracking.learning import Habits
from avcli.tracking.model import Population
from avcli.tracking.scan import Scan, likelihoods
from avcli.tracking.settings import Sensor

CELL, CELLS = 0.5, 40  # m, wider where a side would have more cells than that
WANDER = 1.0  # m²/s, of the diffusion: velocities of 0.7 m/s along each axis, forgotten in 2 s
AWAY, BLUR = 1.0, 0.1  # s since the last detection of people who may be lost among others; m, noise of one that tells
# On hall-both (seeds 100 to 107) HOTA is 92.6 with 3 and 91.2 with 1, on hall (100 to 102) 96.0 and 96.1.
SURELY = 3.0  # so many times as likely as anybody else, who was out of sight keeps the label
PARTS = 4  # points along each side of a cell at which its walls and its coverage are looked up


class UnseenMap:
    """The uniform part of the Poisson process where sensors cover the area in part; in place of `births.Undetected`.

    Attributes:
        number: (nx, ny) expected people in each cell.
        able: (S, nx, ny) expected number of those whom each sensor can detect.
        share: (S, nx, ny) of its detection probability that each sensor has there.
    """

    def __init__(self, population: Population, habits: Habits, sensors: Sequence[Sensor]) -> None:
        """Begin with the people expected in the room before the first record, anywhere alike.

        Args:
            population: how many come, and how long they stay.
            habits: how many are found at each place against how many it expects, as far as learnt.
            sensors: those that may report.
        """
        self.population, self.habits, self.entries = population, habits, habits.entries
        habits.in_part = True
        low, high = population.corners
        self.low, self.step = low, max(CELL, float((high - low).max()) / CELLS)
        nx, ny = (max(math.ceil(side / self.step - 1e-9), 1) for side in (high - low).tolist())
        offsets = (np.arange(max(nx, ny) * PARTS) + 0.5) * self.step / PARTS
        fine = np.stack(np.meshgrid(low[0] + offsets[: nx * PARTS], low[1] + offsets[: ny * PARTS], indexing="ij"), -1)
        self.points = fine.reshape(nx, PARTS, ny, PARTS, 2).swapaxes(1, 2).reshape(-1, 2)
        self.shape = nx, ny
        self.centres = self.points.reshape(nx * ny, PARTS**2, 2).mean(1)
        inside, core = self._overlap(low, high), self._overlap(low + population.edge, high - population.edge)
        walls = inside - core
        self.area = inside
        self.arrivals = sum(
            rate * part / part.sum() for rate, part in zip(population.birth_rate, (inside, walls), strict=True)
        )
        self.number = population.present * inside / inside.sum()
        self.able, self.share = np.zeros((0, nx, ny)), np.zeros((0, nx, ny))
        self.bases = [_modes(n) for n in (nx, ny)]
        for one in sensors:
            self.add(one)

    def _overlap(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return how much of each cell, (nx, ny) m², lies in a rectangle with these corners, (2,) m each."""
        borders = [self.low[axis] + self.step * np.arange(n + 1) for axis, n in enumerate(self.shape)]
        across, along = (np.diff(borders[k].clip(low[k], max(low[k], high[k]))) for k in (0, 1))
        return np.outer(across, along)

    def _of_cells(self, values: np.ndarray) -> np.ndarray:
        """Average values at the points to the cells."""
        return values.reshape(*self.shape, PARTS**2).mean(2)

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""
        share = self._of_cells(covered(self.points, [sensor])[:, 0])
        self.share = np.concatenate([self.share, share[None]])
        self.able = np.concatenate([self.able, (self.number * sensor.detectable())[None]])

    def predict(self, dt: float) -> None:
        """Let people come, go and walk for dt seconds."""
        mix = math.exp(-dt / self.population.stay)
        came = self.arrivals * min(dt, self.population.stay)  # who came longer ago has left again
        self.number = self._moved(self.number * mix, dt) + came
        self.able = self._moved(self.able * mix, dt)

    def relax(self, rest: np.ndarray, mix: np.ndarray) -> None:
        """Let them hide and show: (S,) probabilities in the long run, and shares (S,) of what is not forgotten."""
        able = rest[:, None, None] * self.number
        self.able = able + (np.minimum(self.able, self.number) - able) * mix[:, None, None]

    def _moved(self, numbers: np.ndarray, dt: float) -> np.ndarray:
        """Return numbers (..., nx, ny) after a walk of dt seconds; nobody walks through a wall."""
        kernels = []
        for vectors, rates in self.bases:
            decay = np.exp(-rates * (WANDER * dt / self.step**2))
            kernels.append((vectors * decay) @ vectors.T)
        return np.maximum(kernels[0] @ numbers @ kernels[1], 0.0)

    def _cells(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cells = (positions - self.low) / self.step
        last = np.array(self.shape) - 1
        at = np.minimum(np.maximum(cells, 0), last).astype(int)
        return at[:, 0], at[:, 1]

    def density(self, positions: np.ndarray) -> np.ndarray:
        """Return the expected number (n,) of them per m² at positions (n, 2) m."""
        at = self._cells(positions)
        return self.entries.at(positions) * self.number[at] / np.maximum(self.area[at], 1e-9)

    def due(self, scan: Scan) -> float:
        """Return how many of them a record should show."""
        return scan.p_newcomer * float((self.share[scan.column] * self.able[scan.column]).sum())

    def arriving(self, z: np.ndarray, detection: float, column: int) -> list[float]:
        """Return the densities, n per m², at positions (n, 2) m of detecting one of them."""
        at = self._cells(z)
        able = self.entries.at(z) * self.able[column][at] / np.maximum(self.area[at], 1e-9)
        return (detection * self.share[column][at] * able).tolist()

    def detectable_at(self, positions: np.ndarray) -> np.ndarray:
        """Return the probabilities (n, S) that each sensor can detect one of them at positions (n, 2) m."""
        rows, columns = self._cells(positions)
        return np.minimum(self.able[:, rows, columns] / np.maximum(self.number[rows, columns], 1e-300), 1.0).T

    def update(self, scan: Scan) -> None:
        """Take those away whom a record's sensor has detected."""
        share = scan.p_newcomer * self.share[scan.column]
        able = np.minimum(self.able[scan.column], self.number)
        found = share * able
        missed = 1 - found / np.maximum(self.number, 1e-300)
        self.number, self.able = self.number * missed, self.able * missed
        self.able[scan.column] = able * (1 - share)
        self.habits.reveal(self.centres, found.ravel())

    def lost(self, people: Densities, rows: Sequence[int], now: float) -> list[int]:
        """Return those of some rows whom nobody could tell from others any more.

        Where such a person is expected most, a detection would not SURELY be of that person: it may be of one of those
        whom no sensor has detected yet, or of another one of the rows.

        Args:
            people: all densities.
            rows: of one joint hypothesis.
            now: s.

        Source:
            J. L. Williams, "Hybrid Poisson and multi-Bernoulli filters", FUSION 2012 (recycling).
        """
        unseen = [row for row in rows if people.seen[row].max() < now - AWAY]
        if not unseen:
            return []
        some = people.take(unseen)
        centres = some.centres()[:, :2]
        blur = np.tile(BLUR**2 * np.eye(2), (len(some), 1, 1))
        gain = (
            likelihoods(some.mode, gaussian.innovation(some.mean, some.cov), centres, blur)[0] * some.existence[:, None]
        )
        own = gain.diagonal()
        others = gain.sum(0) - own + self.density(centres)
        return [row for row, gone in zip(unseen, own < SURELY * others, strict=True) if gone]

    def receive(self, mean: np.ndarray, cov: np.ndarray, number: float, detectable: np.ndarray) -> None:
        """Take in people whom nobody can tell from others any more.

        Args:
            mean: (2,) m, of where they are.
            cov: (2, 2) m².
            number: expected number of them.
            detectable: (S,) probabilities that each sensor can detect one.
        """
        away, inverse = self.centres - mean, np.linalg.inv(cov + self.step**2 * np.eye(2))
        weight = self.area * np.exp(-0.5 * ((away @ inverse) * away).sum(1)).reshape(self.shape)
        more = number * weight / max(weight.sum(), 1e-300)
        self.number, self.able = self.number + more, self.able + detectable[:, None, None] * more

    def share_knowledge(self, one: int, others: list[int]) -> None:
        """Let other sensors detect the same ones of them as one sensor does."""
        self.able[others] = self.able[one]


def _modes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the modes (count, count) and their rates (count,) of diffusion along a row of cells between two walls."""
    k = np.arange(count)
    vectors = np.cos(np.pi * k * (k[:, None] + 0.5) / count) * np.sqrt(np.where(k, 2.0, 1.0) / count)
    return vectors, 2 - 2 * np.cos(np.pi * k / count)
