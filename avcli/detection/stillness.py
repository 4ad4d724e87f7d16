"""How much what a box shows has moved: a person never keeps quite still, a plant or a chair does.

Pictures are kept for some seconds, reduced. What a box shows now is compared with what it showed half a second to eight
seconds ago, in units of the change that the room itself shows in this film: the noise of its sensor and compression.
The more pictures show the same, the less probable is a person. Moving is no evidence for a person, since screens and
curtains move too: it takes back what stillness has told, and no more. What stands where somebody passes is the same as
some seconds before, so that it is not taken for a person again.

The numbers were chosen on eleven real films of a ceiling fisheye and on random worlds, see
examples/benchmarks/detection.md.
"""

import numpy as np

WIDTH_PX = 320
"""Width, about, at which pictures are compared."""

AGES_S = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Ages of the pictures with which the present one is compared; a picture of .7 to 1.4 times the age serves."""

NEAREST, FARTHEST = 0.7, 1.4

STEP_S = 0.24
"""Pictures nearer to each other in time are not both kept."""

MOVING = 3
"""Of nine parts of a box those that change most count: head, hands; the others may show a table."""

MOVED, SLOPE = 1.25, 2.0
"""Logarithm of the change in units of noise that tells nothing, and the nats that a picture tells a unit beside it."""

LEAST, MOST = -2.0, 1.0
"""Nats that one picture tells at most, against a person and back."""

DOUBT = -5.0
"""Nats that all pictures tell at most: some people keep still for long."""

QUANTUM = 0.05
"""Grey levels squared: less change than this is none, in pictures of a perfect sensor."""

FIT_S = 2.0
"""s after which the room's own change is learnt again."""

ALIKE = 0.8
"""Overlap over union of boxes that are looked at once until the next picture is kept."""

STEADY = 0.5
"""Where the room changes by more than this part of its squared contrast, the camera moves, or pictures are of several
rooms: people would not stand out, and nothing is told."""

_TILE_PX, _FEWEST_TILES, _UNLIT = 8, 30, 8.0
_FEWEST_PX = 3


class Stillness:
    """Remembers a film's last seconds and says of boxes how much less probable people are for having kept still."""

    def __init__(self) -> None:
        self._kept: list[tuple[float, np.ndarray]] = []
        self._noise: np.ndarray | None = None
        self._fitted_at = -np.inf
        self._picture, self._time = np.zeros((0, 0, 3), np.uint8), -np.inf
        self._earlier: list[tuple[np.ndarray, np.ndarray]] = []
        self._looked, self._evidence = np.empty((0, 4), int), np.empty(0)

    @property
    def _factor(self) -> int:
        return max(round(self._picture.shape[1] / WIDTH_PX), 1)

    def see(self, picture: np.ndarray, time: float, boxes: np.ndarray) -> None:
        """Take in a picture (height, width, 3) uint8 of a time, s, with what may be people at boxes (n, 4) px.

        A time that is not later, or another size, begins anew.
        """
        if self._kept and (time <= self._time or picture.shape != self._picture.shape):
            self._kept, self._noise, self._fitted_at = [], None, -np.inf
        self._picture, self._time = picture, time
        if self._kept and time < self._kept[-1][0] + STEP_S:
            return
        self._looked, self._evidence = np.empty((0, 4), int), np.empty(0)
        now = _reduced(picture, self._factor)
        self._earlier = self._pictures(now)
        if time >= self._fitted_at + FIT_S:
            self._fit(now, boxes / self._factor)
        self._kept = [one for one in self._kept if time - one[0] <= FARTHEST * AGES_S[-1]] + [(time, now)]

    def evidence(self, boxes: np.ndarray) -> np.ndarray:
        """Logarithms (n,) of likelihood ratios, person over thing, of boxes (n, 4) px: 0, nothing told, to `DOUBT`."""
        if self._noise is None or not len(boxes):
            return np.zeros(len(boxes))
        height, width = self._kept[-1][1].shape[:2]
        corners = np.concatenate([np.floor(boxes[:, :2] / self._factor), np.ceil(boxes[:, 2:] / self._factor)], axis=1)
        corners = np.clip(corners, 0, [width, height, width, height]).astype(int)
        told = np.zeros(len(boxes))
        for k, corner in enumerate(corners):
            alike = _overlap(corner, self._looked)
            if len(alike) and alike.max() >= ALIKE:
                told[k] = self._evidence[alike.argmax()]
            elif (corner[2:] - corner[:2]).min() >= _FEWEST_PX:
                told[k] = self._told(*corner.tolist())
                self._looked = np.append(self._looked, corner[None], axis=0)
                self._evidence = np.append(self._evidence, told[k])
        return told

    def _told(self, x0: int, y0: int, x1: int, y1: int) -> float:
        """The evidence of one part of the reduced picture, px."""
        assert self._noise is not None  # evidence() has looked
        if not self._earlier:
            return 0.0
        factor = self._factor
        part = _reduced(self._picture[y0 * factor : y1 * factor, x0 * factor : x1 * factor], factor)
        noise = np.maximum(_ninths(_causes(part)) @ self._noise, QUANTUM)
        then = np.stack([picture[y0:y1, x0:x1] for picture, _ in self._earlier])
        light = np.stack([light for _, light in self._earlier])
        changes = np.sort(_ninths(np.moveaxis(_change(part, then, light), 0, 2)) / noise[:, None], axis=0)
        levels = np.log(np.maximum(changes[-MOVING:].mean(axis=0), 1e-3))
        return float(np.clip(np.clip(SLOPE * (levels - MOVED), LEAST, MOST).sum(), DOUBT, 0.0))

    def _pictures(self, now: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Pictures kept that have the ages, youngest first, and how much brighter (3,) a reduced one is than each.

        One that is the same in all pixels tells nothing: a camera that has stopped, or repeats its pictures.
        """
        old = self._time - np.array([time for time, _ in self._kept])
        found = []
        for age in AGES_S if len(old) else ():
            nearest = int(np.abs(old - age).argmin())
            then = self._kept[nearest][1]
            frozen = np.array_equal(now, then)
            if NEAREST * age <= old[nearest] <= FARTHEST * age and not frozen:
                away = now[::8, ::4].astype(np.int16) - then[::8, ::4]
                found.append((then, np.median(away.reshape(-1, 3), axis=0)))
        return found

    def _fit(self, now: np.ndarray, boxes: np.ndarray) -> None:
        """Learn how much the room changes, from a reduced picture and one of some time before, beside the boxes."""
        import cv2

        if not self._earlier:
            return
        self._fitted_at = self._time
        height, width = now.shape[:2]
        tiles = max(width // _TILE_PX, 1), max(height // _TILE_PX, 1)
        free = np.ones((height, width), np.float32)
        for x0, y0, x1, y1 in np.rint(boxes).astype(int):
            free[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 0.0
        free *= now.max(axis=2) >= _UNLIT
        whole = cv2.resize(free, tiles, interpolation=cv2.INTER_AREA) > 0.99
        if whole.sum() < _FEWEST_TILES:
            return
        change = _change(now, *(one[None] for one in self._earlier[:2][-1]))[0]
        change = cv2.resize(change, tiles, interpolation=cv2.INTER_AREA)[whole]
        causes = cv2.resize(_causes(now), tiles, interpolation=cv2.INTER_AREA)[whole]
        law = _law(change.astype(float), causes.astype(float))
        texture = max(float(np.square(causes[:, 1], dtype=float).mean()), QUANTUM)
        self._noise = law if float((causes @ law).mean()) < STEADY * texture else None


def after(scores: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Probabilities (n,) of people with scores (n,) once the evidence (n,), nats, is known."""
    sure = np.clip(scores, 1e-6, 1 - 1e-6)
    return np.where(evidence == 0, scores, 1 / (1 + (1 - sure) / sure * np.exp(-evidence)))


def _reduced(picture: np.ndarray, factor: int) -> np.ndarray:
    """A picture (height, width, 3) uint8, each pixel the mean of factor × factor; what is left at the border is cut."""
    import cv2

    height, width = (side // factor for side in picture.shape[:2])
    whole = picture[: height * factor, : width * factor]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)) if factor > 1 else whole


