import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avcli import pose


def test_ceiling_camera_of_the_thesis_looks_down_with_x_right_and_y_up():
    T_room_camera = pose.camera_pose([2.33, 2.33, 2.5], [90, 0, 0])
    right, down, forward = T_room_camera[:3, :3].T
    np.testing.assert_array_equal(right, [1, 0, 0])
    np.testing.assert_array_equal(down, [0, -1, 0])
    np.testing.assert_array_equal(forward, [0, 0, -1])
    np.testing.assert_allclose(pose.apply(T_room_camera, [0, 0, 2.5]), [2.33, 2.33, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("rotation", "right", "forward"),
    [
        ([0, 0, 0], [1, 0, 0], [0, 1, 0]),
        ([0, 90, 0], [0, -1, 0], [1, 0, 0]),
        ([0, 0, 90], [0, 0, 1], [0, 1, 0]),
        ([-90, 0, 0], [1, 0, 0], [0, 0, 1]),
        ([90, 90, 0], [0, -1, 0], [0, 0, -1]),
        ([90, 0, 90], [0, 1, 0], [0, 0, -1]),
    ],
)
def test_the_sense_of_each_angle(rotation, right, forward):
    T = pose.camera_pose([0, 0, 0], rotation)
    np.testing.assert_allclose(T[:3, 0], right, atol=1e-15)
    np.testing.assert_allclose(T[:3, 2], forward, atol=1e-15)


angles = st.one_of(st.sampled_from([-90.0, 0.0, 90.0, 180.0]), st.floats(-180, 180))


@given(angles, angles, angles)
def test_any_rotation_can_be_written_and_read(pitch, yaw, roll):
    T = pose.camera_pose([1, 2, 3], [pitch, yaw, roll])
    again = pose.camera_pose([1, 2, 3], pose.camera_rotation_deg(T))
    np.testing.assert_allclose(again, T, atol=1e-9)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(T) == pytest.approx(1)


def test_inverse_undoes():
    T = pose.camera_pose([1, -2, 3], [70, 20, -5])
    np.testing.assert_allclose(pose.inverse(T) @ T, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(pose.apply(pose.inverse(T), [[1, -2, 3]]), [[0, 0, 0]], atol=1e-15)
