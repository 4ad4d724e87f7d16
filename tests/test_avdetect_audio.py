"""avdetect-audio as a process: records, files and streams of sound in, one record a time step out."""

import io
import struct

import numpy as np
import orjson
import pytest
import soundfile
from conftest import run
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.formats.experiment import read_config
from avcli.formats.media import Sound
from avcli.localization import localize

FS = 16000
PLACE = np.array([3.1, 1.3, 1.6])
WAV = "audio/wav/multichannel_audio_0.0000000000.wav"


@pytest.fixture(scope="module")
def sound():
    rng = np.random.default_rng(3)
    return noisy(heard(PLACE, voice(1.25, FS, rng), FS, reflection=0.4, order=1), 30, rng).astype(np.float32)


def write(directory, sound, **changes):
    """An experiment with one recording: 1 s of a scene, and its reverberation of 0.25 s."""
    (directory / "audio" / "wav").mkdir(parents=True, exist_ok=True)
    soundfile.write(directory / WAV, sound, FS, subtype="FLOAT")
    config = {
        "microphone_config": {
            "audio_sample_rate_hz": FS,
            "mic_positions_m": [{"id": i, "position": p} for i, p in enumerate(MICROPHONES.tolist())],
        },
        "room_config": {"room_dimensions_m": ROOM.tolist(), "reverberation_time_s": 0.25},
    }
    for section, values in changes.items():
        config[section].update(values)
    (directory / "config.json").write_bytes(orjson.dumps(config))
    return directory


@pytest.fixture(scope="module")
def experiment(tmp_path_factory, sound):
    return write(tmp_path_factory.mktemp("experiment"), sound)


def record(path=WAV, start=0, count=20000, **more):
    audio = {"path": path, "start_sample": start, "num_samples": count, "sample_rate_hz": FS, "num_channels": 8}
    return orjson.dumps({"timestamp": f"{start / FS:.10f}", "audio": audio, **more}) + b"\n"


def test_the_record_says_where_its_scene_ends(tmp_path, sound):
    write(tmp_path, sound)
    for tail, steps in ((0, 13), (2000, 12), (8000, 8)):
        stdin = record().replace(b'"num_channels"', b'"tail_samples":%d,"num_channels"' % tail)
        assert len(lines(run("avdetect-audio", "-C", tmp_path, stdin=stdin))) == steps
    halves = b""
    for start in (0, 10000):
        path = f"audio/wav/{start}.wav"
        soundfile.write(tmp_path / path, sound[start : start + 10000], FS, subtype="FLOAT")
        halves += record(path, start, 10000).replace(
            b'"num_channels"', b'"tail_samples":%d,"num_channels"' % (8000 if start else 0)
        )
    assert len(lines(run("avdetect-audio", "-C", tmp_path, stdin=halves))) == 8
    bad = record().replace(b'"num_channels"', b'"tail_samples":-1,"num_channels"')
    assert "tail_samples" in one_line(run("avdetect-audio", "-C", tmp_path, stdin=bad))


def lines(result):
    assert (result.returncode, result.stderr) == (0, "")
    return [orjson.loads(line) for line in result.stdout.splitlines()]


