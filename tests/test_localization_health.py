"""Faulty channels: what is said of them, and that they make no talker who is not there."""

import numpy as np
import pytest
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.formats.experiment import Wiring
from avcli.localization import correlation
from avcli.localization.array import Array
from avcli.localization.health import CHANGED, ORDERED
from avcli.localization.rewiring import Moments, Remedy, Rewiring, turned_over
from avcli.localization.settings import ClosedFormSettings, SteeredSettings
from avcli.localization.ssl3d import ClosedFormLocalizer
from avcli.localization.steered import CONTRADICTED, UNSETTLED, SteeredLocalizer
from avcli.localization.stream import Block

FS = 16000
PLACE = np.array([1.4, 3.1, 1.55])


@pytest.fixture(scope="module")
def talk():
    """3 s of one talker in a room that echoes a little, with noise 30 dB below."""
    samples = heard(PLACE, voice(3.0, FS, np.random.default_rng(21)), FS, reflection=0.6, order=2)
    return noisy(samples, 30, np.random.default_rng(22))


def localize(samples, microphones=MICROPHONES, settings=None):
    array = Array(microphones, FS, ROOM, 343.0)
    localizer = SteeredLocalizer(array, settings or SteeredSettings(), np.random.default_rng(0))
    return list(localizer.localize([Block(samples)]))


def late(samples, channel, count):
    return np.column_stack([np.roll(x, count * (c == channel)) for c, x in enumerate(samples.T)])


def turned(samples, *channels):
    return samples * np.where(np.isin(np.arange(samples.shape[1]), channels), -1.0, 1.0)


def check(decisions, expected):
    """The faults are named, each once, and from then on there is one talker, at the right place."""
    last = decisions[-1].faults
    assert {(fault.channel, fault.kind) for fault in last} == expected
    known = [d for d in decisions if len(d.faults) == len(last)]
    assert len(known) >= 5
    positions = np.concatenate([d.positions for d in known])
    assert (np.hypot(*(positions - PLACE)[:, :2].T) < 0.1).mean() >= 0.95
    assert len(positions) >= 0.9 * (len(known) - 3)
    notices = [notice for d in decisions for notice in d.notices]
    assert len(notices) == len(set(notices)) == len(last)
    return last


def test_talkers_are_found_by_misplaced_microphones_and_it_is_said(talk):
    moved = MICROPHONES + 0.03 * np.random.default_rng(2).standard_normal(MICROPHONES.shape)
    decisions = localize(talk, np.clip(moved, 0.05, ROOM - 0.05))
    assert all(len(d.positions) for d in decisions)
    assert np.hypot(*(np.array([d.positions[0] for d in decisions]) - PLACE)[:, :2].T).max() < 0.1
    assert [UNSETTLED.format(1)] == [notice for d in decisions for notice in d.notices]
    assert not any(d.notices for d in localize(talk))


def test_channels_that_are_left_out_do_not_count_against_a_talker(talk):
    noise = np.random.default_rng(23).standard_normal((2, len(talk))) * talk.std()
    decisions = localize(np.column_stack([talk[:, :2], noise[0], talk[:, 3:5], noise[1], talk[:, 6:]]))
    assert {fault.channel for fault in decisions[-1].faults} == {3, 6}
    scores = [d.scores[0] if len(d.scores) else 0.0 for d in decisions if len(d.faults) == 2]
    assert min(scores) > 0.85
    assert np.median(scores) > 0.95


def test_two_channels_of_wrong_polarity(talk):
    check(localize(turned(talk, 2, 5)), {(3, "polarity"), (6, "polarity")})


def test_two_channels_that_are_exchanged(talk):
    faults = check(localize(talk[:, [0, 3, 2, 1, 4, 5, 6, 7]]), {(4, "swapped"), (2, "swapped")})
    assert {fault.channel: fault.microphone for fault in faults} == {2: 4, 4: 2}


def test_a_late_channel_and_one_of_wrong_polarity(talk):
    faults = check(localize(turned(late(talk, 1, 51), 4)), {(2, "late"), (5, "polarity")})
    assert [fault.delay_s for fault in faults if fault.kind == "late"] == [pytest.approx(51 / FS, abs=2e-4)]


def test_a_quiet_channel_is_named_and_does_no_harm(talk):
    quiet = localize(talk * np.where(np.arange(8) == 6, 0.02, 1.0))
    (fault,) = quiet[-1].faults
    assert (fault.channel, fault.kind, fault.corrected) == (7, "level", True)
    assert fault.level_db == pytest.approx(-34.0, abs=6.0)
    assert str(fault) in [notice for d in quiet for notice in d.notices]


