"""The metrics, and the records that they make of one sequence and of several together.

A new metric is registered here, by its name in METRICS; a new number of a known metric is one more Field beside it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from avcli.metrics import clear, detections, hota, identity, ospa, position
from avcli.metrics.metric import Case, Field, Metric, Scores

METRICS: tuple[Metric[Case], ...] = (
    hota.METRIC,
    clear.METRIC,
    identity.IDENTITY,
    identity.COUNT,
    ospa.METRIC,
    position.METRIC,
)
"""Metrics of tracks, in the order of their sections in a record."""
SENSOR_METRIC = detections.METRIC
"""The metric of a sensor's detections."""

_ORDER = ("%", "count", "m", "s")


def every_metric() -> tuple[Metric[Any], ...]:
    """Return all metrics: those of tracks, and that of sensors."""
    return (*METRICS, SENSOR_METRIC)


def summary_fields() -> list[Field]:
    """Return the fields of the summary, in the order of a record."""
    return [field for metric in METRICS for field in metric.fields if field.summary]


def columns() -> list[Field]:
    """Return the fields that tables of tracks show: fractions first, then counts, metres, seconds and other units."""
    shown = [field for field in summary_fields() if field.column]
    return sorted(shown, key=lambda field: _ORDER.index(field.unit) if field.unit in _ORDER else len(_ORDER))


def sensor_columns() -> list[Field]:
    """Return the fields that tables of sensors show."""
    return [field for field in SENSOR_METRIC.fields if field.column]


def score_case(case: Case) -> dict[str, Scores]:
    """Score tracks against ground truth by every metric.

    Returns:
        "summary" (fractions, counts, m and s; curves by their means) and a section for each metric, with TrackEval's
        names where it has one.
    """
    return _with_summary({metric.name: metric.score(case) for metric in METRICS})


def combine(records: Sequence[dict], cases: Sequence[Case]) -> dict[str, Scores]:
    """Combine the sequences of one tracker as TrackEval does (micro): every point counts the same.

    Args:
        records: what `score_case` returned for each sequence, at least one, all with the same settings.
        cases: the sequences themselves, in the same order.
    """
    return _with_summary(
        {metric.name: metric.combine([record[metric.name] for record in records], cases) for metric in METRICS}
    )


def mean(records: Sequence[dict]) -> dict[str, float | None]:
    """Average the summaries of several sequences (macro): every sequence counts the same, None where none has it."""
    means = {}
    for name in records[0]["summary"]:
        known = [record["summary"][name] for record in records if record["summary"][name] is not None]
        means[name] = float(np.mean(known)) if known else None
    return means


def _with_summary(sections: dict[str, Scores]) -> dict[str, Scores]:
    summary = {}
    for metric in METRICS:
        for field in metric.fields:
            if field.summary:
                value = sections[metric.name][field.name]
                summary[field.name] = float(np.mean(value)) if field.kind == "curve" else value
    return {"summary": summary, **sections}
