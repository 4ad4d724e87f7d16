"""avdetect-audio: find who speaks where."""

import io
from collections.abc import Iterator
from typing import BinaryIO

import click

from avcli.commands.filter import Filter, common

_SOUND = (b"RIFF", b"RF64", b"fLaC", b"FORM", b"caff")


@click.command("avdetect-audio", cls=Filter, epilog="Example: avdetect-audio -C out/s1 audio.jsonl -o a.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--method",
    type=click.Choice(["srp", "3d-ssl"]),
    default="srp",
    show_default=True,
    help="srp: steered response power, live, several talkers. 3d-ssl: the thesis's closed form, on whole recordings.",
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0.1, max=1000),
    default=10.0,
    show_default=True,
    metavar="HZ",
    help="Decisions per second, in Hz: one record for every k / rate.",
)
@click.option(
    "--start",
    type=float,
    default=0.0,
    show_default=True,
    metavar="S",
    help="Time of the first sample of a sound file or stream, in s (records carry their own).",
)
@click.option(
    "--temperature",
    type=click.FloatRange(min=-50, max=60),
    metavar="C",
    help="Air temperature in °C, which sets the speed of sound.  [default: the config's speed, or 343 m/s]",
)
@click.option(
    "--window",
    type=click.FloatRange(min=0.005, max=5),
    metavar="S",
    help="Length of the Hann window, in s.  [default: 0.186 for srp, 0.042 for 3d-ssl]",
)
@click.option(
    "--beta",
    type=click.FloatRange(min=0, max=1),
    metavar="B",
    help="How far spectra are whitened: 0 not at all, 1 phases alone.  [default: 1 for srp, 0.7 for 3d-ssl]",
)
@click.option(
    "--context",
    type=click.FloatRange(min=0, max=2),
    default=0.1,
    show_default=True,
    metavar="S",
    help="srp: add the windows up to this many s before and after a decision's own; 0 adds none.",
)
@click.option(
    "--band",
    type=click.FloatRange(min=0),
    nargs=2,
    default=(80.0, 8000.0),
    show_default=True,
    metavar="LOW HIGH",
    help="srp: the frequencies that are listened to, in Hz.",
)
@click.option(
    "--tilt",
    type=click.FloatRange(min=0, max=2),
    default=0.25,
    show_default=True,
    metavar="P",
    help="srp: weigh a frequency f by f to the power -P.",
)
@click.option(
    "--heights",
    type=click.FloatRange(min=0),
    nargs=2,
    default=(0.8, 2.0),
    show_default=True,
    metavar="LOW HIGH",
    help="srp: between which heights mouths are, in m.",
)
@click.option(
    "--cell",
    type=click.FloatRange(min=0.02),
    default=0.25,
    show_default=True,
    metavar="M",
    help="srp: edge of the cells with which the search begins, in m.",
)
@click.option(
    "--resolution",
    type=click.FloatRange(min=0.001),
    default=0.02,
    show_default=True,
    metavar="M",
    help="srp: edge of the cells with which it ends, in m; a fit goes below.",
)
@click.option(
    "--keep",
    type=click.IntRange(1),
    default=24,
    show_default=True,
    metavar="N",
    help="srp: cells that go on to the next, finer level.",
)
@click.option(
    "--max-speakers",
    type=click.IntRange(1),
    default=2,
    show_default=True,
    metavar="N",
    help="srp: most talkers at one time.",
)
@click.option(
    "--max-speed",
    type=click.FloatRange(min=0),
    default=1.6,
    show_default=True,
    metavar="M/S",
    help="srp: the fastest that a talker walks, in m/s.",
)
@click.option(
    "--false-alarm",
    type=click.FloatRange(min=0, max=1, min_open=True, max_open=True),
    default=0.01,
    show_default=True,
    metavar="P",
    help="srp: share of decisions that may report something where there is noise alone; sets the threshold.",
)
@click.option(
    "--min-score",
    type=click.FloatRange(min=0, max=1),
    default=0.5,
    show_default=True,
    metavar="P",
    help="srp: report a talker only if this probable to be right.",
)
@click.option(
    "--high-pass",
    type=click.FloatRange(min=0),
    default=200.0,
    show_default=True,
    metavar="HZ",
    help="3d-ssl: cutoff of the high-pass, in Hz; 0 is none.",
)
@click.option(
    "--threshold",
    type=click.FloatRange(min=0, max=1),
    default=0.01,
    show_default=True,
    metavar="SHARE",
    help="3d-ssl: share of the recording's largest short-time energy that makes an event.",
)
@click.option(
    "--min-gap",
    type=click.FloatRange(min=0),
    metavar="S",
    help="3d-ssl: least time between events, in s.  [default: T60 in s times the window in samples, as samples]",
)
@click.option(
    "--combination",
    type=click.IntRange(4, 32),
    default=4,
    show_default=True,
    metavar="N",
    help="3d-ssl: delays in each closed form; every choice of N of them is solved (4 of 7: 35 solutions).",
)
@click.option(
    "--max-condition",
    type=click.FloatRange(min=1),
    default=300.0,
    show_default=True,
    metavar="N",
    help="3d-ssl: largest condition number of a closed form that counts as stable.",
)
@click.option(
    "--refine",
    is_flag=True,
    help="3d-ssl: fit each event's delays by robust maximum likelihood instead of averaging the closed forms.",
)
@common(seed=True, skip_invalid=True, presets={"thesis": {"method": "3d-ssl"}})
def main(session, files, method, start, temperature, **options):
    """Find who speaks where, by ear.

    FILE holds audio records, or is a WAV or FLAC file; standard input may be a WAV stream too. One record is written
    for every time step, with the talkers' positions at which the sound was emitted; its objects are empty where nobody
    speaks.
    """
    with session.output() as write:
        sound = _Sound(session, files, start)
        blocks = sound.blocks()
        with session.timing("read"):
            first = next(blocks, None)
        if first is None:
            return
        array = _array(session, temperature)
        for decision in _decisions(session, method, array, sound, _with_first(first, blocks), options):
            for notice in decision.notices:
                session.warn(f"{notice} (at {decision.time:.1f} s)", kind=notice)
            objects = [
                {"position": position, "covariance": covariance, "score": score}
                for position, covariance, score in zip(
                    decision.positions, decision.covariances, decision.scores, strict=True
                )
            ]
            write({"timestamp": decision.time, "sensor": "audio", "objects": objects})


