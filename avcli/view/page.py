"""A page that shows runs: one file, or, for long runs, a file and a folder with film, sound and data beside it.

Its scripts are our own. No library draws through a fisheye lens, a map and lanes on the clock of film and sound; one
for the curve of the error alone (uPlot has some 50 kB) would nearly double the scripts.
"""

import html
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from avcli import __version__
from avcli.formats.atomic import write_bytes
from avcli.view import pictures, sound
from avcli.view.pictures import Timed
from avcli.view.recording import Recording

LARGEST_PAGE_MB = 20
"""A page that would be larger gets a folder beside it."""
_PICTURE_BYTES, _SOUND_BYTES_S, _ROW_BYTES = 32_000, 6_000, 130  # about what they take inside a page
_SCRIPTS = ("camera.js", "streams.js", "charts.js", "stage.js", "listen.js", "player.js")


@dataclass
class Shown:
    """A run as a page shows it.

    Attributes:
        recording: what was recorded.
        surroundings: as `avcli.view.surroundings.surroundings` describes them.
        pictures: of the camera, in order of time, and how many they are.
        rate_hz: of the camera.
        track: sound, None where there is none.
        beams: what is heard at each track, of the tracker that is shown first.
        scores: tracker -> "score" (fraction), "hota" (curves over alpha), "error" ("t" in s, "cm", "missed", "false").
        film: where the pictures come from, if it is one film, and the time of its first picture in s.
    """

    recording: Recording
    surroundings: Mapping[str, Any] = field(default_factory=dict)
    pictures: Iterable[Timed] = ()
    picture_count: int = 0
    rate_hz: float = 10.0
    track: sound.Track | None = None
    beams: Sequence[sound.Beam] = ()
    scores: Mapping[str, Any] | None = None
    film: tuple[Path, float] | None = None

    def bytes_inside(self) -> int:
        """Reckon how much it takes inside a page."""
        rows = sum(1 + len(row[1]) for stream in self.recording.streams for row in stream.rows)
        heard = sum(track.duration_s for track in [self.track, *(beam.track for beam in self.beams)] if track)
        return int(_ROW_BYTES * rows + _PICTURE_BYTES * self.picture_count + _SOUND_BYTES_S * heard)


@dataclass(frozen=True)
class Words:
    """What a page says about itself.

    Attributes:
        title: in its heading.
        subject: what it is, in the browser's tab.
        writer: command and version that wrote it.
        scores: HTML that stands below the charts.
        alpha: thresholds of the HOTA curves.
    """

    title: str
    subject: str = "a run"
    writer: str = f"avview {__version__}"
    scores: str = ""
    alpha: Sequence[float] = ()


def save(
    path: Path,
    shown: Sequence[Shown],
    words: Words,
    say: Callable[[str], None] = lambda text: None,
    largest_mb: float = LARGEST_PAGE_MB,
) -> Path | None:
    """Write a page; the same runs give the same bytes.

    Args:
        path: of the page.
        shown: the runs, at least one.
        words: what the page says about itself.
        say: is called with a sentence if pictures are missing.
        largest_mb: a page that would be larger than this many MB gets a folder beside it, PAGE.files, with film, sound
            and data.

    Returns:
        The folder, None where the page is one file.

    Raises:
        OSError: it cannot be written.
    """
    if sum(one.bytes_inside() for one in shown) <= 1e6 * largest_mb:
        write_bytes(path, page([_inside(one, say) for one in shown], words).encode())
        return None
    folder = path.with_name(path.name + ".files")
    folder.mkdir(exist_ok=True)
    runs = [_beside(one, folder, number, say) for number, one in enumerate(shown)]
    content = f"window.RECORDED = {_json(runs, words, None)};\n"
    write_bytes(folder / "data.js", content.encode())
    write_bytes(path, page(runs, words, folder=folder.name).encode())
    return folder


