"""Photographs of people as a camera at the ceiling might show them: turned by any angle, foreshortened, side by side.

`python photographs.py ANNOTATIONS.json PICTURES --out FOLDER` takes from COCO's person_keypoints_*.json and a folder of
its pictures those whose licence permits what is made of them to be shared: CC BY 2.0, no known copyright restrictions,
works of the US government. FOLDER then holds small pictures and photographs.jsonl, a line a picture: {"file", "source",
"licence", "people": [{"box": [x0, y0, x1, y1], "polygon": [[x, y, x, y, ...], ...] or null, "keypoints": COCO's 51
numbers or null, "crowd": bool}]}, all px; `people` is [] where nobody is seen. photographs.csv names those that the
shipped networks have seen.

From above the head is nearer than the feet: each photograph is shortened along its vertical and widened at its top.
Half of them are shown side by side, on their own grounds; from the others people are cut out by their outlines and put
into the pictures of random worlds (worlds.py), where these are given.

Source:
    T.-Y. Lin et al., "Microsoft COCO: common objects in context", ECCV 2014 (labels: CC BY 4.0).
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from backdrops import blend
from generate import PAD, Sample, anchor
from worlds import read_one

SIDE = 640
"""px, of the squares that are made."""

SIZES = 32, 300
"""px, of whom is put in the middle."""

SMALLEST = 16
"""px: who is smaller is neither learnt nor held against the network."""

SHARP = 60
"""px, the least size of whom is cut out of a photograph."""

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
        self.rings = [np.reshape(ring, (-1, 2)) for ring in told["polygon"] or []] if not self.crowd else []
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
        if self.rings:
            self.outline = np.concatenate(self.rings)
        middle = [(x0 + x1) / 2, 0.6 * y0 + 0.4 * y1]
        self.spot = np.where(np.isfinite(self.parts[0]), self.parts[0], middle)


def _sample(picture: np.ndarray, rows: list[tuple]) -> Sample:
    """A picture and who is seen in it: box, parts, anchor, visible of each."""
    boxes, parts, anchors, visible = zip(*rows, strict=True) if rows else ([], [], [], [])
    return Sample(
        picture, np.reshape(boxes, (-1, 4)), np.reshape(parts, (-1, 3, 2)), np.reshape(anchors, (-1, 2)),
        np.array(visible, float),
    )  # fmt: skip


def from_above(
    centre: np.ndarray, place: np.ndarray, scale: float, angle: float, short: float, wide: float
) -> np.ndarray:
    """The projective map (3, 3) that shows a photograph as from above.

    Args:
        centre: (2,) px of the photograph that comes to a place (2,) px.
        angle: rad by which it is turned.
        short: what is left of its vertical; the more is lost, the wider is its top, by `wide` (1/px).
    """
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    to_middle = np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1.0]])
    # Points above the middle come nearer: their divisor falls below one.
    shortened = np.array([[1, 0, 0], [0, short, 0], [0, wide * (1 - short), 1.0]])
    turn = np.array([[cosine, -sine, place[0]], [sine, cosine, place[1]], [0, 0, 1.0]])
    return turn @ shortened @ to_middle


def _moved(made: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 2) px under a projective map (3, 3)."""
    flat = np.column_stack([points, np.ones(len(points))]) @ made.T
    return flat[:, :2] / flat[:, 2:]


def _seen(path: Path, made: np.ndarray, scale: float, shape: tuple[int, int], border: int) -> np.ndarray:
    """A photograph under a projective map that makes it about `scale` times as large, RGB uint8."""
    picture = cv2.imread(str(path))[..., ::-1]
    height, width = picture.shape[:2]
    if scale < 0.6:  # what is made much smaller is averaged first
        picture = cv2.resize(picture, None, fx=scale * 1.3, fy=scale * 1.3, interpolation=cv2.INTER_AREA)
    back = np.diag([width / picture.shape[1], height / picture.shape[0], 1.0])
    return cv2.warpPerspective(
        np.ascontiguousarray(picture), made @ back, shape, flags=cv2.INTER_LINEAR, borderMode=border,
        borderValue=(PAD,) * 3,
    )  # fmt: skip


