"""Errors of position, and how late a person is found."""

from collections.abc import Iterable

import numpy as np

from avcli.metrics.matching import Matches
from avcli.metrics.metric import Case, Field, Metric, Scores
from avcli.metrics.sequence import Sequence, length


def errors(sequence: Sequence, matches: Matches) -> np.ndarray:
    """Distances (p,) of matched points, m."""
    offset = sequence.truth.position[matches.truth] - sequence.track.position[matches.track]
    return length(offset)


def position(sequence: Sequence, matches: Matches) -> Scores:
    """Measure the error of matched points, and the delay between a person's first frame and its first match.

    Returns:
        Matches; RMSE, MAE, MaxError in m, None without a match; Found, how many of the people were ever matched;
        BirthDelay and MaxBirthDelay of these in s, None if there are none.
    """
    distance = errors(sequence, matches)
    identity = sequence.truth.identity
    appeared, found = (np.full(sequence.truth.label.size, np.inf) for _ in range(2))
    np.minimum.at(appeared, identity, sequence.time[sequence.truth.frame])
    np.minimum.at(found, identity[matches.truth], sequence.time[sequence.truth.frame[matches.truth]])
    delay = (found - appeared)[np.isfinite(found)]
    return {
        "Matches": distance.size,
        "RMSE": float(np.sqrt((distance**2).mean())) if distance.size else None,
        "MAE": float(distance.mean()) if distance.size else None,
        "MaxError": float(distance.max()) if distance.size else None,
        "Found": delay.size,
        "BirthDelay": float((delay / delay.size).sum()) if delay.size else None,
        "MaxBirthDelay": float(delay.max()) if delay.size else None,
    }


def combine(results: Iterable[Scores]) -> Scores:
    """Combine several sequences: every match and every person found counts the same."""
    results = list(results)
    matched = [r for r in results if r["Matches"]]
    matches, found = (sum(r[name] for r in results) for name in ("Matches", "Found"))

    def mean(name: str, weight: str, power: float = 1.0) -> float | None:
        total = sum(r[name] ** power * r[weight] for r in matched)
        return (total / sum(r[weight] for r in matched)) ** (1 / power) if matched else None

    return {
        "Matches": matches,
        "RMSE": mean("RMSE", "Matches", 2.0),
        "MAE": mean("MAE", "Matches"),
        "MaxError": max((r["MaxError"] for r in matched), default=None),
        "Found": found,
        "BirthDelay": mean("BirthDelay", "Found"),
        "MaxBirthDelay": max((r["MaxBirthDelay"] for r in matched), default=None),
    }


METRIC: Metric[Case] = Metric(
    name="Position",
    text="errors of the matched points, and the delay until each person is found; null if nothing matches",
    fields=(
        Field("RMSE", "root mean square distance of the matches", "m", "down", True, "RMSE", optional=True),
        Field("MAE", "mean distance of the matches", "m", "down", True, optional=True),
        Field(
            "BirthDelay",
            "mean time from a person's first record to the first match",
            "s",
            "down",
            True,
            "Delay",
            optional=True,
        ),
        Field("MaxError", "largest distance of a match", "m", "down", optional=True),
        Field("MaxBirthDelay", "longest such time", "s", "down", optional=True),
        Field("Matches", "matched points", "count", "up"),
        Field("Found", "people who were matched at least once", "count", "up"),
    ),
    score=lambda case: position(case.sequence, case.matches),
    combine=lambda scores, _cases: combine(scores),
)
