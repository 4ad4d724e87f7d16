"""A network in windows of a ceiling picture that are turned so that outward is up.

Under a ceiling camera people stand with their heads away from the point below the camera, in every direction. A network
that knows people as photographs show them, upright, finds few of them in the whole picture. In a window that is turned
about that point they stand upright.
"""

from dataclasses import dataclass

import numpy as np

from avcli.detection.network import PAD, Boxes, Network, suppress

SIDE = 1.0
"""Side of a window, as a part of the radius of what the lens shows."""

FILLED = 2.0
"""Exponent of the outline of a body in its box: 1 is the whole box, 2 an ellipse. It makes upright boxes of turned."""

WITHIN = 0.6
"""Of two boxes the one with the smaller score is the same person's if so much of the smaller is within the other."""

LEANING = 0.5
"""Part of its score that a box loses against others of the same person if the person stands on the head in it."""

OVERLAP = 0.4
"""Or if their intersection over union is larger than this; boxes from two windows agree less than those from one."""

_EDGE_PX = 3.0
"""px; a box so near to the border of its window may be cut."""


@dataclass(frozen=True)
class Window:
    """A square of a picture.

    Attributes:
        to_picture: (2, 3) affine map from px of the window to those of the picture, both corner-based.
        turn: rad, from the picture's x axis to the window's, towards y.
        box: (4,) px of the picture, in which it lies.
        scale: px of the picture for one of the window.
    """

    to_picture: np.ndarray
    turn: float
    box: np.ndarray
    scale: float


def windows(
    size: tuple[int, int], centre: np.ndarray, circle: tuple[float, float, float] | None, count: int, side_px: int
) -> list[Window]:
    """Lay `count` windows around a point so that in each of them the way from the point leads up.

    Each reaches from beyond the point to the picture's border, or to that of what the lens lights, in its sector.

    Args:
        size: (width, height) px of the picture.
        centre: (2,) px of the picture, corner-based, of the point below the camera.
        circle: (x, y, radius) px, of what the lens lights; None: all of the picture.
        count: number of windows, at equal angles.
        side_px: px, of each window.
    """
    laid = []
    for azimuth in 2 * np.pi * np.arange(count) / count:
        sector = azimuth + np.pi / count * np.linspace(-1, 1, 33)
        side = SIDE * max(_reach(size, centre, circle, sector).max(), 8.0)
        outward = np.array([np.cos(azimuth), np.sin(azimuth)])
        turn = float(np.arctan2(outward[0], -outward[1]))
        across, scale = np.array([-outward[1], outward[0]]), side / side_px
        corner = centre + side / SIDE * outward - side / 2 * across
        to_picture = np.column_stack([scale * across, -scale * outward, corner])
        ends = np.array([[0, 0], [side_px, 0], [0, side_px], [side_px, side_px]]) @ to_picture[:, :2].T + corner
        laid.append(Window(to_picture, turn, np.concatenate([ends.min(axis=0), ends.max(axis=0)]), scale))
    return laid


def _reach(
    size: tuple[int, int], centre: np.ndarray, circle: tuple[float, float, float] | None, azimuths: np.ndarray
) -> np.ndarray:
    """Distances (n,) px from a point to where the picture ends in directions (n,) rad."""
    outward = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.where(outward > 0, np.array(size) - centre, -centre) / outward
    reach = np.nan_to_num(sides, nan=np.inf).min(axis=1)
    if circle is not None:
        away = centre - [circle[0] + 0.5, circle[1] + 0.5]
        along = outward @ away
        reach = np.minimum(reach, np.sqrt(np.maximum(along**2 - away @ away + circle[2] ** 2, 0.0)) - along)
    return np.maximum(reach, 0.0)


