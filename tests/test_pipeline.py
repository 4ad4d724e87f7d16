"""Whole experiments: by files, live through pipes, by ear alone; and what a user sees when something is missing."""

import json
import os
import re
import shutil
import subprocess
import sys

import cv2
import jsonschema
import numpy as np
import orjson
import pytest
from conftest import BIN, COMMANDS, HANG_S, done, refused, run, schema
from forked import write_shims

THESIS_HOTA = {"audio": 0.477, "video": 0.800, "audio_video": 0.803}
"""Table 5.6 of the thesis (S1)."""


def lines(path):
    return [orjson.loads(line) for line in path.read_bytes().splitlines()]


def camera_of(directory):
    return json.dumps(json.loads((directory / "config.json").read_bytes())["camera_config"])


def scores(truth, *tracks):
    result = done("aveval", truth, *tracks, "--format", "jsonl")
    return [orjson.loads(line) for line in result.stdout.splitlines()]


# --- by files ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", THESIS_HOTA)
def test_s1_beats_the_thesis(finished_s1, modality):
    record = scores(finished_s1 / "groundtruth_sources.jsonl", finished_s1 / f"tracking/{modality}_tracking.jsonl")[0]
    jsonschema.validate(record, schema("metrics"))
    assert record["summary"]["HOTA"] > THESIS_HOTA[modality]


@pytest.mark.parametrize(
    ("file", "kind"),
    [
        ("groundtruth_sources.jsonl", "groundtruth"),
        ("scene.jsonl", "groundtruth"),
        ("scene.jsonl", "frame"),
        ("audio.jsonl", "audio"),
        ("localization/audio_localizations.jsonl", "localization"),
        ("localization/video_localizations.jsonl", "localization"),
        ("tracking/audio_video_tracking.jsonl", "track"),
    ],
)
def test_every_record_keeps_to_its_schema(finished_s1, file, kind):
    validator = jsonschema.Draft202012Validator(schema(kind))
    records = lines(finished_s1 / file)
    assert records
    for record in records:
        validator.validate(record)


def test_one_record_for_every_step_of_the_clock(finished_s1):
    clock = [f"{k / 10:.10f}" for k in range(41)]
    for file in ("groundtruth_sources.jsonl", "scene.jsonl", "localization/video_localizations.jsonl"):
        assert [record["timestamp"] for record in lines(finished_s1 / file)] == clock, file
    for file in ("localization/audio_localizations.jsonl", "tracking/audio_video_tracking.jsonl"):
        assert [record["timestamp"] for record in lines(finished_s1 / file)][:41] == clock, file


def test_the_experiment_has_the_layout_of_the_thesis(finished_s1):
    config = orjson.loads((finished_s1 / "config.json").read_bytes())
    jsonschema.validate(config, schema("config"))
    assert config["camera_config"]["lens_model"] == "kannala_brandt"
    for record in lines(finished_s1 / "scene.jsonl"):
        t = record["timestamp"]
        assert record["frame"] == {"rgb": f"video/rgb/RGB_frame_{t}.png", "depth": f"video/depth/Depth_frame_{t}.png"}
    rgb = cv2.imread(str(finished_s1 / "video/rgb/RGB_frame_2.0000000000.png"), cv2.IMREAD_UNCHANGED)
    depth = cv2.imread(str(finished_s1 / "video/depth/Depth_frame_2.0000000000.png"), cv2.IMREAD_UNCHANGED)
    assert (rgb.shape, rgb.dtype, depth.shape, depth.dtype) == ((1080, 1920, 3), np.uint8, (1080, 1920), np.uint16)
    assert (finished_s1 / "audio/wav/multichannel_audio_0.0000000000.wav").is_file()


# --- live -------------------------------------------------------------------------------------------------------------

PIPELINE = """
exec 3> >(avsim-audio -C out/s1 | avdetect-audio -C out/s1 >a.jsonl); ears=$!
avsim-scene s1 --duration 1 -C out/s1 | tee /dev/fd/3 | avdetect-video -C out/s1 >v.jsonl
exec 3>&-; wait $ears
avfuse -C out/s1 a.jsonl v.jsonl | tee t.jsonl | aveval out/s1/groundtruth_sources.jsonl -
"""


