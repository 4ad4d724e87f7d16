#!/usr/bin/env python3
"""Make an experiment of a sequence of CAV3D: config.json, ground truth and the sound of its circular array.

    python examples/datasets/cav3d.py CAV3D seq22 -C out/cav3d
    avdetect-audio -C out/cav3d out/cav3d/audio.jsonl -o a.jsonl
    avfuse -C out/cav3d a.jsonl | aveval out/cav3d/groundtruth_sources.jsonl -

The data: X. Qian, A. Brutti, O. Lanz, M. Omologo, A. Cavallaro, "Multi-speaker tracking from an audio-visual sensing
device", IEEE Transactions on Multimedia 2019; https://speechtek.fbk.eu/cav3d-dataset. The layout is read as its
authors' tracker AV3T reads it (github.com/smartcameras/AV3T): somewhere below the folder of the set lie

    seqNN_MA0.wav               eight channels, 96 kHz
    seqNN_id1.3dmouthgt, ...    a row for each picture from 0 on, 15 a second: two other columns, then x, y, z m
    MA0_pos.mat                 MATLAB file with Mic_pos (3, 8) m
    CAV3D_AVsync_content.txt    rows of: sequence, first and last picture, -, begin and end in the sound s, ...

The origin is a corner of the room on the floor, as avcli's. The sound is cut to the annotated part: time 0 is its
first picture. Of an array of 10 cm radius the direction is known and the distance hardly.
The camera stands on the table beside the array and looks sideways; it is not imported.
"""

import argparse
from pathlib import Path

import numpy as np
import scipy.io
import soundfile
from experiment import RATE_HZ, only, people, run, sampled, save

PICTURES_HZ = 15.0


def part(path: Path, sequence: str) -> tuple[int, int, float]:
    """Read the first and the last picture of a sequence, and when the first one was taken, s of the sound."""
    rows = np.loadtxt(path, ndmin=2, delimiter="," if "," in path.read_text() else None)
    if rows.shape[1] < 6:
        raise ValueError(f"{path}: its rows have fewer than 6 columns")
    mine = rows[rows[:, 0] == int(sequence.removeprefix("seq"))]
    if len(mine) != 1:
        raise ValueError(f"{path}: expected one row of {sequence}, found {len(mine)}")
    return int(mine[0, 1]), int(mine[0, 2]), float(mine[0, 4])


def convert(folder: Path, sequence: str, out: Path, room: list[float]) -> None:
    """Write the experiment of one sequence.

    Args:
        folder: of the set.
        sequence: seqNN.
        out: of the experiment; it must be empty or missing.
        room: its sides, m.

    Raises:
        ValueError: the folder is not of that layout; `out` is not empty.
    """
    if not sequence.removeprefix("seq").isdigit():
        raise ValueError(f"{sequence}: a sequence is seq06 to seq26")
    first, last, begin = part(only(folder, "CAV3D_AVsync_content.txt"), sequence)
    positions = np.asarray(scipy.io.loadmat(only(folder, "MA0_pos.mat"))["Mic_pos"], float).T
    sound, rate = soundfile.read(only(folder, f"{sequence}_MA0.wav"), always_2d=True)
    if positions.shape != (sound.shape[1], 3):
        raise ValueError(f"{folder}: {sound.shape[1]} channels, but Mic_pos has {len(positions)} microphones")
    annotations = sorted(folder.rglob(f"{sequence}_id*.3dmouthgt"))
    if not annotations:
        raise ValueError(f"{folder}: found no {sequence}_id1.3dmouthgt")
    seconds = min((last - first) / PICTURES_HZ, len(sound) / rate - begin)
    if seconds <= 0:
        raise ValueError(f"{folder}: the sound of {sequence} ends before its first picture, at {begin:g} s")
    at = np.arange(np.floor(seconds * RATE_HZ + 1e-6) + 1) / RATE_HZ
    mouths = {}
    for number, path in enumerate(annotations, 1):
        rows = np.loadtxt(path, ndmin=2)
        if rows.shape[1] != 5 or len(rows) <= last:
            raise ValueError(f"{path}: expected 5 columns and {last + 1} rows, found {rows.shape[1]} and {len(rows)}")
        known = np.isfinite(rows[:, 2:]).all(axis=1) & rows[:, 2:].any(axis=1)
        times = (np.arange(len(rows)) - first) / PICTURES_HZ
        mouths[number] = sampled(times[known], rows[known, 2:], at) if known.any() else np.full((len(at), 3), np.nan)
    truth = [people(time, {number: path[row] for number, path in mouths.items()}) for row, time in enumerate(at)]
    config = {
        "session_id": f"cav3d-{sequence}",
        "room_config": {"room_dimensions_m": room, "reverberation_time_s": 0.7},
        "microphone_config": {
            "audio_sample_rate_hz": rate,
            "audio_bit_depth": 24,
            "mic_positions_m": positions.round(5).tolist(),
        },
    }
    heard = sound[round(begin * rate) : round((begin + seconds) * rate)]
    save(out, config, {"groundtruth_sources.jsonl": truth}, heard)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sequence", help="seq06 to seq26")
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the experiment's directory")
    parser.add_argument("--room", type=float, nargs=3, default=[4.77, 5.95, 4.5], help="sides of the room, m")
    given = parser.parse_args()
    run(lambda: convert(given.folder, given.sequence, given.out, given.room))


if __name__ == "__main__":
    main()
