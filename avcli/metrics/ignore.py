"""Scoring some of the people: the others are there, but count neither way."""

import numpy as np

from avcli.metrics.assignment import assign_each
from avcli.metrics.sequence import Sequence


def ignore(sequence: Sequence, ignored: np.ndarray, d0: float = 2.0) -> Sequence:
    """Leave out some true points, and the tracked points that match them better than those that stay.

    Each frame's points are matched for the greatest total similarity, pairs of at least 0.5 alone, before anything is
    left out: so whoever follows an ignored person is not false.

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
