"""Cameras in the files of other tools, read by those tools' own readers where they are installed."""

import functools
import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import conftest
import cv2
import numpy as np
import pytest

from avcli.calibration import exchange
from avcli.calibration.exchange import Camera, nearest
from avcli.formats import yaml
from avcli.lens import (
    LENSES,
    BrownConrady,
    KannalaBrandt,
    Lens,
    TangentialBrownConrady,
    TangentialKannalaBrandt,
    lens_config,
)

FISHEYE = KannalaBrandt(862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006)
ORDINARY = TangentialBrownConrady(1400.0, 1402.0, 950.5, 545.25, -0.21, 0.07, -0.01, p1=1e-3, p2=-5e-4)
SIZE = (1920, 1080)
SAMPLES: dict[str, Lens] = {
    "kannala_brandt": FISHEYE,
    "brown_conrady": ORDINARY,
    "fisheye not centred": TangentialKannalaBrandt(600, 601, 955, 540, 0.02, -0.003, 1e-3, -2e-4, p1=8e-4, p2=-5e-4),
    "fisheye behind a prism": TangentialKannalaBrandt(600, 601, 955, 540, 0.02, -0.003, 0, 0, 8e-4, -5e-4, 2e-3, -1e-3),
    "rational": LENSES["rational"](900, 901, 955, 540, 0.3, 0.05, 0.01, 0.6, 0.12, 0.02, 1e-3, -2e-3),
    "double_sphere": LENSES["double_sphere"](600, 601, 955, 540, -0.2, 0.6),
    "eucm": LENSES["eucm"](800, 801, 955, 540, 0.6, 1.1),
    "ucm": LENSES["ucm"](800, 801, 955, 540, 0.6),
}
EXACT = {
    "kannala_brandt": {"opencv", "ros", "kalibr", "colmap"},
    "brown_conrady": {"opencv", "ros", "colmap", "mrcal"},
    "rational": {"opencv", "ros", "colmap", "mrcal"},
    "double_sphere": {"kalibr"},
    "eucm": {"kalibr"},
    "ucm": {"kalibr"},
    "fisheye not centred": {"colmap"},
    "fisheye behind a prism": {"colmap"},
}
TOOLS = [name for name in exchange.FORMATS if name != "avcli"]


def rays(theta_max: float = 0.7) -> np.ndarray:
    """Rays (n, 3) up to an angle from the axis."""
    angle, azimuth = (a.ravel() for a in np.meshgrid(np.linspace(0, theta_max, 9), np.linspace(0, 6.2, 13)))
    return np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], -1)


def shown(lens: nearest.Projection, theta_max: float = 0.69) -> np.ndarray:
    """Those of `rays` that the picture shows."""
    every = rays(theta_max)
    pixels = lens.project(every)
    return every[((pixels > 0) & (pixels < np.array(SIZE) - 1)).all(1)]


def written(lens: nearest.Projection, kind: str, **more: object) -> exchange.Written:
    return exchange.write(Camera(lens, SIZE, **more), kind)  # type: ignore[arg-type]


KNOWN = {"theta_max_observed_deg": 40.0}


@functools.cache
def sample(model: str, kind: str) -> exchange.Written:
    return written(SAMPLES[model], kind, known=KNOWN)


def reread(text: str) -> Camera:
    _, (camera,) = exchange.read(text.encode(), "file")
    return camera


# --- there and back ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", TOOLS)
@pytest.mark.parametrize("model", SAMPLES)
def test_every_model_goes_through_every_format(model: str, kind: str) -> None:
    lens = SAMPLES[model]
    found = sample(model, kind)
    camera = reread(found.text)
    assert exchange.read(found.text.encode(), "file")[0] == kind
    assert camera.size == SIZE
    assert camera.known == KNOWN
    apart = np.linalg.norm(camera.lens.project(shown(lens)) - lens.project(shown(lens)), axis=1)
    assert apart.max() <= found.max_px + 1e-9
    if kind in EXACT[model]:
        assert found.max_px == 0
        assert camera.lens == lens or apart.max() < 1e-9
    else:
        assert 0 < found.max_px < 1.0


