"""Voices: the pitch and the place of known vowels, what has no voice, and what the fit finds."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from localization_rooms import MICROPHONES, noisy
from localization_rooms import ROOM as SHOEBOX
from localization_rooms import heard as in_a_room

from avcli.formats.features import known
from avcli.localization import correlation, voice
from avcli.localization.array import Array, Talker
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block
from avcli.localization.voice import VoiceMeter
from avcli.localization.windows import Band, Correlator

sys.path.insert(0, str(ROOT / "tests" / "bench"))

import fit_voice

FS = 16000
ARRAY = Array(MICROPHONES, FS, SHOEBOX)
HERE, THERE = np.array([1.5, 3.1, 1.6]), np.array([3.4, 1.2, 1.5])


def vowel(pitch, seconds=1.0, formants=(500.0, 1500.0, 2500.0)):
    """A vowel (n,) of a steady pitch in Hz."""
    time = np.arange(round(seconds * FS)) / FS
    harmonics = pitch * np.arange(1, int(7000.0 / pitch))
    gains = sum(1.0 / (1.0 + ((harmonics - formant) / 100.0) ** 2) for formant in formants) + 0.02
    return gains @ np.sin(2.0 * np.pi * harmonics[:, None] * time)


def window(samples, array=ARRAY):
    """The window in the middle of samples (n, m), correlated."""
    band = Band.of(SteeredSettings(), FS)
    begin = (len(samples) - band.size) // 2
    cut = samples[begin : begin + band.size].T
    return Correlator(array, band, 400, 1.0).correlate(cut, correlation.hann(band.size)).correlated


def talkers(*places):
    return [Talker(place, np.eye(3), 1.0) for place in places]


def features(samples, *places, settings=None):
    band = Band.of(settings or SteeredSettings(), FS)
    return VoiceMeter(ARRAY, band).features(window(samples), np.zeros(8, bool), talkers(*places))


@pytest.mark.parametrize("pitch", [85.0, 120.0, 215.0, 330.0])
def test_the_pitch_of_a_vowel_is_right(pitch):
    found = features(in_a_room(HERE, vowel(pitch), FS, reflection=0.6), HERE)["voice"]
    assert found.kind == voice.KIND
    assert found.vectors[0, 0] == pytest.approx(np.log(pitch), abs=0.02)
    assert 0.02 < found.sds[0, 0] < 0.5  # as a measurement of the person: the melody is in it


def test_two_vowels_at_once_are_taken_apart_by_their_places_and_less_certain():
    alone = in_a_room(HERE, vowel(110.0), FS, reflection=0.4)
    both = alone + in_a_room(THERE, vowel(190.0, formants=(700.0, 1100.0, 2600.0)), FS, reflection=0.4)
    meter = VoiceMeter(ARRAY, Band.of(SteeredSettings(), FS))
    lone = meter.hear(window(alone).spectra, MICROPHONES, HERE[None])
    pair = meter.hear(window(both).spectra, MICROPHONES, np.array([HERE, THERE]))
    assert pair.pitch == pytest.approx([110.0, 190.0], rel=0.02)
    assert lone.others == pytest.approx([0.0], abs=1e-9)
    assert (pair.others > 0.1).all()
    spread = voice.fitted_law().spread
    assert (spread @ voice.terms(pair)[0] >= spread @ voice.terms(lone)[0]).all()


def test_a_voice_does_not_depend_on_its_level_or_on_the_order_of_talkers():
    sound = in_a_room(HERE, vowel(130.0), FS) + 0.5 * in_a_room(THERE, vowel(220.0), FS)
    meter = VoiceMeter(ARRAY, Band.of(SteeredSettings(), FS))
    one = meter.hear(window(sound).spectra, MICROPHONES, np.array([HERE, THERE]))
    other = meter.hear(window(30.0 * sound).spectra, MICROPHONES, np.array([THERE, HERE]))
    assert np.allclose(voice.raw(one), voice.raw(other)[::-1], atol=1e-3)


def test_noise_and_silence_have_no_voice():
    rng = np.random.default_rng(1)
    rustle = in_a_room(HERE, rng.standard_normal(FS), FS, reflection=0.4)
    localizer = SteeredLocalizer(ARRAY, SteeredSettings(), rng)
    decisions = list(localizer.localize([Block(np.concatenate([rustle, np.zeros((FS, 8))]))]))
    assert any(len(one.scores) for one in decisions)
    assert not any(one.features for one in decisions)


@pytest.mark.parametrize("settings", [SteeredSettings(window=0.1), SteeredSettings(band=(80.0, 4000.0))])
def test_windows_and_bands_other_than_the_fitted_ones_give_no_voice(settings):
    assert features(in_a_room(HERE, vowel(120.0), FS), HERE, settings=settings) == {}


def test_a_stream_in_pieces_gives_the_same_voices_and_they_are_those_of_the_talker():
    spoken = vowel(140.0, 1.5)
    spoken *= 1.0 + 0.8 * np.sin(2.0 * np.pi * 3.7 * np.arange(len(spoken)) / FS)  # what stays as loud is a machine
    sound = noisy(in_a_room(HERE, spoken, FS, reflection=0.5), 25.0, np.random.default_rng(2))

    def said(pieces):
        localizer = SteeredLocalizer(ARRAY, SteeredSettings(), np.random.default_rng(0))
        return [one.detections() for one in localizer.localize(map(Block, pieces))]

    whole, again = said([sound]), said(np.array_split(sound, 17))
    voices = [one.features["voice"] for one in whole if one.features]
    assert len(voices) > 8
    for one, other in zip(voices, [one.features["voice"] for one in again if one.features], strict=True):
        assert (one.vectors == other.vectors).all()
        assert (one.sds == other.sds).all()
    for one in voices:
        assert abs(one.vectors[0, 0] - np.log(140.0)) < one.sds[0, 0]


def test_the_fitted_law_and_what_is_known_of_its_kind_agree():
    law, kind = voice.fitted_law(), known(voice.KIND)
    assert law.projection.shape == (1 + voice.BANDS, len(kind.mean))
    assert law.projection[:, 0].tolist() == [1.0] + [0.0] * voice.BANDS
    assert kind.mean[0] == law.mean[0]
    assert (kind.between > 0).all()
    stated = json.loads(fit_voice.KNOWN.read_bytes())
    assert stated["fitted_on"]
    assert len(stated["components"]) == len(kind.mean)


def made(rng, people=60, portions=3, each=25):
    """Looks at people whose moments are known: between 1, portions 0.25, within 0.5, in all values."""
    size = 1 + voice.BANDS
    talker, portion, count = np.meshgrid(np.arange(people), np.arange(portions), np.arange(each), indexing="ij")
    own = rng.normal(0.0, 1.0, (people, 1, 1, size)) + rng.normal(0.0, 0.5, (people, portions, 1, size))
    raw = (own + rng.normal(0.0, np.sqrt(0.5), (people, portions, each, size))).reshape(-1, size)
    terms = np.column_stack([np.ones(len(raw)), rng.uniform(1.0, 2.0, len(raw)), np.zeros(len(raw))])
    flat = (talker.ravel(), portion.ravel(), 0.1 * count.ravel(), np.zeros(len(raw), bool))
    return fit_voice.Looks(*flat, raw, terms, np.zeros(len(raw)))


def test_the_fit_finds_the_moments_that_looks_were_made_with():
    looks = made(np.random.default_rng(3))
    found = fit_voice.moments(looks, looks.raw)
    for covariance, value in ((found.between, 1.0), (found.portions, 0.25), (found.within, 0.5)):
        assert np.diag(covariance).mean() == pytest.approx(value, rel=0.15)
        assert np.abs(covariance - np.diag(np.diag(covariance))).mean() < 0.15
    components = fit_voice.projection(found)
    assert (components[:, 0] == np.eye(len(components))[0]).all()
    one_look = components.T @ (found.portions + found.within) @ components
    assert np.diag(one_look)[1:] == pytest.approx(np.ones(fit_voice.COMPONENTS - 1))
    assert np.abs(one_look[0, 1:]).max() < 0.1


def test_what_two_looks_say_is_the_odds_of_two_gaussians():
    kind = {"mean": [0.0], "between": [4.0], "correlated": 0.0, "correlation_s": 1.0}
    looks = np.array([[1.0], [1.4]])
    sums = [fit_voice.summed(look[None], np.ones((1, 1)), np.zeros(1), kind) for look in looks]
    found = fit_voice.log_ratios(*[np.array(one) for one in sums], kind)
    joint, apart = np.array([[5.0, 4.0], [4.0, 5.0]]), np.eye(2) * 5.0
    x = looks[:, 0]
    densities = [-0.5 * (x @ np.linalg.solve(c, x) + np.log(np.linalg.det(c))) for c in (joint, apart)]
    assert found == pytest.approx(densities[0] - densities[1])
    twice = fit_voice.summed(np.zeros((2, 1)), np.ones((2, 1)), np.zeros(2), {**kind, "correlated": 1.0 - 1e-9})
    assert twice[1] == pytest.approx([1.0])  # two looks of one error are one


def test_a_wider_spread_is_found_where_errors_are_larger():
    looks = made(np.random.default_rng(4))
    others = np.random.default_rng(5).uniform(0.0, 1.0, len(looks.raw))
    looks = replace(looks, terms=np.column_stack([looks.terms[:, :2], others]))
    values = np.random.default_rng(6).normal(size=(len(others), 3)) * np.exp(0.5 * others)[:, None]
    spread = fit_voice.fit_spread(looks, values)
    assert spread[1] == pytest.approx([0.0, 0.0, 1.0], abs=0.3)


def test_channels_that_the_sound_has_not_reached_are_no_copies():
    rng = np.random.default_rng(3)
    band = Band.of(SteeredSettings(), FS)
    sound, ringing = rng.normal(size=(len(MICROPHONES), band.size)), rng.normal(size=band.size)
    for level, whole, said in ((1e-4, 1.0, False), (1.0, 1.0, True), (1.0, 1e-10, False), (1.0, 1e-6, False)):
        sound[[4, 5]] = level * ringing
        notices = Correlator(ARRAY, band, 400, 1.0).correlate(whole * sound, correlation.hann(band.size)).notices
        assert any("channels 5 and 6 are the same" in notice for notice in notices) == said


@pytest.mark.parametrize(
    ("taken", "notices"),
    [
        ([0, 1, 2, 3, 4, 5, 6, 7], set()),
        ([0, 0, 2, 3, 3, 5, 3, 7], {"channels 1 and 2", "channels 4, 5 and 7"}),
        ([3] * 8, {"all channels"}),
    ],
)
def test_all_copies_of_a_signal_are_named_in_one_sentence(taken, notices):
    band = Band.of(SteeredSettings(), FS)
    sound = np.random.default_rng(4).normal(size=(len(MICROPHONES), band.size))[taken]
    window = Correlator(ARRAY, band, 400, 1.0).correlate(sound, correlation.hann(band.size))
    assert set(window.notices) == {f"{one} are the same signal and left out" for one in notices}
