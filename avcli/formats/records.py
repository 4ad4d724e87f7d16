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
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO, NoReturn

import numpy as np
import orjson

from avcli.formats import atomic, descriptions, features
from avcli.formats.bounds import LATEST_S, LONGEST_RECORD, MOST_OBJECTS
from avcli.formats.features import Feature
from avcli.formats.schema import DEEPEST, IDENTITY, Invalid, Object, refuse_depth, shown, syntax_error


class RecordError(ValueError):
    """An invalid record; `column` is the place in its line, from 1, if that is known."""

    def __init__(self, reason: str, column: int | None = None):
        super().__init__(reason)
        self.column = column


class WrongKindError(RecordError):
    """A record of another kind than the reader's: ground truth or tracks in place of detections, or the reverse."""


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
    size = begin = 0
    indent = b""
    for number, line in enumerate(_lines(stream), 1):
        if number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        text = line.strip()
        if block:
            size += len(line)
            if size < LONGEST_RECORD:
                block.append(line)
            if text in (b"}", b"},") and line[: len(line) - len(line.lstrip())] == indent:
                yield begin, _joined(block, size)
                block = []
        elif text == b"{":
            block, begin, size, indent = [line], number, len(line), line[: len(line) - len(line.lstrip())]
        elif b"}\\n" in text and len(line) < LONGEST_RECORD:
            for part in text.replace(b"}\\n", b"}\n").split(b"\n"):
                if part.strip():
                    yield number, part.strip()
        elif text:
            yield number, line if len(line) >= LONGEST_RECORD else text
    if block:
        yield begin, _joined(block, size)


def _joined(block: list[bytes], size: int) -> bytes:
    """Join the lines of one object; of one that is longer than a record, what was kept, just as long."""
    text = b"".join(block).strip().removesuffix(b",")
    return text if size < LONGEST_RECORD else text.ljust(LONGEST_RECORD)


