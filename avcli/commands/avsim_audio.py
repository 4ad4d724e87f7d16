"""avsim-audio: what the microphones of a room hear of people who walk and talk in it."""

import contextlib
import math
from pathlib import Path

import click

from avcli.commands.filter import Filter, Session, common
from avcli.settings import DEFAULT_RT60_S

LONGEST_SILENCE_S = 3600.0
"""s; a scene whose first record is later begins there."""
MANY_IMAGES = 1_000_000
"""images of a microphone from which on it is said that they take long."""
BYTES_AN_IMAGE = 100
"""that choosing among the images of a microphone takes, roughly."""
PATTERNS = ("omni", "subcardioid", "cardioid", "hypercardioid", "bidirectional")
PRESETS = {"thesis": {"switch": 0.01, "ism_decay": 15.0}}


def _absorption(_context, _parameter, text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 6) or not all(0 <= value <= 1 for value in values):
        raise click.BadParameter(f"{text}: expected one number from 0 to 1, or six for x0,x1,y0,y1,z0,z1")
    return values if len(values) == 6 else values * 6


def _noise(_context, _parameter, texts: tuple[str, ...]) -> dict[str, float]:
    levels = {}
    for text in texts:
        kind, _, value = text.partition("=")
        try:
            levels[kind] = float(value)
        except ValueError:
            kind = ""
        if kind not in ("sensor", "room") or not math.isfinite(levels[kind]):
            raise click.BadParameter(f"{text}: expected sensor=DB or room=DB")
    return levels


