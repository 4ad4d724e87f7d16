"""Calibration as a library: pictures in, a Calibration out; any lens model of avcli.lens; gathering."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
from calibration_boards import BOARD, HALF, HALF_SIZE, THESIS, exact, field_error, film, photographs

from avcli.calibration import calibrate, choose, corners, fit, gather, quality, robust
from avcli.calibration.settings import FitSettings
from avcli.calibration.target import Board
from avcli.formats.media import MediaError, write_png
from avcli.lens import (
    BrownConrady,
    Division,
    DoubleSphere,
    ExtendedUnified,
    KannalaBrandt,
    Rational,
    TangentialBrownConrady,
    TangentialKannalaBrandt,
    Unified,
    name_of,
    variants,
)

SIZE = (1920, 1080)


@pytest.fixture(scope="module")
def shots():
    rng = np.random.default_rng(1)
    return photographs(film(8, rng, lens=HALF, size=HALF_SIZE), rng)


def test_the_sample_in_the_docstring_runs(shots, tmp_path, monkeypatch):
    (tmp_path / "boards").mkdir()
    for number, shot in enumerate(shots):
        write_png(tmp_path / "boards" / f"{number}.png", shot)
    monkeypatch.chdir(tmp_path)
    finder = doctest.DocTestFinder(recurse=False)
    (sample,) = finder.find(calibrate.calibrate, globs={"calibrate": calibrate.calibrate})
    assert doctest.DocTestRunner().run(sample).failed == 0


def test_arrays_and_iterators_give_the_same_lens(shots):
    listed = calibrate.calibrate(shots, board=(6, 8), square_m=0.095)
    streamed = calibrate.calibrate(iter(shots), board=Board(6, 8, 0.095))
    assert listed.camera_config() == streamed.camera_config()
    assert (listed.width, listed.height, len(listed.views)) == (*HALF_SIZE, 8)


def test_a_wrong_count_of_squares_is_corrected_and_no_picture_is_lost(shots):
    said = []
    seen = gather.collect(iter(shots[:6]), Board(5, 7, 0.095), say=said.append)
    assert str(seen.board) == "6x8"
    assert len(said) == 1
    assert "continuing with a board of 6x8 squares" in said[0]
    assert len(seen.views) == len(seen) == 6


def test_pictures_without_a_board_are_no_fit():
    with pytest.raises(fit.NoFit, match="none of the 3 pictures shows a whole board"):
        calibrate.calibrate([np.full((200, 300), 90, np.uint8)] * 3)
    with pytest.raises(fit.NoFit, match="no pictures"):
        calibrate.calibrate([])


def test_boards_that_are_never_held_still_are_no_fit(shots):
    seen = gather.collect(shots[:3], BOARD, reason=lambda *_: "moving")
    with pytest.raises(fit.NoFit, match="3 of the 3 pictures show the board, but it moves in all of them"):
        seen.require_views()


def test_a_source_that_fails_leaves_what_it_gave(shots):
    def broken():
        yield from shots[:5]
        raise MediaError("the cable is out")

    said = []
    assert len(gather.collect(broken(), BOARD, say=said.append).views) == 5
    assert said == ["the cable is out; the calibration continues with the pictures before it"]

    def nothing():
        yield shots[0][:100, :100]
        raise MediaError("the cable is out")

    with pytest.raises(MediaError):
        gather.collect(nothing(), BOARD)


def test_after_ends_the_search(shots):
    seen = gather.collect(shots, BOARD, eager=True, after=lambda seen, _grey, _view: len(seen) == 3)
    assert len(seen) == 3


# --- lens models ------------------------------------------------------------------------------------------------------

TRUE = {
    "kannala_brandt": THESIS,
    "brown_conrady": BrownConrady(1400.0, 1403.0, 951.0, 548.0, -0.12, 0.03, 0.0, 0.0),
    "division": Division(1100.0, 1098.0, 955.0, 545.0, -0.05, 0.01, 0.0, 0.0),
    "rational": Rational(1200.0, 1203.0, 951.0, 548.0, 0.3, 0.02, 0.0, 0.5, 0.05, 0.0, 1e-3, -5e-4),
    "double_sphere": DoubleSphere(700.0, 703.0, 951.0, 548.0, -0.2, 0.59),
    "eucm": ExtendedUnified(860.0, 863.0, 951.0, 548.0, 0.62, 1.1),
    "ucm": Unified(860.0, 863.0, 951.0, 548.0, 0.6),
    "kannala_brandt+tangential": TangentialKannalaBrandt(*THESIS.parameters, 1e-3, -5e-4, 2e-3, 1e-3),
    "brown_conrady+tangential": TangentialBrownConrady(1400.0, 1403.0, 951.0, 548.0, -0.12, 0.03, 0.0, 0.0, 1e-3, 5e-4),
}


@pytest.mark.parametrize("model", variants())
def test_every_lens_model_comes_back_from_exact_corners(model):
    true = TRUE[model]
    observations = exact(film(20, np.random.default_rng(3), lens=true), lens=true)
    solution, good = robust.fit_robustly(observations, *SIZE, model=model)
    assert good.mean() > 0.95
    assert type(solution.lens) is variants()[model]
    assert np.abs(fit.residuals(observations, solution)).max() < 1e-3
    on_axis = [lens.project_jacobian([0.0, 0.0, 1.0])[1][:, :2] for lens in (solution.lens, true)]
    assert np.abs(on_axis[0] - on_axis[1]).max() < 0.5
    assert np.abs(solution.parameters[2:4] - [true.cx, true.cy]).max() < 0.5


@pytest.mark.parametrize(("true", "chosen"), [("ucm", Unified), ("kannala_brandt+tangential", TangentialKannalaBrandt)])
def test_auto_takes_the_simplest_model_that_fits(true, chosen):
    rng = np.random.default_rng(5)
    seen = exact(film(20, rng, lens=TRUE[true]), lens=TRUE[true])  # twelve views leave it to chance
    seen = replace(seen, pixels=seen.pixels + rng.normal(0, 0.1, seen.pixels.shape))
    solution, good = robust.fit_robustly(seen, *SIZE)
    held_out = robust.held_out(seen, solution, good)
    found, error, tried = choose.choose(seen, solution, good, held_out, *SIZE, board_errors=False)
    assert type(found.lens) is chosen
    assert error.rms_px <= held_out.rms_px * 1.02
    assert [one.held_out_px for one in tried] == sorted(one.held_out_px for one in tried)
    assert {one.name for one in tried} >= {"kannala_brandt", "ucm", "eucm", "double_sphere"}


def test_auto_says_what_it_tried(shots):
    found = calibrate.calibrate(shots, board=(6, 8), settings=FitSettings(lens_model="auto", board_shape="no"))
    assert found.camera_config()["lens_model"] == name_of(found.lens)
    assert found.camera_config()["calibration"]["tried_rms_px"].keys() == {one.name for one in found.tried}


def test_the_config_names_the_model_that_was_fitted(shots):
    found = calibrate.calibrate(shots, settings=FitSettings(lens_model="brown_conrady", board_shape="no"))
    assert found.camera_config()["lens_model"] == "brown_conrady"
    assert isinstance(found.lens, BrownConrady)
    assert isinstance(calibrate.calibrate(shots, settings=FitSettings(board_shape="no")).lens, KannalaBrandt)


def test_a_lens_behind_a_tilted_window_gets_a_prism_unless_a_model_is_asked_for():
    size = (480, 360)
    lens = TangentialKannalaBrandt(190.0, 190.5, 238.0, 181.0, 0.1, 0.03, 0.0, 0.0, 0.013, 0.004, -0.009, -0.03)
    rng = np.random.default_rng(2)
    filmed = film(12, rng, lens=lens, size=size)
    pictures = photographs(filmed, rng, lens=lens, size=size, oversample=2)
    found = calibrate.calibrate(pictures, board=(6, 8))
    assert type(found.lens) is TangentialKannalaBrandt
    assert {one.name for one in found.tried} <= {choose.START, *choose.NEXT}
    assert "describe" not in found.verdict
    assert field_error(found.lens, lens, size)[0] < 0.1
    plain = calibrate.calibrate(pictures, board=(6, 8), settings=FitSettings(lens_model="kannala_brandt"))
    assert type(plain.lens) is KannalaBrandt
    assert not plain.tried
    assert plain.quality.missed > quality.MISSED_LIMIT > found.quality.missed
    assert found.held_out.rms_px < 0.5 * plain.held_out.rms_px


def test_a_model_that_turns_the_camera_is_no_choice():
    """A narrow lens hardly tells a turn of the camera from tangential terms."""
    assert choose.keeps_axis(HALF, replace(HALF, cx=HALF.cx + 30.0))
    assert not choose.keeps_axis(HALF, replace(HALF, cy=HALF.cy + 150.0))
    assert not choose.keeps_axis(HALF, replace(HALF, cx=1e5))


class UnderWater:
    """A fisheye right behind an upright window under water: Snell's law, 1.333."""

    air = KannalaBrandt(287.0, 287.2, 424.0, 401.0, -0.015, 0.09, -0.16, 0.1)

    def project(self, points):
        ways = points / np.linalg.norm(points, axis=1, keepdims=True)
        across = 1.333 * ways[:, :2]
        with np.errstate(invalid="ignore"):
            ahead = np.where(ways[:, 2] > 0, np.sqrt(1 - (across**2).sum(1)), np.nan)
        return self.air.project(np.column_stack([across, ahead]))

    def unproject(self, pixels):
        across = self.air.unproject(pixels)[:, :2] / 1.333
        return np.column_stack([across, np.sqrt(1 - (across**2).sum(1))])