def test_the_stated_distance_is_that_of_the_picture() -> None:
    """Root mean square over the pixels, not over the rays."""
    lens, limit = FISHEYE, np.deg2rad(50.0)
    seen = nearest.sampled(lens, SIZE, limit)
    assert seen.weights.sum() == pytest.approx(1)
    other = nearest.nearest(lens, BrownConrady, seen, {"k3": 0.0, "k4": 0.0})
    grid = np.stack(np.meshgrid(np.arange(0.0, 1920, 7), np.arange(0.0, 1080, 7)), -1).reshape(-1, 2)
    sight = lens.unproject(grid)
    apart = np.linalg.norm(other.lens.project(sight) - grid, axis=1)[sight[:, 2] >= np.cos(limit)]
    assert other.rms_px == pytest.approx(np.sqrt((apart**2).mean()), rel=0.02)
    assert other.max_px == pytest.approx(apart.max(), rel=0.05)


def test_what_a_format_cannot_image_is_refused() -> None:
    behind = nearest.omni(np.array([500.0, 500.0, 959.5, 539.5]), 0.9, np.array([0.01, 0.0, 1e-3, 0.0]))
    with pytest.raises(exchange.NotConvertible, match="beyond the models"):
        exchange._best(Camera(behind, SIZE), PERSPECTIVE, nearest.sampled(behind, SIZE))
    assert written(behind, "mrcal").rms_px < 0.05, "mrcal's splines image rays behind the camera"


PERSPECTIVE = replace(exchange.FORMATS["opencv"], choices=exchange.OPENCV[:1])
BEYOND = KannalaBrandt(560.0, 561.0, 961.0, 542.0, 0.01, -0.004, 0.001, -0.0002)


def test_a_pose_goes_to_mrcal_and_back() -> None:
    from avcli.pose import camera_pose

    T = camera_pose([1.0, 2.0, 2.5], [80.0, 10.0, 5.0])
    back = reread(written(FISHEYE, "mrcal", T_reference_camera=T).text)
    assert back.T_reference_camera is not None
    np.testing.assert_allclose(back.T_reference_camera, T, atol=1e-12)
    assert "its pose" in written(FISHEYE, "opencv", T_reference_camera=T).lost


def test_that_a_centre_moves_is_lost_and_said() -> None:
    lens = {"lens_model": "kannala_brandt", "fx_px": 800, "fy_px": 801, "cx_px": 959, "cy_px": 540}
    lens |= {"k1": 0.01, "k2": 0, "k3": 0, "k4": 0, "image_width_px": 1920, "image_height_px": 1080}
    for calibration, lost in (({"pupil_m": 0.002}, 2), ({"rms_px": 0.1}, 1)):
        _, (camera,) = exchange.read(json.dumps(lens | {"calibration": calibration}).encode(), "camera.json")
        found = exchange.write(camera, "opencv")
        assert len(found.lost) == lost
        assert ("how its centre moves" in " ".join(exchange.words(camera, found, "opencv"))) == (lost == 2)


@pytest.mark.parametrize("rotation", [[90, 0, 0], [90, 0, 180], [-30, 179, 0], [0, 0, 0], [0, 180, 90]])
def test_half_turns_go_to_mrcal_and_back(rotation: list[float]) -> None:
    from avcli.pose import camera_pose

    T = camera_pose([0.5, 0.0, 3.0], rotation)
    back = reread(written(ORDINARY, "mrcal", T_reference_camera=T).text).T_reference_camera
    assert back is not None
    np.testing.assert_allclose(back, T, atol=1e-12)


# --- what other tools write -------------------------------------------------------------------------------------------


def test_colmap_counts_half_a_pixel_more() -> None:
    camera = reread("# a comment\n7 SIMPLE_RADIAL_FISHEYE 1920 1080 900 960.0 540.0 -0.02\n")
    assert camera.name == "7"
    assert camera.lens == KannalaBrandt(900.0, 900.0, 959.5, 539.5, -0.02)


