r"""JSON Lines records: one object a line, checked where it enters and where it leaves.

`texts` finds the records in a stream, `decode` and `encode` know the line, and the functions after them turn a decoded
record into arrays and back. Readers check the keys that they know (avcli.formats.descriptions) and ignore others.
Whatever is invalid raises RecordError, which says what was found.

    >>> from avcli.formats import records
    >>> line = b'{"timestamp": 0.1, "objects": [{"object_id": 4, "position": [1, 2, 0], "speaking": true}]}'
    >>> people = records.identified(records.decode(line))
    >>> people.ids, people.positions, people.speaking
    (array([4]), array([[1., 2., 0.]]), array([1.]))
    >>> records.encode(records.as_record(people))
    b'{"timestamp":"0.1000000000","objects":[{"object_id":4,"position":[1.0,2.0,0.0],"speaking":true}]}\n'
"""

import functools
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NoReturn

import numpy as np
import orjson

from avcli.formats import atomic, descriptions
from avcli.formats.schema import Invalid, Object, shown

LONGEST_LINE = 1 << 26
"""bytes; a longer line is not a record, and reading on would fill the memory."""


class RecordError(ValueError):
    """An invalid record; `column` is the place in its line, from 1, if that is known."""

    def __init__(self, reason: str, column: int | None = None):
        super().__init__(reason)
        self.column = column


def refuse(reason: str) -> NoReturn:
    """Refuse the whole record because of one invalid object (the strict way to treat it)."""
    raise RecordError(reason)


Bad = Callable[[str], None]
"""Called with the reason for each invalid object: it raises RecordError, or returns to drop that object alone."""


# --- lines ------------------------------------------------------------------------------------------------------------


