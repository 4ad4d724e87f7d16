"""avcalib's actions for a camera whose lens is known: pictures without the fisheye, its place, the microphones."""

import os
from pathlib import Path

import click

from avcli.commands.filter import common


def _known_camera(session):
    from avcli.commands.avcalib import read_camera

    if not session.has_config:
        session.usage("-c FILE (a config.json, or what `avcalib calibrate` wrote) or -C DIR is needed")
    return read_camera(session, session.config_path)


# --- undistort --------------------------------------------------------------------------------------------------------

_VIDEOS = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "mp4v"}


@click.command("undistort")
@click.argument("sources", nargs=-1, metavar="SOURCE...")
@click.option(
    "--to",
    "target",
    required=True,
    metavar="PATH",
    help="Where the pictures go: a folder, a picture file (of one source), or a video (.mp4, .avi, .mkv).",
)
@click.option(
    "--projection",
    type=click.Choice(["perspective", "cylindrical", "whole"]),
    default="perspective",
    show_default=True,
    help="perspective: straight lines stay straight. cylindrical: upright lines do, and it goes round further. "
    "whole: all that the lens sees, as azimuth and elevation.",
)
@click.option(
    "--balance",
    type=click.FloatRange(0, 1),
    default=0.0,
    show_default=True,
    help="Of a perspective picture: 0 shows what the camera fills to the last corner, 1 all it sees up to 80 degrees.",
)
@click.option(
    "--fov", type=click.FloatRange(1, 360), metavar="DEG", help="Width of the view in degrees, instead of --balance."
)
@click.option("--size", metavar="WxH", help="Size of the new pictures in px.  [default: as the camera's]")
@click.option(
    "--rate",
    type=click.FloatRange(min=0, min_open=True),
    metavar="HZ",
    help="Pictures a second to take from a video.  [default: all]",
)
@common()
def undistort_command(session, sources, target, projection, balance, fov, size, rate):
    """Straighten pictures and videos; the camera_config of the new pictures goes to the output.

    A perspective picture is a camera of its own, brown_conrady without distortion. The other projections have none.
    """
    import math

    from avcli import footage
    from avcli.calibration import undistort
    from avcli.commands.avcalib import _check_sources, _Size

    lens, native, values = _known_camera(session)
    sources = _check_sources(session, sources)
    out_size = _Size().convert(size, None, None) if size else native
    limit = math.radians(float(values.get("theta_max_valid_deg", 180.0)))
    try:
        straight = undistort.straighten(
            lens,
            native,
            projection,
            out_size,
            balance=balance,
            fov=None if fov is None else math.radians(fov),
            theta_max=limit,
        )
    except ValueError as error:
        session.usage(str(error))
    with _Sink(session, target, out_size, rate or 10.0, sources) as sink:
        total = footage.count_pictures(sources, rate)
        for picture in session.progress(footage.pictures(sources, rate), total, "straightening"):
            if picture.image.shape[1::-1] != native:
                session.fail(
                    f"{picture.name} is {picture.image.shape[1]} × {picture.image.shape[0]} px, the camera "
                    f"{native[0]} × {native[1]} px"
                )
            with session.timing("straighten"):
                new = undistort.resample(picture.image, straight)
            with session.timing("write"):
                sink.write(picture, new)
    found = {
        "projection": projection,
        "fov_deg": math.degrees(straight.fov),
        "image_width_px": out_size[0],
        "image_height_px": out_size[1],
    }
    if projection == "perspective":
        found |= {
            "lens_model": "brown_conrady",
            "fx_px": straight.focal_px,
            "fy_px": straight.focal_px,
            "cx_px": (out_size[0] - 1) / 2,
            "cy_px": (out_size[1] - 1) / 2,
        }
    else:
        found["px_per_rad"] = straight.focal_px
    with session.output() as write:
        write(found)


