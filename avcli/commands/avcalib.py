"""avcalib: calibrate a real fisheye camera, and know how far to trust the result."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from avcli import __version__
from avcli.calibration.settings import BoardSettings, FitSettings
from avcli.commands import avcalib_room
from avcli.commands.avcalib_pictures import (
    BOARD_OPTIONS,
    POSITIVE,
    RATE_OPTION,
    collect,
    parse_board,
    read_camera,
    usage_errors,
    views_for,
    write_camera,
)
from avcli.commands.filter import FilterGroup, GateNotMet, Session, common
from avcli.commands.options import Size, from_settings, refuse_without_effect, settings_from
from avcli.settings import settings_of

if TYPE_CHECKING:
    from avcli.calibration.calibrate import Calibration
    from avcli.calibration.gather import Seen

_THESIS = {"thesis": {"procedure": "thesis", "board": "6x8", "square_mm": 95.0, "rate_hz": 2.0}}
_PLOTS = ("png", "svg", "pdf")


@click.group(
    "avcalib",
    cls=FilterGroup,
    invoke_without_command=False,
    epilog="Example: avcalib calibrate film.mp4 --board 6x9 --square 90 -o camera.json",
)
@click.help_option("-h", "--help")
@click.version_option(__version__, "--version", message="%(prog)s %(version)s")
def main() -> None:
    """Calibrate a camera with a printed board: films, pictures or a USB camera in, a camera_config out."""


for _command in (avcalib_room.undistort_command, avcalib_room.pose_command, avcalib_room.microphones_command):
    main.add_command(_command)


# --- calibrate --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Outputs:
    """Where results go besides the camera_config, and whether a lens that is not observable is written."""

    details: str | None = None
    plot: str | None = None
    html: str | None = None
    force: bool = False

    @property
    def plot_kind(self) -> str:
        return self.plot.rsplit(".", 1)[-1].lower() if self.plot else ""


def _fit_options(function: Callable) -> Callable:
    for option in (
        click.option("--size", type=Size(), help="Size in px to request from a camera, for example 1920x1080."),
        click.option("--force", is_flag=True, help="Write the result even if the lens is not observable (exit 3)."),
        click.option("--html", metavar="FILE", help="Write the report with its plots as one HTML file."),
        click.option("--plot", metavar="FILE", help="Plot residuals, coverage and expected error: .png, .svg or .pdf."),
        click.option("--details", metavar="FILE", help="Write one record per picture: corners, residual, used or not."),
        from_settings(FitSettings),
    ):
        function = option(function)
    return function


def _fit_settings(session: Session, values: dict[str, Any]) -> tuple[FitSettings, _Outputs]:
    """Check the options of calibrate and live before any picture is read."""
    settings, outputs = settings_from(FitSettings, values), settings_from(_Outputs, values)
    foreign = [
        name for name, (_, known) in settings_of(FitSettings).items() if known.only not in ("", settings.procedure)
    ]
    refuse_without_effect(foreign, f"with --procedure {settings.procedure}")
    if outputs.plot and outputs.plot_kind not in _PLOTS:
        session.usage(f"--plot {outputs.plot}: the name must end in .{', .'.join(_PLOTS)}")
    return settings, outputs


@main.command("calibrate", epilog="Example: avcalib calibrate film.mp4 --board 6x9 --square 90 -o camera.json")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@BOARD_OPTIONS
@RATE_OPTION
@_fit_options
@common(presets=_THESIS)
def calibrate_command(
    session: Session, sources: tuple[str, ...], rate_hz: float, size: tuple[int, int] | None, **values: Any
) -> None:
    """Find a camera's lens from pictures, a video or a camera that saw a printed board from many sides."""
    board, (settings, outputs) = parse_board(session, values), _fit_settings(session, values)
    _finish(session, collect(session, sources, board, rate_hz, size), settings, outputs)


def _finish(session: Session, seen: Seen, settings: FitSettings, outputs: _Outputs) -> None:
    """Fit, report, write."""
    from avcli.calibration import calibrate, fit

    try:
        with session.timing("fit"):
            seen.require_views()
            result = calibrate.calibrate_views(seen.board, seen.views, settings)
    except fit.NoFit as error:
        _write_details(outputs.details, seen)
        raise GateNotMet(str(error)) from None
    _write_details(outputs.details, seen, result)
    _report(session, seen, result, outputs)
    if outputs.force or not result.quality.refusals:
        write_camera(session, result.camera_config())
    if result.quality.refusals:
        raise GateNotMet(f"the lens is not observable: {'; '.join(result.quality.refusals)}")


def _write_details(path: str | None, seen: Seen, result: Calibration | None = None) -> None:
    from avcli.formats import records
    from avcli.formats.atomic import write_bytes

    if path:
        rows = seen.records(result.kept, result.view_rms_px) if result else seen.records()
        write_bytes(path, b"".join(map(records.encode, rows)))


