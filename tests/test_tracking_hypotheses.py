"""Clusters of joint hypotheses: what splits them, what merges in them; sensors that go blind; people who meet."""

import math
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats.experiment import Config
from avcli.formats.sensors import MICROPHONES
from avcli.tracking import association, coverage, gaussian
from avcli.tracking.blindness import Blindness
from avcli.tracking.densities import Densities
from avcli.tracking.glmb import GLMB
from avcli.tracking.hypotheses import Cluster, condensed, decided
from avcli.tracking.model import Population
from avcli.tracking.motion import WALKING
from avcli.tracking.settings import Settings, sensor

sys.path.insert(0, str(Path(__file__).parent / "bench"))
import tracking_scenes as scenes


def cluster(shares, labels=None):
    """Of a dictionary: row -> probability."""
    rows = sorted(shares, key=lambda row: -shares[row])
    return Cluster(labels or list(range(len(rows[0]))), rows, [math.log(shares[row]) for row in rows])


def people(states, labels):
    """Densities with all models' means at the states (n, 4)."""
    n, m = len(states), len(WALKING.models)
    mean = np.tile(np.reshape(states, (n, 1, 4)), (1, m, 1)).astype(float)
    cov = np.tile(0.01 * np.eye(4), (n, m, 1, 1))
    return Densities(
        mean=mean,
        cov=cov,
        mode=np.full((n, m), 1 / m),
        existence=np.ones(n),
        detectable=np.ones((n, 1)),
        lean=np.ones((n, 1)),
        seen=np.zeros((n, 1)),
        place=np.zeros((n, 2)),
        hits=np.ones((n, 1)),
        told=np.zeros(n),
        counted=np.zeros((n, 1)),
        doubt=np.zeros((n, 1)),
        reach=np.zeros(n),
        common=np.zeros((n, 2, 2)),
        label=list(labels),
        node=[None] * n,
    )


def test_two_pairs_that_know_nothing_of_each_other_are_two_clusters():
    pair, other = {(0, 1): 0.7, (2, 3): 0.3}, {(4, 5): 0.6, (6, 7): 0.4}
    joint = cluster({a + b: p * q for a, p in pair.items() for b, q in other.items()})
    assert joint.parts() == [[0, 1], [2, 3]]
    one, two = (joint.only(part) for part in joint.parts())
    assert dict(zip(one.hypotheses, one.shares, strict=True)) == pytest.approx(pair)
    assert dict(zip(two.hypotheses, two.shares, strict=True)) == pytest.approx(other)


def test_who_depends_on_another_through_a_third_stays_with_them():
    chain = cluster({(0, 1, 2): 0.4, (3, 4, 2): 0.3, (0, 5, 6): 0.3})
    assert chain.parts() == [[0, 1, 2]]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_parts_keep_every_marginal(seed):
    rng = np.random.default_rng(seed)
    rows = {tuple((10 * k + rng.integers(-1, 3)) if rng.random() > 0.2 else -1 for k in range(4)) for _ in range(8)}
    weights = rng.dirichlet(np.ones(len(rows)))
    whole = cluster(dict(zip(sorted(rows), weights.tolist(), strict=True)))
    parts = whole.parts()
    assert sorted(at for part in parts for at in part) == [0, 1, 2, 3]
    exist = np.ones(40)
    for part in parts:
        for k, at in enumerate(part):
            assert whole.only(part).marginals(k, exist)[0] == pytest.approx(whole.marginals(at, exist)[0])


def crowd(count, beside):
    """Each of so many people in a line, with a detection each, and the options of each row.

    beside: log weight of the detection of a neighbour, where the own one has ln 40 and none ln 0.1.
    """
    clusters, options = [Cluster([k], [(k,)], [0.0]) for k in range(count)], {}
    for k in range(count):
        near = [(beside, j) for j in (k - 1, k + 1) if 0 <= j < count]
        options[k] = sorted([(math.log(40), k), *near, (math.log(0.1), association.MISSED)], reverse=True)
    return clusters, options


