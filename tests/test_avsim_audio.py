"""avsim-audio as a user meets it: files, records, pipes and bad input."""

import json
import re
import subprocess

import jsonschema
import numpy as np
import orjson
import pytest
import soundfile
from conftest import BIN, done, refused, run, schema
from localization_rooms import decibels

from avcli.acoustics.images import shoebox_rir
from avcli.acoustics.settings import Settings
from avcli.acoustics.surroundings import surroundings_of
from avcli.formats import media
from avcli.formats.experiment import Config

MICROPHONES = [[0.115, 4.545, 2.493], [2.401, 4.498, 2.385], [0.115, 0.115, 2.489], [2.386, 2.253, 2.489]]
RATE = 16000


@pytest.fixture
def experiment(tmp_path):
    (tmp_path / "config.json").write_text(
        json.dumps(
            {
                "microphone_config": {"audio_sample_rate_hz": RATE, "mic_positions_m": MICROPHONES},
                "room_config": {"room_dimensions_m": [4.66, 4.66, 3.0], "reverberation_time_s": 0.2},
            }
        )
    )
    return tmp_path


def truth(times, *people):
    """Ground truth of people given as functions of time: (position, speaking)."""
    lines = []
    for time in times:
        objects = []
        for identity, person in enumerate(people):
            if (state := person(time)) is not None:
                mouth, speaking = state
                objects.append(
                    {"object_id": identity, "position": [mouth[0], mouth[1], 0.0], "speaking": bool(speaking)}
                )
                objects[-1]["mouth_position"] = list(mouth)
        lines.append(json.dumps({"timestamp": f"{time:.10f}", "objects": objects}))
    return "\n".join(lines) + "\n"


def walk(time):
    return (0.5 + time, 2.33, 1.6), True


TIMES = np.arange(11) / 10


def simulate(experiment, text, *options):
    result = done("avsim-audio", "-C", experiment, *options, stdin=text)
    records = [orjson.loads(line) for line in result.stdout.splitlines()]
    pieces = [media.read_audio(experiment / record["audio"]["path"])[0].T for record in records]
    return records, np.concatenate(pieces, axis=1) if pieces else None, result.stderr


def test_one_file_for_the_scene_and_its_reverberation(experiment):
    records, sound, messages = simulate(experiment, truth(TIMES, walk))
    assert messages == ""
    assert records[0]["timestamp"] == "0.0000000000"
    assert records[0]["audio"] == {
        "path": "audio/wav/multichannel_audio_0.0000000000.wav",
        "start_sample": 0,
        "num_samples": round(1.2 * RATE),
        "tail_samples": round(0.2 * RATE),
        "sample_rate_hz": RATE,
        "num_channels": 4,
    }
    assert sound.shape == (4, round(1.2 * RATE))
    jsonschema.validate(records[0], schema("audio"))
    assert 0.001 < np.sqrt(np.mean(sound**2)) < 0.1
    path = experiment / records[0]["audio"]["path"]
    before = path.read_bytes()
    simulate(experiment, truth(TIMES, walk))
    assert path.read_bytes() == before


def test_pieces_are_the_whole(experiment):
    _, whole, _ = simulate(experiment, truth(TIMES, walk, lambda t: ((3.0, 3.0, 1.5), t > 0.45)))
    records, pieces, _ = simulate(
        experiment, truth(TIMES, walk, lambda t: ((3.0, 3.0, 1.5), t > 0.45)), "--chunk", "0.25"
    )
    assert [record["audio"]["start_sample"] for record in records] == [0, 4000, 8000, 12000, 16000]
    assert np.array_equal(pieces, whole)
    assert {path.name for path in (experiment / "audio" / "wav").iterdir()} == {
        record["audio"]["path"].rsplit("/", 1)[1] for record in records
    }


