"""Settings of a stage: dataclass fields that say their unit, their range and what they mean.

A stage declares each setting once. The command line takes the option, its default, its range and its help from here.
This module imports the standard library alone, so that `--help` can read the settings of a stage without numpy.
"""

import dataclasses
import math
from typing import Any

DEFAULT_RT60_S = 0.35
"""s, the reverberation time of a room whose config.json states none: an office by DIN 18041, as in the thesis."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is known of one field besides its type and default.

    Attributes:
        text: one sentence for --help.
        unit: metavar on the command line: "S", "HZ", "M", "DB", "N", "P"…; empty for a flag or a choice.
        least, above, most, below: bounds; `above` and `below` are exclusive. None: no bound.
        choices: the permitted values.
        flag: the option's name where it is not the field's ("--band" for band_hz); "--x/--no-x" for a switch.
        default_text: what --help says of the default where the value itself would say nothing.
        only: the method or mode that the setting belongs to; empty: all of them.
    """

    text: str
    unit: str = ""
    least: float | None = None
    above: float | None = None
    most: float | None = None
    below: float | None = None
    choices: tuple[str | int, ...] = ()
    flag: str = ""
    default_text: str = ""
    only: str = ""


def setting(default: Any, text: str, **known: Any) -> Any:
    """Declare a dataclass field with a default, the sentence for --help, and what else `Setting` knows."""
    return dataclasses.field(default=default, metadata={"setting": Setting(text, **known)})


def settings_of(kind: type) -> dict[str, tuple[dataclasses.Field, Setting]]:
    """Return the declared settings of a dataclass by the names of their fields, in the order of declaration."""
    return {
        field.name: (field, field.metadata["setting"])
        for field in dataclasses.fields(kind)
        if "setting" in field.metadata
    }


def check(settings: Any) -> None:
    """Check the values of a settings object against the declared bounds and choices; None is always permitted.

    Call it in `__post_init__`, so that a Python program is refused what the command line refuses.

    Raises:
        ValueError: a value is out of its bounds, not finite, or not one of the choices.
    """
    for name, (_, known) in settings_of(type(settings)).items():
        value = getattr(settings, name)
        if value is None:
            continue
        if known.choices and value not in known.choices:
            raise ValueError(f"{name} must be one of {', '.join(map(str, known.choices))}, not {value}")
        for number in value if isinstance(value, tuple) else (value,):
            if not isinstance(number, int | float):
                continue
            for bound, words, holds in (
                (known.least, "at least", lambda x, b: x >= b),
                (known.above, "above", lambda x, b: x > b),
                (known.most, "at most", lambda x, b: x <= b),
                (known.below, "below", lambda x, b: x < b),
            ):
                if bound is not None and not holds(number, bound):
                    raise ValueError(f"{name} must be {words} {bound:g}, not {number:g}")
            if not math.isfinite(number) and number != known.most:
                raise ValueError(f"{name} must be a finite number, not {number:g}")
