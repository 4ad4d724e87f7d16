"""What a recording tells of an array: where somebody spoke, how late each channel is, and what carries which sound.

The start of a self-calibration. Places come from steered response power over the magnitudes of the GCCs, so that a
channel's polarity does not matter and a late one only adds noise. Steered to these places, each channel is correlated
with the sum of the others over a minute of speech: it stands out at its delay, whatever that is, at the microphone
whose sound it carries.
"""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avcli.localization import correlation
from avcli.localization.faults import Fault
from avcli.localization.health import UNUSUAL_DB
from avcli.localization.srp import SteeredResponse
from avcli.localization.windows import finite
from avcli.numeric import TooLittle, assign, fft_length

WINDOW_S, HOP_S = 0.085, 0.05
BAND_HZ = (300.0, 8000.0)
MOST = 3600
"""Windows that are used at most; of a longer recording they are taken evenly."""
ALONE, LISTENED = 1200, 240
"""How many of them are heard each by itself, and from how many the state of the channels is found."""
LONGEST_S = 0.06
"""The largest delay of a channel that is looked for, s."""
TOLD_S = 0.0005
"""The least delay that is told from a microphone that hangs up to 17 cm from where the config says, s."""
STEEPEST = 150e-6
"""The largest drift of a channel against the others that is looked for."""
STRETCH_S, STRETCHES = 5.0, 60
"""The time over which a drift hardly moves a channel, s, and how many such stretches a recording has at most."""
HEARD_S = 0.0003
"""The time over which a channel is heard: microphones hang some centimetres beside their places."""
CANDIDATES = 4
"""Peaks of a pair's GCC that are kept."""
MARGIN_M = 0.3
"""How much longer than between its microphones a pair's delay may be."""
TOGETHER_S = 0.5
"""The time over which windows are heard together, once a path is known."""
NEAR_S = 5e-4
"""How far from the prediction a delay is looked for then."""
ECHO_NEAR_S, ECHO_FINER = 1e-3, 4
"""How far from the prediction an echo is listened for, and by how much finer than other lags."""
CLEAR = 6.0
"""How many standard deviations of its correlation a channel must stand out by at its delay."""

SYNCHRONOUS_S, STEADY = 3e-5, 5e-7
"""How late a channel may be, s, and by how much it may drift, that still is taken for synchronous."""
DOUBTED = 0.7
"""The share of the usual agreement below which a channel is left out: what is wrong with it is not known for sure."""

Read = Callable[[], Iterable[tuple[float, np.ndarray, int]]]
"""Reads sound from the start: time in s, samples (n, m) and sample rate in Hz of each piece."""


