"""The space between the tags of an AprilGrid, measured where it was not given."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avcli.calibration import fit
from avcli.calibration.target import Board

_STEPS = (0.04, 0.015, 0.005, 0.002)
"""Ratios that are compared with the one in hand, above and below it."""


def measured(board: Board, observe: Callable[[Board], fit.Observations], size: tuple[int, int], model: str) -> Board:
    """Return the board with the ratio that explains the corners best.

    A wrong ratio shifts every other corner, which no lens and no pose can imitate. So the lens is fitted with the ratio
    in hand, then the ratio with that lens (the minimum of a parabola through three ratios), and so on.

    Args:
        board: an AprilGrid whose ratio is roughly known.
        observe: the corners of some views, a dozen is enough, as those of a board with this ratio.
        size: width and height of the pictures, px.
        model: of the lens, a name in avcli.lens.LENSES.

    Raises:
        fit.NoFit: there are fewer equations than unknowns.
    """
    solution: fit.Solution | None = None
    for step in _STEPS:
        seen = observe(board)
        if solution is None:
            solution = fit.scan_focal(seen, *size, model)
        solution = fit.fit(seen, solution)
        below, here, above = (
            _misfit(observe(replace(board, ratio=board.ratio + change)), solution) for change in (-step, 0, step)
        )
        bend = below - 2 * here + above
        change = step * (below - above) / (2 * bend) if bend > 0 else float(np.sign(below - above)) * step
        ratio = board.ratio + float(np.clip(change, -2 * step, 2 * step))
        board = replace(board, ratio=round(float(np.clip(ratio, 0.01, 0.99)), 5))
    return board


def _misfit(seen: fit.Observations, solution: fit.Solution) -> float:
    posed = fit.refine_poses(seen, solution, 8)
    size = np.linalg.norm(fit.residuals(seen, posed), axis=1)
    return float(np.log1p(size**2).mean())  # corners that were misread count little
