"""Simulate, hear, see, track and score people who walk and talk in a room.

The library has one function a stage. Each works on arrays and small dataclasses, and is imported when it is first
used:

    import avcli

    scene = avcli.simulate("s1", video=False)
    sound = avcli.hear(scene.config, scene.truth)
    detections = avcli.localize(scene.config, sound)
    tracks = avcli.track(scene.config, detections)
    print(avcli.score(scene.truth, tracks)["HOTA"])
"""

TYPE_CHECKING = False  # as typing's. Nothing is imported here: Ctrl-C during an import would print a traceback
if TYPE_CHECKING:
    from typing import Any

    from avcli.acoustics.recorder import hear as hear
    from avcli.calibration.calibrate import calibrate as calibrate
    from avcli.detection.detector import detect as detect
    from avcli.formats.experiment import read_config as read_config
    from avcli.formats.records import load as load
    from avcli.formats.records import save as save
    from avcli.localization.methods import localize as localize
    from avcli.metrics.scoring import score as score
    from avcli.scene.film import simulate as simulate
    from avcli.tracking.fusion import track as track

__version__ = "0.2.0"

_DOOR = {
    "simulate": "avcli.scene.film",
    "hear": "avcli.acoustics.recorder",
    "localize": "avcli.localization.methods",
    "detect": "avcli.detection.detector",
    "track": "avcli.tracking.fusion",
    "score": "avcli.metrics.scoring",
    "calibrate": "avcli.calibration.calibrate",
    "load": "avcli.formats.records",
    "save": "avcli.formats.records",
    "read_config": "avcli.formats.experiment",
}
"""The library's functions and the modules that they come from."""


def __getattr__(name: str) -> "Any":
    if name not in _DOOR:
        raise AttributeError(f"module 'avcli' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_DOOR[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_DOOR])
