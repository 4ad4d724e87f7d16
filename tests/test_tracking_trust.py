"""Existence is as true as the tracks that it was fitted to: its curves, the fit, the shipped file."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parent / "bench"))

import fit_existence

from avcli.formats.records import Detections
from avcli.formats.sensors import CAMERA, MICROPHONES
from avcli.tracking import coverage
from avcli.tracking.fusion import Fusion
from avcli.tracking.model import Population
from avcli.tracking.settings import Settings, sensor
from avcli.tracking.trust import FITTED, MOST, TRUST, Absences, Grounds, Law, Trust

probabilities = st.floats(0.0, 1.0)
KINDS = st.tuples(st.booleans(), st.integers(1, 9), st.booleans(), st.integers(0, 99), st.floats(0.01, 100.0))


@given(probabilities, probabilities, probabilities, KINDS)
def test_who_is_believed_in_more_is_likelier_there(one, other, fixed, kind):
    low, high = sorted((one, other))
    assert 0 <= TRUST.of(Grounds(low, fixed, *kind)) <= TRUST.of(Grounds(high, fixed, *kind)) <= 1
    assert TRUST.of(Grounds(fixed, low, *kind)) <= TRUST.of(Grounds(fixed, high, *kind))


@given(st.floats(0.5, 0.95))
def test_who_is_detected_is_likelier_there_and_most_of_all_who_is_detected_again(believed):
    said = [TRUST.of(Grounds(believed, 1.0, *how)) for how in ((False, 1), (True, 1), (True, 2))]
    assert said == sorted(said)


@given(st.floats(0.5, 0.95), st.integers(1, 9))
def test_a_miss_says_less_where_no_camera_looks(believed, count):
    missed, away = (TRUST.of(Grounds(believed, 0.9, False, count, watched, 1)) for watched in (True, False))
    assert missed < away
    assert len({TRUST.of(Grounds(believed, 0.9, True, count, watched)) for watched in (True, False)}) == 1


def test_who_is_missed_is_likelier_there_where_others_came_back_from_as_long_an_absence():
    absences = Absences()
    for k in range(30):
        absences.record(k / 10)
    unknown = absences.grounds(0.9, 0.99, False, 5, True, 1.9, 2.9)
    assert (unknown.missed, unknown.returned) == (10, 1.0)
    absences.back([0.1, 0.5, 1.5, 2.5], dt=0.1)  # the first missed no record
    assert absences.gaps == [0.5, 1.5, 2.5]
    assert absences.grounds(0.9, 0.99, False, 5, True, 1.9, 2.9).returned == 3.0
    back = TRUST.of(absences.grounds(0.9, 0.99, False, 5, True, 1.9, 2.9))
    absences.left += 3
    gone = TRUST.of(absences.grounds(0.9, 0.99, False, 5, True, 1.9, 2.9))
    assert gone < TRUST.of(unknown) < back
    assert absences.grounds(0.9, 0.99, True, 5, True, 2.9, 2.9) == Grounds(0.9, 0.99, True, 5, True)


def test_what_is_kept_of_a_run_stays_small():
    absences = Absences()
    absences.left = 400.0
    for k in range(5000):
        absences.record(k / 10)
        absences.back([0.2 + k % 7], dt=0.1)
    assert len(absences.gaps) <= MOST
    assert len(absences.times) <= 2 * MOST
    assert absences.left == pytest.approx(400 / 2**8)


@pytest.mark.parametrize(("named", "looks"), [(("video", "audio"), [True, False]), (("audio",), [True, True])])
def test_a_camera_looks_where_it_would_detect_half_of_the_people_it_can_detect(named, looks):
    share = np.ones((40, 40))
    share[20:] = coverage.LEAST  # nobody is in the picture beyond x = 2 m
    field = coverage.Coverage(np.zeros(2), coverage.STEP, share)
    known = {"video": sensor("video", coverage=field), "audio": sensor("audio", MICROPHONES)}
    sensors = [known[name] for name in named]
    assert coverage.watched(np.array([[1.0, 1.0], [3.0, 1.0]]), sensors) == looks


def test_the_fit_finds_the_law_that_made_the_truth():
    rng, law = np.random.default_rng(1), Law(0.5, 0.6, 0.4, 0.5, 0.3)
    n = 40000
    believed, missed, returned = rng.uniform(0.02, 0.98, (n, 2)), rng.integers(1, 20, n), 2.0 ** rng.normal(0, 2, n)
    grounds = [
        Grounds(*both, False, 3, True, many, ratio)
        for both, many, ratio in zip(believed.tolist(), missed.tolist(), returned.tolist(), strict=True)
    ]
    factor = rng.uniform(0.3, 1, n)
    true = rng.uniform(size=n) < factor * [law.of(one) for one in grounds]
    rows = np.column_stack([np.array(grounds, float), factor, true])
    found = fit_existence.fit(rows, np.ones(n), ("existence", "near", "missed", "returned"))
    assert list(found) == pytest.approx(list(law), abs=0.05)
    again = fit_existence.fit(rows, np.ones(n), (), law._replace(odds=9.0))  # the powers are given
    assert list(again) == pytest.approx(list(law), abs=0.03)


def test_the_shipped_laws_made_existence_truer_where_they_were_fitted():
    whole = json.loads(FITTED.read_text())
    assert Trust(*(Law(**one) for one in whole["laws"].values())) == TRUST
    assert list(whole["laws"]) == list(TRUST._fields)
    for domain in ("synthetic", "hotel", "films"):  # zara hides people for long, and hotel lets them go
        scores = whole["fit"][domain]
        assert scores["after"]["brier"] < scores["before"]["brier"]
    for count, said, true in whole["fit"]["synthetic"]["after"]["bins"]:
        assert count < 400 or said == pytest.approx(true, abs=0.05)


def existences(scores, name="audio", kind=MICROPHONES, before=(), lag=0.0):
    """Existence of one person at one place after each record of a sensor; `before` are records (name, kind, score)."""
    fusion, found = Fusion(Settings(), "ms-glmb", lag, population=Population()), []
    records = [*before, *((name, kind, score) for score in scores)]
    for k, (sensor_name, sensor_kind, score) in enumerate(records):
        at = 0.1 * (k + 1)
        seen = Detections(
            at, sensor_name, np.array([[1.0, 2.0, np.nan]]), np.full((1, 3, 3), np.nan), np.array([score]), sensor_kind
        )
        found += fusion.step(at, [(at, sensor_name, seen)])
    return [float(max(tracks.existence, default=0.0)) for tracks in [*found, *fusion.finish()]]


@pytest.mark.parametrize("kind", [MICROPHONES, CAMERA])
def test_doubtful_reports_at_one_place_do_not_become_sure(kind):
    said = existences([0.7, 0.75, 0.62, 0.7, 0.7, 0.66], kind=kind)
    assert 0.7 < max(said) <= 0.75
    assert existences([0.7, 0.7, 0.99, 0.7, 0.7, 0.7])[-1] > 0.95  # one good report is enough
    assert max(existences([0.7, 0.75, 0.62, 0.7], kind=kind, lag=2)) <= 0.75
    assert 0 < existences([0.2] * 6)[-1] <= 0.2  # who is shown does not depend on it
    assert existences([np.nan] * 6)[-1] > 0.95  # a sensor that gives no score is judged by its detections


def test_sensors_that_doubt_by_themselves_are_surer_together():
    alone = existences([0.7] * 3)[-1]
    both = existences([0.7] * 3, before=[("video", CAMERA, 0.8)] * 3)[-1]
    assert alone < 0.7 < both < 1 - 0.3 * 0.2 + 1e-6
    assert existences([0.7] * 3, before=[("video", CAMERA, np.nan)] * 3)[-1] > 0.95  # nothing tells how sure it is


def heard_alone(score, looks=True, seen=0, lag=0.0):
    """Existence of whom an array reports ten times at one place, after a camera has looked at another person for 2 s.

    looks: whether the camera works: else its records are empty; seen: of its records show the talker, too.
    """
    fusion, found = Fusion(Settings(), "ms-glmb", lag, population=Population()), []
    for k in range(30):
        at = 0.1 * (k + 1)
        places = [[4.0, 3.0, np.nan]] * looks + [[1.0, 2.0, np.nan]] * (20 <= k < 20 + seen)
        n = len(places)
        video = Detections(
            at, "video", np.array(places).reshape(-1, 3), np.full((n, 3, 3), np.nan), np.full(n, 0.9), CAMERA
        )
        records = [(at, "video", video)]
        if k >= 20:
            talker = np.array([[1.0, 2.0, np.nan]])
            audio = Detections(at, "audio", talker, np.full((1, 3, 3), np.nan), np.array([score]), MICROPHONES)
            records.append((at, "audio", audio))
        found += fusion.step(at, records)
    last = [*found, *fusion.finish()][-1]
    near = [
        existence
        for place, existence in zip(last.positions, last.existence, strict=True)
        if np.hypot(*(place[:2] - [1.0, 2.0])) < 0.5
    ]
    return max(map(float, near), default=0.0)


@pytest.mark.parametrize("lag", [0.0, 3.0])
def test_a_doubtful_talker_whom_a_camera_overlooks_is_nobody(lag):
    assert heard_alone(0.8, lag=lag) == 0.0
    assert 0.5 < heard_alone(0.995, lag=lag) < 0.95  # who is surely heard may be hidden
    assert heard_alone(0.8, seen=1, lag=lag) > 0.9  # hidden since


def test_a_camera_that_sees_nothing_at_all_says_nothing_of_a_talker():
    assert heard_alone(0.8, looks=False) == pytest.approx(0.8, abs=0.1)
