"""What the pages that this machine serves have in common: who may read them, and how they answer."""

import ipaddress
from http.server import BaseHTTPRequestHandler


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
