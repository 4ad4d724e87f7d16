"""A person of a scene: build, clothes, walk and turns to speak."""

from dataclasses import dataclass

import numpy as np

from avcli.scene.motion import Motion

SKIN, KNIT, DENIM, HAIR, LEATHER, STRIPES, PLAID, EYES = range(8)
"""What a cone is made of: how the renderer paints it."""

FOLDED = 8
"""Added to a material of cloth: it hangs in folds."""

Colour = tuple[float, float, float]
"""sRGB fractions."""

_FADE_S = 0.4  # in which gestures begin and end with a turn to speak
_TURN_S = 0.8  # in which a head turns to somebody
_FARTHEST_TURN, _BEHIND = np.deg2rad(70.0), np.deg2rad(140.0)


def rgb(text: str) -> Colour:
    """The colour of six hexadecimal digits."""
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (0, 2, 4))
    return red, green, blue


@dataclass(frozen=True)
class Look:
    """How a person is dressed and built.

    Attributes:
        shirt, trousers, skin, hair, shoes: colours.
        cut: of the hair: "short", "long", "bald"...
        cloth, legwear: materials of shirt and trousers.
        sleeve, legs: how much of the limb cloth covers: 1 to the elbow or knee, 2 the whole limb.
        girth, shoulders: widths over those of the average body.
        height: m, where the scenario states none.
        second: colour of a pattern; None: no pattern.
        folds: whether cloth hangs in folds, and the shirt over the trousers.
        jacket, skirt, collar: their colours; None: not worn. A jacket is open, its sleeves are long.
        hem: how long jacket and skirt are: 1 to the knee, 2 to the ankle.
        hat: one of HATS, of the colour `hat_colour`; None: bare-headed.
        bag: one of BAGS, of the colour `bag_colour`; None: none.
    """

    shirt: Colour
    trousers: Colour
    skin: Colour
    hair: Colour
    shoes: Colour
    cut: str = "short"
    cloth: int = KNIT
    legwear: int = DENIM
    sleeve: float = 2.0
    legs: float = 2.0
    girth: float = 1.0
    shoulders: float = 1.0
    height: float = 1.75
    second: Colour | None = None
    folds: bool = False
    jacket: Colour | None = None
    skirt: Colour | None = None
    collar: Colour | None = None
    hem: float = 0.4
    hat: str | None = None
    hat_colour: Colour = (0.2, 0.2, 0.22)
    bag: str | None = None
    bag_colour: Colour = (0.15, 0.15, 0.17)


CUTS = (
    "short", "long", "cropped", "bun", "receding", "curly", "beard", "ponytail", "bald", "scarf", "bob", "afro",
)  # fmt: skip
HATS = ("cap", "beanie", "brim", "helmet")
BAGS = ("backpack", "shoulder")


