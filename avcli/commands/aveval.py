"""aveval: score tracks against ground truth."""

import re
import shutil
import sys
from pathlib import Path

import click

from avcli.commands.filter import Filter, GateNotMet, common

_TRACKERS = ("audio", "video", "audio_video")


@click.command("aveval", cls=Filter)
@click.argument("paths", nargs=-1, metavar="GROUNDTRUTH TRACKS...")
@click.option(
    "--experiments",
    is_flag=True,
    help="The arguments are experiment directories: score their tracking/*_tracking.jsonl against their ground truth.",
)
@click.option(
    "--dims",
    type=click.Choice(["2", "3"]),
    default="2",
    show_default=True,
    help="2 scores x and y, 3 the height z too (ground truth lies on the floor).",
)
@click.option(
    "--d0",
    type=click.FloatRange(min=0, min_open=True),
    default=2.0,
    show_default=True,
    metavar="M",
    help="Distance in m at which the similarity 1 - d/d0 is zero; CLEAR and Identity match within half of it.",
)
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0),
    default=0.001,
    show_default=True,
    metavar="S",
    help="Records match whose times differ by no more than this, in s.",
)
@click.option(
    "--cutoff",
    type=click.FloatRange(min=0, min_open=True),
    metavar="M",
    help="Distance in m that a missed or false point is worth to OSPA and GOSPA.  [default: half of --d0]",
)
@click.option(
    "--order",
    type=click.FloatRange(min=1),
    default=1.0,
    show_default=True,
    metavar="P",
    help="Order of OSPA and GOSPA: 1 adds metres, more weighs large errors up.",
)
@click.option(
    "--window",
    type=click.IntRange(1),
    default=10,
    show_default=True,
    metavar="FRAMES",
    help="Length in frames of the window over which OSPA2 compares tracks.",
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["jsonl", "table", "csv", "markdown", "latex"]),
    help="What to write.  [default: table on a terminal, otherwise jsonl]",
)
@click.option("--compare-thesis", is_flag=True, help="Set the thesis's tables 5.6 to 5.10 beside s1 to s4.")
@click.option(
    "--fail-under",
    multiple=True,
    metavar="[TRACKER:]NAME=PERCENT",
    help="Exit 3 if a summary score of all sequences together is below this many percent; may be repeated.",
)
@common(experiment=False, skip_invalid=True)
def main(session, paths, experiments, dims, d0, tolerance, cutoff, order, window, kind, compare_thesis, fail_under):
    """Score tracks against ground truth: HOTA, CLEAR and identity as TrackEval does, and OSPA, GOSPA, errors, delays.

    Writes one metrics record for each sequence and tracker, and for each tracker one "combined" over all sequences
    (and, of several sequences, their plain "mean"). TRACKS may be -, standard input.
    """
    from avcli.metrics import table
    from avcli.metrics.score import combine, mean, score

    gates = [_gate(session, text, table.PERCENT) for text in fail_under]
    runs = _experiments(session, paths) if experiments else _files(session, paths)
    if kind is None:
        kind = "table" if session.output_path == "-" and sys.stdout.isatty() else "jsonl"
    records = []
    with session.output() as write:

        def emit(record: dict) -> None:
            records.append(record)
            if kind == "jsonl":
                write(record)

        for name, truth_path, tracks in runs:
            with session.timing("read"):
                truth = _recording(session, truth_path)
            if not any(len(identities) for _, identities, _ in truth):
                session.warn(f"{name}: the ground truth has no objects, so all that was tracked is false")
            for tracker, path in tracks:
                with session.timing("read"):
                    tracked = _recording(session, path)
                sequence = _align(session, f"{name} {tracker}", truth, tracked, int(dims), tolerance)
                with session.timing("score"):
                    emit({"sequence": name, "tracker": tracker, **score(sequence, d0, cutoff, order, window)})
        single = list(records)
        for tracker in dict.fromkeys(record["tracker"] for record in single):
            own = [record for record in single if record["tracker"] == tracker]
            blank = [record["sequence"] for record in own if not record["HOTA"]["HOTA_TP"].any()]
            if blank and len(own) > 1:
                session.warn(f"combined {tracker}: AssA and LocA leave out {', '.join(blank)}, where nothing matches")
            of = {"tracker": tracker, "sequences": [record["sequence"] for record in own]}
            emit({"sequence": "combined", "average": "micro", **of, **combine(own)})
            if len(own) > 1:
                emit({"sequence": "mean", "average": "macro", **of, "summary": mean(own)})
        if kind != "jsonl":
            width = shutil.get_terminal_size((120, 24)).columns if sys.stdout.isatty() else None
            write(table.render(records if len(runs) > 1 else single, kind, compare_thesis, width))
    _check(gates, [record for record in records if record["sequence"] == "combined"])


