"""A film of a run: the camera's picture with the tracks beside the map, the sound below, as MP4."""

import bisect
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avcli import pose
from avcli.formats import atomic
from avcli.formats.experiment import Camera
from avcli.formats.media import MediaError, quiet_decoders
from avcli.view import mp4, sound
from avcli.view.page import Shown
from avcli.view.recording import DETECTIONS, TRACKS, TRUTH, Stream

_PICTURE, _MAP, _STRIP = (960, 540), 540, 90
_INK, _PAPER, _SOFT, _VOICE, _HEARD = (33, 31, 28), (250, 251, 251), (150, 146, 140), (0, 119, 199), (160, 63, 122)
_COLORS = [(178, 114, 0), (0, 94, 213), (115, 158, 0), (167, 121, 204), (0, 159, 230), (233, 180, 86)]
"""BGR: Okabe and Ito's colours, which colour-blind people can distinguish."""
_TRAIL_S, _BODY_M, _MOUTH_M = 6.0, 1.7, 1.5
_ELLIPSE = 2.448 * np.stack([np.cos(np.linspace(0, 2 * np.pi, 25)), np.sin(np.linspace(0, 2 * np.pi, 25))], axis=1)
"""The ellipse that holds 95 % of a Gaussian, of unit covariance."""
Place = Callable[[np.ndarray], np.ndarray]
"""Maps points (n, 3) in m to pixels (n, 2), NaN where they are not seen."""


def save(
    path: Path, shown: Shown, heard: sound.Track | None, camera: Camera | None, say: Callable[[str], None]
) -> None:
    """Write a film of a run, with its sound.

    H.264 and AAC where ffmpeg is installed, else VP9 and MP3, which browsers and VLC play.

    Args:
        path: of the film.
        shown: the run.
        heard: what it plays; None: it is silent.
        camera: with which it was taken; None: the map alone.
        say: is called with a sentence on what is missing.

    Raises:
        MediaError: the run has no records, or the film cannot be written.
    """
    import cv2

    times = _times(shown)
    if not times.size:
        raise MediaError(f"{path}: there are no records to film")
    quiet_decoders()
    encoder = shutil.which("ffmpeg")
    with tempfile.TemporaryDirectory() as folder, atomic.replacing(path, ".mp4") as temporary:
        silent = Path(folder) / "silent.mp4"
        size = (_PICTURE[0] + _MAP if camera else _MAP), _MAP + _STRIP
        codec = cv2.VideoWriter.fourcc(*("mp4v" if encoder else "vp09"))
        writer = cv2.VideoWriter(str(silent), codec, shown.rate_hz, size)
        if not writer.isOpened():
            raise MediaError(f"{path}: OpenCV writes no film here")
        for image in _images(shown, heard, camera, times, say):
            writer.write(image)
        writer.release()
        track = None if heard is None else _during(heard, times, shown.rate_hz)
        if encoder:
            _encode(encoder, silent, track, temporary, path)
        else:
            content = silent.read_bytes()
            temporary.write_bytes(content if track is None else mp4.with_sound(content, sound.mp3(track)))


def _times(shown: Shown) -> np.ndarray:
    ends = [row[0] for stream in shown.recording.streams for row in (stream.rows[:1] + stream.rows[-1:])]
    if not ends:
        return np.zeros(0)
    return np.arange(min(ends), max(ends) + 0.5 / shown.rate_hz, 1 / shown.rate_hz)


def _during(track: sound.Track, times: np.ndarray, rate_hz: float) -> sound.Track:
    """The sound from the first picture to the end of the last."""
    begin = round((times[0] - track.start_s) * track.rate_hz)
    count = round(len(times) / rate_hz * track.rate_hz)
    samples = np.zeros(count, np.float32)
    first, last = max(begin, 0), min(begin + count, len(track.samples))
    if last > first:
        samples[first - begin : last - begin] = track.samples[first:last]
    return sound.Track(track.name, float(times[0]), track.rate_hz, samples)


def _encode(encoder: str, silent: Path, track: sound.Track | None, target: Path, path: Path) -> None:
    import soundfile

    command = [encoder, "-loglevel", "error", "-y", "-i", str(silent)]
    if track is not None:
        heard = silent.with_suffix(".wav")
        soundfile.write(heard, track.samples, track.rate_hz)
        command += ["-i", str(heard), "-c:a", "aac"]
    command += ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-f", "mp4", str(target)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        raise MediaError(f"{path}: ffmpeg failed: {' '.join(done.stderr.split())[-300:]}")


# --- one picture ------------------------------------------------------------------------------------------------------