def test_four_coefficients_of_opencv_are_not_guessed() -> None:
    text = "%YAML:1.0\n---\nimage_width: 1920\nimage_height: 1080\nK: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n"
    text += "  data: [900, 0, 960, 0, 900, 540, 0, 0, 1]\nD: [0.1, 0.01, 0.0, 0.0]\n"
    with pytest.raises(ValueError, match="--fisheye"):
        exchange.read(text.encode(), "x.yml")
    assert exchange.read(text.encode(), "x.yml", True)[1][0].lens == KannalaBrandt(900, 900, 960, 540, 0.1, 0.01)
    assert exchange.read(text.encode(), "x.yml", False)[1][0].lens == BrownConrady(900, 900, 960, 540, 0.1, 0.01)


def test_a_camera_info_message_is_read() -> None:
    text = "header:\n  frame_id: camera\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\n"
    text += "d: [0.1, -0.2, 0.0, 0.0, 0.01]\nk: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]\nbinning_x: 0\n"
    camera = reread(text)
    assert camera.size == (640, 480)
    assert camera.lens == BrownConrady(500, 501, 320, 240, 0.1, -0.2, 0.01)


def test_a_model_of_the_other_tool_is_chosen_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**lens_config(ORDINARY), "image_width_px": 1920, "image_height_px": 1080}))
    assert " OPENCV " in run(path, 0, "--to", "colmap", "--model", "opencv")
    assert " FULL_OPENCV " in run(path, 0, "--to", "colmap")
    assert "SPLINED" in run(path, 0, "--to", "mrcal", "--model", "splined")
    assert "it has PINHOLE, OPENCV" in run(path, 2, "--to", "colmap", "--model", "splined")


def test_nothing_of_the_old_lens_stays_in_a_config(tmp_path: Path) -> None:
    old = {"camera_config": {**lens_config(FISHEYE), "theta_max_observed_deg": 70.0, "camera_position_m": [1, 2, 2.5]}}
    (tmp_path / "config.json").write_text(json.dumps(old))
    path = tmp_path / "chain.yaml"
    path.write_text(written(SAMPLES["double_sphere"], "kalibr").text)
    run(path, 0, "-C", str(tmp_path))
    found = json.loads((tmp_path / "config.json").read_text())["camera_config"]
    assert found["camera_position_m"] == [1, 2, 2.5]
    assert "k1" not in found
    assert "theta_max_observed_deg" not in found
    lens = SAMPLES["double_sphere"]
    assert reread((tmp_path / "config.json").read_text()).lens == lens


def test_of_several_cameras_one_is_named(tmp_path: Path) -> None:
    one = (
        "cam{}:\n  camera_model: pinhole\n  distortion_coeffs: [0.0, 0.01, 0.0, {}]\n  distortion_model: equidistant\n"
    )
    one += "  intrinsics: [400.0, 400.0, 320.0, 240.0]\n  resolution: [640, 480]\n  T_cn_cnm1:\n  - [1, 0, 0, 0]\n"
    path = tmp_path / "chain.yaml"
    path.write_text(one.format(0, 0.1) + one.format(1, 0.2))
    assert "--camera: cam0, cam1" in run(path, 2)
    found = json.loads(run(path, 0, "--camera", "cam1"))
    assert found["k4"] == 0.2
    assert "has no camera 'cam7'" in run(path, 2, "--camera", "cam7")


@pytest.mark.parametrize(
    "text",
    ["", "hello", "{}", '{"fx_px": 1}', "cam0:\n  camera_model: pinhole\n", "1 OPENCV 10 10 1 2 3\n",
     "<opencv_storage>",
     "<!DOCTYPE x><opencv_storage/>", "{'lensmodel': 'LENSMODEL_PINHOLE'}", "{'lensmodel': 'LENSMODEL_X', ",
     "distortion_model: plumb_bob\nK: [1, 2]\n", "camera_matrix: [1, 0, nan, 0, 1, 1, 0, 0, 1]\n",
     "camera_matrix: " + "[" * 100, "1 OPENCV 10 10 1e999 2 3 4 0 0 0 0\n"],
)  # fmt: skip
def test_bad_files_end_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"^bad\.txt:") as caught:
        exchange.read(text.encode(), "bad.txt")
    assert "\n" not in str(caught.value)


