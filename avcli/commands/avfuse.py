"""avfuse: fuse localizations of several sensors into tracks."""

import contextlib
import math
from pathlib import Path

import click

from avcli.commands.filter import Filter, common

_THESIS = {
    "motion": "cv",
    "process_noise": 0.15,
    "birth": "adaptive",
    "adapt": False,
    "stay": 10.0,
    "doors": "anywhere",
    "sigma": ["video=0.2,0.2,0", "audio=0.25,0.25,0"],
    "detection": ["video=0.5", "audio=0.25"],
    "clutter": ["video=0.01", "audio=0.01"],
    "hidden": False,
    "room_margin": 0.0,
}


class _Lag(click.ParamType):
    """A number of steps, or "inf"."""

    name = "steps"

    def convert(self, value, param, ctx):
        if value in ("inf", math.inf):
            return math.inf
        return click.IntRange(0).convert(value, param, ctx)


class _ForSensor(click.ParamType):
    """NAME=VALUE: something of one sensor."""

    name = "name=value"

    def __init__(self, convert, wanted):
        self.convert_value, self.wanted = convert, wanted

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        name, equals, text = value.partition("=")
        try:
            if not (name and equals):
                raise ValueError
            return name, self.convert_value(text)
        except ValueError:
            self.fail(f"{value!r} is not {self.wanted}", param, ctx)


def _file(text):
    if not text:
        raise ValueError
    return text


def _sigma(text):
    numbers = [float(part) for part in text.split(",")]
    if len(numbers) > 3 or not all(0 <= number < math.inf for number in numbers):
        raise ValueError
    return tuple((numbers * 2)[:2])


def _probability(text):
    number = float(text)
    if not 0 <= number <= 1:
        raise ValueError
    return number


def _count(text):
    number = float(text)
    if not 0 <= number < math.inf:
        raise ValueError
    return number


