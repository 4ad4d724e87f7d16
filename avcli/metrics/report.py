"""What a page says of scores: the tables, and for each tracker its curves over the threshold and over time."""

import html
from collections.abc import Sequence as List
from math import isfinite

import numpy as np

from avcli.metrics import registry, table
from avcli.metrics.run import Tracked, error_over_time


def section(records: List[dict], compare: bool = False) -> str:
    """Write the part of a page that holds the tables.

    Args:
        records: all metrics records.
        compare: set the thesis's figures beside ours.

    Returns:
        HTML.
    """
    return f"""<section aria-labelledby="table-title">
<h2 id="table-title">Scores</h2>
<div class="scroll" tabindex="0" role="region" aria-labelledby="table-title">
{table.render(records, "html", compare)}
</div>
<p class="soft">Fractions are in percent. &uarr; higher is better, &darr; lower is better.
The table scrolls sideways.</p>
<details class="soft"><summary>What the columns mean</summary><dl>
{_legend(records)}
</dl></details>
</section>"""


def over_time(tracked: Tracked) -> dict:
    """Describe how well a tracker did.

    Returns:
        "score", its HOTA as a fraction; "hota", its curves over alpha; "error", over time: "t" in s, "cm" (mean error
        of the matched people, null where none matches), and the numbers of people "missed" and of "false" tracks.
    """
    sequence, matches = tracked.sequence, tracked.case.matches
    error, _ = error_over_time(tracked)

    def unmatched(frame: np.ndarray, matched: np.ndarray) -> list[int]:
        count = np.bincount(frame, minlength=sequence.time.size)
        return (count - np.bincount(frame[matched], minlength=sequence.time.size)).tolist()

    return {
        "score": round(tracked.record["summary"]["HOTA"], 6),
        "hota": {part: np.round(tracked.record["HOTA"][part], 4).tolist() for part in ("HOTA", "DetA", "AssA", "LocA")},
        "error": {
            "t": [round(time, 4) for time in sequence.time.tolist()],
            "cm": [round(100 * value, 2) if isfinite(value) else None for value in error.tolist()],
            "missed": unmatched(sequence.truth.frame, matches.truth),
            "false": unmatched(sequence.track.frame, matches.track),
        },
    }


def _legend(records: List[dict]) -> str:
    """What each column of the tables means."""
    fields = registry.columns()
    if any("sensor" in record for record in records):
        names = {field.name for field in fields}
        fields += [field for field in registry.sensor_columns() if field.name not in names]
    return "\n".join(
        f"<dt>{html.escape(field.name.replace('_', ' '))}</dt><dd>{html.escape(field.text)}</dd>" for field in fields
    )
