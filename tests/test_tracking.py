"""The tracker over arrays: known answers, properties, and what must not break it."""

import dataclasses
import doctest
import importlib
import itertools
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from avcli.formats.records import Detections
from avcli.formats.sensors import MICROPHONES
from avcli.tracking import association, gaussian
from avcli.tracking.association import ranked
from avcli.tracking.fusion import Fusion, noise_of
from avcli.tracking.glmb import GLMB
from avcli.tracking.model import Population
from avcli.tracking.motion import FITTED, WALKING, Model, Motion
from avcli.tracking.settings import Sensor, Settings, sensor
from avcli.tracking.smoothing import Delayed, backwards

sys.path.insert(0, str(Path(__file__).parent / "bench"))
import fit_tracking
import tracking_scenes as scenes

SURE = Sensor("video", detection=0.9, clutter=0.01, sigma=(0.15, 0.15), hide=0.0)
WHITE = dataclasses.replace(SURE, floor=0.0, bias_sd=0.0, offset_sd=0.0)  # noise alone, without bias and lasting error
CV = Motion((Model(0.5),))


def look(rng, places, sigma=0.12):
    """Detections of people at places (n, 2), as the tracker takes them."""
    z = np.reshape(places, (-1, 2)) + sigma * rng.standard_normal((len(places), 2))
    return z, np.tile(sigma**2 * np.eye(2), (len(z), 1, 1))


def detections(time, z, sigma=0.12):
    """Detections as records give them."""
    n = len(z)
    positions = np.column_stack([np.reshape(z, (n, 2)), np.full(n, np.nan)])
    return Detections(time, "video", positions, np.tile(sigma**2 * np.eye(3), (n, 1, 1)), np.full(n, np.nan))


def walkers(t, n):
    """Places of n people abreast, walking along x at 1 m/s."""
    return np.column_stack([np.full(n, 0.4 + t), 0.8 + 1.2 * np.arange(n)])


def follow(tracker, n=1, frames=40, seed=0, name="video", detection=1.0, shift=0.0, turn=None):
    """Feed a tracker with n walkers; the tracks of every frame."""
    rng, out = np.random.default_rng(seed), []
    for k in range(frames):
        z, noise = look(rng, walkers(k / 10, n))
        seen = rng.random(n) < detection
        z = z + shift if turn is None else z @ turn.T + shift
        tracker.update(k / 10, name, z[seen], noise[seen])
        out.append(tracker.tracks(k / 10))
    return out


# --- Gaussians --------------------------------------------------------------------------------------------------------


def test_one_track_and_one_sensor_are_the_textbook_filter():
    rng = np.random.default_rng(0)
    f, q = (np.array(a)[0] for a in CV.step(0.1)[:2])
    h, r = np.eye(2, 4), 0.12**2 * np.eye(2)
    x, p = np.array([1.0, 2.0, 0.0, 0.0]), np.diag([0.1, 0.1, 0.5, 0.5])
    mean, cov, mode = x[None, None].copy(), p[None, None].copy(), np.ones((1, 1))
    for _ in range(50):
        z = rng.normal([1.0, 2.0], 0.12)
        x, p = f @ x, f @ p @ f.T + q
        s = h @ p @ h.T + r
        gain = p @ h.T @ np.linalg.inv(s)
        x, p = x + gain @ (z - h @ x), (np.eye(4) - gain @ h) @ p
        mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, CV, 0.1)
        log, _ = gaussian.loglikelihood(gaussian.innovation(mean, cov), z[None], r[None])
        d = z - mean[0, 0, :2]
        expected = -0.5 * (d @ np.linalg.inv(s) @ d + np.log(np.linalg.det(2 * np.pi * s)))
        assert log[0, 0, 0] == pytest.approx(expected, abs=1e-10)
        mean, cov, mode = gaussian.update(mean, cov, mode, z[None], r[None])
        np.testing.assert_allclose(mean[0, 0], x, atol=1e-12)
        np.testing.assert_allclose(cov[0, 0], p, atol=1e-12)


