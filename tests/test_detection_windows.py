"""Turned windows: where they lie, that outward is up in them, and that two of them give one person once."""

import cv2
import numpy as np
import pytest

from avcli.detection.network import Boxes, suppress
from avcli.detection.windows import OVERLAP, WITHIN, WindowedNetwork, upright, windows


class Bright:
    """Finds what is bright in a picture, like a network that knows upright things."""

    size, confidence = (96, 96), 0.5

    def __init__(self):
        self.seen = []

    def detect(self, picture, regions=None):
        self.seen.append(picture)
        _, _, stats, _ = cv2.connectedComponentsWithStats((picture[..., 0] > 200).astype(np.uint8))
        boxes = np.array([[x, y, x + w, y + h] for x, y, w, h, area in stats[1:] if area > 30], float).reshape(-1, 4)
        tall = (boxes[:, 3] - boxes[:, 1]) / np.maximum(boxes[:, 2:] - boxes[:, :2], 1).sum(axis=1)
        return Boxes(boxes, tall)


def picture_of(azimuth, distance, size=(320, 320), wide=16, tall=48):
    """A picture (320 px square) with a bright body whose head points outward from the middle."""
    centre = np.array(size) / 2
    outward = np.array([np.cos(azimuth), np.sin(azimuth)])
    across = np.array([-outward[1], outward[0]])
    corners = [centre + (distance + a * tall / 2) * outward + b * wide / 2 * across for a, b in [(-1, -1), (-1, 1), (1, 1), (1, -1)]]  # fmt: skip  # noqa: E501
    image = np.zeros((size[1], size[0], 3), np.uint8)
    cv2.fillPoly(image, [np.rint(np.array(corners) * 16).astype(np.int32)], (255, 255, 255), cv2.LINE_AA, 4)
    return image, centre + distance * outward


@pytest.mark.parametrize("azimuth", np.linspace(0.0, 6.0, 9))
@pytest.mark.parametrize("distance", [40.0, 90.0, 105.0])
def test_somebody_is_found_once_and_upright(azimuth, distance):
    image, middle = picture_of(azimuth, distance)
    found = WindowedNetwork(Bright(), (320, 320), np.array([160.0, 160.0]), 8, (159.5, 159.5, 160.0)).detect(image)
    assert len(found) == 1
    x, y, width, height, turn = found.turned[0]
    assert np.allclose([x, y], middle, atol=4)
    assert height > 1.5 * width
    up = np.array([np.sin(turn), -np.cos(turn)])
    assert up @ [np.cos(azimuth), np.sin(azimuth)] > np.cos(np.pi / 8) - 1e-6
    rows, columns = np.nonzero(image[..., 0] > 128)
    truth = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    box = found.boxes[0]
    shared = np.maximum(np.minimum(box[2:], truth[2:]) - np.maximum(box[:2], truth[:2]), 0).prod()
    assert shared / ((box[2:] - box[:2]).prod() + (truth[2:] - truth[:2]).prod() - shared) > 0.5


def test_windows_cover_the_picture_and_no_more_than_the_circle_asks_for():
    for size, circle in (((640, 360), None), ((400, 400), (199.5, 199.5, 190.0)), ((300, 500), None)):
        covered = np.zeros((size[1], size[0]), bool)
        v, u = np.mgrid[: size[1], : size[0]]
        pixels = np.stack([u, v], axis=-1) + 0.5
        for window in windows(size, np.array(size) / 2, circle, 8, 100):
            inside = (pixels - window.to_picture[:, 2]) @ np.linalg.inv(window.to_picture[:, :2]).T
            covered |= ((inside >= 0) & (inside <= 100)).all(axis=-1)
        lit = np.ones_like(covered) if circle is None else np.hypot(u - circle[0], v - circle[1]) < circle[2]
        assert covered[lit].all()


def test_a_window_in_which_nothing_changed_is_not_looked_at_again():
    image, _ = picture_of(0.3, 90.0)
    network = WindowedNetwork(Bright(), (320, 320), np.array([160.0, 160.0]), 8)
    first = network.detect(image)
    again = network.detect(image, np.array([[300, 150, 316, 170]]))
    assert 0 < network.looked - 8 < 8
    assert network.skipped == 16 - network.looked
    assert np.array_equal(first.boxes, again.boxes)


def test_a_point_below_the_camera_outside_the_picture_does_no_harm():
    found = WindowedNetwork(Bright(), (320, 320), np.array([160.0, 500.0]), 4).detect(picture_of(1.0, 60.0)[0])
    assert np.isfinite(found.boxes).all()


def test_upright_boxes_of_turned_ones():
    still = upright(np.array([[10.0, 20.0, 4.0, 8.0, 0.0], [10.0, 20.0, 4.0, 8.0, np.pi / 2]]))
    assert np.allclose(still, [[8, 16, 12, 24], [6, 18, 14, 22]])


def test_a_part_of_somebody_is_the_same_person():
    boxes = np.array([[0.0, 0, 10, 30], [0, 0, 10, 12], [30, 0, 40, 30]])
    assert suppress(boxes, np.array([0.6, 0.9, 0.5]), OVERLAP, WITHIN).tolist() == [1, 2]
    assert suppress(np.zeros((0, 4)), np.zeros(0), OVERLAP, WITHIN).tolist() == []
