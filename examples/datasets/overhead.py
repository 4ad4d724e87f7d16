#!/usr/bin/env python3
"""Make an experiment of pictures of a ceiling fisheye with turned boxes: CEPDOF's JSON, or HABBOF's text files.

    python examples/datasets/overhead.py CEPDOF/Lunch1 --boxes CEPDOF/annotations/Lunch1.json -C out/lunch1
    python examples/datasets/overhead.py HABBOF/Meeting1 -C out/meeting1
    avdetect-video -C out/lunch1 out/lunch1/frames.jsonl -o v.jsonl
    avfuse -C out/lunch1 v.jsonl -o t.jsonl
    aveval -C out/lunch1 out/lunch1/groundtruth_sources.jsonl t.jsonl --detections v.jsonl --format table

The data: Z. Duan, M. O. Tezcan, H. Nakamura, P. Ishwar, J. Konrad, "RAPiD: Rotation-Aware People Detection in Overhead
Fisheye Images", CVPR Workshops 2020 (CEPDOF; ten frames of it are in github.com/duanzhiihao/CEPDOF_tools); S. Li et
al., "Supervised People Counting Using An Overhead Fisheye Camera", AVSS 2019 (HABBOF). Boston University gives both for
research; WEPDTOF and MW-R have CEPDOF's format.

A box is [middle x, middle y, width, height, degrees clockwise], px; HABBOF has a text file for each picture, beside it:
`person x y width height degrees`. CEPDOF's person_id becomes the identity. HABBOF has none: identities are then new in
each picture, and only detections can be scored.

Assumed, because the sets do not say it: the lens is equidistant, with --fov degrees across the shorter side; it hangs
--height m above the floor and looks straight down. A person stands where the box's long axis comes nearest to the
middle of the picture. Places in metres are as good as that. Boxes whose feet are more than --reach m from the camera
are left out, and counted.
"""

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from experiment import people, run, save
from ground import places_below

from avcli.formats.experiment import Config

Boxes = list[tuple[int | str, list[float]]]
"""Identities, and boxes [x, y, width, height, degrees]."""


def of_json(path: Path) -> Iterator[tuple[str, Boxes]]:
    """Read CEPDOF's annotations: the name of each picture and its boxes, in the order of the names."""
    table = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(table, dict) or not {"images", "annotations"} <= table.keys():
        raise ValueError(f"{path}: has no images or no annotations")
    boxes: dict[Any, Boxes] = defaultdict(list)
    for number, one in enumerate(table["annotations"]):
        if len(one["bbox"]) != 5:
            raise ValueError(f"{path}: annotation {number}: a turned box has 5 numbers, found {len(one['bbox'])}")
        boxes[one["image_id"]].append((one.get("person_id", f"{one['image_id']}-{number}"), one["bbox"]))
    for image in sorted(table["images"], key=lambda one: one["file_name"]):
        yield image["file_name"], boxes[image["id"]]


def of_text(folder: Path) -> Iterator[tuple[str, Boxes]]:
    """Read HABBOF's text files: the name of each picture and its boxes, in the order of the names."""
    for path in sorted(folder.glob("*.txt")):
        boxes: Boxes = []
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            cells = line.split()
            try:
                box = [float(cell) for cell in cells[1:]]
            except ValueError:
                box = []
            if cells and len(box) != 5:
                raise ValueError(f"{path}:{number}: expected `person x y width height degrees`")
            if cells:
                boxes.append((f"{path.stem}-{number}", box))
        yield f"{path.stem}.jpg", boxes


