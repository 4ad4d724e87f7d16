"""What avcalib's actions share: options for boards and pictures, the search for boards, a camera in and out."""

import os
import signal

import click

from avcli.commands.filter import GateNotMet

_FEW = 100
"""Up to so many pictures each is searched thoroughly; a film has boards enough."""
POSITIVE = click.FloatRange(min=0, min_open=True)

# --- options ----------------------------------------------------------------------------------------------------------


def board_options(board="6x8", square=95.0):
    """Add --board, --square and --charuco to a command, which gets the three as `board_text`, `square`, `charuco`."""
    options = [
        click.option(
            "--board",
            "board_text",
            metavar="COLSxROWS",
            default=board,
            show_default=True,
            help="Squares of the board as printed, along a row and along a column; one odd and one even count make up "
            "and down distinct.",
        ),
        click.option(
            "--square",
            type=POSITIVE,
            default=square,
            show_default=True,
            metavar="MM",
            help="Side of a square in mm; the lens does not depend on it, poses do.",
        ),
        click.option(
            "--charuco", is_flag=True, help="The board has a marker in each white square, so that a part is enough."
        ),
    ]
    return lambda function: with_options(function, options)


def with_options(function, options):
    """Add options to a command, the first of them on top of its help."""
    for option in reversed(options):
        function = option(function)
    return function


def rate_option(default: float | None = 2.0):
    """Add --rate to a command; None takes all pictures."""
    shown = {"show_default": True} if default else {}
    return click.option(
        "--rate",
        type=POSITIVE,
        default=default,
        metavar="HZ",
        help="Pictures a second to take from a video or a camera; picture files are all taken."
        + ("" if default else "  [default: all]"),
        **shown,
    )


class Size(click.ParamType):
    """A width and a height in px, such as 1920x1080."""

    name = "WxH"

    def convert(self, value, param, ctx):
        parts = value.lower().split("x")
        if len(parts) != 2 or not all(part.isdigit() and int(part) for part in parts):
            self.fail(f"{value!r} is no size like 1920x1080", param, ctx)
        return int(parts[0]), int(parts[1])


def parse_board(session, text: str, square: float, charuco: bool):
    """Make the board that --board, --square (mm) and --charuco state; usage error where there is no such board."""
    from avcli.calibration import target

    try:
        return target.Board(*target.parse_size(text), square / 1000, charuco)
    except ValueError as error:
        session.usage(str(error))


def check_sources(session, sources) -> list[str]:
    """Check that all sources exist; usage error where one does not."""
    from avcli.formats import footage

    if not sources:
        session.usage("nothing to read: name pictures, a video, a camera (/dev/video0), or - for JPEGs on stdin")
    for source in sources:
        if source == "-" or "%" in source:
            continue
        if footage.is_camera(source):
            source = f"/dev/video{source.removeprefix('/dev/video')}"
        if not os.path.exists(source):
            session.usage(f"{source}: no such file or directory")
    return list(sources)


# --- the search for boards --------------------------------------------------------------------------------------------


class _Filming:
    """While it lasts, the first Ctrl-C ends the filming and not the program, so that what was collected is kept."""

    def __init__(self, active: bool):
        self.active, self.stopped = active, False

    def __enter__(self):
        if self.active:
            self.before = signal.signal(signal.SIGINT, self._stop)
        return self

    def _stop(self, _number, _frame):
        self.stopped = True
        signal.signal(signal.SIGINT, self.before)

    def __exit__(self, *_):
        if self.active:
            signal.signal(signal.SIGINT, self.before)

    def until_stopped(self, pictures):
        for picture in pictures:
            yield picture
            if self.stopped:
                return


