"""The pages of the documentation: their commands run, and print what the pages show; their links lead somewhere."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import documented
import pytest
from conftest import ROOT

TUTORIAL = sorted((ROOT / "examples" / "tutorial").glob("[01]*.md"))
HOW_TO = sorted((ROOT / "examples" / "how-to").glob("[a-z]*.md"))
CHAINS = [TUTORIAL[:3], *([page] for page in TUTORIAL[3:])]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "examples").rglob("*.md")])


@pytest.mark.slow
@pytest.mark.parametrize("pages", CHAINS, ids=lambda pages: pages[0].stem)
def test_the_tutorial_prints_what_it_shows(pages, tmp_path):
    for page in pages:
        if tools := documented.missing_tools(page):
            pytest.skip(f"{', '.join(tools)} not installed")
        documented.run_page(page, tmp_path)


@pytest.mark.slow
def test_the_how_tos_print_what_they_show(finished_s1, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "s1").symlink_to(finished_s1)
    for page in HOW_TO:
        if not documented.missing_tools(page):
            documented.run_page(page, tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text()):
        drawn = page.parent.name == "methods" and target.endswith(".svg")  # by make docs
        assert target.startswith("https://") or drawn or (page.parent / target).exists(), target


@pytest.mark.skipif(not shutil.which("mandoc"), reason="mandoc is not installed")
def test_every_page_is_in_the_navigation_of_the_site(tmp_path):
    subprocess.run([sys.executable, ROOT / "examples" / "site" / "assemble.py", tmp_path / "site"], check=True)
    pages = {page.resolve().with_suffix("") for page in (tmp_path / "site").rglob("*.md")}
    listed = set()
    for page in (tmp_path / "site").rglob("*.md"):
        for tree in re.findall(r"```{toctree}\n(.*?)```", page.read_text(), re.DOTALL):
            entries = [line for line in tree.splitlines() if line and not line.startswith(":")]
            listed |= {(page.parent / f"{entry}.md").resolve().with_suffix("") for entry in entries}
    assert listed == pages - {tmp_path / "site" / "index"}


def page_of(tmp_path, text) -> Path:
    (tmp_path / "page.md").write_text(text)
    return tmp_path / "page.md"


def test_a_page_that_shows_something_else_is_found(tmp_path):
    page = page_of(tmp_path, "```sh\necho 7 people, 0.25 m; echo end\n```\n\n```text\n7 people, 0.24 m\n...\n```\n")
    documented.run_page(page, tmp_path)
    page = page_of(tmp_path, page.read_text().replace("0.24", "0.35"))
    with pytest.raises(AssertionError, match=r"0\.25 m"):
        documented.run_page(page, tmp_path)
    documented.run_page(page, tmp_path, write=True)
    assert "```text\n7 people, 0.25 m\nend\n```" in page.read_text()


def test_a_command_that_fails_is_found(tmp_path):
    page = page_of(tmp_path, "<!-- not run: it fails -->\n```sh\nfalse\n```\n\n```sh\naveval --no-such-option\n```\n")
    with pytest.raises(AssertionError, match=r"exit 2[\s\S]*aveval: "):
        documented.run_page(page, tmp_path)


def test_files_of_a_page_are_written(tmp_path):
    page = page_of(
        tmp_path, "<!-- file: a/b.json -->\n```json\n{}\n```\n\n```sh\ncat a/b.json\n```\n\n```text\n{}\n```\n"
    )
    documented.run_page(page, tmp_path)
