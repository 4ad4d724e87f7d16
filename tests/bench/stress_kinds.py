"""The kinds of trials of `make stress`; each makes an input from a seed, and says how a command took it."""

import copy
import importlib
import json
import math
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import soundfile

from avcli import lens as lenses
from avcli.formats import media
from avcli.scene.scenario import LABORATORY

fuzz: Any = importlib.import_module("test_fuzz")
run: Any = importlib.import_module("forked").run_forked
BIN = Path(sys.executable).parent
OURS = os.fsencode(Path(media.__file__).parents[1])  # is in each line of a traceback that shows avcli's code
REFUSALS, GATE = (1, 2, 3, 74), 3  # a gate that is not met may come with a report
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's "&" ignores it, and children would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)


@dataclass(frozen=True)
class Trial:
    """What was tried, the sentence that refused it ("" none did), and what is wrong with its end ("" nothing)."""

    what: str
    refused: str = ""
    lost: str = ""


# --- how a command ended ----------------------------------------------------------------------------------------------


def not_finite(text: str) -> float:
    """Refuse the numbers that JSON does not have."""
    raise ValueError(f"{text} in the output")


def wrong_records(data: bytes) -> str:
    """Say what is wrong with records: not whole lines, NaN, a covariance that is none, a probability beyond 0 to 1."""
    if data and not data.endswith(b"\n"):
        return "the last line is not whole"
    for number, line in enumerate(data.splitlines(), 1):
        try:
            record = json.loads(line, parse_constant=not_finite)
        except ValueError as error:
            return f"line {number}: {error}"
        for one in record.get("objects", []):
            spread = np.array(one.get("covariance", np.eye(3)), float)
            if not (np.array_equal(spread, spread.T) and (np.linalg.eigvalsh(spread) >= 0).all()):
                return f"line {number}: a covariance that is not positive: {spread.tolist()}"
            chances = [one[key] for key in ("existence", "score", "speaking") if isinstance(one.get(key), float)]
            if not all(0 <= chance <= 1 for chance in chances):
                return f"line {number}: a probability of {chances}"
    return ""


DECODERS = ("libpng ", "Corrupt JPEG data", "Premature end of JPEG", "Invalid SOS parameters")
"""How lines begin that libpng and libjpeg write for damaged pictures, beside ours."""


def ended(
    command: str, arguments: Sequence[object], folder: Path, stdin: bytes = b"", **how: Any
) -> tuple[Trial, bytes]:
    """Run a command with its output in folder/out.jsonl; return how it ended, and what it wrote."""
    output = folder / "out.jsonl"
    output.unlink(missing_ok=True)
    shown = f"{command} {' '.join(map(str, arguments))}"
    try:
        end = run(command, *arguments, "-o", output, stdin=stdin, **how)
    except AssertionError as error:
        return Trial(shown, lost=str(error)), b""
    written = output.read_bytes() if output.exists() else b""
    said = end.stderr.splitlines()
    lost = ""
    if end.returncode not in (0, *REFUSALS):
        lost = f"exit {end.returncode}: {end.stderr[-300:]}"
    elif not all(line.startswith((f"{command}: ", *DECODERS)) for line in said):
        lost = f"a line that is none of ours: {end.stderr[:400]}"
    elif end.returncode and not said:
        lost = f"exit {end.returncode} without a word"
    elif end.returncode not in (0, GATE) and written:
        lost = f"exit {end.returncode} with an output"
    elif temporary := [path.name for path in folder.rglob(".*.tmp")]:
        lost = f"left behind: {temporary}"
    elif command != "avcalib":
        lost = wrong_records(written)
    return Trial(shown, said[-1] if end.returncode and said else "", lost), written


# --- files ------------------------------------------------------------------------------------------------------------


def damaged(chance: random.Random, data: bytes) -> bytes:
    """Flip bits, cut, drop, repeat, exchange, or overwrite some of the bytes."""
    out = bytearray(data)
    kind = chance.randrange(7)
    first, second = sorted(chance.randrange(len(out) + 1) for _ in range(2))
    if kind in (0, 1):
        for _ in range(chance.choice([1, 1, 4, 64])):
            out[chance.randrange(len(out))] ^= 1 << chance.randrange(8)
    elif kind == 2:
        del out[first:]
    elif kind == 3:
        del out[first:second]
    elif kind == 4:
        out[first:first] = out[first:second]
    elif kind == 5:
        out[first:second] = bytes(second - first)
    else:
        out[first : first + 8] = chance.choice(
            [b"\xff" * 8, b"\0" * 8, b"\r\n", b"\xef\xbb\xbf", b'{"', b"nan", b"[[[["]
        )
    return bytes(out)


