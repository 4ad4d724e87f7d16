"""Detections, metres and milliseconds of avdetect-video's detectors on random scenes that no training has seen.

    make bench-detection [BENCH_FLAGS="--scenes 40 --model yolo.onnx"]

Writes detection.md, detection.jsonl and detection.svg into --out. Scenes, looks, lenses, camera heights and furniture
are random (examples/train-detector/renders.py), pictures 1920 × 1080. A person counts as one to be found if at least a
third of the body is seen; errors are of x and y against the point on the floor under the body. Times are CPU
milliseconds of one thread, without reading files.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import moderngl
import numpy as np
from figures import Row, figure, hand_over

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent / "examples" / "train-detector"))

from judge import Verdict, average_precision, overlaps
from renders import Shot, shots

from avcli.detection import network
from avcli.detection.body import Person
from avcli.detection.depth import DepthDetector, place_centre
from avcli.detection.gate import Gate
from avcli.detection.network import Boxes, Network
from avcli.detection.view import View
from avcli.scene import render, scenario

SIZE = (1920, 1080)
BINS = (0.0, 0.3, 0.6, 1.0, 9.0)
"""Distances of people from the camera's axis, in camera heights."""
GATE_M = 1.0
"""m; a position farther from everybody is false."""


def scenes(
    count: int, frames: int, seed: int | list[int], context: moderngl.Context | None = None, **options: Any
) -> Iterator[tuple[list[Shot], View]]:
    """Yield (shots, view at stride 4) of random scenes; options as `shots` has them."""
    rng, context = np.random.default_rng(seed), context or render.open_context()
    context.gc_mode = "auto"  # a scene's textures go with it
    while count:
        try:
            drawn = list(shots(rng, *SIZE, frames, context, **options))
        except scenario.ScenarioError:
            continue
        if drawn:
            first = drawn[0].view
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = first.rotation, first.origin
            yield drawn, View(first.lens, pose, SIZE, first.theta_max)
            count -= 1


class Tally:
    """What one way of detecting has found."""

    def __init__(self, name: str):
        self.name = name
        self.ms: list[float] = []
        self.errors: list[float] = []
        self.nees: list[float] = []
        self.bins: list[int] = []
        self.people = self.missed = self.false = 0
        self.scores: list[float] = []
        self.right: list[float] = []

    def add(self, shot: Shot, view: View, people: list[Person], ms: float) -> None:
        """Match the people found in a frame with those who are there."""
        self.ms.append(ms)
        taken: set[int] = set()
        for person in sorted(people, key=lambda one: -one.score):
            away = np.linalg.norm(shot.places - person.position[:2], axis=1)
            away[list(taken)] = np.inf
            if not len(away) or away.min() > GATE_M:
                self.false += 1
                continue
            best = int(away.argmin())
            taken.add(best)
            if shot.visible[best] >= 1 / 3:
                error = person.position[:2] - shot.places[best]
                self.errors.append(away[best])
                self.nees.append(error @ np.linalg.solve(person.covariance[:2, :2], error))
                radius = np.linalg.norm(shot.places[best] - view.origin[:2]) / view.origin[2]
                self.bins.append(np.searchsorted(BINS, radius, "right") - 1)
        seen = np.flatnonzero(shot.visible >= 1 / 3)
        self.people += len(seen)
        self.missed += sum(index not in taken for index in seen)

    def rank(self, shot: Shot, found: Boxes) -> None:
        """Collect a network's boxes for its average precision."""
        must, taken = shot.visible >= 1 / 3, np.zeros(len(shot.boxes), bool)
        for box, score in zip(found.boxes, found.scores, strict=True):
            overlap = overlaps(box, shot.boxes)
            overlap[taken] = 0.0
            best = int(overlap.argmax()) if len(overlap) else -1
            hit = best >= 0 and overlap[best] >= 0.5
            if hit:
                taken[best] = True
            if not hit or must[best]:
                self.scores.append(score)
                self.right.append(float(hit))

    def row(self) -> dict[str, Any]:
        """Sum up as one row of the table."""
        errors, bins = np.array(self.errors), np.array(self.bins)
        row: dict[str, Any] = {"detector": self.name, "people": self.people, "frames": len(self.ms)}
        row["recall"] = 1 - self.missed / max(self.people, 1)
        row["false_per_frame"] = self.false / max(len(self.ms), 1)
        if self.scores:
            verdict = Verdict(np.array(self.scores), np.array(self.right), np.empty(0), self.people, 0, 0)
            row["AP50"] = average_precision(verdict)
        if len(errors):
            row |= {"median_m": np.median(errors), "p99_m": np.quantile(errors, 0.99), "max_m": errors.max()}
            row["nees"] = float(np.mean(self.nees))
            for index in range(len(BINS) - 1):
                here = bins == index
                row[f"median_m {BINS[index]:g}-{BINS[index + 1]:g} h"] = np.median(errors[here]) if here.any() else None
        row["ms"] = float(np.median(self.ms))
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in row.items()}


