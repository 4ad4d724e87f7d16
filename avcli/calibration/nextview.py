"""Where to hold the board next: the place from which the lens will be known best.

The information about the lens that a view of the board brings follows from the lens and the pose alone, before the view
is taken. Of many poses that a person can hold, the one is proposed after which the mean expected error over the picture
is least (Peng and Sturm 2019, Calibration Wizard, who minimise the trace of the intrinsics' covariance instead).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avcli import pose
from avcli.calibration import fit
from avcli.calibration.field import grid
from avcli.calibration.pupil import PUPIL, project_jacobian
from avcli.calibration.quality import coverage
from avcli.calibration.target import Board
from avcli.lens import Lens

Mask = Callable[[np.ndarray], np.ndarray]
"""Tells of pixels (n, 2) which of them light reaches: (n,) bool."""

_SIZES = (0.3, 0.45, 0.65)
"""Angles that a board may fill, of that which the picture's shorter side fills."""
_TILT = np.deg2rad(38.0)
_TURNS = 6
"""Directions in which a board may be tilted, beside not at all."""
_LEAST_SPACING = 8.0 / 960.0
"""px between corners over the picture's width below which boards are not found well."""
_NEW = 0.4
"""Fraction by which corners where none were seen yet count as lowering the variance."""
NEAR = 0.15
"""Distance in the picture, over its width, within which two places for the board are one."""
_LINES = 6
"""Lines that a drawn board has along each side."""
_BEND = 1e-3
"""How far a board bends from view to view, over half its length (standard deviation)."""
_PRIOR = 0.05
"""Expected error before any view, over the picture's width: keeps what no view tells finite."""


