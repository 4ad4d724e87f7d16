"""Photographs to learn from: only those whose licence permits it, and people where the labels say."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "examples" / "train-detector"))

PERSON = {"image_id": 1, "bbox": [200, 60, 120, 360], "num_keypoints": 17, "iscrowd": 0}


@pytest.fixture
def folder(tmp_path):
    """A white person on black under CC BY 2.0, and a picture under a licence for non-commercial use alone."""
    import cv2
    from photographs import kept

    picture = np.zeros((480, 640, 3), np.uint8)
    picture[60:420, 200:320] = 255
    for name in ("free.jpg", "not.jpg"):
        cv2.imwrite(str(tmp_path / name), picture)
    outline = [200, 60, 320, 60, 320, 420, 200, 420]
    points = [260, 80, 2] * 5 + [260, 150, 2] * 2 + [260, 200, 2] * 4 + [260, 260, 2] * 2 + [260, 400, 2] * 4
    images = [
        {"id": 1, "file_name": "free.jpg", "license": 4, "flickr_url": "here"},
        {"id": 2, "file_name": "not.jpg", "license": 1, "flickr_url": "there"},
    ]
    people = [PERSON | {"segmentation": [outline], "keypoints": points}]
    (out := tmp_path / "out").mkdir()
    assert kept({"images": images, "annotations": people}, tmp_path, out) == 1
    return out


def test_only_pictures_whose_licence_permits_it_are_kept_and_their_source_is_named(folder):
    (line,) = (folder / "photographs.jsonl").read_text().splitlines()
    told = json.loads(line)
    assert (told["source"], told["licence"]) == ("here", "CC BY 2.0")
    assert [path.name for path in folder.glob("*.jpg")] == ["free.jpg"]


def test_people_are_where_the_labels_say_in_every_position(folder):
    from photographs import SIDE, Photographs

    photographs, seen = Photographs(folder, 3), 0
    for _ in range(8):
        sample = photographs()
        assert sample.picture.shape == (SIDE, SIDE, 3)
        for box, parts, anchor, visible in zip(sample.boxes, sample.parts, sample.anchors, sample.visible, strict=True):
            x0, y0, x1, y1 = box.round().astype(int)
            white = (sample.picture[y0:y1, x0:x1] > 200).all(axis=2)
            assert white.mean() > 0.3  # a body of 3 to 1 that is turned by 45 degrees fills .375 of its upright box
            assert (box[:2] <= anchor).all()
            assert (anchor <= box[2:]).all()
            if visible > 0.99:
                assert all(edge.any() for edge in (white[:4], white[-4:], white[:, :4], white[:, -4:]))
                assert sample.picture[tuple(anchor.astype(int)[::-1])].min() > 200
                head, foot = parts[1] - parts[0], parts[2] - parts[0]
                assert head @ foot < 0  # the torso is between them
            seen += 1
    assert seen > 8


def test_who_is_cut_out_and_put_into_a_world_is_where_the_labels_say(folder, tmp_path):
    from generate import Sample
    from photographs import Photographs
    from worlds import write

    nothing = np.zeros((0, 4)), np.zeros((0, 3, 2)), np.zeros((0, 2)), np.zeros(0)
    ground = np.full((400, 640, 3), 40, np.uint8)
    write([Sample(ground, *nothing, np.zeros((400, 640), np.uint8))], tmp_path / "10.npz")
    photographs, seen, hidden = Photographs(folder, 3, tmp_path), 0, 0
    while seen < 20:
        sample = photographs()
        if sample.picture.shape != ground.shape:
            continue  # side by side
        for box, anchor, visible in zip(sample.boxes, sample.anchors, sample.visible, strict=True):
            x0, y0, x1, y1 = box.astype(int)
            inside = sample.picture[y0:y1, x0:x1].max(axis=2)
            assert inside.size
            assert ((box >= 0) & (box <= [640, 400, 640, 400])).all()
            assert sample.picture[tuple(anchor.astype(int)[::-1])].max() > 60
            hidden += visible < 0.9
            seen += 1
    assert 2 < hidden < 18
