"""What is learnt of a room: maps, rates, the file that keeps them, and what follows for tracks."""

import dataclasses
import json
import math
import os

import cv2
import numpy as np
import orjson
import pytest
from conftest import run
from hypothesis import given
from hypothesis import strategies as some

from avcli.formats.records import Detections
from avcli.formats.sensors import MICROPHONES
from avcli.tracking import gaussian, track
from avcli.tracking.births import Undetected
from avcli.tracking.blindness import COMMON, EMPTIED, LOST, Blindness
from avcli.tracking.coverage import Coverage
from avcli.tracking.fusion import Fusion
from avcli.tracking.glmb import GLMB
from avcli.tracking.learning import Habits
from avcli.tracking.learnt import LEARNT, read_learnt, write_learnt
from avcli.tracking.model import Population
from avcli.tracking.picture import bounds, picture, ticks
from avcli.tracking.places import Places
from avcli.tracking.rates import EVENTS, KEEP, MOST_AGAIN, Hiding, Rates, logit
from avcli.tracking.settings import Settings, sensor
from avcli.tracking.unseen import UnseenMap

ROOM = ((0.0, 0.0), (8.0, 6.0))
DOOR = np.array([5.0, 3.0])  # where people leave, amid the room: no prior knows of it


# --- places -----------------------------------------------------------------------------------------------------------


@given(
    some.lists(
        some.tuples(some.floats(-1, 9), some.floats(-1, 7), some.floats(-3, 50), some.floats(0, 1e6)), max_size=8
    ),
    some.floats(0, 1),
)
def test_factors_are_positive_and_finite_whatever_happened(events, keep):
    places = Places(ROOM, 1.0, 1.0)
    for x, y, happened, expected in events:
        places.expect(np.array([[x, y]]), np.array([expected]))
        places.happen(np.array([x, y]), happened)
    places.fade(keep)
    places.refresh()
    assert np.isfinite(places.factor).all()
    assert (places.factor > 0).all()
    assert ((places.learnt() >= 0) & (places.learnt() < 1)).all()


def test_a_place_far_from_all_others_is_the_gamma_poisson_posterior():
    """Prior worth 2 events in the room and 3 at a place; 5 happened where 1 was expected, 9 were expected elsewhere.

    The factors of the room, of 2 m around a place and of .5 m around it are posteriors, each the next one's prior.
    """
    places = Places(ROOM, 2.0, 3.0)
    here, far = np.array([0.1, 0.1]), np.array([7.9, 5.9])
    places.expect(np.stack([here, far]), np.array([1.0, 9.0]))
    places.happen(here, 5.0)
    overall = (2 + 5) / (2 + 10)
    assert places.overall == pytest.approx(overall)
    around = overall * (3 + 5) / (3 + overall * 1)
    assert places.at(here[None]) == pytest.approx(around * (3 + 5) / (3 + around * 1), rel=1e-4)
    around = overall * 3 / (3 + overall * 9)
    assert places.at(far[None]) == pytest.approx(around * 3 / (3 + around * 9), rel=1e-2)


def test_who_vanishes_amid_the_room_may_vanish_anywhere_near():
    """One person left at the door: a metre from it the factor is higher than at the other end of the room."""
    places = Places(ROOM, 1.0, 0.2)
    places.expect(places.centres().reshape(-1, 2), np.full(places.factor.size, 0.5 / places.factor.size))
    places.happen(DOOR)
    at, beside, away = (float(places.at((DOOR - [x, 0.0])[None])[0]) for x in (0.0, 1.0, 4.9))
    assert at > 2 * beside > 2 * away


def test_what_is_taken_back_leaves_no_trace():
    places = Places(ROOM, 1.0, 1.0)
    before = places.factor.copy()
    places.happen(DOOR)
    assert places.at(DOOR[None]) > 1
    places.happen(DOOR, -1.0)
    np.testing.assert_array_equal(places.factor, before)


def test_places_outside_the_area_are_those_of_its_border():
    places = Places(ROOM, 1.0, 1.0)
    places.happen(np.array([100.0, 3.0]))
    assert places.at(np.array([[7.99, 3.0], [1e6, 3.0]])).tolist() == [places.factor.max()] * 2


