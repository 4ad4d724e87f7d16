"""The sound of one microphone for a page: to be heard, and to be seen as a waveform and a spectrogram."""

import base64
import io
import tempfile
from dataclasses import dataclass
from typing import Any

import numpy as np

_MOST_COLUMNS = 30_000  # a picture may be 65 535 px wide
_SHORTEST_COLUMN_S = 0.01
_BANDS, LOW_HZ, HIGH_HZ = 48, 80.0, 8000.0
_WINDOW_S = 0.032
_MOST_IN_MEMORY, _AT_ONCE = 1 << 25, 1 << 20  # samples
_RANGE_DB = 60.0
_MP3_RATES_HZ = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000)


@dataclass(frozen=True, eq=False)
class Track:
    """One channel of sound.

    Attributes:
        name: says what it is: "microphone 1".
        start_s: time of its first sample on the run's clock, s.
        rate_hz: sample rate, Hz.
        samples: (n,) full scale at 1.
        loudest: amplitude that is played and drawn at full scale; its own where None.
    """

    name: str
    start_s: float
    rate_hz: int
    samples: np.ndarray
    loudest: float | None = None

    @property
    def duration_s(self) -> float:
        """Its length, s."""
        return len(self.samples) / self.rate_hz


@dataclass(frozen=True, eq=False)
class Beam:
    """What the array hears at a track.

    Attributes:
        tracker: name of the stream of the track.
        identity: of the track.
        track: the sound, while the track is there.
    """

    tracker: str
    identity: Any
    track: Track


class Spool:
    """Space for samples: in memory, or, where they are many, in a file that nobody else sees and that goes by itself.

    Args:
        count: how many there are.

    Attributes:
        samples: (count,) float32, zeros.
    """

    def __init__(self, count: int):
        self.samples: np.ndarray
        if count <= _MOST_IN_MEMORY:
            self.samples = np.zeros(count, np.float32)
        else:
            with tempfile.TemporaryFile() as file:
                file.truncate(4 * count)
                self.samples = np.memmap(file, np.float32, "r+", shape=(count,))


def loudest(samples: np.ndarray) -> float:
    """Return the largest amplitude of samples (n,)."""
    blocks = (samples[begin : begin + _AT_ONCE] for begin in range(0, len(samples), _AT_ONCE))
    return max((float(np.abs(block).max(initial=0.0)) for block in blocks), default=0.0)


def mp3(track: Track) -> bytes:
    """Encode a track as MP3 with its loudest sample at -1 dB; every browser plays it."""
    import soundfile

    content = io.BytesIO()
    samples, rate = _playable(track)
    full = loudest(samples) if track.loudest is None else track.loudest
    gain = 0.89 / full if full > 0 else 1.0
    how = {"format": "MP3", "subtype": "MPEG_LAYER_III", "bitrate_mode": "CONSTANT", "compression_level": 0.8}
    with soundfile.SoundFile(content, "w", rate, 1, **how) as file:
        for begin in range(0, len(samples), _AT_ONCE):
            file.write(gain * samples[begin : begin + _AT_ONCE])
    return content.getvalue()


