"""The tables and pictures of the bench of trackers, as examples/benchmarks/tracking.md has them."""

import json
import math
import os
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats
from tracking_cases import is_synthetic
from tracking_measures import BINS, SUMMARY, Outcome, mean, summary
from tracking_scenes import EASY
from tracking_worlds import COARSE

ENOUGH, RUNS, CLOSE = 400, 20, 0.05  # records and runs in a bin of existence that count; said = true to this
DEFAULT, CEILING = "default", "ceiling"
OWN = ("5 hypotheses", "20 hypotheses", "80 hypotheses", "lag 5", "lag inf", "lmb")  # variants of the default tracker
LEGEND = """\
- HOTA, DetA, AssA: percent at d0 = 2 m; ±: standard error of the mean; > 10 s: from then on; d0=.5: HOTA at .5 m.
- invent: tracks of nobody in a frame, where no camera sees anything.
- birth s: seconds until a person who comes is found within 1 m.
- ghost s: seconds for which the track of somebody who has left is reported with nobody within 2 m, on average, and for
  95 %. left: departures; taken: those whose tracks were somebody else's afterwards.
- Brier: of existence, which is true if the track is matched, one to one, to somebody within 1 m.
- ms: processor time a frame of the tracker alone, the least of the seeds.
- ceiling: HOTA of a filter that is told which detection belongs to whom. Its motion models are those of avfuse.
""".splitlines()
DIGITS = {**SUMMARY, "HOTA": 1, "+-": 1, ">10 s": 1, "d0=.5": 1, "DetA": 1, "AssA": 1}


@dataclass(frozen=True)
class Run:
    """One scene with one tracker; sensors: those that it got, empty: all."""

    case: str
    seed: int
    variant: str
    sensors: str
    outcome: Outcome


def write(runs: Sequence[Run], path: Path) -> None:
    """Keep runs in a file."""
    path.write_text(json.dumps([asdict(run) for run in runs]))


def read(path: Path) -> list[Run]:
    """Runs of a file."""
    return [_run(one) for one in json.loads(path.read_text())]


def keep(runs: Sequence[Run], path: Path) -> None:
    """Append runs to a file, a line each, for `kept`."""
    with path.open("a") as file:
        file.writelines(json.dumps(asdict(run)) + "\n" for run in runs)


def kept(path: Path) -> list[Run]:
    """Runs of a file of `keep`, which may be missing."""
    return [_run(json.loads(line)) for line in path.read_text().splitlines()] if path.exists() else []


def _run(one: dict[str, Any]) -> Run:
    return Run(**{**one, "outcome": Outcome(**one["outcome"])})


def chosen(runs: Iterable[Run], variant: str = DEFAULT, sensors: str = "", case: str = "") -> list[Run]:
    """The runs of one variant, of one case or of all."""
    return [one for one in runs if (one.variant, one.sensors) == (variant, sensors) and case in ("", one.case)]


def cases_of(runs: Iterable[Run]) -> list[str]:
    """The names of the cases, in their order."""
    return list(dict.fromkeys(run.case for run in runs))


def peers_of(runs: Iterable[Run]) -> list[str]:
    """The trackers that the default one is compared with, in their order."""
    return [one for one in dict.fromkeys(run.variant for run in runs) if one not in (DEFAULT, CEILING, *OWN)]


def shown(value: float, digits: int = 1, sign: str = "") -> str:
    """A number of a table, empty for NaN."""
    return "" if math.isnan(value) else f"{value:{sign}.{digits}f}"


