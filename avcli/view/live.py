"""A page on this machine that follows a run: new records reach it as server-sent events."""

import base64
import contextlib
import functools
import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from avcli.formats.media import MediaError
from avcli.formats.records import Identified
from avcli.formats.serving import is_named, send, serving
from avcli.numeric import assign
from avcli.view import sound
from avcli.view.experiment import Recorded
from avcli.view.page import Shown, Words, described, page
from avcli.view.pictures import Read, jpeg
from avcli.view.recording import TRACKS, TRUTH, Row

_QUIET_S = 10.0
"""After this time without news a comment keeps the connection open."""
_KEPT = 64
"""Small pictures that are kept; others are made again when they are looked at."""


_LOOK_S = 0.25
"""So often it is looked whether there is more sound."""
_STEP_S = 0.02
_ERROR_KEYS = ("t", "cm", "missed", "false")
_LONGEST_S = 5.0


@dataclass
class Heard:
    """The sound of a run that goes on.

    Attributes:
        recorded: returns the sound that is there now, None where there is none yet.
        microphone: that is drawn, and heard first, counted from 1.
        beam: returns what is heard at a track, by its identity as text, between two times in s, and its sample rate;
            None where there is no array.
    """

    recorded: Callable[[], Recorded | None]
    microphone: int
    beam: Callable[[str, float, float], tuple[np.ndarray, int]] | None = None
    _columns: int = field(default=0, init=False)

    def news(self) -> dict[str, Any] | None:
        """Describe the sound that came since the last call, in whole columns; None where there is none."""
        recorded = self.recorded()
        hop = 0 if recorded is None else round(_STEP_S * recorded.rate_hz)
        columns = 0 if recorded is None else recorded.length // hop
        if recorded is None or columns <= self._columns:
            return None
        columns = min(columns, self._columns + round(60 / _STEP_S))
        samples = recorded.read(self._columns * hop, columns * hop)[:, self.microphone - 1]
        peak, bands = sound.decibels(samples, recorded.rate_hz, _STEP_S)
        self._columns = columns
        return {
            "name": f"microphone {self.microphone}",
            "start": recorded.start_s,
            "step": hop / recorded.rate_hz,
            "bands": bands.shape[1],
            "low_hz": sound.LOW_HZ,
            "high_hz": min(sound.HIGH_HZ, recorded.rate_hz / 2),
            "peak": base64.b64encode(peak.tobytes()).decode(),
            "levels": base64.b64encode(bands.tobytes()).decode(),
            "beams": self.beam is not None,
        }

    def part(self, of: str | None, begin: float, end: float) -> tuple[bytes, int]:
        """Return float32 samples between two times in s, of the microphone or of the beam at a track, and their rate.

        Raises:
            ValueError: too much is asked for, or nobody can listen there.
            MediaError: it cannot be read.
        """
        recorded = self.recorded()
        if recorded is None or not 0 < end - begin <= _LONGEST_S:
            raise ValueError("no such sound")
        if of is not None:
            if self.beam is None:
                raise ValueError("no such beam")
            samples, rate = self.beam(of, begin, end)
        else:
            first, last = (round((time - recorded.start_s) * recorded.rate_hz) for time in (begin, end))
            samples, rate = recorded.read(first, last)[:, self.microphone - 1], recorded.rate_hz
        return samples.astype("<f4").tobytes(), rate


