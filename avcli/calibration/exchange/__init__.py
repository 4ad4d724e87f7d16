"""Cameras in the files of other tools: OpenCV, ROS, Kalibr, COLMAP and mrcal, both ways.

Pixel (0, 0) is the centre of the top-left pixel in avcli, OpenCV, ROS, Kalibr and mrcal. COLMAP puts (0.5, 0.5) there.
What a format has no place for, and what is known of the limits, stands in comments; `read` understands them again.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import orjson

from avcli.calibration.exchange import nearest, reading, writing
from avcli.calibration.exchange.cameras import AVCLI, COLMAP, KALIBR, KNOWN, MRCAL, OPENCV, ROS, Camera, Choice
from avcli.calibration.exchange.nearest import Projection, Splined
from avcli.lens import Lens

_NOTED = re.compile(rf"\b({'|'.join(KNOWN)}): (\[[^\]]*\]|[0-9.]+)")
_LARGEST = 64 << 20
"""bytes; mrcal puts all its observations into its files."""


class NotConvertible(ValueError):
    """A camera cannot be written as asked; the message says why."""


@dataclass(frozen=True)
class Format:
    """A tool's format.

    Attributes:
        text: what it is, in a few words.
        sign: a regular expression that its files match and those of the formats after it in FORMATS may match too.
        read: takes the text, the file's name and `fisheye`.
        write: takes the camera, the choice, the lens, the notes, the field and `xml`.
        choices: the lens models that can be written, the simplest first.
        endings: of file names, which tell the format of a file that is to be written.
        has_pose: whether the file says where the camera is.
        spline: whether mrcal's splined model can be written.
    """

    text: str
    sign: str
    read: Callable[[str, str, bool | None], list[Camera]]
    write: Callable[[Camera, Choice, Any, list[str], nearest.Samples, bool], str]
    choices: tuple[Choice, ...]
    endings: tuple[str, ...] = ()
    has_pose: bool = False
    spline: bool = False


FORMATS: dict[str, Format] = {
    "mrcal": Format(
        "mrcal's .cameramodel", r"\bLENSMODEL_", reading.mrcal, writing.mrcal, MRCAL, (".cameramodel",), True, True
    ),
    "colmap": Format(
        "COLMAP's cameras.txt", reading.COLMAP_LINE.pattern, reading.colmap, writing.colmap, COLMAP, ("cameras.txt",)
    ),
    "kalibr": Format(
        "Kalibr's camchain", r"^\s+camera_model\s*:", reading.kalibr, writing.kalibr, KALIBR, ("camchain.yaml",)
    ),
    "ros": Format("ROS's camera_info", r"^distortion_model\s*:", reading.ros, writing.ros, ROS),
    "avcli": Format("a camera_config", r'"fx_px"', reading.avcli, writing.avcli, AVCLI, (".json",), True),
    "opencv": Format(
        "OpenCV's YAML or XML",
        r"opencv[-_](matrix|storage)|^\W*(camera_?matrix|camera_?intrinsics|K)\W*:",
        reading.opencv,
        writing.opencv,
        OPENCV,
        (".xml", ".yml", ".yaml"),
    ),
}
"""The formats by name, in the order in which a file is compared with them."""


def read(content: bytes, name: str, fisheye: bool | None = None) -> tuple[str, list[Camera]]:
    """Read the cameras of a file of any known format; which format it has follows from what stands in it.

    Args:
        content: of the file.
        name: of the file, for errors.
        fisheye: whether four coefficients that OpenCV wrote are those of its fisheye, where the file does not say.

    Returns:
        The format's name in FORMATS, and the cameras.

    Raises:
        ValueError: the format is not recognised, or something is missing or wrong in the file.
    """
    if len(content) > _LARGEST:
        raise ValueError(f"{name}: longer than {_LARGEST >> 20} MiB, which is no camera file")
    try:
        text = content.decode()
    except UnicodeDecodeError:
        raise ValueError(f"{name}: no text; a camera file of {', '.join(FORMATS)} is expected") from None
    for kind, form in FORMATS.items():
        if re.search(form.sign, text, re.MULTILINE | re.IGNORECASE):
            try:
                cameras = form.read(text, name, fisheye)
            except (KeyError, IndexError, TypeError, AttributeError) as error:
                what = f"{error} is missing" if isinstance(error, KeyError) else "it is not laid out as expected"
                raise ValueError(f"{name}: looks like a file of {kind}, but {what}") from None
            except (ValueError, SyntaxError, ElementTree.ParseError, RecursionError) as error:
                said = str(error)
                raise ValueError(said if said.startswith(f"{name}:") else f"{name}: {said}") from None
            if not cameras:
                raise ValueError(f"{name}: looks like a file of {kind}, but has no camera in it")
            noted = {key: orjson.loads(value) for key, value in _NOTED.findall(text)}
            return kind, [replace(camera, known={**camera.known, **noted}) for camera in cameras]
    raise ValueError(f"{name}: is no camera file of {', '.join(FORMATS)}")


class Written(NamedTuple):
    """A camera in another format.

    text: of the file; config: the same as keys of a camera_config, where that is the format. model: the tool's name of
    the lens model. rms_px, max_px: distance from the camera over the field up to theta, rad. lost: what has no place.
    """

    text: str
    config: dict[str, Any]
    model: str
    rms_px: float
    max_px: float
    theta: float
    lost: tuple[str, ...]

    @property
    def said(self) -> str:
        """How near the lens is, in words."""
        if not self.max_px:
            return "exactly the same lens"
        angle = f"up to {np.rad2deg(self.theta):.1f} degrees from the axis"
        return f"the nearest lens: {self.rms_px:.2g} px RMS and at most {self.max_px:.2g} px away, {angle}"


def write(camera: Camera, kind: str, *, xml: bool = False, model: str | None = None) -> Written:
    """Write a camera in a format.

    The first model of the format that has exactly the camera's lens is taken, else the one that comes nearest over the
    field that is known: the picture up to the angle to which the lens is known.

    Args:
        camera: with its picture's size.
        kind: a name in FORMATS.
        xml: XML in place of YAML, for OpenCV.
        model: the only lens model to take, by the tool's name for it; mrcal's "splined" is one.

    Raises:
        NotConvertible: no model of the format images the whole field.
        ValueError: the lens images no pixel, the size is not known, or the format has no such model.
    """
    if camera.size is None:
        raise ValueError("the size of the camera's pictures is not known")
    form = FORMATS[kind] if model is None else _only(FORMATS[kind], model)
    seen = nearest.sampled(camera.lens, camera.size, camera.theta_max)
    choice, lens, rms, largest = _best(camera, form, seen)
    lost = (*camera.lost, *(("its pose",) if camera.T_reference_camera is not None and not form.has_pose else ()))
    found = Written("", {}, choice.name, rms, largest, seen.theta, lost)
    notes = [
        f"{choice.name}, written by avcalib convert from a lens of the model {camera.model}",
        found.said,
        *(f"{key}: {orjson.dumps(value).decode()}" for key, value in camera.known.items()),
    ]
    if kind == "avcli" and isinstance(lens, Lens):
        found = found._replace(config=writing.config(camera, lens))
    return found._replace(text=form.write(camera, choice, lens, notes, seen, xml))


def words(camera: Camera, found: Written, kind: str) -> list[str]:
    """What a user should know of a conversion, one sentence each."""
    lines = [f"{camera.model} → {found.model}: {found.said}"]
    if found.lost:
        lines.append(f"not in the new file: {', '.join(found.lost)}")
    if kind == "avcli" and "theta_max_observed_deg" not in camera.known:
        lines.append("the file does not say up to which angle the lens was seen; far from the axis it may be a guess")
    return lines


def _only(form: Format, model: str) -> Format:
    """A format with one of its lens models alone."""
    names = [choice.name.removeprefix("LENSMODEL_") for choice in form.choices]
    wanted = model.upper().removeprefix("LENSMODEL_")
    chosen = tuple(choice for choice, name in zip(form.choices, names, strict=True) if name.upper() == wanted)
    if not chosen and not (form.spline and wanted == "SPLINED"):
        known = ", ".join([*names, *(["splined"] if form.spline else [])])
        raise ValueError(f"{form.text} has no lens model {model!r} here; it has {known}")
    return replace(form, choices=chosen, spline=form.spline and wanted == "SPLINED")


def _best(camera: Camera, form: "Format", seen: nearest.Samples) -> tuple[Choice, Projection, float, float]:
    for choice in sorted(form.choices, key=lambda choice: choice.model != camera.model):
        exact = choice.same(camera.lens)
        if exact is not None:
            return choice, exact, 0.0, 0.0
    if form.spline and isinstance(camera.lens, Splined):
        return _spline_choice(camera.lens), camera.lens, 0.0, 0.0
    best: tuple[Choice, Projection, float, float] | None = None
    for choice in form.choices:
        lens, rms, largest = choice.nearest(camera.lens, seen)
        if best is None or rms < best[2]:
            best = choice, lens, rms, largest
    if form.spline and (best is None or not best[2] < 1e-3):
        spline, rms, largest = nearest.splined(camera.lens, seen)
        if best is None or rms < best[2]:
            best = _spline_choice(spline), spline, rms, largest
    if best is None or not np.isfinite(best[2]):
        names = ", ".join(choice.name for choice in form.choices)
        raise NotConvertible(
            f"a lens that is known up to {np.rad2deg(seen.theta):.0f} degrees from the axis ({camera.model}) is beyond "
            f"the models of this format ({names})"
        )
    return best


def _spline_choice(lens: Splined) -> Choice:
    rows, columns = lens.knots.shape[:2]
    return Choice(
        f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={columns}_Ny={rows}_fov_x_deg={lens.fov_deg}", "kannala_brandt", ()
    )
