"""Positions of people: from depth against bodies cast ray by ray, from boxes alone, and where nothing can be known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detection_people import KB8, cast, ceiling_view
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.detection.body import Person, beyond_trust
from avcli.detection.depth import DepthDetector, place_centre, separate
from avcli.detection.fitted import BOX
from avcli.detection.frozen import Frozen
from avcli.detection.gate import LEARNING, Gate
from avcli.detection.monocular import Fitted
from avcli.detection.mounting import Mounting
from avcli.detection.network import Boxes
from avcli.detection.overlay import draw
from avcli.detection.view import View
from avcli.lens import BrownConrady, Division, KannalaBrandt
from avcli.pose import camera_pose

CEILING = camera_pose([2.33, 2.33, 2.5], [90, 0, 0])


@pytest.fixture(scope="module")
def view():
    return ceiling_view(4)


@pytest.fixture(scope="module")
def background(view):
    return cast(view)


@pytest.fixture(scope="module")
def detector(view, background):
    return DepthDetector(view, background)


def box_of(depth, background):
    rows, columns = np.nonzero((depth > 0) & (depth < background - 0.03))
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], float)


def placed_at(radius, azimuth, seed):
    rng = np.random.default_rng(seed)
    x, y = 2.33 + radius * np.cos(azimuth), 2.33 + radius * np.sin(azimuth)
    return x, y, rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5), rng.uniform(1.55, 1.9)


# --- the camera -------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 1919), st.floats(0, 1079))
def test_a_pixels_ray_projects_onto_the_pixel(u, v):
    view = ceiling_view(1, stride=4)
    ray = view.unproject(np.array([[u, v]]))
    assert np.allclose(view.project(view.origin + 2.0 * ray), [[u, v]], atol=1e-8)


def test_samples_rays_and_indices_belong_together():
    view = ceiling_view(1, stride=4)
    v, u = np.mgrid[:1080, :1920]
    columns, rows = view.sampled(u), view.sampled(v)
    assert view.rays.shape[:2] == columns.shape == (270, 480)
    pixels = np.stack([columns[10, 20], rows[10, 20]])[None].astype(float)
    assert view.sample_indices(pixels).tolist() == [[20, 10]]
    assert np.allclose(view.rays[10, 20], view.unproject(pixels)[0], atol=1e-6)
    assert view.sample_indices(np.array([[-0.5, -0.5], [1919.4, 1079.4]])).tolist() == [[0, 0], [479, 269]]


def test_solid_angles_add_up():
    view = View(KannalaBrandt(100.0, 100.0, 199.5, 199.5), camera_pose([0, 0, 2.5], [90, 0, 0]), (400, 400), 1.0, 1)
    assert view.solid_angles.sum() == pytest.approx(2 * np.pi * (1 - np.cos(1.0)), rel=0.02)


def test_depth_along_the_axis_and_along_the_ray_agree(view):
    radial = np.full((270, 480), 20000, np.uint16)
    along = np.rint(radial * np.where(view.cosines > 0, view.cosines, 0)).astype(np.uint16)
    metres = view.radial_depth(radial, 1e-4), view.radial_depth(along, 1e-4, "z")
    steep = view.cosines > 0.3
    assert np.allclose(metres[0][steep], metres[1][steep], atol=3e-4)


def test_what_was_not_measured_is_no_depth(view):
    picture = np.zeros((270, 480), np.uint8)
    picture[0, :2] = 255, 7
    assert view.radial_depth(picture, 0.02)[0, :3].tolist() == [0.0, pytest.approx(0.14), 0.0]


def test_rays_beyond_the_lens_are_none():
    fold = View(BrownConrady(596.43, 596.43, 960, 540, -0.2), camera_pose([0, 0, 2.5], [90, 0, 0]), (1920, 1080))
    assert np.isnan(fold.unproject(np.array([[960 + 514.0, 540.0]]))).all()
    assert np.isfinite(fold.unproject(np.array([[960 + 510.0, 540.0]]))).all()
    narrow = View(fold.lens, camera_pose([0, 0, 2.5], [90, 0, 0]), (1920, 1080), theta_max=0.5)
    assert np.isnan(narrow.unproject(np.array([[960 + 510.0, 540.0]]))).all()


def test_what_light_does_not_reach_has_no_ray():
    lit = View(KannalaBrandt(300.0, 300.0, 511.5, 511.5), CEILING, (1024, 1024), circle=(500.0, 520.0, 400.0))
    pixels = np.array([[500.0, 520.0], [890.0, 520.0], [910.0, 520.0], [np.nan, 0.0]])
    assert np.isfinite(lit.unproject(pixels)).all(1).tolist() == [True, True, False, False]
    assert lit.inside(pixels).tolist() == [True, True, False, False]
    assert np.isfinite(lit.rays).all(2).mean() == pytest.approx(np.pi * 400**2 / 1024**2, rel=0.01)


@pytest.mark.parametrize("method", ["depth", "monocular"])
def test_people_beyond_the_trusted_angle_stay_and_are_less_certain(method):
    known = View(KannalaBrandt(300.0, 300.0, 511.5, 511.5), CEILING, (1024, 1024), theta_trusted=np.deg2rad(50))

    def person(radius):
        covariance = np.diag([0.01, 0.01, 0.25])
        return Person(known.origin + np.array([radius, 0.0, -1.6]), covariance, 0.9, np.zeros(4), 1.7, method)

    near, far, farther = (beyond_trust(person(radius), known) for radius in (1.0, 3.0, 6.0))
    assert near.covariance[0, 0] == 0.01
    excess = np.arctan2(3.0, 1.6) - np.deg2rad(50)
    distance = np.hypot(3.0, 1.6)
    along = distance * 0.2 * excess * (1 if method == "depth" else distance / 1.6)
    assert far.covariance[0, 0] == pytest.approx(0.01 + along**2)
    assert far.covariance[1, 1] == pytest.approx(0.01 + (distance * 0.2 * excess) ** 2)
    assert farther.covariance[0, 0] > far.covariance[0, 0]
    assert np.linalg.eigvalsh(farther.covariance).min() > 0


# --- depth ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("azimuth", [0.0, np.pi])
def test_the_axis_of_a_body_within_six_centimetres_on_average(view, detector, radius, azimuth):
    errors = []
    for seed in range(4):
        person = placed_at(radius, azimuth, seed)
        (found,) = detector.detect(cast(view, [person]))
        errors.append(found.position[:2] - person[:2])
        assert found.height is None or found.height == pytest.approx(person[4], abs=0.06)
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.06
    assert np.linalg.norm(errors, axis=1).max() < 0.13


def test_somebody_under_the_camera_has_a_position(view, detector):
    (found,) = detector.detect(cast(view, [(2.33, 2.33, 0.3, 0.2, 1.75)]))
    assert np.linalg.norm(found.position[:2] - 2.33) < 0.02
    assert np.isfinite(found.covariance).all()


def test_a_headless_body_at_the_border_is_found_by_its_legs(view, detector):
    person = (2.33, 3.55, 0.0, 0.3, 1.75)
    (found,) = detector.detect(cast(view, [person]))
    assert np.linalg.norm(found.position[:2] - person[:2]) < 0.15
    assert found.height is None


def test_two_who_touch_are_two(view, detector):
    people = [(1.6, 2.30, 0.0, 0.2, 1.75), (1.6, 2.80, 0.0, -0.2, 1.65)]
    found = detector.detect(cast(view, people))
    assert len(found) == 2
    for person in people:
        assert min(np.linalg.norm(one.position[:2] - person[:2]) for one in found) < 0.10


def test_one_who_hides_the_other_does_not_move_them(view, detector):
    people = [(3.2, 2.33, np.pi / 2, 0.0, 1.8), (3.9, 2.33, np.pi / 2, 0.0, 1.8)]
    found = sorted(detector.detect(cast(view, people)), key=lambda one: one.position[0])
    assert len(found) == 2
    assert np.linalg.norm(found[0].position[:2] - people[0][:2]) < 0.10
    assert np.linalg.norm(found[1].position[:2] - people[1][:2]) < 0.25


def test_an_empty_room_is_empty(view, detector, background):
    noise = np.random.default_rng(0)
    for _ in range(20):
        assert detector.detect(np.where(background > 0, background + noise.normal(0, 0.01, background.shape), 0)) == []


def test_furniture_that_was_moved_is_nobody(view, detector, background):
    seat = np.array([2.9, 2.7, 0.45])
    t = (seat[2] - view.origin[2]) / view.rays[..., 2]
    points = view.origin + t[..., None] * view.rays
    chair = (np.abs(points[..., :2] - seat[:2]) < 0.25).all(axis=2)
    assert detector.detect(np.where(chair, t, background).astype(np.float32)) == []


def test_depth_without_numbers_finds_nobody(view, detector, background):
    assert detector.detect(np.zeros_like(background)) == []
    assert detector.detect(np.full_like(background, 1e-4)) == []


def test_salt_in_the_depth_is_nobody_and_moves_nobody(view, detector):
    person = (1.5, 2.0, 1.0, 0.2, 1.75)
    depth = cast(view, [person])
    rng = np.random.default_rng(0)
    hit = rng.random(depth.shape) < 0.01
    depth[hit] = rng.uniform(0.5, 3.0, hit.sum())
    (found,) = detector.detect(depth)
    assert np.linalg.norm(found.position[:2] - person[:2]) < 0.10


@settings(max_examples=25, deadline=None)
@given(st.floats(0.4, 4.2), st.floats(1.2, 3.4), st.floats(0, 6.3), st.integers(0, 100))
def test_covariances_are_positive_and_boxes_lie_on_the_picture(x, y, yaw, seed):
    view = ceiling_view(8)
    detector = DepthDetector(view, cast(view))
    for found in detector.detect(cast(view, [(x, y, yaw, 0.3, 1.5 + seed / 250)])):
        assert np.allclose(found.covariance, found.covariance.T)
        assert np.linalg.eigvalsh(found.covariance)[0] > 0
        assert found.covariance[2, 2] >= 0.2
        assert (found.bbox_px >= 0).all()
        assert (found.bbox_px <= [240, 135, 240, 135]).all()
        assert 0 < found.score < 1


def test_error_and_covariance_agree(view, detector):
    distances = []
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        person = (rng.uniform(0.4, 4.2), rng.uniform(1.3, 3.3), rng.uniform(0, 6.28), rng.uniform(-0.5, 0.5), 1.75)
        found = detector.detect(cast(view, [person]))
        assert len(found) == 1
        error = found[0].position[:2] - person[:2]
        distances.append(error @ np.linalg.solve(found[0].covariance[:2, :2], error))
    assert 0.5 < np.mean(distances) < 4.0  # 2 is what a perfect covariance gives


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal([1, 1, 1], 0.1, (200, 3)), rng.normal([2, 1, 1], 0.1, (200, 3))])
    order = rng.permutation(400)
    first, second = separate(points, np.full(400, 1e-3)), separate(points[order], np.full(400, 1e-3))
    assert [set(member.tolist()) for member in first] == [set(order[member].tolist()) for member in second]
    assert len(first) == 2


# --- a network's boxes ------------------------------------------------------------------------------------------------


def test_boxes_with_depth_take_the_body_in_them(view, detector, background):
    people = [(1.2, 2.0, 0.0, 0.2, 1.75), (3.4, 2.6, 2.0, -0.3, 1.65)]
    depth = cast(view, people)
    boxes = np.array([box_of(cast(view, [person]), background) for person in people])
    for one in (detector, DepthDetector(view, None)):
        found = one.place(Boxes(boxes, np.array([0.9, 0.8])), depth)
        assert [person.method for person in found] == ["depth", "depth"]
        assert [person.score for person in found] == [0.9, 0.8]
        for person, body in zip(found, people, strict=True):
            assert np.linalg.norm(person.position[:2] - body[:2]) < 0.10


def test_two_boxes_that_overlap_give_two_points(view, detector, background):
    people = [(1.5, 2.30, 0.0, 0.2, 1.75), (1.5, 2.75, 0.0, -0.2, 1.65)]
    boxes = np.array([box_of(cast(view, [person]), background) for person in people])
    found = detector.place(Boxes(boxes, np.array([0.9, 0.9])), cast(view, people))
    for person, body in zip(found, people, strict=True):
        assert np.linalg.norm(person.position[:2] - body[:2]) < 0.12


def test_a_box_on_the_empty_room_is_nobody_where_depth_shows_it(view, detector, background):
    found = Boxes(box_of(cast(view, [(1.2, 2.0, 0.0, 0.2, 1.75)]), background)[None], np.array([0.9]))
    assert detector.place(found, background) == []
    assert len(detector.place(found, None)) == 1
    assert len(detector.place(found, np.zeros_like(background))) == 1


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0, 1.5, 2.0])
def test_a_box_alone_places_within_fifteen_centimetres(view, background, radius):
    people = np.array([placed_at(radius, seed * np.pi / (14 if radius < 1.2 else 40), seed) for seed in range(8)])
    found = Fitted(np.array([box_of(cast(view, [person]), background) for person in people]), view).places()
    away = found.positions - people[:, :2]
    errors = np.linalg.norm(away, axis=1)
    assert np.median(errors) < 0.15
    assert np.max(errors) < 0.35
    assert np.mean(np.einsum("ni,nij,nj->n", away, np.linalg.inv(found.covariances), away)) < 6.0
    assert found.explained.all()
    assert ((found.heights > 1.1) & (found.heights < 2.1)).all()


def test_a_batch_says_what_each_box_says_alone(view, background):
    boxes = np.array([box_of(cast(view, [placed_at(r, r, 0)]), background) for r in (0.5, 1.5)] + [[9, 9, 470, 260]])
    many = Fitted(boxes, view).places()
    for index, box in enumerate(boxes):
        alone = Fitted(box[None], view).places()
        assert np.allclose(alone.positions[0], many.positions[index], atol=2e-3)
        assert alone.explained[0] == many.explained[index]


def test_parts_sharpen_the_place(view, background):
    person = (3.5, 2.4, 1.0, 0.3, 1.75)
    axis = np.array([[person[0], person[1], z] for z in (0.54 * 1.75, 0.93 * 1.75, 0.0)])
    box = box_of(cast(view, [person]), background)[None]
    found = Fitted(box, view, view.project(axis)[None] + 0.5).places()
    assert np.linalg.norm(found.positions[0] - person[:2]) < 0.05
    assert found.heights[0] == pytest.approx(1.75, abs=0.06)
    assert np.trace(found.covariances[0]) < np.trace(Fitted(box, view).places().covariances[0])


def test_legs_that_a_network_overlooks_move_nobody_far(view, background):
    person = (3.7, 2.33, 1.0, 0.3, 1.75)
    axis = np.array([[person[0], person[1], z] for z in (0.54 * 1.75, 0.93 * 1.75, 0.0)])
    box, parts = box_of(cast(view, [person]), background)[None], view.project(axis)[None] + 0.5
    away = view.below - box.reshape(2, 2).mean(axis=0)
    overlooked = 0.12 * np.sqrt((box[0, 2:] - box[0, :2]).prod()) * away / np.linalg.norm(away)
    box = box - np.concatenate([np.minimum(overlooked, 0), np.maximum(overlooked, 0)])
    parts = parts - np.array([0.5, 0.0, 1.0])[:, None] * overlooked
    whole = replace(BOX, short=0.0, short_spread=1e-6)
    errors = []
    for law in (BOX, whole):
        found = Fitted(box, view, parts, law=law, scores=np.array([0.9])).places()
        error = found.positions[0] - person[:2]
        errors.append((np.linalg.norm(error), error @ np.linalg.solve(found.covariances[0], error)))
    assert errors[0][0] < 0.7 * errors[1][0]
    assert errors[0][1] < min(errors[1][1], 5.99)


@pytest.mark.parametrize("height", [0.9, 1.1, 1.3])
def test_a_child_is_placed(view, background, height):
    person = (3.5, 2.4, 1.0, 0.3, height)
    found = Fitted(box_of(cast(view, [person]), background)[None], view).places()
    away = found.positions[0] - person[:2]
    assert found.seen[0]
    assert away @ np.linalg.solve(found.covariances[0], away) < 9.0


def test_a_turned_box_says_more_than_an_upright_one(view, background):
    """The axes of the turned box are those of the body, whose picture points away from the camera's foot."""
    person = (3.2, 3.2, 0.7, 0.2, 1.75)
    rows, columns = np.nonzero(cast(view, [person]) < background - 0.02)
    pixels = np.column_stack([columns, rows]) + 0.5
    turn = np.pi / 2 + np.arctan2(*(view.project(np.array([[*person[:2], 0.9]]))[0] - [262.0, 137.8])[::-1])
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    ends = np.array([(pixels @ axes.T).min(axis=0) - 0.5, (pixels @ axes.T).max(axis=0) + 0.5])
    middle, half = axes.T @ ends.mean(axis=0), (ends[1] - ends[0]) / 2
    found = Fitted(np.concatenate([middle - half, middle + half])[None], view, turns=np.array([turn])).places()
    upright = Fitted(box_of(cast(view, [person]), background)[None], view).places()
    assert np.linalg.norm(found.positions[0] - person[:2]) < 0.1
    assert np.linalg.det(found.covariances[0]) < np.linalg.det(upright.covariances[0])


