"""A leaderboard: trackers on all sequences of a data set in MOTChallenge's layout, best first."""

import configparser
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from avcli.formats.records import Identified
from avcli.metrics.run import Run
from avcli.metrics.scoring import combined, score_tracks
from avcli.metrics.settings import Settings

DISTANCES_M = (2.0, 0.5)
"""The d0 at which trackers are compared: TrackEval's, and one that asks for accuracy."""


@dataclass(frozen=True)
class Entry:
    """A sequence of a data set.

    Attributes:
        name: of the sequence, and of a tracker's file for it.
        level: what seqinfo.ini says of its difficulty; "" where it says nothing.
        truth: path of gt.txt.
        rate_hz: frames a second.
    """

    name: str
    level: str
    truth: Path
    rate_hz: float


def entries(dataset: Path) -> list[Entry]:
    """Find the sequences of a data set: every folder below it with seqinfo.ini and gt/gt.txt, in the order of names.

    Raises:
        ValueError: there is none, a seqinfo.ini has no frame rate, or two sequences have one name.
    """
    found = []
    for path in sorted(dataset.rglob("seqinfo.ini")):
        about = configparser.ConfigParser()
        try:
            about.read(path, encoding="utf-8")
            rate = about.getfloat("Sequence", "frameRate")
        except (configparser.Error, ValueError) as error:
            raise ValueError(f"{path}: has no frameRate: {' '.join(str(error).split())}") from None
        if not rate > 0:
            raise ValueError(f"{path}: frameRate must be positive, found {rate:g}")
        truth = path.parent / "gt" / "gt.txt"
        if truth.exists():
            level = about.get("Sequence", "level", fallback="")
            found.append(Entry(about.get("Sequence", "name", fallback=path.parent.name), level, truth, rate))
    if not found:
        raise ValueError(f"{dataset}: has no sequences (SEQUENCE/seqinfo.ini with SEQUENCE/gt/gt.txt)")
    names = [entry.name for entry in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{dataset}: two sequences are called {twice[0]}")
    return found


def file_of(tracker: Path, entry: Entry) -> Path | None:
    """Return the tracker's file for a sequence, NAME.txt or NAME.jsonl in its directory; None if there is none."""
    paths = (tracker / f"{entry.name}{ending}" for ending in (".txt", ".jsonl"))
    return next((path for path in paths if path.exists()), None)


def rank(
    truths: Mapping[Entry, Sequence[Identified]],
    tracks: Mapping[str, Mapping[Entry, Sequence[Identified]]],
    settings: Settings,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[dict]:
    """Score trackers on each level and on everything, at each of DISTANCES_M.

    Args:
        truths: ground truth of each sequence.
        tracks: by tracker; a sequence that it lacks counts as missed.
        settings: how they are compared, but for d0.
        say: is called with a sentence where a score leaves out a sequence.

    Yields:
        Metrics records, called "LEVEL at D m" or "all at D m"; in each of these the best HOTA comes first.

    Raises:
        ValueError: as `score_tracks`; the message names the sequence and the tracker.
    """
    levels = list(dict.fromkeys(entry.level for entry in truths if entry.level))
    for d0 in DISTANCES_M:
        chosen = replace(settings, d0=d0)
        runs = {entry: _run(entry, truth, tracks, chosen) for entry, truth in truths.items()}
        for level in [*(levels if len(levels) > 1 else []), ""]:
            own = [run for entry, run in runs.items() if level in ("", entry.level)]
            records = [record for record in combined(own, say) if record["average"] == "micro"]
            for record in sorted(records, key=lambda record: -record["summary"]["HOTA"]):
                del record["average"]
                yield {**record, "sequence": f"{level or 'all'} at {d0:g} m"}


def _run(
    entry: Entry,
    truth: Sequence[Identified],
    tracks: Mapping[str, Mapping[Entry, Sequence[Identified]]],
    settings: Settings,
) -> Run:
    scored = {}
    for tracker, of in tracks.items():
        try:
            scored[tracker], _ = score_tracks(truth, of.get(entry, ()), settings, entry.name, tracker)
        except ValueError as error:
            raise ValueError(f"{entry.name} {tracker}: {error}") from None
    return Run(entry.name, scored, {})
