"""Files that appear whole or not at all."""

import contextlib
import errno
import fcntl
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_LONGEST_NAME = 255
"""bytes; NAME_MAX of the file systems in use."""
_DESCRIPTOR = re.compile(r"/dev/(stdin|stdout|stderr|fd/(\d+))|/proc/self/fd/(\d+)")
_STANDARD = {"stdin": 0, "stdout": 1, "stderr": 2}
_TEMPORARY = re.compile(r"\..*\.(\d+)\.avcli-tmp(\.\w+)?", re.DOTALL)
_swept: set[Path] = set()
_in_progress: dict[Path, Path] = {}
"""The temporary file of each path that is being written."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], suffix: str = "") -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its place when the block ends well.

    Any other end of the block (an error, Ctrl-C) removes the temporary file and leaves an old `path` as it was. Only a
    process that is killed leaves it behind; the next one that writes into the directory removes it. Where `path` is a
    symbolic link, the file that it points at is replaced.

    Args:
        path: where the file is to appear.
        suffix: ends the name of the temporary file, for a writer that looks at it (".mp4").

    Raises:
        OSError: the directory is missing or not writable, or the path is a device, a pipe or a directory (at once,
            before the block runs), the disk is full, or the file is being written by this process already.
    """
    path = Path(path)
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():  # root could replace a device by a file
        raise OSError(errno.EINVAL, "not a file; only a file can be replaced", str(path))
    if path in _in_progress:
        raise FileExistsError(errno.EEXIST, "two outputs have the same name", str(path))
    _sweep(path.parent)
    temporary = _temporary(path, suffix)
    _in_progress[path] = temporary
    try:
        # It is created here, with the user's umask, so that an unwritable directory is known before any work is done.
        with open(temporary, "wb") as stream:
            with contextlib.suppress(OSError):  # some file systems have no locks
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield temporary
            os.replace(temporary, path)
    except BaseException as error:
        _remove(temporary)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # a full disk does not say where it is full
        raise
    finally:
        del _in_progress[path]


def remove_unfinished() -> None:
    """Remove the temporary files of a process that a signal ends, as its last act: the exception that a signal raises
    may fall between the creation of a file and the block that would remove it.
    """
    for temporary in _in_progress.values():
        _remove(temporary)


def is_temporary(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is that of a file that is not finished, by its name."""
    return _TEMPORARY.fullmatch(Path(path).name) is not None


def _remove(temporary: Path) -> None:
    with contextlib.suppress(OSError):
        os.unlink(temporary)


def _temporary(path: Path, suffix: str) -> Path:
    """Name the temporary file of a path: a long name is cut, and its checksum tells it from others."""
    end = f".{os.getpid()}.avcli-tmp{suffix}"
    name = os.fsencode(path.name)
    room = _LONGEST_NAME - len(end) - 1
    if len(name) > room:
        name = name[: room - 9] + f"-{zlib.crc32(name):08x}".encode()
    return path.with_name("." + os.fsdecode(name) + end)


def _sweep(directory: Path) -> None:
    """Remove the temporary files that killed processes left in a directory, once in each process.

    A file is removed where no process has its number any more, and where nobody holds its lock: the process may run on
    another machine that shares the directory, or in another container.
    """
    if directory in _swept:
        return
    _swept.add(directory)
    with contextlib.suppress(OSError):
        for entry in os.scandir(directory):
            found = _TEMPORARY.fullmatch(entry.name)
            if found and entry.is_file(follow_symlinks=False) and not _is_running(int(found[1])):
                with contextlib.suppress(OSError), open(entry.path, "rb") as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(entry.path)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it is another user's
        return True
    return True


@contextlib.contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a stream for a file that appears whole when the block ends well; a device or a pipe is written directly.

    So is what is open already, as /dev/stdout: it may be a file to which the shell appends, and which holds more.

    Raises:
        OSError: it is a directory or not writable (at once), or the disk is full.
    """
    path = Path(path)
    if open_already := _DESCRIPTOR.fullmatch(str(path)):
        name, *numbers = open_already.groups()
        number = _STANDARD[name] if name in _STANDARD else int(next(filter(None, numbers)))
        with open(os.dup(number), "wb") as stream:
            yield stream
        return
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.is_file() and not os.access(path, os.W_OK):  # which replacing it would get round
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    with contextlib.ExitStack() as stack:
        special = path.exists() and not path.is_file()
        with open(path if special else stack.enter_context(replacing(path)), "wb") as stream:
            yield stream


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to `path`, whole or not at all; a device or a pipe is written directly."""
    with writing(path) as stream:
        stream.write(content)