def test_a_box_that_no_body_fills_is_placed_and_marked(view):
    found = Fitted(np.array([[200.0, 100.0, 215.0, 115.0], [100.0, 10.0, 370.0, 260.0]]), view).places()
    assert found.seen.all()
    assert not found.explained.any()
    assert np.isnan(found.heights).all()
    assert (np.sqrt(np.linalg.eigvalsh(found.covariances)[:, 0]) >= 0.2).all()


def test_a_lying_person_is_placed_within_what_is_said(view, background):
    lying = np.array([[x, 3.1 + y, z] for x in np.linspace(2.6, 4.3, 9) for y in (-0.2, 0.2) for z in (0.0, 0.25)])
    pixels = view.project(lying) + 0.5
    found = Fitted(np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])[None], view).places()
    away = found.positions[0] - [3.45, 3.1]
    assert away @ np.linalg.solve(found.covariances[0], away) < 6.0


def test_who_lies_is_placed_alike_with_the_others_and_after_them(view, background):
    lying = np.array([[x, 3.1 + y, z] for x in np.linspace(2.6, 4.3, 9) for y in (-0.2, 0.2) for z in (0.0, 0.25)])
    pixels = view.project(lying) + 0.5
    standing = box_of(cast(view, [placed_at(1.0, 0.3, 0)]), background)
    boxes = np.array([np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]), standing])
    after, together = Fitted(boxes, view), Fitted(boxes, view, lie=True)
    assert after.lie
    assert together.lie
    assert np.allclose(after.places().positions, together.places().positions, atol=1e-3)
    assert np.allclose(after.places().covariances, together.places().covariances, rtol=0.01)
    assert not Fitted(standing[None], view, lie=True).lie


