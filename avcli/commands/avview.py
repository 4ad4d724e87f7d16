"""avview: look at a run, live or afterwards."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from avcli.commands.filter import Filter, Session, common

if TYPE_CHECKING:
    from avcli.formats.experiment import Config
    from avcli.view.page import Shown
    from avcli.view.recording import Recording

_FILE: dict[str, Any] = {"type": click.Path(dir_okay=False), "metavar": "FILE"}
_LYING: dict[str, Any] = {"type": click.Path(exists=True, dir_okay=False), "metavar": "FILE"}


@dataclass
class Options:
    """What the user asked for, beside what to show."""

    truth: tuple[str, ...]
    film: str | None
    sound: str | None
    microphone: int
    start: float
    learnt: str | None
    scenario: str | None


@dataclass
class Run:
    """One run and where its parts come from."""

    name: str
    root: Path
    files: list[str] = field(default_factory=list)
    config_path: Path | None = None


@click.command("avview", cls=Filter, epilog="Example: avview out/s1 --html s1.html")
@click.argument("paths", nargs=-1, metavar="[FILE|DIR]...")
@click.option("--html", **_FILE, help="Write a page: picture, map, sound and lanes on one clock.")
@click.option(
    "--largest-mb",
    type=click.FloatRange(0),
    metavar="MB",
    default=20.0,
    show_default=True,
    help="A page that would be larger gets a folder beside it, FILE.files, with film and sound.",
)
@click.option("--truth", multiple=True, metavar="FILE", help="This file is ground truth; by default its keys tell.")
@click.option("--film", **_LYING, help="Show the pictures of this video; its first one was taken at --start.")
@click.option("--sound", **_LYING, help="Play this sound file; its first sample was taken at --start.")
@click.option(
    "--microphone",
    type=click.IntRange(1),
    metavar="N",
    default=1,
    show_default=True,
    help="Play and draw the sound of this microphone.",
)
@click.option(
    "--start", type=float, metavar="S", default=0.0, show_default=True, help="Time of the start of film and sound, s."
)
@click.option("--learnt", **_LYING, help="Show where people leave, from a file that avfuse --learn wrote.")
@click.option("--scenario", metavar="NAME|FILE", help="Draw the furniture of this scenario on the map.")
@common(skip_invalid=True, media=True, output=False)
def main(session: Session, paths: tuple[str, ...], html: str | None, largest_mb: float, **values: Any) -> None:
    """Look at a run: tracks, truth, detections and sound in the camera's picture and on a map, on one clock.

    FILE is any mixture of records: ground truth, detections, tracks, audio. DIR is an experiment directory, of which
    everything is shown. Records that come from standard input are passed on to standard output.
    """
    options = Options(**values)
    if not html:
        session.usage("nothing to do: give --html FILE")
    if not Path(html).parent.is_dir():
        session.usage(f"{html}: its directory does not exist")
    runs = list(_runs(session, paths, options))
    shown = [_shown(session, run, options) for run in runs]
    from avcli.metrics.hota import ALPHA
    from avcli.view import page

    with session.timing("page"):
        words = page.Words(", ".join(run.name for run in runs), alpha=[round(alpha, 2) for alpha in ALPHA.tolist()])
        folder = page.save(Path(html), shown, words, session.warn, largest_mb)
    if folder is not None:
        session.warn(f"{html} needs the folder {folder} beside it: in one file it would be over {largest_mb:g} MB")


def _runs(session: Session, paths: tuple[str, ...], options: Options) -> Iterator[Run]:
    """Sort what the user named into runs: one for each directory, and one for all files."""
    from avcli.formats.experiment import Layout

    config = session.config_path if session.has_config else None
    directories = [path for path in paths if path != "-" and Path(path).is_dir()]
    for path in directories:
        layout = Layout(Path(path))
        lying = [layout.groundtruth, Path(path) / "audio.jsonl"]
        lying = [file for file in lying if file.is_file()]
        lying += sorted(layout.localization.glob("*.jsonl")) + sorted(layout.tracking.glob("*.jsonl"), key=_fused_last)
        if not lying:
            session.usage(f"{path}: no records lie in this directory")
        name = Path(path).resolve().name
        yield Run(name, Path(path), [str(file) for file in lying], config or layout.config)
    named = [path for path in paths if path not in directories]
    if named or not directories:
        root = session.media_root
        name = root.resolve().name if session.has_experiment else Path(named[0]).stem if named else "stdin"
        yield Run(name, root, [*options.truth, *named] or ["-"], config)


def _fused_last(path: Path) -> tuple[int, str]:
    """Order tracks so that those of several sensors, whose names are the longest, stand last and are shown first."""
    return len(path.name), path.name


def _config(session: Session, run: Run) -> Config | None:
    from avcli.formats.experiment import read_config

    if run.config_path is None:
        return None
    try:
        return session.config if session.has_config else read_config(run.config_path)
    except FileNotFoundError:
        session.warn(f"{run.config_path}: no such file; the page has no map of the room and no picture")
        return None


def _shown(session: Session, run: Run, options: Options) -> Shown:
    from avcli.view import experiment
    from avcli.view.page import Shown
    from avcli.view.recording import Recording
    from avcli.view.surroundings import surroundings

    stated = ("-" in run.files) or None  # a pipeline that ends here may write config.json after it has begun
    config = None if stated else _config(session, run)
    recording = Recording(run.name, config.sensors if config else None, outside=session.allow_outside)
    _read(session, run, recording, options)
    if stated:
        config = _config(session, run)
    around: Mapping[str, Any] = {}
    if config is not None:
        around = surroundings(config, _furniture(session, options.scenario), _learnt(session, options), session.warn)
    shown = Shown(recording, around, rate_hz=_rate(config))
    with session.timing("pictures"):
        if options.film:
            shown.pictures, shown.picture_count = experiment.film(options.film, shown.rate_hz, options.start)
        else:
            found = experiment.frames(run.root, recording.frames)
            shown.pictures, shown.picture_count = found, len(found)
    with session.timing("sound"):
        if options.sound:
            shown.track = experiment.recording(options.sound, options.microphone, options.start)
        else:
            shown.track = experiment.channel(run.root, recording.chunks, options.microphone)
    with session.timing("score"):
        shown.scores = _scores(recording)
    return shown


def _read(session: Session, run: Run, recording: Recording, options: Options) -> None:
    from avcli.view.recording import TRUTH

    for path in sorted(run.files, key=lambda path: path == "-"):
        source = "tracks" if path == "-" else Path(path).stem.removesuffix("_tracking")
        parse = partial(_add, recording, source, TRUTH if path in options.truth else None)
        with session.timing("read"):
            if path == "-":
                for _ in session.stream_records(_Tee(session.open(path)), "<stdin>", parse):  # type: ignore[arg-type]
                    pass
            else:
                for _ in session.records([path], parse):
                    pass


def _add(recording: Recording, source: str, stated: str | None, record: Mapping[str, Any], bad: Any) -> Any:
    return recording.add(record, source, bad, stated)


class _Tee:
    """Standard input, whose lines go on to standard output as they are read."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream

    def readline(self, size: int = -1) -> bytes:
        """Read a line and pass it on."""
        line = self._stream.readline(size)
        sys.stdout.buffer.write(line)
        sys.stdout.buffer.flush()
        return line


