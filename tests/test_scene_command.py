"""avsim-scene as a command: the files and records of an experiment."""

import json

import cv2
import numpy as np
import pytest
from conftest import run

from avcli import experiment, media, records

SMALL = {
    "name": "small",
    "duration_s": 0.3,
    "camera_config": {
        "lens_model": "kannala_brandt",
        "fx_px": 143.7,
        "fy_px": 143.8,
        "cx_px": 174.9,
        "cy_px": 92.1,
        "image_width_px": 320,
        "image_height_px": 180,
    },
    "people": [{"waypoints": [{"position_m": [2.0, 2.33]}, {"position_m": [3.0, 2.33]}], "speech_s": True}],
}


def simulate(tmp_path, scenario, *options):
    result = run("avsim-scene", "-", "-C", tmp_path / "exp", *options, stdin=json.dumps(scenario))
    assert result.returncode == 0, result.stderr
    return [records.decode(line) for line in result.stdout.splitlines()]


def test_an_experiment_holds_what_the_design_says(tmp_path):
    lines = simulate(tmp_path, SMALL)
    assert [r["timestamp"] for r in lines] == [0.0, 0.1, 0.2, 0.3]
    exp = tmp_path / "exp"
    config = experiment.read_config(exp / "config.json")
    assert config.camera.depth_step_m == 1e-4
    empty = media.read_depth(exp / config.camera.background_depth)
    for record in lines:
        frame = records.frame(record)
        rgb, depth = media.read_rgb(exp / frame.rgb), media.read_depth(exp / frame.depth)
        assert rgb.shape == (180, 320, 3)
        assert depth.dtype == np.uint16
        assert (depth <= empty).all()
        assert (cv2.imread(str(exp / frame.rgb))[..., ::-1] == rgb).all()
        person = record["objects"][0]
        assert person["visible_fraction"] > 0.9
        x0, y0, x1, y1 = person["bbox_px"]
        rows, columns = np.nonzero(depth < empty)
        assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == (x0, y0, x1, y1)
    truth = [records.decode(line) for line in (exp / "groundtruth_sources.jsonl").read_bytes().splitlines()]
    assert truth == [{key: value for key, value in r.items() if key != "frame"} for r in lines]


def test_the_same_input_gives_the_same_bytes(tmp_path):
    simulate(tmp_path / "a", SMALL)
    simulate(tmp_path / "b", SMALL)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 11
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path


def test_raw_frames_are_the_png_frames(tmp_path):
    png = simulate(tmp_path / "png", SMALL)
    npy = simulate(tmp_path / "npy", SMALL, "--frames", "npy")
    for one, other in zip(png, npy, strict=True):
        a, b = tmp_path / "png" / "exp", tmp_path / "npy" / "exp"
        assert (media.read_rgb(a / one["frame"]["rgb"]) == np.load(b / other["frame"]["rgb"])).all()
        assert (media.read_depth(a / one["frame"]["depth"]) == np.load(b / other["frame"]["depth"])).all()


def test_without_video_nothing_is_drawn(tmp_path):
    seen = simulate(tmp_path / "seen", SMALL, "--frames", "none")
    heard = simulate(tmp_path / "heard", SMALL, "--no-video")
    assert "frame" not in seen[0]
    assert "visible_fraction" in seen[0]["objects"][0]
    assert "visible_fraction" not in heard[0]["objects"][0]
    assert [r["objects"][0]["mouth_position"] for r in heard] == [r["objects"][0]["mouth_position"] for r in seen]
    assert not (tmp_path / "heard" / "exp" / "video").exists()


def test_no_graphics_is_one_line(tmp_path):
    result = run("avsim-scene", "s1", "-C", tmp_path / "exp", env={"GLCONTEXT_LINUX_LIBEGL": "/nonexistent/libEGL.so"})
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    for package in ("libegl1", "libgl1", "libegl-mesa0", "libgl1-mesa-dri"):
        assert package in result.stderr
    assert not (tmp_path / "exp").exists()


def test_a_foreign_config_is_left_alone(tmp_path):
    (tmp_path / "exp").mkdir()
    config = tmp_path / "exp" / "config.json"
    config.write_text('{"session_id": "mine"}')
    result = run("avsim-scene", "s1", "-C", tmp_path / "exp", "--no-video")
    assert result.returncode == 1
    assert "--force" in result.stderr
    assert config.read_text() == '{"session_id": "mine"}'
    assert run("avsim-scene", "s1", "-C", tmp_path / "exp", "--no-video", "--force").returncode == 0


def test_a_second_run_clears_the_frames_of_the_first(tmp_path):
    simulate(tmp_path, SMALL)
    (tmp_path / "exp" / "video" / "rgb" / "notes.txt").write_text("mine")
    simulate(tmp_path, {**SMALL, "duration_s": 0.0})
    assert sorted(p.name for p in (tmp_path / "exp" / "video" / "rgb").iterdir()) == [
        "RGB_frame_0.0000000000.png",
        "notes.txt",
    ]


@pytest.mark.parametrize("name", ["s1", "s2", "s3", "s4"])
def test_built_in_scenarios(tmp_path, name):
    result = run("avsim-scene", name, "-C", tmp_path / "exp", "--no-video")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    lines = [records.decode(line) for line in result.stdout.splitlines()]
    assert len(lines) == 41
    first, last = lines[0]["objects"], lines[-1]["objects"]
    assert {abs(a["position"][0] - b["position"][0]) for a, b in zip(first, last, strict=True)} == {4.0}
    speakers = [[o["object_id"] for o in r["objects"] if o["speaking"]] for r in lines]
    if name == "s4":
        assert speakers == [[0]] * 14 + [[1]] * 13 + [[2]] * 14
    else:
        assert speakers == [[1 if name == "s3" else 0]] * 41


def test_a_printed_scenario_is_the_scenario(tmp_path):
    printed = run("avsim-scene", "s4", "--print-scenario")
    assert printed.returncode == 0
    again = run("avsim-scene", "-", "--print-scenario", stdin=printed.stdout)
    assert again.stdout == printed.stdout
