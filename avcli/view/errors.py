"""How far tracks are from the people as both arrive: each moment by itself, for a page that follows a run."""

from collections import OrderedDict
from typing import Any

import numpy as np

from avcli.formats.records import Identified
from avcli.numeric import assign
from avcli.view.recording import TRACKS, TRUTH

_CUTOFF_M = 1.0
_KEPT = 2000
"""Moments that wait for the other kind of records; a moment without its counterpart is forgotten after so many."""


class Errors:
    """Compares trackers with the ground truth; one assignment a moment, without memory of identities."""

    def __init__(self) -> None:
        self._truth: OrderedDict[int, np.ndarray] = OrderedDict()
        self._waiting: OrderedDict[tuple[str, int], tuple[float, np.ndarray]] = OrderedDict()

    def add(self, kind: str, name: str, people: Identified) -> list[dict[str, Any]]:
        """Add a record of people.

        Args:
            kind: `TRUTH` or `TRACKS`.
            name: of the tracker.
            people: the record.

        Returns:
            For each tracker that can be compared now: "of" (its name), "t" in s, "cm" (mean distance of the matched,
            null where none is within 1 m), and the numbers of people "missed" and of "false" tracks.
        """
        moment, places = round(1000 * people.timestamp), people.positions[:, :2]
        ready = []
        if kind == TRUTH:
            self._truth[moment] = places
            found = [key for key in self._waiting if key[1] == moment]
            ready = [_compared(key[0], *self._waiting.pop(key), places) for key in found]
        elif kind == TRACKS and moment in self._truth:
            ready = [_compared(name, people.timestamp, places, self._truth[moment])]
        elif kind == TRACKS:
            self._waiting[name, moment] = (people.timestamp, places)
        for kept in (self._truth, self._waiting):
            while len(kept) > _KEPT:
                kept.popitem(last=False)
        return ready


def _compared(name: str, time: float, tracks: np.ndarray, people: np.ndarray) -> dict[str, Any]:
    distance = np.linalg.norm(people[:, None] - tracks, axis=2)
    who, which = assign(np.minimum(distance, 10 * _CUTOFF_M)) if distance.size else (np.zeros(0, int),) * 2
    near = distance[who, which]
    near = near[near < _CUTOFF_M]
    cm = round(100 * float(near.mean()), 2) if near.size else None
    return {
        "of": name,
        "t": round(time, 4),
        "cm": cm,
        "missed": len(people) - near.size,
        "false": len(tracks) - near.size,
    }
