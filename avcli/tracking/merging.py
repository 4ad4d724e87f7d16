"""The records of several sensors on one clock: in order of time, each time step closed as soon as it is complete."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from avcli.formats.records import Detections
from avcli.numeric import is_regular, rate_of

SAME = 1e-6  # s; nearer times are one
PATIENCE = 3  # records after a gap before the missing one is given up
JUMP = 10.0  # s without any record, or back in time, after which the clock starts anew
FASTEST = 1000.0  # Hz, of a clock that is estimated
FEW, PLENTY = 8, 200  # steps of a sensor that an estimate wants, and with which it waits for no more
LATEST = 1e11  # s; the steps of a clock cannot be told from each other much beyond


Record = tuple[float, str, Detections]
"""Time in s, name of the sensor, what it detected."""

Step = tuple[float, list[Record]]
"""Time in s of a step of the clock, and the records up to it since the step before, in order of time."""

Event = tuple[int, Detections | None] | None
"""The number of a source and its next record, or None at its end; None alone: nothing came for a while."""

Key = tuple[int, str]
"""One sensor: the number of its source, and its name."""


@dataclass
class Stream:
    """One sensor of one source.

    Attributes:
        complete: s, the time up to which no record is missing.
        latest: s, of the records seen.
        step: s, its usual step.
        waiting: s, times of records after a gap.
    """

    complete: float
    latest: float
    step: float
    waiting: list[float] = field(default_factory=list)

    def take(self, time: float) -> None:
        """Note a record's time. A step longer than usual may be a record out of order: it is waited for."""
        self.latest = max(self.latest, time)
        if time <= self.complete:
            return
        self.waiting = sorted({*self.waiting, time})
        if len(self.waiting) > PATIENCE:
            steps = [b - a for a, b in zip([self.complete, *self.waiting[:-1]], self.waiting, strict=True)]
            self.step = max(min((s for s in steps if s > SAME), default=self.step), SAME)
            self.complete = self.waiting.pop(0)
        while self.waiting and self.waiting[0] - self.complete < 1.5 * self.step + SAME:
            step = self.waiting[0] - self.complete
            if step > SAME:
                self.step = max(step, 0.8 * self.step)
            self.complete = self.waiting.pop(0)


class SetBack:
    """Records of sensors whose time went back by more than JUMP, until all sensors have done so.

    One such record is a wrong time. A clock that was set back goes on from there: more than PATIENCE records follow
    each other.

    Attributes:
        records: of each such sensor, (time s, detections) in order of time.
        others: sensors that have sent a record by the old clock since the first of these.
    """

    def __init__(self) -> None:
        self.records: dict[Key, list[tuple[float, Detections]]] = {}
        self.others: set[Key] = set()

    def take(self, key: Key, time: float, before: float, detections: Detections) -> int | None:
        """Take a record where it is of a clock that was set back.

        Args:
            key, time, detections: of the record.
            before: s, the time up to which no record of the sensor is missing.

        Returns:
            How many records of the sensor were none of such a clock after all; None where this one is none, too.
        """
        if time >= before - JUMP:
            if self.records:
                self.others.add(key)
            return None
        self.others.discard(key)
        known = self.records.setdefault(key, [])
        wrong = 0
        if known and not SAME < time - known[-1][0] <= JUMP:
            wrong = len(known)
            known.clear()
        known.append((time, detections))
        return wrong

    def drop(self, key: Key) -> int:
        """Forget the records of a sensor; returns how many."""
        count = len(self.records.pop(key, ()))
        if not self.records:
            self.others.clear()
        return count

    def trim(self, seconds: float) -> Iterator[Key]:
        """Forget what is older than some s; yields the sensor of each such record."""
        for key, known in self.records.items():
            while len(known) > PATIENCE + 1 and known[-1][0] - known[0][0] > seconds:
                known.pop(0)
                yield key

    def is_over(self, key: Key, seconds: float) -> bool:
        """Tell whether a sensor was set back, or sends nothing while another of its source sends for some s."""
        if len(self.records.get(key, ())) > PATIENCE:
            return True
        beside = (known for (source, _), known in self.records.items() if source == key[0])
        return key not in self.others and any(known[-1][0] - known[0][0] >= seconds for known in beside)


