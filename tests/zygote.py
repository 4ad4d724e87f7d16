"""Runs the filters as real processes that need not load the libraries: a process that has loaded them forks each one.

The zygote runs nothing itself, so that a fork takes no thread with it (onnxruntime starts one as it loads). A forked
filter goes through the interpreter's own end, as the real program does.
"""

import atexit
import importlib
import json
import os
import pkgutil
import socket
import subprocess
import sys
import tempfile
import threading
from functools import cache
from pathlib import Path

import avcli
from avcli.formats import media

LIBRARIES = ("cv2", "moderngl", "orjson", "scipy.linalg", "scipy.optimize", "scipy.signal", "soundfile")
LONGEST_MESSAGE = 1 << 20


def run(command: list[str], stdin: bytes, cwd: str | None, timeout: float) -> subprocess.CompletedProcess:
    """Run one of our filters; the result's stdout and stderr are bytes, as those of `subprocess.run`."""
    request = json.dumps({"command": command, "cwd": cwd or os.getcwd(), "env": dict(os.environ)}).encode()
    ours, theirs = socket.socketpair()
    reader, writer = os.pipe()
    with ours, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with theirs, os.fdopen(reader) as given:
            socket.send_fds(_zygote(), [request], [given.fileno(), out.fileno(), err.fileno(), theirs.fileno()])
        feeder = threading.Thread(target=_feed, args=(writer, stdin))
        feeder.start()
        ours.settimeout(timeout)
        try:
            status = int(ours.recv(100))
        except TimeoutError:
            raise subprocess.TimeoutExpired(command, timeout) from None
        feeder.join()
        out.seek(0)
        err.seek(0)
        return subprocess.CompletedProcess(command, status, out.read(), err.read())


def _feed(writer: int, content: bytes) -> None:
    try:
        with os.fdopen(writer, "wb") as pipe:
            pipe.write(content)
    except BrokenPipeError:  # the filter ended without reading everything
        pass


@cache
def _zygote() -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in (ours, theirs):
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, LONGEST_MESSAGE)
    with theirs:
        process = subprocess.Popen(
            [sys.executable, __file__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
    atexit.register(process.wait)
    atexit.register(ours.close)
    return ours


# --- in the zygote ----------------------------------------------------------------------------------------------------


def _serve(orders: socket.socket) -> None:
    media.quiet_decoders()  # as every filter does before it loads OpenCV
    ours = (module.name for module in pkgutil.walk_packages(avcli.__path__, "avcli.") if "__main__" not in module.name)
    for name in [*LIBRARIES, *ours]:
        importlib.import_module(name)
    while True:
        message, files, _, _ = socket.recv_fds(orders, LONGEST_MESSAGE, 4)
        if not message:
            return
        if os.fork() == 0:  # this one waits, so that the zygote can go on
            orders.close()
            child = os.fork()
            if child == 0:
                _become(json.loads(message), files)
            for file in files[:3]:
                os.close(file)
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            os.write(files[3], str(status).encode())
            os._exit(0)
        for file in files:
            os.close(file)
        _reap()


def _reap() -> None:
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        pass


def _become(request: dict, files: list[int]) -> None:
    for number, file in enumerate(files[:3]):
        os.dup2(file, number)
    for file in files:
        os.close(file)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = request["command"]
    name = Path(sys.argv[0]).name.replace("-", "_")
    sys.exit(importlib.import_module(f"avcli.commands.{name}").main())


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
