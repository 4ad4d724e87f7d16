"""The pose of a camera of known lens, from pixels whose places in the room are known."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from avcli import pose
from avcli.calibration.camera import KnownCamera
from avcli.calibration.corners import View
from avcli.calibration.field import seen_angles
from avcli.calibration.pupil import from_pupil, project_jacobian
from avcli.calibration.target import Board
from avcli.lens import Lens

MOST_OFF = {"board": np.deg2rad(0.12), "points": np.deg2rad(2.0)}
"""rad, the largest RMS angle between where a lens sees corners of a board, or points measured by hand, and where they
should be. Real lenses leave 0.02 to 0.07 degrees on real boards, wrong ones of the same size of picture 0.13 and more;
2 degrees are 10 cm at 3 m."""
_LEAST_OFF_PX = 1.5
"""px; a smaller residual is never refused, since a coarse picture can do no better."""
_STARTS = 400
_TRIED = 12


@dataclass(frozen=True)
class Place:
    """A camera's pose in the room.

    Attributes:
        T_room_camera: (4, 4), m.
        covariance: (6, 6) of a turn (rad, in the room's axes, about the camera) and of the position (m).
        rms_px: residual, root of the mean of du² + dv².
        residuals: (n, 2) px, seen minus predicted.
        off: rad, root of the mean square of the angles between the rays of the pixels and where their points are.
        beyond: how many points were left out, since they lie beyond the angle up to which the lens is known.
    """

    T_room_camera: np.ndarray
    covariance: np.ndarray
    rms_px: float
    residuals: np.ndarray
    off: float
    beyond: int = 0

    def camera_config(self) -> dict:
        """The pose as keys of config.json's camera_config."""
        return {
            "camera_position_m": self.T_room_camera[:3, 3].tolist(),
            "camera_rotation_deg": pose.camera_rotation_deg(self.T_room_camera).tolist(),
            "pose_covariance": self.covariance.tolist(),
            "pose_rms_px": self.rms_px,
        }


def locate(
    lens: Lens,
    pixels: np.ndarray,
    points: np.ndarray,
    sigma_px: float | None = None,
    *,
    pupil_m: float = 0.0,
    lens_covariance: np.ndarray | None = None,
    shared: float = 1.0,
) -> Place:
    """Find the pose of a camera that sees room points (n, 3) m at pixels (n, 2), n >= 4; beyond 90 degrees too.

    Rotations are tried all over; for each the position follows linearly from ray × (R p + t) = 0. The best are polished
    by Levenberg-Marquardt on the pixels, large residuals counting less (Huber).

    Args:
        lens: any model of avcli.lens.
        pixels, points: what was seen, and where it is.
        sigma_px: standard deviation of a pixel; None takes it from the residuals, at least 0.1 px.
        pupil_m: how the lens's centre moves, see fit.Solution.
        lens_covariance: (parameters, parameters) of the lens's parameters, whose error the pose inherits; None: 0.
        shared: how many times larger errors that the pixels share make the pose's error (standard deviation).

    Raises:
        ValueError: there are fewer than four points, they lie on a line, or the lens images none of the pixels.
    """
    pixels, points = np.asarray(pixels, float), np.asarray(points, float)
    rays = lens.unproject(pixels)
    if not np.isfinite(rays).all():
        bad = pixels[~np.isfinite(rays).all(1)][0]
        raise ValueError(f"pixel ({bad[0]:.1f}, {bad[1]:.1f}) is outside the field of the lens")
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False) if len(points) >= 4 else np.zeros(3)
    if len(points) < 4 or spread[1] < 1e-6 * max(spread[0], 1e-12):
        found = f"found {len(points)}" if len(points) < 4 else f"the {len(points)} points are on one line"
        raise ValueError(f"a pose needs at least 4 points that are not on one line; {found}")
    starts = _starts(rays, points)
    R, t, _ = min((_polish(lens, pupil_m, pixels, points, *start) for start in starts), key=lambda one: one[2])
    residuals, jacobian, by_lens = _residuals(lens, pupil_m, pixels, points, R, t)
    freedom = max(2 * len(points) - 6, 1)
    if sigma_px is None:
        sigma_px = max(float(np.sqrt((residuals**2).sum() / freedom)), 0.1)
    J = jacobian.reshape(-1, 6)
    # From a turn and shift of the points in the camera's frame to the camera's own in the room.
    inverse = np.linalg.pinv(J.T @ J)
    inner = (shared * sigma_px) ** 2 * inverse
    if lens_covariance is not None:
        follows = inverse @ J.T @ by_lens.reshape(len(J), -1)
        inner += follows @ lens_covariance @ follows.T
    change = np.zeros((6, 6))
    change[:3, :3] = -R.T
    change[3:, :3] = -R.T @ pose.cross_matrix(t)
    change[3:, 3:] = -R.T
    covariance = change @ inner @ change.T
    return Place(
        pose.inverse(pose.transform(R, t)),
        (covariance + covariance.T) / 2,
        float(np.sqrt((residuals**2).sum(1).mean())),
        residuals,
        off_angle(rays, from_pupil(points @ R.T + t, pupil_m)[0]),
    )


