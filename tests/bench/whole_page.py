"""What `make bench` measured, as Markdown and as one HTML page that needs nothing else: verdict first."""

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from budget import Judged
from figures import Row, front, groups

WIDTH, HEIGHT = 440, 260
LEFT, BOTTOM, TOP, RIGHT = 52, 40, 26, 16

STYLE = """
:root { color-scheme: light dark; --page: #fbfbfa; --card: #fff; --ink: #1c1d1f; --soft: #5d6168; --line: #e2e4e8;
  --ours: #0b63b0; --peer: #b04a00; --good: #0a7a3f; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --page: #16181b; --card: #1e2125; --ink: #e8e9eb; --soft: #a2a7af;
  --line: #34383e; --ours: #6db3f2; --peer: #f0a060; --good: #5fcf93; --bad: #ff8a80; } }
* { box-sizing: border-box } body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif }
main { max-width: 1180px; margin: 0 auto; padding: 1rem }
h1 { font-size: 1.5rem; margin: .3rem 0 } h2 { font-size: 1.15rem; margin: 1.6rem 0 .5rem }
.verdict { border-left: .4rem solid var(--good); background: var(--card); padding: .7rem 1rem; font-size: 1.1rem }
.verdict.bad { border-color: var(--bad) } p.soft, figcaption, td.soft { color: var(--soft) }
.plots { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr)) }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .6rem }
figcaption { font-size: .85rem } figcaption b { color: var(--ink) } svg { width: 100%; height: auto; display: block }
svg text { fill: var(--soft); font-size: 11px } .ours { color: var(--ours) } .peer { color: var(--peer) }
ol { margin: .4rem 0 0; padding-left: 1.6rem; font-size: .85rem }
.scroll { overflow-x: auto } table { border-collapse: collapse; font-size: .88rem; width: 100% }
th, td { text-align: right; padding: .25rem .6rem; border-bottom: 1px solid var(--line); white-space: nowrap }
th:first-child, td:first-child, td.text, th.text { text-align: left } tr.over td { color: var(--bad) }
.bar { display: inline-block; height: .7em; background: var(--ours); border-radius: 2px }
"""


def sentence(verdict: Sequence[Judged], failed: dict[str, str]) -> str:
    """The verdict in one or two sentences."""

    def named(some: Iterable[Judged]) -> str:
        return "; ".join(f"{one.stage}, {one.case}, {one.tool} ({one.found:.2g} for {one.allowed:.2g})" for one in some)

    limits = [one for one in verdict if not one.goal]
    over, missed = ([one for one in verdict if one.over and one.goal is goal] for goal in (False, True))
    said = f"{len(limits) - len(over)} of {len(limits)} limits of time are kept."
    if not limits:
        said = "Nothing that was measured has a limit of time, so that none was checked."
    said += f" Over the limit, in units: {named(over)}." if over else ""
    said += f" Goals that are not reached, in units: {named(missed)}." if missed else ""
    if failed:
        said += " Not measured: " + "; ".join(f"{name} ({why})" for name, why in failed.items()) + "."
    return said


def facts(machine: dict[str, Any]) -> str:
    """The machine in one sentence."""
    parts = ", ".join(f"{name} {1e3 * value:.0f}" for name, value in machine["reference"].items() if name != "all")
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    return (
        f"{machine['processor']}, {machine['cpus']} CPUs, {machine['memory_gib']} GiB, {machine['system']}, Python "
        f"{machine['python']}; {versions}; load {machine['load']} at the beginning. One unit, the reference workload, "
        f"takes {1e3 * machine['reference']['all']:.0f} ms of CPU time here (ms: {parts})."
    )


