"""Fits the motion models to real and simulated people; writes avcli/tracking/fitted.json (`make fit-tracking`).

The loss is the negative log likelihood in nats of where a person is detected .1, .5, 1 and 2.5 s after the last
detection, of the interacting multiple model filter that knows to whom each detection belongs. Real and simulated people
count half each, within either the kinds by WEIGHTS. Real people come from a checkout of OpenTraj (--walks): the fit
sees UCY zara01 and zara02, which are free with credit; ETH hotel is held out, since its licence is not stated.

Simulated people have seeds from 1000 on (fit) and 2000 on (held out). The fit begins at the numbers in the file, and
writes its own beside them. With --adopt it replaces them, if its own are better on held-out people: a better likelihood
of single people is not yet a better HOTA, which bench_tracking.py says.
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

from tracking_scenes import RATE, clock
from walkers import SIMULATED, real

import avcli
from avcli.tracking import gaussian
from avcli.tracking.motion import FITTED, Motion

SIGMA = 0.12  # m, noise of the detections
DURATION = 12.0  # s, of each path at most
HORIZONS = (1, 5, 10, 25)  # steps of 1 / RATE
EVERY = 20  # steps between two predictions of a path
TRAIN, HELD_OUT, CHECK = 1000, 2000, 3000  # first seeds
CHECKED = 3  # people of each simulated kind whom the test follows again
FITTED_TO, LEFT_OUT = ("zara01", "zara02"), ("hotel",)  # sets of real people
SOURCE = (
    "UCY zara01 and zara02: A. Lerner, Y. Chrysanthou and D. Lischinski, Crowds by example, Computer Graphics Forum "
    "26(3), 2007; free for use with credit to the authors"
)
KEYS = ("noise", "memory", "start")
WEIGHTS = {"strolls": 2.0, "avsim": 2.0, "runs": 0.2}  # others 1: in rooms people stroll more often than they run
STILL = 0.03  # m / s^1.5, least noise: real tracks are drawn straight between points, people are not

People = dict[str, np.ndarray]
"""Kind -> detections (people, n, 2) m at each step, NaN after the end of a path."""


def detected(paths: list[np.ndarray], seed: int) -> np.ndarray:
    """Detections of people at each step: (people, n, 2) m, NaN after the end of a path."""
    steps = round(DURATION * RATE) + 1
    found = np.full((len(paths), steps, 2), np.nan)
    for row, path in zip(found, paths, strict=True):
        row[: len(path)] = path[:steps]
    return found + SIGMA * np.random.default_rng(seed).standard_normal(found.shape)


def simulated(first: int, count: int) -> People:
    """So many people of each simulated kind, with seeds from `first` on."""
    times, seeds = clock(DURATION), range(first, first + count)
    return {
        kind: detected([walker(np.random.default_rng(seed), times) for seed in seeds], first)
        for kind, walker in SIMULATED.items()
    }


def real_people(names: tuple[str, ...], root: Path, count: int) -> People:
    """At most so many people of each set, chosen by chance; long paths are cut into several."""
    people = {}
    for name in names:
        steps = round(DURATION * RATE) + 1
        paths = [path[at : at + steps] for path in real(name, root) for at in range(0, len(path), steps)]
        paths = [path for path in paths if len(path) > HORIZONS[-1] + EVERY]
        order = np.random.default_rng(TRAIN).permutation(len(paths))[:count]
        people[name] = detected([paths[k] for k in order], TRAIN)
    return people


def predictive(motion: Motion, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow people, and predict their detections from time to time.

    Args:
        motion: the models.
        z: (people, n, 2) m, NaN after the end of a path.

    Returns:
        For each of HORIZONS the mean negative log likelihood in nats, and the mean squared Mahalanobis distance of the
        detection from the prediction's moments (2 if the covariance is right).
    """
    steps, noise = z.shape[1], SIGMA**2 * np.eye(2)
    mean, cov, mode = gaussian.begin(z[:, 0], np.tile(noise, (len(z), 1, 1)), motion)
    begun = []
    for k in range(1, steps):
        here = np.isfinite(z[:, k, 0])
        mean, cov, mode, z = mean[here], cov[here], mode[here], z[here]
        mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, motion, 1 / RATE)
        mean, cov, mode = gaussian.update(mean, cov, mode, z[:, k], np.tile(noise, (len(z), 1, 1)))
        if k % EVERY == 2 and k + HORIZONS[0] < steps:
            later = np.minimum(k + np.array(HORIZONS), steps - 1)
            due = np.where((k + np.array(HORIZONS) < steps)[:, None], z[:, later], np.nan)
            begun.append((mean, cov, mode, due))
    mean, cov, mode, due = (np.concatenate(parts) for parts in zip(*begun, strict=True))
    losses, squares = [], []
    for k in range(1, HORIZONS[-1] + 1):
        mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, motion, 1 / RATE)
        if k in HORIZONS:
            there = np.isfinite(due[:, HORIZONS.index(k), 0])
            mean, cov, mode, due = mean[there], cov[there], mode[there], due[there]
            at = due[:, HORIZONS.index(k)]
            away, spread = at[:, None] - mean[..., :2], cov[..., :2, :2] + noise
            log = -0.5 * (_square(away, spread) + np.log(np.linalg.det(spread))) - gaussian.LOG_2_PI
            top = log.max(1)
            losses.append(-float((np.log((mode * np.exp(log - top[:, None])).sum(1)) + top).mean()))
            centre, spread = gaussian.moments(mean, cov, mode)
            squares.append(float(_square(at - centre[:, :2], spread[:, :2, :2] + noise).mean()))
    return np.array(losses), np.array(squares)


