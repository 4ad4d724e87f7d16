"""make bench compares what the benchmarks hand over, and judges it by the budget."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "bench"))
import budget
import chain
import machine
import whole_page
from figures import figure, front, groups, hand_over, handed_over

ROWS = [
    figure("audio", "a scene", "avcli, -40 dB", 1.0, "scene", -40, "dB"),
    figure("audio", "a scene", "avcli, -20 dB", 0.5, "scene", -20, "dB"),
    figure("audio", "a scene", "<peer>", 1.0, "scene", -30, "dB"),
    figure("start", "--help", "avcli avfuse", 0.1, "start"),
]


def test_what_is_handed_over_is_read_again(tmp_path):
    hand_over(tmp_path, "audio", ROWS[:3])
    hand_over(tmp_path, "start", ROWS[3:])
    assert list(handed_over(tmp_path)) == ROWS


def test_nobody_is_sooner_and_more_accurate_than_the_front():
    (found,) = groups(ROWS).values()
    assert [row["tool"] for row in front(found)] == ["avcli, -20 dB", "avcli, -40 dB"]
    twins = [dict(ROWS[0]), dict(ROWS[0])]
    assert front(twins) == twins


@pytest.fixture
def limits(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "FILE", tmp_path / "budget.json")
    return budget.FILE


def test_a_limit_that_is_exceeded_is_told_from_a_goal(limits):
    rows = [{**row, "units": 2 * row["cpu_s"], "wall_s": 1.0, "wall_units": 9.0} for row in ROWS]
    keys = ("stage", "case", "tool")
    lines = [{**{key: ROWS[0][key] for key in keys}, "units": 1.5, "why": "by hand"},
             {**{key: ROWS[3][key] for key in keys}, "units": 8, "why": "a wish", "wall": True, "goal": True},
             {"stage": "gone", "case": "", "tool": "", "units": 1, "why": "by hand"}]  # fmt: skip
    limits.write_text(json.dumps({"limits": lines}))
    verdict = budget.judged(rows)
    assert [(one.found, one.over, one.goal) for one in verdict] == [(2.0, True, False), (9.0, True, True)]
    said = whole_page.sentence(verdict, {"scene": "no EGL"})
    assert "0 of 1 limits" in said
    assert "Goals that are not reached" in said
    assert "scene (no EGL)" in said
    assert "none was checked" in whole_page.sentence([], {})
    assert budget.unjudged(rows) == ["start, --help, avcli avfuse"], "a goal is no limit, and other tools have none"
    budget.write(rows, {"processor": "P", "cpus": 1, "reference": {"all": 0.5}})
    written = json.loads(limits.read_text())["limits"]
    assert len(written) == 4, "what people wrote stays, the start is new"
    assert [line["units"] for line in written if line["why"] == budget.WRITTEN] == [0.3]
    assert not budget.unjudged(rows)


def test_the_page_says_everything_and_escapes_it(limits):
    rows = [{**row, "units": 1.0} for row in ROWS]
    here = {**machine.described(), "reference": {"arithmetic": 0.1, "all": 0.5}}
    page = whole_page.page(here, rows, budget.judged(rows), {})
    assert "&lt;peer&gt;" in page
    assert "<peer>" not in page
    assert page.count("<figure>") == 1
    assert "yes" in whole_page.markdown(here, rows, [], {})


def test_an_interval_of_seeds():
    assert chain.shown([50.0]) == "50.0"
    mean, half = chain.interval([1.0, 2.0, 3.0])
    assert (mean, half) == pytest.approx((2.0, 4.303 / 3**0.5), rel=1e-3)
