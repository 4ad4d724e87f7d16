"""aveval --leaderboard: trackers on a data set in MOTChallenge's layout."""

import json

import pytest
from conftest import done, refused, run


def rows(offset, frames=range(1, 11)):
    return "".join(f"{frame},3,-1,-1,-1,-1,1,{0.1 * frame + offset},1,0\n" for frame in frames)


@pytest.fixture
def dataset(tmp_path):
    """Two sequences of different levels, and two trackers: one good, one that is .4 m off and lacks a sequence."""
    for name, level in (("a", "easy"), ("b", "hard")):
        folder = tmp_path / "set/test" / name
        (folder / "gt").mkdir(parents=True)
        (folder / "seqinfo.ini").write_text(f"[Sequence]\nname={name}\nframeRate=5\nlevel={level}\n")
        (folder / "gt/gt.txt").write_text(rows(0.0))
    for tracker in ("good", "rough"):
        (tmp_path / tracker).mkdir()
    (tmp_path / "good/a.txt").write_text(rows(0.0))
    places = [{"object_id": 1, "position": [0.1 * frame, 1.0, 0.0]} for frame in range(1, 11)]
    records = [json.dumps({"timestamp": 0.2 * n, "objects": [place]}) for n, place in enumerate(places)]
    (tmp_path / "good/b.jsonl").write_text("\n".join(records))  # the other format, at the rate of seqinfo.ini
    (tmp_path / "rough/a.txt").write_text(rows(0.4))
    return tmp_path


def test_the_best_tracker_comes_first_in_each_level(dataset):
    result = done("aveval", "--leaderboard", dataset / "set", dataset / "rough", dataset / "good")
    assert "rough has no file for b: counted as missed" in result.stderr
    records = [json.loads(line) for line in result.stdout.splitlines()]
    order = [f"{level} at {d0} m" for d0 in ("2", "0.5") for level in ("easy", "hard", "all")]
    assert [(one["sequence"], one["tracker"]) for one in records] == [
        (where, tracker) for where in order for tracker in ("good", "rough")
    ]
    hota = {(one["sequence"], one["tracker"]): one["summary"]["HOTA"] for one in records}
    assert hota["all at 0.5 m", "good"] == 1.0
    assert hota["easy at 2 m", "rough"] == pytest.approx(16 / 19, abs=0.03)  # a similarity of .8, 19 thresholds
    assert hota["easy at 0.5 m", "rough"] == pytest.approx(4 / 19, abs=0.03)
    assert hota["hard at 2 m", "rough"] == 0.0
    assert hota["all at 2 m", "rough"] < hota["easy at 2 m", "rough"]


def test_a_leaderboard_is_a_table_too(dataset):
    result = done("aveval", "--leaderboard", dataset / "set", dataset / "good", "--format", "markdown")
    assert "| all at 0.5 m | good | 100.0 |" in result.stdout.decode()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["set"], "needs a data set and at least one directory of a tracker"),
        (["set", "nowhere"], "nowhere: no such directory"),
        (["good", "good"], "good: has no sequences"),
        (["set", "good", "set/../good"], "two directories of trackers have the same name"),
        (["set", "good", "--d0", "1"], "--d0 has no effect with --leaderboard"),
    ],
)
def test_what_is_no_leaderboard_is_refused(dataset, arguments, says):
    result = run("aveval", "--leaderboard", *arguments, cwd=dataset)
    assert result.returncode in (1, 2)
    assert says in result.stderr
    assert not result.stdout


def test_a_sequence_needs_its_frame_rate(dataset):
    (dataset / "set/test/a/seqinfo.ini").write_text("[Sequence]\nname=a\n")
    refused(run("aveval", "--leaderboard", dataset / "set", dataset / "good"), "seqinfo.ini: has no frameRate")
