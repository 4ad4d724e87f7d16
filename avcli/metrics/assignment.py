"""Optimal assignment in each matrix of a stack."""

import numpy as np

from avcli.numeric import assignment_solver


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
