"""Annotations of a frame: the ground truth of each person, and COCO's form of it."""

from typing import Any

import numpy as np

from avcli import pose
from avcli.formats.experiment import Camera
from avcli.scene.doorways import is_inside
from avcli.scene.people import KEYPOINTS, Bodies, speaking
from avcli.scene.render import Frame
from avcli.scene.scenario import Scenario

_SURFACE_M = 0.15  # by which a joint lies behind the surface that is seen, at most


def truth(scenario: Scenario, bodies: Bodies, index: int, frame: Frame | None = None) -> dict[str, Any]:
    """Make the ground-truth record of one time, without the paths of its media; who is outside the room is not in it.

    Args:
        scenario: whose people they are.
        bodies: posed at several times.
        index: of the time.
        frame: what was drawn; without it the record has no visibility, boxes or keypoints.
    """
    time = float(bodies.times[index])
    pixels = _keypoint_pixels(scenario.config.camera, bodies.keypoints[index])
    objects = []
    for number, person in enumerate(scenario.people):
        place = person.motion.position(np.array([time]))[0]
        if not is_inside(place, scenario.config.room.dimensions):
            continue
        item = {
            "object_id": person.object_id,
            "position": [float(place[0]), float(place[1]), 0.0],
            "mouth_position": bodies.mouths[index, number].tolist(),
            "speaking": bool(speaking(person, np.array([time]), scenario.duration)[0]),
        }
        if frame is not None:
            if number not in frame.known:
                frame.known[number] = visibility(frame, number)
            item |= frame.known[number]
            item["keypoints_px"] = _keypoints(frame, number, pixels[number], scenario.config.camera, bodies, index)
        objects.append(item)
    return {"timestamp": time, "objects": objects}


def visibility(frame: Frame, number: int) -> dict[str, Any]:
    """Measure how much of a person is seen, and where.

    Args:
        frame: what was drawn.
        number: index of the person.

    Returns:
        `visible_fraction`: seen samples over the samples of the whole body, counted on every second pixel of every
        second row. Boxes [x0, y0, x1, y1] in px, x1 and y1 excluded: `bbox_px` around what is seen, `bbox_full_px`
        around the whole body with its hidden parts and what lies outside the image; absent where there is nothing.
    """
    mask, (left, top) = frame.shapes[number]
    whole = int(mask.sum())
    if whole == 0:
        return {"visible_fraction": 0.0}
    p = frame.pitch
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    full = [left + p * columns[0], top + p * rows[0], left + p * columns[-1] + p, top + p * rows[-1] + p]
    # Only the part of the picture that the body can fill is searched.
    height, width = frame.ids.shape
    x0, y0 = max(full[0] - p, 0), max(full[1] - p, 0)
    x1, y1 = min(full[2] + p, width), min(full[3] + p, height)
    item = {"visible_fraction": 0.0, "bbox_full_px": [int(v) for v in full]}
    if x1 <= x0 or y1 <= y0:
        return item
    seen = frame.ids[y0:y1, x0:x1] == number + 1
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    if len(rows):
        item["bbox_px"] = [int(x0 + columns[0]), int(y0 + rows[0]), int(x0 + columns[-1] + 1), int(y0 + rows[-1] + 1)]
        counted = int(seen[(-y0) % p :: p, (-x0) % p :: p].sum())
        item["visible_fraction"] = round(min(counted / whole, 1.0), 6)
    return item


def _keypoint_pixels(camera: Camera, keypoints: np.ndarray) -> np.ndarray:
    """Pixels (people, 17, 2) of keypoints (people, 17, 3)."""
    points = pose.apply(pose.inverse(camera.T_room_camera), keypoints)
    return camera.lens.project(points.reshape(-1, 3)).reshape(*keypoints.shape[:2], 2)


def _keypoints(
    frame: Frame, number: int, pixels: np.ndarray, camera: Camera, bodies: Bodies, index: int
) -> list[list[float]]:
    """COCO's list for one person: [x, y, v] with v = 2 seen, 1 hidden or outside the image, 0 not imaged by the lens.

    A keypoint is seen where its own person is the first thing that its pixel's ray meets, and the surface lies at most
    `_SURFACE_M` in front of it: joints are inside the body.
    """
    height, width = frame.ids.shape
    distance = np.linalg.norm(bodies.keypoints[index, number] - camera.T_room_camera[:3, 3], axis=-1)
    rows: list[list[float]] = []
    for k in range(len(KEYPOINTS)):
        x, y = pixels[k]
        if not np.isfinite(x):
            rows.append([0.0, 0.0, 0])
            continue
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        inside = 0 <= column < width and 0 <= row < height
        near = inside and frame.ids[row, column] == number + 1
        near = near and frame.depth[row, column] * frame.depth_step > distance[k] - _SURFACE_M
        rows.append([round(float(x), 2), round(float(y), 2), 2 if near else 1])
    return rows


def coco(item: dict[str, Any], number: int, frame: Frame, image_id: int, annotation_id: int) -> dict[str, Any] | None:
    """Make COCO's annotation of one person in one frame.

    Args:
        item: the person's object in the ground-truth record.
        number: index of the person.
        frame: what was drawn.
        image_id, annotation_id: COCO's numbers.

    Returns:
        Box, mask (run lengths, column by column) and keypoints of what is seen; None where nothing of the person is.

    Source: Lin et al. (2014), Microsoft COCO, and the format's page "Data format", uncompressed run lengths.
    """
    if "bbox_px" not in item:
        return None
    x0, y0, x1, y1 = item["bbox_px"]
    height, width = frame.ids.shape
    seen = frame.ids[:, x0:x1] == number + 1
    flat = np.concatenate([[0], seen.T.ravel().astype(np.int8), [0]])
    edges = np.flatnonzero(np.diff(flat)) + x0 * height
    counts = np.diff(np.concatenate([[0], edges, [height * width]]))
    counts = counts[: len(counts) - (counts[-1] == 0)]
    return {
        "id": annotation_id,
        "image_id": image_id,
        "category_id": 1,
        "iscrowd": 0,
        "area": int(seen.sum()),
        "bbox": [x0, y0, x1 - x0, y1 - y0],
        "segmentation": {"size": [height, width], "counts": counts.tolist()},
        "object_id": item["object_id"],
        "keypoints": [value for keypoint in item["keypoints_px"] for value in keypoint],
        "num_keypoints": sum(keypoint[2] > 0 for keypoint in item["keypoints_px"]),
    }


COCO_CATEGORIES = [
    {
        "id": 1,
        "name": "person",
        "supercategory": "person",
        "keypoints": list(KEYPOINTS),
        "skeleton": [
            [16, 14], [14, 12], [17, 15], [15, 13], [12, 13], [6, 12], [7, 13], [6, 7], [6, 8], [7, 9], [8, 10],
            [9, 11], [2, 3], [1, 2], [1, 3], [2, 4], [3, 5], [4, 6], [5, 7],
        ],
    }
]  # fmt: skip
"""The one category, as COCO's own files of person keypoints have it."""
