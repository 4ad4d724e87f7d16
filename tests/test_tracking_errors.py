"""What is learnt of sensors' errors: the scale of their noise, their bias, and what lasts."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats.records import Detections
from avcli.formats.sensors import CAMERA, MICROPHONES
from avcli.tracking import gaussian
from avcli.tracking.errors import LEAST, MOST, WHITE, Errors, followed, leaning
from avcli.tracking.fusion import Fusion
from avcli.tracking.glmb import GLMB
from avcli.tracking.model import Population
from avcli.tracking.motion import Model, Motion
from avcli.tracking.settings import Sensor, Settings, sensor

EYE, ARM = Sensor("eye"), Sensor("arm")
STILL = Population(motion=Motion((Model(0.01),)))
ALWAYS = {"detection": 0.99, "clutter": 0.001, "hide": 0.0}


def person(seed, seconds, **sensors):
    """Track somebody who stands at (2, 2); sensors: name -> (Sensor, told sigma, sigma, bias (2,))."""
    rng = np.random.default_rng(seed)
    tracker = GLMB(Settings(), STILL, [dataclasses.replace(one[0], name=name) for name, one in sensors.items()])
    for k in range(round(10 * seconds)):
        for name, (one, told, sigma, bias) in sensors.items():
            z = np.array([[2.0, 2.0]]) + bias + sigma * rng.standard_normal((1, 2))
            tracker.update(k / 10, name, z, (told**2 + one.floor**2) * np.eye(2)[None])
    return tracker


@pytest.mark.parametrize("scale", [0.5, 1.0, 4.0])
def test_the_scale_of_the_noise_is_learnt(scale):
    exact = Sensor("", floor=0.0, bias_sd=0.0, offset_sd=0.0, **ALWAYS)
    tracker = person(1, 60.0, eye=(exact, 0.1, 0.1 * scale, np.zeros(2)))
    assert tracker.errors.factor[0, 0] == pytest.approx(scale**2, rel=0.3)
    assert len(tracker.tracks(60.0)) == 1


def test_without_learning_nothing_is_learnt():
    tracker = GLMB(Settings(learn=False), STILL, [EYE, ARM])
    before = [tracker.errors.described(k) for k in (0, 1)]
    for k in range(100):
        tracker.update(k / 10, "eye", np.array([[2.0, 2.0]]), 0.01 * np.eye(2)[None])
        tracker.update(k / 10, "arm", np.array([[2.1, 2.0]]), 0.01 * np.eye(2)[None])
    assert [tracker.errors.described(k) for k in (0, 1)] == before


def test_a_covariance_that_says_a_quarter_of_the_error_keeps_one_track():
    sensor = dataclasses.replace(EYE, **ALWAYS)
    tracker = person(2, 20.0, eye=(sensor, 0.05, 0.2, np.zeros(2)))
    (track,) = tracker.tracks(20.0)
    assert tracker.next_label <= 2, "a second track at most while the noise was not known"
    off = track.state[:2] - 2.0
    assert off @ np.linalg.solve(track.cov[:2, :2], off) < 14


def test_the_bias_between_two_sensors_is_learnt_and_goes_to_the_vaguer_one():
    exact, vague = dataclasses.replace(EYE, **ALWAYS), dataclasses.replace(EYE, **ALWAYS, bias_sd=0.1)
    shift = np.array([0.15, -0.1])
    tracker = person(3, 60.0, eye=(exact, 0.05, 0.05, np.zeros(2)), arm=(vague, 0.05, 0.05, shift))
    bias, sd = tracker.errors.bias[:, :2], tracker.errors.bias_sd[:, :2]
    np.testing.assert_allclose(bias[1] - bias[0], shift, atol=0.05)
    assert (abs(bias[1]) > 5 * abs(bias[0])).all()
    assert (sd[0] > 0.7 * exact.bias_sd).all(), "a bias that both have cannot be known"
    assert (tracker.errors.lasting < np.square([exact.floor, 0.1])).all()


def test_one_sensor_alone_says_nothing_of_its_bias():
    tracker = person(4, 20.0, eye=(dataclasses.replace(EYE, **ALWAYS), 0.1, 0.1, np.array([0.3, 0.0])))
    assert not tracker.errors.bias.any()
    assert tracker.tracks(20.0)[0].cov[0, 0] > 0.9 * EYE.floor**2, "what lasts does not average away"


def test_lasting_errors_are_weighted_by_their_variance_in_the_long_run():
    """Two sensors with constant errors of 0.05 and 0.1 m: weights 0.8 and 0.2, however many detections."""
    constant = {**ALWAYS, "memory": 1e9, "bias_sd": 0.0, "offset_sd": 0.0}
    eye, ear = Sensor("", floor=0.05, **constant), Sensor("", floor=0.1, **constant)
    tracker = GLMB(Settings(learn=False), STILL, [dataclasses.replace(eye, name="eye")])
    tracker.add(dataclasses.replace(ear, name="ear"))
    for k in range(200):
        for name, x in (("eye", 2.0), ("ear", 2.1)):
            tracker.update(k / 10, name, np.array([[x, 2.0]]), 0.05**2 * np.eye(2)[None])
    (track,) = tracker.tracks(20.0)
    assert track.state[0] == pytest.approx(2.02, abs=0.004)
    assert track.cov[0, 0] == pytest.approx(0.8 * 0.05**2, rel=0.3)


def test_fusion_with_errors_that_last_is_better_than_each_sensor():
    rng, squares = np.random.default_rng(5), {"eye": [], "ear": [], "both": []}
    kinds = {"eye": Sensor("eye", floor=0.05, **ALWAYS), "ear": Sensor("ear", floor=0.1, **ALWAYS)}
    for _ in range(15):
        off = {name: math.sqrt(0.5) * one.floor * rng.standard_normal(2) for name, one in kinds.items()}
        z = {name: 2.0 + off[name] + one.floor * rng.standard_normal((25, 2)) for name, one in kinds.items()}
        for case, names in (("eye", ["eye"]), ("ear", ["ear"]), ("both", ["eye", "ear"])):
            tracker = GLMB(Settings(), STILL, [kinds[name] for name in names])
            for k in range(25):
                for name in names:
                    tracker.update(k / 10, name, z[name][k : k + 1], kinds[name].floor ** 2 * np.eye(2)[None])
            squares[case].append(float(np.square(tracker.tracks(2.5)[0].state[:2] - 2.0).sum()))
    mean = {case: np.mean(one) for case, one in squares.items()}
    assert mean["both"] < mean["eye"] < mean["ear"]


def test_what_was_learnt_is_restored():
    sensor = dataclasses.replace(EYE, **ALWAYS)
    tracker = person(6, 20.0, eye=(sensor, 0.05, 0.1, np.zeros(2)), arm=(sensor, 0.05, 0.05, np.array([0.05, 0.0])))
    again = GLMB(Settings(), STILL)
    again.restore(json.loads(json.dumps(tracker.state())))
    for k, sensor in enumerate(tracker.sensors):
        again.add(sensor)
        for key, value in again.errors.described(k).items():
            assert value == pytest.approx(tracker.errors.described(k)[key]), key


@given(
    st.lists(st.tuples(*[st.floats(1e-6, 1e8)] * 2, st.floats(-0.999, 0.999)), min_size=1, max_size=4),
    st.floats(LEAST, MOST),
    st.floats(LEAST, MOST),
    st.sampled_from([0.0, 0.05, 0.1]),
    st.sampled_from([[EYE], [EYE, ARM]]),
)
@settings(max_examples=100, deadline=None)
def test_noise_stays_positive_definite(given_noise, on_told, on_floor, floor, sensors):
    xx, yy, correlation = np.array(given_noise).T
    cross = correlation * np.sqrt(xx * yy)
    noise = np.stack([xx, cross, cross, yy], 1).reshape(-1, 2, 2)
    errors = Errors()
    for one in sensors:
        errors.add(dataclasses.replace(one, floor=floor))
    errors.factor[0] = on_told, on_floor
    _, scaled, part = errors.corrected(0, np.zeros((len(noise), 2)), noise)
    assert np.isfinite(scaled).all()
    assert (part >= 0).all()
    np.testing.assert_array_equal(scaled, scaled.swapaxes(1, 2))
    assert (np.linalg.det(scaled / np.sqrt(xx * yy)[:, None, None]) > 0).all()
    if floor == 0.0 and on_told == 1.0 and len(sensors) > 1:
        np.testing.assert_allclose(scaled, noise)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=2), st.floats(1e-6, 1.0), st.floats(1e-6, 1.0))
@settings(max_examples=100, deadline=None)
def test_shares_of_lasting_errors_stay_bounded(lean, variance, noise):
    errors = Errors()
    errors.add(EYE)
    errors.add(dataclasses.replace(ARM, floor=0.1, bias_sd=0.05))
    for _ in range(5):
        for column in (0, 1):
            row = np.array([lean])
            between = errors.between(row, column)
            assert between.unshared[0] >= 0
            r = noise * np.eye(2)[None]
            lean = leaning(row, column, np.array([[variance]]), np.ones((1, 1)), r, between)[0].tolist()
            assert min(lean) >= -1e-12
            assert max(lean) <= 1 + 1e-12


@pytest.mark.parametrize("joins", [1, 4, 9, 17, 30])
def test_a_sensor_may_join_at_any_time(joins):
    """What was learnt of a sensor's errors before another one joins stays, and neither record is lost."""
    tracker = GLMB(Settings(), Population(), [sensor("ceiling")])
    for k in range(60):
        time = k / 10
        place = np.array([[1 + time / 2, 2.0]])
        tracker.update(time, "ceiling", place, 0.01 * np.eye(2)[None])
        if k == joins:
            tracker.add(sensor("door"))
        if k >= joins:
            tracker.update(time, "door", place, 0.01 * np.eye(2)[None])
    (track,) = tracker.tracks(5.9)
    assert np.hypot(*(track.state[:2] - place[0])) < 0.1
    assert track.existence > 0.95


