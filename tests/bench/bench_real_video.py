"""People in real pictures of ceiling fisheyes: found, missed, false and placed, by networks plain and in windows.

    make bench-real-video BENCH_FLAGS="--data FOLDER --model yolox_nano.onnx"

FOLDER holds a folder for each set, with pictures and hand-made labels as YOLO writes them: SET/**/images/NAME.jpg and
SET/**/labels/NAME.txt, a line `0 x y width height` in parts of the picture for each person. Nothing of them ships; see
examples/benchmarks/real-video.md for where public sets are and under which terms.

Networks: the package's own, in the whole picture and as the detector uses it (in bands of round pictures), what
`avcalib detector` made of it, and each other --model, in the whole picture and, with --windows N, in N turned windows.
A box is found if it overlaps a label by more than .3 (or .5, for AP.5). The lens is not known: it is taken as
equidistant over the picture's shorter side, which serves to lay the windows and to place true boxes: `placed` is the
share of them that get a position, `explained` the share that a body explains, at the camera height of --heights at
which most are. With --films RATE the pictures are those of films, in order, and the detector by colour alone looks at
them, following people and not; its positions are compared with those of the labels' boxes, placed in the same way: the
lens, the height and the shape of bodies, which are not known, spoil both alike, so what is left is what the network's
boxes are off. A table more says how many pictures, moved against the first of their film, count as of a knocked
camera. Times are CPU milliseconds of one thread.
"""

import argparse
import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_detection import table

from avcli.detection.agreement import Found, average_precision, judged, matched, overlaps, within
from avcli.detection.bands import suited
from avcli.detection.body import Person
from avcli.detection.detector import Detector
from avcli.detection.following import FOLLOWED
from avcli.detection.monocular import Fitted
from avcli.detection.mounting import SHIFT, TURN_DEG, moves, outlines
from avcli.detection.network import Boxes, Network, own_model
from avcli.detection.settings import Settings
from avcli.detection.stillness import Stillness
from avcli.detection.view import View
from avcli.detection.windows import WindowedNetwork
from avcli.formats.experiment import Config
from avcli.formats.media import read_rgb

HEIGHT_M = 2.7
"""Height at which a film's camera is taken to hang."""

LEAST = 0.05
"""Score from which boxes count for the average precision."""

LOOSE, BLUR_M = 0.04, 0.1
"""By how much each side of a hand-made box is outside the person, as a share of the box's size (so much more than the
network's at the head and the sides); and standard deviation, m, of what a label tells of a position."""

MOVES, COVERED = 0.5, 0.5
"""Nats of motion from which a box is said to move; and the share of a box from which it lies in another one."""

KNOCKS = (
    ("as it is", 0.0, 0.0, 1.0),
    ("darker, .4 of the light", 0.0, 0.0, 0.4),
    ("moved by .8 %", 0.008, 0.0, 1.0),
    ("moved by 2 %", 0.02, 0.0, 1.0),
    ("moved by 8 %", 0.08, 0.0, 1.0),
    ("turned by 2 degrees", 0.0, 2.0, 1.0),
    ("turned by 10 degrees", 0.0, 10.0, 1.0),
)
"""How a knocked camera's picture is moved: shift as a share of its shorter side, turn in degrees, and light."""


def labelled(picture: Path) -> np.ndarray:
    """Return the labels (m, 4) [x0, y0, x1, y1] of a picture, in parts of it."""
    lines = Path(str(picture.with_suffix(".txt")).replace("/images/", "/labels/")).read_text().splitlines()
    rows = np.array([line.split()[1:5] for line in lines if line.strip()], float).reshape(-1, 4)
    return np.concatenate([rows[:, :2] - rows[:, 2:] / 2, rows[:, :2] + rows[:, 2:] / 2], axis=1)


