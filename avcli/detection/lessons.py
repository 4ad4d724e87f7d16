"""Pictures from which a network learns where people are: what a teacher saw in them, and the maps that follow."""

import math
from dataclasses import dataclass

import numpy as np

from avcli.detection.network import PAD, Letterbox
from avcli.detection.windows import upright

STRIDE = 8
"""px of the input for a cell of the maps."""

_SQUARE = 1.2
"""Ratio of the picture's sides up to which it may be turned by any angle."""


@dataclass(frozen=True)
class Lesson:
    """A picture and the people whom the teacher sees in it.

    Attributes:
        name: of the picture's file, or of its video.
        picture: (height, width, 3) uint8 RGB, whole cells of the network's input.
        people: (n, 5) [x, y, width, height, turn], px and rad: turned boxes that are sure.
        doubtful: (k, 4) [x0, y0, x1, y1] px.
        labels: (m, 4) px, made by hand; None: there are none for this picture.
    """

    name: str
    picture: np.ndarray
    people: np.ndarray
    doubtful: np.ndarray
    labels: np.ndarray | None = None

    @property
    def boxes(self) -> np.ndarray:
        """(n, 4) px of the sure people."""
        return upright(self.people)


def lesson(
    name: str, picture: np.ndarray, seen: tuple[np.ndarray, np.ndarray], size: tuple[int, int],
    labels: np.ndarray | None = None,
) -> Lesson:  # fmt: skip
    """A picture at the scale of the learner's input, with what was seen in it.

    Args:
        name: of the picture's file.
        picture: (height, width, 3) uint8 RGB.
        seen: (n, 5) and (k, 4) px of the picture, from `Teacher.look`.
        size: (width, height) px of the learner's input.
        labels: (m, 4) px of the picture, made by hand; None: there are none.
    """
    fit = Letterbox.fit((picture.shape[1], picture.shape[0]), size)
    people = seen[0].copy()
    people[:, :2], people[:, 2:4] = fit.to_input(people[:, :2]), people[:, 2:4] * fit.scale
    doubtful, made = (
        None if boxes is None else fit.to_input(boxes.reshape(-1, 2, 2)).reshape(-1, 4) for boxes in (seen[1], labels)
    )
    return Lesson(name, fit.apply(picture), people, np.zeros((0, 4)) if doubtful is None else doubtful, made)


def drawn(one: Lesson, chance: np.random.Generator) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """A lesson's picture (h, w, 3) uint8, turned, mirrored, scaled and in another light, and its `targets`."""
    import cv2

    height, width = one.picture.shape[:2]
    may_turn = max(width, height) <= _SQUARE * min(width, height) and chance.random() < 0.5
    angle = chance.uniform(0, 2 * np.pi) if may_turn else np.pi * chance.integers(2)
    cosine, sine = np.exp(chance.normal(0, 0.08)) * np.array([np.cos(angle), np.sin(angle)])
    to_new = np.array([[cosine, -sine], [sine, cosine]]) @ np.diag([chance.choice([-1.0, 1.0]), 1.0])
    middle = np.array([width, height]) / 2
    map_ = np.column_stack([to_new, middle - to_new @ middle])
    centred = map_.copy()
    centred[:, 2] += centred[:, :2] @ [0.5, 0.5] - 0.5  # OpenCV's pixels are centre-based
    picture = cv2.warpAffine(one.picture, centred, (width, height), borderValue=(PAD, PAD, PAD))
    light = chance.uniform(0.75, 1.3) * chance.uniform(0.93, 1.07, 3)
    table = np.clip(255 * (np.arange(256) / 255)[:, None] ** chance.uniform(0.8, 1.25) * light, 0, 255).astype(np.uint8)
    picture = np.stack([table[picture[..., k], k] for k in range(3)], axis=-1)
    people = one.people.copy()
    people[:, :2] = people[:, :2] @ map_[:, :2].T + map_[:, 2]
    people[:, 2:4] *= np.hypot(cosine, sine)
    along = np.column_stack([np.cos(people[:, 4]), np.sin(people[:, 4])]) @ to_new.T
    people[:, 4] = np.arctan2(along[:, 1], along[:, 0])
    corners = one.doubtful[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2) @ map_[:, :2].T + map_[:, 2]
    doubtful = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    boxes = upright(people)
    clipped = np.clip(boxes, 0, [width, height, width, height])
    share = (clipped[:, 2:] - clipped[:, :2]).prod(axis=1) / np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1)
    whole = share > 0.5
    ignored = np.concatenate([doubtful, clipped[~whole]])
    spots = np.clip(people[whole, :2], 0, [width, height])
    return picture, targets(clipped[whole], spots, ignored, (width, height))


def targets(boxes: np.ndarray, spots: np.ndarray, ignored: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Maps to learn for one picture.

    Args:
        boxes: (n, 4) px of people.
        spots: (n, 2) px, where their scores belong.
        ignored: (k, 4) px in which nothing is held against the network, beyond the people.
        size: (width, height) px of the picture, whole cells.

    Returns:
        Heat (h, w): 1 at people; weights (h, w) of what is no person; logs of the distances, in cells, to the left,
        top, right and bottom of the box (4, h, w); weights (h, w) of these. float32.
    """
    rows, columns = size[1] // STRIDE, size[0] // STRIDE
    heat, negative = np.zeros((rows, columns), np.float32), np.ones((rows, columns), np.float32)
    reach, weight = np.zeros((4, rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    v, u = np.mgrid[:rows, :columns] + 0.5
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1) / STRIDE**2
    for x0, y0, x1, y1 in np.concatenate([ignored, boxes[area < 1.5]]) / STRIDE:
        negative[(v > y0 - 1) & (v < y1 + 1) & (u > x0 - 1) & (u < x1 + 1)] = 0
    for index in np.flatnonzero(area >= 1.5):
        x0, y0, x1, y1 = boxes[index] / STRIDE
        x, y = np.clip(spots[index] / STRIDE, [x0 + 0.5, y0 + 0.5], np.maximum([x1, y1], [x0 + 1, y0 + 1]) - 0.5)
        column, row = int(np.clip(x, 0, columns - 1)), int(np.clip(y, 0, rows - 1))
        sigma = max(0.12 * math.sqrt(area[index]), 0.7)
        blob = np.exp(-((u - column - 0.5) ** 2 + (v - row - 0.5) ** 2) / (2 * sigma**2))
        heat = np.maximum(heat, blob.astype(np.float32))
        here = (blob > 0.4) & (blob >= weight) & (u > x0) & (u < x1) & (v > y0) & (v < y1)
        here[row, column] = True
        reach[:, here] = np.log(np.maximum(np.stack([u - x0, v - y0, x1 - u, y1 - v]), 0.15))[:, here]
        weight[here] = blob[here]
    return heat, negative, reach, weight