def feet(boxes: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return where people stand, (n, 2) px: the points of the boxes' long axes nearest to the picture's middle."""
    turn = np.deg2rad(boxes[:, 4])
    upwards = np.stack([np.sin(turn), -np.cos(turn)], axis=1)
    along = ((middle - boxes[:, :2]) * upwards).sum(axis=1)
    return boxes[:, :2] + np.clip(along, -boxes[:, 3] / 2, boxes[:, 3] / 2)[:, None] * upwards


def hull(boxes: np.ndarray) -> np.ndarray:
    """Return the upright boxes (n, 4) [x0, y0, x1, y1] around turned ones, px."""
    turn = np.deg2rad(boxes[:, 4:])
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half = np.concatenate([cos * boxes[:, 2:3] + sin * boxes[:, 3:4], sin * boxes[:, 2:3] + cos * boxes[:, 3:4]], 1) / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def equidistant(size: tuple[int, int], fov: float, height: float, reach: float, rate: float) -> dict[str, Any]:
    """Return config.json of the assumed camera, in the middle of a room; size: width and height of the picture, px."""
    width, tall = size
    focal = min(size) / np.deg2rad(fov)
    return {
        "camera_config": {
            "lens_model": "kannala_brandt",
            "fx_px": focal,
            "fy_px": focal,
            "cx_px": (width - 1) / 2,
            "cy_px": (tall - 1) / 2,
            "camera_position_m": [reach, reach, height],
            "image_width_px": width,
            "image_height_px": tall,
            "image_circle_px": [(width - 1) / 2, (tall - 1) / 2, min(size) / 2],
            "frame_rate_hz": rate,
        },
        "room_config": {"room_dimensions_m": [2 * reach, 2 * reach, height + 0.1]},
    }


def convert(folder: Path, boxes: Path | None, out: Path, fov: float, height: float, reach: float, rate: float) -> None:
    """Write the experiment of a folder of pictures.

    Args:
        folder: of the pictures, and of HABBOF's text files.
        boxes: CEPDOF's JSON; None: text files.
        out: of the experiment; it must be empty or missing.
        fov: degrees across the picture's shorter side.
        height: of the camera, m.
        reach: m from the camera up to which people are kept.
        rate: pictures a second.

    Raises:
        ValueError: the folder is not of that layout; `out` is not empty.
    """
    pictures = list(of_json(boxes) if boxes else of_text(folder))
    if not pictures:
        raise ValueError(f"{folder}: has no text files of boxes; CEPDOF's are in a file: --boxes")
    first = cv2.imread(str(folder / pictures[0][0]))
    if first is None:
        raise ValueError(f"{folder / pictures[0][0]}: is no picture that can be read")
    config = equidistant((first.shape[1], first.shape[0]), fov, height, reach, rate)
    camera = Config(config).camera
    truth, frames, far, count = [], [], 0, 0
    for number, (name, found) in enumerate(pictures):
        rows = np.array([box for _, box in found], float).reshape(-1, 5)
        stand = places_below(camera, feet(rows, np.array([camera.lens.cx, camera.lens.cy])))
        near = np.linalg.norm(stand - reach, axis=1) <= reach
        ids = [identity for identity, _ in found]
        far, count = far + int((~near).sum()), count + len(found)
        truth.append(
            people(
                number / rate,
                {identity: place for identity, place, kept in zip(ids, stand, near, strict=True) if kept},
                bbox_px=dict(zip(ids, hull(rows).round(2).tolist(), strict=True)),
                turned_px=dict(zip(ids, rows.tolist(), strict=True)),
            )
        )
        frames.append({"timestamp": truth[-1]["timestamp"], "frame": {"rgb": str((folder / name).resolve())}})
    save(out, config, {"groundtruth_sources.jsonl": truth, "frames.jsonl": frames})
    if far:
        print(
            f"overhead.py: {far} of {count} boxes stand more than {reach:g} m from the camera: left out",
            file=sys.stderr,
        )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the experiment's directory")
    parser.add_argument("--boxes", type=Path, help="annotations in CEPDOF's JSON")
    parser.add_argument("--fov", type=float, default=180.0, help="degrees across the picture's shorter side")
    parser.add_argument("--height", type=float, default=3.0, help="of the camera above the floor, m")
    parser.add_argument("--reach", type=float, default=8.0, help="m from the camera up to which people are kept")
    parser.add_argument("--rate", type=float, default=10.0, help="pictures a second")
    given = parser.parse_args()
    run(lambda: convert(given.folder, given.boxes, given.out, given.fov, given.height, given.reach, given.rate))


if __name__ == "__main__":
    main()
