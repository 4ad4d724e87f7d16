"""Boards: drawing, finding, refining."""

import re
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from calibration_boards import BOARD, HALF, HALF_SIZE, THESIS, exact, film, photograph, photographs

from avcli.calibration import calibrate, corners, drawing, fit, gather, robust, saddles, sharpness, shutter, target
from avcli.calibration.target import Board
from avcli.lens import KannalaBrandt


@pytest.fixture(scope="module")
def shots():
    """Three photographs of the thesis's board, with where its corners truly are."""
    rng = np.random.default_rng(0)
    filmed = film(3, rng, lens=HALF, size=HALF_SIZE)
    return filmed, photographs(filmed, rng), exact(filmed, lens=HALF).pixels.reshape(3, -1, 2)


def error(found, true):
    """RMS along one axis, px; a board of even counts may be read upside down."""
    return min(np.sqrt(((found - true) ** 2).mean()), np.sqrt(((found[::-1] - true) ** 2).mean()))


def draw_upright():
    """A board (480, 640) that faces the camera, its rows to the right."""
    cells = np.add.outer(np.arange(BOARD.rows), np.arange(BOARD.columns)) % 2
    picture = np.full((480, 640), 220, np.uint8)
    picture[40:440, 170:470] = np.kron(np.where(cells == 0, 30, 220), np.ones((50, 50)))
    return picture


def test_corners_are_found_to_a_few_hundredths_of_a_pixel(shots):
    for picture, true in zip(*shots[1:], strict=True):
        assert error(corners.find(picture, BOARD).pixels, true) < 0.06


