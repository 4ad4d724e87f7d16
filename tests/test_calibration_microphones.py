"""Microphone positions and clocks, from voices whose way is known."""

import json

import numpy as np
import pytest
import soundfile

from avcli.calibration import camera, microphones
from avcli.formats.records import Identified

SPEED = 343.0
ROOM = np.array(
    [
        [0.115, 4.545, 2.493],
        [2.401, 4.498, 2.385],
        [4.545, 4.545, 2.484],
        [4.498, 2.342, 2.380],
        [4.545, 0.115, 2.489],
        [2.395, 0.162, 2.378],
        [0.115, 0.115, 2.489],
        [2.386, 2.253, 2.489],
    ]
)
"""The thesis's microphones, m."""


def walk(seconds=30.0):
    """A winding walk through the room: times (s) and mouths (m)."""
    t = np.arange(0, seconds, 0.1)
    place = np.stack([2.3 + 1.6 * np.sin(0.41 * t), 2.3 + 1.5 * np.sin(0.53 * t + 1), 1.6 + 0.05 * np.sin(2 * t)], -1)
    return t, place


def hear(where, offset, rng, noise=1e-5, wrong=0.15):
    """Delays in windows every 50 ms; the sound's clock lags the picture's by `offset` s."""
    t, path = walk()
    first, second = np.triu_indices(len(where), 1)
    times = np.arange(1.0, 28.0, 0.05)
    delays = []
    for middle in times:
        emitted = middle + offset
        for _ in range(3):
            place = np.array([np.interp(emitted, t, path[:, i]) for i in range(3)])
            emitted = middle + offset - np.linalg.norm(where - place, axis=1).mean() / SPEED
        away = np.linalg.norm(where - place, axis=1)
        delays.append((away[first] - away[second]) / SPEED)
    delays = np.array(delays) + noise * rng.standard_normal((len(times), len(first)))
    lost = rng.random(delays.shape)
    delays[lost < wrong] = rng.uniform(-0.01, 0.01, (lost < wrong).sum())
    delays[lost > 0.95] = np.nan
    return microphones.Heard(times, delays, first, second)


def test_the_clock_and_one_moved_microphone_are_found():
    rng = np.random.default_rng(0)
    true = ROOM.copy()
    true[3] += [0.06, -0.05, 0.04]
    heard = hear(true, 0.24, rng)
    found = microphones.align(heard, *walk(), ROOM, SPEED)
    assert found.clock_offset == pytest.approx(0.24, abs=0.005)
    assert found.improves
    # What everything has in common (a turn or shift of room and path together) is held by the priors alone.
    relative = found.shifts - np.median(found.shifts, axis=0)
    assert np.linalg.norm(relative[3] - [0.06, -0.05, 0.04]) < 0.02
    assert np.linalg.norm(np.delete(relative, 3, 0), axis=1).max() < 0.02


def test_microphones_that_hang_right_are_left_alone():
    found = microphones.align(hear(ROOM, -0.1, np.random.default_rng(1)), *walk(), ROOM, SPEED)
    assert found.clock_offset == pytest.approx(-0.1, abs=0.005)
    assert np.linalg.norm(found.shifts, axis=1).max() < 0.01
    assert not found.improves
    assert found.used > 0.7


def test_too_little_is_refused():
    heard = hear(ROOM, 0.0, np.random.default_rng(2))
    few = microphones.Heard(heard.times[:5], heard.delays[:5], heard.first, heard.second)
    with pytest.raises(ValueError, match="talks or claps"):
        microphones.align(few, *walk(), ROOM, SPEED)
    t, path = walk()
    with pytest.raises(ValueError, match="do not overlap"):
        microphones.align(heard, t + 500, path, ROOM, SPEED)


def person(timestamp, position, mouth=None):
    mouths = None if mouth is None else np.array([mouth])
    known = {} if mouths is None else {"mouths": mouths}
    return Identified(timestamp, np.array([1]), np.array([position], float), **known)


def test_a_mouth_is_where_the_record_says_or_ahead_of_the_walker():
    stated = [person(t, [t, 1.0, 0.0], [t + 0.2, 1.1, 1.5]) for t in (0.2, 0.0, 0.1)]
    times, path = microphones.mouths(stated, 1.7)
    assert times.tolist() == [0.0, 0.1, 0.2]
    assert np.allclose(path, [[0.2, 1.1, 1.5], [0.3, 1.1, 1.5], [0.4, 1.1, 1.5]])
    walker = [person(t, [t, 1.0, 0.0]) for t in np.arange(0, 3, 0.1)]  # 1 m/s along x
    times, path = microphones.mouths(walker, 1.7)
    assert np.allclose(path, np.stack([times + microphones.MOUTH_AHEAD_M, 0 * times + 1, 0 * times + 1.7], -1))


def test_records_with_several_people_or_none_are_left_out():
    nobody = Identified(0.5, np.zeros(0, int), np.zeros((0, 3)))
    two = Identified(0.6, np.array([1, 2]), np.zeros((2, 3)))
    assert microphones.mouths([nobody, two, person(0.7, [1, 1, 0], [1, 1, 1.6])], 1.6)[0].tolist() == [0.7]


def test_sound_follows_on_or_starts_at_the_time_in_its_name(tmp_path):
    for name in ("multichannel_audio_0.0000000000.wav", "multichannel_audio_7.5000000000.wav"):
        soundfile.write(tmp_path / name, np.zeros((800, 2)), 8000)
    files = sorted(map(str, tmp_path.iterdir()))
    assert [(start, len(x), rate) for start, x, rate in microphones.sounds(files, None)] == [
        (0.0, 800, 8000),
        (0.1, 800, 8000),
    ]
    assert [start for start, _, _ in microphones.sounds([], tmp_path)] == [0.0, 7.5]
    with pytest.raises(ValueError, match="no sound in"):
        list(microphones.sounds([], tmp_path / "empty"))


def test_found_positions_go_into_a_config_and_all_else_stays(tmp_path):
    raw = {
        "session_id": "a",
        "microphone_config": {
            "audio_bit_depth": 24,
            "mic_positions_m": [{"object_id": 1, "position": [0, 0, 0]}, [1, 1, 1]],
        },
    }
    camera.write_microphones(tmp_path / "config.json", raw, [[0.1, 0.2, 0.3], [1.1, 1.2, 1.3]], 0.004)
    assert json.loads((tmp_path / "config.json").read_text()) == {
        "session_id": "a",
        "microphone_config": {
            "audio_bit_depth": 24,
            "mic_positions_m": [{"object_id": 1, "position": [0.1, 0.2, 0.3]}, [1.1, 1.2, 1.3]],
            "calibration": {"sd_m": 0.004},
        },
    }
    assert raw["microphone_config"]["mic_positions_m"][1] == [1, 1, 1]
