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
        position: (n, d) m.
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
            return cls(start, np.zeros(0, int), np.zeros((0, 0)), np.zeros(0, int))
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
            groups.append(Group(frame, truth, track, np.sqrt((offset * offset).sum(axis=-1))))
        return groups
