"""The parts of a picture that changed since the network last looked at them, by more than the sensor's noise."""

import numpy as np

TILE_PX = 16


class Gate:
    """Compares pictures tile by tile with what passed before.

    The level of a tile is its mean absolute difference. Most tiles show no motion, so their median is the noise, and a
    tile far above it has changed. Each tile is compared with its own state when it last passed, so that slow motion
    adds up.

    Args:
        refresh: every `refresh`-th picture passes whole, changed or not; 1: all pictures do.
        coarseness: px between the pixels that are compared.
    """

    def __init__(self, refresh: int = 10, coarseness: int = 3):
        self.refresh, self.coarseness = refresh, coarseness
        self._last: np.ndarray | None = None
        self._since = 0

    def changes(self, picture: np.ndarray) -> np.ndarray:
        """Find the changed parts of a picture (height, width, 3) uint8, and remember their new state.

        Returns:
            (n, 4) [x0, y0, x1, y1] px: rectangles that contain all changes. The whole picture if it is the first one of
            its size, or every `refresh`-th.
        """
        import cv2

        height, width = picture.shape[:2]
        size = -(-width // self.coarseness), -(-height // self.coarseness)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)
        self._since += 1
        if self._last is None or self._last.shape != small.shape or self._since >= self.refresh:
            self._last, self._since = small, 0
            return np.array([[0, 0, width, height]])
        regions = _moved(small, self._last)
        for x0, y0, x1, y1 in regions:
            self._last[y0:y1, x0:x1] = small[y0:y1, x0:x1]
        return np.minimum(regions * self.coarseness, [width, height, width, height])


def _moved(small: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Bounding boxes (n, 4) px of the groups of changed tiles, a tile wider on each side."""
    import cv2

    height, width = small.shape[:2]
    rows, columns = max(height // TILE_PX, 1), max(width // TILE_PX, 1)
    difference = cv2.resize(cv2.absdiff(small, last), (4 * columns, 4 * rows), interpolation=cv2.INTER_AREA)
    levels = cv2.resize(difference.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA).mean(axis=2)
    noise = np.median(levels)
    spread = 1.4826 * np.median(np.abs(levels - noise))
    moved = levels > noise + 6 * spread + 1.0
    if not moved.any():
        return np.empty((0, 4), int)
    wide = cv2.dilate(moved.astype(np.uint8), np.ones((3, 3), np.uint8))
    boxes = cv2.connectedComponentsWithStats(wide)[2][1:]  # left, top, width, height, area; the first is the rest
    corners = np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:4]])
    tile = np.array([width / columns, height / rows] * 2)
    return np.rint(corners * tile).astype(int)
