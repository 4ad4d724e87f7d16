"""The sound of whole scenes from Python: the same as the command's, with the rules for rooms, voices and clocks."""

import doctest
import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import done
from hypothesis import given
from hypothesis import settings as hypotheses
from hypothesis import strategies as st

from avcli.acoustics import absorption as walls
from avcli.acoustics import hear, recorder
from avcli.acoustics.decay import image_absorption
from avcli.acoustics.recorder import Recorder
from avcli.acoustics.settings import PATTERNS, Settings
from avcli.acoustics.signals import active_level, pascal, recording_faults, source_signal
from avcli.acoustics.surroundings import surroundings_of, walls_of
from avcli.acoustics.trajectory import trajectories_of
from avcli.formats import media
from avcli.formats.experiment import DIRECTIVITIES, Config
from avcli.formats.records import Identified
from avcli.settings import DEFAULT_RT60_S

RATE = 16000
ROOM = [4.66, 4.66, 3.0]
MICROPHONES = [[0.115, 4.545, 2.493], [4.545, 0.115, 2.489], [2.386, 2.253, 2.489]]
CONFIG = Config(
    {
        "microphone_config": {"audio_sample_rate_hz": RATE, "mic_positions_m": MICROPHONES},
        "room_config": {"room_dimensions_m": ROOM, "reverberation_time_s": 0.2},
    }
)
TIMES = np.arange(8) / 10


def people(time):
    """Two people: one walks and talks, the other stands and begins to talk at 0.3 s."""
    mouths = np.array([[0.5 + time, 2.33, 1.6], [3.0, 3.0, 1.5]])
    return Identified(time, np.array([0, 1]), mouths * (1, 1, 0), mouths, np.array([1.0, time >= 0.3]))


SCENE = [people(time) for time in TIMES]


@pytest.mark.parametrize("module", [recorder, walls])
def test_the_examples_in_the_documentation(module):
    result = doctest.testmod(module)
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.parametrize("noise", [(), ("--noise", "sensor=40", "--noise", "room=30", "--seed", "3")])
def test_the_sound_is_that_of_the_command(tmp_path, noise):
    (tmp_path / "config.json").write_text(json.dumps(CONFIG.raw))
    truth = "".join(
        json.dumps(
            {
                "timestamp": f"{moment.timestamp:.10f}",
                "objects": [
                    {"object_id": i, "position": p, "mouth_position": m, "speaking": bool(s)}
                    for i, p, m, s in zip(
                        moment.ids.tolist(),
                        moment.positions.tolist(),
                        moment.mouths.tolist(),
                        moment.speaking,
                        strict=True,
                    )
                ],
            }
        )
        + "\n"
        for moment in SCENE
    )
    result = done("avsim-audio", "-C", tmp_path, *noise, stdin=truth)
    record = json.loads(result.stdout)["audio"]
    settings = Settings(sensor_noise_db=40.0, room_noise_db=30.0) if noise else None
    sound = hear(CONFIG, SCENE, seed=3 if noise else 0, settings=settings)
    written, rate = media.read_audio(tmp_path / record["path"])
    assert sound.sample_rate_hz == rate == RATE
    assert sound.samples.dtype == np.float32
    assert np.array_equal(sound.samples, written)
    assert sound.tail_samples == record["tail_samples"] == round(0.2 * RATE)


@hypotheses(max_examples=5, deadline=None)
@given(taken=st.lists(st.booleans(), min_size=len(TIMES), max_size=len(TIMES)))
def test_the_sound_does_not_depend_on_when_it_is_taken(taken):
    simulation = Recorder(CONFIG, Settings(rt60_s=0.15, error_db=-20.0))
    pieces = []
    for moment, now in zip(SCENE, taken, strict=True):
        simulation.step(moment)
        if now:
            pieces += simulation.pieces()
    simulation.finish()
    pieces += simulation.pieces()
    whole = hear(CONFIG, SCENE, settings=Settings(rt60_s=0.15, error_db=-20.0)).samples
    assert np.array_equal(np.concatenate(pieces).astype(np.float32), whole)
    assert simulation.end == len(whole)


