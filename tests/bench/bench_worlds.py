"""Random worlds through the whole pipeline: what crashes, what is warned of, and how well people are tracked.

    make bench-worlds [BENCH_FLAGS="--worlds 200"]

World k is `avsim-scene random --seed k`, with 1 to 8 people by turns, for one second. A world that worlds.jsonl in
--out has is not run again, so a long run goes on where it was stopped; media are deleted as soon as they are used.
Writes worlds.md, and sheets of all first pictures to look at.
"""

import argparse
import collections
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

BIN = Path(sys.executable).parent
SIDE, COLUMNS, ROWS = 240, 6, 5
"""px of a picture on a sheet, and how many it has."""
TRACKS = {"audio": ("a.jsonl",), "video": ("v.jsonl",), "both": ("a.jsonl", "v.jsonl")}


def read_image(path: Path) -> np.ndarray:
    """Read a picture, (height, width, 3) uint8."""
    picture = cv2.imread(str(path))
    assert picture is not None, path
    return picture


def run_world(seed: int, thumbnail: Path, seconds: float) -> dict[str, Any]:
    """Run the pipeline on a world.

    Args:
        seed: of the world.
        thumbnail: where its first picture is kept, small.
        seconds: how long it lasts.

    Returns:
        The record of worlds.jsonl: what failed, the warnings of each stage, HOTA by sensor, and wall times, s.
    """
    people = 1 + seed % 8
    found: dict[str, Any] = {"seed": seed, "people": people, "failed": [], "warnings": [], "HOTA": {}, "wall_s": {}}
    with tempfile.TemporaryDirectory(prefix="avcli-world-") as name:
        folder = Path(name)

        def run(stage: str, *options: object) -> bool:
            before = time.perf_counter()
            done = subprocess.run([BIN / stage, *map(str, options)], capture_output=True, text=True, cwd=folder)
            found["wall_s"][stage] = round(time.perf_counter() - before, 2)
            found["warnings"] += [line for line in done.stderr.splitlines() if line]
            if done.returncode:
                found["failed"].append(f"{stage}: exit {done.returncode}: {done.stderr.strip()[-300:]}")
            return not done.returncode

        world = "random", "--seed", seed, "--people", people, "--duration", seconds
        if not run("avsim-scene", *world, "-C", ".", "-o", "truth.jsonl"):
            return found
        picture = read_image(min((folder / "video/rgb").iterdir()))
        scale = SIDE / max(picture.shape[:2])
        cv2.imwrite(str(thumbnail), cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
        heard = run("avsim-audio", "-C", ".", "--error-db", -20, "truth.jsonl", "-o", "sound.jsonl")
        heard = heard and run("avdetect-audio", "-C", ".", "sound.jsonl", "-o", "a.jsonl")
        seen = run("avdetect-video", "-C", ".", "truth.jsonl", "-o", "v.jsonl")
        room = json.loads((folder / "config.json").read_bytes())["room_config"]
        found["room_m"], found["t60_s"] = room["room_dimensions_m"], room["reverberation_time_s"]
        there = {"a.jsonl": heard, "v.jsonl": seen}
        for sensor, files in TRACKS.items():
            fused = all(there[file] for file in files) and run("avfuse", "-C", ".", *files, "-o", "tracks.jsonl")
            truth = "groundtruth_sources.jsonl"
            if fused and run("aveval", truth, "tracks.jsonl", "--format", "jsonl", "-o", "score.jsonl"):
                score = json.loads((folder / "score.jsonl").read_text().splitlines()[0])
                found["HOTA"][sensor] = score["summary"]["HOTA"]
    return found


def kind(warning: str) -> str:
    """A warning without its numbers and names."""
    return re.sub(r"-?\d+(\.\d+)?(e-?\d+)?", "#", re.sub(r"/\S+/|avcli-world-\w+ ", "", warning))


def as_table(records: list[dict[str, Any]]) -> str:
    """What happened in all worlds, as Markdown."""
    failed = [(record["seed"], text) for record in records for text in record["failed"]]
    lines = [f"{len(records)} random worlds, {len(failed)} failures of a stage.", ""]
    lines += [f"- world {seed}: {text}" for seed, text in failed]
    lines += ["", "| HOTA | worlds | least | 10 % | 25 % | median | 75 % | mean |", "|---|---|---|---|---|---|---|---|"]
    for sensor in TRACKS:
        values = [100 * record["HOTA"][sensor] for record in records if sensor in record["HOTA"]]
        if values:
            figures = [*np.quantile(values, [0, 0.1, 0.25, 0.5, 0.75]), np.mean(values)]
            lines.append(f"| {sensor} | {len(values)} | " + " | ".join(f"{value:.1f}" for value in figures) + " |")
    counts: collections.Counter[str] = collections.Counter()
    for record in records:
        counts.update({kind(warning) for warning in record["warnings"]})
    lines += ["", "| warning | worlds |", "|---|---|"]
    lines += [f"| {text.replace('|', '/')} | {count} |" for text, count in counts.most_common()]
    return "\n".join(lines) + "\n"


def sheets(pictures: list[Path], out: Path) -> None:
    """Write the pictures, side by side, into out/sheet-N.png."""
    for number in range(0, len(pictures), COLUMNS * ROWS):
        shown = pictures[number : number + COLUMNS * ROWS]
        sheet = np.full((-(-len(shown) // COLUMNS) * SIDE, COLUMNS * SIDE, 3), 40, np.uint8)
        for place, path in enumerate(shown):
            picture = read_image(path)
            y, x = (SIDE * index for index in divmod(place, COLUMNS))
            sheet[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
            cv2.putText(sheet, path.stem, (x + 4, y + SIDE - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 255, 255), 1)
        cv2.imwrite(str(out / f"sheet-{number // (COLUMNS * ROWS) + 1}.png"), sheet)


def main() -> None:
    """Run the worlds that are missing, and write the table and the sheets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--worlds", type=int, default=60, help="seeds 0 to this number")
    parser.add_argument("--at-most", type=int, help="run no more than so many now")
    parser.add_argument("--seconds", type=float, default=1.0)
    options = parser.parse_args()
    pictures = options.out / "worlds"
    pictures.mkdir(parents=True, exist_ok=True)
    log = options.out / "worlds.jsonl"
    known = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    missing = sorted(set(range(options.worlds)) - {record["seed"] for record in known})
    for seed in missing[: options.at_most]:
        known.append(run_world(seed, pictures / f"{seed:04d}.png", options.seconds))
        with log.open("a") as file:
            file.write(json.dumps(known[-1]) + "\n")
    (options.out / "worlds.md").write_text(table := as_table(known))
    sheets(sorted(pictures.iterdir()), options.out)
    sys.stdout.write(table)


if __name__ == "__main__":
    main()
