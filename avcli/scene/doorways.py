"""Doors that people come and go through: a waypoint may lie outside the room, behind a door."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def is_inside(places: np.ndarray, room: np.ndarray) -> Any:
    """Whether places (..., 2) m are in a room of size (3,) m, (...) bool."""
    return np.all((places > 0) & (places < room[:2]), axis=-1)


def goes_through_wall(start: np.ndarray, end: np.ndarray, room: np.ndarray, doors: Sequence[Mapping[str, Any]]) -> bool:
    """Tell whether a straight way leaves or enters a room beside its doors.

    Args:
        start, end: (2,) m.
        room: (3,) size of the room, m.
        doors: of room_config.

    Returns:
        False where both ends are inside, or where the way passes the outline of the room within a door; a way that is
        wholly outside has to stay behind one door.
    """
    for axis in (0, 1):
        for wall, beyond in (
            (0.0, min(start[axis], end[axis]) <= 0),
            (room[axis], max(start[axis], end[axis]) >= room[axis]),
        ):
            if not beyond:
                continue
            name = f"{'xy'[axis]}{int(wall > 0)}"
            off = np.array([start[axis], end[axis]]) - wall
            crossing = off[0] * off[1] < 0
            part = off[0] / (off[0] - off[1]) if crossing else 0.0
            along = [start[1 - axis] + part * (end[1 - axis] - start[1 - axis])] if crossing else []
            along += [place[1 - axis] for place, o in ((start, off[0]), (end, off[1])) if (o <= 0) == (wall == 0)]
            if not any(
                door["wall"] == name and all(abs(at - door["at_m"]) <= door["width_m"] / 2 for at in along)
                for door in doors
            ):
                return True
    return False
