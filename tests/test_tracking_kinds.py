"""Sensors that show a direction or a distance, and sensors that cover the area in part."""

import dataclasses
import math

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats import records
from avcli.formats.experiment import Config
from avcli.formats.records import Detections
from avcli.tracking import coverage, partial
from avcli.tracking.densities import Densities
from avcli.tracking.errors import Between
from avcli.tracking.fusion import Fusion
from avcli.tracking.glmb import GLMB
from avcli.tracking.learning import Habits
from avcli.tracking.model import Population
from avcli.tracking.scan import Scan
from avcli.tracking.settings import Settings, sensor
from avcli.tracking.unseen import UnseenMap

ROOM = ((0.0, 0.0), (5.0, 5.0))
HALL = ((0.0, 0.0), (40.0, 25.0))


def detections(time, origin, targets=(), *, name="a", shows="floor", sd=None, kind="microphones"):
    """What a sensor at `origin` finds without error, of targets (x, y, z): "floor" or "space" directions, "range"."""
    away = np.array(targets, float).reshape(-1, 3) - origin
    n = len(away)
    given = {"origins": np.tile(np.array(origin, float), (n, 1))}
    if shows == "range":
        given |= {"ranges": np.linalg.norm(away, axis=1)}
    else:
        directions = away / np.linalg.norm(away * ((1, 1, 0) if shows == "floor" else 1), axis=1, keepdims=True)
        directions[:, 2] = np.nan if shows == "floor" else directions[:, 2]
        given |= {"directions": directions}
    sds = {"range_sds" if shows == "range" else "direction_sds": np.full(n, sd)} if sd else {}
    return Detections(time, name, np.full((n, 3), np.nan), kind=kind, **given, **sds)


def fused(looks, steps=20, **options):
    """Tracks after each step of a fusion; looks: function of the time to what the sensors find."""
    fusion = Fusion(Settings(), population=Population(ROOM), **options)
    return [fusion.step(k / 10, [(k / 10, one.sensor, one) for one in looks(k / 10)])[0] for k in range(steps)]


def test_two_crossing_rays_locate_a_talker():
    tracks = fused(
        lambda t: [
            detections(t, (0.0, 0.0, 1.2), [(2.0, 3.0, 1.5)], name="a"),
            detections(t, (5.0, 0.0, 1.2), [(2.0, 3.0, 1.5)], name="b"),
        ]
    )
    np.testing.assert_allclose(tracks[-1].positions[:, :2], [[2.0, 3.0]], atol=0.05)
    assert tracks[1].ids.tolist() == [0]
    assert (np.linalg.eigvalsh(tracks[-1].covariances[0, :2, :2]) < 0.3**2).all()


@pytest.mark.parametrize(("shows", "height"), [("floor", 1.2), ("range", 2.4)])
def test_one_ray_or_ring_alone_makes_no_track(shows, height):
    tracks = fused(lambda t: [detections(t, (0.0, 0.0, height), [(2.0 + t / 5, 3.0, 1.45)], shows=shows)], 50)
    assert not any(len(one) for one in tracks)


def test_distances_from_three_anchors_locate_a_person():
    anchors = [(0.0, 0.0, 2.4), (5.0, 0.0, 2.4), (2.5, 5.0, 2.4)]
    tracks = fused(
        lambda t: [
            detections(t, at, [(1.0, 2.0, 1.0)], name=f"tag{k}", shows="range", sd=0.1, kind="camera")
            for k, at in enumerate(anchors)
        ]
    )
    np.testing.assert_allclose(tracks[-1].positions[:, :2], [[1.0, 2.0]], atol=0.1)


def test_a_camera_shows_where_on_a_ray_the_talker_is():
    def looks(t):
        seen = Detections(t, "video", np.array([[2.0, 3.0, np.nan]]), kind="camera")
        return [detections(t, (0.0, 0.0, 1.2), [(2.0, 3.0, 1.5)]), seen]

    track = fused(looks)[-1]
    np.testing.assert_allclose(track.positions[:, :2], [[2.0, 3.0]], atol=0.1)
    assert track.speaking[0] > 0.8


