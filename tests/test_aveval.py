"""aveval as a process: what it reads, writes, refuses and how it ends."""

import csv
import io
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import BIN, refused, run, schema


def record(t, objects):
    return json.dumps({"timestamp": f"{t:.10f}", "objects": objects}) + "\n"


def walk(identity=0, y=2.33, offset=0.0, frames=41, height=0.0):
    return [(k / 10, identity, [0.33 + k / 10, y + offset, height]) for k in range(frames)]


def lines(*walks):
    rows = {}
    for at, identity, position in (row for each in walks for row in each):
        rows.setdefault(at, []).append({"object_id": identity, "position": position})
    return "".join(record(at, objects) for at, objects in sorted(rows.items()))


@pytest.fixture
def experiment(tmp_path):
    """An experiment s1 whose video tracks are 0.3 m off, and whose audio tracks see half of the walk."""
    folder = tmp_path / "s1"
    (folder / "tracking").mkdir(parents=True)
    (folder / "groundtruth_sources.jsonl").write_text(lines(walk()))
    (folder / "tracking" / "video_tracking.jsonl").write_text(lines(walk(5, offset=0.3)))
    half = "".join(lines(walk(1)).splitlines(keepends=True)[:20]) + "".join(record(k / 10, []) for k in range(20, 41))
    (folder / "tracking" / "audio_tracking.jsonl").write_text(half)
    return folder


def records_of(result):
    assert result.returncode == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_one_record_a_sequence_and_tracker_and_one_combined(experiment):
    truth, tracks = experiment / "groundtruth_sources.jsonl", experiment / "tracking" / "video_tracking.jsonl"
    result = run("aveval", truth, tracks)
    single, combined = records_of(result)
    assert result.stderr == ""
    assert (single["sequence"], single["tracker"]) == ("s1", "video")
    assert (combined["sequence"], combined["average"]) == ("combined", "micro")
    assert single["summary"]["HOTA"] == pytest.approx(17 / 19)
    assert combined["summary"] == single["summary"]
    assert len(single["HOTA"]["alpha"]) == len(single["HOTA"]["DetA"]) == 19
    assert single["HOTA"]["alpha"][:3] == [0.05, 0.1, 0.15]
    assert single["CLEAR"]["MOTA"] == single["Identity"]["IDF1"] == 1.0
    assert single["Count"] == {"Dets": 41, "GT_Dets": 41, "IDs": 1, "GT_IDs": 1, "Frames": 41}
    assert single["Position"]["RMSE"] == pytest.approx(0.3)
    assert single["summary"]["OSPA"] == pytest.approx(0.3)


def test_tracks_from_standard_input_and_the_same_bytes_twice(experiment):
    truth, tracks = experiment / "groundtruth_sources.jsonl", experiment / "tracking" / "video_tracking.jsonl"
    by_name, piped = run("aveval", truth, tracks), run("aveval", truth, "-", stdin=tracks.read_bytes())
    assert piped.stdout == by_name.stdout.replace(b'"tracker":"video"', b'"tracker":"stdin"')


def test_experiments_beside_the_thesis(experiment):
    second = experiment.parent / "s2"
    (second / "tracking").mkdir(parents=True)
    for name in ("groundtruth_sources.jsonl", "tracking/audio_tracking.jsonl", "tracking/video_tracking.jsonl"):
        (second / name).write_bytes((experiment / name).read_bytes())
    found = records_of(run("aveval", "--experiments", experiment, second))
    assert [(r["sequence"], r["tracker"]) for r in found] == [
        ("s1", "audio"),
        ("s1", "video"),
        ("s2", "audio"),
        ("s2", "video"),
        ("combined", "audio"),
        ("mean", "audio"),
        ("combined", "video"),
        ("mean", "video"),
    ]
    assert found[4]["sequences"] == ["s1", "s2"]
    text = run("aveval", "--experiments", experiment, "--format", "table", "--compare-thesis").stdout.decode()
    rows = [line.split() for line in text.splitlines()]
    assert rows[0] == ["s1", "HOTA", "DetA", "AssA", "DetRe", "DetPr", "AssRe", "AssPr", "LocA"]
    assert rows[4][:2] == ["video", "89.5"]
    assert rows[5][:2] == ["thesis", "80.0"]
    assert rows[6][:2] == ["difference", "+9.5"]
    table = run("aveval", "--experiments", experiment, "--format", "csv", "--compare-thesis").stdout.decode()
    row = next(csv.DictReader(io.StringIO(table)))
    assert float(row["HOTA_thesis"]) == 0.477
    assert float(row["HOTA_difference"]) == pytest.approx(float(row["HOTA"]) - 0.477)


