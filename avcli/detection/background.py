"""The colours of a room without people, learnt from its own film, and what of a picture differs from them.

The median of the first pictures begins it: whoever moves is gone from it. Then each pixel that shows no person follows
the film slowly. Light that changes everywhere alike, or the camera's exposure, is divided out before pictures are
compared. Somebody who sits still from the beginning is part of the room until he or she moves.
"""

from collections.abc import Iterable

import numpy as np

FIRST = 25
"""Pictures of which the median is taken."""

WIDTH_PX = 320
"""Width at which pictures are compared."""

RATE = 0.02
"""Part of the way that the background goes to each new picture."""

DIFFERENT = 0.12
"""Least difference of logarithms of brightness that is no noise."""

_DARK = 12.0
"""Grey levels that are added before logarithms are taken, since dark pixels are mostly noise."""


class Background:
    """What the room looks like, from the pictures so far.

    Args:
        start: (height, width, 3) uint8, a picture of the empty room; None: it is learnt from the first pictures.
    """

    def __init__(self, start: np.ndarray | None = None):
        self._first: list[np.ndarray] = []
        self._room = None if start is None else _logarithms(start)
        self._changed: np.ndarray | None = None
        self._scale = 1.0

    @property
    def is_known(self) -> bool:
        """Whether enough pictures were seen."""
        return self._room is not None

    def see(self, picture: np.ndarray) -> None:
        """Compare a picture (height, width, 3) uint8 with the room; the first ones are collected only."""
        now = _logarithms(picture)
        self._scale = now.shape[1] / picture.shape[1]
        if self._room is None:
            self._first.append(now)
            if len(self._first) < FIRST:
                return
            self._room, self._first = np.median(self._first, axis=0).astype(np.float32), []
        self._now = now
        away = now - self._room
        away -= np.median(away.reshape(-1, 3), axis=0)  # another light, or another exposure
        level = np.abs(away).max(axis=2)
        noise = 1.4826 * np.median(level)
        self._changed = level > max(DIFFERENT, 3 * noise)

    def shares(self, boxes: np.ndarray) -> np.ndarray:
        """Which part (n,) of each box (n, 4) px of the last picture differs from the room; 1 while it is not known."""
        if self._changed is None:
            return np.ones(len(boxes))
        height, width = self._changed.shape
        corners = np.clip(np.rint(boxes * self._scale), 0, [width, height, width, height]).astype(int)
        total = np.zeros((height + 1, width + 1))
        total[1:, 1:] = np.cumsum(np.cumsum(self._changed, axis=0), axis=1)
        x0, y0, x1, y1 = corners.T
        amount = total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0]
        return amount / np.maximum((x1 - x0) * (y1 - y0), 1)

    def learn(self, people: np.ndarray) -> None:
        """Follow the last picture where no person's box (n, 4) px is."""
        if self._room is None or self._changed is None:
            return
        free = np.ones(self._changed.shape, bool)
        for x0, y0, x1, y1 in np.rint(people * self._scale).astype(int):
            free[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = False
        self._room[free] += RATE * (self._now - self._room)[free]


def _logarithms(picture: np.ndarray) -> np.ndarray:
    import cv2

    scale = min(WIDTH_PX / picture.shape[1], 1.0)
    size = round(picture.shape[1] * scale), max(round(picture.shape[0] * scale), 1)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.log(small.astype(np.float32) + _DARK)


def still_colour(pictures: Iterable[np.ndarray], most: int = 100) -> np.ndarray:
    """The median of at most `most` pictures (height, width, 3) uint8, at equal steps: whoever moves is gone."""
    return np.median(_thinned(pictures, most), axis=0).astype(np.uint8)


def still_depth(pictures: Iterable[np.ndarray], most: int = 100) -> np.ndarray:
    """The depth picture of a room from several, 0 where most of them have a hole.

    Whoever passes is nearer than the room, and flicker goes both ways: of the values of a pixel the upper quartile is
    taken, holes left out.

    Args:
        pictures: (height, width) uint16, in steps; 0 is a hole.
        most: of how many, at equal steps.

    Raises:
        ValueError: there are none, or of several sizes.
    """
    several = np.sort(_thinned(pictures, most), axis=0)  # holes first
    count = len(several)
    holes = (several == 0).sum(axis=0)
    place = np.minimum(holes + (3 * (count - holes)) // 4, count - 1)
    upper = np.take_along_axis(several, place[None], axis=0)[0]
    return np.where(2 * holes > count, 0, upper).astype(np.uint16)


def _thinned(pictures: Iterable[np.ndarray], most: int) -> np.ndarray:
    """At most `most` of the pictures, at equal steps, in one pass."""
    kept: list[np.ndarray] = []
    step = 1
    for number, picture in enumerate(pictures):
        if number % step == 0:
            kept.append(picture)
        if len(kept) > most:
            kept, step = kept[::2], 2 * step
    if len({picture.shape for picture in kept}) != 1:
        raise ValueError("there are no pictures" if not kept else "the pictures have several sizes")
    return np.stack(kept)
