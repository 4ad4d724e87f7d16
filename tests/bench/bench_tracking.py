"""Trackers on S1 to S4 and on hard cases: HOTA and its parts, OSPA(2), birth delay, time (`make bench-tracking`).

Every tracker has one set of parameters, its defaults, which were decided on seeds from 100 on; the seeds from 0 on are
reported. "ceiling" is the Kalman filter (IMM) that is told which detection belongs to whom. Times are processor time of
the tracker alone, the least of all seeds; another load on the machine still shows in them.
"""

import argparse
import json
import math
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from tracking_scenes import EASY, HARD, KIND, Scene, Truth

from avcli.formats.records import Detections
from avcli.metrics.metric import Case
from avcli.metrics.registry import score_case
from avcli.metrics.sequence import Sequence
from avcli.tracking import gaussian
from avcli.tracking.fusion import Fusion
from avcli.tracking.merging import Record
from avcli.tracking.model import Population
from avcli.tracking.motion import WALKING
from avcli.tracking.settings import Settings, sensor
from avcli.tracking.trackers import TRACKERS

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
COLUMNS = ("HOTA", "DetA", "AssA", "LocA", "OSPA2", "BirthDelay")
VARIANTS: dict[str, dict[str, Any]] = {
    "ms-glmb": {},
    "ms-glmb, 5 hypotheses": {"hypotheses": 5},
    "ms-glmb, 20 hypotheses": {"hypotheses": 20},
    "ms-glmb, 80 hypotheses": {"hypotheses": 80},
    "ms-glmb, lag 5": {"lag": 5},
    "ms-glmb, lag inf": {"lag": math.inf},
    **{name: {"tracker": name} for name in TRACKERS if name != "ms-glmb"},
}


