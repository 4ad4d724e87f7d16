"""Fused tracks against the better single sensor's on S1 to S4, by the project's own simulated and detected signals.

Every seed has its own audio: microphone noise 30 dB below a voice and pauses between sentences of its own length. Video
is drawn for the first few seeds only, with a camera sensor's noise (it takes longest), and used in turn by the others.
Detections are kept below --out and made only where they are missing. Tracks are online, with the defaults of avfuse.
bench_tracking.py adds what is found here about existence to its tables, where it has the same --out.
"""

import argparse
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

import tracking_report as report
import walks
from tracking_measures import outcome
from tracking_report import Run
from tracking_runs import Variant, fuse
from tracking_scenes import Scene

SCENARIOS = ("s1", "s2", "s3", "s4")


def run(command: str, *arguments: object) -> None:
    subprocess.run([Path(sys.executable).parent / command, *map(str, arguments)], check=True)


def hear(folder: Path, scenario: str, seed: int) -> None:
    """Make the audio localizations of one seed."""
    found = folder / "audio_localizations.jsonl"
    if not found.exists():
        scene, sound = folder / "scene.jsonl", folder / "audio.jsonl"
        pause = round(float(np.random.default_rng(seed).uniform(0.1, 0.4)), 3)
        run("avsim-scene", scenario, "--no-video", "-C", folder, "-o", scene)
        run("avsim-audio", "-C", folder, "--noise", "sensor=30", "--pause", pause, "--seed", seed, scene, "-o", sound)
        run("avdetect-audio", "-C", folder, sound, "-o", found)


def see(folder: Path, scenario: str, seed: int) -> None:
    """Make the video localizations of one seed."""
    found = folder / "video_localizations.jsonl"
    if not found.exists():
        scene, noise = folder / "scene.jsonl", ("--full-well", 10000, "--read-noise", 1)
        run("avsim-scene", scenario, "--frames", "npy", *noise, "--seed", seed, "-C", folder, "-o", scene)
        run("avdetect-video", "-C", folder, scene, "-o", found)
        shutil.rmtree(folder / "video")


def scene_of(ear: Path, eye: Path) -> Scene:
    """The truth and detections of two directories, one of which was heard and the other seen."""
    heard, seen = walks.ready(ear, ("audio",)), walks.ready(eye, ("video",))
    return replace(heard, ready=sorted([*(heard.ready or ()), *(seen.ready or ())], key=lambda r: (r[0], r[1])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="directory of the figures and detections")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seeds", type=int, default=10, help="audio simulations of each scenario")
    parser.add_argument("--video-seeds", type=int, default=3, help="video simulations of each scenario")
    parser.add_argument("--scenarios", nargs="*", default=SCENARIOS, choices=SCENARIOS)
    options = parser.parse_args()
    runs: list[Run] = []
    for scenario in options.scenarios:
        for seed in range(options.first, options.first + options.seeds):
            drawn = options.first + (seed - options.first) % options.video_seeds
            ear = options.out / "tracking-real" / f"{scenario}-audio-{seed}"
            eye = options.out / "tracking-real" / f"{scenario}-video-{drawn}"
            for folder in (ear, eye):
                folder.mkdir(parents=True, exist_ok=True)
            hear(ear, scenario, seed)
            see(eye, scenario, drawn)
            scene = scene_of(ear, eye)
            for sensors in ("", "audio", "video"):
                some = scene.only(sensors) if sensors else scene
                runs.append(Run(scenario, seed, "default", sensors, outcome(some, *fuse(some, Variant()))))
            audio, video, both = (report.chosen(runs, "default", one, scenario) for one in ("audio", "video", ""))
            shown = [f"{one[-1].outcome.hota:.1f} ({one[-1].outcome.fine:.1f})" for one in (audio, video, both)]
            print(f"{scenario} {seed}: audio {shown[0]}, video {shown[1]}, both {shown[2]}", flush=True)
    report.write(runs, options.out / "tracking-real.json")
    arguments = f"--first {options.first} --seeds {options.seeds} --video-seeds {options.video_seeds}"
    lines = [
        "# On the project's own detections, online",
        "",
        f"Made by `tests/bench/bench_tracking_real.py {arguments}`:",
        "every seed has its own simulation of audio (noise and pauses differ); those of video (the camera's noise",
        "differs) are used in turn, so their figures repeat. HOTA in percent at d0 = 2, .5 and .25 m, online.",
        "",
        *report.single_table(runs),
        "Both sensors less the better one: mean with its 95 % interval, and the worst.",
        "",
        *report.sensors_table(runs, {"s1 to s4": options.scenarios}),
        "Existence: said and true.",
        "",
        *report.reliability_table({"own detections": report.chosen(runs)}),
    ]
    (options.out / "tracking-real.md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()
