"""avsim-audio: what the microphones of a room hear of people who walk and talk in it."""

import contextlib
import math
from pathlib import Path

import click

from avcli.commands.filter import Filter, Session, common

DEFAULT_RT60_S = 0.35
"""s; an office by DIN 18041, as in the thesis."""
LONGEST_SILENCE_S = 3600.0
"""s; a scene whose first record is later begins there."""


@click.command("avsim-audio", cls=Filter)
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--speech",
    multiple=True,
    metavar="FILE",
    help="Recording that the people speak instead of the built-in voices; once for each voice. "
    "The person with object id i has voice i modulo their number.",
)
@click.option(
    "--level", type=float, default=60.0, show_default=True, metavar="DB", help="Level of a voice, dB SPL at 1 m."
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
    "--rt60",
    type=click.FloatRange(0),
    metavar="S",
    help="Reverberation time, s; 0 is a room without echo.  [default: the config's, else 0.35]",
)
@click.option("--strict", is_flag=True, help="Refuse a reverberation time that the room cannot have.")
@click.option(
    "--error-db",
    type=click.FloatRange(-100, -10),
    default=-40.0,
    show_default=True,
    metavar="DB",
    help="Error allowed relative to what is heard, dB; a smaller one takes longer.",
)
@click.option(
    "--chunk",
    type=click.FloatRange(0.05),
    metavar="S",
    help="Write a sound file for every S seconds, as soon as it is known.  [default: one for the whole scene]",
)
@common(seed=True, skip_invalid=True)
def main(session: Session, files, speech, level, pause, mouth_height, rt60, strict, error_db, chunk):
    """Simulate what the microphones of a room hear of people who walk and talk in it.

    Reads ground-truth records (who is where, and whose turn it is to speak), writes sound files with a channel for each
    microphone to DIR/audio/wav, and a record for each file.
    """
    recordings = _recordings(session, speech)
    last = -math.inf

    def people_at(record, bad):
        from avcli import records

        nonlocal last
        people = records.sources(record, bad)
        if people.timestamp <= last:
            raise records.RecordError(f"timestamp {people.timestamp:g} does not come after {last:g}")
        last = people.timestamp
        return people

    with session.output() as write, contextlib.ExitStack() as stack:
        tape = None
        for people in session.records(files, people_at):
            if tape is None:
                surroundings, tail_s = _surroundings(session, rt60, strict)
                speakers = _speakers(session, surroundings, recordings, level, pause, mouth_height, error_db)
                rate = surroundings.sample_rate_hz
                # A clock that does not start with the scene (Unix time) is not waited for from its zero on.
                begin = 0 if people.timestamp < LONGEST_SILENCE_S else math.ceil(people.timestamp * rate)
                tape = stack.enter_context(_Tape(session, speakers, rate, begin, chunk, write))
            with session.timing("simulation"):
                speakers.step(people)
            tape.roll(speakers.settled)
        if tape is not None:
            with session.timing("simulation"):
                speakers.finish()
            tape.roll(math.ceil((last + tail_s) * rate - 1e-4))
            _tell(session, speakers)


def _recordings(session: Session, paths):
    """Read the voices: [((n,) samples, rate in Hz)]."""
    from avcli import acoustics, media

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


