"""JSON Lines records: one object a line, checked where it enters and where it leaves.

`decode` and `encode` know the line; the functions after them turn a decoded record into arrays. A reader takes what it
knows and passes over the rest. Everything that is wrong raises RecordError, which says what was found.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np
import orjson


class RecordError(ValueError):
    """What is wrong with a record; `column` is where in its line, from 1, if that is known."""

    def __init__(self, reason: str, column: int | None = None):
        super().__init__(reason)
        self.column = column


def refuse(reason: str) -> None:
    """Refuse the whole record because of one bad object (the strict way to treat it)."""
    raise RecordError(reason)


Bad = Callable[[str], None]
"""Called with the reason for each bad object: it raises RecordError, or returns to drop that object alone."""


# --- lines ------------------------------------------------------------------------------------------------------------


def decode(line: bytes) -> dict:
    """Decode one line to a record whose "timestamp" is a float in seconds.

    Raises:
        RecordError: the line is no JSON object, or its timestamp is missing or no finite number.
    """
    try:
        record = orjson.loads(line)
    except orjson.JSONDecodeError as error:
        raise RecordError(f"no JSON: {error.msg}", error.colno) from None
    if not isinstance(record, dict):
        raise RecordError(f"expected a JSON object, found {_shown(record)}")
    record["timestamp"] = _timestamp(record)
    return record


def encode(record: Mapping) -> bytes:
    """Encode a record as one line, its "timestamp" (s) as a string with ten decimals.

    numpy arrays and numbers are written as lists and numbers.

    Raises:
        RecordError: a number in it is NaN or infinite, which JSON cannot hold.
    """
    if "timestamp" in record:
        record = {**record, "timestamp": format_timestamp(float(record["timestamp"]))}
    _refuse_non_finite(record, "")
    return orjson.dumps(record, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE, default=_listed)


def format_timestamp(seconds: float) -> str:
    """Write a time in seconds as records and media names do: "0.1000000000"."""
    if not isfinite(seconds):
        raise RecordError(f"timestamp is {seconds}")
    return f"{seconds + 0.0:.10f}" if round(seconds, 10) else "0.0000000000"


def _listed(value):
    if isinstance(value, np.ndarray):  # orjson itself takes only C-contiguous arrays of native type
        return value.tolist()
    raise TypeError(type(value).__name__)


def _refuse_non_finite(value, where: str) -> None:
    if isinstance(value, float | np.floating):
        if not isfinite(value):
            raise RecordError(f"{where or 'value'} is {float(value)}, which JSON cannot hold")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            _refuse_non_finite(item, f"{where}.{key}" if where else key)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _refuse_non_finite(item, f"{where}[{index}]")
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
        raise RecordError(f"{where or 'array'} holds NaN or infinity, which JSON cannot hold")


def _timestamp(record: Mapping) -> float:
    if "timestamp" not in record:
        raise RecordError('"timestamp" is missing')
    value = record["timestamp"]
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str) or "_" in str(value):
            raise ValueError
        seconds = float(value)
        if not isfinite(seconds):
            raise ValueError
    except (ValueError, OverflowError):
        raise RecordError(f'"timestamp" is no finite number of seconds: {_shown(value)}') from None
    return seconds


def _shown(value) -> str:
    text = orjson.dumps(value).decode()
    return text if len(text) <= 60 else text[:57] + "..."


# --- objects ----------------------------------------------------------------------------------------------------------


def _fill_with_nan(item, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        if getattr(item, name) is None:
            object.__setattr__(item, name, np.full((len(item.positions), *shape), np.nan))


@dataclass(frozen=True)
class Detections:
    """What one sensor found at one time.

    Attributes:
        timestamp: s.
        sensor: the sensor's name, None where the record does not say it.
        positions: (n, 3) m in the room frame; z is NaN where it was not given.
        covariances: (n, 3, 3) m²; NaN where none was given; a zero variance means "not observed".
        scores: (n,) probability that the detection is right; NaN where none was given.
        kind: "camera" or "microphones", None where the record does not say it.
        boxes_px: (n, 4) x0, y0, x1, y1 in the full image; NaN where none was given.
        heights: (n,) m, of people; NaN where none was given.
    """

    timestamp: float
    sensor: str | None
    positions: np.ndarray
    covariances: np.ndarray
    scores: np.ndarray
    kind: str | None = None
    boxes_px: np.ndarray = None  # type: ignore[assignment]  # NaN of the right shape where it is left out
    heights: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        _fill_with_nan(self, boxes_px=(4,), heights=())

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class Identified:
    """Ground truth or tracks at one time.

    Attributes:
        timestamp: s.
        ids: (n,) int64, unique.
        positions: (n, 3) m in the room frame; z is NaN where it was not given.
        mouths: (n, 3) m.
        speaking: (n,) of ground truth 0 or 1, of tracks a probability.
        boxes_px: (n, 4) x0, y0, x1, y1 in the full image.
        velocities: (n, 3) m/s.
        covariances: (n, 3, 3) m².
        existence: (n,) probability.
    Each from `mouths` on is NaN where the record does not give it.
    """

    timestamp: float
    ids: np.ndarray
    positions: np.ndarray
    mouths: np.ndarray = None  # type: ignore[assignment]  # NaN of the right shape where it is left out
    speaking: np.ndarray = None  # type: ignore[assignment]
    boxes_px: np.ndarray = None  # type: ignore[assignment]
    velocities: np.ndarray = None  # type: ignore[assignment]
    covariances: np.ndarray = None  # type: ignore[assignment]
    existence: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        _fill_with_nan(self, mouths=(3,), speaking=(), boxes_px=(4,), velocities=(3,), covariances=(3, 3), existence=())

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Sources:
    """Who may sound at one time.

    Attributes:
        timestamp: s.
        ids: (n,) int64, unique.
        positions: (n, 3) m, the points on the floor under the people.
        mouths: (n, 3) m; NaN where the record does not say where the mouth is.
        speaking: (n,) bool; true where the record does not say it, as the thesis's ground truth does not.
    """

    timestamp: float
    ids: np.ndarray
    positions: np.ndarray
    mouths: np.ndarray
    speaking: np.ndarray


def detections(record: Mapping, bad: Bad = refuse) -> Detections:
    """Read the detections of a decoded record.

    Raises:
        RecordError: "objects" is missing or no list, or, by `bad`, an object's position, covariance or score is wrong.
    """
    rows = []
    for index, item in enumerate(_objects(record)):
        try:
            score = item.get("score") if isinstance(item, Mapping) else None
            position = _position(item, "position", missing_z=True)
            covariance = _covariance(item)
            if score is not None and (not _is_number(score) or not 0.0 <= score <= 1.0):
                raise RecordError(f'"score" is no number from 0 to 1: {_shown(score)}')
        except RecordError as error:
            bad(f"objects[{index}]: {error}")
            continue
        rows.append((position, covariance, np.nan if score is None else float(score)))
    sensor = record.get("sensor")
    if sensor is not None and not (isinstance(sensor, str) and sensor):
        raise RecordError(f'"sensor" is no name: {_shown(sensor)}')
    return Detections(
        timestamp=record["timestamp"],
        sensor=sensor,
        positions=np.array([row[0] for row in rows], dtype=float).reshape(-1, 3),
        covariances=np.array([row[1] for row in rows], dtype=float).reshape(-1, 3, 3),
        scores=np.array([row[2] for row in rows], dtype=float),
    )


def identified(record: Mapping, bad: Bad = refuse) -> Identified:
    """Read the objects of a ground-truth or track record.

    Raises:
        RecordError: "objects" is missing or no list, or, by `bad`, an object's identity or position is wrong.
    """
    items = _identified_items(record, bad)
    return Identified(
        timestamp=record["timestamp"],
        ids=np.array([identity for identity, _, _ in items], dtype=np.int64),
        positions=np.array([position for _, position, _ in items], dtype=float).reshape(-1, 3),
    )


def sources(record: Mapping, bad: Bad = refuse) -> Sources:
    """Read who may sound, and from where, of a ground-truth record.

    Raises:
        RecordError: as `identified`, or a mouth's position or "speaking" is wrong.
    """
    rows = []
    for identity, position, item in _identified_items(record, bad):
        try:
            mouth = _position(item, "mouth_position") if "mouth_position" in item else [np.nan] * 3
            speaking = item.get("speaking", True)
            if not isinstance(speaking, bool):
                raise RecordError(f'"speaking" is neither true nor false: {_shown(speaking)}')
        except RecordError as error:
            bad(f"object_id {identity}: {error}")
            continue
        rows.append((identity, position, mouth, speaking))
    return Sources(
        timestamp=record["timestamp"],
        ids=np.array([row[0] for row in rows], dtype=np.int64),
        positions=np.array([row[1] for row in rows], dtype=float).reshape(-1, 3),
        mouths=np.array([row[2] for row in rows], dtype=float).reshape(-1, 3),
        speaking=np.array([row[3] for row in rows], dtype=bool),
    )


def _objects(record: Mapping) -> list:
    if "objects" not in record:
        raise RecordError('"objects" is missing')
    if not isinstance(record["objects"], list):
        raise RecordError(f'"objects" is no list: {_shown(record["objects"])}')
    return record["objects"]


def _identified_items(record: Mapping, bad: Bad) -> list[tuple[int, list[float], Mapping]]:
    items, seen = [], set()
    for index, item in enumerate(_objects(record)):
        try:
            position = _position(item, "position")
            identity = item.get("object_id")
            if not isinstance(identity, int) or isinstance(identity, bool) or not -(2**63) <= identity < 2**63:
                raise RecordError(f'"object_id" is no integer: {_shown(identity)}')
            if identity in seen:
                raise RecordError(f'"object_id" {identity} stands twice in one record')
        except RecordError as error:
            bad(f"objects[{index}]: {error}")
            continue
        seen.add(identity)
        items.append((identity, position, item))
    return items


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _position(item, key: str, *, missing_z: bool = False) -> list[float]:
    if not isinstance(item, Mapping):
        raise RecordError(f"expected an object, found {_shown(item)}")
    if key not in item:
        raise RecordError(f'"{key}" is missing')
    value = item[key]
    numbers = value[:2] if missing_z and isinstance(value, list) and len(value) == 3 and value[2] is None else value
    if not isinstance(value, list) or len(value) not in (2, 3) or not all(map(_is_number, numbers)):
        raise RecordError(f'"{key}" is no list of two or three finite numbers: {_shown(value)}')
    return [float(number) for number in numbers] + [np.nan] * (3 - len(numbers))


def _covariance(item: Mapping) -> np.ndarray:
    covariance = np.full((3, 3), np.nan)
    value = item.get("covariance")
    if value is None:
        return covariance
    try:
        matrix = np.array(value, dtype=float)
    except (ValueError, TypeError):
        matrix = np.empty(0)
    if matrix.shape not in ((2, 2), (3, 3)) or not np.isfinite(matrix).all():
        raise RecordError(f'"covariance" is no 2 × 2 or 3 × 3 matrix of finite numbers: {_shown(value)}')
    scale = np.abs(matrix).max()
    if np.abs(matrix - matrix.T).max() > 1e-6 * scale or np.linalg.eigvalsh(matrix)[0] < -1e-9 * scale:
        raise RecordError(f'"covariance" is not symmetric and positive: {_shown(value)}')
    size = len(matrix)
    covariance[:size, :size] = (matrix + matrix.T) / 2
    if size == 2:
        covariance[2, :] = covariance[:, 2] = 0.0  # the height was not observed
    return covariance


# --- media ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frame:
    """Where a frame's pictures lie: paths as the record has them; depth is None where the record has none."""

    timestamp: float
    rgb: str
    depth: str | None


