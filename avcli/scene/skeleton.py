"""A person's joints at many times: trunk, legs, arms and head, by closed formulas from the person's motion.

Lengths of limbs are fractions of the body's height H, others are metres of a body of 1.75 m. Those of thigh, shank and
foot: Winter, Biomechanics and Motor Control of Human Movement (2009), figure 4.1. All others were chosen by eye.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from avcli.scene.person import Person, listening, talking
from avcli.scene.postures import LOADS, POSTURES, WHEELCHAIR, Posture

AVERAGE_M = 1.75
_THIGH, _SHANK, FOOT = 0.245, 0.246, 0.152  # over H
_UPPER_ARM, _FOREARM = 0.172, 0.150  # over H
_LEG = 0.49  # over H, hip to ankle; a little less than thigh and shank, so that knees are never quite straight
_HIP_HALF_M, _SHOULDER_HALF_M = 0.085, 0.168
ANKLE_M = 0.075  # above the floor
_SEAT_AHEAD_M = 0.36  # feet go forward of a chair's seat, hips to the middle of it
_SEAT_HEIGHT_M = 0.53  # of the hips above the floor
_SWAY_M, _IDLE_M = 0.018, 0.006  # sideways, while walking and while standing
_LEAN = np.deg2rad(2.5)
_GESTURE_HZ, _NOD_HZ, _LOOK_ROUND_HZ = 0.75, 0.9, 0.23
_UP = np.array([0.0, 0.0, 1.0])
_GROWN_M, _HEAD_M = 1.5, 0.213  # below the first a body is a child's, whose head is larger; from the neck to the top
_LYING_M = 0.12  # of the hips above the floor
_PUSH_M, _PUSHES_M, _REST_M = 0.12, 1.3, 0.12  # of hands on wheels, a push for so far a way; of feet above the floor


@dataclass(frozen=True)
class Trunk:
    """Pelvis, chest and their axes at n times, (n, 3) m or unit vectors; and how the person walks, sits and talks.

    Attributes:
        pelvis, waist, chest, neck: joints.
        pelvis_front, pelvis_left, chest_front, chest_left, chest_up: axes.
        sit, talk: (n,) how far the person sits, and gestures.
        sole: (n, 2, 3) where the soles are; right, left.
        foot_heading, foot_swing, foot_ahead: (n, 2) as Motion.feet gives them.
        stride: (n,) right foot before left, -1..1.
        doing: the postures besides standing and plain sitting, with how far each is taken, (n,).
    """

    pelvis: np.ndarray
    waist: np.ndarray
    chest: np.ndarray
    neck: np.ndarray
    pelvis_front: np.ndarray
    pelvis_left: np.ndarray
    chest_front: np.ndarray
    chest_left: np.ndarray
    chest_up: np.ndarray
    sit: np.ndarray
    talk: np.ndarray
    sole: np.ndarray
    foot_heading: np.ndarray
    foot_swing: np.ndarray
    foot_ahead: np.ndarray
    stride: np.ndarray
    doing: list[tuple[Posture, np.ndarray]]


@dataclass(frozen=True)
class Leg:
    """One leg at n times: joints (n, 3) m, and the foot's axes: forward on the floor, along the sole, away from it."""

    hip: np.ndarray
    knee: np.ndarray
    ankle: np.ndarray
    heel: np.ndarray
    toe: np.ndarray
    forward: np.ndarray
    along: np.ndarray
    rise: np.ndarray


@dataclass(frozen=True)
class Arm:
    """One arm at n times: joints (n, 3) m."""

    shoulder: np.ndarray
    elbow: np.ndarray
    wrist: np.ndarray


@dataclass(frozen=True)
class Head:
    """The head at n times: where the neck ends, the middle of the head, and its axes, (n, 3); `unit` is its size."""

    base: np.ndarray
    centre: np.ndarray
    front: np.ndarray
    left: np.ndarray
    up: np.ndarray
    unit: float

    def at(self, forward: float, side: float, rise: float) -> np.ndarray:
        """A point (n, 3) of the head, by metres of an average head along its axes."""
        return self.centre + self.unit * (forward * self.front + side * self.left + rise * self.up)


