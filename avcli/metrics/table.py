"""Metrics records as tables: for a terminal, and as CSV, markdown, LaTeX and HTML."""

import csv
import io
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

from avcli.metrics import registry, thesis
from avcli.metrics.metric import Field

_ARROWS = {"up": "↑", "down": "↓", "": ""}


class Row(NamedTuple):
    """One line of a table: `whose` is "" for our figures, "thesis" or "difference"."""

    sequence: str
    name: str
    whose: str
    cells: list[str]


def render(records: Sequence[dict], kind: str, compare: bool = False, width: int | None = None) -> str:
    """Lay out metrics records.

    Args:
        records: with "sequence", and "tracker" and "summary" or "sensor" and "Detections".
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
        return "\n".join([_csv(trackers, compare)] + ([_sensor_csv(sensors)] if sensors else []))
    columns = registry.columns()
    if compare and kind != "html":
        columns = [field for field in registry.summary_fields() if field.name in thesis.COLUMNS]
    parts = [([row for record in trackers for row in _rows(record, columns, compare)], columns)]
    if sensors:
        fields = registry.sensor_columns()
        parts.append(([_sensor_row(record, fields) for record in sensors], fields))
    if kind == "table":
        return "\n".join(_table(rows, columns, width) for rows, columns in parts)
    lay_out = {"markdown": _markdown, "html": _html, "latex": _latex}[kind]
    return "\n".join(lay_out(rows, columns) for rows, columns in parts)


def shown(field: Field, value: float | None) -> str:
    """Show a value: a fraction in percent, a count as it is, anything else with three decimals."""
    if value is None:
        return "-"
    if field.unit == "%":
        return f"{100 * value:.1f}"
    if field.unit == "count":
        return str(value) if isinstance(value, int) else f"{value:g}"
    return f"{value:.3f}" if value < 100 else f"{value:.3g}"


def _rows(record: dict, columns: Sequence[Field], compare: bool) -> list[Row]:
    """The lines of one record: ours, and the thesis's and the difference where they are wanted and known."""
    summary = record["summary"]
    names = _labelled(record), record["tracker"]
    rows = [Row(*names, "", [shown(field, summary[field.name]) for field in columns])]
    theirs = thesis.figures(record) if compare else None
    if theirs:
        # Both are rounded to the thesis's one decimal first, so that the three lines add up as they are read.
        known = [field for field in columns if field.name in theirs]
        gains = [round(100 * summary[field.name], 1) - round(100 * theirs[field.name], 1) for field in known]
        blank = [""] * (len(columns) - len(known))
        rows.append(Row(*names, "thesis", [shown(field, theirs[field.name]) for field in known] + blank))
        rows.append(Row(*names, "difference", [f"{gain + 0.0:+.1f}" for gain in gains] + blank))
    return rows


def _sensor_row(record: dict, columns: Sequence[Field]) -> Row:
    scores = record["Detections"]
    return Row(_labelled(record), record["sensor"], "", [shown(field, scores[field.name]) for field in columns])


def _labelled(record: dict) -> str:
    notes = [record[name] for name in ("average", "people") if name in record]
    return record["sequence"] + (f" ({', '.join(notes)})" if notes else "")


