"""Directions from arrays that are small against the range: bearing, elevation and inverse range.

Sound from 2 m reaches an array of 20 cm almost as a plane wave: the response hardly changes along a ray, and a search
in metres, whose cells are larger than the array, finds nothing. Here the response is taken on rays from the middle of
the array instead, at few inverse ranges, and what is not observed is said: a direction with its uncertainty, and a
position whose covariance reaches along the ray as far as the room lets it.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from avcli.localization import correlation
from avcli.localization.array import Array, Ray, Talker
from avcli.localization.line import HARDLY, line_of, tangents
from avcli.localization.masks import Masks
from avcli.localization.memory import Memory, Trace, level_distance
from avcli.localization.mirror import mirrored
from avcli.localization.modulation import APART_S, Course, Levels
from avcli.localization.noise import NoiseLaw
from avcli.localization.settings import SteeredSettings
from avcli.localization.srp import interpolated
from avcli.localization.uncertainty import After, after_terms, flattened, logistic
from avcli.localization.windows import Heard

TIMED_M = 0.005
"""m: the error of an arrival's path that says whether an array observes ranges."""

RANGED = 0.25
"""The share of the range below which the error of a range is told, in the median place of the volume."""

NEAREST_M, SPACING, DEFOCUS_M = 0.4, np.radians(2.5), 0.01
"""m and rad: the least range, how far the rays are apart, and by how much path they may be out of focus in range."""

PLACED_M = 0.001
"""m: how well the places of the microphones are known."""

APART, NEAR_M = np.radians(25.0), 0.2
"""rad: the least angle between two talkers; and m across AWAY_M: how far apart two decisions may see one who stands."""

IN_LINE = np.radians(10.0)
"""rad: how far beside a talker, seen from above, his echoes by floor, ceiling or the wall behind may seem to be."""

