"""A report as one HTML page that needs nothing else: verdict first, on phones too, light or dark."""

from collections.abc import Iterable
from html import escape
from importlib import resources


def document(title: str, kind: str, verdict: str, sections: Iterable[str]) -> str:
    """Return the whole page.

    Args:
        title: of the page.
        kind: "yes", "partly" or "no": how good the verdict is.
        verdict: a sentence without a full stop.
        sections: HTML, as `section` returns it; empty ones are left out.
    """
    style = resources.files(__package__).joinpath("page.css").read_text()
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{style}</style>
<main>
<h1>{escape(title)}</h1>
<p class="verdict {kind}">{escape(sentence(verdict))}</p>
{"".join(sections)}</main>
</html>
"""


def section(title: str, body: str) -> str:
    """Return HTML under a title; nothing where there is none."""
    return f"<section>\n<h2>{title}</h2>\n{body}\n</section>\n" if body else ""


def sentence(text: str) -> str:
    """Return a sentence with its capital and its full stop."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def listed(lines: Iterable[str]) -> str:
    """Return sentences without full stops as a list in HTML."""
    return "<ul>\n" + "".join(f"<li>{escape(sentence(line))}</li>\n" for line in lines) + "</ul>"


def table(rows: Iterable[tuple[str, ...]], head: tuple[str, ...] = ()) -> str:
    """Return rows of text as a table in HTML, the first cell of each a heading."""
    titles = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    cells = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>\n'
        for row in rows
    )
    return f"<table>\n{f'<tr>{titles}</tr>' if head else ''}{cells}</table>"