def test_huge_and_tiny_areas_have_few_cells():
    for size in (1e-3, 1e3, 1e6):
        places = Places(((0.0, 0.0), (size, size)), 1.0, 1.0)
        assert 1 <= len(places.factor) <= 60
        assert places.centres().shape == (*places.shape, 2)


# --- rates ------------------------------------------------------------------------------------------------------------


def test_clutter_and_detection_are_learnt_to_their_values():
    rates = Rates(sensor("ceiling"))
    for _ in range(2000):
        rates.learn(1.5, 3.0, 2.0, 0.0)
    assert rates.clutter == pytest.approx(1.5, rel=0.01)
    assert rates.detection == pytest.approx(0.6, rel=0.01)


def test_clutter_far_above_what_was_learnt_is_learnt_in_a_few_records():
    rates = Rates(sensor("ceiling"))
    for _ in range(200):
        rates.learn(0.0, 1.0, 0.0, 0.0)
    for _ in range(5):
        rates.learn(20.0, 1.0, 0.0, 0.0)
    assert rates.clutter > 10


def test_records_far_apart_hardly_teach_that_there_is_clutter():
    """One that is full of detections may be full of people, as long as none shows soon whether they are still there."""

    def learnt(dt):
        rates = Rates(sensor("ceiling"))
        for _ in range(5):
            rates.settle(dt)
            rates.learn(20.0, 1.0, 0.0, 0.0)
        rates.settle(dt)
        return rates.clutter

    assert learnt(0.1) > 10
    assert learnt(1.0) < 3


def test_what_is_given_back_was_never_learnt():
    one, other = Rates(sensor("ceiling")), Rates(sensor("ceiling"))
    for false in (0.0, 0.9, 0.0):
        for rates, more in ((one, false), (other, 0.0)):
            rates.settle(0.1)
            rates.learn(0.2 + more, 1.0, 0.0, 0.0)
    one.give_back(0.9 * KEEP)
    assert one.clutter == pytest.approx(other.clutter, rel=1e-3)
    for rates in (one, other):
        rates.settle(1.0)
    assert one.clutter == pytest.approx(other.clutter, rel=0.01)
    one.give_back(5.0)
    assert one.clutter == pytest.approx(1e-3)


@pytest.mark.parametrize("rate", [1.0, 2.0, 10.0])
def test_people_who_come_are_not_learnt_as_clutter(rate):
    """Each second one comes amid a hall of 12 m x 8 m, where nobody should; .05 false detections in a record."""
    rng, shown, there = np.random.default_rng(0), 0, 0
    fusion = Fusion(Settings(), population=Population(area=((0.0, 0.0), (12.0, 8.0))))
    begin, rows = np.arange(120.0), rng.uniform(1, 7, 120)
    for k in range(int(120 * rate)):
        walked = 3.0 + 1.3 * (k / rate - begin)
        here = (walked >= 3.0) & (walked <= 9.0)
        at = np.column_stack([walked[here], rows[here]])
        found = at[rng.random(len(at)) < 0.9]
        false = rng.uniform(0, 8, (rng.poisson(0.05), 2))
        z = np.vstack([found + 0.12 * rng.standard_normal(found.shape), false])
        nan = np.full((len(z), 3, 3), np.nan)
        record = Detections(k / rate, "ceiling", np.insert(z, 2, 0.0, axis=1), nan, nan[:, 0, 0], "camera")
        [out] = fusion.step(k / rate, [(k / rate, "ceiling", record)])
        shown, there = shown + len(out.ids), there + len(at)
    assert fusion.tracker.rates[0].clutter < 0.3
    assert shown > 0.7 * there


def test_tracks_that_clutter_began_do_not_count_as_people_who_left():
    """Twelve false detections in a record of 4.66 m x 4.66 m, and nobody: three by chance make a track."""
    rng, nan = np.random.default_rng(0), np.full((12, 3, 3), np.nan)
    fusion = Fusion(Settings(), population=Population())
    for k in range(80):
        at = np.column_stack([rng.uniform(0, 4.66, (12, 2)), np.zeros(12)])
        record = Detections(k / 10, "ceiling", at, nan, np.full(12, np.nan), "camera")
        fusion.step(k / 10, [(k / 10, "ceiling", record)])
    assert np.sum(fusion.state()["exits"]["happened"]) < 4  # 22 when three detections were enough


