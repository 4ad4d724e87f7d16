"""People as posable bodies of rounded cones: skeleton, gait, gestures, clothes.

A body is posed for many times at once, by closed formulas from its Motion. A rounded cone is the hull of two balls; it
may be flattened along one axis (chests, feet and hands are not round). Proportions: Winter, Biomechanics (2009).
"""

from dataclasses import dataclass, field

import numpy as np

from avcli.scene.motion import Motion

KEYPOINTS = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
"""The 17 keypoints of COCO, in COCO's order."""

SKIN, KNIT, DENIM, HAIR, LEATHER, STRIPES, PLAID, EYES = range(8)
"""What a cone is made of: how the renderer paints it."""


@dataclass(frozen=True)
class Look:
    """How a person is dressed: colours are sRGB fractions; sleeve and legs say how much of the limb cloth covers."""

    shirt: tuple
    trousers: tuple
    skin: tuple
    hair: tuple
    shoes: tuple
    cut: str = "short"
    cloth: int = KNIT
    legwear: int = DENIM
    sleeve: float = 2.0
    legs: float = 2.0
    girth: float = 1.0
    shoulders: float = 1.0
    height: float = 1.75
    second: tuple | None = None


def _rgb(text):
    return tuple(int(text[i : i + 2], 16) / 255 for i in (0, 2, 4))


LOOKS = {
    "red": Look(_rgb("b3262f"), _rgb("27314f"), _rgb("e2b091"), _rgb("6b431c"), _rgb("241c18"), "long", sleeve=1.55,
                girth=0.93, shoulders=0.92, height=1.68),
    "blue": Look(_rgb("2f56ad"), _rgb("23262c"), _rgb("d8a184"), _rgb("2b1a12"), _rgb("15110f"), "short", sleeve=1.5),
    "olive": Look(_rgb("676a3a"), _rgb("4a4234"), _rgb("8a5a3c"), _rgb("14100e"), _rgb("5a3d25"), "cropped",
                  height=1.83, shoulders=1.04),
    "white": Look(_rgb("dcdad2"), _rgb("39424e"), _rgb("c98e6b"), _rgb("1d1512"), _rgb("d8d5cf"), "bun", STRIPES,
                  sleeve=0.75, girth=0.92, shoulders=0.9, height=1.62, second=_rgb("3d5a80")),
    "grey": Look(_rgb("6f7378"), _rgb("1d2026"), _rgb("e6bea2"), _rgb("8f8a84"), _rgb("3a2a1e"), "receding", girth=1.1,
                 height=1.78),
    "green": Look(_rgb("2e6b4f"), _rgb("7a6a52"), _rgb("5c3a28"), _rgb("0f0c0b"), _rgb("e0ddd8"), "curly", sleeve=0.8,
                  height=1.9, shoulders=1.06),
    "plaid": Look(_rgb("8c3b2e"), _rgb("2f3b57"), _rgb("dfa98a"), _rgb("a8632c"), _rgb("6b4a2b"), "beard", PLAID,
                  girth=1.06, height=1.86, shoulders=1.05, second=_rgb("1f2a33")),
    "mustard": Look(_rgb("c9962e"), _rgb("5b2f3a"), _rgb("a9714f"), _rgb("23150f"), _rgb("2a1d1a"), "ponytail",
                    girth=0.95, shoulders=0.93, height=1.71, legs=1.6),
    "teal": Look(_rgb("1f7d80"), _rgb("3b3f45"), _rgb("efc7ab"), _rgb("c9a36a"), _rgb("1c1c1e"), "bald", sleeve=0.85,
                 height=1.74, girth=1.08),
    "violet": Look(_rgb("5d4a86"), _rgb("20242d"), _rgb("b98263"), _rgb("4d3f63"), _rgb("141316"), "scarf",
                   girth=1.0, height=1.58, shoulders=0.92),
}  # fmt: skip
"""The built-in looks by name."""


