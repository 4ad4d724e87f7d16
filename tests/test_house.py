"""The rules of the house: who imports whom, what starts up fast, what is documented."""

import ast
import importlib
import itertools
import os
import re
import shutil
import subprocess
import sys

import pytest
from conftest import BIN, COMMANDS, ROOT, run

import avcli

SOURCES = sorted((ROOT / "avcli").rglob("*.py"))
HEAVY = {"numpy", "scipy", "cv2", "onnxruntime", "moderngl", "trimesh", "soundfile", "matplotlib", "torch", "orjson"}
STARTED = {"click", "avcli"}
IN_FUNCTIONS_ONLY = {"scipy", "cv2", "onnxruntime", "trimesh", "matplotlib", "moderngl", "soundfile"}


def imports(nodes):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_layers():
    result = subprocess.run([BIN / "lint-imports", "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_module_imports_when_it_is_imported(path):
    tree = ast.parse(path.read_text())
    top = {name.split(".")[0] for name in imports(tree.body)}
    everywhere = set(imports(ast.walk(tree)))
    assert not everywhere & {"scipy.signal", "scipy.stats"}
    assert not top & IN_FUNCTIONS_ONLY
    if path.parent.name == "commands":
        assert top <= STARTED | set(sys.stdlib_module_names)
        ours = {name for name in imports(tree.body) if name.startswith("avcli.")}
        light = re.compile(r"avcli\.(commands|__version__|(\w+\.)?settings)\b")
        assert all(light.match(name) for name in ours)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_and_version_import_nothing_heavy(command):
    module = command.replace("-", "_")
    program = (
        "import sys; sys.argv = [sys.argv[1], sys.argv[2]]\n"
        f"from avcli.commands.{module} import main\n"
        "try:\n    main()\n"
        f"finally:\n    print(*sorted({HEAVY!r} & set(sys.modules)), file=sys.stderr)\n"
    )
    for option in ("--help", "--version"):
        result = subprocess.run([sys.executable, "-c", program, command, option], capture_output=True, text=True)
        assert result.returncode == 0
        assert result.stdout.strip()
        assert result.stderr.strip() == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_help_ends_with_a_line_to_type(command):
    main = importlib.import_module("avcli.commands." + command.replace("-", "_")).main
    for name, one in {command: main, **getattr(main, "commands", {})}.items():
        assert one.epilog.startswith(f"Example: {command} {name if one is not main else ''}".strip())
        assert len(one.epilog) <= 76  # else it is broken in two


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_public_function_is_documented(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree) or not tree.body, "the module"
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name
    public = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    for node in public:
        if not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name


# --- manual pages -----------------------------------------------------------------------------------------------------


def options_of(command):
    """{"avcalib target": {"-o", "--output", …}, …} as click knows them."""
    import importlib

    import click

    main = importlib.import_module(f"avcli.commands.{command.replace('-', '_')}").main
    actions = {f"{command} {name}": sub for name, sub in main.commands.items()} if hasattr(main, "commands") else {}
    return {
        name: {
            text
            for parameter in action.get_params(click.Context(action))
            if isinstance(parameter, click.Option) and not parameter.hidden
            for text in (*parameter.opts, *parameter.secondary_opts)
        }
        for name, action in (actions or {command: main}).items()
    }


def page_of(command):
    return (ROOT / "man" / f"{command}.1").read_text()


def plain(page):
    """A page's text without the roff escapes that hide a dash."""
    return page.replace("\\-", "-").replace("\\fB", "").replace("\\fI", "").replace("\\fR", "").replace("\\fP", "")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_manual_lists_exactly_the_options(command):
    text = plain(page_of(command))
    section = text.split(".Sh OPTIONS", 1)[1].split("\n.Sh ", 1)[0]
    listed = set()
    for line in section.splitlines():
        if line.startswith(".It Fl"):
            for part in re.split(r"\s,\s", line[len(".It ") :]):
                words = part.replace("Fl Fl", "Fl -").split()
                for one, two in itertools.pairwise(words):
                    if one == "Fl":
                        listed.add(f"-{two}")
    offered = set().union(*options_of(command).values())
    assert listed == offered, f"missing {sorted(offered - listed)}, too many {sorted(listed - offered)}"


PAGES = sorted((ROOT / "man").glob("*.[1-9]"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
@pytest.mark.skipif(not shutil.which("mandoc"), reason="mandoc is not installed")
def test_the_manual_is_well_formed(page):
    result = subprocess.run(["mandoc", "-T", "lint", "-W", "warning", page], capture_output=True, text=True)
    assert result.stdout == ""


def test_every_command_has_its_page():
    assert {f"{command}.1" for command in COMMANDS} | {"avcli.7", "avcli-formats.5"} == {page.name for page in PAGES}


def examples_of(page):
    """The literal lines of the EXAMPLES section, continued lines joined."""
    section = plain(page).split(".Sh EXAMPLES", 1)[1].split("\n.Sh ", 1)[0]
    blocks = re.findall(r"\.Bd -literal[^\n]*\n(.*?)\n\.Ed", section, re.DOTALL)
    return [block.replace("\\e", "\\") for block in blocks]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_manual_has_examples(command):
    assert examples_of(page_of(command)), "an EXAMPLES section with .Bd -literal blocks"


# --- what may not be in the tree --------------------------------------------------------------------------------------


@pytest.mark.skipif(not shutil.which("git") or not (ROOT / ".git").exists(), reason="no git checkout")
def test_no_path_of_one_machine_is_committed():
    files = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True).stdout.split(b"\0")
    home = os.path.expanduser("~").encode()
    for name in filter(None, files):
        path = ROOT / name.decode()
        if path.is_file() and path.suffix in {".py", ".md", ".json", ".sh", "", ".1", ".5", ".7", ".toml"}:
            text = path.read_bytes()
            assert str(ROOT).encode() + b"/" not in text, name
            assert len(home) < 4 or home + b"/" not in text, name


# --- what is installed beside the package -----------------------------------------------------------------------------

COMPLETIONS = ROOT / "avcli" / "commands" / "completions"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_shell_completes_the_command(command):
    variable = f"_{command.upper().replace('-', '_')}_COMPLETE"
    bash = (COMPLETIONS / "bash-completion" / "completions" / command).read_text()
    fish = (COMPLETIONS / "fish" / "vendor_completions.d" / f"{command}.fish").read_text()
    assert bash == f'eval "$({variable}=bash_source {command})"\n'
    assert fish == f"{variable}=fish_source {command} | source\n"
    assert command in (COMPLETIONS / "zsh" / "site-functions" / "_avcli").read_text().splitlines()[0].split()


@pytest.mark.skipif(not shutil.which("bash"), reason="bash is not installed")
def test_bash_completes_the_trackers():
    script = (
        f"source {COMPLETIONS}/bash-completion/completions/avfuse; "
        "COMP_WORDS=(avfuse --tracker ''); COMP_CWORD=2; _avfuse_completion avfuse; echo ${COMPREPLY[@]}"
    )
    path = f"{BIN}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env={**os.environ, "PATH": path})
    assert result.stdout.split() == ["ms-glmb", "lmb", "gnn", "jpda"]


def test_the_version_is_the_same_everywhere():
    assert f"\nversion: {avcli.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {avcli.__version__} (" in (ROOT / "CHANGELOG.md").read_text()
    for page in PAGES:
        assert f"\n.Os avcli {avcli.__version__}\n" in page.read_text(), page.name


def test_usage_errors_are_one_line():
    for command in COMMANDS:
        result = run(command, "--no-such-option")
        assert result.returncode == 2
        assert result.stderr.startswith(f"{command}: ")
        assert result.stderr.count("\n") == 1
