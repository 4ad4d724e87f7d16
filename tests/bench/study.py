"""The thesis's hypotheses with intervals over seeds, and what it left open: one factor of the scene at a time.

    make study                                      # three seeds: half an hour of CPU time
    make study STUDY_FLAGS="--seeds 20"
    make study STUDY_FLAGS="--only hypotheses"      # or factors; --factors people "T60, s"

H1: by sound alone tracking is poor, since nobody is heard who is silent. H2: by pictures alone it is better than by
sound, and drops where people hide one another (S2). H3: by both it is better than by the better of the two. Each on S1
to S4, by ours and by the thesis's chain; a seed is another noise of the camera (a webcam's) and of the microphones.

What is left open: people who walk between random places of the laboratory and talk by turns, another world each seed;
depth or colour alone, noise, reverberation, height of the camera, people, microphones, errors of the calibration. Each
seed's world is the same for all levels of a factor, so the change of a level is measured seed by seed. Writes study.md,
study.jsonl and study.svg into --out, which grows by about 400 MB a seed.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import chain
import numpy as np
import thesis
from scipy.spatial.transform import Rotation

from avcli.scene.scenario import LABORATORY

SECONDS = 5.0
D0 = (2.0, 0.5)
Scores = dict[str, dict[float, float]]


@dataclass(frozen=True)
class World:
    """One setting of everything: what is simulated, and how it is detected."""

    people: int = 3
    height_m: float = 2.5
    microphones: int = 8
    noise_db: int = 30
    rt60_s: float = 0.35
    colour_alone: bool = False
    tilted_deg: float = 0.0
    misplaced_m: float = 0.0


FACTORS: dict[str, list[tuple[str, World]]] = {
    "camera": [("colour and depth", World()), ("colour alone", World(colour_alone=True))],
    "noise, dB below a voice": [(str(db), World(noise_db=db)) for db in (40, 30, 20, 10)],
    "T60, s": [(f"{s:g}", World(rt60_s=s)) for s in (0.1, 0.35, 0.6, 0.8)],
    "height of the camera, m": [(f"{h:g}", World(height_m=h)) for h in (2.2, 2.5, 2.9)],
    "people": [(str(n), World(people=n)) for n in (1, 2, 3, 5)],
    "microphones": [(str(n), World(microphones=n)) for n in (5, 6, 8, 12)],
    "camera tilted unknowingly, degrees": [(f"{d:g}", World(tilted_deg=d)) for d in (0, 1, 3)],
    "microphones misplaced unknowingly, cm (sd)": [(f"{100 * m:g}", World(misplaced_m=m)) for m in (0, 0.02, 0.05)],
}


def scenario(world: World, seed: int) -> dict[str, Any]:
    """People who walk between random places, in lanes of their own, and talk by turns."""
    rng = np.random.default_rng(seed)
    length, width, _ = LABORATORY["room_config"]["room_dimensions_m"]
    lanes = 0.6 + (width - 1.2) * (np.arange(world.people) + 0.5) / world.people
    people = []
    for k, lane in enumerate(rng.permutation(lanes)):
        stops = rng.uniform(0.6, length - 0.6, 4)
        ways = [{"position_m": [float(x), float(lane + rng.uniform(-0.25, 0.25))]} for x in stops]
        turns = [[t, min(t + 1.0, SECONDS)] for t in np.arange(k, SECONDS, world.people).tolist()]
        people.append({"waypoints": ways, "speech_s": turns})
    return {
        "name": "study", "duration_s": SECONDS, "people": people,
        "microphone_config": {"mic_positions_m": microphones(world.microphones)},
    }  # fmt: skip


def microphones(count: int) -> list[list[float]]:
    """The thesis's eight; of fewer the corners first, of more others between them, lower."""
    own = [list(one["position"]) for one in LABORATORY["microphone_config"]["mic_positions_m"]]
    order = [0, 2, 4, 6, 7, 1, 3, 5]
    more = [[1.2, 0.1, 1.9], [3.5, 4.55, 1.9], [0.1, 3.5, 1.9], [4.55, 1.2, 1.9]]
    return [*(own[k] for k in order), *more][:count]


