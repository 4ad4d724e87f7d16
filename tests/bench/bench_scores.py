"""Whether avdetect-audio's scores and ellipses are true with any array: said beside true, condition by condition.

    make setup-bench bench-scores BENCH_FLAGS="--noises FOLDER"    # scores.md and scores.jsonl in bench-out/
    make bench-scores BENCH_FLAGS="--scenes 40 --cache DIR"        # fewer scenes; DIR keeps the simulated ones

The scenes are those of array_scenes.py, by our own simulator and by pyroomacoustics, each with its array as it is said
to be, and as people build it. `make fit-scores` fits to other ones. A detection is right within 0.5 m in x and y of a
talker who is not taken and who sounds within 0.15 s. With recordings of machines (see bench_steady.py) there are scenes
in which one sounds, by itself or beside a talker.
"""

import argparse
import functools
import importlib.util
import itertools
import json
import os
import pickle
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
if importlib.util.find_spec("pyroomacoustics") is None:
    bench = ROOT / ".venv-bench" / "bin" / "python"
    if not bench.exists():
        sys.exit(f"{Path(sys.argv[0]).stem}: needs pyroomacoustics; make setup-bench installs it")
    os.execv(bench, [str(bench), *sys.argv])

import numpy as np  # noqa: E402
from array_scenes import (  # noqa: E402
    FEW_FROM,
    MACHINE_S,
    MACHINES,
    MISPLACED_M,
    SECONDS,
    Given,
    as_built,
    machine_scene,
    machines,
    recordings,
    scene,
)
from fit_localization import NEARBY_S, match  # noqa: E402
from localization_scenes import Person, Scene  # noqa: E402

from avcli.localization import uncertainty  # noqa: E402
from avcli.localization.array import Talker  # noqa: E402
from avcli.localization.noise import NoiseLaw  # noqa: E402
from avcli.localization.places import Judged, PlaceFinder  # noqa: E402
from avcli.localization.settings import SteeredSettings  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402
from avcli.localization.windows import Heard  # noqa: E402

CHI2_95 = 5.991
EDGES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
LATE_S = 0.2
"""s after the last word, from which a report is late."""
EIGHT = 8
"""Microphones from which an array has many: two talkers at once are looked at with fewer, and with so many or more."""
LEAST, RUNS, FAR, SURE = 400, 20, 0.05, 0.9
"""Records and scenes from which a bin counts, how far what is said may be from what is true, and from where a wrong
score is a confident one."""


@dataclass(frozen=True)
class Peak:
    """One peak of one decision.

    Attributes:
        given: its scene.
        time: s.
        features: see uncertainty.Features.
        score: of it.
        right: whether a talker is there.
        inside: whether the error in x and y is within the 95 % ellipse.
        walks: whether its talker moves.
        sounds: whether its talker sounds at this time.
        together: whether two talkers sound at this time, its own one of them.
        quiet: s since the last word where nobody sounds now or in the next 0.15 s; 0 else.
        after: what is known afterwards, see uncertainty.After; None at the end of a scene.
    """

    given: Given
    time: float
    features: uncertainty.Features
    score: float
    right: bool
    inside: bool
    walks: bool
    sounds: bool
    together: bool
    quiet: float
    after: uncertainty.After | None


