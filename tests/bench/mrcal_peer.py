"""mrcal on the corners that the calibration benchmark gives it; run by the Python that mrcal is installed for.

    /usr/bin/python3 tests/bench/mrcal_peer.py WORK.npz RESULT.json

WORK.npz has the corners as a grid, the size, and the command line's lens models; see bench_lenses.mrcal_rows.
The whole fit is mrcal-calibrate-cameras; folds and halves start from it and are optimised through mrcal's library.
"""

import copy
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import mrcal
import numpy as np
from lens_measures import Corners, apart, halves, held_out_errors, honesty


class MrcalLens:
    """A lens of mrcal as the measures want one."""

    def __init__(self, model: Any) -> None:
        self.name, self.values = model.intrinsics()

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of rays (n, 3)."""
        return mrcal.project(points, self.name, self.values)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Rays (n, 3) of pixels (n, 2)."""
        return mrcal.unproject(np.ascontiguousarray(pixels), self.name, self.values, normalize=True)

    def project_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Pixels and their derivatives to the points."""
        return mrcal.project(np.ascontiguousarray(points), self.name, self.values, get_gradients=True)[:2]


def whole_fit(work: Any, name: str, folder: Path) -> tuple[Any, float]:
    """Run mrcal-calibrate-cameras on all corners; return the model and its CPU seconds."""
    lines = ["# filename x y level"]
    for v, grid in enumerate(work["grid"]):
        flat = grid.reshape(-1, 3)
        lines += [f"frame{v:04d}.png {x:.6f} {y:.6f} {'0' if w > 0 else '-'}" for x, y, w in flat]
    Path(folder, "corners.vnl").write_text("\n".join(lines) + "\n")
    height_n, width_n = work["grid"].shape[1:3]
    command = [
        "mrcal-calibrate-cameras", "--corners-cache", "corners.vnl", "--lensmodel", name, "--focal",
        str(float(work["focal"])), "--object-spacing", str(float(work["spacing"])), "--object-width-n", str(width_n),
        "--object-height-n", str(height_n),
        "--imagersize", *(str(int(side)) for side in work["size"]), "--outdir", ".", "frame*.png",
    ]  # fmt: skip
    before = os.times()
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    after = os.times()
    if done.returncode:
        raise RuntimeError((done.stderr or done.stdout).strip().splitlines()[-1][:120])
    spent = after.children_user - before.children_user + after.children_system - before.children_system
    return mrcal.cameramodel(str(folder / "camera-0.cameramodel")), spent


def refitted(inputs: dict[str, Any], views: np.ndarray) -> Any:
    """Optimise some views again from where the whole fit stands: intrinsics, poses and the board's warp."""
    some = copy.deepcopy(inputs)
    some["frames_rt_toref"] = np.ascontiguousarray(inputs["frames_rt_toref"][views])
    some["observations_board"] = np.ascontiguousarray(inputs["observations_board"][views])
    # What another set of views rejected is given back: the outliers of these are looked for again.
    some["observations_board"][..., 2] = np.abs(some["observations_board"][..., 2])
    some["observations_board"][..., 2][inputs["missing"][views]] = -1.0
    some["indices_frame_camintrinsics_camextrinsics"] = np.array([[i, 0, -1] for i in range(len(views))], np.int32)
    del some["missing"]
    mrcal.optimize(**some)
    return mrcal.cameramodel(optimization_inputs=some, icam_intrinsics=0)


def board_of(model: Any, shape: tuple[int, int]) -> np.ndarray:
    """Corners (ids, 3) in the board's frame, in squares from its middle, warped as mrcal found it."""
    inputs = model.optimization_inputs()
    spacing = inputs["calibration_object_spacing"]
    warped = mrcal.ref_calibration_object(shape[1], shape[0], spacing, calobject_warp=inputs["calobject_warp"])
    return warped.reshape(-1, 3) - np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2, 0]) * spacing


def stated(model: Any, pixels: np.ndarray) -> np.ndarray:
    """Variance (n,) px² of the projection at infinity that mrcal states, u and v together."""
    rays = mrcal.unproject(pixels, *model.intrinsics())
    spread = mrcal.projection_uncertainty(rays, model, atinfinity=True, what="covariance")
    return spread[:, 0, 0] + spread[:, 1, 1]


def measure(work: Any, name: str, folder: Path) -> dict[str, Any]:
    """One row of the table: mrcal with one lens model on the corners of one set."""
    model, cpu = whole_fit(work, name, folder)
    inputs = model.optimization_inputs()
    shape = work["grid"].shape[1:3]
    inputs["missing"] = work["grid"][..., 2] <= 0
    corners = Corners(work["view"], work["ids"], work["pixels"], work["rotations"], work["translations"])
    weights = inputs["observations_board"][..., 2]
    row: dict[str, Any] = {"fit_s": cpu, "rejected": int((weights <= 0).sum() - inputs["missing"].sum())}
    every = np.arange(corners.views)
    errors = []
    for fold in range(min(5, corners.views)):
        learned = refitted(inputs, every[every % 5 != fold])
        errors.append(held_out_errors(MrcalLens(learned), board_of(learned, shape), corners, every[every % 5 == fold]))
    row["errors"] = np.concatenate(errors).tolist()
    actual, said = [], []
    for one, other in halves(corners.views, int(work["splits"])) if corners.views >= 8 else []:
        try:
            a, b = refitted(inputs, one), refitted(inputs, other)
            actual.append(apart(MrcalLens(a), MrcalLens(b), work["field"]))
            said.append(np.sqrt(stated(a, work["field"]) + stated(b, work["field"])))
        except Exception as error:
            row["note"] = str(error)[:80]
    row["honesty"] = honesty(actual, said) if actual else None
    row["halves"] = len(actual)
    return row


def main() -> None:
    work = dict(np.load(sys.argv[1]))
    rows = {}
    for name in work["models"].tolist():
        with tempfile.TemporaryDirectory() as folder:
            try:
                rows[name] = measure(work, name, Path(folder))
            except Exception as error:
                rows[name] = {"failed": str(error)[:160]}
    Path(sys.argv[2]).write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
