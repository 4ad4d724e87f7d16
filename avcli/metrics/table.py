"""Metrics records as tables: for a terminal, and as CSV, markdown and LaTeX."""

import csv
import io
from collections.abc import Sequence

from avcli.metrics import thesis
from avcli.metrics.score import HOTA_SUMMARY

PERCENT = (*HOTA_SUMMARY, "MOTA", "MOTP", "MODA", "IDF1", "IDP", "IDR")
"""Summary fields that are fractions and shown in percent."""
_COUNTS = ("IDSW", "Frag", "MT", "PT", "ML")
_COLUMNS = (*HOTA_SUMMARY, "MOTA", "IDF1", "IDSW", "OSPA", "OSPA2", "GOSPA", "RMSE", "BirthDelay")
_UNITS = {"OSPA": "m", "OSPA2": "m", "GOSPA": "m", "RMSE": "m", "BirthDelay": "s"}
_BETTER = dict.fromkeys(PERCENT, "↑") | dict.fromkeys(("IDSW", "OSPA", "OSPA2", "GOSPA", "RMSE", "BirthDelay"), "↓")


def render(records: Sequence[dict], kind: str, compare: bool = False, width: int | None = None) -> str:
    """Lay out metrics records.

    Args:
        records: with "sequence", "tracker" and "summary".
        kind: "table", "csv", "markdown" or "latex".
        compare: set the thesis's figures and the difference beside ours, HOTA and its parts only.
        width: characters that a "table" may be wide; columns that would not fit are left out.
    """
    columns = HOTA_SUMMARY if compare else _COLUMNS
    if kind == "csv":
        return _csv(records, compare)
    sequences = list(dict.fromkeys(record["sequence"] for record in records))
    records = sorted(records, key=lambda record: sequences.index(record["sequence"]))
    rows = [row for record in records for row in _rows(record, columns, compare)]
    if kind == "markdown":
        return _markdown(rows, columns, compare)
    if kind == "latex":
        return _latex(rows, columns, compare)
    return _table(rows, columns, width)


def percent(name: str, value: float | None) -> str:
    """Show a summary value: a fraction in percent, metres and seconds with three decimals, a count as it is."""
    if value is None:
        return "-"
    if name in PERCENT:
        return f"{100 * value:.1f}"
    return f"{value:g}" if name in _COUNTS else f"{value:.3f}"


def _rows(record: dict, columns: Sequence[str], compare: bool) -> list[tuple[str, str, str, list[str]]]:
    """Sequence, tracker, whose figures ("" for ours) and the cells, of each line of one record."""
    summary = record["summary"]
    average = f" ({record['average']})" if "average" in record else ""
    names = record["sequence"] + average, record["tracker"]
    rows = [(*names, "", [percent(name, summary[name]) for name in columns])]
    theirs = thesis.figures(record) if compare else None
    if theirs:
        # Both are rounded to the thesis's one decimal first, so that the three lines add up as they are read.
        rows.append((*names, "thesis", [percent(name, theirs[name]) for name in columns]))
        gains = [round(100 * summary[name], 1) - round(100 * theirs[name], 1) for name in columns]
        rows.append((*names, "difference", [f"{gain + 0.0:+.1f}" for gain in gains]))
    return rows


def _table(rows: list, columns: Sequence[str], width: int | None) -> str:
    label = max([len(f"{tracker}") + 1 for _, tracker, _, _ in rows] + [len(s) for s, *_ in rows] + [13])
    units = any(name in _UNITS for name in columns)
    cell = 7
    fitting = len(columns) if width is None else max(1, min(len(columns), (width - label) // cell))
    columns = [("Delay" if name == "BirthDelay" else name) for name in columns[:fitting]]
    lines, current = [], None
    for sequence, tracker, whose, cells in rows:
        if sequence != current:
            if current is not None:
                lines.append("")
            lines.append(f"{sequence:<{label}}" + "".join(f"{name:>{cell}}" for name in columns))
            current = sequence
        name = f"  {whose}" if whose else tracker
        lines.append(f"{name:<{label}}" + "".join(f"{text:>{cell}}" for text in cells[:fitting]))
    if units and any(name in columns for name in ("OSPA", "RMSE", "Delay")):
        lines += ["", "HOTA to IDF1 in percent; IDSW counts; OSPA, OSPA2, GOSPA, RMSE in m; Delay of births in s"]
    return "\n".join(lines) + "\n"


def _csv(records: Sequence[dict], compare: bool) -> str:
    text = io.StringIO()
    names = list(records[0]["summary"]) if records else []
    header = ["sequence", "tracker", *names]
    if compare:
        header += [f"{name}_{which}" for name in HOTA_SUMMARY for which in ("thesis", "difference")]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for record in records:
        summary = record["summary"]
        row = [record["sequence"], record["tracker"], *("" if summary[n] is None else summary[n] for n in names)]
        if compare:
            theirs = thesis.figures(record)
            for name in HOTA_SUMMARY:
                row += [theirs[name], round(summary[name] - theirs[name], 12)] if theirs else ["", ""]
        writer.writerow(row)
    return text.getvalue()


def _headings(columns: Sequence[str]) -> list[str]:
    return [f"{name}{_BETTER[name]}" + (f" ({_UNITS[name]})" if name in _UNITS else "") for name in columns]


def _markdown(rows: list, columns: Sequence[str], compare: bool) -> str:
    head = ["sequence", "tracker", *([""] if compare else []), *_headings(columns)]
    lines = [head, ["---"] * (len(head) - len(columns)) + ["---:"] * len(columns)]
    lines += [[sequence, tracker, *([whose] if compare else []), *cells] for sequence, tracker, whose, cells in rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def _latex(rows: list, columns: Sequence[str], compare: bool) -> str:
    heads = [h.replace("↑", r"$\uparrow$").replace("↓", r"$\downarrow$") for h in _headings(columns)]
    lines = [
        r"\begin{tabular}{ll" + ("l" if compare else "") + "r" * len(columns) + "}",
        r"\toprule",
        " & ".join(["Sequence", "Tracker", *([""] if compare else []), *heads]) + r" \\",
    ]
    current = None
    for sequence, tracker, whose, cells in rows:
        if sequence != current:
            lines.append(r"\midrule")
        first = "" if sequence == current else sequence
        current = sequence
        names = [first, "" if whose else tracker, *([whose] if compare else [])]
        numbers = [f"${cell}$" if cell[0] in "+-" and len(cell) > 1 else cell for cell in cells]
        lines.append(" & ".join([*(name.replace("_", r"\_") for name in names), *numbers]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"
