"""The heights of people who were seen whole some time ago: they tell where somebody is of whom the feet are hidden."""

from dataclasses import dataclass

import numpy as np

from avcli.detection.agreement import overlaps
from avcli.detection.monocular import Places

SAME = 0.3
"""Overlap over union of a person's boxes in one picture and the next."""

SPEED_M_S, REACH_M = 2.0, 0.5
"""How far somebody who was lost may have gone: m/s, and m besides."""

FORGET_S = 10.0
"""s after which who was lost is forgotten."""

SURE_M = 0.12
"""m; a look tells a height if its standard deviation is less."""

FLOOR_M, DRIFT_M = 0.04, 0.02
"""m; standard deviation of a height beside that of the look, and its growth in a second, with the root of time."""


@dataclass
class _Known:
    box: np.ndarray
    place: np.ndarray
    seen: float
    height: float
    sd: float
    learnt: float


class Heights:
    """Remembers people's heights; pictures must come in order of time."""

    def __init__(self) -> None:
        self._people: list[_Known] = []

    def known(self, boxes: np.ndarray, time: float, places: Places | None = None) -> np.ndarray:
        """Heights and standard deviations (n, 2) m of the people in boxes (n, 4) px of a time, s; NaN if unknown.

        Who was lost is known again by the places, where they are given.
        """
        self._people = [one for one in self._people if 0 <= time - one.seen <= FORGET_S]
        self._owners = np.full(len(boxes), -1)
        told = np.full((len(boxes), 2), np.nan)
        if self._people and len(boxes):
            near = overlaps(boxes, np.array([one.box for one in self._people]))
            near[:, [time - one.seen > 0.5 for one in self._people]] = 0.0
            self._assign(near, SAME)
            if places is not None:
                away = np.linalg.norm(places.positions[:, None] - np.array([one.place for one in self._people]), axis=2)
                reach = np.array([REACH_M + SPEED_M_S * (time - one.seen) for one in self._people])
                sd = np.sqrt(np.trace(places.covariances, axis1=1, axis2=2))
                near = 1 - away / (reach + sd[:, None])
                near[self._owners >= 0] = 0.0
                near[:, self._owners[self._owners >= 0]] = 0.0
                self._assign(np.where(np.isfinite(near), near, 0.0), 1e-6)
        for row, owner in enumerate(self._owners):
            if owner >= 0:
                one = self._people[owner]
                told[row] = one.height, np.sqrt(one.sd**2 + FLOOR_M**2 + DRIFT_M**2 * (time - one.learnt))
        return told

    def _assign(self, near: np.ndarray, least: float) -> None:
        near = near.copy()
        while near.size and near.max() > least:
            row, owner = np.unravel_index(near.argmax(), near.shape)
            self._owners[row] = owner
            near[row], near[:, owner] = 0.0, 0.0

    def learn(self, boxes: np.ndarray, places: Places, time: float) -> None:
        """Take in where the people of the boxes last asked for are, and how tall they look."""
        for row, owner in enumerate(self._owners):
            height, sd = places.looks[row]
            sure = np.isfinite(height) and sd < SURE_M
            if not np.isfinite(places.positions[row]).all():
                continue
            if owner < 0:
                if sure:
                    self._people.append(_Known(boxes[row], places.positions[row], time, height, sd, time))
                continue
            one = self._people[owner]
            one.box, one.place, one.seen = boxes[row], places.positions[row], time
            if sure and sd**2 < one.sd**2 + DRIFT_M**2 * (time - one.learnt):
                one.height, one.sd, one.learnt = height, sd, time
