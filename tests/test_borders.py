"""What bad input, broken files and faults of the machine do to the filters: one line, the right status, no hang."""

import contextlib
import os
import signal
import struct
import subprocess
import sys

import numpy as np
import orjson
import pytest
from conftest import BIN, refused
from forked import run_forked

from avcli.formats import atomic, footage, media, records
from avcli.formats.bounds import LONGEST_RECORD
from avcli.scene.scenario import LABORATORY

DETECTION = b'{"timestamp":"0.1000000000","sensor":"video","kind":"camera","objects":[{"position":[1.0,2.0,null]}]}\n'
DEEP = "[" * 300 + "]" * 300


def config(tmp_path, **changes):
    """A config.json of the laboratory with "section__key" replaced."""
    raw = {section: dict(values) for section, values in LABORATORY.items()}
    for where, value in changes.items():
        section, key = where.split("__")
        raw[section][key] = value
    path = tmp_path / "config.json"
    path.write_bytes(orjson.dumps(raw))
    return path


# --- records ----------------------------------------------------------------------------------------------------------

BAD = {
    f'{{"timestamp":"0.2","objects":[{{"position":{DEEP}}}]}}': "deep inside one another",
    f'{{"timestamp":"0.2","objects":{DEEP}}}': "deep inside one another",
    f'{{"timestamp":{DEEP},"objects":[]}}': "deep inside one another",
    f'{{"timestamp":"0.2","sensor":{DEEP},"objects":[]}}': "deep inside one another",
    f'{{"timestamp":"0.2","objects":[{{"position":[0,1],"score":{DEEP}}}]}}': "deep inside one another",
    f'{{"timestamp":"0.2","objects":[{{"position":[0,1],"covariance":{DEEP}}}]}}': "deep inside one another",
    "[" * 300 + "]" * 300: "must be a JSON object",
    "[" * 2000 + "]" * 2000: "invalid JSON",
    '{"timestamp":1e300,"objects":[]}': "from -1e11 to 1e11, found 1e+300",
    '{"timestamp":"1e16","objects":[]}': "from -1e11 to 1e11",
    '{"timestamp":"0.2","objects":[{"position":[1e300,0,0]}]}': "from -1e6 to 1e6",
    '{"timestamp":"0.2","objects":[{"position":[0,1],"covariance":[[1e308,0],[0,1e308]]}]}': "from -1e12 to 1e12",
    '{"timestamp":"0.2","objects":[' + ",".join(['{"position":[0,1]}'] * 10001) + "]}": "at most 10000, found 10001",
    '{"timestamp":"0.2","objects":[' + "{}," * 6_000_000 + "{}]}": "longer than 16 MiB",
}


@pytest.mark.parametrize("line", BAD, ids=range(len(BAD)))
def test_a_record_beyond_the_bounds_is_refused_or_skipped(line):
    given = DETECTION + line.encode() + b"\n" + DETECTION.replace(b"0.1", b"0.2")
    refused(run_forked("avfuse", stdin=given), "avfuse: <stdin>:2", BAD[line])
    ended = run_forked("avfuse", "--skip-invalid", stdin=given)
    assert (ended.returncode, len(ended.stdout.splitlines())) == (0, 2)
    assert "avfuse: skipped 1 invalid" in ended.stderr


