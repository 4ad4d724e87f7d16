"""What the pages that this machine serves have in common: the server, who may read them, and how they answer."""

import contextlib
import ipaddress
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@contextlib.contextmanager
def serving(answer: Callable[[BaseHTTPRequestHandler], None], port: int, host: str = "127.0.0.1") -> Iterator[int]:
    """Serve pages while the block lasts; yields the port.

    Args:
        answer: answers one request, in a thread of its own.
        port: 0: any that is free.
        host: of this machine.

    Raises:
        OSError: the port is taken, or the host is not this machine's.
    """

    class _Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            answer(self)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer((host, port), _Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()


def is_local(host: str) -> bool:
    """Tell whether a host, by name or address, is this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_named(handler: BaseHTTPRequestHandler) -> bool:
    """Tell whether a request names this machine; a page from the network could have its own name lead here."""
    return is_local(handler.headers.get("Host", "").rpartition(":")[0].strip("[]"))


def send(handler: BaseHTTPRequestHandler, kind: str, content: bytes | None, rate_hz: int | None = None) -> None:
    """Answer a request.

    Args:
        handler: of the request.
        kind: the content's media type.
        content: of the answer; None: it follows in parts that the caller writes.
        rate_hz: sample rate, which goes into the header "X-Rate", where the content is sound.

    Raises:
        OSError: whoever asked is gone.
    """
    handler.send_response(200)
    handler.send_header("Content-Type", kind)
    handler.send_header("Cache-Control", "no-store")
    handler.send_header("Referrer-Policy", "no-referrer")
    if rate_hz is not None:
        handler.send_header("X-Rate", str(rate_hz))
    if content is not None:
        handler.send_header("Content-Length", str(len(content)))
    handler.end_headers()
    if content is not None:
        handler.wfile.write(content)
