"""Fit what avdetect-video says of clothes to rendered and to real people, and judge it on others.

    make fit-looks FIT_FLAGS="--real FOLDER"

Rendered people: scenes, looks, lenses and furniture are random (examples/train-detector/renders.py); so are exposure,
gain, the light's colour, a lamp or a shadow, glare and noise of each picture. Real clothes are duller than those
looks, so their colours are drawn half-way towards grey. Real people: looks_real.py says which, and from where; films of
even numbers are fitted to, films of odd numbers judge. Without --real all is fitted to renders alone, which are too
easy. With it, the people of both count the same.

Two files are written: avcli/detection/looks.json has the errors of a measurement, avcli/formats/features/clothes.json
has how people differ. How errors last was measured on the real films: after two frames .2 of what it is after 300, half
of it after about 20 frames, and it still grows after 100.
"""

import argparse
import dataclasses
import json
import subprocess
from collections.abc import Callable, Iterable
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import looks_real
import numpy as np
from bench_detection import scenes
from generate import random_look
from renders import Shot
from scipy.optimize import minimize

from avcli import __version__
from avcli.detection import looks
from avcli.detection.body import Person
from avcli.detection.depth import DepthDetector
from avcli.detection.looks import COMPONENTS, KIND, NAME, Looks, LooksLaw
from avcli.detection.network import Network, own_model
from avcli.formats import features
from avcli.scene.person import Colour, Look

GATE_M = {"depth": 0.3, "monocular": 0.5}
"""m; a person found farther than this from everybody is nobody."""

OUTLIERS = 0.03
"""Share of measurements that no standard deviation explains (another person's body in the box), as in avfuse."""

DOUBT = 1.5
"""Factor on the standard deviations of least cost: to be sure and wrong is worse than to be unsure."""

CORRELATION_S, CORRELATED = 5.0, 0.8
"""How errors last, from the real films (15 to 30 frames a second)."""

SPREADS = LooksLaw(np.zeros(len(COMPONENTS)), 1.0)
"""With it the standard deviations of `Looks` are the bare spreads."""


@dataclasses.dataclass
class Sights:
    """n descriptions of people.

    Attributes:
        vectors, spreads: (n, 7).
        people: (n,) number of the person.
        same, different: (m, 2) pairs of descriptions of one person, and of two.
    """

    vectors: np.ndarray
    spreads: np.ndarray
    people: np.ndarray
    same: np.ndarray
    different: np.ndarray


def dull_look(rng: np.random.Generator, height: float) -> Look:
    """Clothes of somebody, half as colourful as a random look."""
    look = random_look(rng, height)

    def dulled(colour: Colour) -> Colour:
        red, green, blue = (0.5 * (value + sum(colour) / 3) for value in colour)
        return red, green, blue

    second = None if look.second is None else dulled(look.second)
    return dataclasses.replace(look, shirt=dulled(look.shirt), trousers=dulled(look.trousers), second=second)


