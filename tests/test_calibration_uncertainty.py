"""What a calibration states of its own errors, against errors that are known: shared within a view, or each its own."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_boards import BOARD, THESIS, exact, film
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.calibration import field, fit, quality, robust, uncertainty
from avcli.calibration.circle import Circle, Light, find
from avcli.calibration.pupil import PUPIL, from_pupil
from avcli.lens import KannalaBrandt

SIZE = (1920, 1080)
GRID = field.grid(*SIZE, step=120).reshape(-1, 2)


def filmed(seed, views, shared, noise=0.15):
    """Corners whose error is noise, and a bend of the picture that is shared within each view (sd `shared` px)."""
    rng = np.random.default_rng(seed)
    o = exact(film(views, rng, tilt=0.9), noise=noise, rng=rng)
    u, v = (o.points / o.half_extent).T
    terms = np.stack([u, v, u * u, u * v, v * v], -1)
    bends = shared * rng.standard_normal((views, 5, 2))
    o = replace(o, pixels=o.pixels + np.einsum("nb,nbi->ni", terms, bends[o.view]))
    solution = fit.refine(o, fit.start_from_rays(o, THESIS), fit.free_parameters(THESIS), np.inf, 20)
    spread, sigma = fit.covariance(o, solution)
    return o, replace(solution, covariance=spread, sigma_px=sigma)


def pull(o, solution):
    """Actual over stated error of the lens over the picture where corners were seen."""
    rays = THESIS.unproject(GRID[field.seen_angles(THESIS, GRID) < np.nanmax(field.seen_angles(THESIS, o.pixels))])
    moved, _ = field.sensitivity(solution.lens, o.pixels, rays)
    off = moved @ (solution.parameters[: -fit.BESIDE] - THESIS.parameters)
    return np.sum(off**2) / np.sum(field.errors_px(solution, o.pixels, rays) ** 2)


@pytest.mark.parametrize("shared", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("views", [8, 24])
def test_the_stated_error_is_true_whether_errors_are_shared_or_not(views, shared):
    found = np.sqrt(np.mean([pull(*filmed(seed, views, shared)) for seed in range(8)]))
    assert 0.5 < found < 1.4


def test_independent_errors_alone_would_state_far_too_little():
    o, solution = filmed(0, 24, 1.0)
    views = fit.by_view(o, solution).views
    assert np.sqrt(np.diag(uncertainty.covariance(views)) / np.diag(uncertainty.noise(views))).min() > 1.5
    assert uncertainty.inflation(uncertainty.covariance(views), uncertainty.noise(views)) > 2


def test_pooled_views_disagree_equally_in_all_directions():
    o, solution = filmed(0, 12, 1.0)
    views = fit.by_view(o, solution).views
    pooled, spread = uncertainty.pooled(views), uncertainty.covariance(views)
    ratio = np.linalg.eigvals(np.linalg.solve(pooled, spread)).real
    assert ratio.mean() == pytest.approx(1.0)
    assert ratio.min() < 0.5


@pytest.mark.parametrize("shared", [0.0, 0.5])
def test_halves_differ_by_what_they_state(shared):
    tested = [field.split_halves(*filmed(seed, 20, shared), GRID, splits=20) for seed in range(5)]
    assert 0.5 < np.sqrt(np.mean([one.ratio**2 for one in tested])) < 1.4
    assert all(one.splits == 20 for one in tested)


def test_halves_of_few_views_are_judged_by_both_together():
    """Student's t of four views each would call true statements 1.4 times too cautious."""
    ratios = []
    for seed in range(100, 116):
        o, solution = filmed(seed, 8, 0.5)
        angles = field.seen_angles(solution.lens, np.concatenate([GRID, o.pixels]))
        seen = angles[: len(GRID)] < np.nanmax(angles[len(GRID) :])
        ratios.append(field.split_halves(o, solution, GRID[seen]).ratio)
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_one_step_to_the_halves_is_as_good_as_a_fit():
    o, solution = filmed(3, 16, 0.3)
    quick, fitted = (field.split_halves(o, solution, GRID, splits=8, refit=refit) for refit in (False, True))
    assert quick.ratio == pytest.approx(fitted.ratio, rel=0.15)
    assert quick.actual_px == pytest.approx(fitted.actual_px, rel=0.15)


