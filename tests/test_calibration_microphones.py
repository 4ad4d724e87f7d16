"""Microphone positions and clocks, from voices whose way is known."""

import numpy as np
import pytest

from avcli.calibration import microphones

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
