"""Which times and frequencies a talker explains, so that the next one is searched for in the others."""

import numpy as np

from avcli.localization.array import Array
from avcli.localization.windows import Correlator, Heard

AGREED_BY_CHANCE, AGREED_BY_A_TALKER = 0.125, 0.475
"""Agreement of the channels in a bin, up to which the mask keeps it whole, and from which it leaves nothing of it."""
LEAST_LEFT = 0.03
"""Share of the bins that must stand above the floor to be raised to the noise of all: a few would ring at all lags."""


class Masks:
    """Masks of one array.

    Args:
        array: the microphones.
        correlator: of the array.
    """

    def __init__(self, array: Array, correlator: Correlator):
        self.array, self.correlator = array, correlator

    def explained(self, heard: Heard) -> np.ndarray:
        """Return what is explained before any talker is found, (windows, bins): the coherence of steady sources."""
        each = [self.coherence(heard, place, np.zeros(3)) for place in heard.steady]
        return np.max([np.zeros_like(heard.power, np.float32), *each], axis=0)

    def masked(self, heard: Heard, explained: np.ndarray) -> np.ndarray:
        """Return GCCs (windows, pairs, lags) of those times and frequencies that are not explained yet.

        Speech is sparse: of two talkers one or the other is the louder in most bins (Yilmaz and Rickard 2004). A bin
        counts the less, the better the channels agree there on the peaks so far. What is left keeps its amplitude.
        Beside a steady source it counts the less, the nearer it is to the floor (Valin, Michaud & Rouat 2007); the
        amplitude is such that noise deviates as much as in whole windows, so that its law stays true.

        Args:
            heard: the windows.
            explained: (windows, bins), see `coherence`.
        """
        whole = self.correlator.band.weight
        agreed = explained / (whole * (heard.spectra.shape[1] - 1))
        kept = (AGREED_BY_A_TALKER - agreed) / (AGREED_BY_A_TALKER - AGREED_BY_CHANCE)
        weights = whole * np.clip(kept, 0.0, 1.0).astype(np.float32)
        totals = np.full(len(weights), whole.sum())
        if heard.above is not None:
            weights *= heard.above
            left = ((whole * heard.above) ** 2).sum(axis=1) / (whole**2).sum()
            totals *= np.sqrt(np.maximum(left, LEAST_LEFT))
        each = [
            self.correlator.gcc(spectra, weight) * (weight.sum() / total)
            for spectra, weight, total in zip(heard.spectra, weights, totals, strict=True)
        ]
        return np.stack(each) * heard.gains[:, None, None]

    def coherence(self, heard: Heard, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return how far the channels agree, bin by bin, on sound from a place that moves, (windows, bins).

        0 is what chance gives; neighbouring bins are averaged.

        Args:
            heard: the windows.
            position: (3,) m.
            velocity: (3,) m/s.
        """
        spectra = heard.spectra
        places = position + velocity * heard.offsets[:, None]
        ranges = np.linalg.norm(places[:, None] - self.array.microphones, axis=2)
        delays = (ranges - ranges.mean(axis=1, keepdims=True)) / self.array.speed_of_sound
        steered = (spectra * self.correlator.band.turned(delays, self.array.sample_rate)).sum(axis=1)
        power = (spectra.real**2 + spectra.imag**2).sum(axis=1)
        excess = steered.real**2 + steered.imag**2 - power
        coherence = self.correlator.band.weight * np.maximum(_smooth(excess) / np.maximum(_smooth(power), 1e-12), 0.0)
        return coherence if heard.above is None else coherence * heard.above


def _smooth(rows: np.ndarray) -> np.ndarray:
    """Return the sums of five neighbours in each row (n, bins); beyond the ends are zeros."""
    wide = np.pad(rows, ((0, 0), (2, 2)))
    count = rows.shape[1]
    return wide[:, :count] + wide[:, 1:-3] + wide[:, 2:-2] + wide[:, 3:-1] + wide[:, 4:]
