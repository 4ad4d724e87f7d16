"""Judge an ONNX detector on rendered pictures that training never saw: python judge.py MODEL.onnx [--pictures 300]

Scenes, looks, lenses and heights are random, drawn by avsim-scene's renderer with seeds that training does not use. A
person of whom at least a third is seen has to be found; of whom less is seen may be. --effects adds what a bad camera
does: noise, blur, gamma, JPEG, false colours. Then as many empty rooms as --rooms says.
"""

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from backdrops import Backdrops
from generate import HEIGHT, WIDTH, Generator, Sample
from renders import Library

from avcli.detection.network import Network


@dataclass
class Verdict:
    """Detections (n,) of all pictures: scores, whether right, errors of the torso in px; and the number of people.

    `empty` counts detections with a score of a half or more in pictures without people, of which there are
    `empty_pictures`.
    """

    scores: np.ndarray
    right: np.ndarray
    torso: np.ndarray
    people: int
    empty: int
    empty_pictures: int


def pictures_to_judge(
    seed: int, count: int, *, effects: bool = False, people: int | None = None, panoramas: Path | None = None
) -> Iterator[Sample]:
    """Yield `count` rendered pictures with their labels: two of each scene, one of each that has no people.

    With a folder of panoramas every second one shows its people in a photographed room, in another light.
    """
    library = Library(seed, each=1 if people == 0 else 2, plain=not effects, people=people)
    generator = Generator(seed, Backdrops(panoramas), bodies=6, textures=1) if panoramas else None
    for index in range(count):
        sample = library()
        yield generator.moved(sample) if generator and index % 2 else sample


def judge(content: bytes, samples: Iterable[Sample], confidence: float = 0.02, iou: float | None = None) -> Verdict:
    """Run a model over the pictures and match what it finds, best first, at an IoU of 0.5."""
    network = Network(content, (WIDTH, HEIGHT), confidence, iou)
    scores, right, torso, people, empty, empty_pictures = [], [], [], 0, 0, 0
    for sample in samples:
        found = network.detect(sample.picture)
        must = sample.visible >= 1 / 3
        people += int(must.sum())
        taken = np.zeros(len(sample.boxes), bool)
        if len(sample.boxes) == 0:
            empty_pictures += 1
            empty += int((found.scores >= 0.5).sum())
        for index, box in enumerate(found.boxes):
            overlap = overlaps(box, sample.boxes)
            overlap[taken] = 0
            best = int(overlap.argmax()) if len(overlap) else -1
            if best >= 0 and overlap[best] >= 0.5:
                taken[best] = True
                if must[best]:
                    scores.append(found.scores[index])
                    right.append(1.0)
                    parts = found.parts[index, 0] if found.parts is not None else (box[:2] + box[2:]) / 2
                    torso.append(np.linalg.norm(parts - sample.parts[best, 0]))
            elif not (len(overlap) and overlaps(box, sample.boxes[~must]).max(initial=0.0) > 0.1):
                scores.append(found.scores[index])
                right.append(0.0)
                torso.append(np.nan)
    return Verdict(np.array(scores), np.array(right), np.array(torso), people, empty, empty_pictures)


def overlaps(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """IoU (n,) of a box (4,) with boxes (n, 4)."""
    shared = np.maximum(np.minimum(boxes[:, 2:], box[2:]) - np.maximum(boxes[:, :2], box[:2]), 0).prod(axis=1)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return shared / (area + (box[2:] - box[:2]).prod() - shared)


def average_precision(verdict: Verdict) -> float:
    """Area under the precision-recall curve, precision made monotone (as COCO does, at every recall)."""
    order = np.argsort(-verdict.scores, kind="stable")
    right = np.cumsum(verdict.right[order])
    precision = right / np.arange(1, len(right) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    recall = np.concatenate([[0.0], right / max(verdict.people, 1)])
    return float((np.diff(recall) * precision).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("--pictures", type=int, default=300)
    parser.add_argument("--seed", type=int, default=800_000)
    parser.add_argument("--rooms", type=int, default=100)
    parser.add_argument("--effects", action="store_true")
    parser.add_argument("--panoramas", type=Path, help="put every second picture's people into photographed rooms")
    options = parser.parse_args()
    content = options.model.read_bytes()
    given = {"effects": options.effects, "panoramas": options.panoramas}
    verdict = judge(content, pictures_to_judge(options.seed, options.pictures, **given))
    order = np.argsort(-verdict.scores, kind="stable")
    right = np.cumsum(verdict.right[order])
    precision, recall = right / np.arange(1, len(right) + 1), right / verdict.people
    good = precision >= 0.95
    working = verdict.scores >= 0.5
    print(f"{verdict.people} people in {options.pictures} pictures; AP50 {average_precision(verdict):.3f}")
    print(f"recall at precision 0.95: {recall[good].max(initial=0.0):.3f}")
    found = verdict.right[working]
    print(f"at score 0.5: precision {found.mean():.3f}, recall {found.sum() / verdict.people:.3f}")
    print(f"torso: median error {np.nanmedian(verdict.torso[working]):.1f} px")
    print(f"{verdict.empty} detections in the {verdict.empty_pictures} pictures without people")
    rooms = judge(content, pictures_to_judge(options.seed + 1, options.rooms, people=0, **given))
    print(f"{rooms.empty} detections in {rooms.empty_pictures} empty rooms")


if __name__ == "__main__":
    main()