def test_in_a_crowd_whose_people_are_told_apart_each_is_a_group_of_its_own():
    clusters, options = crowd(12, math.log(0.04))
    assert len(association.competing(clusters, options)) == 1
    parts = association.apart(clusters, options, 12)
    assert sorted(one.labels for some, _ in parts for one in some) == [[k] for k in range(12)]
    assert all(len(some) == 1 for some, _ in parts)
    unclaimed = [1.0] * 12
    groups = [association.associate(some, kept, unclaimed, 40) for some, kept in parts]
    assert all(group.hypotheses[0].pairs == ((group.labels[0], group.labels[0]),) for group in groups)
    assert max(unclaimed) < 0.01


@pytest.mark.parametrize(("count", "beside"), [(association.MANY, 0.04), (12, 30.0)])
def test_few_people_and_those_who_are_not_told_apart_stay_together(count, beside):
    clusters, options = crowd(count, math.log(beside))
    assert [len(some) for some, _ in association.apart(clusters, options, count)] == [count]


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_claims_are_near_those_of_all_joint_associations(seed):
    rng = np.random.default_rng(seed)
    clusters = [cluster({(0,): 0.7, (1,): 0.3}), cluster({(2, 3): 0.6, (2, 4): 0.4})]
    gains = rng.normal(0, 2, (5, 3)).tolist()
    options = {
        row: sorted([(0.0, association.MISSED), *((gain, j) for j, gain in enumerate(some))], reverse=True)
        for row, some in enumerate(gains)
    }
    priors = [
        (math.log(p * q), (*a, *b))
        for a, p in {(0,): 0.7, (1,): 0.3}.items()
        for b, q in {(2, 3): 0.6, (2, 4): 0.4}.items()
    ]
    exact, whole = np.zeros((2, 3)), 0.0
    for weight, pairs, _ in association.ranked(priors, options, 10**6, math.inf):
        whole += math.exp(weight)
        for at, (_, j) in enumerate(pairs):
            if j >= 0:
                exact[min(at, 1), j] += math.exp(weight)
    assert abs(association._claims(clusters, options, 3) - exact / whole).max() < 0.15


def test_densities_that_are_alike_become_one_with_the_moments_of_both():
    crowd = people([[1, 1, 0, 0], [1.05, 1, 0, 0], [3, 3, 0, 0]], [0, 0, 1])
    mean, cov = gaussian.moments(crowd.mean, crowd.cov, crowd.mode)
    (merged,) = condensed([cluster({(0, 2): 0.75, (1, 2): 0.25})], crowd)
    assert merged.hypotheses == [(0, 2)]
    assert merged.shares == pytest.approx([1.0])
    got, spread = gaussian.moments(crowd.mean[[0]], crowd.cov[[0]], crowd.mode[[0]])
    expected = 0.75 * mean[0] + 0.25 * mean[1]
    np.testing.assert_allclose(got[0], expected)
    outer = sum(p * (cov[k] + np.outer(mean[k] - expected, mean[k] - expected)) for k, p in ((0, 0.75), (1, 0.25)))
    np.testing.assert_allclose(spread[0], outer)


def test_groups_that_are_merged_together_are_as_if_each_was_merged_alone():
    rng = np.random.default_rng(5)

    def crowd():
        states = np.random.default_rng(6).normal(size=(6, 4))
        return people(states, [0, 0, 1, 1, 1, 2])

    groups, shares = [[0, 1], [4, 2, 3]], [rng.random(2).tolist(), rng.random(3).tolist()]
    together, alone = crowd(), crowd()
    together.merge(groups, shares)
    for group, some in zip(groups, shares, strict=True):
        alone.merge([group], [some])
    for name in ("mean", "cov", "mode", "existence", "detectable", "lean"):
        np.testing.assert_allclose(getattr(together, name), getattr(alone, name), atol=1e-14)


@pytest.mark.parametrize("labels", [[0, 1], [0, 0]], ids=["two people", "two places"])
def test_two_people_and_places_far_apart_never_merge(labels):
    crowd = people([[1, 1, 0, 0], [1, 1, 0, 0] if labels[1] else [1.3, 1, 0, 0]], labels)
    rows = {(0, 1): 1.0} if labels[1] else {(0,): 0.5, (1,): 0.5}
    assert condensed([cluster(rows)], crowd)[0].hypotheses == list(rows)


