"""Metrics records as tables: for a terminal, and as CSV, markdown and LaTeX."""

import csv
import io
from collections.abc import Sequence
from html import escape

from avcli.metrics import thesis
from avcli.metrics.score import HOTA_SUMMARY

PERCENT = (*HOTA_SUMMARY, "MOTA", "MOTP", "MODA", "IDF1", "IDP", "IDR")
"""Summary fields that are fractions and shown in percent."""
_COUNTS = ("IDSW", "Frag", "MT", "PT", "ML")
_COLUMNS = (*HOTA_SUMMARY, "MOTA", "IDF1", "IDSW", "OSPA", "OSPA2", "GOSPA", "RMSE", "BirthDelay")
_SENSOR_COLUMNS = ("Precision", "Recall", "Recall_speaking", "F1", "RMSE", "MAE", "ANEES", "TP", "FN", "FP")
_SENSOR_PERCENT = ("Precision", "Recall", "Recall_speaking", "F1")
_SHORT = {"BirthDelay": "Delay", "Precision": "Prec", "Recall": "Rec", "Recall_speaking": "RecSp"}
_UNITS = {"OSPA": "m", "OSPA2": "m", "GOSPA": "m", "RMSE": "m", "MAE": "m", "BirthDelay": "s"}
_BETTER = dict.fromkeys(PERCENT, "↑") | dict.fromkeys(("IDSW", "OSPA", "OSPA2", "GOSPA", "RMSE", "BirthDelay"), "↓")


def render(records: Sequence[dict], kind: str, compare: bool = False, width: int | None = None) -> str:
    """Lay out metrics records.

    Args:
        records: with "sequence", "tracker" and "summary".
        kind: "table", "csv", "markdown", "latex" or "html".
        compare: set the thesis's figures and the difference beside ours, HOTA and its parts only.
        width: characters that a "table" may be wide; columns that would not fit are left out.
    """
    sequences = list(dict.fromkeys(record["sequence"] for record in records))
    if len({record["sequence"] for record in records if "average" not in record}) == 1:
        records = [record for record in records if "average" not in record]  # one sequence is its own average
    records = sorted(records, key=lambda record: sequences.index(record["sequence"]))
    trackers = [record for record in records if "tracker" in record]
    sensors = [record for record in records if "sensor" in record]
    if kind == "csv":
        parts = [_csv(trackers, compare)] + ([_sensor_csv(sensors)] if sensors else [])
        return "\n".join(parts)
    columns = HOTA_SUMMARY if compare and kind != "html" else _COLUMNS
    parts = [([row for record in trackers for row in _rows(record, columns, compare)], columns)]
    if sensors:
        parts.append(([row for record in sensors for row in _sensor_rows(record)], _SENSOR_COLUMNS))
    if kind == "markdown":
        return "\n".join(_markdown(rows, columns) for rows, columns in parts)
    if kind == "html":
        return "\n".join(_html(rows, columns) for rows, columns in parts)
    if kind == "latex":
        return "\n".join(_latex(rows, columns) for rows, columns in parts)
    return "\n".join(_table(rows, columns, width) for rows, columns in parts)


def percent(name: str, value: float | None) -> str:
    """Show a summary value: a fraction in percent, metres and seconds with three decimals, a count as it is."""
    if value is None:
        return "-"
    if name in PERCENT:
        return f"{100 * value:.1f}"
    return f"{value:g}" if name in _COUNTS else f"{value:.3f}"


def _rows(record: dict, columns: Sequence[str], compare: bool) -> list[tuple[str, str, str, list[str]]]:
    """Sequence, tracker, whose figures ("" for ours) and the cells, of each line of one record (ours, the thesis's)."""
    summary = record["summary"]
    names = _labelled(record), record["tracker"]
    rows = [(*names, "", [percent(name, summary[name]) for name in columns])]
    theirs = thesis.figures(record) if compare else None
    if theirs:
        # Both are rounded to the thesis's one decimal first, so that the three lines add up as they are read.
        known = [name for name in columns if name in theirs]
        gains = [round(100 * summary[name], 1) - round(100 * theirs[name], 1) for name in known]
        blank = [""] * (len(columns) - len(known))
        rows.append((*names, "thesis", [percent(name, theirs[name]) for name in known] + blank))
        rows.append((*names, "difference", [f"{gain + 0.0:+.1f}" for gain in gains] + blank))
    return rows


def _sensor_rows(record: dict) -> list[tuple[str, str, str, list[str]]]:
    scores = record["Detections"]
    cells = []
    for name in _SENSOR_COLUMNS:
        value = scores[name]
        if value is None:
            cells.append("-")
        elif name in _SENSOR_PERCENT:
            cells.append(f"{100 * value:.1f}")
        else:
            cells.append(str(value) if isinstance(value, int) else f"{value:.3f}" if value < 100 else f"{value:.3g}")
    return [(_labelled(record), record["sensor"], "", cells)]


