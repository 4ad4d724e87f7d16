"""avsim-scene: people who walk and talk in a room, seen by a fisheye camera, and the truth about them."""

import collections
import contextlib
import importlib.resources
import json
from pathlib import Path

import click

from avcli.commands.filter import Filter, Session, common

CHUNK = 100  # frames whose bodies are posed together: memory does not grow with the scene
THESIS_DEPTH_STEP_M = 0.02  # 8 bits over 5.1 m, a little more than the room's diagonal from the camera
PRESETS = {"thesis": {"camera": "thesis", "depth_bits": "8"}}
BUILT_IN = ("s1", "s2", "s3", "s4")


@click.command("avsim-scene", cls=Filter)
@click.argument("scenario", metavar="SCENARIO")
@click.option("--no-video", is_flag=True, help="Draw nothing: ground truth for an audio-only run, no graphics needed.")
@click.option(
    "--frames",
    type=click.Choice(["png", "npy", "none"]),
    default="png",
    show_default=True,
    help="How frames are written: PNG, raw NumPy arrays, or not at all (they are still drawn for the ground truth).",
)
@click.option(
    "--samples",
    type=click.IntRange(1, 64),
    default=4,
    show_default=True,
    metavar="N",
    help="Colour samples in a pixel at people's outlines; 1 draws hard edges, faster.",
)
@click.option(
    "--depth-bits",
    type=click.Choice(["8", "16"]),
    default="16",
    show_default=True,
    help="Bits of a depth pixel: 16 in steps of 0.1 mm, 8 in steps of 20 mm.",
)
@click.option(
    "--camera",
    type=click.Choice(["scenario", "real", "thesis"]),
    default="scenario",
    show_default=True,
    help="Lens: the scenario's, the calibrated KB-8 lens of the thesis, or its virtual one (division model).",
)
@click.option("--camera-config", metavar="FILE", help="Lens and image size from avcalib: a twin of your own camera.")
@click.option("--camera-height", type=click.FloatRange(0, min_open=True), metavar="M", help="Height of the camera, m.")
@click.option("--print-scenario", is_flag=True, help="Print the scenario, every default filled in, and end.")
@click.option("--force", is_flag=True, help="Use DIR even where another program wrote its config.json.")
@common(seed=True, presets=PRESETS)
def main(
    session: Session, scenario, no_video, frames, samples, depth_bits, camera, camera_config, camera_height, **options
):
    """Simulate people who walk and talk in a room under a fisheye camera.

    SCENARIO is a built-in one (s1, s2, s3, s4), or a JSON file, - for standard input. Writes config.json,
    groundtruth_sources.jsonl and video/ into the experiment directory, and one record a frame.
    """
    raw, name = _read_scenario(session, scenario)
    scene = _parse(session, _with_camera(session, raw, camera, camera_config, camera_height), name)
    if options["print_scenario"]:
        with session.output() as write:
            write(json.dumps(scene.raw, indent=2, ensure_ascii=False) + "\n")
        return
    directory = session.experiment
    for warning in scene.warnings:
        session.warn(warning)
    step = THESIS_DEPTH_STEP_M if depth_bits == "8" else 1e-4
    renderer = None
    if not no_video:
        with session.timing("open the renderer and draw the room"):
            renderer = _renderer(session, scene, samples, step)
    _prepare(session, directory, options["force"])
    saver = _Saver(session, directory, "none" if no_video else frames, depth_bits)
    with session.output() as write, contextlib.ExitStack() as stack:
        if saver.kind != "none":
            with session.timing("write the empty room"):
                saver.background(renderer.room_depth)
        _write_config(session, directory, scene, step, background=saver.kind != "none", video=renderer is not None)
        stack.enter_context(saver)
        truth = stack.enter_context(_GroundTruth(directory))
        for record in session.progress(_records(session, scene, renderer, saver), len(scene.times)):
            truth.write({key: value for key, value in record.items() if key != "frame"})
            write(record)


# --- the scenario -----------------------------------------------------------------------------------------------------


def _read_scenario(session, source):
    """The JSON of a scenario and the name by which messages call it."""
    if source in BUILT_IN:
        path = importlib.resources.files("avcli.scene") / "scenarios" / f"{source}.json"
        return json.loads(path.read_bytes()), source
    with session.open(source) as stream:
        text = stream.read()
    name = "<stdin>" if source == "-" else source
    return _json(session, text, name), name


def _json(session, text, name):
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        session.fail(f"{name}:{error.lineno}:{error.colno}: no JSON: {error.msg}")
    except UnicodeDecodeError as error:
        session.fail(f"{name}: no UTF-8 at byte {error.start}")


def _with_camera(session, raw, camera, camera_config, height):
    from avcli.scene import scenario

    if not isinstance(raw, dict):
        return raw
    if camera != "scenario":
        raw = scenario.with_camera(raw, scenario.CAMERAS[camera])
    if camera_config is not None:
        with session.open(camera_config) as stream:
            raw = scenario.with_camera(raw, _json(session, stream.read(), camera_config))
    if height is not None:
        section = {**scenario.LABORATORY["camera_config"], **raw.get("camera_config", {})}
        position = [*list(section["camera_position_m"])[:2], height]
        raw = {**raw, "camera_config": {**raw.get("camera_config", {}), "camera_position_m": position}}
    return raw


def _parse(session, raw, name):
    from avcli.scene import scenario

    folder = Path(name).parent

    def load_mesh(path):
        import trimesh

        try:
            mesh = trimesh.load_mesh(folder / path, process=False)
        except FileNotFoundError:
            raise ValueError(f"{path}: no such file") from None
        except Exception as error:  # each of trimesh's readers has its own
            raise ValueError(f"{path}: no mesh that can be read: {error}") from None
        return getattr(mesh, "triangles", [])

    return scenario.parse(raw, name, load_mesh)


