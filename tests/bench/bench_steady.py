"""Whether avdetect-audio takes steady sources, such as fans, for talkers.

    make setup-bench bench-steady BENCH_FLAGS="--noises FOLDER"    # steady.jsonl in bench-out/: five minutes

FOLDER holds recordings of machines, NAME_K_PART.wav, whose parts follow one another, such as noise_data/processed of
github.com/Timgrau/Projektarbeit-1 (air conditioners, dishwashers, vacuum cleaners; CC0); without it the machine is
pink noise. Recordings 0 and 1 of each name decide settings (--split decide), the others are reported. One talker, with
real speech (CMU ARCTIC) from ../shared/data or AVCLI_SHARED_DATA and a pause after each sentence, and one machine
elsewhere in the room, which sounds from beginning to end; rooms by pyroomacoustics. With --compact the microphones are
a ring of 5 cm on a table, and who is reported within 10 degrees of the talker is right.
"""

import argparse
import json
import os
import re
import sys
import time
from pathlib import Path

import numpy as np
from bench_faults import CASES, FS, ROOT, SPEAKERS, SPEED, Case, ring
from bench_localization import responses
from scipy.signal import fftconvolve, resample_poly

from avcli.formats.media import read_audio
from avcli.localization.array import Array
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block

SECONDS, PAUSE_S = 15.0, 0.8
LEVELS = (-10.0, 0.0)
"""dB, of the machine over the talker."""
DECIDES = {"0", "1"}
COMPACT_M, RIGHT, APART = 0.05, np.radians(10.0), np.radians(40.0)
"""m and rad: the radius of a compact array, the error of a right direction, and how far apart its two sources are."""


