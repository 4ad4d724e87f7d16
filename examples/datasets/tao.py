#!/usr/bin/env python3
"""Make experiments of TAO's annotations, one for each video: config.json and ground truth.

    python examples/datasets/tao.py annotations/validation.json --scale 0.05 -C out/tao
    aveval out/tao/VIDEO/groundtruth_sources.jsonl t.jsonl

The format (A. Dave, T. Khurana, P. Tokmakov, C. Schmid, D. Ramanan, "TAO: A Large-Scale Benchmark for Tracking Any
Object", ECCV 2020; BDD100K, LVIS-VIS and others use it too) is a JSON file with lists: `videos` (id, name), `images`
(id, video_id, frame_index), `tracks` (id, category_id), `annotations` (image_id, track_id, category_id, bbox [left,
top, width, height] px) and `categories` (id, name). Only some frames are annotated, those of `images`: they become
records, and aveval says how many records of a track have no ground truth.

avcli scores people in metres, and this file has pixels: say where the ground is (one of --config, --homography,
--scale). A person stands at the middle of the lower side of the box. --rate is the rate of frame_index (TAO's films
have 24 to 30; its annotations have one frame a second). The annotations are MIT-licensed; the films' terms differ.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
from experiment import people, run, save
from ground import Ground, add_options, at_home, ground_of


def convert(annotations: Path, out: Path, ground: Ground, category: str, rate: float) -> None:
    """Write an experiment for each video that has people.

    Args:
        annotations: the JSON file.
        out: the directory of the experiments; it must be empty or missing.
        ground: where the floor is.
        category: name of the category that is people.
        rate: frames a second of frame_index.

    Raises:
        ValueError: the file is not of that format, or nobody is in it; `out` is not empty.
    """
    table = json.loads(annotations.read_text(encoding="utf-8"))
    missing = {"videos", "images", "annotations", "categories"} - set(table)
    if missing:
        raise ValueError(f"{annotations}: has no {', '.join(sorted(missing))}")
    if out.exists() and any(out.iterdir()):
        raise ValueError(f"{out}: is not empty")
    names = {one["name"]: one["id"] for one in table["categories"]}
    if category not in names:
        raise ValueError(f"{annotations}: has no category {category!r}")
    in_picture = defaultdict(list)
    for one in table["annotations"]:
        if one["category_id"] == names[category]:
            in_picture[one["image_id"]].append(one)
    films = defaultdict(list)
    for image in table["images"]:
        films[image["video_id"]].append(image)
    written = 0
    for film in table["videos"]:
        pictures = sorted(films[film["id"]], key=lambda one: one["frame_index"])
        found = [one for picture in pictures for one in in_picture[picture["id"]]]
        if not found:
            continue
        boxes = np.array([one["bbox"] for one in found], float).reshape(-1, 4)
        places, config = at_home(boxes[:, :2] + boxes[:, 2:] * [0.5, 1.0], ground)
        place = {id(one): row for one, row in zip(found, places, strict=True)}
        truth = [
            people(
                picture["frame_index"] / rate,
                {one["track_id"]: place[id(one)] for one in in_picture[picture["id"]]},
                bbox_px={
                    one["track_id"]: [x, y, x + width, y + height]
                    for one in in_picture[picture["id"]]
                    for x, y, width, height in [one["bbox"]]
                },
            )
            for picture in pictures
        ]
        save(out / film["name"], config | {"session_id": film["name"]}, {"groundtruth_sources.jsonl": truth})
        written += 1
    if not written:
        raise ValueError(f"{annotations}: no video shows a {category}")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("annotations", type=Path)
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the directory of the experiments")
    add_options(parser)
    parser.add_argument("--category", default="person", help="name of the category that is people")
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second of frame_index")
    given = parser.parse_args()
    run(lambda: convert(given.annotations, given.out, ground_of(given), given.category, given.rate))


if __name__ == "__main__":
    main()
