"""The rounded cones around a skeleton: trunk, limbs, hands, head, hair and clothes.

Sizes are metres of a body of 1.75 m, chosen by eye.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from avcli.scene.garments import Garment, garments
from avcli.scene.person import EYES, FOLDED, HAIR, KNIT, LEATHER, SKIN, Colour, Person, rgb
from avcli.scene.skeleton import FOOT, Arm, Head, Leg, Skeleton, hip_offset, unit_vector

_TOUCHING = 4  # cones whose surfaces blend with one cone's, at most
_SKULL = (-0.022, 0.0, 0.022), (0.022, 0.0, 0.018)
_FINGERS = (0.070, 0.078, 0.072, 0.058)  # lengths
_Z = np.array([0.0, 0.0, 1.0])


@dataclass
class Part(Garment):
    """One rounded cone at n times; its radii are those of this body.

    Attributes:
        beyond: colour beyond `split`, a fraction of its axis.
        second: colour of what is printed on it.
    """

    beyond: Colour
    second: Colour
    split: float


class _Surface(TypedDict):
    """What a part is made of."""

    group: str
    material: int
    colour: Colour
    front: np.ndarray


def dress(bones: Skeleton, person: Person) -> list[Part]:
    """Put cones around a skeleton at n times: the person's body, clothes and what they carry."""
    dressed = _Dress(person, bones)
    dressed.trunk()
    for side, leg in enumerate(bones.legs):
        dressed.leg(leg, side, bones.height)
    for side, arm in enumerate(bones.arms):
        dressed.arm(arm, side)
    dressed.head(bones.head)
    dressed.garments(person)
    return dressed.parts


def touching(parts: list[Part]) -> np.ndarray:
    """For each cone the cones of its group that touch it most, by the gap between their balls; (p, 4), -1 for none."""
    f = np.linspace(0, 1, 4)[:, None]
    a, b = np.array([(part.a[0], part.b[0]) for part in parts]).transpose(1, 2, 0)[:, :, None]
    ra, rb = np.array([(part.ra, part.rb) for part in parts]).T
    balls, radii = a * (1 - f) + b * f, ra * (1 - f) + rb * f  # (3, 4, p), (4, p)
    numbers: dict[str, int] = {}
    group = np.array([numbers.setdefault(part.group, len(numbers)) for part in parts])
    one, other = np.nonzero((group[:, None] == group) & ~np.eye(len(parts), dtype=bool))
    x, y, z = balls[:, :, None, one] - balls[:, None, :, other]
    gaps = np.sqrt(x * x + y * y + z * z) - radii[:, None, one] - radii[None, :, other]
    nearest = gaps.min((0, 1))
    gap = np.full((len(parts), len(parts)), np.inf)
    gap[one, other] = np.where(nearest > 0, np.inf, nearest)
    best = np.argsort(gap, 1, kind="stable")[:, :_TOUCHING]
    best = np.pad(best, ((0, 0), (0, _TOUCHING - best.shape[1])), constant_values=-1)
    kept = np.isfinite(np.take_along_axis(gap, np.maximum(best, 0), 1)) & (best >= 0)
    return np.where(kept, best, -1)


def shadow_balls(bones: Skeleton) -> np.ndarray:
    """Balls (n, 20, 4), centre and radius, that cast the body's shadow; the first eight also darken the body."""
    trunk, unit = bones.trunk, bones.unit
    side = 0.075 * unit * trunk.chest_left
    balls = [
        (0.5 * (bones.head.at(*_SKULL[0]) + bones.head.at(*_SKULL[1])), 0.092),
        (trunk.chest + side, 0.105), (trunk.chest - side, 0.105), (trunk.pelvis, 0.135),
        *((arm.elbow, 0.05) for arm in bones.arms),
        *((leg.knee, 0.06) for leg in bones.legs),
        *((0.5 * (leg.hip + leg.knee), 0.078) for leg in bones.legs),
        *((0.5 * (leg.knee + leg.ankle), 0.052) for leg in bones.legs),
        *((leg.ankle, 0.05) for leg in bones.legs),
        *((leg.toe, 0.04) for leg in bones.legs),
        *((arm.wrist, 0.04) for arm in bones.arms),
        *((arm.shoulder, 0.055) for arm in bones.arms),
    ]  # fmt: skip
    rows = np.empty((len(trunk.chest), len(balls), 4))
    for k, (at, radius) in enumerate(balls):
        rows[:, k, :3], rows[:, k, 3] = at, radius * unit
    return rows


