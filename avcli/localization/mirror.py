"""Microphones in one plane: a talker and the mirror image of the talker behind the plane are heard alike.

Mostly the room decides, as for an array on a wall or under the ceiling, or there is nothing to decide, as for a level
array in whose height people talk. Where both may be and are apart on the floor, both are told.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avcli.formats.features import Feature
from avcli.localization.array import Array, Talker
from avcli.localization.line import APART_M, BEYOND_M, HARDLY, repeated
from avcli.localization.memory import level_distance

FLAT_M = 0.01
"""m: how far from one plane, as a standard deviation, microphones that are far apart may be and be heard as in it."""


def mirrored(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the mirror images (..., 3) of vectors (..., 3) in the plane through the origin with a unit normal (3,)."""
    return points - 2.0 * (points @ normal)[..., None] * normal


@dataclass(frozen=True)
class HalfSpace:
    """The space before a plane of microphones, which stands for that behind it.

    Attributes:
        normal: (3,) unit vector.
        centre: (3,) m, the middle of the array.
        low, high: (3,) m, corners of the volume in which talkers may be.
    """

    normal: np.ndarray
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def beside(cls, array: Array, low: np.ndarray, high: np.ndarray) -> "HalfSpace | None":
        """Return that of an array in a volume with corners (3,) m; None where the microphones are not in one plane."""
        centre = array.microphones.mean(axis=0)
        normal = np.linalg.svd(array.microphones - centre)[2][2]
        return cls(normal, centre, low, high) if array.spread[2] < FLAT_M else None

    def searched(self, array: Array) -> tuple[Array, np.ndarray, np.ndarray]:
        """Return the array and the corners (3,) m of the volume, which is searched whole."""
        return array, self.low, self.high

    def image(self, points: np.ndarray) -> np.ndarray:
        """Return the mirror images (..., 3) m of points (..., 3) m."""
        return self.centre + mirrored(points - self.centre, self.normal)

    def fold(self, point: np.ndarray) -> np.ndarray:
        """Return the one of a point (3,) m and its mirror image in the volume that stands for both."""
        image = self.image(point)
        behind = (point - self.centre) @ self.normal < 0.0
        return image if behind and ((image >= self.low) & (image <= self.high)).all() else point

    def in_room(self, points: np.ndarray) -> np.ndarray:
        """Return where in the room points (n, 3) m are, (n, 3) m."""
        return points

    def told(
        self, talkers: Sequence[Talker], features: Mapping[str, Feature]
    ) -> tuple[list[Talker], dict[str, Feature]]:
        """Return talkers, with mirror images where these may be as well, and their features."""
        return repeated([self.sides(talker) for talker in talkers], features)

    def sides(self, talker: Talker) -> list[Talker]:
        """Return a talker, and the mirror image where it is in the volume and elsewhere on the floor."""
        image = self.image(talker.position)
        outside = float(((image - np.clip(image, self.low, self.high)) ** 2).sum())
        likely = float(np.exp(-0.5 * outside / BEYOND_M**2))
        if likely < HARDLY or level_distance(image, talker.position) < APART_M:
            return [talker]
        covariance = mirrored(mirrored(talker.covariance, self.normal).T, self.normal)
        score = talker.score / (1.0 + likely)
        behind = replace(talker, position=image, covariance=0.5 * (covariance + covariance.T), score=likely * score)
        return [replace(talker, score=score), behind]
