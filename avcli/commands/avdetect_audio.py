"""avdetect-audio: find who speaks where."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import itertools
import math
import os
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from avcli.commands.filter import Filter, Session, common
from avcli.commands.live import Skips, open_pipe
from avcli.commands.options import FiniteRange, Numbers, Parsed, from_settings, refuse_without_effect, settings_from
from avcli.commands.places import doubt_microphones
from avcli.localization.settings import METHODS, ClosedFormSettings, CommonSettings, SteeredSettings
from avcli.settings import settings_of

if TYPE_CHECKING:
    import numpy as np

    from avcli.formats.experiment import Config, Microphones
    from avcli.formats.live import Stoppable
    from avcli.formats.recorder import Raw
    from avcli.localization.array import Decision
    from avcli.localization.stream import Block, Recording

_BLOCK = 1 << 16
"""samples that are read of a file at a time."""
_SOUND = (b"RIFF", b"RIFX", b"RF64", b"riff", b"fLaC", b"FORM", b"caff", b".snd", b"OggS")
"""How sound files begin: WAV, its form for large files and W64, FLAC, AIFF, CAF, AU, Ogg."""


@click.command("avdetect-audio", cls=Filter, epilog="Example: avdetect-audio -C out/s1 audio.jsonl -o a.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--method",
    type=click.Choice(list(METHODS)),
    default="srp",
    show_default=True,
    help="srp: steered response power, live, several talkers. 3d-ssl: the thesis's closed form, on whole recordings.",
)
@click.option(
    "--sensor",
    default="audio",
    show_default=True,
    metavar="NAME",
    help="Name of the microphones in the records; of several arrays each needs its own.",
)
@click.option(
    "--start",
    type=FiniteRange(),
    default=0.0,
    show_default=True,
    metavar="S",
    help="Time of the first sample of a sound file or stream, in s (records state their own).",
)
@click.option(
    "--temperature",
    type=FiniteRange(min=-50, max=60),
    metavar="C",
    help="Air temperature in °C, which sets the speed of sound.  [default: the config's speed, or 343 m/s]",
)
@click.option("--live", is_flag=True, help="srp: When behind a stream in real time, skip time steps.")
@click.option(
    "--raw",
    type=Parsed("KIND,HZ,CHANNELS", "avcli.formats.recorder", "Raw.parse"),
    help="The sound is raw samples, interleaved: s16le, s24le, s32le or f32le, such as s16le,48000,8.",
)
@click.option(
    "--channels",
    type=Parsed("LIST", "avcli.formats.recorder", "channels_of"),
    help="Channels of the sound that are the microphones', in their order, from 1: 3-10 or 1-4,8,6.  [default: all]",
)
@click.option("--gains", type=Numbers(), help="Gains of these channels in dB, such as 0,0,6,0.  [default: none]")
@from_settings(CommonSettings)
@from_settings(SteeredSettings)
@from_settings(ClosedFormSettings)
@common(seed=True, skip_invalid=True, media=True, mark_end=True, presets={"thesis": {"method": "3d-ssl"}})
def main(
    session: Session,
    files: tuple[str, ...],
    method: str,
    sensor: str,
    start: float,
    temperature: float | None,
    live: bool,
    raw: Raw | None,
    channels: tuple[int, ...] | None,
    gains: tuple[float, ...] | None,
    **options: Any,
) -> None:
    """Localize people who speak, with microphones.

    FILE holds audio records, or is a WAV or FLAC file; standard input may be a WAV stream too. One record is written
    for every time step: the positions of the talkers' mouths at the time at which the sound left them. Its list of
    objects is empty if nobody speaks.
    """
    for name, kind in METHODS.items():
        if name != method:
            refuse_without_effect(settings_of(kind), f"with --method {method}")
    if method != "srp":
        refuse_without_effect(["live"], f"with --method {method}, which needs the whole recording")
    heights = options["heights"] or ()
    if list(heights) != sorted(heights):
        session.usage("--heights {:g} {:g}: the lowest mouth comes first".format(*heights))
    if not sensor:
        session.usage("--sensor: the name is empty")
    session.check_outputs({}, files or ("-",))
    session.load("soundfile", "avcli.localization.methods")
    with session.output() as write, contextlib.ExitStack() as stack:
        from avcli.formats.numbered import as_numbered

        sound = _Sound(session, start, live, raw, channels, gains)
        if live:
            blocks = _arriving(sound, stack, *open_pipe(session, files))
        else:
            blocks = sound.blocks([(path, session.open(path)) for path in as_numbered(files or ("-",))])
        with session.timing("read"):
            first = next(blocks, None)
        if first is None:
            return
        from avcli.formats.features import as_objects
        from avcli.localization import localizer
        from avcli.localization.steered import SteeredLocalizer

        settings = settings_from(METHODS[method], options)
        chosen = localizer(sound.config, method, seed=session.seed, settings=settings, temperature_c=temperature)
        if chosen.latency is not None:
            session.note(f"a decision comes {chosen.latency:.3f} s after the sound was emitted")
        doubt_microphones(session, sound.config)
        if sound.microphones.wiring:
            session.note("the channels are put right as microphone_config.channels in config.json says")
        at = "position"  # of a steady source
        if isinstance(chosen, SteeredLocalizer) and chosen.settings.beta < 1.0:
            beta = chosen.settings.beta
            session.warn(
                f"--beta {beta:g}: scores were fitted with 1 and are too high here; second talkers are mostly false"
            )
        if isinstance(chosen, SteeredLocalizer) and chosen.compact:
            at = "direction"
            session.note("the microphones are close together: directions are told, distances are not known")
        skips = stack.enter_context(Skips(session, "time steps"))
        read = session.progress(itertools.chain([first], blocks), None if live else sound.expected(files))
        for number, decision in enumerate(chosen.localize(read, sound.recording.begin or 0)):
            skips.take(decision.time, skips.skipped + decision.skipped, starting=number == 0)
            for notice in decision.notices:
                session.warn(f"{notice} (at {decision.time:.1f} s)", kind=notice)
            objects = _objects(decision, as_objects(decision.features, len(decision.scores)))
            faults = {"channel_faults": [fault.record() for fault in decision.faults]} if decision.faults else {}
            steady = {"steady_sources": [{at: place} for place in decision.steady]} if len(decision.steady) else {}
            named = {"timestamp": decision.time, "sensor": sensor, "kind": "microphones"}
            write({**named, "objects": objects, **faults, **steady})
        if isinstance(chosen, SteeredLocalizer):
            session.note_skipped("searches of windows", chosen.silent, chosen.windows, "which hold no voice")


def _objects(decision: Decision, features: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the talkers of a decision as a record has them, each with its features."""
    objects = []
    rays = decision.rays or (None,) * len(decision.scores)
    rows = zip(
        decision.positions, decision.covariances, decision.scores, decision.machines, rays, features, strict=True
    )
    for position, covariance, score, machine, ray, told in rows:
        one: dict[str, Any] = {"position": position, "covariance": covariance, "score": score}
        if not math.isnan(machine):
            one["machine"] = machine
        if ray is not None:
            direction = [number for number in ray.direction.tolist() if not math.isnan(number)]
            one |= {"origin": ray.origin, "direction": direction, "direction_sd_deg": math.degrees(ray.sd)}
        objects.append(one | ({"features": told} if told else {}))
    return objects


