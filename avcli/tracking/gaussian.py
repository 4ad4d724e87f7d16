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
        after = joint.sum(1)
        weight = (joint / after[:, None]).transpose(0, 2, 1)  # (n, to, from)
        mixed = weight @ mean
        spread = (mean[:, None] - mixed[:, :, None]) * np.sqrt(weight)[..., None]  # (n, to, from, 4)
        cov = (weight @ cov.reshape(*cov.shape[:2], 16)).reshape(cov.shape) + spread.transpose(0, 1, 3, 2) @ spread
        mean, mode = mixed, after
    moved = (f @ mean[..., None])[..., 0]
    half = f @ cov
    cov = half @ f.transpose(0, 2, 1) + q
    return moved, (cov + cov.swapaxes(-1, -2)) / 2, mode, half.swapaxes(-1, -2), mean


def heading(mean, cov):
    """Expected walking direction: velocity over its root mean square, so that it vanishes for someone who stands.

    mean (n, M, 4), cov (n, M, 4, 4). Returns (n, M, 2), length at most 1.
    """
    v = mean[..., 2:]
    return v / np.sqrt((v * v).sum(-1) + cov[..., 2, 2] + cov[..., 3, 3] + 1e-12)[..., None]


def innovation(mean, cov, z, noise, lead=0.0):
    """Residuals and their covariances for all pairs of densities and detections.

    mean (n, M, 4), cov (n, M, 4, 4), z (J, 2) m, noise (J, 2, 2) m^2; lead: metres that what is detected is in front
    of the body's axis (a mouth), along the walking direction as far as that is known.
    Returns residual (n, M, J, 2) and s11, s12, s22 (n, M, J).
    """
    place = mean[..., :2]
    s11, s12, s22 = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1]
    if lead:
        ahead = heading(mean, cov)
        place = place + lead * ahead
        unknown = lead * lead / 2 * (1 - (ahead * ahead).sum(-1))
        s11, s22 = s11 + unknown, s22 + unknown
    residual = z - place[:, :, None]
    return residual, s11[..., None] + noise[:, 0, 0], s12[..., None] + noise[:, 0, 1], s22[..., None] + noise[:, 1, 1]


def loglikelihood(mean, cov, z, noise, lead=0.0):
    """Log likelihood of each detection under each model of each density, and its squared Mahalanobis distance.

    Arguments as `innovation`. Returns two (n, M, J) arrays.
    """
    d, s11, s12, s22 = innovation(mean, cov, z, noise, lead)
    dx, dy = d[..., 0], d[..., 1]
    det = s11 * s22 - s12 * s12
    distance = (s22 * dx * dx - 2 * s12 * dx * dy + s11 * dy * dy) / det
    return -0.5 * (distance + np.log(det)) - 1.8378770664093453, distance


def update(mean, cov, mode, z, noise, lead=0.0):
    """Kalman update of density k by detection k, in Joseph's form.

    mean (n, M, 4), cov (n, M, 4, 4), mode (n, M), z (n, 2) m, noise (n, 2, 2) m^2. Returns (mean, cov, mode).
    """
    place, ahead = mean[..., :2], None
    if lead:
        ahead = heading(mean, cov)
        place = place + lead * ahead
        unknown = lead * lead / 2 * (1 - (ahead * ahead).sum(-1))
        noise = noise[:, None] + unknown[..., None, None] * EYE2
    else:
        noise = noise[:, None]
    d = z[:, None] - place
    s = cov[..., :2, :2] + noise
    det = s[..., 0, 0] * s[..., 1, 1] - s[..., 0, 1] * s[..., 1, 0]
    inverse = s[..., ::-1, ::-1] * COFACTOR / det[..., None, None]
    gain = cov[..., :, :2] @ inverse  # (n, M, 4, 2)
    if mode.shape[1] > 1:
        distance = (d[..., None, :] @ inverse @ d[..., None])[..., 0, 0]
        log = -0.5 * (distance + np.log(det))
        mode = mode * np.exp(log - log.max(1, keepdims=True)) + 1e-12
        mode /= mode.sum(1, keepdims=True)
    mean = mean + (gain @ d[..., None])[..., 0]
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
