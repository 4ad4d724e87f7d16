"""How far a detection may be believed: the probability that it is right and its covariance."""

from dataclasses import dataclass

import numpy as np

FLOOR = 0.003
"""m: the standard deviation that no localization undercuts (where the microphones are, how warm the air is)."""


@dataclass(frozen=True)
class Features:
    """What a steered response tells about its own peak.

    Attributes:
        response: the peak over the largest response to be expected of noise alone.
        contrast: the peak over the largest response elsewhere in the room.
        residual: m, robust rms of the range differences about the position.
        rank: 0 for the first talker of a decision, 1 for the second...
    """

    response: float
    contrast: float
    residual: float
    rank: int


def probability(features: Features) -> float:
    """Return the probability that a peak is within half a metre (x, y) of a talker, by logistic regression."""
    response, contrast = np.log(max(features.response, 1e-6)), np.log(max(features.contrast, 1e-6))
    value = -1.0 + 4.0 * response + 4.0 * contrast - 1.0 * min(features.rank, 1)
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -30.0, 30.0))))


def covariance(normal: np.ndarray, features: Features, low, high) -> np.ndarray:
    """Return the covariance (3, 3) m² of a position.

    Args:
        normal: (3, 3) JᵀWJ of the range differences about the position, with weights of any scale.
        features: see Features; they set the standard deviation of one range difference.
        low, high: (3,) m, corners of the searched volume: an axis that was not observed is as uncertain as the volume.
    """
    sigma = np.exp(-3.0 - 1.0 * np.log(max(features.response, 1e-6)))
    extent = np.maximum((np.asarray(high) - np.asarray(low)) / np.sqrt(12.0), FLOOR)
    spread = np.linalg.inv(normal / sigma**2 + np.diag(extent**-2.0)) + FLOOR**2 * np.eye(3)
    return 0.5 * (spread + spread.T)


def closed_form_probability(spread: float, residual: float) -> float:
    """Return the probability that a mean of closed-form solutions is within half a metre (x, y) of the talker.

    Args:
        spread: m, standard deviation of the solutions in x and y.
        residual: m, rms of the range differences about the mean.
    """
    value = -2.0 - 1.5 * np.log(max(spread, 1e-3)) - 0.5 * np.log(max(residual, 1e-3))
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -30.0, 30.0))))