@dataclass(frozen=True)
class Skeleton:
    """All joints at n times; legs and arms are (right, left).

    `unit` is the size of the body over that of the average, `height` the height that a grown body of that size has, m.
    """

    unit: float
    height: float
    trunk: Trunk
    legs: tuple[Leg, Leg]
    arms: tuple[Arm, Arm]
    head: Head

    @property
    def mouth(self) -> np.ndarray:
        """The mouth, (n, 3)."""
        return self.head.at(0.105, 0, -0.058)

    def joints(self) -> dict[str, np.ndarray]:
        """All COCO keypoints by name, (n, 3) each."""
        face = {"nose": (0.125, 0.0, -0.022)}
        for side, sign in (("left", 1), ("right", -1)):
            face |= {f"{side}_eye": (0.092, sign * 0.033, 0.01), f"{side}_ear": (0.0, sign * 0.08, -0.005)}
        points = {name: self.head.at(*place) for name, place in face.items()}
        for side, leg, arm in zip(("right", "left"), self.legs, self.arms, strict=True):
            for limb, names in ((arm, ("shoulder", "elbow", "wrist")), (leg, ("hip", "knee", "ankle"))):
                points |= {f"{side}_{name}": getattr(limb, name) for name in names}
        return points


def skeleton(person: Person, t: np.ndarray) -> Skeleton:
    """Pose a person's joints at times t (n,) s."""
    height, unit, head_unit = _proportions(person.height)
    trunk = _trunk(person, t, unit, height)
    legs = _leg(height, trunk, unit, 0), _leg(height, trunk, unit, 1)
    arms = _arm(person, t, trunk, legs[0], unit, height, 0), _arm(person, t, trunk, legs[1], unit, height, 1)
    bones = Skeleton(unit, height, trunk, legs, arms, _head(person, t, trunk, unit, head_unit))
    for posture, amount in trunk.doing:
        if posture.lying:
            bones = _laid(bones, person.motion.position(t), person.motion.heading(t), amount)
    return bones


def _proportions(height: float) -> tuple[float, float, float]:
    """Height of the grown body that has these limbs, m, and the sizes of body and head over the average's.

    A child's head is a larger part of its height: a fifth at 1.1 m (Snyder et al., 1977), against an eighth.
    """
    unit = height / AVERAGE_M
    if height >= _GROWN_M:
        return height, unit, unit
    head = unit * (1 + 0.7 * (_GROWN_M - height))
    unit = (height - _HEAD_M * head) / (AVERAGE_M - _HEAD_M)
    return unit * AVERAGE_M, unit, head


_Part = TypeVar("_Part", Trunk, Leg, Arm, Head)
_POINTS = ("pelvis", "waist", "chest", "neck", "hip", "knee", "ankle", "heel", "toe", "shoulder", "elbow", "wrist",
           "base", "centre")  # fmt: skip
_AXES = ("pelvis_front", "pelvis_left", "chest_front", "chest_left", "chest_up", "forward", "along", "rise", "front",
         "left", "up")  # fmt: skip


def _laid(bones: Skeleton, place: np.ndarray, heading: np.ndarray, amount: np.ndarray) -> Skeleton:
    """Tilt a standing body backwards about its hips, which come to lie at its place on the floor; amount (n,) 0..1."""
    angle = 0.5 * np.pi * amount[:, None]
    forward, left = _horizontal(heading), _horizontal(heading + np.pi / 2)

    def turned(v: np.ndarray) -> np.ndarray:
        ahead, up = np.sum(v * forward, -1, keepdims=True), np.sum(v * _UP, -1, keepdims=True)
        aside = np.sum(v * left, -1, keepdims=True) * left
        cos, sin = np.cos(angle), np.sin(angle)
        return aside + (ahead * cos - up * sin) * forward + (ahead * sin + up * cos) * _UP

    hips = bones.trunk.pelvis
    low = np.concatenate([place, np.full((len(place), 1), _LYING_M * bones.unit)], -1)
    pivot = hips + amount[:, None] * (low - hips)

    def tilted(part: _Part) -> _Part:
        names = [field.name for field in fields(part)]
        moved: dict[str, Any] = {name: pivot + turned(getattr(part, name) - hips) for name in _POINTS if name in names}
        moved |= {name: turned(getattr(part, name)) for name in _AXES if name in names}
        return replace(part, **moved)

    right, left_leg = map(tilted, bones.legs)
    first, second = map(tilted, bones.arms)
    return replace(
        bones, trunk=tilted(bones.trunk), legs=(right, left_leg), arms=(first, second), head=tilted(bones.head)
    )


