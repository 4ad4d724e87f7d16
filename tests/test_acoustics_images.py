"""Image sources: against brute force and against what is known of rooms without computing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from localization_rooms import MICROPHONES, ROOM, decibels

from avcli.acoustics import absorption as walls
from avcli.acoustics import decay
from avcli.acoustics.images import NEAREST_M, DelaySpectrum, audible, image_count, image_microphones, shoebox_rir

SOURCE = np.array([1.73, 2.33, 1.6])
BETA = 0.835684  # Sabine, 0.35 s


def brute_force(room, source, microphone, reflection, rate, samples, sign, c=343.0):
    """The band-limited sum over all images, image by image over u, v, w and orders, straight from Allen and Berkley."""
    most = [int(samples * c / rate / (2 * length)) + 2 for length in room]
    n = np.arange(samples)
    response = np.zeros(samples)
    for i in range(-most[0], most[0] + 1):
        for j in range(-most[1], most[1] + 1):
            for k in range(-most[2], most[2] + 1):
                for u in (0, 1):
                    for v in (0, 1):
                        for w in (0, 1):
                            order = [abs(i - u), abs(i), abs(j - v), abs(j), abs(k - w), abs(k)]
                            image = (1 - 2 * np.array([u, v, w])) * source + 2 * np.array([i, j, k]) * room
                            delay = np.linalg.norm(image - microphone) * rate / c
                            if delay > samples - 1:
                                continue
                            gain = np.prod(np.power(reflection, order)) * sign ** sum(order)
                            distance = delay * c / rate
                            response += gain / (4 * np.pi * distance) * np.sinc(n - delay)
    return response


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_response_is_the_ideal_band_limited_sum(sign):
    reflection = np.array([0.9, 0.7, 0.85, 0.8, 0.5, 0.95])
    for rate, samples in ((8000, 320), (44100, 900)):
        found = shoebox_rir(ROOM, SOURCE, MICROPHONES[:2], reflection, rate, samples, sign=sign)
        for response, microphone in zip(found, MICROPHONES, strict=False):
            expected = brute_force(ROOM, SOURCE, microphone, reflection, rate, samples, sign)
            assert decibels(response, expected) < -75


@pytest.mark.parametrize("error_db", [-20, -30, -40, -50])
@pytest.mark.parametrize("sign", [-1, 1])
def test_pruning_keeps_the_error_that_was_asked_for(error_db, sign):
    full = shoebox_rir(ROOM, SOURCE, MICROPHONES[:3], BETA, 16000, 5600, sign=sign)
    pruned = shoebox_rir(ROOM, SOURCE, MICROPHONES[:3], BETA, 16000, 5600, sign=sign, error_db=error_db)
    for one, other in zip(pruned, full, strict=True):
        assert error_db - 6 < decibels(one, other) <= error_db


def test_a_larger_error_takes_fewer_images_and_a_shorter_transform(monkeypatch):
    """So it is never dearer: the cost is that of the images and of the transform."""
    costs = []
    call = DelaySpectrum.__call__

    def counted(self, impulses):
        costs.append((sum(len(delays) for delays, _ in impulses), self.length))
        return call(self, impulses)

    monkeypatch.setattr(DelaySpectrum, "__call__", counted)
    for error_db in (-10, -20, -30, -40, -50, -60, -70, None):
        shoebox_rir(ROOM, SOURCE, MICROPHONES[:2], BETA, 44100, 15435, error_db=error_db)
    assert costs == sorted(costs)
    assert costs[0][0] < 0.01 * costs[-1][0]
    assert costs[-1] == costs[-2] == costs[-3]


def test_walls_that_reflect_everything_are_never_cut_short():
    full = shoebox_rir(ROOM, SOURCE, MICROPHONES[:1], 1.0, 8000, 800)
    pruned = shoebox_rir(ROOM, SOURCE, MICROPHONES[:1], 1.0, 8000, 800, error_db=-40)
    assert decibels(pruned, full) <= -40


def test_the_direct_path_alone_without_reflection():
    distance = np.linalg.norm(SOURCE - MICROPHONES[0])
    assert distance == pytest.approx(2.88304, abs=1e-5)
    response = shoebox_rir(ROOM, SOURCE, MICROPHONES[:1], 0.0, 44100, 2000)[0]
    delay = distance / 343 * 44100
    assert np.argmax(response) == round(delay)
    expected = np.sinc(np.arange(2000) - delay) / (4 * np.pi * distance)
    assert 1 / (4 * np.pi * distance) == pytest.approx(0.0276020, abs=1e-7)
    assert decibels(response, expected) < -80


def test_one_image_without_walls_and_two_with_one():
    for wall in range(6):
        reflection = np.zeros(6)
        assert len(image_microphones(ROOM, MICROPHONES[0], reflection, SOURCE, 100.0)) == 1
        reflection[wall] = -0.8
        images = image_microphones(ROOM, MICROPHONES[0], reflection, SOURCE, 100.0)
        assert sorted(images.gains) == [-0.8, 1.0]
        mirrored = images.positions[:, np.argmin(images.gains)]
        expected = MICROPHONES[0].copy()
        expected[wall // 2] = 2 * ROOM[wall // 2] * (wall % 2) - expected[wall // 2]
        np.testing.assert_allclose(mirrored, expected, atol=1e-14)


def test_number_of_images():
    reach = 343 * 0.35
    images = image_microphones(ROOM, MICROPHONES[0], np.full(6, -BETA), SOURCE, reach)
    assert len(images) == pytest.approx(image_count(ROOM, reach), rel=0.01)
    assert len(images) == 111_250  # counted on its own for this room, source and microphone


coordinate = st.floats(0.1, 2.9)


@settings(max_examples=25, deadline=None)
@given(
    source=st.tuples(coordinate, coordinate, coordinate),
    microphone=st.tuples(coordinate, coordinate, coordinate),
    reflection=st.tuples(*[st.floats(0.0, 1.0)] * 6),
)
def test_reciprocity(source, microphone, reflection):
    def delays_and_gains(here, there):
        images = image_microphones((3.0, 3.5, 4.0), there, reflection, np.array(here), 25.0)
        distances = images.distances(np.array(here))
        return np.array(sorted(zip(distances.round(9), images.gains, strict=True)))

    np.testing.assert_allclose(delays_and_gains(source, microphone), delays_and_gains(microphone, source), atol=1e-8)


def test_the_negative_sign_leaves_no_constant_pressure():
    def sums(sign):
        return shoebox_rir(ROOM, SOURCE, MICROPHONES[:1], BETA, 16000, 5600, sign=sign).sum()

    assert abs(sums(-1)) < 0.002
    assert sums(1) == pytest.approx(3.50, abs=0.02)


def decay_times(room, absorption, rt60, pairs, rate):
    """T30 of the responses of some pairs of places, measured as in a room: none decided what is tested here."""
    rng, room = np.random.default_rng(5), np.array(room)
    times = []
    while len(times) < pairs:
        source, microphone = rng.uniform(0.3, room - 0.3, (2, 3))
        if np.linalg.norm(source - microphone) < 1:
            continue
        samples = int((1.2 * rt60 + np.linalg.norm(room) / 343) * rate)
        response = shoebox_rir(room, source, microphone, np.sqrt(1 - absorption), rate, samples)[0]
        energy = np.cumsum(response[::-1] ** 2)[::-1]
        level = 10 * np.log10(energy / energy[0])
        inside = (level < -5) & (level > -35)
        times.append(-60 / np.polyfit(np.flatnonzero(inside) / rate, level[inside], 1)[0])
    return np.array(times)


@pytest.mark.parametrize(
    ("room", "rt60", "pairs"),
    [
        ((3.0, 3.0, 2.5), 0.2, 4),
        ((4.66, 4.66, 3.0), 0.35, 4),
        ((10.0, 5.0, 3.0), 0.2, 100),
        ((10.0, 8.0, 3.5), 0.2, 20),
        ((10.0, 8.0, 3.5), 0.6, 4),
        ((20.0, 15.0, 5.0), 0.35, 20),
        ((20.0, 6.0, 3.0), 0.2, 60),
        ((20.0, 6.0, 3.0), 0.35, 200),
        ((20.0, 6.0, 3.0), 0.6, 60),
        ((20.0, 20.0, 3.0), 0.2, 60),
    ],
)
def test_the_decay_is_what_was_asked_for(room, rt60, pairs):
    times = decay_times(room, decay.wanted_absorption(room, rt60)[0], rt60, pairs, 16000)
    assert np.mean(times) == pytest.approx(rt60, rel=0.05)


def test_walls_farther_apart_absorb_more_where_a_room_is_too_dead_for_walls_that_absorb_alike():
    room = (20.0, 6.0, 3.0)
    assert "at 21 % of places sound does not decay but ends" in str(
        decay.too_dead(room, 0.2, decay.image_absorption(room, 0.2))
    )
    absorption, said = decay.wanted_absorption(room, 0.2)
    assert "95 % at both ends of x, 60 % of y, 37 % of z" in str(said)
    lost = -np.log(1 - absorption[::2]) / room
    np.testing.assert_allclose(lost, lost[0])
    for of_room, rt60 in ((room, 0.35), (ROOM, 0.2)):
        alike, said = decay.wanted_absorption(of_room, rt60)
        assert said is None
        np.testing.assert_array_equal(alike, decay.image_absorption(of_room, rt60))


def test_a_room_that_is_too_dead_for_its_time_is_named():
    """A cube gains nothing by walls that absorb apart."""
    absorption, said = decay.wanted_absorption((12.0, 12.0, 12.0), 0.1)
    np.testing.assert_allclose(absorption, absorption[0])
    assert "of places sound does not decay but ends" in str(said)
    with pytest.raises(ValueError, match="too short for this room"):
        decay.wanted_absorption((30.0, 20.0, 6.0), 0.2)


def test_the_equations_of_statistics_are_wrong_for_image_sources():
    """Where walls absorb much, Sabine's equation is 18 % short, for image sources of any make."""
    for rt60, error in ((0.2, -0.18), (0.35, 0.0)):
        absorption = walls.sabine_absorption(ROOM, rt60)
        found = decay.image_rt60(ROOM, absorption)
        assert found == pytest.approx((1 + error) * rt60, rel=0.03)
        assert np.mean(decay_times(ROOM, absorption, rt60, 8, 16000)) == pytest.approx(found, rel=0.05)


