"""The thesis's own results, to stand beside ours.

Source: "Multimodal Audio-Visual Sensor Fusion for Multi-Object Tracking of Speakers in Indoor Environments", tables
5.6 to 5.9 (scenarios S1 to S4) and 5.10 (all scenarios together, as TrackEval combines sequences): MS-GLMB by audio
(M1), video (M2) and both (M3), in percent, in the order of COLUMNS.
"""

import re

COLUMNS = ("HOTA", "DetA", "AssA", "DetRe", "DetPr", "AssRe", "AssPr", "LocA")
_PERCENT = {
    "s1": {
        "audio": (47.7, 47.7, 47.7, 48.0, 98.4, 48.0, 98.4, 95.6),
        "video": (80.0, 80.0, 80.0, 81.6, 95.6, 81.6, 95.6, 94.0),
        "audio_video": (80.3, 80.3, 80.3, 81.9, 95.9, 81.9, 95.9, 94.0),
    },
    "s2": {
        "audio": (47.7, 47.7, 47.7, 48.0, 98.4, 48.0, 98.4, 95.6),
        "video": (35.1, 49.1, 25.1, 49.6, 92.5, 25.3, 93.4, 91.1),
        "audio_video": (79.4, 79.4, 79.4, 80.8, 94.7, 80.8, 94.7, 92.7),
    },
    "s3": {
        "audio": (15.6, 9.0, 26.9, 9.0, 92.9, 27.2, 92.9, 91.2),
        "video": (70.3, 69.5, 71.0, 71.5, 92.6, 72.8, 93.1, 91.4),
        "audio_video": (68.4, 67.6, 69.2, 69.4, 92.8, 70.9, 93.4, 91.5),
    },
    "s4": {
        "audio": (8.9, 7.5, 10.7, 7.6, 78.0, 12.2, 41.9, 83.4),
        "video": (70.8, 70.3, 71.4, 72.4, 92.7, 73.2, 93.3, 91.5),
        "audio_video": (65.1, 64.2, 65.9, 66.1, 92.4, 67.7, 93.1, 91.4),
    },
    "combined": {
        "audio": (26.32, 18.08, 38.40, 18.26, 93.59, 38.92, 89.60, 92.66),
        "video": (68.54, 68.61, 68.49, 70.40, 93.10, 70.17, 93.74, 91.83),
        "audio_video": (70.29, 69.38, 71.24, 71.18, 93.39, 72.88, 93.97, 92.04),
    },
}


def figures(record: dict) -> dict[str, float] | None:
    """The thesis's scores for a metrics record, as fractions under the names of COLUMNS; None where it has none.

    Args:
        record: its "tracker" is "audio", "video" or "audio_video"; its "sequence" begins with s1 to s4, or is
            "combined" and its "sequences" are just these four.
    """
    scenario = _scenario(record["sequence"])
    if record["sequence"] == "combined":
        together = sorted(str(_scenario(name)) for name in record["sequences"])
        scenario = "combined" if together == ["s1", "s2", "s3", "s4"] else None
    row = _PERCENT.get(scenario or "", {}).get(record["tracker"])
    return row and {name: round(percent / 100, 4) for name, percent in zip(COLUMNS, row, strict=True)}


def _scenario(name: str) -> str | None:
    found = re.match(r"s[1-4](?![0-9a-z])", name.lower())
    return found and found[0]