def markdown(machine: dict[str, Any], rows: Sequence[Row], verdict: Sequence[Judged], failed: dict[str, str]) -> str:
    """Everything as one table."""
    best = _fronts(rows)
    lines = [
        "# All stages: run time against error",
        "",
        f"By `make bench`. {sentence(verdict, failed)}",
        "",
        f"{facts(machine)} Times are CPU time; wall times stand where the row says so. Under load they are longer.",
        "Pareto: no other tool of that case is both as soon and as accurate.",
        "",
        "| stage | case | tool | CPU ms | units | wall s | a | error | | Pareto |",
        "|---|---|---|---:|---:|---:|---|---:|---|---|",
    ]
    for row in rows:
        error = f"{row['error']:.3g}" if "error" in row else ""
        wall = f"{row['wall_s']:.1f}" if "wall_s" in row else ""
        spent, units = ("", "") if row["cpu_s"] is None else (f"{1e3 * row['cpu_s']:.3g}", f"{row['units']:.3g}")
        cells = (row["stage"], row["case"], row["tool"], spent, units, wall, row["per"], error,
                 row.get("error_unit", ""), "yes" if id(row) in best else "")  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def page(machine: dict[str, Any], rows: Sequence[Row], verdict: Sequence[Judged], failed: dict[str, str]) -> str:
    """Everything as one HTML page."""
    bad = bool(failed or any(one.over and not one.goal for one in verdict))
    plots = "".join(_plot(*key, some) for key, some in groups(rows).items() if len(some) > 1)
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>avcli: run time against error</title><style>{STYLE}</style><main>
<h1>Run time against error</h1>
<p class="verdict{" bad" if bad else ""}">{escape(sentence(verdict, failed))}</p>
<p class="soft">{escape(facts(machine))}</p>
{_pipeline(rows)}
<h2>Run time against error</h2>
<p class="soft">Left is sooner, low is more accurate. A ring marks the Pareto front: nobody else is both as soon and as
accurate. Blue is avcli, orange are others, in the same run.</p>
<div class="plots">{plots}</div>
{_budget(verdict)}
</main></html>
"""


def _fronts(rows: Sequence[Row]) -> set[int]:
    return {id(row) for some in groups(rows).values() if len(some) > 1 for row in front(some)}


def _table(heads: Sequence[str], lines: Iterable[tuple[str, Sequence[str]]]) -> str:
    """A table of ready cells, whose first three columns are words; each line with its class."""
    head = "".join(f'<th class="{"text" if k < 3 else ""}">{escape(name)}</th>' for k, name in enumerate(heads))
    body = "".join(
        f'<tr class="{kind}">' + "".join(f'<td class="{"text" if k < 3 else ""}">{c}</td>' for k, c in enumerate(cells))
        for kind, cells in lines
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def _pipeline(rows: Sequence[Row]) -> str:
    """S1 by stages: CPU time the first time and again, and the share that the machine itself needs."""
    cases = {(row["case"], row["tool"]): row for row in rows if row["stage"] == "pipe"}
    whole = [(case, row) for (case, tool), row in cases.items() if tool == "avcli, all"]
    stages = {tool: row for (case, tool), row in cases.items() if case == "S1" and tool != "avcli, all"}
    if not stages:
        return ""
    longest = max(row["cpu_s"] for row in stages.values())
    lines = []
    for tool, row in stages.items():
        least = cases.get(("S1, the least", tool.removeprefix("avcli ")))
        share = f"{100 * least['cpu_s'] / row['cpu_s']:.0f} %" if least else ""
        bar = f'<span class="bar" style="width:{10 * row["cpu_s"] / longest:.2f}rem"></span>'
        what = escape(least["what"]) if least else ""
        cells = (escape(tool.removeprefix("avcli ")), f"{row['cpu_s']:.2f}", bar, f"{row['units']:.2f}", share, what)
        lines.append(("", cells))
    said = "; ".join(f"{case}: {row['cpu_s']:.1f} CPU s, {row['wall_s']:.1f} s by the clock" for case, row in whole)
    heads = ("command", "CPU s", "", "units", "share of its limit", "the limit: this alone")
    return f'<h2>S1 from end to end</h2><p class="soft">{escape(said)}. S1 lasts 4 s.</p>{_table(heads, lines)}'


def _budget(verdict: Sequence[Judged]) -> str:
    lines = []
    for one in sorted(verdict, key=lambda one: one.allowed / max(one.found, 1e-12)):
        share = f"{100 * one.found / one.allowed:.0f} %"
        words = (one.stage, one.case, one.tool, share, f"{one.found:.3g}", f"{one.allowed:.3g}", one.why)
        lines.append(("over" if one.over else "", [escape(word) for word in words]))
    heads = ("stage", "case", "tool", "used", "units", "allowed", "the limit is")
    return f"<h2>Budget</h2>{_table(heads, lines)}" if lines else ""


def _plot(stage: str, case: str, unit: str, rows: Sequence[Row]) -> str:
    """Time against error of one case; points are numbered as the list below them is."""
    best = {id(row) for row in front(rows)}
    ordered = sorted(rows, key=lambda row: row["cpu_s"])
    xs = [math.log10(max(row["cpu_s"], 1e-9)) for row in ordered]
    ys = [row["error"] for row in ordered]
    by_powers = min(ys) > 0 and max(ys) > 20 * min(ys)
    heights = [math.log10(y) for y in ys] if by_powers else ys
    x_low, x_high = math.floor(min(xs) * 2 - 0.2) / 2, math.ceil(max(xs) * 2 + 0.2) / 2
    y_ticks = _ticks(min(heights), max(heights), by_powers)
    y_low, y_high = min(y_ticks[0], min(heights)), max(y_ticks[-1], max(heights))

    def at(x: float, y: float) -> tuple[float, float]:
        across = (x - x_low) / (x_high - x_low)
        up = (y - y_low) / ((y_high - y_low) or 1)
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - BOTTOM - TOP)

    marks = []
    for y in y_ticks:
        px, py = at(x_low, y)
        label = f"{10**y:.3g}" if by_powers else f"{y:.3g}"
        marks.append(f'<path d="M{px:.1f} {py:.1f}H{WIDTH - RIGHT}" stroke="var(--line)"/>')
        marks.append(f'<text x="{px - 6:.1f}" y="{py + 4:.1f}" text-anchor="end">{label}</text>')
    few = x_high - x_low < 2
    for power in [k + step for k in range(-9, 6) for step in ((0, math.log10(2), math.log10(5)) if few else (0,))]:
        if not x_low <= power <= x_high:
            continue
        px, py = at(power, y_low)
        marks.append(f'<path d="M{px:.1f} {TOP}V{py:.1f}" stroke="var(--line)"/>')
        marks.append(f'<text x="{px:.1f}" y="{py + 15:.1f}" text-anchor="middle">{_seconds(power)}</text>')
    marks.append(
        f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 6}" text-anchor="end">CPU time a {escape(rows[0]["per"])}</text>'
    )
    marks.append(f'<text x="4" y="11">error, {escape(unit)}</text>')
    for number, (row, x, y) in enumerate(zip(ordered, xs, heights, strict=True), 1):
        px, py = at(x, y)
        kind = "ours" if row["tool"].startswith("avcli") else "peer"
        ring = (
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="8" fill="none" stroke="currentColor"/>' if id(row) in best else ""
        )
        marks.append(f'<g class="{kind}"><circle cx="{px:.1f}" cy="{py:.1f}" r="4" fill="currentColor"/>{ring}</g>')
        marks.append(f'<text x="{px + 10:.1f}" y="{py - 5:.1f}">{number}</text>')
    names = "".join(
        f'<li class="{"ours" if row["tool"].startswith("avcli") else "peer"}">{escape(row["tool"])}: '
        f"{_seconds(math.log10(max(row['cpu_s'], 1e-9)))}, {row['error']:.3g} {escape(unit)}</li>"
        for row in ordered
    )
    return (
        f'<figure><figcaption><b>{escape(stage)}</b>: {escape(case)}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'role="img" aria-label="run time against error">{"".join(marks)}</svg><ol>{names}</ol></figure>'
    )


def _ticks(low: float, high: float, by_powers: bool) -> list[float]:
    """Some round numbers around and between two; whole powers where the axis is logarithmic."""
    if by_powers:
        return [float(power) for power in range(math.floor(low), math.ceil(high) + 1)]
    width = (high - low) or abs(high) or 1.0
    step = 10 ** math.floor(math.log10(width / 2))
    step *= next(k for k in (1, 2, 5, 10) if width / (step * k) <= 5)
    return [step * k for k in range(math.floor(low / step), math.ceil(high / step) + 1)]


def _seconds(power: float) -> str:
    value = 10**power
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if value >= size * 0.9995:
            return f"{value / size:.3g} {unit}"
    return f"{value:.1g} s"
