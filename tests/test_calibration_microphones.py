"""Microphone positions and clocks, from a voice that moves."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
import soundfile
from click.testing import CliRunner
from localization_rooms import MICROPHONES, heard, noisy, voice

from avcli.calibration import bundle, camera, echoes, microphones
from avcli.commands.avcalib import main
from avcli.commands.avdetect_audio import main as detect_audio
from avcli.formats.experiment import Config, ConfigError
from avcli.formats.records import Identified
from avcli.localization.survey import Listening

SPEED = 343.0


def walk(seconds, rng):
    """A winding walk through a room of 6 x 5 x 3 m: times (s) and mouths (m)."""
    t = np.arange(0, seconds, 0.1)
    a, b = rng.uniform(0, 6, 2)
    return t, np.stack([3 + 2.2 * np.sin(0.41 * t + a), 2.5 + 1.8 * np.sin(0.53 * t + b), 1.6 + 0.03 * np.sin(t)], -1)


def array(rng, count=6):
    """Microphones along the walls of that room, (count, 3) m."""
    angle = 2 * np.pi * np.arange(count) / count
    x, y = 3 + 2.9 * np.cos(angle), 2.5 + 2.4 * np.sin(angle)
    return np.stack([x, y, rng.uniform(1.0, 2.5, count)], -1)


@dataclass
class Said:
    """What a survey would say."""

    times: np.ndarray
    places: np.ndarray
    delays: np.ndarray
    first: np.ndarray
    second: np.ndarray
    echoes: None = None


def said(true, t, path, rng, *, late=0.0, drift=0.0, noise=2e-5, offset=0.0, wrong=0.15):
    """Delays of windows every 0.25 s; the sound's clock lags the picture's by `offset` s, and channels are late."""
    first, second = np.triu_indices(len(true), 1)
    times = np.arange(1.0, t[-1] - 2.0, 0.25)
    where = np.stack([np.interp(times + offset, t, path[:, i]) for i in range(3)], -1)
    travel = np.linalg.norm(where[:, None] - true, axis=2) / SPEED
    ahead = np.stack([np.interp(times + offset + 0.05, t, path[:, i]) for i in range(3)], -1)
    rate = (np.linalg.norm(ahead[:, None] - true, axis=2) / SPEED - travel) / 0.05
    early = travel.mean(1, keepdims=True) - 0.5 * (travel[:, first] + travel[:, second])
    delays = travel[:, first] - travel[:, second] + early * (rate[:, first] - rate[:, second])
    behind = late + drift * times[:, None] + noise * rng.standard_normal(travel.shape)
    delays = delays + behind[:, first] - behind[:, second]
    delays = np.where(rng.random(delays.shape) < wrong, rng.uniform(-0.01, 0.01, delays.shape), delays)
    rough = where + rng.normal(0, 0.05, where.shape)
    return Said(times + travel.mean(1), rough, delays[..., None], first, second)


def measured(heard, given, way=None, **known):
    prior = microphones.Prior(given, 0.04, SPEED, 2.0, *np.zeros((2, len(given)), bool), np.array([6.0, 5.0, 3.0]))
    return microphones.measure(heard, lambda *_: heard, prior, way, **known)


def test_stated_uncertainty_is_true_over_many_rooms():
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        true = array(rng)
        given = true + rng.normal(0, 0.04, true.shape)
        priors = bundle.Priors(delay_s=1e-4, drift=1e-6)
        late = rng.normal(0, 1e-4, 6)
        speed = rng.normal(0, 2.0)
        heard = said(true, *walk(25, rng), rng, late=late - late.mean())
        fit = bundle.adjust(
            heard.times, heard.places, heard.delays * SPEED / (SPEED + speed), heard.first, heard.second, given, SPEED,
            priors,
        )  # fmt: skip
        error = (fit.positions - true).ravel()
        errors.append(error @ np.linalg.solve(fit.covariance[:18, :18], error) / 18)
    assert 0.6 < np.mean(errors) < 1.4


def test_positions_and_a_channel_of_another_device_are_found():
    rng = np.random.default_rng(1)
    true = array(rng, 8)
    given = true + rng.normal(0, 0.04, true.shape)
    late, drift = np.zeros(8), np.zeros(8)
    late[5], drift[5] = 4e-4, 5e-6
    t, path = walk(40, rng)
    heard = said(true, t, path, rng, late=late, drift=drift, offset=0.24)
    found = measured(heard, given, microphones.tracked(t, path, True, 0.01), is_clock_known=False)
    assert found.refusal is None
    assert found.fit.clock == pytest.approx(0.24, abs=0.01)
    assert np.median(np.linalg.norm(found.fit.positions - true, axis=1)) < 0.015
    away = found.fit.delays - np.median(found.fit.delays)
    assert away[5] == pytest.approx(4e-4, abs=1e-4)
    assert np.abs(np.delete(away, 5)).max() < 1e-4
    assert 1e6 * (found.fit.drifts - np.median(found.fit.drifts))[5] == pytest.approx(5, abs=1)
    assert found.held_out_s < 0.5 * found.held_out_given_s
    assert any("is not where it was measured" in line for line in found.words())


def test_a_voice_in_one_place_tells_nothing_and_says_so():
    rng = np.random.default_rng(2)
    true = array(rng, 8)
    t = np.arange(0, 30, 0.1)
    heard = said(true, t, np.tile([2.0, 2.0, 1.5], (len(t), 1)), rng)
    found = measured(heard, true + rng.normal(0, 0.04, true.shape))
    assert "cannot tell where the microphones are" in found.refusal
    assert np.median(found.fit.shape_sd) > 0.02


def test_a_voice_that_is_elsewhere_than_said_is_refused_with_that_reason():
    rng = np.random.default_rng(3)
    true, (t, path) = array(rng), walk(40, rng)
    mirrored = path * [-1, 1, 1] + [6, 0, 0]
    sound = said(true, t, path, rng)
    found = measured(sound, true, microphones.tracked(t, mirrored, True, 0.05))
    assert "does not come from where the voice is said to be" in found.refusal
    with pytest.raises(ValueError, match="nothing is heard at the times of the places"):
        measured(sound, true, microphones.tracked(t + 1000, path, True, 0.05))


def test_a_microphone_that_is_not_heard_does_not_agree_with_its_place():
    rng = np.random.default_rng(4)
    true, (t, path) = array(rng), walk(40, rng)
    sound = said(true, t, path, rng)
    sound.delays[:, (sound.first == 2) | (sound.second == 2)] = np.nan
    found = measured(sound, true)
    assert found.untold.tolist() == [False, False, True, False, False, False]
    assert "microphone 3: the sound does not tell where it is; its position stays as it was" in found.words()


def test_too_little_is_refused():
    rng = np.random.default_rng(3)
    true = array(rng)
    t, path = walk(40, rng)
    heard = said(true, t, path, rng)
    few = Said(heard.times[:5], heard.places[:5], heard.delays[:5], heard.first, heard.second)
    with pytest.raises(ValueError, match="speech or claps"):
        measured(few, true)
    with pytest.raises(ValueError, match="do not overlap"):
        measured(heard, true, microphones.tracked(t + 500, path, True, 0.05), is_clock_known=False)


@pytest.fixture(scope="module")
def recording():
    """A voice for 0.75 s at each of 16 places, at 16 kHz: samples (n, 8), and the places as --places takes them."""
    rng, fs = np.random.default_rng(4), 16000
    parts, lines = [], []
    for number in range(16):
        place = np.array([*rng.uniform(0.6, 4.0, 2), rng.uniform(1.2, 1.7)])
        parts.append(heard(place, voice(0.75, fs, rng), fs, reflection=0.5, order=1))
        lines.append(f"{0.75 * number + 0.05},{0.75 * number + 0.7},{place[0]},{place[1]},{place[2]}")
    return noisy(np.concatenate(parts), 30, rng), fs, "\n".join(["# begin,end,x,y,z", *lines])


def test_a_survey_finds_late_turned_and_exchanged_channels(recording):
    samples, fs, _ = recording
    faulty = samples.copy()
    faulty[:, 1] *= -1
    faulty[:, [2, 3]] = faulty[:, [3, 2]]
    faulty[:, 6] = np.roll(faulty[:, 6], 80)
    listening = Listening(lambda: [(0.0, faulty, fs)], MICROPHONES, np.array([0.1, 0.1, 0.8]), [4.5, 4.5, 2.0], SPEED)
    channels = listening.channels
    assert channels.order.tolist() == [0, 1, 3, 2, 4, 5, 6, 7]
    assert channels.sign.tolist() == [1, -1, 1, 1, 1, 1, 1, 1]
    assert channels.delay[6] == pytest.approx(0.005, abs=3e-4)
    assert np.count_nonzero(channels.delay) == 1
    assert channels.usable.all()
    told = {str(fault) for fault in channels.faults()}
    assert any("channel 2 has the wrong polarity" in one for one in told)
    assert any("channel 4 carries the sound of microphone 3" in one for one in told)


def test_an_exchange_that_the_places_of_the_voice_bend_to_is_compared_the_other_way_round():
    """Six seconds in a ring whose places are 5 cm off: without that comparison no exchange is found."""
    rng, fs, room = np.random.default_rng(12), 16000, np.array([5.6, 6.2, 2.9])
    angle = np.arange(8) * np.pi / 4 + 0.2
    level = np.clip(1.35 * np.column_stack([np.cos(angle), np.sin(angle)]), -1.0, 1.0)
    true = np.column_stack([room[:2] / 2 + (room[:2] / 2 - 0.15) * level, rng.uniform(2.2, 2.5, 8)])
    places = (np.array([*rng.uniform(0.7, room[:2] - 0.7), 1.6]) for _ in range(12))
    samples = np.concatenate([
        heard(at, voice(0.5, fs, rng), fs, microphones=true, room=room, reflection=0.7, order=1) for at in places
    ])  # fmt: skip
    samples = noisy(samples, 20, rng)
    given = true + rng.normal(0.0, 0.05, true.shape)
    order = [0, 1, 3, 2, 4, 5, 6, 7]
    low, high = np.array([0.1, 0.1, 0.8]), np.array([*(room[:2] - 0.1), 2.0])
    channels = Listening(lambda: [(0.0, samples[:, order], fs)], given, low, high, SPEED).channels
    assert channels.order.tolist() == order


def test_a_channel_that_is_not_a_number_is_left_out(recording):
    samples, fs, _ = recording
    broken = samples[: 6 * fs].copy()
    broken[:, 5] = np.nan
    channels = Listening(
        lambda: [(0.0, broken, fs)], MICROPHONES, np.array([0.1, 0.1, 0.8]), [4.5, 4.5, 2.0], SPEED
    ).channels
    assert channels.usable.tolist() == [True] * 5 + [False] + [True] * 2
    assert channels.order.tolist() == list(range(8))
    assert any("channel 6" in str(fault) for fault in channels.faults())


@dataclass
class Heard:
    """What a survey would hear of echoes."""

    heard: np.ndarray
    step: float
    expected: np.ndarray
    windows: np.ndarray

    def part(self, rows):
        return Heard(self.heard[rows], self.step, self.expected[rows], self.windows[rows])


def echoed(seen, true, t, path, room, loud, rng):
    """Correlations about echoes that are expected some centimetres beside their places, `loud` (6,) times noise."""
    step, lags = 1e-5, np.arange(-100, 101) * 1e-5
    where = np.stack([np.interp(seen.times, t, path[:, i]) for i in range(3)], -1)
    for _ in range(3):  # times are those of hearing
        travel = np.linalg.norm(where[:, None] - true, axis=2).mean(axis=1) / SPEED
        where = np.stack([np.interp(seen.times - travel, t, path[:, i]) for i in range(3)], -1)
    images = echoes.surfaces(room).mirrored(true, echoes.surfaces(room).position)
    far = np.linalg.norm(where[:, None, None] - images, axis=3) / SPEED
    late = far - np.linalg.norm(where[:, None] - true, axis=2).mean(axis=1)[:, None, None] / SPEED
    expected = late + rng.normal(0.0, 1e-4, late.shape[1:])
    away = late[..., None] - expected[..., None] - lags
    noise = np.fft.irfft(np.fft.rfft(rng.standard_normal(away.shape)) * (np.arange(101) < 20), 201)
    noise /= noise.std()
    return Heard(noise - np.array(loud)[:, None] * np.sinc(away * 1e4), step, expected, np.full(len(late), 7))


def test_echoes_tell_what_one_height_of_the_voice_does_not():
    rng = np.random.default_rng(7)
    room, true = np.array([6.0, 5.0, 3.0]), array(np.random.default_rng(7), 8)
    given = true + rng.normal(0, 0.04, true.shape)
    t, path = walk(40, rng)
    seen = said(true, t, path, rng)
    known = bundle.Priors(delay_s=1e-5, drift=1e-7)

    def errors(surfaces=None, heard=None):
        fit = bundle.adjust(
            seen.times, seen.places, seen.delays, seen.first, seen.second, given, SPEED, known, surfaces=surfaces,
            echoes=heard,
        )  # fmt: skip
        return fit, np.median(np.linalg.norm(fit.positions - true, axis=1))

    without = errors()[1]
    heard = echoed(seen, true, t, path, room, [2, 2, 2, 2, 2, 2], rng)
    fit, clear = errors(echoes.surfaces(room), heard)
    assert clear < 0.01 < without
    assert (fit.clear > 0).all()
    assert np.median(fit.shape_sd) < 0.007
    # A ceiling 5 cm from where it is said to be does not harm the shape; then the place is as it was given.
    fit, _ = errors(echoes.surfaces(room + np.array([0.0, 0.0, 0.05])), heard)
    off = fit.positions - true
    assert np.median(np.linalg.norm(off - off.mean(axis=0), axis=1)) < 0.01
    assert abs(off[:, 2].mean()) < abs((given - true)[:, 2].mean()) + 0.005
    # Surfaces that give nothing back are not heard.
    fit, _ = errors(echoes.surfaces(room), echoed(seen, true, t, path, room, [2, 2, 0, 0, 2, 2], rng))
    assert (fit.clear > 0).mean(axis=0)[[2, 3]].max() < 0.2
    assert (fit.clear > 0).mean(axis=0)[[0, 1, 4, 5]].min() > 0.8


def experiment(tmp_path, samples, fs, positions):
    (tmp_path / "audio" / "wav").mkdir(parents=True)
    soundfile.write(tmp_path / "audio" / "wav" / "multichannel_audio_0.0000000000.wav", samples, fs)
    raw = {
        "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]},
        "microphone_config": {"audio_sample_rate_hz": fs, "mic_positions_m": positions.tolist()},
    }
    (tmp_path / "config.json").write_text(json.dumps(raw))
    return raw


def test_the_command_writes_a_corrected_config(recording, tmp_path):
    samples, fs, places = recording
    given = MICROPHONES + np.random.default_rng(5).normal(0, 0.04, MICROPHONES.shape)
    raw = experiment(tmp_path, samples, fs, given)
    (tmp_path / "places.csv").write_text(places)
    new = tmp_path / "new.json"
    result = CliRunner().invoke(
        main, ["microphones", "-C", str(tmp_path), "--places", str(tmp_path / "places.csv"), "-o", str(new), "--html",
         str(tmp_path / "page.html")],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    page = (tmp_path / "page.html").read_text()
    assert "The positions are measured, in the room too." in page
    assert page.count('<ellipse class="light"') == 8
    assert "nan" not in page.lower()
    written = json.loads(new.read_text())
    assert written["room_config"] == raw["room_config"]
    found = np.array(written["microphone_config"]["mic_positions_m"])
    assert np.median(np.linalg.norm(found - MICROPHONES, axis=1)) < 0.02
    assert written["microphone_config"]["calibration"]["sd_m"] < 0.04
    assert json.loads((tmp_path / "config.json").read_text()) == raw


def test_what_is_wrong_with_channels_goes_into_config_and_detection_puts_it_right(recording, tmp_path):
    samples, fs, places = recording
    faulty = samples * np.where(np.arange(8) == 1, -1.0, 1.0)
    faulty[:, 6] = np.roll(faulty[:, 6], 80)
    experiment(tmp_path, faulty, fs, MICROPHONES)
    (tmp_path / "places.csv").write_text(places)
    call = ["microphones", "-C", str(tmp_path), "--places", str(tmp_path / "places.csv"), "--write"]
    result = CliRunner().invoke(main, call)
    assert result.exit_code == 0, result.output
    channels = json.loads((tmp_path / "config.json").read_text())["microphone_config"]["channels"]
    assert [one["channel"] for one in channels] == list(range(1, 9))
    assert [one["polarity"] for one in channels] == [1, -1, 1, 1, 1, 1, 1, 1]
    assert channels[6]["delay_s"] == pytest.approx(0.005, abs=1e-4)
    assert sum(one["delay_s"] != 0 for one in channels) == 1
    assert all(one["usable"] for one in channels)
    wav = tmp_path / "beginning.wav"
    soundfile.write(wav, faulty[: 2 * fs], fs)
    result = CliRunner().invoke(detect_audio, ["-C", str(tmp_path), str(wav)])
    assert result.exit_code == 0, result.output
    assert "channel" not in result.stderr
    first = json.loads(result.stdout.splitlines()[0])
    assert {(fault["channel"], fault["fault"]) for fault in first["channel_faults"]} == {(2, "polarity"), (7, "late")}


@pytest.mark.parametrize(
    ("channels", "words"), [([{"channel": 1}], "a list of 8"), ([{"channel": 1}] * 8, "each channel from 1 to 8 once")]
)
def test_channels_in_config_that_make_no_sense_are_refused(channels, words):
    raw = {"microphone_config": {"mic_positions_m": MICROPHONES.tolist(), "channels": channels}}
    with pytest.raises(ConfigError, match=words):
        _ = Config(raw).microphones


@pytest.mark.parametrize(
    ("scale", "code", "words"),
    [([1, 1, -1], 3, "microphones 1, 2, 3, 4, 5, 6, 7, 8 are outside the room"), ([1000] * 3, 1, "in metres?")],
)
def test_microphones_that_cannot_be_there_are_named(recording, tmp_path, scale, code, words):
    samples, fs, _ = recording
    experiment(tmp_path, np.tile(samples[: round(0.75 * fs)], (2, 1)), fs, MICROPHONES * scale)
    result = CliRunner().invoke(main, ["microphones", "-C", str(tmp_path)])
    assert result.exit_code == code, result.output
    assert words in result.output


def test_the_command_changes_nothing_where_the_recording_cannot_tell(recording, tmp_path):
    samples, fs, _ = recording
    raw = experiment(tmp_path, np.tile(samples[: round(0.75 * fs)], (8, 1)), fs, MICROPHONES)
    new = tmp_path / "new.json"
    result = CliRunner().invoke(main, ["microphones", "-C", str(tmp_path), "--write", "-o", str(new)])
    assert result.exit_code == 3, result.output
    assert "record some minutes of speech or claps" in result.output
    assert not new.exists()
    assert json.loads((tmp_path / "config.json").read_text()) == raw


def test_places_are_read_and_bad_lines_named():
    way = microphones.measured_places("# claps\n1,2,0.5,0.6,1.2\n\n3,4.5,2,2,1.5\n", "p.csv")
    assert way.times[[0, -1]].tolist() == [1.0, 4.5]
    assert way.places[0].tolist() == [0.5, 0.6, 1.2]
    assert len(np.unique(way.errors)) == 2
    for bad in ("1,2,3", "2,1,0,0,0", "1,2,0,0,x", "1,2,0,0,nan", "1,3,0,0,1\n2,4,0,0,1"):
        with pytest.raises(ValueError, match=r"p.csv:\d: expected begin,end"):
            microphones.measured_places(bad, "p.csv")
    with pytest.raises(ValueError, match="no places"):
        microphones.measured_places("# nothing\n", "p.csv")


def person(timestamp, position, mouth=None):
    mouths = None if mouth is None else np.array([mouth])
    known = {} if mouths is None else {"mouths": mouths}
    return Identified(timestamp, np.array([1]), np.array([position], float), **known)


def test_a_mouth_is_where_the_record_says_or_ahead_of_the_walker():
    stated = [person(t, [t, 1.0, 0.0], [t + 0.2, 1.1, 1.5]) for t in (0.2, 0.0, 0.1)]
    times, path, known = microphones.mouths(stated, 1.7)
    assert known
    assert times.tolist() == [0.0, 0.1, 0.2]
    assert np.allclose(path, [[0.2, 1.1, 1.5], [0.3, 1.1, 1.5], [0.4, 1.1, 1.5]])
    walker = [person(t, [t, 1.0, 0.0]) for t in np.arange(0, 3, 0.1)]  # 1 m/s along x
    times, path, known = microphones.mouths(walker, 1.7)
    assert not known
    assert np.allclose(path, np.stack([times + microphones.MOUTH_AHEAD_M, 0 * times + 1, 0 * times + 1.7], -1))


def test_a_long_track_is_smoothed_as_a_short_one_is():
    t, path = walk(130, np.random.default_rng(5))
    level, step = microphones._smooth(t, path[:, :2])
    wanted = microphones._lines(t, t, path[:, :2])
    np.testing.assert_allclose(level, wanted[0], atol=1e-9)
    np.testing.assert_allclose(step, wanted[1], atol=1e-9)


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
    (tmp_path / "multichannel_audio_0.0000000000.wav").rename(tmp_path / "multichannel_audio_10.0000000000.wav")
    assert [start for start, _, _ in microphones.sounds([], tmp_path)] == [7.5, 10.0]  # as no list of names has them
    with pytest.raises(ValueError, match="no sound in"):
        list(microphones.sounds([], tmp_path / "empty"))


def test_found_positions_go_into_a_config_and_all_else_stays():
    raw = {
        "session_id": "a",
        "microphone_config": {
            "audio_bit_depth": 24,
            "mic_positions_m": [{"object_id": 1, "position": [0, 0, 0]}, [1, 1, 1]],
        },
    }
    raw["microphone_config"]["channels"] = [{"channel": 2}, {"channel": 1}]  # of a measurement before
    assert camera.with_microphones(raw, [[0.1, 0.2, 0.3], [1.1, 1.2, 1.3]], 0.004, None) == {
        "session_id": "a",
        "microphone_config": {
            "audio_bit_depth": 24,
            "mic_positions_m": [{"object_id": 1, "position": [0.1, 0.2, 0.3]}, [1.1, 1.2, 1.3]],
            "calibration": {"sd_m": 0.004},
        },
    }
    assert raw["microphone_config"]["mic_positions_m"][1] == [1, 1, 1]
