"""Cameras into the text of each tool's files.

Every function takes the camera, the model of the tool, the lens in it, notes for comments, the field that is known, and
whether OpenCV is to get XML.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import orjson

from avcli import pose
from avcli.calibration.exchange import nearest
from avcli.calibration.exchange.cameras import Camera, Choice
from avcli.calibration.exchange.nearest import Projection, Splined
from avcli.lens import Lens, lens_config


def _listed(values: Iterable[float]) -> str:
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"


def _core_of(lens: Projection) -> list[float]:
    return [float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")]


def _matrix_of(lens: Projection) -> list[float]:
    fx, fy, cx, cy = _core_of(lens)
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def avcli(camera: Camera, choice: Choice, lens: Any, notes: list[str], seen: nearest.Samples, xml: bool) -> str:
    """A camera_config as one line."""
    return orjson.dumps(config(camera, lens), option=orjson.OPT_APPEND_NEWLINE).decode()


def config(camera: Camera, lens: Lens) -> dict[str, Any]:
    """The keys of camera_config of a camera whose lens was converted to `lens`."""
    assert camera.size is not None
    valid = min(float(np.rad2deg(lens.theta_max)), camera.known.get("theta_max_valid_deg", 180.0))
    known = {**camera.known, "theta_max_valid_deg": valid}
    found: dict[str, Any] = {
        **lens_config(lens), "image_width_px": camera.size[0], "image_height_px": camera.size[1], **known,
    }  # fmt: skip
    if camera.T_reference_camera is not None:
        found["camera_position_m"] = camera.T_reference_camera[:3, 3].round(10).tolist()
        found["camera_rotation_deg"] = (pose.camera_rotation_deg(camera.T_reference_camera).round(10) + 0.0).tolist()
    return found


def opencv(camera: Camera, choice: Choice, lens: Any, notes: list[str], seen: nearest.Samples, xml: bool) -> str:
    """A FileStorage with the names of OpenCV's calibration sample."""
    width, height = camera.size or (0, 0)
    d, fisheye = choice.values(lens), int(choice.name == "fisheye")
    plain = [("image_width", width), ("image_height", height), ("fisheye_model", fisheye)]
    matrices = [("camera_matrix", 3, 3, _matrix_of(lens)), ("distortion_coefficients", len(d), 1, d)]
    if xml:
        lines = [
            '<?xml version="1.0"?>',
            "<opencv_storage>",
            *(f"<!-- {note.replace('--', '- -')} -->" for note in notes),
        ]
        lines += [f"<{key}>{value}</{key}>" for key, value in plain]
        for key, rows, columns, data in matrices:
            numbers = " ".join(repr(float(v)) for v in data)
            lines.append(
                f'<{key} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{columns}</cols>\n  <dt>d</dt>\n'
                f"  <data>\n    {numbers}</data></{key}>"
            )
        return "\n".join([*lines, "</opencv_storage>", ""])
    lines = ["%YAML:1.0", "---", *(f"# {note}" for note in notes), *(f"{key}: {value}" for key, value in plain)]
    for key, rows, columns, data in matrices:
        lines += [
            f"{key}: !!opencv-matrix",
            f"   rows: {rows}",
            f"   cols: {columns}",
            "   dt: d",
            f"   data: {_listed(data)}",
        ]
    return "\n".join([*lines, ""])


def ros(camera: Camera, choice: Choice, lens: Any, notes: list[str], seen: nearest.Samples, xml: bool) -> str:
    """The YAML of camera_calibration_parsers."""
    width, height = camera.size or (0, 0)
    K, d = _matrix_of(lens), choice.values(lens)
    P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    lines = [
        *(f"# {note}" for note in notes),
        f"image_width: {width}",
        f"image_height: {height}",
        f"camera_name: {camera.name}",
    ]
    for key, rows, columns, data in (
        ("camera_matrix", 3, 3, K),
        ("distortion_coefficients", 1, len(d), d),
        ("rectification_matrix", 3, 3, np.eye(3).ravel()),
        ("projection_matrix", 3, 4, P),
    ):
        if key == "distortion_coefficients":
            lines.append(f"distortion_model: {choice.name}")
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {_listed(data)}"]
    return "\n".join([*lines, ""])


def kalibr(camera: Camera, choice: Choice, lens: Any, notes: list[str], seen: nearest.Samples, xml: bool) -> str:
    """A camchain of one camera."""
    width, height = camera.size or (0, 0)
    model, bend = choice.name.split("-")
    d = choice.values(lens)
    extra, d = (d, []) if bend == "none" else ([], d)
    lines = [
        *(f"# {note}" for note in notes),
        "cam0:",
        "  cam_overlaps: []",
        f"  camera_model: {model}",
        f"  distortion_coeffs: {_listed(d)}",
        f"  distortion_model: {bend}",
        f"  intrinsics: {_listed([*extra, *_core_of(lens)])}",
        f"  resolution: [{width}, {height}]",
        "  rostopic: /cam0/image_raw",
    ]
    return "\n".join([*lines, ""])


def colmap(camera: Camera, choice: Choice, lens: Any, notes: list[str], seen: nearest.Samples, xml: bool) -> str:
    """A cameras.txt of one camera."""
    width, height = camera.size or (0, 0)
    fx, fy, cx, cy = _core_of(lens)
    d = choice.values(lens)
    numbers = " ".join(repr(v) for v in (fx, fy, cx + 0.5, cy + 0.5, *d))
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        "# Number of cameras: 1",
        *(f"# {note}" for note in notes),
        f"{camera.name if camera.name.isdigit() else 1} {choice.name} {width} {height} {numbers}",
    ]
    return "\n".join([*lines, ""])


def mrcal(camera: Camera, choice: Choice, lens: Any, notes: list[str], seen: nearest.Samples, xml: bool) -> str:
    """A .cameramodel, whose reference frame is the room."""
    width, height = camera.size or (0, 0)
    if isinstance(lens, Splined):
        numbers = [*lens.core, *lens.knots.ravel()]
    else:
        numbers = [*_core_of(lens), *choice.values(lens)]
    turn = np.zeros(6)
    if camera.T_reference_camera is not None:
        T = pose.inverse(camera.T_reference_camera)
        turn = np.concatenate([pose.rotation_vector(T[:3, :3]), T[:3, 3]])
    region = _region(camera, seen)
    lines = [
        *(f"# {note}" for note in notes),
        "{",
        f"    'lensmodel': '{choice.name}',",
        f"    'intrinsics': {_listed(numbers)},",
        f"    'valid_intrinsics_region': [{', '.join(_listed(p) for p in region)}],",
        f"    'extrinsics': {_listed(turn)},",
        f"    'imagersize': [{width}, {height}],",
        "}",
    ]
    return "\n".join([*lines, ""])


def _region(camera: Camera, seen: nearest.Samples) -> np.ndarray:
    """The closed border (m, 2) px of the field that is known, cut at the picture's border."""
    azimuths = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    sine, top = np.sin(seen.theta * (1 - 1e-9)), np.cos(seen.theta * (1 - 1e-9))
    rays = np.stack([sine * np.cos(azimuths), sine * np.sin(azimuths), np.full(60, top)], -1)
    border = camera.lens.project(rays)
    border = border[np.isfinite(border).all(1)]
    border = np.clip(border, 0, np.array(camera.size) - 1)
    return np.concatenate([border, border[:1]]).round(2)
