"""The scores against TrackEval and against answers known from theory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.metrics import clear, hota, identity
from avcli.metrics.matching import assign_each, match
from avcli.metrics.sequence import Sequence
from avcli.numeric import assign

EMPTY = ([], np.zeros((0, 2)))


def frames(*people):
    """Frames of the given (start, positions (n, d)) walks, identity k for the k-th."""
    length = max(start + len(walk) for start, walk in people)
    rows = []
    for t in range(length):
        here = [(k, walk[t - start]) for k, (start, walk) in enumerate(people) if 0 <= t - start < len(walk)]
        rows.append(([k for k, _ in here], np.array([p for _, p in here]).reshape(len(here), -1)))
    return rows


def walk(n, y=0.0, step=0.1):
    return np.column_stack([np.arange(n) * step, np.full(n, y)])


def score(truth, track, d0=2.0):
    sequence = Sequence.of(truth, track)
    return {
        "HOTA": hota.hota(sequence, d0),
        "CLEAR": clear.clear(sequence, match(sequence, d0)),
        "Identity": identity.identity(sequence, d0),
        "Count": identity.count(sequence),
    }


def trackeval_data(sequence, d0=2.0):
    """The sequence as TrackEval's metrics take it."""
    truth, track = sequence.truth, sequence.track
    data = {"gt_ids": [], "tracker_ids": [], "similarity_scores": []}
    for t in range(sequence.time.size):
        g, k = slice(*truth.start[t : t + 2]), slice(*track.start[t : t + 2])
        data["gt_ids"].append(truth.identity[g])
        data["tracker_ids"].append(track.identity[k])
        if g.start == g.stop or k.start == k.stop:
            data["similarity_scores"].append(np.zeros((g.stop - g.start, k.stop - k.start)))
            continue
        distance = np.linalg.norm(truth.position[g][:, None] - track.position[k][None], axis=2)
        data["similarity_scores"].append(np.maximum(0, 1 - distance / d0))
    return data | {
        "num_timesteps": sequence.time.size,
        "num_gt_ids": truth.label.size,
        "num_tracker_ids": track.label.size,
        "num_gt_dets": truth.identity.size,
        "num_tracker_dets": track.identity.size,
    }


@pytest.fixture(scope="module")
def oracle():
    trackeval = pytest.importorskip("trackeval", reason="trackeval, the oracle, is not installed")
    return {
        "HOTA": trackeval.metrics.HOTA(),
        "CLEAR": trackeval.metrics.CLEAR({"PRINT_CONFIG": False}),
        "Identity": trackeval.metrics.Identity({"PRINT_CONFIG": False}),
        "Count": trackeval.metrics.Count(),
    }


def assert_equal_to(oracle, sequences, d0=2.0):
    theirs, ours = {name: {} for name in oracle}, {name: [] for name in oracle}
    for k, sequence in enumerate(sequences):
        data = trackeval_data(sequence, d0)
        for name, metric in oracle.items():
            theirs[name][str(k)] = metric.eval_sequence(data)
        ours["HOTA"].append(hota.hota(sequence, d0))
        ours["CLEAR"].append(clear.clear(sequence, match(sequence, d0)))
        ours["Identity"].append(identity.identity(sequence, d0))
        ours["Count"].append(identity.count(sequence))
        for name, metric in oracle.items():
            compare(metric, theirs[name][str(k)], ours[name][-1])
    together = {
        "HOTA": hota.combine(ours["HOTA"]),
        "CLEAR": clear.combine(ours["CLEAR"]),
        "Identity": identity.combine(ours["Identity"]),
        "Count": identity.combine_counts(ours["Count"]),
    }
    for name, metric in oracle.items():
        compare(metric, metric.combine_sequences(theirs[name]), together[name])


def compare(metric, theirs, ours):
    assert set(metric.fields) <= set(ours)
    for field in theirs:
        np.testing.assert_allclose(ours[field], theirs[field], rtol=0, atol=1e-9, err_msg=field)


# --- assignment -------------------------------------------------------------------------------------------------------


@st.composite
def matrices(draw):
    shape = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    values = draw(st.sampled_from([[0.0, 1.0], [0.0, 0.25, 0.1, 1.0], list(np.linspace(0, 1, 30))]))
    cells = draw(st.lists(st.sampled_from(values), min_size=shape[0] * shape[1], max_size=shape[0] * shape[1]))
    return np.array(cells).reshape(shape)


@given(matrices())
@settings(max_examples=300, deadline=None)
def test_assignment_is_scipys_ties_included(score):
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-score)
    ours = assign(-score)
    np.testing.assert_array_equal(ours[0], rows)
    np.testing.assert_array_equal(ours[1], columns)
    expected = np.full(score.shape[0], -1)
    expected[rows] = columns
    np.testing.assert_array_equal(assign_each(np.stack([score, score])), [expected, expected])


# --- against TrackEval ------------------------------------------------------------------------------------------------


