"""examples/datasets/build.py and export_coco.py: our own data sets in MOTChallenge's layout."""

import hashlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import done, run

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "datasets"


def module(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[name] = loaded
    spec.loader.exec_module(loaded)
    return loaded


build = module("build")


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    """A set of one short sequence with sound."""
    out = tmp_path_factory.mktemp("sets")
    worlds = [build.World("tiny-s1", "test", ("s1", "--duration", "0.4"), seen=False, about=(("level", "easy"),))]
    build.save("TINY", worlds, out, media=True)
    return out / "TINY"


def test_a_sequence_is_an_experiment_and_a_sequence_of_motchallenge(heard):
    sequence = heard / "test/tiny-s1"
    first = (sequence / "gt/gt.txt").read_text().splitlines()[0]
    assert first == "1,1,-1,-1,-1,-1,1,0.3300,2.3300,0.0000"
    assert "seqLength=5\n" in (sequence / "seqinfo.ini").read_text()
    assert "level=easy\n" in (sequence / "seqinfo.ini").read_text()
    assert (sequence / "det/audio.txt").exists()
    tracks = heard.parent / "tracker"
    tracks.mkdir(exist_ok=True)
    (tracks / "tiny-s1.txt").write_bytes((sequence / "gt/gt.txt").read_bytes())
    ranked = done("aveval", "--leaderboard", heard, tracks)
    assert [json.loads(line)["summary"]["HOTA"] for line in ranked.stdout.splitlines()] == [1.0, 1.0]
    again = run("avdetect-audio", "-C", sequence, sequence / "audio.jsonl")
    assert again.stdout == (sequence / "localization/audio_localizations.jsonl").read_bytes()


def test_the_checksums_are_those_of_the_files(heard):
    lines = (heard / "SHA256SUMS").read_text().splitlines()
    for line in lines:
        digest, path = line.split("  ")
        assert hashlib.sha256((heard / path).read_bytes()).hexdigest() == digest
    named = {line.split("  ")[1] for line in lines}
    assert {"manifest.json", "DATASHEET.md", "test/tiny-s1/gt/gt.txt"} <= named
    (entry,) = json.loads((heard / "manifest.json").read_text())["sequences"]
    assert (entry["path"], entry["level"], entry["seen"]) == ("test/tiny-s1", "easy", False)


def test_mot25v_is_mot25av_without_its_sound(tmp_path):
    twin = tmp_path / "MOT25AV-s1"
    for name in ("img1/000001.png", "audio/wav/a.wav", "det/det.txt", "det/audio.txt", "audio.jsonl"):
        (twin / name).parent.mkdir(parents=True, exist_ok=True)
        (twin / name).write_text(name)
    (twin / "seqinfo.ini").write_text("[Sequence]\nname=MOT25AV-s1\n")
    build.without_sound(twin, tmp_path / "MOT25V-s1.part")
    made = {str(path.relative_to(tmp_path / "MOT25V-s1.part")) for path in (tmp_path / "MOT25V-s1.part").rglob("*.*")}
    assert made == {"img1/000001.png", "det/det.txt", "seqinfo.ini"}
    assert "name=MOT25V-s1\n" in (tmp_path / "MOT25V-s1.part/seqinfo.ini").read_text()
    assert "name=MOT25AV-s1\n" in (twin / "seqinfo.ini").read_text()


def test_the_worlds_of_mot26_do_not_depend_on_how_many_there_are():
    few, many = build.mot26(1, 6.0), build.mot26(3, 6.0)
    assert len(many) == 27
    assert [world for world in many if world.name.endswith("-001")] == few
    seeds = [dict(world.about)["seed"] for world in many]
    assert len(set(seeds)) == len(seeds)
    t60 = {
        level: [dict(w.about)["reverberation_time_s"] for w in many if f"-{level}-" in w.name] for level in build.LEVELS
    }
    assert max(t60["easy"]) <= 0.3 <= min(t60["medium"])
    assert {dict(world.about)["depth"] for world in many} == {True, False}


def test_detections_become_results_of_coco(tmp_path):
    images = [{"id": 5, "file_name": "video/rgb/RGB_frame_0.1000000000.png"}]
    (tmp_path / "coco.json").write_text(json.dumps({"images": images}))
    objects = [{"position": [1, 1, 1], "bbox_px": [10, 20, 30, 60], "score": 0.5}, {"position": [2, 2, 1]}]

    def exported(time):
        return subprocess.run(
            [sys.executable, FOLDER / "export_coco.py", tmp_path / "coco.json"],
            input=json.dumps({"timestamp": time, "objects": objects}), capture_output=True, text=True,
        )  # fmt: skip

    result = exported("0.1000000000")
    assert json.loads(result.stdout) == [{"image_id": 5, "category_id": 1, "bbox": [10, 20, 20, 40], "score": 0.5}]
    assert "1 detections have no box: left out" in result.stderr
    assert "there is no picture of the time 0.2 s" in exported(0.2).stderr
