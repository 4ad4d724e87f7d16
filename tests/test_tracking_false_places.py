"""Places that are falsely detected again and again, and people who sit there."""

import math

import cv2
import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as some

from avcli.formats.records import Detections
from avcli.tracking.false_places import CERTAIN, FalsePlace, FalsePlaces
from avcli.tracking.fusion import Fusion
from avcli.tracking.learnt import read_learnt, write_learnt
from avcli.tracking.model import Population
from avcli.tracking.picture import picture
from avcli.tracking.settings import Settings

ROOM = ((0.0, 0.0), (8.0, 6.0))
SEAT = np.array([5.0, 4.0])


def fused(share, seconds, *, path=None, show="likely", settings=None, begin=None, seed=1):
    """Tracks of two people who walk to and fro, and of somebody at a path (frames, 2) m whom a share of records shows.

    share is a number, or one for each frame.

    Returns:
        The fusion, existence (frames,) of the nearest track within .7 m of the path, numbers of tracks, sentences said.
    """
    rng, said, existence, numbers = np.random.default_rng(seed), [], [], []
    fusion = Fusion(settings or Settings(show=show), population=Population(ROOM), say=said.append)
    if begin is not None:
        fusion.restore(begin)
    nan = np.full((3, 3, 3), np.nan)
    path = np.tile(SEAT, (round(10 * seconds), 1)) if path is None else path
    shares = np.broadcast_to(share, len(path))
    for k, here in enumerate(path):
        swing = 2.5 * math.sin(0.15 * k / 2.5)
        people = np.array([[3 + swing, 1.0], [3 - swing, 2.2], here]) + 0.05 * rng.standard_normal((3, 2))
        found = rng.random(3) < [0.9, 0.9, shares[k]]
        n = int(found.sum())
        at = np.column_stack([people[found], np.zeros(n)])
        record = Detections(k / 10, "ceiling", at, nan[:n], np.full(n, 0.99), "camera")
        (out,) = fusion.step(k / 10, [(k / 10, "ceiling", record)])
        near = np.linalg.norm(out.positions[:, :2] - here, axis=1) < 0.7
        existence.append(max(out.existence[near], default=0.0))
        numbers.append(len(out))
    return fusion, np.array(existence), np.array(numbers), said


def walk_in():
    """Somebody who comes from the wall, and sits down."""
    way = np.linspace([0.2, 4.0], SEAT, 45)
    return np.concatenate([way, np.tile(SEAT, (255, 1))])


@pytest.fixture(scope="module")
def flickering():
    return fused(0.3, 30.0)


def test_a_place_of_independent_detections_is_learnt_within_seconds(flickering):
    fusion, _, numbers, said = flickering
    assert (numbers[80:] == 2).mean() > 0.97
    (place,) = fusion.state()["sensors"]["ceiling"]["false_places"]
    np.testing.assert_allclose(place["position"], SEAT, atol=0.1)
    assert place["hits"] / (place["hits"] + place["misses"]) == pytest.approx(0.3, abs=0.1)
    assert len(said) == 1
    assert "ceiling" in said[0]


def test_nothing_is_learnt_of_a_place_without_learning():
    assert fused(0.3, 10.0, settings=Settings(learn=False))[3] == []


def test_who_walked_in_and_is_hardly_detected_stays():
    _, existence, _, said = fused(0.3, 30.0, path=walk_in())
    assert existence[50:].mean() > 0.9
    assert not said


def test_who_sits_there_from_the_start_and_is_detected_as_others_are_stays():
    _, existence, _, said = fused(0.9, 30.0)
    assert existence[10:].min() > 0.8
    assert not said


def test_who_was_taken_for_a_false_place_is_a_person_as_soon_as_he_moves():
    path = np.concatenate([np.tile(SEAT, (150, 1)), np.linspace(SEAT, [1.0, 5.0], 40), np.tile([1.0, 5.0], (60, 1))])
    _, existence, _, said = fused(np.where(np.arange(len(path)) < 150, 0.3, 0.9), 25.0, path=path)
    assert said
    assert existence[100:150].mean() < 0.2
    assert existence[165:].mean() > 0.9


def test_who_sits_down_at_a_false_place_is_believed(flickering):
    state = flickering[0].state()
    _, existence, _, _ = fused(0.9, 30.0, path=walk_in(), begin=state, seed=3)
    assert existence[50:].mean() > 0.9


def test_a_false_place_that_another_run_found_is_known_at_once_and_kept(flickering, tmp_path):
    path = tmp_path / "room.json"
    write_learnt(path, flickering[0].state())
    learnt = read_learnt(path)
    assert learnt == orjson.loads(path.read_bytes())
    fusion, existence, _, said = fused(0.3, 4.0, begin=learnt, seed=2)
    assert existence.mean() < 0.2
    assert not said
    assert fusion.state()["sensors"]["ceiling"]["false_places"]


def test_a_file_without_false_places_is_read_as_one_with_none(flickering, tmp_path):
    state = flickering[0].state()
    del state["sensors"]["ceiling"]["false_places"]
    path = tmp_path / "room.json"
    write_learnt(path, state)
    assert read_learnt(path)["sensors"]["ceiling"]["false_places"] == []


def test_the_picture_has_a_cross_where_a_place_is_false(flickering):
    state, population = flickering[0].state(), Population(ROOM)
    false = state["sensors"]["ceiling"]["false_places"]
    drawn = []
    for places in (false, []):
        state["sensors"]["ceiling"]["false_places"] = places
        drawn.append(cv2.imdecode(np.frombuffer(picture(state, population, {}), np.uint8), cv2.IMREAD_COLOR))
    with_cross, without = drawn
    assert len(with_cross) > len(without)  # the legend has one more line
    changed = (with_cross[:470] != without[:470]).any(2)
    for left in (0, 740):  # 8 m of the room are 500 px
        rows, columns = changed[:, left : left + 740].nonzero()
        assert (np.mean(columns), np.mean(rows)) == pytest.approx((90 + 5 * 62.5, 100 + 2 * 62.5), abs=8)


@given(some.lists(some.tuples(some.booleans(), some.floats(-1e3, 1e3)), max_size=300))
def test_rate_and_odds_stay_within_their_bounds(records):
    place = FalsePlace(1.0, 2.0, 0.01)
    for hit, nats in records:
        place.weigh(nats)
        place.count(hit)
        assert 0 < place.rate < 1
        assert place.odds <= CERTAIN


def test_the_density_of_false_places_is_that_of_their_rates():
    places = FalsePlaces(learn=True)
    places.add()
    places.restore(0, [{"position": [2.0, 3.0], "variance": 0.01, "hits": 30.0, "misses": 70.0, "log_odds": 10.0}])
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(1.0, 3.0, 0.02), np.arange(2.0, 4.0, 0.02)))
    assert 0.02**2 * math.fsum(places.density(0, np.column_stack([x, y]))) == pytest.approx(0.3, rel=1e-3)
    assert places.density(0, np.empty((0, 2))) == []
