"""Merging by the wall clock: sensors that fall silent are left behind, and nothing is held longer than it must be."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from avcli.formats.records import Detections
from avcli.tracking.merging import JUMP, PATIENCE, SAME, Key, Merger, Stream, tells_rate

SLACK = 0.02  # s, in which what has been sent arrives


@dataclass
class LiveStream(Stream):
    """One sensor whose records come in order, so that a gap is not waited for.

    Attributes:
        reach: s, a longer gap may be a wrong time: it is believed when further records agree.
        steady: how often in a row the step was the usual one.
    """

    reach: float = 1.0
    steady: int = 0

    def take(self, time: float) -> None:
        """Note a record's time."""
        gap = time - self.complete
        if gap > max(self.reach, 2.5 * self.step):
            super().take(time)
            return
        self.waiting.clear()
        if gap > SAME:
            usual = abs(gap - self.step) < 0.25 * self.step
            self.steady = self.steady + 1 if usual else 0
            self.step = self.step if usual else gap
            self.complete = self.latest = time

    def delivered(self) -> float:
        """Return the time in s before which no further record is expected: of a steady sensor, half a step later."""
        return self.complete + (self.step / 2 if self.steady >= PATIENCE else 2 * SAME)


class LiveMerger(Merger):
    """Merges records as they come; what it yields depends on when they come.

    A step closes as soon as every sensor that is present has delivered for it. A sensor that has been quiet for
    `max_wait` of wall time, or has lagged for so long as much behind the newest record of any sensor, is absent: it is
    not waited for until it speaks again. While all are absent, the clock goes on with the wall.

    Call `steps` with an event of None whenever `due` seconds have gone by without another.
    """

    streams: dict[Key, LiveStream]  # type: ignore[assignment]  # `_stream` makes them

    def __init__(
        self,
        sources: Sequence[str],
        rate: float | None = None,
        max_wait: float = 1.0,
        *,
        say: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin without records.

        Args:
            sources, rate, say: as `Merger` has them.
            max_wait: s of wall time.
            clock: returns the wall time in s; it never goes back.
        """
        super().__init__(sources, rate, max_wait, one_sensor=True, say=say)
        self.clock, self.start = clock, clock()
        self.spoke = math.inf  # wall time in s of the first record
        self.heard: dict[Key, float] = {}  # wall time in s of the latest record
        self.behind: dict[Key, float] = {}  # wall time in s since when a sensor lags
        self.absent: set[Key] = set()
        self.unheard: set[int] = set()  # sources without any record that are not waited for any more

    def push(self, source: int, sensor: str, time: float, detections: Detections) -> None:
        """Take one record that has just come, as `Merger.push` does."""
        key = source, sensor
        stream = self.streams.get(key)
        if stream and key in self.absent:
            stream.complete = stream.latest = max(stream.complete, time)
            stream.steady = 0
        doubtful = bool(stream and stream.waiting)
        super().push(source, sensor, time, detections)
        self.heard[key] = self.clock()
        self.spoke = min(self.spoke, self.heard[key])
        if stream and doubtful and not stream.waiting and stream.complete == time:
            wrong = [r for r in self.records if r[1:3] == (sensor, source) and r[0] > time]
            if wrong:
                self.say(f"sensor {sensor!r}: a record with a time far ahead of the others was ignored")
                self.records = [r for r in self.records if not (r[1:3] == (sensor, source) and r[0] > time)]
                self.last = max((r[0] for r in self.records), default=time)

    def end(self, source: int) -> None:
        """Note that a source has ended."""
        super().end(source)
        for key in [key for key in self.heard if key[0] == source]:
            del self.heard[key]
            self.behind.pop(key, None)
            self.absent.discard(key)

    def watch(self, *, idle: bool) -> None:
        """Note which sensors are present, and tell the user of those that are not waited for.

        None of them becomes absent unless the merger is idle: their records may have arrived while others were used.
        """
        now = self.clock()
        quiet = {key for key, heard in self.heard.items() if now - heard >= self.max_wait}
        newest = max((s.complete for key, s in self.streams.items() if key not in quiet), default=-math.inf)
        behind = [key for key, s in self.streams.items() if newest - s.complete > self.max_wait + SAME]
        self.behind = {key: self.behind.get(key, now) for key in behind}
        lagging = {key for key, since in self.behind.items() if now - since >= self.max_wait} - quiet
        absent = quiet | lagging if idle else (quiet | lagging) & self.absent
        for key in sorted(absent - self.absent):
            how = "has been quiet for" if key in quiet else "lags"
            self.say(
                f"sensor {key[1]!r} {how} more than {self.max_wait:g} s (--max-wait); its records are not waited for"
            )
        for key in sorted(self.absent - absent):
            self.say(f"sensor {key[1]!r} is back; its records are waited for again")
        self.absent = absent
        for source in sorted(self._without_record() - self.unheard):
            if idle and now - self.start >= self.max_wait:
                self.unheard.add(source)
                name = self.sources[source]
                self.say(f"{name} has no record after {self.max_wait:g} s (--max-wait); it is not waited for")

    def horizon(self) -> float:
        """Return the time in s before which no step is waited for any more."""
        if not self.open:
            return math.inf
        now = self.clock()
        if not self.began and now < self._rate_due():
            return -math.inf
        if self._without_record() - self.unheard:
            return -math.inf
        if not self.streams:  # the sources that spoke have ended, and the others are not waited for
            return self.last + 2 * SAME
        present = [s.delivered() for key, s in self.streams.items() if key not in self.absent]
        return min(present) if present else self._gone_by(now)

    def due(self) -> float | None:
        """Return the wall time in s after which a step can close without a further event; None: never."""
        if not self.open or math.isinf(self.max_wait):
            return None
        now = self.clock()
        times = [at for one in (self.heard, self.behind) for key, at in one.items() if key not in self.absent]
        if self._without_record() - self.unheard:
            times.append(self.start)
        waits = [at + self.max_wait - now for at in times]
        if not self.began and now < self._rate_due() < math.inf:
            waits.append(self._rate_due() - now)
        if not waits and self.streams:
            waits = [self._time(self.tick) - self._gone_by(now)]
        return max(min(waits), 0.0) + SLACK if waits else None

    def _gone_by(self, now: float) -> float:
        """Time in s of the records that would have come `max_wait` ago, had the sensors not fallen silent."""
        newest = max(stream.complete for stream in self.streams.values())
        return newest + now - max(self.heard.values()) - self.max_wait

    def _rate_due(self) -> float:
        """Wall time in s up to which the rate may yet show: longer where a sensor has steps, but not enough of them."""
        steps = [] if self.rate is not None else self._steps()
        if self.rate is not None or tells_rate(steps):
            return -math.inf
        return self.spoke + JUMP if steps else self.start + self.max_wait

    def _without_record(self) -> set[int]:
        return self.open - {source for source, _ in self.streams}

    def _end(self) -> float:
        return math.inf if self.open else super()._end()

    def _present(self) -> Iterable[Key]:
        return self.streams.keys() - self.absent

    def _ignore(self, key: Key, count: int = 1) -> None:
        if not count:
            return
        if self.clock() - self.heard.get(key, -math.inf) >= self.max_wait:
            return  # nobody waited for the first record of a sensor, or for the first after a silence
        if key[1] not in self.late:
            self.say(f"sensor {key[1]!r}: records come too late and are ignored")
        super()._ignore(key, count)

    def _stream(self, time: float) -> LiveStream:
        return LiveStream(time, time, 1.0 / self.rate if self.rate else math.inf, reach=self.max_wait)
