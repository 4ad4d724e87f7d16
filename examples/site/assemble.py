"""Lay out the sources of the site: the pages of the checkout, the manuals as HTML, and the figures.

    python assemble.py TARGET

The tree in TARGET is that of the checkout, so that the links between pages hold. What changes: the names of manuals in
the text become links, a link to a folder leads to its README or becomes plain text, and README.md becomes index.md.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HERE = Path("examples/site")
SECTIONS: dict[str, list[str]] = {
    "Tutorial": ["examples/tutorial/README"],
    "How to": ["examples/how-to/README"],
    "Methods": ["examples/methods/README"],
    "Longer examples": [],
    "Reference": ["examples/site/manuals", "examples/site/library"],
    "Measured": ["examples/site/benchmarks"],
    "Project": ["CHANGELOG", "CONTRIBUTING"],
}
PICTURES = {".svg", ".png", ".jpg"}
MANUAL = re.compile(r"(?<![\w/\[-])(av[a-z-]+)\(([157])\)(?![\w\]])")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def manual_file(name: str) -> str:
    """The page of a manual: man/avfuse.1 as man/avfuse.1.html."""
    return f"man/{name}"


def toctree(entries: list[str], caption: str = "", hidden: bool = True) -> str:
    """A list of pages for the navigation."""
    options = [f":caption: {caption}"] * bool(caption) + [":hidden:"] * hidden + [":maxdepth: 1"]
    return "\n".join(["", "```{toctree}", *options, "", *entries, "```", ""])


def text_of(page: Path, pages: set[Path]) -> str:
    """The text of a page of the checkout as the site has it."""
    up = "../" * len(page.parent.parts)

    def link(match: re.Match) -> str:
        picture, label, target, anchor = match[1], match[2], match[3], match[4] or ""
        if target.startswith("https://") or picture:
            return match[0]
        goal = Path(ROOT / page.parent / target).resolve()
        if goal.is_dir():
            if not (goal / "README.md").exists():
                return label
            target = f"{target.rstrip('/')}/README.md"
        elif goal == ROOT / "README.md":
            target = f"{up}index.md"
        elif goal.suffix == ".md" and goal.relative_to(ROOT) not in pages:
            return label
        return f"[{label}]({target}{anchor})"

    parts = re.split(r"(^```.*?^```$|`[^`\n]*`)", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    for index in range(0, len(parts), 2):
        parts[index] = MANUAL.sub(rf"[\1(\2)]({up}man/\1.\2.md)", LINK.sub(link, parts[index]))
    return re.sub(r"^```sh$", "```bash", "".join(parts), flags=re.MULTILINE)


def manual(page: Path) -> str:
    """A manual as a page: mandoc's HTML with our headings and links."""
    html = subprocess.run(
        ["mandoc", "-T", "html", "-O", "fragment,man=%N.%S.html", page], capture_output=True, text=True, check=True
    ).stdout
    html = re.sub(r"<(/?)h2\b", r"<\1h3", html)
    html = re.sub(r"<(/?)h1\b", r"<\1h2", html)
    html = re.sub(r"<table class=\"(?:head|foot)\">.*?</table>", "", html, flags=re.DOTALL)
    known = {other.name for other in page.parent.iterdir()}
    html = re.sub(
        r'<a class="Xr" href="([^"]+?)\.html"[^>]*>(.*?)</a>',
        lambda match: match[0] if match[1] in known else match[2], html,
    )  # fmt: skip
    html = html.replace("\n\n", "\n")
    return f"# {page.stem}({page.suffix[1:]})\n\n```{{raw}} html\n{html}\n```\n"


def main() -> None:
    """Write the tree."""
    target = Path(sys.argv[1])
    shutil.rmtree(target, ignore_errors=True)
    pages = {page.relative_to(ROOT) for page in [*ROOT.glob("*.md"), *(ROOT / "examples").rglob("*.md")]}
    for page in pages:
        (target / page).parent.mkdir(parents=True, exist_ok=True)
        (target / page).write_text(text_of(page, pages))
    for file in (ROOT / "examples").rglob("*"):
        if file.suffix in PICTURES | {".py", ".sh", ".json"} and file.parent != ROOT / HERE:
            (target / file.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, target / file.relative_to(ROOT))
    for name in ("CITATION.cff", "constraints.txt"):
        shutil.copy(ROOT / name, target / name)
    (target / "man").mkdir()
    manuals = sorted((ROOT / "man").glob("*.[157]"), key=lambda page: (-int(page.suffix[1:]), page.name))
    for page in manuals:
        (target / "man" / f"{page.name}.md").write_text(manual(page))
    listed = [f"../../man/{page.name}" for page in manuals]
    about = "# Manuals\n\nThe same text as `man avfuse` and so on.\n"
    (target / HERE / "manuals.md").write_text(about + toctree(listed, "", False))
    measured = sorted(f"../benchmarks/{page.stem}" for page in (ROOT / "examples/benchmarks").glob("*.md"))
    (target / HERE / "benchmarks.md").write_text("# Benchmarks\n" + toctree(measured, "", False))
    for folder in ("tutorial", "how-to", "methods"):
        readme = target / "examples" / folder / "README.md"
        text = readme.read_text()
        readme.write_text(text + toctree(re.findall(r"\]\(([\w-]+)\.md\)", text)))
    listed_above = {"tutorial", "how-to", "methods", "site", "benchmarks"}
    longer = [page for page in pages if page.parts[0] == "examples" and page.parent.name not in listed_above]
    by_folder = sorted(longer, key=lambda page: (page.parent, page.name != "README.md", page.name))
    SECTIONS["Longer examples"] = [str(page.with_suffix("")) for page in by_folder]
    index = (target / "README.md").read_text()
    (target / "README.md").unlink()
    (target / "index.md").write_text(index + "".join(toctree(names, title) for title, names in SECTIONS.items()))


if __name__ == "__main__":
    main()
