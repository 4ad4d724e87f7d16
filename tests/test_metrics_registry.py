"""What every registered metric must hold to, and a new metric tried as a contributor would add it."""

import doctest
import json

import numpy as np
import pytest
from conftest import ROOT, done, run, schema
from hypothesis import given
from hypothesis import strategies as st
from test_metrics import sequences

from avcli.formats.schema import Invalid
from avcli.metrics import description, registry, report, scoring, table
from avcli.metrics.detections import SensorCase
from avcli.metrics.metric import Case, Field, Metric
from avcli.metrics.sequence import Sequence

EMPTY = ([], np.zeros((0, 2)))
SOME = ([1], np.ones((1, 2)))
EDGES = [([], []), ([EMPTY], [EMPTY]), ([SOME], [EMPTY]), ([EMPTY], [SOME]), ([SOME], [SOME])]


def as_sensor(sequence):
    return SensorCase(sequence, np.full((sequence.track.identity.size, 2, 2), np.nan), "body", 1.0)


def assert_declared(metric, scores):
    """The keys are the declared fields, and each value is of the declared kind."""
    assert set(scores) == {field.name for field in metric.fields}, metric.name
    for field in metric.fields:
        value = scores[field.name]
        if value is None:
            assert field.optional, field.name
        elif field.kind == "number":
            assert np.ndim(value) == 0, field.name
            assert field.unit != "count" or value == int(value), field.name
        else:
            assert np.ndim(value) == (0 if field.kind == "word" else 1), field.name


def assert_all_declared(some):
    cases = [Case(sequence) for sequence in some]
    sensors = [as_sensor(sequence) for sequence in some]
    for metric, of in [(each, cases) for each in registry.METRICS] + [(registry.SENSOR_METRIC, sensors)]:
        scores = [metric.score(case) for case in of]
        for each in (*scores, metric.combine(scores, of)):
            assert_declared(metric, each)
        # One sequence is its own combination, but for counts of frames in which nothing can match.
        if len(of) == 1 and some[0].truth.identity.size and some[0].track.identity.size:
            for name, value in metric.combine(scores, of).items():
                if value is not None and not isinstance(value, str):
                    np.testing.assert_allclose(value, scores[0][name], rtol=1e-12, err_msg=name)


@given(st.lists(sequences(grid=0), min_size=1, max_size=2))
def test_a_metric_returns_exactly_its_fields(some):
    assert_all_declared(some)


@pytest.mark.parametrize(("truth", "track"), EDGES)
def test_a_metric_returns_exactly_its_fields_where_there_is_little(truth, track):
    assert_all_declared([Sequence.of(truth, track)])


def test_names_and_columns_are_unique_and_short():
    names = [field.name for field in registry.summary_fields()]
    assert len(set(names)) == len(names)
    for columns in (registry.columns(), registry.sensor_columns()):
        headings = [field.column for field in columns]
        assert len(set(headings)) == len(headings)
        assert max(map(len, headings)) <= 6
    for metric in registry.every_metric():
        for field in metric.fields:
            assert field.text, field.name
            assert not field.text.endswith("."), field.name
            assert not field.column or field.summary or metric is registry.SENSOR_METRIC, field.name


def test_the_schema_and_the_manuals_know_every_metric():
    """They are written by `python -m avcli.formats`."""
    described = schema("metrics")
    manual, keys = ((ROOT / "man" / name).read_text() for name in ("aveval.1", "avcli-formats.5"))
    assert description.with_score_list(manual) == manual
    for metric in registry.every_metric():
        assert set(described["properties"][metric.name]["properties"]) == {field.name for field in metric.fields}
        assert all(f".It Va {field.name}\n" in keys for field in metric.fields)
    assert set(described["properties"]["summary"]["properties"]) == {field.name for field in registry.summary_fields()}


# --- a new metric -----------------------------------------------------------------------------------------------------


def miscounted(sequence):
    return np.abs(sequence.track.count - sequence.truth.count)


COUNT_ERROR: Metric[Case] = Metric(
    name="CountError",
    text="how wrong the number of people is",
    fields=(
        Field("CountError", "people miscounted per frame", "people", "down", summary=True, column="CntErr"),
        Field("CountError90", "nine tenths of the frames miscount no more people than this", "people", "down"),
    ),
    score=lambda case: count_error([case]),
    combine=lambda _scores, cases: count_error(cases),
)


def count_error(cases):
    errors = np.concatenate([miscounted(case.sequence) for case in cases])
    known = errors.size > 0
    return {
        "CountError": float(errors.mean()) if known else 0.0,
        "CountError90": float(np.quantile(errors, 0.9)) if known else 0.0,
    }


@pytest.fixture
def with_count_error(monkeypatch):
    monkeypatch.setattr(registry, "METRICS", (*registry.METRICS, COUNT_ERROR))


def people(*counts):
    return [(range(count), np.arange(2.0 * count).reshape(-1, 2)) for count in counts]


