"""Noise at microphones: their own noise, and the diffuse noise of a room."""

import numpy as np
from numpy.typing import ArrayLike

from avcli.numeric import SPEED_OF_SOUND_M_S, fft_length

FRAME = 4096
"""samples of a frame of room noise; frames overlap by half."""
BLOCK = 8192
"""samples of sensor noise that are drawn at a time."""
MIXED = 1 << 20
"""coefficients of the matrices that mix diffuse noise, at a time; it bounds the memory."""
LOWEST_HZ = 50.0
"""Hz; room noise has no power below it, and 3 dB an octave less above it."""


def diffuse_mixing(frequencies_hz: ArrayLike, microphones_m: ArrayLike, speed_of_sound_m_s: float) -> np.ndarray:
    """Return what mixes independent noises to diffuse noise at microphones, (n, m, m): one matrix a frequency.

    The coherence of two microphones at a distance d is then sin(k d) / (k d), k = 2π f / c (E. A. P. Habets and
    S. Gannot, 2007), as where sound comes equally from all directions.

    Args:
        frequencies_hz: (n,) Hz.
        microphones_m: (m, 3) m.
        speed_of_sound_m_s: m/s.
    """
    microphones, frequencies = np.asarray(microphones_m, dtype=float), np.asarray(frequencies_hz, dtype=float)
    distances = np.linalg.norm(microphones[:, None] - microphones[None], axis=2)
    coherence = np.sinc(2 * frequencies[:, None, None] * distances / speed_of_sound_m_s)
    return np.linalg.cholesky(coherence + 1e-9 * np.eye(len(microphones)))


def diffuse_noise(
    count: int, microphones_m: ArrayLike, sample_rate_hz: float, speed_of_sound_m_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Return white diffuse noise of variance 1 at microphones, (m, count); see `diffuse_mixing`.

    Args:
        count: samples.
        microphones_m: (m, 3) m.
        sample_rate_hz: Hz.
        speed_of_sound_m_s: m/s.
        rng: draws it.
    """
    microphones = np.asarray(microphones_m, dtype=float)
    length = fft_length(count)
    spectra = np.fft.rfft(rng.standard_normal((len(microphones), length)))
    frequencies = np.fft.rfftfreq(length, 1 / sample_rate_hz)
    at_once = max(1, MIXED // len(microphones) ** 2)
    for first in range(0, len(frequencies), at_once):
        part = slice(first, first + at_once)
        mixing = diffuse_mixing(frequencies[part], microphones, speed_of_sound_m_s)
        spectra[:, part] = (mixing @ spectra[:, part].T[:, :, None])[:, :, 0].T
    return np.fft.irfft(spectra, length)[:, :count]


class Noise:
    """Noise at microphones, the same to the last bit in pieces of any length.

    Sensor noise is white and independent. Room noise is pink and diffuse; see `diffuse_mixing`.

    Args:
        microphones_m: (m, 3) m.
        sample_rate_hz: Hz.
        sensor_pa: root mean square of the sensor noise, Pa.
        room_pa: root mean square of the room noise, Pa.
        speed_of_sound_m_s: m/s.
        seed: seed of all chance.
    """

    def __init__(
        self,
        microphones_m: ArrayLike,
        sample_rate_hz: float,
        sensor_pa: float = 0.0,
        room_pa: float = 0.0,
        speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S,
        seed: int = 0,
    ):
        microphones = np.asarray(microphones_m, dtype=float)
        self._count, self._sensor_pa, self._room_pa, self._seed = len(microphones), sensor_pa, room_pa, seed
        frequencies = np.fft.rfftfreq(FRAME, 1 / sample_rate_hz)
        self._mixing = diffuse_mixing(frequencies, microphones, speed_of_sound_m_s)
        power = np.where(frequencies >= LOWEST_HZ, LOWEST_HZ / np.maximum(frequencies, LOWEST_HZ), 0.0)
        self._shape = np.sqrt(power * FRAME**2 / (4 * power.sum()))
        self._window = np.sin(np.pi * (np.arange(FRAME) + 0.5) / FRAME)
        self._frames: dict[int, np.ndarray] = {}

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return the noise from sample `begin` to before `end`, (m, n) Pa; a later call must not begin earlier."""
        noise = np.zeros((self._count, end - begin))
        if self._sensor_pa > 0:
            for block in range(begin // BLOCK, -(-end // BLOCK)):
                drawn = self._rng(0, block).normal(scale=self._sensor_pa, size=(self._count, BLOCK))
                _add(noise, drawn, block * BLOCK - begin)
        if self._room_pa > 0:
            hop = FRAME // 2
            self._frames = {index: frame for index, frame in self._frames.items() if (index + 2) * hop > begin}
            for index in range(begin // hop - 1, -(-end // hop)):
                if index not in self._frames:
                    self._frames[index] = self._room_frame(index)
                _add(noise, self._frames[index], index * hop - begin)
        return noise

    def _room_frame(self, index: int) -> np.ndarray:
        drawn = self._rng(1, index).normal(size=(2, len(self._shape), self._count, 1))
        spectra = (self._mixing @ (drawn[0] + 1j * drawn[1]))[:, :, 0] * (self._room_pa * self._shape)[:, None]
        return np.fft.irfft(spectra, FRAME, axis=0).T * self._window

    def _rng(self, kind: int, index: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, kind, index + 1])


def _add(total: np.ndarray, part: np.ndarray, at: int) -> None:
    """Add a part to the total where they overlap; `at` is the index of the part's beginning."""
    first, last = max(at, 0), min(at + part.shape[1], total.shape[1])
    if last > first:
        total[:, first:last] += part[:, first - at : last - at]
