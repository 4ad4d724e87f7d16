"""Run time against error of the room simulation, beside pyroomacoustics and rir-generator.

    python tests/bench/bench_audio.py --out bench-out [--peers .venv-bench/bin/python] [--quick]

Everything is measured in one run, in CPU seconds (the least of several; set OPENBLAS_NUM_THREADS=1), and against the
same ideal: for a response the band-limited sum over all its images in float64, for a scene our own rendering at -90 dB,
which in turn is checked against the analytic solution by retarded time. Peers run in an environment of their own
(`make setup-bench`); what differs by convention is taken out before comparing (pyroomacoustics: a factor of 4 pi and 40
samples; both: the sign of a reflection).
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
from figures import Row, figure, hand_over
from numpy.typing import ArrayLike

from avcli.acoustics.absorption import sabine_absorption
from avcli.acoustics.images import image_microphones, shoebox_rir
from avcli.acoustics.recorder import built_in_voices
from avcli.acoustics.sampling import Switching, interpolation
from avcli.acoustics.signals import power_spectrum, resample, source_signal
from avcli.acoustics.speakers import Speakers
from avcli.acoustics.surroundings import Surroundings
from avcli.acoustics.trajectory import Trajectory
from avcli.formats import media
from avcli.formats.records import Identified
from avcli.scene.scenario import LABORATORY

Result = TypeVar("Result")

ROOM, RT60, RATE, C = np.array([4.66, 4.66, 3.0]), 0.35, 44100, 343.0
MICROPHONES = np.array([one["position"] for one in LABORATORY["microphone_config"]["mic_positions_m"]])
PLACES = [0.43, 1.73, 3.0]
"""m, x of the places whose responses are compared; y = 2.33, z = 1.6."""
SAMPLES = round(RT60 * RATE)
POSITIONS = 400
"""places of the thesis's scene: 4 s in steps of 10 ms."""

PEERS = """
import sys, time, json, numpy as np
spec = json.load(sys.stdin)
found = {}
def timed(call, repeat):
    best = np.inf
    for _ in range(repeat):
        begin = time.process_time(); result = call(); best = min(best, time.process_time() - begin)
    return result, best
try:
    import pyroomacoustics as pra
    pra.constants.set("c", spec["c"])
    absorption, order = pra.inverse_sabine(spec["rt60"], spec["room"], c=spec["c"])
    for highpass in (True, False):
        pra.constants.set("rir_hpf_enable", highpass)
        for highest in (10, 20, order):
            responses, cpu = [], 0.0
            for x in spec["places"]:
                def call():
                    room = pra.ShoeBox(spec["room"], fs=spec["rate"], max_order=highest,
                                       materials=pra.Material(1 - spec["beta"] ** 2))
                    room.add_source([x, 2.33, 1.6]); room.add_microphone_array(np.array(spec["microphones"]).T)
                    room.compute_rir()
                    return [np.asarray(r[0]) for r in room.rir]
                rirs, seconds = timed(call, 2)
                cpu += seconds
                out = np.zeros((len(rirs), spec["samples"]))
                for row, r in zip(out, rirs):
                    r = r[40:40 + spec["samples"]] / (4 * np.pi)
                    row[:len(r)] = r
                responses.append(out)
            name = f"pyroomacoustics, order {highest}, high pass {'on' if highpass else 'off'}"
            found[name] = cpu / len(spec["places"])
            np.save(f"{spec['folder']}/{name}.npy", responses)
except ImportError as error:
    print(error, file=sys.stderr)
try:
    import rir_generator
    def call(x, m):
        return rir_generator.generate(c=spec["c"], fs=spec["rate"], r=[m], s=[x, 2.33, 1.6], L=spec["room"],
                                      beta=[spec["beta"]] * 6, nsample=spec["samples"], hp_filter=False)[:, 0]
    responses, cpu = [], 0.0
    for x in spec["places"]:
        rirs, seconds = zip(*(timed(lambda: call(x, m), 1) for m in spec["microphones"][:2]))
        cpu += sum(seconds) / 2 * len(spec["microphones"])
        responses.append(rirs)
    name = "rir-generator, high pass off"
    found[name] = cpu / len(spec["places"])
    np.save(f"{spec['folder']}/{name}.npy", responses)
except ImportError as error:
    print(error, file=sys.stderr)
print(json.dumps(found))
"""


