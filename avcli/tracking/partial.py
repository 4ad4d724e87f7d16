"""Detections that show a part of a place only: a direction (compact arrays, cameras) or a distance (time of flight).

A direction is compared with people in the plane that touches the sphere of directions at each person's expected
direction, so that there is neither a seam at 180 degrees nor a pole above the sensor. Both kinds are linearised over
each person's density by cubature points (statistical linear regression), which keeps what is not linear as noise: near
the sensor, and where a person's place is hardly known, a detection says little instead of something wrong. How high a
mouth or a body is, is not known but stays: its error repeats in each record and is not averaged away.

One such detection does not tell where somebody is. The people who may have caused it stand in cells along its ray or
its ring, as many in each as have not been detected there before. They become tentative people, and together a person
with a label as soon as nearly all of the probability lies at one place.

Source:
    A. F. Garcia-Fernandez, L. Svensson, M. R. Morelande and S. Sarkka, "Posterior linearization filter: principles and
    implementation using sigma points", IEEE TSP 63(20), 2015 (statistical linear regression);
    I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE TAC 54(6), 2009 (the points);
    N. Peach, "Bearings-only tracking using a set of range-parameterised extended Kalman filters", IEE Proceedings
    Control Theory and Applications 142(1), 1995 (cells along a ray).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from avcli.formats.records import Detections
from avcli.tracking import births, gaussian
from avcli.tracking.births import TENTATIVE, Birth
from avcli.tracking.densities import NEVER, Densities
from avcli.tracking.gaussian import COFACTOR, EYE2, LOG_2_PI
from avcli.tracking.model import Population
from avcli.tracking.scan import GATE, Scan
from avcli.tracking.settings import Sensor

WHOLE, DIRECTION, RANGE = 0, 1, 2
FINEST_RAD, FINEST_M = math.radians(0.1), 0.01  # no sensor of people is better
UNKNOWN = 1e4  # m², of what stands for a position: nothing is learnt from it
HOLD = 0.1  # s; somebody's height does not change: its error is taken for new so often, however many records there are
CELL, GROWTH = 0.5, 0.15  # m, least length of a cell along a ray; share of the distance by which cells grow
WIDEST = 0.7  # rad, of a cell across a ray
TILE = 0.4  # standard deviation of a Gaussian over its spacing: a row of them is flat
LEAST_SHARE = 0.01  # of a detection's probability, below which a place is given up
PLACED_SHARE, PLACED_SD, NEAR = 0.9, 0.7, 0.7  # share of it within NEAR m, known to that many m: a place
LIKE, ALIKE_SPEED, ALIKE_SIZE = (
    1.0,
    0.7,
    4.0,
)  # squared sds, m/s, ratio of variances: as near are tentative people merged
ROOT3 = math.sqrt(3.0)


@dataclass(frozen=True)
class Partial:
    """What J detections show.

    Attributes:
        what: (J,) WHOLE, DIRECTION or RANGE.
        origin: (J, 3) m, where the sensor is; z NaN: not known, as on the floor.
        direction: (J, 3) unit vectors; z NaN: on the floor. NaN but for directions.
        distance: (J,) m. NaN but for ranges.
        sd: (J,) rad or m.
    """

    what: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    distance: np.ndarray
    sd: np.ndarray

    def take(self, rows: Sequence[int] | np.ndarray) -> Partial:
        """Return some of the detections, in that order."""
        return Partial(*(array[rows] for array in vars(self).values()))

    def columns(self) -> list[int]:
        """Return the numbers of the detections that are not whole positions."""
        return np.flatnonzero(self.what).tolist()

    def whole_only(self, values: Sequence[float]) -> list[float]:
        """Return J values with 0 for the detections that are not whole positions."""
        return [value if what == WHOLE else 0.0 for value, what in zip(values, self.what.tolist(), strict=True)]

    def flat(self, j: int) -> bool:
        """Tell whether detection j is known on the floor alone: its origin or its direction has no z."""
        return bool(np.isnan(self.origin[j, 2]) or (self.what[j] == DIRECTION and np.isnan(self.direction[j, 2])))

    def dims(self, j: int) -> int:
        """Return how many numbers detection j shows: 2 for a direction in space."""
        return 2 if self.what[j] == DIRECTION and not self.flat(j) else 1

    def volume(self, j: int, population: Population) -> float:
        """Return the size of all that detection j could have been: radians, their square, or metres."""
        if self.what[j] == RANGE:
            return math.hypot(*(population.corners[1] - population.corners[0]), 1.0)
        return 2 * math.pi  # of a half-plane's turn, and of a hemisphere, too

    def plane(self, j: int, height: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return where detection j comes from and points to: origin (3,), direction (3,), the rise to `height` in m.

        On the floor (see `flat`) the direction is level and the rise 0.
        """
        origin, direction = self.origin[j].copy(), self.direction[j].copy()
        if self.flat(j):
            origin[2], direction[2] = height, 0.0
            length = math.hypot(direction[0], direction[1])
            direction = direction / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
        return origin, direction, float(height - origin[2])