def test_a_first_record_full_of_detections_is_rather_clutter_than_a_crowd():
    """As many as are expected are people at once; of twenty each is doubted, until others come in the same places."""
    rng, nan = np.random.default_rng(0), np.full((20, 3, 3), np.nan)
    at = np.column_stack([rng.uniform(0, 4.66, (20, 2)), np.zeros(20)])

    def said(records, count=20):
        fusion = Fusion(Settings(show="all"), population=Population())
        for k in range(records):
            record = Detections(k / 10, "ceiling", at[:count], nan[:count], np.full(count, np.nan), "camera")
            [out] = fusion.step(k / 10, [(k / 10, "ceiling", record)])
        return out.existence

    assert said(1, 3).min() > 0.9
    assert said(1).max() < 0.6
    assert said(3).mean() > 0.95


def test_how_people_hide_is_learnt_from_people_who_come_back():
    """Who is hidden for 4 s every 20 s is detected 10 times a second in between."""
    hiding, sure = Hiding(sensor("ceiling")), np.ones(1)
    for _ in range(100):
        shown = hiding.detectable() * (1 - math.exp(-(hiding.hide + hiding.show) * 0.1))  # since just now
        hiding.learn(np.array([shown]), np.array([4.0]), sure, 0.1)
        for _ in range(200):
            hiding.learn(np.array([0.999]), np.array([0.1]), sure, 0.1)
    assert 1 / hiding.hide == pytest.approx(20, rel=0.2)
    assert 1 / hiding.show == pytest.approx(4, rel=0.2)
    assert hiding.events < EVENTS / (1 - KEEP)


@given(
    some.lists(some.tuples(some.floats(0, 1), some.floats(0, 1e3), some.floats(0, 1)), min_size=1, max_size=20),
    some.floats(1e-3, 1e3),
)
def test_rates_of_hiding_are_positive_and_finite(people, dt):
    hiding = Hiding(sensor("ceiling"))
    hiding.learn(*np.array(people).T, dt)
    for rate in (hiding.hide, hiding.show):
        assert 0 < rate < math.inf
    assert 0 < hiding.detectable() < 1


@given(some.lists(some.tuples(some.floats(1e-6, 100), some.floats(0, 1e6), some.floats(0, 10)), max_size=20))
def test_blindness_is_a_probability(records):
    blindness = Blindness(True)
    for dt, ratio, leaving in records:
        blindness.update(dt, ratio)
        blindness.empty(dt, leaving)
        assert 0 <= blindness.probability <= 1
        assert 0 <= blindness.left <= 1


def test_a_sensor_that_lost_everybody_is_believed_blind_at_first_and_empty_later():
    blindness, left = Blindness(True), []
    for _ in range(200):
        blindness.update(0.1, 1e-6)
        blindness.empty(0.1, 0.01)
        left.append(blindness.left)
    assert left[0] < 0.1
    assert left == sorted(left)
    assert left[-1] > 0.99


def blind(records, seen=()):
    """A camera that sees people for ten records, nobody for 30, and in so many others known people in some, `seen`."""
    blindness = Blindness(True)
    for k in range(40 + records):
        blindness.update(0.1, 1e-6 if 10 <= k < 40 else 1e6)
        blindness.empty(0.1, 0.01)
        if k - 40 in seen:
            blindness.learn([3.0 if k - 40 == seen[0] else 0.1], 0.1)
    return blindness


def test_people_have_come_back_if_more_than_one_record_shows_them():
    after = int(LOST) + 1
    assert (blind(after).returned, blind(after).emptied) == (1.0, pytest.approx(1 + EMPTIED))
    assert blind(after, seen=(0, 1)).returned == 2.0
    assert blind(after, seen=(0,)).emptied == pytest.approx(1 + EMPTIED)  # a false detection where somebody was


def test_what_blinds_one_sensor_may_blind_another():
    one, other = Blindness(True), Blindness(True, tells=False)
    other.share(one)
    assert other.probability == pytest.approx(COMMON)
    one.left = 1.0  # everybody left
    other.share(one)
    assert other.probability == pytest.approx(COMMON)
    never = Blindness(False)
    never.share(Blindness(True))
    assert never.probability == 0


# --- what is kept -----------------------------------------------------------------------------------------------------