class Live:
    """A run that is watched while it goes on.

    Args:
        shown: the run; what its recording already holds is on the page from the start.
        words: what the page says about itself.

    Attributes:
        url: of the page, once it is served.
    """

    def __init__(self, shown: Shown, words: Words):
        self.url = ""
        self._shown, self._words = shown, words
        self._news = threading.Condition()
        self._log: list[dict[str, Any]] = []
        self._streams, self._ended = len(shown.recording.streams), False
        self._reads: list[Read] = []
        self._errors, self._compared = _Errors(), dict[tuple[str, str], int]()
        self._heard: Heard | None = None
        self._jpeg = functools.lru_cache(maxsize=_KEPT)(lambda number: jpeg(self._reads[number]()))

    def tell(self, add: Callable[[], Sequence[tuple[int, Row]]], pictures: Sequence[tuple[float, Read]] = ()) -> None:
        """Add to the run, and tell everybody who watches.

        Args:
            add: adds records to the recording, and returns the new rows with the numbers of their streams.
            pictures: that belong to them.
        """
        with self._news:
            rows = add()
            for stream in self._shown.recording.streams[self._streams :]:
                about: dict[str, Any] = {"name": stream.name, "kind": stream.kind, "sensor": stream.sensor, "rows": []}
                self._log.append({"stream": about})
            self._streams = len(self._shown.recording.streams)
            self._log += [{"to": number, "row": row} for number, row in rows]
            self._log += [{"error": each} for each in self._new_errors()]
            for time, read in pictures:
                self._log.append({"picture": [round(time, 4), f"picture/{len(self._reads)}"]})
                self._reads.append(read)
            self._news.notify_all()

    def _new_errors(self) -> Iterator[dict[str, Any]]:
        for key, people in self._shown.recording.people.items():
            for one in people[self._compared.get(key, 0) :]:
                yield from self._errors.add(*key, one)
            self._compared[key] = len(people)

    def follow(self, heard: Heard) -> None:
        """Follow the sound of a run in a thread of its own, as long as the page is served."""
        self._heard = heard
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        assert self._heard is not None
        while True:
            try:
                new = self._heard.news()
            except MediaError:  # somebody writes it just now
                new = None
            if new:
                with self._news:
                    self._log.append({"sound": new})
                    self._news.notify_all()
            time.sleep(_LOOK_S)

    def end(self) -> None:
        """Say that nothing more comes; the page stays."""
        with self._news:
            self._ended = True
            self._news.notify_all()

    def _page(self) -> bytes:
        with self._news:
            scores: dict[str, Any] = {}
            told = [each["picture"] for each in self._log if "picture" in each]
            for each in self._log:
                if "error" in each:
                    error = scores.setdefault(each["error"]["of"], {"error": {k: [] for k in _ERROR_KEYS}})["error"]
                    for key in _ERROR_KEYS:
                        error[key].append(each["error"][key])
            sounds = [each["sound"] for each in self._log if "sound" in each]
            film = {"t": [time for time, _ in told], "jpegs": [address for _, address in told]} if told else None
            run = {**described(self._shown, film), "scores": self._shown.scores or scores or None, "sounds": sounds}
            return page([run], self._words, live=len(self._log)).encode()

    def _events(self, first: int) -> Iterator[bytes]:
        while True:
            with self._news:
                if len(self._log) <= first and not self._ended:
                    self._news.wait(_QUIET_S)
                new, ended = self._log[first:], self._ended
            first += len(new)
            if not new and not ended:
                yield b": nothing new\n\n"
            yield b"".join(b"data: " + json.dumps(each, separators=(",", ":")).encode() + b"\n\n" for each in new)
            if ended and not new:
                yield b'data: {"ended":true}\n\n'
                return

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        """Answer one request; it must name this machine, so that no page from the network can read the run."""
        with contextlib.suppress(OSError):
            try:
                self._reply(handler)
            except (MediaError, KeyError, ValueError):
                handler.send_error(404)

    def _reply(self, handler: BaseHTTPRequestHandler) -> None:
        asked = urlsplit(handler.path)
        what = asked.path.strip("/")
        if not is_named(handler):
            handler.send_error(403)
        elif what == "":
            send(handler, "text/html; charset=utf-8", self._page())
        elif what == "events":
            first = parse_qs(asked.query).get("from", [""])[0]
            send(handler, "text/event-stream", None)
            for part in self._events(int(first) if first.isdecimal() else 0):
                handler.wfile.write(part)
                handler.wfile.flush()
        elif what == "sound" and self._heard is not None:
            query = {key: values[-1] for key, values in parse_qs(asked.query).items()}
            content, rate = self._heard.part(query.get("of"), float(query["from"]), float(query["to"]))
            send(handler, "application/octet-stream", content, rate)
        elif (number := what.removeprefix("picture/")).isdecimal() and int(number) < len(self._reads):
            send(handler, "image/jpeg", self._jpeg(int(number)))
        else:
            handler.send_error(404)

    @contextlib.contextmanager
    def serving(self, port: int) -> Iterator[None]:
        """Serve the page at 127.0.0.1 while the block lasts; port 0 is any that is free.

        Raises:
            OSError: the port is taken.
        """
        with serving(self.answer, port) as there:
            self.url = f"http://127.0.0.1:{there}/"
            try:
                yield
            finally:
                self.end()


# --- how far tracks are from the people, each moment by itself --------------------------------------------------------

_CUTOFF_M = 1.0
_MOMENTS = 2000
"""Moments that wait for the other kind of records; a moment without its counterpart is forgotten after so many."""


class _Errors:
    """Compares trackers with the ground truth; one assignment a moment, without memory of identities."""

    def __init__(self) -> None:
        self._truth: OrderedDict[int, np.ndarray] = OrderedDict()
        self._waiting: OrderedDict[tuple[str, int], tuple[float, np.ndarray]] = OrderedDict()

    def add(self, kind: str, name: str, people: Identified) -> list[dict[str, Any]]:
        """Add a record of people.

        Args:
            kind: `TRUTH` or `TRACKS`.
            name: of the tracker.
            people: the record.

        Returns:
            For each tracker that can be compared now: "of" (its name), "t" in s, "cm" (mean distance of the matched,
            null where none is within 1 m), and the numbers of people "missed" and of "false" tracks.
        """
        moment, places = round(1000 * people.timestamp), people.positions[:, :2]
        ready = []
        if kind == TRUTH:
            self._truth[moment] = places
            found = [key for key in self._waiting if key[1] == moment]
            ready = [_compared(key[0], *self._waiting.pop(key), places) for key in found]
        elif kind == TRACKS and moment in self._truth:
            ready = [_compared(name, people.timestamp, places, self._truth[moment])]
        elif kind == TRACKS:
            self._waiting[name, moment] = (people.timestamp, places)
        for kept in (self._truth, self._waiting):
            while len(kept) > _MOMENTS:
                kept.popitem(last=False)
        return ready


def _compared(name: str, time: float, tracks: np.ndarray, people: np.ndarray) -> dict[str, Any]:
    distance = np.linalg.norm(people[:, None] - tracks, axis=2)
    who, which = assign(np.minimum(distance, 10 * _CUTOFF_M)) if distance.size else (np.zeros(0, int),) * 2
    near = distance[who, which]
    near = near[near < _CUTOFF_M]
    cm = round(100 * float(near.mean()), 2) if near.size else None
    return {
        "of": name,
        "t": round(time, 4),
        "cm": cm,
        "missed": len(people) - near.size,
        "false": len(tracks) - near.size,
    }
