"""The keys of room_config that say what a room is made of: surfaces, windows, doors, lamps, skirting and daylight."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avcli import materials
from avcli.formats import bounds
from avcli.formats.schema import Choice, Either, Invalid, Key, ListOf, Named, Number, Numbers, Object

MATERIAL = Named("a material", tuple(materials.table()))
"""The name of a material, of a room or of furniture."""
COLOR = Numbers(3, Number(least=0, most=1))

_WALL = Choice(materials.FACES[:4])
_PAINTED = Object(
    {
        "material": Key(MATERIAL, "its material", required=True),
        "color": Key(COLOR, "its colour, sRGB fractions; default: that of the material"),
    },
    closed=True,
)
_SURFACE = Either((MATERIAL, _PAINTED))
_SURFACES = Object(
    {
        "floor": Key(_SURFACE, "floor"),
        "ceiling": Key(_SURFACE, "ceiling"),
        "walls": Key(_SURFACE, "the walls that have no entry of their own"),
        **{face: Key(_SURFACE, f"the wall {face[0]} = {'0' if face[1] == '0' else 'its largest'}")
           for face in materials.FACES[:4]},
    },
    closed=True,
)  # fmt: skip
_PLACE_ON_WALL = {
    "wall": Key(_WALL, "wall that it is in", required=True),
    "at_m": Key(bounds.COORDINATE, "its middle along the wall, m: y in x0 and x1, x in y0 and y1", required=True),
}
_WINDOW = Object(
    {
        **_PLACE_ON_WALL,
        **{key: Key(bounds.LENGTH if key != "sill_m" else bounds.DISTANCE, text, default=materials.WINDOW[key])
           for key, text in (("width_m", "width, m"), ("height_m", "height, m"),
                             ("sill_m", "height of its lower edge above the floor, m"))},
    },
    closed=True,
)  # fmt: skip
_DOOR = Object(
    {
        **_PLACE_ON_WALL,
        "width_m": Key(bounds.LENGTH, "width, m", default=materials.DOOR["width_m"]),
        "height_m": Key(bounds.LENGTH, "height, m", default=materials.DOOR["height_m"]),
        "material": Key(MATERIAL, "its material", default="door"),
        "color": Key(COLOR, "its colour, sRGB fractions; default: that of the material"),
    },
    closed=True,
)
_LAMP = Object(
    {
        "position_m": Key(Numbers(2, bounds.COORDINATE), "[x, y] of its middle, m", required=True),
        "height_m": Key(bounds.LENGTH, "height above the floor, m; default: at the ceiling"),
        "shape": Key(Choice(("panel", "disc")), "a panel is a rectangle", default="panel"),
        "size_m": Key(Numbers(2, bounds.LENGTH), "size along x and y, m; a disc has the first", default=[0.6, 0.6]),
        "strength": Key(Number(0, most=100), "its light; 1 is a lamp of a room without this key", default=1.0),
        "color": Key(COLOR, "colour of its light, sRGB fractions", default=[1.0, 1.0, 1.0]),
    },
    closed=True,
)  # fmt: skip
KEYS = {
    "surfaces": Key(
        _SURFACES,
        "the material of each surface, by name; it sets the look, and the absorption where no number does: neither "
        "absorption nor, without contents_absorption_m2, reverberation_time_s. A surface that is left out is as in a "
        "room without this key: dark curtains, grey vinyl tiles, a white ceiling",
    ),
    "contents_absorption_m2": Key(
        Numbers(7, Number(0, most=1e6)),
        "equivalent absorption area of what stands in the room, furniture and people, in octave bands from 125 Hz to "
        "8 kHz, m²: where the surfaces give the absorption, it absorbs too, and reverberation_time_s is only the mean "
        "from 500 Hz to 2 kHz that follows. avsim-scene writes both where a scenario names surfaces and no number",
    ),
    "windows": Key(ListOf(_WINDOW, most=64), "windows: light falls through them, and they are glass for the sound"),
    "doors": Key(ListOf(_DOOR, most=64), "doors: people may come and go there"),
    "lights": Key(ListOf(_LAMP, most=16), "lamps; default: two discs at the ceiling that the pictures do not show"),
    "skirting_m": Key(Number(0, most=1), "height of a skirting board along the walls, m", default=0.0),
    "daylight": Key(Number(0, most=100), "brightness of the sky behind the windows; 0 is night", default=1.0),
    "sun_deg": Key(
        Numbers(2, bounds.DEGREES),
        "where the sun stands: azimuth, counterclockwise from +x, and elevation; by default it is behind clouds",
    ),
}  # fmt: skip
"""They belong into the description of room_config."""


@dataclass(frozen=True)
class Fittings:
    """What is fitted into a room; every entry is as its description reads it.

    Attributes:
        windows, doors, lights: of the room; lights is None where they are not stated.
        skirting_m: height of the skirting boards, m; 0: none.
        daylight: brightness of the sky, without unit.
        sun_deg: azimuth and elevation of the sun, degrees; None: clouds.
    """

    windows: tuple[Mapping[str, Any], ...] = ()
    doors: tuple[Mapping[str, Any], ...] = ()
    lights: tuple[Mapping[str, Any], ...] | None = None
    skirting_m: float = 0.0
    daylight: float = 1.0
    sun_deg: tuple[float, float] | None = None


def fittings(values: Mapping[str, Any]) -> Fittings:
    """Return what is fitted into a room.

    Args:
        values: of room_config, as its description reads them.

    Raises:
        Invalid: a window, a door or a lamp is not inside the room.
    """
    x, y, z = values["room_dimensions_m"]
    for kind in ("windows", "doors"):
        for index, item in enumerate(values[kind] or ()):
            length, half = (y if item["wall"][0] == "x" else x), item["width_m"] / 2
            if item["at_m"] - half < 0 or item["at_m"] + half > length:
                reason = f"is {item['width_m']:g} m wide at {item['at_m']:g} m; the wall is {length:g} m long"
                raise Invalid(reason, (kind, index))
            if item.get("sill_m", 0.0) + item["height_m"] > z:
                raise Invalid(f"reaches above the ceiling at {z:g} m", (kind, index, "height_m"))
    for index, lamp in enumerate(values["lights"] or ()):
        px, py = lamp["position_m"]
        if not (0 <= px <= x and 0 <= py <= y and (lamp["height_m"] is None or 0 < lamp["height_m"] <= z)):
            raise Invalid(f"is outside the room of [{x:g}, {y:g}, {z:g}] m", ("lights", index))
    lights, sun = values["lights"], values["sun_deg"]
    return Fittings(
        tuple(values["windows"] or ()), tuple(values["doors"] or ()), None if lights is None else tuple(lights),
        values["skirting_m"], values["daylight"], None if sun is None else (sun[0], sun[1]),
    )  # fmt: skip