@st.composite
def sequences(draw, grid):
    """A few people and tracks that come, go, vanish for frames, swap names and may coincide exactly (on a grid)."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    length, people, tracks = draw(st.integers(0, 25)), draw(st.integers(0, 5)), draw(st.integers(0, 6))
    seen = draw(st.sampled_from([0.3, 0.8, 1.0]))
    room = draw(st.sampled_from([1.5, 4.0]))
    sides = []
    for number in (people, tracks):
        position = rng.uniform(0, room, (number, 2)) + np.cumsum(rng.normal(0, 0.15, (length, number, 2)), axis=0)
        sides.append(np.round(position / grid) * grid if grid else position)
    follow = rng.random(tracks) < 0.7
    for k in np.flatnonzero(follow[: min(people, tracks)]):
        sides[1][:, k] = sides[0][:, k] + (0 if grid else rng.normal(0, 0.1, (length, 2)))
    result = []
    for side in sides:
        here = rng.random(side.shape[:2]) < seen
        name = np.argsort(rng.random(side.shape[1])) if side.shape[1] else np.zeros(0, int)
        rows = []
        for t in range(length):
            if rng.random() < 0.1:
                name = rng.permutation(name)
            rows.append((name[here[t]], side[t, here[t]]))
        result.append(rows)
    return Sequence.of(*result)


@given(st.lists(sequences(grid=0), min_size=1, max_size=3))
@settings(max_examples=120, deadline=None)
def test_random_sequences_score_as_in_trackeval(oracle, some):
    assert_equal_to(oracle, some)


@given(st.lists(sequences(grid=0.5), min_size=1, max_size=3), st.sampled_from([1.0, 2.0]))
@settings(max_examples=120, deadline=None)
def test_ties_fall_as_in_trackeval(oracle, some, d0):
    assert_equal_to(oracle, some, d0)


def test_edge_cases_score_as_in_trackeval(oracle):
    some = frames((0, walk(6)), (2, walk(3, 1.0)))
    nothing = [EMPTY] * len(some)
    for truth, track in [(some, nothing), (nothing, some), (nothing, nothing), ([], []), (some, some)]:
        assert_equal_to(oracle, [Sequence.of(truth, track)])
    assert_equal_to(oracle, [Sequence.of(some, nothing), Sequence.of(some, some), Sequence.of(nothing, some)])


@pytest.mark.parametrize("k", range(19))
def test_a_similarity_exactly_on_a_threshold(oracle, k):
    truth = frames((0, np.zeros((5, 2))))
    for offset in 2.0 * (1 - hota.ALPHA[k]) + np.array([-1e-12, -4e-16, 0, 4e-16, 1e-12]):
        assert_equal_to(oracle, [Sequence.of(truth, frames((0, np.full((5, 2), [offset, 0.0]))))])


def test_many_people_in_many_blocks(oracle, monkeypatch):
    monkeypatch.setattr("avcli.metrics.sequence._PAIRS_A_BLOCK", 500)
    rng = np.random.default_rng(3)
    truth, track = [], []
    for _ in range(60):
        position = rng.uniform(0, 3, (12, 2))
        here, seen = rng.random(12) < 0.9, rng.random(12) < 0.9
        truth.append((np.flatnonzero(here), position[here]))
        track.append((np.flatnonzero(seen) + 5, (position + rng.normal(0, 0.2, (12, 2)))[seen]))
    assert_equal_to(oracle, [Sequence.of(truth, track)])


# --- known answers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("offset", "share"), [(0, 19), (0.05, 19), (0.3, 17), (0.5, 15), (1.2, 8), (2.0, 0), (9.0, 0)])
def test_a_constant_offset_fails_the_thresholds_above_it(offset, share):
    result = score(frames((0, walk(20))), frames((0, walk(20, offset))))
    for field in ("HOTA", "DetA", "AssA"):
        assert result["HOTA"][field].mean() == pytest.approx(share / 19)
    if offset >= 2:
        np.testing.assert_array_equal(result["HOTA"]["LocA"], 1.0)
    assert result["CLEAR"]["MOTA"] == (1.0 if offset <= 1 else -1.0)
    assert result["Identity"]["IDF1"] == (1.0 if offset <= 1 else 0.0)


def test_an_identity_switch_half_way():
    n = 40
    path = walk(n)
    result = score(frames((0, path)), frames((0, path[: n // 2]), (n // 2, path[n // 2 :])))
    assert result["HOTA"]["AssA"].mean() == pytest.approx(0.5)
    assert result["HOTA"]["HOTA"].mean() == pytest.approx(np.sqrt(0.5))
    assert result["Identity"]["IDF1"] == 0.5
    assert result["CLEAR"]["MOTA"] == pytest.approx(1 - 1 / n)
    assert (result["CLEAR"]["IDSW"], result["CLEAR"]["Frag"]) == (1, 0)


def test_a_new_identity_every_frame():
    path = walk(25)
    result = score(frames((0, path)), frames(*((t, path[t : t + 1]) for t in range(25))))
    assert result["HOTA"]["HOTA"].mean() == pytest.approx(1 / 5)


def test_half_of_the_frames_missing_and_a_ghost():
    path = walk(20)
    half = score(frames((0, path)), frames((0, path[:10])) + [EMPTY] * 10)
    assert half["HOTA"]["HOTA"].mean() == pytest.approx(0.5)
    ghost = score(frames((0, path)), frames((0, path), (0, path + 50)))
    assert ghost["HOTA"]["HOTA"].mean() == pytest.approx(np.sqrt(0.5))
    assert ghost["CLEAR"]["MOTA"] == 0
    assert ghost["Identity"]["IDF1"] == pytest.approx(2 / 3)


def test_bad_sequences_are_refused():
    with pytest.raises(ValueError, match="identity 4 occurs twice in frame 1"):
        Sequence.of([EMPTY, ([4, 4], np.zeros((2, 2)))], [EMPTY, EMPTY])
    with pytest.raises(ValueError, match="not finite"):
        Sequence.of([([1], np.array([[np.nan, 0]]))], [EMPTY])
    with pytest.raises(ValueError, match="dimensions"):
        Sequence.of([([1], np.zeros((1, 2)))], [([1], np.zeros((1, 3)))])
    with pytest.raises(ValueError, match="the ground truth has 2 frames, but the tracks have 1"):
        Sequence.of([EMPTY, EMPTY], [EMPTY])
