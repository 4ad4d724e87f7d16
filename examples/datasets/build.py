#!/usr/bin/env python3
"""Build the data sets MOT25A, MOT25V, MOT25AV and MOT26 in MOTChallenge's layout: `make datasets`.

    python examples/datasets/build.py out/datasets
    python examples/datasets/build.py out/datasets --sets MOT26 --worlds 50 --seconds 60

MOT25A (sound), MOT25V (pictures) and MOT25AV (both) are the scenarios S1 to S4 of the thesis, 4 s each. MOT26 has
random worlds of a fixed seed for each sequence: splits train, val and test, levels easy, medium and hard, half of them
with depth. DATASHEET.md, which is copied beside them, says what they are for and what they are not.

    SET/SPLIT/SEQUENCE/     (MOT25 has no splits)
      seqinfo.ini gt/gt.txt det/det.txt img1/000001.png ...   as MOTChallenge has them; columns 8 to 10 are x, y, z m
      depth/000001.png audio/wav/...wav det/audio.txt         depth, microphones, and what was heard
      config.json groundtruth_sources.jsonl localization/     the same as avcli's experiment; frames.jsonl, audio.jsonl
    SET/manifest.json SET/SHA256SUMS                          what each sequence is; `sha256sum -c SHA256SUMS` checks it

The same options give the same bytes on one machine. A sequence that is there is not built again.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import avcli

HERE = Path(__file__).resolve().parent
SPLITS = ("train", "val", "test")
LEVELS: dict[str, dict[str, Any]] = {
    "easy": {
        "people": (1, 2),
        "t60": (0.1, 0.3),
        "noise": 40,
        "height": (2.4, 3.0),
        "kinds": ("office", "meeting", "living"),
    },
    "medium": {
        "people": (3, 4),
        "t60": (0.3, 0.5),
        "noise": 30,
        "height": (2.4, 3.5),
        "kinds": ("office", "meeting", "workshop"),
    },
    "hard": {
        "people": (5, 8),
        "t60": (0.5, 0.8),
        "noise": 20,
        "height": (2.6, 4.5),
        "kinds": ("office", "hall", "corridor"),
    },
}
"""What is drawn in a level: people (least, most), reverberation s, microphones' noise dB below a voice, camera m."""


@dataclass(frozen=True)
class World:
    """A sequence: its name, where it lies in its set, and the options of the commands that make it."""

    name: str
    folder: str
    scene: tuple[str, ...]
    audio: tuple[str, ...] = ()
    heard: bool = True
    seen: bool = True
    depth: bool = True
    about: tuple[tuple[str, Any], ...] = ()


def mot25(name: str) -> list[World]:
    """The sequences of MOT25A, MOT25V or MOT25AV."""
    kinds = name.removeprefix("MOT25")
    return [
        World(f"{name}-{scenario}", "", (scenario,), (), "A" in kinds, "V" in kinds, about=(("scenario", scenario),))
        for scenario in ("s1", "s2", "s3", "s4")
    ]


def mot26(worlds: int, seconds: float) -> list[World]:
    """The sequences of MOT26: `worlds` of each split and level, each of so many seconds."""
    found = []
    for split_number, split in enumerate(SPLITS):
        for level_number, (level, of) in enumerate(LEVELS.items()):
            for number in range(worlds):
                rng = np.random.default_rng([26, split_number, level_number, number])
                about = {
                    "split": split,
                    "level": level,
                    "seed": int(rng.integers(2**31)),
                    "people": int(rng.integers(of["people"][0], of["people"][1] + 1)),
                    "kind": str(rng.choice(of["kinds"])),
                    "camera_height_m": round(float(rng.uniform(*of["height"])), 2),
                    "reverberation_time_s": round(float(rng.uniform(*of["t60"])), 2),
                    "noise_db": of["noise"],
                    "depth": (number + level_number + split_number) % 2 == 0,
                }
                seed = ("--seed", str(about["seed"]))
                scene = ("random", *seed, "--duration", f"{seconds:g}", "--people", str(about["people"]), "--kind",
                         about["kind"], "--camera-height", str(about["camera_height_m"]))  # fmt: skip
                audio = (*seed, "--rt60", str(about["reverberation_time_s"]), "--ism-decay", "20", "--noise",
                         f"sensor={about['noise_db']}")  # fmt: skip
                name = f"MOT26-{split}-{level}-{number + 1:03d}"
                found.append(World(name, split, scene, audio, depth=about["depth"], about=tuple(about.items())))
    return found


