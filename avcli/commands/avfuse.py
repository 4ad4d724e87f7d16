"""avfuse: fuse localizations of several sensors into tracks."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from avcli.commands.filter import Failure, Filter, Killed, Session, common, unbroken
from avcli.commands.options import from_settings, refuse_without_effect, settings_from, was_given
from avcli.settings import settings_of
from avcli.tracking.settings import SENSORS, TRACKERS, Settings

if TYPE_CHECKING:
    from avcli.formats.arrivals import Arrivals
    from avcli.formats.records import Detections
    from avcli.tracking.fusion import Fusion
    from avcli.tracking.merging import Event, Merger

_THESIS = {
    "motion": "cv",
    "process_noise": 0.15,
    "birth": "adaptive",
    "no_learn": True,
    "stay": 10.0,
    "doors": "anywhere",
    "sigma": ["camera=0.2,0.2,0", "microphones=0.25,0.25,0"],
    "detection": ["camera=0.5", "microphones=0.25"],
    "clutter": ["camera=0.01", "microphones=0.01"],
    "hidden": False,
    "room_margin": 0.0,
}


class _Lag(click.ParamType):
    """A number of steps, or "inf"."""

    name = "steps"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if value in ("inf", math.inf):
            return math.inf
        return click.IntRange(0).convert(value, param, ctx)


class _ForSensor(click.ParamType):
    """NAME=VALUE: something of one sensor, or of all of a kind."""

    name = "name=value"

    def __init__(self, convert: Callable[[str], Any], wanted: str) -> None:
        self.convert_value, self.wanted = convert, wanted

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, Any]:
        if isinstance(value, tuple):
            return value
        name, equals, text = value.partition("=")
        try:
            if not (name and equals and text):
                raise ValueError
            return name, self.convert_value(text)
        except ValueError:
            self.fail(f"{value!r} is not {self.wanted}", param, ctx)


def _sigma(text: str) -> tuple[float, float]:
    numbers = [_number(part) for part in text.split(",")]
    if len(numbers) > 3:
        raise ValueError
    return numbers[0], numbers[min(1, len(numbers) - 1)]


def _number(text: str, most: float = math.inf) -> float:
    number = float(text)
    if not (0 <= number <= most and number < math.inf):
        raise ValueError
    return number


def _usual(field: str) -> str:
    """What --help says of the default of a sensor's field."""
    values = {kind: getattr(one, field) for kind, one in SENSORS.items()}
    return "[default: " + ", ".join(f"{k} {v[0] if isinstance(v, tuple) else v:g}" for k, v in values.items()) + "]"


