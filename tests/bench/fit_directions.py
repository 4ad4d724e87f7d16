"""Fit how far the directions of compact arrays may be believed, and write avcli/localization/directions.json.

    make fit-directions

Scenes are simulated by avcli's own acoustics, with real speech (CMU ARCTIC aew to fit, axb to check) where
../shared/data or AVCLI_SHARED_DATA has it: rings, spheres, planes, lines and irregular arrays of 4 to 10 microphones
and 6 to 40 cm, on tables, walls and ceilings, in rooms of 3.5 to 10 m and T60 .15 to .9 s, one or two people who stand.
What is remembered rests on the law that stands: scenes are heard twice, the second time by the law of the first.
"""

import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from fit_localization import log_loss, rounded  # noqa: E402
from fit_scores import undecided  # noqa: E402
from localization_scenes import FS, Person, recorded, voices  # noqa: E402
from scipy.optimize import minimize  # noqa: E402

from avcli.formats.experiment import Config  # noqa: E402
from avcli.formats.media import Sound  # noqa: E402
from avcli.formats.records import Identified  # noqa: E402
from avcli.localization.array import Array, Talker  # noqa: E402
from avcli.localization.directions import (  # noqa: E402
    Bearing,
    DirectionFinder,
    DirectionLaw,
    Found,
    fitted_law,
    tangents,
)
from avcli.localization.settings import SteeredSettings  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402
from avcli.localization.uncertainty import After, after_terms  # noqa: E402

FITTED = ROOT / "avcli" / "localization" / "directions.json"
SPLITS = {"fit": (31, 300), "held out": (5031, 100)}
"""Seed and number of scenes."""
SECONDS, RIGHT = 4.5, np.radians(10.0)
FIRST = ("one", "agreement", "coherence", "narrow", "wide", "strongest", "few", "before")
FURTHER = ("one", "agreement", "coherence", "wide", "strongest", "few", "own", "before")
AFTER = ("one", "score", "again")
SPREAD = {
    "level": ("one", "agreement", "size", "few"),
    "upward": ("one", "coherence", "size", "few", "mirror"),
}
UNSEEN = 1.0
"""rad²: a larger variance by the curvature alone is of what was not observed, as the elevation by a line."""
PARTS = 6
"""In so many parts the scenes are split; each is predicted from the others."""


@dataclass(frozen=True)
class Scene:
    """What a compact array heard, samples (n, m), of whom."""

    array: Array
    samples: np.ndarray
    people: list[Person]


@dataclass(frozen=True)
class Row:
    """A direction that was found: whether it is right, its errors (2,) rad level and upward, and what is told of it.

    `after` is what the decisions after it tell, and `part` that of its scene.
    """

    right: bool
    error: np.ndarray
    terms: dict[str, float]
    shape: np.ndarray
    first: bool
    part: int
    after: After | None = None


def compact(rng: np.random.Generator) -> np.ndarray:
    """Return the shape of an array, (m, 3) m about its middle."""
    kind, count, radius = (
        rng.integers(5),
        int(rng.integers(4, 11)),
        float(np.exp(rng.uniform(np.log(0.03), np.log(0.2)))),
    )
    turn = 2.0 * np.pi * np.arange(count) / count
    ring = radius * np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])
    if kind == 0:
        return ring
    if kind == 1:
        away = rng.standard_normal((count, 3))
        return radius * away / np.linalg.norm(away, axis=1)[:, None]
    if kind == 2:  # upright, as a plate on a wall
        return ring[:, [0, 2, 1]]
    if kind == 3:
        along = np.linspace(-radius, radius, max(count, 5))
        return np.column_stack([along, 0.0 * along, 0.0 * along])
    return radius * rng.uniform(-1.0, 1.0, (count, 3))