def cpu_of(call: Callable[[], Result], repeat: int = 3) -> tuple[Result, float]:
    """Return a result and the CPU time of the fastest of some calls, s."""
    best = np.inf
    for _ in range(repeat):
        begin = time.process_time()
        result = call()
        best = min(best, time.process_time() - begin)
    return result, best


def decibels(
    found: ArrayLike, expected: ArrayLike, spectrum: Callable[[np.ndarray], np.ndarray] | None = None
) -> float:
    """Error relative to the expected, over 0.1 to 18 kHz and, with a power spectrum, for a sound that has it."""
    one, other = (np.fft.rfft(x, axis=-1) for x in (found, expected))
    frequencies = np.fft.rfftfreq(2 * (other.shape[-1] - 1), 1 / RATE)
    inside = (frequencies > 100) & (frequencies < 18000)
    weight = inside if spectrum is None else inside * spectrum(frequencies)
    error = np.sum(np.abs(one - other) ** 2 * weight) / np.sum(np.abs(other) ** 2 * weight)
    return float(10 * np.log10(max(error, 1e-30)))


def speechlike(frequencies: np.ndarray) -> np.ndarray:
    """The long-term power of speech: flat to 500 Hz, then 9 dB an octave less."""
    return np.minimum(1.0, (500 / np.maximum(frequencies, 1)) ** 3)


def ideal(x: float, microphone: np.ndarray, beta: float, sign: int) -> np.ndarray:
    """Σ aᵢ sinc(n − τᵢ) over all images within the response, in float64."""
    source = np.array([x, 2.33, 1.6])
    images = image_microphones(ROOM, microphone, np.full(6, sign * beta), source, (SAMPLES - 1) / RATE * C)
    distances = images.distances(source)
    delays, amplitudes = distances * RATE / C, images.amplitudes(distances)
    alternating = -np.sin(np.pi * delays) * amplitudes / np.pi  # sin π(n − τ) = −(−1)ⁿ sin πτ
    response = np.empty(SAMPLES)
    for n in range(SAMPLES):
        response[n] = np.sum(alternating / (n - delays)) * (1 - 2 * (n % 2))
    return response


def responses(out: Path, peers: str | None, quick: bool) -> list[dict]:
    """Time and error of static responses to all eight microphones."""
    beta = float(np.sqrt(1 - sabine_absorption(ROOM, RT60)[0]))
    places, compared = PLACES[: 1 if quick else 3], MICROPHONES[:2]
    reference = {sign: np.array([[ideal(x, m, beta, sign) for m in compared] for x in places]) for sign in (-1, 1)}
    rows = []

    def add(name: str, seconds: float, found: np.ndarray, sign: int) -> None:
        errors = [decibels(found, reference[sign], weight) for weight in (None, speechlike)]
        rows.append({"method": name, "ms_a_position": 1e3 * seconds, "white_db": errors[0], "speech_db": errors[1]})
        print(f"{name:48s} {1e3 * seconds:9.2f} ms  white {errors[0]:7.1f} dB  speech {errors[1]:7.1f} dB", flush=True)

    for error_db in (-20, -30, -40, -50, -60, None):
        timed = [
            cpu_of(partial(shoebox_rir, ROOM, [x, 2.33, 1.6], MICROPHONES, beta, RATE, SAMPLES, error_db=error_db))
            for x in places
        ]
        found = np.array([rirs[: len(compared)] for rirs, _ in timed])
        name = f"avcli, {error_db or 'all'}{' dB' if error_db else ' images'}"
        add(name, float(np.mean([s for _, s in timed])), found, -1)
    if peers and Path(peers).exists():
        folder = out / "peers"
        folder.mkdir(parents=True, exist_ok=True)
        spec = {
            "room": ROOM.tolist(), "rt60": RT60, "rate": RATE, "c": C, "beta": beta, "samples": SAMPLES,
            "places": places, "microphones": MICROPHONES.tolist(), "folder": str(folder),
        }  # fmt: skip
        result = subprocess.run(
            [peers, "-c", PEERS], input=json.dumps(spec), capture_output=True, text=True, check=True
        )
        for name, seconds in json.loads(result.stdout).items():
            add(name, seconds, np.load(folder / f"{name}.npy")[:, : len(compared)], 1)
    else:
        print(f"no peers: {peers} is not there (make setup-bench)")
    return rows


