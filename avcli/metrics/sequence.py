"""Ground truth and tracks of one sequence in the flat form on which every metric works."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Frames
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from avcli.formats.records import Identified

_PAIRS_A_BLOCK = 1 << 20


@dataclass(frozen=True, eq=False)
class Points:
    """Identified points over T frames, frame after frame.

    Attributes:
        start: (T + 1,) the points of frame t are those from start[t] up to start[t + 1].
        identity: (n,) identities, counted from 0 in the order of their labels.
        position: (n, d) m; d is 1 where there are no points.
        label: (k,) the identities' own names.
        speaking: (n,) probability that the person speaks; NaN where it is not known.
    """

    start: np.ndarray
    identity: np.ndarray
    position: np.ndarray
    label: np.ndarray
    speaking: np.ndarray

    @classmethod
    def of(cls, frames: Iterable[tuple[ArrayLike, ArrayLike]]) -> Points:
        """Join frames into one table.

        Args:
            frames: for each frame the identities (n,), all numbers or all strings, and positions (n, d), m.

        Raises:
            ValueError: an identity occurs twice in a frame, or a position is not finite.
        """
        rows = [(np.asarray(ids), np.asarray(position, dtype=float)) for ids, position in frames]
        start = np.concatenate([[0], np.cumsum([len(ids) for ids, _ in rows])]).astype(int)
        filled = [(ids, position) for ids, position in rows if len(ids)]
        if not filled:
            return cls(start, np.zeros(0, int), np.zeros((0, 1)), np.zeros(0, int), np.zeros(0))
        position = np.concatenate([position for _, position in filled])
        if not np.isfinite(position).all():
            raise ValueError("a position is not finite")
        label, identity = np.unique(np.concatenate([ids for ids, _ in filled]), return_inverse=True)
        frame = np.repeat(np.arange(len(rows)), np.diff(start))
        key, count = np.unique(frame * label.size + identity, return_counts=True)
        if (count > 1).any():
            t, i = divmod(int(key[count > 1][0]), label.size)
            raise ValueError(f"identity {label[i]} occurs twice in frame {t}")
        return cls(start, identity, position, label, np.full(identity.size, np.nan))

    def keep(self, mask: np.ndarray) -> Points:
        """The points of a mask (n,) alone; identities without any are forgotten."""
        count = np.bincount(self.frame[mask], minlength=self.start.size - 1)
        present, identity = np.unique(self.identity[mask], return_inverse=True)
        start = np.concatenate([[0], np.cumsum(count)])
        return Points(start, identity, self.position[mask], self.label[present], self.speaking[mask])

    @property
    def count(self) -> np.ndarray:
        """Points of each frame, int (T,)."""
        return np.diff(self.start)

    @property
    def frame(self) -> np.ndarray:
        """Frame of each point, int (n,)."""
        return np.repeat(np.arange(self.start.size - 1), self.count)


@dataclass(frozen=True, eq=False)
class Group:
    """Frames that hold equally many true and tracked points.

    Attributes:
        frame: (f,) frame numbers.
        truth: (f, n) indices of the true points.
        track: (f, m) indices of the tracked points.
        distance: (f, n, m) m.
    """

    frame: np.ndarray
    truth: np.ndarray
    track: np.ndarray
    distance: np.ndarray

    def similarity(self, d0: float) -> np.ndarray:
        """Similarity max(0, 1 - distance / d0), float (f, n, m) (TrackEval's Euclidean similarity)."""
        return np.maximum(0, 1 - self.distance / d0)


@dataclass(frozen=True, eq=False)
class Sequence:
    """Ground truth and tracks on one timeline.

    Attributes:
        truth, track: the points.
        time: (T,) s.
    """

    truth: Points
    track: Points
    time: np.ndarray

    @classmethod
    def of(
        cls,
        truth: Iterable[tuple[ArrayLike, ArrayLike]],
        track: Iterable[tuple[ArrayLike, ArrayLike]],
        time: np.ndarray | None = None,
    ) -> Sequence:
        """Join ground truth and tracks that are given frame by frame.

        Args:
            truth: for each of T frames the identities (n,) and positions (n, d), m.
            track: the same of the tracks.
            time: (T,) s; by default the frames' numbers.

        Raises:
            ValueError: the lengths or dimensions differ, an identity occurs twice in a frame, or a position is not
                finite.
        """
        true, tracked = Points.of(truth), Points.of(track)
        frames = true.start.size - 1
        if tracked.start.size - 1 != frames:
            raise ValueError(f"the ground truth has {frames} frames, but the tracks have {tracked.start.size - 1}")
        if true.identity.size and tracked.identity.size and true.position.shape[1] != tracked.position.shape[1]:
            raise ValueError("ground truth and tracks have different dimensions")
        return cls(true, tracked, np.arange(frames, dtype=float) if time is None else np.asarray(time, dtype=float))

    def blocks(self) -> Iterator[list[Group]]:
        """Pairs of true and tracked points, block after block of consecutive frames, grouped by the frame's shape.

        Blocks bound the memory; groups let numpy work on many frames at once. Frames in which either side is empty are
        in no group.
        """
        pairs = np.concatenate([[0], np.cumsum(self.truth.count * self.track.count)])
        first, frames = 0, self.time.size
        while first < frames:
            last = max(first + 1, int(np.searchsorted(pairs, pairs[first] + _PAIRS_A_BLOCK, side="right")) - 1)
            block = np.arange(first, min(last, frames))
            yield self._groups(block[self.truth.count[block] * self.track.count[block] > 0])
            first = last

    def _groups(self, frames: np.ndarray) -> list[Group]:
        groups = []
        shapes, member = np.unique(
            np.stack([self.truth.count[frames], self.track.count[frames]]), axis=1, return_inverse=True
        )
        for k, (n, m) in enumerate(shapes.T):
            frame = frames[member.ravel() == k]
            truth = self.truth.start[frame][:, None] + np.arange(n)
            track = self.track.start[frame][:, None] + np.arange(m)
            offset = self.truth.position[truth][:, :, None] - self.track.position[track][:, None, :]
            groups.append(Group(frame, truth, track, length(offset)))
        return groups


def length(offset: np.ndarray) -> np.ndarray:
    """Euclidean length (...) of offsets (..., d); infinite where the square is beyond all numbers."""
    with np.errstate(over="ignore"):
        return np.sqrt((offset * offset).sum(axis=-1))


@dataclass(frozen=True)
class Mismatch:
    """What of two recordings has no partner in time, and what was wrong with their order.

    Attributes:
        truth_records, track_records: all records of each side.
        truth_frames, truth_points: frames of ground truth without a track record, and the points in them.
        track_frames, track_points: the same of the tracks.
        unsorted: records that were earlier than the one before them.
        repeated: records of a time that had been before; their points were joined.
        dropped: points dropped because their identity occurs twice at a time.
        height: m, mean height of the tracked over the true points of matched frames, NaN where either has none.
    """

    truth_records: int
    track_records: int
    truth_frames: int
    truth_points: int
    track_frames: int
    track_points: int
    unsorted: int
    repeated: int
    dropped: int
    height: float


def align(
    truth: Frames[Identified],
    track: Frames[Identified],
    dims: int = 2,
    tolerance: float = 1e-3,
    keep_first: bool = False,
) -> tuple[Sequence, Mismatch]:
    """Bring ground truth and tracks on one timeline: the ground truth's, and between it what only the tracks have.

    Each track record meets the ground-truth record next to it in time, one to one, if that is within the tolerance.

    Args:
        truth, track: records in any order.
        dims: 2 to score x and y, 3 for the height too.
        tolerance: s.
        keep_first: drop the points of an identity that occurs twice at a time, all but the first, and count them.

    Raises:
        ValueError: an identity occurs twice at a time, or dims is 3 and a height is missing.
    """
    records = len(truth), len(track)
    truth, truth_odd = _in_order(truth, keep_first, "the ground truth")
    track, track_odd = _in_order(track, keep_first, "the tracks")
    truth_time, track_time = (np.array([record.timestamp for record in side]) for side in (truth, track))
    partner = _partners(truth_time, track_time, tolerance)
    alone = np.setdiff1d(np.arange(track_time.size), partner)
    time = np.concatenate([truth_time, track_time[alone]])
    frames: list[tuple[Identified | None, Identified | None]] = [
        (truth[i], track[j] if j >= 0 else None) for i, j in enumerate(partner)
    ]
    frames += [(None, track[j]) for j in alone]
    frames = [frames[i] for i in np.argsort(time, kind="stable")]
    sides = [_points([pair[which] for pair in frames], dims) for which in (0, 1)]
    met = [(one, other) for one, other in frames if one is not None and other is not None]
    lonely = np.flatnonzero(partner < 0)
    return Sequence(sides[0], sides[1], np.sort(time, kind="stable")), Mismatch(
        truth_records=records[0],
        track_records=records[1],
        truth_frames=lonely.size,
        truth_points=sum(len(truth[i]) for i in lonely),
        track_frames=alone.size,
        track_points=sum(len(track[j]) for j in alone),
        unsorted=truth_odd[0] + track_odd[0],
        repeated=truth_odd[1] + track_odd[1],
        dropped=truth_odd[2] + track_odd[2],
        height=_gap(_heights([one for one, _ in met]), _heights([other for _, other in met])),
    )


def _points(records: Frames[Identified | None], dims: int) -> Points:
    """Join the records of a timeline; None is a frame without a record."""
    nothing = np.zeros((0, dims))
    for record in records:
        if dims == 3 and record is not None and np.isnan(record.positions).any():
            raise ValueError(f"a position at {record.timestamp:g} s has no height; --dims 2 scores x and y")
    points = Points.of([((), nothing) if r is None else (r.ids, r.positions[:, :dims]) for r in records])
    speaking = [record.speaking for record in records if record is not None]
    return replace(points, speaking=np.concatenate(speaking)) if speaking else points


def _heights(records: Frames[Identified]) -> np.ndarray:
    return np.concatenate([record.positions[:, 2] for record in records]) if records else np.zeros(0)


def _gap(below: np.ndarray, above: np.ndarray) -> float:
    if not below.size or not above.size:
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        return float(above.mean() - below.mean())


def _in_order(
    records: Frames[Identified], keep_first: bool, name: str
) -> tuple[list[Identified], tuple[int, int, int]]:
    """Sort records by time and join those of one time; returns them and the numbers of unsorted, repeated, dropped."""
    times = np.array([record.timestamp for record in records])
    unsorted, repeated, dropped = int((np.diff(times) < 0).sum()), 0, 0
    ordered: list[Identified] = []
    for k in np.argsort(times, kind="stable"):
        record = records[k]
        if ordered and record.timestamp == ordered[-1].timestamp:
            repeated += 1
            before = ordered.pop()
            twice = np.isin(record.ids, before.ids)
            if twice.any() and not keep_first:
                raise ValueError(f"identity {record.ids[twice][0]} occurs twice at {record.timestamp:g} s in {name}")
            dropped += int(twice.sum())
            record = Identified(
                timestamp=record.timestamp,
                ids=np.concatenate([before.ids, record.ids[~twice]]),
                positions=np.concatenate([before.positions, record.positions[~twice]]),
                speaking=np.concatenate([before.speaking, record.speaking[~twice]]),
            )
        ordered.append(record)
    return ordered, (unsorted, repeated, dropped)


def _partners(truth: np.ndarray, track: np.ndarray, tolerance: float) -> np.ndarray:
    """For each truth time (n,) the index of the track time (m,) that is nearest and has it as its nearest, or -1."""
    partner = np.full(truth.size, -1)
    if truth.size == 0 or track.size == 0:
        return partner
    after = np.clip(np.searchsorted(truth, track), 1, max(1, truth.size - 1))
    nearest = np.where(np.abs(truth[after - 1] - track) <= np.abs(truth[after % truth.size] - track), after - 1, after)
    nearest = np.minimum(nearest, truth.size - 1)
    gap = np.abs(truth[nearest] - track)
    for j in np.lexsort((np.arange(track.size), gap)):
        # The tolerance includes its end: timestamps carry ten decimals.
        if gap[j] <= tolerance + 1e-10 and partner[nearest[j]] < 0:
            partner[nearest[j]] = j
    return partner