@pytest.mark.slow
def test_a_second_run_live_and_otherwise_hashed_gives_the_same_bytes(small_s1, tmp_path):
    path = f"{BIN}{os.pathsep}{os.environ['PATH']}"
    (tmp_path / "camera.json").write_text(camera_of(small_s1))
    pipeline = PIPELINE.replace("avsim-scene s1", "avsim-scene s1 --camera-config camera.json")
    result = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", pipeline],
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "OPENBLAS_NUM_THREADS": "2", "PYTHONHASHSEED": "7"},
        capture_output=True,
        timeout=HANG_S,
    )
    assert (result.returncode, result.stderr) == (0, b"")
    wav = "audio/wav/multichannel_audio_0.0000000000.wav"
    for file, made in [
        (f"out/s1/{wav}", wav),
        ("a.jsonl", "localization/audio_localizations.jsonl"),
        ("v.jsonl", "localization/video_localizations.jsonl"),
        ("t.jsonl", "tracking/audio_video_tracking.jsonl"),
    ]:
        assert (tmp_path / file).read_bytes() == (small_s1 / made).read_bytes(), file


@pytest.mark.parametrize("stage", ["avsim-scene", "avsim-audio", "avdetect-audio", "avdetect-video", "tee"])
def test_a_stage_that_fails_at_once_ends_the_others(tmp_path, stage):
    lines = [line for line in PIPELINE.strip().splitlines() if not line.startswith("avfuse")]
    short = "\n".join(lines).replace("--duration 1", "--duration 0.1 --pictures depth")
    failing = short.replace(f"{stage} ", f"{stage} --no-such-option ", 1)
    environment, nursery = write_shims(tmp_path / "bin")
    result = subprocess.run(
        ["bash", "-o", "pipefail", "-c", failing + "; jobs -p"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        pass_fds=[nursery],
    )
    assert "--no-such-option" in result.stderr or "unrecognized option" in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""


def test_by_ear_alone_nothing_is_rendered(tmp_path):
    program = (
        "import sys; sys.argv = ['avsim-scene', 's1', '-C', sys.argv[1], '--no-video']\n"
        "from avcli.commands.avsim_scene import main\n"
        "try:\n    main()\n"
        "finally:\n    print(*({'moderngl', 'cv2', 'trimesh'} & set(sys.modules)), file=sys.stderr)\n"
    )
    result = subprocess.run([sys.executable, "-c", program, tmp_path / "e"], capture_output=True, text=True)
    assert (result.returncode, result.stderr.strip()) == (0, "")
    assert not (tmp_path / "e" / "video").exists()
    assert all("frame" not in json.loads(line) for line in result.stdout.splitlines())


# --- ground truth stays unread ----------------------------------------------------------------------------------------


def test_a_detector_reads_no_ground_truth(finished_s1):
    stripped = b"".join(
        orjson.dumps({key: record[key] for key in ("timestamp", "frame")}) + b"\n"
        for record in lines(finished_s1 / "scene.jsonl")[:3]
    )
    whole = b"".join((finished_s1 / "scene.jsonl").read_bytes().splitlines(keepends=True)[:3])
    outputs = [run("avdetect-video", "-C", finished_s1, stdin=stdin).stdout for stdin in (stripped, whole)]
    assert outputs[0] == outputs[1] != b""


# --- what goes wrong --------------------------------------------------------------------------------------------------

READERS = {
    "avsim-audio": "groundtruth_sources.jsonl",
    "avdetect-audio": "audio.jsonl",
    "avdetect-video": "scene.jsonl",
    "avfuse": "localization/video_localizations.jsonl",
}


def broken(finished_s1, tmp_path, change):
    """A copy of the experiment's config and records whose config.json `change` has broken."""
    config = orjson.loads((finished_s1 / "config.json").read_bytes())
    directory = tmp_path / "e"
    directory.mkdir()
    content = change(config)
    if content is not None:
        (directory / "config.json").write_bytes(content if isinstance(content, bytes) else orjson.dumps(content))
    return directory


@pytest.mark.parametrize("command", READERS)
def test_a_missing_or_broken_config(finished_s1, tmp_path, command):
    stdin = (finished_s1 / READERS[command]).read_bytes()
    directory = broken(finished_s1, tmp_path, lambda config: b"{")
    refused(run(command, "-C", directory, stdin=stdin), f"{command}: ")
    (directory / "config.json").unlink()
    refused(run(command, "-C", directory, stdin=stdin), f"{command}: ")
    refused(run(command, "-C", tmp_path / "missing", stdin=stdin), f"{command}: ", status=2)
    refused(run(command, "-c", tmp_path / "missing.json", stdin=stdin), f"{command}: ", status=2)


@pytest.mark.parametrize(
    ("command", "section", "key"),
    [
        ("avsim-audio", "microphone_config", "mic_positions_m"),
        ("avsim-audio", "room_config", "room_dimensions_m"),
        ("avdetect-audio", "microphone_config", "mic_positions_m"),
        ("avdetect-video", "camera_config", "fx_px"),
    ],
)
def test_a_config_without_a_needed_key_names_it(finished_s1, tmp_path, command, section, key):
    def without(config):
        del config[section][key]
        return config

    directory = broken(finished_s1, tmp_path, without)
    result = run(command, "-C", directory, stdin=(finished_s1 / READERS[command]).read_bytes())
    refused(result, f"{command}: ")
    assert f"{section}.{key}" in result.stderr


def test_a_missing_picture(finished_s1, tmp_path):
    directory = broken(finished_s1, tmp_path, lambda config: config)
    result = run("avdetect-video", "-C", directory, stdin=(finished_s1 / "scene.jsonl").read_bytes())
    refused(result, "avdetect-video: ")
    assert re.search(r"(RGB_frame_0\.0|Depth_)\S*: no such file", result.stderr)


def test_sound_of_another_rate_or_channel_count(finished_s1, tmp_path):
    def fewer(config):
        config["microphone_config"]["mic_positions_m"].pop()
        return config

    def slower(config):
        config["microphone_config"]["audio_sample_rate_hz"] = 48000
        return config

    wav = finished_s1 / "audio/wav/multichannel_audio_0.0000000000.wav"
    for number, change in enumerate((fewer, slower)):
        (tmp_path / str(number)).mkdir()
        directory = broken(finished_s1, tmp_path / str(number), change)
        refused(run("avdetect-audio", "-C", directory, wav), "avdetect-audio: ")


@pytest.mark.parametrize("command", READERS)
def test_a_bad_line_in_every_reader(finished_s1, tmp_path, command):
    directory = broken(finished_s1, tmp_path, lambda config: config)
    first = (finished_s1 / READERS[command]).read_bytes().splitlines(keepends=True)[0]
    result = run(command, "-C", directory, stdin=b"?" + first)
    refused(result, f"{command}: ")
    assert "<stdin>:1:" in result.stderr
    assert os.listdir(directory) == ["config.json"], "nothing half-written"


# --- the manual's examples --------------------------------------------------------------------------------------------


def shortened(block: str) -> str:
    """A block whose scenes of seconds are shorter, and its pictures smaller: what it shows is the same."""
    block = re.sub(r"(avsim-scene (?:s\d|random|mine\.json)) (?![^|\n]*--(?:lens|no-video|print))",
                   r"\1 --camera-config small.json ", block)  # fmt: skip
    block = re.sub(r"--duration [1-9]\S*", "--duration 0.5", block)
    return re.sub(r"(avsim-scene s[1-4])(?=[^|\n]* -C )(?![^|\n]*--duration)", r"\1 --duration 0.5", block)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_the_manual_run(small_s1, tmp_path, command):
    from test_house import examples_of, page_of

    shutil.copytree(small_s1, tmp_path / "out" / "s1")
    (tmp_path / "small.json").write_text(camera_of(small_s1))
    environment, nursery = write_shims(tmp_path / "bin")
    for block in examples_of(page_of(command)):
        if re.search(r"\bjq\b", block) and not shutil.which("jq"):
            continue
        result = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", shortened(block)],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            stdin=subprocess.DEVNULL,
            timeout=HANG_S,
            pass_fds=[nursery],
        )
        assert result.returncode == 0, f"{block}\n{result.stderr.decode()}"