def test_a_very_small_picture_gives_the_same_corners_unless_it_may_turn_the_board(shots):
    picture = shots[1][0]
    quick, slow = (saddles.find_board(picture, BOARD.inner, quickly=quickly) for quickly in (True, False))
    assert quick.quickly
    assert not slow.quickly
    assert np.linalg.norm(quick.pixels - slow.pixels, axis=1).max() < quick.error
    steep = cv2.resize(np.rot90(draw_upright()), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    assert not saddles.find_board(np.ascontiguousarray(steep), BOARD.inner).quickly


def test_polish_halves_the_error_and_knows_what_is_left(shots):
    _filmed, pictures, true = shots
    views = [corners.find(picture, BOARD) for picture in pictures]
    before = calibrate.observe(BOARD, views)
    start = fit.refine_poses(before, fit.start_from_rays(before, HALF), 10)
    after = robust.polished(before, start, BOARD, views)
    pairs = [[error(o.pixels[o.view == i], true[i]) for i in range(3)] for o in (before, after)]
    assert np.mean(pairs[1]) < 0.6 * np.mean(pairs[0])
    assert np.mean(pairs[1]) < 0.025


def test_a_picture_in_any_form_gives_the_same_corners(shots):
    picture = shots[1][0]
    expected = corners.find(picture, BOARD).pixels
    forms = {
        "colour": np.repeat(picture[:, :, None], 3, 2),
        "with alpha": np.dstack([picture] * 3 + [np.full_like(picture, 255)]),
        "one channel": picture[:, :, None],
        "16 bits": picture.astype(np.uint16) * 257,
        "12 bits in 16": picture.astype(np.uint16) * 16,
        "floats": picture / 255.0,
    }
    for name, form in forms.items():
        found = corners.find(corners.to_grey(form), BOARD)
        assert found is not None, name
        assert error(found.pixels, expected) < 0.02, name


def test_nothing_is_found_where_there_is_nothing():
    for picture in (
        np.zeros((540, 960), np.uint8),
        np.full((540, 960), 200, np.uint8),
        np.zeros((8, 8), np.uint8),
        np.tile(np.arange(960, dtype=np.uint8), (540, 1)),
    ):
        assert corners.find(picture, BOARD) is None
    assert (corners.to_grey(np.zeros((40, 40), np.uint16)) == 0).all()


def test_blotches_are_no_board():
    rng = np.random.default_rng(5)
    for _ in range(6):
        blotches = cv2.resize(
            rng.integers(0, 256, (45, 80)).astype(np.uint8), (1920, 1080), interpolation=cv2.INTER_CUBIC
        )
        noisy = np.clip(blotches + rng.normal(0, 3, blotches.shape), 0, 255).astype(np.uint8)
        assert corners.find(noisy, BOARD) is None


def test_corners_of_blotches_in_rows_are_no_board():
    """By chance they join into grids, but the squares between them are not dark and bright in turn."""
    for seed in (5, 14, 19, 26):
        small = np.random.default_rng(seed).integers(0, 256, (45, 80)).astype(np.uint8)
        blotches = cv2.resize(small, (960, 540), interpolation=cv2.INTER_CUBIC)
        for inner in ((5, 7), (4, 5)):
            assert saddles.find_board(blotches, inner) is None


@pytest.mark.parametrize("part", ["5x8", "6x7", "4x6"])
def test_a_part_of_a_larger_board_is_not_taken_for_the_board(shots, part):
    for picture in shots[1]:
        assert corners.find(picture, Board(*target.parse_size(part))) is None


def test_all_corners_of_a_large_board_are_joined_and_of_texture_only_the_strongest(monkeypatch):
    joined = []
    neighbours = saddles._neighbours

    def counted(known):
        joined.append(len(known.pixels))
        return neighbours(known)

    monkeypatch.setattr(saddles, "_neighbours", counted)
    rng = np.random.default_rng(0)
    squares = np.kron(np.indices((24, 24)).sum(0) % 2, np.full((25, 25), 200.0)) + 30
    squares = np.pad(squares, 50, constant_values=230.0)
    board = cv2.warpPerspective(squares, np.array([[1, 0.05, 20], [-0.05, 0.95, 60], [0, 5e-5, 1]]), (760, 720))
    noisy = np.clip(cv2.GaussianBlur(board, (0, 0), 0.8) + rng.normal(0, 2, board.shape), 0, 255).astype(np.uint8)
    assert len(saddles.find_board(noisy, (23, 23)).ids) == 529
    joined.clear()
    texture = cv2.GaussianBlur(rng.standard_normal((540, 960)), (0, 0), 3.0)
    texture = np.clip(128 + 60 * texture / texture.std(), 0, 255).astype(np.uint8)
    assert saddles.sizes(texture) == []
    assert max(joined) == saddles._JOINABLE


def test_a_finger_on_the_board_hides_only_the_corners_under_it(shots):
    _, pictures, true = shots
    for picture, places in zip(pictures, true, strict=True):
        x, y = np.rint(places[16]).astype(int)
        spoiled = picture.copy()
        spoiled[y - 14 : y + 15, x - 14 : x + 15] = 120
        view = corners.find(spoiled, BOARD)
        assert len(view.ids) == 34
        seen = places[view.ids] if error(view.pixels, places[view.ids]) < 1 else places[::-1][view.ids]
        assert error(view.pixels, seen) < 0.1


@pytest.mark.parametrize("given", ["5x7", "7x9"])
def test_the_size_of_the_board_is_guessed(shots, given):
    guess = corners.guess_board(shots[1], Board(*target.parse_size(given)))
    assert sorted((guess.columns, guess.rows)) == [6, 8]


def test_a_large_picture_and_its_small_copy_agree():
    rng = np.random.default_rng(3)
    filmed = film(1, rng, lens=HALF, size=HALF_SIZE)
    R, t = filmed.rotations[0], filmed.translations[0]
    large = KannalaBrandt(
        3 * HALF.fx, 3 * HALF.fy, 3 * HALF.cx + 1, 3 * HALF.cy + 1, *[HALF.k1, HALF.k2, HALF.k3, HALF.k4]
    )
    picture = photograph(R, t, rng, lens=large, size=(2880, 1620), oversample=1)
    found = corners.find(picture, BOARD)
    assert error(found.pixels, exact(filmed, lens=large).pixels) < 0.1


def test_a_duplicate_is_recognised(shots):
    views = [corners.find(picture, BOARD) for picture in shots[1]]
    turned = corners.view_of(shots[1][0], views[0].ids, views[0].pixels[::-1] + 0.2)
    assert gather.is_duplicate(turned, views)
    assert not gather.is_duplicate(views[0], views[1:])


# --- targets ----------------------------------------------------------------------------------------------------------


def test_a_target_has_true_millimetres():
    board = Board(7, 10, 0.025)
    svg = drawing.to_svg(drawing.draw(board, "A3"))
    assert 'width="297mm" height="420mm" viewBox="0 0 297 420"' in svg
    path = re.search(r'<path d="([^"]*)"', svg)[1]
    squares = re.findall(r"M([\d.]+) ([\d.]+)h25v25h-25z", path)
    assert len(squares) == 35
    x = np.array(squares, float)
    assert np.ptp(x[:, 0]) == pytest.approx(150)
    assert np.ptp(x[:, 1]) == pytest.approx(225)


def test_a_pdf_is_a_pdf_whose_offsets_hold():
    pdf = drawing.to_pdf(drawing.draw(Board(5, 7, 0.03, kind="charuco")))
    assert pdf.startswith(b"%PDF-1.4")
    table = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", pdf)[1])
    assert pdf[table : table + 4] == b"xref"
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", pdf), 1):
        assert pdf[int(offset) :].startswith(b"%d 0 obj" % number)
    length = int(re.search(rb"/Length (\d+)", pdf)[1])
    assert pdf.split(b"stream\n", 1)[1][length:].startswith(b"\nendstream")
    assert drawing.to_pdf(drawing.draw(Board(5, 7, 0.03, kind="charuco"))) == pdf


def test_a_board_that_does_not_fit_says_what_does():
    with pytest.raises(ValueError, match="the largest squares that fit have 26 mm"):
        drawing.draw(Board(7, 10, 0.05), "A4")
    with pytest.raises(ValueError, match="too small"):
        Board(2, 8)
    with pytest.raises(ValueError, match="6x8"):
        target.parse_size("6,8")


def test_what_is_drawn_is_what_opencv_knows():
    """The drawn ChArUco board has the markers where OpenCV's own picture has them."""
    from calibration_boards import texture

    board = Board(5, 7, 0.03, kind="charuco")
    ours = texture(board, 56)[56:-56, 56:-56] > 0.5
    theirs = board.charuco().generateImage((5 * 56, 7 * 56), marginSize=0) > 127
    assert (ours == theirs).mean() > 0.999


# --- blur and shutter -------------------------------------------------------------------------------------------------


def smeared(picture, length, angle):
    """The picture as a uniform motion by `length` px smears it."""
    steps = np.linspace(-0.5, 0.5, 4 * length) * length
    moved = [
        cv2.warpAffine(
            picture.astype(np.float32),
            np.array([[1, 0, s * np.cos(angle)], [0, 1, s * np.sin(angle)]]),
            picture.shape[::-1],
            borderMode=cv2.BORDER_REPLICATE,
        )
        for s in steps
    ]
    return np.rint(np.mean(moved, axis=0)).astype(np.uint8)


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5])
def test_the_length_and_direction_of_a_motion_are_measured(shots, angle):
    for picture in shots[1]:
        sharp = corners.find(picture, BOARD).blur
        assert sharp.smear_px < 3
        blur = corners.find(smeared(picture, 9, angle), BOARD).blur
        assert blur.smear_px == pytest.approx(9, abs=1)
        assert abs(np.sin(blur.angle - angle)) < 0.15
        assert blur.least_px < 1.7


