"""The report on a calibration: in words, and in a picture."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from avcli.calibration import field, fit, quality, sharpness, shutter, undistort
from avcli.calibration.calibrate import Calibration
from avcli.calibration.gather import Seen
from avcli.calibration.settings import ProjectionSettings
from avcli.lens import name_of

Axes = Any
"""matplotlib's Axes and Figure: matplotlib has no types of its own."""


def words(result: Calibration, seen: Seen) -> list[str]:
    """Describe how good a calibration is, in sentences without a full stop.

    Args:
        result: the calibration.
        seen: what became of each picture.
    """
    q, lens, parameters = result.quality, result.solution.lens, result.solution.parameters
    used = int(result.kept.sum())
    held_out = f"{q.held_out_rms_px:.3f} px" if np.isfinite(q.held_out_rms_px) else "unknown (too few pictures)"
    pixels = zip(("fx", "fy", "cx", "cy"), parameters[:4], q.sd[:4], strict=True)
    terms = zip(lens.names()[4:], parameters[4 : -fit.BESIDE], q.sd[4 : -fit.BESIDE], strict=True)
    again = seen.count("duplicate")
    shown = len(seen) - seen.count("no board") - seen.count("another size")
    lines = [
        f"{shown} of {len(seen)} pictures show the {result.board.words}"
        f"{f', {again} of them as in another picture' if again else ''}; the fit uses "
        f"{used} picture{'s' if used != 1 else ''} with {len(result.observations.pixels)} corners",
        f"RMS residual {q.rms_px:.3f} px, without outliers {q.inlier_rms_px:.3f} px, of pictures held out of the fit "
        f"{held_out}",
        ", ".join(f"{name} {value:.2f} ± {sd:.2f}" for name, value, sd in pixels) + " px",
        ", ".join(f"{name} {value:.5f} ± {sd:.5f}" for name, value, sd in terms),
        f"angles from the axis: corners were seen up to {_degrees(q.theta_max_observed)}, rays are known to "
        f"{np.rad2deg(quality.TRUST_LIMIT):g}° up to {_degrees(q.theta_max_trusted)}, the picture reaches "
        f"{_degrees(q.theta_max_picture)}, the lens model is one-to-one up to {_degrees(lens.theta_max)}",
    ]
    if result.tried:
        errors = ", ".join(f"{one.name} {one.held_out_px:.3f}" for one in result.tried)
        lines.append(
            f"lens model {name_of(lens)}, {len(lens.names())} parameters: the simplest that held-out pictures cannot "
            f"tell from the best; RMS of each, px: {errors}"
        )
    if q.trusted.any():
        lines.append(
            f"expected error of the projection up to {_degrees(q.theta_max_trusted)}: mean {q.mean_sd_px:.3f} px, "
            f"largest {np.nanmax(q.field_sd_px):.3f} px; ± and expected errors are from how the views disagree"
        )
    if np.isfinite(q.halves.ratio):
        lines.append(
            f"lenses of random halves of the pictures differ by {q.halves.actual_px:.3f} px; that is "
            f"{q.halves.ratio:.2f} times what their stated uncertainties say"
        )
    if q.circle is not None:
        lines.append(
            f"light fills a circle about ({q.circle.x:.0f}, {q.circle.y:.0f}) px with a radius of "
            f"{q.circle.radius:.0f} px; what lies outside it does not count"
        )
    if result.solution.shape.any():
        lines += _shape_in_words(result)
    lines += _pupil_in_words(result)
    if result.observations.errors.any():
        rms = np.sqrt((result.observations.errors**2).sum(1).mean()) / result.board.square_m
        lines.append(
            f"the corners are {100 * rms:.2f} % of a square (RMS) from where the print should have them; with this the "
            f"held-out RMS is {result.printed_px:.3f} px"
        )
    lines += (
        sharpness.advice(result.views, seen.names) + shutter.advice(result.shutter) + _left_out_in_words(result, seen)
    )
    return [*lines, *q.advice, f"Verdict: {q.verdict}"]


