"""3D-SSL, the thesis's localizer: energy events, β-GCC-PHAT against one reference, the closed form, and a mean.

It needs the whole recording, since its threshold is a share of the largest energy, and it hears one talker at a time.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avcli.localization import correlation, events, multilateration, uncertainty
from avcli.localization.array import Array, Decision, time_steps


@dataclass(frozen=True)
class Settings:
    """The parameters of 3D-SSL; the defaults are the thesis's (Table 5.2), or stand in for what it leaves open.

    Attributes:
        rate: time steps per second, to which the events are gathered.
        high_pass: Hz.
        window: s, the length of the Hann windows of energy and correlation.
        threshold: share of the recording's largest short-time energy above which there is an event.
        min_gap: s between two events (T60 in s times the window in samples, read as samples).
        combination: delays in each closed form.
        beta: exponent of the phase transform.
        max_condition: the largest condition number of a system that counts as stable.
        refine: fit each event's range differences by robust maximum likelihood instead of the closed forms' mean.
    """

    rate: float = 10.0
    high_pass: float = 200.0
    window: float = 0.042
    threshold: float = 0.01
    min_gap: float = 0.0147
    combination: int = 4
    beta: float = 0.7
    max_condition: float = 300.0
    refine: bool = False


@dataclass(frozen=True)
class Event:
    """One localized event.

    Attributes:
        time: s, when the sound was emitted.
        position: (3,) m.
        scatter: (3, 3) m², of the valid closed-form solutions about their mean; of the fit, with `refine`.
        valid: share of the closed-form solutions that were valid.
    """

    time: float
    position: np.ndarray
    scatter: np.ndarray
    valid: float


def localize(
    samples: np.ndarray, array: Array, settings: Settings, begin: int = 0, tail: float = 0.0
) -> Iterator[Decision]:
    """Yield a decision for every time step of a recording.

    Args:
        samples: (n, m).
        array: five microphones or more that do not lie in one plane.
        settings: see Settings.
        begin: the first sample's place on the clock, in samples.
        tail: s at the end of the recording in which nobody speaks any more.

    Raises:
        ValueError: the array is too small or flat.
    """
    array.require(count=settings.combination + 1, dimensions=3)
    steps: dict[int, list[Event]] = {}
    for event in localized_events(samples, array, settings):
        steps.setdefault(round((begin / array.sample_rate + event.time) * settings.rate), []).append(event)
    for step in time_steps(begin, len(samples), array.sample_rate, settings.rate, tail):
        found = [fuse(steps[step], settings)] if step in steps else []
        yield Decision.of(step / settings.rate, found)


def localized_events(samples: np.ndarray, array: Array, settings: Settings) -> Iterator[Event]:
    """Yield the events of a recording (see `localize`) from which a position could be had."""
    fs = array.sample_rate
    size = max(round(settings.window * fs), 16)
    scale = np.abs(samples).max(initial=0.0)
    if scale == 0.0:
        return
    samples = correlation.high_pass(samples / scale, fs, settings.high_pass)
    energy = events.short_time_energy(samples, size)
    loudest = energy.max(axis=1)
    gap = max(1, round(settings.min_gap * fs))
    padded = np.pad(samples, ((size, size), (0, 0)))
    for sample in events.crossings(loudest, settings.threshold * loudest.max(), gap):
        reference = int(np.argmax(energy[sample]))
        begin = sample + size - size // 2
        window = padded[begin : begin + size] * correlation.hann(size)[:, None]
        event = locate(window, sample / fs, reference, array, settings)
        if event is not None:
            yield event


def locate(window: np.ndarray, time: float, reference: int, array: Array, settings: Settings) -> Event | None:
    """Localize one tapered window (n, m) around `time` s; None where no solution is valid."""
    microphones, c = array.microphones, array.speed_of_sound
    baselines = np.linalg.norm(microphones - microphones[reference], axis=1)
    delays = multilateration.time_differences(
        window, array.sample_rate, reference, baselines / c * array.sample_rate, beta=settings.beta
    )
    differences = delays * c
    positions, ranges, conditions = multilateration.closed_form(
        microphones, reference, differences, combination_size=settings.combination
    )
    good = multilateration.valid(
        positions, ranges, conditions, max_condition=settings.max_condition, low=np.zeros(3), high=array.room
    )
    if not good.any():
        return None
    position = positions[good].mean(axis=0)
    scatter = np.cov(positions[good].T) if good.sum() > 1 else np.diag(array.room**2 / 12.0)
    others = np.delete(np.arange(len(microphones)), reference)
    first, second = others, np.full(len(others), reference)
    if settings.refine:
        position, normal, residual = multilateration.refine(
            position, microphones, first, second, differences[others], np.ones(len(others))
        )
        if not ((position >= 0.0) & (position <= array.room)).all():
            return None
        scatter = np.linalg.inv(normal / max(residual, uncertainty.FLOOR) ** 2 + np.diag(12.0 / array.room**2))
    travel = np.linalg.norm(position - microphones[reference]) / c
    return Event(time - travel, position, scatter, float(good.mean()))


def fuse(found: list[Event], settings: Settings) -> tuple[np.ndarray, np.ndarray, float]:
    """Return position (3,) m, covariance (3, 3) m² and score of the events of one time step: their Euclidean mean."""
    position = np.mean([event.position for event in found], axis=0)
    between = np.mean([np.outer(d, d) for d in (event.position - position for event in found)], axis=0)
    within = np.mean([event.scatter for event in found], axis=0)
    covariance = between + within
    score = uncertainty.closed_form_probability(
        spread=float(np.sqrt(np.trace(covariance[:2, :2]))),
        valid=float(np.median([event.valid for event in found])),
        events=len(found) * settings.rate / 10.0,
        refined=settings.refine,
    )
    covariance = (2.0 if settings.refine else 1.0) * covariance + uncertainty.CLOSED_FORM_FLOOR**2 * np.eye(3)
    return position, 0.5 * (covariance + covariance.T), score