@dataclass(frozen=True)
class Proposal:
    """A place for the board.

    Attributes:
        rotation, translation: (3, 3) and (3,) m, board to camera.
        outline: (n, 2) px, the board's edge in the picture, closed.
        grid: lines along the board's inner rows and columns, each (m, 2) px.
        gain: fraction by which it lowers the root of the mean expected variance over the picture.
        words: how to hold the board, after "hold the board".
        lens: through which it was drawn.
    """

    rotation: np.ndarray
    translation: np.ndarray
    outline: np.ndarray
    grid: tuple[np.ndarray, ...]
    gain: float
    words: str
    lens: Lens

    def seen(self, places: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) at which places (n, 2) m of the board would be seen."""
        return self.lens.project(np.column_stack([places, np.zeros(len(places))]) @ self.rotation.T + self.translation)

    @cached_property
    def middle(self) -> np.ndarray:
        """Middle of the outline, (2,) px."""
        return self.outline.mean(0)


def information(observations: fit.Observations, solution: fit.Solution, sigma_px: float, length: float) -> np.ndarray:
    """Information that each view brings about the lens and its pupil, its pose and the bend of its board being unknown.

    Were the errors of corners alone counted, the same few slanted views would be asked for again and again, and what
    they say is wrong as soon as the board bends.

    Args:
        observations: whose `view`, `points` and `sigma` count; the pixels do not.
        solution: lens and poses.
        sigma_px: standard deviation of a common corner's error along one axis.
        length: m, the unit of the pupil.

    Returns:
        (views, m, m), in units of 1 / sigma_px²; the pupil, in `length`, is the last of the m.
    """
    o, R = observations, solution.rotations[observations.view]
    turned = np.einsum("nij,nj->ni", R, fit.surface(o.points, solution.shape, o.half_extent))
    points = turned + solution.translations[o.view]
    _, by_point, by_lens, by_pupil = project_jacobian(solution.lens, points, solution.pupil)
    by_lens = np.concatenate([by_lens, length * by_pupil[:, :, None]], 2)
    bend = np.stack(
        [R[:, :, 2] * (1 - (p / h) ** 2)[:, None] for p, h in zip(o.points.T, o.half_extent, strict=True)], -1
    )
    own = np.concatenate([-by_point @ pose.cross_matrix(turned), by_point, by_point @ bend], -1)
    unseen = ~(np.isfinite(own).all((1, 2)) & np.isfinite(by_lens).all((1, 2)))
    own[unseen], by_lens[unseen] = 0.0, 0.0
    own, common = own / o.sigma[:, None, None], by_lens / o.sigma[:, None, None]
    A = o.per_view(np.einsum("nia,nib->nab", common, common))
    B = o.per_view(np.einsum("nia,nib->nab", own, common))
    C = o.per_view(np.einsum("nia,nib->nab", own, own))
    known = np.append(np.zeros(6), np.full(2, (sigma_px / (_BEND * o.half_extent.max())) ** 2))
    C += np.diag(known) + (1e-9 * np.einsum("vaa->v", C[:, :6, :6]) + 1e-12)[:, None, None] * np.eye(8)
    return A - np.swapaxes(B, 1, 2) @ np.linalg.solve(C, B)


def field(lens: Lens, width: int, height: int, lit: Mask) -> np.ndarray:
    """Return F (m, m): trace(F covariance) is the mean variance over the lit picture, px², a turn not counted."""
    pixels = grid(width, height, 60).reshape(-1, 2)
    rays = lens.unproject(pixels[lit(pixels)])
    rays = rays[np.isfinite(rays).all(1) & (pose.angle_from_axis(rays) < 0.99 * lens.theta_max)]
    _, by_point, by_lens = lens.project_jacobian(rays)
    turn = (-by_point @ pose.cross_matrix(rays)).reshape(-1, 3)
    J = by_lens.reshape(len(turn), -1)
    J = J - turn @ np.linalg.lstsq(turn, J, rcond=None)[0]
    return J.T @ J / max(len(rays), 1)


def places(lens: Lens, board: Board, width: int, height: int, lit: Mask) -> tuple[np.ndarray, np.ndarray]:
    """Poses in which a person can hold the board so that all of it is seen well.

    Returns:
        rotations (k, 3, 3) and translations (k, 3) m, board to camera.
    """
    u, v = (np.linspace(0.08, 0.92, count) * (side - 1) for count, side in ((8, width), (6, height)))
    aims = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    rays = lens.unproject(aims[lit(aims)])
    rays = rays[np.isfinite(rays).all(1)]
    across = np.cross([0.0, 1.0, 0.01], rays)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    facing = np.stack([across, np.cross(rays, across), rays], -1)
    about = np.arange(_TURNS) * 2 * np.pi / _TURNS
    lean = np.concatenate([np.zeros((1, 3)), _TILT * np.stack([np.cos(about), np.sin(about), 0 * about], -1)])
    upright, lying = np.eye(3), pose.rotation_from_vector(np.array([[0.0, 0.0, np.pi / 2]]))[0]
    tilts = np.concatenate([pose.rotation_from_vector(lean) @ roll for roll in (upright, lying)])
    outer = board.printed_m / 2 + 0.5 * board.square_m  # with a part of the quiet border
    shorter = lens.unproject(np.array([[width, height]]) / 2 + min(width, height) * np.array([[-0.4, 0], [0.4, 0]]))
    angle = np.arccos(np.clip(shorter[0] @ shorter[1], -1, 1)) if np.isfinite(shorter).all() else 1.0
    distances = outer.max() / np.tan(np.minimum(np.array(_SIZES) * angle / 2, 1.2))
    rotations = np.repeat((facing[:, None] @ tilts[None]).reshape(-1, 3, 3), len(distances), 0)
    rays = np.repeat(rays, len(tilts), 0)
    translations = (rays[:, None] * distances[None, :, None]).reshape(-1, 3)
    good = _seen_well(lens, board, outer, rotations, translations, width, height, lit)
    return rotations[good], translations[good]


def _seen_well(
    lens: Lens,
    board: Board,
    outer: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    width: int,
    height: int,
    lit: Mask,
) -> np.ndarray:
    """Tell which poses show the whole board, lit, not too small and not too slanted: (k,) bool."""
    s = np.array([-1.0, 0.0, 1.0])
    grid = np.stack(np.meshgrid(s, s), -1).reshape(-1, 2)
    flat = np.concatenate([grid * outer, grid * board.half_extent])
    points = np.concatenate([flat, np.zeros((len(flat), 1))], 1)
    inside = np.einsum("kij,nj->kni", rotations, points) + translations[:, None]
    seen = lens.project(inside.reshape(-1, 3)).reshape(len(inside), -1, 2)
    good = np.isfinite(seen).all((1, 2)) & (seen > 4).all((1, 2)) & (seen < np.array([width, height]) - 5).all((1, 2))
    good[good] = lit(seen[good].reshape(-1, 2)).reshape(-1, seen.shape[1]).all(1)
    corners = seen[:, 9:].reshape(-1, 3, 3, 2)
    sides = [np.linalg.norm(np.diff(corners, axis=axis), axis=3).min((1, 2)) for axis in (2, 1)]  # along rows, columns
    with np.errstate(invalid="ignore"):
        good &= (np.array(sides) / board.half_extent[:, None] * board.square_m > _LEAST_SPACING * width).all(0)
    slant = np.einsum("ki,kni->kn", rotations[:, :, 2], inside) / np.linalg.norm(inside, axis=2)
    return good & (slant > np.cos(np.deg2rad(65.0))).all(1)


def propose(
    board: Board,
    solution: fit.Solution,
    seen: fit.Observations,
    width: int,
    height: int,
    lit: Mask = lambda pixels: np.ones(len(pixels), bool),
    avoid: tuple[np.ndarray, ...] = (),
) -> Proposal | None:
    """Propose the place for the board after which the lens will be known best; None where no place is seen well.

    Args:
        board: the board.
        solution: what is known of the lens, and the poses of the views so far.
        seen: corners of these views.
        width, height: px, of the pictures.
        lit: which pixels light reaches.
        avoid: places (2,) px that the person could not reach.
    """
    lens = solution.lens
    rotations, translations = places(lens, board, width, height, lit)
    if len(avoid):
        aimed = lens.project(translations)
        near = np.min([np.linalg.norm(aimed - place, axis=1) for place in avoid], axis=0) < NEAR * width
        rotations, translations = rotations[~near], translations[~near]
    if not len(rotations):
        return None
    few = _some_corners(board)
    k, n = len(rotations), len(few)
    tried = fit.Observations(
        np.repeat(np.arange(k), n), np.tile(few, (k, 1)), np.zeros((k * n, 2)), np.ones(k * n), board.half_extent
    )
    sigma = solution.sigma_px if np.isfinite(solution.sigma_px) and solution.sigma_px > 0 else 0.2
    length = fit.pupil_unit(seen, solution)
    brought = information(tried, replace(solution, rotations=rotations, translations=translations), sigma, length)
    brought *= len(board.points) / n
    F = field(lens, width, height, lit)
    scale = 1 / np.sqrt(np.maximum(np.diag(F), 1e-30))
    F = F * np.outer(scale, scale)
    before = (F + 1e-6 * np.eye(len(F))) * (sigma / (_PRIOR * width)) ** 2
    # The fit lets the pupil move: views that do not tell it from the lens, as those from one distance, teach little.
    F, before, scale = np.pad(F, (0, 1)), np.pad(before, (0, 1)), np.append(scale, 1.0)
    before[-1, -1] = (solution.doubt * sigma / PUPIL.sd) ** 2
    known = before + information(seen, solution, sigma, length).sum(0) * np.outer(scale, scale)
    variance = sigma**2 * np.einsum("ab,kba->k", F, np.linalg.inv(known + brought * np.outer(scale, scale)))
    # The model of the lens is the same on all sides, the lens may not be.
    best = int(
        np.argmin(variance * (1 - _NEW * _new_share(board, solution, seen, rotations, translations, width, height)))
    )
    sd_px, now = float(np.sqrt(variance[best])), sigma * float(np.sqrt(np.trace(F @ np.linalg.inv(known))))
    return _proposal(board, lens, rotations[best], translations[best], width, height, 1 - sd_px / now)


def first(board: Board, lens: Lens, width: int, height: int) -> Proposal:
    """Propose a place for the first view: in the middle, facing the camera, half as high as the picture.

    Args:
        board: the board.
        lens: a guess.
        width, height: px, of the pictures.
    """
    outer = board.printed_m / 2
    ray = lens.unproject(np.array([[(width - 1) / 2, height / 4]]))[0]
    away = float(outer[1]) * ray[2] / max(float(np.hypot(ray[0], ray[1])), 1e-9)
    return _proposal(board, lens, np.eye(3), np.array([0.0, 0.0, away]), width, height, 1.0)


def _new_share(
    board: Board,
    solution: fit.Solution,
    seen: fit.Observations,
    rotations: np.ndarray,
    translations: np.ndarray,
    width: int,
    height: int,
) -> np.ndarray:
    """Share of each board's corners that would be where no corner was seen yet, (k,)."""
    few = _some_corners(board)
    inside = np.einsum("kij,nj->kni", rotations[:, :, :2], few) + translations[:, None]
    pixels = solution.lens.project(inside.reshape(-1, 3))
    counts = coverage(seen.pixels, width, height)
    rows, columns = counts.shape
    x, y = ((pixels[:, i] + 0.5) / side for i, side in enumerate((width, height)))
    empty = counts[(rows * y).astype(int).clip(0, rows - 1), (columns * x).astype(int).clip(0, columns - 1)] == 0
    return empty.reshape(len(rotations), -1).mean(1)