def machines(folder: Path | None, split: str) -> dict[str, np.ndarray]:
    """Return recordings of machines of a split, (n,) at FS; pink noise without a folder."""
    if folder is None:
        rng = np.random.default_rng(5 if split == "decide" else 6)
        size = int(SECONDS * FS)
        spectrum = np.fft.rfft(rng.standard_normal(size))
        spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
        spectrum[: int(50 * SECONDS)] = 0.0
        return {"pink": np.fft.irfft(spectrum, size)}
    parts: dict[str, dict[int, np.ndarray]] = {}
    for path in folder.glob("*.wav"):
        if (name := re.fullmatch(r"([a-z]+)_(\d+)_(\d+)", path.stem)) and (name[2] in DECIDES) == (split == "decide"):
            samples, rate = read_audio(path)
            whole = resample_poly(samples[:, 0], FS // np.gcd(FS, rate), rate // np.gcd(FS, rate))
            parts.setdefault(f"{name[1]} {name[2]}", {})[int(name[3])] = whole
    found = {name: np.concatenate([one[k] for k in sorted(one)]) for name, one in sorted(parts.items())}
    return {name: one[: int(SECONDS * FS)] for name, one in found.items() if len(one) >= SECONDS * FS}


def speech(speaker: str) -> np.ndarray:
    """Return SECONDS of sentences with pauses between them."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    spoken = [read_audio(path) for path in sorted(folder.glob(f"*_{speaker}_*.wav"))]
    if not spoken:
        sys.exit("bench-steady: needs CMU ARCTIC's sentences of aew and axb (AVCLI_SHARED_DATA/speech)")
    each = [resample_poly(x[:, 0], FS // np.gcd(FS, rate), rate // np.gcd(FS, rate)) for x, rate in spoken]
    pause = np.zeros(int(PAUSE_S * FS))
    whole = np.concatenate([part for one in each * 3 for part in (0.05 * one / np.sqrt(np.mean(one**2)), pause)])
    return np.concatenate([pause, whole])[: int(SECONDS * FS)]


def places(case: Case, rng: np.random.Generator) -> np.ndarray:
    """Return where the talker and the machine are, (2, 3) m, at least 1.2 m apart."""
    room = np.array(case.room, float)
    while True:
        found = np.column_stack([rng.uniform(0.7, room[:2] - 0.7, (2, 2)), rng.uniform([1.3, 0.9], [1.7, 1.9])])
        if np.hypot(*(found[0] - found[1])[:2]) > 1.2:
            return found


def between(rays: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles (n,) rad on the floor between rays (n, 3) and another one (3,)."""
    turn = np.arctan2(rays[:, 1], rays[:, 0]) - np.arctan2(other[1], other[0])
    angles: np.ndarray = np.abs(np.angle(np.exp(1j * turn)))
    return angles


def measured(case: Case, sound: np.ndarray, talker: np.ndarray, at: np.ndarray, microphones: np.ndarray) -> dict:
    """Return what was reported of a talker (3,) m whose dry voice is given, and of a machine at another place."""
    array = Array(microphones, FS, np.array(case.room, float), SPEED)
    localizer = SteeredLocalizer(array, SteeredSettings(), np.random.default_rng(0))
    energy = np.convolve(talker**2, np.ones(FS // 10) / (FS // 10), "same")
    speaks = energy > energy.max() * 10**-2.5
    active = hit = right = early = late = 0
    begin, named = time.process_time(), None
    for decision in localizer.localize(Block(sound[i : i + 4096]) for i in range(0, len(sound), 4096)):
        near = np.hypot(*(decision.positions - at[0])[:, :2].T) < 0.5
        if decision.rays:
            told = np.array([ray.direction for ray in decision.rays if ray]).reshape(-1, 3)
            near = between(told, at[0] - microphones.mean(axis=0)) < RIGHT
        now = bool(speaks[min(int(decision.time * FS), len(speaks) - 1)])
        active, hit, right = active + now, hit + (now and near.any()), right + near.any()
        wrong = len(near) - near.any()
        if named is None and len(decision.steady):
            named = decision.time
        early, late = early + wrong * (named is None), late + wrong * (named is not None)
    return {
        "recall": hit / max(active, 1),
        "precision": right / max(right + early + late, 1),
        "named_after_s": named,
        "false_before": int(early),
        "false_after": int(late),
        "cpu_s": time.process_time() - begin,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=list(CASES), default="report")
    parser.add_argument("--noises", type=Path)
    parser.add_argument("--compact", action="store_true", help="a ring of 5 cm on a table, which tells directions")
    parser.add_argument("--cases", nargs="+", default=None)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    dry = speech(SPEAKERS[options.split])
    with open(options.out / "steady.jsonl", "w") as rows:
        for case in CASES[options.split]:
            if case.walks or (options.cases and case.name not in options.cases):
                continue
            rng, room = np.random.default_rng([case.seed, 50]), np.array(case.room, float)
            microphones = ring(room, case.microphones, rng)
            at = places(case, rng)
            if options.compact:
                turn = 2.0 * np.pi * np.arange(case.microphones) / case.microphones
                middle = np.array([*room[:2] * rng.uniform(0.4, 0.6, 2), 1.0])
                microphones = middle + COMPACT_M * np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])
                while between((at - middle)[:1], at[1] - middle)[0] < APART:
                    at = places(case, rng)
            order = min(int(SPEED * case.rt60 / room.min()) + 1, 45)
            to_talker, to_machine = responses(room, FS, case.rt60, list(at), microphones, order)
            voice = np.column_stack([fftconvolve(dry, one)[: len(dry)] for one in to_talker])
            level = np.sqrt(np.mean(voice**2))
            hiss = level * 10 ** (-case.snr_db / 20) * rng.standard_normal(voice.shape)
            for name, recording in {"none": None, **machines(options.noises, options.split)}.items():
                for decibels in LEVELS if recording is not None else (0.0,):
                    heard = voice + hiss
                    if recording is not None:
                        machine = np.column_stack([fftconvolve(recording, one)[: len(dry)] for one in to_machine])
                        heard += machine * (level * 10 ** (decibels / 20) / np.sqrt(np.mean(machine**2)))
                    row = {"case": case.name, "machine": name, "level_db": decibels}
                    row |= measured(case, heard, dry, at, microphones)
                    print(json.dumps(row), file=rows, flush=True)
                    print(*(f"{v:.2f}" if isinstance(v, float) else v for v in row.values()), sep="\t", flush=True)


if __name__ == "__main__":
    main()
