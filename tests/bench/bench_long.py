"""Time per record and memory of each filter over an hour: both must stay flat.

    make bench-long [BENCH_FLAGS="--minutes 60 --only avfuse"]

Writes long.md and long.jsonl into --out. Two people walk and talk for an hour, 10 records a second of each sensor. A
filter's CPU time and resident memory are read whenever another tenth of its results has come out. The detections that
avfuse gets are made from the truth, with noise, misses and false ones; the detectors see small pictures and hear sound
of 16 kHz, a few seconds of which are repeated. aveval gives its result at the end: it runs on a tenth, half and all.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from detection_people import KB8, cast, ceiling_view
from localization_rooms import MICROPHONES, heard, noisy, voice
from tracking_scenes import ROOM, waypoints

from avcli.formats import media

BIN = Path(sys.executable).parent
RATE = 10.0
FS = 16000
TICKS = os.sysconf("SC_CLK_TCK")
SHARES = (0.1, 0.2, 0.5, 0.6, 0.9, 0.99)
"""Shares of the results after which time and memory are read; the process is still there after the last one."""


def spent(process: subprocess.Popen[bytes]) -> tuple[float, float]:
    """Return a process's CPU time in s and its resident memory in MB."""
    stat = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    status = Path(f"/proc/{process.pid}/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return (int(stat[11]) + int(stat[12])) / TICKS, int(resident.split()[1]) / 1e3


def watched(
    count: int, *command: str | Path, source: Path | None = None, sent: Iterable[bytes] = (), keep: Path | None = None
) -> dict[str, Any]:
    """Run one of our commands and watch it.

    Args:
        count: how many records will come out.
        command: its name and options.
        source: a file for its standard input.
        sent: else, what to write there.
        keep: a file for its records.
    """
    marks = [int(share * count) for share in SHARES]
    stdin: Any = open(source, "rb") if source else subprocess.PIPE  # noqa: SIM115 - closed with the process
    process = subprocess.Popen([BIN / command[0], *command[1:]], stdin=stdin, stdout=subprocess.PIPE)
    if process.stdin:
        threading.Thread(target=feed, args=(process.stdin, sent), daemon=True).start()
    assert process.stdout
    found, number = [], 0
    with open(keep or os.devnull, "wb") as out:
        for line in process.stdout:
            out.write(line)
            number += 1
            if number in marks:
                found.append(spent(process))
    if process.wait() or number != count:
        raise SystemExit(f"{command[0]}: exit {process.returncode}, {number} of {count} records")
    times, memory = [one[0] for one in found], [one[1] for one in found]
    pieces = [1000 * (times[k + 1] - times[k]) / (marks[k + 1] - marks[k]) for k in (0, 2, 4)]
    return {"records": count, "ms": pieces, "mb": [memory[0], memory[2], memory[5]]}


def feed(stream: Any, sent: Iterable[bytes]) -> None:
    """Write everything and close the stream."""
    with stream:
        for content in sent:
            stream.write(content)


# --- an hour of input -------------------------------------------------------------------------------------------------


def scenario(seconds: float, rng: np.random.Generator) -> dict[str, Any]:
    """Two people who walk between random places and talk in turn."""
    times = np.arange(0.0, seconds, 2.0)
    people = []
    for number in range(2):
        path = waypoints(rng, times)
        path[:, 0] = 0.45 * path[:, 0] + number * 2.25  # each in a half of the room, so that they never meet
        points = [{"t_s": t, "position_m": p} for t, p in zip(times.tolist(), path.round(3).tolist(), strict=True)]
        speech = [[t, t + 7] for t in np.arange(10.0 * number, seconds - 8, 20.0).tolist()]
        people.append({"object_id": number, "waypoints": points, "speech_s": speech})
    room = {"room_dimensions_m": [ROOM, ROOM, 3.0], "reverberation_time_s": 0.2}
    microphones = {"audio_sample_rate_hz": FS, "mic_positions_m": MICROPHONES.tolist()}
    return {"duration_s": seconds, "people": people, "room_config": room, "microphone_config": microphones}


def detections(truth: Path, sensor: str, kind: str, sigma: float, rng: np.random.Generator) -> Iterator[bytes]:
    """Detections as a sensor might give them: noise, one in ten missed, one false one in fifty records."""
    for line in truth.read_bytes().splitlines():
        record = json.loads(line)
        seen = [one["position"] for one in record["objects"] if kind == "camera" or one.get("speaking")]
        places = [[*(np.array(place[:2]) + rng.normal(0, sigma, 2)), 1.2] for place in seen if rng.random() < 0.9]
        if rng.random() < 0.02:
            places.append([*rng.uniform(0, ROOM, 2), 1.2])
        variance = np.diag([sigma**2, sigma**2, 0.1]).tolist()
        objects = [{"position": place, "covariance": variance, "score": 0.9} for place in places]
        stated = {"timestamp": record["timestamp"], "sensor": sensor, "kind": kind, "objects": objects}
        yield json.dumps(stated, default=float).encode() + b"\n"


def pictures(folder: Path, count: int) -> Path:
    """Write twenty small pictures of somebody who walks, a config.json, and records that show them again and again."""
    view = ceiling_view(4)
    fx, fy, cx, cy, *k = KB8
    camera = {
        "lens_model": "kannala_brandt",
        "fx_px": fx / 4, "fy_px": fy / 4, "cx_px": (cx - 1.5) / 4, "cy_px": (cy - 1.5) / 4,
        "k1": k[0], "k2": k[1], "k3": k[2], "k4": k[3],
        "image_width_px": 480, "image_height_px": 270, "frame_rate_hz": RATE, "camera_position_m": [2.33, 2.33, 2.5],
        "camera_rotation_deg": [90, 0, 0], "depth_step_m": 1e-4, "background_depth": "empty.png",
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps({"camera_config": camera}))
    rng = np.random.default_rng(0)
    for number in range(-1, 20):
        depth = cast(view, [(1.2 + 0.1 * number, 2.0, 0.0, 0.3, 1.75)] if number >= 0 else [])
        media.write_png(folder / f"{'empty' if number < 0 else number}.png", np.rint(depth * 1e4).astype(np.uint16))
        grey = (depth * 60 + rng.normal(0, 2, depth.shape)).clip(0, 255).astype(np.uint8)
        media.write_png(folder / f"rgb{number}.png", np.repeat(grey[..., None], 3, axis=2))
    path = folder / "frames.jsonl"
    with open(path, "w") as file:
        for step in range(count):
            shown = {"rgb": f"rgb{step % 20}.png", "depth": f"{step % 20}.png"}
            file.write(json.dumps({"timestamp": step / RATE, "frame": shown}) + "\n")
    return path


def sound(seconds: float) -> Iterator[bytes]:
    """A WAV without end in which somebody talks for three of every four seconds."""
    rng = np.random.default_rng(0)
    samples = noisy(heard(np.array([3.1, 1.3, 1.6]), voice(3.0, FS, rng), FS), 30, rng)
    piece = np.concatenate([samples, 1e-4 * rng.standard_normal((4 * FS - len(samples), samples.shape[1]))])
    content = np.rint(piece / np.abs(piece).max() * 20000).astype("<i2")
    channels = content.shape[1]
    yield b"RIFF\xff\xff\xff\xffWAVEfmt \x10\0\0\0\1\0" + channels.to_bytes(2, "little") + FS.to_bytes(4, "little")
    yield (2 * FS * channels).to_bytes(4, "little") + (2 * channels).to_bytes(2, "little") + b"\x10\0data" + b"\xff" * 4
    for _ in range(round(seconds / 4)):
        yield content.tobytes()


# --- what is watched --------------------------------------------------------------------------------------------------


def scored(truth: Path, tracks: Path, count: int, folder: Path) -> dict[str, Any]:
    """Run aveval on a tenth, half and all of the records."""
    times, memory = [], []
    for share in (0.1, 0.5, 1.0):
        parts = []
        for path in (truth, tracks):
            parts.append(folder / f"{path.stem}_{share}.jsonl")
            with open(path, "rb") as file:
                parts[-1].write_bytes(b"".join(islice(file, int(share * count))))
        process = subprocess.Popen([BIN / "aveval", *parts], stdout=subprocess.DEVNULL)
        _, _, used = os.wait4(process.pid, 0)
        process.returncode = 0
        times.append(1000 * (used.ru_utime + used.ru_stime) / (share * count))
        memory.append(used.ru_maxrss / 1e3)
    return {"records": count, "ms": times, "mb": memory}


def cases(folder: Path, minutes: float) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Yield what can be watched: its name, and what watches it. Later cases read what the first two write."""
    seconds, rng = 60.0 * minutes, np.random.default_rng(0)
    count = round(seconds * RATE) + 1
    scene, tracks, audio, video = (folder / f"{name}.jsonl" for name in ("scene", "tracks", "audio", "video"))
    (folder / "hour.json").write_text(json.dumps(scenario(seconds, rng)))
    simulate: list[str | Path] = ["avsim-scene", folder / "hour.json", "-C", folder, "--no-video"]
    yield "avsim-scene --no-video", lambda: watched(count, *simulate, keep=scene)
    if not audio.exists():
        audio.write_bytes(b"".join(detections(scene, "audio", "microphones", 0.2, rng)))
        video.write_bytes(b"".join(detections(scene, "video", "camera", 0.1, rng)))
    fuse: list[str | Path] = ["avfuse", "-C", folder, audio, video]
    yield "avfuse", lambda: watched(count, *fuse, keep=tracks)
    yield "avfuse --lag 5", lambda: watched(count, *fuse, "--lag", "5")
    yield "aveval", lambda: scored(scene, tracks, count, folder)
    small = folder / "small"
    small.mkdir()
    frames = pictures(small, count - 1)
    see: list[str | Path] = ["avdetect-video", "-C", small]
    yield "avdetect-video --detector depth", lambda: watched(count - 1, *see, "--detector", "depth", source=frames)
    yield "avdetect-video", lambda: watched(count - 1, *see, source=frames)
    chunks: list[str | Path] = ["avsim-audio", "-C", folder, "--chunk", "1"]
    yield "avsim-audio --chunk 1", lambda: watched(int(seconds) + 1, *chunks, source=scene)
    listen: list[str | Path] = ["avdetect-audio", "-C", folder, "-"]
    yield "avdetect-audio", lambda: watched(40 * round(seconds / 4) + 1, *listen, sent=sound(seconds))


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "CPU time per record in ms and resident memory in MB, near the begin, the middle and the end of the records.",
        "",
        "| filter | records out | ms: 10 to 20 % | 50 to 60 % | 90 to 99 % | MB at 10 % | at 50 % | at 99 % |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        ms, mb = " | ".join(f"{one:.2f}" for one in row["ms"]), " | ".join(f"{one:.0f}" for one in row["mb"])
        lines.append(f"| {row['what']} | {row['records']} | {ms} | {mb} |")
    return (
        "\n".join(lines) + "\n\naveval: the whole run on 10 %, 50 % and 100 % of the records, with its peak memory.\n"
    )


def main() -> None:
    """Watch all filters and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the recording")
    parser.add_argument("--only", default="", help="filters whose names match this regular expression")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for number, (name, watch) in enumerate(cases(Path(temporary), options.minutes)):
            if number and not re.search(options.only, name):  # the first case writes what the others read
                continue
            rows.append({"what": name, **watch()})
            print(json.dumps(rows[-1]), file=sys.stderr)
    text = table(rows)
    print(text)
    (options.out / "long.md").write_text(text)
    (options.out / "long.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


if __name__ == "__main__":
    main()