def test_times_that_are_impossible():
    absorption = decay.image_absorption(ROOM, 0.4)
    assert decay.image_rt60(ROOM, absorption) == pytest.approx(0.4, rel=0.02)
    assert decay.image_rt60(ROOM, absorption, 171.5) == pytest.approx(0.8, rel=0.02)
    with pytest.raises(ValueError, match="too short for this room"):
        decay.image_absorption((20, 15, 5), 0.01)
    with pytest.raises(ValueError, match="above 0"):
        decay.image_absorption(ROOM, np.nan)


def test_sabine_by_hand():
    alpha = walls.sabine_absorption(ROOM, 0.35)
    np.testing.assert_allclose(alpha, 0.301632, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(1 - alpha), BETA, atol=1e-6)
    assert walls.sabine_rt60(ROOM, alpha) == pytest.approx(0.35)
    with pytest.raises(ValueError, match=r"the shortest is 0\.1056 s"):
        walls.sabine_absorption(ROOM, 0.1)
    assert (walls.eyring_absorption(ROOM, 0.1) < 1).all()
    mean = walls.eyring_absorption(ROOM, 0.35)[0]
    assert 0.161 * ROOM.prod() / (-walls.wall_areas(ROOM).sum() * np.log(1 - mean)) == pytest.approx(0.35)
    assert walls.schroeder_frequency(ROOM, 0.35) == pytest.approx(146.6, abs=0.05)