def test_a_piece_comes_as_soon_as_it_is_known(experiment):
    process = subprocess.Popen(
        [BIN / "avsim-audio", "-C", experiment, "--chunk", "0.2"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    process.stdin.write(truth(TIMES, walk).encode())
    process.stdin.flush()
    assert b'"start_sample":0' in process.stdout.readline()  # while the scene goes on
    process.stdin.close()
    assert process.wait() == 0
    process.stdout.close()


def test_the_thesis_ground_truth_has_no_mouths(experiment):
    objects = [{"object_id": 0, "position": [0.5, 2.33, 0.0]}]
    without = "".join(json.dumps({"timestamp": f"{t:.10f}", "objects": objects}) + "\n" for t in TIMES)
    _, sound, _ = simulate(experiment, without)
    _, expected, _ = simulate(experiment, truth(TIMES, lambda t: ((0.5, 2.33, 1.6), True)))
    assert np.array_equal(sound, expected)
    _, lower, _ = simulate(experiment, without, "--mouth-height", "1.2")
    assert not np.allclose(lower, expected)


def test_two_speakers_are_the_sum_of_each(experiment):
    def other(time):
        return (3.5, 4.0 - time, 1.7), time >= 0.3

    def mute(state):
        return lambda time: (state(time)[0], False)

    _, both, _ = simulate(experiment, truth(TIMES, walk, other))
    _, one, _ = simulate(experiment, truth(TIMES, walk, mute(other)))
    _, two, _ = simulate(experiment, truth(TIMES, mute(walk), other))
    np.testing.assert_allclose(both, one + two, atol=1e-7)
    assert two.any()


def test_nobody_speaks(experiment):
    _, sound, _ = simulate(experiment, truth(TIMES, lambda t: (walk(t)[0], False)))
    assert not sound.any()
    records, sound, _ = simulate(experiment, truth(TIMES))
    assert not sound.any()
    assert records[0]["activity"] == {}
    assert simulate(experiment, "")[0] == []


def test_activity_says_when_a_voice_sounds(experiment):
    def turns(time):
        return (1.0, 1.0, 1.6), 0.35 < time < 0.75  # from 0.4 to 0.8

    records, sound, _ = simulate(experiment, truth(TIMES, turns), "--rt60", "0")
    intervals = records[0]["activity"]["0"]
    assert intervals[0][0] == pytest.approx(0.4, abs=0.011)
    assert intervals[-1][1] == pytest.approx(0.81, abs=0.011)
    delay = np.linalg.norm(np.array([1.0, 1.0, 1.6]) - MICROPHONES[2]) / 343
    heard = np.flatnonzero(np.abs(sound[2]) > 1e-2 * np.abs(sound[2]).max()) / RATE
    assert heard[0] == pytest.approx(0.4 + delay, abs=0.02)
    assert heard[-1] < 0.82 + delay + 0.01


def test_the_direct_path_arrives_when_it_should(experiment, tmp_path):
    clicks = np.zeros(RATE // 4)
    clicks[:32] = np.hanning(32)
    with media.AudioWriter(tmp_path / "click.wav", RATE, 1) as file:
        file.write(clicks[:, None])
    _, sound, _ = simulate(
        experiment, truth(TIMES, walk), "--rt60", "0", "--speech", tmp_path / "click.wav", "--pause", "0"
    )
    for k in range(4):
        emitted = 0.25 * k + 15.5 / RATE
        mouth = np.array([0.5 + emitted, 2.33, 1.6])
        for channel, microphone in zip(sound, MICROPHONES, strict=True):
            arrival = emitted + np.linalg.norm(mouth - microphone) / 343
            begin = int(arrival * RATE) - 100
            part = channel[begin : begin + 200]
            found = begin + np.sum(np.arange(200) * np.maximum(part, 0) ** 2) / np.sum(np.maximum(part, 0) ** 2)
            assert found / RATE == pytest.approx(arrival, abs=0.3 / RATE)


def test_levels_are_in_pascal(experiment):
    _, sound, _ = simulate(experiment, truth(TIMES, lambda t: ((2.33, 2.33, 1.0), True)), "--rt60", "0")
    _, louder, _ = simulate(
        experiment, truth(TIMES, lambda t: ((2.33, 2.33, 1.0), True)), "--rt60", "0", "--level", "66.0206"
    )
    np.testing.assert_allclose(louder, 2 * sound, rtol=1e-4, atol=1e-7)
    distance = np.linalg.norm(np.array([2.33, 2.33, 1.0]) - MICROPHONES[3])
    level = 20 * np.log10(np.sqrt(np.mean(sound[3][:16000] ** 2)) * distance / 2e-5)
    assert level == pytest.approx(60, abs=1.5)  # pauses between the words count here


@pytest.mark.parametrize("rate", [8000, 48000])
def test_real_speech_at_other_rates(experiment, shared_data, rate):
    config = json.loads((experiment / "config.json").read_text())
    config["microphone_config"]["audio_sample_rate_hz"] = rate
    (experiment / "config.json").write_text(json.dumps(config))
    speech = shared_data / "speech" / "cmu_arctic_us_aew_a0001.wav"
    records, sound, messages = simulate(experiment, truth(TIMES, walk), "--speech", speech)
    assert messages == ""
    assert records[0]["audio"]["sample_rate_hz"] == rate
    assert np.isfinite(sound).all()
    assert sound.any()


# --- options ----------------------------------------------------------------------------------------------------------


def test_flac_and_bit_depths(experiment):
    _, floats, _ = simulate(experiment, truth(TIMES, walk))
    for options, step in (
        (("--bit-depth", "16"), 2**-15),
        (("--bit-depth", "24"), 2**-23),
        (("--format", "flac"), 2**-23),
        (("--format", "flac", "--bit-depth", "16"), 2**-15),
    ):
        records, sound, _ = simulate(experiment, truth(TIMES, walk), *options)
        assert records[0]["audio"]["path"].endswith("flac" if "flac" in options else "wav")
        assert np.abs(sound - floats).max() <= 0.51 * step
        assert len(list(experiment.glob("audio/wav/*"))) == 1, "the old file is gone"
    _, _, messages = simulate(experiment, truth(TIMES, walk), "--bit-depth", "16", "--level", "110")
    assert "samples were clipped" in messages


def test_the_sample_rate_may_be_lower(experiment):
    _, whole, _ = simulate(experiment, truth(TIMES, walk), "--error-db", "-60")
    records, low, _ = simulate(experiment, truth(TIMES, walk), "--sample-rate", "8000", "--error-db", "-60")
    assert records[0]["audio"]["sample_rate_hz"] == 8000
    spectra = [np.abs(np.fft.rfft(sound, axis=1)[:, 200:3000]) for sound in (whole / 2, low)]
    assert np.sum((spectra[0] - spectra[1]) ** 2) < 0.1 * np.sum(spectra[0] ** 2)  # the same voice, scaled on its own


def test_noise(experiment):
    silent = truth(TIMES, lambda t: (walk(t)[0], False))
    _, sound, _ = simulate(experiment, silent, "--noise", "sensor=30")
    assert 20 * np.log10(sound.std() / 2e-5) == pytest.approx(30, abs=0.2)
    correlation = np.corrcoef(sound)
    assert np.abs(correlation - np.eye(4)).max() < 0.05
    _, sound, _ = simulate(experiment, silent, "--noise", "room=40")
    assert 20 * np.log10(sound.std() / 2e-5) == pytest.approx(40, abs=0.5)
    _, pieces, _ = simulate(experiment, silent, "--noise", "room=40", "--noise", "sensor=30", "--chunk", "0.3")
    _, whole, _ = simulate(experiment, silent, "--noise", "room=40", "--noise", "sensor=30")
    assert np.array_equal(pieces, whole)
    _, other, _ = simulate(experiment, silent, "--noise", "room=40", "--noise", "sensor=30", "--seed", "1")
    assert not np.array_equal(other, whole)


def test_directivities(experiment):
    config = json.loads((experiment / "config.json").read_text())
    microphones = config["microphone_config"]
    still = truth(TIMES, lambda t: ((2.386, 2.253, 1.0), True))  # right below the last microphone, which looks down
    _, omni, _ = simulate(experiment, still, "--rt60", "0")
    for kind, looks, gain in (
        ("cardioid", [0, 0, -1], 1.0),
        ("cardioid", [0, 0, 1], 0.0),
        ("cardioid", [1, 0, 0], 0.5),
        ("bidirectional", [0, 0, 1], -1.0),
    ):
        microphones["directivities"], microphones["orientations"] = [kind] * 4, [looks] * 4
        (experiment / "config.json").write_text(json.dumps(config))
        _, sound, _ = simulate(experiment, still, "--rt60", "0")
        np.testing.assert_allclose(sound[3], gain * omni[3], atol=1e-4 * np.abs(omni).max())


def test_recordings_are_not_removed(experiment):
    """A real room's may have the names of simulated sound."""
    folder = experiment / "audio" / "wav"
    for depth in ("16", "24", "32", "32"):  # of its own it removes
        simulate(experiment, truth(TIMES, walk), "--rt60", "0", "--bit-depth", depth)
    kept = folder / "multichannel_audio_10.0000000000.wav"
    for subtype in ("PCM_16", "FLOAT"):
        soundfile.write(kept, np.zeros((100, 4)), 16000, subtype)
        before = kept.read_bytes()
        result = run("avsim-audio", "-C", experiment, stdin=truth(TIMES, walk))
        assert (result.returncode, "did not write this sound" in result.stderr) == (1, True)
        assert kept.read_bytes() == before
        assert len(list(folder.iterdir())) == 2


def test_a_talking_head_looks_where_it_walks(experiment):
    _, omni, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0")
    _, head, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0", "--source-directivity", "cardioid")
    gain = np.sqrt(np.sum(head**2, axis=1) / np.sum(omni**2, axis=1))
    assert gain[3] > 0.9  # ahead
    assert gain[0] < 0.6  # behind


def test_absorption_speed_and_temperature(experiment):
    alpha = 0.161 * 4.66 * 4.66 * 3 / (2 * (4.66 * 4.66 + 2 * 4.66 * 3)) / 0.2
    _, by_time, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0.2", "--absorption-model", "sabine")
    _, by_walls, _ = simulate(experiment, truth(TIMES, walk), "--absorption", str(alpha))
    np.testing.assert_allclose(by_walls[:, : by_time.shape[1]], by_time, atol=1e-6)
    _, cold, _ = simulate(experiment, truth(TIMES, walk), "--temperature", "-10")
    _, slow, _ = simulate(experiment, truth(TIMES, walk), "--speed-of-sound", str(343.2 * np.sqrt(263.15 / 293.15)))
    np.testing.assert_allclose(cold[:, : slow.shape[1]], slow[:, : cold.shape[1]], atol=1e-6)
    _, positive, _ = simulate(experiment, truth(TIMES, walk), "--reflection-sign", "positive")
    assert np.abs(positive.mean()) > 3 * np.abs(by_time.mean())
    _, eyring, _ = simulate(experiment, truth(TIMES, walk), "--absorption-model", "eyring")
    assert np.sum(eyring**2) > np.sum(by_time**2)


@pytest.mark.parametrize(("model", "expected"), [("sabine", 0.165), ("image", 0.2)])
def test_the_reverberation_that_the_walls_really_give_is_said(experiment, model, expected):
    _, _, messages = simulate(experiment, truth(TIMES[:2], walk), "-v", "--absorption-model", model)
    line = next(line for line in messages.splitlines() if "(T30)" in line)
    assert float(line.split(" in ")[1].split()[0]) == pytest.approx(expected, abs=0.002)


def test_the_thesis_preset_switches_and_ends_in_noise(experiment):
    _, exact, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0.35")
    _, thesis, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0.35", "--preset", "thesis")
    by_hand = ("--switch", "0.01", "--ism-decay", "15", "--absorption-model", "sabine")
    _, again, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0.35", *by_hand)
    assert np.array_equal(thesis, again)
    assert -20 < decibels(thesis, exact) < -6
    tail, expected = thesis[:, int(1.05 * RATE) :], exact[:, int(1.05 * RATE) :]
    assert 10 * np.log10(np.sum(tail**2) / np.sum(expected**2)) == pytest.approx(0, abs=4)


def test_long_reverberation_ends_in_noise_that_stays(experiment):
    still = truth(TIMES, lambda t: ((1.0, 2.0, 1.6), True))
    _, exact, _ = simulate(experiment, still, "--rt60", "0.6")
    _, sound, _ = simulate(experiment, still, "--rt60", "0.6", "--ism-decay", "15", "--error-db", "-20")
    late = slice(int(1.1 * RATE), int(1.25 * RATE))
    assert 10 * np.log10(np.sum(sound[:, late] ** 2) / np.sum(exact[:, late] ** 2)) == pytest.approx(0, abs=3)


def test_microphones_at_one_place_hear_the_same(experiment):
    config = json.loads((experiment / "config.json").read_text())
    config["microphone_config"]["mic_positions_m"][1] = MICROPHONES[2]
    (experiment / "config.json").write_text(json.dumps(config))
    _, sound, _ = simulate(experiment, truth(TIMES, walk))
    assert np.array_equal(sound[1], sound[2])
    assert not np.allclose(sound[0], sound[2])
    assert np.sum(sound[3] ** 2) > 0


def path_of(times, **channels):
    """Records of microphones given as functions of time; m0 is the microphone of channel 0, whose number is 1."""
    lines = []
    for time in times:
        objects = [{"object_id": int(name[1:]) + 1, "position": place(time)} for name, place in channels.items()]
        lines.append(json.dumps({"timestamp": f"{time:.10f}", "objects": objects}))
    return "\n".join(lines) + "\n"


def test_a_microphone_that_moves(experiment, tmp_path):
    """A microphone that is carried before a speaker hears no Doppler shift and no change of level."""
    path = tmp_path / "microphones.jsonl"
    times = np.arange(-2, 15) / 10
    path.write_text(path_of(times, m2=lambda t: (0.5 + t + 0.1, 2.33, 1.6), m3=lambda t: (3.0, 3, 2)))
    _, sound, messages = simulate(experiment, truth(TIMES, walk), "--rt60", "0", "--microphone-path", path)
    assert messages == ""
    _, fixed, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0")
    for channel in (0, 1):
        assert np.array_equal(sound[channel], fixed[channel]), "who does not move is not touched"
    config = json.loads((experiment / "config.json").read_text())
    config["microphone_config"]["mic_positions_m"][2:] = [[0.6, 2.33, 1.6], [3.0, 3.0, 2.0]]
    (experiment / "config.json").write_text(json.dumps(config))
    _, beside, _ = simulate(experiment, truth(TIMES, lambda t: ((0.5, 2.33, 1.6), True)), "--rt60", "0")
    # It flees from the sound, which takes 0.1 m / (c − v), not 0.1 m / c.
    whole = slice(0, int(0.9 * RATE))
    frequencies = np.fft.rfftfreq(beside.shape[1])
    later = 0.1 * (1 / (343 - 1) - 1 / 343) * RATE
    expected = np.fft.irfft(np.fft.rfft(beside[2]) * np.exp(-2j * np.pi * frequencies * later), beside.shape[1])
    assert 10 * np.log10(np.sum((sound[2] - expected)[whole] ** 2) / np.sum(expected[whole] ** 2)) < -60
    _, standing, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0")
    assert 10 * np.log10(np.sum((sound[3] - standing[3]) ** 2) / np.sum(standing[3] ** 2)) < -75


def test_pieces_are_the_whole_where_microphones_move(experiment, tmp_path):
    path = tmp_path / "microphones.jsonl"
    path.write_text(path_of(TIMES, m0=lambda t: (0.2 + t, 4.4, 2.4), m3=lambda t: (4.4, 2 - t, 2.4)))
    _, whole, _ = simulate(experiment, truth(TIMES, walk), "--microphone-path", path)
    _, pieces, _ = simulate(experiment, truth(TIMES, walk), "--microphone-path", path, "--chunk", "0.3")
    assert np.array_equal(pieces, whole)
    assert whole.any(axis=1).all()


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        (None, 2, "no such file"),
        (path_of([0.0], m1=lambda t: (9.0, 1, 1)), 1, "microphone 2 at [9.0, 1.0, 1.0] is outside the room"),
        (path_of([0.0, 0.1], m1=lambda t: (30 * t, 1, 1)), 1, "microphone 2: moves at 30 m/s from 0 s on; at most 20"),
        (path_of([0.1, 0.0], m1=lambda t: (1, 1, 1)), 1, "microphone 2: the times of a trajectory must increase"),
        (path_of([0.0], m8=lambda t: (1, 1, 1)), 1, "microphone 9 does not exist"),
        ('{"timestamp":0,"objects":[{"object_id":0,"position":[1,1,1]}]}', 1, "microphone 0 does not exist"),
        ('{"timestamp":0,"objects":[{"object_id":1,"position":[1,1]}]}', 1, "microphones.jsonl:1: "),
    ],
)
def test_microphone_paths_that_are_wrong(experiment, tmp_path, text, code, message):
    path = tmp_path / "microphones.jsonl"
    if text is not None:
        path.write_text(text)
    result = run("avsim-audio", "-C", experiment, "--microphone-path", path, stdin=truth(TIMES, walk))
    assert result.returncode == code
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


def test_impulse_responses_for_others(experiment, tmp_path):
    simulate(experiment, truth(TIMES, walk), "--rir", tmp_path / "rir.npz", "--error-db", "-60")
    content = np.load(tmp_path / "rir.npz")
    assert content["rir"].shape[:2] == (11, 4)
    np.testing.assert_allclose(content["source_position_m"], [walk(t)[0] for t in TIMES])
    expected = shoebox_rir(
        content["room_dimensions_m"],
        content["source_position_m"][3],
        content["microphone_positions_m"],
        -content["reflection"],
        RATE,
        2000,
    )
    found = content["rir"][3][:, :2000]
    assert decibels(found, expected) < -55


def test_impulse_responses_as_sofa(experiment, tmp_path):
    sofar = pytest.importorskip("sofar", reason="sofar is not installed: no SOFA files")
    simulate(experiment, truth(TIMES, walk), "--rir", tmp_path / "rir.sofa")
    sofa = sofar.read_sofa(str(tmp_path / "rir.sofa"))
    assert sofa.Data_IR.shape[:2] == (11, 4)
    np.testing.assert_allclose(sofa.SourcePosition, [walk(t)[0] for t in TIMES])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--rt60", "0.3", "--absorption", "0.3"), "contradict each other"),
        (("--no-reverb", "--rt60", "0.3"), "contradict each other"),
        (("--temperature", "20", "--speed-of-sound", "340"), "contradict each other"),
        (("--absorption", "0.3,0.4"), "one number from 0 to 1, or six"),
        (("--absorption", "1.3"), "one number from 0 to 1, or six"),
        (("--noise", "traffic=30"), "expected sensor=DB or room=DB"),
        (("--noise", "room=nan"), "expected sensor=DB or room=DB"),
        (("--format", "flac", "--bit-depth", "32"), "FLAC takes 16 or 24"),
        (("--rir", "rir.wav"), "must end in .npz or .sofa"),
        (("--error-db", "10"), "--error-db"),
        (("--rt60", "nan"), "must be a finite number, found nan"),
        (("--chunk", "inf"), "must be a finite number, found inf"),
        (("--rt60", "1e300"), "--rt60"),
        (("--temperature", "inf"), "'--temperature': must be a finite number, found inf"),
        (("--rir", "rir.npz", "--microphone-path", "path.jsonl"), "not of --microphone-path"),
        (("--rt60", "0", "--ism-decay", "15"), "--ism-decay has no effect in a room without reverberation"),
        (("--no-reverb", "--strict"), "--strict has no effect in a room without reverberation"),
        (("--no-reverb", "--reflection-sign", "positive"), "--reflection-sign has no effect"),
        (("--absorption", "1", "--reflection-sign", "positive"), "--reflection-sign has no effect"),
        (("--absorption", "0.3", "--absorption-model", "eyring"), "--absorption-model has no effect where"),
        (("--absorption", "0.3", "--strict"), "--strict has no effect where the absorption of the walls is stated"),
    ],
)
def test_options_that_make_no_sense_or_have_no_effect_are_refused(experiment, options, message):
    refused(run("avsim-audio", "-C", experiment, *options, stdin=truth(TIMES, walk)), message, status=2)


