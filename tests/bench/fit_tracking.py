"""Fits the motion models to generated walks and writes avcli/tracking/fitted.json (`make fit-tracking`).

The loss is the negative log likelihood of a detection given those before it, in nats, of the interacting multiple model
filter that knows to whom each detection belongs. People walk straight, turn back, or stroll between places with stops.
The fit begins at the numbers in use and replaces them only if its own are better on held-out walks and on the bench
(mean HOTA of the default tracker). Walks have seeds from 1000 on (fit) and 2000 on (held out), bench scenes from
100 on; `make bench-tracking` reports seeds from 0 on.
"""

import argparse
import copy
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_scenes import RATE, ROOM, Rng, clock, waypoints

import avcli
from avcli.tracking import gaussian
from avcli.tracking.fusion import Fusion
from avcli.tracking.model import Population
from avcli.tracking.motion import FITTED, Motion

SIGMA = 0.12  # m, noise of the detections
DURATION = 20.0  # s, of each walk
TRAIN, HELD_OUT, CHECK = 1000, 2000, 3000  # first seeds
CHECKED = 6  # walks that the test runs again
CASES = ("s4", "crossing", "turning-back", "weak", "comings-goings", "gaps", "dim-edge")
FIRST_SEED = 100  # of the bench scenes


def walk(rng: Rng) -> np.ndarray:
    """One person who strolls (3 of 5), turns back (1 of 5) or walks straight (1 of 5): (n, 2) m."""
    times, kind = clock(DURATION), rng.integers(5)
    if kind < 3:
        return waypoints(rng, times)
    heading, speed, start = rng.uniform(0, 2 * math.pi), rng.uniform(0.5, 1.3), rng.uniform(0, ROOM, 2)
    along = speed * times
    if kind == 3:  # slows down at 1 m/s², turns back, and walks at the same speed
        away = np.abs(times - rng.uniform(4.0, DURATION - 4.0))
        along = np.where(away < speed, away**2 / 2, speed * (away - speed / 2))
    return start + along[:, None] * [math.cos(heading), math.sin(heading)]


def detected_walks(first: int, count: int) -> np.ndarray:
    """Detections of people, one at each time: (walks, n, 2) m."""
    walks = []
    for seed in range(first, first + count):
        rng = np.random.default_rng(seed)
        path = walk(rng)
        walks.append(path + SIGMA * rng.standard_normal(path.shape))
    return np.array(walks)


def loss(motion: Motion, walks: np.ndarray) -> float:
    """Mean negative log likelihood in nats of each detection but the first given those before it."""
    n, m = len(walks), len(motion.models)
    mean, cov = np.zeros((n, m, 4)), np.zeros((n, m, 4, 4))
    mean[..., :2] = walks[:, 0, None]
    cov[..., :2, :2], cov[..., 2:, 2:] = SIGMA**2 * np.eye(2), Population().speed ** 2 * np.eye(2)
    mode, noise, total = np.tile(motion.stationary(), (n, 1)), np.tile(SIGMA**2 * np.eye(2), (n, 1, 1)), 0.0
    for z in walks.swapaxes(0, 1)[1:]:
        mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, motion, 1 / RATE)
        away, s = z[:, None] - mean[..., :2], cov[..., :2, :2] + noise[:, None]
        distance = (away[..., None, :] @ np.linalg.solve(s, away[..., None]))[..., 0, 0]
        log = -0.5 * (distance + np.log(np.linalg.det(s))) - gaussian.LOG_2_PI
        top = log.max(1, keepdims=True)
        likelihood = np.exp(log - top)
        total -= float((np.log((mode * likelihood).sum(1)) + top[:, 0]).sum())
        mean, cov, mode = gaussian.update(mean, cov, mode, z, noise, likelihood=likelihood + 1e-12)
    return total / (n * (walks.shape[1] - 1))


def parameters(described: dict[str, Any]) -> np.ndarray:
    """All numbers of a motion that are fitted: noises, memories where there are any, rates where not 0."""
    models = described["models"]
    numbers = [one["noise"] for one in models] + [one["memory"] for one in models if "memory" in one]
    return np.array(numbers + [rate for row in described["rates"] for rate in row if rate])


def with_parameters(described: dict[str, Any], numbers: np.ndarray) -> dict[str, Any]:
    """The motion with other numbers."""
    changed, left = copy.deepcopy(described), iter(numbers.tolist())
    for one in changed["models"]:
        one["noise"] = next(left)
    for one in changed["models"]:
        if "memory" in one:
            one["memory"] = next(left)
    changed["rates"] = [[next(left) if rate else 0.0 for rate in row] for row in changed["rates"]]
    return changed


