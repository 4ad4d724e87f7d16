"""How people look: the key of a scenario that says it, and looks drawn by chance."""

import colorsys
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from avcli.formats.schema import Boolean, Choice, Either, Key, Number, Numbers, Object
from avcli.scene.person import BAGS, CUTS, DENIM, HATS, KNIT, LEATHER, LOOKS, PLAID, STRIPES, Colour, Look

_CLOTHS = {"knit": KNIT, "denim": DENIM, "leather": LEATHER, "stripes": STRIPES, "plaid": PLAID}
_COLOUR = Numbers(3, Number(least=0, most=1))
_LENGTH = Number(least=0, most=2)
_WIDTH = Number(least=0.5, most=2)
_PLAIN = Look((0.5, 0.5, 0.5), (0.2, 0.22, 0.26), (0.8, 0.62, 0.5), (0.2, 0.14, 0.1), (0.12, 0.11, 0.1))

_OWN = Object(
    {
        "shirt": Key(_COLOUR, "colour of the shirt, sRGB fractions, as are all colours", default=list(_PLAIN.shirt)),
        "trousers": Key(_COLOUR, "colour of the trousers", default=list(_PLAIN.trousers)),
        "skin": Key(_COLOUR, "colour of the skin", default=list(_PLAIN.skin)),
        "hair": Key(_COLOUR, "colour of the hair", default=list(_PLAIN.hair)),
        "shoes": Key(_COLOUR, "colour of the shoes", default=list(_PLAIN.shoes)),
        "cut": Key(Choice(CUTS), "cut of the hair", default="short"),
        "cloth": Key(Choice(tuple(_CLOTHS)), "cloth of the shirt", default="knit"),
        "legwear": Key(Choice(tuple(_CLOTHS)), "cloth of the trousers", default="denim"),
        "sleeve": Key(_LENGTH, "how far sleeves cover the arm: 1 to the elbow, 2 all of it", default=2.0),
        "legs": Key(_LENGTH, "how far trousers cover the leg: 1 to the knee, 2 all of it", default=2.0),
        "girth": Key(_WIDTH, "width of the belly over that of the average body", default=1.0),
        "shoulders": Key(_WIDTH, "width of the shoulders over that of the average body", default=1.0),
        "second": Key(_COLOUR, "second colour of a pattern; default: none"),
        "folds": Key(Boolean(), "whether cloth hangs in folds, and the shirt over the trousers", default=True),
        "jacket": Key(_COLOUR, "colour of an open jacket; default: none"),
        "skirt": Key(_COLOUR, "colour of a skirt; default: none"),
        "collar": Key(_COLOUR, "colour of a collar; default: none"),
        "hem": Key(_LENGTH, "where jacket and skirt end: 1 at the knee, 2 at the ankle", default=0.4),
        "hat": Key(Choice(HATS), "a hat; default: none"),
        "hat_colour": Key(_COLOUR, "colour of the hat", default=list(_PLAIN.hat_colour)),
        "bag": Key(Choice(BAGS), "a bag that is worn; default: none"),
        "bag_colour": Key(_COLOUR, "colour of the bag", default=list(_PLAIN.bag_colour)),
    },
    closed=True,
)
LOOK = Either((Choice(tuple(LOOKS)), _OWN))
"""What "look" of a person may be: the name of a built-in look, or an object that describes one."""


def look_of(value: str | Mapping[str, Any]) -> Look:
    """Make the look of a value as `LOOK` reads it."""
    if isinstance(value, str):
        return LOOKS[value]
    known = {field.name for field in fields(Look)}
    made: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in value.items() if key in known}
    made |= {key: _CLOTHS[value[key]] for key in ("cloth", "legwear")}
    return Look(**made)


