"""How the path of a moving source is sampled.

While a source moves by s, the phase of an image at frequency f turns by at most 2π f s / c. So the nodes of its path
are spaced in distance, not in time: a spacing below c / (2 f) is enough at every speed, and a source that stands still
needs one node.
"""

import bisect
import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli.numeric import SPEED_OF_SOUND_M_S

SLOWEST_M_S = 0.3
"""m/s; nodes are at least as frequent as at this speed, so that turning round is followed in time."""
NODES_TO_MICROPHONE = 5.0
"""nodes, at least, on a way as long as the distance to the nearest microphone."""


@dataclass(frozen=True)
class Interpolation:
    """Interpolation between nodes by a Kaiser-windowed sinc that is scaled to a partition of unity.

    Attributes:
        spacing_m: distance of the nodes, m.
        half_width: nodes on each side that contribute.
        table: the kernel from −half_width to half_width in steps of 1 / STEPS.
    """

    spacing_m: float
    half_width: int
    table: np.ndarray

    STEPS = 1024

    @functools.cached_property
    def _steps(self) -> np.ndarray:
        """What the kernel changes by from each place of the table to the next."""
        return np.append(np.diff(self.table), 0.0)

    @property
    def window_s(self) -> float:
        """Length of the window of a node at 1 m/s, s."""
        return 2 * self.half_width * self.spacing_m

    def nodes_a_second(self, speeds_m_s: np.ndarray, nearest_m: np.ndarray) -> np.ndarray:
        """Return how many nodes a second a source passes, (n,).

        Args:
            speeds_m_s: (n,) m/s.
            nearest_m: (n,) m, distance of the nearest microphone: close to it the sound changes within that distance.
        """
        paces = np.sqrt(np.sqrt(speeds_m_s**4 + SLOWEST_M_S**4))  # smooth, as the interpolation needs it
        return paces / np.minimum(self.spacing_m, nearest_m / NODES_TO_MICROPHONE)

    def weights(self, places: np.ndarray) -> np.ndarray:
        """Return the weights at places relative to a node, (n,) in units of the spacing: (n,)."""
        cells = (places + self.half_width) * self.STEPS
        np.maximum(np.minimum(cells, len(self.table) - 1.0, out=cells), 0.0, out=cells)
        below = cells.astype(np.intp)
        cells -= below
        cells *= self._steps.take(below)
        cells += self.table.take(below)
        return cells


def interpolation(
    power: ArrayLike,
    frequencies_hz: ArrayLike,
    error_db: float,
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
    half_width: int = 6,
) -> Interpolation:
    """Choose the widest spacing of nodes at which a signal is interpolated within an error.

    The error of the kernel at every frequency is weighted with the signal's power. It is computed for images straight
    ahead, where the phase turns fastest.

    Args:
        power: (n,) power spectrum of the dry signal, any unit.
        frequencies_hz: (n,) Hz.
        error_db: error power relative to the signal's, dB, below 0.
        speed_of_sound_m_s: m/s.
        half_width: nodes on each side that contribute.
    """
    power, frequencies = np.asarray(power, dtype=float), np.asarray(frequencies_hz, dtype=float)
    steps = Interpolation.STEPS
    places = (np.arange(2 * half_width * steps + 1) - half_width * steps) / steps
    beta = max(1.0, 0.12 * -error_db - 0.6)  # the window that reaches this error at the widest spacing
    kernel = np.sinc(places) * np.i0(beta * np.sqrt(np.maximum(0, 1 - (places / half_width) ** 2))) / np.i0(beta)
    kernel[[0, -1]] = 0.0
    sums = kernel[:-1].reshape(2 * half_width, steps).sum(axis=0)
    kernel /= np.append(np.tile(sums, 2 * half_width), sums[0])

    turns = np.linspace(0.0, 1.0, 101)  # of phase between two nodes
    offsets = places[:-1].reshape(2 * half_width, steps)[:, ::32]
    taps = kernel[:-1].reshape(2 * half_width, steps)[:, ::32]
    found = (np.exp(2j * np.pi * turns[:, None, None] * offsets) * taps).sum(axis=1)
    errors = np.mean(np.abs(found - 1) ** 2, axis=1)
    allowed = 10 ** (error_db / 10) * power.sum()
    bands = np.linspace(0.0, frequencies.max(initial=0.0) or 1.0, 2049)
    power = np.histogram(frequencies, bands, weights=power)[0]
    frequencies = (bands[1:] + bands[:-1]) / 2
    spacings = 0.25 * 0.99 ** np.arange(782)

    def is_close_enough(spacing: float) -> bool:
        lost = np.sum(power * np.interp(frequencies * spacing / speed_of_sound_m_s, turns, errors))
        return bool(lost <= allowed)

    chosen = bisect.bisect_left(spacings, True, hi=len(spacings) - 1, key=is_close_enough)
    return Interpolation(float(spacings[chosen]), half_width, kernel)


@dataclass(frozen=True)
class Switching:
    """Responses that are held for a time and then switched, as gpuRIR does it; for comparison.

    Attributes:
        step_s: s.
    """

    step_s: float

    half_width = 1

    @property
    def window_s(self) -> float:
        """Length of the window of a node, s."""
        return self.step_s

    def nodes_a_second(self, speeds_m_s: np.ndarray, nearest_m: np.ndarray) -> np.ndarray:
        """Return how many nodes a second a source passes at these speeds, (n,), at whatever distance."""
        return np.full(len(speeds_m_s), 1 / self.step_s)

    def weights(self, places: np.ndarray) -> np.ndarray:
        """Return the weights at places relative to a node, (n,) in steps: (n,)."""
        return (np.floor(places + 1e-9) == 0).astype(float)  # sums of steps are rounded: not a sample too late
