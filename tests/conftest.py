"""What all tests share."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
COMMANDS = ["avsim-scene", "avsim-audio", "avdetect-audio", "avdetect-video", "avfuse", "aveval", "avcalib"]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, photographs and networks beside the checkout; skips where it is absent."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"the real data are not here ({folder.name}/ beside the checkout, or AVCLI_SHARED_DATA)")
    return folder


def run(*command, stdin: bytes | str | None = b"", cwd=None, timeout=120, env=None) -> subprocess.CompletedProcess:
    """Run one of our commands as a real process; stdout is bytes, stderr text."""
    first = str(BIN / command[0]) if command[0] in COMMANDS else command[0]
    result = subprocess.run(
        [first, *map(str, command[1:])],
        input=stdin.encode() if isinstance(stdin, str) else stdin,
        capture_output=True,
        cwd=cwd,
        timeout=timeout,
        env={**os.environ, **(env or {})},
    )
    result.stderr = result.stderr.decode()
    return result