def _change(now: np.ndarray, then: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Mean squared differences (n, h, w) of a picture (h, w, 3) from n others, their other light (n, 3) taken out."""
    away = now.astype(np.float32) - then
    away -= light[:, None, None].astype(np.float32)
    return np.asarray(np.einsum("nhwc,nhwc->nhw", away, away) / np.float32(3))


def _overlap(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Overlap over union (n,) of a box (4,) with others (n, 4)."""
    shared = np.maximum(np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2]), 0).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1) + (box[2:] - box[:2]).prod()
    return np.asarray(shared / np.maximum(areas - shared, 1))


def _ninths(values: np.ndarray) -> np.ndarray:
    """Means (9, c) of the parts of a picture (height, width, c)."""
    down, across = (side * np.arange(4) // 3 for side in values.shape[:2])
    sums = np.add.reduceat(np.add.reduceat(values, down[:3], axis=0), across[:3], axis=1)
    return np.asarray((sums / np.multiply.outer(np.diff(down), np.diff(across))[..., None]).reshape(9, -1))


def _causes(picture: np.ndarray) -> np.ndarray:
    """What noise grows with, (height, width, 3): nothing, contrast (compression), and darkness (gamma)."""
    import cv2

    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    across, down = cv2.spatialGradient(grey) if min(grey.shape) > 1 else (np.zeros(grey.shape),) * 2
    contrast = np.hypot(across.astype(np.float32), down.astype(np.float32)) / 8
    return np.stack([np.ones(grey.shape, np.float32), contrast, 1e3 / (grey + np.float32(12)) ** 2], axis=-1)


def _law(change: np.ndarray, causes: np.ndarray) -> np.ndarray:
    """Coefficients (3,), none negative, of causes (n, 3) that explain changes (n,), what moves left out."""
    expected = np.full(len(change), max(float(np.median(change)), QUANTUM))
    quiet = change <= np.quantile(change, 0.9)
    for _ in range(4):
        weights = quiet / expected
        law = np.zeros(3)
        free = np.ones(3, bool)  # a cause that would make for less noise has none, and the others are fitted again
        while free.any():
            law[free] = np.linalg.lstsq(causes[:, free] * weights[:, None], change * weights, rcond=None)[0]
            if (law[free] >= 0).all():
                break
            free &= law > 0
            law[~free] = 0.0
        expected = np.maximum(causes @ law, QUANTUM)
        quiet = change < 2 * expected
        if quiet.sum() < _FEWEST_TILES:
            break
    return np.asarray(law)