def test_options_without_effect_on_the_configured_walls_are_refused(experiment):
    config = json.loads((experiment / "config.json").read_text())
    config["room_config"]["absorption"] = 0.5
    (experiment / "config.json").write_text(json.dumps(config))
    result = run("avsim-audio", "-C", experiment, "--absorption-model", "image", stdin=truth(TIMES, walk))
    refused(result, "--absorption-model has no effect where the absorption of the walls is stated", status=2)
    simulate(experiment, truth(TIMES[:2], walk), "--absorption-model", "image", "--rt60", "0.2")
    simulate(experiment, truth(TIMES[:2], walk), "--preset", "thesis", "--no-reverb")  # a preset is not an option given


# --- rooms and places that are not easy -------------------------------------------------------------------------------


def test_a_reverberation_time_that_the_room_cannot_have(experiment):
    model = ("--absorption-model", "sabine")
    _, dry, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0")
    _, sound, messages = simulate(experiment, truth(TIMES, walk), "--rt60", "0.1", *model)
    refusal = "avsim-audio: T60 0.1 s is too short for this room; the shortest is 0.1056 s"
    assert messages == f"{refusal}; simulated without reverberation\n"
    assert np.array_equal(sound, dry)
    result = run("avsim-audio", "-C", experiment, "--rt60", "0.1", "--strict", *model, stdin=truth(TIMES, walk))
    assert result.returncode == 1
    assert result.stderr == f"{refusal}\n"