def test_after_many_frames_the_covariance_is_the_riccati_solution():
    tracker = GLMB(Settings(learn=False), Population(motion=CV), [WHITE])
    noise = 0.12**2 * np.eye(2)[None]
    for k in range(3000):
        tracker.update(k / 10, "video", np.array([[2.0, 2.0]]), noise)
    cov = tracker.people.cov[tracker.labelled()[0][1], 0]
    f, q = (np.array(a)[0] for a in CV.step(0.1)[:2])
    h, p = np.eye(2, 4), np.eye(4)
    for _ in range(3000):
        p = f @ p @ f.T + q
        p = p - p @ h.T @ np.linalg.inv(h @ p @ h.T + noise[0]) @ h @ p
    np.testing.assert_allclose(cov, p, atol=1e-9)
    assert np.abs(cov - cov.T).max() < 1e-12
    assert np.linalg.eigvalsh(cov).min() > 0


@pytest.mark.slow
def test_a_hundred_thousand_steps_keep_the_covariance_sound():
    mean, cov, mode = np.zeros((1, 1, 4)), np.eye(4)[None, None], np.ones((1, 1))
    for _ in range(100_000):
        mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, CV, 0.1)
        mean, cov, mode = gaussian.update(mean, cov, mode, np.zeros((1, 2)), 0.01 * np.eye(2)[None])
    assert np.abs(cov - cov.swapaxes(-1, -2)).max() < 1e-12
    assert np.linalg.eigvalsh(cov[0, 0]).min() > 0


@given(st.floats(1e-4, 100), st.floats(1e-3, 100), st.floats(0.05, 5))
@settings(max_examples=60, deadline=None)
def test_two_steps_are_one_of_their_sum(dt, memory, noise):
    f, q = Model(noise, memory).step(dt)
    ff, qq = Model(noise, memory).step(2 * dt)
    np.testing.assert_allclose(f @ f, ff, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(f @ q @ f.T + q, qq, rtol=2e-5, atol=1e-9 * np.abs(qq).max())


@pytest.mark.parametrize("dt", [1e-6, 0.04, 0.1, 10.0, 1e4])
def test_switching_probabilities_are_probabilities(dt):
    _, _, switch = WALKING.step(dt)
    np.testing.assert_allclose(switch.sum(1), 1)
    assert (switch > 0).all()
    np.testing.assert_allclose(WALKING.stationary() @ switch, WALKING.stationary(), atol=1e-9)


@pytest.mark.parametrize("dt", [1e-9, 0.1, 3600.0, 1e6])
def test_a_prediction_over_any_time_is_a_density(dt):
    z, noise = np.array([[1e6, -1e6]]), 0.0144 * np.eye(2)[None]
    state = gaussian.begin(z, noise, WALKING)
    mean, cov, mode, *_ = gaussian.predict(*state, WALKING, dt)
    np.testing.assert_allclose(mode.sum(1), 1)
    np.testing.assert_allclose(mean[..., :2], np.tile(z, (1, len(WALKING.models), 1)), rtol=1e-9)
    np.testing.assert_array_equal(cov, cov.swapaxes(-1, -2))
    assert np.linalg.eigvalsh(cov).min() > 0
    assert np.isfinite(cov).all()


def test_a_new_person_moves_as_the_models_do_in_the_long_run():
    models = (Model(0.1, start=2.0), Model(3.0, memory=0.5, start=None))
    motion = Motion(models, ((0.0, 1.0), (3.0, 0.0)))
    mean, cov, mode = gaussian.begin(np.array([[1.0, 2.0]]), 0.01 * np.eye(2)[None], motion)
    np.testing.assert_allclose(mode, [[0.75, 0.25]])
    np.testing.assert_allclose(mean[0], [[1, 2, 0, 0]] * 2)
    np.testing.assert_allclose(cov[0].diagonal(axis1=1, axis2=2), [[0.01, 0.01, 4, 4], [0.01, 0.01, 2.25, 2.25]])
    later = Motion(models[1:]).step(50.0)
    np.testing.assert_allclose(
        (later[0] @ cov[:, 1:] @ later[0].swapaxes(1, 2) + later[1])[0, 0, 2:, 2:], 2.25 * np.eye(2)
    )


def test_who_runs_at_five_metres_a_second_is_one_track():
    rng = np.random.default_rng(0)
    tracker = GLMB(Settings(), Population(area=((0.0, 0.0), (20.0, 20.0))), [SURE])
    for k in range(36):
        tracker.update(k / 10, "video", *look(rng, [[1 + 0.5 * k, 10.0]]))
        if k > 2:
            (track,) = tracker.tracks(k / 10)
            assert track.label == 0
            assert np.hypot(*(track.state[:2] - [1 + 0.5 * k, 10])) < 0.4
    assert track.state[2] == pytest.approx(5.0, abs=0.5)


@pytest.mark.slow
def test_two_who_sit_beside_each_other_for_an_hour_stay_who_they_are():
    rng, seats = np.random.default_rng(0), np.array([[2.0, 2.3], [2.45, 2.3]])
    tracker = GLMB(Settings(), Population(), [sensor("video")])
    for second in range(3600):
        z, noise = look(rng, seats)
        found = rng.random(2) < 0.9
        tracker.update(float(second), "video", z[found], noise[found])
        if second == 10:
            labels = [track.label for track in tracker.tracks(10.0)]
    tracks = tracker.tracks(3600.0)
    assert len(labels) == 2
    assert [track.label for track in tracks] == labels
    order = np.array([track.state[0] for track in tracks]).argsort()
    errors = np.array([track.state[:2] for track in tracks])[order] - seats
    assert abs(errors).max() < 0.25
    spread = [math.sqrt(track.cov[0, 0]) for track in tracks]
    assert 0.03 < min(spread) <= max(spread) < 0.5  # the last record may have missed one


def test_innovations_are_as_large_as_the_filter_says():
    rng, squares = np.random.default_rng(1), []
    for _ in range(60):
        x = np.array([2.0, 2.0, *rng.normal(0, 0.7, 2)])
        mean, mode = np.zeros((1, 1, 4)), np.ones((1, 1))
        mean[..., :2] = x[:2] + rng.normal(0, 0.12, 2)
        cov = np.diag([0.12**2, 0.12**2, 0.49, 0.49])[None, None]
        f, q = (np.array(a)[0] for a in CV.step(0.1)[:2])
        for _ in range(30):
            x = f @ x + rng.multivariate_normal(np.zeros(4), q)
            z = x[:2] + rng.normal(0, 0.12, 2)
            mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, CV, 0.1)
            expected = gaussian.innovation(mean, cov)
            squares.append(gaussian.loglikelihood(expected, z[None], 0.12**2 * np.eye(2)[None])[1][0, 0, 0])
            mean, cov, mode = gaussian.update(mean, cov, mode, z[None], 0.12**2 * np.eye(2)[None])
    assert np.mean(squares) == pytest.approx(2.0, abs=4 * 2 / math.sqrt(len(squares)))