def test_ghosts_of_two_talkers_end_when_one_is_silent():
    """Two talkers and two arrays: four crossings, of which two are nobody."""
    talkers = [(1.0, 3.0, 1.5), (3.5, 3.5, 1.5)]

    def looks(t):
        heard = talkers[: 1 if t < 1 else 2]
        return [detections(t, (0.0, 0.0, 1.2), heard, name="a"), detections(t, (5.0, 0.0, 1.2), heard, name="b")]

    track = fused(looks, 40)[-1]
    np.testing.assert_allclose(sorted(track.positions[:, :2].tolist()), [one[:2] for one in talkers], atol=0.15)


def test_a_direction_with_a_range_is_a_position():
    one = detections(0.0, (1.0, 1.0, 1.0), [(3.0, 2.0, 1.0)], shows="space", sd=0.01)
    both = Detections(
        0.0, "a", one.positions, origins=one.origins, directions=one.directions, ranges=np.array([5**0.5])
    )
    model = sensor("a")
    found, cov, shown = partial.read(
        [both], both.positions[:, :2], both.covariances[:, :2, :2], model, Population(ROOM)
    )
    assert shown is None
    np.testing.assert_allclose(found, [[3.0, 2.0]])
    along = np.array([2.0, 1.0]) / 5**0.5
    assert along @ cov[0] @ along == pytest.approx(model.range_sd**2, rel=0.01)


@pytest.mark.parametrize("across", [0.0, 1e-9, -1e-6, 3e-5, -2e-3])
def test_a_direction_that_misses_the_area_stands_for_its_origin(across):
    """The line cuts both sides of the area outside of it, one of them ever farther away."""
    look = np.array([[1.0, across, 0.0]]) / np.hypot(1.0, across)
    one = Detections(
        0.0, "a", np.full((1, 3), np.nan), origins=np.array([[150.0, 250.0, 1.5]]), directions=look,
        direction_sds=np.array([0.02])
    )  # fmt: skip
    place, _, shown = partial.read(
        [one], one.positions[:, :2], one.covariances[:, :2, :2], sensor("a"), Population(ROOM)
    )
    assert shown is not None
    np.testing.assert_array_equal(place, [[150.0, 250.0]])


def people(centre, spread=0.2):
    """One person whose place is about known, of one motion model."""
    cov = np.diag([spread**2, spread**2, 0.3, 0.3])
    ones, place = np.ones((1, 1)), np.array([centre], float)
    return Densities(
        mean=np.array([[[*centre, 0.2, 0.1]]]), cov=cov[None, None], mode=ones, existence=np.ones(1),
        detectable=ones.copy(), lean=np.zeros((1, 1)), seen=np.zeros((1, 1)), place=place, hits=np.ones((1, 1)),
        told=np.zeros(1), counted=np.zeros((1, 1)), doubt=np.zeros((1, 1)), reach=np.ones(1),
        common=np.zeros((1, 2, 2)), label=[0], node=[None],
    )  # fmt: skip


def looked(one, person, model, hold=1.0):
    """Likelihood of a detection, and the person after it."""
    parts = [one]
    _, _, shown = partial.read(parts, one.positions[:, :2], one.covariances[:, :2, :2], model, Population(ROOM))
    seen = partial.view(shown, person, model, np.full(1, hold))
    likelihood = partial.likelihoods(seen, person)
    after = partial.update(person, seen, [(0, 0)], likelihood[:, :, 0])
    return likelihood[0, 0, 0], after


places = st.tuples(st.floats(-4, 4), st.floats(-4, 4))


