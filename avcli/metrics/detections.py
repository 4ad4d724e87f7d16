"""Scores of one sensor's detections, which have no identity."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from avcli.metrics.matching import assign_each
from avcli.metrics.metric import Field, Metric, Scores
from avcli.metrics.sequence import Sequence

COUNTS = ("TP", "FN", "FP", "Speaking", "Speaking_TP")


def match(sequence: Sequence, reach: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Match the detections of each frame with people: as many as possible within reach, and of these the nearest.

    Args:
        sequence: ground truth, and the detections as its tracks (their identities mean nothing).
        reach: m, farthest distance of a detection from its person.

    Returns:
        Indices (p,) of the true points and (p,) of the detections.
    """
    truth, detection = [np.zeros(0, int)], [np.zeros(0, int)]
    for groups in sequence.blocks():
        for group in groups:
            near = group.distance <= reach
            # A pair more is worth more than any gain of nearness, which is at most 1 for each pair.
            column = assign_each(np.where(near, 2 + min(near.shape[1:]) - group.distance / reach, 0.0))
            frame, row = np.nonzero(column >= 0)
            right = near[frame, row, column[frame, row]]
            frame, row = frame[right], row[right]
            truth.append(group.truth[frame, row])
            detection.append(group.track[frame, column[frame, row]])
    return np.concatenate(truth), np.concatenate(detection)


def score(
    sequence: Sequence,
    matches: tuple[np.ndarray, np.ndarray],
    covariance: np.ndarray | None = None,
    speaking: np.ndarray | None = None,
) -> Scores:
    """Score one sensor: how many people it finds, how many of its detections are right, and how far off these are.

    Args:
        sequence: ground truth, and the detections as its tracks.
        matches: what `match` found in it.
        covariance: (n, d, d) m² that each detection claims; NaN where it claims none.
        speaking: (g,) whether each true point speaks; None where that is not known.

    Returns:
        Precision, Recall, F1, and Recall_speaking among speaking people; RMSE, MAE and Bias (d,) of the right
        detections in m; ANEES, their squared error in units of the claimed covariance for each dimension, which is 1
        for an honest sensor and above 1 for one that claims too much; the counts. None where a score has no meaning.
    """
    truth, detection = matches
    result: Scores = _finish(
        {
            "TP": truth.size,
            "FN": sequence.truth.identity.size - truth.size,
            "FP": sequence.track.identity.size - truth.size,
            "Speaking": None if speaking is None else int(speaking.sum()),
            "Speaking_TP": None if speaking is None else int(speaking[truth].sum()),
        }
    ) | dict.fromkeys(("RMSE", "MAE", "Bias", "ANEES"))
    if not truth.size:
        return result
    offset = sequence.track.position[detection] - sequence.truth.position[truth]
    square = (offset**2).sum(axis=1)
    result |= {
        "RMSE": float(np.sqrt(square.mean())),
        "MAE": float(np.sqrt(square).mean()),
        "Bias": offset.mean(axis=0).tolist(),
    }
    if covariance is not None:
        known = np.isfinite(covariance[detection]).all(axis=(1, 2))
        known[known] = np.linalg.det(covariance[detection][known]) > 0  # zero where a dimension was not observed
        if known.any():
            error = offset[known]
            scaled = np.linalg.solve(covariance[detection][known], error[:, :, None])[:, :, 0]
            result["ANEES"] = float((error * scaled).sum() / error.size)
    return result


def combine(results: Iterable[Scores]) -> Scores:
    """Combine the scores of one sensor over several sequences, every right detection counting the same."""
    results = [{**r, "square": r["RMSE"] and r["RMSE"] ** 2} for r in results]
    counts = {name: None if any(r[name] is None for r in results) else sum(r[name] for r in results) for name in COUNTS}

    def mean(name: str) -> np.ndarray | None:
        known = [(np.asarray(r[name]), r["TP"]) for r in results if r[name] is not None]
        return sum(value * n for value, n in known) / sum(n for _, n in known) if known else None

    square, bias = mean("square"), mean("Bias")
    reference = {"Reference": results[0]["Reference"]} if "Reference" in results[0] else {}
    return (
        _finish(counts)
        | reference
        | {
            "RMSE": square and float(square) ** 0.5,
            "MAE": mean("MAE"),
            "Bias": None if bias is None else bias.tolist(),
            "ANEES": mean("ANEES"),
        }
    )


def _finish(counts: Scores) -> Scores:
    tp, fn, fp = counts["TP"], counts["FN"], counts["FP"]
    return {
        "Precision": tp / (tp + fp) if tp + fp else None,
        "Recall": tp / (tp + fn) if tp + fn else None,
        "F1": tp / (tp + 0.5 * fn + 0.5 * fp) if tp + fn + fp else None,
        "Recall_speaking": counts["Speaking_TP"] / counts["Speaking"] if counts["Speaking"] else None,
        **counts,
    }


@dataclass(frozen=True, eq=False)
class SensorCase:
    """The detections of one sensor in one sequence.

    Attributes:
        sequence: ground truth, and the detections as its tracks (their identities mean nothing).
        covariance: (n, d, d) m² that each detection claims; NaN where it claims none.
        reference: "mouth" or "body", the point of a person that the ground truth gives.
        reach: m, farthest distance of a detection from its person.
    """

    sequence: Sequence
    covariance: np.ndarray
    reference: str
    reach: float

    @cached_property
    def matches(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices (p,) of the true points and (p,) of the detections that belong together."""
        return match(self.sequence, self.reach)


def _score(case: SensorCase) -> Scores:
    speaking = case.sequence.truth.speaking
    known = None if np.isnan(speaking).any() or not speaking.size else speaking > 0.5
    return score(case.sequence, case.matches, case.covariance, known) | {"Reference": case.reference}


METRIC: Metric[SensorCase] = Metric(
    name="Detections",
    text="scores of one sensor, in a record with sensor in place of tracker and without other sections; a detection is "
    "right within half of d0 of a person; a score without meaning is null",
    fields=(
        Field("Precision", "share of the detections that are right", "%", "up", column="Prec", optional=True),
        Field("Recall", "share of the people who are found", "%", "up", column="Rec", optional=True),
        Field(
            "Recall_speaking", "share of the speaking people who are found", "%", "up", column="RecSp", optional=True
        ),
        Field("F1", "harmonic mean of Precision and Recall", "%", "up", column="F1", optional=True),
        Field("RMSE", "root mean square error of the right detections", "m", "down", column="RMSE", optional=True),
        Field("MAE", "mean error of the right detections", "m", "down", column="MAE", optional=True),
        Field(
            "ANEES",
            "squared error relative to the stated covariance, per dimension: 1 for a correct covariance, above 1 if "
            "the stated covariance is too small",
            column="ANEES",
            optional=True,
        ),
        Field("TP", "right detections", "count", "up", column="TP"),
        Field("FN", "people not found", "count", "down", column="FN"),
        Field("FP", "false detections", "count", "down", column="FP"),
        Field("Bias", "mean offset of the right detections", "m", kind="vector", optional=True),
        Field("Speaking", "true points of speaking people", "count", optional=True),
        Field("Speaking_TP", "of these, points that are found", "count", "up", optional=True),
        Field("Reference", "the point of a person with which detections are compared: mouth or body", kind="word"),
    ),
    score=_score,
    combine=lambda scores, _cases: combine(scores),
)