class _Dress:
    """Collects the parts of one person."""

    def __init__(self, person: Person, bones: Skeleton) -> None:
        self.look, self.bones, self.unit = person.look, bones, bones.unit
        look, folds = person.look, FOLDED if person.look.folds else 0
        self.cloth, self.legwear = look.cloth | folds, look.legwear | folds
        worn = (look.cloth, look.shirt) if look.jacket is None else (KNIT, look.jacket)
        self.sleeve, self.sleeve_colour = worn[0] | folds, worn[1]
        self.sleeve_end = look.sleeve if look.jacket is None else 2.0
        self.parts: list[Part] = []

    def add(
        self,
        a: np.ndarray,
        b: np.ndarray,
        ra: float,
        rb: float,
        surface: _Surface,
        flat_axis: np.ndarray = _Z,
        flat: float = 1.0,
        *,
        beyond: Colour | None = None,
        split: float = 2.0,
    ) -> None:
        """Add a cone whose radii are metres of an average body."""
        colour = surface["colour"]
        second = self.look.second or colour
        self.parts.append(
            Part(
                a, b, ra * self.unit, rb * self.unit, flat_axis, flat, surface["front"], surface["group"],
                surface["material"], colour, beyond or colour, second, split,
            )
        )  # fmt: skip

    def trunk(self) -> None:
        """Add hips, belly, chest and shoulders."""
        trunk, unit, look = self.bones.trunk, self.unit, self.look
        g, w = look.girth, look.shoulders
        front, up = trunk.chest_front, trunk.chest_up
        shirt = _Surface(group="shirt", material=self.cloth, colour=look.shirt, front=front)
        hips = _Surface(group="legs", material=self.legwear, colour=look.trousers, front=trunk.pelvis_front)
        side = hip_offset(trunk, unit)
        self.add(trunk.pelvis + side, trunk.pelvis - side, 0.094 * g, 0.094 * g, hips, trunk.pelvis_front, 0.9)
        self.add(trunk.pelvis + 0.03 * _Z, trunk.waist, 0.142 * g, 0.136 * g, shirt, front, 0.74)
        self.add(trunk.waist, trunk.chest, 0.136 * g, 0.158 * w, shirt, front, 0.70)
        self.add(trunk.chest, trunk.chest + 0.07 * unit * up, 0.158 * w, 0.125 * w, shirt, front, 0.68)
        yoke = _Surface(group="shirt", material=self.sleeve, colour=self.sleeve_colour, front=front)
        for sign, arm in zip((-1, 1), self.bones.arms, strict=True):
            inner = trunk.neck + sign * 0.05 * unit * trunk.chest_left - 0.015 * unit * up
            self.add(inner, arm.shoulder, 0.05, 0.056 * w, yoke, front, 0.9)

    def leg(self, leg: Leg, side: int, height: float) -> None:
        """Add thigh, shin and shoe."""
        unit, look, length = self.unit, self.look, FOOT * height
        cloth = _Surface(group="legs", material=self.legwear, colour=look.trousers, front=self.bones.trunk.pelvis_front)
        self.add(leg.hip, leg.knee, 0.088 * look.girth, 0.057, cloth)
        middle = leg.knee + 0.3 * (leg.ankle - leg.knee) - 0.012 * unit * leg.forward
        shin = _Surface(group="legs", material=self.legwear, colour=look.trousers, front=leg.forward)
        self.add(leg.knee, middle, 0.056, 0.056, shin, beyond=look.skin)
        self.add(middle, leg.ankle, 0.055, 0.043, shin, beyond=look.skin, split=look.legs - 1.0)
        shoe = _Surface(group=f"shoe{side}", material=LEATHER, colour=look.shoes, front=leg.forward)
        ball = leg.toe - 0.2 * length * leg.along
        self.add(leg.heel, ball, 0.035, 0.039, shoe, leg.rise, 0.82)
        self.add(ball, leg.toe, 0.039, 0.032, shoe, leg.rise, 0.74)
        self.add(leg.ankle - 0.02 * unit * leg.rise, leg.heel + 0.02 * leg.rise, 0.041, 0.036, shoe)

    def arm(self, arm: Arm, side: int) -> None:
        """Add upper arm, forearm and hand; the sleeve ends where the look says."""
        look, front = self.look, self.bones.trunk.chest_front
        sleeve = _Surface(group="shirt", material=self.sleeve, colour=self.sleeve_colour, front=front)
        end = self.sleeve_end
        self.add(arm.shoulder, arm.elbow, 0.057 * look.shoulders, 0.044, sleeve, beyond=look.skin, split=end)
        if end <= 1.0:
            sleeve = _Surface(group=f"arm{side}", material=SKIN, colour=look.skin, front=front)
        middle = arm.elbow + 0.35 * (arm.wrist - arm.elbow)
        self.add(arm.elbow, middle, 0.042, 0.041, sleeve, beyond=look.skin)
        self.add(middle, arm.wrist, 0.041, 0.029, sleeve, beyond=look.skin, split=(end - 1.35) / 0.65)
        self.hand(arm, side)

    def garments(self, person: Person) -> None:
        """Add what is worn over shirt and trousers, and what is carried."""
        for item in garments(self.bones, person.look, person.carries, wheelchair=person.wheelchair):
            surface = _Surface(group=item.group, material=item.material, colour=item.colour, front=item.front)
            self.unit = self.bones.head.unit if item.group == "hat" else self.bones.unit
            self.add(item.a, item.b, item.ra, item.rb, surface, item.flat_axis, item.flat)

    def hand(self, arm: Arm, side: int) -> None:
        """Add palm, fingers and thumb."""
        unit, sign, wrist = self.unit, (-1.0, 1.0)[side], arm.wrist
        along = unit_vector(wrist - arm.elbow)
        inward = -sign * self.bones.trunk.chest_left
        palm = unit_vector(inward - along * np.sum(inward * along, -1, keepdims=True))
        across = np.cross(along, palm) * sign
        skin = _Surface(group=f"hand{side}", material=SKIN, colour=self.look.skin, front=palm)
        knuckles = wrist + 0.075 * unit * along
        self.add(wrist, knuckles, 0.028, 0.036, skin, palm, 0.5)
        bend, curl = unit_vector(along + 0.2 * palm), unit_vector(along + 0.45 * palm)
        for index, finger in enumerate(_FINGERS):
            base = knuckles + (0.026 - 0.0175 * index) * unit * across
            length = finger * unit
            bent = base + 0.5 * length * bend
            self.add(base, bent, 0.0105, 0.0095, skin)
            self.add(bent, bent + 0.5 * length * curl, 0.0095, 0.0075, skin)
        thumb = wrist + 0.025 * unit * along + 0.024 * unit * across
        tip = thumb + 0.055 * unit * unit_vector(along + 0.55 * across + 0.5 * palm)
        self.add(thumb, tip, 0.014, 0.010, skin)

    def head(self, head: Head) -> None:
        """Add neck, skull, jaw, nose, face and hair."""
        trunk, at = self.bones.trunk, head.at
        skin = _Surface(group="head", material=SKIN, colour=self.look.skin, front=head.front)
        self.add(trunk.neck - 0.02 * self.unit * trunk.chest_up, head.base, 0.058, 0.053, skin)
        self.unit = head.unit
        self.add(at(*_SKULL[0]), at(*_SKULL[1]), 0.083, 0.079, skin, head.left, 0.90)
        self.add(at(0.03, 0, 0.0), at(0.052, 0, -0.083), 0.066, 0.034, skin, head.left, 0.95)
        self.add(at(0.02, 0, -0.045), at(0.045, 0, -0.085), 0.058, 0.036, skin)
        self.add(at(0.098, 0, 0.012), at(0.113, 0, -0.028), 0.008, 0.0145, skin)
        self.face(head)
        material = KNIT if self.look.cut == "scarf" else HAIR
        hair = _Surface(group="hair", material=material, colour=self.look.hair, front=head.front)
        for a, b, ra, rb, flat in _strands(self.look.cut):
            self.add(at(*a), at(*b), ra, rb, hair, head.left, flat)

    def face(self, head: Head) -> None:
        """Add ears, eyes, brows and lips."""
        look, at, front = self.look, head.at, head.front
        bald = look.cut in ("bald", "scarf")
        white: Colour = (0.93, 0.92, 0.9)
        brown = rgb("5a4636") if bald else look.hair
        red, green, blue = look.skin
        lips: Colour = (0.78 * red + 0.08, 0.78 * green - 0.01, 0.78 * blue)
        for s in (-1, 1):
            ear = _Surface(group=f"ear{s}", material=SKIN, colour=look.skin, front=front)
            eye = _Surface(group=f"eye{s}", material=EYES, colour=white, front=front)
            brow = _Surface(group=f"brow{s}", material=HAIR, colour=brown, front=front)
            self.add(at(-0.002, s * 0.077, 0.006), at(0, s * 0.074, -0.03), 0.021, 0.013, ear, head.left, 0.5)
            self.add(at(0.079, s * 0.033, 0.01), at(0.079, s * 0.033, 0.01), 0.0135, 0.0135, eye, head.up, 1)
            inner, outer = at(0.0955, s * 0.017, 0.036), at(0.0840, s * 0.047, 0.035)
            self.add(inner, outer, 0.0058, 0.0045, brow, head.up, 0.7)
        mouth = _Surface(group="lips", material=SKIN, colour=lips, front=front)
        self.add(at(0.0985, 0.021, -0.058), at(0.0985, -0.021, -0.058), 0.0085, 0.0085, mouth, head.up, 0.7)


