"""Others' formats: TrackEval itself scores the folders that we write, and MOTChallenge files come back as they went."""

import json
import subprocess
import sys

import numpy as np
import pytest
from conftest import run
from hypothesis import given, settings
from hypothesis import strategies as st
from test_aveval import lines, record, records_of, walk

from avcli.formats.records import Identified
from avcli.metrics import mot
from avcli.metrics.sequence import Sequence, align

EVALUATE = """
import json, sys
import trackeval

class Points(trackeval.datasets.MotChallenge2DBox):
    def _calculate_similarities(self, truth, tracks):
        return self._calculate_euclidean_similarity(truth[:, :2], tracks[:, :2], zero_distance=2.0)

folder = sys.argv[1]
points = Points({"GT_FOLDER": folder + "/gt", "TRACKERS_FOLDER": folder + "/trackers", "BENCHMARK": "avcli",
                 "SPLIT_TO_EVAL": "all", "DO_PREPROC": False, "PRINT_CONFIG": False})
quiet = {"PRINT_RESULTS": False, "PRINT_CONFIG": False, "TIME_PROGRESS": False, "OUTPUT_SUMMARY": False,
         "OUTPUT_DETAILED": False, "PLOT_CURVES": False, "DISPLAY_LESS_PROGRESS": True, "BREAK_ON_ERROR": True}
metrics = [trackeval.metrics.HOTA(), trackeval.metrics.CLEAR({"PRINT_CONFIG": False}),
           trackeval.metrics.Identity({"PRINT_CONFIG": False})]
found, _ = trackeval.Evaluator(quiet).evaluate([points], metrics)
result = {tracker: {sequence: {"HOTA": list(of["pedestrian"]["HOTA"]["HOTA"]),
                               "MOTA": of["pedestrian"]["CLEAR"]["MOTA"], "IDF1": of["pedestrian"]["Identity"]["IDF1"]}
                    for sequence, of in sequences.items()}
          for tracker, sequences in found["Points"].items()}
json.dump(result, open(sys.argv[2], "w"))
"""


