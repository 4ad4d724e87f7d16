"""Commands run in a child of this process, which has loaded the libraries already: some milliseconds for each run."""

import contextlib
import importlib
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass

import click

LONGEST_S = 120
"""s; a run that takes longer hangs."""


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit status (negative: the signal), and what it wrote."""

    status: int
    out: bytes
    err: str


def run_forked(
    command: str | click.Command, *args: object, stdin: bytes = b"", largest_file: int | None = None
) -> Ended:
    """Run a command's own main.

    Args:
        command: "avfuse", or a command that is none of ours.
        args: of its command line.
        stdin: content of its standard input.
        largest_file: bytes; a write beyond it fails, as on a full disk.
    """
    if isinstance(command, str):
        command = importlib.import_module(f"avcli.commands.{command.replace('-', '_')}").main
    with contextlib.ExitStack() as stack:
        given, out, err = (stack.enter_context(tempfile.TemporaryFile()) for _ in range(3))
        given.write(stdin)
        given.seek(0)
        child = os.fork()
        if child == 0:
            _run(command, [str(arg) for arg in args], (given, out, err), largest_file)
        status = _waited(child)
        out.seek(0)
        err.seek(0)
        return Ended(status, out.read(), err.read().decode())


def _run(main, args, files, largest_file):
    status = 99
    try:
        for number, file in enumerate(files):
            os.dup2(file.fileno(), number)
        sys.stdin, sys.stdout, sys.stderr = (os.fdopen(n, mode, closefd=False) for n, mode in enumerate("rww"))
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        main.main(args)
    except SystemExit as end:
        status = end.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _waited(child: int) -> int:
    end = time.monotonic() + LONGEST_S
    pause = 0.001
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError("the run hangs")
        time.sleep(pause)
        pause = min(2 * pause, 0.02)