def _playable(track: Track) -> tuple[np.ndarray, int]:
    """The samples at a rate that MP3 has: their own, a part of it, or the highest one."""
    whole = next((n for n in range(1, 9) if track.rate_hz % n == 0 and track.rate_hz // n in _MP3_RATES_HZ), None)
    if whole == 1:
        return track.samples, track.rate_hz
    if whole is not None:  # the mean of a few samples: what lies above half the new rate is not worth a filter
        count = len(track.samples) // whole * whole
        return track.samples[:count].reshape(-1, whole).mean(axis=1, dtype=np.float32), track.rate_hz // whole
    rate = max(_MP3_RATES_HZ)
    times = np.arange(int(len(track.samples) * rate / track.rate_hz)) * (track.rate_hz / rate)
    return np.interp(times, np.arange(len(track.samples)), track.samples).astype(np.float32), rate


def data_url(track: Track) -> str:
    """Return a track as a data URL of MP3."""
    return "data:audio/mpeg;base64," + base64.b64encode(mp3(track)).decode()


def pictured(track: Track) -> dict[str, Any]:
    """Draw a track for a page.

    Returns:
        "start" and "step" in s of columns; "peak", base64 of one byte a column, the largest amplitude on a scale of 60
        dB; "spectrogram", a PNG as a data URL with one column of pixels a column and the lowest band below; "low_hz"
        and "high_hz" of its bands, whose scale is logarithmic.
    """
    import cv2

    step = max(_SHORTEST_COLUMN_S, track.duration_s / _MOST_COLUMNS)
    hop = max(1, round(step * track.rate_hz))
    count = -(-len(track.samples) // hop)
    peak, amplitude = _columns(track.samples, hop, count, track.rate_hz)
    own = float(peak.max(initial=0.0))
    full = own if track.loudest is None else track.loudest
    brightest = (
        float(amplitude.max(initial=0.0)) * full / max(own, 1e-12) if track.loudest else amplitude.max(initial=0.0)
    )
    level = np.frombuffer(_scaled(amplitude, float(brightest)), np.uint8).reshape(_BANDS, count)
    picture = cv2.imencode(".png", level[::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return {
        "name": track.name,
        "start": round(track.start_s, 4),
        "step": hop / track.rate_hz,
        "peak": base64.b64encode(_scaled(peak, full)).decode(),
        "spectrogram": "data:image/png;base64," + base64.b64encode(picture).decode(),
        "low_hz": LOW_HZ,
        "high_hz": min(HIGH_HZ, track.rate_hz / 2),
    }


def _window(rate_hz: int) -> int:
    return 1 << (int(_WINDOW_S * rate_hz) - 1).bit_length()


def _columns(samples: np.ndarray, hop: int, count: int, rate_hz: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest amplitude (columns,) of each column, and (bands, columns) that of each band in it."""
    window = _window(rate_hz)
    edges = np.geomspace(LOW_HZ, min(HIGH_HZ, rate_hz / 2), _BANDS + 1) * window / rate_hz
    low = np.minimum(np.floor(edges[:-1]).astype(int), window // 2)
    high = np.minimum(np.maximum(np.ceil(edges[1:]).astype(int), low + 1), window // 2 + 1)
    shape = np.hanning(window).astype(np.float32)
    peak, power = np.empty(count, np.float32), np.empty((_BANDS, count), np.float32)
    for begin in range(0, count, 512):
        end = min(begin + 512, count)
        around = _padded(samples, begin * hop - window, end * hop + window)
        peak[begin:end] = np.abs(around[window:-window].reshape(end - begin, hop)).max(axis=1)
        starts = hop * np.arange(end - begin) + hop // 2 + window - window // 2
        spectrum = np.fft.rfft(around[starts[:, None] + np.arange(window)] * shape, axis=1)
        total = np.cumsum(np.pad(np.abs(spectrum) ** 2, ((0, 0), (1, 0))), axis=1)
        power[:, begin:end] = ((total[:, high] - total[:, low]) / (high - low)).T
    return peak, np.sqrt(power)


def decibels(samples: np.ndarray, rate_hz: int, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Describe sound as it arrives, on a scale that does not depend on what follows.

    Args:
        samples: (n,) full scale at 1.
        rate_hz: sample rate, Hz.
        step_s: length of a column, s; only whole columns are described.

    Returns:
        uint8: the largest amplitude (columns,) of each, and (columns, bands) of each band, 255 at full scale and less
        by one for each half dB.
    """
    hop = round(step_s * rate_hz)
    peak, amplitude = _columns(samples, hop, len(samples) // hop, rate_hz)
    amplitude *= 2 / np.hanning(_window(rate_hz)).sum()  # a tone of full scale is 1
    scaled = (np.clip(255 + 40 * np.log10(np.maximum(part, 1e-7)), 0, 255) for part in (peak, amplitude.T))
    return tuple(part.astype(np.uint8) for part in scaled)


def _padded(samples: np.ndarray, first: int, last: int) -> np.ndarray:
    """The samples from one to before another, zeros where there are none."""
    begin, end = max(first, 0), min(last, len(samples))
    return (
        np.pad(samples[begin:end], (begin - first, last - end)) if begin < end else np.zeros(last - first, np.float32)
    )


def _scaled(amplitude: np.ndarray, largest: float) -> bytes:
    decibels = 20 * np.log10(np.maximum(amplitude, 1e-30) / max(largest, 1e-12))
    return np.clip(255 * (1 + decibels / _RANGE_DB), 0, 255).astype(np.uint8).tobytes()
