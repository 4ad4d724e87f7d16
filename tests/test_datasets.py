"""Importers of public data sets, on small files of the same layout."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
import soundfile
from conftest import done, run
from forked import run_forked
from localization_rooms import MICROPHONES, heard, voice

EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "datasets"
OFFSET = np.array([2.33, 2.33, 0.0])


def write_table(path, names, rows):
    path.write_text("\n".join(["\t".join(names), *("\t".join(f"{cell:.6f}" for cell in row) for row in rows)]) + "\n")


def stamped(times):
    """Columns of LOCATA's times (n, 6), across an hour."""
    return [[2018, 1, 12, *divmod(59 + (58 + t) // 60, 60), (58 + t) % 60] for t in times]


TIME = ["year", "month", "day", "hour", "minute", "second"]


@pytest.fixture(scope="module")
def locata(tmp_path_factory):
    """A recording of LOCATA's layout, in which somebody speaks in one place; and that place."""
    folder = tmp_path_factory.mktemp("task1") / "ring"
    folder.mkdir()
    fs, place = 16000, np.array([1.5, 3.0, 1.5])
    samples = heard(place, voice(1.5, fs, np.random.default_rng(0)), fs)
    soundfile.write(folder / "audio_array_ring.wav", samples, fs)
    moments = np.arange(len(samples)) / fs
    write_table(folder / "audio_array_timestamps_ring.txt", TIME, stamped(moments[:100]))
    at = np.arange(0.0, 1.6, 1 / 120)
    axes = [f"mic{number}_{axis}" for number in range(1, 9) for axis in "xyz"]
    centred = (MICROPHONES - OFFSET).ravel().tolist()
    write_table(folder / "position_array_ring.txt", TIME + axes, [row + centred for row in stamped(at)])
    there = (place - OFFSET).tolist()
    write_table(folder / "position_source_loudspeaker1.txt", [*TIME, "x", "y", "z"], [r + there for r in stamped(at)])
    return folder, place


def importer(name, *arguments):
    return run_forked(str(EXAMPLES / f"{name}.py"), *arguments)


def imported(folder, out):
    return importer("locata", folder, "-C", out, "--room", 4.66, 4.66, 3, "--offset", *OFFSET)


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def in_place(records):
    """The positions (n, 3) of all objects of records, m."""
    return np.array([one["position"] for record in records for one in record["objects"]])


def test_a_recording_of_locata_becomes_an_experiment(locata, tmp_path):
    folder, place = locata
    result = imported(folder, tmp_path)
    assert result.returncode == 0, result.stderr
    config = json.loads((tmp_path / "config.json").read_text())
    assert np.allclose(config["microphone_config"]["mic_positions_m"], MICROPHONES, atol=1e-5)
    truth = [json.loads(line) for line in (tmp_path / "groundtruth_sources.jsonl").read_text().splitlines()]
    assert [record["timestamp"] for record in truth[:3]] == [0.0, 0.1, 0.2]
    assert all(np.allclose(record["objects"][0]["mouth_position"], place, atol=1e-5) for record in truth)
    found = done("avdetect-audio", "-C", tmp_path, tmp_path / "audio.jsonl")
    places = [one["position"] for line in found.stdout.splitlines() for one in json.loads(line)["objects"]]
    assert np.linalg.norm(np.median(places, axis=0)[:2] - place[:2]) < 0.1


def test_what_locata_does_not_say_is_refused(locata, tmp_path):
    folder, _ = locata
    assert "expected one audio_array_NAME.wav, found 0" in imported(tmp_path, tmp_path / "out").stderr
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert "is not empty" in imported(folder, tmp_path / "full").stderr
    moving = tmp_path / "moving"
    moving.mkdir()
    for path in folder.iterdir():
        (moving / path.name).write_bytes(path.read_bytes())
    lines = (folder / "position_array_ring.txt").read_text().splitlines()
    cells = lines[-1].split("\t")
    cells[6] = "9.0"
    (moving / "position_array_ring.txt").write_text("\n".join([*lines[:-1], "\t".join(cells)]))
    assert "the array moves" in imported(moving, tmp_path / "out").stderr
    assert not (tmp_path / "out").exists()


def circle(middle):
    angle = np.pi + np.arange(8) * np.pi / 4
    return np.array(middle) + 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def test_a_sequence_of_av163_becomes_an_experiment(tmp_path):
    folder, fs, place = tmp_path / "seq11-1p-0100", 16000, np.array([1.2, 0.7, 0.5])
    folder.mkdir()
    arrays = [circle([0.0, 0.4, 0.0]), circle([0.0, -0.4, 0.0])]
    sound = voice(1.5, fs, np.random.default_rng(0))
    for array, microphones in enumerate(arrays, 1):
        for number, channel in enumerate(heard(place, sound, fs, microphones=microphones).T, 1):
            soundfile.write(folder / f"seq11-1p-0100_array{array}_mic{number}.wav", channel, fs)
    rows = [[time, 1, *place] for time in np.arange(10.2, 11.35, 0.04)]
    np.savetxt(folder / "seq11-1p-0100-person1-interpolated.3dmouthgt", rows)
    result = importer("av163", folder, "-C", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")
    truth = lines_of(tmp_path / "out/groundtruth_sources.jsonl")
    assert [truth[0]["timestamp"], truth[-1]["timestamp"]] == [0.2, 1.3]  # the sound begins at time code 10
    assert np.allclose(truth[3]["objects"][0]["mouth_position"], place + np.array([4.1, 4.1, 0.75]))
    found = done("avdetect-audio", "-C", tmp_path / "out", tmp_path / "out/audio.jsonl")
    offset = np.median(in_place(map(json.loads, found.stdout.splitlines())), axis=0)[:2] - (place + 4.1)[:2]
    assert np.linalg.norm(offset) < 0.15
    (folder / "seq11-1p-0100_array2_mic8.wav").unlink()
    refused = importer("av163", folder, "-C", tmp_path / "other")
    assert refused.returncode == 1
    assert "expected one seq11-1p-0100_array2_mic8.wav, found 0" in refused.stderr
    assert not (tmp_path / "other").exists()


def test_a_sequence_of_cav3d_becomes_an_experiment(tmp_path):
    fs, middle, place = 48000, np.array([2.0, 2.5, 0.9]), np.array([3.0, 3.4, 1.4])
    microphones = circle(middle)
    late = np.concatenate([np.zeros(fs // 2), voice(1.0, fs, np.random.default_rng(0))])
    (tmp_path / "cav3d/seq22").mkdir(parents=True)
    soundfile.write(tmp_path / "cav3d/seq22/seq22_MA0.wav", heard(place, late, fs, microphones=microphones), fs)
    scipy.io.savemat(tmp_path / "cav3d/MA0_pos.mat", {"Mic_pos": microphones.T})
    (tmp_path / "cav3d/CAV3D_AVsync_content.txt").write_text("22 3 18 1 0.5 1.5 1 3 18\n")
    rows = [[frame, 1, *(place if frame >= 3 else (0, 0, 0))] for frame in range(20)]
    np.savetxt(tmp_path / "cav3d/seq22/seq22_id1.3dmouthgt", rows)
    result = importer("cav3d", tmp_path / "cav3d", "seq22", "-C", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")
    truth = lines_of(tmp_path / "out/groundtruth_sources.jsonl")
    assert len(truth) == 11
    assert all(np.allclose(record["objects"][0]["mouth_position"], place) for record in truth)
    found = done("avdetect-audio", "-C", tmp_path / "out", tmp_path / "out/audio.jsonl")
    towards = [one["direction"][:2] for line in found.stdout.splitlines() for one in json.loads(line)["objects"]]
    true = (place - middle)[:2] / np.linalg.norm((place - middle)[:2])
    assert np.median(np.array(towards) @ true / np.linalg.norm(towards, axis=1)) > np.cos(np.deg2rad(5))
    (tmp_path / "cav3d/CAV3D_AVsync_content.txt").write_text("21 3 18 1 0.5 1.5 1 3 18\n")
    assert "expected one row of seq22, found 0" in importer("cav3d", tmp_path / "cav3d", "seq22", "-C", "x").stderr


PEOPLE = np.array([[6.0, 8.5], [9.5, 7.0]])
"""Where two people stand in a room of 16 m, m; the camera hangs in its middle."""


def turned_boxes(size, height):
    """Boxes [x, y, width, height, degrees clockwise] of people 1.7 m tall under an equidistant lens."""
    middle, focal = (size - 1) / 2, size / np.pi
    boxes = []
    for x, y in PEOPLE - 8.0:
        bearing, flat = np.arctan2(x, y), np.hypot(x, y)
        near, far = focal * np.arctan2(flat, [height, height - 1.7])
        along = (near + far) / 2
        place = [middle + along * np.sin(bearing), middle - along * np.cos(bearing)]
        boxes.append([*place, 30.0, far - near, np.rad2deg(bearing)])
    return boxes


@pytest.mark.parametrize("layout", ["CEPDOF", "HABBOF"])
def test_turned_boxes_become_people_on_the_floor(layout, tmp_path):
    size, height = 512, 2.8
    folder = tmp_path / "Lunch1"
    folder.mkdir()
    cv2.imwrite(str(folder / "Lunch1_000001.jpg"), np.full((size, size, 3), 90, np.uint8))
    boxes = turned_boxes(size, height)
    options = []
    if layout == "CEPDOF":
        marked = [{"image_id": "a", "bbox": box, "person_id": 7 + n} for n, box in enumerate(boxes)]
        images = [{"id": "a", "file_name": "Lunch1_000001.jpg"}]
        (tmp_path / "boxes.json").write_text(json.dumps({"images": images, "annotations": marked}))
        options = ["--boxes", tmp_path / "boxes.json"]
    else:
        lines = ["person " + " ".join(f"{cell:.3f}" for cell in box) for box in boxes]
        (folder / "Lunch1_000001.txt").write_text("\n".join(lines) + "\n")
    result = importer("overhead", folder, *options, "-C", tmp_path / "out", "--height", height)
    assert (result.returncode, result.stderr) == (0, "")
    truth = lines_of(tmp_path / "out/groundtruth_sources.jsonl")
    assert np.allclose(in_place(truth)[:, :2], PEOPLE, atol=0.01)
    assert [one["object_id"] for one in truth[0]["objects"]] == (
        [7, 8] if layout == "CEPDOF" else ["Lunch1_000001-1", "Lunch1_000001-2"]
    )
    frames = tmp_path / "out/frames.jsonl"
    seen = run("avdetect-video", "--allow-outside", "-C", tmp_path / "out", frames)
    assert (seen.returncode, len(seen.stdout.splitlines())) == (0, 1), seen.stderr


def test_boxes_of_five_numbers_are_needed(tmp_path):
    (tmp_path / "a.txt").write_text("person 1 2 3 4\n")
    refused = importer("overhead", tmp_path, "-C", tmp_path / "out")
    assert "a.txt:1: expected `person x y width height degrees`" in refused.stderr


def test_a_sequence_of_motchallenge_becomes_an_experiment(tmp_path):
    for folder in ("gt", "det"):
        (tmp_path / "PETS" / folder).mkdir(parents=True)
    (tmp_path / "PETS/seqinfo.ini").write_text("[Sequence]\nname=PETS\nframeRate=7\nseqLength=30\n")
    walk = [(100 + 10 * frame, 300 + 2 * frame) for frame in range(30)]
    rows = [f"{frame},1,{x - 10},{y - 60},20,60,1,1,1" for frame, (x, y) in enumerate(walk, 1)]
    ignored = [f"{frame},2,0,0,20,60,0,1,1" for frame in range(1, 31)] + ["1,3,0,0,9,9,1,8,1"]
    (tmp_path / "PETS/gt/gt.txt").write_text("\n".join(rows + ignored))
    (tmp_path / "PETS/det/det.txt").write_text("\n".join(row.replace(",1,", ",-1,", 1) for row in rows))
    np.savetxt(tmp_path / "H.txt", [[0.02, 0, 1], [0, -0.03, 20], [0, 0, 1]])
    result = importer("motchallenge", tmp_path / "PETS", "--homography", tmp_path / "H.txt", "-C", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")
    truth = lines_of(tmp_path / "out/groundtruth_sources.jsonl")
    assert (len(truth), truth[7]["timestamp"]) == (30, 1.0)
    assert np.allclose(np.diff(in_place(truth), axis=0), [0.2, -0.06, 0.0])
    found = tmp_path / "out/detections.jsonl"
    tracks = done("avfuse", "-C", tmp_path / "out", "--doors", "anywhere", "--sigma", "camera=0.05", found)
    score = run("aveval", tmp_path / "out/groundtruth_sources.jsonl", "-", "--fail-under", "HOTA=90",
                stdin=tracks.stdout)  # fmt: skip
    assert score.returncode == 0, score.stderr
    (tmp_path / "PETS/gt/gt.txt").write_text("1,1,a,0,9,9,1\n")
    refused = importer("motchallenge", tmp_path / "PETS", "--scale", "0.1", "-C", tmp_path / "other")
    assert "gt.txt:1: a value is not a number" in refused.stderr


def test_boxes_stand_on_the_floor_of_a_calibrated_camera(tmp_path):
    camera = {"lens_model": "kannala_brandt", "fx_px": 300, "fy_px": 300, "cx_px": 320, "cy_px": 240,
              "image_width_px": 640, "image_height_px": 480, "camera_position_m": [4, 3, 3]}  # fmt: skip
    (tmp_path / "config.json").write_text(json.dumps({"camera_config": camera}))
    table = {
        "videos": [{"id": 1, "name": "one"}, {"id": 2, "name": "nobody"}],
        "images": [{"id": 5, "video_id": 1, "frame_index": 30}],
        "categories": [{"id": 9, "name": "person"}],
        "tracks": [{"id": 4, "category_id": 9}],
        "annotations": [{"image_id": 5, "track_id": 4, "category_id": 9, "bbox": [310, 200, 20, 40]}],
    }
    (tmp_path / "a.json").write_text(json.dumps(table))
    ground = ["--config", tmp_path / "config.json"]
    result = importer("tao", tmp_path / "a.json", *ground, "-C", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["one"]
    (record,) = lines_of(tmp_path / "out/one/groundtruth_sources.jsonl")
    assert record["timestamp"] == 1.0
    assert np.allclose(record["objects"][0]["position"], [4, 3, 0])
    del table["categories"]
    (tmp_path / "a.json").write_text(json.dumps(table))
    assert "has no categories" in importer("tao", tmp_path / "a.json", *ground, "-C", tmp_path / "other").stderr


def test_tracks_of_eth_and_ucy_become_an_experiment(tmp_path):
    (tmp_path / "seq").mkdir()
    rows = [[frame, 3, 0.1 * frame, 0, 5.0, 0, 0, 0] for frame in range(0, 100, 6)]
    rows += [[frame + 300, 3, 0, 0, 0.1 * frame, 0, 0, 0] for frame in range(0, 100, 6)]
    np.savetxt(tmp_path / "seq/obsmat.txt", rows)
    control = "2 - the number of splines\n2 - Num of control points\n0 0 0 90 - x y frame gaze\n100 0 50 90\n"
    (tmp_path / "seq/annotation.vsp").write_text(control)
    np.savetxt(tmp_path / "H.txt", np.diag([0.05, 0.05, 1.0]))
    walked = importer("ethucy", tmp_path / "seq/obsmat.txt", "--seconds", 17, "--simulate", "-C", tmp_path / "eth")
    drawn = importer("ethucy", tmp_path / "seq/annotation.vsp", "--homography", tmp_path / "H.txt", "--seconds", 2,
                     "-C", tmp_path / "ucy")  # fmt: skip
    assert (walked.stderr, drawn.stderr) == ("", "")
    truth = lines_of(tmp_path / "eth/groundtruth_sources.jsonl")
    assert {one["object_id"] for record in truth for one in record["objects"]} == {"3", "3-2"}  # came back: another
    assert np.allclose(truth[2]["objects"][0]["position"], [0.5, 5.0, 0.0], atol=1e-6)
    assert np.allclose(in_place(lines_of(tmp_path / "ucy/groundtruth_sources.jsonl"))[10], [2.5, 0, 0])
    done("avfuse", "-C", tmp_path / "eth", "--doors", "anywhere", tmp_path / "eth/detections.jsonl")
    late = importer("ethucy", tmp_path / "seq/obsmat.txt", "--begin", 900, "-C", tmp_path / "late")
    assert "nobody walks from 900 s to 1020 s" in late.stderr


def test_an_importer_leaves_what_is_there(tmp_path):
    np.savetxt(tmp_path / "obsmat.txt", [[0, 1, 0, 0, 0, 0, 0, 0], [10, 1, 1, 0, 0, 0, 0, 0]])
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine").touch()
    refused = importer("ethucy", tmp_path / "obsmat.txt", "-C", tmp_path / "out")
    assert (refused.returncode, "is not empty" in refused.stderr) == (1, True)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine"]