def page(runs: Sequence[Mapping[str, Any]], words: Words, *, folder: str | None = None, live: int | None = None) -> str:
    """Assemble a page.

    Args:
        runs: as `described` makes them.
        words: what the page says about itself.
        folder: holds the data, beside the page; None: the page holds it.
        live: number of the event from which a live page goes on; None: it is finished.
    """
    own = files(__package__)
    data, sources, scripts, needs = "", "data:", "", "This page is one file and loads nothing from the network."
    if folder is not None:
        address = html.escape(folder)
        data, sources, scripts = f'<script src="{address}/data.js"></script>', "data: 'self' file:", "'self' file:"
        needs = f"It needs the folder {address} beside it, and nothing from the network."
    else:
        data = f'<script type="application/json" id="data">{_json(runs, words, live)}</script>'
    if live is not None:
        sources, needs = "data: 'self'", "It follows a run on this machine."
    content = {
        "title": html.escape(words.title),
        "subject": html.escape(words.subject),
        "sources": sources,
        "scripts": scripts,
        "connect": "'none'" if live is None else "'self'",
        "style": own.joinpath("page.css").read_text(),
        "script": "\n".join(own.joinpath(name).read_text() for name in _SCRIPTS),
        "scores": words.scores,
        "writer": html.escape(words.writer),
        "needs": needs,
        "data": data,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: content[mark[1]], own.joinpath("page.html").read_text())


def described(
    one: Shown,
    film: Mapping[str, Any] | None = None,
    heard: Mapping[str, Any] | None = None,
    beams: Sequence[Mapping[str, Any]] = (),
) -> dict:
    """Describe a run in JSON's types, with its film, its sound and its beams as they are given."""
    streams = [
        {"name": stream.name, "kind": stream.kind, "sensor": stream.sensor, "rows": stream.rows}
        for stream in one.recording.streams
    ]
    return {
        "name": one.recording.name,
        "streams": streams,
        **one.surroundings,
        "film": film,
        "sound": heard,
        **({"beams": list(beams)} if beams else {}),
        "scores": one.scores,
    }


def _inside(one: Shown, say: Callable[[str], None]) -> dict:
    return described(one, pictures.inside(one.pictures, say), *_heard(one, lambda track, _: sound.data_url(track)))


def _beside(one: Shown, folder: Path, number: int, say: Callable[[str], None]) -> dict:
    def store(track: sound.Track, name: str) -> str:
        write_bytes(folder / f"{name}.mp3", sound.mp3(track))
        return f"{folder.name}/{name}.mp3"

    heard = _heard(one, lambda track, which: store(track, f"sound-{number}{which}"))
    film = _film(one, folder / f"film-{number}", say)
    film = film and {**film, "src": f"{folder.name}/{film['src']}"}
    return described(one, film, *heard)


def _film(one: Shown, path: Path, say: Callable[[str], None]) -> dict | None:
    """The film beside a page: as it is if browsers play it, else encoded."""
    played = one.film and pictures.as_browsers_play(one.film[0])
    if one.film and played:
        for _, read in one.pictures:
            read()  # who wraps the reader is told of pictures of a wrong size
            break
        source, start_s = one.film
        return pictures.copied(source, path.with_suffix(played), start_s, one.rate_hz)
    if not one.picture_count:
        return None
    return pictures.film(one.pictures, pictures.rate(one.pictures, one.rate_hz), path.with_suffix(".webm"), say)


def _heard(one: Shown, store: Callable[[sound.Track, str], str]) -> tuple[dict | None, list[dict]]:
    """The microphone and the beams, drawn and, by `store`, at an address."""
    heard = None if one.track is None else {**sound.pictured(one.track), "src": store(one.track, "")}
    beams = [
        {**sound.pictured(beam.track), "id": beam.identity, "tracker": beam.tracker, "src": store(beam.track, f"-{k}")}
        for k, beam in enumerate(one.beams)
    ]
    return heard, beams


def _json(runs: Sequence[Mapping[str, Any]], words: Words, live: int | None) -> str:
    data = {"runs": runs, "alpha": list(words.alpha), "live": live}
    # No name in the data may end the script element that holds it, or begin another.
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
