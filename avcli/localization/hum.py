"""The mains' hum and other steady tones that are in all channels alike: they come by cable, and are no sound.

Such a tone looks like a source at which all delays are none; one that is louder than the voice hides it, and what the
taper spreads of it lies over its neighbours. The frequencies in which the quietest moments of the last seconds stand
out of those around them are left out of everything. Tones of a machine in the room have other phases in each channel;
they tell that it is one.
"""

from collections import deque

import numpy as np

from avcli.localization.windows import Band

LEAKS, HEARD, LOUDER = (1.0, 0.25, 0.01, 5e-4, 8e-5), 0.75, 0.5
"""What the taper spreads of a tone over the bins beside it; the share of the time in which a voice is not louder than
what is usual while somebody speaks, and by how much of that a bin is disturbed."""
MEMORY_S, LEAST_S, QUANTILE = 3.0, 1.0, 0.2
"""s that are remembered, from how many s on tones are looked for, and the share of them that is quieter than what
counts: a voice comes and goes, and its pitch changes."""
AROUND_HZ, USUAL, ABOVE, STEADY = 80.0, 0.25, 16.0, 1.5
"""Hz to each side in which a tone must stand out, of which share of these it must, and by which power; and what the
median over the time may be over the quiet moments."""
ALIKE = 0.7
"""A tone is in all channels alike if the mean of their phases, as unit vectors, has at least this squared length."""


class Hum:
    """Learns, window by window, which bins hold steady tones.

    Args:
        band: of the windows.
        sample_rate: Hz.
        hop: s between windows.

    Attributes:
        bins: (bins,) bool, those that hold one; None: no tone is known.
    """

    def __init__(self, band: Band, sample_rate: float, hop: float):
        self.width = sample_rate / band.size
        self.first = band.bins.start
        self.memory, self.least = max(5, round(MEMORY_S / hop)), max(5, round(LEAST_S / hop))
        self.half = round(AROUND_HZ / self.width)
        self.told = False
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after a gap in the stream."""
        self.history: deque[np.ndarray] = deque(maxlen=self.memory)
        self.phases: deque[np.ndarray] = deque(maxlen=self.memory)
        self.bins: np.ndarray | None = None
        self.lasted = np.zeros(0, int)  # windows on end in which each bin stood out

    def take(self, power: np.ndarray, alike: np.ndarray) -> None:
        """Take the power (bins,) of a whole window, tones and all, and how far its channels are alike (bins,)."""
        self.history.append(power)
        self.phases.append(alike)
        if len(self.history) < self.least:
            return
        count = len(self.history)
        low, middle, high = int(QUANTILE * count), count // 2, int(HEARD * count)
        ordered = np.partition(np.array(self.history), [low, middle, high], axis=0)
        floor = ordered[low]
        tones = (floor > ABOVE * self._around(floor, USUAL)) & (ordered[middle] < STEADY * floor)
        tones &= np.mean(self.phases, axis=0) > ALIKE
        self.lasted = (self.lasted + 1) * tones if len(self.lasted) else tones.astype(int)
        self.bins = None
        if tones.any():
            loud = np.pad(np.where(tones, floor, 0.0), len(LEAKS) - 1)
            beside = np.lib.stride_tricks.sliding_window_view(loud, 2 * len(LEAKS) - 1)
            spread = (beside * np.array([*LEAKS[:0:-1], *LEAKS])).max(axis=1)
            self.bins = tones | (spread > LOUDER * self._around(ordered[high], 0.5))

    def _around(self, power: np.ndarray, share: float) -> np.ndarray:
        """Return for each bin (bins,) the power that a share of those around it do not reach."""
        wide = np.pad(power, self.half, mode="reflect")
        each = np.lib.stride_tricks.sliding_window_view(wide, 2 * self.half + 1)[:: self.half]
        return np.interp(np.arange(len(power)), np.arange(len(each)) * self.half, np.quantile(each, share, axis=1))

    def news(self) -> list[str]:
        """Return a sentence about the loudest tones, once they have stood out for as long as is remembered."""
        lasting = self.lasted >= self.memory
        if self.told or not lasting.any():
            return []
        self.told = True
        power = np.where(lasting, np.median(self.history, axis=0), 0.0)
        beside = np.pad(power, 1)
        peaks = np.flatnonzero(lasting & (power >= beside[:-2]) & (power >= beside[2:]))
        loudest = np.sort(peaks[np.argsort(-power[peaks])[:3]])
        named = ", ".join(f"{(self.first + at) * self.width:.0f}" for at in loudest)
        return [f"steady tones, such as a hum, sound at {named} Hz; their frequencies are left out"]
