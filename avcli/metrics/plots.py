"""Figures of a run: the room from above, HOTA over its thresholds, the error over time, a timeline of each person."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from avcli.formats.atomic import write_bytes
from avcli.formats.sensors import CAMERA, MICROPHONES
from avcli.metrics.hota import ALPHA
from avcli.metrics.run import Lane, Run, error_over_time, timeline

if TYPE_CHECKING:  # an extra
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

IDENTITY_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195", "#8C564B")
"""Okabe and Ito's colours without black and yellow, which colour-blind readers can distinguish, and two more."""
_GAP = 10  # usual steps; a longer time without records is left empty
_MARKERS = {MICROPHONES: "x", CAMERA: "+"}
_SHADES = {MICROPHONES: "0.55", CAMERA: "0.3"}
_SCORES: dict[str, dict[str, Any]] = {
    "HOTA": {"color": "#000000", "linewidth": 2.2},
    "DetA": {"color": "#0072B2", "linewidth": 1.5, "linestyle": (0, (4, 2))},
    "AssA": {"color": "#D55E00", "linewidth": 1.5, "linestyle": (0, (1, 1.5))},
    "LocA": {"color": "#009E73", "linewidth": 1.2},
}


def save_plots(path: Path, runs: Sequence[Run]) -> None:
    """Draw each run to a file, PNG, SVG or PDF by its suffix; of several runs, the run's name is added before the dot.

    Raises:
        ModuleNotFoundError: matplotlib, an extra, is not installed.
    """
    for run in runs:
        name = re.sub(r"[^\w.-]+", "-", run.name).strip("-")
        own = path if len(runs) == 1 else path.with_name(f"{path.stem}-{name}{path.suffix}")
        write_bytes(own, plot(run, path.suffix.lower()[1:]))


def plot(run: Run, kind: str) -> bytes:
    """Draw a run, one column for each tracker, as in figures 5.1 to 5.12 of the thesis and beyond.

    Args:
        run: what to draw.
        kind: "png", "svg" or "pdf".

    Returns:
        The file's content; the same run gives the same bytes.

    Raises:
        ModuleNotFoundError: matplotlib, an extra, is not installed.
    """
    try:
        import matplotlib
    except ModuleNotFoundError:
        raise ModuleNotFoundError("matplotlib is not installed: pip install 'avcli[plot]'") from None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rc("svg", hashsalt="avcli", fonttype="none")
        matplotlib.rc("font", size=9)
        matplotlib.rc("axes", titlesize=10, titleweight="bold")
        matplotlib.rc("axes.spines", top=False, right=False)
        columns = len(run.trackers)
        lanes = {name: timeline(run, name) for name in run.trackers}
        shades = {name: _SHADES[sensor.kind] for name, sensor in run.sensors.items()} | {"speaks": "#E69F00"}
        rows = max(4, max(len(lane) for lane in lanes.values()))
        heights = (3.9, 2.0, 1.8, 0.5 + 0.16 * rows)
        figure = Figure(figsize=(max(4.4, 4.0 * columns), sum(heights) + 1.2), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, columns, squeeze=False, height_ratios=heights)
        figure.suptitle(run.name, fontsize=13, fontweight="bold")
        for k, (name, tracked) in enumerate(run.trackers.items()):
            summary = tracked.record["summary"]
            axes[0, k].set_title(f"{name}   HOTA {100 * summary['HOTA']:.1f}")
            _draw_room(axes[0, k], run, name)
            _draw_hota(axes[1, k], tracked.record)
            _draw_error(axes[2, k], run, name)
            _draw_timeline(axes[3, k], lanes[name], shades)
            if k:
                for row in range(3):
                    axes[row, k].set_ylabel("")
        figure.legend(handles=_legend(run), loc="outside lower center", ncols=min(5, 1 + columns), frameon=False)
        content = io.BytesIO()
        nothing = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
        figure.savefig(content, format=kind, dpi=150, metadata=nothing)
    return content.getvalue()