class Merger:
    """Merges records by their time into the steps of one regular clock; the result depends on the records alone.

    A step closes when every sensor that is still open has passed it. A record that comes out of order or twice is put
    in its place as long as its step is open; a later one is dropped and counted in `late`. Where the time of all
    sensors goes back by more than JUMP, the steps go back, too.

    Attributes:
        late: sensor name -> number of its records that came too late.
    """

    def __init__(
        self,
        sources: Sequence[str],
        rate: float | None = None,
        max_wait: float = 1.0,
        *,
        one_sensor: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Begin without records.

        Args:
            sources: names of the streams of records.
            rate: Hz of the clock, None: estimated from the records, which are then held back for `max_wait` seconds,
                and until they show it.
            max_wait: s of data by which a sensor may lag behind the others of its source.
            one_sensor: whether each source is known to hold one sensor; else a sole source waits for its second one.
            say: called with a sentence for the user, for each sensor that lags too far behind or was late.
        """
        self.sources, self.open = sources, set(range(len(sources)))
        self.rate, self.max_wait, self.say = rate, max_wait, say
        self.waits_for_second = len(sources) == 1 and not one_sensor
        self.streams: dict[Key, Stream] = {}
        self.records: list[tuple[float, str, int, Detections]] = []
        self.lagging: set[str] = set()
        self.first, self.last = math.inf, -math.inf
        self.origin, self.tick, self.begin, self.began = 0.0, 0, 0, False
        self.late: Counter[str] = Counter()
        self.set_back = SetBack()
        self.since: dict[str, dict[int, float]] = {}  # sensor -> number of each of its sources, s of its first record
        self.shared: set[str] = set()  # sensors of several sources of which that was said

    def steps(self, events: Iterable[Event]) -> Iterator[Step]:
        """Yield each step as soon as it is complete.

        Args:
            events: what the sources deliver, as `in_turn` yields it.
        """
        for event in events:
            if event is not None:
                source, detections = event
                if detections is None:
                    self.end(source)
                else:
                    self.push(source, detections.sensor or "sensor", detections.timestamp, detections)
            self.watch(idle=event is None)
            yield from self.closed()
        for (_, sensor), left in self.set_back.records.items():
            self.late[sensor] += len(left)
        for name, count in sorted(self.late.items()):
            self.say(f"sensor {name!r}: {count} records came too late and were ignored; --max-wait inf waits for all")

    def push(self, source: int, sensor: str, time: float, detections: Detections) -> None:
        """Take one record: number of its source, name of its sensor, time in s.

        Raises:
            ValueError: the time is beyond 1e11 s, so that no clock can count up to it.
        """
        if not abs(time) <= LATEST:
            raise ValueError(
                f"sensor {sensor!r}: the time of a record must be within {LATEST:g} s of 0, not {time:g} s"
            )
        key = source, sensor
        since = self.since.setdefault(sensor, {})
        since.setdefault(source, time)
        if len(since) > 1 and sensor not in self.shared:
            self._say_if_shared(key, time)
        stream = self.streams.get(key)
        if self.began and stream:
            wrong = self.set_back.take(key, time, stream.complete, detections)
            if wrong is not None:
                self._ignore(key, wrong)
                return
            self._ignore(key, self.set_back.drop(key))
        if self.began and time < self._time(self.tick - 1) + SAME:
            self._ignore(key)
        else:
            self.records.append((time, sensor, source, detections))
            self.first, self.last = min(self.first, time), max(self.last, time)
        if stream is None:
            self.streams[key] = self._stream(time)
        else:
            stream.take(time)

    def _say_if_shared(self, key: Key, time: float) -> None:
        """Say so if another source has records of the same sensor at the time: what both find would count twice."""
        source, sensor = key
        for other, first in self.since[sensor].items():
            stream = self.streams.get((other, sensor))
            if other != source and stream and first <= time and stream.latest >= self.since[sensor][source]:
                self.shared.add(sensor)
                names = " and ".join(self.sources[k] for k in sorted((source, other)))
                self.say(
                    f"sensor {sensor!r}: {names} have records of it at the same times; if these are two sensors, "
                    "each needs a name of its own (--sensor of avdetect-video and avdetect-audio)"
                )
                return

    def end(self, source: int) -> None:
        """Note that a source has ended."""
        self.open.remove(source)
        for key in [key for key in self.streams if key[0] == source]:
            del self.streams[key]

    def watch(self, *, idle: bool) -> None:
        """Tell the user of sensors that are no longer waited for; idle: all that has arrived is taken."""
        laggards = self.laggards()
        for name in sorted(laggards - self.lagging):
            self.say(f"sensor {name!r} lags more than {self.max_wait:g} s (--max-wait); its records are not waited for")
        self.lagging |= laggards

    def laggards(self) -> set[str]:
        """Return the names of the sensors that lag too far behind to be waited for."""
        newest: dict[int, float] = {}
        for (source, _), stream in self.streams.items():
            newest[source] = max(newest.get(source, -math.inf), stream.latest)
        return {key[1] for key, s in self.streams.items() if newest[key[0]] - s.latest > self.max_wait + SAME}

    def closed(self) -> Iterator[Step]:
        """Yield the steps that have become complete."""
        yield from self._closed(self.horizon(), self._end())
        if not self.set_back.records:
            return
        gone_on = not self.open and self.set_back.others  # by the old clock, up to the end
        if not gone_on and all(self.set_back.is_over(key, self.max_wait) for key in self._present()):
            yield from self._closed(math.inf, Merger._end(self))
            if self._go_back():
                yield from self._closed(self.horizon(), self._end())
        for key in self.set_back.trim(2 * self.max_wait):
            self._ignore(key)

    def _closed(self, horizon: float, end: float) -> Iterator[Step]:
        """Yield the steps before two times in s: that up to which all is complete, and the end of what has come."""
        if not self.began:
            if not self.records or horizon <= self.first + SAME:
                return
            self._begin()
        while True:
            now = self._time(self.tick)
            if now + SAME >= horizon or now > end:
                return
            known = min((record[0] for record in self.records if record[0] <= horizon), default=now)
            if known - now > JUMP:
                unit = "; are the times in seconds?" if self.tick <= self.begin + 1 else ""
                self.say(
                    f"no sensor has a record for more than {JUMP:g} s; the tracks go on with the next record{unit}"
                )
                self._begin()
                continue
            yield now, self._until(now)
            self.tick += 1

    def _present(self) -> Iterable[Key]:
        """The sensors that are waited for."""
        return self.streams

    def _go_back(self) -> bool:
        """Begin anew with the records of the clock that was set back; tells whether there are enough of them."""
        known = {key: records for key, records in self.set_back.records.items() if len(records) > PATIENCE}
        if not known:
            return False
        begin = min(records[0][0] for records in known.values())
        self.say(f"time goes back from {self.last:.4f} to {begin:.4f} s; the tracks go on from there")
        for key in self.set_back.records.keys() - known.keys():
            self._ignore(key, len(self.set_back.records[key]))
        self.set_back, self.streams = SetBack(), {}
        self.first, self.last, self.began = math.inf, -math.inf, False
        for key, records in known.items():
            for time, detections in records:
                Merger.push(self, *key, time, detections)
            if key[0] not in self.open:
                del self.streams[key]
        return True

    def horizon(self) -> float:
        """Return the time in s before which all steps are complete."""
        if any(not any(key[0] == source for key in self.streams) for source in self.open):
            return -math.inf
        if not self.open:
            return math.inf
        waits = not self.began and self.waits_for_second and len(self.streams) < 2
        if (waits and self.last - self.first < self.max_wait) or not self._is_rate_known():
            return -math.inf
        lagging = self.laggards()
        return min((s.complete for key, s in self.streams.items() if key[1] not in lagging), default=-math.inf)

    def due(self) -> float | None:
        """Return the wall time in s after which a step can close without a further event; None: never."""
        return None

    def _end(self) -> float:
        """Time in s after which there is no step without a further record."""
        return self.last + 1e-3

    def _ignore(self, key: Key, count: int = 1) -> None:
        """Count records that came too late."""
        if count:
            self.late[key[1]] += count

    def _stream(self, time: float) -> Stream:
        return Stream(time, time, 1.0 / self.rate if self.rate else math.inf)

    def _begin(self) -> None:
        rate = self.rate = self.rate or self._estimated_rate()
        times = sorted(record[0] for record in self.records)
        on_grid = [t for t in times if abs(t * rate - round(t * rate)) < 1e-3 * rate]
        self.origin = 0.0 if on_grid else times[0]
        self.tick = self.begin = math.ceil((times[0] - self.origin) * rate - 1e-3 * rate)
        self.began = True
        for stream in self.streams.values():
            stream.step = min(stream.step, 1.0 / rate)

    def _is_rate_known(self) -> bool:
        """Tell whether the rate is stated, or the records show it, or there are too many to wait for more."""
        if self.rate is not None:
            return True
        if self.last - self.first < self.max_wait:
            return False
        return tells_rate(self._steps())

    def _estimated_rate(self) -> float:
        steps = self._steps()
        if not steps:
            return 10.0
        rate = min(rate_of(steps), FASTEST)
        if max(map(len, steps)) > 1 and not is_regular(steps):
            self.say(f"the times of the records do not tell a rate; tracks are written at {rate:.4g} Hz (--rate)")
        return rate

    def _steps(self) -> list[list[float]]:
        """Return the s between the records of each sensor that has some."""
        steps: dict[str, list[float]] = {}
        before: dict[str, float] = {}
        for time, sensor, *_ in sorted(self.records, key=lambda r: r[:3]):
            if sensor in before and time - before[sensor] > SAME:
                steps.setdefault(sensor, []).append(time - before[sensor])
            before[sensor] = time
        return list(steps.values())

    def _time(self, tick: int) -> float:
        return self.origin + tick / (self.rate or 1.0)

    def _until(self, now: float) -> list[Record]:
        ready = sorted((r for r in self.records if r[0] <= now + SAME), key=lambda r: r[:3])
        self.records = [r for r in self.records if r[0] > now + SAME]
        return [(time, sensor, detections) for time, sensor, _, detections in ready]


def tells_rate(steps: Sequence[Sequence[float]]) -> bool:
    """Tell whether the s between the records of each sensor show the rate, or are so many that no more may help."""
    most = max(map(len, steps), default=0)
    return most >= PLENTY or (most >= FEW and is_regular(steps))


def in_turn(sources: Sequence[Iterator[Detections]]) -> Iterator[tuple[int, Detections | None]]:
    """Yield the records of all sources, always from the one that is behind.

    Yields:
        The number of the source and its record; None at its end.
    """
    reached = dict.fromkeys(range(len(sources)), (0, -math.inf))  # how often its time went back, and s since then
    back: dict[int, list[float]] = {source: [] for source in reached}  # s, records since it did so
    while reached:
        source = min(reached, key=lambda k: (reached[k], k))
        detections = next(sources[source], None)
        if detections is None:
            del reached[source]
        else:
            (times, latest), time = reached[source], detections.timestamp
            back[source] = [*back[source][-PATIENCE:], time] if time < latest - JUMP else []
            if len(back[source]) > PATIENCE and back[source] == sorted(back[source]):
                reached[source], back[source] = (times + 1, time), []
            else:
                reached[source] = times, max(latest, time)
        yield source, detections
