"""What a scene does not need is not computed: each command says so in the same words, and no result changes."""

import json
import re
from itertools import pairwise

import numpy as np
import pytest
from conftest import done, run

from avcli.acoustics.recorder import Recorder
from avcli.commands.filter import Session

SAID = re.compile(r"not computed: (\d+) of (\d+) [a-z ]+ \(\d+ %\), [a-z ]+(; saved about \d+\.\d\d s)?")
SCENARIO = {
    "duration_s": 1.5,
    "camera_config": {"image_width_px": 160, "image_height_px": 90, "fx_px": 71, "fy_px": 71, "cx_px": 80, "cy_px": 45},
    "microphone_config": {"audio_sample_rate_hz": 16000},
    "room_config": {"reverberation_time_s": 0.15},
    "people": [{"waypoints": [{"position_m": [1, 2]}], "speech_s": [[0.2, 0.7]]},
               {"waypoints": [{"position_m": [3.5, 3]}], "speech_s": []}],
}  # fmt: skip


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """Two people who stand still, of whom one speaks for half a second: simulated, with what each command said."""
    folder = tmp_path_factory.mktemp("still")
    (folder / "still.json").write_text(json.dumps(SCENARIO))
    steps = [
        ("avsim-scene", folder / "still.json", "-o", folder / "scene.jsonl"),
        ("avsim-audio", folder / "scene.jsonl", "-o", folder / "audio.jsonl"),
        ("avdetect-audio", folder / "audio.jsonl", "-o", folder / "a.jsonl"),
        ("avdetect-video", folder / "scene.jsonl", "-o", folder / "v.jsonl"),
        ("avfuse", folder / "a.jsonl", folder / "v.jsonl", "-o", folder / "t.jsonl"),
    ]
    said = {}
    for command, *options in steps:
        ended = done(command, "-v", "-C", folder, *options)
        said[command] = ended.stderr
    return folder, said


def test_each_command_says_in_the_same_words_what_it_did_not_compute(experiment):
    _, said = experiment
    for command, text in said.items():
        lines = [line.split(": ", 1)[1] for line in text.splitlines() if "not computed" in line]
        counts = [SAID.fullmatch(line) for line in lines if "empty room" not in line]
        assert counts, command
        assert all(counts), lines
        assert any(int(match[1]) > 0 for match in counts if match), (command, lines)
        assert all(int(match[1]) <= int(match[2]) for match in counts if match)


def test_a_frame_that_was_not_drawn_is_as_the_one_before(experiment):
    folder, said = experiment
    spared, frames = map(int, re.search(r"not computed: (\d+) of (\d+) frames", said["avsim-scene"]).groups())
    pictures = [path.read_bytes() for path in sorted((folder / "video" / "rgb").glob("*.png"))]
    assert len(pictures) == frames
    assert sum(one == other for one, other in pairwise(pictures)) == spared


@pytest.mark.parametrize("way", [[], ["--monocular"]], ids=["depth", "colour"])
def test_detections_of_pictures_that_were_passed_over_are_those_of_the_network(experiment, way):
    folder, _ = experiment
    scene = folder / "scene.jsonl"
    every = run("avdetect-video", "-C", folder, "--refresh", "1", *way, scene).stdout.splitlines()
    some = run("avdetect-video", "-C", folder, *way, scene).stdout.splitlines()
    apart = []
    for one, other in zip(map(json.loads, every), map(json.loads, some), strict=True):
        places = np.array([person["position"][:2] for person in other["objects"]])
        scores = np.array([person["score"] for person in other["objects"]])
        for person in one["objects"]:
            away = np.linalg.norm(places - person["position"][:2], axis=1)
            if min(person["score"], scores[away.argmin()]) > 0.7:
                apart.append(away.min())
    assert len(apart) > 10
    assert max(apart) < 0.08  # as avdetect-video(1) says


def test_sound_of_people_who_stand_is_that_of_responses_that_are_all_computed():
    """A voice that moves by a micrometre needs every response; the sounds differ by less than the -40 dB promised."""
    from avcli.formats.experiment import Config
    from avcli.formats.records import Identified
    from avcli.scene.scenario import LABORATORY

    config = Config(
        LABORATORY | {"microphone_config": {**LABORATORY["microphone_config"], "audio_sample_rate_hz": 8000}}
    )

    def heard(step_m):
        recorder = Recorder(config, say=print)
        for k in range(11):
            floor = np.array([[1.0 + step_m * k, 2.0, 0.0]])
            recorder.step(Identified(k / 10, np.zeros(1, int), floor, floor + np.array([0.1, 0, 1.6]), np.ones(1)))
        recorder.finish()
        return np.concatenate(list(recorder.pieces())), recorder.work

    still, (few, spared) = heard(0.0)
    moved, (many, _) = heard(1e-6)
    assert spared > 0
    assert few < many
    assert np.sum((still - moved) ** 2) < 1e-4 * np.sum(moved**2)


def test_nothing_is_said_of_nothing():
    noted = []
    session = Session("avfuse", {"quiet": False, "verbose": True})
    session.note = noted.append
    session.note_skipped("pairs", 0, 0, "which are far")
    session.note_skipped("pairs", 3, 4, "which are far")
    assert noted == ["not computed: 3 of 4 pairs (75 %), which are far"]