def _draw_room(axes: Axes, run: Run, name: str) -> None:
    from matplotlib.patches import Rectangle

    x0, x1, y0, y1 = run.extent()
    if run.room is not None:
        axes.add_patch(Rectangle((0, 0), *run.room, fill=False, linewidth=1.2, color="0.35", zorder=0))
    axes.scatter(run.microphones[:, 0], run.microphones[:, 1], marker="^", s=22, color="0.6", linewidths=0, zorder=1)
    if run.camera is not None:
        axes.scatter(run.camera[0], run.camera[1], marker="s", s=28, facecolor="none", edgecolor="0.6", zorder=1)

    tracked = run.trackers[name]
    begin = tracked.sequence.time.min(initial=math.inf)
    length = max(tracked.sequence.time.max(initial=-math.inf) - begin, 1e-9)
    for sensor, detected in run.sensors.items():
        # A tracker that is named after one sensor had that sensor alone.
        if name in run.sensors and sensor != name:
            continue
        points, time = detected.sequence.track.position, detected.sequence.time[detected.sequence.track.frame]
        if time.size:
            axes.scatter(
                points[:, 0],
                points[:, 1],
                c=0.15 + 0.6 * (time - begin) / length,
                cmap="gray",
                vmin=0,
                vmax=1,
                marker=_MARKERS[detected.kind],
                s=26,
                linewidths=0.9,
                zorder=2,
            )
    truth = tracked.sequence.truth
    for k in range(truth.label.size):
        own = np.flatnonzero(truth.identity == k)
        path = truth.position[own]
        axes.plot(*_parts(path, truth.frame[own]), color="black", linewidth=1.0, zorder=3)
        _birth_and_death(axes, path, "black", "none", 62)
    track = tracked.sequence.track
    for k in range(track.label.size):
        own = np.flatnonzero(track.identity == k)
        path = track.position[own]
        color = IDENTITY_COLORS[k % len(IDENTITY_COLORS)]
        axes.plot(*_parts(path, track.frame[own]), color=color, linewidth=1.8, zorder=4, solid_capstyle="round")
        _birth_and_death(axes, path, color, color, 26)
    margin = 0.04 * max(x1 - x0, y1 - y0, 1e-3)
    axes.set(xlim=(x0 - margin, x1 + margin), ylim=(y0 - margin, y1 + margin), xlabel="x in m", ylabel="y in m")
    axes.set_aspect("equal")


def _parts(path: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return x and y (2, n) of a path, m, with NaN between frames in which there is nobody."""
    return np.insert(path[:, :2], np.flatnonzero(np.diff(frame) > 1) + 1, np.nan, axis=0).T


def _birth_and_death(axes: Axes, path: np.ndarray, edge: str, face: str, size: float) -> None:
    for point, marker in ((path[0], "o"), (path[-1], "s")):
        axes.scatter(
            point[0], point[1], marker=marker, s=size, facecolor=face, edgecolor=edge, linewidths=1.0, zorder=5
        )


def _draw_hota(axes: Axes, record: dict) -> None:
    for name, style in _SCORES.items():
        axes.plot(ALPHA, 100 * np.asarray(record["HOTA"][name]), label=name, **style)
    axes.set(xlim=(0, 1), ylim=(0, 103), xlabel="α", ylabel="percent")
    axes.grid(color="0.9", linewidth=0.6)
    axes.legend(loc="best", fontsize=8, ncols=2, handlelength=2, edgecolor="none", framealpha=0.8)


def _draw_error(axes: Axes, run: Run, name: str) -> None:
    tracked = run.trackers[name]
    error, distances = error_over_time(tracked)
    time = tracked.sequence.time
    largest = 100 * max(float(np.nan_to_num(error).max(initial=0.0)), 0.01)
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > _GAP * (np.median(steps) if steps.size else 0.0)) + 1
    time, error, ospa = (np.insert(values, gaps, np.nan) for values in (time, error, distances.ospa))
    axes.fill_between(time, 100 * ospa, step="mid", color="0.88", linewidth=0, label="OSPA")
    axes.plot(
        time, 100 * error, color="#0072B2", linewidth=1.4, marker=".", markersize=3, label="mean error of matches"
    )
    axes.set(xlabel="time in s", ylabel="cm", ylim=(0, 1.6 * largest))  # OSPA of a missed person reaches beyond
    axes.grid(color="0.9", linewidth=0.6)
    axes.legend(loc="upper right", fontsize=8, edgecolor="none", framealpha=0.8)


def _draw_timeline(axes: Axes, lanes: list[Lane], shades: Mapping[str, str]) -> None:
    for row, lane in enumerate(lanes):
        for begin, end, identity in lane.spans:
            color = IDENTITY_COLORS[identity % len(IDENTITY_COLORS)]
            color = color if lane.what in ("tracked", "false") else shades[lane.what]
            height = 0.3 if lane.what == "false" else 0.7
            axes.barh(row, end - begin, left=begin, height=height, color=color, linewidth=0)
        if row and lane.who != lanes[row - 1].who:
            axes.axhline(row - 0.5, color="0.8", linewidth=0.6)
    axes.set(ylim=(max(1, len(lanes)) - 0.5, -0.5), xlabel="time in s")
    axes.set_yticks(range(len(lanes)), [f"{lane.who} {lane.what}" for lane in lanes], fontsize=7)
    axes.tick_params(axis="y", length=0)


def _legend(run: Run) -> list[Line2D]:
    from matplotlib.lines import Line2D

    def entry(label: str, **style: Any) -> Line2D:
        return Line2D([], [], **{"color": "black", "linewidth": 0, **style}, label=label)

    entries = [
        entry("ground truth", linewidth=1),
        entry("track, by identity", linewidth=1.8, color=IDENTITY_COLORS[0]),
        entry("birth", marker="o", markerfacecolor="none"),
        entry("death", marker="s", markerfacecolor="none"),
    ]
    entries += [
        entry(f"{name} detection, dark to light over time", marker=_MARKERS[sensor.kind], color="0.4")
        for name, sensor in run.sensors.items()
    ]
    if len(run.microphones):
        entries.append(entry("microphone", marker="^", color="0.6"))
    if run.camera is not None:
        entries.append(entry("camera", marker="s", color="0.6", markerfacecolor="none"))
    return entries
