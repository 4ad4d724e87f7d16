"""avcalib: calibrate a real fisheye camera, and know whether to believe it."""

import os
import signal

import click

from avcli import __version__
from avcli.commands import avcalib_room
from avcli.commands.filter import FilterGroup, GateNotMet, common

_THESIS = {"thesis": {"procedure": "thesis", "board_text": "6x8", "square": 95.0, "rate": 2.0}}


@click.group("avcalib", cls=FilterGroup, invoke_without_command=False)
@click.help_option("-h", "--help")
@click.version_option(__version__, "--version", message="%(prog)s %(version)s")
def main():
    """Calibrate a camera with a printed board: films, pictures or a USB camera in, a camera_config out."""


for _command in (avcalib_room.undistort_command, avcalib_room.pose_command, avcalib_room.microphones_command):
    main.add_command(_command)


_FEW = 100
"""Up to so many pictures each is searched thoroughly; a film has boards enough."""

# --- boards and pictures ----------------------------------------------------------------------------------------------


def _board_options(function):
    options = [
        click.option(
            "--board",
            "board_text",
            metavar="COLSxROWS",
            default="6x8",
            show_default=True,
            help="Squares of the board as printed, along a row and along a column.",
        ),
        click.option(
            "--square",
            type=click.FloatRange(min=0, min_open=True),
            default=95.0,
            show_default=True,
            metavar="MM",
            help="Side of a square in mm; the lens does not depend on it, poses do.",
        ),
        click.option(
            "--charuco", is_flag=True, help="The board is a ChArUco board as `avcalib target --charuco` draws it."
        ),
    ]
    for option in reversed(options):
        function = option(function)
    return function


def _board(session, text: str, square: float, charuco: bool):
    from avcli.calibration import target

    try:
        return target.Board(*target.parse_size(text), square / 1000, charuco)
    except ValueError as error:
        session.usage(str(error))


def _check_sources(session, sources) -> list[str]:
    from avcli import footage

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


def _is_endless(sources) -> bool:
    from avcli import footage

    return any(source == "-" or footage.is_camera(source) for source in sources)


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


def _pictures(session, sources, rate, size=None):
    from avcli import footage

    stream = session.open("-") if "-" in sources else None
    return footage.pictures(sources, rate, stream=stream, size=size)


class _Seen:
    """What became of each picture, in order; `views` are those that can be used."""

    def __init__(self, board):
        self.board = board
        self.records, self.views, self.names, self.misses = [], [], [], []
        self.size = self.sample = None

    def take(self, session, picture, grey, view):
        from avcli.calibration import calibrate, corners

        height, width = grey.shape
        if self.size is None:
            self.size = (width, height)
        if (width, height) != self.size:
            session.fail(
                f"{picture.name} is {width} × {height} px and the pictures before it are {self.size[0]} × "
                f"{self.size[1]} px: one lens has one size"
            )
        why = None
        if view is None:
            why = "no board"
            if len(self.misses) < 8:
                self.misses.append(corners.shrunk(grey)[0])
        elif calibrate.is_duplicate(view, self.views):
            why = "duplicate"
        record = {"timestamp": picture.timestamp, "picture": picture.name, "why": why, "view": None}
        if why is None:
            record["view"] = len(self.views)
            self.views.append(view)
            self.names.append(picture.name)
            if self.sample is None:
                self.sample = grey
        self.records.append(record)

    def count(self, why):
        return sum(record["why"] == why for record in self.records)

    @property
    def few(self):
        """Whether the board was found so seldom that it may have another size."""
        return bool(self.records) and self.count("no board") > 0.7 * len(self.records)


def _look(picture, board, thorough):
    """Find the board in one picture: (picture, grey, view or None). Runs in a thread."""
    from avcli.calibration import corners

    grey = corners.to_grey(picture.image)
    view = corners.find(grey, board, thorough=thorough)
    if view is not None and not board.markers and not corners.is_whole(grey, view.pixels, board.inner):
        view = None
    return picture, grey, view