@pytest.mark.parametrize("kind", ["table", "csv", "markdown", "latex"])
def test_every_format_has_every_tracker(experiment, kind):
    text = run("aveval", "--experiments", experiment, "--format", kind).stdout.decode()
    assert "audio" in text
    assert "video" in text
    assert ("0.8947" if kind == "csv" else "89.5") in text


def test_the_thesis_recovered_from_its_own_rows():
    """Table 5.10 is TrackEval's combination of the rows of 5.6 to 5.9: recall and precision follow from the counts."""
    from avcli.metrics.thesis import figures

    people = {"s1": 1, "s2": 1, "s3": 3, "s4": 3}
    for tracker in ("audio", "video", "audio_video"):
        rows = {name: figures({"sequence": name, "tracker": tracker}) for name in people}
        points = {name: 41 * count for name, count in people.items()}
        found = {name: rows[name]["DetRe"] * points[name] for name in people}
        recall = sum(found.values()) / sum(points.values())
        precision = sum(found.values()) / sum(found[name] / rows[name]["DetPr"] for name in people)
        combined = figures({"sequence": "combined", "sequences": list(people), "tracker": tracker})
        assert recall == pytest.approx(combined["DetRe"], abs=6e-4)
        # The rows are rounded to 0.1, so that the precision of few audio tracks is known to 0.1 only.
        assert precision == pytest.approx(combined["DetPr"], abs=1e-3)
    assert figures({"sequence": "s1-audio", "tracker": "audio"})["HOTA"] == 0.477
    assert figures({"sequence": "s12", "tracker": "audio"}) is None
    assert figures({"sequence": "combined", "sequences": ["s1"], "tracker": "audio"}) is None


def test_listing_5_of_the_thesis_as_printed(tmp_path):
    """Indented over many lines, ids from 0, the ground truth at z = 0."""
    text = ""
    for k in range(3):
        objects = [{"object_id": i, "position": [k / 10, 1.33 + i, 0.0]} for i in range(3)]
        text += json.dumps({"timestamp": f"{k / 10:.10f}", "objects": objects}, indent=2) + "\n"
    (tmp_path / "truth.jsonl").write_text(text)
    found = records_of(run("aveval", tmp_path / "truth.jsonl", "-", stdin=text))
    assert found[0]["summary"]["HOTA"] == 1.0
    assert found[0]["Count"]["GT_IDs"] == 3


def test_the_ground_truth_is_read_when_the_tracks_have_ended(tmp_path):
    """A whole pipeline starts at once, and its head writes the ground truth while its end waits for tracks."""
    command = [BIN / "aveval", "truth.jsonl", "-"]
    aveval = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path)
    first, rest = lines(walk()).split("\n", 1)
    aveval.stdin.write(first.encode() + b"\n")
    aveval.stdin.flush()
    time.sleep(0.3)
    (tmp_path / "truth.jsonl").write_text(lines(walk()))
    out, _ = aveval.communicate(rest.encode())
    assert json.loads(out.splitlines()[0])["summary"]["HOTA"] == 1
    missing = run("aveval", "nowhere.jsonl", "-", stdin=lines(walk()), cwd=tmp_path)
    assert (missing.returncode, missing.stderr.count("\n")) == (2, 1)


def test_a_short_sequence_needs_no_scipy(experiment):
    program = (
        "import sys\nfrom avcli.commands.aveval import main\n"
        "try: main()\nexcept SystemExit as end: assert not end.code\n"
        "heavy = {'scipy', 'matplotlib', 'cv2'} & set(sys.modules)\nassert not heavy, heavy"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, "--experiments", experiment, "-o", os.devnull], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr


# --- gates ------------------------------------------------------------------------------------------------------------