@click.command("avfuse", cls=Filter, epilog="Example: avfuse -C out/s1 a.jsonl v.jsonl -o tracks.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--sensor",
    "named",
    multiple=True,
    type=_ForSensor(_file, "NAME=FILE"),
    metavar="NAME=FILE",
    help="Read FILE too; its records are of sensor NAME unless they say otherwise.  May be repeated.",
)
@click.option(
    "--tracker",
    type=click.Choice(["ms-glmb", "lmb", "gnn", "jpda"]),
    default="ms-glmb",
    show_default=True,
    help="ms-glmb: joint hypotheses; lmb: each one's marginals; gnn: best assignment; jpda: Stone Soup's.",
)
@click.option(
    "--lag",
    type=_Lag(),
    metavar="N|inf",
    default="0",
    show_default=True,
    help="Put each record out N steps late, smoothed by what came since; inf: at the end, smoothed by everything.",
)
@click.option(
    "--motion",
    type=click.Choice(["imm", "cv"]),
    default="imm",
    show_default=True,
    help="imm: people walk on, stop and turn (interacting models); cv: constant velocity with --process-noise.",
)
@click.option(
    "--process-noise",
    type=click.FloatRange(min=0, min_open=True),
    default=0.5,
    show_default=True,
    metavar="SIGMA",
    help="With --motion cv: standard deviation in m/s2 of an acceleration that is constant over each step.",
)
@click.option(
    "--birth",
    type=click.Choice(["poisson", "adaptive"]),
    default="poisson",
    show_default=True,
    help="poisson: a person begins with any unexplained detection; adaptive: with the next one (thesis).",
)
@click.option(
    "--stay",
    type=click.FloatRange(min=0, min_open=True),
    default=100.0,
    show_default=True,
    metavar="S",
    help="Mean time in s for which a person stays; with --doors walls, a tenth of that while within 0.7 m of a wall.",
)
@click.option(
    "--doors",
    type=click.Choice(["walls", "anywhere"]),
    default="walls",
    show_default=True,
    help="Where people come and go: through the walls, mostly, or anywhere alike.",
)
@click.option(
    "--adapt/--no-adapt",
    default=True,
    show_default=True,
    help="Estimate each sensor's clutter and detection probability on the way.",
)
@click.option(
    "--hidden/--no-hidden",
    default=True,
    show_default=True,
    help="Let people be hidden from a sensor (occluded, silent) for a while; without, a miss is a miss.",
)
@click.option(
    "--sigma",
    multiple=True,
    type=_ForSensor(_sigma, "NAME=M[,M[,M]]"),
    metavar="NAME=M[,M[,M]]",
    help="Noise in m of x, y and z for detections of a sensor that carry no covariance; 0: not observed.  "
    "[default: audio 0.25, others 0.15]",
)
@click.option(
    "--detection",
    multiple=True,
    type=_ForSensor(_probability, "NAME=P"),
    metavar="NAME=P",
    help="Probability with which a sensor finds someone whom it can find.  [default: audio 0.8, others 0.9]",
)
@click.option(
    "--clutter",
    multiple=True,
    type=_ForSensor(_count, "NAME=N"),
    metavar="NAME=N",
    help="False detections expected in one record of a sensor.  [default: audio 0.2, others 0.05]",
)
@click.option(
    "--room-margin",
    type=click.FloatRange(min=0),
    default=0.5,
    show_default=True,
    metavar="M",
    help="Drop detections farther than this, in m, outside the room of the config; without a config none is dropped.",
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0, min_open=True, max=1000),
    metavar="HZ",
    help="Records a second that are put out.  [default: frame_rate_hz of the config, else the commonest step's]",
)
@click.option(
    "--max-wait",
    type=click.FloatRange(min=0),
    default=1.0,
    show_default=True,
    metavar="S",
    help="Leave a sensor behind that lags more than this, in s of data, behind another of its stream; inf: never.",
)
@click.option(
    "--explain",
    type=click.Path(dir_okay=False, writable=True),
    metavar="FILE",
    help="Also write to FILE what each record meant: hypotheses, existence, who took which detection, came, went.",
)
@common(skip_invalid=True, presets={"thesis": _THESIS})
def main(session, files, named, rate, max_wait, room_margin, lag, tracker, explain, **options):
    """Fuse localizations of any sensors, merged in one stream or a file a sensor, into labelled tracks.

    Reads one record for each look of a sensor and writes one record of tracks for each step of a regular clock, as
    soon as every sensor has passed it. Tracks are points on the floor, with velocity, covariance, probability of
    existence and, where there are microphones, the probability that the person is speaking.
    """
    if tracker in ("gnn", "jpda") and (lag or explain):
        session.usage(
            f"--tracker {tracker} has no {'smoothing: --lag must be 0' if lag else 'hypotheses to --explain'}"
        )
    from avcli.tracking.fusion import Fusion
    from avcli.tracking.merging import Merger

    sources = [(_sensor_name(path), path) for path in files] + list(named)
    sources = sources or [("sensor", "-")]
    readers = _readers(session, sources)
    merger = fusion = None

    def steps():
        for due in merger.closed():
            with session.timing("tracking"):
                ready = fusion.step(*due)
            yield from ready

    with session.output() as write, _accounts(explain) as account:
        for source, name, found in _in_turn(readers):
            if merger is None:
                config = session.config if session.has_config else None
                rate = rate or (config and config.frame_rate_hz)
                merger = Merger(len(sources), rate, max_wait, one_sensor=not files and bool(named))
                fusion = Fusion(
                    _settings(config, options),
                    tracker,
                    lag,
                    _sensors(session, config, options),
                    room_margin if config else None,
                    bool(explain),
                )
            if found is None:
                merger.end(source)
            else:
                merger.push(source, name, found.timestamp, found)
            _tell_laggards(session, merger, max_wait)
            for time, tracks in steps():
                write(_record(time, tracks, fusion.tracker.column))
            if explain:
                account(fusion.accounts())
        if fusion is not None:
            for time, tracks in fusion.finish():
                write(_record(time, tracks, fusion.tracker.column))
            for name, count in sorted(merger.late.items()):
                session.warn(
                    f"{count} records of {name!r} came too late and were dropped; --max-wait inf waits for all"
                )
            if fusion.outside:
                session.note(f"{fusion.outside} detections outside the room were dropped (--room-margin)")