def run(command: str, *options: object) -> None:
    """Run one of avcli's commands; it ends the build if it fails."""
    subprocess.run([str(Path(sys.executable).parent / command), "-q", *map(str, options)], check=True)


def lines(path: Path) -> list[dict[str, Any]]:
    """Read a file of records."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def rows(records: list[dict[str, Any]], rate: float) -> str:
    """Write records as MOTChallenge's rows: frame, identity, box, score, x, y, z."""
    text = []
    for record in records:
        frame = round(float(record["timestamp"]) * rate) + 1
        for one in record["objects"]:
            identity = one["object_id"] + 1 if "object_id" in one else -1
            x0, y0, x1, y1 = one.get("bbox_px") or (-1, -1, -2, -2)
            x, y, z = one["position"]
            cells = [frame, identity, x0, y0, x1 - x0, y1 - y0, round(one.get("score", 1), 4)]
            text.append(",".join(f"{cell:g}" for cell in cells) + f",{x:.4f},{y:.4f},{z or 0.0:.4f}")
    return "".join(line + "\n" for line in text)


def frames(folder: Path, records: list[dict[str, Any]]) -> None:
    """Move the pictures to MOTChallenge's names, and write the records that name them."""
    moved = []
    for number, record in enumerate(records, 1):
        names = {}
        for kind, home in (("rgb", "img1"), ("depth", "depth")):
            if kind in record["frame"]:
                names[kind] = f"{home}/{number:06d}.png"
                (folder / home).mkdir(exist_ok=True)
                (folder / record["frame"][kind]).rename(folder / names[kind])
        moved.append({"timestamp": record["timestamp"], "frame": names})
    (folder / "frames.jsonl").write_text("".join(json.dumps(one) + "\n" for one in moved), encoding="utf-8")


def build(world: World, folder: Path, media: bool) -> None:
    """Make a sequence."""
    at = ("-C", folder)
    for name in ("gt", "det", "localization"):
        (folder / name).mkdir(parents=True)
    drawn = () if world.seen else ("--no-video",)
    pictures = ("--pictures", "both" if world.depth else "rgb") if world.seen else ()
    scene = folder / "scene.jsonl"
    run("avsim-scene", *world.scene, *at, *drawn, *pictures, "-o", scene)
    records = lines(scene)
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    camera = config["camera_config"]
    rate = camera.get("frame_rate_hz", 10)
    if world.heard:
        heard = folder / "localization/audio_localizations.jsonl"
        run("avsim-audio", *at, *world.audio, scene, "-o", folder / "audio.jsonl")
        run("avdetect-audio", *at, folder / "audio.jsonl", "-o", heard)
        (folder / "det/audio.txt").write_text(rows(lines(heard), rate), encoding="utf-8")
    if world.seen:
        seen = folder / "localization/video_localizations.jsonl"
        run("avdetect-video", *at, scene, "-o", seen)
        (folder / "det/det.txt").write_text(rows(lines(seen), rate), encoding="utf-8")
        frames(folder, records)
    (folder / "gt/gt.txt").write_text(rows(lines(folder / "groundtruth_sources.jsonl"), rate), encoding="utf-8")
    level = "".join(f"{key}={value}\n" for key, value in world.about if key in ("level", "split"))
    (folder / "seqinfo.ini").write_text(
        f"[Sequence]\nname={world.name}\nimDir=img1\nframeRate={rate:g}\nseqLength={len(records)}\n"
        f"imWidth={camera.get('image_width_px', 1920)}\nimHeight={camera.get('image_height_px', 1080)}\n"
        f"imExt=.png\n{level}",
        encoding="utf-8",
    )
    scene.unlink()
    for name in [] if media else ("img1", "depth", "video", "audio", "frames.jsonl", "audio.jsonl"):
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def without_sound(twin: Path, folder: Path) -> None:
    """Make a sequence of MOT25V of that of MOT25AV: the same files, linked, but for what was heard."""
    heard = {"audio", "audio.jsonl", "audio.txt", "audio_localizations.jsonl"}
    shutil.copytree(twin, folder, dirs_exist_ok=True, copy_function=os.link, ignore=lambda _, names: heard & set(names))
    about = folder / "seqinfo.ini"
    text = about.read_text(encoding="utf-8").replace(
        f"name={twin.name}\n", f"name={folder.name.removesuffix('.part')}\n"
    )
    about.unlink()  # not the twin's
    about.write_text(text, encoding="utf-8")


