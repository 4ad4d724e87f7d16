"""Room impulse responses from a source at positions along its path to the microphones, as spectra."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli.acoustics.bands import spectra_of_bands
from avcli.acoustics.images import NEAREST_M, SINGLE_DB, DelaySpectrum, Images, at_once, audible, image_microphones
from avcli.acoustics.noise import diffuse_noise
from avcli.acoustics.surroundings import MOTION_STEP_S, STRIDE_M, Surroundings
from avcli.materials.decay import energy_decay, scattered_energy
from avcli.numeric import fft_length

TAIL_REFERENCE_S = 0.01
"""s; the level of the noise that continues the images is that of their last part of this length (as in gpuRIR)."""

TAPS, LONGEST_TAPS = 48, 400
"""samples before and after an impulse that a low pass spreads it to, and the most of them."""


@dataclass(frozen=True)
class Lowpass:
    """A low pass that is short in time, a Kaiser-windowed sinc (J. F. Kaiser, 1974): blocks join without a trace.

    Attributes:
        every: of so many samples of the signal one is needed: the low pass fills in the others.
        taps: samples before and after an impulse that it spreads it to, and no further.
        edge: frequency above which nothing is left, cycles a sample.
        transition: width in which it falls to that, cycles a sample.
        attenuation: dB.
    """

    every: int
    taps: int
    edge: float
    transition: float
    attenuation: float

    def spectrum(self, length: int) -> np.ndarray:
        """Return its spectrum for a transform of a length, (length // 2 + 1,)."""
        taps = np.arange(-self.taps, self.taps + 1)
        cutoff, above = self.edge - self.transition / 2, self.attenuation
        beta = 0.1102 * (above - 8.7) if above > 50 else 0.5842 * (above - 21) ** 0.4
        response = np.zeros(length)
        response[taps] = 2 * cutoff * np.sinc(2 * cutoff * taps) * np.kaiser(len(taps), beta)
        return np.fft.rfft(response).real


def lowpass(band: float, error_db: float, most: int = 4) -> Lowpass:
    """Return the low pass for a signal of a band, cycles a sample, at an error, dB.

    A signal that is bounded to a quarter of the sample rate is told by every other sample; between its band and the
    image of it that this leaves, the low pass must fall. It is as long as that takes.

    Args:
        band: the highest frequency that the signal holds, cycles a sample.
        error_db: dB.
        most: every so many samples at most one is needed.
    """
    attenuation = 10 - error_db
    steepness = (attenuation - 7.95) / (14.36 * 2)  # transition and taps have a product
    for every in range(most, 1, -1):
        room = 1 / every - 2 * band
        if room * LONGEST_TAPS >= steepness:
            taps = max(TAPS, int(np.ceil(steepness / room)))
            return Lowpass(every, taps, band + steepness / taps, steepness / taps, attenuation)
    return Lowpass(1, TAPS, min(0.5, band + steepness / TAPS), steepness / TAPS, attenuation)


class Responses:
    """The responses of the microphones to a source at positions along its path, as spectra.

    Args:
        surroundings: the room and the microphones.
        length: samples of the transform, at least surroundings.longest_delay and the margin twice.
        lowpass: what the responses are filtered with; None: nothing.
        error_db: numerical error, dB.
        rng: draws the noise that continues the images; None: without.
        fresh: draw it anew for each position and microphone, as gpuRIR does; otherwise it stays the same, as in a
            room, and is diffuse: near microphones hear similar noise.

    Attributes:
        bins: number of bins that a spectrum has.
        margin: samples before and after an impulse that its band-limited form may spread to.
        dtype: of a spectrum; it is in single precision where the error allows it.
        bounded: whether the source has been nearer than NEAREST_M to a microphone, which hears it as at that distance.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        length: int,
        lowpass: Lowpass | None,
        error_db: float,
        rng: np.random.Generator | None = None,
        fresh: bool = False,
    ):
        self._surroundings, self._length, self._rng, self._fresh = surroundings, length, rng, fresh
        self._error_db = error_db
        self._spectrum = DelaySpectrum(length, lowpass.edge if lowpass else 0.5, error_db)
        self.bins = self._spectrum.bins
        self.margin = surroundings.spread + (lowpass.taps if lowpass else 0)
        self.dtype = np.dtype(np.complex64 if error_db > SINGLE_DB else np.complex128)
        self._lowpass = lowpass.spectrum(length)[: self.bins] if lowpass else 1.0
        self._chosen_at: tuple[np.ndarray, np.ndarray] | None = None  # source, microphones
        self._images: list[Images] = []
        self._exact: list[int] = []  # how many of each microphone's images come first that need be exact
        self._tail_begin = int(np.ceil(surroundings.reach_m * surroundings.samples_per_m))
        self._tail_end = int(surroundings.end_s * surroundings.sample_rate_hz) if rng is not None else 0
        self._continued = self._tail_end > self._tail_begin  # by noise
        bands = 1 if surroundings.bands is None else len(surroundings.bands.rt60_s)
        self._levels = np.zeros((bands, len(surroundings.microphones_m)))
        self._last = TAIL_REFERENCE_S * surroundings.sample_rate_hz  # samples of the images that give its level
        self._at_level_1 = np.array([self._last])  # energy that they have where it is 1
        if surroundings.bands is not None and self._continued:  # a way to and fro: between echoes it is quiet
            to_and_fro = 2 * surroundings.room_dimensions_m.max() * surroundings.samples_per_m
            self._last = min(to_and_fro, self._tail_begin / 2)
            before = np.arange(-self._last, 0) / surroundings.sample_rate_hz
            self._at_level_1 = np.array([self._decay(band, before).sum() for band in range(bands)])
        self.bounded = False
        self._noise: np.ndarray | None = None
        self._tail: np.ndarray | None = None
        of_bands = surroundings.bands
        self._scatters = rng is not None and of_bands is not None and of_bands.scattering is not None
        self._scattered: tuple[np.ndarray, np.ndarray] | None = None  # noise, and its envelopes by band
        self._walls: list[np.ndarray] = []  # of each microphone: (n, bands) gains of its images by walls and air
        self._used = np.zeros(1, int)  # the bands that the signal reaches
        if surroundings.bands is not None:
            self._of_bands = spectra_of_bands(length, self.bins, surroundings.sample_rate_hz)
            self._used = np.flatnonzero(np.abs(self._of_bands).max(axis=1) > 1e-3)

    @property
    def at_once(self) -> int:
        """For how many places it is best to ask at once."""
        return max(1, at_once(self._length) // (len(self._surroundings.microphones_m) * len(self._used)))

    def at(self, places: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
        """Return the spectra of the responses at n places of the source, delayed by the margin: (n, m, bins).

        Args:
            places: position, (3,) m, heading, a unit vector in which the source looks, and where the microphones are
                from then on, (k, m, 3) m; see `Surroundings.microphones_from`. Each is not far from the one before.
        """
        impulses, exact, tails = [], [], []
        for position, heading, microphones in places:
            of_place = self.impulses(position, heading, microphones)
            for delays, _ in of_place:
                delays += self.margin
            impulses += of_place
            bands = len(of_place) // len(self._exact)
            exact += [count for count in self._exact for _ in range(bands)]
            if self._rng is not None and (self._continued or self._scatters):
                if self._tail is None or self._fresh:
                    self._tail = self.noise(position, microphones[0], self._rng)
                tails.append(self._tail)
        spectra = self.joined(self._spectrum(impulses, exact)).reshape(len(places), -1, self.bins)
        if tails:
            spectra += tails
        return np.multiply(spectra, self._lowpass, dtype=self.dtype, casting="same_kind")

    def impulses(
        self, position: np.ndarray, heading: np.ndarray, microphones: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return for each microphone the delays, (n,) samples, and amplitudes, (n,), of the images it hears.

        In octave bands there are as many of these as the signal reaches bands, one after another.

        Args:
            position: (3,) m.
            heading: (3,) unit vector in which the source looks.
            microphones: (k, m, 3) m, where they are from now on.
        """
        now = microphones[0]
        if self._chosen_at is None or self._gone(position, now) > STRIDE_M:
            self._chosen_at = position, now
            self._walls, self._exact, self._tail = [], [], None
            self._images = [self._choose(microphone, position, heading, now) for microphone in range(len(now))]
        moved = microphones - self._chosen_at[1] if any(self._surroundings.trajectories) else None
        impulses = []
        for microphone, images in enumerate(self._images):
            by = None if moved is None else moved[:, microphone]
            delays, amplitudes, towards = self._arrivals(microphone, images, position, heading, by)
            if self._surroundings.bands is None:
                impulses.append((delays, amplitudes))
                continue
            gains = self._walls[microphone] if towards is None else self._walls[microphone] * towards[:, self._used]
            impulses += [(delays.copy(), of_band) for of_band in gains.T * amplitudes]
        return impulses

    def _gone(self, position: np.ndarray, microphones: np.ndarray) -> float:
        """Return how far source and microphones are from where the images were chosen, m."""
        assert self._chosen_at is not None
        source, before = self._chosen_at
        gone = math.dist(position, source)
        if any(self._surroundings.trajectories):
            gone += float(np.linalg.norm(microphones - before, axis=-1).max())
        return gone

    def joined(self, spectra: np.ndarray) -> np.ndarray:
        """Return the spectra of the microphones, (m, bins), from those of `impulses`."""
        if self._surroundings.bands is None:
            return spectra
        by_band = spectra.reshape(-1, len(self._used), spectra.shape[1])
        return np.einsum("mkb,kb->mb", by_band, self._of_bands[self._used, : spectra.shape[1]])

    def noise(self, position: np.ndarray, microphones: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the spectra of what is heard beside the images, delayed by the margin, (m, bins), after `impulses`.

        It is the sound that walls have scattered, and what continues the images.

        Args:
            position: (3,) m.
            microphones: (m, 3) m.
            rng: draws it.
        """
        late = np.zeros((len(microphones), self.bins), complex)
        if self._continued:
            late = (self._drawn(rng) * self._levels[:, :, None]).sum(axis=0)
        if not self._scatters:
            return late
        s = self._surroundings
        noise, envelopes = self._diffuse(rng)
        # It comes later than the sound itself: from anywhere that the source may move to before this is done anew.
        begins = (np.linalg.norm(microphones - position, axis=1) + STRIDE_M) * s.samples_per_m
        noise = noise * (np.arange(noise.shape[1]) > begins[:, None])
        tail = np.zeros((len(microphones), self._length))
        for band, envelope in zip(self._used, envelopes, strict=True):
            tail[:, self.margin :][:, : noise.shape[1]] = noise * envelope
            late += np.fft.rfft(tail)[:, : self.bins] * self._of_bands[band]
        return late

    def _diffuse(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return noise of variance 1, (m, n), and the envelopes of what is scattered in the bands used, (bands, n).

        Of a sound of energy 1, images of energy c / (4 π V) arrive a second where nothing is absorbed.
        """
        if self._scattered is None or self._fresh:
            s = self._surroundings
            assert s.bands is not None
            assert s.bands.scattering is not None
            count = int(s.end_s * s.sample_rate_hz)
            times, speed = np.arange(count) / s.sample_rate_hz, s.speed_of_sound_m_s
            density = speed / (4 * np.pi * np.prod(s.room_dimensions_m) * s.sample_rate_hz)
            sent = _of_all_directions(s.source_directivity) * s.bands.of_all_directions
            energies = [
                density * sent[band] * scattered_energy(
                    s.room_dimensions_m, s.bands.absorption[:, band], s.bands.scattering[:, band], s.bands.air[band],
                    speed, times,
                )
                for band in self._used
            ]  # fmt: skip
            noise = diffuse_noise(count, s.microphones_m, s.sample_rate_hz, speed, rng)
            if s.directivities is not None:
                noise *= np.sqrt(_of_all_directions(s.directivities))[:, None]
            self._scattered = noise, np.sqrt(energies)
        return self._scattered

    def _drawn(self, rng: np.random.Generator) -> np.ndarray:
        """Return the spectra of the noise that continues the images, at the level 1, (bands, m, bins)."""
        if self._noise is None or self._fresh:
            s, count = self._surroundings, self._tail_end - self._tail_begin
            times = np.arange(count) / s.sample_rate_hz + TAIL_REFERENCE_S / 2
            if self._fresh:  # as gpuRIR: logistic, and independent at each microphone
                noise = rng.logistic(scale=np.sqrt(3) / np.pi, size=(len(s.microphones_m), count))
            else:
                noise = diffuse_noise(count, s.microphones_m, s.sample_rate_hz, s.speed_of_sound_m_s, rng)
            self._noise = np.empty((len(self._levels), len(s.microphones_m), self.bins), complex)
            tail = np.zeros((len(s.microphones_m), self._length))
            for band in range(len(self._levels)):
                if s.bands is None:
                    envelope = np.exp(-3 * np.log(10) / s.rt60_s * times)
                else:
                    envelope = np.sqrt(self._decay(band, np.arange(count) / s.sample_rate_hz))
                tail[:, self._tail_begin + self.margin :][:, :count] = envelope * noise
                self._noise[band] = np.fft.rfft(tail)[:, : self.bins]
                if s.bands is not None:
                    self._noise[band] *= self._of_bands[band]
        return self._noise

    def _decay(self, band: int, times: np.ndarray) -> np.ndarray:
        """Return the energy of the mean decay of a band at times since the noise begins, (n,) s, relative to then."""
        s = self._surroundings
        assert s.bands is not None
        begin = self._tail_begin / s.sample_rate_hz
        some = np.linspace(min(times[0], 0.0), max(times[-1], 0.0), 100)
        walls, loss = s.bands.lost[:, band], s.bands.air[band]
        energy = np.log(energy_decay(s.room_dimensions_m, walls, loss, s.speed_of_sound_m_s, begin + some))
        return np.exp(np.interp(times, some, energy) - np.interp(0.0, some, energy))

    def _choose(self, microphone: int, position: np.ndarray, heading: np.ndarray, microphones: np.ndarray) -> Images:
        """Choose the images that a microphone hears, and note how loud the last of all images are."""
        s, exact = self._surroundings, None
        images = image_microphones(s.room_dimensions_m, microphones[microphone], s.reflection, position, s.reach_m)
        gains = np.ones((len(images), 1))
        if s.bands is not None:
            gains = s.bands.gains(
                images.orders(s.room_dimensions_m, microphones[microphone]), images.distances(position)
            )
            images = Images(images.positions, np.sign(images.gains), images.mirrored)
        delays, amplitudes, towards = self._arrivals(microphone, images, position, heading, None)
        heard = gains if towards is None else gains * towards
        if self._continued:
            last = delays > self._tail_begin - self._last
            energies = np.sum((amplitudes[last, None] * heard[last]) ** 2, axis=0)
            self._levels[:, microphone] = np.sqrt(energies / self._at_level_1)
        if s.error_db is not None:
            far = np.clip(delays / (STRIDE_M * s.samples_per_m), NEAREST_M / STRIDE_M, 1.0)  # the source may move away
            loudness = amplitudes if s.bands is None else amplitudes * np.sqrt(np.mean(heard**2, axis=1))
            # The coarse images may have so much energy that their error is as large as the spectrum's own.
            coarse_db = self._error_db - self._spectrum.coarse_db
            first, others = audible(delays, loudness * far, s.error_db, coarse_db)
            kept, exact = np.concatenate([first, others]), len(first)
            images, gains = images[kept], gains[kept]
        self._walls.append(gains[:, self._used])
        self._exact.append(len(images) if exact is None else exact)
        return images.in_precision_for(self._error_db)

    def _arrivals(
        self, microphone: int, images: Images, position: np.ndarray, heading: np.ndarray, moved: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return delays and amplitudes of images whose microphone has moved, (k, 3) m, since they were chosen, or not.

        The third is the source's gain towards them in bands, (n, 8); None where it is the same all around.
        """
        s = self._surroundings
        receding: np.ndarray | float = 0.0
        if moved is not None and (moved != moved[0]).any():
            images, distances, receding = images.at_arrival(position, moved, MOTION_STEP_S * s.speed_of_sound_m_s)
        else:
            images = images if moved is None else images.moved(moved[0])
            distances = images.distances(position)
        self.bounded |= bool((distances < NEAREST_M).any())
        amplitudes = images.amplitudes(distances)
        a = 1.0 if s.directivities is None else s.directivities[microphone]
        turned = s.bands is not None and s.bands.behind_db.any()
        towards = None
        if a != 1 or s.source_directivity != 1 or turned:
            away = (position[:, None] - images.positions) / np.maximum(distances, NEAREST_M)
            if a != 1 and s.orientations is not None:  # an image looks where the microphone looks, mirrored
                amplitudes *= a + (1 - a) * (s.orientations[microphone][:, None] * images.mirrored * away).sum(axis=0)
            if s.source_directivity != 1:
                amplitudes *= s.source_directivity - (1 - s.source_directivity) * (heading[:, None] * away).sum(axis=0)
            if turned and s.bands is not None:
                towards = s.bands.towards(-(heading[:, None] * away).sum(axis=0))
        # Sound that is emitted in ds is heard in (1 − n·v_source/c) / (1 − n·v_microphone/c) ds, and is louder the
        # shorter that is; the motion of a microphone does not change the pressure at its position.
        if not np.isscalar(receding):
            amplitudes /= 1 - receding
        distances *= s.samples_per_m
        return distances, amplitudes, towards


def _of_all_directions(a: ArrayLike) -> np.ndarray:
    """Return the mean over all directions of the energy that patterns a + (1 − a) cos θ let through."""
    pattern = np.asarray(a, dtype=float)
    return pattern**2 + (1 - pattern) ** 2 / 3


def impulse_responses(surroundings: Surroundings, positions_m: np.ndarray) -> np.ndarray:
    """Return the impulse responses of the microphones to a source at each of k positions, (k, m, n) float64.

    They are band-limited at half the sample rate and as long as the surroundings follow the sound.

    Args:
        surroundings: the room and the microphones.
        positions_m: (k, 3) m.
    """
    samples = surroundings.longest_delay
    spectrum = DelaySpectrum(fft_length(4 * samples))
    distinct, copies = np.unique(positions_m, axis=0, return_inverse=True)
    responses = np.empty((len(distinct), len(surroundings.microphones_m), samples))
    scatters = surroundings.bands is not None and surroundings.bands.scattering is not None
    images = Responses(surroundings, spectrum.length, None, -60.0, np.random.default_rng(0) if scatters else None)
    for response, position in zip(responses, distinct, strict=True):
        impulses = images.impulses(position, np.array([1.0, 0.0, 0.0]), surroundings.microphones_m[None])
        spectra = images.joined(spectrum(impulses))
        response[:] = np.fft.irfft(spectra, spectrum.length)[:, :samples]
        if scatters:
            late = images.noise(position, surroundings.microphones_m, np.random.default_rng(0))
            response += np.fft.irfft(late, spectrum.length)[:, images.margin :][:, :samples]
    return responses[copies.ravel()]
