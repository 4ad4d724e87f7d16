"""The KB-8 fit, against cameras that are known."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_boards import BOARD, THESIS, exact, field_error, film
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.calibration import field, fit, opencv, quality, robust
from avcli.lens import KannalaBrandt

SIZE = (1920, 1080)
WIDE = KannalaBrandt(300.0, 301.0, 511.0, 520.0, 0.01, -0.004, 0.001, -0.0002)
"""A 1024 × 1024 lens that sees beyond 90 degrees along its edges."""


def calibrated(observations, size=SIZE, **options):
    solution, good = robust.fit_robustly(observations, *size, **options)
    return solution, observations.views_of(good)


@pytest.fixture(scope="module")
def forty():
    return exact(film(40, np.random.default_rng(1)), noise=0.15, rng=np.random.default_rng(2))


def test_without_noise_the_camera_comes_back_exactly():
    observations = exact(film(20, np.random.default_rng(0)))
    solution, kept = calibrated(observations)
    assert kept.all()
    assert np.abs(solution.parameters[:4] - [THESIS.fx, THESIS.fy, THESIS.cx, THESIS.cy]).max() < 1e-6
    assert fit.view_rms(observations, solution).max() < 1e-8


@pytest.mark.parametrize("lens", [THESIS, WIDE])
def test_poses_from_rays_are_exact_beyond_90_degrees_too(lens):
    size = SIZE if lens is THESIS else (1024, 1024)
    filmed = film(30, np.random.default_rng(3), lens=lens, size=size)
    observations = exact(filmed, lens=lens)
    if lens is WIDE:
        assert quality.seen_angles(lens, observations.pixels).max() > np.pi / 2
    rotations, translations = fit.poses_from_rays(lens, observations)
    assert np.abs(rotations - filmed.rotations).max() < 1e-8
    assert np.abs(translations - filmed.translations).max() < 1e-8


def test_derivatives_agree_with_differences():
    shape = np.array([0.003, -0.001, 0.004])
    filmed = film(5, np.random.default_rng(4), shape=shape)
    observations = exact(filmed, noise=1.0, rng=np.random.default_rng(5))
    parameters = np.concatenate([[862.27, 862.70, 1049.47, 552.76, -0.0269, -0.0038, 0.0016, -0.0006], shape, [0.004]])
    free = fit.free_parameters(THESIS, True, True)
    at = fit.Solution(parameters, filmed.rotations, filmed.translations, free=free)
    columns = fit._linearise(observations, at)
    common, own = columns[:, :, :-7], columns[:, :, -7:-1]
    for i in range(12):
        h = 1e-6 * max(abs(parameters[i]), 1e-2)
        steps = [fit.stepped(at, sign * h * np.eye(12)[i], np.zeros((5, 6))) for sign in (1, -1)]
        slope = (fit.residuals(observations, steps[1]) - fit.residuals(observations, steps[0])) / (2 * h)
        assert np.abs(slope - common[:, :, i]).max() < 1e-6 * np.abs(common[:, :, i]).max() + 1e-6
    for i in range(6):
        h = 1e-7
        steps = [fit.stepped(at, np.zeros(12), np.tile(sign * h * np.eye(6)[i], (5, 1))) for sign in (1, -1)]
        slope = (fit.residuals(observations, steps[1]) - fit.residuals(observations, steps[0])) / (2 * h)
        assert np.abs(slope - own[:, :, i]).max() < 1e-6 * np.abs(own[:, :, i]).max()


def test_noise_gives_the_residual_and_the_error_that_theory_says(forty):
    solution, kept = calibrated(forty)
    assert kept.all()
    n = 2 * len(forty.pixels)
    expected = 0.15 * np.sqrt(2) * np.sqrt(1 - (8 + 6 * 40) / n)
    rms = np.sqrt((fit.residuals(forty, solution) ** 2).sum(1).mean())
    assert rms == pytest.approx(expected, rel=0.05)
    assert solution.sigma_px == pytest.approx(0.15, rel=0.05)
    observed = np.nanmax(quality.seen_angles(THESIS, forty.pixels))
    mean, largest = field_error(solution.lens, theta_max=observed)
    assert mean < 0.3
    assert largest < 1.0


def test_standard_deviations_are_honest():
    filmed = film(15, np.random.default_rng(6))
    pulls = []
    for seed in range(15):
        observations = exact(filmed, noise=0.15, rng=np.random.default_rng(seed))
        solution = fit.fit(observations, fit.start_from_rays(observations, THESIS))
        pulls.append((solution.parameters[:8] - _parameters(THESIS)) / np.sqrt(np.diag(solution.covariance)[:8]))
    spread = np.std(pulls, axis=0)
    assert ((spread > 0.5) & (spread < 1.4)).all()


def test_the_expected_field_error_is_the_mean_of_what_happens():
    filmed = film(15, np.random.default_rng(6))
    predicted, found = [], []
    for seed in range(15):
        observations = exact(filmed, noise=0.15, rng=np.random.default_rng(seed))
        solution = fit.fit(observations, fit.start_from_rays(observations, THESIS))
        predicted.append(np.nanmean(field.measured(observations, solution, *SIZE).sd_px))
        found.append(field_error(solution.lens)[0])
    assert np.median(found) == pytest.approx(np.median(predicted), rel=0.5)


def _parameters(lens):
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy, lens.k1, lens.k2, lens.k3, lens.k4])


def test_corners_beyond_90_degrees():
    filmed = film(25, np.random.default_rng(7), lens=WIDE, size=(1024, 1024))
    observations = exact(filmed, lens=WIDE, noise=0.05, rng=np.random.default_rng(8))
    assert (quality.seen_angles(WIDE, observations.pixels) > np.pi / 2).sum() > 40
    solution, kept = calibrated(observations, (1024, 1024))
    assert kept.all()
    mean, _ = field_error(solution.lens, WIDE, (1024, 1024), theta_max=np.deg2rad(100))
    assert mean < 0.1


def test_a_bowed_and_stretched_board():
    shape = np.array([0.0012, 0.0008, 0.003])
    filmed = film(40, np.random.default_rng(9), shape=shape)
    observations = exact(filmed, shape=shape, noise=0.05, rng=np.random.default_rng(10))
    rigid, _ = calibrated(observations)
    solution, kept = calibrated(observations, board_shape=True)
    assert kept.all()
    assert np.abs(solution.shape[:2].sum() - 0.002) < 0.0002
    assert solution.shape[2] == pytest.approx(0.003, abs=3e-4)
    assert field_error(rigid.lens)[0] > 1.0
    assert field_error(solution.lens)[0] < 0.1


def test_scrambled_and_noisy_views_do_not_matter(forty):
    rng = np.random.default_rng(11)
    alone, _ = calibrated(forty.of_views(np.arange(4, 40)))
    pixels = forty.pixels.copy()
    for view in (0, 1):
        rows = np.flatnonzero(forty.view == view)
        pixels[rows] = pixels[rng.permutation(rows)]
    noisy = forty.view == 2
    pixels[noisy] += 3 * rng.standard_normal((noisy.sum(), 2))
    foreign = forty.view == 3
    pixels[foreign] = pixels[foreign][::-1] * 0.7 + 200
    spoiled = fit.Observations(forty.view, forty.points, pixels, forty.sigma, forty.half_extent)
    solution, kept = calibrated(spoiled)
    assert not kept[:4].any()
    assert kept[4:].all()
    assert np.abs(solution.parameters[:4] - alone.parameters[:4]).max() < 1e-3


def test_one_outlier_in_each_view_costs_no_view(forty):
    rng = np.random.default_rng(12)
    pixels = forty.pixels.copy()
    pixels[forty.starts + rng.integers(0, 35, 40)] += 5 * rng.choice([-1, 1], (40, 2))
    spoiled = replace(forty, pixels=pixels)
    solution, good = robust.fit_robustly(spoiled, *SIZE)
    assert np.array_equal(good, (pixels == forty.pixels).all(1))
    assert field_error(solution.lens, theta_max=np.deg2rad(75))[0] < 0.3
    held_out = robust.held_out(spoiled, solution, good)
    assert held_out.rms_px == pytest.approx(0.15 * np.sqrt(2), rel=0.1)
    assert held_out.all_px == pytest.approx(np.sqrt(2 * 0.15**2 + 50 / 35), rel=0.1)


# --- invariants -------------------------------------------------------------------------------------------------------


def test_the_order_of_the_views_does_not_matter(forty):
    order = np.random.default_rng(13).permutation(40)
    rows = np.concatenate([np.flatnonzero(forty.view == view) for view in order])
    shuffled = fit.Observations(
        forty.view, forty.points[rows], forty.pixels[rows], forty.sigma[rows], forty.half_extent
    )
    one, other = calibrated(forty)[0], calibrated(shuffled)[0]
    assert np.abs(one.parameters[:4] - other.parameters[:4]).max() < 1e-3


@settings(max_examples=4, deadline=None)
@given(scale=st.floats(0.05, 20.0), shift=st.integers(-40, 40), turned=st.booleans())
def test_square_size_turned_boards_and_shifted_pictures(scale, shift, turned):
    filmed = film(10, np.random.default_rng(14))
    observations = exact(filmed, noise=0.05, rng=np.random.default_rng(15))
    start = fit.start_from_rays(observations, THESIS)
    before = fit.fit(observations, start)
    pixels = observations.pixels.copy()
    if turned:
        rows = observations.view == 3
        pixels[rows] = pixels[rows][::-1]
    other = fit.Observations(
        observations.view,
        observations.points * scale,
        pixels + np.array([shift, 0]),
        observations.sigma,
        observations.half_extent * scale,
    )
    moved = KannalaBrandt(860.0, 860.0, 1049.0 + shift, 553.0, -0.0269, -0.0038, 0.0016, -0.0006)
    after = fit.fit(other, fit.start_from_rays(other, moved))
    expected = before.parameters[:4] + np.array([0, 0, shift, 0])
    assert np.abs(after.parameters[:4] - expected).max() < 2e-3
    distance = np.linalg.norm(after.translations, axis=1) / np.linalg.norm(before.translations, axis=1)
    assert np.allclose(distance, scale, rtol=1e-4)


# --- what cannot be calibrated ----------------------------------------------------------------------------------------


def judged(filmed, noise=0.15, board=BOARD):
    observations = exact(filmed, noise=noise, rng=np.random.default_rng(20), board=board)
    solution, good = robust.fit_robustly(observations, *SIZE)
    held_out = robust.held_out(observations, solution, good).rms_px
    return quality.assess(observations.of_corners(good), solution, *SIZE, held_out)


@pytest.mark.parametrize("seed", range(2))
def test_degenerate_sets_are_refused_with_the_reason(seed):
    rng = np.random.default_rng(seed)
    centre = judged(film(40, rng, aim=((960, 540), 120), distance=(1.5, 2.5)))
    assert any("no corner was seen beyond" in reason for reason in centre.refusals)
    flat = judged(film(20, rng, tilt=0.0, aim=((1049, 552), 1), distance=(0.6, 1.5)))
    assert any("tilt" in reason for reason in flat.refusals)
    assert judged(film(1, rng)).refusals
    assert judged(film(3, rng)).refusals


@pytest.mark.parametrize("count", [20, 40])
def test_good_sets_are_not_refused(count):
    for seed in range(2):
        assert judged(film(count, np.random.default_rng(seed)), noise=0.05).refusals == ()


def test_too_few_corners_are_no_fit():
    observations = exact(film(1, np.random.default_rng(0)))
    few = fit.Observations(
        observations.view[:6],
        observations.points[:6],
        observations.pixels[:6],
        observations.sigma[:6],
        observations.half_extent,
    )
    with pytest.raises(fit.NoFit, match="too few"):
        fit.fit(few, fit.start_from_rays(few, THESIS))


# --- OpenCV -----------------------------------------------------------------------------------------------------------


def test_opencv_finds_the_same_camera_from_a_good_start():
    filmed = film(15, np.random.default_rng(21), aim=((1049, 553), 450))
    observations = exact(filmed, noise=0.1, rng=np.random.default_rng(22))
    ours = fit.refine(
        observations, fit.start_from_rays(observations, THESIS), fit.free_parameters(THESIS), np.inf, 60, 1e-14
    )
    theirs = opencv.calibrate(observations, *SIZE, start=THESIS)
    assert ours.parameters[:4] == pytest.approx(theirs.parameters[:4], abs=0.01)


def test_the_thesis_procedure_drops_pictures_above_its_limit():
    filmed = film(15, np.random.default_rng(21), aim=((1049, 553), 450))
    observations = exact(filmed, noise=0.1, rng=np.random.default_rng(22))
    observations.pixels[observations.view == 4] += 2 * np.random.default_rng(23).standard_normal((35, 2))
    solution, kept = opencv.thesis_procedure(observations, *SIZE)
    assert not kept[4]
    assert kept.sum() >= 10
    assert np.isfinite(solution.covariance).all()
