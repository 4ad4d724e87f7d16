"""A page on 127.0.0.1 that shows the newest picture of a film (multipart/x-mixed-replace, as webcams do)."""

import contextlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

_PAGE = b"""<!doctype html><meta charset="utf-8"><title>avcalib live</title>
<style>body{margin:0;background:#111}img{width:100%;max-height:100vh;object-fit:contain}</style>
<img src="/stream" alt="the camera, with corners and coverage">"""


class Show:
    """Call it with a picture (height, width, 3) uint8 RGB to show that one; `port` is where."""

    def __init__(self, port: int) -> None:
        self._new = threading.Condition()
        self._jpeg, self._number, self._ended = b"", 0, False
        show = self

        class _Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/stream":
                    show._send_stream(self)
                else:
                    self.send_response(200)
                    self.send_header("Content-Type", "text/html")
                    self.end_headers()
                    self.wfile.write(_PAGE)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", port), _Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def __call__(self, picture: np.ndarray) -> None:
        import cv2

        jpeg = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        with self._new:
            self._jpeg, self._number = jpeg, self._number + 1
            self._new.notify_all()

    def _send_stream(self, handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        handler.end_headers()
        sent = 0
        with contextlib.suppress(OSError):
            while True:
                with self._new:
                    while not self._ended and self._number == sent:
                        self._new.wait()
                    if self._ended:
                        return
                    jpeg, sent = self._jpeg, self._number
                handler.wfile.write(b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg))
                handler.wfile.write(jpeg + b"\r\n")

    def _end(self) -> None:
        with self._new:
            self._ended = True
            self._new.notify_all()
        self._server.shutdown()
        self._server.server_close()


@contextlib.contextmanager
def serving(port: int) -> Iterator[Show]:
    """Serve the page while the block lasts; OSError where the port is taken."""
    show = Show(port)
    show._thread.start()
    try:
        yield show
    finally:
        show._end()
