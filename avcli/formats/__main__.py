"""Write the JSON Schemas, and the lists in avcli-formats(5), aveval(1) and avfuse(1), from their descriptions.

python -m avcli.formats            # write them
python -m avcli.formats --check    # exit 1, naming the files that are not as the descriptions say
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from avcli import materials
from avcli.formats.descriptions import RECORDS, Format
from avcli.formats.experiment import CONFIG
from avcli.formats.schema import Either, Key, Kind, ListOf, MapOf, Object, Variants
from avcli.metrics.description import METRICS, with_score_list
from avcli.scene.scenario import SCENARIO
from avcli.tracking.learnt import LEARNT
from avcli.tracking.trackers import with_trackers

SCHEMAS = Path(__file__).with_name("schemas")
MANUAL = Path(__file__).parents[2] / "man" / "avcli-formats.5"
SCORES_MANUAL = MANUAL.with_name("aveval.1")
TRACKERS_MANUAL = MANUAL.with_name("avfuse.1")
FORMATS = (*RECORDS, METRICS, CONFIG, SCENARIO, LEARNT)


def json_schema(described: Format) -> str:
    """Return the text of a format's schema file."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": described.title}
    return json.dumps(head | described.content.schema(), indent=2, ensure_ascii=False) + "\n"


def key_list(described: Format) -> str:
    """Return a format's list of keys in the language of manual pages (mdoc)."""
    return "\n".join(_listed(described.content)) + "\n"


def _listed(kind: Object) -> Iterator[str]:
    if not kind.keys:
        return
    yield ".Bl -tag -width Ds -compact"
    for name, key in kind.keys.items():
        yield f".It Va {name}"
        yield _sentence(key)
        yield from _inside(key.kind)
    yield ".El"


def _inside(kind: Kind) -> Iterator[str]:
    """List the keys of the objects that a value is made of."""
    if isinstance(kind, Object):
        yield from _listed(kind)
    elif isinstance(kind, ListOf | MapOf):
        yield from _inside(kind.item)
    elif isinstance(kind, Either):
        for each in kind.kinds:
            yield from _inside(each)
    elif isinstance(kind, Variants):
        yield ".Bl -tag -width Ds -compact"
        for name, variant in kind.kinds.items():
            yield f".It Va kind No = Cm {name}"
            yield from _listed(variant)
        yield ".El"


def _sentence(key: Key) -> str:
    words = key.kind.words() + ("; required" if key.required else "")
    if key.default is not None:
        words += f"; default {json.dumps(key.default)}"
    text = "\n".join(f"{part[:1].upper()}{part[1:]}." for part in (key.text, words))
    text = re.sub(r"\. (?=[A-Z])", ".\n", text)  # mandoc wants a line for each sentence
    # A backslash would be an escape, and formatters differ in what they make of other characters than ASCII.
    return "".join(c if c.isascii() else f"\\[u{ord(c):04X}]" for c in text.replace("\\", "\\e"))


def _with_key_lists(page: str) -> str:
    """Return the manual page with the lists between its marker comments written anew."""
    for described in FORMATS:
        begin, end = f'.\\" keys of {described.name}, written by make formats\n', f'.\\" end of {described.name}\n'
        before, _, rest = page.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise SystemExit(f"{MANUAL}: the marker comments of {described.name} are missing")
        page = f"{before}{begin}{key_list(described)}{end}{after}"
    return page


def _with_materials(page: str) -> str:
    """Return the manual page with its list of materials written anew."""
    begin, end = '.\\" materials, written by make formats\n', '.\\" end of materials\n'
    before, _, rest = page.partition(begin)
    after = rest.partition(end)[2]
    lines = [".Bl -tag -width Ds -compact"]
    for name, material in materials.table().items():
        lines += [f".It Cm {name}", f"{material.text[:1].upper()}{material.text[1:]}."]
    text = "\n".join([*lines, ".El", ""])
    return f"{before}{begin}{text}{end}{after}"


def main() -> int:
    """Write or check the files; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m avcli.formats", description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a file would change")
    check = parser.parse_args().check
    files = {SCHEMAS / f"{described.name}.schema.json": json_schema(described) for described in FORMATS}
    files[MANUAL] = _with_materials(_with_key_lists(MANUAL.read_text()))
    files[SCORES_MANUAL] = with_score_list(SCORES_MANUAL.read_text())
    files[TRACKERS_MANUAL] = with_trackers(TRACKERS_MANUAL.read_text())
    stale = [path for path, text in files.items() if not path.exists() or path.read_text() != text]
    for path in stale:
        if check:
            print(f"{path}: differs from the formats' descriptions; run make formats", file=sys.stderr)
        else:
            path.write_text(files[path])
    return 1 if check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
