"""Identity scores (IDF1, IDP, IDR) and counts, equal to TrackEval's."""

from collections.abc import Iterable

import numpy as np

from avcli.metrics.matching import THRESHOLD
from avcli.metrics.metric import Case, Field, Metric
from avcli.metrics.sequence import Sequence
from avcli.numeric import assignment_solver


def identity(sequence: Sequence, d0: float = 2.0) -> dict[str, float]:
    """Score how long each person keeps one identity, by the best one-to-one map of identities over the whole sequence.

    Args:
        sequence: ground truth and tracks.
        d0: m, distance at which the similarity becomes zero; a pair counts where its similarity is at least 0.5.

    Returns:
        IDTP, IDFN, IDFP and IDF1, IDR, IDP.

    Source: E. Ristani et al., "Performance measures and a data set for multi-target, multi-camera tracking", ECCV
    workshops 2016; TrackEval 1.3.0, trackeval/metrics/identity.py.
    """
    truth, track = sequence.truth, sequence.track
    flat = np.zeros(truth.label.size * track.label.size, dtype=int)
    for groups in sequence.blocks():
        for group in groups:
            frame, row, column = np.nonzero(group.similarity(d0) >= THRESHOLD)
            true, tracked = truth.identity[group.truth[frame, row]], track.identity[group.track[frame, column]]
            key = true * track.label.size + tracked
            flat += np.bincount(key, minlength=flat.size)
    together = flat.reshape(truth.label.size, track.label.size)
    # TrackEval's square problem costs every identity all its points less those that it shares with its partner, which
    # is least where the shared points are most.
    matched = 0
    if together.any():
        solve = assignment_solver(float(together.size * min(together.shape)))
        matched = int(together[solve(-together.astype(float))].sum())
    return _finish({"IDTP": matched, "IDFN": truth.identity.size - matched, "IDFP": track.identity.size - matched})


def count(sequence: Sequence) -> dict[str, int]:
    """Count the points and identities of both sides, and the frames."""
    return {
        "Dets": sequence.track.identity.size,
        "GT_Dets": sequence.truth.identity.size,
        "IDs": sequence.track.label.size,
        "GT_IDs": sequence.truth.label.size,
        "Frames": sequence.time.size,
    }


def combine(results: Iterable[dict[str, float]]) -> dict[str, float]:
    """Combine the sequences of one tracker as TrackEval does: sums, and fractions of the sums."""
    results = list(results)
    return _finish({name: sum(result[name] for result in results) for name in ("IDTP", "IDFN", "IDFP")})


def combine_counts(results: Iterable[dict[str, int]]) -> dict[str, int]:
    """Add the counts of several sequences."""
    results = list(results)
    return {name: sum(result[name] for result in results) for name in results[0]}


def _finish(scores: dict[str, float]) -> dict[str, float]:
    tp, fn, fp = scores["IDTP"], scores["IDFN"], scores["IDFP"]
    return scores | {
        "IDR": tp / max(1, tp + fn),
        "IDP": tp / max(1, tp + fp),
        "IDF1": tp / max(1, tp + 0.5 * fp + 0.5 * fn),
    }


IDENTITY: Metric[Case] = Metric(
    name="Identity",
    text="how long each person keeps one identity, by the best one-to-one map of people to tracks over the sequence",
    fields=(
        Field("IDF1", "harmonic mean of IDP and IDR", "%", "up", True, "IDF1"),
        Field("IDP", "share of the tracked points that have the right identity", "%", "up", True),
        Field("IDR", "share of the true points that are tracked under the right identity", "%", "up", True),
        Field("IDTP", "points with the right identity", "count", "up"),
        Field("IDFN", "true points without the right identity", "count", "down"),
        Field("IDFP", "tracked points without the right identity", "count", "down"),
    ),
    score=lambda case: identity(case.sequence, case.settings.d0),
    combine=lambda scores, _cases: combine(scores),
)

COUNT: Metric[Case] = Metric(
    name="Count",
    text="points and identities of both sides, and frames",
    fields=(
        Field("Dets", "tracked points", "count"),
        Field("GT_Dets", "true points", "count"),
        Field("IDs", "tracks", "count"),
        Field("GT_IDs", "people", "count"),
        Field("Frames", "frames", "count"),
    ),
    score=lambda case: count(case.sequence),
    combine=lambda scores, _cases: combine_counts(scores),
)
