"""What people wear: the colours of head, upper body and lower body, each with an honest standard deviation.

Every component is a median over the samples of a part of the body, of logarithms of the picture's own values, relative
to the empty room's. Exposure, gain and the colour of the light multiply the room and the clothes alike, and cancel
(von Kries's model of adaptation, 1902). The axes of colour are the opponent ones of Finlayson, Hordley and Drew (2002):
lightness, warm against cool, and green against magenta. Their errors are nearly independent of each other.

The standard deviation follows from how much the part's own samples differ: a pattern, a border with the background or
with bare skin, and a sleeve in the shade all show there.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np

from avcli.detection.body import Person, Surface, standing
from avcli.detection.monocular import HEIGHT_M
from avcli.detection.view import View
from avcli.formats.features import Feature
from avcli.numeric import median

KIND, NAME = "clothes", "looks"

PARTS = {"head": (0.88, 1.03), "upper": (0.58, 0.80), "lower": (0.12, 0.36)}
"""Parts of the body: from and to which part of its height. Neck, waist, hands and feet are left out."""

COLOURS = ("light", "warm", "green")
COMPONENTS = ("head_light", *(f"{part}_{colour}" for part in ("upper", "lower") for colour in COLOURS))
"""What a vector holds. A head's colour changes with its turn, from hair to face: it told nothing of real people."""

_KEPT = [3 * list(PARTS).index(part) + COLOURS.index(colour) for part, colour in (c.split("_") for c in COMPONENTS)]

_AXES = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, 0.0, -1.0], [-0.5, 1.0, -0.5]]).T
_ROOM = 0.45
"""Value, of 1, to which the room's median is brought; with it `_DARK` is a share of the room's light."""

_DARK = 0.05
"""Added before the logarithm, so that noise and glare in black cloth make no colour."""

_USABLE = 12, 245
"""Values of the room between which a sample tells about the light: neither black nor clipped."""

_CLIPPED, _GREY = 252, 12
"""A value from which a sample may be clipped; and the difference of red, green and blue that is noise."""

_FEWEST, _MOST = 6, 300
"""Samples of a part: with fewer it was not seen, and more tell nothing new."""

_SEEN = 1 / 3
"""Least visible fraction of a body: of whom depth shows less, an arm stands for all of the upper body."""

_ROOM_ROWS, _LEAST_ROOM = 54, 200
"""Rows of samples of the room, and the number of them that its light is measured by at least."""


_SAME_COLOUR, _SHADOW, _LIT = 0.2, 0.4, 0.2
"""Differences of logarithms up to which a sample is the room's: of its colour, and of a shadow and a brighter light."""


@dataclass(frozen=True)
class LooksLaw:
    """How far the components are off.

    Attributes:
        floor: (7,) standard deviation of a part of one colour: light, turn and place.
        slope: the spread of a part's samples, times this, is added in squares.
    """

    floor: np.ndarray
    slope: float

    def deviations(self, spreads: np.ndarray) -> np.ndarray:
        """Standard deviations (n, 7) of the medians of samples with these spreads (n, 7), standard deviations too."""
        return np.hypot(self.floor, self.slope * spreads)


def _read() -> LooksLaw:
    fitted = json.loads((resources.files("avcli.detection") / "looks.json").read_text())
    return LooksLaw(np.array(fitted["floor"]), fitted["slope"])


LAW = _read()


def feature(people: Sequence[Person]) -> dict[str, Feature]:
    """Return the feature "looks" of the people that were described, by its name; empty where none was."""
    unknown = np.full((2, len(COMPONENTS)), np.nan)
    looks = np.array([unknown if person.looks is None else person.looks for person in people])
    if not len(looks) or np.isnan(looks).all():
        return {}
    return {NAME: Feature(KIND, looks[:, 0].round(3), looks[:, 1].round(3))}


_LOGARITHMS = np.log(np.maximum(np.arange(256), 1) / 255)
"""Of the 256 levels of a pixel, as fractions of the largest; of 0 that of 1."""


