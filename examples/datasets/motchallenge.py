#!/usr/bin/env python3
"""Make an experiment of a MOTChallenge sequence: config.json, ground truth, and its public detections.

    python examples/datasets/motchallenge.py MOT15/train/PETS09-S2L1 --homography H.txt -C out/pets
    avfuse -C out/pets --doors anywhere --sigma camera=0.3 out/pets/detections.jsonl -o t.jsonl
    aveval out/pets/groundtruth_sources.jsonl t.jsonl

The layout (P. Dendorfer et al., "MOTChallenge: A Benchmark for Single-Camera Multiple Target Tracking", IJCV 2021):
seqinfo.ini with frameRate; gt/gt.txt and det/det.txt with rows of frame (from 1), identity (-1: a detection), left,
top, width, height px, confidence, ... In the ground truth of MOT16 and later rows of confidence 0 are not scored, and
column 8 is the class: 1 is a pedestrian (--class). MOT15 has no classes.

avcli scores people in metres, and these files have pixels: say where the ground is (one of --config, --homography,
--scale). A person stands at the middle of the lower side of the box. Detections have no covariance: say their noise to
avfuse (--sigma). The sets are for research (CC BY-NC-SA 3.0).
"""

import argparse
import configparser
from pathlib import Path

import numpy as np
from experiment import people, run, save
from ground import Ground, add_options, at_home, ground_of


def rows_of(path: Path, least: int) -> np.ndarray:
    """Read the rows (n, 10) of a file of boxes; -1 where a column is missing.

    Raises:
        ValueError: a row, named by its line, has a word or fewer than `least` columns.
    """
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if line.strip():
            try:
                cells = [float(cell) for cell in line.replace(",", " ").split()]
            except ValueError:
                raise ValueError(f"{path}:{number}: a value is not a number") from None
            if len(cells) < least or not np.isfinite(cells).all() or cells[0] < 1 or cells[0] % 1:
                raise ValueError(f"{path}:{number}: expected frame, identity, left, top, width, height, confidence")
            rows.append((cells + [-1.0] * 10)[:10])
    return np.array(rows).reshape(-1, 10)


def convert(folder: Path, out: Path, ground: Ground, kinds: list[int], rate: float | None) -> None:
    """Write the experiment of one sequence.

    Args:
        folder: of the sequence.
        out: of the experiment; it must be empty or missing.
        ground: where the floor is.
        kinds: classes that count, where the file has classes.
        rate: pictures a second; None: seqinfo.ini says it.

    Raises:
        ValueError: the folder is not of that layout; `out` is not empty.
    """
    if rate is None:
        about = configparser.ConfigParser()
        if not about.read(folder / "seqinfo.ini"):
            raise ValueError(f"{folder}: has no seqinfo.ini; say --rate")
        rate = about.getfloat("Sequence", "frameRate")
    truth = rows_of(folder / "gt" / "gt.txt", 7)
    classes = len(truth) and (truth[:, 7] >= 1).all() and (truth[:, 7] % 1 == 0).all()
    kept = (truth[:, 6] != 0) & (np.isin(truth[:, 7], kinds) if classes else True)
    truth = truth[kept]
    det = folder / "det" / "det.txt"
    found = rows_of(det, 7) if det.exists() else np.zeros((0, 10))
    both = np.concatenate([truth, found])
    places, config = at_home(both[:, 2:4] + both[:, 4:6] * [0.5, 1.0], ground)
    config["session_id"] = folder.resolve().name
    if ground.config is None:
        config |= {"sensors": {"camera": {"kind": "camera"}}, "camera_config": {"frame_rate_hz": rate}}
    boxes = np.concatenate([both[:, 2:4], both[:, 2:4] + both[:, 4:6]], axis=1)
    streams: dict[str, list[dict]] = {"groundtruth_sources.jsonl": [], "detections.jsonl": []}
    for frame in range(1, int(both[:, 0].max(initial=0)) + 1):
        time = (frame - 1) / rate
        here = np.flatnonzero(truth[:, 0] == frame)
        ids = truth[here, 1].astype(int).tolist()
        placed = dict(zip(ids, places[here], strict=True))
        record = people(time, placed, bbox_px=dict(zip(ids, boxes[here].tolist(), strict=True)))
        streams["groundtruth_sources.jsonl"].append(record)
        here = len(truth) + np.flatnonzero(found[:, 0] == frame)
        objects = [
            {"position": [*places[row].tolist(), None], "bbox_px": boxes[row].tolist()}
            for row in here
            if np.isfinite(places[row]).all()
        ]
        streams["detections.jsonl"].append({"timestamp": record["timestamp"], "sensor": "camera", "objects": objects})
    if not len(found):
        del streams["detections.jsonl"]
    save(out, config, streams)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the experiment's directory")
    add_options(parser)
    parser.add_argument("--class", dest="kinds", type=int, nargs="+", default=[1], help="classes that are people")
    parser.add_argument("--rate", type=float, help="pictures a second, in place of seqinfo.ini's")
    given = parser.parse_args()
    run(lambda: convert(given.folder, given.out, ground_of(given), given.kinds, given.rate))


if __name__ == "__main__":
    main()
