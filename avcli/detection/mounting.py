"""A camera that was knocked: its whole picture has moved or turned against what it showed before."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LOOK_S, LOOKS = 2.0, 5
"""s between two looks; how many of them in a row must say the same."""
SHIFT, TURN_DEG = 0.006, 1.5
"""Least shift that counts, as a share of the picture's shorter side, and least turn. In eleven films of still cameras
(CERIS_FishEye, the rooms that decide) 159 pictures moved by 0.002 and turned by 0.4 degrees at most."""
ALIKE = 0.25
"""Height of the phase correlation's peak from which two pictures show the same room: at least 0.31 in these films."""
RENEW_S, LOST_S = 60.0, 600.0
"""Age in s at which the picture to compare with is renewed where nothing moved, and where it shows another room."""

_MIDDLE, _SIDE, _ANGLES, _RADII = 0.62, 192, 256, 64
"""Share of the shorter side that is compared, which the border of a lens does not reach; and sizes, px."""

Outlines = tuple[np.ndarray, np.ndarray]


class Knock(NamedTuple):
    """How a picture has moved.

    Attributes:
        since: s, time of the first picture that is not as before.
        shift: as a share of the shorter side.
        turn_deg: degrees about the middle.
    """

    since: float
    shift: float
    turn_deg: float


class Mounting:
    """Tells whether a camera still looks where it looked, by the outlines in the middle of its pictures.

    Outlines are compared by phase correlation, as they are and about the middle, so that light and people hardly
    count. What is shown in another light, or not at all, tells nothing.

    Attributes:
        knock: the latest knock, None: there was none.
    """

    def __init__(self) -> None:
        """Begin without pictures."""
        self.knock: Knock | None = None
        self._before: Outlines | None = None
        self._seen, self._alike = 0.0, 0.0  # s, of the last look, and of the last that showed the same room
        self._moved: list[Knock] = []
        self._taken = 0.0  # s, of the picture to compare with

    def see(self, picture: np.ndarray, time: float) -> None:
        """Take in a picture (height, width, 3) uint8 and its time, s."""
        if self._before is not None and 0.0 <= time - self._seen < LOOK_S:
            return
        now, began = outlines(picture), self._before is None or time < self._seen
        self._seen = time
        if began or self._before is None:
            self._renew(now, time)
            return
        moved = moves(self._before, now)
        if moved is None:
            self._moved = []
            if time - self._alike > LOST_S:
                self._renew(now, time)
            return
        self._alike = time
        shift, turn = moved
        if shift < SHIFT and turn < TURN_DEG:
            self._moved = []
            if time - self._taken > RENEW_S:
                self._renew(now, time)
            return
        self._moved.append(Knock(time, shift, turn))
        first = self._moved[0]
        if abs(shift - first.shift) > SHIFT or abs(turn - first.turn_deg) > TURN_DEG:  # it still moves
            self._moved = self._moved[-1:]
        elif len(self._moved) == LOOKS:
            self.knock = first
            self._renew(now, time)

    def _renew(self, outlines: Outlines, time: float) -> None:
        self._before, self._moved = outlines, []
        self._taken = self._alike = time


def outlines(picture: np.ndarray) -> Outlines:
    """Return the outlines in the middle of a picture (height, width, 3) uint8, as they are and by angle and radius."""
    import cv2

    height, width = picture.shape[:2]
    side = max(int(_MIDDLE * min(height, width)), 1)
    y, x = (height - side) // 2, (width - side) // 2
    middle = cv2.resize(picture[y : y + side, x : x + side], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(middle, cv2.COLOR_BGR2GRAY).astype(np.float32)
    steep = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    tenth = int(0.9 * steep.size)
    steep = np.minimum(steep / (np.partition(steep.ravel(), tenth)[tenth] + 1.0), 1.5)
    centre = (_SIDE - 1) / 2
    around = cv2.warpPolar(
        steep, (_RADII, _ANGLES), (centre, centre), 0.94 * centre, cv2.WARP_POLAR_LINEAR | cv2.INTER_LINEAR
    )
    return steep - steep.mean(), around - around.mean()


def moves(before: Outlines, now: Outlines) -> tuple[float, float] | None:
    """Return by what share of the shorter side a picture has moved, and by how many degrees it has turned.

    One of them is 0, that which explains less; None: the two pictures do not show the same.

    Source:
        C. D. Kuglin and D. C. Hines, "The phase correlation image alignment method", Proc. IEEE Int. Conf. on
        Cybernetics and Society, 1975, pp. 163-165.
    """
    import cv2

    if not all(one.any() for one in (*before, *now)):
        return None
    square = cv2.createHanningWindow((_SIDE, _SIDE), cv2.CV_32F)
    radial = np.repeat(np.hanning(_RADII)[None].astype(np.float32), _ANGLES, axis=0)
    # phaseCorrelate writes the windowed pictures over what it is given.
    (dx, dy), shifted = cv2.phaseCorrelate(before[0].copy(), now[0].copy(), square)
    (_, along), turned = cv2.phaseCorrelate(before[1].copy(), now[1].copy(), radial)
    if max(shifted, turned) < ALIKE:
        return None
    if shifted >= turned:
        return float(np.hypot(dx, dy)) / _SIDE * _MIDDLE, 0.0
    return 0.0, abs(along) / _ANGLES * 360.0
