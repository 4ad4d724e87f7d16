"""How uncertain what a fit found is, from how the views of the board disagree.

Errors of corners are not independent: the bend of the board, blur and what the lens model misses are shared within a
view. A covariance that takes each corner's error for its own is several times too small on real photographs. Here each
view counts as one draw of an unknown error.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

_LEAST_LEFT = 1e-3
"""Least share of the information on one direction that must come from the other views."""
_LEAST_SHARE = 1e-12
"""Of the information on one direction, below which a view says nothing of it."""


class Views(NamedTuple):
    """What each view says about the common unknowns, its own pose eliminated (Schur); or many such sets of views.

    Attributes:
        information: (..., views, p, p).
        score: (..., views, p), the gradient, at the solution of all views or near it.
        cost: (..., views) sum of the whitened squared residuals, robust.
        freedom: (..., views) residuals of the view minus the unknowns of its pose.
        own: (..., views, p, p), `information` less what the view spends on unknowns that are eliminated and that other
            share, such as the places of the corners on the board; None: it spends nothing.
        prior: (..., p, p), information on the common unknowns that no view brings: it is from how they and those
            others are held; None: there is none.
        pull: (..., p), the gradient of what holds the common unknowns, where it is not in the scores; None: nothing.
        unsure: (..., p, p), the covariance of `pull` over `variance`; None: there is none.
    """

    information: np.ndarray
    score: np.ndarray
    cost: np.ndarray
    freedom: np.ndarray
    own: np.ndarray | None = None
    prior: np.ndarray | None = None
    pull: np.ndarray | None = None
    unsure: np.ndarray | None = None

    def of(self, keep: np.ndarray) -> "Views":
        """Some views only, which share nothing: `keep` (views,) bool, or indices; of (sets, n) so many sets of n."""
        return self._replace(**{name: getattr(self, name)[keep] for name in self._fields[:4]})

    @property
    def total(self) -> np.ndarray:
        """The information of all views together (..., p, p)."""
        total = self.information.sum(-3)
        return total if self.prior is None else total + self.prior

    @property
    def step(self) -> np.ndarray:
        """How far the solution of these views lies from where they were linearised, (..., p)."""
        scale, roots = _whitening(self.total)
        score = self.score.sum(-2) if self.pull is None else self.score.sum(-2) + self.pull
        return scale * _times(roots, _times(_turned(roots), scale * score))

    @property
    def variance(self) -> np.ndarray:
        """Variance of a whitened residual along one axis (...); infinite without residuals to spare."""
        left = self.freedom.sum(-1) - self.score.shape[-1]
        return np.where(left > 0, self.cost.sum(-1) / np.where(left > 0, left, 1.0), np.inf)


def stacked(sets: Sequence[Views]) -> Views:
    """Many sets of as many views each as one."""
    return Views(*[None if parts[0] is None else np.array(parts) for parts in zip(*sets, strict=True)])  # type: ignore[arg-type]


def noise(views: Views) -> np.ndarray:
    """Covariance (..., p, p) of the common unknowns if the error of each corner were its own."""
    to_unit = _to_unit(views)
    return views.variance[..., None, None] * (to_unit @ _turned(to_unit))


def covariance(views: Views, freedom: float | None = None) -> np.ndarray:
    """Covariance (..., p, p) of the common unknowns, each view a draw by itself; at least that of independent corners.

    Each view's score is set right for the part that the view itself took of the solution, and of what all views share
    beside it (`own`), so that the result is unbiased where the errors are independent (Bell and McCaffrey 2002, the
    estimator CR2). It is then multiplied by the
    variance of Student's t, since it is itself known from few views only. In the directions where independent errors of
    the corners explain more, theirs is taken.

    Args:
        views: at the solution or near it.
        freedom: degrees of freedom of Student's t, where the result is added to that of other views and both are known
            together, so that what holds both is no error of their difference; None: of these views alone, their number
            less one.

    Returns:
        infinite where there are no residuals to spare, or where there are no numbers.
    """
    count = views.score.shape[-2]
    known = np.isfinite(views.variance)
    variance = np.where(known, views.variance, 0.0)
    to_unit = _to_unit(views)
    left = views.score - _times(views.information, views.step[..., None, :])
    share, axes = np.linalg.eigh(
        _symmetric(_turned(to_unit)[..., None, :, :] @ views.information @ to_unit[..., None, :, :])
    )
    along = _times(_turned(axes), left @ to_unit)
    if views.own is None:
        along = along / np.sqrt(np.maximum(1 - share, _LEAST_LEFT))
    else:
        root = np.sqrt(np.maximum(share, _LEAST_SHARE))
        basis = to_unit[..., None, :, :] @ axes / root[..., None, :]
        kept = _symmetric(_turned(basis) @ views.own @ basis)
        kept = kept - share[..., None] * np.eye(share.shape[-1])
        part, turn = np.linalg.eigh(kept)
        rest = _times(_turned(turn), along / root) / np.sqrt(np.clip(part, _LEAST_LEFT, 1.0))
        along = root * _times(turn, rest)
    drawn = _times(axes, along)
    spread = _turned(drawn) @ drawn * student(count - 1 if freedom is None else freedom)
    if views.unsure is not None and freedom is None:
        spread = spread + variance[..., None, None] * (_turned(to_unit) @ views.unsure @ to_unit)
    known = known & np.isfinite(spread).all((-2, -1))  # a lens that went astray may have left no numbers
    spread = np.where(known[..., None, None], spread, 0.0)
    size, direction = np.linalg.eigh(spread)
    spread = direction * np.maximum(size, variance[..., None])[..., None, :] @ _turned(direction)
    return np.where(known[..., None, None], _symmetric(to_unit @ spread @ _turned(to_unit)), np.inf)


def pooled(views: Views) -> np.ndarray:
    """Covariance (p, p) if views disagree equally in all directions: that of independent corners, times `inflation`².

    Few views tell the disagreement in one direction poorly, and may agree in it by chance; they tell its mean over all
    directions better.
    """
    independent = noise(views)
    return max(inflation(covariance(views), independent), 1.0) ** 2 * independent


def inflation(spread: np.ndarray, independent: np.ndarray) -> float:
    """Root of the mean ratio of variances between a covariance (p, p) and that of independent errors, over all axes."""
    if not len(spread) or not (np.isfinite(spread).all() and np.isfinite(independent).all()):
        return np.inf
    scale, roots = _whitening(independent)
    to_unit = scale[:, None] * roots
    return float(np.sqrt(np.trace(to_unit.T @ spread @ to_unit) / len(spread)))


def student(freedom: float) -> float:
    """Variance of Student's t; that of 2.5 degrees of freedom, which is 5, where it is larger."""
    freedom = max(freedom, 2.5)
    return freedom / (freedom - 2)


def halves(count: int, splits: int, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Draw random splits of `count` views into two halves: pairs of ascending indices."""
    rng = np.random.default_rng(seed)
    orders = [rng.permutation(count) for _ in range(splits)]
    return [(np.sort(order[: count // 2]), np.sort(order[count // 2 :])) for order in orders]


def _to_unit(views: Views) -> np.ndarray:
    """(..., p, p), which takes errors of unit variance to those of the common unknowns."""
    scale, roots = _whitening(views.total)
    return scale[..., None] * roots


def _whitening(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`scale` (..., p) and `roots` (..., p, p): scale roots roots' scale is the inverse, however ill-conditioned."""
    scale = 1 / np.sqrt(np.maximum(np.einsum("...ii->...i", information), 1e-200))
    value, vector = np.linalg.eigh(_symmetric(information * scale[..., None] * scale[..., None, :]))
    return scale, vector / np.sqrt(np.maximum(value, 1e-16))[..., None, :]


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return (matrix + _turned(matrix)) / 2


def _turned(matrix: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrix, -1, -2)


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]