@dataclass(frozen=True)
class Person:
    """One person of a scene.

    Attributes:
        object_id: identity in the ground truth.
        motion: where the person is at what time.
        look: clothes, hair, build.
        height: m, to the top of the head.
        speech: (k, 2) s, intervals in which it is this person's turn to speak.
        gestures: whether the hands move while speaking.
    """

    object_id: int
    motion: Motion
    look: Look
    height: float
    speech: np.ndarray
    gestures: bool = True


@dataclass
class Bodies:
    """Bodies at n times, p cones in all; room frame, metres.

    Attributes:
        times: (n,) s.
        a, b: (n, p, 3) ends of the cones' axes.
        ra, rb: (p,) radii there.
        flat_axis: (n, p, 3) unit axis along which a cone is flattened about its middle, by flat (p,) in (0, 1].
        front: (n, p, 3) unit vector to the front of the part, which anchors what is painted on it.
        person: (p,) index of the person.
        touching: (p, 4) indices of cones whose surfaces blend smoothly with this one's, -1 for none.
        material: (p,) SKIN, KNIT...
        colours: (p, 3, 3) sRGB fractions of the cone before and beyond `split` (p,), a fraction of its axis, and of
            what is printed on it.
        balls: (n, people, 20, 4) a coarse body for soft shadows: centre and radius.
        keypoints: (n, people, 17, 3) COCO's keypoints.
        mouths: (n, people, 3).
    """

    times: np.ndarray
    a: np.ndarray
    b: np.ndarray
    ra: np.ndarray
    rb: np.ndarray
    flat_axis: np.ndarray
    flat: np.ndarray
    front: np.ndarray
    person: np.ndarray
    touching: np.ndarray
    material: np.ndarray
    colours: np.ndarray
    split: np.ndarray
    balls: np.ndarray
    keypoints: np.ndarray
    mouths: np.ndarray


def speaking(person, t, end):
    """Whether it is the person's turn at times t (n,), s; a turn that lasts to the scene's end holds its last frame."""
    turns = person.speech.reshape(-1, 2)
    t = np.asarray(t, float)[:, None]
    return ((t >= turns[:, 0] - 1e-9) & ((t < turns[:, 1] - 1e-9) | (turns[:, 1] >= end - 1e-9))).any(1)


def pose(people, t):
    """Pose people at times t (n,) s; returns Bodies."""
    bodies = [_Body(person, np.asarray(t, float)) for person in people]
    offsets = np.cumsum([0] + [len(body.parts) for body in bodies])
    parts = [part for body in bodies for part in body.parts]
    n, p = len(t), len(parts)

    def stacked(name, width):
        rows = [np.broadcast_to(getattr(part, name), (n, width)) for part in parts]
        return np.stack(rows, 1) if p else np.zeros((n, 0, width))

    return Bodies(
        times=np.asarray(t, float),
        a=stacked("a", 3),
        b=stacked("b", 3),
        ra=np.array([part.ra for part in parts]),
        rb=np.array([part.rb for part in parts]),
        flat_axis=stacked("flat_axis", 3),
        flat=np.array([part.flat for part in parts]),
        front=stacked("front", 3),
        person=np.repeat(np.arange(len(bodies)), np.diff(offsets)),
        touching=np.concatenate(
            [
                np.where(body.touching >= 0, body.touching + offset, -1)
                for body, offset in zip(bodies, offsets, strict=False)
            ]
            or [np.zeros((0, 4), int)]
        ),
        material=np.array([part.material for part in parts], int),
        colours=np.array([[part.colour, part.beyond, part.second] for part in parts]).reshape(-1, 3, 3),
        split=np.array([part.split for part in parts]),
        balls=np.stack([body.balls() for body in bodies], 1) if p else np.zeros((n, 0, 20, 4)),
        keypoints=np.stack([body.keypoints for body in bodies], 1) if p else np.zeros((n, 0, 17, 3)),
        mouths=np.stack([body.mouth for body in bodies], 1) if p else np.zeros((n, 0, 3)),
    )


