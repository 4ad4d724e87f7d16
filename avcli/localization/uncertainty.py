"""How far a detection may be believed: the probability that it is right and its covariance.

The coefficients are fitted, by maximum likelihood, on rooms of T60 0.1 to 0.8 s, SNR 30 and 10 dB, with one or two
talkers who stand or walk (`make bench-localization` refits and checks them on others).
"""

from dataclasses import dataclass

import numpy as np

FLOOR = 0.001
"""m: the standard deviation that no localization undercuts."""

FIRST = {"one": 1.23, "response": 4.41, "agreement": 4.89, "before": 0.63}
FURTHER = {"one": 1.82, "response": 2.37, "own": 9.07, "support": 3.57, "before": 1.25}
"""Logit of the probability that a decision's first peak, or a further one, is within half a metre (x, y) of a talker,
on the logarithms of its features, and on how lasting it is."""

MEMORY = 0.28
"""s: how long a decision counts in the later ones."""

SPREAD = {"one": 3.73, "response": 1.21, "agreement": -4.36, "residual": 2.27}
"""Logarithm of the standard deviation (m) of a range difference, on the logarithms of the features."""

MOTION = 0.054
"""s: standard deviation in x and y of a walker's place over his speed: he is elsewhere at the windows' ends."""

STRAYED = 0.34
"""Share of how far a peak is from where it was a decision ago, had it moved as it seems to: the velocity is wrong, or
one of the places is."""

SHARPNESS = 8.0
"""Logarithm of a height's likelihood over the response there, in standard deviations of a GCC of noise."""

CLOSED_FORM = {False: (1.65, -0.70, 0.95, 1.36), True: (-1.99, -1.65, 1.19, 4.07)}
"""Logit of the probability that a mean of closed forms is right, without and with their refinement: constant, and
weights of the logarithms of spread, valid share and events."""

CLOSED_FORM_FLOOR = 0.1
"""m: the standard deviation that a mean of closed-form solutions does not undercut, whatever their scatter says."""


@dataclass(frozen=True)
class Features:
    """What a steered response tells about its own peak.

    Attributes:
        response: the peak over the largest response to be expected of noise alone.
        agreement: mean over the pairs of microphones of their GCC at the place, cut off at 3 standard deviations of
            noise on either side, over these; from 0 to 1.
        support: share of the pairs that have a peak near the place, from 0 to 1.
        before: how lasting it is: see `remembered`, of what was nearby in the decision before.
        first: whether it is the decision's first peak.
        own: share of the frequencies' agreement on the peak that is not better on a peak before it, from 0 to 1; an
            echo of the first talker has little.
        speed: m/s.
        residual: m, root mean square of how far the pairs' peaks are from the place in range difference, each cut off
            at 2 cm: where few pairs agree, a robust fit to them alone would seem perfect.
        strayed: (3,) m, from where it was in the decision before, had it moved as it seems to; 0 where it is new.
    """

    response: float
    agreement: float
    support: float
    before: float
    first: bool
    own: float
    speed: float
    residual: float
    strayed: np.ndarray


def terms(features: Features) -> list[float]:
    """Return what the weights of FIRST, or of FURTHER, are multiplied by, in their order."""
    names = [name for name in (FIRST if features.first else FURTHER) if name not in ("one", "before")]
    return [1.0, *(float(np.log(max(getattr(features, name), 1e-3))) for name in names), features.before]


def logit(features: Features) -> float:
    """Return the logit of the probability that a peak is within half a metre (x, y) of a talker."""
    weights = (FIRST if features.first else FURTHER).values()
    return sum(weight * term for weight, term in zip(weights, terms(features), strict=True))


def remembered(features: Features, kept: float) -> float:
    """Return how lasting a peak is: a mean over the decisions of the logits that it is right, from -4 to 2, plus 2.4.

    Who is weak but there again and again comes to count; what stays without ever being likely, as a talker's echoes
    do, counts against itself.

    Args:
        features: its own, and what was nearby before.
        kept: how much of that is kept, 0 to 1.
    """
    return kept * features.before + (1.0 - kept) * float(np.clip(logit(features), -4.0, 2.0) + 2.4)


def probability(features: Features) -> float:
    """Return the probability that a peak is within half a metre (x, y) of a talker."""
    return float(1.0 / (1.0 + np.exp(-np.clip(logit(features), -30.0, 30.0))))


def spread_terms(features: Features) -> list[float]:
    """Return what the weights of SPREAD are multiplied by, in their order."""
    response, agreement = max(features.response, 1e-3), max(features.agreement, 0.02)
    return [1.0, float(np.log(response)), float(np.log(agreement)), float(np.log(max(features.residual, 3e-4)))]


def covariance(normal: np.ndarray, features: Features, low, high) -> np.ndarray:
    """Return the covariance (3, 3) m² of a position.

    Args:
        normal: (3, 3) JᵀWJ of the range differences about the position, with weights of mean 1.
        features: see Features; they set the standard deviation of one range difference.
        low, high: (3,) m, corners of the searched volume: an axis that was not observed is as uncertain as the volume.
    """
    sigma = np.exp(np.clip(np.dot(list(SPREAD.values()), spread_terms(features)), -12.0, 3.0))
    extent = np.maximum((np.asarray(high) - np.asarray(low)) / np.sqrt(12.0), FLOOR)
    spread = np.linalg.inv(normal / sigma**2 + np.diag(extent**-2.0)) + FLOOR**2 * np.eye(3)
    level = (MOTION * features.speed) ** 2 + STRAYED**2 * (features.strayed[0] ** 2 + features.strayed[1] ** 2)
    spread[[0, 1, 2], [0, 1, 2]] += [level, level, (STRAYED * features.strayed[2]) ** 2]
    return 0.5 * (spread + spread.T)


def beyond(edge: np.ndarray) -> np.ndarray:
    """Return what is added to a covariance, (3, 3) m², where the search ended on the edge of its volume.

    Args:
        edge: (3,) bool, on which axes; there the source may be outside.
    """
    return np.diag(np.where(edge, [0.5, 0.5, 0.3], 0.0) ** 2)


def closed_form_probability(spread: float, valid: float, events: float, *, refined: bool) -> float:
    """Return the probability that a mean of closed-form solutions is within half a metre (x, y) of the talker.

    Args:
        spread: m, standard deviation of the solutions in x and y.
        valid: share of the closed-form solutions that were valid.
        events: how many events were averaged, for steps of a tenth of a second.
        refined: whether each event was fitted by maximum likelihood.
    """
    one, on_spread, on_valid, on_events = CLOSED_FORM[refined]
    value = one + on_spread * np.log(max(spread, 1e-3)) + on_valid * np.log(valid + 0.01) + on_events * np.log(events)
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -30.0, 30.0))))
