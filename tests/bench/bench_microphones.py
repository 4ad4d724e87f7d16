"""How well avcalib microphones measures an array by sound alone, with tracks, and with faulty channels.

    make bench-microphones                              # microphones.md and .jsonl in bench-out/: fifteen minutes
    make bench-microphones BENCH_FLAGS="--falls 0.6"    # the talker stoops and rises again, by 60 cm every 18 s

A person walks for three minutes through rooms of T60 0.35 s and talks (real speech, CMU ARCTIC, from ../shared/data or
AVCLI_SHARED_DATA); eight microphones at 20 dB, whose positions in config.json are wrong by 4 cm along each axis. The
sound is simulated by avsim-audio's library. Rooms, walks and voice that decided settings (--split decide) are not those
that are reported.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import soundfile
from scipy.signal import resample_poly

from avcli.acoustics.recorder import hear
from avcli.acoustics.settings import Settings
from avcli.calibration import microphones
from avcli.formats.experiment import Config
from avcli.formats.media import Sound
from avcli.formats.records import Identified
from avcli.localization.survey import Listening

ROOT = Path(__file__).resolve().parents[2]
FS, SECONDS, SNR_DB, WRONG_M, SPEED = 24000, 180.0, 20.0, 0.04, 343.0
STOOPS_S = 18.0
SPEAKERS = {"decide": "aew", "report": "axb"}


@dataclass(frozen=True)
class Case:
    """A room (3,) m, the seed of walk and array, and whether microphones hang at all heights or below the ceiling."""

    name: str
    room: tuple[float, float, float]
    seed: int
    spread: bool = False


CASES = {
    "decide": (Case("ring", (6, 5, 3), 1), Case("low room", (5.2, 4.4, 2.7), 2), Case("heights", (7, 5, 3), 3, True)),
    "report": (
        Case("ring", (5.6, 6.2, 2.9), 11),
        Case("square", (4.66, 4.66, 3.0), 12),
        Case("heights", (6.6, 4.8, 2.6), 13, True),
    ),
}
FAULTS: dict[str, dict[str, dict[int, float]]] = {
    "none": {},
    "3.2 ms late": {"late": {2: 0.0032}},
    "0.3 ms late": {"late": {4: 0.0003}},
    "20 and -50 ppm": {"drift": {1: 20e-6, 6: -50e-6}},
    "two turned over": {"sign": {2: -1.0, 5: -1.0}},
    "neighbours exchanged": {"order": {2: 3, 3: 2}},
}


def walk(room: np.ndarray, rng: np.random.Generator, falls: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) s and mouths (n, 3) m of a person who walks from place to place and stoops by so many m."""
    t, step = np.arange(0.0, SECONDS + 1e-9, 0.1), 0.1
    here = goal = rng.uniform(0.7, room[:2] - 0.7)
    velocity, speed, path = np.zeros(2), 0.8, []
    for _ in t:
        if np.linalg.norm(goal - here) < 0.3:
            goal, speed = rng.uniform(0.6, room[:2] - 0.6), rng.uniform(0.5, 1.2)
        away = goal - here
        velocity = velocity + (speed * away / max(float(np.linalg.norm(away)), 1e-9) - velocity) * step / 0.4
        here = here + velocity * step
        path.append(here)
    height = rng.uniform(1.45, 1.7) + 0.02 * np.sin(2 * np.pi * 0.9 * t) + 0.05 * np.sin(0.2 * t)
    height = height + 0.5 * falls * (np.sin(2 * np.pi * t / STOOPS_S) - 1.0)
    return t, np.column_stack([path, height])