def test_the_tail_of_a_line_that_is_too_long_is_no_record():
    long = b'{"timestamp": "0.2", "own": "' + b"x" * (LONGEST_RECORD + 7) + DETECTION.strip() + b'"}\n'
    printed = (
        b'{\n"timestamp": "0.2",\n' + (b'"own": [],' * 1000 + b"\n") * (LONGEST_RECORD // 10000) + DETECTION + b"}\n"
    )
    for text in (long, printed):
        ended = run_forked("avfuse", "--skip-invalid", stdin=DETECTION + text + DETECTION.replace(b"0.1", b"0.2"))
        assert (ended.returncode, len(ended.stdout.splitlines())) == (0, 2)
        assert ended.stderr.splitlines()[-1] == "avfuse: skipped 1 invalid record"


@pytest.mark.parametrize("value", [DEEP, "[" * 1000 + "]" * 1000, '{"a":' * 500 + "1" + "}" * 500])
def test_any_value_can_be_shown(value):
    from avcli.formats.schema import shown

    assert 0 < len(shown(orjson.loads(value))) <= 60
    assert shown(10**5000)
    assert shown([1, "a", None, {"b": [2.5]}]) == '[1,"a",null,{"b":[2.5]}]'


def test_records_of_another_kind_are_named(tmp_path):
    tracks = b'{"timestamp":"0.1000000000","objects":[{"object_id":1,"position":[1.0,2.0,0.0]}]}\n'
    for options in ([], ["--skip-invalid"]):
        refused(run_forked("avfuse", *options, stdin=tracks * 2), "these are ground truth or tracks, not detections")
        (tmp_path / "truth.jsonl").write_bytes(tracks)
        refused(
            run_forked("aveval", *options, tmp_path / "truth.jsonl", "-", stdin=DETECTION),
            "these are detections, not ground truth or tracks; --detections scores them",
        )


def test_people_can_be_named_by_text(tmp_path):
    rows = [
        records.encode({"timestamp": k / 10, "objects": [{"object_id": "anna", "position": [k / 10, 1.0]}]})
        for k in range(10)
    ]
    (tmp_path / "truth.jsonl").write_bytes(b"".join(rows))
    ended = run_forked("aveval", tmp_path / "truth.jsonl", "-", stdin=b"".join(rows).replace(b"anna", b"T 7"))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert orjson.loads(ended.stdout.splitlines()[0])["summary"]["HOTA"] == 1.0
    mixed = b"".join(rows[:5] + [row.replace(b'"anna"', b"3") for row in rows[5:]])
    refused(run_forked("aveval", tmp_path / "truth.jsonl", "-", stdin=mixed), "<stdin>:6: ", "text for some people")
    loaded = records.load(tmp_path / "truth.jsonl")
    records.save(tmp_path / "again.jsonl", loaded)
    assert (tmp_path / "again.jsonl").read_bytes() == b"".join(rows)


# --- config.json and scenarios ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "changes", "words"),
    [
        ("avfuse", {"camera_config__frame_rate_hz": 1e6}, "frame_rate_hz"),
        ("avfuse", {"camera_config__frame_rate_hz": 1e300}, "frame_rate_hz"),
        ("avfuse", {"camera_config__frame_rate_hz": 1e-300}, "frame_rate_hz"),
        ("avfuse", {"room_config__room_dimensions_m": [1e300] * 3}, "room_dimensions_m"),
        ("avfuse", {"room_config__room_dimensions_m": [1e-9, 4, 3]}, "room_dimensions_m"),
        ("avsim-audio", {"room_config__reverberation_time_s": 1e300}, "reverberation_time_s"),
        ("avsim-audio", {"room_config__speed_of_sound_m_s": 1e300}, "speed_of_sound_m_s"),
        ("avsim-audio", {"microphone_config__audio_sample_rate_hz": 1e308}, "audio_sample_rate_hz"),
        ("avsim-audio", {"microphone_config__audio_sample_rate_hz": 1}, "audio_sample_rate_hz"),
        ("avsim-audio", {"microphone_config__mic_positions_m": [[1, 1, 1]] * 1025}, "at most 1024, found 1025"),
        ("avdetect-video", {"camera_config__image_width_px": 1e9}, "image_width_px"),
        ("avdetect-video", {"camera_config__image_width_px": 20000, "camera_config__image_height_px": 20000}, "pixels"),
    ],
)
def test_a_config_beyond_the_bounds_is_refused(tmp_path, command, changes, words):
    config(tmp_path, **changes)
    truth = b'{"timestamp":"0.1","objects":[{"object_id":1,"position":[1,2,0]}],"frame":{"rgb":"a.png"}}\n'
    ended = run_forked(command, "-C", tmp_path, stdin=DETECTION if command == "avfuse" else truth)
    refused(ended, "config.json: ", words)


@pytest.mark.parametrize("depth", [65, 900, 200_000])
def test_a_deep_scenario_or_config_is_refused(tmp_path, depth):
    deep = b'{"people":' + b"[" * depth + b"]" * depth + b"}"
    refused(run_forked("avsim-scene", "-", "-C", tmp_path / "out", stdin=deep), "deep inside one another")
    (tmp_path / "config.json").write_bytes(deep)
    ended = run_forked("avfuse", "-C", tmp_path, stdin=DETECTION)
    refused(ended, "config.json", "invalid JSON" if depth > 1000 else "deep inside one another")


