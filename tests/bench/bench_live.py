"""Latency of each filter, and of the whole graph from sample to track, with input in real time.

    make bench-live [BENCH_FLAGS="--seconds 60 --hogs 4 --experiment out/s1"]

Writes live.md and live.jsonl into --out. The pictures and the sound of S1 are sent again and again, 10 pictures a
second and the sound in pieces of 20 ms, each when it is due. The latency of a result is the time at which its line
comes out, less the time at which what it is about was due at the input: for a track, the time from light and sound to
the line. All is measured twice: alone, and beside --hogs processes that do nothing but compute.
"""

import argparse
import contextlib
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any

import soundfile

BIN = Path(sys.executable).parent
RATE = 10.0
"""Hz of the pictures."""
PIECE = 0.02
"""s of sound that are sent at once."""
STARTED = 2.0
"""s; what is about an earlier time waits for the start of the processes, and does not count."""
LEAD = 3.0
"""s between the start of the processes and the first input."""

Due = tuple[float, bytes]
"""s after the beginning at which something is due, and its bytes."""


@dataclass
class Case:
    """One way of running something, and what came of it.

    Attributes:
        name: what runs.
        load: what runs beside it.
        sent: how many results are due.
        latencies: s, of the results about times after `STARTED`.
        first: s, of the first result, which waits for the start where that takes longer than `LEAD`.
        out: how many results came.
        said: the warnings about what was skipped.
    """

    name: str
    load: str
    sent: int
    latencies: list[float] = field(default_factory=list)
    first: float = float("nan")
    out: int = 0
    said: str = ""

    def row(self) -> dict[str, Any]:
        """Sum up as one row of the table."""
        late = self.latencies or [float("nan")]
        return {
            "what": self.name,
            "load": self.load,
            "due": self.sent,
            "out": self.out,
            "first_ms": 1000 * self.first,
            "median_ms": 1000 * statistics.median(late),
            "worst_ms": 1000 * max(late),
            "said": self.said,
        }


# --- input in real time -----------------------------------------------------------------------------------------------


class Experiment:
    """The records and the sound of a short experiment, repeated to any length."""

    def __init__(self, folder: Path, seconds: float):
        self.folder, self.steps = folder, round(seconds * RATE)
        self.scene = _records(folder / "scene.jsonl")
        audio = next(record for record in _records(folder / "audio.jsonl") if "audio" in record)["audio"]
        self.fs = audio["sample_rate_hz"]
        samples, _ = soundfile.read(folder / audio["path"], dtype="int16", always_2d=True)
        self.samples = samples[: audio["num_samples"] - audio["tail_samples"]]

    def repeated(self, records: list[dict[str, Any]]) -> Iterator[Due]:
        """Yield records again and again, each at its new time."""
        for step in range(self.steps):
            record = dict(records[step % len(records)], timestamp=f"{step / RATE:.10f}")
            yield step / RATE, json.dumps(record).encode() + b"\n"

    def frames(self) -> Iterator[Due]:
        """Yield frame records."""
        return self.repeated([{"timestamp": 0, "frame": record["frame"]} for record in self.scene])

    def truth(self) -> Iterator[Due]:
        """Yield ground truth."""
        return self.repeated([{"objects": record["objects"]} for record in self.scene])

    def sound(self) -> Iterator[Due]:
        """Yield a WAV without end; a piece is due when its last sample is."""
        channels = self.samples.shape[1]
        layout = [16, 1, channels, self.fs, 2 * channels * self.fs, 2 * channels, 16]
        sizes = [4, 2, 2, 4, 4, 2, 2]
        form = b"".join(value.to_bytes(size, "little") for value, size in zip(layout, sizes, strict=True))
        yield 0.0, b"RIFF\xff\xff\xff\xffWAVEfmt " + form + b"data\xff\xff\xff\xff"
        piece, place = round(PIECE * self.fs), 0
        while place / self.fs < self.steps / RATE:
            begin = place % (len(self.samples) // piece * piece)
            place += piece
            yield place / self.fs, self.samples[begin : begin + piece].astype("<i2").tobytes()


def _records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_bytes().splitlines()]


def send(begin: float, items: Iterable[Due], stream: IO[bytes]) -> None:
    """Write each when it is due, counted from a monotonic time `begin`, and close the stream."""
    with contextlib.suppress(BrokenPipeError), stream:
        for due, content in items:
            time.sleep(max(0.0, begin + due - time.monotonic()))
            stream.write(content)
            stream.flush()


@contextlib.contextmanager
def hogs(count: int) -> Iterator[None]:
    """Run processes that compute."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


# --- what is measured -------------------------------------------------------------------------------------------------


def start(*command: str | Path, **words: Any) -> subprocess.Popen[bytes]:
    """Start one of our commands with pipes around it."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([BIN / command[0], *command[1:]], **{**pipes, **words})


def measure(case: Case, last: subprocess.Popen[bytes], sources: list[tuple[IO[bytes], Iterable[Due]]]) -> Case:
    """Send all sources in real time and note when each record of the last process comes out."""
    begin = time.monotonic() + LEAD
    senders = [threading.Thread(target=send, args=(begin, items, stream)) for stream, items in sources]
    for sender in senders:
        sender.start()
    assert last.stdout
    for line in last.stdout:
        now, record = time.monotonic() - begin, json.loads(line)
        about = float(record["timestamp"])
        if audio := record.get("audio"):  # of a piece of sound, its end
            about += audio["num_samples"] / audio["sample_rate_hz"]
        if not case.out:
            case.first = now - about
        case.out += 1
        if about >= STARTED:
            case.latencies.append(now - about)
    for sender in senders:
        sender.join()
    return case