def test_where_most_channels_are_dead_it_is_said_and_the_others_are_not_called_loud(talk):
    decisions = localize(talk * (np.arange(8) >= 5))
    assert {(fault.channel, fault.kind) for fault in decisions[-1].faults} == {(k, "dead") for k in range(1, 6)}
    notices = {notice for one in decisions for notice in one.notices}
    assert "fewer than four channels are left: nobody can be located" in notices


def test_noise_alone_is_left_out(talk):
    noise = np.random.default_rng(23).standard_normal(len(talk)) * talk.std()
    decisions = localize(np.column_stack([talk[:, :3], noise, talk[:, 4:]]))
    assert [(f.channel, f.kind, f.corrected) for f in decisions[-1].faults] == [(4, "unexplained", False)]


@pytest.mark.parametrize("seed", [1, 2])
def test_microphones_that_hang_a_little_elsewhere_are_not_called_late(talk, seed):
    moved = MICROPHONES + np.random.default_rng(seed).normal(0.0, 0.02, MICROPHONES.shape)
    assert {fault.kind for fault in localize(talk, moved)[-1].faults} <= {"unexplained"}


def test_a_healthy_array_in_a_room_with_echoes_and_noise_is_not_blamed():
    samples = heard(PLACE, voice(2.0, FS, np.random.default_rng(24)), FS, reflection=0.8, order=3)
    assert localize(noisy(samples, 12, np.random.default_rng(25)))[-1].faults == ()


def test_faults_are_records_and_sentences(talk):
    decision = localize(turned(talk, 2))[-1]
    assert [fault.record() for fault in decision.faults] == [{"channel": 3, "fault": "polarity", "corrected": True}]
    assert str(decision.faults[0]) == "channel 3 has the wrong polarity; this is corrected"


def test_channels_that_config_json_names_are_right_from_the_first_sample(talk):
    broken = turned(late(talk[:, [0, 3, 2, 1, 4, 5, 6, 7]], 1, 51), 4)
    broken[:, 6] = np.random.default_rng(3).standard_normal(len(broken)) * 0.01
    delay = np.where(np.arange(8) == 3, 51 / FS, 0.0)  # microphone 4 is on channel 2, which is late
    sign = np.where(np.arange(8) == 4, -1.0, 1.0)
    wiring = Wiring(np.array([0, 3, 2, 1, 4, 5, 6, 7]), sign, delay, np.arange(8) != 6)
    array = Array(MICROPHONES, FS, ROOM, 343.0, wiring)
    steered = list(SteeredLocalizer(array, SteeredSettings(), np.random.default_rng(0)).localize([Block(broken)]))
    closed = list(ClosedFormLocalizer(array, ClosedFormSettings()).localize([Block(broken)]))
    for decisions, metres in ((steered, 0.1), (closed, 0.5)):
        found = [d.positions[0] for d in decisions if len(d.positions)]
        assert len(found) >= 15
        assert np.median(np.hypot(*(np.array(found) - PLACE)[:, :2].T)) < metres
    assert not any(decision.notices for decision in steered)
    kinds = {(fault.channel, fault.kind) for fault in steered[0].faults}
    assert kinds == {(2, "swapped"), (4, "swapped"), (2, "late"), (5, "polarity"), (7, "unexplained")}


def test_channels_that_are_all_moved_on_by_one(talk):
    """This array differs from itself turned by an eighth; where it did not, nothing could be told."""
    faults = localize(np.roll(talk, 1, axis=1))[-1].faults
    assert {fault.channel: fault.microphone for fault in faults} == {(c + 1) % 8 + 1: c + 1 for c in range(8)}
    assert {fault.kind for fault in faults} == {"swapped"}


def test_two_exchanged_and_one_turned_over(talk):
    exchanged = turned(talk[:, [0, 1, 3, 2, 4, 5, 6, 7]], 5)
    check(localize(exchanged), {(3, "swapped"), (4, "swapped"), (6, "polarity")})


@pytest.mark.parametrize("seed", range(3))
def test_misplaced_microphones_are_not_called_exchanged(talk, seed):
    moved = MICROPHONES + np.random.default_rng(seed).normal(0.0, 0.04, MICROPHONES.shape)
    found = find(talk, moved)
    assert found is None or not found.changed.any()


def find(samples, microphones=MICROPHONES, *, room=ROOM, noise=1.0):
    """What the search of the wiring finds in six moments, of which the noise is said to be so many times as loud."""
    localizer = SteeredLocalizer(Array(microphones, FS, room, 343.0), SteeredSettings(), np.random.default_rng(0))
    gccs = [correlated(localizer, samples[int(t * FS) :]) for t in (0.5, 0.8, 1.1, 1.4, 1.7, 2.0)]
    moments = Moments(gccs, np.ones(len(microphones), bool), noise * localizer.noise(1).deviation)
    return Rewiring(localizer.health.response, 343.0).find(moments)


