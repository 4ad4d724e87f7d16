"""Which files make up a sequence: named one by one, or found in experiment directories."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from avcli.formats.experiment import Layout
from avcli.formats.records import printable

_FIRST = ("audio", "video", "audio_video")
"""The thesis's trackers, which stand first in this order."""


@dataclass(frozen=True)
class Input:
    """What to read for one sequence; "-" is standard input.

    Attributes:
        name: of the sequence.
        truth: file of ground truth.
        tracks: name and file of each tracker.
        detections: files of detections to score.
        unscored: files of detections that pictures alone show.
        directory: where the experiment's config.json and pictures lie, if they do.
    """

    name: str
    truth: str
    tracks: Sequence[tuple[str, str]]
    detections: Sequence[str]
    unscored: Sequence[str]
    directory: Path


def from_files(paths: Sequence[str], detections: Sequence[str], directory: Path | None = None) -> Input:
    """Make one sequence of named files; trackers are named by their files.

    Args:
        paths: of the ground truth and of at least one tracker's tracks.
        detections: files of detections to score.
        directory: of the experiment, by default that of the ground truth.

    Raises:
        ValueError: fewer than two paths, a file is missing, or two tracks are the same file. Ground truth may be
            missing while tracks come from standard input: a pipeline may write it later.
    """
    if len(paths) < 2:
        raise ValueError("GROUNDTRUTH and at least one TRACKS are needed (- is standard input)")
    truth, *tracks = paths
    for path in (*(tracks if "-" in tracks else (truth, *tracks)), *detections):
        _must_exist(path)
    names = ["stdin" if path == "-" else printable(Path(path).stem.removesuffix("_tracking")) for path in tracks]
    if len(set(names)) < len(names):
        names = [printable(path) for path in tracks]
    if len(set(names)) < len(names):
        raise ValueError("the same TRACKS are named twice")
    named = list(zip(names, tracks, strict=True))
    return Input(_sequence_name(truth), truth, named, detections, [], directory or Path(truth).parent)


def from_experiments(directories: Sequence[str], detections: Sequence[str]) -> list[Input]:
    """Make a sequence of each experiment directory: its ground truth and all its tracks.

    Args:
        directories: of the experiments.
        detections: paths inside each directory.

    Raises:
        ValueError: no directory is given, one has no ground truth or no tracks, or a file of detections is missing.
    """
    if not directories:
        raise ValueError("--experiments needs at least one experiment directory")
    inputs = []
    for directory in directories:
        layout = Layout(Path(directory))
        _must_exist(str(layout.groundtruth))
        found = {path.stem.removesuffix("_tracking"): str(path) for path in layout.tracking.glob("*_tracking.jsonl")}
        if not found:
            raise ValueError(f"{layout.tracking}: no *_tracking.jsonl")
        order = [name for name in _FIRST if name in found] + sorted(set(found) - set(_FIRST))
        scored = [str(layout.directory / path) for path in detections]
        for path in scored:
            _must_exist(path)
        lying = sorted(map(str, layout.localization.glob("*_localizations.jsonl")))
        name = _sequence_name(str(layout.groundtruth))
        unscored = [path for path in lying if path not in scored]
        tracks = [(tracker, found[tracker]) for tracker in order]
        inputs.append(Input(name, str(layout.groundtruth), tracks, scored, unscored, layout.directory))
    if len({entry.name for entry in inputs}) < len(inputs):
        inputs = [replace(entry, name=directory) for entry, directory in zip(inputs, directories, strict=True)]
    return inputs


def missing_trackers(inputs: Sequence[Input]) -> dict[str, list[str]]:
    """Return, by the sequence's name, the trackers that other sequences have and this one has not."""
    trackers = {tracker for entry in inputs for tracker, _ in entry.tracks}
    missing = {entry.name: sorted(trackers - {tracker for tracker, _ in entry.tracks}) for entry in inputs}
    return {name: lacking for name, lacking in missing.items() if lacking}


def _must_exist(path: str) -> None:
    if path != "-" and not Path(path).exists():
        raise ValueError(f"{path}: no such file or directory")


def _sequence_name(path: str) -> str:
    """The experiment's name where the file is an experiment's ground truth, otherwise the file's."""
    if path == "-":
        return "stdin"
    if Path(path).name == "groundtruth_sources.jsonl":
        return printable(Path(path).resolve().parent.name)
    return printable(Path(path).stem)
