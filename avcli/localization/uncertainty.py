"""How far a detection may be believed: the probability that it is right and its covariance.

The coefficients stand in fitted.json, with what they were fitted on; `make fit-localization` writes it.
"""

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

FLOOR = 0.0005
"""m: the standard deviation that no localization undercuts."""

MISPLACED_M = 0.01
"""m: how well the place of a microphone is known that was measured with a tape, along the ray to a talker."""

UNCHECKED = 2.0
"""What the variances grow by where four channels are heard: a place takes all their delays, and none shows an error."""

UNSURE_M = 0.2
"""m: what the standard deviation grows by while channels disagree and it is not known yet which of them are right: the
places that such an array answers best were up to 0.45 m off."""

BEYOND_M, BEYOND_NEAR = np.array([0.5, 0.5, 0.3]), 0.68
"""m: the standard deviations of how far a talker is beyond the searched volume, if at all; and the share of talkers who
are less than half a metre beyond a side of it then."""

HALFWAY = 400.0
"""The dilution, see `Features`, at which a further peak of somebody is as likely as not within half a metre of him. Of
those with a score above 0.8 without it, 3 % were wrong, and a third where the dilution was above 20."""

MIDDLE = 2.2
"""A logit up to which a peak is undecided, see `flattened`."""

NOTHING = -8.0
"""A logit of evidence up to which nothing at all is heard."""

PARTS = {
    "peaks": ("one", "residual", "dilution", "pace"),
    "lattice": ("one", "heights"),
    "motion": ("one", "strongest", "agreement"),
    "level": ("one", "heights", "places", "strayed", "new", "residual", "moves", "agreement"),
    "height": ("one", "heights", "climbed", "support"),
}
"""A covariance is the sum of five parts, and this names the terms of the logarithm of each part's standard deviation:
m of a range difference, a factor of what other places nearby add, s along the path, m in x and y, m in z."""


@dataclass(frozen=True)
class Features:
    """What a steered response tells about its own peak.

    Attributes:
        response: the peak over the largest response to be expected of noise alone.
        agreement: mean over the pairs of microphones of their GCC at the place, cut off at 3 standard deviations of
            noise on either side, over these; from 0 to 1.
        support: share of the pairs that have a peak near the place, from 0 to 1.
        before: how lasting it is: see `remembered`, of what was nearby in the decision before.
        confirmed: the most that spoke lately for what is nearby, see `memory.Trace`.
        first: whether it is the decision's first peak.
        crowded: 1 where the decision has more peaks than there may be talkers, so that one is nobody; else 0.
        leading: the probability that the decision's first peak is right, which tells how far the array and the room may
            be believed; 0.5 for the first peak itself, and beside a steady source.
        relative: its response over that of the peak that the decision found first.
        familiar: how often and how surely a voice was heard there lately, see `memory.Memory.familiar`.
        own: share of the frequencies' agreement on the peak that is not better on a peak before it, from 0 to 1; an
            echo of the first talker has little.
        velocity: (3,) m/s.
        residual: m, root mean square of how far the pairs' peaks are from the place in range difference, each cut off
            at 2 cm: where few pairs agree, a robust fit to them alone would seem perfect.
        strayed: (3,) m, from where it was in the decision before, had it moved as it seems to; 0 where it is new.
        pace: (3,) m/s, the level velocity at which it came here from where it was in the decision before; its velocity
            where it is new.
        gait: (3,) m/s, its velocity as the decisions before have it, the latest counting most; its own where it is new.
            What still sounds of one who fell silent stands where he was, and he walks on.
        strongest: the best of the windows' responses over their mean: where one window alone answers, nothing averages.
        dilution: by how much errors of range differences grow into errors in x and y, along the worse axis.
        fall: dB, from the loudest of the last second to the sound in which it was found; not above 0. What falls away
            may be the room alone.
        steady: how steadily it sounds, from 0 (as a voice) on, see `modulation.Course`.
        channels: how many channels it rests on. Four tell three delays, which some place nearly always fits.
        doubted: 1 where channels are left out since they disagree with the others, else 0: where somebody is beyond a
            wall, the others agree on a place, too.
    """

    response: float
    agreement: float
    support: float
    before: float
    confirmed: float
    first: bool
    crowded: float
    leading: float
    relative: float
    familiar: float
    own: float
    velocity: np.ndarray
    residual: float
    strayed: np.ndarray
    pace: np.ndarray
    gait: np.ndarray
    strongest: float
    dilution: float
    fall: float
    channels: float
    doubted: float
    steady: float


@dataclass(frozen=True)
class After:
    """What is known of a peak once the decisions after it are known.

    Attributes:
        score: the probability that it is right by what was heard until then.
        again: for each of these decisions the score of the best peak near it, 0 where there is none.
        sought: whether it was found only since a talker was there later.
    """

    score: float
    again: tuple[float, ...]
    sought: bool


