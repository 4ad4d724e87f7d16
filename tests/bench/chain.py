"""The whole chain as its commands run it, stage by stage; what another run of the same stage has made is used again."""

import importlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

run: Any = importlib.import_module("forked").run_forked
SENSORS = {"audio": ("audio",), "video": ("video",), "both": ("audio", "video")}
"""What is tracked: the detections of which sensors."""


def made(command: str, output: Path, *options: object, stdin: bytes = b"") -> Path:
    """Run a command with its output in a file, where that is not there yet; RuntimeError with its words if it fails."""
    if not output.exists():
        output.parent.mkdir(parents=True, exist_ok=True)
        ended = run(command, "-q", *options, "-o", output, stdin=stdin)
        if ended.returncode:
            raise RuntimeError(f"{command} {' '.join(map(str, options))}: {ended.stderr.strip()}")
    return output


def seen(folder: Path, scenario: str | dict, *options: object) -> Path:
    """Draw a scenario into a folder; return the folder, which has config.json, the truth and scene.jsonl."""
    made("avsim-scene", folder / "scene.jsonl", *_given(scenario), "-C", folder, *options, stdin=_text(scenario))
    return folder


def heard(folder: Path, scenario: str | dict, *options: object, drawn: Sequence[object] = ()) -> Path:
    """Simulate the sound of a scenario, which is not drawn, into a folder; return the folder."""
    seen(folder, scenario, "--no-video", *drawn)
    made("avsim-audio", folder / "audio.jsonl", "-C", folder, folder / "scene.jsonl", *options)
    return folder


def scored(truth: Path, tracks: Path, d0: float) -> float:
    """HOTA in percent."""
    ended = run("aveval", "-q", truth, tracks, "--d0", d0, "--format", "jsonl")
    if ended.returncode:
        raise RuntimeError(ended.stderr.strip())
    return 100 * json.loads(ended.stdout.splitlines()[0])["summary"]["HOTA"]


def tracked(
    experiment: Path, found: dict[str, Path], tracks: Path, *options: object, d0: Sequence[float] = (2.0, 0.5)
) -> dict[str, dict[float, float]]:
    """Track by sound, by pictures and by both; return HOTA in percent by what was tracked, and by d0 in metres.

    Args:
        experiment: folder with config.json and the truth.
        found: detections by sensor.
        tracks: path without its end for the tracks.
        options: of avfuse.
        d0: m, the distances at which a track has no similarity with a person.
    """
    score: dict[str, dict[float, float]] = {}
    for name, sensors in SENSORS.items():
        path = made(
            "avfuse", tracks.with_name(f"{tracks.name}-{name}.jsonl"), "-C", experiment, *options,
            *(found[sensor] for sensor in sensors),
        )  # fmt: skip
        score[name] = {each: scored(experiment / "groundtruth_sources.jsonl", path, each) for each in d0}
    return score


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % interval by Student's t; NaN of fewer than two values."""
    some = np.asarray(values, float)
    if len(some) < 2:
        return float(some.mean()), math.nan
    return float(some.mean()), float(stats.t.ppf(0.975, len(some) - 1) * some.std(ddof=1) / math.sqrt(len(some)))


def shown(values: Sequence[float]) -> str:
    """A mean with its interval as a cell of a table."""
    mean, half = interval(values)
    return f"{mean:.1f}" if math.isnan(half) else f"{mean:.1f} ± {half:.1f}"


def _given(scenario: str | dict) -> list[str]:
    return [scenario] if isinstance(scenario, str) else ["-"]


def _text(scenario: str | dict) -> bytes:
    return b"" if isinstance(scenario, str) else json.dumps(scenario).encode()
