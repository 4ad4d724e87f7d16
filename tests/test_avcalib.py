"""avcalib as a user runs it."""

import json

import numpy as np
import pytest
from calibration_boards import film, photograph
from conftest import run
from test_calibration_corners import HALF, HALF_SIZE

from avcli.media import write_png


@pytest.fixture(scope="session")
def pictures(tmp_path_factory):
    """A folder with eight photographs of the thesis's board, taken with half the pixels of its camera."""
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(1)
    filmed = film(8, rng, lens=HALF, size=HALF_SIZE)
    for i, (R, t) in enumerate(zip(filmed.rotations, filmed.translations, strict=True)):
        write_png(folder / f"board_{i:02d}.png", photograph(R, t, rng, lens=HALF, size=HALF_SIZE, oversample=2))
    return folder


def test_pictures_in_a_lens_out(pictures, tmp_path):
    details = tmp_path / "details.jsonl"
    result = run("avcalib", "calibrate", pictures, "--board", "6x8", "--details", details)
    assert result.returncode == 0, result.stderr
    camera = json.loads(result.stdout)
    assert camera["lens_model"] == "kannala_brandt"
    assert camera["fx_px"] == pytest.approx(HALF.fx, abs=1.0)
    assert camera["cx_px"] == pytest.approx(HALF.cx, abs=1.0)
    assert (camera["image_width_px"], camera["image_height_px"]) == HALF_SIZE
    assert 50 < camera["theta_max_observed_deg"] < 90 < camera["theta_max_valid_deg"]
    assert camera["calibration"]["rms_px"] < 0.1
    assert "verdict" in result.stderr
    rows = [json.loads(line) for line in details.read_text().splitlines()]
    assert [row["kept"] for row in rows] == [True] * 8
    assert run("avcalib", "calibrate", pictures, "--board", "6x8").stdout == result.stdout


def test_into_a_config_that_has_other_things(pictures, tmp_path):
    config = tmp_path / "config.json"
    config.write_text('{"session_id":"a","camera_config":{"camera_position_m":[1,2,2.5],"fx_px":1,"fy_px":1}}')
    result = run("avcalib", "calibrate", pictures, "-C", tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout == b""
    raw = json.loads(config.read_text())
    assert raw["session_id"] == "a"
    assert raw["camera_config"]["camera_position_m"] == [1, 2, 2.5]
    assert raw["camera_config"]["fx_px"] == pytest.approx(HALF.fx, abs=1.0)


def test_inner_corners_for_squares_are_recognised(pictures):
    result = run("avcalib", "calibrate", pictures, "--board", "5x7")
    assert result.returncode == 0, result.stderr
    assert "a board of 6x8 squares" in result.stderr


def test_too_few_pictures_are_refused(pictures, tmp_path):
    out = tmp_path / "camera.json"
    result = run("avcalib", "calibrate", pictures / "board_00.png", pictures / "board_01.png", "-o", out)
    assert result.returncode == 3
    assert "not observable" in result.stderr
    assert not out.exists()
    result = run("avcalib", "calibrate", pictures / "board_00.png", "--force")
    assert result.returncode == 3


def test_bad_input(pictures, tmp_path):
    assert run("avcalib", "calibrate").returncode == 2
    assert run("avcalib", "calibrate", tmp_path / "none.png").returncode == 2
    assert run("avcalib", "calibrate", pictures, "--board", "6:8").returncode == 2
    broken = tmp_path / "film.mp4"
    broken.write_bytes(b"this is no film" * 100)
    result = run("avcalib", "calibrate", broken)
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    empty = tmp_path / "empty.mp4"
    empty.touch()
    assert run("avcalib", "calibrate", empty).returncode == 1
    write_png(tmp_path / "small.png", np.zeros((100, 100), np.uint8))
    result = run("avcalib", "calibrate", pictures / "board_00.png", tmp_path / "small.png")
    assert result.returncode == 1
    assert "960 × 540" in result.stderr
    assert "100 × 100" in result.stderr
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
    result = run("avcalib", "calibrate", shared_data / "calibration" / "fish_1", "--board", "7x9", "--square", "30")
    assert result.returncode == 0, result.stderr
    camera = json.loads(result.stdout)
    quality = camera["calibration"]
    assert quality["views_used"] == 15
    assert quality["held_out_rms_px"] <= 0.42
    assert camera["fx_px"] == pytest.approx(337, abs=1.5)


@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_targets(tmp_path, kind):
    result = run("avcalib", "target", "--charuco", "--format", kind)
    assert result.returncode == 0
    out = tmp_path / f"board.{kind}"
    assert run("avcalib", "target", "--charuco", "-o", out).returncode == 0
    assert out.read_bytes() == result.stdout
    assert run("avcalib", "target", "--square", "90", "--paper", "A4").returncode == 2


def test_a_board_on_stdin_as_jpegs(pictures):
    import cv2

    stream = b"".join(
        cv2.imencode(".jpg", cv2.imread(str(path), 0), [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
        for path in sorted(pictures.iterdir())
    )
    result = run("avcalib", "calibrate", "-", "--rate", "30", stdin=stream)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["fx_px"] == pytest.approx(HALF.fx, abs=1.5)
