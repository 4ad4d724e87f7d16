"""avdetect-video: where the people stand, from a ceiling camera's pictures."""

import contextlib
import re
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path

import click

from avcli.commands import filter

VIDEOS = {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ogv"}
AHEAD = 3
"""Frames that are decoded ahead of use where that cannot hold up a live pipeline."""

WALL_M = 0.3
"""m; who is found farther than this behind a wall is a reflection, or a box that was misread."""


@dataclass(frozen=True)
class Shot:
    """One time step: what loads its pictures, None where it has none; depth as whole steps."""

    timestamp: float
    rgb: Callable | None
    depth: Callable | None


def _size(_context, _parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", value)
    if not match or not all(32 <= int(side) <= 4096 for side in match.groups()):
        raise click.BadParameter(f"expected WIDTHxHEIGHT from 32x32 to 4096x4096, found {value!r}")
    return int(match[1]), int(match[2])


@click.command("avdetect-video", cls=filter.Filter, epilog="Example: avdetect-video -C out/s1 scene.jsonl -o v.jsonl")
@click.argument("files", nargs=-1, metavar="[FILE]...")
@click.option(
    "--detector",
    type=click.Choice(["net", "depth"]),
    default="net",
    show_default=True,
    help="How people are found: net, a network in the colour picture; depth, what stands before the empty room's "
    "depth.",
)
@click.option(
    "--model",
    metavar="FILE",
    help="ONNX file of a YOLO export to find people with. [default: the package's own small network]",
)
@click.option(
    "--confidence",
    type=click.FloatRange(0.0, 1.0),
    default=0.5,
    show_default=True,
    help="Least score of a person that the network finds.",
)
@click.option(
    "--iou",
    type=click.FloatRange(0.0, 1.0),
    help="Two of the network's boxes that share more than this fraction of their union are one person. "
    "[default: the model's, else 0.7]",
)
@click.option(
    "--imgsz",
    metavar="WxH",
    callback=_size,
    help="Size in pixels at which the network looks, if the model leaves it open. [default: the model's, else 640x384]",
)
@click.option("--monocular", is_flag=True, help="Place people by the colour picture alone, even if there is depth.")
@click.option(
    "--position",
    type=click.Choice(["body", "centre"]),
    default="body",
    show_default=True,
    help="What a position with depth is: body, the body's axis from all its pixels; centre, the surface at the one "
    "pixel in the middle of the box, as the thesis had it.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.0, min_open=True),
    metavar="HZ",
    help="Time steps a second of image files, a video or a camera. [default: the video's own, else config.json's]",
)
@click.option(
    "--threads",
    type=click.IntRange(1, 64),
    default=1,
    show_default=True,
    help="Threads of the network; more than one pays only on an idle machine.",
)
@click.option(
    "--refresh",
    type=click.IntRange(1),
    default=10,
    show_default=True,
    metavar="N",
    help="The network looks at the whole of every N-th picture, and of the others only at what has changed; 1: at the "
    "whole of each.",
)
@click.option("--overlay", metavar="FILE.mp4|DIR", help="Draw what was found into a video, or into PNG files in DIR.")
@filter.common(skip_invalid=True, presets={"thesis": {"position": "centre", "iou": 0.7}})
def main(session, files, detector, model, rate, overlay, position, **options):
    """Find the people in a ceiling camera's pictures and write where they stand.

    FILE is a stream of frame records (- or none: standard input), image files, a directory of them, a video, or a
    camera (/dev/video0). Each frame gives one localization record: for each person a position on the body's axis in the
    room, its covariance, the height, the box in the picture and a score. The camera's lens and place come from
    config.json.
    """
    if model and detector == "depth":
        session.usage("--model is for --detector net")
    network = detector == "net"
    if options["monocular"] and not network:
        session.usage("--monocular places what a network has found: it is for --detector net")
    with session.output() as write, contextlib.ExitStack() as stack:
        shots = _shots(session, files, rate, pictures_are_depth=not network)
        pool = stack.enter_context(ThreadPoolExecutor(2))
        watcher = None
        drawing = stack.enter_context(_Overlay(overlay, session)) if overlay else None
        for shot, rgb, depth in _decoded(shots, pool, network or bool(overlay), not network, files):
            if watcher is None:
                with session.timing("start"):
                    watcher = _Watcher(session, network, model, position, options)
            people = watcher.people(shot, rgb, depth)
            if people is None:
                continue
            people = [person for person in people if watcher.in_room(person)]
            write({"timestamp": shot.timestamp, "sensor": "video", "objects": [_object(person) for person in people]})
            if drawing:
                drawing.add(shot.timestamp, rgb.result() if rgb else None, people, watcher.view)


class _Watcher:
    """What turns a shot into people: the camera of config.json, a network or the empty room, and the checks between."""

    def __init__(self, session, network: bool, model: str | None, position: str, options: dict):
        from avcli.detection.depth import DepthDetector
        from avcli.detection.gate import Gate
        from avcli.detection.view import View

        self.session, self.position, self.monocular = session, position, options["monocular"]
        self.camera = session.config.camera
        self.size = self.camera.width_px, self.camera.height_px
        self.view = View(self.camera.lens, self.camera.T_room_camera, self.size, self.camera.theta_max)
        self.network = self._network(model, options) if network else None
        self.gate, self.last = Gate(options["refresh"]), []
        self.by_box = DepthDetector(self.view, None)
        known = "room_dimensions_m" in session.config.raw.get("room_config", {})
        self.room = session.config.room.dimensions if known else None

    @cached_property
    def detector(self):
        """The detector that knows the empty room, whose picture is read when there is depth to compare with it."""
        from avcli.detection.depth import DepthDetector

        return DepthDetector(self.view, self._background(needed=self.network is None))

    def people(self, shot: Shot, rgb, depth) -> list | None:
        """The people of a shot, None where its pictures cannot be read and --skip-invalid passes over them."""
        from avcli.formats.media import MediaError

        try:
            if self.network is None:
                if depth is None:
                    raise MediaError(f"t = {shot.timestamp:.4f} s: the record names no depth picture")
                with self.session.timing("wait for pictures"):
                    picture = depth.result()
                with self.session.timing("depth and positions"):
                    return self.detector.detect(self._metres(picture, shot))
            if rgb is None:
                raise MediaError(f"t = {shot.timestamp:.4f} s: the record names no colour picture")
            with self.session.timing("wait for pictures"):
                picture = rgb.result()
            self._check_size(picture, shot, "colour")
            regions = self.gate.changes(picture)
            if len(regions):
                self.last = self._look(picture, regions, shot)
            return self.last
        except MediaError as error:
            if not self.session.skip_invalid:
                raise
            self.session.warn(f"skipped: {error}", kind="a frame that cannot be read was skipped")
            return None

    def _look(self, picture, regions, shot: Shot) -> list:
        with self.session.timing("network"):
            found = self.network.detect(picture, regions)
        if not len(found):
            return []
        with self.session.timing("depth and positions"):
            metres = self._metres(shot.depth(), shot) if shot.depth and not self.monocular else None
            return self._placed(found, metres)

    def in_room(self, person) -> bool:
        """Whether a person stands within the walls, if config.json says where they are."""
        x, y = person.position[:2]
        return self.room is None or (-WALL_M < x < self.room[0] + WALL_M and -WALL_M < y < self.room[1] + WALL_M)

    def _placed(self, found, metres):
        from avcli.detection.depth import place_centre

        if self.position == "centre" and metres is not None:
            return place_centre(found, metres, self.view)
        return (self.by_box if metres is None else self.detector).place(found, metres)

    def _network(self, model: str | None, options: dict):
        from avcli.detection.network import ModelError, Network
        from avcli.formats import media

        try:
            if model is None:
                content = (resources.files("avcli.detection") / "people.onnx").read_bytes()
            else:
                content = media.read_bytes(model)
        except media.MediaError as error:
            self.session.usage(str(error))
        try:
            return Network(content, options["imgsz"], options["confidence"], options["iou"], options["threads"])
        except ModelError as error:
            self.session.fail(f"{model}: {error}")

    def _background(self, *, needed: bool):
        from avcli.formats import media

        path = self.camera.background_depth
        if path is None:
            if needed:
                self.session.fail(
                    f'{self.session.config.name}: camera_config names no "background_depth", the empty room\'s depth '
                    "picture, which --detector depth needs"
                )
            return None
        picture = media.read_depth(self.session.media_root / path)
        if picture.shape[::-1] != self.size:
            self.session.fail(f"{path}: {self._other_size(picture)}")
        return self.view.radial_depth(picture, self.camera.depth_step_m, self.camera.depth_kind)

    def _metres(self, picture, shot: Shot):
        self._check_size(picture, shot, "depth")
        return self.view.radial_depth(picture, self.camera.depth_step_m, self.camera.depth_kind)

    def _check_size(self, picture, shot: Shot, kind: str) -> None:
        from avcli.formats.media import MediaError

        if picture.shape[1::-1] != self.size:
            raise MediaError(f"t = {shot.timestamp:.4f} s: the {kind} picture {self._other_size(picture)}")

    def _other_size(self, picture) -> str:
        return (
            f"is {picture.shape[1]} × {picture.shape[0]}, and {self.session.config.name} says "
            f"{self.size[0]} × {self.size[1]}"
        )


def _object(person) -> dict:
    return {
        "position": person.position,
        "covariance": person.covariance,
        "score": person.score,
        "bbox_px": person.bbox_px.round(2),
        "height": person.height,
    }


# --- where the pictures come from -------------------------------------------------------------------------------------


def _shots(session, files: tuple[str, ...], rate: float | None, *, pictures_are_depth: bool) -> Iterator[Shot]:
    """Yield the time steps of all files: records, pictures, a video or a camera, told apart by name."""
    from avcli.formats import footage

    files = files or ("-",)
    moving = [file for file in files if footage.is_camera(file) or Path(file).suffix.lower() in VIDEOS]
    still = [file for file in files if Path(file).is_dir() or Path(file).suffix.lower() in footage.PICTURES]
    if len(moving) > 1 or (moving and len(files) > 1) or (still and len(still) < len(files)):
        session.usage("one video or camera at a time, or pictures only, or records only")
    missing = [file for file in (*still, *moving) if not file.isdigit() and not Path(file).exists()]
    if missing:
        session.usage(f"{missing[0]}: no such {'camera' if footage.is_camera(missing[0]) else 'file'}")
    if moving and pictures_are_depth:
        session.usage(f"{moving[0]}: a video has no depth; find people in it by --detector net")
    if moving:
        for picture in footage.pictures(moving, rate):
            yield Shot(picture.timestamp, lambda image=picture.image: image, None)
    elif still:
        yield from _picture_shots(session, still, rate, pictures_are_depth)
    else:
        yield from _record_shots(session, files)


def _record_shots(session, files: tuple[str, ...]) -> Iterator[Shot]:
    from avcli.formats import media, records

    root = session.media_root
    for frame in session.records(files, lambda record, _bad: records.frame(record)):
        if frame is not None:
            yield Shot(
                frame.timestamp,
                lambda frame=frame: media.read_rgb(root / frame.rgb),
                (lambda frame=frame: media.read_depth(root / frame.depth)) if frame.depth else None,
            )


def _picture_shots(session, files: list[str], rate: float | None, are_depth: bool) -> Iterator[Shot]:
    """Pictures in the order given; a time in every name ("RGB_frame_0.1000000000.png") is taken, else k / rate."""
    from avcli.formats import footage, media

    background = session.config.camera.background_depth  # lies beside the frames, and is none
    background = session.media_root / background if background else None
    paths = []
    for path in map(Path, files):
        inside = [path]
        if path.is_dir():
            inside = sorted(item for item in path.iterdir() if item.suffix.lower() in footage.PICTURES)
            inside = [item for item in inside if background is None or item.resolve() != background.resolve()]
        if not inside:
            session.usage(f"{path}: no pictures in this directory")
        paths += inside
    if not are_depth and media.is_depth(paths[0]):
        session.warn(f"{paths[0]} looks like a depth picture (16 bits, one channel): those are for --detector depth")
    stamps = [re.search(r"_(\d+\.\d+)$", path.stem) for path in paths]
    for index, (path, stamp) in enumerate(zip(paths, stamps, strict=True)):
        timestamp = float(stamp[1]) if all(stamps) else index / (rate or session.config.frame_rate_hz)
        if are_depth:
            yield Shot(timestamp, None, lambda path=path: media.read_depth(path))
        else:
            yield Shot(timestamp, lambda path=path: media.read_rgb(path), None)


def _decoded(shots: Iterator[Shot], pool: ThreadPoolExecutor, need_rgb: bool, need_depth: bool, files) -> Iterator:
    """Yield (shot, its colour picture, its depth picture) with the pictures as futures that are being decoded.

    Files are decoded a few frames ahead; a pipe is not read ahead, since that would hold back the frame in hand.
    """
    waiting = deque()
    ahead = AHEAD if files and all(Path(file).is_file() or Path(file).is_dir() for file in files) else 0
    for shot in shots:
        waiting.append(
            (
                shot,
                pool.submit(shot.rgb) if need_rgb and shot.rgb else None,
                pool.submit(shot.depth) if need_depth and shot.depth else None,
            )
        )
        if len(waiting) > ahead:
            yield waiting.popleft()
    yield from waiting


class _Overlay:
    """Writes frames with what was found drawn on them: a video where the name ends as one, else PNG files."""

    def __init__(self, target: str, session):
        self.target, self.session, self.writer = Path(target), session, None

    def __enter__(self) -> "_Overlay":
        return self

    def __exit__(self, *_error) -> None:
        if self.writer is not None:
            self.writer.release()

    def add(self, timestamp: float, picture, people: list, view) -> None:
        from avcli.detection.overlay import draw
        from avcli.formats import media, records

        if picture is None:
            self.session.warn("--overlay: there is no colour picture to draw on")
            return
        drawn = draw(picture, people, view)
        if self.target.suffix.lower() not in VIDEOS:
            self.target.mkdir(parents=True, exist_ok=True)
            media.write_png(self.target / f"overlay_{records.format_timestamp(timestamp)}.png", drawn)
            return
        import cv2

        if self.writer is None:
            rate = self.session.config.frame_rate_hz
            self.writer = cv2.VideoWriter(str(self.target), cv2.VideoWriter.fourcc(*"mp4v"), rate, view.size)
            if not self.writer.isOpened():
                self.session.fail(f"{self.target}: this video cannot be written")
        self.writer.write(cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR))