def run(path: Path, code: int, *options: str) -> str:
    """Run avcalib convert; what it wrote, or said where it failed."""
    done = conftest.run("avcalib", "convert", path, *options)
    assert done.returncode == code, done.stderr
    return done.stderr if code else done.stdout.decode()


# --- YAML -------------------------------------------------------------------------------------------------------------


def test_yaml_is_read_as_cameras_write_it() -> None:
    text = """%YAML:1.0
---
time: "Mon 1: 2 # no comment"   # a comment
matrix: !!opencv-matrix
   rows: 2
   data: [ 1.5e+02, 0.,
       -.5, 4 ]
cam0:
  T:
  - [1.0, 2, {a: 1, 'b c': [x y, ~]}]
  - - 3
    - yes it is
  topic: /cam0/image_raw
empty:
last: true
"""
    assert yaml.parse(text) == {
        "time": "Mon 1: 2 # no comment",
        "matrix": {"rows": 2, "data": [150.0, 0.0, -0.5, 4]},
        "cam0": {"T": [[1.0, 2, {"a": 1, "b c": ["x y", None]}], [3, "yes it is"]], "topic": "/cam0/image_raw"},
        "empty": None,
        "last": True,
    }


@pytest.mark.parametrize(
    "text", ["a: [1, 2", "a: 1\n  b: 2", "{a 1}", "", "- [1]]", "a: {b: 1", "a: " + "[" * 50 + "]" * 50]
)
def test_what_is_no_yaml_is_refused_with_its_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"^f:"):
        yaml.parse(text, "f")


# --- the tools' own readers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("xml", [False, True])
@pytest.mark.parametrize("lens", [FISHEYE, ORDINARY, BEYOND], ids=["fisheye", "ordinary", "past 90 degrees"])
def test_opencv_reads_what_is_written_for_it(lens: Lens, xml: bool, tmp_path: Path) -> None:
    path = tmp_path / f"camera.{'xml' if xml else 'yml'}"
    path.write_text(exchange.write(Camera(lens, SIZE), "opencv", xml=xml).text)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, D = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    assert storage.getNode("image_width").real() == 1920
    is_fisheye = storage.getNode("fisheye_model").real() == 1
    storage.release()
    points, zero = rays(), np.zeros(3)
    if is_fisheye:
        pixels = cv2.fisheye.projectPoints(points[None], zero, zero, K, D)[0][0]
    else:
        pixels = cv2.projectPoints(points, zero, zero, K, D)[0][:, 0]
    np.testing.assert_allclose(pixels, lens.project(points), atol=1e-9)


@pytest.mark.parametrize("fisheye", [False, True])
def test_what_opencv_writes_is_read(fisheye: bool, tmp_path: Path) -> None:
    for ending in ("yml", "xml", "json"):
        path = tmp_path / f"camera.{ending}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for key, value in (("image_width", 1920), ("image_height", 1080), ("fisheye_model", int(fisheye))):
            storage.write(key, value)
        storage.write("camera_matrix", np.array([[900.0, 0, 950.25], [0, 901.0, 540.5], [0, 0, 1]]))
        storage.write(
            "distortion_coefficients",
            np.array([[0.1, -0.02, 0.003, 0.0004]] if fisheye else [[0.1, -0.02, 0.0, 0.0, 3e-3]]),
        )
        storage.release()
        kind, (camera,) = exchange.read(path.read_bytes(), "x")
        assert kind == "opencv"
        if fisheye:
            assert camera.lens == KannalaBrandt(900.0, 901.0, 950.25, 540.5, 0.1, -0.02, 0.003, 0.0004)
        else:
            assert camera.lens == BrownConrady(900.0, 901.0, 950.25, 540.5, 0.1, -0.02, 3e-3)