def files(seed: int, folder: Path) -> Trial:
    """A file with damaged bytes: records, config.json, scenario, WAV, PNG."""
    chance = random.Random(seed)
    fuzz.made(folder)
    command = chance.choice([*fuzz.FUZZED, "avcalib"])
    if command == "avcalib":
        target = folder / "rgb.png"
        target.write_bytes(damaged(chance, target.read_bytes()))
        return ended("avcalib", ["calibrate", target, folder / "empty.png", "--board", "6x8"], folder)[0]
    documents, options, _ = fuzz.FUZZED[command]
    given = fuzz.lines(documents)
    media_of = {"avdetect-audio": ["a.wav"], "avdetect-video": ["rgb.png", "depth.png", "empty.png"]}
    names = ["", "config.json", *media_of.get(command, [])] if command != "avsim-scene" else [""]
    name = chance.choice(names)
    if name:
        (folder / name).write_bytes(damaged(chance, (folder / name).read_bytes()))
    else:
        given = damaged(chance, given)
    where = folder / "experiment" if command == "avsim-scene" else folder
    filled = [option.format(truth=folder / "truth.jsonl") for option in options]
    trial, _ = ended(command, ["-C", where, *filled], folder, given)
    return Trial(f"{command}, {name or 'its input'} damaged", trial.refused, trial.lost)


def values(seed: int, folder: Path) -> Trial:
    """One value of the input or of config.json replaced, scaled, left out or put in twice."""
    chance = random.Random(seed)
    fuzz.made(folder)
    command = chance.choice(list(fuzz.FUZZED))
    documents, options, _ = fuzz.FUZZED[command]
    given, config = documents, fuzz.CONFIG
    if chance.random() < 0.5 or command in ("aveval", "avsim-scene"):
        given = fuzz.changed(documents, chance)
    else:
        (config,) = fuzz.changed([fuzz.CONFIG], chance)
    (folder / "config.json").write_bytes(fuzz.lines([config]))
    where = folder / "experiment" if command == "avsim-scene" else folder
    filled = [option.format(truth=folder / "truth.jsonl") for option in options]
    trial, _ = ended(command, ["-C", where, *filled], folder, fuzz.lines(given))
    return Trial(f"{command}, one value changed", trial.refused, trial.lost)


# --- sensors ----------------------------------------------------------------------------------------------------------


