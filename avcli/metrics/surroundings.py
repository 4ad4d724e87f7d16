"""What pictures show around the people: the room, the microphones, the camera and its frames."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from avcli.formats.experiment import Config, ConfigError
from avcli.metrics.run import Run


def with_surroundings(run: Run, config: Config, say: Callable[[str], None] = lambda text: None) -> Run:
    """Add the room, the microphones and the camera to a run, as far as its experiment states them.

    Args:
        run: what is to be drawn.
        config: of the experiment.
        say: is called with a sentence if something is missing or invalid.
    """
    known: dict[str, Any] = {}
    try:
        known["room"] = np.asarray(config.room.dimensions[:2], dtype=float)
        known["microphones"] = np.asarray(config.microphones.positions[:, :2], dtype=float)
        known["camera"] = np.asarray(config.camera.T_room_camera[:2, 3], dtype=float)
    except ConfigError as error:
        say(f"{run.name}: the room, the microphones or the camera are not drawn: {error}")
    return replace(run, **known)
