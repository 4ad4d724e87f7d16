"""How far boxes agree with labels: overlap, average precision, and the score as a probability."""

import numpy as np

LEAST = 0.3
"""Intersection over union from which a box shows the person of a label. Hand-made labels agree little better."""

Found = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of a picture: boxes (n, 4) [x0, y0, x1, y1], scores (n,), and labels (m, 4)."""


def overlaps(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Intersection over union (n, m) of boxes (n, 4) and (m, 4) [x0, y0, x1, y1]."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    shared = np.maximum(high - low, 0).prod(axis=2)
    areas = [(item[:, 2:] - item[:, :2]).prod(axis=1) for item in (boxes, others)]
    return shared / np.maximum(areas[0][:, None] + areas[1][None] - shared, 1e-9)


def within(boxes: np.ndarray) -> np.ndarray:
    """Shares (n, n) of each of the boxes (n, 4) [x0, y0, x1, y1] that lie in each of them."""
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return np.maximum(high - low, 0).prod(axis=2) / np.maximum(areas, 1e-9)[:, None]


def matched(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, least: float = LEAST) -> np.ndarray:
    """Whether each box (n,) shows the person of a label that no better box shows.

    Args:
        boxes: (n, 4) [x0, y0, x1, y1].
        scores: (n,); the best box takes its label first.
        labels: (m, 4).
        least: intersection over union.
    """
    right = np.zeros(len(boxes), bool)
    if not len(labels):
        return right
    overlap = overlaps(boxes, labels)
    for index in np.argsort(-scores, kind="stable"):
        best = int(overlap[index].argmax())
        if overlap[index, best] >= least:
            overlap[:, best], right[index] = 0.0, True
    return right


def judged(found: list[Found], least: float = LEAST) -> tuple[np.ndarray, np.ndarray, int]:
    """Scores (k,), falling, and whether each box is right (k,), of all pictures; and the number of labels."""
    scores = np.concatenate([score for _, score, _ in found]) if found else np.zeros(0)
    right = [matched(*one, least) for one in found]
    order = np.argsort(-scores, kind="stable")
    return scores[order], np.concatenate([*right, np.zeros(0, bool)])[order], sum(len(one[2]) for one in found)


def average_precision(found: list[Found], least: float = LEAST) -> float:
    """Area under the curve of precision over recall, all points (Everingham et al., 2010); 0 without labels."""
    _, right, count = judged(found, least)
    hits = np.cumsum(right)
    precision = np.maximum.accumulate((hits / np.arange(1, len(hits) + 1))[::-1])[::-1]
    return float(np.sum(np.diff(hits, prepend=0) * precision) / max(count, 1))


def platt(scores: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """Slope and shift of the logit that make a score the probability of being right (Platt, 1999, with his targets).

    Args:
        scores: (n,) in (0, 1).
        right: (n,) bool.
    """
    from scipy.special import expit

    x = np.log(scores / (1 - scores))
    good, bad = int(right.sum()), int((~right).sum())
    wanted = np.where(right, (good + 1) / (good + 2), 1 / (bad + 2))
    slope, shift = 1.0, 0.0
    for _ in range(200):
        p = expit(slope * x + shift)
        w = np.maximum(p * (1 - p), 1e-9)
        gradient = np.array([((wanted - p) * x).sum(), (wanted - p).sum()])
        hessian = np.array([[(w * x * x).sum(), (w * x).sum()], [(w * x).sum(), w.sum()]]) + 1e-6 * np.eye(2)
        step = np.clip(np.linalg.solve(hessian, gradient), -1, 1)
        slope, shift = slope + step[0], shift + step[1]
    return float(slope), float(shift)