# --- the experiment directory -----------------------------------------------------------------------------------------


def _renderer(session, scene, samples, step):
    from avcli.scene import render

    try:
        return render.Renderer(scene.config.camera, scene.config.room.dimensions, scene.solids, step, samples)
    except render.NoGraphics as error:
        session.fail(str(error))


def _prepare(session, directory, force):
    """Make the directory and clear what an earlier run wrote; refuse one whose config.json is somebody else's."""
    from avcli.experiment import Layout

    layout = Layout(directory)
    if directory.exists() and not directory.is_dir():
        session.usage(f"{directory}: is no directory")
    if layout.config.exists() and not force:
        try:
            owner = json.loads(layout.config.read_bytes()).get("written_by", {}).get("command")
        except (ValueError, AttributeError):
            owner = None
        if owner != "avsim-scene":
            session.fail(
                f"{layout.config}: avsim-scene did not write it; --force overwrites it and the frames beside it"
            )
    layout.config.unlink(missing_ok=True)
    layout.groundtruth.unlink(missing_ok=True)
    for kind, prefix in (("rgb", "RGB_frame_"), ("depth", "Depth_frame_"), ("depth", "Depth_background")):
        for extension in ("png", "npy"):
            for path in (directory / "video" / kind).glob(f"{prefix}*.{extension}"):
                path.unlink()
    directory.mkdir(parents=True, exist_ok=True)


def _write_config(session, directory, scene, step, *, background, video):
    """Write config.json: its keys are the scenario's own sections, and what a reader of the frames has to know."""
    import math

    from avcli import __version__
    from avcli.experiment import Layout, write_config

    camera = dict(scene.raw["camera_config"])
    camera["theta_max_valid_deg"] = math.degrees(scene.config.camera.lens.theta_max)
    if video:
        camera |= {"depth_kind": "radial", "depth_step_m": step}
    if background:
        camera["background_depth"] = Layout.background_depth
    sections = {key: scene.raw[key] for key in ("microphone_config", "room_config")}
    written_by = {"command": "avsim-scene", "version": __version__, "scenario": scene.name, "seed": session.seed}
    config = {"session_id": scene.name, "camera_config": camera, **sections, "written_by": written_by}
    write_config(Layout(directory).config, config)


class _GroundTruth:
    """groundtruth_sources.jsonl, which appears when it is complete."""

    def __init__(self, directory):
        self.path = directory / "groundtruth_sources.jsonl"

    def __enter__(self):
        from avcli import atomic

        self._replacing = atomic.replacing(self.path)
        self._stream = open(self._replacing.__enter__(), "wb")
        return self

    def __exit__(self, *error):
        try:
            self._stream.close()
        except OSError as failure:
            self._replacing.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._replacing.__exit__(*error)

    def write(self, record):
        from avcli import records

        self._stream.write(records.encode(record))


class _Saver:
    """Writes frames beside the drawing, in a thread of its own (deflate needs no interpreter)."""

    def __init__(self, session, directory, kind, depth_bits):
        self.session, self.directory, self.kind, self.depth_bits = session, directory, kind, depth_bits

    def __enter__(self):
        from concurrent.futures import ThreadPoolExecutor

        self._pool = ThreadPoolExecutor(1)
        return self

    def __exit__(self, *error):
        self._pool.shutdown(wait=True, cancel_futures=True)

    def background(self, depth):
        from avcli.experiment import Layout

        self._write(Layout.background_depth, self._bits(depth), "png")

    def save(self, time, frame):
        """Begin to write a frame; returns the record's "frame" and a function that waits until its files are there."""
        from avcli.experiment import Layout

        if self.kind == "none":
            return None, lambda: None
        paths = {"rgb": Layout.rgb(time, self.kind), "depth": Layout.depth(time, self.kind)}

        def work():
            with self.session.timing(f"write {self.kind} (in parallel)"):
                self._write(paths["rgb"], frame.rgb, self.kind)
                self._write(paths["depth"], self._bits(frame.depth), self.kind)

        return paths, self._pool.submit(work).result

    def _bits(self, depth):
        import numpy as np

        return depth if self.depth_bits == "16" else np.where(depth < 256, depth, 0).astype(np.uint8)

    def _write(self, path, picture, kind):
        import io

        import numpy as np

        from avcli import atomic, media

        path = self.directory / path
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "png":
            media.write_png(path, picture)
        else:
            raw = io.BytesIO()
            np.save(raw, picture)
            atomic.write_bytes(path, raw.getbuffer())


# --- the frames -------------------------------------------------------------------------------------------------------


def _records(session, scene, renderer, saver):
    """Yield one record a frame as soon as its files are there; two frames are on their way at a time."""
    waiting = collections.deque()
    for record, done in _drawn(session, scene, renderer, saver):
        waiting.append((record, done))
        if len(waiting) > 2:
            record, done = waiting.popleft()
            done()
            yield record
    for record, done in waiting:
        done()
        yield record


def _drawn(session, scene, renderer, saver):
    from avcli.scene import annotations, people

    times = scene.times
    for start in range(0, len(times), CHUNK):
        with session.timing("pose the people"):
            bodies = people.pose(scene.people, times[start : start + CHUNK])
            prepared = renderer.prepare(bodies) if renderer else None
        for index, time in enumerate(bodies.times):
            frame = None
            if renderer:
                with session.timing("draw"):
                    frame = renderer.draw(prepared, index)
            with session.timing("annotate"):
                record = annotations.truth(scene, bodies, index, frame)
            paths, done = saver.save(float(time), frame) if frame else (None, lambda: None)
            if paths:
                record["frame"] = paths
            yield record, done
