"""Several pipes read at once, each by a thread of its own, so that none fills up while another is waited for.

Pipes are read only while somebody waits for an item. So a program that is slower than its inputs slows them down, as
any filter does, and what is read ahead is only what one pipe is ahead of another.
"""

from __future__ import annotations

import io
import os
import select
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO, Generic, TypeVar

Item = TypeVar("Item")

SLOW = 2.0  # s of waiting for one pipe after which the user is told
BUFFER = 1 << 16  # bytes


def is_pipe(stream: BinaryIO) -> bool:
    """Tell whether reading from a stream can block: everything but a regular file and bytes in memory."""
    try:
        return not stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
    except (OSError, ValueError):
        return False


def open_fifo(path: str) -> BinaryIO | None:
    """Open a named pipe for reading without waiting for its first writer; None where the path is not a named pipe.

    Raises:
        OSError: the path does not exist or may not be read.
    """
    if not stat.S_ISFIFO(os.stat(path).st_mode):
        return None
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    os.set_blocking(number, True)
    return open(number, "rb", buffering=0)


class _Patient(io.RawIOBase):
    """A pipe that is read while somebody waits; a named pipe has not ended before its first writer has come."""

    def __init__(self, pipe: BinaryIO, wanted: threading.Event) -> None:
        self.pipe, self.wanted = pipe, wanted
        self.poll = select.poll()
        self.poll.register(pipe.fileno(), select.POLLIN)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        self.poll.poll()
        self.wanted.wait()
        return os.readv(self.pipe.fileno(), [buffer])


class Arrivals(Generic[Item]):
    """The items of several pipes, in the order of each and as they come.

    >>> import os
    >>> read, write = os.pipe()
    >>> arrivals = Arrivals(["numbers"], [open(read, "rb", buffering=0)], lambda k, stream: map(int, stream))
    >>> _ = os.write(write, b"1\\n2\\n")
    >>> arrivals.next(), arrivals.next(), arrivals.next(0.01)
    ((0, 1), (0, 2), None)
    >>> os.close(write)
    >>> arrivals.next()
    (0, None)
    """

    def __init__(
        self,
        names: Sequence[str],
        pipes: Sequence[BinaryIO],
        read: Callable[[int, BinaryIO], Iterator[Item]],
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Begin to read.

        Args:
            names: what the user calls the pipes.
            pipes: file objects with a descriptor; what they have buffered is not read.
            read: makes the items of one pipe, called in its thread with the pipe's number and a buffered stream.
            say: called with a sentence for the user, once for each pipe that `of` waits for longer than 2 s.
        """
        self.names, self.say = names, say
        self._wanted, self._changed = threading.Event(), threading.Condition()
        self._arrived: list[deque[tuple[int, Item | Exception | None]]] = [deque() for _ in pipes]  # None: the end
        self._count = 0
        self._slow: set[int] = set()
        for number, pipe in enumerate(pipes):
            threading.Thread(target=self._read, args=(number, pipe, read), daemon=True).start()

    def _read(self, number: int, pipe: BinaryIO, read: Callable[[int, BinaryIO], Iterator[Item]]) -> None:
        with pipe:
            try:
                for item in read(number, io.BufferedReader(_Patient(pipe, self._wanted), BUFFER)):
                    self._put(number, item)
                self._put(number, None)
            except Exception as error:
                self._put(number, error)  # raised where the item is wanted

    def _put(self, number: int, item: Item | Exception | None) -> None:
        with self._changed:
            self._arrived[number].append((self._count, item))
            self._count += 1
            self._changed.notify()

    def next(self, seconds: float | None = None) -> tuple[int, Item | None] | None:
        """Return the number of a pipe and its next item, None at its end; None alone if nothing comes for so long."""
        if not self._wait(lambda: any(self._arrived), seconds):
            return None
        number = min((k for k, arrived in enumerate(self._arrived) if arrived), key=lambda k: self._arrived[k][0][0])
        return number, self._take(number)

    def of(self, number: int) -> Iterator[Item]:
        """Yield the items of one pipe; the others are read meanwhile."""
        while True:
            arrived = self._arrived[number]
            begin = time.monotonic()
            while not self._wait(lambda: bool(arrived), SLOW):  # noqa: B023 - called at once
                if number not in self._slow and len(self.names) > 1 and time.monotonic() - begin >= SLOW:
                    self._slow.add(number)
                    self.say(f"waiting for {self.names[number]}")
            item = self._take(number)
            if item is None:
                return
            yield item

    def _wait(self, ready: Callable[[], bool], seconds: float | None) -> bool:
        with self._changed:
            if ready():
                return True
            self._wanted.set()
            try:
                return self._changed.wait_for(ready, seconds)
            finally:
                self._wanted.clear()

    def _take(self, number: int) -> Item | None:
        _, item = self._arrived[number].popleft()
        if isinstance(item, Exception):
            raise item
        return item