def believed(config: dict[str, Any], world: World, seed: int) -> dict[str, Any]:
    """config.json with the errors that nobody knows of."""
    rng = np.random.default_rng(seed + 7)
    wrong = json.loads(json.dumps(config))
    camera, places = wrong["camera_config"], wrong["microphone_config"]["mic_positions_m"]
    if world.tilted_deg:
        about = rng.uniform(0, 360)
        tilt = Rotation.from_euler("zx", [about, world.tilted_deg], degrees=True)
        stated = Rotation.from_euler("xyz", camera["camera_rotation_deg"], degrees=True)
        turned = tilt * Rotation.from_euler("z", -about, degrees=True) * stated
        camera["camera_rotation_deg"] = turned.as_euler("xyz", degrees=True).tolist()
    for place in places:
        values = place["position"] if isinstance(place, dict) else place
        values[:] = (np.array(values) + rng.normal(0, world.misplaced_m, 3)).tolist()
    return wrong


def measured(out: Path, world: World, seed: int) -> Scores:
    """HOTA in one world: by sound, pictures and both, by d0."""
    base = out / "worlds" / f"{seed}"
    told = scenario(world, seed)
    drawn = ("--seed", seed, "--camera-height", world.height_m)
    eye = chain.seen(base / f"eye-{world.people}-{world.height_m}", told, *drawn, "--sensor", "webcam")
    ear_name = f"ear-{world.people}-{world.microphones}-{world.noise_db}-{world.rt60_s}"
    ear = chain.heard(base / ear_name, told, "--seed", seed, "--noise", f"sensor={world.noise_db}",
                      "--rt60", world.rt60_s, drawn=drawn)  # fmt: skip
    found = {}
    for sensor, folder, how in (("audio", ear, f"{world.misplaced_m}"),
                                ("video", eye, f"{world.colour_alone}-{world.tilted_deg}")):  # fmt: skip
        config = folder / f"believed-{how}.json"
        config.write_text(json.dumps(believed(json.loads((folder / "config.json").read_text()), world, seed)))
        source = folder / ("audio.jsonl" if sensor == "audio" else "scene.jsonl")
        more = ("--monocular",) if sensor == "video" and world.colour_alone else ()
        found[sensor] = chain.made(f"avdetect-{sensor}", folder / f"found-{how}.jsonl", "-C", folder, "-c", config,
                                   source, *more)  # fmt: skip
    name = "-".join(str(value) for value in asdict(world).values())
    return chain.tracked(eye, found, base / f"tracks-{name}", d0=D0)


def hypotheses(out: Path, seeds: int) -> list[dict[str, Any]]:
    """S1 to S4 by ours and by the thesis's chain: a row a scenario, seed and chain."""
    rows = []
    for name in ("s1", "s2", "s3", "s4"):
        for seed in range(seeds):
            for whose, which in (("ours", frozenset[str]()), ("the thesis's", thesis.ALL)):
                score = thesis.score_of(out / "hypotheses", name, seed, which, "webcam")
                flat = {sensor: score[sensor][2.0] for sensor in chain.SENSORS}
                rows.append({"scenario": name, "seed": seed, "chain": whose, **flat})
                print(rows[-1], flush=True)
    return rows


def judged(rows: Sequence[dict[str, Any]], whose: str) -> list[str]:
    """H1 to H3 of one chain as lines: differences of HOTA, seed by seed, with their 95 % intervals."""
    mine = [row for row in rows if row["chain"] == whose]
    seeds = sorted({row["seed"] for row in mine})

    def mean(seed: int, value: Callable[[dict[str, Any]], float], scenarios: str = "s1s2s3s4") -> float:
        return float(np.mean([value(row) for row in mine if row["seed"] == seed and row["scenario"] in scenarios]))

    claims = {
        "H1: audio, HOTA": [mean(s, lambda r: r["audio"]) for s in seeds],
        "H1: audio where three speak by turns (S4)": [mean(s, lambda r: r["audio"], "s4") for s in seeds],
        "H2: video less audio": [mean(s, lambda r: r["video"] - r["audio"]) for s in seeds],
        "H2: video with people hidden (S2) less video without": [
            mean(s, lambda r: r["video"], "s2") - mean(s, lambda r: r["video"], "s1s3s4") for s in seeds
        ],
        "H3: both less the better one": [mean(s, lambda r: r["both"] - max(r["audio"], r["video"])) for s in seeds],
        "H3: the same, the worst scenario": [
            min(mean(s, lambda r: r["both"] - max(r["audio"], r["video"]), one) for one in ("s1", "s2", "s3", "s4"))
            for s in seeds
        ],
    }  # fmt: skip
    return [f"| {name} | {chain.shown(values)} |" for name, values in claims.items()]