@given(places, places, st.floats(-math.pi, math.pi), places, st.sampled_from(["floor", "space", "range"]))
@settings(max_examples=60, deadline=None)
def test_turning_and_moving_the_world_turns_and_moves_the_result(at, target, angle, shift, shows):
    """There is no seam at 180 degrees, and no pole."""
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    if math.dist(at, target) < 0.3:
        return
    whole = np.eye(4)
    whole[:2, :2] = whole[2:, 2:] = turn
    model, there = sensor("a"), np.array(target) + 0.1
    one = looked(detections(0.0, (*at, 2.0), [(*target, 1.1)], shows=shows), people(there), model)
    moved = people(turn @ there + shift)
    moved.mean[..., 2:] = turn @ (0.2, 0.1)
    new_at, new_target = turn @ at + shift, turn @ target + shift
    other = looked(detections(0.0, (*new_at, 2.0), [(*new_target, 1.1)], shows=shows), moved, model)
    assert other[0] == pytest.approx(one[0], rel=0.05, abs=1e-6)  # the cubature points turn with the axes
    mean, cov = one[1][0][0, 0], one[1][1][0, 0]
    np.testing.assert_allclose(other[1][0][0, 0, :2], turn @ mean[:2] + shift, atol=0.01)
    np.testing.assert_allclose(other[1][1][0, 0], whole @ cov @ whole.T, atol=0.02)


@given(places, places, st.sampled_from(["floor", "space", "range"]))
@settings(max_examples=60, deadline=None)
def test_who_exchanges_x_and_y_gets_the_same_result(at, target, shows):
    """The cubature points lie alike along both axes, however long the covariance is across them."""
    if math.dist(at, target) < 0.3:
        return
    model, there, swap = sensor("a"), np.array(target) + 0.1, [1, 0, 3, 2]
    person, other = people(there), people(there[::-1])
    person.cov[..., :2, :2] = [[0.3, 0.1], [0.1, 0.05]]
    other.cov[..., :2, :2] = [[0.05, 0.1], [0.1, 0.3]]
    other.mean[..., 2:] = (0.1, 0.2)
    one = looked(detections(0.0, (*at, 2.0), [(*target, 1.1)], shows=shows), person, model)
    two = looked(detections(0.0, (*at[::-1], 2.0), [(*target[::-1], 1.1)], shows=shows), other, model)
    assert two[0] == pytest.approx(one[0], rel=1e-6, abs=1e-12)
    np.testing.assert_allclose(two[1][0][0, 0][swap], one[1][0][0, 0], atol=1e-6)
    np.testing.assert_allclose(two[1][1][0, 0][np.ix_(swap, swap)], one[1][1][0, 0], atol=1e-6)


@pytest.mark.parametrize("shows", ["floor", "space", "range"])
@pytest.mark.parametrize("centre", [(0.0, 0.0), (1e-9, 0.0), (0.0, 0.05), (4.0, 0.0)])
@pytest.mark.parametrize("sd", [1e-9, 0.05, 3.0])
def test_the_result_is_finite_and_no_surer_than_before_wherever_the_person_is(shows, centre, sd):
    seen = detections(0.0, (0.0, 0.0, 2.5), [(0.3, 0.0, 1.45)], shows=shows, sd=sd)
    before = people(centre)
    likelihood, (mean, cov, mode) = looked(seen, before, sensor("a", "microphones"))
    assert np.isfinite(likelihood)
    assert np.isfinite(mean).all()
    assert np.isfinite(mode).all()
    ends = np.linalg.eigvalsh(cov[0, 0])
    assert ends[0] > 0
    assert np.linalg.eigvalsh(before.cov[0, 0] - cov[0, 0])[0] > -1e-9


