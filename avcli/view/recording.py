"""What a run's records say, sorted by kind into streams that a page can draw."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np

from avcli.formats import records
from avcli.formats.sensors import sensor_kind

TRUTH, TRACKS, DETECTIONS = "truth", "tracks", "detections"
_TRUE_KEYS = {"mouth_position", "visible_fraction", "bbox_full_px", "keypoints_px"}
_TRACK_KEYS = {"existence", "velocity", "covariance", "observed", "last_seen"}
Row = list[Any]


@dataclass
class Stream:
    """Records of one kind from one source.

    Attributes:
        name: of the tracker or the sensor; "truth" of the ground truth.
        kind: `TRUTH`, `TRACKS` or `DETECTIONS`.
        sensor: "camera" or "microphones"; None where the stream holds people.
        rows: for each record [time in s, objects]. A person is [identity, x, y, speaking, existence, observed, cxx,
            cxy, cyy]; a detection is [x, y, z, score, cxx, cxy, cyy, box, origin, direction]. Unknown values are null,
            those at the end are left out. Metres, m², px.
    """

    name: str
    kind: str
    sensor: str | None = None
    rows: list[Row] = field(default_factory=list)


class Recording:
    """Sorts records into streams.

    Args:
        name: of the run.
        sensors: name -> kind, as config.json states it.
        outside: whether frames and sounds may lie outside the experiment's directory.

    Attributes:
        sensors: name -> kind of sensor.
        streams: in the order in which they appeared.
        frames: (time in s, path) of the camera's pictures.
        chunks: pieces of sound.
        people: ground truth and tracks by kind and name, as they were read.
    """

    def __init__(self, name: str, sensors: Mapping[str, str] | None = None, *, outside: bool = False):
        self.name = name
        self.streams: list[Stream] = []
        self.frames: list[tuple[float, str]] = []
        self.chunks: list[records.AudioChunk] = []
        self.people: dict[tuple[str, str], list[records.Identified]] = {}
        self.sensors = sensors or {}
        self._outside = outside
        self._by_key: dict[tuple[str, str], int] = {}
        self._names: dict[str, records.Names] = {}
        self._known: dict[str, str] = {}  # kind of the people of a source
        self._pending: dict[str, list[float]] = {}  # times of records without objects before that is known

    def add(
        self, record: Mapping[str, Any], source: str, bad: records.Bad = records.refuse, stated: str | None = None
    ) -> list[tuple[int, Row]]:
        """Add a decoded record.

        Args:
            record: as `avcli.formats.records.decode` returns it.
            source: names the tracker whose tracks it may hold.
            bad: called with the reason for each invalid object.
            stated: `TRUTH` or `TRACKS` where that is known; by default the record's keys and the source's name tell.

        Returns:
            The new rows: number of the stream, row.

        Raises:
            RecordError: the record is invalid.
        """
        frame = records.frame(record, outside=self._outside)
        if frame is not None and frame.rgb is not None:
            self.frames.append((frame.timestamp, frame.rgb))
        chunk = records.audio(record, outside=self._outside)
        if chunk is not None:
            self.chunks.append(chunk)
        if "objects" not in record:
            return []
        if record.get("sensor") is not None or record.get("kind") is not None or _lacks_identities(record):
            return [self.add_detections(records.detections(record, bad))]
        kind = stated or _kind_of_people(record, source) or self._known.get(source)  # one pipe may carry both
        if kind is None and record["objects"] == []:
            self._pending.setdefault(source, []).append(record["timestamp"])
            return []
        people = records.identified(record, bad, self._names.setdefault(source, records.Names()))
        kind = kind or TRACKS
        self._known[source] = kind
        name = "truth" if kind == TRUTH else source
        new = [self.add_people(kind, name, _nobody(time)) for time in self._pending.pop(source, [])]
        return [*new, self.add_people(kind, name, people)]

    def add_people(self, kind: str, name: str, people: records.Identified) -> tuple[int, Row]:
        """Add a record of ground truth or tracks that was read already; return its stream's number and its row."""
        number = self._stream(kind, name)
        row = [round(people.timestamp, 4), _people(people)]
        self.streams[number].rows.append(row)
        self.people.setdefault((kind, name), []).append(people)
        return number, row

    def add_all(self, kind: str, name: str, records_of_people: Iterable[records.Identified]) -> None:
        """Add records of ground truth or tracks; a stream without any is kept, empty."""
        self._stream(kind, name)
        for people in records_of_people:
            self.add_people(kind, name, people)

    def add_detections(self, found: records.Detections) -> tuple[int, Row]:
        """Add a record of detections that was read already; return its stream's number and its row."""
        name = found.sensor or "detections"
        kind = sensor_kind(name, found.kind, self.sensors)[0]
        number = self._stream(DETECTIONS, name, kind)
        row = [round(found.timestamp, 4), _found(found)]
        self.streams[number].rows.append(row)
        return number, row

    def _stream(self, kind: str, name: str, sensor: str | None = None) -> int:
        number = self._by_key.setdefault((kind, name), len(self.streams))
        if number == len(self.streams):
            self.streams.append(Stream(name, kind, sensor))
        return number


