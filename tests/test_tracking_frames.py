"""Coordinate frames of sensors that disagree: found where people walk, and nothing is said where nobody can tell."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats.records import Detections
from avcli.tracking.agreement import Agreement
from avcli.tracking.frames import Transform, transform, turn

Record = tuple[float, np.ndarray]
STILL = np.eye(2)


def turned(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s], [s, c]])


def walked(people: int, seconds: float, rng: np.random.Generator) -> np.ndarray:
    """People (times, people, 2) m who walk from one drawn place to the next at 1 m/s, ten times a second."""
    times = np.arange(0.0, seconds, 0.1)
    paths = []
    for _ in range(people):
        ways = rng.uniform(0.5, 5.5, (int(seconds), 2))
        reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ways, axis=0), axis=1))])
        paths.append(np.column_stack([np.interp(times, reached, column) for column in ways.T]))
    return np.stack(paths, axis=1)


def sensed(paths: np.ndarray, sd: float, share: float, rng: np.random.Generator) -> list[Record]:
    """What a sensor finds of people, with noise, one false detection in twenty records, and heights that it lacks."""
    out = []
    for k, places in enumerate(paths):
        found = places[rng.random(len(places)) < share] + sd * rng.standard_normal((1, 2))
        found = np.concatenate([found, rng.uniform(0, 6, (int(rng.random() < 0.05), 2))])
        out.append((k / 10, np.column_stack([found, np.full(len(found), np.nan)])))
    return out


def of(
    people: int, matrix: np.ndarray, shift: tuple[float, float], seed: int = 0, seconds: float = 60.0
) -> Transform | None:
    """What is found of ears, and of an eye whose coordinates are turned or mirrored about (3, 3) m, and moved."""
    rng = np.random.default_rng(seed)
    paths = walked(people, seconds, rng)
    moved = (paths - 3) @ matrix.T + 3 + np.array(shift)
    return transform(sensed(paths, 0.2, 0.8, rng), sensed(moved, 0.1, 0.95, rng))


@pytest.mark.parametrize("people", [1, 3])
@pytest.mark.parametrize(
    ("matrix", "shift"),
    [
        (turned(90), (0, 0)),
        (turned(180), (0, 0)),
        (turned(-30), (0.5, 0)),
        (np.diag([-1, 1]), (0, 0)),
        (np.array([[0, 1], [1, 0]]), (0, 0)),
        (STILL, (0.8, -0.5)),
    ],
)
def test_a_frame_that_is_turned_mirrored_or_moved_is_found(people, matrix, shift):
    found = of(people, matrix, shift)
    assert found is not None
    np.testing.assert_allclose(found.matrix, matrix, atol=0.07)
    np.testing.assert_allclose(found.matrix @ [3, 3] + found.shift, np.array([3, 3]) + shift, atol=0.15)
    assert found.fits > 0.6 > found.as_it_is


@pytest.mark.parametrize(
    ("matrix", "shift", "says"),
    [
        (turned(90), (6, 0), "turned by 90 degrees from x to y about (3.0, 3.0) m"),
        (turned(-20), (0, 0), "turned by -20 degrees from x to y about (0.0, 0.0) m"),
        (turned(1), (0.8, -0.5), "moved by (0.8, -0.5) m"),
        (np.diag([-1, 1]), (6, 0), "mirrored: x runs the other way"),
        (np.diag([1, -1]) @ turned(4), (6, 0), "mirrored: y runs the other way"),
        (np.array([[0, 1], [1, 0]]), (0, 0), "mirrored: x and y are exchanged"),
        (-np.array([[0, 1], [1, 0]]), (6, 6), "mirrored: x and y are exchanged and run the other way"),
        (turned(60) @ np.diag([1, -1]), (0, 0), "mirrored about a line at 30 degrees from x to y"),
    ],
)
def test_a_transform_is_said_as_the_mistake_that_makes_it(matrix, shift, says):
    assert Transform(matrix, np.array(shift, float), np.zeros(2), 1.0, 0.9, 0.1).words() == says


@pytest.mark.parametrize("people", [1, 3, 6])
@pytest.mark.parametrize("shift", [(0, 0), (0.15, 0.0)])
def test_frames_that_agree_to_the_noise_are_not_doubted(people, shift):
    assert of(people, STILL, shift) is None


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_sensors_that_see_other_people_have_nothing_in_common(seed, people):
    rng = np.random.default_rng(seed)
    here, there = (sensed(walked(people, 60.0, rng), 0.15, 0.9, rng) for _ in range(2))
    assert transform(here, there) is None


def test_detections_of_a_single_moment_tell_nothing():
    places = np.column_stack([np.random.default_rng(0).uniform(0, 30, (60, 2)), np.zeros(60)])
    records = [(0.1 * k, places[k : k + 15]) for k in range(0, 60, 15)]
    assert transform(records, records) is None


def test_people_who_stay_where_they_are_tell_nothing():
    rng = np.random.default_rng(0)
    seated = np.broadcast_to(np.array([[1.0, 2.0], [4.0, 4.5]]), (600, 2, 2))
    assert transform(sensed(seated, 0.1, 0.9, rng), sensed(seated @ turned(90).T, 0.1, 0.9, rng)) is None


@pytest.mark.parametrize("found", [np.empty((0, 3)), np.full((2, 3), np.nan)])
def test_a_sensor_without_positions_tells_nothing(found):
    rng = np.random.default_rng(0)
    others = sensed(walked(2, 60.0, rng), 0.1, 0.9, rng)
    nothing = [(time, found) for time, _ in others]
    assert transform(nothing, others) is None
    assert transform(others, nothing) is None
    assert transform([], others) is None


def test_the_run_says_it_once_and_names_both_sensors():
    rng, agreement, said = np.random.default_rng(0), Agreement(), []
    paths = walked(2, 100.0, rng)
    ears, eye = sensed(paths, 0.2, 0.6, rng), sensed((paths - 3) * [-1, 1] + 3, 0.1, 0.95, rng)
    for (time, heard), (_, seen) in zip(ears, eye, strict=True):
        agreement.take(time, "ears", Detections(time, "ears", heard, np.full((len(heard), 3, 3), np.nan)))
        agreement.take(time, "eye", Detections(time, "eye", seen, np.full((len(seen), 3, 3), np.nan)))
        said += agreement.news(time)
    (sentence,) = said
    assert sentence.startswith("sensor 'eye' finds people where 'ears' finds them, mirrored: x runs the other way (")
    assert sentence.endswith("do their coordinates agree?")


ARRAY = np.array([2.2, 2.8, 0.8])


def directions(heard: list[Record], matrix: np.ndarray) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """What an array at ARRAY hears of mouths, if it is turned or mirrored."""
    out = []
    for time, places in heard:
        away = np.column_stack([places[:, :2], np.full(len(places), 1.5)]) - ARRAY
        away[:, :2] = away[:, :2] @ matrix.T
        out.append((time, np.tile(ARRAY, (len(away), 1)), away / np.linalg.norm(away, axis=1, keepdims=True)))
    return out


@pytest.mark.parametrize("people", [1, 3])
@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        (turned(90), "turned by -"),
        (turned(180), "turned by"),
        (np.diag([-1, 1]), "mirrored: x runs"),
        (STILL, ""),
    ],
)
def test_a_compact_array_that_is_turned_is_found(people, matrix, says):
    rng = np.random.default_rng(0)
    paths = walked(people, 60.0, rng)
    heard, seen = sensed(paths, 0.15, 0.8, rng), sensed(paths, 0.1, 0.95, rng)
    found = turn(directions(heard, matrix), seen)
    if not says:
        assert found is None
        return
    np.testing.assert_allclose(found.matrix, matrix.T, atol=0.1)
    np.testing.assert_allclose(found.matrix @ ARRAY[:2] + found.shift, ARRAY[:2], atol=1e-9)
    assert found.words().startswith(says)


def test_the_run_says_that_an_array_is_turned():
    rng, agreement, said = np.random.default_rng(1), Agreement(), []
    paths = walked(2, 60.0, rng)
    heard, seen = directions(sensed(paths, 0.15, 0.8, rng), turned(45)), sensed(paths, 0.1, 0.95, rng)
    for (time, origins, ways), (_, places) in zip(heard, seen, strict=True):
        nowhere = np.full((len(ways), 3), np.nan), np.full((len(ways), 3, 3), np.nan)
        agreement.take(time, "ears", Detections(time, "ears", *nowhere, origins=origins, directions=ways))
        agreement.take(time, "eye", Detections(time, "eye", places, np.full((len(places), 3, 3), np.nan)))
        said += agreement.news(time)
    (sentence,) = said
    assert sentence.startswith("sensor 'eye' finds people where 'ears' finds them, turned by -4")
    assert "about (2.2, 2.8) m" in sentence
    assert "within 14 degrees" in sentence


@pytest.mark.parametrize("way", [[0.0, 0.0, 1.0], [np.nan] * 3])
def test_directions_that_point_nowhere_on_the_floor_tell_nothing(way):
    rng = np.random.default_rng(0)
    others = sensed(walked(2, 60.0, rng), 0.1, 0.9, rng)
    ways = [(time, ARRAY[None], np.array([way])) for time, _ in others]
    assert turn(ways, others) is None
    assert turn([(time, np.full((1, 3), np.nan), np.array([[1.0, 0.0, 0.0]])) for time, _ in others], others) is None


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 60), st.sampled_from([0.001, 1.0, 1e6]))
def test_any_detections_are_compared_without_a_warning(seed, records, scale):
    rng, agreement = np.random.default_rng(seed), Agreement()
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        for time in np.cumsum(rng.choice([0.0, 0.1, 0.5, 1000.0], records, p=[0.1, 0.4, 0.45, 0.05])):
            for name in ("ears", "eye"):
                count = int(rng.integers(0, 30))
                places = rng.normal(0.0, scale, (count, 3))
                places[rng.random(count) < 0.1] = np.nan
                given = {}
                if name == "ears" and seed % 2:
                    ways = rng.normal(size=(count, 3))
                    ways[rng.random(count) < 0.2] = np.nan
                    given = {"origins": rng.normal(0.0, scale, (count, 3)), "directions": ways}
                agreement.take(time, name, Detections(time, name, places, np.full((count, 3, 3), np.nan), **given))
            agreement.news(time)
        agreement.news(time + 1e4)