def disturbed(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Change the light and the camera of a picture (height, width, 3) uint8."""
    height, width = picture.shape[:2]
    v, u = np.mgrid[:height:8, :width:8]
    away = (u - rng.uniform(0, width)) ** 2 + (v - rng.uniform(0, height)) ** 2
    lamp = np.exp(-away / (2 * (rng.uniform(0.1, 0.4) * width) ** 2))[..., None] * rng.uniform(-0.5, 0.7)
    light = (1 + lamp * np.exp(rng.uniform(-0.1, 0.1, 3))).astype(np.float32)
    light *= np.exp(rng.uniform(np.log(0.6), np.log(1.4))) * np.exp(rng.uniform(-0.12, 0.12, 3))
    values = picture * cv2.resize(light, (width, height)) + rng.uniform(0, 10)
    noise = rng.normal(0, rng.uniform(0, 8), (128, 128, 3))
    values += np.tile(noise, (-(-height // 128), -(-width // 128), 1))[:height, :width]
    return np.clip(values, 0, 255).astype(np.uint8)


Row = tuple[np.ndarray, np.ndarray, int, int]


def collect(count: int, frames: int, seed: int) -> dict[str, Sights]:
    """Describe rendered people, placed by depth and without it, on `frames` pictures of each of `count` scenes."""
    rng = np.random.default_rng([seed, 1])
    network = Network(own_model())
    rows: dict[str, list[Row]] = {method: [] for method in GATE_M}
    for scene, (drawn, view) in enumerate(scenes(count, frames, seed, look=dull_look)):
        depth = DepthDetector(view, view.sampled(drawn[0].background))
        describers = {method: Looks(view, SPREADS) for method in GATE_M}
        for shot in drawn:
            picture = disturbed(rng, shot.picture)
            found = {
                "depth": depth.detect(view.sampled(shot.depth)),
                "monocular": depth.place(network.detect(picture), None),
            }
            for method, people in found.items():
                described = describers[method].describe(picture, people)
                for (vector, spread), number in zip(described, whose(people, shot, GATE_M[method]), strict=True):
                    if number is not None:
                        rows[method].append((vector, spread, 10 * scene + number, scene))
    return {method: rendered(own) for method, own in rows.items()}


def whose(people: list[Person], shot: Shot, gate: float) -> list[int | None]:
    """Number of each person who was found, None where nobody stands there."""
    numbers: list[int | None] = []
    for person in people:
        away = np.linalg.norm(shot.places - person.position[:2], axis=1)
        near = bool(len(away)) and away.min() < gate
        numbers.append(int(shot.numbers[away.argmin()]) if near else None)
    return numbers


def rendered(rows: list[Row]) -> Sights:
    """Sights with all pairs of one person, and some of people of two scenes."""
    vectors, spreads, people, places = (np.array(column) for column in zip(*rows, strict=True))
    same = [pair for k in np.unique(people) for pair in combinations(np.flatnonzero(people == k), 2)]
    some = np.random.default_rng(0).integers(0, len(rows), (3000, 2))
    different = some[places[some[:, 0]] != places[some[:, 1]]]
    return Sights(vectors, spreads, people, np.array(same).reshape(-1, 2), different)


def real(folder: Path, films: Iterable[int]) -> Sights:
    """Describe the people of real films."""
    rows: list[Row] = []
    for film in films:
        describer = None
        for frame, picture, people, numbers, view in looks_real.pictures(folder, film):
            describer = describer or Looks(view, SPREADS)
            for (vector, spread), number in zip(describer.describe(picture, people), numbers, strict=True):
                rows.append((vector, spread, 1000 * film + int(number), 1000 * film + frame))
    vectors, spreads, people_of, frames = (np.array(column) for column in zip(*rows, strict=True))
    return Sights(vectors, spreads, people_of, *looks_real.pairs(people_of, frames))


# --- how well people are told apart -----------------------------------------------------------------------------------


@dataclasses.dataclass
class Population:
    """Mean (7,) of people's own vectors, and variance (7,) between them."""

    mean: np.ndarray
    between: np.ndarray


def population(everybody: Iterable[Sights]) -> Population:
    """Sum people up, each by the medians of his descriptions."""
    own = [np.nanmedian(each.vectors[each.people == k], axis=0) for each in everybody for k in np.unique(each.people)]
    return Population(np.nanmean(own, axis=0), np.nanvar(own, axis=0))


def groups(sets: dict[str, Sights]) -> list[list[Sights]]:
    """The sets of rendered people, and those of real ones."""
    parts = [[each for name, each in sets.items() if (name == "real") == real] for real in (False, True)]
    return [part for part in parts if part]


def average(populations: list[Population]) -> Population:
    """Mean of populations, each of which counts the same."""
    means, variances = zip(*((one.mean, one.between) for one in populations), strict=True)
    return Population(np.mean(means, axis=0), np.mean(variances, axis=0))


def log_ratios(sights: Sights, law: LooksLaw, people: Population, pairs: np.ndarray) -> np.ndarray:
    """Log likelihood ratios (m,) of "one person" over "two" for pairs (m, 2), by the two-covariance model."""
    sds, between = law.deviations(sights.spreads), people.between
    one, other = (sights.vectors[pairs[:, k]] - people.mean for k in (0, 1))
    a, b = (between + sds[pairs[:, k]] ** 2 for k in (0, 1))
    determinant = a * b - between**2
    joint = (b * one**2 - 2 * between * one * other + a * other**2) / determinant
    ratio = 0.5 * (np.log(a * b / determinant) + one**2 / a + other**2 / b - joint)
    return np.logaddexp(np.log(1 - OUTLIERS) + np.nansum(ratio, axis=1), np.log(OUTLIERS))


def cost(same: np.ndarray, different: np.ndarray) -> float:
    """Cost of log ratios of pairs of one person and of two (Cllr, bits; Bruemmer and du Preez 2006); 1: no use."""
    return float((np.logaddexp(0, -same).mean() + np.logaddexp(0, different).mean()) / 2 / np.log(2))


def judge(sights: Sights, law: LooksLaw, people: Population) -> dict[str, float]:
    """Judge a law: equal error rate, Cllr and what it is after linear calibration, slope of that, share of sure errors.

    "squares" is the mean of squared differences of a person, each in units of what it is said to be, at most 9.
    """
    same, different = (log_ratios(sights, law, people, pairs) for pairs in (sights.same, sights.different))
    best = least(lambda state: cost(*(state[0] * part + state[1] for part in (same, different))), np.array([1.0, 0.0]))
    grid = np.quantile(np.concatenate([same, different]), np.linspace(0, 1, 500))
    errors = np.array([[(same <= at).mean(), (different > at).mean()] for at in grid])
    variances = law.deviations(sights.spreads) ** 2
    one, other = sights.same.T
    squares = (sights.vectors[one] - sights.vectors[other]) ** 2 / (variances[one] + variances[other])
    figures = {
        "equal_error_rate": errors[np.abs(errors[:, 0] - errors[:, 1]).argmin()].mean(),
        "cllr": cost(same, different),
        "least_cllr": cost(*(best[0] * part + best[1] for part in (same, different))),
        "slope": best[0],
        "wrong_20_to_1": (np.mean(same < -3) + np.mean(different > 3)) / 2,
        "squares": np.nanmean(np.minimum(squares, 9)),
    }
    return {"descriptions": len(sights.people)} | {name: round(float(value), 3) for name, value in figures.items()}


def fit_law(everybody: Iterable[Sights], people: Population) -> LooksLaw:
    """Find the law of least cost over all sets; lightness, warm and green have one floor in both parts of the body."""
    sets = list(everybody)

    def law(logs: np.ndarray) -> LooksLaw:
        head, light, warm, green, slope = np.exp(logs)
        return LooksLaw(np.array([head, light, warm, green, light, warm, green]), float(slope))

    def mean_cost(logs: np.ndarray) -> float:
        ratios = [[log_ratios(each, law(logs), people, k) for k in (each.same, each.different)] for each in sets]
        return float(np.mean([cost(*pair) for pair in ratios]))

    found = law(least(mean_cost, np.log([0.3, 0.15, 0.05, 0.025, 0.6])))
    return LooksLaw((DOUBT * found.floor).round(3), round(DOUBT * found.slope, 3))


def least(function: Callable[[np.ndarray], float], start: np.ndarray) -> np.ndarray:
    """Where a function is least (Nelder and Mead 1965)."""
    options: Any = {"maxfev": 500, "xatol": 1e-2, "fatol": 1e-4}
    found: np.ndarray = minimize(function, start, method="Nelder-Mead", options=options).x
    return found


# --- files ------------------------------------------------------------------------------------------------------------


def write(options: argparse.Namespace, fitted_to: dict[str, Sights], others: dict[str, Sights]) -> None:
    """Fit to some descriptions, judge on others, write."""
    people = average([population(group) for group in groups(fitted_to)])
    law = fit_law(fitted_to.values(), people)
    place = Path(__file__).parent
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=place, capture_output=True, text=True)
    origin: dict[str, Any] = {
        "command": "tests/bench/fit_looks.py",
        "data": "renders of random scenes in random light, examples/train-detector/renders.py, 1920 x 1080"
        + (
            "; real films, tests/bench/looks_real.py: even ones fitted to, odd ones judge"
            if "real" in fitted_to
            else ""
        ),
        **{name: getattr(options, name) for name in ("scenes", "frames", "seed", "other_seed")},
        "doubt": DOUBT,
        "version": __version__,
        "commit": commit.stdout.strip() or None,
        "fitted": {name: judge(each, law, people) for name, each in fitted_to.items()},
        "others": {name: judge(each, law, people) for name, each in others.items()},
    }
    numbers = {"floor": law.floor.tolist(), "slope": law.slope}
    options.law.write_text(json.dumps({**numbers, "fitted_on": origin}, indent=2) + "\n")
    within = [law.deviations(each.spreads) ** 2 for each in fitted_to.values()]
    kind = {
        "kind": KIND,
        "name": NAME,
        "components": COMPONENTS,
        "mean": people.mean.round(3).tolist(),
        "between": people.between.round(4).tolist(),
        "within": np.nanmedian(np.concatenate(within), axis=0).round(4).tolist(),
        "correlation_s": CORRELATION_S,
        "correlated": CORRELATED,
        "fitted_on": origin,
    }
    options.kind.write_text(json.dumps(kind, indent=2) + "\n")
    print(json.dumps({**numbers, **kind}, indent=2))


def main() -> None:
    """Fit, judge, and write the two files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--law", type=Path, default=Path(looks.__file__).with_name("looks.json"))
    parser.add_argument("--kind", type=Path, default=Path(features.__file__).with_name(f"{KIND}.json"))
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--frames", type=int, default=6, help="frames of a scene")
    parser.add_argument("--seed", type=int, default=740_000, help="of the scenes that are fitted to")
    parser.add_argument("--other-seed", type=int, default=730_000, help="of the scenes that judge")
    parser.add_argument("--real", type=Path, metavar="FOLDER", help="of the real films")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    fitted_to, others = (collect(options.scenes, options.frames, k) for k in (options.seed, options.other_seed))
    if options.real:
        films = sorted(looks_real.films(options.real))
        fitted_to["real"] = real(options.real, [film for film in films if film % 2 == 0])
        others["real"] = real(options.real, [film for film in films if film % 2 == 1])
    write(options, fitted_to, others)


if __name__ == "__main__":
    main()
