"""Fit how far further talkers beside a line of microphones may be believed, and write avcli/localization/line.json.

    make fit-line

Scenes are simulated by avcli's own acoustics, with real speech (CMU ARCTIC aew to fit, axb to check) where
../shared/data or AVCLI_SHARED_DATA has it: lines of 4 to 16 microphones and .8 to 4 m, on walls, under ceilings, on
tables and aslant in rooms of 4 to 10 m and T60 .15 to .8 s, with one or two people who stand or walk. What is found is
right within .5 m in the half-plane beside the line, where only one report is a person's.
"""

import itertools
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))


import numpy as np  # noqa: E402
from fit_localization import log_loss, logistic, rounded  # noqa: E402
from localization_scenes import FS, Person, acted, recorded, voices  # noqa: E402

from avcli.formats.experiment import Config  # noqa: E402
from avcli.formats.media import Sound  # noqa: E402
from avcli.formats.records import Identified  # noqa: E402
from avcli.localization.array import Array, Talker  # noqa: E402
from avcli.localization.line import HalfPlane  # noqa: E402
from avcli.localization.noise import NoiseLaw  # noqa: E402
from avcli.localization.places import Judged, PlaceFinder  # noqa: E402
from avcli.localization.settings import SteeredSettings  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402
from avcli.localization.windows import Heard  # noqa: E402

FITTED = ROOT / "avcli" / "localization" / "line.json"
SPLITS = {"fit": (341, 150), "held out": (349, 100)}
"""Seed and number of scenes."""
SECONDS, RIGHT_M = 4.0, 0.5
KINDS, ACTS = ("wall", "ceiling", "table", "aslant"), ("still", "still", "walking", "two")
BOUNDS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.01)


@dataclass(frozen=True)
class Scene:
    """What a line heard of whom.

    Attributes:
        kind: where the line is.
        array: the microphones and the room.
        samples: (n, m).
        people: who talked.
    """

    kind: str
    array: Array
    samples: np.ndarray
    people: list[Person]


@dataclass(frozen=True)
class Row:
    """A place that was found.

    Attributes:
        kind: where the line is.
        first: whether it was the decision's first.
        score: as it was judged.
        right: whether it is a talker's.
        distance: Mahalanobis distance² of that talker in the half-plane, and the least one of the sides in the room.
    """

    kind: str
    first: bool
    score: float
    right: bool
    distance: tuple[float, float]


def scenes(split: str, spoken: Sequence[Sound]) -> Iterator[Scene]:
    """Yield the scenes of a split."""
    seed, count = SPLITS[split]
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        room = np.array([rng.uniform(4.0, 10.0), rng.uniform(3.5, 8.0), rng.uniform(2.5, 3.3)])
        microphones, long = int(rng.integers(4, 17)), min(rng.uniform(0.8, 4.0), 0.9 * room[0])
        kind = KINDS[rng.integers(len(KINDS))]
        along = long * np.linspace(-0.5, 0.5, microphones)[:, None]
        if kind == "wall":
            middle, axis = np.array([room[0] / 2, 0.05, rng.uniform(1.0, 2.3)]), np.array([1.0, 0.0, 0.0])
        else:
            height = {"ceiling": room[2] - 0.05, "table": 0.75, "aslant": 1.4}[kind]
            middle, axis = np.array([room[0] / 2, room[1] * rng.uniform(0.3, 0.7), height]), np.array([1.0, 0.0, 0.0])
        if kind == "aslant":
            axis = np.array([1.0, rng.uniform(-0.6, 0.6), rng.uniform(-0.4, 0.4)])
        places = np.clip(middle + along * axis / np.linalg.norm(axis), 0.02, room - 0.02)
        times = np.arange(0.0, SECONDS + 0.05, 0.1)
        mouths, turns = acted(str(rng.choice(ACTS)), room, times, rng)
        config = Config(
            {
                "microphone_config": {"audio_sample_rate_hz": FS, "mic_positions_m": places.tolist()},
                "room_config": {"room_dimensions_m": room.tolist()},
            }
        )
        truth = [
            Identified(round(float(time), 4), np.arange(len(mouths)), mouths[:, k] * [1.0, 1.0, 0.0],
                       mouths=mouths[:, k], speaking=turns[:, k].astype(float))
            for k, time in enumerate(times)
        ]  # fmt: skip
        speech = [spoken[index] for index in rng.permutation(len(spoken))[:3]] if spoken else None
        samples, activity = recorded(config, truth, round(float(rng.uniform(0.15, 0.8)), 2), speech)
        level = float(np.sqrt(np.mean(samples**2)) * 10.0 ** (-rng.uniform(10.0, 35.0) / 20.0))
        samples = samples + level * rng.standard_normal(samples.shape, np.float32)
        people = [Person(times, mouth, activity.get(k, [])) for k, mouth in enumerate(mouths)]
        yield Scene(kind, Array.of(config), samples, people)


