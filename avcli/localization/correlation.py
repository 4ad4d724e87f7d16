"""Windowed spectra and generalised cross-correlation of microphone pairs, on numpy.fft alone."""

from functools import lru_cache

import numpy as np

from avcli.numeric import fft_length


@lru_cache(maxsize=8)
def hann(size: int) -> np.ndarray:
    """Return the symmetric Hann window, (size,) float64 (Harris 1978, equation 27b)."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / max(size - 1, 1))


PAIRS, PARTNERS = 256, 16
"""About how many pairs are taken of many channels, and the least number of channels that each is paired with. Of 32
microphones in a room with a T60 of 0.7 s, all 496 pairs had a median error of 4 mm, 256 pairs 7 mm, 160 pairs 20 mm."""


@lru_cache(maxsize=8)
def pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and second channel of every pair that is correlated, two (pairs,) integer arrays.

    Up to 23 channels, these are all pairs. Of more, each channel is paired with as many others, so many places further
    in a circle of the channels: all pairs would cost much more than they tell, since their noise is shared.
    """
    first, second = np.triu_indices(count, 1)
    distances = max(-(-PAIRS // max(count, 1)), PARTNERS // 2)
    if distances >= count // 2:
        return first, second
    chosen = np.rint(np.linspace(1, (count - 1) // 2, distances)).astype(np.intp)
    apart = second - first
    kept = np.isin(apart, chosen) | np.isin(count - apart, chosen)
    return first[kept], second[kept]


def high_pass(samples: np.ndarray, sample_rate: float, cutoff: float) -> np.ndarray:
    """Remove what lies below a cutoff, without delay: a raised-cosine edge from half the cutoff to the cutoff.

    Args:
        samples: (n, channels).
        sample_rate: Hz.
        cutoff: Hz; 0 leaves the samples as they are.

    Returns:
        (n, channels) float64. The ends are mirrored outwards, so that no step rings there.
    """
    samples = np.asarray(samples, dtype=np.float64)
    if cutoff <= 0.0 or len(samples) == 0:
        return samples
    margin = min(len(samples) - 1, int(np.ceil(4.0 * sample_rate / cutoff)))
    head, tail = samples[margin:0:-1], samples[-2 : -2 - margin : -1]
    extended = np.concatenate([2.0 * samples[0] - head, samples, 2.0 * samples[-1] - tail]) if margin else samples
    size = fft_length(len(extended))
    frequency = np.fft.rfftfreq(size, 1.0 / sample_rate)
    gain = 0.5 - 0.5 * np.cos(np.pi * np.clip(2.0 * frequency / cutoff - 1.0, 0.0, 1.0))
    filtered = np.fft.irfft(np.fft.rfft(extended, size, axis=0) * gain[:, None], size, axis=0)
    return filtered[margin : margin + len(samples)]


def whiten(spectra: np.ndarray, beta: float) -> np.ndarray:
    """Divide each bin by its magnitude to the power beta; an empty bin stays empty.

    Args:
        spectra: (channels, bins) complex.
        beta: 0 (plain cross-correlation) to 1 (phase transform).

    Returns:
        (channels, bins) complex64.
    """
    magnitude = np.abs(spectra)
    floor = np.maximum(magnitude.max(axis=1, keepdims=True, initial=0.0) * 1e-7, 1e-30)
    return (spectra / np.maximum(magnitude, floor) ** beta).astype(np.complex64)


def gcc(
    whitened: np.ndarray,
    bins: slice,
    window_size: int,
    lags: int,
    oversampling: float = 1.0,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """Cross-correlate every pair of channels from whitened spectra of one band (Knapp & Carter 1976).

    A pair's value at lag l is the mean over the band's bins of the cross-spectrum turned by l, so that it is 1 where
    two channels (beta = 1) are equal but for that lag. A positive lag says that the pair's first channel is later.

    Args:
        whitened: (channels, band bins) complex, as `whiten` gives.
        bins: where the band lies in the spectrum.
        window_size: samples that the spectrum was taken of.
        lags: half width H of the result, in steps of 1 / oversampling samples.
        oversampling: lag steps per sample; window_size * oversampling must be an even integer above 2 H.
        weight: (band bins,) weights of the bins; all equal where None.

    Returns:
        (pairs, 2 H + 1) float32, lags -H to H.
    """
    first, second = pairs(len(whitened))
    turned = whitened.conj()
    if weight is not None:
        turned = turned * weight
    cross = whitened[first] * turned[second]
    total = (np.abs(whitened) @ np.abs(turned).T)[first, second]
    total[total == 0.0] = 1.0
    size = round(window_size * oversampling)
    spectrum = np.zeros((len(first), size // 2 + 1), np.complex64)
    spectrum[:, bins] = cross * (0.5 * size / total)[:, None]
    correlation = np.fft.irfft(spectrum, size, axis=1)
    return np.concatenate([correlation[:, -lags:], correlation[:, : lags + 1]], axis=1)


def interpolate_peak(before: np.ndarray, peak: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the vertex of the parabola through three neighbours, in steps from the middle one, within ±0.5."""
    curvature = before - 2.0 * peak + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(curvature < 0.0, 0.5 * (before - after) / curvature, 0.0)
    return np.clip(offset, -0.5, 0.5)
