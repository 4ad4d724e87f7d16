"""Importers of public data sets, on small files of the same layout."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import run
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


def imported(folder, out):
    return subprocess.run(
        [sys.executable, EXAMPLES / "locata.py", folder, "-C", out, "--room", "4.66", "4.66", "3", "--offset",
         *map(str, OFFSET)], capture_output=True, text=True,
    )  # fmt: skip


def test_a_recording_of_locata_becomes_an_experiment(locata, tmp_path):
    folder, place = locata
    result = imported(folder, tmp_path)
    assert result.returncode == 0, result.stderr
    config = json.loads((tmp_path / "config.json").read_text())
    assert np.allclose(config["microphone_config"]["mic_positions_m"], MICROPHONES, atol=1e-5)
    truth = [json.loads(line) for line in (tmp_path / "groundtruth_sources.jsonl").read_text().splitlines()]
    assert [record["timestamp"] for record in truth[:3]] == [0.0, 0.1, 0.2]
    assert all(np.allclose(record["objects"][0]["mouth_position"], place, atol=1e-5) for record in truth)
    found = run("avdetect-audio", "-C", tmp_path, tmp_path / "audio.jsonl")
    assert found.returncode == 0, found.stderr
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
