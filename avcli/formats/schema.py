"""Descriptions of what JSON may hold: one description gives the reader's check, the JSON Schema and the manual's text.

A format is an `Object` of `Key`s, each with a kind of value:

    >>> point = Object({
    ...     "position_m": Key(Numbers(2), "position on the floor, m", required=True),
    ...     "stay_s": Key(Number(least=0), "time that the person stays, s", default=0.0),
    ... })
    >>> point.read({"position_m": [1, 2]})
    {'position_m': [1.0, 2.0], 'stay_s': 0.0}
    >>> point.read({"position_m": [1]})
    Traceback (most recent call last):
    avcli.formats.schema.Invalid: "position_m" must be a list of two finite numbers, found [1]
    >>> point.keys["stay_s"].kind.schema()
    {'type': 'number', 'minimum': 0}

Every kind has three methods: `read` returns a checked value or raises Invalid, `schema` returns the JSON Schema of the
same values, and `words` ends the sentence "must be …" in an error and describes the value in the manual.
An optional key may be null, which is the same as leaving it out. Nothing changes a description after it is made; the
classes are not frozen all the same, since Python builds frozen ones 2.5 times as slowly, in each command anew.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import hypot, isfinite, nan
from typing import Any, ClassVar, Protocol

import numpy as np
import orjson


class Invalid(ValueError):
    """A value that does not fit its description; `path` leads to it: keys and indices from the outside in."""

    def __init__(self, reason: str, path: tuple[str | int, ...] = ()):
        super().__init__(reason)
        self.reason, self.path = reason, path

    def within(self, *steps: str | int) -> Invalid:
        """Return the same error as seen from outside, where these steps lead to the value."""
        return Invalid(self.reason, (*steps, *self.path))

    def __str__(self) -> str:
        return f'"{written(self.path)}" {self.reason}' if self.path else self.reason


def written(path: tuple[str | int, ...]) -> str:
    """Write a path as people do: people[0].waypoints[2].t_s."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).removeprefix(".")


DEEPEST = 64
"""Lists and objects inside one another in a record, a config.json or a scenario; none needs more than ten."""
_SHOWN = 60
"""Characters of a wrong value that a message shows."""


def shown(value: Any) -> str:
    """Show a wrong value in a message, in at most 60 characters; any value, however large or deep, costs little."""
    beginning = _beginning(value, [_SHOWN])
    try:
        text = orjson.dumps(beginning, option=orjson.OPT_SERIALIZE_NUMPY).decode()
    except TypeError:
        try:
            text = repr(beginning)
        except ValueError:  # Python refuses to write integers of thousands of digits
            text = f"a value of type {type(value).__name__}"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def _beginning(value: Any, left: list[int]) -> Any:
    """Copy as much of a value as its first characters can show; `left` counts down the values that may still follow."""
    left[0] -= 1
    if isinstance(value, str):
        return value[: 2 * _SHOWN]
    if isinstance(value, Mapping):
        return {str(k)[: 2 * _SHOWN]: _beginning(v, left) for k, v in value.items() if left[0] > 0}
    if isinstance(value, list | tuple):
        return [_beginning(item, left) for item in value if left[0] > 0]
    return value


def syntax_error(error: orjson.JSONDecodeError) -> str:
    """Say why a text is no JSON: as the decoder does, or what programs write that take NaN for a number of JSON."""
    word = re.match(r"[A-Za-z]*", error.doc[error.pos :])
    if word and word[0].lower() in ("nan", "inf", "infinity"):
        return f"invalid JSON: {word[0]} is no number of JSON; write null, or leave the key or the object out"
    return f"invalid JSON: {error.msg}"


def refuse_depth(value: Any) -> None:
    """Refuse a decoded JSON value whose lists and objects lie more than DEEPEST deep inside one another.

    Raises:
        Invalid: it is deeper.
    """
    level = [value]
    for _ in range(DEEPEST):
        inner: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                inner += item.values()
            elif isinstance(item, list):
                inner += item
        level = [item for item in inner if isinstance(item, dict | list)]
        if not level:
            return
    raise Invalid(f"has lists or objects more than {DEEPEST} deep inside one another")