@click.command("avfuse", cls=Filter, epilog="Example: avfuse -C out/s1 a.jsonl v.jsonl -o tracks.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--sensor",
    "named",
    multiple=True,
    type=_ForSensor(str, "NAME=FILE"),
    metavar="NAME=FILE",
    help="Also read FILE; its records are of sensor NAME unless they state another.  Can be repeated.",
)
@click.option(
    "--live",
    is_flag=True,
    help="Write each record at once; do not wait for a sensor that is quiet for --max-wait by the wall clock.",
)
@click.option(
    "--tracker",
    type=click.Choice(list(TRACKERS)),
    default=next(iter(TRACKERS)),
    show_default=True,
    help="How detections are assigned to people. "
    + "; ".join(f"{name}: {one.text}" for name, one in TRACKERS.items())
    + ".",
)
@click.option(
    "--lag",
    type=_Lag(),
    metavar="N|inf",
    default="0",
    show_default=True,
    help="Delay each output by N steps and smooth it with what came since; inf: output at the end.",
)
@from_settings(Settings)
@click.option(
    "--sigma",
    multiple=True,
    type=_ForSensor(_sigma, "NAME=M[,M[,M]]"),
    metavar="NAME=M[,M[,M]]",
    help="Noise in m of x, y and z for detections without a covariance; 0: not observed.  NAME is a sensor's name or a "
    "kind: camera, microphones.  " + _usual("sigma"),
)
@click.option(
    "--detection",
    multiple=True,
    type=_ForSensor(lambda text: _number(text, 1.0), "NAME=P"),
    metavar="NAME=P",
    help="Probability that a sensor detects a person who is not hidden from it.  " + _usual("detection"),
)
@click.option(
    "--clutter",
    multiple=True,
    type=_ForSensor(_number, "NAME=N"),
    metavar="NAME=N",
    help="Expected number of false detections in one record of a sensor.  " + _usual("clutter"),
)
@click.option(
    "--learn",
    type=click.Path(dir_okay=False, writable=True),
    metavar="FILE",
    help="Keep what is learnt of the room and its sensors in FILE. It is read at the start, if it exists, and written "
    "at the end.",
)
@click.option("--no-learn", is_flag=True, help="Learn nothing from the run: all rates stay as they were given.")
@click.option(
    "--map",
    type=click.Path(dir_okay=False, writable=True),
    metavar="FILE.png",
    help="Also draw to FILE what was learnt: where people come, where they leave, and what is known of each sensor.",
)
@click.option(
    "--explain",
    type=click.Path(dir_okay=False, writable=True),
    metavar="FILE",
    help="Also write to FILE how each record was used: hypotheses, associations, births and deaths of tracks.",
)
@common(skip_invalid=True, mark_end=True, presets={"thesis": _THESIS})
def main(
    session: Session,
    files: tuple[str, ...],
    named: tuple[tuple[str, str], ...],
    live: bool,
    tracker: str,
    lag: float,
    learn: str | None,
    no_learn: bool,
    map: str | None,
    explain: str | None,
    **options: Any,
) -> None:
    """Fuse localizations of any sensors, merged in one stream or one file per sensor, into labelled tracks.

    Reads one record for each time a sensor looked. Writes one record of tracks for each step of a regular clock, as
    soon as every sensor has passed it. Tracks are points on the floor, with velocity, covariance, probability of
    existence and, where there are microphones, the probability that the person is speaking.
    """
    settings = settings_from(Settings, options | {"learn": not no_learn})
    _refuse(tracker, lag, settings, session.has_config)
    given: dict[str, dict[str, Any]] = {}
    for key in ("sigma", "detection", "clutter"):
        for name, value in options[key]:
            given.setdefault(name, {})[key] = value
    from avcli.formats.records import as_record
    from avcli.tracking.fusion import Fusion
    from avcli.tracking.glmb import GLMB

    sources = [(_sensor_name(path), path) for path in files] + list(named) or [("sensor", "-")]
    outputs = {"--explain": explain, "--learn": learn, "--map": map}
    session.check_outputs(outputs, [path for _, path in sources])
    if learn and os.path.exists(learn) and not os.path.isfile(learn):
        session.usage(f"--learn {learn}: not a file; it is read before it is written")
    if learn and no_learn and not os.path.exists(learn):
        session.usage(f"--learn {learn}: no such file, and --no-learn writes none")
    inputs = _Inputs(session, sources, live)
    with session.output() as write, _accounts(explain) as account:
        first = inputs.until_first_record()  # then config.json is complete
        config = session.config if session.has_config else None
        fusion = Fusion.of(config, settings, tracker, lag, given=given, explain=bool(explain), say=session.warn)
        merger: Merger = (
            fusion.live_merger(inputs.names)
            if live
            else fusion.merger(inputs.names, one_sensor=not files and bool(named))
        )
        if learn:
            _recall(session, fusion, learn)
        events = itertools.chain(first, inputs.rest(merger))
        with _kept(learn if live and not no_learn else None, fusion):
            for step in merger.steps(session.progress(events, session.lines(path for _, path in sources))):
                with session.timing("tracking"), unbroken():
                    ready = fusion.step(*step)
                for tracks in ready:
                    write(as_record(tracks))
                account(fusion)
        for tracks in fusion.finish():
            write(as_record(tracks))
        if inputs.broken:
            raise inputs.broken
    if learn and not no_learn:
        from avcli.tracking.learnt import write_learnt

        write_learnt(learn, fusion.state())
    if map:
        from avcli.formats.atomic import write_bytes
        from avcli.tracking.picture import picture

        write_bytes(map, picture(fusion.state(), fusion.population, fusion.coverage, settings.hidden))
    _doubt(session, fusion, given)
    for note in fusion.notes():
        session.note(note)
    if isinstance(fusion.tracker, GLMB):
        pairs, near = fusion.tracker.pairs, fusion.tracker.near
        session.note_skipped("pairs of person and detection", pairs - near, pairs, "which are far from each other")


def _doubt(session: Session, fusion: Fusion, given: dict[str, dict[str, Any]]) -> None:
    """Say which sensors and options cannot be as they were meant."""
    for name in sorted(given.keys() - fusion.tracker.column.keys() - SENSORS.keys()):
        session.warn(f"sensor {name!r} has options but sent no record")
    for name in fusion.alone():
        first, last = fusion.spans[name]
        session.warn(
            f"sensor {name!r}: its records, from {first:.1f} to {last:.1f} s, have no time in common with those of "
            "another sensor: do the clocks agree?"
        )
    for name in sorted(name for name, fields in given.items() if "sigma" in fields and was_given("sigma")):
        stated = [fusion.stated.get(one.name) for one in fusion.tracker.sensors if name in (one.name, one.kind)]
        if True in stated and False not in stated:
            session.warn(f"--sigma {name} has no effect: all of its detections state a covariance, which counts")

    steps, seen, shown = (fusion.steps[key] for key in ("all", "detections", "people"))
    if seen >= max(50, steps / 2) and shown < seen / 20 and not fusion.outside and not fusion.doubted:
        session.warn(
            f"{seen} of {steps} steps have detections, but {shown} have people: are positions in metres, covariances "
            "in square metres, and times in seconds?"
        )