def scenes(split: str, spoken: Sequence[Sound], numbers: Iterable[int]) -> Iterator[Scene]:
    """Yield scenes of a split by their numbers."""
    seed, _ = SPLITS[split]
    for number in numbers:
        rng = np.random.default_rng([seed, number])
        room = np.array([rng.uniform(3.5, 10.0), rng.uniform(3.5, 8.0), rng.uniform(2.5, 3.3)])
        shape = compact(rng)
        wall = np.ptp(shape[:, 1]) < 1e-6
        centre = np.array([*rng.uniform(0.3, 0.7, 2) * room[:2], rng.choice([0.8, 1.2, 2.3])])
        if wall:
            centre[1] = np.ptp(shape[:, 2]) / 2 + 0.05
        microphones = centre + shape
        mouths: list[np.ndarray] = []
        while len(mouths) < 1 + number % 2:
            place = np.array([*rng.uniform(0.4, room[:2] - 0.4), rng.uniform(1.1, 1.75)])
            bearing = np.arctan2(*(place - centre)[1::-1])
            others = [np.arctan2(*(mouth - centre)[1::-1]) for mouth in mouths]
            apart = all(abs(np.angle(np.exp(1j * (bearing - other)))) > 0.6 for other in others)
            if apart and np.linalg.norm((place - centre)[:2]) > 0.7:
                mouths.append(place)
        times = np.arange(0.0, SECONDS + 0.05, 0.1)
        talk = [(times > begin) & (times < begin + length) for begin, length in zip(
            rng.uniform(0.1, 0.6, len(mouths)), rng.uniform(2.5, 3.3, len(mouths)), strict=True)]  # fmt: skip
        config = Config(
            {
                "microphone_config": {"audio_sample_rate_hz": FS, "mic_positions_m": microphones.tolist()},
                "room_config": {"room_dimensions_m": room.tolist()},
            }
        )
        identities, at = np.arange(len(mouths)), np.array(mouths)
        truth = [
            Identified(round(float(time), 4), identities, at * [1.0, 1.0, 0.0], mouths=at,
                       speaking=np.array([float(one[step]) for one in talk]))
            for step, time in enumerate(times)
        ]  # fmt: skip
        speech = [spoken[index] for index in rng.permutation(len(spoken))[:3]] if spoken else None
        samples, activity = recorded(config, truth, round(float(rng.uniform(0.15, 0.9)), 2), speech)
        level = float(np.sqrt(np.mean(samples**2)) * 10.0 ** (-rng.uniform(10.0, 35.0) / 20.0))
        samples = samples + level * rng.standard_normal(samples.shape, np.float32)
        people = [Person(times, np.tile(mouth, (len(times), 1)), activity.get(k, [])) for k, mouth in enumerate(mouths)]
        yield Scene(Array.of(config), samples, people)


class Witness(DirectionFinder):
    """A finder that notes each of its bearings."""

    def __init__(self, finder: DirectionFinder, scene: Scene, part: int):
        vars(self).update(vars(finder))
        self.scene, self.part, self.rows = scene, part, list[Row]()

    def talkers_of(self, found: Found, later: Sequence[Found | None]) -> list[Talker]:
        """Note the bearings of a decision, and tell its talkers as ever."""
        taken: set[int] = set()
        for one in found.bearings:
            self.note(one, found, later, taken)
        return super().talkers_of(found, later)

    def note(self, one: Bearing, found: Found, later: Sequence[Found | None], taken: set[int]) -> None:
        """Note a bearing, as the nearest person's who is not taken yet, or the mirror image of that."""
        best: tuple[float, int, np.ndarray] = (np.inf, -1, np.zeros(2))
        for number, person in enumerate(self.scene.people):
            true = person.at(found.time) - self.response.centre
            ray = max(self.images(one.ray), key=lambda image: float(image @ true))
            error = tangents(ray) @ (true / np.linalg.norm(true))
            if self.line is not None:
                error = np.array([self.line.angle(ray) - self.line.angle(true / np.linalg.norm(true)), np.nan])
            if (self.line is not None or ray @ true > 0.0) and abs(error[0]) < best[0]:
                best = (abs(float(error[0])), number, error)
        right = best[0] < RIGHT and best[1] not in taken and self.scene.people[best[1]].sounds(found.time, 0.1)
        if right:
            taken.add(best[1])
        law, self.law = self.law, replace(self.law, spread={along: {} for along in SPREAD})
        shape = self.across(one, found.noise)
        self.law = law
        after = self.after(one, found.time, later) if later else None
        self.rows.append(Row(right, best[2], one.terms, shape, one.first, self.part, after))


def rows(law: DirectionLaw, heard: Iterable[Scene]) -> list[Row]:
    """Return the bearings that are found in scenes with a law."""
    found: list[Row] = []
    for number, scene in enumerate(heard):
        localizer = SteeredLocalizer(scene.array, SteeredSettings(), np.random.default_rng(0))
        if not isinstance(localizer.finder, DirectionFinder):
            continue
        witness = Witness(localizer.finder, scene, number % PARTS)
        witness.law = law
        localizer.finder = witness
        for _ in localizer.localize([Block(scene.samples)]):
            pass
        found += witness.rows
    return found


def logistic(found: Sequence[Row], names: Sequence[str], ridge: float = 0.5) -> dict[str, float]:
    """Return the weights of a logistic regression."""
    terms = np.array([[row.terms[name] for name in names] for row in found])
    sign = np.where([row.right for row in found], 1.0, -1.0)

    def loss(weights: np.ndarray) -> float:
        return float(np.logaddexp(0.0, -sign * (terms @ weights)).sum() + ridge * (weights[1:] ** 2).sum())

    return dict(zip(names, np.round(minimize(loss, np.zeros(len(names))).x, 2).tolist(), strict=True))