def _lines(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the lines of a stream; of one that is longer than a record, the beginning stands for all of it."""
    while line := stream.readline(LONGEST_RECORD):
        yield line
        while len(line) >= LONGEST_RECORD and not line.endswith(b"\n"):
            line = stream.readline(LONGEST_RECORD)


def decode(line: bytes) -> dict[str, Any]:
    """Decode one line to a record whose "timestamp" is a float in seconds.

    Raises:
        RecordError: the line is not a JSON object, is too long or too deep, or its timestamp is missing or not a number
            of seconds.
    """
    if len(line) >= LONGEST_RECORD:
        raise RecordError(f"longer than {LONGEST_RECORD >> 20} MiB, which is not a record")
    try:
        record = orjson.loads(line)
    except orjson.JSONDecodeError as error:
        if not line.startswith(b"{") and (b"\0" in line or not _is_text(line)):
            raise RecordError("not text, but perhaps sound or a picture; a record is a line of JSON") from None
        raise RecordError(syntax_error(error), error.colno) from None
    if not isinstance(record, dict):
        raise RecordError(f"must be a JSON object, found {shown(record)}")
    if "timestamp" not in record:
        raise RecordError('"timestamp" is missing')
    try:
        if not _is_flat(line):
            refuse_depth(record)
    except Invalid as error:
        raise RecordError(str(error)) from None
    try:
        record["timestamp"] = descriptions.TIMESTAMP.kind.read(record["timestamp"])
    except Invalid as error:
        raise RecordError(str(error.within("timestamp"))) from None
    return record


def _is_text(line: bytes) -> bool:
    try:
        line.decode()
    except UnicodeDecodeError:
        return False
    return True


_ALIKE = bytes.maketrans(b"{}", b"[]")
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))


def _is_flat(line: bytes) -> bool:
    """Tell quickly whether a line is surely not too deep; one with brackets inside its texts may need a closer look."""
    if line.count(b"[") + line.count(b"{") <= DEEPEST:
        return True
    brackets = line.translate(_ALIKE, _NO_BRACKETS)
    for _ in range(DEEPEST):
        if not brackets:
            return True
        brackets = brackets.replace(b"[]", b"")
    return False


def printable(name: str) -> str:
    """Return the name of a file with "�" for bytes that are no UTF-8, which neither JSON nor a page can hold."""
    return os.fsencode(name).decode("utf-8", "replace")


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, Mapping):
        return {_printable(key): _printable(one) for key, one in value.items()}
    return [_printable(one) for one in value] if isinstance(value, list | tuple) else value


def encode(record: Mapping) -> bytes:
    """Encode a record as one line, its "timestamp" (s) as a string with ten decimals.

    numpy arrays and numbers are written as lists and numbers.

    Raises:
        RecordError: a number in it is NaN or infinite, which JSON cannot hold.
    """
    if "timestamp" in record:
        record = {**record, "timestamp": format_timestamp(float(record["timestamp"]))}
    option = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE
    try:
        line = orjson.dumps(record, option=option, default=_listed)
    except orjson.JSONEncodeError:  # the name of a file that is no UTF-8
        line = orjson.dumps(_printable(record), option=option, default=_listed)
    if b"null" in line:  # orjson writes it in the place of what JSON cannot hold
        _refuse_non_finite(record, "")
    return line


def format_timestamp(seconds: float) -> str:
    """Write a time in seconds as records and media names do: "0.1000000000"."""
    if not abs(seconds) <= LATEST_S:
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


_OF_DETECTIONS: dict[str, tuple[int, ...]] = {  # shapes of what is known of each
    "covariances": (3, 3),
    "boxes_px": (4,),
    "origins": (3,),
    "directions": (3,),
    "turned_px": (5,),
    **dict.fromkeys(("scores", "heights", "direction_sds", "ranges", "range_sds", "explained", "machines"), ()),
}
_OF_PEOPLE: dict[str, tuple[int, ...]] = {
    "mouths": (3,),
    "boxes_px": (4,),
    "velocities": (3,),
    "covariances": (3, 3),
    **dict.fromkeys(("speaking", "existence", "observed", "last_seen"), ()),
}


def _fill_unknown(item: "Detections | Identified", shapes: Mapping[str, tuple[int, ...]]) -> None:
    count, own = len(item), vars(item)
    for name, shape in shapes.items():
        if own[name] is _UNKNOWN:
            own[name] = _nan((count, *shape))


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
        positions: (n, 3) m in the room frame; z is NaN where it was not given, all are where only a direction or a
            range was.
        covariances: (n, 3, 3) m²; NaN where none was given; a zero variance means "not observed".
        scores: (n,) probability that the detection is right; NaN where none was given.
        kind: "camera" or "microphones", None where the record does not say it.
        boxes_px: (n, 4) x0, y0, x1, y1 in the full image; NaN where none was given.
        heights: (n,) m, of people; NaN where none was given.
        features: name ("looks", "voice") -> what tells these people from others.
        origins: (n, 3) m, from which directions and ranges count; z is NaN where it was not given.
        directions: (n, 3) unit vectors in the room frame; z is NaN where only the direction on the floor was given.
        direction_sds: (n,) rad, across the direction to each side.
        ranges: (n,) m, distances from the origins.
        range_sds: (n,) m.
        turned_px: (n, 5) middle x, y, width, height in px, and turn in degrees, of boxes turned as the people stand.
        explained: (n,) 0 where no body explains the box that a position comes from.
        machines: (n,) probability that a machine sounds there and nobody speaks.
    All from `origins` on are NaN where the record does not give them.
    """

    timestamp: float
    sensor: str | None
    positions: np.ndarray
    covariances: np.ndarray = field(default_factory=_unknown)
    scores: np.ndarray = field(default_factory=_unknown)
    kind: str | None = None
    boxes_px: np.ndarray = field(default_factory=_unknown)
    heights: np.ndarray = field(default_factory=_unknown)
    features: Mapping[str, Feature] = field(default_factory=dict)
    origins: np.ndarray = field(default_factory=_unknown)
    directions: np.ndarray = field(default_factory=_unknown)
    direction_sds: np.ndarray = field(default_factory=_unknown)
    ranges: np.ndarray = field(default_factory=_unknown)
    range_sds: np.ndarray = field(default_factory=_unknown)
    turned_px: np.ndarray = field(default_factory=_unknown)
    explained: np.ndarray = field(default_factory=_unknown)
    machines: np.ndarray = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        _fill_unknown(self, _OF_DETECTIONS)

    def __len__(self) -> int:
        return len(self.positions)

    def shows_less(self) -> bool:
        """Tell whether a detection has a direction or a range, in place of a position or beside a guess of it."""
        count = len(self.positions)
        if self.directions is _nan((count, 3)) and self.ranges is _nan((count,)):
            return False
        return bool(np.isfinite(self.directions[:, 0]).any() or np.isfinite(self.ranges).any())

    def located(self) -> "Detections":
        """Return the detections that have a position."""
        known = np.isfinite(self.positions[:, :2]).all(1)
        if known.all():
            return self
        columns = {key: value[known] for key, value in vars(self).items() if isinstance(value, np.ndarray)}
        told = {name: one.take(known) for name, one in self.features.items()}
        return replace(self, **columns, features=told)


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
        observed: (n,) 1 or 0, whether a sensor has detected the person since the record before.
        last_seen: (n,) s, when a sensor detected the person last.
        names: text of the identities that are text in the records, by their numbers in `ids`; None: all are integers.
    All from `mouths` to `last_seen` are NaN where the record does not give them.
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
    observed: np.ndarray = field(default_factory=_unknown)
    last_seen: np.ndarray = field(default_factory=_unknown)
    names: Mapping[int, str] | None = None

    def __post_init__(self) -> None:
        _fill_unknown(self, _OF_PEOPLE)

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
        WrongKindError: the record has identities and no sensor: it is ground truth or tracks.
        RecordError: "objects" is missing or not a list, or, by `bad`, a key of an object is invalid.
    """
    try:
        head = _SENSOR.read(record)
    except Invalid as error:
        raise RecordError(str(error)) from None
    if record.get("sensor") is None and record.get("kind") is None and _some_object(record, has_identity=True):
        raise WrongKindError('has "object_id": these are ground truth or tracks, not detections')
    rows = _rows(record, descriptions.DETECTION, bad)
    given = any(row["features"] for row in rows.values())
    told = features.columns(rows, bad) if given else {}  # first, since it may drop rows
    positions = _column(rows, "position", 3) if rows else np.empty((0, 3))
    return Detections(
        timestamp=record["timestamp"],
        sensor=head["sensor"],
        kind=head["kind"],
        positions=_nan((len(rows), 3)) if positions is _UNKNOWN else positions,
        covariances=_column(rows, "covariance", 3, 3),
        scores=_column(rows, "score"),
        boxes_px=_column(rows, "bbox_px", 4),
        heights=_column(rows, "height"),
        features=told,
        origins=_column(rows, "origin", 3),
        directions=_column(rows, "direction", 3),
        direction_sds=_radians(_column(rows, "direction_sd_deg")),
        ranges=_column(rows, "range_m"),
        range_sds=_column(rows, "range_sd_m"),
        turned_px=_column(rows, "turned_px", 5),
        explained=_column(rows, "explained"),
        machines=_column(rows, "machine"),
    )


def _radians(degrees: np.ndarray) -> np.ndarray:
    return degrees if degrees is _UNKNOWN else np.radians(degrees)


class Names:
    """Numbers for the people of a stream that are named by text: 0, 1, 2 … in the order in which they appear.

    >>> names = Names()
    >>> [names.number(identity) for identity in ("anna", "ben", "anna")]
    [0, 1, 0]

    Attributes:
        by_number: number -> text.
    """

    def __init__(self) -> None:
        self.by_number: dict[int, str] = {}
        self._numbers: dict[str, int] = {}
        self._has_integers = False

    def number(self, identity: int | str) -> int:
        """Return the number of a person; an integer stands for itself.

        Raises:
            RecordError: some identities of the stream are text and others are integers.
        """
        self._has_integers |= not isinstance(identity, str)
        if isinstance(identity, str):
            number = self._numbers.setdefault(identity, len(self._numbers))
            self.by_number[number] = identity
        else:
            number = identity
        if self._has_integers and self._numbers:
            raise RecordError('"object_id" is text for some people and an integer for others')
        return number


def identified(record: Mapping[str, Any], bad: Bad = refuse, names: Names | None = None) -> Identified:
    """Read the people of a ground-truth or track record.

    Args:
        record, bad: as `detections` has them.
        names: numbers the people whose "object_id" is text, the same for all records of a stream; None: text is
            invalid.

    Raises:
        WrongKindError: the record names a sensor, or none of its objects has an identity: they are detections.
        RecordError: "objects" is missing or not a list, or, by `bad`, a key of an object is invalid or an identity
            occurs twice.
    """
    named = record.get("sensor") is not None or record.get("kind") is not None
    if (named or _some_object(record, has_identity=False)) and not _some_object(record, has_identity=True):
        raise WrongKindError('"object_id" is missing: these are detections, not ground truth or tracks')
    rows = _rows(record, descriptions.PERSON, bad)
    known: set[int] = set()
    for place, row in list(rows.items()):
        try:
            row["object_id"] = _number_of(row["object_id"], names)
            if row["object_id"] in known:
                raise RecordError(f'"object_id" {row["object_id"]} occurs twice in one record')
        except RecordError as error:
            bad(f"objects[{place}]: {error}")
            del rows[place]
            continue
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
        observed=_column(rows, "observed"),
        last_seen=_column(rows, "last_seen"),
        names=names.by_number if names and names.by_number else None,
    )


def _number_of(identity: int | str, names: Names | None) -> int:
    if names is not None:
        return names.number(identity)
    try:
        return IDENTITY.read(identity)
    except Invalid as error:
        raise RecordError(str(error.within("object_id"))) from None


def _some_object(record: Mapping[str, Any], *, has_identity: bool) -> bool:
    """Tell whether some object of a record has, or has not, an identity."""
    objects = record.get("objects")
    return isinstance(objects, list) and any(
        isinstance(item, dict) and ("object_id" in item) == has_identity for item in objects[:MOST_OBJECTS]
    )


Row = dict[str, Any]


def _rows(record: Mapping[str, Any], kind: Object, bad: Bad) -> dict[int, Row]:
    """Return the checked objects of a record by their places in its list; those that `bad` lets drop are left out."""
    if "objects" not in record:
        raise RecordError('"objects" is missing')
    if not isinstance(record["objects"], list):
        raise RecordError(f'"objects" must be a list, found {shown(record["objects"])}')
    if len(record["objects"]) > MOST_OBJECTS:
        raise RecordError(f'"objects" must be a list of at most {MOST_OBJECTS}, found {len(record["objects"])}')
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

    Values that are NaN are left out, but the unknown height of a detection with a box is null, and so is the z of a
    detection's position that is not known; a direction without z has two numbers. `speaking` is written as
    true or false where it is 0 or 1 and the person has no existence (ground truth), else as a probability (tracks).
    """
    if isinstance(item, Detections):
        named = {"sensor": item.sensor, "kind": item.kind}
        names: Mapping[int, str] = {}
        columns = {
            "position": item.positions,
            "covariance": item.covariances,
            "score": item.scores,
            "bbox_px": item.boxes_px,
            "height": item.heights,
            "origin": item.origins,
            "direction": item.directions,
            "direction_sd_deg": np.degrees(item.direction_sds),
            "range_m": item.ranges,
            "range_sd_m": item.range_sds,
            "turned_px": item.turned_px,
            "explained": item.explained,
            "machine": item.machines,
        }
    else:
        named, names = {}, item.names or {}
        columns = {
            "object_id": item.ids,
            "position": item.positions,
            "mouth_position": item.mouths,
            "velocity": item.velocities,
            "covariance": item.covariances,
            "existence": item.existence,
            "observed": item.observed,
            "last_seen": item.last_seen,
            "speaking": item.speaking,
            "bbox_px": item.boxes_px,
        }
    objects: list[Row] = [{} for _ in range(len(item))]
    for key, column in columns.items():
        if column is _nan(column.shape) and key != "height":  # as nearly all that nobody gave
            continue
        lacks = np.isnan(column)
        some = np.logical_or.reduce(lacks.reshape(len(item), -1), 1).tolist() if lacks.any() else [False] * len(item)
        for row, value, unknown in zip(objects, column.tolist(), some, strict=True):
            if key == "object_id":
                row[key] = names.get(value, value)
            elif not unknown:
                is_bool = key in ("observed", "explained") or (
                    key == "speaking" and value in (0, 1) and "existence" not in row
                )
                row[key] = bool(value) if is_bool else value
            elif key in ("position", "origin") and not math.isnan(value[0]):
                row[key] = value[:2] if "object_id" in row else [*value[:2], None]
            elif key == "direction" and not math.isnan(value[0]):
                row[key] = value[:2]
            elif key == "height" and "bbox_px" in row:
                row[key] = None
    if isinstance(item, Detections) and item.features:
        for row, its_features in zip(objects, features.as_objects(item.features, len(item)), strict=True):
            if its_features:
                row["features"] = its_features
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
    marks = EndMarks()
    decoded = [(number, _located(path, number, decode, text)) for number, text in lines]
    decoded = [(number, record) for number, record in decoded if not marks.is_mark(record)]
    found = any({"sensor", "kind"} & record.keys() or _some_object(record, has_identity=False) for _, record in decoded)
    read = detections if found else functools.partial(identified, names=Names())
    return [_located(path, number, read, record) for number, record in decoded]


def _located(path: str | os.PathLike[str], number: int, read: Callable[[Any], Any], value: Any) -> Any:
    try:
        return read(value)
    except RecordError as error:
        raise RecordError(f"{os.fspath(path)}:{number}: {error}", error.column) from None


# --- the end of a stream ----------------------------------------------------------------------------------------------


class EndMarks:
    """Follows the end marks of a stream, or of several that were merged into one.

    A writer that marks its end puts `"end": false` into its first record, and after its last record it writes
    `{"timestamp": …, "end": true, "records": N}`. A mark is not a record. Nothing is expected of a stream that did not
    announce its mark.

    >>> marks = EndMarks()
    >>> [marks.is_mark(record) for record in ({"timestamp": 0.0, "end": False}, {"timestamp": 0.1})]
    [False, False]
    >>> marks.missing()
    'ended before its end mark: its writer was stopped, or the end was cut off'
    """

    def __init__(self) -> None:
        self._announced = self._marked = self._records = self._stated = 0

    def is_mark(self, record: Mapping[str, Any]) -> bool:
        """Take the next record of the stream; true if it is a mark, which is to be left out."""
        end = record.get("end")
        if end is True:
            self._marked += 1
            stated = record.get("records")
            self._stated += stated if type(stated) is int else 0
            return True
        self._announced += end is False
        self._records += 1
        return False

    def missing(self) -> str | None:
        """Say at the end of the stream what is missing of it, as the end of a sentence; None: nothing is missing."""
        if self._announced > self._marked:
            return "ended before its end mark: its writer was stopped, or the end was cut off"
        if self._records < self._stated:
            return f"has {self._records} of the {self._stated} records that its end mark counts"
        return None


def end_mark(timestamp: float, records: int) -> dict[str, Any]:
    """Return the mark that follows the last record of a stream.

    Args:
        timestamp: of the last record, s.
        records: number of records before it.
    """
    return {"timestamp": timestamp, "end": True, "records": records}


# --- media ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frame:
    """Where a frame's pictures lie: paths as the record has them; None for the picture that it does not have."""

    timestamp: float
    rgb: str | None
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


def frame(record: Mapping[str, Any], *, outside: bool = False) -> Frame | None:
    """Read a record's frame, None where the record has none.

    Args:
        record: as `decode` returns it.
        outside: whether a path may lead out of the experiment directory.

    Raises:
        RecordError: the frame has no picture, or a path is not text or leads out of the directory.
    """
    if record.get("frame") is None:
        return None
    value = _read_media("frame", descriptions.FRAME, record)
    for key in ("rgb", "depth"):
        _refuse_outside(f"frame.{key}", value[key], outside)
    return Frame(record["timestamp"], value["rgb"], value["depth"])


def audio(record: Mapping[str, Any], *, outside: bool = False) -> AudioChunk | None:
    """Read a record's audio chunk, None where the record has none.

    Args:
        record, outside: as `frame` has them.

    Raises:
        RecordError: a key is missing or of the wrong kind, or the path leads out of the directory.
    """
    if record.get("audio") is None:
        return None
    value = _read_media("audio", descriptions.AUDIO, record)
    _refuse_outside("audio.path", value["path"], outside)
    tail = value["tail_samples"]
    if tail is not None and tail > value["num_samples"]:
        raise RecordError(f'"audio.tail_samples" must be at most "num_samples", {value["num_samples"]}, found {tail}')
    return AudioChunk(record["timestamp"], **value)


def _read_media(key: str, kind: Object, record: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return kind.read(record[key])
    except Invalid as error:
        raise RecordError(str(error.within(key))) from None


def _refuse_outside(key: str, path: str | None, outside: bool) -> None:
    """Refuse a path that leads out of the experiment by its letters; links inside may lead anywhere."""
    if path is None:
        return
    if "\0" in path:
        raise RecordError(f'"{key}" must be a path, found {shown(path)}')
    if not outside and (os.path.isabs(path) or os.path.normpath(path).split(os.sep, 1)[0] == os.pardir):
        raise RecordError(
            f'"{key}" must be inside the experiment directory, found {shown(path)}; --allow-outside reads it'
        )
