"""How many pictures people need who follow the hints of avcalib live, and people who do not.

    make bench-guidance [BENCH_FLAGS="--seeds 3"]

Writes guidance.md into --out. People are simulated: they bring the board to the outline that they are shown,
and miss its place by 3 % of the distance, its distance by 8 % and its tilt by 6 degrees (standard deviations); or they
hold it anywhere in the picture; or, as most do, near the middle. Corners have noise of 0.08 px, and the board bends by
0.3 mm, anew in each picture, so that the corners of a picture share a part of their errors.
"""

import argparse
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from calibration_boards import BOARD, THESIS, field_error, film

from avcli import pose
from avcli.calibration import field, fit, live
from avcli.calibration.corners import PATCH, View
from avcli.lens import KannalaBrandt, Lens

Pose = tuple[np.ndarray, np.ndarray]
Person = Callable[[live.Guide, np.random.Generator], Pose]

SIZE = (1920, 1080)
MOST = 40
"""Pictures after which a person gives up."""
LENSES = {
    "thesis, 85° at the corners": THESIS,
    "ordinary wide, 40° at the corners": KannalaBrandt(1560.0, 1562.0, 949.0, 551.0, -0.02, 0.004, 0.0, 0.0),
    "fisheye, 98° at the sides": KannalaBrandt(560.0, 561.0, 961.0, 542.0, 0.01, -0.004, 0.001, -0.0002),
}
_GRID = np.array([[x, y] for y in (-1, 0, 1) for x in (-1, 0, 1)], float)


def is_visible(lens: Lens, R: np.ndarray, t: np.ndarray) -> bool:
    """Whether the whole board is in the picture."""
    seen = lens.project(np.column_stack([_GRID * BOARD.printed_m / 2, np.zeros(9)]) @ R.T + t)
    return bool(np.isfinite(seen).all() and (seen > 4).all() and (seen < np.array(SIZE) - 5).all())


def following(lens: Lens) -> Person:
    """Make a person who brings the board to the outline on the picture, whatever lens the hint believes in."""

    def hold(guide: live.Guide, rng: np.random.Generator) -> Pose:
        if guide.proposal is None:
            return anywhere(lens)(guide, rng)
        places = _GRID * BOARD.half_extent
        shown = fit.Observations(np.zeros(9, int), places, guide.proposal.seen(places), np.ones(9), BOARD.half_extent)
        R, t = (one[0] for one in fit.poses_from_rays(lens, shown))
        far = float(np.linalg.norm(t))
        for attempt in range(200):
            missed = pose.rotation_from_vector(rng.normal(0, np.deg2rad(6), (1, 3)))[0] @ R
            there = t * np.exp(rng.normal(0, 0.08)) + rng.normal(0, 0.03 * far, 3)
            there += np.array([0, 0, 0.01 * attempt * far])  # who sees it cut off steps back
            if is_visible(lens, missed, there):
                return missed, there
        return anywhere(lens)(guide, rng)

    return hold


def anywhere(lens: Lens) -> Person:
    """Make a person who holds the board anywhere in the picture, at any distance, tilted by up to 40 degrees."""

    def hold(_guide: live.Guide, rng: np.random.Generator) -> Pose:
        near = 0.35 * lens.fx / 862  # as large in the picture whatever the focal length
        filmed = film(1, rng, lens=lens, distance=(near, 3.4 * near))
        return filmed.rotations[0], filmed.translations[0]

    return hold


def in_the_middle(lens: Lens) -> Person:
    """Make a person who holds the board within a quarter of the picture's height around its middle."""

    def hold(_guide: live.Guide, rng: np.random.Generator) -> Pose:
        near = 0.35 * lens.fx / 862
        aim = ((SIZE[0] / 2, SIZE[1] / 2), SIZE[1] / 4)
        filmed = film(1, rng, lens=lens, distance=(near, 3.4 * near), aim=aim)
        return filmed.rotations[0], filmed.translations[0]

    return hold


PEOPLE: dict[str, Callable[[Lens], Person]] = {
    "follow the hints": following,
    "anywhere": anywhere,
    "near the middle": in_the_middle,
}


def seen_by(lens: Lens, pose: Pose, rng: np.random.Generator) -> View:
    """The corners that are found in a picture of the board."""
    bend = np.append(rng.normal(0, 0.0003, 2), 0.0)
    R, t = pose
    pixels = lens.project(fit.surface(BOARD.points, bend, BOARD.half_extent) @ R.T + t)
    pixels = pixels + 0.08 * rng.standard_normal(pixels.shape)
    n = len(pixels)
    blank = np.zeros((n, 2 * PATCH + 1, 2 * PATCH + 1), np.uint8)
    return View(np.arange(n), pixels, blank, np.rint(pixels).astype(int), *SIZE)