class Kind(Protocol):
    """A kind of value."""

    def read(self, value: Any) -> Any:
        """Return the value, checked; raises Invalid."""

    def schema(self) -> dict[str, Any]:
        """Return the JSON Schema of the values that `read` takes."""

    def words(self) -> str:
        """Return the end of the sentence "must be …"."""


def _refuse(kind: Kind, value: Any) -> Invalid:
    return Invalid(f"must be {kind.words()}, found {shown(value)}")


def _count(number: int) -> str:
    words = ("no", "one", "two", "three", "four", "five", "six")
    return words[number] if number < len(words) else str(number)


def _plain(number: float) -> str:
    """Write a bound as people do: 1000000 is 1e6, and 0.001 stays."""
    return re.sub(r"e\+?(-?)0*", r"e\1", f"{number:g}")


_PLAIN = {float, int}


def _is_number(value: Any) -> bool:
    try:
        known = type(value) in _PLAIN or (isinstance(value, int | float) and not isinstance(value, bool))
        return known and isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def _are_within(values: list[Any] | tuple[Any, ...], least: float, most: float) -> bool:
    """Tell whether all are numbers from least to most; NaN is not."""
    for value in values:
        if type(value) not in _PLAIN and not _is_number(value):
            return False
        if not least <= value <= most:
            return False
    return True


# --- single values ----------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Number:
    """A finite number within bounds; `above` is exclusive."""

    least: float | None = None
    above: float | None = None
    most: float | None = None

    def read(self, value: Any) -> float:
        if (
            not _is_number(value)
            or (self.least is not None and value < self.least)
            or (self.above is not None and value <= self.above)
            or (self.most is not None and value > self.most)
        ):
            raise _refuse(self, value)
        return float(value)

    def schema(self) -> dict[str, Any]:
        bounds = {"minimum": self.least, "exclusiveMinimum": self.above, "maximum": self.most}
        return {"type": "number"} | {name: bound for name, bound in bounds.items() if bound is not None}

    def words(self) -> str:
        bounds = self.bounds()
        return f"a number {bounds}" if bounds else "a finite number"

    def bounds(self) -> str:
        """Return the bounds in words: "above 0", "from 0 to 1"; empty where there are none."""
        if self.least is not None and self.most is not None:
            return f"from {_plain(self.least)} to {_plain(self.most)}"
        if self.above is not None:
            most = f" and at most {_plain(self.most)}" if self.most is not None else ""
            return f"above {_plain(self.above)}{most}"
        return f"of at least {_plain(self.least)}" if self.least is not None else ""


@dataclass(eq=False)
class Integer:
    """An integer, at least and at most some number. 2.0 is an integer, as in JSON Schema."""

    least: int | None = None
    most: int | None = None

    def read(self, value: Any) -> int:
        if (
            not _is_number(value)
            or value != int(value)
            or (self.least is not None and value < self.least)
            or (self.most is not None and value > self.most)
        ):
            raise _refuse(self, value)
        return int(value)

    def schema(self) -> dict[str, Any]:
        bounds = {"minimum": self.least, "maximum": self.most}
        return {"type": "integer"} | {name: bound for name, bound in bounds.items() if bound is not None}

    def words(self) -> str:
        if self.least is None or self.least <= -(2**53):  # any that JSON's readers hold exactly
            return "an integer"
        return (
            f"an integer of at least {self.least}"
            if self.most is None or self.most >= 2**53
            else f"an integer from {self.least} to {self.most}"
        )


IDENTITY = Integer(-(2**63), 2**63 - 1)
"""What names a person in numbers: any integer of 64 bits."""


@dataclass(eq=False)
class Identity:
    """What names a person: an integer of 64 bits, or text."""

    def read(self, value: Any) -> int | str:
        if isinstance(value, str) and value:
            return value
        try:
            return IDENTITY.read(value)
        except Invalid:
            raise _refuse(self, value) from None

    def schema(self) -> dict[str, Any]:
        return {"anyOf": [IDENTITY.schema(), Text(filled=True).schema()]}

    def words(self) -> str:
        return "an integer or text"


