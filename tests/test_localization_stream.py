"""Pieces of a recording on one clock, and what is remembered of decisions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from localization_rooms import MICROPHONES, ROOM

from avcli.formats.bounds import LONGEST_GAP_S
from avcli.formats.experiment import Config
from avcli.localization import localizer
from avcli.localization.array import Array
from avcli.localization.memory import CONFIRMED, UNKNOWN, Memory, Trace
from avcli.localization.noise import NoiseLaw
from avcli.localization.settings import ClosedFormSettings, SteeredSettings
from avcli.localization.stream import Block, LatestSamples, Recording, stretches

RATE = 100
CONFIG = Config(
    {
        "microphone_config": {"audio_sample_rate_hz": RATE, "mic_positions_m": MICROPHONES.tolist()},
        "room_config": {"room_dimensions_m": ROOM.tolist()},
    }
)


def numbered(first, count):
    """Samples (count, 8) that say where on the clock they are."""
    return np.repeat(np.arange(first, first + count, dtype=float)[:, None], 8, axis=1)


def pieces(recording, *placed, tail=None):
    """What comes of pieces (start, count): samples (n,), and the tail in s after each block."""
    blocks = [
        block
        for start, count in placed
        for block in recording.piece(
            "a.wav", [(numbered(start, count), RATE)], start_sample=start, num_samples=count, tail_samples=tail
        )
    ]
    return np.concatenate([block.samples[:, 0] for block in blocks]), [block.tail for block in blocks]


@given(st.lists(st.integers(1, 300), min_size=1, max_size=8), st.integers(0, 500))
def test_pieces_in_a_row_are_the_whole(counts, start):
    starts = start + np.cumsum([0, *counts[:-1]])
    recording = Recording(CONFIG.microphones)
    samples, _ = pieces(recording, *zip(starts.tolist(), counts, strict=True))
    assert recording.begin == start
    np.testing.assert_array_equal(samples, np.arange(start, start + sum(counts)))


def test_what_is_missing_is_silence_and_what_is_repeated_is_dropped_and_both_are_said():
    said = []
    recording = Recording(CONFIG.microphones, warn=lambda text, kind: said.append((text, kind)))
    samples, _ = pieces(recording, (10, 20), (40, 10), (35, 20))
    np.testing.assert_array_equal(samples, [*range(10, 30), *[0] * 10, *range(40, 50), *range(50, 55)])
    assert said == [
        ("a.wav: 10 samples before it are missing; they count as silence", "gaps"),
        ("a.wav: 15 of its samples are repeated; they are dropped", "repeated"),
    ]


def test_a_long_gap_starts_the_recording_anew_and_writes_no_silence():
    said = []
    recording = Recording(CONFIG.microphones, warn=lambda text, kind: said.append((text, kind)))
    gap = LONGEST_GAP_S * RATE
    far = 4_410_000_000_000
    samples, _ = pieces(recording, (0, 20), (20 + gap, 10), (far, 20))
    assert len(samples) == 20 + gap + 10 + 20, "ten seconds are silence, more than that is not"
    missing = f"a.wav: {(far - 30 - gap) / RATE:.0f} s before it are missing; the recording starts anew there"
    assert said[1:] == [(missing, "long gaps")]
    blocks = [
        Block(np.zeros((5, 8))),
        Block(np.ones((5, 8))),
        Block(np.ones((3, 8)), begin=far),
        Block(np.ones((2, 8))),
    ]
    found = [(begin, sum(len(block.samples) for block in stretch)) for begin, stretch in stretches(blocks, 7)]
    assert found == [(7, 10), (far, 5)]
    assert list(stretches([], 0)) == []


def test_a_clock_that_is_set_back_starts_the_recording_anew_and_loses_no_sound():
    said = []
    recording = Recording(CONFIG.microphones, warn=lambda text, kind: said.append((text, kind)))
    hour = 3600 * RATE
    samples, _ = pieces(recording, (hour, 20), (hour + 20, 20), (RATE, 20), (RATE + 20, 10), (RATE, 20))
    np.testing.assert_array_equal(samples, [*range(hour, hour + 40), *range(RATE, RATE + 30)])
    assert said[0] == (
        f"a.wav: time goes back from {(hour + 20) / RATE:.4f} to 1.0000 s; the recording starts anew there",
        "set back",
    )
    assert said[1][1] == "repeated", "the same piece twice is no clock that was set back"


def test_nothing_is_decided_about_what_comes_after_the_scene():
    known = Recording(CONFIG.microphones, reverberation_s=0.5)
    assert pieces(known, (0, 100), tail=0)[1] == [0.0]
    assert pieces(known, (100, 100), tail=30)[1] == [0.3]
    assert pieces(known, (200, 100), tail=100)[1] == [1.3]
    unknown = Recording(CONFIG.microphones, reverberation_s=0.5)
    assert pieces(unknown, (0, 100))[1] == [0.5]
    assert pieces(unknown, (100, 100), tail=0)[1] == [0.5], "it held back so far, and goes on with it"


@pytest.mark.parametrize(
    ("samples", "rate", "message"),
    [(np.zeros((50, 7)), RATE, "7 channels.* 8 microphones"), (np.zeros((50, 8)), 200, "200 Hz.* 100 Hz")],
)
def test_sound_that_is_not_the_microphones_is_refused(samples, rate, message):
    with pytest.raises(ValueError, match=message):
        list(Recording(CONFIG.microphones).sound("a.wav", [(samples, rate)]))
    with pytest.raises(ValueError, match="10 samples fewer"):
        list(
            Recording(CONFIG.microphones).piece(
                "a.wav", [(numbered(0, 40), RATE)], start_sample=0, num_samples=50, tail_samples=None
            )
        )


def test_settings_and_methods_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match='one of srp, 3d-ssl, not "magic"'):
        localizer(CONFIG, "magic")
    with pytest.raises(ValueError, match="ClosedFormSettings are not the settings of srp"):
        localizer(CONFIG, "srp", settings=ClosedFormSettings())
    with pytest.raises(ValueError, match="3d-ssl"):
        localizer(CONFIG, "3d-ssl", settings=SteeredSettings())


def test_the_temperature_sets_the_speed_of_sound():
    assert Array.of(CONFIG).speed_of_sound == 343.0
    assert Array.of(CONFIG, 20.0).speed_of_sound == pytest.approx(343.2)


@given(st.lists(st.integers(1, 80), min_size=1, max_size=10), st.integers(0, 200), st.integers(16, 60))
def test_windows_do_not_depend_on_how_the_stream_is_cut(counts, at, size):
    whole, parts = LatestSamples(0, 8), LatestSamples(0, 8)
    samples = numbered(0, sum(counts)) + 1.0
    whole.append(samples)
    for first, count in zip(np.cumsum([0, *counts[:-1]]), counts, strict=True):
        parts.append(samples[first : first + count])
    parts.forget(at)
    for one, two in zip(whole.window(at, size), parts.window(at, size), strict=True):
        np.testing.assert_array_equal(one, two)


def test_memory_fades_and_a_trace_that_is_seen_again_is_replaced():
    memory = Memory(rate=10.0, max_speed=1.6, kept=0.5)
    here, there = np.array([1.0, 1.0, 1.5]), np.array([3.0, 3.0, 1.5])
    memory.keep([Trace(here, np.zeros(3), 2.0), Trace(there, np.zeros(3), 1.2)])
    assert [trace.lasting for trace in memory.known()] == [2.0, 1.2]
    memory.keep([Trace(here + 0.1, np.zeros(3), 1.8)])
    assert [(trace.lasting, trace.age) for trace in memory.traces] == [(1.8, 1), (0.6, 2)]
    assert memory.reach(memory.traces[1]) == pytest.approx(0.2 + 1.6 * 0.2)
    for _ in range(6):
        memory.keep([])
    assert memory.known() == []
    assert len(memory.traces) == 1
    memory.keep([])
    memory.keep([])
    assert memory.traces == []


def test_who_was_confirmed_is_looked_for_again_for_a_second():
    memory = Memory(rate=10.0, max_speed=1.6, kept=0.9)
    assert memory.confirmed(UNKNOWN, own=9.0) == CONFIRMED
    assert memory.confirmed(CONFIRMED, own=0.0) == pytest.approx(CONFIRMED - 0.1)
    memory.keep([Trace(np.ones(3), np.zeros(3), 0.4, CONFIRMED), Trace(np.full(3, 4.0), np.zeros(3), 0.4)])
    for _ in range(9):
        assert [trace.position[0] for trace in memory.known()] == [1.0]
        memory.keep([])
    memory.keep([])
    memory.keep([])
    assert memory.known() == []


def test_a_place_becomes_familiar_where_something_is_heard_again_and_again():
    memory = Memory(rate=10.0, max_speed=1.6, kept=0.5)
    here, beside, there = np.array([1.0, 1.0, 1.5]), np.array([1.3, 1.0, 1.5]), np.array([3.0, 3.0, 1.5])
    known = [memory.familiar(here)]
    for _ in range(60):
        memory.keep([Trace(here, np.zeros(3), 1.0, heard=1.0), Trace(there, np.zeros(3), 1.0, heard=0.5)])
        known.append(memory.familiar(here))
    assert known[0] == 0.0
    assert (np.diff(known) >= 0.0).all()
    assert known[-1] == pytest.approx(0.94, abs=0.03)
    assert memory.familiar(beside) == known[-1]
    assert memory.familiar(there) == pytest.approx(0.5 * known[-1], rel=0.06)
    assert memory.familiar(np.full(3, 2.0)) == 0.0
    for _ in range(15):
        memory.keep([])
    assert memory.familiar(here) == pytest.approx(known[-1] / np.e, rel=0.15)
    for _ in range(60):
        memory.keep([])
    assert memory.familiar(here) == 0.0
    assert len(memory.heard) == 0


def test_a_fall_is_from_the_loudest_of_the_last_second():
    memory = Memory(rate=10.0, max_speed=1.6, kept=0.5)
    assert memory.fall(1.0) == 0.0
    assert memory.fall(0.01) == pytest.approx(-20.0)
    assert memory.fall(0.0) <= -100.0
    for _ in range(10):
        memory.fall(0.01)
    assert memory.fall(0.001) == pytest.approx(-10.0)
    memory.forget()
    assert memory.fall(1e-9) == 0.0


def test_the_noise_law_is_gumbels_and_falls_with_the_number_of_windows():
    law = NoiseLaw(location=0.2, scale=0.01, deviation=0.05, windows=3)
    for false_alarm in (0.5, 0.01):
        exceeded = 1.0 - np.exp(-np.exp(-(law.threshold(false_alarm) - 0.2) / 0.01))
        assert exceeded == pytest.approx(false_alarm)
    assert law.of(12).location == pytest.approx(0.1)
    assert law.of(3) == law