def _doing(person: Person, t: np.ndarray) -> list[tuple[Posture, np.ndarray]]:
    """Postures besides standing and plain sitting, and how far each is taken, (n,)."""
    taken = person.motion.doing(t)
    found = [(POSTURES[name], amount) for name, amount in taken.items()]
    free = np.maximum(1 - sum(taken.values(), np.zeros_like(t)), 0)
    if person.wheelchair:
        found.append((WHEELCHAIR, free))
    if person.carries:
        found.append((LOADS[person.carries], free))
    return found


def _trunk(person: Person, t: np.ndarray, unit: float, height: float) -> Trunk:
    """The chest turns against the pelvis, and leans with speed, into a seat and as the posture asks."""
    motion, doing = person.motion, _doing(person, t)
    sit, heading = motion.sitting(t), motion.heading(t)
    sole, foot_heading, foot_swing, foot_ahead = motion.feet(t, ANKLE_M * unit)
    speed = motion.speed(t)
    if person.wheelchair:
        sit, speed = np.ones_like(sit), np.zeros_like(speed)
        sole, foot_heading, foot_swing, foot_ahead = motion.standing_feet(t, ANKLE_M * unit)
        sole = sole + _REST_M * _UP
    stride = np.clip(0.5 * (foot_ahead[:, 0] - foot_ahead[:, 1]), -1, 1)
    moving = np.clip(speed / 0.6, 0, 1)
    idle = (1 - moving) * _IDLE_M * np.sin(0.9 * t + 2.1 * person.object_id)
    forward, left = _horizontal(heading), _horizontal(heading + np.pi / 2)
    ground = np.concatenate([motion.position(t), np.zeros((len(t), 1))], -1)
    sole = sole + (_SEAT_AHEAD_M * unit * sit)[:, None, None] * forward[:, None]
    stance = np.sum((1 - foot_swing) * np.array([-1.0, 1.0]), 1)
    sway = _SWAY_M * unit * np.clip(stance, -1, 1) * moving + idle
    leg = _LEG * height
    # The hips sink as far as the foot on the floor demands; a trailing foot gains by lifting its heel.
    reach = np.abs(foot_ahead).max(1) * _step_length(sole, ground, foot_ahead)
    drop = leg - np.sqrt(np.maximum(leg**2 - np.minimum(0.8 * reach, 0.6 * leg) ** 2, 0))
    standing = ANKLE_M * unit + 0.985 * leg - np.minimum(drop, 0.18 * leg)
    hip_height = (1 - sit) * standing + sit * _SEAT_HEIGHT_M * unit**0.5
    hip_height = hip_height * (1 + sum(((p.hips - 1) * amount for p, amount in doing), np.zeros_like(t)))
    bow = np.sin(np.pi * sit) * 0.5 + 0.10 * sit + _LEAN + 0.03 * np.minimum(speed, 4)
    bow = bow + sum((p.bow * amount for p, amount in doing), np.zeros_like(t))
    back = sum((p.back * unit * amount for p, amount in doing), np.zeros_like(t))
    pelvis = ground + sway[:, None] * left + hip_height[:, None] * _UP
    pelvis = pelvis - (0.02 * unit * np.sin(np.pi * sit) + back)[:, None] * forward
    twist = 0.13 * stride * moving
    pelvis_heading, chest_heading = heading + twist, heading - 0.9 * twist
    level = _horizontal(chest_heading)
    cos, sin = np.cos(bow)[:, None], np.sin(bow)[:, None]
    chest_front, chest_up = level * cos - _UP * sin, _UP * cos + level * sin
    waist = pelvis + 0.16 * unit * (0.6 * chest_up + 0.4 * _UP)
    chest = waist + 0.16 * unit * chest_up
    return Trunk(
        pelvis=pelvis,
        waist=waist,
        chest=chest,
        neck=chest + 0.165 * unit * chest_up - 0.01 * unit * chest_front,
        pelvis_front=_horizontal(pelvis_heading),
        pelvis_left=_horizontal(pelvis_heading + np.pi / 2),
        chest_front=chest_front,
        chest_left=_horizontal(chest_heading + np.pi / 2),
        chest_up=chest_up,
        sit=sit,
        talk=talking(person.speech, t),
        sole=sole,
        foot_heading=foot_heading,
        foot_swing=foot_swing,
        foot_ahead=foot_ahead,
        stride=stride,
        doing=doing,
    )