@dataclass(frozen=True)
class Channels:
    """The state of an array's channels.

    Attributes:
        order: (m,) which channel carries each microphone's sound.
        sign: (m,) its polarity, 1 or -1.
        delay: (m,) s by which it is late at time 0.
        drift: (m,) by which its delay grows, s/s.
        heard: (m,) by how many standard deviations it agrees with the others.
        level_db: (m,) over the median channel.
    """

    order: np.ndarray
    sign: np.ndarray
    delay: np.ndarray
    drift: np.ndarray
    heard: np.ndarray
    level_db: np.ndarray

    @property
    def late(self) -> np.ndarray:
        """Which channels (m,) were found to be late or to drift."""
        return (self.delay != 0.0) | (self.drift != 0.0)

    def faults(self) -> list[Fault]:
        """What is wrong with the channels."""
        found = list[Fault]()
        for microphone, channel in enumerate(self.order):
            number = int(channel) + 1
            if not self.usable[microphone]:
                found.append(Fault(number, "unexplained", corrected=False))
                continue
            if channel != microphone:
                found.append(Fault(number, "swapped", microphone=microphone + 1))
            if self.sign[microphone] < 0.0:
                found.append(Fault(number, "polarity"))
            if self.delay[microphone] and not self.drift[microphone]:
                found.append(Fault(number, "late", delay_s=float(self.delay[microphone])))
            if abs(self.level_db[microphone]) > UNUSUAL_DB:
                found.append(Fault(number, "level", level_db=float(self.level_db[microphone])))
        return found

    def words(self) -> list[str]:
        """Describe what is wrong in sentences without a full stop."""
        drifting = [
            f"channel {channel + 1} drifts by {1e6 * drift:.1f} ppm; config.json will not use it, since no fixed delay "
            "puts it right"
            for channel, drift in zip(self.order, self.drift, strict=True)
            if drift
        ]
        return [str(fault) for fault in self.faults()] + drifting

    def record(self) -> list[dict[str, Any]]:
        """Return the state of each microphone's channel, as avcalib writes it."""
        return [
            {
                "channel": int(channel) + 1,
                "polarity": int(sign),
                "delay_s": float(delay),
                "drift_ppm": 1e6 * float(drift),
                "level_db": float(level),
                "usable": bool(usable),
            }
            for channel, sign, delay, drift, level, usable in zip(
                self.order, self.sign, self.delay, self.drift, self.level_db, self.usable, strict=True
            )
        ]

    def refined(self, delays: np.ndarray, drifts: np.ndarray, echoing: np.ndarray) -> "Channels":
        """Return the channels with what a fit found beside.

        Args:
            delays, drifts: (m,) s at time 0 and s/s.
            echoing: (m,) which hear the room's echoes at their microphones: nothing is wrong with them.
        """
        off, adrift = np.abs(delays) > SYNCHRONOUS_S, np.abs(self.drift + drifts) > STEADY
        return replace(
            self,
            delay=np.where(self.late | off | adrift, self.delay + delays, 0.0),
            drift=np.where(adrift, self.drift + drifts, 0.0),
            heard=np.where(echoing & self.heard_as_is, np.maximum(self.heard, np.median(self.heard)), self.heard),
        )

    def wiring(self) -> list[dict[str, Any]] | None:
        """Return microphone_config.channels of a config.json; None where nothing is wrong.

        A channel that drifts is not used: its delay will be another one in the next recording.
        """
        usable = self.usable & (self.drift == 0.0)
        if usable.all() and not self.delay.any() and (self.sign > 0.0).all() and (np.diff(self.order) == 1).all():
            return None
        return [
            {"channel": int(channel) + 1, "polarity": int(sign), "delay_s": float(delay), "usable": bool(used)}
            for channel, sign, delay, used in zip(self.order, self.sign, self.delay, usable, strict=True)
        ]

    @property
    def clear(self) -> np.ndarray:
        """Which microphones (m,) agree with the others at some delay."""
        return self.heard >= CLEAR

    @property
    def usable(self) -> np.ndarray:
        """Which microphones (m,) agree with the others at some delay, about as well as those do with each other."""
        alike = self.clear & (self.heard >= DOUBTED * np.median(self.heard))
        return alike if alike.sum() >= 5 else self.clear

    @property
    def heard_as_is(self) -> np.ndarray:
        """Which microphones (m,) are usable, or agree less but with nothing put right: those are listened to, too."""
        return self.usable | (self.clear & (self.order == np.arange(len(self.order))) & (self.sign > 0.0) & ~self.late)


@dataclass(frozen=True)
class Echoes:
    """What was heard of the echoes of a room's surfaces.

    Attributes:
        heard: (n, m, s, l) each channel's correlation with the voice in each window, the echo of each surface where it
            was expected in the middle of the lags.
        step: s, from lag to lag.
        expected: (n, m, s) s, arrival of an echo minus the mean arrival of the direct sound.
        windows: (n,) how many windows were heard together.
    """

    heard: np.ndarray
    step: float
    expected: np.ndarray
    windows: np.ndarray

    def part(self, rows: np.ndarray | slice) -> "Echoes":
        """Return those of some windows."""
        return Echoes(self.heard[rows], self.step, self.expected[rows], self.windows[rows])


@dataclass(frozen=True)
class Survey:
    """What was heard.

    Attributes:
        times: (n,) s, the middles of the windows.
        places: (n, 3) m, where the sound came from, roughly.
        delays: (n, p, k) s, the peaks of each pair's GCC, highest first, after the channels were put right: arrival at
            the pair's first microphone minus at its second; NaN where there is none.
        first, second: (p,) the microphones of each pair.
        channels: what was put right.
        echoes: what was heard of the room's; None where they were not listened for.
    """

    times: np.ndarray
    places: np.ndarray
    delays: np.ndarray
    first: np.ndarray
    second: np.ndarray
    channels: Channels
    echoes: Echoes | None = None