def figures(row: dict[str, Any]) -> Iterator[Row]:
    peer = row["detector"].startswith("yolo")
    given = (row["detector"] if peer else f"avcli {row['detector']}", row["ms"] / 1e3, "frame")
    if "recall" not in row:
        yield figure("detect-video", "nobody", *given)
        return
    case = "random rooms, boxes are given" if row["detector"].startswith("true boxes") else "random rooms"
    yield figure("detect-video", case, *given, 1 - row["recall"], "share missed")
    if "median_m" in row:
        yield figure("detect-video", case, *given, row["median_m"], "m")


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Call a function; its result, and the CPU time that it took, ms."""
    begin = time.process_time()
    result = function(*arguments)
    return result, (time.process_time() - begin) * 1e3


def compare(networks: dict[str, Network], drawn: list[Shot], view: View, tallies: dict[str, Tally]) -> None:
    """Run every detector over the frames of one scene."""
    _ = view.rays, view.solid_angles
    background = view.sampled(drawn[0].background)
    before_room, anywhere = DepthDetector(view, background), DepthDetector(view, None)
    for shot in drawn:
        depth = view.sampled(shot.depth)
        people, ms = timed(before_room.detect, depth)
        tallies["depth"].add(shot, view, people, ms)
        truth = Boxes(shot.boxes[shot.visible > 0.05], np.ones((shot.visible > 0.05).sum()))
        people, ms = timed(before_room.place, truth, None)
        tallies["true boxes, monocular"].add(shot, view, people, ms)
        tallies["true boxes, centre pixel"].add(shot, view, *timed(place_centre, truth, depth, view))
        tallies["true boxes, depth, no background"].add(shot, view, *timed(anywhere.place, truth, depth))
        for name, finder in networks.items():
            everything, ms = timed(finder.detect, shot.picture)
            tallies[name].rank(shot, everything)
            good = everything.scores >= 0.5
            parts = None if everything.parts is None else everything.parts[good]
            found = Boxes(everything.boxes[good], everything.scores[good], parts)
            people, more = timed(before_room.place, found, depth)
            tallies[name].add(shot, view, people, ms + more)
            people, more = timed(before_room.place, found, None)
            tallies[f"{name}, monocular"].add(shot, view, people, ms + more)


def gate_rows(networks: dict[str, Network], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Milliseconds of a network on a noisy picture, still or with something small that moves, with and without gate."""
    rows = []
    room = cv2.resize(rng.integers(60, 200, (27, 48, 3), dtype=np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    for what, radius in (("a still room", 0), ("something moves in a corner", 40)):
        frames = []
        for k in range(10):
            picture = cv2.circle(room.copy(), (200 + 20 * k, 200), radius, (20, 20, 20), -1) if radius else room
            frames.append(np.clip(picture + rng.normal(0, 3, room.shape), 0, 255).astype(np.uint8))
        for name, finder in networks.items():
            for refresh in (1, 10):
                gate = Gate(refresh)
                gated(finder, gate, frames)  # which learns the sensor's noise
                _, ms = timed(gated, finder, gate, frames)
                rows.append({"detector": f"{name}, {what}, --refresh {refresh}", "ms": round(ms / len(frames), 2)})
    return rows


def gated(finder: Network, gate: Gate, frames: list[np.ndarray]) -> None:
    """Look at the frames where they change."""
    for frame in frames:
        regions = gate.changes(frame)
        if len(regions):
            finder.detect(frame, regions)


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    for row in rows:
        cells = ["" if row.get(key) is None else f"{row[key]:.3g}" if isinstance(row[key], float) else str(row[key]) for key in columns]  # fmt: skip  # noqa: E501
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def plot(tallies: dict[str, Tally], path: Path) -> None:
    """Plot the distribution of each detector's errors."""
    try:
        import matplotlib
    except ModuleNotFoundError:
        print("no plot: matplotlib is not installed")
        return
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5))
    axes.set_prop_cycle(color=pyplot.colormaps["tab20"](np.arange(20)))
    for tally in tallies.values():
        if tally.errors:
            axes.plot(np.sort(tally.errors), np.linspace(0, 1, len(tally.errors)), label=tally.name)
    axes.set(xlabel="error of x and y / m", ylabel="fraction of people found", xscale="log", xlim=(0.005, 1))
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Compare the detectors and write the table and the plot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--scenes", type=int, default=25)
    parser.add_argument("--frames", type=int, default=4, help="frames of a scene")
    parser.add_argument("--seed", type=int, default=700_000)
    parser.add_argument("--model", action="append", default=[], help="ONNX files to compare")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    networks = {}
    for path in [*map(Path, options.model), *Path(network.__file__).parent.glob("*.onnx")]:
        for size in ((640, 384), (480, 288), (320, 192)):
            made = Network(path.read_bytes(), size, confidence=0.02)
            networks[f"{path.stem} {made.size[0]}x{made.size[1]}"] = made
    names = ["depth", *(f"true boxes, {how}" for how in ("monocular", "centre pixel", "depth, no background"))]
    names += [text for name in networks for text in (name, f"{name}, monocular")]
    tallies = {name: Tally(name) for name in names}
    for drawn, view in scenes(options.scenes, options.frames, options.seed):
        compare(networks, drawn, view, tallies)
    rows = [tally.row() for tally in tallies.values()] + gate_rows(networks, np.random.default_rng(0))
    text = table(rows)
    print(text)
    (options.out / "detection.md").write_text(text)
    (options.out / "detection.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    plot(tallies, options.out / "detection.svg")
    hand_over(options.out, "detect-video", (one for row in rows for one in figures(row)))


if __name__ == "__main__":
    main()
