"""avview: look at a run, live or afterwards."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from avcli.commands.filter import Filter, Session, common
from avcli.commands.options import FiniteRange, WholeRange

if TYPE_CHECKING:
    import numpy as np

    from avcli.formats.experiment import Camera, Config
    from avcli.formats.media import AudioForm
    from avcli.formats.records import Identified
    from avcli.localization.beam import Beams
    from avcli.view.experiment import Recorded
    from avcli.view.live import Heard, Live
    from avcli.view.page import Shown
    from avcli.view.recording import Recording
    from avcli.view.sound import Beam

_FILE: dict[str, Any] = {"type": click.Path(dir_okay=False), "metavar": "FILE"}
_SHORTEST_BEAM_S, _LONGEST_BEAMS_S = 1.0, 1200.0
"""Beams are made of tracks that last longer, if they do not last longer than this in all."""
_AROUND_S = 3.0
"""So much of a path before and after a piece of sound is known to the beam of a live page."""
_BEAM = "the beam at track {}"
_LYING: dict[str, Any] = {"type": click.Path(exists=True, dir_okay=False), "metavar": "FILE"}


@dataclass
class Options:
    """What the user asked for, beside what to show."""

    truth: tuple[str, ...]
    film: str | None
    sound: str | None
    microphone: int
    beam: tuple[str, ...]
    start: float
    sensor: str | None
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
    type=FiniteRange(0),
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
    type=WholeRange(1),
    metavar="N",
    default=1,
    show_default=True,
    help="Play and draw the sound of this microphone.",
)
@click.option(
    "--beam",
    multiple=True,
    metavar="ID",
    help="Listen to the place of this track with all microphones. --mp4 plays that sound; --html offers it beside the "
    "others. May be repeated; the word none: no such sound. By default --html has that of each track of the tracker "
    "that is shown first.",
)
@click.option(
    "--start",
    type=FiniteRange(),
    metavar="S",
    default=0.0,
    show_default=True,
    help="Time at which film and sound begin.",
)
@click.option(
    "--sensor",
    metavar="NAME",
    help="The camera that took the pictures, where config.json has several; by default the main one, or the only one.",
)
@click.option("--learnt", **_LYING, help="Show where people leave, from a file that avfuse --learn wrote.")
@click.option("--scenario", metavar="NAME|FILE", help="Draw the furniture of this scenario on the map.")
@click.option("--mp4", **_FILE, help="Write a film with sound: the picture beside the map. One run only.")
@click.option("--rrd", **_FILE, help="Write the run for the Rerun viewer; needs the extra avcli[rerun]. One run only.")
@click.option(
    "--serve", is_flag=True, help="Serve a page on this machine that follows the run; Ctrl-C ends it. One run only."
)
@click.option(
    "--port",
    type=WholeRange(0, 65535),
    metavar="N",
    default=8008,
    show_default=True,
    help="Port of --serve; 0 is any that is free.",
)
@common(skip_invalid=True, media=True, output=False)
def main(
    session: Session,
    paths: tuple[str, ...],
    html: str | None,
    largest_mb: float,
    mp4: str | None,
    rrd: str | None,
    serve: bool,
    port: int,
    **values: Any,
) -> None:
    """Look at a run: tracks, truth, detections and sound in the camera's picture and on a map, on one clock.

    FILE is any mixture of records: ground truth, detections, tracks, audio. DIR is an experiment directory, of which
    everything is shown. Records that come from standard input are passed on to standard output.
    """
    options = Options(**values)
    if not (html or mp4 or rrd or serve):
        session.usage("nothing to do: give --html FILE, --mp4 FILE, --rrd FILE or --serve")
    runs = list(_runs(session, paths, options))
    lying = [*options.truth, options.film, options.sound, options.learnt, options.scenario]
    lying += [str(file) for run in runs for file in (*run.files, run.config_path) if file]
    session.check_outputs({"--html": html, "--mp4": mp4, "--rrd": rrd}, [*paths, *filter(None, lying)])
    if (serve or mp4 or rrd) and len(runs) > 1:
        session.usage("--serve, --mp4 and --rrd show one run; --html shows several")
    if mp4 and len(options.beam) > 1:
        session.usage("--mp4 plays the beam at one track; give one --beam")
    if options.film and sum(map(bool, (html, mp4, rrd))) > 1:
        session.usage("a --film can be read once: give one of --html, --mp4 and --rrd")
    if options.start and not (options.film or options.sound):
        session.usage("--start has no effect without --film or --sound; records state their own times")
    with contextlib.ExitStack() as stack:
        watch = partial(_serve, session, stack, port) if serve else None
        shown = [_shown(session, run, options, watch, bool(html)) for run in runs]
        if html:
            _write_page(session, Path(html), shown, largest_mb)
        if mp4:
            from avcli.view import film

            with session.timing("film"):
                heard = shown[0].beams[0].track if options.beam and shown[0].beams else shown[0].track
                film.save(Path(mp4), shown[0], heard, _camera(session, runs[0], options), session.warn)
        if rrd:
            from avcli.view import rerun

            with session.timing("Rerun"):
                rerun.save(Path(rrd), shown[0])
        if serve:
            sys.stdout.buffer.flush()
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # whoever reads our output can end
            threading.Event().wait()


def _serve(session: Session, stack: contextlib.ExitStack, port: int, shown: Shown) -> Live:
    from avcli.view.live import Live
    from avcli.view.page import Words

    live = Live(shown, Words(shown.recording.name))
    try:
        stack.enter_context(live.serving(port))
    except OSError as error:
        session.usage(f"--port {port}: {(error.strerror or str(error)).lower()}")
    session.warn(f"open {live.url}; Ctrl-C ends it")
    return live


def _write_page(session: Session, path: Path, shown: list[Shown], largest_mb: float) -> None:
    from avcli.metrics.hota import ALPHA
    from avcli.view import page

    with session.timing("page"):
        alpha = [round(alpha, 2) for alpha in ALPHA.tolist()]
        words = page.Words(", ".join(one.recording.name for one in shown), alpha=alpha)
        folder = page.save(path, shown, words, session.warn, largest_mb)
    if folder is not None:
        session.warn(f"{path} needs the folder {folder} beside it: in one file it would be over {largest_mb:g} MB")


def _runs(session: Session, paths: tuple[str, ...], options: Options) -> Iterator[Run]:
    """Sort what the user named into runs: one for each directory, and one for all files."""
    from avcli.formats.experiment import Layout
    from avcli.formats.records import printable

    config = session.config_path if session.has_config else None
    directories = [path for path in paths if path != "-" and Path(path).is_dir()]
    for path in directories:
        layout = Layout(Path(path))
        lying = [layout.groundtruth, Path(path) / "audio.jsonl"]
        lying = [file for file in lying if file.is_file()]
        lying += sorted(layout.localization.glob("*.jsonl"))
        # Tracks of several sensors, whose names are the longest, stand last and are shown first.
        lying += sorted(layout.tracking.glob("*.jsonl"), key=lambda path: (len(path.name), path.name))
        if not lying:
            session.usage(f"{path}: no records lie in this directory")
        name = Path(path).resolve().name
        yield Run(printable(name), Path(path), [str(file) for file in lying], config or layout.config)
    named = [path for path in paths if path not in directories]
    if named or not directories:
        root = session.media_root
        name = root.resolve().name if session.has_experiment else Path(named[0]).stem if named else "stdin"
        yield Run(printable(name), root, [*options.truth, *named] or ["-"], config)


def _config(session: Session, run: Run) -> Config | None:
    from avcli.formats.experiment import read_config

    if run.config_path is None:
        return None
    try:
        return session.config if session.has_config else read_config(run.config_path)
    except FileNotFoundError:
        session.warn(f"{run.config_path}: no such file; the page has no map of the room and no picture")
        return None


def _camera(session: Session, run: Run, options: Options) -> Camera | None:
    """The camera that took the pictures, where its place is known."""
    config = _config(session, run)
    camera = None if config is None else config.placed_camera(options.sensor)
    if config is not None and camera is None and options.sensor is not None:
        session.usage(f"--sensor {options.sensor}: {config.name} has no camera of this name whose place it says")
    return camera


def _shown(
    session: Session, run: Run, options: Options, watch: Callable[[Shown], Live] | None, listening: bool
) -> Shown:
    """Read a run, and show it while it is read where somebody watches; listen at its tracks if that is wanted."""
    from avcli.formats import footage
    from avcli.view import experiment
    from avcli.view.page import Shown
    from avcli.view.recording import Recording

    recording = Recording(run.name, outside=session.allow_outside)
    shown = Shown(recording)
    live: Live | None = None
    begun = False

    def take(source: str, stated: str | None, record: Mapping[str, Any], bad: Any) -> None:
        nonlocal live, begun
        if not begun:  # a pipeline that ends here writes config.json before its first record
            begun = True
            _surround(session, run, options, shown)
            live = watch and watch(shown)
            if live is not None:
                live.follow(_heard(session, run, options, recording))
        add = partial(recording.add, record, source, bad, stated)
        if live is None:
            add()
            return
        before = len(recording.frames)
        live.tell(add)
        live.tell(list, experiment.frames(run.root, recording.frames[before:], lying=False))

    _read(session, run, options, take)
    if not begun:
        session.warn("there are no records to show")
        _surround(session, run, options, shown)
        live = watch and watch(shown)
    if live is not None:
        live.end()
    with session.timing("pictures"):
        if options.film:
            found = experiment.film(options.film, shown.rate_hz, options.start, session.warn)
            shown.pictures, shown.picture_count = found
            shown.film = Path(options.film), options.start
            rate = footage.rate_taken(options.film, shown.rate_hz)
            _say_if_apart(session, "film", options.start, shown.picture_count / rate if rate else 0.0, recording)
        else:
            frames = experiment.frames(run.root, recording.frames)
            shown.pictures, shown.picture_count = frames, len(frames)
        if shown.surroundings and (camera := _camera(session, run, options)):
            checked = experiment.of_size((camera.width_px, camera.height_px), session.warn)
            read = ((time, checked(picture)) for time, picture in shown.pictures)
            shown.pictures = read if options.film else list(read)
        elif shown.surroundings and shown.picture_count:
            session.warn(
                "nothing is drawn into the pictures: config.json has no camera_config that says where the camera is "
                'or several under "sensors", of which --sensor names one'
            )
    with session.timing("sound"):
        if options.sound:
            played = experiment.Recorded([(options.start, Path(options.sound))])
            _say_if_apart(session, "sound", options.start, played.length / played.rate_hz, recording)
            recorded: Recorded | None = played
        else:
            recorded = experiment.recorded(run.root, recording.chunks)
        unheard = [f"--beam {one}" for one in options.beam if one != "none"]
        unheard += [f"--microphone {options.microphone}"] * (options.microphone != 1)
        if recorded is None and unheard:
            session.usage(f"{unheard[0]}: there is no sound; -C names the experiment that has it, --sound a file")
        shown.track = None if recorded is None else recorded.channel(options.microphone)
    with session.timing("beams"):
        if recorded and (listening or options.beam):
            shown.beams = _beams(session, run, options, recording, recorded)
    with session.timing("score"):
        shown.scores = _scores(recording)
    return shown


def _say_if_apart(session: Session, what: str, begin: float, seconds: float, recording: Recording) -> None:
    """Say so if a film or a sound has no time in common with the records."""
    times = [row[0] for stream in recording.streams for row in (stream.rows[0], stream.rows[-1])]
    if times and seconds and (begin > max(times) or begin + seconds < min(times)):
        session.warn(
            f"the {what} is from {begin:.1f} to {begin + seconds:.1f} s, but the records are from {min(times):.1f} to "
            f"{max(times):.1f} s: is --start right?"
        )


def _beams(session: Session, run: Run, options: Options, recording: Recording, recorded: Recorded) -> list[Beam]:
    """Listen at each track that the user wants to hear."""
    listener = _listener(session, run, options, recording, recorded)
    if listener is None:
        return []
    from avcli.view.sound import Beam, Spool, Track, loudest

    tracker, beams = listener
    rate, ends = beams.rate_hz, beams.names
    wanted = {str(name): name for name in ends}
    missing = [name for name in options.beam if name not in wanted]
    if missing:
        session.usage(f"--beam {missing[0]}: {tracker} has no such track; it has {', '.join(wanted) or 'none'}")
    chosen = [wanted[name] for name in options.beam] or [
        name for name, (begin, end) in ends.items() if end - begin >= _SHORTEST_BEAM_S
    ]
    lasting = sum(ends[name][1] - ends[name][0] for name in chosen)
    if not options.beam and lasting > _LONGEST_BEAMS_S:
        session.warn(f"no beams: the tracks last {lasting / 60:.0f} min in all; choose some with --beam ID")
        return []
    length = recorded.length * rate // recorded.rate_hz
    places = {name: [min(max(0, round(end * rate)), length) for end in ends[name]] for name in chosen}
    spools = {name: Spool(last - first) for name, (first, last) in places.items() if last > first}
    for start, heard in beams.blocks(length, list(spools)):
        for name, samples in heard.items():
            first, last = places[name]
            begin, end = max(first, start), min(last, start + len(samples))
            if begin < end:
                spools[name].samples[begin - first : end - first] = samples[begin - start : end - start]
    full = max((loudest(spool.samples) for spool in spools.values()), default=0.0)  # who is silent stays silent
    starts = {name: recorded.start_s + first / rate for name, (first, _) in places.items()}
    return [
        Beam(tracker, name, Track(_BEAM.format(name), starts[name], rate, spool.samples, full))
        for name, spool in spools.items()
    ]


def _time(people: Identified) -> float:
    return people.timestamp


def _heard(session: Session, run: Run, options: Options, recording: Recording) -> Heard:
    """The sound of a run that goes on: of the file that is named, or of the records that have come."""
    from avcli.view.experiment import Recorded, recorded
    from avcli.view.live import Heard

    known: dict[Path, AudioForm] = {}

    def now() -> Recorded | None:
        if options.sound:
            return Recorded([(options.start, Path(options.sound))], growing=True)
        return recorded(run.root, list(recording.chunks), known)

    def beam(identity: str, begin: float, end: float) -> tuple[np.ndarray, int]:
        import numpy as np

        sound = now()
        anyone = dataclasses.replace(options, beam=())
        around = begin - _AROUND_S, end + _AROUND_S
        listener = sound and _listener(session, run, anyone, recording, sound, around)
        if not listener or sound is None:
            raise ValueError("there is no array to listen with")
        beams = listener[1]
        name = next((name for name in beams.names if str(name) == identity), None)
        first, last = (round((time - sound.start_s) * beams.rate_hz) for time in (begin, end))
        heard = beams.hear(first, last, [name])
        return heard.get(name, np.zeros(last - first, np.float32)), beams.rate_hz

    return Heard(now, options.microphone, None if "none" in options.beam else beam)


def _listener(
    session: Session,
    run: Run,
    options: Options,
    recording: Recording,
    recorded: Recorded,
    between: tuple[float, float] = (-inf, inf),
) -> tuple[str, Beams] | None:
    """The name of the tracker that is shown first, and what listens at its tracks; None if nothing can."""
    from avcli.view.recording import TRACKS

    trackers = [name for kind, name in recording.people if kind == TRACKS]
    why = "there are no tracks"
    if trackers and "none" not in options.beam:
        from avcli.localization.beam import Beams

        config = _config(session, run)
        why = "config.json does not say where the microphones are"
        if config is not None and "microphone_config" in config.raw:
            many = len(config.microphones.positions)
            why = f"the sound has {recorded.channels} channels, and config.json {many} microphones"
            if many == recorded.channels > 1:
                tracks = recording.people[TRACKS, trackers[-1]]
                people = sorted((one for one in tracks if between[0] <= one.timestamp <= between[1]), key=_time)
                beams = Beams.of(config, people, recorded.start_s, recorded.rate_hz, recorded.read)
                return trackers[-1], beams
    if options.beam and options.beam != ("none",):
        session.usage(f"--beam {options.beam[0]}: {why}")
    return None


def _surround(session: Session, run: Run, options: Options, shown: Shown) -> None:
    """Add what config.json says of the room."""
    from avcli.view.surroundings import surroundings

    config = _config(session, run)
    if config is None:
        return
    shown.recording.sensors = config.sensors
    shown.rate_hz = config.frame_rate_hz
    learnt = _learnt(session, options)
    shown.surroundings = surroundings(
        config, _furniture(session, options.scenario), learnt, options.sensor, session.warn
    )


def _read(session: Session, run: Run, options: Options, take: Callable[..., None]) -> None:
    """Read all records; named files come first, standard input last."""
    from avcli.formats.records import printable
    from avcli.view.recording import TRUTH

    for path in sorted(run.files, key=lambda path: path == "-"):
        source = "tracks" if path == "-" else printable(Path(path).stem.removesuffix("_tracking"))
        parse = partial(take, source, TRUTH if path in options.truth else None)
        if path == "-":
            records = session.stream_records(_Tee(session.open(path)), "<stdin>", parse)  # type: ignore[arg-type]
        else:
            records = session.records([path], parse)
        with session.timing("read"):
            for _ in records:
                pass


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
