"""Bands of round pictures: which pictures are round, and that two bands give each person once, judged by both."""

import copy

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_detection_windows import picture_of

from avcli.detection.bands import LEAST_SCORE, BandedNetwork, is_round, round_part, voted
from avcli.detection.detector import Detector
from avcli.detection.network import PAD, Boxes
from avcli.detection.settings import Settings
from avcli.formats.experiment import Config


class Bright:
    """Finds what is bright, with the score that it is given; it notes what it looks at."""

    def __init__(self, score=0.9, confidence=0.5):
        self.size, self.confidence, self.iou = (320, 320), confidence, 0.5
        self.score, self.looks = score, []

    def resized(self, size):
        other = copy.copy(self)
        other.size = size
        return other

    def detect(self, picture, regions=None):
        self.looks.append((picture.shape, regions))
        if self.score < self.confidence:
            return Boxes(np.zeros((0, 4)), np.zeros(0), np.zeros((0, 3, 2)))
        _, _, stats, middles = cv2.connectedComponentsWithStats((picture[..., 0] > 200).astype(np.uint8))
        boxes = np.array([[x, y, x + w, y + h] for x, y, w, h, _ in stats[1:]], float).reshape(-1, 4)
        parts = np.repeat(middles[1:, None] + 0.5, 3, axis=1).reshape(-1, 3, 2)
        return Boxes(boxes, np.full(len(boxes), self.score), parts)


@given(azimuth=st.floats(0, 2 * np.pi), distance=st.floats(0, 105))
def test_everybody_is_found_once_where_he_is(azimuth, distance):
    image, middle = picture_of(azimuth, distance)
    found = BandedNetwork(Bright()).detect(image)
    assert len(found) == 1
    rows, columns = np.nonzero(image[..., 0] > 200)
    truth = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    assert np.allclose(found.boxes[0], truth, atol=1e-9)
    assert np.allclose(found.parts[0], middle, atol=1.5)


def test_a_band_that_does_not_see_somebody_lowers_the_score_and_one_that_cannot_does_not():
    boxes = np.array([[200.0, 150, 220, 170], [290, 150, 310, 170]])  # the second is outside the band down the picture
    across = Boxes(boxes, np.array([0.9, 0.8]))
    nobody = Boxes(np.zeros((0, 4)), np.zeros(0))
    scores = voted(across, nobody, (320, 320)).scores
    odds = np.sqrt(9 * LEAST_SCORE / (1 - LEAST_SCORE))
    assert np.allclose(scores, [odds / (1 + odds), 0.8])
    agreed = voted(across, Boxes(boxes[:1] + 1, np.array([0.9])), (320, 320))
    assert np.allclose(agreed.scores, [0.9, 0.8])


def test_only_the_band_that_something_touches_is_looked_at_anew():
    image, _ = picture_of(0.0, 100.0)
    network = Bright()
    banded = BandedNetwork(network)
    banded.detect(image)
    network.looks.clear()
    banded.detect(image, np.array([[300.0, 150, 310, 170]]))
    (shape, across), (turned, down) = network.looks
    assert shape == turned == (224, 320, 3)
    assert across.tolist() == [[300, 102, 310, 122]]
    assert len(down) == 0


def test_a_round_picture_between_margins_is_looked_at_as_one_without_them():
    image, _ = picture_of(1.0, 80.0)
    framed = np.pad(image, ((10, 0), (120, 60), (0, 0)))
    network = Bright()
    alone = BandedNetwork(network).detect(image)
    network.looks.clear()
    regions = np.array([[420.0, 160, 430, 180], [0, 0, 50, 9]])
    found = BandedNetwork(network, (120, 10, 440, 330)).detect(framed, regions)
    assert np.allclose(found.boxes - alone.boxes, [120, 10, 120, 10])
    assert np.allclose(found.parts - alone.parts, [120, 10])
    (shape, across), _ = network.looks
    assert shape == (224, 320, 3)
    assert across.tolist() == [[300, 102, 310, 122]]


def lit_disc(level=120, outside=0, size=(240, 240)):
    picture = np.full((size[1], size[0], 3), outside, np.uint8)
    return cv2.circle(picture, (size[0] // 2, size[1] // 2), min(size) // 2, (level, level, level), -1)


@pytest.mark.parametrize(
    ("picture", "answer"),
    [
        (lit_disc(), True),
        (lit_disc(30, 3), True),
        (lit_disc(outside=PAD), True),
        (lit_disc(outside=120), False),
        (lit_disc(30, 30), False),
        (lit_disc(0), False),
        (lit_disc(size=(426, 240)), False),
        (lit_disc(size=(260, 240)), True),
        (lit_disc(size=(3, 3)), False),
    ],
)
def test_a_round_picture_is_square_with_dark_corners(picture, answer):
    assert is_round(picture) == answer


@pytest.mark.parametrize(
    ("picture", "part"),
    [
        (lit_disc(), (0, 0, 240, 240)),
        (lit_disc(size=(426, 240)), (93, 0, 334, 240)),
        (lit_disc(outside=PAD, size=(320, 240)), (40, 0, 281, 240)),
        (lit_disc(outside=9, size=(1920, 1080)), (420, 0, 1504, 1080)),
        (np.full((240, 426, 3), 120, np.uint8), None),
        (lit_disc(0, size=(426, 240)), None),
        (lit_disc(outside=120, size=(426, 240)), None),
    ],
)
def test_a_round_picture_is_found_between_margins_that_the_lens_does_not_light(picture, part):
    found = round_part(picture)
    assert (found is None) == (part is None)
    assert part is None or np.allclose(found, part, atol=0.02 * picture.shape[1])


def test_the_own_network_looks_at_bands_of_round_pictures_unless_a_size_is_given():
    camera = {
        "lens_model": "kannala_brandt", "fx_px": 75, "fy_px": 75, "cx_px": 119.5, "cy_px": 119.5,
        "image_width_px": 240, "image_height_px": 240,
        "camera_position_m": [2, 2, 2.6], "camera_rotation_deg": [90, 0, 0],
    }  # fmt: skip
    config = Config({"camera_config": camera})
    for settings, picture, bands in (
        (Settings(), lit_disc(), True),
        (Settings(), lit_disc(outside=120), False),
        (Settings(imgsz=(320, 320)), lit_disc(), False),
    ):
        detector = Detector(config, settings=settings)
        assert detector.look(picture, None, 0.0) == []
        assert isinstance(detector.sight, BandedNetwork) == bands