@pytest.mark.parametrize("mouth", [(0.0, 2.0, 1.6), (0.0, 0.0, 0.0), (-1.0, 2.0, 1.6), (2.0, 2.0, 9.0)])
def test_mouths_on_walls_and_outside(experiment, mouth):
    _, sound, messages = simulate(experiment, truth(TIMES, lambda t: (mouth, True)))
    assert messages == "avsim-audio: a mouth on a wall or outside the room was moved inside (11 times)\n"
    assert np.isfinite(sound).all()
    assert sound.any()


def test_a_mouth_at_a_microphone_and_a_jump(experiment):
    def jump(time):
        return (MICROPHONES[3] if time < 0.55 else (0.5, 0.5, 1.0)), True

    _, sound, messages = simulate(experiment, truth(TIMES, jump))
    assert messages == (
        "avsim-audio: a person jumped (once); the voice is interrupted there\n"
        "avsim-audio: a mouth came within 1 mm of a microphone; it is heard as from that distance\n"
    )
    assert np.isfinite(sound).all()
    assert 10 < np.abs(sound).max() < 1000


def test_someone_comes_and_goes(experiment):
    def sometimes(time):
        return walk(time) if 0.25 < time < 0.65 else None

    records, sound, _ = simulate(experiment, truth(TIMES, sometimes), "--rt60", "0")
    assert records[0]["activity"]["0"][0][0] == pytest.approx(0.3, abs=0.011)
    assert records[0]["activity"]["0"][-1][1] <= 0.63
    assert np.abs(sound[:, : int(0.3 * RATE)]).max() < 1e-6 * np.abs(sound).max()