@pytest.mark.parametrize("rate", [8000, 44100, 192000])
def test_small_and_large_rooms_at_all_rates(rate):
    small = shoebox_rir([0.3, 0.3, 0.3], [0.1, 0.15, 0.2], [[0.2, 0.2, 0.1]], 0.5, rate, 300)
    assert np.isfinite(small).all()
    assert small.any()
    far = np.array([[49.0, 39.0, 19.0]])
    samples = int(0.2 * rate)
    large = shoebox_rir([50, 40, 20], [1.0, 1.0, 1.0], far, 0.0, rate, samples)[0]
    assert np.argmax(np.abs(large)) == round(np.linalg.norm(far[0] - 1) / 343 * rate)


def test_a_source_at_a_microphone_is_finite():
    for shift in (0.0, 1e-6, 0.01):
        response = shoebox_rir(ROOM, MICROPHONES[7] + (0, 0, -shift), MICROPHONES[7:], BETA, 44100, 500)
        assert np.isfinite(response).all()
        assert np.abs(response).max() <= 1.01 / (4 * np.pi * NEAREST_M)


def test_a_source_on_a_wall_and_in_a_corner():
    on_wall = shoebox_rir(ROOM, [0.0, 2.0, 1.5], MICROPHONES, BETA, 16000, 800)
    # A reflection of the opposite sign leaves 1 − β of each pair of images.
    inside = shoebox_rir(ROOM, [0.0, 2.0, 1.5], MICROPHONES, [0.0, *[BETA] * 5], 16000, 800)
    assert np.sum(on_wall**2) < 0.1 * np.sum(inside**2)
    assert np.isfinite(shoebox_rir(ROOM, [0.0, 0.0, 0.0], MICROPHONES, BETA, 16000, 800)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"room_dimensions_m": [4, 0, 3]}, "three dimensions above 0"),
        ({"room_dimensions_m": [4, np.nan, 3]}, "three dimensions above 0"),
        ({"source_m": [5.0, 2, 1]}, "not in the room"),
        ({"source_m": [np.nan, 2, 1]}, "not in the room"),
        ({"source_m": [1, 2]}, "three coordinates"),
        ({"microphones_m": [[1, 2, 3.5]]}, "not in the room"),
        ({"reflection": 1.2}, "from 0 to 1"),
        ({"reflection": [0.5, -0.5, 0, 0, 0, 0]}, "from 0 to 1"),
        ({"sample_rate_hz": 0}, "above 0"),
        ({"num_samples": 0}, "above 0"),
        ({"sign": 0}, "-1 or 1"),
        ({"error_db": 3.0}, "below 0"),
        ({"num_samples": 10**7}, "too many"),
    ],
)
def test_what_makes_no_sense_is_refused(change, message):
    arguments = {
        "room_dimensions_m": ROOM,
        "source_m": SOURCE,
        "microphones_m": MICROPHONES,
        "reflection": BETA,
        "sample_rate_hz": 44100,
        "num_samples": 1000,
    } | change
    with pytest.raises(ValueError, match=message):
        shoebox_rir(**arguments)


