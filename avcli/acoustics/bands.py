"""Sound in octave bands: what materials, air and the head of a talker do to it, and how bands are joined to a spectrum.

Between the middles of two bands a gain goes from one to the other by a raised cosine of the octaves. The images of a
room are summed once for each band, and the sums are joined with these curves.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli import materials
from avcli.materials.decay import unmirrored

BANDS_HZ = (*materials.BANDS_HZ, 16000)
"""Hz, the middles of the octave bands; the walls absorb at 16 kHz as at 8 kHz."""
REACH_S = 0.012
"""s; what is joined from bands rings before and after an impulse for no longer, and hardly that long."""
BEHIND_DB = (2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 18.0, 22.0)
"""dB in BANDS_HZ, how much less of a voice is heard behind the head than in front: round figures of the order that
W. T. Chu and A. C. C. Warnock (2002, IRC-RR-104) and B. B. Monson, E. J. Hunter and B. H. Story (2012) measured."""


@dataclass(frozen=True)
class Bands:
    """What happens to sound in each of BANDS_HZ.

    Attributes:
        absorption: (6, 8) energy that the walls x0 x1 y0 y1 z0 z1 absorb, from 0 to 1.
        air: (8,) 1/m, the pressure decays by exp(−air · d) on a way d, by what stands in the room too.
        behind_db: (8,) dB by which the source is fainter behind it than in front; (1 − cos θ) / 2 of it at the angle θ.
        rt60_s: (8,) s, T30 of each band.
        scattering: (6, 8) share of the energy that the walls reflect without mirroring it; None: nothing.
    """

    absorption: np.ndarray
    air: np.ndarray
    behind_db: np.ndarray
    rt60_s: np.ndarray
    scattering: np.ndarray | None = None

    @property
    def lost(self) -> np.ndarray:
        """The energy that the walls do not mirror, (6, 8), from 0 to 1: they absorb it, or scatter it."""
        return self.absorption if self.scattering is None else unmirrored(self.absorption, self.scattering)

    @property
    def of_all_directions(self) -> np.ndarray:
        """The energy that the source sends out on the mean over all directions, (8,), relative to in front."""
        falls = np.maximum(np.log(10) / 10 * self.behind_db, 1e-9)
        return -np.expm1(-falls) / falls

    def gains(self, orders: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Return the gains of paths by walls and air, (n, 8), without sign.

        Args:
            orders: (6, n) how often each path has met each wall.
            distances: (n,) m.
        """
        walls = np.log(np.maximum(1 - self.lost, 1e-12)) / 2
        return np.exp(orders.T @ walls - np.outer(distances, self.air))

    def towards(self, cosines: np.ndarray) -> np.ndarray:
        """Return the gains of the source in directions at angles to where it looks, (n, 8).

        Args:
            cosines: (n,) of the angles.
        """
        return np.exp(-np.log(10) / 40 * np.outer(1 - cosines, self.behind_db))


def curves(frequencies_hz: ArrayLike) -> np.ndarray:
    """Return the share that each band has in the gain at frequencies, (8, n); they sum to 1.

    Args:
        frequencies_hz: (n,) Hz.
    """
    middles = np.log2(BANDS_HZ)
    octaves = np.clip(np.log2(np.maximum(frequencies_hz, 1.0)), middles[0], middles[-1])
    away = np.abs(octaves - middles[:, None])
    return np.where(away < 1, 0.5 + 0.5 * np.cos(np.pi * np.minimum(away, 1.0)), 0.0)


def spectra_of_bands(length: int, bins: int, sample_rate_hz: float) -> np.ndarray:
    """Return the bands' curves as spectra of zero phase whose responses last ±REACH_S, (8, bins).

    Args:
        length: samples of the transform.
        bins: the first bins that are wanted.
        sample_rate_hz: Hz.
    """
    responses = np.fft.irfft(curves(np.fft.rfftfreq(length, 1 / sample_rate_hz)), length)
    reach = min(reach_samples(sample_rate_hz), length // 2 - 1)
    window = np.zeros(length)
    taps = np.arange(-reach, reach + 1)
    window[taps] = 0.5 + 0.5 * np.cos(np.pi * taps / (reach + 1))
    return np.fft.rfft(responses * window).real[:, :bins]


def reach_samples(sample_rate_hz: float) -> int:
    """Return the samples before and after an impulse that `spectra_of_bands` may spread it to."""
    return int(np.ceil(REACH_S * sample_rate_hz))