def test_a_person_on_the_other_side_of_the_sensor_did_not_cause_the_detection():
    for angle in np.linspace(-math.pi, math.pi, 9):
        target = (3 * math.cos(angle), 3 * math.sin(angle), 1.5)
        seen = detections(0.0, (0.0, 0.0, 1.2), [target])
        assert looked(seen, people(target[:2]), sensor("a"))[0] > 1.0
        assert looked(seen, people((-target[0], -target[1])), sensor("a"))[0] < 1e-6


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1e-12, 0.0, -1.0)])
def test_a_vertical_direction_is_somebody_below(direction):
    def looks(t):
        one = np.array([direction])
        nothing = np.full((1, 3), np.nan)
        return [Detections(t, "a", nothing, kind="microphones", origins=np.array([[2.0, 2.0, 2.6]]), directions=one)]

    tracks = fused(looks)
    if direction[2] > 0:
        assert not len(tracks[-1])
    else:
        np.testing.assert_allclose(tracks[-1].positions[:, :2], [[2.0, 2.0]], atol=0.2)


def test_a_distance_beyond_the_room_is_nobody():
    far = [(9.0, 9.0, 1.0)]
    for tracks in fused(lambda t: [detections(t, (0.0, 0.0, 2.4), far, shows="range")]):
        assert not len(tracks)


def test_the_order_of_detections_makes_no_difference():
    targets = [(1.0, 3.0, 1.5), (4.0, 2.0, 1.5), (2.5, 4.0, 1.5)]

    def looks(t, order):
        heard = [targets[k] for k in order]
        return [detections(t, (0.0, 0.0, 2.4), heard, shows="space"), detections(t, (5.0, 0.0, 2.4), heard, name="b")]

    one, other = (fused(lambda t, order=order: looks(t, order)) for order in ((0, 1, 2), (2, 0, 1)))
    for a, b in zip(one, other, strict=True):
        assert records.encode(records.as_record(a)) == records.encode(records.as_record(b))


def test_a_tracker_without_directions_says_so():
    fusion = Fusion(Settings(), "gnn")
    with pytest.raises(
        ValueError, match="sensor 'a' has a direction or a range without a position: use --tracker ms-glmb"
    ):
        fusion.step(0.0, [(0.0, "a", detections(0.0, (0, 0, 1), [(1, 1, 1)]))])


@pytest.mark.parametrize("wrong", [1e150, -2e6, np.nan])
def test_a_position_that_is_no_place_is_refused(wrong):
    fusion = Fusion(Settings())
    with pytest.raises(ValueError, match="sensor 'v': a position must be within 1e"):
        fusion.step(0.0, [(0.0, "v", Detections(0.0, "v", np.array([[wrong, 1.0, 0.0]]), kind="camera"))])


# --- records ----------------------------------------------------------------------------------------------------------


def line(**one):
    return records.detections({"timestamp": 0.0, "sensor": "a", "objects": [one]})


def test_a_record_keeps_directions_and_ranges():
    found = line(origin=[0, 0, 2], direction=[0.6, 0.8, 0], direction_sd_deg=5)
    assert np.isnan(found.positions).all()
    np.testing.assert_allclose(found.direction_sds, np.radians(5))
    again = records.as_record(found)["objects"]
    assert again == [{"origin": [0, 0, 2], "direction": [0.6, 0.8, 0], "direction_sd_deg": pytest.approx(5)}]
    assert records.as_record(line(origin=[0, 0], direction=[0, 1]))["objects"] == [
        {"origin": [0, 0, None], "direction": [0, 1]}
    ]
    assert records.as_record(line(origin=[0, 0, 1], range_m=2, range_sd_m=0.1))["objects"][0]["range_m"] == 2
    assert len(line(origin=[0, 0, 1], range_m=2).located()) == 0


