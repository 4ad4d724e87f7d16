"""What pictures show around the people: the room, the microphones, the camera and its frames."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avcli.formats.experiment import Config, ConfigError, Layout
from avcli.formats.media import MediaError, read_rgb
from avcli.metrics.run import Run

MOST_FRAMES = 150
"""Camera frames in a report; of a longer sequence every second, third ... one."""
_WIDTH_PX = 720


def with_surroundings(
    run: Run, config: Config, pictures: Path | None = None, say: Callable[[str], None] = lambda text: None
) -> Run:
    """Add the room, the microphones, the camera and its frames to a run, as far as its experiment gives them.

    Args:
        run: what is to be drawn.
        config: of the experiment.
        pictures: the experiment's directory, for small JPEGs of the camera's frames at the times of the ground truth,
            at most `MOST_FRAMES`; None: no frames.
        say: is called with a sentence if something is missing or invalid.
    """
    known: dict[str, Any] = {}
    try:
        known["room"] = np.asarray(config.room.dimensions[:2], dtype=float)
        known["microphones"] = np.asarray(config.microphones.positions[:, :2], dtype=float)
        known["camera"] = np.asarray(config.camera.T_room_camera[:2, 3], dtype=float)
        known["frame_size"] = (config.camera.width_px, config.camera.height_px)
    except ConfigError as error:
        say(f"{run.name}: the room, the microphones or the camera are not drawn: {error}")
    if pictures:
        known["frames"] = _camera_frames(pictures, sorted(set(run.truth_time.tolist())), say)
    return replace(run, **known)


def thumbnail(image: np.ndarray) -> bytes:
    """Make a small JPEG of a camera frame (h, w, 3) uint8 RGB, as the player shows it."""
    import cv2

    height, width = image.shape[:2]
    scale = min(1.0, _WIDTH_PX / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, content = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 72])
    return content.tobytes()


def _camera_frames(directory: Path, times: Sequence[float], say: Callable[[str], None]) -> dict[float, bytes]:
    there = [time for time in times if (directory / Layout.rgb(time)).is_file()]
    frames, lacking = {}, []
    for time in there[:: -(-len(there) // MOST_FRAMES) or 1]:
        try:
            frames[time] = thumbnail(read_rgb(directory / Layout.rgb(time)))
        except MediaError as error:
            lacking.append(error)
    if lacking:
        say(f"{len(lacking)} of {len(there)} camera frames are missing in the report; the first is {lacking[0]}")
    return frames
