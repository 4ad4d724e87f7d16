"""Known answers and properties of correlation, closed form, steered response and events."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.localization import correlation, events, multilateration, uncertainty
from avcli.localization.array import Array, time_steps
from avcli.localization.modulation import BANDS, MOST, Course, Levels
from avcli.localization.srp import SteeredResponse
from avcli.localization.windows import Band

FS = 16000
LAW = uncertainty.fitted_law()
FLOAT32 = 100 * float(np.finfo(np.float32).eps)
"""Relative error of a float32 sum over some thousand terms, whatever the processor's order of summation."""
places = st.tuples(st.floats(0.4, 4.2), st.floats(0.4, 4.2), st.floats(0.3, 1.85)).map(np.array)


def ranges(place, microphones=MICROPHONES):
    return np.linalg.norm(microphones - place, axis=1)


# --- spectra and correlation ------------------------------------------------------------------------------------------


def test_hann_is_symmetric_and_sums_to_half():
    window = correlation.hann(1001)
    np.testing.assert_allclose(window, window[::-1])
    assert window[0] == 0.0
    assert window[500] == 1.0
    assert window.sum() == pytest.approx(500.0)


@pytest.mark.parametrize(("count", "taken"), [(2, 1), (8, 28), (23, 253), (24, 264), (32, 256), (64, 512)])
def test_of_many_channels_each_is_paired_with_as_many_others(count, taken):
    first, second = correlation.pairs(count)
    assert (first < second).all()
    assert len(set(zip(first.tolist(), second.tolist(), strict=True))) == taken
    assert len(set(np.bincount(np.concatenate([first, second])).tolist())) == 1