def ceiling(scene: Scene) -> Tracks:
    """Tracks of the filter that knows the truth's associations."""
    states: dict[int, tuple[float, np.ndarray, np.ndarray, np.ndarray]] = {}
    out, queue = [], list(scene.records)
    start = WALKING.stationary()
    m = len(start)

    def moved(
        state: tuple[float, np.ndarray, np.ndarray, np.ndarray], t: float
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        last, mean, cov, mode = state
        if t - last > 1e-9:
            mean, cov, mode, *_ = gaussian.predict(mean, cov, mode, WALKING, round(t - last, 9))
        return max(t, last), mean, cov, mode

    for now, present, _ in scene.truth:
        while queue and queue[0][0] <= now + 1e-9:
            t, name, z, sigma, owners = queue.pop(0)
            noise = sigma**2 * np.eye(2)[None]
            for position, owner in zip(z, owners.tolist(), strict=True):
                if owner in states:
                    last, mean, cov, mode = moved(states[owner], t)
                    offset = sensor(name, KIND[name]).mouth_offset
                    states[owner] = (last, *gaussian.update(mean, cov, mode, position[None], noise, offset))
                elif owner >= 0:
                    mean, cov = np.zeros((1, m, 4)), np.zeros((1, m, 4, 4))
                    mean[..., :2], cov[..., :2, :2] = position, noise
                    cov[..., 2:, 2:] = Population().speed ** 2 * np.eye(2)
                    states[owner] = (t, mean, cov, start[None])
        known = [i for i in present.tolist() if i in states]
        positions = [gaussian.moments(*moved(states[i], now)[1:])[0][0, :2] for i in known]
        out.append((known, np.reshape(positions, (-1, 2))))
    return out


def detections(scene: Scene) -> list[Record]:
    """What the sensors of a scene found, as `Fusion.step` takes it."""
    records = []
    told = scene.features or [{} for _ in scene.records]
    for (t, name, z, sigma, _), features in zip(scene.records, told, strict=True):
        n, floor = len(z), sensor(name, KIND[name]).floor
        covariances = np.full((n, 3, 3), np.nan)
        covariances[:, :2, :2] = max(sigma**2 - floor**2, 1e-6) * np.eye(2)
        positions = np.column_stack([z, np.full(n, np.nan)])
        found = Detections(t, name, positions, covariances, np.full(n, np.nan), KIND[name], features=features)
        records.append((t, name, found))
    return records


def track(
    scene: Scene, tracker: str = "ms-glmb", lag: float = 0, hypotheses: int = Settings.hypotheses
) -> tuple[Tracks, float]:
    """Tracks of a scene, and milliseconds a frame."""
    fusion = Fusion(Settings(hypotheses=hypotheses), tracker, lag, population=Population())
    queue, steps = detections(scene), []
    for now, *_ in scene.truth:
        due = [record for record in queue if record[0] <= now + 1e-9]
        del queue[: len(due)]
        steps.append((now, due))
    begin = time.process_time()
    out = [one for now, due in steps for one in fusion.step(now, due)] + fusion.finish()
    spent = time.process_time() - begin
    return [(one.ids.tolist(), one.positions[:, :2]) for one in out], 1e3 * spent / len(steps)


def measure(truth: Truth, tracks: Tracks) -> list[float]:
    """The columns of the table: percent, OSPA(2) in m, the birth delay in frames."""
    sequence = Sequence.of([(ids.tolist(), xy) for _, ids, xy in truth], tracks)
    summary = score_case(Case(sequence))["summary"]
    values = [math.nan if summary[c] is None else summary[c] for c in COLUMNS]
    return [v * (1 if c in ("OSPA2", "BirthDelay") else 100) for c, v in zip(COLUMNS, values, strict=True)]


def scene_of(case: str, seed: int) -> Scene:
    return {**EASY, **HARD}[case](np.random.default_rng(seed))


Variant = tuple[str, tuple[str, ...]]  # a tracker, and the sensors that it gets: (): all
Task = tuple[str, int, list[Variant]]  # case, seed, what is run


def job(task: Task) -> dict[Variant, list[float]]:
    """What one scene gives each tracker: {(tracker, sensors): its columns and milliseconds a frame}."""
    case, seed, rows = task
    whole, out = scene_of(case, seed), {}
    for name, sensors in rows:
        scene = whole.only(*sensors) if sensors else whole
        tracks, spent = (ceiling(scene), math.nan) if name == "ceiling" else track(scene, **VARIANTS[name])
        out[name, sensors] = [*measure(scene.truth, tracks), spent]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="directory of the figures")
    parser.add_argument("--seeds", type=int, default=3, help="scenes of each case")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--no-more", action="store_true", help="no more seeds than these of any case")
    parser.add_argument("--cases", nargs="*", default=[*EASY, *HARD], choices=[*EASY, *HARD])
    parser.add_argument("--trackers", nargs="*", default=None, choices=list(VARIANTS))
    parser.add_argument("--jobs", type=int, default=1, help="processes; more than one blurs the times")
    options = parser.parse_args()
    names = options.trackers
    if names is None:
        import importlib.util

        names = [n for n in VARIANTS if n != "jpda" or importlib.util.find_spec("stonesoup")]
    seeds = range(options.first, options.first + options.seeds)
    all_rows: dict[str, list[Variant]] = {}
    tasks: list[Task] = []
    for case in options.cases:
        main_rows: list[Variant] = [(name, ()) for name in ("ms-glmb", "ceiling") if name in (*names, "ceiling")]
        if case in EASY and "ms-glmb" in names:
            main_rows += [("ms-glmb", (eye,)) for eye in ("audio", "video")]
        others: list[Variant] = [
            (name, ()) for name in names if name != "ms-glmb" and case not in TOO_MUCH.get(name, ())
        ]
        all_rows[case] = main_rows[:1] + others + main_rows[1:]
        count = max(options.seeds, MORE[case]) if "ms-glmb" in names and not options.no_more else options.seeds
        tasks += [(case, options.first + k, all_rows[case] if k < len(seeds) else main_rows) for k in range(count)]
    with ProcessPoolExecutor(options.jobs) as pool:
        results = list(pool.map(job, tasks))
    table: list[Row] = []
    for case, rows in all_rows.items():
        found = [result for task, result in zip(tasks, results, strict=True) if task[0] == case]
        for row in dict.fromkeys(rows):
            every = np.array([result[row] for result in found if row in result])
            block = every[: len(seeds)]
            table.append(
                {
                    "case": case,
                    "tracker": row[0] + (f" ({row[1][0]} only)" if row[1] else ""),
                    **dict(zip(COLUMNS, block[:, :-1].mean(0).tolist(), strict=True)),
                    "HOTA_min": float(block[:, 0].min()),
                    "HOTA_all": every[:, 0].tolist(),
                    "ms": float(every[:, -1].min()),
                }
            )
    show(table)
    gains = against_best_sensor(table)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "tracking.json").write_text(json.dumps({"seeds": [*seeds], "rows": table, "gains": gains}))
    (options.out / "tracking.md").write_text(markdown(table, seeds, gains))
    plot(table, options.out / "tracking.svg")


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