@pytest.mark.parametrize("name", ["association", "fusion", "gaussian", "glmb", "motion"])
def test_the_examples_of_docstrings_run(name):
    module = importlib.import_module(f"avcli.tracking.{name}")
    result = doctest.testmod(module)
    assert result.attempted
    assert not result.failed


def test_the_fitted_motion_has_the_loss_that_its_file_states():
    stated = json.loads(FITTED.read_text())
    assert Motion.of(stated["motion"]) == WALKING
    first, last = stated["check"]["seeds"]
    people = fit_tracking.simulated(first, last - first + 1)
    assert fit_tracking.loss(WALKING, people) == pytest.approx(stated["check"]["loss"], abs=1e-6)
    for noise in (0.1, 0.25, 0.5):
        assert fit_tracking.loss(Motion((Model(noise),)), people) > stated["check"]["loss"] + 0.2


def test_a_fit_lowers_the_loss_and_keeps_what_is_not_a_number():
    described = json.loads(FITTED.read_text())["motion"]
    people = {
        kind: z for kind, z in fit_tracking.simulated(fit_tracking.TRAIN, 2).items() if kind in ("strolls", "sits")
    }
    numbers = fit_tracking.parameters(described)
    assert fit_tracking.with_parameters(described, numbers) == described
    wrong = fit_tracking.with_parameters(described, numbers * np.resize([1.35, 0.74], len(numbers)))
    found = fit_tracking.fit(wrong, people, 1)
    assert fit_tracking.loss(Motion.of(found), people) < fit_tracking.loss(Motion.of(wrong), people)
    assert found["stand"] == described["stand"]


# --- assignment -------------------------------------------------------------------------------------------------------