def voice(path: str | None) -> np.ndarray:
    """Return the source signal of a recording, or of the first built-in voice, (n,)."""
    recording = media.Sound(*media.read_audio(path)) if path else built_in_voices()[0]
    return source_signal(recording, RATE, 60)


def scene(
    people: int = 1,
    *,
    dry: np.ndarray,
    error_db: float,
    rt60: float = RT60,
    rate: int = RATE,
    microphones: np.ndarray = MICROPHONES,
    moving: int = 0,
    decay: float = np.inf,
    end_s: float = 0.0,
    switch_s: float | None = None,
) -> tuple[np.ndarray, float]:
    """Render the thesis's walk; return the sound, (m, n), and CPU seconds."""
    followed = rt60 * min(15 - error_db, decay) / 60
    seconds_moving = np.linspace(0, 2, 21)
    to_and_fro = np.abs(1 - seconds_moving)[:, None] * (0.0, 0.0, -1.0)
    paths = tuple(
        Trajectory(seconds_moving, place + to_and_fro) if i < moving else None for i, place in enumerate(microphones)
    )
    surroundings = Surroundings(
        ROOM, -np.sqrt(1 - sabine_absorption(ROOM, rt60)), microphones, rate, followed * C,
        rt60_s=rt60, end_s=end_s, trajectories=paths,
    )  # fmt: skip
    begin = time.process_time()
    speakers = Speakers(surroundings, [dry], error_db=error_db, switch_s=switch_s)
    for k in range(41):
        mouths = np.array([[0.33 + k / 10, 0.8 + 3 * (i + 0.51) / people, 1.6] for i in range(people)])
        floor, ids = mouths * (1, 1, 0), np.arange(people)
        speakers.step(Identified(k / 10, ids, floor, mouths, np.ones(people)))
    speakers.finish()
    sound = speakers.take(0, round((4 + RT60) * rate))
    return sound, time.process_time() - begin


def moving(dry: np.ndarray, quick: bool) -> list[dict]:
    """Time and error of the whole scene: responses, interpolation, convolution."""
    reference, _ = scene(dry=dry, error_db=-90.0)
    rows = []
    settings: list[tuple[str, dict[str, Any]]] = [
        (f"avcli, {e} dB", {"error_db": float(e)}) for e in ((-20, -40, -60) if quick else range(-20, -71, -10))
    ]
    settings += [
        ("switched every 10 ms, all images", {"error_db": -60.0, "switch_s": 0.01}),
        ("switched every 10 ms, 15 dB and noise", {"error_db": -40.0, "switch_s": 0.01, "decay": 15.0, "end_s": RT60}),
    ]
    for name, options in settings:
        timed = [scene(dry=dry, **options) for _ in range(1 if quick else 2)]
        sound, seconds = timed[0][0], min(s for _, s in timed)
        error = 10 * np.log10(np.sum((sound - reference) ** 2) / np.sum(reference**2))
        worst = np.max(10 * np.log10(np.sum((sound - reference) ** 2, axis=1) / np.sum(reference**2, axis=1)))
        rows.append({"method": name, "cpu_s": seconds, "error_db": error, "worst_microphone_db": worst})
        print(f"{name:48s} {seconds:7.2f} CPU-s  error {error:7.1f} dB  worst microphone {worst:7.1f} dB", flush=True)
    return rows


