"""Fits how true the filter's existence is; writes avcli/tracking/existence.json (`make fit-existence`).

A record of a track is true if the track is matched, one to one, to somebody within 1 m. The curves of
avcli/tracking/trust.py are those of greatest likelihood over all records of the tracks in which the filter believes
with .35 or more: on the synthetic cases (seeds from 100 on), and on the tracks of real people that may decide (ETH
hotel, UCY zara01 and zara02, with and without occlusions, from a checkout of OpenTraj).
"""

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_cases import FIRST_DECIDING, ONCE, SYNTHETIC, scene_of
from tracking_measures import matched
from tracking_runs import Variant, fuse
from tracking_scenes import Scene

from avcli.tracking import glmb
from avcli.tracking.model import THERE
from avcli.tracking.trust import FITTED, SUREST, Curve, Trust

REAL = tuple(f"{name}{hiding}@any+120" for name in ("hotel", "zara01", "zara02") for hiding in ("", "occ"))
LONG = ("long-pair", "long-pair-looks", "ten-looks", "crowd100", "60hz", *ONCE)  # minutes, and nearly all is true


class Noted:
    """In place of a `Trust`: says what the filter believes, and notes the other arguments."""

    def __init__(self) -> None:
        self.arguments: list[tuple[float, bool, float, bool]] = []

    def of(self, believed: float, detected: bool, count: float, watched: bool) -> float:
        if believed > THERE:
            self.arguments.append((believed, detected, count, watched))
        return believed


def records_of(scene: Scene) -> np.ndarray:
    """Records of the tracks of a scene: (n, 5) the arguments of `Trust.of`, and whether it is true."""
    noted, usual = Noted(), (glmb.TRUST, glmb.SHOWN)
    glmb.TRUST, glmb.SHOWN = noted, 0.0  # type: ignore[assignment]
    try:
        tracks, _ = fuse(scene, Variant())
    finally:
        glmb.TRUST, glmb.SHOWN = usual
    true = [
        one in found for frame, found in zip(tracks, matched(scene.truth, tracks), strict=True) for one in frame.ids
    ]
    return np.column_stack([np.reshape(noted.arguments, (-1, 4)), true])


def fit(believed: np.ndarray, true: np.ndarray) -> Curve:
    """The curve of greatest likelihood for n records, with three digits: logistic regression."""
    odds = np.log(believed + SUREST) - np.log(1 - believed + SUREST)

    def loss(curve: np.ndarray) -> tuple[float, np.ndarray]:
        logits = curve[0] + curve[1] * odds
        off = expit(logits) - true
        return float(np.mean(np.logaddexp(0, logits) - true * logits)), np.array([off.mean(), (off * odds).mean()])

    curve = minimize(loss, np.array([0.0, 1.0]), jac=True, method="BFGS", options={"gtol": 1e-7}).x
    return Curve(float(f"{math.exp(curve[0]):.3g}"), float(f"{curve[1]:.3g}"))


def bins(said: np.ndarray, true: np.ndarray) -> list[list[float]]:
    """Records, what is said and what is true, on average, in bins of .1 from .5 on."""
    place = np.minimum((said * 10).astype(int), 9)
    some = [(place == k) for k in range(5, 10) if (place == k).any()]
    return [[int(one.sum()), round(float(said[one].mean()), 3), round(float(true[one].mean()), 3)] for one in some]


def described(records: np.ndarray, command: str, synthetic: list[str]) -> dict[str, Any]:
    """What the file says of curves that are fitted to records (n, 5) of some synthetic cases and of REAL."""
    believed, detected, count, watched, true = records.T
    now, again, away = detected > 0, count > 1, (detected == 0) & (watched == 0)
    groups = [~away & (again == many) & (now == seen) for many in (False, True) for seen in (True, False)]
    trust = Trust(*(fit(believed[some], true[some]) for some in [*groups, away]))
    said = np.array([trust.of(b, d > 0, c, w > 0) for b, d, c, w in records[:, :4].tolist()])
    return {
        "origin": "Fitted by tests/bench/fit_existence.py. UCY zara01 and zara02: A. Lerner, Y. Chrysanthou and D. "
        "Lischinski, Crowds by example, Computer Graphics Forum 26(3), 2007; ETH hotel: S. Pellegrini, A. Ess, K. "
        "Schindler and L. van Gool, You'll never walk alone, ICCV 2009. None of their data is part of avcli.",
        "curves": {name: curve._asdict() for name, curve in trust._asdict().items()},
        "fit": {
            "command": command,
            "first seed": FIRST_DECIDING,
            "synthetic": synthetic,
            "real": list(REAL),
            "bins": "records, said, true",
            "before": {"bins": bins(believed, true), "brier": round(float(np.square(believed - true).mean()), 5)},
            "after": {"bins": bins(said, true), "brier": round(float(np.square(said - true).mean()), 5)},
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=Path, required=True, help="a checkout of OpenTraj")
    parser.add_argument("--seeds", type=int, default=2, help="scenes of each synthetic case")
    parser.add_argument("--real-seeds", type=int, default=4, help="scenes of each set of real people")
    parser.add_argument("--out", type=Path, default=FITTED, help="the file to write")
    options = parser.parse_args()
    synthetic = [name for name in SYNTHETIC if name not in LONG]
    scenes = [(name, options.seeds) for name in synthetic] + [(name, options.real_seeds) for name in REAL]
    parts = []
    for name, seeds in scenes:
        parts += [records_of(scene_of(name, FIRST_DECIDING + k, options.walks)) for k in range(seeds)]
        print(f"{name}: {sum(map(len, parts))} records", file=sys.stderr)
    command = f"fit_existence.py --seeds {options.seeds} --real-seeds {options.real_seeds}"
    whole = described(np.concatenate(parts), command, synthetic)
    options.out.write_text(json.dumps(whole, indent=1) + "\n")
    print(json.dumps(whole["fit"], indent=1))


if __name__ == "__main__":
    main()
