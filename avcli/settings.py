"""Settings of a stage: dataclass fields that say their unit, their range and what they mean.

A stage declares each setting once. The command line takes the option, its default, its range and its help from here.
This module imports the standard library alone, so that `--help` can read the settings of a stage without numpy.
"""

import dataclasses
from typing import Any


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
