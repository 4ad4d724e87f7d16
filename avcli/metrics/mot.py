"""MOTChallenge's and TrackEval's text files: other tools can check our figures, and we can score their tracks."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from avcli.formats.atomic import write_bytes
from avcli.formats.records import Identified
from avcli.metrics.sequence import Points, Sequence
from avcli.numeric import rate_of

_STEPS = 10_000
"""How many steps tell a clock's rate."""


def read(text: str, rate_hz: float) -> list[Identified]:
    """Read points from a MOTChallenge file: frame, id, left, top, width, height, confidence, x, y[, z].

    Frame 1 is time 0. Rows of confidence 0, which MOTChallenge does not score, are left out.

    Args:
        text: the file.
        rate_hz: frames a second.

    Raises:
        ValueError: a row, named by its line, is not such a row, or holds a box in pixels and no point in the room.
    """
    frames: dict[int, list[tuple[int, list[float]]]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            cells = [float(cell) for cell in line.replace(",", " ").split()]
        except ValueError:
            raise ValueError(f"line {number}: a value is not a number") from None
        if not np.isfinite(cells).all() or len(cells) < 2 or cells[0] < 1 or any(cell % 1 for cell in cells[:2]):
            raise ValueError(f"line {number}: must begin with a frame number from 1 on and an identity")
        point = cells[7:10]
        boxed = any(cell != -1 for cell in cells[2:6])
        if len(point) < 2 or (len(point) == 2 and boxed) or (boxed and point == [-1, -1, -1]):
            raise ValueError(f"line {number}: columns 8 to 10 must hold a position in the room, in m")
        if cells[6] == 0:
            continue
        frames.setdefault(int(cells[0]), []).append((int(cells[1]), point + [np.nan] * (3 - len(point))))
    return [
        Identified((frame - 1) / rate_hz, np.array([i for i, _ in rows]), np.array([p for _, p in rows]))
        for frame, rows in sorted(frames.items())
    ]


def write(sequences: Mapping[str, Mapping[str, Sequence]]) -> dict[str, str]:
    """Write ground truth and tracks of all sequences as MOTChallenge files and as TrackEval's folders.

    MOTChallenge's rows have the point in their last columns and -1 for the box. TrackEval reads only the columns of the
    box, so there x, y, z stand in those of left, top and width. Frames count from 1 on the union of the trackers'
    timelines, identities from 1 in the order of their labels.

    Args:
        sequences: by the sequence's name, for each tracker its sequence; all of a name have the same ground truth.

    Returns:
        Contents by path: mot/SEQUENCE/gt.txt and mot/SEQUENCE/TRACKER.txt; gt/ and trackers/ as TrackEval's benchmark
        "avcli", split "all".
    """
    files = {}
    split = "avcli-all"
    for name, trackers in sequences.items():
        time = np.unique(np.concatenate([sequence.time for sequence in trackers.values()]))
        rate = rate_of([np.diff(time[:_STEPS]).tolist()]) if time.size > 1 else 10.0
        truth = next(iter(trackers.values()))
        sides = {"gt": (truth.truth, truth.time)}
        sides |= {tracker: (sequence.track, sequence.time) for tracker, sequence in trackers.items()}
        for side, (points, own_time) in sides.items():
            frame = np.searchsorted(time, own_time)[points.frame] + 1
            files[f"mot/{name}/{side}.txt"] = _rows(points, frame, "{f},{i},-1,-1,-1,-1,1,{x},{y},{z}")
            path = f"gt/{split}/{name}/gt/gt.txt" if side == "gt" else f"trackers/{split}/{side}/data/{name}.txt"
            files[path] = _rows(points, frame, "{f},{i},{x},{y},{z},0,1,1,1")
        files[f"gt/{split}/{name}/seqinfo.ini"] = (
            f"[Sequence]\nname={name}\nframeRate={rate:g}\nseqLength={time.size}\nimDir=\nimExt=\n"
        )
    files[f"gt/seqmaps/{split}.txt"] = "\n".join(["name", *sequences]) + "\n"
    return files


def save_mot(directory: Path, sequences: Mapping[str, Mapping[str, Sequence]]) -> None:
    """Write the files of `write` into a directory, which is made if it does not exist."""
    for name, text in write(sequences).items():
        path = directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, text.encode())


def _rows(points: Points, frame: np.ndarray, form: str) -> str:
    position = np.zeros((points.identity.size, 3))
    position[:, : points.position.shape[1]] = points.position
    # repr keeps every digit, so that others' tools score exactly what we scored.
    return "".join(
        form.format(f=f, i=i + 1, x=x, y=y, z=z) + "\n"
        for f, i, (x, y, z) in zip(frame.tolist(), points.identity.tolist(), position.tolist(), strict=True)
    )