def test_no_boxes_give_no_places(view):
    found = Fitted(np.zeros((0, 4)), view).places()
    assert (found.positions.shape, found.covariances.shape, found.seen.shape) == ((0, 2), (0, 2, 2), (0,))


def test_rays_above_the_horizon_give_no_place():
    tilted = View(KannalaBrandt(300.0, 300.0, 320.0, 240.0), camera_pose([0, 0, 2.5], [0, 0, 0]), (640, 480))
    assert not Fitted(np.array([[300.0, 20.0, 340.0, 60.0]]), tilted).places().seen[0]


def test_a_box_outside_the_lens_gives_no_place():
    fold = View(BrownConrady(596.43, 596.43, 960, 540, -0.2), camera_pose([0, 0, 2.5], [90, 0, 0]), (1920, 1080))
    assert not Fitted(np.array([[1700.0, 500.0, 1900.0, 600.0]]), fold).places().seen[0]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-300, 900), min_size=4, max_size=4), st.floats(-4, 4))
def test_any_box_gives_a_finite_place_or_none(numbers, turn):
    box = np.array([min(numbers[0], numbers[2]), min(numbers[1], numbers[3]), max(numbers[0], numbers[2]), 0.0])
    box[3] = max(numbers[1], numbers[3])
    found = Fitted(box[None], ceiling_view(4), turns=None if turn > 3 else np.array([turn])).places()
    if found.seen[0]:
        assert np.isfinite(found.covariances).all()
        assert np.linalg.eigvalsh(found.covariances[0])[0] > 0
        assert not found.explained[0] or 0.0 < found.heights[0] < 2.6


