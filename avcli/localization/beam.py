"""Listening to one of several people: the array is steered at each track, and what is stronger at another is damped.

A track says where a body is; the mouth is some 15 cm before it and at an unknown height. So the beam is first turned to
where the sound about the track comes from (steered response with phase transform, DiBiase 2000), then the channels are
delayed and summed with weights as the inverse distance, which gives the voice as it is heard 1 m away. Microphones that
are metres apart hear little direct sound and much reverberation, of which a sum alone keeps what other people say.
Therefore each time and frequency is multiplied by the share that the person has in it. It is a post-filter from the
cross-power of the aligned channels (Zelinski 1988) less that of diffuse sound (McCowan & Bourlard 2003), estimated for
every track at once, as Hioka et al. (2013) do in beamspace.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avcli.formats.experiment import Config
from avcli.formats.records import Identified
from avcli.localization.array import Array, put_right
from avcli.localization.correlation import pairs

BLOCK_S = 10.0
"""So much is computed at once."""
_LEAST_RATE_HZ = 16000
"""Voices need no more; sound is reduced to a rate that is no lower."""
_CONTEXT_S = 1.5
"""Of the sound on either side of a block, which the turn of the beam rests on."""
_WINDOW_S = 0.045
_SPAN_S = 0.5
_REACH_M, _STEP_M, _HEIGHTS_M = 0.3, 0.1, (1.1, 1.3, 1.5, 1.7)
"""Where a mouth may be about a track, and its height above the floor."""
_BAND_HZ = (200.0, 4000.0)
_OVERSAMPLING = 4
_DIFFUSE = 0.1
"""Part of the whole power that is nobody's voice."""
_FLOOR_DB = 15.0
"""Others are damped by no more than this; more than that sounds of water."""
_FADE_S = 0.02
_LEAST_M = 0.3

Read = Callable[[int, int], np.ndarray]
"""Returns the samples (last - first, microphones) from the first to before the last one, zeros where there are none."""


@dataclass(frozen=True)
class Path:
    """Where somebody is.

    Attributes:
        times: (n,) s, ascending, from the first sample on.
        places: (n, 2) m on the floor.
    """

    times: np.ndarray
    places: np.ndarray

    def mouths(self, times: np.ndarray) -> np.ndarray:
        """Return where a mouth may be, (t, 3) m at times (t,) s; before the first and after the last it stays."""
        places = _columns(times, self.times, self.places)
        return np.column_stack([places, np.full(len(places), _HEIGHTS_M[2])])

    def present(self, times: np.ndarray) -> np.ndarray:
        """Tell (t,) whether it is known then; a frame that reaches in from outside fades it in."""
        return (times >= self.times[0] - _FADE_S) & (times <= self.times[-1] + _FADE_S)


@dataclass(frozen=True)
class _Aligned:
    """The channels in time and frequency, delayed so that what was said at a path falls together.

    Attributes:
        spectra: (frames, bins, microphones).
        distances: (frames, microphones) m.
    """

    spectra: np.ndarray
    distances: np.ndarray


