"""avcalib convert: cameras from and for other tools."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import click

import avcli.calibration.settings as settings
from avcli.commands.avcalib_pictures import usage_errors, write_camera
from avcli.commands.filter import GateNotMet, Session, common
from avcli.commands.options import Size, from_settings, refuse_without_effect

if TYPE_CHECKING:
    from avcli.calibration.exchange import Camera


@click.command("convert", epilog="Example: avcalib convert camera.json --to opencv -o camera.yml")
@click.argument("source", metavar="FILE")
@from_settings(settings.ConvertSettings)
@click.option("--size", type=Size(), help="Size in px of the camera's pictures, where the file does not say it.")
@common()
def convert_command(
    session: Session,
    source: str,
    to: str | None,
    model: str | None,
    camera: str | None,
    fisheye: bool | None,
    max_error_px: float,
    size: tuple[int, int] | None,
) -> None:
    """Convert a camera from or to the format of OpenCV, ROS, Kalibr, COLMAP or mrcal.

    FILE is a camera_config, or a file of one of those tools; what it is follows from its content. Where the other tool
    lacks the lens model, the nearest lens that it has is written, and its distance from the camera is stated.
    """
    from dataclasses import replace

    from avcli.calibration import exchange

    session.check_outputs({}, [source])
    with session.open(source) as stream:
        content = stream.read()
    kind, cameras = exchange.read(content, source, fisheye)
    to = to or _format_of(session, kind)
    if kind != "opencv":
        refuse_without_effect(["fisheye"], f"with a file of {kind}")
    if to != "avcli":
        refuse_without_effect(["experiment", "config"], f"with --to {to}")
    with usage_errors(session):
        chosen = _chosen(cameras, camera, source)
    if chosen.size is None and size is None:
        session.usage(f"{source} does not say how large the pictures are; give --size WxH")
    if chosen.size is not None and size is not None and size != chosen.size:
        session.usage(f"--size {size[0]}x{size[1]}, but {source} says {chosen.size[0]}x{chosen.size[1]}")
    chosen = replace(chosen, size=chosen.size or size)
    with session.timing("convert"), usage_errors(session) if model else contextlib.nullcontext():
        try:
            found = exchange.write(chosen, to, xml=session.output_path.lower().endswith(".xml"), model=model)
        except exchange.NotConvertible as error:
            raise GateNotMet(f"{source}: {error}") from None
    for line in exchange.words(chosen, found, to):
        session.warn(line)
    if found.rms_px > max_error_px:
        raise GateNotMet(
            f"the nearest {found.model} is {found.rms_px:.2g} px (RMS) from the lens, more than --max-error "
            f"{max_error_px:g}"
        )
    if to == "avcli":
        write_camera(session, found.config)
        return
    with session.output() as write:
        write(found.text)


def _format_of(session: Session, kind: str) -> str:
    """The format to write where --to is absent: by the output's name, else a camera_config."""
    from avcli.calibration.exchange import FORMATS

    name = session.output_path.lower()
    for other, form in FORMATS.items():
        if name.endswith(form.endings):
            return other
    if kind == "avcli":
        session.usage(f"--to is needed: one of {', '.join(other for other in FORMATS if other != 'avcli')}")
    return "avcli"


def _chosen(cameras: list[Camera], name: str | None, source: str) -> Camera:
    """The camera of that name; of several one must be named."""
    names = ", ".join(camera.name for camera in cameras)
    if name is None:
        if len(cameras) > 1:
            raise ValueError(f"{source} has {len(cameras)} cameras; choose one with --camera: {names}")
        return cameras[0]
    for camera in cameras:
        if camera.name == name:
            return camera
    raise ValueError(f"{source} has no camera {name!r}; it has {names}")
