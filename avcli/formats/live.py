"""Live sources: a thread takes what comes as it comes, so that a slow reader keeps no writer waiting."""

import io
import math
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import BinaryIO, Generic, TypeVar

_PATIENCE = 1.0
"""s that the end waits for the thread; a camera that hangs must not hold it up."""

T = TypeVar("T")


class LiveSource(Generic[T]):
    """The items of a live source, which a thread takes as they come; a context manager and an iterator.

    Args:
        items: the source. The thread reads it to its end, or until the block ends.
        newest: keep the newest item alone; the ones that nobody took before it are skipped.
        stop: is called when the block ends, to end a wait inside `items`.

    Attributes:
        skipped: how many items were skipped.

    The reader comes back after three items have arrived, and takes the last one:

    >>> with LiveSource([1, 2, 3], newest=True) as arrivals:
    ...     arrivals.thread.join()
    ...     list(arrivals), arrivals.skipped
    ([3], 2)
    """

    def __init__(self, items: Iterable[T], *, newest: bool = False, stop: Callable[[], None] = lambda: None):
        self._items, self._newest, self._stop = items, newest, stop
        self._waiting: deque[T] = deque()
        self._changed = threading.Condition()
        self._ended, self._stopped = False, False
        self._error: Exception | None = None
        self.skipped = 0
        self.thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> "LiveSource[T]":
        self.thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped = True
        self._stop()
        self.thread.join(_PATIENCE)

    def __iter__(self) -> Iterator[T]:
        """Yield the items; at the end of the source, raise what it raised."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ended)
                if not self._waiting:
                    break
                item = self._waiting.popleft()
            yield item
        if self._error:
            raise self._error

    def waiting(self, size: Callable[[T], float]) -> float:
        """Return the sum of the sizes of the items that have arrived and that nobody took yet."""
        with self._changed:
            return sum(map(size, self._waiting))

    def _read(self) -> None:
        try:
            for item in self._items:
                with self._changed:
                    if self._newest:
                        self.skipped += len(self._waiting)
                        self._waiting.clear()
                    self._waiting.append(item)
                    self._changed.notify()
                if self._stopped:
                    break
        except Exception as error:
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


class Pace:
    """Takes at most so many a second of what comes, and so many on average, by a clock that nobody sets back.

    What comes up to a quarter of a step early is taken, since a camera's pictures do not come evenly: else one of 10 Hz
    would give 5 of the 10 that are wanted.

    Args:
        rate_hz: how many a second; None: all.
        clock: gives s.
    """

    def __init__(self, rate_hz: float | None, clock: Callable[[], float] = time.monotonic):
        self.step = 1 / rate_hz if rate_hz else 0.0
        self.clock, self.due = clock, -math.inf

    def takes(self) -> bool:
        """Tell whether to take what comes now."""
        now = self.clock()
        if now < self.due - self.step / 4:
            return False
        self.due = max(self.due + self.step, now + self.step / 2)
        return True


class Stoppable(io.RawIOBase):
    """A pipe, fifo or terminal whose reader in another thread can be told to stop waiting.

    Python cannot end while a thread waits in standard input itself.

    Args:
        stream: of which nothing has been read yet.
    """

    def __init__(self, stream: BinaryIO):
        self._stream = stream  # keeps it open
        self._end, self._signal = os.pipe()
        self._poll = select.poll()
        for descriptor in (self._end, stream.fileno()):
            self._poll.register(descriptor, select.POLLIN)

    def readable(self) -> bool:
        """Whether it can be read: yes."""
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]  # typeshed's Buffer has no len
        """Read what is there, or wait for it; 0 bytes at the end, and after `stop`."""
        if any(descriptor == self._end for descriptor, _ in self._poll.poll()):
            return 0
        content = os.read(self._stream.fileno(), len(buffer))
        buffer[: len(content)] = content
        return len(content)

    def stop(self) -> None:
        """Let the stream end for its reader, now."""
        signal, self._signal = self._signal, -1  # the reader wakes at the close, and may stop it too
        if signal >= 0:
            os.close(signal)

    def close(self) -> None:
        """Stop, and give back what the waiting needs."""
        if not self.closed:
            self.stop()
            os.close(self._end)
        super().close()
