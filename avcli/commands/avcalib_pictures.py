"""What the actions of avcalib share: boards, sources of pictures, the search for boards, a camera in and out."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avcli.calibration.settings import BoardSettings
from avcli.commands.filter import GateNotMet, Session
from avcli.commands.options import is_default, refuse_without_effect, settings_from, was_given

if TYPE_CHECKING:
    from avcli.calibration.camera import KnownCamera
    from avcli.calibration.gather import Seen
    from avcli.calibration.recognise import Wanted
    from avcli.formats.footage import Source

_FEW = 100
"""Up to this number of pictures each is searched thoroughly; a film has boards enough."""
_OF_A_FILM = 150
"""Pictures of a long film that are looked at first."""
_ENOUGH = 40
"""Views of the board in them with which the others are not looked at."""
_MORE = 1.5
"""Times as many views after which a film that is decoded whole is asked again whether it tells the lens already."""


@contextlib.contextmanager
def usage_errors(session: Session) -> Iterator[None]:
    """Turn what a stage refuses in the block into a usage error: it was asked for on the command line."""
    try:
        yield
    except ValueError as error:
        session.usage(str(error))


def parse_board(session: Session, values: Mapping[str, Any]) -> Wanted:
    """Read what the options say of the board; usage error where there is no such board."""
    from avcli.calibration import recognise, target

    given = settings_from(BoardSettings, values)
    kind: target.Kind | None = given.kind
    if given.legacy or (given.dictionary and kind is None):
        if kind not in (None, "charuco"):
            refuse_without_effect(["legacy"], f"with --kind {kind}")
        kind = "charuco"
    with usage_errors(session):
        wanted = recognise.Wanted(
            target.parse_size(given.board) if given.board else None,
            kind,
            target.name_of_dictionary(given.dictionary) if given.dictionary else "",
            given.ratio or 0.0,
            True if given.legacy else None,
            given.square_mm / 1000 if given.square_mm else None,
        )
        wanted.board()
    return wanted


def check_sources(session: Session, names: list[str]) -> list[Source]:
    """Return what the sources are; usage error where one does not exist, or where --rate would have no effect."""
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
def ending_on_interrupt(active: bool, end: Callable[[], None] = lambda: None) -> Iterator[list[int]]:
    """While the block lasts, the first Ctrl-C does not end the program but fills the list and calls `end`."""
    caught: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def stop(number: int, _frame: object) -> None:
        caught.append(number)
        signal.signal(signal.SIGINT, before)
        end()

    if active:
        signal.signal(signal.SIGINT, stop)
    try:
        yield caught
    finally:
        signal.signal(signal.SIGINT, before)


def collect(
    session: Session,
    names: list[str],
    values: Mapping[str, Any],
    camera_size: tuple[int, int] | None = None,
    is_enough: Callable[[Seen], bool] | None = None,
) -> Seen:
    """Look for the board in all pictures (gather.collect); the first Ctrl-C ends a camera or a stream.

    A film that must be decoded whole is read until `is_enough`, if that is given.
    """
    from avcli.calibration import gather
    from avcli.formats import footage

    board, sources, rate_hz = parse_board(session, values), check_sources(session, names), values["rate_hz"]
    if not any(source.kind == "camera" for source in sources):
        refuse_without_effect(["size"], "without a camera")
    live = any(source.is_live for source in sources)
    every = None if live else footage.count_pictures(names, rate_hz)
    stream = session.open("-") if "-" in names else None

    def look(most: int | None, after: Callable[[Seen], bool] = lambda _: False) -> Seen:
        total = None if live else footage.count_pictures(names, rate_hz, most)
        pictures = footage.pictures(
            names,
            rate_hz,
            stream=stream,
            stream_rate_hz=rate_hz if was_given("rate_hz") else None,
            size=values.get("size"),
            skip=lambda words: session.warn(f"left out: {words}"),
            say=session.warn,
            grey=True,
            most=most,
        )
        with ending_on_interrupt(live) as caught, session.timing("look for boards"):
            return gather.collect(
                session.progress(pictures, total, "looking for boards"),
                board,
                thorough=total is not None and total <= _FEW,
                eager=live,
                size=camera_size,
                say=session.warn,
                after=lambda so_far, *_: bool(caught) or after(so_far),
            )

    some = footage.count_pictures(names, rate_hz, _OF_A_FILM) if every and is_default("rate_hz") else every
    if some == every:
        return look(None)
    ended = _Ending(is_enough if is_enough and footage.is_decoded_whole(names, rate_hz, _OF_A_FILM) else None)
    seen = look(_OF_A_FILM, ended)
    if ended.at:
        session.warn(
            f"the film has few key frames, so that it must be decoded from its start: it was read until {ended.at} "
            f"views told the lens, {len(seen)} pictures of about {some}; --rate {rate_hz:g} takes {every}"
        )
        return seen
    shown = len(seen) - seen.count("no board")
    if shown < _ENOUGH:
        session.warn(f"{shown} of {len(seen)} pictures of the film show a board; now {every} pictures are looked at")
        return look(None)
    session.warn(f"{len(seen)} pictures of the film were looked at, which is enough; --rate {rate_hz:g} takes {every}")
    return seen


class _Ending:
    """Asks after 40, 60, 90 ... views whether they are enough; `at` is how many were, 0 before that."""

    def __init__(self, is_enough: Callable[[Seen], bool] | None) -> None:
        self.at, self._next, self._is_enough = 0, _ENOUGH, is_enough

    def __call__(self, seen: Seen) -> bool:
        if self._is_enough and len(seen.views) >= self._next:
            self._next = round(_MORE * self._next)
            self.at = len(seen.views) if self._is_enough(seen) else 0
        return self.at > 0


def views_for(session: Session, names: list[str], values: Mapping[str, Any], camera: KnownCamera) -> Seen:
    """Look for a board in pictures of a known camera; exit 3 where none shows one, 1 at another size."""
    from avcli.calibration import fit

    seen = collect(session, names, values, camera_size=camera.size)
    try:
        seen.require_views()
    except fit.NoFit as error:
        raise GateNotMet(str(error)) from None
    camera.require_size(seen.size)
    return seen


def read_camera(session: Session, path: str | Path | None = None) -> KnownCamera:
    """Read the camera that a file or an experiment's directory describes; no path: that of -C or -c."""
    from avcli.calibration import camera

    if path is None and not session.has_config:
        session.usage("-c FILE or -C DIR is needed: a config.json, or the output of avcalib calibrate")
    name = str(config_file(path or session.config_path))
    with session.open(name) as stream:
        return camera.parse_camera(stream.read(), name)


def config_file(path: str | Path) -> Path:
    """The config.json that a path is, or that is in the directory that it is."""
    return Path(path) / "config.json" if Path(path).is_dir() else Path(path)


def write_camera(session: Session, found: Mapping[str, Any]) -> None:
    """Write keys of camera_config into config.json (-C, -c), and as one line to -o; without either to stdout."""
    from avcli.calibration import camera

    if session.has_config:
        camera.write_camera(session.config_path, found)
    if not session.has_config or session.output_path != "-":
        with session.output() as write:
            write(found)
