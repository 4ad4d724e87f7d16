"""One experiment as one pipe with raw frames: wall time beside the time that it simulates, and each stage's share.

    make bench-pipe [BENCH_FLAGS="--scenario s1 --runs 3"]

Writes pipe.md and pipe.jsonl into --out. The stages run at the same time and read each other's output as it comes:

    avsim-scene s1 --frames npy | tee truth | avdetect-video >v &
    avsim-audio --chunk 0.5 truth | avdetect-audio >a &
    avfuse a v | aveval out/s1/groundtruth_sources.jsonl -

truth, a and v are fifos. Nothing is kept from an earlier run: the cache of rooms is empty, and with --compile that of
the driver's shaders too. The wall time means something on a quiet machine alone; CPU times of two versions can be
compared on a busy one, if their runs take turns.

A virtual machine often gets its memory from its host only when it is first used, and gives it back some seconds after
it is freed. A page that is used anew then costs ten times what writing it costs, and a run writes 425 MB of frames. So
a run begins with memory that the machine has: it is written and freed just before, as memory of a process and as pages
of files, which the kernel takes from other places. --fresh leaves that out. What 1 GB of a process costs for the first
time and again is printed.
"""

import argparse
import json
import mmap
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

BIN = Path(sys.executable).parent
CHUNK_S = 0.5
"""s of sound that is heard at once."""
HELD_BYTES = 3 << 29
"""What a run needs at most: its frames, and the memory of the six stages."""
FRAME_BYTES, FRAMES = 5 << 20, 96
"""What the frames of a run take at most, as files."""
STAGES = ("avsim-scene", "avsim-audio", "avdetect-audio", "avdetect-video", "avfuse", "aveval")


def hold_memory(directory: Path) -> tuple[float, float]:
    """Write and free the memory of a run, and its files; the CPU s of 1 GB when it was first written, and again."""
    took = []
    for _ in range(2):
        with mmap.mmap(-1, HELD_BYTES) as memory:
            begin = time.process_time()
            for page in range(0, HELD_BYTES, mmap.PAGESIZE):
                memory[page] = 1
            took.append((time.process_time() - begin) / HELD_BYTES * 1e9)
    held = [directory / str(k) for k in range(FRAMES)]
    for file in held:
        file.write_bytes(bytes(FRAME_BYTES))
    for file in held:
        file.unlink()
    return took[0], took[1]


def run_pipe(scenario: str, directory: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Run one experiment as a pipe in an empty directory.

    Returns:
        The wall time, the CPU time of each stage, s, and the metrics.

    Raises:
        RuntimeError: a stage failed.
    """
    out, fifos = directory / "out", {name: directory / name for name in ("truth", "a", "v")}
    for fifo in fifos.values():
        os.mkfifo(fifo)
    held = {name: os.open(fifo, os.O_RDWR) for name, fifo in fifos.items()}  # no stage waits for another to open it
    writer = {"avsim-scene": "truth", "avdetect-audio": "a", "avdetect-video": "v"}
    started: dict[int, str] = {}
    kept = []  # a process that is forgotten is waited for elsewhere

    def start(name: str, *options: object, stdin: Any = None, stdout: Any = subprocess.PIPE) -> Any:
        program = [BIN / name, "-q"] if name in STAGES else [name]
        process = subprocess.Popen(list(map(str, [*program, *options])), stdin=stdin, stdout=stdout, env=environment)
        started[process.pid] = name
        kept.append(process)
        if stdin is not None:
            stdin.close()
        return process.stdout

    begin = time.perf_counter()
    experiment = "-C", out
    frames = start("tee", fifos["truth"], stdin=start("avsim-scene", scenario, *experiment, "--frames", "npy"))
    sound = start("avsim-audio", *experiment, "--chunk", CHUNK_S, fifos["truth"])
    start("avdetect-audio", *experiment, stdin=sound, stdout=held["a"])
    start("avdetect-video", *experiment, stdin=frames, stdout=held["v"])
    tracks = start("avfuse", *experiment, fifos["a"], fifos["v"])
    cpu, score = dict.fromkeys(STAGES, 0.0), None
    while started:
        pid, status, used = os.wait4(-1, 0)
        name = started.pop(pid)
        if status:
            raise RuntimeError(f"{name} failed")
        if name in cpu:
            cpu[name] = used.ru_utime + used.ru_stime
        if name in writer:
            os.close(held[writer[name]])
        if name == "avsim-scene":  # the ground truth is there as a whole
            score = start("aveval", out / "groundtruth_sources.jsonl", "-", "--format", "jsonl", stdin=tracks)
    wall_s = time.perf_counter() - begin
    assert score is not None  # avsim-scene has ended
    hota = json.loads(score.readline())["summary"]["HOTA"]
    return {"scenario": scenario, "wall_s": wall_s, "cpu_s": cpu, "HOTA": hota}


def as_table(runs: list[dict[str, Any]], simulated_s: float) -> str:
    """The medians of several runs as a Markdown table."""
    wall = statistics.median(run["wall_s"] for run in runs)
    walls = ", ".join(f"{run['wall_s']:.2f}" for run in runs)
    cpu = {stage: statistics.median(run["cpu_s"][stage] for run in runs) for stage in STAGES}
    total = sum(cpu.values())
    rows = [f"| {stage} | {seconds:.2f} | {100 * seconds / total:.0f} |" for stage, seconds in cpu.items()]
    return "\n".join(
        [
            f"{runs[0]['scenario']}, {simulated_s:g} s, as one pipe with raw frames: {wall:.2f} s of wall time, "
            f"{wall / simulated_s:.2f} times what it simulates, on {os.cpu_count()} cores; median of {len(runs)} "
            f"({walls}). {_of_memory(runs)}",
            "",
            "| stage | CPU s | share, % |",
            "|---|---|---|",
            *rows,
            f"| all | {total:.2f} | 100 |",
            "",
        ]
    )


def _of_memory(runs: list[dict[str, Any]]) -> str:
    first, again = (statistics.median(run["memory_s_per_gb"][k] for run in runs) for k in (0, 1))
    if not first:
        return "Memory as the machine had it."
    return f"1 GB of memory took {first:.2f} CPU s at first and {again:.2f} again; it was held before each run."


def main() -> None:
    """Run the pipe several times and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--scenario", default="s1")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--fresh", action="store_true", help="do not write the memory of a run before it")
    parser.add_argument("--compile", action="store_true", help="let the driver compile the shaders in every run")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    shaders = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    runs, simulated_s = [], 0.0
    for _ in range(options.runs):
        with tempfile.TemporaryDirectory(prefix="avcli-pipe-") as name:
            first, again = (0.0, 0.0) if options.fresh else hold_memory(Path(name))
            cache = {"XDG_CACHE_HOME": name, "MESA_SHADER_CACHE_DIR": name if options.compile else shaders}
            runs.append(run_pipe(options.scenario, Path(name), {**os.environ, **cache}))
            runs[-1] |= {"memory_s_per_gb": [first, again]}
            truth = (Path(name) / "out/groundtruth_sources.jsonl").read_bytes().splitlines()
            simulated_s = float(json.loads(truth[-1])["timestamp"])
    (options.out / "pipe.jsonl").write_text("".join(json.dumps(run) + "\n" for run in runs))
    (options.out / "pipe.md").write_text(table := as_table(runs, simulated_s))
    sys.stdout.write(table)


if __name__ == "__main__":
    main()
