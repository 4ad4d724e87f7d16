"""All scores of a sequence in one record, and of several sequences together."""

from collections.abc import Sequence as List

import numpy as np

from avcli.metrics import clear, hota, identity, ospa, position, tgospa
from avcli.metrics.sequence import Sequence

HOTA_SUMMARY = ("HOTA", "DetA", "AssA", "DetRe", "DetPr", "AssRe", "AssPr", "LocA")
"""The columns of the thesis's tables 5.6 to 5.10."""
_SUMMARY = {
    "CLEAR": ("MOTA", "MOTP", "MODA", "IDSW", "Frag", "MT", "PT", "ML"),
    "Identity": ("IDF1", "IDP", "IDR"),
    "OSPA": ("OSPA", "OSPA2", "GOSPA"),
    "Position": ("RMSE", "MAE", "BirthDelay"),
}


def score(
    sequence: Sequence, d0: float = 2.0, cutoff: float | None = None, order: float = 1.0, window: int = 10
) -> dict[str, dict]:
    """Score tracks against ground truth by every metric.

    Args:
        sequence: ground truth and tracks.
        d0: m, distance at which the similarity max(0, 1 - d / d0) becomes zero.
        cutoff: m, of the OSPA family; by default d0 / 2, the distance up to which CLEAR and Identity match.
        order: of the OSPA family.
        window: frames, of OSPA(2).

    Returns:
        The sections "summary" (means over alpha, fractions), "HOTA", "CLEAR", "Identity", "Count", "OSPA" and
        "Position", with TrackEval's names where it has one.
    """
    cutoff = d0 / 2 if cutoff is None else cutoff
    matches = clear.match(sequence, d0)
    distances = ospa.set_distances(sequence, cutoff, order)
    trajectories = tgospa.tgospa(sequence, cutoff, order)
    frames = max(1, sequence.time.size)
    return _summarized(
        {
            "HOTA": {"alpha": np.round(hota.ALPHA, 2), **hota.hota(sequence, d0)},
            "CLEAR": clear.clear(sequence, matches),
            "Identity": identity.identity(sequence, d0),
            "Count": identity.count(sequence),
            "OSPA": {
                "cutoff": cutoff,
                "order": order,
                "window": window,
                "OSPA": float(distances.ospa.sum()) / frames,
                "OSPA_localization": float(distances.localization.sum()) / frames,
                "OSPA_cardinality": float(distances.cardinality.sum()) / frames,
                "OSPA2": float(ospa.ospa2(sequence, cutoff, order, window).sum()) / frames,
                "GOSPA": float(distances.gospa.sum()) / frames,
                "GOSPA_localization": float(distances.gospa_localization.sum()) / frames,
                "GOSPA_missed": float(distances.missed.sum()) / frames,
                "GOSPA_false": float(distances.false.sum()) / frames,
                "TGOSPA": trajectories and float(trajectories.total),
                "TGOSPA_switches": trajectories and float(trajectories.switches),
            },
            "Position": position.position(sequence, matches),
        }
    )


def combine(records: List[dict]) -> dict[str, dict]:
    """Combine the sequences of one tracker as TrackEval does (micro): every point counts the same.

    The OSPA family is averaged over all frames; T-GOSPA, which is a sum over them, is added up.

    Args:
        records: what `score` returned for each sequence, at least one, all with the same settings.
    """
    frames = np.array([record["Count"]["Frames"] for record in records])
    distances = dict(records[0]["OSPA"])
    for name in distances:
        if name in ("TGOSPA", "TGOSPA_switches"):
            power = distances["order"] if name == "TGOSPA" else 1
            parts = [record["OSPA"][name] for record in records]
            distances[name] = None if None in parts else sum(part**power for part in parts) ** (1 / power)
        elif name not in ("cutoff", "order", "window"):
            distances[name] = float(np.dot([record["OSPA"][name] for record in records], frames) / max(1, frames.sum()))
    return _summarized(
        {
            "HOTA": {"alpha": records[0]["HOTA"]["alpha"], **hota.combine([record["HOTA"] for record in records])},
            "CLEAR": clear.combine([record["CLEAR"] for record in records]),
            "Identity": identity.combine([record["Identity"] for record in records]),
            "Count": identity.combine_counts([record["Count"] for record in records]),
            "OSPA": distances,
            "Position": position.combine([record["Position"] for record in records]),
        }
    )


def mean(records: List[dict]) -> dict[str, float | None]:
    """Average the summaries of several sequences (macro): every sequence counts the same, None where none has it."""
    means = {}
    for name in records[0]["summary"]:
        known = [record["summary"][name] for record in records if record["summary"][name] is not None]
        means[name] = float(np.mean(known)) if known else None
    return means


def _summarized(sections: dict[str, dict]) -> dict[str, dict]:
    summary = {name: float(np.mean(sections["HOTA"][name])) for name in HOTA_SUMMARY}
    for section, names in _SUMMARY.items():
        summary |= {name: sections[section][name] for name in names}
    return {"summary": summary, **sections}
