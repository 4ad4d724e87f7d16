"""Directions from arrays that are small against the range: bearing, elevation and inverse range.

Sound from 2 m reaches an array of 20 cm almost as a plane wave: the response hardly changes along a ray, and a search
in metres, whose cells are larger than the array, finds nothing. Here the response is taken on rays from the middle of
the array instead, at few inverse ranges, and what is not observed is said: a direction with its uncertainty, and a
position whose covariance reaches along the ray as far as the room lets it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from avcli.localization import correlation
from avcli.localization.array import Array, Ray, Talker
from avcli.localization.masks import Masks
from avcli.localization.memory import Memory, Trace, level_distance
from avcli.localization.noise import NoiseLaw
from avcli.localization.settings import SteeredSettings
from avcli.localization.srp import interpolated
from avcli.localization.windows import Heard

TIMED_M = 0.005
"""m: the error of an arrival's path that says whether an array observes ranges."""

RANGED = 0.25
"""The share of the range below which the error of a range is told, in the median place of the volume."""

NEAREST_M, SPACING, DEFOCUS_M = 0.4, np.radians(2.5), 0.01
"""m and rad: the least range, how far the rays are apart, and by how much path they may be out of focus in range."""

PLACED_M = 0.001
"""m: how well the places of the microphones are known."""

APART = np.radians(25.0)
"""rad: the least angle between two talkers."""

AWAY_M = 2.0
"""m: where along its ray a direction is remembered."""


def observes_ranges(array: Array, low: np.ndarray, high: np.ndarray) -> bool:
    """Tell whether an array is large enough for the ranges in a volume.

    The Cramér-Rao bound of a place along the ray from the middle of the array, with independent errors of TIMED_M in
    the paths and an unknown time, over the range; the median over the volume decides.

    Args:
        array: the microphones.
        low, high: (3,) m, corners of the volume.
    """
    share = [np.linspace(a, b, 7)[1::2] for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*share, indexing="ij"), axis=-1).reshape(-1, 3)
    centre = array.microphones.mean(axis=0)
    told = []
    for place in places:
        away = place - array.microphones
        units = away / np.maximum(np.linalg.norm(away, axis=1), 1e-6)[:, None]
        units = units - units.mean(axis=0)
        ray = (place - centre) / max(np.linalg.norm(place - centre), 1e-6)
        # Height is taken for known to 0.3 m, so that a plane's own blindness across it does not count.
        bound = np.linalg.inv(units.T @ units / TIMED_M**2 + np.diag([1e-4, 1e-4, 0.3**-2.0]))
        told.append(np.sqrt(ray @ bound @ ray) / max(np.linalg.norm(place - centre), 1e-6))
    return float(np.median(told)) < RANGED


def band_of(settings: SteeredSettings, array: Array) -> tuple[float, float]:
    """Return the band in Hz that tells directions: from where the array is a sixth of a wavelength wide."""
    low, high = settings.band
    first, second = correlation.pairs(len(array.microphones))
    width = np.linalg.norm(array.microphones[first] - array.microphones[second], axis=1).max()
    return min(max(low, array.speed_of_sound / (6.0 * max(width, 1e-3))), 0.25 * high), high


@dataclass(frozen=True)
class DirectionLaw:
    """What was fitted: see `fitted_law`.

    Attributes:
        first, further: weights of the logit of the probability that a direction is right: a constant, and of the
            logarithms of the response over the largest of noise and of the agreement, and of what was there before.
        spread: weights of the logarithm of a factor on the standard deviation that the curvature of the response gives:
            a constant ("one") and the logarithm of the agreement.
        sharpness: logarithm of a range's likelihood over its response, in standard deviations of a GCC of noise.
    """

    first: Mapping[str, float]
    further: Mapping[str, float]
    spread: Mapping[str, float]
    sharpness: float

    def logit(self, terms: Mapping[str, float], *, first: bool) -> float:
        """Return the logit of the probability that a direction is right."""
        return sum(weight * terms[name] for name, weight in (self.first if first else self.further).items())


@cache
def fitted_law() -> DirectionLaw:
    """Return the law that directions.json holds."""
    return DirectionLaw(**json.loads((Path(__file__).parent / "directions.json").read_bytes())["law"])


