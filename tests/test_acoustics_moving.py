"""Moving sources: against the analytic solution by retarded time, and what must hold of any."""

import numpy as np
import pytest
from localization_rooms import decibels

from avcli.acoustics.images import image_microphones, shoebox_rir
from avcli.acoustics.moving import MovingSource, first_sample
from avcli.acoustics.responses import LONGEST_TAPS, Responses, lowpass
from avcli.acoustics.sampling import Switching, interpolation
from avcli.acoustics.signals import power_spectrum
from avcli.acoustics.speakers import Speakers
from avcli.acoustics.surroundings import Surroundings
from avcli.acoustics.trajectory import Trajectory
from avcli.formats.records import Identified

ROOM = np.array([4.66, 4.66, 3.0])
MICROPHONES = np.array([[0.115, 4.545, 2.493], [2.386, 2.253, 2.489]])
RATE = 44100
C = 343.0


def surroundings(beta, reach, **changes):
    return Surroundings(ROOM, np.full(6, -beta), MICROPHONES, RATE, reach, **changes)


def tones(highest, duration, seed=0):
    """A sum of tones up to a frequency, under a smooth window: exact at any time, also between samples."""
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.uniform(150, highest, 12), rng.uniform(0, 2 * np.pi, 12)

    def signal(t):
        window = np.sin(np.pi * np.clip(t / duration, 0, 1)) ** 2
        return window * np.cos(2 * np.pi * frequencies[:, None] * t + phases[:, None]).sum(axis=0)

    return signal


def by_retarded_time(signal, start, velocity, images, samples, microphone_velocity=(0.0, 0.0, 0.0)):
    """The pressure of a source at p(s) where |p(s) − image(t)| = c (t − s), for every image and sample.

    A moving monopole is louder by 1 / (1 + d'/c), d' by its own velocity; how the microphone moves does not matter
    where it is (P. M. Morse and K. U. Ingard, 1968, section 11.2).
    """
    t = np.arange(samples) / RATE
    heard = np.zeros(samples)
    for position, gain, mirrored in zip(images.positions.T, images.gains, images.mirrored.T, strict=True):
        away = start[:, None] - position[:, None] - (mirrored * np.asarray(microphone_velocity))[:, None] * t
        closing = velocity @ away
        a, b = C**2 - velocity @ velocity, -(C**2 * t + closing)
        s = (-b - np.sqrt(b**2 - a * (C**2 * t**2 - (away**2).sum(axis=0)))) / a
        distance = C * (t - s)
        towards = (away + velocity[:, None] * s) * velocity[:, None]
        heard += gain / (4 * np.pi * distance) * signal(s) / (1 + towards.sum(axis=0) / distance / C)
    return heard


def render(source, times, place, dry):
    before = None
    for time in times:
        begin = first_sample(before, RATE) if before is not None else 0
        source.move(time, place(time), dry[begin : first_sample(time, RATE)] if before is not None else ())
        before = time
    source.finish()
    return source