_Point = tuple[float, float, float]


def _strands(cut: str) -> Iterator[tuple[_Point, _Point, float, float, float]]:
    """The cones of a haircut: two points of the head (forward, left, up), radii there, and flatness to the side."""
    if cut == "bald":
        return
    if cut == "scarf":
        yield (-0.026, 0, 0.026), (0.012, 0, 0.030), 0.092, 0.085, 0.92
        yield (-0.02, 0, -0.01), (-0.015, 0, -0.09), 0.092, 0.085, 0.95
        yield (0.0, 0, -0.115), (-0.01, 0, -0.15), 0.082, 0.115, 1.0
        return
    thick = {"cropped": 0.004, "receding": 0.004, "curly": 0.024}.get(cut, 0.010)
    if cut == "receding":
        yield (-0.034, 0, 0.006), (-0.022, 0, 0.012), 0.083, 0.080, 0.95
        return
    yield (-0.028, 0, 0.028), (0.012, 0, 0.036), 0.083 + thick, 0.073 + thick, 0.92
    yield (-0.034, 0, 0.005), (-0.030, 0, -0.035), 0.076 + thick, 0.062 + thick, 0.93
    if cut in ("short", "beard", "ponytail", "long", "bun", "bob"):
        yield (0.045, 0.035, 0.066), (0.052, -0.035, 0.066), 0.030, 0.030, 1.0
    if cut == "beard":
        yield (0.062, 0.032, -0.075), (0.062, -0.032, -0.075), 0.030, 0.030, 1.0
        yield (0.066, 0.0, -0.085), (0.070, 0, -0.105), 0.034, 0.022, 1.0
    if cut == "long":
        yield (-0.045, 0, -0.02), (-0.060, 0, -0.14), 0.078, 0.072, 1.0
        yield (-0.060, 0, -0.14), (-0.070, 0, -0.22), 0.072, 0.045, 1.0
        for side in (-1, 1):
            yield (0.015, side * 0.058, 0.02), (-0.02, side * 0.066, -0.10), 0.032, 0.030, 1.0
    if cut == "bun":
        yield (-0.105, 0, 0.06), (-0.118, 0, 0.066), 0.040, 0.036, 1.0
    if cut == "bob":
        yield (-0.040, 0, -0.02), (-0.050, 0, -0.085), 0.082, 0.078, 1.0
        for side in (-1, 1):
            yield (0.015, side * 0.056, 0.02), (0.0, side * 0.064, -0.075), 0.034, 0.032, 1.0
    if cut == "afro":
        yield (-0.035, 0, 0.035), (-0.005, 0, 0.045), 0.125, 0.115, 1.0
    if cut == "ponytail":
        yield (-0.10, 0, 0.045), (-0.125, 0, 0.03), 0.022, 0.026, 1.0
        yield (-0.125, 0, 0.03), (-0.125, 0, -0.15), 0.030, 0.014, 1.0
    if cut == "curly":
        for k in range(9):
            angle = 2 * np.pi * k / 9
            forward, aside = float(np.cos(angle)), float(np.sin(angle))
            low = 0.030 if forward > 0.3 else -0.01
            yield (
                (-0.02 + 0.062 * forward, 0.055 * aside, 0.060), (-0.03 + 0.080 * forward, 0.070 * aside, low),
                0.040, 0.036, 1.0,
            )  # fmt: skip