@pytest.mark.parametrize("seed", [2**63, 2**64, 10**30, -1])
def test_a_seed_is_checked_before_anything_is_removed(tmp_path, seed):
    (tmp_path / "groundtruth_sources.jsonl").write_text("old")
    refused(run_forked("avsim-scene", "s1", "-C", tmp_path, "--seed", seed), "--seed", status=2)
    assert (tmp_path / "groundtruth_sources.jsonl").read_text() == "old"


# --- media ------------------------------------------------------------------------------------------------------------


def png(width, height):
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + head + b"\0" * 40


def jpeg(width, height):
    frame = b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, height, width, 3) + b"\0" * 9
    return b"\xff\xd8\xff\xe0\x00\x10JFIF\0" + b"\0" * 9 + frame + b"\xff\xd9"


@pytest.mark.parametrize("kind", ["fifo", "zero", "directory", "socket"])
def test_a_file_that_is_not_a_regular_one_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "x.png"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "directory":
        path.mkdir()
    else:
        os.mknod(path, 0o600 | 0o140000)
    for read in (media.read_rgb, media.read_depth, media.read_audio):
        with pytest.raises(media.MediaError, match=r"x\.png: (a pipe|a device|a directory|a socket|no such)"):
            read(path)


def test_headers_are_checked_before_anything_is_decoded(tmp_path):
    path = tmp_path / "x"
    raw = b"\x93NUMPY\x01\x00v\x00{'descr': '|u1', 'fortran_order': False, 'shape': (9000000000, 900), }"
    for content in (
        png(20000, 20000),
        png(2**31 - 1, 2**31 - 1),
        jpeg(65000, 65000),
        raw.ljust(127) + b"\n" + b"1" * 9,
    ):
        path.write_bytes(content)
        with pytest.raises(media.MediaError, match=r"at most 134217728 pixels|its header states"):
            media.read_rgb(path)
    assert media.stated_size(png(3, 4)) == media.stated_size(jpeg(3, 4)) == (3, 4)
    image = np.zeros((4, 3, 3), np.uint8)
    for suffix in (".png", ".jpg"):
        assert media.stated_size(media.encode_picture(image, suffix)) == (3, 4)
    head = b"RIFF\xff\xff\xff\xffWAVEfmt \x10\0\0\0" + struct.pack("<HHIIHH", 1, 60000, 8000, 8000, 2, 16)
    path.write_bytes(head + b"data\xff\xff\xff\x7f" + b"\0" * 1000)
    with pytest.raises(media.MediaError), open(path, "rb") as stream:
        list(media.wav_stream_blocks(stream, "x"))
    with pytest.raises(media.MediaError):
        media.read_audio(path)


@pytest.mark.parametrize("path", ["/etc/passwd", "../a.wav", "audio/../../a.wav", "a\0b"])
def test_a_record_cannot_name_a_file_outside_the_experiment(tmp_path, path):
    audio = {"path": path, "start_sample": 0, "num_samples": 10, "sample_rate_hz": 44100, "num_channels": 8}
    heard = records.encode({"timestamp": 0.0, "audio": audio})
    seen = records.encode({"timestamp": 0.0, "frame": {"rgb": path}})
    config(tmp_path)
    for command, line in (("avdetect-audio", heard), ("avdetect-video", seen)):
        refused(run_forked(command, "-C", tmp_path, stdin=line), f"{command}: <stdin>:1: ", "must be")
        allowed = run_forked(command, "-C", tmp_path, "--allow-outside", stdin=line)
        assert (allowed.returncode, "experiment directory" in allowed.stderr) == (1, False)
    inside = {"timestamp": 0.0, "frame": {"rgb": "video/../a.png", "depth": "./b..png"}}
    assert records.frame(inside).rgb == "video/../a.png"


def test_a_gap_in_the_sound_is_bounded(tmp_path):
    config(tmp_path)
    with media.AudioWriter(tmp_path / "a.wav", 44100, 8) as file:
        file.write(np.zeros((4410, 8)))
    audio = {"path": "a.wav", "start_sample": 0, "num_samples": 4410, "sample_rate_hz": 44100, "num_channels": 8}
    lines = [{"timestamp": 0.0, "audio": {**audio, "start_sample": start}} for start in (0, 44100 * 10**8)]
    ended = run_forked("avdetect-audio", "-C", tmp_path, stdin=b"".join(map(records.encode, lines)))
    assert (ended.returncode, ended.stdout.count(b"\n")) == (0, 0), "the reverberation time hides all of 0.1 s"
    assert "a.wav: 100000000 s before it are missing; the recording starts anew there" in ended.stderr


