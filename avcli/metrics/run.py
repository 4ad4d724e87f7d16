"""One sequence with all that was tracked and detected in it: what pictures and reports are made from."""

from dataclasses import dataclass, field

import numpy as np

from avcli.metrics import clear
from avcli.metrics.ospa import SetDistances, set_distances
from avcli.metrics.position import errors
from avcli.metrics.sequence import Sequence


@dataclass(frozen=True, eq=False)
class Tracked:
    """What one tracker made of a sequence.

    Attributes:
        sequence: ground truth and its tracks, in x and y or x, y and z.
        record: its metrics record.
        speaking: (n,) probability that each tracked point speaks, NaN where that is not said.
    """

    sequence: Sequence
    record: dict
    speaking: np.ndarray


@dataclass(frozen=True, eq=False)
class Detected:
    """What one sensor detected in a sequence.

    Attributes:
        sequence: ground truth, and the detections as tracks whose identities mean nothing.
        matches: indices of the true points and of the detections that belong together.
        record: its scores.
        box: (n, 4) px x0, y0, x1, y1 of each detection in the camera's frame, NaN where it has none.
    """

    sequence: Sequence
    matches: tuple[np.ndarray, np.ndarray]
    record: dict
    box: np.ndarray


@dataclass(frozen=True, eq=False)
class Run:
    """A sequence, its trackers and sensors by name.

    Attributes:
        name: of the sequence.
        trackers, sensors: at least one tracker; all have the same ground truth.
        speaking: (g,) whether each true point speaks, 1 or 0, NaN where that is not said.
        d0: m.
        room: (2,) size of the room in x and y, m; None where it is not known.
        microphones: (m, 2) m.
        camera: (2,) m; None where it is not known.
        frames: JPEG bytes of the camera's picture by time in s.
        frame_size: px width and height in which boxes are given.
    """

    name: str
    trackers: dict[str, Tracked]
    sensors: dict[str, Detected]
    speaking: np.ndarray
    d0: float
    room: np.ndarray | None = None
    microphones: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    camera: np.ndarray | None = None
    frames: dict[float, bytes] = field(default_factory=dict)
    frame_size: tuple[int, int] | None = None

    @property
    def truth_time(self) -> np.ndarray:
        """(g,) time of each true point, s."""
        first = next(iter(self.trackers.values())).sequence
        return first.time[first.truth.frame]

    def extent(self) -> tuple[float, float, float, float]:
        """x0, x1, y0, y1 in m of all that there is to see, the room at least."""
        corners = [np.zeros((1, 2)), self.room[None]] if self.room is not None else []
        corners += [self.microphones] + ([self.camera[None]] if self.camera is not None else [])
        for seen in (*self.trackers.values(), *self.sensors.values()):
            corners += [
                side.position[:, :2] for side in (seen.sequence.truth, seen.sequence.track) if side.identity.size
            ]
        points = np.concatenate(corners)
        if not points.size:
            return 0.0, 1.0, 0.0, 1.0
        if self.room is not None:  # a wild detection far outside must not shrink the room to a speck
            points = np.clip(points, -0.5 * self.room, 1.5 * self.room)
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        return float(x0), float(x1), float(y0), float(y1)


def error_over_time(tracked: Tracked, d0: float) -> tuple[np.ndarray, SetDistances]:
    """Mean error (T,) in m of each frame's matched points, NaN where none matches, and the frames' set distances."""
    sequence = tracked.sequence
    matches = clear.match(sequence, d0)
    frame = sequence.truth.frame[matches.truth]
    number = np.bincount(frame, minlength=sequence.time.size)
    total = np.bincount(frame, weights=errors(sequence, matches), minlength=sequence.time.size)
    mean = np.where(number > 0, total / np.maximum(1, number), np.nan)
    ospa = tracked.record["OSPA"]
    return mean, set_distances(sequence, ospa["cutoff"], ospa["order"])


@dataclass(frozen=True)
class Lane:
    """One line of a timeline, as spans of time.

    Attributes:
        who: a person, or a track that follows nobody.
        what: of a person "speaks", a sensor's name or "tracked"; of a track "false".
        spans: start and end in s, and the track's identity (0 for what is no track).
    """

    who: str
    what: str
    spans: list[tuple[float, float, int]]


def timeline(run: Run, tracker: str) -> list[Lane]:
    """When each person spoke, was detected by each sensor, was tracked under which identity; and what was false."""
    tracked = run.trackers[tracker]
    truth, track = tracked.sequence.truth, tracked.sequence.track
    time = run.truth_time
    step = float(np.median(np.diff(np.unique(time)))) if np.unique(time).size > 1 else 0.1
    matches = clear.match(tracked.sequence, run.d0)
    follows = np.full(truth.identity.size, -1)
    follows[matches.truth] = track.identity[matches.track]
    lanes = []
    for k, label in enumerate(truth.label.tolist()):
        who, own = f"person {label}", np.flatnonzero(truth.identity == k)
        if np.isfinite(run.speaking[own]).any():
            lanes.append(Lane(who, "speaks", _spans(time[own], np.where(run.speaking[own] > 0.5, 0, -1), step)))
        for name, sensor in run.sensors.items():
            found = np.full(truth.identity.size, -1)
            found[sensor.matches[0]] = 0
            lanes.append(Lane(who, name, _spans(time[own], found[own], step)))
        lanes.append(Lane(who, "tracked", _spans(time[own], follows[own], step)))
    false = np.ones(track.identity.size, dtype=bool)
    false[matches.track] = False
    for k in np.unique(track.identity[false]):
        own = np.flatnonzero(false & (track.identity == k))
        at = tracked.sequence.time[track.frame[own]]
        lanes.append(Lane(f"track {track.label[k]}", "false", _spans(at, track.identity[own], step)))
    return lanes


def _spans(time: np.ndarray, value: np.ndarray, step: float) -> list[tuple[float, float, int]]:
    """Spans (start, end, value) of equal values other than -1; a missing step ends one."""
    spans: list[tuple[float, float, int]] = []
    for t, v in zip(time.tolist(), value.tolist(), strict=True):
        if v < 0:
            continue
        if spans and spans[-1][2] == v and t - spans[-1][1] < 0.6 * step:
            spans[-1] = (spans[-1][0], t + step / 2, v)
        else:
            spans.append((t - step / 2, t + step / 2, v))
    return spans
