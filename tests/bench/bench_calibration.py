"""Error and run time of avcalib's fit beside the thesis's procedure, OpenCV with a good start, and mrcal.

    make bench-calibration [BENCH_FLAGS="--seeds 3 --quick"]

Writes calibration.md, calibration.jsonl and calibration.svg into --out. Errors are px over the whole picture against
the true lens, after the rotation of the camera that suits best; times are CPU seconds of one process.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from calibration_boards import BOARD, FLAT, THESIS, exact, field_error, film, photograph

from avcli.calibration import calibrate, corners, fit, opencv, quality, robust
from avcli.calibration.corners import View
from avcli.lens import KannalaBrandt, Lens

Row = dict[str, Any]
Method = Callable[[fit.Observations], tuple[fit.Solution, np.ndarray]]

SIZE = (1920, 1080)
BEYOND = KannalaBrandt(560.0, 561.0, 961.0, 542.0, 0.01, -0.004, 0.001, -0.0002)
"""A lens whose picture reaches 98 degrees at its left and right edges."""
BOW = np.array([0.001, 0.001, 0.0])


# --- photographs ------------------------------------------------------------------------------------------------------


def photographed(
    seed: int, lens: Lens, shape: np.ndarray, count: int, noise: float = 3.0, **poses: Any
) -> tuple[list[View], float]:
    """Views of boards that were photographed, and the seconds a picture took to be searched."""
    rng = np.random.default_rng(seed)
    filmed = film(count, rng, lens=lens, shape=shape, **poses)
    views, spent = [], 0.0
    for R, t in zip(filmed.rotations, filmed.translations, strict=True):
        picture = photograph(R, t, rng, lens=lens, shape=shape, noise=noise)
        begin = time.process_time()
        view = corners.find(picture, BOARD)
        spent += time.process_time() - begin
        if view is not None:
            views.append(view)
    return views, spent / count


def scrambled(views: list[View], seed: int) -> list[View]:
    """Two of the views with their corners in another order."""
    rng = np.random.default_rng(seed)
    spoiled = list(views)
    for i in rng.choice(len(views), 2, replace=False):
        order = rng.permutation(len(views[i].ids))
        spoiled[i] = replace(
            views[i], pixels=views[i].pixels[order], patches=views[i].patches[order], origins=views[i].origins[order]
        )
    return spoiled


def photograph_cases(seeds: int, count: int) -> Iterator[Row]:
    """Photographs through known lenses, blur 0.8 px, noise 3 grey levels: one row a case and seed."""
    for seed in range(seeds):
        cases = {
            "thesis lens": (THESIS, FLAT),
            "corners past 90°": (BEYOND, FLAT),
            "board bowed 2 mm": (THESIS, BOW),
        }
        for case, (lens, shape) in cases.items():
            views, search = photographed(seed, lens, shape, count)
            variants = {case: views}
            if case == "thesis lens":
                variants["two pictures scrambled"] = scrambled(views, seed)
            for name, used in variants.items():
                begin = time.process_time()
                found = calibrate.calibrate_views(BOARD, used)
                spent = time.process_time() - begin
                mean, largest = field_error(found.solution.lens, lens)
                seen = found.quality.theta_max_observed
                yield {
                    "case": name,
                    "seed": seed,
                    "views": len(used),
                    "kept": int(found.kept.sum()),
                    "mean_px": mean,
                    "max_px": largest,
                    "max_where_seen_px": field_error(found.solution.lens, lens, theta_max=seen)[1],
                    "expected_mean_px": float(np.nanmean(found.quality.field_sd_px)),
                    "rms_px": found.quality.rms_px,
                    "held_out_px": found.quality.held_out_rms_px,
                    "refused": bool(found.quality.refusals),
                    "bow_mm": 1000 * found.bow_m,
                    "search_s": search,
                    "fit_s": spent,
                    "theta_max_seen_deg": float(np.rad2deg(seen)),
                }


# --- methods ----------------------------------------------------------------------------------------------------------


def thesis_method(observations: fit.Observations) -> tuple[fit.Solution, np.ndarray]:
    solution, kept = opencv.thesis_procedure(observations, *SIZE)
    return solution, kept[observations.view]


def opencv_method(observations: fit.Observations) -> tuple[fit.Solution, np.ndarray]:
    f = fit.scan_focal(observations, *SIZE).lens
    found = opencv.calibrate(observations, *SIZE, start=f)
    spread, sigma = fit.covariance(observations, found)
    return replace(found, covariance=spread, sigma_px=sigma), np.ones(len(observations.view), bool)


def our_method(observations: fit.Observations) -> tuple[fit.Solution, np.ndarray]:
    return robust.fit_robustly(observations, *SIZE)


def our_shape_method(observations: fit.Observations) -> tuple[fit.Solution, np.ndarray]:
    return robust.fit_robustly(observations, *SIZE, board_shape=True)


METHODS: dict[str, Method] = {
    "thesis (OpenCV twice)": thesis_method,
    "OpenCV, our start": opencv_method,
    "avcalib": our_method,
    "avcalib + board": our_shape_method,
}


def sets(quick: bool) -> Iterator[tuple[str, Callable[[int], fit.Observations]]]:
    """Name -> what makes the corners of one seed; corners with Gaussian noise of 0.15 px, unless it says otherwise."""

    def boards(
        count: int, noise: float = 0.15, shape: np.ndarray = FLAT, **poses: Any
    ) -> Callable[[int], fit.Observations]:
        def make(seed: int) -> fit.Observations:
            rng = np.random.default_rng(seed)
            return exact(film(count, rng, shape=shape, **poses), shape=shape, noise=noise, rng=rng)

        return make

    def spoiled(seed: int) -> fit.Observations:
        observations = boards(40)(seed)
        rng = np.random.default_rng(seed + 1000)
        for view in (3, 17):
            rows = np.flatnonzero(observations.view == view)
            observations.pixels[rows] = observations.pixels[rng.permutation(rows)]
        return observations

    def outliers(seed: int) -> fit.Observations:
        observations = boards(40)(seed)
        rng = np.random.default_rng(seed + 1000)
        observations.pixels[observations.starts + rng.integers(0, 35, 40)] += 5 * rng.choice([-1, 1], (40, 2))
        return observations

    yield from {f"{n} pictures": boards(n) for n in ((10, 40) if quick else (5, 10, 20, 40, 80))}.items()
    yield from {f"noise {s} px": boards(40, noise=s) for s in ((0.05,) if quick else (0.02, 0.05, 0.3))}.items()
    yield from {
        f"within {r} px of the centre": boards(40, aim=((960, 540), r)) for r in ((200,) if quick else (100, 200, 400))
    }.items()
    yield "bowed 2 mm", boards(40, shape=BOW)
    yield "bowed 5 mm", boards(40, shape=2.5 * BOW)
    yield "printed 1 % longer", boards(40, shape=np.array([0, 0, 0.01]))
    yield "two pictures scrambled", spoiled
    yield "a 5 px outlier in each", outliers


def method_rows(seeds: int, quick: bool) -> Iterator[Row]:
    """Corners with known noise through each method: one row a set, seed and method."""
    for name, make in sets(quick):
        for seed in range(seeds):
            observations = make(seed)
            for method, run in METHODS.items():
                row: Row = {"set": name, "seed": seed, "method": method}
                begin = time.process_time()
                try:
                    solution, good = run(observations)
                except (ValueError, np.linalg.LinAlgError) as error:
                    yield {**row, "failed": str(error)[:80]}
                    continue
                row["s"] = time.process_time() - begin
                some = observations.of_corners(good)
                row["kept"] = some.views
                row["rms_px"] = float(np.sqrt(np.nanmean((fit.residuals(some, solution) ** 2).sum(1))))
                row["held_out_px"] = robust.held_out(observations, solution, good).rms_px
                row["refused"] = bool(quality.assess(some, solution, *SIZE, row["held_out_px"]).refusals)
                row["mean_px"], row["max_px"] = field_error(solution.lens)
                yield row


def mrcal_row(observations: fit.Observations) -> Row | None:
    """mrcal's OPENCV8 lens on the same corners; None where mrcal is not installed."""
    if not shutil.which("mrcal-calibrate-cameras"):
        return None
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder, "corners.vnl")
        lines = ["# filename x y level"]
        for view in range(observations.views):
            rows = observations.view == view
            lines += [f"frame{view:04d}.png {x:.6f} {y:.6f} 0" for x, y in observations.pixels[rows]]
        table.write_text("\n".join(lines) + "\n")
        command = [
            "mrcal-calibrate-cameras", "--corners-cache", table, "--lensmodel", "LENSMODEL_OPENCV8", "--focal", "860",
            "--object-spacing", str(BOARD.square_m), "--object-width-n", str(BOARD.inner[0]),
            "--object-height-n", str(BOARD.inner[1]), "--imagersize", *map(str, SIZE), "--outdir", folder, "frame*.png",
        ]  # fmt: skip
        begin = time.perf_counter()
        result = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        said = next((line for line in (result.stdout + result.stderr).splitlines() if "RMS" in line), "")
        return {"wall_s": time.perf_counter() - begin, "rc": result.returncode, "said": said.strip()}


