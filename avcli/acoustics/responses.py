"""What a room does to a sound: the responses of its microphones to a source at places along its way."""

from dataclasses import dataclass

import numpy as np

from avcli.acoustics.images import NEAREST_M, DelaySpectrum, Images, audible, fast_length, image_microphones

STRIDE_M = 0.5
"""m; the images that are audible are chosen anew when the source has gone so far."""
MARGIN = 48
"""samples before and after an impulse that its band-limited form may spread to."""
TAIL_REFERENCE_S = 0.01
"""s, the end of the images from which the noise after them takes its level (as in gpuRIR)."""


@dataclass(frozen=True)
class Surroundings:
    """A room and the microphones in it.

    Attributes:
        room_dimensions_m: (3,) m.
        reflection: (6,) signed pressure coefficients of the walls x0 x1 y0 y1 z0 z1.
        microphones_m: (m, 3) m.
        sample_rate_hz: Hz.
        reach_m: length of the longest way that is followed, m.
        error_db: images that can be left out for this relative error (dB) are left out; None: none are.
        speed_of_sound_m_s: m/s.
        directivities: (m,) a of the microphones' pattern a + (1 − a) cos θ.
        orientations: (m, 3) unit vectors in which they look.
        source_directivity: a of the source's pattern, 1 for all round.
        rt60_s: reverberation time of the noise that goes on after reach_m, s.
        end_s: when that noise ends, s; without it, before.
    """

    room_dimensions_m: np.ndarray
    reflection: np.ndarray
    microphones_m: np.ndarray
    sample_rate_hz: float
    reach_m: float
    error_db: float | None = None
    speed_of_sound_m_s: float = 343.0
    directivities: np.ndarray | None = None
    orientations: np.ndarray | None = None
    source_directivity: float = 1.0
    rt60_s: float = 0.0
    end_s: float = 0.0

    @property
    def samples_per_m(self) -> float:
        return self.sample_rate_hz / self.speed_of_sound_m_s

    @property
    def longest_delay(self) -> int:
        """Samples that a response lasts, with the source up to STRIDE_M away from where its images were chosen."""
        longest_way = int(np.ceil((self.reach_m + STRIDE_M) * self.samples_per_m)) + 1
        return max(longest_way, int(np.ceil(self.end_s * self.sample_rate_hz)) + 1)


