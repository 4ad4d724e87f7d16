"""The beam at a track, on sound whose every part is known."""

import numpy as np
import pytest

from avcli.formats.experiment import Config
from avcli.formats.records import Identified
from avcli.localization.array import Array
from avcli.localization.beam import Beams, paths

RATE, ROOM = 16000, np.array([5.0, 4.0, 2.6])
CORNERS = np.array([[x, y, z] for x in (0.1, 4.9) for y in (0.1, 3.9) for z in (2.2, 2.4)])
BODIES = {"a": [1.4, 1.0], "b": [3.4, 3.0]}
MOUTHS = {"a": [1.5, 1.1, 1.5], "b": [3.5, 2.9, 1.7]}


def voice(seed, count=2 * RATE):
    """Noise in bursts, as speech comes and goes in time and frequency."""
    rng = np.random.default_rng(seed)
    bursts = np.repeat(rng.random(count // 1600) < 0.5, 1600)
    return np.pad(rng.normal(size=count - count % 1600) * bursts, (0, count % 1600))


def arriving(name, samples):
    """What each microphone hears of a voice, without reverberation."""
    distance = np.linalg.norm(CORNERS - MOUTHS[name], axis=1)
    spectrum = np.fft.rfft(samples, 2 * len(samples))
    delay = np.exp(-2j * np.pi * np.fft.rfftfreq(2 * len(samples))[:, None] * distance / 343.0 * RATE)
    return np.fft.irfft(spectrum[:, None] * delay / distance, axis=0)[: len(samples)]


def moved(samples, by_s):
    """The samples, later by some s."""
    spectrum = np.fft.rfft(samples, 2 * len(samples))
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(2 * len(samples)) * by_s * RATE)
    return np.fft.irfft(spectrum * turn)[: len(samples)]


def listener(sound, names="ab", until=2.0):
    def read(first, last):
        begin, end = max(first, 0), min(last, len(sound))
        return np.pad(sound[begin:end], ((begin - first, last - end), (0, 0)))

    records = [
        Identified(
            t, np.arange(len(names)), np.array([[*BODIES[name], 0.0] for name in names]), names=dict(enumerate(names))
        )
        for t in np.arange(0, until + 0.05, 0.1)
    ]
    return Beams(Array(CORNERS, RATE, ROOM), paths(records, 0.0), read)


def test_a_voice_comes_out_as_it_was_said_and_the_other_is_damped():
    voices = {name: voice(seed) for seed, name in enumerate("ab")}
    heard = {name: arriving(name, samples) for name, samples in voices.items()}
    beams = listener(sum(heard.values())).hear(0, 2 * RATE)
    inside = slice(RATE // 4, -RATE // 4)
    for name in "ab":
        said, other = (voices[who][inside] for who in (name, "ab".replace(name, "")))
        fits = [
            np.linalg.lstsq(np.stack([said, other], axis=1), moved(beams[name], by)[inside], rcond=None)[0]
            for by in np.arange(-0.5e-3, 0.5e-3, 0.25 / RATE)  # the mouth is up to 0.15 m nearer than the path
        ]
        gains = max(fits, key=lambda each: each[0])
        assert 0.5 < gains[0] < 1.05, name  # a mouth beside the track's place loses some of the highest tones
        assert abs(gains[1]) < 0.1 * gains[0], name


def test_parts_are_the_same_as_the_whole_and_nobody_is_heard_who_is_gone():
    sound = arriving("a", voice(3))
    beams = listener(sound, "a", until=1.0)
    whole = beams.hear(0, 2 * RATE)["a"]
    assert whole[: RATE // 2].std() > 0.1
    assert not whole[RATE + 2000 :].any()
    assert beams.hear(RATE + 4000, 2 * RATE) == {}
    part = beams.hear(4000, 8000)["a"]
    np.testing.assert_allclose(part, whole[4000:8000], atol=0.05 * np.abs(whole).max())


def test_silence_stays_silence_and_one_microphone_is_no_array():
    assert not listener(np.zeros((2 * RATE, len(CORNERS)))).hear(0, RATE)["b"].any()
    with pytest.raises(ValueError, match="two microphones"):
        Beams(Array(CORNERS[:1], RATE, ROOM), {}, lambda first, last: np.zeros((last - first, 1)))


def test_channels_that_config_names_as_faulty_are_put_right_for_the_beam():
    sound = sum(arriving(name, voice(seed)) for seed, name in enumerate("ab"))
    faulty = sound[:, [0, 2, 1, 3, 4, 5, 6, 7]] * np.where(np.arange(8) == 4, -1.0, 1.0)
    faulty[:, 5] = np.roll(faulty[:, 5], 40)
    faulty[:, 7] = 0.0
    channels = [{"channel": c + 1} for c in (0, 2, 1, 3, 4, 5, 6, 7)]
    channels[4]["polarity"], channels[5]["delay_s"], channels[7]["usable"] = -1, 40 / RATE, False

    def heard(samples, microphones, known):
        section = {"mic_positions_m": microphones.tolist(), "audio_sample_rate_hz": RATE, **known}
        config = Config({"microphone_config": section, "room_config": {"room_dimensions_m": ROOM.tolist()}})

        def read(first, last):
            at = np.arange(first, last)
            known = (at >= 0) & (at < len(samples))
            return samples[np.clip(at, 0, len(samples) - 1)] * known[:, None]

        records = [Identified(t, np.array([0]), np.array([[*BODIES["a"], 0.0]])) for t in np.arange(0, 2.05, 0.1)]
        return Beams.of(config, records, 0.0, RATE, read).hear(0, 2 * RATE)[0]

    healthy = heard(sound[:, :7], CORNERS[:7], {})
    mended = heard(faulty, CORNERS, {"channels": channels})
    inside = slice(RATE // 4, -RATE // 4)  # the last samples of the late channel were never recorded
    assert np.abs(mended - healthy)[inside].max() < 0.02 * np.abs(healthy).max()