class Witness(PlaceFinder):
    """A finder that notes each of its places."""

    def __init__(self, finder: PlaceFinder, beside: HalfPlane, scene: Scene):
        vars(self).update(vars(finder))
        self.beside, self.scene, self.rows = beside, scene, list[Row]()

    def report(self, time: float, judged: list[Judged], heard: Heard, noise: NoiseLaw) -> list[Talker]:
        """Note the places of a decision, and report them as ever."""
        mouths = [person.at(time) for person in self.scene.people if person.sounds(time, 0.1)]
        taken: set[int] = set()
        for one in judged:
            covariance = self.covariance(one, heard.offsets, noise)
            away = [self.beside.flat(mouth) - one.peak.position for mouth in mouths]
            nearest = min(range(len(away)), key=lambda k: float(np.linalg.norm(away[k])), default=-1)
            right = nearest not in {-1, *taken} and float(np.linalg.norm(away[nearest])) < RIGHT_M
            distance = np.inf, np.inf
            if right:
                taken.add(nearest)
                sides = self.beside.sides(Talker(one.peak.position, covariance, one.score))
                distance = (
                    _squared(away[nearest], covariance),
                    min(_squared(mouths[nearest] - side.position, side.covariance) for side in sides),
                )
            self.rows.append(Row(self.scene.kind, one.features.first, one.score, right, distance))
        return super().report(time, judged, heard, noise)


def _squared(away: np.ndarray, covariance: np.ndarray) -> float:
    """Return the squared Mahalanobis distance of (3,) m in the first two coordinates."""
    return float(away[:2] @ np.linalg.solve(covariance[:2, :2], away[:2]))


def rows(heard: Iterator[Scene]) -> list[Row]:
    """Return the places that are found in scenes, their scores as they are judged without line.json."""
    found: list[Row] = []
    for scene in heard:
        localizer = SteeredLocalizer(scene.array, SteeredSettings(), np.random.default_rng(0))
        if not isinstance(localizer.half, HalfPlane) or not isinstance(localizer.finder, PlaceFinder):
            continue
        witness = Witness(localizer.finder, localizer.half, scene)
        localizer.finder = witness
        for _ in localizer.localize([Block(scene.samples)]):
            pass
        found += witness.rows
    return found


def described(found: Sequence[Row], weights: dict[str, float] | None) -> dict[str, Any]:
    """Return how scores and ellipses hold, further scores by weights of `line.believed`; None: as they are."""
    told: dict[str, Any] = {}
    for name in ("first", "further"):
        mine = [one for one in found if one.first == (name == "first")]
        said, right = np.array([one.score for one in mine]), np.array([one.right for one in mine])
        if name == "further" and weights:
            said = 1.0 / (1.0 + np.exp(-(_terms(said) @ list(weights.values()))))
        told[name] = {"log_loss": round(log_loss(right, said), 4)}
        for low, high in itertools.pairwise(BOUNDS):
            bin_ = (said >= low) & (said < high)
            if bin_.any():
                told[name][f"from {low:g}"] = [int(bin_.sum()), *np.round([said[bin_].mean(), right[bin_].mean()], 3)]
    for kind in ("all", *KINDS):
        inside = np.array([one.distance for one in found if one.right and kind in ("all", one.kind)]) < 5.991
        told[f"ellipses, {kind}"] = [len(inside), *inside.mean(axis=0).round(3)]
    return told


def _terms(scores: np.ndarray) -> np.ndarray:
    """Return a constant and the logits of scores (n,), (n, 2)."""
    within = np.clip(scores, 1e-6, 1.0 - 1e-6)
    return np.column_stack([np.ones(len(within)), np.log(within / (1.0 - within))])


def main() -> None:
    """Fit, check and write."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    found, held_out = (rows(scenes(split, voices(split, folder))) for split in SPLITS)
    further = [one for one in found if not one.first]
    terms, right = _terms(np.array([one.score for one in further])), np.array([one.right for one in further])
    law = dict(zip(("one", "score"), rounded(logistic(terms, right, np.ones(len(right)))), strict=True))
    content = {
        "further": law,
        "fitted_on": {
            "command": "tests/bench/fit_line.py",
            "speech": "CMU ARCTIC aew; held out: axb" if folder.exists() else "synthetic voices",
            "scenes": {split: {"seed": seed, "count": count} for split, (seed, count) in SPLITS.items()},
            "columns": "scores: count, said, true; ellipses of 95 %: count, inside in the half-plane, in the room",
            "held_out_before": described(held_out, None),
            "held_out": described(held_out, law),
        },
    }
    FITTED.write_text(json.dumps(content, indent=1) + "\n")
    print(FITTED.read_text())


if __name__ == "__main__":
    main()
