"""When something sounds: short-time energy, a causal noise floor, and how much of the spectrum is in use."""

from collections import deque

import numpy as np

from avcli.localization import correlation
from avcli.numeric import fft_length


def short_time_energy(samples: np.ndarray, window_size: int) -> np.ndarray:
    """Return the mean of the squared samples under a Hann window around each sample.

    Args:
        samples: (n, channels).
        window_size: samples.

    Returns:
        (n, channels) float64, not below 0.
    """
    samples = np.asarray(samples, dtype=np.float64)
    taper = correlation.hann(window_size)
    size = fft_length(len(samples) + window_size)
    spectrum = np.fft.rfft(samples**2, size, axis=0) * np.fft.rfft(taper / taper.sum(), size)[:, None]
    smoothed = np.fft.irfft(spectrum, size, axis=0)
    begin = window_size // 2
    return np.maximum(smoothed[begin : begin + len(samples)], 0.0)


def crossings(energy: np.ndarray, threshold: float, minimum_gap: int) -> np.ndarray:
    """Return the samples of the events, of which there is one every `minimum_gap` samples while the energy is high.

    Args:
        energy: (n,).
        threshold: what the energy must exceed.
        minimum_gap: samples between two events, at least 1.

    Returns:
        (events,) ascending indices.
    """
    above = np.flatnonzero(energy > threshold)
    events = []
    position = 0
    while position < len(above):
        events.append(above[position])
        position = np.searchsorted(above, above[position] + minimum_gap)
    return np.array(events, dtype=np.int64)


def occupancy(power: np.ndarray, floor: float = 1e-4) -> float:
    """Return the share of bins within a factor `floor` of the strongest: speech fills a band, a tone a few lines.

    Args:
        power: (bins,) of one spectrum.
        floor: relative power.
    """
    peak = power.max(initial=0.0)
    return float(np.mean(power > floor * peak)) if peak > 0.0 else 0.0


class Gate:
    """Tells sound from the room's noise, causally: a minimum-tracking noise floor and two thresholds.

    The floor is the least energy of the last `memory` seconds (Martin 2001, without its bias correction: windows of a
    fifth of a second scatter by less than the lower threshold). The gate opens where the energy exceeds the floor by
    `opening` and closes where it falls below `closing`; until the floor has been seen for `settling` it is open, and
    what is louder than nothing passes.

    Args:
        rate: decisions per second.
        opening, closing: dB above the floor.
        memory, settling: s.
    """

    def __init__(
        self, rate: float, *, opening: float = 2.0, closing: float = 1.0, memory: float = 5.0, settling: float = 0.5
    ):
        self.opening, self.closing = 10.0 ** (opening / 10.0), 10.0 ** (closing / 10.0)
        self.history: deque[float] = deque(maxlen=max(1, round(memory * rate)))
        self.settled = max(1, round(settling * rate))
        self.open = False

    def __call__(self, energy: float) -> bool:
        """Take the next window's energy and return whether it holds sound."""
        self.history.append(energy)
        floor = min(self.history)
        if len(self.history) <= self.settled:
            self.open = energy > 0.0
        else:
            self.open = energy > floor * (self.closing if self.open else self.opening)
        return self.open
