"""How far a detection may be believed: the probability that it is right and its covariance.

The coefficients are fitted, by maximum likelihood, on rooms of T60 0.1 to 0.8 s, SNR 30 and 10 dB, with one or two
talkers who stand or walk (`make bench-localization` refits and checks them on others).
"""

from dataclasses import dataclass

import numpy as np

FLOOR = 0.003
"""m: the standard deviation that no localization undercuts (where the microphones are, how warm the air is)."""

RIGHT = {"one": 0.81, "response": -0.25, "support": 3.36, "evidence": 2.38, "share": 1.72, "own": 4.90}
"""Logit of the probability that a peak is within half a metre (x, y) of a talker, on the logarithms of its features."""

SPREAD = {"one": -2.67, "response": -0.80, "support": -4.77}
"""Logarithm of the standard deviation (m) of a range difference, on the logarithms of the features."""

MOTION = np.array([0.044, 0.044, 0.15])
"""s: standard deviation (x, y, z) of a walker's place over his speed: he is elsewhere at the windows' ends, and what
they share may be a wrong height."""


CLOSED_FORM = {False: (1.65, -0.70, 0.95, 1.36), True: (-1.99, -1.65, 1.19, 4.07)}
"""The same for a mean of closed forms, without and with their refinement: constant, spread, valid share, events."""

CLOSED_FORM_FLOOR = 0.1
"""m: the standard deviation that a mean of closed-form solutions does not undercut, whatever their scatter says."""


@dataclass(frozen=True)
class Features:
    """What a steered response tells about its own peak.

    Attributes:
        response: the peak over the largest response to be expected of noise alone.
        support: share of the pairs of microphones that agree, from 0 to 1.
        evidence: logarithm of the response, with what was nearby in the decisions before (see `accumulate`).
        share: the peak over the decision's first.
        own: share of the frequencies' agreement on the peak that is not better on a peak before it, from 0 to 1; an
            echo of the first talker has little.
        speed: m/s.
    """

    response: float
    support: float
    evidence: float
    share: float
    own: float
    speed: float


def accumulate(response: float, before: float) -> float:
    """Return the evidence of a peak: its own, and a share of that of the peak nearby one decision ago.

    Args:
        response: the peak over the response to noise.
        before: the evidence of the peak nearby, 0 where there was none.
    """
    return max(float(np.log(response)), 0.0) + 0.6 * before


def probability(features: Features) -> float:
    """Return the probability that a peak is within half a metre (x, y) of a talker, by logistic regression."""
    value = (
        RIGHT["one"]
        + RIGHT["response"] * np.log(max(features.response, 1e-3))
        + RIGHT["support"] * np.log(max(features.support, 1e-3))
        + RIGHT["evidence"] * features.evidence
        + RIGHT["share"] * min(np.log(max(features.share, 1e-3)), 0.0)
        + RIGHT["own"] * np.log(max(features.own, 1e-3))
    )
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -30.0, 30.0))))


def covariance(normal: np.ndarray, features: Features, low, high) -> np.ndarray:
    """Return the covariance (3, 3) m² of a position.

    Args:
        normal: (3, 3) JᵀWJ of the range differences about the position, with weights of mean 1.
        features: see Features; they set the standard deviation of one range difference.
        low, high: (3,) m, corners of the searched volume: an axis that was not observed is as uncertain as the volume.
    """
    sigma = np.exp(
        SPREAD["one"]
        + SPREAD["response"] * np.log(max(features.response, 1e-3))
        + SPREAD["support"] * np.log(max(features.support, 1e-3))
    )
    extent = np.maximum((np.asarray(high) - np.asarray(low)) / np.sqrt(12.0), FLOOR)
    spread = np.linalg.inv(normal / sigma**2 + np.diag(extent**-2.0)) + FLOOR**2 * np.eye(3)
    spread += np.diag((MOTION * features.speed) ** 2)
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
