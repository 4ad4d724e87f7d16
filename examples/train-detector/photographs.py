"""Photographs of people as a camera at the ceiling might show them: turned by any angle, foreshortened, side by side.

`python photographs.py ANNOTATIONS.json PICTURES --out FOLDER` takes from COCO's person_keypoints_*.json and a folder of
its pictures those whose licence permits what is made of them to be shared: CC BY 2.0, no known copyright restrictions,
works of the US government. FOLDER then holds small pictures and photographs.jsonl, a line a picture: {"file", "source",
"licence", "people": [{"box": [x0, y0, x1, y1], "polygon": [[x, y, x, y, ...], ...] or null, "keypoints": COCO's 51
numbers or null, "crowd": bool}]}, all px; `people` is [] where nobody is seen. photographs.csv names those that the
shipped networks have seen.

From above the head is nearer than the feet: each photograph is shortened along its vertical and widened at its top.

Source:
    T.-Y. Lin et al., "Microsoft COCO: common objects in context", ECCV 2014 (labels: CC BY 4.0).
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from generate import PAD, Sample

SIDE = 640
"""px, of the squares that are made."""

SIZES = 32, 300
"""px, of whom is put in the middle."""

SMALLEST = 16
"""px: who is smaller is neither learnt nor held against the network."""

LICENCES = {4: "CC BY 2.0", 7: "No known copyright restrictions", 8: "United States government work"}
"""COCO's numbers of the licences that are taken."""

LONGEST = 460
"""px, of the longer side of the pictures that are kept."""

_FACE, _TRUNK, _ANKLES = slice(0, 5), [5, 6, 11, 12], [15, 16]


class _Person:
    """Who is in a photograph: an outline (n, 2), and torso, head and foot (3, 2), NaN where unknown; px."""

    def __init__(self, told: dict):
        x0, y0, x1, y1 = told["box"]
        self.size, self.crowd = max(x1 - x0, y1 - y0), bool(told["crowd"])
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        around = np.column_stack([np.cos(angle), np.sin(angle)])
        self.outline = around * [(x1 - x0) / 2, (y1 - y0) / 2] + [(x0 + x1) / 2, (y0 + y1) / 2]
        self.parts = np.full((3, 2), np.nan)
        if told["keypoints"]:
            points = np.reshape(told["keypoints"], (17, 3)).astype(float)
            points[points[:, 2] == 0] = np.nan
            known = points[np.isfinite(points[:, 0]), :2]
            if len(known) >= 8:  # limbs are some tenth of the body thick around them
                limbs = (known[:, None] + 0.09 * self.size * around).reshape(-1, 2)
                self.outline = np.clip(limbs, [x0, y0], [x1, y1])
            for k, which, least in ((0, _TRUNK, 3), (1, _FACE, 1), (2, _ANKLES, 2)):
                chosen = points[which, :2]
                if np.isfinite(chosen[:, 0]).sum() >= least:
                    self.parts[k] = np.nanmean(chosen, axis=0)
        if told["polygon"] and not self.crowd:
            self.outline = np.concatenate([np.reshape(ring, (-1, 2)) for ring in told["polygon"]])
        middle = [(x0 + x1) / 2, 0.6 * y0 + 0.4 * y1]
        self.spot = np.where(np.isfinite(self.parts[0]), self.parts[0], middle)


