"""What avcalib live films: the newest picture of a camera, of a stream, or of a film at its own pace."""

from __future__ import annotations

import contextlib
import io
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from avcli.commands.avcalib_pictures import ending_on_interrupt
from avcli.commands.filter import Session
from avcli.commands.options import refuse_without_effect

if TYPE_CHECKING:
    from avcli.calibration.gather import Seen
    from avcli.calibration.live import Guide
    from avcli.calibration.recognise import Wanted
    from avcli.formats.footage import Picture, Source

_PATIENCE_S = 60.0
"""How long an unplugged camera is waited for."""


def film(session: Session, source: Source, board: Wanted, values: Mapping[str, Any], guide: Guide) -> Seen:
    """Look for the board in what is filmed until the guide knows enough, the source ends, or Ctrl-C."""
    from avcli.calibration import gather

    if source.kind != "camera":
        refuse_without_effect(["size"], "without a camera")
    with contextlib.ExitStack() as stack, session.timing("film"):
        pictures, stop = _pictures(session, stack, source, values)
        caught = stack.enter_context(ending_on_interrupt(True, stop))
        return gather.collect(
            pictures,
            board,
            thorough=False,
            eager=True,
            say=session.warn,
            reason=guide.reason,
            after=lambda *news: guide.after(*news) or bool(caught),
        )


def _pictures(
    session: Session, stack: contextlib.ExitStack, source: Source, values: Mapping[str, Any]
) -> tuple[Iterator[Picture], Callable[[], None]]:
    """Return the pictures of a source as they come, and what ends them."""
    from avcli.formats import footage
    from avcli.formats.camera import Camera
    from avcli.formats.live import LiveSource, Stoppable

    rate_hz: float | None = values["rate_hz"]
    ended = threading.Event()
    stop: Callable[[], None] = ended.set
    if source.kind == "camera":
        camera = Camera(source.name, rate_hz, values["size"], True, _PATIENCE_S, session.warn, ended=ended)
        arriving = footage.camera_pictures(camera)
    elif source.kind == "stream":
        pipe = Stoppable(session.open("-"))
        stop = pipe.stop
        arriving = _as_they_arrive(footage.pictures(["-"], stream=io.BufferedReader(pipe)), rate_hz)
    elif source.kind in ("video", "file"):
        arriving = _paced(footage.pictures([source.name], rate_hz), ended)
    else:  # single pictures have no pace
        return footage.pictures([source.name]), stop
    return iter(stack.enter_context(LiveSource(arriving, newest=True, stop=stop))), stop


def _as_they_arrive(pictures: Iterator[Picture], rate_hz: float | None) -> Iterator[Picture]:
    """Yield pictures with the time at which they arrived, at most so many a second."""
    due = 0.0
    for picture in pictures:
        now = time.monotonic()
        if now >= due:
            due = now + 1 / rate_hz if rate_hz else 0.0
            yield replace(picture, timestamp=now)


def _paced(pictures: Iterator[Picture], ended: threading.Event) -> Iterator[Picture]:
    """Yield the pictures of a film when they are due, as a camera would."""
    begun = None
    for picture in pictures:
        begun = time.monotonic() - picture.timestamp if begun is None else begun
        if ended.wait(max(0.0, begun + picture.timestamp - time.monotonic())):
            return
        yield picture
