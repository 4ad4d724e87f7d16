"""Pictures of boards that others took, through avcalib, OpenCV and mrcal: one row a set and tool.

A set is a folder of pictures. A file set.json in it may say what they show, for example {"board": "7x10",
"kind": "checkerboard"}; where it does not, avcalib recognises the board. All tools get the same corners (those
that avcalib refined) of all views in which the board was found, and are measured in the same way (`lens_measures`).
"""

import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import lens_measures
import numpy as np

from avcli import pose
from avcli.calibration import calibrate, corners, fit, gather, opencv, robust, target, uncertainty
from avcli.calibration.calibrate import Calibration
from avcli.calibration.pupil import from_pupil, project_jacobian
from avcli.calibration.recognise import Wanted
from avcli.formats import footage

Row = dict[str, Any]

MRCAL_PYTHON = "/usr/bin/python3"
MRCAL_MODELS = {
    "mrcal OPENCV8": "LENSMODEL_OPENCV8",
    "mrcal splined": "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=16_Ny=12_fov_x_deg={fov:.0f}",
}
MRCAL_SPLITS = 12
"""Splits of the views at most that mrcal is fitted to; each costs it seconds."""
FIELD_PX = 40
"""Distance of the pixels at which two lenses are compared."""


TEXT = (
    "All tools get the same corners of all readable views. Held out: five folds by view, the pose of a held-out view "
    "fitted robustly, in the same way for every tool; all of its corners count, whatever is wrong with them. Actual "
    "over stated: root mean square over random splits of how far the lenses of two disjoint halves lie apart, over "
    "what both state, where corners were seen, the turn of the camera taken out, the 5 % of pixels that a tool states "
    "worst left out; 1 is honest, more is boastful. OpenCV states none."
)


@dataclass(frozen=True)
class Case:
    """A set with avcalib's calibration of it.

    Attributes:
        name: of its folder.
        found: avcalib's calibration from all views.
        everything: the refined corners of all views in which the board was found.
        corners: the same as the measures want them.
        field: (n, 2) px, pixels within the angle to which corners were seen.
        search_s, fit_s: CPU seconds of avcalib's search for corners and of its fit.
        pictures: how many there are.
    """

    name: str
    found: Calibration
    everything: fit.Observations
    corners: lens_measures.Corners
    field: np.ndarray
    search_s: float
    fit_s: float
    pictures: int


def calibrated(folder: Path) -> tuple[gather.Seen, Calibration, float, float]:
    """Look for the board in a set and calibrate it as `avcalib calibrate` does; and the CPU seconds of either."""
    about = json.loads((folder / "set.json").read_text()) if (folder / "set.json").exists() else {}
    wanted = Wanted(target.parse_size(about["board"]) if "board" in about else None, about.get("kind"))
    begin = time.process_time()
    seen = gather.collect(footage.pictures([str(folder)]), wanted)
    searched = time.process_time()
    seen.require_views()
    found = calibrate.calibrate_views(seen.board, seen.views, circle=seen.light.circle)
    return seen, found, searched - begin, time.process_time() - searched


def read_case(folder: Path) -> Case:
    """Calibrate a set, and pose all of its views."""
    seen, found, search_s, fit_s = calibrated(folder)
    everything = calibrate.observe(found.board, seen.views)
    poses = fit.start_from_rays(everything, found.lens, found.solution.beside)
    poses = fit.refine_poses(everything, poses, 20, found.solution.delta_px)
    good = robust.belonging(everything, poses)[0]
    everything = robust.polished(everything, poses, found.board, seen.views, good)
    poses = fit.refine_poses(everything, poses, 20, found.solution.delta_px)
    ids = np.concatenate([view.ids for view in seen.views])
    u, v = (np.arange(FIELD_PX / 2, side, FIELD_PX) for side in (found.width, found.height))
    grid = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    rays = found.lens.unproject(grid)
    angles = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return Case(
        name=folder.name,
        found=found,
        everything=everything,
        corners=lens_measures.Corners(everything.view, ids, everything.pixels, poses.rotations, poses.translations),
        field=grid[angles <= found.quality.theta_max_observed],
        search_s=search_s,
        fit_s=fit_s,
        pictures=len(seen),
    )