class Photographs:
    """Calling it draws a square of one to four photographs."""

    def __init__(self, folder: Path, seed: int):
        self.rng = np.random.default_rng(seed)
        self.pictures = []
        for line in (folder / "photographs.jsonl").read_text().splitlines():
            told = json.loads(line)
            people = [_Person(one) for one in told["people"]]
            self.pictures.append((folder / told["file"], people))

    def __call__(self) -> Sample:
        rng, out = self.rng, np.full((SIDE, SIDE, 3), PAD, np.uint8)
        x, y = (int(value) for value in rng.uniform(0.3, 0.7, 2) * SIDE)
        cells = [(0, 0, x, y), (x, 0, SIDE, y), (0, y, x, SIDE), (x, y, SIDE, SIDE)]
        if rng.random() < 0.3:
            cells = [(0, 0, SIDE, SIDE)]
        rows = [row for cell in cells for row in self._put(out, *cell)]
        boxes, parts, anchors, visible = zip(*rows, strict=True) if rows else ([], [], [], [])
        return Sample(
            out, np.reshape(boxes, (-1, 4)), np.reshape(parts, (-1, 3, 2)), np.reshape(anchors, (-1, 2)),
            np.array(visible, float),
        )  # fmt: skip

    def _put(self, out: np.ndarray, x0: int, y0: int, x1: int, y1: int) -> list[tuple]:
        """Show a part of a photograph in a cell, somebody of it near the middle; who is seen there, as in `Sample`."""
        rng = self.rng
        path, people = self.pictures[rng.integers(len(self.pictures))]
        picture = cv2.imread(str(path))[..., ::-1]
        height, width = picture.shape[:2]
        cover = max((x1 - x0) / width, (y1 - y0) / height)
        scale, centre = min(cover * np.exp(rng.uniform(-0.3, 0.9)), 1.6), rng.uniform(0.3, 0.7, 2) * [width, height]
        fitting = [one for one in people if not one.crowd and SIZES[0] < one.size * scale < SIZES[1]]
        if fitting:
            centre = fitting[rng.integers(len(fitting))].outline.mean(axis=0)
        elif people and max(one.size for one in people) * scale > SIZES[1]:
            scale *= SIZES[1] / (max(one.size for one in people) * scale)
        angle, short, wide = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.0), rng.uniform(0.0, 0.5)
        cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
        mirror = rng.choice([-1.0, 1.0])
        to_middle = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1.0]])
        # Points above the middle come nearer: their divisor falls below one.
        from_above = np.array([[mirror, 0, 0], [0, short, 0], [0, wide * (1 - short) / max(height, width), 1.0]])
        place = rng.normal(0, 0.12, 2) * [x1 - x0, y1 - y0] + [(x1 - x0) / 2, (y1 - y0) / 2]
        turn = np.array([[cosine, -sine, place[0]], [sine, cosine, place[1]], [0, 0, 1.0]])
        made = turn @ from_above @ to_middle
        shape, shrunk = (x1 - x0, y1 - y0), picture
        if scale < 0.6:  # what is made much smaller is averaged first
            shrunk = cv2.resize(picture, None, fx=scale * 1.3, fy=scale * 1.3, interpolation=cv2.INTER_AREA)
        back = np.diag([width / shrunk.shape[1], height / shrunk.shape[0], 1.0])
        border = cv2.BORDER_REFLECT_101 if not people else cv2.BORDER_CONSTANT
        out[y0:y1, x0:x1] = cv2.warpPerspective(
            np.ascontiguousarray(shrunk), made @ back, shape, flags=cv2.INTER_LINEAR, borderMode=border,
            borderValue=(PAD,) * 3,
        )  # fmt: skip

        def moved(points: np.ndarray) -> np.ndarray:
            flat = np.column_stack([points, np.ones(len(points))]) @ made.T
            return flat[:, :2] / flat[:, 2:] + [x0, y0]

        rows = []
        for one in people:
            outline = moved(one.outline)
            low, high = outline.min(axis=0), outline.max(axis=0)
            inside = np.clip(low, [x0, y0], [x1, y1]), np.clip(high, [x0, y0], [x1, y1])
            share = np.prod(inside[1] - inside[0]) / max(np.prod(high - low), 1.0)
            if share < 0.05:
                continue
            learnt = not one.crowd and max(high - low) >= SMALLEST
            box = np.concatenate(inside)
            spot = np.clip(moved(one.spot[None])[0], box[:2] + 0.5, np.maximum(box[2:] - 0.5, box[:2] + 0.5))
            rows.append((box, moved(one.parts), spot, share if learnt else 0.1))
        return rows


def kept(annotations: dict, pictures: Path, out: Path) -> int:
    """Write the pictures that may be used, small, and their labels; how many they are."""
    people: dict[int, list] = {}
    for one in annotations["annotations"]:
        people.setdefault(one["image_id"], []).append(one)
    count = 0
    with open(out / "photographs.jsonl", "w") as lines:
        for told in annotations["images"]:
            path = pictures / told["file_name"]
            if told["license"] not in LICENCES or not path.exists():
                continue
            picture = cv2.imread(str(path))
            scale = min(1.0, LONGEST / max(picture.shape[:2]))
            small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(out / path.name), small, [cv2.IMWRITE_JPEG_QUALITY, 75])
            content = {"file": path.name, "source": told["flickr_url"], "licence": LICENCES[told["license"]]}
            seen = [_label(one, scale) for one in people.get(told["id"], [])]
            lines.write(json.dumps(content | {"people": seen}) + "\n")
            count += 1
    return count


def _label(one: dict, scale: float) -> dict:
    x, y, width, height = one["bbox"]
    polygon = one["segmentation"] if isinstance(one["segmentation"], list) else None
    keypoints = np.reshape(one["keypoints"], (-1, 3)) * [scale, scale, 1] if one.get("num_keypoints") else None
    return {
        "box": [round(value * scale, 1) for value in (x, y, x + width, y + height)],
        "polygon": polygon and [[round(value * scale, 1) for value in ring] for ring in polygon],
        "keypoints": None if keypoints is None else keypoints.round(1).ravel().tolist(), "crowd": bool(one["iscrowd"]),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("annotations", type=Path)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    count = kept(json.loads(options.annotations.read_text()), options.pictures, options.out)
    print(f"{count} photographs in {options.out}")


if __name__ == "__main__":
    main()
