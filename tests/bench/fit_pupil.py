"""Fits how far the centres of real lenses move; writes avcli/calibration/pupil.json (`make fit-pupil`).

Each set is a folder of pictures of a board, as for bench_calibration.py. Its lens is fitted without anything known of
the pupil before. The mean and the spread of the pupil over lenses are those of greatest likelihood: what a set tells
is the pupil of its lens with an error of the size that it states. Sets that avcalib refuses, and those behind glass,
whose centre is that of the window, do not count.
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
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).resolve().parent))

from lens_sets import calibrated

from avcli.calibration import fit
from avcli.calibration.calibrate import Calibration
from avcli.calibration.pupil import FITTED, Spread

NOTHING = Spread(0.0, 1e4)


def told(found: Calibration) -> tuple[float, float]:
    """The pupil and its standard deviation, in squares, as the pictures of a calibration alone tell it."""
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
    return alone.pupil / o.square, math.sqrt(variance) / o.square


def spread(pupils: np.ndarray, errors: np.ndarray) -> Spread:
    """The normal distribution of greatest likelihood over lenses whose pupils (n,) are known to `errors` (n,)."""

    def loss(at: np.ndarray) -> float:
        variance = errors**2 + math.exp(2 * at[1])
        return float(np.sum(np.log(variance) + (pupils - at[0]) ** 2 / variance))

    best = minimize(loss, np.array([np.median(pupils), math.log(np.std(pupils))]), method="Nelder-Mead").x
    return Spread(float(best[0]), math.exp(best[1]))


def described(sets: dict[str, tuple[float, float]], refused: list[str], glass: list[str]) -> dict[str, Any]:
    """What the file says of a fit to sets, each with its pupil and its standard deviation."""
    names, known = list(sets), np.array(list(sets.values()))
    whole = spread(*known.T)
    others = {name: spread(*np.delete(known, k, 0).T) for k, name in enumerate(names)}
    return {
        "origin": "Fitted by tests/bench/fit_pupil.py to photographs of boards that others took, named in "
        "examples/benchmarks/lenses.md. None of them is part of avcli.",
        "unit": "squares of the board",
        "mean": float(f"{whole.mean:.2g}"),
        "sd": float(f"{whole.sd:.2g}"),
        "fit": {
            "sets": "pupil and its standard deviation; mean and sd of all the others",
            **{n: [round(v, 4) for v in (*sets[n], *others[n])] for n in names},
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
            print("{}: {:+.4f} ± {:.4f}".format(folder.name, *sets[folder.name]), file=sys.stderr)
    whole = described(sets, refused, options.behind_glass)
    options.out.write_text(json.dumps(whole, indent=1) + "\n")
    print(json.dumps({key: whole[key] for key in ("mean", "sd")}))


if __name__ == "__main__":
    main()
