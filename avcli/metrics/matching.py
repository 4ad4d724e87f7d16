"""Which tracked point belongs to which true one: optimal assignment, and the matches of CLEAR."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avcli.metrics.sequence import Sequence
from avcli.numeric import assignment_solver

THRESHOLD = 0.5
"""Least similarity of a match of CLEAR and Identity."""


def assign_each(score: np.ndarray) -> np.ndarray:
    """Assign in every matrix of a stack the pairs of greatest total score, as scipy would on the negated matrix.

    Where the greatest entries of the shorter side are unique and lie apart, they are the answer and nothing is solved.

    Args:
        score: finite scores (f, n, m).

    Returns:
        For each matrix the column of every row, int (f, n), -1 where a row has none (n > m).
    """
    frames, rows, columns = score.shape
    if columns < rows:
        row_of = assign_each(score.transpose(0, 2, 1))
        column_of = np.full((frames, rows), -1)
        np.put_along_axis(column_of, row_of, np.broadcast_to(np.arange(columns), (frames, columns)), axis=1)
        return column_of
    column_of = score.argmax(axis=2)
    top = np.take_along_axis(score, column_of[:, :, None], axis=2)
    ordered = np.sort(column_of, axis=1)
    clear = ((score == top).sum(axis=2) == 1).all(axis=1) & (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
    hard = np.flatnonzero(~clear)
    solve = assignment_solver(hard.size * rows * rows * columns)
    for f in hard:
        column_of[f] = solve(-score[f])[1]
    return column_of


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

    A pair can match if its similarity reaches 0.5, that is within d0 / 2. The frame before is the last one with both
    true and tracked points.

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


def ignore(sequence: Sequence, ignored: np.ndarray, d0: float = 2.0) -> Sequence:
    """Leave out some true points, and the tracked points that match these and not the remaining ones.

    Before anything is left out, each frame's points are matched for the greatest total similarity among pairs of at
    least 0.5. A track that follows an ignored person therefore does not count as false.

    Args:
        sequence: ground truth and tracks.
        ignored: (g,) true points to leave out.
        d0: m, distance at which the similarity becomes zero.

    Source: TrackEval 1.3.0, trackeval/datasets/mot_challenge_2d_box.py, which treats distractors in this way.
    """
    dropped = np.zeros(sequence.track.identity.size, dtype=bool)
    for groups in sequence.blocks():
        for group in groups:
            similarity = group.similarity(d0)
            score = np.where(similarity < 0.5 - np.finfo(float).eps, 0.0, similarity)
            column = assign_each(score)
            frame, row = np.nonzero(column >= 0)
            column = column[frame, row]
            gone = (score[frame, row, column] > np.finfo(float).eps) & ignored[group.truth[frame, row]]
            dropped[group.track[frame[gone], column[gone]]] = True
    return Sequence(sequence.truth.keep(~ignored), sequence.track.keep(~dropped), sequence.time)


def speakers(sequence: Sequence, d0: float = 2.0) -> Sequence:
    """Leave out the true points of silent people, and the tracked points that match them, as `ignore` does.

    Raises:
        ValueError: the ground truth does not give "speaking" for every point.
    """
    if np.isnan(sequence.truth.speaking).any():
        raise ValueError('to score only speaking people, the ground truth must give "speaking" for every person')
    return ignore(sequence, sequence.truth.speaking < 0.5, d0)
