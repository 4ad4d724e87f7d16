"""avcalib: calibrate a real fisheye camera, and know how far to trust the result."""

from __future__ import annotations

import contextlib
import io
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

import avcli.calibration.settings as settings
from avcli import __version__
from avcli.commands import avcalib_convert, avcalib_detector, avcalib_room
from avcli.commands.avcalib_pictures import (
    check_sources,
    collect,
    ending_on_interrupt,
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
    from avcli.calibration.live import Guide
    from avcli.calibration.recognise import Wanted
    from avcli.formats.footage import Picture, Source

_THESIS = {"thesis": {"procedure": "thesis", "board": "6x8", "kind": "checkerboard", "square_mm": 95.0, "rate_hz": 2.0}}


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


for _command in (
    avcalib_room.undistort_command,
    avcalib_room.pose_command,
    avcalib_room.microphones_command,
    avcalib_room.background_command,
    avcalib_detector.detector_command,
    avcalib_convert.convert_command,
):
    main.add_command(_command)


def _fit_options(rate_hz: float) -> Callable:
    """Add the options that calibrate and live share."""
    options = (
        click.option("--size", type=Size(), help="Size in px to request from a camera, for example 1920x1080."),
        click.option("--force", is_flag=True, help="Write the lens even if the pictures do not tell it (exit 3)."),
        click.option("--html", metavar="FILE", help="Write the report with its plots as one HTML file."),
        click.option("--plot", metavar="FILE", help="Plot residuals, coverage and expected error: .png, .svg or .pdf."),
        click.option("--details", metavar="FILE", help="Write one record per picture: corners, residual, used or not."),
        from_settings(settings.FitSettings),
        from_settings(settings.PictureSettings, defaults={"rate_hz": rate_hz}),
        from_settings(settings.BoardSettings),
    )

    def decorate(function: Callable) -> Callable:
        for option in options:
            function = option(function)
        return function

    return decorate


@main.command("calibrate", epilog="Example: avcalib calibrate film.mp4 --board 6x9 --square 90 -o camera.json")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@_fit_options(rate_hz=2.0)
@common(presets=_THESIS)
def calibrate_command(session: Session, sources: tuple[str, ...], **values: Any) -> None:
    """Find a camera's lens from pictures, a video or a camera that saw a printed board from many sides."""
    _check_options(session, values, sources)
    from avcli.calibration import live

    fitted = settings_from(settings.FitSettings, values)
    seen = collect(session, list(sources), values, is_enough=lambda seen: live.is_enough(seen, fitted))
    _finish(session, seen, values)


@main.command("live", epilog="Example: avcalib live /dev/video0 --board 7x10 --square 95 -C lab")
@click.argument("source", default="/dev/video0", metavar="[CAMERA]")
@_fit_options(rate_hz=10.0)
@from_settings(settings.LiveSettings)
@common()
def live_command(session: Session, source: str, **values: Any) -> None:
    """Calibrate while you film: hints say where to hold the board next, and when it is enough.

    CAMERA is a device or its number (default: /dev/video0), a stream at an address (rtsp://…), a video, which plays at
    its own pace, or - for JPEGs on standard input. Only the newest picture counts, and only of a board that is held
    still. Ctrl-C ends the filming earlier.
    """
    from avcli.calibration import live, watch
    from avcli.formats import serving

    _check_options(session, values, [source])
    given = settings_from(settings.LiveSettings, values)
    fitted = settings_from(settings.FitSettings, values)
    board, camera = parse_board(session, values), check_sources(session, [source])[0]
    with contextlib.ExitStack() as stack:
        show = None
        if given.port:
            page = stack.enter_context(watch.serving(given.port, given.host))
            session.warn(f"open {page.url} to watch")
            if not serving.is_local(given.host):
                session.warn("everybody in the network who knows this address sees the camera")

            def show(picture: Any, state: live.State) -> None:
                page(picture, state.record())

        else:
            refuse_without_effect(["host"], "without a page")
        guide = live.Guide(fitted, given.enough_px, session.warn, show, given.stops)
        seen = _film(session, camera, board, values, guide)
    if guide.state.enough and sys.stderr.isatty() and not session.quiet:
        click.echo("\a", err=True, nl=False)
    _finish(session, seen, values)


def _check_options(session: Session, values: dict[str, Any], sources: Iterable[str]) -> None:
    """Refuse, before any picture is read, what cannot be done or has no effect."""
    from avcli.calibration.choose import AUTO
    from avcli.lens import variants

    procedure, plot, model = values["procedure"], values["plot"], values["lens_model"]
    foreign = [
        name for name, (_, known) in settings_of(settings.FitSettings).items() if known.only not in ("", procedure)
    ]
    refuse_without_effect(foreign, f"with --procedure {procedure}")
    if model not in (*variants(), AUTO, None):
        session.usage(f"--lens-model {model} is unknown; known are {', '.join(variants())}, {AUTO}")
    if plot and not plot.lower().endswith((".png", ".svg", ".pdf")):
        session.usage(f"--plot {plot}: the name must end in .png, .svg or .pdf")
    session.check_outputs({f"--{name}": values[name] for name in ("html", "plot", "details")}, sources)


def _finish(session: Session, seen: Seen, values: dict[str, Any]) -> None:
    """Fit, report, write."""
    from avcli.calibration import calibrate, fit

    result = None
    try:
        with session.timing("fit"):
            seen.require_views()
            given = settings_from(settings.FitSettings, values)
            result = calibrate.calibrate_views(seen.board, seen.views, given, seen.light.circle)
    except fit.NoFit as error:
        raise GateNotMet(str(error)) from None
    finally:
        _write_details(values["details"], seen, result)
    _report(session, seen, result, values["plot"], values["html"])
    if values["force"] or not result.quality.refusals:
        write_camera(session, result.camera_config())
    if result.quality.refusals:
        written = "all the same, as --force asks" if values["force"] else "by --force only"
        why = f": {'; '.join(result.quality.refusals)}" if session.quiet else ""  # the verdict has said it
        raise GateNotMet(f"the pictures do not tell the lens{why}; it is written {written}")


def _write_details(path: str | None, seen: Seen, result: Calibration | None) -> None:
    from avcli.formats import records
    from avcli.formats.atomic import write_bytes

    if path:
        rows = seen.records(result.kept, result.view_rms_px, result.dropped) if result else seen.records()
        write_bytes(path, b"".join(map(records.encode, rows)))


def _report(session: Session, seen: Seen, result: Calibration, plot: str | None, html: str | None) -> None:
    from avcli.calibration import page, report
    from avcli.formats.atomic import write_bytes
    from avcli.formats.records import printable

    for line in report.words(result, seen):
        session.warn(line)
    with session.timing("draw"):
        if plot:
            write_bytes(plot, report.picture(result, seen.sample, plot[-3:].lower()))
        if html:
            write_bytes(html, printable(page.page(result, seen)).encode())


@main.command("check", epilog="Example: avcalib check camera.json new/ --board 6x9 --square 90")
@click.argument("camera", metavar="CONFIG")
@click.argument("sources", nargs=-1, metavar="[SOURCE]...")
@click.option(
    "--part",
    "parts",
    multiple=True,
    metavar="NAME",
    help="Without SOURCE: examine only this part: lens, limits, room, pose, microphones, doors or background. Repeat "
    "the option for more.  [default: all]",
)
@from_settings(settings.BoardSettings)
@from_settings(settings.PictureSettings)
@from_settings(settings.CheckSettings)
@common(experiment=False)
def check_command(
    session: Session,
    camera: str,
    sources: tuple[str, ...],
    parts: tuple[str, ...],
    fail_over_px: float | None,
    **values: Any,
) -> None:
    """Test a calibration on new pictures of a board, or examine a whole installation.

    CONFIG is a config.json or the directory of an experiment. With pictures, only the poses of the board are fitted;
    the lens is fixed. Without, lens, limits, room, pose, microphones, doors and background are examined: what is there,
    whether it is plausible, and how it was measured.
    """
    from avcli.calibration import calibrate, fit, place

    session.check_outputs({}, [camera, *sources])
    if not sources:
        refuse_without_effect([*settings_of(settings.BoardSettings), "rate_hz", "fail_over_px"], "without SOURCE")
        avcalib_room.examine(session, camera, parts)
        return
    refuse_without_effect(["parts"], "with SOURCE")
    known = read_camera(session, camera)
    seen = views_for(session, list(sources), values, known)
    trusted = known.theta_trusted if "theta_max_trusted_deg" in known.values else math.inf
    try:
        score = calibrate.check(seen.board, seen.views, known.lens, trusted, known.pupil_m)
    except fit.NoFit as error:
        raise GateNotMet(str(error)) from None
    with session.output() as write:
        write({"pictures": len(seen), **score})
    if wrong := place.refusal(math.radians(score["off_deg"]), "board", score["rms_px"]):
        raise GateNotMet(wrong)
    if fail_over_px is not None and not score["rms_px"] <= fail_over_px:
        raise GateNotMet(f"the RMS residual is {score['rms_px']:.3f} px, more than --fail-over {fail_over_px:g}")


@main.command("target", epilog="Example: avcalib target --board 7x10 --square 25 --paper A4 -o board.pdf")
@from_settings(settings.BoardSettings, defaults={"square_mm": 25.0}, words=settings.TO_PRINT)
@from_settings(settings.PrintSettings)
@click.option("--kalibr", metavar="FILE", help="Also write the board's description for Kalibr (target.yaml).")
@common(experiment=False)
def target_command(
    session: Session, paper: str | None, format: str | None, dpi: float, kalibr: str | None, **values: Any
) -> None:
    """Draw a board to print at true size, with rulers to check the print."""
    from avcli.calibration import drawing
    from avcli.formats.atomic import write_bytes

    kind = _picture_format(session, format)
    if kind != "png":
        refuse_without_effect(["dpi"], f"with {kind}")
    session.check_outputs({"--kalibr": kalibr})
    with usage_errors(session):
        board = parse_board(session, values).board()
        page = drawing.draw(board, paper)
        content: str | bytes = drawing.to_svg(page)
        if kind == "pdf":
            content = drawing.to_pdf(page)
        elif kind == "png":
            content = drawing.to_png(page, dpi)
        description = drawing.kalibr_yaml(board).encode() if kalibr else b""
    if board.is_ambiguous:
        session.warn(
            f"a {board.words} looks the same upside down: avcalib pose cannot find its direction"
            + ("; make one count odd and one even" if board.kind == "checkerboard" else "")
        )
    if kalibr:
        write_bytes(kalibr, description)
    with session.output() as write:
        write(content)


def _picture_format(session: Session, format: str | None) -> str:
    """The format of a target, by --format or by the name of the output; usage error where they differ."""
    from pathlib import PurePath

    suffix = PurePath(session.output_path).suffix.lower().removeprefix(".")
    if suffix and suffix not in ("svg", "pdf", "png"):
        session.usage(f"-o {session.output_path}: the name must end in .svg, .pdf or .png")
    if format and suffix and format != suffix:
        session.usage(f"-o {session.output_path} contradicts --format {format}")
    return format or suffix or "svg"


# --- what avcalib live films: the newest picture of a camera, of a stream, or of a film at its own pace ---------------

_PATIENCE_S = 60.0
"""How long an unplugged camera is waited for."""


def _film(session: Session, source: Source, board: Wanted, values: Mapping[str, Any], guide: Guide) -> Seen:
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
        arriving = _as_they_arrive(footage.pictures(["-"], stream=io.BufferedReader(pipe)), rate_hz, ended)
    elif source.kind == "url":
        arriving = _as_they_arrive(footage.pictures([source.name]), rate_hz, ended)
    elif source.kind in ("video", "file"):
        arriving = _paced(footage.pictures([source.name], rate_hz), ended)
    else:  # single pictures have no pace
        return footage.pictures([source.name]), stop
    return iter(stack.enter_context(LiveSource(arriving, newest=True, stop=stop))), stop


def _as_they_arrive(pictures: Iterator[Picture], rate_hz: float | None, ended: threading.Event) -> Iterator[Picture]:
    """Yield pictures with the time at which they arrived, at most so many a second."""
    from avcli.formats.live import Pace

    pace = Pace(rate_hz)
    for picture in pictures:
        if ended.is_set():
            return
        if pace.takes():
            yield replace(picture, timestamp=time.monotonic())


def _paced(pictures: Iterator[Picture], ended: threading.Event) -> Iterator[Picture]:
    """Yield the pictures of a film when they are due, as a camera would."""
    begun = None
    for picture in pictures:
        begun = time.monotonic() - picture.timestamp if begun is None else begun
        if ended.wait(max(0.0, begun + picture.timestamp - time.monotonic())):
            return
        yield picture
