"""CLEAR MOT scores, equal to TrackEval's."""

from collections.abc import Iterable
from math import log10

import numpy as np

from avcli.metrics.matching import Matches
from avcli.metrics.metric import Case, Field, Metric
from avcli.metrics.sequence import Sequence

SUMMED = ("CLR_TP", "CLR_FN", "CLR_FP", "IDSW", "MT", "PT", "ML", "Frag", "CLR_Frames", "MOTP_sum")
RATES = ("MOTA", "MOTP", "MODA", "CLR_Re", "CLR_Pr", "CLR_F1", "MTR", "PTR", "MLR", "sMOTA", "MOTAL", "FP_per_frame")


def clear(sequence: Sequence, matches: Matches) -> dict[str, float]:
    """Score tracks by the CLEAR metrics.

    Args:
        sequence: ground truth and tracks.
        matches: what `matching.match` found in it.

    Returns:
        The fields of TrackEval: SUMMED counts and RATES. As there, a sequence without tracks or without ground
        truth has fractions of 0 but MLR = 1, and no frames.

    Source: K. Bernardin and R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics",
    EURASIP JIVP, 2008; TrackEval 1.3.0, trackeval/metrics/clear.py.
    """
    truth, track = sequence.truth, sequence.track
    scores: dict[str, float] = dict.fromkeys((*SUMMED, *RATES), 0)
    if track.identity.size == 0:
        return scores | {"CLR_FN": truth.identity.size, "ML": truth.label.size, "MLR": 1.0}
    if truth.identity.size == 0:
        return scores | {"CLR_FP": track.identity.size, "MLR": 1.0}

    switches, fragments = _breaks(sequence, matches)
    tracked = np.bincount(truth.identity[matches.truth], minlength=truth.label.size) / np.bincount(truth.identity)
    mostly, lost = int((tracked > 0.8).sum()), int((tracked < 0.2).sum())
    positives = matches.truth.size
    return _finish(
        {
            "CLR_TP": positives,
            "CLR_FN": truth.identity.size - positives,
            "CLR_FP": track.identity.size - positives,
            "IDSW": switches,
            "MT": mostly,
            "PT": truth.label.size - mostly - lost,
            "ML": lost,
            "Frag": fragments,
            "CLR_Frames": sequence.time.size,
            "MOTP_sum": float(matches.similarity.sum()),
        }
    )


def combine(results: Iterable[dict[str, float]]) -> dict[str, float]:
    """Combine the sequences of one tracker as TrackEval does: sums, and fractions of the sums."""
    results = list(results)
    return _finish({name: sum(result[name] for result in results) for name in SUMMED})


def _breaks(sequence: Sequence, matches: Matches) -> tuple[int, int]:
    """Count the identity switches and the fragmentations in the matches."""
    truth, track = sequence.truth, sequence.track
    by_identity = np.argsort(truth.identity[matches.truth], kind="stable")
    true = truth.identity[matches.truth][by_identity]
    tracked = track.identity[matches.track][by_identity]
    # Frames in which either side is empty do not break a track into fragments, so they are not counted here.
    frame = np.cumsum(truth.count * track.count > 0)[truth.frame[matches.truth][by_identity]]
    same = true[1:] == true[:-1]
    return int((same & (tracked[1:] != tracked[:-1])).sum()), int((same & (frame[1:] != frame[:-1] + 1)).sum())


def _finish(scores: dict[str, float]) -> dict[str, float]:
    tp, fn, fp, switches = (scores[name] for name in ("CLR_TP", "CLR_FN", "CLR_FP", "IDSW"))
    true, tracked = max(1, tp + fn), max(1, tp + fp)
    identities = max(1, scores["MT"] + scores["PT"] + scores["ML"])
    return scores | {
        "MTR": scores["MT"] / identities,
        "PTR": scores["PT"] / identities,
        "MLR": scores["ML"] / identities,
        "CLR_Re": tp / true,
        "CLR_Pr": tp / tracked,
        "CLR_F1": tp / max(1, tp + 0.5 * fn + 0.5 * fp),
        "MODA": (tp - fp) / true,
        "MOTA": (tp - fp - switches) / true,
        "MOTP": scores["MOTP_sum"] / max(1, tp),
        "sMOTA": (scores["MOTP_sum"] - fp - switches) / true,
        "MOTAL": (tp - fp - (log10(switches) if switches else 0)) / true,
        "FP_per_frame": fp / max(1, scores["CLR_Frames"]),
    }


METRIC: Metric[Case] = Metric(
    name="CLEAR",
    text="CLEAR MOT scores: errors counted frame by frame; a track matches a person within half of d0",
    fields=(
        Field(
            "MOTA",
            "accuracy: 1 minus the misses, false points and identity switches per true point",
            "%",
            "up",
            True,
            "MOTA",
        ),
        Field("MOTP", "mean similarity 1 - d/d0 of the matches (a similarity, not a distance)", "%", "up", True),
        Field("MODA", "MOTA without identity switches", "%", "up", True),
        Field(
            "IDSW", "identity switches: a person is matched by another track than before", "count", "down", True, "IDSW"
        ),
        Field("Frag", "fragmentations: the track of a person is interrupted", "count", "down", True),
        Field("MT", "people tracked for more than 80 % of their time", "count", "up", True),
        Field("PT", "people tracked for 20 % to 80 % of their time", "count", "", True),
        Field("ML", "people tracked for less than 20 % of their time", "count", "down", True),
        Field("CLR_TP", "matched points", "count", "up"),
        Field("CLR_FN", "missed points", "count", "down"),
        Field("CLR_FP", "false points", "count", "down"),
        Field("CLR_Frames", "frames", "count"),
        Field("MOTP_sum", "sum of the similarities of the matches"),
        Field("CLR_Re", "share of the true points that are matched", "%", "up"),
        Field("CLR_Pr", "share of the tracked points that are matched", "%", "up"),
        Field("CLR_F1", "harmonic mean of CLR_Re and CLR_Pr", "%", "up"),
        Field("MTR", "MT as a share of the people", "%", "up"),
        Field("PTR", "PT as a share of the people", "%"),
        Field("MLR", "ML as a share of the people", "%", "down"),
        Field("sMOTA", "MOTA with the similarity of each match in place of 1", "%", "up"),
        Field("MOTAL", "MOTA with the logarithm of the identity switches", "%", "up"),
        Field("FP_per_frame", "false points per frame", "", "down"),
    ),
    score=lambda case: clear(case.sequence, case.matches),
    combine=lambda scores, _cases: combine(scores),
)
