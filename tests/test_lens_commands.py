"""Every lens model in every command that uses a lens."""

import json

import numpy as np
import pytest
from calibration_boards import photograph
from conftest import done, run

from avcli import pose
from avcli.calibration.target import Board
from avcli.formats.experiment import lens_from_config
from avcli.formats.media import write_png
from avcli.lens import Lens, lens_config, variants

SIZE, SMALL = (960, 540), (480, 270)
MIDDLE = (482.0, 268.0)
PARAMETERS = {
    "kannala_brandt": (431.0, 431.3, *MIDDLE, -0.0269, -0.0038, 0.0016, -0.0006),
    "kannala_brandt+tangential": (431.0, 431.3, *MIDDLE, -0.0269, -0.0038, 0.0016, -0.0006, 2e-3, -1e-3, 3e-3, -2e-3),
    "brown_conrady": (330.0, 331.0, *MIDDLE, -0.1, 0.01, 0.0, 0.0),
    "brown_conrady+tangential": (330.0, 331.0, *MIDDLE, -0.1, 0.01, 0.0, 0.0, 2e-3, -1e-3),
    "division": (340.0, 341.0, *MIDDLE, -0.1, 0.0, 0.0, 0.0),
    "rational": (430.0, 431.0, *MIDDLE, 0.4, 0.03, 0.001, 0.6, 0.1, 0.005, 1e-3, -8e-4),
    "double_sphere": (250.0, 251.0, *MIDDLE, -0.2, 0.59),
    "eucm": (350.0, 351.0, *MIDDLE, 0.62, 1.1),
    "ucm": (350.0, 351.0, *MIDDLE, 0.5),
}
SAME_IN = {
    "kannala_brandt": "kalibr",
    "kannala_brandt+tangential": "colmap",
    "brown_conrady": "ros",
    "brown_conrady+tangential": "opencv",
    "rational": "mrcal",
    "double_sphere": "kalibr",
    "eucm": "kalibr",
    "ucm": "kalibr",
}
"""A tool that has the same lens, under its own name. None has the division model, whose distortion is elliptic."""
HALL = {
    "name": "two",
    "duration_s": 0.5,
    "camera_config": {"camera_position_m": [2.33, 2.33, 2.5], "camera_rotation_deg": [90, 0, 0], "frame_rate_hz": 2},
    "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]},
    "people": [
        {"waypoints": [{"t_s": 0, "position_m": [1.2, 1.5]}, {"t_s": 0.5, "position_m": [1.65, 1.45]}]},
        {"waypoints": [{"t_s": 0, "position_m": [3.5, 3.0]}, {"t_s": 0.5, "position_m": [3.05, 3.15]}]},
    ],
}
CEILING = pose.camera_pose([2.33, 2.30, 2.5], [88, 4, 0])
BOARD = Board(7, 10, 0.095)


@pytest.fixture(params=variants())
def lens(request):
    return made(request.param, SIZE)


def made(name: str, size: tuple[int, int]) -> Lens:
    scale = size[0] / SIZE[0]
    fx, fy, cx, cy, *coefficients = PARAMETERS[name]
    middle = ((centre + 0.5) * scale - 0.5 for centre in (cx, cy))
    return variants()[name].of_image([fx * scale, fy * scale, *middle, *coefficients], *size)


@pytest.fixture
def camera(lens, tmp_path):
    return save(lens, SIZE, tmp_path / "camera.json")


def save(lens: Lens, size: tuple[int, int], path):
    known = {"image_width_px": size[0], "image_height_px": size[1], "theta_max_observed_deg": 50.0}
    path.write_text(json.dumps({**lens_config(lens), **known}))
    return path


def did(*command, stdin=""):
    result = done(*command, stdin=stdin)
    return result.stdout.decode()


