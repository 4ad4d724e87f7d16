"""From detections of several sensors to tracks: `track` at once, `Fusion` step by step."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, cast

import numpy as np

from avcli.formats import features
from avcli.formats.bounds import FARTHEST_M
from avcli.formats.experiment import Config
from avcli.formats.records import Detections, Identified
from avcli.formats.sensors import MICROPHONES, sensor_kind
from avcli.tracking import partial
from avcli.tracking.agreement import Agreement
from avcli.tracking.coverage import Coverage, of_config
from avcli.tracking.live import LiveMerger
from avcli.tracking.merging import Merger, Record, in_turn
from avcli.tracking.model import Corners, Population, Track, unobserved
from avcli.tracking.settings import Sensor, Settings, sensor
from avcli.tracking.smoothing import Delayed
from avcli.tracking.trackers import TRACKERS, Explainable, Learning, Partly, Smoothable

FLOOR, CEILING = 1e-6, 1e8  # m², of variances; a person's position is not defined to better than a millimetre
HEIGHT_VARIANCE = 1e-4  # m², of tracks: people stand on the floor
FEW_RECORDS, GAPPY = 50, 0.01  # records of a sensor, and share of longer gaps, from which some are missing
_MANY_OUTSIDE = 10  # detections outside the room after which the user is told, if most are there

Given = Mapping[str, Mapping[str, Any]]
"""Name of a sensor, or a kind of sensors -> fields of `settings.Sensor` that the user gave; the name wins."""


def track(
    config: Config | None,
    *detections: Iterable[Detections],
    tracker: str = "ms-glmb",
    lag: float = 0,
    settings: Settings | None = None,
    given: Given | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Identified]:
    """Fuse detections of any sensors into tracks, as the command avfuse does.

    Args:
        config: the experiment's config, None: the room, its camera and the rate of the output are not known.
        detections: one or more streams, each of one or more sensors and about in order of time.
        tracker: a name in `trackers.TRACKERS`.
        lag: steps by which each result is late and smoothed by what came since; math.inf: by everything.
        settings: None: the defaults.
        given: what is known of some sensors.
        say: called with sentences for the user.

    Returns:
        One item for each step of a regular clock, with the people who probably exist.

    Raises:
        ValueError: the tracker is not known, cannot smooth, or needs a package that is not installed.

    >>> import numpy as np
    >>> from avcli.formats.records import Detections
    >>> from avcli.tracking import track
    >>> nan, seen = np.full((1, 3, 3), np.nan), []
    >>> for k in range(20):  # a person walks along x at 1 m/s; a camera looks at 10 Hz
    ...     seen.append(Detections(k / 10, "ceiling", np.array([[1 + k / 10, 2, 0]]), nan, np.array([0.9]), "camera"))
    >>> tracks = track(None, seen)
    >>> len(tracks), tracks[-1].ids.tolist(), tracks[-1].positions.round(1).tolist()
    (20, [0], [[2.9, 2.0, 0.0]])
    """
    settings = settings or Settings()
    fusion = Fusion.of(config, settings, tracker, lag, given=given, say=say)
    names = [f"sensor{k}" for k in range(len(detections))]
    merger = fusion.merger(names)
    sources = [named(*one) for one in zip(names, detections, strict=True)]
    out = [one for step in merger.steps(in_turn(sources)) for one in fusion.step(*step)]
    return out + fusion.finish()


def named(name: str, detections: Iterable[Detections]) -> Iterator[Detections]:
    """Yield detections with a name for the sensor of those that have none."""
    for one in detections:
        yield one if one.sensor else replace(one, sensor=name)


class Fusion:
    """A tracker with its sensors, its output delay and its numbering of people, for use record by record.

    >>> import numpy as np
    >>> from avcli.formats.records import Detections
    >>> fusion = Fusion(Settings(stay=20.0))
    >>> nan, here = np.full((1, 3, 3), np.nan), np.array([[2.0, 1.0, 0.9]])
    >>> for k in range(3):
    ...     seen = Detections(k / 10, "ceiling", here, nan, np.array([0.9]), "camera")
    ...     (tracks,) = fusion.step(k / 10, [(k / 10, "ceiling", seen)])
    >>> tracks.timestamp, tracks.ids.tolist(), tracks.positions.round(2).tolist()
    (0.2, [0], [[2.0, 1.0, 0.0]])

    Attributes:
        tracker: the filter.
        outside: number of detections of each sensor that were ignored because they lie outside the room.
        stated: whether all detections of each sensor stated a covariance.
        spans: s, times of the first and the last record of each sensor.
        steps: number of steps, of those with detections, and of those with people.
        doubted: whether the user was told of detections that are nobody, or of features that are not used.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        tracker: str = "ms-glmb",
        lag: float = 0,
        *,
        population: Population | None = None,
        kinds: Mapping[str, str] | None = None,
        given: Given | None = None,
        coverage: Mapping[str, Coverage] | None = None,
        margin: float | None = None,
        explain: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Begin without people and sensors.

        Args:
            settings: None: the defaults.
            tracker: a name in `trackers.TRACKERS`.
            lag: steps of delay, math.inf: all tracks come at the end.
            population: how people come, move, stay and leave; None: as the settings say, in a room of unknown size.
            kinds: sensor name -> kind, as config.json has them.
            given: what is known of some sensors.
            coverage: name of a sensor, or a kind of sensors -> where it detects people; the name wins.
            margin: m beyond the area where detections are still used, None: everywhere.
            explain: keep an account of every record, see `accounts`.
            say: called once for each sensor whose kind is guessed, with a sentence for the user.

        Raises:
            ValueError: the tracker is not known, or cannot smooth or explain, or needs a package.
        """
        if tracker not in TRACKERS:
            raise ValueError(f"the tracker {tracker!r} is not known; there are {', '.join(TRACKERS)}")
        self.settings, self.margin = settings or Settings(), margin
        self.population = population or Population.of(self.settings)
        self.kinds, self.given, self.coverage, self.say = kinds or {}, given or {}, coverage or {}, say
        self.entry = TRACKERS[tracker]
        self.tracker = self.entry.make(self.settings, self.population, lag > 0, explain)
        if explain and not isinstance(self.tracker, Explainable):
            raise ValueError(f"the tracker {tracker} cannot explain its records")
        self._news = self.tracker.news if isinstance(self.tracker, Learning) else None
        self.delayed = None
        if lag:
            if not isinstance(self.tracker, Smoothable):
                raise ValueError(f"the tracker {tracker} cannot smooth; its lag must be 0")
            self.delayed = Delayed(self.tracker, lag)
        self._origins: list[tuple[float, float]] = []  # tracker's time in s from which on, and the time of its 0, in s
        self._now, self._period = 0.0, 0.1  # tracker's time of the last step, and since the one before, in s
        self.shown = -math.inf  # tracker's time of the last output
        self.numbers: dict[int, int] = {}
        self.ears: list[str] = []  # names of the microphones
        self.outside: Counter[str] = Counter()
        self.stated: dict[str, bool] = {}
        self.spans: dict[str, tuple[float, float]] = {}
        self.doubted = False
        self._empty: Counter[str] = Counter()  # records of each sensor that find nobody
        self._gaps: dict[str, Counter[int]] = {}  # of each sensor: ms between its records -> how often
        self.steps = {"all": 0, "detections": 0, "people": 0}
        self._agreement = Agreement()
        self._inside: Counter[str] = Counter()
        self._astray: set[str] = set()  # sensors of which it was said that most of their detections lie outside
        self.rate = self.settings.rate  # Hz of the output, None: that of the records
        self._notes: list[str] = []

    @classmethod
    def of(
        cls,
        config: Config | None,
        settings: Settings,
        tracker: str = "ms-glmb",
        lag: float = 0,
        *,
        given: Given | None = None,
        explain: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> Fusion:
        """Make a fusion for an experiment: its room, its camera and its sensors are those of the config.

        Args:
            config: None: none of them is known.
            settings, tracker, lag, given, explain, say: see `Fusion`.
        """
        if config is None:
            return cls(settings, tracker, lag, given=given, explain=explain, say=say)
        x, y, _ = config.room.dimensions.tolist()
        population = Population.of(settings, (x, y))
        coverage, notes = of_config(config, population.area) if settings.hidden else ({}, [])
        fusion = cls(
            settings,
            tracker,
            lag,
            population=population,
            kinds=config.sensors,
            given=_with_heights(config, given or {}),
            coverage=coverage,
            margin=settings.room_margin,
            explain=explain,
            say=say,
        )
        fusion.rate = settings.rate or config.frame_rate_hz
        fusion._notes += notes
        return fusion

    def merger(self, sources: Sequence[str], *, one_sensor: bool = False) -> Merger:
        """Return what merges streams of records, see `Merger`, for `step`."""
        return Merger(sources, self.rate, self.settings.max_wait, one_sensor=one_sensor, say=self.say)

    def live_merger(self, sources: Sequence[str]) -> LiveMerger:
        """Return what merges streams of records by the wall clock, see `LiveMerger`, for `step`."""
        return LiveMerger(sources, self.rate, self.settings.max_wait, say=self.say)

    def notes(self) -> list[str]:
        """Return sentences for a user who wants to know more."""
        ignored = f"{self.outside.total()} detections outside the room were ignored (--room-margin)"
        return self._notes + [ignored] * bool(self.outside)

    def step(self, time: float, records: Sequence[Record]) -> list[Identified]:
        """Take in all records of one time step.

        Args:
            time: s.
            records: (time s, sensor name, detections) in order of time, not later than `time`.

        Returns:
            The tracks of the steps that are due: without lag those of this step.
        """
        self.steps["all"] += 1
        self.steps["detections"] += any(len(one) for _, _, one in records)
        begin = min([time, *[at for at, _, _ in records]])
        if not self._origins:
            self._origins.append((-math.inf, begin))  # nothing is before the tracker's time 0
        elif time - self._origins[-1][1] < self._now:  # a clock was set back; people have not gone meanwhile
            self._origins.append((self._now + self._period, begin - self._now - self._period))
        origin = self._origins[-1][1]
        now = round(time - origin, 6)
        self._now, self._period = now, min(now - self._now, self._period) or self._period
        looks: dict[tuple[float, int], list[Detections]] = {}
        for at, name, one in records:
            first, last = self.spans.get(name, (at, at))
            self._empty[name] += not len(one)
            self._gaps.setdefault(name, Counter())[min(round(1000 * (at - last)), 60_000)] += at > last
            self.spans[name] = min(first, at), max(last, at)
            self._agreement.take(at - origin, name, one.positions)
            looks.setdefault((round(at - origin, 6), self._column(name, one.kind)), []).append(one)
        sensors = (
            self.tracker.sensors
        )  # at one time the exact sensor first: where it sees nobody, a vague one is doubted
        for (at, column), parts in sorted(looks.items(), key=lambda look: (look[0][0], max(sensors[look[0][1]].sigma))):
            self._update(at, sensors[column], parts)
        for text in self._news() if self._news else ():
            self.doubted = True
            self.say(text)
        for text in self._agreement.news(now):
            self.say(text)
        if self.delayed:
            return [self._identified(*due) for due in self.delayed.push(now)]
        return [self._identified(now, self.tracker.tracks(now))]

    def alone(self) -> list[str]:
        """Return the sensors of several whose records have no time in common with those of any other."""
        spans = self.spans.items()
        together = {
            name
            for name, (a, b) in spans
            if any(a <= last and first <= b for one, (first, last) in spans if one != name)
        }
        return sorted(self.spans.keys() - together) if len(self.spans) > 1 else []

    def without_empty(self) -> dict[str, int]:
        """Return the sensors without a record that finds nobody, and how often each has none for longer than usual."""
        found = {}
        for name, gaps in self._gaps.items():
            count = gaps.total()
            if count < FEW_RECORDS or self._empty[name]:
                continue
            ordered = sorted(gaps)
            below = accumulate(gaps[gap] for gap in ordered)
            usual = next(gap for gap, often in zip(ordered, below, strict=True) if 2 * often > count)
            longer = sum(often for gap, often in gaps.items() if gap > 1.5 * usual)
            if longer >= GAPPY * count:
                found[name] = longer
        return found

    def finish(self) -> list[Identified]:
        """Return the tracks of the steps that are left at the end."""
        return [self._identified(*due) for due in self.delayed.finish()] if self.delayed else []

    def state(self) -> dict[str, Any]:
        """Return what was learnt of the room and its sensors, as `restore` takes it and `learnt` writes it."""
        if not isinstance(self.tracker, Learning):
            raise ValueError("the tracker learns nothing")
        return self.tracker.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what an earlier run in the same room has learnt; to be called before the first record.

        Raises:
            ValueError: it was learnt in a room of another size, or the tracker learns nothing.
        """
        if not isinstance(self.tracker, Learning):
            raise ValueError("the tracker learns nothing")
        self.tracker.restore(state)

    def accounts(self) -> list[dict[str, Any]]:
        """Return what each record since the last call meant; labels get the tracks' numbers as `object_id`."""
        if not isinstance(self.tracker, Explainable):
            raise ValueError("the tracker cannot explain its records")
        accounts = self.tracker.accounts()
        for account in accounts:
            account["timestamp"] = self._outside(account["timestamp"])
            for person in account["people"]:
                person["last_seen"] = None if person["last_seen"] is None else self._outside(person["last_seen"])
            for entry in (*account["people"], *account["born"], *account["died"]):
                entry["object_id"] = self.numbers.get(entry["label"])
        return accounts

    def _outside(self, time: float) -> float:
        """Return the time in s of the records at a time of the tracker, which never goes back."""
        return time + next((origin for since, origin in reversed(self._origins) if time > since - 1e-6), 0.0)

    def _column(self, name: str, stated: str | None) -> int:
        """Number of a sensor by its name; a new one is added as its kind says."""
        if name not in self.tracker.column:
            kind, guessed = sensor_kind(name, stated, self.kinds)
            if guessed:
                self.say(
                    f'sensor {name!r}: kind {kind!r} is guessed from its name; state it in "sensors" of config.json'
                )
            if kind == MICROPHONES:
                self.ears.append(name)
            known: dict[str, Any] = {}
            if not self.settings.hidden:
                known["hide"] = 0.0
            else:
                known["coverage"] = self.coverage.get(name, self.coverage.get(kind))
            self.tracker.add(sensor(name, kind, **known, **{**self.given.get(kind, {}), **self.given.get(name, {})}))
        return self.tracker.column[name]

    def _update(self, at: float, model: Sensor, parts: Sequence[Detections]) -> None:
        """Update the tracker with what one sensor found at one time."""
        positions, covariances, scores = parts[0].positions, parts[0].covariances, parts[0].scores
        told = parts[0].features
        if len(parts) > 1:
            positions = np.concatenate([part.positions for part in parts])
            covariances = np.concatenate([part.covariances for part in parts])
            scores = np.concatenate([part.scores for part in parts])
            told = features.joined([part.features for part in parts], [len(part) for part in parts])
        positions, covariances = positions[:, :2], covariances[:, :2, :2]
        shown = None
        if any(one.shows_less() for one in parts):
            positions, covariances, shown = partial.read(parts, positions, covariances, model, self.population)
        where = positions.tolist()
        if not all(abs(x) <= FARTHEST_M and abs(y) <= FARTHEST_M for x, y in where):
            farthest = abs(positions).max()
            raise ValueError(
                f"sensor {model.name!r}: a position must be within {FARTHEST_M:g} m of 0, not {farthest:g} m"
            )
        if self.margin is not None:
            ((x0, y0), (x1, y1)), more = self.population.area, self.margin
            within = [x0 - more <= x <= x1 + more and y0 - more <= y <= y1 + more for x, y in where]
            if not all(within):
                inside = np.array(within)
                if shown is not None:
                    inside |= shown.what != partial.WHOLE
                shown = None if shown is None else shown.take(inside)
                self._ignore(model.name, int((~inside).sum()))
                positions, covariances, scores = positions[inside], covariances[inside], scores[inside]
                told = {name: one.take(inside) for name, one in told.items()}
            self._inside[model.name] += len(positions)
        if len(covariances):
            flat = covariances.reshape(-1, 4).tolist()
            all_stated = all(max(one) > 0 and not math.isnan(sum(one)) for one in flat)
            self.stated[model.name] = self.stated.get(model.name, True) and all_stated
        noise = noise_of(covariances, model.sigma, model.floor, self.population.area)
        if shown is None:
            self.tracker.update(at, model.name, positions, noise, scores, told)
        elif not self.entry.partial:
            names = " or ".join(name for name, entry in TRACKERS.items() if entry.partial)
            raise ValueError(
                f"sensor {model.name!r} has a direction or a range without a position: use --tracker {names}"
            )
        else:
            cast(Partly, self.tracker).update(at, model.name, positions, noise, scores, told, shown)

    def _ignore(self, name: str, count: int) -> None:
        """Count detections outside the room; say once of a sensor that most of its detections are there."""
        self.outside[name] += count
        now = self.outside[name]
        if name not in self._astray and now >= _MANY_OUTSIDE and now > self._inside[name]:
            self._astray.add(name)
            self.say(
                f"sensor {name!r}: {now} of {now + self._inside[name]} detections so far are more than {self.margin:g}"
                " m outside the room of config.json, and are ignored (--room-margin); are they in metres, and counted"
                " from the room's corner?"
            )

    def _identified(self, time: float, tracks: Sequence[Track]) -> Identified:
        """Make the output of tracks at a time since the origin."""
        before, self.shown = self.shown, time
        if self.settings.show == "observed":
            tracks = [one for one in tracks if one.last_seen > before]
        self.steps["people"] += bool(tracks)
        n, numbers, ears = len(tracks), self.numbers, self.ears
        positions, velocities, covariances = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3))
        speaking = [math.nan] * n
        for k, one in enumerate(tracks):
            positions[k, :2], velocities[k, :2], covariances[k, :2, :2] = one.state[:2], one.state[2:], one.cov[:2, :2]
            numbers.setdefault(one.label, len(numbers))
            if ears and one.detectable:
                # a sum of weights may end an ulp above
                speaking[k] = min(max([one.detectable.get(name, 0.0) for name in ears]), 1.0)
        covariances[:, 1, 0], covariances[:, 2, 2] = covariances[:, 0, 1], HEIGHT_VARIANCE
        last = [one.last_seen for one in tracks]
        return Identified(
            timestamp=self._outside(time),
            ids=np.array([numbers[one.label] for one in tracks], np.int64),
            positions=positions,
            speaking=np.array(speaking),
            velocities=velocities,
            covariances=covariances,
            existence=np.array([one.existence for one in tracks]),
            observed=np.array([float(one > before) for one in last]),
            last_seen=np.array([self._outside(one) if math.isfinite(one) else math.nan for one in last]),
        )