class Looks:
    """Describes the clothes of the people in a camera's pictures, which must come in order of time.

    Args:
        view: the camera.
        law: the fitted errors.
    """

    def __init__(self, view: View, law: LooksLaw = LAW):
        self.view, self.law = view, law
        self._room: np.ndarray | None = None
        self._whole = np.full((1, 1, 3), np.nan)
        self._median = self._light = np.zeros(3)

    def describe(self, picture: np.ndarray, people: Sequence[Person]) -> np.ndarray:
        """Measure the people found in a picture.

        Args:
            picture: (height, width, 3) uint8 RGB.
            people: who were found in it, n.

        Returns:
            (n, 2, 7): the vector of each person in the order of COMPONENTS, and its standard deviations. NaN for a part
            that is not seen, for who is mostly hidden, for whoever has no colour in a picture without colours (it may
            show heat), and for all where the picture does not show enough of the room.
        """
        described = np.full((len(people), 2, len(COMPONENTS)), np.nan)
        step = _step(picture)
        room = np.moveaxis(picture[step // 2 :: step, step // 2 :: step], -1, 0).copy()
        gain = self._gain(room, step, people)
        if gain is None:
            return described
        table = np.log(np.arange(256) / 255 * gain[:, None] + _DARK)
        grey = _is_grey(np.moveaxis(room, 0, -1), 0.002)
        for index, person in enumerate(people):
            if person.visible is not None and person.visible < _SEEN:
                continue
            surface = self._surface(person, people, picture)
            colours = picture[surface.rows, surface.columns]
            if not (grey and _is_grey(colours, 0.05)):
                share = surface.heights / (person.height or HEIGHT_M)
                medians, spreads = _medians(colours, share, table)
                described[index] = medians, self.law.deviations(spreads)
        return described

    def _surface(self, person: Person, people: Sequence[Person], picture: np.ndarray) -> Surface:
        """Where the picture shows a person.

        Without depth it is where a standing body is, in the box, outside nearer people's boxes, and unlike the room.
        """
        if person.surface is not None:
            return person.surface
        surface = standing(person.position[:2], person.height or HEIGHT_M, self.view)
        shown = _in_box(surface, person.bbox_px)
        for other in people:
            if other is not person and self._away(other) < self._away(person):
                shown &= ~_in_box(surface, other.bbox_px)
        rows, columns = surface.rows, surface.columns
        shown &= ~self._like_room(picture[rows, columns], rows, columns, _step(picture))
        return Surface(rows[shown], columns[shown], surface.heights[shown], surface.areas[shown])

    def _like_room(self, colours: np.ndarray, rows: np.ndarray, columns: np.ndarray, step: int) -> np.ndarray:
        """Whether colours (n, 3) are those of the room there, in the light or in a body's shadow; (n,) bool."""
        height, width = self._whole.shape[:2]
        room = self._whole[np.minimum(rows // step, height - 1), np.minimum(columns // step, width - 1)]
        change = (np.log(np.maximum(colours, 1) / 255) - room - self._light) @ _AXES
        alike = (np.abs(change[:, 1:]) < _SAME_COLOUR).all(axis=1)
        return np.asarray(alike & (change[:, 0] > -_SHADOW) & (change[:, 0] < _LIT))

    def _away(self, person: Person) -> float:
        return float(np.linalg.norm(person.position[:2] - self.view.origin[:2]))

    def _gain(self, room: np.ndarray, step: int, people: Sequence[Person]) -> np.ndarray | None:
        """Factors (3,) of red, green and blue that bring the room to `_ROOM`; None where the picture shows no room.

        The light of a picture is compared with that of the first one sample by sample, so that it does not matter
        which part of the room the people hide.

        Args:
            room: (3, h, w) samples of a picture.
            step: px between them.
            people: who hide the room.
        """
        usable = (room > _USABLE[0]) & (room < _USABLE[1])
        free = np.asarray(usable[0] & usable[1] & usable[2])
        for person in people:
            x0, y0, x1, y1 = np.maximum(person.bbox_px / step, 0).astype(int)
            free[y0 : y1 + 1, x0 : x1 + 1] = False
        if free.sum() < _LEAST_ROOM:
            return None
        values, known = _LOGARITHMS.take(room), self._room
        both = free & ~np.isnan(known[0]) if known is not None and known.shape == room.shape else np.zeros((0, 0), bool)
        if known is None or both.sum() < _LEAST_ROOM:
            known = np.full(room.shape, np.nan)
            self._median, self._light = median(values[:, free]), np.zeros(3)
        else:
            self._light = median(values[:, both] - known[:, both])
        new = free & np.isnan(known[0])
        if new.any():
            known[:, new] = values[:, new] - self._light[:, None]
            self._room, self._whole = known, _filled(np.moveaxis(known, 0, -1))
        return np.asarray(_ROOM / np.exp(self._median + self._light))


def _medians(colours: np.ndarray, share: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Medians (7,) of the components and their spreads (7,) over a part, as standard deviations; NaN: not seen.

    Args:
        colours: (n, 3) uint8.
        share: (n,) of the body's height.
        table: (3, 256) logarithms of the values.
    """
    medians, spreads = np.full((2, len(PARTS), len(COLOURS)), np.nan)
    for index, (low, high) in enumerate(PARTS.values()):
        own = colours[(share >= low) & (share < high)]
        own = own[:: -(-len(own) // _MOST)] if len(own) else own
        if len(own) < _FEWEST or (np.maximum(np.maximum(*own.T[:2]), own[:, 2]) >= _CLIPPED).mean() > 0.5:
            continue
        values = np.sort(_AXES.T @ np.stack([table[k, own[:, k]] for k in range(3)]), axis=1)
        lower, medians[index], upper = values[:, [len(own) // 4, len(own) // 2, (3 * len(own)) // 4]].T
        spreads[index] = (upper - lower) / 1.349
    return medians.ravel()[_KEPT], spreads.ravel()[_KEPT]


def _step(picture: np.ndarray) -> int:
    """Distance of the samples of the room, px."""
    return max(picture.shape[0] // _ROOM_ROWS, 1)


def _filled(room: np.ndarray) -> np.ndarray:
    """The samples of a room (h, w, 3); those that are NaN, where somebody has been all the time, as the nearest one."""
    import cv2

    known = ~np.isnan(room[..., 0])
    if not known.any():
        return room
    labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    of_label = np.zeros((labels.max() + 1, 3))
    of_label[labels[known]] = room[known]
    return of_label[labels]


def _is_grey(colours: np.ndarray, few: float) -> bool:
    """Whether at most a few of the samples (..., 3) have a colour."""
    if not colours.size:
        return True
    red, green, blue = np.moveaxis(colours, -1, 0)  # a reduction over three numbers each takes five times as long
    brightest, darkest = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    return bool((brightest - darkest > _GREY).mean() <= few)


def _in_box(surface: Surface, box: np.ndarray) -> np.ndarray:
    x, y = surface.columns + 0.5, surface.rows + 0.5
    return (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
