"""The steered localizer on simulated streams: what it finds, what it must not find, and what it survives."""

from dataclasses import replace

import numpy as np
import pytest
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.formats.records import as_record, detections
from avcli.localization.array import Array
from avcli.localization.correlation import hann
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block
from avcli.localization.windows import Band, Correlator, Heard, together

FS = 16000
PLACE = np.array([1.4, 3.1, 1.55])


def localize(samples, *, microphones=MICROPHONES, fs=FS, block=4000, begin=0, tail=0.0, speed=343.0, **options):
    array = Array(np.asarray(microphones), fs, ROOM, speed)
    localizer = SteeredLocalizer(array, SteeredSettings(**options), np.random.default_rng(0))
    blocks = (Block(samples[i : i + block], tail) for i in range(0, len(samples), block))
    return list(localizer.localize(blocks, begin))


def errors(decisions, place=PLACE):
    """Distances in x and y of all that was found, (n,)."""
    positions = np.concatenate([d.positions for d in decisions])
    return np.hypot(*(positions - place)[:, :2].T)


@pytest.fixture(scope="module")
def speech():
    return voice(1.6, FS, np.random.default_rng(11))


@pytest.fixture(scope="module")
def talk(speech):
    """1.6 s of one talker in a room that echoes a little, with noise 30 dB below."""
    samples = heard(PLACE, speech, FS, reflection=0.6, order=2)
    return noisy(samples, 30, np.random.default_rng(12))


@pytest.fixture(scope="module")
def found(talk):
    return localize(talk)


# --- what it finds ----------------------------------------------------------------------------------------------------


def test_microphones_too_far_apart_for_the_window_are_refused():
    far = MICROPHONES + np.array([[200.0, 0.0, 0.0]]) * (np.arange(len(MICROPHONES)) == 3)[:, None]
    with pytest.raises(ValueError, match=r"microphones \d and \d are \d+\.\d m apart"):
        SteeredLocalizer(Array(far, FS, ROOM), SteeredSettings(), np.random.default_rng(0))


def test_a_talker_is_found_in_every_step_and_nobody_else(found):
    assert [d.time for d in found] == pytest.approx(np.arange(17) / 10)
    spoken = found[1:15]
    assert np.mean([len(d.positions) == 1 for d in spoken]) >= 0.9
    assert np.median(errors(spoken)) < 0.01
    assert errors(spoken).max() < 0.5
    heights = np.concatenate([d.positions for d in spoken])[:, 2]
    assert np.median(np.abs(heights - PLACE[2])) < 0.03


def test_covariances_are_positive_and_scores_probabilities(found):
    for d in found:
        for covariance in d.covariances:
            np.testing.assert_array_equal(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance)[0] > 1e-7
        assert ((d.scores >= 0.5) & (d.scores <= 1.0)).all()


def test_the_same_bytes_twice_and_in_blocks_of_any_size(talk, found):
    for block in (1000, 100_000):
        again = localize(talk, block=block)
        for one, two in zip(found, again, strict=True):
            np.testing.assert_array_equal(one.positions, two.positions)
            np.testing.assert_array_equal(one.covariances, two.covariances)
            np.testing.assert_array_equal(one.scores, two.scores)


@pytest.mark.parametrize("fs", [8000, 22050, 48000])
def test_any_sample_rate(fs):
    samples = noisy(heard(PLACE, voice(0.8, fs, np.random.default_rng(1)), fs), 30, np.random.default_rng(2))
    assert np.median(errors(localize(samples, fs=fs)[1:7])) < 0.03


@pytest.mark.parametrize("rate", [4.0, 25.0])
def test_any_decision_rate(talk, rate):
    decisions = localize(talk, rate=rate)
    assert [d.time for d in decisions] == pytest.approx(np.arange(len(decisions)) / rate)
    assert len(decisions) == int(1.6 * rate) + 1
    assert np.median(errors(decisions)) < 0.02


@pytest.mark.parametrize(("lookahead", "latency"), [(0.3, 0.52), (0.0, 0.22)])
def test_a_decision_needs_no_sample_that_comes_after_its_latency(talk, lookahead, latency):
    array = Array(MICROPHONES, FS, ROOM)
    localizer = SteeredLocalizer(array, SteeredSettings(lookahead=lookahead), np.random.default_rng(0))
    assert localizer.latency < latency
    until = round((1.0 + localizer.latency) * FS) + 1
    whole, decided = (localize(samples, lookahead=lookahead) for samples in (talk, talk[:until]))
    np.testing.assert_array_equal(decided[10].positions, whole[10].positions)
    np.testing.assert_array_equal(decided[10].scores, whole[10].scores)


