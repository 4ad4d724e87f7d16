"""One writer of an experiment directory: its lock, and the files of earlier runs that it removes."""

import contextlib
import errno
import fcntl
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

_TIME = r"-?\d+\.\d{10}"

PICTURES = {
    "video/rgb": re.compile(rf"RGB_frame_{_TIME}\.(png|npy)"),
    "video/depth": re.compile(rf"Depth_(frame_{_TIME}\.(png|npy)|background\.png)"),
    "video/masks": re.compile(rf"Mask_frame_{_TIME}\.png"),
}
"""The pictures that avsim-scene writes: folder in the experiment -> their names."""
SOUND = {"audio/wav": re.compile(rf"multichannel_audio_{_TIME}\.(wav|flac)")}
"""The sound files that avsim-audio writes: folder in the experiment -> their names."""


class Busy(ValueError):
    """Another process is writing into the experiment directory."""


class Linked(ValueError):
    """Files of an earlier run would be removed through a symbolic link."""


@contextlib.contextmanager
def only_writer(directory: Path, command: str) -> Iterator[None]:
    """Make an experiment directory and hold a command's lock on it: no second run of the command can write there.

    The kernel releases the lock when the process dies. Another command has a lock of its own, so that avsim-scene and
    avsim-audio can write into one directory at once. A file system without locks is used without one.

    Args:
        directory: of the experiment.
        command: that writes.

    Raises:
        Busy: another process holds the lock; the message names it by its process ID.
        OSError: the directory cannot be made or written to.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f".{command}.lock"
    lock = _locked(path, f"{directory}: {command}")
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is locked: whoever opened it meanwhile finds out that it is gone
        os.close(lock)


def _locked(path: Path, what: str) -> int:
    """Return the open file descriptor of a lock file that this process has locked and whose name still is its own."""
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                pid = os.pread(lock, 20, 0).decode("ascii", "replace").strip()
                raise Busy(
                    f"{what}{f' (PID {pid})' if pid else ''} is writing there; wait for it, or use another directory"
                ) from None
            except OSError as error:
                if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                    raise
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock), os.stat(path)):
                    os.ftruncate(lock, 0)
                    os.write(lock, b"%d\n" % os.getpid())
                    return lock
        except BaseException:
            os.close(lock)
            raise
        os.close(lock)  # the run before removed it between our opening and locking it


def earlier_files(directory: Path, names: Mapping[str, re.Pattern], *, force: bool = False) -> list[Path]:
    """Return the files that earlier runs wrote into an experiment directory.

    Args:
        directory: of the experiment.
        names: folder in it -> names of the files, as PICTURES and SOUND have them; other files are not returned.
        force: also those that are reached through a symbolic link.

    Raises:
        Linked: there are such files behind a symbolic link, which may belong to another experiment.
    """
    found = []
    for folder, name in names.items():
        place = directory / folder
        if not place.is_dir():
            continue
        files = [path for path in place.iterdir() if name.fullmatch(path.name)]
        target = place.resolve()
        if files and not force and target != directory.resolve() / folder:
            raise Linked(
                f"{place}: leads by a symbolic link to {target}, where {len(files)} files of an earlier run would be "
                "removed; remove them, if no other experiment needs them, or remove the link"
            )
        found += files
    return found