def _table(rows: Sequence[Row], columns: Sequence[Field], width: int | None) -> str:
    label = max([len(tracker) + 1 for _, tracker, _, _ in rows] + [len(s) + 1 for s, *_ in rows] + [13])
    cell = 7
    fitting = len(columns) if width is None else max(1, min(len(columns), (width - label) // cell))
    columns = columns[:fitting]
    lines: list[str] = []
    current = None
    for sequence, name, whose, cells in rows:
        if sequence != current:
            if current is not None:
                lines.append("")
            lines.append(f"{sequence:<{label}}" + "".join(f"{field.column:>{cell}}" for field in columns))
            current = sequence
        name = f"  {whose}" if whose else name
        lines.append(f"{name:<{label}}" + "".join(f"{text:>{cell}}" for text in cells[:fitting]))
    units: dict[str, list[str]] = {}
    for field in columns:
        if _unit(field):
            units.setdefault(_unit(field), []).append(field.column)
    if units:
        lines += ["", "; ".join(["fractions in percent", *(f"{', '.join(n)} in {u}" for u, n in units.items())])]
    return "\n".join(lines) + "\n"


def _csv(records: Sequence[dict], compare: bool) -> str:
    text = io.StringIO()
    names = list(records[0]["summary"]) if records else []
    header = ["sequence", "tracker", *names]
    if compare:
        header += [f"{name}_{which}" for name in thesis.COLUMNS for which in ("thesis", "difference")]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for record in records:
        summary = record["summary"]
        row = [record["sequence"], record["tracker"], *("" if summary[n] is None else summary[n] for n in names)]
        if compare:
            theirs = thesis.figures(record)
            for name in thesis.COLUMNS:
                row += [theirs[name], round(summary[name] - theirs[name], 12)] if theirs else ["", ""]
        writer.writerow(row)
    return text.getvalue()


def _sensor_csv(records: Sequence[dict]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    vectors = {field.name for field in registry.SENSOR_METRIC.fields if field.kind == "vector"}
    names = [name for name in records[0]["Detections"] if name not in vectors]
    writer.writerow(["sequence", "sensor", *names])
    for record in records:
        values = [record["Detections"][name] for name in names]
        writer.writerow([record["sequence"], record["sensor"], *("" if value is None else value for value in values)])
    return text.getvalue()


def _unit(field: Field) -> str:
    """The unit that a heading gives."""
    return "" if field.unit in ("%", "count") else field.unit


def _headings(columns: Sequence[Field]) -> list[str]:
    return [
        f"{field.name}{_ARROWS[field.better]}".replace("_", " ") + (f" ({_unit(field)})" if _unit(field) else "")
        for field in columns
    ]


def _markdown(rows: Sequence[Row], columns: Sequence[Field]) -> str:
    compare = any(whose for _, _, whose, _ in rows)
    head = ["sequence", "", *([""] if compare else []), *_headings(columns)]
    lines = [head, ["---"] * (len(head) - len(columns)) + ["---:"] * len(columns)]
    lines += [[sequence, tracker, *([whose] if compare else []), *cells] for sequence, tracker, whose, cells in rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def _html(rows: Sequence[Row], columns: Sequence[Field]) -> str:
    """A table element; the best of a sequence's own figures in a column are marked."""
    best: dict[tuple[str, str], float] = {}
    for sequence, _, whose, cells in rows:
        for field, cell in zip(columns, cells, strict=True):
            if not whose and field.better and cell != "-":
                value = _goodness(field, cell)
                best[sequence, field.name] = max(best.get((sequence, field.name), value), value)
    alone = {sequence for sequence, *_ in rows if sum(s == sequence and not w for s, _, w, _ in rows) < 2}

    def look(row: Row, field: Field, cell: str) -> str:
        if row.whose == "difference" and cell not in ("", "+0.0"):
            return ' class="gain"' if cell[0] == "+" else ' class="loss"'
        if row.whose or cell == "-" or row.sequence in alone or not field.better:
            return ""
        return ' class="best"' if _goodness(field, cell) == best[row.sequence, field.name] else ""

    lines = [
        "<table>",
        "<thead><tr><th></th>" + "".join(f"<th>{text}</th>" for text in _headings(columns)) + "</tr></thead>",
    ]
    current = None
    for row in rows:
        if row.sequence != current:
            lines += ["</tbody>"] if current is not None else []
            current = row.sequence
            lines.append(f'<tbody><tr><th class="sequence" colspan="{len(columns) + 1}">{escape(current)}</th></tr>')
        tds = [f"<td{look(row, field, cell)}>{cell}</td>" for field, cell in zip(columns, row.cells, strict=True)]
        lines.append(f'<tr class="{row.whose or "ours"}"><th>{escape(row.whose or row.name)}</th>{"".join(tds)}</tr>')
    return "\n".join([*lines, "</tbody>", "</table>"])


def _goodness(field: Field, cell: str) -> float:
    return float(cell) if field.better == "up" else -float(cell)


def _latex(rows: Sequence[Row], columns: Sequence[Field]) -> str:
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