@dataclass(eq=False)
class Text:
    """Text, which may have to hold at least one character."""

    filled: bool = False

    def read(self, value: Any) -> str:
        if not isinstance(value, str) or (self.filled and not value):
            raise _refuse(self, value)
        return value

    def schema(self) -> dict[str, Any]:
        return {"type": "string"} | ({"minLength": 1} if self.filled else {})

    def words(self) -> str:
        return "text that is not empty" if self.filled else "text"


@dataclass(eq=False)
class Boolean:
    """True or false."""

    def read(self, value: Any) -> bool:
        if not isinstance(value, bool):
            raise _refuse(self, value)
        return value

    def schema(self) -> dict[str, Any]:
        return {"type": "boolean"}

    def words(self) -> str:
        return "true or false"


@dataclass(eq=False)
class Choice:
    """One of several words or numbers, or the single value true."""

    choices: tuple[str | int | bool, ...]

    def read(self, value: Any) -> Any:
        for choice in self.choices:
            if value == choice and isinstance(value, bool) == isinstance(choice, bool):
                return choice
        raise _refuse(self, value)

    def schema(self) -> dict[str, Any]:
        return {"enum": list(self.choices)}

    def words(self) -> str:
        texts = [choice if isinstance(choice, str) else shown(choice) for choice in self.choices]
        return texts[0] if len(texts) == 1 else f"one of {', '.join(texts)}"


@dataclass(eq=False)
class Named:
    """One of many names, such as a material; an error shows the nearest instead of all.

    Attributes:
        what: the names are of, with its article.
        names: all that are known.
    """

    what: str
    names: tuple[str, ...]

    def read(self, value: Any) -> str:
        if isinstance(value, str) and value in self.names:
            return value
        import difflib

        near = difflib.get_close_matches(value, self.names, 1, 0.4) if isinstance(value, str) else []
        hint = f"; the nearest is {near[0]}" if near else f"; known are {', '.join(self.names)}"
        raise Invalid(f"must be {self.words()}, found {shown(value)}{hint}")

    def schema(self) -> dict[str, Any]:
        return {"type": "string", "pattern": f"^({'|'.join(self.names)})$"}  # an enum would fill a page each time

    def words(self) -> str:
        return f"the name of {self.what}"


@dataclass(eq=False)
class Timestamp:
    """A time in seconds: a number, or text that holds one; at most so large, before or after 0."""

    most: float

    pattern: ClassVar[str] = r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*$"

    def read(self, value: Any) -> float:
        if isinstance(value, int | float | str) and not isinstance(value, bool):
            try:
                seconds = float(value)
                if -self.most <= seconds <= self.most and not (isinstance(value, str) and "_" in value):
                    return seconds
            except (ValueError, OverflowError):
                pass
        raise _refuse(self, value)

    def schema(self) -> dict[str, Any]:
        number = Number(-self.most, most=self.most).schema()
        return {"anyOf": [{"type": "string", "pattern": self.pattern}, number]}

    def words(self) -> str:
        return f"a number of seconds from {_plain(-self.most)} to {_plain(self.most)}"


# --- lists ------------------------------------------------------------------------------------------------------------


_ANY_NUMBER = Number()


@dataclass(eq=False)
class Numbers:
    """A list of so many numbers."""

    count: int
    item: Number = _ANY_NUMBER

    def read(self, value: Any) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != self.count:
            raise _refuse(self, value)
        item = self.item
        if item.above is None and item.least is not None and item.most is not None:
            if not _are_within(value, item.least, item.most):
                raise _refuse(self, value)
        else:
            try:
                return [item.read(number) for number in value]
            except Invalid:
                raise _refuse(self, value) from None
        return list(map(float, value))

    def schema(self) -> dict[str, Any]:
        return {"type": "array", "items": self.item.schema(), "minItems": self.count, "maxItems": self.count}

    def words(self) -> str:
        count, bounds = _count(self.count), self.item.bounds()
        return f"a list of {count} numbers {bounds}" if bounds else f"a list of {count} finite numbers"


