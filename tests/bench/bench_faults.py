"""What avdetect-audio makes of faulty channels, one or two faults at a time.

    make setup-bench bench-faults            # faults.md and .jsonl in bench-out/: ten minutes
    make bench-faults BENCH_FLAGS="--compact --data DIR"     # of compact arrays, see compact_faults.py: four minutes

Five recordings of one talker, simulated by pyroomacoustics and not by us, with real speech (CMU ARCTIC) from
../shared/data or AVCLI_SHARED_DATA: eight microphones in a ring in a usual room, in a harder one, in a live and noisy
one, a talker who walks, and six microphones. Those that decided settings (--split decide) and those that are reported
share no room, no place and no voice. A detection is right within 0.5 m in x and y of the talker. DIR holds the sets of
bench-real-audio; without it compact arrays are simulated alone.
"""

import argparse
import importlib.util
import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
if importlib.util.find_spec("pyroomacoustics") is None:
    bench = ROOT / ".venv-bench" / "bin" / "python"
    if not bench.exists():
        sys.exit("bench-faults: needs pyroomacoustics; make setup-bench installs it")
    os.execv(bench, [str(bench), *sys.argv])

import compact_faults  # noqa: E402
import numpy as np  # noqa: E402
import soundfile  # noqa: E402
from bench_localization import responses  # noqa: E402
from scipy.signal import fftconvolve, resample_poly  # noqa: E402

from avcli.localization.array import Array  # noqa: E402
from avcli.localization.settings import SteeredSettings  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402

FS, SPEED, SECONDS = 48000, 343.0, 8.0
SPEAKERS = {"decide": "aew", "report": "axb"}


@dataclass(frozen=True)
class Case:
    """A room (3,) m, its T60 in s, the noise in dB below the talker, the seed, and the number of microphones."""

    name: str
    room: tuple[float, float, float]
    rt60: float
    snr_db: float
    seed: int
    walks: bool = False
    microphones: int = 8


CASES = {
    "decide": (
        Case("usual", (6, 5, 3), 0.4, 30, 1),
        Case("another place", (6, 5, 3), 0.4, 30, 2),
        Case("walker", (6, 5, 3), 0.4, 30, 3, walks=True),
        Case("live and noisy", (6, 5, 3), 0.7, 15, 4),
        Case("six microphones", (6, 5, 3), 0.4, 30, 5, microphones=6),
    ),
    "report": (
        Case("usual", (5, 5.5, 3.2), 0.3, 30, 12),
        Case("harder", (7.2, 4.4, 2.8), 0.5, 25, 11),
        Case("walker", (7, 6, 3), 0.45, 30, 13, walks=True),
        Case("live and noisy", (5.5, 5, 3), 0.75, 15, 14),
        Case("six microphones", (6.4, 4.7, 2.9), 0.4, 30, 15, microphones=6),
    ),
}


@dataclass(frozen=True)
class Recording:
    """Samples (n, m), microphones (m, 3) m, the talker's path (k, 4) t, x, y, z, and whether he speaks, every 10 ms."""

    samples: np.ndarray
    microphones: np.ndarray
    path: np.ndarray
    speaks: np.ndarray


