"""What the commands with --live share: the stream that may be skipped in, and the words about what was skipped."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from avcli.commands.filter import Session
    from avcli.formats.live import Stoppable


class _Timed(Protocol):
    @property
    def timestamp(self) -> float: ...


T = TypeVar("T", bound=_Timed)


def open_pipe(session: Session, files: tuple[str, ...]) -> tuple[str, Stoppable]:
    """Open the one live source that the user named, standard input where none is; usage error for a regular file.

    Returns:
        Its name in messages, and the stream.
    """
    from avcli.formats.live import Stoppable

    if len(files) > 1:
        session.usage("--live reads one source")
    path = files[0] if files else "-"
    stream = session.open(path)
    name = "<stdin>" if path == "-" else path
    if stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        session.usage(f"{name} is a file; --live is for a source in real time: a pipe, a fifo or a camera")
    return name, Stoppable(stream)


class Skips(contextlib.AbstractContextManager["Skips"]):
    """Prints a warning when skipping begins, and the number at the end, however the command ends.

    Args:
        session: of the command.
        what: is skipped: "pictures".
    """

    def __init__(self, session: Session, what: str):
        self.session, self.what = session, what
        self.taken = self.skipped = self.at_start = 0
        self._warned = False

    def take(self, time: float, skipped: int, *, starting: bool) -> None:
        """Note that one was taken.

        Args:
            time: its time, s.
            skipped: how many were skipped so far.
            starting: whether they were skipped because the program had only just been started.
        """
        self.taken += 1
        if starting:
            self.at_start = skipped
        elif skipped > self.skipped and not self._warned:
            self.session.warn(f"t = {time:.1f} s: too slow for this source; it skips {self.what} to keep up")
            self._warned = True
        self.skipped = skipped

    def __exit__(self, *error: object) -> None:
        if self.skipped:
            start = f", {self.at_start} of them while it started" if self.at_start else ""
            self.session.warn(f"skipped {self.skipped} of {self.taken + self.skipped} {self.what}{start}")


def newest(
    session: Session, stack: contextlib.ExitStack, shots: Iterable[T], stop: Callable[[], None] = lambda: None
) -> Iterator[T]:
    """Yield the newest of the pictures that a live source sends whenever the next is asked for.

    Args:
        session: of the command.
        stack: ends the thread that reads the source.
        shots: the source.
        stop: ends a wait inside `shots`.
    """
    from avcli.formats.live import LiveSource

    skips = stack.enter_context(Skips(session, "pictures"))
    arrivals = stack.enter_context(LiveSource(shots, newest=True, stop=stop))
    for number, shot in enumerate(arrivals):
        skips.take(shot.timestamp, arrivals.skipped, starting=number < 2)  # the first one waits for the detector
        yield shot
