"""The detector as a Python program uses it: pictures in, people out."""

import dataclasses
import doctest

import cv2
import numpy as np
import pytest
from detection_people import KB8, cast, ceiling_view

import avcli.detection.detector
from avcli.detection.detector import Detector, detect, detections
from avcli.detection.fitted import FAINT
from avcli.detection.network import Boxes
from avcli.detection.settings import Settings
from avcli.formats import records
from avcli.formats.experiment import Config
from avcli.formats.media import MediaError, Shot

PERSON = (1.2, 2.3, 0.0, 0.3, 1.75)
STEP = 1e-4
DEPTH = Settings(detector="depth")


def config(**room):
    fx, fy, cx, cy, *k = KB8
    camera = {
        "lens_model": "kannala_brandt",
        "fx_px": fx / 4, "fy_px": fy / 4, "cx_px": (cx - 1.5) / 4, "cy_px": (cy - 1.5) / 4,
        "k1": k[0], "k2": k[1], "k3": k[2], "k4": k[3],
        "image_width_px": 480, "image_height_px": 270,
        "camera_position_m": [2.33, 2.33, 2.5], "camera_rotation_deg": [90, 0, 0], "depth_step_m": STEP,
    }  # fmt: skip
    return Config({"camera_config": camera, **({"room_config": room} if room else {})})


def steps(*people):
    return np.rint(cast(ceiling_view(4), people) / STEP).astype(np.uint16)


@pytest.fixture(scope="module")
def empty():
    return steps()


@pytest.fixture(scope="module")
def full():
    return steps(PERSON)


GREY = np.full((270, 480, 3), 90, np.uint8)


class FakeNetwork:
    """Finds the same box in every picture, and counts how often it looked."""

    learnt_wide = False

    def __init__(self, box):
        self.box, self.looks = np.array([box], float), 0

    def detect(self, picture, regions):
        self.looks += 1
        return Boxes(self.box, np.array([0.9]))