def some(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def spread(rng: np.random.Generator, least: float, most: float) -> list[list[float]]:
    """A covariance whose axes are turned at random."""
    axes, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    found = axes @ np.diag([some(rng, least, most) for _ in range(3)]) @ axes.T
    return ((found + found.T) / 2).tolist()


def detections(seed: int, folder: Path) -> Trial:
    """Detections at scales from 1 mm to 10 km, covariances from 1e-12 to 1e12, 0 to 250 a record, to each tracker."""
    rng = np.random.default_rng(seed)
    scale, rate, start = some(rng, 1e-3, 1e4), some(rng, 0.5, 60), float(rng.choice([0, 0, 1.7e9, -1e3, 1e10]))
    most = int(rng.choice([0, 1, 3, 10, 40, 250]))
    least_variance = some(rng, 1e-12, 1e6)
    records = []
    for k in range(max(2, 60 // (most + 1))):
        for sensor, kind in (("audio", "microphones"), ("video", "camera")):
            objects = []
            for _ in range(int(rng.integers(0, most + 1))):
                one: dict[str, Any] = {"position": (rng.uniform(-1, 1, 3) * scale).tolist()}
                if rng.random() < 0.8:
                    one["covariance"] = spread(rng, least_variance, min(least_variance * some(rng, 1, 1e12), 1e12))
                if rng.random() < 0.5:
                    one["score"] = float(rng.choice([0.0, 1e-9, 0.5, 1.0]))
                objects.append(one)
            at = f"{start + k / rate:.10f}"
            records.append({"timestamp": at, "sensor": sensor, "kind": kind, "objects": objects})
    tracker = str(rng.choice(["ms-glmb", "ms-glmb", "lmb", "gnn"]))
    options = ["--tracker", tracker, *(["--lag", "5"] if tracker == "ms-glmb" and rng.random() < 0.3 else [])]
    trial, tracks = ended("avfuse", options, folder, fuzz.lines(records))
    what = f"avfuse --tracker {tracker}, {scale:.1e} m, up to {most}"
    if trial.lost or trial.refused or not tracks:
        return Trial(what, trial.refused, trial.lost)
    (folder / "tracks.jsonl").write_bytes(tracks)
    scored, _ = ended("aveval", [folder / "tracks.jsonl", folder / "tracks.jsonl"], folder)
    lost = scored.lost or ("aveval refuses avfuse's tracks" if scored.refused else "")
    return Trial(f"{what}, then aveval", lost=lost)


def found(rng: np.random.Generator, kind: str, place: np.ndarray, origin: np.ndarray, sd: float) -> dict[str, Any]:
    """A detection of a kind of a place (3,) m by a sensor at an origin (3,) m, with errors of so many m."""
    place = place + rng.normal(0.0, sd, 3)
    away = float(np.linalg.norm(place - origin))
    one: dict[str, Any] = {"score": float(rng.choice([rng.uniform(), 1e-6, 1.0]))} if rng.random() < 0.7 else {}
    if kind == "direction":
        look = ((place - origin) / away).tolist()
        return one | {"origin": origin.tolist(), "direction": look, "direction_sd_deg": some(rng, 0.1, 20)}
    if kind == "distance":
        return one | {"origin": origin.tolist(), "range_m": away, "range_sd_m": sd}
    if kind == "covariance":
        return one | {"position": place.tolist(), "covariance": spread(rng, 0.1 * sd**2, 10 * sd**2)}
    return one | {"position": [*place[:2].tolist(), None if kind == "floor" else float(place[2])]}


def walkers(seed: int, folder: Path) -> Trial:
    """People who come and go past sensors of every kind, which see too much and too little; with many options."""
    rng = np.random.default_rng(seed)
    room, lasts = np.array([8.0, 6.0, 2.0]) * rng.choice([1, 1, 1, 50]), float(rng.uniform(3, 15))
    people = [
        (rng.uniform(0, room), [*rng.normal(0, 0.7, 2), 0.0], begin, begin + rng.uniform(1, 20))
        for begin in rng.uniform(-5, 0.6 * lasts, int(rng.choice([0, 1, 1, 2, 3, 5, 10])))
    ]
    start, records = float(rng.choice([0, 0, 1.7e9, -5])), list[dict[str, Any]]()
    for number in range(int(rng.integers(1, 5))):
        rate, sd, chance = float(rng.choice([1, 5, 10, 12.5, 29.97, 60])), some(rng, 0.005, 1.5), rng.uniform(0.1, 1)
        kinds = ["position", "covariance", "floor", "direction", "distance"]
        kind, clutter = str(rng.choice([*kinds, "any"])), rng.choice([0, 0, 0.2, 2])
        origin, blind = rng.uniform(0, room), np.sort(rng.uniform(0, 2 * lasts, 2))
        for at in np.arange(rng.uniform(0, 1 / rate), lasts, 1 / rate):
            if blind[0] < at < blind[1]:
                continue
            there = [first + at * np.array(pace) for first, pace, begin, end in people if begin < at < end]
            seen = [place for place in there if rng.random() < chance]
            seen += [rng.uniform(-0.5, room + 0.5) for _ in range(rng.poisson(clutter))]
            objects = [found(rng, str(rng.choice(kinds)) if kind == "any" else kind, x, origin, sd) for x in seen]
            records.append({"timestamp": f"{start + at:.10f}", "sensor": f"s{number}", "objects": objects})
    records.sort(key=lambda record: float(record["timestamp"]))
    ways = ("", "", "--lag 0", "--lag inf", "--no-hidden", "--no-learn", "--rate 10", "--tracker lmb", "--show all")
    options = str(rng.choice(ways)).split()
    trial, tracks = ended("avfuse", options, folder, fuzz.lines(records))
    (folder / "tracks.jsonl").write_bytes(tracks)
    scored, _ = ended("aveval", [folder / "tracks.jsonl", folder / "tracks.jsonl"], folder)
    lost = trial.lost or trial.refused or scored.lost or (scored.refused if b"object_id" in tracks else "")
    return Trial(f"avfuse {' '.join(options)}, {len(people)} people, {len(records)} records", lost=lost)


def order(seed: int, folder: Path) -> Trial:
    """Records that come twice, or a few places too early or late: the tracks are those of the records in order."""
    rng = np.random.default_rng(seed)
    in_order = []
    for k in range(20):
        for sensor, kind in (("audio", "microphones"), ("video", "camera")):
            place = [1 + 0.1 * k + rng.normal(0, 0.05), 2 + rng.normal(0, 0.05), 1.6]
            objects = [{"position": place, "covariance": (0.01 * np.eye(3)).tolist(), "score": 0.9}]
            in_order.append({"timestamp": f"{k / 10:.10f}", "sensor": sensor, "kind": kind, "objects": objects})
    mixed = list(in_order)
    for k in sorted(rng.choice(len(mixed) - 1, 6, replace=False).tolist(), reverse=True):
        if rng.random() < 0.5:
            mixed.insert(k, copy.deepcopy(mixed[k]))
        else:
            mixed[k], mixed[k + 1] = mixed[k + 1], mixed[k]
    plain, expected = ended("avfuse", [], folder, fuzz.lines(in_order))
    trial, found = ended("avfuse", [], folder, fuzz.lines(mixed))
    lost = plain.lost or trial.lost or ("" if found == expected else "other tracks than in order")
    return Trial("avfuse, repeated and exchanged records", lost=lost)


def sounds(seed: int, folder: Path) -> Trial:
    """Sound of 8 to 192 kHz, 1 to 16 microphones; silence, clipping, NaN, offsets, few samples."""
    rng = np.random.default_rng(seed)
    rate = int(rng.choice([8000, 16000, 22050, 44100, 48000, 96000, 192000]))
    count, samples = int(rng.choice([1, 2, 5, 8, 16])), int(rng.choice([0, 1, 100, 4000, 30000, 90000]))
    kind = str(rng.choice(["noise", "silence", "faint", "clipped", "nan", "infinite", "offset", "same"]))
    wave = rng.standard_normal((samples, count)) * 0.05
    if kind == "same":
        wave[:] = wave[:, :1]
    elif kind in ("nan", "infinite"):
        wave[samples // 2 :] = np.nan if kind == "nan" else np.inf
    elif kind == "offset":
        wave += 0.9
    else:
        wave = np.clip(wave * {"noise": 1, "silence": 0, "faint": 1e-30, "clipped": 1e9}[kind], -1, 1)
    soundfile.write(folder / "a.wav", wave, rate, subtype="DOUBLE")
    size = some(rng, 0.1, 100)
    config = copy.deepcopy(LABORATORY)
    config["room_config"]["room_dimensions_m"] = [size, size, max(size / 2, 0.1)]
    config["microphone_config"]["audio_sample_rate_hz"] = rate
    config["microphone_config"]["mic_positions_m"] = (rng.random((count, 3)) * [size, size, size / 2]).tolist()
    (folder / "config.json").write_text(json.dumps(config))
    method = ["--method", str(rng.choice(["srp", "3d-ssl"]))]
    trial, _ = ended("avdetect-audio", ["-C", folder, folder / "a.wav", *method], folder)
    return Trial(f"avdetect-audio {method[1]}, {rate} Hz, {count} channels, {kind}", trial.refused, trial.lost)


def spoilt(rng: np.random.Generator, wave: np.ndarray, rate: int) -> np.ndarray:
    """Sound (n, m) in which up to three channels are faulty, or all of them hum."""
    wave = wave.copy()
    loudest, count = float(np.abs(wave).max(initial=0.0)) + 1e-6, wave.shape[1]
    for c in rng.choice(count, min(count, int(rng.choice([0, 0, 1, 2, 3]))), replace=False):
        kind, one = rng.choice(["dead", "over", "late", "loud", "clipped", "noise", "shifted", "exchanged"]), wave[:, c]
        if kind == "exchanged":
            wave[:, [c, -1]] = wave[:, [-1, c]]
        else:
            wave[:, c] = {
                "dead": 0 * one, "over": -one, "late": np.roll(one, int(rng.integers(1, rate // 50))),
                "loud": 10 * one, "clipped": np.clip(one, -0.2 * loudest, 0.2 * loudest),
                "noise": 0.1 * loudest * rng.standard_normal(len(one)), "shifted": one + 0.3 * loudest,
            }[str(kind)]  # fmt: skip
    if rng.random() < 0.2:
        wave += 0.3 * loudest * np.sin(2 * np.pi * 50 * np.arange(len(wave)) / rate)[:, None]
    return wave


def talks(seed: int, folder: Path) -> Trial:
    """People who talk for seconds between microphones of any shape, some channels of which are faulty."""
    rng = np.random.default_rng(seed)
    sides, rate = rng.uniform([3, 3, 2.4], [10, 8, 3.5]), int(rng.choice([8000, 16000, 16000, 44100]))
    count, shape = (
        int(rng.choice([4, 5, 6, 8, 8, 12])),
        str(rng.choice(["room", "room", "table", "line", "wall"])),
    )
    microphones = rng.random((count, 3))
    if shape == "room":
        microphones *= sides
    else:  # of some size: thin in one or in two axes, or in none
        thin = {"table": [1, 1, 1], "line": [1, 0, 0], "wall": [1, 0, 1]}[shape]
        microphones = sides / 2 + (microphones - 0.5) * some(rng, 0.05, 2) * thin
    config = copy.deepcopy(LABORATORY)
    config["room_config"] = {"room_dimensions_m": sides.tolist()}
    config["microphone_config"] = {"mic_positions_m": microphones.tolist(), "audio_sample_rate_hz": rate}
    (folder / "config.json").write_text(json.dumps(config))
    mouths = [rng.uniform([0.2, 0.2, 1.0], sides - [0.2, 0.2, 0.5]) for _ in range(int(rng.choice([0, 1, 1, 2, 3])))]
    paces = [[*rng.normal(0, 0.5, 2), 0.0] if rng.random() < 0.3 else [0.0] * 3 for _ in mouths]
    people = []
    for k in range(int(rng.integers(5, 90))):
        places = [np.clip(at + 0.1 * k * np.array(pace), 0.1, sides) for at, pace in zip(mouths, paces, strict=True)]
        people.append({"timestamp": k / 10, "objects": [
            {"object_id": i, "position": [*place[:2], 0.0], "mouth_position": place.tolist(),
             "speaking": (k // 7 + i) % 5 > 0} for i, place in enumerate(places)]})  # fmt: skip
    trial, _ = ended("avsim-audio", ["-C", folder, "--rt60", rng.choice([0.0, 0.2, 0.5])], folder, fuzz.lines(people))
    paths = list(folder.rglob("*.wav"))
    if trial.lost or not paths:
        return trial
    wave, _ = soundfile.read(paths[0], always_2d=True)
    soundfile.write(folder / "a.wav", spoilt(rng, wave, rate), rate, subtype="FLOAT")
    ways = ("", "", "--method 3d-ssl", "--lookahead 0", "--context 0", "--max-speakers 4", "--rate 25", "--min-score 0")
    options = str(rng.choice(ways)).split()
    trial, _ = ended("avdetect-audio", [folder / "a.wav", "-C", folder, *options], folder)
    what = (
        f"avdetect-audio {' '.join(options)}, {count} microphones ({shape}), {len(mouths)} people, {len(people)} steps"
    )
    return Trial(what, trial.refused, trial.lost)


def pictures(seed: int, folder: Path) -> Trial:
    """Pictures from 1 x 1 px to 8K, grey, with alpha, of 16 bits; depth that is absent, zero, far, of another size."""
    rng = np.random.default_rng(seed)
    sizes = [(1, 1), (2, 3), (1, 400), (64, 36), (320, 180), (640, 480), (1920, 1080)]
    width, height = sizes[rng.integers(len(sizes))] if rng.random() < 0.98 else (7680, 4320)
    channels = int(rng.choice([1, 3, 3, 3, 4]))
    deep = bool(rng.random() < 0.1)
    picture = rng.integers(0, 65536 if deep else 256, (height, width, channels))
    cv2.imwrite(str(folder / "rgb.png"), picture.astype(np.uint16 if deep else np.uint8))
    config = copy.deepcopy(LABORATORY)
    camera = config["camera_config"]
    camera |= {"image_width_px": width, "image_height_px": height, "cx_px": width / 2, "cy_px": height / 2}
    camera |= {"fx_px": max(width, 2) / 3, "fy_px": max(width, 2) / 3}
    frame = {"rgb": "rgb.png"}
    if with_depth := rng.random() < 0.7:
        other = rng.random() < 0.1
        depth = np.full((height + other, width), int(rng.choice([0, 1, 25000, 65535])), np.uint16)
        media.write_png(folder / "depth.png", depth)
        media.write_png(folder / "empty.png", np.full((height, width), 25000, np.uint16))
        frame["depth"] = "depth.png"
        camera |= {"background_depth": "empty.png", "depth_kind": "radial"}
    (folder / "config.json").write_text(json.dumps(config))
    detector = "depth" if with_depth and rng.random() < 0.5 else "net"
    records = fuzz.lines([{"timestamp": k / 10, "frame": frame} for k in range(2)])
    trial, _ = ended("avdetect-video", ["-C", folder, "--detector", detector], folder, records)
    return Trial(f"avdetect-video {detector}, {width}x{height}x{channels}", trial.refused, trial.lost)


def lens(seed: int, _folder: Path) -> Trial:
    """A lens of random parameters: what it sees comes back to the pixel, what it cannot see is NaN."""
    rng = np.random.default_rng(seed)
    names = list(lenses.LENSES)
    name = names[rng.integers(len(names))]
    model = lenses.LENSES[name]
    f, width = some(rng, 1, 5000), some(rng, 2, 8000)
    own = [float(rng.normal(0, some(rng, 1e-4, 1))) for _ in model.names()[4:]]
    try:
        made = model.of_image([f, f * rng.uniform(0.8, 1.2), width / 2, width / 3, *own], width, width / 1.5)
    except ValueError as error:
        return Trial(name, refused=str(error))
    if not made.is_possible:
        return Trial(name, refused="not a possible lens")
    rays = rng.standard_normal((400, 3)) * some(rng, 1e-3, 1e4)
    with np.errstate(all="raise", under="ignore"):
        try:
            pixels = made.project(rays)
            back = made.project(made.unproject(pixels))
        except FloatingPointError as error:
            return Trial(f"{name} {made.parameters}", lost=str(error))
    seen = np.isfinite(pixels).all(1)
    allowed = 1e-4 * max(1.0, width) + 1e-6 * np.abs(pixels[seen]).max(1, initial=0.0)
    off = np.abs(back[seen] - pixels[seen]).max(1, initial=0.0)
    wrong = "" if (off <= allowed).all() else f"{off.max():.2g} px off, or lost, after there and back"
    if np.isinf(pixels).any():
        wrong = "an infinite pixel"
    return Trial(f"{name} {made.parameters}", lost=wrong)


def cameras(seed: int, folder: Path) -> Trial:
    """A camera of random size and lens through avcalib: check, convert to each format, undistort, background."""
    rng = np.random.default_rng(seed)
    fuzz.made(folder)
    names = list(lenses.LENSES)
    model = names[rng.integers(len(names))]
    width, height = (int(some(rng, 1, 400)) for _ in range(2))
    keys = lenses.LENSES[model].keys()
    own = {key: float(rng.normal(0, some(rng, 1e-4, 1))) for key in keys}
    camera = {**LABORATORY["camera_config"], "lens_model": model, "image_width_px": width, "image_height_px": height}
    camera = {key: value for key, value in camera.items() if not re.fullmatch(r"k\d", key)} | own
    camera |= {"fx_px": some(rng, 0.1, 5000), "fy_px": some(rng, 0.1, 5000), "cx_px": width / 2, "cy_px": height / 2}
    path = folder / "config.json"
    path.write_text(json.dumps({**LABORATORY, "camera_config": camera}))
    picture = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    media.write_png(folder / "seen.png", picture)
    kind = str(rng.choice(["check", "convert", "undistort", "background"]))
    arguments: list[object] = {
        "check": ["check", path],
        "convert": ["convert", path, "--to", str(rng.choice(["opencv", "ros", "kalibr", "colmap", "mrcal"]))],
        "undistort": ["undistort", folder / "seen.png", "-c", path, "--to", folder / "straight.png"],
        "background": ["background", folder / "seen.png", "-C", folder],
    }[kind]
    trial, _ = ended("avcalib", arguments, folder)
    return Trial(f"avcalib {kind}, {model}, {width}x{height}", trial.refused, trial.lost)


# --- the whole --------------------------------------------------------------------------------------------------------


def world(rng: np.random.Generator) -> dict[str, Any]:
    """A random scenario: room, camera, microphones, people who walk, furniture."""
    sides = [round(some(rng, 1.5, 25), 3), round(some(rng, 1.5, 25), 3), round(rng.uniform(2.0, 6.0), 3)]
    count = int(rng.choice([0, 1, 2, 5, 12]))
    rate = int(rng.choice([8000, 16000, 44100, 96000]))

    def place() -> list[float]:
        return [float(rng.uniform(0.3, side - 0.3)) for side in sides[:2]]

    people = []
    for _ in range(count):
        ways: list[dict[str, Any]] = [{"position_m": place()}, {"position_m": place()}]
        if rng.random() < 0.3:
            ways[1]["stay_s"] = 0.2
        people.append({"waypoints": ways, "speech_s": [[0.0, 0.4]] if rng.random() < 0.7 else []})
    microphones = [[*place(), float(rng.uniform(0.2, sides[2] - 0.1))] for _ in range(int(rng.choice([2, 5, 8, 8])))]
    return {
        "name": "stress", "duration_s": float(rng.choice([0.0, 0.1, 0.5])),
        "camera_config": {"image_width_px": 96, "image_height_px": 54, "fx_px": 45.0, "fy_px": 45.0, "cx_px": 48.0,
                          "cy_px": 27.0},
        "microphone_config": {"mic_positions_m": microphones, "audio_sample_rate_hz": rate},
        "room_config": {"room_dimensions_m": sides, "reverberation_time_s": float(rng.choice([0.0, 0.2, 0.4]))},
        "people": people,
    }  # fmt: skip


def worlds(seed: int, folder: Path) -> Trial:
    """A random world through all stages: simulated, heard, seen, tracked and scored."""
    rng = np.random.default_rng(seed)
    scenario = json.dumps(world(rng)).encode()
    experiment = folder / "experiment"
    at: list[object] = ["-C", experiment]
    drawn = rng.random() < 0.3
    steps: list[tuple[str, list[object], str]] = [
        ("avsim-scene", ["-", *([] if drawn else ["--no-video"])], "scene"),
        ("avsim-audio", [folder / "scene.jsonl"], "audio"),
        ("avdetect-audio", [folder / "audio.jsonl", "--method", str(rng.choice(["srp", "3d-ssl"]))], "a"),
        ("avdetect-video", [folder / "scene.jsonl"], "v"),
        ("avfuse", [folder / "a.jsonl", folder / "v.jsonl"], "tracks"),
    ]
    if not drawn:
        del steps[3], steps[-1][1][1]
    for command, arguments, name in steps:
        trial, written = ended(command, [*at, *arguments], folder, scenario)
        if trial.lost or trial.refused:
            return Trial(f"{command} in a random world", trial.refused, trial.lost)
        (folder / f"{name}.jsonl").write_bytes(written)
    truth = experiment / "groundtruth_sources.jsonl"
    trial, _ = ended("aveval", [truth, folder / "tracks.jsonl"], folder)
    return Trial("a random world through all stages", trial.refused, trial.lost)


def rooms(seed: int, folder: Path) -> Trial:
    """Sound in rooms from a box to a cathedral: any rate, echoes, noise, speed; mouths and microphones anywhere."""
    rng = np.random.default_rng(seed)
    sides = [some(rng, 0.2, 200), some(rng, 0.2, 200), some(rng, 0.2, 50)]
    config = copy.deepcopy(LABORATORY)
    config["room_config"] = {"room_dimensions_m": sides}
    count = int(rng.choice([1, 2, 8]))
    config["microphone_config"]["mic_positions_m"] = (rng.random((count, 3)) * sides).tolist()
    config["microphone_config"]["audio_sample_rate_hz"] = int(rng.choice([8000, 22050, 96000, 192000]))
    (folder / "config.json").write_text(json.dumps(config))
    walk = rng.uniform(-0.1, 1.1, 3) * sides + np.outer(np.arange(3), rng.normal(0, some(rng, 1e-6, 3), 3))
    people = [
        {"timestamp": k / 10, "objects": [{"object_id": 0, "position": [*place[:2], 0.0],
                                           "mouth_position": place.tolist(), "speaking": bool(rng.random() < 0.8)}]}
        for k, place in enumerate(walk)
    ]  # fmt: skip
    options = [
        *["--rt60", str(rng.choice([0.0, 0.1, 0.3]))],
        *(["--noise", f"sensor={rng.choice([-60, 0, 30, 200])}"] if rng.random() < 0.4 else []),
        *(["--switch", "0.01"] if rng.random() < 0.2 else []),
        *(["--level", str(rng.choice([-20, 0, 60, 140]))] if rng.random() < 0.3 else []),
    ]
    trial, _ = ended("avsim-audio", ["-C", folder, *options], folder, fuzz.lines(people))
    what = f"avsim-audio {' '.join(options)}, {' x '.join(f'{side:.2g}' for side in sides)} m"
    heard = [soundfile.read(path)[0] for path in folder.rglob("*.wav")]
    finite = all(np.isfinite(wave).all() for wave in heard)
    return Trial(what, trial.refused, trial.lost or ("" if finite else "samples that are not numbers"))


def scores(seed: int, folder: Path) -> Trial:
    """Truth and tracks at any scale, with gaps, names, exchanged people, NaN-free scores; metrics, tables and pages."""
    rng = np.random.default_rng(seed)
    scale = some(rng, 1e-3, 1e5)
    kinds: list[list[Any]] = [["a", "b", "c", "d"], [0, 1, 2, 3], [-5, 2**40, 7, 8]]
    names = kinds[rng.integers(3)]
    for name in ("truth", "tracks"):
        records = []
        for k in range(int(rng.integers(0, 30))):
            chosen = [one for one in names if rng.random() < 0.6]
            objects = [{"object_id": one, "position": (rng.uniform(-1, 1, 3) * scale).tolist()} for one in chosen]
            if rng.random() < 0.9:
                records.append({"timestamp": f"{k / 10:.10f}", "objects": objects})
        (folder / f"{name}.jsonl").write_bytes(fuzz.lines(records))
    how = ["--format", str(rng.choice(["jsonl", "table", "csv", "markdown", "latex"]))]
    options: list[object] = [*how, "--dims", str(rng.choice([2, 3])), "--d0", f"{some(rng, 1e-3, 1e3):.6g}"]
    if rng.random() < 0.2:
        options += ["--html", folder / "page.html"]
    trial, written = ended("aveval", [folder / "truth.jsonl", folder / "tracks.jsonl", *options], folder)
    lost = trial.lost
    if how[1] != "jsonl":
        lost = "" if lost.startswith("line ") or not lost else lost
        lost = lost or ("nan in the table" if b"nan" in written.lower() else "")
    return Trial(f"aveval {' '.join(map(str, options[:6]))}, {scale:.1e} m", trial.refused, lost)


def view(seed: int, folder: Path) -> Trial:
    """Any mixture of records on a page: truth, detections, tracks, frames and sound, out of order, some damaged."""
    chance = random.Random(seed)
    fuzz.made(folder)
    mixed = [*fuzz.DETECTIONS, *fuzz.PEOPLE, *fuzz.FRAMES, *fuzz.HEARD]
    some_of = chance.sample(mixed, chance.randrange(1, len(mixed)))
    given = fuzz.changed(some_of, chance) if chance.random() < 0.7 else some_of
    (folder / "mixed.jsonl").write_bytes(fuzz.lines(given))
    page = folder / "page.html"
    end = run("avview", "-q", "-C", folder, folder / "mixed.jsonl", "--html", page)
    lost = ""
    if end.returncode not in (0, 1, 2):
        lost = f"exit {end.returncode}: {end.stderr[-300:]}"
    elif end.returncode and (page.exists() or not end.stderr.startswith("avview: ")):
        lost = f"exit {end.returncode} with a page, or without a word"
    elif page.exists() and re.search(r"[:,\[]\s*NaN\b", page.read_text()):
        lost = "NaN in the page"
    return Trial("avview --html", end.stderr.strip(), lost)


# --- faults -----------------------------------------------------------------------------------------------------------


def disk(seed: int, folder: Path) -> Trial:
    """A disk that is full after some bytes: exit 74, and what was there before is still there."""
    chance = random.Random(seed)
    fuzz.made(folder)
    command = chance.choice(["avfuse", "aveval", "avsim-audio", "avsim-scene", "avdetect-audio", "avdetect-video"])
    documents, options, _ = fuzz.FUZZED[command]
    filled = [option.format(truth=folder / "truth.jsonl") for option in options]
    where = folder / "experiment" if command == "avsim-scene" else folder
    largest = chance.choice([0, 10, 100, 1000, 10_000])
    kept = folder / "kept.jsonl"
    kept.write_text("before\n")
    end = run(command, "-C", where, *filled, "-o", kept, stdin=fuzz.lines(documents), largest_file=largest)
    what = f"{command}, files of at most {largest} bytes"
    if end.returncode not in (0, 74) or "Traceback" in end.stderr:
        return Trial(what, lost=f"exit {end.returncode}: {end.stderr[-300:]}")
    if left := [path.name for path in folder.rglob(".*.tmp")]:
        return Trial(what, lost=f"left behind: {left}")
    whole = kept.read_text()
    if end.returncode and whole != "before\n":
        return Trial(what, lost="the old output is gone")
    return Trial(what, end.stderr.strip(), "" if end.returncode else wrong_records(whole.encode()))


def ending(seed: int, folder: Path) -> Trial:
    """A filter in a pipe that is killed, whose input is cut, or whose reader goes away."""
    chance = random.Random(seed)
    fuzz.made(folder)
    kind = chance.choice(["SIGTERM", "SIGINT", "SIGKILL", "cut", "reader"])
    output = folder / "out.jsonl"
    to_pipe = kind == "reader"
    process = subprocess.Popen(
        [BIN / "avfuse", "-C", folder, "-o", "-" if to_pipe else output],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "LANG": "C"},
    )  # fmt: skip
    assert process.stdin
    assert process.stdout
    data = fuzz.lines([{**fuzz.DETECTIONS[0], "timestamp": k / 10} for k in range(200)])
    try:
        if to_pipe:
            process.stdout.close()
            process.stdin.write(data)
            process.stdin.close()
        else:
            process.stdin.write(data[: chance.randrange(1, len(data))])
            process.stdin.flush()
            time.sleep(chance.uniform(0.0, 0.6))
            if kind != "cut":
                process.send_signal(getattr(signal, kind))
            process.stdin.close()
    except BrokenPipeError:
        pass
    process.stdin = None
    try:
        _, said = (
            process.communicate(timeout=120) if not to_pipe else (b"", process.stderr.read() if process.stderr else b"")
        )
        process.wait(120)
    except subprocess.TimeoutExpired:
        process.kill()
        return Trial(f"avfuse, {kind}", lost="hangs")
    what, code = f"avfuse, {kind}", process.returncode
    if b"Traceback" in said and kind == "SIGINT" and OURS not in said and not output.exists():
        return Trial(what, "Ctrl-C in Python's own start, before avcli's first line")
    if b"Traceback" in said:
        return Trial(what, lost=said[-300:].decode())
    if kind == "SIGKILL":
        return Trial(what, kind, "an output of a killed run" if output.exists() else "")
    if left := [path.name for path in folder.rglob(".*.tmp")]:
        return Trial(what, lost=f"left behind: {left}")
    expected = {"cut": (0, 1), "reader": (-signal.SIGPIPE,)}.get(kind)
    if expected is None:
        expected = (-getattr(signal, kind),)
    lost = "" if code in expected else f"exit {code}: {said[-200:]!r}"
    if code and output.exists():
        lost = "half an output"
    return Trial(what, f"exit {code}" if code else "", lost)


def hour(seed: int, folder: Path) -> Trial:
    """An hour of records, 36,000, in one trial of fifty; a minute in the others."""
    rng = np.random.default_rng(seed)
    count = 36_000 if (seed >> 32) % 50 == 49 else 600
    way = 2 + np.cumsum(rng.normal(0, 0.05, (count, 2)), axis=0)
    lines = []
    for k, place in enumerate(2.5 + 2 * np.sin(way)):
        one = {"position": [*place.tolist(), 1.0], "score": 0.9}
        objects = [one] if rng.random() < 0.9 else []
        lines.append(json.dumps({"timestamp": f"{k / 10:.10f}", "sensor": "video", "objects": objects}))
    trial, tracks = ended("avfuse", [], folder, "\n".join(lines).encode() + b"\n")
    records = len(tracks.splitlines())
    lost = trial.lost or ("" if trial.refused or records == count else f"{records} records of {count}")
    return Trial(f"avfuse, {count} records", trial.refused, lost)


Kind = Callable[[int, Path], Trial]
KINDS: dict[str, Kind] = {
    one.__name__: one
    for one in (
        files,
        values,
        detections,
        walkers,
        order,
        sounds,
        talks,
        pictures,
        lens,
        cameras,
        rooms,
        worlds,
        scores,
        view,
        disk,
        ending,
        hour,
    )
}