def _some_corners(board: Board) -> np.ndarray:
    """Nine corners spread over the board, (9, 2) m, which stand for all."""
    s = np.array([-1.0, 0.0, 1.0])
    return np.stack(np.meshgrid(s, s), -1).reshape(-1, 2) * board.half_extent


def _proposal(board: Board, lens: Lens, R: np.ndarray, t: np.ndarray, width: int, height: int, gain: float) -> Proposal:
    """Draw a place for the board, and put it into words."""
    outer = board.printed_m / 2
    s = np.linspace(-1, 1, 13)
    one = np.ones_like(s)
    edge = np.concatenate([np.stack(side, -1)[:-1] for side in ((s, -one), (one, s), (-s, one), (-one, -s))])
    lines = [np.stack([s, y * one], -1) for y in np.linspace(-1, 1, _LINES)[1:-1]]
    lines += [np.stack([x * one, s], -1) for x in np.linspace(-1, 1, _LINES)[1:-1]]

    def seen(part: np.ndarray) -> np.ndarray:
        return lens.project(np.column_stack([part * outer, np.zeros(len(part))]) @ R.T + t)

    outline = seen(edge)
    words = _words(outline, R, t, lens, width, height)
    return Proposal(R, t, outline, tuple(map(seen, lines)), gain, words, lens)


