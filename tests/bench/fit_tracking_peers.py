"""Tunes the peers of avfuse's trackers (tracking_peers.py) and writes tracking_peers.json.

Coordinate search for the best mean HOTA at d0 = 2 m over sets and seeds that may decide: each parameter in turn takes
the best of a few values, until a round changes nothing.
"""

import argparse
import itertools
import json
import os
import sys
from dataclasses import asdict, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_cases import scene_of
from tracking_measures import hota
from tracking_peers import FITTED, TUNED, Parameters, register
from tracking_runs import Variant, fuse
from tracking_scenes import Scene

register()
GRID: dict[str, tuple[float, ...]] = {
    "reach": (0.4, 0.6, 0.8, 1.3),
    "ear": (0.5, 0.7, 1.3),
    "hits": (1, 2, 3, 4),
    "doubt": (0.15, 0.25, 0.35),
    "age": (0.55, 1.05, 1.55, 2.05),
    "shown": (0.0, 0.15, 0.25, 0.35, 0.55, 1.05),
    "noise": (0.25, 0.5, 0.8, 1.2),
}
CASES = ("hotel@any+60", "zara01occ@any+60", "zara02@any+60", "s4", "crossing", "comings-goings")
FIRST, SEEDS = 100, 2


def score(peer: str, parameters: Parameters, root: Path) -> float:
    """Mean HOTA over the cases that tune, %."""
    TUNED[peer] = parameters
    values = []
    for case, seed in itertools.product(CASES, range(FIRST, FIRST + SEEDS)):
        scene = _scenes.setdefault((case, seed), scene_of(case, seed, root))
        values.append(hota(scene.truth, fuse(scene, Variant(peer))[0], 2.0)[0])
    return float(np.mean(values))


_scenes: dict[tuple[str, int], Scene] = {}


def tune(peer: str, root: Path, rounds: int = 3) -> tuple[Parameters, float]:
    """Coordinate search over GRID from the parameters in use: the best, and their mean HOTA."""
    best = TUNED[peer]
    top = score(peer, best, root)
    names = [*GRID, "momentum"] if peer == "oc-sort" else list(GRID)
    for _ in range(rounds):
        before = best
        for name in names:
            for value in GRID.get(name, (0.0, 0.1, 0.2, 0.4)):
                one = replace(best, **{name: value})  # type: ignore[arg-type]
                if one != best and (found := score(peer, one, root)) > top + 1e-9:
                    best, top = one, found
        print(f"{peer}: {top:.2f} {asdict(best)}", flush=True)
        if best == before:
            break
    return best, top


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walks", type=Path, help="a checkout of OpenTraj")
    parser.add_argument("--peers", nargs="*", choices=list(TUNED), default=list(TUNED), help="these alone")
    options = parser.parse_args()
    for name in options.peers:
        best, top = tune(name, options.walks)
        whole = json.loads(FITTED.read_text())
        whole["parameters"][name] = asdict(best)
        fit = {"cases": CASES, "seeds": [FIRST, FIRST + SEEDS - 1], "mean_HOTA": round(top, 2)}
        whole.setdefault("fit", {})[name] = fit
        FITTED.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