def test_a_wrong_first_change_is_overtaken_by_a_better_story():
    """The likeliest single change leads nowhere here; the right story begins with another one."""
    rng = np.random.default_rng(21)
    talk = noisy(heard((3.1, 2.6, 1.6), voice(2.6, FS, rng), FS, reflection=0.7, order=2), 25, rng)
    found = find(turned(talk[:, [0, 1, 6, 3, 4, 5, 2, 7]], 1))
    assert found is not None
    assert found.certain
    assert found.order.tolist() == [0, 1, 6, 3, 4, 5, 2, 7]
    assert np.flatnonzero(found.sign < 0.0).tolist() == [1]


def test_a_wrong_exchange_that_explains_a_little_is_not_believed():
    """One channel is late and one turned over, in a live room: an exchange of a healthy one explains a part of it."""
    rng = np.random.default_rng(9)
    place = [*rng.uniform(0.8, 3.8, 2), rng.uniform(1.2, 1.7)]
    talk = heard(place, voice(2.6, FS, rng), FS, reflection=0.85, order=3)
    rng.uniform()
    found = find(turned(late(noisy(talk, 10.8, rng), 2, 57), 4), noise=0.95)
    assert found is not None
    assert found.changed.any()  # were nothing found, nothing would be tried here
    assert 120.0 < found.gain < 150.0
    assert not found.certain


def test_a_healthy_ring_that_its_mirror_image_resembles_is_not_called_counted_backwards():
    """Some pairs' lags fit the mirror image better, to within 5 cm; none of its places fits them exactly."""
    room = np.array([5.8, 5.2, 2.7])
    ring = np.array([[5.65, 3.26], [4.08, 5.05], [0.44, 5.05], [0.15, 1.94], [1.72, 0.15], [5.36, 0.15]])
    six = np.column_stack([ring, [2.47, 2.40, 2.40, 2.48, 2.46, 2.42]])
    rng = np.random.default_rng(3)
    talk = heard((3.96, 1.75, 1.47), voice(2.6, FS, rng), FS, microphones=six, room=room, reflection=0.8, order=3)
    found = find(noisy(talk, 20, rng), six, room=room)
    assert found is None or not found.changed.any()


@pytest.mark.parametrize(("clear", "faults"), [(False, 0), (True, 8)])
def test_of_several_orders_alike_a_microphone_is_named_only_where_they_are_clear(talk, monkeypatch, clear, faults):
    moved = Remedy(np.roll(np.arange(8), 1), np.ones(8), np.zeros(8), 200.0, clear=clear, certain=False)
    monkeypatch.setattr(Rewiring, "find", lambda self, heard: moved)
    last = localize(talk[: 2 * FS])[-5:]
    assert [len(one.positions) for one in last] == [0] * 5
    assert [len(one.faults) for one in last] == [faults] * 5
    assert not any(fault.corrected for one in last for fault in one.faults)


def test_nobody_scores_high_while_the_channels_contradict_each_other_and_it_is_said_once(talk, monkeypatch):
    possible = Remedy(np.roll(np.arange(8), 1), np.ones(8), np.zeros(8), 100.0, 0.3, clear=False, certain=False)
    monkeypatch.setattr(Rewiring, "find", lambda self, heard: possible)
    decisions = localize(talk, settings=SteeredSettings(min_score=0.0))
    said = [k for k, one in enumerate(decisions) if CONTRADICTED in one.notices]
    assert len(said) == 1
    before, after = decisions[: said[0]], decisions[said[0] + 1 :]
    assert max(score for one in before for score in one.scores) > 0.5
    assert 0.1 < max(score for one in after for score in one.scores) <= ORDERED


def test_channels_that_are_left_out_contradict_nobody_where_one_may_be_of_wrong_polarity():
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM, 343.0), SteeredSettings(), np.random.default_rng(0))
    health = localizer.health
    assert health.trust == 1.0
    health.possible = turned_over((2,), 8)
    assert health.trust == CHANGED
    health.doubted[2] = True
    assert health.trust == 1.0
    health.possible = Remedy(np.roll(np.arange(8), 1), np.ones(8), np.zeros(8))
    assert health.trust == ORDERED


def test_one_late_and_one_of_wrong_polarity_of_six_are_told_together():
    """The likeliest change is an exchange of the late channel; a delay in its place explains more."""
    rng = np.random.default_rng(34)
    six = MICROPHONES[[0, 2, 4, 6, 1, 5]]
    place = [*rng.uniform(0.8, 3.8, 2), rng.uniform(1.2, 1.7)]
    talk = noisy(heard(place, voice(2.6, FS, rng), FS, microphones=six, reflection=0.6, order=2), 25, rng)
    found = find(turned(late(talk, 5, 32), 2), six)
    assert found is not None
    assert found.certain
    assert found.order.tolist() == list(range(6))
    assert np.flatnonzero(found.sign < 0.0).tolist() == [2]
    assert np.flatnonzero(found.delay).tolist() == [5]
    assert found.delay[5] == pytest.approx(32 / FS, abs=1e-4)


