"""avfuse as a real process: merging, live output, bad input, the thesis's listings."""

import json
import os
import re
import select
import subprocess

import jsonschema
import numpy as np
import pytest
from conftest import BIN, ROOT, run, schema

from avcli.formats import records
from avcli.formats.experiment import read_config
from avcli.tracking import track
from avcli.tracking.trackers import TRACKERS

LISTING = (
    r'{"timestamp": "0.0000000000", "objects": [{"position": [-0.63, 2.34, 0.52]}]}\n '
    r'{"timestamp": "0.1000000000", "objects": [{"position": [-0.62, 2.34, 0.46]}]}\n '
    r'{"timestamp": "0.2000000000", "objects": [{"position": [-0.44, 2.29, 0.35]}]}\n '
    r'{"timestamp": "0.3000000000", "objects": [{"position": [-0.12, 2.31, 0.83]}]}\n '
    r'{"timestamp": "0.4000000000", "objects": [{"position": [0.13, 2.37, 1.01]}]}\n '
    r'{"timestamp": "0.5000000000", "objects": [{"position": [0.30, 2.35, 0.97]}]}\n '
    r'{"timestamp": "0.6000000000", "objects": []}' + "\n"
)
"""The thesis's Listing .4, its separators as printed."""

GUESSED = "avfuse: sensor '{name}': kind '{kind}' is guessed from its name; state it in \"sensors\" of config.json\n"


KINDS = {"video": "camera", "audio": "microphones"}


def line(time, positions=(), sensor="video", **more):
    """One localization record."""
    record = {"timestamp": f"{time:.10f}", "objects": [{"position": list(p), **more} for p in positions]}
    named = {"sensor": sensor} if sensor else {}
    return json.dumps({**record, **named, "kind": KINDS.get(sensor, "camera")}) + "\n"


def walk(sensor="video", steps=20, seed=0, people=1, begin=0.0, sigma=0.1):
    """Lines of someone who walks along x at 1 m/s (others beside them)."""
    rng = np.random.default_rng(seed)
    return [
        line(
            begin + k / 10,
            [
                [0.5 + k / 10 + sigma * rng.standard_normal(), 1.0 + p + sigma * rng.standard_normal()]
                for p in range(people)
            ],
            sensor,
        )
        for k in range(steps)
    ]


def fuse(lines, *options):
    """The records that avfuse makes of lines on its standard input."""
    result = run("avfuse", *options, stdin="".join(lines))
    assert (result.returncode, result.stderr) == (0, "")
    return [json.loads(text) for text in result.stdout.splitlines()]


@pytest.fixture
def experiment(tmp_path):
    (tmp_path / "config.json").write_text('{"room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]}}')
    return tmp_path


def test_a_record_of_tracks_has_all_its_fields():
    records = fuse(walk() + walk("audio", seed=1), "--max-wait", "inf")
    assert [r["timestamp"] for r in records] == [f"{k / 10:.10f}" for k in range(20)]
    (person,) = records[-1]["objects"]
    assert person["object_id"] == 0
    assert np.hypot(person["position"][0] - 2.4, person["position"][1] - 1.0) < 0.15
    assert person["position"][2] == 0.0
    assert abs(person["velocity"][0] - 1.0) < 0.3
    assert np.linalg.eigvalsh(person["covariance"]).min() > 0
    assert 0.9 < person["existence"] <= 1
    assert 0.5 < person["speaking"] <= 1


def test_one_stream_several_files_and_any_order_give_the_same_tracks(tmp_path):
    video, audio = walk(people=2), walk("audio", seed=1)
    (tmp_path / "v.jsonl").write_text("".join(video))
    (tmp_path / "a.jsonl").write_text("".join(audio))
    files = run("avfuse", tmp_path / "a.jsonl", tmp_path / "v.jsonl").stdout
    named = run("avfuse", "--sensor", f"audio={tmp_path / 'a.jsonl'}", tmp_path / "v.jsonl").stdout
    woven = [one for pair in zip(video, audio, strict=True) for one in pair]
    swapped = woven[:4] + [woven[k ^ 2] for k in range(4, len(woven))]  # neighbours in time change places
    repeated = [one for one in woven for _ in range(2)]
    assert files.count(b"\n") == 20
    for other in (named, *(run("avfuse", "--rate", "10", stdin="".join(x)).stdout for x in (woven, swapped, repeated))):
        assert other == files


