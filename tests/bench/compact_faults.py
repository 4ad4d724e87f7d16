"""Recordings of one talker by compact arrays, measured and simulated, with channels spoilt: see bench_faults.py.

Measured: the circle and the sphere of `real_audio_sets`, with the loudspeakers of the same split. Simulated by
pyroomacoustics: two rings, a sphere and a square in three rooms, T60 .3 to .7 s. A talker is found if a direction is
within ten degrees of him, in azimuth.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import bench_real_audio as real
import numpy as np
from bench_localization import responses
from real_audio_sets import SETS, Measured

from avcli.localization.array import Array
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Block

FS, MEASURED = 16000, {"circle of 8, 10 cm": 6, "sphere of 7, 5 cm": 10}
"""Hz; and how many of the measured recordings are taken."""


def ring(count: int, radius: float) -> np.ndarray:
    """Return a level ring of microphones, (count, 3) m about its middle."""
    turn = 2.0 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])


SLANT = 0.05 * np.sqrt(0.5)
SHAPES = {
    "ring of 8, 10 cm": ring(8, 0.1),
    "ring of 8, 5 cm": ring(8, 0.05),
    "sphere of 7, 5 cm, simulated": np.array(
        [[0.05, 0, 0], [-0.05, 0, 0], [0, -SLANT, SLANT], [0, SLANT, SLANT], [0, -SLANT, -SLANT], [0, SLANT, -SLANT],
         [0, 0, 0]]),
    "square of 4, 6 cm": ring(4, 0.03 * np.sqrt(2.0)),
}  # fmt: skip
ROOMS = {
    "decide": (((6.0, 5.0, 3.0), 0.3, 25.0), ((7.5, 4.5, 2.8), 0.5, 20.0), ((5.0, 6.0, 3.0), 0.7, 20.0)),
    "judge": (((5.5, 5.2, 3.1), 0.35, 25.0), ((8.0, 5.0, 2.7), 0.5, 18.0), ((4.6, 6.3, 2.9), 0.7, 22.0)),
}
"""Rooms (3,) m, their T60 in s, and the noise in dB below the talker."""


@dataclass(frozen=True)
class Recording:
    """What a compact array heard, samples (n, m), of a talker at a place (3,) m, and the times (k,) s of his sound."""

    set: str
    array: Array
    samples: np.ndarray
    source: np.ndarray
    times: np.ndarray


def recordings(split: str, folder: Path | None) -> Iterator[Recording]:
    """Yield the recordings of a split, "decide" or "judge", the measured ones from a folder where one is given."""
    rng = np.random.default_rng(5)
    sources = [(one, folder / one.folder) for one in SETS] if folder else []
    for one, path in sources:
        cases = [case for case in one.read(path) if case.split == split and case.set in MEASURED]
        for number, case in enumerate(cases[:: max(1, len(cases) // MEASURED[cases[0].set])] if cases else ()):
            yield _heard(case, number, rng)
    for a, (name, shape) in enumerate(SHAPES.items()):
        for number, (size, rt60, below_db) in enumerate(ROOMS[split]):
            draw = np.random.default_rng([a, number, split == "judge"])
            room, turn = np.array(size), draw.uniform(0.0, 2.0 * np.pi)
            centre = np.array([*(room[:2] * draw.uniform(0.35, 0.65, 2)), draw.choice([0.8, 1.2])])
            places = np.column_stack([draw.uniform(0.5, room[:2] - 0.5, (50, 2)), draw.uniform(1.2, 1.7, 50)])
            away = np.linalg.norm((places - centre)[:, :2], axis=1)
            source = places[np.flatnonzero((away > 1.0) & (away < 3.5))[0]]
            turned = shape @ [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
            order = min(int(real.SPEED * rt60 / room.min()) + 1, 30)
            heard = responses(room, FS, rt60, [source], centre + turned, order)[0]
            case = Measured(name, f"room {number}", split, room, centre + turned, source, heard, FS)
            yield _heard(case, 3 * a + number, draw, below_db, recorder=False)


def _heard(
    case: Measured, number: int, rng: np.random.Generator, below_db: float = real.NOISE_DB, *, recorder: bool = True
) -> Recording:
    samples, times = real.heard(case, number, rng, below_db)
    samples = samples[int(real.delay(case) * case.sample_rate) if recorder else 0 :]
    array = Array(case.microphones, case.sample_rate, case.room, real.SPEED)
    return Recording(case.set, array, samples, case.source, times)


def measured(one: Recording, spoil: Callable[[np.ndarray, float], np.ndarray]) -> dict[str, object]:
    """Return what is found of a recording with a fault, and what is said of it.

    Args:
        one: the recording.
        spoil: puts the fault into samples (n, m) of a rate in Hz.
    """
    localizer = SteeredLocalizer(one.array, SteeredSettings(), np.random.default_rng(0))
    true = one.source - one.array.microphones.mean(axis=0)
    active, hit, right = 0, 0, 0
    false: list[float] = []
    said: list[str] = []
    for decision in localizer.localize([Block(spoil(one.samples, one.array.sample_rate))]):
        found = [ray is not None and real.azimuth_error(ray.direction, true) < real.RIGHT_DEG for ray in decision.rays]
        speaks = bool(np.abs(one.times - decision.time).min() < 0.03)
        active, hit, right = active + speaks, hit + (speaks and any(found)), right + sum(found)
        false += [float(score) for score, is_he in zip(decision.scores, found, strict=True) if not is_he]
        said += decision.notices
    return {"set": one.set, "active": active, "hit": hit, "right": right, "false": false, "said": said}
