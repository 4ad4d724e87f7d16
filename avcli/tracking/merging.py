"""The records of several sensors on one clock: in order of time, each time step closed as soon as it is complete."""

import math
from collections import Counter
from dataclasses import dataclass, field

SAME = 1e-6  # s; nearer times are one
PATIENCE = 3  # records after a gap before the missing one is given up
JUMP = 3600.0  # s without any record, after which the clock starts anew


@dataclass
class Stream:
    """One sensor of one source: up to where it is complete, the latest time seen, its usual step; times after a gap."""

    complete: float
    latest: float
    step: float
    waiting: list = field(default_factory=list)

    def take(self, time):
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


class Merger:
    """Merges records by their time into the steps of one regular clock.

    A step closes when every sensor that is still open has passed it. A record that comes out of order or twice is put
    in its place as long as its step is open; what comes later is dropped and counted in `late`.
    """

    def __init__(self, sources, rate=None, max_wait=1.0, one_sensor=False):
        """sources: how many streams of records there are. rate: Hz of the clock, None: found from the records, whose
        first `max_wait` seconds are then held back. max_wait: s of data by which a sensor may lag behind the others of
        its source. one_sensor: each source is known to hold one sensor; else a sole source waits for its second one.
        """
        self.open = dict.fromkeys(range(sources))
        self.rate, self.max_wait = rate, max_wait
        self.waits_for_second = sources == 1 and not one_sensor
        self.streams, self.records, self.lagging = {}, [], set()
        self.first, self.last, self.origin, self.tick, self.began = math.inf, -math.inf, None, None, False
        self.late = Counter()

    def push(self, source, sensor, time, item):
        """Take one record: source number, sensor name, time in s, anything."""
        if self.began and time < self._time(self.tick - 1) + SAME:
            self.late[sensor] += 1
        else:
            self.records.append((time, sensor, len(self.records), item))
            self.first, self.last = min(self.first, time), max(self.last, time)
        stream = self.streams.get((source, sensor))
        if stream is None:
            self.streams[source, sensor] = Stream(time, time, 1.0 / self.rate if self.rate else math.inf)
        else:
            stream.take(time)

    def end(self, source):
        """Take note that a source has ended."""
        del self.open[source]
        for key in [key for key in self.streams if key[0] == source]:
            del self.streams[key]

    def laggards(self):
        """Names of the sensors that lag too far behind to be waited for."""
        newest = {}
        for (source, _), stream in self.streams.items():
            newest[source] = max(newest.get(source, -math.inf), stream.latest)
        return {key[1] for key, s in self.streams.items() if newest[key[0]] - s.latest > self.max_wait + SAME}

    def closed(self):
        """Yield (time s, [(time s, sensor, item), ...] in order) of each step that has become complete."""
        horizon = self._horizon()
        if not self.began:
            if not self.records or horizon <= self.first + SAME:
                return
            self._begin()
        while self.tick is not None:
            now = self._time(self.tick)
            if now + SAME >= horizon or now > self.last + 1e-3:
                return
            yield now, self._until(now)
            self.tick += 1
            if self.records and min(self.records)[0] - now > JUMP:
                self.first = min(self.records)[0]
                self._begin()

    def _horizon(self):
        if any(not any(key[0] == source for key in self.streams) for source in self.open):
            return -math.inf
        if not self.open:
            return math.inf
        held = self.rate is None or (self.waits_for_second and len(self.streams) < 2)
        if not self.began and held and self.last - self.first < self.max_wait:
            return -math.inf
        lagging = self.laggards()
        return min((s.complete for key, s in self.streams.items() if key[1] not in lagging), default=-math.inf)

    def _begin(self):
        self.rate = self.rate or self._commonest_rate()
        times = sorted(record[0] for record in self.records)
        on_grid = [t for t in times if abs(t * self.rate - round(t * self.rate)) < 1e-3 * self.rate]
        self.origin = 0.0 if on_grid else times[0]
        self.tick = math.ceil((times[0] - self.origin) * self.rate - 1e-3 * self.rate)
        self.began = True
        for stream in self.streams.values():
            stream.step = min(stream.step, 1.0 / self.rate)

    def _commonest_rate(self):
        steps, before = Counter(), {}
        for time, sensor, *_ in sorted(self.records, key=lambda r: r[:3]):
            if sensor in before and time - before[sensor] > SAME:
                steps[round(time - before[sensor], 6)] += 1
            before[sensor] = time
        return 1.0 / max(steps, key=lambda step: (steps[step], -step)) if steps else 10.0

    def _time(self, tick):
        return self.origin + tick / self.rate

    def _until(self, now):
        ready = sorted((r for r in self.records if r[0] <= now + SAME), key=lambda r: r[:3])
        self.records = [r for r in self.records if r[0] > now + SAME]
        return [(time, sensor, item) for time, sensor, _, item in ready]
