"""Moving sources in a shoebox room.

What a microphone hears of a moving source is y(t) = ∫ x(s) h(p(s), t − s) ds: each bit of sound travels by the response
of the place where it was emitted, which is right for Doppler by construction. h(p, ·) is known at nodes along the path
and interpolated between them; since the interpolation is linear in h, it is done by windows on the source signal,
y = Σ_k (x w_k) * h(p_k), which need one response a node whatever their shape.

As the source advances by s, the phase of an image at frequency f turns by at most 2π f s / c. So the nodes are spaced
in distance, not in time: a spacing below c / (2 f) is enough at every speed, and a source that stands still needs one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli.acoustics.images import NEAREST_M, DelaySpectrum, audible, fast_length, image_microphones

SLOWEST_M_S = 0.3
"""m/s; a node is made at least as often as at this speed, so that turning round is followed in time."""
STRIDE_M = 0.3
"""m; the images that are audible are chosen anew when the source has gone so far."""
MARGIN = 48
"""samples before a block that its band-limited response may spread to."""


# --- how often a path must be sampled ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Interpolation:
    """Interpolation between nodes by a Kaiser-windowed sinc that is scaled to a partition of unity.

    Attributes:
        spacing_m: distance of the nodes, m.
        half_width: nodes that count on each side.
        table: the kernel from −half_width to half_width in steps of 1 / STEPS.
    """

    spacing_m: float
    half_width: int
    table: np.ndarray

    STEPS = 1024

    def weights(self, places: np.ndarray) -> np.ndarray:
        """Return the weights at places relative to a node, (n,), in units of the spacing."""
        grid = (np.arange(len(self.table)) - self.half_width * self.STEPS) / self.STEPS
        return np.interp(places, grid, self.table, left=0.0, right=0.0)


def interpolation(
    power: ArrayLike, frequencies_hz: ArrayLike, error_db: float, speed_of_sound_m_s: float = 343.0, half_width: int = 6
) -> Interpolation:
    """Choose the widest spacing of nodes at which a signal is interpolated within an error.

    The error of the kernel is known for every frequency, in nodes a turn, and is weighted with the signal's power. It
    is taken for images straight ahead, where the phase turns fastest.

    Args:
        power: (n,) power spectrum of the dry signal, any unit.
        frequencies_hz: (n,) Hz.
        error_db: error power relative to the signal's, dB, below 0.
        speed_of_sound_m_s: m/s.
        half_width: nodes that count on each side.
    """
    power, frequencies = np.asarray(power, dtype=float), np.asarray(frequencies_hz, dtype=float)
    steps = Interpolation.STEPS
    places = (np.arange(2 * half_width * steps + 1) - half_width * steps) / steps
    beta = max(1.0, 0.12 * -error_db - 0.6)  # the window that reaches this error at the widest spacing
    kernel = np.sinc(places) * np.i0(beta * np.sqrt(np.maximum(0, 1 - (places / half_width) ** 2))) / np.i0(beta)
    kernel[[0, -1]] = 0.0
    sums = kernel[:-1].reshape(2 * half_width, steps).sum(axis=0)
    kernel /= np.append(np.tile(sums, 2 * half_width), sums[0])

    turns = np.linspace(0.0, 1.0, 101)  # of phase between two nodes
    offsets = places[:-1].reshape(2 * half_width, steps)[:, ::32]
    taps = kernel[:-1].reshape(2 * half_width, steps)[:, ::32]
    found = (np.exp(2j * np.pi * turns[:, None, None] * offsets) * taps).sum(axis=1)
    errors = np.mean(np.abs(found - 1) ** 2, axis=1)
    allowed = 10 ** (error_db / 10) * power.sum()
    spacing = 0.25
    while power.sum() > 0 and spacing > 1e-4:
        lost = np.sum(power * np.interp(frequencies * spacing / speed_of_sound_m_s, turns, errors))
        if lost <= allowed:
            break
        spacing *= 0.97
    return Interpolation(spacing, half_width, kernel)


# --- what a room does to a sound --------------------------------------------------------------------------------------


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

    @property
    def samples_per_m(self) -> float:
        return self.sample_rate_hz / self.speed_of_sound_m_s

    @property
    def longest_delay(self) -> int:
        """Samples that the longest way takes, with the source up to STRIDE_M away from where it was reckoned."""
        return int(np.ceil((self.reach_m + STRIDE_M) * self.samples_per_m)) + 1


class Responses:
    """The responses of a room to a source at places along its way.

    Args:
        surroundings: the room and the microphones.
    """

    def __init__(self, surroundings: Surroundings):
        self.surroundings = surroundings
        self._chosen_at: np.ndarray | None = None
        self._images: list = []

    def delays_and_amplitudes(self, position: np.ndarray, heading: np.ndarray):
        """Yield for each microphone the delays, samples, and amplitudes of the images it hears.

        Args:
            position: (3,) m.
            heading: (3,) unit vector in which the source looks.
        """
        if self._chosen_at is None or np.linalg.norm(position - self._chosen_at) > STRIDE_M:
            self._chosen_at = position
            self._images = [self._choose(microphone, position, heading) for microphone in range(self.count)]
        for microphone, images in enumerate(self._images):
            yield self._reckon(microphone, images, position, heading)

    @property
    def count(self) -> int:
        return len(self.surroundings.microphones_m)

    def _choose(self, microphone: int, position: np.ndarray, heading: np.ndarray):
        s = self.surroundings
        images = image_microphones(s.room_dimensions_m, s.microphones_m[microphone], s.reflection, position, s.reach_m)
        if s.error_db is None:
            return images
        return images[audible(*self._reckon(microphone, images, position, heading), s.error_db)]

    def _reckon(self, microphone: int, images, position: np.ndarray, heading: np.ndarray):
        s = self.surroundings
        vectors, distances = images.offsets(position)
        nearest = np.maximum(distances, NEAREST_M)
        amplitudes = images.gains / nearest
        amplitudes *= 1 / (4 * np.pi)
        if s.directivities is not None and s.directivities[microphone] != 1:
            a = s.directivities[microphone]
            looks = (s.orientations[microphone][:, None] * images.mirrored * vectors).sum(axis=0)
            amplitudes *= a + (1 - a) * looks / nearest
        if s.source_directivity != 1:
            a = s.source_directivity
            amplitudes *= a - (1 - a) * (heading @ vectors) / nearest
        return distances * s.samples_per_m, amplitudes


# --- a source on its way ----------------------------------------------------------------------------------------------


class MovingSource:
    """A source that moves and sounds, and what the microphones hear of it.

    It is told piece by piece where it goes and what it emits; what is heard comes out as soon as it is settled, and is
    the same to the last bit however it is asked for.

    Args:
        surroundings: the room and the microphones.
        nodes: how the path is sampled.
        band: highest frequency that the signal holds, cycles a sample.
        error_db: numerical error of a response, dB.
        heading: (3,) where the source looks until it moves.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        nodes: Interpolation,
        band: float = 0.5,
        error_db: float = -60.0,
        heading: ArrayLike = (1.0, 0.0, 0.0),
    ):
        self._surroundings, self._nodes = surroundings, nodes
        self._responses = Responses(surroundings)
        longest = surroundings.longest_delay
        window = 2 * nodes.half_width * nodes.spacing_m * surroundings.sample_rate_hz  # at 1 m/s
        length = fast_length(longest + 2 * MARGIN + int(min(max(window, longest / 4), 4 * longest + 4096)))
        lowpass, edge = _lowpass(length, band, error_db)
        self._spectrum = DelaySpectrum(length, edge, error_db)
        self._lowpass = lowpass[: self._spectrum.bins]
        self._block = length - longest - 2 * MARGIN

        self._knots: list[tuple[float, np.ndarray, np.ndarray]] = []  # time, position, dry signal since the last knot
        self._begin = 0  # the sample that the arrays below begin with
        self._dry, self._path = np.zeros(0), np.zeros(0)  # signal and way so far, in nodes
        self._places: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # node -> position, heading
        self._node = 1 - nodes.half_width  # the next that is to be rendered
        self._last = np.inf  # the last node
        self._heading = np.asarray(heading, dtype=float)

        self._pending_begin, self._pending, self._pending_place = 0, np.zeros(0), None
        self._transfer: np.ndarray | None = None
        self._heard_begin, self._heard = 0, np.zeros((len(surroundings.microphones_m), 0))

    def move(self, time_s: float, position_m: ArrayLike, dry: ArrayLike = ()) -> None:
        """Go on to a place.

        Args:
            time_s: when it is there, s; later than the last.
            position_m: (3,) m.
            dry: what it emitted since the last place: the samples from the last time to before this one.

        Raises:
            ValueError: the time does not increase, or `dry` has another length.
        """
        position, dry = np.array(position_m, dtype=float), np.asarray(dry, dtype=float)
        rate = self._surroundings.sample_rate_hz
        if not self._knots:
            self._begin = self._heard_begin = first_sample(time_s, rate)
            self._pending_begin = self._begin
            self._heard_begin -= MARGIN
        else:
            before = self._knots[-1][0]
            expected = first_sample(time_s, rate) - first_sample(before, rate)
            if time_s <= before or len(dry) != expected:
                raise ValueError(f"{len(dry)} samples from {before} s to {time_s} s, expected {expected}")
        self._knots.append((time_s, position, dry))
        if len(self._knots) >= 3:
            self._go(-2)
            if len(self._knots) > 3:
                del self._knots[0]
        self._render()

    def finish(self) -> None:
        """End the path at the last place; what is heard of it is settled then."""
        if len(self._knots) >= 2:
            self._go(-1)
            self._last = (
                self._node - 1 if self._path.size == 0 else int(np.ceil(self._path[-1])) + self._nodes.half_width
            )
            self._render()
            self._convolve(len(self._pending))
        self._knots = []
        self._last = -np.inf

    @property
    def settled(self) -> float:
        """The sample before which nothing changes any more; infinite when all is settled."""
        return np.inf if self._last == -np.inf else self._pending_begin - MARGIN

    @property
    def exhausted(self) -> bool:
        """Whether all that is heard of it has been taken."""
        return self._last == -np.inf and not self._heard.any()

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return and forget what is heard from sample `begin` to before `end`, (m, n); zeros where there is nothing."""
        heard = np.zeros((self._responses.count, end - begin))
        first, last = max(begin, self._heard_begin), min(end, self._heard_begin + self._heard.shape[1])
        if last > first:
            heard[:, first - begin : last - begin] = self._heard[
                :, first - self._heard_begin : last - self._heard_begin
            ]
        drop = min(max(end - self._heard_begin, 0), self._heard.shape[1])
        self._heard, self._heard_begin = self._heard[:, drop:], self._heard_begin + drop
        return heard

    def _go(self, to: int) -> None:
        """Follow the path to one of the last knots: by cubics with mean velocities at the knots (Catmull-Rom)."""
        knots = self._knots
        here = len(knots) + to
        (t0, p0, _), (t1, p1, dry) = knots[here - 1], knots[here]
        chord = (p1 - p0) / (t1 - t0)

        def velocity(i: int) -> np.ndarray:
            if 0 < i < len(knots) - 1:
                (ta, pa, _), (tb, pb, _), (tc, pc, _) = knots[i - 1 : i + 2]
                return ((pb - pa) / (tb - ta) * (tc - tb) + (pc - pb) / (tc - tb) * (tb - ta)) / (tc - ta)
            return chord

        cubic = _Cubic(t0, p0, velocity(here - 1), t1, p1, velocity(here))
        rate, nodes = self._surroundings.sample_rate_hz, self._nodes
        times = np.arange(first_sample(t0, rate), first_sample(t1, rate)) / rate
        if len(times) == 0:
            return
        speeds = np.sqrt((cubic.velocity(times) ** 2).sum(axis=1) + SLOWEST_M_S**2) / (nodes.spacing_m * rate)
        start = self._way if self._places else 0.0
        way = start + np.concatenate([[0.0], np.cumsum(speeds)])
        crossed = np.arange(np.ceil(start), np.ceil(way[-1]), dtype=int)
        at = np.interp(crossed, way, np.append(times, times[-1] + 1 / rate))
        if not self._places:
            crossed = np.concatenate([np.arange(1 - nodes.half_width, 0), crossed])
            at = np.concatenate([times[0] + np.arange(1 - nodes.half_width, 0) / (speeds[0] * rate), at])
        if to == -1:  # the path goes straight on for as long as its end is interpolated
            beyond = np.arange(np.ceil(way[-1]), np.ceil(way[-1]) + nodes.half_width + 1, dtype=int)
            crossed = np.concatenate([crossed, beyond])
            at = np.concatenate([at, times[-1] + (beyond - way[-2]) / (speeds[-1] * rate)])
        for node, position, moving in zip(crossed, cubic.position(at), cubic.velocity(at), strict=True):
            level = moving * (1.0, 1.0, 0.0)
            if (length := np.linalg.norm(level)) > 0.05:
                self._heading = level / length
            self._places[int(node)] = (position, self._heading)
        self._way = way[-1]
        self._dry, self._path = np.append(self._dry, dry), np.append(self._path, way[:-1])

    def _render(self) -> None:
        nodes = self._nodes
        while (
            self._path.size
            and self._node <= self._last
            and (self._path[-1] >= self._node + nodes.half_width or self._last < np.inf)
        ):
            first = int(np.searchsorted(self._path, self._node - nodes.half_width, side="right"))
            last = int(np.searchsorted(self._path, self._node + nodes.half_width, side="left"))
            place = self._places.pop(self._node)
            if self._pending_place is None or not all(map(np.array_equal, place, self._pending_place)):
                self._convolve(len(self._pending))
                self._pending_begin = self._begin + first
                self._pending_place, self._transfer = place, None
            sound = self._dry[first:last]
            if sound.any():
                offset = self._begin + first - self._pending_begin
                missing = offset + last - first - len(self._pending)
                self._pending = np.append(self._pending, np.zeros(max(missing, 0)))
                self._pending[offset : offset + last - first] += sound * nodes.weights(
                    self._path[first:last] - self._node
                )
            # Sound before the next node's reach is complete.
            reached = int(np.searchsorted(self._path, self._node + 1 - nodes.half_width, side="right"))
            complete = self._begin + reached - self._pending_begin
            while complete >= self._block:
                self._convolve(self._block)
                complete -= self._block
            self._dry, self._path, self._begin = self._dry[reached:], self._path[reached:], self._begin + reached
            self._node += 1

    def _convolve(self, count: int) -> None:
        """Send the first `count` pending samples through the room."""
        for start in range(0, count, self._block):
            block = self._pending[start : min(start + self._block, count)]
            sounding = np.flatnonzero(block)
            if len(sounding) == 0:
                continue
            if self._transfer is None:
                self._transfer = np.stack(
                    [
                        self._spectrum(delays + MARGIN, amplitudes) * self._lowpass
                        for delays, amplitudes in self._responses.delays_and_amplitudes(*self._pending_place)
                    ]
                )
            length = self._spectrum.length
            emitted = np.fft.rfft(block, length)[: self._spectrum.bins]
            begin = self._pending_begin + start - MARGIN - self._heard_begin
            end = begin + len(block) + self._surroundings.longest_delay + 2 * MARGIN
            self._heard = _lengthened(self._heard, end)
            self._heard[:, begin:end] += np.fft.irfft(emitted * self._transfer, length)[:, : end - begin]
        self._pending, self._pending_begin = self._pending[count:], self._pending_begin + count


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


def first_sample(time_s: float, sample_rate_hz: float) -> int:
    """Return the first sample at or after a time, with room for the rounding of written times."""
    return int(np.ceil(time_s * sample_rate_hz - 1e-4))


def _lengthened(array: np.ndarray, length: int) -> np.ndarray:
    """Return the array with zeros after it, and some to spare, so that it need not be copied each time."""
    if length <= array.shape[-1]:
        return array
    return np.concatenate(
        [array, np.zeros((*array.shape[:-1], max(length, 4096) + length // 2 - array.shape[-1]))], axis=-1
    )


@dataclass(frozen=True)
class _Cubic:
    """A cubic in time through two points with two velocities (Hermite)."""

    t0: float
    p0: np.ndarray
    v0: np.ndarray
    t1: float
    p1: np.ndarray
    v1: np.ndarray

    def position(self, times: np.ndarray) -> np.ndarray:
        step = self.t1 - self.t0
        u = ((np.asarray(times) - self.t0) / step)[:, None]
        inside = np.clip(u, 0.0, 1.0)
        points = (
            self.p0
            + inside * step * self.v0
            + inside**2 * (3 * (self.p1 - self.p0) - step * (2 * self.v0 + self.v1))
            + inside**3 * (2 * (self.p0 - self.p1) + step * (self.v0 + self.v1))
        )
        return points + np.minimum(u, 0.0) * step * self.v0 + np.maximum(u - 1.0, 0.0) * step * self.v1

    def velocity(self, times: np.ndarray) -> np.ndarray:
        step = self.t1 - self.t0
        u = np.clip((np.asarray(times) - self.t0) / step, 0.0, 1.0)[:, None]
        return (
            self.v0
            + 2 * u * (3 * (self.p1 - self.p0) / step - (2 * self.v0 + self.v1))
            + 3 * u**2 * (2 * (self.p0 - self.p1) / step + (self.v0 + self.v1))
        )
