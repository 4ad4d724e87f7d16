"""avcalib as a user runs it."""

import json
import shutil

import numpy as np
import pytest
from calibration_boards import BOARD, HALF, HALF_SIZE, film, photograph, photographs
from conftest import done, refused, run

from avcli import pose
from avcli.calibration import corners, place
from avcli.calibration.target import Board
from avcli.formats import footage
from avcli.formats.media import write_png


@pytest.fixture(scope="session")
def pictures(tmp_path_factory):
    """A folder with eight photographs of the thesis's board, taken with half the pixels of its camera."""
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(1)
    filmed = film(8, rng, lens=HALF, size=HALF_SIZE)
    for i, picture in enumerate(photographs(filmed, rng)):
        write_png(folder / f"board_{i:02d}.png", picture)
    return folder


def test_pictures_in_a_lens_out(pictures, tmp_path):
    details = tmp_path / "details.jsonl"
    result = done("avcalib", "calibrate", pictures, "--board", "6x8", "--details", details)
    camera = json.loads(result.stdout)
    assert camera["lens_model"] == "kannala_brandt"
    assert camera["fx_px"] == pytest.approx(HALF.fx, abs=1.0)
    assert camera["cx_px"] == pytest.approx(HALF.cx, abs=1.0)
    assert (camera["image_width_px"], camera["image_height_px"]) == HALF_SIZE
    assert 50 < camera["theta_max_observed_deg"] < 90 < camera["theta_max_valid_deg"]
    assert camera["calibration"]["rms_px"] < 0.1
    assert "Verdict: trust this calibration up to" in result.stderr
    rows = [json.loads(line) for line in details.read_text().splitlines()]
    assert [row["kept"] for row in rows] == [True] * 8
    assert run("avcalib", "calibrate", pictures, "--board", "6x8").stdout == result.stdout


def test_into_a_config_that_has_other_things(pictures, tmp_path):
    config = tmp_path / "config.json"
    config.write_text('{"session_id":"a","camera_config":{"camera_position_m":[1,2,2.5],"fx_px":1,"fy_px":1}}')
    result = done("avcalib", "calibrate", pictures, "-C", tmp_path)
    assert result.stdout == b""
    raw = json.loads(config.read_text())
    assert raw["session_id"] == "a"
    assert raw["camera_config"]["camera_position_m"] == [1, 2, 2.5]
    assert raw["camera_config"]["fx_px"] == pytest.approx(HALF.fx, abs=1.0)


def test_into_an_experiment_that_is_new(pictures, tmp_path):
    lab = tmp_path / "lab"
    done("avcalib", "calibrate", pictures, "-C", lab)
    raw = json.loads((lab / "config.json").read_text())
    assert list(raw) == ["camera_config"]
    assert raw["camera_config"]["fx_px"] == pytest.approx(HALF.fx, abs=1.0)
    assert [path.name for path in lab.iterdir()] == ["config.json"]
    straight = tmp_path / "straight.png"
    assert run("avcalib", "undistort", pictures / "board_00.png", "-C", lab, "--to", straight).returncode == 0


def test_too_few_pictures_are_refused(pictures, tmp_path):
    out = tmp_path / "camera.json"
    result = run("avcalib", "calibrate", pictures / "board_00.png", pictures / "board_01.png", "-o", out)
    assert result.returncode == 3
    assert "the pictures do not tell the lens; it is written by --force only" in result.stderr
    assert not out.exists()
    result = run("avcalib", "calibrate", pictures / "board_00.png", "--force")
    assert result.returncode == 3


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (["calibrate", "{}", "--max-rms", "1"], "--max-rms has no effect with --procedure avcli"),
        (["calibrate", "{}", "--procedure", "thesis", "--board-shape", "no"], "--board-shape has no effect with"),
        (["calibrate", "{}", "--procedure", "thesis", "--lens-model", "division"], "--lens-model has no effect with"),
        (["calibrate", "{}", "--rate", "3"], "--rate has no effect with single pictures"),
        (["calibrate", "{}", "--size", "640x480"], "--size has no effect without a camera"),
        (["calibrate", "{}", "--lens-model", "pinhole"], "known are kannala_brandt, brown_conrady, division"),
        (["undistort", "{}", "-c", "CAMERA", "--to", "x", "--fov", "90", "--balance", "1"], "--balance has no effect"),
        (["undistort", "{}", "-c", "CAMERA", "--to", "x", "--projection", "whole", "--balance", "1"], "--balance has"),
        (["pose", "-c", "CAMERA", "--points", "p.csv", "--yaw", "3"], "--yaw has no effect with --points"),
        (["pose", "-c", "CAMERA", "--points", "p.csv", "--square", "3"], "--square has no effect with --points"),
    ],
)
def test_options_without_effect_are_refused_by_name(pictures, camera, options, name):
    places = {"{}": pictures, "CAMERA": camera}
    refused(run("avcalib", *(places.get(option, option) for option in options)), name, status=2)


