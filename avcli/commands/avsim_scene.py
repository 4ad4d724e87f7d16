"""avsim-scene: people who walk and talk in a room, seen by a fisheye camera, and the truth about them."""

import collections
import contextlib
import importlib.resources
import json
from pathlib import Path

import click

from avcli.commands.filter import Filter, Session, common

CHUNK = 100  # frames whose bodies are posed together: memory does not grow with the scene
SHUTTER_PICTURES = 8  # that are averaged while the shutter is open
THESIS_DEPTH_STEP_M = 0.02  # 8 bits over 5.1 m, a little more than the room's diagonal from the camera
PRESETS = {"thesis": {"camera": "thesis", "depth_bits": "8"}}
BUILT_IN = ("s1", "s2", "s3", "s4")


@click.command("avsim-scene", cls=Filter, epilog="Example: avsim-scene s1 -C out/s1 -o scene.jsonl")
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
@click.option(
    "--people", type=click.IntRange(0, 250), default=3, show_default=True, help="People of a random scenario."
)
@click.option("--duration", type=click.FloatRange(0), metavar="S", help="Length of the scene, s, instead of its own.")
@click.option("--masks", is_flag=True, help="Write video/masks/Mask_frame_<t>.png: whose each pixel is, 0 the room's.")
@click.option("--coco", metavar="FILE", help="Write boxes, masks and keypoints of all frames as COCO JSON.")
@click.option("--sheet", metavar="FILE", help="Write a contact sheet of twelve frames, a PNG.")
@click.option("--gltf", metavar="FILE", help="Write the scene at its middle as binary glTF, for any viewer.")
@click.option("--shutter", type=click.FloatRange(0), default=0.0, metavar="S", help="Exposure time, s: motion blur.")
@click.option("--exposure", type=float, default=0.0, metavar="EV", help="Stops brighter or darker.")
@click.option("--vignetting", type=click.FloatRange(0, 1), default=0.0, metavar="F", help="Light lost in the corner.")
@click.option(
    "--aberration", type=float, default=0.0, metavar="PX", help="Shift of red and blue against green in the corner, px."
)
@click.option(
    "--full-well",
    type=click.FloatRange(0),
    default=0.0,
    metavar="N",
    help="Shot noise of a sensor whose white pixels hold N electrons; 0 for none.",
)
@click.option(
    "--read-noise", type=click.FloatRange(0), default=0.0, metavar="S", help="Noise of reading, in 1/255 of white."
)
@click.option("--jpeg", type=click.IntRange(1, 100), metavar="Q", help="Compress frames as JPEG of this quality would.")
@click.option("--print-scenario", is_flag=True, help="Print the scenario, every default filled in, and end.")
@click.option("--force", is_flag=True, help="Use DIR even where another program wrote its config.json.")
@common(seed=True, presets=PRESETS)
def main(session: Session, scenario, **options):
    """Simulate people who walk and talk in a room under a fisheye camera.

    SCENARIO is a built-in one (s1, s2, s3, s4), random, or a JSON file, - for standard input. Writes config.json,
    groundtruth_sources.jsonl and video/ into the experiment directory, and one record a frame.
    """
    scene = _scenario(session, scenario, options)
    if options["print_scenario"]:
        with session.output() as write:
            write(json.dumps(scene.raw, indent=2, ensure_ascii=False) + "\n")
        return
    for warning in scene.warnings:
        session.warn(warning)
    if options["gltf"]:
        _write_gltf(scene, options["gltf"])
        if not session.has_experiment:
            return
    directory = session.experiment
    draws = not options["no_video"]
    for name in ("masks", "coco", "sheet"):
        if options[name] and not draws:
            session.usage(f"--{name} needs pictures, and --no-video draws none")
    step = THESIS_DEPTH_STEP_M if options["depth_bits"] == "8" else 1e-4
    renderer = None
    if draws:
        with session.timing("open the renderer and draw the room"):
            renderer = _renderer(session, scene, options["samples"], step)
    _prepare(session, directory, options["force"])
    saver = _Saver(session, directory, options["frames"] if draws else "none", options)
    with session.output() as write, contextlib.ExitStack() as stack:
        if saver.kind != "none":
            saver.background(renderer.room_depth)
        _write_config(session, directory, scene, step, background=saver.kind != "none", video=draws)
        stack.enter_context(saver)
        truth = stack.enter_context(_GroundTruth(directory))
        extras = [kind(scene, options[name]) for name, kind in (("coco", _Coco), ("sheet", _Sheet)) if options[name]]
        frames = _drawn(session, scene, renderer, saver, extras, options)
        for record in session.progress(_complete(frames), len(scene.times)):
            truth.write({key: value for key, value in record.items() if key != "frame"})
            write(record)
        for extra in extras:
            extra.finish()


# --- the scenario -----------------------------------------------------------------------------------------------------