@click.command("avsim-audio", cls=Filter, epilog="Example: avsim-audio -C out/s1 scene.jsonl -o audio.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--speech",
    multiple=True,
    metavar="FILE",
    help="Recording that the people speak instead of the built-in voices; once for each voice. "
    "The person with object id i has voice i modulo their number.",
)
@click.option(
    "--level",
    type=click.FloatRange(-20, 140),
    default=60.0,
    show_default=True,
    metavar="DB",
    help="Level of a voice, dB SPL at 1 m.",
)
@click.option(
    "--pause",
    type=click.FloatRange(0),
    default=0.15,
    show_default=True,
    metavar="S",
    help="Pause between the end of a recording and its next beginning, s.",
)
@click.option(
    "--mouth-height",
    type=click.FloatRange(0, min_open=True),
    default=1.6,
    show_default=True,
    metavar="M",
    help="Height above the floor, m, of a mouth whose mouth_position the ground truth does not state.",
)
@click.option(
    "--source-directivity",
    type=click.Choice(PATTERNS),
    default="omni",
    show_default=True,
    help="Pattern of a talking head, which looks where it walks.",
)
@click.option(
    "--microphone-path",
    metavar="FILE",
    help="Where microphones move: records whose object_id is a channel and whose position is that of its microphone. "
    "Channels that it does not name stay where the configuration has them.",
)
@click.option(
    "--rt60",
    type=click.FloatRange(0, 1000),
    metavar="S",
    help="Reverberation time, s; 0 is a room without echo.  [default: the config's, else 0.35]",
)
@click.option("--no-reverb", is_flag=True, help="The direct path alone, to -80 dB; as --rt60 0.")
@click.option(
    "--absorption",
    callback=_absorption,
    metavar="A[,A...]",
    help="Energy that the walls absorb, from 0 to 1, instead of a reverberation time: one number, or six for "
    "x0,x1,y0,y1,z0,z1.",
)
@click.option(
    "--absorption-model",
    type=click.Choice(["sabine", "eyring", "image"]),
    default="sabine",
    show_default=True,
    help="How the absorption follows from the reverberation time: by Sabine's or Eyring's equation, or such that the "
    "image sources decay in it (T30).",
)
@click.option("--strict", is_flag=True, help="Refuse a reverberation time that the room cannot have.")
@click.option(
    "--reflection-sign",
    type=click.Choice(["negative", "positive"]),
    default="negative",
    show_default=True,
    help="Whether a wall turns the pressure over. If not, low frequencies build up.",
)
@click.option(
    "--speed-of-sound",
    type=click.FloatRange(0, min_open=True),
    metavar="M/S",
    help="Speed of sound, m/s.  [default: the config's, else 343]",
)
@click.option(
    "--temperature", type=float, metavar="C", help="Temperature of the air, °C, instead of its speed of sound."
)
@click.option(
    "--noise",
    multiple=True,
    callback=_noise,
    metavar="KIND=DB",
    help="sensor=DB: white noise of each microphone, DB below a voice of --level at 1 m. "
    "room=DB: diffuse pink noise of DB SPL. May be given for each.",
)
@click.option(
    "--error-db",
    type=click.FloatRange(-100, -10),
    default=-40.0,
    show_default=True,
    metavar="DB",
    help="Error allowed relative to what is heard, dB; a smaller one takes longer.",
)
@click.option(
    "--ism-decay",
    type=click.FloatRange(1, 60),
    metavar="DB",
    help="Follow image sources until the sound has decayed by DB, and let noise go on from there; for very long "
    "reverberation.  [default: image sources throughout]",
)
@click.option(
    "--switch",
    type=click.FloatRange(0.001),
    metavar="S",
    help="Hold the response of a place for S seconds and switch then, as gpuRIR does, with the noise of --ism-decay "
    "drawn anew each time; to compare with.  [default: interpolate]",
)
@click.option(
    "--sample-rate", type=click.IntRange(4000, 384000), metavar="HZ", help="Sample rate, Hz.  [default: the config's]"
)
@click.option(
    "--bit-depth",
    type=click.Choice(["16", "24", "32"]),
    help="Bits of a sample; 32 are floats.  [default: the config's, else 32; 24 in FLAC]",
)
@click.option(
    "--format",
    "extension",
    type=click.Choice(["wav", "flac"]),
    default="wav",
    show_default=True,
    help="Kind of the sound files.",
)
@click.option(
    "--chunk",
    type=click.FloatRange(0.05),
    metavar="S",
    help="Write a sound file for every S seconds, as soon as it is known.  [default: one for the whole scene]",
)
@click.option(
    "--rir",
    metavar="FILE",
    help="Write the impulse responses from every mouth of every record too: .npz, or .sofa (needs sofar).",
)
@common(seed=True, skip_invalid=True, presets=PRESETS)
def main(session: Session, files, **options):
    """Simulate what the microphones of a room hear of people who walk and talk in it.

    Reads ground-truth records (who is where, and whose turn it is to speak), writes sound files with a channel for each
    microphone to DIR/audio/wav, and a record for each file.
    """
    _check(session, options)
    paths = _microphone_paths(session, options["microphone_path"])
    recordings = _recordings(session, options["speech"])
    last = -math.inf

    def people_at(record, bad):
        from avcli.formats import records

        nonlocal last
        people = records.sources(record, bad)
        if people.timestamp <= last:
            raise records.RecordError(f"timestamp {people.timestamp:g} does not come after {last:g}")
        last = people.timestamp
        return people

    with session.output() as write, contextlib.ExitStack() as stack:
        tape = None
        places = []
        for people in session.records(files, people_at):
            if tape is None:
                surroundings, tail_s = _surroundings(session, paths, options)
                rate = surroundings.sample_rate_hz
                speakers = _speakers(session, surroundings, recordings, options)
                # A clock that does not start with the scene (Unix time) is not waited for from its zero on.
                begin = 0 if people.timestamp < LONGEST_SILENCE_S else math.ceil(people.timestamp * rate)
                hear = _with_noise(session, surroundings, speakers, options)
                tape = stack.enter_context(_Tape(session, hear, speakers.activity, rate, begin, options, write))
            with session.timing("simulation"):
                mouths = speakers.step(people)
            tape.roll(speakers.settled)
            if options["rir"]:
                places += [(people.timestamp, *who) for who in zip(people.ids.tolist(), mouths, strict=True)]
        if tape is None:
            return
        with session.timing("simulation"):
            speakers.finish()
        tape.scene_end = math.ceil(last * rate - 1e-4)
        tape.roll(math.ceil((last + tail_s) * rate - 1e-4))
        if speakers.moved_inside:
            session.warn(f"a mouth on a wall or outside the room was moved inside ({_times(speakers.moved_inside)})")
        if speakers.jumps:
            session.warn(f"someone jumped ({_times(speakers.jumps)}); the voice breaks off there")
        if options["rir"]:
            with session.timing("responses"):
                _write_responses(session, options["rir"], surroundings, places)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _check(session: Session, options) -> None:
    """Refuse options that contradict each other or need what is missing, before any work is done."""
    for name, value in options.items():
        if isinstance(value, float) and not math.isfinite(value):
            session.usage(f"--{name.replace('_', '-')} {value:g}: expected a finite number")
    for one, other in (
        ("rt60", "absorption"),
        ("rt60", "no_reverb"),
        ("absorption", "no_reverb"),
        ("speed_of_sound", "temperature"),
    ):
        if options[one] not in (None, False) and options[other] not in (None, False):
            session.usage(f"--{one.replace('_', '-')} and --{other.replace('_', '-')} contradict each other")
    if options["extension"] == "flac" and options["bit_depth"] == "32":
        session.usage("--bit-depth 32: FLAC takes 16 or 24")
    if options["rir"] and options["source_directivity"] != "omni":
        session.usage("--rir writes the responses to a source that sounds all round; not with --source-directivity")
    if options["rir"] and options["microphone_path"]:
        session.usage("--rir writes the responses of microphones that stand; not with --microphone-path")
    if options["rir"] and Path(options["rir"]).suffix not in (".npz", ".sofa"):
        session.usage(f"--rir {options['rir']}: expected a name that ends in .npz or .sofa")
    if options["rir"] and Path(options["rir"]).suffix == ".sofa":
        import importlib.util

        if importlib.util.find_spec("sofar") is None:
            session.fail("--rir FILE.sofa needs the package sofar (pip install sofar); .npz does not")


