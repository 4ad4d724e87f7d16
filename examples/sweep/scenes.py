#!/usr/bin/env python3
"""Simulate, detect, fuse and score several scenes, the job of one worker of a sweep.

    python scenes.py --scenario s1 --t60 0.3 --noise 30 --seeds 0-24 --seconds 1 --out OUT/…/noise~30

Each scene has a directory OUT/…/noise~30/seed~0/. It holds config.json, ground truth, localizations and tracks, whose
bytes are those that `make s1-audio` (with --video: `make s1`) makes with the same options, and metrics.jsonl; sound and
pictures are deleted as soon as they were used. A scene whose metrics.jsonl is there is not made again.

The commands run one after the other in children of this process, which has loaded the libraries: a start costs
milliseconds in place of a third of a second. This process itself draws nothing and starts no thread.
"""

import argparse
import contextlib
import ctypes
import gc
import importlib
import os
import shutil
import signal
import sys
from pathlib import Path

COMMANDS = ("avsim-scene", "avsim-audio", "avdetect-audio", "avdetect-video", "avfuse", "aveval")
# Not onnxruntime: it starts a thread when it is loaded, and a process of several threads must not fork.
LIBRARIES = ("cv2", "moderngl", "orjson", "scipy.optimize", "scipy.signal", "scipy.special", "soundfile")


def load() -> None:
    """Load what the children need."""
    for name in LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for stage in ("scene", "acoustics", "localization", "detection", "tracking", "metrics"):
        package = Path(importlib.import_module(f"avcli.{stage}").__file__ or "")
        for module in sorted(package.parent.glob("[a-z]*.py")):
            with contextlib.suppress(ImportError):
                importlib.import_module(f"avcli.{stage}.{module.stem}")
    gc.freeze()


def run(command: str, *arguments: object) -> None:
    """Run one of avcli's commands in a child; a command that fails ends the job."""
    sys.stdout.flush()
    child = os.fork()
    if not child:
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: no child outlives a killed worker
        sys.argv = [command, *map(str, arguments)]
        status = 70
        try:
            importlib.import_module(f"avcli.commands.{command.replace('-', '_')}").main()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status:
        sys.exit(f"scenes.py: {command} {' '.join(map(str, arguments))}: exit code {status}")


def scene(directory: Path, scenario: str, t60: str, noise: str, seed: int, seconds: float, video: bool) -> None:
    """Make one scene, as the Makefile does."""
    if (directory / "metrics.jsonl").exists():
        return
    shutil.rmtree(directory, ignore_errors=True)  # a worker was killed here
    for folder in ("localization", "tracking"):
        (directory / folder).mkdir(parents=True)
    at = ("-C", directory)
    truth, sound = directory / "scene.jsonl", directory / "audio.jsonl"
    found = {sensor: directory / f"localization/{sensor}_localizations.jsonl" for sensor in ("audio", "video")}
    drawn = () if video else ("--no-video",)
    run("avsim-scene", scenario, *at, *drawn, "--seed", seed, "--duration", seconds, "-o", truth)
    run("avsim-audio", *at, "--seed", seed, "--rt60", t60, "--noise", f"sensor={noise}", truth, "-o", sound)
    run("avdetect-audio", *at, "--seed", seed, sound, "-o", found["audio"])
    shutil.rmtree(directory / "audio")
    sensors = {"audio": [found["audio"]]}
    if video:
        run("avdetect-video", *at, truth, "-o", found["video"])
        shutil.rmtree(directory / "video")
        sensors |= {"video": [found["video"]], "audio_video": list(found.values())}
    for name, files in sensors.items():
        run("avfuse", *at, *files, "-o", directory / f"tracking/{name}_tracking.jsonl")
    run("aveval", "-q", "--experiments", directory, "--format", "jsonl", "-o", directory / "metrics.jsonl")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", required=True, help="s1 to s4, random, or a file")
    parser.add_argument("--t60", required=True, help="reverberation time, s")
    parser.add_argument("--noise", required=True, help="noise of the microphones, dB below a voice at 1 m")
    parser.add_argument("--seeds", required=True, help="FIRST-LAST")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of a scene")
    parser.add_argument("--video", action="store_true", help="with the camera, too")
    parser.add_argument("--out", type=Path, required=True, help="directory of the scenes")
    given = parser.parse_args()
    first, last = map(int, given.seeds.split("-"))
    load()
    for seed in range(first, last + 1):
        directory = given.out / f"seed~{seed}"
        scene(directory, given.scenario, given.t60, given.noise, seed, given.seconds, given.video)


if __name__ == "__main__":
    main()
