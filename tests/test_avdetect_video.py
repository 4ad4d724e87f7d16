"""avdetect-video as a process: what it reads, what it writes, and what it says when something is wrong."""

import http.server
import json
import os
import re
import shutil
import threading

import numpy as np
import pytest
from conftest import run
from detection_people import KB8, cast, ceiling_view
from test_detection_network import model, rows

from avcli.detection.detector import detect
from avcli.detection.network import Letterbox
from avcli.formats import experiment, footage, media

PEOPLE = [(1.2, 2.3, 0.0, 0.3, 1.75), (3.4, 2.6, 2.0, -0.3, 1.65)]
STEP = 1e-4


DEPTH = "avdetect-video", "--detector", "depth"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An experiment of three small frames: nobody, one, two people."""
    folder = tmp_path_factory.mktemp("experiment")
    view = ceiling_view(4)
    fx, fy, cx, cy, *k = KB8
    camera = {
        "lens_model": "kannala_brandt",
        "fx_px": fx / 4, "fy_px": fy / 4, "cx_px": (cx - 1.5) / 4, "cy_px": (cy - 1.5) / 4,
        "k1": k[0], "k2": k[1], "k3": k[2], "k4": k[3],
        "image_width_px": 480, "image_height_px": 270, "frame_rate_hz": 10,
        "camera_position_m": [2.33, 2.33, 2.5], "camera_rotation_deg": [90, 0, 0],
        "depth_step_m": STEP, "background_depth": experiment.Layout.background_depth,
    }  # fmt: skip
    for kind in ("rgb", "depth"):
        (folder / "video" / kind).mkdir(parents=True)
    experiment.write_config(folder / "config.json", {"camera_config": camera})
    save(folder / experiment.Layout.background_depth, cast(view))
    lines = []
    for index in range(3):
        depth = cast(view, PEOPLE[:index])
        names = {"rgb": experiment.Layout.rgb(index / 10), "depth": experiment.Layout.depth(index / 10)}
        save(folder / names["depth"], depth)
        media.write_png(folder / names["rgb"], np.repeat((depth * 60).astype(np.uint8)[..., None], 3, axis=2))
        truth = [{"object_id": k, "position": [*person[:2], 0.0]} for k, person in enumerate(PEOPLE[:index])]
        lines.append({"timestamp": index / 10, "objects": truth, "frame": names})
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def save(path, depth):
    media.write_png(path, np.rint(depth / STEP).clip(0, 65535).astype(np.uint16))


@pytest.fixture
def folder(made, tmp_path):
    """A copy that a test may break."""
    return shutil.copytree(made, tmp_path / "experiment")


def found(result):
    assert (result.returncode, result.stderr) == (0, "")
    return [json.loads(line) for line in result.stdout.splitlines()]


def refused(result, *words, code=1):
    assert result.returncode == code, result.stderr
    assert result.stderr.startswith("avdetect-video: ")
    assert result.stderr.count("\n") == 1
    for word in words:
        assert word in result.stderr


def test_people_before_the_empty_room(made):
    records = found(run(*DEPTH, "-C", made, made / "frames.jsonl"))
    assert [record["timestamp"] for record in records] == ["0.0000000000", "0.1000000000", "0.2000000000"]
    assert [len(record["objects"]) for record in records] == [0, 1, 2]
    assert {(record["sensor"], record["kind"]) for record in records} == {("video", "camera")}
    for one, person in zip(records[2]["objects"], PEOPLE, strict=True):
        assert np.linalg.norm(np.array(one["position"][:2]) - person[:2]) < 0.12
        assert np.linalg.eigvalsh(one["covariance"])[0] > 0
        assert set(one) == {"position", "covariance", "score", "bbox_px", "height"}


def test_what_people_wear_is_said_where_it_is_asked_for(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "experiment")
    picture = np.full((270, 480, 3), (90, 120, 100), np.uint8)
    media.write_png(folder / experiment.Layout.rgb(0.2), picture)
    line = (folder / "frames.jsonl").read_text().splitlines()[2]
    plain = found(run(*DEPTH, "-C", folder, stdin=line))[0]["objects"]
    told = found(run(*DEPTH, "--features", "-C", folder, stdin=line))[0]["objects"]
    for one in told:
        looks = one.pop("features")["looks"]
        assert looks["kind"] == "clothes"
        assert looks["vector"][1] == pytest.approx(np.log(0.5), abs=1e-3)  # as bright as the room
        assert all((a is None) == (b is None) for a, b in zip(looks["vector"], looks["sd"], strict=True))
    assert told == plain


def test_ground_truth_that_passes_by_changes_nothing(made):
    lines = [json.loads(line) for line in (made / "frames.jsonl").read_text().splitlines()]
    bare = "".join(json.dumps({"timestamp": line["timestamp"], "frame": line["frame"]}) + "\n" for line in lines)
    other = '{"timestamp": 0, "audio": {"path": "a.wav"}}\n' + bare
    expected = run(*DEPTH, "-C", made, made / "frames.jsonl").stdout
    assert run(*DEPTH, "-C", made, stdin=bare).stdout == expected
    assert run(*DEPTH, "-C", made, "-", stdin=other).stdout == expected


def test_depth_pictures_by_name_give_the_same(made):
    by_records = run(*DEPTH, "-C", made, made / "frames.jsonl").stdout
    frames = sorted((made / "video" / "depth").glob("Depth_frame_*.png"))
    assert run(*DEPTH, "-C", made, *frames).stdout == by_records
    assert run(*DEPTH, "-C", made, made / "video" / "depth").stdout == by_records  # without the empty room's picture


def test_the_bytes_are_the_same_with_any_number_of_threads(made):
    once = run("avdetect-video", "-C", made, made / "frames.jsonl").stdout
    assert run("avdetect-video", "-C", made, "--threads", "2", made / "frames.jsonl").stdout == once


def test_nothing_in_nothing_out(made):
    assert found(run("avdetect-video", "-C", made, stdin="")) == []


# --- networks ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def network(tmp_path):
    """A model file that sees the first of PEOPLE in any picture."""
    view = ceiling_view(4)
    v, u = np.nonzero(cast(view, PEOPLE[:1]) < cast(view) - 0.03)
    box = Letterbox.fit((480, 270), (96, 64)).to_input(np.array([[u.min(), v.min()], [u.max() + 1, v.max() + 1]]))
    table = rows(84)
    table[5, :4] = [*box.mean(axis=0), *(box[1] - box[0])]
    path = tmp_path / "model.onnx"
    path.write_bytes(model(table.T[None]))
    return path


def test_a_model_places_what_it_sees(folder, network):
    (folder / "config.json").write_text((folder / "config.json").read_text().replace("background_depth", "unused"))
    records = found(run("avdetect-video", "-C", folder, "--model", network, folder / "frames.jsonl"))
    assert [len(record["objects"]) for record in records] == [1, 1, 1]
    alone = found(run("avdetect-video", "-C", folder, "--model", network, "--monocular", folder / "frames.jsonl"))
    assert [len(record["objects"]) for record in alone] == [1, 1, 1]
    pictures = sorted((folder / "video" / "rgb").glob("*.png"))
    assert found(run("avdetect-video", "-C", folder, "--model", network, *pictures)) == alone


def test_a_box_where_depth_shows_the_empty_room_is_nobody(made, network):
    first = found(run("avdetect-video", "-C", made, "--model", network, made / "frames.jsonl"))[0]
    assert first["objects"] == []


def test_the_thesiss_way(made, network):
    options = ["-C", made, "--model", network, "--preset", "thesis", made / "frames.jsonl"]
    assert [len(record["objects"]) for record in found(run("avdetect-video", *options))] == [1, 1, 1]


def test_a_real_network_runs(made, shared_data):
    network = shared_data / "models" / "yolox_nano.onnx"
    records = found(run("avdetect-video", "-C", made, "--model", network, made / "frames.jsonl"))
    assert len(records) == 3


def test_a_size_for_a_model_that_has_its_own_is_refused(made, network):
    options = ["--model", network, made / "frames.jsonl"]
    refused(run("avdetect-video", "-C", made, "--imgsz", "640x384", *options), "--imgsz", "96 × 64", code=2)
    assert len(found(run("avdetect-video", "-C", made, "--imgsz", "96x64", *options))) == 3


def test_the_library_finds_the_same(made):
    config = experiment.read_config(made / "config.json")
    lines = [json.loads(line) for line in (made / "frames.jsonl").read_text().splitlines()]
    shots = [media.Shot(line["timestamp"], None, media.read_depth(made / line["frame"]["depth"])) for line in lines]
    empty = media.read_depth(made / experiment.Layout.background_depth)
    for one, record in zip(
        detect(config, shots, background=empty, detector="depth"),
        found(run(*DEPTH, "-C", made, made / "frames.jsonl")),
        strict=True,
    ):
        assert (f"{one.timestamp:.10f}", one.sensor, one.kind) == (record["timestamp"], "video", "camera")
        keys = {"positions": "position", "covariances": "covariance", "scores": "score", "heights": "height"}
        for name, key in keys.items():
            expected = np.array([item[key] for item in record["objects"]], float)
            assert np.array_equal(getattr(one, name), expected.reshape(getattr(one, name).shape), equal_nan=True)
        assert one.boxes_px.tolist() == [item["bbox_px"] for item in record["objects"]]


@pytest.mark.parametrize(
    ("content", "word"),
    [(b"", "empty"), (b"no model", "not an ONNX model"), (b"version https://git-lfs.github.com/spec/v1\n", "git-lfs")],
)
def test_a_file_that_is_no_model(made, tmp_path, content, word):
    (tmp_path / "m.onnx").write_bytes(content)
    result = run("avdetect-video", "-C", made, "--model", tmp_path / "m.onnx", made / "frames.jsonl")
    refused(result, "m.onnx", word, code=2 if not content else 1)


# --- pictures that are wrong ------------------------------------------------------------------------------------------


def broken(folder, kind, how):
    path = folder / (experiment.Layout.depth(0.1) if kind == "depth" else experiment.Layout.rgb(0.1))
    content = path.read_bytes()
    if how == "missing":
        path.unlink()
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "no picture":
        path.write_bytes(b"this is no picture")
    elif how == "truncated":
        path.write_bytes(content[:100])
    elif how == "another size":
        media.write_png(path, np.zeros((100, 200), np.uint16))
    elif how == "colour":
        media.write_png(path, np.zeros((270, 480, 3), np.uint8))


@pytest.mark.parametrize("how", ["missing", "empty", "no picture", "truncated", "another size", "colour"])
def test_a_depth_picture_that_is_wrong(folder, how):
    broken(folder, "depth", how)
    refused(run(*DEPTH, "-C", folder, folder / "frames.jsonl"))


def test_a_picture_that_is_wrong_can_be_skipped(folder):
    broken(folder, "depth", "truncated")
    skipping = run(*DEPTH, "-C", folder, "--skip-invalid", folder / "frames.jsonl")
    assert skipping.returncode == 0
    assert [json.loads(line)["timestamp"][:3] for line in skipping.stdout.splitlines()] == ["0.0", "0.2"]
    assert "skipped" in skipping.stderr


@pytest.mark.parametrize("how", ["missing", "truncated", "another size"])
def test_a_colour_picture_that_is_wrong(folder, network, how):
    broken(folder, "rgb", how)
    refused(run("avdetect-video", "-C", folder, "--model", network, folder / "frames.jsonl"))


@pytest.mark.parametrize("value", [0, 65535])
def test_depth_without_a_measurement_is_nobody(folder, value):
    media.write_png(folder / experiment.Layout.depth(0.2), np.full((270, 480), value, np.uint16))
    records = found(run(*DEPTH, "-C", folder, folder / "frames.jsonl"))
    assert [len(record["objects"]) for record in records] == [0, 1, 0]


@pytest.mark.parametrize("channels", ["grey", "rgba", "16 bit"])
def test_colour_pictures_of_other_kinds(folder, network, channels):
    import cv2

    picture = {
        "grey": np.full((270, 480), 90, np.uint8),
        "rgba": np.full((270, 480, 4), 90, np.uint8),
        "16 bit": np.full((270, 480, 3), 90 << 8, np.uint16),
    }[channels]
    assert cv2.imwrite(str(folder / experiment.Layout.rgb(0.2)), picture)
    options = ["--model", network, "--monocular", folder / "frames.jsonl"]
    assert len(found(run("avdetect-video", "-C", folder, *options))[2]["objects"]) == 1


def test_colour_alone_needs_no_picture_of_the_empty_room(folder, network):
    (folder / experiment.Layout.background_depth).unlink()
    records = found(run("avdetect-video", "-C", folder, "--model", network, folder / "video" / "rgb"))
    assert [len(record["objects"]) for record in records] == [1, 1, 1]


def test_depth_pictures_without_their_detector_are_noticed(made, network):
    depth = (made / experiment.Layout.depth(0.0)).parent
    ran = run("avdetect-video", "-C", made, "--model", network, depth)
    assert ran.returncode == 0
    assert len(ran.stdout.splitlines()) == 3
    assert "--detector depth" in ran.stderr
    assert len(ran.stderr.splitlines()) == 1
    assert not run("avdetect-video", "-C", made, "--model", network, (made / experiment.Layout.rgb(0.0)).parent).stderr


def test_a_record_without_depth(made, network):
    line = json.dumps({"timestamp": 0.0, "frame": {"rgb": experiment.Layout.rgb(0.0)}}) + "\n"
    refused(run(*DEPTH, "-C", made, stdin=line), "no depth picture")
    assert len(found(run("avdetect-video", "-C", made, "--model", network, stdin=line))[0]["objects"]) == 1


def test_no_background(folder):
    (folder / experiment.Layout.background_depth).unlink()
    refused(run(*DEPTH, "-C", folder, folder / "frames.jsonl"), "Depth_background.png")
    (folder / "config.json").write_text((folder / "config.json").read_text().replace("background_depth", "unused"))
    refused(run(*DEPTH, "-C", folder, folder / "frames.jsonl"), "background_depth")


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["nowhere.jsonl"], "nowhere.jsonl"),
        (["nowhere.png"], "nowhere.png"),
        (["nowhere.mp4", "--model", "m.onnx"], "nowhere.mp4"),
        (["/dev/video99", "--model", "m.onnx"], "/dev/video99"),
        (["--detector", "depth", "--model", "m.onnx"], "--model"),
        (["--detector", "depth", "--monocular"], "--monocular"),
        (["--detector", "depth", "--imgsz", "640x384"], "--imgsz has no effect with --detector depth"),
        (["--detector", "depth", "--iou", "0.5"], "--iou"),
        (["--detector", "depth", "--confidence", "0.5"], "--confidence"),
        (["--detector", "depth", "--refresh", "10"], "--refresh"),
        (["--detector", "depth", "--threads", "1"], "--threads"),
        (["--detector", "depth", "--position", "body"], "--position"),
        (["--monocular", "--position", "centre"], "--position has no effect with --monocular"),
        (["--rate", "5"], "--rate"),
        (["--overlay", "one.jpg"], "--overlay"),
        (["--overlay", "clip.avi", "clip.avi"], "--overlay clip.avi: this file is an input"),
        (["--imgsz", "big"], "--imgsz"),
        (["--imgsz", "16x16"], "--imgsz"),
        (["--confidence", "2"], "--confidence"),
        (["--model", "nowhere.onnx"], "nowhere.onnx"),
    ],
)
def test_wrong_usage(made, options, word):
    line = (made / "frames.jsonl").read_text().splitlines()[0] + "\n"
    refused(run("avdetect-video", "-C", made, *options, stdin=line), word, code=2)


# --- other sources and drawings ---------------------------------------------------------------------------------------


def test_colour_alone_is_not_compared_with_the_empty_rooms_depth(folder, network):
    config = json.loads((folder / "config.json").read_text())
    config["camera_config"]["camera_rotation_deg"] = [-90, 0, 0]
    (folder / "config.json").write_text(json.dumps(config))
    up = run("avdetect-video", "-C", folder, "--model", network, folder / "video/rgb")
    assert "3 boxes have no place: none of their rays reaches the floor" in up.stderr
    assert "is camera_rotation_deg right?" in up.stderr


@pytest.mark.parametrize(("step", "where"), [(10 * STEP, "m below the floor"), (STEP / 10, "m below the camera")])
def test_depth_that_cannot_be_of_the_room_is_doubted(folder, step, where):
    config = json.loads((folder / "config.json").read_text())
    config["camera_config"]["depth_step_m"] = step
    (folder / "config.json").write_text(json.dumps(config))
    doubted = run(*DEPTH, "-C", folder, folder / "frames.jsonl")
    assert where in doubted.stderr
    assert "depth_step_m" in doubted.stderr


def test_pictures_that_are_missing_by_their_numbers_are_said(folder, network, tmp_path):
    (tmp_path / "film").mkdir()
    picture = next((folder / "video/rgb").iterdir())
    for number in (*range(8), *range(9, 12)):
        shutil.copy(picture, tmp_path / f"film/img{number}.png")
    result = run("avdetect-video", "-C", folder, "--model", network, tmp_path / "film")
    assert len(result.stdout.splitlines()) == 11
    said = f"pictures that are missing by the numbers in the names: 1, the first after {tmp_path}/film/img7.png"
    assert said in result.stderr
    shutil.copy(picture, tmp_path / "film/img8.png")
    assert "missing" not in run("avdetect-video", "-C", folder, "--model", network, tmp_path / "film").stderr


def test_a_video_and_its_rate(folder, network, tmp_path):
    import cv2

    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20, (480, 270))
    for _ in range(10):
        writer.write(np.full((270, 480, 3), 90, np.uint8))
    writer.release()
    options = ["-C", folder, "--model", network, "--overlay", tmp_path / "drawn.mp4", tmp_path / "clip.avi"]
    every = found(run("avdetect-video", *options))
    assert footage.frame_rate(str(tmp_path / "drawn.mp4")) == 20.0
    assert [float(record["timestamp"]) for record in every] == pytest.approx(np.arange(10) / 20)
    some = found(run("avdetect-video", *options, "--rate", "10"))
    assert [float(record["timestamp"]) for record in some] == pytest.approx(np.arange(5) / 10)
    assert footage.frame_rate(str(tmp_path / "drawn.mp4")) == 10.0
    capture = cv2.VideoCapture(str(tmp_path / "drawn.mp4"))
    assert capture.read()[1].shape == (270, 480, 3)


def test_an_overlay_that_cannot_be_written_is_named(made, tmp_path):
    (tmp_path / "drawn").write_text("a file")
    result = run(*DEPTH, "-C", made, "--overlay", tmp_path / "drawn", "-o", tmp_path / "v.jsonl", made / "frames.jsonl")
    refused(result, f"{tmp_path / 'drawn'}: File exists", code=74)


def test_an_overlay_of_pictures(made, tmp_path):
    target = tmp_path / "drawn"
    run(*DEPTH, "-C", made, "--overlay", target, made / "frames.jsonl")
    pictures = sorted(target.iterdir())
    assert [path.name for path in pictures] == [f"overlay_0.{k}000000000.png" for k in range(3)]
    original = media.read_rgb(made / experiment.Layout.rgb(0.2))
    assert (media.read_rgb(pictures[2]) != original).any()


def test_a_live_pipe_is_answered_frame_by_frame(made):
    import subprocess

    from conftest import BIN

    command = [BIN / "avdetect-video", "-C", made]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        for line in (made / "frames.jsonl").read_bytes().splitlines(keepends=True):
            os.write(process.stdin.fileno(), line)
            assert json.loads(process.stdout.readline())["timestamp"][:3] in ("0.0", "0.1", "0.2")
        process.stdin.close()
        assert process.wait(20) == 0


def test_a_film_of_depth_and_a_pattern_say_what_the_pictures_say(folder, tmp_path):
    import cv2

    pictures = [media.read_depth(folder / experiment.Layout.depth(k / 10)) for k in range(3)]
    depth = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    kind = cv2.VideoWriter.fourcc(*"FFV1")
    film = cv2.VideoWriter(str(tmp_path / "depth.mkv"), cv2.CAP_FFMPEG, kind, 10, (480, 270), depth)
    for number, picture in enumerate(pictures, 8):  # 8, 9, 10: by number, not by name
        film.write(picture)
        media.write_png(tmp_path / f"d{number}.png", picture)
    film.release()
    expected = found(run(*DEPTH, "-C", folder, folder / "frames.jsonl"))
    result = run(*DEPTH, "-C", folder, tmp_path / "depth.mkv", env={})  # a process that has not loaded OpenCV
    assert found(result) == expected
    assert result.stderr == ""
    assert found(run(*DEPTH, "-C", folder, tmp_path / "d%d.png")) == expected
    refused(run(*DEPTH, "-C", folder, tmp_path / "e%d.png"), "no file matches this pattern", code=2)


def test_a_film_of_eight_bits_is_no_depth(folder, tmp_path):
    import cv2

    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20, (480, 270))
    writer.write(np.zeros((270, 480, 3), np.uint8))
    writer.release()
    refused(run(*DEPTH, "-C", folder, tmp_path / "clip.avi"), "16 bits", "gray16le")


def test_a_stream_at_an_address(folder, network):
    """A camera that sends JPEGs over HTTP, as many cheap ones do."""
    import cv2

    jpeg = cv2.imencode(".jpg", np.full((270, 480, 3), 90, np.uint8))[1].tobytes()

    class Camera(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            for _ in range(12):
                self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg + b"\r\n")

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/stream"
        result = run("avdetect-video", "-C", folder, "--model", network, address)
        server.shutdown()
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()
    assert float(json.loads(result.stdout.splitlines()[0])["timestamp"]) > 1e9
    assert f"{address}: no more pictures come" in result.stderr
    nobody = run("avdetect-video", "-C", folder, "--model", network, "http://127.0.0.1:9/nothing")
    refused(nobody, "no stream of pictures answers")


def test_windows_for_the_own_network_are_warned_of(folder):
    result = run("avdetect-video", "-C", folder, "--windows", "4", "--monocular", folder / "frames.jsonl")
    assert result.returncode == 0
    assert "misses most people in windows" in result.stderr


def test_windows_give_turned_boxes_and_say_what_they_skipped(folder, network):
    options = "-v", "--windows", "4", "--model", network, "--monocular"
    result = run("avdetect-video", "-C", folder, *options, folder / "frames.jsonl")
    assert result.returncode == 0, result.stderr
    assert re.search(r"not computed: \d+ of 12 windows", result.stderr)
    for line in result.stdout.splitlines():
        for one in json.loads(line)["objects"]:
            assert len(one["turned_px"]) == 5


def test_records_without_frames_are_not_passed_over_in_silence(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    result = run("avdetect-video", "-C", tmp_path, stdin='{"timestamp":0}\n{"timestamp":1,"audio":null}\n')
    assert (result.returncode, result.stdout) == (0, b"")
    assert "none of the 2 records is a frame" in result.stderr
    assert run("avdetect-video", "-C", tmp_path).stderr == ""  # an empty stream is no mistake


def test_a_time_that_goes_back_is_said_once_and_nothing_is_lost(made):
    lines = (made / "frames.jsonl").read_text().splitlines()
    mixed = "".join(f"{lines[k]}\n" for k in (2, 1, 2, 0))
    result = run(*DEPTH, "-C", made, stdin=mixed)
    assert result.returncode == 0
    assert [len(json.loads(line)["objects"]) for line in result.stdout.splitlines()] == [2, 1, 2, 0]
    first, count = result.stderr.splitlines()
    assert "time goes back from 0.2000 to 0.1000 s" in first
    assert count.startswith("avdetect-video: 2 ")


def test_a_named_camera_of_several_is_used(tmp_path):
    lens = {"lens_model": "kannala_brandt", "fx_px": 60, "fy_px": 60, "cx_px": 79.5, "cy_px": 59.5}
    camera = lens | {"image_width_px": 160, "image_height_px": 120, "camera_rotation_deg": [90, 0, 0]}
    camera |= {"depth_step_m": 0.001, "background_depth": "empty.png"}
    cameras = {name: camera | {"camera_position_m": [x, 2, 2.5]} for name, x in (("left", 2), ("right", 5))}
    sensors = {name: {"kind": "camera", "camera_config": one} for name, one in cameras.items()}
    sensors["ring"] = {"kind": "microphones"}
    (tmp_path / "config.json").write_text(json.dumps({"sensors": sensors}))
    empty = np.full((120, 160), 2500, np.uint16)
    media.write_png(tmp_path / "empty.png", empty)
    depth = empty.copy()
    depth[50:66, 90:106] = 1100
    media.write_png(tmp_path / "seen.png", depth)
    found = {}
    for name in cameras:
        result = run("avdetect-video", "-C", tmp_path, "--detector", "depth", "--sensor", name, tmp_path / "seen.png")
        assert result.returncode == 0, result.stderr
        record = json.loads(result.stdout)
        found[name] = record["objects"][0]["position"]
        assert record["sensor"] == name
    assert found["right"][0] - found["left"][0] == pytest.approx(3)
    wrong = run("avdetect-video", "-C", tmp_path, "--detector", "depth", "--sensor", "ring", tmp_path / "seen.png")
    assert (wrong.returncode, "these are microphones" in wrong.stderr) == (2, True)
    for raw, name in (({}, "video"), ({}, "rihgt"), ({"camera_config": cameras["left"]}, "rihgt")):
        (tmp_path / "config.json").write_text(json.dumps({**raw, "sensors": sensors}))
        wrong = run("avdetect-video", "-C", tmp_path, "--sensor", name, tmp_path / "seen.png")
        assert wrong.returncode == 2
        assert "no camera of this name; it has left, right" in wrong.stderr


def test_a_folder_of_folders_is_told_from_one_of_pictures(folder, tmp_path):
    (tmp_path / "deeper" / "rgb").mkdir(parents=True)
    result = run("avdetect-video", "-C", folder, tmp_path / "deeper")
    assert result.returncode == 2
    assert "no pictures in this folder; name one of its folders (rgb)" in result.stderr


def test_a_camera_in_centimetres_is_asked_about(folder):
    config = json.loads((folder / "config.json").read_text())
    config["room_config"] = {"room_dimensions_m": [4.66, 4.66, 3]}
    config["camera_config"]["camera_position_m"] = [233, 233, 250]
    (folder / "config.json").write_text(json.dumps(config))
    said = run("avdetect-video", "-C", folder, folder / "frames.jsonl").stderr
    assert "camera_position_m is outside the room of 4.66 × 4.66 × 3 m in " in said