def test_a_stream_that_begins_later_and_a_tail_in_which_nobody_speaks(talk, found):
    later = localize(talk, begin=2 * FS, tail=0.4)
    assert [d.time for d in later] == pytest.approx(np.arange(20, 33) / 10)
    for one, two in zip(found, later, strict=False):
        assert one.positions == pytest.approx(two.positions, abs=1e-3)


def test_a_walker_is_where_he_was_when_he_spoke():
    rng = np.random.default_rng(4)
    sound, step = voice(1.6, FS, rng), FS // 50
    path = np.array([1.0, 2.0, 1.6]) + np.arange(82)[:, None] / 50 * [1.0, 0.0, 0.0]
    fade = np.hanning(2 * step + 1)[:-1]
    samples = np.zeros((len(sound), 8))
    padded = np.concatenate([np.zeros(step), sound, np.zeros(2 * step)])
    for k in range(len(sound) // step + 1):
        piece = np.zeros(len(sound) + 3 * step)
        piece[k * step : (k + 2) * step] = padded[k * step : (k + 2) * step] * fade
        first, last = max(k * step, step), min((k + 2) * step + FS // 10, len(sound) + step)
        samples[first - step : last - step] += heard(path[k], piece[k * step :][: FS // 4], FS)[
            first - k * step : last - k * step
        ]
    decisions = localize(noisy(samples, 30, rng))[2:14]
    along = np.concatenate([(d.positions - [1.0 + d.time, 2.0, 1.6]) for d in decisions])[:, 0]
    assert len(along) >= 10
    assert abs(np.median(along)) < 0.02
    assert np.abs(along).max() < 0.15


def test_a_walker_whose_recording_begins_or_ends_with_him_is_where_the_sound_was():
    """The first and the last windows are half empty, and what they hold was said after, or before, their middle."""
    rng = np.random.default_rng(17)
    syllables = 1.0 + 0.8 * np.sin(2.0 * np.pi * 3.7 * np.arange(FS) / FS)  # noise that stays as loud is a machine
    sound, step = syllables * rng.standard_normal(FS), FS // 100
    path = np.array([1.0, 2.0, 1.6]) + np.arange(102)[:, None] / 100 * [1.5, 0.0, 0.0]
    samples = np.zeros((FS, 8))
    for k in range(100):
        piece = np.zeros(FS)
        piece[k * step : (k + 1) * step] = sound[k * step : (k + 1) * step]
        samples += heard(path[k], piece, FS)
    decisions = localize(noisy(samples, 30, rng))
    along = np.array([d.positions[0, 0] - 1.0 - 1.5 * d.time for d in decisions])
    assert np.abs(along).max() < 0.06


def test_a_machine_is_told_from_a_voice_before_it_is_named():
    """The score of a machine falls, and the record says why: a doubtful place has a low score by itself."""
    rng = np.random.default_rng(23)
    hiss = rng.standard_normal(2 * FS)
    syllables = 1.0 + 0.8 * np.sin(2.0 * np.pi * 3.7 * np.arange(len(hiss)) / FS)
    for sound, low, high in ((hiss, 0.7, 1.0), (hiss * syllables, 0.0, 0.3)):
        decisions = localize(noisy(heard(PLACE, sound, FS), 30, rng), min_score=0.0)
        told = [one.machines[0] for one in decisions[15:19]]
        assert low <= min(told) <= max(told) <= high
        record = as_record(decisions[16].detections())
        assert record["objects"][0]["machine"] == decisions[16].machines[0]
        assert record["objects"][0]["score"] <= 1.0 - record["objects"][0]["machine"]
        assert detections(record).machines.tolist() == decisions[16].machines.tolist()


def test_what_rings_on_quietly_where_somebody_begins_or_ends_does_not_count():
    array = Array(MICROPHONES, FS, ROOM)
    correlator = Correlator(array, Band.of(SteeredSettings(), FS), 400, 1.0)
    sound = np.random.default_rng(3).standard_normal((8, correlator.band.size))
    taper = hann(correlator.band.size)

    def counted(*decibels):
        windows = [
            (correlator.correlate(10 ** (db / 20) * sound, taper).correlated, 0.1 * k) for k, db in enumerate(decibels)
        ]
        return np.rint(10 * together(windows, np.zeros(8, bool)).offsets).astype(int).tolist()

    assert counted(-20, 0, -30) == [0, 1]
    assert counted(-30, -60) == [0]
    assert counted(-60) == [0]


def test_two_talkers_at_once():
    rng = np.random.default_rng(5)
    other = np.array([3.4, 1.0, 1.7])
    samples = heard(PLACE, voice(1.6, FS, rng), FS, reflection=0.4, order=2)
    samples += heard(other, voice(1.6, FS, rng), FS, reflection=0.4, order=2)
    decisions = localize(noisy(samples, 30, rng))[1:15]
    hits = [(errors([d], place) < 0.3).any() for d in decisions for place in (PLACE, other)]
    assert np.mean(hits) >= 0.8
    assert max(len(d.positions) for d in decisions) == 2
    alone = localize(noisy(samples, 30, rng), max_speakers=1)
    assert max(len(d.positions) for d in alone) == 1


def test_who_falls_silent_is_not_reported_from_memory():
    rng = np.random.default_rng(15)
    other = np.array([3.4, 1.0, 1.7])
    first, second = voice(1.0, FS, rng), voice(1.2, FS, rng)
    samples = heard(PLACE, np.concatenate([first, np.zeros(len(second))]), FS, reflection=0.4, order=2)
    samples += heard(other, np.concatenate([np.zeros(len(first)), second]), FS, reflection=0.4, order=2)
    decisions = localize(noisy(samples, 30, rng))
    assert all((errors([d]) < 0.3).any() for d in decisions[1:9])
    assert all((errors([d], other) < 0.3).any() for d in decisions[13:21])
    assert not any((errors([d]) < 0.5).any() for d in decisions[14:])


def test_the_mask_keeps_the_frequencies_that_another_talker_has():
    """Of two talkers who share the frequencies between them nothing of the first is left, and all of the second."""
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM, 343.0), SteeredSettings(), np.random.default_rng(0))
    other = np.array([3.4, 1.0, 1.7])
    band, masks = localizer.band, localizer.finder.talkers.masks
    frequencies = np.arange(band.bins.start, band.bins.stop) * FS / band.size
    delays = np.linalg.norm(np.stack([PLACE, other])[:, None] - MICROPHONES, axis=2) / 343.0
    both = np.exp(-2j * np.pi * frequencies * delays[..., None]).astype(np.complex64)
    spectra = np.where(np.arange(len(frequencies)) // 40 % 2, both[0], both[1])[None]
    one = np.ones(1, np.float32)
    pairs, power = np.ones(28, bool), np.ones((1, spectra.shape[2]))
    windows = Heard(np.zeros(0), spectra, one, np.zeros(1), np.zeros(1), 1.0, 8.0, pairs, power)
    explained = masks.coherence(windows, PLACE, np.zeros(3))

    def answers(gccs):
        return localizer.finder.response.response(gccs[0], np.stack([PLACE, other]))

    before = answers(masks.masked(windows, np.zeros_like(explained)))
    after = answers(masks.masked(windows, explained))
    assert min(before) > 0.4
    assert after[0] < 0.15 * before[0]
    assert after[1] > 0.8 * before[1]
    assert not masks.masked(replace(windows, spectra=0 * spectra), explained).any()
    # What stands at the floor of a steady source counts for nothing, and the rest as if there were no more.
    above = replace(windows, above=(np.arange(len(frequencies)) // 40 % 2 == 0)[None].astype(np.float32))
    alone = answers(masks.masked(above, np.zeros_like(explained)))
    assert abs(alone[0]) < 0.15 * before[0]
    assert alone[1] > 1.2 * before[1]
    nothing = replace(windows, above=np.zeros((1, len(frequencies)), np.float32))
    assert not masks.masked(nothing, np.zeros_like(explained)).any()


def test_a_talker_is_heard_again_in_the_pauses_of_another():
    """Who is masked for a fifth of a second is not lost, and comes back at once."""
    rng = np.random.default_rng(16)
    other = np.array([3.4, 1.0, 1.7])
    pauses = np.repeat([1.0, 0.1, 1.0, 0.1, 1.0, 0.1, 1.0, 1.0], FS // 5)
    samples = heard(PLACE, voice(1.6, FS, rng) * pauses, FS, reflection=0.4, order=2)
    samples += heard(other, voice(1.6, FS, rng), FS, reflection=0.4, order=2)
    decisions = localize(noisy(samples, 30, rng))[1:15]
    assert np.mean([(errors([d]) < 0.3).any() for d in decisions]) >= 0.7
    assert np.mean([(errors([d], other) < 0.3).any() for d in decisions]) >= 0.9


def test_who_begins_softly_beside_another_is_found_earlier_by_what_comes_after():
    """At once, the first words of a second talker are too faint; later it is known that somebody is there."""
    rng = np.random.default_rng(17)
    other = np.array([3.4, 1.0, 1.7])
    swells = np.clip(np.arange(round(1.6 * FS)) / FS - 0.4, 0.0, 0.8) ** 2 / 0.64
    samples = heard(PLACE, voice(1.6, FS, rng), FS, reflection=0.7, order=2)
    samples += heard(other, swells * voice(1.6, FS, rng), FS, reflection=0.7, order=2)
    samples = noisy(samples, 20, rng)
    at_once, later = (
        [(errors([d], other) < 0.3).any() for d in localize(samples, lookahead=lookahead)] for lookahead in (0.0, 0.3)
    )
    assert np.argmax(later) < np.argmax(at_once)
    assert sum(later) > sum(at_once)
    assert not any(later[:4])


# --- what it must not find --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [1e-3, 0.7])
def test_a_constant_and_a_rumble_are_nobody(level):
    """What computing left of them is alike in all channels, and was a talker in the middle between them."""
    constant = np.full((FS, 8), level)
    rumble = level * np.sin(2 * np.pi * 5 * np.arange(FS) / FS)[:, None] * np.linspace(0.5, 1, 8)
    assert not any(len(d.positions) for d in localize(constant))
    assert not any(len(d.positions) for d in localize(rumble)[:-2])  # the last windows are narrow, and it leaks


def test_silence_and_the_least_significant_bit_are_nobody():
    rng = np.random.default_rng(6)
    bits = rng.integers(-1, 2, (2 * FS, 8)) / 32768
    for samples in (np.zeros((2 * FS, 8)), bits):
        decisions = localize(samples)
        assert len(decisions) == 21
        assert sum(len(d.positions) for d in decisions) <= 1


def test_noise_alone_is_rarely_somebody():
    rng = np.random.default_rng(7)
    samples = rng.standard_normal((15 * FS, 8))
    samples[: FS // 2] *= 0.1  # so that the gate lets the rest pass
    decisions = localize(samples, min_score=0.0, false_alarm=0.05)
    assert sum(len(d.positions) > 0 for d in decisions) <= 0.15 * len(decisions)
    assert sum(len(d.positions) for d in localize(samples)) <= 1


@pytest.mark.parametrize("frequency", [100, 300, 1000])
def test_a_tone_or_a_hum_is_no_speaker(frequency):
    t = np.arange(2 * FS) / FS
    tone = heard(PLACE, np.sin(2 * np.pi * frequency * t), FS, reflection=0.5, order=2)[FS // 2 :]
    assert sum(len(d.positions) for d in localize(tone)) == 0
    assert sum(len(d.positions) for d in localize(noisy(tone, 40, np.random.default_rng(8)))) == 0


def test_a_click_does_not_mute_the_talker(talk, found):
    samples = talk.copy()
    samples[3000:3004] += 1e3
    decisions = localize(samples)
    late = slice(5, 15)
    assert sum(len(d.positions) for d in decisions[late]) >= sum(len(d.positions) for d in found[late]) - 1


def test_music_from_one_place_is_one_source():
    t = np.arange(2 * FS) / FS
    chord = sum(
        np.sin(2 * np.pi * f * h * t + f) / h * np.exp(-3 * (t % 0.5))
        for f in (220.0, 277.2, 329.6)
        for h in range(1, 12)
    )
    decisions = localize(noisy(heard(PLACE, chord, FS), 40, np.random.default_rng(9)))
    assert (errors(decisions) < 0.5).mean() >= 0.9


# --- what it survives -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-12, -1.0, 1e20])
def test_any_scale_and_polarity(talk, found, scale):
    for one, two in zip(found[:8], localize(talk[:FS] * scale)[:8], strict=True):
        assert two.positions == pytest.approx(one.positions, abs=1e-3)


def test_dc_is_not_heard_but_named_on_each_channel_and_none_is_left_out(talk, found):
    decisions = localize(talk + 0.3)
    for one, two in zip(found[2:15], decisions[2:15], strict=True):
        assert two.positions == pytest.approx(one.positions, abs=0.02)
    assert noticed(decisions) == {f"channel {c + 1} is shifted by a constant (DC)" for c in range(8)}
    assert np.median(errors(decisions)) < 0.02


def noticed(decisions):
    return {notice for d in decisions for notice in d.notices}


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda x: x * (np.arange(8) != 3), "channel 4 is dead"),
        (lambda x: x + 0.3 * (np.arange(8) == 5), "channel 6 is shifted by a constant (DC) and left out"),
        (lambda x: x[:, [0, 1, 2, 2, 4, 5, 6, 7]], "channels 3 and 4 are the same"),
        (lambda x: x * np.where(np.arange(8) == 3, -1, 1), "channel 4"),
        (lambda x: np.column_stack([x[:, :7], np.clip(20 * x[:, 7], -0.5, 0.5)]), "channel 8 is clipped"),
        (lambda x: np.where((np.arange(len(x)) % 4001 == 7)[:, None] & (np.arange(8) == 5), np.nan, x), "channel 6"),
        (lambda x: np.where((np.arange(len(x)) % 4001 == 7)[:, None] & (np.arange(8) == 5), np.inf, x), "channel 6"),
    ],
    ids=["dead", "shifted", "twins", "inverted", "clipped", "nan", "inf"],
)
def test_a_bad_channel_is_named_and_the_talker_still_found(talk, spoil, word):
    decisions = localize(spoil(talk[:FS]))
    assert np.median(errors(decisions)) < 0.02
    clearest = np.array([d.positions[0] for d in decisions if len(d.positions)])
    assert (np.hypot(*(clearest - PLACE)[:, :2].T) < 0.5).mean() >= 0.9
    assert any(word in notice for notice in noticed(decisions)), noticed(decisions)


def test_good_channels_give_no_notice(found):
    assert noticed(found) == set()


def test_everything_clipped_is_named_and_still_heard(talk):
    decisions = localize(np.clip(talk * (20 / np.abs(talk).max()), -1, 1))
    assert np.median(errors(decisions)) < 0.1
    assert len(noticed(decisions)) == 8


def test_shorter_than_a_window_or_empty(talk):
    assert localize(talk[:0]) == []
    decisions = localize(talk[:1000])
    assert [d.time for d in decisions] == [0.0]
    assert len(localize(talk[:1])) == 1


# --- arrays -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("microphones", "limit"),
    [
        (MICROPHONES * [1, 1, 0] + [0, 0, 2.4], 0.02),
        (MICROPHONES[[0, 1, 2, 3, 4, 5, 6, 6]], 0.02),
        (MICROPHONES[[0, 2, 4, 7]], 0.1),
    ],
    ids=["coplanar", "coincident", "four"],
)
def test_other_arrays(speech, microphones, limit):
    rng = np.random.default_rng(13)
    decisions = localize(noisy(heard(PLACE, speech, FS, microphones=microphones), 30, rng), microphones=microphones)
    assert np.median(errors(decisions)) < limit


def test_arrays_that_see_too_little_are_refused():
    with pytest.raises(ValueError, match="needs 4"):
        localize(np.zeros((100, 3)), microphones=MICROPHONES[:3])
    with pytest.raises(ValueError, match="band"):
        localize(np.zeros((100, 8)), band=(7000.0, 7010.0))


@pytest.mark.parametrize(
    "place",
    [(5.3, 2.0, 1.5), (0.05, 0.05, 1.0), (2.386, 2.253, 1.95)],
    ids=["outside", "corner", "below a microphone"],
)
def test_extreme_places_give_finite_answers_inside_the_room(speech, place):
    decisions = localize(noisy(heard(place, speech, FS), 30, np.random.default_rng(14)))
    for d in decisions:
        assert np.isfinite(d.positions).all()
        assert np.isfinite(d.covariances).all()
        assert ((d.positions >= 0) & (d.positions <= ROOM)).all()
    if place[0] > ROOM[0]:
        assert any("outside" in notice for notice in noticed(decisions))
        told = [d for d in decisions if len(d.scores)]
        assert len(told) > 8, "somebody is heard"
        assert max(d.scores[0] for d in told) < 0.9, "it is not where it seems to be"
        assert np.median([d.covariances[0][0, 0] for d in told]) > 0.1, "it may be behind the wall"


def test_a_peak_without_any_response_does_no_harm(talk, found):
    """Known talkers are searched for where they were, and what is there may be nothing at all."""
    localizer = SteeredLocalizer(Array(MICROPHONES, FS, ROOM, 343.0), SteeredSettings(), np.random.default_rng(0))
    talkers = localizer.finder.talkers
    peaks = talkers.peaks

    def with_nothing(*args):
        real = peaks(*args)
        away = np.array([1.5, -1.0, 0.0])
        return [*real, *(replace(one, position=one.position + away, response=0.0, own=100.0) for one in real[:1])]

    talkers.peaks = with_nothing
    decisions = list(localizer.localize([Block(talk)]))
    assert len(decisions) == len(found)
    assert sum((errors([d]) < 0.3).any() for d in decisions) >= sum((errors([d]) < 0.3).any() for d in found) - 1
