"""Names of files in the order in which people number them: frame2 before frame10."""

import os
import re
from collections.abc import Sequence
from pathlib import Path


def by_number(path: str | os.PathLike[str]) -> list[tuple[int, str]]:
    """Return what the names of paths are sorted by: their letters and numbers, and so a_2.0 before a_10.0."""
    parts = re.split(r"(\d+)", Path(path).name)
    return [(int(part), part) if part.isdecimal() and part.isascii() else (-1, part) for part in parts]


def as_numbered(paths: Sequence[str]) -> list[str]:
    """Put paths that stand in the order of their letters, as a shell's * names them, in that of their numbers.

    >>> as_numbered(["a1.wav", "a10.wav", "a2.wav"]), as_numbered(["a2.wav", "a10.wav", "a1.wav"])
    (['a1.wav', 'a2.wav', 'a10.wav'], ['a2.wav', 'a10.wav', 'a1.wav'])
    """
    if list(paths) != sorted(paths):
        return list(paths)
    folders = {folder: number for number, folder in enumerate(dict.fromkeys(map(os.path.dirname, paths)))}
    return sorted(paths, key=lambda path: (folders[os.path.dirname(path)], by_number(path)))
