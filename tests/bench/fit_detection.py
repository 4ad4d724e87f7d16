"""Fit the detector's numbers (avcli/detection/fitted.json) to renders of random scenes, and judge them on others.

    make fit-detection [FIT_FLAGS="--scenes 200"]

Scenes, looks, lenses, camera heights and furniture are random (examples/train-detector/renders.py), pictures
1920 × 1080. Four laws are fitted, each by greatest likelihood: the errors of positions from depth ("axis"), those of
positions by boxes alone ("box", in random worlds as well), the score of what stands before the empty room ("score"),
and, in random worlds (detection_worlds.py), that of whom the network by itself does not find ("faint"). A law of
fitted.json is replaced only where the new one is better on the scenes that nothing was fitted to. The file also says
how well the network's own score is calibrated; examples/train-detector/export.py fits that one.

Most of the time goes into drawing. What each scene tells is kept in the folder --samples, so that an interrupted run
goes on where it was; the samples of other code or of another network are left alone.
"""

import argparse
import dataclasses
import itertools
import json
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from detection_samples import AxisSample, Samples, collect, collect_worlds, folder, joined
from detection_worlds import BoxSample, Said
from scipy.optimize import minimize

from avcli import __version__
from avcli.detection import fitted
from avcli.detection.body import axis_covariance
from avcli.detection.fitted import AXIS, BOX, FAINT, SCORE, AxisLaw, BoxLaw, FaintLaw, ScoreLaw
from avcli.detection.monocular import Fitted, stated

FEW = 10
"""The score is not fitted to fewer wrong detections than this."""

OUTLIERS, SPREAD_M2 = 0.001, 10.0
"""Share of errors that no law explains (another person's box, a wrong fit), and the area, m², that they spread over."""

SURE = 3.0
"""A law replaces the one that stands if it is better on other scenes by more than so many standard errors."""


# --- losses, in nats a sample -----------------------------------------------------------------------------------------


