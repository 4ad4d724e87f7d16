"""aveval against TrackEval: the same figures, and how much sooner. `make bench-metrics` runs it.

Both score the same people and tracks in one process, by turns; of several rounds the least processor time counts.
Processes are timed by the wall clock, which a busy machine stretches.
"""

import argparse
import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from figures import Row, figure, hand_over

from avcli.metrics import clear, hota, identity, ospa
from avcli.metrics.matching import match
from avcli.metrics.sequence import Sequence


def crowd(people: int, frames: int, side: float, seed: int = 0) -> Sequence:
    """People who wander in a square room; tracks miss a tenth, err by 0.15 m, and 1 % of them are ghosts."""
    rng = np.random.default_rng(seed)
    wander = np.cumsum(rng.normal(0, 0.1, (frames, people, 2)), axis=0) + rng.uniform(0, side, (people, 2))
    position = np.abs((wander + side) % (2 * side) - side)
    truth = [(np.arange(people), here) for here in position]
    track = []
    for here in position:
        seen = np.flatnonzero(rng.random(people) < 0.9)
        points = here[seen] + rng.normal(0, 0.15, (seen.size, 2))
        ghosts = rng.random(people) < 0.01
        identities = np.concatenate([seen, people + np.flatnonzero(ghosts)])
        track.append((identities, np.concatenate([points, rng.uniform(0, side, (ghosts.sum(), 2))])))
    return Sequence.of(truth, track)


def least(*functions: Callable[[], Any], rounds: int) -> list[tuple[float, Any]]:
    """Least processor time in s and last result of each function, run by turns."""
    best: list[float] = [np.inf] * len(functions)
    result: list[Any] = [None] * len(functions)
    for _ in range(rounds):
        for k, function in enumerate(functions):
            begin = time.process_time()
            result[k] = function()
            best[k] = min(best[k], time.process_time() - begin)
    return list(zip(best, result, strict=True))


def compare(trackeval: Any, people: int, frames: int, side: float, rounds: int) -> list[dict]:
    """Time and compare both on one sequence.

    Args:
        trackeval: the module.
        people: in the room.
        frames: of the sequence.
        side: m, of the square room.
        rounds: of which the fastest counts.
    """
    sequence = crowd(people, frames, side)
    data = importlib.import_module("test_metrics").trackeval_data(sequence)
    pairs = {
        "HOTA": (lambda: hota.hota(sequence), trackeval.metrics.HOTA()),
        "CLEAR": (
            lambda: clear.clear(sequence, match(sequence)),
            trackeval.metrics.CLEAR({"PRINT_CONFIG": False}),
        ),
        "Identity": (lambda: identity.identity(sequence), trackeval.metrics.Identity({"PRINT_CONFIG": False})),
    }
    rows = []
    for name, (ours, metric) in pairs.items():
        (mine, found), (theirs, expected) = least(ours, partial(metric.eval_sequence, data), rounds=rounds)
        gap = max(float(np.abs(np.asarray(found[field]) - expected[field]).max()) for field in expected)
        rows.append(
            {
                "metric": name,
                "people": people,
                "frames": frames,
                "ours_s": mine,
                "trackeval_s": theirs,
                "ratio": theirs / mine,
                "largest_difference": gap,
            }
        )
    for name, function in {
        "OSPA, GOSPA": lambda: ospa.set_distances(sequence, 1.0),
        "OSPA2": lambda: ospa.ospa2(sequence, 1.0),
    }.items():
        ((mine, _),) = least(function, rounds=rounds)
        rows.append({"metric": name, "people": people, "frames": frames, "ours_s": mine})
    return rows


def process(rounds: int) -> dict:
    """aveval as a process on 41 frames of three people, and what a bare interpreter takes beside it."""
    sequence = crowd(3, 41, 4.66)
    with tempfile.TemporaryDirectory() as folder:
        for name, points in (("truth", sequence.truth), ("tracks", sequence.track)):
            with open(Path(folder) / f"{name}.jsonl", "w") as stream:
                for t in range(41):
                    rows = range(points.start[t], points.start[t + 1])
                    objects = [
                        {"object_id": int(points.identity[i]), "position": [*points.position[i].tolist(), 0.0]}
                        for i in rows
                    ]
                    stream.write(json.dumps({"timestamp": f"{t / 10:.10f}", "objects": objects}) + "\n")
        aveval = [str(Path(sys.executable).parent / "aveval"), "truth.jsonl", "tracks.jsonl", "-o", os.devnull]

        def timed(command: list[str]) -> tuple[float, float]:
            begin, used = time.perf_counter(), os.times()
            subprocess.run(command, cwd=folder, check=True)
            now = os.times()
            processor = now.children_user + now.children_system - used.children_user - used.children_system
            return time.perf_counter() - begin, processor

        times = [(*timed(aveval), *timed([sys.executable, "-c", ""])) for _ in range(rounds)]
    wall, processor, bare, _ = (min(column) for column in zip(*times, strict=True))
    return {
        "metric": "aveval on 3 people, 41 frames",
        "wall_s": wall,
        "processor_s": processor,
        "bare_python_s": bare,
    }


def figures(row: dict[str, Any]) -> Iterator[Row]:
    """Both tools' times; the error is the largest difference from TrackEval, which is the standard."""
    case = f"{row['metric']}, {row['people']} people in {row['room_m']:g} m, {row['frames']} frames"
    error, unit = row.get("largest_difference"), "difference"
    error = 0.0 if error is not None and error < 1e-9 else error  # the order of sums
    yield figure("eval", case, "avcli", row["ours_s"], "sequence", error, unit)
    if error is not None:
        yield figure("eval", case, "TrackEval", row["trackeval_s"], "sequence", 0.0, unit)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="bench-out")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="1000 frames in place of 10,000")
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the tests know how TrackEval takes a sequence
    with contextlib.redirect_stdout(io.StringIO()):  # it prints which data sets it cannot import
        import trackeval
    rows = []
    frames = 1000 if arguments.quick else 10000
    for people, side in ((1, 4.66), (3, 4.66), (10, 10.0), (10, 4.66)):
        rows += [{**row, "room_m": side} for row in compare(trackeval, people, frames, side, arguments.rounds)]
    print(
        f"{'people':>6} {'room m':>7} {'metric':<12} {'ours s':>8} {'TrackEval s':>12} {'ratio':>7} {'difference':>11}"
    )
    for row in rows:
        line = f"{row['people']:6d} {row['room_m']:7.2f} {row['metric']:<12} {row['ours_s']:8.3f}"
        if "ratio" in row:
            line += f" {row['trackeval_s']:12.3f} {row['ratio']:7.1f} {row['largest_difference']:11.1e}"
        print(line)
    whole = process(3 * arguments.rounds)
    print(
        f"{whole['metric']}: {whole['wall_s']:.3f} s as a process ({whole['processor_s']:.3f} s of a processor), "
        f"a bare interpreter {whole['bare_python_s']:.3f} s"
    )
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    Path(arguments.out).mkdir(parents=True, exist_ok=True)
    hand_over(Path(arguments.out), "eval", (one for row in rows for one in figures(row)))
    (Path(arguments.out) / "metrics.json").write_text(json.dumps([*rows, whole], indent=1) + "\n")


if __name__ == "__main__":
    main()