def test_smeared_pictures_are_named_and_too_many_refused():
    def of(length):
        return SimpleNamespace(blur=sharpness.Blur(np.hypot(length / 2 / 1.349, 0.8), 0.8, 0.0))

    views = [of(1), of(15), of(1)]
    assert sharpness.advice(views, ["a", "b", "c"])[0].startswith("1 picture is smeared by motion: b (15 px)")
    assert sharpness.refusals(views) == ()
    assert "15 px" in sharpness.refusals([of(15)] * 3)[0]
    assert sharpness.refusals([SimpleNamespace(blur=None)]) == ()


@pytest.mark.parametrize("motion", [0.0, 4.0])
def test_a_rolling_shutter_is_told_from_noise(motion):
    rng = np.random.default_rng(101)
    filmed = film(20, rng)
    pixels = []
    for R, t in zip(filmed.rotations, filmed.translations, strict=True):
        velocity = rng.standard_normal(3)
        velocity *= motion / THESIS.fx * np.linalg.norm(t) / np.linalg.norm(velocity)
        points = np.column_stack([BOARD.points, np.zeros(len(BOARD.points))]) @ R.T + t
        seen = THESIS.project(points)
        for _ in range(3):
            seen = THESIS.project(points + (seen[:, 1:] / 1080 - 0.5) * velocity)
        pixels.append(seen)
    noisy = np.concatenate(pixels) + 0.1 * rng.standard_normal((20 * 35, 2))
    observations = replace(exact(filmed), pixels=noisy)
    solution, good = robust.fit_robustly(observations, 1920, 1080)
    found = shutter.measure(observations.of_corners(good), solution, 1080)
    assert found.is_rolling == (motion > 0)
    assert bool(shutter.refusals(found)) == (motion > 0)
    if motion:
        assert found.typical_px == pytest.approx(0.7 * motion, rel=0.3)


# --- corners that walked ----------------------------------------------------------------------------------------------


def test_a_corner_that_walked_is_looked_for_where_the_lens_expects_it():
    rng = np.random.default_rng(104)
    filmed = film(10, rng, lens=HALF, size=HALF_SIZE)
    views = []
    for R, t in zip(filmed.rotations, filmed.translations, strict=True):
        view = corners.find(photograph(R, t, rng, lens=HALF, size=HALF_SIZE), BOARD)
        pixels = view.pixels.copy()
        pixels[rng.integers(35, size=2)] += rng.choice([-4, 4], 2)
        views.append(replace(view, pixels=pixels))
    found = calibrate.calibrate_views(BOARD, views)
    assert found.kept.all()
    assert found.dropped.sum() <= 1
    assert found.quality.rms_px < 0.05
