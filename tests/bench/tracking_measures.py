"""What the bench of trackers measures beside aveval's metrics: ghosts, takeovers, and whether existence is true."""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from tracking_runs import Frame
from tracking_scenes import Scene, Truth

from avcli.metrics.hota import METRIC as HOTA
from avcli.metrics.metric import Case
from avcli.metrics.sequence import Sequence
from avcli.metrics.settings import Settings

NEAR = 1.0  # m; a track is true if it is matched, one to one, to somebody so near
ALONE = 2.0  # m; a track with nobody so near is a ghost
AWAY = 1.5  # s outside what is scored after which somebody is somebody else
LATER = 10.0  # s; HOTA is given from then on, too: what a tracker learns it has begun to know
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


def within(scene: Scene, tracks: list[Frame]) -> tuple[Truth, list[Frame]]:
    """The truth and tracks of what is scored: people in `scene.seen`, and tracks that are of nobody outside it."""
    truth, tracks = looked_at(scene.truth, tracks, scene.unlooked) if scene.unlooked else (scene.truth, tracks)
    if scene.seen is None:
        return truth, tracks
    low, high = np.array(scene.seen)
    return visits_of(truth, tracks, lambda xy: ((xy >= low) & (xy <= high)).all(1))


def looked_at(truth: Truth, tracks: list[Frame], unlooked: Iterable[tuple[float, float]]) -> tuple[Truth, list[Frame]]:
    """The truth and tracks without times of which nobody knows who was there, see `Scene.unlooked`.

    Nobody knows either who of those afterwards was there before: a track has another number then.
    """
    spans, numbers = sorted(unlooked), dict[tuple[int, int], int]()
    scored, kept = [], []
    for one, frame in zip(truth, tracks, strict=True):
        if any(since + 1e-6 < one[0] < until - 1e-6 for since, until in spans):
            continue
        part = sum(until - 1e-6 < one[0] for _, until in spans)
        scored.append(one)
        ids = [numbers.setdefault((part, track), len(numbers)) for track in frame.ids]
        kept.append(replace(frame, ids=ids))
    return scored, kept


def visits_of(truth: Truth, tracks: list[Frame], seen: Callable[[np.ndarray], np.ndarray]) -> tuple[Truth, list[Frame]]:
    """The truth and tracks of what is scored: people at places (n, 2) m that are seen.

    Who comes back into it after 1.5 s may be known again or be somebody new: each visit is a person of its own, and a
    track of the same person in another visit gets a number of its own.
    """
    scored, kept = [], []
    visits: dict[int, tuple[int, float]] = {}  # person -> number of the visit, last time in it
    persons: list[int] = []  # of each visit
    known: dict[int, tuple[int, int]] = {}  # track -> number of the visit it was matched to last, number of its own
    numbers = itertools.count()
    for (t, ids, xy), frame, pairs in zip(truth, tracks, matched(truth, tracks), strict=True):
        inside = seen(xy)
        there = ids[inside].tolist()
        for person in there:
            if person not in visits or t - visits[person][1] > AWAY:
                visits[person] = (len(persons), t)
                persons.append(person)
            visits[person] = (visits[person][0], t)
        scored.append((t, np.array([visits[person][0] for person in there], int), xy[inside]))
        here = seen(frame.xy).tolist()
        keep = [k for k, one in enumerate(frame.ids) if (pairs[one] in there if one in pairs else here[k])]
        for track in (frame.ids[k] for k in keep):
            visit = visits[pairs[track]][0] if track in pairs else -1
            last, own = known.get(track, (-1, -1))
            again = -1 < last != visit > -1 and persons[last] == persons[visit]
            known[track] = (visit if visit >= 0 else last, next(numbers) if own < 0 or again else own)
        kept.append(Frame([known[frame.ids[k]][1] for k in keep], frame.xy[keep], frame.existence[keep]))
    return scored, kept


def invented(scene: Scene, tracks: list[Frame]) -> float:
    """Tracks in a frame, on average, that are outside `scene.seen` and of nobody; NaN where all is seen."""
    if scene.seen is None:
        return math.nan
    low, high = np.array(scene.seen)
    false = 0
    for frame, pairs in zip(tracks, matched(scene.truth, tracks), strict=True):
        outside = ((frame.xy < low) | (frame.xy > high)).any(1).tolist()
        false += sum(out and one not in pairs for one, out in zip(frame.ids, outside, strict=True))
    return false / len(tracks)


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


