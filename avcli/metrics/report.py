"""A report on runs: one HTML page that needs nothing else, with tables, plots and a player over time."""

import base64
import html
import json
import re
from collections.abc import Sequence as List
from importlib.resources import files
from math import isfinite
from pathlib import Path

import numpy as np

from avcli import __version__
from avcli.formats.atomic import write_bytes
from avcli.metrics import registry, table
from avcli.metrics.hota import ALPHA
from avcli.metrics.plots import IDENTITY_COLORS
from avcli.metrics.run import Detected, Run, error_over_time, timeline
from avcli.metrics.sequence import Points


def report(runs: List[Run], records: List[dict], compare: bool = False) -> str:
    """Write a report.

    Args:
        runs: what the player shows, at least one.
        records: all metrics records, for the tables.
        compare: set the thesis's figures beside ours in the tables.

    Returns:
        The page; it loads nothing from anywhere, and the same runs give the same text.
    """
    page = files("avcli.metrics").joinpath("report.html").read_text()
    title = ", ".join(run.name for run in runs)
    data = {"runs": [_run(run) for run in runs], "alpha": np.round(ALPHA, 2).tolist(), "colors": IDENTITY_COLORS}
    # No name in the data may end the script element that holds it, or begin another.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    content = {
        "title": html.escape(title),
        "tables": table.render(records, "html", compare),
        "legend": _legend(records),
        "version": __version__,
        "data": text,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: content[mark[1]], page)


def save_report(path: Path, runs: List[Run], records: List[dict], compare: bool = False) -> None:
    """Write a report to a file, as `report` makes it."""
    write_bytes(path, report(runs, records, compare).encode())


def _legend(records: List[dict]) -> str:
    """What each column of the tables means."""
    fields = registry.columns()
    if any("sensor" in record for record in records):
        names = {field.name for field in fields}
        fields += [field for field in registry.sensor_columns() if field.name not in names]
    return "\n".join(
        f"<dt>{html.escape(field.name.replace('_', ' '))}</dt><dd>{html.escape(field.text)}</dd>" for field in fields
    )


def _run(run: Run) -> dict:
    time = np.unique(np.concatenate([tracked.sequence.time for tracked in run.trackers.values()]))
    first = next(iter(run.trackers.values())).sequence
    return {
        "name": run.name,
        "room": None if run.room is None else run.room.tolist(),
        "extent": [round(number, 3) for number in run.extent()],
        "microphones": [_numbers(row) for row in run.microphones],
        "camera": None if run.camera is None else _numbers(run.camera),
        "times": _numbers(time),
        "truth": _points(first.truth, first.time, time),
        "trackers": [
            {
                "name": name,
                **_tracker(run, name, time),
                **_points(seen.sequence.track, seen.sequence.time, time),
            }
            for name, seen in run.trackers.items()
        ],
        "sensors": [
            {"name": name, "kind": sensor.kind, "frames": _detections(sensor, time)}
            for name, sensor in run.sensors.items()
        ],
        "frame_size": run.frame_size,
        **_pictures(run, time),
    }


def _tracker(run: Run, name: str, time: np.ndarray) -> dict:
    tracked = run.trackers[name]
    error, distances = error_over_time(tracked)
    place = np.searchsorted(time, tracked.sequence.time)
    series = np.full((2, time.size), np.nan)
    series[:, place] = error, distances.ospa
    lanes = timeline(run, name)
    return {
        "hota": {part: np.round(tracked.record["HOTA"][part], 4).tolist() for part in ("HOTA", "DetA", "AssA", "LocA")},
        "score": round(tracked.record["summary"]["HOTA"], 4),
        "error": _numbers(series[0]),
        "ospa": _numbers(series[1]),
        "cutoff": tracked.case.settings.cutoff_m,
        "lanes": [
            {
                "who": lane.who,
                "what": lane.what,
                "spans": [[round(a, 3), round(b, 3), k] for a, b, k in lane.spans],
            }
            for lane in lanes
        ],
    }


def _points(points: Points, own_time: np.ndarray, time: np.ndarray) -> dict:
    """Labels, and for each frame a row [identity, x, y, speaking] for each point."""
    frames: list[list] = [[] for _ in time]
    frame = np.searchsorted(time, own_time)[points.frame]
    speaking = _numbers(points.speaking)
    rows = zip(frame.tolist(), points.identity.tolist(), map(_numbers, points.position), speaking, strict=True)
    for f, identity, position, speaks in rows:
        frames[f].append([identity, position[0], position[1], speaks])
    for row in frames:
        row.sort(key=lambda point: point[0])
    return {"labels": points.label.tolist(), "frames": frames}


def _detections(sensor: Detected, time: np.ndarray) -> list[list]:
    """For each frame a row [x, y, matched, box] for each detection, at the frame next to it in time."""
    frames: list[list] = [[] for _ in time]
    points = sensor.sequence.track
    if not time.size:
        return frames
    own = sensor.sequence.time
    after = np.minimum(np.searchsorted(time, own), time.size - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(own - time[before]) < np.abs(own - time[after]), before, after)[points.frame]
    matched = np.zeros(points.identity.size, dtype=int)
    matched[sensor.case.matches[1]] = 1
    boxes = [None if np.isnan(box).any() else _numbers(box) for box in sensor.boxes_px]
    for f, position, right, box in zip(
        nearest.tolist(), map(_numbers, points.position), matched.tolist(), boxes, strict=True
    ):
        frames[f].append([position[0], position[1], right, box])
    return frames


def _pictures(run: Run, time: np.ndarray) -> dict:
    """Camera frames as data URLs, and for each moment the number of the latest one, or None."""
    at = sorted(run.frames)
    latest = np.searchsorted(at, time + 1e-3) - 1
    return {
        "pictures": ["data:image/jpeg;base64," + base64.b64encode(run.frames[t]).decode() for t in at],
        "picture": [int(k) if k >= 0 else None for k in latest] if at else [None] * time.size,
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    # Not numpy's round, which overflows on the largest numbers.
    return [round(value, 4) if isfinite(value) else None for value in values.tolist()]
