"""What pictures show around the people: the room, the microphones, the camera and its frames."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from avcli.formats.experiment import Config, ConfigError
from avcli.metrics.run import Run

_DRAWN: dict[str, tuple[str, str, Callable[[Config], np.ndarray]]] = {
    "room": ("room_config", "room_dimensions_m", lambda config: config.room.dimensions[:2]),
    "microphones": ("microphone_config", "mic_positions_m", lambda config: config.microphones.positions[:, :2]),
    "camera": ("camera_config", "camera_position_m", lambda config: config.camera.T_room_camera[:2, 3]),
}


def with_surroundings(run: Run, config: Config, say: Callable[[str], None] = lambda text: None) -> Run:
    """Add the room, the microphones and the camera to a run, as far as its experiment states them.

    Args:
        run: what is to be drawn.
        config: of the experiment.
        say: is called with a sentence for each that is invalid.
    """
    known: dict[str, Any] = {}
    for name, (section, key, read) in _DRAWN.items():
        if not config.states(section, key):
            continue
        try:
            known[name] = np.asarray(read(config), dtype=float)
        except ConfigError as error:
            say(f"{run.name}: not drawn: {name}: {error}")
    return replace(run, **known)
