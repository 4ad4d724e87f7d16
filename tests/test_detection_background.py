"""The room as it is learnt from its film: who passes is not in it, light does not matter, and it follows slowly."""

import json

import numpy as np
import pytest
from conftest import run

from avcli.detection.background import FIRST, Background, still_colour, still_depth
from avcli.formats import media

BOX = np.array([[100.0, 60.0, 140.0, 120.0]])
ELSEWHERE = np.array([[10.0, 10.0, 50.0, 50.0]])


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.fixture
def room(rng):
    return np.kron(rng.integers(40, 180, (18, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8)


def filmed(room, rng, at=None, light=1.0):
    """A noisy picture of the room, with somebody whose left side is at `at` px."""
    picture = room.astype(float)
    if at is not None:
        picture[60:120, at : at + 40] = (20, 30, 200)
    return np.clip(picture * light + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)


def test_who_walks_differs_and_what_is_still_does_not(room, rng):
    background = Background()
    for k in range(FIRST):
        assert background.shares(BOX)[0] == 1.0  # nothing is known yet
        background.see(filmed(room, rng, at=10 * k))
    assert background.is_known
    for light in (1.0, 0.6, 1.3):
        background.see(filmed(room, rng, at=100, light=light))
        assert background.shares(BOX)[0] > 0.8
        assert background.shares(ELSEWHERE)[0] < 0.05


def test_the_room_follows_slowly_but_not_where_somebody_is(room, rng):
    background = Background(room)
    other = room.copy()
    other[60:120, 100:140] = 250 - other[60:120, 100:140]
    pictures = [filmed(other, rng) for _ in range(20)]  # drawing their noise takes most of the time
    for people, moves in ((BOX, False), (np.zeros((0, 4)), True)):
        for picture in 8 * pictures:
            background.see(picture)
            background.learn(people)
        background.see(filmed(other, rng))
        assert (background.shares(BOX)[0] < 0.1) == moves


def test_a_box_outside_the_picture_has_a_share(room):
    background = Background(room)
    background.see(room)
    assert np.isfinite(background.shares(np.array([[-90.0, -90, -10, -10], [0, 0, 9000, 9000]]))).all()


def test_the_still_pictures_of_a_film(room, rng):
    colour = still_colour(filmed(room, rng, at=5 * k) for k in range(41))
    assert np.abs(colour.astype(int) - room)[20:].mean() < 2
    true = np.full((20, 30), 2500)
    several = []
    for k in range(40):
        depth = true + rng.integers(-5, 6, true.shape)
        depth[:, k % 30] = 1200  # somebody passes
        depth[rng.random(true.shape) < 0.3] = 0
        depth[3, 3] = 0 if k % 3 else 2500
        several.append(depth.astype(np.uint16))
    found = still_depth(several)
    assert found[3, 3] == 0
    found[3, 3] = 2500
    assert np.abs(found.astype(int) - true).max() <= 8
    with pytest.raises(ValueError, match="no pictures"):
        still_depth([])


def test_a_command_records_both(tmp_path, room, rng):
    (tmp_path / "colour").mkdir()
    (tmp_path / "depth").mkdir()
    for k in range(5):
        media.write_png(tmp_path / "colour" / f"{k}.png", filmed(room, rng, at=60 * k))
        media.write_png(tmp_path / "depth" / f"{k}.png", np.full((18, 32), 2500 + k, np.uint16))
    result = run("avcalib", "background", tmp_path / "colour", "--depth", tmp_path / "depth", "-C", tmp_path / "lab")
    assert (result.returncode, result.stderr) == (0, "")
    said = json.loads(result.stdout)["camera_config"]
    colour = media.read_rgb(tmp_path / "lab" / said["background_rgb"])
    assert np.abs(colour.astype(int) - room).mean() < 4
    assert (media.read_depth(tmp_path / "lab" / said["background_depth"]) == 2503).all()
    assert run("avcalib", "background", "-C", tmp_path / "lab").returncode == 2
    alone = run("avcalib", "background", "--depth", tmp_path / "depth", "-C", tmp_path / "other")
    assert json.loads(alone.stdout)["camera_config"] == {"background_depth": said["background_depth"]}
    missing = run("avcalib", "background", "--depth", tmp_path / "none", "-C", tmp_path / "other")
    assert (missing.returncode, missing.stderr.count("none: ")) == (2, 1)