def _scenario(session, source, options):
    """The scenario that the command line asks for."""
    from avcli.scene import scenario

    if source == "random":
        import numpy as np

        from avcli.scene import crowd

        duration = 10.0 if options["duration"] is None else options["duration"]
        raw, name = crowd.random(options["people"], duration, np.random.default_rng(session.seed)), "random"
    elif source in BUILT_IN:
        path = importlib.resources.files("avcli.scene") / "scenarios" / f"{source}.json"
        raw, name = json.loads(path.read_bytes()), source
    else:
        with session.open(source) as stream:
            text = stream.read()
        name = "<stdin>" if source == "-" else source
        raw = _json(session, text, name)
    if isinstance(raw, dict):
        if options["duration"] is not None:
            raw = {**raw, "duration_s": options["duration"]}
        if options["camera"] != "scenario":
            raw = scenario.with_camera(raw, scenario.CAMERAS[options["camera"]])
        if options["camera_config"] is not None:
            with session.open(options["camera_config"]) as stream:
                text = stream.read()
            raw = scenario.with_camera(raw, _json(session, text, options["camera_config"]))
        if options["camera_height"] is not None:
            raw = scenario.at_height(raw, options["camera_height"])
    return scenario.parse(raw, name, _mesh_loader(Path(name).parent))


def _json(session, text, name):
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        session.fail(f"{name}:{error.lineno}:{error.colno}: no JSON: {error.msg}")
    except UnicodeDecodeError as error:
        session.fail(f"{name}: no UTF-8 at byte {error.start}")


def _mesh_loader(folder):
    """A function that reads a mesh's triangles; its path is relative to the scenario's file."""

    def load_mesh(path):
        import trimesh

        if not (folder / path).is_file():
            raise ValueError(f"{path}: no such file")
        try:
            mesh = trimesh.load_mesh(folder / path, process=False)
        except Exception as error:  # each of trimesh's readers has its own
            raise ValueError(f"{path}: no mesh that can be read: {error}") from None
        return getattr(mesh, "triangles", [])

    return load_mesh


# --- the experiment directory -----------------------------------------------------------------------------------------


def _renderer(session, scene, samples, step):
    from avcli.scene import render

    try:
        return render.Renderer(scene.config.camera, scene.config.room.dimensions, scene.solids, step, samples)
    except render.NoGraphics as error:
        session.fail(str(error))


def _prepare(session, directory, force):
    """Make the directory and clear what an earlier run wrote; refuse one whose config.json is somebody else's."""
    from avcli.formats.experiment import Layout

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
    for pattern in ("rgb/RGB_frame_*", "depth/Depth_frame_*", "depth/Depth_background", "masks/Mask_frame_*"):
        for extension in ("png", "npy"):
            for path in (directory / "video").glob(f"{pattern}.{extension}"):
                path.unlink()
    directory.mkdir(parents=True, exist_ok=True)


def _write_config(session, directory, scene, step, *, background, video):
    """Write config.json: its keys are the scenario's own sections, and what a reader of the frames has to know."""
    import math

    from avcli import __version__
    from avcli.formats.experiment import Layout, write_config

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
        from avcli.formats import atomic

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
        from avcli.formats import records

        self._stream.write(records.encode(record))


class _Saver:
    """Writes frames beside the drawing, in a thread of its own (deflate needs no interpreter)."""

    def __init__(self, session, directory, kind, options):
        self.session, self.directory, self.kind = session, directory, kind
        self.narrow, self.masks = options["depth_bits"] == "8", options["masks"]

    def __enter__(self):
        from concurrent.futures import ThreadPoolExecutor

        self._pool = ThreadPoolExecutor(1)
        return self

    def __exit__(self, *error):
        self._pool.shutdown(wait=True, cancel_futures=True)

    def background(self, depth):
        """Write the empty room's depth, always as PNG."""
        from avcli.formats.experiment import Layout

        self._write(Layout.background_depth, self._bits(depth), "png")

    def save(self, time, rgb, frame):
        """Begin to write a frame; returns the record's "frame" and a function that waits until its files are there."""
        from avcli.formats.experiment import Layout

        pictures = {}
        if self.kind != "none":
            pictures["rgb"] = Layout.rgb(time, self.kind), rgb, self.kind
            pictures["depth"] = Layout.depth(time, self.kind), self._bits(frame.depth), self.kind
        if self.masks:
            stem = Layout.rgb(time).rsplit("RGB_frame_", 1)[1]
            pictures["mask"] = f"video/masks/Mask_frame_{stem}", frame.ids, "png"

        def work():
            with self.session.timing("write (beside the drawing)"):
                for path, picture, kind in pictures.values():
                    self._write(path, picture, kind)

        return {name: path for name, (path, _, _) in pictures.items()}, self._pool.submit(work).result

    def _bits(self, depth):
        import numpy as np

        return np.where(depth < 256, depth, 0).astype(np.uint8) if self.narrow else depth

    def _write(self, path, picture, kind):
        import io

        import numpy as np

        from avcli.formats import atomic, media

        path = self.directory / path
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "png":
            media.write_png(path, picture)
        else:
            raw = io.BytesIO()
            np.save(raw, picture)
            atomic.write_bytes(path, raw.getbuffer())


