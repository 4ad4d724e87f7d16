"""aveval: score tracks against ground truth."""

import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import click

from avcli.commands.filter import Filter, GateNotMet, common

_TRACKERS = ("audio", "video", "audio_video")
_MOST_FRAMES = 150
"""Camera frames in a report; of a longer sequence every second, third ... one."""


@click.command("aveval", cls=Filter, epilog="Example: aveval out/s1/groundtruth_sources.jsonl tracks.jsonl")
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
    type=click.FloatRange(min=0, max=1e9, min_open=True),
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
    "--speaking",
    is_flag=True,
    help="Score people only while they speak; whoever tracks a silent one is neither right nor wrong.",
)
@click.option(
    "--cutoff",
    type=click.FloatRange(min=0, max=1e9, min_open=True),
    metavar="M",
    help="Distance in m that a missed or false point is worth to OSPA and GOSPA.  [default: half of --d0]",
)
@click.option(
    "--order",
    type=click.FloatRange(min=1, max=16),
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
@click.option(
    "--detections",
    multiple=True,
    metavar="FILE",
    help="Score a sensor's detections too; with --experiments a path inside each directory; may be repeated.",
)
@click.option(
    "--plot",
    type=click.Path(dir_okay=False),
    metavar="FILE",
    help="Draw each sequence to FILE.png, .svg or .pdf; of several sequences to FILE-NAME.png.",
)
@click.option(
    "--html",
    type=click.Path(dir_okay=False),
    metavar="FILE",
    help="Write a report: one page that needs nothing else, with tables, plots and a player.",
)
@click.option(
    "--mot",
    type=click.Path(file_okay=False),
    metavar="DIR",
    help="Write ground truth and tracks as MOTChallenge files and as TrackEval's folders.",
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0, min_open=True),
    default=10.0,
    show_default=True,
    metavar="HZ",
    help="Frames a second of MOTChallenge files (.txt or .csv) that are read.",
)
@common(skip_invalid=True, presets={"thesis": {"dims": "2", "d0": 2.0, "compare_thesis": True}})
def main(session, paths, experiments, kind, compare_thesis, fail_under, detections, plot, html, mot, **settings):
    """Score tracks against ground truth: HOTA, CLEAR and identity as TrackEval does, and OSPA, GOSPA, errors, delays.

    Writes one metrics record for each sequence and tracker, and for each tracker one "combined" over all sequences
    (and, of several sequences, their plain "mean"). TRACKS may be -, standard input.
    """
    from avcli.metrics import table

    if settings["speaking"] and compare_thesis:
        session.usage("the thesis scored silent people too: --speaking and --compare-thesis exclude each other")
    gates = [_gate(session, text, table.PERCENT) for text in fail_under]
    if plot and Path(plot).suffix.lower() not in (".png", ".svg", ".pdf"):
        session.usage(f"--plot {plot}: expected a name that ends in .png, .svg or .pdf")
    for path in filter(None, (plot, html)):
        if not Path(path).parent.is_dir():
            session.usage(f"{path}: its directory does not exist")
    inputs = _experiments(session, paths, detections) if experiments else _files(session, paths, detections)
    if kind is None:
        kind = "table" if session.output_path == "-" and sys.stdout.isatty() else "jsonl"
    records: list[dict] = []
    with session.output() as write:

        def emit(record: dict) -> None:
            records.append(record)
            if kind == "jsonl":
                write(record)

        runs = [
            _score(session, entry, settings, emit, pictures="html" if html else "plot" if plot else None)
            for entry in inputs
        ]
        _combine(session, records, emit)
        if kind != "jsonl":
            width = shutil.get_terminal_size((120, 24)).columns if sys.stdout.isatty() else None
            write(table.render(records, kind, compare_thesis, width))
    if plot:
        _plot(session, runs, Path(plot))
    if html:
        _report(session, runs, records, compare_thesis, Path(html))
    if mot:
        _write_mot(runs, Path(mot))
    _check(gates, [record for record in records if record["sequence"] == "combined" and "tracker" in record])


@dataclass(frozen=True)
class _Input:
    """What to read for one sequence: its name, files by name, and the experiment's directory if it has one."""

    name: str
    truth: str
    tracks: list[tuple[str, str]]
    detections: list[str]
    unscored: list[str]
    experiment: Path | None


def _files(session, paths: tuple[str, ...], detections: tuple[str, ...]) -> list[_Input]:
    """What GROUNDTRUTH TRACKS... name."""
    if len(paths) < 2:
        session.usage("GROUNDTRUTH and at least one TRACKS are needed (- is standard input)")
    truth, *tracks = paths
    for path in (*(tracks if "-" in tracks else paths), *detections):
        _must_exist(session, path)
    names = ["stdin" if path == "-" else Path(path).stem.removesuffix("_tracking") for path in tracks]
    if len(set(names)) < len(names):
        names = list(tracks)
    if len(set(names)) < len(names):
        session.usage("the same TRACKS are named twice")
    around = session.experiment if session.has_experiment else Path(truth).parent
    named = list(zip(names, tracks, strict=True))
    return [_Input(_sequence_name(truth), truth, named, list(detections), [], around)]