@pytest.mark.usefixtures("with_count_error")
def test_a_new_metric_is_in_the_record_the_tables_the_legend_and_the_descriptions():
    cases = [Case(Sequence.of(people(1, 1, 1, 1), people(1, 1, 1, 3))), Case(Sequence.of(people(2), people(2)))]
    scored = [registry.score_case(case) for case in cases]
    assert scored[0]["CountError"] == {"CountError": 0.5, "CountError90": pytest.approx(1.4)}
    assert scored[0]["summary"]["CountError"] == 0.5
    together = registry.combine(scored, cases)
    # A quantile of all frames cannot be made from the quantiles of the sequences.
    assert together["CountError"] == {"CountError": 0.4, "CountError90": pytest.approx(1.2)}
    assert registry.mean(scored)["CountError"] == 0.25
    records = [{"sequence": "s", "tracker": "t", **scored[0]}]
    assert "CntErr" in table.render(records, "table")
    assert "CountError↓ (people)" in table.render(records, "markdown")
    assert table.render(records, "csv").splitlines()[0].endswith(",CountError")
    assert "people miscounted per frame" in report._legend(records)
    described = description.describe().content.schema()["properties"]
    assert {"CountError", "CountError90"} == set(described["CountError"]["properties"])
    assert "CountError" in described["summary"]["properties"]
    assert "People miscounted per frame, in people; lower is better." in description.score_list()
    manual = (ROOT / "man/aveval.1").read_text()
    assert description.with_score_list(manual) != manual  # so that the test above fails until it is written


def test_the_description_reads_what_is_written_and_refuses_other_kinds():
    case = Case(Sequence.of(people(1, 2), people(1, 1)))
    content = description.METRICS.content
    for metric in registry.METRICS:
        scores = metric.score(case)
        content.keys[metric.name].kind.read({name: np.asarray(value).tolist() for name, value in scores.items()})
    with pytest.raises(Invalid):
        content.keys["Count"].kind.read({"Dets": "many"})


# --- the library ------------------------------------------------------------------------------------------------------


def test_the_sample_in_the_docstring():
    result = doctest.testmod(scoring, verbose=False)
    assert result.attempted > 0
    assert result.failed == 0


def test_scores_by_the_library_are_those_of_the_command(tmp_path):
    from test_metrics_report import experiment

    from avcli.formats import records
    from avcli.metrics import score

    folder = experiment(tmp_path / "s3")
    truth, tracks = folder / "groundtruth_sources.jsonl", folder / "tracking/audio_tracking.jsonl"
    for options, words in (
        ((), {}),
        (("--speaking", "--d0", "1", "--order", "2"), {"speaking": True, "d0": 1.0, "order": 2.0}),
        (("--dims", "3", "--cutoff", "0.3", "--window", "4"), {"dims": 3, "cutoff": 0.3, "window": 4}),
    ):
        result = done("aveval", truth, tracks, *options)
        assert json.loads(result.stdout.splitlines()[0])["summary"] == score(
            records.load(truth), records.load(tracks), **words
        )


@pytest.mark.parametrize("wrong", [{"d0": 0.0}, {"dims": 4}, {"order": 0.5}, {"tolerance": -1.0}, {"cutoff": np.nan}])
def test_the_library_refuses_what_the_command_refuses(wrong):
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))} must be"):
        scoring.score([], [], **wrong)


# --- what a sensor is -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["audio", "ring", "ceiling-audio"])
@pytest.mark.parametrize("kind", ["camera", "microphones"])
@pytest.mark.parametrize("where", ["config", "record"])
def test_a_sensors_name_changes_no_score_where_its_kind_is_stated(tmp_path, name, kind, where):
    truth, found = [], []
    for k in range(10):
        person = {"object_id": 0, "position": [k / 10, 1.0, 0.0], "mouth_position": [k / 10 + 0.3, 1.0, 1.6]}
        truth.append({"timestamp": k / 10, "objects": [person]})
        stated = {"kind": kind} if where == "record" else {}
        found.append({"timestamp": k / 10, "sensor": name, **stated, "objects": [{"position": [k / 10 + 0.3, 1.0]}]})
    for file, rows in (("truth.jsonl", truth), ("found.jsonl", found)):
        (tmp_path / file).write_text("".join(json.dumps(row) + "\n" for row in rows))
    if where == "config":
        (tmp_path / "config.json").write_text(json.dumps({"sensors": {name: {"kind": kind}}}))
    result = run("aveval", "truth.jsonl", "truth.jsonl", "--detections", "found.jsonl", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    scores = json.loads(result.stdout.splitlines()[1])["Detections"]
    assert scores["Reference"] == ("mouth" if kind == "microphones" else "body")
    assert scores["RMSE"] == pytest.approx(0.0 if kind == "microphones" else 0.3)


def test_a_guessed_kind_is_said_once(tmp_path):
    from test_metrics_report import experiment

    person = {"object_id": 0, "position": [1.0, 1.0, 0.0], "mouth_position": [1.0, 1.0, 1.6]}
    for name in ("s1", "s2"):
        folder = experiment(tmp_path / name, people=1)
        (folder / "groundtruth_sources.jsonl").write_text(json.dumps({"timestamp": 0.0, "objects": [person]}) + "\n")
    command = ("aveval", "--experiments", "s1", "s2", "--detections", "localization/audio_localizations.jsonl")
    said = run(*command, cwd=tmp_path).stderr
    assert said.count('the kind of sensor "audio" was guessed') == 1
    for name in ("s1", "s2"):
        path = tmp_path / name / "config.json"
        config = json.loads(path.read_text()) | {"sensors": {"audio": {"kind": "microphones"}}}
        path.write_text(json.dumps(config))
    assert "guessed" not in run(*command, cwd=tmp_path).stderr
