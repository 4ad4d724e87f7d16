"""Options that are made from a stage's settings."""

import ast
import dataclasses
import sys

import click
import pytest
from click.testing import CliRunner
from conftest import ROOT

from avcli.commands import options
from avcli.settings import setting


@dataclasses.dataclass(frozen=True)
class Settings:
    window: float = setting(0.1, "Length of a window.", unit="S", above=0.0)
    count: int = setting(3, "How many.", unit="N", least=1, most=9)
    band: tuple[float, float] = setting((200.0, 8000.0), "Band of frequencies.", unit="HZ", least=0.0, flag="--band-hz")
    kind: str = setting("a", "Which kind.", choices=("a", "b"))
    share: float | None = setting(None, "Share.", unit="P", least=0.0, most=1.0, default_text="learnt")
    refine: bool = setting(True, "Refine.", flag="--refine/--no-refine")
    inner: int = 7


@click.command()
@options.from_settings(Settings)
def command(**values):
    if values["kind"] == "b":
        options.refuse_without_effect(["count"], "with --kind b")
    print(options.settings_from(Settings, values))


def run(*arguments):
    return CliRunner().invoke(command, arguments)


def test_the_defaults_are_those_of_the_settings():
    assert run().output == f"{Settings()}\n"


def test_what_is_given_arrives():
    result = run("--window", "0.2", "--count", "4", "--band-hz", "1", "2", "--share", "0.5", "--no-refine")
    assert result.output == f"{Settings(0.2, 4, (1.0, 2.0), 'a', 0.5, False)}\n"


@pytest.mark.parametrize("wrong", [("--window", "0"), ("--count", "10"), ("--kind", "c"), ("--share", "-1")])
def test_what_is_out_of_range_is_refused(wrong):
    assert run(*wrong).exit_code == 2


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (["--window", "x"], "must be a number, found 'x'"),
        (["--window", "inf"], "must be a finite number, found inf"),
        (["--window", "0"], "must be above 0, found 0"),
        (["--count", "2.5"], "must be a whole number, found '2.5'"),
        (["--count", "10"], "must be from 1 to 9, found 10"),
        (["--band-hz", "-1", "3"], "must be at least 0, found -1"),
    ],
)
def test_what_is_wrong_with_a_number_is_said_in_words(wrong, words):
    assert words in run(*wrong).output


def test_a_long_whole_number_is_written_in_full():
    with pytest.raises(click.BadParameter, match="must be from 0 to 9223372036854775807, found -1"):
        options.WholeRange(0, 2**63 - 1).convert("-1", None, None)


def test_help_says_default_unit_and_range():
    text = " ".join(run("--help").output.split())
    for part in ("--window S", "[default: 0.1; above 0]", "[default: (learnt); from 0 to 1]", "--refine / --no-refine"):
        assert part in text


def test_an_option_without_effect_is_refused_by_name_only_if_it_was_given():
    assert run("--kind", "b").exit_code == 0
    assert "--count has no effect with --kind b" in run("--kind", "b", "--count", "3").output


def test_settings_import_the_standard_library_alone():
    tree = ast.parse((ROOT / "avcli/settings.py").read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert {node.names[0].name if isinstance(node, ast.Import) else node.module for node in imports} <= (
        sys.stdlib_module_names
    )
