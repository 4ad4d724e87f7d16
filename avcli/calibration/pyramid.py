"""Pictures made smaller, quickly."""

import numpy as np


class Pyramid:
    """A picture (height, width) uint8 and the same made smaller, each size once.

    Attributes:
        in_vain: longer side in px of a reduced picture -> corners of the least checkerboard that it does not show.
        crowded: whether it has too many corners for a board, and no board: it is full of texture.
    """

    def __init__(self, grey: np.ndarray):
        self.in_vain: dict[int, int] = {}
        self.crowded = False
        self._halves = [grey]
        self._made: dict[int, tuple[np.ndarray, float]] = {}

    @classmethod
    def of(cls, picture: "np.ndarray | Pyramid") -> "Pyramid":
        """Make the pyramid of a picture (height, width) uint8, or return the one that is given."""
        return picture if isinstance(picture, Pyramid) else cls(picture)

    @property
    def grey(self) -> np.ndarray:
        """The picture itself."""
        return self._halves[0]

    def reduced(self, longest: int) -> tuple[np.ndarray, float]:
        """The picture with a longer side of at most so many px, and the factor back to the full one.

        It is halved as often as can be, which is several times quicker than one reduction by a fraction; a last odd row
        or column is lost. The rest is a mean of areas: in a mean of two pixels noise is taken for corners. Pixel x of
        the full picture is at (x + 0.5) / factor - 0.5.
        """
        if longest not in self._made:
            self._made[longest] = self._reduce(longest)
        return self._made[longest]

    def _reduce(self, longest: int) -> tuple[np.ndarray, float]:
        import cv2

        level, grey = 0, self.grey
        while max(grey.shape) >= 2 * longest and min(grey.shape) > 1:
            level += 1
            if level == len(self._halves):
                height, width = (side // 2 for side in grey.shape)
                whole = grey[: 2 * height, : 2 * width]
                self._halves.append(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))
            grey = self._halves[level]
        rest = max(grey.shape) / longest
        if rest <= 1:
            return grey, float(2**level)
        size = [max(round(side / rest), 1) for side in grey.shape[::-1]]
        # Both take the mean of two pixels here, of nearly the same weights, and one of them is eight times as quick.
        how = cv2.INTER_LINEAR if rest == 1.5 else cv2.INTER_AREA
        return cv2.resize(grey, size, interpolation=how), 2**level * rest
