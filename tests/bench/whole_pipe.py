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
from typing import IO, Any

import numpy as np
from figures import Row, figure
from scipy import fft

from avcli.detection.network import Network
from avcli.formats import media

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
FRAMES, MICROPHONES, WINDOWS = 41, 8, 2


class Running:
    """A process whose processor time is known when it has ended."""

    def __init__(self, command: Sequence[object], stdin: IO[bytes] | None, stdout: IO[bytes] | int, cache: Path):
        first, *others = map(str, command)
        environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
        environment.setdefault("MESA_SHADER_CACHE_DIR", os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")))
        program = str(BIN / first) if first.startswith("av") else first
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - cpu_s closes it
        self._process = subprocess.Popen(
            [program, *others], stdin=stdin, stdout=stdout, stderr=self._said, env=environment
        )
        self.name = first
        self.stdout = self._process.stdout
        if stdin is not None:
            stdin.close()

    def cpu_s(self) -> float:
        """Wait for its end; RuntimeError with its last words where that is a bad one."""
        _, status, used = os.wait4(self._process.pid, 0)
        self._process.returncode = os.waitstatus_to_exitcode(status)
        with self._said as said:
            said.seek(0)
            if self._process.returncode:
                words = said.read().decode(errors="replace").strip()[-300:]
                raise RuntimeError(f"{self.name} ended with {self._process.returncode}: {words}")
        return used.ru_utime + used.ru_stime


def pipe(folder: Path, cache: Path) -> tuple[dict[str, float], float]:
    """Run S1 as one pipe of processes with raw frames; return CPU s of each command, and wall s of all."""
    os.mkfifo(folder / "truth")
    at = ("-C", folder)
    begin = time.perf_counter()
    with open(folder / "v.jsonl", "wb") as seen, open(folder / "a.jsonl", "wb") as heard:
        scene = Running(["avsim-scene", "s1", *at, "--frames", "npy"], None, subprocess.PIPE, cache)
        both = Running(["tee", folder / "truth", folder / "scene.jsonl"], scene.stdout, subprocess.PIPE, cache)
        eye = Running(["avdetect-video", *at], both.stdout, seen, cache)
        sound = Running(["avsim-audio", *at, folder / "truth"], None, subprocess.PIPE, cache)
        ear = Running(["avdetect-audio", *at], sound.stdout, heard, cache)
        spent = {one.name: one.cpu_s() for one in (scene, both, eye, sound, ear)}
    tracker = Running(["avfuse", *at, folder / "a.jsonl", folder / "v.jsonl"], None, subprocess.PIPE, cache)
    truth = folder / "groundtruth_sources.jsonl"
    score = Running(["aveval", truth, "-"], tracker.stdout, subprocess.DEVNULL, cache)
    spent |= {one.name: one.cpu_s() for one in (tracker, score)}
    return spent, time.perf_counter() - begin


def pipe_rows() -> Iterator[Row]:
    """S1 as one pipe, with the least that the machine needs for it; and by `make -j2 s1`."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "s1"
        folder.mkdir()
        spent, wall = pipe(folder, Path(temporary) / "cache")
        del spent["tee"]
        for name, seconds in spent.items():
            yield figure("pipe", "S1", f"avcli {name}", seconds, "S1")
        yield {**figure("pipe", "S1", "avcli, all", sum(spent.values()), "S1"), "wall_s": wall}
        for name, (seconds, what) in limits(folder).items():
            yield {**figure("pipe", "S1, the least", name, seconds, "S1"), "what": what}
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
        pipe(folder, cache)
        for name in ("v.jsonl", "scene.jsonl", "groundtruth_sources.jsonl"):
            lines = (folder / name).read_text().splitlines(keepends=True)
            (folder / f"one-{name}").write_text("".join(lines[:1]))
        at = ("-C", folder)
        truth = folder / "one-groundtruth_sources.jsonl"
        work: dict[str, list[object]] = {
            "avsim-scene": ["s1", "-C", folder / "other", "--no-video"],
            "avsim-audio": [*at, truth],
            "avdetect-audio": [],  # it waits for whole windows of sound: the pipe measures it
            "avdetect-video": [*at, folder / "one-scene.jsonl"],
            "avfuse": [*at, folder / "one-v.jsonl"],
            "aveval": [truth, truth],
            "avcalib": ["check", folder / "config.json"],
            "avview": [truth, "--html", folder / "page.html"],
        }
        for name, options in work.items():
            cases: dict[str, list[object]] = {"--help": ["--help"], "the least": options}
            for case, given in cases.items():
                if not given:
                    continue
                spent = min(Running([name, *given], None, subprocess.DEVNULL, cache).cpu_s() for _ in range(3))
                yield figure("start", case, f"avcli {name}", spent, "start")
                shutil.rmtree(folder / "other", ignore_errors=True)