def test_the_thesis_reads_one_pixel(view, background):
    person = (1.2, 2.33, 0.0, 0.0, 1.75)
    depth = cast(view, [person])
    box = box_of(depth, background)
    (found,) = place_centre(Boxes(box[None], np.array([0.7])), depth, view)
    assert 0.02 < np.linalg.norm(found.position[:2] - person[:2]) < 0.35  # the surface, not the axis
    assert place_centre(Boxes(box[None], np.array([0.7])), np.zeros_like(depth), view) == []


def test_a_drawing_changes_a_copy(view, detector):
    people = detector.detect(cast(view, [(1.2, 2.33, 0.0, 0.0, 1.75)]))
    picture = np.zeros((270, 480, 3), np.uint8)
    drawn = draw(picture, people, view)
    assert not picture.any()
    assert drawn.any()


@pytest.mark.parametrize("noise", [0, 6])
def test_the_gate_sees_five_millimetres_and_no_noise(noise):
    rng = np.random.default_rng(noise)
    room = cv2.resize(rng.integers(60, 200, (27, 48, 3), dtype=np.uint8), (1920, 1080), interpolation=cv2.INTER_CUBIC)

    def frame(x):
        picture = cv2.ellipse(room.copy(), (x, 500), (130, 90), 0, 0, 360, (40, 60, 150), -1).astype(float)
        return np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)

    gate = Gate(refresh=100)
    assert gate.changes(frame(900)).tolist() == [[0, 0, 1920, 1080]]
    learning = [gate.changes(frame(900)).tolist() for _ in range(LEARNING)]
    assert learning == [[[0, 0, 1920, 1080]] if noise else []] * LEARNING
    assert not any(len(gate.changes(frame(900))) for _ in range(5))
    x0, y0, x1, y1 = gate.changes(frame(904)).T  # 5 mm at 2.5 m is about two pixels; noise of 6 hides one or two
    assert x0.min() < 938 < x1.max() or x0.min() < 866 < x1.max()
    assert x1.max() - x0.min() < 500
    assert y0.min() > 304
    assert y1.max() < 696
    assert not len(gate.changes(frame(904)))


