"""The direct sound of a moving source alone: a delay line, which is much cheaper than the responses of a room.

A sound that is emitted at s is heard at t = s + d(s) / c. The signal is oversampled once for all microphones; for each
of them t is inverted and the signal read at s(t), with the gain 1 / (4π d) and the factor 1 / (1 + d'/c) of a moving
monopole, d' by its own motion (P. M. Morse and K. U. Ingard, 1968, section 11.2).
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli.acoustics.images import NEAREST_M
from avcli.acoustics.moving import AHEAD, Cubic, Heard, Part, Way, first_sample, headings
from avcli.acoustics.surroundings import Surroundings
from avcli.numeric import fft_length

OVERSAMPLING = 8
"""samples of the oversampled signal for each of its own: cubics between them leave -100 dB at 0.18 cycles a sample."""
REACH = 48
"""samples of the signal before and after a place that decide on its value there."""
EVERY = 16
"""samples between the moments at which delay and gain are reckoned; near a microphone at every sample."""
NEAR_M = 0.3
"""m; near."""


class DirectSource:
    """A moving source without walls, and its sound at the microphones; it is used as `MovingSource` is.

    Args:
        surroundings: the microphones.

    Attributes:
        bounded: whether it has been nearer than NEAREST_M to a microphone, which hears it as at that distance.
        computed, passed: 0: it needs no responses.
    """

    def __init__(self, surroundings: Surroundings):
        self._surroundings, self._way = surroundings, Way(surroundings.sample_rate_hz)
        self._heading = AHEAD
        self._stretches: list[_Stretch] = []  # of the path, to be heard when enough of the signal is there
        self._dry, self._begin = np.zeros(0), 0  # signal from a sample on
        self._heard = Heard(len(surroundings.microphones_m), 0)
        self._next = np.zeros(len(surroundings.microphones_m), int)  # the next sample at each microphone
        self._ended, self.bounded = False, False
        self.computed = self.passed = 0

    def move(self, time_s: float, position_m: ArrayLike, dry: ArrayLike = ()) -> None:
        """Go on to a position; see `MovingSource.move`."""
        if self._way.time is None:
            self._begin = first_sample(time_s, self._surroundings.sample_rate_hz) - 2 * REACH
            self._dry = np.zeros(2 * REACH)
            self._heard = Heard(len(self._next), self._begin)
            self._next[:] = self._begin
        parts = self._way.to(time_s, position_m, dry)
        self._dry = np.append(self._dry, dry)
        for part in parts:
            self._go(part)
        self._render()

    def finish(self) -> None:
        """End the path at the last position; all that is heard of it is then settled."""
        for part in self._way.end():
            self._go(part)
        self._dry = np.append(self._dry, np.zeros(2 * REACH))
        self._render()
        self._ended = True

    @property
    def settled(self) -> float:
        """The sample before which the sound does not change any more; infinite when all is settled."""
        return np.inf if self._ended else float(self._next.min())

    @property
    def exhausted(self) -> bool:
        """Whether all its sound at the microphones has been taken."""
        return self._ended and self._heard.empty

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return and forget what is heard from sample `begin` to before `end`, (m, n); zeros where there is nothing."""
        return self._heard.take(begin, end)

    def _go(self, part: Part) -> None:
        """Reckon delays and gains on the next part of the path; what was emitted before and after it is zero."""
        s, cubic = self._surroundings, part.cubic
        rate = s.sample_rate_hz
        first = first_sample(cubic.t0, rate)
        last = first + len(part.dry)
        if first == self._begin + 2 * REACH and not self._stretches:
            first -= REACH
        if part.ends:
            last += REACH
        if last == first:
            return
        near = np.linalg.norm(cubic.position(np.array([cubic.t0, cubic.t1]))[:, None] - s.microphones_m, axis=2).min()
        every = 1 if any(s.trajectories) or near < NEAR_M + cubic.longest else EVERY
        moments = np.append(np.arange(first, last, every), last)
        self._stretches.append(_Stretch(moments, *self._arrivals(cubic, moments / rate)))

    def _arrivals(self, cubic: Cubic, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return when sound that is emitted at some times arrives, (m, n) samples, and its gains, (m, n)."""
        s = self._surroundings
        places, velocities = cubic.position(times), cubic.velocity(times)
        away = places[:, None] - s.microphones_at(times)
        lengths = np.sqrt((away**2).sum(axis=2))
        for _ in range(20 if any(s.trajectories) else 0):  # a microphone goes on while the sound travels
            here = np.stack(
                [s.microphones_at(times + lengths[:, m] / s.speed_of_sound_m_s)[:, m] for m in range(lengths.shape[1])],
                axis=1,
            )
            away = places[:, None] - here
            before, lengths = lengths, np.sqrt((away**2).sum(axis=2))
            if np.abs(lengths - before).max() < 1e-9:
                break
        self.bounded |= bool((lengths < NEAREST_M).any())
        away /= np.maximum(lengths, NEAREST_M)[:, :, None]
        gains = 1 / (4 * np.pi * np.maximum(lengths, NEAREST_M))
        gains /= 1 + np.einsum("nmk,nk->nm", away, velocities) / s.speed_of_sound_m_s
        if s.directivities is not None and s.orientations is not None:
            gains *= s.directivities + (1 - s.directivities) * (away * s.orientations).sum(axis=2)
        if s.source_directivity != 1:
            looks = headings(velocities, self._heading)
            self._heading = looks[-1]
            gains *= s.source_directivity - (1 - s.source_directivity) * np.einsum("nmk,nk->nm", away, looks)
        return (times[:, None] * s.sample_rate_hz + lengths * s.samples_per_m).T, gains.T

    def _render(self) -> None:
        """Let be heard what is emitted where enough of the signal around is known."""
        while self._stretches and self._stretches[0].moments[-1] + REACH <= self._begin + len(self._dry):
            stretch = self._stretches.pop(0)
            first, last = int(stretch.moments[0]), int(stretch.moments[-1])
            around = self._dry[first - REACH - self._begin : last + REACH - self._begin]
            dense = _oversampled(around) if around.any() else None
            for microphone, (arrivals, gains) in enumerate(zip(stretch.arrivals, stretch.gains, strict=True)):
                begin, end = self._next[microphone], max(int(np.ceil(arrivals[-1])), self._next[microphone])
                self._next[microphone] = end
                if dense is None or end == begin:
                    continue
                heard_at = np.arange(begin, end)
                emitted = np.interp(heard_at, arrivals, stretch.moments)
                sound = _read(dense, (emitted - (first - REACH)) * OVERSAMPLING)
                self._heard.add(microphone, begin, sound * np.interp(heard_at, arrivals, gains))
            if (done := first - 2 * REACH - self._begin) > 0:
                self._dry, self._begin = self._dry[done:], self._begin + done


@dataclass(frozen=True)
class _Stretch:
    """A part of the path.

    Attributes:
        moments: (n,) samples of the signal.
        arrivals: (m, n) samples at the microphones at which they are heard.
        gains: (m, n).
    """

    moments: np.ndarray
    arrivals: np.ndarray
    gains: np.ndarray


@functools.lru_cache(maxsize=4)
def _filter(length: int) -> np.ndarray:
    """Return the spectrum of the oversampling filter, a Kaiser-windowed sinc, for a transform of a length."""
    taps = np.arange(-REACH * OVERSAMPLING, REACH * OVERSAMPLING + 1)
    response = np.zeros(length * OVERSAMPLING)
    response[taps] = np.sinc(taps / OVERSAMPLING) * np.kaiser(len(taps), 9.0)
    return np.fft.rfft(response).real


def _oversampled(signal: np.ndarray) -> np.ndarray:
    """Return a signal, (n,), with OVERSAMPLING samples for each of its own, (n · OVERSAMPLING,)."""
    length = fft_length(len(signal) + 2 * REACH)
    spectrum = np.fft.fft(signal, length)
    repeated = np.tile(spectrum, OVERSAMPLING // 2 + 1)[: length * OVERSAMPLING // 2 + 1]
    return np.fft.irfft(repeated * _filter(length), length * OVERSAMPLING)[: len(signal) * OVERSAMPLING]


def _read(signal: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return a signal between its samples, (n,), by cubics through four of them (Lagrange)."""
    below = np.clip(places.astype(np.intp), 1, len(signal) - 3)
    u = places - below
    a, b, c, d = (signal[below + k] for k in (-1, 0, 1, 2))
    once, twice, thrice = c - a / 3 - b / 2 - d / 6, (a + c) / 2 - b, (d - a) / 6 + (b - c) / 2
    return b + u * (once + u * (twice + u * thrice))
