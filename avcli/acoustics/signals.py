"""Dry sound: recordings made ready to be spoken by someone.

A sample of 1.0 is 1 Pa at a microphone, and a source signal s is heard at r metres as s / (4π r).
"""

import numpy as np

PASCAL_AT_0_DB = 2e-5
"""Pa, the reference of sound pressure levels."""
FRAME_S = 0.01
"""s, the frames in which it is told whether a voice sounds."""
FADE_S = 0.02
"""s, in which a voice fades out that is cut off."""
QUIET_DB = -35.0
"""dB; a frame this far below a voice's level is no sound of it."""


def pascal(level_db_spl: float) -> float:
    """Return the root mean square pressure of a level, Pa."""
    return PASCAL_AT_0_DB * 10 ** (level_db_spl / 20)


def resample(signal: np.ndarray, from_hz: int, to_hz: int) -> np.ndarray:
    """Resample a signal by its spectrum: exact for what is below both Nyquist frequencies, nothing beyond.

    Args:
        signal: (n,).
        from_hz: its sample rate, Hz.
        to_hz: the wanted sample rate, Hz.

    Returns:
        (⌈n · to / from⌉,) float64; sample 0 is at the same time as before.
    """
    signal = np.asarray(signal, dtype=float)
    if from_hz == to_hz or len(signal) == 0:
        return signal
    divisor = int(np.gcd(from_hz, to_hz))
    up, down = to_hz // divisor, from_hz // divisor
    blocks = -(-(len(signal) + from_hz // 10) // down)  # zeros after the end keep it from ringing into the beginning
    spectrum = np.fft.rfft(signal, blocks * down)
    bins = min(len(spectrum), blocks * up // 2 + 1)
    if up < down:  # a soft edge below the new Nyquist frequency
        edge = np.clip((np.arange(bins) / (bins - 1) - 0.94) / 0.06, 0.0, 1.0)
        spectrum = spectrum[:bins] * (0.5 + 0.5 * np.cos(np.pi * edge))
    return np.fft.irfft(spectrum, blocks * up)[: -(-len(signal) * up // down)] * (up / down)


def frame_levels(signal: np.ndarray, sample_rate_hz: float) -> np.ndarray:
    """Return the root mean square of each frame of FRAME_S, (frames,); the last may be shorter."""
    count = int(np.ceil(len(signal) / (FRAME_S * sample_rate_hz)))
    starts = np.rint(np.arange(count) * FRAME_S * sample_rate_hz).astype(int)
    starts = starts[starts < len(signal)]
    if len(starts) == 0:
        return np.zeros(0)
    return np.sqrt(np.add.reduceat(signal**2, starts) / np.diff(np.append(starts, len(signal))))


def active_level(signal: np.ndarray, sample_rate_hz: float) -> float:
    """Return the root mean square of a signal over the frames in which it sounds; 0 for silence.

    A frame sounds if it is at most 30 dB below the loudest.
    """
    levels = frame_levels(np.asarray(signal, dtype=float), sample_rate_hz)
    if len(levels) == 0 or levels.max() == 0:
        return 0.0
    return float(np.sqrt(np.mean(levels[levels > levels.max() * 10**-1.5] ** 2)))


def at_level(signal: np.ndarray, sample_rate_hz: float, level_db_spl: float) -> np.ndarray:
    """Scale a recording to a source signal of a level, dB SPL at 1 m while it sounds; silence stays silence."""
    level = active_level(signal, sample_rate_hz)
    wanted = 4 * np.pi * pascal(level_db_spl)
    return np.asarray(signal, dtype=float) * (wanted / level if level > 0 else 0.0)


def power_spectrum(signal: np.ndarray, sample_rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a signal's power spectrum, (n,), and its frequencies, (n,) Hz."""
    return np.abs(np.fft.rfft(signal)) ** 2, np.fft.rfftfreq(len(signal), 1 / sample_rate_hz)


def bandwidth(signal: np.ndarray, sample_rate_hz: float, error_db: float) -> float:
    """Return the frequency, Hz, above which a signal holds less than an error (dB) of its power."""
    power, frequencies = power_spectrum(signal, sample_rate_hz)
    rest = np.cumsum(power[::-1])[::-1]
    above = np.flatnonzero(rest > 10 ** (error_db / 10) * rest[0]) if len(rest) else []
    return float(frequencies[above[-1]]) if len(above) else 0.0


class Voice:
    """Someone's voice: a recording that is said again and again for as long as it is their turn.

    A turn begins with the beginning of the recording and fades out within FADE_S where it is cut off.

    Args:
        recording: (n,) source signal.
        sample_rate_hz: Hz.
        pause_s: s between the end of the recording and its next beginning.
    """

    def __init__(self, recording: np.ndarray, sample_rate_hz: float, pause_s: float = 0.15):
        self._cycle = np.concatenate([recording, np.zeros(round(pause_s * sample_rate_hz))])
        self._fade = round(FADE_S * sample_rate_hz)
        self._place, self._speaking = 0, False

    def emit(self, count: int, speaking: bool) -> np.ndarray:
        """Return the next `count` samples, in which it is or is not its turn."""
        if not speaking and not self._speaking:
            return np.zeros(count)
        if not self._speaking:
            self._place = 0
        sound = self._cycle[(self._place + np.arange(count)) % len(self._cycle)]
        self._place = (self._place + count) % len(self._cycle)
        if not speaking:
            fade = min(self._fade, count)
            sound[:fade] *= 0.5 + 0.5 * np.cos(np.pi * (np.arange(fade) + 0.5) / fade)
            sound[fade:] = 0.0
        self._speaking = speaking
        return sound
