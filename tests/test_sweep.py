"""examples/sweep: what a worker makes is what the commands make, and a killed worker's scenes are made again."""

import json
from pathlib import Path

import pytest
from conftest import run
from forked import run_forked

SWEEP = Path(__file__).resolve().parents[1] / "examples" / "sweep"
FOLDER = Path("s1/audio/seconds~0.5/t60~0/noise~30")


def worker(out, seeds="3-4"):
    wanted = "--scenario", "s1", "--t60", "0", "--noise", "30", "--seconds", "0.5", "--seeds", seeds
    return run_forked(str(SWEEP / "scenes.py"), *wanted, "--out", out / FOLDER)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep of two scenes by one worker."""
    out = tmp_path_factory.mktemp("sweep")
    result = worker(out)
    assert (result.returncode, result.stderr) == (0, "")
    return out


def test_a_scene_is_that_of_the_commands_byte_for_byte(swept, tmp_path):
    for folder in ("localization", "tracking"):
        (tmp_path / folder).mkdir()
    files = {name: tmp_path / name for name in ("scene.jsonl", "audio.jsonl")}
    heard, tracks = "localization/audio_localizations.jsonl", "tracking/audio_tracking.jsonl"
    at = ("-C", tmp_path)
    for command in (
        ("avsim-scene", "s1", *at, "--no-video", "--seed", 3, "--duration", 0.5, "-o", files["scene.jsonl"]),
        ("avsim-audio", *at, "--seed", 3, "--rt60", 0, "--noise", "sensor=30", files["scene.jsonl"], "-o",
         files["audio.jsonl"]),
        ("avdetect-audio", *at, "--seed", 3, files["audio.jsonl"], "-o", tmp_path / heard),
        ("avfuse", *at, tmp_path / heard, "-o", tmp_path / tracks),
    ):  # fmt: skip
        assert run(*command).returncode == 0
    mine = swept / FOLDER / "seed~3"
    for name in ("config.json", "groundtruth_sources.jsonl", *files, heard, tracks):
        assert (mine / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_no_sound_is_kept_and_a_scene_is_small(swept):
    for scene in (swept / FOLDER).glob("seed~*"):
        files = [path for path in scene.rglob("*") if path.is_file()]
        assert not [path for path in files if path.suffix in (".wav", ".png", ".npy")]
        assert sum(path.stat().st_size for path in files) < 2_000_000


def test_a_killed_workers_scenes_are_made_again_and_no_other(swept):
    done, cut = (swept / FOLDER / f"seed~{seed}" for seed in (3, 4))
    before = {path: path.read_bytes() for path in cut.rglob("*.jsonl")}
    stamp = (done / "metrics.jsonl").stat().st_mtime_ns
    (cut / "metrics.jsonl").unlink()
    (cut / "tracking/audio_tracking.jsonl").write_text('{"cut')
    (cut / "audio").mkdir()
    assert worker(swept).returncode == 0
    assert {path: path.read_bytes() for path in cut.rglob("*.jsonl")} == before
    assert not (cut / "audio").exists()
    assert (done / "metrics.jsonl").stat().st_mtime_ns == stamp


def test_a_worker_that_fails_says_what_failed(tmp_path):
    wanted = "--scenario", "nowhere.json", "--t60", "0", "--noise", "30", "--seeds", "0-0", "--out", tmp_path
    ended = run_forked(str(SWEEP / "scenes.py"), *wanted)
    assert ended.returncode == 1
    assert "scenes.py: avsim-scene nowhere.json" in ended.stderr
    assert "exit code 2" in ended.stderr


def test_the_table_has_a_row_for_each_combination(swept):
    pytest.importorskip("matplotlib")
    result = run_forked(str(SWEEP / "collect.py"), swept)
    assert result.returncode == 0, result.stderr
    head, _, row = (swept / "table.md").read_text().splitlines()
    cells = dict(zip(head.split(" | "), row.split(" | "), strict=True))
    assert (cells["T60 s"], cells["noise dB"], cells["scenes"]) == ("0", "30", "2")
    scores = [json.loads((path / "metrics.jsonl").read_text().splitlines()[0])["summary"]["HOTA"]
              for path in sorted((swept / FOLDER).glob("seed~*"))]  # fmt: skip
    assert cells["HOTA"].startswith(f"{50 * sum(scores):.1f} ±")
    assert len((swept / "scenes.csv").read_text().splitlines()) == 3
