"""Fit the detector's numbers (avcli/detection/fitted.json) to renders of random scenes, and judge them on others.

    make fit-detection [FIT_FLAGS="--scenes 200"]

Scenes, looks, lenses, camera heights and furniture are random (examples/train-detector/renders.py), pictures
1920 × 1080. Four laws are fitted, each by greatest likelihood: the errors of positions from depth ("axis"), those of
boxes and of positions by boxes alone ("box"), the score of what stands before the empty room ("score"), and, in random
worlds (detection_worlds.py), that of whom the network by itself does not find ("faint"). A law of fitted.json is
replaced only where the new one is better on the scenes that nothing was fitted to. The file also says how well the
network's own score is calibrated; examples/train-detector/export.py fits that one.
"""

import argparse
import contextlib
import dataclasses
import itertools
import json
import subprocess
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_detection import GATE_M, Tally, scenes
from detection_worlds import Said, said
from judge import overlaps
from renders import Shot
from scipy.optimize import minimize

from avcli import __version__
from avcli.detection import fitted
from avcli.detection.body import axis_covariance
from avcli.detection.depth import DepthDetector
from avcli.detection.fitted import AXIS, BOX, FAINT, SCORE, AxisLaw, BoxLaw, FaintLaw, ScoreLaw
from avcli.detection.monocular import locate_boxes
from avcli.detection.network import Boxes, Network
from avcli.detection.view import View
from avcli.scene import render, scenario

FEW = 10
"""The score is not fitted to fewer wrong detections than this."""

OUTLIERS, SPREAD_M2 = 0.01, 10.0
"""Share of errors that no law explains (another person's box, a wrong fit), and the area, m², that they spread over."""

SURE = 3.0
"""A law replaces the one that stands if it is better on other scenes by more than so many standard errors."""


AxisSample = tuple[np.ndarray, np.ndarray, float]
BoxSample = tuple[np.ndarray, np.ndarray, View, np.ndarray, float]


@dataclasses.dataclass
class Samples:
    """What a number of scenes gives to fit to.

    Attributes:
        axis: of each position from depth: error (2,) m, from the camera (2,) m, visible fraction.
        box: of each body that the network found: box (4,) px, parts (3, 2) px, camera, the true position (2,) m, and
            the network's score.
        score: of each thing before the empty room: visible surface, m², and whether it was a person.
        faint: of each body before the empty room that is none of the network's people, see detection_worlds.
        network: of each of the network's detections: score, and whether it was a person.
    """

    axis: list[AxisSample] = dataclasses.field(default_factory=list)
    box: list[BoxSample] = dataclasses.field(default_factory=list)
    score: list[tuple[float, bool]] = dataclasses.field(default_factory=list)
    faint: list[Said] = dataclasses.field(default_factory=list)
    network: list[tuple[float, bool]] = dataclasses.field(default_factory=list)


def collect(count: int, frames: int, seed: int) -> list[Samples]:
    """Look at `frames` pictures of each of `count` random scenes: the samples of each."""
    everything = []
    content = (resources.files("avcli.detection") / "people.onnx").read_bytes()
    network = Network(content, confidence=0.02)
    for drawn, view in scenes(count, frames, seed):
        samples = Samples()
        detector = DepthDetector(view, view.sampled(drawn[0].background))
        tally = Tally("network")
        for shot in drawn:
            _add_depth(samples, shot, view, detector)
            found = network.detect(shot.picture)
            tally.rank(shot, found)
            _add_boxes(samples, shot, view, found)
        samples.network += zip(tally.scores, map(bool, tally.right), strict=True)
        everything.append(samples)
    return everything


def collect_worlds(count: int, frames: int, first: int) -> list[Samples]:
    """Look at `frames` pictures of each of `count` random worlds, from the seed `first` on: the samples of each."""
    context = render.open_context()
    context.gc_mode = "auto"
    everything = []
    for seed in range(first, first + count):
        with contextlib.suppress(scenario.ScenarioError):  # more people than the room holds
            everything.append(Samples(faint=said(seed, frames, context)))
    return everything


def _add_depth(samples: Samples, shot: Shot, view: View, detector: DepthDetector) -> None:
    taken: set[int] = set()
    for person in sorted(detector.detect(view.sampled(shot.depth)), key=lambda one: -one.score):
        away = np.linalg.norm(shot.places - person.position[:2], axis=1)
        away[list(taken)] = np.inf
        right = bool(len(away)) and bool(away.min() < GATE_M)
        samples.score.append((SCORE.surface_m2 * person.score / (1 - person.score), right))
        if right and person.visible is not None:
            best = int(away.argmin())
            taken.add(best)
            place = person.position[:2]
            samples.axis.append((place - shot.places[best], place - view.origin[:2], person.visible))


def _add_boxes(samples: Samples, shot: Shot, view: View, found: Boxes) -> None:
    taken: set[int] = set()
    if found.parts is None or not len(shot.boxes):
        return
    for index in np.flatnonzero(found.scores >= 0.5):
        overlap = overlaps(found.boxes[index], shot.boxes)
        overlap[list(taken)] = 0.0
        best = int(overlap.argmax())
        if overlap[best] >= 0.5:
            taken.add(best)
            box, parts = found.boxes[index], found.parts[index]
            samples.box.append((box, parts, view, shot.places[best], float(found.scores[index])))


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
    return _placed_loss(law, samples, *placed(law, samples))