@dataclass(frozen=True)
class AudioChunk:
    """Where a piece of sound lies: its file, the place of its first sample on the scene's clock, and its length.

    `tail_samples` says how many of its samples come after the scene's end, where nothing but reverberation is left;
    None where the record does not say it.
    """

    timestamp: float
    path: str
    start_sample: int
    num_samples: int
    sample_rate_hz: int
    num_channels: int
    tail_samples: int | None = None


def frame(record: Mapping) -> Frame | None:
    """Read a record's frame, None where the record is about something else.

    Raises:
        RecordError: the frame has no colour picture, or a path is no text.
    """
    value = record.get("frame")
    if value is None:
        return None
    if not isinstance(value, Mapping) or not isinstance(value.get("rgb"), str):
        raise RecordError(f'"frame" names no "rgb" file: {_shown(value)}')
    if not isinstance(value.get("depth"), str | None):
        raise RecordError(f'"frame": "depth" is no path: {_shown(value["depth"])}')
    return Frame(record["timestamp"], value["rgb"], value.get("depth"))


def audio(record: Mapping) -> AudioChunk | None:
    """Read a record's audio chunk, None where the record is about something else.

    Raises:
        RecordError: a key is missing or of the wrong kind.
    """
    value = record.get("audio")
    if value is None:
        return None
    if not isinstance(value, Mapping) or not isinstance(value.get("path"), str):
        raise RecordError(f'"audio" names no "path": {_shown(value)}')
    counts = []
    for key, least in (("start_sample", None), ("num_samples", 0), ("sample_rate_hz", 1), ("num_channels", 1)):
        count = value.get(key)
        if not isinstance(count, int) or isinstance(count, bool) or (least is not None and count < least):
            raise RecordError(f'"audio": "{key}" is no {"integer" if least is None else "count"}: {_shown(count)}')
        counts.append(count)
    tail = value.get("tail_samples")
    if tail is not None and (not isinstance(tail, int) or isinstance(tail, bool) or not 0 <= tail <= counts[1]):
        raise RecordError(f'"audio": "tail_samples" is no count up to "num_samples": {_shown(tail)}')
    return AudioChunk(record["timestamp"], value["path"], *counts, tail)
