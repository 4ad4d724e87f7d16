"""Time differences of arrival between the microphones of an array, window by window."""

import numpy as np

from avcli.localization import correlation

WINDOW_S, HOP_S = 0.093, 0.05
BAND_HZ = (300.0, 8000.0)
_FINER = 4
_MARGIN_M = 0.3
"""How much longer than between its microphones a pair's delay may be: they may hang elsewhere than stated."""


def pair_delays(
    samples: np.ndarray, sample_rate: float, positions: np.ndarray, speed_of_sound: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find the delay of each microphone pair in every loud window, by GCC-PHAT (Knapp & Carter 1976).

    Args:
        samples: (n, m).
        sample_rate: Hz.
        positions: (m, 3) m, of the microphones.
        speed_of_sound: m/s.

    Returns:
        middles of the windows (k,) s from the first sample, and delays (k, pairs) s, arrival at a pair's first
        microphone minus at its second, pairs as correlation.pairs lists them; NaN where no peak stands out.
    """
    first, second = correlation.pairs(len(positions))
    reach = (np.linalg.norm(positions[first] - positions[second], axis=1) + _MARGIN_M) / speed_of_sound
    samples = correlation.high_pass(samples, sample_rate, 200.0)
    size, hop = 1 << round(np.log2(WINDOW_S * sample_rate)), round(HOP_S * sample_rate)
    lags = min(int(np.ceil(reach.max() * sample_rate * _FINER)), size * _FINER // 2 - 1)
    outside = np.abs(np.arange(-lags, lags + 1)) > np.ceil(reach * sample_rate * _FINER)[:, None]
    frequency = np.fft.rfftfreq(size, 1 / sample_rate)
    band = slice(*np.searchsorted(frequency, [BAND_HZ[0], min(BAND_HZ[1], 0.45 * sample_rate)]).tolist())
    window = correlation.hann(size)
    begins = np.arange(0, len(samples) - size + 1, hop)
    power = np.array([np.mean(samples[begin : begin + size] ** 2) for begin in begins])
    if len(begins):
        begins = begins[power > max(0.05 * np.quantile(power, 0.95), 1e-12)]
    delays = np.empty((len(begins), len(first)))
    pair = np.arange(len(first))
    for row, begin in enumerate(begins):
        spectra = np.fft.rfft(samples[begin : begin + size] * window[:, None], axis=0).T[:, band]
        gcc = correlation.gcc(correlation.whiten(spectra, 1.0), band, size, lags, _FINER)
        noise = np.sqrt(np.mean(np.where(outside, 0.0, gcc) ** 2, axis=1))
        gcc = np.where(outside, -1.0, gcc)
        at = np.clip(gcc.argmax(1), 1, 2 * lags - 1)
        peak = gcc[pair, at]
        shift = correlation.interpolate_peak(gcc[pair, at - 1], peak, gcc[pair, at + 1])
        delays[row] = np.where(peak > 5 * noise, (at - lags + shift) / (_FINER * sample_rate), np.nan)
    return (begins + size / 2) / sample_rate, delays
