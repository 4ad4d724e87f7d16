"""Listening to one of several people: the array is steered at each track, and what is stronger at another is damped.

A track says where a body is; the mouth is some 15 cm before it and at an unknown height. So the beam is first turned to
where the sound about the track comes from (steered response with phase transform, DiBiase 2000), and the channels are
delayed so that the voice falls together. The share that the person has in each time and frequency follows from the
cross-power of the aligned channels (Zelinski 1988) less that of diffuse sound (McCowan & Bourlard 2003), estimated for
every track at once, as Hioka et al. (2013) do in beamspace. It tells how each microphone hears the voice and how it
hears all else, from which the weights of the sum follow: in an array of metres a far microphone holds reverberation and
other people, and a sum by distance alone is worse than the nearest one. What is left of others is damped a little more.
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
_LASTS_S = 1.0
"""Standard deviation of the window in which a mouth's place beside the track, and sound and noise, are the same."""
_REACH_M, _STEP_M, _HEIGHTS_M = 0.3, 0.05, (1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7)
"""Where a mouth may be about a track, and its height above the floor."""
_MIDDLE_M = 1.5
_BAND_HZ = (200.0, 4000.0)
_OVERSAMPLING = 4
_DIFFUSE = 0.1
"""Part of the whole power that is nobody's voice."""
_FLOOR_DB = 6.0
"""Others are damped by no more than this after the beam; more than that sounds of water."""
_LOADING, _TRUST = 0.1, 0.01
"""Parts of the noise's power: what is added to each microphone's, and what the stated place counts as voice."""
_CHOOSY = 4.0
"""Power of the ratio of voice to noise by which the microphones count that the voice shall sound as in."""
_AT_ONCE = 1 << 22
"""So many complex numbers of a covariance are held at once."""
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
        return np.column_stack([places, np.full(len(places), _MIDDLE_M)])

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
        self._segment = max(1, round(_SPAN_S / 2 * array.sample_rate / half))
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
        margin, step = round(_CONTEXT_S * rate), self._segment
        frames = np.arange((first - margin) // hop // step * step, -(-(last + margin) // hop // step) * step)
        times = frames * hop / rate
        here = {name: path for name, path in self._paths.items() if path.present(times).any()}
        asked = times[(times >= (first - 3 * hop) / rate) & (times <= (last + 3 * hop) / rate)]
        wanted = [name for name in here if (only is None or name in only) and here[name].present(asked).any()]
        if not wanted:
            return {}
        far = margin + round(np.linalg.norm(self._array.room) / self._array.speed_of_sound * rate) + 3 * hop
        begin = int(frames[0]) * hop - far
        sound = self._read(begin, int(frames[-1]) * hop + far)
        aligned = {name: self._pointed(sound, begin, path, times) for name, path in here.items()}
        voices = {name: self._voice(one, here[name].present(times)) for name, one in aligned.items()}
        every = sum(voice for voice, _ in voices.values())
        heard = {}
        for name in wanted:
            voice, whole = voices[name]
            share = self._share(voice, every + _DIFFUSE * whole)
            spectra = np.einsum("kfm,kfm->kf", self._weights(aligned[name], share), aligned[name].spectra)
            spectra *= np.maximum(np.sqrt(share), 10 ** (-_FLOOR_DB / 20)) * here[name].present(times)[:, None]
            heard[name] = self._joined(spectra, first - int(frames[0]) * hop, last - first)
        return heard

    def _share(self, voice: np.ndarray, every: np.ndarray) -> np.ndarray:
        """Part (frames, bins) of all power that is a voice; of the whole frame where the array is too small to tell."""
        told = 1 - self._diffuse / len(self._pairs[0])
        loud = (voice * told).sum(axis=1) / np.maximum((every * told).sum(axis=1), 1e-30)
        share = told * voice / np.maximum(every, 1e-30) + (1 - told) * loud[:, None]
        return np.clip(share, 0, 1)

    def _weights(self, one: _Aligned, share: np.ndarray) -> np.ndarray:
        """Weights (frames, bins, microphones) of least noise that leave the voice as the near microphones have it.

        The filter of Souden et al. (2010) from the voice's share of each time and frequency (Higuchi et al. 2016). So a
        microphone counts by what it hears of the voice over all else, and not by its distance alone.
        """
        count, step = one.spectra.shape[2], self._segment
        parts, bins = len(one.spectra) // step, one.spectra.shape[1]
        apart = (np.arange(parts)[:, None] - np.arange(parts)) * step * self._hop / self._array.sample_rate
        kernel = np.exp(-0.5 * (apart / _LASTS_S) ** 2)
        spectra = one.spectra.reshape(parts, step, bins, count).transpose(0, 2, 3, 1)
        shares = share.reshape(parts, step, bins, 1).transpose(0, 2, 3, 1)
        gain = 1 / one.distances.reshape(parts, step, count).mean(axis=1)
        stated = gain[:, :, None] * gain[:, None, :] / (gain**2).sum(axis=1)[:, None, None]
        near = self._near(spectra, shares, kernel, gain)
        weights = np.empty((parts, bins, count), complex)
        for k in range(0, bins, at_once := max(1, _AT_ONCE // (parts * count**2))):
            some, part = spectra[:, k : k + at_once], shares[:, k : k + at_once]
            noise, voice = (
                np.tensordot(kernel, (some * weight) @ some.conj().swapaxes(2, 3), axes=1)
                for weight in (1 - part, part)
            )
            level = np.einsum("sfmm->sf", noise + _LOADING * voice).real[..., None, None] / count + 1e-12
            ratio = np.linalg.solve(noise + _LOADING * level * np.eye(count), voice + _TRUST * level * stated[:, None])
            weights[:, k : k + at_once] = np.einsum("sfmn,sn->sfm", ratio, near)
            weights[:, k : k + at_once] /= np.einsum("sfmm->sf", ratio).real[..., None]
        return np.repeat(weights.conj(), step, axis=0)

    def _near(self, spectra: np.ndarray, shares: np.ndarray, kernel: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """How much (parts, microphones) each counts for what the voice sounds like; (near * gain).sum(axis=1) is 1."""
        frequency = np.fft.rfftfreq(self._window, 1 / self._array.sample_rate)
        power = np.abs(spectra[:, (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])]) ** 2
        part = shares[:, (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])]
        voice, noise = (
            np.log(np.tensordot(kernel, (power * weight).sum(axis=3), axes=1) + 1e-12).mean(axis=1)
            for weight in (part, 1 - part)
        )
        clear = np.exp(_CHOOSY * (voice - noise - (voice - noise).max(axis=1, keepdims=True)))
        near = clear * gain**2
        return near / (near * gain).sum(axis=1, keepdims=True)

    def _pointed(self, sound: np.ndarray, begin: int, path: Path, times: np.ndarray) -> _Aligned:
        """Align the channels with where the sound about a path comes from.

        A place that is searched anew would move along the line of sight, where a small array cannot tell, and with it
        the pitch. So the time at which sound arrives on the mean stays that of the path, and the place changes slowly.
        """
        step = _SPAN_S / 2
        around = step * np.arange(np.floor(times[0] / step), np.ceil(times[-1] / step) + 1)
        maps = self._maps(sound, begin, path, around)
        apart = around[:, None] - around
        maps = np.exp(-0.5 * (apart / _LASTS_S) ** 2) * np.maximum(maps.max(axis=1), 0) ** 2 @ maps
        kernel = np.exp(-0.5 * (apart / _SPAN_S) ** 2)
        offsets = kernel @ _AROUND[maps.argmax(axis=1)] / kernel.sum(axis=1, keepdims=True)
        stated = path.mouths(times)
        mouths = stated + _columns(times, around, offsets)
        later = (self._distances(mouths) - self._distances(stated)).mean(axis=1) / self._array.speed_of_sound
        return self._align(sound, begin, times - later, mouths)

    def _maps(self, sound: np.ndarray, begin: int, path: Path, around: np.ndarray) -> np.ndarray:
        """Steered response (t, points) about a path at times (t,) s; 1 where all channels are alike."""
        places = path.mouths(around)
        rate, window = self._array.sample_rate, self._window
        frequency = np.fft.rfftfreq(window, 1 / rate)
        band = (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])
        parts = np.arange(-_SPAN_S / 2, _SPAN_S / 2 + 1e-9, self._hop / rate)
        one, other = self._pairs
        size = _OVERSAMPLING * window
        scale = len(one) * len(parts) * band.sum() * 2 / size
        maps = np.empty((len(around), len(_AROUND)))
        for k, (time, place) in enumerate(zip(around, places, strict=True)):
            spectra = self._align(sound, begin, time + parts, np.broadcast_to(place, (len(parts), 3))).spectra[:, band]
            spectra = spectra / np.maximum(np.abs(spectra), 1e-12)
            cross = np.zeros((len(one), len(frequency)), complex)
            cross[:, band] = np.einsum("kfp,kfp->pf", spectra[..., one], spectra[..., other].conj())
            lagged = np.fft.irfft(cross, size, axis=1)
            lags = self._lags(place + _AROUND) - self._lags(place[None])
            maps[k] = lagged[np.arange(len(one)), np.rint(lags * _OVERSAMPLING).astype(int) % size].sum(axis=1) / scale
        return maps

    def _distances(self, points: np.ndarray) -> np.ndarray:
        """(points, microphones) m."""
        return np.maximum(np.linalg.norm(points[:, None] - self._array.microphones, axis=2), _LEAST_M)

    def _lags(self, points: np.ndarray) -> np.ndarray:
        """(points, pairs) samples by which sound reaches the first microphone of a pair later than the second."""
        distance = np.linalg.norm(points[:, None] - self._array.microphones, axis=2)
        one, other = self._pairs
        return (distance[:, one] - distance[:, other]) * self._array.sample_rate / self._array.speed_of_sound

    def _align(self, sound: np.ndarray, begin: int, times: np.ndarray, mouths: np.ndarray) -> _Aligned:
        """Take frames about times (k,) s at mouths (k, 3) m, each channel later by its way."""
        rate, window = self._array.sample_rate, self._window
        distances = self._distances(mouths)
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
    x, y, z = (axis.ravel() for axis in np.meshgrid(steps, steps, np.array(_HEIGHTS_M) - _MIDDLE_M, indexing="ij"))
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
