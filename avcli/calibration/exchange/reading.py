"""Cameras out of the files of each tool. Every function takes the text, the file's name and `fisheye` (see `read`)."""

import ast
import re
from collections.abc import Iterable, Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np
import orjson

from avcli import pose
from avcli.calibration.exchange import nearest
from avcli.calibration.exchange.cameras import COLMAP, KALIBR, KNOWN, OPENCV, ROS, Camera, Choice
from avcli.calibration.exchange.nearest import Projection, Splined
from avcli.formats import experiment, yaml
from avcli.lens import LENSES


def _numbers(value: Any, count: int | None = None) -> np.ndarray:
    """A matrix of a file, however it is written, as a flat array."""
    if isinstance(value, Mapping):
        value = value["data"]
    array = np.array(value if value is not None else [], float).ravel()
    if count is not None and array.size != count:
        raise ValueError(f"expected {count} numbers, found {array.size}")
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array


def _core(matrix: Any) -> np.ndarray:
    K = _numbers(matrix, 9).reshape(3, 3)
    if K[0, 1]:
        raise ValueError(f"the camera matrix has a skew of {K[0, 1]:g} px, which avcli does not know")
    return K[[0, 1, 0, 1], [0, 1, 2, 2]]


def _size(width: Any, height: Any) -> tuple[int, int] | None:
    if width is None or height is None:
        return None
    if not (int(width) > 0 and int(height) > 0):
        raise ValueError(f"the picture's size {width} x {height} is impossible")
    return int(width), int(height)


def _choice(choices: Iterable[Choice], name: str) -> Choice:
    for choice in choices:
        if choice.name == name:
            return choice
    raise ValueError(f"the lens model {name} is not known here")


def _opencv_lens(core: np.ndarray, d: np.ndarray) -> Projection:
    """The lens of OpenCV's plain model with 0, 4, 5, 8, 12 or 14 coefficients."""
    if d.size not in (0, 1, 4, 5, 8, 12, 14):
        raise ValueError(f"OpenCV's distortion has 4, 5, 8, 12 or 14 coefficients, found {d.size}")
    if d[8:].any():
        return nearest.opencv_extended(core, np.pad(d, (0, 14 - d.size)))
    full = np.pad(d, (0, max(0, 8 - d.size)))
    return _choice(OPENCV, "rational" if full[5:8].any() else "plain").lens(
        core, full[:8] if full[5:8].any() else full[:5]
    )


def avcli(text: str, name: str, fisheye: bool | None) -> list[Camera]:
    """The camera of a config.json, or of the line that `avcalib calibrate` writes."""
    raw = orjson.loads(text)
    values = raw.get("camera_config", raw)
    width, height = int(values.get("image_width_px", 1920)), int(values.get("image_height_px", 1080))
    lens = experiment.lens_from_config(values, name=name, width_px=width, height_px=height)
    place = None
    if values.get("camera_position_m") is not None:
        place = pose.camera_pose(values["camera_position_m"], values.get("camera_rotation_deg", [90, 0, 0]))
    known = {key: values[key] for key in KNOWN if values.get(key) is not None}
    found = values.get("calibration")
    moves = isinstance(found, Mapping) and bool(found.get("pupil_m"))
    lost = ["the standard deviations of the parameters"] * (found is not None) + ["how its centre moves"] * moves
    return [Camera(lens, (width, height), "camera", known, place, tuple(lost))]


_MATRIX_KEY = re.compile(r"(?i)(camera_?matrix|intrinsic_?matrix|intrinsics|mtx|K|M)[_ ]?(\w*)")
_DISTORTION_KEY = re.compile(r"(?i)(distortion_?(?:coefficients|coeffs)?|dist_?(?:coeffs?|coef)?|D)[_ ]?(\w*)")


