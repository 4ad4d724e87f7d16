"""Fits how true the filter's existence is; writes avcli/tracking/existence.json (`make fit-existence`).

A record of a track is true if the track is matched, one to one, to somebody within 1 m. The curve of
avcli/tracking/trust.py is the one of greatest likelihood over all records of the tracks in which the filter believes
with .35 or more: on the synthetic cases (seeds from 100 on), and on the tracks of real people that may decide (ETH
hotel, UCY zara01 and zara02, with and without occlusions, from a checkout of OpenTraj).
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_cases import FIRST_DECIDING, ONCE, SYNTHETIC, scene_of
from tracking_measures import matched
from tracking_runs import Variant, fuse
from tracking_scenes import Scene

from avcli.tracking import glmb
from avcli.tracking.model import THERE
from avcli.tracking.trust import FITTED, SUREST, Trust

REAL = tuple(f"{name}{hiding}@any+120" for name in ("hotel", "zara01", "zara02") for hiding in ("", "occ"))
LONG = ("long-pair", "long-pair-looks", "ten-looks", "crowd100", "60hz", *ONCE)  # minutes, and nearly all is true
STEPS = 50  # of Newton's method at most


class Noted:
    """In place of a `Trust`: says what the filter believes, and notes for how long sensors looked in vain."""

    def __init__(self) -> None:
        self.unseen: list[float] = []

    def of(self, believed: float, unseen: float) -> float:
        if believed > THERE:
            self.unseen.append(unseen)
        return believed


def records_of(scene: Scene) -> np.ndarray:
    """Records of the tracks of a scene: (n, 3) what the filter believes, s in which sensors looked in vain, truth."""
    noted, usual = Noted(), (glmb.TRUST, glmb.SHOWN)
    glmb.TRUST, glmb.SHOWN = noted, THERE  # type: ignore[assignment]
    try:
        tracks, _ = fuse(scene, Variant())
    finally:
        glmb.TRUST, glmb.SHOWN = usual
    true = [
        one in found for frame, found in zip(tracks, matched(scene.truth, tracks), strict=True) for one in frame.ids
    ]
    believed = np.concatenate([np.zeros(0), *(frame.existence for frame in tracks)])
    return np.column_stack([believed, noted.unseen, true])


def fit(records: np.ndarray) -> Trust:
    """The curve of greatest likelihood for records (n, 3), with three digits: logistic regression."""
    believed, unseen, true = records.T
    odds = np.log(believed + SUREST) - np.log(1 - believed + SUREST)
    signs, curve = np.column_stack([np.ones(len(odds)), odds, np.log1p(unseen)]), np.array([0.0, 1.0, 0.0])
    for _ in range(STEPS):
        p = 1 / (1 + np.exp(-signs @ curve))
        step = np.linalg.solve((signs * (p * (1 - p))[:, None]).T @ signs + 1e-6 * np.eye(3), signs.T @ (true - p))
        curve = curve + step
        if abs(step).max() < 1e-6:
            break
    return Trust(*(float(f"{number:.3g}") for number in curve.tolist()))


def bins(said: np.ndarray, true: np.ndarray) -> list[list[float]]:
    """Records, what is said and what is true, on average, in bins of .1 from .5 on."""
    place = np.minimum((said * 10).astype(int), 9)
    some = [(place == k) for k in range(5, 10) if (place == k).any()]
    return [[int(one.sum()), round(float(said[one].mean()), 3), round(float(true[one].mean()), 3)] for one in some]


def described(records: np.ndarray, command: str, synthetic: list[str]) -> dict[str, Any]:
    """What the file says of a curve that is fitted to records (n, 3) of some synthetic cases and of REAL."""
    curve, (believed, unseen, true) = fit(records), records.T
    said = np.array([curve.of(*one) for one in zip(believed.tolist(), unseen.tolist(), strict=True)])
    return {
        "origin": "Fitted by tests/bench/fit_existence.py. UCY zara01 and zara02: A. Lerner, Y. Chrysanthou and D. "
        "Lischinski, Crowds by example, Computer Graphics Forum 26(3), 2007; ETH hotel: S. Pellegrini, A. Ess, K. "
        "Schindler and L. van Gool, You'll never walk alone, ICCV 2009. None of their data is part of avcli.",
        "curve": curve._asdict(),
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