# --- tables -----------------------------------------------------------------------------------------------------------


def table(rows: list[Row], by: list[str], columns: list[tuple[str, Callable[[list[Row]], str]]]) -> str:
    """Markdown: one line for each value of `by`; a column is (title, function of the rows)."""
    names = list(dict.fromkeys(tuple(row[key] for key in by) for row in rows))
    lines = ["| " + " | ".join([*by, *(title for title, _ in columns)]) + " |"]
    lines.append("|" + "---|" * (len(by) + len(columns)))
    for name in names:
        some = [row for row in rows if tuple(row[key] for key in by) == name]
        lines.append("| " + " | ".join([*map(str, name), *(function(some) for _, function in columns)]) + " |")
    return "\n".join(lines)


def of(key: str, function: Callable[[list[float]], Any], form: str = "{:.3f}") -> Callable[[list[Row]], str]:
    def column(rows: list[Row]) -> str:
        values = [row[key] for row in rows if key in row and row[key] is not None]
        return form.format(function(values)) if values else "—"

    return column


def plot(rows: list[Row], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(11, 5))
    names = list(dict.fromkeys(row["set"] for row in rows))
    for i, method in enumerate(METHODS):
        x = np.arange(len(names)) + 0.2 * (i - 1.5)
        y = [
            np.median([row.get("mean_px", np.nan) for row in rows if row["set"] == name and row["method"] == method])
            for name in names
        ]
        axis.bar(x, np.nan_to_num(np.array(y, float), nan=0.0), 0.18, label=method)
    axis.set_yscale("log")
    axis.set_xticks(np.arange(len(names)), names, rotation=35, ha="right")
    axis.set_ylabel("mean error over the picture, px (median of seeds)")
    axis.grid(axis="y", alpha=0.3)
    axis.legend()
    figure.tight_layout()
    with matplotlib.rc_context({"svg.hashsalt": "avcalib"}):
        figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="fewer sets")
    parser.add_argument("--only", choices=["photographs", "methods"])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    parts = []
    with open(options.out / "calibration.jsonl", "w") as log:

        def collected(rows: Iterable[Row]) -> Iterator[Row]:
            for row in rows:
                log.write(json.dumps(row) + "\n")
                log.flush()
                yield row

        if options.only != "methods":
            rows = list(collected(photograph_cases(options.seeds, options.views)))
            columns = [
                ("seeds", lambda rows: str(len(rows))),
                ("mean error px, median of seeds", of("mean_px", np.median)),
                ("worst seed", of("mean_px", np.max)),
                ("largest error px, worst seed", of("max_px", np.max)),
                ("largest where corners were seen, worst seed", of("max_where_seen_px", np.max)),
                ("expected mean", of("expected_mean_px", np.median)),
                ("RMS px", of("rms_px", np.median)),
                ("held out px", of("held_out_px", np.median)),
                ("kept", lambda rows: f"{sum(r['kept'] for r in rows)}/{sum(r['views'] for r in rows)}"),
                ("search s a picture", of("search_s", np.min)),
                ("fit s", of("fit_s", np.min)),
            ]
            parts.append(f"## {options.views} photographs a seed\n\n" + table(rows, ["case"], columns))
        if options.only != "photographs":
            rows = list(collected(method_rows(options.seeds, options.quick)))
            columns = [
                ("mean error px", of("mean_px", np.median)),
                ("worst seed", of("mean_px", np.max)),
                ("RMS px", of("rms_px", np.median)),
                ("held out px", of("held_out_px", np.median)),
                ("kept", of("kept", np.median, "{:.0f}")),
                ("failed", lambda rows: str(sum("failed" in r for r in rows))),
                ("refused by us", lambda rows: str(sum(r.get("refused", False) for r in rows))),
                ("s", of("s", np.min, "{:.2f}")),
            ]
            parts.append("## Corners with known noise\n\n" + table(rows, ["set", "method"], columns))
            plot(rows, options.out / "calibration.svg")
            peer = mrcal_row(exact(film(40, np.random.default_rng(0)), noise=0.15, rng=np.random.default_rng(0)))
            parts.append(f"mrcal: {peer or 'not installed, so not compared; its command line was never run here'}")
    text = "\n\n".join(parts) + "\n"
    (options.out / "calibration.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
