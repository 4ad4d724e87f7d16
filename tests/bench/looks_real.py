"""Real people under ceiling cameras, for fit_looks.py: whose description is it, as far as the pictures tell.

The pictures are those of the branch Mirror_World of github.com/BenoitFaureIMT/CERIS_FishEye: 1025 frames, 640 × 640, of
19 films (train/ and valid/, images and boxes by hand). No licence is stated, so they are used to measure with and are
never copied. The boxes have no identities. Boxes of frames that follow each other are linked where only one link is
possible; two boxes of one frame are two people. Lens and height of the cameras are not known: an equidistant lens that
shows a half space is assumed, and for each film the height at which most boxes hold a standing body.
"""

import itertools
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from avcli.detection.body import Person
from avcli.detection.monocular import Fitted
from avcli.detection.view import View
from avcli.formats.media import read_rgb
from avcli.lens import KannalaBrandt
from avcli.pose import camera_pose

SIZE = 640
HEIGHTS_M = 2.2, 2.5, 2.8, 3.1
STEP, REACH_PX, CLEAR = 25, 70.0, 0.5
"""Links: over at most so many frames and px, and at most so many times as far as any other link."""

APART = 15
"""Frames between two descriptions of a person that are compared."""

MOST_SAME, MOST_DIFFERENT = 60, 20
"""Pairs of one person and of two, so that nobody counts more than others."""

Frame = tuple[int, Path, np.ndarray]


def films(folder: Path) -> dict[int, list[Frame]]:
    """Film number -> its frames in order: number, picture, boxes (n, 4) px."""
    found: dict[int, list[Frame]] = defaultdict(list)
    for picture in sorted(folder.glob("*/images/vid*.jpg")):
        match = re.match(r"vid(\d+)im(\d+)_", picture.name)
        if match:
            text = (picture.parent.parent / "labels" / f"{picture.stem}.txt").read_text().split()
            middle, extent = np.split(np.array(text, float).reshape(-1, 5)[:, 1:] * SIZE, 2, axis=1)
            found[int(match[1])].append((int(match[2]), picture, np.hstack([middle - extent / 2, middle + extent / 2])))
    return {film: sorted(frames, key=lambda frame: frame[0]) for film, frames in sorted(found.items())}


def linked(frames: list[Frame]) -> list[np.ndarray]:
    """Number of the person of each box of each frame; a person who is lost gets a new number."""
    fresh, numbers = itertools.count(), list[np.ndarray]()
    before, last = np.empty((0, 2)), -STEP - 1
    for frame, _, boxes in frames:
        middles = (boxes[:, :2] + boxes[:, 2:]) / 2
        own = np.full(len(boxes), -1)
        if frame - last <= STEP:
            away = np.linalg.norm(middles[:, None] - before[None], axis=2)
            for row, column in zip(*linear_sum_assignment(away), strict=True):
                others = np.concatenate([np.delete(away[row], column), np.delete(away[:, column], row), [np.inf]])
                if away[row, column] < min(REACH_PX, CLEAR * others.min()):
                    own[row] = numbers[-1][column]
        own[own < 0] = [next(fresh) for _ in range((own < 0).sum())]
        numbers.append(own)
        before, last = middles, frame
    return numbers


def camera(frames: list[Frame]) -> View:
    """The camera of a film."""
    middle, focal = (SIZE - 1) / 2, SIZE / np.pi
    lens = KannalaBrandt(focal, focal, middle, middle, 0.0, 0.0, 0.0, 0.0)
    views = [View(lens, camera_pose([0, 0, height], [90, 0, 0]), (SIZE, SIZE), np.deg2rad(92)) for height in HEIGHTS_M]
    some = np.array([box for _, _, boxes in frames[::4] for box in boxes])
    return max(views, key=lambda view: Fitted(some, view).places().explained.sum())


def people(boxes: np.ndarray, view: View) -> list[Person | None]:
    """Place people by their boxes (n, 4); None where no body fits."""
    fits = Fitted(boxes, view).places()
    columns = zip(fits.explained, fits.positions, fits.heights.tolist(), boxes, strict=True)
    return [
        Person(np.array([*place, 0.9]), np.eye(3), 1.0, box, height, "monocular") if explained else None
        for explained, place, height, box in columns
    ]


def pictures(folder: Path, film: int) -> list[tuple[int, np.ndarray, list[Person], np.ndarray, View]]:
    """Frame, picture RGB, the people who could be placed, their numbers and the camera, of each frame of a film."""
    frames = films(folder)[film]
    view, found = camera(frames), []
    for (frame, path, boxes), numbers in zip(frames, linked(frames), strict=True):
        placed = people(boxes, view)
        kept = [k for k, one in enumerate(placed) if one is not None]
        picture = read_rgb(path)
        found.append((frame, picture, [one for one in placed if one is not None], numbers[kept], view))
    return found


def pairs(identity: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (m, 2) of descriptions of one person, and of two people who were seen together.

    Args:
        identity: (n,) of each description, of any film.
        frame: (n,) other numbers for frames of other films.
    """
    rng = np.random.default_rng(0)
    rows = {k: np.flatnonzero(identity == k) for k in np.unique(identity)}
    same: list[np.ndarray] = []
    for own in rows.values():
        each = np.array(
            [pair for pair in itertools.combinations(own, 2) if abs(frame[pair[0]] - frame[pair[1]]) >= APART]
        )
        same += list(rng.permutation(each)[:MOST_SAME]) if len(each) else []
    together = {pair for k in np.unique(frame) for pair in itertools.combinations(sorted(identity[frame == k]), 2)}
    different = [
        (rng.choice(rows[one]), rng.choice(rows[other]))
        for one, other in sorted(together)
        for _ in range(min(MOST_DIFFERENT, len(rows[one]) * len(rows[other])))
    ]
    return np.array(same).reshape(-1, 2), np.array(different).reshape(-1, 2)
