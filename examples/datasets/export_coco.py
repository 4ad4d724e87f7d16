#!/usr/bin/env python3
"""Write avdetect-video's boxes as COCO results, which pycocotools, FiftyOne and others evaluate.

    avsim-scene s3 -C out/s3 --coco s3.json -o s3.jsonl
    avdetect-video -C out/s3 s3.jsonl | python examples/datasets/export_coco.py s3.json >results.json

    from pycocotools.coco import COCO; from pycocotools.cocoeval import COCOeval
    truth = COCO("s3.json"); score = COCOeval(truth, truth.loadRes("results.json"), "bbox")
    score.evaluate(); score.accumulate(); score.summarize()

COCO counts pictures by numbers and avcli by time: a record belongs to the picture whose file name ends with its time,
as avsim-scene names them. Boxes are [left, top, width, height] px. Detections without a box are left out, and counted.
"""

import json
import re
import sys
from collections.abc import Iterable
from typing import Any


def results(lines: Iterable[str], images: Iterable[dict[str, Any]]) -> tuple[list[dict[str, Any]], int]:
    """Convert records of detections: COCO's results, and how many had no box.

    Raises:
        ValueError: there is no picture of a record's time.
    """
    numbers = {}
    for image in images:
        if time := re.search(r"_(\d+\.\d+)\.\w+$", image["file_name"]):
            numbers[round(float(time[1]), 4)] = image["id"]
    found, boxless = [], 0
    for line in lines:
        record = json.loads(line)
        time = round(float(record["timestamp"]), 4)
        if time not in numbers:
            raise ValueError(f"there is no picture of the time {time:g} s")
        for one in record["objects"]:
            if "bbox_px" not in one:
                boxless += 1
                continue
            x0, y0, x1, y1 = one["bbox_px"]
            box = [x0, y0, round(x1 - x0, 2), round(y1 - y0, 2)]
            score = one.get("score", 1.0)
            found.append({"image_id": numbers[time], "category_id": 1, "bbox": box, "score": score})
    return found, boxless


def main() -> None:
    """Run from the command line."""
    if len(sys.argv) != 2:
        sys.exit("usage: export_coco.py COCO.json <detections.jsonl >results.json")
    try:
        with open(sys.argv[1], encoding="utf-8") as stream:
            found, boxless = results(sys.stdin, json.load(stream)["images"])
    except (OSError, ValueError, KeyError) as error:
        sys.exit(f"export_coco.py: {error}")
    print(json.dumps(found))
    if boxless:
        print(f"export_coco.py: {boxless} detections have no box: left out", file=sys.stderr)


if __name__ == "__main__":
    main()
