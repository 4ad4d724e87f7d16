"""Trackers on S1 to S4, on hard worlds, and on the tracks of real people (`make bench-tracking`).

Without --out, a line a case for who develops: HOTA, its parts, ghosts, existence and time, of the default settings
and of each --set beside them, in one run. With --out, the tables of examples/benchmarks/tracking.md. --before adds what
another run's tracking.json says; to run the bench on other code, put that code's directory into PYTHONPATH.

Every tracker has one set of parameters, its defaults, which were decided on seeds from 100 on; the seeds from 0 on are
reported. "ceiling" is the Kalman filter (IMM) that is told which detection belongs to whom. Times are processor time of
the tracker alone, the least of all seeds; another load on the machine still shows in them.

Cases: the names of tracking_scenes.py and tracking_worlds.py, with --walks those of walks.py, and directories with a
ready case. What judges and may not decide (some real sets, synthetic seeds below 100) is refused without --judge or
--out. All tables take about an hour on one core; --cases, --variants, --seeds and --no-more make it less. A
run that was stopped goes on where it was, if the code is the same.
"""

import argparse
import hashlib
import importlib.util
import math
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).resolve().parent))

import tracking_peers
import tracking_report as report
from figures import Row, figure, hand_over
from tracking_cases import MORE, ONCE, REAL, SYNTHETIC, TOO_MUCH, judged, scene_of
from tracking_measures import SUMMARY, Outcome, mean, outcome, summary
from tracking_report import CEILING, DEFAULT, OWN, Run
from tracking_runs import Variant, ceiling, fuse
from tracking_scenes import EASY, HARD
from tracking_worlds import COARSE

from avcli.tracking import trackers

tracking_peers.register()
VARIANTS = {
    DEFAULT: Variant(),
    "no-hidden": Variant.of(["no-hidden"]),
    **{name: Variant(name) for name in trackers.TRACKERS if name not in ("ms-glmb", "lmb")},
    **{f"{n} hypotheses": Variant.of([f"hypotheses={n}"]) for n in (5, 20, 80)},
    "lag 5": Variant(lag=5),
    "lag inf": Variant(lag=math.inf),
    "lmb": Variant("lmb"),
    CEILING: Variant(),  # of its kind: see `ran`
}
WITH_MORE = (DEFAULT, CEILING)  # those that get the seeds of MORE
NEEDS = {"jpda": "stonesoup", "stonesoup-gnn": "stonesoup"}

Task = tuple[str, int, list[tuple[str, str]]]  # case, seed, what is run: (variant, sensor or "" for all)


def ran(task: Task, variants: dict[str, Variant], root: Path | None) -> list[Outcome]:
    """What one scene gives each variant; the one called "ceiling" is the filter that knows the associations."""
    case, seed, entries = task
    whole, out = scene_of(case, seed, root), []
    for name, sensors in entries:
        scene = whole.only(sensors) if sensors else whole
        tracks, spent = (ceiling(scene), math.nan) if name == CEILING else fuse(scene, variants[name])
        out.append(outcome(scene, tracks, spent))
    return out


# --- a line a case ----------------------------------------------------------------------------------------------------


def table(cases: list[str], seeds: range, variants: dict[str, Variant], root: Path | None, jobs: int) -> None:
    """Print a line a case and variant, and their means over the cases."""
    scenes = {case: seeds[:1] if case in ONCE or Path(case).is_dir() else seeds for case in cases}
    tasks: list[Task] = [(case, seed, [(name, "") for name in variants]) for case in cases for seed in scenes[case]]
    widest, first = max(len(Path(case).name) for case in (*cases, "mean")) + 2, next(iter(variants))
    print(f"{'case':{widest}s}{'variant':22s}" + "".join(f"{name:>8s}" for name in (*SUMMARY, "ratio")))
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in variants}
    with ProcessPoolExecutor(jobs) as pool:
        results = pool.map(partial(ran, variants=variants, root=root), tasks)
        for case in cases:
            found = [next(results) for _ in scenes[case]]
            for k, (name, values) in enumerate(rows.items()):
                values.append(summary([one[k] for one in found]))
                values[-1]["ratio"] = values[-1]["ms"] / rows[first][-1]["ms"]
                print(f"{Path(case).name:{widest}s}{name:22s}{line(values[-1])}", flush=True)
    for name, values in rows.items():
        print(f"{'mean':{widest}s}{name:22s}{line({key: mean(row[key] for row in values) for key in values[0]})}")


def line(row: dict[str, float]) -> str:
    """The numbers of a row of the table."""
    return "".join(f"{'-' if math.isnan(v) else format(v, f'.{SUMMARY.get(k, 2)}f'):>8s}" for k, v in row.items())


# --- the tables of the project ----------------------------------------------------------------------------------------


def tasks_of(cases: Sequence[str], names: Sequence[str], seeds: range, more: bool) -> list[Task]:
    """What is to be run for the tables: the same seeds for all variants, and more for a few."""
    tasks: list[Task] = []
    for case in cases:
        entries = [
            (name, "")
            for name in names
            if case not in TOO_MUCH.get(name, ()) and (name not in OWN or case in EASY or case in HARD)
        ]
        few = [entry for entry in entries if entry[0] in WITH_MORE]
        if DEFAULT in names and (case in EASY or case in COARSE):
            few += [(DEFAULT, "audio"), (DEFAULT, "video")]
            entries += few[-2:]
        count = max(len(seeds), MORE.get(case, 0)) if more and DEFAULT in names else len(seeds)
        count = 1 if case in ONCE or Path(case).is_dir() else count
        tasks += [(case, seeds[0] + k, entries if k < len(seeds) else few) for k in range(count)]
    return tasks