@pytest.mark.parametrize(
    ("one", "words"),
    [
        ({}, '"position" is missing, and there is no direction or range_m'),
        ({"position": [1, 2], "direction": [1, 0]}, '"origin" is missing beside direction'),
        ({"range_m": 1}, '"origin" is missing beside range_m'),
        ({"origin": [0, 0], "direction": [0, 0]}, '"direction" must be a list of two or three numbers .* not all 0'),
        ({"origin": [0, 0], "direction": [3, 4]}, '"direction" must be'),
        ({"origin": [0, 0], "direction": [1, 0], "direction_sd_deg": 0}, '"direction_sd_deg" must be a number above 0'),
        ({"origin": [0, 0], "range_m": -1}, '"range_m" must be a number from 0'),
    ],
)
def test_a_wrong_direction_or_range_is_named(one, words):
    with pytest.raises(records.RecordError, match=rf"objects\[0\]: {words}"):
        line(**one)


# --- coverage ---------------------------------------------------------------------------------------------------------


def config(**named):
    return Config({"room_config": {"room_dimensions_m": [10, 6, 3]}, "sensors": named})


def test_each_sensor_has_the_coverage_that_config_json_states():
    eye = {"camera_position_m": [7, 3, 3], "lens_model": "kannala_brandt", "fx_px": 500, "fy_px": 500}
    eye |= {"cx_px": 499.5, "cy_px": 499.5, "image_width_px": 1000, "image_height_px": 1000}
    known = config(
        west={"kind": "camera", "covers": {"polygon_m": [[0, 0], [4, 0], [4, 6], [0, 6]]}},
        east={"kind": "camera", "camera_config": eye},
        ring={"kind": "microphones", "covers": {"disc_m": [5, 3, 2]}},
        far={"kind": "microphones"},
    )
    found, notes = coverage.of_config(known, ((0.0, 0.0), (10.0, 6.0)))
    assert not notes
    sensors = [sensor(name, coverage=found.get(name)) for name in known.sensors]
    seen = coverage.covered(np.array([[2.0, 3.0], [8.0, 3.0], [5.0, 4.0]]), sensors)
    least = coverage.LEAST
    np.testing.assert_allclose(seen, [[1, least, least, 1], [least, 1, least, 1], [least, seen[2, 1], 1, 1]])
    assert found["west"].surface == pytest.approx(24 + 36 * least, rel=0.02)
    assert found["ring"].surface == pytest.approx(4 * math.pi + least * (60 - 4 * math.pi), rel=0.02)


def test_the_height_of_what_a_sensor_localizes_comes_from_config_json():
    fusion = Fusion.of(config(tag={"kind": "camera", "height_m": 1.3, "height_sd_m": 0.1}), Settings())
    fusion.step(0.0, [(0.0, "tag", detections(0.0, (0, 0, 2), name="tag"))])
    assert (fusion.tracker.sensors[0].height, fusion.tracker.sensors[0].height_sd) == (1.3, 0.1)


def look(model, column=0):
    """An empty record of a sensor that detects 0.9 of those whom it can."""
    nothing = np.zeros((0, 2))
    none, between = np.zeros(0), Between(np.zeros(0), np.zeros(0))
    noise = np.zeros((0, 2, 2))
    seen = [], None, [], np.zeros((0, 1, 6)), nothing, nothing, [], {}, [], [], []
    return Scan(model, column, nothing, noise, none, None, 0.0, between, *seen, 1.0, 0.0, [], 0.9, 0.9, [], [], [])


def half_seen():
    """A camera that sees the western half of an area of 20 x 10 m."""
    share = np.full((200, 100), coverage.LEAST)
    share[:100] = 1.0
    return sensor("v", coverage=coverage.Coverage(np.zeros(2), 0.1, share))