def _surroundings(session: Session, rt60, strict):
    """Return the room with its microphones, and how long its reverberation lasts, s."""
    import numpy as np

    from avcli import acoustics

    room, microphones = session.config.room, session.config.microphones
    for i, position in enumerate(microphones.positions):
        if ((position < 0) | (position > room.dimensions)).any():
            session.fail(f"{session.config.name}: microphone {i} at {position.tolist()} is outside the room")
    absorption = room.absorption
    if rt60 is None and absorption is None:
        rt60 = DEFAULT_RT60_S if room.reverberation_time_s is None else room.reverberation_time_s
    if rt60 is not None:
        absorption = np.ones(6)
        shortest = acoustics.minimum_rt60(room.dimensions)
        if rt60 >= shortest:
            absorption = acoustics.sabine_absorption(room.dimensions, rt60)
        elif rt60 > 0:
            text = f"T60 {rt60:g} s: this room has at least {shortest:.4f} s"
            if strict:
                session.fail(text)
            session.warn(f"{text}; simulated without echo")
    else:
        rt60 = acoustics.sabine_rt60(room.dimensions, absorption)
        if not math.isfinite(rt60):
            session.fail(f"{session.config.name}: room_config.absorption: the sound of this room would never end")
    direct_s = float(np.linalg.norm(room.dimensions)) / room.speed_of_sound_m_s
    tail_s = max(rt60 if (absorption < 1).any() else 0.0, direct_s)
    session.note(
        f"T60 {rt60:g} s, absorption {np.round(absorption, 4).tolist()}, "
        f"Schroeder frequency {acoustics.schroeder_frequency(room.dimensions, rt60):.1f} Hz"
    )
    surroundings = acoustics.Surroundings(
        room_dimensions_m=room.dimensions,
        reflection=-np.sqrt(1 - absorption),
        microphones_m=microphones.positions,
        sample_rate_hz=microphones.sample_rate_hz,
        reach_m=tail_s * room.speed_of_sound_m_s,
        speed_of_sound_m_s=room.speed_of_sound_m_s,
        directivities=microphones.directivities,
        orientations=microphones.orientations,
    )
    return surroundings, tail_s


def _speakers(session: Session, surroundings, recordings, level, pause, mouth_height, error_db):
    from avcli import acoustics

    rate = surroundings.sample_rate_hz
    with session.timing("voices"):
        voices = [
            acoustics.at_level(acoustics.resample(samples, own, rate), rate, level) for samples, own in recordings
        ]
    return acoustics.Speakers(surroundings, voices, error_db=error_db, pause_s=pause, mouth_height_m=mouth_height)


def _tell(session: Session, speakers) -> None:
    if speakers.moved_inside:
        session.warn(f"{speakers.moved_inside} times a mouth on a wall or outside the room was moved inside")
    if speakers.jumps:
        session.warn(f"{speakers.jumps} times someone jumped; the voice breaks off there")


class _Tape:
    """The sound files of an experiment, one after another, with a record for each that is complete."""

    def __init__(self, session: Session, speakers, sample_rate_hz: int, begin: int, chunk_s: float | None, write):
        self._session, self._speakers, self._rate, self._write = session, speakers, sample_rate_hz, write
        self._chunk = math.inf if chunk_s is None else round(chunk_s * sample_rate_hz)
        self._begin = self._now = begin
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
        from avcli import experiment, media

        while self._now < until:
            if self._file is None:
                microphones = self._session.config.microphones
                self._path = experiment.Layout.audio(self._begin / self._rate)
                self._file = media.AudioWriter(
                    self._session.experiment / self._path, self._rate, len(microphones.positions), microphones.bit_depth
                ).__enter__()
            end = min(until, self._begin + self._chunk, self._now + (1 << 16))
            self._file.write(self._speakers.take(self._now, end).T)
            self._now = end
            if end == self._begin + self._chunk:
                self._file.__exit__(None, None, None)
                self._report()
                self._begin, self._file = end, None

    def _report(self) -> None:
        begin_s, end_s = self._begin / self._rate, self._now / self._rate
        if self._file.clipped:
            self._session.warn(f"{self._path}: {self._file.clipped} samples were clipped")
        audio = {
            "path": self._path,
            "start_sample": self._begin,
            "num_samples": self._now - self._begin,
            "sample_rate_hz": self._rate,
            "num_channels": self._file.channels,
        }
        activity = {
            str(identity): [[round(start, 6), round(end, 6)] for start, end in intervals]
            for identity, intervals in self._speakers.activity(begin_s, end_s).items()
        }
        self._write({"timestamp": begin_s, "audio": audio, "activity": activity})