def test_thin_prisms_and_tilt_are_opencv_s() -> None:
    D = [0.1, 0.02, 1e-3, -2e-3, 0.01, 0.2, 0.05, 0.01, 1e-3, 2e-4, -1e-3, 3e-4, 0.02, -0.03]
    text = "image_width: 640\nimage_height: 480\ncamera_matrix:\n  data: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n"
    lens = reread(f"{text}distortion_coefficients:\n  data: {D}\n").lens
    K = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
    pixels = cv2.projectPoints(rays(0.45), np.zeros(3), np.zeros(3), K, np.array(D))[0][:, 0]
    np.testing.assert_allclose(lens.project(rays(0.45)), pixels, atol=1e-9)


COLMAPS = {
    "SIMPLE_PINHOLE": (500, 320, 240),
    "PINHOLE": (500, 501, 320, 240),
    "SIMPLE_RADIAL": (500, 320, 240, -0.1),
    "RADIAL": (500, 320, 240, -0.1, 0.01),
    "OPENCV": (500, 501, 320, 240, -0.1, 0.01, 1e-3, -2e-3),
    "FULL_OPENCV": (500, 501, 320, 240, 0.1, 0.01, 1e-3, -2e-3, 0.01, 0.2, 0.03, 0.01),
    "OPENCV_FISHEYE": (500, 501, 320, 240, -0.01, 0.01, 1e-3, -2e-3),
    "SIMPLE_RADIAL_FISHEYE": (500, 320, 240, -0.1),
    "RADIAL_FISHEYE": (500, 320, 240, -0.1, 0.01),
    "FOV": (500, 501, 320, 240, 0.9),
    "THIN_PRISM_FISHEYE": (500, 501, 320, 240, -0.01, 0.01, 1e-3, -2e-3, 1e-3, 1e-4, 1e-3, 2e-3),
    "SIMPLE_FISHEYE": (500, 320, 240),
    "FISHEYE": (500, 501, 320, 240),
    "EUCM": (500, 501, 320, 240, 0.6, 1.1),
}


@pytest.mark.parametrize("model", COLMAPS)
def test_colmap_s_models_are_read_as_colmap_projects_them(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    if model not in pycolmap.CameraModelId.__members__:
        pytest.skip(f"this pycolmap has no {model}")
    theirs = pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=COLMAPS[model])
    lens = reread(f"1 {model} 640 480 {' '.join(str(float(v)) for v in COLMAPS[model])}\n").lens
    np.testing.assert_allclose(lens.project(rays(0.45)), np.array(theirs.img_from_cam(rays(0.45))) - 0.5, atol=1e-9)