# --- what is written --------------------------------------------------------------------------------------------------


def test_flac_has_at_most_eight_channels(tmp_path):
    with pytest.raises(media.MediaError, match="FLAC has at most 8 channels, not 9; use WAV"):
        media.AudioWriter(tmp_path / "a.flac", 16000, 9, 24)
    config(tmp_path, microphone_config__mic_positions_m=[[1, 1, 1]] * 9)
    truth = b'{"timestamp":"0.1","objects":[{"object_id":1,"position":[1,2,0]}]}\n'
    refused(run_forked("avsim-audio", "-C", tmp_path, "--format", "flac", stdin=truth), "FLAC has at most 8 channels")


def test_a_full_disk_is_an_error_of_each_writer(tmp_path):
    config(tmp_path, room_config__reverberation_time_s=0.0)
    truth = b"".join(
        records.encode({"timestamp": k / 10, "objects": [{"object_id": 1, "position": [1, 2, 0], "speaking": True}]})
        for k in range(12)
    )
    for kind in ("wav", "flac"):
        options = ("-C", tmp_path, "--format", kind, "--noise", "sensor=20")
        ended = run_forked("avsim-audio", *options, stdin=truth, largest_file=1 << 17)
        refused(ended, "File too large", f"multichannel_audio_0.0000000000.{kind}", status=74)
        assert list((tmp_path / "audio" / "wav").iterdir()) == []


def test_a_full_disk_is_an_error_of_a_video(tmp_path):
    command = (
        "import numpy, resource, signal, sys; from avcli.formats.footage import Picture, Sink\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16)); noise = numpy.random.default_rng(0)\n"
        "with Sink(sys.argv[1], (320, 240), 10.0, single=True) as sink:\n"
        "    for k in range(40): sink.write(Picture('', k, None), noise.integers(0, 256, (240, 320, 3), numpy.uint8))"
    )
    for suffix in (".mp4", ".avi"):
        path = tmp_path / f"film{suffix}"
        result = subprocess.run([sys.executable, "-c", command, path], capture_output=True, text=True, timeout=300)
        assert "OSError: [Errno 27] File too large" in result.stderr.splitlines()[-1]
        assert list(tmp_path.iterdir()) == []


def test_a_film_that_a_signal_ends_is_kept_where_it_is_live(tmp_path):
    path = tmp_path / "film.mp4"
    image = np.zeros((48, 64, 3), np.uint8)
    for whole, error, kept in ((True, KeyboardInterrupt, 0), (False, ValueError, 0), (False, KeyboardInterrupt, 1)):
        sink = footage.Sink(path, (64, 48), 10.0, single=True, whole=whole)
        with contextlib.suppress(error), sink:
            sink.write(footage.Picture("", 0.0, image), image)
            raise error
        assert len(list(tmp_path.iterdir())) == kept
    assert len(list(footage.pictures([str(path)]))) == 1


def test_temporary_files_of_killed_runs_are_removed_and_others_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "_swept", set())
    gone = subprocess.Popen(["true"])
    gone.wait()
    names = [f".{name}.{gone.pid}.avcli-tmp" for name in ("a.png", "b.wav", "film.mp4")]
    dead, other = [*names[:2], f"{names[2]}.mp4"], [f".a.{os.getppid()}.avcli-tmp", f".x.{gone.pid}.tmp", "a.avcli-tmp"]
    for name in dead + other:
        (tmp_path / name).write_text("x")
    atomic.write_bytes(tmp_path / "new.png", b"new")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*other, "new.png"])


def test_an_output_follows_a_link_and_may_have_a_long_name(tmp_path):
    (tmp_path / "there").mkdir()
    link, target = tmp_path / "link", tmp_path / "there" / "target"
    link.symlink_to("there/target")
    for content in (b"1", b"2"):  # a link that points at nothing yet, and then at a file
        with atomic.writing(link) as stream:
            stream.write(content)
        assert link.is_symlink()
        assert target.read_bytes() == content
    for name in ("n" * 250, "é" * 127, "n" * 251 + ".mp4"):
        atomic.write_bytes(tmp_path / name, b"long")
        assert (tmp_path / name).read_bytes() == b"long"
    assert len(list(tmp_path.iterdir())) == 5