def test_a_lens_behind_an_upright_window_gets_a_model_that_reaches_its_rim():
    size, rng, window = (848, 800), np.random.default_rng(4), UnderWater()
    filmed = film(20, rng, lens=window, size=size, distance=(1.0, 2.0), margin=2)
    seen = exact(filmed, lens=window, noise=0.05, rng=rng)
    blank = np.zeros((len(BOARD.points), 2 * corners.PATCH + 1, 2 * corners.PATCH + 1), np.uint8)
    views = [
        corners.View(np.arange(len(blank)), pixels, blank, np.rint(pixels).astype(int), *size)
        for pixels in seen.pixels.reshape(20, -1, 2)
    ]
    found = calibrate.calibrate_views(BOARD, views)
    plain = calibrate.calibrate_views(BOARD, views, FitSettings(lens_model="kannala_brandt"))
    assert not isinstance(found.lens, KannalaBrandt)
    assert {one.name for one in found.tried} == {choose.START, *choose.NEXT}
    assert found.held_out.all_px < 0.09 < 0.14 < plain.held_out.all_px


def test_a_model_that_went_astray_is_no_choice_however_unsure_it_is():
    good, view = np.ones(40, bool), np.arange(40) // 4
    errors = {"rational": np.ones(40), "ucm": np.where(view == 3, 1e9, 1.0)}
    tried = choose.compared({name: robust.HeldOut(one, good) for name, one in errors.items()}, view, good)
    assert tried[1].is_as_good
    assert choose.simplest(tried) == "rational"


def test_an_unknown_model_names_the_known_ones(shots):
    with pytest.raises(ValueError, match="known are kannala_brandt"):
        calibrate.calibrate(shots, settings=FitSettings(lens_model="pinhole"))


def test_pictures_before_the_first_board_are_looked_at_again(shots, monkeypatch):
    """While no picture shows a board, most are looked at quickly; a board that is only found thoroughly is not lost."""
    find = corners.find

    def only_thoroughly(picture, board, *, thorough=True, likely=True):
        return find(picture, board) if thorough else None

    monkeypatch.setattr(corners, "find", only_thoroughly)
    blank = np.full_like(shots[0], 128)
    seen = gather.collect([blank, blank, blank, *shots[:7]], BOARD)
    assert [row["why"] for row in seen.records()] == ["no board"] * 3 + ["no fit"] * 7
    assert seen.names == [f"picture {number}" for number in range(3, 10)]