@dataclass(frozen=True)
class ClosedForm:
    """How far a mean of closed-form solutions may be believed.

    Attributes:
        one, spread, valid, events: weights of the logit of the probability that it is right: a constant, and of the
            logarithms of what `Law.closed_form_probability` takes.
        widened: factor on the covariance that the solutions' scatter has.
        floor: m, the standard deviation that is added to it.
    """

    one: float
    spread: float
    valid: float
    events: float
    widened: float
    floor: float


@dataclass(frozen=True)
class Law:
    """The fitted coefficients, and what follows from them.

    Attributes:
        first, further: weights of the evidence for a decision's first peak, or for a further one, by the names of
            `terms`: of what is remembered, and a term of the score. It is the logit of the probability that the peak is
            right where eight microphones hang around a small room.
        score: for the "first" peak and a "further" one, weights of the logit of the probability that it is within half
            a metre (x, y) of a talker, with any array in any room, by the names of `terms`.
        machine: weights of the logit of the probability that a peak is a machine: "one", and how "steady" it sounds.
        after: for the "first" peak and a "further" one, weights of the logit of that probability once it is known what
            the decisions after it found, by the names of `after_terms`, and how far it is `flattened`: "middle".
        spread: for each of `PARTS` the weights of its terms.
        widened: logarithms by which parts are wider than `spread` has them: errors have heavier tails than the Gaussian
            that is fitted, and 95 % ellipses shall hold 95 % of them. Empty where `spread` has it in it.
        memory: s, how long a decision counts in the later ones.
        sharpness: logarithm of a place's likelihood over the response there, in standard deviations of a GCC of noise.
        closed_form, closed_form_refined: of 3D-SSL, without and with its refinement.
    """

    first: Mapping[str, float]
    further: Mapping[str, float]
    score: Mapping[str, Mapping[str, float]]
    machine: Mapping[str, float]
    after: Mapping[str, Mapping[str, float]]
    spread: Mapping[str, Mapping[str, float]]
    widened: Mapping[str, float]
    memory: float
    sharpness: float
    closed_form: ClosedForm
    closed_form_refined: ClosedForm

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> "Law":
        """Make the law that the "law" of a fitted.json holds."""
        closed = {name: ClosedForm(**values[name]) for name in ("closed_form", "closed_form_refined")}
        return cls(**{**values, **closed})

    def evidence(self, features: Features) -> float:
        """Return what speaks for a peak, as a logit."""
        weights = self.first if features.first else self.further
        return sum(weight * term for weight, term in zip(weights.values(), terms(features, weights), strict=True))

    def probability(self, features: Features, *, edge: bool = False) -> float:
        """Return the probability that a peak is within half a metre (x, y) of a talker.

        Args:
            features: its own.
            edge: whether the search ended on a side of its volume. Then the pairs disagree about the place because the
                talker is beyond it, by how much is not known (see `beyond`), and not because nobody is there.
        """
        voice = self.voice(features.steady)
        if edge:
            return voice * BEYOND_NEAR * logistic(self.evidence(features))
        weights = self.score["first" if features.first else "further"]
        values = terms(features, weights, self.evidence(features))
        chance = logistic(sum(weight * term for weight, term in zip(weights.values(), values, strict=True)))
        return voice * near(features) * chance

    def borne_out(self, after: After, features: Features, *, edge: bool = False) -> float:
        """Return that probability as it is known by what the decisions after it found (see `probability`)."""
        weights, terms = self.after["first" if features.first else "further"], after_terms(after)
        logit = flattened(
            sum(weight * terms[name] for name, weight in weights.items() if name in terms), weights["middle"]
        )
        return min(logistic(logit), self.voice(features.steady) * (BEYOND_NEAR if edge else 1.0))

    def voice(self, steady: float) -> float:
        """Return the probability that what sounds so steadily, see Features, is no machine."""
        return 1.0 - logistic(self.machine["one"] + self.machine["steady"] * steady)

    def remembered(self, features: Features, kept: float) -> float:
        """Return how lasting a peak is: a mean over the decisions of its evidence, each from -4 to 2, plus 2.4.

        A peak that is weak but there again and again comes to count. A peak that stays without ever being likely, as
        a talker's echoes do, counts against itself. Each decision's evidence is its own, without what was remembered
        before: else what still rings in a room would keep alive for seconds who fell silent.

        Args:
            features: its own, and what was nearby before.
            kept: how much of that is kept, 0 to 1.
        """
        return kept * features.before + (1.0 - kept) * float(np.clip(self.own_evidence(features), -4.0, 2.0) + 2.4)

    def own_evidence(self, features: Features) -> float:
        """Return what speaks for a peak without what was remembered, as a logit."""
        weights = self.first if features.first else self.further
        return self.evidence(features) - weights["before"] * features.before

    def heard(self, features: Features) -> float:
        """Return how surely a voice is heard, not a machine, by a peak's own evidence, from 0 to 1."""
        return self.voice(features.steady) * min(max(1.0 - self.own_evidence(features) / NOTHING, 0.0), 1.0)

    def covariance(
        self, normal: np.ndarray, others: np.ndarray, features: Features, low: np.ndarray, high: np.ndarray
    ) -> np.ndarray:
        """Return the covariance (3, 3) m² of a position.

        Args:
            normal: (3, 3) JᵀWJ of the range differences about the position, with weights of mean 1.
            others: (3, 3) m², the spread of the places nearby and above that are answered nearly as well.
            features: see Features.
            low, high: (3,) m, corners of the searched volume: nothing is more uncertain than where in it the source is.
        """
        extent = np.maximum((np.asarray(high) - np.asarray(low)) / np.sqrt(12.0), FLOOR)
        weights = {part: np.array(list(self.spread[part].values())) for part in PARTS}
        for part, wider in self.widened.items():
            weights[part][0] += wider
        found = spread(weights, spread_terms(normal, others, features), normal, others, paths(features), extent)
        found = found * (UNCHECKED if features.channels < 4.5 else 1.0) + misplaced(normal, features.channels, extent)
        found = np.linalg.inv(np.linalg.inv(found) + np.diag((3.0 * extent) ** -2.0))
        return 0.5 * (found + found.T)

    def closed_form_probability(self, spread: float, valid: float, events: float, *, refined: bool) -> float:
        """Return the probability that a mean of closed-form solutions is within half a metre (x, y) of the talker.

        Args:
            spread: m, standard deviation of the solutions in x and y.
            valid: share of the closed-form solutions that were valid.
            events: how many events were averaged, for steps of a tenth of a second.
            refined: whether each event was fitted by maximum likelihood.
        """
        law = self.closed_form_refined if refined else self.closed_form
        term = closed_form_terms(spread, valid, events)
        return logistic(law.one + law.spread * term[1] + law.valid * term[2] + law.events * term[3])