def factor_rows(out: Path, seeds: int, names: Sequence[str]) -> list[dict[str, Any]]:
    """A row a factor, level, seed and d0."""
    rows = []
    for factor in names:
        for level, world in FACTORS[factor]:
            for seed in range(seeds):
                score = measured(out, world, seed)
                rows += [
                    {"factor": factor, "level": level, "seed": seed, "d0_m": d0, **asdict(world)}
                    | {sensor: score[sensor][d0] for sensor in chain.SENSORS}
                    for d0 in D0
                ]
            mine = [row for row in rows if (row["factor"], row["level"], row["d0_m"]) == (factor, level, 2.0)]
            print(factor, level, {s: chain.shown([row[s] for row in mine]) for s in chain.SENSORS}, flush=True)
    return rows


def factor_table(rows: Sequence[dict[str, Any]], factor: str) -> list[str]:
    """Levels of a factor: HOTA at both d0 with the interval over the worlds."""
    heads = [f"{sensor}, {d0:g} m" for d0 in D0 for sensor in chain.SENSORS]
    lines = [f"| {factor} | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for level, _ in FACTORS[factor]:
        here = [row for row in rows if (row["factor"], row["level"]) == (factor, level)]
        cells = [chain.shown([r[sensor] for r in here if r["d0_m"] == d0]) for d0 in D0 for sensor in chain.SENSORS]
        lines.append(f"| {level} | " + " | ".join(cells) + " |")
    return lines


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """HOTA at d0 = 0.5 m against the level of each factor."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "study"
    from matplotlib import pyplot

    names = list(dict.fromkeys(row["factor"] for row in rows))
    figure, axes = pyplot.subplots(2, 4, figsize=(14, 6.4), sharey=True, layout="constrained")
    for axis, factor in zip(axes.flat, names, strict=False):
        levels = [level for level, _ in FACTORS[factor]]
        for number, sensor in enumerate(chain.SENSORS):
            cells = [
                chain.interval(
                    [r[sensor] for r in rows if (r["factor"], r["level"], r["d0_m"]) == (factor, level, 0.5)]
                )
                for level in levels
            ]
            means, halves = zip(*cells, strict=True)
            places = np.arange(len(levels)) + 0.06 * (number - 1)
            axis.errorbar(places, means, np.nan_to_num(halves), marker="o", capsize=3, label=sensor)
        axis.set_xticks(range(len(levels)), levels)
        axis.set(title=factor, ylim=(0, 101))
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(names) :]:
        axis.set_axis_off()
    axes[0, 0].legend()
    axes[0, 0].set_ylabel("HOTA at d0 = 0.5 m, %")
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/study"), help="what is there already is used again")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", choices=["hypotheses", "factors"])
    parser.add_argument("--factors", nargs="+", choices=list(FACTORS), default=list(FACTORS), metavar="FACTOR",
                        help=", ".join(FACTORS))  # fmt: skip
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    command = f'make study STUDY_FLAGS="--seeds {options.seeds}"'
    said = f"By `{command}`: {options.seeds} seeds. HOTA in percent; ±: 95 % interval of the mean over seeds."
    lines = ["# The thesis's hypotheses, and what it left open", "", said]
    rows: list[dict[str, Any]] = []
    if options.only != "factors":
        rows += hypotheses(options.out, options.seeds)
        for whose in ("ours", "the thesis's"):
            lines += ["", f"## H1 to H3, {whose} chain, S1 to S4, d0 = 2 m", "", "| | HOTA |", "|---|---:|"]
            lines += judged(rows, whose)
    if options.only != "hypotheses":
        found = factor_rows(options.out, options.seeds, options.factors)
        rows += found
        lines += ["", "## What was left open", "", f"Random worlds of {SECONDS:g} s in the thesis's laboratory: three "
                  "people, a webcam's noise, noise of the microphones 30 dB below a voice, where the row does not say "
                  "otherwise. d0 is in each column.", "", "![HOTA against each factor](study.svg)"]  # fmt: skip
        for factor in options.factors:
            lines += ["", *factor_table(found, factor)]
        plot(found, options.out / "study.svg")
    (options.out / "study.md").write_text("\n".join(lines) + "\n")
    (options.out / "study.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
