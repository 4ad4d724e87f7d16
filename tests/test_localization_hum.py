"""Steady tones: they are found, cost no talker, and a voice is none."""

import numpy as np
import pytest
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.localization.array import Array
from avcli.localization.correlation import hann
from avcli.localization.hum import Hum
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block
from avcli.localization.windows import Band

FS, PLACE = 16000, np.array([1.4, 3.1, 1.55])
BAND = Band.of(SteeredSettings(), FS)
HOP = 1 / 15


def learnt(sound, alike=1.0):
    """What is known of the tones in a sound (n,), so far alike in all channels, at its end."""
    hum, taper = Hum(BAND, FS, HOP), hann(BAND.size)
    for start in range(0, len(sound) - BAND.size, round(HOP * FS)):
        spectrum = np.fft.rfft(sound[start : start + BAND.size] * taper)[BAND.bins]
        hum.take(np.abs(spectrum) ** 2, np.full(len(spectrum), alike))
    return hum


def tones(seconds, *frequencies):
    times = np.arange(round(seconds * FS)) / FS
    return np.sum([np.sin(2 * np.pi * f * times + f) for f in frequencies], axis=0)


def frequency(bins):
    return (BAND.bins.start + np.flatnonzero(bins)) * FS / BAND.size


def test_the_bins_of_steady_tones_are_found_and_named():
    rng = np.random.default_rng(1)
    hum = learnt(tones(5, 100, 150, 3000) + 0.05 * rng.standard_normal(5 * FS))
    assert hum.bins is not None
    away = np.abs(frequency(hum.bins)[:, None] - [100, 150, 3000])
    assert (away.min(axis=0) < 6).all()
    assert away.min(axis=1).max() < 30
    (said,) = hum.news()
    named = [float(one) for one in said.split(" at ")[1].split(" Hz")[0].split(", ")]
    np.testing.assert_allclose(named, [100, 150, 3000], atol=6)
    assert hum.news() == []


@pytest.mark.parametrize("seed", range(4))
def test_noise_and_voices_are_no_tones(seed):
    rng = np.random.default_rng(seed)
    noise = 0.01 * rng.standard_normal(6 * FS)
    assert learnt(noise).bins is None
    assert learnt(noise + voice(6, FS, rng)).news() == []


def test_a_tone_that_ends_is_forgotten():
    rng = np.random.default_rng(2)
    hum = learnt(np.r_[tones(4, 100), np.zeros(5 * FS)] + 0.05 * rng.standard_normal(9 * FS))
    assert hum.bins is None


def test_the_tones_of_a_machine_in_the_room_stay():
    assert learnt(tones(5, 100, 150) + 0.05 * np.random.default_rng(4).standard_normal(5 * FS), alike=0.3).bins is None


@pytest.mark.parametrize("level", [0.3, 1.0, 10.0])
def test_a_hum_in_all_channels_costs_no_talker_and_makes_none(level):
    rng = np.random.default_rng(3)
    sound = np.r_[np.zeros(FS), voice(4, FS, rng)]
    samples = noisy(heard(PLACE, sound, FS, reflection=0.6, order=2), 30, rng)
    hum = np.r_[tones(8, *range(50, 401, 50))][: len(samples)]
    samples += level * np.sqrt(np.mean(samples**2) / np.mean(hum**2)) * hum[:, None]
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM), SteeredSettings(), np.random.default_rng(0))
    found = list(localizer.localize([Block(samples)]))
    away = np.concatenate([np.hypot(*(one.positions - PLACE)[:, :2].T) for one in found])
    assert (away < 0.3).sum() >= 34  # of 40 moments, with pauses between the syllables
    assert (away > 0.5).sum() <= 2
    assert any("such as a hum" in notice for one in found for notice in one.notices)
