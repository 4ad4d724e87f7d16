"""How well, how often and how fast avdetect-audio's methods localize, beside the Cramér-Rao bound.

    make bench-localization                           # localization.md, .jsonl and .svg in bench-out/
    make bench-localization BENCH_FLAGS="--seed 5"    # other places and other noise

The rooms are simulated by pyroomacoustics, not by us, with real speech (CMU ARCTIC) where ../shared/data or
AVCLI_SHARED_DATA has it and espeak-ng's voices where it is installed. Score and covariance are fitted elsewhere (make
fit-localization), on another simulator's rooms; the scenes that decide settings (--split fit) and those that are
reported share no place, no path and no voice. A detection is right within 0.5 m in x and y of a talker who is not taken
yet.
"""

import argparse
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
if importlib.util.find_spec("pyroomacoustics") is None:
    bench = ROOT / ".venv-bench" / "bin" / "python"
    if not bench.exists():
        sys.exit("bench-localization: needs pyroomacoustics; make setup-bench installs it")
    os.execv(bench, [str(bench), *sys.argv])

sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
import pyroomacoustics  # noqa: E402
from figures import Row, figure, hand_over  # noqa: E402
from localization_rooms import MICROPHONES, ROOM  # noqa: E402

from avcli.acoustics.recorder import built_in_voices  # noqa: E402
from avcli.localization.array import Array, Decision  # noqa: E402
from avcli.localization.settings import ClosedFormSettings, SteeredSettings  # noqa: E402
from avcli.localization.ssl3d import ClosedFormLocalizer  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402

Condition = tuple[str, float, float]
"""What people do, T60 in s, and the noise in dB below them."""

FS, SPEED = 44100, 343.0
ARRAY = Array(MICROPHONES, FS, ROOM, SPEED)
SPLITS: dict[str, tuple[int, str, tuple[tuple[str, str], ...]]] = {
    "fit": (11, "aew", (("en-us", "Could you open the window please, it is getting warm in this room."),
                        ("en-gb+f2", "Seven people walked along the corridor and talked about the weather."))),
    "report": (907, "axb", (("en-gb-scotland", "The meeting starts at nine and everybody should bring a notebook."),
                           ("en-us+f4", "My brother keeps his old bicycle behind the garden shed."))),
}  # fmt: skip
CONDITIONS: list[Condition] = [
    ("still", 0.1, 30), ("still", 0.1, 10), ("still", 0.35, 30), ("still", 0.35, 10), ("still", 0.6, 30),
    ("still", 0.6, 10), ("still", 0.8, 30), ("walking", 0.35, 30), ("walking", 0.35, 10), ("two", 0.1, 30),
    ("two", 0.35, 30), ("two", 0.6, 30), ("turns", 0.35, 30),
]  # fmt: skip

USUAL: Condition = ("still", 0.35, 30)
"""The thesis's room, in which windows and grids are compared."""


# --- scenes -----------------------------------------------------------------------------------------------------------


@dataclass
class Talker:
    """Where a talker was (times, places), when the voice was sounding (per sample), and the direct sound (n, 8)."""

    times: np.ndarray
    places: np.ndarray
    sounding: np.ndarray
    direct: np.ndarray

    def at(self, time_s: float) -> np.ndarray:
        return np.array([np.interp(time_s, self.times, column) for column in self.places.T])


@dataclass
class Scene:
    samples: np.ndarray
    talkers: list[Talker]
    noise: float


