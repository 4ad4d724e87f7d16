"""Where the camera hangs, from known points."""

import numpy as np
import pytest
from calibration_boards import THESIS
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli import pose
from avcli.calibration import place, undistort
from avcli.calibration.camera import KnownCamera
from avcli.calibration.circle import Circle
from avcli.calibration.field import seen_angles
from avcli.calibration.pupil import from_pupil
from avcli.calibration.target import Board
from avcli.lens import BrownConrady, KannalaBrandt

CEILING = pose.camera_pose([2.33, 2.33, 2.5], [90, 0, 0])


def seen(lens, T_room_camera, points):
    return lens.project(pose.apply(pose.inverse(T_room_camera), points))


def visible(lens, T, rng, count, planar):
    points = []
    while len(points) < count:
        p = rng.uniform([0.5, 1.0, 0.0], [4.0, 3.6, 0.0 if planar else 1.5])
        u = seen(lens, T, p[None])[0]
        if np.isfinite(u).all() and (u > 0).all() and (u < [1919, 1079]).all():
            points.append(p)
    return np.array(points)


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    tilt=st.floats(-25, 25),
    yaw=st.floats(-180, 180),
    planar=st.booleans(),
    count=st.integers(6, 12),
)
def test_exact_points_give_the_exact_pose(seed, tilt, yaw, planar, count):
    rng = np.random.default_rng(seed)
    T = pose.camera_pose([2.3, 2.2, 2.5], [90 + tilt, yaw, 0])
    points = visible(THESIS, T, rng, count, planar)
    if np.linalg.svd(points - points.mean(0), compute_uv=False)[1] < 0.3:
        return
    found = place.locate(THESIS, seen(THESIS, T, points), points)
    assert np.abs(found.T_room_camera - T).max() < 1e-6


def test_points_beyond_90_degrees_and_another_lens():
    lens = KannalaBrandt(300, 300, 512, 512)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.arccos(directions[:, 2])
    cloud = directions[angles < 1.9] * rng.uniform(1, 3, (np.sum(angles < 1.9), 1))
    assert (np.arccos(cloud[:, 2] / np.linalg.norm(cloud, axis=1)) > np.pi / 2).any()
    points = pose.apply(CEILING, cloud)
    assert np.abs(place.locate(lens, lens.project(cloud), points).T_room_camera - CEILING).max() < 1e-6
    plain = BrownConrady(900, 900, 960, 540, 0.01)
    floor = visible(plain, CEILING, rng, 8, True)
    assert np.abs(place.locate(plain, seen(plain, CEILING, floor), floor).T_room_camera - CEILING).max() < 1e-6


def test_the_covariance_is_honest():
    rng = np.random.default_rng(1)
    points = visible(THESIS, CEILING, rng, 12, True)
    exact = seen(THESIS, CEILING, points)
    pulls = []
    for _ in range(30):
        found = place.locate(THESIS, exact + 0.5 * rng.standard_normal(exact.shape), points, sigma_px=0.5)
        moved = found.T_room_camera[:3, 3] - CEILING[:3, 3]
        turn = found.T_room_camera[:3, :3] @ CEILING[:3, :3].T
        omega = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        pulls.append(np.concatenate([omega, moved]) / np.sqrt(np.diag(found.covariance)))
    assert ((np.std(pulls, axis=0) > 0.6) & (np.std(pulls, axis=0) < 1.45)).all()


def test_one_wrong_point_of_many_does_not_matter():
    rng = np.random.default_rng(2)
    points = visible(THESIS, CEILING, rng, 12, False)
    pixels = seen(THESIS, CEILING, points)
    pixels[4] += 150
    found = place.locate(THESIS, pixels, points)
    assert np.abs(found.T_room_camera[:3, 3] - CEILING[:3, 3]).max() < 0.02


def test_a_board_on_the_floor():
    board = Board(7, 10, 0.095)
    points = place.board_on_floor(board.points, [2.0, 2.5, 0.0], np.deg2rad(30))
    assert np.allclose(points[:, 2], 0)
    along = points[1] - points[0]
    assert np.allclose(along, 0.095 * np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0]))
    down = points[board.inner[0]] - points[0]
    # Seen from above (x right, y up) the board reads as it was printed: down is to the right of along.
    assert np.cross(along, down)[2] < 0
    found = place.locate(THESIS, seen(THESIS, CEILING, points), points)
    assert np.abs(found.T_room_camera - CEILING).max() < 1e-6


def test_too_little_is_refused():
    with pytest.raises(ValueError, match="at least 4 points"):
        place.locate(THESIS, np.zeros((3, 2)) + 500, np.eye(3))
    line = np.array([[1.0, 1, 0], [2, 2, 0], [3, 3, 0], [1.5, 1.5, 0]])
    with pytest.raises(ValueError, match="on one line"):
        place.locate(THESIS, seen(THESIS, CEILING, line), line)
    with pytest.raises(ValueError, match="outside the field"):
        place.locate(THESIS, np.array([[5000.0, 500]] * 4), np.eye(4)[:, :3])


