"""Gaussian mixtures over [x, y, vx, vy]: prediction, likelihood and update of many at once, closed-form 2 x 2 algebra.

Shapes: n densities of M motion models each: mean (n, M, 4), cov (n, M, 4, 4), mode (n, M) probabilities.
"""

import math
from typing import NamedTuple

import numpy as np

from avcli.tracking.motion import Motion

EYE2 = np.eye(2)
COFACTOR = np.array([[1.0, -1.0], [-1.0, 1.0]])
UPPER = np.array([0, 1, 3])  # of a 2 x 2 matrix: along x, across, along y
POSITION = np.array([0, 1, 5])  # the same of a 4 x 4 matrix
ADJUGATE, SIGNS = np.array([2, 1, 1, 0]), np.array([1.0, -1.0, -1.0, 1.0])  # of the inverse, from these three
LOG_2_PI = 1.8378770664093453
_TURNS = np.arange(16) * (math.pi / 16)
AROUND = np.array([np.cos(_TURNS), np.sin(_TURNS)])  # 16 directions, (2, 16)
TAILS = 4.0  # by likelihood 3.7 of tracks in films by colour that state over .3 m, and 3 in drawn rooms
LEAST_SHARED = -0.5  # of a variance: a detection never pushes a position away


class Prediction(NamedTuple):
    """Densities some time later.

    Attributes:
        mean, cov, mode: the prediction.
        cross: (n, M, 4, 4) covariance of the states before and after within each model, about its mixed mean.
        mixed: (n, M, 4) mean of each model after mixing and before the step.
    """

    mean: np.ndarray
    cov: np.ndarray
    mode: np.ndarray
    cross: np.ndarray
    mixed: np.ndarray


