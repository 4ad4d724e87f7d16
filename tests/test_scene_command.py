"""avsim-scene as a command: the files and records of an experiment."""

import doctest
import json
import os
import shutil
import signal
import subprocess

import cv2
import numpy as np
import pytest
from conftest import BIN, ROOT, done, refused, run

from avcli.formats import experiment, media, png, records
from avcli.scene import film, render

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
    result = done("avsim-scene", "-", "-C", tmp_path / "exp", *options, stdin=json.dumps(scenario))
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


def test_threads_leave_no_trace_in_the_bytes(tmp_path):
    for threads in ("0", "1", "3"):
        done("avsim-scene", "-", "-C", tmp_path / threads, stdin=json.dumps(SMALL), env={"LP_NUM_THREADS": threads})
    files = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*") if p.is_file())
    assert len(files) == 11
    for path in files:
        assert len({(tmp_path / threads / path).read_bytes() for threads in ("0", "1", "3")}) == 1, path


def test_a_long_scene_needs_no_more_memory_than_a_short_one(tmp_path):
    def peak(duration):
        command = [
            str(BIN / "avsim-scene"),
            "-",
            "--frames",
            "none",
            "--duration",
            duration,
            "-C",
            str(tmp_path / duration),
        ]
        with open(tmp_path / "stdin.json", "rb") as stdin:
            child = subprocess.Popen(command, stdin=stdin, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        assert child.returncode == 0
        return usage.ru_maxrss

    (tmp_path / "stdin.json").write_text(json.dumps(SMALL))
    short = peak("10.5")  # a chunk of bodies and a bit
    assert peak("60") < short + 8 * 1024  # KiB


def test_an_interrupt_leaves_whole_files(tmp_path):
    long = {**SMALL, "duration_s": 300.0}
    (tmp_path / "stdin.json").write_text(json.dumps(long))
    command = [str(BIN / "avsim-scene"), "-", "-C", str(tmp_path / "exp")]
    with open(tmp_path / "stdin.json", "rb") as stdin:
        child = subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    lines = [child.stdout.readline() for _ in range(7)]
    child.send_signal(signal.SIGINT)
    rest, said = child.communicate(timeout=60)
    assert child.returncode == -signal.SIGINT
    assert b"Traceback" not in said
    exp = tmp_path / "exp"
    assert not list(exp.rglob(".*"))
    assert not (exp / "groundtruth_sources.jsonl").exists()
    for picture in exp.rglob("*.png"):
        assert cv2.imread(str(picture), cv2.IMREAD_UNCHANGED) is not None, picture
    for line in [*lines, *rest.splitlines()]:
        frame = records.frame(records.decode(line))
        assert media.read_rgb(exp / frame.rgb).shape == (180, 320, 3)


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
    refused(result)
    for package in ("libegl1", "libgl1", "libegl-mesa0", "libgl1-mesa-dri"):
        assert package in result.stderr
    assert not (tmp_path / "exp").exists()


def test_a_foreign_config_is_left_alone(tmp_path):
    (tmp_path / "exp").mkdir()
    config = tmp_path / "exp" / "config.json"
    config.write_text('{"session_id": "mine"}')
    refused(run("avsim-scene", "s1", "-C", tmp_path / "exp", "--no-video"), "--force")
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


def test_a_second_run_into_a_directory_is_refused_by_name_and_clears_nothing(tmp_path):
    exp = tmp_path / "exp"
    command = [str(BIN / "avsim-scene"), "s1", "--no-video", "--duration", "100000", "-C", str(exp)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE)
    line = first.stdout.readline()
    before = (exp / "config.json").read_bytes()
    second = run("avsim-scene", "s3", "--no-video", "-C", exp)
    assert second.returncode == 1
    assert second.stderr == (
        f"avsim-scene: {exp}: avsim-scene (PID {first.pid}) is writing there; wait for it, or use another directory\n"
    )
    assert (exp / "config.json").read_bytes() == before
    assert run("avsim-audio", "-C", exp, stdin=line).returncode == 0, "another command may write beside it"
    first.kill()
    first.communicate()
    assert run("avsim-scene", "s3", "--no-video", "--duration", "0", "-C", exp).returncode == 0, "the lock died with it"
    assert json.loads((exp / "config.json").read_bytes())["session_id"] == "s3"
    assert not list(exp.rglob(".*"))


def test_only_pictures_of_earlier_runs_are_removed_and_none_behind_a_link(tmp_path):
    exp, elsewhere = tmp_path / "exp", tmp_path / "elsewhere"
    simulate(tmp_path, SMALL)
    mine = exp / "video" / "rgb" / "RGB_frame_of_my_cat.png"
    mine.touch()
    (exp / "video" / "rgb").rename(elsewhere)
    (exp / "video" / "rgb").symlink_to(elsewhere)
    before = sorted(path for path in [*elsewhere.iterdir(), *exp.rglob("*")])
    result = run("avsim-scene", "-", "-C", exp, "--no-video", stdin=json.dumps(SMALL))
    refused(result, f"leads by a symbolic link to {elsewhere}, where 4 files")
    assert sorted(path for path in [*elsewhere.iterdir(), *exp.rglob("*")]) == before
    done("avsim-scene", "-", "-C", exp, "--no-video", "--force", stdin=json.dumps(SMALL))
    assert [path.name for path in elsewhere.iterdir()] == [mine.name]


def test_the_config_says_what_the_sensors_are(tmp_path):
    simulate(tmp_path, SMALL, "--no-video")
    assert experiment.read_config(tmp_path / "exp" / "config.json").sensors == {
        "audio": "microphones",
        "video": "camera",
    }


@pytest.mark.parametrize("name", ["s1", "s2", "s3", "s4"])
def test_built_in_scenarios(tmp_path, name):
    result = done("avsim-scene", name, "-C", tmp_path / "exp", "--no-video")
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
    printed = done("avsim-scene", "s4", "--print-scenario")
    again = run("avsim-scene", "-", "--print-scenario", stdin=printed.stdout)
    assert again.stdout == printed.stdout


@pytest.mark.parametrize(
    ("options", "because"),
    [
        (["--gltf", "mine.json"], "--gltf mine.json: this file is an input"),
        (["--coco", "x", "--sheet", "x"], "--sheet x: two outputs have the same name"),
        (["--coco", "none/x"], "--coco none/x: there is no such directory"),
        (["--sheet", "-"], "--sheet -: only --output writes to standard output"),
    ],
)
def test_a_further_output_replaces_no_input_and_no_other_output(tmp_path, monkeypatch, options, because):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.json").write_text("{}")
    refused(run("avsim-scene", "mine.json", "-C", "exp", *options), because, status=2)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.json"]
    assert (tmp_path / "mine.json").read_text() == "{}"


def test_masks_coco_and_sheet_agree_with_the_truth(tmp_path):
    coco, sheet = tmp_path / "coco.json", tmp_path / "sheet.png"
    lines = simulate(tmp_path, SMALL, "--masks", "--coco", coco, "--sheet", sheet)
    data = json.loads(coco.read_bytes())
    assert [image["file_name"] for image in data["images"]] == [r["frame"]["rgb"] for r in lines]
    assert len(data["categories"][0]["keypoints"]) == 17
    for record, entry in zip(lines, data["annotations"], strict=True):
        mask = cv2.imread(str(tmp_path / "exp" / record["frame"]["mask"]), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(mask)) == {0, 1}
        counts = entry["segmentation"]["counts"]
        assert sum(counts) == mask.size
        decoded = np.repeat(np.arange(len(counts)) % 2, counts).reshape(mask.shape[::-1]).T
        np.testing.assert_array_equal(decoded, mask)
        x0, y0, x1, y1 = record["objects"][0]["bbox_px"]
        assert entry["bbox"] == [x0, y0, x1 - x0, y1 - y0]
        assert entry["area"] == mask.sum()
        assert len(entry["keypoints"]) == 51
    assert cv2.imread(str(sheet)).shape[1] == 4 * 480


def test_the_preset_is_the_thesis(tmp_path):
    result = done("avsim-scene", "s1", "-C", tmp_path, "--preset", "thesis", "--duration", "0")
    config = experiment.read_config(tmp_path / "config.json")
    assert (type(config.camera.lens).__name__, config.camera.lens.k1, config.camera.lens.fx) == (
        "Division",
        -0.2,
        596.43,
    )
    frame = records.frame(records.decode(result.stdout))
    depth, rgb = media.read_depth(tmp_path / frame.depth), media.read_rgb(tmp_path / frame.rgb)
    assert depth.dtype == np.uint8
    black = (rgb == 0).all(-1)
    assert black.mean() == pytest.approx(0.323, abs=0.003)
    assert (depth[black] == 0).all()
    ray = config.camera.lens.unproject([[960.0, 200.0]])[0]
    assert depth[200, 960] * config.camera.depth_step_m == pytest.approx(2.5 / ray[2], abs=0.011)


def test_sensor_effects_are_seeded_and_leave_depth_alone(tmp_path):
    effects = ("--full-well", "9000", "--read-noise", "1.5", "--vignetting", "0.3", "--aberration", "1", "--jpeg", "80")
    plain = simulate(tmp_path / "plain", SMALL)
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        simulate(tmp_path / name, SMALL, *effects, "--shutter", "0.03", "--seed", seed)
    for record in plain[:2]:
        read = {n: media.read_rgb(tmp_path / n / "exp" / record["frame"]["rgb"]) for n in ("plain", "a", "b", "c")}
        assert (read["a"] == read["b"]).all()
        assert (read["a"] != read["c"]).any()
        assert (read["a"] != read["plain"]).any()
        depth = [media.read_depth(tmp_path / n / "exp" / record["frame"]["depth"]) for n in ("plain", "a")]
        assert (depth[0] == depth[1]).all()


def test_what_cannot_go_together_is_said(tmp_path):
    for option in (["--masks"], ["--coco", "x.json"], ["--samples", "4"], ["--shutter", "0.1"], ["--jpeg", "50"]):
        result = run("avsim-scene", "s1", "-C", tmp_path / "exp", "--no-video", *option)
        refused(result, f"{option[0]} has no effect with --no-video", status=2)
    assert run("avsim-scene", "s1", "-C", tmp_path / "exp", "--no-video", "--preset", "thesis").returncode == 0
    crowd = run("avsim-scene", "s1", "-C", tmp_path / "exp", "--people", "5")
    refused(crowd, "--people has no effect on a scenario that is not random", status=2)
    shutil.rmtree(tmp_path / "exp")
    assert run("avsim-scene", "s1").returncode == 2
    refused(run("avsim-scene", "s9", "-C", tmp_path / "exp"), "s1, s2, s3, s4, random", status=2)
    refused(run("avsim-scene", "-", "-C", tmp_path / "exp", stdin='{"people": ['), "<stdin>:1:13: invalid JSON")
    assert not (tmp_path / "exp").exists()


def test_another_camera_is_a_twin(tmp_path):
    lens = {"lens_model": "kannala_brandt", "fx_px": 50, "fy_px": 50, "cx_px": 39.5, "cy_px": 29.5}
    (tmp_path / "lens.json").write_text(
        json.dumps({"camera_config": {**lens, "image_width_px": 80, "image_height_px": 60}})
    )
    options = ("--camera-config", tmp_path / "lens.json", "--camera-height", "2.8")
    lines = simulate(tmp_path, SMALL, *options)
    config = experiment.read_config(tmp_path / "exp" / "config.json")
    assert config.camera.T_room_camera[:3, 3].tolist() == [2.33, 2.33, 2.8]
    assert media.read_rgb(tmp_path / "exp" / lines[0]["frame"]["rgb"]).shape == (60, 80, 3)


@pytest.mark.parametrize("name", ["materials", "meeting", "wide-lens"])
def test_the_examples_are_scenarios(name):
    done("avsim-scene", ROOT / "examples" / "scenarios" / f"{name}.json", "--print-scenario")


def test_the_library_gives_what_the_command_writes(tmp_path):
    lines = simulate(tmp_path, SMALL)
    exp = tmp_path / "exp"
    scene = film.simulate(SMALL)
    written = experiment.read_config(exp / "config.json")
    assert {**scene.config.raw, "written_by": written.raw["written_by"]} == written.raw
    np.testing.assert_array_equal(scene.background, media.read_depth(exp / written.camera.background_depth))
    for record, truth, shot, frame in zip(lines, scene.truth, scene.shots(), scene.frames(), strict=True):
        assert truth.timestamp == shot.timestamp == frame.timestamp == record["timestamp"]
        paths = records.frame(record)
        np.testing.assert_array_equal(shot.rgb, media.read_rgb(exp / paths.rgb))
        np.testing.assert_array_equal(shot.depth, media.read_depth(exp / paths.depth))
        assert frame.record == {key: value for key, value in record.items() if key != "frame"}
        said = records.identified(record)
        np.testing.assert_array_equal(truth.mouths, said.mouths)
        np.testing.assert_array_equal(truth.speaking, said.speaking)
        assert np.isfinite(said.boxes_px).all()
        assert np.isnan(truth.boxes_px).all()


def test_a_scene_without_video_needs_no_graphics_and_refuses_pictures(monkeypatch):
    monkeypatch.setattr(render, "Renderer", None)
    scene = film.simulate("random", people=2, duration=0.5, seed=4, video=False)
    assert scene.background is None
    assert [len(truth) for truth in scene.truth] == [2] * 6
    with pytest.raises(ValueError, match="video=True"):
        scene.shots()


def test_a_scene_is_drawn_when_it_is_asked_for():
    shots = film.simulate({**SMALL, "duration_s": 3600.0}).shots()
    assert next(shots).timestamp == 0.0
    assert next(shots).timestamp == 0.1


def test_an_unknown_scenario_lists_the_known_ones():
    with pytest.raises(FileNotFoundError, match="s1, s2, s3, s4, random"):
        film.simulate("s9", video=False)


def test_the_samples_in_the_docstring_run():
    tried = doctest.testmod(film)
    assert tried.attempted
    assert not tried.failed


def test_one_picture_of_the_two_can_be_asked_for(tmp_path):
    both = simulate(tmp_path / "both", SMALL)
    for wanted, other in (("rgb", "depth"), ("depth", "rgb")):
        lines = simulate(tmp_path / wanted, SMALL, "--pictures", wanted)
        exp = tmp_path / wanted / "exp"
        assert not (exp / "video" / other).exists()
        assert [line["objects"] for line in lines] == [line["objects"] for line in both]
        for line, full in zip(lines, both, strict=True):
            assert line["frame"] == {wanted: full["frame"][wanted]}
            assert (exp / line["frame"][wanted]).read_bytes() == (
                tmp_path / "both" / "exp" / full["frame"][wanted]
            ).read_bytes()
            assert records.frame(line).depth == line["frame"].get("depth")
    assert ("background_depth" in json.loads((tmp_path / "rgb/exp/config.json").read_text())["camera_config"]) is False
    found = done("avdetect-video", "--detector", "depth", "-C", exp, stdin=b"".join(map(records.encode, lines)))
    assert [len(records.decode(line)["objects"]) for line in found.stdout.splitlines()] == [1] * 4
    refused(run("avsim-scene", "s1", "-C", tmp_path / "no", "--pictures", "depth", "--jpeg", "80"), "--jpeg", status=2)


def test_what_does_not_change_is_neither_drawn_nor_encoded_again(tmp_path, monkeypatch):
    from avcli.scene import load, output
    from avcli.scene.settings import Drawing, Effects

    encoded = []
    encode = png.Encoder.encode
    monkeypatch.setattr(png.Encoder, "encode", lambda self, one: encoded.append(one.shape) or encode(self, one))
    empty = load.build({**SMALL, "people": [], "duration_s": 2.0}, "empty")

    def written(name, effects):
        encoded.clear()
        drawn = film.Film(empty, Drawing(), effects)
        (tmp_path / name).mkdir()
        lines = list(output.write(drawn, tmp_path / name, output.Files(), drawn._timing))
        return drawn.account, [(tmp_path / name / line["frame"]["rgb"]).read_bytes() for line in lines]

    account, files = written("clean", Effects())
    assert (account.drawn, account.again) == (1, 20)
    assert len(encoded) == 3  # colour, depth, and the depth of the empty room
    assert len(files) == 21
    assert len(set(files)) == 1
    _, files = written("balanced", Effects(white_balance=1.0, vignetting=0.2))
    assert len(encoded) == 3
    assert len(set(files)) == 1
    _, files = written("noisy", Effects(read_noise=2.0))
    assert len(encoded) == 23  # every colour picture has noise of its own
    assert len(set(files)) == 21


def test_a_sensor_is_a_set_of_effects_that_options_refine(tmp_path):
    from avcli.scene.settings import Drawing, Effects, with_sensor

    drawing, effects = with_sensor("ip-camera", Drawing(), Effects(jpeg_quality=95))
    assert effects.jpeg_quality == 95
    assert effects.time_stamp
    assert drawing.shutter_s > 0
    assert with_sensor("clean", Drawing(), Effects()) == (Drawing(), Effects())
    pictures = {}
    for name, scenario, options in (
        ("clean", SMALL, []),
        ("key", {**SMALL, "sensor": "webcam"}, []),
        ("option", SMALL, ["--sensor", "webcam"]),
        ("other", {**SMALL, "sensor": "webcam"}, ["--sensor", "clean"]),
        ("stamp", SMALL, ["--time-stamp"]),
    ):
        line = simulate(tmp_path / name, scenario, *options)[2]
        pictures[name] = media.read_rgb(tmp_path / name / "exp" / line["frame"]["rgb"]).astype(int)
    assert (pictures["key"] == pictures["option"]).all()
    assert (pictures["other"] == pictures["clean"]).all()
    changed = (pictures["key"] != pictures["clean"]).any(-1)
    assert changed.mean() > 0.5
    assert np.abs(pictures["key"] - pictures["clean"]).mean() < 15
    rows, _ = np.nonzero((pictures["stamp"] != pictures["clean"]).any(-1))
    assert 0 < len(rows) < 3000
    assert rows.max() < 20


def test_blur_and_sharpening_change_the_finest_contrast():
    from avcli.scene import sensor
    from avcli.scene.settings import Effects

    picture = np.full((64, 64, 3), 100, np.uint8)
    picture[:, 32:] = 140
    soft, sharp = (
        sensor.expose(picture, effects, (32, 32), np.random.default_rng(0)).astype(int)
        for effects in (Effects(blur_px=1.5), Effects(sharpening=1.0))
    )
    assert (np.diff(soft[30, :, 0]) >= 0).all()
    assert np.diff(soft[30, :, 0]).max() < 20
    assert sharp.max() > 145
    assert sharp.min() < 95
    assert (sharp[:, :20] == 100).all()


def test_an_empty_room_is_kept_for_the_next_run(tmp_path):
    from avcli.scene import load
    from avcli.scene.settings import Drawing

    rooms = tmp_path / "avcli" / "rooms"

    def frame(scenario, folder=rooms):
        drawn = film.Film(load.build({**scenario, "duration_s": 0}, "room"), Drawing(), rooms=folder)
        return next(drawn.frames()).rgb.tobytes(), drawn.cache.saved_s if drawn.cache else None

    drawn, _ = frame(SMALL, None)
    assert not rooms.exists()
    assert frame(SMALL) == (drawn, 0)
    (kept,) = rooms.iterdir()
    again, saved = frame({**SMALL, "name": "other"})
    assert again == drawn
    assert saved > 0
    kept.write_bytes(b"no picture")
    assert frame(SMALL) == (drawn, 0)
    shutil.rmtree(rooms)
    rooms.write_text("not a folder")
    assert frame(SMALL) == (drawn, 0)
    env = {"XDG_CACHE_HOME": str(tmp_path / "home")}
    command = ("avsim-scene", "-", "-v", "--no-cache", "--duration", "0", "-C", tmp_path / "exp")
    result = done(*command, stdin=json.dumps(SMALL), env=env)
    assert "drawn by" in result.stderr
    assert not (tmp_path / "home" / "avcli").exists()


def test_the_cache_of_rooms_is_bounded(tmp_path):
    from avcli.scene import furniture, room_cache

    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), np.uint8)  # 30 kB each
    for index in range(5):
        cache = room_cache.RoomCache(tmp_path, index, furniture.join([]), most_bytes=100_000)
        cache.store("GL", noise, 0.5)
        os.utime(next(tmp_path.glob(f"{cache._key('GL')}.*")), (index, index))
    left = [room_cache.RoomCache(tmp_path, k, furniture.join([])).load("GL", (100, 100)) is not None for k in range(5)]
    assert left == [False, False, True, True, True]
    assert room_cache.RoomCache(tmp_path, 4, furniture.join([])).load("another GL", (100, 100)) is None
    ball = furniture.build(
        {"kind": "sphere", "position_m": [1, 1, 1], "radius_m": 0.5, "material": "paint", "color": [1, 1, 1]}, None
    )
    assert room_cache.RoomCache(tmp_path, 4, ball).load("GL", (100, 100)) is None