def test_bad_input(pictures, tmp_path):
    assert run("avcalib", "calibrate").returncode == 2
    assert run("avcalib", "calibrate", tmp_path / "none.png").returncode == 2
    assert run("avcalib", "calibrate", pictures, "--board", "6:8").returncode == 2
    broken = tmp_path / "film.mp4"
    broken.write_bytes(b"this is no film" * 100)
    refused(run("avcalib", "calibrate", broken))
    empty = tmp_path / "empty.mp4"
    empty.touch()
    assert run("avcalib", "calibrate", empty).returncode == 1
    write_png(tmp_path / "small.png", np.zeros((100, 100), np.uint8))
    result = run("avcalib", "calibrate", pictures / "board_00.png", tmp_path / "small.png")
    assert result.returncode == 3
    assert f"left out: {tmp_path / 'small.png'}: 100 × 100 px" in result.stderr
    assert "here 960 × 540 px" in result.stderr
    write_png(tmp_path / "dark.png", np.zeros((540, 960), np.uint8))
    result = run("avcalib", "calibrate", tmp_path / "dark.png")
    assert result.returncode == 3
    assert "whole board" in result.stderr


def test_the_thesis_procedure_on_its_own_kind_of_set(pictures):
    result = run("avcalib", "calibrate", pictures, "--preset", "thesis")
    if result.returncode == 0:
        assert json.loads(result.stdout)["fx_px"] == pytest.approx(HALF.fx, abs=5.0)
    else:
        assert result.returncode == 3
        assert "OpenCV" in result.stderr


def test_real_photographs(shared_data):
    result = done("avcalib", "calibrate", shared_data / "calibration" / "fish_1", "--board", "7x9", "--square", "30")
    camera = json.loads(result.stdout)
    quality = camera["calibration"]
    assert quality["views_used"] == 15
    assert quality["held_out_rms_px"] <= 0.2
    # Fits with a single centre of projection say 336 px, and 0.26 px held out: the boards are 0.1 m away, and the
    # centre moves by 3 mm. With it, the nearer half of the pictures says 338.5 ± 0.4 px and the others 338.0 ± 0.6 px.
    assert quality["pupil_m"] == pytest.approx(0.0014, abs=0.0003)
    assert camera["fx_px"] == pytest.approx(338.2, abs=1.0)


@pytest.fixture(scope="session")
def camera(pictures, tmp_path_factory):
    """What `avcalib calibrate` wrote for these pictures."""
    path = tmp_path_factory.mktemp("camera") / "camera.json"
    result = done("avcalib", "calibrate", pictures, "-q", "-o", path)
    assert result.stderr == ""
    return path


@pytest.mark.slow
def test_a_report_in_pictures(pictures, tmp_path):
    plot, page, folder = tmp_path / "report.svg", tmp_path / "report.html", tmp_path / "boards"
    shutil.copytree(pictures, folder)
    (folder / "board_00.png").rename(folder / "board_00.png\udce9.png")  # no UTF-8
    done("avcalib", "calibrate", folder, "--plot", plot, "--html", page)
    assert "board_00.png\ufffd.png" in page.read_text()
    assert "expected error of the projection" in plot.read_text()
    text = page.read_text()
    assert "data:image/png;base64," in text
    assert text.count("<meter") == 8
    assert 'name="viewport"' in text
    assert text.index("Trust this calibration up to") < text.index("What to film next") < text.index("<svg")
    assert all(f"board_{number:02d}.png" in text for number in range(8))
    assert "times what is stated" in text
    assert "http" not in text
    assert run("avcalib", "calibrate", pictures, "--plot", tmp_path / "report.doc").returncode == 2