@functools.cache
def fitted_law() -> Law:
    """Return the law that fitted.json holds."""
    return Law.of(json.loads((Path(__file__).parent / "fitted.json").read_bytes())["law"])


def terms(features: Features, weights: Mapping[str, float], evidence: float = 0.0) -> list[float]:
    """Return what the weights of a law's `first`, `further` or `score` are multiplied by, in their order.

    A constant, and the logarithms of the features of these names, but "before", "confirmed", "crowded", "strongest",
    "fall" and the evidence as they are, within bounds, the logit of "leading", and the root of "familiar". "few" is
    the share of the delays that a place uses up, from 1 with four channels to 0 with many; "few_residual" and its like
    are what it makes of another term, and "leading_relative" what "leading" makes of "relative".
    """
    few = min(3.0 / max(features.channels - 1.0, 3.0), 1.0)
    chance = min(max(features.leading, 0.0025), 0.9975)
    leading, relative = float(np.log(chance / (1.0 - chance))), max(_log(features.relative), -4.0)
    value = {
        "one": 1.0,
        "before": features.before,
        "confirmed": features.confirmed,
        "crowded": features.crowded,
        "leading": leading,
        "relative": relative,
        "leading_relative": leading * relative,
        "familiar": float(np.sqrt(features.familiar)),
        "evidence": float(np.clip(evidence, -6.0, 10.0)),
        "strongest": min(features.strongest, 3.0),
        "fall": max(features.fall, -30.0),
        "new": float(not features.strayed.any()),
        "doubted": features.doubted,
        "few": few,
        "few_residual": few * _log(features.residual),
        "few_dilution": few * _log(features.dilution),
        "few_support": few * _log(features.support),
    }
    return [value[name] if name in value else _log(getattr(features, name)) for name in weights]


def after_terms(after: After) -> dict[str, float]:
    """Return what the weights of a law's `after` but "middle" are multiplied by."""
    chance = min(max(after.score, 1e-3), 1.0 - 1e-3)
    score = float(np.log(chance / (1.0 - chance)))
    again = float(np.mean(after.again))
    return {"one": 1.0, "score": score, "doubt": min(score, 0.0), "again": again, "sought": float(after.sought)}


def flattened(logit: Any, middle: float) -> Any:
    """Return logits, numbers or arrays, less `middle` times themselves within `MIDDLE`: undecided peaks are a mixture
    of a few talkers and many ghosts, whose odds change little there."""
    return logit - middle * np.clip(logit, -MIDDLE, MIDDLE)


def near(features: Features) -> float:
    """Return the probability that a peak of somebody is near him; of the first one the score's other terms tell it."""
    return 1.0 if features.first else 1.0 / (1.0 + features.dilution / HALFWAY)