def _files(session, paths: tuple[str, ...]) -> list[tuple[str, str, list[tuple[str, str]]]]:
    """One run (sequence, ground truth, trackers by name and path) from GROUNDTRUTH TRACKS..."""
    if len(paths) < 2:
        session.usage("GROUNDTRUTH and at least one TRACKS are needed (- is standard input)")
    truth, *tracks = paths
    for path in paths:
        _must_exist(session, path)
    names = ["stdin" if path == "-" else Path(path).stem.removesuffix("_tracking") for path in tracks]
    if len(set(names)) < len(names):
        names = list(tracks)
    if len(set(names)) < len(names):
        session.usage("the same TRACKS are named twice")
    return [(_sequence_name(truth), truth, list(zip(names, tracks, strict=True)))]


def _experiments(session, directories: tuple[str, ...]) -> list[tuple[str, str, list[tuple[str, str]]]]:
    """The runs of several experiment directories, the thesis's three trackers first."""
    from avcli.experiment import Layout

    if not directories:
        session.usage("--experiments needs at least one experiment directory")
    runs = []
    for directory in directories:
        layout = Layout(Path(directory))
        _must_exist(session, str(layout.groundtruth))
        found = {path.stem.removesuffix("_tracking"): str(path) for path in layout.tracking.glob("*_tracking.jsonl")}
        if not found:
            session.usage(f"{layout.tracking}: no *_tracking.jsonl")
        order = [name for name in _TRACKERS if name in found] + sorted(set(found) - set(_TRACKERS))
        runs.append((_sequence_name(str(layout.groundtruth)), str(layout.groundtruth), [(n, found[n]) for n in order]))
    names = [name for name, _, _ in runs]
    if len(set(names)) < len(names):
        runs = [(directory, *run[1:]) for directory, run in zip(directories, runs, strict=True)]
    trackers = {name for _, _, tracks in runs for name, _ in tracks}
    for name, _, tracks in runs:
        missing = trackers - {tracker for tracker, _ in tracks}
        if missing:
            session.warn(f"{name} has no tracks of {', '.join(sorted(missing))}, so those combine fewer sequences")
    return runs


def _must_exist(session, path: str) -> None:
    if path != "-" and not Path(path).exists():
        session.usage(f"{path}: no such file or directory")


def _sequence_name(path: str) -> str:
    """The experiment's name where the file is an experiment's ground truth, otherwise the file's."""
    if path == "-":
        return "stdin"
    if Path(path).name == "groundtruth_sources.jsonl":
        return Path(path).resolve().parent.name
    return Path(path).stem


def _recording(session, path: str) -> list:
    """Time, identities and positions of each record of a file."""
    from avcli import records

    parsed = session.records([path], records.identified)
    return [(record.timestamp, record.ids, record.positions) for record in parsed]


def _align(session, name: str, truth: list, tracks: list, dims: int, tolerance: float):
    """The sequence of the two recordings; says what did not meet."""
    from avcli.metrics.sequence import align

    try:
        sequence, mismatch = align(truth, tracks, dims, tolerance, session.skip_invalid)
    except ValueError as error:
        session.fail(f"{name}: {error}")
    within = f"within {1000 * tolerance:g} ms"
    if not sequence.track.identity.size:
        session.warn(f"{name}: there are no tracks, so everybody is missed")
    elif mismatch.truth_frames:
        session.warn(
            f"{name}: {mismatch.truth_frames} of {len(truth)} ground-truth records have no track record {within}; "
            f"their {mismatch.truth_points} points count as missed"
        )
    if mismatch.track_frames:
        session.warn(
            f"{name}: {mismatch.track_frames} of {len(tracks)} track records have no ground truth {within}; "
            f"their {mismatch.track_points} points count as false"
        )
    for count, what in (
        (mismatch.unsorted, "records were out of order and have been sorted"),
        (mismatch.repeated, "records repeat a time; their points have been joined"),
        (mismatch.dropped, "points dropped, whose identity was there already at that time"),
    ):
        if count:
            session.warn(f"{name}: {count} {what}")
    if dims == 3 and abs(mismatch.height) > 0.25:
        session.warn(
            f"{name}: tracks are {mismatch.height:+.2f} m from the ground truth in height on average, as if they meant "
            "other points of a person; --dims 2 scores x and y alone"
        )
    return sequence


def _gate(session, text: str, names) -> tuple[str | None, str, float]:
    """Tracker (None: each), score and least percentage of a --fail-under."""
    found = re.fullmatch(r"(?:(.+):)?(\w+)=(-?\d+(?:\.\d+)?)%?", text)
    if not found or found[2] not in names:
        session.usage(f"--fail-under {text}: expected [TRACKER:]NAME=PERCENT, where NAME is one of {', '.join(names)}")
    return found[1], found[2], float(found[3])


def _check(gates: list, combined: list[dict]) -> None:
    """End with exit 3 where a gate is not met."""
    short = []
    for tracker, name, least in gates:
        concerned = [record for record in combined if tracker in (None, record["tracker"])]
        if not concerned:
            short.append(f"there are no tracks of {tracker}")
        values = [(record["tracker"], 100 * record["summary"][name]) for record in concerned]
        short += [f"{of}: {name} is {value:.2f}, under {least:g}" for of, value in values if value < least]
    if short:
        raise GateNotMet("; ".join(short))
