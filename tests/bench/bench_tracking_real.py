"""Fused tracks against the better single sensor's on S1 to S4, by the project's own simulated and detected signals.

Every seed has its own audio: microphone noise 30 dB below a voice and pauses between sentences of its own length. Video
is drawn for the first few seeds only, with a camera sensor's noise (it takes longest), and used in turn by the others.
Detections are kept below --out and made only where they are missing. Tracks are online, with the defaults of avfuse.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from avcli.formats import records
from avcli.formats.experiment import Config, read_config
from avcli.metrics.metric import Case
from avcli.metrics.registry import score_case
from avcli.metrics.sequence import Sequence
from avcli.tracking.fusion import Fusion
from avcli.tracking.merging import Record
from avcli.tracking.settings import Settings

SCENARIOS = ("s1", "s2", "s3", "s4")


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


def hota(truth: list[tuple[float, list[int], np.ndarray]], found: list[Record], config: Config) -> float:
    """HOTA in percent of online tracks of some detections."""
    fusion, tracks = Fusion.of(config, Settings()), []
    for now, *_ in truth:
        (people,) = fusion.step(now, [one for one in found if one[0] == now])
        tracks.append((people.ids.tolist(), people.positions[:, :2]))
    return 100 * score_case(Case(Sequence.of([(ids, xy) for _, ids, xy in truth], tracks)))["summary"]["HOTA"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="directory of the figures and detections")
    parser.add_argument("--seeds", type=int, default=10, help="audio simulations of each scenario")
    parser.add_argument("--video-seeds", type=int, default=3, help="video simulations of each scenario")
    parser.add_argument("--scenarios", nargs="*", default=SCENARIOS, choices=SCENARIOS)
    options = parser.parse_args()
    lines = [
        "# On the project's own detections, online",
        "",
        f"Made by `tests/bench/bench_tracking_real.py --seeds {options.seeds} --video-seeds {options.video_seeds}`:",
        "every seed has its own simulation of audio (noise and pauses differ); those of video (the camera's noise",
        "differs) are used in turn, so their figures repeat. HOTA in percent.",
        "",
        "| scenario | seed | audio | video | both | both less the better |",
        "|---|---|---|---|---|---|",
    ]
    for scenario in options.scenarios:
        gains = []
        for seed in range(options.seeds):
            ear = options.out / "tracking-real" / f"{scenario}-audio-{seed}"
            eye = options.out / "tracking-real" / f"{scenario}-video-{seed % options.video_seeds}"
            for folder in (ear, eye):
                folder.mkdir(parents=True, exist_ok=True)
            heard = detections(hear(ear, scenario, seed))
            seen = detections(see(eye, scenario, seed % options.video_seeds))
            truth, config = truth_of(ear), read_config(ear / "config.json")
            audio, video, both = (hota(truth, found, config) for found in (heard, seen, heard + seen))
            gains.append(both - max(audio, video))
            lines.append(f"| {scenario} | {seed} | {audio:.1f} | {video:.1f} | {both:.1f} | {gains[-1]:+.1f} |")
            print(lines[-1], flush=True)
        lines.append(f"| **{scenario}** | mean, least | | | | **{np.mean(gains):+.2f}, {min(gains):+.2f}** |")
        print(lines[-1], flush=True)
    (options.out / "tracking-real.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