@pytest.mark.parametrize("name", variants())
def test_people_are_drawn_and_found(name, tmp_path):
    small = save(made(name, SMALL), SMALL, tmp_path / "small.json")
    drawn = did("avsim-scene", "-", "--camera-config", small, "--samples", "1", "-C", tmp_path, stdin=json.dumps(HALL))
    found = did("avdetect-video", "-C", tmp_path, stdin=drawn)
    frames = [[json.loads(line)["objects"] for line in lines.splitlines()] for lines in (drawn, found)]
    assert len(frames[0]) == len(frames[1]) == 2
    apart = []
    for true, seen in zip(*frames, strict=True):
        assert len(seen) == 2
        at = np.array([one["position"][:2] for one in seen])
        apart += [np.linalg.norm(at - person["position"][:2], axis=1).min() for person in true]
    assert np.mean(apart) < 0.05
    assert max(apart) < 0.12


def test_a_board_is_checked_and_tells_the_pose(lens, camera, tmp_path):
    c, s = np.cos(np.deg2rad(20)), np.sin(np.deg2rad(20))
    T_room_board = pose.transform([[c, s, 0], [s, -c, 0], [0, 0, -1]], [2.1, 2.5, 0.0])
    inside = pose.inverse(CEILING) @ T_room_board
    floor = tmp_path / "floor.png"
    rng = np.random.default_rng(0)
    write_png(floor, photograph(inside[:3, :3], inside[:3, 3], rng, lens=lens, size=SIZE, board=BOARD))
    report = json.loads(did("avcalib", "check", camera, floor, "--board", "7x10", "--fail-over", "0.3"))
    assert report["rms_px"] < 0.2
    out = tmp_path / "placed.json"
    known = "--board", "7x10", "--square", "95", "--at", "2.1", "2.5", "0", "--yaw", "20"
    did("avcalib", "pose", floor, "-c", camera, *known, "-o", out)
    assert np.abs(placed(out) - CEILING).max() < 0.02

    points = pose.apply(T_room_board, np.column_stack([BOARD.points, 0 * BOARD.points[:, 0]]))
    pixels = lens.project(pose.apply(pose.inverse(CEILING), points))
    table = tmp_path / "points.csv"
    np.savetxt(table, np.column_stack([pixels, points]), delimiter=",", header="u,v,x,y,z", comments="")
    did("avcalib", "pose", "--points", table, "-c", camera, "-o", out)
    assert np.abs(placed(out) - CEILING).max() < 1e-6

    room = {"camera_config": json.loads(camera.read_text()), "room_config": {"room_dimensions_m": [4.66, 4.66, 3]}}
    (tmp_path / "room.json").write_text(json.dumps(room))
    asked = "outside the room of 4.66 × 4.66 × 3 m"
    command = "avcalib", "pose", "--points", table, "-c", tmp_path / "room.json", "-o", out
    assert asked not in run(*command).stderr
    in_cm = np.column_stack([pixels, 100 * points])
    np.savetxt(table, in_cm, delimiter=",", header="u,v,x,y,z", comments="")
    assert asked in run(*command).stderr


@pytest.mark.parametrize("name", variants())
def test_it_goes_to_another_tool_and_back_or_its_distance_is_said(name, tmp_path):
    lens, there, back = made(name, SIZE), tmp_path / "there", tmp_path / "back.json"
    camera = save(lens, SIZE, tmp_path / "camera.json")
    if name not in SAME_IN:
        result = run("avcalib", "convert", camera, "--to", "opencv", "-o", there)
        assert result.returncode == 3
        assert "px" in result.stderr
        assert not there.exists()
        return
    did("avcalib", "convert", camera, "--to", SAME_IN[name], "-o", there)
    did("avcalib", "convert", there, "--to", "avcli", "-o", back)
    found = lens_from_config(json.loads(back.read_text()), width_px=SIZE[0], height_px=SIZE[1])
    pixels = np.stack(np.meshgrid(*(np.linspace(1, side - 2, 7) for side in SIZE)), -1).reshape(-1, 2)
    rays = lens.unproject(pixels)
    np.testing.assert_allclose(found.project(rays), pixels, atol=1e-6, equal_nan=False)


def placed(path):
    found = json.loads(path.read_text())
    return pose.camera_pose(found["camera_position_m"], found["camera_rotation_deg"])
