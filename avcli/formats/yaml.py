"""The part of YAML that camera files use: nested mappings and lists, in blocks or in brackets, and plain values.

No tags have a meaning (OpenCV's `!!opencv-matrix` is skipped), and there are no anchors, merges or several documents.
"""

import re
from typing import Any

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_KEY = re.compile(r"""("[^"]*"|'[^']*'|[^\s\[\]{},#"'&*!|>%@`-][^:#]*?|-[^\s:]+)\s*:(\s+|$)""")
_WORDS: dict[str, Any] = {
    "": None, "~": None, "null": None, "true": True, "false": False, ".inf": float("inf"), "-.inf": float("-inf"),
    ".nan": float("nan"),
}  # fmt: skip
_DEEPEST = 32

_Line = tuple[int, str, int]
"""Indentation, text without it, and the line's number."""


def parse(text: str, name: str = "YAML") -> Any:
    """Read the first document of a YAML text as dicts, lists, numbers, booleans and strings.

    Args:
        text: the file's content.
        name: of the file, for errors.

    Raises:
        ValueError: it is none, or uses what this reader does not know; the message names the line.
    """
    lines = _lines(text)
    if not lines:
        raise ValueError(f"{name}: empty")
    try:
        value, rest = _block(lines, 0, lines[0][0], 0)
    except _Unreadable as error:
        raise ValueError(f"{name}:{error.number}: {error}") from None
    if rest < len(lines):
        raise ValueError(f"{name}:{lines[rest][2]}: {lines[rest][1][:40]!r} does not fit what stands above it")
    return value


class _Unreadable(ValueError):
    def __init__(self, text: str, number: int) -> None:
        super().__init__(text)
        self.number = number


def _lines(text: str) -> list[_Line]:
    lines: list[_Line] = []
    for number, raw in enumerate(text.splitlines(), 1):
        if raw.startswith(("%", "---")):
            if lines:
                break
            raw = raw[3:] if raw.startswith("---") else ""
        if raw.startswith("..."):
            break
        bare = _without_comment(raw).rstrip()
        if bare.strip():
            lines.append((len(bare) - len(bare.lstrip(" ")), bare.strip(), number))
    return lines


def _without_comment(line: str) -> str:
    quote = ""
    for i, c in enumerate(line):
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'" and (i == 0 or line[i - 1] in " [{,:"):
            quote = c
        elif c == "#" and (i == 0 or line[i - 1] in " \t"):
            return line[:i]
    return line


def _block(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[Any, int]:
    """Read what begins at line `at` with that indentation; the value, and the line after it."""
    if depth > _DEEPEST:
        raise _Unreadable("nested too deeply", lines[at][2])
    _, text, number = lines[at]
    if text == "-" or text.startswith("- "):
        return _list(lines, at, indent, depth)
    if _KEY.match(text):
        return _mapping(lines, at, indent, depth)
    return _value(lines, at, text, number, depth)


def _list(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[list[Any], int]:
    items: list[Any] = []
    while at < len(lines) and lines[at][0] == indent and (lines[at][1] == "-" or lines[at][1].startswith("- ")):
        _, text, number = lines[at]
        inner = text[1:].lstrip()
        if inner:
            lines[at] = (indent + len(text) - len(inner), inner, number)
            value, at = _block(lines, at, lines[at][0], depth + 1)
        else:
            value, at = _below(lines, at + 1, indent, depth)
        items.append(value)
    return items, at


def _mapping(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[dict[str, Any], int]:
    found: dict[str, Any] = {}
    while at < len(lines) and lines[at][0] == indent:
        _, text, number = lines[at]
        match = _KEY.match(text)
        if not match:
            break
        key, rest = match[1].strip("\"'"), text[match.end() :]
        rest = re.sub(r"^!\S*\s*", "", rest)  # a tag
        if rest:
            found[key], at = _value(lines, at, rest, number, depth)
        elif at + 1 < len(lines) and lines[at + 1][0] == indent and re.match(r"-( |$)", lines[at + 1][1]):
            found[key], at = _list(lines, at + 1, indent, depth + 1)
        else:
            found[key], at = _below(lines, at + 1, indent, depth)
    return found, at


def _below(lines: list[_Line], at: int, indent: int, depth: int) -> tuple[Any, int]:
    """What is indented further than `indent`; None where nothing is."""
    if at < len(lines) and lines[at][0] > indent:
        return _block(lines, at, lines[at][0], depth + 1)
    return None, at


def _value(lines: list[_Line], at: int, text: str, number: int, depth: int) -> tuple[Any, int]:
    """A value that begins in line `at` with `text`; one in brackets may go on in the lines below."""
    at += 1
    if text[0] not in "[{":
        return _scalar(text), at
    while not _is_closed(text):
        if at >= len(lines):
            raise _Unreadable("a bracket is not closed", number)
        text += " " + lines[at][1]
        at += 1
    value, end = _flow(text, 0, number, depth)
    if text[end:].strip():
        raise _Unreadable(f"{text[end:].strip()[:40]!r} follows a closed bracket", number)
    return value, at


def _is_closed(text: str) -> bool:
    bare = re.sub(r""""[^"]*"|'[^']*'""", "", text)
    return bare.count("[") + bare.count("{") <= bare.count("]") + bare.count("}")


def _flow(text: str, at: int, number: int, depth: int) -> tuple[Any, int]:
    """A value in brackets, or inside of brackets, from `at` on; the value, and where it ends."""
    if depth > _DEEPEST:
        raise _Unreadable("nested too deeply", number)
    at += len(text[at:]) - len(text[at:].lstrip())
    if at >= len(text):
        raise _Unreadable("a value is missing", number)
    if text[at] not in "[{":
        match = re.compile(r""""[^"]*"|'[^']*'|[^,\[\]{}]*""").match(text, at)
        assert match is not None  # the last of the three matches anything
        return _scalar(match[0].strip()), match.end()
    closing, found = {"[": "]", "{": "}"}[text[at]], []
    keys: list[str] = []
    at += 1
    while True:
        at += len(text[at:]) - len(text[at:].lstrip())
        if at >= len(text):
            raise _Unreadable("a bracket is not closed", number)
        if text[at] == closing:
            break
        if closing == "}":
            match = re.compile(r"""("[^"]*"|'[^']*'|[^,:\[\]{}]+)\s*:""").match(text, at)
            if match is None:
                raise _Unreadable(f"expected a key and a colon, found {text[at : at + 20]!r}", number)
            keys.append(match[1].strip().strip("\"'"))
            at = match.end()
        value, at = _flow(text, at, number, depth + 1)
        found.append(value)
        at += len(text[at:]) - len(text[at:].lstrip())
        if at < len(text) and text[at] == ",":
            at += 1
        elif at >= len(text) or text[at] != closing:
            raise _Unreadable(f"expected a comma or {closing}, found {text[at : at + 20]!r}", number)
    return (dict(zip(keys, found, strict=True)) if closing == "}" else found), at + 1


def _scalar(text: str) -> Any:
    if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _NUMBER.fullmatch(text):
        return int(text) if re.fullmatch(r"[-+]?\d+", text) else float(text)
    return text