def read(
    parts: Sequence[Detections], positions: np.ndarray, covariances: np.ndarray, sensor: Sensor, population: Population
) -> tuple[np.ndarray, np.ndarray, Partial | None]:
    """Return what the detections of a record show, with their positions and covariances filled in.

    A direction with a range is a position. Where a position is not observed, one in the middle of where the person may
    be stands for it, to be shown and sorted by.

    Args:
        parts: the detections, J together.
        positions: (J, 2) m, NaN where not given.
        covariances: (J, 2, 2) m².
        sensor: which sensor.
        population: where people can be.

    Returns:
        Positions (J, 2) m, covariances (J, 2, 2) m², and what detections show, None: all are positions.
    """
    keys = ("origins", "directions", "direction_sds", "ranges", "range_sds")
    origins, directions, turns, ranges, reaches = (np.concatenate([getattr(one, key) for one in parts]) for key in keys)
    turns = np.where(np.isnan(turns), sensor.direction_sd, turns)
    reaches = np.where(np.isnan(reaches), sensor.range_sd, reaches)
    turned, away = np.isfinite(directions[:, 0]), np.isfinite(ranges)
    positions, covariances = positions.copy(), covariances.copy()
    both = turned & away
    ray = np.nan_to_num(directions[both])
    outer = ray[:, :, None] * ray[:, None]
    across = ((turns * ranges)[both] ** 2)[:, None, None] * (np.eye(3) - outer)
    positions[both] = origins[both, :2] + ray[:, :2] * ranges[both, None]
    covariances[both] = (across + (reaches[both] ** 2)[:, None, None] * outer)[:, :2, :2] + FINEST_M**2 * EYE2
    what = np.where(both | ~(turned | away), WHOLE, np.where(turned, DIRECTION, RANGE))
    if not what.any():
        return positions, covariances, None
    sd = np.where(turned, np.maximum(turns, FINEST_RAD), np.maximum(reaches, FINEST_M))
    partial = Partial(what, origins, directions, ranges, sd)
    covariances[what != WHOLE] = UNKNOWN * EYE2
    return _guesses(partial, positions, population, sensor.height), covariances, partial


def _guesses(partial: Partial, z: np.ndarray, population: Population, height: float) -> np.ndarray:
    """Return positions (J, 2) m: z, and where it is not observed a place in the middle of where the person may be."""
    z = z.copy()
    for j in partial.columns():
        origin, direction, rise = partial.plane(j, height)
        if partial.what[j] == RANGE:
            toward = population.centre - origin[:2]
            far = max(math.hypot(*toward), 1e-9)
            z[j] = origin[:2] + toward / far * math.sqrt(max(partial.distance[j] ** 2 - rise**2, 0.0))
        else:
            begin, end = _stretch(origin[:2], direction[:2], population)
            crosses = begin < end and math.isfinite(begin + end)  # a line may miss the area
            z[j] = origin[:2] + direction[:2] * (max(begin + end, 0.0) / 2 if crosses else 0.0)
    return z


def in_order(partial: Partial, z: np.ndarray, noise: np.ndarray) -> list[int]:
    """Return the numbers of the detections in a defined order: by z, then by all they show; without repetitions."""
    shown = np.column_stack([*(np.nan_to_num(array) for array in vars(partial).values()), noise.reshape(-1, 4), z])
    order = np.lexsort((*shown.T[:-2], z[:, 1], z[:, 0]))
    same = (shown[order][1:] == shown[order][:-1]).all(1)
    return order[np.r_[True, ~same][: len(order)]].tolist()