def test_the_gate_sees_a_small_person_where_noise_is_faint_though_it_is_loud_elsewhere():
    rng = np.random.default_rng(0)
    lit = cv2.circle(np.zeros((720, 1280), np.uint8), (640, 360), 350, 1, -1)
    noise = np.where(np.arange(1280) < 500, 4.0, 16.0) * lit

    def frame(x):
        picture = np.where(lit[..., None], np.full((720, 1280, 3), 90.0), 0.0)
        picture[340:370, x : x + 14] = 40
        return np.clip(picture + rng.normal(0, 1, picture.shape) * noise[..., None], 0, 255).astype(np.uint8)

    gate = Gate(refresh=1000)
    for _ in range(1 + LEARNING):
        gate.changes(frame(340))
    assert sum(len(gate.changes(frame(340))) for _ in range(30)) <= 2
    ((x0, y0, x1, y1),) = gate.changes(frame(352))
    assert x0 <= 340 < 366 <= x1
    assert y0 <= 340 < 370 <= y1
    assert x1 - x0 <= 240


def test_the_gate_learns_noise_that_begins_later():
    rng = np.random.default_rng(0)
    gate = Gate(refresh=1000)
    for _ in range(20):
        gate.changes(np.full((240, 320, 3), 90, np.uint8))
    noisy = [len(gate.changes(rng.normal(90, 8, (240, 320, 3)).astype(np.uint8))) for _ in range(30)]
    assert noisy[: LEARNING + 1] == [1] * (LEARNING + 1)
    assert sum(noisy[LEARNING + 1 :]) <= 1


