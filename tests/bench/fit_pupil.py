"""Fits how far the centres of real lenses move; writes avcli/calibration/pupil.json (`make fit-pupil`).

Each set is a folder of pictures of a board, as for bench_calibration.py. Its lens is fitted without anything known of
the pupil before. The mean and the spread of the pupil over lenses are those of greatest likelihood: what a set tells
is the pupil of its lens with an error of the size that it states. Sets that avcalib refuses, and those behind glass,
whose centre is that of the window, do not count. Their unit is the geometric mean of the board's square and its
distance; how much more likely they are in it than in either is written as well.
"""

import argparse
import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from lens_sets import calibrated
from scipy.optimize import minimize

from avcli.calibration import fit
from avcli.calibration.calibrate import Calibration
from avcli.calibration.pupil import FITTED, Spread

NOTHING = Spread(0.0, 1e4)


def told(found: Calibration) -> tuple[float, float, float]:
    """The pupil and its standard deviation as pictures alone tell it, in fit.pupil_unit, and that in squares."""
    usual, fit.PUPIL = fit.PUPIL, NOTHING
    try:
        o, start = found.observations, replace(found.solution, doubt=1.0)
        if o.errors.any():
            o, alone = fit.refine_with_errors(o, start, 40, 1e-8)
        else:
            alone = fit.refine(o, start, start.free, start.delta_px, 60)
        variance = fit.covariance(o, alone)[0][-1, -1]
    finally:
        fit.PUPIL = usual
    unit = fit.pupil_unit(o, alone)
    return alone.pupil / unit, math.sqrt(variance) / unit, unit / o.square


def spread(pupils: np.ndarray, errors: np.ndarray) -> tuple[Spread, float]:
    """The normal distribution of greatest likelihood over lenses whose pupils (n,) are known to `errors` (n,).

    Returns:
        the distribution, and the logarithm of its likelihood but for a constant.
    """

    def loss(at: np.ndarray) -> float:
        variance = errors**2 + math.exp(2 * at[1])
        return float(np.sum(np.log(variance) + (pupils - at[0]) ** 2 / variance)) / 2

    best = minimize(loss, np.array([np.median(pupils), math.log(np.std(pupils))]), method="Nelder-Mead")
    return Spread(float(best.x[0]), math.exp(best.x[1])), -float(best.fun)


def described(sets: dict[str, tuple[float, float, float]], refused: list[str], glass: list[str]) -> dict[str, Any]:
    """What the file says of a fit to sets, each with what `told` says of it."""
    names, (pupils, errors, units) = list(sets), np.array(list(sets.values())).T
    whole, likely = spread(pupils, errors)

    def more_likely(power: int) -> float:
        """Than if the unit, in squares, had been this power of the distance (its own is 1/2)."""
        by = units ** (1 - 2.0 * power)
        return round(math.exp(likely - spread(by * pupils, by * errors)[1] - float(np.log(by).sum())), 1)

    others = {name: spread(np.delete(pupils, k), np.delete(errors, k))[0] for k, name in enumerate(names)}
    return {
        "origin": "Fitted by tests/bench/fit_pupil.py to photographs of boards that others took, named in "
        "examples/benchmarks/lenses.md. None of them is part of avcli.",
        "unit": "geometric mean of the board's square and the median distance of its middle",
        "mean": float(f"{whole.mean:.2g}"),
        "sd": float(f"{whole.sd:.2g}"),
        "fit": {
            "times as likely as in squares": more_likely(0),
            "times as likely as in distances": more_likely(1),
            "sets": "pupil, its standard deviation, and squares in the unit; mean and sd of all the others",
            **{n: [round(v, 5) for v in (*sets[n], *others[n])] for n in names},
        },
        "refused": refused,
        "behind glass": glass,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, nargs="+", help="folders of pictures of a board, one for each camera")
    parser.add_argument("--behind-glass", nargs="*", default=[], metavar="NAME", help="sets that do not count")
    parser.add_argument("--out", type=Path, default=FITTED, help="the file to write")
    options = parser.parse_args()
    sets, refused = {}, []
    for folder in options.sets:
        if folder.name in options.behind_glass:
            continue
        try:
            found = calibrated(folder)[1]
        except ValueError as error:
            print(f"{folder.name}: {error}", file=sys.stderr)
            continue
        if found.quality.refusals:
            refused.append(folder.name)
        else:
            sets[folder.name] = told(found)
            print("{}: {:+.5f} ± {:.5f}".format(folder.name, *sets[folder.name]), file=sys.stderr)
    whole = described(sets, refused, options.behind_glass)
    options.out.write_text(json.dumps(whole, indent=1) + "\n")
    print(json.dumps({key: whole[key] for key in ("mean", "sd")}))


if __name__ == "__main__":
    main()