def voices(split: str) -> list[np.ndarray]:
    import soundfile
    from scipy.signal import resample_poly

    _, speaker, spoken = SPLITS[split]
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    recordings = [soundfile.read(path) for path in sorted(folder.glob(f"*_{speaker}_*.wav"))]
    speaks = bool(shutil.which("espeak-ng"))
    if not (recordings and speaks):
        used = "real speech" if recordings else "espeak-ng" if speaks else "the voices of avsim-audio"
        print(f"bench-localization: uses {used} alone", file=sys.stderr)
    if not (recordings or speaks):
        recordings = [(one.samples[:, 0], one.sample_rate_hz) for one in built_in_voices()]
    spoken = spoken if speaks else ()
    with tempfile.TemporaryDirectory() as directory:
        for number, (voice, text) in enumerate(spoken):
            path = Path(directory) / f"{number}.wav"
            subprocess.run(["espeak-ng", "-v", voice, "-w", path, text], check=True)
            recordings.append(soundfile.read(path))
    resampled = [resample_poly(x, FS // np.gcd(FS, rate), rate // np.gcd(FS, rate)) for x, rate in recordings]
    return [0.05 * x / np.sqrt(np.mean(x**2)) for x in resampled]


def responses(
    room: np.ndarray, fs: int, t60: float, places: Sequence[np.ndarray], microphones: np.ndarray, order: int
) -> np.ndarray:
    """Room impulse responses, (places, m, n), by Eyring's absorption; without pyroomacoustics' 40 samples of delay."""
    surface = 2 * (room[0] * room[1] + room[0] * room[2] + room[1] * room[2])
    absorption = 1 - np.exp(-24 * np.log(10) * room.prod() / (SPEED * surface * t60))
    shoebox = pyroomacoustics.ShoeBox(room, fs=fs, materials=pyroomacoustics.Material(absorption), max_order=order)
    shoebox.set_sound_speed(SPEED)
    for place in places:
        shoebox.add_source(place)
    shoebox.add_microphone_array(microphones.T)
    shoebox.compute_rir()
    length = max(len(one) for row in shoebox.rir for one in row)
    result = np.zeros((len(places), len(microphones), length))
    for m, row in enumerate(shoebox.rir):
        for s, one in enumerate(row):
            result[s, m, : len(one)] = one
    return result[:, :, 40:]


def sounding(dry: np.ndarray, decibels: float = -25.0) -> np.ndarray:
    """Whether the voice is on, per sample: the energy of 100 ms within so many dB of the utterance's largest."""
    total = np.concatenate([[0.0], np.cumsum(dry**2)])
    half = FS // 20
    index = np.arange(len(dry))
    energy = total[np.minimum(index + half, len(dry))] - total[np.maximum(index - half, 0)]
    return energy > energy.max() * 10 ** (decibels / 10)


def still(voice: np.ndarray, t60: float, place: np.ndarray, begin: float = 0.5) -> tuple[np.ndarray, Talker]:
    from scipy.signal import fftconvolve

    dry = np.concatenate([np.zeros(int(begin * FS)), voice, np.zeros(FS // 2)])
    order = min(int(np.ceil(SPEED * t60 / ROOM.min())), 60)
    wet, direct = (
        np.column_stack([fftconvolve(dry, h)[: len(dry)] for h in responses(ROOM, FS, t60, [place], MICROPHONES, o)[0]])
        for o in (order, 0)
    )
    return wet, Talker(np.array([0.0]), place[None], sounding(dry), direct)


def walking(
    voice: np.ndarray, t60: float, start: np.ndarray, end: np.ndarray, step: float = 0.01
) -> tuple[np.ndarray, Talker]:
    """A talker who walks from start to end at 1 m/s: each 10 ms of voice from its own place."""
    from scipy.signal import fftconvolve

    duration = np.linalg.norm(end - start)
    count, hop = int(duration / step) + 1, int(step * FS)
    dry = np.tile(np.concatenate([voice, np.zeros(FS // 3)]), 6)[: int(duration * FS)]
    places = start + (end - start) * np.linspace(0.0, 1.0, count)[:, None]
    padded = np.concatenate([np.zeros(hop), dry, np.zeros(2 * hop)])
    rise = np.arange(hop) / hop
    fade = np.concatenate([rise, 1.0 - rise])
    sums = []
    for order in (24, 0):
        wet = np.zeros((len(dry) + 2 * FS, len(MICROPHONES)))
        for k, place in enumerate(places):
            piece = padded[k * hop : (k + 2) * hop] * fade
            for m, h in enumerate(responses(ROOM, FS, t60, [place], MICROPHONES, order)[0]):
                heard = fftconvolve(piece, h)[: len(wet) - k * hop]
                wet[k * hop : k * hop + len(heard), m] += heard
        sums.append(wet[hop : hop + len(dry) + FS // 2])
    dry = np.concatenate([dry, np.zeros(FS // 2)])
    return sums[0], Talker(np.arange(count) * step, places, sounding(dry), sums[1])


def scenes(split: str, condition: Condition, count: int) -> Iterator[Scene]:
    """Yield the scenes of one condition, with noise: (kind, T60 in s, SNR in dB)."""
    kind, t60, snr = condition
    rng = np.random.default_rng([SPLITS[split][0], CONDITIONS.index((kind, t60, 30)) if snr != 30 else
                                 CONDITIONS.index(condition)])  # fmt: skip
    spoken = voices(split)

    def somewhere() -> np.ndarray:
        return np.append(rng.uniform(0.5, 4.16, 2), rng.uniform(1.2, 1.8))

    for number in range(count if kind != "walking" else max(1, count // 2)):
        voice = spoken[number % len(spoken)]
        if kind == "walking":
            start, end = np.array([0.33, rng.uniform(0.6, 4.06), 1.6]), np.array([4.33, rng.uniform(0.6, 4.06), 1.6])
            end = start + (end - start) * 4.0 / np.linalg.norm(end - start)
            parts = [walking(voice, t60, *((start, end) if number % 2 else (end, start)))]
        else:
            parts = [still(voice, t60, somewhere())]
        if kind in ("two", "turns"):
            place = somewhere()
            while np.hypot(*(place - parts[0][1].places[0])[:2]) < 1.0:
                place = somewhere()
            begin = 0.5 + (len(voice) / FS if kind == "turns" else 0.0)
            parts.append(still(spoken[(number + 1 + number // len(spoken)) % len(spoken)], t60, place, begin))
        length = max(len(wet) for wet, _ in parts)
        samples, talkers = np.zeros((length, len(MICROPHONES))), []
        for wet, talker in parts:
            gain = 0.02 / np.sqrt(np.mean(wet**2))  # equal power
            samples[: len(wet)] += gain * wet
            on = np.pad(talker.sounding, (0, length - len(wet)))
            direct = np.pad(gain * talker.direct, ((0, length - len(wet)), (0, 0)))
            talkers.append(replace(talker, sounding=on, direct=direct))
        anyone = np.any([talker.sounding for talker in talkers], axis=0)
        noise = np.sqrt(np.mean(samples[anyone] ** 2)) * 10 ** (-snr / 20)
        yield Scene(samples + noise * rng.standard_normal(samples.shape), talkers, noise)


# --- the bound --------------------------------------------------------------------------------------------------------


def cramer_rao(scene: Scene, talker: Talker, time_s: float, window: float = 0.186) -> tuple[float, float]:
    """Standard deviations (x and y, all three; m) that no unbiased estimator undercuts from one window.

    The talker is a Gaussian signal of the spectrum that the direct sound has, and everything else, echoes included, is
    noise that differs in each channel: the delays' Fisher information (Weinstein & Weiss 1984, for many sensors).
    """
    size = int(window * FS)
    begin = int((time_s + 0.008) * FS) - size // 2
    if begin < 0 or begin + size > len(scene.samples):
        return np.nan, np.nan
    taper = np.hanning(size)[:, None]
    direct = np.fft.rfft(talker.direct[begin : begin + size] * taper, axis=0)
    rest = np.fft.rfft((scene.samples - talker.direct)[begin : begin + size] * taper, axis=0)
    frequency = np.fft.rfftfreq(size, 1.0 / FS)
    bins = np.flatnonzero((frequency > 80) & (frequency < 8000))
    kernel = np.ones(9) / 9

    def smooth(power: np.ndarray) -> np.ndarray:
        return np.column_stack([np.convolve(column, kernel, "same") for column in power.T])[bins]

    ratio = smooth(np.abs(direct) ** 2) / np.maximum(smooth(np.abs(rest) ** 2), 1e-30)
    total = ratio.sum(axis=1)
    # Neighbouring bins of a Hann window are not independent: 1.5 of them count as one.
    omega = 2.0 * (2.0 * np.pi * frequency[bins]) ** 2 / (1.0 + total) / 1.5
    information = np.diag((omega * total) @ ratio) - (ratio * omega[:, None]).T @ ratio
    offset = talker.at(time_s) - MICROPHONES
    slope = offset / np.linalg.norm(offset, axis=1, keepdims=True) / SPEED
    bound = np.linalg.inv(slope.T @ information @ slope)
    return float(np.sqrt(bound[0, 0] + bound[1, 1])), float(np.sqrt(np.trace(bound)))


# --- methods ----------------------------------------------------------------------------------------------------------

METHODS: dict[str, SteeredSettings | ClosedFormSettings] = {
    "3d-ssl": ClosedFormSettings(),
    "3d-ssl --refine": ClosedFormSettings(refine=True),
    "srp": SteeredSettings(),
}
VARIANTS: dict[str, SteeredSettings | ClosedFormSettings] = {
    "3d-ssl --refine --window 0.186": ClosedFormSettings(refine=True, window=0.186),
    "srp --max-speakers 1": SteeredSettings(max_speakers=1),
    "srp --context 0": SteeredSettings(context=0.0),
    "srp --context 0 --window 0.093": SteeredSettings(context=0.0, window=0.093),
    "srp --context 0 --window 0.372": SteeredSettings(context=0.0, window=0.372),
    "srp --beta 0.7": SteeredSettings(beta=0.7),
    "srp --cell 0.5": SteeredSettings(cell=0.5),
    "srp --resolution 0.08": SteeredSettings(resolution=0.08),
    "srp --keep 8": SteeredSettings(keep=8),
    "srp --keep 64": SteeredSettings(keep=64),
}
"""Windows, grids and the rest, compared where the thesis's room is: T60 0.35 s, 30 dB, one who stands."""


def run(settings: SteeredSettings | ClosedFormSettings, scene: Scene) -> tuple[list[Decision], float]:
    """Decisions, and CPU seconds a decision without the start."""
    blocks = (Block(scene.samples[i : i + 4096]) for i in range(0, len(scene.samples), 4096))
    if isinstance(settings, ClosedFormSettings):
        begin = time.process_time()
        decisions = list(ClosedFormLocalizer(ARRAY, settings).localize(blocks))
    else:
        localizer = SteeredLocalizer(ARRAY, settings, np.random.default_rng(0))
        localizer.noise(1)
        begin = time.process_time()
        decisions = list(localizer.localize(blocks))
    return decisions, (time.process_time() - begin) / max(len(decisions), 1)


def matched(decisions: list[Decision], scene: Scene) -> tuple[list[tuple], int, int]:
    """One row a detection: right, error (3,), score, covariance (3, 3); and active talkers, and how many were found."""
    rows: list[tuple] = []
    active = hit = 0
    for decision in decisions:
        sample = min(int(decision.time * FS), len(scene.samples) - 1)
        places = np.array([talker.at(decision.time) for talker in scene.talkers])
        taken = set()
        for position, covariance, score in zip(decision.positions, decision.covariances, decision.scores, strict=True):
            error = position - places
            nearest = int(np.argmin(np.hypot(error[:, 0], error[:, 1])))
            right = np.hypot(*error[nearest, :2]) < 0.5 and nearest not in taken
            if right:
                taken.add(nearest)
            rows.append((right, error[nearest], score, covariance))
        on = [bool(talker.sounding[sample]) for talker in scene.talkers]
        active += sum(on)
        hit += sum(found and nearest in taken for nearest, found in enumerate(on))
    return rows, active, hit


def summary(method: str, condition: Condition, prepared: list[Scene]) -> dict[str, Any]:
    rows: list[tuple] = []
    active, hit, cost = 0, 0, list[float]()
    for scene in prepared:
        decisions, seconds = run((METHODS | VARIANTS)[method], scene)
        more, on, found = matched(decisions, scene)
        rows, active, hit = rows + more, active + on, hit + found
        cost.append(seconds)
    right = np.array([row[0] for row in rows], bool)
    errors = np.array([row[1] for row in rows]).reshape(-1, 3)[right]
    covariances = np.array([row[3] for row in rows]).reshape(-1, 3, 3)[right]
    squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors) if len(errors) else np.zeros(0)
    level = np.linalg.inv(covariances[:, :2, :2]) if len(errors) else np.zeros((0, 2, 2))
    squared_level = np.einsum("ni,nij,nj->n", errors[:, :2], level, errors[:, :2])
    scores = np.array([row[2] for row in rows])

    def median(values: np.ndarray) -> float | None:
        return float(np.median(values)) if len(values) else None

    return {
        "method": method,
        "scene": condition[0],
        "rt60_s": condition[1],
        "snr_db": condition[2],
        "active": active,
        "recall": hit / max(active, 1),
        "precision": float(right.mean()) if len(right) else None,
        "mean_score": float(scores.mean()) if len(scores) else None,
        "error_2d_m": median(np.hypot(*errors[:, :2].T)),
        "error_2d_p90_m": float(np.quantile(np.hypot(*errors[:, :2].T), 0.9)) if len(errors) else None,
        "error_3d_m": median(np.linalg.norm(errors, axis=1)),
        "nees_3d": float(squared.mean()) if len(squared) else None,
        "nees_3d_median": median(squared),
        "coverage95_3d": float((squared < 7.815).mean()) if len(squared) else None,
        "coverage95_2d": float((squared_level < 5.991).mean()) if len(squared) else None,
        "ms": 1e3 * float(np.min(cost)),
    }


def bounds(prepared: list[Scene]) -> tuple[float, float]:
    found: list[tuple[float, float]] = []
    for scene in prepared:
        for talker in scene.talkers:
            moments = np.arange(0.0, len(scene.samples) / FS, 0.1)
            found += [cramer_rao(scene, talker, t) for t in moments if talker.sounding[int(t * FS)]]
    level, space = np.nanmedian(found, axis=0).tolist()
    return level, space


# --- the report -------------------------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="folder for the table, records and plot")
    parser.add_argument("--scenes", type=int, default=8, help="scenes of each condition (walkers: half as many)")
    parser.add_argument("--split", choices=list(SPLITS), default="report", help="which voices and places")
    parser.add_argument("--seed", type=int, help="seed of the places and of the noise, instead of the split's")
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS | VARIANTS))
    parser.add_argument("--kinds", nargs="*", default=["still", "walking", "two", "turns"], help="kinds of scenes")
    parser.add_argument("--no-variants", action="store_true", help="leave windows and grids out")
    options = parser.parse_args()
    if options.seed is not None:
        SPLITS[options.split] = (options.seed, *SPLITS[options.split][1:])
    options.out.mkdir(parents=True, exist_ok=True)
    records = []
    for condition in (condition for condition in CONDITIONS if condition[0] in options.kinds):
        prepared = list(scenes(options.split, condition, options.scenes))
        level, space = bounds(prepared)
        methods = list(options.methods)
        if condition == USUAL and not options.no_variants:
            methods += list(VARIANTS)
        for method in methods:
            record = {**summary(method, condition, prepared), "bound_2d_m": level, "bound_3d_m": space}
            records.append(record)
            print(row(record), flush=True)
    seed = SPLITS[options.split][0]
    (options.out / "localization.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    hand_over(options.out, "detect-audio", (one for record in records for one in figures(record)))
    (options.out / "localization.md").write_text(table(records, f"split {options.split}, seed {seed}"))
    if importlib.util.find_spec("matplotlib"):
        plot(records, options.out / "localization.svg")


def figures(record: dict[str, Any]) -> Iterator[Row]:
    case = f"{record['scene']}, T60 {record['rt60_s']} s, noise at {record['snr_db']} dB"
    given = ("detect-audio", case, f"avcli {record['method']}", record["ms"] / 1e3, "decision")
    yield figure(*given, 1 - record["recall"], "share missed")
    if record["error_2d_m"] is not None:
        yield figure(*given, record["error_2d_m"], "m")


COLUMNS = (
    ("scene", "scene", None), ("T60 s", "rt60_s", "g"), ("SNR dB", "snr_db", "g"), ("method", "method", None),
    ("recall", "recall", ".3f"), ("precision", "precision", ".3f"), ("score", "mean_score", ".3f"),
    ("error x y, mm", "error_2d_m", "mm"), ("its 90 %, mm", "error_2d_p90_m", "mm"),
    ("bound x y, mm", "bound_2d_m", "mm"),
    ("error x y z, mm", "error_3d_m", "mm"), ("bound x y z, mm", "bound_3d_m", "mm"), ("NEES of 3", "nees_3d", ".2f"),
    ("its median of 2.37", "nees_3d_median", ".2f"), ("in 95 %, x y", "coverage95_2d", ".2f"),
    ("in 95 %, x y z", "coverage95_3d", ".2f"), ("CPU ms", "ms", ".1f"),
)  # fmt: skip


def row(record: dict[str, Any]) -> str:
    """One row of a Markdown table."""

    def shown(value: Any, form: str | None) -> str:
        if value is None:
            return ""
        if form == "mm":
            return f"{1000.0 * value:.1f}"
        return format(value, form or "")

    return "| " + " | ".join(shown(record[key], form) for _, key, form in COLUMNS) + " |"


def table(records: list[dict[str, Any]], what: str) -> str:
    """What was measured, as Markdown."""
    head = "| " + " | ".join(name for name, _, _ in COLUMNS) + " |\n"
    head += "|" + "|".join(" --- " if form is None else " ---: " for _, _, form in COLUMNS) + "|\n"
    plain = [record for record in records if record["method"] in METHODS]
    others = [record for record in records if record["method"] in VARIANTS]
    text = f"""# Localization: error, recall, precision and run time

By `make bench-localization` ({what}), load {os.getloadavg()[0]:.1f}.
Rooms by pyroomacoustics, the thesis's eight microphones. A detection is right within 0.5 m in x and y of a talker;
recall is over the tenths of a second in which a talker sounds. Errors are medians over what is right. NEES is the
normalised error squared of three dimensions, its mean and its median; then the shares of errors inside the ellipses and
ellipsoids that should hold 95 %. CPU time is of one process for a decision, the start left out, and the
least of the scenes.
The bound is Cramér and Rao's for one window of 0.186 s, with echoes as noise; several windows allow less.

![recall against run time, and error against the bound](localization.svg)

## Methods

"""
    text += head + "".join(row(record) + "\n" for record in plain)
    if others:
        default = [r for r in plain if (r["scene"], r["rt60_s"], r["snr_db"]) == ("still", 0.35, 30)]
        text += "\n## Windows and grids\n\n" + head
        text += "".join(row(record) + "\n" for record in [*default, *others])
    return text


def plot(records: list[dict[str, Any]], path: Path) -> None:
    """Recall against run time, and error against the bound."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "localization"
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    shapes = {"still": "o", "walking": ">", "two": "s", "turns": "D"}
    for number, method in enumerate(METHODS):
        for kind, shape in shapes.items():
            mine = [r for r in records if r["method"] == method and r["scene"] == kind]
            style = {"color": f"C{number}", "marker": shape, "s": 26, "alpha": 0.8, "linewidths": 0}
            left.scatter([r["ms"] for r in mine], [r["recall"] for r in mine], **style)
            found = [r for r in mine if r["error_2d_m"] is not None]
            right.scatter([r["bound_2d_m"] for r in found], [r["error_2d_m"] for r in found], **style)
    variants = [r for r in records if r["method"] in VARIANTS]
    left.scatter([r["ms"] for r in variants], [r["recall"] for r in variants], color="grey", marker="x", s=22)
    left.set(xlabel="CPU ms a decision", ylabel="recall", xscale="log", ylim=(0, 1.03))
    right.set(xlabel="Cramér-Rao bound of one window, x and y (m)", ylabel="median error, x and y (m)")
    right.set(xscale="log", yscale="log")
    right.minorticks_off()
    right.set_xticks([5e-4, 1e-3, 2e-3, 5e-3], ["0.0005", "0.001", "0.002", "0.005"])
    left.minorticks_off()
    left.set_xticks([3, 5, 10, 20], ["3", "5", "10", "20"])
    limits = np.array(right.get_xlim())
    right.plot(limits, limits, color="grey", linewidth=0.8, zorder=0)
    right.set_xlim(limits)
    for number, method in enumerate(METHODS):
        left.scatter([], [], color=f"C{number}", marker="o", label=method)
    for kind, shape in shapes.items():
        left.scatter([], [], color="grey", marker=shape, label=kind)
    if variants:
        left.scatter([], [], color="grey", marker="x", label="other windows and grids")
    left.legend(fontsize=8)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