def _recordings(session: Session, paths):
    """Read the voices: [((n,) samples, rate in Hz)]."""
    from avcli import acoustics
    from avcli.formats import media

    built_in = Path(acoustics.__file__).with_name("voices")
    recordings = []
    for path in paths or sorted(built_in.glob("*.flac")):
        if not Path(path).exists():
            session.usage(f"{path}: no such file")
        samples, rate = media.read_audio(path)
        if samples.shape[1] > 1:
            session.warn(f"{path}: the mean of its {samples.shape[1]} channels is spoken")
        samples = samples.mean(axis=1)
        if not samples.any():
            session.warn(f"{path}: silent from beginning to end")
        elif (abs(samples) >= 0.9999).sum() > 0.001 * len(samples):
            session.warn(f"{path}: the recording is clipped")
        recordings.append((samples, rate))
    return recordings


def _microphone_paths(session: Session, path: str | None):
    """Read where microphones go: {channel: (times, positions)}."""
    from avcli.formats import records

    paths: dict[int, tuple[list[float], list]] = {}

    def extend(record, bad):
        moment = records.identified(record, bad)
        for channel, position in zip(moment.ids.tolist(), moment.positions, strict=True):
            if math.isnan(position[2]):
                bad(f"object_id {channel}: a microphone needs three coordinates")
                continue
            times, positions = paths.setdefault(channel, ([], []))
            times.append(moment.timestamp)
            positions.append(position)

    for _ in session.records([path], extend) if path else ():
        pass
    return paths


