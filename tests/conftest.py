"""What all tests share."""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from forked import COMMANDS, HANG_S, run_forked
from hypothesis import HealthCheck, settings

# On a busy machine examples take long to make; that is no fault of a test.
settings.register_profile(
    "same every time", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same every time")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if "PYTEST_XDIST_WORKER" not in os.environ:  # a worker has all this from the process that starts it
    _CACHE = tempfile.TemporaryDirectory(prefix="avcli-cache-")
    shaders = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    os.environ.setdefault("MESA_SHADER_CACHE_DIR", shaders)
    os.environ["XDG_CACHE_HOME"] = _CACHE.name  # rooms are not left behind; compiled shaders may be
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # hundreds of processes start: each would compile everything again
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's "&" ignores it, and children would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, photographs and networks beside the checkout; skips where it is absent."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"the real data are not here ({folder.name}/ beside the checkout, or AVCLI_SHARED_DATA)")
    return folder


def schema(name: str) -> dict:
    """The JSON Schema of a format that ships with the package."""
    return json.loads((ROOT / "avcli" / "formats" / "schemas" / f"{name}.schema.json").read_bytes())


def run(
    *command, stdin: bytes | str = b"", cwd=None, env=None, largest_file: int | None = None
) -> subprocess.CompletedProcess:
    """Run a command in a process of its own; stdout is bytes, stderr text. Ours are forked, where `env` allows it."""
    given = stdin.encode() if isinstance(stdin, str) else stdin
    if command[0] in COMMANDS and env is None:
        return run_forked(*command, stdin=given, cwd=cwd, largest_file=largest_file)
    first = str(BIN / command[0]) if command[0] in COMMANDS else command[0]
    result = subprocess.run(
        [first, *map(str, command[1:])],
        input=given,
        capture_output=True,
        cwd=cwd,
        timeout=HANG_S,
        env={**os.environ, **(env or {})},
    )
    result.stderr = result.stderr.decode()
    return result


def done(*command, **more) -> subprocess.CompletedProcess:
    """Run a command, as `run` does, that must end well."""
    ended = run(*command, **more)
    assert ended.returncode == 0, ended.stderr
    return ended


def refused(ended: subprocess.CompletedProcess, *words: str, status: int = 1) -> subprocess.CompletedProcess:
    """Check that a command ended with this status and one line that has these words; return it."""
    assert (ended.returncode, ended.stderr.count("\n")) == (status, 1), ended.stderr
    assert all(word in ended.stderr for word in words), ended.stderr
    return ended


def run_experiment(directory: Path, *scene: object) -> None:
    """Run one scenario by all three modalities into a directory, as `make` does; `scene` is what avsim-scene gets."""
    for folder in ("localization", "tracking"):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    found = {sensor: directory / f"localization/{sensor}_localizations.jsonl" for sensor in ("audio", "video")}
    by_ear = [
        ("avsim-audio", directory / "scene.jsonl", "-o", directory / "audio.jsonl"),
        ("avdetect-audio", directory / "audio.jsonl", "-o", found["audio"]),
        ("avfuse", found["audio"], "-o", directory / "tracking/audio_tracking.jsonl"),
    ]
    by_eye = [
        ("avdetect-video", directory / "scene.jsonl", "-o", found["video"]),
        ("avfuse", found["video"], "-o", directory / "tracking/video_tracking.jsonl"),
    ]

    def steps(*commands: tuple) -> None:
        for name, *options in commands:
            result = run(name, "-C", directory, *options)
            assert (result.returncode, result.stderr) == (0, ""), f"{name}: {result.stderr}"

    steps(("avsim-scene", *scene, "-o", directory / "scene.jsonl"))
    with ThreadPoolExecutor() as both:  # the other worker waits for this, so that a processor is free
        list(both.map(lambda branch: steps(*branch), (by_ear, by_eye)))
    steps(("avfuse", *found.values(), "-o", directory / "tracking/audio_video_tracking.jsonl"))


@pytest.fixture(scope="session")
def finished_s1(tmp_path_factory) -> Path:
    """A finished S1 experiment, made once for all tests and all workers; nobody may change it."""
    return _experiment_of_all(tmp_path_factory, "finished", "s1")


@pytest.fixture(scope="session")
def small_s1(finished_s1, tmp_path_factory) -> Path:
    """The first second of S1 in pictures of half the size, for what needs any experiment; nobody may change it."""
    camera = json.loads((finished_s1 / "config.json").read_bytes())["camera_config"]
    for axis in "xy":
        camera[f"f{axis}_px"] /= 2
        camera[f"c{axis}_px"] = (camera[f"c{axis}_px"] + 0.5) / 2 - 0.5
    camera |= {"image_width_px": 960, "image_height_px": 540}
    given = tmp_path_factory.mktemp("camera") / "camera.json"
    given.write_text(json.dumps(camera))
    return _experiment_of_all(tmp_path_factory, "small", "s1", "--duration", 1, "--camera-config", given)


def _experiment_of_all(tmp_path_factory, name: str, *scene: object) -> Path:
    """An experiment that one of the workers makes, for all."""
    shared = tmp_path_factory.getbasetemp()
    shared = shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared
    directory = shared / name / "out" / "s1"
    directory.parent.mkdir(parents=True, exist_ok=True)
    with open(shared / name / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (directory / "done").exists():
            shutil.rmtree(directory, ignore_errors=True)
            run_experiment(directory, *scene)
            (directory / "done").touch()
    return directory