def hip_offset(trunk: Trunk, unit: float) -> np.ndarray:
    """From the pelvis to the left hip, (n, 3) m."""
    return _HIP_HALF_M * unit * trunk.pelvis_left


def _step_length(sole: np.ndarray, ground: np.ndarray, foot_ahead: np.ndarray) -> np.ndarray:
    apart = np.linalg.norm((sole - ground[:, None])[..., :2], axis=-1).max(1)
    return apart / np.maximum(np.abs(foot_ahead).max(1), 1e-6)


def _leg(h: float, trunk: Trunk, unit: float, side: int) -> Leg:
    """The right (0) or left (1) leg of a body of height h; the foot rolls from heel to toes."""
    sign = (-1.0, 1.0)[side]
    forward = _horizontal(trunk.foot_heading[:, side] + sign * 0.12)
    ahead, swing = trunk.foot_ahead[:, side], trunk.foot_swing[:, side]
    # Positive pitch lifts the heel: at push-off and early in the swing; toes rise for the heel's landing.
    pitch = 0.75 * np.clip(-ahead - 0.25, 0, 0.8) - 0.35 * np.clip(ahead - 0.25, 0, 0.6)
    pitch = pitch + 0.35 * np.sin(np.pi * np.clip(2 * swing, 0, 1)) * (swing > 0)
    cos, sin = np.cos(pitch)[:, None], np.sin(pitch)[:, None]
    along, rise = forward * cos - _UP * sin, _UP * cos + forward * sin
    length, ankle_height = FOOT * h, ANKLE_M * unit
    ball = trunk.sole[:, side] + 0.30 * length * forward + 0.03 * unit * _UP
    heel = trunk.sole[:, side] - 0.30 * length * forward + 0.035 * unit * _UP
    # The foot pivots on its ball while the heel is up, on its heel while the toes are up.
    ankle = np.where(
        (pitch < 0)[:, None],
        heel + 0.09 * length * along + (ankle_height - 0.035 * unit) * rise,
        ball - 0.53 * length * along + (ankle_height - 0.03 * unit) * rise,
    )
    hip = trunk.pelvis + sign * (_HIP_HALF_M * unit) * trunk.pelvis_left
    knee, ankle = two_links(hip, ankle, _THIGH * h, _SHANK * h, trunk.pelvis_front + 0.08 * sign * trunk.pelvis_left)
    heel = ankle - 0.09 * length * along - (ankle_height - 0.035 * unit) * rise
    toe = ankle + 0.62 * length * along - (ankle_height - 0.027 * unit) * rise
    return Leg(hip, knee, ankle, heel, toe, forward, along, rise)


def _arm(person: Person, t: np.ndarray, trunk: Trunk, leg: Leg, unit: float, height: float, side: int) -> Arm:
    """The right (0) or left (1) arm: it swings, lies in the lap, does what the posture asks, or gestures."""
    sign, look = (-1.0, 1.0)[side], person.look
    front, left, up = trunk.chest_front, trunk.chest_left, trunk.chest_up
    upper, lower = _UPPER_ARM * height, _FOREARM * height
    shoulder = trunk.neck + sign * _SHOULDER_HALF_M * unit * look.shoulders * left - 0.045 * unit * up
    speed = np.clip(person.motion.speed(t), 0, 3)
    # Arms swing against the leg of their side; faster walks swing and bend them more.
    swing = -0.42 * sign * -trunk.stride * np.minimum(speed, 1.5) ** 0.5 + 0.05
    bend = 0.28 + 0.12 * speed + 0.25 * np.maximum(swing, 0)
    ahead = upper * np.sin(swing) + lower * np.sin(swing + bend)
    down = upper * np.cos(swing) + lower * np.cos(swing + bend)
    hanging = shoulder + ahead[:, None] * front - down[:, None] * up + 0.045 * unit * sign * left
    lap = leg.knee - 0.12 * unit * trunk.pelvis_front + 0.085 * unit * _UP - 0.03 * sign * trunk.pelvis_left
    target = hanging + trunk.sit[:, None] * (lap - hanging)
    busy = np.zeros_like(t)
    for posture, share in trunk.doing:
        place = posture.hands[side]
        if place is not None:
            goal = _hand(person, t, posture, place, unit, side)
            target, busy = target + share[:, None] * (goal - target), np.maximum(busy, share)
    if person.gestures:
        beat = 1.7 * person.object_id + t * 2 * np.pi * _GESTURE_HZ
        amount = (1 - busy) * trunk.talk * (0.75 + 0.25 * np.sin(0.61 * beat + sign)) * (1.0, 0.7)[side]
        hand = (
            shoulder
            + (0.27 + 0.05 * np.sin(1.3 * beat + sign))[:, None] * unit * front
            - (0.22 - 0.09 * np.sin(beat + 0.9 * sign))[:, None] * unit * up
            - (0.05 + 0.07 * np.sin(0.83 * beat - sign))[:, None] * unit * sign * left
        )
        target = target + amount[:, None] * (hand - target)
    elbow, wrist = two_links(shoulder, target, upper, lower, -0.8 * front + 0.55 * sign * left - 0.35 * up)
    return Arm(shoulder, elbow, wrist)


