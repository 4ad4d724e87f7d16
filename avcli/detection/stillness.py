"""How much what a box shows has moved: a person never keeps quite still, a plant or a chair does.

Grey pictures are kept for some seconds, reduced. What a box shows now is compared with what it showed half a second to
eight seconds ago: in each of up to nine parts, by least squares, the shift that turns one picture into the other (Lucas
and Kanade, 1981), and the logarithm of the likelihood ratio of that shift to none. A sway of a tenth of a pixel changes
a pixel by less than the noise, yet all pixels of the part agree about it; noise, compression and flicker do not. Where
a sway could hardly be seen, stillness tells little. The more pictures show no shift, the less probable is a person.
Moving alone is no evidence for a person, since screens and curtains move too: it takes back what stillness has told,
and no more. What stands where somebody passes is the same as some seconds before, so that it is not taken for a person
again. Who has come since the film began is believed however still he or she sits, since furniture does not come by
itself; and what has come and moves is a person more probably than the network knows.

The numbers were chosen on eleven real films of a ceiling fisheye and on random worlds, see
examples/benchmarks/detection.md.
"""

from functools import lru_cache
from itertools import combinations_with_replacement

import numpy as np

from avcli.detection.agreement import overlaps
from avcli.numeric import median

WIDTH_PX = 320
"""Width, about, at which pictures are compared."""

AGES_S = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Ages of the pictures with which the present one is compared; a picture of .7 to 1.4 times the age serves."""

NEAREST, FARTHEST = 0.7, 1.4

STEP_S = 0.24
"""Pictures nearer to each other in time are not both kept."""

MOVED, SLOPE = 2.4, 2.0
"""Logarithm of the nats for a shift, of the part that moves most, a hand or the head, that tell nothing; and the nats
that a picture tells a unit beside it."""

SWAY = 0.01
"""Sway, as a part of a box's size, of people who hardly move. Where it would show less than what tells nothing,
stillness tells less. In random worlds (seeds 5100 to 5129) 30 of 1876 people are held back with it and 36 without, and
it lets no furniture through."""

PART_PX = 6
"""A box is looked at in nine parts, four, or as a whole, so that no side of a part is shorter than this, reduced px."""

LEAST, MOST = -2.0, 1.0
"""Nats that one picture tells at most, against a person and back."""

DOUBT = -5.0
"""Nats that all pictures tell at most: some people keep still for long."""

SUREST = 0.99
"""Score that stillness takes higher ones for: networks say 1.00 of shelves, too."""

OTHER = 20.0
"""What no shift explains counts as noise up to this many times the room's; more is something else that stands there."""

QUANTUM = 0.02
"""Grey levels squared: less change than this is none, in pictures of a perfect sensor."""

CAME_S, KNOWN_S = 4.0, 600.0
"""Who is where two pictures, the first of these apart, s, show something else has come there. Furniture does not, so
that stillness tells nothing of who did. The two are the film's first, and later ones after the second, s."""

COME = 1.5
"""Nats for a person that motion tells at most of what has come. In the eleven real films 73 of 108 boxes with scores of
.2 to .5 that had come and moved were right (81 of 117 by the network before), and 11 (8) showed nobody: a factor of 4
in the odds. `make bench-real-video` counts them with `--films 20`."""

UNLIKE, CHANGE, OTHERS = 0.7, 5.0, 0.4
"""A part shows something else if the correlation of the two pictures is less than the first and their mean squared
difference more than so many times the room's; a box, if this share of its parts do."""

FIT_S = 2.0
"""s after which the room's own change is learnt again."""

ALIKE = 0.8
"""Overlap over union of boxes that are looked at once until the next picture is kept."""

STEADY = 0.5
"""Where the room changes by more than this part of its squared contrast, the camera moves, or pictures are of several
rooms: people would not stand out, and nothing is told."""

SEEN = 0.25
"""Share of a part that must show a body for the part to tell whether the body moves."""

_TILE_PX, _FEWEST_TILES, _UNLIT = 8, 30, 8.0
_FEWEST_PX = 6
_GREY = np.array([0.299, 0.587, 0.114], np.float32)