@pytest.mark.parametrize("speed", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("beta", [0.0, 0.1])
def test_moving_source_against_retarded_time(speed, beta):
    duration = 0.3 if speed > 3 else 0.5
    start, velocity = np.array([0.5, 2.0, 1.6]), speed * np.array([0.95, 0.3, 0.0]) / np.hypot(0.95, 0.3)
    signal = tones(8000, duration)
    dry = signal(np.arange(first_sample(duration, RATE)) / RATE)
    room = surroundings(beta, 25.0)
    times = np.linspace(0, duration, 1 + round(duration / 0.1))
    images = image_microphones(ROOM, MICROPHONES[0], room.reflection, start, 25.0)
    images = images[np.abs(images.gains) > 9e-5]
    expected = by_retarded_time(signal, start, velocity, images, len(dry) + 1500)
    for error_db in (-40, -60):
        nodes = interpolation(*power_spectrum(dry, RATE), error_db, C)
        source = MovingSource(room, nodes, 8500 / RATE, error_db - 15)
        heard = render(source, times, lambda t: start + velocity * t, dry)
        assert decibels(heard.take(0, len(expected))[0], expected) < error_db


@pytest.mark.parametrize(("speed", "microphone_speed"), [(0.0, 1.0), (1.0, 1.0), (0.0, 10.0), (5.0, 5.0)])
@pytest.mark.parametrize("beta", [0.0, 0.1])
def test_moving_microphone_against_retarded_time(speed, microphone_speed, beta):
    duration = 0.3
    start, velocity = np.array([0.5, 2.0, 1.6]), speed * np.array([0.95, 0.3, 0.0]) / np.hypot(0.95, 0.3)
    there, fleeing = np.array([4.3, 3.5, 2.2]), microphone_speed * np.array([-0.9, -0.4, -0.1]) / np.sqrt(0.98)
    signal = tones(8000, duration)
    dry = signal(np.arange(first_sample(duration, RATE)) / RATE)
    times = np.linspace(-0.1, 0.4, 6)
    room = Surroundings(
        ROOM, np.full(6, -beta), there[None], RATE, 25.0,
        trajectories=(Trajectory(times, there + times[:, None] * fleeing),),
    )  # fmt: skip
    images = image_microphones(ROOM, there, room.reflection, start, 25.0)
    images = images[np.abs(images.gains) > 9e-5]
    expected = by_retarded_time(signal, start, velocity, images, len(dry) + 1500, fleeing)
    for error_db in (-40, -60):
        nodes = interpolation(*power_spectrum(dry, RATE), error_db, C)
        source = MovingSource(room, nodes, 8500 / RATE, error_db - 15)
        heard = render(source, np.linspace(0, duration, 4), lambda t: start + velocity * t, dry)
        assert decibels(heard.take(0, len(expected))[0], expected) < error_db
    if microphone_speed > 5:  # what is tested here is not small
        still = by_retarded_time(signal, start, velocity, images, len(expected))
        assert decibels(still, expected) > 0


def test_a_microphone_that_rests_takes_one_response(monkeypatch):
    times = np.array([0.0, 0.5, 1.0, 3.0])
    way = Trajectory(times, np.array([[1.0, 1, 1], [1.0, 1, 1], [1.5, 1, 1], [1.5, 1, 1]]))
    room = surroundings(0.1, 25.0, trajectories=(way, None))
    dry = tones(8000, 3.0)(np.arange(3 * RATE) / RATE)
    nodes = interpolation(*power_spectrum(dry, RATE), -60, C)
    source = MovingSource(room, nodes, 8500 / RATE, -75)
    reckon, places = source._responses.at, []
    monkeypatch.setattr(source._responses, "at", lambda some: places.extend(some) or reckon(some))
    here = np.array([1.0, 2.0, 1.6])
    heard = render(source, np.arange(31) / 10, lambda t: here, dry).take(0, 3 * RATE)
    assert 0.5 / nodes.spacing_m < len(places) < 1.2 / nodes.spacing_m
    rested = Surroundings(ROOM, room.reflection, np.array([[1.5, 1, 1], MICROPHONES[1]]), RATE, 25.0)
    expected = render(MovingSource(rested, nodes, 8500 / RATE, -75), np.arange(31) / 10, lambda t: here, dry)
    expected = expected.take(0, 3 * RATE)
    late = slice(int(1.2 * RATE), int(2.8 * RATE))
    assert decibels(heard[0, late], expected[0, late]) < -60
    assert decibels(heard[1], expected[1]) < -60


def test_trajectories():
    times = np.array([0.0, 0.1, 0.4, 0.5])
    places = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.4, 0.3, 0], [0.4, 0.4, 0.1]])
    way = Trajectory(times, places)
    np.testing.assert_allclose(way.at(times), places, atol=1e-15)
    np.testing.assert_allclose(way.at([-1, 9]), places[[0, 3]], atol=1e-15)
    fine = np.linspace(0, 0.5, 5001)
    speeds = np.linalg.norm(np.diff(way.at(fine), axis=0), axis=1) * 1e4
    assert speeds.max() <= way.fastest(0, 0.5) * (1 + 1e-9)
    assert speeds[:500].max() <= way.fastest(0, 0.05) * (1 + 1e-9)
    assert way.fastest(0.6, 9) == way.fastest(-9, -1) == 0
    assert Trajectory(np.zeros(1), np.ones((1, 3))).fastest(-9, 9) == 0
    np.testing.assert_array_equal(Trajectory(np.zeros(1), np.ones((1, 3))).at([-1, 2]), np.ones((2, 3)))
    for bad_times, message in (([0.0, 0.1, 0.1, 0.5], "increase"), ([0.0, 0.001, 0.4, 0.5], "100 m/s from 0 s on")):
        with pytest.raises(ValueError, match=message):
            Trajectory(np.array(bad_times), places)
    with pytest.raises(ValueError, match="three coordinates"):
        Trajectory(times, places[:3])


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_without_reverberation_it_is_exact_to_80_db(speed):
    duration, velocity = 0.3, speed * np.array([1.0, 0.0, 0.0])
    start, signal = np.array([0.5, 2.0, 1.6]), tones(8000, 0.3)
    dry = signal(np.arange(first_sample(duration, RATE)) / RATE)
    room = surroundings(0.0, 8.0)
    speakers = Speakers(room, [dry], pause_s=1.0)
    for time in np.arange(5) / 10:
        mouth = (start + velocity * time)[None]
        speakers.step(Identified(time, np.array([0]), mouth * (1, 1, 0), mouth, np.ones(1)))
    speakers.finish()
    for microphone, found in zip(MICROPHONES, speakers.take(0, RATE // 2), strict=True):
        images = image_microphones(ROOM, microphone, room.reflection, start, 8.0)
        assert decibels(found, by_retarded_time(signal, start, velocity, images, len(found))) < -80


def test_a_head_that_sways_and_is_told_at_10_hz():
    """2 cm at 2 Hz: the paths between the records are right to 0.1 mm, and the sound to -54 dB."""
    signal = tones(4000, 2.0)
    dry = signal(np.arange(first_sample(2.0, RATE)) / RATE)

    def heard(rate):
        speakers = Speakers(surroundings(0.0, 8.0), [dry], pause_s=2.0)
        for time in np.arange(2 * rate + 1) / rate:
            mouth = np.array(
                [[0.5 + time, 2.0 + 0.02 * np.sin(2 * np.pi * time), 1.6 + 0.02 * np.sin(4 * np.pi * time)]]
            )
            speakers.step(Identified(time, np.array([0]), mouth * (1, 1, 0), mouth, np.ones(1)))
        speakers.finish()
        return speakers.take(0, 2 * RATE)

    inside = slice(RATE // 2, 3 * RATE // 2)
    assert decibels(heard(10)[:, inside], heard(100)[:, inside]) < -50


@pytest.mark.parametrize("nearest", [0.001, 0.01, 0.05])
def test_a_mouth_that_passes_a_microphone_closely(nearest):
    duration, velocity = 0.2, np.array([1.0, 0.0, 0.0])
    start, signal = MICROPHONES[1] + (-0.1, 0.0, -nearest), tones(8000, duration)
    dry = signal(np.arange(first_sample(duration, RATE)) / RATE)
    room = surroundings(0.1, 25.0)
    nodes = interpolation(*power_spectrum(dry, RATE), -60, C)
    source = MovingSource(room, nodes, 8500 / RATE, -75)
    heard = render(source, np.arange(3) / 10, lambda t: start + velocity * t, dry).take(0, len(dry) + 1500)[1]
    images = image_microphones(ROOM, MICROPHONES[1], room.reflection, start, 25.0)
    images = images[np.abs(images.gains) > 9e-5]
    assert decibels(heard, by_retarded_time(signal, start, velocity, images, len(heard))) < -50
    assert not source.bounded


def test_the_paths_stay_audible_when_a_mouth_leaves_a_microphone():
    """Beside the direct sound at 1 cm all others are faint: they are not left out at half a metre."""
    room = surroundings(0.8, 40.0, error_db=-40.0)
    images = Responses(room, 1 << 14, lowpass(0.5, -60.0), -60.0)
    every = Responses(surroundings(0.8, 40.0), 1 << 14, lowpass(0.5, -60.0), -60.0)
    places = MICROPHONES[1] - (0, 0, 0.01), MICROPHONES[1] - (0, 0, 0.5)
    for found in (images, every):
        found.at([(places[0], np.array([1.0, 0, 0]), MICROPHONES[None])])
    heard, expected = (
        found.at([(places[1], np.array([1.0, 0, 0]), MICROPHONES[None])])[0, 1] for found in (images, every)
    )
    assert decibels(heard.view(float), expected.view(float)) < -38


def test_the_noise_after_the_images_is_diffuse():
    """Its coherence at microphones 5 cm to 1 m apart is sin(kd) / (kd), from 100 Hz to 4 kHz, over 50 seeds."""
    microphones = np.array([[2.0, 2, 1], [2.05, 2, 1], [2.2, 2, 1], [2.5, 2, 1], [2.0, 3, 1]])
    rate, length = 16000, 1 << 14
    room = Surroundings(ROOM, np.full(6, -0.9), microphones, rate, 20.0, rt60_s=0.6, end_s=0.6)
    powers, crossed = np.zeros((513, 5)), np.zeros((513, 5))
    window = np.hanning(1024)[:, None]
    place = np.array([1.0, 1.0, 1.6]), np.array([1.0, 0, 0]), microphones[None]
    for seed in range(50):
        responses = Responses(room, length, lowpass(0.5, -60.0), -60.0, np.random.default_rng(seed))
        late = np.fft.irfft(responses.at([place])[0], length)[:, 1100:9000].T
        late *= np.exp(3 * np.log(10) / 0.6 * np.arange(len(late)) / rate)[:, None]
        for begin in range(0, 6500, 512):
            spectra = np.fft.rfft(late[begin : begin + 1024] * window, axis=0)
            powers += np.abs(spectra) ** 2
            crossed += (spectra[:, [0]] * spectra.conj()).real
    frequencies = np.fft.rfftfreq(1024, 1 / rate)
    theory = np.sinc(2 * frequencies[:, None] * np.linalg.norm(microphones - microphones[0], axis=1) / C)
    edges = np.searchsorted(frequencies, 100 * 40 ** (np.arange(17) / 16))  # thirds of octaves from 100 Hz to 4 kHz
    in_bands = [np.add.reduceat(values, edges, axis=0)[:-1] for values in (crossed, powers, theory)]
    coherence = in_bands[0] / np.sqrt(in_bands[1][:, [0]] * in_bands[1])
    np.testing.assert_allclose(coherence, in_bands[2] / np.diff(edges)[:, None], atol=0.1)


def test_microphones_at_one_position_are_simulated_once(monkeypatch):
    way = Trajectory(np.arange(2.0), np.array([[1.0, 1, 1], [1.5, 1, 1]]))
    microphones = np.array([[1.0, 1, 2], [2.0, 2, 2], [1.0, 1, 2], [1.0, 1, 1], [1.0, 1, 1]])
    room = Surroundings(ROOM, np.full(6, -0.3), microphones, RATE, 10.0, trajectories=(None, None, None, way, way))
    chosen = []
    choose = Responses._choose
    monkeypatch.setattr(Responses, "_choose", lambda self, *which: chosen.append(which[0]) or choose(self, *which))
    speakers = Speakers(room, [np.ones(RATE)])
    for time in (0.0, 0.1):
        mouth = np.array([[3.0, 3.0, 1.6]])
        speakers.step(Identified(time, np.array([0]), mouth * (1, 1, 0), mouth, np.ones(1)))
    speakers.finish()
    heard = speakers.take(0, 10000)
    assert chosen == [0, 1, 0], "two that stand and one that moves"
    assert np.array_equal(heard[0], heard[2])
    assert np.array_equal(heard[3], heard[4])
    assert not np.allclose(heard[0], heard[3])


def test_switching_is_a_convolution_for_every_step():
    """As gpuRIR: the response of the place at t_k for the samples from t_k to before t_k + 10 ms, and no others."""
    rng, step, count = np.random.default_rng(1), RATE // 100, 6
    dry = np.fft.irfft(np.fft.rfft(rng.normal(size=count * step)) * (np.arange(count * step // 2 + 1) < 1000))
    length = int(25.0 / C * RATE)

    def place(t):
        return np.array([0.5 + t, 2.0, 1.6])

    expected = np.zeros((2, len(dry) + length))
    for k in range(count):
        responses = shoebox_rir(ROOM, place(k / 100), MICROPHONES, 0.1, RATE, length)
        for heard, response in zip(expected, responses, strict=True):
            part = np.convolve(dry[k * step : (k + 1) * step], response)
            heard[k * step :][: len(part)] += part
    source = MovingSource(surroundings(0.1, 25.0), Switching(0.01), 0.45, -80)
    heard = render(source, np.arange(count + 1) / 100, place, dry).take(0, len(dry) + length)
    spectra = [np.fft.rfft(sound)[:, : int(0.35 * sound.shape[1])] for sound in (heard, expected)]
    assert 10 * np.log10(np.sum(abs(spectra[0] - spectra[1]) ** 2) / np.sum(abs(spectra[1]) ** 2)) < -60


def test_the_pitch_rises_towards_a_microphone():
    speed, pitch, duration = 10.0, 2000.0, 0.4
    dry = np.sin(2 * np.pi * pitch * np.arange(int(duration * RATE)) / RATE)
    room = Surroundings(np.array([10.0, 4.0, 3.0]), np.zeros(6), np.array([[9.5, 2.0, 1.5]]), RATE, 15.0)
    nodes = interpolation(*power_spectrum(dry, RATE), -60, C)
    source = MovingSource(room, nodes, 0.1, -70)
    heard = render(source, np.arange(5) / 10, lambda t: np.array([0.5 + speed * t, 2.0, 1.5]), dry).take(0, len(dry))[0]
    part = heard[4000:16000]
    turns = np.unwrap(np.angle(np.fft.ifft(np.fft.fft(part) * (np.fft.fftfreq(len(part)) > 0))))
    found = np.polyfit(np.arange(2000, 10000), turns[2000:10000], 1)[0] * RATE / (2 * np.pi)
    assert found == pytest.approx(pitch / (1 - speed / C), rel=1e-3)


def test_a_source_that_stands_still_is_one_convolution():
    rng = np.random.default_rng(3)
    dry = np.fft.irfft(np.fft.rfft(rng.normal(size=RATE)) * (np.arange(RATE // 2 + 1) < 12000), RATE)
    impulse = np.zeros(RATE)
    impulse[4000] = 1.0
    room = surroundings(0.8, 20.0)
    nodes = interpolation(*power_spectrum(dry, RATE), -60, C)
    heard, responses = (
        render(
            MovingSource(room, nodes, 0.3, -130), np.linspace(0, 1, 11), lambda t: np.array([1.73, 2.33, 1.6]), sound
        ).take(-50, RATE + 8000)
        for sound in (dry, impulse)
    )
    length = 3 * RATE
    for found, response in zip(heard, responses, strict=True):
        expected = np.fft.irfft(np.fft.rfft(dry, length) * np.fft.rfft(response, length), length)[4000:]
        np.testing.assert_allclose(found[50:RATE], expected[50:RATE], atol=1e-6 * np.abs(expected).max())
        assert decibels(found[50:RATE], expected[50:RATE]) < -120


def test_time_shift_gain_and_sum():
    signal = tones(6000, 0.3)
    dry = signal(np.arange(first_sample(0.3, RATE)) / RATE)
    room = surroundings(0.6, 15.0)
    nodes = interpolation(*power_spectrum(dry, RATE), -40, C)

    def place(t):
        return np.array([0.5 + t, 2.0, 1.6])

    def heard(sound):
        return render(MovingSource(room, nodes, 0.2), np.arange(4) / 10, place, sound).take(0, 40000)

    once = heard(dry)
    np.testing.assert_allclose(heard(-3.0 * dry), -3.0 * once, atol=1e-12)
    late = first_sample(0.2, RATE)
    shifted = render(
        MovingSource(room, nodes, 0.2),
        np.arange(4) / 10 + 0.2,
        lambda t: place(t - 0.2),
        np.append(np.zeros(late), dry),
    ).take(0, 40000)
    assert decibels(shifted[:, late:], once[:, :-late]) < -200
    other = np.random.default_rng(0).normal(size=len(dry))
    np.testing.assert_allclose(heard(dry + other), once + heard(other), atol=1e-12)


def test_silence_costs_nothing(monkeypatch):
    room = surroundings(0.8, 100.0)
    nodes = interpolation(np.ones(10), np.arange(10) * 800.0, -40, C)
    source = MovingSource(room, nodes)
    monkeypatch.setattr(source._responses, "at", None)
    heard = render(source, np.arange(5) / 10, lambda t: np.array([1 + t, 2, 1.6]), np.zeros(RATE)).take(0, RATE)
    assert not heard.any()


def test_standing_still_takes_one_response(monkeypatch):
    room = surroundings(0.5, 10.0)
    nodes = interpolation(np.ones(10), np.arange(10) * 800.0, -40, C)
    source = MovingSource(room, nodes)
    reckon, places = source._responses.at, []
    monkeypatch.setattr(source._responses, "at", lambda some: places.extend(some) or reckon(some))
    render(source, np.arange(31) / 10, lambda t: np.array([1.0, 2, 1.6]), np.ones(3 * RATE))
    assert len(places) == 1


@pytest.mark.parametrize("pieces", [1, 7, 1000])
def test_the_samples_do_not_depend_on_how_they_are_taken(pieces):
    rng = np.random.default_rng(5)
    dry = rng.normal(size=RATE)
    room = surroundings(0.7, 30.0, error_db=-30.0)
    nodes = interpolation(*power_spectrum(dry, RATE), -30, C)

    def place(t):
        return np.array([1.0 + max(0.0, t - 0.3), 2.0 + np.sin(3 * t) / 2, 1.6])

    whole = render(MovingSource(room, nodes), np.arange(11) / 10, place, dry).take(0, RATE)
    source, found, now, before = MovingSource(room, nodes), [], 0, None
    for time in np.arange(11) / 10:
        begin = first_sample(before, RATE) if before is not None else 0
        source.move(time, place(time), dry[begin : first_sample(time, RATE)] if before is not None else ())
        before = time
        while now + RATE // pieces <= source.settled:
            found.append(source.take(now, now + RATE // pieces))
            now += RATE // pieces
    source.finish()
    found.append(source.take(now, RATE))
    assert np.array_equal(np.concatenate(found, axis=1), whole)


@pytest.mark.parametrize(
    ("band", "every"), [(0.05, 4), (0.12, 4), (0.16, 3), (0.2, 2), (0.2465, 2), (0.249, 1), (0.5, 1)]
)
def test_the_low_pass_leaves_the_band_and_removes_the_image_of_left_out_samples(band, every):
    filtered = lowpass(band, -55.0)
    assert filtered.every == every
    assert filtered.taps <= LONGEST_TAPS
    levels, frequencies = np.abs(filtered.spectrum(1 << 14)), np.fft.rfftfreq(1 << 14)
    np.testing.assert_allclose(levels[frequencies <= min(band, 0.5 - filtered.transition)], 1.0, atol=1e-3)
    assert (levels[frequencies > filtered.edge] < 1e-3).all()
    assert filtered.edge <= (1 / every - band + 1e-12 if every > 1 else 0.5)


def test_the_nodes_are_spaced_by_the_signals_bandwidth():
    spacings = [
        interpolation((frequencies := np.arange(0, 20000.0, 50)) < highest, frequencies, -40).spacing_m
        for highest in (2000, 4000, 8000, 16000)
    ]
    for spacing, highest in zip(spacings, (2000, 4000, 8000, 16000), strict=True):
        assert 0.36 < spacing * highest / C < 0.5
    silent = interpolation(np.zeros(10), np.arange(10), -40)
    assert np.isfinite(silent.spacing_m)
    weights = sum(silent.weights(np.linspace(0, 1, 333) - node) for node in range(-8, 9))
    np.testing.assert_allclose(weights, 1.0, atol=1e-12)


def test_going_back_in_time_and_wrong_lengths_are_refused():
    room = surroundings(0.0, 10.0)
    nodes = interpolation(np.ones(10), np.arange(10) * 800.0, -40, C)
    source = MovingSource(room, nodes)
    source.move(0.0, [1, 2, 1.6])
    with pytest.raises(ValueError, match="expected 4410"):
        source.move(0.1, [1, 2, 1.6], np.zeros(3))
    with pytest.raises(ValueError, match="0 samples"):
        source.move(0.0, [1, 2, 1.6])


@pytest.mark.parametrize("rate", [8, 4000])
def test_time_steps_without_a_sample_are_no_trouble(rate):
    """Steps may be shorter than a sample, the last one too: the path ends behind its last sample all the same."""
    rng = np.random.default_rng(0)
    nodes = interpolation(np.ones(9), np.linspace(0, 100, 9), -40.0)
    around = Surroundings(ROOM, np.zeros(6), MICROPHONES, rate, 10.0)
    for _ in range(60):
        source = MovingSource(around, Switching(0.01) if rng.random() < 0.3 else nodes, band=0.25)
        time, position, dry = rng.random(), np.array([2.0, 2.0, 1.5]), np.zeros(0)
        for _ in range(rng.integers(1, 8)):
            source.move(time, position, dry)
            step = float(rng.choice([1e-9, 1e-6, 1e-3, 0.1, 0.3]))
            position = np.clip(position + rng.uniform(-5, 5, 3) * step, 0.1, 2.9)
            dry = rng.standard_normal(first_sample(time + step, rate) - first_sample(time, rate))
            time += step
        source.move(time, position, dry)
        source.finish()
        assert source.settled == np.inf
        assert np.isfinite(source.take(0, first_sample(time, rate) + rate + 1000)).all()
        assert source.exhausted