def test_few_people_are_left_undetected_where_a_sensor_looks_and_they_come_in_at_the_border():
    area = ((0.0, 0.0), (20.0, 10.0))
    model, population = half_seen(), Population(area, appear=0.0)
    unseen = UnseenMap(population, Habits(population, False), [model])
    before = unseen.number.sum()
    unseen.predict(0.1)
    assert unseen.number.sum() == pytest.approx(before * math.exp(-0.1 / population.stay) + 0.05 * 0.1)
    for _ in range(100):
        unseen.update(look(model))
        unseen.predict(0.1)
        unseen.relax(np.array([model.detectable()]), np.array([0.9]))
    inside, border, outside = unseen.density(np.array([[4.0, 5.0], [9.7, 5.0], [16.0, 5.0]]))
    assert inside < border < outside
    assert inside < 0.1 * outside
    for places in (np.array([[-5.0, 0.0], [50.0, 9.0]]), np.array([[4.0, 5.0]])):
        assert np.isfinite(unseen.density(places)).all()
        able = unseen.detectable_at(places)
        assert ((able >= 0) & (able <= 1)).all()
    assert unseen.number[unseen.centres.reshape(*unseen.shape, 2)[..., 0] > 10].sum() > 0.5  # they have not left


@pytest.mark.parametrize("room", [(0.001, 0.001), (0.001, 2.0), (4.66, 4.66), (1e4, 1e4), (1e4, 3.0)])
def test_people_are_expected_in_a_room_of_any_size(room):
    population = Population(((0.0, 0.0), room))
    unseen = UnseenMap(population, Habits(population, False), [])
    assert unseen.area.sum() == pytest.approx(room[0] * room[1])
    assert unseen.number.sum() == pytest.approx(population.present)
    assert unseen.arrivals.sum() == pytest.approx(population.arrivals)
    assert unseen.arrivals.min() >= 0


def test_who_is_out_of_sight_for_long_cannot_be_told_from_others_and_is_counted_among_them():
    tracker = GLMB(Settings(), Population(((0.0, 0.0), (20.0, 10.0))), [half_seen()])
    for k in range(20):  # a person walks out of the picture
        tracker.update(k / 10, "v", np.array([[8.05 + k / 10, 5.0]]), 0.01 * np.eye(2)[None])
    for k in range(20, 25):
        tracker.update(k / 10, "v", np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert [one.label for one in tracker.tracks(2.4)] == [0]
    while tracker.labelled():
        k, before = k + 1, tracker.undetected.number.sum()
        tracker.update(k / 10, "v", np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert k < 150
    assert tracker.undetected.number.sum() > before + 0.1
    assert tracker.habits.exits.happened.sum() == 0
    for k in range(200, 205):
        tracker.update(k / 10, "v", np.array([[10.0 - (k - 200) / 10, 5.0]]), 0.01 * np.eye(2)[None])
    assert [one.label for one in tracker.tracks(20.4)] == [1]


def test_how_many_are_out_of_sight_is_learnt_from_those_who_come_into_the_picture():
    tracker = GLMB(Settings(), Population(((0.0, 0.0), (20.0, 10.0))), [half_seen()])
    for k in range(600):  # every 5 s somebody walks in, and out again
        step = k % 50
        at = 10.0 - (min(step, 40 - step) + 1) / 10
        z = np.array([[at, 2.0 + (k // 50) % 6]]) if step < 40 else np.zeros((0, 2))
        tracker.update(k / 10, "v", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
    happened, expected = tracker.habits.entries.happened.sum(), tracker.habits.entries.expected.sum()
    assert 8 <= happened <= 12
    assert expected < happened
    assert tracker.habits.entries.at(np.array([[9.8, 5.0]])) > 1.5


def test_what_is_learnt_of_a_sensor_that_covers_a_part_can_be_written():
    disc = coverage.of_place({"polygon_m": None, "disc_m": [3.0, 2.0, 2.0]}, HALL)
    tracker = GLMB(Settings(), Population(HALL), [dataclasses.replace(sensor("ceiling"), coverage=disc)])
    for k in range(30):  # missed now and then
        z = np.array([[3.0, 2.0]])[: k % 4]
        tracker.update(k / 10, "ceiling", z, np.tile(0.01 * np.eye(2), (len(z), 1, 1)))
    assert orjson.loads(orjson.dumps(tracker.state()))["sensors"]["ceiling"]["hit_count"] > 10