def test_reverberation_that_is_too_long(experiment):
    result = run("avsim-audio", "-C", experiment, "--rt60", "5", stdin=truth(TIMES, walk))
    refused(result, "images of each microphone", "GiB; use --ism-decay 5, which")
    refused(run("avsim-audio", "-C", experiment, "--absorption", "0", stdin=truth(TIMES, walk)), "would never end")


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("room_config", "speed_of_sound_m_s", 1, '"room_config.speed_of_sound_m_s" must be from 100 to 10000, found 1'),
        ("microphone_config", "audio_sample_rate_hz", 100, "must be from 4000 to 384000, found 100"),
        ("microphone_config", "audio_sample_rate_hz", 10**30, "audio_sample_rate_hz"),
        ("room_config", "reverberation_time_s", 1e300, "reverberation_time_s"),
        ("room_config", "room_dimensions_m", [1e300, 1e300, 1e300], "room_dimensions_m"),
    ],
)
def test_numbers_that_cannot_be_simulated(experiment, section, key, value, message):
    config = json.loads((experiment / "config.json").read_text())
    config[section][key] = value
    (experiment / "config.json").write_text(json.dumps(config))
    result = run("avsim-audio", "-C", experiment, stdin=truth(TIMES, walk))
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert message in result.stderr


