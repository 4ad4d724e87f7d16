"""How far T30 is from the reverberation time that was asked for, in empty rooms of 3 to 30 m, beside pyroomacoustics.

    make bench-decay [BENCH_FLAGS="--pairs 60"]

T30 is fitted to the broadband responses of pairs of random places from -5 to -35 dB, and is the mean over them.
pyroomacoustics does what its manual says: the absorption by `inverse_sabine`, image sources up to the order that this
names, where that is at most 40, at six pairs. Writes decay.md into --out.
"""

import argparse
import json
import subprocess
from pathlib import Path

import numpy as np

from avcli.acoustics.decay import wanted_absorption
from avcli.acoustics.images import MOST_IMAGES, image_count, shoebox_rir

RATE, C = 16000, 343.0
ROOMS = (
    (3.0, 3.0, 2.5), (4.66, 4.66, 3.0), (8.0, 5.0, 3.0), (10.0, 5.0, 3.0), (12.0, 3.0, 2.5), (10.0, 8.0, 3.5),
    (15.0, 10.0, 4.0), (20.0, 6.0, 3.0), (20.0, 15.0, 5.0), (20.0, 20.0, 3.0), (30.0, 4.0, 2.6),
)  # fmt: skip
TIMES_S = (0.2, 0.35, 0.6, 1.2, 2.0)
PEER = """
import json, sys, numpy as np, pyroomacoustics as pra
spec = json.load(sys.stdin)
pra.constants.set("c", spec["c"]); pra.constants.set("rir_hpf_enable", False)
try:
    absorption, order = pra.inverse_sabine(spec["rt60"], spec["room"])
except ValueError:
    sys.exit()
if order <= 40:
    for source, microphone in spec["places"]:
        room = pra.ShoeBox(spec["room"], fs=spec["rate"], materials=pra.Material(absorption), max_order=order)
        room.add_source(source); room.add_microphone(microphone); room.compute_rir()
        print(json.dumps(room.rir[0][0].tolist()))
"""


def t30(response: np.ndarray) -> float:
    """Return T30 of a response, s."""
    energy = np.cumsum(response[::-1] ** 2)[::-1]
    level = 10 * np.log10(np.maximum(energy / energy[0], 1e-12))
    inside = np.flatnonzero((level < -5) & (level > -35))
    return float(-60 / np.polyfit(inside / RATE, level[inside], 1)[0])


def places_in(room: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw pairs of places, (n, 2, 3) m: 0.3 m from the walls, and 1 m apart, at least."""
    drawn = rng.uniform(0.3, room - 0.3, (20 * count, 2, 3))
    return drawn[np.linalg.norm(drawn[:, 0] - drawn[:, 1], axis=1) > 1][:count]


def row_of(size: tuple[float, float, float], rt60: float, options: argparse.Namespace) -> str:
    """Measure one room at one time: a row of the table."""
    room = np.array(size)
    begin = f"| {' x '.join(f'{v:g}' for v in size)} | {rt60:g} |"
    samples = int((1.2 * rt60 + np.linalg.norm(room) / C) * RATE)
    if image_count(room, samples / RATE * C) > MOST_IMAGES:
        return f"{begin} more images than possible | | | |"
    absorption, _ = wanted_absorption(room, rt60, C)
    count = int(np.clip(options.pairs * 0.35 / rt60, min(40, options.pairs), options.pairs))
    places = places_in(
        room, count, np.random.default_rng([options.seed, *np.rint(1000 * np.array([*size, rt60])).astype(int)])
    )
    walls = np.sqrt(1 - absorption)
    times = np.array([t30(shoebox_rir(room, one, other, walls, RATE, samples)[0]) for one, other in places]) / rt60
    peer = ""
    if options.peers.exists():
        spec = {"c": C, "rate": RATE, "room": size, "rt60": rt60, "places": places[:6].tolist()}
        said = subprocess.run(
            [options.peers, "-c", PEER], input=json.dumps(spec), text=True, check=True, capture_output=True
        ).stdout.splitlines()
        if said:
            peer = f"{100 * np.mean([t30(np.array(json.loads(line))) / rt60 - 1 for line in said]):+.0f}"
    of_walls = f"{100 * absorption[0]:.0f}"
    if np.ptp(absorption) > 0:
        of_walls = ", ".join(f"{100 * v:.0f}" for v in absorption[::2])
    mean, error = 100 * (times.mean() - 1), 100 * times.std() / np.sqrt(count)
    return f"{begin} {of_walls} | {mean:+.1f} ± {error:.1f} | {100 * times.std():.0f} | {peer} |"


def main() -> None:
    """Measure the rooms and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--peers", type=Path, default=Path(".venv-bench/bin/python"), help="Python of the peers")
    parser.add_argument("--pairs", type=int, default=100, help="pairs of places in each room, fewer at long times")
    parser.add_argument("--seed", type=int, default=0, help="of the places")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    lines = [
        "| room, m | asked, s | walls absorb, % | T30 off by, % | sd of places, % | pyroomacoustics, % |",
        "|---|---|---|---|---|---|",
    ]
    for size in ROOMS:
        for rt60 in TIMES_S:
            lines.append(row_of(size, rt60, options))
            print(lines[-1], flush=True)
    (options.out / "decay.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
