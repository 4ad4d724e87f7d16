"""avcalib's actions for a camera whose lens is known: pictures without the fisheye, its pose, the microphones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import avcli.calibration.settings as settings
from avcli.commands.avcalib_pictures import (
    check_sources,
    config_file,
    read_camera,
    usage_errors,
    views_for,
    write_camera,
)
from avcli.commands.filter import GateNotMet, Session, common
from avcli.commands.options import FiniteRange, Size, WholeRange, from_settings, refuse_without_effect, settings_from
from avcli.commands.places import doubt_camera, doubt_microphones
from avcli.settings import settings_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from avcli.calibration.bundle import Way
    from avcli.localization.survey import Listening


@click.command("undistort", epilog="Example: avcalib undistort film.mp4 -c camera.json --to straight.mp4")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@click.option(
    "--to",
    "target",
    required=True,
    metavar="PATH",
    help="Where the pictures go: a folder, a picture file (for one source), or a video (.mp4, .avi, .mkv).",
)
@from_settings(settings.ProjectionSettings)
@click.option("--size", type=Size(), help="Size of the new pictures in px.  [default: as the camera's]")
@click.option(
    "--extrapolate", is_flag=True, help="Also show what lies beyond the angle up to which the lens is trusted."
)
@from_settings(settings.PictureSettings, defaults={"rate_hz": None})
@common()
def undistort_command(
    session: Session,
    sources: tuple[str, ...],
    target: str,
    size: tuple[int, int] | None,
    extrapolate: bool,
    **values: Any,
) -> None:
    """Straighten pictures and videos. The camera_config of the new pictures goes to the output.

    A perspective picture has a camera_config of its own: brown_conrady without distortion.
    """
    from avcli.calibration import undistort
    from avcli.formats import footage

    given, names, rate_hz = settings_from(settings.ProjectionSettings, values), list(sources), values["rate_hz"]
    if given.projection != "perspective":
        refuse_without_effect(["balance"], f"with --projection {given.projection}")
    if given.fov_deg is not None:
        refuse_without_effect(["balance"], "with --fov")
    session.check_outputs({"--to": target if footage.source(target).kind == "video" else None}, names)
    camera, kinds = read_camera(session), check_sources(session, names)
    size, single = size or camera.size, len(kinds) == 1 and kinds[0].kind != "folder"
    with usage_errors(session):
        limit = camera.theta_max if extrapolate else camera.theta_trusted
        straight = undistort.straighten(camera.lens, camera.size, size, given, limit, camera.circle)
        sink = footage.Sink(target, size, footage.rate_taken(names[0], rate_hz) or 10.0, single=single)
    names = footage.in_numbers(names)  # a film of them plays in order
    total = footage.count_pictures(names, rate_hz)
    pictures = session.progress(footage.pictures(names, rate_hz, say=session.warn), total, "straightening")

    def skip(words: str) -> None:
        session.warn(f"left out: {words}")

    with sink, session.timing("straighten"):
        for picture, new in undistort.straightened(pictures, camera, straight, skip):
            sink.write(picture, new)
    if straight.is_cut:
        session.warn(
            f"what lies beyond {math.degrees(limit):.1f} degrees from the axis is black: the lens is not known there"
            + ("" if extrapolate else " (--extrapolate shows it)")
        )
    with session.output() as write:
        write(straight.camera_config())


@click.command("pose", epilog="Example: avcalib pose a.png -C lab --board 7x10 --square 95 --at 2 2.5 0")
@click.argument("sources", nargs=-1, metavar="[SOURCE]...")
@click.option(
    "--points",
    metavar="FILE",
    help="CSV with the header u,v,x,y,z: pixels, and the room points in metres that are seen there.",
)
@from_settings(settings.BoardSettings)
@click.option(
    "--at", nargs=3, type=FiniteRange(), metavar="X Y Z", help="Room position in m of the middle of the board."
)
@from_settings(settings.PlaceSettings)
@from_settings(settings.PictureSettings)
@common()
def pose_command(
    session: Session, sources: tuple[str, ...], points: str | None, at: tuple[float, ...] | None, **values: Any
) -> None:
    """Find the position and rotation of a calibrated camera in the room, with their covariance.

    Use pictures of a board that lies face up at a known place, or pixels whose room points were measured.
    """
    from avcli.calibration import place

    session.check_outputs({}, [*sources, *filter(None, (points,))], writes_config=True)
    given, camera = settings_from(settings.PlaceSettings, values), read_camera(session)
    if bool(points) == bool(sources):
        session.usage("give either pictures of a board on the floor (with --at X Y Z), or --points FILE")
    if points:
        refuse_without_effect([*settings_of(settings.BoardSettings), "at", "yaw_deg", "rate_hz"], "with --points")
        with session.open(points) as stream:
            choices, views = [place.parse_points(stream.read(), points)], 0
    else:
        if not at:
            session.usage("--at X Y Z is needed: the room position of the middle of the board")
        if values["square_mm"] is None:
            session.usage("--square MM is needed: without the size of the print there is no distance to it")
        seen = views_for(session, list(sources), values, camera)
        choices, views = place.board_choices(seen.board, seen.views, at, math.radians(given.yaw_deg)), len(seen.views)
    best, others = place.best(camera, choices, given.sigma_px, views)
    for line in place.words(best, others):
        session.warn(line)
    kind = "points" if points else "board"
    wrong = place.refusal(best.off, kind, best.rms_px)
    if place.is_mirrored(camera, choices, best, kind):
        where = "the points fit if they are mirrored" if wrong else "the camera is below the floor"
        wrong = f"{where}: x and y are exchanged, an axis runs the other way, or the pictures are mirrored"
    if wrong:
        raise GateNotMet(wrong)
    doubt_camera(session, best.camera_config()["camera_position_m"], "that")
    if session.output_path == "-":
        write_camera(session, best.camera_config())
        return
    with session.output() as write:
        write({**camera.values, **best.camera_config()})


@click.command("microphones", epilog="Example: avcalib microphones -C lab smooth.jsonl")
@click.argument("tracks", required=False, metavar="[TRACKS]")
@click.option(
    "--audio",
    multiple=True,
    type=click.Path(exists=True, dir_okay=False),
    metavar="FILE",
    help="Sound with one channel per microphone, from time 0 on; repeat the option for the files that follow.  "
    "[default: DIR/audio/wav, each from the time in its name]",
)
@click.option(
    "--places",
    type=click.Path(exists=True, dir_okay=False),
    metavar="FILE",
    help="Where somebody spoke or clapped, measured in the room: lines begin,end,x,y,z in s and m.",
)
@from_settings(settings.MicrophoneSettings)
@click.option(
    "--write", "into_config", is_flag=True, help="Write the positions and the faults of channels into config.json."
)
@click.option("--html", metavar="FILE", help="Write a report with a plan of the room as one HTML file.")
@common()
def microphones_command(
    session: Session,
    tracks: str | None,
    audio: tuple[str, ...],
    places: str | None,
    into_config: bool,
    html: str | None,
    **values: Any,
) -> None:
    """Measure the microphones by sound: some minutes of one person who walks and talks, or claps, in the room.

    Without TRACKS or --places the sound tells the shape of the array, but not its place in the room. TRACKS are records
    with one person (tracks, or ground truth). With -o FILE the output is the whole config.json with the positions that
    were found. The exit status is 3, and nothing is changed, if the recording cannot tell.
    """
    from avcli.calibration import camera, microphone_page, microphones
    from avcli.formats.atomic import write_bytes
    from avcli.formats.experiment import write_config
    from avcli.numeric import TooLittle

    given = settings_from(settings.MicrophoneSettings, values)
    if tracks and tracks.lower().endswith((".wav", ".flac")):
        session.usage(f"{tracks}: TRACKS are records of where the voice was; --audio takes sound")
    if tracks and places:
        session.usage("give TRACKS or --places, not both")
    session.check_outputs({"--html": html}, [*audio, *filter(None, (tracks, places))], writes_config=True)
    if not tracks:
        refuse_without_effect(["mouth_height_m", "track_sd_m"], "without TRACKS")
    doubt_microphones(session, session.config)
    way = _way(session, tracks, places, given)
    with session.timing("listen"):
        listening = _listening(session, audio, given)
    known = session.config.microphones.positions
    speed, speed_sd = _speed_of_sound(session, given)
    channels = listening.channels
    late, adrift, room = channels.late, channels.drift != 0.0, session.config.room.dimensions
    prior = microphones.Prior(known, given.position_sd_m, speed, speed_sd, late, adrift, room)
    with session.timing("fit"):
        try:
            found = microphones.measure(listening.heard(), listening.again, prior, way, is_clock_known=not tracks)
        except TooLittle as error:
            raise GateNotMet(str(error)) from None
        except ValueError as error:
            session.fail(str(error))
    if not found.refusal:
        channels = channels.refined(found.fit.delays, found.fit.drifts, found.hearing)
    for line in [*channels.words(), *found.words()]:
        session.warn(line)
    if html:
        report = microphone_page.page(found, channels.record(), channels.words(), session.config.room.dimensions)
        write_bytes(html, report.encode())
    if found.refusal:
        raise GateNotMet(found.refusal)
    record = {**found.record(), "channels": channels.record()}
    sd = float(found.fit.position_sd.max())
    changed = camera.with_microphones(session.config.raw, found.fit.positions.tolist(), sd, channels.wiring())
    with session.output() as write:
        write(record if session.output_path == "-" else changed)
    if into_config:
        write_config(session.config_path, changed)


def _way(session: Session, tracks: str | None, places: str | None, given: settings.MicrophoneSettings) -> Way | None:
    """Return where the voice was, as tracks or a file of places say it; None where neither is given."""
    from avcli.calibration import microphones
    from avcli.formats import records

    try:
        if places:
            return microphones.measured_places(Path(places).read_text(encoding="utf-8"), places)
        if tracks:
            walked = microphones.mouths(session.records([tracks], records.identified), given.mouth_height_m)
            return microphones.tracked(*walked, given.track_sd_m)
    except (ValueError, OSError) as error:
        session.fail(str(error))
    return None


def _speed_of_sound(session: Session, given: settings.MicrophoneSettings) -> tuple[float, float]:
    """Return the speed of sound and its standard deviation, m/s."""
    from avcli.numeric import speed_of_sound

    if given.temperature_c is None:
        return session.config.room.speed_of_sound_m_s, 2.0
    return speed_of_sound(given.temperature_c), 0.6


def _listening(session: Session, audio: tuple[str, ...], given: settings.MicrophoneSettings) -> Listening:
    """Listen to the sound, in a room without the last decimetres before its walls."""
    import numpy as np

    from avcli.calibration import microphones
    from avcli.localization.survey import WINDOW_S, Listening
    from avcli.numeric import TooLittle

    config, speed = session.config, _speed_of_sound(session, given)[0]
    known, size = config.microphones, config.room.dimensions
    widest, most = float(np.linalg.norm(known.positions[:, None] - known.positions, axis=2).max()), WINDOW_S * speed / 2
    if widest > most:
        session.fail(
            f"microphones of {config.name} are {widest:.1f} m apart, but sound is compared up to {most:.1f} m; are the "
            "positions in metres?"
        )

    def read() -> Iterator[tuple[float, np.ndarray, int]]:
        for start, samples, rate in microphones.sounds(audio, None if audio else session.experiment / "audio" / "wav"):
            if samples.shape[1] != len(known.positions):
                session.fail(
                    f"the sound has {samples.shape[1]} channels, but config.json has {len(known.positions)} microphones"
                )
            yield start, samples, rate

    low, high = np.array([0.1, 0.1, min(0.8, 0.4 * size[2])]), np.append(size[:2] - 0.1, min(2.0, 0.9 * size[2]))
    try:
        return Listening(read, known.positions, low, high, speed)
    except TooLittle as error:
        raise GateNotMet(str(error)) from None
    except ValueError as error:
        session.fail(str(error))


@click.command("background", epilog="Example: avcalib background empty.mp4 --depth depth.mkv -C lab")
@click.argument("sources", nargs=-1, metavar="[SOURCE]...")
@click.option("--depth", metavar="FILM|DIR", help="A film of depth in 16 bits, or a folder of depth pictures.")
@click.option(
    "--pictures", type=WholeRange(3, 1000), default=100, metavar="N", show_default=True, help="Use at most N of each."
)
@common()
def background_command(session: Session, sources: tuple[str, ...], depth: str | None, pictures: int) -> None:
    """Record what a room looks like without people, in colour and depth, from a film in which nobody stays in place.

    The pictures are written into the experiment directory. The output is the part of config.json that names them.
    """
    from avcli.detection import background
    from avcli.formats import footage, media
    from avcli.formats.experiment import Layout

    if not sources and not depth:
        session.usage("give colour pictures or a film, or --depth, or both")
    check_sources(session, [*sources, *filter(None, (depth,))])
    session.check_outputs({}, [*sources, *filter(None, (depth,))])
    found: dict[str, str] = {}
    try:
        if sources:
            colour = (picture.image[..., :3] for picture in footage.pictures(list(sources), say=session.warn))
            room = background.still_colour(colour, pictures)
            found["background_rgb"] = Layout.background_rgb
            _write_picture(session, Layout.background_rgb, room)
        if depth:
            shown = background.still_depth(footage.depths(depth, session.warn), pictures)
            found["background_depth"] = Layout.background_depth
            holes = float((shown == 0).mean())
            if holes > 0.5:
                session.warn(f"{holes:.0%} of the depth picture is unknown")
            _write_picture(session, Layout.background_depth, shown)
    except (media.MediaError, ValueError) as error:
        session.fail(str(error))
    with session.output() as write:
        write({"camera_config": found})


def _write_picture(session: Session, name: str, picture: Any) -> None:
    from avcli.formats import media

    path = session.experiment / name
    path.parent.mkdir(parents=True, exist_ok=True)
    media.write_png(path, picture)


def examine(session: Session, path: str, only: tuple[str, ...]) -> None:
    """Examine a whole installation; exit 3 where a part is missing or wrong."""
    from avcli.calibration import installation
    from avcli.formats import experiment

    unknown = [name for name in only if name not in installation.LOOKS]
    if unknown:
        session.usage(f"--part {unknown[0]} is unknown; known are {', '.join(installation.LOOKS)}")
    name = config_file(path)
    try:
        config = experiment.read_config(name)
    except FileNotFoundError:
        session.usage(f"{name}: no such file")
    parts = installation.examine(config, name.parent, only)
    for part in parts:
        session.warn(f"{part.name}: {part.state}: {part.text}")
    with session.output() as write:
        write(installation.record(parts))
    bad = [part.name for part in parts if not part.is_good]
    if bad:
        raise GateNotMet(f"{name}: the installation is not complete: {', '.join(bad)}")