def placed(law: BoxLaw, samples: list[BoxSample]) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 2, 2) m of the positions by boxes alone, and covariances (n, 2, 2, 2) m² before the law's last steps.

    Each box is placed with the parts and the score, and without. A fit that fails is an outlier.
    """
    errors, covariances = [], []
    bare = dataclasses.replace(law, spread=1.0, floor_m=0.0, sure=1.0, unsure=0.0)
    for view, scene in itertools.groupby(samples, key=lambda sample: sample[2]):
        boxes, parts, _, places, scores = (np.array(column, object) for column in zip(*scene, strict=True))
        columns = boxes, parts, places, scores
        boxes, parts, places, scores = (np.stack(list(column)).astype(float) for column in columns)
        both = [locate_boxes(boxes, view, known, law=bare, scores=scores) for known in (parts, None)]
        failed = ~np.stack([found.explained for found in both], axis=1)
        error = np.stack([found.positions - places for found in both], axis=1)
        covariance = np.stack([found.covariances for found in both], axis=1)
        errors.append(np.where(failed[..., None], 1e3, error))
        covariances.append(np.where(failed[..., None, None], np.eye(2), covariance))
    return np.concatenate(errors), np.concatenate(covariances)


def _placed_loss(law: BoxLaw, samples: list[BoxSample], errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    wider = law.sure + law.unsure * np.sqrt(1 - np.array([score for *_, score in samples]))
    wider = np.column_stack([wider, np.ones(len(wider))])[..., None, None]  # with the score, and without
    wide = wider**2 * (law.spread * covariances + law.floor_m**2 * np.eye(2))
    return surprise(errors.reshape(-1, 2), wide.reshape(-1, 2, 2)).reshape(-1, 2).mean(axis=1)


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
        found = _least(lambda law: float(loss(law, samples).mean()), standing, 200)[0]
    return type(standing)(*(float(f"{number:.3g}") for number in dataclasses.astuple(found)))


def fit_box(standing: BoxLaw, samples: list[BoxSample]) -> BoxLaw:
    """Find the law of boxes: its last steps anew for each trial of the others, since they cost next to nothing."""
    best: dict[float, BoxLaw] = {}

    def cost(law: BoxLaw) -> float:
        errors, covariances = placed(law, samples)
        inner, least = _least(
            lambda inner: float(_placed_loss(_with(law, inner), samples, errors, covariances).mean()),
            _Rest(standing.spread, standing.floor_m, standing.sure, standing.unsure),
            150,
        )
        best[least] = _with(law, inner)
        return least

    _least(cost, standing, 60, ("side", "part", "part_unsure"))
    return best[min(best)]


@dataclasses.dataclass(frozen=True)
class _Rest:
    """The numbers of a BoxLaw that do not move the fit itself."""

    spread: float
    floor_m: float
    sure: float
    unsure: float


def _with(law: BoxLaw, rest: _Rest) -> BoxLaw:
    return dataclasses.replace(law, **dataclasses.asdict(rest))


def _least(
    cost: Callable[[Any], float], start: Any, evaluations: int, names: tuple[str, ...] = ()
) -> tuple[Any, float]:
    """Minimize over the logarithms of a law's numbers, of all or those named (Nelder and Mead 1965): law and cost."""
    names = names or tuple(field.name for field in dataclasses.fields(start))

    def law(logarithms: np.ndarray) -> Any:
        return dataclasses.replace(start, **dict(zip(names, np.exp(logarithms).tolist(), strict=True)))

    def cost_of(logarithms: np.ndarray) -> float:
        return cost(law(logarithms))

    begin = np.log([getattr(start, name) for name in names])
    options: Any = {"maxfev": evaluations, "xatol": 0.01, "fatol": 1e-4}
    options["initial_simplex"] = np.vstack([begin, begin + 0.3 * np.eye(len(begin))])
    found = minimize(cost_of, begin, method="Nelder-Mead", options=options)
    return law(found.x), float(found.fun)


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


def joined(scenes_of: list[Samples], name: str) -> list:
    """The samples of a name of all scenes."""
    return [sample for scene in scenes_of for sample in getattr(scene, name)]


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
    parser.add_argument("--worlds", type=int, default=60, help="random worlds, of three pictures")
    parser.add_argument("--world", type=int, default=7000, help="seed of the first world that is fitted to")
    parser.add_argument("--other-world", type=int, default=5300, help="seed of the first world that judges")
    parser.add_argument("--only", nargs="*", default=list(LAWS), help="laws to fit; the others stay")
    parser.add_argument("--keep", nargs="*", default=[], choices=LAWS, help="laws that stay in any case")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    found: dict[str, dict[str, Any]] = {"laws": {}, "losses": {}}
    if options.only:
        mine, others = [], []
        if set(options.only) != {"faint"}:
            mine, others = (
                collect(options.scenes, options.frames, seed) for seed in (options.seed, options.other_seed)
            )
        if "faint" in options.only:
            mine += collect_worlds(options.worlds, 3, options.world)
            others += collect_worlds(options.worlds, 3, options.other_world)
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