def _arriving(sound: _Sound, stack: contextlib.ExitStack, name: str, pipe: Stoppable) -> Iterator[Block]:
    """Yield the blocks of a live source, each with what has arrived after it; the stack ends the reading."""
    from avcli.formats.live import LiveSource

    arrivals = stack.enter_context(LiveSource(sound.blocks([(name, io.BufferedReader(pipe))]), stop=pipe.stop))
    for block in arrivals:
        samples = arrivals.waiting(lambda block: len(block.samples))
        yield dataclasses.replace(block, waiting=samples / sound.microphones.sample_rate_hz)


class _Sound:
    """The sound that files hold, or the records in them point at, as one recording."""

    def __init__(
        self,
        session: Session,
        start: float,
        live: bool,
        raw: Raw | None,
        channels: tuple[int, ...] | None,
        gains: tuple[float, ...] | None,
    ):
        self.session, self.start, self.live, self.raw = session, start, live, raw
        self.channels, self.gains = channels, gains

    @functools.cached_property
    def recording(self) -> Recording:
        """The recording; the config is read when it is first asked for: after the first record."""
        from avcli.localization.stream import Recording

        config = self.session.config
        reverberation = config.room.reverberation_time_s or 0.0
        if self.raw and self.raw.rate != config.microphones.sample_rate_hz:
            stated = config.microphones.sample_rate_hz
            self.session.warn(f"the sound has {self.raw.rate} Hz, which counts; config.json says {stated} Hz")
        return Recording(self.microphones, reverberation_s=reverberation, start_s=self.start, warn=self.session.warn)

    @functools.cached_property
    def config(self) -> Config:
        """The config, with the rate of raw sound."""
        known = self.session.config
        if not self.raw:
            return known
        section = {**known.raw["microphone_config"], "audio_sample_rate_hz": self.raw.rate}
        return type(known)({**known.raw, "microphone_config": section}, known.name)

    @property
    def microphones(self) -> Microphones:
        """The microphones; the rate of raw sound counts in place of the config's."""
        return self.config.microphones

    def blocks(self, streams: list[tuple[str, BinaryIO]]) -> Iterator[Block]:
        """Yield the blocks of the streams, one after another."""
        for path, stream in streams:
            name = "<stdin>" if path == "-" else path
            if self.raw:
                from avcli.formats import recorder

                head = stream.read(4)
                if head in _SOUND:
                    self.session.fail(f"{name}: begins as a sound file, not with raw samples; leave --raw out")
                whole = io.BufferedReader(_Again(head, stream))
                yield from self.recording.sound(name, self.picked(name, recorder.raw_blocks(whole, self.raw, name)))
                continue
            head = stream.read(4)
            whole = io.BufferedReader(_Again(head, stream))
            if head in _SOUND:
                yield from self.sound(path, name, head, whole)
            else:
                yield from self.recorded(whole, name)

    def picked(self, name: str, pieces: Iterable[tuple[np.ndarray, int]]) -> Iterable[tuple[np.ndarray, int]]:
        """Return the chosen channels of pieces of sound, with their gains, and silence where live ones are missing."""
        from avcli.formats import recorder

        if self.channels is not None or self.gains is not None:
            pieces = recorder.chosen(pieces, name, self.channels, self.gains)
        return self.whole(name, pieces) if self.live else pieces

    def whole(self, name: str, pieces: Iterable[tuple[np.ndarray, int]]) -> Iterator[tuple[np.ndarray, int]]:
        """Yield pieces of live sound, with silence for what the clock says is missing."""
        import numpy as np

        from avcli.formats.recorder import Arrivals

        arrivals, held = Arrivals(), list[tuple[np.ndarray, int]]()
        for samples, rate in pieces:
            held.append((samples, rate))
            seconds = arrivals.missing(len(samples) / rate)
            if seconds is None:  # the sound may have been held up alone
                continue
            lost = round(seconds * rate)
            if lost:
                self.session.warn(
                    f"{name}: {lost / rate:.2f} s of sound are missing; they count as silence", kind="gaps"
                )
            for begin in range(0, lost, _BLOCK):
                yield np.zeros((min(lost - begin, _BLOCK), samples.shape[1])), rate
            yield from held
            held.clear()
        yield from held

    def expected(self, files: Iterable[str]) -> int | None:
        """Return about how many blocks the files have, for a progress bar; None where a stream or a fault hides it."""
        if self.raw or self.session.lines(files) is None:
            return None
        import soundfile

        from avcli.formats import records

        lengths: list[int] = []
        for path in files:
            try:
                with open(path, "rb") as stream:
                    if stream.read(4) in _SOUND:
                        lengths.append(soundfile.info(os.fsencode(path)).frames)
                        continue
                    stream.seek(0)
                    found = [records.audio(records.decode(text), outside=True) for _, text in records.texts(stream)]
                    lengths += [chunk.num_samples for chunk in found if chunk is not None]
            except (ValueError, OSError, soundfile.LibsndfileError):  # reading the sound reports it
                return None
        return sum(-(-length // _BLOCK) for length in lengths)

    def sound(self, path: str, name: str, head: bytes, stream: BinaryIO) -> Iterator[Block]:
        """Yield the blocks of a sound file, or of a WAV on standard input."""
        from avcli.formats import media

        if path != "-" and not self.live:
            stream.close()
            pieces = media.audio_blocks(path, _BLOCK)
        elif head in (b"RIFF", b"RF64"):
            pieces = media.wav_stream_blocks(stream, name)
        else:
            self.session.fail(f"{name}: standard input takes sound as WAV only; name the file instead")
        yield from self.recording.sound(name, self.picked(name, pieces))

    def recorded(self, stream: BinaryIO, name: str) -> Iterator[Block]:
        """Yield the blocks that the audio records of a stream point at."""
        from avcli.formats import media, records

        seen = found = 0
        read = functools.partial(records.audio, outside=self.session.allow_outside)
        for chunk in self.session.stream_records(stream, name, lambda record, _bad: read(record)):
            seen += 1
            if chunk is not None:
                found += 1
                path = self.session.media_root / chunk.path
                yield from self.recording.piece(
                    str(path),
                    self.picked(str(path), media.audio_blocks(path, _BLOCK)),
                    start_sample=chunk.start_sample,
                    num_samples=chunk.num_samples,
                    tail_samples=chunk.tail_samples,
                )
        if seen and not found:
            self.session.fail(f"{name}: none of its records has audio")


class _Again(io.RawIOBase):
    """A stream whose first bytes were read already and are read again."""

    def __init__(self, head: bytes, stream: BinaryIO):
        self.head, self.stream = head, stream

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        content = self.head[: len(buffer)] or self.stream.read1(len(buffer))  # type: ignore[attr-defined]  # every file and pipe has it
        self.head = self.head[len(buffer) :]
        buffer[: len(content)] = content
        return len(content)

    def close(self) -> None:
        self.stream.close()
        super().close()
