"""make runs again exactly what depends on a change; the stages are stubs that write down how they were called."""

import shutil
import subprocess
import sys

import pytest
from conftest import COMMANDS, HANG_S, ROOT

pytestmark = pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")

STUB = """#!/usr/bin/env bash
echo "${0##*/} $*" >>"$(dirname "$0")/calls"
while [ $# -gt 0 ]; do if [ "$1" = -o ]; then echo {} >"$2"; fi; shift; done
"""


@pytest.fixture
def make(tmp_path):
    """A function that runs make in a place of its own and returns the stages that it called, with their arguments."""
    stubs = tmp_path / "venv" / "bin"
    stubs.mkdir(parents=True)
    for command in COMMANDS:
        (stubs / command).write_text(STUB)
        (stubs / command).chmod(0o755)
    (tmp_path / "venv" / ".ready").touch()

    def run(*arguments, rc=0):
        (stubs / "calls").write_text("")
        result = subprocess.run(
            ["make", "-C", ROOT, f"VENV={tmp_path}/venv", f"OUT={tmp_path}/out", *arguments],
            capture_output=True,
            text=True,
            timeout=HANG_S,
        )
        assert result.returncode == rc, result.stderr
        return (stubs / "calls").read_text().splitlines() if rc == 0 else result.stderr

    return run


def stages(calls):
    return sorted({call.split()[0] for call in calls})


def test_nothing_is_done_twice_and_a_changed_option_redoes_what_depends_on_it(make):
    assert len(make("s1")) == 9
    assert make("s1") == []
    assert stages(make("s1", "FUSE_FLAGS=--lag 'inf'")) == ["aveval", "avfuse"]
    assert make("s1", "FUSE_FLAGS=--lag 'inf'") == []
    assert len([call for call in make("s1") if call.startswith("avfuse")]) == 3
    again = make("s1", "DETECT_VIDEO_FLAGS=--monocular")
    assert stages(again) == ["avdetect-video", "aveval", "avfuse"]
    assert len([call for call in again if call.startswith("avfuse")]) == 2
    assert stages(make("s1", "DETECT_VIDEO_FLAGS=--monocular", "AUDIO_FLAGS=--rt60 0.8")) == [
        "avdetect-audio",
        "aveval",
        "avfuse",
        "avsim-audio",
    ]
    assert len(make("s1", "SEED=3")) == 9
    assert stages(make("s1", "SEED=3", "EVAL_FLAGS=--d0 1")) == ["aveval"]


def test_changed_code_redoes_the_stage_and_what_depends_on_it(make):
    make("s1")
    assert stages(make("s1", "-W", "avcli/tracking/glmb.py")) == ["aveval", "avfuse"]
    assert stages(make("s1", "-W", "avcli/metrics/hota.py")) == ["aveval"]
    assert len(stages(make("s1", "-W", "avcli/lens/models.py"))) == 6


def test_an_own_scenario(make, tmp_path):
    mine = tmp_path / "mine.json"
    mine.write_text("{}")
    calls = make("run", f"SCENARIO={mine}")
    assert calls[0].startswith(f"avsim-scene {mine} -C {tmp_path}/out/mine ")
    assert stages(make("run", f"SCENARIO={mine}")) == ["aveval"]
    mine.write_text("{ }")
    assert len(make("run", f"SCENARIO={mine}")) == 9
    assert stages(make("run", f"SCENARIO={mine}", "MODALITIES=audio")) == [
        "avdetect-audio",
        "aveval",
        "avfuse",
        "avsim-audio",
        "avsim-scene",
    ]
    assert make("run", "SCENARIO=s2")[0].startswith("avsim-scene s2 ")
    assert "needs SCENARIO" in make("run", rc=2)


def test_python_m_avcli_lists_the_commands_and_runs_one():
    from avcli.__main__ import COMMANDS as LISTED

    assert list(LISTED) == COMMANDS
    listing = subprocess.run([sys.executable, "-m", "avcli"], capture_output=True, text=True)
    assert listing.returncode == 0
    assert all(f"  {command} " in listing.stdout for command in COMMANDS)
    version = subprocess.run([sys.executable, "-m", "avcli", "avfuse", "--version"], capture_output=True, text=True)
    assert version.stdout.startswith("avfuse ")
    assert subprocess.run([sys.executable, "-m", "avcli", "avfus"], capture_output=True).returncode == 2


def test_help_lists_targets_and_variables_alone():
    text = subprocess.run(["make", "-C", ROOT, "-s", "help"], capture_output=True, text=True).stdout
    for word in ("make setup", "make run SCENARIO=", "SEED=0", "FUSE_FLAGS", "make bench-audio", "make clean"):
        assert word.removeprefix("make ") in text
    assert "---" not in text


def test_a_place_with_spaces_is_refused(make, tmp_path):
    for place in ("OUT", "VENV"):
        assert "each needs a path without spaces" in make("s1", f"{place}={tmp_path}/my place", rc=2)