def test_check_scores_new_pictures(pictures, camera, tmp_path):
    some = sorted(pictures.iterdir())[:3]
    result = done("avcalib", "check", camera, *some, "--fail-over", "0.1")
    score = json.loads(result.stdout)
    assert score["views"] == 3
    assert score["rms_px"] < 0.05
    shutil.copy(camera, tmp_path / "config.json")
    assert json.loads(run("avcalib", "check", tmp_path, *some).stdout) == score
    other = json.loads(camera.read_text()) | {"fx_px": 436.0}
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps({"camera_config": other}))
    result = run("avcalib", "check", wrong, *some, "--fail-over", "0.1")
    assert result.returncode == 3
    assert json.loads(result.stdout)["rms_px"] > 0.1
    wrong.write_text("[]")
    assert run("avcalib", "check", wrong, *some).returncode == 1


def test_straightened_boards_have_straight_rows(pictures, camera, tmp_path):
    import cv2

    source = sorted(pictures.iterdir())[0]
    out = tmp_path / "straight.png"
    result = done("avcalib", "undistort", source, "-c", camera, "--to", out, "--fov", "110", "--size", "1600x900")
    assert json.loads(result.stdout)["lens_model"] == "brown_conrady"
    found = corners.find(cv2.imread(str(out), 0), BOARD)
    for row in found.pixels.reshape(7, 5, 2):
        centred = row - row.mean(0)
        off = centred @ np.linalg.svd(centred)[2][1]
        assert np.abs(off).max() < 0.3
    folder = tmp_path / "all"
    done("avcalib", "undistort", pictures, "-c", camera, "--to", folder, "--projection", "whole")
    assert len(list(folder.iterdir())) == 8
    done("avcalib", "undistort", source, "-c", camera, "--to", tmp_path / "a.avi", "--projection", "cylindrical")
    assert (tmp_path / "a.avi").stat().st_size > 1000
    assert len(list(tmp_path.iterdir())) == 3
    assert footage.frame_rate(str(tmp_path / "a.avi")) == 10.0
    assert run("avcalib", "undistort", tmp_path / "none.avi", "-c", camera, "--to", out).returncode == 2
    assert run("avcalib", "undistort", pictures, "-c", camera, "--to", out).returncode == 2
    film = tmp_path / "a.avi"
    kept = film.read_bytes(), (folder / source.with_suffix(".png").name).read_bytes()
    for action in (["undistort", film, "--to", film], ["undistort", folder, "--to", folder, "--size", "1600x900"]):
        result = run("avcalib", *action, "-c", camera)
        assert result.returncode in (1, 2)
        assert "is an input; name another" in result.stderr
    assert run("avcalib", "calibrate", film, "--details", film).returncode == 2
    assert kept == (film.read_bytes(), (folder / source.with_suffix(".png").name).read_bytes())
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros((90, 160), np.uint8))
    result = done("avcalib", "undistort", other, source, "-c", camera, "--to", tmp_path / "some")
    assert "other.png: 160 × 90 px" in result.stderr
    assert [path.name for path in (tmp_path / "some").iterdir()] == [source.name]
    result = run("avcalib", "undistort", other, "-c", camera, "--to", tmp_path / "none")
    assert result.returncode == 1
    assert "no picture is of the size of" in result.stderr
    assert run("avcalib", "undistort", source, "-c", camera, "--to", out, "--fov", "200").returncode == 2


def test_a_camera_that_is_missing_has_no_page():
    result = refused(run("avcalib", "live", "9876", "--port", "18987"), "/dev/video9876: no such camera", status=2)
    assert "open http" not in result.stderr


