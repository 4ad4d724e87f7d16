"""CLEAR MOT scores, equal to TrackEval's, and the matches from which they come."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import log10

import numpy as np

from avcli.metrics.sequence import Sequence
from avcli.numeric import assignment_solver

SUMMED = ("CLR_TP", "CLR_FN", "CLR_FP", "IDSW", "MT", "PT", "ML", "Frag", "CLR_Frames", "MOTP_sum")
RATES = ("MOTA", "MOTP", "MODA", "CLR_Re", "CLR_Pr", "CLR_F1", "MTR", "PTR", "MLR", "sMOTA", "MOTAL", "FP_per_frame")
THRESHOLD = 0.5


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs that belong together, in the order of time.

    Attributes:
        truth: (p,) index of the true point.
        track: (p,) index of the tracked point.
        similarity: (p,) max(0, 1 - d / d0).
    """

    truth: np.ndarray
    track: np.ndarray
    similarity: np.ndarray


def match(sequence: Sequence, d0: float = 2.0) -> Matches:
    """Match each frame's points as CLEAR does: keep the pairs of the frame before, then take the most similar ones.

    A pair may match where its similarity reaches 0.5, that is within d0 / 2. The frame before is the last one in which
    there were true and tracked points.

    Args:
        sequence: ground truth and tracks.
        d0: m, distance at which the similarity becomes zero.

    Source: K. Bernardin and R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics",
    EURASIP JIVP, 2008; TrackEval 1.3.0, trackeval/metrics/clear.py.
    """
    truth, track = sequence.truth, sequence.track
    shapes = list(zip(truth.count.tolist(), track.count.tolist(), strict=True))
    work = 0
    before: dict[int, int] = {}
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0))]
    for frame, row, column, similarity in _candidates(sequence, d0):
        true, tracked = truth.start[frame] + row, track.start[frame] + column
        identities = truth.identity[true].tolist(), track.identity[tracked].tolist()
        kept, settled = _settle(*identities, before)
        if not settled:
            score = np.zeros(shapes[frame])
            work += score.size * min(score.shape)
            score[row, column] = similarity
            score[row[kept], column[kept]] += 1000
            chosen = np.zeros(score.shape, dtype=bool)
            chosen[assignment_solver(work)(-score)] = True
            kept = np.flatnonzero(chosen[row, column]).tolist()
        before = {identities[0][i]: identities[1][i] for i in kept}
        found.append((true[kept], tracked[kept], similarity[kept]))
    return Matches(*(np.concatenate(column) for column in zip(*found, strict=True)))


def clear(sequence: Sequence, matches: Matches) -> dict[str, float]:
    """Score tracks by the CLEAR metrics.

    Args:
        sequence: ground truth and tracks.
        matches: what `match` found in it.

    Returns:
        The fields of TrackEval: SUMMED counts and RATES. As there, a sequence without tracks or without ground
        truth has fractions of 0 but MLR = 1, and no frames.
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


def _candidates(sequence: Sequence, d0: float) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Frame, rows, columns and similarities of the pairs that may match, frame by frame in order."""
    for groups in sequence.blocks():
        frames = {}
        for group in groups:
            similarity = group.similarity(d0)
            frame, row, column = np.nonzero(similarity >= THRESHOLD - np.finfo(float).eps)
            similarity = similarity[frame, row, column]
            ends = np.searchsorted(frame, np.arange(group.frame.size + 1)).tolist()
            for k, f in enumerate(group.frame.tolist()):
                part = slice(ends[k], ends[k + 1])
                frames[f] = row[part], column[part], similarity[part]
        for f in sorted(frames):
            yield f, *frames[f]


def _settle(truth: list[int], track: list[int], before: dict[int, int]) -> tuple[list[int], bool]:
    """Choose among a frame's candidate pairs without solving an assignment, where that can be done.

    Continued pairs weigh 1000 in TrackEval, more than all others together, and compete with each other for nothing:
    they stand. Only where the rest competes is there something to solve, for the whole frame then, because ties must
    fall as they fall there.

    Args:
        truth, track: the identities of each candidate pair.
        before: the tracked identity of each true one in the frame before.

    Returns:
        The chosen pairs and True, or the continued pairs and False.
    """
    kept = [i for i, identity in enumerate(truth) if before.get(identity) == track[i]]
    if len(kept) == len(truth):
        return kept, True
    true, tracked = {truth[i] for i in kept}, {track[i] for i in kept}
    rest = [i for i in range(len(truth)) if truth[i] not in true and track[i] not in tracked]
    if len({truth[i] for i in rest}) == len(rest) == len({track[i] for i in rest}):
        return kept + rest, True
    return kept, False


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