@dataclass
class _Part:
    a: np.ndarray
    b: np.ndarray
    ra: float
    rb: float
    flat_axis: np.ndarray
    flat: float
    front: np.ndarray
    group: str
    material: int
    colour: tuple
    beyond: tuple
    second: tuple
    split: float


@dataclass
class _Body:
    """One person's skeleton and parts at times t."""

    person: Person
    t: np.ndarray
    parts: list = field(default_factory=list)

    def __post_init__(self):
        self.look, self.h = self.person.look, self.person.height
        self.unit = self.h / 1.75
        self._place()
        self._legs()
        self._arms()
        self._head()
        self.touching = _touching(self.parts)

    def balls(self):
        """Balls (n, 20, 4) that cast about the body's shadow; the first eight are those that darken the body itself."""
        unit, side = self.unit, 0.075 * self.unit * self.cl
        centre = 0.5 * (self.parts[self.skull].a + self.parts[self.skull].b)
        limbs = [
            (self.elbow[:, 0], 0.05), (self.elbow[:, 1], 0.05), (self.knee[:, 0], 0.06), (self.knee[:, 1], 0.06),
            (0.5 * (self.hip + self.knee)[:, 0], 0.078), (0.5 * (self.hip + self.knee)[:, 1], 0.078),
            (0.5 * (self.knee + self.ankle)[:, 0], 0.052), (0.5 * (self.knee + self.ankle)[:, 1], 0.052),
            (self.ankle[:, 0], 0.05), (self.ankle[:, 1], 0.05), (self.toe[:, 0], 0.04), (self.toe[:, 1], 0.04),
            (self.wrist[:, 0], 0.04), (self.wrist[:, 1], 0.04), (self.shoulder[:, 0], 0.055),
            (self.shoulder[:, 1], 0.055),
        ]  # fmt: skip
        trunk = [(centre, 0.092), (self.chest + side, 0.105), (self.chest - side, 0.105), (self.pelvis, 0.135)]
        rows = [np.concatenate([at, np.full((len(at), 1), r * unit)], -1) for at, r in trunk + limbs]
        return np.stack(rows, 1)

    def _place(self):
        """Pelvis, chest and their axes; the chest turns against the pelvis and leans with speed and into a seat."""
        motion, t, h, unit = self.person.motion, self.t, self.h, self.unit
        self.sit = motion.sitting(t)
        self.talk = self._talking()
        heading = motion.heading(t)
        self.hip_half = 0.085 * unit
        sole, self.foot_heading, self.foot_swing, self.foot_ahead = motion.feet(t, 0.075 * unit)
        ahead = np.clip(0.5 * (self.foot_ahead[:, 0] - self.foot_ahead[:, 1]), -1, 1)  # right foot before left
        self.stride = ahead
        moving = np.clip(motion.speed(t) / 0.6, 0, 1)
        idle = (1 - moving) * 0.006 * np.sin(0.9 * t + 2.1 * self.person.object_id)
        up = np.array([0.0, 0.0, 1.0])
        forward, left = _horizontal(heading), _horizontal(heading + np.pi / 2)
        ground = np.concatenate([motion.position(t), np.zeros((len(t), 1))], -1)
        # Feet go forward of a chair's seat, hips to the middle of it.
        sole = sole + (0.36 * unit * self.sit)[:, None, None] * forward[:, None]
        stance = np.sum((1 - self.foot_swing) * np.array([-1.0, 1.0]), 1)
        sway = 0.018 * unit * np.clip(stance, -1, 1) * moving + idle
        self.ankle_height = 0.075 * unit
        leg = 0.49 * h
        # The hips sink as far as the foot on the floor demands; a trailing foot gains by lifting its heel.
        reach = np.abs(self.foot_ahead).max(1) * self._step_length(sole, ground)
        drop = leg - np.sqrt(np.maximum(leg**2 - np.minimum(0.8 * reach, 0.6 * leg) ** 2, 0))
        standing = self.ankle_height + 0.985 * leg - np.minimum(drop, 0.18 * leg)
        hip_height = (1 - self.sit) * standing + self.sit * 0.53 * unit**0.5
        bow = np.sin(np.pi * self.sit) * 0.5 + 0.10 * self.sit + np.deg2rad(2.5) + 0.03 * np.minimum(motion.speed(t), 4)
        self.pelvis = ground + sway[:, None] * left + hip_height[:, None] * up
        self.pelvis = self.pelvis - (0.02 * unit * np.sin(np.pi * self.sit))[:, None] * forward
        twist = 0.13 * ahead * moving
        pelvis_heading, chest_heading = heading + twist, heading - 0.9 * twist
        self.pf, self.pl = _horizontal(pelvis_heading), _horizontal(pelvis_heading + np.pi / 2)
        cf, self.cl = _horizontal(chest_heading), _horizontal(chest_heading + np.pi / 2)
        cos, sin = np.cos(bow)[:, None], np.sin(bow)[:, None]
        self.cf, self.cu = cf * cos - up * sin, up * cos + cf * sin
        self.sole = sole
        waist = self.pelvis + 0.16 * unit * (0.6 * self.cu + 0.4 * up)
        self.chest = waist + 0.16 * unit * self.cu
        self.neck = self.chest + 0.165 * unit * self.cu - 0.01 * unit * self.cf
        g, w = self.look.girth, self.look.shoulders
        shirt = {"group": "shirt", "material": self.look.cloth, "colour": self.look.shirt, "front": self.cf}
        hips = {"group": "legs", "material": self.look.legwear, "colour": self.look.trousers, "front": self.pf}
        side = self.hip_half * self.pl
        self._add(self.pelvis + side, self.pelvis - side, 0.094 * unit * g, 0.094 * unit * g, self.pf, 0.9, **hips)
        self._add(self.pelvis + 0.03 * up, waist, 0.142 * unit * g, 0.136 * unit * g, self.cf, 0.74, **shirt)
        self._add(waist, self.chest, 0.136 * unit * g, 0.158 * unit * w, self.cf, 0.70, **shirt)
        self._add(
            self.chest, self.chest + 0.07 * unit * self.cu, 0.158 * unit * w, 0.125 * unit * w, self.cf, 0.68, **shirt
        )
        self.shoulder = np.stack(
            [self.neck + s * 0.168 * unit * w * self.cl - 0.045 * unit * self.cu for s in (-1.0, 1.0)], 1
        )
        for s in (0, 1):
            inner = self.neck + (2 * s - 1) * 0.05 * unit * self.cl - 0.015 * unit * self.cu
            self._add(inner, self.shoulder[:, s], 0.05 * unit, 0.056 * unit * w, self.cf, 0.9, **shirt)

    def _step_length(self, sole, ground):
        apart = np.linalg.norm((sole - ground[:, None])[..., :2], axis=-1).max(1)
        return apart / np.maximum(np.abs(self.foot_ahead).max(1), 1e-6)

    def _talking(self):
        """How much the person is taken by talking, 0..1, faded over 0.4 s at each end of a turn."""
        amount = np.zeros_like(self.t)
        for begin, end in self.person.speech.reshape(-1, 2):
            amount = np.maximum(amount, np.clip(np.minimum(self.t - begin, end - self.t) / 0.4 + 0.5, 0, 1))
        return amount * amount * (3 - 2 * amount)

    def _legs(self):
        unit, h, look = self.unit, self.h, self.look
        cloth = {"group": "legs", "material": look.legwear, "colour": look.trousers}
        up = np.array([0.0, 0.0, 1.0])
        self.hip, self.knee, self.ankle, self.toe = np.empty((4, len(self.t), 2, 3))
        for s, sign in enumerate((-1.0, 1.0)):
            forward = _horizontal(self.foot_heading[:, s] + sign * 0.12)
            rel, swing = self.foot_ahead[:, s], self.foot_swing[:, s]
            # Positive pitch lifts the heel: at push-off and early in the swing; toes rise for the heel's landing.
            pitch = 0.75 * np.clip(-rel - 0.25, 0, 0.8) - 0.35 * np.clip(rel - 0.25, 0, 0.6)
            pitch = pitch + 0.35 * np.sin(np.pi * np.clip(2 * swing, 0, 1)) * (swing > 0)
            cos, sin = np.cos(pitch)[:, None], np.sin(pitch)[:, None]
            along, rise = forward * cos - up * sin, up * cos + forward * sin
            length = 0.152 * h
            ball = self.sole[:, s] + 0.30 * length * forward + 0.03 * unit * up
            heel_side = pitch < 0
            heel = self.sole[:, s] - 0.30 * length * forward + 0.035 * unit * up
            # The foot pivots on its ball while the heel is up, on its heel while the toes are up.
            ankle = np.where(
                heel_side[:, None],
                heel + 0.09 * length * along + (self.ankle_height - 0.035 * unit) * rise,
                ball - 0.53 * length * along + (self.ankle_height - 0.03 * unit) * rise,
            )
            hip = self.pelvis + sign * self.hip_half * self.pl
            pole = self.pf + 0.08 * sign * self.pl
            knee, ankle = _two_links(hip, ankle, 0.245 * h, 0.246 * h, pole)
            self.hip[:, s], self.knee[:, s], self.ankle[:, s] = hip, knee, ankle
            heel = ankle - 0.09 * length * along - (self.ankle_height - 0.035 * unit) * rise
            toe = ankle + 0.62 * length * along - (self.ankle_height - 0.027 * unit) * rise
            self.toe[:, s] = toe
            g = look.girth
            self._add(hip, knee, 0.088 * unit * g, 0.057 * unit, front=self.pf, **cloth)
            middle = knee + 0.3 * (ankle - knee) - 0.012 * unit * forward
            shin = dict(front=forward, beyond=look.skin, split=look.legs - 1.0, **cloth)
            self._add(knee, middle, 0.056 * unit, 0.056 * unit, **{**shin, "split": 2.0})
            self._add(middle, ankle, 0.055 * unit, 0.043 * unit, **shin)
            shoe = {"group": f"shoe{s}", "material": LEATHER, "colour": look.shoes, "front": forward}
            ball = toe - 0.2 * length * along
            self._add(heel, ball, 0.035 * unit, 0.039 * unit, rise, 0.82, **shoe)
            self._add(ball, toe, 0.039 * unit, 0.032 * unit, rise, 0.74, **shoe)
            self._add(ankle - 0.02 * unit * rise, heel + 0.02 * rise, 0.041 * unit, 0.036 * unit, **shoe)

    def _arms(self):
        unit, h, look, t = self.unit, self.h, self.look, self.t
        upper, lower = 0.172 * h, 0.150 * h
        self.elbow, self.wrist = np.empty((2, len(t), 2, 3))
        seed = 1.7 * self.person.object_id
        speed = np.clip(self.person.motion.speed(t), 0, 3)
        for s, sign in enumerate((-1.0, 1.0)):
            shoulder = self.shoulder[:, s]
            # Arms swing against the leg of their side; faster walks swing and bend them more.
            swing = -0.42 * sign * -self.stride * np.minimum(speed, 1.5) ** 0.5 + 0.05
            bend = 0.28 + 0.12 * speed + 0.25 * np.maximum(swing, 0)
            ahead = upper * np.sin(swing) + lower * np.sin(swing + bend)
            down = upper * np.cos(swing) + lower * np.cos(swing + bend)
            hanging = shoulder + ahead[:, None] * self.cf - down[:, None] * self.cu + 0.045 * unit * sign * self.cl
            lap = self.knee[:, s] - 0.12 * unit * self.pf + 0.085 * unit * np.array([0, 0, 1.0]) - 0.03 * sign * self.pl
            target = hanging + self.sit[:, None] * (lap - hanging)
            if self.person.gestures:
                beat = seed + t * 2 * np.pi * 0.75
                raise_ = self.talk * (0.75 + 0.25 * np.sin(0.61 * beat + sign)) * (1.0 if s == 0 else 0.7)
                hand = (
                    shoulder
                    + (0.27 + 0.05 * np.sin(1.3 * beat + sign))[:, None] * unit * self.cf
                    - (0.22 - 0.09 * np.sin(beat + 0.9 * sign))[:, None] * unit * self.cu
                    - (0.05 + 0.07 * np.sin(0.83 * beat - sign))[:, None] * unit * sign * self.cl
                )
                target = target + raise_[:, None] * (hand - target)
            pole = -0.8 * self.cf + 0.55 * sign * self.cl - 0.35 * self.cu
            elbow, wrist = _two_links(shoulder, target, upper, lower, pole)
            self.elbow[:, s], self.wrist[:, s] = elbow, wrist
            sleeve = {
                "group": "shirt",
                "material": look.cloth,
                "colour": look.shirt,
                "beyond": look.skin,
                "front": self.cf,
            }
            self._add(shoulder, elbow, 0.057 * unit * look.shoulders, 0.044 * unit, split=look.sleeve, **sleeve)
            middle = elbow + 0.35 * (wrist - elbow)
            bare = look.sleeve <= 1.0
            sleeve["material"] = SKIN if bare else look.cloth
            sleeve["group"] = f"arm{s}" if bare else "shirt"
            if bare:
                sleeve["colour"] = look.skin
            self._add(elbow, middle, 0.042 * unit, 0.041 * unit, split=2.0, **sleeve)
            self._add(middle, wrist, 0.041 * unit, 0.029 * unit, split=(look.sleeve - 1.35) / 0.65, **sleeve)
            self._hand(s, sign, elbow, wrist)

    def _hand(self, s, sign, elbow, wrist):
        unit = self.unit
        along = _unit(wrist - elbow)
        inward = -sign * self.cl
        palm = _unit(inward - along * np.sum(inward * along, -1, keepdims=True))
        across = np.cross(along, palm) * sign
        skin = {"group": f"hand{s}", "material": SKIN, "colour": self.look.skin, "front": palm}
        knuckles = wrist + 0.075 * unit * along
        self._add(wrist, knuckles, 0.028 * unit, 0.036 * unit, palm, 0.5, **skin)
        curl = _unit(along + 0.45 * palm)
        for index in range(4):
            base = knuckles + (0.026 - 0.0175 * index) * unit * across
            length = (0.070, 0.078, 0.072, 0.058)[index] * unit
            bent = base + 0.5 * length * _unit(along + 0.2 * palm)
            self._add(base, bent, 0.0105 * unit, 0.0095 * unit, **skin)
            self._add(bent, bent + 0.5 * length * curl, 0.0095 * unit, 0.0075 * unit, **skin)
        thumb = wrist + 0.025 * unit * along + 0.024 * unit * across
        tip = thumb + 0.055 * unit * _unit(along + 0.55 * across + 0.5 * palm)
        self._add(thumb, tip, 0.014 * unit, 0.010 * unit, **skin)

    def _head(self):
        unit, look, t = self.unit, self.look, self.t
        nod = 0.06 + self.talk * 0.07 * np.sin(2 * np.pi * 0.9 * t + self.person.object_id)
        turn = self.talk * 0.18 * np.sin(2 * np.pi * 0.23 * t + 2 * self.person.object_id)
        heading = self.person.motion.heading(t) + turn
        up = np.array([0.0, 0.0, 1.0])
        level, left = _horizontal(heading), _horizontal(heading + np.pi / 2)
        f = level * np.cos(nod)[:, None] - up * np.sin(nod)[:, None]
        u = up * np.cos(nod)[:, None] + level * np.sin(nod)[:, None]
        base = self.neck + 0.055 * unit * _unit(self.cu + u)
        centre = base + 0.098 * unit * u + 0.018 * unit * f
        size = unit

        def at(forward, side, rise):
            return centre + size * (forward * f + side * left + rise * u)

        skin = {"material": SKIN, "colour": look.skin, "front": f}
        self._add(self.neck - 0.02 * unit * self.cu, base, 0.058 * unit, 0.053 * unit, group="head", **skin)
        skull = (at(-0.022, 0, 0.022), at(0.022, 0, 0.018))
        self.skull = len(self.parts)
        self._add(*skull, 0.083 * size, 0.079 * size, left, 0.90, group="head", **skin)
        self._add(at(0.03, 0, 0.0), at(0.052, 0, -0.083), 0.066 * size, 0.034 * size, left, 0.95, group="head", **skin)
        self._add(at(0.02, 0, -0.045), at(0.045, 0, -0.085), 0.058 * size, 0.036 * size, group="head", **skin)
        self._add(at(0.098, 0, 0.012), at(0.113, 0, -0.028), 0.008 * size, 0.0145 * size, group="head", **skin)
        self._face(at, f, u, left, size)
        self._hair(at, f, u, left, size)
        self.mouth = at(0.105, 0, -0.058)
        face = {"nose": (0.125, 0, -0.022)}
        for side, sign in (("left", 1), ("right", -1)):
            face |= {f"{side}_eye": (0.092, sign * 0.033, 0.01), f"{side}_ear": (0.0, sign * 0.08, -0.005)}
        points = {name: at(*place) for name, place in face.items()}
        for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
            joint = getattr(self, name)
            points[f"right_{name}"], points[f"left_{name}"] = joint[:, 0], joint[:, 1]
        self.keypoints = np.stack([points[name] for name in KEYPOINTS], 1)

    def _face(self, at, f, u, left, size):
        look = self.look
        skin = {"material": SKIN, "colour": look.skin, "front": f}
        white = {"material": EYES, "colour": (0.93, 0.92, 0.9), "front": f}
        bald = look.cut in ("bald", "scarf")
        brow = {"material": HAIR, "colour": _rgb("5a4636") if bald else look.hair, "front": f}
        red = tuple(0.78 * c + d for c, d in zip(look.skin, (0.08, -0.01, 0.0), strict=True))

        def line(start, end, ra, rb, axis, flat, **kind):
            self._add(at(*start), at(*end), ra * size, rb * size, axis, flat, **kind)

        for s in (-1, 1):
            line((-0.002, s * 0.077, 0.006), (0, s * 0.074, -0.03), 0.021, 0.013, left, 0.5, group=f"ear{s}", **skin)
            line((0.079, s * 0.033, 0.01), (0.079, s * 0.033, 0.01), 0.0135, 0.0135, u, 1, group=f"eye{s}", **white)
            inner, outer = (0.0955, s * 0.017, 0.036), (0.0840, s * 0.047, 0.035)
            line(inner, outer, 0.0058, 0.0045, u, 0.7, group=f"brow{s}", **brow)
        corner = (0.0985, 0.021, -0.058), (0.0985, -0.021, -0.058)
        line(*corner, 0.0085, 0.0085, u, 0.7, group="lips", material=SKIN, colour=red, front=f)

    def _hair(self, at, f, u, left, size):
        look = self.look
        hair = {"group": "hair", "material": HAIR, "colour": look.hair, "front": f}
        cut = look.cut

        def strand(a, b, ra, rb, flat=1.0):
            self._add(at(*a), at(*b), ra * size, rb * size, left, flat, **hair)

        if cut == "bald":
            return
        if cut == "scarf":
            hair["material"] = KNIT
            strand((-0.026, 0, 0.026), (0.012, 0, 0.030), 0.092, 0.085, 0.92)
            strand((-0.02, 0, -0.01), (-0.015, 0, -0.09), 0.092, 0.085, 0.95)
            strand((0.0, 0, -0.115), (-0.01, 0, -0.15), 0.082, 0.115, 1.0)
            return
        thick = {"cropped": 0.004, "receding": 0.004, "curly": 0.024}.get(cut, 0.010)
        if cut == "receding":
            strand((-0.034, 0, 0.006), (-0.022, 0, 0.012), 0.083, 0.080, 0.95)
            return
        strand((-0.028, 0, 0.028), (0.012, 0, 0.036), 0.083 + thick, 0.073 + thick, 0.92)
        strand((-0.034, 0, 0.005), (-0.030, 0, -0.035), 0.076 + thick, 0.062 + thick, 0.93)
        if cut in ("short", "beard", "ponytail", "long", "bun"):
            strand((0.045, 0.035, 0.066), (0.052, -0.035, 0.066), 0.030, 0.030, 1.0)
        if cut == "beard":
            strand((0.062, 0.032, -0.075), (0.062, -0.032, -0.075), 0.030, 0.030, 1.0)
            strand((0.066, 0.0, -0.085), (0.070, 0, -0.105), 0.034, 0.022, 1.0)
        if cut == "long":
            strand((-0.045, 0, -0.02), (-0.060, 0, -0.14), 0.078, 0.072, 1.0)
            strand((-0.060, 0, -0.14), (-0.070, 0, -0.22), 0.072, 0.045, 1.0)
            for side in (-1, 1):
                strand((0.015, side * 0.058, 0.02), (-0.02, side * 0.066, -0.10), 0.032, 0.030, 1.0)
        if cut == "bun":
            strand((-0.105, 0, 0.06), (-0.118, 0, 0.066), 0.040, 0.036, 1.0)
        if cut == "ponytail":
            strand((-0.10, 0, 0.045), (-0.125, 0, 0.03), 0.022, 0.026, 1.0)
            strand((-0.125, 0, 0.03), (-0.125, 0, -0.15), 0.030, 0.014, 1.0)
        if cut == "curly":
            for k in range(9):
                angle = 2 * np.pi * k / 9
                strand(
                    (-0.02 + 0.062 * np.cos(angle), 0.055 * np.sin(angle), 0.060),
                    (-0.03 + 0.080 * np.cos(angle), 0.070 * np.sin(angle), 0.030 if np.cos(angle) > 0.3 else -0.01),
                    0.040, 0.036,
                )  # fmt: skip

    def _add(self, a, b, ra, rb, flat_axis=None, flat=1.0, *, group, material, colour, front, beyond=None, split=2.0):
        axis = np.array([0.0, 0.0, 1.0]) if flat_axis is None else flat_axis
        second = self.look.second or colour
        self.parts.append(
            _Part(a, b, ra, rb, axis, flat, front, group, material, colour, beyond or colour, second, split)
        )