def _square(away: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (...) of differences (..., 2) with covariances (..., 2, 2)."""
    return (away[..., None, :] @ np.linalg.solve(spread, away[..., None]))[..., 0, 0]


def loss(motion: Motion, people: People) -> float:
    """Mean negative log likelihood in nats, over horizons, kinds of people, and then real and simulated ones."""
    halves: tuple[list[float], list[float]] = [], []
    weights: tuple[list[float], list[float]] = [], []
    for kind, z in people.items():
        halves[kind in SIMULATED].append(float(predictive(motion, z)[0].mean()))
        weights[kind in SIMULATED].append(WEIGHTS.get(kind, 1.0))
    return float(np.mean([np.average(half, weights=w) for half, w in zip(halves, weights, strict=True) if half]))


def parameters(described: dict[str, Any]) -> np.ndarray:
    """All numbers of a motion that are fitted: noises, memories and starts where there are any, rates where not 0."""
    numbers = [one[key] for one in described["models"] for key in KEYS if key in one]
    return np.array(numbers + [rate for row in described["rates"] for rate in row if rate])


def with_parameters(described: dict[str, Any], numbers: np.ndarray) -> dict[str, Any]:
    """The motion with other numbers."""
    changed, left = copy.deepcopy(described), iter(numbers.tolist())
    for one in changed["models"]:
        one.update({key: next(left) for key in KEYS if key in one})
    changed["rates"] = [[next(left) if rate else 0.0 for rate in row] for row in changed["rates"]]
    return changed


def fit(described: dict[str, Any], people: People, iterations: int) -> dict[str, Any]:
    """The motion of least loss, by quasi-Newton steps from the one given, with three digits.

    The steps are in the logarithms of the numbers; no number changes more than 20-fold.
    """
    from scipy.optimize import minimize

    begin = np.log(parameters(described))
    least = with_parameters(described, np.exp(begin) / 20)
    for one in least["models"]:
        one["noise"] = max(one["noise"], STILL)

    def objective(logs: np.ndarray) -> float:
        return loss(Motion.of(with_parameters(described, np.exp(logs))), people)

    bounds = list(zip(np.log(parameters(least)).tolist(), (begin + math.log(20)).tolist(), strict=True))
    found = minimize(objective, begin, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations, "eps": 1e-3})
    return with_parameters(described, np.array([float(f"{number:.3g}") for number in np.exp(found.x).tolist()]))


def figures(motion: Motion, people: People) -> dict[str, Any]:
    """What the file says of a motion: its loss, and of each kind of people both results of `predictive`."""
    kinds = {}
    for kind, z in people.items():
        nll, squares = predictive(motion, z)
        kinds[kind] = {"nll": nll.round(3).tolist(), "nees": squares.round(2).tolist()}
    return {"loss": round(loss(motion, people), 5), "people": kinds}


def commit() -> str | None:
    """The code's commit, if it is known."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=FITTED.parent, capture_output=True, text=True)
    return done.stdout.strip() or None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=Path, required=True, help="a checkout of OpenTraj")
    parser.add_argument(
        "--people", type=int, default=12, help="people of each simulated kind; four times so many real ones"
    )
    parser.add_argument("--iterations", type=int, default=15, help="quasi-Newton steps")
    parser.add_argument("--out", type=Path, default=FITTED, help="the file to read and to write")
    parser.add_argument(
        "--adopt", action="store_true", help="use the numbers of the fit, if they are better on held-out people"
    )
    options = parser.parse_args()
    whole, real_ones = json.loads(options.out.read_text()), 4 * options.people
    old = whole["motion"]
    train = real_people(FITTED_TO, options.walks, real_ones) | simulated(TRAIN, options.people)
    held_out = real_people(LEFT_OUT, options.walks, real_ones) | simulated(HELD_OUT, options.people)
    new = fit(old, train, options.iterations)
    before, after = (figures(Motion.of(one), held_out) for one in (old, new))
    adopted = after["loss"] < before["loss"] and options.adopt
    whole = {
        "origin": f"Fitted by tests/bench/fit_tracking.py to simulated people and to {SOURCE}."
        if adopted
        else whole["origin"],
        "motion": new if adopted else old,
        "fit": {
            "command": f"fit_tracking.py --people {options.people} --iterations {options.iterations}",
            "code": {"version": avcli.__version__, "commit": commit()},
            "loss": "mean nll, nats, after .1, .5, 1 and 2.5 s; real and simulated people half each; nees: 2 is right",
            "train": {"real": list(FITTED_TO), "simulated seeds": [TRAIN, TRAIN + options.people - 1]},
            "held_out": {"real": list(LEFT_OUT), "simulated seeds": [HELD_OUT, HELD_OUT + options.people - 1]},
            "before": before,
            "after": after,
            "adopted": adopted,
            **({} if adopted else {"not_adopted": new}),
        },
    }
    checked = round(loss(Motion.of(whole["motion"]), simulated(CHECK, CHECKED)), 9)
    whole["check"] = {"seeds": [CHECK, CHECK + CHECKED - 1], "loss": checked}
    options.out.write_text(json.dumps(whole, indent=1) + "\n")
    print(json.dumps(whole["fit"], indent=1))


if __name__ == "__main__":
    main()