def _refuse(tracker: str, lag: float, settings: Settings, has_config: bool) -> None:
    """End with a usage error where an option was given that has no effect."""
    refuse_without_effect(TRACKERS[tracker].unused - (set() if lag else {"lag"}), f"with --tracker {tracker}")
    foreign = [name for name, (_, one) in settings_of(Settings).items() if one.only not in ("", settings.motion)]
    refuse_without_effect(foreign, f"with --motion {settings.motion}")
    if lag and settings.show == "all":
        refuse_without_effect(["show"], "with --lag if it is all: whether a person has left is known then")
    if not has_config:
        refuse_without_effect(["room_margin"], "without a config.json (-C or -c), which gives the room's size")


def _recall(session: Session, fusion: Fusion, path: str) -> None:
    """Let a fusion begin with what an earlier run has written to a file, if there is one."""
    from avcli.tracking.learnt import read_learnt

    if os.path.exists(path):
        try:
            fusion.restore(read_learnt(path))
        except ValueError as error:
            session.fail(f"--learn {path}: {error}")


@contextlib.contextmanager
def _kept(path: str | None, fusion: Fusion) -> Iterator[None]:
    """Write what was learnt to a file where a signal ends the block, as a live run mostly ends; None: write nothing."""
    try:
        yield
    except Killed:
        if path:
            from avcli.tracking.learnt import write_learnt

            write_learnt(path, fusion.state())
        raise


@contextlib.contextmanager
def _accounts(path: str | None) -> Iterator[Callable[[Fusion], None]]:
    """Yield a function that writes how a fusion used the latest records, to a file that appears whole."""
    if not path:
        yield lambda fusion: None
        return
    from avcli.formats.atomic import replacing
    from avcli.formats.records import encode

    with replacing(path) as whole, open(whole, "wb") as stream:
        yield lambda fusion: stream.writelines(map(encode, fusion.accounts()))


def _sensor_name(path: str) -> str:
    stem = Path(path).stem.lower()
    return next((word for word in ("audio", "video") if word in stem), "sensor" if path == "-" else stem)


class _Inputs:
    """The detections of all sources; all are opened first, so that a missing file is found."""

    def __init__(self, session: Session, sources: list[tuple[str, str]], live: bool) -> None:
        from avcli.formats.arrivals import Arrivals, is_pipe, open_fifo
        from avcli.tracking.merging import in_turn

        self.session, self.sources = session, sources
        self.names = ["standard input" if path == "-" else path for _, path in sources]
        self.broken: Failure | None = None
        streams = [self._opened(path, open_fifo) for _, path in sources]
        pipes = [k for k, stream in enumerate(streams) if is_pipe(stream)]
        self.arrivals: Arrivals[Detections] | None = None
        self.in_turn: Iterator[Event]
        if pipes and live:
            self.arrivals = Arrivals(self.names, streams, self._read)
        elif pipes and len(sources) > 1:
            names, several = [self.names[k] for k in pipes], [streams[k] for k in pipes]
            arrivals = Arrivals(names, several, lambda k, stream: self._read(pipes[k], stream), session.warn)
            of = {source: arrivals.of(k) for k, source in enumerate(pipes)}
            self.in_turn = in_turn([of.get(k) or self._read(k, stream) for k, stream in enumerate(streams)])
        else:
            self.in_turn = in_turn([self._read(k, stream) for k, stream in enumerate(streams)])

    def until_first_record(self) -> list[Event]:
        """Return the events up to the first record, or to the end."""
        events: list[Event] = []
        ended = 0
        while ended < len(self.sources):
            event = self.arrivals.next() if self.arrivals else next(self.in_turn)
            events.append(event)
            if event and event[1] is not None:
                break
            ended += 1
        return events

    def rest(self, merger: Merger) -> Iterator[Event]:
        """Yield the further events; live ones with one of None where the merger has something due.

        A broken input ends all of them, so that the tracks up to there are written; `broken` then says why.
        """
        try:
            if not self.arrivals:
                yield from self.in_turn
                return
            while merger.open:
                yield self.arrivals.next(merger.due())
        except Failure as broken:
            self.broken = broken
            yield from [(source, None) for source in merger.open]

    def _opened(self, path: str, open_fifo: Callable[[str], BinaryIO | None]) -> BinaryIO:
        with contextlib.suppress(OSError):  # which `Session.open` finds again and reports
            if path != "-" and (fifo := open_fifo(path)):
                return fifo
        return self.session.open(path)

    def _read(self, number: int, stream: BinaryIO) -> Iterator[Detections]:
        from avcli.formats import records
        from avcli.tracking.fusion import named

        name, path = self.sources[number]
        with stream:
            place = "<stdin>" if path == "-" else path
            yield from named(name, self.session.stream_records(stream, place, records.detections))