class Witness(PlaceFinder):
    """A finder that notes each of its peaks, and reports none."""

    def __init__(self, finder: PlaceFinder, given: Given, people: list[Person]):
        vars(self).update(vars(finder))
        self.given, self.people, self.seen = given, people, list[Peak]()

    def report(self, time: float, judged: list[Judged], heard: Heard, noise: NoiseLaw) -> list[Talker]:
        """Note the peaks of a decision."""
        taken: set[int] = set()
        quiet, sounding = quiet_for(self.people, time), [one.sounds(time) for one in self.people]
        for one in judged:
            if not self.people:
                self.seen.append(
                    Peak(self.given, time, one.features, one.score, False, False, False, False, False, 0.0, one.after)
                )
                continue
            right, nearest, error = match(one.peak.position, time, self.people, taken)
            person, level, inside = self.people[nearest], error[:2], False
            if right:
                spread = self.covariance(one, heard.offsets, noise)[:2, :2]
                inside = bool(level @ np.linalg.solve(spread, level) < CHI2_95)
            walks = bool(np.linalg.norm(person.at(time + 0.1) - person.at(time - 0.1)) > 0.02)
            sounds = sounding[nearest]
            together = sum(sounding) > 1 and sounds
            self.seen.append(
                Peak(
                    self.given, time, one.features, one.score, right, inside, walks, sounds, together, quiet, one.after
                )
            )
        return []


def quiet_for(people: Sequence[Person], time: float) -> float:
    """Return the s since the last word where nobody sounds at a time in s or in the next 0.15 s; 0 else."""
    spans = [span for one in people for span in one.activity]
    if any(begin - NEARBY_S <= time <= end for begin, end in spans):
        return 0.0
    return min((time - end for _, end in spans if end < time), default=0.0)


