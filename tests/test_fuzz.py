"""One number, key or value of a valid input is changed at random, and the filter is to end as a filter does.

The changes are the same in every run. `OPENBLAS_NUM_THREADS=1 python tests/test_fuzz.py 1000` tries that many of each
filter, and prints the
number of each exit status.
"""

import copy
import json
import random
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from forked import run_forked

from avcli.formats import media, records
from avcli.scene.scenario import LABORATORY

MOST_BYTES = 200_000
"""Output of the few records that each run gets; undisturbed it is below 10 kB."""
VALUES = [
    None, True, False, 0, 1, -1, 2, 3, 0.5, 1e-9, 250.5, -250.5, 3000.0, 1e4, 1e5, 1e6, -1e6, 1e7, 1e9, 1e11, -1e11,
    1e16, 1e300, -1e300, 1e-300, 2**31, 2**53, 2**63, 2**64, "", "x", "0.1", "1e9", "-5", "1e300", "../x", "/dev/zero",
    [], [0, 1], [0, 1, 2], [1e6, 1e6, 1e6], [[0]], {}, {"kind": "camera"}, {"x": 1}, "sphere", "omni", "division",
]  # fmt: skip


def leaves(value, path=()):
    """Paths to all values inside a JSON value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in inner:
        yield (*path, key)
        yield from leaves(item, (*path, key))


def changed(documents, chance):
    """Copy JSON documents with one change: a value replaced, scaled, moved a little, left out or put in twice."""
    documents = copy.deepcopy(documents)
    *way, last = chance.choice(list(leaves(documents))[1:] or [(0,)])
    place = documents
    for key in way:
        place = place[key]
    old = place[last]
    kind = chance.randrange(8)
    if kind == 0:
        del place[last]
    elif kind == 1 and isinstance(place, list):
        place.append(copy.deepcopy(old))
    elif kind in (2, 3) and isinstance(old, int | float) and not isinstance(old, bool):
        place[last] = old * chance.choice([-1, 0, 1e-12, 1e-3, 0.999, 3.7, 1e3, 1e12])
    else:
        place[last] = copy.deepcopy(chance.choice(VALUES))
    return documents


def lines(documents):
    return b"".join(json.dumps(document).encode() + b"\n" for document in documents)


# --- valid inputs -----------------------------------------------------------------------------------------------------

EYE = [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.04]]
DETECTIONS = [
    {"timestamp": k / 10, "sensor": sensor, "kind": kind,
     "objects": [{"position": [1.0 + k / 10, 2.0, 1.6], "covariance": EYE, "score": 0.9, "bbox_px": [1, 2, 30, 40]}]}
    for k in range(3) for sensor, kind in (("audio", "microphones"), ("video", "camera"))
]  # fmt: skip
PEOPLE = [
    {"timestamp": k / 10,
     "objects": [{"object_id": i, "position": [1.0 + i, 2.0, 0.0], "mouth_position": [1.1 + i, 2.0, 1.6],
                  "speaking": True, "velocity": [0, 0, 0], "covariance": EYE, "existence": 0.9} for i in range(2)]}
    for k in range(3)
]  # fmt: skip
CONFIG = copy.deepcopy(LABORATORY) | {"sensors": {"video": {"kind": "camera"}}}
CONFIG["camera_config"] |= {"image_width_px": 64, "image_height_px": 36, "fx_px": 30.0, "fy_px": 30.0, "cx_px": 32.0}
CONFIG["camera_config"] |= {"cy_px": 18.0, "background_depth": "empty.png", "depth_kind": "radial"}
CONFIG["microphone_config"] |= {"audio_sample_rate_hz": 8000, "audio_bit_depth": 16}
CONFIG["microphone_config"]["mic_positions_m"] = [[0.1, 0.1, 2.4], [4.5, 0.1, 2.4], [4.5, 4.5, 2.4], [0.1, 4.5, 2.3]]
CONFIG["room_config"]["reverberation_time_s"] = 0.0
FRAMES = [{"timestamp": k / 10, "frame": {"rgb": "rgb.png", "depth": "depth.png"}} for k in range(2)]
SOUND = {"path": "a.wav", "start_sample": 0, "num_samples": 4000, "sample_rate_hz": 8000, "num_channels": 4}
HEARD = [{"timestamp": k / 2, "audio": {**SOUND, "start_sample": 4000 * k, "tail_samples": 0}} for k in range(2)]
SCENARIO = {
    "name": "fuzz", "duration_s": 0.2, **{key: CONFIG[key] for key in LABORATORY},
    "furniture": [{"kind": "table", "position_m": [3, 3]}, {"kind": "box", "position_m": [1, 3, 1], "size_m": [1] * 3}],
    "people": [{"object_id": 3, "waypoints": [{"position_m": [1, 1]}, {"position_m": [2, 2], "t_s": 2, "stay_s": 1}],
                "speech_s": [[0, 0.1]], "height_m": 1.7}],
}  # fmt: skip

FUZZED = {
    "avfuse": (DETECTIONS, [], 24),
    "aveval": (PEOPLE, ["--dims", "3", "{truth}", "-"], 20),
    "avsim-audio": (PEOPLE, ["--seed", "1"], 14),
    "avsim-scene": ([SCENARIO], ["-", "--no-video"], 24),
    "avdetect-audio": (HEARD, [], 10),
    "avdetect-video": (FRAMES, ["--detector", "depth"], 14),
}
"""Command -> its input, its arguments, and how many runs of each kind the test makes."""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Path:
    """A directory with the files that the records name."""
    return made(tmp_path_factory.mktemp("fuzz"))


def made(directory: Path) -> Path:
    noise = np.random.default_rng(0)
    media.write_png(directory / "rgb.png", noise.integers(0, 256, (36, 64, 3)).astype(np.uint8))
    empty = np.full((36, 64), 25000, np.uint16)
    media.write_png(directory / "empty.png", empty)
    empty[10:20, 20:30] = 9000
    media.write_png(directory / "depth.png", empty)
    with media.AudioWriter(directory / "a.wav", 8000, 4, 16) as file:
        file.write(noise.normal(0, 0.01, (4000, 4)))
    (directory / "truth.jsonl").write_bytes(b"".join(map(records.encode, PEOPLE)))
    (directory / "config.json").write_bytes(lines([CONFIG]))
    return directory


def runs(command, directory, count):
    """Run a command on changed inputs, and then on changed config.json files; yield what ended how."""
    documents, options, _ = FUZZED[command]
    chance = random.Random(f"{command} 17")
    options = [option.format(truth=directory / "truth.jsonl") for option in options]
    for number in range(-1, 2 * count):
        config, given = CONFIG, documents
        if number < 0:  # the valid input first
            pass
        elif number < count or command in ("aveval", "avsim-scene"):
            given = changed(documents, chance)
        else:
            (config,) = changed([CONFIG], chance)
        (directory / "own.json").write_bytes(lines([config]))
        where = ["-C", directory / "out" if command == "avsim-scene" else directory]
        if command != "avsim-scene":
            where += ["-c", directory / "own.json"]
        yield (given if config is CONFIG else config), run_forked(command, *where, *options, stdin=lines(given))


@pytest.mark.parametrize("command", FUZZED)
def test_a_changed_input_ends_a_filter_as_it_should(command, experiment):
    ended = runs(command, experiment, FUZZED[command][2])
    assert next(ended)[1].returncode == 0
    for given, end in ended:
        assert fault(command, end) is None, (fault(command, end), end.stderr[-500:], json.dumps(given))


def fault(command, end):
    """Say what is wrong with the way in which a run ended; None: nothing."""
    said = end.stderr.splitlines()
    if end.returncode not in (0, 1, 2):
        return f"exit {end.returncode}"
    if not all(line.startswith(f"{command}: ") for line in said):
        return "a line that is none of ours"
    if end.returncode and not said:
        return "no word"
    return "too much output" if len(end.stdout) > MOST_BYTES else None


if __name__ == "__main__":
    import tempfile

    for name in sys.argv[2:] or FUZZED:
        with tempfile.TemporaryDirectory() as folder:
            counts: Counter = Counter()
            for document, how in runs(name, made(Path(folder)), int(sys.argv[1]) // 2):
                counts[how.returncode] += 1
                if wrong := fault(name, how):
                    print(name, wrong, how.stderr[-300:], len(how.stdout), json.dumps(document), flush=True)
            print(name, dict(counts), flush=True)