def _with_first(first, rest: Iterator) -> Iterator:
    yield first
    yield from rest


def _array(session, temperature: float | None):
    """The microphones and the room that the config describes."""
    from avcli.localization.array import Array
    from avcli.numeric import speed_of_sound

    microphones, room = session.config.microphones, session.config.room
    speed = room.speed_of_sound_m_s if temperature is None else speed_of_sound(temperature)
    return Array(microphones.positions, microphones.sample_rate_hz, room.dimensions, speed)


def _decisions(session, method: str, array, sound: "_Sound", blocks: Iterator, options: dict) -> Iterator:
    """Run the localizer that was asked for."""
    from dataclasses import fields

    import numpy as np

    given = {key: value for key, value in options.items() if value is not None}

    def settings_of(kind):
        return kind(**{field.name: given[field.name] for field in fields(kind) if field.name in given})

    if method == "srp":
        from avcli.localization.steered import Settings, SteeredLocalizer

        localizer = SteeredLocalizer(array, settings_of(Settings), np.random.default_rng(session.seed))
        session.note(f"a decision comes {localizer.latency:.3f} s after the sound was emitted")
        yield from localizer.localize(blocks, sound.begin, sound.tail)
    else:
        from avcli.localization import ssl3d

        given.setdefault("min_gap", (session.config.room.reverberation_time_s or 0.35) * given.get("window", 0.042))
        samples = np.concatenate(list(blocks))
        yield from ssl3d.localize(samples, array, settings_of(ssl3d.Settings), sound.begin, sound.tail())