def _rate(config: Config | None) -> float:
    return 10.0 if config is None else config.frame_rate_hz


def _furniture(session: Session, scenario: str | None) -> list[dict[str, Any]]:
    if scenario is None:
        return []
    from avcli.scene.load import load
    from avcli.scene.outline import plan

    try:
        return plan(load(scenario))
    except (ValueError, OSError) as error:
        session.usage(f"--scenario {scenario}: {error}")


def _learnt(session: Session, options: Options) -> Mapping[str, Any] | None:
    if options.learnt is None:
        return None
    from avcli.tracking.learnt import read_learnt

    try:
        return read_learnt(options.learnt)
    except OSError as error:
        session.usage(f"{options.learnt}: {(error.strerror or str(error)).lower()}")
    except ValueError as error:
        session.fail(f"{options.learnt}: {error}")


def _scores(recording: Recording) -> dict[str, Any] | None:
    """Score each tracker where there is ground truth."""
    from avcli.metrics import report, scoring
    from avcli.metrics.settings import Settings
    from avcli.view.recording import TRACKS, TRUTH

    truth = recording.people.get((TRUTH, "truth"))
    if not truth or not any(map(len, truth)):
        return None
    scores = {}
    for (kind, name), tracks in recording.people.items():
        if kind == TRACKS:
            tracked, _ = scoring.score_tracks(truth, tracks, Settings(), recording.name, name, keep_first=True)
            scores[name] = report.over_time(tracked)
    return scores