def test_what_the_ground_truth_leaves_out():
    def moments(**known):
        return [Identified(time, np.array([0]), np.array([[1.0, 2.0, np.nan]]), **known) for time in TIMES[:4]]

    settings = Settings(rt60_s=0.0)
    known = hear(CONFIG, moments(mouths=np.array([[1.0, 2.0, 1.6]]), speaking=np.ones(1)), settings=settings)
    assert known.samples.any()
    assert np.array_equal(hear(CONFIG, moments(), settings=settings).samples, known.samples)
    flat = hear(CONFIG, moments(mouths=np.array([[1.0, 2.0, np.nan]])), settings=settings)
    assert np.array_equal(flat.samples, known.samples)
    lower = hear(CONFIG, moments(), settings=replace(settings, mouth_height_m=1.2))
    assert not np.allclose(lower.samples, known.samples)
    assert not hear(CONFIG, moments(speaking=np.zeros(1)), settings=settings).samples.any()


def test_scenes_without_people_and_without_times():
    nobody = [Identified(time, np.zeros(0, int), np.zeros((0, 3))) for time in TIMES]
    sound = hear(CONFIG, nobody)
    assert sound.samples.shape == (round(0.9 * RATE), 3)
    assert not sound.samples.any()
    empty = hear(CONFIG, [])
    assert empty.samples.shape == (0, 3)
    assert empty.tail_samples == 0


def test_a_scene_must_start_at_its_beginning():
    with pytest.raises(ValueError, match=r"subtract its start"):
        hear(CONFIG, [replace(moment, timestamp=moment.timestamp + 1.7e9) for moment in SCENE])
    with pytest.raises(ValueError, match=r"0\.1 is not later than 0\.2"):
        hear(CONFIG, [people(0.2), people(0.1)])


def test_a_user_is_warned():
    said = []
    corner = Identified(0.0, np.array([0]), np.array([[0.0, 0.0, 0.0]]))
    hear(CONFIG, [corner, replace(corner, timestamp=0.1)], say=said.append)
    assert said == ["a mouth on a wall or outside the room was moved inside (2 times)"]
    with pytest.warns(UserWarning, match="simulated without reverberation"):
        Recorder(CONFIG, Settings(rt60_s=0.01))


def test_a_microphone_that_is_carried():
    """A path that rests at another place gives the sound of a microphone that stands there."""
    there = [4.0, 4.0, 1.0]
    paths = trajectories_of([Identified(0.0, np.array([1]), np.array([there]))])
    settings = Settings(rt60_s=0.0)
    sound = hear(CONFIG, SCENE, trajectories=paths, settings=settings)
    raw = {**CONFIG.raw, "microphone_config": {"audio_sample_rate_hz": RATE, "mic_positions_m": MICROPHONES[:1]}}
    raw["microphone_config"]["mic_positions_m"] = [MICROPHONES[0], there, MICROPHONES[2]]
    np.testing.assert_allclose(sound.samples, hear(Config(raw), SCENE, settings=settings).samples, atol=1e-7)
    for channel, position, message in ((3, there, "microphone 4 does not exist"), (1, [9.0, 1, 1], "outside the room")):
        wrong = trajectories_of([Identified(0.0, np.array([channel]), np.array([position]))])
        with pytest.raises(ValueError, match=message):
            Recorder(CONFIG, trajectories=wrong)


# --- rooms ------------------------------------------------------------------------------------------------------------


def test_the_first_that_is_stated_decides_on_the_walls():
    def room(**keys):
        return Config({"room_config": {"room_dimensions_m": ROOM, **keys}}).room

    assert walls_of(room(), Settings())[0] == DEFAULT_RT60_S
    rt60, absorption = walls_of(room(reverberation_time_s=0.5), Settings())
    assert rt60 == 0.5
    np.testing.assert_allclose(absorption, image_absorption(ROOM, 0.5))
    sabine = Settings(absorption_model="sabine")
    np.testing.assert_allclose(walls_of(room(), sabine)[1], walls.sabine_absorption(ROOM, DEFAULT_RT60_S))
    rt60, absorption = walls_of(room(reverberation_time_s=0.5, absorption=0.2), Settings())
    np.testing.assert_array_equal(absorption, np.full(6, 0.2))
    assert rt60 == pytest.approx(walls.sabine_rt60(ROOM, 0.2))
    assert walls_of(room(absorption=0.2), Settings(rt60_s=0.4))[0] == 0.4
    six = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    np.testing.assert_array_equal(walls_of(room(absorption=0.2), Settings(absorption=six))[1], six)
    for anechoic in (Settings(rt60_s=0.0), Settings(absorption=(1.0,) * 6)):
        rt60, absorption = walls_of(room(), anechoic)
        assert rt60 == 0
        np.testing.assert_array_equal(absorption, np.ones(6))
    with pytest.raises(ValueError, match="absorb nothing"):
        walls_of(room(), Settings(absorption=(0.0,) * 6))
    with pytest.raises(ValueError, match="the shortest is"):
        walls_of(room(), Settings(rt60_s=0.1, strict=True, absorption_model="sabine"))