def _report(session: Session, seen: Seen, result: Calibration, outputs: _Outputs) -> None:
    from avcli.calibration import report
    from avcli.formats.atomic import write_bytes

    session.warn(
        f"{len(seen) - seen.count('no board')} of {len(seen)} pictures show the board of {result.board} squares, "
        f"{seen.count('duplicate')} of them as in another picture; the fit uses {int(result.kept.sum())} pictures with "
        f"{len(result.observations.pixels)} corners"
    )
    for line in report.words(result):
        session.warn(line)
    with session.timing("draw"):
        if outputs.plot:
            write_bytes(outputs.plot, report.picture(result, seen.sample, outputs.plot_kind))
        if outputs.html:
            write_bytes(outputs.html, report.page(result, seen.names, seen.sample).encode())


# --- check ------------------------------------------------------------------------------------------------------------


@main.command("check", epilog="Example: avcalib check camera.json new/ --board 6x9 --square 90")
@click.argument("camera", metavar="CONFIG")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@BOARD_OPTIONS
@RATE_OPTION
@click.option("--fail-over", type=POSITIVE, metavar="PX", help="Exit 3 if the RMS residual exceeds this many px.")
@common(experiment=False)
def check_command(
    session: Session, camera: str, sources: tuple[str, ...], rate_hz: float, fail_over: float | None, **values: Any
) -> None:
    """Test a calibration on new pictures of a board. Only the poses of the board are fitted; the lens is fixed."""
    from avcli.calibration import calibrate

    known = read_camera(session, camera)
    seen = views_for(session, sources, parse_board(session, values), rate_hz, known)
    score = calibrate.check(seen.board, seen.views, known.lens)
    with session.output() as write:
        write({"pictures": len(seen), **score})
    if fail_over is not None and not score["rms_px"] <= fail_over:
        raise GateNotMet(f"the RMS residual is {score['rms_px']:.3f} px, more than --fail-over {fail_over:g}")


# --- live -------------------------------------------------------------------------------------------------------------


@main.command("live", epilog="Example: avcalib live /dev/video0 --board 7x10 --square 95 -C lab")
@click.argument("source", default="/dev/video0", metavar="[CAMERA]")
@BOARD_OPTIONS
@RATE_OPTION
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8080,
    show_default=True,
    help="Port on 127.0.0.1 of the page that shows the camera with corners and coverage. 0: no page.",
)
@click.option(
    "--enough",
    type=POSITIVE,
    metavar="PX",
    help="Stop when the mean expected error over the picture is below this many px.  [default: at Ctrl-C]",
)
@_fit_options
@common()
def live_command(
    session: Session,
    source: str,
    rate_hz: float,
    port: int,
    enough: float | None,
    size: tuple[int, int] | None,
    **values: Any,
) -> None:
    """Calibrate while you film: hints say where to hold the board next.

    The first Ctrl-C ends the filming. The lens is then found from the collected pictures.
    """
    from avcli.calibration import live, mjpeg

    board, (settings, outputs) = parse_board(session, values), _fit_settings(session, values)
    with contextlib.ExitStack() as stack:
        show = stack.enter_context(mjpeg.serving(port)) if port else None
        if show:
            session.warn(f"open http://127.0.0.1:{show.port}/ to watch")
        guide = live.Guide(enough, session.warn, show)
        seen = collect(session, [source], board, rate_hz, size, guide.after)
    _finish(session, seen, settings, outputs)


# --- target -----------------------------------------------------------------------------------------------------------


@main.command("target", epilog="Example: avcalib target --board 7x10 --square 25 --paper A4 -o board.pdf")
@from_settings(BoardSettings, defaults={"board": "7x10", "square_mm": 25.0})
@click.option(
    "--paper",
    type=click.Choice(["A4", "A3", "A2", "A1", "A0"]),
    help="Paper size; the sheet is turned as the board needs it.  [default: a page as large as the board]",
)
@click.option(
    "--format", "kind", type=click.Choice(["svg", "pdf"]), help="Format.  [default: by the name of -o, else svg]"
)
@common(experiment=False)
def target_command(session: Session, paper: str | None, kind: str | None, **values: Any) -> None:
    """Draw a board to print at true size, with rulers to check the print."""
    from avcli.calibration import target

    board = parse_board(session, values)
    with usage_errors(session):
        drawing = target.draw(board, paper)
    if board.is_ambiguous:
        session.warn(
            f"a checkerboard of {board} squares looks the same upside down: avcalib pose cannot tell which way it lies"
        )
    if kind is None:
        kind = "pdf" if session.output_path.lower().endswith(".pdf") else "svg"
    with session.output() as write:
        write(target.to_pdf(drawing) if kind == "pdf" else target.to_svg(drawing))
