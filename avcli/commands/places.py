"""Warnings about where config.json has microphones and cameras."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from avcli.commands.filter import Session

if TYPE_CHECKING:
    from avcli.formats.experiment import Config

_SLACK_M = 0.3
"""How far outside the stated room a microphone or a camera may be: walls are measured roughly."""
_ONE_PLACE_M = 1e-3
"""Nearer microphones are stated to be at one place, where two cannot be."""


def doubt_camera(session: Session, position: Iterable[float], name: str) -> None:
    """Say so if a camera (x, y, z) m is outside the room that config.json states: centimetres, or another corner."""
    config = session.config
    if not config.states("room_config", "room_dimensions_m"):
        return
    room = config.room.dimensions
    if any(not -_SLACK_M <= place <= side + _SLACK_M for place, side in zip(position, room, strict=True)):
        session.warn(
            f"{name} is outside the room of {_sides(room)} m in {config.name}: is it in metres, counted from a floor "
            "corner, z upwards?"
        )


def doubt_microphones(session: Session, config: Config) -> None:
    """Say which microphones cannot be where config.json has them: outside the room, or two at one place.

    Those outside may have z counted downwards, millimetres, or another origin. Numbers that are in another order than
    the list may have been meant as the order of the channels.
    """
    positions, room = config.microphones.positions, config.room.dimensions
    outside = [number for number, one in enumerate(positions, 1) if ((one < -_SLACK_M) | (one > room + _SLACK_M)).any()]
    if outside:
        who = f"microphones {', '.join(map(str, outside))} are" if len(outside) > 1 else f"microphone {outside[0]} is"
        session.warn(
            f"{config.name}: {who} outside the room of {_sides(room)} m, so places are wrong; x, y and z are counted "
            "in metres from a floor corner, z upwards"
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


def _sides(room: Iterable[float]) -> str:
    return " × ".join(f"{side:g}" for side in room)
