"""How the benchmarks hand their figures over to `make bench`: one row a measured thing, in OUT/STAGE.figures.jsonl.

A row has the keys stage, case and tool, then cpu_s (CPU seconds of one `per`), and where there is one the error with
its unit. Smaller errors are better. Rows of one stage, case and error_unit are compared with each other.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def figure(
    stage: str, case: str, tool: str, cpu_s: float | None, per: str, error: float | None = None, error_unit: str = ""
) -> Row:
    """Return one row.

    Args:
        stage: the step that is measured, as "audio".
        case: what it was given, as "4 s, one walker".
        tool: what did it; those of the project start with "avcli".
        cpu_s: CPU seconds for one `per`; None where it was not measured.
        per: what was done in that time, as "frame".
        error: what was wrong with the result, the smaller the better; None where that was not measured.
        error_unit: unit of the error, as "dB".
    """
    row: Row = {"stage": stage, "case": case, "tool": tool, "cpu_s": cpu_s, "per": per}
    return row if error is None else {**row, "error": float(error), "error_unit": error_unit}


def hand_over(out: Path, stage: str, rows: Iterable[Row]) -> None:
    """Write the rows of one stage into a directory that is there."""
    (out / f"{stage}.figures.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def handed_over(out: Path) -> Iterator[Row]:
    """Yield the rows of all stages in a directory, by the name of the stage."""
    for path in sorted(out.glob("*.figures.jsonl")):
        yield from map(json.loads, path.read_text().splitlines())


def groups(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Sort rows that have an error and a time into those that can be compared: by stage, case and unit."""
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        if row.get("error") is not None and row["cpu_s"] is not None:
            found.setdefault((row["stage"], row["case"], row["error_unit"]), []).append(row)
    return found


def front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows than which no other is both as soon and as accurate, and better in one of the two."""

    def beats(one: Row, other: Row) -> bool:
        no_worse = one["cpu_s"] <= other["cpu_s"] and one["error"] <= other["error"]
        return no_worse and (one["cpu_s"], one["error"]) != (other["cpu_s"], other["error"])

    return sorted((r for r in rows if not any(beats(o, r) for o in rows)), key=lambda r: r["cpu_s"])