def test_high_pass_takes_away_dc_and_hum_and_leaves_speech():
    t = np.arange(FS) / FS
    hum, tone = 0.3 + np.sin(2 * np.pi * 50 * t), np.sin(2 * np.pi * 400 * t + 0.3)
    filtered = correlation.high_pass((hum + tone)[:, None], FS, 200.0)[:, 0]
    middle = slice(FS // 10, -FS // 10)
    assert np.abs(filtered - tone)[middle].max() < 0.01
    np.testing.assert_array_equal(correlation.high_pass(tone[:, None], FS, 0.0)[:, 0], tone)


def gcc_of(signals, half, oversampling=1.0, beta=1.0):
    size = len(signals)
    bins = slice(1, size // 2)
    spectra = np.fft.rfft(signals * correlation.hann(size)[:, None], axis=0).T[:, bins]
    return correlation.gcc(correlation.whiten(spectra, beta), bins, size, half, oversampling)


@given(st.integers(-30, 30))
@settings(max_examples=20, deadline=None)
def test_gcc_of_a_whole_delay_peaks_on_its_lag(delay):
    rng = np.random.default_rng(1)
    noise = rng.standard_normal(4096)
    gcc = gcc_of(np.column_stack([np.roll(noise, delay), noise]), 40)[0]
    assert np.argmax(gcc) - 40 == delay
    assert gcc.max() > 0.9


def test_gcc_of_equal_channels_is_one_whatever_beta():
    noise = np.random.default_rng(2).standard_normal(2048)
    for beta in (0.0, 0.7, 1.0):
        gcc = gcc_of(np.column_stack([noise, -3.0 * noise, noise]), 5, beta=beta)
        assert gcc[:, 5] == pytest.approx([-1, 1, -1], rel=FLOAT32)


def test_oversampled_gcc_finds_fractions_of_a_sample():
    rng = np.random.default_rng(3)
    size, delay = 4096, 7.3
    spectrum = np.fft.rfft(rng.standard_normal(size))
    spectrum[1600:] = 0.0
    late = np.fft.irfft(spectrum * np.exp(-2j * np.pi * np.arange(len(spectrum)) * delay / size))
    bins = slice(1, 1600)
    spectra = np.fft.rfft(np.column_stack([late, np.fft.irfft(spectrum)]), axis=0).T[:, bins]
    gcc = correlation.gcc(correlation.whiten(spectra, 1.0), bins, size, 60, 4.0)[0]
    peak = int(np.argmax(gcc))
    offset = correlation.interpolate_peak(gcc[peak - 1], gcc[peak], gcc[peak + 1])
    assert (peak - 60 + offset) / 4.0 == pytest.approx(delay, abs=0.01)


# --- closed form and maximum likelihood -------------------------------------------------------------------------------


@given(places, st.integers(0, 7))
@settings(max_examples=50, deadline=None)
def test_exact_delays_give_the_exact_place(place, reference):
    distance = ranges(place)
    positions, reach, condition = multilateration.closed_form(MICROPHONES, reference, distance - distance[reference])
    assert len(positions) == 35
    good = multilateration.valid(positions, reach, condition, max_condition=300.0, low=np.zeros(3), high=ROOM)
    assert np.abs(positions[good] - place).max(initial=0.0) < 1e-6
    first, second = correlation.pairs(8)
    fitted, _, residual = multilateration.refine(
        [2.33, 2.33, 1.4], MICROPHONES, first, second, distance[first] - distance[second], np.ones(28), scale=0.3
    )
    assert np.abs(fitted - place).max() < 1e-3
    assert residual < 1e-3


def test_a_plane_is_singular_for_the_closed_form_and_not_for_maximum_likelihood():
    flat = MICROPHONES * [1, 1, 0] + [0, 0, 2.4]
    place = np.array([1.2, 3.1, 1.5])
    distance = ranges(place, flat)
    positions, _, condition = multilateration.closed_form(flat, 0, distance - distance[0])
    assert np.isinf(condition).all()
    assert np.isnan(positions).all()
    first, second = correlation.pairs(8)
    fitted, _, _ = multilateration.refine(
        [2.3, 2.3, 1.4], flat, first, second, distance[first] - distance[second], np.ones(28), scale=0.3
    )
    assert np.abs(fitted - place).max() < 1e-3


def test_one_wrong_delay_does_not_move_the_robust_fit():
    place = np.array([3.0, 1.4, 1.6])
    first, second = correlation.pairs(8)
    difference = (ranges(place)[first] - ranges(place)[second]).copy()
    difference[[3, 11]] += 1.0
    fitted, _, _ = multilateration.refine(place + 0.1, MICROPHONES, first, second, difference, np.ones(28), scale=0.05)
    assert np.abs(fitted - place).max() < 0.01


@given(places, st.floats(0.0, 6.28), st.tuples(*[st.floats(-9, 9)] * 3), st.booleans())
@settings(max_examples=30, deadline=None)
def test_the_closed_form_moves_with_the_room(place, angle, shift, mirrored):
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turn = turn @ np.diag([-1 if mirrored else 1, 1, 1])
    noise = 0.003 * np.sin(np.arange(8.0))
    difference = ranges(place) - ranges(place)[0] + noise
    here, _, condition = multilateration.closed_form(MICROPHONES, 0, difference)
    there, _, _ = multilateration.closed_form(MICROPHONES @ turn.T + shift, 0, difference)
    good = condition < 300
    np.testing.assert_allclose(there[good], here[good] @ turn.T + shift, atol=1e-6)


# --- steered response -------------------------------------------------------------------------------------------------


def test_a_cell_bounds_the_response_of_every_place_in_it():
    rng = np.random.default_rng(4)
    steered = SteeredResponse(MICROPHONES, [0, 0, 0.8], [4.66, 4.66, 2.0], 60.0)
    gcc = rng.standard_normal((28, 2 * steered.half_lags + 1)).astype(np.float32)
    bound = steered.bound(steered.ladder(gcc), steered.coarse)
    inside = rng.uniform(-1.0, 1.0, (20, 3)) * steered.half_cell
    for cell in rng.integers(len(steered.cells), size=200):
        assert steered.response(gcc, steered.cells[cell] + inside).max() <= bound[cell] + 0.05


def test_a_room_in_millimetres_is_refused_and_not_searched_for_hours():
    with pytest.raises(ValueError, match="is room_dimensions_m in metres"):
        SteeredResponse(MICROPHONES, [0, 0, 0.8], [4660, 4660, 2.0], 60.0)


@given(places)
@settings(max_examples=15, deadline=None)
def test_the_search_finds_an_ideal_source(place):
    place = np.clip(place, [0.3, 0.3, 0.9], [4.3, 4.3, 1.9])
    steered = SteeredResponse(MICROPHONES, [0, 0, 0.8], [4.66, 4.66, 2.0], 128.6)
    lag = np.arange(-steered.half_lags, steered.half_lags + 1)
    gcc = np.sinc(0.36 * (lag - steered.lags(place[None]))).astype(np.float32)
    centres, values = steered.search(gcc)
    assert values[0] <= steered.most(steered.ladder(gcc))
    assert (steered.search(gcc, least=values[0])[0] == centres).all()
    assert len(steered.search(gcc, least=1.001 * steered.most(steered.ladder(gcc)))[0]) == 0
    assert np.linalg.norm(centres[0, :2] - place[:2]) < 0.04
    assert np.linalg.norm(centres[0] - place) < 0.06  # three of the finest cells; height is what lags tell least of
    assert values[0] > 0.5


@given(places, st.sampled_from([(0, 0.0), (0, 4.66), (1, 0.0), (1, 4.66), (2, 0.0), (2, 3.0)]))
@settings(max_examples=30)
def test_a_notch_takes_away_a_talker_and_what_his_first_echoes_add(place, wall):
    steered = SteeredResponse(MICROPHONES, [0, 0, 0.8], [4.66, 4.66, 2.0], 128.6)
    axis, at = wall
    image = place.copy()
    image[axis] = 2 * at - place[axis]
    direct, echo = ranges(place) * 128.6, ranges(image) * 128.6
    pairs = np.arange(len(steered.first))
    half = steered.half_lags
    whole = np.ones((len(pairs), 2 * half + 1), np.float32)
    lag = (direct[steered.first] - direct[steered.second] + half).round().astype(int)
    assert (steered.notch(whole[None], place[None], 0.1)[0, pairs, lag] == 0).all()
    notched = steered.notch_echoes(whole[None], place[None], ROOM, 0.012)[0]
    for first, second in ((direct, echo), (echo, direct), (echo, echo)):
        lag = (first[steered.first] - second[steered.second] + half).round().astype(int)
        inside = (lag >= 0) & (lag <= 2 * half)
        assert (notched[pairs[inside], lag[inside]] == 0).all()
    assert ((notched >= 0) & (notched <= 1)).all()
    assert notched.mean() > 0.5, "most of what others say stays"


def test_heights_that_are_answered_as_well_are_in_the_covariance():
    steered = SteeredResponse(MICROPHONES, [0, 0, 0.8], [4.66, 4.66, 2.0], 128.6)
    lag = np.arange(-steered.half_lags, steered.half_lags + 1)

    def heard_from(place):
        return np.sinc(0.36 * (lag - steered.lags(place[None]))).astype(np.float32)

    place, higher, now = np.array([1.4, 3.1, 1.2]), np.array([1.43, 3.1, 1.7]), np.zeros(1)
    alone = steered.ambiguity(heard_from(place)[None], now, place, np.zeros(3), 40.0)
    both = steered.ambiguity((heard_from(place) + heard_from(higher))[None], now, place, np.zeros(3), 40.0)
    assert np.sqrt(alone[2, 2]) < 0.03
    assert 0.3 * 0.5**2 < both[2, 2] < 0.8 * 0.5**2, "some half of the likelihood is 0.5 m higher"
    assert both[0, 2] > 0, "and there further along x"
    assert np.linalg.eigvalsh(both)[0] > -1e-9


# --- events -----------------------------------------------------------------------------------------------------------


def test_short_time_energy_of_a_steady_sound_is_its_power():
    samples = np.full((4000, 2), [1.0, 2.0])
    energy = events.short_time_energy(samples, 401)
    np.testing.assert_allclose(energy[300:-300], np.full((3400, 2), [1.0, 4.0]))
    assert (energy >= 0.0).all()


@given(st.lists(st.floats(0, 1), max_size=200), st.floats(0, 1), st.integers(1, 50))
def test_events_lie_above_the_threshold_and_apart(energy, threshold, gap):
    found = events.crossings(np.array(energy), threshold, gap)
    assert (np.array(energy)[found] > threshold).all()
    assert (np.diff(found) >= gap).all()
    assert bool(len(found)) == any(e > threshold for e in energy)


def test_the_gate_follows_the_noise_and_no_click_mutes_speech():
    gate = events.Gate(10.0)
    rng = np.random.default_rng(5)
    noise = 1.0 + 0.05 * rng.standard_normal(60)
    heard = [gate(e) for e in noise]
    assert not any(heard[10:])
    assert gate(1e6)
    assert gate(3.0)
    assert not gate(1.0)
    for _ in range(100):
        quiet = gate(1e-3)
    assert not quiet
    assert gate(3e-3), "the floor has come down with the noise"


def test_a_tone_uses_few_lines_and_speech_many():
    rng = np.random.default_rng(6)
    t = np.arange(8192) / 44100
    window = correlation.hann(8192)
    tone = np.abs(np.fft.rfft(np.sin(2 * np.pi * 1000 * t) * window))[15:1500] ** 2
    speech = np.abs(np.fft.rfft(voice(8192 / 44100, 44100, rng) * window))[15:1500] ** 2
    assert events.occupancy(tone) < 0.02 < 0.05 < events.occupancy(speech)
    assert events.occupancy(np.zeros(5)) == 0.0


# --- arrays and steps -------------------------------------------------------------------------------------------------


def test_arrays_from_which_no_position_can_be_had_are_refused():
    line = np.outer(np.linspace(0, 4, 6), [1.0, 0.2, 0.0]) + 1.0
    with pytest.raises(ValueError, match="line"):
        Array(line, FS, ROOM).require(count=4, solid=True)
    with pytest.raises(ValueError, match="3 microphones"):
        Array(MICROPHONES[:3], FS, ROOM).require(count=4)
    with pytest.raises(ValueError, match="4 microphones"):
        Array(MICROPHONES[[0, 0, 2, 3, 4]], FS, ROOM).require(count=5)
    flat = Array(MICROPHONES * [1, 1, 0] + [0, 0, 2.4], FS, ROOM)
    flat.require(count=4)
    with pytest.raises(ValueError, match="plane"):
        flat.require(count=5, solid=True)


def test_time_steps_are_those_within_the_recording():
    assert time_steps(0, 176400, 44100, 10.0, 0.0) == range(41)
    assert time_steps(0, round(4.35 * 44100), 44100, 10.0, 0.35) == range(41)
    assert time_steps(44100, 44100, 44100, 10.0, 0.0) == range(10, 21)
    assert len(time_steps(0, 0, 44100, 10.0, 0.0)) == 0
    assert len(time_steps(0, 100, 44100, 10.0, 0.5)) == 0


def test_simulated_delays_are_the_geometry():
    rng = np.random.default_rng(7)
    place = np.array([1.0, 3.3, 1.5])
    samples = noisy(heard(place, rng.standard_normal(FS), FS), 30, rng)
    window = samples[4000:8096] * correlation.hann(4096)[:, None]
    delays = multilateration.time_differences(window, FS, 2, np.full(8, 300.0), beta=0.7)
    np.testing.assert_allclose(delays * 343.0, ranges(place) - ranges(place)[2], atol=0.004)


# --- how far a detection may be believed ------------------------------------------------------------------------------


def features(**changed):
    usual = {"response": 1.3, "agreement": 0.3, "support": 0.4, "before": 0.0, "first": False, "own": 0.8}
    still = dict.fromkeys(("velocity", "pace", "gait"), np.zeros(3))
    more = {"residual": 0.01, "strayed": np.full(3, 0.01), "strongest": 1.3, "dilution": 1.0, "fall": 0.0}
    more |= {"confirmed": -4.0, "crowded": 0.0, "leading": 0.9, "relative": 0.4, "familiar": 0.2}
    return uncertainty.Features(**(usual | still | more | {"channels": 8.0, "doubted": 0.0, "steady": 0.0} | changed))


def course(levels, rate=10.0):
    """How steady something is, decision by decision, whose levels are (times, bands) dB, 0.1 s apart."""
    so_far, apart, found = Course(), max(1, round(0.1 * rate)), []
    for now in np.arange(1.0, len(levels) - 2.0 + 1e-9, 10.0 / rate):
        around = [[np.interp(now + step, np.arange(len(levels)), band) for band in levels.T] for step in (-1, 0, 1)]
        so_far, steady = so_far.goes_on(np.array(around), np.array([-0.1, 0.0, 0.1]), apart)
        found.append(steady)
    return np.array(found)


def test_what_sounds_steadily_comes_to_be_a_machine_and_what_rises_and_falls_does_not():
    rng, law = np.random.default_rng(1), uncertainty.fitted_law()
    machine = 60.0 + rng.normal(0.0, 0.7, (20, BANDS))
    voice = 60.0 + 8.0 * np.sin(2.0 * np.pi * (0.37 * np.arange(20)[:, None] + rng.random(BANDS)))
    beside = machine + 20.0 * (np.arange(BANDS) < 4) * (np.arange(20) % 2)[:, None]
    unknown = law.probability(features(first=True, steady=Course().steady))
    for levels, rate in ((machine, 10.0), (beside, 10.0), (machine, 20.0)):
        said = [law.probability(features(first=True, steady=one)) for one in course(levels, rate)]
        assert said[0] < unknown
        assert max(said[4:]) < 0.1
    said = [law.probability(features(first=True, steady=one)) for one in course(voice)]
    assert min(said) > unknown
    assert course(machine)[-1] == MOST
    begins = course(np.vstack([machine, 20.0 + voice]))  # somebody begins to speak at its place
    assert law.voice(begins[21]) > 0.9


def test_bands_are_followed_by_themselves():
    band = Band(4096, slice(10, 400), np.ones(390, np.float32), 1.0)
    levels = Levels(band, 22050.0)
    coherence, power = np.ones((2, 390)), np.ones((2, 390))
    power[1, :100] *= 100.0
    first, second = levels(coherence, power)
    assert first.shape == (BANDS,)
    assert (second - first)[0] == pytest.approx(20.0)
    assert (second - first)[-1] == 0.0
    narrow = Levels(Band(4096, slice(10, 26), np.ones(16, np.float32), 1.0), 22050.0)
    assert np.isfinite(narrow(coherence[:, :16], power[:, :16])).all()


def lasting(steps, **changed):
    """The evidence for a peak that is as it is for so many decisions."""
    before, found = 0.0, []
    for _ in range(steps):
        peak = features(before=before, **changed)
        found.append(LAW.evidence(peak))
        before = LAW.remembered(peak, 0.7)
    return np.array(found)


def test_what_is_weak_but_lasts_comes_to_count_and_what_is_unlikely_never_does():
    weak, ghost = lasting(8, response=1.9, support=0.5), lasting(8, own=0.6)
    assert weak[0] < 0.0 < weak[-1]
    assert (np.diff(weak) > 0).all()
    assert ghost.max() < -1.4
    assert ghost[-1] <= ghost[0]


@pytest.mark.parametrize("first", [True, False])
def test_the_score_falls_with_all_that_speaks_against_a_place(first):
    usual = {"first": first, "response": 3.0, "own": 0.9, "before": 1.5, "strongest": 1.6, "confirmed": 2.0}
    score = LAW.probability(features(**usual))
    against = [{"before": -1.0}, {"strongest": 1.0}, {"fall": -12.0}]
    if first:
        against += [{"dilution": 10.0}, {"residual": 0.02}, {"support": 0.1}, {"doubted": 1.0}]
    else:
        against += [{"response": 1.0}, {"own": 0.5}, {"confirmed": 0.0}, {"crowded": 1.0}, {"leading": 0.5}]
        against += [{"relative": 0.2}, {"familiar": 0.0}]
        against.append({"dilution": 100.0})
        against.append({"strayed": np.zeros(3), "confirmed": -4.0})  # nothing was there before
    for changed in against:
        assert LAW.probability(features(**(usual | changed))) < score - 0.001, changed
    assert 0.0 <= LAW.probability(features(**(usual | {"fall": -1e9, "strongest": 1e9}))) <= 1.0


def test_a_place_far_from_a_small_array_is_diluted():
    def told(width, range_m):
        around = 2.0 * np.pi * np.arange(8) / 8
        away = np.array([range_m, 0.0, 0.0]) - np.column_stack(
            [width * np.cos(around), width * np.sin(around), 0 * around]
        )
        units = away / np.linalg.norm(away, axis=1)[:, None]
        first, second = np.triu_indices(8, 1)
        rows = units[first] - units[second]
        return uncertainty.dilution(rows.T @ rows / len(rows))

    assert told(0.5, 4.0) > 3.0 * told(0.5, 1.0) > 3.0 * told(2.0, 1.0)


def test_the_covariance_grows_with_all_that_speaks_against_a_place():
    normal, low, high = np.diag([20.0, 20.0, 5.0]), np.array([0, 0, 0.8]), np.array([4.66, 4.66, 2.0])
    nowhere, elsewhere = np.diag([1e-6, 1e-6, 1e-4]), np.diag([0.02, 0.02, 0.1]) ** 2

    def spread(others=nowhere, **changed):
        found = LAW.covariance(normal, others, features(**changed), low, high)
        np.testing.assert_array_equal(found, found.T)
        assert np.linalg.eigvalsh(found)[0] >= 0.99 * uncertainty.FLOOR**2
        return np.sqrt(np.diag(found))

    walks = np.array([1.5, 0.0, 0.0])
    usual = spread()
    for changed in (
        {"residual": 0.019},
        {"others": elsewhere},
        {"agreement": 0.1},
        {"velocity": walks},
        {"pace": walks},
        {"gait": walks},
        {"strayed": np.array([0.2, 0.0, 0.0])},
        {"strayed": np.zeros(3)},
    ):
        assert spread(**changed)[0] > 1.3 * usual[0], changed
    walking = dict.fromkeys(("velocity", "pace", "gait"), walks)
    along, across, _ = spread(**walking)
    assert along > 1.2 * across, "when he spoke is less sure than where he walks"
    assert spread(**walking, strongest=2.5)[0] > along, "one window alone says when"
    assert spread(strayed=np.array([0.01, 0.0, 0.3]))[2] > 1.3 * usual[2]
    lost = spread(residual=1.0, others=np.diag([9.0, 9.0, 1.0]))
    assert (lost < 3.1 * (high - low) / np.sqrt(12.0)).all(), "no wider than the room"


@pytest.mark.parametrize("count", [5, 8, 16])
def test_errors_of_the_microphones_places_are_in_the_covariance(count):
    rng = np.random.default_rng(count)
    microphones, place = rng.uniform([0, 0, 0], [6, 5, 3], (count, 3)), np.array([2.5, 3.0, 1.5])
    first, second = np.triu_indices(count, 1)

    def found(moved):
        ranges = np.linalg.norm(place - moved, axis=1)
        differences = ranges[first] - ranges[second]
        return multilateration.refine(place, microphones, first, second, differences, np.ones(len(first)), scale=1e3)

    draws = rng.normal(0.0, uncertainty.MISPLACED_M, (600, count, 3))
    errors = np.array([found(microphones + moved)[0] - place for moved in draws])
    expected = uncertainty.misplaced(found(microphones)[1], count, np.full(3, 1e3))
    whitened = errors @ np.linalg.inv(np.linalg.cholesky(expected)).T
    np.testing.assert_allclose(np.cov(whitened.T), np.eye(3), atol=0.25)