def _looked(pictures, searched, filming, thorough):
    """Yield what `_look` finds of searched[0], in order; OpenCV lets go of Python's lock, so that threads help."""
    from collections import deque
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        waiting = deque()
        try:
            for picture in pictures:
                waiting.append(pool.submit(_look, picture, searched[0], thorough))
                if filming.active or len(waiting) >= 4:  # a hint must not wait for pictures to come
                    yield waiting.popleft().result()
                if filming.stopped:
                    break
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _collect(session, sources, board, rate, size=None, after=None):
    """Look for the board in all pictures; a board of another size than the given one is recognised, said and taken.

    `after(seen, grey, view)` is called after each picture and ends the filming by returning True.
    """
    from avcli import footage
    from avcli.calibration import corners
    from avcli.media import MediaError

    endless = _is_endless(sources)
    total = None if endless else footage.count_pictures(sources, rate)
    guessed, before = board.markers, None
    while True:
        seen = _Seen(board)
        searched = [board]
        restart = False
        with _Filming(endless or after is not None) as filming:
            pictures = session.progress(_pictures(session, sources, rate, size), total, "looking for boards")
            try:
                for picture, grey, view in _looked(pictures, searched, filming, total is not None and total <= _FEW):
                    seen.take(session, picture, grey, view)
                    if not guessed and len(seen.records) in (4, 12) and seen.few:
                        guessed = len(seen.records) == 12
                        other = corners.guess_board(seen.misses, board)
                        if other:
                            _say_other_size(session, board, other)
                            guessed, restart, board = True, not endless, other
                            if restart:
                                break
                            seen, searched[0] = _Seen(board), board
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


def _nothing_found(session, seen):
    if not seen.records:
        raise GateNotMet("no pictures in the sources")
    board = seen.board
    raise GateNotMet(
        f"none of {len(seen.records)} pictures shows a whole board of {board} squares ({board.inner[0]}x"
        f"{board.inner[1]} inner corners): is it all in the picture, lit, sharp, with a white border of a square?"
        if not board.markers
        else f"none of {len(seen.records)} pictures shows six corners of a ChArUco board of {board} squares (mirrored?)"
    )


# --- calibrate --------------------------------------------------------------------------------------------------------


def _rate_option(default=2.0):
    return click.option(
        "--rate",
        type=click.FloatRange(min=0, min_open=True),
        default=default,
        show_default=True,
        metavar="HZ",
        help="Pictures a second to take from a video or a camera; picture files are all taken.",
    )


class _Size(click.ParamType):
    name = "WxH"

    def convert(self, value, param, ctx):
        parts = value.lower().split("x")
        if len(parts) != 2 or not all(part.isdigit() and int(part) for part in parts):
            self.fail(f"{value!r} is no size like 1920x1080", param, ctx)
        return int(parts[0]), int(parts[1])


def _fit_options(function):
    options = [
        click.option(
            "--procedure",
            type=click.Choice(["avcli", "thesis"]),
            default="avcli",
            show_default=True,
            help="avcli: our robust fit. thesis: OpenCV twice, dropping pictures above --max-rms between.",
        ),
        click.option(
            "--max-rms",
            type=click.FloatRange(min=0, min_open=True),
            default=0.75,
            show_default=True,
            metavar="PX",
            help="Residual in px above which --procedure thesis drops a picture.",
        ),
        click.option(
            "--board-shape",
            type=click.Choice(["auto", "yes", "no"]),
            default="auto",
            show_default=True,
            help="Fit the board's bow and stretch too; auto does where held-out pictures improve by 2 %.",
        ),
        click.option("--details", metavar="FILE", help="Write a record a picture: corners, residual, kept or why not."),
        click.option("--plot", metavar="FILE", help="Draw residuals, coverage and expected error: .png, .svg or .pdf."),
        click.option("--html", metavar="FILE", help="Write the report with its pictures as one HTML file."),
        click.option(
            "--force", is_flag=True, help="Write the result even where the lens is not observable (still exit 3)."
        ),
        click.option("--size", type=_Size(), help="Size in px to ask of a camera, such as 1920x1080."),
    ]
    for option in reversed(options):
        function = option(function)
    return function


