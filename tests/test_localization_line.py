"""Microphones on one line: what a line can tell, and that the rest is said to be unknown."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.formats.features import Feature
from avcli.localization.array import Array, Talker
from avcli.localization.line import APART_M, HalfPlane, believed
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block

FS = 16000
LOW, HIGH = np.array([0.0, 0.0, 0.8]), np.array([*ROOM[:2], 2.0])


def line(middle, axis, length=2.4, count=8):
    """The microphones (count, 3) m of a line."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.asarray(middle, float) + length * np.linspace(-0.5, 0.5, count)[:, None] * axis


WALL = line([ROOM[0] / 2, 0.03, 1.5], [1, 0, 0])
TABLE = line([ROOM[0] / 2, ROOM[1] / 2, 0.75], [1, 0, 0])


def beside(microphones):
    found = HalfPlane.beside(Array(microphones, FS, ROOM), LOW, HIGH)
    assert found is not None
    return found


def talker(half, place, sd=0.05, score=0.8):
    return Talker(half.flat(np.asarray(place, float)), sd**2 * np.eye(3), score)


places = st.tuples(*(st.floats(a + 0.3, b - 0.3) for a, b in zip(LOW, HIGH, strict=True))).map(np.array)
axes = st.tuples(st.floats(0.2, 1), st.floats(-1, 1), st.floats(-1, 1)).map(np.array)


@given(axes, places)
def test_a_half_plane_keeps_all_distances_to_the_microphones(axis, place):
    array = Array(line(ROOM / 2, axis, 1.5), FS, ROOM)
    half = HalfPlane.beside(array, LOW, HIGH)
    flat, low, high = half.searched(array)
    ways = np.linalg.norm(half.flat(place) - flat.microphones, axis=1)
    np.testing.assert_allclose(ways, np.linalg.norm(place - array.microphones, axis=1), atol=1e-9)
    assert (half.flat(place) >= low - 1e-2).all()
    assert (half.flat(place) <= high + 1e-2).all()


@given(axes, places)
def test_a_talker_is_within_what_is_told_and_no_probability_is_lost(axis, place):
    half = beside(line(ROOM / 2, axis, 1.5))
    told = half.sides(talker(half, place))
    assert 0.76 <= sum(one.score for one in told) <= 0.8 + 1e-9
    distances = []
    for one in told:
        np.testing.assert_allclose(one.covariance, one.covariance.T)
        assert np.linalg.eigvalsh(one.covariance).min() > 0
        assert (one.position >= LOW - 0.2).all()
        assert (one.position <= HIGH + 0.2).all()
        away = one.position - place
        distances.append(away @ np.linalg.solve(one.covariance, away))
    assert min(distances) < 16.3  # 99.9 % of three dimensions


def test_before_a_wall_there_is_one_side():
    half, place = beside(WALL), np.array([1.4, 2.6, 1.5])
    (told,) = half.sides(talker(half, place))
    assert np.linalg.norm((told.position - place)[:2]) < 0.1
    assert told.score == pytest.approx(0.8, abs=0.01)


def test_a_line_in_the_middle_tells_both_sides():
    half, place = beside(TABLE), np.array([1.4, ROOM[1] / 2 + 1.9, 1.5])
    one, other = sorted(half.sides(talker(half, place)), key=lambda told: -told.position[1])
    assert np.linalg.norm((one.position - place)[:2]) < 0.2
    assert other.position[1] == pytest.approx(ROOM[1] - one.position[1], abs=0.01)
    assert one.score == pytest.approx(other.score, abs=0.01)
    assert abs(one.position[1] - other.position[1]) > APART_M


def test_above_a_table_the_sides_are_one():
    half = beside(TABLE)
    (told,) = half.sides(talker(half, [1.4, ROOM[1] / 2 + 0.3, 1.6]))
    assert np.sqrt(told.covariance[1, 1]) > 0.2


def test_features_go_with_their_talkers():
    half = beside(TABLE)
    two = [talker(half, [1.4, ROOM[1] / 2 + 0.3, 1.6]), talker(half, [2.0, ROOM[1] / 2 + 1.9, 1.5])]
    voices = {"voice": Feature("pitch", np.array([[100.0], [200.0]]), np.ones((2, 1)))}
    told, features = half.told(two, voices)
    assert len(told) == 3
    assert features["voice"].vectors.ravel().tolist() == [100.0, 200.0, 200.0]
    assert half.told([], {}) == ([], {})


def test_what_is_outside_the_room_is_told_where_the_room_is_nearest():
    half = beside(WALL)
    (told,) = half.sides(Talker(np.array([0.0, ROOM[1] + 1.0, 0.0]), 0.01 * np.eye(3), 0.5))
    assert (np.isfinite(told.position)).all()
    assert told.position[1] > ROOM[1] - 0.5


def test_arrays_in_a_plane_or_in_space_are_no_lines():
    assert HalfPlane.beside(Array(MICROPHONES, FS, ROOM), LOW, HIGH) is None
    assert HalfPlane.beside(Array(WALL + [[0, 0.03, 0], [0, 0, 0.03]] * 4, FS, ROOM), LOW, HIGH) is None


@given(st.floats(0, 1), st.floats(0, 1))
def test_further_scores_keep_their_order(one, other):
    assert 0 <= believed(one) <= 1
    assert believed(min(one, other)) <= believed(max(one, other))


@pytest.mark.parametrize(("microphones", "y", "limit"), [(WALL, 2.6, 0.25), (TABLE, 4.2, 0.4)])
def test_a_talker_is_heard_by_a_line(microphones, y, limit):
    place, rng = np.array([1.4, y, 1.5]), np.random.default_rng(21)
    samples = noisy(heard(place, voice(1.6, FS, rng), FS, microphones=microphones, reflection=0.6, order=2), 30, rng)
    localizer = SteeredLocalizer(Array(microphones, FS, ROOM), SteeredSettings(), np.random.default_rng(0))
    decisions = [one for one in localizer.localize([Block(samples)]) if 0.3 < one.time < 1.4]
    away = [np.linalg.norm((one.positions - place)[:, :2], axis=1).min() for one in decisions if len(one.positions)]
    assert len(away) > 0.8 * len(decisions)
    assert np.median(away) < limit
    assert all(one.scores.sum() <= 2.0 for one in decisions)
