"""Draw detections and tracks into the frame that the camera saw: a picture with the library.

    .venv/bin/python examples/draw_tracks.py out/s3 2.5 s3.png

It also shows how little it takes to use avcli as a library: config.json gives the lens and the pose of the camera,
`project` maps points of the room to pixels.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from avcli import pose
from avcli.formats import experiment, media, records

COLOURS = [(255, 176, 0), (100, 143, 255), (220, 38, 127), (254, 97, 0), (120, 94, 240)]  # told apart by all eyes
VIDEO, AUDIO = (255, 255, 255), (60, 255, 160)


def read(path: Path, parse) -> list:
    return [parse(records.decode(line)) for line in path.read_bytes().splitlines()]


def boxes(record: dict) -> tuple[float, list]:
    return record["timestamp"], [found["bbox_px"] for found in record["objects"]]


def draw(directory: Path, time: float) -> np.ndarray:
    camera = experiment.read_config(directory / "config.json").camera
    T_camera_room = pose.inverse(camera.T_room_camera)

    def pixels(points: np.ndarray) -> np.ndarray:
        return camera.lens.project(pose.apply(T_camera_room, np.atleast_2d(points)))

    image = media.read_rgb(directory / experiment.Layout.rgb(time)).copy()
    for sensor, colour in (("video", VIDEO), ("audio", AUDIO)):
        for found in read(directory / f"localization/{sensor}_localizations.jsonl", records.detections):
            if abs(found.timestamp - time) < 1e-6:
                points = found.positions.copy()
                if sensor == "video":
                    points[:, 2] = 1.0
                for x, y in pixels(points)[np.isfinite(pixels(points)).all(axis=1)]:
                    marker = cv2.MARKER_CROSS if sensor == "video" else cv2.MARKER_DIAMOND
                    cv2.drawMarker(image, (round(x), round(y)), colour, marker, 34, 3, cv2.LINE_AA)
    for timestamp, found in read(directory / "localization/video_localizations.jsonl", boxes):
        if abs(timestamp - time) < 1e-6:
            for x0, y0, x1, y1 in np.rint(found).astype(int).tolist():
                cv2.rectangle(image, (x0, y0), (x1, y1), VIDEO, 2, cv2.LINE_AA)
    trails: dict[int, list] = {}
    for tracks in read(directory / "tracking/audio_video_tracking.jsonl", records.identified):
        if tracks.timestamp <= time + 1e-6:
            for identity, position in zip(tracks.ids.tolist(), tracks.positions, strict=True):
                trails.setdefault(identity, []).append([*position[:2], 0.0])
    for identity, trail in trails.items():
        line = pixels(np.array(trail))
        line = np.rint(line[np.isfinite(line).all(axis=1)] * 8).astype(np.int32)
        colour = COLOURS[identity % len(COLOURS)]
        cv2.polylines(image, [line], False, colour, 5, cv2.LINE_AA, shift=3)
        if len(line):
            cv2.circle(image, tuple(map(int, line[-1])), 12 * 8, colour, -1, cv2.LINE_AA, shift=3)
    return image


if __name__ == "__main__":
    source, moment, target = sys.argv[1:]
    picture = draw(Path(source), float(moment))
    media.write_png(target, cv2.resize(picture, (960, 540), interpolation=cv2.INTER_AREA))
