"""Trackers on a data set of `make datasets`: tracks of each in MOTChallenge's layout, and the leaderboard of them.

    make bench-datasets BENCH_FLAGS="--data out/datasets/MOT26"

avfuse's own trackers, what the thesis set (`--preset thesis`), each sensor alone, and the peers of bench_tracking.py,
whose parameters were fitted on other data (tracking_peers.json). All get the same detections: those of avcli's
detectors, which the data set has. Nothing is fitted here. The table goes to datasets.md below --out.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import walks
from tracking_peers import PEERS, register
from tracking_runs import Variant, fuse

OURS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "ms-glmb": (("audio", "video"), ()),
    "ms-glmb-video": (("video",), ()),
    "ms-glmb-audio": (("audio",), ()),
    "lmb": (("audio", "video"), ("--tracker", "lmb")),
    "gnn": (("audio", "video"), ("--tracker", "gnn")),
    "thesis": (("audio", "video"), ("--preset", "thesis")),
}
"""avfuse's: the sensors and the options."""
BIN = Path(sys.executable).parent
NAMES = ("HOTA", "DetA", "AssA", "LocA", "MOTA", "IDF1")


def track(sequence: Path, out: Path) -> None:
    """Write the tracks of every tracker for one sequence."""
    there = [one for one in ("audio", "video") if (sequence / f"localization/{one}_localizations.jsonl").exists()]
    for name, (sensors, options) in OURS.items():
        files = [sequence / f"localization/{one}_localizations.jsonl" for one in sensors if one in there]
        if files and (len(sensors) > 1 or len(there) > 1):
            target = out / name / f"{sequence.name}.jsonl"
            target.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run([BIN / "avfuse", "-q", "-C", sequence, *options, *files, "-o", target], check=True)
    scene = walks.ready(sequence, tuple(there))
    for name in PEERS:
        (out / name).mkdir(parents=True, exist_ok=True)
        frames, _ = fuse(scene, Variant(name))
        lines = [
            json.dumps(
                {
                    "timestamp": time,
                    "objects": [
                        {"object_id": identity, "position": [*place, 0.0]}
                        for identity, place in zip(frame.ids, frame.xy.tolist(), strict=True)
                    ],
                }
            )
            for (time, *_), frame in zip(scene.truth, frames, strict=True)
        ]
        (out / name / f"{sequence.name}.jsonl").write_text("\n".join(lines) + "\n")


def table(records: list[dict]) -> str:
    """One row a tracker of each level and distance."""
    lines = [f"| | tracker | {' | '.join(NAMES)} | RMSE m |", "|---|---|" + "---:|" * (len(NAMES) + 1)]
    for record in records:
        summary = record["summary"]
        rmse = "-" if summary["RMSE"] is None else f"{summary['RMSE']:.3f}"
        cells = [f"{100 * summary[name]:.1f}" for name in NAMES]
        lines.append(f"| {record['sequence']} | {record['tracker']} | {' | '.join(cells)} | {rmse} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("out/datasets/MOT26"), help="a set, or a split of it")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    given = parser.parse_args()
    register()
    tracks = given.out / "datasets"
    for path in sorted(given.data.rglob("seqinfo.ini")):
        print(path.parent.name, file=sys.stderr)
        track(path.parent, tracks)
    trackers = sorted(path for path in tracks.iterdir() if path.is_dir())
    command = [BIN / "aveval", "--leaderboard", given.data, *trackers, "--format", "jsonl"]
    records = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    text = table([json.loads(line) for line in records.splitlines()])
    (given.out / "datasets.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