def texts(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    r"""Yield (line number, text) of each JSON text of a stream.

    A record is a line. Two habits of other writers are read too, since the thesis's listings have them: an object
    printed over several lines (its first line is a lone brace, its last a brace in the same column), and records that
    are separated by a literal \n. Blank lines are ignored.
    """
    block: list[bytes] = []
    number, begin, indent = 0, 0, b""
    while line := stream.readline(LONGEST_LINE):
        number += 1
        if number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        text = line.strip()
        if block:
            block.append(line)
            if text in (b"}", b"},") and line[: len(line) - len(line.lstrip())] == indent:
                yield begin, b"".join(block).strip().removesuffix(b",")
                block = []
            elif sum(map(len, block)) > LONGEST_LINE:
                yield begin, b"".join(block)
                block = []
        elif text == b"{":
            block, begin, indent = [line], number, line[: len(line) - len(line.lstrip())]
        elif b"}\\n" in text:
            for part in text.replace(b"}\\n", b"}\n").split(b"\n"):
                if part.strip():
                    yield number, part.strip()
        elif text:
            yield number, text
    if block:
        yield begin, b"".join(block)


def decode(line: bytes) -> dict[str, Any]:
    """Decode one line to a record whose "timestamp" is a float in seconds.

    Raises:
        RecordError: the line is not a JSON object, is too long, or its timestamp is missing or not a finite number.
    """
    if len(line) >= LONGEST_LINE:
        raise RecordError(f"longer than {LONGEST_LINE >> 20} MiB, which is not a record")
    try:
        record = orjson.loads(line)
    except orjson.JSONDecodeError as error:
        raise RecordError(f"invalid JSON: {error.msg}", error.colno) from None
    if not isinstance(record, dict):
        raise RecordError(f"must be a JSON object, found {shown(record)}")
    if "timestamp" not in record:
        raise RecordError('"timestamp" is missing')
    try:
        record["timestamp"] = descriptions.TIMESTAMP.kind.read(record["timestamp"])
    except Invalid as error:
        raise RecordError(str(error.within("timestamp"))) from None
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
    if not math.isfinite(seconds):
        raise RecordError(f"timestamp is {seconds}")
    return f"{seconds + 0.0:.10f}" if round(seconds, 10) else "0.0000000000"


def _listed(value: Any) -> list[Any]:
    if isinstance(value, np.ndarray):  # orjson itself takes only C-contiguous arrays of native type
        return value.tolist()
    raise TypeError(type(value).__name__)


def _refuse_non_finite(value: Any, where: str) -> None:
    if isinstance(value, float | np.floating):
        if not math.isfinite(value):
            raise RecordError(f"{where or 'value'} is {float(value)}, which JSON cannot hold")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            _refuse_non_finite(item, f"{where}.{key}" if where else key)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _refuse_non_finite(item, f"{where}[{index}]")
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
        raise RecordError(f"{where or 'array'} holds NaN or infinity, which JSON cannot hold")


# --- objects ----------------------------------------------------------------------------------------------------------


_UNKNOWN = np.empty(0)
_UNKNOWN.flags.writeable = False


def _unknown() -> np.ndarray:
    """Stand for an array that is not given: NaN in the shape that the number of objects asks for."""
    return _UNKNOWN


def _fill_unknown(item: "Detections | Identified", count: int, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        if getattr(item, name) is _UNKNOWN:
            object.__setattr__(item, name, _nan((count, *shape)))


@functools.lru_cache(maxsize=256)
def _nan(shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of NaN that all records share, and that nobody can write to."""
    array = np.full(shape, np.nan)
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Detections:
    """What one sensor found at one time: n objects.

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
    covariances: np.ndarray = field(default_factory=_unknown)
    scores: np.ndarray = field(default_factory=_unknown)
    kind: str | None = None
    boxes_px: np.ndarray = field(default_factory=_unknown)
    heights: np.ndarray = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        _fill_unknown(self, len(self.positions), covariances=(3, 3), scores=(), boxes_px=(4,), heights=())

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class Identified:
    """Ground truth or tracks at one time: n people.

    Attributes:
        timestamp: s.
        ids: (n,) int64, unique.
        positions: (n, 3) m in the room frame; z is NaN where it was not given.
        mouths: (n, 3) m.
        speaking: (n,) 0 or 1 in ground truth, a probability in tracks.
        boxes_px: (n, 4) x0, y0, x1, y1 in the full image.
        velocities: (n, 3) m/s.
        covariances: (n, 3, 3) m².
        existence: (n,) probability.
    All from `mouths` on are NaN where the record does not give them.
    """

    timestamp: float
    ids: np.ndarray
    positions: np.ndarray
    mouths: np.ndarray = field(default_factory=_unknown)
    speaking: np.ndarray = field(default_factory=_unknown)
    boxes_px: np.ndarray = field(default_factory=_unknown)
    velocities: np.ndarray = field(default_factory=_unknown)
    covariances: np.ndarray = field(default_factory=_unknown)
    existence: np.ndarray = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        count = len(self.ids)
        _fill_unknown(self, count, mouths=(3,), speaking=(), boxes_px=(4,))
        _fill_unknown(self, count, velocities=(3,), covariances=(3, 3), existence=())

    def __len__(self) -> int:
        return len(self.ids)


_SENSOR = descriptions.LOCALIZATION.content.only("sensor", "kind")


def detections(record: Mapping[str, Any], bad: Bad = refuse) -> Detections:
    """Read the detections of a decoded record.

    Args:
        record: as `decode` returns it.
        bad: called with the reason for each invalid object; it raises RecordError (as `refuse` does), or returns, and
            the object is dropped.

    Raises:
        RecordError: "objects" is missing or not a list, or, by `bad`, a key of an object is invalid.
    """
    try:
        head = _SENSOR.read(record)
    except Invalid as error:
        raise RecordError(str(error)) from None
    rows = _rows(record, descriptions.DETECTION, bad)
    return Detections(
        timestamp=record["timestamp"],
        sensor=head["sensor"],
        kind=head["kind"],
        positions=_column(rows, "position", 3) if rows else np.empty((0, 3)),
        covariances=_column(rows, "covariance", 3, 3),
        scores=_column(rows, "score"),
        boxes_px=_column(rows, "bbox_px", 4),
        heights=_column(rows, "height"),
    )


def identified(record: Mapping[str, Any], bad: Bad = refuse) -> Identified:
    """Read the people of a ground-truth or track record.

    Args:
        record, bad: as `detections` has them.

    Raises:
        RecordError: "objects" is missing or not a list, or, by `bad`, a key of an object is invalid or an identity
            occurs twice.
    """

    def bad_person(reason: str) -> None:
        hint = "; detections have none, but tracks and ground truth do"
        bad(reason + hint if reason.endswith('"object_id" is missing') else reason)

    rows = _rows(record, descriptions.PERSON, bad_person)
    known: set[int] = set()
    for place, row in list(rows.items()):
        if row["object_id"] in known:
            bad(f'objects[{place}]: "object_id" {row["object_id"]} occurs twice in one record')
            del rows[place]
        known.add(row["object_id"])
    return Identified(
        timestamp=record["timestamp"],
        ids=np.array([row["object_id"] for row in rows.values()], dtype=np.int64),
        positions=_column(rows, "position", 3) if rows else np.empty((0, 3)),
        mouths=_column(rows, "mouth_position", 3),
        speaking=_column(rows, "speaking"),
        boxes_px=_column(rows, "bbox_px", 4),
        velocities=_column(rows, "velocity", 3),
        covariances=_column(rows, "covariance", 3, 3),
        existence=_column(rows, "existence"),
    )


Row = dict[str, Any]


def _rows(record: Mapping[str, Any], kind: Object, bad: Bad) -> dict[int, Row]:
    """Return the checked objects of a record by their places in its list; those that `bad` lets drop are left out."""
    if "objects" not in record:
        raise RecordError('"objects" is missing')
    if not isinstance(record["objects"], list):
        raise RecordError(f'"objects" must be a list, found {shown(record["objects"])}')
    rows = {}
    for place, item in enumerate(record["objects"]):
        try:
            rows[place] = kind.read(item)
        except Invalid as error:
            bad(f"objects[{place}]: {error}")
    return rows


def _column(rows: Mapping[int, Row], key: str, *shape: int) -> np.ndarray:
    """Return one key of all objects, (n, *shape); NaN where an object does not give it."""
    values = [row[key] for row in rows.values()]
    if values.count(None) == len(values):
        return _UNKNOWN
    if None in values:
        missing = [np.nan] * math.prod(shape) if shape else np.nan
        values = [missing if value is None else value for value in values]
    return np.array(values, dtype=float).reshape(-1, *shape)


# --- writing ----------------------------------------------------------------------------------------------------------


def as_record(item: Detections | Identified) -> dict[str, Any]:
    """Turn detections or people into a record for `encode`.

    Values that are NaN are left out, but the unknown height of a detection with a box is null. `speaking` is written as
    true or false where it is 0 or 1 and the person has no existence (ground truth), else as a probability (tracks).
    """
    if isinstance(item, Detections):
        named = {"sensor": item.sensor, "kind": item.kind}
        columns = {
            "position": item.positions,
            "covariance": item.covariances,
            "score": item.scores,
            "bbox_px": item.boxes_px,
            "height": item.heights,
        }
    else:
        named = {}
        columns = {
            "object_id": item.ids,
            "position": item.positions,
            "mouth_position": item.mouths,
            "velocity": item.velocities,
            "covariance": item.covariances,
            "existence": item.existence,
            "speaking": item.speaking,
            "bbox_px": item.boxes_px,
        }
    objects: list[Row] = [{} for _ in range(len(item))]
    for key, column in columns.items():
        known = ~np.isnan(column.reshape(len(item), -1)).any(axis=1) if len(item) else np.empty(0, bool)
        for row, value, given in zip(objects, column.tolist(), known.tolist(), strict=True):
            if given:
                row[key] = bool(value) if key == "speaking" and value in (0, 1) and "existence" not in row else value
            elif key == "position":
                row[key] = value[:2] if "object_id" in row else [*value[:2], None]
            elif key == "height" and "bbox_px" in row:
                row[key] = None
    said = {key: value for key, value in named.items() if value is not None}
    return {"timestamp": item.timestamp, **said, "objects": objects}


def save(path: str | os.PathLike[str], items: Iterable[Detections | Identified]) -> None:
    """Write detections, ground truth or tracks as JSON Lines; the file appears whole or not at all.

    Args:
        path: of the file.
        items: in the order in which they are written.

    Raises:
        RecordError: a number is NaN or infinite where JSON needs a number.
        OSError: the file cannot be written.

    >>> import numpy as np
    >>> save("tracks.jsonl", [Identified(0.0, np.array([1]), np.array([[1.0, 2.0, 0.0]]))])
    >>> load("tracks.jsonl")[0].positions
    array([[1., 2., 0.]])
    """
    with atomic.writing(path) as stream:
        stream.writelines(encode(as_record(item)) for item in items)


def load(path: str | os.PathLike[str]) -> list[Detections | Identified]:
    """Read a file of detections, ground truth or tracks.

    Objects with "object_id" are people, and records with "sensor" or "kind" or with other objects are detections. A
    file without any object and any sensor holds people.

    Args:
        path: of the file, JSON Lines.

    Returns:
        One item a record, in the order of the file.

    Raises:
        RecordError: a record is invalid; the message names the file and the line.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as stream:
        lines = list(texts(stream))
    decoded = [(number, _located(path, number, decode, text)) for number, text in lines]
    read = detections if any(_holds_detections(record) for _, record in decoded) else identified
    return [_located(path, number, read, record) for number, record in decoded]


def _located(path: str | os.PathLike[str], number: int, read: Callable[[Any], Any], value: Any) -> Any:
    try:
        return read(value)
    except RecordError as error:
        raise RecordError(f"{os.fspath(path)}:{number}: {error}", error.column) from None


def _holds_detections(record: Mapping[str, Any]) -> bool:
    if "sensor" in record or "kind" in record:
        return True
    objects = record.get("objects")
    return isinstance(objects, list) and any(isinstance(item, dict) and "object_id" not in item for item in objects)


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


def frame(record: Mapping[str, Any]) -> Frame | None:
    """Read a record's frame, None where the record has none.

    Raises:
        RecordError: the frame has no colour picture, or a path is not text.
    """
    if record.get("frame") is None:
        return None
    value = _read_media("frame", descriptions.FRAME, record)
    return Frame(record["timestamp"], value["rgb"], value["depth"])


def audio(record: Mapping[str, Any]) -> AudioChunk | None:
    """Read a record's audio chunk, None where the record has none.

    Raises:
        RecordError: a key is missing or of the wrong kind.
    """
    if record.get("audio") is None:
        return None
    value = _read_media("audio", descriptions.AUDIO, record)
    tail = value["tail_samples"]
    if tail is not None and tail > value["num_samples"]:
        raise RecordError(f'"audio.tail_samples" must be at most "num_samples", {value["num_samples"]}, found {tail}')
    return AudioChunk(record["timestamp"], **value)


def _read_media(key: str, kind: Object, record: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return kind.read(record[key])
    except Invalid as error:
        raise RecordError(str(error.within(key))) from None
