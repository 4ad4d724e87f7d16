"""What a body does while its person stays: how low the hips are, how far the trunk bows, where the hands are.

Numbers are metres of a body of 1.75 m and radians, chosen by eye.
"""

from dataclasses import dataclass

Place = tuple[float, float, float]
"""Of a wrist: forward of the person's place, outwards from the middle, height above the floor; m."""


@dataclass(frozen=True)
class Posture:
    """One posture.

    Attributes:
        seated: whether the hips are on a seat.
        hips: height of the hips over that of standing (of a seat, where seated).
        bow: rad by which the trunk leans forward.
        back: m by which the hips go backward for balance.
        nod: rad by which the head is lowered.
        hands: places of the right and the left wrist; None: it hangs, or lies in the lap.
        moving: m by which busy hands go to and fro.
        lying: whether the person lies on the back.
    """

    seated: bool = False
    hips: float = 1.0
    bow: float = 0.0
    back: float = 0.0
    nod: float = 0.0
    hands: tuple[Place | None, Place | None] = (None, None)
    moving: float = 0.0
    lying: bool = False


def _both(forward: float, outward: float, height: float) -> tuple[Place, Place]:
    return (forward, outward, height), (forward, outward, height)


POSTURES: dict[str, Posture] = {
    "stand": Posture(),
    "sit": Posture(seated=True),
    "table": Posture(seated=True, bow=0.16, nod=0.12, hands=_both(0.40, 0.13, 0.79)),
    "type": Posture(seated=True, bow=0.10, nod=0.25, hands=_both(0.38, 0.10, 0.80), moving=0.008),
    "write": Posture(seated=True, bow=0.38, nod=0.60, hands=((0.42, 0.04, 0.79), (0.40, 0.20, 0.79)), moving=0.012),
    "recline": Posture(seated=True, bow=-0.34, nod=-0.10),
    "lean": Posture(hips=0.97, bow=0.62, back=0.16, nod=0.35, hands=_both(0.48, 0.24, 0.80)),
    "bend": Posture(hips=0.92, bow=1.25, back=0.22, nod=0.95, hands=_both(0.36, 0.14, 0.30)),
    "crouch": Posture(hips=0.38, bow=0.42, back=0.10, nod=0.45, hands=_both(0.46, 0.14, 0.36)),
    "fold": Posture(bow=-0.02, hands=((0.22, -0.05, 1.17), (0.25, -0.03, 1.12))),
    "hips": Posture(hands=_both(0.06, 0.21, 1.00)),
    "raise": Posture(hands=((0.18, 0.22, 1.85), None)),
    "lie": Posture(lying=True, hands=_both(0.06, 0.24, 0.92)),
}
"""The postures by name: what a waypoint's "pose" may be."""

SEATED = tuple(name for name, posture in POSTURES.items() if posture.seated)

LOADS: dict[str, Posture] = {
    "box": Posture(bow=-0.06, hands=_both(0.34, 0.20, 1.02)),
    "laptop": Posture(hands=_both(0.27, 0.15, 1.05)),
    "tray": Posture(hands=_both(0.32, 0.19, 1.10)),
    "phone": Posture(nod=0.42, hands=((0.27, 0.06, 1.27), None)),
    "bag": Posture(hands=((0.04, 0.24, 0.74), None)),
}
"""What a person may carry, and how: what "carries" may be."""

WHEELCHAIR = Posture(seated=True, hands=_both(0.04, 0.27, 0.64))
"""Of a person in a wheelchair; the hands push its wheels."""