def _hand(
    person: Person, t: np.ndarray, posture: Posture, place: tuple[float, float, float], unit: float, side: int
) -> np.ndarray:
    """Where a posture wants a wrist, (n, 3)."""
    sign, heading = (-1.0, 1.0)[side], person.motion.heading(t)
    ahead, out, height = place
    forward = np.full(len(t), ahead)
    if posture is WHEELCHAIR:
        forward = forward + _PUSH_M * np.sin(2 * np.pi / _PUSHES_M * person.motion.travelled(t))
    forward = forward + posture.moving * np.sin(2 * np.pi * (2.1 + 0.7 * side) * t + person.object_id)
    level = forward[:, None] * _horizontal(heading) + sign * out * _horizontal(heading + np.pi / 2)
    at = np.concatenate([person.motion.position(t), np.zeros((len(t), 1))], -1)
    return at + unit * level + (height * unit**0.5 if posture.seated else height * unit) * _UP


def _head(person: Person, t: np.ndarray, trunk: Trunk, unit: float, head_unit: float) -> Head:
    """The head nods and looks round while its person talks, and turns to others while they do."""
    nod = 0.06 + sum((p.nod * amount for p, amount in trunk.doing), np.zeros_like(t))
    nod = nod + trunk.talk * 0.07 * np.sin(2 * np.pi * _NOD_HZ * t + person.object_id)
    turn = trunk.talk * 0.18 * np.sin(2 * np.pi * _LOOK_ROUND_HZ * t + 2 * person.object_id)
    heading = person.motion.heading(t) + turn + listening(person, t)
    level, left = _horizontal(heading), _horizontal(heading + np.pi / 2)
    front = level * np.cos(nod)[:, None] - _UP * np.sin(nod)[:, None]
    up = _UP * np.cos(nod)[:, None] + level * np.sin(nod)[:, None]
    base = trunk.neck + 0.055 * unit * unit_vector(trunk.chest_up + up)
    centre = base + 0.098 * head_unit * up + 0.018 * head_unit * front
    return Head(base, centre, front, left, up, head_unit)


def two_links(
    root: np.ndarray, target: np.ndarray, first: float, second: float, pole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bend two links from a root towards a target.

    Args:
        root, target: (n, 3) m; a target out of reach is approached as far as the links go.
        first, second: lengths of the links, m.
        pole: (n, 3), the side on which the joint lies.

    Returns:
        The joint and the end, (n, 3) each.
    """
    offset = target - root
    distance = np.maximum(lengths(offset), 1e-6)
    direction = offset / distance
    reach = np.clip(distance, abs(first - second) + 0.02, 0.999 * (first + second))
    along = (first**2 - second**2 + reach**2) / (2 * reach)
    aside = np.sqrt(np.maximum(first**2 - along**2, 0.0))
    bend = unit_vector(pole - direction * np.sum(pole * direction, -1, keepdims=True))
    return root + along * direction + aside * bend, root + reach * direction


def unit_vector(vector: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) scaled to length 1."""
    return vector / np.maximum(lengths(vector), 1e-12)


def lengths(vector: np.ndarray) -> np.ndarray:
    """Lengths (..., 1) of vectors (..., 3); numpy's norm takes twice as long."""
    found: np.ndarray = np.sqrt(np.add.reduce(vector * vector, -1, keepdims=True))
    return found


def _horizontal(heading: np.ndarray) -> np.ndarray:
    way = np.zeros((*heading.shape, 3))
    way[..., 0], way[..., 1] = np.cos(heading), np.sin(heading)
    return way