# --- how people look from the sensor ----------------------------------------------------------------------------------


class View(NamedTuple):
    """How n densities look in J partial detections, linearised: residual - jacobian (position - centre) + noise.

    Attributes:
        number: detection -> its place in J.
        position: (n, M, 2) m, where each model has the point that the sensor detects.
        loose: (n, M) m², its variance beside that of the state.
        centre: (n, 2) m, of the mixture.
        residual: (J, n, 2) rad or m; the second is 0 where the detection has one dimension.
        jacobian: (J, n, 2, 2).
        noise: (J, n, 2, 2); the second variance is 1 where the detection has one dimension.
        dims: (J,) 1 or 2.
    """

    number: dict[int, int]
    position: np.ndarray
    loose: np.ndarray
    centre: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    noise: np.ndarray
    dims: np.ndarray


def view(partial: Partial, people: Densities, sensor: Sensor, hold: np.ndarray) -> View:
    """Linearise what partial detections show over each density.

    Args:
        partial: the detections.
        people: n densities.
        sensor: which sensor.
        hold: (n,) factors of the variance that the unknown height adds, see `HOLD`.
    """
    position, loose = gaussian.expected_detection(people.mean, people.cov, sensor.mouth_offset)
    loose = loose + sensor.floor**2
    weight = people.mode[..., None]
    centre = (weight * position).sum(1)
    away = (position - centre[:, None])[..., None]
    spread = (
        weight[..., None] * (people.cov[..., :2, :2] + loose[..., None, None] * EYE2 + away * away.swapaxes(2, 3))
    ).sum(1)
    # Along the columns of the symmetric root: who mirrors the floor or turns it by 90 degrees finds the same points.
    xx, xy, yy = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
    area = np.sqrt(np.maximum(xx * yy - xy**2, 1e-9 * (xx + yy)))
    root = (spread + area[:, None, None] * EYE2) / np.sqrt(xx + yy + 2 * area)[:, None, None]
    axes = np.zeros((len(root), 3, 3))
    axes[:, :2, :2], axes[:, 2, 2] = ROOT3 * root, ROOT3 * sensor.height_sd
    middle = np.column_stack([centre, np.full(len(centre), sensor.height)])
    points = np.concatenate([middle[:, None] + axes, middle[:, None] - axes], 1)  # (n, 6, 3)
    columns = partial.columns()
    seen = [_shown(partial, j, middle, points, sensor.height) for j in columns]
    residual = np.array([one[0] for one in seen]).reshape(len(columns), len(root), 2)
    shown = np.array([one[1] for one in seen]).reshape(len(columns), len(root), 6, 2)
    mean = shown.mean(2)
    slope = (shown[:, :, :3] - shown[:, :, 3:]) / (2 * ROOT3)  # (J, n, 3, 2): along each axis, one standard deviation
    outer = slope[..., None] * slope[..., None, :]
    away = (shown - mean[:, :, None])[..., None]
    bent = (away * away.swapaxes(-1, -2)).mean(2) - outer.sum(2)
    noise = bent + hold[:, None, None] * outer[:, :, 2]
    noise = (noise + noise.swapaxes(-1, -2)) / 2
    noise += (partial.sd[columns] ** 2)[:, None, None, None] * EYE2
    dims = np.array([partial.dims(j) for j in columns], int)
    noise[dims == 1, :, 1, 1], noise[dims == 1, :, 0, 1], noise[dims == 1, :, 1, 0] = 1.0, 0.0, 0.0
    jacobian = slope[:, :, :2].swapaxes(-1, -2) @ np.linalg.inv(root)
    number = {j: k for k, j in enumerate(columns)}
    return View(number, position, loose, centre, residual - mean, jacobian, noise, dims)