def collect(session, sources, board, rate, size=None, after=None):
    """Look for the board in all pictures; a board of another size than the given one is recognised, said and taken.

    `after(seen, grey, view)` is called after each picture and ends the filming by returning True.
    """
    from avcli.calibration import corners, gather
    from avcli.formats import footage
    from avcli.formats.media import MediaError

    endless = any(source == "-" or footage.is_camera(source) for source in sources)
    total = None if endless else footage.count_pictures(sources, rate)
    thorough = total is not None and total <= _FEW
    guessed, before = board.markers, None
    while True:
        seen = gather.Seen(board)
        restart = False
        with _Filming(endless or after is not None) as filming:
            stream = session.open("-") if "-" in sources else None
            pictures = footage.pictures(sources, rate, stream=stream, size=size)
            pictures = filming.until_stopped(session.progress(pictures, total, "looking for boards"))
            looked = gather.look_ahead(pictures, lambda: board, thorough, eager=filming.active)  # noqa: B023
            try:
                for picture, grey, view in looked:
                    seen.take(picture.name, picture.timestamp, grey, view)
                    if not guessed and len(seen) in (4, 12) and seen.few:
                        guessed = len(seen) == 12
                        other = corners.guess_board(seen.misses, board)
                        if other:
                            _say_other_size(session, board, other)
                            guessed, restart, board = True, not endless, other
                            if restart:
                                break
                            seen = gather.Seen(board)
                    if after and after(seen, grey, view):
                        break
            except MediaError as error:
                if not seen.views:
                    raise
                session.warn(f"{error}; going on with what was collected")
        if not restart and not guessed and not endless and seen.few:
            guessed = True
            other = corners.guess_board(seen.misses, board)
            if other:
                _say_other_size(session, board, other)
                restart, board, before = True, other, seen
        if not restart:
            return before if before and len(before.views) > len(seen.views) else seen


def _say_other_size(session, given, other):
    session.warn(
        f"--board {given} squares means {given.inner[0]}x{given.inner[1]} inner corners; the pictures show "
        f"{other.inner[0]}x{other.inner[1]} inner corners, a board of {other} squares: going on with that"
    )


def nothing_found(seen):
    """Say that no picture shows the board, and what may be wrong: exit 3."""
    if not len(seen):
        raise GateNotMet("no pictures in the sources")
    board = seen.board
    raise GateNotMet(
        f"none of {len(seen)} pictures shows a whole board of {board} squares ({board.inner[0]}x"
        f"{board.inner[1]} inner corners): is it all in the picture, lit, sharp, with a white border of a square?"
        if not board.markers
        else f"none of {len(seen)} pictures shows six corners of a ChArUco board of {board} squares (mirrored?)"
    )


def views_for(session, sources, board, rate, size, name):
    """Look for a board in pictures of a camera of known size; exit 3 where none shows one, 1 at another size."""
    seen = collect(session, check_sources(session, sources), board, rate)
    if not seen.views:
        nothing_found(seen)
    if seen.size != size:
        session.fail(f"the pictures are {seen.size[0]} × {seen.size[1]} px, {name} is for {size[0]} × {size[1]} px")
    return seen


# --- a camera in and out ----------------------------------------------------------------------------------------------


def read_camera(session, path):
    """Read a lens from a config.json or from a line that `calibrate` wrote: lens, (width, height) px, raw keys."""
    import orjson

    from avcli.formats import experiment

    try:
        with session.open(str(path)) as stream:
            raw = orjson.loads(stream.read())
        values = raw.get("camera_config", raw)
        width, height = int(values.get("image_width_px", 1920)), int(values.get("image_height_px", 1080))
    except (orjson.JSONDecodeError, AttributeError, TypeError, ValueError) as error:
        session.fail(f"{path}: no camera_config: {error}")
    return (
        experiment.lens_from_config(values, name=str(path), width_px=width, height_px=height),
        (width, height),
        values,
    )


def write_camera(session, found: dict) -> None:
    """Write keys of camera_config into config.json (-C, -c), and as one line to -o; without either to stdout."""
    if session.has_config:
        from avcli.formats import experiment

        path = session.config_path
        raw = dict(experiment.read_config(path).raw) if path.exists() else {}
        if "fx_px" in raw:  # a line that calibrate wrote: a camera_config by itself
            raw |= found
        else:
            raw["camera_config"] = {**raw.get("camera_config", {}), **found}
        path.parent.mkdir(parents=True, exist_ok=True)
        experiment.write_config(path, raw)
    if not session.has_config or session.output_path != "-":
        with session.output() as write:
            write(found)