def test_a_mirror_image_that_is_nearly_the_ring_is_not_told():
    """Microphones 2 cm elsewhere made such a ring fit its mirror image better; the ring itself is healthy."""
    room = np.array([5.8, 5.2, 2.7])
    ring = np.array([[5.65, 3.27], [4.06, 5.01], [0.44, 5.05], [0.17, 1.96], [1.71, 0.14], [5.36, 0.14]])
    six = np.column_stack([ring, [2.45, 2.42, 2.39, 2.48, 2.44, 2.43]])
    localizer = SteeredLocalizer(Array(six, FS, room, 343.0), SteeredSettings(), np.random.default_rng(0))
    mirrored = [1, 0, 5, 4, 3, 2]
    assert not any(one.order.tolist() == mirrored for one in localizer.health.rewiring.changes)
    assert any(one.tolist() == mirrored for one in localizer.health.rewiring.twins)


def test_of_six_healthy_microphones_five_are_always_used():
    """Four agree on some place although all are healthy: in this live room two were left out at times."""
    rng = np.random.default_rng(5)
    place = [*rng.uniform(0.8, 3.8, 2), rng.uniform(1.2, 1.7)]
    six = MICROPHONES[[0, 2, 4, 6, 1, 5]]
    talk = heard(place, voice(2.2, FS, rng), FS, microphones=six, reflection=0.85, order=3)
    localizer = SteeredLocalizer(Array(six, FS, ROOM, 343.0), SteeredSettings(), np.random.default_rng(0))
    samples = noisy(talk, 20, rng)
    out = [localizer.health.out.sum() for _ in localizer.localize([Block(samples)])]
    assert max(out) == 1  # were none doubted, nothing would be tried here
    assert localizer.health.faults == ()


def test_with_one_of_six_left_out_for_good_no_other_is_doubted():
    rng = np.random.default_rng(5)
    place = [*rng.uniform(0.8, 3.8, 2), rng.uniform(1.2, 1.7)]
    six = MICROPHONES[[0, 2, 4, 6, 1, 5]]
    talk = heard(place, voice(2.2, FS, rng), FS, microphones=six, reflection=0.85, order=3)
    wiring = Wiring(np.arange(6), np.ones(6), np.zeros(6), np.arange(6) != 5)
    localizer = SteeredLocalizer(Array(six, FS, ROOM, 343.0, wiring), SteeredSettings(), np.random.default_rng(0))
    samples = noisy(talk, 20, rng)
    assert {int(localizer.health.out.sum()) for _ in localizer.localize([Block(samples)])} == {1}


def correlated(localizer, samples):
    size = localizer.band.size
    return localizer.correlator.gcc(localizer.correlator.whitened(samples[:size].T * correlation.hann(size)))


def test_an_exchange_that_hardly_changes_the_ways_is_not_told(talk):
    """Half way between two microphones, the sound is the same when they are exchanged."""
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM, 343.0), SteeredSettings(), np.random.default_rng(0))
    rewiring = Rewiring(localizer.health.response, 343.0)
    order = np.arange(8)
    order[[0, 1]] = 1, 0
    exchange = Remedy(order, np.ones(8), np.zeros(8))
    middle = MICROPHONES[:2].mean(axis=0)
    assert not rewiring._told(exchange, middle[None])
    assert rewiring._told(exchange, MICROPHONES[:1])
    assert rewiring._told(turned_over((0,), 8), middle[None])


def test_a_ring_that_looks_like_itself_when_turned_is_not_called_moved_on():
    angle = np.arange(8) * np.pi / 4
    ring = np.column_stack([2.5 + 2.0 * np.cos(angle), 2.5 + 2.0 * np.sin(angle), np.full(8, 2.4)])
    room = np.array([5.0, 5.0, 3.0])
    localizer = SteeredLocalizer(Array(ring, FS, room, 343.0), SteeredSettings(), np.random.default_rng(0))
    rewiring = Rewiring(localizer.health.response, 343.0)
    assert len(rewiring.twins) == 15  # seven turns and eight mirrors
    assert not any((one.order == np.roll(np.arange(8), k)).all() for one in rewiring.changes for k in range(1, 8))


def test_more_decisions_a_second_make_no_more_evidence_about_the_channels(talk):
    moved = np.clip(MICROPHONES + 0.03 * np.random.default_rng(2).standard_normal((8, 3)), 0.05, ROOM - 0.05)
    for rate in (10, 50):
        decisions = localize(talk[: round(2.3 * FS)], moved, SteeredSettings(rate=rate, lookahead=0.0))
        said = [(decision.time, notice) for decision in decisions for notice in decision.notices]
        assert said == [(pytest.approx(2.0), UNSETTLED.format(1))]