@dataclass(eq=False)
class Point:
    """A position [x, y, z] or [x, y]; read as three numbers, z NaN where it is not given.

    Attributes:
        most: largest coordinate, before or after 0.
        height_may_be_null: whether [x, y, null] is valid too.
    """

    most: float
    height_may_be_null: bool = False

    def read(self, value: Any) -> list[float]:
        if isinstance(value, list | tuple):
            most = self.most
            if len(value) == 3 and _are_within(value, -most, most):
                return list(map(float, value))
            numbers = value[:2] if self.height_may_be_null and len(value) == 3 and value[2] is None else value
            if len(numbers) == 2 and _are_within(numbers, -most, most):
                return [float(numbers[0]), float(numbers[1]), nan]
        raise _refuse(self, value)

    def schema(self) -> dict[str, Any]:
        number = Number(-self.most, most=self.most).schema()
        if not self.height_may_be_null:
            return {"type": "array", "items": number, "minItems": 2, "maxItems": 3}
        items = [number, number, number | {"type": ["number", "null"]}]
        return {"type": "array", "prefixItems": items, "items": False, "minItems": 2}

    def words(self) -> str:
        bounds = f"from {_plain(-self.most)} to {_plain(self.most)}"
        null = ", the third may be null" if self.height_may_be_null else ""
        return f"a list of two or three numbers {bounds}{null}"


@dataclass(eq=False)
class UnitVector:
    """A direction: two or three numbers, not all 0; read as a vector of length 1, z NaN where it is not given."""

    component: ClassVar[Number] = Number(-1.001, most=1.001)  # as far as somebody else's rounding may go beyond 1

    def read(self, value: Any) -> list[float]:
        if isinstance(value, list | tuple) and len(value) in (2, 3) and _are_within(value, -1.001, 1.001):
            length = hypot(*value)
            if length > 0:
                return [*(number / length for number in value), nan][:3]
        raise _refuse(self, value)

    def schema(self) -> dict[str, Any]:
        some = {"contains": {"not": {"const": 0}}}
        return {"type": "array", "items": self.component.schema(), "minItems": 2, "maxItems": 3, **some}

    def words(self) -> str:
        return f"a list of two or three numbers {self.component.bounds()} that are not all 0"


@dataclass(eq=False)
class Covariance:
    """A symmetric, positive semidefinite matrix, 3 × 3 or 2 × 2, as a list of rows.

    `read` returns nine numbers, row by row; of a 2 × 2 matrix, the third row and column are 0: not observed.

    Attributes:
        most: largest entry, before or after 0.
    """

    most: float

    def read(self, value: Any) -> list[float]:
        if not isinstance(value, list) or len(value) not in (2, 3):
            raise _refuse(self, value)
        for row in value:
            if not isinstance(row, list) or len(row) != len(value) or not _are_within(row, -self.most, self.most):
                raise _refuse(self, value)
        if len(value) == 2:
            (a, b), (d, e) = value
            c = f = g = h = i = 0.0
            definite = a > 0 and a * e > b * b
        else:
            (a, b, c), (d, e, f), (g, h, i) = value
            minor = e * i - f * f
            definite = i > 0 and minor > 0 and a * minor > b * (b * i - c * f) - c * (b * f - c * e)
        if not (definite and b == d and c == g and f == h) and not _semidefinite(value):
            raise Invalid(f"must be symmetric and positive semidefinite, found {shown(value)}")
        b, c, f = (b + d) / 2, (c + g) / 2, (f + h) / 2
        return [float(a), b, c, b, float(e), f, c, f, float(i)]

    def schema(self) -> dict[str, Any]:
        entry = Number(-self.most, most=self.most)
        return {"anyOf": [ListOf(Numbers(size, entry), size, size).schema() for size in (2, 3)]}

    def words(self) -> str:
        return f"a 2 × 2 or 3 × 3 matrix of numbers from {_plain(-self.most)} to {_plain(self.most)}"


def _semidefinite(matrix: list[list[float]]) -> bool:
    """Tell whether a matrix is symmetric and has no eigenvalue below 0, within what rounding may leave."""
    full = np.array(matrix, dtype=float)
    scale = np.abs(full).max()
    return bool(np.abs(full - full.T).max() <= 1e-6 * scale and np.linalg.eigvalsh(full)[0] >= -1e-9 * scale)