def test_only_a_file_is_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path):
        with pytest.raises(OSError, match="only a file can be replaced"), atomic.replacing(path):
            pass
    assert pipe.is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]


@pytest.mark.parametrize(
    "command",
    [
        "avdetect-audio sound.wav -o sound.wav",
        "avdetect-audio -o sound.wav <sound.wav",
        "avdetect-video film.mp4 -o film.mp4",
        "avsim-scene mine.json -o mine.json",
        "avsim-scene s1 -C . -o config.json",
        "avsim-audio in.jsonl -o in.jsonl",
        "avsim-audio in.jsonl --speech sound.wav -o sound.wav",
        "avfuse in.jsonl -o in.jsonl",
        "avfuse -o in.jsonl <in.jsonl",
        "avfuse in.jsonl -C . -o config.json",
        "aveval in.jsonl in.jsonl -o in.jsonl",
        "avcalib calibrate film.mp4 -o film.mp4",
        "avcalib calibrate film.mp4 -C . -o config.json",
        "avcalib convert mine.json --to ros -o mine.json",
        "avcalib check mine.json -o mine.json",
        "avcalib background film.mp4 -C . -o film.mp4",
        "avcalib detector film.mp4 --teacher mine.json -o mine.json",
        "avcalib pose film.mp4 -C . -o film.mp4",
        "avcalib undistort film.mp4 -C . --to new -o config.json",
    ],
)
def test_the_output_replaces_no_input(tmp_path, command):
    """A recording cannot be made again."""
    names = ("sound.wav", "film.mp4", "mine.json", "in.jsonl", "config.json")
    for name in names:
        (tmp_path / name).write_bytes(b"{}")
    line, _, stdin = command.partition(" <")
    with open(tmp_path / stdin if stdin else os.devnull, "rb") as stream:
        name, *options = line.split()
        result = subprocess.run([BIN / name, *options], stdin=stream, capture_output=True, text=True, cwd=tmp_path)
    assert (result.returncode, "this file is an input; name another one" in result.stderr) == (2, True), result.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(names, b"{}")


def test_an_output_that_is_open_already_is_not_replaced(tmp_path):
    """The shell may append to it."""
    every = tmp_path / "every.jsonl"
    every.write_text("old\n")
    for name in ("/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"):
        program = f"from avcli.formats.atomic import write_bytes; write_bytes({name!r}, b'new\\n')"
        with open(every, "ab") as stream:
            subprocess.run([sys.executable, "-c", program], stdout=stream, check=True)
    assert every.read_text() == "old\n" + 3 * "new\n"


def test_a_second_output_on_standard_output_is_refused(tmp_path, monkeypatch):
    """It was a file of the name "-"."""
    monkeypatch.chdir(tmp_path)
    for option in ("--explain", "--learn", "--map"):
        refused(run_forked("avfuse", option, "-", stdin=DETECTION), f"{option} -: only --output", status=2)
    refused(run_forked("avview", "--html", "-", stdin=DETECTION), "--html -: only --output", status=2)
    assert list(tmp_path.iterdir()) == []


# --- the end of a stream ----------------------------------------------------------------------------------------------


def copied(*options, stdin):
    return run_forked("copy_records", *options, stdin=stdin)


def test_an_end_mark_is_announced_written_and_not_passed_on(monkeypatch):
    plain = copied(stdin=DETECTION * 3).stdout
    marked = copied("--mark-end", stdin=DETECTION * 3).stdout
    rows = [orjson.loads(line) for line in marked.splitlines()]
    assert [row.pop("end", None) for row in rows] == [False, None, None, True]
    assert rows[3] == {"timestamp": "0.1000000000", "records": 3}
    assert rows[:3] == [orjson.loads(line) for line in plain.splitlines()]
    monkeypatch.setenv("AVCLI_MARK_END", "1")
    assert copied(stdin=DETECTION * 3).stdout == marked
    assert copied(stdin=b"").stdout == b'{"timestamp":"0.0000000000","end":true,"records":0}\n'