def dilution(normal: np.ndarray) -> float:
    """Return by how much errors of range differences grow into errors in x and y, along the worse axis.

    Args:
        normal: (3, 3) JᵀWJ of the range differences, with weights of mean 1.
    """
    grown = np.linalg.inv(normal + 1e-6 * np.eye(3))
    level, across = 0.5 * (grown[0, 0] + grown[1, 1]), 0.5 * (grown[0, 0] - grown[1, 1])
    return float(np.sqrt(level + np.hypot(across, grown[0, 1])))


def closed_form_terms(spread: float, valid: float, events: float) -> list[float]:
    """Return what the four weights of a `ClosedForm` are multiplied by (arguments as `Law.closed_form_probability`)."""
    return [1.0, float(np.log(max(spread, 1e-3))), float(np.log(valid + 0.01)), float(np.log(events))]


def spread_terms(normal: np.ndarray, others: np.ndarray, features: Features) -> dict[str, np.ndarray]:
    """Return what the weights of each part of a law's `spread` are multiplied by, in their order.

    Args:
        normal, others: as for `Law.covariance`.
        features: see Features.
    """
    dilution = np.linalg.inv(normal + 1e-6 * np.eye(3))
    speed, pace = np.hypot(*features.velocity[:2]), np.hypot(*features.pace[:2])
    term = {
        "one": 1.0,
        "residual": np.log(max(features.residual, 3e-4)),
        "dilution": 0.5 * np.log(0.5 * (dilution[0, 0] + dilution[1, 1])),
        "heights": np.log(np.sqrt(others[2, 2]) + 0.003),
        "places": np.log(np.sqrt(0.5 * (others[0, 0] + others[1, 1])) + 0.003),
        "strayed": np.log(max(np.hypot(*features.strayed[:2]), 0.002)),
        "climbed": np.log(max(abs(features.strayed[2]), 0.002)),
        "new": float(not features.strayed.any()),
        "agreement": np.log(max(features.agreement, 0.02)),
        "support": np.log(max(features.support, 0.02)),
        "strongest": features.strongest,
        "pace": np.log(max(speed, pace) + 0.1),
        "moves": float(speed > 0.05),
    }
    return {part: np.array([term[name] for name in weights]) for part, weights in PARTS.items()}


def paths(features: Features) -> np.ndarray:
    """Return v vᵀ summed over the velocities that a peak seems to have, (3, 3) m²/s²."""
    return np.sum([np.outer(v, v) for v in (features.velocity, features.pace, features.gait)], axis=0)


def spread(
    weights: Mapping[str, np.ndarray],
    terms: Mapping[str, np.ndarray],
    normal: np.ndarray,
    others: np.ndarray,
    motion: np.ndarray,
    extent: np.ndarray,
) -> np.ndarray:
    """Return covariances (..., 3, 3) m², the sums of the parts that `PARTS` names.

    Args:
        weights: (k,) for each part.
        terms: (..., k) for each part.
        normal, others: (..., 3, 3) as for `Law.covariance`.
        motion: (..., 3, 3) m²/s², see `paths`.
        extent: (..., 3) m, the standard deviation of what was not observed.
    """
    factor = {part: np.exp(2.0 * np.clip(terms[part] @ weights[part], -12.0, 3.0))[..., None, None] for part in weights}
    result = np.linalg.inv(normal / factor["peaks"] + np.eye(3) * (extent**-2.0)[..., None]) + FLOOR**2 * np.eye(3)
    result = result + factor["lattice"] * others + factor["motion"] * motion
    return result + factor["level"] * np.diag([1.0, 1.0, 0.0]) + factor["height"] * np.diag([0.0, 0.0, 1.0])


def misplaced(normal: np.ndarray, channels: float, extent: np.ndarray) -> np.ndarray:
    """Return the covariance (3, 3) m² of a position by the errors of the places of the microphones.

    Args:
        normal: (3, 3) JᵀWJ of the range differences of all pairs, with weights of mean 1: that of the single ranges and
            a common time, times the number of channels.
        channels: how many there are.
        extent: (3,) m, the standard deviation of what was not observed.
    """
    return np.asarray(np.linalg.inv(normal / (MISPLACED_M**2 * channels) + np.diag(extent**-2.0)))


def beyond(edge: np.ndarray) -> np.ndarray:
    """Return what is added to a covariance, (3, 3) m², where the search ended on the edge of its volume.

    Args:
        edge: (3,) bool, on which axes; there the source may be outside.
    """
    return np.diag(np.where(edge, BEYOND_M, 0.0) ** 2)


def _log(value: float) -> float:
    return float(np.log(max(value, 1e-3)))


def logistic(value: float) -> float:
    """Return the probability of log odds, which are held within 30."""
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -30.0, 30.0))))
