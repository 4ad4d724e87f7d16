"""People who were found a moment ago are found again at a lower score, for example half hidden ones.

A score that is too low to find somebody new is high enough to follow somebody (the second association of ByteTrack,
Zhang et al., 2022, section 3), and the more so as he or she is seen to move. The numbers were chosen on eleven real
films of a ceiling fisheye and on random worlds, see examples/benchmarks/detection.md.
"""

import numpy as np

from avcli.detection.agreement import overlaps

FOLLOWED = 0.3
"""Least score of a person who is followed."""

HITS = 2
"""Pictures in which the score alone found the person before he or she is followed. With one, things that flicker
about the score when a film begins are followed (two of 24 random worlds lose 9 and 14 points of HOTA)."""

LOST_S = 1.0
"""s; a person who is not seen for longer must be found anew."""

OVERLAP = 0.3
"""Least intersection over union of a person's boxes in two pictures."""


class Following:
    """Remembers the boxes of the people whom the last pictures of a film showed."""

    def __init__(self) -> None:
        self._time = -np.inf
        self._boxes, self._seen, self._hits = np.empty((0, 4)), np.empty(0), np.empty(0, int)

    def found(
        self, boxes: np.ndarray, scores: np.ndarray, least: float, time: float, moving: np.ndarray | None = None
    ) -> np.ndarray:
        """Say which people (n,) the next picture shows: found by the score, or followed from the pictures before.

        Args:
            boxes: (n, 4) px.
            scores: (n,) of them, in falling order.
            least: score from which somebody is found wherever he or she is.
            time: of the picture, s. What was seen at this time or later is forgotten.
            moving: (n,) scores that count in place of `scores` for people who are followed; None: the same.
        """
        self._time = time
        known = (self._seen < time) & (time - self._seen <= LOST_S)
        self._boxes, self._seen, self._hits = self._boxes[known], self._seen[known], self._hits[known]
        found, new = scores >= least, scores >= least
        shared = overlaps(boxes, self._boxes)
        followed = scores if moving is None else moving
        for k in np.flatnonzero(followed >= FOLLOWED) if known.any() else ():
            nearest = int(shared[k].argmax())
            if shared[k, nearest] >= OVERLAP and (found[k] or self._hits[nearest] >= HITS):
                self._boxes[nearest], self._seen[nearest] = boxes[k], time
                self._hits[nearest] += found[k]
                found[k], new[k] = True, False
                shared[:, nearest] = 0.0  # a person has one box in a picture
        self._boxes = np.concatenate([self._boxes, boxes[new]])
        self._seen = np.append(self._seen, np.full(int(new.sum()), time))
        self._hits = np.append(self._hits, np.ones(int(new.sum()), int))
        return found

    def near(self, boxes: np.ndarray) -> np.ndarray:
        """Whether each of the boxes (n, 4) px may show somebody whom the last pictures showed, (n,) bool."""
        return np.asarray((overlaps(boxes, self._boxes[self._hits >= HITS]) >= OVERLAP).any(axis=1))

    def unchanged(self, time: float) -> None:
        """Take in that the picture of a time, s, shows what the last one showed."""
        self._seen[self._seen == self._time] = time
        self._time = time
