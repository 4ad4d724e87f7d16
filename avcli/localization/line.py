"""Microphones on one line: all places that lie on one circle about the line are heard alike.

What is far against the length of the line is heard as a direction, and is somewhere on a cone about the line. What is
nearer has a place along the line and a distance from it. Either way the room tells which parts of the circle may be:
mouths are at some heights, and behind a wall there is nobody.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from avcli.formats.features import Feature
from avcli.localization.array import Array, Talker
from avcli.localization.uncertainty import logistic

HARDLY = 0.02
"""The share of the places that may be on a side, below which nobody is told there."""

ON_LINE_M = 0.01
"""m: how far from one line, as a standard deviation, microphones that are far apart may be and be heard as on it."""

APART_M, BEYOND_M = 0.5, 0.1
"""m: two are told where the places on both sides of a line are so far apart; and how far outside the volume a place may
seem to be."""


@dataclass(frozen=True)
class Line:
    """A line on which microphones are.

    Attributes:
        axis: (3,) unit vector.
        level: (3,) unit vector across it, level. The direction on that side stands for the others of its cone.
    """

    axis: np.ndarray
    level: np.ndarray

    def angle(self, rays: np.ndarray) -> np.ndarray:
        """Return the angle in rad between rays (..., 3) and the axis."""
        return np.arccos(np.clip(rays @ self.axis, -1.0, 1.0))

    def across(self, turns: np.ndarray) -> np.ndarray:
        """Return the unit vectors (t, 3) across the line at turns (t,) rad about it from `level`."""
        return np.cos(turns)[:, None] * self.level + np.sin(turns)[:, None] * np.cross(self.axis, self.level)

    def cones(self, angles: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """Return the directions (a t, 3) at angles (a,) to the axis, turned about it by turns (t,) from `level`."""
        along = np.cos(angles)[:, None, None] * self.axis
        return (along + np.sin(angles)[:, None, None] * self.across(turns)).reshape(-1, 3)

    def standing_for(self, ray: np.ndarray) -> np.ndarray:
        """Return the direction (3,) that stands for one's cone."""
        return self.cones(self.angle(ray)[None], np.zeros(1))[0]

    def curved(self, ray: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Return a curvature (2, 2) 1/rad² as it is about the direction that stands for a ray: along the cone none."""
        angle = self.angle(ray)
        steeper = tangents(self.standing_for(ray)) @ (np.cos(angle) * self.level - np.sin(angle) * self.axis)
        return float(np.linalg.eigvalsh(curvature)[-1]) * np.outer(steeper, steeper)


def line_of(microphones: np.ndarray, straight: float = 0.05) -> Line | None:
    """Return the line that microphones (m, 3) m are on; None where they are not.

    Args:
        microphones: (m, 3) m.
        straight: how far they may be from it, over how far along it, both as standard deviations.
    """
    centred = microphones - microphones.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred)
    if spread[1] > straight * spread[0]:
        return None
    level = np.cross(axes[0], [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(level))
    return Line(axes[0], level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0]))


@cache
def _further() -> Mapping[str, float]:
    weights: Mapping[str, float] = json.loads((Path(__file__).parent / "line.json").read_bytes())["further"]
    return weights


def believed(score: float) -> float:
    """Return the score of a further talker beside a line, where echoes cannot be taken away, from that of any array."""
    chance, weights = min(max(score, 1e-6), 1.0 - 1e-6), _further()
    return logistic(weights["one"] + weights["score"] * float(np.log(chance / (1.0 - chance))))


@dataclass(frozen=True)
class HalfPlane:
    """The half-plane on one side of a line of microphones, which stands for all that are turned about the line.

    Its coordinates, in m from the middle of the array, are along the line, away from it, and 0.

    Attributes:
        line: of the microphones.
        centre: (3,) m, the middle of the array in the room.
        low, high: (3,) m, corners of the volume of the room in which talkers may be.
    """

    line: Line
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def beside(cls, array: Array, low: np.ndarray, high: np.ndarray) -> "HalfPlane | None":
        """Return that of an array in a volume with corners (3,) m; None where the microphones are not on one line."""
        line = line_of(array.microphones, ON_LINE_M / max(float(array.spread[0]), ON_LINE_M))
        return None if line is None else cls(line, array.microphones.mean(axis=0), low, high)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return the coordinates (..., 3) m of points (..., 3) m of the room."""
        away = points - self.centre
        along = away @ self.line.axis
        distance = np.linalg.norm(away - along[..., None] * self.line.axis, axis=-1)
        return np.stack([along, distance, np.zeros_like(along)], axis=-1)

    def searched(self, array: Array) -> tuple[Array, np.ndarray, np.ndarray]:
        """Return an array in these coordinates, with the corners (3,) m of what the volume is in them."""
        microphones = self.flat(array.microphones) * [1.0, 0.0, 0.0]
        ends = np.stack([self.low, self.high])
        corners = self.flat(np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3))
        low, high = corners.min(axis=0), corners.max(axis=0)
        along = self.centre + np.linspace(low[0], high[0], 2000)[:, None] * self.line.axis
        low[1] = np.linalg.norm(along - np.clip(along, self.low, self.high), axis=1).min()
        return replace(array, microphones=microphones), low, high

    def places(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places of the room that may be heard at points (n, 3) m of the half-plane.

        Returns:
            places (n, t, 3) m, and weights (n, t): all places of the volume are equally likely. Where none are in it,
            the nearest ones are as likely as the errors of BEYOND_M make them.
        """
        along = self.centre + points[:, :1] * self.line.axis
        places = along[:, None] + points[:, None, 1:2] * self.line.across(_TURNS)
        outside = ((places - np.clip(places, self.low, self.high)) ** 2).sum(axis=-1)
        return places, np.exp(-0.5 * (outside - outside.min()) / BEYOND_M**2)

    def in_room(self, points: np.ndarray) -> np.ndarray:
        """Return the mean place (n, 3) m of the room that may be heard at each of points (n, 3) m."""
        each = [self.places(point[None]) for point in points]
        return np.array([weights[0] @ places[0] / weights.sum() for places, weights in each]).reshape(-1, 3)

    def fold(self, point: np.ndarray) -> np.ndarray:
        """Return the point (3,) m that stands for all that are heard like one of the half-plane: itself."""
        return point

    def told(
        self, talkers: Sequence[Talker], features: Mapping[str, Feature]
    ) -> tuple[list[Talker], dict[str, Feature]]:
        """Return talkers in the half-plane, and their features, as they are told in the room: see `sides`."""
        return repeated([self.sides(talker) for talker in talkers], features)

    def sides(self, talker: Talker) -> list[Talker]:
        """Return a talker in the half-plane as one in the room, or as two where both sides of the line may be."""
        variances, axes = np.linalg.eigh(talker.covariance[:2, :2])
        offsets = np.sqrt(np.maximum(variances, 0.0)) * _STEPS @ axes.T
        points = talker.position + np.column_stack([offsets, np.zeros(len(offsets))])
        points[:, 1] = np.abs(points[:, 1])
        places, weights = self.places(points)
        weights = weights * np.exp(-0.5 * (_STEPS**2).sum(axis=1))[:, None]
        weights = weights / weights.sum()
        aside = points[:, 1:2] * np.cos(_TURNS)
        sides = [aside > 0.0, aside <= 0.0]
        if weights[np.abs(aside) < 0.5 * APART_M].sum() > HARDLY:
            sides = [np.ones_like(weights, bool)]
        return [_told(talker, places[side], weights[side]) for side in sides if weights[side].sum() > HARDLY]


def repeated(
    sides: Sequence[Sequence[Talker]], features: Mapping[str, Feature]
) -> tuple[list[Talker], dict[str, Feature]]:
    """Return each talker's sides, one after another, and features with a row for each of them."""
    rows = [k for k, some in enumerate(sides) for _ in some]
    return [one for some in sides for one in some], {name: each.take(rows) for name, each in features.items()}


def _told(talker: Talker, places: np.ndarray, weights: np.ndarray) -> Talker:
    """Return a talker who is at places (n, 3) m with weights (n,), of which the sum says how probably."""
    share = weights.sum()
    position = weights @ places / share
    away = places - position
    covariance = (away * (weights / share)[:, None]).T @ away + 0.05**2 * np.eye(3)
    covariance = 0.5 * (covariance + covariance.T)
    return replace(talker, position=position, covariance=covariance, score=talker.score * float(share))


def tangents(ray: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) across a ray (3,), the first level, the second upward as far as may be."""
    level = np.array([-ray[1], ray[0], 0.0])
    length = float(np.linalg.norm(level))
    level = level / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.stack([level, np.cross(ray, level)])


_TURNS = 2.0 * np.pi * (np.arange(120) + 0.5) / 120
_STEPS = np.array([[x, y] for x in np.linspace(-2.0, 2.0, 5) for y in np.linspace(-2.0, 2.0, 5)])
"""rad about a line, and standard deviations from a place, at which some stand for all."""
