"""3D-SSL, the thesis's localizer: energy events, β-GCC-PHAT against one reference, the closed form, and a mean.

It needs the whole recording, since its threshold is a share of the largest energy, and it hears one talker at a time.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from avcli.localization import correlation, events, multilateration, uncertainty
from avcli.localization.array import Array, Decision, Talker, put_right, time_steps
from avcli.localization.settings import ClosedFormSettings
from avcli.localization.stream import Block, stretches
from avcli.localization.windows import finite

RT60_S = 0.35
"""s, the reverberation time of the thesis's room."""


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


class ClosedFormLocalizer:
    """3D-SSL for one array.

    Args:
        array: five microphones or more that do not lie in one plane.
        settings: see ClosedFormSettings.
        reverberation_s: T60 in s, from which the least gap between events follows where the settings do not state it.
        law: scores and covariances; the fitted one by default.

    Raises:
        ValueError: the array is too small or flat.
    """

    def __init__(
        self,
        array: Array,
        settings: ClosedFormSettings,
        reverberation_s: float | None = None,
        law: uncertainty.Law | None = None,
    ):
        self.wiring = array.wiring
        array = array.usable
        array.require(count=settings.combination + 1, solid=True)
        self.array, self.settings, self.law = array, settings, law or uncertainty.fitted_law()
        # The thesis gives T60 times the window; we take the window in samples and the product as samples.
        gap = (reverberation_s or RT60_S) * settings.window if settings.min_gap is None else settings.min_gap
        self.gap = max(1, round(gap * array.sample_rate))
        self.latency: float | None = None

    def localize(self, blocks: Iterable[Block], begin: int = 0) -> Iterator[Decision]:
        """Yield a decision for every time step of a recording, once the whole of it is there.

        Args:
            blocks: the recording, piece by piece.
            begin: the first sample's place on the clock, in samples.
        """
        fs, rate = self.array.sample_rate, self.settings.rate
        for first, stretch in stretches(blocks, begin):
            read = list(stretch)
            heard, _, notices = finite(np.concatenate([block.samples for block in read]).T)
            samples = np.ascontiguousarray(heard.T)
            if self.wiring:
                samples = put_right(samples, self.wiring, fs)
            steps = self.steps(samples, first)
            for step in time_steps(first, len(samples), fs, rate, read[-1].tail):
                yield Decision.of(step / rate, [self.mean(steps[step])] if step in steps else [], notices)
                notices = []

    def steps(self, samples: np.ndarray, begin: int = 0) -> dict[int, list[Event]]:
        """Return the events of a recording (n, m) by the time step, k at k / rate seconds, to which each belongs."""
        steps: dict[int, list[Event]] = {}
        for event in self.events(samples):
            time = begin / self.array.sample_rate + event.time
            steps.setdefault(round(time * self.settings.rate), []).append(event)
        return steps

    def events(self, samples: np.ndarray) -> Iterator[Event]:
        """Yield the events of a recording (n, m) from which a position could be had."""
        fs, settings = self.array.sample_rate, self.settings
        size = max(round(settings.window * fs), 16)
        scale = np.abs(samples).max(initial=0.0)
        if scale == 0.0:
            return
        samples = correlation.high_pass(samples / scale, fs, settings.high_pass)
        energy = events.short_time_energy(samples, size)
        loudest = energy.max(axis=1)
        padded = np.pad(samples, ((size, size), (0, 0)))
        for sample in events.crossings(loudest, settings.threshold * loudest.max(), self.gap):
            reference = int(np.argmax(energy[sample]))
            begin = sample + size - size // 2
            window = padded[begin : begin + size] * correlation.hann(size)[:, None]
            event = self.locate(window, sample / fs, reference)
            if event is not None:
                yield event

    def locate(self, window: np.ndarray, time: float, reference: int) -> Event | None:
        """Localize one tapered window (n, m) around `time` s; None where no solution is valid."""
        array, settings = self.array, self.settings
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
        travel = float(np.linalg.norm(position - microphones[reference])) / c
        return Event(time - travel, position, scatter, float(good.mean()))

    def mean(self, found: list[Event]) -> Talker:
        """Return the talker of one time step: the Euclidean mean of its events."""
        position, scatter = self.gathered(found)
        score = self.law.closed_form_probability(*self.reliability(found, scatter), refined=self.settings.refine)
        law = self.law.closed_form_refined if self.settings.refine else self.law.closed_form
        covariance = law.widened * scatter + law.floor**2 * np.eye(3)
        return Talker(position, 0.5 * (covariance + covariance.T), score)

    def gathered(self, found: list[Event]) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean position (3,) m of events, and their scatter (3, 3) m² between and within them."""
        position = np.mean([event.position for event in found], axis=0)
        between = np.mean([np.outer(d, d) for d in (event.position - position for event in found)], axis=0)
        within = np.mean([event.scatter for event in found], axis=0)
        return position, between + within

    def reliability(self, found: list[Event], scatter: np.ndarray) -> tuple[float, float, float]:
        """Return the spread in x and y, m, the share of valid solutions, and the events in a tenth of a second."""
        return (
            float(np.sqrt(np.trace(scatter[:2, :2]))),
            float(np.median([event.valid for event in found])),
            len(found) * self.settings.rate / 10.0,
        )