def ring(room: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return microphones near the walls, 2.4 to 2.5 m high, (count, 3) m."""
    angle = np.arange(count) * 2.0 * np.pi / count + 0.2
    level = np.clip(1.35 * np.column_stack([np.cos(angle), np.sin(angle)]), -1.0, 1.0)
    return np.column_stack([room[:2] / 2 + (room[:2] / 2 - 0.15) * level, rng.uniform(2.4, 2.5, count)])


def voice(speaker: str, first: int) -> np.ndarray:
    """Return speech of SECONDS, with silence before and after it."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    spoken = [soundfile.read(path) for path in sorted(folder.glob(f"*_{speaker}_*.wav"))]
    if not spoken:
        sys.exit("bench-faults: needs CMU ARCTIC's sentences of aew and axb (AVCLI_SHARED_DATA/speech)")
    resampled = [resample_poly(x, FS // np.gcd(FS, rate), rate // np.gcd(FS, rate)) for x, rate in spoken]
    whole = np.tile(np.concatenate(resampled[first:] + resampled[:first]), 3)[: int(SECONDS * FS)]
    return np.concatenate([np.zeros(FS // 4), 0.05 * whole / np.sqrt(np.mean(whole**2)), np.zeros(FS)])


def recording(case: Case, speaker: str) -> Recording:
    """Simulate a case."""
    rng, room = np.random.default_rng(case.seed), np.array(case.room, float)
    microphones = ring(room, case.microphones, rng)
    dry = voice(speaker, case.seed % 3)
    if case.walks:
        share = np.linspace(0.0, 1.0, 40)[:, None]
        places = np.array([1.0, 1.0, 1.6]) + share * (np.array([room[0] - 2.0, room[1] - 2.2, 0.0]))
    else:
        places = np.array([[*rng.uniform(0.8, room[:2] - 0.8), rng.uniform(1.3, 1.7)]])
    hop = len(dry) / max(len(places) - 1, 1)
    wet = np.zeros((len(dry), len(microphones)))
    order = min(int(SPEED * case.rt60 / room.min()) + 1, 45)
    for k, heard in enumerate(responses(room, FS, case.rt60, places, microphones, order)):
        near = np.clip(1.0 - np.abs(np.arange(len(dry)) / hop - k), 0.0, 1.0) if case.walks else 1.0
        for m, response in enumerate(heard):
            wet[:, m] += fftconvolve(dry * near, response)[: len(dry)]
    wet += np.sqrt(np.mean(wet**2)) * 10 ** (-case.snr_db / 20) * rng.standard_normal(wet.shape)
    energy = np.convolve(dry**2, np.ones(FS // 10) / (FS // 10), "same")
    path = np.column_stack([np.arange(len(places)) * hop / FS, places])
    return Recording(wet, microphones, path, (energy > energy.max() * 10**-2.5)[:: FS // 100])


# --- faults -----------------------------------------------------------------------------------------------------------


def late(samples: np.ndarray, seconds: dict[int, float], rate: float = FS) -> np.ndarray:
    """Delay channels by so many s."""
    size = 2 * len(samples)
    frequency = np.fft.rfftfreq(size, 1.0 / rate)
    found = samples.copy()
    for c, delay in seconds.items():
        turned = np.fft.rfft(samples[:, c], size) * np.exp(-2j * np.pi * frequency * delay)
        found[:, c] = np.fft.irfft(turned, size)[: len(samples)]
    return found


def over(samples: np.ndarray, *channels: int) -> np.ndarray:
    """Turn channels over."""
    return samples * np.where(np.isin(np.arange(samples.shape[1]), channels), -1.0, 1.0)


def hum(samples: np.ndarray, level_db: float) -> np.ndarray:
    """Add 50 Hz and seven harmonics, alike in all channels, that are so much louder than the sound."""
    times = np.arange(len(samples)) / FS
    tones = np.sum([np.sin(2.0 * np.pi * 50.0 * k * times + k) / k for k in range(1, 9)], axis=0)
    level = np.sqrt(np.mean(samples**2)) * 10.0 ** (level_db / 20.0)
    return np.asarray(samples + level * (tones / tones.std())[:, None])


def exchanged(samples: np.ndarray, one: int, other: int) -> np.ndarray:
    """Exchange two channels."""
    order = np.arange(samples.shape[1])
    order[[one, other]] = other, one
    return samples[:, order]


def noise(samples: np.ndarray, *channels: int) -> np.ndarray:
    """Put noise in place of channels."""
    found = samples.copy()
    found[:, channels] = samples.std() * np.random.default_rng(7).standard_normal((len(samples), len(channels)))
    return found


FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": lambda x: x,
    "one dead": lambda x: x * (np.arange(x.shape[1]) != 2),
    "one of noise": lambda x: noise(x, 2),
    "two of noise": lambda x: noise(x, 2, 5),
    "one 26 dB quieter": lambda x: x * np.where(np.arange(x.shape[1]) == 2, 0.05, 1.0),
    "one turned over": lambda x: over(x, 2),
    "two turned over": lambda x: over(x, 2, 5),
    "three turned over": lambda x: over(x, 0, 2, 5),
    "one 3.2 ms late": lambda x: late(x, {2: 0.0032}),
    "two .23 ms late": lambda x: late(x, {2: 10 / 44100, 5: 10 / 44100}),
    "3.2 and 11 ms late": lambda x: late(x, {2: 0.0032, 5: 0.011}),
    "neighbours exchanged": lambda x: exchanged(x, 2, 3),
    "opposite ones exchanged": lambda x: exchanged(x, 1, 1 + x.shape[1] // 2),
    "one turned over, one 2 ms late": lambda x: late(over(x, 2), {5: 0.002}),
    "two exchanged, one turned over": lambda x: over(exchanged(x, 2, 3), 5),
    "all moved on by one": lambda x: np.roll(x, 1, axis=1),
    "a hum 10 dB below the voice": lambda x: hum(x, -10.0),
    "a hum as loud as the voice": lambda x: hum(x, 0.0),
    "a hum 20 dB above it": lambda x: hum(x, 20.0),
}
COMPACT: dict[str, Callable[[np.ndarray, float], np.ndarray]] = {
    "none": lambda x, _: x,
    "one turned over": lambda x, _: over(x, 2),
    "one .1 ms late": lambda x, rate: late(x, {2: 0.0001}, rate),
    "one 1 ms late": lambda x, rate: late(x, {2: 0.001}, rate),
    "one 5 ms late": lambda x, rate: late(x, {2: 0.005}, rate),
    "neighbours exchanged": lambda x, _: exchanged(x, 2, 3),
    "first and third exchanged": lambda x, _: exchanged(x, 0, 2),
    "one 20 dB quieter": lambda x, _: x * np.where(np.arange(x.shape[1]) == 2, 0.1, 1.0),
    "one of noise": lambda x, _: noise(x, 2),
    "one turned over, one 1 ms late": lambda x, rate: late(over(x, 2), {0: 0.001}, rate),
    "one turned over, one of noise": lambda x, _: noise(over(x, 2), 0),
    "two exchanged, one turned over": lambda x, _: over(exchanged(x, 2, 3), 0),
}
MISPLACED = {"places wrong by 2 cm": 0.02, "places wrong by 5 cm": 0.05}


def measured(case: Case, heard: Recording, fault: str) -> dict[str, object]:
    """Return recall, precision and what was said of a case with a fault."""
    samples, microphones = heard.samples, heard.microphones
    if fault in MISPLACED:
        microphones = microphones + np.random.default_rng(case.seed).normal(0.0, MISPLACED[fault], microphones.shape)
    else:
        samples = FAULTS[fault](samples)
    array = Array(microphones, FS, np.array(case.room, float), SPEED)
    localizer = SteeredLocalizer(array, SteeredSettings(), np.random.default_rng(0))
    blocks = (Block(samples[i : i + 4096]) for i in range(0, len(samples), 4096))
    active = hit = 0
    right, false = [], []
    said: list[str] = []
    for decision in localizer.localize(blocks):
        said += decision.notices
        place = np.array([np.interp(decision.time, heard.path[:, 0], column) for column in heard.path[:, 1:].T])
        away = np.hypot(*(decision.positions - place)[:, :2].T)
        nearest = int(away.argmin()) if len(away) else -1
        found = bool(len(away) and away[nearest] < 0.5)
        speaks = bool(heard.speaks[min(int(decision.time * 100), len(heard.speaks) - 1)])
        active, hit = active + speaks, hit + (speaks and found)
        right += [float(away[nearest])] if found else []
        false += [float(s) for k, s in enumerate(decision.scores) if not (found and k == nearest)]
    return {
        "case": case.name,
        "fault": fault,
        "recall": hit / max(active, 1),
        "precision": len(right) / max(len(right) + len(false), 1),
        "median_m": float(np.median(right)) if right else None,
        "false": len(false),
        "false_score": float(np.median(false)) if false else None,
        "said": said,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=list(CASES), default="report")
    parser.add_argument("--only", nargs="+", choices=[*FAULTS, *MISPLACED, *COMPACT], help="faults; by default all")
    parser.add_argument("--compact", action="store_true", help="compact arrays in place of distributed ones")
    parser.add_argument("--data", type=Path, help="measured sets for --compact")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table = of_compact if options.compact else of_distributed
    name = "faults-compact" if options.compact else "faults"
    with open(options.out / f"{name}.jsonl", "w") as rows:
        lines = table(options, lambda found: rows.writelines(json.dumps(row) + "\n" for row in found))
    (options.out / f"{name}.md").write_text("\n".join(lines) + "\n")


def of_distributed(options: argparse.Namespace, keep: Callable[[list[dict[str, object]]], None]) -> list[str]:
    """Return the lines of the table of distributed arrays: recall / precision."""
    cases = CASES[options.split]
    heard = [recording(case, SPEAKERS[options.split]) for case in cases]
    lines = ["| fault | " + " | ".join(case.name for case in cases) + " |", "|---|" + "---|" * len(cases)]
    for fault in options.only or [*FAULTS, *MISPLACED]:
        found = [measured(case, one, fault) for case, one in zip(cases, heard, strict=True)]
        keep(found)
        lines.append(f"| {fault} | " + " | ".join(f"{r['recall']:.2f} / {r['precision']:.2f}" for r in found) + " |")
        print(lines[-1], flush=True)
    return lines


def of_compact(options: argparse.Namespace, keep: Callable[[list[dict[str, object]]], None]) -> list[str]:
    """Return the lines of the table of compact arrays: the share of the moments of speech / false reports (score)."""
    split = {"decide": "decide", "report": "judge"}[options.split]
    heard = list(compact_faults.recordings(split, options.data))
    sets = list(dict.fromkeys(one.set for one in heard))
    lines = ["| fault | " + " | ".join(sets) + " |", "|---|" + "---|" * len(sets)]
    for fault in options.only or list(COMPACT):
        found = [{"fault": fault} | compact_faults.measured(one, COMPACT[fault]) for one in heard]
        keep(found)
        cells = []
        for name in sets:
            here = [row for row in found if row["set"] == name]
            false = [score for row in here for score in row["false"]]
            said = f" ({np.mean(false):.2f})" if false else ""
            cells.append(f"{sum(r['hit'] for r in here) / sum(r['active'] for r in here):.2f}/{len(false)}{said}")
        lines.append(f"| {fault} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    main()