@main.command("calibrate")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@_board_options
@_rate_option()
@_fit_options
@common(presets=_THESIS)
def calibrate_command(session, sources, board_text, square, charuco, rate, size, **options):
    """Find a camera's lens from pictures, a video or a camera that saw a printed board from many sides."""
    board = _board(session, board_text, square, charuco)
    sources = _check_sources(session, sources)
    with session.timing("look for boards"):
        seen = _collect(session, sources, board, rate, size)
    _finish(session, seen, **options)


def _finish(session, seen, *, procedure, max_rms, board_shape, details, plot, html, force):
    """Fit, judge, report, write."""
    from avcli.calibration import calibrate, fit, opencv

    if plot and plot.rsplit(".", 1)[-1].lower() not in ("png", "svg", "pdf"):
        session.usage(f"--plot {plot}: expected a name that ends in .png, .svg or .pdf")

    if not seen.views:
        _write_details(session, details, seen, None)
        _nothing_found(session, seen)
    try:
        with session.timing("fit"):
            if procedure == "thesis":
                if not opencv.version().startswith("5."):
                    session.warn(f"this is OpenCV {opencv.version()}; the thesis's procedure was tried with 5.0")
                result = calibrate.calibrate_as_thesis(seen.board, seen.views, max_rms)
            else:
                shape = {"auto": None, "yes": True, "no": False}[board_shape]
                result = calibrate.calibrate(seen.board, seen.views, board_shape=shape)
    except (fit.NoFit, opencv.OpenCVRefused) as error:
        _write_details(session, details, seen, None)
        raise GateNotMet(str(error)) from None
    _write_details(session, details, seen, result)
    _report(session, seen, result)
    with session.timing("draw"):
        _draw(session, seen, result, plot, html)
    refusals = result.quality.refusals
    if not refusals or force:
        _write_camera(session, result.camera_config())
    if refusals:
        raise GateNotMet(f"the lens is not observable: {'; '.join(refusals)}")


def _report(session, seen, result):
    from avcli.calibration import report

    given, duplicates = len(seen.records), seen.count("duplicate")
    session.warn(
        f"{given - seen.count('no board')} of {given} pictures show the board of {result.board} squares, {duplicates} "
        f"as another does; {int(result.kept.sum())} used, {len(result.observations.pixels)} corners"
    )
    for line in report.words(result):
        session.warn(line)


def _draw(session, seen, result, plot, html):
    from avcli.atomic import write_bytes
    from avcli.calibration import report

    if plot:
        write_bytes(plot, report.picture(result, seen.sample, plot.rsplit(".", 1)[-1].lower()))
    if html:
        write_bytes(html, report.page(result, seen.names, seen.sample).encode())


def _write_details(session, path, seen, result):
    """Write a record a picture; a picture that was used has its corners and residual."""
    if not path:
        return
    from avcli import records
    from avcli.atomic import write_bytes

    lines = []
    for number, record in enumerate(seen.records):
        row = {"timestamp": record["timestamp"], "frame_number": number, "picture": record["picture"]}
        index, why = record["view"], record["why"]
        kept = False
        if index is not None:
            view = seen.views[index]
            row["corner_ids"], row["corners_px"] = view.ids, view.pixels
            if result is not None:
                kept = bool(result.kept[index])
                row["rms_px"] = float(result.view_rms_px[index])
                why = None if kept else "does not fit"
            else:
                why = "no fit"
        row["kept"], row["why"] = kept, why
        lines.append(records.encode(row))
    write_bytes(path, b"".join(lines))


def _write_camera(session, found: dict) -> None:
    """Write keys of camera_config into config.json (-C, -c), and as one line to -o; without either to stdout."""
    if session.has_config:
        from avcli import experiment

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


# --- check ------------------------------------------------------------------------------------------------------------