def _images(
    shown: Shown, heard: sound.Track | None, camera: Camera | None, times: np.ndarray, say: Callable[[str], None]
) -> Iterator[np.ndarray]:
    import cv2

    plan, to_map = _plan(shown)
    strip = _strip(heard, shown.rate_hz, times, _PICTURE[0] + _MAP if camera else _MAP)
    pictures = iter(shown.pictures)
    held: np.ndarray = np.full((*_PICTURE[::-1], 3), 40, np.uint8)
    after = next(pictures, None)
    unread = 0
    for time in times.tolist():
        while after is not None and after[0] <= time + 0.5 / shown.rate_hz:
            try:
                held = cv2.resize(after[1](), _PICTURE, interpolation=cv2.INTER_AREA)[:, :, ::-1]
            except MediaError:
                unread += 1
            after = next(pictures, None)
        room = plan.copy()
        _draw(room, shown.recording.streams, time, to_map, seen=False)
        top = room
        if camera is not None:
            picture = np.ascontiguousarray(held)
            _draw(picture, shown.recording.streams, time, _seen_by(camera), seen=True)
            top = np.hstack([picture, room])
        below = strip.copy()
        x = int((time - times[0]) / max(times[-1] - times[0], 1e-9) * (below.shape[1] - 1))
        cv2.line(below, (x, 0), (x, _STRIP), _INK, 2)
        _write(top, f"{time:.1f} s" if abs(time) < 1e6 else f"{time - times[0]:.1f} s", (12, 28), 0.7)
        yield np.vstack([top, below])
    if unread:
        say(f"{unread} camera frames are missing in the film")


def _seen_by(camera: Camera) -> Place:
    T, scale = pose.inverse(camera.T_room_camera), _PICTURE[0] / camera.width_px
    return lambda points: camera.lens.project(pose.apply(T, points)) * scale


def _plan(shown: Shown) -> tuple[np.ndarray, Place]:
    """The empty map, and how it maps points."""
    import cv2

    around = shown.surroundings
    size = np.array(around.get("room", _extent(shown.recording.streams))[:2], float)
    scale = (_MAP - 60) / max(size.max(), 0.1)
    corner = (np.array([_MAP, _MAP]) - scale * size) / 2

    def place(points: np.ndarray) -> np.ndarray:
        return corner + scale * np.stack([points[:, 0], size[1] - points[:, 1]], axis=1)

    def pixels(points: Sequence[Sequence[float]]) -> np.ndarray:
        return np.rint(place(np.array(points, float))).astype(np.int32)

    plan = np.full((_MAP, _MAP, 3), _PAPER, np.uint8)
    for piece in around.get("furniture", ()):
        cv2.fillPoly(plan, [pixels(piece["outline"])], (226, 223, 219), cv2.LINE_AA)
    if "room" in around:
        low, high = pixels([[0, 0], size.tolist()]).tolist()
        cv2.rectangle(plan, low, high, _SOFT, 2)
    for x0, y0, x1, y1 in around.get("doors", ()):
        one, other = pixels([[x0, y0], [x1, y1]]).tolist()
        cv2.line(plan, one, other, (176, 99, 11), 6)
    for number, microphone in enumerate(around.get("microphones", ()), 1):
        u, v = pixels([microphone])[0].tolist()
        cv2.circle(plan, (u, v), 5, _SOFT, 1, cv2.LINE_AA)
        cv2.putText(
            plan,
            str(number),
            (u + (7 if u < _MAP / 2 else -16), v + 4),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.38,
            _SOFT,
            1,
            cv2.LINE_AA,
        )
    return plan, place


def _extent(streams: Sequence[Stream]) -> list[float]:
    first = {TRUTH: 1, TRACKS: 1, DETECTIONS: 0}
    places = [item[first[s.kind] : first[s.kind] + 2] for s in streams for row in s.rows for item in row[1]]
    known = np.array([place for place in places if None not in place] or [[1.0, 1.0]])
    return known.max(axis=0).clip(1.0).tolist()