def one_line(result, code=1):
    assert result.returncode == code, result.stderr
    assert result.stderr.startswith("avdetect-audio: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.fixture(scope="module")
def found(experiment):
    return lines(run("avdetect-audio", "-C", experiment, stdin=record()))


def test_one_record_for_every_time_step_of_the_scene(found):
    assert [r["timestamp"] for r in found] == [f"{k / 10:.10f}" for k in range(11)]
    for r in found:
        assert (r["sensor"], r["kind"]) == ("audio", "microphones")
        for item in r["objects"]:
            assert set(item) - {"features"} == {"position", "covariance", "score", "machine"}
            assert np.linalg.eigvalsh(item["covariance"])[0] > 0
            assert 0 <= item["score"] <= 1 - item["machine"] <= 1
    voices = [item["features"]["voice"] for r in found for item in r["objects"] if "features" in item]
    assert voices
    assert all(one["kind"] == "pitch-envelope" and len(one["vector"]) == len(one["sd"]) for one in voices)
    positions = np.array([item["position"] for r in found for item in r["objects"]])
    assert len(positions) >= 9
    assert np.median(np.linalg.norm(positions - PLACE, axis=1)) < 0.05


def test_each_array_has_its_own_name(experiment, found):
    named = lines(run("avdetect-audio", "-C", experiment, "--sensor", "tile", stdin=record()))
    assert named == [one | {"sensor": "tile"} for one in found]
    assert "the name is empty" in one_line(run("avdetect-audio", "-C", experiment, "--sensor", "", stdin=record()), 2)


def test_ground_truth_that_passes_by_changes_nothing(experiment, found):
    truth = {"objects": [{"object_id": 0, "position": [1, 1, 0]}], "activity": {"0": [[0, 1]]}}
    assert lines(run("avdetect-audio", "-C", experiment, stdin=b'{"timestamp":0}\n' + record(**truth))) == found


def test_a_file_a_stream_and_records_give_the_same(experiment, found, sound):
    wav = experiment / WAV
    for result in (
        run("avdetect-audio", "-C", experiment, wav),
        run("avdetect-audio", "-c", experiment / "config.json", "-", stdin=wav.read_bytes()),
        run("avdetect-audio", "-c", experiment / "config.json", stdin=wav.read_bytes()),
    ):
        assert lines(result)[:9] == found[:9]
    later = lines(run("avdetect-audio", "-C", experiment, "--start", "1000", wav))
    assert later[0]["timestamp"] == "1000.0000000000"


def test_a_recorder_that_does_not_know_its_length(experiment, found):
    content = bytearray((experiment / WAV).read_bytes())
    place = content.index(b"data") + 4
    content[place : place + 4] = struct.pack("<I", 0xFFFFFFFF)
    streamed = lines(run("avdetect-audio", "-C", experiment, stdin=bytes(content)))
    assert streamed[:9] == found[:9]


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24", "PCM_32", "DOUBLE"])
def test_any_sample_format(experiment, found, sound, subtype):
    stream = io.BytesIO()
    soundfile.write(stream, sound, FS, subtype=subtype, format="WAV")
    for one, two in zip(lines(run("avdetect-audio", "-C", experiment, stdin=stream.getvalue())), found, strict=False):
        for a, b in zip(one["objects"], two["objects"], strict=True):
            assert a["position"] == pytest.approx(b["position"], abs=0.05)


@pytest.mark.parametrize(
    "kind", [{"format": "W64"}, {"format": "AU"}, {"format": "RF64"}, {"format": "WAV", "endian": "BIG"}], ids=str
)
def test_other_kinds_of_sound_files_are_no_records(tmp_path, sound, kind):
    write(tmp_path, sound)
    soundfile.write(tmp_path / "a", sound, FS, subtype="FLOAT", **kind)
    assert len(lines(run("avdetect-audio", "-C", tmp_path, tmp_path / "a"))) == 13


def test_numbers_that_mean_nothing_are_wrong_usage(tmp_path, sound):
    write(tmp_path, sound)
    for options in (["--start", "nan"], ["--start", "inf"], ["--temperature", "nan"], ["--heights", "2", "1"]):
        assert options[0] in one_line(run("avdetect-audio", "-C", tmp_path, *options, tmp_path / WAV), 2)


def test_a_wav_is_not_taken_for_raw_samples(tmp_path, sound):
    write(tmp_path, sound)
    assert "leave --raw out" in one_line(
        run("avdetect-audio", "-C", tmp_path, "--raw", f"s16le,{FS},8", tmp_path / WAV)
    )


def test_pieces_of_a_recording_are_taken_in_the_order_of_their_numbers(tmp_path, sound):
    write(tmp_path, sound)
    pieces = np.array_split(sound, 12)
    for number, piece in enumerate(pieces):
        soundfile.write(tmp_path / f"p{number}.wav", piece, FS, subtype="FLOAT")
    shell = sorted((tmp_path / f"p{number}.wav" for number in range(12)), key=str)
    whole = run("avdetect-audio", "-C", tmp_path, tmp_path / WAV)
    assert run("avdetect-audio", "-C", tmp_path, *shell).stdout == whole.stdout


def test_microphones_outside_the_room_are_named(tmp_path, sound):
    listed = [{"position": p} for p in (MICROPHONES * [1, 1, -1]).tolist()]
    write(tmp_path, sound, microphone_config={"mic_positions_m": listed})
    said = run("avdetect-audio", "-C", tmp_path, tmp_path / WAV).stderr
    assert "microphones 1, 2, 3, 4, 5, 6, 7, 8 are outside the room of 4.66 × 4.66 × 3 m" in said


def test_microphones_at_one_place_and_numbers_in_another_order_are_named(tmp_path, sound):
    listed = MICROPHONES.tolist()
    write(tmp_path, sound, microphone_config={"mic_positions_m": [*listed[:4], listed[1], *listed[5:]]})
    said = run("avdetect-audio", "-C", tmp_path, tmp_path / WAV).stderr
    assert "microphones 2 and 5 have the same position" in said
    listed = [{"object_id": 8 - k, "position": p} for k, p in enumerate(listed)]
    write(tmp_path, sound, microphone_config={"mic_positions_m": listed})
    said = run("avdetect-audio", "-C", tmp_path, tmp_path / WAV).stderr
    assert "object_id does not count, and stands in another order: 8, 7, 6, 5, 4, 3, 2, 1" in said
    assert "same position" not in said


def test_scores_that_are_too_high_are_said(tmp_path, sound):
    write(tmp_path, sound)
    soundfile.write(tmp_path / "a.wav", sound, FS, subtype="FLOAT")
    result = run("avdetect-audio", "-C", tmp_path, "--beta", "0.7", tmp_path / "a.wav")
    assert "--beta 0.7: scores were fitted with 1" in result.stderr
    assert run("avdetect-audio", "-C", tmp_path, "--beta", "1", tmp_path / "a.wav").stderr == ""


def test_flac_by_name(tmp_path, sound):
    write(tmp_path, sound)
    soundfile.write(tmp_path / "a.flac", sound, FS, subtype="PCM_24")
    assert len(lines(run("avdetect-audio", "-C", tmp_path, tmp_path / "a.flac"))) == 13
    assert "WAV only" in one_line(run("avdetect-audio", "-C", tmp_path, stdin=(tmp_path / "a.flac").read_bytes()))


def test_chunks_join_to_one_stream(tmp_path, sound, found):
    write(tmp_path, sound)
    stdin = b""
    for start in range(0, 20000, 7000):
        path = f"audio/wav/{start}.wav"
        soundfile.write(tmp_path / path, sound[start : start + 7000], FS, subtype="FLOAT")
        stdin += record(path, start, min(7000, 20000 - start))
    assert lines(run("avdetect-audio", "-C", tmp_path, stdin=stdin)) == found
    twice = run("avdetect-audio", "-C", tmp_path, stdin=record("audio/wav/0.wav", 0, 7000) + stdin)
    assert [orjson.loads(line) for line in twice.stdout.splitlines()] == found
    assert "dropped" in twice.stderr
    gap = run("avdetect-audio", "-C", tmp_path, stdin=stdin.splitlines(True)[0] + stdin.splitlines(True)[2])
    assert len(gap.stdout.splitlines()) == 11
    assert "missing" in gap.stderr


@pytest.mark.parametrize("method", ["srp", "3d-ssl"])
def test_a_jump_in_time_starts_anew_and_writes_no_records_between(experiment, method):
    far = 1_000_000_000
    alone = lines(run("avdetect-audio", "-C", experiment, "--method", method, stdin=record()))
    both = run("avdetect-audio", "-C", experiment, "--method", method, stdin=record() + record(start=far * FS))
    assert both.returncode == 0
    assert "starts anew" in one_line(both, code=0)
    out = [orjson.loads(line) for line in both.stdout.splitlines()]
    assert out[: len(alone)] == alone
    assert len(out) == 2 * len(alone)
    for first, second in zip(alone, out[len(alone) :], strict=True):
        assert float(second["timestamp"]) == pytest.approx(far + float(first["timestamp"]), abs=1e-6)
        places = [[item["position"] for item in decision["objects"][:1]] for decision in (first, second)]
        np.testing.assert_allclose(places[1], places[0], atol=0.1)


def test_nothing_in_nothing_out(experiment):
    result = run("avdetect-audio", "-C", experiment, stdin=b"")
    assert (result.returncode, result.stdout, result.stderr) == (0, b"", "")


def test_a_record_comes_as_soon_as_it_is_known(experiment):
    import subprocess

    from conftest import BIN

    content = (experiment / WAV).read_bytes()
    with subprocess.Popen(
        [BIN / "avdetect-audio", "-c", experiment / "config.json", "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        process.stdin.write(content[: len(content) * 3 // 5])
        process.stdin.flush()
        first = process.stdout.readline()
        assert orjson.loads(first)["timestamp"] == "0.0000000000"
        process.stdin.write(content[len(content) * 3 // 5 :])
        process.stdin.close()
        assert len(process.stdout.read().splitlines()) >= 10


# --- the thesis's method ----------------------------------------------------------------------------------------------


def test_the_thesis_method_and_its_refinement(tmp_path):
    rng = np.random.default_rng(5)
    sound = noisy(heard(PLACE, voice(1.25, FS, rng), FS), 30, rng)
    write(tmp_path, sound)
    plain = lines(run("avdetect-audio", "-C", tmp_path, "--preset", "thesis", stdin=record()))
    explicit = lines(run("avdetect-audio", "-C", tmp_path, "--method", "3d-ssl", stdin=record()))
    refined = lines(run("avdetect-audio", "-C", tmp_path, "--preset", "thesis", "--refine", stdin=record()))
    assert plain == explicit
    assert len(plain) == len(refined) == 11

    def median(records):
        return np.median([np.linalg.norm(o["position"] - PLACE) for r in records for o in r["objects"]])

    assert median(plain) < 0.3
    assert median(refined) < 0.5 * median(plain)


def test_the_thesis_method_on_silence(tmp_path):
    write(tmp_path, np.zeros((20000, 8)))
    for r in lines(run("avdetect-audio", "-C", tmp_path, "--preset", "thesis", stdin=record())):
        assert r["objects"] == []


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_sound_that_does_not_fit_the_config(tmp_path, sound):
    write(tmp_path, sound[:, :7])
    assert "7 channels" in one_line(run("avdetect-audio", "-C", tmp_path, tmp_path / WAV))
    write(tmp_path, sound, microphone_config={"audio_sample_rate_hz": 44100})
    message = one_line(run("avdetect-audio", "-C", tmp_path, tmp_path / WAV))
    assert "16000 Hz" in message
    assert "44100" in message


def test_files_that_are_broken(tmp_path, sound):
    write(tmp_path, sound)
    wav = tmp_path / WAV
    whole = wav.read_bytes()
    assert "cut short" in one_line(run("avdetect-audio", "-C", tmp_path, stdin=whole[:-5000]))
    assert "header" in one_line(run("avdetect-audio", "-C", tmp_path, stdin=whole[:30]))
    wav.write_bytes(whole[:-5000])
    assert "cut short" in one_line(run("avdetect-audio", "-C", tmp_path, wav))
    assert one_line(run("avdetect-audio", "-C", tmp_path, stdin=record()))
    wav.write_bytes(b"")
    assert "empty" in one_line(run("avdetect-audio", "-C", tmp_path, stdin=record()))
    wav.unlink()
    assert "no such file" in one_line(run("avdetect-audio", "-C", tmp_path, stdin=record()))
    one_line(run("avdetect-audio", "-C", tmp_path, tmp_path / "none.wav"), 2)


def test_records_that_are_wrong(experiment):
    assert "<stdin>:1" in one_line(run("avdetect-audio", "-C", experiment, stdin=b"?\n"))
    assert "num_samples" in one_line(run("avdetect-audio", "-C", experiment, stdin=record(count=-1)))
    assert "fewer" in one_line(run("avdetect-audio", "-C", experiment, stdin=record(count=30000)))
    assert "audio" in one_line(run("avdetect-audio", "-C", experiment, stdin=b'{"timestamp":0}\n'))
    skipped = run("avdetect-audio", "-C", experiment, "--skip-invalid", stdin=b"?\n" + record())
    assert skipped.returncode == 0
    assert "skipped 1" in skipped.stderr


def test_samples_that_are_no_numbers_are_named_and_survived(tmp_path, sound, found):
    spoilt = sound.copy()
    spoilt[4000, 2], spoilt[9000, 5] = np.nan, np.inf
    write(tmp_path, spoilt)
    result = run("avdetect-audio", "-C", tmp_path, stdin=record())
    assert result.returncode == 0
    assert "channel 3" in result.stderr
    assert "channel 6" in result.stderr
    assert len(result.stdout.splitlines()) == len(found)


@pytest.mark.parametrize(
    ("positions", "method", "reason"),
    [
        (MICROPHONES[:3], "srp", "3 microphones"),
        (np.outer(np.arange(1, 9) / 2, [1, 0.5, 0.1]), "3d-ssl", "one line"),
        (MICROPHONES * [1, 1, 0] + [0, 0, 2.4], "3d-ssl", "plane"),
    ],
)
def test_arrays_from_which_no_position_can_be_had(tmp_path, sound, positions, method, reason):
    listed = [{"position": p} for p in positions.tolist()]
    write(tmp_path, sound[:, : len(positions)], microphone_config={"mic_positions_m": listed})
    assert reason in one_line(run("avdetect-audio", "-C", tmp_path, "--method", method, tmp_path / WAV))


def test_wrong_usage(experiment):
    for options in (["--method", "magic"], ["--rate", "0"], ["--beta", "2"], ["--band", "100"]):
        one_line(run("avdetect-audio", "-C", experiment, *options, stdin=record()), 2)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("srp", ["--refine"]),
        ("srp", ["--combination", "6"]),
        ("srp", ["--min-gap", "0.02"]),
        ("3d-ssl", ["--max-speakers", "1"]),
        ("3d-ssl", ["--band", "100", "200"]),
        ("3d-ssl", ["--min-score", "0.5"]),
    ],
)
def test_options_of_the_other_method_are_refused_by_name(experiment, method, options):
    result = run("avdetect-audio", "-C", experiment, "--method", method, *options, stdin=record())
    assert f"{options[0]} has no effect with --method {method}" in one_line(result, 2)


def test_a_preset_gives_no_foreign_option_but_refuses_one(experiment):
    assert run("avdetect-audio", "-C", experiment, "--preset", "thesis", "--refine", stdin=b"").returncode == 0
    result = run("avdetect-audio", "-C", experiment, "--preset", "thesis", "--context", "0", stdin=b"")
    assert "--context has no effect with --method 3d-ssl" in one_line(result, 2)


def test_the_library_and_the_command_give_the_same(experiment, found, sound):
    config = read_config(experiment / "config.json")
    heard = localize(config, Sound(sound, FS, tail_samples=4000))
    assert len(heard) == len(found)
    for one, line in zip(heard, found, strict=True):
        assert (one.sensor, one.kind, f"{one.timestamp:.10f}") == ("audio", "microphones", line["timestamp"])
        np.testing.assert_array_equal(one.positions, [item["position"] for item in line["objects"]])
        np.testing.assert_array_equal(one.covariances, [item["covariance"] for item in line["objects"]])
        np.testing.assert_array_equal(one.scores, [item["score"] for item in line["objects"]])


def test_more_delays_in_a_closed_form_than_there_are(experiment):
    result = run("avdetect-audio", "-C", experiment, "--preset", "thesis", "--combination", "8", stdin=record())
    assert "needs 9" in one_line(result)


def test_temperature_sets_the_speed_of_sound(experiment, found):
    warm = lines(run("avdetect-audio", "-C", experiment, "--temperature", "20", stdin=record()))
    cold = lines(run("avdetect-audio", "-C", experiment, "--temperature", "-20", stdin=record()))

    def errors(records):
        return np.median([np.linalg.norm(o["position"] - PLACE) for r in records for o in r["objects"]] or [9.0])

    assert errors(warm) < 0.05 < errors(cold)
