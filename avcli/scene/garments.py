"""What people wear or carry over shirt and trousers: jackets, skirts, hems, collars, hats, bags, boxes, wheelchairs.

Sizes are metres of a body of 1.75 m, chosen by eye, as in dress.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from avcli.scene.person import DENIM, FOLDED, KNIT, LEATHER, Colour, Look
from avcli.scene.skeleton import Head, Skeleton, hip_offset, unit_vector

_Z = np.array([0.0, 0.0, 1.0])
_STEEL: Colour = (0.32, 0.33, 0.35)
_RUBBER: Colour = (0.07, 0.07, 0.075)
_CARD: Colour = (0.66, 0.52, 0.36)


@dataclass
class Garment:
    """One rounded cone at n times.

    Attributes:
        a, b: (n, 3) m, the ends of its axis.
        ra, rb: radii there, m, of an average body.
        flat_axis: (n, 3) or (3,), unit axis along which it is flattened, by `flat` in (0, 1].
        front: (n, 3), unit vector to the front of the part.
        group: cones of one group blend where they touch.
        material: SKIN, KNIT...
        colour: before `Part.split`.
    """

    a: np.ndarray
    b: np.ndarray
    ra: float
    rb: float
    flat_axis: np.ndarray
    flat: float
    front: np.ndarray
    group: str
    material: int
    colour: Colour


def garments(bones: Skeleton, look: Look, load: str | None, *, wheelchair: bool) -> Iterator[Garment]:
    """Yield what a person wears and carries beyond shirt, trousers and shoes.

    Args:
        bones: at n times.
        look: says what is worn.
        load: one of postures.LOADS, held in both hands or in one; None: nothing.
        wheelchair: whether the person sits in one.
    """
    if look.jacket is not None:
        yield from _jacket(bones, look, look.jacket)
    elif look.folds:
        yield from _hem(bones, look)
    if look.skirt is not None:
        yield from _skirt(bones, look, look.skirt)
    if look.collar is not None:
        yield from _collar(bones, look.collar)
    if look.hat is not None:
        yield from _hat(bones.head, look.hat, look.hat_colour)
    if look.bag is not None:
        yield from _bag(bones, look.bag, look.bag_colour)
    if load is not None:
        yield from _load(bones, load)
    if wheelchair:
        yield from _wheelchair(bones)


def _jacket(bones: Skeleton, look: Look, colour: Colour) -> Iterator[Garment]:
    """Two halves that leave the shirt free in front, a back, and tails as far as the hem goes."""
    trunk, unit, g = bones.trunk, bones.unit, look.girth
    front, left, up = trunk.chest_front, trunk.chest_left, trunk.chest_up
    side = hip_offset(trunk, unit)
    drop = (0.42 * look.hem * unit * (1 - trunk.sit))[:, None] * _Z
    back, cloth = -0.035 * unit * front, ("jacket", KNIT | FOLDED, colour)
    for sign in (-1, 1):
        top = trunk.chest + unit * (0.078 * sign * left + 0.06 * up - 0.006 * front)
        middle = trunk.waist + unit * (0.062 * sign * left - 0.004 * front)
        low = trunk.pelvis + 0.85 * sign * side - 0.012 * unit * trunk.pelvis_front - drop
        yield Garment(top, middle, 0.108 * look.shoulders, 0.104 * g, front, 0.98, front, *cloth)
        yield Garment(middle, low, 0.104 * g, 0.118 * g, front, 0.92, front, *cloth)
    waist, seat = trunk.waist + back, trunk.pelvis + back - 0.03 * unit * up
    yield Garment(trunk.chest + back + 0.05 * unit * up, waist, 0.115, 0.105 * g, front, 0.75, front, *cloth)
    yield Garment(waist, seat, 0.105 * g, 0.140 * g, front, 0.75, front, *cloth)


def _hem(bones: Skeleton, look: Look) -> Iterator[Garment]:
    """The end of a shirt that hangs over the trousers."""
    trunk, unit = bones.trunk, bones.unit
    low = trunk.pelvis - 0.055 * unit * _Z
    yield Garment(
        low, low + 0.09 * unit * _Z, 0.148 * look.girth, 0.140 * look.girth, trunk.pelvis_front, 0.80,
        trunk.pelvis_front, "hem", look.cloth | FOLDED, look.shirt,
    )  # fmt: skip


def _skirt(bones: Skeleton, look: Look, colour: Colour) -> Iterator[Garment]:
    """A cone from the hips over both legs; it ends at the knees, or below."""
    trunk, unit = bones.trunk, bones.unit
    right, left = bones.legs
    knees, ankles = 0.5 * (right.knee + left.knee), 0.5 * (right.ankle + left.ankle)
    wide = 0.155 + 0.05 * look.hem
    front = trunk.pelvis_front
    cloth = "skirt", KNIT | FOLDED, colour
    yield Garment(trunk.pelvis + 0.02 * unit * _Z, knees, 0.140 * look.girth, wide, front, 0.85, front, *cloth)
    for leg in (right, left):
        yield Garment(leg.hip, leg.knee, 0.095 * look.girth, 0.085, front, 1.0, front, *cloth)
    if look.hem > 1.0:
        low = knees + (look.hem - 1.0) * (ankles - knees)
        yield Garment(knees, low, wide, wide, front, 0.9, front, *cloth)


def _collar(bones: Skeleton, colour: Colour) -> Iterator[Garment]:
    trunk, unit = bones.trunk, bones.unit
    front, left, up = trunk.chest_front, trunk.chest_left, trunk.chest_up
    for sign in (-1, 1):
        back = trunk.neck + unit * (0.025 * sign * left - 0.045 * front + 0.018 * up)
        tip = trunk.neck + unit * (0.03 * sign * left + 0.075 * front - 0.02 * up)
        yield Garment(back, tip, 0.024, 0.018, up, 0.8, front, "collar", KNIT, colour)


def _hat(head: Head, hat: str, colour: Colour) -> Iterator[Garment]:
    at, cloth = head.at, ("hat", KNIT, colour)
    left, up = head.left, head.up
    if hat == "helmet":
        cloth = "hat", LEATHER, colour
        yield Garment(at(-0.01, 0, 0.032), at(0.012, 0, 0.034), 0.107, 0.103, left, 0.92, head.front, *cloth)
        yield Garment(at(0.0, 0, 0.02), at(0.05, 0, 0.012), 0.118, 0.10, up, 0.12, head.front, *cloth)
        return
    yield Garment(at(-0.022, 0, 0.034), at(0.012, 0, 0.038), 0.097, 0.090, left, 0.93, head.front, *cloth)
    if hat == "cap":
        yield Garment(at(0.06, 0, 0.045), at(0.125, 0, 0.034), 0.072, 0.06, up, 0.10, head.front, *cloth)
    elif hat == "brim":
        yield Garment(at(0.0, 0, 0.04), at(0.0, 0, 0.04), 0.165, 0.165, up, 0.07, head.front, *cloth)
        yield Garment(at(-0.01, 0, 0.06), at(0.0, 0, 0.085), 0.088, 0.075, left, 0.95, head.front, *cloth)
    elif hat == "beanie":
        yield Garment(at(-0.03, 0, 0.01), at(0.02, 0, 0.045), 0.094, 0.087, left, 0.93, head.front, *cloth)
        yield Garment(at(-0.02, 0, 0.128), at(-0.02, 0, 0.128), 0.022, 0.022, left, 1.0, head.front, *cloth)


def _bag(bones: Skeleton, bag: str, colour: Colour) -> Iterator[Garment]:
    trunk, unit = bones.trunk, bones.unit
    front, left, up = trunk.chest_front, trunk.chest_left, trunk.chest_up
    paint = "bag", KNIT, colour
    if bag == "backpack":
        high, low = trunk.chest - unit * (0.165 * front - 0.02 * up), trunk.waist - unit * (0.175 * front + 0.02 * up)
        for sign in (-1, 1):
            aside = 0.05 * sign * unit * left
            yield Garment(high + aside, low + aside, 0.115, 0.125, front, 0.78, -front, *paint)
            strap = trunk.neck + unit * (0.10 * sign * left - 0.02 * up)
            yield Garment(
                strap, trunk.chest + unit * (0.10 * sign * left + 0.13 * front), 0.022, 0.02, front, 0.9, front, *paint
            )
        return
    hip = trunk.pelvis + unit * (0.235 * left + 0.05 * up)
    yield Garment(hip + 0.05 * unit * front, hip - 0.08 * unit * front, 0.125, 0.125, left, 0.45, left, *paint)
    shoulder = trunk.neck - unit * (0.11 * left + 0.02 * up)
    yield Garment(shoulder, trunk.chest + unit * (0.13 * front + 0.02 * left), 0.018, 0.018, front, 0.9, front, *paint)
    yield Garment(trunk.chest + unit * (0.13 * front + 0.02 * left), hip, 0.018, 0.018, front, 0.9, front, *paint)


def _load(bones: Skeleton, load: str) -> Iterator[Garment]:
    """What the hands hold, between them or in the right one."""
    (right, left), unit, trunk = bones.arms, bones.unit, bones.trunk
    middle = 0.5 * (right.wrist + left.wrist) + 0.06 * unit * trunk.chest_front
    across = trunk.chest_left
    if load == "box":
        for lift in (-0.06, 0.06):
            for ahead in (-0.03, 0.09):
                place = middle + unit * (lift * _Z + ahead * trunk.chest_front)
                yield Garment(
                    place - 0.09 * unit * across, place + 0.09 * unit * across, 0.085, 0.085, _Z, 0.9,
                    trunk.chest_front, "box", LEATHER, _CARD,
                )  # fmt: skip
    elif load in ("laptop", "tray"):
        colour = (0.55, 0.56, 0.58) if load == "laptop" else (0.45, 0.30, 0.18)
        aside = 0.07 * unit * across
        yield Garment(middle - aside, middle + aside, 0.12, 0.12, _Z, 0.1, trunk.chest_front, "load", LEATHER, colour)
    elif load == "phone":
        hand = right.wrist + 0.1 * unit * unit_vector(right.wrist - right.elbow)
        yield Garment(
            hand - 0.045 * unit * _Z, hand + 0.045 * unit * _Z, 0.036, 0.036, trunk.chest_front, 0.15,
            trunk.chest_front, "load", LEATHER, _RUBBER,
        )  # fmt: skip
    else:  # a bag in the right hand
        grip = right.wrist - 0.12 * unit * _Z
        for ahead in (-0.09, 0.09):
            low = grip + ahead * unit * trunk.chest_front - 0.18 * unit * _Z
            yield Garment(grip, low, 0.02, 0.07, across, 0.7, trunk.chest_front, "load", DENIM, (0.16, 0.2, 0.26))


def _wheelchair(bones: Skeleton) -> Iterator[Garment]:
    """Two large wheels, two small ones, a seat, a back and foot rests; it moves with the person."""
    trunk, unit = bones.trunk, bones.unit
    front, left = trunk.pelvis_front, trunk.pelvis_left
    floor = trunk.pelvis * np.array([1.0, 1.0, 0.0])
    black = "chair", LEATHER, _RUBBER
    for sign in (-1, 1):
        hub = floor + unit * (0.28 * sign * left - 0.02 * front) + 0.30 * _Z
        yield Garment(hub, hub, 0.29, 0.29, left, 0.06, front, "wheel", LEATHER, _RUBBER)
        yield Garment(
            hub + 0.02 * sign * left, hub + 0.02 * sign * left, 0.24, 0.24, left, 0.05, front, "rim", LEATHER, _STEEL
        )
        caster = floor + unit * (0.22 * sign * left + 0.40 * front) + 0.08 * _Z
        yield Garment(caster, caster, 0.08, 0.08, left, 0.2, front, "caster", LEATHER, _RUBBER)
        rest = floor + unit * (0.12 * sign * left + 0.48 * front) + 0.11 * _Z
        yield Garment(rest, rest + 0.12 * unit * front, 0.07, 0.07, _Z, 0.15, front, "rest", LEATHER, _STEEL)
        arm = floor + unit * (0.26 * sign * left - 0.12 * front) + 0.66 * _Z
        yield Garment(arm, arm + 0.30 * unit * front, 0.03, 0.03, _Z, 0.8, front, "armrest", LEATHER, _RUBBER)
        yield Garment(
            floor + unit * (0.20 * sign * left - 0.24 * front) + 0.45 * _Z,
            floor + unit * (0.20 * sign * left - 0.33 * front) + 0.95 * _Z, 0.018, 0.018, left, 1.0, front, "frame",
            LEATHER, _STEEL,
        )  # fmt: skip
    seat = floor + 0.42 * _Z
    yield Garment(seat - 0.12 * unit * front, seat + 0.14 * unit * front, 0.22, 0.22, _Z, 0.12, front, *black)
    back = floor - 0.24 * unit * front
    yield Garment(back + 0.55 * _Z, back - 0.05 * unit * front + 0.78 * _Z, 0.22, 0.22, front, 0.12, front, *black)
