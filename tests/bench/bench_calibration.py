"""Error and run time of avcalib's fit beside the thesis's procedure, OpenCV with a good start, and mrcal.

    make bench-calibration [BENCH_FLAGS="--seeds 3 --quick"]
    make bench-calibration BENCH_FLAGS="--only sets --sets FOLDER"     pictures of others, one folder a set (lens_sets)

Writes calibration.md, calibration.jsonl and calibration.svg into --out. Errors are px over the whole picture against
the true lens, after the rotation of the camera that suits best; times are CPU seconds of one process.
"""

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import lens_sets
import numpy as np
from figures import figure, hand_over

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from calibration_boards import BOARD, FLAT, THESIS, exact, field_error, film, photograph, photographs

from avcli.calibration import calibrate, corners, fit, gather, opencv, quality, robust, target
from avcli.calibration.corners import View
from avcli.calibration.recognise import Wanted
from avcli.formats import footage
from avcli.lens import KannalaBrandt, Lens

Row = dict[str, Any]
Method = Callable[[fit.Observations], tuple[fit.Solution, np.ndarray]]

SIZE = (1920, 1080)
BEYOND = KannalaBrandt(560.0, 561.0, 961.0, 542.0, 0.01, -0.004, 0.001, -0.0002)
"""A lens whose picture reaches 98 degrees at its left and right edges."""
BOW = np.array([0.001, 0.001, 0.0])
_IN_TURN = 5
"""Times that avcalib and OpenCV run in turn where their speed is compared."""


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


# --- real sets and speed ----------------------------------------------------------------------------------------------


def speed_rows(quick: bool) -> Iterator[Row]:
    """CPU seconds of one process from pictures in memory to a lens: avcalib's, and OpenCV's as its tutorial does it.

    Both look for the corners of a board whose size they know, and fit a lens. They run in turn, each several times, and
    the least time of each part counts. OpenCV also gets a start for the lens. One thread of BLAS is fair: set
    OPENBLAS_NUM_THREADS=1, or its threads count while they wait.
    """
    cases = {
        "40 photographs, 1080p": (40, 1.0),
        "8 photographs, 12 megapixels": (8, 2.4),
        "40 photographs, 12 megapixels": (40, 2.4),
    }
    for name, (count, times) in ({} if quick else cases).items():
        rng = np.random.default_rng(100)
        lens, size = _enlarged(THESIS, times), (round(SIZE[0] * times), round(SIZE[1] * times))
        filmed = film(count, rng, lens=lens, size=size)
        pictures = photographs(filmed, rng, lens=lens, size=size, blur=0.8 * times)
        both = [(_our_time(pictures), _opencv_time(pictures)) for _ in range(_IN_TURN)]
        ours, theirs = (_least(list(rows)) for rows in zip(*both, strict=True))
        ours["over"] = (ours["search_s"] + ours["fit_s"]) / (theirs["search_s"] + theirs["fit_s"])
        yield {"speed": name, "tool": "avcalib", **ours}
        yield {"speed": name, "tool": "OpenCV", **theirs}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "film.mp4")
        _write_film(path, 20 if quick else 300)
        begin = time.process_time()
        board = target.Board(BOARD.columns, BOARD.rows, BOARD.square_m)
        seen = gather.collect(footage.pictures([str(path)], 2.0, grey=True, most=150), board, thorough=False)
        searched = time.process_time()
        calibrate.calibrate_views(seen.board, seen.views)
        yield {
            "speed": "a film of five minutes, 1080p",
            "tool": "avcalib",
            "pictures": len(seen),
            "views": len(seen.views),
            "search_s": searched - begin,
            "fit_s": time.process_time() - searched,
        }


def texture_rows(seeds: int) -> Iterator[Row]:
    """CPU seconds from 24 pictures of boards in memory to a lens, and of as many of texture without a board."""
    known: dict[str, target.Board | Wanted] = {
        "size and kind known": BOARD, "kind known": Wanted(kind="checkerboard"), "nothing known": Wanted(),
    }  # fmt: skip
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        filmed = film(_TEXTURES, rng)
        poses = zip(filmed.rotations, filmed.translations, strict=True)
        pictures = {"boards": [photograph(R, t, rng) for R, t in poses]}
        pictures |= {make.__name__: [make(rng) for _ in range(_TEXTURES)] for make in (blotches, rectangles, tiles)}
        for name, wanted in known.items():
            spent = {what: min(_calibrated(shots, wanted) for _ in range(_IN_TURN)) for what, shots in pictures.items()}
            yield {"seed": seed, "known": name, **spent}