def delays(truth: Truth, pairs: list[dict[int, int]]) -> np.ndarray:
    """Seconds (n,) from each person's coming to the first match; of who is never matched, the whole stay."""
    come: dict[int, float] = {}
    gone: dict[int, float] = {}
    met: dict[int, float] = {}
    for (t, ids, _), found in zip(truth, pairs, strict=True):
        for person in ids.tolist():
            come.setdefault(person, t)
            gone[person] = t
        for person in found.values():
            met.setdefault(person, t)
    return np.array([met.get(person, gone[person]) - t for person, t in come.items()])


BINS = 10


def existence(tracks: list[Frame], pairs: list[dict[int, int]]) -> np.ndarray:
    """How true the existence of tracks is, in ten bins of what is said: records, sum of what is said, true, squares.

    Returns:
        (10, 4); the squares are those of Brier's score.
    """
    said = np.concatenate([np.zeros(0), *(one.existence for one in tracks)])
    true = np.array([track in found for one, found in zip(tracks, pairs, strict=True) for track in one.ids], float)
    columns = np.column_stack([np.ones_like(said), said, true, (said - true) ** 2])
    place = np.minimum((said * BINS).astype(int), BINS - 1) if np.isfinite(said).all() else np.zeros(len(said), int)
    return np.array([columns[place == k].sum(0) for k in range(BINS)])


@dataclass(frozen=True)
class Outcome:
    """What one scene gave a tracker.

    Attributes:
        hota, late: HOTA in % at d0 = 2 m, and from 10 s on; fine, finest: at d0 = .5 m and .25 m.
        det, ass: DetA and AssA in %, at d0 = 2 m.
        invented: tracks of nobody in a frame where nothing is seen, NaN where all is.
        births: s until each person was found.
        ghosts: s for which the track of each who left was reported with nobody near.
        takeovers: tracks of people who left that were matched to somebody else.
        bins: see `existence`.
        spent: processor time in ms a frame, NaN: not measured.
    """

    hota: float
    late: float
    fine: float
    finest: float
    det: float
    ass: float
    invented: float
    births: list[float]
    ghosts: list[float]
    takeovers: int
    bins: list[list[float]]
    spent: float


def outcome(scene: Scene, tracks: list[Frame], spent: float) -> Outcome:
    """Score the tracks of a scene."""
    truth, inside = within(scene, tracks)
    pairs = matched(truth, inside)
    start = sum(t < LATER for t, *_ in truth)
    late = hota(truth[start:], inside[start:], 2.0)[0] if 0 < start < len(truth) else math.nan
    (whole, det, ass), (fine, *_), (finest, *_) = (hota(truth, inside, d0) for d0 in (2.0, 0.5, 0.25))
    left = departures(truth, inside, pairs)
    return Outcome(
        whole,
        late,
        fine,
        finest,
        det,
        ass,
        invented(scene, tracks),
        delays(truth, pairs).tolist(),
        left.ghosts.tolist(),
        left.takeovers,
        existence(inside, pairs).tolist(),
        spent,
    )


SUMMARY = {
    "HOTA": 2, "+-": 2, ">10 s": 2, "d0=.5": 2, "DetA": 2, "AssA": 2, "invent": 2, "birth s": 2, "ghost s": 2,
    "95 %": 1, "left": 0, "taken": 0, "Brier": 3, "ms": 2,
}  # fmt: skip
"""The numbers of `summary`, and how many decimals a table shows."""


def summary(outcomes: list[Outcome]) -> dict[str, float]:
    """Means over the scenes of a case, with the standard error of HOTA; over all people or departures; least time."""
    ghosts = np.array([ghost for one in outcomes for ghost in one.ghosts])
    each = np.array([one.hota for one in outcomes])
    n, bins = len(outcomes), np.array([one.bins for one in outcomes]).sum((0, 1))
    return {
        "HOTA": float(each.mean()),
        "+-": float(each.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan,
        ">10 s": mean([one.late for one in outcomes]),
        "d0=.5": mean([one.fine for one in outcomes]),
        "DetA": mean([one.det for one in outcomes]),
        "AssA": mean([one.ass for one in outcomes]),
        "invent": mean([one.invented for one in outcomes]),
        "birth s": mean([birth for one in outcomes for birth in one.births]),
        "ghost s": float(ghosts.mean()) if len(ghosts) else math.nan,
        "95 %": float(np.percentile(ghosts, 95)) if len(ghosts) else math.nan,
        "left": len(ghosts),
        "taken": sum(one.takeovers for one in outcomes),
        "Brier": bins[3] / bins[0] if bins[0] else math.nan,
        "ms": min(one.spent for one in outcomes),
    }


def mean(values: Iterable[float]) -> float:
    """Mean of those that are not NaN, NaN of none."""
    known = [v for v in values if not math.isnan(v)]
    return math.fsum(known) / len(known) if known else math.nan
