"""What features can tell at best of two people who part: an observer who knows all but who is who.

    python tests/bench/features_limit.py parting-voice 0 20

The observer is told which detection belongs to whom before and after the meeting, and the model that drew the features.
While the two are together it learns nothing. Afterwards it reports, at any time, the likelier of the two assignments;
before there is a word or a look, a coin decides (both ways are scored, and the mean counts). No tracker that answers at
once can do better on the mean.
"""

import math
import sys
from dataclasses import replace

import numpy as np
from features_scenes import LOOKS, MIXED, VOICE, Drawn
from tracking_cases import scene_of
from tracking_measures import outcome
from tracking_runs import Frame, ceiling
from tracking_scenes import Scene

Look = tuple[float, np.ndarray, np.ndarray]  # time in s, and (d,) vector and standard deviations


def evidence(looks: list[Look], drawn: Drawn) -> float:
    """Log density of all looks at one person."""
    if not looks:
        return 0.0
    one = drawn.population
    t, vectors, sds = (np.array(column) for column in zip(*looks, strict=True))
    lasting = one.correlated * np.exp(-abs(t[:, None] - t) / one.correlation_s) + (1 - one.correlated) * np.eye(len(t))
    total = 0.0
    for value, sd, between, mean in zip(vectors.T, sds.T, one.between, one.mean, strict=True):
        lower = np.linalg.cholesky(between + np.outer(sd, sd) * lasting)
        white = np.linalg.solve(lower, value - mean)
        total += float(-0.5 * white @ white - np.log(np.diag(lower)).sum() - len(t) / 2 * math.log(2 * math.pi))
    return total


def together(scene: Scene) -> tuple[float, float]:
    """First and last time (s) at which the two may be mixed up in one vector."""
    near = [t for t, ids, xy in scene.truth if len(ids) == 2 and np.linalg.norm(xy[0] - xy[1]) < MIXED]
    return min(near), max(near)


def ratios(scene: Scene, name: str, drawn: Drawn) -> list[tuple[float, float]]:
    """Times, and the log ratio of the true assignment to the exchanged one, from when they part on."""
    begin, end = together(scene)
    before: list[list[Look]] = [[], []]
    after: list[list[Look]] = [[], []]
    out = []
    for (t, _, _, _, owners), features in zip(scene.records, scene.features, strict=True):
        one = features.get(name)
        for j, i in enumerate(owners.tolist() if one is not None and not begin <= t <= end else ()):
            if one is not None and i >= 0 and np.isfinite(one.vectors[j]).all():
                (before if t < begin else after)[i].append((t, one.vectors[j], one.sds[j]))
        if t >= end:
            true, false = (
                sum(evidence(before[i] + after[i if same else 1 - i], drawn) for i in (0, 1)) for same in (True, False)
            )
            out.append((t, true - false if any(after) else 0.0))
    return out


def reported(scene: Scene, told: list[tuple[float, float]], coin: float) -> list[Frame]:
    """The tracks of the filter that knows who is who, with the observer's labels; the sign of `coin` decides a tie."""
    middle, out = sum(together(scene)) / 2, []
    for (t, *_), frame in zip(scene.truth, ceiling(scene), strict=True):
        ratio = next((one for when, one in reversed(told) if when <= t), 0.0) + coin
        swapped = t >= middle and ratio < 0
        out.append(replace(frame, ids=[1 - i if swapped and i in (0, 1) else i for i in frame.ids]))
    return out


def main() -> None:
    """Print HOTA of the observer, of the filter that knows, and in how many scenes the observer ends wrong."""
    case, first, last = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    name, drawn = next(iter((VOICE if case == "parting-voice" else LOOKS).items()))
    at_best, known, wrong = [], [], 0
    for seed in range(first, last):
        scene = scene_of(case, seed)
        told = ratios(scene, name, drawn)
        both = [outcome(scene, reported(scene, told, coin), 0.0).hota for coin in (1e-9, -1e-9)]
        at_best.append(float(np.mean(both)))
        known.append(outcome(scene, ceiling(scene), 0.0).hota)
        wrong += told[-1][1] < 0
    error = np.std(at_best, ddof=1) / math.sqrt(len(at_best))
    print(f"{case}: at best {np.mean(at_best):.1f} +- {error:.1f}, wrong at the end in {wrong} of {last - first}")
    print(f"told who is who: {np.mean(known):.1f}")


if __name__ == "__main__":
    main()