def test_a_camera_that_repeats_one_picture_has_stopped():
    rng, frozen = np.random.default_rng(0), Frozen()
    picture = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    for k in range(50):  # 10 s of noise
        frozen.see(rng.integers(0, 255, picture.shape, dtype=np.uint8), k / 5)
    for k in range(150):
        frozen.see(picture, 10 + k / 5)
        assert not frozen.is_frozen
    frozen.see(picture, 40.0)
    assert (frozen.is_frozen, frozen.since) == (True, 10.0)
    frozen.see(picture + 1, 41.0)
    assert not frozen.is_frozen


def test_a_little_motion_in_a_small_picture_passes():
    gate, picture = Gate(refresh=100), np.full((640, 640, 3), 90, np.uint8)
    gate.changes(picture)
    picture = picture.copy()
    picture[200:212, 304:316] += 10  # a head far away
    ((x0, y0, x1, y1),) = gate.changes(picture)
    assert (np.array([x0, y0]) <= [304, 200]).all()
    assert (np.array([x1, y1]) >= [316, 212]).all()
    assert (x1 - x0) * (y1 - y0) < 80**2


def test_the_gate_looks_again_now_and_then():
    gate = Gate(refresh=4)
    still = np.zeros((64, 64, 3), np.uint8)
    assert [len(gate.changes(still)) for _ in range(9)] == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    all_of_them = Gate(refresh=1)
    assert [len(all_of_them.changes(still)) for _ in range(3)] == [1, 1, 1]
    assert gate.changes(np.zeros((32, 64, 3), np.uint8)).tolist() == [[0, 0, 64, 32]]