def opencv(text: str, name: str, fisheye: bool | None) -> list[Camera]:
    """The cameras of a FileStorage in YAML, XML or JSON: each camera matrix with its distortion."""
    start = text.lstrip()[:1]
    if start == "<":
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("XML with a document type is refused")
        values = {child.tag: _of_xml(child) for child in ElementTree.fromstring(text)}
    else:
        values = orjson.loads(text) if start == "{" else yaml.parse(text, name)
    if not isinstance(values, Mapping):
        raise ValueError("expected names and values")
    matrices = {m[2]: v for key, v in values.items() if (m := _MATRIX_KEY.fullmatch(key)) and _is_matrix(v)}
    bends = {
        m[2]: value for key, value in values.items() if (m := _DISTORTION_KEY.fullmatch(key)) and _is_matrix(value)
    }
    lowered = {key.lower(): value for key, value in values.items()}
    size = _size(lowered.get("image_width"), lowered.get("image_height"))
    if size is None and _is_matrix(lowered.get("image_size", lowered.get("imagesize"))):
        size = _size(*_numbers(lowered.get("image_size", lowered.get("imagesize")), 2))
    said = lowered.get("fisheye_model", lowered.get("fisheye"))
    is_fisheye = bool(int(said)) if said is not None else fisheye
    cameras = []
    for suffix, matrix in matrices.items():
        d = _numbers(bends.get(suffix))
        if d.size == 4 and is_fisheye is None:
            raise ValueError(
                "four distortion coefficients are of OpenCV's fisheye or of its plain model, and the file does not say "
                "which; give --fisheye or --no-fisheye"
            )
        core = _core(matrix)
        lens = _choice(OPENCV, "fisheye").lens(core, d) if is_fisheye and d.size == 4 else _opencv_lens(core, d)
        cameras.append(Camera(lens, size, f"camera{suffix}"))
    return cameras


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) or (isinstance(value, Mapping) and "data" in value)


def _of_xml(element: ElementTree.Element) -> Any:
    if len(element):
        inside = {child.tag: _of_xml(child) for child in element}
        if isinstance(inside.get("data"), str):
            inside["data"] = [float(v) for v in inside["data"].split()]
        return inside
    text = (element.text or "").strip()
    return text if not re.fullmatch(r"[-+0-9.eE\s]+", text) or " " in text else float(text)


def ros(text: str, name: str, fisheye: bool | None) -> list[Camera]:
    """The camera of a camera_info: a file of camera_calibration_parsers, or a printed message."""
    values = {key.lower(): value for key, value in yaml.parse(text, name).items()}
    core = _core(values.get("camera_matrix", values.get("k")))
    d = _numbers(values.get("distortion_coefficients", values.get("d")))
    model = str(values["distortion_model"])
    if model in ("equidistant", "fisheye", "kannala_brandt4"):
        lens: Projection = _choice(ROS, "equidistant").lens(core, np.pad(d, (0, max(0, 4 - d.size)))[:4])
    elif model in ("plumb_bob", "rational_polynomial", "thin_prism", "none", ""):
        lens = _opencv_lens(core, d)
    else:
        raise ValueError(f"ROS's distortion model {model!r} is not known here")
    width, height = (values.get(f"image_{side}", values.get(side)) for side in ("width", "height"))
    if values.get("binning_x", 0) not in (0, 1, None):
        raise ValueError("the camera_info is of binned pictures; convert that of the full ones")
    return [Camera(lens, _size(width, height), str(values.get("camera_name") or "camera"))]


def kalibr(text: str, name: str, fisheye: bool | None) -> list[Camera]:
    """The cameras of a camchain."""
    cameras = []
    for key, values in yaml.parse(text, name).items():
        if not re.fullmatch(r"cam\d+", str(key)):
            continue
        model, bend = str(values["camera_model"]), str(values.get("distortion_model") or "none")
        numbers, d = _numbers(values["intrinsics"]), _numbers(values.get("distortion_coeffs"))
        lost = ("where the camera sits on its rig",) if any(k.startswith("T_") for k in values) else ()
        lens = _kalibr_lens(model, bend, numbers, d)
        cameras.append(Camera(lens, _size(*_numbers(values["resolution"], 2)), key, lost=lost))
    return cameras


def _kalibr_lens(model: str, bend: str, numbers: np.ndarray, d: np.ndarray) -> Projection:
    extra, core = numbers[:-4], numbers[-4:]
    if {"pinhole": 4, "omni": 5, "ds": 6, "eucm": 6}.get(model) != numbers.size:
        raise ValueError(f"Kalibr's camera model {model} with {numbers.size} intrinsics is not known here")
    if model == "pinhole" and bend == "fov":
        return nearest.fov(core, float(d[0]))
    if model == "pinhole" and bend in ("radtan", "equidistant", "equi"):
        return _choice(KALIBR, "pinhole-radtan" if bend == "radtan" else "pinhole-equidistant").lens(core, d)
    if model == "omni" and bend in ("radtan", "none"):
        if not d.any():
            xi = float(extra[0])
            scale = np.array([1 + xi, 1 + xi, 1, 1])
            return LENSES["ucm"].of_image([*(core / scale), xi / (1 + xi)], 0, 0)
        return nearest.omni(core, float(extra[0]), np.pad(d, (0, 4 - d.size)))
    if bend == "none" or not d.any():
        return (
            _choice(OPENCV, "plain").lens(core, ())
            if model == "pinhole"
            else _choice(KALIBR, f"{model}-none").lens(core, extra)
        )
    raise ValueError(f"Kalibr's model {model}-{bend} is not known here")