def begin(z: np.ndarray, noise: np.ndarray, motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return densities of people of whom nothing but one detection is known.

    Args:
        z: (n, 2) m.
        noise: (n, 2, 2) m².
        motion: M models.

    Returns:
        mean (n, M, 4), cov (n, M, 4, 4) and mode (n, M).
    """
    models, velocities = motion.start
    n, m = len(z), len(models)
    mean, cov = np.zeros((n, m, 4)), np.zeros((n, m, 4, 4))
    mean[..., :2], cov[..., :2, :2], cov[..., 2:, 2:] = z[:, None], noise[:, None], velocities
    return mean, cov, np.tile(models, (n, 1))


def predict(mean: np.ndarray, cov: np.ndarray, mode: np.ndarray, motion: Motion, dt: float) -> Prediction:
    """Mix the models and predict each, as the interacting multiple model filter does.

    Args:
        mean: (n, M, 4).
        cov: (n, M, 4, 4).
        mode: (n, M) probabilities.
        motion: M models.
        dt: s.

    Returns:
        The prediction, and what smoothing needs of the step.

    Source:
        H. A. P. Blom and Y. Bar-Shalom, "The interacting multiple model algorithm for systems with Markovian switching
        coefficients", IEEE TAC 33(8), 1988.
    """
    f, q, switch = motion.step(dt)
    if mode.shape[1] > 1:
        after = mode @ switch
        weight = mode[:, None] * switch.T / after[..., None]  # (n, to, from)
        mixed = weight @ mean
        spread = (mean[:, None] - mixed[:, :, None]) * np.sqrt(weight)[..., None]  # (n, to, from, 4)
        cov = (weight @ cov.reshape(*cov.shape[:2], 16)).reshape(cov.shape) + spread.swapaxes(2, 3) @ spread
        mean, mode = mixed, after
    moved = (f @ mean[..., None])[..., 0]
    half = f @ cov
    cov = half @ f.swapaxes(1, 2).copy() + q  # a product with a transposed view takes twice as long
    return Prediction(moved, symmetric(cov), mode, half.swapaxes(2, 3), mean)


def symmetric(cov: np.ndarray) -> np.ndarray:
    """Return covariances (..., k, k) without what rounding made of their symmetry; the argument is lost."""
    cov = cov + cov.swapaxes(-1, -2)
    cov *= 0.5
    return cov


def expected_detection(mean: np.ndarray, cov: np.ndarray, mouth_offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Predict where a sensor should detect people whose mouth is in front of the body's axis.

    The direction is that of walking as far as it is known: velocity over its root mean square, so that it vanishes for
    a person who stands.

    Args:
        mean: (n, M, 4).
        cov: (n, M, 4, 4).
        mouth_offset: m.

    Returns:
        Positions (n, M, 2) m and the variance (n, M) m² per axis that the unknown part of the direction adds.
    """
    vx, vy = mean[..., 2], mean[..., 3]
    unknown = cov[..., 2, 2] + cov[..., 3, 3] + 1e-12
    energy = vx * vx + vy * vy + unknown
    ahead = mean[..., 2:] * (mouth_offset / np.sqrt(energy))[..., None]
    return mean[..., :2] + ahead, mouth_offset * mouth_offset / 2 * unknown / energy


def loglikelihood(expected: np.ndarray, z: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the log likelihood of each detection under each model of each density.

    Args:
        expected: (n, M, 6), see `innovation`.
        z: (J, 2) m.
        noise: (J, 2, 2) m².

    Returns:
        The log likelihoods (n, M, J), and the squared Mahalanobis distances (n, M, J).
    """
    expected = expected.transpose(2, 0, 1)[..., None].copy()  # number by number, in which arrays are a third faster
    xy = z.T[:, None, None] - expected[:2]
    return log_normal(*xy, *(expected[2:5] + noise.reshape(-1, 4).T.take(UPPER, 0)[:, None, None]))


def innovation(
    mean: np.ndarray, cov: np.ndarray, mouth_offset: float = 0.0, unshared: np.ndarray | None = None
) -> np.ndarray:
    """Predict what a sensor should detect.

    Args:
        mean: (n, M, 4).
        cov: (n, M, 4, 4).
        mouth_offset: m, see `expected_detection`.
        unshared: (n,) m², variance per axis of what the detections' errors have in common with each other and not
            with the density.

    Returns:
        (n, M, 6): position x and y in m; variance along x, covariance, and variance along y in m², without the noise;
        that part of the variances in m² which comes from where the mouth is.
    """
    expected = np.zeros((*mean.shape[:2], 6))
    expected[..., 2:5] = cov.reshape(*cov.shape[:2], 16).take(POSITION, 2)
    if mouth_offset:
        expected[..., :2], expected[..., 5] = expected_detection(mean, cov, mouth_offset)
        expected[..., 2:5:2] += expected[..., 5:]
    else:
        expected[..., :2] = mean[..., :2]
    if unshared is not None:
        expected[..., 2:5:2] += unshared[:, None, None]
    return expected


def log_normal(
    dx: np.ndarray, dy: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return log density and squared Mahalanobis distance of differences from the mean; all arrays have one shape.

    dx, dy: m; xx, xy, yy: m², of the covariance.
    """
    det = xx * yy - xy * xy
    distance = ((yy * dx - 2 * xy * dy) * dx + xx * dy * dy) / det
    return -0.5 * (distance + np.log(det)) - LOG_2_PI, distance


def update(
    mean: np.ndarray,
    cov: np.ndarray,
    mode: np.ndarray,
    z: np.ndarray,
    noise: np.ndarray,
    expected: np.ndarray | None = None,
    likelihood: np.ndarray | None = None,
    shared: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Update density k by detection k: K = P Hᵀ S⁻¹, and P⁺ = (I - K H) P (I - K H)ᵀ + K R Kᵀ in each model.

    The covariance is in Joseph's form, which keeps it symmetric and positive.

    Args:
        mean: (n, M, 4).
        cov: (n, M, 4, 4).
        mode: (n, M).
        z: (n, 2) m.
        noise: (n, 2, 2) m².
        expected: (n, M, 6) of the densities, see `innovation`; None: the sensor detects the body's axis.
        likelihood: (n, M) of the detections in each model, if that is known already.
        shared: (n,) m² per axis, of errors that last: the covariance of the density with the innovation that they add,
            see `errors.Between`.

    Returns:
        mean, cov and mode after the update.
    """
    if expected is None:
        expected = innovation(mean, cov)
    spread = expected[..., 2:5] + noise.reshape(-1, 1, 4).take(UPPER, 2)
    xx, xy, yy = spread[..., 0], spread[..., 1], spread[..., 2]
    det = xx * yy - xy * xy
    inverse = (spread.take(ADJUGATE, 2) * (SIGNS / det[..., None])).reshape(*det.shape, 2, 2)
    gain = cov[..., :2] @ inverse  # (n, M, 4, 2)
    if shared is not None:
        gain[..., :2, :] += np.maximum(shared[:, None], LEAST_SHARED * cov[..., 0, 0])[..., None, None] * inverse
    d = (z[:, None] - expected[..., :2])[..., None]
    if mode.shape[1] > 1:
        if likelihood is None:
            log = -0.5 * ((d.swapaxes(-1, -2) @ inverse @ d)[..., 0, 0] + np.log(det))
            likelihood = np.exp(log - log.max(1, keepdims=True)) + 1e-12
        mode = mode * likelihood
        mode = mode / np.add.reduce(mode, 1, keepdims=True) + 1e-12
    mean = mean + (gain @ d)[..., 0]
    keep = cov - gain @ cov[..., :2, :]
    noise = noise[:, None] + expected[..., 5, None, None] * EYE2
    return mean, symmetric(keep + (gain @ noise - keep[..., :2]) @ gain.swapaxes(-1, -2).copy()), mode


def odds_within(cov: np.ndarray, radius: float) -> list[float]:
    """Return the odds that errors of covariance (n, 2, 2) m², as if isotropic, are within a radius in m; at most 1."""
    trace = np.maximum(cov[:, 0, 0] + cov[:, 1, 1], 1e-12)
    return np.expm1(np.minimum(radius * radius / trace, math.log(2))).tolist()


def within(mean: np.ndarray, cov: np.ndarray, mode: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Compute the probability (n,) that each position lies within a distance of a point.

    Each model counts as an isotropic Gaussian around the point with the second moment that it has there.

    Args:
        mean: (n, M, 4).
        cov: (n, M, 4, 4).
        mode: (n, M).
        centre: (n, 2) m.
        radius: (n,) m.
    """
    away = mean[..., :2] - centre[:, None]
    away *= away
    second = cov[..., 0, 0] + cov[..., 1, 1] + away[..., 0] + away[..., 1]
    return np.minimum(-np.add.reduce(mode * np.expm1((radius * -radius)[:, None] / second), 1), 1.0)


def near(cov: np.ndarray, radius: float) -> np.ndarray:
    """Compute the probability (n,) that errors of places, of covariances (n, 2, 2) m², are shorter than a radius in m.

    Errors of places have long tails: they are Student's, with `TAILS` degrees of freedom. An ellipse that is long and
    thin, as along a line of sight, is not taken for a circle: the probability is the mean over all directions.

    >>> near(np.array([np.diag([0.5, 0.5]), np.diag([1.0, 0.0])]), 1.0).round(2).tolist()
    [0.75, 0.77]
    """
    variance = np.add.reduce(AROUND * (cov @ AROUND), 1) * ((TAILS - 2) / TAILS)
    return 1 - ((1 + radius * radius / (TAILS * np.maximum(variance, 1e-12))) ** (-TAILS / 2)).mean(1)


def places(mean: np.ndarray, cov: np.ndarray, mode: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean position (n, 2) m of each density, and its mean square error (n,) m²."""
    centre = (mode[:, None] @ mean[..., :2])[:, 0]
    away = mean[..., :2] - centre[:, None]
    away *= away
    second = cov[..., 0, 0] + cov[..., 1, 1] + away[..., 0] + away[..., 1]
    return centre, np.add.reduce(mode * second, 1)


def moments(mean: np.ndarray, cov: np.ndarray, mode: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (n, 4) and covariance (n, 4, 4) of each density's mixture over its models.

    >>> mean, cov = np.array([[[0.0] * 4, [2.0, 0.0, 0.0, 0.0]]]), np.tile(np.eye(4), (1, 2, 1, 1))
    >>> centre, spread = moments(mean, cov, np.array([[0.5, 0.5]]))
    >>> centre[0].tolist(), spread[0].diagonal().round(12).tolist()
    ([1.0, 0.0, 0.0, 0.0], [2.0, 1.0, 1.0, 1.0])
    """
    if mode.shape[1] == 1:
        return mean[:, 0], cov[:, 0]
    centre = (mode[:, None] @ mean)[:, 0]
    spread = (mean - centre[:, None]) * np.sqrt(mode)[..., None]
    inside = (mode[:, None] @ cov.reshape(*cov.shape[:2], 16)).reshape(-1, 4, 4)
    return centre, inside + spread.transpose(0, 2, 1) @ spread
