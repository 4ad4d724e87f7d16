"""How furnished rooms of materials sound by octave band, as stated, as rendered, and by rays: T30, EDT, D50, C50,
coherence.

    make bench-rooms [BENCH_FLAGS="--pairs 6"]

The rooms are random worlds of six kinds, from 3 to 20 m. "Stated" is what config.json says; "rendered" are the
responses of avsim-audio at random places; "rays" are those of pyroomacoustics (image sources up to order 3, then ray
tracing) in the same box with the same absorption and scattering, where the environment of the peers is set up. What
stands in the room is part of its air there. Writes rooms.md into --out.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avcli.acoustics.bands import BANDS_HZ
from avcli.acoustics.responses import Responses, lowpass
from avcli.acoustics.settings import Settings
from avcli.acoustics.surroundings import surroundings_of
from avcli.formats.experiment import Config
from avcli.numeric import fft_length
from avcli.scene import load
from avcli.scene.film import Film
from avcli.scene.worlds import Wishes

RATE, C, ERROR_DB, APART_M = 16000, 343.0, -45.0, 0.1
ROOMS = {
    "living": (3.0, 4.0, 2.5), "office": (5.0, 4.5, 2.8), "meeting": (8.0, 6.0, 3.0), "hall": (14.0, 10.0, 4.5),
    "workshop": (20.0, 12.0, 5.0), "corridor": (18.0, 3.0, 2.8),
}  # fmt: skip
MIDDLE = slice(2, 5)
HEARD = BANDS_HZ[1:6]
PEER = """
import json, sys, time, numpy as np, pyroomacoustics as pra
spec = json.load(sys.stdin)
pra.constants.set("c", spec["c"]); pra.constants.set("rir_hpf_enable", False)
names = "west east south north floor ceiling".split()
of = {n: pra.Material({"coeffs": a, "center_freqs": spec["bands"]}, {"coeffs": s, "center_freqs": spec["bands"]})
      for n, a, s in zip(names, spec["absorption"], spec["scattering"])}
begin, found = time.process_time(), []
for place, microphones in zip(spec["places"], spec["microphones"]):
    room = pra.ShoeBox(spec["room"], fs=spec["rate"], max_order=3, materials=of, ray_tracing=True, air_absorption=True)
    room.set_ray_tracing(receiver_radius=0.3, energy_thres=1e-7)
    room.air_absorption = np.array(spec["energy_loss"])[:len(room.air_absorption)]
    room.add_source(place); room.add_microphone_array(np.array(microphones).T); room.compute_rir()
    found.append([r[0] for r in room.rir])