class Photographs:
    """Calling it draws a square of one to four photographs, or half of the time people of them in a random world.

    Args:
        worlds: folder of these worlds, which may grow.
    """

    def __init__(self, folder: Path, seed: int, worlds: Path | None = None):
        self.rng, self.worlds = np.random.default_rng(seed), worlds
        self.pictures = []
        for line in (folder / "photographs.jsonl").read_text().splitlines():
            told = json.loads(line)
            people = [_Person(one) for one in told["people"]]
            self.pictures.append((folder / told["file"], people))
        self._cut = [(p, one) for p, people in self.pictures for one in people if one.rings and one.size > SHARP]
        self._nobody = [path for path, people in self.pictures if not people]

    def __call__(self) -> Sample:
        if self.worlds and self.rng.random() < 0.5 and (files := sorted(self.worlds.glob("[0-9]*[0-9].npz"))):
            return self._pasted(read_one(self.rng, files[self.rng.integers(len(files))]))
        rng, out = self.rng, np.full((SIDE, SIDE, 3), PAD, np.uint8)
        x, y = (int(value) for value in rng.uniform(0.3, 0.7, 2) * SIDE)
        cells = [(0, 0, x, y), (x, 0, SIDE, y), (0, y, x, SIDE), (x, y, SIDE, SIDE)]
        if rng.random() < 0.3:
            cells = [(0, 0, SIDE, SIDE)]
        rows = [row for cell in cells for row in self._put(out, *cell)]
        return _sample(out, rows)

    def _pasted(self, ground: Sample) -> Sample:
        """People by their outlines in a picture, heads outward, some behind something; and pieces of no people."""
        rng, picture = self.rng, ground.picture.astype(np.float32)
        size = np.array([picture.shape[1], picture.shape[0]])
        rows = list(zip(ground.boxes, ground.parts, ground.anchors, ground.visible, strict=True))
        taken = [row[0] for row in rows]
        for _ in range(int(rng.integers(2, 8))):
            path, one = self._cut[rng.integers(len(self._cut))]
            turn, away = rng.uniform(0, 2 * np.pi), 0.95 * np.sqrt(rng.random())
            place = size / 2 * (1 + away * np.array([np.sin(turn), -np.cos(turn)]))
            long = min(np.exp(rng.uniform(np.log(40), np.log(190))), 1.5 * one.size)
            square = np.concatenate([place - 0.8 * long, place + 0.8 * long])
            if any((square[:2] < box[2:]).all() and (box[:2] < square[2:]).all() for box in taken):
                continue
            somebody = rng.random() < 0.75 or not self._nobody
            if not somebody:
                path = self._nobody[rng.integers(len(self._nobody))]
            angle = turn + rng.normal(0, 0.2) if somebody else rng.uniform(0, 2 * np.pi)
            short = np.clip(0.5 + 0.5 * away + rng.normal(0, 0.12), 0.4, 1.0)
            middle = (one.outline.min(axis=0) + one.outline.max(axis=0)) / 2
            made = from_above(middle, place, long / one.size, angle, short, rng.uniform(0, 0.5) / one.size)
            shown = _seen(path, made, long / one.size, tuple(size), cv2.BORDER_REFLECT_101).astype(np.float32)
            whole = np.zeros(picture.shape[:2], np.uint8)
            cv2.fillPoly(whole, [np.rint(16 * _moved(made, ring)).astype(np.int32) for ring in one.rings], 1, shift=4)
            mask = whole & ~self._hidden(picture, place, long, angle) if rng.random() < 0.5 else whole
            v, u = np.nonzero(mask)
            if len(v) < 40:
                continue
            taken.append(square)
            light = max(float(picture[v, u].mean()), 20) / max(float(shown[v, u].mean()), 20)
            edge = int(long / 8) * 2 + 1
            picture *= 1 - rng.uniform(0, 0.4) * cv2.blur(mask.astype(np.float32), (edge, edge))[..., None]
            blend(picture, shown * np.float32(light ** rng.uniform(0, 0.6) * np.exp(rng.normal(0, 0.2))), mask)
            if somebody:
                share = len(v) / whole.sum() if long >= SMALLEST else 0.1
                box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float)
                rows.append((box, _moved(made, one.parts), anchor(v, u, _moved(made, one.spot[None])[0]), share))
        return _sample(np.clip(picture, 0, 255).astype(np.uint8), rows)

    def _hidden(self, picture: np.ndarray, place: np.ndarray, long: float, angle: float) -> np.ndarray:
        """What is hidden of somebody behind an edge (height, width) uint8: of what is there, or of something new."""
        rng = self.rng
        v, u = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
        tilt = angle + rng.normal(0, 0.35)
        out = ((u - place[0]) * np.sin(tilt) - (v - place[1]) * np.cos(tilt)) / long
        along = ((u - place[0]) * np.cos(tilt) + (v - place[1]) * np.sin(tilt)) / long
        edge = rng.uniform(-0.35, 0.1)
        below = (out < edge).astype(np.uint8)
        if rng.random() < 0.6:  # the surface of another place of the picture
            desk = below & (out > edge - rng.uniform(0.2, 0.45)) & (np.abs(along) < rng.uniform(0.4, 0.8))
            far = rng.integers(60, 300, 2)
            other = np.roll(picture, tuple(far), (0, 1)) * np.float32(rng.uniform(0.5, 1.3))
            if rng.random() < 0.5:
                other = other * np.float32(0.2) + rng.uniform(20, 230, 3).astype(np.float32) * np.float32(0.8)
            blend(picture, other, desk)
        return below

    def _put(self, out: np.ndarray, x0: int, y0: int, x1: int, y1: int) -> list[tuple]:
        """Show a part of a photograph in a cell, somebody of it near the middle; who is seen there, as in `Sample`."""
        rng = self.rng
        path, people = self.pictures[rng.integers(len(self.pictures))]
        height, width = cv2.imread(str(path)).shape[:2]
        cover = max((x1 - x0) / width, (y1 - y0) / height)
        scale, centre = min(cover * np.exp(rng.uniform(-0.3, 0.9)), 1.6), rng.uniform(0.3, 0.7, 2) * [width, height]
        fitting = [one for one in people if not one.crowd and SIZES[0] < one.size * scale < SIZES[1]]
        if fitting:
            centre = fitting[rng.integers(len(fitting))].outline.mean(axis=0)
        elif people and max(one.size for one in people) * scale > SIZES[1]:
            scale *= SIZES[1] / (max(one.size for one in people) * scale)
        angle, short = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.0)
        place = rng.normal(0, 0.12, 2) * [x1 - x0, y1 - y0] + [(x1 - x0) / 2, (y1 - y0) / 2]
        made = from_above(centre, place, scale, angle, short, rng.uniform(0.0, 0.5) / max(height, width))
        border = cv2.BORDER_REFLECT_101 if not people else cv2.BORDER_CONSTANT
        out[y0:y1, x0:x1] = _seen(path, made, scale, (x1 - x0, y1 - y0), border)

        def moved(points: np.ndarray) -> np.ndarray:
            return _moved(made, points) + np.array([x0, y0])

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