LOOKS: dict[str, Look] = {
    "red": Look(rgb("b3262f"), rgb("27314f"), rgb("e2b091"), rgb("6b431c"), rgb("241c18"), "long", sleeve=1.55,
                girth=0.93, shoulders=0.92, height=1.68),
    "blue": Look(rgb("2f56ad"), rgb("23262c"), rgb("d8a184"), rgb("2b1a12"), rgb("15110f"), "short", sleeve=1.5),
    "olive": Look(rgb("676a3a"), rgb("4a4234"), rgb("8a5a3c"), rgb("14100e"), rgb("5a3d25"), "cropped",
                  height=1.83, shoulders=1.04),
    "white": Look(rgb("dcdad2"), rgb("39424e"), rgb("c98e6b"), rgb("1d1512"), rgb("d8d5cf"), "bun", STRIPES,
                  sleeve=0.75, girth=0.92, shoulders=0.9, height=1.62, second=rgb("3d5a80")),
    "grey": Look(rgb("6f7378"), rgb("1d2026"), rgb("e6bea2"), rgb("8f8a84"), rgb("3a2a1e"), "receding", girth=1.1,
                 height=1.78),
    "green": Look(rgb("2e6b4f"), rgb("7a6a52"), rgb("5c3a28"), rgb("0f0c0b"), rgb("e0ddd8"), "curly", sleeve=0.8,
                  height=1.9, shoulders=1.06),
    "plaid": Look(rgb("8c3b2e"), rgb("2f3b57"), rgb("dfa98a"), rgb("a8632c"), rgb("6b4a2b"), "beard", PLAID,
                  girth=1.06, height=1.86, shoulders=1.05, second=rgb("1f2a33")),
    "mustard": Look(rgb("c9962e"), rgb("5b2f3a"), rgb("a9714f"), rgb("23150f"), rgb("2a1d1a"), "ponytail",
                    girth=0.95, shoulders=0.93, height=1.71, legs=1.6),
    "teal": Look(rgb("1f7d80"), rgb("3b3f45"), rgb("efc7ab"), rgb("c9a36a"), rgb("1c1c1e"), "bald", sleeve=0.85,
                 height=1.74, girth=1.08),
    "violet": Look(rgb("5d4a86"), rgb("20242d"), rgb("b98263"), rgb("4d3f63"), rgb("141316"), "scarf",
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
        carries: one of postures.LOADS; None: nothing.
        wheelchair: whether the person sits in one, and rolls where others walk.
        heeds: motions of others, and their turns to speak (k, 2) s, to whom the head turns while they speak.
    """

    object_id: int
    motion: Motion
    look: Look
    height: float
    speech: np.ndarray
    gestures: bool = True
    carries: str | None = None
    wheelchair: bool = False
    heeds: tuple[tuple[Motion, np.ndarray], ...] = ()


def speaking(person: Person, t: np.ndarray, end: float) -> np.ndarray:
    """Tell whether it is a person's turn to speak.

    Args:
        person: with turns to speak.
        t: (n,) s.
        end: of the scene, s; a turn that lasts until then holds the last frame.

    Returns:
        (n,) bool.
    """
    turns = person.speech.reshape(-1, 2)
    t = np.asarray(t, float)[:, None]
    now: np.ndarray = (t >= turns[:, 0] - 1e-9) & ((t < turns[:, 1] - 1e-9) | (turns[:, 1] >= end - 1e-9))
    return np.any(now, axis=1)


def talking(turns: np.ndarray, t: np.ndarray, fade_s: float = _FADE_S) -> np.ndarray:
    """How far somebody with turns to speak (k, 2) s is in one at times t (n,) s: (n,), 0..1, faded at each end."""
    amount = np.zeros_like(t)
    for begin, end in turns.reshape(-1, 2):
        amount = np.maximum(amount, np.clip(np.minimum(t - begin, end - t) / fade_s + 0.5, 0, 1))
    return amount * amount * (3 - 2 * amount)


def listening(person: Person, t: np.ndarray) -> np.ndarray:
    """By what angle the head is turned to those who speak, (n,) rad counterclockwise, at times t (n,) s.

    A head turns by 70 degrees at most, and does not turn to somebody in the person's back; of several who speak it
    follows their mean.
    """
    turn, listens = np.zeros_like(t), 1 - talking(person.speech, t, _TURN_S)
    if not person.heeds:
        return turn
    place, heading = person.motion.position(t), person.motion.heading(t)
    total = np.full_like(t, 1e-9)
    for motion, turns in person.heeds:
        way = motion.position(t) - place
        aside = (np.arctan2(way[:, 1], way[:, 0]) - heading + np.pi) % (2 * np.pi) - np.pi
        amount = talking(turns, t, _TURN_S) * np.clip((_BEHIND - np.abs(aside)) / 0.3, 0, 1)
        turn += amount * np.clip(aside, -_FARTHEST_TURN, _FARTHEST_TURN)
        total += amount
    return listens * turn / np.maximum(total, 1.0)
