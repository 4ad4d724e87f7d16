"""Whether a picture differs from the last one that was looked at, in spite of the sensor's noise."""

import numpy as np

TILE_PX = 16


class Gate:
    """Compares pictures tile by tile with the last one that was let through.

    The level of a tile is its mean absolute difference. Most tiles show nothing that moves: their median is the noise,
    and what stands out from it is change. The comparison is with the last picture let through, not with the last one,
    so that slow motion adds up.

    Args:
        refresh: of pictures that do not change every `refresh`-th is let through; 1 lets all through.
        coarseness: px between the pixels that are compared.
    """

    def __init__(self, refresh: int = 10, coarseness: int = 3):
        self.refresh, self.coarseness = refresh, coarseness
        self._last, self._held = None, 0

    def changed(self, picture: np.ndarray) -> bool:
        """Tell whether to look at a picture (height, width, 3) uint8, and remember it if so."""
        import cv2

        small = np.ascontiguousarray(picture[:: self.coarseness, :: self.coarseness])
        self._held += 1
        if (
            self.refresh > 1
            and self._last is not None
            and self._last.shape == small.shape
            and self._held < self.refresh
        ):
            difference = cv2.absdiff(small, self._last)
            height, width = (side // TILE_PX * TILE_PX for side in difference.shape[:2])
            tiles = cv2.resize(
                difference[:height, :width], (width // TILE_PX, height // TILE_PX), interpolation=cv2.INTER_AREA
            ).astype(np.float32)
            levels = tiles.mean(axis=2).ravel()
            noise = np.median(levels)
            spread = 1.4826 * np.median(np.abs(levels - noise))
            if levels.max(initial=0.0) <= noise + 6 * spread + 1.0:
                return False
        self._last, self._held = small, 0
        return True