def _words(outline: np.ndarray, R: np.ndarray, t: np.ndarray, lens: Lens, width: int, height: int) -> str:
    x, y = outline.mean(0) / [width, height]
    place = (
        f"{'top' if y < 0.36 else 'bottom' if y > 0.64 else ''} {'left' if x < 0.36 else 'right' if x > 0.64 else ''}"
    )
    place = " ".join(place.split())
    share = 100 * float(np.ptp(outline[:, 0])) / width
    where = f"at the {place}" if place else "in the middle"
    words = [where, f"as wide as {max(5 * round(share / 5), 5)} % of the picture"]
    ray = t / np.linalg.norm(t)
    slant = np.degrees(np.arccos(np.clip(R[:, 2] @ ray, -1, 1)))
    if slant > 12:
        # The point of the board's rim that is nearest to the camera, and where it is in the picture.
        depth = R.T @ ray
        nearest = t - 0.1 * np.linalg.norm(t) * R[:, :2] @ (depth[:2] / max(float(np.linalg.norm(depth[:2])), 1e-12))
        du, dv = (lens.project(nearest[None]) - lens.project(t[None]))[0]
        side = ("right" if du > 0 else "left") if abs(du) > abs(dv) else ("lower" if dv > 0 else "upper")
        words.append(f"turned by {5 * round(slant / 5):.0f}° so that its {side} edge is nearer to the camera")
    return ", ".join(words)