class RaySearch:
    """The tables of one compact array in its room.

    Args:
        array: the microphones.
        low, high: (3,) m, corners of the volume in which talkers may be.
        steps_per_metre: lag steps per metre of range difference.

    Attributes:
        microphones, first, second, half_lags: as of a SteeredResponse.
        centre: (3,) m.
        size: m, root mean square of the microphones' distances from it.
        rays: (n, 3) unit vectors that meet the volume.
        reach: (n, 2) m, where they enter and leave it.

    Raises:
        ValueError: no ray meets the volume.
    """

    def __init__(self, array: Array, low: np.ndarray, high: np.ndarray, steps_per_metre: float):
        self.microphones, self.low, self.high = array.microphones, np.asarray(low), np.asarray(high)
        self.first, self.second = correlation.pairs(len(self.microphones))
        self.steps_per_metre = steps_per_metre
        baseline = np.linalg.norm(self.microphones[self.first] - self.microphones[self.second], axis=1)
        self.half_lags = int(np.ceil(baseline.max() * steps_per_metre)) + 4
        self.centre = self.microphones.mean(axis=0)
        self.size = float(np.sqrt(np.mean(np.sum((self.microphones - self.centre) ** 2, axis=1))))
        rays = _sphere(SPACING)
        reach = self.stretch(rays)
        kept = reach[:, 1] > reach[:, 0] + 0.05
        if not kept.any():
            raise ValueError("no direction from the microphones meets the room at the heights of mouths")
        self.rays, self.reach = rays[kept], reach[kept]
        half = 0.5 * baseline.max()
        count = max(1, int(np.ceil(0.5 * half**2 * (1.0 / NEAREST_M - 1.0 / self.reach[:, 1].max()) / DEFOCUS_M)))
        share = (np.arange(count) + 0.5) / count
        inverse = 1.0 / self.reach[:, :1] + share * (1.0 / self.reach[:, 1:] - 1.0 / self.reach[:, :1])
        self.points = (self.centre + self.rays[:, None] / inverse[:, :, None]).reshape(-1, 3)
        self.depths = count
        rows = np.arange(len(self.first))[:, None] * (2 * self.half_lags + 1)
        self.table = (np.rint(self.lags(self.points)).astype(np.int32) + self.half_lags + rows).astype(np.int32)

    def stretch(self, rays: np.ndarray) -> np.ndarray:
        """Return where rays (n, 3) enter and leave the volume, (n, 2) m; leaving before entering: they miss it."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(self.low - self.centre) / rays, (self.high - self.centre) / rays])
        ends = np.where(np.isnan(ends), np.array([-np.inf, np.inf])[:, None, None], ends)
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        return np.column_stack([np.maximum(enter, NEAREST_M), leave])

    def lags(self, points: np.ndarray) -> np.ndarray:
        """Return the lag steps (pairs, n) that sound from points (n, 3) m causes."""
        ranges = np.linalg.norm(points - self.microphones[:, None], axis=2)
        return (ranges[self.first] - ranges[self.second]) * self.steps_per_metre

    def responses(self, gcc: np.ndarray) -> np.ndarray:
        """Return each ray's largest response, (n,), to GCCs (pairs, lags)."""
        return gcc.ravel().take(self.table).mean(axis=0).reshape(-1, self.depths).max(axis=1)

    def response(self, gcc: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the response at points (n, 3) m, (n,), interpolated between lags."""
        return interpolated(gcc, self.lags(points) + self.half_lags).mean(axis=0)

    def search(self, gcc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (n, 3) m of the rays, the best first, and their responses (n,)."""
        value = self.responses(gcc)
        order = np.argsort(-value, kind="stable")
        return self.points.reshape(-1, self.depths, 3)[order, 0], value[order]

    def refined(self, gcc: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, float, np.ndarray, float]:
        """Fit a direction, and the curvature of the response about it.

        Args:
            gcc: (pairs, lags).
            ray: (3,) where to start.

        Returns:
            Direction (3,), the range in m that is answered best, negative second derivatives (2, 2) 1/rad² of the
            response along `tangents`, and the response.
        """
        reach = self.stretch(ray[None])[0]
        distance = 2.0 / (1.0 / max(reach[0], NEAREST_M) + 1.0 / max(reach[1], NEAREST_M))
        for step in (SPACING / 2, SPACING / 4, SPACING / 10):
            around = _tangent(ray, step * _GRID)
            inverse = 1.0 / distance
            if self.depths > 1:
                steps = np.clip(inverse + np.array([-0.3, -0.1, 0.0, 0.1, 0.3]), 1.0 / 30.0, 1.0 / NEAREST_M)
                at = int(np.argmax(self.response(gcc, self.centre + ray / steps[:, None])))
                distance = 1.0 / steps[at]
            values = self.response(gcc, self.centre + around * distance)
            ray = around[int(np.argmax(values))]
        step = SPACING / 4
        values = self.response(gcc, self.centre + _tangent(ray, step * _GRID) * distance)
        # A paraboloid by least squares through 5 x 5 values: less at the mercy of one interpolated lag than 3 x 3.
        fit = _PARABOLOID @ values
        curvature = -np.array([[2.0 * fit[3], fit[5]], [fit[5], 2.0 * fit[4]]])
        widths, axes = np.linalg.eigh(curvature)
        offset = axes @ ((axes.T @ fit[1:3]) / np.maximum(widths, 1e-9))
        if np.abs(offset).max() <= 1.0:
            ray = _tangent(ray, step * offset[None])[0]
        value = float(self.response(gcc, self.centre + ray[None] * distance)[0])
        return ray, distance, (axes * np.maximum(widths, 0.0)) @ axes.T / step**2, value


@dataclass(frozen=True)
class Bearing:
    """A direction that is answered better than noise would.

    Attributes:
        ray: (3,) unit vector.
        gcc: (pairs, lags) in which it was found.
        curvature: (2, 2) 1/rad², see RaySearch.refined.
        response: there.
        terms: what the weights of a DirectionLaw are multiplied by.
        first: whether it is the decision's first.
    """

    ray: np.ndarray
    gcc: np.ndarray
    curvature: np.ndarray
    response: float
    terms: dict[str, float]
    first: bool


class DirectionFinder:
    """Decides, step by step, from which directions an array hears talkers.

    Args:
        settings: see SteeredSettings.
        response, masks: of the array.
        law: see DirectionLaw.
    """

    outside = False  # along a ray there is always a place in the room

    def __init__(self, settings: SteeredSettings, response: RaySearch, masks: Masks, law: DirectionLaw):
        self.settings, self.response, self.masks, self.law = settings, response, masks, law
        self.mirror = _mirror(response.microphones)

    def bearings(self, heard: Heard, noise: NoiseLaw, memory: Memory) -> list[Bearing]:
        """Return the directions that are answered better than noise would, each without those before it."""
        found: list[Bearing] = []
        explained = self.masks.explained(heard)
        gcc, free = heard.gccs.mean(axis=0), np.ones(len(self.response.rays), bool)
        for away in heard.steady - self.response.centre:
            free &= self.response.rays @ (away / np.linalg.norm(away)) < np.cos(APART)
        begin = len(heard.steady)
        for number in range(begin, begin + self.settings.max_speakers):
            if number or heard.above is not None:
                gcc = self.masks.masked(heard, explained).mean(axis=0)
            values = np.where(free, self.response.responses(gcc), -np.inf)
            threshold = noise.threshold(self.settings.candidate if number else self.settings.false_alarm)
            if not free.any() or values.max() * 1.5 < threshold:
                break
            ray, distance, curvature, response = self.response.refined(gcc, self.response.rays[int(np.argmax(values))])
            place = self.response.centre + ray * distance
            coherence = self.masks.coherence(heard, place, np.zeros(3))
            own = float((coherence * (coherence > explained)).sum() / max(coherence.sum(), 1e-12))
            explained = np.maximum(explained, coherence)
            free &= self.response.rays @ ray < np.cos(APART)
            if self.mirror is not None:
                free &= self.response.rays @ _mirrored(ray, self.mirror) < np.cos(APART)
            if response < threshold:
                break
            at_lag = interpolated(gcc, self.response.lags(place[None]) + self.response.half_lags)[:, 0]
            agreement = max(float(np.clip(at_lag / (3.0 * noise.deviation), -1.0, 1.0).mean()), 0.02)
            terms = {
                "one": 1.0,
                "response": float(np.log(max(response / noise.location, 1e-3))),
                "agreement": float(np.log(agreement)),
                "own": float(np.log(max(own, 1e-3))),
                "before": max((t.lasting for t in memory.traces if self._near(t, ray, memory)), default=0.0, key=abs),
            }
            found.append(Bearing(ray, gcc, curvature, response, terms, number == 0))
        return found

    def _near(self, trace: Trace, ray: np.ndarray, memory: Memory) -> bool:
        return level_distance(trace.position, self.response.centre + AWAY_M * ray) < memory.reach(trace)

    def talkers_of(self, found: list[Talker], later: Sequence[list[Talker] | None]) -> list[Talker]:
        """Return a decision's talkers: what comes later does not count here."""
        return found

    def decide(self, time: float, heard: Heard, noise: NoiseLaw, memory: Memory) -> list[Talker]:
        """Return the talkers in the windows around one moment, the most probable first, and remember them.

        Args:
            time: s, the moment.
            heard: the windows around it.
            noise: what noise does to as many windows.
            memory: what the decisions before found.
        """
        found = self.bearings(heard, noise, memory)
        logits = [self.law.logit(one.terms, first=one.first) for one in found]
        memory.keep(
            [
                Trace(
                    self.response.centre + AWAY_M * one.ray,
                    np.zeros(3),
                    memory.kept * one.terms["before"] + (1.0 - memory.kept) * float(np.clip(logit, -4.0, 2.0) + 2.4),
                )
                for one, logit in zip(found, logits, strict=True)
            ]
        )
        talkers: list[Talker] = []
        for one, logit in zip(found, logits, strict=True):
            score = 1.0 / (1.0 + float(np.exp(-np.clip(logit, -30.0, 30.0))))
            if score >= self.settings.min_score:
                talkers += self.told(one, score, noise)
        return sorted(talkers, key=lambda talker: -talker.score)

    def told(self, one: Bearing, score: float, noise: NoiseLaw) -> list[Talker]:
        """Return a bearing as a talker, and as two of half the score where a mirror image is as good.

        An image above or below the talker says no more than that the height is unknown.
        """
        if self.mirror is None:
            return [self.talker(one, [one.ray], score, noise)]
        other = _mirrored(one.ray, self.mirror)
        reach = self.response.stretch(other[None])[0]
        if other @ one.ray > np.cos(APART) or reach[1] < reach[0] + 0.3:
            return [self.talker(one, [one.ray], score, noise)]
        if abs(self.mirror[2]) > np.cos(APART):
            return [self.talker(one, [one.ray, other], score, noise)]
        return [self.talker(one, [ray], 0.5 * score, noise) for ray in (one.ray, other)]

    def talker(self, one: Bearing, rays: list[np.ndarray], score: float, noise: NoiseLaw) -> Talker:
        """Return a talker in one of some directions, with the middle of where along them he may be."""
        turned, ray = self.across(one, noise), rays[0]
        means, covariances = zip(*(self.place(one.gcc, each, turned, noise) for each in rays), strict=True)
        position = np.mean(means, axis=0)
        covariance = np.mean(covariances, axis=0) + np.mean([np.outer(m, m) for m in means - position], axis=0)
        # `tangents` are level and upward: where elevation is hardly known, the direction on the floor is told alone.
        level = float(np.hypot(ray[0], ray[1]))
        sideways, upward = np.sqrt(turned[0, 0]), np.sqrt(turned[1, 1])
        if (upward > 2.0 * sideways or len(rays) > 1) and level > 0.3:
            flat = np.array([ray[0] / level, ray[1] / level, np.nan])
            told = Ray(self.response.centre, flat, float(sideways / level))
        else:
            told = Ray(self.response.centre, ray, float(np.sqrt(0.5 * (turned[0, 0] + turned[1, 1]))))
        return Talker(position, covariance, score, told)

    def across(self, one: Bearing, noise: NoiseLaw) -> np.ndarray:
        """Return the covariance (2, 2) rad² of a direction along `tangents`."""
        weights = self.law.spread
        factor = np.exp(2.0 * (weights["one"] + weights["agreement"] * one.terms["agreement"]))
        turned = factor * noise.deviation * np.linalg.inv(one.curvature + 0.02 * noise.deviation * np.eye(2))
        turned = turned + (PLACED_M / self.response.size) ** 2 * np.eye(2)
        return 0.5 * (turned + turned.T)

    def place(
        self, gcc: np.ndarray, ray: np.ndarray, turned: np.ndarray, noise: NoiseLaw
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (3,) m and covariance (3, 3) m² of where in the volume a talker about a ray may be.

        Directions are as likely as their covariance (2, 2) rad² has it; along each, the response tells how far the
        talker is as far as it does, who may stand anywhere on the floor.
        """
        widths, axes = np.linalg.eigh(turned)
        offsets = (np.minimum(np.sqrt(widths), 0.4) * _STEPS) @ axes.T
        rays = _tangent(ray, offsets)
        enter, leave = self.response.stretch(rays).T
        met = leave > enter
        met[len(met) // 2] = True
        leave = np.maximum(leave, enter + 0.1)
        ranges = enter[:, None] + _SHARES * (leave - enter)[:, None]
        points = self.response.centre + rays[:, None] * ranges[:, :, None]
        values = self.response.response(gcc, points.reshape(-1, 3)).reshape(ranges.shape)
        values = values - values.max(axis=1, keepdims=True)
        weight = ranges * np.exp(self.law.sharpness * values / noise.deviation)
        likely = met * np.exp(-0.5 * (_STEPS**2).sum(axis=1))
        weight *= (likely * (leave - enter) / weight.sum(axis=1))[:, None]
        weight /= weight.sum()
        mean = np.einsum("rk,rkx->x", weight, points)
        away = points - mean
        covariance = np.einsum("rk,rkx,rky->xy", weight, away, away) + 0.05**2 * np.eye(3)
        return mean, 0.5 * (covariance + covariance.T)


def tangents(ray: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) across a ray (3,), the first level, the second upward as far as may be."""
    level = np.array([-ray[1], ray[0], 0.0])
    length = float(np.linalg.norm(level))
    level = level / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return np.stack([level, np.cross(ray, level)])


def _tangent(ray: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the unit vectors (n, 3) at offsets (n, 2) rad from a ray along `tangents`."""
    turned = ray + offsets @ tangents(ray)
    return turned / np.linalg.norm(turned, axis=1)[:, None]


def _sphere(spacing: float) -> np.ndarray:
    """Return unit vectors (n, 3) about `spacing` rad apart, on a spiral (Gonzalez 2010)."""
    count = int(np.ceil(4.0 * np.pi / spacing**2))
    index = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * index / count, np.pi * (1.0 + np.sqrt(5.0)) * index
    level = np.sqrt(1.0 - height**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), height])


def _mirror(microphones: np.ndarray) -> np.ndarray | None:
    """Return the unit normal (3,) of the plane in which mirror images are heard alike; None where there is none."""
    centred = microphones - microphones.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=True)
    if spread[2] > 0.05 * spread[0]:
        return None
    if spread[1] > 0.05 * spread[0]:
        normal: np.ndarray = axes[2]
        return normal
    across = np.cross(axes[0], [0.0, 0.0, 1.0])  # a line hears a cone alike; its mirror image on the floor is told
    length = float(np.linalg.norm(across))
    return across / length if length > 1e-6 else None


def _mirrored(ray: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return ray - 2.0 * (ray @ normal) * normal


_GRID = np.array([[x, y] for y in range(-2, 3) for x in range(-2, 3)], dtype=np.float64)
_STEPS = np.array([[x, y] for y in np.linspace(-2.5, 2.5, 7) for x in np.linspace(-2.5, 2.5, 7)])
"""Standard deviations, at which directions about a ray stand for the others."""

_SHARES = (np.arange(16) + 0.5) / 16
"""Of the way through the volume, at which ranges along a ray stand for the others."""

_PARABOLOID = np.linalg.pinv(
    np.column_stack([np.ones(25), _GRID, _GRID[:, 0] ** 2, _GRID[:, 1] ** 2, _GRID[:, 0] * _GRID[:, 1]])
)