def _left_out_in_words(result: Calibration, seen: Seen) -> list[str]:
    """Which corners and pictures do not fit."""
    lines = []
    some = [i for i in np.flatnonzero(result.kept) if result.dropped[i]]
    if some:
        lines.append(
            f"corners that do not fit are left out: {int(result.dropped[some].sum())} in {_listed(seen, some)}; with "
            f"every corner of every picture the held-out RMS is {result.held_out.all_px:.3f} px"
        )
    out = list(np.flatnonzero(~result.kept))
    if out:
        lines.append(f"most corners do not fit, so the whole picture is left out: {_listed(seen, out)}")
    return lines


def _listed(seen: Seen, views: Sequence[np.integer]) -> str:
    more = f" and {len(views) - 5} more" if len(views) > 5 else ""
    return ", ".join(seen.names[i] for i in views[:5]) + more


def _shape_in_words(result: Calibration) -> list[str]:
    """What the fit says of the board's shape; in mm only where the side of a square was measured."""
    board, bow = result.board, abs(result.bow_m)
    amount = (
        f"{1000 * result.bow_m:.2f} mm" if board.scaled else f"{100 * result.bow_m / board.square_m:.1f} % of a square"
    )
    lines = [
        f"the board is bowed by {amount} and stretched by {100 * result.solution.shape[2]:+.3f} % along its columns "
        f"(held-out RMS {result.flat_px:.3f} px without this correction, {result.shaped_px:.3f} px with it)"
    ]
    if board.scaled and bow > 0.0005:
        lines.append("the board is bowed by more than 0.5 mm: mount it on something flat")
    return lines


def _pupil_in_words(result: Calibration) -> list[str]:
    """How the lens's centre moves, if it surely does; as lengths only where the side of a square was measured."""
    board, theta = result.board, result.quality.theta_max_observed
    moved, sd, near = result.solution.pupil * theta**2, result.quality.sd[-1] * theta**2, result.near_m
    if not abs(moved) > 3 * sd:
        return []
    shift, distance = f"{1000 * abs(moved):.1f} ± {1000 * sd:.1f} mm", f"{near:.2f} m"
    if not board.scaled:
        near, moved, sd = near / board.square_m, moved / board.square_m, sd / board.square_m
        shift, distance = f"{abs(moved):.3f} ± {sd:.3f} squares", f"{near:.0f} squares"
    where = f"the lens has no single centre: at {_degrees(theta)} from the axis it is {shift}"
    if moved < 0:
        return [f"{where} behind, where that of a lens alone is ahead"]
    return [
        f"{where} farther ahead; the lens that is written is that of things far away: nearer than {distance} a ray at "
        f"this angle is more than {np.rad2deg(quality.TRUST_LIMIT):g}° off"
    ]


def _degrees(angle: float) -> str:
    return f"{np.rad2deg(angle):.1f}°"


def picture(result: Calibration, sample: np.ndarray | None = None, kind: str = "png") -> bytes:
    """Draw residuals, coverage, expected error, residuals by picture, two halves compared, and a straightened picture.

    Args:
        result: the calibration.
        sample: (height, width) uint8, one of the pictures.
        kind: "png", "svg" or "pdf".
    """
    import io

    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 12.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 2)
    _draw_residuals(axes[0, 0], result)
    _draw_coverage(figure, axes[0, 1], result)
    q = result.quality
    _draw_map(figure, axes[1, 0], result, "expected error of the projection", q.field.pixels, q.field.sd_px)
    _draw_views(axes[1, 1], result)
    halves = field.apart(result.observations, result.solution, q.field.pixels.reshape(-1, 2)).reshape(q.field.lit.shape)
    halves = np.where(q.field.lit, halves, np.nan)
    title = "difference between the lenses of two halves of the pictures"
    _draw_map(figure, axes[2, 0], result, title, q.field.pixels, halves)
    _draw_sample(axes[2, 1], result, sample)
    out = io.BytesIO()
    # Neither the time nor a random salt belongs in a file that the same pictures must give again.
    metadata = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    with matplotlib.rc_context({"svg.hashsalt": "avcalib"}):
        figure.savefig(out, format=kind, dpi=110, metadata=metadata)
    return out.getvalue()