def test_with_few_views_nothing_is_tested():
    o, solution = filmed(4, 7, 0.1)
    assert np.isnan(field.split_halves(o, solution, GRID).ratio)
    assert np.isnan(field.apart(o, solution, GRID)).all()


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 12), st.integers(2, 6), st.integers(0, 1000))
def test_the_covariance_is_symmetric_and_at_least_that_of_independent_corners(count, p, seed):
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((count, 20, p)) * 10.0 ** rng.uniform(-3, 3, p)
    e = rng.standard_normal((count, 20))
    views = uncertainty.Views(
        np.einsum("vna,vnb->vab", J, J), np.einsum("vna,vn->va", J, e), (e**2).sum(1), np.full(count, 20)
    )
    found, least = uncertainty.covariance(views), uncertainty.noise(views)
    assert np.array_equal(found, found.T)
    scale = 1 / np.sqrt(np.diag(least))
    assert (
        np.linalg.eigvalsh((found - least) * np.outer(scale, scale)).min()
        > -1e-6 * np.diag(found).max() * scale.max() ** 2
    )
    order = rng.permutation(count)
    assert np.allclose(uncertainty.covariance(views.of(order)) * np.outer(scale, scale), found * np.outer(scale, scale))


def test_views_that_say_nothing_of_a_direction_leave_it_unknown_and_finite():
    information = np.zeros((6, 2, 2))
    information[:, 0, 0] = 1.0
    views = uncertainty.Views(information, np.zeros((6, 2)), np.full(6, 20.0), np.full(6, 20))
    found = uncertainty.covariance(views)
    assert np.isfinite(found).all()
    assert found[0, 0] == pytest.approx(views.variance / 6)


def test_the_trusted_angle_grows_with_what_was_seen():
    o, solution = filmed(5, 24, 0.2)
    near = [field.trusted_angle(solution, o.pixels, np.deg2rad(limit)) for limit in (0.001, 0.05, 5.0)]
    assert near == sorted(near)
    assert near[-1] == pytest.approx(np.nanmax(field.seen_angles(solution.lens, o.pixels)))


def test_limits_do_not_depend_on_the_resolution():
    """The same pictures with four times the pixels are trusted up to the same angle."""
    o, solution = filmed(6, 20, 0.2)
    large = replace(o, pixels=4 * o.pixels + 1.5)
    start = THESIS.parameters
    big = type(THESIS)(*(4 * value for value in start[:2]), 4 * start[2] + 1.5, 4 * start[3] + 1.5, *start[4:])
    other = fit.refine(large, fit.start_from_rays(large, big), fit.free_parameters(big), np.inf, 20)
    other = replace(other, covariance=fit.covariance(large, other)[0])
    one, four = quality.assess(o, solution, *SIZE, 0.2), quality.assess(large, other, 7680, 4320, 0.8)
    assert four.theta_max_trusted == pytest.approx(one.theta_max_trusted, abs=np.deg2rad(1.5))
    assert four.refusals == one.refusals == ()


# --- the circle -------------------------------------------------------------------------------------------------------