@pytest.mark.parametrize(("band", "error_db"), [(0.25, -55.0), (0.25, -40.0), (0.5, -75.0), (0.2, -45.0)])
def test_impulses_that_need_not_be_exact_have_the_error_that_is_stated(band, error_db):
    random = np.random.default_rng(3)
    spectrum = DelaySpectrum(2048, band, error_db)
    delays, amplitudes = random.uniform(50, 1900, 600), random.normal(size=600)
    turns = np.exp(-2j * np.pi * np.outer(np.arange(spectrum.bins) / 2048, delays))
    exact, mixed = spectrum([(delays, amplitudes)] * 2, [600, 100])

    def error(found, energy):  # of white sound in the band
        return 10 * np.log10(np.mean(np.abs(found - turns @ amplitudes) ** 2) / energy)

    assert error(exact, np.sum(amplitudes**2)) < error_db
    assert error(mixed, np.sum(amplitudes[100:] ** 2)) == pytest.approx(spectrum.coarse_db, abs=1.5)
    assert -35 < spectrum.coarse_db < -5


@given(st.integers(1, 400), st.floats(-60, -5), st.floats(0, 30), st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_audible_images_leave_out_no_more_than_is_permitted(count, error_db, more_db, seed):
    random = np.random.default_rng(seed)
    delays = random.uniform(0, 50, count)  # many fall on one sample
    amplitudes = random.normal(size=count) * 10 ** random.uniform(-3, 0, count)
    exact, others = audible(delays, amplitudes, error_db, error_db + more_db)
    chosen = np.concatenate([exact, others])
    assert len(set(chosen.tolist())) == len(chosen) <= count

    def energy(of):
        return np.sum(np.bincount(np.rint(delays[of]).astype(int), amplitudes[of], minlength=1) ** 2)

    permitted = energy(np.arange(count)) * 10 ** (error_db / 10)
    assert energy(np.setdiff1d(np.arange(count), chosen)) <= permitted * (1 + 1e-9)
    assert energy(np.setdiff1d(np.arange(count), exact)) <= permitted * 10 ** (more_db / 10) * (1 + 1e-9)