def _experiments(session, directories: tuple[str, ...], detections: tuple[str, ...]) -> list[_Input]:
    """What experiment directories hold, the thesis's three trackers first."""
    from avcli.formats.experiment import Layout

    if not directories:
        session.usage("--experiments needs at least one experiment directory")
    inputs = []
    for directory in directories:
        layout = Layout(Path(directory))
        _must_exist(session, str(layout.groundtruth))
        found = {path.stem.removesuffix("_tracking"): str(path) for path in layout.tracking.glob("*_tracking.jsonl")}
        if not found:
            session.usage(f"{layout.tracking}: no *_tracking.jsonl")
        order = [name for name in _TRACKERS if name in found] + sorted(set(found) - set(_TRACKERS))
        scored = [str(layout.directory / path) for path in detections]
        for path in scored:
            _must_exist(session, path)
        lying = sorted(map(str, layout.localization.glob("*_localizations.jsonl")))
        name = _sequence_name(str(layout.groundtruth))
        tracks = [(tracker, found[tracker]) for tracker in order]
        unscored = [path for path in lying if path not in scored]
        inputs.append(_Input(name, str(layout.groundtruth), tracks, scored, unscored, layout.directory))
    if len({entry.name for entry in inputs}) < len(inputs):
        inputs = [replace(entry, name=directory) for entry, directory in zip(inputs, directories, strict=True)]
    trackers = {tracker for entry in inputs for tracker, _ in entry.tracks}
    for entry in inputs:
        missing = trackers - {tracker for tracker, _ in entry.tracks}
        if missing:
            session.warn(f"{entry.name} has no tracks of {', '.join(sorted(missing))}: those combine fewer sequences")
    return inputs


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


# --- scoring ----------------------------------------------------------------------------------------------------------


def _score(session, entry: _Input, settings: dict, emit: Callable[[dict], None], pictures: str | None):
    """Score one sequence's tracks and detections, and give back all that there is to draw of it (metrics.run.Run)."""
    from avcli.metrics.run import Run, Tracked
    from avcli.metrics.score import score

    with session.timing("read"):
        # A pipeline that ends here may still be writing the ground truth: it is whole when the tracks have ended.
        piped = {path: _identified(session, path, settings["rate"]) for _, path in entry.tracks if path == "-"}
        truth = _identified(session, entry.truth, settings["rate"])
    if not any(len(identities) for _, identities, _ in truth.recording):
        session.warn(f"{entry.name}: the ground truth has no objects, so all that was tracked is false")
    distances = {name: settings[name] for name in ("d0", "cutoff", "order", "window")}
    people = {"people": "speaking"} if settings["speaking"] else {}
    trackers, sensors = {}, {}
    for name, path in entry.tracks:
        with session.timing("read"):
            tracks = piped.get(path) or _identified(session, path, settings["rate"])
        sequence = _aligned(session, f"{entry.name} {name}", truth.recording, tracks.recording, settings)
        sequence = truth.speakers_of(session, sequence, settings)
        with session.timing("score"):
            record = {"sequence": entry.name, "tracker": name, **people, **score(sequence, **distances)}
        emit(record)
        trackers[name] = Tracked(sequence, record, tracks.speaking_of(sequence.track, sequence.time))
    first = next(iter(trackers.values())).sequence
    speaking = truth.speaking_of(first.truth, first.time)
    for path in (*entry.detections, *(entry.unscored if pictures else ())):
        for name, found in _detected(session, entry, path, truth, speaking, settings).items():
            name = f"{name} of {Path(path).name}" if name in sensors else name
            sensors[name] = found
            if path in entry.detections:
                emit({"sequence": entry.name, "sensor": name, **people, "Detections": found.record})
    run = Run(entry.name, trackers, sensors, speaking, settings["d0"])
    return _with_surroundings(session, entry, run, pictures == "html") if pictures else run


