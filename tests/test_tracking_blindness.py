"""A sensor that seems blind: what else may be, when it detects somebody again and again all the same."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avcli.formats.records import Detections
from avcli.tracking.blindness import Seen, Spell
from avcli.tracking.fusion import Fusion
from avcli.tracking.glmb import GLMB
from avcli.tracking.model import Population
from avcli.tracking.settings import Settings, sensor

HIDE, SHOW = 0.01, 1.0


def all_but_one_go(seen_later, hide=HIDE):
    """Nine people stand for 4 s; for .2 s the camera finds nobody, then one of them or nobody; returns who is shown."""
    hall, n = Population(((0.0, 0.0), (12.0, 12.0))), 9
    tracker = GLMB(Settings(learn=False), hall, [sensor("video", hide=hide)])
    places = np.array([[2.0 + 3 * (k % 3), 2.0 + 3.5 * (k // 3)] for k in range(n)])
    for k in range(50):
        z = places if k < 40 else places[:0] if k < 42 else places[:seen_later]
        tracker.update(k / 10, "video", z, np.tile(0.0144 * np.eye(2), (len(z), 1, 1)))
    return len(tracker.tracks(4.9))


def test_who_is_missed_beside_somebody_who_is_found_again_and_again_has_left():
    assert all_but_one_go(1) == 1


def test_where_nobody_is_found_everybody_may_still_be_there():
    assert all_but_one_go(0) == 9


def test_where_the_sensor_often_loses_people_they_are_believed_to_be_hidden():
    assert all_but_one_go(1, hide=0.5) == 9


def record(found, there=1.0, able=1.0):
    return {k: Seen(there, able, 0.02, 0.9, more) for k, more in enumerate(found)}


def test_who_has_left_costs_a_sensor_that_sees_nothing_more():
    spell, odds = Spell(0.002, 0.05), []
    for _ in range(30):
        assert not spell.follow(record([0.0, 0.0, 0.0]), 0.0, 0.0, HIDE, SHOW, 0.1)
        odds.append(spell._missed)
    assert odds[-1] - odds[-2] == pytest.approx(0.0, abs=0.05)
    there, able = spell.before[0]
    assert there * able < 0.01


def test_a_few_detections_of_one_person_show_that_the_sensor_sees():
    spell = Spell(0.002, 0.05)
    assert not spell.follow(record([0.0, 0.0, 0.0, 0.0]), 0.0, 0.0, HIDE, SHOW, 0.1)
    sees = [spell.follow(record([500.0, 0.0, 0.0, 0.0]), 0.0, -0.05, HIDE, SHOW, 0.1) for _ in range(3)]
    assert sees == [False, True, True]


@given(
    st.lists(st.lists(st.floats(0, 1e9), min_size=3, max_size=3), max_size=20),
    st.floats(0, 1),
    st.floats(0, 1),
    st.floats(0, 1),
    st.floats(1e-6, 10),
)
def test_a_spell_holds_probabilities(records, blind, there, able, dt):
    spell = Spell(blind, 0.05)
    for found in records:
        spell.follow(record(found, there, able), 0.0, -1.0, HIDE, SHOW, dt)
        assert all(0 <= p <= 1 + 1e-12 for pair in spell._after.values() for p in pair)
        assert math.isfinite(spell._odds)


@pytest.mark.parametrize("seed", [17, 41, 56])
def test_a_first_step_may_hold_records_of_many_seconds(seed):
    random = np.random.default_rng(seed)
    records = []
    for k in range(60):
        there = 3 if k < 11 else int(random.choice([0, 0, 2, 2, 3]))
        places = np.column_stack([1 + np.arange(there), np.full(there, 2.0), np.full(there, np.nan)])
        places[:, :2] += random.normal(0, 0.05, (there, 2))
        records.append((0.1 * k, "video", Detections(0.1 * k, "video", places, kind="camera")))
        if random.random() < 0.5:
            heard = np.array([[1.0, 2.0, 1.5]])[: random.integers(2)] + random.normal(0, 0.1, 3)
            records.append((0.1 * k, "audio", Detections(0.1 * k, "audio", heard, kind="microphones")))
    at_once, by_turns = Fusion(), Fusion()
    (last,) = at_once.step(30.0, records)
    for record in records:
        by_turns.step(record[0], [record])
    (other,) = by_turns.step(30.0, [])
    assert last.ids.tolist() == other.ids.tolist()
    np.testing.assert_allclose(last.positions, other.positions, atol=1e-6)