def scenes(options: argparse.Namespace, split: str) -> Iterator[tuple[Given, Scene]]:
    """Yield the scenes of a split, those with few microphones, and those with machines where recordings of these are.

    Each comes twice, with the array as it is said to be and `as_built`. Scenes that the cache has are not simulated
    again.
    """
    spoken = recordings(split, options.speech)
    whole = [
        (f"{split}_{number:04d}.pkl", functools.partial(scene, split, number, spoken))
        for number in (*range(options.scenes), *range(FEW_FROM, FEW_FROM + options.few))
    ]
    if options.noises:
        noises = machines(split, options.noises)
        whole += [
            (f"{split}_machine_{number:04d}.pkl", functools.partial(machine_scene, split, number, spoken, noises))
            for number in range(options.scenes * 2 // 5)
        ]
    for name, make in whole:
        kept = options.cache / name if options.cache else None
        if kept and kept.exists():
            made = pickle.loads(kept.read_bytes())
        else:
            made = make()
            if kept:
                kept.parent.mkdir(parents=True, exist_ok=True)
                kept.write_bytes(pickle.dumps(made))
        yield made
        yield as_built(*made)


@dataclass(frozen=True)
class Spoken:
    """How many talkers could be found in a scene, decision by decision: all of them, and those who sound together."""

    given: Given
    all: int
    together: int


def peaks(heard: Iterator[tuple[Given, Scene]], law: uncertainty.Law) -> tuple[list[Peak], list[Spoken]]:
    """Return the peaks that the localizer finds in scenes with a law, and whom it could find in each scene."""
    found, spoken = list[Peak](), list[Spoken]()
    for given, one in heard:
        localizer = SteeredLocalizer(one.array, SteeredSettings(), np.random.default_rng(0), law)
        if not isinstance(localizer.finder, PlaceFinder):
            raise TypeError("the array observes no ranges")
        localizer.finder = witness = Witness(localizer.finder, given, one.people)
        for _ in localizer.localize([Block(one.samples)]):
            pass
        found += witness.seen
        times = np.arange(0.0, SECONDS, 0.1)
        sounding = np.array([[person.sounds(time) for time in times] for person in one.people]).reshape(-1, len(times))
        talking = sounding.sum(axis=0)
        spoken.append(Spoken(given, int(talking.sum()), int((talking * (talking > 1)).sum())))
        print(f"{given.split} {given.number}: {len(witness.seen)} peaks", file=sys.stderr, flush=True)
    return found, spoken


def log_loss(right: np.ndarray, score: np.ndarray) -> float:
    """Return the mean of -log(probability of what was), in nats."""
    chance = np.clip(score, 1e-6, 1.0 - 1e-6)
    return float(np.mean(-np.where(right, np.log(chance), np.log1p(-chance))))


def reliability(found: Sequence[Peak], score: np.ndarray) -> list[dict[str, Any]]:
    """Return for each bin of the score how many peaks and scenes it has, what is said and what is true."""
    right = np.array([one.right for one in found])
    run = np.array([one.given.number for one in found])
    rows = []
    for low, high in itertools.pairwise(EDGES):
        inside = (score >= low) & ((score < high) | (high == 1.0))
        if inside.any():
            said, true = float(score[inside].mean()), float(right[inside].mean())
            runs = len(np.unique(run[inside]))
            counts = bool(inside.sum() >= LEAST and runs >= RUNS)
            rows.append({
                "from": low, "to": high, "peaks": int(inside.sum()), "scenes": runs, "said": round(said, 3),
                "true": round(true, 3), "counts": counts, "far": counts and abs(said - true) > FAR,
            })  # fmt: skip
    return rows


def conditions(found: Sequence[Peak], spoken: Sequence[Spoken]) -> list[dict[str, Any]]:
    """Return for each condition how many are reported, how many of these are right, and how many ellipses hold."""
    kinds: dict[str, Any] = {
        "places off, cm:": lambda one: _step(100 * one.given.misplaced, (0, 1, 2, 3)) if one.given.misplaced else "0",
        "noisy channels": lambda one: one.given.noisy,
        "simulator": lambda one: one.given.simulator,
        "array": lambda one: one.given.kind,
        "people": lambda one: one.given.act,
        "talker": lambda one: "walks" if one.walks else "stands",
        "microphones": lambda one: one.given.count,
        "T60 s": lambda one: _step(one.given.rt60, (0.1, 0.2, 0.4, 0.7, 1.2)),
        "noise dB": lambda one: _step(one.given.noise_db, (5, 10, 20, 40)),
        "room m": lambda one: _step(one.given.room[0], (3, 5, 9, 20)),
    }
    rows = []
    for what, of in kinds.items():
        for value in sorted({of(one) for one in found}, key=_order):
            mine = [one for one in found if of(one) == value and one.score >= 0.5]
            right, sure = [one for one in mine if one.right], [one for one in mine if one.score > SURE]
            if not right:
                continue
            # Whether a talker walks is not told of those whom nobody finds.
            heard = sum(one.all for one in spoken if of(one) == value) if what != "talker" else 0
            rows.append({
                "condition": f"{what} {value}", "scenes": len({one.given.number for one in mine}),
                "reported": len(mine),
                "said": round(float(np.mean([one.score for one in mine])), 3),
                "true": round(len(right) / len(mine), 3), "sure": len(sure),
                "sure_wrong": sum(not one.right for one in sure),
                "in_95": round(float(np.mean([one.inside for one in right])), 3),
                "recall": round(sum(one.sounds for one in right) / heard, 3) if heard else None,
            })  # fmt: skip
    return rows


def _order(value: Any) -> tuple[float, str]:
    first = str(value).split()[0]
    return (float(first), "") if first[0].isdigit() else (0.0, first)


def _step(value: float, edges: Sequence[float]) -> str:
    index = min(max(int(np.searchsorted(edges, value, side="right")), 1), len(edges) - 1)
    return f"{edges[index - 1]:g} to {edges[index]:g}"


def counted(score: np.ndarray, right: np.ndarray) -> dict[str, Any]:
    """Return the log loss, how many scores are sure and of these wrong, how many are reported and of these right."""
    sure, told = score > SURE, score >= 0.5
    return {
        "log_loss": round(log_loss(right, score), 4), "sure": int(sure.sum()), "sure_wrong": int((sure & ~right).sum()),
        "reported": int(told.sum()), "reported_right": int((right & told).sum()),
    }  # fmt: skip


def figures(found: Sequence[Peak], spoken: Sequence[Spoken], law: uncertainty.Law) -> dict[str, Any]:
    """Return what is said and what is true, for first and further peaks and by condition.

    Args:
        found, spoken: see `peaks`.
        law: that found them.
    """
    told: dict[str, Any] = {"machines": []}
    for act in MACHINES:
        mine = [one for one in found if one.given.act == act]
        score, right = np.array([one.score for one in mine]), np.array([one.right for one in mine], bool)
        level = score / np.array([law.voice(one.features.steady) for one in mine])
        if mine:
            row = {"what": act, "scenes": len({one.given.number for one in mine})}
            told["machines"].append({**row, "now": counted(score, right), "without": counted(level, right)})
    found = [one for one in found if one.given.act not in MACHINES]
    spoken = [one for one in spoken if one.given.act not in MACHINES]
    for name, first in (("first", True), ("further", False)):
        mine = [one for one in found if one.features.first == first]
        score, right = np.array([one.score for one in mine]), np.array([one.right for one in mine])
        built = np.array([one.given.misplaced > 0.0 for one in mine])
        at_once = [one for one in mine if not (one.after and one.after.sought)]
        evidence = np.array([law.evidence(one.features) for one in at_once])
        known = np.array([one.after.score if one.after else one.score for one in at_once])
        were = np.array([one.right for one in at_once])
        told[name] = {
            "peaks": len(mine),
            **counted(score, right),
            "said_places": counted(score[~built], right[~built]),
            "as_built": counted(score[built], right[built]),
            "evidence": counted(1.0 / (1.0 + np.exp(-np.clip(evidence, -30.0, 30.0))), were),
            "at_once": counted(known, were),
            "bins": reliability(mine, score),
        }
    reported = [one for one in found if one.score >= 0.5]
    late = [one.quiet for one in reported if round(one.quiet, 3) > LATE_S]
    told["together"] = []
    for few, people_built in itertools.product((False, True), repeat=2):
        kind = (few, people_built)
        of = sum(one.together for one in spoken if (one.given.count < EIGHT, one.given.misplaced > 0.0) == kind)
        mine = [one for one in reported if (one.given.count < EIGHT, one.given.misplaced > 0.0) == kind]
        true = [one.right for one in mine if one.together]
        told["together"].append({
            "array": f"{'4 to 6' if few else '8 and more'} microphones, {'as built' if people_built else 'as said'}",
            "of": of,
            "recall": round(sum(true) / max(of, 1), 3),
            "precision": round(sum(true) / max(len(true), 1), 3),
        })  # fmt: skip
    told["late"] = {"reports": len(late), "latest_s": round(max(late, default=0.0), 2)}
    return {"scenes": len({one.given.number for one in found}), **told, "conditions": conditions(found, spoken)}


def page(told: dict[str, Any], split: str) -> str:
    """Return the figures as Markdown."""
    text = f"""# Scores: what is said, and what is true

By `make bench-scores` (split {split}, {told["scenes"]} scenes of {SECONDS:g} s). Each scene draws its array (4 to 32
microphones), its room (3 to 20 m), its reverberation time (.1 to 1.2 s), noise (5 to 40 dB below the voices), and what
one or two people do. Half of them are our own simulator's, half pyroomacoustics'. What decided the scores has other
seeds and another speaker, and no array of the kind "pairs". Each scene comes twice: with microphones where they are
said to be, and as people build arrays, with places off by a standard deviation of 0 to {100 * MISPLACED_M:g} cm in each
axis, and in a third of them with one or two noisy channels. A detection is right within 0.5 m in x and y of a talker.
A bin counts where it has {LEAST} peaks of {RUNS} scenes; its true share may be {FAR} from what is said.
"""
    for name, what in (("first", "The first talker of a decision"), ("further", "Further talkers")):
        one = told[name]
        text += f"""
## {what}

{one["peaks"]} peaks. Before is the score that knew no array but a ring of eight, the evidence of today; at once,
what is said of those that are found before later decisions are known.

| | log loss | over {SURE} | of these wrong | reported, .5 or more | of these right |
| --- | ---: | ---: | ---: | ---: | ---: |
{_counts("before", one["evidence"])}
{_counts("at once", one["at_once"])}
{_counts("now", one)}
{_counts("now, places as said", one["said_places"])}
{_counts("now, as built", one["as_built"])}

| score | peaks | scenes | said | true | |
| --- | ---: | ---: | ---: | ---: | --- |
"""
        for row in one["bins"]:
            verdict = ("too far" if row["far"] else "kept") if row["counts"] else "few"
            text += f"| {row['from']:g} to {row['to']:g} | {row['peaks']} | {row['scenes']} | {row['said']:.3f} |"
            text += f" {row['true']:.3f} | {verdict} |\n"
    late = told["late"]
    text += """
## Two at once, and the last word

Two sound together, and each of them could be found: how many of them are reported, and how many of the reports of such
moments are right.

| | to be found | recall | precision |
| --- | ---: | ---: | ---: |
"""
    for row in told["together"]:
        text += f"| {row['array']} | {row['of']} | {row['recall']:.3f} | {row['precision']:.3f} |\n"
    text += f"""
Later than {LATE_S} s after the last word, and not within {NEARBY_S} s before the next one, there are {late["reports"]}
reports, the latest {late["latest_s"]} s after it. A decision's windows reach 0.2 s into the next word, and what they
hear of it is no tail.
"""
    text += f"""
## Machines

Scenes of {MACHINE_S:g} s in which a machine sounds all the time: a recorded one, or in every fourth a motor that hums.
Without: were the score not lowered where something goes on as steadily.

| | scenes | | reported, .5 or more | of these right | over 0.9 | of these wrong |
| --- | ---: | --- | ---: | ---: | ---: | ---: |
"""
    for row in told["machines"]:
        for name in ("without", "now"):
            one = row[name]
            text += f"| {row['what']} | {row['scenes']} | {name} | {one['reported']} | {one['reported_right']} |"
            text += f" {one['sure']} | {one['sure_wrong']} |\n"
    text += f"""
## By condition

Of what is reported: said, true, how many scores over {SURE} are wrong, the share of right ones within the 95 % ellipse
in x and y, and how many of the talkers who sound are reported.

| condition | scenes | reported | said | true | sure | wrong | in 95 % | recall |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
"""
    for row in told["conditions"]:
        text += f"| {row['condition']} | {row['scenes']} | {row['reported']} | {row['said']:.3f} | {row['true']:.3f} |"
        text += f" {row['sure']} | {row['sure_wrong']} | {row['in_95']:.3f} |"
        text += f" {row['recall']:.3f} |\n" if row["recall"] is not None else " |\n"
    return text


def _counts(name: str, one: dict[str, Any]) -> str:
    columns = ("log_loss", "sure", "sure_wrong", "reported", "reported_right")
    return "| " + " | ".join([name, *(str(one[column]) for column in columns)]) + " |"


def options_of(description: str | None, few: int) -> argparse.ArgumentParser:
    """Return the options that measuring and fitting share; `few` scenes with few microphones by default."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    parser.add_argument("--speech", type=Path, default=shared, help="folder of CMU ARCTIC's aew and axb")
    parser.add_argument("--noises", type=Path, help="folder of recordings of machines, see bench_steady.py")
    parser.add_argument("--cache", type=Path, help="folder that keeps the simulated scenes")
    parser.add_argument("--few", type=int, default=few, help="scenes with four to six microphones")
    return parser


def main() -> None:
    """Measure, and write the page."""
    parser = options_of(__doc__, few=0)
    parser.add_argument("--split", choices=("decide", "judge"), default="judge")
    parser.add_argument("--scenes", type=int, default=120)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    law = uncertainty.fitted_law()
    found, spoken = peaks(scenes(options, options.split), law)
    told = figures(found, spoken, law)
    (options.out / "scores.jsonl").write_text(json.dumps(told) + "\n")
    (options.out / "scores.md").write_text(page(told, options.split))


if __name__ == "__main__":
    main()