def test_where_the_camera_hangs(camera, tmp_path):
    board = Board(7, 10, 0.095)
    T = pose.camera_pose([2.33, 2.30, 2.5], [88, 4, 0])
    room = place.board_on_floor(board.points, [2.1, 2.5, 0.0], np.deg2rad(20))
    c, s = np.cos(np.deg2rad(20)), np.sin(np.deg2rad(20))
    T_room_board = pose.transform([[c, s, 0], [s, -c, 0], [0, 0, -1]], [2.1, 2.5, 0.0])
    inside = pose.inverse(T) @ T_room_board
    picture = photograph(
        inside[:3, :3], inside[:3, 3], np.random.default_rng(0), lens=HALF, size=HALF_SIZE, board=board
    )
    write_png(tmp_path / "floor.png", picture)
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"camera_config": json.loads(camera.read_text())}))
    result = run(
        "avcalib", "pose", tmp_path / "floor.png", "-C", tmp_path, "--square", "95",
        "--at", "2.1", "2.5", "0", "--yaw", "20",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = json.loads(config.read_text())["camera_config"]
    assert np.abs(np.array(found["camera_position_m"]) - [2.33, 2.30, 2.5]).max() < 0.02
    assert found["lens_model"] == "kannala_brandt"
    table = tmp_path / "points.csv"
    pixels = HALF.project(pose.apply(pose.inverse(T), room))
    rows = [",".join(map(str, [*u, *p])) for u, p in zip(pixels, room, strict=True)]
    table.write_text("u,v,x,y,z\n" + "\n".join(rows))
    out = tmp_path / "placed.json"
    done("avcalib", "pose", "--points", table, "-c", camera, "-o", out)
    placed = json.loads(out.read_text())
    again = pose.camera_pose(placed["camera_position_m"], placed["camera_rotation_deg"])
    assert np.abs(again - T).max() < 0.01
    assert placed["fx_px"] == json.loads(camera.read_text())["fx_px"]
    line = tmp_path / "line.json"
    line.write_text(camera.read_text())
    assert run("avcalib", "pose", "--points", table, "-c", line).returncode == 0
    assert json.loads(line.read_text()) == placed
    table.write_text("u,v,x\n1,2,3\n")
    assert run("avcalib", "pose", "--points", table, "-c", camera).returncode == 1
    assert run("avcalib", "pose", "-c", camera).returncode == 2


@pytest.mark.parametrize(
    ("heights", "says"),
    [((0, 0, 0, 0), "the camera is below the floor: "), ((0, 0.7, 0, 1.2), "the points fit if they are mirrored: ")],
)
def test_points_whose_axes_are_exchanged_put_no_camera_below_the_floor(tmp_path, heights, says):
    camera = tmp_path / "camera.json"
    size = {"image_width_px": HALF_SIZE[0], "image_height_px": HALF_SIZE[1]}
    camera.write_text(
        json.dumps({"lens_model": "kannala_brandt", **size, **dict(zip(HALF.keys(), HALF.parameters, strict=True))})
    )
    points = np.column_stack([[1.4, 3.2, 3.4, 1.2, 2.0], [1.6, 1.5, 3.0, 3.1, 2.6], [*heights, 0.3 * max(heights)]])
    seen = HALF.project((points - [2.3, 2.4, 2.5]) * (1, -1, -1))
    rows = [f"{u},{v},{y},{x},{z}" for (u, v), (x, y, z) in zip(seen, points, strict=True)]
    (tmp_path / "points.csv").write_text("\n".join(["u,v,x,y,z", *rows]))
    result = run("avcalib", "pose", "--points", tmp_path / "points.csv", "-c", camera, "-o", tmp_path / "out.json")
    assert result.returncode == 3
    assert f"{says}x and y are exchanged, an axis runs the other way, or the pictures are mirrored" in result.stderr
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_targets(tmp_path, kind):
    result = done("avcalib", "target", "--kind", "charuco", "--format", kind)
    out = tmp_path / f"board.{kind}"
    assert run("avcalib", "target", "--kind", "charuco", "-o", out).returncode == 0
    assert out.read_bytes() == result.stdout
    assert run("avcalib", "target", "--square", "90", "--paper", "A4").returncode == 2