def brute_force(priors, options):
    """All feasible joint associations."""
    found = []
    for number, (weight, row) in enumerate(priors):
        for picks in itertools.product(*(options[leaf] if leaf >= 0 else [(0.0, -1)] for leaf in row)):
            used = [j for _, j in picks if j >= 0]
            if len(used) == len(set(used)):
                found.append((weight + sum(gain for gain, _ in picks), number, tuple(j for _, j in picks)))
    return sorted(found, reverse=True)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=80, deadline=None)
def test_ranked_associations_are_those_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    options = {
        leaf: sorted([(-rng.exponential(2), -1), *((rng.normal(0, 3), j) for j in range(3) if rng.random() < 0.7)])[
            ::-1
        ]
        for leaf in range(6)
    }
    priors = [(-rng.exponential(), tuple(rng.integers(-1, 6, 3).tolist())) for _ in range(3)]
    expected = brute_force(priors, options)
    got = ranked(priors, options, 10_000, 7.0)
    inside = [e for e in expected if e[0] > expected[0][0] - 7.0]
    kept = [g for g in got if g[0] > expected[0][0] - 7.0]
    assert len(kept) == len(inside)
    for a, b in zip(sorted(kept, reverse=True), inside, strict=True):
        assert a[0] == pytest.approx(b[0], abs=1e-9)
    few = ranked(priors, options, 1, 7.0)
    assert few
    assert few[0][0] <= expected[0][0] + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_in_a_pressed_crowd_the_best_association_is_found_with_a_small_budget(seed):
    """Without prices the search kept what most people wanted most, and ended 10 nats and more below the best."""
    rng = np.random.default_rng(seed)
    places = 0.3 * np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2)
    z = (places + rng.normal(0, 0.12, places.shape))[rng.random(len(places)) < 0.9]
    gains = 5 - np.square(places[:, None] - z).sum(2) / (2 * 0.15**2)
    options = {
        row: sorted([(-2.3, -1), *((one, j) for j, one in enumerate(some) if one > -4)], reverse=True)
        for row, some in enumerate(gains.tolist())
    }
    cost = np.hstack([np.where(gains > -4, -gains, 1e3), np.full((64, 64), 2.3)])
    best = -cost[linear_sum_assignment(cost)].sum()
    found = ranked([(0.0, tuple(range(64))), (-1.0, tuple(range(64)))], options, 100, 7.0, 30)
    assert best - 64 * association.BID < found[0][0] < best + 1e-9
    assert all(len({j for _, j in pairs if j >= 0}) == used.bit_count() for _, pairs, used in found)


# --- the filter -------------------------------------------------------------------------------------------------------


def test_three_walkers_have_three_labels_from_the_first_frame():
    frames = follow(GLMB(Settings(), Population(), [sensor("video")]), 3)
    assert [[t.label for t in tracks] for tracks in frames] == [[0, 1, 2]] * 40
    for t, place in zip(sorted(frames[-1], key=lambda t: t.state[1]), walkers(3.9, 3), strict=True):
        assert np.abs(t.state[:2] - place).max() < 0.3
        assert np.abs(t.state[2:] - [1, 0]).max() < 0.4
        assert np.linalg.eigvalsh(t.cov).min() > 0


@pytest.mark.parametrize(
    ("turn", "shift"),
    [
        (np.eye(2), [3.0, -2.0]),
        (np.array([[0.0, -1.0], [1.0, 0.0]]), [6.0, 0.0]),
        (np.array([[1.0, 0.0], [0.0, -1.0]]), [0.0, 6.0]),
        (np.eye(2), [1e6, 1e6]),
    ],
    ids=["shifted", "turned", "mirrored", "far away"],
)
def test_tracks_move_with_the_room(turn, shift):
    corners = np.array([[0.0, 0.0], [6.0, 6.0]]) @ turn.T + shift
    area = (tuple(corners.min(0)), tuple(corners.max(0)))
    one = follow(GLMB(Settings(), Population(area=((0.0, 0.0), (6.0, 6.0))), [SURE]), 3)
    two = follow(GLMB(Settings(), Population(area=area), [SURE]), 3, turn=turn, shift=np.array(shift))
    for tracks, moved in zip(one, two, strict=True):
        places = np.array([t.state[:2] for t in tracks]) @ turn.T + shift
        others = np.array([t.state[:2] for t in moved])
        assert places.shape == others.shape
        np.testing.assert_allclose(np.sort(places, 0), np.sort(others, 0), atol=1e-6)