@main.command("check")
@click.argument("camera", metavar="CONFIG")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@_board_options
@_rate_option()
@click.option(
    "--fail-over",
    type=click.FloatRange(min=0, min_open=True),
    metavar="PX",
    help="Exit 3 if the RMS residual is more than this many px.",
)
@common(experiment=False)
def check_command(session, camera, sources, board_text, square, charuco, rate, fail_over):
    """Score a calibration on new pictures of a board: only the board's pose is fitted, the lens is held."""
    from avcli.calibration import calibrate

    lens, size, _ = read_camera(session, camera)
    board = _board(session, board_text, square, charuco)
    seen = _collect(session, _check_sources(session, sources), board, rate)
    if not seen.views:
        _nothing_found(session, seen)
    if seen.size != size:
        session.fail(f"the pictures are {seen.size[0]} × {seen.size[1]} px, {camera} is for {size[0]} × {size[1]} px")
    score = calibrate.check(seen.board, seen.views, lens)
    with session.output() as write:
        write({"pictures": len(seen.records), **score})
    if fail_over is not None and not score["rms_px"] <= fail_over:
        raise GateNotMet(f"RMS {score['rms_px']:.3f} px, more than {fail_over:g} px")


def read_camera(session, path):
    """Read a lens from a config.json or from a line that `calibrate` wrote: lens, (width, height) px, raw keys."""
    import orjson

    from avcli import experiment

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


# --- live -------------------------------------------------------------------------------------------------------------


@main.command("live")
@click.argument("source", default="/dev/video0", metavar="[CAMERA]")
@_board_options
@_rate_option()
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1 of the page that shows the camera with corners and coverage; 0 for none.",
)
@click.option(
    "--enough",
    type=click.FloatRange(min=0, min_open=True),
    metavar="PX",
    help="Stop when the mean expected error over the picture is below this many px.  [default: until Ctrl-C]",
)
@_fit_options
@common()
def live_command(session, source, board_text, square, charuco, rate, port, enough, size, **options):
    """Film with hints: what was found, what is known so far, and where to hold the board next; then calibrate.

    The first Ctrl-C ends the filming, and the lens is found from what was collected.
    """
    import contextlib

    from avcli.calibration import live
    from avcli.commands import mjpeg

    board = _board(session, board_text, square, charuco)
    sources = _check_sources(session, [source])
    with contextlib.ExitStack() as stack:
        show = stack.enter_context(mjpeg.serving(port)) if port else None
        if show:
            session.warn(f"watch on http://127.0.0.1:{show.port}/")
        guide = live.Guide()

        def after(seen, grey, view):
            line = guide.take(seen.board, seen.views, view is not None)
            if line:
                session.warn(line)
            if show:
                show(live.overlay(grey, view, guide))
            return bool(enough and guide.quality and not guide.quality.refusals and guide.mean_px <= enough)

        seen = _collect(session, sources, board, rate, size, after)
    _finish(session, seen, **options)


# --- target -----------------------------------------------------------------------------------------------------------


@main.command("target")
@click.option(
    "--board",
    "board_text",
    metavar="COLSxROWS",
    default="7x10",
    show_default=True,
    help="Squares along a row and along a column; one odd and one even count make up and down distinct.",
)
@click.option(
    "--square",
    type=click.FloatRange(min=0, min_open=True),
    default=25.0,
    show_default=True,
    metavar="MM",
    help="Side of a square in mm.",
)
@click.option(
    "--charuco", is_flag=True, help="With a marker in each white square, so that a part of the board is enough."
)
@click.option(
    "--paper",
    type=click.Choice(["A4", "A3", "A2", "A1", "A0"]),
    help="Paper to put it on, upright or across.  [default: a page as large as the board]",
)
@click.option(
    "--format", "kind", type=click.Choice(["svg", "pdf"]), help="What to write.  [default: by the name of -o, else svg]"
)
@common(experiment=False)
def target_command(session, board_text, square, charuco, paper, kind):
    """Draw a board to print at true size, with rulers that tell whether the printer kept it."""
    from avcli.calibration import target

    board = _board(session, board_text, square, charuco)
    try:
        drawing = target.draw(board, paper)
    except ValueError as error:
        session.usage(str(error))
    if not charuco and board.columns % 2 == board.rows % 2:
        session.warn(
            f"a checkerboard of {board} squares looks the same upside down: its pose is known up to half a turn"
        )
    if kind is None:
        kind = "pdf" if session.output_path.lower().endswith(".pdf") else "svg"
    with session.output() as write:
        write(target.to_pdf(drawing) if kind == "pdf" else target.to_svg(drawing))
