"""aveval: score tracks against ground truth."""

from __future__ import annotations

import contextlib
import functools
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.commands.filter import Filter, GateNotMet, Session, common
from avcli.commands.options import from_settings, refuse_without_effect, settings_from
from avcli.metrics.settings import MotSettings, Settings

if TYPE_CHECKING:
    from avcli.formats.experiment import Config
    from avcli.formats.records import Detections, Identified
    from avcli.metrics.inputs import Input
    from avcli.metrics.run import Run
    from avcli.metrics.sequence import Mismatch
    from avcli.view.page import Shown
    from avcli.view.recording import Recording

Emit = Callable[[dict], None]
Name = str | None
_NOT_RANKED = ("experiments", "d0", "compare_thesis", "fail_under", "detections", "plot", "html", "mot", "rate")
"""Parameters without effect on a leaderboard."""
APART = 0.5  # DetA up to which it is asked whether the tracks are elsewhere or late
_FILE: dict[str, Any] = {"type": click.Path(dir_okay=False), "metavar": "FILE"}
_DIRECTORY: dict[str, Any] = {"type": click.Path(file_okay=False), "metavar": "DIR"}


@click.command("aveval", cls=Filter, epilog="Example: aveval out/s1/groundtruth_sources.jsonl tracks.jsonl")
@click.argument("paths", nargs=-1, metavar="GROUNDTRUTH TRACKS...")
@click.option(
    "--experiments",
    is_flag=True,
    help="The arguments are experiment directories: score their tracking/*_tracking.jsonl against their ground truth.",
)
@click.option(
    "--leaderboard",
    is_flag=True,
    help="The arguments are a data set in MOTChallenge's layout and the directories of trackers, each with a file "
    "SEQUENCE.txt or SEQUENCE.jsonl for each sequence: rank the trackers, at d0 of 2 and 0.5 m.",
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
@click.option("--html", **_FILE, help="Write the page of avview with the scores: picture, map, sound, lanes, tables.")
@click.option(
    "--mot", **_DIRECTORY, help="Write ground truth and tracks as MOTChallenge files and TrackEval's folders."
)
@from_settings(MotSettings)
@common(skip_invalid=True, presets={"thesis": {"dims": 2, "d0": 2.0, "compare_thesis": True}})
def main(
    session: Session,
    paths: tuple[str, ...],
    experiments: bool,
    leaderboard: bool,
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
    from avcli.metrics import scoring, table

    settings: Settings = settings_from(Settings, values)
    if settings.speaking and compare_thesis:
        session.usage("--speaking and --compare-thesis exclude each other: the thesis scored silent people too")
    if not any(Path(path).suffix.lower() in (".txt", ".csv") for path in paths):
        refuse_without_effect(["rate"], "without MOTChallenge files (.txt or .csv)")
    with _ending(session.usage, "--fail-under"):
        least = [scoring.parse_gate(text) for text in fail_under]
    if plot and Path(plot).suffix.lower() not in (".png", ".svg", ".pdf"):
        session.usage(f"--plot {plot}: the name must end in .png, .svg or .pdf")
    if [*paths, *detections].count("-") > 1:
        session.usage("standard input ('-') is named twice")
    session.check_outputs({"--plot": plot, "--html": html}, [*paths, *detections])
    if kind is None:
        kind = "table" if session.output_path == "-" and sys.stdout.isatty() else "jsonl"
    if leaderboard:
        refuse_without_effect(_NOT_RANKED, "with --leaderboard")
        _rank(session, paths, settings, kind)
        return
    inputs = _inputs(session, paths, experiments, detections)
    if kind == "jsonl" and not html:
        refuse_without_effect(["compare_thesis"], "with --format jsonl and without --html")
    records: list[dict] = []
    with session.output() as write:

        def emit(record: dict) -> None:
            records.append(record)
            if kind == "jsonl":
                write(record)

        shown: list[Shown] | None = [] if html else None
        runs = [_score(session, entry, settings, rate, emit, bool(plot), shown) for entry in inputs]
        for text in dict.fromkeys(text for run in runs for text in run.guesses):
            session.warn(text)
        for record in scoring.combined(runs, session.warn):
            emit(record)
        if kind != "jsonl":
            width = shutil.get_terminal_size((120, 24)).columns if sys.stdout.isatty() else None
            write(table.render(records, kind, compare_thesis, width))
    _write_files(session, runs, plot, mot)
    if html and shown is not None:
        _write_page(session, Path(html), shown, records, compare_thesis)
    if missed := scoring.missed_gates(least, records):
        raise GateNotMet("; ".join(missed))


def _rank(session: Session, paths: tuple[str, ...], settings: Settings, kind: str) -> None:
    """Write the leaderboard of a data set and the directories of trackers."""
    from avcli.metrics import leaderboard, table

    if len(paths) < 2:
        session.usage("--leaderboard needs a data set and at least one directory of a tracker")
    for path in paths:
        if not Path(path).is_dir():
            session.usage(f"{path}: no such directory")
    dataset, *trackers = map(Path, paths)
    names = [path.resolve().name for path in trackers]
    if len(set(names)) < len(names):
        session.usage("two directories of trackers have the same name")
    with _ending(session.fail):
        found = leaderboard.entries(dataset)
    truths = {entry: _identified(session, str(entry.truth), entry.rate_hz) for entry in found}
    tracks: dict[str, dict] = {}
    for name, tracker in zip(names, trackers, strict=True):
        files = {entry: leaderboard.file_of(tracker, entry) for entry in found}
        if missing := [entry.name for entry, path in files.items() if path is None]:
            session.warn(f"{name} has no file for {', '.join(missing)}: counted as missed")
        tracks[name] = {e: _identified(session, str(path), e.rate_hz) for e, path in files.items() if path}
    with session.output() as write, session.timing("score"), _ending(session.fail):
        ranked = list(leaderboard.rank(truths, tracks, settings, functools.cache(session.warn)))
        for record in ranked if kind == "jsonl" else ():
            write(record)
        if kind != "jsonl":
            width = shutil.get_terminal_size((120, 24)).columns if sys.stdout.isatty() else None
            write(table.render(ranked, kind, False, width))


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


def _write_files(session: Session, runs: list[Run], plot: Name, mot: Name) -> None:
    if plot:
        from avcli.metrics.plots import save_plots

        with session.timing("plot"):
            save_plots(Path(plot), runs)
    if mot:
        from avcli.metrics.mot import save_mot

        save_mot(Path(mot), {run.name: run.sequences for run in runs})


def _write_page(session: Session, path: Path, shown: list[Shown], records: list[dict], compare: bool) -> None:
    from avcli import __version__
    from avcli.metrics import report
    from avcli.metrics.hota import ALPHA
    from avcli.view import page

    with session.timing("report"):
        words = page.Words(
            title=", ".join(one.recording.name for one in shown),
            subject="tracking report",
            writer=f"aveval {__version__}",
            scores=report.section(records, compare),
            alpha=[round(alpha, 2) for alpha in ALPHA.tolist()],
        )
        folder = page.save(path, shown, words, session.warn)
    if folder is not None:
        session.warn(f"{path} needs the folder {folder} beside it: in one file it would be very large")


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
            names = records.Names()

            def people(record: Mapping[str, Any], bad: records.Bad) -> Identified:
                try:
                    one = records.identified(record, bad, names)
                except records.WrongKindError as error:
                    raise records.WrongKindError(f"{error}; --detections scores them") from None
                return records.Identified(  # without what no score asks for: long files take less memory
                    one.timestamp, one.ids, one.positions, one.mouths, one.speaking, names=one.names
                )

            return list(session.records([path], people))
        with session.open(path) as stream, _ending(session.fail, path):
            return mot.read(stream.read().decode(), rate)


def _config(session: Session, entry: Input) -> Config | None:
    """Read the experiment's config.json; None if it has none."""
    from avcli.formats.experiment import read_config

    try:
        return session.config if session.has_config else read_config(entry.directory / "config.json")
    except FileNotFoundError:
        return None


def _score(
    session: Session,
    entry: Input,
    settings: Settings,
    rate: float,
    emit: Emit,
    plotted: bool,
    shown: list[Shown] | None,
) -> Run:
    """Score the tracks and detections of one sequence, and gather what its plot and, in `shown`, the page show."""
    from avcli.formats import records
    from avcli.metrics.run import Run
    from avcli.metrics.scoring import score_sensors, score_tracks
    from avcli.view.recording import TRACKS, TRUTH, Recording

    # A pipeline that ends here may still be writing the ground truth: it is whole when the tracks have ended.
    piped = {path: _identified(session, path, rate) for _, path in entry.tracks if path == "-"}
    truth = _identified(session, entry.truth, rate)
    if not any(map(len, truth)):
        session.warn(f"{entry.name}: the ground truth has no objects, so any track is false")
    keep_first = session.skip_invalid
    config = _config(session, entry) if plotted or shown is not None or entry.detections else None
    kinds = config.sensors if config else None
    recording = Recording(entry.name, kinds)
    recording.add_all(TRUTH, "truth", truth)
    trackers = {}
    for name, path in entry.tracks:
        tracks = piped[path] if path in piped else _identified(session, path, rate)
        recording.add_all(TRACKS, name, tracks)
        with session.timing("score"), _ending(session.fail, f"{entry.name} {name}"):
            tracked, mismatch = score_tracks(truth, tracks, settings, entry.name, name, keep_first=keep_first)
        if any(map(len, tracks)):
            _warn(session, f"{entry.name} {name}", mismatch, settings, "track")
            if mismatch.truth_frames < mismatch.truth_records:
                _warn_apart(session, f"{entry.name} {name}", truth, tracks, tracked.record, settings)
        elif any(map(len, truth)):
            session.warn(f"{entry.name} {name}: there are no tracks, so all people are missed")
        else:
            session.warn(f"{entry.name} {name}: there are no tracks either; that is right, but HOTA and its like are 0")
        emit(tracked.record)
        trackers[name] = tracked
    paths = (*entry.detections, *(entry.unscored if plotted or shown is not None else ()))
    found = [(path, _noted(recording, session.records([path], records.detections))) for path in paths]
    sensors = {}
    scored = score_sensors(truth, found, settings, entry.name, sensors=kinds, keep_first=keep_first)
    for path, name, detected, mismatch in scored:
        sensors[name] = replace(detected, scored=path in entry.detections)
        if sensors[name].scored:
            _warn(session, f"{entry.name} {name}", mismatch, settings, "detection")
            emit(detected.record)
    run = Run(entry.name, trackers, sensors)
    if shown is not None:
        with session.timing("surroundings"):
            shown.append(_shown(session, entry, recording, config, run))
    if not plotted or config is None:
        return run
    from avcli.metrics.run import with_surroundings

    return with_surroundings(run, config, session.warn)


def _warn_apart(
    session: Session,
    name: str,
    truth: Sequence[Identified],
    tracks: Sequence[Identified],
    scores: Mapping[str, Any],
    settings: Settings,
) -> None:
    """Say that tracks are where nobody is, and what brings them there: another frame, or another clock."""
    if scores["summary"]["DetA"] > APART:
        return
    if not scores["HOTA"]["HOTA_TP"][0]:
        session.warn(
            f"{name}: no track comes within {settings.d0:g} m (--d0) of anybody; the tracks lie in {_extent(tracks)}, "
            f"the people in {_extent(truth)}: are both in metres, from the same corner?"
        )
    from avcli.tracking.clocks import REACH, offset
    from avcli.tracking.frames import transform

    ordered = (sorted(side, key=attrgetter("timestamp")) for side in (truth, tracks))
    people, found = ([(one.timestamp, one.positions) for one in side] for side in ordered)
    there = f"{name}: the tracks are where the people are,"
    if (moved := transform(people, found)) is not None:
        fits, as_it_is = f"{moved.fits:.0%} within {REACH:g} m", f"as they are {moved.as_it_is:.0%}"
        session.warn(f"{there} {moved.words()} ({fits}; {as_it_is}): do the coordinates agree?")
    elif (late := offset(people, found)) is not None:
        when = "later" if late.seconds > 0 else "before"
        fits, at_once = f"{late.fits:.0%} within {REACH:g} m", f"at the same time {late.at_once:.0%}"
        session.warn(f"{there} {abs(late.seconds):.1f} s {when} ({fits}; {at_once}): do the clocks agree?")


def _extent(people: Sequence[Identified]) -> str:
    """Say in which x and y, m, people are."""
    import numpy as np

    places = np.concatenate([one.positions[:, :2] for one in people])
    if not len(places):
        return "no place"
    (x0, y0), (x1, y1) = places.min(0), places.max(0)
    return f"x {x0:.4g} to {x1:.4g} m, y {y0:.4g} to {y1:.4g} m"


def _noted(recording: Recording, found: Iterator[Detections]) -> Iterator[Detections]:
    """Show detections on the page while they are scored."""
    for one in found:
        recording.add_detections(one)
        yield one


def _shown(session: Session, entry: Input, recording: Recording, config: Config | None, run: Run) -> Shown:
    from avcli.metrics.report import over_time
    from avcli.view import experiment
    from avcli.view.page import Shown
    from avcli.view.surroundings import surroundings

    pictures = experiment.frames(entry.directory, [])
    recorded = experiment.recorded(entry.directory, [])
    return Shown(
        recording,
        {} if config is None else surroundings(config, say=session.warn),
        pictures,
        len(pictures),
        10.0 if config is None else config.frame_rate_hz,
        None if recorded is None else recorded.channel(1),
        scores={name: over_time(tracked) for name, tracked in run.trackers.items()},
    )


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
