"""Optimal assignment with the answers of scipy.optimize.linear_sum_assignment, ties included, importing scipy late."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

# Importing scipy.optimize costs as much as about three million inner steps of the Python solver.
_WORK_WORTH_SCIPY = 3_000_000


def solver(work: float) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Choose the assignment solver that is sooner done with a given amount of work.

    Both give the same answer on the same cost matrix, so the choice is one of time alone.

    Args:
        work: sum over the problems of rows * columns * min(rows, columns).

    Returns:
        A function from a finite cost matrix (n, m) to row and column indices (min(n, m),) each, rows ascending.
    """
    if work < _WORK_WORTH_SCIPY and "scipy.optimize" not in sys.modules:
        return assign
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment


def assign(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign rows to columns at the least total cost, by shortest augmenting paths in plain Python.

    Ties are broken as scipy breaks them (columns are scanned from the last to the first, a later scanned one wins only
    when it is free), and the sums are taken in its order, so that results agree where TrackEval, which uses scipy, is
    the reference.

    Args:
        cost: finite costs (n, m).

    Returns:
        Row indices and column indices, int (min(n, m),) each, rows ascending.

    Source: D. F. Crouse, "On implementing 2D rectangular assignment algorithms", IEEE TAES 52(4), 2016, section III.
    """
    rows, columns = cost.shape
    if columns < rows:
        column, row = assign(cost.T)
        order = np.argsort(row)
        return row[order], column[order]
    costs = cost.tolist()
    row_dual = [0.0] * rows
    column_dual = [0.0] * columns
    row_of = [-1] * columns
    column_of = [-1] * rows
    for start in range(rows):
        distance = [np.inf] * columns
        parent = [-1] * columns
        open_columns = list(range(columns - 1, -1, -1))
        tree_rows, tree_columns = [], []
        row, reached, sink = start, 0.0, -1
        while sink < 0:
            tree_rows.append(row)
            costs_of_row, dual = costs[row], row_dual[row]
            best, nearest = -1, np.inf
            for k, column in enumerate(open_columns):
                through = reached + costs_of_row[column] - dual - column_dual[column]
                if through < distance[column]:
                    distance[column] = through
                    parent[column] = row
                length = distance[column]
                if length < nearest or (length == nearest and row_of[column] < 0):
                    best, nearest = k, length
            reached = nearest
            column = open_columns[best]
            tree_columns.append(column)
            open_columns[best] = open_columns[-1]
            open_columns.pop()
            if row_of[column] < 0:
                sink = column
            else:
                row = row_of[column]
        row_dual[start] += reached
        for row in tree_rows[1:]:
            row_dual[row] += reached - distance[column_of[row]]
        for column in tree_columns:
            column_dual[column] -= reached - distance[column]
        column = sink
        while True:
            row = parent[column]
            row_of[column] = row
            column_of[row], column = column, column_of[row]
            if row == start:
                break
    return np.arange(rows), np.array(column_of, dtype=int)


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
    solve = solver(hard.size * rows * rows * columns)
    for f in hard:
        column_of[f] = solve(-score[f])[1]
    return column_of
