"""avcalib: calibrate a real fisheye camera, and know whether to believe it."""

import click

from avcli import __version__
from avcli.commands import avcalib_room
from avcli.commands.avcalib_pictures import (
    POSITIVE,
    Size,
    board_options,
    check_sources,
    collect,
    nothing_found,
    parse_board,
    rate_option,
    read_camera,
    views_for,
    with_options,
    write_camera,
)
from avcli.commands.filter import FilterGroup, GateNotMet, common

_THESIS = {"thesis": {"procedure": "thesis", "board_text": "6x8", "square": 95.0, "rate": 2.0}}


@click.group(
    "avcalib",
    cls=FilterGroup,
    invoke_without_command=False,
    epilog="Example: avcalib calibrate film.mp4 --board 6x9 --square 90 -o camera.json",
)
@click.help_option("-h", "--help")
@click.version_option(__version__, "--version", message="%(prog)s %(version)s")
def main():
    """Calibrate a camera with a printed board: films, pictures or a USB camera in, a camera_config out."""


for _command in (avcalib_room.undistort_command, avcalib_room.pose_command, avcalib_room.microphones_command):
    main.add_command(_command)


# --- calibrate --------------------------------------------------------------------------------------------------------


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
            type=POSITIVE,
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
        click.option("--size", type=Size(), help="Size in px to ask of a camera, such as 1920x1080."),
    ]
    return with_options(function, options)


@main.command("calibrate", epilog="Example: avcalib calibrate film.mp4 --board 6x9 --square 90 -o camera.json")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@board_options()
@rate_option()
@_fit_options
@common(presets=_THESIS)
def calibrate_command(session, sources, board_text, square, charuco, rate, size, **options):
    """Find a camera's lens from pictures, a video or a camera that saw a printed board from many sides."""
    board = parse_board(session, board_text, square, charuco)
    sources = check_sources(session, sources)
    with session.timing("look for boards"):
        seen = collect(session, sources, board, rate, size)
    _finish(session, seen, **options)


def _finish(session, seen, *, procedure, max_rms, board_shape, details, plot, html, force):
    """Fit, judge, report, write."""
    from avcli.calibration import calibrate, fit, opencv

    if plot and plot.rsplit(".", 1)[-1].lower() not in ("png", "svg", "pdf"):
        session.usage(f"--plot {plot}: expected a name that ends in .png, .svg or .pdf")

    if not seen.views:
        _write_details(details, seen, None)
        nothing_found(seen)
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
        _write_details(details, seen, None)
        raise GateNotMet(str(error)) from None
    _write_details(details, seen, result)
    _report(session, seen, result)
    with session.timing("draw"):
        _draw(session, seen, result, plot, html)
    refusals = result.quality.refusals
    if not refusals or force:
        write_camera(session, result.camera_config())
    if refusals:
        raise GateNotMet(f"the lens is not observable: {'; '.join(refusals)}")


def _write_details(path, seen, result):
    if path:
        from avcli.formats import records
        from avcli.formats.atomic import write_bytes

        write_bytes(path, b"".join(map(records.encode, seen.records(result))))


def _report(session, seen, result):
    from avcli.calibration import report

    given, duplicates = len(seen), seen.count("duplicate")
    session.warn(
        f"{given - seen.count('no board')} of {given} pictures show the board of {result.board} squares, {duplicates} "
        f"as another does; {int(result.kept.sum())} used, {len(result.observations.pixels)} corners"
    )
    for line in report.words(result):
        session.warn(line)


def _draw(session, seen, result, plot, html):
    from avcli.calibration import report
    from avcli.formats.atomic import write_bytes

    if plot:
        write_bytes(plot, report.picture(result, seen.sample, plot.rsplit(".", 1)[-1].lower()))
    if html:
        write_bytes(html, report.page(result, seen.names, seen.sample).encode())


# --- check ------------------------------------------------------------------------------------------------------------


@main.command("check", epilog="Example: avcalib check camera.json new/ --board 6x9 --square 90")
@click.argument("camera", metavar="CONFIG")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@board_options()
@rate_option()
@click.option(
    "--fail-over",
    type=POSITIVE,
    metavar="PX",
    help="Exit 3 if the RMS residual is more than this many px.",
)
@common(experiment=False)
def check_command(session, camera, sources, board_text, square, charuco, rate, fail_over):
    """Score a calibration on new pictures of a board: only the board's pose is fitted, the lens is held."""
    from avcli.calibration import calibrate

    lens, size, _ = read_camera(session, camera)
    board = parse_board(session, board_text, square, charuco)
    seen = views_for(session, sources, board, rate, size, camera)
    score = calibrate.check(seen.board, seen.views, lens)
    with session.output() as write:
        write({"pictures": len(seen), **score})
    if fail_over is not None and not score["rms_px"] <= fail_over:
        raise GateNotMet(f"RMS {score['rms_px']:.3f} px, more than {fail_over:g} px")


# --- live -------------------------------------------------------------------------------------------------------------


@main.command("live", epilog="Example: avcalib live /dev/video0 --board 7x10 --square 95 -C lab")
@click.argument("source", default="/dev/video0", metavar="[CAMERA]")
@board_options()
@rate_option()
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1 of the page that shows the camera with corners and coverage; 0 for none.",
)
@click.option(
    "--enough",
    type=POSITIVE,
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

    board = parse_board(session, board_text, square, charuco)
    sources = check_sources(session, [source])
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

        seen = collect(session, sources, board, rate, size, after)
    _finish(session, seen, **options)


# --- target -----------------------------------------------------------------------------------------------------------


@main.command("target", epilog="Example: avcalib target --board 7x10 --square 25 --paper A4 -o board.pdf")
@board_options("7x10", 25.0)
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

    board = parse_board(session, board_text, square, charuco)
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
