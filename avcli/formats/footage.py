"""Pictures in order of time from whatever a user names (files, folders, videos, a camera, JPEGs), and out again."""

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from avcli.formats.atomic import replacing, write_bytes
from avcli.formats.media import MediaError, read_bytes

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".jp2", ".npy"}
"""Extensions of single pictures."""
VIDEOS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "mp4v"}
"""Extensions of videos that can be written, and their codecs (FourCC)."""
_STREAM_RATE = 30.0
"""Hz; a stream of JPEGs carries no times."""


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        name: what to call it in a message.
        timestamp: s; of single pictures their number.
        image: (height, width[, 3 RGB or 4 RGBA]) uint8 or uint16, as the sensor saw it: a note on which way is up
            (EXIF, a video's rotation) is not followed, since a lens does not turn with it.
    """

    name: str
    timestamp: float
    image: np.ndarray


def is_camera(source: str) -> bool:
    """Tell whether a source is a camera: "/dev/video0", or just its number."""
    return source.startswith("/dev/video") or source.isdigit()


def pictures(
    sources: list[str],
    rate_hz: float | None = None,
    *,
    stream: BinaryIO | None = None,
    size: tuple[int, int] | None = None,
) -> Iterator[Picture]:
    """Yield the pictures of the sources one after another.

    Args:
        sources: picture files, folders of them, videos (or "frame_%03d.png"), cameras, or "-" for JPEGs on `stream`.
        rate_hz: how many a second to take from a video or a camera; None takes all.
        stream: what "-" means.
        size: width and height in px to ask of a camera.

    Raises:
        MediaError: a source cannot be opened, or a picture file is broken.
    """
    number = 0
    for source in sources:
        if source == "-":
            yield from _stream_pictures(stream, rate_hz)
        elif is_camera(source):
            yield from _camera_pictures(source, rate_hz, size)
        else:
            names = [source]
            if Path(source).is_dir():
                names = sorted(str(p) for p in Path(source).iterdir() if p.suffix.lower() in PICTURES)
                if not names:
                    raise MediaError(f"{source}: no pictures in this folder")
            if "%" not in source and all(Path(name).suffix.lower() in PICTURES for name in names):
                for name in names:
                    yield Picture(name, float(number), read_picture(name))
                    number += 1
            else:
                yield from _video_pictures(source, rate_hz)


def count_pictures(sources: list[str], rate_hz: float | None = None) -> int | None:
    """Tell how many pictures `pictures` will yield, as far as files tell; None where they do not."""
    total = 0
    for source in sources:
        path = Path(source)
        if source == "-" or is_camera(source):
            return None
        if path.is_dir():
            total += sum(p.suffix.lower() in PICTURES for p in path.iterdir())
        elif path.suffix.lower() in PICTURES and "%" not in source:
            total += 1
        else:
            capture = _open_video(source)
            import cv2

            frames, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            capture.release()
            if not frames > 0:
                return None
            total += int(frames if not rate_hz or not fps > rate_hz else np.ceil(frames / fps * rate_hz))
    return total


def frame_rate(source: str) -> float | None:
    """Frames a second of a video, Hz; None of pictures, folders, and where the video does not say."""
    path = Path(source)
    if source == "-" or is_camera(source) or path.is_dir() or path.suffix.lower() in PICTURES:
        return None
    import cv2

    capture = _open_video(source)
    fps = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    return fps if 0 < fps < 1000 else None


def read_picture(path: str | os.PathLike) -> np.ndarray:
    """Read a picture file as it is, (height, width[, 3 or 4]), colours in the order red, green, blue.

    Raises:
        MediaError: the file is missing, empty or no picture.
    """
    content = read_bytes(path)
    if Path(path).suffix.lower() == ".npy":
        import io

        try:
            return np.load(io.BytesIO(content), allow_pickle=False)
        except ValueError as error:
            raise MediaError(f"{path}: a broken .npy file: {error}") from None
    image = _decode(content)
    if image is None:
        raise MediaError(f"{path}: no picture that can be read ({len(content)} bytes)")
    return image


def _decode(content: bytes) -> np.ndarray | None:
    _hush()
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return None if image is None else _swapped(image)


def _swapped(image: np.ndarray) -> np.ndarray:
    """Turn red, green, blue into OpenCV's blue, green, red, and back; grey stays grey."""
    if image.ndim == 3 and image.shape[2] in (3, 4):
        return np.ascontiguousarray(image[:, :, [2, 1, 0, 3][: image.shape[2]]])
    return image


def _hush() -> None:
    """Keep the decoders' own lines off stderr; what went wrong is said once, by us."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def _open_video(source: str):
    _hush()
    import cv2

    if "%" not in source and not os.path.getsize(source):
        raise MediaError(f"{source}: the file is empty")
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise MediaError(f"{source}: no video and no picture that can be opened")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _video_pictures(source: str, rate_hz: float | None) -> Iterator[Picture]:
    import cv2

    capture = _open_video(source)
    fps = capture.get(cv2.CAP_PROP_FPS)
    fps = fps if 0 < fps < 1000 else _STREAM_RATE
    frame, due, last = 0, 0.0, -1.0
    try:
        while capture.grab():
            stated = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            now = stated if stated > last else max(last, 0.0) + 1 / fps
            now = 0.0 if frame == 0 and now <= 1 / fps + 1e-9 else now
            frame, last = frame + 1, now
            if rate_hz and now < due - 0.5 / fps:
                continue
            good, image = capture.retrieve()
            if good:
                yield Picture(f"{source} at {now:.2f} s", now, image[:, :, ::-1] if image.ndim == 3 else image)
            if rate_hz:
                due = max(due + 1 / rate_hz, now + 0.5 / rate_hz)
    finally:
        capture.release()
    if frame == 0:
        raise MediaError(f"{source}: a video without a picture that can be read")


def _camera_pictures(source: str, rate_hz: float | None, size: tuple[int, int] | None) -> Iterator[Picture]:
    """Newest pictures of a live camera: what waits in the driver's buffer is drained, so that a picture is of now."""
    _hush()
    import cv2

    capture = cv2.VideoCapture(int(source.removeprefix("/dev/video")), cv2.CAP_V4L2)
    if not capture.isOpened():
        raise MediaError(f"{source}: the camera cannot be opened (absent, busy, or no permission)")
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*"MJPG"))
    if size:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)  # a lens that refocuses is another lens
    due = 0.0
    try:
        while capture.grab():
            now = time.time()
            if rate_hz and now < due:
                continue
            good, image = capture.retrieve()
            if not good:
                continue
            if size and image.shape[1::-1] != tuple(size):
                raise MediaError(f"{source}: gives {image.shape[1]} × {image.shape[0]} px, not {size[0]} × {size[1]}")
            yield Picture(f"{source} at {now:.2f}", now, image[:, :, ::-1])
            due = now + 1 / rate_hz if rate_hz else 0.0
    finally:
        capture.release()


