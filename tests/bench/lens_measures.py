"""What the calibration benchmark measures of a lens, of whatever tool: held-out error, and how far two lenses differ.

Needs numpy alone, so that the Python that mrcal is installed for can import it.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class AnyLens(Protocol):
    """A lens of any tool: rays (n, 3) to pixels (n, 2) with derivatives, and back; NaN where it images nothing."""

    def project(self, points: np.ndarray) -> np.ndarray: ...

    def unproject(self, pixels: np.ndarray) -> np.ndarray: ...

    def project_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pixels (n, 2) and their derivatives to the points (n, 2, 3), and whatever follows."""


@dataclass(frozen=True)
class Corners:
    """Corners in views: view (n,) ascending, ids (n,) on the board, pixels (n, 2), and a pose of each view to start.

    rotations (views, 3, 3) and translations (views, 3) m take the board to the camera.
    """

    view: np.ndarray
    ids: np.ndarray
    pixels: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.rotations)


def held_out_errors(lens: AnyLens, board: np.ndarray, corners: Corners, views: np.ndarray) -> np.ndarray:
    """Distances (n,) px of the corners of `views` from where the lens puts them, the pose of each view fitted to it.

    The poses are fitted robustly (Huber, three times the median), for every tool in this same way.

    Args:
        lens: from other views.
        board: (ids, 3) m, the corners in the board's frame, bowed as the tool found it.
        corners: of all views.
        views: indices of those to measure.
    """
    errors = []
    for v in views:
        rows = corners.view == v
        points, pixels = board[corners.ids[rows]], corners.pixels[rows]
        errors.append(_posed_error(lens, points, pixels, corners.rotations[v], corners.translations[v]))
    return np.concatenate(errors) if errors else np.zeros(0)


def _posed_error(lens: AnyLens, points: np.ndarray, pixels: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    def at(R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turned = points @ R.T
        seen, by_point = lens.project_jacobian(turned + t)[:2]
        off = np.nan_to_num(pixels - seen, nan=100.0)
        J = np.concatenate([-by_point @ cross_matrix(turned), by_point], -1)
        return off, np.nan_to_num(J), np.linalg.norm(off, axis=1)

    def cost(length: np.ndarray, delta: float) -> float:
        return float(np.where(length < delta, length**2, 2 * delta * length - delta**2).sum())

    off, J, length = at(R, t)
    damping = 1e-3
    for _ in range(40):
        delta = max(3 * float(np.median(length)), 1e-3)
        weight = np.minimum(1.0, delta / np.maximum(length, 1e-12))
        H = np.einsum("nia,nib,n->ab", J, J, weight)
        g = np.einsum("nia,ni,n->a", J, off, weight)
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6), g)
        R_new, t_new = rotation(step[:3]) @ R, t + step[3:]
        moved = at(R_new, t_new)
        before, after = cost(length, delta), cost(moved[2], delta)
        if after < before:
            R, t, (off, J, length) = R_new, t_new, moved
            damping = max(damping / 6, 1e-9)
            if before - after < 1e-9 * before:
                break
        else:
            damping *= 6
            if damping > 1e8:
                break
    return length


def apart(one: AnyLens, other: AnyLens, pixels: np.ndarray) -> np.ndarray:
    """How far two lenses put the same rays from each other, (n,) px, after the turn of the camera that suits best.

    Args:
        one, other: the lenses.
        pixels: (n, 2) px of `one`; the turn is fitted over all of them. NaN where either images nothing.
    """
    rays = one.unproject(pixels)
    for _ in range(6):
        projected, by_point = other.project_jacobian(rays)[:2]
        good = np.isfinite(projected).all(1) & np.isfinite(by_point).all((1, 2))
        by_turn = -by_point[good] @ cross_matrix(rays[good])
        turn = np.linalg.lstsq(by_turn.reshape(-1, 3), (pixels - projected)[good].ravel(), rcond=None)[0]
        rays = rays @ rotation(turn).T
    return np.linalg.norm(pixels - other.project(rays), axis=1)


def halves(views: int, splits: int, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Random splits of the views into two disjoint halves, the same for every tool."""
    rng = np.random.default_rng(seed)
    orders = [rng.permutation(views) for _ in range(splits)]
    return [(np.sort(order[: views // 2]), np.sort(order[views // 2 :])) for order in orders]


def honesty(actual: list[np.ndarray], stated: list[np.ndarray]) -> float:
    """Root mean square, over the splits, of actual over stated difference of halves; 1 is honest, more is boastful.

    The 5 % of pixels that a tool itself states worst are left out: one pixel next to a pole outweighs all others.

    Args:
        actual: of each split, (n,) px between the lenses of its halves.
        stated: of each split, (n,) px, the root of the sum of both variances (u and v together).
    """
    ratios = []
    for apart_px, stated_px in zip(actual, stated, strict=True):
        both = np.isfinite(apart_px) & np.isfinite(stated_px)
        both &= stated_px <= np.quantile(stated_px[both], 0.95) if both.any() else both
        if both.any():
            ratios.append(np.mean(apart_px[both] ** 2) / np.mean(stated_px[both] ** 2))
    return float(np.sqrt(np.mean(ratios))) if ratios else float("nan")


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) that take w to v × w."""
    zero = np.zeros(v.shape[:-1])
    x, y, z = np.moveaxis(v, -1, 0)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def rotation(omega: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector (3,) rad."""
    angle = float(np.linalg.norm(omega))
    if angle < 1e-12:
        return np.eye(3)
    K = cross_matrix(omega / angle)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