def leavers(people, begin=0.0, gone=2.0):
    """Records at 10 Hz of people who come one after the other at (1, 3), walk to `DOOR` at 1.5 m/s, and are gone."""
    nan, scores = np.full((1, 3, 3), np.nan), np.array([0.9])
    steps = round((DOOR[0] - 1) / 0.15)
    for person in range(people):
        for k in range(steps + round(gone * 10)):
            t = begin + (person * (steps + round(gone * 10)) + k) / 10
            at = np.array([[1 + 0.15 * k, 3.0 + 0.02 * (-1) ** k, 0.0]])
            if k < steps:
                yield Detections(t, "ceiling", at, nan, scores, "camera")
            else:
                yield Detections(t, "ceiling", np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), "camera")


def fusion_of(state=None, tracker="ms-glmb", lag=0, **settings):
    settings = Settings(**settings)
    fusion = Fusion(settings, tracker, lag, population=Population.of(settings, ROOM[1]))
    if state is not None:
        fusion.restore(state)
    return fusion


def fuse(fusion, records):
    """Tracks of each record."""
    out = [one for record in records for one in fusion.step(record.timestamp, [(record.timestamp, "ceiling", record)])]
    return out + fusion.finish()


@pytest.fixture(scope="module")
def learnt():
    """What a run has learnt in which twelve people left by a door that nobody knew."""
    fusion = fusion_of()
    fuse(fusion, leavers(12))
    return fusion.state()


def test_who_leaves_by_a_learnt_door_is_dropped_within_a_second(learnt):
    ghosts = [
        sum(len(one) for one in fuse(fusion_of(state), leavers(1, gone=8.0)) if not one.observed.any())
        for state in (None, learnt)
    ]
    assert ghosts[0] > 12
    assert ghosts[1] < 10


def test_people_are_learnt_to_come_and_leave_where_they_do(learnt):
    habits = Habits(Population(ROOM), learn=False)
    habits.restore(learnt)
    in_the_middle, begin = np.array([[4.0, 5.0]]), np.array([[1.0, 3.0]])
    assert habits.exits.at(DOOR[None]) > 5 * habits.exits.at(in_the_middle)
    assert habits.entries.at(begin) > 2 * habits.entries.at(in_the_middle)


def test_how_often_a_sensor_finds_one_person_again_is_learnt():
    """A detector that finds each person three times in a picture: two tracks remain, and its rate is told."""
    rng, tracker = np.random.default_rng(0), GLMB(Settings(), Population(), [sensor("ceiling")])
    for k in range(100):
        here = np.array([[1.0 + 0.02 * k, 1.5], [3.0, 3.5 - 0.02 * k]]).repeat(3, 0) + 0.1 * rng.standard_normal((6, 2))
        tracker.update(k / 10, "ceiling", here, np.tile(0.01 * np.eye(2), (6, 1, 1)))
    assert len(tracker.tracks(9.9)) == 2
    assert tracker.rates[0].again_sum / tracker.rates[0].again_count > 1.0
    assert tracker.rates[0].again == MOST_AGAIN
    assert tracker.rates[0].clutter < 0.5


def test_what_is_restored_is_what_was_kept(learnt, tmp_path):
    path = tmp_path / "room.json"
    write_learnt(path, learnt)
    again = fusion_of(read_learnt(path))
    assert again.state() == learnt
    fuse(again, [])
    again._column("ceiling", "camera")  # the sensor of before reports
    after = again.state()
    assert after["exits"] == learnt["exits"]
    for key in ("clutter_sum", "hit_sum", "again_sum", "hiding", "blindness"):
        assert after["sensors"]["ceiling"][key] == learnt["sensors"]["ceiling"][key]


def test_the_second_run_begins_as_the_first_ended(learnt):
    first, second = fusion_of(), fusion_of(learnt)
    fuse(first, leavers(12))
    second._column("ceiling", "camera")
    for one, other in zip(first.tracker.rates, second.tracker.rates, strict=True):
        assert one.clutter == pytest.approx(other.clutter)
        assert one.detection == pytest.approx(other.detection)
        assert one.hiding.hide == pytest.approx(other.hiding.hide)
    first.tracker.habits.exits.refresh()
    np.testing.assert_allclose(first.tracker.habits.exits.factor, second.tracker.habits.exits.factor, rtol=1e-3)
    assert second.state() != fusion_of().state()


def test_learning_is_the_same_each_time(learnt):
    fusion = fusion_of()
    fuse(fusion, leavers(12))
    assert orjson.dumps(fusion.state()) == orjson.dumps(learnt)