@pytest.mark.parametrize("error_db", [-20.0, -40.0, -60.0])
def test_the_reach_is_the_reverberation_that_is_heard(error_db):
    surroundings = surroundings_of(CONFIG, Settings(error_db=error_db))
    assert surroundings.reach_m == pytest.approx(0.2 * (15 - error_db) / 60 * 343)
    assert surroundings.tail_s == 0.2
    assert surroundings.end_s == 0.0
    shorter = surroundings_of(CONFIG, Settings(error_db=error_db, ism_decay_db=15.0))
    assert shorter.reach_m == pytest.approx(0.2 * 15 / 60 * 343)
    assert shorter.end_s == 0.2
    dry = surroundings_of(CONFIG, Settings(rt60_s=0.0))
    assert dry.reach_m == pytest.approx(np.linalg.norm(ROOM))
    assert dry.tail_s == pytest.approx(np.linalg.norm(ROOM) / 343)


def test_very_long_reverberation_needs_noise():
    said = []
    surroundings_of(CONFIG, Settings(rt60_s=1.0), say=said.append)
    assert "use --ism-decay 15" in said[0]
    for rt60 in (5.0, 10.0):
        with pytest.raises(ValueError, match=r"GiB; use --ism-decay \d+") as refused:
            surroundings_of(CONFIG, Settings(rt60_s=rt60))
        advised = float(str(refused.value).split("--ism-decay ")[1].split(",")[0])
        surroundings_of(CONFIG, Settings(rt60_s=rt60, ism_decay_db=advised), say=said.append)
    with pytest.raises(ValueError, match="GiB; use a shorter reverberation time"):
        surroundings_of(CONFIG, Settings(rt60_s=100.0))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rt60_s": -1.0}, "rt60_s must be at least 0, not -1"),
        ({"error_db": 5.0}, "error_db must be at most -10, not 5"),
        ({"mouth_height_m": 0.0}, "mouth_height_m must be above 0, not 0"),
        ({"pause_s": float("inf")}, "pause_s must be a finite number, not inf"),
        ({"absorption_model": "sabin"}, "absorption_model must be one of image, sabine, eyring, not sabin"),
        ({"absorption": (0.5,)}, "absorption must be six numbers from 0 to 1"),
    ],
)
def test_settings_out_of_their_bounds_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Settings(**wrong)


def test_the_patterns_are_those_of_the_configuration():
    assert (*DIRECTIVITIES, "voice") == PATTERNS


# --- voices -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [8000, 16000, 44100])
def test_a_recording_becomes_a_voice_of_the_wanted_level(rate):
    tone = 0.1 * np.sin(2 * np.pi * 440 * np.arange(rate) / rate)
    signal = source_signal(media.Sound(np.column_stack([tone, 3 * tone]), rate), RATE, 66.0)
    assert len(signal) == RATE
    assert active_level(signal, RATE) / (4 * np.pi) == pytest.approx(pascal(66.0), rel=1e-3)
    expected = np.sin(2 * np.pi * 440 * np.arange(RATE) / RATE) * signal.max()
    np.testing.assert_allclose(signal[100:-100], expected[100:-100], atol=0.01 * signal.max())


def test_unusual_recordings_are_named():
    loud = np.clip(3 * np.sin(np.arange(8000) / 5), -1, 1)[:, None]
    assert recording_faults(media.Sound(0.5 * loud, RATE)) == []
    assert recording_faults(media.Sound(loud, RATE)) == ["is clipped"]
    assert recording_faults(media.Sound(0 * loud, RATE)) == ["is silent from beginning to end"]
    assert recording_faults(media.Sound(np.hstack([loud, loud]) / 2, RATE)) == [
        "has 2 channels; the voice is their mean"
    ]
