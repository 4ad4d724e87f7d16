"""What noise alone does to the steered response: the law from which the detection threshold follows."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from avcli.localization import correlation
from avcli.localization.windows import Correlator

DRAWS, FEW_DRAWS, MANY_PAIRS = 32, 12, 200
"""How many draws of noise the law is fitted to; fewer from so many pairs of microphones on, where each is dear. The
threshold then deviates by 10 % from draw to draw, instead of by 6."""


class Search(Protocol):
    """What is searched for the largest response: places of a room, or rays from an array."""

    microphones: np.ndarray

    def search(self, gcc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places (n, 3) m, best first, and their responses (n,)."""
        ...


@dataclass(frozen=True)
class NoiseLaw:
    """The Gumbel law of the largest response to noise, and the standard deviation of a GCC of noise.

    Attributes:
        location, scale: of the Gumbel law.
        deviation: of the mean GCC of the windows.
        windows: how many windows it is of.
    """

    location: float
    scale: float
    deviation: float
    windows: float

    def threshold(self, false_alarm: float) -> float:
        """Return the response that noise exceeds with this probability."""
        return float(self.location - self.scale * np.log(-np.log1p(-false_alarm)))

    def of(self, windows: float) -> "NoiseLaw":
        """Return the law of another number of windows: it rises as one over the square root of their number."""
        factor = float(np.sqrt(self.windows / windows))
        return NoiseLaw(self.location * factor, self.scale * factor, self.deviation * factor, windows)


def draw_noise_law(
    correlator: Correlator, response: Search, hop: int, windows: int, rng: np.random.Generator
) -> NoiseLaw:
    """Fit the law by its moments to draws of white noise, independent in each channel.

    Args:
        correlator: of the array.
        response: the search whose peaks are taken.
        hop: samples between two windows.
        windows: how many windows a decision has.
        rng: draws the noise.
    """
    draws = DRAWS if len(correlator.first) < MANY_PAIRS else FEW_DRAWS
    size, count = correlator.band.size, draws + windows - 1
    noise = rng.standard_normal((len(response.microphones), size + hop * (count - 1)), np.float32)
    taper = correlation.hann(size).astype(np.float32)
    gccs = [correlator.gcc(correlator.whitened(noise[:, i * hop :][:, :size] * taper)) for i in range(count)]
    means = [np.sum(gccs[i : i + windows], axis=0) / windows for i in range(draws)]
    peaks = [response.search(mean)[1][0] for mean in means]
    scale = float(np.std(peaks) * np.sqrt(6.0) / np.pi)
    deviation = float(np.sqrt(np.mean([np.mean(mean**2) for mean in means])))
    return NoiseLaw(float(np.mean(peaks) - np.euler_gamma * scale), scale, deviation, windows)