def test_without_learning_a_run_changes_nothing_of_what_it_was_given(learnt):
    fusion = fusion_of(learnt, learn=False)
    fuse(fusion, leavers(3))
    after = fusion.state()
    assert (after["exits"], after["entries"]) == (learnt["exits"], learnt["entries"])
    assert after["sensors"]["ceiling"]["errors"] == learnt["sensors"]["ceiling"]["errors"]


def test_after_a_pause_of_a_day_a_run_tracks_as_at_its_start():
    """The people who came in a day were all expected to be there, and those of before counted as having left at once:
    clutter became people (16 numbers for three), and tracks ended after two misses.
    """
    rng, seen = np.random.default_rng(0), []
    for start in (0.0, 86400.0):
        for k in range(100):
            people = np.array([[1 + k / 50, 1.2, 0], [3.5, 1 + k / 50, 0], [3.5 - k / 50, 3.8, 0]])
            people[:, :2] += rng.normal(0, 0.1, (3, 2))
            found = np.concatenate([people[rng.random(3) < 0.9], rng.uniform(0, 4.66, (rng.poisson(0.3), 3))])
            noise = np.tile(0.01 * np.eye(3), (len(found), 1, 1))
            seen.append(Detections(start + k / 10, "ceiling", found, noise, kind="camera"))
    tracks = track(None, seen)
    first, second = ([one for one in tracks if (one.timestamp >= 86400) == late] for late in (False, True))
    assert len({label for one in second for label in one.ids.tolist()}) <= 4
    assert abs(np.mean(list(map(len, second))) - np.mean(list(map(len, first)))) < 0.2


def test_no_more_people_come_in_a_pause_than_stay():
    population = Population(((0.0, 0.0), (6.0, 4.0)))
    habits = Habits(population, learn=True)
    everywhere, in_part = Undetected(population, habits.entries), UnseenMap(population, habits, [])
    for one in (everywhere, in_part):
        one.predict(1e7)
    assert sum(everywhere.expected) == pytest.approx(population.arrivals * population.stay)
    assert in_part.number.sum() == pytest.approx(population.arrivals * population.stay)


def test_a_low_score_speaks_against_an_exact_detection_and_not_against_a_vague_one():
    near = gaussian.odds_within(np.stack([0.0 * np.eye(2), 4.0 * np.eye(2)]), 0.5)
    assert near == pytest.approx([1.0, math.expm1(1 / 32)])
    rates = Rates(sensor("ring", MICROPHONES))
    rates.learn_score([logit(0.9), logit(0.1), math.nan], [1.0, 0.01, 1.0], [1.0, 1.0, 1.0])
    assert rates.typical == pytest.approx(logit(0.9), abs=0.15)
    exact, vague, unknown = rates.clutter_factors([logit(0.3), logit(0.3), math.nan], [1.0, 0.01, 1.0])
    assert exact == pytest.approx(21, rel=0.2)
    assert vague == pytest.approx(math.exp(-1))
    assert unknown == 1


def test_without_learning_no_history_makes_a_difference():
    fresh, old = fusion_of(learn=False), fusion_of(learn=False)
    fuse(fresh, leavers(1))
    fuse(old, leavers(12))
    kept, known = fresh.state(), old.state()
    for state in (kept, known):
        del state["sensors"]["ceiling"]["typical"]  # of the scores, which is a scale and no rate
    assert kept == known


@pytest.mark.parametrize("hidden", [True, False])
def test_what_is_kept_is_valid_and_can_be_read_again(hidden, tmp_path):
    fusion = fusion_of(hidden=hidden)
    fuse(fusion, leavers(1))
    write_learnt(tmp_path / "room.json", fusion.state())
    assert read_learnt(tmp_path / "room.json") == LEARNT.content.read(fusion.state())


@pytest.mark.parametrize("other", [(8.0, 7.0), (4.0, 3.0)])
def test_another_room_is_refused(learnt, other):
    settings = Settings()
    with pytest.raises(ValueError, match="another size"):
        Fusion(settings, population=Population.of(settings, other)).restore(learnt)


def test_maps_with_ragged_or_missing_rows_are_refused(learnt):
    for rows in ([], [[0.0]], learnt["exits"]["expected"][:-1], [*learnt["exits"]["expected"][:-1], [1.0]]):
        with pytest.raises(ValueError, match="another size"):
            fusion_of({**learnt, "exits": {**learnt["exits"], "expected": rows}})