def fit(described: dict[str, Any], walks: np.ndarray, iterations: int) -> dict[str, Any]:
    """The motion of least loss, by quasi-Newton steps from the one given, with three digits.

    The steps are in the logarithms of the numbers; no number changes more than 20-fold.
    """
    from scipy.optimize import minimize

    begin = np.log(parameters(described))

    def objective(logs: np.ndarray) -> float:
        return loss(Motion.of(with_parameters(described, np.exp(logs))), walks)

    bounds = [(one - math.log(20), one + math.log(20)) for one in begin.tolist()]
    found = minimize(objective, begin, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations, "eps": 1e-3})
    return with_parameters(described, np.array([float(f"{number:.3g}") for number in np.exp(found.x).tolist()]))


def hota(motion: Motion, seeds: int) -> np.ndarray:
    """HOTA in percent of the default tracker on each scene of the bench's hard cases."""
    from tracking_cases import scene_of
    from tracking_measures import hota as hota_of
    from tracking_runs import Frame, detections

    values = []
    for case in CASES:
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            scene = scene_of(case, seed)
            fusion, queue, tracks = Fusion(population=Population(motion=motion)), detections(scene), []
            for now, *_ in scene.truth:
                due = [record for record in queue if record[0] <= now + 1e-9]
                del queue[: len(due)]
                tracks += [
                    Frame(one.ids.tolist(), one.positions[:, :2], one.existence) for one in fusion.step(now, due)
                ]
            values.append(hota_of(scene.truth, tracks, 2.0)[0])
    return np.array(values)


def commit() -> str | None:
    """The code's commit, if it is known."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=FITTED.parent, capture_output=True, text=True)
    return done.stdout.strip() or None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walks", type=int, default=100, help="walks to fit to, and as many that are held out")
    parser.add_argument("--iterations", type=int, default=15, help="quasi-Newton steps")
    parser.add_argument("--seeds", type=int, default=6, help="bench scenes of each case")
    parser.add_argument("--out", type=Path, default=FITTED, help="the file to read and to write")
    options = parser.parse_args()
    whole = json.loads(options.out.read_text())
    old = whole["motion"]
    train, held_out = detected_walks(TRAIN, options.walks), detected_walks(HELD_OUT, options.walks)
    new = fit(old, train, options.iterations)
    figures, scores = {}, []
    for name, one in (("before", old), ("after", new)):
        motion = Motion.of(one)
        scores.append(hota(motion, options.seeds))
        figures[name] = {
            "train": round(loss(motion, train), 5),
            "held_out": round(loss(motion, held_out), 5),
            "bench_hota": round(float(scores[-1].mean()), 2),
        }
        print(name, figures[name], flush=True)
    before, after, gain = figures["before"], figures["after"], scores[1] - scores[0]
    figures["bench_hota_gain"] = {
        "mean": round(float(gain.mean()), 2),
        "standard_error": round(float(gain.std(ddof=1)) / math.sqrt(len(gain)), 2),
    }
    adopted = after["held_out"] < before["held_out"] and after["bench_hota"] >= before["bench_hota"]
    whole["motion"] = new if adopted else old
    whole["fit"] = {
        "command": f"fit_tracking.py --walks {options.walks} --iterations {options.iterations} --seeds {options.seeds}",
        "code": {"version": avcli.__version__, "commit": commit()},
        "loss": "negative log likelihood of a detection given those before it, nats",
        "train": {"seeds": [TRAIN, TRAIN + options.walks - 1], "detections": train.shape[0] * (train.shape[1] - 1)},
        "held_out": {"seeds": [HELD_OUT, HELD_OUT + options.walks - 1]},
        "bench": {"cases": list(CASES), "seeds": [FIRST_SEED, FIRST_SEED + options.seeds - 1]},
        **figures,
        "adopted": adopted,
        **({} if adopted else {"not_adopted": new}),
    }
    checked = round(loss(Motion.of(whole["motion"]), detected_walks(CHECK, CHECKED)), 9)
    whole["check"] = {"seeds": [CHECK, CHECK + CHECKED - 1], "loss": checked}
    options.out.write_text(json.dumps(whole, indent=1) + "\n")
    print("adopted" if adopted else "not adopted: the numbers in use are as good or better", options.out)


if __name__ == "__main__":
    main()
