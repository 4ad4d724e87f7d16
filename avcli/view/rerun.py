"""A run as a file for the Rerun viewer (rerun.io), which has map, picture and time line for long recordings."""

from pathlib import Path
from typing import Any

import numpy as np

from avcli.formats import atomic
from avcli.formats.media import MediaError
from avcli.view.page import Shown
from avcli.view.pictures import jpeg
from avcli.view.recording import DETECTIONS

_RADII_M = {"truth": 0.12, "tracks": 0.09, "detections": 0.05}


def save(path: Path, shown: Shown) -> None:
    """Write a run for the Rerun viewer, extra "avcli[rerun]".

    Args:
        path: of the file.
        shown: the run. Rooms, microphones, people, detections and pictures are written, on the time line "time".

    Raises:
        ModuleNotFoundError: rerun-sdk is not installed.
    """
    try:
        import rerun
    except ModuleNotFoundError:
        raise ModuleNotFoundError("--rrd needs rerun-sdk: pip install 'avcli[rerun]'") from None
    log = rerun.RecordingStream("avcli", recording_id=shown.recording.name)
    with atomic.replacing(path) as temporary:
        log.save(temporary)
        _log_surroundings(rerun, log, shown)
        for stream in shown.recording.streams:
            for time, row in stream.rows:
                log.set_time("time", duration=time)
                people = stream.kind != DETECTIONS
                known = [item for item in row if people or item[0] is not None]
                places = [[item[1], item[2], 0.0] if people else [*item[:2], item[2] or 0.0] for item in known]
                labels = [_label(item) for item in known if people]
                points = rerun.Points3D(places, radii=_RADII_M[stream.kind], labels=labels or None)
                log.log(f"room/{stream.kind}/{stream.name}", points)
        for time, read in shown.pictures:
            log.set_time("time", duration=time)
            try:
                log.log("camera", rerun.EncodedImage(contents=jpeg(read(), 1280), media_type="image/jpeg"))
            except MediaError:
                continue
        log.flush()
        log.disconnect()


def _label(person: list) -> str:
    speaks = len(person) > 3 and person[3] is not None and person[3] > 0.5
    return f"{person[0]} speaks" if speaks else str(person[0])


def _log_surroundings(rerun: Any, log: Any, shown: Shown) -> None:
    around = shown.surroundings
    if "room" in around:
        half = np.array(around["room"]) / 2
        log.log("room", rerun.Boxes3D(centers=[half], half_sizes=[half]), static=True)
    if "microphones" in around:
        names = [str(number) for number in range(1, len(around["microphones"]) + 1)]
        log.log("room/microphones", rerun.Points3D(around["microphones"], radii=0.04, labels=names), static=True)
