"""Gaussian mixtures over [x, y, vx, vy]: prediction, likelihood and update of many at once, closed-form 2 x 2 algebra.

Shapes: n densities of M motion models each: mean (n, M, 4), cov (n, M, 4, 4), mode (n, M) probabilities.
"""

import numpy as np

EYE2 = np.eye(2)
COFACTOR = np.array([[1.0, -1.0], [-1.0, 1.0]])


def predict(mean, cov, mode, motion, dt):
    """IMM mixing and prediction (Blom and Bar-Shalom 1988).

    mean (n, M, 4), cov (n, M, 4, 4), mode (n, M); motion: Motion; dt: seconds.
    Returns (mean, cov, mode, cross): the prediction and cross (n, M, 4, 4) = cov(x before, x after) within each model
    about that model's mixed mean, with the mixed mean (n, M, 4) as last element.
    """
    f, q, switch = motion.step(dt)
    if mode.shape[1] > 1:
        joint = mode[:, :, None] * switch  # (n, from, to)
        after = mode @ switch
        weight = (joint / after[:, None]).transpose(0, 2, 1)  # (n, to, from)
        mixed = weight @ mean
        spread = (mean[:, None] - mixed[:, :, None]) * np.sqrt(weight)[..., None]  # (n, to, from, 4)
        cov = (weight @ cov.reshape(*cov.shape[:2], 16)).reshape(cov.shape) + spread.transpose(0, 1, 3, 2) @ spread
        mean, mode = mixed, after
    moved = (f @ mean[..., None])[..., 0]
    half = f @ cov
    cov = half @ f.transpose(0, 2, 1) + q
    return moved, (cov + cov.swapaxes(-1, -2)) / 2, mode, half.swapaxes(-1, -2), mean


def detected(mean, cov, lead):
    """Where a sensor should find people, `lead` metres in front of the body's axis (a mouth).

    The direction is that of walking as far as it is known: velocity over its root mean square, so that it vanishes for
    someone who stands. mean (n, M, 4), cov (n, M, 4, 4).
    Returns place (n, M, 2) and the variance (n, M) per axis that the unknown part of the direction adds.
    """
    vx, vy = mean[..., 2], mean[..., 3]
    unknown = cov[..., 2, 2] + cov[..., 3, 3] + 1e-12
    energy = vx * vx + vy * vy + unknown
    return mean[..., :2] + mean[..., 2:] * (lead / np.sqrt(energy))[..., None], lead * lead / 2 * unknown / energy


def loglikelihood(mean, cov, z, noise, lead=0.0):
    """Log likelihood of each detection under each model of each density, and its squared Mahalanobis distance.

    mean (n, M, 4), cov (n, M, 4, 4), z (J, 2) m, noise (J, 2, 2) m^2; lead: m, see `detected`.
    Returns two (n, M, J) arrays.
    """
    place, s11, s12, s22 = mean, cov[..., 0, 0], cov[..., 0, 1, None], cov[..., 1, 1]
    if lead:
        place, unknown = detected(mean, cov, lead)
        s11, s22 = s11 + unknown, s22 + unknown
    dx, dy = z[:, 0] - place[..., 0, None], z[:, 1] - place[..., 1, None]
    s11, s12, s22 = s11[..., None] + noise[:, 0, 0], s12 + noise[:, 0, 1], s22[..., None] + noise[:, 1, 1]
    det = s11 * s22 - s12 * s12
    distance = (s22 * dx * dx - 2 * s12 * dx * dy + s11 * dy * dy) / det
    return -0.5 * (distance + np.log(det)) - 1.8378770664093453, distance


def update(mean, cov, mode, z, noise, lead=0.0, likelihood=None):
    """Kalman update of density k by detection k, in Joseph's form.

    mean (n, M, 4), cov (n, M, 4, 4), mode (n, M), z (n, 2) m, noise (n, 2, 2) m^2; lead: m, see `detected`; likelihood
    (n, M): of the detections in each model, if that is known. Returns (mean, cov, mode).
    """
    place, noise = mean[..., :2], noise[:, None]
    if lead:
        place, unknown = detected(mean, cov, lead)
        noise = noise + unknown[..., None, None] * EYE2
    d = (z[:, None] - place)[..., None]
    s = cov[..., :2, :2] + noise
    det = s[..., 0, 0] * s[..., 1, 1] - s[..., 0, 1] * s[..., 1, 0]
    inverse = s[..., ::-1, ::-1] * COFACTOR / det[..., None, None]
    gain = cov[..., :, :2] @ inverse  # (n, M, 4, 2)
    if mode.shape[1] > 1:
        if likelihood is None:
            log = -0.5 * ((d.swapaxes(-1, -2) @ inverse @ d)[..., 0, 0] + np.log(det))
            likelihood = np.exp(log - log.max(1, keepdims=True)) + 1e-12
        mode = mode * likelihood
        mode = mode / np.add.reduce(mode, 1, keepdims=True) + 1e-12
    mean = mean + (gain @ d)[..., 0]
    keep = cov - gain @ cov[..., :2, :]
    cov = keep + (gain @ noise - keep[..., :2]) @ gain.swapaxes(-1, -2)
    return mean, (cov + cov.swapaxes(-1, -2)) / 2, mode


def moments(mean, cov, mode):
    """Mean (n, 4) and covariance (n, 4, 4) of each density's mixture over its models."""
    if mode.shape[1] == 1:
        return mean[:, 0], cov[:, 0]
    centre = (mode[:, None] @ mean)[:, 0]
    spread = (mean - centre[:, None]) * np.sqrt(mode)[..., None]
    inside = (mode[:, None] @ cov.reshape(*cov.shape[:2], 16)).reshape(-1, 4, 4)
    return centre, inside + spread.transpose(0, 2, 1) @ spread
