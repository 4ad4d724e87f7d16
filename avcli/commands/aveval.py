"""aveval: score tracks against ground truth."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.commands.filter import Filter, GateNotMet, Session, common
from avcli.commands.options import from_settings, refuse_without_effect, settings_from
from avcli.metrics.settings import MotSettings, Settings

if TYPE_CHECKING:
    from avcli.formats.experiment import Config
    from avcli.formats.records import Identified
    from avcli.metrics.inputs import Input
    from avcli.metrics.run import Run
    from avcli.metrics.sequence import Mismatch

Emit = Callable[[dict], None]
Name = str | None
_FILE: dict[str, Any] = {"type": click.Path(dir_okay=False), "metavar": "FILE"}
_DIRECTORY: dict[str, Any] = {"type": click.Path(file_okay=False), "metavar": "DIR"}


@click.command("aveval", cls=Filter, epilog="Example: aveval out/s1/groundtruth_sources.jsonl tracks.jsonl")
@click.argument("paths", nargs=-1, metavar="GROUNDTRUTH TRACKS...")
@click.option(
    "--experiments",
    is_flag=True,
    help="The arguments are experiment directories: score their tracking/*_tracking.jsonl against their ground truth.",
)
@from_settings(Settings)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["jsonl", "table", "csv", "markdown", "latex"]),
    help="Format of the output.  [default: table on a terminal, otherwise jsonl]",
)
@click.option("--compare-thesis", is_flag=True, help="Show the thesis's results (tables 5.6 to 5.10) beside s1 to s4.")
@click.option(
    "--fail-under",
    multiple=True,
    metavar="[TRACKER:]NAME=PERCENT",
    help="Exit with 3 if a summary score of all sequences together is below this many percent; may be repeated.",
)
@click.option(
    "--detections",
    multiple=True,
    metavar="FILE",
    help="Score a sensor's detections too; with --experiments, a path inside each directory; may be repeated.",
)
@click.option(
    "--plot", **_FILE, help="Draw each sequence to FILE.png, .svg or .pdf; with several sequences, to FILE-NAME.png."
)
@click.option("--html", **_FILE, help="Write a report: one self-contained page with tables, plots and a player.")
@click.option(
    "--mot", **_DIRECTORY, help="Write ground truth and tracks as MOTChallenge files and TrackEval's folders."
)
@from_settings(MotSettings)
@common(skip_invalid=True, presets={"thesis": {"dims": 2, "d0": 2.0, "compare_thesis": True}})
def main(
    session: Session,
    paths: tuple[str, ...],
    experiments: bool,
    kind: str | None,
    compare_thesis: bool,
    fail_under: tuple[str, ...],
    detections: tuple[str, ...],
    plot: Name,
    html: Name,
    mot: Name,
    rate: float,
    **values: Any,
) -> None:
    """Score tracks against ground truth: HOTA, CLEAR and identity as TrackEval does, and OSPA, GOSPA, errors, delays.

    Writes one metrics record for each sequence and tracker, and for each tracker one "combined" over all sequences
    (and, for several sequences, their plain "mean"). TRACKS may be -, standard input.
    """
    from avcli.metrics import gates, table
    from avcli.metrics.scoring import combined

    settings: Settings = settings_from(Settings, values)
    if settings.speaking and compare_thesis:
        session.usage("--speaking and --compare-thesis exclude each other: the thesis scored silent people too")
    if not any(Path(path).suffix.lower() in (".txt", ".csv") for path in paths):
        refuse_without_effect(["rate"], "without MOTChallenge files (.txt or .csv)")
    with _ending(session.usage, "--fail-under"):
        least = [gates.parse_gate(text) for text in fail_under]
    if plot and Path(plot).suffix.lower() not in (".png", ".svg", ".pdf"):
        session.usage(f"--plot {plot}: the name must end in .png, .svg or .pdf")
    for path in filter(None, (plot, html)):
        if not Path(path).parent.is_dir():
            session.usage(f"{path}: its directory does not exist")
    inputs = _inputs(session, paths, experiments, detections)
    if kind is None:
        kind = "table" if session.output_path == "-" and sys.stdout.isatty() else "jsonl"
    if kind == "jsonl" and not html:
        refuse_without_effect(["compare_thesis"], "with --format jsonl and without --html")
    records: list[dict] = []
    with session.output() as write:

        def emit(record: dict) -> None:
            records.append(record)
            if kind == "jsonl":
                write(record)

        pictures = "html" if html else "plot" if plot else ""
        runs = [_score(session, entry, settings, rate, emit, pictures) for entry in inputs]
        for text in dict.fromkeys(text for run in runs for text in run.guesses):
            session.warn(text)
        for record in combined(runs, session.warn):
            emit(record)
        if kind != "jsonl":
            width = shutil.get_terminal_size((120, 24)).columns if sys.stdout.isatty() else None
            write(table.render(records, kind, compare_thesis, width))
    _write_files(session, runs, records, plot, html, mot, compare_thesis)
    if missed := gates.missed_gates(least, records):
        raise GateNotMet("; ".join(missed))


def _inputs(session: Session, paths: tuple[str, ...], experiments: bool, detections: tuple[str, ...]) -> list[Input]:
    from avcli.metrics import inputs

    with _ending(session.usage):
        if not experiments:
            directory = session.experiment if session.has_experiment else None
            return [inputs.from_files(paths, detections, directory)]
        found = inputs.from_experiments(paths, detections)
    for name, trackers in inputs.missing_trackers(found).items():
        session.warn(f"{name} has no tracks of {', '.join(trackers)}: their combined scores cover fewer sequences")
    return found


def _write_files(
    session: Session, runs: list[Run], records: list[dict], plot: Name, html: Name, mot: Name, compare: bool
) -> None:
    if plot:
        from avcli.metrics.plots import save_plots

        with session.timing("plot"):
            save_plots(Path(plot), runs)
    if html:
        from avcli.metrics.report import save_report

        with session.timing("report"):
            save_report(Path(html), runs, records, compare)
    if mot:
        from avcli.metrics.mot import save_mot

        save_mot(Path(mot), {run.name: run.sequences for run in runs})


@contextlib.contextmanager
def _ending(end: Callable[[str], None], where: str = "") -> Iterator[None]:
    """End the command with the sentence of a stage that refuses its input."""
    try:
        yield
    except ValueError as error:
        end(f"{where}: {error}" if where else str(error))


def _identified(session: Session, path: str, rate: float) -> list[Identified]:
    """Read a file of ground truth or tracks: JSON Lines, or MOTChallenge's rows in a .txt or .csv."""
    from avcli.formats import records
    from avcli.metrics import mot

    with session.timing("read"):
        if Path(path).suffix.lower() not in (".txt", ".csv"):
            return list(session.records([path], records.identified))
        with session.open(path) as stream, _ending(session.fail, path):
            return mot.read(stream.read().decode(), rate)


