"""The beam at a track beside the best single microphone, in simulated and in measured rooms.

    make setup-bench bench-beam                              # rooms of pyroomacoustics; beam.md in bench-out/
    make bench-beam BENCH_FLAGS="--data DIR"                 # measured rooms, the folders of real_audio_sets.py
    make bench-beam BENCH_FLAGS="--split decide"             # what settings were decided on; by default what judges

One to three people of CMU ARCTIC talk at once, noise 25 dB below their sound; tracks are where they stand, and in the
simulated rooms 5 cm (sd) beside it. What of a signal follows from what was said by a filter of 48 ms is taken for the
voice, all the rest for noise and reverberation (Vincent et al. 2006); both are A-weighted. A filter that colours the
voice costs nothing there, so its intelligibility is told beside it: ESTOI, 0 to 1 (Jensen & Taal 2016). The best
microphone is that of the largest ratio, which a listener does not know beforehand.
"""

import argparse
import importlib.util
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
if importlib.util.find_spec("pyroomacoustics") is None:
    bench = ROOT / ".venv-bench" / "bin" / "python"
    if not bench.exists():
        sys.exit("bench-beam: needs pyroomacoustics; make setup-bench installs it")
    os.execv(bench, [str(bench), *sys.argv])

import numpy as np  # noqa: E402
import pyroomacoustics as pra  # noqa: E402
import soundfile  # noqa: E402
from bench_real_audio import SPEAKERS, delay  # noqa: E402
from pystoi import stoi  # noqa: E402
from real_audio_sets import LINE, RANDOM, SETS, Measured  # noqa: E402
from scipy.linalg import solve_toeplitz  # noqa: E402
from scipy.signal import fftconvolve, resample_poly  # noqa: E402

from avcli.localization.array import Array  # noqa: E402
from avcli.localization.beam import Beams  # noqa: E402
from avcli.localization.beam import Path as Way  # noqa: E402

RATE, SECONDS, NOISE_DB, TRACK_M = 16000, 4.0, 25.0, 0.05
EARLY, LATE = 256, 512  # samples of the filter before and after the strongest arrival
SHAPES = ("circle of 10 cm", "grid of 1 m", "grid of 2 m", "line of 4 m", "around the room")


@dataclass(frozen=True)
class Case:
    """What is recorded in one room.

    Attributes:
        name: of the row of the table.
        array: the microphones.
        tracks: (k, 2) m where people are said to be.
        said: (k, n) their voices.
        heard: (n, m) what the microphones record.
    """

    name: str
    array: Array
    tracks: np.ndarray
    said: np.ndarray
    heard: np.ndarray


def sentences(split: str, count: int, first: int) -> np.ndarray:
    """Return (count, n) different sentences of the speaker of a split, at RATE."""
    folder = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    paths = sorted(folder.glob(f"*_{SPEAKERS[split]}_*.wav"))
    if not paths:
        sys.exit("bench-beam: needs CMU ARCTIC's sentences of aew and axb (AVCLI_SHARED_DATA/speech)")
    voices = np.zeros((count, int(SECONDS * RATE)))
    for k in range(count):
        samples, rate = soundfile.read(paths[(first + k) % len(paths)])
        whole = resample_poly(samples, RATE, rate)
        begin = 4000 * (first % 3) + RATE // 4
        voice = np.tile(whole, 3)[k * 5000 :][: voices.shape[1] - begin]
        voices[k, begin:] = voice / np.sqrt(np.mean(voice**2))
    return voices


def recorded(
    name: str,
    array: Array,
    tracks: np.ndarray,
    said: np.ndarray,
    responses: list[np.ndarray],
    rng: np.random.Generator,
) -> Case:
    """Convolve voices with responses (k times (m, n)), and add noise."""
    heard = np.zeros((said.shape[1], len(array.microphones)))
    for voice, each in zip(said, responses, strict=True):
        heard += np.stack([fftconvolve(voice, one)[: len(heard)] for one in each], axis=1)
    heard += np.sqrt(np.mean(heard**2)) * 10 ** (-NOISE_DB / 20) * rng.standard_normal(heard.shape)
    return Case(name, array, tracks, said, heard)


