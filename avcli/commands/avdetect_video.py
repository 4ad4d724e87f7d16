"""avdetect-video: the positions of people in a ceiling camera's pictures."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.commands import filter
from avcli.commands.live import newest, open_pipe
from avcli.commands.options import FiniteRange, from_settings, refuse_without_effect, settings_from
from avcli.commands.places import doubt_camera
from avcli.detection.settings import Settings
from avcli.settings import settings_of

if TYPE_CHECKING:
    from avcli.detection.body import Person
    from avcli.detection.detector import Detector
    from avcli.detection.frozen import Frozen
    from avcli.detection.mounting import Knock
    from avcli.detection.view import View
    from avcli.formats import footage, records
    from avcli.formats.experiment import Camera


PRESET = {"position": "centre", "iou": 0.7, "features": False}
"""What the thesis did."""


@click.command("avdetect-video", cls=filter.Filter, epilog="Example: avdetect-video -C out/s1 scene.jsonl -o v.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@from_settings(Settings)
@click.option(
    "--model",
    metavar="FILE",
    show_default="the package's own small network",
    help="ONNX file of a YOLO export that finds the people.",
)
@click.option(
    "--rate",
    type=FiniteRange(0.0, min_open=True),
    metavar="HZ",
    show_default="the video's own, else config.json's",
    help="Time steps per second of picture files, a video or a camera.",
)
@click.option(
    "--live",
    is_flag=True,
    help="When behind, take the newest picture and skip the older ones.  [default: with a camera]",
)
@click.option("--overlay", metavar="FILE.mp4|DIR", help="Draw the people into a video, or into PNG files in DIR.")
@filter.common(skip_invalid=True, media=True, mark_end=True, presets={"thesis": PRESET})
def main(
    session: filter.Session,
    files: tuple[str, ...],
    model: str | None,
    rate: float | None,
    live: bool,
    overlay: str | None,
    **options: Any,
) -> None:
    """Find the people in a ceiling camera's pictures and write their positions in the room.

    FILE is a stream of frame records (- or none: standard input), picture files, a folder of them, a video, a camera
    (/dev/video0), or a stream at an address (rtsp://…). Each frame gives one record. For each person it has a position
    on the body's axis, its covariance, the height, the box in the picture, and a score. The camera's lens and pose come
    from config.json.
    """
    settings = settings_from(Settings, options)
    _refuse_without_effect(settings)
    from avcli.detection.detector import detections
    from avcli.formats import footage, media, records

    session.check_outputs(
        {"--overlay": overlay if overlay and footage.source(overlay).kind == "video" else None}, files or ("-",)
    )
    media.quiet_decoders()  # OpenCV asks when it is loaded
    network = settings.detector == "net"
    session.load("cv2", *(("onnxruntime",) if network else ()))
    detector: Detector | None = None
    drawing: footage.Sink | None = None
    with session.output() as write, contextlib.ExitStack() as stack:
        shots = _shots(session, stack, files, rate, settings.sensor, live=live, depth=not network)
        if files and all(Path(file).is_file() or Path(file).is_dir() for file in files):
            colour = network or bool(overlay) or bool(settings.features)
            ahead = footage.decoded_ahead(shots, rgb=colour, depth=not network)
            shots = stack.enter_context(contextlib.closing(ahead))
        for shot in session.progress(shots, _expected(session, files, rate)):
            if detector is None:
                with session.timing("start"):
                    detector = _detector(session, model, settings, depth=shot.depth is not None)
                if overlay:
                    drawing = stack.enter_context(_sink(session, overlay, detector.view.size, rate, files))
            doubted, stopped = detector.shown_m is not None, detector.frozen.is_frozen
            knocked = detector.mounting.knock
            people = _people(session, detector, shot)
            if detector.frozen.is_frozen != stopped:
                _say_if_frozen(session, detector.frozen, shot.timestamp)
            if detector.mounting.knock and detector.mounting.knock is not knocked:
                _say_knocked(session, detector.mounting.knock)
            if not doubted:
                _doubt_depth(session, detector)
            if people is None:
                continue
            write(records.as_record(detections(shot.timestamp, people, settings.sensor)))
            if drawing:
                _draw(session, drawing, shot, people, detector.view)
        if detector is not None:
            _say_what_did_not_fit(session, detector)


def _refuse_without_effect(settings: Settings) -> None:
    if settings.detector == "depth":
        of_network = [name for name, (_, setting) in settings_of(Settings).items() if setting.only == "net"]
        refuse_without_effect(["model", *of_network], "with --detector depth")
    if settings.monocular:
        refuse_without_effect(["position"], "with --monocular")


def _detector(session: filter.Session, model: str | None, settings: Settings, *, depth: bool) -> Detector:
    from avcli.detection.detector import Detector
    from avcli.formats import media

    camera = _camera(session, settings.sensor)
    doubt_camera(session, camera.T_room_camera[:3, 3], "camera_position_m")
    path = camera.background_depth
    if path is None and settings.detector == "depth":
        session.fail(
            f'{session.config.name}: camera_config has no "background_depth", the depth picture of the empty room, '
            "which --detector depth needs"
        )

    if settings.windows and model is None:
        session.warn(
            "--windows is for networks that know people from photographs (--model): the package's own has learnt from"
            " whole pictures, and misses most people in windows"
        )
    compared = depth or settings.detector == "depth"  # colour alone cannot be compared with the empty room's depth
    empty = partial(media.read_depth, session.media_root / path) if path and compared else None
    try:
        colour = camera.background_rgb if settings.learn_background else None
        detector = Detector(
            session.config,
            background=empty,
            room_picture=media.read_rgb(session.media_root / colour) if colour else None,
            model=model,
            settings=settings,
            timing=session.timing,
        )
    except media.MediaError as error:
        session.usage(str(error))
    network = detector.network
    if network and settings.imgsz and network.size != settings.imgsz:
        refuse_without_effect(["imgsz"], "with this model: its input is always {} × {} px".format(*network.size))
    if network and network.head.kind == "end2end":
        refuse_without_effect(["iou"], "with this model: it removes overlapping boxes itself")
    return detector


def _say_if_frozen(session: filter.Session, frozen: Frozen, time: float) -> None:
    """Say that the picture stopped, or goes on, at a time in s."""
    if frozen.is_frozen:
        session.warn(
            f"the picture has been the same to the last bit since {frozen.since:.1f} s: has the camera stopped? "
            "Whoever is in it is still reported"
        )
    else:
        session.warn(f"the picture changes again at {time:.1f} s")


def _say_knocked(session: filter.Session, knock: Knock) -> None:
    """Say by how much the camera's picture has moved."""
    moved = f"moved by {knock.shift:.1%} of its shorter side"
    how = f"turned by {knock.turn_deg:.1f} degrees" if knock.turn_deg else moved
    session.warn(
        f"the picture has {how} since {knock.since:.1f} s: was the camera knocked? Positions are wrong then, until its "
        "pose is measured again (avcalib pose)"
    )


def _doubt_depth(session: filter.Session, detector: Detector) -> None:
    """Say so if the first depth shows no room: half lies far below the floor, or nearly all just below the camera."""
    if detector.shown_m is None:
        return
    (half, tenth), height = detector.shown_m, float(detector.view.origin[2])
    where = ""
    if half < -0.5:
        where = f"half of what depth shows lies {-half:.1f} m below the floor"
    elif tenth > 0.8 * height:
        where = f"nearly all that depth shows lies less than {height - tenth:.2g} m below the camera"
    if where:
        session.warn(
            f"{where}, so nobody can be found there: are depth_step_m, depth_kind and the camera's place right in "
            f"{session.config.name}?"
        )


def _camera(session: filter.Session, sensor: str) -> Camera:
    """The camera of this name that config.json has, else its only one; where cameras have names, of no unknown name."""
    from avcli.formats.sensors import MICROPHONES

    config = session.config
    if config.sensors.get(sensor) == MICROPHONES:
        session.usage(f"--sensor {sensor}: {config.name} says that these are microphones")
    named = [name for name, known in config.known_sensors.items() if known.get("camera_config") is not None]
    if named and sensor not in config.sensors and (sensor != Settings().sensor or "camera_config" not in config.raw):
        session.usage(f"--sensor {sensor}: {config.name} has no camera of this name; it has {', '.join(named)}")
    return config.camera_of(sensor) or config.camera


def _people(session: filter.Session, detector: Detector, shot: footage.UnreadShot) -> list[Person] | None:
    """Find the people of a shot; None where its pictures cannot be read and --skip-invalid passes over them."""
    from avcli.formats.media import MediaError

    try:
        return detector.look(shot.rgb, shot.depth, shot.timestamp)
    except MediaError as error:
        if not session.skip_invalid:
            session.fail(f"t = {shot.timestamp:.4f} s: {error}")
        session.warn(f"skipped: t = {shot.timestamp:.4f} s: {error}", kind="a frame that cannot be read was skipped")
        return None


def _say_what_did_not_fit(session: filter.Session, detector: Detector) -> None:
    from avcli.detection.bands import BandedNetwork

    tally = detector.tally
    if detector.windows is not None:
        seen, still = detector.windows.looked, detector.windows.skipped
        session.note_skipped("windows", still, seen + still, "in which nothing had changed", "network")
    if isinstance(detector.sight, BandedNetwork):
        session.note("the pictures are round: the network looked at two bands of each")
    session.note_skipped("pictures", tally.unchanged, tally.pictures, "in which nothing had changed", "network")
    if tally.followed:
        session.note(f"boxes with a low score that were followed from the pictures before: {tally.followed}")
    if tally.came:
        session.note(f"boxes with a low score of people who came since the film began, and move: {tally.came}")
    if tally.unexplained:
        session.warn(
            f"{tally.unexplained} of {tally.by_box} boxes that were placed without depth fit no body: people who lie, "
            'reach out or are mostly hidden, or no people; they have "explained": false and a large covariance'
            + _other_height(detector)
        )
    if tally.nowhere:
        session.warn(
            f"{tally.nowhere} boxes have no place: none of their rays reaches the floor or a body on it"
            + ("; is camera_rotation_deg right?" if tally.nowhere > tally.by_box else "")
        )
    if tally.still:
        session.warn(
            f"{tally.still} boxes showed only the room as it was learnt (--learn-background), and are left out"
        )
    if tally.held_back:
        session.warn(
            f"{tally.held_back} boxes kept too still for people, and are held back: things, or people who have hardly "
            "moved since the film began (--no-stillness reports them)"
        )
    if tally.outside:
        session.warn(f"{tally.outside} people were found more than 0.3 m behind a wall, and are left out")


def _other_height(detector: Detector) -> str:
    """Say at which height of the camera clearly more of the boxes would fit a body; nothing if at none."""
    shares = detector.explained_by_height() if detector.tally.unexplained > detector.tally.by_box / 4 else {}
    stated = float(detector.view.origin[2])
    best = max(shares, key=lambda height: shares[height], default=stated)
    now = next((share for height, share in shares.items() if abs(height - stated) < 1e-9), 1.0)
    if shares.get(best, 0.0) < now + 0.1:
        return ""
    return f"; with the camera at {best:.1f} m {shares[best]:.0%} would fit one, at the stated {stated:.1f} m {now:.0%}"


def _sink(
    session: filter.Session, target: str, size: tuple[int, int], rate: float | None, files: tuple[str, ...]
) -> footage.Sink:
    """Where the drawn pictures go; a video of them plays as fast as the one that is looked at."""
    from avcli.formats import footage

    films = [file for file in files if footage.source(file).kind == "video"]
    rate_hz = (footage.rate_taken(films[0], rate) if films else rate) or session.config.frame_rate_hz
    try:
        return footage.Sink(target, size, rate_hz, single=False, prefix="overlay", whole=False)
    except ValueError as error:
        session.usage(f"--overlay: {error}")


def _draw(
    session: filter.Session, sink: footage.Sink, shot: footage.UnreadShot, people: list[Person], view: View
) -> None:
    from avcli.detection.overlay import draw
    from avcli.formats.footage import Picture

    if shot.rgb is None:
        session.warn("--overlay: there is no colour picture to draw on")
        return
    picture = shot.rgb()
    sink.write(Picture("", shot.timestamp, picture), draw(picture, people, view))


# --- where the pictures come from -------------------------------------------------------------------------------------


def _shots(
    session: filter.Session,
    stack: contextlib.ExitStack,
    files: tuple[str, ...],
    rate: float | None,
    sensor: str,
    *,
    live: bool,
    depth: bool,
) -> Iterator[footage.UnreadShot]:
    """Return the time steps of all files: picture files, one video or camera, or else frame records."""
    from avcli.formats import footage

    try:
        sources = footage.sources(files or ("-",))
    except FileNotFoundError as error:
        session.usage(f"{error.filename}: {error.strerror}")
    moving = [source for source in sources if source.kind in ("video", "camera", "url")]
    still = [source for source in sources if source.kind in ("picture", "folder", "pattern")]
    if len(moving) > 1 or (moving and len(files) > 1) or (still and len(still) < len(files)):
        session.usage("give one video or one camera, or picture files only, or frame records only")
    if moving and depth and moving[0].is_live:
        session.usage(f"{moving[0].name}: a camera's pictures have no depth; use --detector net")
    if still or (moving and not moving[0].is_live):
        refuse_without_effect(["live"], "on files; it is for a camera, or for frame records from a pipe")
    if still:
        return _picture_shots(session, still, rate, sensor, depth=depth)
    if moving and depth:
        pictures = footage.depth_pictures(moving[0].name, rate, session.warn)
        return (footage.UnreadShot(picture.timestamp, None, picture.image.view) for picture in pictures)
    if moving:
        pictures = footage.pictures([moving[0].name], rate, say=session.warn)
        shots = (footage.UnreadShot(picture.timestamp, picture.image.view, None) for picture in pictures)
        if not moving[0].is_live:
            return shots
        return newest(session, stack, _saying_its_end(session, moving[0].name, shots))
    refuse_without_effect(["rate"], "on frame records, which have their own times")
    parse = partial(_frame, session.allow_outside)
    if not live:
        return _frames(session, session.records(files, parse))
    name, pipe = open_pipe(session, files)
    frames = session.stream_records(io.BufferedReader(pipe), name, parse)
    return newest(session, stack, _frames(session, frames), pipe.stop)


def _saying_its_end(
    session: filter.Session, name: str, shots: Iterable[footage.UnreadShot]
) -> Iterator[footage.UnreadShot]:
    """Yield what a camera sees; where it goes away, nobody would be found from then on without a word."""
    yield from shots
    session.warn(f"{name}: no more pictures come: the camera, or the connection to it, is gone")


def _expected(session: filter.Session, files: tuple[str, ...], rate: float | None) -> int | None:
    """Return the number of time steps, for a progress bar; None if it is not known, or nobody sees the bar."""
    from avcli.formats import footage

    if not (session.shows_progress and files):
        return None
    if any(one.kind == "file" for one in footage.sources(files)):
        return session.lines(files)
    return footage.count_pictures(list(files), rate)


def _frame(outside: bool, record: Any, _bad: object) -> records.Frame | None:
    from avcli.formats import records

    return records.frame(record, outside=outside)


def _frames(session: filter.Session, frames: Iterable[records.Frame | None]) -> Iterator[footage.UnreadShot]:
    """Yield the time steps of frame records; other records are passed over.

    Says so if there are no frames, or if time goes back.
    """
    from avcli.formats import footage, media
    from avcli.formats.bounds import LONGEST_GAP_S

    root, others, last = session.media_root, 0, -math.inf
    for frame in frames:
        others += frame is None
        if frame is not None:
            if frame.timestamp < last:
                late = ", and avfuse drops what comes too late" if last - frame.timestamp <= LONGEST_GAP_S else ""
                session.warn(
                    f"time goes back from {last:.4f} to {frame.timestamp:.4f} s: people are found anew from there on"
                    + late,
                    kind="a frame is earlier than the frame before it",
                )
            last = frame.timestamp
            colour = partial(media.read_rgb, root / frame.rgb) if frame.rgb else None
            distance = partial(media.read_depth, root / frame.depth) if frame.depth else None
            yield footage.UnreadShot(frame.timestamp, colour, distance)
    if others and last == -math.inf:
        session.warn(f"none of the {others} records is a frame with a picture, so nobody was looked for")


def _picture_shots(
    session: filter.Session, sources: list[footage.Source], rate: float | None, sensor: str, *, depth: bool
) -> Iterator[footage.UnreadShot]:
    """Pictures in the order given; the empty room's depth picture, which lies beside the frames, is left out."""
    from avcli.formats import media
    from avcli.formats.footage import UnreadShot, stamped, without_pictures
    from avcli.formats.numbered import missing

    background = _camera(session, sensor).background_depth
    empty = (session.media_root / background).resolve() if background else None
    paths: list[Path] = []
    for source in sources:
        inside = [path for path in source.files() if source.kind == "picture" or path.resolve() != empty]
        if not inside:
            session.usage(without_pictures(source.name))
        paths += inside
    if not depth and media.is_depth(paths[0]):
        session.warn(f"{paths[0]} looks like a depth picture (16 bits, one channel); use --detector depth for those")
    rate = rate or session.config.frame_rate_hz
    timed = stamped(paths, rate)
    counted = all(time == number / rate for number, (time, _) in enumerate(timed))  # the names have no times
    if counted and (gaps := missing([path for _, path in timed])):
        session.warn(
            f"pictures that are missing by the numbers in the names: {gaps[0]}, the first after {gaps[1]}; what "
            "follows counts as the next time step"
        )
    for timestamp, path in timed:
        if depth:
            yield UnreadShot(timestamp, None, partial(media.read_depth, path))
        else:
            yield UnreadShot(timestamp, partial(media.read_rgb, path), None)