def _microphones(session: Session, paths):
    """Return the places of the microphones, (m, 3) m, and the trajectories of those that move."""
    import numpy as np

    from avcli import acoustics

    room, fixed = session.config.room, session.config.microphones.positions
    places, trajectories = fixed.copy(), [None] * len(fixed)
    for channel, (times, positions) in sorted(paths.items()):
        if not 0 <= channel < len(fixed):
            session.fail(f"--microphone-path: channel {channel}: {session.config.name} has {len(fixed)} microphones")
        try:
            trajectories[channel] = acoustics.Trajectory(np.array(times), np.array(positions))
        except ValueError as error:
            session.fail(f"--microphone-path: channel {channel}: {error}")
        places[channel] = positions[0]
    for channel in range(len(fixed)):
        on_the_way = np.array(paths[channel][1]) if channel in paths else fixed[[channel]]
        outside = on_the_way[((on_the_way < 0) | (on_the_way > room.dimensions)).any(axis=1)]
        if len(outside):
            source = "--microphone-path" if channel in paths else session.config.name
            session.fail(f"{source}: microphone {channel} at {outside[0].tolist()} is outside the room")
    return places, tuple(trajectories) if paths else ()


def _surroundings(session: Session, paths, options):
    """Return the room with its microphones, and how long its reverberation lasts, s."""
    import numpy as np

    from avcli import acoustics, numeric
    from avcli.formats import experiment

    room, microphones = session.config.room, session.config.microphones
    places, trajectories = _microphones(session, paths)
    speed = options["speed_of_sound"] or room.speed_of_sound_m_s
    if options["temperature"] is not None:
        speed = numeric.speed_of_sound(options["temperature"])
    rt60, absorption = _absorption_of(session, room, options)

    direct_m = float(np.linalg.norm(room.dimensions))
    tail_s = max(rt60, direct_m / speed)
    # At the default error the last of the reverberation is not heard; below −45 dB more than T60 of it is.
    followed_s = rt60 * (15 - options["error_db"]) / 60
    if options["ism_decay"] is not None:
        followed_s = min(followed_s, rt60 * options["ism_decay"] / 60)
    reach_m = max(followed_s * speed, direct_m)
    images = acoustics.image_count(room.dimensions, reach_m) if (absorption < 1).all() else 1
    if images > MANY_IMAGES:
        text = f"T60 {rt60:g} s: sound reaches {images:.2g} images of each microphone"
        advice = f"--ism-decay {15 if options['ism_decay'] is None else 'of less'} follows the strong ones and lets "
        advice += "noise go on"
        if images > acoustics.MOST_IMAGES:
            session.fail(f"{text}, some {images * BYTES_AN_IMAGE / 2**30:.1f} GiB; {advice}")
        session.warn(f"{text}, which takes long; {advice}")
    if ((absorption > 0) & (absorption < 1)).all():
        decay = acoustics.image_rt60(room.dimensions, absorption, speed)
        session.note(f"image sources between these walls decay by 60 dB in {decay:.3f} s (T30)")
    session.note(
        f"T60 {rt60:g} s, absorption {np.round(absorption, 4).tolist()}, about {images:.0f} images of a microphone, "
        f"Schroeder frequency {acoustics.schroeder_frequency(room.dimensions, rt60):.1f} Hz, {speed:.1f} m/s"
    )
    sign = -1 if options["reflection_sign"] == "negative" else 1
    surroundings = acoustics.Surroundings(
        room_dimensions_m=room.dimensions,
        reflection=sign * np.sqrt(1 - absorption),
        microphones_m=places,
        sample_rate_hz=options["sample_rate"] or microphones.sample_rate_hz,
        reach_m=reach_m,
        speed_of_sound_m_s=speed,
        directivities=microphones.directivities,
        orientations=microphones.orientations,
        source_directivity=experiment.DIRECTIVITIES[options["source_directivity"]],
        rt60_s=rt60,
        end_s=tail_s if options["ism_decay"] is not None and rt60 > 0 else 0.0,
        trajectories=trajectories,
    )
    return surroundings, tail_s


