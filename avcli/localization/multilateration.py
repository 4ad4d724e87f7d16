"""A position from time differences of arrival: the closed form 3D-SSL and robust maximum likelihood."""

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from avcli.localization import correlation
from avcli.numeric import fft_length


def closed_form(
    microphones: ArrayLike, reference: int, differences: ArrayLike, *, combination_size: int = 4
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve every choice of `combination_size` range differences for a position, linearly (3D-SSL).

    With y the source relative to the reference microphone, R = |y|, b_i the other microphones relative to it and d_i
    the range differences, |y - b_i| = R + d_i becomes 2 b_i · y + 2 d_i R = |b_i|² - d_i²: linear in (y, R) when R is
    taken for a fourth unknown (Smith & Abel 1987). Five microphones that lie in one plane leave it singular.

    Args:
        microphones: (m, 3) m.
        reference: the reference microphone's index.
        differences: (m,) m, range to each microphone minus range to the reference; the reference's own is not used.
        combination_size: 4 solves exactly, more solves by least squares.

    Returns:
        positions (n, 3) m, ranges to the reference (n,) m, condition numbers (n,) of the systems with all lengths as
        they are in metres, one for each choice in lexicographic order. A singular system gives NaN and infinity.
    """
    places = np.asarray(microphones, dtype=np.float64)
    others = np.delete(np.arange(len(places)), reference)
    baseline = places[others] - places[reference]
    difference = np.asarray(differences, dtype=np.float64)[others]
    rows = np.column_stack([baseline, difference])
    right = 0.5 * ((baseline**2).sum(axis=1) - difference**2)
    choices = np.array(list(combinations(range(len(others)), combination_size)))
    left, singular, right_basis = np.linalg.svd(rows[choices], full_matrices=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.where(singular[:, -1] > 1e-12 * singular[:, 0], singular[:, 0] / singular[:, -1], np.inf)
        projected = np.einsum("nki,nk->ni", left, right[choices]) / singular
        solutions = np.einsum("nik,ni->nk", right_basis, projected)
    solutions[~np.isfinite(condition)] = np.nan
    return places[reference] + solutions[:, :3], solutions[:, 3], condition


def valid(
    positions: np.ndarray,
    ranges: np.ndarray,
    conditions: np.ndarray,
    *,
    max_condition: float,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """Return which closed-form solutions (n,) are stable, in front of the reference, and inside the room.

    Args:
        positions: (n, 3) m.
        ranges: (n,) m.
        conditions: (n,).
        max_condition: the largest condition number that counts as stable.
        low, high: (3,) m, the corners of the room.
    """
    with np.errstate(invalid="ignore"):
        inside = ((positions >= low) & (positions <= high)).all(axis=1)
        return inside & (conditions <= max_condition) & (ranges > 0.0)


def refine(
    position: ArrayLike,
    microphones: ArrayLike,
    first: np.ndarray,
    second: np.ndarray,
    differences: np.ndarray,
    weights: ArrayLike,
    *,
    scale: float = 0.02,
    iterations: int = 20,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Fit a position to range differences by Gauss-Newton with Cauchy weights (robust maximum likelihood).

    Args:
        position: (3,) m, where to start.
        microphones: (m, 3) m.
        first, second: (p,) microphone indices of each difference.
        differences: (p,) m, range to first minus range to second.
        weights: (p,) how much each difference counts, 0 leaves it out.
        scale: m, the residual at which a difference's weight has halved.
        iterations: at most this many steps.

    Returns:
        position (3,) m, normal matrix JᵀWJ (3, 3) with the final weights, weighted rms residual in m.
    """
    places = np.asarray(microphones, dtype=np.float64)
    found = np.array(position, dtype=np.float64)
    counts = np.asarray(weights, dtype=np.float64)

    def linearized(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        offsets = at - places
        ranges = np.sqrt((offsets**2).sum(axis=1))
        units = offsets / np.maximum(ranges, 1e-9)[:, None]
        residual = differences - (ranges[first] - ranges[second])
        return units[first] - units[second], residual, counts / (1.0 + (residual / scale) ** 2)

    def cost(residual: np.ndarray) -> float:
        return float((counts * np.log1p((residual / scale) ** 2)).sum())

    jacobian, residual, robust = linearized(found)
    least = cost(residual)
    damping = 1e-9
    for _ in range(iterations):
        normal = jacobian.T @ (jacobian * robust[:, None])
        ridge = damping * np.trace(normal) + 1e-12
        step = np.linalg.solve(normal + np.diag([ridge] * 3), jacobian.T @ (robust * residual))
        if not np.isfinite(step).all():
            break
        candidate = linearized(found + step)
        reached = cost(candidate[1])
        if reached <= least:
            found, least = found + step, reached
            (jacobian, residual, robust), damping = candidate, 0.1 * damping
            if np.abs(step).max() < 1e-5:
                break
        else:
            damping = max(damping * 100.0, 1e-6)
    normal = jacobian.T @ (jacobian * robust[:, None])
    rms = float(np.sqrt((robust * residual**2).sum() / robust.sum())) if robust.any() else np.inf
    return found, normal, rms


def time_differences(
    window: np.ndarray, sample_rate: float, reference: int, max_lags: np.ndarray, *, beta: float
) -> np.ndarray:
    """Return the delay of each channel behind the reference by β-GCC-PHAT with parabolic interpolation.

    Args:
        window: (n, m) samples, already tapered.
        sample_rate: Hz.
        reference: index of the reference channel.
        max_lags: (m,) samples, the largest delay that each channel's distance from the reference allows.
        beta: 0 (plain cross-correlation) to 1 (phase transform).

    Returns:
        (m,) s; 0 for the reference itself.
    """
    size = fft_length(2 * len(window))
    whitened = correlation.whiten(np.fft.rfft(window, size, axis=0).T, beta)
    correlated = np.fft.irfft(whitened * whitened[reference].conj(), size, axis=1)
    delays = np.zeros(window.shape[1])
    for channel in range(window.shape[1]):
        if channel == reference:
            continue
        half = min(int(np.ceil(max_lags[channel])), size // 2 - 2)
        values = np.concatenate([correlated[channel, -half - 1 :], correlated[channel, : half + 2]])
        peak = 1 + int(np.argmax(values[1:-1]))
        offset = correlation.interpolate_peak(values[peak - 1], values[peak], values[peak + 1])
        delays[channel] = (peak - half - 1 + offset) / sample_rate
    return delays
