"""Dry sound: recordings become the source signals of voices.

A sample of 1.0 is 1 Pa at a microphone, and a source signal s is heard at r metres as s / (4π r).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from avcli.formats.media import Sound

PASCAL_AT_0_DB = 2e-5
"""Pa, the reference of sound pressure levels."""
FRAME_S = 0.01
"""s; whether a voice sounds is decided for each frame of this length."""
FADE_S = 0.02
"""s in which a voice fades out at the end of its turn."""
QUIET_DB = -35.0
"""dB relative to a voice's level; in a fainter frame the voice is silent."""
CLIPPED_SHARE = 0.001
"""share of the samples at full scale from which on a recording is taken for clipped."""


def pascal(level_db_spl: float) -> float:
    """Return the root mean square pressure of a level, Pa."""
    return PASCAL_AT_0_DB * 10 ** (level_db_spl / 20)


def resample(signal: np.ndarray, from_hz: int, to_hz: int) -> np.ndarray:
    """Resample a signal by its spectrum: exact below both Nyquist frequencies, zero above the lower one.

    Args:
        signal: (n,).
        from_hz: its sample rate, Hz.
        to_hz: the new sample rate, Hz.

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
    """Return the root mean square of a signal (n,) over the frames in which it sounds; 0 for silence.

    A frame sounds if it is at most 30 dB below the loudest.
    """
    levels = frame_levels(np.asarray(signal, dtype=float), sample_rate_hz)
    if len(levels) == 0 or levels.max() == 0:
        return 0.0
    return float(np.sqrt(np.mean(levels[levels > levels.max() * 10**-1.5] ** 2)))


def at_level(signal: np.ndarray, sample_rate_hz: float, level_db_spl: float) -> np.ndarray:
    """Scale a recording, (n,), to a source signal with a level in dB SPL at 1 m; silence stays silent."""
    level = active_level(signal, sample_rate_hz)
    wanted = 4 * np.pi * pascal(level_db_spl)
    return np.asarray(signal, dtype=float) * (wanted / level if level > 0 else 0.0)


def source_signal(recording: Sound, sample_rate_hz: int, level_db_spl: float) -> np.ndarray:
    """Make a recording the source signal of a voice: the mean of its channels, resampled and brought to a level.

    Args:
        recording: of any rate and number of channels.
        sample_rate_hz: the wanted rate, Hz.
        level_db_spl: dB SPL at 1 m while it sounds.

    Returns:
        (n,) float64.
    """
    mono = np.asarray(recording.samples, dtype=float).mean(axis=1)
    return at_level(resample(mono, recording.sample_rate_hz, sample_rate_hz), sample_rate_hz, level_db_spl)


class SourceSignals(Sequence[np.ndarray]):
    """The source signals of recordings, each made when it is first asked for; see `source_signal`."""

    def __init__(self, recordings: Sequence[Sound], sample_rate_hz: int, level_db_spl: float):
        self._recordings, self._rate, self._level = recordings, sample_rate_hz, level_db_spl
        self._made: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._recordings)

    def __getitem__(self, number: Any) -> Any:
        if number not in self._made:
            self._made[number] = source_signal(self._recordings[number], self._rate, self._level)
        return self._made[number]


def recording_faults(recording: Sound) -> list[str]:
    """Return what is unusual about a recording for a voice, as ends of sentences that begin with its name."""
    faults = []
    channels = recording.samples.shape[1]
    if channels > 1:
        faults.append(f"has {channels} channels; the voice is their mean")
    mono = recording.samples.mean(axis=1)
    if not mono.any():
        faults.append("is silent from beginning to end")
    elif (abs(mono) >= 0.9999).sum() > CLIPPED_SHARE * len(mono):
        faults.append("is clipped")
    return faults


def power_spectrum(signal: np.ndarray, sample_rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a signal's power spectrum, (n,), and its frequencies, (n,) Hz."""
    return np.abs(np.fft.rfft(signal)) ** 2, np.fft.rfftfreq(len(signal), 1 / sample_rate_hz)


def bandwidth(power: np.ndarray, frequencies: np.ndarray, error_db: float) -> float:
    """Return the frequency, Hz, above which a power spectrum holds less than an error (dB) of its power."""
    rest = np.cumsum(power[::-1])[::-1]
    above = np.flatnonzero(rest > 10 ** (error_db / 10) * rest[0]) if len(rest) else np.zeros(0, int)
    return float(frequencies[above[-1]]) if len(above) else 0.0


class Voice:
    """A person's voice: a recording that is repeated for as long as it is their turn.

    A turn starts at the beginning of the recording; at its end the voice fades out within FADE_S.

    Args:
        recording: (n,) source signal.
        sample_rate_hz: Hz.
        pause_s: pause between two repetitions, s.
    """

    def __init__(self, recording: np.ndarray, sample_rate_hz: float, pause_s: float = 0.15):
        self._cycle = np.concatenate([recording, np.zeros(round(pause_s * sample_rate_hz))])
        self._fade = round(FADE_S * sample_rate_hz)
        self._place, self._speaking = 0, False

    def emit(self, count: int, speaking: bool) -> np.ndarray:
        """Return the next `count` samples, during the person's turn or not, (count,)."""
        if not speaking and not self._speaking:
            return np.zeros(count)
        if not self._speaking:
            self._place = 0
        sound = self._cycle.take(np.arange(self._place, self._place + count), mode="wrap")
        self._place = (self._place + count) % len(self._cycle)
        if not speaking:
            fade = min(self._fade, count)
            sound[:fade] *= 0.5 + 0.5 * np.cos(np.pi * (np.arange(fade) + 0.5) / fade)
            sound[fade:] = 0.0
        self._speaking = speaking
        return sound
