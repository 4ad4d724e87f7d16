"""Files that appear whole or not at all."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its place when the block ends well.

    Any other end of the block (an error, Ctrl-C) removes the temporary file and leaves an old `path` as it was.

    Raises:
        OSError: the directory is missing or not writable (at once, before the block runs), or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    # The file is created here, with the user's umask, so that an unwritable directory is known before any work is done.
    os.close(os.open(temporary, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o666))
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # a full disk does not say where it is full
        raise


@contextlib.contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a stream for a file that appears whole when the block ends well; a device or a pipe is written directly.

    Raises:
        OSError: it is a directory or not writable (at once), or the disk is full.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.is_file() and not os.access(path, os.W_OK):  # which replacing it would get round
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    with contextlib.ExitStack() as stack:
        special = path.exists() and not path.is_file()
        with open(path if special else stack.enter_context(replacing(path)), "wb") as stream:
            yield stream


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to `path`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