def test_fail_under(experiment):
    gate = lambda *texts: run(  # noqa: E731
        "aveval", "--experiments", experiment, *(w for text in texts for w in ("--fail-under", text))
    )
    assert gate("video:HOTA=89", "video:MOTA=100").returncode == 0
    low = gate("HOTA=70")
    assert low.returncode == 3
    assert low.stderr == "aveval: audio: HOTA is 48.78, below 70\n"
    assert len(low.stdout.splitlines()) == 4
    assert gate("radar:HOTA=1").returncode == 3
    assert "--fail-under: HOTTA=1 must be [TRACKER:]NAME=PERCENT" in gate("HOTTA=1").stderr
    assert gate("HOTTA=1").returncode == 2
    assert gate("HOTA").returncode == 2


# --- bad input --------------------------------------------------------------------------------------------------------


def scored(tmp_path, truth, tracks, *options):
    (tmp_path / "truth.jsonl").write_text(truth)
    return run("aveval", tmp_path / "truth.jsonl", "-", *options, stdin=tracks)


def test_nothing_on_either_side(tmp_path):
    nobody = scored(tmp_path, lines(walk()), "")
    assert "there are no tracks, so all people are missed" in nobody.stderr
    found = records_of(nobody)[0]
    assert found["summary"]["HOTA"] == 0
    assert found["HOTA"]["HOTA_FN"] == [41] * 19
    assert found["summary"]["RMSE"] is None
    nothing = scored(tmp_path, "", lines(walk()))
    assert "the ground truth has no objects" in nothing.stderr
    neither = scored(tmp_path, "", "").stderr
    assert "there are no tracks either; that is right" in neither
    assert "missed" not in neither
    assert records_of(nothing)[0]["HOTA"]["HOTA_FP"] == [41] * 19
    assert records_of(scored(tmp_path, "", ""))[0]["Count"]["Frames"] == 0
    table = scored(tmp_path, lines(walk()), "", "--format", "table")
    assert " - " in table.stdout.decode()


def test_standard_input_is_named_once_and_no_page_replaces_an_input(tmp_path):
    for paths in (("-", "-"), (tmp_path / "truth.jsonl", "-", "--detections", "-")):
        (tmp_path / "truth.jsonl").write_text(lines(walk()))
        refused(run("aveval", *paths, stdin=lines(walk())), "standard input ('-') is named twice", status=2)
    for command in ("aveval", "avview"):
        truth = tmp_path / "truth.jsonl"
        refused(run(command, truth, truth, "--html", truth), "this file is an input", status=2)
        assert truth.read_text() == lines(walk())


def test_what_does_not_match_in_time_is_said(tmp_path):
    late = "".join(record(k / 10 + 0.02, [{"object_id": 1, "position": [0.33 + k / 10, 2.33]}]) for k in range(41))
    result = scored(tmp_path, lines(walk()), late)
    assert "41 of 41 ground-truth records have no track record within 1 ms; their 41 points count as missed" in (
        result.stderr
    )
    assert "41 of 41 track records have no ground truth within 1 ms; their 41 points count as false" in result.stderr
    assert records_of(result)[0]["summary"]["HOTA"] == 0
    assert records_of(scored(tmp_path, lines(walk()), late, "--tolerance", "0.03"))[0]["summary"]["HOTA"] == 1


def test_tracks_in_another_unit_or_frame_are_said(tmp_path):
    result = scored(tmp_path, lines(walk()), lines(walk(offset=20.0)))
    assert "no track comes within 2 m (--d0) of anybody; the tracks lie in x " in result.stderr
    assert "no track comes" not in scored(tmp_path, lines(walk()), lines(walk(offset=0.5))).stderr


def test_unsorted_records_are_sorted(tmp_path):
    backwards = "".join(reversed(lines(walk()).splitlines(keepends=True)))
    result = scored(tmp_path, lines(walk()), backwards)
    assert "40 records were out of order" in result.stderr
    assert records_of(result)[0]["summary"]["HOTA"] == 1


