"""Sound as a recorder sends it: raw samples, channels in the recorder's order, time that goes on whatever is lost."""

import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from avcli.formats import media
from avcli.formats.bounds import MOST_CHANNELS

KINDS = {"s16le": (1, 16), "s24le": (1, 24), "s32le": (1, 32), "f32le": (3, 32)}
"""Raw samples by their names at FFmpeg, little endian: their format and their bits as WAV writes them."""
LATE_S, STEADY_S, MEMORY_S = 0.25, 1.0, 30.0
"""How much later than usual sound must arrive, and for how long, before samples are missing; and what is usual, s."""


@dataclass(frozen=True)
class Raw:
    """The layout of raw samples, interleaved.

    Attributes:
        kind: one of KINDS.
        rate: Hz.
        channels: how many.
    """

    kind: str
    rate: int
    channels: int

    @classmethod
    def parse(cls, text: str) -> "Raw":
        """Read "s16le,48000,8".

        Raises:
            ValueError: it is not a known kind with a rate and a number of channels.
        """
        match = re.fullmatch(r"(\w+),(\d{1,7}),(\d{1,4})", text)
        known = match and match[1] in KINDS and int(match[2]) >= 1000 and 1 <= int(match[3]) <= MOST_CHANNELS
        if not match or not known:
            raise ValueError(f"expected KIND,HZ,CHANNELS such as s16le,48000,8 with one of {', '.join(KINDS)}")
        return cls(match[1], int(match[2]), int(match[3]))


def raw_blocks(stream: BinaryIO, raw: Raw, name: str, block_size: int = 1 << 10) -> Iterator[tuple[np.ndarray, int]]:
    """Yield raw samples as they come, (≤ block_size, channels) float64 with full scale at 1, each with the rate in Hz.

    Raises:
        MediaError: there is nothing, or it ends within a sample.
    """
    decode, width = media.decoder(*KINDS[raw.kind])
    frame, found = width * raw.channels, False
    while content := media.as_much_as(stream, block_size * frame):
        if len(content) % frame:
            raise media.MediaError(
                f"{name}: ends within a sample of {raw.channels} channels; is it {raw.kind} with {raw.channels}?"
            )
        found = True
        yield decode(content).reshape(-1, raw.channels), raw.rate
    if not found:
        raise media.MediaError(f"{name}: there is no sound in it")


def channels_of(text: str) -> tuple[int, ...]:
    """Read "3-10" or "1-4,8,6": channels from 1, in the order of the microphones; from 0 in the result.

    Raises:
        ValueError: it is no list of channels, or names one twice.
    """
    found = list[int]()
    for part in text.split(","):
        match = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part.strip())
        if not match or not 1 <= int(match[1]) <= (last := int(match[2] or match[1])) <= MOST_CHANNELS:
            raise ValueError(f"expected channels from 1 such as 3-10 or 1-4,8,6, found {text!r}")
        found += range(int(match[1]) - 1, last)
    if len(set(found)) < len(found):
        raise ValueError(f"a channel stands twice in {text!r}")
    return tuple(found)


def chosen(
    blocks: Iterable[tuple[np.ndarray, int]],
    name: str,
    channels: tuple[int, ...] | None,
    gains_db: tuple[float, ...] | None,
) -> Iterator[tuple[np.ndarray, int]]:
    """Yield some channels of sound (n, channels), in the order that is asked for, each with its gain in dB.

    Raises:
        MediaError: there are too few channels, or not one gain for each that is chosen.
    """
    for samples, rate in blocks:
        if channels is not None:
            if max(channels) >= samples.shape[1]:
                raise media.MediaError(
                    f"{name}: channel {max(channels) + 1} is asked for, but the sound has {samples.shape[1]}"
                )
            samples = samples[:, list(channels)]
        if gains_db is not None:
            if len(gains_db) != samples.shape[1]:
                raise media.MediaError(f"{name}: {len(gains_db)} gains for {samples.shape[1]} channels")
            samples = samples * 10.0 ** (np.array(gains_db) / 20.0)
        yield samples, rate


class Arrivals:
    """Notices by the clock on the wall that samples of a live stream are missing.

    Sound that is only late comes in the end; where it arrives later than usual for STEADY_S, some is lost.

    Args:
        clock: gives s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self.clock = clock
        self.heard = 0.0
        self.late: deque[tuple[float, float]] = deque()

    def missing(self, seconds: float) -> float:
        """Take the next s of sound, which arrive now; return how many s are missing before them, mostly 0."""
        now = self.clock()
        self.heard += seconds
        self.late.append((now, now - self.heard))
        while self.late[0][0] < now - MEMORY_S:
            self.late.popleft()
        recent = [late for at, late in self.late if at >= now - STEADY_S]
        earlier = [late for at, late in self.late if at < now - STEADY_S]
        if not earlier or min(recent) - min(earlier) < LATE_S:
            return 0.0
        lost = min(recent) - min(earlier)
        self.heard += lost
        self.late = deque((at, late if at < now - STEADY_S else late - lost) for at, late in self.late)
        return lost