def _strip(heard: sound.Track | None, rate_hz: float, times: np.ndarray, width: int) -> np.ndarray:
    """The waveform over the whole time, and what it is of."""
    strip = np.full((_STRIP, width, 3), _PAPER, np.uint8)
    if heard is None:
        return strip
    track = _during(heard, times, rate_hz)
    parts = np.array_split(np.abs(track.samples), width)
    peak = np.array([part.max(initial=0.0) for part in parts]) / max(sound.loudest(track.samples), 1e-9)
    for x, tall in enumerate(np.rint(peak * (_STRIP / 2 - 6)).astype(int).tolist()):
        strip[_STRIP // 2 - tall : _STRIP // 2 + tall + 1, x] = _COLORS[0]
    _write(strip, heard.name, (8, 18), 0.5)
    return strip


def _draw(image: np.ndarray, streams: Sequence[Stream], time: float, place: Place, *, seen: bool) -> None:
    """Draw the records of one moment, on the map or into the picture that the camera has `seen`."""
    for stream in streams:
        if stream.kind == DETECTIONS:
            for found in _at(stream, time):
                _draw_found(image, stream, found, place)
    tracks = [stream for stream in streams if stream.kind == TRACKS]
    for stream in (*(one for one in streams if one.kind == TRUTH), *tracks[-1:]):
        true = stream.kind == TRUTH
        trails = {} if true else _trails(stream, time)
        for person in _at(stream, time):
            row: list[Any] = [*person, *[None] * (9 - len(person))]
            identity, x, y, speaking, _, _, *spread = row
            color = _INK if true and not seen else (255, 255, 255) if true else _color(identity)
            foot = _pixel(place(np.array([[x, y, 0.0]]))[0])
            if identity in trails:
                _lines(image, place(np.column_stack([trails[identity], np.zeros(len(trails[identity]))])), color, 2)
            if None not in spread:
                _lines(image, place(_around(x, y, spread)), color, 1)
            if foot is None:
                continue
            if true:
                _circle(image, foot, 9, color, 2)
                continue
            head = _pixel(place(np.array([[x, y, _BODY_M]]))[0]) if seen else None
            if head is not None:
                _lines(image, np.array([foot, head], float), color, 2)
            _circle(image, foot, 6, color, -1)
            if speaking is not None and speaking > 0.5:
                _circle(image, head or foot, 14, _VOICE, 3)
            at = head or foot
            _write(image, str(identity), (at[0] + 8, at[1] - 8), 0.55, color)


def _draw_found(image: np.ndarray, stream: Stream, found: list, place: Place) -> None:
    import cv2

    row: list[Any] = [*found, None, None, None]
    x, y, z = row[:3]
    if x is None:
        return
    heard = stream.sensor == "microphones"
    at = _pixel(place(np.array([[x, y, (z or _MOUTH_M) if heard else 0.0]]))[0])
    if at is not None:
        kind = cv2.MARKER_TILTED_CROSS if heard else cv2.MARKER_CROSS
        cv2.drawMarker(image, at, _HEARD if heard else _SOFT, kind, 13, 2, cv2.LINE_AA)


def _at(stream: Stream, time: float) -> list:
    """What a stream says at a time; nothing where it has said nothing for a while."""
    index = bisect.bisect_right(stream.rows, time + 1e-3, key=lambda row: row[0]) - 1
    return stream.rows[index][1] if index >= 0 and time - stream.rows[index][0] < 0.25 else []


def _trails(stream: Stream, time: float) -> Mapping[Any, list]:
    begin = bisect.bisect_right(stream.rows, time - _TRAIL_S, key=lambda row: row[0])
    end = bisect.bisect_right(stream.rows, time + 1e-3, key=lambda row: row[0])
    trails: dict[Any, list] = {}
    for row in stream.rows[begin:end]:
        for person in row[1]:
            trails.setdefault(person[0], []).append(person[1:3])
    return trails


def _around(x: float, y: float, spread: Sequence[float]) -> np.ndarray:
    xx, xy, yy = spread
    values, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
    ring = _ELLIPSE * np.sqrt(values.clip(0)) @ axes.T + [x, y]
    return np.column_stack([ring, np.zeros(len(ring))])


def _color(identity: Any) -> tuple[int, int, int]:
    number = identity if isinstance(identity, int) else sum(str(identity).encode())
    return _COLORS[number % len(_COLORS)]


def _pixel(point: np.ndarray) -> tuple[int, int] | None:
    if not (np.isfinite(point).all() and (np.abs(point) < 1e4).all()):
        return None
    return round(float(point[0])), round(float(point[1]))


def _lines(image: np.ndarray, points: np.ndarray, color: tuple[int, int, int], width: int) -> None:
    import cv2

    known = points[np.isfinite(points).all(axis=1)].clip(-1e4, 1e4)
    cv2.polylines(image, [np.rint(known * 8).astype(np.int32)], False, color, width, cv2.LINE_AA, shift=3)


def _circle(image: np.ndarray, at: tuple[int, int], radius: int, color: tuple[int, int, int], width: int) -> None:
    import cv2

    cv2.circle(image, at, radius, color, width, cv2.LINE_AA)


def _write(
    image: np.ndarray, text: str, at: tuple[int, int], size: float, color: tuple[int, int, int] = (20, 20, 20)
) -> None:
    """Write on a small white ground, which is within the image."""
    import cv2

    (wide, tall), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 2)
    x = min(max(at[0], 4), image.shape[1] - wide - 5)
    y = min(max(at[1], tall + 4), image.shape[0] - 5)
    cv2.rectangle(image, (x - 3, y - tall - 3), (x + wide + 3, y + 5), (255, 255, 255), -1, cv2.LINE_AA)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, color, 2, cv2.LINE_AA)
