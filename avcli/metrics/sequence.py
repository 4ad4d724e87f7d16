"""Ground truth and tracks of one sequence in the flat form on which every metric works."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Frames
from dataclasses import dataclass

import numpy as np

_PAIRS_A_BLOCK = 1 << 20


@dataclass(frozen=True, eq=False)
class Points:
    """Identified points over T frames, frame after frame.

    Attributes:
        start: (T + 1,) the points of frame t are those from start[t] up to start[t + 1].
        identity: (n,) identities, counted from 0 in the order of their labels.
        position: (n, d) m; d is 1 where there are no points.
        label: (k,) the identities' own names.
    """

    start: np.ndarray
    identity: np.ndarray
    position: np.ndarray
    label: np.ndarray

    @classmethod
    def of(cls, frames: Iterable[tuple[Frames, np.ndarray]]) -> Points:
        """Join frames into one table.

        Args:
            frames: for each frame the identities (n,), all numbers or all strings, and positions (n, d), m.

        Raises:
            ValueError: an identity stands twice in a frame, or a position is not finite.
        """
        frames = list(frames)
        start = np.concatenate([[0], np.cumsum([len(identity) for identity, _ in frames])]).astype(int)
        filled = [(identity, position) for identity, position in frames if len(identity)]
        if not filled:
            return cls(start, np.zeros(0, int), np.zeros((0, 1)), np.zeros(0, int))
        position = np.concatenate([np.asarray(position, dtype=float) for _, position in filled])
        if not np.isfinite(position).all():
            raise ValueError("a position is not finite")
        label, identity = np.unique(np.concatenate([np.asarray(ids) for ids, _ in filled]), return_inverse=True)
        frame = np.repeat(np.arange(len(frames)), np.diff(start))
        key, count = np.unique(frame * label.size + identity, return_counts=True)
        if (count > 1).any():
            t, i = divmod(int(key[count > 1][0]), label.size)
            raise ValueError(f"identity {label[i]} stands twice in frame {t}")
        return cls(start, identity, position, label)

    def keep(self, mask: np.ndarray) -> Points:
        """The points of a mask (n,) alone; identities without any are forgotten."""
        count = np.bincount(self.frame[mask], minlength=self.start.size - 1)
        present, identity = np.unique(self.identity[mask], return_inverse=True)
        return Points(np.concatenate([[0], np.cumsum(count)]), identity, self.position[mask], self.label[present])

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
        truth: Iterable[tuple[Frames, np.ndarray]],
        track: Iterable[tuple[Frames, np.ndarray]],
        time: np.ndarray | None = None,
    ) -> Sequence:
        """Join ground truth and tracks that are given frame by frame.

        Args:
            truth: for each of T frames the identities (n,) and positions (n, d), m.
            track: the same of the tracks.
            time: (T,) s; by default the frames' numbers.

        Raises:
            ValueError: the lengths or dimensions differ, an identity stands twice in a frame, or a position is not
                finite.
        """
        truth, track = Points.of(truth), Points.of(track)
        frames = truth.start.size - 1
        if track.start.size - 1 != frames:
            raise ValueError(f"{frames} frames of ground truth against {track.start.size - 1} of tracks")
        if truth.identity.size and track.identity.size and truth.position.shape[1] != track.position.shape[1]:
            raise ValueError("ground truth and tracks have different dimensions")
        return cls(truth, track, np.arange(frames, dtype=float) if time is None else np.asarray(time, dtype=float))

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
    """What of two recordings did not meet in time, and what order they were in.

    Attributes:
        truth_frames, truth_points: frames of ground truth without a track record, and the points in them.
        track_frames, track_points: the same of the tracks.
        unsorted: records that were earlier than the one before them.
        repeated: records of a time that had been before; their points were joined.
        dropped: points dropped because their identity stood twice at a time.
        height: m, mean height of the tracked over the true points of matched frames, NaN where either has none.
    """

    truth_frames: int
    truth_points: int
    track_frames: int
    track_points: int
    unsorted: int
    repeated: int
    dropped: int
    height: float


Recording = list[tuple[float, np.ndarray, np.ndarray]]
"""Records of one file: time in s, identities (n,), positions (n, 3) in m with NaN where the height is not known."""


def align(
    truth: Recording, track: Recording, dims: int = 2, tolerance: float = 1e-3, keep_first: bool = False
) -> tuple[Sequence, Mismatch]:
    """Bring ground truth and tracks on one timeline: the ground truth's, and between it what only the tracks have.

    Each track record meets the ground-truth record next to it in time, one to one, if that is within the tolerance.

    Args:
        truth, track: records in any order.
        dims: 2 to score x and y, 3 for the height too.
        tolerance: s.
        keep_first: drop the points of an identity that stands twice at a time, all but the first, and count them.

    Raises:
        ValueError: an identity stands twice at a time, or dims is 3 and a height is missing.
    """
    truth, truth_odd = _in_order(truth, keep_first, "the ground truth")
    track, track_odd = _in_order(track, keep_first, "the tracks")
    truth_time, track_time = (np.array([time for time, _, _ in side]) for side in (truth, track))
    partner = _partners(truth_time, track_time, tolerance)
    alone = np.setdiff1d(np.arange(track_time.size), partner)
    time = np.concatenate([truth_time, track_time[alone]])
    frames = [(truth[i], track[j] if j >= 0 else None) for i, j in enumerate(partner)]
    frames += [(None, track[j]) for j in alone]
    frames = [frames[i] for i in np.argsort(time, kind="stable")]

    def side(which: int):
        for pair in frames:
            if pair[which] is None:
                yield (), np.zeros((0, dims))
                continue
            at, identity, position = pair[which]
            if dims == 3 and np.isnan(position).any():
                raise ValueError(f"a position at {at:g} s has no height; --dims 2 scores x and y")
            yield identity, position[:, :dims]

    lonely = [i for i, j in enumerate(partner) if j < 0]
    heights = [
        [position[:, 2] for pair in frames if None not in pair for position in [pair[which][2]]] for which in (0, 1)
    ]
    heights = [np.concatenate(side) if side else np.zeros(0) for side in heights]
    sequence = Sequence.of(side(0), side(1), np.sort(time, kind="stable"))
    return sequence, Mismatch(
        truth_frames=len(lonely),
        truth_points=sum(len(truth[i][1]) for i in lonely),
        track_frames=alone.size,
        track_points=sum(len(track[j][1]) for j in alone),
        unsorted=truth_odd[0] + track_odd[0],
        repeated=truth_odd[1] + track_odd[1],
        dropped=truth_odd[2] + track_odd[2],
        height=_gap(*heights),
    )


def _gap(below: np.ndarray, above: np.ndarray) -> float:
    if not below.size or not above.size:
        return np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        return float(above.mean() - below.mean())


def _in_order(recording: Recording, keep_first: bool, name: str) -> tuple[Recording, tuple[int, int, int]]:
    """Sort records by time and join those of one time; returns them and the numbers of unsorted, repeated, dropped."""
    times = np.array([time for time, _, _ in recording])
    unsorted, repeated, dropped = int((np.diff(times) < 0).sum()), 0, 0
    ordered: Recording = []
    for k in np.argsort(times, kind="stable"):
        time, identity, position = recording[k]
        if ordered and time == ordered[-1][0]:
            repeated += 1
            _, before, there = ordered.pop()
            twice = np.isin(identity, before)
            if twice.any() and not keep_first:
                raise ValueError(f"identity {identity[twice][0]} stands twice at {time:g} s in {name}")
            dropped += int(twice.sum())
            identity = np.concatenate([before, identity[~twice]])
            position = np.concatenate([there, position[~twice]])
        ordered.append((time, identity, position))
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
