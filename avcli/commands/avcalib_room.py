"""avcalib's actions for a camera whose lens is known: pictures without the fisheye, its place, the microphones."""

import math
import os

import click

from avcli.commands.avcalib_pictures import (
    POSITIVE,
    Size,
    board_options,
    check_sources,
    parse_board,
    rate_option,
    read_camera,
    views_for,
    write_camera,
)
from avcli.commands.filter import common


def _known_camera(session):
    if not session.has_config:
        session.usage("-c FILE (a config.json, or what `avcalib calibrate` wrote) or -C DIR is needed")
    return read_camera(session, session.config_path)


# --- undistort --------------------------------------------------------------------------------------------------------


@click.command("undistort", epilog="Example: avcalib undistort film.mp4 -c camera.json --to straight.mp4")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@click.option(
    "--to",
    "target",
    required=True,
    metavar="PATH",
    help="Where the pictures go: a folder, a picture file (of one source), or a video (.mp4, .avi, .mkv).",
)
@click.option(
    "--projection",
    type=click.Choice(["perspective", "cylindrical", "whole"]),
    default="perspective",
    show_default=True,
    help="perspective: straight lines stay straight. cylindrical: upright lines do, and it goes round further. "
    "whole: all that the lens sees, as azimuth and elevation.",
)
@click.option(
    "--balance",
    type=click.FloatRange(0, 1),
    default=0.0,
    show_default=True,
    help="Of a perspective picture: 0 shows what the camera fills to the last corner, 1 all it sees up to 80 degrees.",
)
@click.option(
    "--fov", type=click.FloatRange(1, 360), metavar="DEG", help="Width of the view in degrees, instead of --balance."
)
@click.option("--size", type=Size(), help="Size of the new pictures in px.  [default: as the camera's]")
@rate_option(None)
@common()
def undistort_command(session, sources, target, projection, balance, fov, size, rate):
    """Straighten pictures and videos; the camera_config of the new pictures goes to the output.

    A perspective picture is a camera of its own, brown_conrady without distortion. The other projections have none.
    """
    from avcli.calibration import undistort
    from avcli.formats import footage

    lens, native, values = _known_camera(session)
    sources = check_sources(session, sources)
    out_size = size or native
    limit = math.radians(float(values.get("theta_max_valid_deg", 180.0)))
    try:
        straight = undistort.straighten(
            lens,
            native,
            projection,
            out_size,
            balance=balance,
            fov=None if fov is None else math.radians(fov),
            theta_max=limit,
        )
    except ValueError as error:
        session.usage(str(error))
    single = len(sources) == 1 and not os.path.isdir(sources[0])
    try:
        sink = footage.Sink(target, out_size, rate or footage.frame_rate(sources[0]) or 10.0, single=single)
    except ValueError as error:
        session.usage(str(error))
    with sink:
        total = footage.count_pictures(sources, rate)
        for picture in session.progress(footage.pictures(sources, rate), total, "straightening"):
            if picture.image.shape[1::-1] != native:
                session.fail(
                    f"{picture.name} is {picture.image.shape[1]} × {picture.image.shape[0]} px, the camera "
                    f"{native[0]} × {native[1]} px"
                )
            with session.timing("straighten"):
                new = undistort.resample(picture.image, straight)
            with session.timing("write"):
                sink.write(picture, new)
    with session.output() as write:
        write(straight.camera_config(projection))


# --- pose -------------------------------------------------------------------------------------------------------------