def _absorption_of(session: Session, room, options):
    """Return the reverberation time, s, and the absorption of the six walls that go together."""
    import numpy as np

    from avcli import acoustics

    rt60, absorption = options["rt60"], options["absorption"]
    if options["no_reverb"]:
        rt60 = 0.0
    if rt60 is None and absorption is None:
        absorption = room.absorption
        if absorption is None:
            rt60 = DEFAULT_RT60_S if room.reverberation_time_s is None else room.reverberation_time_s
    if rt60 is None:
        absorption = np.asarray(absorption)
        rt60 = acoustics.sabine_rt60(room.dimensions, absorption)
        if not math.isfinite(rt60):
            session.fail("walls that absorb nothing: the sound of this room would never end")
        return (rt60 if (absorption < 1).any() else 0.0), absorption
    if rt60 == 0:
        return 0.0, np.ones(6)
    model = getattr(acoustics, f"{options['absorption_model']}_absorption")
    try:
        return rt60, model(room.dimensions, rt60)
    except ValueError as error:
        if options["strict"]:
            raise
        session.warn(f"{error}; simulated without echo")
        return 0.0, np.ones(6)


def _speakers(session: Session, surroundings, recordings, options):
    from avcli import acoustics

    rate = surroundings.sample_rate_hz
    with session.timing("voices"):
        voices = [
            acoustics.at_level(acoustics.resample(samples, own_rate, rate), rate, options["level"])
            for samples, own_rate in recordings
        ]
    return acoustics.Speakers(
        surroundings,
        voices,
        error_db=options["error_db"],
        switch_s=options["switch"],
        pause_s=options["pause"],
        mouth_height_m=options["mouth_height"],
        seed=session.seed,
    )


def _with_noise(session: Session, surroundings, speakers, options):
    """Return a function of (begin, end) that gives what the microphones hear, (m, n) Pa."""
    from avcli import acoustics

    wanted = options["noise"]
    if not wanted:
        return speakers.take
    noise = acoustics.Noise(
        surroundings.microphones_m,
        surroundings.sample_rate_hz,
        sensor_pa=acoustics.pascal(options["level"] - wanted["sensor"]) if "sensor" in wanted else 0.0,
        room_pa=acoustics.pascal(wanted["room"]) if "room" in wanted else 0.0,
        speed_of_sound_m_s=surroundings.speed_of_sound_m_s,
        seed=session.seed,
    )
    return lambda begin, end: speakers.take(begin, end) + noise.take(begin, end)


class _Tape:
    """The sound files of an experiment, one after another, with a record for each that is complete."""

    def __init__(self, session: Session, hear, activity, rate: int, begin: int, options, write):
        self._session, self._hear, self._activity, self._rate, self._write = session, hear, activity, rate, write
        self._chunk = math.inf if options["chunk"] is None else round(options["chunk"] * rate)
        self._extension = options["extension"]
        self._bit_depth = int(options["bit_depth"] or session.config.microphones.bit_depth)
        if self._extension == "flac":
            self._bit_depth = min(self._bit_depth, 24)
        self._begin = self._now = begin
        self.scene_end = math.inf
        self._file = None

    def __enter__(self) -> "_Tape":
        directory = self._session.experiment / "audio" / "wav"
        directory.mkdir(parents=True, exist_ok=True)
        for old in directory.glob("multichannel_audio_*"):
            old.unlink()
        return self

    def __exit__(self, kind, error, trace) -> None:
        if self._file is not None:
            self._file.__exit__(kind, error, trace)
            if kind is None:
                self._report()

    def roll(self, until: int) -> None:
        """Write all samples before `until`."""
        from avcli.formats import experiment, media

        while self._now < until:
            if self._file is None:
                self._path = experiment.Layout.audio(self._begin / self._rate, self._extension)
                channels = len(self._session.config.microphones.positions)
                path = self._session.experiment / self._path
                self._file = media.AudioWriter(path, self._rate, channels, self._bit_depth).__enter__()
            end = min(until, self._begin + self._chunk, self._now + (1 << 16))
            self._file.write(self._hear(self._now, end).T)
            self._now = end
            if end == self._begin + self._chunk:
                self._file.__exit__(None, None, None)
                self._report()
                self._begin, self._file = end, None

    def _report(self) -> None:
        begin_s, end_s = self._begin / self._rate, self._now / self._rate
        if self._file.clipped:
            self._session.warn(f"{self._path}: {self._file.clipped} samples were clipped at 1 Pa", "samples clipped")
        audio = {
            "path": self._path,
            "start_sample": self._begin,
            "num_samples": self._now - self._begin,
            "tail_samples": max(0, self._now - max(self.scene_end, self._begin)),
            "sample_rate_hz": self._rate,
            "num_channels": self._file.channels,
        }
        activity = {
            str(identity): [[round(start, 6), round(end, 6)] for start, end in intervals]
            for identity, intervals in self._activity(begin_s, end_s).items()
        }
        self._write({"timestamp": begin_s, "audio": audio, "activity": activity})