COLMAP_LINE = re.compile(r"^\s*(\d+)\s+([A-Z][A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+0-9.eE]+)+)\s*$", re.MULTILINE)
_COLMAP_SHORT = {  # fewer parameters than the models that we write; f stands for both focal lengths
    "SIMPLE_PINHOLE": ("PINHOLE", ("f", "cx", "cy")),
    "SIMPLE_RADIAL": ("OPENCV", ("f", "cx", "cy", "k1")),
    "RADIAL": ("OPENCV", ("f", "cx", "cy", "k1", "k2")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("f", "cx", "cy", "k1", "k2")),
    "SIMPLE_FISHEYE": ("OPENCV_FISHEYE", ("f", "cx", "cy")),
    "FISHEYE": ("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy")),
}


def colmap(text: str, name: str, fisheye: bool | None) -> list[Camera]:
    """The cameras of a cameras.txt."""
    cameras = []
    for number, model, width, height, rest in COLMAP_LINE.findall(text):
        lens = _colmap_lens(model, np.array(rest.split(), float))
        cameras.append(Camera(lens, _size(width, height), number))
    return cameras


def _colmap_lens(model: str, numbers: np.ndarray) -> Projection:
    if model in _COLMAP_SHORT:
        model, names = _COLMAP_SHORT[model]
        given = dict(zip(names, numbers.tolist(), strict=True))
        numbers = np.array([given.get("fx", given.get("f")), given.get("fy", given.get("f")), given["cx"], given["cy"],
                            *(given.get(name, 0.0) for name in _choice(COLMAP, model).names)])  # fmt: skip
    core, d = numbers[:4] - [0, 0, 0.5, 0.5], numbers[4:]
    if model == "FOV":
        return nearest.fov(core, float(d[0]))
    if model == "EUCM":
        return _choice(KALIBR, "eucm-none").lens(core, _numbers(d, 2))
    if model == "FULL_OPENCV":
        return _opencv_lens(core, _numbers(d, 8))
    choice = _choice(COLMAP, model)
    if d.size < len(choice.names):
        raise ValueError(f"the model {model} has {4 + len(choice.names)} parameters, found {numbers.size}")
    return choice.lens(core, d)


def mrcal(text: str, name: str, fisheye: bool | None) -> list[Camera]:
    """The camera of a .cameramodel."""
    values = ast.literal_eval(text)
    model, numbers = str(values["lensmodel"]), _numbers(values["intrinsics"])
    core, d = numbers[:4], numbers[4:]
    size = _size(*_numbers(values["imagersize"], 2))
    if match := re.fullmatch(r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+)", model):
        columns, rows, fov_deg = (int(g) for g in match.groups())
        lens: Projection = Splined(core, _numbers(d, 2 * columns * rows).reshape(rows, columns, 2), fov_deg)
    elif model == "LENSMODEL_STEREOGRAPHIC":
        lens = LENSES["ucm"].of_image([*core, 0.5], 0, 0)  # 2 tan(theta / 2) = sin / (0.5 + 0.5 cos)
    elif re.fullmatch(r"LENSMODEL_(PINHOLE|OPENCV(4|5|8|12))", model):
        lens = _opencv_lens(core, d)
    else:
        raise ValueError(f"mrcal's {model} is not known here")
    turn = values.get("rt_cam_ref", values.get("extrinsics"))
    place = None
    if turn is not None and np.any(_numbers(turn, 6)):
        place = pose.inverse(
            pose.transform(pose.rotation_from_vector(_numbers(turn, 6)[None, :3])[0], _numbers(turn, 6)[3:])
        )
    limits = _region_limit(lens, size, values.get("valid_intrinsics_region"))
    lost = ("mrcal's observations",) if "optimization_inputs" in values else ()
    return [Camera(lens, size, "camera", limits, place, lost)]


def _region_limit(lens: Projection, size: tuple[int, int] | None, region: Any) -> dict[str, float]:
    """The angle up to which all pixels lie in mrcal's region of valid intrinsics."""
    if size is None or region is None or len(region) < 3:
        return {}
    corners = np.array(region, float)
    try:
        seen = nearest.sampled(lens, size)
    except ValueError:
        return {}
    inside = _is_inside(seen.pixels, corners)
    if inside.all() or not inside.any():
        return {}
    return {"theta_max_observed_deg": float(np.rad2deg(seen.angles[~inside].min()))}


def _is_inside(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Which points (n, 2) lie in a polygon (m, 2): those from which a ray to the right meets its border oddly often."""
    x, y = points.T
    inside = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside
