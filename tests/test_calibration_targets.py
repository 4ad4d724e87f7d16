"""Boards of every kind: drawn, recognised in simulated pictures without being told, and fitted."""

import dataclasses
import functools
import struct

import cv2
import numpy as np
import pytest
from calibration_boards import HALF, HALF_SIZE, exact, field_error, film, photograph, photographs, printed
from conftest import done, refused, run

from avcli.calibration import calibrate, circles, corners, drawing, fit, gather, markers, recognise, saddles
from avcli.calibration.recognise import Wanted
from avcli.calibration.target import Board
from avcli.formats.media import write_png

BOARDS = {
    "checkerboard": Board(6, 9, 0.07),
    "charuco": Board(7, 10, 0.06, kind="charuco"),
    "charuco-of-tags": Board(9, 7, 0.06, kind="charuco", dictionary="APRILTAG_36h11", ratio=0.8),
    "legacy-charuco": Board(8, 6, 0.07, kind="charuco", dictionary="4X4_50", ratio=0.7, legacy=True),
    "aprilgrid": Board(6, 6, 0.05, kind="aprilgrid"),
    "circles": Board(6, 7, 0.07, kind="circles"),
    "asymmetric": Board(4, 11, 0.04, kind="asymmetric"),
}


@functools.cache
def shots(board, count=8, **known):
    """Boards as they were filmed, and their pictures; some tests look at the first of them."""
    rng = np.random.default_rng(3)
    filmed = film(count, rng, lens=HALF, size=HALF_SIZE, board=board, **known)
    return filmed, photographs(filmed, rng, board=board, blur=0.6, oversample=2)


@pytest.mark.parametrize("name", BOARDS)
def test_each_print_is_recognised_and_gives_the_lens(name):
    """From pictures alone: what is drawn is found again through a fisheye, and gives its lens."""
    board, said = BOARDS[name], []
    _, pictures = shots(board)
    seen = gather.collect(pictures, Wanted(square_m=board.square_m), say=said.append)
    found = seen.board
    assert found.words.replace("5X5_50", "5X5_250") == board.words
    assert any(found.words in line for line in said)
    assert len(seen.views) == 8
    result = calibrate.calibrate_views(found, seen.views)
    assert result.kept.sum() >= 7
    assert result.quality.rms_px < 0.08
    assert result.board.ratio == pytest.approx(board.ratio, abs=0.001)
    assert result.lens.fx == pytest.approx(HALF.fx, abs=1.0)
    assert field_error(result.lens, HALF, HALF_SIZE, theta_max=0.9)[0] < 0.25


@pytest.mark.parametrize("name", ["aprilgrid", "charuco"])
def test_a_part_of_a_board_with_markers_is_enough(name):
    board = BOARDS[name]
    filmed, pictures = shots(board, 5, whole=False, distance=(0.25, 0.4), tilt=0.4, aim=((480, 270), 250))
    parts = 0
    for R, t, picture in zip(filmed.rotations, filmed.translations, pictures, strict=True):
        view = corners.find(picture, board)
        if view is not None:
            parts += len(view.ids) < len(board.points)
            true = HALF.project(np.column_stack([board.points, np.zeros(len(board.points))])[view.ids] @ R.T + t)
            assert np.median(np.linalg.norm(view.pixels - true, axis=1)) < 0.15
    assert parts >= 2


@pytest.mark.parametrize("name", ["aprilgrid", "charuco"])
@pytest.mark.parametrize("wanted", [Wanted(), "its kind"])
def test_a_mirrored_picture_of_markers_is_refused_and_passes_for_no_other_board(name, wanted):
    _, pictures = shots(BOARDS[name])
    mirrored = [np.ascontiguousarray(picture[:, ::-1]) for picture in pictures]
    with pytest.raises(fit.NoFit, match=r"is mirrored: its mirror image shows an? (AprilGrid|ChArUco)"):
        gather.collect(mirrored, Wanted(kind=name) if wanted == "its kind" else wanted)


def test_large_circles_need_their_centres_corrected():
    board = Board(3, 4, 0.3, kind="circles", ratio=0.7)
    filmed, pictures = shots(board, 5, distance=(0.6, 0.9), tilt=0.9)
    points = np.column_stack([board.points, np.zeros(len(board.points))])
    errors = []
    for R, t, picture in zip(filmed.rotations, filmed.translations, pictures, strict=True):
        true, view = HALF.project(points @ R.T + t), corners.find(picture, board)
        if view is None:  # the picture's edge cuts a circle
            continue
        turned = (
            np.linalg.norm(view.pixels[::-1] - true, axis=1).mean() < np.linalg.norm(view.pixels - true, axis=1).mean()
        )
        seen = view.pixels[::-1] if turned else view.pixels
        many = [np.repeat(a[None], len(points), 0) for a in (R, t)]
        off = circles.offsets(points, *many, HALF, board.diameter_m / 2)
        errors.append([np.linalg.norm(seen - true, axis=1).mean(), np.linalg.norm(seen - off - true, axis=1).mean()])
    assert len(errors) >= 2
    before, after = np.mean(errors, 0)
    assert before > 1.0
    assert after < 0.05 * before


@pytest.mark.parametrize("name", ["aprilgrid", "charuco", "legacy-charuco"])
def test_the_rows_of_a_board_are_counted_over_all_pictures(name):
    """While it is unknown how many rows a board has, more are looked for, and none is invented."""
    board = BOARDS[name]
    pictures = shots(board)[1][:3]
    searched = Wanted().searched(dataclasses.replace(board, rows=4))
    assert searched.rows > 12
    views = [corners.find(picture, searched) for picture in pictures]
    settled = recognise.trimmed(searched, views)
    assert (settled.columns, settled.rows, settled.rows_known) == (board.columns, board.rows, True)
    for view in views:
        assert recognise.within(view, settled) is view
    misread = dataclasses.replace(views[0], ids=views[0].ids + 4 * board.columns)
    assert recognise.trimmed(searched, [*views, misread]).rows == board.rows
    beyond = recognise.within(misread, settled)
    assert 0 < len(beyond.ids) == len(beyond.pixels) < len(misread.ids)


def test_an_aprilgrid_is_kalibrs():
    """Kalibr's numbering, and its first tag: code 0xd5d628584, read from the top left, two cells of border."""
    board = BOARDS["aprilgrid"]
    code = [bool(0xD5D628584 >> shift & 1) for shift in range(35, -1, -1)]
    cells = board.marker_cells(0)
    assert cells.shape == (10, 10)
    assert cells[:2].all()
    assert (cells[2:-2, 2:-2] == ~np.array(code).reshape(6, 6)).all()
    assert board.points[0] == pytest.approx([-0.1875, 0.1875])  # bottom left, y downwards
    assert board.points[12] - board.points[0] == pytest.approx([0, -0.05])
    assert board.points[2] - board.points[0] == pytest.approx([0.065, 0])
    ink, per_m, half = printed(board)
    around = ([-0.007, 0.007], [0.004, -0.004], [0.007, 0.007])
    outside, inside, beside = ((board.points[0] + offset + half) * per_m for offset in around)
    assert [round(float(ink[int(y), int(x)])) for x, y in (outside, inside, beside)] == [0, 0, 1]


def test_a_png_is_true_to_scale():
    board = Board(5, 7, 0.03)
    png = drawing.to_png(drawing.draw(board, "A4"), 254)
    at = png.index(b"pHYs")
    assert struct.unpack(">IIB", png[at + 4 : at + 13]) == (10000, 10000, 1)
    assert struct.unpack(">II", png[16:24]) == (2100, 2970)
    found = corners.find(cv2.imdecode(np.frombuffer(png, np.uint8), 0), board)
    spacing = np.diff(found.pixels.reshape(6, 4, 2), axis=1)[..., 0]
    assert spacing == pytest.approx(300, abs=0.02)
    with pytest.raises(ValueError, match="too large"):
        drawing.to_png(drawing.draw(board, "A0"), 2400)


@pytest.mark.parametrize("name", BOARDS)
def test_svg_and_pdf_have_the_same_shapes(name):
    page = drawing.draw(BOARDS[name])
    svg, pdf = drawing.to_svg(page), drawing.to_pdf(page)
    assert svg.count("z") - svg.count("size") >= len(page.rectangles)
    assert svg.count("<circle") == len(page.circles) == pdf.count(b" m\n")
    assert pdf.count(b" re\n") == len(page.rectangles)


def test_a_kind_and_a_size_that_are_given_are_kept():
    board = BOARDS["charuco"]
    pictures = shots(board)[1][:3]
    seen = gather.collect(pictures, Wanted(size=(7, 10), kind="charuco"))
    assert (str(seen.board), seen.board.ratio, len(seen.views)) == ("7x10", 0.75, 3)
    said = []
    seen = gather.collect(pictures, Wanted(size=(6, 10)), say=said.append)
    assert "the pictures show 7 columns" in said[0]
    assert str(seen.board) == "7x10"
    assert recognise.look(pictures[0], Wanted(kind="aprilgrid")) is None
    assert recognise.look(pictures[0], Wanted(kind="circles")) is None


def test_nothing_is_recognised_in_noise():
    rng = np.random.default_rng(0)
    for picture in (rng.integers(0, 256, (540, 960)).astype(np.uint8), np.full((540, 960), 128, np.uint8)):
        assert recognise.look(picture, Wanted()) is None


def test_blotches_are_no_board():
    rng = np.random.default_rng(0)
    pictures = [
        cv2.normalize(cv2.GaussianBlur(rng.integers(0, 256, (300, 400)).astype(np.uint8), (0, 0), 2), None, 0, 255, 32)
        for _ in range(12)
    ]
    seen = gather.collect(pictures, Wanted())
    assert not seen.is_known
    with pytest.raises(fit.NoFit, match="none of the 12 pictures shows a whole board that is known"):
        seen.require_views()


def test_targets_on_the_command_line(tmp_path):
    out, yaml = tmp_path / "tags.png", tmp_path / "target.yaml"
    done("avcalib", "target", "--kind", "aprilgrid", "--square", "60", "--dpi", "100", "--kalibr", yaml, "-o", out)
    assert out.read_bytes().startswith(b"\x89PNG")
    assert "tagSize: 0.06\ntagSpacing: 0.3\n" in yaml.read_text()
    for wrong, why in (
        (["-o", tmp_path / "t.jpg"], "must end in .svg, .pdf or .png"),
        (["-o", tmp_path / "t.svg", "--format", "png"], "contradicts --format png"),
        (["--dpi", "100"], "--dpi has no effect with svg"),
        (["--kind", "circles", "--dictionary", "4X4_50"], "has no markers"),
        (["--kind", "charuco", "--dictionary", "9X9"], "unknown dictionary '9X9'; known are 4X4_100"),
        (["--kind", "charuco", "--dictionary", "4X4_50", "--board", "20x20"], "needs 200 markers"),
        (["--kind", "charuco", "--kalibr", yaml], "Kalibr does not know"),
    ):
        refused(run("avcalib", "target", *wrong), why, status=2)
        assert not (tmp_path / "t.jpg").exists()


def test_lengths_are_stated_only_where_the_print_was_measured(tmp_path):
    board = BOARDS["checkerboard"]
    for number, picture in enumerate(shots(board)[1][:7]):
        write_png(tmp_path / f"{number}.png", picture)
    result = run("avcalib", "calibrate", tmp_path, "--board-shape", "yes", "--force")
    assert "% of a square and stretched" in result.stderr
    assert "mm" not in result.stderr
    assert '"square_m":null' in result.stdout.decode()
    assert "board_shape_m" not in result.stdout.decode()
    result = run("avcalib", "calibrate", tmp_path, "--board-shape", "yes", "--force", "--square", "70")
    assert "mm and stretched" in result.stderr
    assert '"square_m":0.07' in result.stdout.decode()


def test_a_part_of_a_board_is_not_taken_for_a_smaller_board():
    board, rng = Board(10, 11, 0.06), np.random.default_rng(5)
    filmed = film(1, rng, board=board, distance=(0.5, 0.9))
    picture = photograph(filmed.rotations[0], filmed.translations[0], rng, board=board)
    rows = exact(filmed, board=board).pixels.reshape(10, 9, 2)
    assert sorted(saddles.sizes(picture)[0]) == [9, 10]
    apart = np.linalg.norm(rows[0, 1] - rows[0, 0])
    for corner in rows[0, 2:6]:  # something lies on four of the nine corners of the first row
        cv2.circle(picture, np.rint(corner).astype(int).tolist(), round(0.45 * apart), 120, -1)
    grids = saddles.find_grids(cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA))
    assert sorted((grids[0].columns, grids[0].rows)) == [9, 9]
    assert grids[0].is_cut
    assert not saddles.sizes(picture)


def test_the_map_from_the_unit_square_is_that_of_opencv():
    rng = np.random.default_rng(0)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    quads = (100 * (square + rng.uniform(-0.3, 0.3, (50, 4, 2))) + rng.uniform(0, 1000, (50, 1, 2))).astype(np.float32)
    expected = [cv2.getPerspectiveTransform(square, quad) for quad in quads]
    assert np.allclose(markers._from_unit_square(quads.astype(float)), expected, rtol=1e-9, atol=1e-9)
    in_a_line = np.array([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]])
    assert np.isfinite(markers._from_unit_square(in_a_line)).all()


@pytest.mark.parametrize(
    ("paper", "size"), [("letter", (215.9, 279.4)), ("Legal", (215.9, 355.6)), ("300x200.5", (200.5, 300.0))]
)
def test_a_sheet_has_the_size_that_is_asked_for(paper, size):
    page = drawing.draw(Board(7, 10, 0.015), paper)
    assert (page.width_mm, page.height_mm) == size


@pytest.mark.parametrize("paper", ["A9", "300", "0x3", "letterx", "-1x300"])
def test_a_paper_that_nobody_has_is_refused(paper):
    with pytest.raises(ValueError, match="must be A4, A3"):
        drawing.draw(Board(7, 10, 0.015), paper)
