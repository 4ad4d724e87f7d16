"""One window of sound: its spectra, the GCC of each pair of microphones, and which channels can be believed."""

from dataclasses import dataclass, field

import numpy as np

from avcli.localization import correlation
from avcli.localization.array import Array
from avcli.localization.events import occupancy
from avcli.localization.settings import SteeredSettings
from avcli.numeric import fft_length

_ROUNDING = 3e-6
"""A channel with a root mean square below this, full scale at 1, holds what computing leaves, or the ringing of filters
before a simulated sound arrives: no converter is so quiet."""

_ROUNDED = 1e-6
"""Where all channels have a root mean square in the band below this, the largest sample at 1, a constant or a rumble is
all that there is, and the rest is what computing leaves: alike in all channels, it would be a source."""

FAINT = 0.003
"""Power of a window over that of the loudest around a moment, up to which it is left out. Where somebody begins or
ends, it holds what rings on in the room, or before the sound arrives; whitened it would count as much as the others."""


@dataclass(frozen=True)
class Band:
    """The frequencies that a localizer uses, and how finely it correlates them.

    Attributes:
        size: samples of a window.
        bins: where the band lies in a window's spectrum.
        weight: (bins,) float32, by which each bin counts.
        oversampling: lag steps per sample.
    """

    size: int
    bins: slice
    weight: np.ndarray
    oversampling: float

    @classmethod
    def of(cls, settings: SteeredSettings, sample_rate: float) -> "Band":
        """Choose the bins and the lag step for a sample rate in Hz.

        Raises:
            ValueError: the band holds too few bins.
        """
        size = fft_length(max(round(settings.window * sample_rate), 16))
        first = max(1, int(np.ceil(settings.band[0] * size / sample_rate)))
        last = min(size // 2 - 1, int(settings.band[1] * size / sample_rate))
        if last < first + 16:
            low, high = settings.band
            raise ValueError(
                f"the band from {low:g} to {high:g} Hz is empty or too narrow for sound sampled at {sample_rate:g} Hz"
            )
        weight = ((np.arange(first, last + 1) / first) ** -settings.tilt).astype(np.float32)
        # The lag step is as long as the band allows (2.75 steps a period of the highest frequency), whatever the rate.
        return cls(size, slice(first, last + 1), weight, fft_length(int(np.ceil(5.5 * last))) / size)

    def turned(self, delays: np.ndarray, sample_rate: float) -> np.ndarray:
        """Return by how much the band's bins turn in so many s (...), (..., bins) complex64.

        A bin's turn is that of a multiple of 32 bins times that of the rest: fewer exponentials.
        """
        count = self.bins.stop - self.bins.start
        turn = 2j * np.pi * sample_rate / self.size * delays[..., None]
        far = np.exp(turn * (self.bins.start + 32 * np.arange(-(-count // 32)))).astype(np.complex64)
        near = np.exp(turn * np.arange(32)).astype(np.complex64)
        return (far[..., :, None] * near[..., None, :]).reshape(*delays.shape, -1)[..., :count]


@dataclass(frozen=True)
class Correlated:
    """What sounds in one window.

    Attributes:
        gcc: (pairs, lags).
        spectra: (m, bins) complex, the spectra of the tapered samples.
        whitened: (m, bins) complex64, the whitened spectra that it is of.
        good: (m,) bool, which channels can be believed.
        part: which part of a whole window the stream held of it, from 0 to 1.
        centre: s from the window's middle to the middle of its energy: of a talker who walks, the window tells where he
            was then.
        energy: mean square of the median channel, times the band's bins.
        occupancy: share of the bins within 40 dB of the strongest.
        power: (bins,) median over the channels of the squared spectra.
        whole: (bins,) the same of all channels, with the steady tones that are left out of everything else.
        alike: (bins,) from 0 to 1, how far the channels have the same phase, these tones included.
    """

    gcc: np.ndarray
    spectra: np.ndarray
    whitened: np.ndarray
    good: np.ndarray
    part: float
    centre: float
    energy: float
    occupancy: float
    power: np.ndarray
    whole: np.ndarray
    alike: np.ndarray


@dataclass(frozen=True)
class Window:
    """One window of the stream.

    Attributes:
        correlated: None where nothing sounds.
        notices: what was noticed about its channels, one sentence each.
    """

    correlated: Correlated | None
    notices: tuple[str, ...] = ()


class Correlator:
    """Correlates windows of one array.

    Args:
        array: the microphones and the room.
        band: the frequencies.
        half_lags: half width of a GCC, in lag steps.
        beta: exponent of the phase transform.

    Attributes:
        first, second: (pairs,) the two microphones of each pair.
        baseline: (pairs,) m, the distance between them.

    Raises:
        ValueError: two microphones are farther apart than a window can tell.
    """

    def __init__(self, array: Array, band: Band, half_lags: int, beta: float):
        self.band, self.half_lags, self.beta = band, half_lags, beta
        self.sample_rate = array.sample_rate
        self.first, self.second = correlation.pairs(len(array.microphones))
        self.baseline = np.linalg.norm(array.microphones[self.first] - array.microphones[self.second], axis=1)
        if 2 * half_lags >= band.size * band.oversampling:
            far = int(self.baseline.argmax())
            raise ValueError(
                f"microphones {self.first[far] + 1} and {self.second[far] + 1} are {self.baseline[far]:.1f} m apart, "
                "farther than sound travels in half a window; check their positions, or use a longer window"
            )

    def whitened(self, tapered: np.ndarray) -> np.ndarray:
        """Return the whitened spectra (m, bins) of tapered samples (m, size)."""
        return correlation.whiten(self._spectra(tapered), self.beta)

    def gcc(self, whitened: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """Return the GCC of every pair, (pairs, lags), of whitened spectra (m, bins); the band's weights by default."""
        band = self.band
        weight = band.weight if weight is None else weight
        return correlation.gcc(whitened, band.bins, band.size, self.half_lags, band.oversampling, weight)

    def correlate(
        self,
        samples: np.ndarray,
        taper: np.ndarray,
        order: np.ndarray | None = None,
        turn: np.ndarray | None = None,
        tones: np.ndarray | None = None,
    ) -> Window:
        """Correlate one window of samples (m, size) under a taper (size,).

        Args:
            samples, taper: of the window.
            order: (m,) which channel is each microphone's; None: each its own.
            turn: (m, bins) by which the spectra of the microphones are multiplied.
            tones: (bins,) bool, which hold steady tones and are left out.
        """
        peak = np.maximum(samples.max(axis=1), -samples.min(axis=1))
        broken, notices = np.zeros(len(samples), bool), list[str]()
        if not np.isfinite(peak).all():
            samples, broken, notices = finite(samples)
            peak = np.abs(samples).max(axis=1)
        scale = peak.max()
        if scale == 0.0:
            return Window(None, tuple(notices))
        tapered = samples * (taper / scale)
        if not taper[1] * taper[-2]:  # the taper of a part is narrow, and a constant would leak into the band
            tapered -= tapered.sum(axis=1, keepdims=True) * (taper / taper.sum())
        tapered = tapered.astype(np.float32)
        spectra = self._spectra(tapered)
        power = (spectra.real**2 + spectra.imag**2).astype(np.float64)
        whole, alike = np.median(power, axis=0) * float(scale) ** 2, _alike(spectra, power)
        if tones is not None:
            spectra, power = np.where(tones, 0.0, spectra), np.where(tones, 0.0, power)
        level = power.sum(axis=1)
        if np.sqrt(2 * level.max()) < _ROUNDED * self.band.size:
            return Window(None, tuple(notices))
        dead, faint = level <= 1e-6 * np.median(level), level <= 1e-6 * level.max()
        faint |= np.sqrt(2 * level) * scale < _ROUNDING * self.band.size
        believed, found = _believed(samples, peak, dead, broken)
        good = believed
        if order is not None:
            spectra, good, faint = spectra[order], good[order], faint[order]
        if turn is not None:
            spectra = spectra * turn
        whitened = correlation.whiten(spectra, self.beta)
        gcc = self.gcc(whitened)
        good, twins = self._without_twins(gcc, good, faint)
        alive = not dead.all()
        # A channel of noise would hide in a mean how loud speech is in the others.
        usual = np.median(power[~dead], axis=0) if alive else np.zeros(power.shape[1])
        heard = (tapered[believed if believed.any() else slice(None)] ** 2).sum(axis=0, dtype=np.float64)
        size = self.band.size
        correlated = Correlated(
            gcc,
            spectra,
            whitened,
            good,
            part=float(np.count_nonzero(taper)) / size,
            centre=float(heard @ np.arange(size) / heard.sum() - 0.5 * (size - 1)) / self.sample_rate,
            energy=float(np.median(level[~dead])) * float(scale) ** 2 if alive else 0.0,
            occupancy=occupancy(usual),
            power=usual * float(scale) ** 2,
            whole=whole,
            alike=alike,
        )
        return Window(correlated, (*notices, *found, *twins))

    def _spectra(self, tapered: np.ndarray) -> np.ndarray:
        return np.fft.rfft(tapered, axis=1)[:, self.band.bins]

    def _without_twins(self, gcc: np.ndarray, good: np.ndarray, faint: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """Return which channels (m,) are good and no copy of another one, and a notice of all copies of one signal.

        Faint channels, (m,) bool, are not compared: what rings in them before the sound itself arrives is alike, and so
        is what computing leaves after its end.
        """
        compared = good & ~faint
        same = (gcc[:, self.half_lags] > 0.99) & (self.baseline > 0.01)
        same &= compared[self.first] & compared[self.second]
        if not same.any():
            return good, []
        copies = np.eye(len(good), dtype=bool)
        copies[self.first[same], self.second[same]] = copies[self.second[same], self.first[same]] = True
        linked = np.linalg.matrix_power(copies, len(good))
        twins = [np.flatnonzero(group) for group in np.unique(linked, axis=0) if group.sum() > 1]
        notices = [f"{_listed(channels + 1, len(good))} are the same signal and left out" for channels in twins]
        return good & (linked.sum(axis=0) == 1), notices


def _listed(numbers: np.ndarray, count: int) -> str:
    """Return the numbers of at least two of so many channels as "channels 1, 2 and 3"."""
    if len(numbers) == count:
        return "all channels"
    return f"channels {', '.join(map(str, numbers[:-1]))} and {numbers[-1]}"


def _alike(spectra: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Return the squared length (bins,) of the mean phase of spectra (m, bins) with some power (m, bins)."""
    sounding = np.count_nonzero(power, axis=0)
    total = (spectra / np.sqrt(np.maximum(power, np.finfo(float).tiny))).sum(axis=0)
    return (np.abs(total) / np.maximum(sounding, 1)) ** 2


def finite(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the samples (m, n) with 0 for NaN and infinity, which channels (m,) held many of them, and notices."""
    numbers = np.isfinite(samples)
    count = (~numbers).sum(axis=1)
    notices = [f"channel {c + 1}: samples that are not numbers count as 0" for c in np.flatnonzero(count)]
    return np.where(numbers, samples, 0.0), count > 0.01 * samples.shape[1], notices


def _believed(
    samples: np.ndarray, peak: np.ndarray, dead: np.ndarray, broken: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Tell which channels (m,) can be believed, and what is wrong with the others.

    Args:
        samples: (m, n), finite.
        peak: (m,) the largest magnitude of each.
        dead, broken: (m,) bool, channels without sound, and with many samples that are not numbers.
    """
    clipped = peak > 0.05
    if clipped.any():
        clipped &= (np.abs(samples) >= 0.9999 * peak[:, None]).mean(axis=1) > 0.005
    shift = np.abs(samples.mean(axis=1))
    shifted = shift > 0.01
    if shifted.any():
        shifted &= shift > samples.std(axis=1)
    notices = [f"channel {c + 1} is clipped" for c in np.flatnonzero(clipped)]
    good = ~(dead | broken)
    if (good & ~clipped).sum() >= max(5, 0.5 * len(good)):
        good &= ~clipped
    # The band has no constant in it, so that shifted channels still serve where there are too few others.
    spared = (good & ~shifted).sum() >= 4
    what = "is shifted by a constant (DC)" + " and left out" * bool(spared)
    notices += [f"channel {c + 1} {what}" for c in np.flatnonzero(shifted & ~dead)]
    if spared:
        good &= ~shifted
    return good, notices


@dataclass(frozen=True)
class Heard:
    """The windows around one moment in which something sounds, without the channels that are left out.

    Attributes:
        gccs: (windows, pairs, lags), scaled up for the pairs that are missing.
        spectra: (windows, m, bins), whitened; 0 in channels that are left out.
        gains: (windows,) float32, how much each window counts.
        offsets: (windows,) s from the moment to the middle of each one's energy.
        middles: (windows,) s from the moment to the middle of each.
        count: how many whole windows they amount to.
        channels: how many channels there are in the mean, at least 4.
        pairs: (pairs,) bool, whose GCCs are in any window: of channels that are left out there are none.
        power: (windows, bins) median over the channels of the squared spectra, as if the stream held each window whole.
        steady: (k, 3) m where something sounds that is no talker, see `steady`.
        above: (windows, bins) float32, the share of each bin's power that is not the floor's, from 0 to 1; None where
            no steady source is known.
    """

    gccs: np.ndarray
    spectra: np.ndarray
    gains: np.ndarray
    offsets: np.ndarray
    middles: np.ndarray
    count: float
    channels: float
    pairs: np.ndarray
    power: np.ndarray
    steady: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    above: np.ndarray | None = None


def together(windows: list[tuple[Correlated, float]], out: np.ndarray) -> Heard | None:
    """Put windows around one moment together but those that are `FAINT`, None where too few channels are left in any.

    Args:
        windows: each with its offset in s from the moment.
        out: (m,) bool, which channels are left out.
    """
    gccs, spectra, shares, parts, offsets, middles, powers, channels, pairs = [], [], [], [], [], [], [], [], []
    first, second = correlation.pairs(len(out))
    usable = [(window, offset) for window, offset in windows if (window.good & ~out).sum() >= 4]
    loudest = max((float(window.power.sum()) for window, _ in usable), default=0.0)
    for window, offset in usable:
        if window.power.sum() < FAINT * loudest:
            continue
        good = window.good & ~out
        channels.append(float(good.sum()))
        kept = good[first] & good[second]
        pairs.append(kept)
        whole = bool(good.all())
        gccs.append(window.gcc if whole else window.gcc * kept[:, None])
        spectra.append(window.whitened if whole else window.whitened * good[:, None])
        shares.append(1.0 if whole else kept.sum() / len(kept))
        parts.append(window.part)
        offsets.append(offset)
        middles.append(offset - window.centre)
        powers.append(window.power / window.part)
    if not gccs:
        return None
    weights = np.array(shares) * parts
    gains = (weights / weights.mean() / shares).astype(np.float32)
    return Heard(
        np.stack(gccs) * gains[:, None, None],
        np.stack(spectra),
        gains,
        np.array(offsets),
        np.array(middles),
        float(weights.sum()),
        float(np.mean(channels)),
        np.any(pairs, axis=0),
        np.stack(powers),
    )