@dataclass(eq=False)
class ListOf:
    """A list of values of one kind, at least and at most so many."""

    item: Kind
    least: int = 0
    most: int | None = None

    def read(self, value: Any) -> list[Any]:
        if not isinstance(value, list | tuple) or len(value) < self.least:
            raise _refuse(self, value)
        if self.most is not None and len(value) > self.most:
            raise Invalid(f"must be {self.words()}, found {len(value)}")
        checked = []
        for index, item in enumerate(value):
            try:
                checked.append(self.item.read(item))
            except Invalid as error:
                raise error.within(index) from None
        return checked

    def schema(self) -> dict[str, Any]:
        bounds: dict[str, Any] = {"minItems": self.least} if self.least else {}
        if self.most is not None:
            bounds["maxItems"] = self.most
        return {"type": "array", "items": self.item.schema()} | bounds

    def words(self) -> str:
        if self.least == self.most:
            return f"a list of {self.most}"
        bounds = [f"at least {_count(self.least)}"] if self.least else []
        bounds += [f"at most {self.most}"] if self.most is not None else []
        return f"a list of {' and '.join(bounds)}" if bounds else "a list"


# --- objects ----------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Key:
    """A key of an object.

    Attributes:
        kind: of its value.
        text: what it means and in which unit, for the schema and the manual.
        required: whether it must be there.
        default: what an absent or null value is read as; it must fit the kind, or be None.
        read: False: the key is described but no reader of this package looks at it, so that it is not checked either.
    """

    kind: Kind
    text: str = ""
    required: bool = False
    default: Any = None
    read: bool = True


@dataclass(eq=False)
class Object:
    """A JSON object.

    Attributes:
        keys: what it may hold.
        closed: whether another key is an error; otherwise it is ignored.
        exclusive: keys of which only one may be there.
        needed: groups of keys; at least one group must be there as a whole.
        beside: keys, each with another one that must be there where the key is.
        rules: further JSON Schema that `read` does not need.
    """

    keys: Mapping[str, Key]
    closed: bool = False
    exclusive: tuple[str, ...] = ()
    needed: tuple[tuple[str, ...], ...] = ()
    beside: Mapping[str, str] = field(default_factory=dict)
    rules: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def _read(self) -> list[tuple[str, Any, bool, Any]]:
        keys = ((name, key) for name, key in self.keys.items() if key.read)
        return [(name, key.kind.read, key.required, key.default) for name, key in keys]

    def only(self, *names: str) -> Object:
        """Return the description of these keys alone."""
        return Object({name: self.keys[name] for name in names})

    def read(self, value: Any) -> dict[str, Any]:
        """Return the checked value of each key that readers look at, or its default where it is absent."""
        if type(value) is not dict and not isinstance(value, Mapping):
            raise _refuse(self, value)
        if self.closed:
            for name in value:
                if name not in self.keys:
                    raise Invalid(f"is not a known key; known are {', '.join(self.keys)}", (name,))
        checked = {}
        for name, read, required, default in self._read:
            item = value.get(name)
            if item is not None:
                try:
                    checked[name] = read(item)
                except Invalid as error:
                    raise error.within(name) from None
            elif not required:
                checked[name] = default
            elif name not in value:
                raise Invalid("is missing", (name,))
            elif isinstance(self.keys[name].kind, OrNull):
                checked[name] = None
            else:
                raise Invalid(f"must be {self.keys[name].kind.words()}, found null", (name,))
        if self.exclusive and sum(value.get(name) is not None for name in self.exclusive) > 1:
            raise Invalid(f"has {' and '.join(self.exclusive)}; only one of them is possible")
        if self.needed and not any(all(value.get(name) is not None for name in group) for group in self.needed):
            first, *others = [" with ".join(group) for group in self.needed]
            raise Invalid(f"is missing, and there is no {' or '.join(others)}", (first,))
        for name, other in self.beside.items():
            if value.get(name) is not None and value.get(other) is None:
                raise Invalid(f"is missing beside {name}", (other,))
        return checked

    def schema(self) -> dict[str, Any]:
        schema: dict[str, Any] = {"type": "object"}
        required = [name for name, key in self.keys.items() if key.required]
        if required:
            schema["required"] = required
        if self.closed:
            schema["additionalProperties"] = False
        if self.exclusive:
            unset = {"properties": {name: {"not": {"type": "null"}} for name in self.exclusive}}
            schema["not"] = {"type": "object", "required": list(self.exclusive), **unset}
        some = [[_all_there(*group) for group in self.needed]] if self.needed else []
        some += [[{"properties": {a: {"type": "null"}}}, _all_there(b)] for a, b in self.beside.items()]
        if some:
            schema["allOf"] = [{"anyOf": one} for one in some]
        schema["properties"] = {name: self._property(key) for name, key in self.keys.items()}
        return schema | dict(self.rules)

    @staticmethod
    def _property(key: Key) -> dict[str, Any]:
        schema = key.kind.schema() if key.required else _or_null(key.kind.schema())
        if key.text:
            schema["description"] = key.text
        if key.default is not None:
            schema["default"] = key.default
        return schema

    def words(self) -> str:
        return "a JSON object"


