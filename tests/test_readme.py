"""The README's figures are those that the program gives, and its links lead somewhere."""

import json
import re

import pytest
from conftest import ROOT, run

README = (ROOT / "README.md").read_text()
TRACKERS = ("audio", "video", "audio_video")


def stated(sequence: str) -> list[float]:
    """HOTA of audio, video and both in the README's table."""
    row = re.search(rf"^\| {sequence}\b[^|]*\|(.*)\|$", README, re.MULTILINE)[1]
    return [float(cell.split()[0]) for cell in row.split("|")]


def measured(metrics: str, sequence: str) -> list[float]:
    """The same of the metrics records."""
    records = [json.loads(line) for line in metrics.splitlines()]
    scores = {r["tracker"]: r["summary"]["HOTA"] for r in records if r["sequence"] == sequence and "tracker" in r}
    return [round(100 * scores[tracker], 1) for tracker in TRACKERS]


def test_the_figures_of_s1(finished_s1):
    result = run("aveval", "--experiments", finished_s1, "--format", "jsonl")
    assert measured(result.stdout.decode(), "s1") == pytest.approx(stated("S1"), abs=0.11)


def test_the_figures_of_all_scenarios():
    """Compare with what `make all` has left in out/, where it was run with today's code."""
    experiments = [ROOT / "out" / name for name in ("s1", "s2", "s3", "s4")]
    if not all((path / "metrics.jsonl").is_file() for path in experiments):
        pytest.skip("make all was not run")
    newest = max(path.stat().st_mtime for path in (ROOT / "avcli").rglob("*.py"))
    if min((path / "metrics.jsonl").stat().st_mtime for path in experiments) < newest:
        pytest.skip("make all was run with older code")
    metrics = run("aveval", "--experiments", *experiments, "--format", "jsonl").stdout.decode()
    for row in ("S1", "S2", "S3", "S4", "combined"):
        assert measured(metrics, row.lower()) == pytest.approx(stated(row), abs=0.11)


def test_the_page_of_results_has_the_same_figures():
    results = (ROOT / "examples" / "benchmarks" / "results.md").read_text()
    rows = ("S1", "S2", "S3", "S4", "combined")
    for column, ours in enumerate(re.findall(r"^\| \| ours \|(.*)\|$", results, re.MULTILINE)):
        assert [float(cell) for cell in ours.split("|")] == [stated(row)[column] for row in rows]


def test_the_readme_is_one_screen():
    assert len(README.splitlines()) < 100
    assert (ROOT / "examples" / "avview.jpg").stat().st_size < 150_000