class Filmed(NamedTuple):
    """How one person fared who filmed MOST pictures, also after the guide said that it was enough.

    Attributes:
        errors: (MOST,) px, mean true error over the picture after each picture; infinite before there is a fit.
        stopped: pictures at which it was enough; MOST + 1 where it never was.
        said: px, the expected error that the guide stated there; NaN where it never was.
        true: px, the mean error of that lens over the same pixels, the turn taken out where corners were seen.
        seconds: CPU time of the guide a picture.
    """

    errors: np.ndarray
    stopped: int
    said: float
    true: float
    seconds: float


def filmed_by(person: Person, lens: Lens, seed: int) -> Filmed:
    """Film MOST pictures."""
    rng = np.random.default_rng([seed, 7])
    guide = live.Guide()
    views: list[View] = []
    guide.take(BOARD, views, None, *SIZE)
    errors, stopped, said, true, spent = np.full(MOST, np.inf), MOST + 1, np.nan, np.nan, 0.0
    for number in range(MOST):
        views.append(seen_by(lens, person(guide, rng), rng))
        begin = time.process_time()
        guide.take(BOARD, views, views[-1], *SIZE)
        spent += time.process_time() - begin
        if guide.quality is not None and guide.solution is not None:
            errors[number] = field_error(guide.solution.lens, lens)[0]
        if guide.state.enough and stopped > MOST:
            stopped, said, true = number + 1, guide.mean_px, true_error(guide, views, lens)
    return Filmed(errors, stopped, said, true, spent / max(len(views), 1))


def true_error(guide: live.Guide, views: list[View], lens: Lens) -> float:
    """Mean distance of the guide's lens from the true one where the guide states its error, px."""
    assert guide.quality is not None
    assert guide.solution is not None
    corners = np.concatenate([view.pixels for view in views])
    pixels = guide.quality.field.pixels[guide.quality.field.lit]
    rays = guide.solution.lens.unproject(pixels)
    seen = np.isfinite(rays).all(1)
    turned = field.turned_to(guide.solution.lens, lens, corners, rays[seen])
    return float(np.nanmean(np.linalg.norm(lens.project(turned) - pixels[seen], axis=1)))


def reached(errors: np.ndarray, limit: float) -> int:
    """Pictures after which the error stays below a limit, as far as the person filmed; MOST + 1: never."""
    last = np.flatnonzero(np.isfinite(errors) | (errors < limit))
    above = np.flatnonzero(~(errors[: last[-1] + 1] <= limit)) if len(last) else np.array([MOST])
    found = int(above[-1]) + 2 if len(above) else 1
    return found if len(last) and found <= last[-1] + 1 else MOST + 1


def row(name: str, person: str, runs: list[Filmed], limit: float) -> str:
    """One line of the table."""

    def count(values: list[int]) -> str:
        middle, worst = float(np.median(values)), max(values)
        shown = [f"> {MOST}" if value > MOST else f"{value:g}" for value in (middle, worst)]
        return " / ".join(shown)

    reach = [reached(run.errors, limit) for run in runs]
    ended = [run for run in runs if run.stopped <= MOST]
    shown = ["-"] * 3
    if ended:
        true, said = np.array([(run.true, run.said) for run in ended]).T
        ratio = np.sqrt(np.mean((true / said) ** 2))
        shown = [f"{np.median(true):.2f} / {true.max():.2f}", f"{np.median(said):.2f}", f"{ratio:.2f} of {len(ended)}"]
    stops = count([run.stopped for run in runs])
    cpu = np.mean([run.seconds for run in runs])
    return f"| {' | '.join([name, person, count(reach), stops, *shown, f'{cpu:.2f}'])} |"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=200, help="the first seed")
    parser.add_argument("--only", default="", metavar="TEXT", help="lenses whose name contains this")
    given = parser.parse_args()
    text = f"""Written by `make bench-guidance`: {given.seeds} simulated people of each kind, seeds {given.first} and
        up, {SIZE[0]} × {SIZE[1]} px, a board of {BOARD} squares, {MOST} pictures. They miss the place that they are
        shown by 3 % of the distance, the distance by 8 %, the tilt by 6°. Corners have noise of 0.08 px, the board
        bends by 0.3 mm (standard deviation), anew in each picture. Errors are the mean over the picture, after a
        rotation; 0.3 px is wanted, or 0.02° on the axis where that is more. Median / worst person. True over said:
        root mean square over the people who were told that it is enough; 1 is honest, more is boastful."""
    head = (
        "lens",
        "people hold the board",
        "pictures to the true error that is wanted",
        "pictures until it says enough",
        "true error then, px",
        "it says, px",
        "true over said",
        "CPU s a picture",
    )
    lines = ["# avcalib live: pictures until the lens is known", "", textwrap.fill(" ".join(text.split()), 120), ""]
    lines += [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name, lens in LENSES.items():
        if given.only not in name:
            continue
        limit = live.wanted_px(lens, SIZE[0])
        for person, make in PEOPLE.items():
            runs = [filmed_by(make(lens), lens, given.first + seed) for seed in range(given.seeds)]
            lines.append(row(name, person, runs, limit))
            print(lines[-1], flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "guidance.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
