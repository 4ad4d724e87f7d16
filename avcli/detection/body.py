"""The position of a person's axis, from the part of the body that a ceiling camera sees."""

from dataclasses import dataclass, replace

import numpy as np

from avcli.detection.fitted import AXIS, AxisLaw
from avcli.detection.view import View

FLOOR_M = 0.25
"""m; lower points may be floor, shadow or a foot far in front of the body."""

MID_BODY_M = 0.90
"""m; height of the middle of an adult: z of a position, since depth does not tell a height on the axis."""

REACH_M = 0.45
"""m; points farther from the axis than an elbow are outliers or another person."""

_FAR_M = 10.0
"""m; a ray that is hardly known says no less than this."""

_RADII = [0.7, 0.85, 1.0, 1.1, 1.25, 1.37, 1.46], [0.095, 0.13, 0.145, 0.145, 0.13, 0.12, 0.07]
"""Heights, m, and radii, m, of a body: 1.27 times the mean distance of its visible surface from the axis."""

_TOP_M, _SHOULDER_M = 1.74, 1.44
_DISCS = ((1.62, 0.09), (_SHOULDER_M, 0.19))  # heights and radii, m, of head and shoulders, which hide the rest


@dataclass(frozen=True)
class Surface:
    """What a picture shows of one person: n samples.

    Attributes:
        rows, columns: (n,) of the full picture, px.
        heights: (n,) m above the floor.
        areas: (n,) m² of the body's surface that each stands for.
    """

    rows: np.ndarray
    columns: np.ndarray
    heights: np.ndarray
    areas: np.ndarray


@dataclass(frozen=True)
class Person:
    """A person that was found.

    Attributes:
        position: (3,) m in the room, a point on the body's axis.
        covariance: (3, 3) m².
        score: probability from 0 to 1 that it is a person.
        bbox_px: (4,) [x0, y0, x1, y1] px in the full picture.
        height: m, None where the top of the head is not seen.
        method: "depth" or "monocular": what the position was measured by.
        visible: visible fraction of the body, None where it is not known.
        surface: where the picture shows the person, None where only the position and the height tell it.
        looks: (2, d) what the person wears and its standard deviations, see avcli.detection.looks; None: not described.
        explained: whether some body explains the box that the position comes from, see avcli.detection.monocular.
        turned_px: (5,) [x, y, width, height, turn in degrees], the box turned as the person stands; None: not known.
    """

    position: np.ndarray
    covariance: np.ndarray
    score: float
    bbox_px: np.ndarray
    height: float | None
    method: str
    visible: float | None = None
    surface: Surface | None = None
    looks: np.ndarray | None = None
    explained: bool = True
    turned_px: np.ndarray | None = None


def boxes_of(people: list[Person]) -> np.ndarray:
    """The boxes of people, (n, 4) px."""
    return np.array([person.bbox_px for person in people]).reshape(-1, 4)


def _standard_body() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (m, 3), outward normals (m, 3) and areas (m,) of a standing adult, averaged over all headings.

    Rings about the axis with the radii of the parts that people turn towards a camera, and the tops of head and
    shoulders.
    """
    points, normals, areas = [], [], []
    azimuth = 2 * np.pi * np.arange(16) / 16
    ring = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(16)], axis=1)
    for z in np.arange(0.30, 1.70, 0.10):
        radius = np.interp(z, *_RADII)
        points.append(radius * ring + [0, 0, z])
        normals.append(ring)
        areas.append(np.full(16, 2 * np.pi * radius * 0.10 / 16))
    for z, inner, outer in ((_TOP_M, 0.0, 0.08), (_SHOULDER_M, 0.08, 0.19)):
        radius = np.sqrt((inner**2 + outer**2) / 2)
        points.append(radius * ring + [0, 0, z])
        normals.append(np.tile([0.0, 0.0, 1.0], (16, 1)))
        areas.append(np.full(16, np.pi * (outer**2 - inner**2) / 16))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(areas)


_POINTS, _NORMALS, _AREAS = _standard_body()


def _trust(z: np.ndarray) -> np.ndarray:
    """Weights of body parts at heights z (m) in finding the axis: legs swing, hips and above do not."""
    return np.interp(z, [0.45, 0.75, 1.0, 1.4], [0.15, 0.3, 1.0, 1.5])


def locate(
    points: np.ndarray, surface: np.ndarray, view: View, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Find a person's axis from points on the visible surface of the body.

    The mean of the visible points does not lie on the axis, since the camera sees only the side that faces it. The same
    mean of a standard body at that position gives the correction. Parts outside the picture or behind something nearer
    are left out of it.

    Args:
        points: (n, 3) m in the room.
        surface: (n,) visible surface that each stands for, m².
        view: the camera.
        depth: (h, w) m, radial depth at the view's samples; 0 where there is none.

    Returns:
        The axis's (x, y), m; its covariance (2, 2), m²; and the visible fraction of the body. None if no point is
        higher than the floor.
    """
    raised = points[:, 2] > FLOOR_M
    if not raised.any():
        return None
    points, weights = points[raised], surface[raised] * _trust(points[raised, 2])
    centre = np.array([_weighted_median(points[:, axis], weights) for axis in (0, 1)])
    for _ in range(4):
        near = np.linalg.norm(points[:, :2] - centre, axis=1) < REACH_M
        if not near.any():
            break
        observed = np.average(points[near, :2], axis=0, weights=weights[near])
        offset, fraction = _visible_offset(centre, points[near, 2].max(), view, depth)
        centre = observed - offset
    return centre, axis_covariance(centre - view.origin[:2], fraction), fraction