def _all_there(*names: str) -> dict[str, Any]:
    """Return the JSON Schema of an object that has these keys, none of them null."""
    return {"required": list(names), "properties": {name: {"not": {"type": "null"}} for name in names}}


def _or_null(schema: dict[str, Any]) -> dict[str, Any]:
    if "enum" in schema:
        return schema | {"enum": [*schema["enum"], None]}
    if "anyOf" in schema:
        return schema | {"anyOf": [*schema["anyOf"], {"type": "null"}]}
    if "oneOf" in schema:
        return {"anyOf": [schema, {"type": "null"}]}
    return schema | {"type": [schema["type"], "null"]}


@dataclass(eq=False)
class MapOf:
    """A JSON object whose keys are names that the format does not fix, with values of one kind."""

    item: Kind

    def read(self, value: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping):
            raise _refuse(self, value)
        checked = {}
        for name, item in value.items():
            try:
                checked[name] = self.item.read(item)
            except Invalid as error:
                raise error.within(name) from None
        return checked

    def schema(self) -> dict[str, Any]:
        return {"type": "object", "additionalProperties": self.item.schema()}

    def words(self) -> str:
        return "a JSON object"


@dataclass(eq=False)
class Variants:
    """A JSON object whose "kind" decides which keys it has; `read` returns them with the kind."""

    kinds: Mapping[str, Object]

    def read(self, value: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping):
            raise _refuse(self, value)
        if "kind" not in value:
            raise Invalid("is missing", ("kind",))
        try:
            kind = Choice(tuple(self.kinds)).read(value["kind"])
        except Invalid as error:
            raise error.within("kind") from None
        others = {name: item for name, item in value.items() if name != "kind"}
        return {"kind": kind, **self.kinds[kind].read(others)}

    def schema(self) -> dict[str, Any]:
        each = []
        for kind, described in self.kinds.items():
            schema = described.schema()
            schema["required"] = ["kind", *schema.get("required", ())]
            schema["properties"] = {"kind": {"const": kind}, **schema["properties"]}
            each.append(schema)
        return {"type": "object", "oneOf": each}

    def words(self) -> str:
        return "a JSON object"


@dataclass(eq=False)
class Either:
    """A value of any of several kinds; the first that fits reads it."""

    kinds: tuple[Kind, ...]

    def read(self, value: Any) -> Any:
        inner = None
        for kind in self.kinds:
            try:
                return kind.read(value)
            except Invalid as error:
                # Its outside fits, so that what is wrong inside is what to name.
                if error.path or (isinstance(kind, Named) and isinstance(value, str)):
                    inner = error
        raise inner or _refuse(self, value)

    def schema(self) -> dict[str, Any]:
        return {"anyOf": [kind.schema() for kind in self.kinds]}

    def words(self) -> str:
        return " or ".join(kind.words() for kind in self.kinds)


@dataclass(eq=False)
class OrNull:
    """A value that must be there and may be null."""

    kind: Kind

    def read(self, value: Any) -> Any:
        return None if value is None else self.kind.read(value)

    def schema(self) -> dict[str, Any]:
        return _or_null(self.kind.schema())

    def words(self) -> str:
        return f"{self.kind.words()} or null"


@dataclass(eq=False)
class Written:
    """A value that is written and never read, so that its JSON Schema stands here as it is."""

    json_schema: Mapping[str, Any]
    text: str = "a JSON object"

    def read(self, value: Any) -> Any:
        return value

    def schema(self) -> dict[str, Any]:
        return dict(self.json_schema)

    def words(self) -> str:
        return self.text