def rows(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    """A table of Markdown, its first column text and the others numbers; empty without lines."""
    if not lines:
        return []
    table = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    return [*table, *("| " + " | ".join(line) + " |" for line in lines), ""]


# --- the tables -------------------------------------------------------------------------------------------------------


def against(runs: Sequence[Run], before: Sequence[Run], case: str) -> list[str]:
    """HOTA before, and what was gained with its standard error, over the seeds that both have."""
    old = {run.seed: run.outcome.hota for run in chosen(before, case=case)}
    pairs = np.array([(old[r.seed], r.outcome.hota) for r in chosen(runs, case=case) if r.seed in old])
    if not len(pairs):
        return ["", ""]
    gain = pairs[:, 1] - pairs[:, 0]
    error = gain.std(ddof=1) / math.sqrt(len(gain)) if len(gain) > 1 else math.nan
    return [shown(pairs[:, 0].mean()), f"{gain.mean():+.1f}" + (f" ± {error:.1f}" if len(gain) > 1 else "")]


def cases_table(runs: Sequence[Run], before: Sequence[Run]) -> list[str]:
    """The default tracker on each case: its numbers, HOTA before, and that of the filter that knows who is who."""
    heads = ["case", "scenes", *(["before", "gained"] if before else []), *SUMMARY, "ceiling"]
    lines = []
    for case in cases_of(chosen(runs)):
        mine, best = chosen(runs, case=case), chosen(runs, CEILING, case=case)
        numbers = [shown(value, DIGITS[name]) for name, value in summary([one.outcome for one in mine]).items()]
        top = shown(mean(one.outcome.hota for one in best))
        lines.append([Path(case).name, str(len(mine)), *(against(runs, before, case) if before else []), *numbers, top])
    return rows(heads, lines)


def hota_of(runs: Sequence[Run], variant: str, case: str, seeds: Iterable[int]) -> float:
    """Mean HOTA of a variant on some seeds of a case, NaN if it has not run on all of them."""
    found = {run.seed: run.outcome.hota for run in chosen(runs, variant, case=case)}
    return mean(found[seed] for seed in seeds) if set(seeds) <= set(found) else math.nan


def variants_table(runs: Sequence[Run], names: Sequence[str]) -> list[str]:
    """HOTA of several variants on each case, on the seeds that the last of them has, and how far the best is ahead."""
    there = {run.variant for run in runs}
    names = [name for name in names if name in there]
    lines = []
    for case in cases_of(runs):
        shared = [
            {run.seed for run in chosen(runs, name, case=case)} for name in names if chosen(runs, name, case=case)
        ]
        if len(shared) < 2 or not chosen(runs, case=case):
            continue
        seeds = set.intersection(*shared)
        values = [hota_of(runs, name, case, seeds) for name in (DEFAULT, *names)]
        ahead = max((value for value in values[1:] if not math.isnan(value)), default=math.nan) - values[0]
        lines.append([Path(case).name, *map(shown, values), shown(ahead, sign="+")])
    return rows(["case", DEFAULT, *names, "best of these less default"], lines)


def real_table(runs: Sequence[Run]) -> list[str]:
    """All trackers on the tracks of real people: HOTA at 2 m (at .5 m), ghosts and takeovers."""
    heads = ["case", "tracker", "HOTA (d0 .5)", "DetA", "AssA", "birth s", "ghost s", "95 %", "taken of left", "Brier"]
    lines = []
    for case in [one for one in cases_of(runs) if not is_synthetic(one)]:
        for name in (DEFAULT, *peers_of(runs), CEILING):
            found = [one.outcome for one in chosen(runs, name, case=case)]
            if found:
                n = summary(found)
                taken = f"{n['taken']:.0f} of {n['left']:.0f}" if n["left"] else ""
                brier = shown(n["Brier"], 3) if name in (DEFAULT, "no-hidden") else ""
                lines.append(
                    [
                        Path(case).name,
                        name,
                        f"{n['HOTA']:.1f} ({n['d0=.5']:.1f})",
                        shown(n["DetA"]),
                        shown(n["AssA"]),
                        shown(n["birth s"], 2),
                        shown(n["ghost s"], 2),
                        shown(n["95 %"]),
                        taken,
                        brier,
                    ]
                )
    return rows(heads, lines)


def sensors_table(runs: Sequence[Run], groups: Mapping[str, Sequence[str]]) -> list[str]:
    """Both sensors less the better one, at three scales: mean with its 95 % interval (Student's t), and the worst."""
    lines = []
    for name, cases in {**{case: [case] for group in groups.values() for case in group}, **groups}.items():
        cells = []
        for scale in ("hota", "fine", "finest"):
            gains = np.array([gain for case in cases for gain in fused(runs, case, scale)])
            if len(gains) > 1:
                half = float(stats.t.ppf(0.975, len(gains) - 1)) * gains.std(ddof=1) / math.sqrt(len(gains))
                cells += [f"{gains.mean():+.2f} ± {half:.2f}", f"{gains.min():+.1f}"]
        if cells:
            lines.append([name, *cells])
    heads = [f"{what} {scale} m" for scale in ("2", ".5", ".25") for what in ("d0", "worst")]
    return rows(["case", *heads], lines)


def single_table(runs: Sequence[Run]) -> list[str]:
    """HOTA of each sensor alone and of both at three scales, the means over the scenes."""
    lines = []
    for case in cases_of(runs):
        for sensors in ("audio", "video", ""):
            found = [one.outcome for one in chosen(runs, DEFAULT, sensors, case)]
            values = [mean(getattr(one, scale) for one in found) for scale in ("hota", "fine", "finest")]
            lines.append([f"{case}, {sensors or 'both'}", str(len(found)), *map(shown, values)])
    return rows(["scenario", "scenes", "d0 2 m", "d0 .5 m", "d0 .25 m"], lines)


def fused(runs: Sequence[Run], case: str, scale: str) -> list[float]:
    """HOTA with both sensors less that with the better one, for each seed."""
    found = [
        {run.seed: getattr(run.outcome, scale) for run in chosen(runs, DEFAULT, sensors, case)}
        for sensors in ("", "audio", "video")
    ]
    return [found[0][seed] - max(found[1][seed], found[2][seed]) for seed in found[0] if seed in found[1]]


def reliability(groups: dict[str, list[Run]]) -> dict[str, np.ndarray]:
    """For each group and bin of existence: records, runs, and what is said and true of all, and alike: (10, 6).

    Alike: each case has the same weight. Some have more seeds than others because chance weighs on their HOTA, not
    because such scenes are frequent.
    """
    out = {}
    for name, runs in groups.items():
        bins = np.array([run.outcome.bins for run in runs]).reshape(-1, BINS, 4)
        seeds = Counter(run.case for run in runs)
        alike = np.tensordot([1 / seeds[run.case] for run in runs], bins, 1)
        with np.errstate(invalid="ignore"):
            said = [sums[:, 1:3] / sums[:, :1] for sums in (bins.sum(0), alike)]
        out[name] = np.column_stack([bins[..., 0].sum(0), (bins[..., 0] > 0).sum(0), *said])
    return out


def reliability_table(groups: dict[str, list[Run]]) -> list[str]:
    """What is said of existence, and what is true, in bins of .1 from .5 on; a star: they differ where it counts."""
    lines = []
    for name, table in reliability(groups).items():
        for k in range(BINS // 2, BINS):
            count, runs, *pairs = table[k].tolist()
            if count:
                cells = [f"{count:.0f}", f"{runs:.0f}"]
                for said, true in (pairs[:2], pairs[2:]):
                    bad = count >= ENOUGH and runs >= RUNS and abs(said - true) > CLOSE
                    cells += [f"{said:.3f}", f"{true:.3f}" + " *" * bad]
                lines.append([name, f"{k / BINS:.1f} to {(k + 1) / BINS:.1f}", *cells])
        squares = np.array([run.outcome.bins for run in groups[name]]).reshape(-1, BINS, 4).sum((0, 1))
        if squares[0]:
            brier = f"{squares[3] / squares[0]:.4f}"
            lines.append([name, "Brier", f"{squares[0]:.0f}", str(len(groups[name])), "", brier, "", ""])
    return rows(["detections", "existence", "records", "runs", "said", "true", "alike: said", "true"], lines)


def markdown(runs: Sequence[Run], before: Sequence[Run], own: Sequence[Run]) -> str:
    """All tables."""
    seeds = sorted({run.seed for run in runs})
    real = [run for run in runs if not is_synthetic(run.case)]
    peers = (
        "SORT, ByteTrack and OC-SORT on points in metres (tests/bench/tracking_peers.py says how), Stone Soup's GNN "
        "and JPDA, avfuse's own gnn, and avfuse with --no-hidden."
    )
    sensors = "Difference of HOTA for each seed: mean with its 95 % interval, and the worst. coarse: video sigma .2 m."
    star = (
        f"A star: more than {CLOSE} apart, where there are {ENOUGH} records of {RUNS} runs. Alike: each case counts "
        "the same, however many seeds it has."
    )
    old = {f"{name}, before": found for name, found in groups_of(before, ()).items()}
    existence = {**groups_of(runs, own), **old}
    groups = {"s1 to s4": [*EASY], "s1 to s4, coarse": [*COARSE]}
    lines = [
        "# Trackers on the same detections",
        "",
        f"Made by `tests/bench/bench_tracking.py` on seeds from {seeds[0]} on; seeds from 100 on decided settings.",
        f"The load average was {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the end.",
        "",
        *LEGEND,
        "",
        *section("The default tracker on each case", "", cases_table(runs, before)),
        *section("Peers on the same detections, HOTA", peers, variants_table(runs, peers_of(runs))),
        *section("Tracks of real people", "", real_table(real)),
        *section("Hypotheses and delay, HOTA", "", variants_table(runs, OWN)),
        *section("Both sensors less the better one", sensors, sensors_table(runs, groups)),
        *section("Existence: said and true", star, reliability_table(existence)),
    ]
    return "\n".join(lines)


def section(title: str, text: str, table: list[str]) -> list[str]:
    """A heading, a paragraph and a table; nothing where the table is empty."""
    if not table:
        return []
    return [f"## {title}", "", *([*textwrap.wrap(text, 118), ""] if text else []), *table]


def groups_of(runs: Sequence[Run], own: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs of the default tracker by where their detections come from."""
    mine = chosen(runs)
    groups = {
        "synthetic": [run for run in mine if is_synthetic(run.case)],
        "real people": [run for run in mine if not is_synthetic(run.case)],
        "own detections": chosen(own),
    }
    return {name: found for name, found in groups.items() if found}


# --- pictures ---------------------------------------------------------------------------------------------------------


def plots(runs: Sequence[Run], own: Sequence[Run], folder: Path) -> None:
    """Write tracking.svg (time and error of each tracker) and tracking-existence.svg (said and true)."""
    try:
        import matplotlib
    except ModuleNotFoundError:
        print("no plots: matplotlib is not installed (avcli[plot])", file=sys.stderr)
        return
    matplotlib.use("svg")
    import matplotlib.pyplot as plt
    from matplotlib import ticker

    names = [one for one in dict.fromkeys(run.variant for run in runs) if one != CEILING]
    cases = [case for case in cases_of(runs) if len({run.variant for run in runs if run.case == case}) > 2]
    if cases:
        figure, axes = plt.subplots(
            math.ceil(len(cases) / 6), 6, figsize=(24, 4 * math.ceil(len(cases) / 6)), squeeze=False
        )
        for axis, case in zip(axes.flat, cases, strict=False):
            seeds = [{one.seed for one in chosen(runs, name, case=case)} for name in names]
            same = set.intersection(*[some for some in seeds if some])  # some trackers have more scenes
            for k, name in enumerate(names):
                found = [one.outcome for one in chosen(runs, name, case=case) if one.seed in same]
                if found:
                    error, spent = 100 - mean(one.hota for one in found), min(one.spent for one in found)
                    axis.plot(spent, error, "os^vDP*"[k // 10], color=f"C{k % 10}", label=name)
            best = [one.outcome.hota for one in chosen(runs, CEILING, case=case) if one.seed in same]
            if best:
                axis.axhline(100 - mean(best), color="0.6", linestyle=":")
            axis.set(title=Path(case).name, xscale="log", xlabel="ms a frame", ylabel="100 - HOTA", ylim=(0, None))
            axis.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter(ticker.NullFormatter())
        axes.flat[0].legend(fontsize=6)
        for axis in axes.flat[len(cases) :]:
            axis.remove()
        figure.tight_layout()
        figure.savefig(folder / "tracking.svg")
    figure, axis = plt.subplots(figsize=(6, 6))
    axis.plot([0, 1], [0, 1], color="0.7")
    for name, table in reliability(groups_of(runs, own)).items():
        there = table[:, 0] >= 20
        axis.plot(table[there, 2], table[there, 3], "o-", label=f"{name}, {table[:, 0].sum():.0f} records")
    axis.set(xlabel="existence that is said", ylabel="share that is true", xlim=(0.4, 1), ylim=(0, 1.02))
    axis.legend()
    figure.savefig(folder / "tracking-existence.svg")
