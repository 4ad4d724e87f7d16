"""Where talkers are, decision by decision: peaks of the steered response in metres, their scores and covariances."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avcli.localization import uncertainty
from avcli.localization.array import Array, Talker
from avcli.localization.health import Health
from avcli.localization.line import HalfPlane, believed
from avcli.localization.masks import Masks
from avcli.localization.memory import UNKNOWN, Memory, Trace, level_distance
from avcli.localization.mirror import HalfSpace
from avcli.localization.modulation import APART_S, Course
from avcli.localization.noise import NoiseLaw
from avcli.localization.settings import SteeredSettings
from avcli.localization.srp import SteeredResponse
from avcli.localization.talkers import Peak, TalkerSearch
from avcli.localization.windows import Heard

NEAR_M, SOUGHT = 0.2, 0.5
"""m: how far apart two decisions may place one talker who stands; and the score from which one is looked for in the
decisions before."""
_SURE = float(np.log(0.9 / 0.1))
"""Evidence from which a source is surely heard."""


@dataclass(frozen=True)
class Judged:
    """A peak and what is known about it.

    Attributes:
        score: the probability that it is right.
        evidence: what speaks for it, see uncertainty.Law.
        peak: the peak.
        features: what both rest on.
        course: see `Trace`.
        after: what the decisions after it tell about it, once they are known.
    """

    score: float
    evidence: float
    peak: Peak
    features: uncertainty.Features
    course: Course
    after: uncertainty.After | None = None


@dataclass(frozen=True)
class Found:
    """What was found in one decision by what was heard until then.

    Attributes:
        time: s.
        judged: its peaks.
        heard: the windows around it.
        noise: what noise does to as many windows.
        memory: what the decisions before found.
        fall: see uncertainty.Features.
        strongest: response of the peak that was found first; 0 where none was.
        trust: by which its scores are multiplied, see `Health`.
    """

    time: float
    judged: list[Judged]
    heard: Heard
    noise: NoiseLaw
    memory: Memory
    fall: float
    strongest: float
    trust: float


class PlaceFinder:
    """Decides, step by step, where an array hears talkers.

    Args:
        array: the microphones and the room.
        settings: see SteeredSettings.
        response, masks, health: of the array.
        law: scores and covariances.
        half: what is searched of the room where places are heard alike.

    Attributes:
        outside: whether a source was surely heard, in the latest decision, on the edge of the room or beyond it.
    """

    def __init__(
        self,
        array: Array,
        settings: SteeredSettings,
        response: SteeredResponse,
        masks: Masks,
        health: Health,
        law: uncertainty.Law,
        half: HalfPlane | HalfSpace | None = None,
    ):
        self.settings, self.response, self.health, self.law = settings, response, health, law
        self.talkers = TalkerSearch(array, settings, masks, response, half)
        self.outside = False
        self.apart = max(1, round(APART_S * settings.rate))  # decisions between two levels that are compared

    def decide(self, time: float, heard: Heard, noise: NoiseLaw, memory: Memory) -> Found:
        """Return what the windows around one moment hold, those peaks first for which most speaks, and remember it.

        Args:
            time: s, the moment.
            heard: the windows around it.
            noise: what noise does to as many windows.
            memory: what the decisions before found.
        """
        fall = memory.fall(float(heard.power[np.argmin(np.abs(heard.offsets))].sum()))
        peaks = self.talkers.peaks(heard, noise, memory)
        strongest = peaks[0].response if peaks else 0.0
        found = Found(time, [], heard, noise, copy.copy(memory), fall, strongest, self.health.trust)
        judged = self.judge(peaks, found)
        judged.sort(key=lambda one: -one.evidence)
        memory.keep(
            [
                Trace(
                    one.peak.position,
                    0.6 * one.features.gait + 0.4 * one.features.velocity,
                    self.law.remembered(one.features, memory.kept),
                    memory.confirmed(one.features.confirmed, self.law.own_evidence(one.features)),
                    one.course,
                    self.law.heard(one.features),
                )
                for one in judged
            ]
        )
        self.outside = any(one.evidence > _SURE for one in judged[:1] if self.beside_a_wall(one.peak))
        return replace(found, judged=judged)

    def talkers_of(self, found: Found, later: Sequence[Found | None]) -> list[Talker]:
        """Return a decision's talkers, the most probable first, as those after it bear them out.

        A talker of a later decision of whom nothing was found is searched for where he was then.

        Args:
            found: the decision.
            later: those after it that are known, one after another; None where nothing was heard.
        """
        told = found.judged
        if later:
            sought = self.judge(self.sought(found, later), found)
            known = [self.after(one, found.time, later, sought=False) for one in told]
            known += [self.after(one, found.time, later, sought=True) for one in sought]
            told = [
                replace(
                    one, score=self.law.borne_out(after, one.features, edge=self.beside_a_wall(one.peak)), after=after
                )
                for one, after in zip((*told, *sought), known, strict=True)
            ]
        told = [replace(one, score=found.trust * one.score) for one in told]
        return self.report(found.time, told, found.heard, found.noise)

    def after(self, one: Judged, time: float, later: Sequence[Found | None], *, sought: bool) -> uncertainty.After:
        """Return what the decisions after one at a time in s tell about a peak of it."""
        again = [0.0] * len(later)
        for k, known in enumerate(later):
            if known is not None:
                age = known.time - time
                place, reach = one.peak.position + one.peak.velocity * age, self.reach(age)
                near = [other for other in known.judged if level_distance(other.peak.position, place) <= reach]
                again[k] = max((other.score for other in near), default=0.0)
        return uncertainty.After(one.score, tuple(again), sought)

    def reach(self, age: float) -> float:
        """Return how far, in m, a talker may seem to have moved in so many s."""
        return NEAR_M + self.settings.max_speed * age

    def sought(self, found: Found, later: Sequence[Found | None]) -> list[Peak]:
        """Return the peaks of a decision where talkers of later ones were, of whom nothing was found in it."""
        peaks = [one.peak for one in found.judged]
        for known in filter(None, later):
            near = self.reach(known.time - found.time)
            for start in (other.peak.position for other in known.judged if other.score >= SOUGHT):
                if all(level_distance(peak.position, start) > near for peak in peaks):
                    peak = self.talkers.beside(found.heard, found.noise, peaks, start)
                    if level_distance(peak.position, start) <= near:
                        peaks.append(peak)
        return peaks[len(found.judged) :]

    def judge(self, peaks: Sequence[Peak], found: Found) -> list[Judged]:
        """Return peaks of a decision with their scores.

        Beside a known steady source, which was taken away before, all of them are further ones.

        Args:
            peaks: in the order in which they were found.
            found: the decision, with those peaks that were judged before.
        """
        memory, heard, noise = found.memory, found.heard, found.noise
        judged, left = list(found.judged), memory.traces
        for one in judged:
            left = [t for t in left if level_distance(t.position, one.peak.position) >= memory.reach(t)]
        strongest = found.strongest
        leading = next((one.score for one in judged if one.features.first), 0.5)
        of_all = {
            "channels": heard.channels,
            "doubted": float(self.health.doubted.any()),
            "fall": found.fall,
            "crowded": float(len(judged) + len(peaks) > self.settings.max_speakers),
        }
        for peak in peaks:
            near = [level_distance(trace.position, peak.position) < memory.reach(trace) for trace in left]
            traces = [trace for trace, same in zip(left, near, strict=True) if same]
            left = [trace for trace, same in zip(left, near, strict=True) if not same]
            so_far = _latest(traces).course if traces else Course()
            course, steady = so_far.goes_on(peak.levels, heard.middles, self.apart)
            first = not judged and not len(heard.steady)
            strongest = strongest or peak.response
            of_one = {
                "steady": steady,
                "leading": leading,
                "relative": peak.response / max(strongest, 1e-9),
                "familiar": memory.familiar(peak.position),
            }
            features = self.features(peak, first, traces, noise, of_all | of_one)
            score = self.law.probability(features, edge=self.beside_a_wall(peak))
            leading = score if first else leading
            judged.append(Judged(score, self.law.evidence(features), peak, features, course))
        return judged[len(found.judged) :]

    def features(
        self, peak: Peak, first: bool, traces: list[Trace], noise: NoiseLaw, more: dict[str, float]
    ) -> uncertainty.Features:
        """Return what tells a right peak, the decision's first or a further one, from a wrong one.

        Of the traces of earlier decisions nearby the most telling one counts, and the latest says where it was; `more`
        holds the features that are known already.
        """
        strayed, pace, gait = np.zeros(3), peak.velocity, peak.velocity
        if traces:
            latest = _latest(traces)
            gait = latest.velocity
            strayed = peak.position - latest.position - peak.velocity * (latest.age / self.settings.rate)
            pace = (peak.position - latest.position) * [1.0, 1.0, 0.0] * (self.settings.rate / latest.age)
        return uncertainty.Features(
            response=peak.response / noise.location,
            agreement=peak.agreement,
            support=peak.support,
            before=max((trace.lasting for trace in traces), default=0.0, key=abs),
            confirmed=max((trace.confirmed for trace in traces), default=UNKNOWN),
            first=first,
            own=peak.own,
            velocity=peak.velocity,
            residual=peak.residual,
            strayed=strayed,
            pace=pace,
            gait=gait,
            strongest=peak.strongest,
            dilution=uncertainty.dilution(peak.normal),
            **more,
        )

    def report(self, time: float, judged: list[Judged], heard: Heard, noise: NoiseLaw) -> list[Talker]:
        """Return those of a decision's peaks that are probable enough, with their covariances.

        Args:
            time: s, the moment.
            judged: the peaks.
            heard: the windows around the moment.
            noise: what noise does to as many windows.
        """
        if self.response.flat:
            judged = [one if one.features.first else replace(one, score=believed(one.score)) for one in judged]
        return [
            Talker(
                one.peak.position,
                self.covariance(one, heard.offsets, noise),
                one.score,
                machine=1.0 - self.law.voice(one.features.steady),
            )
            for one in sorted(judged, key=lambda one: -one.score)[: self.settings.max_speakers]
            if one.score >= self.settings.min_score
        ]

    def covariance(self, judged: Judged, offsets: np.ndarray, noise: NoiseLaw) -> np.ndarray:
        """Return the covariance (3, 3) m² of a peak that was found in windows at offsets (windows,) s."""
        peak, low, high = judged.peak, self.response.low, self.response.high
        sharpness = self.law.sharpness / noise.deviation
        others = self.response.ambiguity(peak.gccs, offsets, peak.position, peak.velocity, sharpness)
        covariance = self.law.covariance(peak.normal, others, judged.features, low, high)
        covariance = covariance + uncertainty.beyond(self.on_the_edge(peak.position))
        return covariance + uncertainty.UNSURE_M**2 * np.eye(3) if self.health.doubted.any() else covariance

    def beside_a_wall(self, peak: Peak) -> bool:
        """Tell whether the search ended on a side of its volume."""
        return bool(self.on_the_edge(peak.position)[:2].any())

    def on_the_edge(self, position: np.ndarray) -> np.ndarray:
        """Return for each axis (3,) whether a place lies on the edge of the searched volume."""
        margin = 0.5 * self.settings.resolution
        return (position - self.response.low < margin) | (self.response.high - position < margin)


def _latest(traces: list[Trace]) -> Trace:
    return min(traces, key=lambda trace: trace.age)
