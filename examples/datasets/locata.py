#!/usr/bin/env python3
"""Make an experiment of a LOCATA recording: config.json, ground truth and sound, as avcli reads them.

    python examples/datasets/locata.py dev/task3/recording2/dicit -C out/locata
    avdetect-audio -C out/locata out/locata/audio.jsonl -o a.jsonl
    avfuse -C out/locata a.jsonl | aveval --dims 2 out/locata/groundtruth_sources.jsonl -

The data: C. Evers et al., "The LOCATA Challenge: Acoustic Source Localization and Tracking", IEEE/ACM TASLP 28, 2020;
https://doi.org/10.5281/zenodo.3630471.
A folder of one recording and one array has audio_array_NAME.wav, audio_array_timestamps_NAME.txt,
position_array_NAME.txt and, in the development set, position_source_PERSON.txt: tables with tabs between the columns,
whose names stand in the first line. LOCATA's origin is inside the room; avcli's is a corner of the floor, so that
--offset is added to all positions. Arrays that move (tasks 5 and 6) are refused.
"""

import argparse
from pathlib import Path

import numpy as np
import soundfile
from experiment import RATE_HZ, people, run, save


def table(path: Path) -> dict[str, np.ndarray]:
    """Read a table: column name -> (n,) values."""
    with open(path, encoding="utf-8") as lines:
        names = lines.readline().split()
        values = np.array([[float(cell) for cell in line.split()] for line in lines if line.strip()])
    if values.ndim != 2 or values.shape[1] != len(names):
        raise ValueError(f"{path}: its lines do not have the {len(names)} columns of its first line")
    return dict(zip(names, values.T, strict=True))


def clock(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return times (n,) in s since the first day's midnight."""
    day = columns["day"] - columns["day"][0]  # a recording lasts some minutes
    return 86400.0 * day + 3600.0 * columns["hour"] + 60.0 * columns["minute"] + columns["second"]


def places(columns: dict[str, np.ndarray], prefix: str = "") -> np.ndarray:
    """Return positions (n, 3) in m."""
    return np.stack([columns[prefix + axis] for axis in "xyz"], axis=1)


def convert(folder: Path, out: Path, room: tuple[float, float, float], offset: tuple[float, float, float]) -> None:
    """Write the experiment of one recording and one array.

    Args:
        folder: of the recording and the array.
        out: of the experiment; it must be empty or missing.
        room: its sides, m.
        offset: m, added to positions.

    Raises:
        ValueError: the folder is not of that layout, or the array moves; `out` is not empty.
    """
    arrays = sorted(folder.glob("audio_array_*.wav"))
    if len(arrays) != 1:
        raise ValueError(f"{folder}: expected one audio_array_NAME.wav, found {len(arrays)}")
    name = arrays[0].stem.removeprefix("audio_array_")
    array = table(folder / f"position_array_{name}.txt")
    samples, rate = soundfile.read(arrays[0], always_2d=True)
    begin = clock(table(folder / f"audio_array_timestamps_{name}.txt"))[0]
    count = samples.shape[1]
    if f"mic{count}_x" not in array or f"mic{count + 1}_x" in array:
        raise ValueError(
            f"{folder}: the sound has {count} channels, but position_array_{name}.txt has other microphones"
        )
    tracks = np.stack([places(array, f"mic{number + 1}_") for number in range(count)])
    if np.ptp(tracks, axis=1).max() > 0.01:
        raise ValueError(f"{folder}: the array moves, by up to {np.ptp(tracks, axis=1).max():.2f} m")
    microphones = np.median(tracks, axis=1) + offset
    times = np.arange(0.0, len(samples) / rate, 1.0 / RATE_HZ)
    mouths = []
    for path in sorted(folder.glob("position_source_*.txt")):
        source = table(path)
        at = clock(source) - begin
        mouths.append(np.stack([np.interp(times, at, column) for column in places(source).T], axis=1) + offset)
    config = {
        "session_id": f"locata-{folder.parent.name}-{name}",
        "room_config": {"room_dimensions_m": list(room), "reverberation_time_s": 0.55},
        "microphone_config": {
            "audio_sample_rate_hz": rate,
            "audio_bit_depth": 24,
            "mic_positions_m": [position.round(5).tolist() for position in microphones],
        },
    }
    truth = [people(time, {number: path[row] for number, path in enumerate(mouths)}) for row, time in enumerate(times)]
    save(out, config, {"groundtruth_sources.jsonl": truth}, samples)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-C", dest="out", type=Path, required=True, help="the experiment's directory")
    parser.add_argument("--room", type=float, nargs=3, default=(7.1, 9.8, 3.0), help="sides of the room, m")
    parser.add_argument("--offset", type=float, nargs=3, default=(3.55, 4.9, 0.0), help="added to positions, m")
    given = parser.parse_args()
    run(lambda: convert(given.folder, given.out, tuple(given.room), tuple(given.offset)))


if __name__ == "__main__":
    main()