def test_a_sensor_that_loses_everybody_at_once_is_taken_for_blind():
    blindness = Blindness(ever=True)

    def after(ratio):
        blindness.update(0.1, ratio)
        return blindness.probability

    assert after(100.0) < 0.01
    assert [after(0.01) for _ in range(7)][-1] > 0.9
    assert after(1e3) < 0.1
    never = Blindness(ever=False)
    for _ in range(8):
        never.update(0.1, 0.01)
    assert never.probability == 0.0


def test_what_one_person_says_of_blindness_can_be_left_out():
    blindness, others = Blindness(ever=True), Blindness(ever=True)
    for one in (blindness, others):
        one.update(1.0, 1e-4)
    blindness.update(0.1, 40.0 * 0.01)
    others.update(0.1, 0.01)
    assert blindness.without(40.0) == pytest.approx(others.probability)
    assert blindness.without(1.0) == pytest.approx(blindness.probability)


@pytest.mark.parametrize("metres", [0.5, 0.8])
def test_one_detection_while_nobody_else_is_found_is_hardly_the_person_beside_it(metres):
    """Three people stand; the sensor goes blind, and after 0.8 s something false appears beside one of them."""
    tracker = GLMB(Settings(learn=False), Population(((0.0, 0.0), (8.0, 6.0))), [sensor("video")])
    places = np.array([[2.0, 2.0], [5.0, 4.0], [6.0, 1.0]])
    for k in range(49):
        z = places if k < 40 else places[:1] + np.array([metres, 0.0]) if k == 48 else places[:0]
        tracker.update(k / 10, "video", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
        tracks = tracker.tracks(k / 10)
    assert tracks[0].existence < 0.9
    assert np.linalg.norm(tracks[0].state[:2] - places[0]) < 0.1


def test_who_is_found_first_when_a_sensor_sees_again_is_nobody_new():
    """Of three people one comes back after 0.8 s, 0.6 m off; the others stay hidden."""
    tracker = GLMB(Settings(), Population(((0.0, 0.0), (8.0, 6.0))), [sensor("video")])
    places = np.array([[2.0, 2.0], [5.0, 4.0], [6.0, 1.0]])
    for k in range(58):
        z = places if k < 40 else places[:0] if k < 48 else places[:1] + np.array([0.6, 0.0])
        tracker.update(k / 10, "video", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
    assert [track.label for track in tracker.tracks(5.7)] == [0]


def test_the_longer_a_sensor_finds_nobody_the_likelier_it_is_that_everybody_left():
    blindness, left = Blindness(ever=True), []
    for _ in range(200):
        blindness.update(0.1, 0.01)
        blindness.empty(0.1, 0.01)
        left.append(blindness.left)
    assert all(a <= b for a, b in pairwise(left))
    assert left[20] < 0.2
    assert left[199] > 0.95
    doors = Blindness(ever=True)
    while doors.probability < 0.5:
        doors.update(0.1, 0.01)
    doors.empty(0.1, 5.0)
    assert doors.left > 0.9  # where people leave within 0.2 s


def test_when_nobody_is_found_for_two_seconds_nobody_is_given_up():
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(1)
    for k in range(60):
        places = np.array([[1.5, 1.5], [3.0, 3.0]]) + 0.12 * rng.standard_normal((2, 2))
        z = places[:0] if 20 <= k < 42 else places
        tracker.update(k / 10, "video", z, np.tile(0.0144 * np.eye(2), (len(z), 1, 1)))
        assert [t.label for t in tracker.tracks(k / 10)] == [0, 1]


def test_who_meet_face_to_face_and_turn_back_keep_their_labels():
    kept = 0
    for seed in range(5):
        tracker = GLMB(Settings(), Population(), [sensor("video"), sensor("audio", MICROPHONES)])
        before = None
        for t, name, z, sigma, _ in scenes.turning_back(np.random.default_rng(seed)).records:
            tracker.update(t, name, z, np.tile(sigma**2 * np.eye(2), (len(z), 1, 1)))
            if before is None and t >= 1.0:
                before = [one.label for one in sorted(tracker.tracks(t), key=lambda one: one.state[0])]
        kept += before == [one.label for one in sorted(tracker.tracks(6.0), key=lambda one: one.state[0])]
    assert kept >= 4


@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize("n", [1, 3])
def test_one_person_found_twice_a_few_centimetres_apart_is_one_track(n, share):
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(3)
    for k in range(60):
        z = np.column_stack([np.full(n, 0.4 + 0.05 * k), 0.8 + 1.2 * np.arange(n)]) + 0.12 * rng.standard_normal((n, 2))
        again = (z + 0.03 + 0.02 * rng.standard_normal((n, 2)))[rng.random(n) < share]
        z = np.vstack([z, again])
        tracker.update(k / 10, "video", z, np.tile(0.0144 * np.eye(2), (len(z), 1, 1)))
        assert len(tracker.tracks(k / 10)) == n


def test_names_that_nothing_can_tell_apart_any_more_are_decided():
    here, there, near = [1, 1, 0.5, 0], [3, 3, 0, 0.5], [1.02, 1.01, 0.45, 0]
    crowd = people([here, there, there, near, [2, 2, 0, 0]], [0, 0, 1, 1, 1])
    either = cluster({(0, 2): 0.55, (1, 3): 0.35, (0, 4): 0.1})  # somebody at (2, 2) is another matter
    (one,) = decided([either], crowd)
    assert one.hypotheses == [(0, 2), (0, 4)]
    assert one.shares == pytest.approx([0.9, 0.1])
    crowd.detectable[3] = 0.5  # one speaks and the other does not: that may yet tell who is who
    assert decided([either], crowd)[0].hypotheses == [(0, 2), (1, 3), (0, 4)]


def test_who_came_back_is_one_person_though_nobody_knows_which_of_those_who_left():
    here, gone, elsewhere = [1, 1, 0.5, 0], [9, 9, 0, 0], [-7, 2, 0, 0]
    crowd = people([here, gone, elsewhere, here], [0, 0, 1, 1])
    crowd.existence[:] = [1.0, 0.001, 0.001, 1.0]
    either = cluster({(0, 2): 0.4, (1, 3): 0.6})  # two left, and one of them is back
    assert decided([either], crowd)[0].hypotheses == [(1, 3)]
    crowd.existence[1:3] = 0.3  # the other one may be there as well
    assert decided([either], crowd)[0].hypotheses == [(1, 3), (0, 2)]


@pytest.mark.parametrize("seed", range(4))
def test_one_of_three_who_left_together_is_shown_when_he_comes_back(seed):
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(seed)
    shown = 0
    for k in range(160):
        t = k / 10
        if t < 8:  # three walk to the wall x = 0, in a row
            places = np.column_stack([np.full(3, 0.3 + 0.5 * (8 - t)), 2.3 + 0.075 * (8 - t) * np.arange(-1, 2)])
        else:
            places = np.array([[0.3 + min(t - 10, 2.5), 2.3]]) if t >= 10 else np.zeros((0, 2))
        places = places[rng.random(len(places)) < 0.92]
        z = places + 0.1 * rng.standard_normal(places.shape)
        tracker.update(t, "video", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
        shown += t >= 11 and len(tracker.tracks(t)) == 1
    assert shown == 50


def camera(focal, **more):
    values = {"camera_position_m": [2.33, 2.33, 2.5], "lens_model": "kannala_brandt", "fx_px": focal, "fy_px": focal}
    values |= {"cx_px": 959.5, "cy_px": 539.5, "image_width_px": 1920, "image_height_px": 1080} | more
    return Config({"camera_config": values}).camera


def test_a_camera_sees_who_stands_below_it_and_not_the_corners_that_its_picture_cuts():
    room = ((0.0, 0.0), (4.66, 4.66))
    below, wall, corner = coverage.of_camera(camera(1000.0), room).at(np.array([[2.33, 2.33], [0.5, 2.33], [0.1, 0.1]]))
    assert below == 1.0
    assert corner == coverage.LEAST < wall <= 1.0
    assert min(coverage.of_camera(camera(150.0), room).at(np.array([[0.1, 0.1], [4.6, 4.6], [9.0, -3.0]]))) == 1.0


@given(st.floats(100.0, 1500.0), st.floats(1.0, 80.0), st.floats(0.3, 9.0), st.floats(0.3, 9.0))
@settings(max_examples=30, deadline=None)
def test_coverage_is_a_share_everywhere_and_a_longer_lens_sees_no_more(focal, valid, width, depth):
    room, places = ((0.0, 0.0), (width, depth)), np.random.default_rng(0).uniform(-1.0, 10.0, (50, 2))
    wide, long = (coverage.of_camera(camera(f, theta_max_valid_deg=valid), room).at(places) for f in (focal, 2 * focal))
    assert all(coverage.LEAST <= b <= a <= 1.0 for a, b in zip(wide, long, strict=True))


@pytest.mark.parametrize("side", [1e-3, 300.0, 1e6])
def test_the_coverage_of_a_hall_costs_no_more_than_that_of_a_room(side):
    seen = coverage.of_camera(camera(500.0), ((0.0, 0.0), (side, side / 2)))
    assert max(seen.share.shape) <= coverage.CELLS
    assert all(coverage.LEAST <= s <= 1.0 for s in seen.at(np.array([[0.0, 0.0], [side, side], [-1e300, 1e300]])))


@pytest.mark.parametrize("seen", [False, True])
def test_whoever_walks_where_the_camera_sees_nobody_is_kept_and_found_again(seen):
    share = np.ones((47, 47))
    share[30:] = coverage.LEAST  # nobody is found beyond x = 3 m
    one = sensor("video", coverage=None if seen else coverage.Coverage(np.zeros(2), coverage.STEP, share))
    tracker = GLMB(Settings(), Population(), [one])
    for k in range(80):
        x = 1.0 + 0.1 * min(k, 25) - 0.1 * max(k - 50, 0)
        z = np.array([[x, 0.5]] if x < 3.0 else []).reshape(-1, 2)
        tracker.update(k / 10, "video", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
        if k == 32:
            assert bool(tracker.tracks(k / 10)) != seen
    assert len(tracker.tracks(7.9)) == 1


def test_near_its_border_a_field_is_between_seen_and_unseen():
    share = np.ones((60, 60))
    share[30:] = coverage.LEAST  # nobody is found beyond x = 3 m
    field = coverage.Coverage(np.zeros(2), coverage.STEP, share)
    places = np.array([[[1.0, 1.0], [2.85, 1.0], [3.05, 1.0]], [[3.2, 1.0], [4.0, 1.0], [9.0, -1.0]]])
    assert field.about(places) == pytest.approx(np.array([[1, 5 / 6, 1 / 6], [1 / 6, 0, 0]]), abs=coverage.LEAST)
    assert field.about(places[0, 0]) == pytest.approx(1.0)


def test_who_is_where_no_detection_is_used_has_left():
    states = np.array([[-0.6, 2.0, 0.0, 0.0], [2.0, 4.6, 0.0, 0.0], [-0.4, 2.0, 0.0, 0.0], [-30.0, 2.0, 0.0, 0.0]])
    known, unknown = Population.of(Settings(), (4.0, 4.0)), Population.of(Settings())
    assert known.leaving(states)[[0, 1, 3]].min() > 100 * known.leaving(states)[2]
    assert unknown.leaving(states).max() < 0.1, "nobody knows where the walls are"
    assert Population.of(Settings(room_margin=1.0), (4.0, 4.0)).leaving(states)[:3].max() < 0.1


def test_who_stands_at_a_wall_leaves_less_readily_than_who_walks_there():
    states = np.array([[0.3, 2.3, 0.0, 0.0], [0.3, 2.3, 0.0, -1.0], [2.3, 2.3, 0.0, 0.0], [2.3, 2.3, 1.0, 0.0]])
    still, walks, amid, through = Population(stay=100.0, pass_by=10.0).leaving(states)
    assert walks == pytest.approx(0.1)
    assert still == amid == through == pytest.approx(0.01)


def test_existence_is_at_most_one_where_the_shares_add_up_to_more_by_rounding():
    several = cluster({(0,): 0.3, (1,): 0.1, (2,): 0.6})
    several.shares = [0.3, 0.1, 0.6000000000000002]
    certain = np.ones(3)
    assert several.existences(certain) == [1.0]
    assert several.marginals(0, certain)[1] == 1.0
