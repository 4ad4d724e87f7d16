"""The cases of the bench of trackers by their names, and which of them may decide about settings."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import walks
from features_scenes import FEATURED
from tracking_scenes import EASY, HARD, Rng, Scene
from tracking_worlds import COARSE, WORLDS

SYNTHETIC: dict[str, Callable[[Rng], Scene]] = {**EASY, **HARD, **WORLDS, **FEATURED}
FIRST_DECIDING = 100  # seeds of synthetic cases from here on may decide
REAL = ("hotel", "zara01", "zara01occ", "zara02")

MORE = {  # seeds of the default tracker and a few others, where chance weighs heavily
    **dict.fromkeys((*EASY, *COARSE), 40),
    **dict.fromkeys(("turning-back", "crossing", "comings-goings", "weak", "asynchronous", "damaged"), 10),
    **dict.fromkeys(("gaps", "dim-edge"), 100),
    **dict.fromkeys((name for name in WORLDS if name.startswith("leave")), 5),
    **dict.fromkeys(("meeting", "found30"), 20),
    **dict.fromkeys((name for name in FEATURED if not name.startswith(("ten", "long"))), 20),
    "unseen": 10,
    "clutter": 6,
    "ten": 10,
    "long-pair": 30,
}
ONCE = ("sitting", "flood")
TOO_MUCH = {  # hours, or minutes
    "jpda": ("clutter", "ten", "long-pair", *(name for name in WORLDS if name not in COARSE)),
    "stonesoup-gnn": ("clutter20", "crowd100", "sitting", "flood"),
    **dict.fromkeys(("no-hidden", "gnn", "sort", "bytetrack", "oc-sort"), ("flood",)),
}


def scene_of(case: str, seed: int, root: Path | None = None) -> Scene:
    """The scene of a case: synthetic, of a set of walks.py in a checkout at `root`, or a directory with a ready one."""
    rng = np.random.default_rng(seed)
    if case in SYNTHETIC:
        return SYNTHETIC[case](rng)
    if walks.dataset(case) and root is None:
        raise ValueError(f"{case} needs --walks")
    return walks.scene(rng, case, root) if root and walks.dataset(case) else walks.ready(Path(case))


def is_synthetic(case: str) -> bool:
    """Whether a case is made here, and not of real people's tracks."""
    return case in SYNTHETIC


def judged(cases: Iterable[str], seeds: range) -> list[str]:
    """Those of the cases that judge, and may not decide: the sets that say so, and synthetic seeds below 100."""
    out = []
    for case in cases:
        one = walks.dataset(case)
        if not one.decides if one else is_synthetic(case) and seeds[0] < FIRST_DECIDING:
            out.append(case)
    return out