def spread(tracker, at):
    """Standard deviation (m, per axis) of the one track, and its existence."""
    (track,) = tracker.tracks(at)
    return math.sqrt((track.cov[0, 0] + track.cov[1, 1]) / 2), track.existence


@pytest.mark.parametrize(("told", "least", "most"), [(0.1, 0.02, 0.1), (0.5, 0.42, 0.55), (1.0, 0.9, 1.1)])
def test_a_camera_that_states_more_than_usual_errs_by_the_same_again(told, least, most):
    exact = dataclasses.replace(EYE, **ALWAYS)
    tracker = person(4, 10.0, eye=(exact, told, 0.1, np.array([told, 0.0])))
    sd, existence = spread(tracker, 10.0)
    assert least < sd < most
    # Student's t with four degrees of freedom and a variance of sigma² along each of two axes.
    assert existence == pytest.approx(1 - (1 + 0.5 / sd**2) ** -2, abs=0.05)


def test_an_exact_sensor_ends_the_doubt_of_a_vague_one():
    vague, exact = dataclasses.replace(EYE, **ALWAYS), dataclasses.replace(ARM, **ALWAYS)
    tracker = person(5, 5.0, eye=(vague, 0.6, 0.1, np.zeros(2)), arm=(exact, 0.08, 0.08, np.zeros(2)))
    sd, existence = spread(tracker, 5.0)
    assert sd < 0.15
    assert existence > 0.98


