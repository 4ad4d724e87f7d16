#!/usr/bin/env python3
"""Make an experiment of a sequence of AV16.3: config.json, ground truth and the sound of its two circular arrays.

    python examples/datasets/av163.py seq11-1p-0100 -C out/av163
    avdetect-audio -C out/av163 out/av163/audio.jsonl -o a.jsonl
    avfuse -C out/av163 a.jsonl | aveval out/av163/groundtruth_sources.jsonl -

The data: G. Lathoud, J.-M. Odobez, D. Gatica-Perez, "AV16.3: an Audio-Visual Corpus for Speaker Localization and
Tracking", MLMI 2004; https://www.idiap.ch/dataset/av16-3. Its page FORMATS describes the annotation files.
The folder of a sequence SEQ has, itself or in folders inside it, SEQ_array1_mic1.wav to SEQ_array2_mic8.wav (16 kHz;
sample 0 is at the time code 10 s) and SEQ-person1-interpolated.3dmouthgt and so on: rows of time code s, whether a
hand marked it, x, y, z m. Where two cameras did not see a mouth there is no truth of it.

The origin is halfway between the arrays, which are circles of 0.1 m radius on the table, 0.8 m apart along y; the
corpus's gt.mat lists the microphones. avcli's origin is a corner of the floor, so that --offset is added to positions.
Assumed, since the files do not say it: the arrays are 0.75 m above the floor, and --room, in whose middle they are. The
room is 8.2 x 3.6 x 2.4 m; which way it lies is not in the files, so that the default holds both ways.
The three cameras are on the walls and see the room sideways; they are not imported.
"""

import argparse
from pathlib import Path

import numpy as np
import soundfile
from experiment import RATE_HZ, only, people, run, sampled, save

BEGIN = 10.0
"""s, the time code of sample 0."""


def microphones(arrays: list[int]) -> np.ndarray:
    """Return the places (8 n, 3) m of the microphones of arrays 1 and 2, in the corpus's frame."""
    angle = np.pi + np.arange(8) * np.pi / 4
    circle = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    middle = {1: np.array([0.0, 0.4, 0.0]), 2: np.array([0.0, -0.4, 0.0])}
    return np.concatenate([middle[array] + circle for array in arrays])


def mouth(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read an annotation: times (n,) s from sample 0 on, and places (n, 3) m."""
    rows = np.loadtxt(path, ndmin=2)
    if rows.size == 0 or rows.shape[1] != 5:
        raise ValueError(f"{path}: its rows do not have 5 columns: time, is_manual, x, y, z")
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if not len(rows):
        raise ValueError(f"{path}: has no positions")
    return rows[:, 0] - BEGIN, rows[:, 2:]


def convert(folder: Path, out: Path, arrays: list[int], room: list[float], offset: list[float]) -> None:
    """Write the experiment of one sequence.

    Args:
        folder: of the sequence, with its name.
        out: of the experiment; it must be empty or missing.
        arrays: 1, 2 or both.
        room: its sides, m.
        offset: m, added to positions.

    Raises:
        ValueError: the folder is not of that layout; `out` is not empty.
    """
    name = folder.resolve().name
    channels, rates = [], set()
    for array in arrays:
        for number in range(1, 9):
            samples, rate = soundfile.read(only(folder, f"{name}_array{array}_mic{number}.wav"), always_2d=True)
            channels.append(samples[:, 0])
            rates.add(rate)
    if len(rates) > 1 or len({len(one) for one in channels}) > 1:
        raise ValueError(f"{folder}: the recordings of the microphones differ in length or sample rate")
    annotations = sorted(folder.rglob(f"{name}-person*-interpolated.3dmouthgt"))
    if not annotations:
        raise ValueError(f"{folder}: found no {name}-person1-interpolated.3dmouthgt")
    mouths = {number: mouth(path) for number, path in enumerate(annotations, 1)}
    begin = max(0.0, min(times[0] for times, _ in mouths.values()))
    end = min(len(channels[0]) / rate, max(times[-1] for times, _ in mouths.values()))
    at = np.arange(np.ceil(begin * RATE_HZ - 1e-6), np.floor(end * RATE_HZ + 1e-6) + 1) / RATE_HZ
    paths = {number: sampled(*one, at) + offset for number, one in mouths.items()}
    truth = [people(time, {number: path[row] for number, path in paths.items()}) for row, time in enumerate(at)]
    config = {
        "session_id": f"av16.3-{name}",
        "room_config": {"room_dimensions_m": room, "reverberation_time_s": 0.5},
        "microphone_config": {
            "audio_sample_rate_hz": rate,
            "audio_bit_depth": 16,
            "mic_positions_m": (microphones(arrays) + offset).round(5).tolist(),
        },
    }
    save(out, config, {"groundtruth_sources.jsonl": truth}, np.stack(channels, axis=1), bits=16)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the experiment's directory")
    parser.add_argument("--arrays", type=int, nargs="+", choices=(1, 2), default=[1, 2])
    parser.add_argument("--room", type=float, nargs=3, default=[8.2, 8.2, 2.4], help="sides of the room, m")
    parser.add_argument("--offset", type=float, nargs=3, default=[4.1, 4.1, 0.75], help="added to positions, m")
    given = parser.parse_args()
    run(lambda: convert(given.folder, given.out, sorted(set(given.arrays)), given.room, given.offset))


if __name__ == "__main__":
    main()
