"""The camera's pictures for a page: small JPEGs inside it, or a film beside it."""

import base64
import shutil
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from avcli.formats import atomic
from avcli.formats.media import MediaError, quiet_decoders

_WIDTH_PX = 720
_PLAYED = {".webm": {"VP80", "VP90", "AV01"}, ".mp4": {"H264", "AVC1", "VP09", "VP90", "AV01"}}
"""Codecs (FourCC) that browsers play, by the container."""

Read = Callable[[], np.ndarray]
"""Reads one picture (h, w, 3) uint8 RGB; raises MediaError."""
Timed = tuple[float, Read]
"""A picture and its time in s."""


def jpeg(image: np.ndarray, width: int = _WIDTH_PX) -> bytes:
    """Make a small JPEG of a camera frame (h, w, 3) uint8 RGB, as a page shows it."""
    import cv2

    small = cv2.cvtColor(_reduced(image, width), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 72])[1].tobytes()


def inside(pictures: Iterable[Timed], say: Callable[[str], None]) -> dict[str, Any] | None:
    """Return pictures as data URLs with their times; None where there are none.

    Args:
        pictures: in order of time.
        say: is called with a sentence if some cannot be read.
    """
    shown = [(round(time, 4), data_url(image)) for time, image in _read(pictures, say)]
    return {"t": [time for time, _ in shown], "jpegs": [url for _, url in shown]} if shown else None


def data_url(image: np.ndarray) -> str:
    """Return a small JPEG of a camera frame (h, w, 3) uint8 RGB as a data URL."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(image)).decode()


def rate(pictures: Iterable[Timed], camera_hz: float) -> float:
    """Return how many pictures a second a film of them needs: fewer than the camera takes if most are left out."""
    times = [time for time, _ in pictures] if isinstance(pictures, list) else []
    steps = sorted(after - before for before, after in pairwise(times))
    own = 1 / steps[len(steps) // 2] if steps and steps[len(steps) // 2] > 0 else camera_hz
    return own if own < 0.9 * camera_hz else camera_hz


def film(pictures: Iterable[Timed], rate_hz: float, path: Path, say: Callable[[str], None]) -> dict[str, Any] | None:
    """Write pictures as a film beside a page (WebM, VP8, which browsers play and OpenCV writes without other programs).

    Args:
        pictures: in order of time.
        rate_hz: pictures in a second; one that is missing is replaced by the one before it.
        path: of the film.
        say: is called with a sentence if some cannot be read.

    Returns:
        Its name, its "start" in s and its "rate" in Hz; None where there is no picture.
    """
    import cv2

    writer, start, written, last = None, 0.0, 0, None
    with atomic.replacing(path, path.suffix) as temporary:
        for time, image in _read(pictures, say):
            small = cv2.cvtColor(_reduced(image, _WIDTH_PX), cv2.COLOR_RGB2BGR)
            if writer is None:
                start = time
                quiet_decoders()
                codec = cv2.VideoWriter.fourcc(*"VP80")
                writer = cv2.VideoWriter(str(temporary), codec, rate_hz, (small.shape[1], small.shape[0]))
                if not writer.isOpened():
                    raise MediaError(f"{path}: OpenCV writes no film of the kind WebM here")
            while last is not None and written < round((time - start) * rate_hz):
                writer.write(last)
                written += 1
            last = small
        if writer is None or last is None:
            temporary.touch()
        else:
            writer.write(last)
            writer.release()
    if writer is None:
        path.unlink()
        return None
    return {"src": path.name, "start": start, "rate": rate_hz}


def copied(source: Path, path: Path, start_s: float, rate_hz: float) -> dict[str, Any]:
    """Copy a film that browsers play beside a page; return what `film` returns.

    Args:
        source: the film.
        path: of the copy.
        start_s: time of its first picture.
        rate_hz: pictures in a second.

    Raises:
        OSError: it cannot be copied.
    """
    with atomic.replacing(path, path.suffix) as temporary:
        shutil.copyfile(source, temporary)
    return {"src": path.name, "start": start_s, "rate": rate_hz}


def as_browsers_play(path: Path) -> str | None:
    """Return the extension of a film that browsers play and that is shown as the sensor saw it; None of others.

    H.264, VP8, VP9 or AV1 with 4:2:0 pixels of 8 bits, in WebM or MP4, without a note that it is to be turned or
    stretched: a lens is known for the pixels as they are.
    """
    with open(path, "rb") as file:
        head = file.read(64)
    is_mp4 = head[4:8] == b"ftyp" and head[8:12] != b"qt  "
    container = ".mp4" if is_mp4 else ".webm" if head[:4] == b"\x1aE\xdf\xa3" and b"webm" in head else None
    if container is None:
        return None
    import cv2

    quiet_decoders()
    capture = cv2.VideoCapture(str(path))
    kinds = [int(capture.get(kind)) for kind in (cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_CODEC_PIXEL_FORMAT)]
    codec, pixels = (kind.to_bytes(4, "little").decode("latin-1").upper() for kind in kinds)
    turned = capture.get(cv2.CAP_PROP_ORIENTATION_META)
    across, down = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    capture.release()
    plain = not turned and across in (0, down) and pixels in ("I420", "YV12")
    return container if plain and codec in _PLAYED[container] else None


def _reduced(image: np.ndarray, width: int) -> np.ndarray:
    import cv2

    h, w = image.shape[:2]
    scale = min(1.0, width / w)
    size = max(2, round(w * scale / 2) * 2), max(2, round(h * scale / 2) * 2)
    while image.shape[1] >= 2 * size[0] and image.shape[0] >= 2 * size[1]:  # in a seventh of the time of one INTER_AREA
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)


def _read(pictures: Iterable[Timed], say: Callable[[str], None]) -> Iterator[tuple[float, np.ndarray]]:
    count, lacking = 0, list[MediaError]()
    for time, read in pictures:
        count += 1
        try:
            yield time, read()
        except MediaError as error:
            lacking.append(error)
    if lacking:
        say(f"{len(lacking)} of {count} camera frames are missing; the first is {lacking[0]}")