def with_network(full, empty, **options):
    detector = Detector(config(), **options)
    rows, columns = np.nonzero(full < empty - 300)
    detector.network = FakeNetwork([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    return detector


def test_the_sample_in_the_documentation_runs():
    assert doctest.testmod(avcli.detection.detector).failed == 0


def test_detections_come_one_by_one_and_lazily(empty, full):
    taken = []

    def shots():
        for k, depth in enumerate((empty, full)):
            taken.append(k)
            yield Shot(k / 10, None, depth)

    found = detect(config(), shots(), background=empty, detector="depth")
    assert taken == []
    assert len(next(found).positions) == 0
    assert taken == [0]
    second = next(found)
    assert (second.timestamp, second.sensor, second.kind) == (0.1, "video", "camera")
    assert np.linalg.norm(second.positions[0, :2] - PERSON[:2]) < 0.12
    assert second.heights[0] == pytest.approx(PERSON[4], abs=0.05)


def test_nobody_has_the_shapes_of_somebody():
    none = detections(0.0, [])
    assert (none.positions.shape, none.covariances.shape, none.scores.shape) == ((0, 3), (0, 3, 3), (0,))
    assert (none.boxes_px.shape, none.heights.shape) == ((0, 4), (0,))


def test_people_outside_the_room_are_dropped(empty, full):
    inside = Detector(config(room_dimensions_m=[4.66, 4.66, 2.5]), background=empty, settings=DEPTH)
    outside = Detector(config(room_dimensions_m=[0.5, 4.66, 2.5]), background=empty, settings=DEPTH)
    assert [len(detector.look(None, full)) for detector in (inside, outside)] == [1, 0]


def test_the_empty_room_is_read_once_and_only_where_it_is_needed(empty, full):
    read = []

    def background():
        read.append(1)
        return empty

    detector = with_network(full, empty, background=background, settings=Settings(refresh=1))
    assert len(detector.look(GREY)) == 1
    assert read == []
    assert [person.method for _ in range(3) for person in detector.look(GREY, full)] == ["depth"] * 3
    assert read == [1]


def test_depth_is_read_where_the_network_looks_only(empty, full):
    read = []

    def depth():
        read.append(1)
        return full

    detector = with_network(full, empty, settings=Settings(refresh=3))
    people = [detector.look(GREY, depth) for _ in range(5)]
    assert detector.network.looks == len(read) == 2
    assert all(one[0].position.tolist() == people[0][0].position.tolist() for one in people)
    monocular = with_network(full, empty, settings=Settings(monocular=True))
    assert monocular.look(GREY, depth)[0].method == "monocular"
    assert len(read) == 2


OTHER = (3.2, 1.6, 1.0, 0.2, 1.7)


class Film:
    """A network that finds nobody but what it is told, and a detector that knows the empty room."""

    def __init__(self, empty, **options):
        self.detector = Detector(config(), background=empty, **options)
        self.detector.network = self
        self.found = Boxes(np.zeros((0, 4)), np.zeros(0))

    def detect(self, picture, regions):
        return self.found

    def look(self, *people):
        return self.detector.look(GREY, steps(*people))


def box_of(empty, *people):
    rows, columns = np.nonzero(steps(*people) < empty - 300)
    return [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]


def test_who_comes_is_found_by_depth_where_the_network_finds_nobody(empty):
    film = Film(empty, settings=Settings(refresh=1))
    assert [len(film.look()) for _ in range(2)] == [0, 0]
    (found,) = film.look(PERSON)
    assert np.linalg.norm(found.position[:2] - PERSON[:2]) < 0.12
    assert (found.method, found.score > 0.9) == ("depth", True)
    assert len(film.look(PERSON)) == 1  # and stays


def test_what_stands_there_from_the_beginning_needs_the_network(empty):
    """It may be furniture that came since the empty room was recorded."""
    film = Film(empty, settings=Settings(refresh=1))
    assert [len(film.look(PERSON)) for _ in range(4)] == [0] * 4
    film.found = Boxes(np.array([box_of(empty, PERSON)], float), np.array([0.15]))
    (found,) = film.look(PERSON)
    assert found.score == pytest.approx(float(FAINT.probability(np.array([0.15]), np.array([False]))[0]))
    assert film.look(PERSON, OTHER)[0].position[:2] == pytest.approx(OTHER[:2], abs=0.12)  # who came, and no more
    others = Film(empty, settings=Settings(refresh=1))
    others.found = film.found
    assert len(others.look(PERSON, OTHER)) == 0  # of whom the network says nothing: the room is not as it was


@pytest.mark.parametrize("sway", [0.0, 1.0])
def test_who_moves_there_is_somebody(empty, sway):
    """Where another thing came of which the network says nothing, a faint box does not suffice."""
    film, rng = Film(empty, settings=Settings(refresh=1)), np.random.default_rng(0)
    x0, y0, x1, y1 = box_of(empty, PERSON)
    film.found = Boxes(np.array([[x0, y0, x1, y1]], float), np.array([0.1]))
    texture = rng.integers(40, 200, GREY.shape).astype(np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 4)
    counts = []
    for time in np.arange(0, 4, 0.2):
        picture = texture.copy()
        by = np.float32([[1, 0, sway * 6 * np.sin(2 * time)], [0, 1, 0]])
        picture[y0:y1, x0:x1] = cv2.warpAffine(texture[y0:y1, x0:x1], by, (x1 - x0, y1 - y0), borderMode=1)
        noisy = np.clip(picture + rng.normal(0, 1, picture.shape), 0, 255).astype(np.uint8)
        counts.append(len(film.detector.look(noisy, steps(PERSON, OTHER), time)))
    assert counts[0] == 0
    assert counts[-5:] == [sway > 0] * 5


def test_whether_a_body_moves_is_unknown_in_the_box_of_somebody_who_was_found(empty):
    class Watched:
        motion = staticmethod(lambda *_: 5.0)

    film = Film(empty, settings=Settings(refresh=1))
    film.found = Boxes(np.array([box_of(empty, PERSON), box_of(empty, OTHER)], float), np.array([0.9, 0.9]))
    one, other = film.look(PERSON, OTHER)
    assert avcli.detection.detector._motion(one, [], Watched()) == 5.0
    assert avcli.detection.detector._motion(one, [other], Watched()) == 5.0
    assert avcli.detection.detector._motion(one, [other, one], Watched()) == 0.0


def test_another_network_s_faint_boxes_tell_nothing(empty):
    film = Film(empty, settings=Settings(refresh=1))
    film.detector._faint = None
    film.found = Boxes(np.array([box_of(empty, PERSON)], float), np.array([0.15]))
    assert len(film.look(PERSON)) == 0


def test_flicker_far_behind_does_not_make_furniture_come(empty):
    rng, film = np.random.default_rng(3), Film(empty, settings=Settings(refresh=1))
    for _ in range(30):
        depth = steps(PERSON)
        flicker = rng.random(depth.shape) < 0.02
        depth[flicker] = empty[flicker]
        assert film.detector.look(GREY, depth) == []


def test_a_person_is_not_found_twice(empty):
    film = Film(empty, settings=Settings(refresh=1))
    for _ in range(2):
        film.look()
    x0, y0, x1, y1 = box_of(empty, PERSON)
    film.found = Boxes(np.array([[x0 + 4, y0 + 4, x1 - 4, y1 - 4]], float), np.array([0.9]))
    (found,) = film.look(PERSON)
    assert found.score == 0.9


def test_a_step_is_timed_by_its_name(empty, full):
    import contextlib

    names = []

    def timing(name):
        names.append(name)
        return contextlib.nullcontext()

    with_network(full, empty, timing=timing).look(GREY, full)
    assert names == ["wait for pictures", "network", "depth and positions", "looks"]


COLOURFUL = np.random.default_rng(4).integers(40, 200, (270, 480, 3)).astype(np.uint8)


def test_looks_change_nothing_else(empty, full):
    with_looks, without = (
        detections(0.0, with_network(full, empty, settings=Settings(features=wanted)).look(COLOURFUL, full))
        for wanted in (None, False)
    )
    assert without.features == {}
    looks = with_looks.features["looks"]
    assert (looks.kind, looks.vectors.shape, looks.sds.shape) == ("clothes", (1, 7), (1, 7))
    plain = dataclasses.replace(with_looks, features={})
    assert records.encode(records.as_record(plain)) == records.encode(records.as_record(without))


def test_the_depth_detector_describes_where_it_is_asked_to(empty, full):
    asked = Settings(detector="depth", features=True)
    assert not np.isnan(Detector(config(), background=empty, settings=asked).look(COLOURFUL, full)[0].looks).all()
    assert Detector(config(), background=empty, settings=DEPTH).look(COLOURFUL, full)[0].looks is None
    with pytest.raises(MediaError, match="no colour picture"):
        Detector(config(), background=empty, settings=asked).look(None, full)


@pytest.mark.parametrize(
    ("settings", "rgb", "depth", "message"),
    [
        (DEPTH, GREY, None, "no depth picture"),
        (Settings(), None, np.zeros((270, 480), np.uint16), "no colour picture"),
        (DEPTH, None, np.zeros((100, 200), np.uint16), "the depth picture is 200 × 100 px, but config.json says 480"),
        (Settings(), GREY[:100], None, "the colour picture is 480 × 100 px"),
    ],
)
def test_a_picture_that_is_missing_or_of_another_size(empty, settings, rgb, depth, message):
    with pytest.raises(MediaError, match=message):
        Detector(config(), background=empty, settings=settings).look(rgb, depth)


def test_wrong_settings_are_refused(empty):
    with pytest.raises(ValueError, match="empty room"):
        Detector(config(), settings=DEPTH)
    with pytest.raises(ValueError, match="detector must be one of net, depth"):
        next(detect(config(), [], detector="sonar"), None)
    with pytest.raises(ValueError, match="confidence must be at most 1"):
        next(detect(config(), [], confidence=2.0), None)
    with pytest.raises(TypeError):
        next(detect(config(), [], colour="red"), None)


def test_a_box_that_fits_no_body_is_placed_marked_and_counted(empty, full):
    detector = with_network(full, empty, settings=Settings(refresh=1))
    detector.network.box = np.array([[200.0, 100.0, 215.0, 115.0]])
    (person,) = detector.look(GREY)
    record = records.as_record(detections(0.0, [person]))["objects"][0]
    assert (record["explained"], record["height"]) == (False, None)
    assert (detector.tally.by_box, detector.tally.unexplained) == (1, 1)
    detector.network.box = with_network(full, empty).network.box
    (person,) = detector.look(GREY)
    assert "explained" not in records.as_record(detections(0.0, [person]))["objects"][0]
    assert (detector.tally.by_box, detector.tally.unexplained) == (2, 1)


def test_the_boxes_tell_the_height_of_the_camera():
    people = [
        (0.9, 2.3, 0.0, 0.3, 1.7),
        (3.6, 2.2, 1.0, 0.3, 1.8),
        (2.0, 3.4, 2.0, 0.1, 1.75),
        (3.0, 3.2, 0.5, 0.2, 1.6),
    ]
    low = config()
    low.raw["camera_config"]["camera_position_m"] = [2.33, 2.33, 2.5 / 0.7]  # said too high
    detector = Detector(Config(low.raw))
    background = cast(ceiling_view(4))
    for person in people:
        rows, columns = np.nonzero(cast(ceiling_view(4), [person]) < background - 0.02)
        detector.tally.boxes.append(np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float))
    shares = detector.explained_by_height()
    assert shares[min(shares, key=lambda height: abs(height - 2.5))] == 1.0
    assert shares[max(shares)] < 1.0


def test_what_the_lens_does_not_light_does_not_count(empty, full):
    lit = config()
    lit.raw["camera_config"]["image_circle_px"] = [240.0, 135.0, 120.0]
    seen = []
    for box, people in (([20.0, 20.0, 60.0, 80.0], 0), ([200.0, 100.0, 240.0, 160.0], 1)):
        detector = Detector(Config(lit.raw))
        detector.network = FakeNetwork(box)
        look = detector.network.detect
        detector.network.detect = lambda picture, regions, look=look: seen.append(picture) or look(picture, regions)
        assert len(detector.look(GREY // 2)) == people
    assert (seen[0][0, 0] == 114).all()
    assert (seen[0][135, 240] == 45).all()


def test_boxes_that_show_only_the_room_are_left_out_and_counted(empty, full):
    settings = Settings(refresh=1, learn_background=True)
    detector = with_network(full, empty, settings=settings, room_picture=GREY)
    assert detector.look(GREY) == []
    assert detector.tally.still == 1
    x0, y0, x1, y1 = detector.network.box[0].astype(int)
    somebody = GREY.copy()
    somebody[y0:y1, x0:x1] = (200, 40, 40)
    assert len(detector.look(somebody)) == 1
