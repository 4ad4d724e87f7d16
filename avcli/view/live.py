"""A page on this machine that follows a run: new records reach it as server-sent events."""

import contextlib
import functools
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from avcli.formats.media import MediaError
from avcli.formats.serving import is_named, send
from avcli.view.page import Shown, Words, described, page
from avcli.view.pictures import Read, jpeg
from avcli.view.recording import Row

_QUIET_S = 10.0
"""After this time without news a comment keeps the connection open."""
_KEPT = 64
"""Small pictures that are kept; others are made again when they are looked at."""


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
            for time, read in pictures:
                self._log.append({"picture": [round(time, 4), f"picture/{len(self._reads)}"]})
                self._reads.append(read)
            self._news.notify_all()

    def end(self) -> None:
        """Say that nothing more comes; the page stays."""
        with self._news:
            self._ended = True
            self._news.notify_all()

    def _page(self) -> bytes:
        with self._news:
            told = [each["picture"] for each in self._log if "picture" in each]
            film = {"t": [time for time, _ in told], "jpegs": [address for _, address in told]} if told else None
            return page([described(self._shown, film)], self._words, live=len(self._log)).encode()

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
        asked = urlsplit(handler.path)
        what = asked.path.strip("/")
        with contextlib.suppress(OSError):
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
        live = self

        class _Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                try:
                    live.answer(self)
                except MediaError:
                    self.send_error(404)

            def log_message(self, *_: object) -> None:
                pass

        with ThreadingHTTPServer(("127.0.0.1", port), _Handler) as server:
            server.daemon_threads = True
            self.url = f"http://127.0.0.1:{server.server_address[1]}/"
            thread = threading.Thread(target=server.serve_forever, daemon=True)
            thread.start()
            try:
                yield
            finally:
                self.end()
                server.shutdown()