def test_trackeval_reads_our_folders_and_agrees(tmp_path):
    pytest.importorskip("trackeval", reason="trackeval, the oracle, is not installed")
    rng = np.random.default_rng(4)
    for name, people in (("s1", 1), ("s3", 3)):
        (tmp_path / name / "tracking").mkdir(parents=True)
        walks = [walk(k, y=1.33 + k) for k in range(people)]
        (tmp_path / name / "groundtruth_sources.jsonl").write_text(lines(*walks))
        for tracker in ("audio", "video"):
            seen = [
                (t, k + 7 * (t > 2), [x + rng.normal(0, 0.3), y + rng.normal(0, 0.3)])
                for each in walks
                for t, k, (x, y, _) in each
                if rng.random() < 0.8
            ]
            # Times at which only this tracker has anything make its timeline longer than the others'.
            text = lines(seen) + record(9.05 if tracker == "audio" else 9.1, [{"object_id": 90, "position": [1, 1]}])
            (tmp_path / name / "tracking" / f"{tracker}_tracking.jsonl").write_text(text)
    found = records_of(run("aveval", "--experiments", "s1", "s3", "--mot", "mot", cwd=tmp_path))
    result = subprocess.run(
        [sys.executable, "-c", EVALUATE, tmp_path / "mot", tmp_path / "theirs.json"], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    theirs = json.loads((tmp_path / "theirs.json").read_text())
    compared = 0
    for ours in found:
        if "HOTA" not in ours:
            continue
        name = {"combined": "COMBINED_SEQ"}.get(ours["sequence"], ours["sequence"])
        expected = theirs[ours["tracker"]][name]
        np.testing.assert_allclose(ours["HOTA"]["HOTA"], expected["HOTA"], atol=1e-9)
        assert ours["CLEAR"]["MOTA"] == pytest.approx(expected["MOTA"], abs=1e-9)
        assert ours["Identity"]["IDF1"] == pytest.approx(expected["IDF1"], abs=1e-9)
        compared += 1
    assert compared == 6


def test_a_clock_whose_times_are_rounded_to_milliseconds_has_its_own_rate():
    """The median step, 0.033 s, made 30.303 Hz of a film of 30 Hz."""
    time = (np.arange(40) / 30).round(3)
    truth = [Identified(t, np.array([1]), np.array([[1.0, 2.0, 0.0]])) for t in time.tolist()]
    files = mot.write({"s": {"t": align(truth, truth)[0]}})
    assert "frameRate=30\n" in files["gt/avcli-all/s/seqinfo.ini"]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_motchallenge_there_and_back(seed):
    rng = np.random.default_rng(seed)

    def side():
        rows = []
        for k in range(12):
            identity = rng.permutation(9)[: rng.integers(1, 4) if rng.random() < 0.7 else 0]
            rows.append(Identified(k / 10, identity, rng.normal(0, 3, (identity.size, 3))))
        return rows

    sequence, _ = align(side(), side(), dims=3)
    files = mot.write({"s": {"t": sequence}})
    step = float(np.median(np.diff(sequence.time)))
    truth, tracks = (mot.read(files[f"mot/s/{name}.txt"], 1 / step) for name in ("gt", "t"))
    for points, back in ((sequence.truth, truth), (sequence.track, tracks)):
        position = np.concatenate([row.positions for row in back]) if back else np.zeros((0, 3))
        np.testing.assert_array_equal(position, points.position.reshape(-1, 3))
        identity = np.concatenate([row.ids for row in back]) if back else np.zeros(0)
        np.testing.assert_array_equal(identity, points.identity + 1)


def test_aveval_reads_motchallenge(tmp_path):
    rows = "".join(f"{k + 1},4,-1,-1,-1,-1,1,{0.33 + k / 10},2.63,0\n" for k in range(41))
    (tmp_path / "tracks.txt").write_text(rows)
    (tmp_path / "truth.jsonl").write_text(lines(walk()))
    found = records_of(run("aveval", "truth.jsonl", "tracks.txt", cwd=tmp_path))[0]
    assert found["summary"]["HOTA"] == pytest.approx(17 / 19)
    flat = rows.replace(",0\n", "\n")
    (tmp_path / "tracks.txt").write_text(flat.replace("\n", "\r\n"))
    assert records_of(run("aveval", "truth.jsonl", "tracks.txt", cwd=tmp_path))[0]["tracker"] == "tracks"
    half = records_of(run("aveval", "truth.jsonl", "tracks.txt", "--rate", "20", "-q", cwd=tmp_path))[0]
    assert half["summary"]["HOTA"] < 0.9


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("1,2,-1,-1,-1,-1,1,a,2,0", "not a number"),
        ("0,2,-1,-1,-1,-1,1,1,2,0", "frame number from 1"),
        ("1,2,10,10,5,5,1,-1,-1,-1", "must hold a position in the room"),
        ("1,2,10,10,5,5,1,1,0.8", "must hold a position in the room"),
        ("1,2,-1,-1,-1,-1,1", "must hold a position in the room"),
        ("1,2,-1,-1,-1,-1,1,nan,2,0", "frame number"),
    ],
)
def test_rows_that_are_none_are_named(tmp_path, row, reason):
    (tmp_path / "tracks.csv").write_text("1,1,-1,-1,-1,-1,1,1,2,0\n" + row + "\n")
    (tmp_path / "truth.jsonl").write_text(lines(walk()))
    result = run("aveval", "truth.jsonl", "tracks.csv", cwd=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("aveval: tracks.csv: line 2: ")
    assert reason in result.stderr


def test_rows_without_confidence_are_left_out():
    assert mot.read("1,1,-1,-1,-1,-1,0,1,2,0\n2,1,-1,-1,-1,-1,1,1,2,0\n", 10.0)[0].timestamp == pytest.approx(0.1)
    nothing = ([], np.zeros((0, 2)))
    assert mot.write({"s": {"t": Sequence.of([nothing], [nothing])}})["mot/s/t.txt"] == ""