class WindowedNetwork:
    """A network that looks at windows of the picture in place of all of it.

    Args:
        network: of any head.
        size: (width, height) px of the picture.
        centre: (2,) px, corner-based, of the point below the camera.
        count: number of windows.
        circle: (x, y, radius) px, of what the lens lights; None: all of the picture.

    Attributes:
        looked, skipped: windows so far in which the network looked, and in which nothing had changed.
    """

    def __init__(
        self,
        network: Network,
        size: tuple[int, int],
        centre: np.ndarray,
        count: int,
        circle: tuple[float, float, float] | None = None,
    ):
        self.network, self.confidence = network, network.confidence
        self._side, self._centre = min(network.size), np.asarray(centre, float)
        self._windows = windows(size, self._centre, circle, count, self._side)
        self._found: list[Boxes | None] = [None] * count
        self.looked = self.skipped = 0

    def detect(self, picture: np.ndarray, regions: np.ndarray | None = None) -> Boxes:
        """Find the people in a picture, as `Network.detect`; only windows that the regions touch are looked at."""
        for index, window in enumerate(self._windows):
            if self._found[index] is None or regions is None or _touches(window.box, regions):
                self._found[index] = self._look(picture, window)
                self.looked += 1
            else:
                self.skipped += 1
        found = [one for one in self._found if one is not None]
        parts = [one.parts for one in found if one.parts is not None]
        turned = np.concatenate([one.turned for one in found if one.turned is not None])
        boxes, scores = np.concatenate([one.boxes for one in found]), np.concatenate([one.scores for one in found])
        kept = suppress(boxes, scores * self._uprightness(turned), OVERLAP, WITHIN)
        kept = kept[np.argsort(-scores[kept], kind="stable")]
        known = np.concatenate(parts)[kept] if parts else None
        return Boxes(boxes[kept], scores[kept], known, turned[kept])

    def _uprightness(self, turned: np.ndarray) -> np.ndarray:
        """Weights (n,) by which boxes (n, 5) are preferred in whose window the way from the point to them leads up."""
        away = turned[:, :2] - self._centre
        up = np.column_stack([np.sin(turned[:, 4]), -np.cos(turned[:, 4])])
        cosine = (away * up).sum(axis=1) / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        return 1 - LEANING * (1 - cosine) / 2

    def _look(self, picture: np.ndarray, window: Window) -> Boxes:
        import cv2

        to_picture = window.to_picture.copy()
        to_picture[:, 2] += to_picture[:, :2] @ [0.5, 0.5] - 0.5  # OpenCV's pixels are centre-based
        flags = (cv2.INTER_AREA if window.scale > 2 else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
        size = self._side, self._side
        image = cv2.warpAffine(picture, to_picture, size, flags=flags, borderValue=(PAD, PAD, PAD))
        found = self.network.detect(image)
        clipped = np.clip(found.boxes, 0, self._side)
        # Beyond the upper side there is no more picture: it cuts nobody whom another window shows whole.
        cut = (clipped[:, 0] < _EDGE_PX) | (clipped[:, 2:] > self._side - _EDGE_PX).any(axis=1)
        middles, extents = (clipped[:, :2] + clipped[:, 2:]) / 2, clipped[:, 2:] - clipped[:, :2]
        middles = middles @ window.to_picture[:, :2].T + window.to_picture[:, 2]
        extents = extents * window.scale
        scores = np.where(cut, 0.5 * found.scores, found.scores)
        parts = None
        if found.parts is not None:
            parts = found.parts @ window.to_picture[:, :2].T + window.to_picture[:, 2]
        turned = np.column_stack([middles, extents, np.full(len(found), window.turn)])
        return Boxes(upright(turned), scores, parts, turned)


def upright(turned: np.ndarray) -> np.ndarray:
    """Boxes (n, 4) [x0, y0, x1, y1] about bodies in turned boxes (n, 5) [x, y, width, height, turn rad]."""
    cosine, sine = np.abs(np.cos(turned[:, 4])), np.abs(np.sin(turned[:, 4]))
    across = ((cosine * turned[:, 2]) ** FILLED + (sine * turned[:, 3]) ** FILLED) ** (1 / FILLED)
    down = ((sine * turned[:, 2]) ** FILLED + (cosine * turned[:, 3]) ** FILLED) ** (1 / FILLED)
    half = np.column_stack([across, down]) / 2
    return np.concatenate([turned[:, :2] - half, turned[:, :2] + half], axis=1)


def _touches(box: np.ndarray, regions: np.ndarray) -> bool:
    return bool(((regions[:, :2] < box[2:]) & (regions[:, 2:] > box[:2])).all(axis=1).any())
