"""Higher order tracking accuracy (HOTA) and its parts, equal to TrackEval's."""

from collections.abc import Iterable

import numpy as np

from avcli.metrics.matching import assign_each
from avcli.metrics.metric import Case, Field, Metric, Scores
from avcli.metrics.sequence import Group, Sequence

ALPHA = np.arange(0.05, 0.99, 0.05)
PARTS = ("HOTA", "DetA", "AssA", "DetRe", "DetPr", "AssRe", "AssPr", "LocA", "OWTA")
COUNTS = ("HOTA_TP", "HOTA_FN", "HOTA_FP")


def hota(sequence: Sequence, d0: float = 2.0) -> Scores:
    """Score tracks by HOTA at the 19 thresholds alpha = 0.05, 0.10 ... 0.95.

    As TrackEval's code has it: one assignment a frame serves every alpha, a pair counts where its similarity reaches
    alpha less the machine epsilon, and LocA is 1 where nothing matches.

    Args:
        sequence: ground truth and tracks.
        d0: m, distance at which the similarity max(0, 1 - d / d0) becomes zero.

    Returns:
        Arrays (19,) of fractions under PARTS and of counts under COUNTS, and the scalars HOTA(0), LocA(0), HOTALocA(0),
        which are taken at the lowest alpha.

    Source: J. Luiten et al., "HOTA: A higher order metric for evaluating multi-object tracking", IJCV 129, 2021;
    TrackEval 1.3.0, trackeval/metrics/hota.py.
    """
    truth, track = sequence.truth, sequence.track
    none = np.zeros(ALPHA.size)
    scores: Scores = {name: none.copy() for name in (*PARTS, *COUNTS)}
    if truth.identity.size == 0 or track.identity.size == 0:
        if track.identity.size == 0:
            scores["HOTA_FN"] += truth.identity.size
        else:
            scores["HOTA_FP"] += track.identity.size
        scores["LocA"] += 1.0
        return scores | {"HOTA(0)": 0.0, "LocA(0)": 1.0, "HOTALocA(0)": 0.0}

    truth_frames = np.bincount(truth.identity, minlength=truth.label.size)
    track_frames = np.bincount(track.identity, minlength=track.label.size)
    alignment = _alignment(sequence, d0, truth_frames, track_frames)

    similarity, pair = _matches(sequence, d0, alignment)
    # How many thresholds each match passes; counting from the top then gives what holds at each alpha.
    passed = np.searchsorted(ALPHA - np.finfo(float).eps, similarity, side="right")
    true_positive = _held(np.bincount(passed, minlength=ALPHA.size + 1))
    scores["HOTA_TP"] = true_positive
    scores["HOTA_FN"] = truth.identity.size - true_positive
    scores["HOTA_FP"] = track.identity.size - true_positive

    pairs, place = np.unique(pair, return_inverse=True)
    counts = np.bincount(place * (ALPHA.size + 1) + passed, minlength=pairs.size * (ALPHA.size + 1))
    count = _held(counts.reshape(pairs.size, ALPHA.size + 1))
    g = truth_frames[pairs // track.label.size][:, None]
    t = track_frames[pairs % track.label.size][:, None]
    matched = np.maximum(1, true_positive)
    scores["AssA"] = (count * (count / np.maximum(1, g + t - count))).sum(axis=0) / matched
    scores["AssRe"] = (count * (count / g)).sum(axis=0) / matched
    scores["AssPr"] = (count * (count / t)).sum(axis=0) / matched
    located = _held(np.bincount(passed, weights=similarity, minlength=ALPHA.size + 1))
    scores["LocA"] = np.maximum(1e-10, located) / np.maximum(1e-10, true_positive)
    return _finish(scores)


def combine(results: Iterable[Scores]) -> Scores:
    """Combine the sequences of one tracker as TrackEval does: counts are summed, association and localization weighted.

    Sequences without a match at an alpha have no weight in AssA and LocA there.

    Args:
        results: what `hota` returned for each sequence, at least one.
    """
    results = list(results)
    scores: Scores = {name: np.sum([r[name] for r in results], axis=0) for name in COUNTS}
    matched = scores["HOTA_TP"]
    for name in ("AssA", "AssRe", "AssPr"):
        scores[name] = np.sum([r[name] * r["HOTA_TP"] for r in results], axis=0) / np.maximum(1.0, matched)
    located = np.sum([r["LocA"] * r["HOTA_TP"] for r in results], axis=0)
    scores["LocA"] = np.maximum(1e-10, located) / np.maximum(1e-10, matched)
    return _finish(scores)


def _held(passed: np.ndarray) -> np.ndarray:
    """Turn totals by number of thresholds passed (..., 20) into totals held at each alpha (..., 19)."""
    return passed[..., :0:-1].cumsum(axis=-1)[..., ::-1]


def _alignment(sequence: Sequence, d0: float, truth_frames: np.ndarray, track_frames: np.ndarray) -> np.ndarray:
    """Jaccard alignment (g, k) of each true with each tracked identity over the whole sequence, before any matching."""
    tracks = track_frames.size
    flat = np.zeros(truth_frames.size * tracks)
    for groups in sequence.blocks():
        pairs = sum(group.distance.size for group in groups)
        keys, weights = np.empty(pairs, dtype=int), np.empty(pairs)
        for group, place in zip(groups, _places(groups), strict=True):
            similarity = group.similarity(d0)
            total = similarity.sum(axis=1)[:, None, :] + similarity.sum(axis=2)[:, :, None] - similarity
            share = np.zeros_like(similarity)
            np.divide(similarity, total, out=share, where=total > np.finfo(float).eps)
            truth = sequence.truth.identity[group.truth][:, :, None]
            keys[place] = truth * tracks + sequence.track.identity[group.track][:, None, :]
            weights[place] = share
        # Added frame by frame: another order would round otherwise and could break a tie that TrackEval sees.
        np.add.at(flat, keys, weights)
    potential = flat.reshape(truth_frames.size, tracks)
    return potential / (truth_frames[:, None] + track_frames[None, :] - potential)


def _places(groups: list[Group]) -> list[np.ndarray]:
    """Places (f, n, m) of each group's pairs when those of all groups are laid out frame by frame."""
    if not groups:
        return []
    frames = np.concatenate([group.frame for group in groups])
    sizes = np.concatenate([np.full(group.frame.size, group.distance[0].size) for group in groups])
    order = np.argsort(frames)
    begin = np.empty(frames.size, dtype=int)
    begin[order] = np.cumsum(sizes[order]) - sizes[order]
    ends = np.cumsum([group.frame.size for group in groups])
    return [
        first[:, None, None] + np.arange(group.distance[0].size).reshape(group.distance[0].shape)
        for group, first in zip(groups, np.split(begin, ends[:-1]), strict=True)
    ]


def _matches(sequence: Sequence, d0: float, alignment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Similarities (p,) of the matches of all frames, and their pair of identities as truth * tracks + track (p,)."""
    similarities, pairs = [np.zeros(0)], [np.zeros(0, int)]
    for groups in sequence.blocks():
        for group in groups:
            similarity = group.similarity(d0)
            truth = sequence.truth.identity[group.truth]
            track = sequence.track.identity[group.track]
            column = assign_each(alignment[truth[:, :, None], track[:, None, :]] * similarity)
            frame, row = np.nonzero(column >= 0)
            column = column[frame, row]
            similarities.append(similarity[frame, row, column])
            pairs.append(truth[frame, row] * alignment.shape[1] + track[frame, column])
    return np.concatenate(similarities), np.concatenate(pairs)


def _finish(scores: Scores) -> Scores:
    tp, fn, fp = (scores[name] for name in COUNTS)
    scores["DetRe"] = tp / np.maximum(1, tp + fn)
    scores["DetPr"] = tp / np.maximum(1, tp + fp)
    scores["DetA"] = tp / np.maximum(1, tp + fn + fp)
    scores["HOTA"] = np.sqrt(scores["DetA"] * scores["AssA"])
    scores["OWTA"] = np.sqrt(scores["DetRe"] * scores["AssA"])
    scores["HOTA(0)"] = float(scores["HOTA"][0])
    scores["LocA(0)"] = float(scores["LocA"][0])
    scores["HOTALocA(0)"] = scores["HOTA(0)"] * scores["LocA(0)"]
    return scores


METRIC: Metric[Case] = Metric(
    name="HOTA",
    text="higher order tracking accuracy: curves over 19 thresholds alpha of the similarity 1 - d/d0",
    fields=(
        Field(
            "HOTA", "higher order tracking accuracy: geometric mean of DetA and AssA", "%", "up", True, "HOTA", "curve"
        ),
        Field(
            "DetA",
            "detection accuracy: share of matches among matches, misses and false points",
            "%",
            "up",
            True,
            "DetA",
            "curve",
        ),
        Field(
            "AssA",
            "association accuracy: how well each person keeps one track, and each track one person",
            "%",
            "up",
            True,
            "AssA",
            "curve",
        ),
        Field("DetRe", "share of the true points that are found", "%", "up", True, "DetRe", "curve"),
        Field("DetPr", "share of the tracked points that are right", "%", "up", True, "DetPr", "curve"),
        Field("AssRe", "share of a person's points that one track follows", "%", "up", True, "AssRe", "curve"),
        Field("AssPr", "share of a track's points that lie on one person", "%", "up", True, "AssPr", "curve"),
        Field("LocA", "mean similarity of the matches; 1 if nothing matches", "%", "up", True, "LocA", "curve"),
        Field("OWTA", "open-world tracking accuracy: geometric mean of DetRe and AssA", "%", "up", kind="curve"),
        Field("HOTA_TP", "matched points", "count", "up", kind="curve"),
        Field("HOTA_FN", "missed points", "count", "down", kind="curve"),
        Field("HOTA_FP", "false points", "count", "down", kind="curve"),
        Field("alpha", "the thresholds", kind="curve"),
        Field("HOTA(0)", "HOTA at the lowest threshold", "%", "up"),
        Field("LocA(0)", "LocA at the lowest threshold", "%", "up"),
        Field("HOTALocA(0)", "the product of both", "%", "up"),
    ),
    score=lambda case: {"alpha": np.round(ALPHA, 2), **hota(case.sequence, case.settings.d0)},
    combine=lambda scores, _cases: {"alpha": np.round(ALPHA, 2), **combine(scores)},
)
