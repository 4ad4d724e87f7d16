"""Fused tracks against the better single sensor's on S1 to S4, by the project's own simulated and detected signals.

Every seed has its own audio: microphone noise 30 dB below a voice and pauses between sentences of its own length. Video
is drawn for the first few seeds only, with a camera sensor's noise (it takes longest), and used in turn by the others.
Detections are kept below --out and made only where they are missing. Tracks are online, with the defaults of avfuse.
The less d0 is, the more centimetres count: at 0.25 m, HOTA is that of matches within 1 to 24 cm.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from avcli.formats import records
from avcli.formats.experiment import Config, read_config
from avcli.metrics.hota import METRIC as HOTA
from avcli.metrics.metric import Case
from avcli.metrics.sequence import Sequence
from avcli.metrics.settings import Settings as Scoring
from avcli.tracking.fusion import Fusion
from avcli.tracking.merging import Record
from avcli.tracking.settings import Settings

SCENARIOS = ("s1", "s2", "s3", "s4")
D0 = (2.0, 0.5, 0.25)  # m


def run(command: str, *arguments: object) -> None:
    subprocess.run([Path(sys.executable).parent / command, *map(str, arguments)], check=True)


def hear(folder: Path, scenario: str, seed: int) -> Path:
    """Audio localizations of one seed."""
    found = folder / "audio_localizations.jsonl"
    if not found.exists():
        scene, sound = folder / "scene.jsonl", folder / "audio.jsonl"
        pause = round(float(np.random.default_rng(seed).uniform(0.1, 0.4)), 3)
        run("avsim-scene", scenario, "--no-video", "-C", folder, "-o", scene)
        run("avsim-audio", "-C", folder, "--noise", "sensor=30", "--pause", pause, "--seed", seed, scene, "-o", sound)
        run("avdetect-audio", "-C", folder, sound, "-o", found)
    return found


def see(folder: Path, scenario: str, seed: int) -> Path:
    """Video localizations of one seed."""
    found = folder / "video_localizations.jsonl"
    if not found.exists():
        scene, noise = folder / "scene.jsonl", ("--full-well", 10000, "--read-noise", 1)
        run("avsim-scene", scenario, "--frames", "npy", *noise, "--seed", seed, "-C", folder, "-o", scene)
        run("avdetect-video", "-C", folder, scene, "-o", found)
        shutil.rmtree(folder / "video")
    return found


def detections(path: Path) -> list[Record]:
    """[(time s, sensor, Detections), ...] of a file."""
    with open(path, "rb") as lines:
        found = [records.detections(records.decode(line)) for line in lines]
    return [(round(one.timestamp, 6), one.sensor or "sensor", one) for one in found]


def truth_of(folder: Path) -> list[tuple[float, list[int], np.ndarray]]:
    """[(time s, ids, xy (n, 2) m)] of an experiment directory."""
    out = []
    for line in (folder / "groundtruth_sources.jsonl").read_bytes().splitlines():
        people = json.loads(line)
        xy = [one["position"][:2] for one in people["objects"]]
        out.append(
            (
                round(float(people["timestamp"]), 6),
                [one["object_id"] for one in people["objects"]],
                np.reshape(xy, (-1, 2)),
            )
        )
    return out


def hota(truth: list[tuple[float, list[int], np.ndarray]], found: list[Record], config: Config) -> list[float]:
    """HOTA in percent of online tracks of some detections, at each d0."""
    fusion, tracks = Fusion.of(config, Settings()), []
    for now, *_ in truth:
        (people,) = fusion.step(now, [one for one in found if one[0] == now])
        tracks.append((people.ids.tolist(), people.positions[:, :2]))
    sequence = Sequence.of([(ids, xy) for _, ids, xy in truth], tracks)
    return [100 * float(np.mean(HOTA.score(Case(sequence, Scoring(d0=d0)))["HOTA"])) for d0 in D0]


def scores(out: Path, scenario: str, seed: int, video_seed: int) -> np.ndarray:
    """HOTA (3, len(D0)) in percent of audio, video and both, of one seed."""
    ear, eye = out / f"{scenario}-audio-{seed}", out / f"{scenario}-video-{video_seed}"
    for folder in (ear, eye):
        folder.mkdir(parents=True, exist_ok=True)
    heard, seen = detections(hear(ear, scenario, seed)), detections(see(eye, scenario, video_seed))
    truth, config = truth_of(ear), read_config(ear / "config.json")
    return np.array([hota(truth, found, config) for found in (heard, seen, heard + seen)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="directory of the figures and detections")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seeds", type=int, default=10, help="audio simulations of each scenario")
    parser.add_argument("--video-seeds", type=int, default=3, help="video simulations of each scenario")
    parser.add_argument("--scenarios", nargs="*", default=SCENARIOS, choices=SCENARIOS)
    options = parser.parse_args()
    arguments = f"--first {options.first} --seeds {options.seeds} --video-seeds {options.video_seeds}"
    lines = [
        "# On the project's own detections, online",
        "",
        f"Made by `tests/bench/bench_tracking_real.py {arguments}`:",
        "every seed has its own simulation of audio (noise and pauses differ); those of video (the camera's noise",
        "differs) are used in turn, so their figures repeat. HOTA in percent, mean of the seeds; the gain is that of",
        "both over the better sensor of each seed, with its 95 % interval.",
        "",
        "| scenario | d0, m | audio | video | both | gain | least gain |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for scenario in options.scenarios:
        found = []
        for seed in range(options.first, options.first + options.seeds):
            video_seed = options.first + (seed - options.first) % options.video_seeds
            found.append(scores(options.out / "tracking-real", scenario, seed, video_seed))
            print(scenario, seed, *found[-1].round(1).tolist(), flush=True)
        each = np.array(found)
        gains = each[:, 2] - each[:, :2].max(1)
        error = 1.96 * gains.std(0, ddof=1) / math.sqrt(len(each)) if len(each) > 1 else np.full(len(D0), math.nan)
        for k, d0 in enumerate(D0):
            audio, video, both = each[..., k].mean(0)
            lines.append(
                f"| {scenario} | {d0:g} | {audio:.1f} | {video:.1f} | {both:.1f} "
                f"| {gains[:, k].mean():+.2f} ± {error[k]:.2f} | {gains[:, k].min():+.2f} |"
            )
            print(lines[-1], flush=True)
    (options.out / "tracking-real.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
