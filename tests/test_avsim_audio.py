"""avsim-audio as a user meets it: files, records, pipes and bad input."""

import json
import subprocess

import jsonschema
import numpy as np
import orjson
import pytest
from conftest import BIN, ROOT, run

from avcli import media

MICROPHONES = [
    [0.115, 4.545, 2.493],
    [2.401, 4.498, 2.385],
    [4.545, 4.545, 2.484],
    [4.498, 2.342, 2.380],
    [4.545, 0.115, 2.489],
    [2.395, 0.162, 2.378],
    [0.115, 0.115, 2.489],
    [2.386, 2.253, 2.489],
]
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
                objects.append({"object_id": identity, "position": [mouth[0], mouth[1], 0.0], "speaking": bool(speaking)})
                objects[-1]["mouth_position"] = list(mouth)
        lines.append(json.dumps({"timestamp": f"{time:.10f}", "objects": objects}))
    return "\n".join(lines) + "\n"


def walk(time):
    return (0.5 + time, 2.33, 1.6), True


TIMES = np.arange(11) / 10


def simulate(experiment, text, *options):
    result = run("avsim-audio", "-C", experiment, *options, stdin=text)
    assert result.returncode == 0, result.stderr
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
        "sample_rate_hz": RATE,
        "num_channels": 8,
    }
    assert sound.shape == (8, round(1.2 * RATE))
    jsonschema.validate(records[0], orjson.loads((ROOT / "avcli/schemas/audio.schema.json").read_bytes()))
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
    delay = np.linalg.norm(np.array([1.0, 1.0, 1.6]) - MICROPHONES[6]) / 343
    heard = np.flatnonzero(np.abs(sound[6]) > 1e-2 * np.abs(sound[6]).max()) / RATE
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
    distance = np.linalg.norm(np.array([2.33, 2.33, 1.0]) - MICROPHONES[7])
    level = 20 * np.log10(np.sqrt(np.mean(sound[7][:16000] ** 2)) * distance / 2e-5)
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


# --- rooms and places that are not easy -------------------------------------------------------------------------------


def test_a_reverberation_time_that_the_room_cannot_have(experiment):
    _, dry, _ = simulate(experiment, truth(TIMES, walk), "--rt60", "0")
    _, sound, messages = simulate(experiment, truth(TIMES, walk), "--rt60", "0.1")
    assert messages == "avsim-audio: T60 0.1 s: this room has at least 0.1056 s; simulated without echo\n"
    assert np.array_equal(sound, dry)
    result = run("avsim-audio", "-C", experiment, "--rt60", "0.1", "--strict", stdin=truth(TIMES, walk))
    assert result.returncode == 1
    assert result.stderr == "avsim-audio: T60 0.1 s: this room has at least 0.1056 s\n"


@pytest.mark.parametrize("mouth", [(0.0, 2.0, 1.6), (0.0, 0.0, 0.0), (-1.0, 2.0, 1.6), (2.0, 2.0, 9.0)])
def test_mouths_on_walls_and_outside(experiment, mouth):
    _, sound, messages = simulate(experiment, truth(TIMES, lambda t: (mouth, True)))
    assert messages == "avsim-audio: 11 times a mouth on a wall or outside the room was moved inside\n"
    assert np.isfinite(sound).all()
    assert sound.any()


def test_a_mouth_at_a_microphone_and_a_jump(experiment):
    def jump(time):
        return (MICROPHONES[7] if time < 0.55 else (0.5, 0.5, 1.0)), True

    _, sound, messages = simulate(experiment, truth(TIMES, jump))
    assert messages == "avsim-audio: 1 times someone jumped; the voice breaks off there\n"
    assert np.isfinite(sound).all()
    assert np.abs(sound).max() < 10


def test_someone_comes_and_goes(experiment):
    def sometimes(time):
        return walk(time) if 0.25 < time < 0.65 else None

    records, sound, _ = simulate(experiment, truth(TIMES, sometimes), "--rt60", "0")
    assert records[0]["activity"]["0"][0][0] == pytest.approx(0.3, abs=0.011)
    assert records[0]["activity"]["0"][-1][1] <= 0.63
    assert np.abs(sound[:, : int(0.3 * RATE)]).max() < 1e-6 * np.abs(sound).max()


def test_one_record_is_silence(experiment):
    _, sound, _ = simulate(experiment, truth([0.0], walk))
    assert sound.shape == (8, round(0.2 * RATE))


def test_a_clock_of_unix_time(experiment):
    records, sound, _ = simulate(experiment, truth(1_700_000_000 + TIMES, lambda t: ((1.0, 2.0, 1.6), True)))
    assert records[0]["timestamp"] == "1700000000.0000000000"
    assert records[0]["audio"]["start_sample"] == 1_700_000_000 * RATE
    assert sound.shape == (8, round(1.2 * RATE))
    assert sound.any()


# --- bad input --------------------------------------------------------------------------------------------------------


def test_records_that_are_wrong(experiment):
    good = truth(TIMES[:3], walk)
    for line, message in (
        ("{", "<stdin>:4:"),
        ('{"timestamp":"0.1","objects":[]}', "<stdin>:4: timestamp 0.1 does not come after 0.2"),
        ('{"timestamp":"0.3","objects":[{"object_id":0,"position":[NaN,1,0]}]}', "<stdin>:4:"),
        ('{"timestamp":"0.3","objects":[{"object_id":0,"position":[null,1,0]}]}', "<stdin>:4:"),
    ):
        result = run("avsim-audio", "-C", experiment, stdin=good + line + "\n")
        assert result.returncode == 1
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
        assert not list(experiment.glob("audio/wav/*")), "nothing half-written"
        result = run("avsim-audio", "-C", experiment, "--skip-invalid", stdin=good + line + "\n")
        assert result.returncode == 0
        assert "skipped 1 invalid" in result.stderr


@pytest.mark.parametrize(
    ("content", "code", "message"),
    [
        (None, 2, "no such file"),
        (b"", 1, "the file is empty"),
        (b"RIFF and so on, but no sound", 1, "no sound that can be read"),
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
        ("silent.wav", np.zeros((8000, 1)), "silent from beginning to end"),
        ("clipped.wav", loud[:, None], "the recording is clipped"),
        ("stereo.wav", np.column_stack([loud, loud]) / 2, "the mean of its 2 channels is spoken"),
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
    assert result.returncode == 1
    assert "microphone 3 at [9.0, 1.0, 1.0] is outside the room" in result.stderr
    (experiment / "config.json").unlink()
    result = run("avsim-audio", "-C", experiment, stdin=truth(TIMES, walk))
    assert result.returncode == 1
    assert "config.json: no such file" in result.stderr