def _config(session: Session, entry: Input) -> Config | None:
    """Read the experiment's config.json; None if it has none."""
    from avcli.formats.experiment import read_config

    try:
        return session.config if session.has_config else read_config(entry.directory / "config.json")
    except FileNotFoundError:
        return None


def _score(session: Session, entry: Input, settings: Settings, rate: float, emit: Emit, pictures: str) -> Run:
    """Score the tracks and detections of one sequence, and gather what its pictures ("html", "plot" or none) show."""
    from avcli.formats import records
    from avcli.metrics.run import Run
    from avcli.metrics.scoring import score_sensors, score_tracks

    # A pipeline that ends here may still be writing the ground truth: it is whole when the tracks have ended.
    piped = {path: _identified(session, path, rate) for _, path in entry.tracks if path == "-"}
    truth = _identified(session, entry.truth, rate)
    if not any(map(len, truth)):
        session.warn(f"{entry.name}: the ground truth has no objects, so all tracks are false")
    keep_first = session.skip_invalid
    trackers = {}
    for name, path in entry.tracks:
        tracks = piped[path] if path in piped else _identified(session, path, rate)
        with session.timing("score"), _ending(session.fail, f"{entry.name} {name}"):
            tracked, mismatch = score_tracks(truth, tracks, settings, entry.name, name, keep_first=keep_first)
        if any(map(len, tracks)):
            _warn(session, f"{entry.name} {name}", mismatch, settings, "track")
        else:
            session.warn(f"{entry.name} {name}: there are no tracks, so all people are missed")
        emit(tracked.record)
        trackers[name] = tracked
    config = _config(session, entry) if pictures or entry.detections else None
    paths = (*entry.detections, *(entry.unscored if pictures else ()))
    found = [(path, session.records([path], records.detections)) for path in paths]
    kinds = config.sensors if config else None
    sensors = {}
    scored = score_sensors(truth, found, settings, entry.name, sensors=kinds, keep_first=keep_first)
    for path, name, detected, mismatch in scored:
        sensors[name] = replace(detected, scored=path in entry.detections)
        if sensors[name].scored:
            _warn(session, f"{entry.name} {name}", mismatch, settings, "detection")
            emit(detected.record)
    run = Run(entry.name, trackers, sensors)
    if not pictures or config is None:
        return run
    from avcli.metrics.surroundings import with_surroundings

    with session.timing("surroundings"):
        return with_surroundings(run, config, entry.directory if pictures == "html" else None, session.warn)


def _warn(session: Session, name: str, mismatch: Mismatch, settings: Settings, kind: str) -> None:
    """Say which records of tracks or detections ("track", "detection") do not fit the ground truth."""
    within = f"within {1000 * settings.tolerance:g} ms"
    for count, text in (
        (
            mismatch.truth_frames,
            f"of {mismatch.truth_records} ground-truth records have no {kind} record {within}; "
            f"their {mismatch.truth_points} points count as missed",
        ),
        (
            mismatch.track_frames,
            f"of {mismatch.track_records} {kind} records have no ground truth {within}; "
            f"their {mismatch.track_points} points count as false",
        ),
        (mismatch.unsorted, "records were out of order and have been sorted"),
        (mismatch.repeated, "records repeat a time; their points have been joined"),
        (mismatch.dropped, "points dropped because their identity occurs twice at a time"),
    ):
        if count:
            session.warn(f"{name}: {count} {text}")
    if settings.dims == 3 and kind == "track" and abs(mismatch.height) > 0.25:
        session.warn(
            f"{name}: tracks are {mismatch.height:+.2f} m from the ground truth in height on average, perhaps because "
            "they are positions of another point of the body; --dims 2 compares x and y only"
        )
