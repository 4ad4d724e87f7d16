"""Command-line options made from a stage's settings, so that default, range and help cannot differ from them."""

from __future__ import annotations

import dataclasses
import importlib
import math
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any

import click

from avcli.settings import Setting, settings_of


def from_settings(
    kind: type,
    *names: str,
    leave_out: tuple[str, ...] = (),
    defaults: Mapping[str, Any] | None = None,
    words: Mapping[str, Mapping[str, Any]] | None = None,
) -> Callable:
    """Add an option for each setting of a stage, in the order of declaration.

    Args:
        kind: a dataclass whose fields were declared by `avcli.settings.setting`.
        names: the fields to take; none: all that are declared.
        leave_out: fields to leave out.
        defaults: field name -> default, where this command's differs from that of the settings.
        words: field name -> parts of its `Setting` that this command says in other words.

    Returns:
        A decorator. The command gets each value by the field's name.
    """
    known = settings_of(kind)
    chosen = [name for name in names or known if name not in leave_out]

    def decorate(function: Callable) -> Callable:
        for name in reversed(chosen):
            field, setting = known[name]
            setting = dataclasses.replace(setting, **(words or {}).get(name, {}))
            function = _option(kind, field, setting, defaults or {})(function)
        return function

    return decorate


def settings_from(kind: type, values: Mapping[str, Any]) -> Any:
    """Make the settings of a stage from a command's values; an option that is None keeps the field's default."""
    names = {field.name for field in dataclasses.fields(kind)}
    return kind(**{name: value for name, value in values.items() if name in names and value is not None})


def refuse_without_effect(names: typing.Iterable[str], why: str) -> None:
    """End with a usage error that names the first of these options that was given: it would have no effect.

    Args:
        names: parameter names of the running command.
        why: the end of the sentence: "with --method 3d-ssl".
    """
    context = click.get_current_context()
    unused = set(names)
    for parameter in context.command.params:
        if parameter.name in unused and was_given(parameter.name):
            raise click.UsageError(f"{max(parameter.opts, key=len)} has no effect {why}", context)


def was_given(name: str) -> bool:
    """Tell whether an option stood on the command line (a default or a preset is not given)."""
    source = click.get_current_context().get_parameter_source(name)
    return source in (click.core.ParameterSource.COMMANDLINE, click.core.ParameterSource.ENVIRONMENT)


def is_default(name: str) -> bool:
    """Tell whether an option has its default value because nobody and no preset said another one."""
    return click.get_current_context().get_parameter_source(name) is click.core.ParameterSource.DEFAULT


class Size(click.ParamType):
    """A width and a height in px, such as 1920x1080, each from `least` to `most`."""

    name = "WxH"

    def __init__(self, least: float | None = None, most: float | None = None):
        self.least, self.most = least or 1, most or math.inf

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> tuple[int, int]:
        """Read "1920x1080"; a pair is taken as it is."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", value)
        if not match or not all(self.least <= int(side) <= self.most for side in match.groups()):
            bounds = f" from {self.least:g} to {self.most:g} px each" if math.isfinite(self.most) else ""
            self.fail(f"expected a width and a height such as 640x384{bounds}, found {value!r}", parameter, context)
        return int(match[1]), int(match[2])


class Parsed(click.ParamType):
    """What a function of a module reads from text; the module is imported only when the option is given."""

    def __init__(self, name: str, module: str, function: str):
        self.name, self.module, self.function = name, module, function

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """Read it; a value that is no text is taken as it is."""
        if not isinstance(value, str):
            return value
        read: Any = importlib.import_module(self.module)
        for part in self.function.split("."):
            read = getattr(read, part)
        try:
            return read(value)
        except ValueError as error:
            self.fail(str(error), parameter, context)


class Numbers(click.ParamType):
    """Finite numbers with commas between them."""

    name = "X,..."

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        """Read "0,0,6"; a tuple is taken as it is."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = (math.nan,)
        if not all(map(math.isfinite, numbers)):
            self.fail(f"expected numbers with commas between them, found {value!r}", parameter, context)
        return numbers


