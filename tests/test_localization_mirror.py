"""Microphones in one plane: where both sides of it may be, both are told."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from localization_rooms import ROOM, heard, noisy, voice

from avcli.localization.array import Array, Talker
from avcli.localization.mirror import HalfSpace
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block

FS = 16000
LOW, HIGH = np.array([0.0, 0.0, 0.8]), np.array([*ROOM[:2], 2.0])
MIDDLE = ROOM[1] / 2
PARTITION = np.array([[x, MIDDLE, z] for x in ROOM[0] * np.array([0.2, 0.4, 0.6, 0.8]) for z in (1.0, 2.0)])


def beside(microphones):
    found = HalfSpace.beside(Array(microphones, FS, ROOM), LOW, HIGH)
    assert found is not None
    return found


places = st.tuples(*(st.floats(a + 0.1, b - 0.1) for a, b in zip(LOW, HIGH, strict=True))).map(np.array)


@given(places)
def test_a_place_and_its_image_are_heard_alike_and_have_the_same_sides(place):
    half, covariance = beside(PARTITION), np.diag([0.1, 0.2, 0.3])
    ways = [np.linalg.norm(point - PARTITION, axis=1) for point in (place, half.image(place))]
    np.testing.assert_allclose(*ways, atol=1e-9)
    np.testing.assert_allclose(half.fold(place), half.fold(half.image(place)), atol=1e-9)
    told = half.sides(Talker(place, covariance, 0.8))
    assert sum(one.score for one in told) == pytest.approx(0.8)
    assert len(told) == (2 if abs(place[1] - MIDDLE) >= 0.25 else 1)
    for one in told:
        np.testing.assert_allclose(np.linalg.eigvalsh(one.covariance), [0.1, 0.2, 0.3])
        np.testing.assert_array_equal(one.covariance, one.covariance.T)


@pytest.mark.parametrize("shift", [[0, 0.03 - MIDDLE, 0], [0, MIDDLE - 0.03, 0]])
def test_before_a_wall_there_is_one_side(shift):
    (told,) = beside(PARTITION + shift).sides(Talker(np.array([1.0, MIDDLE, 1.5]), 0.01 * np.eye(3), 0.8))
    assert told.score == 0.8


def test_level_arrays_have_one_side():
    level = PARTITION[:, [0, 2, 1]] * [1, 1, 0] + [0, 0, 1.3]
    (told,) = beside(level).sides(Talker(np.array([1.0, 3.0, 1.5]), 0.01 * np.eye(3), 0.8))
    assert told.position.tolist() == [1.0, 3.0, 1.5]


def test_microphones_in_space_have_no_mirror_images():
    assert (
        HalfSpace.beside(
            Array(PARTITION + np.array([[0, 0.05, 0], [0, 0, 0], [0, 0, 0], [0, 0.05, 0]] * 2), FS, ROOM), LOW, HIGH
        )
        is None
    )


def test_a_talker_beside_a_partition_is_told_on_both_sides():
    place, rng = np.array([1.4, MIDDLE + 1.2, 1.5]), np.random.default_rng(21)
    sound = heard(place, voice(1.2, FS, rng), FS, microphones=PARTITION, reflection=0.6, order=2)
    localizer = SteeredLocalizer(Array(PARTITION, FS, ROOM), SteeredSettings(), np.random.default_rng(0))
    found = [one for one in localizer.localize([Block(noisy(sound, 30, rng))]) if 0.2 < one.time < 1.0]
    assert all(len(one.positions) == 2 for one in found)
    assert all((one.scores < 0.51).all() for one in found)
    away = [np.linalg.norm((one.positions - place)[:, :2], axis=1).min() for one in found]
    assert np.median(away) < 0.15
