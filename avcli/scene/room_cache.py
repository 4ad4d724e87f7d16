"""The colours of empty rooms that were drawn before, kept in the user's cache: drawing them is most of a short run.

Each is a PNG that appears whole or not at all. Its name is a checksum of all that its pixels depend on, and the time
that drawing took. When the folder is full, the rooms that were used longest ago go first. What cannot be read is drawn,
and what cannot be written is not kept: a fault of the cache ends no run.
"""

import contextlib
import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np

import avcli
from avcli.formats import media
from avcli.scene.furniture import Solids

MOST_BYTES = 1 << 28


def folder() -> Path:
    """Where the rooms are, by the XDG Base Directory Specification 0.8."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if os.path.isabs(home) else Path.home() / ".cache") / "avcli" / "rooms"


class RoomCache:
    """The picture of one room in a folder of many.

    Args:
        rooms: the folder; it need not exist.
        scene: what the room and its camera are, as values whose `repr` is exact.
        solids: the furniture.
        most_bytes: of all files in the folder.

    Attributes:
        saved_s: s that drawing the room took when it was kept; 0 until it was found.
    """

    def __init__(self, rooms: Path, scene: Any, solids: Solids, most_bytes: int = MOST_BYTES) -> None:
        self.rooms, self.most_bytes, self.saved_s = rooms, most_bytes, 0.0
        self._sum = hashlib.sha256(repr(scene).encode())
        for array in vars(solids).values():
            values = np.asarray(array)
            self._sum.update(f"{values.dtype}{values.shape}".encode())
            self._sum.update(values.tobytes())

    def load(self, drawn_by: str, size: tuple[int, int]) -> np.ndarray | None:
        """The colours (height, width, 3) uint8 of the room as this OpenGL draws them; None where they are not kept."""
        with contextlib.suppress(OSError, ValueError):
            for path in self.rooms.glob(f"{self._key(drawn_by)}.*.png"):
                picture = media.read_rgb(path)
                if picture.shape == (size[1], size[0], 3):
                    self.saved_s = int(path.name.split(".")[1]) / 1e3
                    os.utime(path)
                    return picture
        return None

    def store(self, drawn_by: str, picture: np.ndarray, seconds: float) -> None:
        """Keep the colours (height, width, 3) uint8 of the room, which took so many seconds to draw."""
        with contextlib.suppress(OSError):
            self.rooms.mkdir(parents=True, exist_ok=True)
            media.write_png(self.rooms / f"{self._key(drawn_by)}.{round(1e3 * seconds)}.png", picture)
            self._bound()

    def _key(self, drawn_by: str) -> str:
        whole = self._sum.copy()
        whole.update(f"{drawn_by}\0{avcli.__version__}".encode())
        package = Path(avcli.__file__).parent
        for path in sorted(path for name in _PAINTERS for path in (package / name).glob("*.*")):
            whole.update(path.read_bytes())  # any of them may change a pixel
        return whole.hexdigest()[:40]

    def _bound(self) -> None:
        """Remove the rooms that were used longest ago, until the others fit."""
        used = sorted(((entry.stat().st_mtime_ns, entry) for entry in self.rooms.glob("*.png")), reverse=True)
        total = 0
        for _, path in used:
            total += path.stat().st_size
            if total > self.most_bytes:
                path.unlink(missing_ok=True)


_PAINTERS = ("scene", "lens", "materials")
"""Folders of the code that draws a room."""