def _labelled(record: dict) -> str:
    notes = [record[name] for name in ("average", "people") if name in record]
    return record["sequence"] + (f" ({', '.join(notes)})" if notes else "")


def _table(rows: list, columns: Sequence[str], width: int | None) -> str:
    label = max([len(tracker) + 1 for _, tracker, _, _ in rows] + [len(s) + 1 for s, *_ in rows] + [13])
    cell = 7
    fitting = len(columns) if width is None else max(1, min(len(columns), (width - label) // cell))
    columns = columns[:fitting]
    lines, current = [], None
    for sequence, name, whose, cells in rows:
        if sequence != current:
            if current is not None:
                lines.append("")
            lines.append(f"{sequence:<{label}}" + "".join(f"{_SHORT.get(name, name):>{cell}}" for name in columns))
            current = sequence
        name = f"  {whose}" if whose else name
        lines.append(f"{name:<{label}}" + "".join(f"{text:>{cell}}" for text in cells[:fitting]))
    if any(name in _UNITS for name in columns):
        units = ", ".join(f"{_SHORT.get(name, name)} {_UNITS[name]}" for name in columns if name in _UNITS)
        lines += ["", f"in percent, but {units}"]
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


def _sensor_csv(records: Sequence[dict]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [name for name in records[0]["Detections"] if name != "Bias"]
    writer.writerow(["sequence", "sensor", *names])
    for record in records:
        values = [record["Detections"][name] for name in names]
        writer.writerow([record["sequence"], record["sensor"], *("" if value is None else value for value in values)])
    return text.getvalue()


def _headings(columns: Sequence[str]) -> list[str]:
    return [
        f"{name}{_BETTER.get(name, '')}".replace("_", " ") + (f" ({_UNITS[name]})" if name in _UNITS else "")
        for name in columns
    ]


def _markdown(rows: list, columns: Sequence[str]) -> str:
    compare = any(whose for _, _, whose, _ in rows)
    head = ["sequence", "", *([""] if compare else []), *_headings(columns)]
    lines = [head, ["---"] * (len(head) - len(columns)) + ["---:"] * len(columns)]
    lines += [[sequence, tracker, *([whose] if compare else []), *cells] for sequence, tracker, whose, cells in rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def _html(rows: list, columns: Sequence[str]) -> str:
    """A table element; the best of a sequence's own figures in a column are marked."""
    best = {}
    for sequence, _, whose, cells in rows:
        for name, cell in zip(columns, cells, strict=True):
            if not whose and name in _BETTER and cell != "-":
                value = float(cell) if _BETTER[name] == "↑" else -float(cell)
                best[sequence, name] = max(best.get((sequence, name), value), value)
    alone = {sequence for sequence, *_ in rows if sum(s == sequence and not w for s, _, w, _ in rows) < 2}
    lines = [
        "<table>",
        "<thead><tr><th></th>" + "".join(f"<th>{text}</th>" for text in _headings(columns)) + "</tr></thead>",
    ]
    current = None
    for sequence, name, whose, cells in rows:
        if sequence != current:
            lines += ["</tbody>"] if current is not None else []
            lines.append(f'<tbody><tr><th class="sequence" colspan="{len(columns) + 1}">{escape(sequence)}</th></tr>')
            current = sequence
        tds = []
        for column, cell in zip(columns, cells, strict=True):
            kind = ""
            if whose == "difference":
                kind = (
                    ' class="gain"'
                    if cell[:1] == "+" and cell != "+0.0"
                    else ' class="loss"'
                    if cell[:1] == "-"
                    else ""
                )
            elif not whose and cell != "-" and sequence not in alone and column in _BETTER:
                value = float(cell) if _BETTER[column] == "↑" else -float(cell)
                kind = ' class="best"' if value == best[sequence, column] else ""
            tds.append(f"<td{kind}>{cell}</td>")
        lines.append(f'<tr class="{whose or "ours"}"><th>{escape(whose or name)}</th>' + "".join(tds) + "</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"])


def _latex(rows: list, columns: Sequence[str]) -> str:
    compare = any(whose for _, _, whose, _ in rows)
    heads = [h.replace("↑", r"$\uparrow$").replace("↓", r"$\downarrow$") for h in _headings(columns)]
    lines = [
        r"\begin{tabular}{ll" + ("l" if compare else "") + "r" * len(columns) + "}",
        r"\toprule",
        " & ".join(["Sequence", "", *([""] if compare else []), *heads]) + r" \\",
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
