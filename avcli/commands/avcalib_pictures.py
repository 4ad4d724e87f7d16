"""What the actions of avcalib share: boards, sources of pictures, the search for boards, a camera in and out."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.calibration.settings import BoardSettings, PictureSettings
from avcli.commands.filter import GateNotMet, Session
from avcli.commands.options import from_settings, refuse_without_effect, settings_from

if TYPE_CHECKING:
    from avcli.calibration.camera import KnownCamera
    from avcli.calibration.gather import Seen
    from avcli.calibration.target import Board
    from avcli.formats.footage import Picture, Source

_FEW = 100
"""Up to this number of pictures each is searched thoroughly; a film has boards enough."""
POSITIVE = click.FloatRange(min=0, min_open=True)
BOARD_OPTIONS = from_settings(BoardSettings)
FLOOR_BOARD_OPTIONS = from_settings(BoardSettings, defaults={"board": "7x10"})
RATE_OPTION = from_settings(PictureSettings)


@contextlib.contextmanager
def usage_errors(session: Session) -> Iterator[None]:
    """Turn what a stage refuses in the block into a usage error: it was asked for on the command line."""
    try:
        yield
    except ValueError as error:
        session.usage(str(error))


def parse_board(session: Session, values: Mapping[str, Any]) -> Board:
    """Make the board that --board, --square and --charuco describe; usage error where there is no such board."""
    from avcli.calibration import target

    given = settings_from(BoardSettings, values)
    with usage_errors(session):
        return target.Board(*target.parse_size(given.board), given.square_mm / 1000, given.charuco)


# --- pictures ---------------------------------------------------------------------------------------------------------


def check_sources(session: Session, names: Sequence[str]) -> list[Source]:
    """Tell what the sources are; usage error where one does not exist, or where --rate would have no effect."""
    from avcli.formats import footage

    if not names:
        session.usage("name the pictures: files, folders, a video, a camera (/dev/video0), or - for JPEGs on stdin")
    try:
        sources = footage.sources(names)
    except FileNotFoundError as error:
        session.usage(f"{error.filename}: {error.strerror}")
    if all(source.kind in ("picture", "folder") for source in sources):
        refuse_without_effect(["rate_hz"], "with single pictures, which are all used")
    return sources


@contextlib.contextmanager
def _ending_on_interrupt(active: bool) -> Iterator[Callable[[], bool]]:
    """While the block lasts, the first Ctrl-C sets the answer to True and does not end the program."""
    stopped = False
    before = signal.getsignal(signal.SIGINT)

    def stop(_number: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True
        signal.signal(signal.SIGINT, before)

    if active:
        signal.signal(signal.SIGINT, stop)
    try:
        yield lambda: stopped
    finally:
        if active:
            signal.signal(signal.SIGINT, before)


class _Files:
    """Pictures of files, which can be read again from the start."""

    def __init__(self, read: Callable[[], Iterator[Picture]]):
        self._read = read

    def __iter__(self) -> Iterator[Picture]:
        return self._read()


def collect(
    session: Session,
    names: Sequence[str],
    board: Board,
    rate_hz: float | None,
    size: tuple[int, int] | None = None,
    after: Callable[..., bool] | None = None,
) -> Seen:
    """Look for the board in all pictures (see gather.collect); the first Ctrl-C ends a camera, a stream or `live`."""
    from avcli.calibration import gather
    from avcli.formats import footage

    sources = check_sources(session, names)
    if not any(source.kind == "camera" for source in sources):
        refuse_without_effect(["size"], "without a camera")
    live = any(source.is_live for source in sources)
    total = None if live else footage.count_pictures(list(names), rate_hz)
    stream = session.open("-") if "-" in names else None
    with _ending_on_interrupt(live or after is not None) as stopped, session.timing("look for boards"):

        def read() -> Iterator[Picture]:
            pictures = footage.pictures(list(names), rate_hz, stream=stream, size=size)
            for picture in session.progress(pictures, total, "looking for boards"):
                yield picture
                if stopped():
                    return

        return gather.collect(
            read() if live else _Files(read),
            board,
            thorough=total is not None and total <= _FEW,
            eager=live or after is not None,
            say=session.warn,
            after=after or (lambda *_: False),
        )


def views_for(session: Session, names: Sequence[str], board: Board, rate_hz: float | None, camera: KnownCamera) -> Seen:
    """Look for a board in pictures of a known camera; exit 3 where none shows one, 1 at another size."""
    from avcli.calibration import fit

    seen = collect(session, names, board, rate_hz)
    try:
        seen.require_views()
    except fit.NoFit as error:
        raise GateNotMet(str(error)) from None
    camera.require_size(seen.size)
    return seen


# --- a camera in and out ----------------------------------------------------------------------------------------------


def read_camera(session: Session, path: str | Path | None = None) -> KnownCamera:
    """Read the camera that a file describes; no path: that of -C or -c."""
    from avcli.calibration import camera

    if path is None:
        if not session.has_config:
            session.usage("-c FILE or -C DIR is needed: a config.json, or the output of avcalib calibrate")
        path = session.config_path
    with session.open(str(path)) as stream:
        return camera.parse_camera(stream.read(), str(path))


def write_camera(session: Session, found: Mapping[str, Any]) -> None:
    """Write keys of camera_config into config.json (-C, -c), and as one line to -o; without either to stdout."""
    if session.has_config:
        from avcli.calibration import camera

        camera.write_camera(session.config_path, found)
    if not session.has_config or session.output_path != "-":
        with session.output() as write:
            write(found)