def _option(kind: type, field: dataclasses.Field, setting: Setting, defaults: Mapping[str, Any]) -> Callable:
    default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    default = defaults.get(field.name, default)
    annotation = typing.get_type_hints(kind)[field.name]
    parts = [part for part in typing.get_args(annotation) if part is not type(None)]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        annotation = parts[0]
    flag = setting.flag or "--" + field.name.replace("_", "-")
    text = f"{setting.only}: {setting.text}" if setting.only else setting.text
    words: dict[str, Any] = {"default": default, "help": text}
    switch = "/" in flag  # "--x/--no-x", whose default is worth showing; a flag alone is off
    words["show_default"] = setting.default_text or (default is not None and (annotation is not bool or switch))
    if setting.unit:
        words["metavar"] = setting.unit
    if annotation is bool:
        return click.option(flag, field.name, is_flag=True, **words)
    if setting.choices:
        words["type"] = click.Choice(setting.choices)
    elif setting.unit == Size.name:
        words["type"] = Size(setting.least, setting.most)
    elif typing.get_origin(annotation) is tuple:
        sides = typing.get_args(annotation)
        words["nargs"], words["type"] = len(sides), _range(sides[0], setting)
        words["default"] = default
    else:
        words["type"] = _range(annotation, setting)
    return click.option(flag, field.name, **words)


_Range = click.FloatRange | click.IntRange


def _bounds(kind: _Range) -> str:
    """Say in words which numbers an option takes, also in --help: "above 0 and at most 1000"; nothing if all."""
    ends = kind.min, None if kind.max == math.inf and not kind.max_open else kind.max
    least, most = (None if x is None else str(x) if isinstance(x, int) else f"{x:g}" for x in ends)
    if least and most and not (kind.min_open or kind.max_open):
        return f"from {least} to {most}"
    low = least and f"{'above' if kind.min_open else 'at least'} {least}"
    high = most and f"{'below' if kind.max_open else 'at most'} {most}"
    return " and ".join(filter(None, (low, high)))


class FiniteRange(click.FloatRange):
    """A range of numbers without NaN, and without infinity unless that is its end."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a number, or fail with words that say what is wrong."""
        number = _read(self, float, "a number", value, param, ctx)
        if not math.isfinite(number) and number != self.max:
            self.fail(f"must be a finite number, found {value}", param, ctx)
        return _within(self, number, value, param, ctx)

    _describe_range = _bounds


class WholeRange(click.IntRange):
    """A range of whole numbers."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a whole number, or fail with words that say what is wrong."""
        return _within(self, _read(self, int, "a whole number", value, param, ctx), value, param, ctx)

    _describe_range = _bounds


def _read(kind: _Range, read: type, what: str, value: Any, *where: Any) -> Any:
    try:
        return read(value)
    except ValueError:
        kind.fail(f"must be {what}, found {value!r}", *where)


def _within(kind: _Range, number: float, value: Any, *where: Any) -> float:
    low = kind.min is None or (number > kind.min if kind.min_open else number >= kind.min)
    if not low or not (kind.max is None or (number < kind.max if kind.max_open else number <= kind.max)):
        kind.fail(f"must be {_bounds(kind)}, found {value}", *where)
    return number


def _range(annotation: type, setting: Setting) -> click.ParamType:
    if annotation is str:
        return click.STRING
    low_open, high_open = setting.least is None, setting.most is None
    low, high = setting.above if low_open else setting.least, setting.below if high_open else setting.most
    low_open, high_open = low_open and low is not None, high_open and high is not None
    if annotation is int:
        least, most = None if low is None else int(low), None if high is None else int(high)
        return WholeRange(least, most, min_open=low_open, max_open=high_open)
    return FiniteRange(low, high, min_open=low_open, max_open=high_open)
