"""How far a detection may be believed: the probability that it is right and its covariance.

The coefficients are fitted, by maximum likelihood, on rooms of T60 0.1 to 0.8 s, SNR 30 and 10 dB, with one or two
talkers who stand or walk (`make bench-localization` refits and checks them on others).
"""

from dataclasses import dataclass

import numpy as np

FLOOR = 0.0005
"""m: the standard deviation that no localization undercuts."""

FIRST = {"one": 1.23, "response": 4.41, "agreement": 4.89, "before": 0.63}
FURTHER = {"one": 1.82, "response": 2.37, "own": 9.07, "support": 3.57, "before": 1.25}
"""Logit of the probability that a decision's first peak, or a further one, is within half a metre (x, y) of a talker,
on the logarithms of its features, and on how lasting it is."""

MEMORY = 0.28
"""s: how long a decision counts in the later ones."""

SPREAD = {
    "peaks": {"one": 2.20, "residual": 1.20, "dilution": 0.55, "pace": 0.17},
    "lattice": {"one": 0.09, "heights": 0.09},
    "motion": {"one": -5.00, "strongest": 0.78, "agreement": -1.54},
    "level": {
        "one": 5.06,
        "heights": 1.00,
        "places": -0.87,
        "strayed": 0.23,
        "new": 2.58,
        "residual": 2.25,
        "moves": 0.30,
        "agreement": -0.85,
    },
    "height": {"one": 0.32, "heights": 0.46, "climbed": 0.79, "support": 1.54},
}
"""A covariance is the sum of five parts, and this the logarithm of each part's standard deviation on its terms: m of a
range difference, a factor of what other places nearby add, s along the path, m in x and y, m in z.

Errors have heavier tails than the Gaussian that is fitted: so that the ellipses of who walks hold what they should,
`motion` is a half and `level` a seventh wider than the likelihood has them."""

SHARPNESS = 8.0
"""Logarithm of a place's likelihood over the response there, in standard deviations of a GCC of noise."""

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
        velocity: (3,) m/s.
        residual: m, root mean square of how far the pairs' peaks are from the place in range difference, each cut off
            at 2 cm: where few pairs agree, a robust fit to them alone would seem perfect.
        strayed: (3,) m, from where it was in the decision before, had it moved as it seems to; 0 where it is new.
        pace: (3,) m/s, the level velocity at which it came here from where it was in the decision before; its velocity
            where it is new.
        gait: (3,) m/s, its velocity as the decisions before have it, the latest counting most; its own where it is new.
            What still sounds of one who fell silent stands where he was, and he walks on.
        strongest: the best of the windows' responses over their mean: where one window alone answers, nothing averages.
    """

    response: float
    agreement: float
    support: float
    before: float
    first: bool
    own: float
    velocity: np.ndarray
    residual: float
    strayed: np.ndarray
    pace: np.ndarray
    gait: np.ndarray
    strongest: float


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


def spread_terms(normal: np.ndarray, others: np.ndarray, features: Features) -> dict[str, np.ndarray]:
    """Return what the weights of each part of SPREAD are multiplied by, in their order.

    Args:
        normal, others: as for `covariance`.
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
    return {part: np.array([term[name] for name in weights]) for part, weights in SPREAD.items()}


def paths(features: Features) -> np.ndarray:
    """Return v vᵀ summed over the velocities that a peak seems to have, (3, 3) m²/s²."""
    return sum(np.outer(velocity, velocity) for velocity in (features.velocity, features.pace, features.gait))


def spread(weights: dict, terms: dict, normal, others, motion, extent) -> np.ndarray:
    """Return covariances (..., 3, 3) m², the sums of the parts that SPREAD names.

    Args:
        weights: (k,) for each part.
        terms: (..., k) for each part.
        normal, others: (..., 3, 3) as for `covariance`.
        motion: (..., 3, 3) m²/s², see `paths`.
        extent: (3,) m, the standard deviation of what was not observed.
    """
    factor = {part: np.exp(2.0 * np.clip(terms[part] @ weights[part], -12.0, 3.0))[..., None, None] for part in weights}
    result = np.linalg.inv(normal / factor["peaks"] + np.diag(extent**-2.0)) + FLOOR**2 * np.eye(3)
    result = result + factor["lattice"] * others + factor["motion"] * motion
    return result + factor["level"] * np.diag([1.0, 1.0, 0.0]) + factor["height"] * np.diag([0.0, 0.0, 1.0])


def covariance(normal: np.ndarray, others: np.ndarray, features: Features, low, high) -> np.ndarray:
    """Return the covariance (3, 3) m² of a position.

    Args:
        normal: (3, 3) JᵀWJ of the range differences about the position, with weights of mean 1.
        others: (3, 3) m², the spread of the places nearby and above that are answered nearly as well.
        features: see Features.
        low, high: (3,) m, corners of the searched volume: nothing is more uncertain than where in it the source is.
    """
    extent = np.maximum((np.asarray(high) - np.asarray(low)) / np.sqrt(12.0), FLOOR)
    weights = {part: np.array(list(names.values())) for part, names in SPREAD.items()}
    found = spread(weights, spread_terms(normal, others, features), normal, others, paths(features), extent)
    found = np.linalg.inv(np.linalg.inv(found) + np.diag((3.0 * extent) ** -2.0))
    return 0.5 * (found + found.T)


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
