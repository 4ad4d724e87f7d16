"""Folders and streams as people have them: what is no good is left out by name, the rest is used."""

import json
import re
import shutil
import sys

import numpy as np
import pytest
from calibration_boards import HALF, HALF_SIZE, film, jpeg, photographs, write_film
from conftest import done, refused, run

from avcli.calibration import gather, place
from avcli.calibration.target import Board
from avcli.formats import footage, media
from avcli.formats.media import MediaError, write_png

BOARD = Board(6, 9, 0.07)


@pytest.fixture(scope="session")
def shots():
    rng = np.random.default_rng(11)
    return photographs(film(8, rng, lens=HALF, size=HALF_SIZE, board=BOARD), rng, board=BOARD)


@pytest.fixture
def folder(shots, tmp_path):
    path = tmp_path / "Bilder für Ünï"
    path.mkdir()
    for number, shot in enumerate(shots):
        (path / f"IMG_{number}.JPG").write_bytes(jpeg(shot))
    return path


def test_a_folder_as_a_phone_leaves_it(folder, shots, tmp_path):
    """Cut off, HEIC by name and by content, another size, turned, hidden, empty, a text, a folder in the folder."""
    write_png(folder / "a_screenshot.png", np.zeros((300, 400), np.uint8))
    write_png(folder / "b_turned.png", np.rot90(shots[0]).copy())
    (folder / "c_cut.jpg").write_bytes(jpeg(shots[1])[:-5000])
    (folder / "d.HEIC").write_bytes(b"whatever")
    (folder / "e.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    (folder / "f.png").touch()
    (folder / "._IMG_0.JPG").write_bytes(b"Mac OS X")
    (folder / "notes.txt").write_text("hello")
    (folder / "more").mkdir()
    shutil.copy(folder / "IMG_0.JPG", folder / "more")
    details = tmp_path / "details.jsonl"
    result = done("avcalib", "calibrate", folder, "--details", details)
    assert json.loads(result.stdout)["fx_px"] == pytest.approx(HALF.fx, abs=1.5)
    for name, why in (
        ("a_screenshot.png", "400 × 300 px"),
        ("b_turned.png", "540 × 960 px, as if turned by 90 degrees"),
        ("c_cut.jpg", "the end of the picture is missing"),
        ("d.HEIC", "HEIC cannot be read"),
        ("e.jpg", "a HEIC picture"),
        ("f.png", "empty"),
        ("more", "a folder in a folder is not read"),
    ):
        assert re.search(f"left out: [^\n]*{re.escape(name)}: [^\n]*{re.escape(why)}", result.stderr), (
            name,
            result.stderr,
        )
    assert "._IMG" not in result.stderr
    assert "notes" not in result.stderr
    assert "8 of 10 pictures show" in result.stderr in result.stderr
    rows = {json.loads(line)["picture"]: json.loads(line) for line in details.read_text().splitlines()}
    assert rows[str(folder / "a_screenshot.png")]["why"] == "another size"
    assert sum(row["kept"] for row in rows.values()) >= 7


def test_the_commonest_size_wins_whatever_comes_first(shots):
    small = [shot[::2, ::2].copy() for shot in shots[:2]]
    said = []
    seen = gather.collect([*small, *shots[2:6]], BOARD, say=said.append)
    assert (seen.size, len(seen.views), len(seen)) == (HALF_SIZE, 4, 6)
    assert seen.sample.shape == HALF_SIZE[::-1]
    assert [row["why"] for row in seen.records()] == ["another size"] * 2 + ["no fit"] * 4
    assert len(said) == 1
    assert "480 × 270 px" in said[0]
    seen = gather.collect([*small, *shots[2:6]], BOARD, size=(480, 270))
    assert (seen.size, len(seen.views)) == ((480, 270), 2)


def test_films_and_pictures_in_one_folder(shots, tmp_path):
    write_film(tmp_path / "b.AVI", shots[4:])
    (tmp_path / "c.mp4").write_bytes(b"no film" * 100)
    for number, shot in enumerate(shots[:4]):
        write_png(tmp_path / f"a{number}.png", shot)
    said = []
    found = list(footage.pictures([str(tmp_path)], 2.0, skip=said.append))
    assert [picture.image.shape[:2] for picture in found] == [HALF_SIZE[::-1]] * 8
    assert len(said) == 1
    assert "c.mp4" in said[0]
    done("avcalib", "calibrate", tmp_path)


def test_a_film_that_is_decoded_whole_is_read_until_it_is_enough(shots, tmp_path, monkeypatch):
    from avcli.commands import avcalib_pictures

    name = str(write_film(tmp_path / "few.avi", shots))
    assert footage.is_decoded_whole([name], 2.0, 4)  # no thirty pictures are quick to reach
    assert not footage.is_decoded_whole([name], 2.0, 8)
    assert not footage.is_decoded_whole([str(tmp_path)], 2.0, 8)
    asked = []

    def is_enough(seen):
        asked.append(len(seen.views))
        return len(seen.views) >= 6

    monkeypatch.setattr(avcalib_pictures, "_ENOUGH", 4)
    ended = avcalib_pictures._Ending(is_enough)
    seen = gather.collect(footage.pictures([name], 2.0), BOARD, after=lambda so_far, *_: ended(so_far))
    assert (asked, ended.at, len(seen.views)) == ([4, 6], 6, 6)
    never = avcalib_pictures._Ending(None)
    assert not never(seen)


def test_folders_without_pictures(tmp_path, folder):
    empty = tmp_path / "empty"
    empty.mkdir()
    for path in (empty, tmp_path / "nested"):
        path.mkdir(exist_ok=True)
    shutil.copytree(folder, tmp_path / "nested" / "left")
    result = run("avcalib", "calibrate", empty)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert "no pictures in this folder" in result.stderr
    result = run("avcalib", "calibrate", tmp_path / "nested")
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert "left: a folder in a folder is not read; name it" in result.stderr
    result = done("avcalib", "calibrate", empty, folder)
    assert f"left out: {empty}: no pictures in this folder" in result.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_name_that_is_no_text(folder, tmp_path):
    import os

    os.rename(folder / "IMG_0.JPG", os.fsencode(folder) + b"/IMG_\xff.JPG")
    details = tmp_path / "details.jsonl"
    done("avcalib", "calibrate", folder, "--details", details)
    assert len(details.read_text().splitlines()) == 8


def test_a_stream_is_not_thinned_by_count(shots):
    """Pictures that were taken seconds apart come at once when they are piped; none is lost."""
    stream = b"".join(map(jpeg, shots))
    result = done("avcalib", "calibrate", "-", stdin=stream)
    assert json.loads(result.stdout)["fx_px"] == pytest.approx(HALF.fx, abs=1.5)
    assert "8 of 8 pictures" in result.stderr
    result = run("avcalib", "calibrate", "-", "--rate", "0.01", stdin=stream)
    assert result.returncode == 3
    assert "7 of 8 pictures came sooner than 0.01 a second" in result.stderr


def test_a_jpeg_with_a_small_picture_in_it(shots):
    """Phones put one into the header, which has an end of its own."""
    import io

    whole, small = jpeg(shots[0]), jpeg(shots[0][::8, ::8])
    note = b"Exif\0\0" + small
    with_note = whole[:2] + b"\xff\xe1" + (len(note) + 2).to_bytes(2, "big") + note + whole[2:]
    assert media.jpeg_end(with_note) == len(with_note)
    assert media.jpeg_end(with_note[:-2]) == -1
    assert media.jpeg_end(b"\xff\xd8\xff") == -1
    found = list(footage.pictures(["-"], stream=io.BytesIO(with_note * 3)))
    assert [picture.image.shape for picture in found] == [HALF_SIZE[::-1]] * 3


def test_what_cannot_be_read_ends_only_where_nothing_can(tmp_path, shots):
    bad = [tmp_path / name for name in ("a.png", "b.png")]
    for path in bad:
        path.write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    with pytest.raises(MediaError, match="1 more cannot be read either"):
        list(footage.pictures([str(path) for path in bad], skip=lambda _: None))
    with pytest.raises(MediaError, match=r"a\.png"):
        list(footage.pictures([str(bad[0])]))


def test_a_pose_that_cannot_be_is_refused(shots, tmp_path):
    """With another lens, or points that are mixed up, the residual is one that no true view has."""
    for number, shot in enumerate(shots[:2]):
        write_png(tmp_path / f"{number}.png", shot)
    lens = {"lens_model": "kannala_brandt", "image_width_px": 960, "image_height_px": 540}
    wrong = lens | {"fx_px": 900, "fy_px": 900, "cx_px": 300, "cy_px": 200, "k1": 0.3}
    config = tmp_path / "wrong.json"
    config.write_text(json.dumps({"camera_config": wrong}))
    moved = tmp_path / "0.png", tmp_path / "1.png"
    result = run("avcalib", "pose", *moved, "-c", config, "--at", "1", "1", "0", "--square", "70")
    assert result.returncode == 3
    assert "no true view has more than 0.12" in result.stderr
    assert json.loads(config.read_text()) == {"camera_config": wrong}
    result = run("avcalib", "check", config, *moved)
    assert result.returncode == 3
    assert "the lens, the size of the pictures or the board is another one" in result.stderr
    assert json.loads(result.stdout)["off_deg"] > 0.12
    result = run("avcalib", "pose", tmp_path / "0.png", "-c", config, "--at", "1", "1", "0")
    refused(result, "--square MM is needed", status=2)
    right = lens | {"fx_px": HALF.fx, "fy_px": HALF.fy, "cx_px": HALF.cx, "cy_px": HALF.cy}
    config.write_text(json.dumps({"camera_config": right}))
    rng = np.random.default_rng(0)
    points = tmp_path / "points.csv"
    rows = np.column_stack([rng.uniform([100, 100], [800, 400], (8, 2)), rng.uniform(0, 4, (8, 3))])
    points.write_text("u,v,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in rows))
    result = run("avcalib", "pose", "--points", points, "-c", config)
    assert result.returncode == 3
    assert "a point, the lens or the size of the pictures is another one" in result.stderr


def test_the_angle_of_a_residual():
    rays = np.array([[0.0, 0, 1], [1, 0, 0]])
    assert place.off_angle(rays, 3 * rays) == pytest.approx(0)
    assert place.off_angle(rays[:1], np.array([[0.0, 0.5, 0.5]])) == pytest.approx(np.pi / 4)
    assert place.off_angle(np.full((1, 3), np.nan), rays[:1]) == pytest.approx(np.pi / 2)
    assert place.refusal(0.1, "board", 1.0) is None
    assert place.refusal(float("nan"), "board", float("nan")) is not None