def _touching(parts):
    """For each cone the (at most 4) cones of its group that touch it most, by the gap between their balls."""
    f = np.linspace(0, 1, 4)[:, None]
    balls = np.stack([part.a[0] * (1 - f) + part.b[0] * f for part in parts])
    radii = np.stack([part.ra * (1 - f[:, 0]) + part.rb * f[:, 0] for part in parts])
    between = np.linalg.norm(balls[:, None, :, None] - balls[None, :, None], axis=-1)
    gap = (between - radii[:, None, :, None] - radii[None, :, None]).min((2, 3))
    names = np.array([part.group for part in parts])
    gap[(names[:, None] != names) | np.eye(len(parts), dtype=bool) | (gap > 0)] = np.inf
    best = np.argsort(gap, 1, kind="stable")[:, :4]
    best = np.pad(best, ((0, 0), (0, 4 - best.shape[1])), constant_values=-1)
    kept = np.isfinite(np.take_along_axis(gap, np.maximum(best, 0), 1)) & (best >= 0)
    return np.where(kept, best, -1)


def _two_links(root, target, first, second, pole):
    """Bend two links of lengths first and second from root towards target (n, 3), the joint on the side of pole.

    Returns the joint and the end (n, 3); a target out of reach is approached as far as the links go.
    """
    way = target - root
    distance = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-6)
    direction = way / distance
    reach = np.clip(distance, abs(first - second) + 0.02, 0.999 * (first + second))
    along = (first**2 - second**2 + reach**2) / (2 * reach)
    aside = np.sqrt(np.maximum(first**2 - along**2, 0.0))
    bend = _unit(pole - direction * np.sum(pole * direction, -1, keepdims=True))
    return root + along * direction + aside * bend, root + reach * direction


def _horizontal(heading):
    return np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], -1)


def _unit(vector):
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)