class Stillness:
    """Remembers a film's last seconds and says of boxes how much less probable people are for having kept still."""

    def __init__(self) -> None:
        self._kept: list[tuple[float, np.ndarray]] = []
        self._noise: float | None = None
        self._fitted_at = -np.inf
        self._picture, self._time = np.zeros((0, 0, 3), np.uint8), -np.inf
        self._earlier: list[tuple[np.ndarray, float]] = []
        self._first: list[tuple[float, np.ndarray]] = []
        self._looked, self._evidence = np.empty((0, 4), int), np.empty((0, 2))

    @property
    def _factor(self) -> int:
        return max(round(self._picture.shape[1] / WIDTH_PX), 1)

    def see(self, picture: np.ndarray, time: float, boxes: np.ndarray) -> None:
        """Take in a picture (height, width, 3) uint8 of a time, s, with what may be people at boxes (n, 4) px.

        A time that is not later, or another size, begins anew.
        """
        if self._kept and (time <= self._time or picture.shape != self._picture.shape):
            self._kept, self._first, self._noise, self._fitted_at = [], [], None, -np.inf
        self._picture, self._time = picture, time
        if self._kept and time < self._kept[-1][0] + STEP_S:
            return
        self._looked, self._evidence = np.empty((0, 4), int), np.empty((0, 2))
        now = _reduced(picture, self._factor)
        self._earlier = self._pictures(now)
        if time >= self._fitted_at + FIT_S:
            self._fit(now, boxes / self._factor)
        self._kept = [one for one in self._kept if time - one[0] <= FARTHEST * AGES_S[-1]] + [(time, now)]
        if not self._first or time - self._first[0][0] > KNOWN_S:
            self._first = self._kept[:1]
        if len(self._first) == 1:
            self._first += [one for one in self._kept if one[0] >= self._first[0][0] + CAME_S][:1]

    def evidence(self, boxes: np.ndarray) -> np.ndarray:
        """Logarithms (n,) of likelihood ratios, person over thing, of boxes (n, 4) px, from `DOUBT` to `COME`."""
        return self.told(boxes, np.ones(len(boxes), bool))[:, 0]

    def told(self, boxes: np.ndarray, wholly: np.ndarray) -> np.ndarray:
        """The evidence (n, 2) of boxes (n, 4) px, nats; second, what motion tells of who was found before, 0 to `COME`.

        Of boxes that are not looked at `wholly`, (n,) bool, only who came tells anything, which takes less time.
        """
        told = np.zeros((len(boxes), 2))
        if self._noise is None:
            return told
        for k, corner in enumerate(self._corners(boxes)):
            alike = overlaps(corner[None], self._looked)[0]
            if len(alike) and alike.max() >= ALIKE:
                told[k] = self._evidence[alike.argmax()]
            elif (corner[2:] - corner[:2]).min() >= _FEWEST_PX:
                both = self._told(corner, bool(wholly[k]))
                if both is None:
                    continue
                told[k] = both
                self._looked = np.append(self._looked, corner[None], axis=0)
                self._evidence = np.append(self._evidence, told[k : k + 1], axis=0)
        return told

    def motion(self, box: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> float:
        """Logarithm of the likelihood ratio, person over thing, of a body that has moved: from 0, nothing told.

        It is for a body that stands before the empty room, which is neither a screen nor a curtain.

        Args:
            box: (4,) px about the body.
            columns, rows: (n,) px of samples of the body's surface; what else the box shows does not count.
        """
        (corner,) = self._corners(box[None]) if self._noise is not None else (np.zeros(4, int),)
        x0, y0, x1, y1 = corner.tolist()
        if min(x1 - x0, y1 - y0) < _FEWEST_PX:
            return 0.0
        import cv2

        height, width = self._kept[-1][1].shape[:2]
        seen = np.zeros((height, width), np.uint8)
        y, x = rows.astype(int) // self._factor, columns.astype(int) // self._factor
        seen[np.minimum(y, height - 1), np.minimum(x, width - 1)] = 1
        whole = cv2.morphologyEx(seen[y0:y1, x0:x1], cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return max(self._nats(self._part(x0, y0, x1, y1), x0, y0, whole.astype(np.float32)), 0.0)

    def _corners(self, boxes: np.ndarray) -> np.ndarray:
        """Corners (n, 4) in the reduced picture, px, of boxes (n, 4) px."""
        height, width = self._kept[-1][1].shape[:2]
        corners = np.concatenate([np.floor(boxes[:, :2] / self._factor), np.ceil(boxes[:, 2:] / self._factor)], axis=1)
        return np.clip(corners, 0, [width, height, width, height]).astype(int)

    def _part(self, x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
        factor, (kept, small) = self._factor, self._kept[-1]
        if kept == self._time:
            return small[y0:y1, x0:x1]
        return _reduced(self._picture[y0 * factor : y1 * factor, x0 * factor : x1 * factor], factor)

    def _told(self, corner: np.ndarray, wholly: bool) -> tuple[float, float] | None:
        """The evidence of one part of the reduced picture, px, and its motion; None if not looked at and not come."""
        assert self._noise is not None  # who calls has looked
        if not wholly and len(self._first) < 2:
            return None
        x0, y0, x1, y1 = corner.tolist()
        part, least = self._part(x0, y0, x1, y1), CHANGE * self._noise
        came = len(self._first) == 2 and all(_other(part, then[y0:y1, x0:x1], least) for _, then in self._first)
        if not (came or wholly):
            return None
        nats = self._nats(part, x0, y0)
        moves = float(np.clip(nats, 0.0, COME))
        return (moves if came else float(np.clip(nats, DOUBT, 0.0))), moves

    def _nats(self, part: np.ndarray, x0: int, y0: int, seen: np.ndarray | None = None) -> float:
        """What the pictures before tell of a part (h, w) at a place, px, or of what of it is `seen`, (h, w) 0 or 1."""
        assert self._noise is not None  # who calls has looked
        if not self._earlier:
            return 0.0
        height, width = part.shape
        before = np.stack([then[y0 : y0 + height, x0 : x0 + width] + light for then, light in self._earlier], axis=-1)
        shifted, swaying = _shifts(part, before, OTHER * self._noise, seen)
        least = LEAST * np.minimum(swaying / np.exp(MOVED), 1.0)
        return float(np.clip(SLOPE * (np.log(shifted) - MOVED), least, MOST).sum())

    def _pictures(self, now: np.ndarray) -> list[tuple[np.ndarray, float]]:
        """Pictures kept that have the ages, youngest first, and how much brighter a reduced one is than each.

        One that is the same in all pixels tells nothing: a camera that has stopped, or repeats its pictures.
        """
        old = self._time - np.array([time for time, _ in self._kept])
        found = []
        for age in AGES_S if len(old) else ():
            nearest = int(np.abs(old - age).argmin())
            then = self._kept[nearest][1]
            if not NEAREST * age <= old[nearest] <= FARTHEST * age:
                continue
            if (now[::8] != then[::8]).any() or not np.array_equal(now, then):
                found.append((then, _brighter(now, then)))
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
        free *= now >= _UNLIT
        whole = cv2.resize(free, tiles, interpolation=cv2.INTER_AREA) > 0.99
        if whole.sum() < _FEWEST_TILES:
            return
        across, down = _slopes(now)
        texture = cv2.resize(across**2 + down**2, tiles, interpolation=cv2.INTER_AREA)[whole]

        def changed(then: np.ndarray) -> tuple[float, bool]:
            """The tiles' median squared change, and whether the camera has moved since."""
            differs = (now - then - _brighter(now, then)) ** 2
            change = cv2.resize(differs, tiles, interpolation=cv2.INTER_AREA)[whole].astype(float)
            quiet = change <= np.partition(change, most := int(0.9 * (len(change) - 1)))[most]  # what moves is left out
            return float(median(change)), change[quiet].mean() >= STEADY * max(float(texture[quiet].mean()), QUANTUM)

        noise, moved = changed(self._earlier[:2][-1][0])
        self._noise = None if moved else max(noise, QUANTUM)
        if self._first and changed(self._first[0][1])[1]:
            self._first = []


def after(scores: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """Probabilities (n,) of people with scores (n,) once the evidence (n,), nats, is known."""
    sure = np.clip(scores, 1e-6, SUREST)
    told = 1 / (1 + (1 - sure) / sure * np.exp(-evidence))
    return np.where(evidence > 0, np.maximum(scores, told), np.where(evidence < 0, np.minimum(scores, told), scores))


def _reduced(picture: np.ndarray, factor: int) -> np.ndarray:
    """Grey of a picture (height, width, 3) uint8, each pixel the mean of factor × factor; what is left over is cut."""
    import cv2

    height, width = (side // factor for side in picture.shape[:2])
    small = picture[: height * factor, : width * factor]
    for times in (2, factor // 2) if factor % 2 == 0 else (factor,):  # by two takes a third of the time
        if times > 1:
            size = small.shape[1] // times, small.shape[0] // times
            small = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
    return small @ _GREY


def _other(now: np.ndarray, then: np.ndarray, least: float) -> bool:
    """Whether two pictures (h, w) show two things: parts are unlike, and differ by more than `least`, squared."""
    now, then = now - now.mean(), then - then.mean()
    if np.square(now - then).mean() < OTHERS / 2 * least:  # too little, however it is spread over the parts
        return False
    one, other, both = _of_parts(np.stack([now * now, then * then, now * then])[..., None])[..., 0]
    unlike = both < UNLIKE * np.sqrt(one * other)
    return bool((unlike & (one + other - 2 * both > least)).mean() >= OTHERS)


def _brighter(now: np.ndarray, then: np.ndarray) -> float:
    """How much brighter a reduced picture is than another."""
    return float(median((now[::8, ::4] - then[::8, ::4]).ravel()))


def _slopes(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of a picture (height, width) by x and y, a pixel."""
    import cv2

    across, down = (cv2.Sobel(picture, -1, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    return across, down


def _shifts(
    now: np.ndarray, then: np.ndarray, most: float, seen: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms (n,), nats, of the likelihood ratios of a shift to none between a picture and n others, and of a sway.

    Of the part where it is largest; the sway, `SWAY`, is that which would be seen best. Squared differences a pixel
    that no shift explains are taken for noise up to `most`. Pixels that are not `seen`, (h, w) 0 or 1, do not count;
    two parts of a body must then have moved, since a camera's time stamp changes, too.

    Args:
        now: (h, w).
        then: (h, w, n).
    """
    now = now[..., None]
    across, down = (slope.reshape(then.shape) for slope in _slopes((now + then) / 2))
    each = across, down, now - then
    values, shares = np.empty((9, *then.shape), np.float32), np.ones((1, 1))
    values[:3] = each
    for value, pair in zip(values[3:], combinations_with_replacement(each, 2), strict=True):
        np.multiply(*pair, out=value)
    if seen is None:
        mean = _of_parts(values)
    else:
        shares = _of_parts(seen[None, ..., None])[0]
        mean = _of_parts(values * seen[..., None]) / np.maximum(shares, 1e-6)
    x, y, e, xx, xy, xe, yy, ye, ee = mean
    xx, xy, xe, yy, ye, ee = xx - x * x, xy - x * y, xe - x * e, yy - y * y, ye - y * e, ee - e * e
    xx, yy = xx + QUANTUM, yy + QUANTUM
    explained = (yy * xe**2 - 2 * xy * xe * ye + xx * ye**2) / (xx * yy - xy**2)
    doubled = 2 * np.clip(ee - explained, QUANTUM, most) / (now.size / len(x))
    sway = SWAY**2 * now.size * (xx + yy) / 2
    shifts, sways = (np.where(shares >= SEEN, one * shares / doubled, 0.0) for one in (explained, sway))
    told = shifts.max(axis=0) if seen is None else np.sort(shifts, axis=0)[-2] if len(shifts) > 1 else np.zeros(1)
    return np.maximum(told, 1e-3), sways.max(axis=0)


def _of_parts(values: np.ndarray) -> np.ndarray:
    """Means (k, 4 or 9, n) of the parts of n pictures of k values, (k, height, width, n)."""
    down, across, sizes = _parts(*values.shape[1:3])
    sums = np.add.reduceat(np.add.reduceat(values, down, axis=1), across, axis=2)
    return np.asarray(sums.reshape(len(values), len(sizes), -1) / sizes)


@lru_cache(256)
def _parts(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the parts of a picture of this size begin, by rows and columns, and their pixels (4 or 9, 1)."""
    count = int(np.clip(min(height, width) // PART_PX, 1, 3))
    down, across = (side * np.arange(count + 1) // count for side in (height, width))
    return down[:-1], across[:-1], np.multiply.outer(np.diff(down), np.diff(across)).reshape(-1, 1)
