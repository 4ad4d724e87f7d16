"""One sequence with all that was tracked and detected in it: what pictures and reports are made from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avcli.formats.experiment import Config, ConfigError
from avcli.metrics.detections import SensorCase
from avcli.metrics.metric import Case
from avcli.metrics.ospa import SetDistances, set_distances
from avcli.metrics.position import errors
from avcli.metrics.sequence import Points, Sequence


@dataclass(frozen=True, eq=False)
class Tracked:
    """What one tracker made of a sequence.

    Attributes:
        case: ground truth and its tracks, in x and y or x, y and z.
        record: its metrics record.
    """

    case: Case
    record: dict

    @property
    def sequence(self) -> Sequence:
        """Ground truth and tracks."""
        return self.case.sequence


@dataclass(frozen=True, eq=False)
class Detected:
    """What one sensor detected in a sequence.

    Attributes:
        case: ground truth, and the detections as tracks whose identities mean nothing.
        record: its metrics record.
        kind: one of avcli.formats.sensors.KINDS.
        guessed: the kind was guessed from the sensor's name, and the scores depend on it.
        scored: its scores belong to the results; otherwise pictures alone show it.
    """

    case: SensorCase
    record: dict
    kind: str
    guessed: bool = False
    scored: bool = True

    @property
    def sequence(self) -> Sequence:
        """Ground truth and detections."""
        return self.case.sequence


@dataclass(frozen=True, eq=False)
class Run:
    """A sequence, its trackers and sensors by name.

    Attributes:
        name: of the sequence.
        trackers, sensors: at least one tracker; all have the same ground truth.
        room: (2,) size of the room in x and y, m; None where it is not known.
        microphones: (m, 2) m.
        camera: (2,) m; None where it is not known.
    """

    name: str
    trackers: Mapping[str, Tracked]
    sensors: Mapping[str, Detected]
    room: np.ndarray | None = None
    microphones: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    camera: np.ndarray | None = None

    @property
    def truth(self) -> Points:
        """The true points."""
        return next(iter(self.trackers.values())).sequence.truth

    @property
    def guesses(self) -> list[str]:
        """A sentence for each scored sensor whose kind was guessed."""
        return [
            f'the kind of sensor "{name}" was guessed from its name: {sensor.kind}; '
            f'config.json can state it: "sensors": {{"{name}": {{"kind": "{sensor.kind}"}}}}'
            for name, sensor in self.sensors.items()
            if sensor.guessed and sensor.scored
        ]

    @property
    def sequences(self) -> dict[str, Sequence]:
        """Ground truth and tracks of each tracker."""
        return {name: tracked.sequence for name, tracked in self.trackers.items()}

    @property
    def truth_time(self) -> np.ndarray:
        """(g,) time of each true point, s."""
        return next(iter(self.trackers.values())).sequence.time[self.truth.frame]

    def extent(self) -> tuple[float, float, float, float]:
        """x0, x1, y0, y1 in m of all that there is to see, the room at least."""
        corners = [np.zeros((1, 2)), self.room[None]] if self.room is not None else []
        corners += [self.microphones] + ([self.camera[None]] if self.camera is not None else [])
        seen = [each.sequence for each in self.trackers.values()] + [each.sequence for each in self.sensors.values()]
        corners += [side.position[:, :2] for each in seen for side in (each.truth, each.track) if side.identity.size]
        points = np.concatenate(corners)
        if not points.size:
            return 0.0, 1.0, 0.0, 1.0
        if self.room is not None:  # a wild detection far outside must not shrink the room to a speck
            points = np.clip(points, -0.5 * self.room, 1.5 * self.room)
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        return float(x0), float(x1), float(y0), float(y1)


def error_over_time(tracked: Tracked) -> tuple[np.ndarray, SetDistances]:
    """Mean error (T,) in m of each frame's matched points, NaN where none matches, and the frames' set distances."""
    sequence, settings = tracked.sequence, tracked.case.settings
    matches = tracked.case.matches
    frame = sequence.truth.frame[matches.truth]
    number = np.bincount(frame, minlength=sequence.time.size)
    total = np.bincount(frame, weights=errors(sequence, matches), minlength=sequence.time.size)
    mean = np.where(number > 0, total / np.maximum(1, number), np.nan)
    return mean, set_distances(sequence, settings.cutoff_m, settings.order)


@dataclass(frozen=True)
class Lane:
    """One line of a timeline, as spans of time.

    Attributes:
        who: a person, or a track with false points.
        what: of a person "speaks", a sensor's name or "tracked"; of a track "false".
        spans: start and end in s, and the track's identity (0 where the lane shows no track).
    """

    who: str
    what: str
    spans: list[tuple[float, float, int]]


def timeline(run: Run, tracker: str) -> list[Lane]:
    """Lay out when each person spoke, was detected by each sensor and was tracked, and when tracks were false."""
    tracked = run.trackers[tracker]
    truth, track = tracked.sequence.truth, tracked.sequence.track
    time = run.truth_time
    step = float(np.median(np.diff(np.unique(time)))) if np.unique(time).size > 1 else 0.1
    matches = tracked.case.matches
    follows = np.full(truth.identity.size, -1)
    follows[matches.truth] = track.identity[matches.track]
    lanes = []
    for k, label in enumerate(truth.label.tolist()):
        who, own = f"person {label}", np.flatnonzero(truth.identity == k)
        speaking = run.truth.speaking[own]
        if np.isfinite(speaking).any():
            lanes.append(Lane(who, "speaks", _spans(time[own], np.where(speaking > 0.5, 0, -1), step)))
        for name, sensor in run.sensors.items():
            found = np.full(truth.identity.size, -1)
            found[sensor.case.matches[0]] = 0
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


_DRAWN: dict[str, tuple[str, str, Callable[[Config], np.ndarray]]] = {
    "room": ("room_config", "room_dimensions_m", lambda config: config.room.dimensions[:2]),
    "microphones": ("microphone_config", "mic_positions_m", lambda config: config.microphones.positions[:, :2]),
    "camera": ("camera_config", "camera_position_m", lambda config: config.camera.T_room_camera[:2, 3]),
}


def with_surroundings(run: Run, config: Config, say: Callable[[str], None] = lambda text: None) -> Run:
    """Add the room, the microphones and the camera to a run, as far as its experiment states them.

    Args:
        run: what is to be drawn.
        config: of the experiment.
        say: is called with a sentence for each that is invalid.
    """
    known: dict[str, Any] = {}
    for name, (section, key, read) in _DRAWN.items():
        if not config.states(section, key):
            continue
        try:
            known[name] = np.asarray(read(config), dtype=float)
        except ConfigError as error:
            say(f"{run.name}: not drawn: {name}: {error}")
    return replace(run, **known)
