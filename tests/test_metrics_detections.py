"""Scores of detections against known answers, and the figures that show them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import done, run
from test_aveval import records_of
from test_metrics_report import experiment

from avcli.metrics import detections
from avcli.metrics.detections import SensorCase
from avcli.metrics.metric import Case
from avcli.metrics.registry import SENSOR_METRIC, score_case
from avcli.metrics.run import Detected, Run, Tracked
from avcli.metrics.sequence import Sequence


def scored(truth, found, **more):
    number = 0
    rows = []
    for points in found:
        rows.append((range(number, number + len(points)), np.reshape(points, (-1, 2))))
        number += len(points)
    sequence = Sequence.of([(range(len(p)), np.reshape(p, (-1, 2))) for p in truth], rows)
    return detections.score(sequence, detections.match(sequence, 1.0), **more)


def test_precision_recall_and_errors():
    truth = [[[0, 0], [3, 0]]] * 10
    found = [[[0.3, 0.4], [9, 9]]] * 10
    result = scored(truth, found)
    assert (result["TP"], result["FN"], result["FP"]) == (10, 10, 10)
    assert result["Precision"] == result["Recall"] == result["F1"] == 0.5
    assert result["RMSE"] == result["MAE"] == pytest.approx(0.5)
    assert result["Bias"] == pytest.approx([0.3, 0.4])
    assert result["ANEES"] is None
    speaks = np.tile([True, False], 10)
    assert scored(truth, found, speaking=speaks)["Recall_speaking"] == 1.0
    assert scored(truth, found, speaking=~speaks)["Recall_speaking"] == 0.0


def test_as_many_pairs_as_possible_come_before_near_ones():
    # The nearest pair alone would leave the person at 0.9 without a detection.
    assert scored([[[0, 0], [0.9, 0]]], [[[0.1, 0], [-0.9, 0]]])["TP"] == 2


def test_an_honest_covariance_has_an_anees_of_one():
    rng = np.random.default_rng(0)
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    noise = rng.multivariate_normal([0, 0], covariance, 4000)
    truth, found = [[[0, 0]]] * 4000, [[row] for row in noise]
    honest = scored(truth, found, covariance=np.tile(covariance, (4000, 1, 1)))
    assert honest["ANEES"] == pytest.approx(1, abs=0.05)
    assert scored(truth, found, covariance=np.tile(covariance / 4, (4000, 1, 1)))["ANEES"] == pytest.approx(4, abs=0.2)
    unknown = np.full((4000, 2, 2), np.nan)
    unknown[0] = 0.0  # a dimension that was not observed
    assert scored(truth, found, covariance=unknown)["ANEES"] is None


def test_nothing_found_and_nobody_there():
    assert scored([[[0, 0]]], [[]])["Precision"] is None
    assert scored([[[0, 0]]], [[]])["Recall"] == 0.0
    assert scored([[]], [[[0, 0]]])["Recall"] is None
    assert scored([[]], [[]])["F1"] is None


def test_combined_is_as_if_it_were_one_sequence():
    rng = np.random.default_rng(1)
    parts = []
    for length in (5, 20):
        truth = rng.uniform(0, 4, (length, 2, 2))
        parts.append((list(truth), list(truth + rng.normal(0, 0.3, truth.shape))))
    single = [scored(*part) for part in parts]
    whole = scored(parts[0][0] + parts[1][0], parts[0][1] + parts[1][1])
    together = detections.combine(single)
    for name, value in whole.items():
        assert together[name] == (pytest.approx(value) if value is not None else None), name


def test_aveval_scores_the_sensors_of_experiments(tmp_path):
    experiment(tmp_path / "s3")
    files = [
        word for sensor in ("audio", "video") for word in ("--detections", f"localization/{sensor}_localizations.jsonl")
    ]
    found = [r for r in records_of(run("aveval", "--experiments", "s3", *files, cwd=tmp_path)) if "sensor" in r]
    assert [(r["sequence"], r["sensor"]) for r in found] == [
        ("s3", "audio"),
        ("s3", "video"),
        ("combined", "audio"),
        ("combined", "video"),
    ]
    assert found[0]["Detections"]["Precision"] == 1.0
    assert found[0]["Detections"]["Recall"] == pytest.approx(2 / 3, abs=0.01)
    assert found[2]["Detections"] == found[0]["Detections"]
    text = run("aveval", "--experiments", "s3", *files, "--format", "table", cwd=tmp_path).stdout.decode()
    assert "RecSp" in text
    truth, tracks = tmp_path / "s3" / "groundtruth_sources.jsonl", tmp_path / "s3" / "tracking" / "video_tracking.jsonl"
    named = run("aveval", truth, tracks, "--detections", tmp_path / "s3" / files[1])
    assert json.loads(named.stdout.splitlines()[1])["sensor"] == "audio"
    assert run("aveval", truth, tracks, "--detections", "nowhere").returncode == 2


# --- figures ----------------------------------------------------------------------------------------------------------


def a_run(truth, track, found=()):
    sequence = Sequence.of(truth, track, np.arange(len(truth)) / 10)
    sensors = {}
    if found:
        seen = Sequence.of(truth, found, sequence.time)
        count = seen.track.identity.size
        case = SensorCase(seen, np.full((count, 2, 2), np.nan), "body", 1.0)
        record = {"sequence": "s", "sensor": "audio", "Detections": SENSOR_METRIC.score(case)}
        sensors["audio"] = Detected(case, record, "microphones")
    speaking = (np.arange(sequence.truth.identity.size) % 2).astype(float)
    case = Case(replace(sequence, truth=replace(sequence.truth, speaking=speaking)))
    tracked = Tracked(case, {"sequence": "s", "tracker": "audio", **score_case(case)})
    return Run("s", {"audio": tracked}, sensors, room=np.array([4.66, 4.66]))


@pytest.fixture(scope="module")
def plot():
    pytest.importorskip("matplotlib", reason="matplotlib, an extra, is not installed")
    from avcli.metrics.plots import plot

    return plot


def one(x, identity=1):
    return [identity], np.array([[x, 1.0]])


NOTHING = ([], np.zeros((0, 2)))


@pytest.mark.parametrize(("kind", "begins"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_figures_are_the_same_every_time(plot, kind, begins):
    walk = [one(k / 10) for k in range(20)]
    run = a_run(walk, walk[:5] + [NOTHING] * 3 + walk[8:], walk)
    content = plot(run, kind)
    assert content.startswith(begins)
    assert content == plot(run, kind)


def test_nothing_is_drawn_where_there_was_no_record(plot):
    from matplotlib.figure import Figure

    from avcli.metrics.plots import _draw_error, _draw_room

    walk = [one(k / 10) for k in range(5)] + [NOTHING] * 3 + [one(k / 10) for k in range(8, 20)]
    run = a_run(walk, walk)
    time = run.trackers["audio"].sequence.time
    time[10:] += 7200.0
    axes = Figure().add_subplot()
    _draw_error(axes, run, "audio")
    ((at, _),) = [line.get_data() for line in axes.lines]
    assert np.isnan(at[10])  # neither a line nor an area through the two hours
    assert len(at) == 21
    room = Figure().add_subplot()
    _draw_room(room, run, "audio")
    assert all(np.isnan(line.get_xdata()[5]) for line in room.lines)


@pytest.mark.parametrize(
    ("truth", "track"), [([], []), ([NOTHING], [NOTHING]), ([one(1)], [NOTHING]), ([NOTHING], [one(1)])]
)
def test_figures_of_little(plot, truth, track):
    assert plot(a_run(truth, track), "svg").startswith(b"<?xml")


def test_a_plot_for_each_sequence(tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib, an extra, is not installed")
    experiment(tmp_path / "s3")
    experiment(tmp_path / "s1", people=1)
    for name in ("s1", "s3"):
        (tmp_path / name / "tracking" / "audio_tracking.jsonl").unlink()
        (tmp_path / name / "tracking" / "video_tracking.jsonl").unlink()
    done("aveval", "--experiments", "s3", "s1", "--plot", "p.svg", "-o", "m.jsonl", cwd=tmp_path)
    for name in ("p-s1.svg", "p-s3.svg"):
        assert "audio_video" in (tmp_path / name).read_text()
    assert run("aveval", "--experiments", "s3", "--plot", "p.bmp", cwd=tmp_path).returncode == 2


def test_ears_are_compared_with_mouths(tmp_path):
    truth, heard = "", ""
    for k in range(10):
        person = {"object_id": 0, "position": [k / 10, 1.0, 0.0], "mouth_position": [k / 10 + 0.3, 1.0, 1.6]}
        truth += json.dumps({"timestamp": f"{k / 10:.10f}", "objects": [person]}) + "\n"
        found = {"timestamp": f"{k / 10:.10f}", "objects": [{"position": [k / 10 + 0.3, 1.0, 1.5]}]}
        heard += "".join(json.dumps({**found, "sensor": sensor}) + "\n" for sensor in ("audio", "video"))
    (tmp_path / "truth.jsonl").write_text(truth)
    (tmp_path / "heard.jsonl").write_text(heard)
    command = ("aveval", "truth.jsonl", "truth.jsonl", "--detections", "heard.jsonl", "-q")
    found = {r["sensor"]: r["Detections"] for r in records_of(run(*command, cwd=tmp_path)) if "sensor" in r}
    assert (found["audio"]["Reference"], found["audio"]["RMSE"]) == ("mouth", pytest.approx(0))
    assert (found["video"]["Reference"], found["video"]["RMSE"]) == ("body", pytest.approx(0.3))
    deep = {
        r["sensor"]: r["Detections"] for r in records_of(run(*command, "--dims", "3", cwd=tmp_path)) if "sensor" in r
    }
    assert deep["audio"]["RMSE"] == pytest.approx(0.1)