def _stream_pictures(stream: BinaryIO, rate_hz: float | None) -> Iterator[Picture]:
    """Pictures of a stream of JPEGs, as "ffmpeg -f mjpeg -" and USB cameras send it."""
    buffer, number, due = b"", 0, 0.0
    while chunk := stream.read1(1 << 16) if hasattr(stream, "read1") else stream.read(1 << 16):
        buffer += chunk
        while True:
            begin = buffer.find(b"\xff\xd8\xff")
            end = buffer.find(b"\xff\xd9", begin + 2) if begin >= 0 else -1
            if end < 0:
                if begin < 0:
                    buffer = buffer[-2:]
                elif len(buffer) > 1 << 27:
                    raise MediaError("<stdin>: no stream of JPEGs")
                break
            content, buffer = buffer[begin : end + 2], buffer[end + 2 :]
            now, number = number / _STREAM_RATE, number + 1
            if rate_hz and now < due - 1e-9:
                continue
            due = now + 1 / rate_hz if rate_hz else 0.0
            image = _decode(content)
            if image is not None:
                yield Picture(f"<stdin> picture {number}", now, image)
    if number == 0:
        raise MediaError("<stdin>: no JPEG in this stream")


class Sink:
    """Where new pictures go: a folder, one picture file, or a video, whole or not at all; a context manager."""

    def __init__(self, target: str | os.PathLike, size: tuple[int, int], rate_hz: float, *, single: bool):
        """Choose by the extension of `target`.

        Args:
            target: path.
            size: width and height in px.
            rate_hz: of a video.
            single: whether the sources are one picture or one video, and not several.

        Raises:
            ValueError: `target` is one picture, and the sources are not.
        """
        self.path, self.size, self.rate_hz = Path(target), size, rate_hz
        suffix = self.path.suffix.lower()
        self._is_video = suffix in VIDEOS
        self._is_picture = bool(suffix) and not self._is_video
        self._count = 0
        if self._is_picture and not single:
            raise ValueError(f"{target} is one picture; several need a folder or a video")

    def __enter__(self) -> "Sink":
        self._stack = contextlib.ExitStack()
        if self._is_video:
            import cv2

            self._whole = self._stack.enter_context(replacing(self.path))
            self._temporary = self._whole.with_suffix(self.path.suffix)  # OpenCV looks at the extension
            self._stack.callback(self._temporary.unlink, missing_ok=True)
            codec = cv2.VideoWriter_fourcc(*VIDEOS[self.path.suffix.lower()])
            self._writer = cv2.VideoWriter(str(self._temporary), codec, self.rate_hz, self.size)
            if not self._writer.isOpened():
                error = MediaError(f"{self.path}: this OpenCV cannot write such a video")
                self._stack.__exit__(MediaError, error, None)
                raise error
        elif not self._is_picture:
            self.path.mkdir(parents=True, exist_ok=True)
        return self

    def write(self, picture: Picture, image: np.ndarray) -> None:
        """Write what became of a picture: (height, width[, 3 or 4]) uint8 or uint16.

        Raises:
            ValueError: it is the second one of a single picture, or of no kind of picture that can be written.
        """
        import cv2

        self._count += 1
        image = _swapped(image)
        if self._is_video:
            if image.dtype == np.uint16:
                image = (image >> 8).astype(np.uint8)
            colour = image[:, :, :3] if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
            self._writer.write(np.ascontiguousarray(colour))
            return
        path = self.path
        if not self._is_picture:
            stem = Path(picture.name).stem if os.path.exists(picture.name) else f"frame_{picture.timestamp:.10f}"
            path = self.path / f"{stem}.png"
        elif self._count > 1:
            raise MediaError(f"{self.path} is one picture; this source has several")
        try:
            coded, content = cv2.imencode(path.suffix, image)
        except cv2.error:
            coded = False
        if not coded:
            raise MediaError(f"{path}: no kind of picture that can be written")
        write_bytes(path, content.tobytes())

    def __exit__(self, kind, error, trace):
        if self._is_video:
            self._writer.release()
            if kind is None:
                os.replace(self._temporary, self._whole)
        return self._stack.__exit__(kind, error, trace)
