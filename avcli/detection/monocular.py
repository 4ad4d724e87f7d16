"""The position of a person from a box in one colour picture, by the lens and the camera's pose.

A standing body of unknown position and height is fitted to the box, and to the points of torso, head and foot where a
network gives them: least squares over x, y and height, with a prior on the height. The picture's border cuts the
modelled box as it cuts the real one. The covariance is that of the fit: long along the ray, short across it.
"""

import numpy as np

from avcli.detection.fitted import BOX, BoxLaw
from avcli.detection.view import View

HEIGHT_M, HEIGHT_SPREAD_M = 1.70, 0.12
"""m; mean and standard deviation of people's heights."""

PART_HEIGHTS = np.array([0.54, 0.93, 0.0])
"""Heights of torso, head and foot as parts of the body's."""

HIDDEN = 2.0
"""Factor on the standard deviation of a side of the box that lies inside the body's: the body may be hidden there."""

_TILT = 2 * np.pi * np.arange(12) / 12
_RING = np.stack([np.cos(_TILT), np.sin(_TILT)], axis=1)
_OUTLINE = np.concatenate(  # a body of height 1: parts of the height, with the radii (m) that limbs reach on average
    [
        np.column_stack([radius * _RING, np.full(12, part)])
        for part, radius in ((0.02, 0.20), (0.25, 0.18), (0.5, 0.24), (0.80, 0.24), (0.90, 0.10), (1.0, 0.06))
    ]
)


def locate_box(
    box: np.ndarray, view: View, parts: np.ndarray | None = None, law: BoxLaw = BOX
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Find the position of the person whose picture fills a box.

    Args:
        box: (4,) [x0, y0, x1, y1] px, corner-based; may reach over the picture's border.
        view: the camera.
        parts: (3, 2) px of torso, head and foot; None if unknown.
        law: the fitted errors of boxes and of positions by them.

    Returns:
        (x, y) m; covariance (2, 2) m²; and the height, m. None if the lens does not see there, the ray does not meet
        the lower part of the room, no body fits the box, or less than a tenth of the body is in the picture.
    """
    size = np.array([*view.size, *view.size], float)
    box = np.clip(box, 0.0, size)
    middle = (box[:2] + box[2:]) / 2 if parts is None else parts[0]
    measured = box if parts is None else np.concatenate([box, parts.ravel()])
    cut = (box[:2] < 2).any() or (box[2:] > size[2:] - 2).any()
    fits = []
    for z in (0.9, 0.3) if cut else (0.9,):  # the border may cut off all but the legs
        start = _on_plane(middle, view, z)
        fit = None if start is None else _fit(np.array([*start, HEIGHT_M]), measured, view, law)
        if fit is not None:
            fits.append(fit)
    if not fits:
        return None
    state, covariance, _ = min(fits, key=lambda fit: fit[2])
    whole = _predict(state, view, False, whole=True)
    if whole is None or (box[2:] - box[:2]).prod() < 0.1 * (whole[2:] - whole[:2]).prod():
        return None  # a foot at the border says too little
    return state[:2], covariance, float(state[2])


def _fit(
    state: np.ndarray, measured: np.ndarray, view: View, law: BoxLaw
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Fit x, y and height (3,) to the measured box (4,) or box and parts (10,) px by Gauss and Newton's method.

    Returns the state, the covariance (2, 2) of x and y, and the cost; None where the fit leaves the lens or the room.
    """
    parts = len(measured) > 4
    predicted = _predict(state, view, parts, whole=True)
    if predicted is None:
        return None
    extent = np.sqrt(max((predicted[2:4] - predicted[:2]).prod(), 1.0))
    spread = np.full(len(measured), law.side * extent + 1.0)
    spread[4:] *= law.part
    mean, prior = np.array([0.0, 0.0, HEIGHT_M]), np.diag([0.0, 0.0, HEIGHT_SPREAD_M**-2])
    for _ in range(8):
        predicted = _predict(state, view, parts)
        moved = [_predict(state + 0.01 * unit, view, parts) for unit in np.eye(3)]
        if predicted is None or any(item is None for item in moved):
            return None
        jacobian = (np.array(moved) - predicted).T / 0.01
        told = np.isfinite(predicted) & np.isfinite(jacobian).all(axis=1)
        jacobian[~told] = 0.0
        error = np.where(told, measured - predicted, 0.0)
        shorter = np.append(error[:2] > 0, error[2:4] < 0)
        doubt = spread.copy()
        doubt[:4][shorter] *= HIDDEN  # that side of the body may be hidden
        weights = 1.0 / np.maximum(np.abs(error / doubt) / 2.0, 1.0) / doubt**2  # Huber: an arm moves one side only
        information = jacobian.T @ (weights[:, None] * jacobian) + prior + np.eye(3)
        step = np.linalg.solve(information, jacobian.T @ (weights * error) + prior @ (mean - state))
        step *= min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-12))
        state = state + step
        if np.abs(step).max() < 1e-3:
            break
    cost = float(weights @ error**2)
    if not np.isfinite(state).all() or not 0.5 < state[2] < 2.6:
        return None
    # One body does not explain a half-hidden one. A sitting person fills another box, but the parts fit.
    side = np.sqrt((measured[2:4] - measured[:2]).prod())
    in_place = parts and np.sqrt(np.mean(error[4:] ** 2)) < 0.1 * side
    if _shared(predicted[:4], measured[:4]) < (0.4 if in_place else 0.5):
        return None
    surplus = max(cost / max(int(told.sum()) - 3, 1), 1.0)  # of misfit over what was expected (Birge, 1932)
    covariance = law.spread * surplus * np.linalg.inv(information)[:2, :2] + law.floor_m**2 * np.eye(2)
    return state, (covariance + covariance.T) / 2, cost


def _shared(box: np.ndarray, other: np.ndarray) -> float:
    """The fraction of their union that two boxes (4,) share."""
    shared = np.maximum(np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2]), 0).prod()
    return float(shared / max((box[2:] - box[:2]).prod() + (other[2:] - other[:2]).prod() - shared, 1e-9))


def _on_plane(pixel: np.ndarray, view: View, z: float) -> np.ndarray | None:
    """(x, y) m where the ray of a corner-based pixel (2,) meets the height z; None where it does not."""
    ray = view.unproject(pixel[None] - 0.5)[0]
    fall = z - view.origin[2]
    if not np.isfinite(ray).all() or ray[2] * fall <= 0 or abs(ray[2]) < 1e-3:
        return None
    return (view.origin + ray * (fall / ray[2]))[:2]


def _predict(state: np.ndarray, view: View, parts: bool, *, whole: bool = False) -> np.ndarray | None:
    """The box (4,), cut at the picture's border unless `whole`, and the parts (6,) of a body; None if not seen."""
    body = np.column_stack([_OUTLINE[:, :2] + state[:2], _OUTLINE[:, 2] * state[2]])
    if parts:
        axis = np.column_stack([np.tile(state[:2], (3, 1)), PART_HEIGHTS * state[2]])
        body = np.concatenate([body, axis])
    pixels = view.project(body) + 0.5
    outline = pixels[: len(_OUTLINE)]
    outline = outline[np.isfinite(outline).all(axis=1)]
    if not len(outline):
        return None
    box = np.concatenate([outline.min(axis=0), outline.max(axis=0)])
    if not whole:
        box = np.clip(box, 0.0, [*view.size, *view.size])
    if not parts:
        return box
    return np.concatenate([box, pixels[len(_OUTLINE) :].ravel()])  # NaN where the lens does not see a part