@click.command("pose", epilog="Example: avcalib pose floor.png -C lab --board 7x10 --square 95")
@click.argument("sources", nargs=-1, metavar="[SOURCE]...")
@click.option(
    "--points",
    metavar="FILE",
    help="CSV with a header u,v,x,y,z: pixels and the room points in metres that are seen there.",
)
@board_options("7x10")
@click.option(
    "--at",
    nargs=3,
    type=float,
    metavar="X Y Z",
    help="Room position in m of the board's middle.",
)
@click.option(
    "--yaw",
    type=float,
    default=0.0,
    show_default=True,
    metavar="DEG",
    help="Direction in which the board's rows run, in degrees from +x, counter-clockwise seen from above.",
)
@rate_option()
@click.option(
    "--sigma",
    type=POSITIVE,
    metavar="PX",
    help="Standard deviation of a pixel, for the covariance.  [default: from the residuals]",
)
@common()
def pose_command(session, sources, points, board_text, square, charuco, at, yaw, rate, sigma):
    """Find where a calibrated camera hangs in the room and how it is turned, with its covariance.

    From a board that lies face up at a known place, or from pixels whose room points were measured.
    """
    from avcli.calibration import place

    lens, size, values = _known_camera(session)
    if bool(points) == bool(sources):
        session.usage("give either pictures of a board on the floor (with --at X Y Z), or --points FILE")
    if points:
        with session.open(points) as stream:
            choices = [place.parse_points(stream.read(), points)]
    else:
        if not at:
            session.usage("--at X Y Z is needed: where the middle of the board lies")
        board = parse_board(session, board_text, square, charuco)
        seen = views_for(session, sources, board, rate, size, session.config_path)
        choices = place.board_choices(seen.board, seen.views, at, math.radians(yaw))
    found = [place.locate(lens, *choice, sigma) for choice in choices]
    known = values.get("camera_position_m")
    rotation = values.get("camera_rotation_deg", [90.0, 0.0, 0.0])
    best = place.nearest(found, known, rotation) if known else found[0]
    for line in place.words(best, [] if known else found[1:]):
        session.warn(line)
    result = best.camera_config()
    if session.output_path != "-":
        with session.output() as write:
            write({**values, **result})
        return
    write_camera(session, result)


# --- microphones ------------------------------------------------------------------------------------------------------


@click.command("microphones", epilog="Example: avcalib microphones -C lab smooth.jsonl")
@click.argument("tracks", metavar="TRACKS")
@click.option(
    "--audio",
    multiple=True,
    metavar="FILE",
    help="Sound with a channel a microphone, from time 0 on; may be repeated for what follows.  "
    "[default: DIR/audio/wav, each from the time in its name]",
)
@click.option(
    "--mouth-height",
    type=click.FloatRange(0.3, 2.2),
    default=1.6,
    show_default=True,
    metavar="M",
    help="Height of the mouth in m, where the records do not say where it is.",
)
@click.option("--write", "write_config", is_flag=True, help="Write the found positions into config.json.")
@common()
def microphones_command(session, tracks, audio, mouth_height, write_config):
    """Check microphone positions and the clock between sound and picture by a person who walks and talks.

    TRACKS are records with one person in the room (tracks, or ground truth). Says for each microphone how far it seems
    to hang from where it was measured, and how sure that is.
    """
    from avcli.calibration import microphones
    from avcli.formats import records
    from avcli.localization import tdoa

    track = session.records([tracks], lambda record, bad: (record, records.identified(record, bad)))
    times, path = microphones.mouths(
        [(p.timestamp, p.positions[0], r["objects"][0].get("mouth_position")) for r, p in track if len(p) == 1],
        mouth_height,
    )
    positions, speed = session.config.microphones.positions, session.config.room.speed_of_sound_m_s
    heard = []
    with session.timing("delays"):
        for start, samples, rate in _sounds(session, audio):
            if samples.shape[1] != len(positions):
                session.fail(f"the sound has {samples.shape[1]} channels, config.json {len(positions)} microphones")
            middles, delays = tdoa.pair_delays(samples, rate, positions, speed)
            heard.append((start + middles, delays))
    with session.timing("fit"):
        result = microphones.align(microphones.joined(heard, len(positions)), times, path, positions, speed)
    for line in microphones.words(result):
        session.warn(line)
    with session.output() as write:
        write(result.record())
    if write_config:
        _write_microphones(session, result)


def _sounds(session, audio):
    """Yield (start in s, samples (n, channels), Hz) of each sound file."""
    from avcli.formats import media

    if audio:
        start = 0.0
        for path in audio:
            if not os.path.exists(path):
                session.usage(f"{path}: no such file")
            samples, rate = media.read_audio(path)
            yield start, samples, rate
            start += len(samples) / rate
        return
    folder = session.experiment / "audio" / "wav"
    files = sorted(folder.glob("multichannel_audio_*")) if folder.is_dir() else []
    if not files:
        session.usage(f"no sound in {folder}: name it with --audio")
    for path in files:
        samples, rate = media.read_audio(path)
        yield float(path.stem.rsplit("_", 1)[1]), samples, rate


def _write_microphones(session, result):
    import copy

    from avcli.formats import experiment

    if not result.improves:
        session.warn("config.json is left as it was: the found positions are no better than those in it")
        return
    raw = copy.deepcopy(dict(session.config.raw))
    listed = raw["microphone_config"]["mic_positions_m"]
    for i, position in enumerate(result.positions.tolist()):
        if isinstance(listed[i], dict):
            listed[i]["position"] = position
        else:
            listed[i] = position
    experiment.write_config(session.config_path, raw)
