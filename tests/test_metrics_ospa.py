"""OSPA, OSPA(2), GOSPA and errors of position against brute force and known answers."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats.records import Identified
from avcli.metrics import position
from avcli.metrics.matching import match
from avcli.metrics.ospa import ospa2, set_distances
from avcli.metrics.sequence import Sequence, align

EMPTY = ([], np.zeros((0, 2)))


def one_frame(truth, track):
    return Sequence.of([(range(len(truth)), truth)], [(range(len(track)), track)])


points = (
    st.integers(0, 4)
    .flatmap(lambda n: st.lists(st.tuples(st.floats(0, 3), st.floats(0, 3)), min_size=n, max_size=n))
    .map(lambda rows: np.array(rows, dtype=float).reshape(-1, 2))
)


def brute(truth, track, c, p):
    """OSPA and GOSPA by trying every assignment."""
    if len(truth) > len(track):
        truth, track = track, truth
    n, m = len(truth), len(track)
    if m == 0:
        return 0.0, 0.0
    best = [np.inf, np.inf]
    for order in permutations(range(m), n):
        d = np.minimum(np.linalg.norm(truth - track[list(order)], axis=1), c) ** p
        near = d < c**p
        best[0] = min(best[0], (d.sum() + c**p * (m - n)) / m)
        best[1] = min(best[1], d[near].sum() + c**p / 2 * (n + m - 2 * near.sum()))
    return best[0] ** (1 / p), best[1] ** (1 / p)


@given(points, points, st.sampled_from([0.5, 1.0, 2.0]), st.sampled_from([1.0, 2.0]))
@settings(max_examples=150, deadline=None)
def test_one_frame_by_brute_force(truth, track, c, p):
    found = set_distances(one_frame(truth, track), c, p)
    ospa, gospa = brute(truth, track, c, p)
    assert found.ospa[0] == pytest.approx(ospa, abs=1e-9)
    assert found.gospa[0] == pytest.approx(gospa, abs=1e-9)
    assert found.localization[0] ** p + found.cardinality[0] ** p == pytest.approx(found.ospa[0] ** p)
    parts = found.gospa_localization[0] + c**p / 2 * (found.missed[0] + found.false[0])
    assert parts == pytest.approx(found.gospa[0] ** p)
    # A window of one frame holds single points, so OSPA(2) is OSPA.
    assert ospa2(one_frame(truth, track), c, p, 1)[0] == pytest.approx(ospa, abs=1e-9)


@given(points, points, points)
@settings(max_examples=100, deadline=None)
def test_ospa_and_gospa_are_metrics(a, b, c):
    def between(x, y):
        found = set_distances(one_frame(x, y), 1.0, 2.0)
        return np.array([found.ospa[0], found.gospa[0]])

    assert (between(a, a) == 0).all()
    np.testing.assert_allclose(between(a, b), between(b, a), atol=1e-12)
    assert (between(a, c) <= between(a, b) + between(b, c) + 1e-9).all()


def test_ospa2_sees_a_switched_identity_and_ospa_does_not():
    path = np.column_stack([np.arange(20) * 0.1, np.zeros(20)])
    truth = [([0], p[None]) for p in path]
    switched = [([t // 10], p[None]) for t, p in enumerate(path)]
    assert set_distances(Sequence.of(truth, switched), 1.0).ospa.max() == 0
    found = ospa2(Sequence.of(truth, switched), 1.0, 1.0, 10)
    assert (found[:10] == 0).all()
    # Just after the switch the old track misses one of ten frames, and the new one is a whole track too many.
    assert found[10] == pytest.approx((0.1 + 1.0) / 2)
    assert found[19] == 0


@pytest.mark.parametrize("window", [1, 7, 600])
def test_ospa2_does_not_depend_on_the_chunks(monkeypatch, window):
    rng = np.random.default_rng(2)

    def side(shift):
        rows = []
        for _ in range(60):
            here = np.flatnonzero(rng.random(4) < 0.7)
            rows.append((here + shift, rng.uniform(0, 2, (here.size, 2))))
        return rows

    sequence = Sequence.of([EMPTY] * 20 + side(0), side(3) + [EMPTY] * 20)
    whole = ospa2(sequence, 1.0, 1.0, window)
    monkeypatch.setattr("avcli.metrics.ospa._FRAMES_A_CHUNK", 7)
    np.testing.assert_allclose(ospa2(sequence, 1.0, 1.0, window), whole, atol=1e-12)
    assert whole[0] == 1.0


def test_errors_and_delay():
    path = np.column_stack([np.arange(10) * 0.1, np.zeros(10)])
    truth = [([7], p[None]) for p in path]
    track = [EMPTY] * 3 + [([1], p[None] + [0.0, 0.3]) for p in path[3:]]
    sequence = Sequence.of(truth, track, np.arange(10) / 10)
    found = position.position(sequence, match(sequence))
    assert found["RMSE"] == found["MAE"] == found["MaxError"] == pytest.approx(0.3)
    assert found["BirthDelay"] == pytest.approx(0.3)
    nobody = Sequence.of(truth, [EMPTY] * 10)
    assert position.position(nobody, match(nobody))["RMSE"] is None
    both = position.combine([found, position.position(nobody, match(nobody))])
    assert (both["RMSE"], both["Found"]) == (pytest.approx(0.3), 1)


# --- one timeline -----------------------------------------------------------------------------------------------------


def recording(times, ids=(0,)):
    return [Identified(t, np.array(ids), np.array([[t, k, 0.0] for k in ids]).reshape(-1, 3)) for t in times]


def test_records_meet_in_time_and_the_rest_is_counted():
    truth = recording([0.0, 0.1, 0.2, 0.3])
    sequence, odd = align(truth, recording([0.3004, 0.1, 0.15, 0.2999]), tolerance=1e-3)
    np.testing.assert_allclose(sequence.time, [0.0, 0.1, 0.15, 0.2, 0.3, 0.3004])
    np.testing.assert_array_equal(sequence.truth.count, [1, 1, 0, 1, 1, 0])
    np.testing.assert_array_equal(sequence.track.count, [0, 1, 1, 0, 1, 1])
    assert (odd.truth_frames, odd.truth_points, odd.track_frames, odd.track_points) == (2, 2, 2, 2)
    assert odd.unsorted == 1
    _, exact = align(truth, recording([0.0001, 0.1001, 0.2001, 0.3001]), tolerance=1e-4)
    assert exact.truth_frames == exact.track_frames == 0


@given(st.lists(st.integers(0, 30), max_size=12, unique=True), st.lists(st.integers(0, 30), max_size=12, unique=True))
@settings(deadline=None)
def test_partners_are_one_to_one_within_the_tolerance(a, b):
    sequence, odd = align(recording([t / 10 for t in a]), recording([t / 10 for t in b]))
    together = len(set(a) & set(b))
    assert odd.truth_frames == len(a) - together
    assert odd.track_frames == len(b) - together
    assert sequence.time.size == len(set(a) | set(b))
    assert (np.diff(sequence.time) > 0).all()


def test_records_of_one_time_are_joined():
    truth = recording([0.0], (0, 1))
    parts = recording([0.0], (4,)) + recording([0.0], (5,))
    sequence, odd = align(truth, parts)
    assert sequence.track.count.tolist() == [2]
    assert odd.repeated == 1
    with pytest.raises(ValueError, match="identity 4 occurs twice at 0 s in the tracks"):
        align(truth, parts + recording([0.0], (4,)))
    sequence, odd = align(truth, parts + recording([0.0], (4,)), keep_first=True)
    assert (sequence.track.count.tolist(), odd.dropped) == ([2], 1)


def test_heights_are_needed_in_three_dimensions_only():
    truth = recording([0.0])
    flat = [Identified(0.0, np.array([1]), np.array([[0.0, 0.0, np.nan]]))]
    assert align(truth, flat)[0].track.position.shape == (1, 2)
    with pytest.raises(ValueError, match="no height"):
        align(truth, flat, dims=3)
    high = [Identified(0.0, np.array([1]), np.array([[0.0, 0.0, 1.5]]))]
    assert align(truth, high, dims=3)[1].height == pytest.approx(1.5)
