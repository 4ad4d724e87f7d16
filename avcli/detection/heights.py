"""Heights of people who were seen whole a while ago: they tell where somebody is whose feet are hidden now.

The box of somebody whose feet are hidden is like that of a smaller person who stands farther away. A film tells them
apart: people do not shrink. The height of the surest look at a person is kept, not a mean, since the errors of one
picture and the next are alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avcli.detection.agreement import overlaps
from avcli.detection.monocular import Places

SAME, NEXT_S = 0.3, 0.5
"""Least overlap over union of a person's boxes in two pictures that are no farther apart than this, s."""

SPEED_M_S, REACH_M = 2.0, 0.5
"""How far somebody may have gone who was lost: m/s, and m besides."""

FORGET_S = 10.0
"""s after which who was lost is forgotten."""

SURE_M = 0.12
"""m; a look tells a height if its standard deviation is less."""

FLOOR_M, DRIFT_M = 0.08, 0.02
"""m; standard deviation of a height beside that of the look, since people bend; and its growth with the root of s."""


@dataclass
class _Known:
    """Somebody: the last box, place and time, and the height, its standard deviation and when it was measured."""

    box: np.ndarray
    place: np.ndarray
    seen: float
    height: float = np.nan
    sd: float = np.inf
    measured: float = 0.0

    def variance(self, time: float) -> float:
        return self.sd**2 + DRIFT_M**2 * (time - self.measured)


class Heights:
    """Remembers the heights of the people in a film, whose pictures come in order of time."""

    def __init__(self) -> None:
        self._people: list[_Known] = []

    def place(self, boxes: np.ndarray, time: float, locate: Callable[[np.ndarray], Places]) -> Places:
        """Place the people in boxes (n, 4) px of a picture of a time, s.

        Args:
            boxes: (n, 4) px.
            time: s; one that is not later begins anew.
            locate: places them where their heights (n, 2) m, with standard deviations, are known; NaN: they are not.
        """
        if any(one.seen >= time for one in self._people):
            self._people = []
        self._people = [one for one in self._people if time - one.seen <= FORGET_S]
        owners = self._followed(boxes, time)
        places = locate(self._known(owners, time))
        found = self._found_again(owners, places, time)
        if (found != owners).any():
            owners, places = found, locate(self._known(found, time))
        self._learn(owners, boxes, places, time)
        return places

    def _known(self, owners: np.ndarray, time: float) -> np.ndarray:
        told = np.full((len(owners), 2), np.nan)
        for row in np.flatnonzero(owners >= 0):
            one = self._people[owners[row]]
            told[row] = one.height, np.sqrt(one.variance(time) + FLOOR_M**2)
        return told

    def _followed(self, boxes: np.ndarray, time: float) -> np.ndarray:
        """Which of the people (n,) each box shows, by their last boxes; -1: nobody known."""
        near = overlaps(boxes, np.array([one.box for one in self._people]).reshape(-1, 4))
        near[:, [time - one.seen > NEXT_S for one in self._people]] = 0.0
        return _assigned(near, SAME, np.full(len(boxes), -1))

    def _found_again(self, owners: np.ndarray, places: Places, time: float) -> np.ndarray:
        """The same, where those who were lost are found again by their places."""
        away = places.positions[:, None] - np.array([one.place for one in self._people]).reshape(-1, 2)
        reach = np.array([REACH_M + SPEED_M_S * (time - one.seen) for one in self._people])
        doubt = np.sqrt(np.trace(places.covariances, axis1=1, axis2=2))
        near = 1 - np.linalg.norm(away, axis=2) / (reach + doubt[:, None])
        near[owners >= 0] = 0.0
        near[:, owners[owners >= 0]] = 0.0
        return _assigned(np.nan_to_num(near), 0.0, owners)

    def _learn(self, owners: np.ndarray, boxes: np.ndarray, places: Places, time: float) -> None:
        for row in np.flatnonzero(places.seen):
            height, sd = places.alone[row]
            if owners[row] < 0:
                owners[row] = len(self._people)
                self._people.append(_Known(boxes[row], places.positions[row], time))
            one = self._people[owners[row]]
            one.box, one.place, one.seen = boxes[row], places.positions[row], time
            if np.isfinite(height) and sd < SURE_M and sd**2 < one.variance(time):
                one.height, one.sd, one.measured = float(height), float(sd), time


def _assigned(near: np.ndarray, least: float, owners: np.ndarray) -> np.ndarray:
    """Owners (n,) with the pairs of `near` (n, m) above a least value, the nearest first."""
    owners, near = owners.copy(), near.copy()
    while near.size and near.max() > least:
        row, owner = np.unravel_index(near.argmax(), near.shape)
        owners[row] = owner
        near[row], near[:, owner] = 0.0, 0.0
    return owners
