"""examples/real-room: the simulated installation is one that can be simulated, and the scripts are bash.

The whole path takes minutes; its README has the figures.
"""

import json
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

from avcli.scene.load import load

FOLDER = ROOT / "examples" / "real-room"


@pytest.mark.parametrize("script", ["simulate.sh", "real-room.sh"])
def test_the_scripts_are_bash(script):
    assert subprocess.run(["bash", "-n", FOLDER / script]).returncode == 0


def test_the_installation_can_be_simulated(tmp_path):
    subprocess.run([sys.executable, FOLDER / "installation.py", "scenes", tmp_path], check=True)
    for name in ("floor", "empty", "walk", "meeting"):
        assert load(str(tmp_path / f"{name}.json")).warnings == ()
    assert len(list((tmp_path / "boards").iterdir())) == 16
    measured = json.loads((tmp_path / "room.json").read_bytes())["microphone_config"]["mic_positions_m"]
    true = json.loads((tmp_path / "truth.json").read_bytes())["mics"]
    assert 0.03 < np.sqrt((np.subtract(measured, true) ** 2).sum(axis=1).mean()) < 0.08
