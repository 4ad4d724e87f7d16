"""A person who was found a moment ago is followed at a lower score, and nobody else is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_detection_detector import GREY, FakeNetwork, config

from avcli.detection.detector import Detector
from avcli.detection.following import FOLLOWED, LOST_S, Following
from avcli.detection.network import Boxes
from avcli.detection.settings import Settings

BOX = np.array([[100.0, 60.0, 150.0, 130.0]])
LEAST = 0.5


def found(*steps):
    """Whether one box is found in each step (time, score, box), once it was found half a second before the first."""
    following = Following()
    following.found(steps[0][2], np.array([0.9]), LEAST, steps[0][0] - 0.5)
    return [bool(following.found(box, np.array([score]), LEAST, time)[0]) for time, score, box in steps]


def test_a_low_score_goes_on_but_does_not_begin():
    assert found((0.0, 0.9, BOX), (0.2, 0.4, BOX), (0.3, 0.4, BOX)) == [True, True, True]
    following = Following()
    assert not any(following.found(BOX, np.array([0.4]), LEAST, 0.1 * k)[0] for k in range(9))


def test_a_score_that_was_enough_once_is_not_followed():
    assert found((0.0, 0.4, BOX), (0.1, 0.9, BOX), (0.2, 0.4, BOX)) == [False, True, True]


def test_a_score_that_is_lower_still_does_not_go_on():
    assert found((0.0, 0.9, BOX), (0.1, FOLLOWED - 0.01, BOX)) == [True, False]


def test_a_score_that_motion_raises_goes_on_but_does_not_begin():
    following = Following()
    low, raised = np.array([0.1]), np.array([0.4])
    assert not following.found(BOX, low, LEAST, 0.0, raised)[0]
    for time in (0.1, 0.2):
        following.found(BOX, np.array([0.9]), LEAST, time)
    assert following.found(BOX, low, LEAST, 0.3, raised)[0]
    assert not following.found(BOX, low, LEAST, 0.4, low)[0]


def test_who_walks_is_followed_from_picture_to_picture():
    steps = [(0.1 * k, 0.9 if k == 0 else 0.35, BOX + 12 * k * np.array([1, 0, 1, 0])) for k in range(12)]
    assert all(found(*steps))
    assert found(steps[0], steps[4]) == [True, False]  # too far from where it was last seen


@pytest.mark.parametrize(
    ("pause", "follows"), [(0.9 * LOST_S, True), (1.1 * LOST_S, False), (0.0, False), (-1.0, False)]
)
def test_who_was_not_seen_for_long_is_found_anew(pause, follows):
    assert found((5.0, 0.9, BOX), (5.0 + pause, 0.4, BOX)) == [True, follows]


def test_who_is_there_while_nothing_changes_is_not_lost():
    following = Following()
    for time in (0.0, 0.1):
        following.found(BOX, np.array([0.9]), LEAST, time)
    for time in np.arange(0.2, 4.0, 0.1):
        following.unchanged(time)
    assert following.found(BOX, np.array([0.4]), LEAST, 4.5)[0]
    following.found(BOX[:0], np.empty(0), LEAST, 4.6)  # the person is hidden
    following.unchanged(5.6)
    assert not following.found(BOX, np.array([0.4]), LEAST, 5.7)[0]


def test_one_person_is_one_box():
    following = Following()
    for time in (-0.1, 0.0):
        following.found(BOX, np.array([0.9]), LEAST, time)
    boxes = np.concatenate([BOX + 3, BOX - 3])
    assert following.found(boxes, np.array([0.45, 0.4]), LEAST, 0.1).tolist() == [True, False]


@given(st.lists(st.lists(st.tuples(st.floats(0, 300), st.floats(5, 80), st.floats(0, 1)), max_size=6), max_size=8))
def test_everybody_with_score_enough_is_found_and_no_one_below_the_lower_one(pictures):
    following = Following()
    for k, people in enumerate(pictures):
        rows = np.array(sorted(people, key=lambda row: -row[2])).reshape(-1, 3)
        boxes = np.column_stack([rows[:, 0], rows[:, 0], rows[:, 0] + rows[:, 1], rows[:, 0] + rows[:, 1]])
        believed = following.found(boxes, rows[:, 2], LEAST, 0.1 * k)
        assert believed[rows[:, 2] >= LEAST].all()
        assert not believed[rows[:, 2] < FOLLOWED].any()


class Fading(FakeNetwork):
    """Finds a box whose score falls at the third picture."""

    def detect(self, picture, regions):
        seen = super().detect(picture, regions)
        return Boxes(seen.boxes, np.array([0.9 if self.looks <= 2 else 0.4]))


@pytest.mark.parametrize(
    ("settings", "times", "people"),
    [
        (Settings(refresh=1), (0.0, 0.1, 0.2), [1, 1, 1]),
        (Settings(confidence=0.5, refresh=1), (0.0, 0.1, 0.2), [1, 1, 0]),
        (Settings(refresh=1), (None, None, None), [1, 1, 0]),
        (Settings(refresh=1), (0.0, 0.1, 2.0), [1, 1, 0]),
    ],
)
def test_the_detector_follows_in_films_where_no_score_was_asked_for(settings, times, people):
    detector = Detector(config(), settings=settings)
    detector.network = Fading(BOX[0])
    seen = [detector.look(GREY, None, time) for time in times]
    assert [len(each) for each in seen] == people
    assert detector.tally.followed == people[2]
    if people[2]:
        assert seen[2][0].score == pytest.approx(0.4)


def test_who_keeps_still_is_not_followed():
    rng = np.random.default_rng(1)
    room = np.kron(rng.integers(40, 180, (27, 48, 3)), np.ones((10, 10, 1)))
    detector = Detector(config(), settings=Settings(refresh=1))
    detector.network = Fading(BOX[0])
    counts = []
    for time in np.arange(0, 6, 0.1):
        picture = np.clip(np.rint(room + 2 * rng.standard_normal(room.shape)), 0, 255).astype(np.uint8)
        counts.append(len(detector.look(picture, None, time)))
    assert counts[:3] == [1, 1, 1]
    assert counts[-1] == 0
