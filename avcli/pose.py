"""Rigid transforms as 4 x 4 matrices, rotation vectors, and the one meaning of a camera's rotation angles.

`T_AB` maps coordinates in frame B to frame A, so that `T_AC = T_AB @ T_BC` reads off its names. The camera frame is
OpenCV's: x right, y down, z forward.
"""

import numpy as np
from numpy.typing import ArrayLike

# The camera of rotation [0, 0, 0] stands upright and looks along the room's y axis: its right is +x, its up is +z.
_R_ROOM_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def transform(rotation: ArrayLike, translation: ArrayLike) -> np.ndarray:
    """Build a rigid transform.

    Args:
        rotation: R_AB (3, 3).
        translation: (3,) m, the origin of B in A.

    Returns:
        T_AB (4, 4).
    """
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def inverse(T_AB: np.ndarray) -> np.ndarray:
    """Invert a rigid transform T_AB (4, 4); returns T_BA (4, 4)."""
    rotation = T_AB[:3, :3].T
    return transform(rotation, -rotation @ T_AB[:3, 3])


def apply(T_AB: np.ndarray, points: ArrayLike) -> np.ndarray:
    """Map points from frame B to frame A.

        >>> from avcli.pose import apply, camera_pose
        >>> T_room_camera = camera_pose([2.0, 2.0, 2.5], [90, 0, 0])
        >>> apply(T_room_camera, [0.0, 0.0, 2.5])  # what a ceiling camera sees in its middle lies below it
        array([2., 2., 0.])

    Args:
        T_AB: (4, 4).
        points: (..., 3) m.

    Returns:
        (..., 3) m.
    """
    return np.asarray(points, float) @ T_AB[:3, :3].T + T_AB[:3, 3]


def angle_from_axis(points: ArrayLike) -> np.ndarray:
    """Angle between a camera's optical axis and points (..., 3) in its frame, (...) rad, from 0 to pi; NaN stays."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.arctan2(np.hypot(x, y), z)


def rotation_from_vector(omega: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3) rad (Rodrigues)."""
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    K = cross_matrix(omega)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = np.where(angle > 1e-8, np.sin(angle) / angle, 1.0)
        b = np.where(angle > 1e-8, (1 - np.cos(angle)) / angle**2, 0.5)
    return np.eye(3) + a * K + b * K @ K


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) that take a vector w to v × w, of vectors v (n, 3)."""
    out = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k, j] = v[..., i]
        out[..., j, k] = -v[..., i]
    return out


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) rad of a rotation matrix, by its quaternion, which is exact near half a turn as well."""
    options = np.array([1 + np.trace(R), *(1 + 2 * R[i, i] - np.trace(R) for i in range(3))])
    k = int(np.argmax(options))
    odd = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    if k == 0:
        q = np.array([options[0], *odd])
    else:
        i = k - 1
        q = np.array([odd[i], *(R[i, j] + R[j, i] for j in range(3))])
        q[1 + i] = options[k]
    q /= np.linalg.norm(q)
    q = q if q[0] >= 0 else -q
    sine = np.linalg.norm(q[1:])
    return q[1:] * (2 * np.arctan2(sine, q[0]) / sine) if sine > 1e-15 else np.zeros(3)


def camera_pose(position: ArrayLike, rotation_deg: ArrayLike) -> np.ndarray:
    """Build T_room_camera (4, 4) from `camera_position_m` (3,) and `camera_rotation_deg` (3,).

    The angles are [pitch, yaw, roll] as Unity, which the thesis used, orders them: from the upright camera that looks
    along the room's +y with +x to its right, first roll about the optical axis (positive turns the camera's right
    side upward), then pitch about its horizontal axis (positive looks down), then yaw about the vertical (positive
    turns it to its right, clockwise seen from above). [90, 0, 0] looks straight down with image right = +x and image
    up = +y.
    """
    pitch, yaw, roll = np.deg2rad(np.asarray(rotation_deg, float))
    rotation = _R_ROOM_UPRIGHT @ _about(1, yaw) @ _about(0, -pitch) @ _about(2, -roll)
    # Without the 6e-17 that cos(90 deg) leaves a ceiling camera's axes are the room's exactly.
    return transform(np.where(np.abs(rotation) < 1e-15, 0.0, rotation), position)


def camera_rotation_deg(T_room_camera: np.ndarray) -> np.ndarray:
    """Read `camera_rotation_deg` [pitch, yaw, roll] (3,) off T_room_camera (4, 4); the inverse of `camera_pose`.

    Where the camera looks straight up or down yaw and roll turn about one axis: yaw is then given as 0.
    """
    rotation = _R_ROOM_UPRIGHT.T @ T_room_camera[:3, :3]
    horizontal = np.hypot(rotation[0, 2], rotation[2, 2])
    pitch = np.arctan2(rotation[1, 2], horizontal)
    yaw = np.arctan2(rotation[0, 2], rotation[2, 2]) if horizontal > 1e-9 else 0.0
    rolled = _about(1, -yaw) @ rotation
    roll = np.arctan2(rolled[0, 1], rolled[0, 0])
    return np.rad2deg(np.array([pitch, yaw, roll])) + 0.0


def _about(axis: int, angle: float) -> np.ndarray:
    """The turn (3, 3) about an axis by an angle, rad."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    turn: np.ndarray = np.eye(3)
    turn[one, one] = turn[other, other] = np.cos(angle)
    turn[one, other], turn[other, one] = -np.sin(angle), np.sin(angle)
    return turn