def array(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Return eight microphones near the walls, (8, 3) m."""
    angle, middle = np.arange(8) * np.pi / 4 + 0.2, np.array(case.room[:2]) / 2
    level = np.clip(1.35 * np.column_stack([np.cos(angle), np.sin(angle)]), -1.0, 1.0)
    return np.column_stack([middle + (middle - 0.15) * level, rng.uniform(0.8 if case.spread else 2.2, 2.5, 8)])


def recorded(case: Case, speaker: str, falls: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return samples (n, 8) without noise, microphones (8, 3) m, and the walk: times and mouths."""
    rng = np.random.default_rng(case.seed)
    true = array(case, rng)
    t, path = walk(np.array(case.room), rng, falls)
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    spoken = [soundfile.read(file, always_2d=True) for file in sorted(folder.glob(f"*_{speaker}_*.wav"))]
    if not spoken:
        sys.exit("bench-microphones: needs CMU ARCTIC's sentences of aew and axb (AVCLI_SHARED_DATA/speech)")
    rate = spoken[0][1]
    pause = np.zeros((int(0.3 * rate), 1))
    voice = Sound(np.concatenate([part for samples, _ in spoken for part in (samples, pause)]), rate)
    room = {"room_dimensions_m": list(map(float, case.room))}
    config = Config(
        {"room_config": room, "microphone_config": {"mic_positions_m": true.tolist(), "audio_sample_rate_hz": FS}}
    )
    truth = (
        Identified(float(time), np.array([0]), np.array([[x, y, 0.0]]), mouths=np.array([[x, y, z]]))
        for time, (x, y, z) in zip(t, path, strict=True)
    )
    sound = hear(config, truth, speech=[voice], seed=case.seed, settings=Settings(rt60_s=0.35, error_db=-30.0))
    return sound.samples[: round(SECONDS * FS)].astype(float), true, t, path


def faulty(samples: np.ndarray, fault: dict[str, dict[int, float]], rng: np.random.Generator) -> np.ndarray:
    """Return the samples with noise, and with a fault."""
    found = samples + samples.std() * 10 ** (-SNR_DB / 20) * rng.standard_normal(samples.shape)
    t = np.arange(len(found)) / FS
    late, drift = fault.get("late", {}), fault.get("drift", {})
    for c in {*late, *drift}:
        finer = resample_poly(found[:, c], 8, 1)
        at = (t - late.get(c, 0.0) - drift.get(c, 0.0) * t) * FS * 8
        found[:, c] = np.interp(at, np.arange(len(finer)), finer)
    for c, sign in fault.get("sign", {}).items():
        found[:, c] *= sign
    order = [int(fault.get("order", {}).get(c, c)) for c in range(found.shape[1])]
    return found[:, order]


def shape_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the errors (m,) m of positions after the best rigid motion (Kabsch 1976)."""
    one, other = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, v = np.linalg.svd(one.T @ other)
    return np.linalg.norm(one @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v) - other, axis=1)


def measured(case: Case, sound: tuple[np.ndarray, ...], fault: str, tracks: bool) -> dict[str, object]:
    """Measure an array, and compare with the truth."""
    samples, true, t, path = sound
    rng = np.random.default_rng(100 + case.seed)
    heard = faulty(samples, FAULTS[fault], rng)
    given = true + rng.normal(0.0, WRONG_M, true.shape)
    begin = time.process_time()
    high = np.array([case.room[0] - 0.1, case.room[1] - 0.1, 2.0])
    listening = Listening(lambda: [(0.0, heard, FS)], given, np.array([0.1, 0.1, 0.8]), high, SPEED)
    way = None
    if tracks:  # errors of 5 cm that last 2 s
        block = np.floor(t / 2.0).astype(int)
        way = microphones.tracked(t, path + rng.normal(0.0, 0.05, (block.max() + 1, 3))[block], True, 0.05)
    channels = listening.channels
    prior = microphones.Prior(given, WRONG_M, SPEED, 2.0, channels.late, channels.drift != 0.0, np.array(case.room))
    found = microphones.measure(listening.heard(), listening.again, prior, way, is_clock_known=not tracks)
    cpu = time.process_time() - begin
    late = FAULTS[fault].get("late", {})
    drift = FAULTS[fault].get("drift", {})
    away = channels.delay + found.fit.delays - [late.get(c, 0.0) for c in range(8)]
    adrift = channels.drift + found.fit.drifts - [drift.get(c, 0.0) for c in range(8)]
    return {
        "room": case.name,
        "fault": fault,
        "tracks": tracks,
        "given_mm": 1000 * float(np.median(shape_error(given, true))),
        "shape_mm": 1000 * float(np.median(shape_error(found.fit.positions, true))),
        "stated_mm": 1000 * float(np.median(found.fit.shape_sd)),
        "place_mm": 1000 * float(np.linalg.norm((found.fit.positions - true).mean(axis=0))),
        "delay_us": 1e6 * float(np.abs(away - np.median(away)).max()),
        "drift_ppm": 1e6 * float(np.abs(adrift - np.median(adrift)).max()),
        "named": channels.refined(found.fit.delays, found.fit.drifts, found.hearing).words(),
        "refusal": found.refusal,
        "cpu_s": cpu,
    }


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=list(CASES), default="report")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--falls", type=float, default=0.0, metavar="M", help="by how much the mouth falls and rises")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    head = (
        "room",
        "fault",
        "tracks",
        "given_mm",
        "shape_mm",
        "stated_mm",
        "place_mm",
        "delay_us",
        "drift_ppm",
        "cpu_s",
    )
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    with open(given.out / "microphones.jsonl", "w", encoding="utf-8") as log:
        for number, case in enumerate(CASES[given.split]):
            sound = recorded(case, SPEAKERS[given.split], given.falls)
            runs = [("none", False), ("none", True)] + [(f, False) for f in list(FAULTS)[1:] if number == 0]
            for fault, tracks in runs:
                row = measured(case, sound, fault, tracks)
                log.write(json.dumps(row) + "\n")
                log.flush()
                cells = [f"{value:.1f}" if isinstance(value, float) else str(value) for value in map(row.get, head)]
                lines.append(f"| {' | '.join(cells)} |")
                print(lines[-1], flush=True)
    (given.out / "microphones.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