ANY = 1.0
"""rad: a larger standard deviation of a direction tells none."""

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
        first, further: weights of the logit of the probability that a direction is right, by the names of
            `Bearing.terms`.
        after: for the "first" and a "further" one, weights of that logit once it is known what the decisions after it
            found, as of an `uncertainty.Law`.
        spread: for "level" and "upward", weights of the logarithm of a factor on the standard deviation that the
            curvature of the response gives, likewise.
        sharpness: logarithm of a range's likelihood over its response, in standard deviations of a GCC of noise.
    """

    first: Mapping[str, float]
    further: Mapping[str, float]
    after: Mapping[str, Mapping[str, float]]
    spread: Mapping[str, Mapping[str, float]]
    sharpness: float

    def probability(self, terms: Mapping[str, float], *, first: bool) -> float:
        """Return the probability that a direction is right by what was heard until then."""
        return logistic(self.logit(terms, first=first))

    def logit(self, terms: Mapping[str, float], *, first: bool) -> float:
        """Return the logit of that probability."""
        return sum(weight * terms[name] for name, weight in (self.first if first else self.further).items())

    def own_evidence(self, terms: Mapping[str, float], *, first: bool) -> float:
        """Return that logit without what was remembered."""
        return self.logit({**terms, "before": 0.0}, first=first)

    def borne_out(self, after: After, *, first: bool) -> float:
        """Return that probability as it is known by what the decisions after it found."""
        weights, terms = self.after["first" if first else "further"], after_terms(after)
        logit = sum(weight * terms[name] for name, weight in weights.items() if name in terms)
        return logistic(float(flattened(logit, weights["middle"])))


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

    def answers(self, gcc: np.ndarray) -> np.ndarray:
        """Return what each pair answers at each of the points, (pairs, points), to GCCs (pairs, lags)."""
        return gcc.ravel().take(self.table)

    def best(self, gcc: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the point (3,) m with the largest response to GCCs (pairs, lags), and that response."""
        ray, distance, _, value = self.refined(gcc, self.rays[int(np.argmax(self.responses(gcc)))])
        return self.centre + ray * distance, value

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
        coherence: (windows, bins) of it, see `Masks.coherence`.
        terms: what the weights of a DirectionLaw are multiplied by. "one" is a constant. Of these the logarithms count:
            "agreement", of the pairs, each cut off at three standard deviations of noise; "coherence", mean over times
            and frequencies, 1 where the channels agree; "narrow" and "wide", the curvatures over the deviation of
            noise; "own", the share of the coherence that is not better on a direction before it;
            "size", of the array, see RaySearch. "strongest" is the best window's response over their mean, "few" the
            share of the delays that a place uses up, from 1 with four channels to 0 with many, "mirror" 1 where mirror
            images are heard alike, and "before" what is remembered.
        first: whether it is the decision's first.
        score: the probability that it is right, and a voice.
        course: how steadily it sounded so far.
        voice: the probability that what sounds so steadily is a voice.
    """

    ray: np.ndarray
    gcc: np.ndarray
    curvature: np.ndarray
    response: float
    coherence: np.ndarray
    terms: dict[str, float]
    first: bool
    score: float = 0.0
    course: Course = field(default_factory=Course)
    voice: float = 1.0


@dataclass(frozen=True)
class Found:
    """What was found in one decision by what was heard until then.

    Attributes:
        time: s.
        bearings: in the order in which they were found.
        noise: what noise does to as many windows.
        trust: by which the scores are multiplied, see `Health`.
    """

    time: float
    bearings: list[Bearing]
    noise: NoiseLaw
    trust: float


class DirectionFinder:
    """Decides, step by step, from which directions an array hears talkers.

    Args:
        settings: see SteeredSettings.
        response, masks: of the array.
        law: see DirectionLaw.
        voice: returns the probability that what sounds so steadily is a voice, see `uncertainty.Law.voice`.
        trust: returns by what scores are multiplied, see `Health`.
    """

    outside = False  # along a ray there is always a place in the room

    def __init__(
        self,
        settings: SteeredSettings,
        response: RaySearch,
        masks: Masks,
        law: DirectionLaw,
        voice: Callable[[float], float],
        trust: Callable[[], float],
    ):
        self.trust = trust
        self.settings, self.response, self.masks, self.law, self.voice = settings, response, masks, law, voice
        self.mirror, self.line = _mirror(response.microphones), line_of(response.microphones)
        self.level = self.mirror is not None and bool(abs(self.mirror[2]) > np.cos(APART))
        self.levels = Levels(masks.correlator.band, masks.array.sample_rate)
        self.apart = max(1, round(APART_S * settings.rate))  # decisions between two levels that are compared

    def bearings(self, heard: Heard, noise: NoiseLaw, memory: Memory) -> list[Bearing]:
        """Return the directions that are answered better than noise would, each without those before it."""
        found: list[Bearing] = []
        explained = self.masks.explained(heard)
        gccs, free = heard.gccs, np.ones(len(self.response.rays), bool)
        for away in heard.steady - self.response.centre:
            free &= self.beside(away / np.linalg.norm(away)) > APART
        begin = len(heard.steady)
        for number in range(begin, begin + self.settings.max_speakers + 1):
            if len(found) == self.settings.max_speakers:
                break
            if number or heard.above is not None:
                gccs = self.masks.masked(heard, explained)
            values = np.where(free, self.response.responses(gccs.mean(axis=0)), -np.inf)
            threshold = noise.threshold(self.settings.candidate if number else self.settings.false_alarm)
            if not free.any() or values.max() * 1.5 < threshold:
                break
            one = self.fitted(gccs, heard, self.response.rays[int(np.argmax(values))], noise, explained, number == 0)
            explained = np.maximum(explained, one.coherence)
            free &= self.beside(one.ray) > APART
            for ray in self.images(one.ray):
                free &= ~self.echoes(ray, self.response.rays)
            if one.response < threshold:
                break
            if not any(self.echoes(other.ray, one.ray[None])[0] for other in found):
                found.append(self.remembered(one, heard, memory))
        return found

    def remembered(self, one: Bearing, heard: Heard, memory: Memory) -> Bearing:
        """Return a bearing with its score, by what the decisions before tell of it, too."""
        near = [trace for trace in memory.traces if self._near(trace, one.ray, memory)]
        terms = one.terms | {"before": max((trace.lasting for trace in near), default=0.0, key=abs)}
        course = min(near, key=lambda trace: trace.age).course if near else Course()
        course, steady = course.goes_on(self.levels(one.coherence, heard.power), heard.middles, self.apart)
        voice = self.voice(steady)
        score = voice * self.law.probability(terms, first=one.first)
        return replace(one, terms=terms, score=score, course=course, voice=voice)

    def fitted(
        self, gccs: np.ndarray, heard: Heard, start: np.ndarray, noise: NoiseLaw, explained: np.ndarray, first: bool
    ) -> Bearing:
        """Fit a direction to the GCCs (windows, pairs, lags) that those before leave.

        Args:
            gccs: see above.
            heard: the windows around the moment.
            start: (3,) unit vector.
            noise: what noise does to as many windows.
            explained: (windows, bins) the coherence of the directions before.
            first: whether there are none.
        """
        gcc = gccs.mean(axis=0)
        ray, distance, curvature, response = self.response.refined(gcc, start)
        if self.line is not None:
            ray, curvature = self.line.standing_for(ray), self.line.curved(ray, curvature)
        place = self.response.centre + ray * distance
        at_lag = interpolated(gcc, self.response.lags(place[None]) + self.response.half_lags)[:, 0]
        # Of pairs that are left out there is nothing, and of the others as much more.
        at_lag = at_lag[heard.pairs] * heard.pairs.mean()
        each = [self.response.response(one, place[None])[0] for one in gccs]
        coherence = self.masks.coherence(heard, place, np.zeros(3))
        own = float((coherence * (coherence > explained)).sum() / max(coherence.sum(), 1e-12))
        whole = self.masks.correlator.band.weight.mean() * max(heard.channels - 1.0, 1.0)
        wide, narrow = np.linalg.eigvalsh(curvature) / noise.deviation
        logarithms = {
            "agreement": max(float(np.clip(at_lag / (3.0 * noise.deviation), -1.0, 1.0).mean()), 0.02),
            "coherence": max(float(coherence.mean()) / whole, 3e-3),
            "narrow": max(narrow, 1e-3),
            "wide": max(wide, 1e-3),
            "own": max(own, 1e-3),
            "size": self.response.size,
        }
        terms = {name: float(np.log(value)) for name, value in logarithms.items()} | {
            "one": 1.0,
            "strongest": min(float(max(each) / max(np.mean(each), 0.1 * noise.deviation)), 3.0),
            "few": min(3.0 / max(heard.channels - 1.0, 3.0), 1.0),
            "mirror": float(self.mirror is not None),
        }
        return Bearing(ray, gcc, curvature, response, coherence, terms, first)

    def images(self, ray: np.ndarray) -> list[np.ndarray]:
        """Return a direction, and its mirror image where that is heard alike."""
        return [ray] if self.mirror is None else [ray, mirrored(ray, self.mirror)]

    def beside(self, ray: np.ndarray) -> np.ndarray:
        """Return how far the rays of the search are from a ray (3,) and from what is heard like it, (n,) rad."""
        if self.line is not None:
            return np.abs(self.line.angle(self.response.rays) - self.line.angle(ray))
        return np.arccos(np.clip(self.response.rays @ np.transpose(self.images(ray)), -1.0, 1.0)).min(axis=1)

    def echoes(self, ray: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Tell which rays (n, 3) are in line with a ray (3,) seen from above, as echoes of its sound may be.

        Those by floor and ceiling are steeper, that by the wall behind a talker is less steep.
        """
        across, along = rays[:, 0] * ray[1] - rays[:, 1] * ray[0], rays[:, :2] @ ray[:2]
        return np.asarray((along > 0.0) & (np.abs(across) < np.tan(IN_LINE) * along))

    def _near(self, trace: Trace, ray: np.ndarray, memory: Memory) -> bool:
        places = [self.response.centre + AWAY_M * image for image in self.images(ray)]
        return min(level_distance(trace.position, place) for place in places) < memory.reach(trace)

    def decide(self, time: float, heard: Heard, noise: NoiseLaw, memory: Memory) -> Found:
        """Return the directions in the windows around one moment, and remember them.

        Args:
            time: s, the moment.
            heard: the windows around it.
            noise: what noise does to as many windows.
            memory: what the decisions before found.
        """
        found = self.bearings(heard, noise, memory)
        memory.keep(
            [
                Trace(
                    self.response.centre + AWAY_M * one.ray,
                    np.zeros(3),
                    memory.kept * one.terms["before"]
                    + (1.0 - memory.kept)
                    * float(np.clip(self.law.own_evidence(one.terms, first=one.first), -4.0, 2.0) + 2.4),
                    course=one.course,
                )
                for one in found
            ]
        )
        return Found(time, found, noise, self.trust())

    def talkers_of(self, found: Found, later: Sequence[Found | None]) -> list[Talker]:
        """Return a decision's talkers, the most probable first, as those after it bear them out.

        Args:
            found: the decision.
            later: those after it that are known, one after another; None where nothing was heard.
        """
        told = found.bearings
        if later:
            borne_out = [self.law.borne_out(self.after(one, found.time, later), first=one.first) for one in told]
            told = [replace(one, score=min(score, one.voice)) for one, score in zip(told, borne_out, strict=True)]
        told = [replace(one, score=found.trust * one.score) for one in told]
        told = [one for one in told if one.score >= self.settings.min_score]
        talkers = [talker for one in told for talker in self.told(one, found.noise)]
        return sorted(talkers, key=lambda talker: -talker.score)

    def after(self, one: Bearing, time: float, later: Sequence[Found | None]) -> After:
        """Return what the decisions after one at a time in s tell about a direction of it."""
        again = [0.0] * len(later)
        for k, known in enumerate(later):
            if known is not None:
                reach = NEAR_M + self.settings.max_speed * (known.time - time)
                near = [
                    other.score
                    for other in known.bearings
                    if any(AWAY_M * np.hypot(*(other.ray - ray)[:2]) <= reach for ray in self.images(one.ray))
                ]
                again[k] = max(near, default=0.0)
        return After(one.score, tuple(again), sought=False)

    def told(self, one: Bearing, noise: NoiseLaw) -> list[Talker]:
        """Return a bearing as a talker, and as two of half the score where a mirror image is as good.

        An image above or below the talker says no more than that the height is unknown.
        """
        turned, images = self.across(one, noise), self.images(one.ray)
        sides = [self.places(one.gcc, *self.about(ray, turned), noise) for ray in images]
        whole = sum(weight.sum() for _, weight in sides)
        if whole == 0.0:  # the ray and all those about it miss the volume
            nearest = self.response.rays[int(np.argmin(self.beside(one.ray)))]
            images, sides, whole = [nearest], [self.places(one.gcc, nearest[None], np.ones(1), noise)], 0.0
        told = [(ray, *side) for ray, side in zip(images, sides, strict=True) if side[1].sum() > HARDLY * whole]
        if len(told) > 1 and (self.level or images[0] @ images[1] > np.cos(APART)):
            points, weights = zip(*sides, strict=True)
            told = [(one.ray, np.concatenate(points), np.concatenate(weights))]
        return [self.talker(one, turned, *side, one.score / len(told)) for side in told]

    def talker(
        self, one: Bearing, turned: np.ndarray, ray: np.ndarray, points: np.ndarray, weight: np.ndarray, score: float
    ) -> Talker:
        """Return a talker who is at points (n, 3) m with weights (n,), about a ray with a covariance (2, 2) rad²."""
        weight = weight / weight.sum()
        position = weight @ points
        away = points - position
        covariance = np.einsum("n,nx,ny->xy", weight, away, away) + 0.05**2 * np.eye(3)
        sd = float(np.sqrt(0.5 * np.trace(turned)))
        told = Ray(self.response.centre, ray, sd) if sd < ANY else None
        # `tangents` are level and upward: where elevation is hardly known, the direction on the floor is told alone.
        if self.line is not None or ((self.level or turned[1, 1] > 4.0 * turned[0, 0]) and np.hypot(*ray[:2]) > 0.3):
            told = self.bearing(points, weight)
        return Talker(position, 0.5 * (covariance + covariance.T), score, told, machine=1.0 - one.voice)

    def bearing(self, points: np.ndarray, weight: np.ndarray) -> Ray | None:
        """Return the direction on the floor of points (n, 3) m with weights (n,); None where it may be any."""
        away = points[:, :2] - self.response.centre[:2]
        away = away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
        middle = weight @ away
        middle = middle / max(float(np.linalg.norm(middle)), 1e-9)
        turn = np.arctan2(middle[0] * away[:, 1] - middle[1] * away[:, 0], away @ middle)
        sd = float(np.sqrt(weight @ turn**2))
        return Ray(self.response.centre, np.array([*middle, np.nan]), sd) if sd < ANY else None

    def across(self, one: Bearing, noise: NoiseLaw) -> np.ndarray:
        """Return the covariance (2, 2) rad² of a direction along `tangents`."""
        parts = [self.law.spread[along] for along in ("level", "upward")]
        factor = np.exp([sum(weight * one.terms[name] for name, weight in part.items()) for part in parts])
        turned = (
            np.outer(factor, factor)
            * noise.deviation
            * np.linalg.inv(one.curvature + 0.02 * noise.deviation * np.eye(2))
        )
        turned = turned + (PLACED_M / self.response.size) ** 2 * np.eye(2)
        return 0.5 * (turned + turned.T)

    def about(self, ray: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rays (n, 3) about one with a covariance (2, 2) rad², and how likely each is, (n,).

        Of a line, these are the half of its cone that is on the side of the ray, or all of it where none is told.
        """
        widths, axes = np.linalg.eigh(turned)
        if self.line is not None:
            angles = self.line.angle(ray) + np.sqrt(widths[0]) * _STEPS
            side = 0.0 if ray @ self.line.level >= 0.0 else np.pi
            turns = side + (_TURNS if self.mirror is not None else 2.0 * _TURNS)
            likely = np.exp(-0.5 * _STEPS**2) * np.abs(np.sin(angles))
            return self.line.cones(angles, turns), np.repeat(likely, len(turns))
        reached = np.minimum(np.sqrt(widths), 0.4) * _GRID_STEPS
        return _tangent(ray, reached @ axes.T), np.exp(-0.5 * (reached**2 / widths).sum(axis=1))

    def places(
        self, gcc: np.ndarray, rays: np.ndarray, likely: np.ndarray, noise: NoiseLaw
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return places (n, 3) m in the volume along rays that are so likely, and the weights (n,) of the places.

        Each place in the volume is as likely as the others before anything is heard. Rays then are as likely as
        is said; along each, the response tells how far the talker is as far as it does.
        """
        enter, leave = self.response.stretch(rays).T
        met = leave > enter
        enter, leave = np.where(met, enter, NEAREST_M), np.where(met, leave, 2.0 * NEAREST_M)
        ranges = enter[:, None] + _SHARES * (leave - enter)[:, None]
        points = self.response.centre + rays[:, None] * ranges[:, :, None]
        values = self.response.response(gcc, points.reshape(-1, 3)).reshape(ranges.shape)
        values = values - values.max(axis=1, keepdims=True)
        weight = ranges**2 * np.exp(self.law.sharpness * values / noise.deviation)
        weight *= (met * likely * (leave**3 - enter**3) / weight.sum(axis=1))[:, None]
        return points.reshape(-1, 3), weight.ravel()


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
    line = line_of(microphones)
    if line is None:
        normal: np.ndarray = axes[2]
        return normal
    return line.level if abs(line.axis[2]) < 1.0 - 1e-6 else None


_GRID = np.array([[x, y] for y in range(-2, 3) for x in range(-2, 3)], dtype=np.float64)
_STEPS = np.linspace(-2.5, 2.5, 7)
_GRID_STEPS = np.array([[x, y] for y in _STEPS for x in _STEPS])
"""Standard deviations, at which directions about a ray stand for the others."""

_TURNS = np.pi * (np.arange(12) + 0.5) / 12 - 0.5 * np.pi
"""rad: about a line, at which directions stand for the others of half a cone."""

_SHARES = (np.arange(16) + 0.5) / 16
"""Of the way through the volume, at which ranges along a ray stand for the others."""

_PARABOLOID = np.linalg.pinv(
    np.column_stack([np.ones(25), _GRID, _GRID[:, 0] ** 2, _GRID[:, 1] ** 2, _GRID[:, 0] * _GRID[:, 1]])
)
