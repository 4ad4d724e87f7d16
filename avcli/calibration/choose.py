"""Which lens model suits a camera: the simplest that pictures held out of the fit cannot tell from the best."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from avcli.calibration import fit, robust
from avcli.calibration.field import seen_angles
from avcli.lens import Lens, Perspective, variants

AUTO = "auto"
"""The name, in place of a model's, that asks for the choice."""
START = "kannala_brandt"
"""The model that is fitted where none is asked for, and that the corners are refined with before the choice."""
NEXT = ("kannala_brandt+tangential", "brown_conrady+tangential", "rational")
"""The models that are fitted as well where none is asked for and START may not describe the lens: the first describes a
window that is tilted, the others one that is upright, where the picture ends at the angle of total reflection."""
DOUBT, RIM_LOST = 0.04, 0.05
"""What robust.missed must gain for that, or which share of the outer tenth of the corners START must leave out. Upright
windows reach one of them, most real sets none (examples/benchmarks/lenses.md)."""
_NO_CANDIDATES = ("division",)  # the thesis's virtual lens
_ALIKE = 1.001
"""Times the RMS of the best up to which a model is as good, however surely it is worse: two models may be one lens."""
_WORST = 1.1
"""Times the RMS of the best above which a model is no choice, however unsure that is: it may have gone astray."""
_TURNED = np.deg2rad(10.0)
"""Angle between the axes of two models above which one has gone astray: in a narrow lens tangential terms can stand for
a turn of the camera, and angles are then measured from where nothing was seen. Those that suit turn it by up to 5°."""
_WIDEST_SLOPES = np.deg2rad(80.0)
"""Angle beyond which a seen corner rules out the models that bend slopes: the slope there grows without bound."""


@dataclass(frozen=True)
class Tried:
    """A lens model that was tried.

    Attributes:
        name: in avcli.lens.variants().
        parameters: how many the lens has.
        held_out_px: RMS residual of pictures held out of the fit.
        worse_px2, worse_sd_px2: how much larger than that of the best model the sum of its squared residuals is, and
            the standard deviation of that, over views.
    """

    name: str
    parameters: int
    held_out_px: float
    worse_px2: float
    worse_sd_px2: float

    @property
    def is_as_good(self) -> bool:
        """Whether the views cannot tell it from the best: within one standard error (Breiman et al. 1984)."""
        return self.worse_px2 <= self.worse_sd_px2


def first(name: str | None) -> str:
    """The model to fit first where `name` is asked for: itself, or START where it is AUTO or None."""
    return START if name in (AUTO, None) else name


def choose(
    observations: fit.Observations,
    solution: fit.Solution,
    good: np.ndarray,
    held_out: robust.HeldOut,
    width: int,
    height: int,
    *,
    board_errors: bool,
) -> tuple[fit.Solution, robust.HeldOut, tuple[Tried, ...]]:
    """Choose the lens model with the fewest parameters among those that held-out views cannot tell from the best.

    Args:
        observations: the corners of every view that shows the board.
        solution: the fit of the model START to the corners in `good`, with or without the board's shape.
        good: (n,) bool; every model is judged by the same corners.
        held_out: of `solution`.
        width, height: px, of the pictures.
        board_errors: whether the board's errors are learnt beside each model; `observations` have none.

    Returns:
        the solution with the model that was chosen, its held-out error, and what was tried, the best first.
    """
    found = {START: (solution, held_out)}
    some = observations.of_corners(good)
    for name in _candidates(solution.lens, some):
        try:
            other = fit.fit(some, fit.scan_focal(some, width, height, name))
            if solution.bends:
                other = fit.fit(some, other, board_shape=True)
        except (fit.NoFit, np.linalg.LinAlgError):
            continue
        error = robust.held_out(observations, other, good, board_errors=board_errors)
        if np.isfinite(error.rms_px) and keeps_axis(solution.lens, other.lens):
            found[name] = other, error
    if not np.isfinite(held_out.rms_px):  # too few views to hold any out
        return solution, held_out, ()
    tried = compared({name: error for name, (_, error) in found.items()}, observations.view, good)
    return *found[simplest(tried)], tried


def compared(errors: Mapping[str, robust.HeldOut], view: np.ndarray, good: np.ndarray) -> tuple[Tried, ...]:
    """Compare models by their names on the corners `good` (n,) bool of the views `view` (n,); the best first."""
    best = min(errors.values(), key=lambda error: error.squared[good].sum())
    tried = []
    for name, error in errors.items():
        worse = np.bincount(view[good], (error.squared - best.squared)[good])[np.unique(view[good])]
        spread = float(np.sqrt(len(worse)) * worse.std(ddof=1))
        tried.append(Tried(name, len(variants()[name].names()), error.of(good), float(worse.sum()), spread))
    return tuple(sorted(tried, key=lambda one: one.held_out_px))


def simplest(tried: tuple[Tried, ...]) -> str:
    """The name of the model with the fewest parameters among those that views cannot tell from the best, the first."""
    best = tried[0].held_out_px
    near = (one for one in tried if one.held_out_px < _WORST * best)
    alike = (one for one in near if one.is_as_good or one.held_out_px < _ALIKE * best)
    return min(alike, key=lambda one: (one.parameters, one.held_out_px)).name


def keeps_axis(lens: Lens, other: Lens) -> bool:
    """Whether the axis of another lens that was fitted to the same pictures is nearly that of the first."""
    return bool(seen_angles(lens, np.array([other.parameters[2:4]]))[0] < _TURNED)


def _candidates(lens: Lens, observations: fit.Observations) -> Iterator[str]:
    seen = float(np.nanmax(seen_angles(lens, observations.pixels)))
    for name in variants():
        if name != START and name not in _NO_CANDIDATES and can_be(name, seen):
            yield name


def can_be(name: str, seen: float) -> bool:
    """Whether a model by its name can describe a lens with corners up to so many rad from the axis."""
    return seen <= _WIDEST_SLOPES or not issubclass(variants()[name], Perspective)
