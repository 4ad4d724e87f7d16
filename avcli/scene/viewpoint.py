"""What a camera can see from where it stands: lenses that see next to nothing and buried cameras are refused."""

from collections.abc import Sequence

import numpy as np

from avcli import pose
from avcli.formats.experiment import Camera
from avcli.formats.schema import Invalid
from avcli.scene import people as bodies
from avcli.scene.furniture import BOX, CYLINDER, TRIANGLE, Solids
from avcli.scene.person import Person

_GRID = 65  # pixels along each side at which a lens is asked
_LEAST_SEEN = 0.05  # of the picture; a full circle of half the height of a 16:9 picture is 0.11
_REACH_M = 1.2  # from the place of a person to their farthest fingertip
_MOST_POSED, _CHUNK = 1000, 100  # instants at which a person near the camera is posed, in all and together


def odd(camera: Camera) -> list[str]:
    """Say where the pictures show what the calibration of the camera does not know.

    Raises:
        Invalid: the lens sees something in less than a twentieth of the picture.
    """
    x, y = np.linspace(0, camera.width_px - 1, _GRID), np.linspace(0, camera.height_px - 1, _GRID)
    rays = camera.lens.unproject(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    angle = np.rad2deg(pose.angle_from_axis(rays))
    seen = np.isfinite(angle).mean()
    if seen < _LEAST_SEEN:
        end = np.rad2deg(camera.lens.theta_max)
        raise Invalid(
            f"gives a picture of which {100 * (1 - seen):.0f} % is black: the lens ends at {end:.3g} degrees from the "
            "axis, too near the centre; its focal length (fx_px) or its coefficients (k1...) are wrong",
            ("camera_config",),
        )
    trusted, widest = np.rad2deg(camera.theta_trusted), np.nanmax(angle)
    if widest <= trusted + 0.05:
        return []
    return [
        f"the pictures are drawn up to {widest:.1f} degrees from the axis; beyond {trusted:.1f} the lens is "
        "extrapolated, and another one than the real camera's"
    ]


def refuse_buried(camera: Camera, pieces: Sequence[Solids], people: Sequence[Person], times: np.ndarray) -> None:
    """Refuse a camera inside furniture, or inside a person at one of the frames.

    Args:
        camera: whose place counts.
        pieces: the furniture, piece by piece; inside a mesh a camera is permitted, since it may be that of a room.
        people: who move.
        times: (n,) s, of the frames. A person who is near the camera for long is looked at a thousand times.

    Raises:
        Invalid: the camera is inside something; the path names it.
    """
    eye = camera.T_room_camera[:3, 3]
    for index, piece in enumerate(pieces):
        if _within(piece, eye):
            raise Invalid(f"holds the camera, which is at {eye.round(3).tolist()} m", ("furniture", index))
    for index, person in enumerate(people):
        time = _inside_at(person, eye, times)
        if time is not None:
            reason = f"is where the camera is, {eye.round(3).tolist()} m, at {time:.1f} s"
            raise Invalid(reason, ("people", index))


def _within(solids: Solids, place: np.ndarray) -> bool:
    """Whether a place (3,) m is inside a box, a cylinder or a ball."""
    local = np.abs(np.einsum("nij,nj->ni", solids.axes, place - solids.centre))
    box = (local < solids.half).all(1)
    upright = (np.hypot(local[:, 0], local[:, 1]) < solids.half[:, 0]) & (local[:, 2] < solids.half[:, 2])
    ball = np.linalg.norm(local, axis=1) < solids.half[:, 0]
    inside = np.where(solids.kind == BOX, box, np.where(solids.kind == CYLINDER, upright, ball))
    return bool((inside & (solids.kind != TRIANGLE)).any())


def _inside_at(person: Person, eye: np.ndarray, times: np.ndarray) -> float | None:
    """The first time at which a place (3,) m is inside a person; None: at none."""
    if eye[2] > person.height + _REACH_M:
        return None
    near = times[np.linalg.norm(person.motion.position(times) - eye[:2], axis=1) < _REACH_M]
    if len(near) > _MOST_POSED:
        near = near[np.linspace(0, len(near) - 1, _MOST_POSED).astype(int)]
    for first in range(0, len(near), _CHUNK):
        some = near[first : first + _CHUNK]
        inside = _cones_around(bodies.pose([person], some), eye)
        if inside.any():
            return float(some[inside.argmax()])
    return None


def _cones_around(posed: bodies.Bodies, place: np.ndarray) -> np.ndarray:
    """Whether a place (3,) m is inside one of the rounded cones at each time, (n,) bool."""
    swell = (1 / posed.flat - 1)[:, None] * posed.flat_axis

    def plain(points: np.ndarray) -> np.ndarray:
        """Points in the space in which the cones are not flattened about their middles."""
        return points + swell * np.sum(posed.flat_axis * (points - middle), -1, keepdims=True)

    middle = 0.5 * (posed.a + posed.b)
    a, b = plain(posed.a), plain(posed.b)
    q, axis, taper = plain(np.broadcast_to(place, a.shape)) - a, b - a, posed.ra - posed.rb
    square = np.maximum(np.sum(axis * axis, -1), 1e-12)
    x = np.sum(q * axis, -1) / square
    radial = np.linalg.norm(q - x[..., None] * axis, axis=-1)
    slope = taper / np.sqrt(np.maximum(square - taper**2, 1e-12))
    along = np.clip(x - radial * slope / np.sqrt(square), 0, 1)
    inside = np.linalg.norm(q - along[..., None] * axis, axis=-1) < posed.ra - along * taper
    return np.any(inside, axis=1)
