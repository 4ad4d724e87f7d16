"""The default localizer: steered response power on a stream, one decision for every time step.

Each step takes one Hann window around the moment at which what was said then passes the microphones. The windows of
the steps before and after are added to it, so that one transform a step serves a window of 0.19 s for talkers who walk
and one of 0.39 s for rooms that echo; the search over place and velocity lets the three agree on a walker.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from avcli.localization import correlation, multilateration, uncertainty
from avcli.localization.array import Array, Decision, time_steps
from avcli.localization.events import Gate, occupancy
from avcli.localization.srp import SteeredResponse


@dataclass(frozen=True)
class Settings:
    """How the steered response is taken; the defaults are what was measured to be best.

    Attributes:
        rate: decisions per second.
        window: s, the length of one Hann window.
        context: s, how far before and after a decision the windows that are added to its own lie; 0 adds none.
        beta: exponent of the phase transform.
        band: (2,) Hz.
        tilt: exponent by which a bin's weight falls with its frequency.
        heights: (2,) m, where mouths are.
        cell, resolution: m, largest edge of a coarse and of a finest cell.
        keep: cells that go on to the next level of the search.
        max_speakers: most talkers in one decision.
        max_speed: m/s, the fastest that a talker walks along x or y.
        occupancy: least share of the band's bins within 40 dB of the strongest; a tone has less.
        false_alarm: probability that a decision on noise alone reports something.
        min_score: least probability of being right that is reported.
    """

    rate: float = 10.0
    window: float = 0.186
    context: float = 0.1
    beta: float = 1.0
    band: tuple[float, float] = (80.0, 8000.0)
    tilt: float = 0.25
    heights: tuple[float, float] = (0.8, 2.0)
    cell: float = 0.25
    resolution: float = 0.02
    keep: int = 24
    max_speakers: int = 2
    max_speed: float = 1.6
    occupancy: float = 0.03
    false_alarm: float = 0.01
    min_score: float = 0.5


@dataclass(frozen=True)
class _Window:
    """One window: its GCC (pairs, lags), None where nothing sounds, and which channels (m,) are good."""

    gcc: np.ndarray | None
    good: np.ndarray | None = None
    energy: float = 0.0
    occupancy: float = 0.0
    notices: tuple[str, ...] = ()


class SteeredLocalizer:
    """Steered response power for one array.

    Args:
        array: the microphones and the room.
        settings: see Settings.
        rng: draws the noise from which the detection threshold is set.
    """

    def __init__(self, array: Array, settings: Settings, rng: np.random.Generator):
        array.require(count=4, dimensions=2)
        self.array, self.settings, self.rng = array, settings, rng
        fs = array.sample_rate
        self.size = correlation.fft_size(max(round(settings.window * fs), 16))
        low = np.array([0.0, 0.0, min(settings.heights[0], array.room[2])])
        high = np.array([*array.room[:2], min(settings.heights[1], array.room[2])])
        self.delay = array.mean_delay(low, high)
        first = max(1, int(np.ceil(settings.band[0] * self.size / fs)))
        last = min(self.size // 2 - 1, int(settings.band[1] * self.size / fs))
        if last < first + 16:
            raise ValueError(f"a band of {settings.band} Hz is empty or too narrow at {fs:g} Hz")
        self.bins = slice(first, last + 1)
        self.weight = ((np.arange(first, last + 1) / first) ** -settings.tilt).astype(np.float32)
        # The lag step is as long as the band allows (2.75 steps a period of the highest frequency), whatever the rate.
        transform = correlation.fft_size(int(np.ceil(5.5 * last)))
        self.oversampling = transform / self.size
        self.response = SteeredResponse(
            array.microphones,
            low,
            high,
            fs * self.oversampling / array.speed_of_sound,
            cell=settings.cell,
            resolution=settings.resolution,
            keep=settings.keep,
        )
        # Windows lie `hop` apart: a whole number of them to a decision, close enough for the context to be covered.
        self.windows_a_step = max(1, int(np.ceil(1.0 / (settings.rate * max(settings.context, 1e-9)) - 1e-9)))
        if settings.context <= 0.0:
            self.windows_a_step = 1
        self.hop = 1.0 / (settings.rate * self.windows_a_step)
        self.reach = int(np.floor(settings.context / self.hop + 1e-9))
        self.offsets = np.arange(-self.reach, self.reach + 1) * self.hop
        first_mic, second_mic = self.response.first, self.response.second
        self.baseline = np.linalg.norm(array.microphones[first_mic] - array.microphones[second_mic], axis=1)
        self.gate = Gate(1.0 / self.hop)
        self.outvoted = np.zeros(len(array.microphones), bool)
        self.votes = np.zeros(len(array.microphones))
        self.ballots = 0
        self.null: dict[int, tuple[float, float]] = {}

    @property
    def latency(self) -> float:
        """How long after the sound left the mouth its decision can be made, s."""
        return self.delay + 0.5 * self.size / self.array.sample_rate + self.reach * self.hop

    # --- windows ------------------------------------------------------------------------------------------------------

    def correlate(self, samples: np.ndarray) -> _Window:
        """Correlate one window of samples (size, m): what sounds in it, and which channels cannot be believed."""
        finite = np.isfinite(samples)
        notices = []
        broken = np.zeros(samples.shape[1], bool)
        if not finite.all():
            count = (~finite).sum(axis=0)
            broken |= count > 0.01 * len(samples)
            samples = np.where(finite, samples, 0.0)
            notices += [f"channel {c + 1}: samples that are no number are taken for 0" for c in np.flatnonzero(count)]
        peak = np.abs(samples).max(axis=0)
        scale = peak.max()
        if scale == 0.0:
            return _Window(None, notices=tuple(notices))
        tapered = (samples * (correlation.hann(self.size)[:, None] / scale)).astype(np.float32)
        spectra = np.fft.rfft(tapered, axis=0).T[:, self.bins]
        power = (spectra.real**2 + spectra.imag**2).astype(np.float64)
        level = power.sum(axis=1)
        dead = level <= 1e-6 * np.median(level)
        clipped = (np.abs(samples) >= 0.9999 * peak).mean(axis=0) > 0.005
        clipped &= peak > 0.05
        notices += [f"channel {c + 1} is dead and left out" for c in np.flatnonzero(dead)]
        notices += [f"channel {c + 1} is clipped" for c in np.flatnonzero(clipped)]
        good = ~(dead | broken)
        if (good & ~clipped).sum() >= max(5, 0.5 * len(good)):
            good &= ~clipped
        whitened = correlation.whiten(spectra, self.settings.beta)
        gcc = correlation.gcc(whitened, self.bins, self.size, self.response.half_lags, self.oversampling, self.weight)
        first, second = self.response.first, self.response.second
        twins = (gcc[:, self.response.half_lags] > 0.99) & (self.baseline > 0.01) & good[first] & good[second]
        for pair in np.flatnonzero(twins):
            notices.append(f"channels {first[pair] + 1} and {second[pair] + 1} are the same signal and left out")
            good[first[pair]] = good[second[pair]] = False
        energy = float(np.median(level[~dead])) * float(scale) ** 2 if not dead.all() else 0.0
        use = occupancy(power[~dead].mean(axis=0)) if not dead.all() else 0.0
        return _Window(gcc, good, energy, use, tuple(notices))

    def masked(self, window: _Window) -> np.ndarray | None:
        """Return a window's GCC with the pairs of channels that are left out at 0 and the others scaled up for them."""
        good = window.good & ~self.outvoted
        if good.sum() < 4:
            return None
        if good.all():
            return window.gcc
        kept = good[self.response.first] & good[self.response.second]
        return window.gcc * (kept * (len(kept) / kept.sum())).astype(np.float32)[:, None]

    # --- one decision -------------------------------------------------------------------------------------------------

    def threshold(self, count: int) -> float:
        """Return the response that `count` windows of noise alone exceed with the probability `false_alarm`."""
        location, scale = self.noise(count)
        return location - scale * np.log(-np.log1p(-self.settings.false_alarm))

    def noise(self, count: int) -> tuple[float, float]:
        """Return location and scale of the Gumbel law that the largest response to `count` windows of noise follows.

        The noise is white and independent in each channel; the law is fitted by its moments to 32 draws.
        """
        if count not in self.null:
            hop, draws = round(self.hop * self.array.sample_rate), 32
            channels = len(self.array.microphones)
            noise = self.rng.standard_normal((self.size + hop * (draws + count - 2), channels))
            gccs = [self.correlate(noise[i * hop : i * hop + self.size]).gcc for i in range(draws + count - 1)]
            peaks = [self.response.search(sum(gccs[i : i + count]) / count)[1][0] for i in range(draws)]
            scale = np.std(peaks) * np.sqrt(6.0) / np.pi
            self.null[count] = (float(np.mean(peaks) - np.euler_gamma * scale), float(scale))
        return self.null[count]

    def decide(self, windows: list[_Window], offsets: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Find the talkers in the windows around one moment.

        Args:
            windows: those in which something sounds.
            offsets: (windows,) s of each from the moment.

        Returns:
            (position (3,) m, covariance (3, 3) m², score) of each, the clearest first.
        """
        kept = [(self.masked(window), offset) for window, offset in zip(windows, offsets, strict=True)]
        gccs = [gcc for gcc, _ in kept if gcc is not None]
        offsets = np.array([offset for gcc, offset in kept if gcc is not None])
        found = []
        while gccs and len(found) < self.settings.max_speakers:
            centres, values = self.response.search(sum(gccs) / len(gccs))
            position, velocity, response = self.response.follow(gccs, offsets, centres[0], self.settings.max_speed)
            if response < self.threshold(len(gccs)):
                break
            away = np.hypot(*(centres - position)[:, :2].T) > 0.5
            rival = float(values[away][0]) if away.any() else 0.0
            position, covariance, score = self.judge(gccs, offsets, position, velocity, response, rival, len(found))
            if score >= self.settings.min_score:
                found.append((position, covariance, score))
            else:
                break
            gccs = [
                self.response.notch(gcc, position + velocity * offset, 0.1)
                for gcc, offset in zip(gccs, offsets, strict=True)
            ]
        return found

    def judge(self, gccs, offsets, position, velocity, response, rival, rank):
        """Refine a position below the grid and say how far it may be believed (see `decide`)."""
        steered = self.response
        aligned = steered.aligned(gccs, offsets, position, velocity, reach=6)
        differences, height = steered.differences(aligned, position)
        refined, normal, residual = multilateration.refine(
            position, self.array.microphones, steered.first, steered.second, differences, np.maximum(height, 0.0)
        )
        inside = ((refined >= steered.low) & (refined <= steered.high)).all()
        if inside and np.abs(refined - position).max() < 0.1:
            moved = steered.aligned_response(aligned, position, refined)
            if moved > response:
                position, response = refined, moved
        location, _ = self.noise(len(gccs))
        features = uncertainty.Features(response / location, response / max(rival, 1e-9), residual, rank)
        covariance = uncertainty.covariance(normal, features, steered.low, steered.high)
        return position, covariance, uncertainty.probability(features)

    # --- the stream ---------------------------------------------------------------------------------------------------

    def localize(self, blocks: Iterable[np.ndarray], begin: int = 0, tail: float = 0.0) -> Iterator[Decision]:
        """Yield a decision for every time step of a stream, as soon as its last window is complete.

        Args:
            blocks: (n, m) samples each, one after another.
            begin: the first sample's place on the clock, in samples.
            tail: s at the end in which nobody speaks any more, such as the reverberation after a scene.
        """
        fs, each, reach = self.array.sample_rate, self.windows_a_step, self.reach
        stream = _Stream(begin, len(self.array.microphones))
        windows: dict[int, _Window] = {}
        step = time_steps(begin, 1, fs, self.settings.rate, 0.0).start
        index = step * each - reach

        def place(index: int) -> int:
            return round((index * self.hop + self.delay) * fs) - self.size // 2

        def decided(ended: bool) -> Iterator[Decision]:
            nonlocal step, index
            while step < time_steps(begin, stream.end - begin, fs, self.settings.rate, tail).stop:
                while index <= step * each + reach:
                    if place(index) + self.size > stream.end and not ended:
                        return
                    windows[index] = self.sounding(self.correlate(stream.window(place(index), self.size)))
                    stream.forget(place(index + 1))
                    windows.pop(index - 2 * reach - 1, None)
                    index += 1
                yield self.step(step, windows)
                step += 1

        for block in blocks:
            stream.append(block)
            yield from decided(ended=False)
        yield from decided(ended=True)

    def sounding(self, window: _Window) -> _Window:
        """Return the window, without its GCC where it holds no more than the room's noise or a mere tone."""
        heard = self.gate(window.energy)
        if heard and window.gcc is not None and window.occupancy >= self.settings.occupancy:
            return window
        return _Window(None, notices=window.notices)

    def step(self, step: int, windows: dict[int, _Window]) -> Decision:
        """Decide about one time step from the windows around it."""
        middle = step * self.windows_a_step
        around = [windows[middle + i] for i in range(-self.reach, self.reach + 1)]
        found = []
        if around[self.reach].gcc is not None:
            heard = [i for i, window in enumerate(around) if window.gcc is not None]
            found = self.decide([around[i] for i in heard], self.offsets[heard])
        return Decision.of(step / self.settings.rate, found, around[self.reach].notices)


class _Stream:
    """The last samples of a stream; outside of what was received there is silence."""

    def __init__(self, begin: int, channels: int):
        self.origin = self.end = begin
        self.samples = np.zeros((0, channels))

    def append(self, block: np.ndarray) -> None:
        self.samples = np.concatenate([self.samples, block])
        self.end += len(block)

    def window(self, begin: int, size: int) -> np.ndarray:
        cut = np.zeros((size, self.samples.shape[1]))
        first, last = max(begin, self.origin), min(begin + size, self.end)
        if last > first:
            cut[first - begin : last - begin] = self.samples[first - self.origin : last - self.origin]
        return cut

    def forget(self, before: int) -> None:
        excess = min(before, self.end) - self.origin
        if excess > 0:
            self.samples = self.samples[excess:]
            self.origin += excess
