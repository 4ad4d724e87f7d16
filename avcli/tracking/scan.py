"""One record of one sensor, and what each density before the record says of its detections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from avcli.tracking import gaussian
from avcli.tracking.errors import Between
from avcli.tracking.features import Evidence
from avcli.tracking.settings import Sensor

if TYPE_CHECKING:
    from avcli.tracking.partial import Partial, View

DENSE = 300  # pairs of a density and a detection, up to which it costs less not to ask which are near
MOST_PLAUSIBLE = 1e300  # a ratio; hundreds of detections would exceed what a number can hold
# Chosen on S1 to S4 with detections 1 m off, and on hotel and zara01 (seeds from 100) with 5 % of them 1 m off.
STRAYS = 0.01  # share of the detections of people that lie anywhere near; a larger one hides that noise is untold
ASTRAY, NEAR = 0.7, 9.0  # m, standard deviation of these; gate of their squared distance
GATE = 30.0  # squared Mahalanobis distance: 3e-7 of a person's detections lie outside


Likelihoods = list[list[tuple[int, float]]]


@dataclass(slots=True)
class Scan:
    """One record of one sensor: J detections, and n densities before it.

    Numbers for each detection or density are lists where that costs less than arrays.

    Attributes:
        sensor: which sensor.
        column: the number of the sensor.
        z: (J, 2) m, in order of x.
        noise: (J, 2, 2) m², of the errors that differ from record to record.
        floor: (J,) m² per axis, the part of it that comes from the sensor's floor.
        common: (J, 2, 2) m², of the errors that a person's detections have in common; None: no sensor has such.
        ahead: m, how far in front of the body's axis the sensor localizes people.
        between: what its lasting errors have to do with those of the densities.
        odds: J log odds of the scores, NaN: unknown.
        doubt: (J,) probabilities by the scores that it is nobody, 0: unknown; None: all are.
        near: J odds, at most 1, that a detection is as near to its person as its score asks.
        expected: (n, M, 6) of what it should detect of the densities, see `gaussian.innovation`.
        gain: (n, J) likelihood of each detection under each density, per m²; 0 outside the gate.
        gain_by_model: (n, M, J) the same under each model of each density.
        likelihoods: n lists of the detections that `gain` is not 0 for, and its values.
        strays: rows of people of whom nothing is detected -> the detections that nobody explains, and the density per
            m² of a detection of that person there, for the share of those that lie anywhere near; see `strays`.
        existence: n probabilities.
        detectable: n probabilities that the sensor can detect the person.
        clutter: J densities per m² of false detections.
        expected_clutter: number of them, without those of places that are false again and again.
        again: expected further detections of a person whom the sensor has detected in the same record already.
        local: J densities per m² of false detections of such places; `clutter` includes them.
        p_sensor: probability that it detects a detectable person who was known before the sensor may have gone blind.
        p_newcomer: the same of a person who came since.
        newcomers: J densities per m² of detecting a person never detected before, where there is room for another.
        p_detect: n probabilities that it detects the person, if that person exists.
        p_hit: the same by all but the person's own detection, of which one that lies there asks.
        covered: (n, M) shares of the detection probability at each person, by motion model; None: all of it.
        partial: what its detections show, None: all show positions.
        view: how the densities look in those that do not.
        evidence: what the features of the detections say; `gain` and `likelihoods` include it. None: there are none.
    """

    sensor: Sensor
    column: int
    z: np.ndarray
    noise: np.ndarray
    floor: np.ndarray
    common: np.ndarray | None
    ahead: float
    between: Between
    odds: list[float]
    doubt: np.ndarray | None
    near: list[float]
    expected: np.ndarray
    gain: np.ndarray
    gain_by_model: np.ndarray
    likelihoods: Likelihoods
    strays: Mapping[int, list[tuple[int, float]]]
    existence: list[float]
    detectable: list[float]
    clutter: list[float]
    expected_clutter: float
    again: float
    local: list[float]
    p_sensor: float
    p_newcomer: float
    newcomers: list[float]
    p_detect: list[float]
    p_hit: list[float]
    evidence: Evidence | None = None
    covered: np.ndarray | None = None
    partial: Partial | None = None
    view: View | None = None


def likelihoods(
    mode: np.ndarray, expected: np.ndarray, z: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the likelihood of each detection under each density, 0 outside the gate: (n, J), and (n, M, J) by model.

    Args:
        mode: (n, M) probabilities of the models of n densities.
        expected: (n, M, 6), see `gaussian.innovation`.
        z: (J, 2) m.
        noise: (J, 2, 2) m².
    """
    n, count = len(mode), len(z)
    if not count:
        return np.zeros((n, 0)), np.zeros((*mode.shape, 0))
    if n * count <= DENSE:
        log, distance = gaussian.loglikelihood(expected, z, noise)
        gain = np.exp(log)
        gain *= distance < GATE
        return (mode[:, None] @ gain)[:, 0], gain
    gain, by_pair = np.zeros((n, count)), np.zeros((n, count, mode.shape[1]))
    row, j = _overlapping(expected[..., :2], expected[..., 2:5:2], z, noise)
    if len(row):
        near = expected.take(row, 0)[..., :5].transpose(2, 0, 1)
        dx, dy = z.take(j, 0).T[..., None] - near[:2]
        spread = near[2:] + noise.reshape(-1, 4).take(j, 0).T.take(gaussian.UPPER, 0)[..., None]
        log, distance = gaussian.log_normal(dx, dy, *spread)
        close = np.where(distance < GATE, np.exp(log), 0.0)
        at = row * count + j
        gain.ravel()[at] = (mode.take(row, 0) * close).sum(1)
        # The models of a pair lie beside each other, which is written several times faster.
        by_pair.reshape(-1, mode.shape[1])[at] = close
    return gain, by_pair.swapaxes(1, 2)


