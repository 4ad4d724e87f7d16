"""Names of files in the order in which people number them: frame2 before frame10."""

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path


def by_number(path: str | os.PathLike[str]) -> list[tuple[int, str]]:
    """Return what the names of paths are sorted by: their letters and numbers, and so a_2.0 before a_10.0."""
    parts = re.split(r"(\d+)", Path(path).name)
    return [(int(part), part) if part.isdecimal() and part.isascii() else (-1, part) for part in parts]


def missing(paths: Sequence[str | os.PathLike[str]]) -> tuple[int, str | os.PathLike[str]] | None:
    """Count the files that are missing by the last numbers in the names, and name the one before the first gap.

    None where there is no gap, or where more than a tenth are missing: then the numbers count something else.

    >>> missing(["f1.png", "f2.png", *(f"f{k}.png" for k in range(5, 40))])
    (2, 'f2.png')
    """
    found = [re.findall(r"\d+", Path(path).stem) for path in paths]
    numbers = [int(one[-1]) for one in found if one]
    steps = [after - before for before, after in itertools.pairwise(numbers)]
    usual = max(set(steps), key=steps.count, default=0)
    if len(numbers) < len(paths) or usual <= 0 or any(step % usual or step <= 0 for step in steps):
        return None
    left_out = sum(step // usual - 1 for step in steps)
    gap = next((k for k, step in enumerate(steps) if step > usual), 0)
    return (left_out, paths[gap]) if 0 < left_out <= len(paths) / 10 else None


def as_numbered(paths: Sequence[str]) -> list[str]:
    """Put paths that stand in the order of their letters, as a shell's * names them, in that of their numbers.

    >>> as_numbered(["a1.wav", "a10.wav", "a2.wav"]), as_numbered(["a2.wav", "a10.wav", "a1.wav"])
    (['a1.wav', 'a2.wav', 'a10.wav'], ['a2.wav', 'a10.wav', 'a1.wav'])
    """
    if list(paths) != sorted(paths):
        return list(paths)
    folders = {folder: number for number, folder in enumerate(dict.fromkeys(map(os.path.dirname, paths)))}
    return sorted(paths, key=lambda path: (folders[os.path.dirname(path)], by_number(path)))