@contextlib.contextmanager
def _accounts(path):
    """A function that writes what the tracker accounts for, to a file that appears whole."""
    if not path:
        yield None
        return
    from avcli.formats.atomic import replacing
    from avcli.formats.records import encode

    with replacing(path) as whole, open(whole, "wb") as stream:
        yield lambda accounts: stream.writelines(map(encode, accounts))


def _sensor_name(path):
    stem = Path(path).stem.lower()
    return next((kind for kind in ("audio", "video") if kind in stem), "sensor" if path == "-" else stem)


def _readers(session, sources):
    """For each source an iterator of (sensor name, detections)."""
    from avcli.formats import records

    streams = [(name, path, session.open(path)) for name, path in sources]

    def read(name, path, stream):
        with stream:
            shown = "<stdin>" if path == "-" else path
            for found in session.stream_records(stream, shown, records.detections):
                yield found.sensor or name, found

    return [read(*one) for one in streams]


def _in_turn(readers):
    """Records of all sources, always from the one that is behind: (source, sensor, detections), None at its end."""
    reached = dict.fromkeys(range(len(readers)), -math.inf)
    while reached:
        source = min(reached, key=lambda k: (reached[k], k))
        name, found = next(readers[source], (None, None))
        if found is None:
            del reached[source]
        else:
            reached[source] = max(reached[source], found.timestamp)
        yield source, name, found


def _settings(config, options):
    from avcli.tracking.model import Settings
    from avcli.tracking.motion import WALKING, Model, Motion

    motion = WALKING
    if options["motion"] == "cv":
        motion = Motion((Model(0.0, pulse=options["process_noise"]),))
    area = {"walls": False}
    if config is not None:
        x, y, _ = config.room.dimensions.tolist()
        area = {"area": ((0.0, 0.0), (x, y))}
    stay = options["stay"]
    anywhere = {"pass_by": stay, "appear": 1.0} if options["doors"] == "anywhere" else {"pass_by": stay / 10}
    return Settings(motion=motion, birth=options["birth"], adapt=options["adapt"], stay=stay, **anywhere, **area)


def _sensors(session, config, options):
    known = {}
    for key in ("sigma", "detection", "clutter"):
        for name, value in options[key]:
            known.setdefault(name, {})[key] = value
    if options["hidden"]:
        return _Known(known, lambda name: {"coverage": _coverage(session, config)} if "video" in name else {})
    return _Known(known, lambda name: {"hide": 0.0})


class _Known(dict):
    """What is known of each sensor, with what its name says."""

    def __init__(self, known, by_name):
        super().__init__(known)
        self.by_name = by_name

    def get(self, name, default=None):
        return {**self.by_name(name), **super().get(name, default or {})}


def _coverage(session, config):
    """Where the camera of config.json, if it is described there, can see people."""
    if config is None or "camera_config" not in config.raw:
        return None
    from avcli.formats.experiment import ConfigError
    from avcli.tracking.coverage import of_camera

    try:
        x, y, _ = config.room.dimensions.tolist()
        return of_camera(config.camera, ((0.0, 0.0), (x, y)))
    except ConfigError as error:
        session.note(f"where the camera sees nobody is not known: {error}")
        return None


def _tell_laggards(session, merger, max_wait):
    for name in sorted(merger.laggards() - merger.lagging):
        session.warn(f"sensor {name!r} lags more than {max_wait:g} s (--max-wait) and is left behind")
    merger.lagging |= merger.laggards()


def _record(time, tracks, sensors):
    ears = [name for name in sensors if "audio" in name]
    objects = []
    for number, track in tracks:
        x, y, vx, vy = track.state.tolist()
        (xx, xy), (_, yy) = track.cov[:2, :2].tolist()
        person = {
            "object_id": number,
            "position": [x, y, 0.0],
            "velocity": [vx, vy, 0.0],
            "covariance": [[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, 1e-4]],
            "existence": track.existence,
        }
        if ears and track.found:
            person["speaking"] = max(track.found.get(name, 0.0) for name in ears)
        objects.append(person)
    return {"timestamp": time, "objects": objects}
