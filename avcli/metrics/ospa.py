"""Distances between sets of points: OSPA and GOSPA of every frame, OSPA(2) of every window of frames."""

from collections.abc import Sequence as List
from dataclasses import dataclass

import numpy as np

from avcli.metrics.matching import assign_each
from avcli.metrics.metric import Case, Field, Metric, Scores
from avcli.metrics.sequence import Points, Sequence, length
from avcli.metrics.tgospa import tgospa
from avcli.numeric import assignment_solver

_FRAMES_A_CHUNK = 256


@dataclass(frozen=True, eq=False)
class SetDistances:
    """Distances between the true and the tracked points of each frame.

    Attributes:
        ospa: (T,) m, distance for each of the points of the larger set.
        localization, cardinality: (T,) m, the parts of ospa: ospa^p is the sum of their p-th powers.
        gospa: (T,) m, distance of the whole sets.
        gospa_localization: (T,) m^p, its part for the assigned points.
        missed, false: (T,) numbers of points left unassigned, each of which adds c^p / 2 to gospa^p.
    """

    ospa: np.ndarray
    localization: np.ndarray
    cardinality: np.ndarray
    gospa: np.ndarray
    gospa_localization: np.ndarray
    missed: np.ndarray
    false: np.ndarray


def set_distances(sequence: Sequence, cutoff: float, order: float = 1.0) -> SetDistances:
    """Measure OSPA and GOSPA (alpha = 2) frame by frame.

    Args:
        sequence: ground truth and tracks.
        cutoff: m, the distance c that a missed or false point is worth.
        order: p >= 1; 1 adds metres, more weighs far points up.

    Source: D. Schuhmacher, B.-T. Vo and B.-N. Vo, "A consistent metric for performance evaluation of multi-object
    filters", IEEE TSP 56(8), 2008, eq. 3; A. S. Rahmathullah et al., "Generalized optimal sub-pattern assignment
    metric", FUSION 2017, proposition 1.
    """
    n, m = sequence.truth.count, sequence.track.count
    near = np.zeros(n.size)  # sum of the clipped distances^p of the best assignment
    within = np.zeros(n.size)  # the same of the pairs nearer than the cutoff
    assigned = np.zeros(n.size, dtype=int)
    for groups in sequence.blocks():
        for group in groups:
            distance = np.minimum(group.distance, cutoff) ** order
            column = assign_each(-distance)
            chosen = np.take_along_axis(distance, np.maximum(column, 0)[:, :, None], axis=2)[:, :, 0]
            close = (column >= 0) & (chosen < cutoff**order)
            near[group.frame] = np.where(column >= 0, chosen, 0).sum(axis=1)
            within[group.frame] = np.where(close, chosen, 0).sum(axis=1)
            assigned[group.frame] = close.sum(axis=1)
    larger = np.maximum(1, np.maximum(n, m))
    localization = near / larger
    cardinality = cutoff**order * np.abs(n - m) / larger
    missed, false = n - assigned, m - assigned
    return SetDistances(
        ospa=(localization + cardinality) ** (1 / order),
        localization=localization ** (1 / order),
        cardinality=cardinality ** (1 / order),
        gospa=(within + cutoff**order / 2 * (missed + false)) ** (1 / order),
        gospa_localization=within,
        missed=missed,
        false=false,
    )


def ospa2(sequence: Sequence, cutoff: float, order: float = 1.0, window: int = 10) -> np.ndarray:
    """Measure OSPA(2), the OSPA distance between sets of tracks, over the window that ends at each frame.

    Two tracks are as far apart as their points are on average over the frames of the window in which either exists,
    and the cutoff counts where only one does: so a broken or switched identity costs, which OSPA does not see.

    Args:
        sequence: ground truth and tracks.
        cutoff: m.
        order: p >= 1.
        window: frames; the first windows are shorter.

    Returns:
        (T,) m.

    Source: M. Beard, B. T. Vo and B.-N. Vo, "A solution for large-scale multi-object tracking", IEEE TSP 68, 2020,
    section V.
    """
    frames = sequence.time.size
    result = np.zeros(frames)
    for first in range(0, frames, _FRAMES_A_CHUNK):
        begin, end = max(0, first - window + 1), min(frames, first + _FRAMES_A_CHUNK)
        truth, track = _tracks(sequence.truth, begin, end), _tracks(sequence.track, begin, end)
        if truth is None or track is None:
            # Nothing on one side: the distance is the cutoff in every window in which the other side has a track.
            for side in (truth, track):
                if side is not None:
                    present = _windowed(~np.isnan(side[:, :, 0]), window).any(axis=1)
                    result[first:end] = np.where(present, cutoff, 0.0)[first - begin :]
            continue
        here, there = ~np.isnan(truth[:, :, 0]), ~np.isnan(track[:, :, 0])
        offset = truth[:, :, None] - track[:, None, :]
        both = here[:, :, None] & there[:, None, :]
        either = here[:, :, None] | there[:, None, :]
        distance = np.minimum(length(offset), cutoff) ** order
        distance = np.where(both, distance, np.where(either, cutoff**order, 0.0))
        total, union = _windowed(distance, window), _windowed(either, window)
        apart = (total / np.maximum(1, union))[first - begin :]
        exists = _windowed(here, window)[first - begin :] > 0, _windowed(there, window)[first - begin :] > 0
        solve = assignment_solver(float((end - first) * apart.shape[1] * apart.shape[2] * min(apart.shape[1:])))
        for t in range(end - first):
            cost = apart[t][np.ix_(exists[0][t], exists[1][t])]
            n, m = cost.shape
            near = cost[solve(cost)].sum() if n and m else 0.0
            result[first + t] = ((near + cutoff**order * abs(n - m)) / max(1, n, m)) ** (1 / order)
    return result


