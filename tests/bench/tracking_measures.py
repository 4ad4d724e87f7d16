"""What the bench of trackers measures beside aveval's metrics: ghosts, takeovers, and whether existence is true."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from tracking_runs import Frame
from tracking_scenes import Truth

from avcli.metrics.hota import METRIC as HOTA
from avcli.metrics.metric import Case
from avcli.metrics.sequence import Sequence
from avcli.metrics.settings import Settings

NEAR = 1.0  # m; a track is true if it is matched, one to one, to somebody so near
ALONE = 2.0  # m; a track with nobody so near is a ghost
LATE = 1.0  # s before a departure in which a track must have been matched to the person to be his


def matched(truth: Truth, tracks: list[Frame]) -> list[dict[int, int]]:
    """For each frame {track: person}, one to one, as many within 1 m as can be, the nearest of these."""
    out = []
    for (_, ids, xy), frame in zip(truth, tracks, strict=True):
        distance = np.linalg.norm(frame.xy[:, None] - xy[None], axis=2)
        rows, columns = linear_sum_assignment(np.where(distance <= NEAR, distance, 1e3))
        out.append(
            {
                frame.ids[r]: int(ids[c])
                for r, c in zip(rows.tolist(), columns.tolist(), strict=True)
                if distance[r, c] <= NEAR
            }
        )
    return out


def hota(truth: Truth, tracks: list[Frame], d0: float) -> tuple[float, float, float]:
    """HOTA, DetA and AssA, %."""
    sequence = Sequence.of([(ids.tolist(), xy) for _, ids, xy in truth], [(one.ids, one.xy) for one in tracks])
    scores = HOTA.score(Case(sequence, Settings(d0=d0)))
    return tuple(100 * float(np.mean(scores[name])) for name in ("HOTA", "DetA", "AssA"))  # type: ignore[return-value]


@dataclass(frozen=True)
class Departures:
    """What became of the tracks of people who left before the end.

    Attributes:
        ghosts: (n,) s for which the track of each was reported after that with nobody within 2 m.
        takeovers: how many of the tracks were matched to somebody else afterwards.
    """

    ghosts: np.ndarray
    takeovers: int


def departures(truth: Truth, tracks: list[Frame], pairs: list[dict[int, int]]) -> Departures:
    """Follow the track of each person who leaves: the one that was matched to that person last, within 1 s before."""
    times = np.array([t for t, *_ in truth])
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    last_seen = {int(i): k for k, (_, ids, _) in enumerate(truth) for i in ids}
    latest: dict[int, dict[int, int]] = {}  # person -> {track: frame of its last match}
    for k, found in enumerate(pairs):
        for track, person in found.items():
            latest.setdefault(person, {})[track] = k
    ghosts, takeovers = [], 0
    for person, left in last_seen.items():
        if left == len(truth) - 1:
            continue
        ghost = 0
        mine = {k: track for track, k in latest.get(person, {}).items()}
        if mine and times[left] - times[max(mine)] <= LATE:
            track = mine[max(mine)]
            for k in range(left + 1, len(truth)):
                if pairs[k].get(track, person) != person:
                    takeovers += 1
                    break
                if track in tracks[k].ids:
                    away = np.linalg.norm(truth[k][2] - tracks[k].xy[tracks[k].ids.index(track)], axis=1)
                    ghost += int((away > ALONE).all())
        ghosts.append(ghost * step)
    return Departures(np.array(ghosts), takeovers)


def existence(tracks: list[Frame], pairs: list[dict[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """What each record of a track says of existence, and whether it is true (n,), (n,)."""
    said = np.concatenate([np.zeros(0), *(one.existence for one in tracks)])
    true = np.array([track in found for one, found in zip(tracks, pairs, strict=True) for track in one.ids], bool)
    return said, true


def brier(said: np.ndarray, true: np.ndarray) -> float:
    """Mean squared difference of probabilities (n,) and what was true (n,); NaN of nothing (Brier 1950)."""
    return float(np.mean((said - true) ** 2)) if len(said) else math.nan