def off_angle(rays: np.ndarray, points: np.ndarray) -> float:
    """Root of the mean square of the angles between unit rays (n, 3) and points (n, 3) in the camera's frame, rad.

    A ray that the lens does not have counts as a right angle.
    """
    across = np.linalg.norm(np.cross(rays, points), axis=1)
    angle = np.arctan2(across, (rays * points).sum(1))
    return float(np.sqrt((np.where(np.isfinite(angle), angle, np.pi / 2) ** 2).mean()))


def refusal(off: float, kind: str, rms_px: float) -> str | None:
    """Say why points cannot be what they are said to be; None where they can.

    Args:
        off: rad, RMS angle between where they are seen and where they should be.
        kind: a key of MOST_OFF.
        rms_px: the same as a residual in px.
    """
    if off <= MOST_OFF[kind] or rms_px <= _LEAST_OFF_PX:
        return None
    what = {
        "board": "the lens, the size of the pictures or the board is another one",
        "points": "a point, the lens or the size of the pictures is another one",
    }[kind]
    return (
        f"the RMS residual is {rms_px:.1f} px, {np.rad2deg(off):.2f} degrees, and no true view has more than "
        f"{np.rad2deg(MOST_OFF[kind]):g}: {what}"
    )


def _starts(rays: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The best of many rotations, room to camera, with their positions."""
    rotations = _rotations(_STARTS)
    turned = np.einsum("kij,nj->kni", rotations, points)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # what of a vector lies across the ray
    normal = across.sum(0)
    t = -np.linalg.solve(normal, np.einsum("nij,knj->ki", across, turned).T).T
    inside = turned + t[:, None]
    off = np.einsum("nij,knj->kni", across, inside)
    behind = np.einsum("ni,kni->kn", rays, inside) < 0
    score = (off**2).sum((1, 2)) + 10 * (behind * (inside**2).sum(2)).sum(1)
    return [(rotations[k], t[k]) for k in np.argsort(score)[:_TRIED]]


def _rotations(count: int) -> np.ndarray:
    """Rotations spread evenly, (count, 3, 3) (Alexa 2022, super-Fibonacci spirals)."""
    s = np.arange(count) + 0.5
    a, b = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    r, q = np.sqrt(s / count), np.sqrt(1 - s / count)
    x, y, z, w = r * np.sin(a), r * np.cos(a), q * np.sin(b), q * np.cos(b)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def _residuals(
    lens: Lens, pupil: float, pixels: np.ndarray, points: np.ndarray, R: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seen minus predicted (n, 2) and the prediction's derivatives to a turn and shift (n, 2, 6) and to the lens."""
    turned = points @ R.T
    predicted, by_point, by_lens, _ = project_jacobian(lens, turned + t, pupil)
    residuals = pixels - predicted
    jacobian = np.concatenate([-by_point @ pose.cross_matrix(turned), by_point], -1)
    unseen = ~(np.isfinite(residuals).all(1) & np.isfinite(jacobian).all((1, 2)))
    residuals[unseen], jacobian[unseen] = 1000.0, 0.0
    return residuals, jacobian, np.nan_to_num(by_lens)


def _polish(
    lens: Lens, pupil: float, pixels: np.ndarray, points: np.ndarray, R: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    delta, damping = 50.0, 1e-3

    def robust(residuals: np.ndarray, limit: float) -> tuple[float, np.ndarray]:
        size = np.linalg.norm(residuals, axis=1)
        weight = np.minimum(1.0, limit / np.maximum(size, 1e-12))
        return np.where(size <= limit, size**2, 2 * limit * size - limit**2).sum().item(), weight

    residuals, jacobian, _ = _residuals(lens, pupil, pixels, points, R, t)
    for _ in range(60):
        cost, weight = robust(residuals, delta)
        A = np.einsum("nia,nib,n->ab", jacobian, jacobian, weight)
        g = np.einsum("nia,ni,n->a", jacobian, residuals, weight)
        step = np.linalg.lstsq(A + damping * np.diag(np.diag(A)) + 1e-12 * np.eye(6), g, rcond=None)[0]
        R_new, t_new = pose.rotation_from_vector(step[None, :3])[0] @ R, t + step[3:]
        new = _residuals(lens, pupil, pixels, points, R_new, t_new)[:2]
        if robust(new[0], delta)[0] < cost:
            gain = 1 - robust(new[0], delta)[0] / cost
            R, t, (residuals, jacobian), damping = R_new, t_new, new, damping / 6
            if gain < 1e-10:
                break
            middle = float(np.median(np.linalg.norm(residuals, axis=1)))
            delta = min(delta, max(5 * middle, 1.0))
        else:
            damping *= 6
            if damping > 1e8:
                break
    return R, t, robust(residuals, 20.0)[0]


def board_on_floor(corners: np.ndarray, position: ArrayLike, yaw: float) -> np.ndarray:
    """Room places (n, 3) m of corners (n, 2) m of a board that lies face up.

    Args:
        corners: in the board's frame, from its middle.
        position: (3,) m, of the board's middle in the room.
        yaw: rad, from the room's x axis to the direction in which the board's rows run, counter-clockwise from above.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    across, down = np.array([c, s, 0.0]), np.array([s, -c, 0.0])
    return np.asarray(position) + corners[:, :1] * across + corners[:, 1:] * down


def board_choices(
    board: Board, views: list[View], position: ArrayLike, yaw: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pixels (n, 2) and room points (n, 3) m of all corners in all views of a board that lies face up (board_on_floor).

    Returns:
        one such pair; two where the board looks the same upside down, the second with all of its corners turned.
    """
    room = board_on_floor(board.points, position, yaw)
    pixels = np.concatenate([view.pixels for view in views])
    turns = (room, room[::-1]) if board.is_ambiguous else (room,)
    return [(pixels, np.concatenate([turned[view.ids] for view in views])) for turned in turns]


def best(
    camera: KnownCamera, choices: list[tuple[np.ndarray, np.ndarray]], sigma_px: float | None = None, views: int = 0
) -> tuple[Place, list[Place]]:
    """Locate a camera, and choose the pose that is nearest to the one that its camera_config states, if it does.

    Args:
        camera: what is known of the camera.
        choices: pixels (n, 2) and room points (n, 3) m; several where it is unclear which is which (board_choices).
        sigma_px: see `locate`.
        views: how many pictures of one board at one place the points come from; what is wrong with the board there is
            the same in all of them, so that many say no more than one. 0: points that were measured one by one.

    Returns:
        The pose, and the others that fit as well if the right one is unknown.
    """
    found = []
    for pixels, points in choices:
        seen = seen_angles(camera.lens, pixels)
        known = ~(seen > camera.theta_trusted)
        if known.sum() < 4 <= len(known):
            raise ValueError(
                f"only {known.sum()} of {len(known)} points lie within the {np.rad2deg(camera.theta_trusted):.1f} "
                "degrees from the axis up to which the lens is known; a pose needs 4"
            )
        at = locate(
            camera.lens,
            pixels[known],
            points[known],
            sigma_px,
            pupil_m=camera.pupil_m,
            lens_covariance=camera.covariance,
            shared=camera.inflation * np.sqrt(views) if views else 1.0,
        )
        found.append(replace(at, beyond=int((~known).sum())))
    stated = camera.values.get("camera_position_m")
    if not stated:
        return found[0], found[1:]
    T = pose.camera_pose(stated, camera.values.get("camera_rotation_deg", [90.0, 0.0, 0.0]))
    return min(found, key=lambda one: float(np.abs(one.T_room_camera - T).sum())), []


def is_mirrored(camera: KnownCamera, choices: list[tuple[np.ndarray, np.ndarray]], found: Place, kind: str) -> bool:
    """Tell whether a camera is only found below the floor, or points fit only in a mirror.

    Points on a floor fit their mirror image as well, seen from below.

    Args:
        camera, choices: see `best`.
        found: the pose.
        kind: see `refusal`.
    """
    if refusal(found.off, kind, found.rms_px) is None:
        height = float(found.T_room_camera[2, 3])
        return height < min(0.0, *(float(points[:, 2].min()) for _, points in choices))
    turned = [(pixels, points * (-1, 1, 1)) for pixels, points in choices]
    other = best(camera, turned)[0]
    return refusal(other.off, kind, other.rms_px) is None


def parse_points(content: bytes, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Read a CSV with a header u,v,x,y,z: pixels (n, 2) and room points (n, 3) m.

    Raises:
        ValueError: a column is missing, or a value is not a finite number; the message begins with `name`.
    """
    import csv
    import io

    rows = csv.DictReader(io.StringIO(content.decode("utf-8-sig", "replace")))
    try:
        table = np.array([[float(row[key]) for key in ("u", "v", "x", "y", "z")] for row in rows]).reshape(-1, 5)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected a header u,v,x,y,z and rows of five numbers ({error})") from None
    if not np.isfinite(table).all():
        raise ValueError(f"{name}: every number must be finite")
    return table[:, :2], table[:, 2:]


def words(place: Place, others: list[Place]) -> list[str]:
    """Describe where the camera is and how certain that is, in sentences without a full stop.

    Args:
        place: what was found.
        others: poses that fit as well.
    """
    error = np.linalg.norm(place.residuals, axis=1)
    sd_mm = 1000 * float(np.sqrt(np.trace(place.covariance[3:, 3:])))
    lines = [
        f"the camera is at {_shown(place)} m ± {sd_mm:.1f} mm; RMS residual {place.rms_px:.2f} px, {len(error)} points"
    ]
    lines += [
        f"this board looks the same upside down, so the camera may also be at {_shown(other)} m: write a rough "
        "camera_position_m into config.json, or use a board with one odd and one even count"
        for other in others
    ]
    if place.beyond:
        lines.append(
            f"{place.beyond} more points lie beyond the angle up to which the lens is known, and were left out"
        )
    bad = np.flatnonzero(error > max(5.0, 4 * float(np.median(error))))
    if len(bad):
        lines.append(f"these points do not fit (counted from 1): {', '.join(map(str, bad + 1))}; check them")
    return lines


def _shown(place: Place) -> str:
    return f"[{', '.join(f'{value:.4f}' for value in place.T_room_camera[:3, 3])}]"