# --- tools ------------------------------------------------------------------------------------------------------------


class Moving:
    """avcalib's lens with its centre, which may move (fit.Solution.pupil), as the measures want a lens."""

    def __init__(self, solution: fit.Solution) -> None:
        self.lens, self.pupil = solution.lens, solution.pupil

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points (n, 3) m."""
        return self.lens.project(from_pupil(points, self.pupil)[0])

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Directions (n, 3) of pixels (n, 2)."""
        return self.lens.unproject(pixels)

    def project_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pixels and their derivatives to the points."""
        return project_jacobian(self.lens, points, self.pupil)[:2]


class PlumbBob:
    """cv2's model of ordinary lenses, with up to eight coefficients, as the measures want a lens."""

    def __init__(self, K: np.ndarray, D: np.ndarray) -> None:
        self.K, self.D = K, D

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of rays (n, 3); NaN behind the camera."""
        return self.project_jacobian(points)[0]

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Rays (n, 3) of pixels (n, 2)."""
        flat = cv2.undistortPoints(np.ascontiguousarray(pixels, float)[:, None], self.K, self.D).reshape(-1, 2)
        rays = np.column_stack([flat, np.ones(len(flat))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def project_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pixels and their derivatives to the points."""
        zero = np.zeros(3)
        ahead = points[:, 2] > 0
        safe = np.where(ahead[:, None], points, [0.0, 0.0, 1.0])
        pixels, J = cv2.projectPoints(np.ascontiguousarray(safe), zero, zero, self.K, self.D)
        hidden = ~ahead[:, None]
        return (
            np.where(hidden, np.nan, pixels.reshape(-1, 2)),
            np.where(hidden[..., None], np.nan, J[:, 3:6].reshape(-1, 2, 3)),
        )


def _flat_views(case: Case, views: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    points, pixels = [], []
    for view in views:
        rows = case.everything.view == view
        points.append(np.column_stack([case.everything.points[rows], np.zeros(rows.sum())]).astype(np.float32))
        pixels.append(case.everything.pixels[rows].astype(np.float32))
    return points, pixels


def _board(case: Case, learned: Calibration | None = None) -> np.ndarray:
    """Corners (ids, 3) m of the board: flat, or as a calibration found it, with its bow and its own errors."""
    board = case.found.board
    if learned is None:
        return fit.surface(board.points, np.zeros(fit.SHAPE), board.half_extent)
    places = fit.surface(board.points, learned.solution.shape, board.half_extent)
    o = learned.observations
    which = np.abs(o.points[:, None] - board.points[None]).sum(-1).argmin(1)
    errors = np.zeros_like(places)
    errors[which] = o.errors
    return places + errors


def ours(case: Case, views: np.ndarray) -> tuple[lens_measures.AnyLens, np.ndarray]:
    """All of avcalib's procedure on some views, from their raw corners."""
    found = calibrate.calibrate_views(case.found.board, [case.found.views[i] for i in views])
    return Moving(found.solution), _board(case, found)


def opencv_search(folder: Path, board: target.Board) -> Row:
    """Corners as OpenCV's tutorial finds them (findChessboardCorners, cornerSubPix, window of 11 px); CPU seconds."""
    if board.kind != "checkerboard":
        return {}
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    spent, found = 0.0, 0
    for picture in footage.pictures([str(folder)]):
        grey = corners.to_grey(picture.image)
        begin = time.process_time()
        good, pixels = cv2.findChessboardCorners(grey, board.inner)
        if good:
            cv2.cornerSubPix(grey, np.asarray(pixels), (11, 11), (-1, -1), criteria)
        spent, found = spent + time.process_time() - begin, found + bool(good)
    return {"search_s": spent, "found": found}


def opencv_fisheye(case: Case, views: np.ndarray) -> tuple[lens_measures.AnyLens, np.ndarray]:
    """cv2.fisheye.calibrate, with a start that works (its own start is asserted away on most wide lenses)."""
    some = case.everything.of_views(views)
    start = fit.scan_focal(some, case.found.width, case.found.height).lens
    return opencv.calibrate(some, case.found.width, case.found.height, start=start).lens, _board(case)


def opencv_rational(case: Case, views: np.ndarray) -> tuple[lens_measures.AnyLens, np.ndarray]:
    """cv2.calibrateCamera with its rational model."""
    points, pixels = _flat_views(case, views)
    size = (case.found.width, case.found.height)
    K: np.ndarray = np.eye(3)
    D: np.ndarray = np.zeros(8)
    _, K, D, _, _ = cv2.calibrateCamera(points, pixels, size, K, D, flags=cv2.CALIB_RATIONAL_MODEL)
    return PlumbBob(K, D.ravel()[:8]), _board(case)


Tool = Callable[[Case, np.ndarray], tuple[lens_measures.AnyLens, np.ndarray]]
TOOLS: dict[str, Tool] = {
    "avcalib": ours,
    "OpenCV fisheye": opencv_fisheye,
    "OpenCV rational": opencv_rational,
}


# --- rows -------------------------------------------------------------------------------------------------------------


def set_rows(folder: Path, splits: int) -> Iterator[Row]:
    """Measure every tool on one set; one row each."""
    base: Row = {"set": folder.name}
    try:
        case = read_case(folder)
    except (fit.NoFit, ValueError) as error:
        yield {**base, "tool": "avcalib", "failed": str(error).replace(f"{folder.parent}/", "")[:160]}
        return
    base |= {"pictures": case.pictures, "readable": case.corners.views}
    for tool, run in TOOLS.items():
        row = {**base, "tool": tool}
        try:
            row |= _tool_row(case, tool, run)
        except (ValueError, cv2.error, np.linalg.LinAlgError) as error:
            row["failed"] = str(error).replace("\n", " ")[:160]
        if tool == "avcalib":
            row |= _our_row(case, splits)
        elif tool == "OpenCV fisheye":
            row |= opencv_search(folder, case.found.board)
        yield row
    yield from mrcal_rows(case, base, splits)


def _tool_row(case: Case, tool: str, run: Tool) -> Row:
    every = np.arange(case.corners.views)
    begin = time.process_time()
    if tool != "avcalib":
        run(case, every)
    spent = time.process_time() - begin
    errors = []
    for fold in range(min(5, len(every))):
        lens, board = run(case, every[every % 5 != fold])
        errors.append(lens_measures.held_out_errors(lens, board, case.corners, every[every % 5 == fold]))
    row: Row = {"fit_s": case.fit_s if tool == "avcalib" else spent, **_error_columns(np.concatenate(errors))}
    if tool != "avcalib":
        row["kept"] = case.corners.views
    return row


def _error_columns(errors: np.ndarray) -> Row:
    best = np.sort(errors)[: max(1, int(0.95 * len(errors)))]
    return {
        "held_out_px": float(np.sqrt(np.mean(errors**2))),
        "held_out_95_px": float(np.sqrt(np.mean(best**2))),
        "median_px": float(np.median(errors)),
    }


def _our_row(case: Case, splits: int) -> Row:
    found = case.found
    return {
        "kept": int(found.kept.sum()),
        "search_s": case.search_s,
        "fit_s": case.fit_s,
        "says_px": found.quality.held_out_rms_px,
        "dropped": int(found.dropped[found.kept].sum()),
        "verdict": "; ".join(found.quality.refusals) or "written",
        "theta_seen_deg": float(np.rad2deg(found.quality.theta_max_observed)),
        "model": found.camera_config()["lens_model"],
        "board": str(found.board),
        **_our_honesty(case, splits),
    }


def _our_honesty(case: Case, splits: int) -> Row:
    """Refit disjoint halves of the kept views; their difference over what their covariances say."""
    found = case.found
    views = int(found.kept.sum())
    if views < 8:
        return {"honesty": None}
    both = partial(uncertainty.covariance, freedom=views - 2)  # the difference is known from both halves together
    actual, said = [], []
    for pair in lens_measures.halves(views, splits):
        lenses, variance = [], np.zeros(len(case.field))
        for half in pair:
            some, start = found.observations.of_views(half), found.solution.of_views(half)
            if some.errors.any():
                some, solved = fit.refine_with_errors(some, start, 25, 1e-8)
            else:
                solved = fit.refine(some, start, start.free, start.delta_px, 25)
            solved = replace(solved, covariance=fit.covariance(some, solved, both)[0])
            lenses.append(solved.lens)
            variance += _variance(solved, case.field)
        actual.append(lens_measures.apart(lenses[0], lenses[1], case.field))
        said.append(np.sqrt(variance))
    return {"honesty": lens_measures.honesty(actual, said), "halves": len(actual)}


def _variance(solved: fit.Solution, pixels: np.ndarray) -> np.ndarray:
    """Variance (n,) px² of the projection, u and v together, the turn of the camera that suits best taken out."""
    lens = solved.lens
    rays = lens.unproject(pixels)
    _, by_point, by_lens = lens.project_jacobian(rays)
    good = np.isfinite(by_point).all((1, 2)) & np.isfinite(by_lens).all((1, 2))
    turn = (-by_point @ pose.cross_matrix(rays))[good].reshape(-1, 3)
    J = by_lens[good].reshape(-1, by_lens.shape[-1])
    Q = np.linalg.qr(turn)[0]
    J = (J - Q @ (Q.T @ J)).reshape(-1, 2, by_lens.shape[-1])
    C = solved.covariance[: J.shape[-1], : J.shape[-1]]
    out = np.full(len(pixels), np.nan)
    out[good] = np.einsum("nia,ab,nib->n", J, C, J)
    return out


def mrcal_rows(case: Case, base: Row, splits: int) -> Iterator[Row]:
    """mrcal on the same corners, by the Python that it is installed for; nothing without it, or for other boards."""
    board, c = case.found.board, case.corners
    if not shutil.which("mrcal-calibrate-cameras") or board.kind not in ("checkerboard", "charuco"):
        return
    columns, rows = board.inner
    grid = np.zeros((c.views, rows, columns, 3))
    grid.reshape(c.views, -1, 3)[c.view, c.ids] = np.column_stack([c.pixels, np.ones(len(c.pixels))])
    fov = min(2.2 * np.rad2deg(case.found.quality.theta_max_observed), 200.0)
    models = {tool: name.format(fov=fov) for tool, name in MRCAL_MODELS.items()}
    with tempfile.TemporaryDirectory() as folder:
        work, result = Path(folder, "work.npz"), Path(folder, "result.json")
        np.savez(
            work, grid=grid, view=c.view, ids=c.ids, pixels=c.pixels, rotations=c.rotations,
            translations=c.translations, field=case.field, focal=case.found.lens.fx, spacing=board.square_m,
size=np.array([case.found.width, case.found.height]), splits=min(splits, MRCAL_SPLITS),
            models=np.array(list(models.values())),
        )  # fmt: skip
        script = Path(__file__).with_name("mrcal_peer.py")
        done = subprocess.run([MRCAL_PYTHON, str(script), str(work), str(result)], capture_output=True, text=True)
        got = json.loads(result.read_text()) if result.exists() else {}
    for tool, name in models.items():
        row = got.get(name, {"failed": (done.stderr or "mrcal ended").strip().splitlines()[-1][:160]})
        errors = row.pop("errors", None)
        yield {**base, "tool": tool, **row, **(_error_columns(np.array(errors)) if errors else {}), "kept": c.views}