@pytest.mark.parametrize("model", SAMPLES)
def test_colmap_reads_what_is_written_for_it(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    found = sample(model, "colmap")
    line = found.text.strip().splitlines()[-1].split()
    camera = pycolmap.Camera(
        camera_id=int(line[0]),
        model=line[1],
        width=int(line[2]),
        height=int(line[3]),
        params=[float(v) for v in line[4:]],
    )
    ahead = shown(SAMPLES[model])
    pixels = np.array(camera.img_from_cam(ahead))
    apart = np.linalg.norm(pixels - 0.5 - SAMPLES[model].project(ahead), axis=1)
    assert apart.max() <= found.max_px + 1e-6


def asked(module: str, script: str, folder: Path) -> str:
    """What the system's Python prints for a script that uses a module; where it lacks that, the test is skipped."""
    python = shutil.which("python3", path="/usr/bin")
    if python is None or subprocess.run([python, "-c", f"import {module}"], capture_output=True).returncode:
        pytest.skip(f"the system's Python has no {module}")
    done = subprocess.run([python, "-c", script], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_mrcal_reads_what_is_written_for_it(tmp_path: Path) -> None:
    past = "past 90 degrees"
    cases = {**{name: (lens, 40.0) for name, lens in SAMPLES.items()}, past: (BEYOND, 96.0)}
    limits = {}
    for name, (lens, limit) in cases.items():
        beyond = {"theta_max_observed_deg": limit}
        found = written(lens, "mrcal", known=beyond) if name == past else sample(name, "mrcal")
        (tmp_path / f"{name}.cameramodel").write_text(found.text)
        np.save(tmp_path / f"{name}.npy", shown(lens, np.deg2rad(limit)))
        limits[name] = found.max_px + 1e-6
    script = "import glob, mrcal, numpy as np\nfor it in glob.glob('*.cameramodel'):\n"
    script += "    m = mrcal.cameramodel(it); it = it[:-12] + '.npy'; print(*m.imagersize())\n"
    script += "    np.save(it, mrcal.project(np.load(it), *m.intrinsics()))\n"
    assert asked("mrcal", script, tmp_path).split() == ["1920", "1080"] * len(cases)
    for name, (lens, limit) in cases.items():
        apart = np.load(tmp_path / f"{name}.npy") - lens.project(shown(lens, np.deg2rad(limit)))
        assert np.linalg.norm(apart, axis=1).max() <= limits[name], name


def test_ros_reads_what_is_written_for_it(tmp_path: Path) -> None:
    texts = {name: sample(name, "ros") for name in SAMPLES}
    for name, found in texts.items():
        (tmp_path / f"{name}.yaml").write_text(found.text)
    script = "import camera_calibration_parsers as c, glob, json\nfor it in glob.glob('*.yaml'):\n    "
    script += (
        "n, i = c.readCalibration(it); print(json.dumps([it, n, i.width, i.height, i.distortion_model, i.D, i.K]))"
    )
    lines = asked("camera_calibration_parsers", script, tmp_path).splitlines()
    assert len(lines) == len(texts)
    for it, name, width, height, model, D, K in map(json.loads, lines):
        found = texts[it[:-5]]
        camera = reread(found.text)
        assert (name, width, height, model) == ("camera", 1920, 1080, found.model)
        assert isinstance(camera.lens, Lens)
        assert [K[0], K[4], K[2], K[5]] == [camera.lens.fx, camera.lens.fy, camera.lens.cx, camera.lens.cy]
        assert next(c for c in exchange.ROS if c.name == model).values(camera.lens) == list(D)


KALIBR_READER = """
import glob, importlib.util, json, os, sys, types
for name in ('aslam_cv', 'aslam_cv_backend', 'sm'):  # what the reader imports and a file's reading does not use
    sys.modules[name] = types.ModuleType(name)
spec = importlib.util.spec_from_file_location('reader', os.environ['KALIBR_READER'])
kalibr = importlib.util.module_from_spec(spec)
spec.loader.exec_module(kalibr)
"""


def asked_kalibr(script: str, folder: Path) -> str:
    """What a script prints that uses Kalibr's reader, kalibr_common/ConfigReader.py, which KALIBR_READER names."""
    if "KALIBR_READER" not in os.environ:
        pytest.skip("KALIBR_READER does not name Kalibr's ConfigReader.py")
    return asked("yaml", KALIBR_READER + script, folder)


def test_kalibr_reads_what_is_written_for_it(tmp_path: Path) -> None:
    for name in SAMPLES:
        (tmp_path / f"{name}.yaml").write_text(sample(name, "kalibr").text)
    script = """
for it in glob.glob('*.yaml'):
    camera = kalibr.CameraChainParameters(it).getCameraParameters(0)
    camera.printDetails(sys.stderr)
    print(json.dumps([it, *camera.getIntrinsics(), *camera.getDistortion(), camera.getResolution()]))
"""
    lines = asked_kalibr(script, tmp_path).splitlines()
    assert len(lines) == len(SAMPLES)
    for it, model, numbers, bend, coefficients, size in map(json.loads, lines):
        found = sample(it[:-5], "kalibr")
        lens = reread(found.text).lens
        assert isinstance(lens, Lens)
        core = [lens.fx, lens.fy, lens.cx, lens.cy]
        more = next(choice for choice in exchange.KALIBR if choice.name == found.model).values(lens)
        assert (f"{model}-{bend}", size) == (found.model, [1920, 1080])
        assert [*numbers, *coefficients] == ([*more, *core] if bend == "none" else [*core, *more])


def test_kalibr_reads_the_targets_that_are_written_for_it(tmp_path: Path) -> None:
    ask = ("--square", "60", "--dpi", "50", "--kalibr")
    kinds = {"aprilgrid": "aprilgrid", "checkerboard": "checkerboard", "circles": "circlegrid"}
    for kind in kinds:
        path = tmp_path / f"{kind}.yaml"
        done = conftest.run("avcalib", "target", "--kind", kind, *ask, path, "-o", tmp_path / f"{kind}.png")
        assert done.returncode == 0, done.stderr
    script = "for it in glob.glob('*.yaml'):\n    found = kalibr.CalibrationTargetParameters(it)\n"
    script += "    print(json.dumps([it, found.getTargetParams()]))\n"
    for it, found in map(json.loads, asked_kalibr(script, tmp_path).splitlines()):
        assert found["targetType"] == kinds.pop(it[:-5])
    assert not kinds


def test_what_kalibr_writes_is_read(tmp_path: Path) -> None:
    script = """
one = kalibr.CameraParameters('one', createYaml=True)
one.setIntrinsics('pinhole', [400.0, 401.0, 320.5, 239.5])
one.setDistortion('equidistant', [0.1, 0.01, -0.002, 0.0003])
one.setResolution([640, 480])
two = kalibr.CameraParameters('two', createYaml=True)
two.setIntrinsics('ds', [-0.2, 0.6, 400.0, 401.0, 320.5, 239.5])
two.setDistortion('none', [])
two.setResolution([640, 480])
chain = kalibr.CameraChainParameters('chain.yaml', createYaml=True)
chain.addCameraAtEnd(one)
chain.addCameraAtEnd(two)
chain.writeYaml()
"""
    asked_kalibr(script, tmp_path)
    kind, (one, two) = exchange.read((tmp_path / "chain.yaml").read_bytes(), "chain.yaml")
    assert kind == "kalibr"
    assert one.size == two.size == (640, 480)
    assert one.lens == KannalaBrandt(400, 401, 320.5, 239.5, 0.1, 0.01, -0.002, 0.0003)
    assert two.lens == LENSES["double_sphere"](400, 401, 320.5, 239.5, -0.2, 0.6)


def test_what_mrcal_writes_is_read(tmp_path: Path) -> None:
    script = """
import mrcal, numpy as np
rng = np.random.default_rng(0)
core = [500.0, 501.0, 320.5, 239.5]
spline = 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=11_Ny=8_fov_x_deg=120'
cases = {'LENSMODEL_PINHOLE': [], 'LENSMODEL_STEREOGRAPHIC': [], 'LENSMODEL_OPENCV4': [-0.1, 0.01, 1e-3, -2e-3],
         'LENSMODEL_OPENCV8': [0.3, 0.05, 1e-3, -2e-3, 0.01, 0.6, 0.12, 0.02],
         'LENSMODEL_OPENCV12': [0.1, 0.02, 1e-3, -2e-3, 0.01, 0.2, 0.05, 0.01, 1e-3, 2e-4, -1e-3, 3e-4],
         spline: (0.01 * rng.standard_normal(11 * 8 * 2)).tolist()}
rays = np.load('rays.npy')
for i, (name, numbers) in enumerate(cases.items()):
    m = mrcal.cameramodel(intrinsics=(name, np.array(core + numbers)), imagersize=(640, 480),
                          extrinsics_rt_fromref=np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    m.write(f'{i}.cameramodel', note='a note')
    np.save(f'{i}.npy', mrcal.project(rays, *m.intrinsics()))
"""
    np.save(tmp_path / "rays.npy", rays(0.45))
    asked("mrcal", script, tmp_path)
    paths = sorted(tmp_path.glob("*.cameramodel"))
    assert len(paths) == 6
    for path in paths:
        kind, (camera,) = exchange.read(path.read_bytes(), path.name)
        assert (kind, camera.size) == ("mrcal", (640, 480))
        assert camera.T_reference_camera is not None
        np.testing.assert_allclose(camera.lens.project(rays(0.45)), np.load(path.with_suffix(".npy")), atol=1e-9)
