"""A USB camera: MJPG first, focus and exposure locked where the driver can, an unplugged one waited for."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from avcli.formats.media import MediaError, quiet_decoders

_WARM_UP = 20
"""Pictures after which the driver's automatic exposure has settled, and is locked."""
_RETRY_S = 1.0
_BY_ID = Path("/dev/v4l/by-id")
_MANUAL = 1
"""V4L2_EXPOSURE_MANUAL, which OpenCV passes on to the driver as it is."""


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def isOpened(self) -> bool: ...

    def grab(self) -> bool: ...

    def retrieve(self) -> tuple[bool, Any]: ...

    def get(self, key: int, /) -> float: ...

    def set(self, key: int, value: float, /) -> bool: ...

    def release(self) -> None: ...


def _open(number: int) -> Capture:
    quiet_decoders()
    import cv2

    return cv2.VideoCapture(number, cv2.CAP_V4L2)


@dataclass
class Camera:
    """A live camera whose newest pictures are wanted: older ones in the driver's buffer are dropped.

    Attributes:
        name: "/dev/video0", or its number.
        rate_hz: pictures per second to take; None: all.
        size: (width, height) px to ask for; None: as the driver has it.
        lock_exposure: also lock the exposure, once it has settled; what was changed is put back at the end.
        patience_s: how long to wait for a camera that went away; 0: its pictures end.
        say: gets sentences for the user: what was obtained, what could not be locked, what went away.
        open: opens a camera by its number.
        ended: set it to end the pictures, also while they are waited for.
        clock: Unix time, s.
    """

    name: str
    rate_hz: float | None = None
    size: tuple[int, int] | None = None
    lock_exposure: bool = False
    patience_s: float = 0.0
    say: Callable[[str], None] = lambda _: None
    open: Callable[[int], Capture] = _open
    ended: threading.Event = field(default_factory=threading.Event)
    clock: Callable[[], float] = time.time

    def __post_init__(self) -> None:
        self._path = _lasting(f"/dev/video{self.name.removeprefix('/dev/video')}")
        self._before: float | None = None

    def pictures(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield Unix time, s, and picture (height, width, 3) uint8 RGB.

        Raises:
            MediaError: it cannot be opened, or gives another size than `size`, or than before it went away.
        """
        capture = self._opened()
        if capture is None:
            raise MediaError(f"{self.name}: the camera cannot be opened (absent, busy, or no permission)")
        size, due, count = self.size, 0.0, 0
        try:
            while not self.ended.is_set():
                if not capture.grab():
                    capture.release()
                    again = self._came_back()
                    if again is None:
                        return
                    capture, count = again, 0
                    continue
                now = self.clock()
                if self.rate_hz and now < due:
                    continue
                good, image = capture.retrieve()
                if not good:
                    continue
                if size and image.shape[1::-1] != tuple(size):
                    found = f"{image.shape[1]} × {image.shape[0]} px"
                    raise MediaError(f"{self.name}: gives {found}, not {size[0]} × {size[1]}")
                size, count = image.shape[1::-1], count + 1
                if count == 1:
                    self._say_obtained(capture, size)
                if count == _WARM_UP and self.lock_exposure:
                    self._lock_exposure(capture)
                yield now, image[:, :, ::-1]
                due = now + 1 / self.rate_hz if self.rate_hz else 0.0
        finally:
            self._unlock(capture)
            capture.release()

    def _opened(self) -> Capture | None:
        """Open it with what is asked for; None where it cannot be opened."""
        import cv2

        try:
            capture = self.open(int(os.path.realpath(self._path).removeprefix("/dev/video")))
        except ValueError:  # the lasting name leads nowhere while the camera is away
            return None
        if not capture.isOpened():
            capture.release()
            return None
        # Compressed first: USB 2 has no room for 1080p at 30 Hz in another format, and a driver fits size and rate to
        # the format. Some forget it when they are given a size.
        mjpg = cv2.VideoWriter.fourcc(*"MJPG")
        capture.set(cv2.CAP_PROP_FOURCC, mjpg)
        if self.size:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.size[1])
            capture.set(cv2.CAP_PROP_FOURCC, mjpg)
        return capture

    def _say_obtained(self, capture: Capture, size: tuple[int, int]) -> None:
        """Lock the focus, and say what the driver gave."""
        import cv2

        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        letters = "".join(chr(code >> shift & 255) for shift in (0, 8, 16, 24)) if code > 0 else ""
        rate = capture.get(cv2.CAP_PROP_FPS)
        words = [f"{size[0]} × {size[1]} px"]
        words += [f"{rate:g} Hz"] if 0 < rate < 1000 else []
        words += [letters.strip()] if letters.strip().isalnum() else []
        # A lens that refocuses is another lens.
        locked = capture.set(cv2.CAP_PROP_AUTOFOCUS, 0) and capture.get(cv2.CAP_PROP_AUTOFOCUS) == 0
        words.append("focus locked" if locked else "no focus that the driver can lock; do not turn it by hand")
        self.say(f"{self.name}: {', '.join(words)}")
        if letters.strip().isalnum() and letters != "MJPG":
            self.say(f"{self.name}: the camera does not give MJPG; {letters} may be slow at this size")

    def _lock_exposure(self, capture: Capture) -> None:
        import cv2

        mode, value = capture.get(cv2.CAP_PROP_AUTO_EXPOSURE), capture.get(cv2.CAP_PROP_EXPOSURE)
        if mode == _MANUAL:
            return
        locked = capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL) and capture.set(cv2.CAP_PROP_EXPOSURE, value)
        if locked and capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) == _MANUAL:
            self._before = mode
            self.say(f"{self.name}: exposure locked at {value:g}")
        else:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, mode)
            self.say(f"{self.name}: the driver cannot lock the exposure; keep the light as it is")

    def _unlock(self, capture: Capture) -> None:
        """Give the exposure back to the driver, which would keep it locked for other programs."""
        import cv2

        if self._before is not None:
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, self._before)

    def _came_back(self) -> Capture | None:
        """Wait for a camera that went away; None where it does not come back in time."""
        if not self.patience_s:
            return None
        self.say(f"{self.name}: the camera went away; waiting {self.patience_s:g} s for it (is it plugged in?)")
        waited = 0.0
        while waited < self.patience_s and not self.ended.wait(_RETRY_S):
            waited += _RETRY_S
            capture = self._opened()
            if capture is not None:
                self.say(f"{self.name}: the camera is back")
                return capture
        if not self.ended.is_set():
            self.say(f"{self.name}: the camera did not come back")
        return None


def _lasting(path: str) -> Path:
    """Return a name of a camera that stays its own when it is plugged in again, where the system has one."""
    if _BY_ID.is_dir():
        for link in sorted(_BY_ID.iterdir()):
            if os.path.realpath(link) == os.path.realpath(path):
                return link
    return Path(path)