def _nobody(time: float) -> records.Identified:
    return records.Identified(time, np.empty(0, dtype=np.int64), np.empty((0, 3)))


def _lacks_identities(record: Mapping[str, Any]) -> bool:
    objects = [item for item in record["objects"] if isinstance(item, dict)] if _is_list(record) else []
    return bool(objects) and not any("object_id" in item for item in objects)


def _is_list(record: Mapping[str, Any]) -> bool:
    return isinstance(record["objects"], list)


def _kind_of_people(record: Mapping[str, Any], source: str) -> str | None:
    """Tell ground truth from tracks, None where nothing tells it."""
    if record.get("frame") is not None or record.get("activity") is not None or "truth" in source:
        return TRUTH
    objects = record["objects"] if _is_list(record) else []
    keys = {key for item in objects if isinstance(item, dict) for key in item}
    if keys & _TRACK_KEYS:
        return TRACKS
    if keys & _TRUE_KEYS or any(isinstance(item, dict) and item.get("speaking") in (True, False) for item in objects):
        return TRUTH
    return None


def _people(people: records.Identified) -> list[Row]:
    names = people.names or {}
    columns = (
        [names.get(number, number) for number in people.ids.tolist()],
        *(_short(column, 3) for column in people.positions[:, :2].T),
        _short(people.speaking, 2),
        _short(people.existence, 3),
        _short(people.observed, 0),
        *(_short(people.covariances[:, i, j], 6) for i, j in ((0, 0), (0, 1), (1, 1))),
    )
    return [_trimmed(row) for row in zip(*columns, strict=True)]


def _found(found: records.Detections) -> list[Row]:
    columns = (
        *(_short(column, 3) for column in found.positions.T),
        _short(found.scores, 3),
        *(_short(found.covariances[:, i, j], 6) for i, j in ((0, 0), (0, 1), (1, 1))),
        _vectors(found.boxes_px, 0),
        _vectors(found.origins, 3),
        _vectors(found.directions, 4),
    )
    return [_trimmed(row) for row in zip(*columns, strict=True)]


def _short(values: np.ndarray, digits: int) -> list[float | None]:
    return [round(value, digits) if isfinite(value) else None for value in values.tolist()]


def _vectors(rows: np.ndarray, digits: int) -> list[list[float] | None]:
    known = np.isfinite(rows[:, :2]).all(axis=1).tolist()
    return [_short(row, digits) if given else None for row, given in zip(rows, known, strict=True)]  # type: ignore[misc]


def _trimmed(row: Sequence[Any]) -> Row:
    last = len(row)
    while last and row[last - 1] is None:
        last -= 1
    return list(row[:last])
