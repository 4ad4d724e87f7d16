"""The default localizer: steered response power on a stream, one decision for every time step.

Each step takes one Hann window around the moment at which what was said then passes the microphones. The windows of
the steps before and after are added to it, so that one transform a step serves a window of 0.19 s for talkers who walk
and one of 0.39 s for rooms that echo; the search over place and velocity lets the three agree on a walker.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from avcli.localization import correlation, multilateration, uncertainty
from avcli.localization.array import Array, Decision, time_steps
from avcli.localization.events import Gate, occupancy
from avcli.localization.srp import SteeredResponse
from avcli.numeric import fft_length


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
        separation: m, the least distance in x and y between two talkers.
        max_speed: m/s, the fastest that a talker walks along x or y.
        occupancy: least share of the band's bins within 40 dB of the strongest; a tone has less.
        false_alarm: probability that a decision on noise alone reports something.
        min_score: least probability of being right that is reported.
        candidate: probability that noise alone makes a further peak worth remembering; it is reported if it lasts.
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
    separation: float = 0.5
    max_speed: float = 1.6
    occupancy: float = 0.03
    false_alarm: float = 0.01
    min_score: float = 0.5
    candidate: float = 0.5


@dataclass(frozen=True)
class _Window:
    """One window: its GCC (pairs, lags), None where nothing sounds; the whitened spectra (m, bins) that it is of; which
    channels (m,) are good; which part of a whole window the stream held of it; and how far in s after its middle the
    middle of its energy is: of a talker who walks the window tells where he was then."""

    gcc: np.ndarray | None
    whitened: np.ndarray | None = None
    good: np.ndarray | None = None
    part: float = 1.0
    centre: float = 0.0
    energy: float = 0.0
    occupancy: float = 0.0
    notices: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Noise:
    """The Gumbel law of the largest response to noise, and the standard deviation of a GCC of noise."""

    location: float
    scale: float
    deviation: float

    def threshold(self, false_alarm: float) -> float:
        """Return the response that noise exceeds with this probability."""
        return float(self.location - self.scale * np.log(-np.log1p(-false_alarm)))


@dataclass(frozen=True)
class _Peak:
    """A place (3,) m that is answered; one that is not worth a fit has but a response.

    Attributes as in uncertainty.Features; `velocity` (3,) m/s, `normal` (3, 3) the normal matrix of its range
    differences, and `gccs` those that were left for it by the peaks before.
    """

    position: np.ndarray
    response: float
    agreement: float = 0.0
    support: float = 0.0
    own: float = 1.0
    velocity: np.ndarray | None = None
    normal: np.ndarray | None = None
    residual: float = 0.0
    strongest: float = 1.0
    gccs: np.ndarray | None = None


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
        self.size = fft_length(max(round(settings.window * fs), 16))
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
        transform = fft_length(int(np.ceil(5.5 * last)))
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
        self.kept = float(np.exp(-1.0 / (settings.rate * uncertainty.MEMORY)))  # by one decision of those before it
        # Where, how lasting, how many decisions ago, and with which velocity so far.
        self.before: list[tuple[np.ndarray, float, int, np.ndarray]] = []
        self.null: _Noise | None = None

    @property
    def latency(self) -> float:
        """How long after the sound left the mouth its decision can be made, s."""
        return self.delay + 0.5 * self.size / self.array.sample_rate + self.reach * self.hop

    # --- windows ------------------------------------------------------------------------------------------------------

    def correlate(self, samples: np.ndarray, taper: np.ndarray) -> _Window:
        """Correlate one window of samples (m, size): what sounds in it, and which channels cannot be believed."""
        notices = []
        broken = np.zeros(len(samples), bool)
        peak = np.maximum(samples.max(axis=1), -samples.min(axis=1))
        if not np.isfinite(peak).all():
            finite = np.isfinite(samples)
            count = (~finite).sum(axis=1)
            broken |= count > 0.01 * samples.shape[1]
            samples = np.where(finite, samples, 0.0)
            peak = np.abs(samples).max(axis=1)
            notices += [f"channel {c + 1}: samples that are no number are taken for 0" for c in np.flatnonzero(count)]
        scale = peak.max()
        if scale == 0.0:
            return _Window(None, notices=tuple(notices))
        tapered = (samples * (taper / scale)).astype(np.float32)
        spectra = self.spectra(tapered)
        power = (spectra.real**2 + spectra.imag**2).astype(np.float64)
        level = power.sum(axis=1)
        dead = level <= 1e-6 * np.median(level)
        clipped = peak > 0.05
        if clipped.any():
            clipped &= (np.abs(samples) >= 0.9999 * peak[:, None]).mean(axis=1) > 0.005
        shift = np.abs(samples.mean(axis=1))
        shifted = shift > 0.01
        if shifted.any():
            shifted &= shift > samples.std(axis=1)
        notices += [f"channel {c + 1} is dead and left out" for c in np.flatnonzero(dead)]
        notices += [f"channel {c + 1} is clipped" for c in np.flatnonzero(clipped)]
        good = ~(dead | broken)
        if (good & ~clipped).sum() >= max(5, 0.5 * len(good)):
            good &= ~clipped
        # The band has no constant in it, so that shifted channels still serve where there are too few others.
        spared = (good & ~shifted).sum() >= 4
        what = "is shifted by a constant (DC)" + " and left out" * bool(spared)
        notices += [f"channel {c + 1} {what}" for c in np.flatnonzero(shifted & ~dead)]
        if spared:
            good &= ~shifted
        whitened = correlation.whiten(spectra, self.settings.beta)
        gcc = self.gcc(whitened)
        first, second = self.response.first, self.response.second
        twins = (gcc[:, self.response.half_lags] > 0.99) & (self.baseline > 0.01) & good[first] & good[second]
        for pair in np.flatnonzero(twins):
            notices.append(f"channels {first[pair] + 1} and {second[pair] + 1} are the same signal and left out")
            good[first[pair]] = good[second[pair]] = False
        energy = float(np.median(level[~dead])) * float(scale) ** 2 if not dead.all() else 0.0
        use = occupancy(power[~dead].mean(axis=0)) if not dead.all() else 0.0
        part = float(np.count_nonzero(taper)) / self.size
        heard = (tapered[good if good.any() else slice(None)] ** 2).sum(axis=0, dtype=np.float64)
        centre = float(heard @ np.arange(self.size) / heard.sum() - 0.5 * (self.size - 1)) / self.array.sample_rate
        return _Window(gcc, whitened, good, part, centre, energy, use, tuple(notices))

    def spectra(self, tapered: np.ndarray) -> np.ndarray:
        """Return the band's bins of tapered samples (m, size), (m, bins)."""
        return np.fft.rfft(tapered, axis=1)[:, self.bins]

    def gcc(self, whitened: np.ndarray) -> np.ndarray:
        """Return the GCC of every pair, (pairs, lags), of whitened spectra (m, bins)."""
        return correlation.gcc(whitened, self.bins, self.size, self.response.half_lags, self.oversampling, self.weight)

    def heard(self, window: _Window) -> tuple[np.ndarray, np.ndarray, float] | None:
        """Return a window's GCC and spectra without the channels that are left out, and the share of pairs that stay.

        The other pairs are to be scaled up for those that are missing.
        """
        good = window.good & ~self.outvoted
        if good.sum() < 4:
            return None
        if good.all():
            return window.gcc, window.whitened, 1.0
        kept = good[self.response.first] & good[self.response.second]
        return window.gcc * kept[:, None], window.whitened * good[:, None], kept.sum() / len(kept)

    # --- one decision -------------------------------------------------------------------------------------------------

    def noise(self, count: float) -> _Noise:
        """Return what so many windows of white noise, independent in each channel, do to the response.

        The law is fitted by its moments to 32 draws of all windows; of fewer windows, or parts of them, it rises as
        one over the square root of their number.
        """
        if self.null is None:
            hop, draws, all_windows = round(self.hop * self.array.sample_rate), 32, len(self.offsets)
            length = self.size + hop * (draws + all_windows - 2)
            noise = self.rng.standard_normal((len(self.array.microphones), length), np.float32)
            taper = correlation.hann(self.size).astype(np.float32)
            windows = (noise[:, i * hop :][:, : self.size] * taper for i in range(draws + all_windows - 1))
            gccs = [self.gcc(correlation.whiten(self.spectra(window), self.settings.beta)) for window in windows]
            means = [sum(gccs[i : i + all_windows]) / all_windows for i in range(draws)]
            peaks = [self.response.search(mean)[1][0] for mean in means]
            scale = float(np.std(peaks) * np.sqrt(6.0) / np.pi)
            deviation = float(np.sqrt(np.mean([np.mean(mean**2) for mean in means])))
            self.null = _Noise(float(np.mean(peaks) - np.euler_gamma * scale), scale, deviation)
        factor = np.sqrt(len(self.offsets) / count)
        return _Noise(self.null.location * factor, self.null.scale * factor, self.null.deviation * factor)

    def decide(self, windows: list[_Window], offsets: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Find the talkers in the windows around one moment.

        Args:
            windows: those in which something sounds.
            offsets: (windows,) s of each from the moment.

        Returns:
            (position (3,) m, covariance (3, 3) m², score) of each, the clearest first.
        """
        heard = [(self.heard(window), window, offset) for window, offset in zip(windows, offsets, strict=True)]
        heard = [item for item in heard if item[0] is not None]
        if not heard:
            self.remember([])
            return []
        shares = np.array([share for (_, _, share), _, _ in heard])
        weights = shares * [window.part for _, window, _ in heard]
        gains = (weights / weights.mean() / shares).astype(np.float32)
        gccs = np.stack([gcc for (gcc, _, _), _, _ in heard]) * gains[:, None, None]
        spectra = np.stack([whitened for (_, whitened, _), _, _ in heard])
        noise = self.noise(weights.sum())
        offsets = np.array([offset for _, _, offset in heard])
        judged = self.judge(self.peaks(gccs, spectra, gains, offsets, noise), noise)
        self.remember(
            [
                (
                    peak.position,
                    uncertainty.remembered(features, self.kept),
                    0.6 * features.gait + 0.4 * features.velocity,
                )
                for _, peak, features in judged
            ]
        )
        found = []
        low, high = self.response.low, self.response.high
        for score, peak, features in judged[: self.settings.max_speakers]:
            if score >= self.settings.min_score:
                sharpness = uncertainty.SHARPNESS / noise.deviation
                others = self.response.ambiguity(peak.gccs, offsets, peak.position, peak.velocity, sharpness)
                covariance = uncertainty.covariance(peak.normal, others, features, low, high)
                covariance += uncertainty.beyond(self.on_the_edge(peak.position))
                found.append((peak.position, covariance, score))
        return found

    def judge(self, peaks: list[_Peak], noise: _Noise) -> list[tuple[float, _Peak, uncertainty.Features]]:
        """Return a decision's peaks with their scores and what these rest on, the most probable first."""
        judged, left = [], self.before
        for peak in peaks:
            near = [_level(place, peak.position) < self.reached(age) for place, _, age, _ in left]
            traces = [trace for trace, same in zip(left, near, strict=True) if same]
            left = [trace for trace, same in zip(left, near, strict=True) if not same]
            features = self.features(peak, peak is peaks[0], traces, noise)
            judged.append((uncertainty.probability(features), peak, features))
        return sorted(judged, key=lambda item: -item[0])

    def on_the_edge(self, position: np.ndarray) -> np.ndarray:
        """Return for each axis (3,) whether a place lies on the edge of the searched volume."""
        margin = 0.5 * self.settings.resolution
        return (position - self.response.low < margin) | (self.response.high - position < margin)

    def peaks(self, gccs, spectra, gains, offsets: np.ndarray, noise: _Noise) -> list[_Peak]:
        """Return the places that are answered better than noise would, each without those before it.

        They are sought in GCCs that are cut off well above their noise, so that many pairs must agree: two talkers
        make ghosts where a few strong pairs of the one meet a few of the other. There is one more than there may be
        talkers, since a ghost may still come before the second talker. After the first, who sounded elsewhere in the
        decisions before is looked for there: it takes less to hear a talker again than to find him in the room.
        """
        found: list[_Peak] = []
        explained = 0.0  # coherence, (windows, bins), that the peaks so far have
        taken: list[np.ndarray] = []  # their places, (windows, 3) m or (1, 3) m each
        steered = self.response
        threshold = noise.threshold(self.settings.false_alarm)
        known = [(place, self.reached(age)) for place, lasting, age, _ in self.before if lasting > 0.5]
        for _ in range(self.settings.max_speakers + 1):
            if taken:
                gccs = self.masked(spectra, explained) * gains[:, None, None]
                for places in taken:
                    gccs = steered.notch(gccs, places, 0.1)
                gccs = steered.notch_echoes(gccs, taken[0], self.array.room, 0.012)
            mean = gccs.mean(axis=0)
            known = [(place, reach) for place, reach in known if all(_level(p.position, place) > reach for p in found)]
            again, reach = known.pop(0) if found and known else (None, 0.0)
            if found:
                threshold = noise.threshold(self.settings.candidate)
            start = steered.search(np.minimum(mean, 7.0 * noise.deviation))[0][0] if again is None else again
            peak = _Peak(start, float(steered.response(mean, start[None])[0]))
            velocity = np.zeros(3)
            if again is not None or 1.5 * peak.response >= threshold:  # a fit makes no more of it
                position, velocity, response = steered.follow(gccs, offsets, start, self.settings.max_speed)
                peak = self.refined(gccs, offsets, position, velocity, response, noise)
                coherence = self.coherence(spectra, offsets, peak.position, velocity)
                own = (coherence * (coherence > explained)).sum() / max(coherence.sum(), 1e-12)
                peak = replace(peak, own=float(own))
                explained = np.maximum(explained, coherence)
            if again is not None and _level(peak.position, again) > reach:
                continue
            if again is None and peak.response < threshold:
                break
            if all(_level(peak.position, other.position) > self.settings.separation for other in found):
                found.append(peak)
            taken.append(peak.position + velocity * offsets[:, None] if velocity.any() else peak.position[None])
        return found

    def masked(self, spectra: np.ndarray, explained: np.ndarray) -> np.ndarray:
        """Return GCCs (windows, pairs, lags) of those times and frequencies that are not explained yet.

        Speech is sparse: of two talkers one or the other is the louder in most bins (Yilmaz and Rickard 2004). A bin
        counts the less, the better the channels agree there on the peaks so far: whole where they agree by chance, not
        at all where by a half. What is left keeps its amplitude.

        Args:
            spectra: (windows, m, bins), whitened.
            explained: (windows, bins), see `coherence`.
        """
        agreed = explained / (self.weight * (spectra.shape[1] - 1))
        weights = self.weight * np.clip((0.475 - agreed) / 0.35, 0.0, 1.0).astype(np.float32)
        lags = self.response.half_lags
        gccs = [
            correlation.gcc(each, self.bins, self.size, lags, self.oversampling, weight)
            * (weight.sum() / self.weight.sum())
            for each, weight in zip(spectra, weights, strict=True)
        ]
        return np.stack(gccs)

    def coherence(self, spectra, offsets, position, velocity) -> np.ndarray:
        """Return how far the channels agree, bin by bin, on sound from a place that moves, (windows, bins).

        0 is what chance gives; neighbouring bins are averaged.
        """
        places = position + velocity * offsets[:, None]
        ranges = np.linalg.norm(places[:, None] - self.array.microphones, axis=2)
        delays = (ranges - ranges.mean(axis=1, keepdims=True)) / self.array.speed_of_sound
        steered = (spectra * self.turned(delays)).sum(axis=1)
        power = (spectra.real**2 + spectra.imag**2).sum(axis=1)
        excess = steered.real**2 + steered.imag**2 - power
        return self.weight * np.maximum(_smooth(excess) / np.maximum(_smooth(power), 1e-12), 0.0)

    def turned(self, delays: np.ndarray) -> np.ndarray:
        """Return by how much the band's bins turn in so many s (...), (..., bins) complex64.

        A bin's turn is that of a multiple of 32 bins times that of the rest: fewer exponentials.
        """
        count = self.bins.stop - self.bins.start
        turn = 2j * np.pi * self.array.sample_rate / self.size * delays[..., None]
        far = np.exp(turn * (self.bins.start + 32 * np.arange(-(-count // 32)))).astype(np.complex64)
        near = np.exp(turn * np.arange(32)).astype(np.complex64)
        return (far[..., :, None] * near[..., None, :]).reshape(*delays.shape, -1)[..., :count]

    def features(self, peak: _Peak, first: bool, traces: list, noise: _Noise) -> uncertainty.Features:
        """Return what tells a right peak, the decision's first or a further one, from a wrong one.

        Of the traces of earlier decisions nearby the most telling one counts, and the latest says where it was.
        """
        velocity = np.zeros(3) if peak.velocity is None else peak.velocity
        strayed, pace, gait = np.zeros(3), velocity, velocity
        if traces:
            place, _, age, gait = min(traces, key=lambda trace: trace[2])
            strayed = peak.position - place - velocity * (age / self.settings.rate)
            pace = (peak.position - place) * [1.0, 1.0, 0.0] * (self.settings.rate / age)
        return uncertainty.Features(
            response=peak.response / noise.location,
            agreement=peak.agreement,
            support=peak.support,
            before=max((lasting for _, lasting, _, _ in traces), default=0.0, key=abs),
            first=first,
            own=peak.own,
            velocity=velocity,
            residual=peak.residual,
            strayed=strayed,
            pace=pace,
            gait=gait,
            strongest=peak.strongest,
        )

    def refined(self, gccs, offsets, position, velocity, response: float, noise: _Noise) -> _Peak:
        """Fit a position to the peaks of each pair's GCC nearby; keep the fit where it is answered better."""
        steered = self.response
        aligned = steered.aligned(gccs, offsets, position, velocity, reach=6)
        differences, height = steered.differences(aligned, position)
        value = aligned[:, aligned.shape[1] // 2]
        fitted, normal, _ = multilateration.refine(
            position, self.array.microphones, steered.first, steered.second, differences, np.maximum(height, 0.0)
        )
        if ((fitted >= steered.low) & (fitted <= steered.high)).all():
            moved = steered.aligned_at(aligned, position, fitted)
            gain = float(moved.mean() - value.mean())
            if gain > 0.0:
                position, response, value = fitted, response + gain, moved
        ranges = np.linalg.norm(position - self.array.microphones, axis=1)
        misfit = differences - (ranges[steered.first] - ranges[steered.second])
        residual = float(np.sqrt(np.minimum(misfit**2, 0.02**2).mean()))
        agreement = max(float(np.clip(value / (3.0 * noise.deviation), -1.0, 1.0).mean()), 0.0)
        support = float(np.clip(height / (4.0 * noise.deviation), 0.0, 1.0).mean())
        scale = max(np.maximum(height, 0.0).mean(), 1e-9)
        places = position + velocity * offsets[:, None]
        each = [steered.response(gcc, place[None])[0] for gcc, place in zip(gccs, places, strict=True)]
        return _Peak(
            position,
            response,
            agreement,
            support,
            velocity=velocity,
            normal=normal / scale,
            residual=residual,
            strongest=float(max(each) / max(np.mean(each), 0.1 * noise.deviation)),
            gccs=gccs,
        )

    def remember(self, peaks: list[tuple[np.ndarray, float, np.ndarray]]) -> None:
        """Keep a decision's peaks, and of those before it what fades.

        Args:
            peaks: the place (3,) m of each, how lasting it is, and its velocity (3,) m/s so far.
        """
        self.before = [(place, lasting, 1, gait) for place, lasting, gait in peaks] + [
            (place, self.kept * lasting, age + 1, gait)
            for place, lasting, age, gait in self.before
            if abs(lasting) > 0.05 and all(_level(place, peak) > self.reached(age) for peak, _, _ in peaks)
        ]

    def reached(self, age: int) -> float:
        """Return how far, in m, a talker may seem to have moved so many decisions later: he walks, and places err."""
        return 0.2 + self.settings.max_speed * age / self.settings.rate

    def poll(self, gcc: np.ndarray, position: np.ndarray) -> list[str]:
        """Let the pairs vote about their channels at a place that is clearly answered; return what is news about one.

        A channel that is late, that stands elsewhere, or that is swapped with another adds nothing where all others
        agree, and one of wrong polarity takes away.
        """
        steered = self.response
        value = steered.at(gcc, position)
        if value.mean() < 3.0 * self.noise(1).location:
            return []
        votes = np.bincount(steered.first, value, len(self.votes)) + np.bincount(steered.second, value, len(self.votes))
        self.votes = 0.95 * self.votes + votes
        self.ballots += 1
        if self.ballots < 5:
            return []
        usual = np.median(self.votes)
        outvoted = self.votes < 0.1 * usual
        new = np.flatnonzero(outvoted & ~self.outvoted)
        if (~outvoted).sum() < max(4, 0.5 * len(outvoted)):
            return []
        self.outvoted = outvoted
        inverted = self.votes < -0.3 * usual
        return [
            f"channel {c + 1} has the wrong polarity and is left out"
            if inverted[c]
            else f"channel {c + 1} does not agree with the others (late, swapped, or elsewhere) and is left out"
            for c in new
        ]

    # --- the stream ---------------------------------------------------------------------------------------------------

    def localize(
        self, blocks: Iterable[np.ndarray], begin: int = 0, tail: Callable[[], float] = lambda: 0.0
    ) -> Iterator[Decision]:
        """Yield a decision for every time step of a stream, as soon as its last window is complete.

        Args:
            blocks: (n, m) samples each, one after another.
            begin: the first sample's place on the clock, in samples.
            tail: tells how much of the blocks so far, in s at their end, comes after a scene and is not decided about.
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
            while step < time_steps(begin, stream.end - begin, fs, self.settings.rate, tail()).stop:
                while index <= step * each + reach:
                    if place(index) + self.size > stream.end and not ended:
                        return
                    windows[index] = self.sounding(self.correlate(*stream.window(place(index), self.size)))
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
        found, notices = [], list(around[self.reach].notices)
        if around[self.reach].gcc is None:
            self.remember([])
        else:
            heard = [i for i, window in enumerate(around) if window.gcc is not None]
            centres = np.array([around[i].centre for i in heard])
            found = self.decide([around[i] for i in heard], self.offsets[heard] + centres)
            if found and found[0][2] > 0.9:
                notices += self.poll(around[self.reach].gcc, found[0][0])
                if self.on_the_edge(found[0][0])[:2].any():
                    notices.append("a source on the edge of the room, or outside it")
        return Decision.of(step / self.settings.rate, found, notices)


def _level(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.hypot(*(one - other)[:2]))


def _smooth(rows: np.ndarray) -> np.ndarray:
    """Return the sums of five neighbours in each row (n, bins); beyond the ends are zeros."""
    wide = np.pad(rows, ((0, 0), (2, 2)))
    count = rows.shape[1]
    return wide[:, :count] + wide[:, 1:-3] + wide[:, 2:-2] + wide[:, 3:-1] + wide[:, 4:]


class _Stream:
    """The last samples of a stream; outside of what was received there is silence."""

    def __init__(self, begin: int, channels: int):
        self.origin = self.end = begin
        self.blocks = [np.zeros((channels, 0))]

    def append(self, block: np.ndarray) -> None:
        self.blocks.append(np.ascontiguousarray(block.T, dtype=np.float64))
        self.end += len(block)

    @property
    def samples(self) -> np.ndarray:
        """What is kept of the stream, (channels, n)."""
        if len(self.blocks) > 1:
            self.blocks = [np.concatenate(self.blocks, axis=1)]
        return self.blocks[0]

    def window(self, begin: int, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return samples (channels, size) and a taper (size,) over those that were received.

        At the ends of a stream the taper is narrower: a step there, at once in all channels, would be a source.
        """
        received = self.samples
        first, last = max(begin, self.origin), min(begin + size, self.end)
        if last - first == size:
            return received[:, first - self.origin : last - self.origin], correlation.hann(size)
        samples, taper = np.zeros((len(received), size)), np.zeros(size)
        if last - first > size // 8:
            samples[:, first - begin : last - begin] = received[:, first - self.origin : last - self.origin]
            taper[first - begin : last - begin] = correlation.hann(last - first)
        return samples, taper

    def forget(self, before: int) -> None:
        excess = min(before, self.end) - self.origin
        if excess > 0:
            self.blocks = [self.samples[:, excess:]]
            self.origin += excess