def test_what_takes_long_or_too_much_memory_is_said_before_it_begins(experiment):
    config = json.loads((experiment / "config.json").read_text())
    config["microphone_config"]["mic_positions_m"] = [[1 + i / 1000, 2, 1] for i in range(1000)]
    said = []
    surroundings_of(Config(config), Settings(rt60_s=0.35), say=said.append)
    assert len(said) == 1
    assert re.search(r"1000 microphones: about 1\d\d s of computing for a second of a voice that moves", said[0])
    with pytest.raises(ValueError, match=r"1000 microphones would hear a sound for 3 s in this room, .* memory"):
        surroundings_of(Config(config), Settings(rt60_s=3.0, ism_decay_db=5.0), say=said.append)


def test_a_second_run_into_a_directory_is_refused_by_name(experiment):
    command = [str(BIN / "avsim-audio"), "-C", str(experiment), "--chunk", "0.1", "--rt60", "0"]
    first = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    first.stdin.write(truth(TIMES, walk).encode())
    first.stdin.flush()
    first.stdout.readline()
    written = sorted((experiment / "audio" / "wav").glob("*.wav"))
    second = run("avsim-audio", "-C", experiment, stdin=truth(TIMES, walk))
    refused(second, f"avsim-audio (PID {first.pid}) is writing there")
    assert set(written) <= set((experiment / "audio" / "wav").glob("*.wav"))
    first.communicate()
    assert first.returncode == 0
    assert not list(experiment.glob(".*"))