class _Sink:
    """Where straightened pictures go: a folder, one picture, or a video."""

    def __init__(self, session, target: str, size, rate: float, sources):
        self.session, self.path, self.size, self.rate = session, Path(target), size, rate
        suffix = self.path.suffix.lower()
        self.video = suffix in _VIDEOS
        self.single = bool(suffix) and not self.video
        self.count = 0
        if self.single and (len(sources) != 1 or os.path.isdir(sources[0])):
            session.usage(f"--to {target} is one picture; several need a folder or a video")

    def __enter__(self):
        import contextlib

        from avcli.atomic import replacing

        self.stack = contextlib.ExitStack()
        if self.video:
            import cv2

            self.whole = self.stack.enter_context(replacing(self.path))
            self.temporary = self.whole.with_suffix(self.path.suffix)  # OpenCV looks at the extension
            fourcc = cv2.VideoWriter_fourcc(*_VIDEOS[self.path.suffix.lower()])
            self.writer = cv2.VideoWriter(str(self.temporary), fourcc, self.rate, self.size)
            if not self.writer.isOpened():
                self.session.fail(f"{self.path}: this OpenCV cannot write such a video")
        elif not self.single:
            self.path.mkdir(parents=True, exist_ok=True)
        return self

    def write(self, picture, image):
        import cv2
        import numpy as np

        from avcli.atomic import write_bytes

        self.count += 1
        if image.ndim == 3:
            image = image[:, :, [2, 1, 0, 3][: image.shape[2]]]
        image = np.ascontiguousarray(image)
        if self.video:
            if image.dtype == np.uint16:
                image = (image >> 8).astype(np.uint8)
            self.writer.write(image[:, :, :3] if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
            return
        if self.single and self.count > 1:
            self.session.usage(f"--to {self.path} is one picture; this source has several")
        if self.single:
            path = self.path
        else:
            stem = Path(picture.name).stem if os.path.exists(picture.name) else f"frame_{picture.timestamp:.10f}"
            path = self.path / f"{stem}.png"
        try:
            coded, content = cv2.imencode(path.suffix, image)
        except cv2.error:
            coded = False
        if not coded:
            self.session.usage(f"{path}: no kind of picture that can be written")
        write_bytes(path, content.tobytes())

    def __exit__(self, kind, error, trace):
        if self.video:
            self.writer.release()
            if kind is None and self.temporary.exists():
                os.replace(self.temporary, self.whole)
            self.temporary.unlink(missing_ok=True)
        return self.stack.__exit__(kind, error, trace)


# --- pose -------------------------------------------------------------------------------------------------------------


@click.command("pose")
@click.argument("sources", nargs=-1, metavar="[SOURCE]...")
@click.option(
    "--points",
    metavar="FILE",
    help="CSV with a header u,v,x,y,z: pixels and the room points in metres that are seen there.",
)
@click.option(
    "--board",
    "board_text",
    metavar="COLSxROWS",
    default="7x10",
    show_default=True,
    help="Squares of the board that lies on the floor in the pictures.",
)
@click.option(
    "--square",
    type=click.FloatRange(min=0, min_open=True),
    default=95.0,
    show_default=True,
    metavar="MM",
    help="Side of a square in mm, as measured on the print.",
)
@click.option("--charuco", is_flag=True, help="The board is a ChArUco board.")
@click.option(
    "--at",
    nargs=3,
    type=float,
    metavar="X Y Z",
    help="Room position in m of the board's middle.",
)
@click.option(
    "--yaw",
    type=float,
    default=0.0,
    show_default=True,
    metavar="DEG",
    help="Direction in which the board's rows run, in degrees from +x, counter-clockwise seen from above.",
)
@click.option(
    "--rate",
    type=click.FloatRange(min=0, min_open=True),
    default=2.0,
    show_default=True,
    metavar="HZ",
    help="Pictures a second to take from a video or a camera.",
)
@click.option(
    "--sigma",
    type=click.FloatRange(min=0, min_open=True),
    metavar="PX",
    help="Standard deviation of a pixel, for the covariance.  [default: from the residuals]",
)
@common()
def pose_command(session, sources, points, board_text, square, charuco, at, yaw, rate, sigma):
    """Find where a calibrated camera hangs in the room and how it is turned, with its covariance.

    From a board that lies face up at a known place, or from pixels whose room points were measured.
    """
    import numpy as np

    from avcli import pose
    from avcli.calibration import place

    lens, size, values = _known_camera(session)
    if bool(points) == bool(sources):
        session.usage("give either pictures of a board on the floor (with --at X Y Z), or --points FILE")
    if points:
        pixels, room = _read_points(session, points)
        choices = [(pixels, room)]
    else:
        if not at:
            session.usage("--at X Y Z is needed: where the middle of the board lies")
        choices = _board_points(session, sources, board_text, square, charuco, at, yaw, rate, size)
    found = [place.locate(lens, *choice, sigma) for choice in choices]
    best = found[0]
    if len(found) == 2:
        best = _chosen(session, found, values)
    covariance = best.covariance
    position = best.T_room_camera[:3, 3]
    off = 1000 * np.sqrt(np.trace(covariance[3:, 3:]))
    session.warn(
        f"the camera hangs at {_shown(position)} m ± {off:.1f} mm, residual {best.rms_px:.2f} px of "
        f"{len(best.residuals)} points"
    )
    bad = np.linalg.norm(best.residuals, axis=1) > max(5.0, 4 * np.median(np.linalg.norm(best.residuals, axis=1)))
    if bad.any():
        session.warn(f"points that do not fit, counted from 1: {', '.join(map(str, np.flatnonzero(bad) + 1))}")
    from avcli.commands.avcalib import _write_camera

    result = {
        "camera_position_m": position.tolist(),
        "camera_rotation_deg": pose.camera_rotation_deg(best.T_room_camera).tolist(),
        "pose_covariance": covariance.tolist(),
        "pose_rms_px": best.rms_px,
    }
    if session.output_path != "-":
        with session.output() as write:
            write({**values, **result})
        return
    _write_camera(session, result)


def _shown(position) -> str:
    return f"[{', '.join(f'{value:.4f}' for value in position)}]"


def _read_points(session, path):
    import csv
    import io

    import numpy as np

    with session.open(path) as stream:
        text = stream.read().decode("utf-8-sig", "replace")
    rows = list(csv.DictReader(io.StringIO(text)))
    try:
        table = np.array([[float(row[key]) for key in ("u", "v", "x", "y", "z")] for row in rows]).reshape(-1, 5)
    except (KeyError, TypeError, ValueError) as error:
        session.fail(f"{path}: expected a header u,v,x,y,z and numbers below it ({error})")
    if not np.isfinite(table).all():
        session.fail(f"{path}: a number is not finite")
    return table[:, :2], table[:, 2:]


def _board_points(session, sources, board_text, square, charuco, at, yaw, rate, size):
    """Pixels and room points of all corners in all pictures; twice where the board may be read upside down."""
    import numpy as np

    from avcli.calibration import place
    from avcli.commands.avcalib import _board, _check_sources, _collect, _nothing_found

    board = _board(session, board_text, square, charuco)
    seen = _collect(session, _check_sources(session, sources), board, rate)
    if not seen.views:
        _nothing_found(session, seen)
    if seen.size != size:
        session.fail(f"the pictures are {seen.size[0]} × {seen.size[1]} px, the camera {size[0]} × {size[1]} px")
    board = seen.board
    room = place.board_on_floor(board.points, np.array(at), np.deg2rad(yaw))
    pixels = np.concatenate([view.pixels for view in seen.views])
    upright = (pixels, np.concatenate([room[view.ids] for view in seen.views]))
    if board.markers or board.columns % 2 != board.rows % 2:
        return [upright]
    return [upright, (pixels, np.concatenate([room[::-1][view.ids] for view in seen.views]))]


def _chosen(session, found, values):
    """Of the two poses that a board of half-turn symmetry leaves, the one nearer to what the config says."""
    import numpy as np

    from avcli import pose

    known = values.get("camera_position_m")
    if known is None:
        session.warn(
            "this board looks the same upside down, so that the camera may also hang at "
            f"{_shown(found[1].T_room_camera[:3, 3])} m: state camera_position_m roughly, or use a board with one odd "
            "and one even count"
        )
        return found[0]
    T = pose.camera_pose(known, values.get("camera_rotation_deg", [90.0, 0.0, 0.0]))
    return min(found, key=lambda one: float(np.abs(one.T_room_camera - T).sum()))


# --- microphones ------------------------------------------------------------------------------------------------------


@click.command("microphones")
@click.argument("tracks", metavar="TRACKS")
@click.option(
    "--audio",
    multiple=True,
    metavar="FILE",
    help="Sound with a channel a microphone, from time 0 on; may be repeated for what follows.  "
    "[default: DIR/audio/wav, each from the time in its name]",
)
@click.option(
    "--mouth-height",
    type=click.FloatRange(0.3, 2.2),
    default=1.6,
    show_default=True,
    metavar="M",
    help="Height of the mouth in m, where the records do not say where it is.",
)
@click.option("--write", "write_config", is_flag=True, help="Write the found positions into config.json.")
@common()
def microphones_command(session, tracks, audio, mouth_height, write_config):
    """Check microphone positions and the clock between sound and picture by a person who walks and talks.

    TRACKS are records with one person in the room (tracks, or ground truth). Says for each microphone how far it seems
    to hang from where it was measured, and how sure that is.
    """
    import numpy as np

    from avcli import records
    from avcli.calibration import microphones

    path_times, path = [], []
    for record in session.records([tracks], lambda record, bad: (record, records.identified(record, bad))):
        raw, people = record
        if len(people) == 1:
            item = raw["objects"][0]
            path_times.append(people.timestamp)
            path.append(item.get("mouth_position") or [*people.positions[0][:2], np.nan])
    path_times, path = np.array(path_times), np.array(path, float).reshape(-1, 3)
    order = np.argsort(path_times, kind="stable")
    path_times, path = path_times[order], _mouths(path_times[order], path[order], mouth_height)
    array = session.config.microphones
    with session.timing("delays"):
        heard = _heard(session, audio, array, session.config.room.speed_of_sound_m_s)
    with session.timing("fit"):
        result = microphones.align(heard, path_times, path, array.positions, session.config.room.speed_of_sound_m_s)
    _report_microphones(session, result)
    record = {
        "clock_offset_s": result.clock_offset,
        "clock_offset_sd_s": result.clock_offset_sd,
        "delay_residual_s": result.residual_s,
        "held_out_given_s": result.held_out_given_s,
        "held_out_found_s": result.held_out_s,
        "microphones": [
            {"position": p.tolist(), "shift_m": s.tolist(), "sd_m": np.sqrt(np.diag(c)).tolist()}
            for p, s, c in zip(result.positions, result.shifts, result.covariances, strict=True)
        ],
    }
    with session.output() as write:
        write(record)
    if write_config:
        _write_microphones(session, result)


def _mouths(times, path, height):
    """Put a mouth 0.1 m ahead of the body's axis, at a height, where the records say only where the body is."""
    import numpy as np

    bare = ~np.isfinite(path[:, 2])
    if bare.any() and len(path) > 1:
        step = np.gradient(path[:, :2], times, axis=0)
        speed = np.linalg.norm(step, axis=1, keepdims=True)
        ahead = np.where(speed > 0.2, 0.1 * step / np.maximum(speed, 1e-9), 0.0)
        path[bare, :2] += ahead[bare]
    path[bare, 2] = height
    return path


def _heard(session, audio, array, speed):
    """Delays between the microphones in windows of 93 ms, every 50 ms."""
    import numpy as np

    from avcli.calibration.microphones import Heard
    from avcli.localization import correlation

    first, second = correlation.pairs(len(array.positions))
    distance = np.linalg.norm(array.positions[first] - array.positions[second], axis=1)
    times, delays = [], []
    for start, samples, rate in _sounds(session, audio):
        if samples.shape[1] != len(array.positions):
            session.fail(f"the sound has {samples.shape[1]} channels, config.json {len(array.positions)} microphones")
        samples = correlation.high_pass(samples, rate, 200.0)
        size, hop, finer = 1 << round(np.log2(0.093 * rate)), round(0.05 * rate), 4
        lags = min(int(np.ceil((distance.max() + 0.3) / speed * rate * finer)), size * finer // 2 - 1)
        frequency = np.fft.rfftfreq(size, 1 / rate)
        band = slice(*np.searchsorted(frequency, [300.0, min(8000.0, 0.45 * rate)]).tolist())
        window = correlation.hann(size)
        begins = np.arange(0, len(samples) - size + 1, hop)
        power = np.array([np.mean(samples[b : b + size] ** 2) for b in begins])
        loud = power > max(0.05 * np.quantile(power, 0.95), 1e-12) if len(power) else []
        for begin in begins[loud]:
            spectra = np.fft.rfft(samples[begin : begin + size] * window[:, None], axis=0).T[:, band]
            gcc = correlation.gcc(correlation.whiten(spectra, 1.0), band, size, lags, finer)
            reach = np.minimum(np.ceil((distance + 0.3) / speed * rate * finer).astype(int), lags)
            outside = np.abs(np.arange(-lags, lags + 1))[None] > reach[:, None]
            gcc = np.where(outside, -1.0, gcc)
            at = np.clip(gcc.argmax(1), 1, 2 * lags - 1)
            p = np.arange(len(at))
            peak = gcc[p, at]
            shift = correlation.interpolate_peak(gcc[p, at - 1], peak, gcc[p, at + 1])
            delay = (at - lags + shift) / (finer * rate)
            noise = np.sqrt(np.mean(np.where(outside, 0.0, gcc) ** 2, axis=1))
            times.append(start + (begin + size / 2) / rate)
            delays.append(np.where(peak > 5 * noise, delay, np.nan))
    return Heard(np.array(times), np.array(delays).reshape(-1, len(first)), first, second)


def _sounds(session, audio):
    """Yield (start in s, samples (n, channels), Hz) of each sound file."""
    from avcli import media

    if audio:
        start = 0.0
        for path in audio:
            if not os.path.exists(path):
                session.usage(f"{path}: no such file")
            samples, rate = media.read_audio(path)
            yield start, samples, rate
            start += len(samples) / rate
        return
    folder = session.experiment / "audio" / "wav"
    files = sorted(folder.glob("multichannel_audio_*")) if folder.is_dir() else []
    if not files:
        session.usage(f"no sound in {folder}: name it with --audio")
    for path in files:
        samples, rate = media.read_audio(path)
        yield float(path.stem.rsplit("_", 1)[1]), samples, rate


def _report_microphones(session, result):
    import numpy as np

    session.warn(
        f"clock: picture time = sound time {result.clock_offset:+.4f} s ± {result.clock_offset_sd:.4f} s; "
        f"{result.windows} windows, delays within {1e6 * result.residual_s:.0f} µs, {100 * result.used:.0f} % fit"
    )
    for number, (shift, covariance) in enumerate(zip(result.shifts, result.covariances, strict=True), 1):
        size, sd = float(np.linalg.norm(shift)), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        sure = float(shift @ np.linalg.solve(covariance, shift)) > 16.3  # chi-square, 3 degrees of freedom, 0.1 %
        say = "hangs elsewhere" if sure and size > 0.01 else "as measured"
        session.warn(f"microphone {number}: {say}, shift {1000 * size:.0f} mm ± {1000 * sd:.0f} mm at worst")
    better = "explain" if result.improves else "do not explain"
    found, given = 1e6 * result.held_out_s, 1e6 * result.held_out_given_s
    session.warn(
        f"the found positions {better} better what took no part: {found:.0f} µs, the given ones {given:.0f} µs"
    )


def _write_microphones(session, result):
    import copy

    from avcli import experiment

    if not result.improves:
        session.warn("config.json is left as it was: the found positions are no better than those in it")
        return
    raw = copy.deepcopy(dict(session.config.raw))
    listed = raw["microphone_config"]["mic_positions_m"]
    for i, position in enumerate(result.positions.tolist()):
        if isinstance(listed[i], dict):
            listed[i]["position"] = position
        else:
            listed[i] = position
    experiment.write_config(session.config_path, raw)