def test_a_sensor_that_finds_nothing_changes_nothing():
    rng = np.random.default_rng(3)
    blind = Sensor("blind", detection=0.0, clutter=0.0)
    one, two = (GLMB(Settings(learn=False), Population(), some) for some in ([SURE], [SURE, blind]))
    for k in range(20):
        z, noise = look(rng, walkers(k / 10, 2))
        for tracker in (one, two):
            tracker.update(k / 10, "video", z, noise)
        two.update(k / 10, "blind", np.zeros((0, 2)), np.zeros((0, 2, 2)))
        for a, b in zip(one.tracks(k / 10), two.tracks(k / 10), strict=True):
            np.testing.assert_allclose(a.state, b.state, atol=1e-9)
            assert a.existence == pytest.approx(b.existence, abs=1e-9)


def test_silence_costs_no_existence_and_is_told():
    tracker, rng = (
        GLMB(Settings(), Population(), [sensor("video"), sensor("audio", MICROPHONES)]),
        np.random.default_rng(4),
    )
    for k in range(60):
        z, noise = look(rng, [[2.3, 2.3]])
        tracker.update(k / 10, "video", z, noise)
        heard = k < 30
        tracker.update(k / 10, "audio", z[: int(heard)], noise[: int(heard)])
        (track,) = tracker.tracks(k / 10)
        assert track.existence > 0.9 or k < 2
        if k in (29, 59):
            assert (track.detectable["audio"] > 0.5) == heard


def test_who_is_hidden_amid_the_room_is_kept_and_who_left_is_not():
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(5)
    for k in range(130):
        z, noise = look(rng, [[1.0 + 0.05 * k, 2.3]] if k < 20 or 32 <= k < 60 else [])
        tracker.update(k / 10, "video", z, noise)
        tracks = tracker.tracks(k / 10)
        if k < 60:
            assert [t.label for t in tracks] == [0]
    assert not tracks


def test_doubled_detections_make_no_second_person():
    rng, tracker = np.random.default_rng(6), GLMB(Settings(), Population(), [sensor("video")])
    for k in range(40):
        z, noise = look(rng, walkers(k / 10, 3))
        tracker.update(k / 10, "video", np.vstack([z, z]), np.concatenate([noise, noise]))
        assert len(tracker.tracks(k / 10)) == 3


@pytest.mark.parametrize("away", [(1.0, 0.0), (0.0, -0.8)])
def test_a_detection_that_lies_far_off_is_the_persons_and_makes_no_other(away):
    rng, tracker, journal = (
        np.random.default_rng(7),
        GLMB(Settings(), Population(), [sensor("video")], explain=True),
        [],
    )
    for k in range(40):
        z, noise = look(rng, walkers(k / 10, 2), sigma=0.03)
        stray = k % 10 == 5
        z[0] += stray * np.array(away)
        tracker.update(k / 10, "video", z, noise)
        tracks = sorted(tracker.tracks(k / 10), key=lambda one: one.state[1])
        assert sorted(one.label for one in tracks) == [0, 1]
        np.testing.assert_allclose([one.state[:2] for one in tracks], walkers(k / 10, 2), atol=0.1)
        assert (tracks[0].last_seen < k / 10) == stray, "the position is a prediction"
        journal += tracker.accounts()
    assert journal[-1]["expected_clutter"] < 0.05, "it is no clutter"
    assert sorted(one["most_likely"] for one in journal[35]["people"]) == [0, 1]


@pytest.mark.parametrize("detection", [0.0, 1.0])
@pytest.mark.parametrize("clutter", [0.0, 100.0])
@pytest.mark.parametrize("sigma", [1e-6, 1e6])
@pytest.mark.parametrize("adapt", [False, True])
def test_extreme_parameters_give_finite_answers(detection, clutter, sigma, adapt):
    extreme = Sensor("video", detection=detection, clutter=clutter, sigma=(sigma, sigma))
    tracker, rng = (
        GLMB(Settings(learn=adapt), Population(stay=math.inf, pass_by=math.inf), [extreme]),
        np.random.default_rng(7),
    )
    for k in range(15):
        z = walkers(k / 10, 3) + 0.1 * rng.standard_normal((3, 2))
        noise = noise_of(np.full((3, 2, 2), np.nan), (sigma, sigma), 0.05, tracker.population.area)
        tracker.update(k / 10, "video", z, noise)
        for track in tracker.tracks(k / 10):
            assert np.isfinite(track.state).all()
            assert np.isfinite(track.cov).all()
            assert 0 <= track.existence <= 1