def test_a_jump_in_time_writes_no_hours_of_silence(experiment):
    late = truth(TIMES, walk) + truth([1e9], lambda t: walk(0.0))
    result = run("avsim-audio", "-C", experiment, "--rt60", "0", stdin=late)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert "<stdin>:12: timestamp 1e+09 is more than 60 s after 1" in result.stderr
    kept = done("avsim-audio", "-C", experiment, "--rt60", "0", "--skip-invalid", stdin=late)
    assert json.loads(kept.stdout)["audio"]["num_samples"] < 2 * RATE


@pytest.mark.parametrize("dimensions", [[0.3, 0.3, 0.3], [50.0, 40.0, 20.0]])
def test_tiny_and_huge_rooms(experiment, dimensions):
    config = json.loads((experiment / "config.json").read_text())
    config["room_config"]["room_dimensions_m"] = dimensions
    spots = [[0.1, 0.1, 0.1], [0.9, 0.8, 0.9]]
    config["microphone_config"]["mic_positions_m"] = (np.array(spots) * dimensions).tolist()
    (experiment / "config.json").write_text(json.dumps(config))
    mouth = tuple(0.5 * np.array(dimensions))
    _, sound, messages = simulate(experiment, truth(TIMES, lambda t: (mouth, True)), "--rt60", "0.05")
    assert np.isfinite(sound).all()
    assert sound.any(axis=1).all()
    assert ("without reverberation" in messages) == (dimensions[0] > 1)