def test_a_stream_is_judged_by_the_mark_that_it_announced():
    first = DETECTION.replace(b"}\n", b',"end":false}\n')
    mark = b'{"timestamp":"0.1","end":true,"records":3}\n'
    cut = "copy-records: <stdin>: ended before its end mark: its writer was stopped, or the end was cut off\n"
    short = "copy-records: <stdin>: has 2 of the 3 records that its end mark counts\n"
    for stdin, count, said in [
        (DETECTION * 3, 3, ""),
        (first + DETECTION * 2 + mark, 3, ""),
        (first + DETECTION * 2, 3, cut),
        (first + DETECTION + mark, 2, short),
        (DETECTION + mark.replace(b"3", b"1"), 1, ""),
        ((first + DETECTION * 2 + mark) * 2, 6, ""),
        ((first + DETECTION * 2 + mark) + first, 4, cut),
        (first + first + DETECTION * 4 + mark + mark, 6, ""),
        (b"", 0, ""),
    ]:
        ended = copied(stdin=stdin)
        assert (ended.returncode, len(ended.stdout.splitlines()), ended.stderr) == (0, count, said)
        ended = copied("--complete", stdin=stdin)
        assert (ended.returncode, ended.stderr) == (int(bool(said)), said)


def test_marks_are_left_out_where_a_file_is_loaded(tmp_path):
    path = tmp_path / "v.jsonl"
    path.write_bytes(copied("--mark-end", stdin=DETECTION).stdout.replace(b'"count":1', b'"objects":[]'))
    assert len(records.load(path)) == 1


def test_a_writer_that_fails_writes_no_mark():
    ended = copied("--mark-end", stdin=DETECTION + b"nonsense\n")
    assert (ended.returncode, b'"end":true' in ended.stdout) == (1, False)


# --- signals ----------------------------------------------------------------------------------------------------------


def test_a_second_signal_ends_a_clean_up_that_hangs():
    command = (
        "import click, sys, time; from avcli.commands.filter import Filter, common\n"
        "@click.command('slow', cls=Filter)\n@common()\ndef main(session):\n"
        "    try:\n        print('up', flush=True)\n        time.sleep(600)\n"
        "    finally:\n        print('cleaning', flush=True)\n        time.sleep(600)\nmain()"
    )
    for first, second in ((signal.SIGTERM, signal.SIGTERM), (signal.SIGINT, signal.SIGTERM)):
        process = subprocess.Popen([sys.executable, "-c", command], stdout=subprocess.PIPE)
        assert process.stdout.readline() == b"up\n"
        process.send_signal(first)
        assert process.stdout.readline() == b"cleaning\n"
        process.send_signal(second)
        assert process.wait(timeout=300) == -second
        process.stdout.close()


def test_a_picture_that_is_still_being_read_does_not_hold_the_end(tmp_path):
    fifo = tmp_path / "slow"
    os.mkfifo(fifo)
    command = (
        "import signal, sys; from avcli.commands.filter import Filter, common; from avcli.formats import footage\n"
        "import click\n@click.command('slow', cls=Filter)\n@common()\ndef main(session):\n"
        "    shot = footage.UnreadShot(0.0, lambda: open(sys.argv[1]).read(), None)\n"
        "    print('up', flush=True)\n"
        "    for one in footage.decoded_ahead([shot] * 9, rgb=True, depth=False): one.rgb()\nmain([])"
    )
    process = subprocess.Popen([sys.executable, "-c", command, fifo], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    writer = os.open(fifo, os.O_WRONLY)  # returns when the worker has opened the other end
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=300) == -signal.SIGTERM
    os.close(writer)
    assert process.stderr.read() == b""
    process.stdout.close()
    process.stderr.close()


@pytest.mark.parametrize(("closing", "status", "said"), [(">&-", 74, "standard output is closed"), ("2>&-", 0, "")])
def test_a_closed_stream_is_an_error_or_nothing(tmp_path, closing, status, said):
    (tmp_path / "d.jsonl").write_bytes(DETECTION + b"{}\n")  # the second line is skipped, which is said
    program = "from avcli.commands.avfuse import main; main()"
    line = f'exec "$0" -c "$1" --skip-invalid d.jsonl {closing}'
    ended = subprocess.run(["sh", "-c", line, sys.executable, program], cwd=tmp_path, capture_output=True, text=True)
    assert (ended.returncode, len(ended.stderr.splitlines())) == (status, bool(said))
    assert said in ended.stderr
    assert all(line.startswith("{") for line in ended.stdout.splitlines())
    assert bool(ended.stdout) == (closing == "2>&-")