class Listening:
    """Listens to a recording of one person at a time.

    Args:
        read: gives the sound; called twice. Samples that are not numbers count as 0.
        microphones: (m, 3) m, roughly.
        low, high: (3,) m, the corners of the volume where people speak.
        speed_of_sound: m/s.

    Raises:
        TooLittle: there is too little sound.
    """

    def __init__(self, read: Read, microphones: np.ndarray, low: np.ndarray, high: np.ndarray, speed_of_sound: float):
        self.times, self.spectra, levels, frame = _windows(
            lambda: ((start, finite(samples.T)[0].T, rate) for start, samples, rate in read())
        )
        if len(self.times) < 8:
            raise TooLittle(f"only {len(self.times)} windows of sound; record some minutes of speech or claps")
        self.listener = _Listener(frame, microphones, low, high, speed_of_sound)
        some = np.unique(np.linspace(0, len(self.times) - 1, LISTENED).astype(int))
        channels = self.listener.channels(self.times[some], self.spectra[some])
        level = 20.0 * np.log10(np.maximum(levels, 1e-30))
        self.channels = replace(channels, level_db=(level - np.median(level))[channels.order])
        self.corrected = self.listener.corrected(self.times, self.spectra, self.channels)

    def heard(self) -> Survey:
        """Return what single windows tell, each by itself."""
        some = np.unique(np.linspace(0, len(self.times) - 1, ALONE).astype(int))
        places, delays = self.listener.delays(self.corrected[some], self.channels)
        return Survey(self.times[some], places, delays, self.listener.first, self.listener.second, self.channels)

    def again(
        self, times: np.ndarray, path: np.ndarray, predicted: np.ndarray, arrivals: np.ndarray, echoes: np.ndarray
    ) -> Survey:
        """Return what windows that follow on tell together, turned to where a voice is thought to be in each.

        Args:
            times: (k,) s.
            path: (k, 3) m, the voice's place at these times.
            predicted: (k, p) s, the delays of the pairs then.
            arrivals, echoes: (k, m) and (k, m, s) s, when each channel hears the direct sound and the echo of each
                surface then.
        """
        shape = echoes.shape[1:]
        path, predicted = _between(self.times, times, path), _between(self.times, times, predicted)
        arrivals = _between(self.times, times, arrivals)
        echoes = _between(self.times, times, echoes.reshape(len(times), -1)).reshape(-1, *shape)
        listener = self.listener
        usable = self.channels.heard_as_is
        kept = usable[listener.first] & usable[listener.second]
        block = np.floor(self.times / TOGETHER_S)
        begins = np.concatenate([[0], np.flatnonzero(np.diff(block)) + 1, [len(block)]])
        middles = np.array([(begin + end - 1) // 2 for begin, end in itertools.pairwise(begins)])
        delays = np.full((len(middles), len(kept), CANDIDATES), np.nan)
        heard = list[np.ndarray]()
        for row, (begin, end) in enumerate(itertools.pairwise(begins)):
            delays[row, kept] = listener.together(self.corrected[begin:end], predicted[begin:end])[kept]
            at = slice(begin, end)
            heard.append(listener.echoes(self.corrected[at], arrivals[at], echoes[at], usable))
        return Survey(
            self.times[middles],
            path[middles],
            predicted[middles][..., None] + delays,
            listener.first,
            listener.second,
            self.channels,
            Echoes(np.array(heard), listener.step / ECHO_FINER, echoes[middles], np.diff(begins)),
        )


@dataclass(frozen=True)
class _Frame:
    """How windows are transformed: sample rate in Hz, samples of a window, and where the band lies in its spectrum."""

    rate: int
    size: int
    band: slice

    def turned(self, delays: np.ndarray) -> np.ndarray:
        """Return what advances the band's bins by so many s (...): (..., bins)."""
        fine, count = 32, self.band.stop - self.band.start
        per_bin = (2j * np.pi * self.rate / self.size) * delays[..., None]
        steps = np.exp(per_bin * np.arange(fine)).astype(np.complex64)
        leaps = np.exp(per_bin * np.arange(self.band.start, self.band.stop, fine)).astype(np.complex64)
        return (leaps[..., None] * steps[..., None, :]).reshape(*delays.shape, -1)[..., :count]


def _windows(read: Read) -> tuple[np.ndarray, np.ndarray, np.ndarray, _Frame]:
    """Return the middles (n,) s of the loud windows, their whitened spectra (n, m, bins), and the channels' RMS."""
    marks, powers = list[tuple[int, int]](), list[np.ndarray]()
    frame: _Frame | None = None
    for piece, (_, samples, rate) in enumerate(read()):
        if frame is None:
            size = fft_length(round(WINDOW_S * rate))
            first, last = (int(np.ceil(f * size / rate)) for f in (BAND_HZ[0], min(BAND_HZ[1], 0.45 * rate)))
            frame = _Frame(rate, size, slice(first, last))
        elif rate != frame.rate:
            raise ValueError(f"the sound has {rate} Hz here and {frame.rate} Hz before")
        for begin in range(0, len(samples) - frame.size + 1, round(HOP_S * rate)):
            part = samples[begin : begin + frame.size]
            marks.append((piece, begin))
            powers.append(np.mean((part - part.mean(axis=0)) ** 2, axis=0))
    if frame is None or not marks:
        return np.zeros(0), np.zeros((0, 0, 0)), np.zeros(0), frame or _Frame(1, 2, slice(1, 2))
    power = np.array(powers)
    total = np.median(power, axis=1)
    loud = np.flatnonzero(total > max(0.05 * float(np.quantile(total, 0.95)), 1e-15))
    chosen = loud[np.unique(np.linspace(0, len(loud) - 1, min(MOST, len(loud))).astype(int))] if len(loud) else loud
    wanted = {marks[index] for index in chosen}
    taper, times, spectra = correlation.hann(frame.size)[:, None], list[float](), list[np.ndarray]()
    for piece, (start, samples, _) in enumerate(read()):
        for begin in range(0, len(samples) - frame.size + 1, round(HOP_S * frame.rate)):
            if (piece, begin) in wanted:
                part = np.fft.rfft(samples[begin : begin + frame.size] * taper, axis=0).T[:, frame.band]
                times.append(start + (begin + 0.5 * frame.size) / frame.rate)
                spectra.append(correlation.whiten(part, 1.0))
    return np.array(times), np.array(spectra), np.sqrt(power[chosen].sum(axis=0) / max(len(chosen), 1)), frame


class _Listener:
    """Finds places, channels and delays in whitened spectra."""

    def __init__(self, frame: _Frame, microphones: np.ndarray, low: np.ndarray, high: np.ndarray, speed: float):
        self.frame, self.microphones, self.speed = frame, microphones, speed
        self.finer = max(1, int(np.ceil(2.75 * BAND_HZ[1] / frame.rate)))
        self.step = 1.0 / (frame.rate * self.finer)
        self.first, self.second = correlation.pairs(len(microphones))
        self.response = SteeredResponse(
            microphones, low, high, frame.rate * self.finer / speed, resolution=0.03, keep=16
        )
        self.reach = np.linalg.norm(microphones[self.first] - microphones[self.second], axis=1) + MARGIN_M

    def channels(self, times: np.ndarray, spectra: np.ndarray) -> Channels:
        """Find which channel carries which microphone's sound, with which polarity, delay and drift."""
        count = len(self.microphones)
        zero = np.zeros(count)
        found = Channels(np.arange(count), np.ones(count), zero, zero, np.full(count, np.inf), zero)
        starts = [
            self._heard(times, spectra, self._places(times, spectra, found, found.usable, signed=signed), found)
            for signed in (True, False)
        ]
        found = max(starts, key=lambda start: float(start.heard.sum()))
        for _ in range(2):
            places = self._places(times, spectra, found, found.usable, signed=True)
            found = self._heard(times, spectra, places, found)
        if (found.clear & ~found.usable).any():
            # Places fit best to the microphones that gave them: what was put right is compared once it helps too.
            again = self._heard(times, spectra, self._places(times, spectra, found, found.clear, signed=True), found)
            found = max(found, again, key=lambda state: float(state.heard.sum()))
        # Places bend until exchanged channels agree with them as they are. They are among the three that agree least.
        best = found
        for one, other in itertools.combinations(np.argsort(found.heard)[:3], 2):
            order = found.order.copy()
            order[[one, other]] = order[[other, one]]
            exchanged = replace(found, order=order)
            places = self._places(times, spectra, exchanged, exchanged.usable, signed=True)
            again = self._heard(times, spectra, places, exchanged)
            if (again.order == order).all() and again.heard.sum() > best.heard.sum():
                best = again
        return best

    def corrected(self, times: np.ndarray, spectra: np.ndarray, channels: Channels) -> np.ndarray:
        late = channels.delay + channels.drift * times[:, None]
        return spectra[:, channels.order] * (channels.sign[:, None] * self.frame.turned(late)).astype(np.complex64)

    def _gcc(self, window: np.ndarray, lags: int) -> np.ndarray:
        return correlation.gcc(window, self.frame.band, self.frame.size, lags, self.finer)

    def _places(
        self, times: np.ndarray, spectra: np.ndarray, channels: Channels, used: np.ndarray, *, signed: bool
    ) -> np.ndarray:
        """Return where each window's sound comes from, (n, 3) m, by the microphones (m,) that are used."""
        kept = used[self.first] & used[self.second]
        places = np.empty((len(times), 3))
        for row, window in enumerate(self.corrected(times, spectra, channels)):
            gcc = self._gcc(window, self.response.half_lags) * kept[:, None]
            ceiling = 6.0 * float(np.sqrt(np.mean(gcc[kept] ** 2)))
            gcc = np.minimum(np.maximum(gcc, 0.0) if signed else np.abs(gcc), ceiling)
            places[row] = self.response.search(gcc)[0][0]
        return places

    def _heard(self, times: np.ndarray, spectra: np.ndarray, places: np.ndarray, before: Channels) -> Channels:
        """Listen to each channel at each microphone's place, against the sum of the others."""
        count, size = len(self.microphones), self.frame.size
        travel = np.linalg.norm(places[:, None] - self.microphones, axis=2) / self.speed
        corrected = self.corrected(times, spectra, before) * before.usable[:, None]
        steered = corrected * self.frame.turned(travel)
        stretch = np.floor((times - times[0]) / max(STRETCH_S, 1.001 * np.ptp(times) / STRETCHES)).astype(int)
        reach = min(int(LONGEST_S / self.step), size * self.finer // 2 - 2)
        sums = np.zeros((stretch.max() + 1, count, count, 2 * reach + 1))  # stretch, channel, microphone, lag
        whole = steered.sum(axis=1)
        carried = np.empty(count, int)
        carried[before.order] = np.arange(count)
        for t in range(len(times)):
            for channel in range(count):
                others = whole[t] - steered[t, carried[channel]]
                others = others / np.maximum(np.abs(others), 1e-6)
                turned = spectra[t, channel] * self.frame.turned(travel[t]) * others.conj()
                sums[stretch[t], channel] += self._lags(turned, reach)
        middles = np.array([times[stretch == s].mean() if (stretch == s).any() else 0.0 for s in range(len(sums))])
        return self._chosen(sums, middles)

    def _lags(self, cross: np.ndarray, reach: int) -> np.ndarray:
        """Correlations (m, 2 reach + 1) of cross spectra (m, bins)."""
        size = self.frame.size * self.finer
        spectrum = np.zeros((len(cross), size // 2 + 1), np.complex64)
        spectrum[:, self.frame.band] = cross
        found = np.fft.irfft(spectrum, size, axis=1)
        return np.concatenate([found[:, -reach:], found[:, : reach + 1]], axis=1)

    def _chosen(self, sums: np.ndarray, middles: np.ndarray) -> Channels:
        """Choose for each microphone the channel that agrees best, and its polarity, delay and drift.

        Args:
            sums: (stretches, channels, microphones, lags) correlations.
            middles: (stretches,) s.
        """
        count, reach = sums.shape[1], sums.shape[3] // 2
        width = max(1, round(HEARD_S / self.step))
        smooth = np.ones(width) / np.sqrt(width)
        noise = np.sqrt(np.median(sums**2, axis=3, keepdims=True) / 0.455)
        scaled = sums / np.maximum(noise, 1e-30)
        heard = np.zeros((count, count))
        best = np.zeros((count, count, 3))  # sign, delay, drift
        centre, some = middles.mean(), max(1, width // 2)
        for channel in range(count):
            for microphone in range(count):
                rows = np.array([np.convolve(row, smooth, "same") for row in scaled[:, channel, microphone]])
                drift = _drift(rows[:, ::some], middles - centre, some * self.step)
                total = _together(rows, drift * (middles - centre), self.step)
                at = int(np.argmax(np.abs(total)))
                value, lag = float(total[at]), at - reach
                heard[channel, microphone] = abs(value)
                best[channel, microphone] = np.sign(value) or 1.0, lag * self.step - drift * centre, drift
        # A channel is taken for another microphone's only where that is clear.
        cost = -heard - 0.1 * heard.max() * np.eye(count)
        _, order = assign(cost.T)
        picked = best[order, np.arange(count)]
        agrees = heard[order, np.arange(count)]
        usable = agrees >= CLEAR
        sign = picked[:, 0] * (1.0 if np.sum(picked[usable, 0]) >= 0 else -1.0)
        delay, drift = (picked[:, k] - np.median(picked[usable, k] if usable.any() else picked[:, k]) for k in (1, 2))
        # A microphone that hangs beside its place seems late by less than this, and a drift shows by more in the end.
        late = (np.abs(delay) > TOLD_S) | (np.abs(drift) * np.ptp(middles) > TOLD_S)
        return Channels(order, sign, np.where(late, delay, 0.0), np.where(late, drift, 0.0), agrees, np.zeros(count))

    def delays(self, windows: np.ndarray, channels: Channels) -> tuple[np.ndarray, np.ndarray]:
        """Return where each window's sound comes from, (n, 3) m, and the peaks of the pairs' GCCs, (n, pairs, k) s."""
        used = channels.heard_as_is
        kept = used[self.first] & used[self.second]
        lags = int(np.ceil(self.reach.max() / self.speed / self.step))
        outside = np.abs(np.arange(-lags, lags + 1)) * self.step * self.speed > self.reach[:, None]
        inner = slice(lags - self.response.half_lags, lags + self.response.half_lags + 1)
        places, delays = np.empty((len(windows), 3)), np.full((len(windows), len(self.first), CANDIDATES), np.nan)
        for row, window in enumerate(windows):
            gcc = self._gcc(window, lags)
            noise = np.sqrt(np.mean(np.where(outside, 0.0, gcc) ** 2, axis=1, keepdims=True))
            clipped = np.clip(gcc[:, inner], 0.0, 6.0 * noise) * kept[:, None]
            places[row] = self.response.search(clipped)[0][0]
            delays[row, kept] = self._peaks(np.where(outside, -1.0, gcc)[kept], lags, 3.0 * noise[kept])
        return places, delays

    def together(self, windows: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Return the peaks of the pairs' mean GCC about predicted delays (n, p) of windows (n, m, bins), (p, k) s."""
        cross = np.zeros((len(self.first), windows.shape[2]), np.complex64)
        for window, late in zip(windows, predicted, strict=True):
            cross += window[self.first] * window[self.second].conj() * self.frame.turned(late)
        near, far = round(NEAR_S / self.step), round(10 * NEAR_S / self.step)
        gcc = self._lags(cross, far)
        noise = np.sqrt(np.mean(np.delete(gcc, np.s_[far - near : far + near + 1], axis=1) ** 2, axis=1, keepdims=True))
        return self._peaks(gcc[:, far - near - 1 : far + near + 2], near + 1, 3.0 * noise)

    def echoes(self, windows: np.ndarray, arrivals: np.ndarray, echoes: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Return each channel's correlations (m, s, l) with the voice about echoes of windows (n, m, bins).

        The voice is the sum of the other channels that are used (m,), turned to when they hear it (n, m) s; an echo is
        expected at (n, m, s) s.
        """
        steered = windows * self.frame.turned(arrivals) * used[:, None]
        voice = steered.sum(axis=1, keepdims=True) - steered
        voice = voice / np.maximum(np.abs(voice), 1e-6)
        alone = (windows * voice.conj())[:, :, None]
        cross = (alone * self.frame.turned(echoes)).sum(axis=0) * used[:, None, None]
        size = self.frame.size * self.finer * ECHO_FINER
        spectrum = np.zeros((*cross.shape[:2], size // 2 + 1), np.complex64)
        spectrum[..., self.frame.band] = cross
        reach = round(ECHO_NEAR_S / self.step * ECHO_FINER)
        found = np.fft.irfft(spectrum, size, axis=2)
        return np.concatenate([found[..., -reach:], found[..., : reach + 1]], axis=2).astype(np.float32)

    def _peaks(self, gcc: np.ndarray, lags: int, least: np.ndarray) -> np.ndarray:
        """Return the lags of the highest peaks of GCCs (p, 2 lags + 1), (p, k) s; NaN below `least` (p, 1)."""
        middle = gcc[:, 1:-1]
        is_peak = (middle > gcc[:, :-2]) & (middle >= gcc[:, 2:]) & (middle > least)
        height = np.where(is_peak, middle, -np.inf)
        at = _largest(height, CANDIDATES)
        found = np.take_along_axis(height, at, axis=1)
        around = [np.take_along_axis(gcc, at + offset, axis=1) for offset in (0, 1, 2)]
        lag = at + 1 - lags + correlation.interpolate_peak(*around)
        return np.where(np.isfinite(found), lag * self.step, np.nan)


def _drift(rows: np.ndarray, times: np.ndarray, step: float) -> float:
    """Return the drift at which rows of correlations (n, lags) of times (n,) s agree best; 0 where that is as good.

    Coarse steps come first, over lags that are summed by four; fine ones follow around the two best of them.
    """
    span = float(np.ptp(times))
    if span <= 2 * STRETCH_S:
        return 0.0
    # From one drift to the next, neither end of the recording moves by more than half of what a channel is heard over.
    fine = HEARD_S / span
    steps = int(np.ceil(STEEPEST / fine))
    drifts = fine * np.arange(-steps, steps + 1)
    wide = rows[:, : rows.shape[1] // 4 * 4].reshape(len(rows), -1, 4).sum(axis=2)

    def peak(rows: np.ndarray, drift: float, step: float) -> float:
        return float(np.abs(_together(rows, drift * times, step)).max())

    coarse = drifts[steps % 4 :: 4]
    best = coarse[np.argsort([-peak(wide, drift, 4 * step) for drift in coarse])[:2]]
    near = drifts[np.abs(drifts[:, None] - best).min(axis=1) < 3.5 * fine]
    peaks = [peak(rows, drift, step) for drift in near]
    return float(near[np.argmax(peaks)]) if max(peaks) > 1.02 * peak(rows, 0.0, step) else 0.0


def _together(rows: np.ndarray, late: np.ndarray, step: float) -> np.ndarray:
    """Return the sum (lags,) of rows (n, lags) that are late by so many s (n,), in standard deviations of noise."""
    shift = np.rint(late / step).astype(int)
    return sum(np.roll(row, -by) for row, by in zip(rows, shift, strict=True)) / np.sqrt(len(rows))


def _between(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values (k, c), known at times (k,), linearly: (n, c)."""
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1)


def _largest(values: np.ndarray, count: int) -> np.ndarray:
    """Return where the largest values of each row are, (rows, count), the largest first."""
    at = np.argpartition(-values, count, axis=1)[:, :count]
    return np.take_along_axis(at, np.argsort(-np.take_along_axis(values, at, axis=1), axis=1), axis=1)
