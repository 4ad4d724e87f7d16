"""Commands run in children of one process that has loaded all libraries: some milliseconds a run, not half a second.

That process has drawn nothing and started no thread, so its children are as good as new.
"""

import atexit
import contextlib
import fcntl
import functools
import gc
import importlib
import json
import os
import pkgutil
import resource
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import traceback
from pathlib import Path

HANG_S = 1800
"""s; a process that takes longer hangs. A test measures no wall time: on a busy machine everything takes longer."""
_LOADED_LATE = [
    "cv2",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "moderngl",
    "onnxruntime",
    "orjson",
    "scipy.optimize",
    "scipy.special",
    "soundfile",
    "trimesh",
]
COMMANDS = ["avsim-scene", "avsim-audio", "avdetect-audio", "avdetect-video", "avfuse", "aveval", "avcalib", "avview"]
_SHIM = """\
import array, json, os, signal, socket, sys
name, *args = sys.argv
request = {"command": os.path.basename(name), "args": args, "cwd": os.getcwd(), "env": dict(os.environ)}
reply, its_reply = os.pipe()
rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [0, 1, 2, its_reply]))
socket.socket(fileno=int(os.environ["AVCLI_NURSERY"])).sendmsg([json.dumps(request).encode()], [rights])
os.close(its_reply)
answer = open(reply)
child = int(answer.readline())
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, frame: os.kill(child, number))
os.close(0), os.close(1)
status = int(answer.readline())
os._exit(status if status >= 0 else 128 - status)
"""


def run_forked(
    command: str, *args: object, stdin: bytes = b"", cwd: Path | None = None, largest_file: int | None = None
) -> subprocess.CompletedProcess:
    """Run a command's own main in a process of its own; stdout is bytes, stderr text.

    Args:
        command: "avfuse", the name of a module beside this one that has a `main`, or the path of a program in Python.
        args: of its command line.
        stdin: content of its standard input, a pipe.
        cwd: its directory, by default this process's.
        largest_file: bytes; a write beyond it fails, as on a full disk.
    """
    ours, its = zip(*(os.pipe() if written else os.pipe()[::-1] for written in (False, True, True)), strict=True)
    reply, its_reply = os.pipe()
    request = {"command": command, "args": [str(arg) for arg in args], "cwd": str(cwd or os.getcwd()),
               "env": dict(os.environ), "largest_file": largest_file}  # fmt: skip
    socket.send_fds(_nursery()[0], [json.dumps(request).encode()], [*its, its_reply])
    for descriptor in (*its, its_reply):
        os.close(descriptor)
    read = [b"", b""]

    def reading(number: int) -> None:
        with open(ours[number + 1], "rb") as stream:
            read[number] = stream.read()

    def writing() -> None:
        with contextlib.suppress(BrokenPipeError), open(ours[0], "wb") as stream:
            stream.write(stdin)

    threads = [threading.Thread(target=writing), *(threading.Thread(target=reading, args=(n,)) for n in (0, 1))]
    for thread in threads:
        thread.start()
    with open(reply, "rb") as stream:
        child = int(stream.readline())
        if not select.select([stream], [], [], HANG_S)[0]:
            os.kill(child, signal.SIGKILL)
            raise AssertionError(f"{command} hangs")
        status = int(stream.readline())
    for thread in threads:
        thread.join()
    return subprocess.CompletedProcess([command, *args], status, read[0], read[1].decode())


def write_shims(folder: Path) -> tuple[dict[str, str], int]:
    """Write one small program for each command, so that a shell runs the commands as `run_forked` does.

    Returns:
        The environment whose PATH finds them first, and a descriptor that the shell must inherit.
    """
    descriptor = fcntl.fcntl(_nursery()[0].fileno(), fcntl.F_DUPFD, 200)
    folder.mkdir(parents=True, exist_ok=True)
    for command in COMMANDS:
        (folder / command).write_text(f"#!{sys.executable} -IS\n{_SHIM}")
        (folder / command).chmod(0o755)
    path = f"{folder}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "AVCLI_NURSERY": str(descriptor)}, descriptor


@functools.cache
def _nursery() -> tuple[socket.socket, subprocess.Popen]:
    """Start the process whose children the commands are; it ends when the socket to it is closed."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = subprocess.Popen(
        [sys.executable, __file__, str(its.fileno())], pass_fds=[its.fileno()], stdin=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    its.close()
    atexit.register(_close, ours, process)
    return ours, process


def _close(ours: socket.socket, process: subprocess.Popen) -> None:
    ours.close()
    process.terminate()  # a command that was given a copy of the socket may still hold it
    process.wait()


def _serve(requests: socket.socket) -> None:
    avcli = importlib.import_module("avcli")
    names = [module.name for module in pkgutil.walk_packages(avcli.__path__, "avcli.")]
    for name in [name for name in names if not name.endswith("__main__")]:
        with contextlib.suppress(ModuleNotFoundError):  # what an extra is needed for
            importlib.import_module(name)
    importlib.import_module("avcli.formats.media").quiet_decoders()  # OpenCV asks once, when it is loaded
    for name in _LOADED_LATE:
        with contextlib.suppress(ModuleNotFoundError):  # likewise
            importlib.import_module(name)
    gc.freeze()
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake)
    replies: dict[int, int] = {}
    while True:
        ready = select.select([requests, woken], [], [])[0]
        if woken in ready:
            os.read(woken, 4096)
            for child in list(replies):
                done, status = os.waitpid(child, os.WNOHANG)
                if done:
                    reply = replies.pop(child)
                    os.write(reply, b"%d\n" % os.waitstatus_to_exitcode(status))
                    os.close(reply)
        if requests in ready:
            message, descriptors, _, _ = socket.recv_fds(requests, 1 << 20, 4)
            if not message:
                return
            child = os.fork()
            if child == 0:
                _run(descriptors[:3], **json.loads(message))
            for descriptor in descriptors[:3]:
                os.close(descriptor)
            replies[child] = descriptors[3]
            os.write(descriptors[3], b"%d\n" % child)


def _run(files, command, args, cwd, env, largest_file=None):
    status = 99
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for number, descriptor in enumerate(files):
            os.dup2(descriptor, number)
        os.closerange(3, 1024)
        sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", 1, errors="backslashreplace", closefd=False)
        os.chdir(cwd)
        os.environ.clear()
        os.environ.update(env)
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        sys.argv = [command, *args]
        if command.endswith(".py"):
            sys.path.insert(0, str(Path(command).parent))
            runpy.run_path(command, run_name="__main__")
        else:
            module = f"avcli.commands.{command.replace('-', '_')}" if command.startswith("av") else command
            importlib.import_module(module).main()
        status = 0
    except SystemExit as end:
        status = end.code or 0
        if isinstance(status, str):  # what Python does with it
            print(status, file=sys.stderr)
            status = 1
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
