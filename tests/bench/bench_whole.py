"""All benchmarks and the whole pipeline on one page: run time against error, beside peers, and a budget of time.

    make bench                                    # five minutes on a quiet machine
    make bench BENCH_FLAGS="--all"                # every stage benchmark as it stands: hours
    make bench BENCH_FLAGS="--check"              # exits 1 above a limit of budget.json, or without one
    make bench BENCH_FLAGS="--only pipe audio"    # some of it; what an earlier run measured stays on the page

Writes bench.jsonl, bench.md and index.html into --out. A small reference workload (machine.py) runs before and after
each part, and every time is also given in units of it: so machines can be compared, and so most of what a busy machine
does to a time is taken out. Peers are those of `make setup-bench`; without it they are left out, and it is said.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import budget
import whole_page
import whole_pipe
from figures import Row, hand_over, handed_over
from machine import described, reference

HERE = Path(__file__).resolve().parent
PEERS = HERE.parents[1] / ".venv-bench" / "bin" / "python"


@dataclass(frozen=True)
class Stage:
    """A benchmark of one stage: its script, and its options in the quick run and in the whole one."""

    script: str
    quick: Sequence[str]
    whole: Sequence[str] = ()
    needs_peers: bool = False


STAGES = {
    "scene": Stage("scene", ["--quick"]),
    "audio": Stage("audio", ["--quick", "--peers", str(PEERS)], ["--peers", str(PEERS)]),
    "detect-audio": Stage(
        "localization", ["--scenes", "1", "--kinds", "turns", "two", "--no-variants"], needs_peers=True
    ),
    "detect-video": Stage("detection", ["--scenes", "2"]),
    "fuse": Stage(
        "tracking",
        [
            "--cases",
            "s1",
            "ten",
            "crowd30",
            "--seeds",
            "1",
            "--no-more",
            "--variants",
            "default",
            "gnn",
            "sort",
            "bytetrack",
            "oc-sort",
        ],
    ),
    "eval": Stage("metrics", ["--quick", "--rounds", "1"]),
    "calibration": Stage("calibration", ["--quick", "--only", "methods", "--seeds", "1"]),
}


def stage_rows(stage: Stage, out: Path, whole: bool) -> str:
    """Run one benchmark, which hands its figures over; return why it could not, or ""."""
    if stage.needs_peers and not PEERS.exists():
        return "needs make setup-bench"
    command = [sys.executable, str(HERE / f"bench_{stage.script}.py"), "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(HERE.parents[1])}
    with open(out / f"{stage.script}.log", "w") as log:
        ended = subprocess.run([*command, *(stage.whole if whole else stage.quick)], stdout=log, stderr=log,
                               env=environment)  # fmt: skip
    if ended.returncode:
        lines = Path(log.name).read_text().strip().splitlines()
        return f"exit {ended.returncode}: {lines[-1] if lines else ''}"
    return ""


def measured(out: Path, only: Sequence[str], whole: bool) -> dict[str, str]:
    """Run what is asked for; each part's figures are kept with the reference around it. Return what failed and why."""
    own = {"pipe": whole_pipe.pipe_rows, "start": whole_pipe.start_rows}

    def by_itself(name: str) -> str:
        hand_over(out, name, own[name]())
        return ""

    work: dict[str, Callable[[], str]] = {name: partial(by_itself, name) for name in own}
    work |= {name: partial(stage_rows, stage, out, whole) for name, stage in STAGES.items()}
    failed = {}
    before = reference()
    for name in [name for name in work if not only or name in only]:
        begin = time.perf_counter()
        (out / f"{name}.figures.jsonl").unlink(missing_ok=True)
        reason = work[name]()
        after = reference()
        around = {key: (before[key] + after[key]) / 2 for key in before}
        before = after
        (out / f"{name}.reference.json").write_text(json.dumps({**around, "load": os.getloadavg()[0]}) + "\n")
        if reason:
            failed[name] = reason
        print(f"{name}: {reason or 'done'}, {time.perf_counter() - begin:.0f} s", flush=True)
    return failed


def in_units(rows: Sequence[Row], out: Path) -> list[Row]:
    """Add to each row its time in units of the reference workload around it."""
    units: dict[str, dict[str, float]] = {}
    for row in rows:
        stage = row["stage"]
        if stage not in units:
            units[stage] = json.loads((out / f"{stage}.reference.json").read_text())
        for time_key, unit_key in (("cpu_s", "units"), ("wall_s", "wall_units")):
            if row.get(time_key) is not None:
                row[unit_key] = row[time_key] / units[stage]["all"]
    return list(rows)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--only", nargs="+", choices=["pipe", "start", *STAGES], default=[], metavar="PART",
                        help=f"pipe, start, {', '.join(STAGES)}")  # fmt: skip
    parser.add_argument("--all", action="store_true", help="each stage benchmark with its own defaults: hours")
    parser.add_argument(
        "--check", action="store_true", help="exit 1 above the budget, without a limit, or where a part failed"
    )
    parser.add_argument("--write-budget", action="store_true", help="allow half as much again as was measured now")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    machine = described()
    failed = measured(options.out, options.only, options.all)
    rows = in_units(list(handed_over(options.out)), options.out)
    machine["reference"] = reference()
    if options.write_budget:
        budget.write(rows, machine)
    verdict = budget.judged(rows)
    (options.out / "bench.jsonl").write_text("".join(json.dumps(row) + "\n" for row in [{"machine": machine}, *rows]))
    (options.out / "bench.md").write_text(whole_page.markdown(machine, rows, verdict, failed))
    (options.out / "index.html").write_text(whole_page.page(machine, rows, verdict, failed))
    print(whole_page.sentence(verdict, failed))
    print(f"{options.out}/index.html, bench.md and bench.jsonl")
    if unjudged := budget.unjudged(rows):
        print(f"Without a limit, which --write-budget would add: {'; '.join(unjudged)}.")
    limits = [one for one in verdict if not one.goal]
    if options.check and (failed or unjudged or not limits or any(one.over for one in limits)):
        sys.exit(1)


if __name__ == "__main__":
    main()