def _frame(axis: Axes, result: Calibration, title: str) -> None:
    axis.set(xlim=(-0.5, result.width - 0.5), ylim=(result.height - 0.5, -0.5), aspect="equal", title=title)
    axis.set_xlabel("u, px")
    axis.set_ylabel("v, px")
    for angle in range(15, int(np.rad2deg(result.solution.lens.theta_max)), 15):
        turn = np.linspace(0, 2 * np.pi, 181)
        theta = np.deg2rad(angle)
        ring = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.full(181, np.cos(theta))], -1)
        axis.plot(*result.solution.lens.project(ring).T, color="0.5", lw=0.5, ls=":")
    if result.quality.circle is not None:
        axis.plot(*result.quality.circle.edge(361).T, color="tab:orange", lw=1)
    trusted = result.quality.theta_max_trusted * np.ones(181)
    turn = np.linspace(0, 2 * np.pi, 181)
    ring = np.stack([np.sin(trusted) * np.cos(turn), np.sin(trusted) * np.sin(turn), np.cos(trusted)], -1)
    axis.plot(*result.solution.lens.project(ring).T, color="tab:green", lw=1)


def _draw_residuals(axis: Axes, result: Calibration) -> None:
    rest = fit.residuals(result.observations, result.solution)
    length = float(np.nanquantile(np.linalg.norm(rest, axis=1), 0.9))
    enlarged = max(1.0, 0.03 * result.width / max(length, 1e-9))
    power = 10 ** np.floor(np.log10(enlarged))
    enlarged = np.floor(enlarged / power) * power
    _frame(axis, result, f"residuals, enlarged {enlarged:g} times; rings every 15°")
    u, v = result.observations.pixels.T
    axis.quiver(u, v, *(enlarged * rest.T), angles="xy", scale_units="xy", scale=1, width=0.0015, color="tab:blue")


def _draw_coverage(figure: Axes, axis: Axes, result: Calibration) -> None:
    _frame(axis, result, "where corners were seen")
    drawn = axis.imshow(
        np.ma.masked_equal(result.quality.counts, 0),
        extent=(-0.5, result.width - 0.5, result.height - 0.5, -0.5),
        cmap="YlGn",
        alpha=0.7,
    )
    axis.plot(*result.observations.pixels.T, ".", ms=2, color="k")
    figure.colorbar(drawn, ax=axis, label="corners in a cell", shrink=0.8)


def _draw_map(figure: Axes, axis: Axes, result: Calibration, title: str, pixels: np.ndarray, error: np.ndarray) -> None:
    from matplotlib.colors import LogNorm

    values = np.where(np.isfinite(error), np.maximum(error, 1e-6), np.nan)
    _frame(axis, result, title)
    if np.isfinite(values).any():
        low, high = np.nanmin(values), np.nanmax(values)
        norm = LogNorm(low * 0.99, max(high, low * 1.1))
        drawn = axis.pcolormesh(pixels[:, :, 0], pixels[:, :, 1], values, cmap="viridis", norm=norm, shading="gouraud")
        figure.colorbar(drawn, ax=axis, label="px", shrink=0.8)
    else:
        axis.text(0.5, 0.5, "too few pictures", transform=axis.transAxes, ha="center")


def _draw_views(axis: Axes, result: Calibration) -> None:
    number = np.arange(len(result.kept))
    for kept, colour, label in ((True, "tab:blue", "used"), (False, "tab:red", "left out")):
        some = result.kept == kept
        if some.any():
            axis.bar(number[some], result.view_rms_px[some], color=colour, label=label)
    axis.set(title="residual of each picture", xlabel="picture", ylabel="RMS, px")
    if not result.kept.all():
        axis.set_yscale("log")
    axis.legend()


def _draw_sample(axis: Axes, result: Calibration, sample: np.ndarray | None) -> None:
    axis.set_axis_off()
    if sample is None:
        return
    size = (result.width, result.height)
    straight = undistort.straighten(
        result.lens,
        size,
        size,
        ProjectionSettings(balance=0.5),
        result.quality.theta_max_trusted,
        result.quality.circle,
    )
    axis.imshow(undistort.resample(sample, straight), cmap="gray", vmin=0, vmax=255)
    axis.set_title(f"a straightened picture, {_degrees(straight.fov)} wide")