def test_one_record_is_silence(experiment):
    _, sound, _ = simulate(experiment, truth([0.0], walk))
    assert sound.shape == (4, round(0.2 * RATE))


def test_a_clock_of_unix_time(experiment):
    records, sound, _ = simulate(experiment, truth(1_700_000_000 + TIMES, lambda t: ((1.0, 2.0, 1.6), True)))
    assert records[0]["timestamp"] == "1700000000.0000000000"
    assert records[0]["audio"]["start_sample"] == 1_700_000_000 * RATE
    assert sound.shape == (4, round(1.2 * RATE))
    assert sound.any()


# --- bad input --------------------------------------------------------------------------------------------------------


def test_records_that_are_wrong(experiment):
    good = truth(TIMES[:3], walk)
    for line, message in (
        ("{", "<stdin>:4:"),
        ('{"timestamp":"0.1","objects":[]}', "<stdin>:4: timestamp 0.1 is not later than 0.2"),
        ('{"timestamp":"0.3","objects":[{"object_id":0,"position":[NaN,1,0]}]}', "<stdin>:4:"),
        ('{"timestamp":"0.3","objects":[{"object_id":0,"position":[null,1,0]}]}', "<stdin>:4:"),
    ):
        refused(run("avsim-audio", "-C", experiment, stdin=good + line + "\n"), message)
        assert not list(experiment.glob("audio/wav/*")), "nothing half-written"
        result = done("avsim-audio", "-C", experiment, "--skip-invalid", stdin=good + line + "\n")
        assert "skipped 1 invalid" in result.stderr


@pytest.mark.parametrize(
    ("content", "code", "message"),
    [
        (None, 2, "no such file"),
        (b"", 1, "the file is empty"),
        (b"RIFF and so on, but no sound", 1, "not a sound file that can be read"),
    ],
)
def test_speech_files_that_are_wrong(experiment, tmp_path, content, code, message):
    path = tmp_path / "speech.wav"
    if content is not None:
        path.write_bytes(content)
    result = run("avsim-audio", "-C", experiment, "--speech", path, stdin=truth(TIMES, walk))
    assert result.returncode == code
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


def test_speech_files_that_are_odd(experiment, tmp_path):
    loud = np.clip(3 * np.sin(np.arange(8000) / 5), -1, 1)
    for name, samples, message in (
        ("silent.wav", np.zeros((8000, 1)), "is silent from beginning to end"),
        ("clipped.wav", loud[:, None], "the recording is clipped"),
        ("stereo.wav", np.column_stack([loud, loud]) / 2, "has 2 channels; the voice is their mean"),
    ):
        with media.AudioWriter(tmp_path / name, RATE, samples.shape[1]) as file:
            file.write(samples)
        _, sound, messages = simulate(experiment, truth(TIMES, walk), "--speech", tmp_path / name)
        assert message in messages
        assert sound.any() == (name != "silent.wav")


def test_a_config_that_is_wrong(experiment):
    config = json.loads((experiment / "config.json").read_text())
    config["microphone_config"]["mic_positions_m"][3] = [9.0, 1.0, 1.0]
    (experiment / "config.json").write_text(json.dumps(config))
    result = run("avsim-audio", "-C", experiment, stdin=truth(TIMES, walk))
    refused(result, "microphone 4 at [9.0, 1.0, 1.0] is outside the room")
    (experiment / "config.json").unlink()
    refused(run("avsim-audio", "-C", experiment, stdin=truth(TIMES, walk)), "config.json: no such file")
