"""What a room does to a sound: the responses of its microphones to a source at places along its way."""

from dataclasses import dataclass

import numpy as np

from avcli.acoustics.images import NEAREST_M, DelaySpectrum, Images, audible, image_microphones
from avcli.acoustics.trajectory import Trajectory
from avcli.numeric import SPEED_OF_SOUND_M_S, fft_length

STRIDE_M = 0.5
"""m; the images that are audible are chosen anew when source and microphones have gone so far."""
MOTION_STEP_S = 0.001
"""s; a microphone moves in a straight line for so long: at 10 m/s² it is wrong by no more than 1.3 µm."""
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
        trajectories: (m,) the ways of the microphones that move, None for one that stands at microphones_m.
    """

    room_dimensions_m: np.ndarray
    reflection: np.ndarray
    microphones_m: np.ndarray
    sample_rate_hz: float
    reach_m: float
    error_db: float | None = None
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
    directivities: np.ndarray | None = None
    orientations: np.ndarray | None = None
    source_directivity: float = 1.0
    rt60_s: float = 0.0
    end_s: float = 0.0
    trajectories: tuple[Trajectory | None, ...] = ()

    @property
    def samples_per_m(self) -> float:
        return self.sample_rate_hz / self.speed_of_sound_m_s

    @property
    def longest_delay(self) -> int:
        """Samples that a response lasts, with the source up to STRIDE_M away from where its images were chosen.

        A microphone that flees is reached later.
        """
        fleeing = self.fastest_microphone(-np.inf, np.inf) / self.speed_of_sound_m_s
        longest_way = int(np.ceil((self.reach_m + STRIDE_M) / (1 - fleeing) * self.samples_per_m)) + 1
        return max(longest_way, int(np.ceil(self.end_s * self.sample_rate_hz)) + 1)

    def fastest_microphone(self, begin_s: float, end_s: float) -> float:
        """Return a speed that no microphone exceeds from one time to another, m/s."""
        return max((way.fastest(begin_s, end_s) for way in self.trajectories if way is not None), default=0.0)

    def microphones_from(self, time_s: float) -> np.ndarray:
        """Return where the microphones are while a sound that is emitted at a time is heard, (k, m, 3) m.

        One place every MOTION_STEP_S; k is 1 where none of them ever moves.
        """
        if not any(self.trajectories):
            return self.microphones_m[None]
        count = int(np.ceil(self.longest_delay / self.sample_rate_hz / MOTION_STEP_S)) + 2
        places = np.repeat(self.microphones_m[None], count, axis=0)
        for microphone, way in enumerate(self.trajectories):
            if way is not None:
                places[:, microphone] = way.at(time_s + MOTION_STEP_S * np.arange(count))
        return places


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
        self._chosen_at: tuple[np.ndarray, np.ndarray] | None = None  # source, microphones
        self._images: list[Images] = []
        self._tail_begin = int(np.ceil(surroundings.reach_m * surroundings.samples_per_m))
        self._tail_end = int(surroundings.end_s * surroundings.sample_rate_hz) if rng is not None else 0
        self._levels = np.zeros(len(surroundings.microphones_m))
        self._noise: np.ndarray | None = None

    def at(self, position: np.ndarray, heading: np.ndarray, microphones: np.ndarray) -> np.ndarray:
        """Return the spectra of the responses, delayed by MARGIN, (m, bins) complex128.

        Args:
            position: (3,) m.
            heading: (3,) unit vector in which the source looks.
            microphones: (k, m, 3) m, where they are from now on: see `Surroundings.microphones_from`.
        """
        impulses = self.impulses(position, heading, microphones)
        for delays, _ in impulses:
            delays += MARGIN
        spectra = self._spectrum(impulses)
        if self._tail_end > self._tail_begin:
            spectra += self._tail()
        spectra *= self._lowpass
        return spectra

    def impulses(
        self, position: np.ndarray, heading: np.ndarray, microphones: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return for each microphone the delays, (n,) samples, and amplitudes, (n,), of the images it hears.

        Args:
            position: (3,) m.
            heading: (3,) unit vector in which the source looks.
            microphones: (k, m, 3) m, where they are from now on.
        """
        now = microphones[0]
        if self._chosen_at is None or _apart(position, self._chosen_at[0]) + _apart(now, self._chosen_at[1]) > STRIDE_M:
            self._chosen_at = position, now
            self._images = [self._choose(microphone, position, heading, now) for microphone in range(len(now))]
        moved = microphones - self._chosen_at[1]
        return [
            self._reckon(microphone, images, position, heading, moved[:, microphone])
            for microphone, images in enumerate(self._images)
        ]

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

    def _choose(self, microphone: int, position: np.ndarray, heading: np.ndarray, microphones: np.ndarray) -> Images:
        """Choose the images that a microphone hears, and note how loud the last of all images are."""
        s = self._surroundings
        images = image_microphones(s.room_dimensions_m, microphones[microphone], s.reflection, position, s.reach_m)
        delays, amplitudes = self._reckon(microphone, images, position, heading, np.zeros((1, 3)))
        reference = TAIL_REFERENCE_S * s.sample_rate_hz
        last = amplitudes[delays > self._tail_begin - reference]
        self._levels[microphone] = np.sqrt(np.sum(last**2) / reference)
        return images if s.error_db is None else images[audible(delays, amplitudes, s.error_db)]

    def _reckon(self, microphone: int, images: Images, position: np.ndarray, heading: np.ndarray, moved: np.ndarray):
        """Return delays and amplitudes of images whose microphone has moved, (k, 3) m, since they were chosen."""
        s = self._surroundings
        fleeing: np.ndarray | float = 0.0
        if (moved != moved[0]).any():
            images, distances, fleeing = images.caught_up(position, moved, MOTION_STEP_S * s.speed_of_sound_m_s)
        else:
            images = images.moved(moved[0]) if moved[0].any() else images
            distances = images.distances(position)
        amplitudes = images.amplitudes(distances)
        a = 1.0 if s.directivities is None else s.directivities[microphone]
        if a != 1 or s.source_directivity != 1:
            away = (position[:, None] - images.positions) / np.maximum(distances, NEAREST_M)
            if a != 1:  # an image looks where the microphone looks, mirrored
                amplitudes *= a + (1 - a) * (s.orientations[microphone][:, None] * images.mirrored * away).sum(axis=0)
            if s.source_directivity != 1:
                amplitudes *= s.source_directivity - (1 - s.source_directivity) * (heading[:, None] * away).sum(axis=0)
        # Sound that is emitted in ds is heard in (1 − n·v_source/c) / (1 − n·v_microphone/c) ds, and louder as that is
        # less; but how a microphone moves does not change the pressure where it is.
        amplitudes /= 1 - fleeing
        distances *= s.samples_per_m
        return distances, amplitudes


def _apart(here: np.ndarray, there: np.ndarray) -> float:
    return float(np.linalg.norm(here - there, axis=-1).max())


def impulse_responses(surroundings: Surroundings, positions_m: np.ndarray) -> np.ndarray:
    """Return the impulse responses to a source at each of some places, (k, m, n) float64.

    They are band-limited at half the sample rate and last as long as the surroundings follow the sound.

    Args:
        surroundings: the room and the microphones.
        positions_m: (k, 3) m.
    """
    samples = surroundings.longest_delay
    spectrum = DelaySpectrum(fft_length(4 * samples))
    places, copies = np.unique(positions_m, axis=0, return_inverse=True)
    responses = np.empty((len(places), len(surroundings.microphones_m), samples))
    images = Responses(surroundings, fft_length(samples + 2 * MARGIN), 0.5, -60.0)
    for response, place in zip(responses, places, strict=True):
        impulses = images.impulses(place, np.array([1.0, 0.0, 0.0]), surroundings.microphones_m[None])
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