np.save(spec["out"], np.array([[np.pad(r, (0, max(map(len, sum(found, []))) - len(r))) for r in f] for f in found]))
print(time.process_time() - begin)
"""


def in_octave(sound: np.ndarray, middle_hz: float) -> np.ndarray:
    """Return an octave of sound, (..., n), with soft edges that do not ring."""
    octaves = np.log2(np.maximum(np.fft.rfftfreq(2 * sound.shape[-1], 1 / RATE), 1.0) / middle_hz)
    smooth = np.where(np.abs(octaves) < 0.5, 0.5 + 0.5 * np.cos(2 * np.pi * octaves), 0.0)
    return np.fft.irfft(np.fft.rfft(sound, 2 * sound.shape[-1]) * smooth)[..., : sound.shape[-1]]


def decay_time(level_db: np.ndarray, first: float, last: float) -> float:
    """Return the time of 60 dB, s, from the decay between two levels."""
    inside = np.flatnonzero((level_db < -first) & (level_db > -last))
    return float(-60 / np.polyfit(inside / RATE, level_db[inside], 1)[0])


def measured(responses: np.ndarray) -> dict[str, np.ndarray]:
    """Return T30 and EDT, s, D50, C50, dB, and the late coherence of two microphones, (bands,), means over places.

    Args:
        responses: (places, 2, n).
    """
    times = []
    for middle in HEARD:
        octave = in_octave(responses, middle)
        energies = np.cumsum(octave[..., ::-1] ** 2, axis=-1)[..., ::-1].reshape(-1, octave.shape[-1])
        levels = 10 * np.log10(energies / energies[:, :1] + 1e-30)
        late = np.argmax(levels.reshape(octave.shape) < -15, axis=-1).max(axis=1)
        both = [one[:, begin:] for one, begin in zip(octave, late, strict=True)]
        coherence = [np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b)) for a, b in both]
        direct = np.argmax(np.abs(responses), axis=-1).ravel()
        after = np.minimum(direct + int(0.05 * RATE), levels.shape[1] - 1)
        late_share = energies[np.arange(len(energies)), after] / energies[:, 0]
        clarity = 10 * np.log10((1 - late_share) / late_share)
        row = [(decay_time(level, 5, 35), decay_time(level, 0.1, 10)) for level in levels]
        times.append([*np.mean(row, axis=0), np.mean(1 - late_share), np.mean(clarity), np.mean(coherence)])
    return dict(zip(("T30", "EDT", "D50", "C50", "coherence"), np.array(times).T, strict=True))


def rows_of(kind: str, seed: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure one room: what is stated, rendered, and found by rays."""
    size = np.array(ROOMS[kind])
    world = load.load("random", seed=seed, wishes=Wishes(people=3, kind=kind, room=ROOMS[kind]), duration=1.0)
    raw = Film(world, None).config(background=False)
    raw["microphone_config"]["audio_sample_rate_hz"] = RATE
    config = Config(raw)
    around = surroundings_of(config, Settings(error_db=ERROR_DB))
    bands = around.bands
    assert bands is not None
    rng, found = np.random.default_rng(seed), []
    places, microphones = [], []
    filtered = lowpass(0.5, ERROR_DB)
    length = fft_length(around.longest_delay + 2 * (filtered.taps + around.spread))
    for number in range(options.pairs):
        place, first = rng.uniform(0.4, size - 0.4, (2, 3))
        away = np.append(rng.normal(size=2), 0.0)
        two = np.array([first, first + APART_M * away / np.linalg.norm(away)])
        here = replace(around, microphones_m=two, directivities=None, orientations=None)
        responses = Responses(here, length, filtered, ERROR_DB, np.random.default_rng(number))
        spectra = responses.at([(place, np.array([1.0, 0.0, 0.0]), two[None])])[0]
        found.append(np.fft.irfft(spectra, length)[:, responses.margin :][:, : around.longest_delay])
        places.append(place.tolist())
        microphones.append(two.tolist())
    stated = config.room.reverberation_time_s
    rows = [
        {"room": kind, "what": "stated", "T": stated, "T30": bands.rt60_s[1:6],
         "coherence": np.sinc(2 * np.array(HEARD) * APART_M / C)},
        {"room": kind, "what": "rendered", **_row(np.array(found))},
    ]  # fmt: skip
    surfaces = config.room.surfaces
    assert surfaces is not None
    scattering = surfaces.scattering if options.scattering is None else np.full((6, 7), options.scattering)
    if options.peers.exists():
        with tempfile.NamedTemporaryFile(suffix=".npy") as file:
            spec = {
                "c": C, "rate": RATE, "room": size.tolist(), "bands": BANDS_HZ[:7],
                "absorption": bands.absorption[:, :7].tolist(), "energy_loss": (2 * bands.air[:7]).tolist(),
                "scattering": scattering.tolist(), "places": places, "microphones": microphones, "out": file.name,
            }  # fmt: skip
            subprocess.run(
                [options.peers, "-c", PEER], input=json.dumps(spec), text=True, check=True, capture_output=True
            )
            rows.append({"room": kind, "what": "rays", **_row(np.load(file.name))})
    return rows


def _row(responses: np.ndarray) -> dict[str, Any]:
    found = measured(responses)
    return {"T": found["T30"][1:4].mean(), **found}


def as_table(rows: list[dict[str, Any]]) -> str:
    """The rooms as Markdown."""
    names = "T30", "EDT", "D50", "C50", "coherence"
    heads = [f"{name} {middle}" for name in names for middle in (HEARD[0], HEARD[2], HEARD[4])]
    lines = [f"| room | what | T, s | {' | '.join(heads)} |", "|---" * (3 + len(heads)) + "|"]
    for row in rows:
        cells = []
        for name in names:
            values = row.get(name)
            cells += ["" if values is None else f"{values[index]:.2f}" for index in (0, 2, 4)]
        lines.append(f"| {row['room']} | {row['what']} | {row['T']:.2f} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure the rooms and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--peers", type=Path, default=Path(".venv-bench/bin/python"), help="Python of the peers")
    parser.add_argument("--scattering", type=float, help="of all walls, for the rays alone; else by materials")
    parser.add_argument("--seed", type=int, default=0, help="of the first room")
    parser.add_argument("--pairs", type=int, default=6, help="pairs of places in each room")
    parser.add_argument("--rooms", nargs="+", choices=list(ROOMS), default=list(ROOMS))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    kinds = [kind for kind in ROOMS if kind in options.rooms]
    rows = [row for kind in kinds for row in rows_of(kind, options.seed + list(ROOMS).index(kind), options)]
    (options.out / "rooms.md").write_text(table := as_table(rows))
    sys.stdout.write(table)


if __name__ == "__main__":
    main()
