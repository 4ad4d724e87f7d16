"""avsim-scene: people who walk and talk in a room, seen by a fisheye camera, and the truth about them."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avcli.commands.filter import Filter, Session, common
from avcli.commands.options import FiniteRange, WholeRange, from_settings, refuse_without_effect, settings_from
from avcli.scene.settings import BUILT_IN, LENSES, ROOM_KINDS, SENSORS, Drawing, Effects
from avcli.settings import settings_of

if TYPE_CHECKING:
    from avcli.scene.film import Film
    from avcli.scene.scenario import Scenario
    from avcli.scene.worlds import Wishes

PICTURES = (
    "no_cache",
    "sensor",
    "frames",
    "masks",
    "coco",
    "sheet",
    *settings_of(Drawing),
    *settings_of(Effects),
)  # what only they need
COLOUR = ("sheet", "sensor", "samples", "shutter_s", *settings_of(Effects))  # what needs colour
PRESETS = {"thesis": {"camera": "thesis", "depth_bits": "8"}}


@click.command("avsim-scene", cls=Filter, epilog="Example: avsim-scene s1 -C out/s1 -o scene.jsonl")
@click.argument("scenario", metavar="SCENARIO")
@click.option("--no-video", is_flag=True, help="Draw nothing: ground truth for an audio-only run, no graphics needed.")
@click.option(
    "--frames",
    type=click.Choice(["png", "npy", "none"]),
    default="png",
    show_default=True,
    help="Format of the frames: PNG, raw NumPy arrays, or none (drawn for the ground truth, but not written).",
)
@from_settings(Drawing, leave_out=("shutter_s",))
@click.option(
    "--camera",
    type=click.Choice(["scenario", "real", "thesis"]),
    default="scenario",
    show_default=True,
    help="Lens: the scenario's, the calibrated KB-8 lens of the thesis, or its virtual one (division model).",
)
@click.option("--camera-config", metavar="FILE", help="Lens and image size from avcalib: a twin of your own camera.")
@click.option("--camera-height", type=FiniteRange(0, min_open=True), metavar="M", help="Height of the camera, m.")
@click.option(
    "--people",
    type=WholeRange(0, 250),
    metavar="N",
    default=3,
    show_default=True,
    help="Number of people in a random scenario.",
)
@click.option("--kind", type=click.Choice(ROOM_KINDS), help="Kind of the room of a random scenario; default: any.")
@click.option("--room", metavar="WxDxH", help="Size of the room of a random scenario, m, as 6x4x2.8; default: any.")
@click.option("--lens", type=click.Choice(LENSES), help="Lens of a random scenario; default: any.")
@click.option("--duration", type=FiniteRange(0), metavar="S", help="Length of the scene, s, instead of its own.")
@click.option(
    "--masks", is_flag=True, help="Write video/masks/Mask_frame_<t>.png: the person of each pixel, 0 for none."
)
@click.option("--coco", metavar="FILE", help="Write boxes, masks and keypoints of all frames as COCO JSON.")
@click.option("--sheet", metavar="FILE", help="Write a contact sheet of twelve frames, a PNG.")
@click.option("--gltf", metavar="FILE", help="Write the scene at its middle as binary glTF, for any viewer.")
@from_settings(Drawing, "shutter_s")
@click.option(
    "--sensor",
    type=click.Choice([*SENSORS]),
    help="Take pictures like a webcam, an IP camera, or a perfect sensor (clean); the options below refine it. "
    "Default: what the scenario says, else clean.",
)
@from_settings(Effects)
@click.option(
    "--no-cache", is_flag=True, help="Draw the empty room even if an earlier run kept it, and do not keep it."
)
@click.option("--print-scenario", is_flag=True, help="Print the scenario with every default filled in, and exit.")
@click.option(
    "--force",
    is_flag=True,
    help="Use DIR even if another program wrote its config.json, or its folders are symbolic links.",
)
@common(seed=True, presets=PRESETS, mark_end=True)
def main(session: Session, scenario: str, **options: Any) -> None:
    """Simulate people who walk and talk in a room under a fisheye camera.

    SCENARIO is a built-in one (s1, s2, s3, s4), random, or a JSON file, - for standard input. Writes config.json,
    groundtruth_sources.jsonl and video/ into the experiment directory, and one record per frame to standard output.
    """
    inputs = [path for path in (scenario, options["camera_config"]) if path and os.path.exists(path)]
    session.check_outputs({f"--{name}": options[name] for name in ("coco", "sheet", "gltf")}, inputs)
    scene = _scenario(session, scenario, options)
    if options["print_scenario"]:
        with session.output() as write:
            write(json.dumps(scene.raw, indent=2, ensure_ascii=False) + "\n")
        return
    from avcli.formats.writer import only_writer
    from avcli.scene import output

    for warning in scene.warnings:
        session.warn(warning)
    if options["gltf"]:
        output.write_gltf(scene, options["gltf"])
        if not session.has_experiment:
            return
    directory = session.experiment
    if options["no_video"]:
        refuse_without_effect(PICTURES, "with --no-video")
    if options["pictures"] == "depth":
        refuse_without_effect(COLOUR, "with --pictures depth")
    if directory.exists() and not directory.is_dir():
        session.usage(f"{directory}: not a directory")
    files = output.Files(options["frames"], options["masks"], options["coco"], options["sheet"])
    film = _film(session, scene, options)
    with only_writer(directory, session.name):
        output.prepare(directory, force=options["force"])
        records = output.write(film, directory, files, session.timing)
        with session.output() as write, contextlib.closing(records):
            for record in session.progress(records, len(scene.times)):
                write(record)
    if film.drawing:
        session.note(f"drawn by {film.drawn_by}")
        if film.cache and film.cache.saved_s:
            saved = f"saved about {film.cache.saved_s:.2f} s"
            session.note(f"not computed: the colours of the empty room, which an earlier run has kept; {saved}")
        frames = film.account.drawn + film.account.again
        size = scene.config.camera.width_px * scene.config.camera.height_px
        session.note_skipped("frames", film.account.again, frames, "which are as the one before", "draw")
        left = round((frames - film.account.share) * size)
        session.note_skipped("pixels", left, frames * size, "where the picture is as the one before")


def _film(session: Session, scene: Scenario, options: dict[str, Any]) -> Film:
    from avcli.scene import film, render, room_cache

    drawing = None if options["no_video"] else settings_from(Drawing, options)
    try:
        return film.Film(
            scene, drawing, settings_from(Effects, options), sensor_name=options["sensor"], seed=session.seed,
            rooms=None if options["no_cache"] else room_cache.folder(), timing=session.timing,
        )  # fmt: skip
    except render.NoGraphics as error:
        session.fail(str(error))


def _scenario(session: Session, source: str, options: dict[str, Any]) -> Scenario:
    """The scenario that the command line asks for."""
    from avcli.scene import load

    if source != load.RANDOM:
        refuse_without_effect(["people", "kind", "room", "lens"], "on a scenario that is not random")
    if source in (*BUILT_IN, load.RANDOM):
        name = source
        raw = load.named(name, session.seed, _wishes(session, options), options["duration"])
    elif source != "-" and not Path(source).exists():
        session.usage(load.unknown(source))
    else:
        name = "<stdin>" if source == "-" else source
        raw = _json(session, source, name)
    given = options["camera_config"]
    return load.build(
        raw,
        name,
        folder=Path(name).parent,
        duration=options["duration"],
        camera=None if options["camera"] == "scenario" else options["camera"],
        camera_config=None if given is None else _json(session, given, given),
        camera_height=options["camera_height"],
    )


def _wishes(session: Session, options: dict[str, Any]) -> Wishes:
    from avcli.scene.worlds import Wishes

    room = None
    if options["room"] is not None:
        try:
            x, y, z = (float(side) for side in options["room"].lower().split("x"))
        except ValueError:
            session.usage(f"--room must be three lengths in m, as 6x4x2.8; found {options['room']}")
        if not (all(2.0 <= side <= 100.0 for side in (x, y)) and 2.0 <= z <= 30.0):
            session.usage(f"--room must be 2 to 100 m long and wide, and 2 to 30 m high; found {options['room']}")
        room = x, y, z
    return Wishes(options["people"], options["kind"], room, options["lens"], options["camera_height"])


def _json(session: Session, path: str, name: str) -> Any:
    from avcli.formats import bounds
    from avcli.scene import load

    with session.open(path) as stream:
        return load.decode(stream.read(bounds.LARGEST_JSON_FILE + 1), name)