def placed(shape: str, room: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return 8 microphones (8, 3) m of a shape somewhere in a room."""
    middle = np.array([room[0] / 2 + rng.uniform(-0.3, 0.3), room[1] / 2 + rng.uniform(-0.3, 0.3)])
    height = rng.uniform(1.0, room[2] - 0.2)
    turn = rng.uniform(0, 2 * np.pi)
    if shape == "line of 4 m":
        across = np.linspace(-2, 2, 8)
        return np.stack([room[0] / 2 + across * min(1, (room[0] - 0.4) / 4), np.full(8, 0.15), np.full(8, height)], 1)
    if shape == "around the room":
        share = (np.arange(8) + rng.uniform(0, 1)) / 8 * 2 * np.pi
        edge = np.stack([np.cos(share), np.sin(share)], 1)
        edge /= np.abs(edge).max(axis=1, keepdims=True)
        return np.column_stack([room[:2] / 2 + edge * (room[:2] / 2 - 0.1), rng.uniform(1.0, room[2] - 0.2, 8)])
    if shape == "circle of 10 cm":
        share = np.arange(8) / 8 * 2 * np.pi
        flat = 0.1 * np.stack([np.cos(share), np.sin(share)], 1)
    else:
        half = float(shape.split()[2]) / 2
        flat = half * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1], [0, -0.5], [-0.5, 0.5], [0.5, 0], [0, 1]])
        turn = 0.0
    turned = flat @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.column_stack([middle + turned, np.full(8, height)])


def simulated(split: str, seeds: int) -> Iterator[Case]:
    """Rooms of images and directed mouths (pyroomacoustics), of T60 0.2 to 0.7 s."""
    for number in range(seeds):
        for k, shape in enumerate(SHAPES):
            rng = np.random.default_rng([split == "judge", number, k])
            room = np.array([rng.uniform(4.5, 8), rng.uniform(4.5, 7), rng.uniform(2.4, 3.2)])
            t60, people = rng.choice([0.2, 0.35, 0.5, 0.7]), 1 + number % 3
            absorption, order = pra.inverse_sabine(t60, room)
            world = pra.ShoeBox(room, RATE, materials=pra.Material(absorption), max_order=min(order, 22))
            microphones = placed(shape, room, rng)
            world.add_microphone_array(microphones.T)
            places: list[np.ndarray] = []
            while len(places) < people:
                place = rng.uniform([0.6, 0.6], room[:2] - 0.6)
                if all(np.hypot(*(place - other[:2])) > 1 for other in places):
                    places.append(np.array([*place, rng.uniform(1.2, 1.75)]))
            for place in places:
                facing = pra.directivities.DirectionVector(azimuth=rng.uniform(0, 360), colatitude=90, degrees=True)
                mouth = pra.directivities.SubCardioid(facing)
                world.add_source(place, directivity=mouth)
            world.compute_rir()
            count = max(len(one) for row in world.rir for one in row)
            responses = [
                np.stack([np.pad(row[source], (0, count - len(row[source]))) for row in world.rir])[:, 40:]
                for source in range(people)
            ]
            tracks = np.array(places)[:, :2] + rng.normal(0, TRACK_M, (people, 2))
            array = Array(microphones, RATE, room, pra.constants.get("c"))
            yield recorded(shape, array, tracks, sentences(split, people, number), responses, rng)


def measured(split: str, data: Path) -> Iterator[Case]:
    """Each loudspeaker of the measured rooms by itself, and beside the next one of the same room."""
    for one in (one for one in SETS if (data / one.folder).is_dir()):
        cases = [case for case in one.read(data / one.folder) if split in ("both", case.split)]
        cases = [case for case in cases if not case.set.startswith((LINE, RANDOM))]
        cases = cases[:: max(1, len(cases) // 8)]
        for number, case in enumerate(cases):
            same = [
                other for other in cases if other.split == case.split and not np.allclose(other.source, case.source)
            ]
            for people in ([case], [case, same[number % len(same)]] if same else []):
                if people:
                    yield of_measured(people, number)


def of_measured(people: list[Measured], number: int) -> Case:
    """One measured room with a loudspeaker for each person."""
    case, rng = people[0], np.random.default_rng([7, number])
    shared = np.gcd(case.sample_rate, RATE)
    late = [round(delay(one) * RATE) for one in people]
    responses = [
        np.roll(resample_poly(one.responses, RATE // shared, case.sample_rate // shared, axis=1), -shift, axis=1)
        for one, shift in zip(people, late, strict=True)
    ]
    scale = [np.sqrt(np.mean(one**2, axis=1).max()) for one in responses]
    responses = [one / size for one, size in zip(responses, scale, strict=True)]
    array = Array(case.microphones, RATE, case.room, 343.0)
    tracks = np.array([one.source[:2] for one in people])
    split = "decide" if case.split == "decide" else "judge"
    return recorded(case.set, array, tracks, sentences(split, len(people), number), responses, rng)


def weighted(samples: np.ndarray) -> np.ndarray:
    """A-weighting (IEC 61672-1) along the last axis, without its phase."""
    f2 = np.fft.rfftfreq(samples.shape[-1], 1 / RATE) ** 2
    gain = 12194**2 * f2**2 / ((f2 + 20.6**2) * np.sqrt((f2 + 107.7**2) * (f2 + 737.9**2)) * (f2 + 12194**2))
    return np.fft.irfft(np.fft.rfft(samples) * gain, samples.shape[-1])


def ratio_db(output: np.ndarray, said: np.ndarray) -> float:
    """Return the power of what follows from what was said, over that of the rest, in dB."""
    size = 1 << (2 * len(said) - 1).bit_length()
    spectrum, own = np.fft.rfft(weighted(output), size), np.fft.rfft(weighted(said), size)
    cross = np.fft.irfft(spectrum * own.conj(), size)
    first = int(np.abs(cross[: RATE // 8]).argmax()) - EARLY
    auto = np.fft.irfft(np.abs(own) ** 2, size)[: EARLY + LATE]
    auto[0] *= 1 + 1e-6
    wanted = np.take(cross, np.arange(first, first + EARLY + LATE), mode="wrap")
    filtered = solve_toeplitz(auto, wanted)
    explained = float(filtered @ wanted)
    whole = float(np.sum(weighted(output) ** 2))
    return 10 * np.log10(explained / max(whole - explained, 1e-12 * whole))


def understood(output: np.ndarray, said: np.ndarray) -> float:
    """Return ESTOI of a signal, moved to where it fits what was said."""
    size = 1 << (2 * len(said) - 1).bit_length()
    cross = np.abs(np.fft.irfft(np.fft.rfft(output, size) * np.fft.rfft(said, size).conj(), size))
    late = int(np.roll(cross, RATE // 32)[: RATE // 8].argmax()) - RATE // 32
    first, last = max(late, 0), len(said) + min(late, 0)
    return float(stoi(said[first - late : last - late], output[first:last], RATE, extended=True))


def heard_by(case: Case) -> list[tuple[float, float, float, float]]:
    """Return of each person the ratio in dB and ESTOI of the best microphone, and of the beam."""

    def read(first: int, last: int) -> np.ndarray:
        begin, end = max(first, 0), min(last, len(case.heard))
        return np.pad(case.heard[begin:end], ((begin - first, last - end), (0, 0)))

    ways = {k: Way(np.array([0.0, SECONDS]), np.tile(track, (2, 1))) for k, track in enumerate(case.tracks)}
    beams = Beams(case.array, ways, read).hear(0, len(case.heard))
    found = []
    for k, voice in enumerate(case.said):
        ratios = [ratio_db(channel, voice) for channel in case.heard.T]
        best = int(np.argmax(ratios))
        near = ratios[best], understood(case.heard[:, best], voice)
        found.append((*near, ratio_db(beams[k], voice), understood(beams[k], voice)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="directory with the measured sets as folders")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out", help="directory of beam.md")
    parser.add_argument("--split", choices=("decide", "judge"), default="judge")
    parser.add_argument("--seeds", type=int, default=6, help="rooms of each shape")
    chosen = parser.parse_args()
    cases = measured(chosen.split, chosen.data) if chosen.data else simulated(chosen.split, chosen.seeds)
    found: dict[tuple[str, int], list[tuple[float, float, float, float]]] = {}
    for case in cases:
        found.setdefault((case.name, len(case.said)), []).extend(heard_by(case))
    lines = [
        "| microphones | people | heard | best microphone, dB | beam, dB | gain: mean | worst | best microphone, ESTOI"
        " | gain: mean | worst |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for (name, people), rows in sorted(found.items()):
        best, clear, beam, beam_clear = np.array(rows).T
        gain, clearer = beam - best, beam_clear - clear
        lines.append(
            f"| {name} | {people} | {len(gain)} | {best.mean():.1f} | {beam.mean():.1f} | {gain.mean():+.1f} |"
            f" {gain.min():+.1f} | {clear.mean():.2f} | {clearer.mean():+.2f} | {clearer.min():+.2f} |"
        )
    chosen.out.mkdir(parents=True, exist_ok=True)
    (chosen.out / "beam.md").write_text("\n".join([*lines, ""]))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
