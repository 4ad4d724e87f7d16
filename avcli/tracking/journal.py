"""What one record meant to the GLMB filter, as a record of its own (`avfuse --explain`)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from avcli.tracking.association import MISSED, Group, detection_of
from avcli.tracking.rates import Rates
from avcli.tracking.scan import Scan

SHOWN = 5  # joint hypotheses of a cluster that an account lists


def account(
    time: float,
    scan: Scan,
    rates: Rates,
    groups: Iterable[Group],
    unclaimed: Sequence[float],
    existence: Sequence[float],
    birth: Sequence[float],
    before: dict[str, float],
    errors: dict[str, Any],
    false_places: list[dict[str, Any]],
) -> dict[str, Any]:
    """Describe one record before births and deaths are known; explain.schema.json has the keys.

    Args:
        time: s.
        scan: the record.
        rates: what is known of its sensor.
        groups: the joint hypotheses after it.
        unclaimed: J probabilities that no labelled person caused the detection.
        existence: J probabilities that it is a person in that case.
        birth: J densities per m² of detections of new people.
        before: label -> existence before the record.
        errors: what is known of the errors of its sensor, see `errors.Errors.described`.
        false_places: where it detects somebody falsely again and again, see `false_places.FalsePlaces.state`.
    """
    people, clusters = {}, []
    for group in groups:
        for at, label in enumerate(group.labels):
            people[label] = _most_likely(group, at, label)
        best = [
            {
                "weight": min(math.exp(h.weight), 1.0),
                "detections": [None if j == MISSED else detection_of(j) for _, j in h.pairs],
            }
            for h in group.hypotheses[:SHOWN]
        ]
        clusters.append({"labels": list(group.labels), "count": len(group.hypotheses), "best": best})
    return {
        "timestamp": time,
        "sensor": scan.sensor.name,
        "expected_clutter": float(rates.clutter),
        "detection_probability": float(rates.detection),
        "detections": [
            {
                "position": position,
                "unclaimed": u,
                "person_if_unclaimed": e,
                "clutter_density": c,
                "stranger_density": b,
            }
            for position, u, e, c, b in zip(scan.z.tolist(), unclaimed, existence, scan.clutter, birth, strict=True)
        ],
        "people": [people[label] for label in sorted(people)],
        "clusters": clusters,
        "existence_before": before,
        "errors": errors,
        "false_places": false_places,
    }


def add_features(account: dict[str, Any], scan: Scan, labels: Sequence[int], likely: Iterable[int]) -> None:
    """Add to an account what the features of the detections say of the people in the likely rows.

    Args:
        account: as `account` made it.
        scan: the record.
        labels: n labels of the densities before it.
        likely: rows of known people.
    """
    if scan.evidence is None:
        return
    ratio = scan.evidence.ratio
    for j, detection in enumerate(account["detections"]):
        near = [row for row in likely if scan.gain[row, j] > 0]
        if near and not np.isnan(scan.evidence.vectors[j]).all():
            detection["features"] = {str(labels[row]): math.log(ratio[row, j]) for row in near}


def add_beliefs(account: dict[str, Any], rates: Rates, leaving: np.ndarray, last_seen: np.ndarray) -> None:
    """Add to an account what was believed before the record: how the sensor loses people, and who may have left.

    Args:
        account: as `account` made it.
        rates: what is known of the sensor.
        leaving: (n,) rates per second at which the n people of the account, by label, leave where they are.
        last_seen: (n,) s, when a sensor detected them last; -inf: never.
    """
    hiding, blindness = rates.hiding, rates.blindness
    account |= {
        "hide_rate": hiding.hide,
        "show_rate": hiding.show,
        "all_left": blindness.emptied / (blindness.emptied + blindness.returned),
        "blind": blindness.probability * (1 - blindness.left),
    }
    for person, rate, last in zip(account["people"], leaving.tolist(), last_seen.tolist(), strict=True):
        person["leave_rate"] = min(rate, 1e9)
        person["last_seen"] = None if last == -math.inf else last


def _most_likely(group: Group, at: int, label: int) -> dict[str, Any]:
    shares: dict[int | str, float] = {}
    for hypothesis in group.hypotheses:
        row, j = hypothesis.pairs[at][0], detection_of(hypothesis.pairs[at][1])
        what = "absent" if row < 0 else "missed" if j < 0 else j
        shares[what] = shares.get(what, 0.0) + math.exp(hypothesis.weight)
    what = max(shares, key=lambda key: (shares[key], str(key)))
    return {"label": label, "most_likely": what, "probability": min(shares[what], 1.0)}