def test_the_order_of_detections_and_the_hash_seed_do_not_matter():
    lines = walk(people=3)
    shuffled = []
    for text in lines:
        record = json.loads(text)
        record["objects"].reverse()
        shuffled.append(json.dumps(record) + "\n")
    one = run("avfuse", stdin="".join(lines), env={"PYTHONHASHSEED": "1"}).stdout
    assert run("avfuse", stdin="".join(shuffled), env={"PYTHONHASHSEED": "2"}).stdout == one


def test_a_track_leaves_as_soon_as_its_step_is_complete(experiment):
    with subprocess.Popen(
        [BIN / "avfuse", "-C", experiment, "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
    ) as process:
        for video, audio in list(zip(walk(), walk("audio", seed=1), strict=True))[:2]:
            process.stdin.write((video + audio).encode())
        assert select.select([process.stdout], [], [], 20)[0], "the first step is complete"
        assert json.loads(os.read(process.stdout.fileno(), 65536).splitlines()[0])["timestamp"] == "0.0000000000"
        process.stdin.close()
        assert process.wait() == 0


def test_live_a_track_leaves_with_its_record_and_a_frozen_sensor_does_not_freeze_the_tracks(experiment):
    fifos = [experiment / "a.fifo", experiment / "v.fifo", experiment / "never.fifo"]
    for fifo in fifos:
        os.mkfifo(fifo)
    command = [BIN / "avfuse", "-C", experiment, "--live", "--max-wait", "0.2", *fifos]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        with open(fifos[1], "wb", buffering=0) as video:
            with open(fifos[0], "wb", buffering=0) as audio:
                audio.write(line(0.0, [[1, 1]], "audio").encode())
                for k in range(5):  # the microphones have nothing more to say, and the third pipe has no writer
                    video.write(line(k / 10, [[1, 1]]).encode())
                    assert json.loads(process.stdout.readline())["timestamp"]
            open(fifos[2], "wb").close()
        times = [float(json.loads(text)["timestamp"]) for text in process.stdout]  # of the pauses in between
        warnings = process.stderr.read().decode()
        assert process.wait() == 0
    assert "never.fifo has no record after 0.2 s (--max-wait); it is not waited for" in warnings
    assert "sensor 'audio' has been quiet for more than 0.2 s (--max-wait); its records are not waited for" in warnings
    assert all(time >= 0.4 for time in times)


@pytest.mark.slow
def test_fifos_give_what_files_give_though_one_branch_delivers_at_its_end(experiment):
    """A common source, 20 s: the microphones' branch writes nothing before its end, and no pipe holds so much."""
    video = experiment / "video.jsonl"
    video.write_text("".join(line(k / 10, [[1 + k % 30 / 10, 2.0]], note="x" * 1000) for k in range(200)))
    as_audio = "sed 's/video/audio/; s/camera/microphones/'"
    script = f"""
        set -e; mkfifo truth v.fifo a.fifo
        (tac truth | tac | {as_audio} >a.fifo) & (tee truth <video.jsonl >v.fifo) &
        "$0" -q -c config.json a.fifo v.fifo >fifos.jsonl; wait
        {as_audio} video.jsonl >a.jsonl; "$0" -q -c config.json a.jsonl video.jsonl >files.jsonl
        (tee truth <video.jsonl >v.fifo) & ({as_audio} truth >a.fifo) &
        "$0" -q -c config.json v.fifo a.fifo >again.jsonl; wait
        cmp fifos.jsonl files.jsonl && cmp again.jsonl files.jsonl
    """
    result = run("bash", "-c", script, BIN / "avfuse", cwd=experiment)
    assert (result.returncode, result.stderr) == (0, "")
    assert (experiment / "files.jsonl").read_text().count("\n") == 200


def test_a_source_that_keeps_the_others_waiting_is_named(experiment):
    for name in ("a.fifo", "v.fifo"):
        os.mkfifo(experiment / name)
    command = [BIN / "avfuse", "-C", experiment, experiment / "a.fifo", experiment / "v.fifo"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        with open(experiment / "v.fifo", "wb", buffering=0) as video:
            video.write(line(0.0).encode())
            assert process.stderr.readline().decode() == f"avfuse: waiting for {experiment / 'a.fifo'}\n"
            (experiment / "a.fifo").write_text(line(0.0, sensor="audio"))
        assert process.stdout.read().count(b"\n") == 1
        assert process.wait() == 0


def test_clocks_that_have_no_time_in_common_are_asked_about(tmp_path):
    for name, begin in (("a", 0.0), ("b", 1.7e9), ("c", 1.7e9 + 1)):
        (tmp_path / f"{name}.jsonl").write_text("".join(line(begin + k / 10, sensor=name) for k in range(21)))
    said = "sensor 'a': its records, from 0.0 to 2.0 s, have no time in common with those of another sensor"
    result = run("avfuse", *(tmp_path / f"{name}.jsonl" for name in "abc"))
    assert (result.returncode, result.stderr.count("no time in common")) == (0, 1)
    assert said in result.stderr
    assert "no time in common" not in run("avfuse", tmp_path / "a.jsonl").stderr


def test_two_files_of_one_sensor_at_the_same_times_are_asked_about(tmp_path):
    for name, begin in (("left", 0.0), ("right", 0.03), ("later", 5.0)):
        (tmp_path / f"{name}.jsonl").write_text("".join(line(begin + k / 10) for k in range(21)))
    left, right, later = (tmp_path / f"{name}.jsonl" for name in ("left", "right", "later"))
    said = f"{left} and {right} have records of it at the same times"
    assert run("avfuse", left, right).stderr.count(said) == 1
    assert "at the same times" not in run("avfuse", left, later).stderr


def test_times_in_milliseconds_are_asked_about(experiment):
    result = run("avfuse", "-C", experiment, stdin="".join(line(100.0 * k) for k in range(5)))
    said = "no sensor has a record for more than 10 s; the tracks go on with the next record; are the times in seconds?"
    assert said in result.stderr


@pytest.mark.parametrize("far", [600.0, 3000.0, 1e11])
def test_one_wrong_time_does_not_make_thousands_of_records(experiment, far):
    lines = walk(steps=41)
    lines.insert(20, line(far, [[1.0, 1.0]]))
    result = run("avfuse", "-C", experiment, stdin="".join(lines))
    assert result.returncode == 0
    assert result.stderr == "avfuse: no sensor has a record for more than 10 s; the tracks go on with the next record\n"
    times = [json.loads(text)["timestamp"] for text in result.stdout.splitlines()]
    assert times == [f"{k / 10:.10f}" for k in range(41)] + [f"{far:.10f}"]


def test_an_explanation_does_not_overwrite_an_input(tmp_path):
    path = tmp_path / "in.jsonl"
    path.write_text("".join(walk()))
    before = path.read_bytes()
    link = tmp_path / "link.jsonl"
    link.symlink_to(path)
    config = tmp_path / "config.json"
    config.write_text(kept := "{}")
    for explain in (path, link, config):
        result = run("avfuse", path, "-c", config, "--explain", explain)
        assert result.returncode == 2
        assert "is an input" in result.stderr
    assert path.read_bytes() == before
    assert config.read_text() == kept


def test_ground_truth_and_tracks_are_not_detections(experiment, finished_s1):
    for path in (finished_s1 / "groundtruth_sources.jsonl", finished_s1 / "tracking" / "video_tracking.jsonl"):
        result = run("avfuse", "-C", finished_s1, path)
        assert result.returncode == 1
        assert result.stdout == b""
        assert result.stderr.startswith(f"avfuse: {path}:1: ")
        assert "not detections" in result.stderr
        assert result.stderr.count("\n") == 1


def test_one_record_for_every_tick_whatever_is_missing_or_added(experiment):
    video, audio = walk(steps=41), walk("audio", steps=41, begin=0.03)
    del video[17], video[5:7]
    records = fuse(sorted(video + audio, key=lambda t: json.loads(t)["timestamp"]), "-C", experiment)
    assert [r["timestamp"] for r in records] == [f"{k / 10:.10f}" for k in range(41)]


def test_the_rate_is_found_given_or_configured(experiment):
    lines = [line(k / 25, [[1.0, 1.0]]) for k in range(26)]
    assert [r["timestamp"] for r in fuse(lines)][:3] == ["0.0000000000", "0.0400000000", "0.0800000000"]
    assert len(fuse(lines, "--rate", "5")) == 6
    assert len(fuse(lines, "-C", experiment)) == 11


def test_unix_time_off_the_grid_is_kept():
    begin = 1.7e9 + 0.037
    records = fuse(walk(begin=begin))
    assert [r["timestamp"] for r in records][:2] == [f"{begin:.10f}", f"{begin + 0.1:.10f}"]
    assert len(records) == 20
    assert len(records[5]["objects"]) == 1


def test_a_lagging_sensor_is_not_waited_for_and_a_warning_says_so(experiment):
    result = run("avfuse", "-C", experiment, stdin="".join(walk(steps=40) + walk("audio", steps=40)))
    assert result.returncode == 0
    assert "'audio'" in result.stderr
    assert "not waited for" in result.stderr or "too late" in result.stderr
    assert result.stdout.count(b"\n") == 40


def test_one_sensor_after_the_other_in_one_stream(experiment):
    video, audio = walk(steps=40), walk("audio", steps=40, seed=1)
    woven = [one for pair in zip(video, audio, strict=True) for one in pair]
    assert fuse(audio + video, "-C", experiment, "--max-wait", "inf") == fuse(woven, "-C", experiment)


def test_the_thesis_listing_loads_as_it_stands(experiment):
    (experiment / "video_localizations.jsonl").write_text(LISTING)
    for options in ((), ("--preset", "thesis")):
        result = run("avfuse", "-C", experiment, *options, experiment / "video_localizations.jsonl")
        assert result.returncode == 0
        assert result.stderr == GUESSED.format(name="video", kind="camera")
        records = [json.loads(text) for text in result.stdout.splitlines()]
        assert [r["timestamp"] for r in records] == [f"{k / 10:.10f}" for k in range(7)]
        assert len(records[5]["objects"]) == 1


def test_detections_outside_the_room_are_dropped_by_margin(experiment):
    lines = [line(k / 10, [[-0.6, 2.0]]) for k in range(9)]  # of more the program would say so
    assert not any(r["objects"] for r in fuse(lines, "-C", experiment))
    assert all(r["objects"] for r in fuse(lines, "-C", experiment, "--room-margin", "1"))
    assert all(r["objects"] for r in fuse(lines))


def test_a_sensor_whose_detections_lie_outside_the_room_is_named(experiment):
    """In millimetres, or with y downwards, nobody is tracked."""
    far = [line(k / 10, [[2000.0 + k, 1000.0]]) for k in range(30)]
    result = run("avfuse", "-C", experiment, stdin="".join(far))
    assert result.stderr.count("outside the room of config.json") == 1
    assert "sensor 'video': 10 of 10 detections so far" in result.stderr
    some = [line(k / 10, [[1.0, 1.0], [1.0, 2.0], [2000.0, 1000.0]]) for k in range(30)]
    assert "outside" not in run("avfuse", "-C", experiment, stdin="".join(some)).stderr


@pytest.mark.parametrize("text", ["", "\n\n", line(0.0), line(0.0, [[1, 1, None]]), line(0, [[1, 1]], None)])
def test_hardly_any_input(text):
    result = run("avfuse", "-q", stdin=text)
    assert (result.returncode, result.stderr) == (0, "")
    records = result.stdout.splitlines()
    assert len(records) == (1 if text.strip() else 0)


def test_bad_input_is_located_or_skipped():
    bad = ["no json\n", '{"timestamp": 1}\n', line(0.5, [[1, None]]), '{"timestamp":"x","objects":[]}\n']
    good = walk()
    for text in bad:
        result = run("avfuse", stdin="".join([*good[:3], text]))
        assert result.returncode == 1
        assert result.stderr.startswith("avfuse: <stdin>:4")
        assert result.stderr.count("\n") == 1
    result = run("avfuse", "--skip-invalid", stdin="".join([*good[:3], *bad, *good[3:]]))
    assert result.returncode == 0
    assert "skipped 3 invalid records" in result.stderr
    assert "skipped 1 invalid object" in result.stderr
    assert result.stdout.count(b"\n") == 20


@pytest.mark.parametrize("steps", [1, 5, 20])
@pytest.mark.parametrize("lag", [0, 5])
def test_what_came_before_a_broken_line_is_tracked(tmp_path, steps, lag):
    lines, path = walk(steps=steps), tmp_path / "tracks.jsonl"
    whole = run("avfuse", "--lag", lag, stdin="".join(lines))
    broken = "".join([*lines, '{"timestamp":'])
    result = run("avfuse", "--lag", lag, stdin=broken)
    assert (result.returncode, result.stdout) == (1, whole.stdout)
    assert result.stderr.startswith(f"avfuse: <stdin>:{steps + 1}")
    assert run("avfuse", "--lag", lag, "-o", path, stdin=broken).returncode == 1
    assert not path.exists()


@pytest.mark.parametrize(
    "options",
    [
        ("--sigma", "video"),
        ("--sigma", "video=x"),
        ("--detection", "video=2"),
        ("--lag", "-1"),
        ("--sensor", "video="),
        ("missing.jsonl",),
        ("--rate", "0"),
    ],
)
def test_wrong_usage(options):
    result = run("avfuse", *options, stdin=line(0.0))
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1


GIVEN = {
    "lag": ("--lag", "3"),
    "explain": ("--explain", "x"),
    "motion": ("--motion", "cv"),
    "process_noise": ("--process-noise", "0.3", "--motion", "cv"),
    "birth": ("--birth", "adaptive"),
    "stay": ("--stay", "3"),
    "doors": ("--doors", "anywhere"),
    "learn": ("--learn", "x"),
    "no_learn": ("--no-learn",),
    "map": ("--map", "x.png"),
    "show": ("--show", "all"),
    "hidden": ("--no-hidden",),
    "detection": ("--detection", "video=0.5"),
    "clutter": ("--clutter", "video=3"),
}


@pytest.mark.parametrize(
    ("options", "because"),
    [
        *((("--tracker", name, *GIVEN[key]), name) for name, one in TRACKERS.items() for key in sorted(one.unused)),
        (("--motion", "imm", "--process-noise", "3"), "imm"),
        (("--process-noise", "3"), "imm"),
        (("--room-margin", "1"), "config.json"),
        (("--lag", "3", "--show", "all"), "--lag"),
        (("--lag", "inf", "--show", "all"), "--lag"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_an_option_without_effect_is_refused_by_name(options, because):
    result = run("avfuse", *options, stdin=line(0.0))
    assert result.returncode == 2
    assert "has no effect" in result.stderr
    assert because in result.stderr
    assert any(word in result.stderr for word in options if word.startswith("--"))


def test_what_has_no_effect_may_come_from_a_preset_or_be_the_default():
    assert run("avfuse", "--tracker", "gnn", "--preset", "thesis", "-q", stdin=line(0.0)).returncode == 0
    assert run("avfuse", "--tracker", "gnn", "--lag", "0", "-q", stdin=line(0.0)).returncode == 0


def test_the_manual_describes_every_tracker_and_its_unused_options():
    page = (ROOT / "man" / "avfuse.1").read_text()
    described = page.split(".Ss Trackers")[1].split(".Sh OPTIONS")[0]
    entries = re.split(r"^\.It Fl -", page.split(".Sh OPTIONS")[1], flags=re.MULTILINE)
    assert "tracker Cm " + " | ".join(TRACKERS) + "\n" in page
    for name, one in TRACKERS.items():
        assert f".It Cm {name}\n" in described
        for key in one.unused - {"process_noise"}:  # which --motion cv alone uses
            (entry,) = (
                entry
                for entry in entries
                if entry.startswith((key.replace("_", "-") + " ", key.replace("_", "-") + "\n"))
            )
            assert name in entry.split("Not with")[1], (name, key)


def test_options_of_a_sensor_reach_it():
    lines = walk()
    default = fuse(lines)
    assert fuse(lines, "--sigma", "video=0.15") == default
    wide = fuse(lines, "--sigma", "video=0.5,0.5,0")
    assert wide[0]["objects"][0]["covariance"][0][0] == pytest.approx(0.25, abs=0.01)  # and the lasting error
    assert fuse(lines, "--sigma", "video=0.3,0")[0]["objects"][0]["covariance"][1][1] > 3.0  # y is not observed
    assert not fuse(lines, "--detection", "video=0", "--no-learn")[-1]["objects"]


def test_detections_of_which_no_track_comes_are_said():
    records = [json.loads(one) for one in walk(steps=80)]
    for record in records:
        record["objects"][0]["position"] = [1000 * x for x in record["objects"][0]["position"][:2]]
    result = run("avfuse", stdin="".join(json.dumps(record) + "\n" for record in records))
    assert "80 of 80 steps have detections, but " in result.stderr
    assert "are positions in metres" in result.stderr
    assert not run("avfuse", stdin="".join(walk(steps=80))).stderr


def test_options_of_a_kind_reach_all_its_sensors_and_those_of_a_name_win():
    lines = walk()
    wide = fuse(lines, "--sigma", "video=0.5")
    assert fuse(lines, "--sigma", "camera=0.5") == wide
    assert fuse(lines, "--sigma", "camera=0.1", "--sigma", "video=0.5") == wide
    assert fuse(lines, "--sigma", "microphones=0.5") == fuse(lines)
    records = [json.loads(one) for one in lines]
    for each in (each for record in records for each in record["objects"]):
        each["covariance"] = [[0.01, 0], [0, 0.01]]
    stated = "".join(json.dumps(record) + "\n" for record in records)
    for name in ("camera", "video"):
        result = run("avfuse", "--sigma", f"{name}=0.5", stdin=stated)
        assert result.stderr == (
            f"avfuse: --sigma {name} has no effect: all of its detections state a covariance, which counts\n"
        )
    result = run("avfuse", "--sigma", "vidoe=0.5", stdin="".join(lines))
    assert result.stderr == "avfuse: sensor 'vidoe' has options but sent no record\n"


@pytest.mark.parametrize("names", [("microphones", "ceiling"), ("video", "audio"), ("x1", "x2")])
def test_renaming_a_sensor_changes_no_track(experiment, names):
    """Which kind a sensor is stands in its records or in config.json; its name means nothing."""
    woven = [one for pair in zip(walk(), walk("audio", seed=1), strict=True) for one in pair]
    expected = run("avfuse", "-C", experiment, stdin="".join(woven)).stdout
    stated, configured = [], []
    for text in woven:
        record = json.loads(text)
        record["sensor"] = names[record["sensor"] == "audio"]
        stated.append(json.dumps(record) + "\n")
        del record["kind"]
        configured.append(json.dumps(record) + "\n")
    assert run("avfuse", "-C", experiment, stdin="".join(stated)).stdout == expected
    config = json.loads((experiment / "config.json").read_text())
    config["sensors"] = {name: {"kind": kind} for name, kind in zip(names, KINDS.values(), strict=True)}
    (experiment / "config.json").write_text(json.dumps(config))
    result = run("avfuse", "-C", experiment, stdin="".join(configured))
    assert (result.stdout, result.stderr) == (expected, b"" if isinstance(result.stderr, bytes) else "")


def test_a_guessed_kind_is_said_once(experiment):
    lines = [text.replace(', "kind": "camera"', "") for text in walk()]
    result = run("avfuse", "-C", experiment, stdin="".join(lines))
    assert result.stderr == GUESSED.format(name="video", kind="camera")
    assert result.stdout == run("avfuse", "-C", experiment, stdin="".join(walk())).stdout


@pytest.mark.parametrize("lag", [0, 3])
def test_the_library_gives_what_the_command_gives(experiment, lag):
    seen, heard = (
        [records.detections(records.decode(text.encode())) for text in lines]
        for lines in (walk(people=2), walk("audio", seed=1))
    )
    (experiment / "v.jsonl").write_text("".join(walk(people=2)))
    (experiment / "a.jsonl").write_text("".join(walk("audio", seed=1)))
    files = experiment / "a.jsonl", experiment / "v.jsonl"
    out = run("avfuse", "-C", experiment, "--lag", str(lag), *files).stdout
    tracks = track(read_config(experiment / "config.json"), heard, iter(seen), lag=lag)
    assert b"".join(records.encode(records.as_record(one)) for one in tracks) == out


def test_an_unknown_tracker_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="there are ms-glmb, lmb, gnn, jpda"):
        track(None, [], tracker="glmb")
    with pytest.raises(ValueError, match="cannot smooth"):
        track(None, [], tracker="gnn", lag=3)


def test_without_hidden_states_a_few_misses_end_a_track():
    lines = walk(steps=40)
    lines = lines[:30] + [line(k / 10) for k in range(30, 40)]
    assert fuse(lines)[32]["objects"]
    assert not fuse(lines, "--no-hidden", "--no-learn")[32]["objects"]


def test_a_config_with_half_a_camera_tracks_without_one(experiment):
    (experiment / "config.json").write_text(
        '{"room_config": {"room_dimensions_m": [4.66, 4.66, 3.0]}, "camera_config": {"fx_px": 700}}'
    )
    result = run("avfuse", "-C", experiment, "-v", stdin="".join(walk()))
    assert result.returncode == 0
    assert "camera" in result.stderr


def test_lag_delays_smooths_and_keeps_every_step():
    lines = walk(steps=40, sigma=0.15, people=2)
    online, late, offline = (fuse(lines, "--lag", n) for n in ("0", "5", "inf"))
    assert [r["timestamp"] for r in late] == [r["timestamp"] for r in offline] == [r["timestamp"] for r in online]

    def error(records):
        return np.mean([abs(p["position"][1] - round(p["position"][1])) for r in records for p in r["objects"]])

    assert error(offline) < error(late) < error(online)


@pytest.mark.parametrize("tracker", list(TRACKERS))
def test_every_tracker_follows_three_people(tracker):
    if tracker == "jpda":
        pytest.importorskip("stonesoup", reason="Stone Soup is optional")
    records = fuse(walk(people=3, steps=30), "--tracker", tracker)
    assert {p["object_id"] for r in records for p in r["objects"]} == {0, 1, 2}
    assert len(records[-1]["objects"]) == 3


def test_every_record_is_accounted_for(tmp_path):
    lines, path = walk(people=2), tmp_path / "why.jsonl"
    assert fuse(lines, "--explain", path) == fuse(lines)
    accounts = [json.loads(text) for text in path.read_text().splitlines()]
    assert len(accounts) == len(lines)
    assert [b["object_id"] for b in accounts[0]["born"]] == [0, 1]
    last = accounts[-1]
    assert {p["object_id"] for p in last["people"]} == {0, 1}
    assert {p["most_likely"] for p in last["people"]} <= {0, 1, "missed"}
    assert all(abs(sum(h["weight"] for h in c["best"]) - 1) < 0.2 for c in last["clusters"])
    assert all(0 <= d["unclaimed"] <= 1 for d in last["detections"])
    assert run("avfuse", "--explain", tmp_path / "no" / "x", stdin=lines[0]).returncode != 0


def test_stone_soup_is_asked_for_by_name():
    result = run("avfuse", "--tracker", "jpda", stdin="".join(walk()))
    if result.returncode:
        assert result.returncode == 1
        assert result.stderr == "avfuse: --tracker jpda needs Stone Soup: pip install stonesoup\n"
    else:
        assert len(json.loads(result.stdout.splitlines()[-1])["objects"]) == 1


def test_an_explanation_is_as_its_schema_says(tmp_path):
    described = schema("explain")
    jsonschema.Draft202012Validator.check_schema(described)
    validator = jsonschema.Draft202012Validator(described)
    rng, lines = np.random.default_rng(4), []
    for k in range(120):  # two people, one of whom vanishes; the other is silent at times; false detections
        places = [[0.5 + 0.03 * k, 1.0]] + ([[3.0, 3.0]] if k < 30 else [])
        clutter = rng.uniform(0, 4.66, (rng.poisson(0.5), 2)).tolist()
        lines.append(
            line(k / 10, [*(np.array(places) + 0.1 * rng.standard_normal((len(places), 2))).tolist(), *clutter])
        )
        lines.append(line(k / 10, places[:1] if k % 20 < 10 else [], "audio"))
    path = tmp_path / "why.jsonl"
    fuse(lines, "--explain", path)
    records = [json.loads(text) for text in path.read_text().splitlines()]
    assert len(records) == len(lines)
    for record in records:
        validator.validate(record)
        assert set(record) == set(described["properties"])
    said = {what["most_likely"] for record in records for what in record["people"]}
    assert "missed" in said
    assert any(record["born"] for record in records)
    assert any(record["died"] for record in records)