class _Sound:
    """The samples that the files hold, or the records in them point at, as one stream on one clock."""

    def __init__(self, session, files, start: float):
        self.session, self.start = session, start
        self.streams = [(path, session.open(path)) for path in (files or ("-",))]
        self.begin: int | None = None
        self.next = 0
        self.scene_end: int | None = None
        self.held_back = 0.0

    def tail(self) -> float:
        """How much of what was received, in s, comes after the scene's end or may do so."""
        if self.scene_end is None:
            return self.held_back
        return max(0, self.next - self.scene_end) / self.session.config.microphones.sample_rate_hz

    def blocks(self) -> Iterator:
        """Yield (n, channels) samples."""
        for path, stream in self.streams:
            name = "<stdin>" if path == "-" else path
            head = stream.read(4)
            whole = io.BufferedReader(_Again(head, stream))
            if head in _SOUND:
                yield from self.sound(path, name, whole)
            else:
                yield from self.recorded(whole, name)

    def sound(self, path: str, name: str, stream: BinaryIO) -> Iterator:
        """Yield the samples of a sound file, or of a WAV on standard input."""
        from avcli.formats import media

        if path != "-":
            stream.close()
            pieces = media.audio_blocks(path)
        elif stream.peek(4)[:4] in (b"RIFF", b"RF64"):
            pieces = media.wav_stream_blocks(stream, name)
        else:
            self.session.fail(f"{name}: of sound, standard input takes WAV alone; name the file")
        for block, rate in pieces:
            self.check(name, block.shape[1], rate)
            if self.begin is None:
                self.begin = round(self.start * rate)
            yield block

    def recorded(self, stream: BinaryIO, name: str) -> Iterator:
        """Yield the samples that the audio records of a stream point at, each at its place on the scene's clock."""
        from avcli.formats import records

        seen = found = 0
        for chunk in self.session.stream_records(stream, name, lambda record, _bad: records.audio(record)):
            seen += 1
            if chunk is not None:
                found += 1
                yield from self.chunk(chunk)
        if seen and not found:
            self.session.fail(f"{name}: no record in it has audio")

    def chunk(self, chunk) -> Iterator:
        """Yield the samples of one record: silence where some were left out before it, none that were there already."""
        import numpy as np

        from avcli.formats import media

        _ = self.session.config.microphones  # a config that is missing or wrong is named before the sound is
        path = self.session.media_root / chunk.path
        if chunk.tail_samples is None:
            self.held_back = self.session.config.room.reverberation_time_s or 0.0
        elif chunk.tail_samples and self.scene_end is None:
            self.scene_end = chunk.start_sample + chunk.num_samples - chunk.tail_samples
        if self.begin is None:
            self.begin = self.next = chunk.start_sample
        if chunk.start_sample > self.next:
            self.session.warn(f"{path}: {chunk.start_sample - self.next} samples are missing before it", "gaps")
        while self.next < chunk.start_sample:
            silence = np.zeros((min(1 << 16, chunk.start_sample - self.next), chunk.num_channels))
            self.next += len(silence)
            yield silence
        skip, left = self.next - chunk.start_sample, chunk.num_samples
        if skip:
            self.session.warn(f"{path}: {min(skip, left)} samples were there before; they are dropped", "repeated")
        for block, rate in media.audio_blocks(path):
            self.check(str(path), block.shape[1], rate)
            block = block[:left]
            left -= len(block)
            new = block[skip:]
            skip -= len(block) - len(new)
            self.next += len(new)
            if len(new):
                yield new
        if left:
            self.session.fail(f"{path}: {left} samples fewer than its record states")

    def check(self, name: str, channels: int, rate: int) -> None:
        """Refuse sound that the config's microphones did not hear."""
        microphones = self.session.config.microphones
        if channels != len(microphones.positions):
            expected = f"{len(microphones.positions)} microphones"
            self.session.fail(f"{name}: {channels} channels, and {self.session.config.name} has {expected}")
        if rate != microphones.sample_rate_hz:
            expected = f"{microphones.sample_rate_hz} (microphone_config.audio_sample_rate_hz)"
            self.session.fail(f"{name}: sampled at {rate} Hz, and {self.session.config.name} says {expected}")


class _Again(io.RawIOBase):
    """A stream whose first bytes were read already and are read again."""

    def __init__(self, head: bytes, stream: BinaryIO):
        self.head, self.stream = head, stream

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        content = self.head[: len(buffer)] or self.stream.read1(len(buffer))
        self.head = self.head[len(buffer) :]
        buffer[: len(content)] = content
        return len(content)

    def close(self) -> None:
        self.stream.close()
        super().close()