@dataclass(frozen=True)
class _Identified:
    """A file of ground truth or tracks: its recording; by time and identity who speaks how surely; where mouths are."""

    recording: list
    speaking: dict[tuple[float, int], float]
    mouths: list | None

    def speaking_of(self, points, time):
        """The probability (n,) for each of the points of a sequence, NaN where it is not said."""
        import numpy as np

        keys = zip(time[points.frame].tolist(), points.label[points.identity].tolist(), strict=True)
        return np.array([self.speaking.get(key, np.nan) for key in keys])

    def speakers_of(self, session, sequence, settings: dict):
        """With --speaking the sequence with those alone of its true points that speak."""
        import numpy as np

        from avcli.metrics.ignore import ignore

        if not settings["speaking"]:
            return sequence
        speaking = self.speaking_of(sequence.truth, sequence.time)
        if np.isnan(speaking).any():
            session.fail('--speaking: the ground truth does not say of everybody who is "speaking"')
        return ignore(sequence, speaking < 0.5, settings["d0"])


def _identified(session, path: str, rate: float) -> _Identified:
    """Read a file of ground truth or tracks: JSON Lines, or MOTChallenge's rows in a .txt or .csv."""
    import numpy as np

    from avcli.formats import records
    from avcli.metrics import mot

    if Path(path).suffix.lower() in (".txt", ".csv"):
        try:
            with session.open(path) as stream:
                return _Identified(mot.read(stream.read().decode(), rate), {}, None)
        except ValueError as error:
            session.fail(f"{path}: {error}")

    def parse(record: dict, bad: Callable):
        found = records.identified(record, bad)
        # Bad objects have been dropped from `found`, so that its identities, not its places, lead back to the objects.
        by_identity = {}
        for item in record["objects"]:
            if isinstance(item, dict) and type(item.get("object_id")) is int:
                by_identity.setdefault(item["object_id"], item)
        return found, [by_identity[identity] for identity in found.ids.tolist()]

    recording, mouths, speaking = [], [], {}
    for found, items in session.records([path], parse):
        recording.append((found.timestamp, found.ids, found.positions))
        mouths.append((found.timestamp, found.ids, np.array([_mouth(item) for item in items]).reshape(-1, 3)))
        for identity, item in zip(found.ids.tolist(), items, strict=True):
            value = item.get("speaking")
            if isinstance(value, bool | int | float) and 0 <= value <= 1:
                speaking.setdefault((found.timestamp, identity), float(value))
    known = all(np.isfinite(position).all() for _, _, position in mouths)
    return _Identified(recording, speaking, mouths if known else None)


def _mouth(item: dict) -> list[float]:
    value = item.get("mouth_position")
    good = isinstance(value, list) and len(value) == 3 and all(isinstance(number, int | float) for number in value)
    return value if good else [float("nan")] * 3


def _aligned(session, name: str, truth: list, tracks: list, settings: dict):
    """The sequence of the two recordings; says what did not meet."""
    from avcli.metrics.sequence import align

    dims, tolerance = int(settings["dims"]), settings["tolerance"]
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


def _detected(session, entry: _Input, path: str, truth: _Identified, speaking, settings: dict) -> dict:
    """The detections in a file by sensor (metrics.run.Detected), scored; a detection's identity is its number.

    Sound comes from mouths, so a sensor named audio is compared with them where the ground truth says where they are.
    """
    import numpy as np

    from avcli.formats import records
    from avcli.metrics import detections
    from avcli.metrics.run import Detected
    from avcli.metrics.sequence import align

    dims = int(settings["dims"])
    stem = Path(path).stem.removesuffix("_localizations")

    def parse(record: dict, bad: Callable):
        found = records.detections(record, bad)
        boxes = [item.get("bbox_px") if isinstance(item, dict) else None for item in record["objects"]]
        return found, boxes if len(boxes) == len(found) else [None] * len(found)

    by_sensor: dict[str, list] = {}
    for found, boxes in session.records([path], parse):
        by_sensor.setdefault(found.sensor or stem, []).append((found, boxes))
    result = {}
    for name, found in by_sensor.items():
        recording, total = [], 0
        for detected, _ in found:
            recording.append((detected.timestamp, np.arange(total, total + len(detected)), detected.positions))
            total += len(detected)
        covariances = np.concatenate([detected.covariances for detected, _ in found])[:, :dims, :dims]
        reference = truth.mouths if name == "audio" and truth.mouths else truth.recording
        boxes = np.array([_box(box) for _, row in found for box in row]).reshape(-1, 4)
        try:
            sequence, mismatch = align(reference, recording, dims, settings["tolerance"], session.skip_invalid)
        except ValueError as error:
            session.fail(f"{path}: {name}: {error}")
        if mismatch.track_frames:
            session.warn(
                f"{entry.name} {name}: {mismatch.track_frames} of {len(found)} detection records have no ground truth "
                f"within {1000 * settings['tolerance']:g} ms; their {mismatch.track_points} detections count as false"
            )
        sequence = truth.speakers_of(session, sequence, settings)
        order = sequence.track.label[sequence.track.identity]
        matches = detections.match(sequence, settings["d0"] / 2)
        known = None if np.isnan(speaking).any() or not speaking.size else speaking > 0.5
        scores = detections.score(sequence, matches, covariances[order], known)
        scores["Reference"] = "body" if reference is truth.recording else "mouth"
        result[name] = Detected(sequence, matches, scores, boxes[order])
    return result


