"""Trackers on S1 to S4, on hard cases and on the tracks of real people (`make bench-tracking`).

Without --out, a line a case for who develops: HOTA, its parts, ghosts, existence and time, of the default settings
and of each --set beside them, in one run. With --out, the tables of examples/benchmarks/tracking.md.

Every tracker has one set of parameters, its defaults, which were decided on seeds from 100 on; the seeds from 0 on are
reported. "ceiling" is the Kalman filter (IMM) that is told which detection belongs to whom. Times are processor time of
the tracker alone, the least of all seeds; another load on the machine still shows in them.

Cases: the names of tracking_scenes.py, and with --walks the names of walks.py. The real sets that judge are refused
without --judge.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

import walks
from tracking_measures import SUMMARY, Outcome, mean, outcome, summary
from tracking_runs import Variant, ceiling, detections, fuse
from tracking_scenes import EASY, HARD, Scene, Truth
from tracking_worlds import WORLDS

from avcli.metrics.metric import Case
from avcli.metrics.registry import score_case
from avcli.metrics.sequence import Sequence
from avcli.tracking.trackers import TRACKERS

__all__ = ["detections", "measure", "scene_of"]  # for fit_tracking.py

Tracks = list[tuple[list[int], np.ndarray]]  # (ids, xy (n, 2) m) a frame
Row = dict[str, Any]

MORE = {  # seeds of the default tracker and the ceiling alone, where chance weighs heavily
    **dict.fromkeys(EASY, 10),
    **dict.fromkeys(("turning-back", "crossing", "comings-goings", "weak", "asynchronous", "damaged"), 10),
    **dict.fromkeys(("gaps", "dim-edge"), 100),
    "clutter": 6,
    "ten": 10,
    "long-pair": 30,
}
TOO_MUCH = {"jpda": ("clutter", "ten", "long-pair")}  # it enumerates all joint associations: hours, or minutes
SYNTHETIC: dict[str, Callable[[np.random.Generator], Scene]] = {**EASY, **HARD, **WORLDS}
COLUMNS = ("HOTA", "DetA", "AssA", "LocA", "OSPA2", "BirthDelay")
VARIANTS = {
    "ms-glmb": Variant(),
    **{f"ms-glmb, {n} hypotheses": Variant.of([f"hypotheses={n}"]) for n in (5, 20, 80)},
    "ms-glmb, lag 5": Variant(lag=5),
    "ms-glmb, lag inf": Variant(lag=math.inf),
    **{name: Variant(name) for name in TRACKERS if name != "ms-glmb"},
}


def measure(truth: Truth, tracks: Tracks) -> list[float]:
    """The columns of the table: percent, OSPA(2) in m, the birth delay in frames."""
    sequence = Sequence.of([(ids.tolist(), xy) for _, ids, xy in truth], tracks)
    summary = score_case(Case(sequence))["summary"]
    values = [math.nan if summary[c] is None else summary[c] for c in COLUMNS]
    return [v * (1 if c in ("OSPA2", "BirthDelay") else 100) for c, v in zip(COLUMNS, values, strict=True)]


def scene_of(case: str, seed: int, root: Path | None = None) -> Scene:
    """The scene of a case: a name of tracking_scenes.py or of walks.py, or the path of a ready case."""
    rng = np.random.default_rng(seed)
    if case in SYNTHETIC:
        return SYNTHETIC[case](rng)
    if root is not None and walks.dataset(case):
        return walks.scene(rng, case, root)
    return walks.ready(Path(case))


Entry = tuple[str, tuple[str, ...]]  # a tracker, and the sensors that it gets: (): all
Task = tuple[str, int, list[Entry]]  # case, seed, what is run


def job(task: Task) -> dict[Entry, list[float]]:
    """What one scene gives each tracker: {(tracker, sensors): its columns and milliseconds a frame}."""
    case, seed, rows = task
    whole, out = scene_of(case, seed), {}
    for name, sensors in rows:
        scene = whole.only(*sensors) if sensors else whole
        tracks, spent = (ceiling(scene), math.nan) if name == "ceiling" else fuse(scene, VARIANTS[name])
        out[name, sensors] = [*measure(scene.truth, [(one.ids, one.xy) for one in tracks]), spent]
    return out


# --- a line a case ----------------------------------------------------------------------------------------------------


def quick(task: tuple[str, int], variants: dict[str, Variant], root: Path | None) -> dict[str, Outcome]:
    """What one scene gives each variant; "ceiling" among their names is the filter that knows the associations."""
    scene = scene_of(*task, root)
    runs = {
        name: (ceiling(scene), math.nan) if name == "ceiling" else fuse(scene, one) for name, one in variants.items()
    }
    return {name: outcome(scene, *run) for name, run in runs.items()}


def table(cases: list[str], seeds: range, variants: dict[str, Variant], root: Path | None, jobs: int) -> None:
    """Print a line a case and variant, and their means over the cases."""
    tasks = [(case, seed) for case in cases for seed in seeds]
    widest = max(len(Path(case).name) for case in cases) + 2
    print(f"{'case':{widest}s}{'variant':22s}" + "".join(f"{name:>8s}" for name in (*SUMMARY, "ratio")))
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
    with ProcessPoolExecutor(jobs) as pool:
        results = pool.map(partial(quick, variants=variants, root=root), tasks)
        for case in cases:
            found = [next(results) for _ in seeds]
            for name in variants:
                row = summary([one[name] for one in found])
                rows[name].append(row)
                row["ratio"] = row["ms"] / rows[next(iter(variants))][-1]["ms"]
                print(f"{Path(case).name:{widest}s}{name:22s}{line(row)}", flush=True)
    for name, values in rows.items():
        print(f"{'mean':{widest}s}{name:22s}{line({key: mean(row[key] for row in values) for key in values[0]})}")


def line(row: dict[str, float]) -> str:
    """The numbers of a row of the table."""
    return "".join(f"{'-' if math.isnan(v) else format(v, f'.{SUMMARY.get(k, 2)}f'):>8s}" for k, v in row.items())


def judged(cases: Iterable[str], seeds: range) -> list[str]:
    """Those of the cases that judge, and may not decide: the sets that say so, and synthetic seeds below 100."""
    return [
        case
        for case in cases
        if (not one.decides if (one := walks.dataset(case)) else seeds[0] < 100 and not Path(case).is_dir())
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="write the tables into this directory")
    parser.add_argument("--seeds", type=int, default=3, help="scenes of each case")
    parser.add_argument("--first", type=int, help="the first seed (100; with --out 0)")
    parser.add_argument("--cases", nargs="*", help="names of cases, or directories of ready ones")
    parser.add_argument("--ready", type=Path, help="a directory: all ready cases in it are added to --cases")
    parser.add_argument("--walks", type=Path, help="a checkout of OpenTraj, for the cases of walks.py")
    parser.add_argument("--judge", action="store_true", help="run the sets and seeds that may not decide")
    parser.add_argument("--set", nargs="*", action="append", default=[], dest="variants", metavar="SETTING",
        help="another variant: no-hidden, stay=20, lag=5, tracker=gnn, ceiling …")  # fmt: skip
    parser.add_argument("--only", action="store_true", help="the variants of --set without the default one")
    parser.add_argument("--jobs", type=int, default=1, help="processes; more than one blurs the times")
    parser.add_argument("--no-more", action="store_true", help="with --out: no more seeds than these of any case")
    parser.add_argument("--trackers", nargs="*", choices=list(VARIANTS), help="with --out: these alone")
    options = parser.parse_args()
    options.first = options.first if options.first is not None else (0 if options.out else 100)
    if options.out:
        options.cases = options.cases or [*EASY, *HARD]
        report(options)
        return
    ready = [str(one) for one in sorted(options.ready.iterdir())] if options.ready else []
    cases = [*(options.cases or []), *ready] or [*SYNTHETIC]
    seeds = range(options.first, options.first + options.seeds)
    forbidden = judged(cases, seeds)
    if forbidden and not options.judge:
        parser.error(f"these judge, and may not decide (--judge): {', '.join(forbidden)}")
    variants = {} if options.only else {"default": Variant()}
    for words in options.variants:
        variants[" ".join(words)] = Variant() if words == ["ceiling"] else Variant.of(words)
    table(cases, seeds, variants, options.walks, options.jobs)


# --- the tables of the project ----------------------------------------------------------------------------------------


def report(options: argparse.Namespace) -> None:
    """Run all cases and write tracking.json, tracking.md and tracking.svg."""
    names = options.trackers
    if names is None:
        import importlib.util

        names = [n for n in VARIANTS if n != "jpda" or importlib.util.find_spec("stonesoup")]
    seeds = range(options.first, options.first + options.seeds)
    all_rows: dict[str, list[Entry]] = {}
    tasks: list[Task] = []
    for case in options.cases:
        main_rows: list[Entry] = [(name, ()) for name in ("ms-glmb", "ceiling") if name in (*names, "ceiling")]
        if case in EASY and "ms-glmb" in names:
            main_rows += [("ms-glmb", (eye,)) for eye in ("audio", "video")]
        others: list[Entry] = [(name, ()) for name in names if name != "ms-glmb" and case not in TOO_MUCH.get(name, ())]
        all_rows[case] = main_rows[:1] + others + main_rows[1:]
        count = max(options.seeds, MORE[case]) if "ms-glmb" in names and not options.no_more else options.seeds
        tasks += [(case, options.first + k, all_rows[case] if k < len(seeds) else main_rows) for k in range(count)]
    with ProcessPoolExecutor(options.jobs) as pool:
        results = list(pool.map(job, tasks))
    rows_found: list[Row] = []
    for case, rows in all_rows.items():
        found = [result for task, result in zip(tasks, results, strict=True) if task[0] == case]
        for row in dict.fromkeys(rows):
            every = np.array([result[row] for result in found if row in result])
            block = every[: len(seeds)]
            rows_found.append(
                {
                    "case": case,
                    "tracker": row[0] + (f" ({row[1][0]} only)" if row[1] else ""),
                    **dict(zip(COLUMNS, block[:, :-1].mean(0).tolist(), strict=True)),
                    "HOTA_min": float(block[:, 0].min()),
                    "HOTA_all": every[:, 0].tolist(),
                    "ms": float(every[:, -1].min()),
                }
            )
    show(rows_found)
    gains = against_best_sensor(rows_found)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "tracking.json").write_text(json.dumps({"seeds": [*seeds], "rows": rows_found, "gains": gains}))
    (options.out / "tracking.md").write_text(markdown(rows_found, seeds, gains))
    plot(rows_found, options.out / "tracking.svg")


def show(table: list[Row]) -> None:
    print(f"{'case':15s} {'tracker':26s}" + "".join(f"{c:>11s}" for c in (*COLUMNS, "worst HOTA", "ms/frame")))
    for row in sorted(table, key=lambda r: list({**EASY, **HARD}).index(r["case"])):
        values = [row[c] for c in COLUMNS] + [row["HOTA_min"], row["ms"]]
        print(f"{row['case']:15s} {row['tracker']:26s}" + "".join(f"{v:11.2f}" for v in values))


def markdown(table: list[Row], seeds: range, gains: dict[str, dict[str, float]]) -> str:
    """The table of one run as Markdown."""
    lines = [
        f"# Trackers on synthetic detections, seeds {seeds[0]} to {seeds[-1]}",
        "",
        "HOTA and its parts in percent, OSPA(2) in m, birth delay in frames; times are processor time of the tracker",
        f"alone, the least of the seeds (load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the end).",
        "The ceiling is a filter that knows the true association of detections with people.  Made by",
        "`tests/bench/bench_tracking.py`, which describes the cases; see tracking.svg for run time against error.",
        "",
        "| case | tracker | " + " | ".join((*COLUMNS, "worst HOTA", "ms a frame")) + " |",
        "|---|---|" + "---:|" * (len(COLUMNS) + 2),
    ]
    for row in sorted(table, key=lambda r: list({**EASY, **HARD}).index(r["case"])):
        values = [row[c] for c in COLUMNS] + [row["HOTA_min"], row["ms"]]
        shown = " | ".join("" if math.isnan(v) else f"{v:.2f}" for v in values)
        lines.append(f"| {row['case']} | {row['tracker']} | {shown} |")
    hota = {(row["case"], row["tracker"]): np.array(row["HOTA_all"]) for row in table}
    lines += [
        "",
        "# More seeds of the default tracker, HOTA",
        "",
        "Settings were decided on seeds from 100 on. One swap of identities moves a scene by tens of points.",
        "",
        "| case | seeds | mean | standard error | ceiling | each |",
        "|---|---|---:|---:|---:|---|",
    ]
    for (case, name), each in hota.items():
        if name == "ms-glmb":
            error, best = each.std(ddof=1) / math.sqrt(len(each)) if len(each) > 1 else math.nan, hota[case, "ceiling"]
            shown = ", ".join(f"{v:.0f}" for v in each)
            lines.append(
                f"| {case} | {seeds[0]} to {seeds[0] + len(each) - 1} | {each.mean():.1f} | {error:.1f} "
                f"| {best.mean():.1f} | {shown} |"
            )
    lines += [""] + [
        f"- {case}: fused less the better single sensor: mean {gain['mean']:+.2f}, least {gain['least']:+.2f}"
        for case, gain in gains.items()
    ]
    return "\n".join(lines) + "\n"


def against_best_sensor(table: list[Row]) -> dict[str, dict[str, float]]:
    """Difference of fused HOTA to the better single sensor's, each seed: prints and returns mean and least by case."""
    found = {(row["case"], row["tracker"]): np.array(row["HOTA_all"]) for row in table}
    gains = {}
    for case in EASY:
        if (case, "ms-glmb (audio only)") in found:
            best = np.maximum(found[case, "ms-glmb (audio only)"], found[case, "ms-glmb (video only)"])
            gain = found[case, "ms-glmb"] - best
            gains[case] = {"mean": float(gain.mean()), "least": float(gain.min())}
            print(f"{case}: both less the better sensor: mean {gain.mean():+.2f}, least {gain.min():+.2f}")
    return gains


def plot(table: list[Row], path: Path) -> None:
    """Run time against error, a point a tracker and case."""
    try:
        import matplotlib
    except ModuleNotFoundError:
        print("no plot: matplotlib is not installed (avcli[plot])", file=sys.stderr)
        return
    matplotlib.use("svg")
    import matplotlib.pyplot as plt
    from matplotlib import ticker

    cases = [c for c in {**EASY, **HARD} if any(row["case"] == c for row in table)]
    figure, axes = plt.subplots(3, math.ceil(len(cases) / 3), figsize=(18, 10), squeeze=False)
    for axis, case in zip(axes.flat, cases, strict=False):
        for row in table:
            if row["case"] != case or "only" in row["tracker"]:
                continue
            if row["tracker"] == "ceiling":
                axis.axhline(100 - row["HOTA"], color="0.6", linestyle=":")
            else:
                axis.plot(row["ms"], 100 - row["HOTA"], "o", label=row["tracker"])
        axis.set(title=case, xscale="log", xlabel="ms a frame", ylabel="100 - HOTA", ylim=(0, None))
        axis.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(ticker.NullFormatter())
    axes.flat[0].legend(fontsize=6)
    for axis in axes.flat[len(cases) :]:
        axis.remove()
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    main()