def _shown(
    partial: Partial, j: int, middle: np.ndarray, points: np.ndarray, height: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what detection j shows (n, 2), and what it would show of points (n, P, 2), about the middles (n, 3)."""
    origin, direction, _ = partial.plane(j, height)
    middle, points = middle - origin, points - origin
    if partial.flat(j):
        middle, points = middle * (1, 1, 0), points * (1, 1, 0)
    if partial.what[j] == RANGE:
        shown = np.linalg.norm(points, axis=2)
        flat = np.zeros((*shown.shape, 2))
        flat[..., 0] = shown
        return np.column_stack([np.full(len(middle), partial.distance[j]), np.zeros(len(middle))]), flat
    frame = _frames(middle)
    return _turns(direction, frame[:, None])[:, 0], _turns(points, frame[:, None])


def _frames(ahead: np.ndarray) -> np.ndarray:
    """Return frames (n, 3, 3) whose rows are: ahead, across on the level, and across both; (n, 3) of any length."""
    level = np.hypot(ahead[:, 0], ahead[:, 1])
    ahead = np.where((np.linalg.norm(ahead, axis=1) > 1e-9)[:, None], ahead, np.array([1.0, 0.0, 0.0]))
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    across = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
    across = np.where((level > 1e-9)[:, None], across, np.array([0.0, 1.0, 0.0]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([ahead, across, np.cross(ahead, across)], 1)


def _turns(vectors: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the angles (..., 2) rad from the first axis of frames (..., 3, 3) to vectors (..., 3) of any length."""
    along, right, up = np.moveaxis((frames @ vectors[..., None])[..., 0], -1, 0)
    side = np.hypot(right, up)
    angle = np.arctan2(side, along)
    scale = np.where(side > 1e-12, angle / np.maximum(side, 1e-12), 0.0)
    behind = (side <= 1e-12) & (along < 0)
    return np.stack([right * scale + math.pi * behind, up * scale], -1)


def likelihoods(seen: View, people: Densities) -> np.ndarray:
    """Return the likelihoods (n, M, J) of the partial detections, per rad, rad² or m; 0 outside the gate."""
    away = (seen.position - seen.centre[:, None])[None, ..., None]
    d = seen.residual[:, :, None] - (seen.jacobian[:, :, None] @ away)[..., 0]
    spread = people.cov[..., :2, :2] + seen.loose[..., None, None] * EYE2
    jacobian = seen.jacobian[:, :, None]
    s = jacobian @ spread @ jacobian.swapaxes(-1, -2) + seen.noise[:, :, None]
    s11, s12, s22 = s[..., 0, 0], s[..., 0, 1], s[..., 1, 1]
    det = np.maximum(s11 * s22 - s12 * s12, 1e-300)
    distance = (s22 * d[..., 0] ** 2 - 2 * s12 * d[..., 0] * d[..., 1] + s11 * d[..., 1] ** 2) / det
    log = -0.5 * (distance + np.log(det) + LOG_2_PI * seen.dims[:, None, None])
    return np.where(distance < GATE, np.exp(log), 0.0).transpose(1, 2, 0)


def with_likelihoods(
    gain_by_model: np.ndarray, seen: View, people: Densities, cells: Mapping[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the likelihoods of all detections, (n, J) and (n, M, J) by model, of those of whole positions alone.

    Args:
        gain_by_model: (n, M, J), changed in place.
        seen: how the densities look in the others.
        people: n densities.
        cells: rows of people who can have caused one detection alone, and which.
    """
    gain_by_model[:, :, [*seen.number]] = likelihoods(seen, people)
    mine = np.array([*cells.values()], int)[:, None] == np.arange(gain_by_model.shape[2])
    gain_by_model[[*cells]] *= mine[:, None]
    return (people.mode[:, None] @ gain_by_model)[:, 0], gain_by_model


def update(
    people: Densities, seen: View, pairs: Sequence[tuple[int, int]], likelihood: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Update densities by partial detections, in Joseph's form, as `gaussian.update` does.

    Args:
        people: k densities.
        seen: the view, from before the record.
        pairs: k of (row before, detection).
        likelihood: (k, M) of the detections in each model.

    Returns:
        mean, cov and mode after the update.
    """
    mean, cov, mode = people.mean, people.cov, people.mode
    rows, js = [row for row, _ in pairs], [seen.number[j] for _, j in pairs]
    jacobian, noise = seen.jacobian[js, rows][:, None], seen.noise[js, rows][:, None]
    away = (seen.position[rows] - seen.centre[rows][:, None])[..., None]
    d = seen.residual[js, rows][:, None, :, None] - jacobian @ away
    noise = noise + seen.loose[rows][..., None, None] * (jacobian @ jacobian.swapaxes(-1, -2))
    s = jacobian @ cov[..., :2, :2] @ jacobian.swapaxes(-1, -2) + noise
    det = s[..., 0, 0] * s[..., 1, 1] - s[..., 0, 1] * s[..., 1, 0]
    inverse = s[..., ::-1, ::-1] * COFACTOR / det[..., None, None]
    gain = cov[..., :, :2] @ jacobian.swapaxes(-1, -2) @ inverse  # (k, M, 4, 2)
    if mode.shape[1] > 1:
        mode = mode * likelihood
        mode = mode / np.maximum(np.add.reduce(mode, 1, keepdims=True), 1e-300) + 1e-12
    mean = mean + (gain @ d)[..., 0]
    keep = cov - gain @ (jacobian @ cov[..., :2, :])
    cov = keep + (gain @ noise - keep[..., :2] @ jacobian.swapaxes(-1, -2)) @ gain.swapaxes(-1, -2)
    return mean, (cov + cov.swapaxes(-1, -2)) / 2, mode


# --- people who may have caused a detection and were never detected before --------------------------------------------


def cells(
    partial: Partial,
    population: Population,
    sensor: Sensor,
    number_at: Callable[[np.ndarray], np.ndarray],
    detectable_at: Callable[[np.ndarray], np.ndarray],
) -> tuple[Densities, list[int]]:
    """Return densities of people never detected before, where partial detections may have found them.

    Args:
        partial: the detections.
        population: how people move, and where they can be.
        sensor: which sensor.
        number_at: function of positions (k, 2) m to the expected number (k,) of such people per m².
        detectable_at: function of positions to the probabilities (k, S) that each sensor can detect one.

    Returns:
        The densities, whose existence is the expected number of people in each, and the detection that each is for.
    """
    places: list[tuple[float, float, float, float, float, float]] = []  # x, y, unit along, sds along and across
    owners: list[int] = []
    for j in partial.columns():
        origin, direction, rise = partial.plane(j, sensor.height)
        found = (
            _along_ring(origin, partial.distance[j], partial.sd[j], rise, sensor.height_sd)
            if partial.what[j] == RANGE
            else _along_ray(origin, direction, partial.sd[j], rise, population)
        )
        places += found
        owners += [j] * len(found)
    at = np.array(places, float).reshape(-1, 6)
    low, high = population.corners
    inside = ((at[:, :2] >= low) & (at[:, :2] <= high)).all(1)
    at, owners = at[inside], [j for j, kept in zip(owners, inside.tolist(), strict=True) if kept]
    n = len(at)
    along, sds = at[:, 2:4], at[:, 4:]
    axes = np.stack([along, np.column_stack([-along[:, 1], along[:, 0]])], 2) * sds[:, None]
    mean, cov, mode = gaussian.begin(at[:, :2], axes @ axes.swapaxes(1, 2), population.motion)
    number = number_at(at[:, :2]) * 2 * math.pi * sds[:, 0] * sds[:, 1]
    able = detectable_at(at[:, :2])
    found_people = Densities(
        mean=mean,
        cov=cov,
        mode=mode,
        existence=number,
        detectable=able,
        lean=np.zeros(able.shape),
        seen=np.full(able.shape, NEVER),
        place=at[:, :2].copy(),
        hits=np.zeros(able.shape),
        told=np.zeros(n),
        counted=np.zeros(able.shape),
        doubt=np.zeros(able.shape),
        reach=births.uncertainty(cov[:, 0]),
        common=np.zeros((n, 2, 2)),
        label=[-1] * n,
        node=[None] * n,
    )
    return found_people, owners


def _stretch(origin: np.ndarray, direction: np.ndarray, population: Population) -> tuple[float, float]:
    """Return between which multiples of a direction (2,) from an origin (2,) the line is inside the area."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (population.corners - origin) / direction
    ends = np.where(np.isnan(ends), [[-math.inf], [math.inf]], ends)
    return float(ends.min(0).max()), float(ends.max(0).min())


def _along_ray(
    origin: np.ndarray, direction: np.ndarray, sd: float, rise: float, population: Population
) -> list[tuple[float, float, float, float, float, float]]:
    level = math.hypot(direction[0], direction[1])
    ahead = math.atan2(direction[1], direction[0]) if level > 1e-9 else 0.0
    whole = min(6 * sd / max(level, 0.1), 2 * math.pi)  # rad on the floor
    tiles = 2 * math.ceil((whole / WIDEST - 1) / 2) + 1
    around = 3 * sd * abs(rise)  # m, of a person below the sensor
    found: list[tuple[float, float, float, float, float, float]] = []
    for k in range(tiles):
        angle = ahead + (k - (tiles - 1) / 2) * whole / tiles
        x, y = math.cos(angle), math.sin(angle)
        begin, end = _stretch(origin[:2], np.array([x, y]), population)
        at = max(begin, -around)
        while at < end - 1e-6 and len(found) < 200:
            length = min(max(CELL, GROWTH * at), end - at)
            middle = at + length / 2
            across = TILE * max(whole / tiles * abs(middle), 2 * around / tiles, 0.05)
            found.append((origin[0] + middle * x, origin[1] + middle * y, x, y, TILE * length, across))
            at += length
    return found


def _along_ring(
    origin: np.ndarray, distance: float, sd: float, rise: float, height_sd: float
) -> list[tuple[float, float, float, float, float, float]]:
    radius = math.sqrt(max(distance**2 - rise**2, 0.0))
    thick = math.hypot(sd * distance, rise * height_sd) / max(radius, distance / 4, 0.1)
    if radius < max(0.3, 2 * thick):
        size = max(radius + thick, 0.3)
        return [(origin[0], origin[1], 1.0, 0.0, size, size)]
    count = max(math.ceil(2 * math.pi * radius / max(CELL, radius / 6)), 8)
    arc = 2 * math.pi * radius / count
    turns = [(math.cos(angle), math.sin(angle)) for angle in np.arange(count) * 2 * math.pi / count]
    return [(origin[0] + radius * c, origin[1] + radius * s, c, s, TILE * 6 * thick, TILE * arc) for c, s in turns]


def other_detections(
    scan: Scan, unclaimed: Sequence[float], real: Sequence[float], body: float
) -> tuple[list[float], list[float]]:
    """Compute what the other detections of a record say of each, as `births.other_detections`, kind by kind.

    Behind one another there is room for several people in one direction, so that there is always room beside.
    """
    room, twice, partial = [1.0] * len(scan.z), [0.0] * len(scan.z), scan.partial
    if partial is None:
        raise ValueError("the record has positions alone")
    whole = np.flatnonzero(partial.what == WHOLE).tolist()
    if len(whole) > 1:
        alone = replace(scan, z=scan.z[whole], noise=scan.noise[whole])
        found = births.other_detections(alone, [unclaimed[j] for j in whole], [real[j] for j in whole], body)
        for j, its_room, its_twice in zip(whole, *found, strict=True):
            room[j], twice[j] = its_room, its_twice
    columns = partial.columns()
    for k, one in enumerate(columns):
        for other in columns[:k]:
            if partial.what[one] != partial.what[other]:
                continue
            dims = min(partial.dims(one), partial.dims(other))
            apart = partial.distance[one] - partial.distance[other]
            if partial.what[one] == DIRECTION:
                a, b = (partial.plane(j, 0.0)[1][: dims + 1] for j in (one, other))
                apart = math.acos(
                    min(max(float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-9), -1.0), 1.0)
                )
            width = 2 * (partial.sd[one] ** 2 + partial.sd[other] ** 2)
            again = scan.again * math.exp(-apart * apart / width) / (math.pi * width) ** (dims / 2)
            for j, claimant in ((one, other), (other, one)):
                claimed = min((1 - unclaimed[claimant]) / max(unclaimed[j], 1e-9), 1.0)
                if j == one:
                    claimed = max(claimed, unclaimed[claimant] * real[claimant])
                twice[j] += again * claimed
    return room, twice


def revealed(
    partial: Partial,
    unclaimed: Sequence[float],
    existence: Sequence[float],
    tentative: Sequence[int],
    from_tentative: np.ndarray,
) -> list[Birth]:
    """Return the people whom partial detections may reveal: one for each place that each detection may be of.

    Args:
        partial: the detections.
        unclaimed, existence, tentative, from_tentative: as `births.births` has them.
    """
    found = []
    for j in partial.columns():
        total = float(from_tentative[:, j].sum())
        number = unclaimed[j] * existence[j]
        if number <= TENTATIVE or not total > 0:
            continue
        shares = from_tentative[:, j] / total
        for at in np.flatnonzero(shares > LEAST_SHARE).tolist():
            share = float(shares[at])
            if number * share > TENTATIVE:
                found.append(Birth(j, tentative[at], number * share, existence[j] * share))
    return found


def gathered(
    partial: Partial, people: Densities, found: Sequence[Birth], row_of: dict[tuple[int, int], int]
) -> list[Birth]:
    """Merge the places of each partial detection that are one place, and tell whether it is known.

    Args:
        partial: the detections.
        people: densities after the record, changed in place.
        found: the births of the record.
        row_of: (row before, detection) -> row after.

    Returns:
        The births, in the same order; those of partial detections with `placed`.
    """
    kept, places = [], dict[int, list[Birth]]()
    for birth in found:
        if partial.what[birth.detection] == WHOLE:
            kept.append(birth)
        else:
            places.setdefault(birth.detection, []).append(birth)
    for j, some in places.items():
        some.sort(key=lambda birth: -birth.number)
        total = math.fsum(birth.number for birth in some)
        rows = [row_of[birth.source, j] for birth in some]
        centres = people.centres(rows)[:, :2]
        near = np.hypot(*(centres - centres[0]).T) < NEAR
        at = [k for k in range(len(some)) if near[k]]
        number = math.fsum(some[k].number for k in at)
        if number < PLACED_SHARE * total:
            kept += [birth._replace(placed=False) for birth in some]
            continue
        if len(at) > 1:
            people.merge([[rows[k] for k in at]], [[some[k].number for k in at]])
        _, cov = gaussian.moments(people.mean[rows[:1]], people.cov[rows[:1]], people.mode[rows[:1]])
        placed = float(np.linalg.eigvalsh(cov[0, :2, :2])[1]) < PLACED_SD**2
        existence = math.fsum(some[k].existence for k in at)
        kept.append(some[0]._replace(number=number, existence=min(existence, 1.0), placed=placed))
        kept += [birth._replace(placed=False) for k, birth in enumerate(some) if not near[k]]
    return kept


def merged(people: Densities, tentative: Sequence[int]) -> list[int]:
    """Merge tentative people without a label who are nearly the same, in `people`; returns the rows that are left."""
    rows = sorted((row for row in tentative if people.label[row] < 0), key=lambda row: (-people.existence[row], row))
    left = [row for row in tentative if people.label[row] >= 0]
    if len(rows) < 2:
        return list(tentative)
    mean, cov = gaussian.moments(people.mean[rows], people.cov[rows], people.mode[rows])
    s11, s12, s22 = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    det = np.maximum(s11 * s22 - s12 * s12, 1e-12)
    free = np.ones(len(rows), bool)
    for k, row in enumerate(rows):
        if not free[k]:
            continue
        d = mean - mean[k]
        distance = (s22[k] * d[:, 0] ** 2 - 2 * s12[k] * d[:, 0] * d[:, 1] + s11[k] * d[:, 1] ** 2) / det[k]
        size = det / det[k]
        like = free & (distance < LIKE) & (np.hypot(d[:, 2], d[:, 3]) < ALIKE_SPEED)
        like &= (size < ALIKE_SIZE) & (size > 1 / ALIKE_SIZE)
        like[k] = True
        free &= ~like
        group = [rows[i] for i in np.flatnonzero(like).tolist()]
        if len(group) > 1:
            group = [row, *(other for other in group if other != row)]
            numbers = people.existence.take(group).tolist()
            people.merge([group], [numbers])
            people.existence[row] = math.fsum(numbers)
        left.append(row)
    return sorted(left)