def against_retarded_time() -> list[dict]:
    """Error of a moving source against the analytic solution, all images of weakly reflecting walls."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    exact = importlib.import_module("test_acoustics_moving")
    rows = []
    for speed in (1.0, 10.0):
        duration = 0.5 if speed == 1 else 0.3
        start, velocity = np.array([0.5, 2.0, 1.6]), np.array([0.95, 0.3, 0.0]) * speed / np.hypot(0.95, 0.3)
        signal = exact.tones(8000, duration)
        dry = signal(np.arange(exact.first_sample(duration, RATE)) / RATE)
        for beta in (0.0, 0.1):
            room = exact.surroundings(beta, 25.0)
            images = image_microphones(ROOM, exact.MICROPHONES[0], room.reflection, start, 25.0)
            images = images[np.abs(images.gains) > 9e-5]
            for name, nodes in (
                ("-40 dB", interpolation(*power_spectrum(dry, RATE), -40, C)),
                ("-60 dB", interpolation(*power_spectrum(dry, RATE), -60, C)),
                ("10 ms switching", Switching(0.01)),
            ):
                source = exact.MovingSource(room, nodes, 8500 / RATE, -75)
                times = np.linspace(0, duration, 1 + round(duration / 0.1))
                heard = exact.render(source, times, lambda t: start + velocity * t, dry).take(0, len(dry) + 1500)  # noqa: B023
                expected = exact.by_retarded_time(signal, start, velocity, images, heard.shape[1])
                error = exact.decibels(heard[0], expected)
                rows.append({"speed_m_s": speed, "images": len(images), "method": name, "error_db": error})
                print(f"{speed:4.0f} m/s, {len(images):3d} images, {name:16s} {error:7.1f} dB", flush=True)
    return rows + microphones_against_retarded_time(exact)


def microphones_against_retarded_time(exact: ModuleType) -> list[dict]:
    """The same where the microphone moves too, towards the source, half the relative speed each."""
    rows = []
    duration, signal = 0.3, exact.tones(8000, 0.3)
    dry = signal(np.arange(exact.first_sample(duration, RATE)) / RATE)
    start, there, times = np.array([0.5, 2.0, 1.6]), np.array([4.3, 3.5, 2.2]), np.linspace(-0.1, 0.4, 6)
    for speed in (1.0, 10.0):
        velocity = speed / 2 * (there - start) / np.linalg.norm(there - start)
        for beta in (0.0, 0.1):
            way = Trajectory(times, there - times[:, None] * velocity)
            room = Surroundings(ROOM, np.full(6, -beta), there[None], RATE, 25.0, trajectories=(way,))
            images = image_microphones(ROOM, there, room.reflection, start, 25.0)
            images = images[np.abs(images.gains) > 9e-5]
            for error_db in (-40, -60):
                nodes = interpolation(*power_spectrum(dry, RATE), error_db, C)
                source = exact.MovingSource(room, nodes, 8500 / RATE, error_db - 15)
                heard = exact.render(source, np.linspace(0, duration, 4), lambda t: start + velocity * t, dry)  # noqa: B023
                found = heard.take(0, len(dry) + 1500)[0]
                expected = exact.by_retarded_time(signal, start, velocity, images, len(found), -velocity)
                error = exact.decibels(found, expected)
                name = f"{error_db} dB, microphone moves too"
                rows.append({"speed_m_s": speed, "images": len(images), "method": name, "error_db": error})
                print(f"{speed:4.0f} m/s, {len(images):3d} images, {name} {error:7.1f} dB", flush=True)
    return rows


def growth(dry: np.ndarray) -> list[dict]:
    """How the cost of a scene grows."""
    rows = []

    def add(what: str, value: float, **options: Any) -> None:
        people = options.pop("people", 1)
        seconds = min(scene(people, **{"dry": dry, "error_db": -40.0, **options})[1] for _ in range(2))
        rows.append({"what": what, "value": value, "cpu_s": seconds})
        print(f"{what} {value}: {seconds:.2f} CPU-s", flush=True)

    for people in (1, 2, 4):
        add("people", people, people=people)
    for count in (1, 2, 4, 8):
        add("microphones", count, microphones=MICROPHONES[:count])
    for count in (1, 2, 4):
        add("of eight microphones that move at 1 m/s", count, moving=count)
    for rt60 in (0.15, 0.25, 0.35, 0.5, 0.7):
        add("T60 in s", rt60, rt60=rt60)
    for rate in (8000, 16000, 44100, 96000):
        add("sample rate in Hz", rate, rate=rate, dry=resample(dry, RATE, rate))
    for error_db in (-20, -30, -40, -50, -60):
        add("error in dB", error_db, error_db=float(error_db))
    return rows


def tables(result: dict) -> str:
    """The result as Markdown."""

    def table(heads: list[str], rows: list[list]) -> str:
        lines = [heads, ["---"] * len(heads), *rows]
        return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)

    responses, scenes, exact, growth = (result[key] for key in ("responses", "scene", "retarded_time", "growth"))
    return "\n\n".join(
        [
            f"# Room simulation: run time against error\n\nBy `make bench-audio`, load {result['load']:.1f}. "
            "CPU seconds of one process; the room, its eight microphones and T60 0.35 s are the thesis's, 44.1 kHz.",
            "![run time against error](audio.svg)",
            "## Responses of one position to eight microphones\n\nError against the band-limited sum over all images.",
            table(
                ["method", "ms", "error, white, dB", "error, as speech, dB", "400 positions, CPU-s"],
                [
                    [
                        r["method"],
                        f"{r['ms_a_position']:.1f}",
                        f"{r['white_db']:.1f}",
                        f"{r['speech_db']:.1f}",
                        f"{r['ms_a_position'] * POSITIONS / 1e3:.1f}",
                    ]
                    for r in responses
                ],
            ),
            "## Four seconds of a walking speaker\n\nResponses, interpolation and convolution; error against ours at "
            "-90 dB.",
            table(
                ["method", "CPU-s", "error, dB", "worst microphone, dB"],
                [
                    [r["method"], f"{r['cpu_s']:.2f}", f"{r['error_db']:.1f}", f"{r['worst_microphone_db']:.1f}"]
                    for r in scenes
                ],
            ),
            "## Against the analytic solution by retarded time\n\nTones up to 8 kHz.",
            table(
                ["relative speed, m/s", "images", "method", "error, dB"],
                [[f"{r['speed_m_s']:g}", r["images"], r["method"], f"{r['error_db']:.1f}"] for r in exact],
            ),
            "## How the cost of a scene grows\n\nAt -40 dB unless the row states another level.",
            table(["", "", "CPU-s"], [[r["what"], r["value"], f"{r['cpu_s']:.2f}"] for r in growth]),
        ]
    )


def figures(static: list[dict], scenes: list[dict]) -> Iterator[Row]:
    for row in static:
        spent = row["ms_a_position"] / 1e3
        yield figure("audio", "one place, 8 microphones", row["method"], spent, "place", row["white_db"], "dB")
    for row in scenes:
        method = row["method"] if row["method"].startswith("avcli") else f"avcli, {row['method']}"
        yield figure("audio", "4 s, one walker", method, row["cpu_s"], "scene", row["error_db"], "dB")


def plot(path: Path, static: list[dict], scenes: list[dict]) -> None:
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5))
    for axis, rows, x, y in ((left, static, "ms_a_position", "white_db"), (right, scenes, "cpu_s", "error_db")):
        ours = [row for row in rows if row["method"].startswith("avcli")]
        axis.plot([row[x] for row in ours], [row[y] for row in ours], "o-", label="avcli")
        for row in rows:
            if row not in ours:
                axis.plot(row[x], row[y], "x", label=row["method"])
        axis.set_xscale("log")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
        axis.set_ylabel("error, dB")
    left.set_xlabel("CPU time of one position's responses, eight microphones, ms")
    left.set_title("Responses, white sound")
    right.set_xlabel("CPU time of the scene, s")
    right.set_title("Four seconds of a walking speaker, T60 0.35 s")
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--peers", default=".venv-bench/bin/python", help="Python of the peers' environment")
    parser.add_argument("--speech", help="recording to speak instead of the first built-in voice")
    parser.add_argument("--quick", action="store_true", help="fewer settings; neither growth nor retarded time")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    dry = voice(arguments.speech)
    print(f"load {os.getloadavg()[0]:.1f}")
    static = responses(arguments.out, arguments.peers, arguments.quick)
    scenes = moving(dry, arguments.quick)
    result = {
        "load": os.getloadavg()[0],
        "responses": static,
        "scene": scenes,
        "retarded_time": [] if arguments.quick else against_retarded_time(),
        "growth": [] if arguments.quick else growth(dry),
    }
    ours = next(row["cpu_s"] for row in scenes if row["method"] == "avcli, -40 dB")
    best = next(row["cpu_s"] for row in scenes if row["method"] == "avcli, -60 dB")
    for row in static:
        if row["method"].startswith("avcli"):
            continue
        whole = row["ms_a_position"] / 1e3 * POSITIONS
        print(f"{row['method']}: {whole:.1f} CPU-s for {POSITIONS} positions, {whole / ours:.1f} x ours at -40 dB, "
              f"{whole / best:.1f} x at -60 dB")  # fmt: skip
    (arguments.out / "audio.json").write_text(json.dumps(result, indent=1) + "\n")
    (arguments.out / "audio.md").write_text(tables(result) + "\n")
    plot(arguments.out / "audio.svg", static, scenes)
    hand_over(arguments.out, "audio", figures(static, scenes))
    print(f"{arguments.out}/audio.json, audio.md and audio.svg")


if __name__ == "__main__":
    main()