def test_repeated_identities(tmp_path):
    twice = lines(walk()) + lines(walk(frames=1))
    refused = scored(tmp_path, lines(walk()), twice)
    assert refused.returncode == 1
    assert "identity 0 occurs twice at 0 s in the tracks" in refused.stderr
    dropped = scored(tmp_path, lines(walk()), twice, "--skip-invalid")
    assert "1 points dropped" in dropped.stderr
    assert records_of(dropped)[0]["summary"]["HOTA"] == 1
    inside = record(0, [{"object_id": 0, "position": [0, 0]}, {"object_id": 0, "position": [1, 0]}])
    refused = scored(tmp_path, lines(walk()), inside)
    assert (refused.returncode, refused.stdout) == (1, b"")
    assert refused.stderr.startswith("aveval: <stdin>:1: ")


@pytest.mark.parametrize(
    "bad", ['{"timestamp":"0.1","objects":[{"object_id":1,"position":[NaN,0]}]}', '{"objects":[]}', "nonsense"]
)
def test_bad_lines_are_located(tmp_path, bad):
    refused = scored(tmp_path, lines(walk()), lines(walk(frames=1)) + bad + "\n")
    assert refused.returncode == 1
    assert refused.stderr.startswith("aveval: <stdin>:2:")
    assert refused.stderr.count("\n") == 1
    kept = scored(tmp_path, lines(walk(frames=1)), lines(walk(frames=1)) + bad + "\n", "--skip-invalid")
    assert records_of(kept)[0]["summary"]["HOTA"] == 1
    assert "skipped 1 invalid" in kept.stderr


@pytest.mark.parametrize(
    "bad",
    [
        '{"timestamp":"0.1","objects":[{"object_id":[1],"position":[1,2]},{"object_id":0,"position":[0.43,2.33]}]}',
        '{"timestamp":"0.1","objects":[{"object_id":true,"position":[1,2]},{"object_id":0,"position":[0.43,2.33]}]}',
        '{"timestamp":"0.1","objects":[{"object_id":0,"position":[1e308,-1e308,1e308]}]}',
        '{"timestamp":"0.1","objects":[{"object_id":0,"position":[0.43,2.33],"speaking":"x","bbox_px":[1,"a"]}]}',
        '{"timestamp":1e308,"objects":[{"object_id":0,"position":[0.43,2.33]}]}',
    ],
)
def test_wild_values_do_no_harm(tmp_path, bad):
    tracks = lines(walk(frames=1)) + bad + "\n"
    (tmp_path / "truth.jsonl").write_text(lines(walk(frames=2)))
    (tmp_path / "tracks.jsonl").write_text(tracks)
    (tmp_path / "found.jsonl").write_text(tracks.replace("object_id", "own_id"))
    more = ("--skip-invalid", "--detections", "found.jsonl", "--html", "r.html", "--dims", "2", "-q")
    result = run("aveval", "truth.jsonl", "tracks.jsonl", *more, cwd=tmp_path, env={"PYTHONWARNINGS": "error"})
    assert records_of(result)[0]["summary"]["HOTA"] > 0.3
    assert "Warning" not in result.stderr


def test_heights(tmp_path):
    high = lines(walk(height=1.5))
    assert records_of(scored(tmp_path, lines(walk()), high))[0]["summary"]["HOTA"] == 1
    result = scored(tmp_path, lines(walk()), high, "--dims", "3")
    assert "tracks are +1.50 m from the ground truth in height on average" in result.stderr
    assert records_of(result)[0]["summary"]["HOTA"] == pytest.approx(5 / 19)
    flat = record(0, [{"object_id": 0, "position": [1, 2]}])
    assert records_of(scored(tmp_path, flat, flat))[0]["summary"]["HOTA"] == 1
    refused = scored(tmp_path, flat, flat, "--dims", "3")
    assert refused.returncode == 1
    assert "has no height" in refused.stderr


def test_wrong_usage(experiment, tmp_path):
    truth = experiment / "groundtruth_sources.jsonl"
    for arguments in (
        [],
        [truth],
        [truth, tmp_path / "nowhere.jsonl"],
        ["--experiments"],
        ["--experiments", tmp_path],
        [truth, truth, truth],
        [truth, "-", "--d0", "0"],
    ):
        result = run("aveval", *arguments)
        assert result.returncode == 2, arguments
        assert result.stdout == b""
        assert result.stderr.count("\n") == 1