class _Coco:
    """Collects COCO's annotations and writes them at the end."""

    def __init__(self, scene, path):
        self.scene, self.path, self.images, self.annotations = scene, path, [], []

    def add(self, time, record, rgb, frame):
        from avcli.formats.experiment import Layout
        from avcli.scene import annotations

        number = len(self.images) + 1
        height, width = frame.ids.shape
        self.images.append({"id": number, "file_name": Layout.rgb(time), "width": width, "height": height})
        for person, item in enumerate(record["objects"]):
            entry = annotations.coco(self.scene, person, frame, number, len(self.annotations) + 1)
            if entry is not None:
                flat = [value for keypoint in item["keypoints_px"] for value in keypoint]
                seen = sum(keypoint[2] > 0 for keypoint in item["keypoints_px"])
                self.annotations.append({**entry, "keypoints": flat, "num_keypoints": seen})

    def finish(self):
        from avcli.formats import atomic
        from avcli.scene import annotations

        content = {"images": self.images, "annotations": self.annotations, "categories": annotations.COCO_CATEGORIES}
        atomic.write_bytes(self.path, json.dumps(content).encode() + b"\n")


class _Sheet:
    """A contact sheet: frames spread over the scene, three rows of four."""

    def __init__(self, scene, path):
        count = len(scene.times)
        self.path, self.pictures = path, []
        self.wanted = {round(k * (count - 1) / 11) for k in range(12)}
        self.number = 0

    def add(self, time, record, rgb, frame):
        import cv2

        if self.number in self.wanted:
            height, width = rgb.shape[:2]
            size = (480, max(round(480 * height / width), 1))
            small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
            cv2.putText(
                small, f"{time:.1f} s", (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA
            )
            self.pictures.append(small)
        self.number += 1

    def finish(self):
        import numpy as np

        from avcli.formats import media

        if not self.pictures:
            return
        blank = np.full_like(self.pictures[0], 40)
        pictures = self.pictures + [blank] * (-len(self.pictures) % 4)
        rows = [np.concatenate(pictures[k : k + 4], 1) for k in range(0, len(pictures), 4)]
        media.write_png(self.path, np.concatenate(rows))


def _write_gltf(scene, path):
    from avcli.formats import atomic
    from avcli.scene import mesh, people

    bodies = people.pose(scene.people, [scene.times[len(scene.times) // 2]])
    atomic.write_bytes(path, mesh.glb(scene, bodies, 0))


# --- the frames -------------------------------------------------------------------------------------------------------


def _complete(frames):
    """Yield each record when its files are there; two frames are on their way at a time."""
    waiting = collections.deque()
    for record, done in frames:
        waiting.append((record, done))
        if len(waiting) > 2:
            record, done = waiting.popleft()
            done()
            yield record
    for record, done in waiting:
        done()
        yield record


def _drawn(session, scene, renderer, saver, extras, options):
    """Yield each frame's record, and a function that waits for its files."""
    import numpy as np

    from avcli.scene import annotations, people, sensor

    effects = sensor.Sensor(
        options["exposure"], options["vignetting"], options["aberration"], options["full_well"], options["read_noise"],
        options["jpeg"] or 0,
    )  # fmt: skip
    generator = np.random.default_rng(session.seed)
    times, shutter = scene.times, options["shutter"] if renderer else 0.0
    # The shutter opens half its time before a frame's time, so that truth and picture agree on the mean.
    instants = shutter * (np.arange(SHUTTER_PICTURES) + 0.5) / SHUTTER_PICTURES - shutter / 2
    for start in range(0, len(times), CHUNK):
        with session.timing("pose the people"):
            bodies = people.pose(scene.people, times[start : start + CHUNK])
            prepared = renderer.prepare(bodies) if renderer else None
        for index, time in enumerate(bodies.times):
            if not renderer:
                yield annotations.truth(scene, bodies, index), lambda: None
                continue
            with session.timing("draw"):
                frame = renderer.draw(prepared, index)
                rgb = frame.rgb
                if shutter:
                    open_ = renderer.prepare(people.pose(scene.people, time + instants))
                    rgb = sensor.blurred([renderer.draw(open_, k).rgb for k in range(SHUTTER_PICTURES)])
            with session.timing("sensor effects"):
                optics = scene.config.camera.lens
                rgb = effects.expose(rgb, (optics.cx, optics.cy), generator)
            with session.timing("annotate"):
                record = annotations.truth(scene, bodies, index, frame)
                for extra in extras:
                    extra.add(float(time), record, rgb, frame)
            paths, done = saver.save(float(time), rgb, frame)
            yield record | ({"frame": paths} if paths else {}), done
