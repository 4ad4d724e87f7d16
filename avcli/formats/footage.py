"""Pictures in order of time from whatever a user names (files, folders, videos, a camera, JPEGs), and out again."""

import contextlib
import errno
import os
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Container, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

import numpy as np

from avcli.formats import film
from avcli.formats.atomic import replacing, write_bytes
from avcli.formats.camera import Camera
from avcli.formats.live import Pace
from avcli.formats.media import (
    MediaError,
    decode_picture,
    encode_picture,
    jpeg_end,
    quiet_decoders,
    read_depth,
    read_picture,
    refuse_full_disk,
    swapped,
)
from avcli.formats.numbered import as_numbered, by_number

if TYPE_CHECKING:
    import cv2

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".jp2", ".npy"}
"""Extensions of single pictures."""
FOREIGN = {".heic", ".heif", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
"""Extensions of pictures that cannot be read."""
VIDEOS = {
    ".mp4": "mp4v", ".m4v": "mp4v", ".mov": "mp4v", ".mkv": "mp4v", ".mpg": "mp4v", ".mpeg": "mp4v",
    ".avi": "MJPG", ".webm": "VP80", ".ogv": "VP80",
}  # fmt: skip
"""Extensions of videos, and the codecs (FourCC) that we write them with."""
_USUAL_RATE = 30.0
"""Hz, of a video that does not say."""
_AHEAD = 3
"""Shots that are read ahead of the one in hand."""
_DAMAGED = 1000
"""Pictures of a film, one after another, that may be damaged; after more of them it has ended."""
_PATIENCE = 5.0
"""Seconds in which a stream may give damaged pictures alone; after more of them it has ended."""


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        name: its name in messages.
        timestamp: s; the number of a picture file.
        image: (height, width[, 3 RGB or 4 RGBA]) uint8 or uint16, as the sensor saw it: a note on which way is up
            (EXIF, a video's rotation) is not followed, since a lens does not turn with it.
    """

    name: str
    timestamp: float
    image: np.ndarray


@dataclass(frozen=True)
class UnreadShot:
    """What a camera saw at one time, with its pictures still in their files (`media.Shot` has them in memory).

    Attributes:
        timestamp: s.
        rgb: reads the colour picture; None where there is none.
        depth: reads the depth picture; None where there is none.
    """

    timestamp: float
    rgb: Callable[[], np.ndarray] | None
    depth: Callable[[], np.ndarray] | None


# --- what a name means ------------------------------------------------------------------------------------------------

Kind = Literal["picture", "folder", "pattern", "video", "camera", "url", "stream", "file"]

_NUMBER = re.compile(r"%0?\d*d")


@dataclass(frozen=True)
class Source:
    """One source of pictures that a user named.

    Attributes:
        name: the name: a path, a camera ("/dev/video0" or its number), an address ("rtsp://…"), or "-".
        kind: "picture"; "folder" of pictures; "pattern" of their names, such as "frame_%03d.png"; "video", also one at
            an address; "camera"; "url", a stream at an address; "stream", standard input; or "file", a name that tells
            nothing.
    """

    name: str
    kind: Kind

    @property
    def is_live(self) -> bool:
        """Whether the source may never end: a camera or a stream."""
        return self.kind in ("camera", "url", "stream")

    def files(self) -> list[Path]:
        """Return the files of a picture, a folder or a pattern, in order, by the numbers in their names; else none."""
        if self.kind in ("folder", "pattern"):
            return sorted((Path(one.name) for one in self.members() if one.kind == "picture"), key=by_number)
        return [Path(self.name)] if self.kind == "picture" else []

    def members(self) -> "list[Source]":
        """Return the pictures and videos of a folder by name, those of a pattern by number; else the source itself."""
        if self.kind == "pattern":
            return [Source(str(path), "picture") for path in self._matching()]
        if self.kind != "folder":
            return [self]
        return [Source(str(path), "picture" if _is(path, PICTURES) else "video") for path in self._inside(_SEEN)]

    def left_out(self) -> list[str]:
        """Say what a folder holds beside pictures and videos: pictures that cannot be read, and folders with some."""
        if self.kind != "folder":
            return []
        foreign = [f"{path}: {path.suffix[1:].upper()} cannot be read; convert it" for path in self._inside(FOREIGN)]
        inner = sorted(path for path in Path(self.name).iterdir() if path.is_dir() and not path.name.startswith("."))
        with_some = [f"{path}: a folder in a folder is not read; name it" for path in inner if _has_some(path)]
        return [*foreign, *with_some]

    def _matching(self) -> list[Path]:
        """The files that a pattern names, in the order of their numbers."""
        path = Path(self.name)
        before, after = _NUMBER.split(path.name, maxsplit=1)
        form = re.compile(re.escape(before) + r"(\d+)" + re.escape(after))
        inside = path.parent.iterdir() if path.parent.is_dir() else iter(())
        found = [(int(match[1]), each) for each in inside if (match := form.fullmatch(each.name))]
        return [each for _, each in sorted(found)]

    def _inside(self, suffixes: Container[str]) -> list[Path]:
        """The files with these extensions, without hidden ones (macOS puts "._a.jpg" by "a.jpg")."""
        every = sorted(Path(self.name).iterdir())
        return [path for path in every if _is(path, suffixes) and not path.name.startswith(".") and not path.is_dir()]


_SEEN = PICTURES | VIDEOS.keys()


def in_numbers(names: Iterable[str]) -> list[str]:
    """Name what folders and a shell's * hold one by one, in the order of the numbers in the names; else as they are."""
    opened: list[str] = []
    for one in map(source, as_numbered(list(names))):
        members = one.members() if one.kind == "folder" else []
        opened += sorted((member.name for member in members), key=by_number) or [one.name]
    return opened


def _is(path: Path, suffixes: Container[str]) -> bool:
    return path.suffix.lower() in suffixes


def _has_some(folder: Path) -> bool:
    try:
        return any(_is(path, _SEEN) for path in folder.iterdir())
    except OSError:  # not ours to read
        return False


def source(name: str) -> Source:
    """Tell what a name means, from its letters and, of a folder, from the file system; it need not exist."""
    suffix = Path(name).suffix.lower()
    kind: Kind = "file"
    if name == "-":
        kind = "stream"
    elif name.startswith("/dev/video") or name.isdigit():
        kind = "camera"
    elif Path(name).is_dir():
        kind = "folder"
    elif "://" in name and suffix not in VIDEOS:
        kind = "url"
    elif _NUMBER.search(Path(name).name) and suffix in PICTURES:
        kind = "pattern"
    elif "%" in name or suffix in VIDEOS:
        kind = "video"
    elif suffix in PICTURES:
        kind = "picture"
    return Source(name, kind)


def sources(names: Iterable[str]) -> list[Source]:
    """Tell what each of the names means, and check that it exists.

    Raises:
        FileNotFoundError: a file or a camera does not exist; `filename` and `strerror` say which, and what is missing.
    """
    found = [source(name) for name in names]
    for one in found:
        path, missing = one.name, "no such file or directory"
        if one.kind == "camera":
            path, missing = f"/dev/video{path.removeprefix('/dev/video')}", f"no such camera; {_cameras()}"
        if one.kind == "pattern" and not one.members():
            raise FileNotFoundError(errno.ENOENT, "no file matches this pattern", path)
        if one.kind not in ("stream", "pattern") and not _is_virtual(path) and not os.path.exists(path):
            raise FileNotFoundError(errno.ENOENT, missing, path)
    return found


def _cameras() -> str:
    """Say which cameras there are."""
    there = sorted(str(path) for path in Path("/dev").glob("video*"))
    return f"there are {', '.join(there)}" if there else "none is plugged in"


def _is_virtual(name: str) -> bool:
    """Whether no file has this very name: an address, or a pattern."""
    return "%" in name or "://" in name


def stamped(paths: list[Path], rate_hz: float) -> list[tuple[float, Path]]:
    """Give picture files their times, s: those that all their names end in ("RGB_frame_0.1000000000"), else k / rate.

    They come in the order of time, as a shell's * does not: it has 10.0 before 2.0, and img10 before img2.

    Args:
        paths: in the order of time where their names have none; those in the order of letters are a shell's, and are
            taken in the order of the numbers in their names.
        rate_hz: pictures a second where a name has no time.
    """
    paths = [Path(path) for path in as_numbered([str(path) for path in paths])]
    times = [re.search(r"_(\d+\.\d+)$", path.stem) for path in paths]
    named = all(times)
    timed = [
        (float(time[1]) if named and time else index / rate_hz, path)
        for index, (path, time) in enumerate(zip(paths, times, strict=True))
    ]
    return sorted(timed, key=lambda one: one[0])


# --- pictures in ------------------------------------------------------------------------------------------------------


def pictures(
    names: list[str],
    rate_hz: float | None = None,
    *,
    stream: BinaryIO | None = None,
    stream_rate_hz: float | None = None,
    size: tuple[int, int] | None = None,
    skip: Callable[[str], None] | None = None,
    say: Callable[[str], None] = lambda _: None,
    grey: bool = False,
    most: int | None = None,
) -> Iterator[Picture]:
    """Yield the pictures of the sources with these names one after another.

    Args:
        names: picture files, folders of them and of videos, videos (or "frame_%03d.png"), cameras, or "-" for JPEGs on
            `stream`.
        rate_hz: pictures per second to take from a video or a camera; None: all.
        stream: is read for "-"; None: standard input.
        stream_rate_hz: pictures per second to take from `stream`, by the clock, since its pictures have no times; None:
            all.
        size: width and height in px to ask of a camera.
        skip: gets a sentence for each file that cannot be read, which is then left out.
        say: gets a sentence about each video of which a part is damaged or missing.
        grey: the brightness of JPEG files and videos is enough, which is quicker.
        most: about how many pictures to take from a long video, over all its length: those that are quick to reach.

    Raises:
        MediaError: a source cannot be opened, or a picture file is broken; with `skip`, none of them gives a picture.
    """
    number, held = 0, list[str]()  # what is left out is said once there is a picture
    for member in _members(names, foreign=skip is not None):
        try:
            if isinstance(member, str):
                raise MediaError(member)
            if member.kind == "picture":
                image = read_picture(member.name, whole=skip is not None, grey=grey)
                found = iter([Picture(member.name, float(number), image)])
            elif member.kind == "stream":
                found = _stream_pictures(stream or sys.stdin.buffer, stream_rate_hz, skip or (lambda _: None))
            elif member.kind == "camera":
                found = camera_pictures(Camera(member.name, rate_hz, size))
            elif member.kind == "url":
                found = _live_pictures(member.name, rate_hz)
            else:
                found = _video_pictures(member.name, rate_hz, say, grey=grey, most=most)
            for picture in found:
                while held and skip:
                    skip(held.pop(0))
                yield picture
                number += 1
        except MediaError as error:
            if not skip or (isinstance(member, Source) and member.is_live):
                raise
            held.append(str(error))
    if held and not number:
        raise MediaError(held[0] + (f"; {len(held) - 1} more cannot be read either" if len(held) > 1 else ""))
    while held and skip:
        skip(held.pop(0))


def _members(names: list[str], *, foreign: bool) -> Iterator[Source | str]:
    """The sources, and in place of folders what they hold; a sentence for an empty one, and for `foreign` files."""
    for one in map(source, names):
        members, left_out = one.members(), one.left_out()
        yield from left_out[: None if foreign else 0 if members else 1]
        yield from members
        if not members and not left_out:
            yield without_pictures(one.name)


def without_pictures(folder: str) -> str:
    """Say that a folder has no pictures, and which folders it has: pictures are often one level below."""
    below = [one.name for one in sorted(Path(folder).glob("*/"))][:5]
    return f"{folder}: no pictures in this folder" + (
        f"; name one of its folders ({', '.join(below)})" if below else ""
    )


def count_pictures(names: list[str], rate_hz: float | None = None, most: int | None = None) -> int | None:
    """Count the pictures that `pictures` will yield, about; None if the sources do not say."""
    total = 0
    for member in (member for name in names for member in source(name).members()):
        if member.is_live:
            return None
        if member.kind == "picture":
            total += 1
            continue
        try:
            frames, fps = _length(member.name)
        except MediaError:
            return None
        if not frames > 0:
            return None
        count = int(frames if not rate_hz or not fps > rate_hz else np.ceil(frames / fps * rate_hz))
        total += count if most is None else min(count, most)
    return total


def is_decoded_whole(names: list[str], rate_hz: float, most: int) -> bool:
    """Whether a film is so long that `pictures` takes `most` of it, but has too few key frames to reach those alone."""
    for member in (member for name in names for member in source(name).members()):
        if member.kind not in ("video", "file"):
            continue
        frames, fps = _length(member.name)
        if fps > 0 and frames / fps * rate_hz > most and film.quick_frames(member.name, frames / most) is None:
            return True
    return False


def frame_rate(name: str) -> float | None:
    """Frames per second of a video, Hz; None for pictures and folders, and if the video does not say."""
    if source(name).kind not in ("video", "file"):
        return None
    fps = _length(name)[1]
    return fps if 0 < fps < 1000 else None


def rate_taken(name: str, rate_hz: float | None) -> float | None:
    """Pictures per second of a source of which `rate_hz` are wanted: no more than a video has; None: not known."""
    known = [rate for rate in (frame_rate(name), rate_hz) if rate]
    return min(known, default=None)


def _length(name: str) -> tuple[float, float]:
    """Frames of a video and frames a second, as its header states them; both may be wrong."""
    import cv2

    capture = _open_video(name)
    frames, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    return frames, fps


def _open_video(source: str, *, deep: bool = False) -> "cv2.VideoCapture":
    quiet_decoders()
    import cv2

    if not _is_virtual(source) and not os.path.getsize(source):
        raise MediaError(f"{source}: the file is empty")
    capture = cv2.VideoCapture(source, cv2.CAP_ANY, [cv2.CAP_PROP_CONVERT_RGB, 0] if deep else [])
    if not capture.isOpened():
        what = "no stream of pictures answers there" if "://" in source else "neither a video nor a picture"
        raise MediaError(f"{source}: {what} that can be opened")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _live_pictures(address: str, rate_hz: float | None) -> Iterator[Picture]:
    """Pictures of a stream at an address, with Unix time; at most `rate_hz` a second."""
    capture, pace, number = _open_video(address), Pace(rate_hz), 0
    try:
        for _ in _grabs(capture):
            now = time.time()
            if not pace.takes():
                continue
            good, image = capture.retrieve()
            if good:
                number += 1
                yield Picture(f"{address} at {now:.2f}", now, swapped(image) if image.ndim == 3 else image)
    finally:
        capture.release()
    if not number:
        raise MediaError(f"{address}: the stream has no picture that can be read")


def depth_pictures(
    name: str, rate_hz: float | None = None, say: Callable[[str], None] = lambda _: None
) -> Iterator[Picture]:
    """Yield the pictures (height, width) uint16 of a film of depth, whose format must keep 16 bits (FFV1, gray16le).

    Args:
        name: of the film.
        rate_hz: pictures per second to take; None: all.
        say: gets a sentence if a part of the film is damaged or missing.

    Raises:
        MediaError: it cannot be opened, or has other pictures.
    """
    for picture in _video_pictures(name, rate_hz, say, deep=True):
        image = picture.image
        if image.dtype != np.uint16 or image.size != image.shape[0] * image.shape[1]:
            raise MediaError(f"{name}: this film does not keep depth in 16 bits; write it as FFV1 with gray16le pixels")
        yield Picture(picture.name, picture.timestamp, image.reshape(image.shape[:2]))


def depths(name: str, say: Callable[[str], None] = lambda _: None) -> Iterator[np.ndarray]:
    """Yield the depth pictures (height, width) of a film, a folder, a pattern or a picture; `say`: as depth_pictures.

    Raises:
        MediaError: one of them cannot be read, or there is none.
    """
    files = source(name).files()
    if files:
        yield from map(read_depth, files)
    else:
        yield from (picture.image for picture in depth_pictures(name, say=say))


def _video_pictures(
    source: str,
    rate_hz: float | None,
    say: Callable[[str], None],
    *,
    deep: bool = False,
    grey: bool = False,
    most: int | None = None,
) -> Iterator[Picture]:
    import cv2

    capture = _open_video(source, deep=deep)
    fps, frames = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    fps = fps if 0 < fps < 1000 else _USUAL_RATE
    jumps: list[int] | None = None
    if most and rate_hz and frames / fps * rate_hz > most:
        rate_hz = most * fps / frames
        jumps = film.quick_frames(source, fps / rate_hz)
    number, due, last, damaged = 0, 0.0, -1.0, 0
    try:
        for now, lost in _jumping(capture, jumps) if jumps else _playing(capture, fps):
            number, damaged = number + 1, damaged + lost
            if now <= last or (rate_hz and not jumps and now < due - 0.5 / fps):
                continue
            last = now
            good, image = capture.retrieve()
            if good:
                if image.ndim == 3 and not deep:
                    image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if grey else image[:, :, ::-1]
                yield Picture(f"{source} at {now:.2f} s", now, image)
            else:
                damaged += 1
            if rate_hz:
                due = max(due + 1 / rate_hz, now + 0.5 / rate_hz)
    finally:
        capture.release()
    if number == 0:
        raise MediaError(f"{source}: the video has no picture that can be read")
    stated = frames / fps
    if not jumps and stated - now > max(1.0, 0.02 * stated):
        say(f"{source}: its header states {stated:.1f} s, but it ends after {now:.1f} s: the rest is missing")
    elif source.lower().endswith(".avi") and not jumps:  # others state no exact number
        damaged = max(damaged, int(frames) - number)
    if damaged:
        say(f"{source}: damaged pictures are left out: {damaged}")


def _grabs(capture: "cv2.VideoCapture") -> Iterator[int]:
    """Grab one picture after another, past damaged ones; yields how many of these lay before each."""
    while True:
        damaged, until = 0, time.monotonic() + _PATIENCE
        while not capture.grab():
            damaged += 1
            if damaged > _DAMAGED or time.monotonic() > until:
                return
        yield damaged


def _playing(capture: "cv2.VideoCapture", fps: float) -> Iterator[tuple[float, int]]:
    """Grab one frame of a video after another; yields the time of each, s, which rises, and damaged ones before it."""
    import cv2

    last, first = -1.0, True
    for damaged in _grabs(capture):
        stated = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        now = stated if stated > last else max(last, 0.0) + 1 / fps
        now = 0.0 if first and now <= 1 / fps + 1e-9 else now
        first, last = False, now
        yield now, damaged


def _jumping(capture: "cv2.VideoCapture", frames: list[int]) -> Iterator[tuple[float, int]]:
    """Grab some frames of a video; yields the time of each, s, and 0."""
    import cv2

    for frame in frames:
        if capture.set(cv2.CAP_PROP_POS_FRAMES, frame) and capture.grab():
            yield capture.get(cv2.CAP_PROP_POS_MSEC) / 1000, 0


def camera_pictures(camera: Camera) -> Iterator[Picture]:
    """Yield the pictures of a live camera, with Unix time."""
    for now, image in camera.pictures():
        yield Picture(f"{camera.name} at {now:.2f}", now, image)


def _stream_pictures(stream: BinaryIO, rate_hz: float | None, skip: Callable[[str], None]) -> Iterator[Picture]:
    """Pictures of a stream of JPEGs, such as "ffmpeg -f mjpeg -" and USB cameras send."""
    number, thinned, pace = 0, 0, Pace(rate_hz)
    for content in _jpegs(stream):
        number += 1
        if not pace.takes():
            thinned += 1
            continue
        image = decode_picture(content)
        if image is None:
            skip(f"<stdin>: picture {number} of the stream cannot be read")
        else:
            yield Picture(f"<stdin> picture {number}", float(number - 1), image)
    if thinned:
        skip(f"<stdin>: {thinned} of {number} pictures came sooner than {rate_hz:g} a second, and are left out")
    if number == 0:
        raise MediaError("<stdin>: no JPEG in this stream")


def _jpegs(stream: BinaryIO) -> Iterator[bytes]:
    """The JPEGs in a stream, one after another; what is between them is left out."""
    buffer = b""
    while chunk := stream.read1(1 << 16) if hasattr(stream, "read1") else stream.read(1 << 16):
        buffer += chunk
        while (begin := buffer.find(b"\xff\xd8\xff")) >= 0 and (end := jpeg_end(buffer, begin)) >= 0:
            yield buffer[begin:end]
            buffer = buffer[end:]
        if begin < 0:
            buffer = buffer[-2:]
        elif len(buffer) > 1 << 27:
            raise MediaError("<stdin>: not a stream of JPEGs")


def decoded_ahead(shots: Iterable[UnreadShot], *, rgb: bool, depth: bool) -> Generator[UnreadShot, None, None]:
    """Yield the same shots while the pictures of the next few are read in threads.

    A live pipeline must not be read ahead, since that holds back the shot in hand. Closing the generator does not wait
    for a picture that is being read: its file may hang.

    Args:
        shots: in the order of time.
        rgb, depth: which of the pictures will be needed of each shot.
    """
    pool = ThreadPoolExecutor(2)
    waiting: deque[UnreadShot] = deque()
    try:
        for shot in shots:
            colour = pool.submit(shot.rgb).result if rgb and shot.rgb else shot.rgb
            distance = pool.submit(shot.depth).result if depth and shot.depth else shot.depth
            waiting.append(UnreadShot(shot.timestamp, colour, distance))
            if len(waiting) > _AHEAD:
                yield waiting.popleft()
        yield from waiting
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)  # a read that hangs (a share that is gone) must not hold the end
        raise
    pool.shutdown()


# --- pictures out -----------------------------------------------------------------------------------------------------


class Sink(contextlib.ExitStack):
    """Where new pictures go: a folder, one picture file, or a video, by the extension of its name; a context manager.

    Args:
        target: path.
        size: width and height in px.
        rate_hz: of a video.
        single: whether the sources are one picture or one video, and not several.
        prefix: begins the name of a picture in a folder that comes from no file: "frame_0.1000000000.png".
        whole: whether a signal (Ctrl-C) drops a video, as an error does; otherwise it ends the video.

    Raises:
        ValueError: `target` is one picture, and the sources are not.
    """

    def __init__(
        self,
        target: str | os.PathLike,
        size: tuple[int, int],
        rate_hz: float,
        *,
        single: bool,
        prefix: str = "frame",
        whole: bool = True,
    ):
        super().__init__()
        self.path, self.size, self.rate_hz, self.prefix, self.whole = Path(target), size, rate_hz, prefix, whole
        suffix = self.path.suffix.lower()
        self._is_video = suffix in VIDEOS
        self._is_picture = bool(suffix) and not self._is_video and not self.path.is_dir()
        self._count = 0
        self._written: set[Path] = set()
        if self._is_picture and not single:
            raise ValueError(f"{target} is one picture; several need a folder or a video")

    def __enter__(self) -> "Sink":
        if self._is_video:
            self._video = self.enter_context(_video_writer(self.path, self.size, self.rate_hz, self.whole))
        elif not self._is_picture:
            self.path.mkdir(parents=True, exist_ok=True)
        return self

    def write(self, picture: Picture, image: np.ndarray) -> None:
        """Write the new image of a picture: (height, width[, 3 or 4]) uint8 or uint16.

        Raises:
            MediaError: it is the second one of a single picture, or of a kind of picture that cannot be written, or
                would replace the file that it comes from, or another one that was written.
        """
        self._count += 1
        if self._is_video:
            import cv2

            if image.dtype == np.uint16:
                image = (image >> 8).astype(np.uint8)
            colour = swapped(image)[:, :, :3] if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
            self._video.write(np.ascontiguousarray(colour))
            return
        path = self.path
        if not self._is_picture:
            stem = (
                Path(picture.name).stem if os.path.exists(picture.name) else f"{self.prefix}_{picture.timestamp:.10f}"
            )
            path = self.path / f"{stem}.png"
            if path in self._written:
                raise MediaError(f"{path} was written already; {picture.name} needs another folder")
            self._written.add(path)
        elif self._count > 1:
            raise MediaError(f"{self.path} is one picture; this source has several")
        if path.exists() and os.path.exists(picture.name) and path.samefile(picture.name):
            raise MediaError(f"{path} is an input; name another folder or file")
        try:
            content = encode_picture(image, path.suffix)
        except MediaError as error:
            raise MediaError(f"{path}: {error}") from None
        write_bytes(path, content)


@contextlib.contextmanager
def _video_writer(path: Path, size: tuple[int, int], rate_hz: float, whole: bool) -> Iterator["_Video"]:
    with contextlib.ExitStack() as stack:
        video = _Video(path, stack.enter_context(replacing(path, path.suffix)), size, rate_hz)
        try:
            yield video
        except Exception:
            video.writer.release()
            raise
        except BaseException as ending:  # Ctrl-C or a signal, by which the film of a camera usually ends
            video.writer.release()
            if not whole:
                video.check()
                stack.close()  # the film appears
            raise ending
        video.writer.release()
        video.check()


class _Video:
    """A video that OpenCV writes to a temporary file, and whose end says whether the file is good."""

    def __init__(self, path: Path, temporary: Path, size: tuple[int, int], rate_hz: float):
        quiet_decoders()
        import cv2

        self.path, self.temporary, self.count = path, temporary, 0
        codec = cv2.VideoWriter.fourcc(*VIDEOS[path.suffix.lower()])
        self.writer = cv2.VideoWriter(str(temporary), codec, rate_hz, size)
        if not self.writer.isOpened():
            refuse_full_disk(temporary, path)
            raise MediaError(f"{path}: this OpenCV cannot write such a video")

    def write(self, image: np.ndarray) -> None:
        """Append a picture, (height, width, 3) uint8 BGR."""
        self.writer.write(image)
        self.count += 1

    def check(self) -> None:
        """Refuse a video that cannot be read again: OpenCV does not say that a disk is full."""
        import cv2

        if not self.count:
            return
        refuse_full_disk(self.temporary, self.path)
        capture = cv2.VideoCapture(str(self.temporary))
        good = capture.isOpened() and capture.grab()
        capture.release()
        if not good:
            raise OSError(errno.EIO, "the video could not be written in full", str(self.path))