def row(name: str, found: list[Found], confidence: float, ms: float) -> dict[str, Any]:
    """Sum up what a way of finding has found."""
    scores, right, count = judged(found, 0.3)
    hits = int(right[scores >= confidence].sum())
    empty = [int((score >= confidence).sum()) for _, score, labels in found if not len(labels)]
    return {
        "detector": name,
        "pictures": len(found),
        "people": count,
        "confidence": confidence,
        "recall": hits / max(count, 1),
        "precision": hits / max(int((scores >= confidence).sum()), 1),
        "AP.3": average_precision(found, 0.3),
        "AP.5": average_precision(found, 0.5),
        "empty": len(empty),
        "false an empty picture": float(np.mean(empty)) if empty else None,
        "ms": ms,
    }


def camera(size: tuple[int, int], height: float) -> dict[str, Any]:
    """An equidistant lens that shows a half space over the shorter side of a picture (width, height), looking down."""
    focal = min(size) / np.pi
    return {
        "lens_model": "kannala_brandt", "fx_px": focal, "fy_px": focal,
        "cx_px": (size[0] - 1) / 2, "cy_px": (size[1] - 1) / 2,
        "image_width_px": size[0], "image_height_px": size[1],
        "camera_position_m": [0, 0, height], "camera_rotation_deg": [90, 0, 0],
    }  # fmt: skip


def fisheye(size: tuple[int, int], height: float) -> View:
    """The view of that camera."""
    made = Config({"camera_config": camera(size, height)}).camera
    return View(made.lens, made.T_room_camera, size, np.deg2rad(92))


def placed(labels: list[tuple[tuple[int, int], np.ndarray]], heights: list[float]) -> dict[str, Any]:
    """Which share of true boxes a body explains, at the best of some camera heights; CPU ms a box."""
    shares, begin, tried, seen = {}, time.process_time(), 0, 0
    for height in heights:
        explained = []
        for size, boxes in labels:
            found = Fitted(boxes, fisheye(size, height)).places()
            explained += found.explained.tolist()
            seen += int(found.seen.sum())
        tried += len(explained)
        shares[height] = float(np.mean(explained)) if explained else 0.0
    best = max(shares, key=lambda height: shares[height])
    ms = (time.process_time() - begin) * 1e3 / max(tried, 1)
    kept = seen / max(tried, 1)
    return {"height m": best, "placed": kept, "explained": shares[best], "ms a box": ms} | {
        f"at {h:g} m": s for h, s in shares.items()
    }


def by_shape(network: Network) -> Callable[[np.ndarray], Boxes]:
    """A network of this project as the detector uses it."""
    return lambda picture: suited(network, picture).detect(picture)


def ways(options: argparse.Namespace, size: tuple[int, int]) -> dict[str, Callable[[np.ndarray], Boxes]]:
    """The networks, in the whole picture and in windows, for pictures of a size."""
    own = own_model()
    whole = Network(own, None, LEAST, picture=size)
    made: dict[str, Callable[[np.ndarray], Boxes]] = {
        f"people {options.own_size[0]}x{options.own_size[1]}": Network(own, options.own_size, LEAST).detect,
        "people, whole picture": whole.detect,
        "people": by_shape(whole),
    }
    for path in options.model:
        network = Network(path.read_bytes(), None, LEAST, picture=size)
        if network.head.kind == "points":  # from avcalib detector
            made[f"people, {path.stem}"] = by_shape(network)
            continue
        made[path.stem] = network.detect
        if options.windows:
            turned = WindowedNetwork(network, size, np.array(size) / 2, options.windows)
            made[f"{path.stem}, {options.windows} windows"] = turned.detect
    return made


