"""The parts of a picture that changed since the network last looked at them, by more than the sensor's noise."""

import numpy as np

from avcli.numeric import median

ACROSS, TILE_PX, FINE_PX = 320, 8, 2
"""Pixels that are compared across a picture, about, and the sides, of these, of a tile and of what is joined first."""
LEARNING = 5
"""Comparisons from which each tile learns its noise before it is relied upon."""
SOON, SLOWLY = 0.3, 0.03
"""Shares by which a tile's noise follows a level below it, and above it: who moves there is not noise."""
NOISY, LEAST = 0.1, 0.05
"""Share of the tiles that show noise where the sensor has any, and the level, of 255, from which they do."""
SURE, MOTION = 6.0, 1.0
"""Standard deviations above the noise, and level of 255 beyond them, from which a tile has changed."""


class Gate:
    """Compares pictures tile by tile with what passed before.

    The level of a tile is its mean absolute difference. Where nothing moves it is the noise, which each tile has learnt
    for itself: a sensor's noise depends on the light, a compressed picture's on what it shows. How far levels scatter
    about it the median over the tiles tells, most of which show no motion. Each tile is compared with its own state
    when it last passed, so that slow motion adds up.

    Args:
        refresh: every `refresh`-th picture passes whole, changed or not; 1: all pictures do.
    """

    def __init__(self, refresh: int = 10):
        self.refresh = refresh
        self._last: np.ndarray | None = None
        self._since = self._compared = 0
        self._noise = np.zeros(0)

    def changes(self, picture: np.ndarray) -> np.ndarray:
        """Find the changed parts of a picture (height, width, 3) uint8, and remember their new state.

        Returns:
            (n, 4) [x0, y0, x1, y1] px: rectangles that contain all changes. The whole picture if it is the first one of
            its size, or every `refresh`-th, or shows noise that is not known yet.
        """
        import cv2

        height, width = picture.shape[:2]
        apart = max(round(width / ACROSS), 1)
        size = -(-width // apart), -(-height // apart)
        small, last = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST), self._last
        self._since += 1
        moved = None
        if last is None or last.shape != small.shape:
            self._compared = 0
        else:
            moved = self._moved(_levels(small, last))
        if last is None or moved is None or self._unknown or self._since >= self.refresh:
            self._last, self._since = small, 0
            return np.array([[0, 0, width, height]])
        regions = _boxes(moved, size)
        for x0, y0, x1, y1 in regions:
            last[y0:y1, x0:x1] = small[y0:y1, x0:x1]
        return np.minimum(regions * apart, [width, height, width, height])

    @property
    def _unknown(self) -> bool:
        """Whether the pictures show noise of which too little is known."""
        return self._compared <= LEARNING and self._is_noisy

    @property
    def _is_noisy(self) -> bool:
        return bool((self._noise > LEAST).mean() > NOISY)

    def _moved(self, levels: np.ndarray) -> np.ndarray:
        """Return which tiles have changed, and learn their noise from the levels of the others."""
        self._compared += 1
        if self._compared == 1:
            self._noise = levels
        moved = levels > MOTION
        if self._is_noisy:
            noisy = self._noise > LEAST
            ratios = levels[noisy] / self._noise[noisy]
            usual = median(ratios)
            scatter = 1.4826 * median(np.abs(ratios - usual))
            moved = levels > self._noise * (usual + SURE * scatter) + MOTION
        if moved.mean() > 0.5:  # the light or the sensor has changed
            self._compared = 0
        elif self._compared <= LEARNING:
            self._noise = np.minimum(self._noise, levels)
        else:
            share = np.where(levels < self._noise, SOON, np.where(moved, 0.0, SLOWLY))
            self._noise += share * (levels - self._noise)
        return moved


def _levels(small: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Mean absolute differences (rows, columns) of the tiles of two pictures."""
    import cv2

    height, width = small.shape[:2]
    rows, columns = max(height // TILE_PX, 1), max(width // TILE_PX, 1)
    less = max(width // FINE_PX, 1), max(height // FINE_PX, 1)  # whole scales take half of the time
    difference = cv2.absdiff(small, last)[: FINE_PX * less[1], : FINE_PX * less[0]]
    difference = cv2.resize(difference, less, interpolation=cv2.INTER_AREA)
    return cv2.resize(difference.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA).mean(axis=2)


def _boxes(moved: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bounding boxes (n, 4) px of the groups of changed tiles of a picture, a tile wider on each side."""
    import cv2

    if not moved.any():
        return np.empty((0, 4), int)
    wide = cv2.dilate(moved.astype(np.uint8), np.ones((3, 3), np.uint8))
    boxes = cv2.connectedComponentsWithStats(wide)[2][1:]  # left, top, width, height, area; the first is the rest
    corners = np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:4]])
    tile = np.array(size * 2) / np.array(moved.shape[::-1] * 2)
    return np.rint(corners * tile).astype(int)