def words(*processes: subprocess.Popen[bytes]) -> str:
    """Wait for processes and return what they said, in one line."""
    texts = []
    for process in processes:
        texts.append(process.stderr.read().decode() if process.stderr else "")
        process.wait()
    return "; ".join(text for text in " ".join(texts).splitlines() if "skipped" in text or "error" in text)


def one_filter(name: str, load: str, made: Experiment, items: Iterable[Due], *command: str | Path) -> Case:
    """Measure one filter."""
    process = start(*command)
    assert process.stdin
    case = measure(Case(name, load, made.steps), process, [(process.stdin, items)])
    case.said = words(process)
    return case


def graph(name: str, load: str, made: Experiment, live: list[str], folder: Path) -> Case:
    """Measure the graph: pictures and sound in, both detectors, fusion, tracks out."""
    folder.mkdir()
    for fifo in ("audio", "video"):
        os.mkfifo(folder / fifo)
    options: list[str | Path] = ["-C", made.folder]
    pipes: dict[str, Any] = {"stdout": subprocess.DEVNULL}
    fuse = start("avfuse", *options, *live, folder / "audio", folder / "video", stdin=subprocess.DEVNULL)
    hear = start("avdetect-audio", *options, *live, "-o", folder / "audio", **pipes)
    see = start("avdetect-video", *options, *live, "-o", folder / "video", **pipes)
    assert hear.stdin
    assert see.stdin
    case = measure(Case(name, load, made.steps), fuse, [(hear.stdin, made.sound()), (see.stdin, made.frames())])
    case.said = words(hear, see, fuse)
    return case


def cases(
    made: Experiment, found: list[dict[str, Any]], load: str, folder: Path
) -> Iterator[tuple[str, Callable[[str], Case]]]:
    """Yield what can be measured under one load: its name, and what measures it; `found` are detections by time."""
    options: list[str | Path] = ["-C", made.folder]

    def detections() -> Iterator[Due]:
        for due, line in made.repeated(found):
            for record in json.loads(line)["both"]:
                yield due, json.dumps({**record, "timestamp": f"{due:.10f}"}).encode() + b"\n"

    def of(items: Callable[[], Iterable[Due]], *command: str | Path) -> Callable[[str], Case]:
        return lambda name: one_filter(name, load, made, items(), *command)

    sound = folder / f"sound {load}"
    sound.mkdir()
    (sound / "config.json").write_bytes((made.folder / "config.json").read_bytes())
    yield "avsim-audio --chunk 1", of(made.truth, "avsim-audio", "-C", sound, "--chunk", "1")
    ways: list[tuple[str, list[str]]] = [("", []), (" --live", ["--live"])]
    for title, live in ways:
        yield f"avdetect-audio{title}", of(made.sound, "avdetect-audio", *options, *live)
    for title, live in ways:
        yield f"avdetect-video{title}", of(made.frames, "avdetect-video", *options, *live)
    for title, live in ways:
        see = ["avdetect-video", *options, *live, "--detector", "depth"]
        yield f"avdetect-video{title} --detector depth", of(made.frames, *see)
    for title, live in ways:
        yield f"avfuse{title}", of(detections, "avfuse", *options, *live)
    for title, live in ways:
        yield (
            f"the graph{title}",
            partial(graph, load=load, made=made, live=live, folder=folder / f"graph {load}{title}"),
        )


def simulated(folder: Path) -> Path:
    """Simulate S1."""
    scene, audio = folder / "scene.jsonl", folder / "audio.jsonl"
    subprocess.run([BIN / "avsim-scene", "s1", "-C", folder, "-o", scene], check=True)
    subprocess.run([BIN / "avsim-audio", "-C", folder, scene, "-o", audio], check=True)
    return folder


def detected(folder: Path) -> list[dict[str, Any]]:
    """Return the detections of both sensors for each time step of an experiment."""
    found: dict[str, list[dict[str, Any]]] = {}
    sources = {"avdetect-audio": "audio.jsonl", "avdetect-video": "scene.jsonl"}
    for name, source in sources.items():
        lines = subprocess.run([BIN / name, "-C", folder, folder / source], check=True, capture_output=True).stdout
        for line in lines.splitlines():
            record = json.loads(line)
            found.setdefault(record["timestamp"], []).append(record)
    return [{"both": both} for both in found.values() if len(both) == 2]


def table(rows: list[dict[str, Any]], load: tuple[float, ...]) -> str:
    """Return the rows as Markdown."""
    lines = [
        f"Latency in ms, {os.cpu_count()} cores; load average at the end {', '.join(f'{one:.1f}' for one in load)}.",
        "",
        "| what | load | results due | out | first | median | worst | it said |",
        "|---|---|---:|---:|---:|---:|---:|---|",
    ]
    for row in rows:
        numbers = " | ".join(f"{row[key]:.0f}" for key in ("due", "out", "first_ms", "median_ms", "worst_ms"))
        lines.append(f"| {row['what']} | {row['load']} | {numbers} | {row['said']} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure all cases and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the input")
    parser.add_argument("--hogs", type=int, default=2 * (os.cpu_count() or 1), help="processes that compute beside")
    parser.add_argument("--experiment", type=Path, help="a finished experiment instead of a new S1")
    parser.add_argument("--only", default="", help="cases whose names match this regular expression")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        made = Experiment(options.experiment or simulated(folder), options.seconds)
        found = detected(made.folder)
        for load, count in (("alone", 0), (f"{options.hogs} hogs", options.hogs)):
            with hogs(count):
                for name, run in cases(made, found, load, folder):
                    if not re.search(options.only, name):
                        continue
                    rows.append(run(name).row())
                    print(json.dumps(rows[-1]), file=sys.stderr)
    text = table(rows, os.getloadavg())
    print(text)
    (options.out / "live.md").write_text(text)
    (options.out / "live.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


if __name__ == "__main__":
    main()
