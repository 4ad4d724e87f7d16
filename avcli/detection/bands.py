"""The package's own network in two bands of a round picture, one across it and one down it.

It has learnt from wide pictures, so it knows people best in these. A round picture is as
high as it is wide. Its two bands are as wide pictures are; the second is turned by a right angle. Each band decides on
the people in the two quarters of the picture that lie along it. Whoever stands where both bands look is judged by both.
"""

import numpy as np

from avcli.detection.agreement import overlaps
from avcli.detection.network import MOST, PAD, Boxes, Network, suppress
from avcli.numeric import median

BREADTH = 0.7
"""Breadth of a band as a part of its length."""

LEAST_SCORE = 0.02
"""Score from which a band's boxes count for the other band, and the score of somebody whom that band does not see."""

SAME = 0.4
"""Intersection over union from which boxes of the two bands show one person."""

SHOWN = 0.85
"""Part of a box, across a band, that the band must hold to have a say."""

SEAM = 1 / 60
"""Part of the picture by which the quarters of the two bands overlap."""

ROUND, FEWEST_PX = 1.2, 64
"""Longer side over shorter side of a picture up to which it can be round, and the shorter side that it must have."""

OUTSIDE, DARK, DARKER, DARK_SHARE = 0.65, 40, 0.6, 0.75
"""A picture is round if this share of what is farther from its middle than OUTSIDE, as a part of its size, is darker
than a level and than a part of the median of the inner picture, or has the grey of what the lens does not light."""


MARGIN = 0.97
"""Least share of a row or a column beside a round picture that the lens does not light."""

Part = tuple[int, int, int, int]
"""(left, top, right, bottom) px of a part of a picture."""