def _write_responses(session: Session, path: str, surroundings, places) -> None:
    """Write the impulse responses of all places, [(time, object id, mouth)], to a .npz or a .sofa file."""
    import numpy as np

    from avcli import acoustics
    from avcli.formats import atomic

    mouths = np.array([mouth for _, _, mouth in places]).reshape(-1, 3)
    content = {
        "rir": acoustics.impulse_responses(surroundings, mouths).astype(np.float32),
        "timestamp": np.array([time for time, _, _ in places]),
        "object_id": np.array([identity for _, identity, _ in places], dtype=np.int64),
        "source_position_m": mouths,
        "microphone_positions_m": surroundings.microphones_m,
        "room_dimensions_m": surroundings.room_dimensions_m,
        "reflection": surroundings.reflection,
        "sample_rate_hz": np.array(surroundings.sample_rate_hz),
        "speed_of_sound_m_s": np.array(surroundings.speed_of_sound_m_s),
    }
    with atomic.replacing(path) as temporary:
        if path.endswith(".npz"):
            with open(temporary, "wb") as file:
                np.savez_compressed(file, **content)
        else:
            _write_sofa(temporary, content)


def _write_sofa(path, content) -> None:
    """Write responses by AES69 (SingleRoomSRIR): a measurement for each place, a receiver for each microphone."""
    import sofar

    sofa = sofar.Sofa("SingleRoomSRIR")
    sofa.GLOBAL_Title = "Simulated impulse responses of a shoebox room"
    sofa.GLOBAL_ApplicationName = "avsim-audio"
    sofa.GLOBAL_RoomType = "shoebox"
    sofa.RoomCornerA, sofa.RoomCornerB = [0.0, 0.0, 0.0], content["room_dimensions_m"]
    sofa.Data_IR, sofa.Data_SamplingRate = content["rir"].astype(float), float(content["sample_rate_hz"])
    sofa.Data_Delay = [[0.0] * len(content["microphone_positions_m"])]
    places, receivers = content["source_position_m"], content["microphone_positions_m"]
    sofa.SourcePosition, sofa.ListenerPosition = places, 0 * places
    sofa.ReceiverPosition = receivers[:, :, None]
    for name in ("SourcePosition", "ListenerPosition", "ReceiverPosition"):
        setattr(sofa, f"{name}_Type", "cartesian")
        setattr(sofa, f"{name}_Units", "metre")
    count = len(receivers)
    for name in ("ReceiverDescriptions", "EmitterDescriptions"):  # sofar 1.3 cannot write them with netCDF4 1.7.5
        sofa.delete(name)
    sofa.ReceiverView, sofa.ReceiverUp = [[[1.0], [0.0], [0.0]]] * count, [[[0.0], [0.0], [1.0]]] * count
    sofa.MeasurementDate = content["timestamp"]
    named = Path(f"{path}.sofa")  # the ending that sofar insists on
    try:
        sofar.write_sofa(str(named), sofa)
        named.replace(path)
    finally:
        named.unlink(missing_ok=True)