def test_a_covariance_of_zeros_alone_is_none():
    stated = np.array([np.zeros((2, 2)), np.full((2, 2), np.nan), [[0.04, 0], [0, 0]]])
    zeros, unknown, only_x = noise_of(stated, (0.2, 0.3), 0.0, ((0.0, 0.0), (4.0, 4.0)))
    np.testing.assert_allclose(zeros, np.diag([0.04, 0.09]))
    np.testing.assert_array_equal(zeros, unknown)
    assert only_x[0, 0] == pytest.approx(0.04)
    assert only_x[1, 1] > 1


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 10.0, 1e12])
def test_any_scale_of_the_covariances_keeps_one_track(scale):
    fusion, rng, labels = Fusion(Settings()), np.random.default_rng(8), set()
    for k in range(30):
        z = walkers(k / 10, 1) + 0.1 * rng.standard_normal((1, 2))
        found = detections(k / 10, z)
        found = Detections(found.timestamp, "video", found.positions, found.covariances * scale, found.scores)
        for tracks in fusion.step(k / 10, [(k / 10, "video", found)]):
            labels |= set(tracks.ids.tolist())
            assert np.isfinite(tracks.positions).all()
            assert np.isfinite(tracks.velocities).all()
    assert labels == {0} or scale > 10


def assert_bounded(tracker, most):
    """The filter keeps no more hypotheses than it may, and no more than so many densities."""
    assert all(len(cluster.hypotheses) <= tracker.settings.hypotheses for cluster in tracker.clusters)
    assert len(tracker.people) <= most


def test_a_burst_of_detections_leaves_bounded_work():
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(9)
    for k in range(6):
        z = rng.uniform(0, 4.66, (200, 2)) if k % 2 else walkers(k / 10, 3)
        tracker.update(k / 10, "video", z, np.tile(0.02 * np.eye(2), (len(z), 1, 1)))
        assert_bounded(tracker, 600)


def test_a_dense_crowd_leaves_bounded_work():
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(10)
    crowd = 2.0 + 0.25 * np.array(list(itertools.product(range(4), range(3))))
    for k in range(15):
        z, noise = look(rng, crowd)
        tracker.update(k / 10, "video", z, noise)
        assert_bounded(tracker, 600)
    assert 8 <= len(tracker.tracks(1.5)) <= 16


def test_irregular_and_huge_time_steps():
    tracker, rng, t = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(11), 0.0
    for dt in (0.1, 0.0, 1e-9, 0.04, 0.3, -0.2, 0.1, 10.0, 0.1, 1e5, 0.1):
        t += dt
        z, noise = look(rng, [[2.0, 2.0]])
        tracker.update(t, "video", z, noise)
        for track in tracker.tracks(t):
            assert np.isfinite(track.state).all()
            assert np.linalg.eigvalsh(track.cov).min() > 0


def test_memory_does_not_grow_online():
    def size(tracker):
        reach, node_count = [n for n in tracker.people.node if n is not None], 0
        while reach:
            node_count += 1
            reach = [n.prev for n in reach if n.prev is not None]
        return len(tracker.people), node_count, len(tracker.retired), len(tracker.died)

    for lag in (0, 5):
        tracker, rng, sizes = (
            GLMB(Settings(), Population(), [sensor("video")], record=lag > 0),
            np.random.default_rng(12),
            [],
        )
        delayed = Delayed(tracker, lag)
        for k in range(600):
            z = np.vstack([look(rng, [[2.0 + math.sin(k / 30), 2.0]])[0], rng.uniform(0, 4.66, (rng.poisson(0.5), 2))])
            tracker.update(k / 10, "video", z, np.tile(0.02 * np.eye(2), (len(z), 1, 1)))
            delayed.push(k / 10) if lag else tracker.tracks(k / 10)
            sizes.append(size(tracker))
        assert np.max(sizes[300:], 0).max() <= 2 * max(np.max(sizes[50:300], 0).max(), 20)


