"""How people differ from free motion between two records: two bodies are not in one place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from avcli.tracking.births import as_complex, squared_distance
from avcli.tracking.densities import Densities
from avcli.tracking.model import Population

# These were chosen by hand on generated scenes (`make bench-tracking`, seeds from 100); no command fits them. Without
# the rule, HOTA of two who meet face to face and turn back (turning-back) falls from 95 to 57; on tracks of real people
# (ETH hotel, UCY zara01 and zara02) the rule changes less than 1.
BUMP = 0.2  # m; people whose courses come nearer to one another than this would bump
SOON, JUST = 0.3, 0.1  # s; the nearest point of two courses counts while it is so near in the future or the past
FACING = -0.9  # cosine of the angle between the courses of people who walk face to face


def evade(people: Densities, rows: Sequence[int], known: Sequence[int], population: Population, dt: float) -> None:
    """Let people who walk into each other face to face stop, within the next dt seconds.

    Two bodies cannot pass through each other, and detections of two people near each other hardly show whether they
    did. A person who comes from the side may pass behind.

    Args:
        people: densities, changed in place.
        rows: of all labelled people, ascending.
        known: those of the likeliest joint hypotheses.
        population: for the rate of stopping and the motion models.
        dt: s.
    """
    rate, stand = population.evade, population.motion.stand
    if len(known) < 2 or stand < 0 or not rate:
        return
    centres = people.centres(rows)
    own = as_complex(centres)
    at = np.searchsorted(rows, known)
    reach = BUMP + 2 * SOON * max(abs(own[:, 1]).tolist())
    if np.count_nonzero(squared_distance(centres, centres.take(at, 0)) < reach * reach) == len(at):
        return  # each is near to itself alone
    other = own.take(at, 0)
    position, velocity = (own[:, None] - other).transpose(2, 0, 1)
    soon = -(position * velocity.conj()).real / (np.square(abs(velocity)) + 1e-9)  # seconds until they are nearest
    bump = abs(soon - (SOON - JUST) / 2) < (SOON + JUST) / 2
    bump &= abs(position + velocity * np.maximum(soon, 0.0)) < BUMP
    if not np.count_nonzero(bump):
        return
    own, other = own[:, 1:], other[:, 1]
    bump &= (own * other.conj()).real < FACING * abs(own) * abs(other)  # never a person and itself
    if bump.any():
        stopping = np.array(rows)[bump.any(1)]
        keep = math.exp(-rate * dt)
        mode = people.mode[stopping] * keep
        mode[:, stand] += 1 - keep
        people.mode[stopping] = mode
