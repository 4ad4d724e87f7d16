"""What people feed to a calibration that is no good set of pictures."""

import json

import numpy as np
import pytest
from calibration_boards import HALF, HALF_SIZE, film, jpeg, photograph, photographs, write_film
from conftest import done, refused, run
from test_calibration_live import FakeCapture

from avcli.calibration import corners
from avcli.calibration.target import Board
from avcli.formats import footage
from avcli.formats.media import MediaError
from avcli.lens import KannalaBrandt

BOARD = Board(6, 8, 0.095)


@pytest.fixture(scope="session")
def shots():
    rng = np.random.default_rng(7)
    return photographs(film(8, rng, lens=HALF, size=HALF_SIZE), rng)


def write(folder, pictures, extension="png"):
    import cv2

    folder.mkdir(exist_ok=True)
    for number, picture in enumerate(pictures):
        assert cv2.imwrite(str(folder / f"p_{number:02d}.{extension}"), picture)
    return folder


def lens_of(*arguments):
    result = done("avcalib", "calibrate", *arguments)
    return json.loads(result.stdout), result.stderr


@pytest.fixture(scope="session")
def usual(shots, tmp_path_factory):
    return lens_of(write(tmp_path_factory.mktemp("usual"), shots))[0]


def test_a_video_and_its_rate(shots, tmp_path, usual):
    film = write_film(tmp_path / "film.avi", shots, each=5, fps=10.0)
    assert [round(p.timestamp, 3) for p in footage.pictures([str(film)], 2.0)] == [i / 2 for i in range(8)]
    assert footage.count_pictures([str(film)], 2.0) == 8
    assert len(list(footage.pictures([str(film)]))) == 40
    found, _ = lens_of(film)
    assert found["fx_px"] == pytest.approx(usual["fx_px"], abs=0.5)
    assert found["calibration"]["views_given"] == 8