def test_options_without_effect_are_refused_by_name(experiment, tmp_path):
    truth, tracks = experiment / "groundtruth_sources.jsonl", experiment / "tracking" / "video_tracking.jsonl"
    for option in (("--rate", "20"), ("--compare-thesis",)):
        refused = run("aveval", truth, tracks, *option)
        assert (refused.returncode, refused.stdout) == (2, b"")
        assert f"{option[0]} has no effect with" in refused.stderr
    for good in (("--preset", "thesis"), ("--compare-thesis", "--format", "csv")):
        assert run("aveval", truth, tracks, *good).returncode == 0
    assert run("aveval", truth, tracks, "--compare-thesis", "--html", tmp_path / "r.html").returncode == 0


def test_two_files_of_one_name_are_told_apart(experiment, tmp_path):
    truth = experiment / "groundtruth_sources.jsonl"
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "tracks.jsonl").write_bytes(truth.read_bytes())
    found = records_of(run("aveval", truth, "a/tracks.jsonl", "b/tracks.jsonl", cwd=tmp_path))
    assert [r["tracker"] for r in found[:2]] == ["a/tracks.jsonl", "b/tracks.jsonl"]


def test_all_records_follow_the_schema(tmp_path):
    jsonschema = pytest.importorskip("jsonschema")

    from test_metrics_report import experiment

    described = schema("metrics")
    experiment(tmp_path / "s3")
    experiment(tmp_path / "s1", people=1)
    (tmp_path / "s1" / "tracking" / "audio_tracking.jsonl").write_text("")
    detections = ("--detections", "localization/audio_localizations.jsonl")
    found = records_of(run("aveval", "--experiments", "s1", "s3", *detections, cwd=tmp_path))
    assert len(found) == 6 + 2 + 6 + 1
    for each in found:
        jsonschema.validate(each, described)


def test_a_name_that_is_no_utf8_is_shown(tmp_path):
    truth, tracks = tmp_path / "t.jsonl", tmp_path / "tr\udce9.jsonl"
    for path in (truth, tracks):
        path.write_text('{"timestamp":0,"objects":[{"object_id":1,"position":[1,1,0]}]}\n')
    result = run("aveval", truth, tracks, "--html", tmp_path / "e.html", "--plot", tmp_path / "e.png")
    assert (result.returncode, result.stderr) == (0, "")
    assert json.loads(result.stdout.splitlines()[0])["tracker"] == "tr�"
    assert run("aveval", truth, tracks, "--format", "table").returncode == 0


def test_what_config_json_states_is_drawn_without_the_rest(tmp_path):
    from avcli.formats.experiment import Config
    from avcli.metrics.run import Run, with_surroundings

    camera = {"fx_px": 500, "fy_px": 500, "cx_px": 320, "cy_px": 240, "camera_position_m": [2, 1, 3]}
    said = []
    shown = with_surroundings(Run("run", [], {}), Config({"camera_config": camera}), said.append)
    assert (shown.camera.tolist(), shown.room, len(shown.microphones), said) == ([2, 1], None, 0, [])
    wrong = Config({"camera_config": camera, "room_config": {"room_dimensions_m": [4, 3]}})
    shown = with_surroundings(Run("run", [], {}), wrong, said.append)
    assert (shown.camera.tolist(), shown.room, len(said)) == ([2, 1], None, 1)
    assert said[0].startswith("run: not drawn: room: ")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"mirrored": True}, "the tracks are where the people are, mirrored: x runs the other way ("),
        ({"late": 3.0}, "the tracks are where the people are, 3.0 s later ("),
        ({}, ""),
    ],
)
def test_tracks_that_are_mirrored_or_late_are_told_from_bad_ones(tmp_path, change, says):
    rng = np.random.default_rng(0)
    ways = rng.uniform(0.5, 5.5, (30, 2))
    reached = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ways, axis=0), axis=1))])

    def place(time):
        return [float(np.interp(time, reached, column)) for column in ways.T]

    def track(time):
        x, y = place(max(time - change.get("late", 0.0), 0.0))
        return [6 - x if "mirrored" in change else x, y + 0.1]

    truth, tracks = (
        "".join(record(k / 5, [{"object_id": 1, "position": at(k / 5)}]) for k in range(200)) for at in (place, track)
    )
    result = scored(tmp_path, truth, tracks)
    assert result.stderr.count("\n") == bool(says)
    assert says in result.stderr
