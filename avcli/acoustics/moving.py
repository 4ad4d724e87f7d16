"""Moving sources and microphones in a shoebox room.

A microphone hears of a moving source y(t) = ∫ x(s) h(p(s), t − s) ds: each bit of sound travels by the response of the
position where it was emitted, so the Doppler shift is right by construction. h(p, ·) is known at nodes along the path
and interpolated between them. The interpolation is linear in h, so it is done by windows on the source signal,
y = Σ_k (x w_k) * h(p_k), which needs one response a node whatever the windows are.

Where microphones move, a sound that is emitted at s meets each image where the microphone will be when it arrives,
t = s + |image(t) − p(s)| / c. This is solved at every node for every image, so one response a node is enough: positions
of source and microphone need not be paired. A sound's path then grows or shrinks by at most v_source + v_microphone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avcli.acoustics.images import NEAREST_M, at_once, scratch
from avcli.acoustics.responses import Responses, lowpass
from avcli.acoustics.sampling import Interpolation, Switching
from avcli.acoustics.surroundings import Surroundings
from avcli.acoustics.trajectory import KNOTS_AROUND, cubic, knot_velocity
from avcli.numeric import fft_length

MOMENT_S = 0.0005
"""s between the moments at which the pace of a source is reckoned; in between it changes evenly."""
AHEAD = np.array([1.0, 0.0, 0.0])
"""Where a source looks until it moves."""


class MovingSource:
    """A source that moves and sounds, and the sound at the microphones.

    Its path and its signal come in piece by piece. The sound at the microphones comes out as soon as it is settled, and
    is the same to the last bit in pieces of any length.

    Args:
        surroundings: the room and the microphones.
        nodes: how the path is sampled.
        band: highest frequency that the signal holds, cycles a sample.
        error_db: numerical error of a response, dB.
        rng: draws the noise that continues the images, where the surroundings have it.

    Attributes:
        computed: responses that were computed for all its microphones.
        passed: nodes of its path that were passed.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        nodes: Interpolation | Switching,
        band: float = 0.5,
        error_db: float = -60.0,
        rng: np.random.Generator | None = None,
    ):
        self._surroundings, self._nodes = surroundings, nodes
        # A response that is switched has a broad band; it is told by every sample, as gpuRIR does.
        filtered = lowpass(band, error_db, most=1 if isinstance(nodes, Switching) else 4)
        self._every, self._margin = filtered.every, surroundings.spread + filtered.taps
        longest = surroundings.longest_delay
        window = int(nodes.window_s * surroundings.sample_rate_hz)
        least = longest + 2 * self._margin + min(max(window, longest // 4), 4 * longest + 4096)
        self._length = self._every * fft_length(-(-least // self._every))
        self._block = (self._length - longest - 2 * self._margin) // self._every
        self._responses = Responses(surroundings, self._length, filtered, error_db, rng, isinstance(nodes, Switching))

        self._way = Way(surroundings.sample_rate_hz)
        self._origin = 0  # the first sample
        # Of the signal every so many samples are taken; these are counted from the first on.
        self._begin = 0  # the one that the arrays below begin with
        self._dry, self._path = np.zeros(0), np.zeros(0)  # signal, and where on the path it was emitted, in nodes
        self._travelled = 0.0  # length of the path so far, in nodes
        self._places: dict[int, tuple[np.ndarray, np.ndarray, float]] = {}  # node -> position, heading, time
        self._node = 1 - nodes.half_width  # the next that is to be rendered
        self._last: float = np.inf  # the last node
        self._heading = AHEAD

        self._spectra: dict[int, np.ndarray] = {}  # number of a block of the signal -> what is heard of it so far
        self._pending_begin, self._pending = 0, np.zeros(0)
        self._pending_place: _Place | None = None
        self._sent: list[_Sent] = []  # to be added to the spectra
        self._heard = Heard(len(surroundings.microphones_m), 0)
        self.computed = self.passed = 0

    def move(self, time_s: float, position_m: ArrayLike, dry: ArrayLike = ()) -> None:
        """Go on to a position.

        Args:
            time_s: when it is there, s; later than the last.
            position_m: (3,) m.
            dry: the signal that it emitted since the last position: the samples from the last time to before this one.

        Raises:
            ValueError: the time does not increase, or `dry` has another length.
        """
        if self._way.time is None:
            self._origin = first_sample(time_s, self._surroundings.sample_rate_hz)
            self._heard = Heard(len(self._surroundings.microphones_m), self._origin - self._margin)
        for part in self._way.to(time_s, position_m, dry):
            self._go(part)
        self._render()

    def finish(self) -> None:
        """End the path at the last position; all that is heard of it is then settled."""
        parts = self._way.end()
        for part in parts:
            self._go(part)
        if parts:
            self._last = (
                self._node - 1 if self._path.size == 0 else int(np.ceil(self._path[-1])) + self._nodes.half_width
            )
            self._render()
            self._convolve(len(self._pending))
            self._settle(np.inf)
        self._last = -np.inf

    @property
    def settled(self) -> float:
        """The sample before which the sound does not change any more; infinite when all is settled."""
        if self._last == -np.inf:
            return np.inf
        blocks = [*self._spectra, *(sent.number for sent in self._sent), self._pending_begin // self._block]
        return self._origin + min(blocks) * self._block * self._every - self._margin

    @property
    def bounded(self) -> bool:
        """Whether it has been nearer than NEAREST_M to a microphone, which hears it as at that distance."""
        return self._responses.bounded

    @property
    def exhausted(self) -> bool:
        """Whether all its sound at the microphones has been taken."""
        return self._last == -np.inf and self._heard.empty

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return and forget what is heard from sample `begin` to before `end`, (m, n); zeros where there is nothing."""
        return self._heard.take(begin, end)

    def _go(self, part: "Part") -> None:
        """Note the nodes on the next part of the path."""
        cubic, t0, t1 = part.cubic, part.cubic.t0, part.cubic.t1
        rate, nodes = self._surroundings.sample_rate_hz, self._nodes
        first, last = first_sample(t0, rate), first_sample(t1, rate)
        moments = np.append(np.arange(first, last, max(1, int(MOMENT_S * rate))), last)
        paces = self._nodes_a_second(cubic, moments / rate)
        start = self._travelled if self._places else 0.0
        path = start + np.append(0.0, np.cumsum(np.diff(moments) * (paces[1:] + paces[:-1]) / (2 * rate)))
        crossed = np.arange(np.ceil(start), np.ceil(path[-1]), dtype=int)
        at = np.interp(crossed, path, moments / rate)
        if not self._places and last > first:
            before = np.arange(1 - nodes.half_width, 0)
            crossed, at = np.append(before, crossed), np.append(first / rate + before / paces[0], at)
        if part.ends and (self._places or last > first):
            end = np.ceil(path[-1])  # nodes after it, on which its last samples are interpolated
            beyond = np.arange(end, end + nodes.half_width + 1, dtype=int)
            crossed, at = np.append(crossed, beyond), np.append(at, last / rate + (beyond - path[-1]) / paces[-1])
        self._add_nodes(cubic, crossed, at)
        self._travelled = float(path[-1])
        skipped = (self._origin - first) % self._every
        kept = np.arange(first + skipped, last, self._every)
        self._dry = np.append(self._dry, part.dry[skipped :: self._every] * self._every)
        self._path = np.append(self._path, np.interp(kept, moments, path))

    def _nodes_a_second(self, cubic: "Cubic", times: np.ndarray) -> np.ndarray:
        """Return how many nodes a second the source passes at times on a part of its path, (n,)."""
        surroundings = self._surroundings
        speeds = cubic.speed(times)
        heard_s = surroundings.longest_delay / surroundings.sample_rate_hz
        receding = surroundings.fastest_microphone(cubic.t0, cubic.t1 + heard_s)
        speeds = (speeds + receding) / (1 - receding / surroundings.speed_of_sound_m_s)
        away = cubic.position(times)[:, None] - surroundings.microphones_at(times)
        nearest = np.sqrt((away**2).sum(axis=2).min(axis=1))
        return self._nodes.nodes_a_second(speeds, np.maximum(nearest, NEAREST_M))

    def _add_nodes(self, cubic: "Cubic", nodes: np.ndarray, at: np.ndarray) -> None:
        """Note where the source is at nodes, and how it looks there; the path goes straight on beyond its ends."""
        looks = headings(cubic.velocity(at), self._heading)
        for node, time, position, heading in zip(nodes, at, cubic.position(at), looks, strict=True):
            self._heading = heading
            self._places[int(node)] = (position, heading, time)

    def _render(self) -> None:
        nodes = self._nodes
        while (
            self._path.size
            and self._node <= self._last
            and (self._path[-1] >= self._node + nodes.half_width or self._last < np.inf)
        ):
            first = int(np.searchsorted(self._path, self._node - nodes.half_width, side="right"))
            last = int(np.searchsorted(self._path, self._node + nodes.half_width, side="left"))
            position, heading, time = self._places.pop(self._node)
            place = position, heading, self._surroundings.microphones_from(time)
            if self._pending_place is None or not self._pending_place.is_at(place):
                self._convolve(len(self._pending))
                self._pending_begin = self._begin + first
                self._pending_place = _Place(place)
            sound = self._dry[first:last]
            if sound.any():
                sound = sound * nodes.weights(self._path[first:last] - self._node)
                offset = self._begin + first - self._pending_begin
                if len(self._pending) < offset + len(sound):
                    missing = np.zeros(offset + len(sound) - len(self._pending))
                    self._pending = np.concatenate([self._pending, missing])
                self._pending[offset : offset + len(sound)] += sound
            # Sound before the next node's reach is complete.
            reached = int(np.searchsorted(self._path, self._node + 1 - nodes.half_width, side="right"))
            while (left := self._left_of_block()) <= self._begin + reached - self._pending_begin:
                self._convolve(left)
            self._dry, self._path, self._begin = self._dry[reached:], self._path[reached:], self._begin + reached
            self._node += 1
            self.passed += 1
        self._settle(self._pending_begin)

    def _left_of_block(self) -> int:
        """Return how many samples are left of the block in which the first pending sample is."""
        return self._block - self._pending_begin % self._block

    def _convolve(self, count: int) -> None:
        """Send the first `count` pending samples through the room."""
        while count > 0:
            length = min(count, self._left_of_block())
            self._emit(self._pending[:length])
            self._pending, self._pending_begin = self._pending[length:], self._pending_begin + length
            count -= length

    def _emit(self, sound: np.ndarray) -> None:
        """Let the first pending samples be heard, as soon as there are some more to be transformed with them."""
        if not sound.any():
            return
        assert self._pending_place is not None  # pending sound has a position
        self._sent.append(_Sent(*divmod(self._pending_begin, self._block), sound, self._pending_place))
        if len(self._sent) == at_once(self._length // self._every):
            self._add_up()

    def _add_up(self) -> None:
        """Add what is heard of the sent sounds to the spectra of their blocks."""
        if not self._sent:
            return
        responses, product = self._responses, scratch("product", (self._responses.bins,), self._responses.dtype)
        for i, (sent, dry) in enumerate(zip(self._sent, self._transformed(), strict=True)):
            if sent.of.response is None:
                new = dict.fromkeys(later.of for later in self._sent[i:] if later.of.response is None)
                some = list(new)[: responses.at_once]
                for place, response in zip(some, responses.at([place.place for place in some]), strict=True):
                    place.response = response
                self.computed += len(some)
            assert sent.of.response is not None
            if sent.number not in self._spectra:
                self._spectra[sent.number] = dry * sent.of.response
                continue
            for heard, response in zip(self._spectra[sent.number], sent.of.response, strict=True):
                heard += np.multiply(dry, response, out=product)
        self._sent = []

    def _transformed(self) -> np.ndarray:
        """Return the spectra of the sent sounds in their blocks, (n, bins)."""
        length, count, bins = self._length // self._every, len(self._sent), self._responses.bins
        blocks = scratch("blocks", (count, length))
        blocks.fill(0.0)
        for block, sent in zip(blocks, self._sent, strict=True):
            block[sent.offset : sent.offset + len(sent.sound)] = sent.sound
        halves = np.fft.rfft(blocks, out=scratch("halves", (count, length // 2 + 1), complex))
        spectra = np.empty((count, bins), self._responses.dtype)
        here = min(bins, halves.shape[1])
        spectra[:, :here] = halves[:, :here]
        image = 2 * (length // 2) - bins  # above the half comes the image, of which the low pass leaves a little
        np.conjugate(halves[:, here - 2 : image : -1], out=spectra[:, here:], casting="same_kind")
        return spectra

    def _settle(self, before: float) -> None:
        """Turn the spectra of the blocks that end before a sample into sound: positions that overlap share one FFT."""
        ended = [
            number
            for number in {*self._spectra, *(sent.number for sent in self._sent)}
            if (number + 1) * self._block <= before
        ]
        if ended:
            self._add_up()
        for number in sorted(ended):
            sound = np.fft.irfft(self._spectra.pop(number), self._length)
            self._heard.add(slice(None), self._origin + number * self._block * self._every - self._margin, sound)


@dataclass(eq=False)
class _Place:
    """A place of the source.

    Attributes:
        place: its position, (3,) m, its heading, (3,), and where the microphones are from then on, (k, m, 3) m.
        response: the spectra of the responses from there, (m, bins), once they are needed.
    """

    place: tuple[np.ndarray, np.ndarray, np.ndarray]
    response: np.ndarray | None = None

    def is_at(self, place: tuple[np.ndarray, np.ndarray, np.ndarray]) -> bool:
        """Whether another place is the same."""
        return all((here == there).all() for here, there in zip(self.place, place, strict=True))


@dataclass(frozen=True)
class _Sent:
    """A part of the signal that is emitted at one place.

    Attributes:
        number, offset: of its block, and its first sample in it.
        sound: (n,).
        of: the place.
    """

    number: int
    offset: int
    sound: np.ndarray
    of: _Place


def first_sample(time_s: float, sample_rate_hz: float) -> int:
    """Return the first sample at or after a time, with room for the rounding of written times."""
    return int(np.ceil(time_s * sample_rate_hz - 1e-4))


def headings(velocities_m_s: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return where a person looks who moves so, (n, 3) unit vectors: ahead, and while standing where they looked last.

    Args:
        velocities_m_s: (n, 3) m/s.
        before: (3,) where the person looked before.
    """
    level = velocities_m_s * (1.0, 1.0, 0.0)
    speeds = np.linalg.norm(level, axis=1)
    walks = speeds > 0.05
    looks = np.concatenate([before[None], level / np.where(walks, speeds, 1.0)[:, None]])
    latest = np.maximum.accumulate(np.where(walks, np.arange(1, len(walks) + 1), 0))
    return looks[latest]


class Heard:
    """Sound at microphones that is being added up and taken from its beginning.

    Args:
        rows: number of microphones.
        begin: the first sample.
    """

    def __init__(self, rows: int, begin: int):
        self._begin, self._sound = begin, np.zeros((rows, 0))

    @property
    def empty(self) -> bool:
        """Whether no sound is left."""
        return not self._sound.any()

    def add(self, rows: slice | int, begin: int, sound: np.ndarray) -> None:
        """Add sound, (…, n), at some microphones from a sample on, which has not been taken."""
        end = begin - self._begin + sound.shape[-1]
        if end > self._sound.shape[1]:  # with some to spare, so that it need not be copied each time
            spare = max(end, 4096) + end // 2 - self._sound.shape[1]
            self._sound = np.concatenate([self._sound, np.zeros((len(self._sound), spare))], axis=1)
        self._sound[rows, begin - self._begin : end] += sound

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return and forget the sound from sample `begin` to before `end`, (rows, n); zeros where there is nothing."""
        taken = np.zeros((len(self._sound), end - begin))
        first, last = max(begin, self._begin), min(end, self._begin + self._sound.shape[1])
        if last > first:
            taken[:, first - begin : last - begin] = self._sound[:, first - self._begin : last - self._begin]
        drop = min(max(end - self._begin, 0), self._sound.shape[1])
        self._sound, self._begin = self._sound[:, drop:], self._begin + drop
        return taken


@dataclass(frozen=True)
class Part:
    """A part of a path between two positions that were told, and the signal emitted on it.

    Attributes:
        cubic: where it goes.
        dry: (n,) samples from its beginning to before its end.
        ends: whether the path ends with it.
    """

    cubic: "Cubic"
    dry: np.ndarray
    ends: bool


class Way:
    """A path that is told position by position, as parts with the velocities of a spline at their ends.

    Args:
        sample_rate_hz: Hz.

    Attributes:
        time: the last time that was told, s; None before the first.
    """

    def __init__(self, sample_rate_hz: float):
        self._rate = sample_rate_hz
        self._knots: list[tuple[float, np.ndarray, np.ndarray]] = []  # time, position, dry signal since the last knot
        self._next, self._velocity = 1, np.zeros(3)  # the knot to go to, and the velocity at the one before
        self.time: float | None = None

    def to(self, time_s: float, position_m: ArrayLike, dry: ArrayLike) -> list[Part]:
        """Take the next position; return the parts, none or one, that do not change any more.

        Raises:
            ValueError: the time does not increase, or `dry` has another length than its samples since the last.
        """
        dry = np.asarray(dry, dtype=float)
        if self.time is not None:
            expected = first_sample(time_s, self._rate) - first_sample(self.time, self._rate)
            if time_s <= self.time or len(dry) != expected:
                raise ValueError(f"{len(dry)} samples from {self.time} s to {time_s} s, expected {expected}")
        self.time = time_s
        self._knots.append((time_s, np.array(position_m, dtype=float), dry))
        if self._next + KNOTS_AROUND >= len(self._knots):
            return []
        part = self._part()
        if self._next > KNOTS_AROUND:
            del self._knots[0]
            self._next -= 1
        return [part]

    def end(self) -> list[Part]:
        """Return the parts that are left, to the last position; the path has then ended."""
        parts = [self._part() for _ in range(self._next, len(self._knots))]
        self._knots = []
        return parts

    def _part(self) -> Part:
        knots, here = self._knots, self._next
        (t0, p0, _), (t1, p1, dry) = knots[here - 1], knots[here]
        told = np.array([knot[0] for knot in knots]), np.array([knot[1] for knot in knots])
        before = knot_velocity(*told, 0) if here == 1 else self._velocity
        self._velocity = knot_velocity(*told, here)
        self._next += 1
        return Part(Cubic(t0, p0, before, t1, p1, self._velocity), dry, here == len(knots) - 1)


@dataclass(frozen=True)
class Cubic:
    """A cubic in time through two points with two velocities, which goes straight on before and after them."""

    t0: float
    p0: np.ndarray
    v0: np.ndarray
    t1: float
    p1: np.ndarray
    v1: np.ndarray

    def position(self, times: np.ndarray) -> np.ndarray:
        """Where it is at times (n,) s: (n, 3) m; before and after the piece it goes straight on."""
        step = self.t1 - self.t0
        u = ((np.asarray(times) - self.t0) / step)[:, None]
        inside = np.minimum(np.maximum(u, 0.0), 1.0)
        points = cubic(inside, step, self.p0, self.v0, self.p1, self.v1)
        return points + np.minimum(u, 0.0) * step * self.v0 + np.maximum(u - 1.0, 0.0) * step * self.v1

    def velocity(self, times: np.ndarray) -> np.ndarray:
        """Its velocity at times (n,) s: (n, 3) m/s."""
        u = np.clip((np.asarray(times) - self.t0) / (self.t1 - self.t0), 0.0, 1.0)[:, None]
        once, twice = self._bends()
        return self.v0 + u * (once + u * twice)

    @property
    def longest(self) -> float:
        """A length, m, that the way is not longer than: that of the polygon of its control points (Bézier)."""
        third = (self.t1 - self.t0) / 3
        controls = self.p0, self.p0 + third * self.v0, self.p1 - third * self.v1, self.p1
        return float(np.linalg.norm(np.diff(controls, axis=0), axis=1).sum())

    def speed(self, times: np.ndarray) -> np.ndarray:
        """Its speed at times (n,) s: (n,) m/s."""
        u = np.clip((np.asarray(times) - self.t0) / (self.t1 - self.t0), 0.0, 1.0)
        once, twice = self._bends()
        v0 = self.v0
        powers = [v0 @ v0, 2 * v0 @ once, once @ once + 2 * v0 @ twice, 2 * once @ twice, twice @ twice]
        return np.sqrt(np.maximum(np.polyval(powers[::-1], u), 0.0))

    def _bends(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how the velocity changes with the share u of the time: it is v0 + u (once + u twice)."""
        step = self.t1 - self.t0
        once = 6 * (self.p1 - self.p0) / step - 4 * self.v0 - 2 * self.v1
        return once, 6 * (self.p0 - self.p1) / step + 3 * (self.v0 + self.v1)