def _with_heights(config: Config, given: Given) -> Given:
    """Add to what the user gave of sensors how high the points are that they localize, where config.json says it."""
    keys = {"height_m": "height", "height_sd_m": "height_sd"}
    stated = {
        name: {field: known[key] for key, field in keys.items() if known[key] is not None}
        for name, known in config.known_sensors.items()
    }
    names = {name for name, fields in stated.items() if fields} | given.keys()
    return {name: {**stated.get(name, {}), **given.get(name, {})} for name in names}


def noise_of(covariances: np.ndarray, sigma: tuple[float, float], floor: float, area: Corners) -> np.ndarray:
    """Return measurement noise as the filter needs it, (J, 2, 2) m², positive definite.

    A variance of 0 means that the coordinate was not observed, see `model.unobserved`; who writes 0 for both of a
    position knows no covariance.

    Args:
        covariances: (J, 2, 2) m², NaN where not given.
        sigma: m along x and y, for those.
        floor: m, see `settings.Sensor`.
        area: two corners, m.
    """
    noise = []
    for (xx, xy), (yx, yy) in covariances.tolist():
        xx, yy, cross = xx + floor * floor * (xx > 0), yy + floor * floor * (yy > 0), (xy + yx) / 2
        if math.isnan(xx + yy + cross) or xx == yy == 0:
            xx, yy, cross = sigma[0] ** 2, sigma[1] ** 2, 0.0
        if not (xx and yy):
            cross = 0.0
            xx, yy = (v or unobserved(low, high) for v, low, high in zip((xx, yy), *area, strict=True))
        xx, yy = min(max(xx, FLOOR), CEILING), min(max(yy, FLOOR), CEILING)
        most = 0.999 * math.sqrt(xx * yy)
        cross = min(max(cross, -most), most)
        noise.append(((xx, cross), (cross, yy)))
    return np.array(noise).reshape(-1, 2, 2)
