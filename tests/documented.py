"""The pages of the documentation, run: their commands are executed, and what they print is compared with the page.

    python tests/documented.py PAGE...           run the pages with everything that takes long
    python tests/documented.py --write PAGE...   the same, and write what was printed into the pages

In a page, a fence `sh` or `python` is run, in the directory that all blocks of the page share. A fence `text` after it
is what it prints. A comment before a fence changes this: `<!-- file: NAME -->` saves the fence as a file,
`<!-- slow: WHY -->` runs it only here and not in the tests, `<!-- not run: WHY -->` never. A line `...` of a `text`
stands for any lines.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from forked import HANG_S, write_shims

ROOT = Path(__file__).resolve().parent.parent
_FENCE = re.compile(
    r"(?:^<!-- (?P<mark>file|slow|not run): (?P<value>[^\n]*?) -->\n+)?^```(?P<kind>\w+)\n(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")

_ANY = r"(?:.*(?:\n|\Z))*?"


@dataclass
class Block:
    """One fence of a page.

    Attributes:
        kind: "sh", "python", "text", "json", ….
        body: its lines.
        mark, value: of the comment before it, "" for none.
        span: where `body` stands in the page, in characters.
        prints: the block with what it prints, None where the page does not show that.
    """

    kind: str
    body: str
    mark: str
    value: str
    span: tuple[int, int]
    prints: "Block | None" = None


def blocks_of(page: str) -> list[Block]:
    """All fences of a page, in order; what a block prints belongs to it and is not listed by itself."""
    found: list[Block] = []
    end = -1
    for match in _FENCE.finditer(page):
        block = Block(match["kind"], match["body"], match["mark"] or "", match["value"] or "", match.span("body"))
        after = found and not page[end : match.start()].strip()
        if block.kind == "text" and after and found[-1].kind in ("sh", "python"):
            found[-1].prints = block
        else:
            found.append(block)
        end = match.end()
    return found


def agrees(printed: str, shown: str) -> bool:
    """Whether a text is the page's: the same words, numbers equal to 2 last digits or 2 %, `...` for any lines."""
    pattern = "\n".join(_as_pattern(line) for line in shown.strip().splitlines()).replace(f"{_ANY}\n", _ANY)
    text = "\n".join(" ".join(line.split()) for line in printed.strip().splitlines())
    match = re.fullmatch(pattern, text)
    if not match:
        return False
    expected = [number for line in shown.splitlines() for number in _NUMBER.findall(line)]
    return all(_near(found, one) for found, one in zip(match.groups(), expected, strict=True))


def _as_pattern(line: str) -> str:
    if line.strip() == "...":
        return _ANY
    words, last = "", 0
    line = " ".join(line.split())
    for number in _NUMBER.finditer(line):
        words += re.escape(line[last : number.start()]) + f"({_NUMBER.pattern})"
        last = number.end()
    return words + re.escape(line[last:])


def _near(found: str, shown: str) -> bool:
    digits = len(shown.partition(".")[2].partition("e")[0])
    return abs(float(found) - float(shown)) <= max(2.01 * 10.0**-digits * bool(digits), 0.02 * abs(float(shown)))


def run_page(path: Path, directory: Path, everything: bool = False, write: bool = False) -> None:
    """Run the blocks of a page; an AssertionError says which one failed or printed something else.

    Args:
        path: the page.
        directory: where its commands run. `examples/` is linked there, as a checkout has it.
        everything: also run what is marked as slow.
        write: put what was printed into the page where it differs, instead of failing.
    """
    page = path.read_text()
    if not (directory / "examples").exists():
        (directory / "examples").symlink_to(ROOT / "examples")
    environment, descriptor = write_shims(directory / ".bin")
    changes = []
    for block in blocks_of(page):
        if block.mark == "file":
            (directory / block.value).parent.mkdir(parents=True, exist_ok=True)
            (directory / block.value).write_text(block.body)
        elif block.kind not in ("sh", "python") or block.mark == "not run" or (block.mark == "slow" and not everything):
            continue
        else:
            command = ["bash", "-euo", "pipefail", "-c", block.body]
            result = subprocess.run(
                command if block.kind == "sh" else [sys.executable, "-W", "error", "-c", block.body], cwd=directory,
                env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                pass_fds=[descriptor], timeout=HANG_S,
            )  # fmt: skip
            printed = result.stdout.decode()
            assert result.returncode == 0, f"{path.name}: exit {result.returncode}:\n{block.body}\n{printed}"
            if block.prints and not agrees(printed, block.prints.body):
                assert write, f"{path.name}:\n{block.body}\nshows\n{block.prints.body}\nbut prints\n{printed}"
                changes.append((block.prints.span, printed.strip() + "\n"))
    for (start, end), text in reversed(changes):
        page = page[:start] + text + page[end:]
    if changes:
        path.write_text(page)


def missing_tools(path: Path) -> list[str]:
    """What the page's commands need beside avcli and is not installed here."""
    commands = "\n".join(block.body for block in blocks_of(path.read_text()) if block.kind == "sh")
    return [tool for tool in ("jq", "make") if re.search(rf"\b{tool}\b", commands) and not shutil.which(tool)]


def main() -> None:
    """Run the pages of the command line, in one directory, and say how long each took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path, metavar="PAGE")
    parser.add_argument("--write", action="store_true", help="write what was printed into the pages")
    parser.add_argument("--s1", type=Path, metavar="DIR", help="a finished S1, as the how-tos use it")
    parser.add_argument("--quick", action="store_true", help="leave out what is marked as slow, as the tests do")
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    failed = False
    with tempfile.TemporaryDirectory(prefix="avcli-pages-") as directory:
        if options.s1:
            (Path(directory) / "out").mkdir()
            (Path(directory) / "out" / "s1").symlink_to(options.s1.resolve())
        for page in options.pages:
            start = time.monotonic()
            try:
                run_page(page, Path(directory), not options.quick, options.write)
                print(f"{page}: {time.monotonic() - start:.1f} s")
            except AssertionError as fault:
                failed = True
                print(f"{page}: FAILED\n{fault}", file=sys.stderr)
    sys.exit(failed)


if __name__ == "__main__":
    main()