class Responses:
    """The responses of a room to a source at places along its way, as spectra.

    Args:
        surroundings: the room and the microphones.
        length: samples of the transform, at least surroundings.longest_delay + 2 MARGIN.
        band: highest frequency that the signal holds, cycles a sample.
        error_db: numerical error, dB.
        rng: draws the noise after the images.
        fresh: draw it anew for each place, as gpuRIR does; otherwise it stays, and sounds like one room.

    Attributes:
        bins: number of bins that a spectrum has.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        length: int,
        band: float,
        error_db: float,
        rng: np.random.Generator | None = None,
        fresh: bool = False,
    ):
        self._surroundings, self._length, self._rng, self._fresh = surroundings, length, rng, fresh
        lowpass, edge = _lowpass(length, band, error_db)
        self._spectrum = DelaySpectrum(length, edge, error_db)
        self.bins = self._spectrum.bins
        self._lowpass = lowpass[: self.bins]
        self._chosen_at: np.ndarray | None = None
        self._images: list[Images] = []
        self._tail_begin = int(np.ceil(surroundings.reach_m * surroundings.samples_per_m))
        self._tail_end = int(surroundings.end_s * surroundings.sample_rate_hz) if rng is not None else 0
        self._levels = np.zeros(len(surroundings.microphones_m))
        self._noise: np.ndarray | None = None

    def at(self, position: np.ndarray, heading: np.ndarray) -> np.ndarray:
        """Return the spectra of the responses, delayed by MARGIN, (m, bins) complex128.

        Args:
            position: (3,) m.
            heading: (3,) unit vector in which the source looks.
        """
        impulses = self.impulses(position, heading)
        for delays, _ in impulses:
            delays += MARGIN
        spectra = self._spectrum(impulses)
        if self._tail_end > self._tail_begin:
            spectra += self._tail()
        spectra *= self._lowpass
        return spectra

    def impulses(self, position: np.ndarray, heading: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return for each microphone the delays, (n,) samples, and amplitudes, (n,), of the images it hears.

        Args:
            position: (3,) m.
            heading: (3,) unit vector in which the source looks.
        """
        if self._chosen_at is None or np.linalg.norm(position - self._chosen_at) > STRIDE_M:
            self._chosen_at = position
            microphones = range(len(self._surroundings.microphones_m))
            self._images = [self._choose(microphone, position, heading) for microphone in microphones]
        return [self._reckon(microphone, images, position, heading) for microphone, images in enumerate(self._images)]

    def _tail(self) -> np.ndarray:
        """Return the spectra of noise that goes on where the images end, at their level, (m, bins)."""
        if self._noise is None or self._fresh:
            rate, decay = self._surroundings.sample_rate_hz, 3 * np.log(10) / self._surroundings.rt60_s
            count = self._tail_end - self._tail_begin
            envelope = np.exp(-decay * (np.arange(count) / rate + TAIL_REFERENCE_S / 2))
            tail = np.zeros((len(self._levels), self._length))
            tail[:, self._tail_begin + MARGIN :][:, :count] = envelope * self._rng.logistic(
                scale=np.sqrt(3) / np.pi, size=(len(self._levels), count)
            )
            self._noise = np.fft.rfft(tail)[:, : self.bins]
        return self._noise * self._levels[:, None]

    def _choose(self, microphone: int, position: np.ndarray, heading: np.ndarray) -> Images:
        """Choose the images that a microphone hears, and note how loud the last of all images are."""
        s = self._surroundings
        images = image_microphones(s.room_dimensions_m, s.microphones_m[microphone], s.reflection, position, s.reach_m)
        delays, amplitudes = self._reckon(microphone, images, position, heading)
        reference = TAIL_REFERENCE_S * s.sample_rate_hz
        last = amplitudes[delays > self._tail_begin - reference]
        self._levels[microphone] = np.sqrt(np.sum(last**2) / reference)
        return images if s.error_db is None else images[audible(delays, amplitudes, s.error_db)]

    def _reckon(self, microphone: int, images, position: np.ndarray, heading: np.ndarray):
        s = self._surroundings
        distances = images.distances(position)
        amplitudes = images.amplitudes(distances)
        a = 1.0 if s.directivities is None else s.directivities[microphone]
        if a != 1 or s.source_directivity != 1:
            away = (position[:, None] - images.positions) / np.maximum(distances, NEAREST_M)
            if a != 1:  # an image looks where the microphone looks, mirrored
                amplitudes *= a + (1 - a) * (s.orientations[microphone][:, None] * images.mirrored * away).sum(axis=0)
            if s.source_directivity != 1:
                amplitudes *= s.source_directivity - (1 - s.source_directivity) * (heading[:, None] * away).sum(axis=0)
        distances *= s.samples_per_m
        return distances, amplitudes


def impulse_responses(surroundings: Surroundings, positions_m: np.ndarray) -> np.ndarray:
    """Return the impulse responses to a source at each of some places, (k, m, n) float64.

    They are band-limited at half the sample rate and last as long as the surroundings follow the sound.

    Args:
        surroundings: the room and the microphones.
        positions_m: (k, 3) m.
    """
    samples = surroundings.longest_delay
    spectrum = DelaySpectrum(fast_length(4 * samples))
    places, copies = np.unique(positions_m, axis=0, return_inverse=True)
    responses = np.empty((len(places), len(surroundings.microphones_m), samples))
    images = Responses(surroundings, fast_length(samples + 2 * MARGIN), 0.5, -60.0)
    for response, place in zip(responses, places, strict=True):
        impulses = images.impulses(place, np.array([1.0, 0.0, 0.0]))
        response[:] = np.fft.irfft(spectrum(impulses), spectrum.length)[:, :samples]
    return responses[copies.ravel()]


def _lowpass(length: int, band: float, error_db: float) -> tuple[np.ndarray, float]:
    """Return the spectrum of a low pass that is short in time, and where it ends, cycles a sample.

    An impulse between samples spreads to ±MARGIN samples and no further, so that blocks join without a trace: a
    Kaiser-windowed sinc (J. F. Kaiser, 1974).
    """
    attenuation = 10 - error_db
    transition = (attenuation - 7.95) / (14.36 * 2 * MARGIN)
    edge = min(0.5, band + transition)
    taps = np.arange(-MARGIN, MARGIN + 1)
    cutoff = edge - transition / 2
    beta = 0.1102 * (attenuation - 8.7) if attenuation > 50 else 0.5842 * (attenuation - 21) ** 0.4
    response = np.zeros(length)
    response[taps] = 2 * cutoff * np.sinc(2 * cutoff * taps) * np.kaiser(len(taps), beta)
    return np.fft.rfft(response).real, edge