def standing(centre: np.ndarray, height: float, view: View) -> Surface:
    """Where the picture shows a standing body of a given height, m, whose axis is at centre (2,), m on the floor.

    Nothing else is taken to hide it; points outside the picture are left out.
    """
    body = _POINTS * [1.0, 1.0, height / _TOP_M] + np.append(centre, 0.0)
    facing = _facing(body, centre, view)
    pixels = view.project(body)
    shown = (facing > 0) & view.inside(pixels)
    columns, rows = np.rint(pixels[shown]).astype(int).T
    return Surface(rows, columns, body[shown, 2], facing[shown])


def _facing(body: np.ndarray, centre: np.ndarray, view: View) -> np.ndarray:
    """Area (m,), m², of a standard body at `centre` that each of its points (m, 3) turns to the camera, 0 if hidden."""
    rays = body - view.origin
    distance = np.linalg.norm(rays, axis=1)
    facing = np.maximum(-(rays * _NORMALS).sum(axis=1) / distance, 0) * _AREAS
    for height, radius in _DISCS:
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = view.origin[:2] + rays[:, :2] * ((view.origin[2] - height) / -rays[:, 2:])
        facing[(_POINTS[:, 2] < height - 0.02) & (np.linalg.norm(crossing - centre, axis=1) < radius)] = 0.0
    return facing


def axis_covariance(away: np.ndarray, fraction: float, law: AxisLaw = AXIS) -> np.ndarray:
    """Covariance (2, 2), m², of the axis (x, y) of a body that a depth picture shows.

    Args:
        away: (2,) from the camera to the axis, on the floor.
        fraction: visible fraction of the body.
        law: the fitted standard deviations.
    """
    direction = away / max(float(np.linalg.norm(away)), 1e-9)
    hidden = (1 - fraction) ** 2
    radial, tangential = law.radial_m**2 + law.hidden_m**2 * hidden, law.tangential_m**2 + law.hidden_m**2 * hidden
    return tangential * np.eye(2) + (radial - tangential) * np.outer(direction, direction)


def beyond_trust(person: Person, view: View) -> Person:
    """Widen a position's covariance by what is not known of the lens where the person stands, see View.direction_sd.

    A depth picture fixes the distance; without it the ray's error grows to where it meets the floor.
    """
    sd = float(view.direction_sd(person.position[None])[0])
    if sd == 0:
        return person
    away = person.position - view.origin
    distance = float(np.linalg.norm(away))
    across = min(distance * sd, _FAR_M)
    along = across
    if person.method != "depth":
        along = min(across * distance / max(abs(float(away[2])), 0.1), _FAR_M)
    outward = away[:2] / max(float(np.linalg.norm(away[:2])), 1e-9)
    covariance = person.covariance.copy()
    covariance[:2, :2] += across**2 * np.eye(2) + (along**2 - across**2) * np.outer(outward, outward)
    return replace(person, covariance=covariance)


def _visible_offset(centre: np.ndarray, top: float, view: View, depth: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean offset (x, y), m, from the axis of the visible part of a standard body, and the visible fraction of it."""
    body = _POINTS + np.append(centre, 0.0)
    distance = np.linalg.norm(body - view.origin, axis=1)
    facing = _facing(body, centre, view) * _trust(_POINTS[:, 2])
    total = facing.sum()  # of a whole adult: legs alone, at the picture's border, are a small fraction of one
    facing[_POINTS[:, 2] > max(top, 0.5) + 0.05] = 0.0
    pixels = view.project(body)
    inside = view.inside(pixels)
    samples = view.sample_indices(pixels[inside])
    seen = np.zeros(len(body), bool)
    found = depth[samples[:, 1], samples[:, 0]]
    seen[inside] = (found == 0) | (found > distance[inside] - REACH_M)
    facing[~seen] = 0.0
    if not facing.sum() > 0:
        return np.zeros(2), 0.0
    return facing @ _POINTS[:, :2] / facing.sum(), float(facing.sum() / total)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(cumulative, cumulative[-1] / 2)]])