def sums(folder: Path) -> str:
    """Return the SHA-256 of all files below a folder, as sha256sum writes them, in the order of their names."""
    found = []
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "SHA256SUMS"):
        with open(path, "rb") as stream:
            found.append(f"{hashlib.file_digest(stream, 'sha256').hexdigest()}  {path.relative_to(folder)}\n")
    return "".join(found)


def save(name: str, worlds: list[World], out: Path, media: bool) -> None:
    """Build a set below `out`: its sequences, manifest, datasheet and checksums."""
    home = out / name
    for world in worlds:
        folder = home / world.folder / world.name
        if folder.exists():
            continue
        print(f"{name}: {world.name}", file=sys.stderr)
        part = folder.with_name(folder.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        twin = Path(str(folder).replace("MOT25V", "MOT25AV"))
        if name == "MOT25V" and twin.exists() and (twin / "img1").exists() == media:
            without_sound(twin, part)
        else:
            build(world, part, media)
        part.rename(folder)
    entries = []
    for world in worlds:
        folder = home / world.folder / world.name
        files = [path for path in folder.rglob("*") if path.is_file()]
        room = json.loads((folder / "config.json").read_text(encoding="utf-8"))["room_config"]
        entry = {"name": world.name, "path": str(folder.relative_to(home)), "heard": world.heard, "seen": world.seen}
        size = {"files": len(files), "bytes": sum(path.stat().st_size for path in files)}
        entries.append(entry | dict(world.about) | {"room_dimensions_m": room["room_dimensions_m"]} | size)
    about = {"name": name, "made_by": f"avcli {avcli.__version__}", "media": media, "sequences": entries}
    (home / "manifest.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    shutil.copyfile(HERE / "DATASHEET.md", home / "DATASHEET.md")
    (home / "SHA256SUMS").write_text(sums(home), encoding="utf-8")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = ("MOT25AV", "MOT25A", "MOT25V", "MOT26")
    parser.add_argument("out", type=Path)
    parser.add_argument("--sets", nargs="+", choices=known, default=known)
    parser.add_argument("--worlds", type=int, default=1, help="MOT26: sequences of each split and level")
    parser.add_argument("--seconds", type=float, default=6.0, help="MOT26: length of a sequence")
    parser.add_argument("--no-media", action="store_true", help="keep ground truth and detections alone")
    given = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in given.sets:
        worlds = mot26(given.worlds, given.seconds) if name == "MOT26" else mot25(name)
        try:
            save(name, worlds, given.out, not given.no_media)
        except subprocess.CalledProcessError as error:
            sys.exit(f"build.py: {Path(error.cmd[0]).name} failed: {' '.join(error.cmd[1:])}")


if __name__ == "__main__":
    main()
