"""Steady sources: what sounds on and on from one place is no talker, and hides none."""

import numpy as np
import pytest
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.localization.array import Array
from avcli.localization.modulation import Course, Levels
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block
from avcli.localization.windows import Band

FS = 16000
FAN, OTHER_FAN, MOUTH = np.array([3.4, 1.2, 1.1]), np.array([1.0, 1.2, 1.6]), np.array([1.4, 3.3, 1.55])


def fan(seconds, seed):
    """Pink noise (n,) above 100 Hz, of a power of 1."""
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(round(seconds * FS)))
    frequency = np.arange(len(spectrum)) / seconds
    spectrum[1:] /= np.sqrt(frequency[1:])
    spectrum[frequency < 100.0] = 0.0
    found = np.fft.irfft(spectrum)
    return found / found.std()


def recorded(seconds, *, fans=(FAN,), speaks=()):
    """Sound (n, m) of fans, 6 dB quieter than one who speaks in the stated spans, (k, 2) s, in a little echo."""
    rng, size = np.random.default_rng(3), round(seconds * FS)
    total = np.zeros((size, len(MICROPHONES)))
    for seed, place in enumerate(fans):
        total += 0.5 * heard(place, fan(seconds, seed), FS, reflection=0.5, order=1)
    for begin, end in speaks:
        sound = np.zeros(size)
        said = voice(end - begin, FS, rng)
        sound[round(begin * FS) :][: len(said)] = said / said.std()
        total += heard(MOUTH, sound, FS, reflection=0.5, order=1)
    return noisy(total, 30, rng) if fans else total + 0.01 * rng.standard_normal(total.shape)


def decided(samples, **options):
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM), SteeredSettings(**options), np.random.default_rng(0))
    return list(localizer.localize(Block(samples[i : i + 4000]) for i in range(0, len(samples), 4000)))


def test_a_fan_is_named_once_and_is_no_talker_from_then_on():
    spans = [(3.2, 4.6), (5.3, 6.6)]
    decisions = decided(recorded(7.0, speaks=spans))
    named = next(d.time for d in decisions if len(d.steady))
    assert named < 3.5
    after = [d for d in decisions if d.time > named]
    assert all(np.linalg.norm(d.steady - FAN, axis=1).max() < 0.1 for d in after)
    talkers = [(d.time, place) for d in after for place in d.positions]
    assert all(np.hypot(*(place - MOUTH)[:2]) < 0.5 for _, place in talkers)
    spoken = [d.time for d in after if any(begin + 0.2 < d.time < end - 0.1 for begin, end in spans)]
    assert len({time for time, _ in talkers} & set(spoken)) > 0.8 * len(spoken)
    (notice,) = {notice for d in decisions for notice in d.notices}
    assert notice == "a steady source, such as a fan, sounds near x = 3.4 m, y = 1.2 m: it is no talker"
    assert sum(len(d.notices) for d in decisions) == 1


def test_what_hisses_where_somebody_talks_is_named_when_the_talk_is_over():
    """A loudspeaker hisses, and so does a recording; to call it no talker while it talks would be untrue."""
    decisions = decided(recorded(8.0, fans=(MOUTH,), speaks=[(0.2, 2.4), (2.9, 4.4)]))
    assert any(len(d.steady) and len(d.scores) for d in decisions if d.time < 4.4)
    (said,) = [d.time for d in decisions if d.notices]
    assert 4.4 < said < 7.0


def test_two_fans_are_two():
    last = decided(recorded(4.0, fans=(FAN, OTHER_FAN)))[-1]
    assert len(last.steady) == 2
    assert sorted(last.steady[:, 0]) == pytest.approx([1.0, 3.4], abs=0.1)


def test_speech_and_the_rooms_own_noise_are_no_steady_source():
    decisions = decided(recorded(6.0, fans=(), speaks=[(0.3, 2.5), (3.0, 5.9)]))
    assert not any(len(d.steady) for d in decisions)


def test_a_gap_in_the_stream_forgets_the_fan():
    samples = recorded(3.5)
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM), SteeredSettings(), np.random.default_rng(0))
    assert list(localizer.localize([Block(samples)]))[-1].steady.shape == (1, 3)
    assert not len(next(iter(localizer.localize([Block(samples)]))).steady)


def test_a_voice_from_the_place_of_a_hiss_is_still_a_talker():
    spans = [(2.8, 4.2), (4.8, 6.0)]
    decisions = decided(recorded(6.2, fans=(MOUTH,), speaks=spans))
    assert len(decisions[-1].steady)
    spoken = [d for d in decisions if any(begin + 0.2 < d.time < end - 0.1 for begin, end in spans)]
    assert np.mean([len(d.positions) > 0 for d in spoken]) > 0.8


@pytest.mark.parametrize(("rate", "context"), [(2.0, 0.0), (0.5, 0.0)])
def test_one_who_speaks_all_the_time_is_no_steady_source_at_low_rates(rate, context):
    decisions = decided(recorded(6.0, fans=(), speaks=[(0.0, 6.0)]), rate=rate, context=context)
    assert not any(len(d.steady) for d in decisions)


@pytest.mark.parametrize("bins", [(2, 4), (10, 300), (400, 900)], ids=["below", "usual", "above"])
def test_a_constant_level_is_steady_and_a_changing_one_is_not_in_any_band(bins):
    band = Band(2048, slice(*bins), np.ones(bins[1] - bins[0], np.float32), 1.0)
    power, middles = np.ones((3, bins[1] - bins[0])), np.array([-0.1, 0.0, 0.1])
    levels = Levels(band, 48_000.0)
    changing = power * 10.0 ** np.array([[0.0], [1.0], [0.0]])
    assert Course().goes_on(levels(power, power), middles, 1)[1] > 1
    assert Course().goes_on(levels(power, changing), middles, 1)[1] == 0