@pytest.mark.slow
def test_a_video_with_rot_in_it(shots, tmp_path, usual):
    film = write_film(tmp_path / "film.avi", shots)
    content = bytearray(film.read_bytes())
    rng = np.random.default_rng(0)
    at = rng.integers(len(content) // 10, 9 * len(content) // 10, 12)
    for place in at:
        content[place] = int(rng.integers(256))
    film.write_bytes(bytes(content))
    result = run("avcalib", "calibrate", film)
    assert result.returncode in (0, 3), result.stderr
    if result.returncode == 0:
        assert json.loads(result.stdout)["fx_px"] == pytest.approx(usual["fx_px"], abs=2.0)


@pytest.mark.parametrize("count", [4, 5])
def test_few_pictures_are_judged_by_what_they_know(shots, tmp_path, count):
    result = run("avcalib", "calibrate", write(tmp_path / "few", shots[:count]))
    assert result.returncode in (0, 3)
    if result.returncode == 0:
        known = json.loads(result.stdout)
        off = abs(known["fx_px"] - HALF.fx) / known["calibration"]["sd"]["fx_px"]
        assert off < 5


def test_duplicates_change_nothing(shots, tmp_path, usual):
    found, said = lens_of(write(tmp_path / "twice", [*shots, *shots, shots[0]]))
    assert "9 of them as in another picture" in said
    assert found == usual


def test_the_same_pose_many_times_is_one_pose(shots, tmp_path):
    rng = np.random.default_rng(1)
    same = [np.clip(shots[0] + rng.normal(0, 2, shots[0].shape), 0, 255).astype(np.uint8) for _ in range(6)]
    result = run("avcalib", "calibrate", write(tmp_path / "same", same))
    assert result.returncode == 3
    assert "1 different view" in result.stderr


def test_depths_colours_and_alpha(shots, tmp_path, usual):
    forms = [picture.astype(np.uint16) * 257 for picture in shots[:3]]
    forms += [np.dstack([picture] * 3) for picture in shots[3:6]]
    forms += [np.dstack([picture] * 3 + [np.full_like(picture, 255)]) for picture in shots[6:]]
    found, _ = lens_of(write(tmp_path / "forms", forms))
    assert found["fx_px"] == pytest.approx(usual["fx_px"], abs=0.05)


def test_a_note_on_which_way_is_up_is_not_followed(shots, tmp_path):
    """The sensor does not turn when someone turns the camera: pixels are taken as they lie in the file."""
    import cv2

    whole = jpeg(shots[0])
    tiff = b"MM\0*" + (8).to_bytes(4, "big") + b"\0\1" + b"\x01\x12\0\3\0\0\0\1\0\6\0\0" + bytes(4)
    note = b"Exif\0\0" + tiff
    path = tmp_path / "turned.jpg"
    path.write_bytes(whole[:2] + b"\xff\xe1" + (len(note) + 2).to_bytes(2, "big") + note + whole[2:])
    assert cv2.imread(str(path)).shape[:2] == HALF_SIZE  # OpenCV by itself would follow it
    assert next(footage.pictures([str(path)])).image.shape[:2] == HALF_SIZE[::-1]


def test_mirrored_pictures_have_a_mirrored_centre(shots, tmp_path, usual):
    found, _ = lens_of(write(tmp_path / "mirrored", [picture[:, ::-1] for picture in shots]))
    assert found["fx_px"] == pytest.approx(usual["fx_px"], abs=0.1)
    assert found["cx_px"] == pytest.approx(HALF_SIZE[0] - 1 - usual["cx_px"], abs=0.1)


def test_a_foreign_picture_among_many_is_left_out(shots, tmp_path, usual):
    import cv2

    skew = cv2.getRotationMatrix2D((480, 270), 12, 0.8) + np.array([[0.08, 0, 20], [0, -0.06, -10]])
    foreign = cv2.warpAffine(shots[3], skew, HALF_SIZE, borderValue=90)
    details = tmp_path / "details.jsonl"
    found, _ = lens_of(write(tmp_path / "foreign", [*shots, foreign]), "--details", details)
    last = json.loads(details.read_text().splitlines()[-1])
    assert last["why"] in ("does not fit", "no board")
    assert found["fx_px"] == pytest.approx(usual["fx_px"], abs=0.1)


def test_pictures_that_are_none(tmp_path, shots):
    with pytest.raises(MediaError, match="no pictures"):
        list(footage.pictures([str(tmp_path)]))
    bad = tmp_path / "bad.png"
    bad.write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    refused(run("avcalib", "calibrate", bad))
    result = run("avcalib", "calibrate", "/dev/video97")
    assert result.returncode == 2
    assert run("avcalib", "calibrate", "-", stdin=b"no jpeg").returncode == 1
    assert run("avcalib", "calibrate", "-", stdin=b"").returncode == 1


@pytest.mark.slow
def test_a_very_large_picture():
    """8K: corners are placed as well as in a small picture."""
    k = 8
    lens = KannalaBrandt(k * HALF.fx, k * HALF.fy, k * HALF.cx, k * HALF.cy, HALF.k1, HALF.k2, HALF.k3, HALF.k4)
    size = (k * HALF_SIZE[0], k * HALF_SIZE[1])
    rng = np.random.default_rng(0)
    filmed = film(1, rng, lens=lens, size=size, distance=(1.4, 1.5), tilt=0.3)
    R, t = filmed.rotations[0], filmed.translations[0]
    view = corners.find(photograph(R, t, rng, lens=lens, size=size, blur=2.0, noise=0), BOARD)
    true = lens.project(np.column_stack([BOARD.points, np.zeros(len(BOARD.points))]) @ R.T + t)
    error = min(np.linalg.norm(view.pixels - one, axis=1).max() for one in (true, true[::-1]))
    assert error < 0.3


def test_a_camera_that_vanishes_leaves_what_it_gave(shots, monkeypatch):
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: FakeCapture([np.dstack([shot] * 3) for shot in shots[:3]]))
    found = list(footage.pictures(["/dev/video0"], size=HALF_SIZE))
    assert len(found) == 3
    with pytest.raises(MediaError, match="not 1920"):
        list(footage.pictures(["/dev/video0"], size=(1920, 1080)))


def test_a_tiled_floor_is_no_board(tmp_path, shots):
    """A picture without the board whose floor has a grid does not change the size of the board."""
    y, x = np.mgrid[0:540, 0:960]
    tiles = (60 + 120 * ((x // 60 + y // 60) % 2)).astype(np.uint8)
    found, said = lens_of(write(tmp_path / "floor", [tiles, *shots]))
    assert "continuing with a board" not in said
    assert found["calibration"]["views_used"] == 8
