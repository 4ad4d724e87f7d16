"""How much sound the furniture and the people of a scenario absorb: the contents of its room."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from avcli import materials
from avcli.materials.decay import MIDDLE, air_loss, contents_loss, reverberation_time
from avcli.scene.furniture import BALL, BOX, MATERIALS, TRIANGLE, Solids
from avcli.scene.scenario import Scenario

PERSON_M2 = (0.12, 0.24, 0.59, 0.98, 1.13, 1.12, 1.12)
"""m² in the bands `materials.BANDS_HZ`: equivalent absorption area of a man who stands, without a coat (H. Kuttruff,
Room Acoustics, 2009, table of the absorption of persons; at 8 kHz as at 4 kHz)."""
PERSON_M = 1.75
"""m, his height; others absorb by the square of theirs, as the surface of a body grows."""
SEATS = ("upholstery", "leather", "plastic")
"""Materials whose absorption was measured as that of chairs: for each m² of floor that they cover, not of surface."""
LYING_M = 0.002
"""m; what is no farther above the floor lies on it, and its lower side is not heard."""


def room_heard(scenario: Scenario) -> dict[str, Any]:
    """Return the room_config of a scenario with what its contents absorb, and the reverberation time that follows.

    These keys are added where the room's surfaces name materials and neither a reverberation time nor an absorption is
    stated.
    """
    stated = dict(scenario.raw["room_config"])
    room = scenario.config.room
    if room.surfaces is None or room.reverberation_time_s is not None or room.absorption is not None:
        return stated
    area = room.contents_absorption_m2
    if area is None:
        area = absorption_area(scenario.pieces, [person.height for person in scenario.people]).round(3)
    loss = air_loss(materials.BANDS_HZ, room.speed_of_sound_m_s) + contents_loss(room.dimensions, area)
    times = [
        reverberation_time(room.dimensions, of_walls, of_air, room.speed_of_sound_m_s, scatters)
        for of_walls, of_air, scatters in zip(
            room.surfaces.absorption.T[MIDDLE], loss[MIDDLE], room.surfaces.scattering.T[MIDDLE], strict=True
        )
    ]
    return stated | {"contents_absorption_m2": area.tolist(), "reverberation_time_s": round(float(np.mean(times)), 3)}


def absorption_area(pieces: Sequence[Solids], heights_m: Sequence[float] = ()) -> np.ndarray:
    """Return the equivalent absorption area of furniture and people, (7,) m² in the bands `materials.BANDS_HZ`.

    It is Σ α S of the surfaces that do not lie on the floor; of `SEATS`, S is the floor that they cover. That parts
    hide each other is left out. EN 12354-6 (2003) has chairs and cupboards of the same order; single pieces may absorb
    half or twice as much.

    Args:
        pieces: of furniture.
        heights_m: of the people.
    """
    known = materials.table()
    of_materials = np.array([known[name].absorption for name in MATERIALS])
    seats = np.isin(MATERIALS, SEATS)
    total = np.sum([(height / PERSON_M) ** 2 for height in heights_m]) * np.array(PERSON_M2)
    for piece in pieces:
        soft = seats[piece.material]
        total += _surfaces(piece[~soft]) @ of_materials[piece.material[~soft]]
        if soft.any():
            total += _covered(piece[soft]) * of_materials[piece.material[soft]].mean(axis=0)
    return total


def _surfaces(solids: Solids) -> np.ndarray:
    """The surface of each solid, (n,) m², without the side that lies on the floor."""
    a, b, c = 2 * solids.half.T
    lies = solids.centre[:, 2] - c / 2 < LYING_M
    ends = a * b * np.where(solids.kind == BOX, 1, np.pi / 4)
    round_ = np.where(solids.kind == BALL, np.pi * a**2, np.pi * a * c + (2 - lies) * ends)
    area = np.where(solids.kind == BOX, 2 * (a + b) * c + (2 - lies) * ends, round_)
    sides = solids.axes[:, :2] - solids.centre[:, None]
    triangles = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    return np.where(solids.kind == TRIANGLE, triangles, area)


def _covered(solids: Solids) -> float:
    """The floor that solids of one piece cover together, m²: a rectangle along the axes of the first."""
    if (solids.kind == TRIANGLE).any():
        return float(np.ptp(solids.centre[:, :2], axis=0).prod())
    axes = solids.axes[0, :2, :2]
    reach = np.abs(np.einsum("ik,nak->nia", axes, solids.axes[:, :, :2])) @ solids.half[:, :, None]
    along = solids.centre[:, :2] @ axes.T
    return float(((along + reach[..., 0]).max(axis=0) - (along - reach[..., 0]).min(axis=0)).prod())