class Beams:
    """Beams at several people, of a recording of any length.

    Args:
        array: the microphones; its `sample_rate` is that of the samples.
        paths: by the person's name.
        read: returns the recorded samples.

    Raises:
        ValueError: the array has fewer than two microphones.
    """

    def __init__(self, array: Array, paths: Mapping[Any, Path], read: Read):
        if len(array.microphones) < 2:
            raise ValueError("a beam needs two microphones or more")
        self._array, self._paths, self._read = array, paths, read
        half = max(8, 1 << round(np.log2(_WINDOW_S * array.sample_rate / 2)))
        self._window, self._hop = 2 * half, half
        self._shape = np.sqrt(np.hanning(2 * half + 1)[:-1])
        self._pairs = pairs(len(array.microphones))
        self._diffuse = self._coherence().sum(axis=1)

    @classmethod
    def of(cls, config: Config, people: Sequence[Identified], start_s: float, rate_hz: int, read: Read) -> "Beams":
        """Prepare beams at tracks, at a reduced sample rate.

        Args:
            config: of the experiment, with its microphones.
            people: tracks or ground truth in order of time.
            start_s: time of the first sample, s.
            rate_hz: sample rate of the recording, Hz.
            read: returns the recorded samples.

        Raises:
            ValueError: the array has fewer than two microphones, or a key of the config is missing or wrong.
        """
        every = max(n for n in range(1, max(1, rate_hz // _LEAST_RATE_HZ) + 1) if rate_hz % n == 0)
        array = Array.of(config)
        wiring, margin = array.wiring, 0
        if wiring is not None:
            margin = int(np.ceil(np.abs(wiring.delay).max() * rate_hz)) + 16
        array = replace(array.usable, sample_rate=rate_hz // every)

        def reduced(first: int, last: int) -> np.ndarray:
            samples = read(first * every - margin, last * every + margin)
            if wiring is not None:
                samples = put_right(samples, wiring, rate_hz)[margin : len(samples) - margin]
            return samples.reshape(last - first, every, -1).mean(axis=1)

        return cls(array, paths(people, start_s), reduced)

    @property
    def rate_hz(self) -> int:
        """Sample rate of the beams, Hz."""
        return round(self._array.sample_rate)

    @property
    def names(self) -> dict[Any, tuple[float, float]]:
        """Whose beams there are, and from when to when each is there, s from the first sample on."""
        return {name: (float(path.times[0]), float(path.times[-1])) for name, path in self._paths.items()}

    def _coherence(self) -> np.ndarray:
        """(bins, pairs) of sound that comes from everywhere (Cook et al. 1955)."""
        first, second = self._pairs
        apart = np.linalg.norm(self._array.microphones[first] - self._array.microphones[second], axis=1)
        frequency = np.fft.rfftfreq(self._window, 1 / self._array.sample_rate)
        return np.sinc(2 * frequency[:, None] * apart / self._array.speed_of_sound)

    def blocks(self, count: int, only: Sequence[Any] | None = None) -> Iterator[tuple[int, dict[Any, np.ndarray]]]:
        """Listen to a whole recording.

        Args:
            count: its samples.
            only: people whose beams are wanted; all where None.

        Yields:
            The number of the first sample and, by name, the samples (≤ `BLOCK_S`,) float32 of whoever is there.
        """
        length = round(BLOCK_S * self._array.sample_rate)
        for first in range(0, count, length):
            yield first, self.hear(first, min(first + length, count), only)

    def hear(self, first: int, last: int, only: Sequence[Any] | None = None) -> dict[Any, np.ndarray]:
        """Listen from one sample to before another.

        Args:
            first, last: numbers of the samples, in time of emission: 0 is said when the first sample is recorded.
            only: people whose beams are wanted; all where None.

        Returns:
            By name, the samples (last - first,) float32 of whoever is there then: pressure as 1 m from the mouth.
        """
        rate, hop = self._array.sample_rate, self._hop
        frames = np.arange(first // hop - 3, last // hop + 5)
        times = frames * hop / rate
        here = {name: path for name, path in self._paths.items() if path.present(times).any()}
        wanted = [name for name in here if only is None or name in only]
        if not wanted:
            return {}
        margin = round(_CONTEXT_S * rate) + round(np.linalg.norm(self._array.room) / self._array.speed_of_sound * rate)
        begin = first - margin
        sound = self._read(begin, last + margin + 6 * hop)
        aligned = {name: self._pointed(sound, begin, path, times) for name, path in here.items()}
        voices = {name: self._voice(one, here[name].present(times)) for name, one in aligned.items()}
        every = sum(voice for voice, _ in voices.values())
        heard = {}
        for name in wanted:
            one, (voice, whole) = aligned[name], voices[name]
            share = voice / np.maximum(every + _DIFFUSE * whole, 1e-30)
            weight = 1 / one.distances
            weight /= (weight**2).sum(axis=1, keepdims=True)
            spectra = np.einsum("kfm,km->kf", one.spectra, weight) * np.maximum(share, 10 ** (-_FLOOR_DB / 20))
            spectra *= here[name].present(times)[:, None]
            heard[name] = self._joined(spectra, first - int(frames[0]) * hop, last - first)
        return heard

    def _pointed(self, sound: np.ndarray, begin: int, path: Path, times: np.ndarray) -> _Aligned:
        """Align the channels with where the sound about a path comes from."""
        around = np.arange(times[0] - _CONTEXT_S, times[-1] + _CONTEXT_S, _SPAN_S / 2)
        offsets, weights = self._offsets(sound, begin, path, around)
        kernel = np.exp(-0.5 * ((around[:, None] - around) / _SPAN_S) ** 2) * weights
        kernel /= np.maximum(kernel.sum(axis=1, keepdims=True), 1e-12)
        smooth = kernel @ offsets
        return self._align(sound, begin, times, path.mouths(times) + _columns(times, around, smooth))

    def _offsets(self, sound: np.ndarray, begin: int, path: Path, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Search the mouth about a path: offsets (t, 3) m from the path at middle height, and how much each counts."""
        places = path.mouths(around)
        rate, window = self._array.sample_rate, self._window
        frequency = np.fft.rfftfreq(window, 1 / rate)
        band = (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])
        parts = np.arange(-_SPAN_S / 2, _SPAN_S / 2 + 1e-9, self._hop / rate)
        one, other = self._pairs
        offsets = np.zeros((len(around), 3))
        strength = np.zeros(len(around))
        size = _OVERSAMPLING * window
        for k, (time, place) in enumerate(zip(around, places, strict=True)):
            spectra = self._align(sound, begin, time + parts, np.broadcast_to(place, (len(parts), 3))).spectra[:, band]
            spectra = spectra / np.maximum(np.abs(spectra), 1e-12)
            cross = np.zeros((len(one), len(frequency)), complex)
            cross[:, band] = np.einsum("kfp,kfp->pf", spectra[..., one], spectra[..., other].conj())
            lagged = np.fft.irfft(cross, size, axis=1)
            lags = self._lags(place + _AROUND) - self._lags(place[None])
            response = lagged[np.arange(len(one)), np.rint(lags * _OVERSAMPLING).astype(int) % size].sum(axis=1)
            best = int(response.argmax())
            offsets[k] = _AROUND[best]
            scale = len(one) * len(parts) * band.sum() * 2 / size  # 1 where all channels are alike
            strength[k] = response[best] / max(scale, 1e-12)
        return offsets, np.maximum(strength, 0) ** 2 + 1e-9

    def _lags(self, points: np.ndarray) -> np.ndarray:
        """(points, pairs) samples by which sound reaches the first microphone of a pair later than the second."""
        distance = np.linalg.norm(points[:, None] - self._array.microphones, axis=2)
        one, other = self._pairs
        return (distance[:, one] - distance[:, other]) * self._array.sample_rate / self._array.speed_of_sound

    def _align(self, sound: np.ndarray, begin: int, times: np.ndarray, mouths: np.ndarray) -> _Aligned:
        """Take frames about times (k,) s at mouths (k, 3) m, each channel later by its way."""
        rate, window = self._array.sample_rate, self._window
        distances = np.maximum(np.linalg.norm(mouths[:, None] - self._array.microphones, axis=2), _LEAST_M)
        arrival = times[:, None] * rate + distances / self._array.speed_of_sound * rate - begin
        whole = np.rint(arrival).astype(int)
        index = whole[:, None, :] + (np.arange(window) - window // 2)[None, :, None]
        taken = sound[np.clip(index, 0, len(sound) - 1), np.arange(sound.shape[1])]
        taken = np.where((index >= 0) & (index < len(sound)), taken, 0.0)
        spectra = np.fft.rfft(taken * self._shape[:, None], axis=1)
        bins = np.arange(window // 2 + 1)
        spectra *= np.exp(2j * np.pi / window * bins[None, :, None] * (arrival - whole)[:, None, :])
        return _Aligned(spectra, distances)

    def _voice(self, one: _Aligned, present: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Power (frames, bins) of the direct sound of a path, and of all sound, both as 1 m away."""
        count = one.spectra.shape[2]
        near = one.spectra * one.distances[:, None, :]
        whole = _mean_of_three((np.abs(near) ** 2).mean(axis=2))
        together = _mean_of_three(np.abs(near.sum(axis=2)) ** 2)
        number = count * (count - 1) / 2
        voice = (together - count * whole - 2 * self._diffuse * whole) / np.maximum(2 * (number - self._diffuse), 1)
        return np.maximum(voice, 0) * present[:, None], whole

    def _joined(self, spectra: np.ndarray, skip: int, count: int) -> np.ndarray:
        """Overlap and add frames; `skip` samples after the middle of the first one the result begins."""
        window, hop = self._window, self._hop
        pieces = np.fft.irfft(spectra, window, axis=1) * self._shape
        total = np.zeros((len(pieces) + 1) * hop)
        total[: len(pieces) * hop] += pieces[:, :hop].ravel()
        total[hop:] += pieces[:, hop:].ravel()
        return total[skip + hop : skip + hop + count].astype(np.float32)


def paths(people: Sequence[Identified], start_s: float) -> dict[Any, Path]:
    """Gather the path of each person.

    Args:
        people: tracks or ground truth in order of time.
        start_s: time of the first sample, s.

    Returns:
        By name, or by number where people have none.
    """
    found: dict[Any, list[tuple[float, float, float]]] = {}
    for one in people:
        names = one.names or {}
        for number, (x, y) in zip(one.ids.tolist(), one.positions[:, :2].tolist(), strict=True):
            found.setdefault(names.get(number, number), []).append((one.timestamp - start_s, x, y))
    rows = {name: np.array(sorted(set(places))) for name, places in found.items()}
    return {name: Path(row[:, 0], row[:, 1:]) for name, row in rows.items()}


def _around() -> np.ndarray:
    steps = np.arange(-_REACH_M, _REACH_M + 1e-9, _STEP_M)
    x, y, z = (axis.ravel() for axis in np.meshgrid(steps, steps, np.array(_HEIGHTS_M) - _HEIGHTS_M[2], indexing="ij"))
    points = np.stack([x, y, z], axis=1)
    return points[np.hypot(x, y) <= _REACH_M + 1e-9]


_AROUND = _around()


def _columns(times: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)


def _mean_of_three(rows: np.ndarray) -> np.ndarray:
    """The mean of each row with its neighbours, of which the first and the last have one."""
    total = rows.copy()
    total[1:] += rows[:-1]
    total[:-1] += rows[1:]
    number = np.full((len(rows), 1), 3.0)
    number[[0, -1]] = 2 if len(rows) > 1 else 1
    return total / number
