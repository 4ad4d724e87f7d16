"""A page that shows the newest picture of a film, and how the filming goes."""

import contextlib
import json
import secrets
import threading
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from avcli.formats import serving as server
from avcli.formats.serving import is_local, is_named, send

_WAIT_S = 10.0
"""How long a question about the state waits for a new one."""


class Show:
    """Call it with a picture (height, width, 3) uint8 RGB and the state (JSON's types) to show these.

    Where the page is served to other machines, its address holds a key that cannot be guessed. On this machine alone
    there is none, but a request must name this machine: a page from the network could otherwise have its own name
    lead here, and read the camera.

    Attributes:
        port: of the page, while it is served.
    """

    port: int

    def __init__(self, host: str) -> None:
        self._new = threading.Condition()
        self._jpeg, self._state, self._number, self._ended = b"", b"{}", 0, False
        self._host, self._local = host, is_local(host)
        self._key = "" if self._local else f"{secrets.token_urlsafe(9)}/"
        self._page = resources.files(__package__).joinpath("watch.html").read_bytes()

    @property
    def url(self) -> str:
        """Where the page is."""
        name = _own_address() if self._host in ("0.0.0.0", "") else self._host
        return f"http://{name}:{self.port}/{self._key}"

    def __call__(self, picture: np.ndarray, state: Mapping[str, Any] | None = None) -> None:
        import cv2

        jpeg = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        with self._new:
            self._jpeg, self._number = jpeg, self._number + 1
            self._state = json.dumps({**(state or {}), "number": self._number}).encode()
            self._new.notify_all()

    def _answer(self, handler: BaseHTTPRequestHandler) -> None:
        asked = urlsplit(handler.path)
        if (self._local and not is_named(handler)) or not asked.path.startswith(f"/{self._key}"):
            handler.send_error(404)
            return
        what = asked.path.removeprefix(f"/{self._key}")
        with contextlib.suppress(OSError):
            if what == "picture":
                send(handler, "image/jpeg", self._jpeg)
            elif what == "state":
                known = parse_qs(asked.query).get("after", [""])[0]
                send(handler, "application/json", self._state_after(int(known) if known.isdecimal() else 0))
            elif what == "":
                send(handler, "text/html; charset=utf-8", self._page)
            else:
                handler.send_error(404)

    def _state_after(self, number: int) -> bytes:
        """Wait for a newer state than the one with this number, for a while."""
        with self._new:
            self._new.wait_for(lambda: self._ended or self._number > number, _WAIT_S)
            return self._state

    def _end(self) -> None:
        with self._new:
            self._ended = True
            self._new.notify_all()


def _own_address() -> str:
    """Address of this machine in its network, as a phone reaches it."""
    import socket

    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing: only asks which way it would go
        return str(probe.getsockname()[0])
    return socket.gethostname()


@contextlib.contextmanager
def serving(port: int, host: str = "127.0.0.1") -> Iterator[Show]:
    """Serve the page while the block lasts; OSError where the port is taken or the host is not this machine's."""
    show = Show(host)
    with server.serving(show._answer, port, host) as show.port:
        try:
            yield show
        finally:
            show._end()