@pytest.mark.parametrize(("x", "y"), [(0, 0), (1900, 0), (3, 1060), (1896, 1056), (700, 500)])
def test_the_gate_tells_where_and_forgets_nothing_elsewhere(x, y):
    still = np.zeros((1080, 1920, 3), np.uint8)
    gate = Gate(refresh=100)
    gate.changes(still)
    moved = still.copy()
    moved[y : y + 24, x : x + 24] = 255
    ((x0, y0, x1, y1),) = gate.changes(moved)
    assert 0 <= x - x0 <= 96
    assert 0 <= y - y0 <= 96
    assert min(x + 24, 1920) <= x1 <= min(x + 120, 1920)
    assert min(y + 24, 1080) <= y1 <= min(y + 120, 1080)
    assert not len(gate.changes(moved))
    slow = moved.copy()
    for level in range(1, 9):  # a lamp that comes on by degrees elsewhere, while here something moves all the time
        slow[300:460, 1200:1360] = 3 * level
        slow[y : y + 24, x : x + 24] = 255 * (level % 2)
        if any(x0 < 1280 < x1 and y0 < 380 < y1 for x0, y0, x1, y1 in gate.changes(slow)):
            break
    else:
        pytest.fail("a change by degrees was never seen")


def test_the_division_lens_places_too():
    lens = Division(596.43 / 4, 596.43 / 4, 239.625, 134.625, -0.2, 0.0, 0.0, 0.0, 240.0, 135.0)
    view = ceiling_view(4, lens=lens)
    person = (3.2, 1.9, 2.0, 0.3, 1.75)
    (found,) = DepthDetector(view, cast(view)).detect(cast(view, [person]))
    assert np.linalg.norm(found.position[:2] - person[:2]) < 0.08
    assert KB8[0] > 0


@pytest.fixture(scope="module")
def furnished():
    """A picture of things that lie about, from above."""
    rng, picture = np.random.default_rng(3), np.full((480, 640, 3), 120, np.uint8)
    for _ in range(120):
        (x, y), (w, h) = rng.integers(0, (640, 480)), rng.integers(8, 60, 2)
        picture[y : y + h, x : x + w] = rng.integers(0, 255, 3)
    return picture


def watched(pictures):
    """What is known of a camera's mounting after pictures of two a second, with noise."""
    rng, mounting = np.random.default_rng(4), Mounting()
    for k, picture in enumerate(pictures):
        mounting.see(np.clip(picture + rng.normal(0, 4, picture.shape), 0, 255).astype(np.uint8), k / 2)
    return mounting.knock


@pytest.mark.parametrize(("shift", "turn"), [(0.02, 0.0), (0.1, 0.0), (0.0, 3.0), (0.0, -40.0)])
def test_a_knocked_camera_is_told_once_with_how_far_it_moved(furnished, shift, turn):
    turned = cv2.getRotationMatrix2D((319.5, 239.5), turn, 1.0)
    turned[:, 2] += shift * 480 * np.array([0.6, -0.8])
    after = cv2.warpAffine(furnished, turned, (640, 480), borderMode=cv2.BORDER_REFLECT)
    knock = watched([furnished] * 40 + [after] * 60)
    assert knock.since == pytest.approx(20.0, abs=2.0)
    assert knock.shift == pytest.approx(shift, abs=0.003)
    assert knock.turn_deg == pytest.approx(abs(turn), abs=0.5)


def test_people_light_noise_and_darkness_do_not_knock_a_camera(furnished):
    def walker(k):
        picture = furnished.copy()
        cv2.circle(picture, (100 + 5 * k, 240), 60, (200, 40, 40), -1)
        return picture

    assert watched([walker(k) for k in range(90)]) is None
    assert watched([furnished] * 30 + [(0.3 * furnished).astype(np.uint8)] * 60) is None
    assert watched([furnished] * 30 + [np.zeros_like(furnished)] * 60 + [furnished] * 30) is None
    assert watched([np.full_like(furnished, 90)] * 90) is None


def test_a_camera_that_is_turned_slowly_is_told_when_it_rests(furnished):
    def at(degrees):
        return cv2.warpAffine(furnished, cv2.getRotationMatrix2D((319.5, 239.5), degrees, 1.0), (640, 480))

    knock = watched([at(min(0.5 * k, 20.0)) for k in range(100)])
    assert knock.turn_deg == pytest.approx(20.0, abs=0.5)
    assert knock.since == pytest.approx(20.0, abs=2.5)