def random_look(generator: np.random.Generator, height: float) -> dict[str, Any]:
    """Draw clothes, hair and build: mostly dull and dark colours, as people in rooms wear them.

    Args:
        generator: of all chance.
        height: of the person, m; children wear no jackets of grown people, and no beards.

    Returns:
        A look as `LOOK` describes it.
    """
    g, child = generator, height < 1.45
    feminine = bool(g.random() < 0.5)
    cuts = ["long", "bob", "bun", "ponytail", "curly", "short", "afro", "scarf"] if feminine else [
        "short", "cropped", "receding", "beard", "bald", "curly", "afro", "long"
    ]  # fmt: skip
    odds = (
        [0.28, 0.18, 0.12, 0.18, 0.08, 0.06, 0.04, 0.06] if feminine else [0.36, 0.2, 0.1, 0.12, 0.08, 0.06, 0.04, 0.04]
    )
    cut = str(g.choice(cuts, p=odds))
    if child and cut in ("receding", "beard", "bald"):
        cut = "short"
    tone, warm = g.uniform(0.0, 1.0), g.uniform(-0.02, 0.02, 3)
    skin = np.array([0.93, 0.75, 0.64]) * (1 - tone) + np.array([0.29, 0.18, 0.13]) * tone
    cloth = str(g.choice(["knit", "stripes", "plaid", "denim"], p=[0.7, 0.12, 0.12, 0.06]))
    look: dict[str, Any] = {
        "shirt": _clothes(g, 0.5), "trousers": _clothes(g, 0.22, blue=0.35), "skin": _colour(skin + warm),
        "hair": _hair(g, grey=not child and g.random() < 0.18), "shoes": _shoes(g), "cut": cut, "cloth": cloth,
        "legwear": str(g.choice(["denim", "knit"])),
        "sleeve": round(float(g.choice([0.6, 0.8, 1.5, 2.0], p=[0.2, 0.2, 0.15, 0.45])), 2),
        "legs": round(float(g.choice([1.0, 1.5, 2.0], p=[0.08, 0.05, 0.87])), 2),
        "girth": round(float(np.clip(g.normal(1.04, 0.10), 0.85, 1.4)), 3),
        "shoulders": round(float(np.clip(g.normal(0.94 if feminine else 1.03, 0.05), 0.82, 1.2)), 3),
        "folds": True,
    }  # fmt: skip
    if cloth in ("stripes", "plaid"):
        look["second"] = _clothes(g, 0.5)
    if not child and g.random() < 0.38:
        look |= {"jacket": _clothes(g, 0.22), "hem": round(float(g.choice([0.25, 0.4, 0.9], p=[0.5, 0.35, 0.15])), 2)}
    if g.random() < 0.4:
        light = g.uniform(0.75, 0.95)
        look["collar"] = _colour(np.full(3, light)) if "jacket" in look else look["shirt"]
    if feminine and g.random() < 0.22:
        look |= {"skirt": look["trousers"], "hem": round(float(g.choice([0.8, 1.0, 1.7])), 2), "legs": 0.0}
    if cut not in ("scarf", "afro") and g.random() < 0.14:
        look |= {"hat": str(g.choice(["cap", "beanie", "brim"], p=[0.5, 0.3, 0.2])), "hat_colour": _clothes(g, 0.4)}
    if g.random() < 0.12:
        look |= {"bag": str(g.choice(list(BAGS))), "bag_colour": _clothes(g, 0.3)}
    return look


def _clothes(g: np.random.Generator, light: float, blue: float = 0.0) -> list[float]:
    """A colour of cloth: black, grey, white or navy, else dull, and now and then bright; `light` is the usual value."""
    kind = g.random()
    if g.random() < blue:
        hue, saturation, value = g.uniform(0.58, 0.66), g.uniform(0.2, 0.6), g.uniform(0.15, 0.5)
    elif kind < 0.42:
        hue, saturation = g.uniform(0, 1), g.uniform(0.0, 0.08)
        value = g.choice([g.uniform(0.05, 0.2), g.uniform(0.3, 0.6), g.uniform(0.75, 0.95)], p=[0.5, 0.25, 0.25])
    elif kind < 0.88:
        hue, saturation, value = g.uniform(0, 1), g.uniform(0.1, 0.5), light * g.uniform(0.4, 1.6)
    else:
        hue, saturation, value = g.uniform(0, 1), g.uniform(0.4, 0.68), g.uniform(0.25, 0.7)
    return _colour(np.array(colorsys.hsv_to_rgb(float(hue), float(saturation), float(np.clip(value, 0.03, 0.95)))))


def _shoes(g: np.random.Generator) -> list[float]:
    bases = np.array([[0.08, 0.07, 0.07], [0.24, 0.16, 0.1], [0.8, 0.79, 0.77], [0.2, 0.24, 0.32]])
    return _colour(bases[g.choice(4, p=[0.5, 0.22, 0.18, 0.1])] * g.uniform(0.6, 1.15))


def _hair(g: np.random.Generator, *, grey: bool) -> list[float]:
    if grey:
        return _colour(np.full(3, g.uniform(0.45, 0.85)))
    bases = np.array(
        [[0.06, 0.05, 0.045], [0.17, 0.11, 0.07], [0.32, 0.2, 0.11], [0.62, 0.47, 0.27], [0.45, 0.2, 0.09]]
    )
    base = bases[g.choice(5, p=[0.38, 0.28, 0.18, 0.12, 0.04])]
    return _colour(base * g.uniform(0.8, 1.2))


def _colour(colour: np.ndarray | Colour) -> list[float]:
    return [round(float(v), 3) for v in np.clip(colour, 0.0, 1.0)]
