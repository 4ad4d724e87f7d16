"""The machine that a benchmark runs on, and a small fixed workload by which times of two machines can be compared."""

import os
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import fft, linalg

PACKAGES = ("avcli", "numpy", "scipy", "opencv-contrib-python-headless", "onnxruntime", "moderngl", "soundfile")
ROUNDS = 3


def described() -> dict[str, Any]:
    """Return processor, number of CPUs, memory, system, load, and versions."""
    return {
        "processor": _first(Path("/proc/cpuinfo"), "model name") or platform.processor() or platform.machine(),
        "cpus": len(os.sched_getaffinity(0)),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.release().split('-')[0]}",
        "load": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def reference() -> dict[str, float]:
    """Return CPU s of each part of the reference workload, the least of some rounds, and of all parts ("all").

    arithmetic: LU factors of a matrix of 400 × 400, 40 times, and a small product 40,000 times. fft: 60 real transforms
    of 2¹⁸ samples. memory: 32 copies of 64 MB. png: 6 pictures of 960 × 540. interpreter: 3,000,000 turns of a loop.
    The parts are what the stages spend their time on; all of it is float64 on one thread, and nothing of it is ours.
    """
    rng = np.random.default_rng(0)
    square, small = rng.standard_normal((400, 400)), rng.standard_normal((6, 6))
    sound, memory = rng.standard_normal(1 << 18), np.zeros(1 << 23)
    y, x = np.mgrid[:540, :960]
    smooth = 128 + 60 * np.sin(x / 37) + 40 * np.cos(y / 23 + x / 91)
    picture = (smooth[..., None] + rng.integers(-3, 4, (540, 960, 3))).astype(np.uint8)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)

    def arithmetic() -> None:
        for _ in range(40):
            linalg.lu_factor(square)
        for _ in range(40_000):
            small @ small

    def transforms() -> None:
        for _ in range(60):
            fft.rfft(sound)

    def copies() -> None:
        for _ in range(32):
            memory.copy()

    def pictures() -> None:
        for _ in range(6):
            cv2.imencode(".png", picture)

    def interpreter() -> None:
        total = 0
        for k in range(3_000_000):
            total += k % 7

    parts = {"arithmetic": arithmetic, "fft": transforms, "memory": copies, "png": pictures, "interpreter": interpreter}
    spent = {name: min(_cpu(part) for _ in range(ROUNDS)) for name, part in parts.items()}
    cv2.setNumThreads(threads)
    return {**spent, "all": sum(spent.values())}


def _cpu(work: Callable[[], None]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin


def _first(path: Path, key: str) -> str:
    try:
        lines = path.read_text().splitlines()
    except OSError:
        return ""
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(key)), "")


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""