# --- which people are written -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("tracker", ["ms-glmb", "lmb", "gnn"])
@pytest.mark.parametrize("lag", [0, 3, math.inf])
def test_who_is_detected_is_observed_and_who_is_not_was_last_seen_before(tracker, lag):
    if tracker == "gnn" and lag:
        pytest.skip("gnn cannot smooth")
    records = list(leavers(1))
    missed = {20, 21, 22}
    for k in missed:
        records[k] = dataclasses.replace(
            records[k], positions=np.empty((0, 3)), covariances=np.empty((0, 3, 3)), scores=np.empty(0)
        )
    tracks = fuse(fusion_of(tracker=tracker, lag=lag), records)
    assert [one.timestamp for one in tracks] == [one.timestamp for one in records]
    for k in range(5, 26):
        assert tracks[k].observed.tolist() == [0.0 if k in missed else 1.0], k
        assert tracks[k].last_seen.tolist() == [pytest.approx(1.9 if k in missed else k / 10)], k


def test_show_decides_who_is_written():
    likely, observed, everybody = (
        fuse(fusion_of(show=show), leavers(1, gone=6.0)) for show in ("likely", "observed", "all")
    )
    for one, two, three in zip(observed, likely, everybody, strict=True):
        assert set(one.ids.tolist()) <= set(two.ids.tolist()) <= set(three.ids.tolist())
        assert (one.observed == 1).all()
        assert ((two.existence > 0.35) | (two.observed == 1)).all()
    count = [sum(map(len, tracks)) for tracks in (observed, likely, everybody)]
    assert count[0] < count[1] < count[2]
    assert min(one.existence.min(initial=1.0) for one in everybody) < 0.35


def test_nobody_is_written_twice_although_he_is_kept_with_several_pasts():
    rng = np.random.default_rng(5)
    records = []
    for k in range(100):
        there = rng.uniform([0, 0], ROOM[1], (rng.poisson(2.0), 2))
        positions = np.column_stack([there, np.zeros(len(there))])
        covariances = np.tile(0.1 * np.eye(3), (len(there), 1, 1))
        records.append(Detections(k / 10, "video", positions, covariances, np.full(len(there), 0.7)))
    for record in fuse(fusion_of(show="all"), records):
        assert len(set(record.ids.tolist())) == len(record)


# --- the picture ------------------------------------------------------------------------------------------------------


def test_the_picture_shows_both_maps_and_is_the_same_each_time(learnt):
    population = Population.of(Settings(), ROOM[1])
    half = Coverage(np.zeros(2), 0.5, np.repeat([[1.0], [0.02]], 8, 0) * np.ones((16, 12)))
    content = picture(learnt, population, {"ceiling": half})
    assert content == picture(learnt, population, {"ceiling": half})
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    left, right = np.split(image[110:470], [740], axis=1)
    for part in (left, right):
        colourful = (np.ptp(part.astype(int), axis=2) > 60).mean()
        assert colourful > 0.3
    assert content != picture(learnt, population, {})
    assert content != picture(fusion_of().state(), population, {"ceiling": half})


def test_a_room_of_any_size_and_no_sensor_give_a_picture():
    for size in ((0.5, 0.5), (4.66, 4.66), (300.0, 2.0), (1e5, 1e5)):
        population = Population.of(Settings(), size)
        assert picture({**Habits(population, True).state(), "sensors": {}}, population, {})[:4] == b"\x89PNG"


@given(some.floats(1e-9, 1e9), some.floats(1.0, 1e9))
def test_the_scale_of_colours_holds_all_values_and_is_a_decade_or_more(low, times):
    values = np.array([low, low * times])
    least, most = bounds(values)
    assert least <= low * (1 + 1e-9)
    assert most >= low * times * (1 - 1e-9)
    assert most / least > 9.9
    assert all(f"{one:.0e}"[0] in "125" for one in ticks(least, most))


# --- the command ------------------------------------------------------------------------------------------------------


def lines(people=2):
    return "".join(
        json.dumps(
            {
                "timestamp": f"{one.timestamp:.10f}",
                "sensor": "ceiling",
                "kind": "camera",
                "objects": [{"position": position} for position in one.positions.tolist()],
            }
        )
        + "\n"
        for one in leavers(people)
    )


