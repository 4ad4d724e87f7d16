"""What a page shows of an experiment beside its records: the camera's pictures and the sound of a microphone."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from avcli.formats import footage, media
from avcli.formats.records import AudioChunk
from avcli.view import sound
from avcli.view.pictures import Read, Timed

if TYPE_CHECKING:
    import numpy as np

_PICTURE = re.compile(r"RGB_frame_(-?\d+\.\d+)\.\w+")
_SOUND = re.compile(r"multichannel_audio_(-?\d+\.\d+)\.\w+")
_AT_ONCE = 1 << 19  # samples


def frames(root: Path, named: Sequence[tuple[float, str]], *, lying: bool = True) -> list[Timed]:
    """Return the pictures that records name; where they name none, those that are `lying` in the directory."""
    found = [(time, root / path) for time, path in named]
    if lying and not found:
        found = _timed(root / "video/rgb", _PICTURE)
    return [(time, partial(media.read_rgb, path)) for time, path in sorted(found)]


def of_size(size: tuple[int, int], say: Callable[[str], None]) -> Callable[[Read], Read]:
    """Return what makes a picture's reader say, once for all, that it has another size than the lens is known for.

    Args:
        size: width and height, px.
        say: is called with a sentence.
    """
    said: list[bool] = []

    def seen(read: Read) -> np.ndarray:
        image = read()
        if image.shape[1::-1] != size and not said:
            said.append(True)
            has = f"{image.shape[1]} × {image.shape[0]} px"
            say(f"a picture has {has}, camera_config {size[0]} × {size[1]} px: what is drawn in it may be misplaced")
        return image

    return lambda read: partial(seen, read)


def film(
    path: str, rate_hz: float | None, start_s: float, say: Callable[[str], None] = lambda _: None
) -> tuple[Iterator[Timed], int]:
    """Return the pictures of a film whose first one was taken at `start_s`, and how many they are.

    `say` gets a sentence if a part of the film is damaged or missing.

    Raises:
        MediaError: it cannot be read.
    """
    count = footage.count_pictures([path], rate_hz) or 0
    shots = footage.pictures([path], rate_hz, say=say)
    return ((start_s + shot.timestamp, partial(_same, shot)) for shot in shots), count


def _same(shot: footage.Picture):  # type: ignore[no-untyped-def]
    return shot.image


class Recorded:
    """What all microphones heard, in files that are read in parts, so that an hour needs no memory.

    Args:
        files: (time in s of the first sample, path); gaps between them are silent, and where they overlap they add up.
        growing: whether somebody still writes the files.
        known: how files are made that were looked at before; those that are not in it are added.

    Attributes:
        start_s: time of the first sample, s.
        rate_hz: sample rate, Hz.
        channels: number of microphones.
        length: samples of each channel.

    Raises:
        MediaError: a file cannot be read, or has another rate or other channels than the first.
    """

    def __init__(
        self,
        files: Sequence[tuple[float, Path]],
        *,
        growing: bool = False,
        known: dict[Path, media.AudioForm] | None = None,
    ):
        files, known = sorted(files), {} if known is None else known
        self._files = files
        for _, path in files:
            if growing or path not in known:
                known[path] = media.audio_form(path, growing=growing)
        forms = [known[path] for _, path in files]
        self.start_s, self.rate_hz, self.channels = files[0][0], forms[0].rate_hz, forms[0].channels
        for (_, path), form in zip(files, forms, strict=True):
            if (form.rate_hz, form.channels) != (self.rate_hz, self.channels):
                here = f"{form.channels} channels at {form.rate_hz} Hz"
                raise media.MediaError(f"{path}: {here}; {files[0][1]} has {self.channels} at {self.rate_hz} Hz")
        self._lengths = [form.samples for form in forms]
        self.length = max(map(sum, zip(self._places(), self._lengths, strict=True)))

    def _places(self) -> list[int]:
        return [round((time - self.start_s) * self.rate_hz) for time, _ in self._files]

    def read(self, first: int, last: int) -> np.ndarray:
        """Return the samples (last - first, channels) float32 from one to before another; zeros where there are none.

        Raises:
            MediaError: they cannot be read.
        """
        import numpy as np

        samples = np.zeros((last - first, self.channels), np.float32)
        for (_, path), place, length in zip(self._files, self._places(), self._lengths, strict=True):
            begin, end = max(first, place), min(last, place + length)
            if begin < end:
                part = media.audio_part(path, begin - place, end - begin)
                samples[begin - first : begin - first + len(part)] += part
        return samples

    def channel(self, microphone: int) -> sound.Track:
        """Return what one microphone heard, counted from 1.

        Raises:
            MediaError: there is no such channel, or it cannot be read.
        """
        if microphone > self.channels:
            raise media.MediaError(f"{self._files[0][1]}: there is no channel {microphone}; it has {self.channels}")
        spool = sound.Spool(self.length)
        for first in range(0, self.length, _AT_ONCE):
            last = min(first + _AT_ONCE, self.length)
            spool.samples[first:last] = self.read(first, last)[:, microphone - 1]
        return sound.Track(f"microphone {microphone}", self.start_s, self.rate_hz, spool.samples)


def recorded(
    root: Path, chunks: Sequence[AudioChunk], known: dict[Path, media.AudioForm] | None = None
) -> Recorded | None:
    """Return the sound that records name or, where they name none, that lies in the experiment's directory, if any.

    Args:
        root: the experiment's directory.
        chunks: as the records name them.
        known: as of `Recorded`.

    Raises:
        MediaError: it cannot be read.
    """
    found = [(chunk.start_sample / chunk.sample_rate_hz, root / chunk.path) for chunk in chunks]
    found = found or _timed(root / "audio/wav", _SOUND)
    return Recorded(found, known=known) if found else None


def _timed(folder: Path, name: re.Pattern[str]) -> list[tuple[float, Path]]:
    if not folder.is_dir():
        return []
    matched = ((name.fullmatch(path.name), path) for path in folder.iterdir())
    return sorted((float(match[1]), path) for match, path in matched if match)