# --- smoothing --------------------------------------------------------------------------------------------------------


def test_smoothed_covariances_are_no_larger_and_the_newest_state_is_the_filtered_one():
    tracker = GLMB(Settings(), Population(motion=CV), [WHITE], record=True)
    follow(tracker, 1)
    (end,) = tracker.ends()
    history = list(backwards(end.node, end.mean, end.cov, 1.0))
    assert len(history) == 40
    np.testing.assert_array_equal(history[0][1], tracker.tracks(3.9)[0].state)
    for node, _, smoothed, exist in history[1:]:
        assert np.linalg.eigvalsh(node.cov - smoothed).min() > -1e-9
        assert exist > 0.99


def test_one_number_is_given_once_where_who_is_recognised_came_before_that_person_was_given_up():
    tracker = GLMB(Settings(), Population(motion=CV), [WHITE], record=True)
    follow(tracker, 1)
    (end,) = tracker.ends()
    tracker.retired[end.label] = end._replace(mean=end.mean + 1.0, meant=0.9)
    for time, found in Delayed(tracker, math.inf)._collect([3.8, 3.9]):
        (one,) = found
        assert one.label == end.label
        assert one.state == pytest.approx(tracker.tracks(3.9)[0].state, abs=0.2), time


def test_lag_zero_is_the_filter_and_all_lags_end_alike():
    scene = scenes.s2(np.random.default_rng(1))
    runs = {lag: track(scene, lag=lag) for lag in (0, 3, math.inf)}
    assert len(runs[0]) == len(runs[3]) == len(runs[math.inf]) == 41
    online, offline = runs[0][-1], runs[math.inf][-1]
    assert online.ids.tolist() == offline.ids.tolist()
    np.testing.assert_allclose(online.positions, offline.positions, atol=1e-9)


def track(scene, lag=0, tracker="ms-glmb"):
    """Run a scene through Fusion: a list of Identified."""
    fusion, out, queue = Fusion(tracker=tracker, lag=lag, population=Population()), [], list(scene.records)
    for t, _, _ in scene.truth:
        due = []
        while queue and queue[0][0] <= t + 1e-9:
            at, name, z, sigma, _ = queue.pop(0)
            floor = sensor(name, scenes.KIND[name]).floor
            found = detections(at, z, math.sqrt(max(sigma**2 - floor**2, 1e-6)))
            due.append((at, name, dataclasses.replace(found, sensor=name, kind=scenes.KIND[name])))
        out += fusion.step(t, due)
    return out + fusion.finish()


def error(scene, out):
    """Mean distance of tracks to the nearest person and of people to the nearest track (5 m: none), m."""
    away = []
    for (_, _, xy), tracks in zip(scene.truth, out, strict=True):
        positions = tracks.positions[:, :2]
        distance = np.linalg.norm(xy[:, None] - positions, axis=-1) if len(tracks) else np.full((len(xy), 1), 5.0)
        away += [distance.min(0).mean(), distance.min(1).mean()]
    return float(np.mean(away))


@pytest.mark.parametrize("name", ["s1", "s2", "s3", "s4", "asynchronous", "damaged"])
def test_scenes_are_followed_and_smoothing_helps(name):
    make = {**scenes.EASY, **scenes.HARD}[name]
    scene = make(np.random.default_rng(2))
    online, offline = error(scene, track(scene)), error(scene, track(scene, math.inf))
    assert online < 0.15
    assert offline < online


@pytest.mark.parametrize("tracker", ["lmb", "gnn"])
def test_baselines_follow_people_who_keep_apart(tracker):
    scene = scenes.s3(np.random.default_rng(2))
    assert error(scene, track(scene, tracker=tracker)) < 0.3


def test_crossing_paths_keep_their_labels():
    kept = 0
    for seed in range(4):
        scene = scenes.crossing(np.random.default_rng(seed))
        out = track(scene)

        def nearest(k, out=out, scene=scene):
            apart = np.linalg.norm(scene.truth[k][2][:, None] - out[k].positions[:, :2], axis=-1)
            return out[k].ids[apart.argmin(1)].tolist()

        kept += nearest(10) == nearest(-1)
    assert kept >= 3