def test_two_long_ellipses_that_cross_leave_no_long_one():
    along, across = np.diag([1.0, 0.0004]), np.diag([0.0004, 1.0])
    place = np.linalg.inv(np.linalg.inv(along) + np.eye(2) * 1e-6)
    after = followed(along[None], across[None], place[None], across[None])[0]
    assert np.linalg.eigvalsh(after).max() < 0.01


vectors = st.tuples(st.floats(0.01, 2), st.floats(0.01, 2), st.floats(0, math.pi))


def ellipse(one):
    """A covariance (1, 2, 2) of two standard deviations in m and a direction."""
    turn = np.array([[math.cos(one[2]), -math.sin(one[2])], [math.sin(one[2]), math.cos(one[2])]])
    return (turn @ np.diag(np.square(one[:2])) @ turn.T)[None]


@given(vectors, vectors, vectors)
@settings(max_examples=60, deadline=None)
def test_common_errors_are_covariances_and_microphones_have_none(before, detected, place):
    stated = ellipse(detected)
    errors = Errors()
    errors.add(sensor("ear", MICROPHONES))
    errors.add(EYE)
    by_ear, by_eye = (errors.common(column, stated) for column in (0, 1))
    assert by_ear is None or not by_ear.any()
    part = np.zeros((1, 2, 2)) if by_eye is None else by_eye
    after = followed(ellipse(before), part, ellipse(place), stated)
    for one in (part, stated - part, after):
        assert np.linalg.eigvalsh(one).min() >= -1e-9