def evaluate(folder: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """The rows of a set."""
    pictures = sorted(path for path in folder.rglob("images/*") if re.search(options.only, path.name))[:: options.step]
    found: dict[str, list[Found]] = {}
    spent: dict[str, float] = {}
    finders: dict[tuple[int, int], dict[str, Callable[[np.ndarray], Boxes]]] = {}
    labels: list[tuple[tuple[int, int], np.ndarray]] = []
    for path in pictures:
        picture = read_rgb(path)
        size = picture.shape[1], picture.shape[0]
        truth = labelled(path) * np.tile(size, 2)
        labels.append((size, truth))
        if size not in finders:
            finders[size] = ways(options, size)
        for name, detect in finders[size].items():
            begin = time.process_time()
            boxes = detect(picture)
            spent[name] = spent.get(name, 0.0) + time.process_time() - begin
            found.setdefault(name, []).append((boxes.boxes, boxes.scores, truth))
    rows = []
    for name, of_pictures in found.items():
        confidence = 0.5 if name.startswith("people") else options.confidence
        rows.append(row(name, of_pictures, confidence, spent[name] * 1e3 / len(of_pictures)))
    geometry = {"detector": "geometry of true boxes", "pictures": len(pictures), **placed(labels, options.heights)}
    return [{"set": folder.name, **one} for one in [*rows, geometry]]


def shots_of(folder: Path, options: argparse.Namespace) -> list[list[tuple[float, Path]]]:
    """The films of a set: the time, s, and the file of each picture, in order."""
    shots: dict[int, dict[int, Path]] = {}
    for path in folder.rglob("images/*"):
        if re.search(options.only, path.name):
            film, number = map(int, re.findall(r"\d+", path.name)[:2])
            shots.setdefault(film, {})[number] = path
    return [[(number / options.films, path) for number, path in sorted(one.items())] for one in shots.values()]


def came(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """How many faint boxes that came and move, and lie in no better one, show a person, a part of one, and nobody."""
    right = part = nobody = 0
    for pictures in shots_of(folder, options):
        stillness, network = (
            Stillness(),
            Network(own_model(), None, LEAST, picture=read_rgb(pictures[0][1]).shape[1::-1]),
        )
        for seconds, path in pictures:
            picture = read_rgb(path)
            found = network.detect(picture)
            truth = labelled(path) * np.tile(picture.shape[1::-1], 2)
            stillness.see(picture, seconds, found.boxes[found.scores >= FOLLOWED])
            told = stillness.evidence(found.boxes)
            covered = np.tril(within(found.boxes), -1)[:, found.scores >= FOLLOWED].max(axis=1, initial=0.0)
            faint = (found.scores >= 0.2) & (found.scores < 0.5) & (told >= MOVES) & (covered <= COVERED)
            hits = matched(found.boxes, found.scores, truth)
            shown = within(np.concatenate([found.boxes, truth]))[: len(found), len(found) :].max(axis=1, initial=0.0)
            right += int((faint & hits).sum())
            part += int((faint & ~hits & (shown > COVERED)).sum())
            nobody += int((faint & ~hits & (shown <= COVERED)).sum())
    return {"set": folder.name, "came and moves": "scores .2 to .5", "right": right, "in part": part, "nobody": nobody}


def tight(labels: np.ndarray) -> np.ndarray:
    """Return the boxes (m, 4) px of the people whom hand-made boxes (m, 4) px surround."""
    loose = LOOSE * np.sqrt((labels[:, 2:] - labels[:, :2]).prod(axis=1, keepdims=True))
    return labels + loose * [1, 1, -1, -1]


def off(people: list[Person], labels: np.ndarray, view: View) -> list[tuple[float, float]]:
    """How far each person whom one label shows is from the label's position: m, and squared, by the covariance."""
    true = Fitted(tight(labels), view).places()
    boxes = np.array([person.bbox_px for person in people]).reshape(-1, 4)
    out = []
    for person, row in zip(people, overlaps(boxes, labels), strict=True):
        best = int(row.argmax()) if len(row) else 0
        if len(row) and row[best] > 0.3 and (row > 0.1).sum() == 1 and true.seen[best]:
            error = np.array(person.position[:2]) - true.positions[best]
            covariance = person.covariance[:2, :2] + BLUR_M**2 * np.eye(2)
            out.append((float(np.hypot(*error)), float(error @ np.linalg.solve(covariance, error))))
    return out


def films(folder: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """The rows of a set whose pictures are of films: the detector by colour alone, following people and not."""
    rows: list[dict[str, Any]] = []
    away: list[tuple[float, float]] = []
    for name, confidence in (("people followed", None), ("people, --confidence .5", 0.5)):
        found, begin, away = [], time.process_time(), []
        for pictures in shots_of(folder, options):
            detector = None
            for seconds, path in pictures:
                picture = read_rgb(path)
                size = picture.shape[1], picture.shape[0]
                if detector is None:
                    settings = Settings(monocular=True, features=False, confidence=confidence)
                    detector = Detector(Config({"camera_config": camera(size, HEIGHT_M)}), settings=settings)
                people = detector.look(picture, None, seconds)
                people.sort(key=lambda person: -person.score)
                boxes = np.array([person.bbox_px for person in people]).reshape(-1, 4)
                scores = np.array([person.score for person in people])
                found.append((boxes, scores, labelled(path) * np.tile(size, 2)))
                away += off(people, found[-1][2], fisheye(size, HEIGHT_M))
        ms = (time.process_time() - begin) * 1e3 / max(len(found), 1)
        rows.append({"set": folder.name, **row(f"films, {name}", found, 0.0, ms)})
    metres, squares = np.array(away).reshape(-1, 2).T
    positions = {
        "set": folder.name, "positions": "by the found boxes, from those by the labels", "people": len(away),
        "median m": float(np.median(metres)), "within 1 m": float(np.mean(metres < 1)),
        "NEES": float(squares.mean()), "inside 95 %": float(np.mean(squares < 5.99)),
    }  # fmt: skip
    return [*rows, positions, came(folder, options)]


def knocked(folder: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Whether a camera that was knocked is told: pictures of films, some of them moved, against each film's first."""
    rows = []
    for name, shift, turn, light in KNOCKS:
        found = []
        for shots in shots_of(folder, options):
            before = outlines(read_rgb(shots[0][1]))
            for _, path in shots[1 :: max(1, len(shots) // 12)]:
                picture = read_rgb(path)
                height, width = picture.shape[:2]
                matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn, 1.0)
                matrix[0, 2] += shift * min(height, width)
                after = cv2.warpAffine((light * picture).astype(np.uint8), matrix, (width, height))
                found.append(moves(before, outlines(after)))
        known = [one for one in found if one]
        rows.append({
            "set": folder.name, "the picture": name, "pictures": len(found), "unknown": len(found) - len(known),
            "moved": sum(one[0] >= SHIFT or one[1] >= TURN_DEG for one in known),
            "median shift, %": 100 * float(np.median([one[0] for one in known])),
            "median turn, degrees": float(np.median([one[1] for one in known])),
        })  # fmt: skip
    return rows


def main() -> None:
    """Evaluate all sets and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--data", type=Path, required=True, help="folder with a folder for each set")
    parser.add_argument("--model", type=Path, action="append", default=[], help="ONNX files to compare")
    parser.add_argument("--windows", type=int, default=8, help="turned windows for the models; 0: none")
    parser.add_argument("--confidence", type=float, default=0.3, help="of the models; the package's own has .5")
    parser.add_argument("--own-size", type=int, nargs=2, default=(640, 384), help="a second input of the package's own")
    parser.add_argument("--only", default="", help="pictures whose names match this regular expression")
    parser.add_argument(
        "--films", type=float, help="the names' first two numbers are a film's and a picture's, so many a second"
    )
    parser.add_argument("--step", type=int, default=1, help="every so many pictures")
    parser.add_argument(
        "--heights", type=float, nargs="+", default=[2.1, 2.4, 2.7, 3.0, 3.5, 4.0], help="of cameras, m"
    )
    options = parser.parse_args()
    cv2.setNumThreads(1)
    sets = sorted(path for path in options.data.iterdir() if path.is_dir())
    if not sets:
        parser.error(f"{options.data} has no folders")
    looks = (films, knocked) if options.films else (evaluate,)
    rows = [one for look in looks for folder in sets for one in look(folder, options)]
    rows = [{key: round(value, 4) if isinstance(value, float) else value for key, value in one.items()} for one in rows]
    options.out.mkdir(parents=True, exist_ok=True)
    parts: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for one in rows:
        parts.setdefault(tuple(one), []).append(one)
    text = "\n".join(table(part) for part in parts.values())
    print(text)
    (options.out / "real-video.md").write_text(text)
    (options.out / "real-video.jsonl").write_text("".join(json.dumps(one) + "\n" for one in rows))


if __name__ == "__main__":
    main()