_TEXTURES = 24


def _calibrated(pictures: list[np.ndarray], wanted: target.Board | Wanted) -> float:
    begin = time.process_time()
    seen = gather.collect(pictures, wanted)
    if len(seen.views) > 3:
        calibrate.calibrate_views(seen.board, seen.views)
    return time.process_time() - begin


def blotches(rng: np.random.Generator) -> np.ndarray:
    """Blurred noise, (height, width) uint8."""
    noise = cv2.GaussianBlur(rng.standard_normal(SIZE[::-1]), (0, 0), 3.0)
    return np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def rectangles(rng: np.random.Generator) -> np.ndarray:
    """Rectangles of all greys, turned and over each other, (height, width) uint8."""
    picture = np.full(SIZE[::-1], 128, np.uint8)
    for _ in range(400):
        middle, sides = rng.uniform(0, SIZE).tolist(), rng.uniform(20, 200, 2).tolist()
        corners_px = cv2.boxPoints((middle, sides, float(rng.uniform(0, 180))))
        cv2.fillPoly(picture, [np.rint(corners_px).astype(int)], (int(rng.integers(256)),))
    return _taken(picture, rng)


def tiles(rng: np.random.Generator) -> np.ndarray:
    """A tiled floor with dark joints, turned, (height, width) uint8."""
    width, height = SIZE
    side = int(rng.integers(40, 90))
    picture = np.kron(rng.uniform(60, 220, (height // side + 1, width // side + 1)), np.ones((side, side)))
    picture[::side], picture[:, ::side] = 30, 30
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), float(rng.uniform(0, 90)), 1.3)
    return _taken(cv2.warpAffine(picture, turn, SIZE, borderMode=cv2.BORDER_REFLECT), rng)


def _taken(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)
    return cv2.GaussianBlur(noisy, (0, 0), 0.8)


def _least(rows: list[Row]) -> Row:
    """The least of each number."""
    return {key: min(row[key] for row in rows) for key in rows[0]}


def _enlarged(lens: KannalaBrandt, times: float) -> KannalaBrandt:
    """The same lens with as many times the pixels along each side."""
    core = {"fx": lens.fx * times, "fy": lens.fy * times}
    core |= {name: (getattr(lens, name) + 0.5) * times - 0.5 for name in ("cx", "cy")}
    return replace(lens, **core)


def _our_time(pictures: list[np.ndarray]) -> Row:
    begin = time.process_time()
    seen = gather.collect(pictures, BOARD)
    searched = time.process_time()
    calibrate.calibrate_views(seen.board, seen.views)
    ended = time.process_time()
    return {
        "pictures": len(pictures),
        "views": len(seen.views),
        "search_s": searched - begin,
        "fit_s": ended - searched,
    }


def _opencv_time(pictures: list[np.ndarray]) -> Row:
    """OpenCV: findChessboardCorners with its defaults, cornerSubPix in a window of 11 px, the fisheye fit."""
    begin = time.process_time()
    points, pixels, numbers = [], [], []
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    for picture in pictures:
        found, corners_px = cv2.findChessboardCorners(picture, BOARD.inner)
        if found:
            exactly = cv2.cornerSubPix(picture, np.asarray(corners_px), (11, 11), (-1, -1), criteria)
            points.append(BOARD.points)
            pixels.append(exactly.reshape(-1, 2).astype(float))
            numbers.append(np.full(len(BOARD.points), len(points) - 1))
    searched = time.process_time()
    n = len(points) * len(BOARD.points)
    observations = fit.Observations(
        np.concatenate(numbers), np.concatenate(points), np.concatenate(pixels), np.ones(n), BOARD.half_extent
    )
    height, width = pictures[0].shape
    begin_fit = time.process_time()
    with contextlib.suppress(fit.NoFit):
        opencv.calibrate(observations, width, height, start=_enlarged(THESIS, width / SIZE[0]))
    return {
        "pictures": len(pictures),
        "views": len(points),
        "search_s": searched - begin,
        "fit_s": time.process_time() - begin_fit,
    }


def _write_film(path: Path, seconds: int, rate: int = 30) -> None:
    """Write a film of a board that moves: a photograph every two seconds, which drifts in between."""
    rng = np.random.default_rng(101)
    filmed = film(seconds // 2, rng)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), float(rate), SIZE)
    for R, t in zip(filmed.rotations, filmed.translations, strict=True):
        still = photograph(R, t, rng)
        for frame in range(2 * rate):
            moved = cv2.warpAffine(still, np.array([[1.0, 0, frame / 10], [0, 1, frame / 20]]), SIZE)
            writer.write(cv2.cvtColor(moved, cv2.COLOR_GRAY2BGR))
    writer.release()


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


def sets_table(rows: list[Row]) -> str:
    """Markdown: one line for each set and tool."""
    columns = [
        ("views kept of readable", lambda rows: f"{rows[0].get('kept', '—')}/{rows[0].get('readable', '—')}"),
        ("held out px, all corners", of("held_out_px", np.mean)),
        ("best 95 %", of("held_out_95_px", np.mean)),
        ("actual over stated", of("honesty", np.mean, "{:.2f}")),
        ("corners, CPU s", of("search_s", np.mean, "{:.1f}")),
        ("fit, CPU s", of("fit_s", np.mean, "{:.2f}")),
        ("verdict", lambda rows: str(rows[0].get("failed", rows[0].get("verdict", "")))),
    ]
    return table(rows, ["set", "tool"], columns)


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
    parser.add_argument("--only", choices=["photographs", "methods", "speed", "texture", "sets"])
    parser.add_argument(
        "--sets", type=Path, action="append", default=[], help="a folder of sets of pictures (lens_sets)"
    )
    parser.add_argument(
        "--splits", type=int, default=50, help="random halves that tell whether a tool's error is honest"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    parts, handed = [], list[Row]()
    with open(options.out / "calibration.jsonl", "w") as log:

        def collected(rows: Iterable[Row]) -> Iterator[Row]:
            for row in rows:
                log.write(json.dumps(row) + "\n")
                log.flush()
                yield row

        if options.only in (None, "photographs"):
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
        if options.only in (None, "methods"):
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
            for row in (row for row in rows if row["seed"] == 0 and "s" in row):
                tool = row["method"].replace("avcalib", "avcli")
                handed.append(figure("calibration", row["set"], tool, row["s"], "fit", row["mean_px"], "px"))
        if options.only in (None, "speed"):
            rows = list(collected(speed_rows(options.quick)))
            columns = [
                ("pictures", of("pictures", np.max, "{:.0f}")),
                ("views", of("views", np.max, "{:.0f}")),
                ("corners, CPU s", of("search_s", np.min, "{:.2f}")),
                ("fit, CPU s", of("fit_s", np.min, "{:.2f}")),
                ("all, over OpenCV's", of("over", np.min, "{:.2f}")),
            ]
            parts.append("## Speed\n\n" + table(rows, ["speed", "tool"], columns))
        if options.only in (None, "texture"):
            rows = list(collected(texture_rows(min(options.seeds, 3))))
            kinds = [name for name in rows[0] if name not in ("seed", "known")]
            columns = [(f"{name}, CPU s", of(name, np.median, "{:.3f}")) for name in kinds]
            parts.append("## Pictures without a board\n\n" + table(rows, ["known"], columns))
        if options.only in (None, "sets"):
            for folder in options.sets:
                sets_in = sorted(path for path in folder.iterdir() if path.is_dir())
                rows = list(collected(row for path in sets_in for row in lens_sets.set_rows(path, options.splits)))
                parts.append(f"## Pictures of others: {folder.name}\n\n{lens_sets.TEXT}\n\n" + sets_table(rows))
    text = "\n\n".join(parts) + "\n"
    (options.out / "calibration.md").write_text(text)
    hand_over(options.out, "calibration", handed)
    print(text)


if __name__ == "__main__":
    main()