def width(found: Sequence[Row], along: str) -> dict[str, float]:
    """Return the weights of the spread along one tangent: the likelihood of the errors, Student's t, and 95 % within
    1.96 standard deviations."""
    axis, names = list(SPREAD).index(along), SPREAD[along]
    some = [row for row in found if row.right and row.shape[axis, axis] < UNSEEN]
    error, shape = np.array([row.error[axis] for row in some]), np.array([row.shape[axis, axis] for row in some])
    terms = np.array([[row.terms[name] for name in names] for row in some])

    def loss(weights: np.ndarray) -> float:
        variance = np.exp(2.0 * terms @ weights) * shape
        return float(np.mean(0.5 * np.log(variance) + 2.5 * np.log1p(error**2 / (4.0 * variance))))

    one, *weights = minimize(loss, np.zeros(len(names))).x
    ratio = np.abs(error) / np.sqrt(np.exp(2.0 * terms @ [one, *weights]) * shape)
    one += float(np.log(np.quantile(ratio, 0.95) / 1.96))
    return dict(zip(names, np.round([one, *weights], 2).tolist(), strict=True))


def described(found: Sequence[Row], law: DirectionLaw) -> dict[str, Any]:
    """Return how well a law holds: log losses, and how often errors are within 1.96 standard deviations.

    Of the scores between two tenths it says how many there are, what they say on average, and how many are right.
    """
    said: dict[str, Any] = {}
    for name, first in (("first", True), ("further", False)):
        some = [row for row in found if row.first == first]
        at_once = np.array([law.probability(row.terms, first=first) for row in some])
        p = np.array(
            [law.borne_out(row.after, first=first) if row.after else q for row, q in zip(some, at_once, strict=True)]
        )
        right = np.array([row.right for row in some])
        said[f"{name}_log_loss_at_once"], said[f"{name}_log_loss"] = log_loss(right, at_once), log_loss(right, p)
        said[f"{name}_said"], said[f"{name}_true"], said[f"{name}_count"] = p.mean(), right.mean(), len(some)
        tenth = np.minimum((10.0 * p).astype(int), 9)
        said[f"{name}_by_tenths"] = [
            [int(here.sum()), round(float(p[here].mean()), 3), round(float(right[here].mean()), 3)]
            for here in (tenth == k for k in range(10))
            if here.any()
        ]
    for axis, (along, weights) in enumerate(law.spread.items()):
        some = [row for row in found if row.right and row.shape[axis, axis] < UNSEEN]
        factor = np.exp([sum(weight * row.terms[name] for name, weight in weights.items()) for row in some])
        sd, error = factor * np.sqrt([r.shape[axis, axis] for r in some]), np.abs([row.error[axis] for row in some])
        said[f"{along}_within_1.96_sd"] = float(np.mean(error < 1.96 * sd))
        said[f"{along}_median_error_deg"] = np.degrees(np.median(error))
        said[f"{along}_median_sd_deg"] = np.degrees(np.median(sd))
    return {name: value if isinstance(value, list) else round(float(value), 3) for name, value in said.items()}


def fitted(found: Sequence[Row], law: DirectionLaw) -> DirectionLaw:
    """Return a law fitted to bearings; what the law before remembered is in their terms, and its scores in `after`."""
    first = logistic([row for row in found if row.first], FIRST)
    further = logistic([row for row in found if not row.first], FURTHER)
    after = {}
    for name in ("first", "further"):
        some = [row for row in found if row.after and row.first == (name == "first")]
        terms = np.array([[after_terms(row.after)[term] for term in AFTER] for row in some if row.after])
        right = np.array([row.right for row in some])
        after[name] = dict(zip([*AFTER, "middle"], rounded(undecided(terms, right, np.ones(len(some)))), strict=True))
    return replace(
        law, first=first, further=further, after=after, spread={along: width(found, along) for along in SPREAD}
    )


def main() -> None:
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    law = fitted_law()
    for _ in range(2):
        law = fitted(rows(law, heard("fit", folder)), law)
    write(law, rows(law, heard("held out", folder)), real=folder.exists())


def heard(split: str, folder: Path) -> Iterator[Scene]:
    """Yield the scenes of a split, with the speech in a folder."""
    return scenes(split, voices(split, folder), range(SPLITS[split][1]))


def write(law: DirectionLaw, held_out: Sequence[Row], *, real: bool) -> None:
    """Write a law with what it was fitted on and how it holds on bearings that it was not fitted to."""
    check = described(held_out, law)
    print(law, check)
    content = {
        "law": dict(vars(law)),
        "fitted_on": {
            "command": "tests/bench/fit_directions.py",
            "speech": "CMU ARCTIC aew; held out: axb" if real else "synthetic voices",
            "scenes": {split: {"seed": seed, "count": count} for split, (seed, count) in SPLITS.items()},
            "right": "within 10 degrees in azimuth of a talker who sounds or his mirror image; of a line: in its angle",
            "held_out": check,
        },
    }
    FITTED.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