def tables(options: argparse.Namespace, cases: list[str], names: list[str], seeds: range) -> None:
    """Run all cases that no stopped run of the same code kept; write tracking.json, tracking.md and the pictures."""
    tasks = tasks_of(cases, names, seeds, not options.no_more)
    options.out.mkdir(parents=True, exist_ok=True)
    kept = options.out / f"tracking-{code()}.jsonl"
    known = {(one.case, one.seed, one.variant, one.sensors): one for one in report.kept(kept)}
    missing = [(case, seed, [one for one in some if (case, seed, *one) not in known]) for case, seed, some in tasks]
    missing = [task for task in missing if task[2]]
    with ProcessPoolExecutor(options.jobs) as pool:
        results = pool.map(partial(ran, variants=VARIANTS, root=options.walks), missing)
        for k, ((case, seed, entries), found) in enumerate(zip(missing, results, strict=True)):
            fresh = [Run(case, seed, *entry, one) for entry, one in zip(entries, found, strict=True)]
            report.keep(fresh, kept)
            known |= {(case, seed, *entry): one for entry, one in zip(entries, fresh, strict=True)}
            if sys.stderr.isatty():
                print(f"\r{k + 1} of {len(missing)} scenes, {case:24s}", end="", file=sys.stderr, flush=True)
    runs = [known[case, seed, *entry] for case, seed, entries in tasks for entry in entries]
    report.write(runs, options.out / "tracking.json")
    own = options.out / "tracking-real.json"
    detected = report.read(own) if own.exists() else []
    before = report.read(options.before) if options.before else []
    (options.out / "tracking.md").write_text(report.markdown(runs, before, detected))
    report.plots(runs, detected, options.out)
    hand_over(options.out, "fuse", figures(runs))


def code() -> str:
    """A mark of the code that decides the figures: the tracker and this bench."""
    here = Path(__file__).parent
    sources = [*Path(trackers.__file__).parent.iterdir(), *here.glob("*track*.py"), *here.glob("*_scenes.py")]
    sources += here.glob("walk*.py")
    return hashlib.sha256(b"".join(one.read_bytes() for one in sorted(sources) if one.is_file())).hexdigest()[:12]


def figures(runs: Sequence[Run]) -> Iterator[Row]:
    """Least time and mean error of each tracker in each case, by all sensors."""
    for case, variant in dict.fromkeys((run.case, run.variant) for run in runs):
        some = [run.outcome for run in runs if (run.case, run.variant, run.sensors) == (case, variant, "")]
        tool = variant if variant in tracking_peers.PEERS else f"avcli {variant}"
        spent = min(one.spent for one in some)
        if not math.isnan(spent):
            lost = 100 - mean(one.hota for one in some)
            yield figure("fuse", case, tool, spent / 1e3, "record", lost, "points of HOTA lost")


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", help="names of cases, or directories of ready ones")
    parser.add_argument("--ready", type=Path, help="a directory: all ready cases in it are added to --cases")
    parser.add_argument("--walks", type=Path, help="a checkout of OpenTraj, for the cases of walks.py")
    parser.add_argument("--seeds", type=int, default=3, help="scenes of each case")
    parser.add_argument("--first", type=int, help="the first seed (100; with --out 0)")
    parser.add_argument("--jobs", type=int, default=1, help="processes; more than one blurs the times")
    parser.add_argument("--judge", action="store_true", help="run the sets and seeds that may not decide")
    words = "another variant: no-hidden, stay=20, lag=5, tracker=gnn, ceiling …"
    parser.add_argument("--set", nargs="*", action="append", default=[], dest="settings", metavar="SETTING", help=words)
    parser.add_argument("--only", action="store_true", help="the variants of --set without the default one")
    parser.add_argument("--out", type=Path, help="write all tables into this directory")
    parser.add_argument("--no-more", action="store_true", help="with --out: no more seeds than these of any case")
    parser.add_argument("--variants", nargs="*", choices=list(VARIANTS), help="with --out: these alone")
    parser.add_argument("--before", type=Path, help="with --out: tracking.json of another run, to compare with")
    options = parser.parse_args()
    options.first = options.first if options.first is not None else (0 if options.out else 100)
    options.fail = parser.error
    return options


def main() -> None:
    options = arguments()
    seeds = range(options.first, options.first + options.seeds)
    ready = sorted(str(one) for one in options.ready.iterdir() if one.is_dir()) if options.ready else []
    cases = [*(options.cases or []), *ready] or [*SYNTHETIC, *(REAL if options.walks else ())]
    forbidden = [case for case in judged(cases, seeds) if not (options.out and case in SYNTHETIC)]
    if forbidden and not options.judge:
        options.fail(f"these judge, and may not decide (--judge): {', '.join(forbidden)}")
    if options.out:
        there = [n for n in VARIANTS if importlib.util.find_spec(NEEDS.get(n, "numpy"))]
        tables(options, cases, options.variants or there, seeds)
        return
    variants = {} if options.only else {DEFAULT: Variant()}
    for words in options.settings:
        variants[" ".join(words)] = Variant() if words == [CEILING] else Variant.of(words)
    table(cases, seeds, variants, options.walks, options.jobs)


if __name__ == "__main__":
    main()
