"""Scores of tracks and detections against ground truth: HOTA, CLEAR, identity, the OSPA family, positions."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avcli.metrics.scoring import score as score

__all__ = ["score"]


def __getattr__(name: str) -> Any:
    # Not imported before it is asked for: `--help` reads avcli.metrics.settings and must not wait for numpy.
    if name != "score":
        raise AttributeError(f"module 'avcli.metrics' has no attribute {name!r}")
    from avcli.metrics.scoring import score

    return score