def _box(value) -> list[float]:
    good = isinstance(value, list) and len(value) == 4 and all(isinstance(number, int | float) for number in value)
    return value if good else [float("nan")] * 4


def _combine(session, records: list[dict], emit: Callable[[dict], None]) -> None:
    """Add what all sequences together come to, for each tracker and sensor."""
    from avcli.metrics import detections
    from avcli.metrics.score import combine, mean

    single = list(records)
    for tracker in dict.fromkeys(record["tracker"] for record in single if "tracker" in record):
        own = [record for record in single if record.get("tracker") == tracker]
        blank = [record["sequence"] for record in own if not record["HOTA"]["HOTA_TP"].any()]
        if blank and len(own) > 1:
            session.warn(f"combined {tracker}: AssA and LocA leave out {', '.join(blank)}, where nothing matches")
        of = {"tracker": tracker, **_people(own), "sequences": [record["sequence"] for record in own]}
        emit({"sequence": "combined", "average": "micro", **of, **combine(own)})
        if len(own) > 1:
            emit({"sequence": "mean", "average": "macro", **of, "summary": mean(own)})
    for sensor in dict.fromkeys(record["sensor"] for record in single if "sensor" in record):
        own = [record for record in single if record.get("sensor") == sensor]
        of = {"sensor": sensor, **_people(own), "sequences": [record["sequence"] for record in own]}
        scores = detections.combine([record["Detections"] for record in own])
        emit({"sequence": "combined", "average": "micro", **of, "Detections": scores})


def _people(records: list[dict]) -> dict:
    return {"people": records[0]["people"]} if "people" in records[0] else {}


# --- pictures and other files -----------------------------------------------------------------------------------------


def _with_surroundings(session, entry: _Input, run, frames: bool):
    """The run with its room, microphones and camera, as far as there is a config.json that says them."""
    import numpy as np

    from avcli.formats.experiment import ConfigError, read_config

    try:
        config = session.config if session.has_config else read_config(entry.experiment / "config.json")
    except FileNotFoundError:
        return run
    known = {}
    try:
        known["room"] = np.asarray(config.room.dimensions[:2], dtype=float)
        known["microphones"] = np.asarray(config.microphones.positions[:, :2], dtype=float)
        known["camera"] = np.asarray(config.camera.T_room_camera[:2, 3], dtype=float)
        known["frame_size"] = (config.camera.width_px, config.camera.height_px)
    except ConfigError as error:
        session.warn(f"pictures of {entry.name} show less: {error}")
    if frames:
        with session.timing("camera frames"):
            known["frames"] = _frames(session, entry.experiment, sorted(set(run.truth_time.tolist())))
    return replace(run, **known)


def _plot(session, runs: list, path: Path) -> None:
    from avcli.formats.atomic import write_bytes
    from avcli.metrics.plots import plot

    for run in runs:
        name = re.sub(r"[^\w.-]+", "-", run.name).strip("-")
        target = path if len(runs) == 1 else path.with_name(f"{path.stem}-{name}{path.suffix}")
        with session.timing("plot"):
            content = plot(run, path.suffix.lower()[1:])
        write_bytes(target, content)


def _report(session, runs: list, records: list[dict], compare: bool, path: Path) -> None:
    from avcli.formats.atomic import write_bytes
    from avcli.metrics.report import report

    with session.timing("report"):
        text = report(runs, records, compare)
    write_bytes(path, text.encode())


def _frames(session, directory: Path, times: list[float]) -> dict[float, bytes]:
    """Small JPEGs of the camera frames of an experiment, at most so many that the report stays light."""
    from avcli.formats.experiment import Layout
    from avcli.formats.media import MediaError, read_rgb
    from avcli.metrics.report import thumbnail

    there = [time for time in times if (directory / Layout.rgb(time)).is_file()]
    chosen = there[:: -(-len(there) // _MOST_FRAMES) or 1]
    frames = {}
    for time in chosen:
        path = directory / Layout.rgb(time)
        try:
            frames[time] = thumbnail(read_rgb(path))
        except MediaError as error:
            session.warn(f"the report goes without a camera frame: {error}", "a camera frame that cannot be read")
    return frames


def _write_mot(runs: list, directory: Path) -> None:
    from avcli.formats.atomic import write_bytes
    from avcli.metrics import mot

    sequences = {run.name: {name: tracked.sequence for name, tracked in run.trackers.items()} for run in runs}
    for name, text in mot.write(sequences).items():
        path = directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, text.encode())


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
