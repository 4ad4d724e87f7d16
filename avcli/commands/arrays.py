"""Warnings about the microphones of config.json."""

from __future__ import annotations

from typing import TYPE_CHECKING

from avcli.commands.filter import Session

if TYPE_CHECKING:
    from avcli.formats.experiment import Config

_SLACK_M = 0.3
"""How far outside the stated room a microphone may be: walls are measured roughly."""
_ONE_PLACE_M = 1e-3
"""Nearer microphones are stated to be at one place, where two cannot be."""


def doubt_microphones(session: Session, config: Config) -> None:
    """Say which microphones cannot be where config.json has them: outside the room, or two at one place.

    Those outside may have z counted downwards, millimetres, or another origin. Numbers that are in another order than
    the list may have been meant as the order of the channels.
    """
    positions, room = config.microphones.positions, config.room.dimensions
    outside = [number for number, one in enumerate(positions, 1) if ((one < -_SLACK_M) | (one > room + _SLACK_M)).any()]
    if outside:
        sides = " × ".join(f"{side:g}" for side in room)
        who = f"microphones {', '.join(map(str, outside))} are" if len(outside) > 1 else f"microphone {outside[0]} is"
        session.warn(
            f"{config.name}: {who} outside the room of {sides} m, so places are wrong; x, y and z are counted in "
            "metres from a floor corner, z upwards"
        )
    apart = abs(positions[:, None] - positions).max(axis=2)
    for first, second in zip(*(apart < _ONE_PLACE_M).nonzero(), strict=True):
        if first < second:
            session.warn(f"{config.name}: microphones {first + 1} and {second + 1} have the same position")
    listed = config.raw["microphone_config"]["mic_positions_m"]
    numbers = [one["object_id"] for one in listed if isinstance(one, dict) and one.get("object_id") is not None]
    if numbers != sorted(numbers):
        session.warn(
            f"{config.name}: the first channel belongs to the first microphone of the list, and so on; object_id does "
            f"not count, and stands in another order: {', '.join(map(str, numbers))}"
        )