def _unlit(picture: np.ndarray) -> tuple[np.ndarray, int]:
    """What the lens does not light (h, w) bool of a picture (height, width, 3) uint8, and of which step it is, px."""
    step = max(min(picture.shape[:2]) // 256, 1)
    some = picture[::step, ::step]
    level = some.max(axis=2)
    dark = min(DARK, DARKER * float(median(level[_away(level.shape) < 0.4])))
    return (level < dark) | (some == PAD).all(axis=2), step


def _away(shape: tuple[int, ...]) -> np.ndarray:
    """Distances (h, w) from the middle of a picture, as parts of its size."""
    v, u = np.ogrid[: shape[0], : shape[1]]
    return np.hypot((u + 0.5) / shape[1] - 0.5, (v + 0.5) / shape[0] - 0.5)


def is_round(picture: np.ndarray) -> bool:
    """Whether a picture (height, width, 3) uint8 is about square, with corners that the lens does not light."""
    height, width = picture.shape[:2]
    if max(height, width) > ROUND * min(height, width) or min(height, width) < FEWEST_PX:
        return False
    unlit, _ = _unlit(picture)
    return bool(unlit[_away(unlit.shape) > OUTSIDE].mean() >= DARK_SHARE)


def round_part(picture: np.ndarray) -> Part | None:
    """The round picture in a picture (height, width, 3) uint8: all of it, or what unlit margins leave, or None."""
    height, width = picture.shape[:2]
    if is_round(picture):
        return 0, 0, width, height
    if min(height, width) < FEWEST_PX:
        return None
    unlit, step = _unlit(picture)
    lit = [np.flatnonzero(unlit.mean(axis=axis) < MARGIN) for axis in (0, 1)]
    if not all(map(len, lit)):
        return None
    (left, right), (top, bottom) = ((int(one[0]) * step, int(one[-1] + 1) * step) for one in lit)
    part = left, top, min(right, width), min(bottom, height)
    return part if is_round(picture[top:bottom, left:right]) else None


class BandedNetwork:
    """A network that looks at two bands of a round picture in place of all of it.

    Args:
        network: that has learnt from wide pictures (`Network.learnt_wide`).
        part: where the round picture is, None for all of a picture.
    """

    def __init__(self, network: Network, part: Part | None = None):
        self.confidence, self._iou, self._part = network.confidence, network.iou, part
        length = max(network.size)
        self._bands = [network.resized((length, round(BREADTH * length))) for _ in range(2)]
        for band in self._bands:
            band.confidence = min(self.confidence, LEAST_SCORE)

    def detect(self, picture: np.ndarray, regions: np.ndarray | None = None) -> Boxes:
        """Find the people in a picture, as `Network.detect`."""
        import cv2

        corner = np.zeros(2, int)
        if self._part is not None:
            left, top, right, bottom = self._part
            picture, corner = picture[top:bottom, left:right], np.array([left, top])
        height, width = picture.shape[:2]
        if regions is not None:
            regions = _inside(regions - np.tile(corner, 2), width, height)
        rows = max((height - round(BREADTH * width)) // 2, 0)  # beside the band across, and columns beside the other
        columns = max((width - round(BREADTH * height)) // 2, 0)
        across = self._look(0, picture[rows : height - rows], rows, regions)
        if regions is not None:
            regions = np.column_stack([regions[:, 1], width - regions[:, 2], regions[:, 3], width - regions[:, 0]])
        band = cv2.rotate(picture[:, columns : width - columns], cv2.ROTATE_90_COUNTERCLOCKWISE)
        down = self._look(1, band, columns, regions)
        found = _moved(voted(across, _turned_back(down, width), (width, height)), corner)
        kept = suppress(found.boxes, found.scores, self._iou)
        return found.take(kept[found.scores[kept] >= self.confidence][:MOST])

    def _look(self, number: int, band: np.ndarray, margin: int, regions: np.ndarray | None) -> Boxes:
        """What a band shows, in px of the picture, which has a margin of rows above it."""
        if regions is not None:
            regions = _inside(regions - [0, margin, 0, margin], band.shape[1], band.shape[0])
        return _moved(self._bands[number].detect(band, regions), np.array([0, margin]))


def _inside(boxes: np.ndarray, width: int, height: int) -> np.ndarray:
    """What a picture of this size, px, shows of boxes (n, 4); those of which it shows nothing are left out."""
    seen = np.concatenate([np.maximum(boxes[:, :2], 0), np.minimum(boxes[:, 2:], [width, height])], axis=1)
    return seen[(seen[:, 2:] > seen[:, :2]).all(axis=1)]


def _moved(found: Boxes, corner: np.ndarray) -> Boxes:
    """People of a part of a picture, whose corner (2,) px is given, in px of the picture."""
    parts = None if found.parts is None else found.parts + corner
    return Boxes(found.boxes + np.tile(corner, 2), found.scores, parts)


def suited(network: Network, picture: np.ndarray) -> Network | BandedNetwork:
    """The bands of a network that has `learnt_wide` if a picture (height, width, 3) holds a round one, else itself."""
    part = round_part(picture) if network.learnt_wide else None
    return network if part is None else BandedNetwork(network, part)


def _turned_back(found: Boxes, width: int) -> Boxes:
    """People in a picture that was turned by a right angle against the clock, in px of the picture (width wide)."""
    x0, y0, x1, y1 = found.boxes.T
    parts = None
    if found.parts is not None:
        parts = np.stack([width - found.parts[..., 1], found.parts[..., 0]], axis=-1)
    return Boxes(np.column_stack([width - y1, x0, width - y0, x1]), found.scores, parts)


def voted(across: Boxes, down: Boxes, size: tuple[int, int]) -> Boxes:
    """The people of both bands, each by the band along which they stand; at a seam one may be there twice.

    Where both bands look, the score is that of the mean of their two log odds.

    Args:
        across, down: what the bands found, in px of the picture.
        size: (width, height) px of the picture.
    """
    boxes, scores, parts = [], [], []
    middle = np.array(size) / 2
    for axis, mine, other in ((0, across, down), (1, down, across)):
        away = np.abs((mine.boxes[:, :2] + mine.boxes[:, 2:]) / 2 - middle)
        mine = mine.take(away[:, 1 - axis] <= away[:, axis] + SEAM * max(size))
        reach = BREADTH * size[1 - axis] / 2  # of the other band, to both sides of the middle
        low, high = mine.boxes[:, axis], mine.boxes[:, axis + 2]
        seen = np.minimum(high, middle[axis] + reach) - np.maximum(low, middle[axis] - reach)
        same = overlaps(mine.boxes, other.boxes) > SAME
        opinion = np.where(same, other.scores[None], LEAST_SCORE).max(axis=1, initial=LEAST_SCORE)
        both = 1 / (1 + np.exp(-(_log_odds(mine.scores) + _log_odds(opinion)) / 2))
        boxes.append(mine.boxes)
        scores.append(np.where(seen >= SHOWN * (high - low), both, mine.scores))
        parts.append(mine.parts)
    known = [one for one in parts if one is not None]
    return Boxes(np.concatenate(boxes), np.concatenate(scores), np.concatenate(known) if len(known) == 2 else None)


def _log_odds(scores: np.ndarray) -> np.ndarray:
    bounded = np.clip(scores, 1e-4, 1 - 1e-4)
    return np.log(bounded) - np.log1p(-bounded)
