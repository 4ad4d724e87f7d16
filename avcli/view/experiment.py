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


def film(path: str, rate_hz: float | None, start_s: float) -> tuple[Iterator[Timed], int]:
    """Return the pictures of a film whose first one was taken at `start_s`, and how many they are.

    Raises:
        MediaError: it cannot be read.
    """
    count = footage.count_pictures([path], rate_hz) or 0
    shots = footage.pictures([path], rate_hz)
    return ((start_s + shot.timestamp, partial(_same, shot)) for shot in shots), count


def _same(shot: footage.Picture):  # type: ignore[no-untyped-def]
    return shot.image


def channel(root: Path, chunks: Sequence[AudioChunk], microphone: int) -> sound.Track | None:
    """Return what one microphone heard, by the records or, where they name no sound, from the experiment's directory.

    Args:
        root: the experiment's directory.
        chunks: as the records name them.
        microphone: its number, from 1.

    Returns:
        The sound, None where there is none.

    Raises:
        MediaError: it cannot be read, or has fewer channels.
    """
    found = [(chunk.start_sample / chunk.sample_rate_hz, root / chunk.path) for chunk in chunks]
    found = found or _timed(root / "audio/wav", _SOUND)
    return _joined(sorted(found), microphone) if found else None


def recording(path: str, microphone: int, start_s: float) -> sound.Track:
    """Return one channel of a sound file whose first sample was taken at `start_s`; raises as `channel` does."""
    return _joined([(start_s, Path(path))], microphone)


def _joined(files: Sequence[tuple[float, Path]], microphone: int) -> sound.Track:
    import numpy as np

    pieces, rate = [], 0
    for time, path in files:
        parts = []
        for block, rate in media.audio_blocks(path):  # noqa: B007 - the rate is the same in each
            if block.shape[1] < microphone:
                raise media.MediaError(f"{path}: there is no channel {microphone}; it has {block.shape[1]}")
            parts.append(block[:, microphone - 1].astype(np.float32))
        pieces.append((time, np.concatenate(parts)))
    return sound.joined(pieces, rate, f"microphone {microphone}")


def _timed(folder: Path, name: re.Pattern[str]) -> list[tuple[float, Path]]:
    if not folder.is_dir():
        return []
    matched = ((name.fullmatch(path.name), path) for path in folder.iterdir())
    return sorted((float(match[1]), path) for match, path in matched if match)
