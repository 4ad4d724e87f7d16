"""Tracking: detections of several sensors become labelled tracks (MS-GLMB), in order of time, as they come.

`track` does the whole step. `merging` puts records on one clock; `fusion` gives them to a tracker (`trackers` lists
them) and delays its tracks by some steps to smooth them (`smoothing`). The GLMB filter (`glmb`) predicts
(`prediction`), weighs a record (`scan`), associates detections with people (`association`), begins tracks (`births`)
and computes the densities after the record (`posterior`). `partial` is for detections that show a direction or a
distance alone, `coverage` says where sensors see, and `unseen` where people may be whom none has seen. `agreement`
tells if two sensors disagree, by their `clocks` or their `frames`. `motion` and `gaussian` are what all trackers are
made of.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avcli.tracking.fusion import track

__all__ = ["track"]


def __getattr__(name: str) -> Any:
    if name == "track":  # lazily, since numpy takes longer to import than --help may take
        from avcli.tracking.fusion import track

        return track
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