def possible(gain: np.ndarray) -> Likelihoods:
    """Return for each density the detections with a likelihood (n, J) that is not 0, and these."""
    if gain.size <= DENSE:
        return [[(j, one) for j, one in enumerate(row) if one] for row in gain.tolist()]
    found: Likelihoods = [[] for _ in range(len(gain))]
    row, j = gain.nonzero()
    for i, one in zip(row.tolist(), zip(j.tolist(), gain[row, j].tolist(), strict=True), strict=True):
        found[i].append(one)
    return found


def strays(
    likelihoods: Likelihoods, rows: Sequence[int], mode: np.ndarray, expected: np.ndarray, z: np.ndarray
) -> dict[int, list[tuple[int, float]]]:
    """Find people who may have caused a detection although it lies far from them, as a detector errs now and then.

    An error is usual noise or, by a small share, anything within a body's reach or a little more: the likelihood has a
    heavy tail. It matters where nothing else explains the detection, and the person is not detected otherwise.

    Args:
        likelihoods: n lists of detections and their likelihoods, per m².
        rows: of labelled people.
        mode: (n, M) probabilities of the models.
        expected: (n, M, 6), see `gaussian.innovation`.
        z: (J, 2) m.

    Source:
        P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35(1), 1964 (the
        mixture of usual noise and a broad one).
    """
    explained = {j for row in rows for j, _ in likelihoods[row]}
    lost = [row for row in rows if not likelihoods[row]] if len(explained) < len(z) else []
    if not lost:
        return {}
    alone = [j for j in range(len(z)) if j not in explained]
    broad = np.tile(ASTRAY * ASTRAY * gaussian.EYE2, (len(alone), 1, 1))
    log, distance = gaussian.loglikelihood(expected.take(lost, 0), z.take(alone, 0), broad)
    density = STRAYS * (mode.take(lost, 0)[:, None] @ np.where(distance < NEAR, np.exp(log), 0.0))[:, 0]
    found = {
        row: [(j, one) for j, one in zip(alone, some, strict=True) if one]
        for row, some in zip(lost, density.tolist(), strict=True)
    }
    return {row: some for row, some in found.items() if some}


def _overlapping(
    position: np.ndarray, variance: np.ndarray, z: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows and detections of all pairs in the gate, and of some that are not: boxes around both overlap.

    position, variance: (n, M, 2) m and m² along x and y.
    """
    reach, around = np.sqrt(GATE * variance), np.sqrt(GATE * noise.reshape(-1, 4)[:, ::3])
    low, high = (position - reach).min(1), (position + reach).max(1)
    near = np.ones((len(low), len(z)), bool)
    for first, last, least, most in zip(
        (z - around).T, (z + around).T, low.T[..., None], high.T[..., None], strict=True
    ):
        near &= (first < most) & (last > least)
    row, j = near.nonzero()
    return row, j


def distinct(
    z: np.ndarray, noise: np.ndarray, score: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, list[int]]:
    """Return detections in a defined order, without exact repetitions: (J, 2), (J, 2, 2), (J,), and their numbers."""
    if len(z) < 2:
        return z, noise, score, list(range(len(z)))
    positions = z.tolist()
    order = sorted(range(len(positions)), key=positions.__getitem__)
    if any(positions[a] == positions[b] for a, b in pairwise(order)):
        order = np.lexsort((*noise.reshape(-1, 4).T, z[:, 1], z[:, 0])).tolist()
        order = order[:1] + [b for a, b in pairwise(order) if positions[a] != positions[b]]
    return z.take(order, 0), noise.take(order, 0), None if score is None else score.take(order), order


def plausibility(
    rows: list[int],
    existence: list[float],
    reach: list[float],
    likelihoods: Likelihoods,
    clutter: list[float],
    new: list[float],
    detection: float,
) -> tuple[float, list[float], list[float]]:
    """Return how much likelier a record is with known and new people than as clutter alone.

    In all; each known person's part in it; and for each detection the largest part of those who may have caused it.

    Args:
        rows: the densities of the known people.
        existence: n probabilities.
        reach: n probabilities that the sensor can detect the person where that person is.
        likelihoods: n lists of detections and their likelihoods, per m².
        clutter: J densities per m² of false detections.
        detection: probability that the sensor detects a detectable person.
    """
    known, fresh = [], [min(1 + b / c, 1e3) for c, b in zip(clutter, new, strict=True)]
    parts = fresh.copy()
    for row in rows:
        present = existence[row] * reach[row] * detection
        more = math.fsum([g / clutter[j] for j, g in likelihoods[row]])
        known.append(min(1 - present + present * more, 1e3))
        for j, _ in likelihoods[row]:
            parts[j] = max(parts[j], known[-1])
    return min(math.prod([*known, *fresh]), MOST_PLAUSIBLE), known, parts