@pytest.fixture
def room(tmp_path):
    (tmp_path / "config.json").write_text('{"room_config": {"room_dimensions_m": [8.0, 6.0, 3.0]}}')
    return tmp_path


def avfuse(room, *options, stdin=None):
    result = run("avfuse", "-q", "-c", room / "config.json", *options, stdin=lines() if stdin is None else stdin)
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout


def test_a_file_is_written_used_and_not_changed_without_learning(room):
    file = room / "room.json"
    first = avfuse(room, "--learn", file)
    assert first == avfuse(room)  # of a file that is not there nothing is known
    kept = file.read_bytes()
    second = avfuse(room, "--learn", file, "--no-learn")
    assert file.read_bytes() == kept
    assert second != avfuse(room, "--no-learn")
    avfuse(room, "--learn", file)
    assert file.read_bytes() != kept
    other = room / "other.json"
    avfuse(room, "--learn", other)
    assert other.read_bytes() == kept


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: "{}",
        lambda text: text.replace('"clutter_count":', '"clutter_count":-'),
        lambda text: text.replace('"happened":[[', '"happened":[[1,'),
        lambda text: text.replace('"area":[0.0,0.0,8.0', '"area":[0.0,0.0,9.0'),
        lambda text: text.replace('"returned":', '"returned":null,"x":'),
        lambda text: "\x00\xff",
    ],
)
def test_a_damaged_file_is_refused_in_one_line_and_nothing_is_written(room, damage):
    file, out, drawn = room / "room.json", room / "tracks.jsonl", room / "map.png"
    avfuse(room, "--learn", file)
    file.write_text(damage(file.read_text()))
    before = file.read_bytes()
    options = ("--learn", file, "-o", out, "--map", drawn)
    result = run("avfuse", "-c", room / "config.json", *options, stdin=lines())
    assert result.returncode == 1
    assert result.stderr.startswith(f"avfuse: --learn {file}: ")
    assert result.stderr.count("\n") == 1
    assert file.read_bytes() == before
    assert not out.exists()
    assert not drawn.exists()


def test_a_run_that_fails_keeps_the_file_of_before(room):
    file, drawn = room / "room.json", room / "map.png"
    avfuse(room, "--learn", file)
    before = file.read_bytes()
    options = ("--learn", file, "--map", drawn)
    result = run("avfuse", "-c", room / "config.json", *options, stdin=lines() + "no record\n")
    assert result.returncode == 1
    assert file.read_bytes() == before
    assert sorted(path.name for path in room.iterdir()) == ["config.json", "room.json"]


@pytest.mark.parametrize("option", ["--learn", "--map", "--explain"])
def test_where_a_file_cannot_be_written_the_run_does_not_begin(room, option):
    (room / "in.jsonl").write_text(lines())
    for path in (room / "nowhere" / "x", room / "in.jsonl"):
        result = run("avfuse", room / "in.jsonl", option, path)
        assert result.returncode == 2
        assert option in result.stderr
        assert result.stderr.count("\n") == 1
    assert (room / "in.jsonl").read_text() == lines()


def test_a_map_of_a_run_and_of_its_file_alone(room):
    avfuse(room, "--learn", room / "room.json", "--map", room / "run.png")
    avfuse(room, "--learn", room / "room.json", "--no-learn", "--map", room / "file.png", stdin="")
    run_map, file_map = (cv2.imread(str(room / name)) for name in ("run.png", "file.png"))
    assert run_map.shape == file_map.shape
    assert (run_map != file_map).mean() < 0.02


def test_what_is_learnt_goes_to_a_file(tmp_path):
    """A pipe or /dev/stdout was read first, and avfuse waited for ever."""
    os.mkfifo(tmp_path / "pipe")
    result = run("avfuse", "--learn", tmp_path / "pipe", stdin="")
    assert (result.returncode, result.stdout) == (2, b"")
    assert "pipe: not a file" in result.stderr


def test_a_learnt_file_that_is_only_read_must_exist(tmp_path):
    result = run("avfuse", "--learn", tmp_path / "rom.json", "--no-learn", stdin="")
    assert result.returncode == 2
    assert "rom.json: no such file" in result.stderr