def _tracks(points: Points, begin: int, end: int) -> np.ndarray | None:
    """Positions (frames, identities, d) between two frames, NaN where an identity is absent; None if all are."""
    part = slice(points.start[begin], points.start[end])
    if part.start == part.stop:
        return None
    present, identity = np.unique(points.identity[part], return_inverse=True)
    position = np.full((end - begin, present.size, points.position.shape[1]), np.nan)
    position[points.frame[part] - begin, identity] = points.position[part]
    return position


def _windowed(values: np.ndarray, window: int) -> np.ndarray:
    """Sum over the window that ends at each frame, along the first axis."""
    total = np.cumsum(values, axis=0, dtype=float)
    result = total.copy()
    result[window:] -= total[:-window]
    return result


def _score(case: Case) -> Scores:
    cutoff, order, window = case.settings.cutoff_m, case.settings.order, case.settings.window
    distances = set_distances(case.sequence, cutoff, order)
    trajectories = tgospa(case.sequence, cutoff, order)
    frames = max(1, case.sequence.time.size)
    return {
        "cutoff": cutoff,
        "order": order,
        "window": window,
        "OSPA": float(distances.ospa.sum()) / frames,
        "OSPA_localization": float(distances.localization.sum()) / frames,
        "OSPA_cardinality": float(distances.cardinality.sum()) / frames,
        "OSPA2": float(ospa2(case.sequence, cutoff, order, window).sum()) / frames,
        "GOSPA": float(distances.gospa.sum()) / frames,
        "GOSPA_localization": float(distances.gospa_localization.sum()) / frames,
        "GOSPA_missed": float(distances.missed.sum()) / frames,
        "GOSPA_false": float(distances.false.sum()) / frames,
        "TGOSPA": trajectories and float(trajectories[0]),
        "TGOSPA_switches": trajectories and float(trajectories[1]),
    }


def _combine(scores: List[Scores], cases: List[Case]) -> Scores:
    """Average over all frames; T-GOSPA, which is a sum over frames, is added up."""
    frames = np.array([case.sequence.time.size for case in cases])
    combined = dict(scores[0])
    for name in combined:
        parts = [each[name] for each in scores]
        if name in ("TGOSPA", "TGOSPA_switches"):
            power = combined["order"] if name == "TGOSPA" else 1
            combined[name] = None if None in parts else sum(part**power for part in parts) ** (1 / power)
        elif name not in ("cutoff", "order", "window"):
            combined[name] = float(np.dot(parts, frames) / max(1, frames.sum()))
    return combined


METRIC: Metric[Case] = Metric(
    name="OSPA",
    text="distances between the sets of people and tracks, means over the frames; T-GOSPA is a sum over the frames",
    fields=(
        Field("OSPA", "distance per person; a missed or false person counts as the cutoff", "m", "down", True, "OSPA"),
        Field(
            "OSPA2",
            "OSPA between whole tracks over a window, which also sees broken identities",
            "m",
            "down",
            True,
            "OSPA2",
        ),
        Field(
            "GOSPA",
            "distance of all people together; a missed or false person counts as half of the cutoff",
            "m",
            "down",
            True,
            "GOSPA",
        ),
        Field("OSPA_localization", "part of OSPA from distances", "m", "down"),
        Field("OSPA_cardinality", "part of OSPA from a wrong number of people", "m", "down"),
        Field("GOSPA_localization", "part of GOSPA from distances, in m to the power of the order", "", "down"),
        Field("GOSPA_missed", "missed people per frame", "", "down"),
        Field("GOSPA_false", "false people per frame", "", "down"),
        Field(
            "TGOSPA",
            "distance between the sets of trajectories; an identity switch costs the cutoff; null if too many people "
            "come close to too many tracks for an exact solution",
            "m",
            "down",
            optional=True,
        ),
        Field(
            "TGOSPA_switches", "part of TGOSPA from switches, in m to the power of the order", "", "down", optional=True
        ),
        Field("cutoff", "the cutoff", "m"),
        Field("order", "the order"),
        Field("window", "the window of OSPA2 in frames", "count"),
    ),
    score=_score,
    combine=_combine,
)
