"""Films of real people as cases of the bench of trackers: what avdetect-video finds, and whom hand-made labels show.

    .venv/bin/python tests/bench/film_cases.py FOLDER cases --films 20
    make bench-tracking BENCH_FLAGS="--judge --ready cases --set no-hidden --set tracker=gnn --set tracker=sort"

FOLDER is a set as bench_real_video.py takes it, whose pictures are named by film and picture. Each film becomes a
directory of --out with config.json, video_localizations.jsonl (by colour alone) and groundtruth_sources.jsonl. Labels
have no identities and no places: they are placed by the detector's own geometry, with the same lens and height, so that
an unknown lens spoils both alike, after the margin that hands leave around people is taken away; and they are linked
from picture to picture by place.
"""

import argparse
import json
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from bench_real_video import HEIGHT_M, camera, fisheye, labelled, shots_of, tight
from scipy.optimize import linear_sum_assignment

from avcli.detection.detector import Detector, detections
from avcli.detection.monocular import Fitted
from avcli.detection.settings import Settings
from avcli.formats.experiment import Config
from avcli.formats.media import read_rgb
from avcli.formats.records import Identified, save

LOST, PACE, BLUR, FAR = 4.0, 2.5, 0.7, 3.5
"""A label is somebody of the last LOST s who is at most BLUR m + PACE m/s away, and FAR m."""
MOST = 12.0
"""Half the side of the room at most, m: it reaches as far as the labels, the camera hangs in its middle."""


class Links:
    """Gives numbers to places that follow each other."""

    def __init__(self) -> None:
        self.known: dict[int, tuple[float, np.ndarray]] = {}  # number -> when and where somebody was last
        self.next = 0

    def link(self, time: float, xy: np.ndarray) -> list[int]:
        """Return the numbers (n,) of people at places (n, 2) m at a time (s)."""
        before = [(who, place, time - then) for who, (then, place) in self.known.items() if time - then <= LOST]
        away = np.array([np.linalg.norm(xy - place, axis=1) / min(BLUR + PACE * dt, FAR) for _, place, dt in before])
        away = away.reshape(len(before), len(xy))
        numbers = [-1] * len(xy)
        for row, column in zip(*linear_sum_assignment(np.minimum(away, 1e3)), strict=True):
            if away[row, column] <= 1:
                numbers[column] = before[row][0]
        for k, place in enumerate(xy):
            if numbers[k] < 0:
                numbers[k], self.next = self.next, self.next + 1
            self.known[numbers[k]] = time, place
        return numbers


def write(folder: Path, pictures: list[tuple[float, Path]]) -> None:
    """Make the case of one film: the time, s, and the file of each picture."""
    size = read_rgb(pictures[0][1]).shape[1::-1]
    view, links = fisheye(size, HEIGHT_M), Links()
    places = [Fitted(tight(labelled(path) * np.tile(size, 2)), view).places() for _, path in pictures]
    below = [one.positions[one.seen] for one in places]
    half = min(float(np.abs(np.concatenate(below)).max(initial=2.0)) + 0.5, MOST)
    middle = {"camera_position_m": [half, half, HEIGHT_M]}
    config = {
        "room_config": {"room_dimensions_m": [2 * half, 2 * half, HEIGHT_M + 0.1]},
        "camera_config": camera(size, HEIGHT_M) | middle,
    }
    detector = Detector(Config(config), settings=Settings(monocular=True))

    def truth() -> Iterator[Identified]:
        for (seconds, _), xy in zip(pictures, below, strict=True):
            xyz = np.pad(np.clip(xy + half, 0, 2 * half), ((0, 0), (0, 1)))
            yield Identified(seconds, np.array(links.link(seconds, xyz[:, :2]), int), xyz)

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config, indent=1) + "\n")
    save(folder / "groundtruth_sources.jsonl", truth())
    found = (detections(seconds, detector.look(read_rgb(path), None, seconds)) for seconds, path in pictures)
    save(folder / "video_localizations.jsonl", found)


def main() -> None:
    """Write a case for each film."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="the set's folder")
    parser.add_argument("out", type=Path, help="where the cases go")
    parser.add_argument("--films", type=float, default=20.0, help="pictures a second, as the names count them")
    parser.add_argument("--only", default="", help="pictures whose names match this regular expression")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    films = shots_of(options.data, options)
    if not films:
        parser.error(f"{options.data} has no pictures in folders named images")
    for pictures in films:
        number = re.findall(r"\d+", pictures[0][1].name)[0]
        write(options.out / f"{options.data.name}-{number}", pictures)


if __name__ == "__main__":
    main()