@pytest.mark.parametrize(("along", "across"), [(0.2, 0.2), (1.0, 1.0), (1.4, 0.1), (0.5, 0.02)])
def test_a_place_is_near_as_often_as_errors_with_long_tails_are(along, across):
    rng = np.random.default_rng(1)
    errors = rng.standard_normal((400_000, 2)) * [along, across]
    errors *= np.sqrt(2 / rng.chisquare(4, (400_000, 1)))  # Student's, of that variance
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    cov = turn @ np.diag([along**2, across**2]) @ turn.T
    expected = float(np.mean(np.hypot(*errors.T) < 1))
    assert gaussian.near(cov[None], 1.0).item() == pytest.approx(expected, abs=0.003)


@given(vectors)
@settings(max_examples=60, deadline=None)
def test_one_camera_s_doubt_along_the_line_of_sight_is_no_noise_of_the_way_but_is_reported(detected):
    stated = ellipse(detected)
    eye = dataclasses.replace(EYE, floor=0.0)
    alone, together = Errors(), Errors()
    for errors, sensors in ((alone, [eye]), (together, [eye, ARM])):
        for one in sensors:
            errors.add(one)
    _, noise, _ = alone.corrected(0, np.zeros((1, 2)), stated)
    np.testing.assert_allclose(together.corrected(0, np.zeros((1, 2)), stated)[1], stated)
    across, along = np.linalg.eigvalsh(stated[0])
    least = max(across, 0.15**2)
    expected = [across, along - (1 - WHITE) * max(along - least, 0.0)]
    assert np.linalg.eigvalsh(noise[0]) == pytest.approx(expected)
    kept, usual = alone.common(0, stated), together.common(0, stated)
    if across <= 0.15**2 < along:
        np.testing.assert_allclose(noise + kept, stated, atol=1e-9)
        assert np.linalg.eigvalsh(usual - kept).min() >= -1e-9


def test_a_track_by_colour_keeps_up_with_who_walks_to_the_camera():
    """A track that took what is stated for noise was 1.2 m behind."""
    fusion, told = Fusion(Settings()), np.full((1, 3, 3), np.nan)
    told[0, :2, :2] = np.diag([1.2**2, 0.1**2])
    for k in range(16):
        place = np.array([[4.0 if k < 8 else 4.0 - 0.4 * (k - 7), 2.0, np.nan]])
        found = Detections(k / 3, "eye", place, told, np.array([0.99]), CAMERA)
        tracks = fusion.step(k / 3, [(k / 3, "eye", found)])
    assert abs(tracks[0].positions[0, 0] - place[0, 0]) < 0.4
    assert math.sqrt(tracks[0].covariances[0, 0, 0]) > 1.0


@pytest.mark.parametrize("lag", [0, 5])
def test_later_detections_do_not_end_the_doubt_of_a_vague_camera(lag):
    """It errs by the same in them; so existence and covariance are the same with --lag."""
    fusion, tracks, told = Fusion(Settings(), lag=lag), [], np.full((1, 3, 3), np.nan)
    told[0, :2, :2] = 0.6**2 * np.eye(2)
    for k in range(40):
        found = Detections(k / 10, "eye", np.array([[2.0, 2.0, np.nan]]), told, np.array([0.99]), CAMERA)
        tracks += fusion.step(k / 10, [(k / 10, "eye", found)])
    (late,) = (one for one in tracks if one.timestamp == 3.0)
    assert 0.5 < math.sqrt(late.covariances[0, 0, 0]) < 0.7
    assert late.existence[0] == pytest.approx(1 - (1 + 0.5 / 0.6**2) ** -2, abs=0.05)
