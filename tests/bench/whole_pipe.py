"""S1 from end to end, as one pipe and by make; the start of each command; and what the machine would need at least."""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import bench_pipe
import numpy as np
from figures import Row, figure
from scipy import fft

from avcli.detection.network import Network
from avcli.formats import media

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
FRAMES, MICROPHONES, WINDOWS = 41, 8, 2


def _environment(cache: Path) -> dict[str, str]:
    """Without pictures of rooms from before, but with the driver's shaders."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    environment.setdefault("MESA_SHADER_CACHE_DIR", os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")))
    return environment


def cpu_s(command: Sequence[object], cache: Path, into: Path | None = None) -> float:
    """Processor time of a command, its standard output into a file; RuntimeError with its last words if it fails."""
    first, *others = map(str, command)
    with tempfile.TemporaryFile() as said, open(into or os.devnull, "wb") as out:
        process = subprocess.Popen([str(BIN / first), *others], stdout=out, stderr=said, env=_environment(cache))
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            said.seek(0)
            words = said.read().decode(errors="replace").strip()[-300:]
            raise RuntimeError(f"{first} ended with {process.returncode}: {words}")
    return used.ru_utime + used.ru_stime


def pipe_rows() -> Iterator[Row]:
    """S1 as one pipe, with the least that the machine needs for it; and by `make -j2 s1`."""
    with tempfile.TemporaryDirectory() as temporary:
        bench_pipe.hold_memory(Path(temporary))
        run = bench_pipe.run_pipe("s1", Path(temporary), _environment(Path(temporary) / "cache"))
        for name, seconds in run["cpu_s"].items():
            yield figure("pipe", "S1", f"avcli {name}", seconds, "S1")
        yield {**figure("pipe", "S1", "avcli, all", sum(run["cpu_s"].values()), "S1"), "wall_s": run["wall_s"]}
        for name, (seconds, what) in limits(Path(temporary) / "out").items():
            yield {**figure("pipe", "S1, the least", name, seconds, "S1"), "what": what}
    with tempfile.TemporaryDirectory() as temporary:
        yield made(Path(temporary))


def made(temporary: Path) -> Row:
    """S1 by `make -j2 s1`: by sound, by pictures and by both, each with its tracks, the scores and the page."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(["make", "-s", "-j2", "-C", ROOT, f"VENV={BIN.parent}", f"OUT={temporary}/out", "s1"],
                   stdout=subprocess.DEVNULL, check=True)  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**figure("pipe", "make s1", "avcli, all", spent, "S1"), "wall_s": time.perf_counter() - begin}


def least(work: Callable[[], Any]) -> float:
    """CPU s of the fastest of three."""
    spent = []
    for _ in range(3):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return min(spent)


def limits(experiment: Path) -> dict[str, tuple[float, str]]:
    """What the heart of each stage takes on this machine, alone: command -> CPU s and what that is.

    A stage cannot be faster than the library routine that it must call; the rest of its time is its own.
    """
    frames = [np.load(path) for path in sorted((experiment / "video").glob("*/*.npy"))]
    colour = [one for one in frames if one.ndim == 3]
    model = next(iter(sorted(Path(media.__file__).parents[1].glob("detection/*.onnx"))))
    network = Network(model.read_bytes())
    rng = np.random.default_rng(0)
    windows, pairs = rng.standard_normal((MICROPHONES, 8192)), MICROPHONES * (MICROPHONES - 1) // 2
    crossed = rng.standard_normal((pairs, 8193)) + 0j
    responses = rng.standard_normal((MICROPHONES, 1 << 15))
    return {
        "avsim-scene": (least(lambda: [one.copy() for one in frames]), "one copy of all pictures and depths"),
        "avsim-audio": (
            FRAMES * least(lambda: fft.irfft(fft.rfft(responses))),
            "convolution with one response a record and microphone",
        ),
        "avdetect-audio": (
            FRAMES * WINDOWS * least(lambda: (fft.rfft(windows, 16384), fft.irfft(crossed))),
            "the transforms of all windows and pairs",
        ),
        "avdetect-video": (len(colour) * least(lambda: network.detect(colour[0])), "the network on all pictures"),
    }


def start_rows() -> Iterator[Row]:
    """Each command's --help, and what it takes to do the least that it can do, mostly one record."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, cache = Path(temporary), Path(temporary) / "cache"
        at, scene, seen = ("-C", folder), folder / "scene.jsonl", folder / "v.jsonl"
        cpu_s(["avsim-scene", "s1", *at, "--duration", "0.01"], cache, scene)  # one record
        cpu_s(["avdetect-video", *at, scene], cache, seen)
        truth = folder / "groundtruth_sources.jsonl"
        work: dict[str, list[object]] = {
            "avsim-scene": ["s1", "-C", folder / "other", "--no-video"],
            "avsim-audio": [*at, truth],
            "avdetect-audio": [],  # it waits for whole windows of sound: the pipe measures it
            "avdetect-video": [*at, scene],
            "avfuse": [*at, seen],
            "aveval": [truth, truth],
            "avcalib": ["check", folder / "config.json"],
            "avview": [truth, "--html", folder / "page.html"],
        }
        for name, options in work.items():
            cases: dict[str, list[object]] = {"--help": ["--help"], "the least": options}
            for case, given in cases.items():
                if not given:
                    continue
                spent = min(cpu_s([name, *given], cache) for _ in range(3))
                yield figure("start", case, f"avcli {name}", spent, "start")
                shutil.rmtree(folder / "other", ignore_errors=True)