def surprise(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Negative log likelihoods (n,) of errors (n, 2) m under covariances (n, 2, 2) m², a few outliers allowed."""
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    density = np.exp(-squares / 2) / (2 * np.pi * np.sqrt(np.linalg.det(covariances)))
    return -np.log((1 - OUTLIERS) * density + OUTLIERS / SPREAD_M2)


def axis_loss(law: AxisLaw, samples: list[AxisSample]) -> np.ndarray:
    """Surprises (n,) of the positions from depth under a law."""
    return surprise(
        np.array([error for error, _, _ in samples]),
        np.array([axis_covariance(away, visible, law) for _, away, visible in samples]),
    )


def box_loss(law: BoxLaw, samples: list[BoxSample]) -> np.ndarray:
    """Surprises (n,) of the positions by boxes alone, each the mean of those with and without the parts."""
    return placed(law, samples).loss(law)


def placed(law: BoxLaw, samples: list[BoxSample]) -> "Placed":
    """Place each box by itself, with the parts and the score and without. A fit that fails is an outlier.

    The covariance of a mixture is that between its bodies, and `spread` times that within them.
    """
    errors, aways, merged = [], [], []
    laws = [dataclasses.replace(law, spread=spread, floor_m=0.0, across=1.0, sure=1.0, unsure=0.0) for spread in (1, 2)]
    for view, scene in itertools.groupby(samples, key=lambda sample: sample[2]):
        boxes, parts, places, scores = (np.array(column) for k, column in enumerate(zip(*scene, strict=True)) if k != 2)
        fits = [[Fitted(boxes, view, known, law=bare, scores=scores) for bare in laws] for known in (parts, None)]
        both = [[one.places() for one in some] for some in fits]
        positions = np.stack([one.positions for one, _ in both], axis=1)
        failed = ~np.stack([one.explained for one, _ in both], axis=1)[..., None]
        errors.append(np.where(failed, 1e3, positions - places[:, None]))
        aways.append(np.where(failed, 1.0, positions - view.origin[:2]))
        single, double = (np.stack([one.covariances for one in some], axis=1) for some in zip(*both, strict=True))
        some = np.stack([2 * single - double, double - single])
        merged.append(np.where(failed[..., None], np.eye(2), some))
    unsure = np.sqrt(1 - np.array([score for *_, score in samples]))
    between, within = np.concatenate(merged, axis=1)
    return Placed(np.concatenate(errors), np.concatenate(aways), between, within, unsure)


@dataclasses.dataclass(frozen=True)
class Placed:
    """Errors (n, 2, 2) m of boxes, with and without parts, where they are from the camera (n, 2, 2) m, the covariances
    (n, 2, 2, 2) m² between and within the bodies of each mixture, and (n,) sqrt(1 - score).
    """

    errors: np.ndarray
    away: np.ndarray
    between: np.ndarray
    within: np.ndarray
    unsure: np.ndarray

    def loss(self, law: BoxLaw) -> np.ndarray:
        """Surprises (n,) under the last steps of a law, each the mean of those with and without the parts."""
        wide = self.between + law.spread * self.within + law.floor_m**2 * np.eye(2)
        told = [stated(wide[:, k], self.away[:, k], law, (self.unsure, None)[k]) for k in (0, 1)]
        return np.mean([surprise(self.errors[:, k], told[k]) for k in (0, 1)], axis=0)


def score_loss(law: ScoreLaw, samples: list[tuple[float, bool]]) -> np.ndarray:
    """Log losses (n,) of the depth detector's score."""
    surface, right = np.array([surface for surface, _ in samples]), np.array([right for _, right in samples])
    return log_loss(surface / (surface + law.surface_m2), right)


def faint_loss(law: FaintLaw, samples: list[Said]) -> np.ndarray:
    """Log losses (n,) of the probability of a person of whom the network by itself is not sure."""
    scores, others, right = map(np.array, zip(*samples, strict=True))
    return log_loss(law.probability(scores, others), right)


def log_loss(probability: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Negative log of the probability (n,) of what turned out to be so (n,)."""
    probability = np.clip(probability, 1e-6, 1 - 1e-6)
    return -np.log(np.where(right, probability, 1 - probability))


# --- the fit ----------------------------------------------------------------------------------------------------------

Loss = Callable[[Any, list], np.ndarray]
LAWS: dict[str, tuple[Any, Loss]] = {
    "axis": (AXIS, axis_loss),
    "box": (BOX, box_loss),
    "score": (SCORE, score_loss),
    "faint": (FAINT, faint_loss),
}


def fit(standing: Any, loss: Loss, samples: list) -> Any:
    """Find the law of least loss, from the one that stands; three figures of each number."""
    if isinstance(standing, BoxLaw):
        found = fit_box(standing, samples)
    else:
        found = _least(lambda law: float(loss(law, samples).mean()), standing, 200)
    return type(standing)(*(float(f"{number:.3g}") for number in dataclasses.astuple(found)))


def fit_box(standing: BoxLaw, samples: list[BoxSample]) -> BoxLaw:
    """Find how much narrower than the fit points make a position across the line of sight; the rest stands.

    `side`, `part` and `part_unsure` also weigh bodies and hidden feet. The numbers of the last steps, fitted together,
    gain less on other scenes than this one alone (examples/benchmarks/detection.md).
    """
    found = placed(standing, samples)
    return _least(lambda law: float(found.loss(law).mean()), standing, 60, ("across",))


def _least(cost: Callable[[Any], float], start: Any, evaluations: int, names: tuple[str, ...] = ()) -> Any:
    """Minimize over the logarithms of a law's numbers, of all or those named (Nelder and Mead 1965)."""
    names = names or tuple(field.name for field in dataclasses.fields(start))

    def law(logarithms: np.ndarray) -> Any:
        return dataclasses.replace(start, **dict(zip(names, np.exp(logarithms).tolist(), strict=True)))

    def cost_of(logarithms: np.ndarray) -> float:
        return cost(law(logarithms))

    begin = np.log([getattr(start, name) for name in names])
    options: Any = {"maxfev": evaluations, "xatol": 0.01, "fatol": 1e-4}
    options["initial_simplex"] = np.vstack([begin, begin + 0.3 * np.eye(len(begin))])
    found = minimize(cost_of, begin, method="Nelder-Mead", options=options)
    return law(found.x)


def report(fitted_to: list[Samples], others: list[Samples], names: Iterable[str] = LAWS) -> dict[str, dict[str, Any]]:
    """Fit each law of these names, judge it on other scenes, and keep the better of it and the one that stands."""
    out: dict[str, dict[str, Any]] = {"laws": {}, "losses": {}}
    for name in names:
        standing, loss = LAWS[name]
        mine = joined(fitted_to, name)
        wrong = sum(not right for _, right in mine) if name == "score" else None
        new = standing if wrong is not None and wrong < FEW else fit(standing, loss, mine)
        before, after = loss(standing, joined(others, name)), loss(new, joined(others, name))
        gain, error = gained(before - after, [len(getattr(scene, name)) for scene in others])
        kept = new if gain > max(SURE * error, 0.0) else standing
        out["laws"][name] = dataclasses.asdict(kept)
        out["losses"][name] = {
            "samples": len(mine),
            "refitted": dataclasses.asdict(new),
            "loss_before": round(float(loss(standing, mine).mean()), 4),
            "loss_refitted": round(float(loss(new, mine).mean()), 4),
            "other_samples": len(before),
            "other_loss_before": round(float(before.mean()), 4),
            "other_loss_refitted": round(float(after.mean()), 4),
            "gain": round(gain, 4),
            "gain_standard_error": round(error, 4),
            "replaced": kept is not standing,
        }
        if wrong is not None:
            out["losses"][name]["wrong"] = wrong
        print(name, json.dumps(out["losses"][name]), flush=True)
    if network := joined(others, "network"):
        out["losses"]["network"] = calibration(network)
    return out


def gained(gains: np.ndarray, counts: list[int]) -> tuple[float, float]:
    """Mean of the gains (n,) of all samples, and its standard error; the samples of one scene are not independent.

    Args:
        gains: in the order of the scenes.
        counts: samples of each scene.
    """
    scene = np.repeat(np.arange(len(counts)), counts)
    mean = float(gains.mean())
    sums = np.bincount(scene, gains - mean, minlength=len(counts))
    return mean, float(np.sqrt((sums**2).sum()) / len(gains))


def calibration(samples: list[tuple[float, bool]]) -> dict[str, float]:
    """How the network's score stands to how often it is right: log loss as it is, and with a new slope and shift."""
    score, right = np.array([score for score, _ in samples]), np.array([right for _, right in samples])
    logit = np.log(score / (1 - score))

    def loss(law: np.ndarray) -> float:
        return float(log_loss(1 / (1 + np.exp(-(law[0] * logit + law[1]))), right).mean())

    best = minimize(loss, [1.0, 0.0], method="Nelder-Mead").x
    return {
        "other_samples": len(samples),
        "other_loss": round(loss(np.array([1.0, 0.0])), 4),
        "best_loss": round(loss(best), 4),
        "best_slope": round(float(best[0]), 3),
        "best_shift": round(float(best[1]), 3),
    }


def part(
    laws: dict[str, dict[str, float]], seed: int, world: int, scenes: int = 4, worlds: int = 3, frames: int = 2
) -> dict[str, Any]:
    """The losses of laws on a few of the scenes: a test compares them with those of the detector of its day."""
    few = collect(scenes, frames, seed) + collect_worlds(worlds, frames, world)
    out: dict[str, Any] = {"scenes": scenes, "worlds": worlds, "frames": frames}
    for name, (standing, loss) in LAWS.items():
        losses = loss(type(standing)(**laws[name]), joined(few, name))
        out[name] = {"samples": len(losses), "loss": round(float(losses.mean()), 4)}
    return out


def commit() -> str | None:
    """The commit that this runs on, None where there is no git."""
    place = Path(__file__).parent
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=place, capture_output=True, text=True)
    return found.stdout.strip() or None


def main() -> None:
    """Fit, judge, and write fitted.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(fitted.__file__).with_name("fitted.json"))
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--frames", type=int, default=4, help="frames of a scene")
    parser.add_argument("--seed", type=int, default=710_000, help="of the scenes that are fitted to")
    parser.add_argument("--other-seed", type=int, default=720_000, help="of the scenes that judge")
    parser.add_argument("--worlds", type=int, default=40, help="random worlds, of three pictures")
    parser.add_argument("--world", type=int, default=7000, help="seed of the first world that is fitted to")
    parser.add_argument("--other-world", type=int, default=5300, help="seed of the first world that judges")
    parser.add_argument("--samples", type=Path, default=Path("bench-out/fit-detection"), help="folder to keep them in")
    parser.add_argument("--only", nargs="*", default=list(LAWS), help="laws to fit; the others stay")
    parser.add_argument("--keep", nargs="*", default=[], choices=LAWS, help="laws that stay in any case")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    found: dict[str, dict[str, Any]] = {"laws": {}, "losses": {}}
    if options.only:
        kept = folder(options.samples)
        mine, others = [], []
        if set(options.only) != {"faint"}:
            mine = collect(options.scenes, options.frames, options.seed, kept)
            others = collect(options.scenes, options.frames, options.other_seed, kept)
        if {"faint", "box"} & set(options.only):
            mine += collect_worlds(options.worlds, 3, options.world, kept)
            others += collect_worlds(options.worlds, 3, options.other_world, kept)
        found = report(mine, others, options.only)
        for name in options.keep:
            found["laws"].pop(name, None)
            found["losses"].get(name, {})["replaced"] = False
    stood = fitted.FITTED["fitted_on"]
    found["laws"] = {name: found["laws"].get(name, fitted.FITTED[name]) for name in LAWS}
    found["losses"] = {name: stood[name] for name in (*LAWS, "network") if name in stood} | found["losses"]
    origin: dict[str, Any] = {
        "command": "tests/bench/fit_detection.py",
        "data": "renders of random scenes, examples/train-detector/renders.py, 1920 x 1080; for faint: random worlds",
        "scenes": options.scenes,
        "frames": options.frames,
        "seed": options.seed,
        "other_seed": options.other_seed,
        "worlds": options.worlds,
        "world": options.world,
        "other_world": options.other_world,
        "version": __version__,
        "commit": commit() if options.only else stood["commit"],
    }
    origin["kept"] = options.keep if options.only else stood["kept"]
    origin |= {**found["losses"], "part": part(found["laws"], options.seed, options.world)}
    text = json.dumps({**found["laws"], "fitted_on": origin}, indent=2)
    options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