def test_live_records_say_who_is_observed(room):
    *_, last = avfuse(room, "--live", "--show", "observed", stdin="".join(lines(1).splitlines(True)[:20])).splitlines()
    (person,) = json.loads(last)["objects"]
    assert person["observed"] is True
    assert person["last_seen"] == pytest.approx(1.9)


def test_an_account_says_what_is_believed_of_leaving(room):
    avfuse(room, "--explain", room / "why.jsonl", stdin=lines(12))
    accounts = [json.loads(text) for text in (room / "why.jsonl").read_text().splitlines()]
    people = [(one, person) for one in accounts for person in one["people"]]
    assert all(person["last_seen"] <= float(one["timestamp"]) for one, person in people)
    times, rates = np.array([(float(one["timestamp"]) % 4.7, person["leave_rate"]) for one, person in people]).T
    at_door, before = rates[(times > 2.3) & (times < 2.7)], rates[(times > 0.5) & (times < 1.5)]
    assert at_door[-4:].mean() > 3 * before[-10:].mean()
    for one in accounts:
        assert 0 < one["hide_rate"] < math.inf
        assert 0 <= one["blind"] <= 1


# --- a room that is full from the beginning ---------------------------------------------------------------------------


def tracked(records, area):
    """Return how many people are reported after each record of a camera, detections (n, 2) m, ten a second."""
    tracker = GLMB(Settings(), Population(area=((0.0, 0.0), area)), [sensor("ceiling")])
    counts = []
    for k, z in enumerate(records):
        tracker.update(k / 10, "ceiling", z, np.tile(0.0064 * np.eye(2), (len(z), 1, 1)))
        counts.append(sum(one.existence > 0.5 for one in tracker.tracks(k / 10)))
    return counts


@pytest.mark.parametrize("spacing", [0.4, 0.5, 0.8])
def test_a_room_full_of_people_is_told_from_clutter_by_the_second_record(spacing):
    """People are where they were; before, it took seconds until 100 who sit close together were more than clutter."""
    rng = np.random.default_rng(1)
    seats = 1.0 + spacing * np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2)
    area = tuple(seats.max(axis=0) + 1.0)
    records = [(seats + rng.normal(0.0, 0.08, seats.shape))[rng.random(len(seats)) < 0.9] for _ in range(3)]
    assert all(70 <= count <= 105 for count in tracked(records, area)[1:])


@pytest.mark.parametrize("seed", range(3))
def test_a_pressed_crowd_is_told_from_clutter_although_the_noise_is_larger_than_told(seed):
    """Of 100 people .3 m apart 5 to 12 were reported after two seconds: others lie within a body of most of them."""
    rng = np.random.default_rng(seed)
    places = 1.0 + 0.3 * np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2)
    records = [(places + rng.normal(0.0, 0.12, places.shape))[rng.random(len(places)) < 0.9] for _ in range(11)]
    assert 60 <= tracked(records, (4.7, 4.7))[-1] <= 100


@pytest.mark.parametrize("seed", range(3))
def test_clutter_does_not_fill_a_room(seed):
    rng = np.random.default_rng(seed)
    records = [rng.uniform(0.0, 6.0, (60, 2)) for _ in range(4)]
    assert max(tracked(records, (6.0, 6.0))) <= 8


def test_one_person_who_is_detected_often_does_not_fill_a_room():
    rng = np.random.default_rng(2)
    records = [rng.normal(3.0, 0.1, (20, 2)) for _ in range(4)]
    assert max(tracked(records, (6.0, 6.0))) <= 4


@pytest.mark.parametrize("seed", [0, 2, 6])
def test_a_first_record_of_false_detections_does_not_make_a_sensor_that_detects_nobody(seed):
    tracker, rng = GLMB(Settings(), Population(), [sensor("video")]), np.random.default_rng(seed)
    shown = 0
    for k in range(150):
        t = k / 10
        z = rng.uniform(0, (9, 7), (6 if k == 0 else rng.poisson(3.0), 2))
        if t >= 3 and rng.random() < 0.9:
            z = np.vstack([z, [0.2 + 0.3 * (t - 3), 2.3] + 0.1 * rng.standard_normal(2)])
        tracker.update(t, "video", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
        places = [one.state[:2] for one in tracker.tracks(t)]
        shown += t >= 5 and any(np.hypot(x - 0.2 - 0.3 * (t - 3), y - 2.3) < 0.5 for x, y in places)
    assert tracker.rates[0].detection > 0.4
    assert shown >= 99