# --- the lens's error -------------------------------------------------------------------------------------------------


def test_the_pose_inherits_the_error_of_the_lens():
    """Poses under lenses drawn from the covariance scatter as the stated covariance says."""
    rng = np.random.default_rng(5)
    points = visible(THESIS, CEILING, rng, 40, True)
    covariance = np.diag(np.array([2.0, 2.0, 1.5, 1.5, 1e-3, 1e-4, 1e-5, 1e-6]) ** 2)
    pixels = seen(THESIS, CEILING, points)
    places = []
    for _ in range(40):
        wrong = KannalaBrandt(*(THESIS.parameters[:8] + np.sqrt(np.diag(covariance)) * rng.standard_normal(8)))
        places.append(place.locate(wrong, pixels, points, 0.1).T_room_camera[:3, 3])
    count = len(THESIS.parameters)
    whole = np.zeros((count, count))
    whole[:8, :8] = covariance
    stated = place.locate(THESIS, pixels, points, 0.1, lens_covariance=whole).covariance
    alone = place.locate(THESIS, pixels, points, 0.1).covariance
    ratio = np.std(places, axis=0) / np.sqrt(np.diag(stated)[3:])
    assert ((ratio > 0.65) & (ratio < 1.4)).all()
    assert np.diag(stated)[3:].min() > np.diag(alone)[3:].min()
    shared = place.locate(THESIS, pixels, points, 0.1, shared=3.0).covariance
    assert np.allclose(shared, 9 * alone)


def camera(**values):
    return KnownCamera(THESIS, (1920, 1080), values, "camera.json")


def test_points_beyond_the_trusted_angle_are_left_out_and_counted():
    points = visible(THESIS, CEILING, np.random.default_rng(6), 40, True)
    pixels = seen(THESIS, CEILING, points)
    angle = np.rad2deg(seen_angles(THESIS, pixels))
    limit = float(np.median(angle))
    found, _ = place.best(camera(theta_max_trusted_deg=limit), [(pixels, points)])
    assert found.beyond == (angle > limit).sum() > 0
    assert "beyond the angle" in " ".join(place.words(found, []))
    assert np.abs(found.T_room_camera - CEILING).max() < 1e-6
    with pytest.raises(ValueError, match="up to which the lens is known"):
        place.best(camera(theta_max_trusted_deg=float(np.sort(angle)[2])), [(pixels, points)])


def test_many_pictures_of_one_board_at_one_place_say_no_more_than_one():
    points = visible(THESIS, CEILING, np.random.default_rng(7), 30, True)
    pixels = seen(THESIS, CEILING, points)
    one, _ = place.best(camera(), [(pixels, points)], 0.2, views=1)
    four, _ = place.best(camera(), [(np.tile(pixels, (4, 1)), np.tile(points, (4, 1)))], 0.2, views=4)
    assert np.allclose(four.covariance, one.covariance, rtol=1e-6)


def test_a_straightened_picture_ends_where_the_lens_is_no_longer_trusted():
    wide = undistort.ProjectionSettings(projection="whole", fov_deg=170.0)
    whole = undistort.straighten(THESIS, (1920, 1080), (340, 200), wide)
    limited = undistort.straighten(THESIS, (1920, 1080), (340, 200), wide, np.deg2rad(50), Circle(960.0, 540.0, 700.0))
    assert (limited.is_cut, whole.is_cut) == (True, False)
    shown = limited.sources[np.isfinite(limited.sources).all(2)]
    assert np.rad2deg(seen_angles(THESIS, shown)).max() <= 50 + 1e-6
    assert np.hypot(*(shown - [960, 540]).T).max() <= 700
    filled = undistort.straighten(THESIS, (1920, 1080), (320, 180), theta_max=np.deg2rad(40))
    assert np.isfinite(filled.sources).all()


@pytest.mark.parametrize("pupil", [0.0, 0.004, -0.003])
def test_a_near_board_is_posed_by_the_centre_that_it_is_seen_from(pupil):
    near = pose.camera_pose([2.0, 2.5, 0.35], [90, 0, 10])
    x, y = np.meshgrid(np.linspace(1.85, 2.15, 7), np.linspace(2.35, 2.65, 7))
    points = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    pixels = THESIS.project(from_pupil(pose.apply(pose.inverse(near), points), pupil)[0])
    known = camera(calibration={"pupil_m": pupil})
    assert known.pupil_m == pupil
    found, _ = place.best(known, [(pixels, points)])
    assert np.abs(found.T_room_camera - near).max() < 1e-7
    assert found.off < 1e-8
    if pupil:
        central, _ = place.best(camera(), [(pixels, points)])
        assert np.linalg.norm(central.T_room_camera[:3, 3] - near[:3, 3]) > 0.0002
        assert central.rms_px > 100 * found.rms_px
