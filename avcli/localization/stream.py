"""Sound as it arrives: pieces of a recording on one clock, and the windows that are cut from it."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from avcli.formats.bounds import LONGEST_GAP_S
from avcli.formats.experiment import Microphones
from avcli.localization import correlation


@dataclass(frozen=True)
class Block:
    """The next samples of a stream.

    Attributes:
        samples: (n, m).
        tail: s, how much of the stream up to this block's end comes after the scene's end, or may do so. No decision is
            made about it.
        waiting: s of sound that had arrived after this block when it was taken. Where that is a time step or more, the
            localizer is behind a live stream, and skips time steps until it has caught up.
        begin: its first sample's place on the clock, in samples, where the stream starts anew there; None: it goes on.
    """

    samples: np.ndarray
    tail: float = 0.0
    waiting: float = 0.0
    begin: int | None = None


def stretches(blocks: Iterable[Block], begin: int) -> Iterator[tuple[int, Iterator[Block]]]:
    """Split a stream where it starts anew: yield each stretch's first place on the clock, and its blocks.

    The blocks of a stretch must be taken before the next stretch.

    Args:
        blocks: of the stream.
        begin: the first sample's place on the clock, in samples, where its block does not say it.
    """
    rest = iter(blocks)
    following = next(rest, None)

    def stretch(first: Block) -> Iterator[Block]:
        nonlocal following
        yield first
        for following in rest:
            if following.begin is not None:
                return
            yield following
        following = None

    while following is not None:
        first = following
        yield begin if first.begin is None else first.begin, stretch(first)


class Recording:
    """One recording of an array, from sound files or from pieces of known place, on the scene's clock.

    Args:
        microphones: that recorded it.
        reverberation_s: how long sound may outlast the scene, where pieces do not say how long; s.
        start_s: time of the first sample, where pieces do not say it.
        warn: takes a sentence about what is missing or repeated, and its kind.

    Attributes:
        begin: the first sample's place on the clock, in samples; None before the first block.
    """

    def __init__(
        self,
        microphones: Microphones,
        *,
        reverberation_s: float = 0.0,
        start_s: float = 0.0,
        warn: Callable[[str, str], None] = lambda text, kind: None,
    ):
        self.microphones, self.reverberation_s, self.warn = microphones, reverberation_s, warn
        self.start_s = start_s
        self.begin: int | None = None
        self.next = 0
        self.scene_end: int | None = None
        self.held_back = 0.0
        self._anew: int | None = None  # the place where the next block starts anew
        self._piece = -math.inf  # the place of the latest piece

    def sound(self, name: str, blocks: Iterable[tuple[np.ndarray, int]]) -> Iterator[Block]:
        """Yield the blocks of a sound that goes on where the one before ended.

        Args:
            name: of its source, for messages.
            blocks: samples (n, m), each with the sample rate in Hz.

        Raises:
            ValueError: its channels or its sample rate are not those of the microphones.
        """
        if self.begin is None:
            self.begin = self.next = round(self.start_s * self.microphones.sample_rate_hz)
        for samples, rate in blocks:
            self._check(name, samples.shape[1], rate)
            yield self._block(samples)

    def piece(
        self,
        name: str,
        blocks: Iterable[tuple[np.ndarray, int]],
        *,
        start_sample: int,
        num_samples: int,
        tail_samples: int | None,
    ) -> Iterator[Block]:
        """Yield the blocks of a piece at its place: silence where samples are missing before it, and no sample twice.

        Where more than LONGEST_GAP_S is missing, or it begins so much before the piece before it, as after a clock was
        set back, the recording starts anew with the piece.

        Args:
            name, blocks: as for `sound`.
            start_sample: the place of its first sample on the clock.
            num_samples: how many samples of it count.
            tail_samples: how many of them come after the scene's end; None where that is not known.

        Raises:
            ValueError: as for `sound`, or it has fewer samples.
        """
        rate = self.microphones.sample_rate_hz
        if self.begin is not None and start_sample - self.next > LONGEST_GAP_S * rate:
            gap = (start_sample - self.next) / rate
            self.warn(f"{name}: {gap:.0f} s before it are missing; the recording starts anew there", "long gaps")
            self._start_anew(start_sample)
        elif self._piece - start_sample > LONGEST_GAP_S * rate:
            times = f"from {self._piece / rate:.4f} to {start_sample / rate:.4f} s"
            self.warn(f"{name}: time goes back {times}; the recording starts anew there", "set back")
            self._start_anew(start_sample)
        self._piece = start_sample
        if tail_samples is None:
            self.held_back = self.reverberation_s
        elif tail_samples and self.scene_end is None:
            self.scene_end = start_sample + num_samples - tail_samples
        if self.begin is None:
            self.begin = self.next = start_sample
        if start_sample > self.next:
            self.warn(
                f"{name}: {start_sample - self.next} samples before it are missing; they count as silence", "gaps"
            )
        while self.next < start_sample:
            yield self._block(np.zeros((min(1 << 16, start_sample - self.next), len(self.microphones.positions))))
        skip, left = self.next - start_sample, num_samples
        if skip:
            self.warn(f"{name}: {min(skip, left)} of its samples are repeated; they are dropped", "repeated")
        for samples, rate in blocks:
            self._check(name, samples.shape[1], rate)
            samples = samples[:left]
            left -= len(samples)
            new = samples[skip:]
            skip -= len(samples) - len(new)
            if len(new):
                yield self._block(new)
        if left:
            raise ValueError(f"{name}: {left} samples fewer than its record states")

    def _start_anew(self, place: int) -> None:
        self.next, self._anew, self.scene_end = place, place, None

    def _block(self, samples: np.ndarray) -> Block:
        self.next += len(samples)
        begin, self._anew = self._anew, None
        if self.scene_end is None:
            return Block(samples, self.held_back, begin=begin)
        return Block(samples, max(0, self.next - self.scene_end) / self.microphones.sample_rate_hz, begin=begin)

    def _check(self, name: str, channels: int, rate: int) -> None:
        count = len(self.microphones.positions)
        if channels != count:
            raise ValueError(f"{name}: {channels} channels, but config.json has {count} microphones")
        if rate != self.microphones.sample_rate_hz:
            raise ValueError(
                f"{name}: sampled at {rate} Hz, but config.json says {self.microphones.sample_rate_hz} Hz"
                " (microphone_config.audio_sample_rate_hz)"
            )


class LatestSamples:
    """The last samples of a stream; outside of what was received there is silence.

    Args:
        begin: the first sample's place on the clock.
        channels: how many there are.
    """

    def __init__(self, begin: int, channels: int):
        self.origin = self.end = begin
        self.blocks = [np.zeros((channels, 0))]

    def append(self, samples: np.ndarray) -> None:
        """Take the next samples (n, channels)."""
        self.blocks.append(np.ascontiguousarray(samples.T, dtype=np.float64))
        self.end += len(samples)

    @property
    def samples(self) -> np.ndarray:
        """What is kept of the stream, (channels, n)."""
        if len(self.blocks) > 1:
            self.blocks = [np.concatenate(self.blocks, axis=1)]
        return self.blocks[0]

    def window(self, begin: int, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return samples (channels, size) and a taper (size,) over those that were received.

        At the ends of a stream the taper is narrower: a step there, at once in all channels, would be a source.
        """
        received = self.samples
        first, last = max(begin, self.origin), min(begin + size, self.end)
        if last - first == size:
            return received[:, first - self.origin : last - self.origin], correlation.hann(size)
        samples, taper = np.zeros((len(received), size)), np.zeros(size)
        if last - first > size // 8:
            samples[:, first - begin : last - begin] = received[:, first - self.origin : last - self.origin]
            taper[first - begin : last - begin] = correlation.hann(last - first)
        return samples, taper

    def forget(self, before: int) -> None:
        """Drop the samples before a place on the clock."""
        excess = min(before, self.end) - self.origin
        if excess > 0:
            self.blocks = [self.samples[:, excess:]]
            self.origin += excess