def lit(width, height, circle, seed=0, black=3.0, softness=6.0):
    """A picture as through a circular fisheye, with things of all brightnesses in it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    away = np.hypot(x - circle.x, y - circle.y)
    blocks = rng.uniform(20, 240, (height // 40 + 1, width // 40 + 1)).repeat(40, 0).repeat(40, 1)[:height, :width]
    light = 1 / (1 + np.exp(np.clip((away - circle.radius) / softness, -50, 50)))
    return np.clip(black + blocks * light + rng.normal(0, 2, away.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("size", "true"),
    [
        ((1280, 1024), Circle(600.0, 530.0, 480.0)),  # whole on the sensor
        ((1920, 1080), Circle(970.0, 520.0, 530.0)),
        ((1032, 778), Circle(545.0, 370.0, 540.0)),  # cropped: only the corners are black
        ((1000, 1000), Circle(505.0, 498.0, 470.0)),
    ],
)
def test_the_circle_is_found_whole_or_cropped(size, true):
    light = Light()
    for seed in range(6):
        light.take(lit(*size, true, seed))
    found = light.circle
    assert found is not None
    assert np.hypot(found.x - true.x, found.y - true.y) < 0.015 * true.radius
    assert found.radius == pytest.approx(true.radius, rel=0.04)


def test_no_circle_where_there_is_none():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:240, :320]
    away = np.hypot(x - 160, y - 120)
    assert find(rng.uniform(0, 255, (240, 320))) is None
    assert find(np.full((240, 320), 100.0)) is None
    assert find(np.zeros((240, 320))) is None
    assert find(220 * np.cos(np.arctan(away / 150)) ** 4) is None  # vignetting fades
    dark_room = np.full((240, 320), 4.0)
    dark_room[60:180, 90:250] = 200
    assert find(dark_room) is None
    assert find(np.zeros((4, 5))) is None
    assert Light().circle is None


def test_black_corners_count_for_nothing():
    o, solution = filmed(7, 20, 0.2)
    circle = Circle(960.0, 540.0, 500.0)
    whole, cut = (quality.assess(o, solution, *SIZE, 0.2, one) for one in (None, circle))
    assert cut.theta_max_picture < whole.theta_max_picture
    assert np.isnan(cut.field.sd_px[~circle.holds(cut.field.pixels)]).all()
    assert cut.lit_cells.sum() < whole.lit_cells.sum() == whole.lit_cells.size
    assert not cut.trusted[~cut.field.lit].any()


@pytest.mark.parametrize("views", [3, 20])  # few: the places on the board are eliminated first; many: the poses
def test_any_part_of_the_views_is_solved_as_the_whole_system_would_be(views):
    o, solution = filmed(5, 24, 0.3)
    known = fit.blocks(o, solution, held=1e5).of(np.arange(views))
    k, corners = solution.free.sum(), known.place.shape[1]
    size = k + 6 * views + 3 * corners
    N, right = np.zeros((size, size)), np.zeros(size)
    own = k + np.arange(6 * views).reshape(views, 6)
    place = k + 6 * views + np.arange(3 * corners).reshape(corners, 3)
    N[:k, :k], right[:k] = known.gram[:, :k, :k].sum(0), known.gram[:, :k, -1].sum(0)
    for v in range(views):
        N[np.ix_(own[v], own[v])], N[np.ix_(own[v], np.arange(k))] = known.gram[v, k:-1, k:-1], known.gram[v, k:-1, :k]
        right[own[v]] = known.gram[v, k:-1, -1]
        for c in range(corners):
            N[np.ix_(place[c], own[v])] = known.cross[v, c, :, k:-1]
    for c in range(corners):
        N[np.ix_(place[c], place[c])] = known.place[:, c].sum(0) + known.held * np.eye(3)
        N[np.ix_(place[c], np.arange(k))] = known.cross[:, c, :, :k].sum(0)
        right[place[c]] = known.cross[:, c, :, -1].sum(0)
    N = np.tril(N) + np.tril(N, -1).T
    scale = 1 / np.sqrt(np.diag(N))
    expected = scale * np.linalg.solve(N * np.outer(scale, scale), right * scale)
    step = known.step()
    np.testing.assert_allclose(step.common, expected[:k], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(step.own, expected[own], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(step.errors, expected[place], rtol=1e-5, atol=1e-8)
    # What holds the errors at zero is no information of the views.
    spread = np.linalg.inv(N * np.outer(scale, scale))[:k, :k] * np.outer(scale[:k], scale[:k])
    assert (np.diag(np.linalg.inv(known.views.information.sum(0))) > 0.999 * np.diag(spread)).all()


WIDE = KannalaBrandt(338.0, 338.5, 514.0, 388.0, 0.01, -0.01, 0.002, -0.0005)
WIDE_SIZE = (1032, 778)


def test_views_held_out_cost_what_the_step_of_the_others_leaves_them():
    o, solution = filmed(20, 12, 0.1)
    known, part = fit.blocks(o, solution), np.arange(12) % 5
    tests = [part == fold for fold in range(5)]
    cost = sum(known.of(test).after(known.of(~test).step()).sum() for test in tests)
    assert known.crossed(part) == pytest.approx(cost, rel=1e-9)
    step = known.step()
    np.testing.assert_allclose(known.follow(step.common), step.own, rtol=1e-6, atol=1e-12)


def test_small_matrices_are_inverted_as_numpy_does():
    matrices = np.random.default_rng(3).normal(size=(6, 2, 2))
    matrices[4], matrices[5] = [[1.0, 2.0], [2.0, 4.0]], 0.0
    np.testing.assert_allclose(field._inverses(matrices), np.linalg.pinv(matrices, rcond=1e-9), rtol=1e-9, atol=1e-12)


def near(seed, views, pupil=0.0, printed=0.0, shared=0.0):
    """Corners of boards near a wide lens: its centre moves, the print is wrong (squares), views share errors (px)."""
    rng = np.random.default_rng(seed)
    shown = film(views, rng, lens=WIDE, size=WIDE_SIZE, distance=(0.3, 0.9), tilt=0.9)
    o = exact(shown, lens=WIDE, pupil=pupil, noise=0.05, rng=rng)
    wrong = printed * BOARD.square_m * rng.standard_normal((len(BOARD.points), 3))
    places = fit.surface(o.points, np.zeros(3), o.half_extent) + np.tile(wrong, (views, 1))
    seen = np.einsum("nij,nj->ni", shown.rotations[o.view], places) + shown.translations[o.view]
    u, v = (o.points / o.half_extent).T
    bends = shared * rng.standard_normal((views, 5, 2))
    bent = np.einsum("nb,nbi->ni", np.stack([u, v, u * u, u * v, v * v], -1), bends[o.view])
    pixels = WIDE.project(from_pupil(seen, pupil)[0]) + bent + 0.05 * rng.standard_normal((*seen.shape[:1], 2))
    return replace(o, pixels=pixels)


def uneven(seed, views):
    """As `near`, but the errors that a view shares are far larger in some views than in others."""
    o = near(seed, views)
    rng = np.random.default_rng(seed)
    u, v = (o.points / o.half_extent).T
    bends = 0.05 * np.exp(rng.standard_normal((views, 1, 1))) * rng.standard_normal((views, 5, 2))
    bent = np.einsum("nb,nbi->ni", np.stack([u, v, u * u, u * v, v * v], -1), bends[o.view])
    return replace(o, pixels=o.pixels + bent)


def far_off(o, solution):
    """Actual and stated error of the wide lens for what is far away, px, where corners were seen."""
    grid = field.grid(*WIDE_SIZE, step=60).reshape(-1, 2)
    rays = WIDE.unproject(grid[field.seen_angles(WIDE, grid) < np.nanmax(field.seen_angles(WIDE, o.pixels))])
    off = solution.lens.project(field.turned_to(WIDE, solution.lens, o.pixels, rays)) - WIDE.project(rays)
    return np.sqrt((off**2).sum(1).mean()), np.sqrt((field.errors_px(solution, o.pixels, rays) ** 2).mean())


def test_corners_beyond_the_robust_limit_hold_the_lens_half_as_well():
    o, solution = filmed(8, 12, 0.3)
    near_all, far_all = (replace(solution, delta_px=delta) for delta in (1e9, 1e-9))
    k = solution.free.sum()
    same, plain = (fit.blocks(o, near_all, newton=newton).gram for newton in (True, False))
    np.testing.assert_array_equal(same, plain)
    bent, weighed = (fit.blocks(o, far_all, newton=newton).gram for newton in (True, False))
    np.testing.assert_allclose(bent[:, :k, :k], weighed[:, :k, :k] / 2)
    np.testing.assert_allclose(bent[:, :-1, -1], weighed[:, :-1, -1])


def test_views_whose_errors_differ_in_size_state_what_is_true():
    pulls = []
    for seed in range(300, 316):
        o = uneven(seed, 24)
        solution, good = robust.fit_robustly(o, *WIDE_SIZE)
        pulls.append(np.divide(*far_off(o.of_corners(good), solution)))
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_views_that_fit_less_well_count_less():
    plain, weighed = [], []
    for seed in range(700, 708):
        o = uneven(seed, 20)
        solution, good = robust.fit_robustly(o, *WIDE_SIZE)
        plain.append(far_off(o, solution)[0])
        o = robust.weighed(o, solution, good)
        weighed.append(far_off(o, fit.settled(o.of_corners(good), solution))[0])
    assert np.sum(np.square(weighed)) < 0.8 * np.sum(np.square(plain))


@pytest.mark.parametrize("seed", [50, 51, 52])
def test_a_lens_whose_centre_moves_is_right_far_away(seed):
    o = near(seed, 20, pupil=0.004, shared=0.02)
    moving, _ = robust.fit_robustly(o, *WIDE_SIZE)
    assert moving.pupil == pytest.approx(0.004, rel=0.2)
    free = moving.free.copy()
    free[-1] = False
    central = replace(moving, parameters=np.append(moving.parameters[:-1], 0.0))
    central = fit.refine(o, central, free, moving.delta_px, 40)
    central = replace(central, covariance=fit.covariance(o, central)[0])
    (actual, stated), (off, said) = far_off(o, moving), far_off(o, central)
    assert actual < 2 * stated
    assert off > 3 * max(said, actual)  # a single centre is wrong, and sure of it


@pytest.mark.parametrize(("pupil", "recedes"), [(-0.004, True), (0.0, False), (0.004, False)])
def test_a_centre_that_moves_back_is_named_in_the_verdict(pupil, recedes):
    o = near(51, 20, pupil=pupil, shared=0.1)
    solution, good = robust.fit_robustly(o, *WIDE_SIZE)
    found = quality.assess(o.of_corners(good), solution, *WIDE_SIZE, held_out=0.1)
    assert (found.recedes > quality.RECEDES_LIMIT) == recedes
    assert ("moves back" in found.verdict) == recedes
    assert any("flat window" in words for words in found.advice) == recedes


@pytest.mark.parametrize("pupil", [0.0, 0.001])
def test_a_shift_of_the_centre_that_views_hardly_show_is_in_the_stated_error(pupil):
    pulls = []
    for seed in range(50, 66):
        o = near(seed, 20, pupil=pupil, shared=0.1)
        solution, good = robust.fit_robustly(o, *WIDE_SIZE)
        pulls.append(np.divide(*far_off(o.of_corners(good), solution)))
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_far_boards_leave_the_shift_of_the_centre_to_what_is_known_before():
    rng = np.random.default_rng(3)
    o = exact(film(12, rng, distance=(4.0, 6.0), whole=False, tilt=0.1), noise=0.2, rng=rng)
    solution = fit.fit(o, fit.scan_focal(o, 1920, 1080))
    unit = fit.pupil_unit(o, solution)
    assert BOARD.square_m < unit == pytest.approx(np.sqrt(5.0 * BOARD.square_m), rel=0.1)
    assert np.sqrt(solution.covariance[-1, -1]) == pytest.approx(PUPIL.sd * unit, rel=0.2)
    assert solution.pupil == pytest.approx(PUPIL.mean * unit, abs=PUPIL.sd * unit)


def test_what_is_known_of_the_centre_weighs_more_where_views_disagree():
    rng = np.random.default_rng(4)
    o = exact(film(12, rng, distance=(2.0, 3.0), whole=False, tilt=0.2), noise=0.05, rng=rng)
    u, v = (o.points / o.half_extent).T
    bends = 0.5 * rng.standard_normal((12, 5, 2))
    bent = np.einsum("nb,nbi->ni", np.stack([u, v, u * u, u * v, v * v], -1), bends[o.view])
    o = replace(o, pixels=o.pixels + bent)
    solution = fit.fit(o, fit.scan_focal(o, 1920, 1080))
    alone = fit.by_view(o, solution).unheld().views
    assert solution.doubt == pytest.approx(
        np.sqrt(uncertainty.covariance(alone)[-1, -1] / uncertainty.noise(alone)[-1, -1]), rel=0.1
    )
    assert solution.doubt > 2
    unit = fit.pupil_unit(o, solution)
    known = PUPIL.sd * unit
    assert np.sqrt(solution.covariance[-1, -1]) < 1.5 * known < np.sqrt(uncertainty.covariance(alone)[-1, -1])
    assert solution.pupil == pytest.approx(PUPIL.mean * unit, abs=known)


def test_a_lens_that_went_astray_states_no_error():
    astray = uncertainty.Views(np.full((5, 3, 3), np.eye(3)), np.full((5, 3), 1e300), np.ones(5), np.full(5, 70.0))
    with np.errstate(over="ignore", invalid="ignore"):
        assert np.isinf(uncertainty.covariance(astray)).all()


def test_what_no_lens_model_has_is_told():
    o = near(70, 20, pupil=0.002, shared=0.05)
    whole, good = robust.fit_robustly(o, *WIDE_SIZE)
    assert robust.missed(o.of_corners(good), whole) < 0.1
    x, y = ((o.pixels - np.array(WIDE_SIZE) / 2) / WIDE_SIZE[0]).T
    o = replace(o, pixels=o.pixels + 20.0 * np.stack([y * x * x, x * x * x], -1))  # as through a window
    bent, good = robust.fit_robustly(o, *WIDE_SIZE)
    some = o.of_corners(good)
    found = quality.assess(some, bent, *WIDE_SIZE, 0.1)
    assert found.missed == robust.missed(some, bent) > quality.MISSED_LIMIT
    assert "does not describe this lens" in found.verdict
    assert any("--lens-model" in line for line in found.advice)
    few = some.of_views(np.arange(7))
    assert np.isnan(robust.missed(few, bent.of_views(np.arange(7))))


@pytest.mark.parametrize("seed", [50, 51, 52])
def test_a_centre_that_moves_is_found_on_a_board_that_is_printed_badly(seed):
    o = near(seed, 20, pupil=0.004, printed=0.01)
    solution, good = robust.fit_robustly(o, *WIDE_SIZE)
    learned, solution, _ = robust.fit_board(o, solution, good)
    assert solution.pupil == pytest.approx(0.004, rel=0.2)
    actual, stated = far_off(learned, solution)
    assert actual < 2 * stated


def test_a_bad_print_is_held_no_tighter_than_it_is():
    """The flat fit's residuals contain the print's errors; held by them, the lens was five times as far off."""
    pulls = []
    for seed in range(50, 56):
        o = near(seed, 20, printed=0.01)
        solution, good = robust.fit_robustly(o, *WIDE_SIZE)
        learned, solution, _ = robust.fit_board(o, solution, good)
        assert solution.sigma_px < 0.06
        assert np.sqrt((learned.errors**2).mean()) == pytest.approx(0.01 * BOARD.square_m, rel=0.25)
        pulls.append(np.divide(*far_off(learned, solution)))
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_a_corner_that_hides_behind_a_bad_print_is_left_out():
    o = near(60, 20, printed=0.01)
    pixels, bad = o.pixels.copy(), 333
    pixels[bad] += [3.0, 0.0]
    spoiled = replace(o, pixels=pixels)
    solution, good = robust.fit_robustly(spoiled, *WIDE_SIZE)
    assert good[bad]
    learned, fitted, left = robust.fit_board(spoiled, solution, good)
    assert np.flatnonzero(good & ~left).tolist() == [bad]
    assert fit.view_rms(learned.of_corners(left), fitted).max() < 0.2


def test_views_that_also_tell_the_places_of_the_corners_state_more():
    """A view that helps to tell the places pulls them towards itself: its score says less than its share."""
    learned, solution, _ = robust.fit_board(
        *(lambda o: (o, *robust.fit_robustly(o, *WIDE_SIZE)))(near(60, 8, printed=0.01))
    )
    views = fit.by_view(learned, solution).views
    spent = np.linalg.eigvalsh(views.information - views.own)
    assert spent.min() > -1e-6 * spent.max()
    whole, plain = uncertainty.covariance(views), uncertainty.covariance(views._replace(own=None))
    assert np.trace(np.linalg.solve(plain, whole)) > len(plain)
    same = uncertainty.covariance(views._replace(own=views.information))
    assert np.allclose(same, plain, rtol=1e-5)


def test_one_step_to_the_halves_is_as_good_as_a_fit_where_the_print_is_bad():
    o = near(61, 16, printed=0.01, shared=0.05)
    learned, solution, _ = robust.fit_board(o, *robust.fit_robustly(o, *WIDE_SIZE))
    grid = field.grid(*WIDE_SIZE, step=60).reshape(-1, 2)
    tested = [field.split_halves(learned, solution, grid, splits=10, refit=refit) for refit in (False, True)]
    assert tested[0].ratio == pytest.approx(tested[1].ratio, rel=0.15)
    assert tested[0].stated_px == pytest.approx(tested[1].stated_px, rel=0.15)
