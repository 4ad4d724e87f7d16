"""The normal equations of a fit, view by view, from which any part of the views is solved without another look.

The unknowns are common to all views (the lens, the board's shape), or of one view (its pose), or of one corner of the
board (where it really is on the print). Views share no pose and corners no place, so that either kind is eliminated
block by block, and what is left is small and dense (the Schur complement; Triggs et al. 2000, section 6.1).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from avcli.calibration.uncertainty import Views

POSE = 6
"""Unknowns of a view."""


class Step(NamedTuple):
    """A Gauss-Newton step: of the common unknowns (k,), of the poses (views, 6), and of the places (corners, 3) m."""

    common: np.ndarray
    own: np.ndarray
    errors: np.ndarray


class _Reduced(NamedTuple):
    """The equations after one kind of unknowns, "first", is eliminated.

    Attributes:
        dense: (q + k + 1,) squared: of the other kind, the common ones, and the right-hand side.
        fold: (blocks, size, q + k + 1), what the first kind follows from.
        diagonal: (blocks, size, size), of the first kind.
        by_corner: whether the places on the board are the first kind.
        q: unknowns of the other kind.
    """

    dense: np.ndarray
    fold: np.ndarray
    diagonal: np.ndarray
    by_corner: bool
    q: int


class Blocks(NamedTuple):
    """Whitened, robustly weighted normal equations.

    Attributes:
        gram: (views, k + 7, k + 7), products of the derivatives to the k common unknowns, to the pose, and of the
            residuals.
        cost: (views,), the robust cost.
        counts: (views,), residuals.
        place: (views, corners, 3, 3), products of the derivatives to a corner's place on the board; no corners where
            the places are known.
        cross: (views, corners, 3, k + 7), their products with the columns of `gram`.
        errors: (corners, 3) m, how far the corners are from where they should be.
        held: 1 / m², the weight with which `errors` are held at zero.
        prior: (k,), the weight with which each of the common unknowns is held.
        off: (k,), how far each of the common unknowns is from where it is held.
        doubt: (k,), how many times larger the standard deviation is that views tell them with, than if the error of
            each corner were its own. The weight in `prior` is so many times squared that of a residual.
    """

    gram: np.ndarray
    cost: np.ndarray
    counts: np.ndarray
    place: np.ndarray
    cross: np.ndarray
    errors: np.ndarray
    held: float
    prior: np.ndarray
    off: np.ndarray
    doubt: np.ndarray

    def of(self, keep: np.ndarray) -> "Blocks":
        """Some views only: `keep` (views,) bool, or indices."""
        return self._replace(
            gram=self.gram[keep],
            cost=self.cost[keep],
            counts=self.counts[keep],
            place=self.place[keep],
            cross=self.cross[keep],
        )

    def unheld(self) -> "Blocks":
        """The same, nothing being known of the common unknowns but by the views."""
        return self._replace(prior=np.zeros_like(self.prior))

    @property
    def total(self) -> float:
        """The cost of all views, and of the errors and the common unknowns that are held."""
        return float(self.cost.sum() + self.held * (self.errors**2).sum() + self.prior @ self.off**2)

    @property
    def pull(self) -> np.ndarray:
        """The gradient (k,) of what holds the common unknowns."""
        return -self.prior * self.off

    @property
    def unsure(self) -> np.ndarray:
        """The covariance (k, k) of `pull` over the variance of a residual."""
        return np.diag(self.prior * self.doubt**2)

    @property
    def _k(self) -> int:
        return self.gram.shape[-1] - POSE - 1

    def step(self, damping: float = 0.0) -> Step:
        """Solve for all unknowns, `damping` times the diagonal added (Levenberg and Marquardt)."""
        return self._solution(self._eliminated(damping))

    def _solution(self, reduced: _Reduced) -> Step:
        k = self._k
        response = _solved(reduced.dense[: reduced.q, : reduced.q], reduced.dense[: reduced.q, reduced.q :])
        left = reduced.dense[reduced.q :, reduced.q :] - reduced.dense[reduced.q :, : reduced.q] @ response
        common = _least(left[:k, :k], left[:k, k])
        other = response[:, k] - response[:, :k] @ common
        first = reduced.fold[..., -1] - reduced.fold[..., :-1] @ np.concatenate([other, common])
        if reduced.by_corner:
            return Step(common, other.reshape(-1, POSE), first)
        return Step(common, first, other.reshape(-1, 3))

    def after(self, step: Step) -> np.ndarray:
        """The cost of each view (views,) after a step of the common unknowns and the places, its own pose following."""
        k = self._k
        along = self.gram[:, :, :k] @ step.common  # products of the columns with what the step predicts
        explained = along[:, :k] @ step.common
        if self.place.shape[1]:
            along = along + np.einsum("vcij,ci->vj", self.cross, step.errors)
            moved = self.cross[..., :k] @ step.common + np.einsum("vcij,cj->vci", self.place, step.errors)
            explained = along[:, :k] @ step.common + np.einsum("vci,ci->v", moved, step.errors)
        rest = self.gram[:, k:-1, -1] - along[:, k:-1]
        followed = np.linalg.solve(damped(self.gram[:, k:-1, k:-1], 0.0), rest[..., None])[..., 0]
        return self.gram[:, -1, -1] - 2 * along[:, -1] + explained - (rest * followed).sum(1)

    def crossed(self, part: np.ndarray) -> float:
        """The cost of the views of each part (views,) after the step that the other parts take, their poses following.

        Where the places are known, each view's pose is eliminated once for all parts.
        """
        if self.place.shape[1]:
            rows = (part == fold for fold in np.unique(part))
            return sum(float(self.of(test).after(self.of(~test).step()).sum()) for test in rows)
        views, own = self.views, self.gram[:, -1, self._k : -1]
        followed = np.linalg.solve(damped(self.gram[:, self._k : -1, self._k : -1], 0.0), own[..., None])[..., 0]
        cost = float(self.gram[:, -1, -1].sum() - (own * followed).sum())
        for fold in np.unique(part):
            test = part == fold
            others, these = views.of(~test), views.of(test)
            step = _least(others.total, others.score.sum(0) + self.pull)
            cost += float(step @ these.information.sum(0) @ step - 2 * these.score.sum(0) @ step)
        return cost

    def follow(self, common: np.ndarray) -> np.ndarray:
        """How each pose (views, 6) follows a step of the common unknowns (k,), the places as they are."""
        k = self._k
        rest = self.gram[:, k:-1, -1] - self.gram[:, k:-1, :k] @ common
        return np.linalg.solve(damped(self.gram[:, k:-1, k:-1], 0.0), rest[..., None])[..., 0]

    def _eliminated(self, damping: float = 0.0) -> _Reduced:
        """Eliminate the kind of unknowns that leaves fewer of the other."""
        k, (views, corners) = self._k, self.place.shape[:2]
        A = self.gram[:, :k, :k].sum(0) + np.diag(self.prior)
        poses = damped(self.gram[:, k:-1, k:-1], damping)
        border = self.gram[:, k:-1][..., np.r_[:k, k + POSE]]  # of the poses: common unknowns, right-hand side
        end = np.empty((k + 1, k + 1))
        end[:k, :k] = A + damping * np.diag(np.diag(A))
        end[:k, k] = end[k, :k] = self.gram[:, :k, -1].sum(0) + self.pull
        end[k, k] = 0.0
        if not corners:
            return _eliminate(poses, border, end, by_corner=False, q=0)
        shared = self.cross.sum(0)
        shared[..., -1] -= self.held * self.errors
        places = damped(self.place.sum(0) + self.held * np.eye(3), damping)
        around = shared[..., np.r_[:k, k + POSE]]
        by_corner = POSE * views <= 3 * corners
        W = self.cross[..., k:-1]
        if by_corner:
            first, dense, q = places, poses, POSE * views
            between = W.transpose(1, 2, 0, 3).reshape(corners, 3, q)
            mine, theirs = around, border
        else:
            first, dense, q = poses, places, 3 * corners
            between = W.transpose(0, 3, 1, 2).reshape(views, POSE, q)
            mine, theirs = border, around
        whole = np.zeros((q + k + 1, q + k + 1))
        size = dense.shape[-1]
        at = np.arange(q).reshape(-1, size)
        whole[at[:, :, None], at[:, None, :]] = dense
        whole[:q, q:] = theirs.reshape(q, k + 1)
        whole[q:, :q] = whole[:q, q:].T
        whole[q:, q:] = end
        return _eliminate(first, np.concatenate([between, mine], -1), whole, by_corner=by_corner, q=q)

    @property
    def views(self) -> Views:
        """What each view says about the common unknowns, with its pose and the places of the corners eliminated."""
        return self.solved()[1] if self.place.shape[1] else self._views_of_known_places()

    def _views_of_known_places(self) -> Views:
        k = self._k
        A, B, C = self.gram[:, :k, :k], self.gram[:, k:-1, :k], self.gram[:, k:-1, k:-1]
        fold = np.linalg.inv(damped(C, 0.0)) @ B
        return Views(
            information=A - B.transpose(0, 2, 1) @ fold,
            score=self.gram[:, :k, -1] - (fold.transpose(0, 2, 1) @ self.gram[:, k:-1, -1:])[..., 0],
            cost=self.cost,
            freedom=self.counts - POSE,
            prior=np.diag(self.prior),
            pull=self.pull,
            unsure=self.unsure,
        )

    def solved(self) -> tuple[Step, Views]:
        """The step to the solution, and what each view says of the common unknowns there; the places are unknown too.

        The columns of the common unknowns are taken less what the places explain of them. A view that helps to tell the
        places pulls them towards itself, and leaves smaller scores: `own` says what is left of its information.
        """
        k, count = self._k, len(self.gram)
        reduced = self._eliminated()
        step = self._solution(reduced)
        gain, learned, spread = self._learned(reduced)
        flat = gain.reshape(-1, k)
        both = self.cross.reshape(count, len(flat), -1).transpose(0, 2, 1) @ flat
        moved = self.place @ gain
        square = flat.T @ moved.reshape(count, len(flat), k)
        A = self.gram[:, :k, :k] - both[:, :k] - both[:, :k].transpose(0, 2, 1) + square
        B = self.gram[:, k:-1, :k] - both[:, k:-1]
        fold = np.linalg.inv(damped(self.gram[:, k:-1, k:-1], 0.0)) @ B
        information = A - B.transpose(0, 2, 1) @ fold
        by_place = self.cross[..., :k] - moved - self.cross[..., k:-1] @ fold[:, None]
        by_place = by_place.reshape(count, len(flat), k).transpose(0, 2, 1)  # products with the columns of the places
        score = self.gram[:, :k, -1] - both[:, -1] - (fold.transpose(0, 2, 1) @ self.gram[:, k:-1, -1:])[..., 0]
        score = score - information @ step.common - by_place @ (gain @ step.common + step.errors).ravel()
        views = Views(
            information=information,
            score=score - score.mean(0),  # what pulls the errors to zero is not of a view
            cost=self.cost,
            freedom=self.counts - POSE - learned / count,
            own=information - by_place @ spread(by_place),
            prior=self.held * flat.T @ flat + np.diag(self.prior),
            unsure=self.unsure,
        )
        return step, views

    def _learned(self, reduced: _Reduced) -> tuple[np.ndarray, float, Callable[[np.ndarray], np.ndarray]]:
        """What the places of the corners tell.

        Returns:
            how they follow the common unknowns, (corners, 3, k); how many unknowns they amount to; and what takes
            (views, k, 3 corners) to the products with their covariance, (views, 3 corners, k).
        """
        k, q, corners = self._k, reduced.q, self.place.shape[1]
        inverse = np.linalg.inv(reduced.dense[:q, :q])
        response = inverse @ reduced.dense[:q, q : q + k]
        if not reduced.by_corner:
            known = 3 * corners - self.held * float(np.trace(inverse))
            return response.reshape(corners, 3, k), known, lambda rows: inverse @ rows.transpose(0, 2, 1)
        between, own = reduced.fold[..., :q], np.linalg.inv(reduced.diagonal)
        flat = between.reshape(-1, q)
        traced = np.trace(own, axis1=1, axis2=2).sum() + float(((flat @ inverse) * flat).sum())

        def spread(rows: np.ndarray) -> np.ndarray:
            apart = np.einsum("cij,vkcj->vcik", own, rows.reshape(len(rows), k, corners, 3))
            return apart.reshape(len(rows), -1, k) + flat @ (inverse @ (flat.T @ rows.transpose(0, 2, 1)))

        return reduced.fold[..., q : q + k] - between @ response, 3 * corners - self.held * float(traced), spread


def _eliminate(first: np.ndarray, border: np.ndarray, dense: np.ndarray, *, by_corner: bool, q: int) -> _Reduced:
    fold = np.linalg.inv(first) @ border
    size = border.shape[-1]
    left = dense - border.reshape(-1, size).T @ fold.reshape(-1, size)
    return _Reduced(left, fold, first, by_corner, q)


def damped(blocks: np.ndarray, damping: float | np.ndarray) -> np.ndarray:
    """Add `damping` times its diagonal to each of (..., m, m) blocks, and enough that none is singular."""
    diagonal = np.einsum("...ii->...i", blocks)
    out = blocks.copy()
    added = np.asarray(damping)[..., None] * diagonal + 1e-12 * diagonal.max(-1, initial=0.0, keepdims=True) + 1e-12
    np.einsum("...ii->...i", out)[...] += added
    return out


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.linalg.solve(matrix, right) if len(matrix) else right


def _least(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Solve a symmetric system whose unknowns differ by orders of magnitude, well enough even where it is singular."""
    if not len(vector):
        return vector
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    return scale * np.linalg.lstsq(matrix * np.outer(scale, scale), vector * scale, rcond=1e-15)[0]
