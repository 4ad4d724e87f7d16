"""avsim-audio: what the microphones of a room record of people who walk and talk in it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.acoustics.settings import Settings
from avcli.commands.filter import Filter, Session, common
from avcli.commands.options import FiniteRange, from_settings, refuse_without_effect, settings_from

if TYPE_CHECKING:
    import numpy as np

    from avcli.acoustics.recorder import Recorder
    from avcli.acoustics.tape import Chunk, Tape
    from avcli.acoustics.trajectory import Trajectory
    from avcli.formats.media import Sound
    from avcli.formats.records import Identified

PRESETS = {"thesis": {"absorption_model": "sabine", "switch_s": 0.01, "ism_decay_db": 15.0}}


def _absorption(_context: click.Context, _parameter: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (1, 6) or not all(0 <= value <= 1 for value in values):
        raise click.BadParameter(f"{text}: expected one number from 0 to 1, or six for x0,x1,y0,y1,z0,z1")
    return values if len(values) == 6 else values * 6


def _noise(_context: click.Context, _parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, float]:
    levels = {}
    for text in texts:
        kind, _, value = text.partition("=")
        try:
            levels[f"{kind}_noise_db"] = level = float(value)
        except ValueError:
            level = math.nan
        if kind not in ("sensor", "room") or not math.isfinite(level):
            raise click.BadParameter(f"{text}: expected sensor=DB or room=DB")
    return levels


@click.command("avsim-audio", cls=Filter, epilog="Example: avsim-audio -C out/s1 scene.jsonl -o audio.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--speech",
    multiple=True,
    metavar="FILE",
    help="Recording that people speak instead of the built-in voices; may be given several times. "
    "The person with object id i has recording i modulo their number.",
)
@click.option(
    "--microphone-path",
    metavar="FILE",
    help="Records of microphones that move: object_id is the number of the microphone, from 1, as in config.json. "
    "The other microphones stay where the configuration has them.",
)
@from_settings(Settings)
@click.option("--no-reverb", is_flag=True, help="Simulate the direct path alone, as --rt60 0 does.")
@click.option(
    "--absorption",
    callback=_absorption,
    metavar="A[,A...]",
    help="Energy that the walls absorb, from 0 to 1, instead of a reverberation time: one number, or six for "
    "x0,x1,y0,y1,z0,z1.",
)
@click.option(
    "--temperature", type=FiniteRange(), metavar="C", help="Temperature of the air, °C, instead of the speed of sound."
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
    help="Format of the sound files.",
)
@click.option(
    "--chunk",
    type=FiniteRange(0.05),
    metavar="S",
    help="Write a sound file for every S seconds, as soon as it is complete.  [default: one for the whole scene]",
)
@click.option(
    "--rir",
    metavar="FILE",
    help="Also write the impulse responses from every mouth of every record: .npz, or .sofa (needs sofar).",
)
@common(seed=True, skip_invalid=True, mark_end=True, presets=PRESETS)
def main(session: Session, files: tuple[str, ...], **options: Any) -> None:
    """Simulate what the microphones of a room record of people who walk and talk in it.

    Reads ground-truth records (where people are, and whose turn it is to speak). Writes sound files with one channel
    for each microphone to DIR/audio/wav, and a record for each file.
    """
    from avcli.formats.writer import only_writer

    others = [path for path in (options["microphone_path"], *options["speech"]) if path]
    session.check_outputs({"--rir": options["rir"]}, [*(files or ("-",)), *others])
    settings = _settings(session, options)
    session.load("soundfile", "avcli.acoustics.recorder", "avcli.acoustics.tape")
    trajectories = _trajectories(session, options["microphone_path"])
    speech = _speech(session, options["speech"])
    recorder = None
    last = -math.inf
    mouths: list[tuple[float, int, np.ndarray]] = []

    def people_at(record: Mapping, bad: Callable[[str], None]) -> Identified:
        from avcli.acoustics.recorder import LONGEST_STEP_S
        from avcli.formats import records

        nonlocal last
        people = records.identified(record, bad)
        if people.timestamp <= last:
            raise records.RecordError(f"timestamp {people.timestamp:g} is not later than {last:g}")
        if last + LONGEST_STEP_S < people.timestamp and last > -math.inf:
            raise records.RecordError(
                f"timestamp {people.timestamp:g} is more than {LONGEST_STEP_S:g} s after {last:g}"
            )
        last = people.timestamp
        return people

    with session.output() as write, contextlib.ExitStack() as held, contextlib.ExitStack() as open_file:

        def store(chunks: Iterable[Chunk]) -> None:
            for chunk in chunks:
                if chunk.clipped:
                    text = f"{chunk.path}: {chunk.clipped} samples were clipped at 1 Pa"
                    session.warn(text, "samples clipped")
                write(chunk.record())

        for people in session.progress(session.records(files, people_at), session.lines(files)):
            if recorder is None:
                recorder = _recorder(session, settings, speech, trajectories)
                held.enter_context(only_writer(session.experiment, session.name))
                tape = _tape(session, recorder, open_file, options)
            with session.timing("simulation"):
                here = recorder.step(people)
            store(tape.roll())
            if options["rir"]:
                mouths += zip([people.timestamp] * len(here), people.ids.tolist(), here, strict=True)
        if recorder is None:
            return
        with session.timing("simulation"):
            recorder.finish()
        store(tape.end())
        computed, spared = recorder.work
        why = "where people stand or are silent"
        session.note_skipped("responses of all microphones", spared, computed + spared, why, "simulation")
        if options["rir"]:
            from avcli.acoustics import exchange

            with session.timing("responses"):
                times, ids, positions = zip(*mouths, strict=True) if mouths else ((), (), ())
                exchange.write_responses(options["rir"], recorder.surroundings, times, ids, positions)


def _settings(session: Session, options: Mapping[str, Any]) -> Settings:
    """Check the options, before any work is done, and return the settings that they mean."""
    for one, other in (
        ("rt60_s", "absorption"),
        ("rt60_s", "no_reverb"),
        ("absorption", "no_reverb"),
        ("speed_of_sound_m_s", "temperature"),
    ):
        if options[one] not in (None, False) and options[other] not in (None, False):
            session.usage(f"{_flag(one)} and {_flag(other)} contradict each other")
    if options["extension"] == "flac" and options["bit_depth"] == "32":
        session.usage("--bit-depth 32: FLAC takes 16 or 24")
    if path := options["rir"]:
        from avcli.acoustics import exchange

        if options["source_directivity"] != "omni":
            session.usage("--rir writes the responses to an omnidirectional source, not to --source-directivity")
        if options["microphone_path"]:
            session.usage("--rir writes the responses of microphones that stand, not of --microphone-path")
        try:
            exchange.check_path(path)
        except ValueError as error:
            session.usage(f"--rir {error}")
    settings = dataclasses.replace(settings_from(Settings, options), **options["noise"])
    if options["no_reverb"]:
        settings = dataclasses.replace(settings, rt60_s=0.0)
    if (temperature := options["temperature"]) is not None:
        from avcli import numeric

        try:
            settings = dataclasses.replace(settings, speed_of_sound_m_s=numeric.speed_of_sound(temperature))
        except ValueError as error:
            session.usage(f"--temperature: {error}")
    _refuse_without_effect(settings.rt60_s, settings.absorption)
    return settings


def _flag(name: str) -> str:
    parameters = click.get_current_context().command.params
    return next(max(parameter.opts, key=len) for parameter in parameters if parameter.name == name)


def _refuse_without_effect(rt60_s: float | None, absorption: Iterable[float] | None) -> None:
    """Refuse the options that have no effect on the walls that the options or the configuration state."""
    anechoic = rt60_s == 0
    if rt60_s is None and absorption is not None:
        refuse_without_effect(("absorption_model", "strict"), "where the absorption of the walls is stated")
        anechoic = min(absorption) == 1
    if anechoic:
        needless = ("absorption_model", "strict", "reflection_sign", "ism_decay_db")
        refuse_without_effect(needless, "in a room without reverberation")


def _speech(session: Session, paths: Iterable[str]) -> list[Sound] | None:
    """Read the recordings that people speak; None: none is given."""
    from avcli.acoustics.signals import recording_faults
    from avcli.formats import media

    recordings = []
    for path in paths:
        if not Path(path).exists():
            session.usage(f"{path}: no such file")
        recordings.append(media.Sound(*media.read_audio(path)))
        for fault in recording_faults(recordings[-1]):
            session.warn(f"{path}: the recording {fault}")
    return recordings or None


def _trajectories(session: Session, path: str | None) -> dict[int, Trajectory]:
    """Read the paths of the microphones that move: channel -> trajectory."""
    import numpy as np

    from avcli.acoustics.trajectory import trajectories_of
    from avcli.formats import records

    def moment(record: Mapping, bad: Callable[[str], None]) -> Identified:
        microphones = records.identified(record, bad)
        known = ~np.isnan(microphones.positions[:, 2])
        for number in microphones.ids[~known].tolist():
            bad(f"object_id {number}: a microphone needs three coordinates")
        channels = microphones.ids[known] - 1
        return records.Identified(microphones.timestamp, channels, microphones.positions[known])

    try:
        return trajectories_of(session.records([path], moment) if path else ())
    except ValueError as error:
        raise ValueError(f"--microphone-path: {error}") from None


def _recorder(
    session: Session, settings: Settings, speech: list[Sound] | None, trajectories: dict[int, Trajectory]
) -> Recorder:
    from avcli.acoustics.recorder import Recorder

    if session.config.microphones.wiring:
        session.warn(
            "the simulated channels have no faults, but microphone_config.channels in config.json states some: "
            "remove it, or avdetect-audio puts right what is not wrong"
        )
    room = session.config.room
    stated = settings.rt60_s is not None or settings.absorption is not None
    if stated or not room.heard_by_materials:
        refuse_without_effect(("humidity_percent",), "where the absorption is not that of materials")
    if room.heard_by_materials and not stated:
        refuse_without_effect(("absorption_model", "strict"), "where the room's surfaces have materials")
    elif not stated:
        _refuse_without_effect(room.reverberation_time_s if room.absorption is None else None, room.absorption)
    with session.timing("voices"):
        recorder = Recorder(
            session.config, settings, speech=speech, trajectories=trajectories, seed=session.seed, say=session.warn
        )
    if session.verbose:  # the decay of the images takes a twentieth of a second
        for sentence in recorder.surroundings.described():
            session.note(sentence)
    return recorder


def _tape(session: Session, recorder: Recorder, files: contextlib.ExitStack, options: Mapping[str, Any]) -> Tape:
    from avcli.acoustics.tape import Tape

    return Tape(
        recorder,
        session.experiment,
        files,
        chunk_s=options["chunk"],
        extension=options["extension"],
        bit_depth=int(options["bit_depth"] or session.config.microphones.bit_depth),
    )
