"""The scenes that the scores of avdetect-audio are fitted to and judged on: conditions and random worlds.

Conditions are one or two people who do one thing in one of four rooms; at a T60 of 0.1 s most of these have no
reverberation. Worlds are the random scenes of avsim-scene, at a random reverberation time.
"""

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from localization_rooms import MICROPHONES, ROOM

import avcli
from avcli.acoustics.recorder import Recorder
from avcli.acoustics.settings import Settings
from avcli.formats.experiment import Config
from avcli.formats.media import Sound, read_audio
from avcli.formats.records import Identified
from avcli.localization.array import Array

FS, SECONDS = 44100, 5.0
WORLD_S, WORLD_T60 = 8.0, (0.2, 0.6)
SEEDS = {"fit": 11, "held out": 4021, "check": 77}
SPEAKERS = {"fit": "aew", "held out": "axb"}


def ring(room: Sequence[float], count: int, height: float) -> np.ndarray:
    """Microphones (count, 3) m along the walls of a room, at two heights in turn."""
    around = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    side = np.clip(1.3 * np.column_stack([np.cos(around), np.sin(around)]), -1.0, 1.0)
    level = np.array(room[:2]) * (0.5 + 0.47 * side)
    return np.column_stack([level, height - 0.12 * (np.arange(count) % 2)])


ARRAYS: dict[str, tuple[np.ndarray, np.ndarray]] = {
    "eight": (ROOM, MICROPHONES),
    "twelve": (np.array([7.5, 5.5, 3.0]), ring((7.5, 5.5), 12, 2.7)),
    "six": (np.array([5.0, 4.0, 2.6]), ring((5.0, 4.0), 6, 2.4)),
    "five": (np.array([4.0, 3.5, 2.7]), np.vstack([ring((4.0, 3.5), 4, 2.3), [[2.0, 1.75, 2.5]]])),
}
CONDITIONS: list[tuple[str, float, float, str]] = [
    ("still", 0.1, 30, "eight"), ("still", 0.35, 30, "eight"), ("still", 0.35, 10, "eight"),
    ("still", 0.6, 30, "eight"), ("still", 0.6, 10, "eight"), ("still", 0.35, 30, "six"),
    ("walking", 0.1, 30, "eight"), ("walking", 0.35, 30, "eight"), ("walking", 0.35, 10, "eight"),
    ("walking", 0.35, 30, "twelve"), ("two", 0.1, 30, "eight"), ("two", 0.35, 30, "eight"),
    ("two", 0.6, 30, "eight"), ("two", 0.35, 30, "twelve"), ("turns", 0.35, 30, "eight"), ("turns", 0.35, 30, "five"),
]  # fmt: skip
"""What people do, T60 in s, noise in dB below them, and the array that hears them."""
WORLD = len(CONDITIONS)
"""The number that random worlds have where conditions have theirs."""


@dataclass(frozen=True)
class Person:
    """Where a mouth was, times (k,) s and places (k, 3) m, and when its voice sounded, [begin, end] s each."""

    times: np.ndarray
    places: np.ndarray
    activity: list[list[float]]

    def at(self, time: float) -> np.ndarray:
        """Return where the mouth was, (3,) m."""
        return np.array([np.interp(time, self.times, column) for column in self.places.T])

    def sounds(self, time: float, margin: float = 0.0) -> bool:
        """Tell whether the voice sounded at a time in s, or up to `margin` s before or after."""
        return any(begin - margin <= time <= end + margin for begin, end in self.activity)


@dataclass(frozen=True, eq=False)
class Scene:
    """What an array heard, samples (n, m), of whom, in a room of a T60 in s; `condition` may be WORLD."""

    condition: int
    rt60: float
    array: Array
    samples: np.ndarray
    people: list[Person]


def scenes(split: str, count: int, speech: Path | None, conditions: Iterable[int] = range(WORLD)) -> Iterator[Scene]:
    """Yield so many scenes of each condition."""
    spoken = voices(split, speech)
    for number in range(count):
        for condition in conditions:
            yield simulated(condition, np.random.default_rng([SEEDS[split], condition, number]), spoken)


def worlds(split: str, count: int) -> Iterator[Scene]:
    """Yield so many random worlds, with two to four people."""
    for number in range(count):
        rng = np.random.default_rng([SEEDS[split], WORLD, number])
        rt60, seed = round(float(rng.uniform(*WORLD_T60)), 2), int(rng.integers(1 << 31))
        world = avcli.simulate("random", seed=seed, video=False, people=2 + number % 3, duration=WORLD_S)
        truth = list(world.truth)
        samples, activity = recorded(world.config, truth, rt60, None)
        places: dict[int, list[tuple[float, np.ndarray]]] = {}
        for one in truth:  # who is outside the room is not in it
            for identity, mouth in zip(one.ids.tolist(), one.mouths, strict=True):
                places.setdefault(identity, []).append((one.timestamp, mouth))
        people = [
            Person(np.array([t for t, _ in path]), np.array([at for _, at in path]), activity.get(identity, []))
            for identity, path in places.items()
        ]
        yield Scene(WORLD, rt60, Array.of(world.config), samples, people)


def voices(split: str, speech: Path | None) -> list[Sound]:
    """Return the recordings of a split's speaker, each as it is and at three other speeds; none without recordings."""
    recordings = [read_audio(path) for path in sorted(speech.glob(f"*_{SPEAKERS[split]}_*.wav"))] if speech else []
    return [Sound(samples, round(rate * speed)) for samples, rate in recordings for speed in (1.0, 1.25, 0.85, 1.5)]


def recorded(
    config: Config, truth: Iterable[Identified], rt60: float, speech: Sequence[Sound] | None
) -> tuple[np.ndarray, dict[int, list[list[float]]]]:
    """Return what the microphones of a config record, (n, m), and when each voice sounds, [begin, end] s each."""
    settings = Settings(rt60_s=rt60, ism_decay_db=30.0 if rt60 > 0.4 else None)
    recorder = Recorder(config, settings, speech=speech, say=lambda text: None)  # a T60 of 0.1 s: no reverberation
    for people in truth:
        recorder.step(people)
    recorder.finish()
    samples = np.concatenate([piece.astype(np.float32) for piece in recorder.pieces()])
    return samples, recorder.activity(0.0, len(samples) / recorder.sample_rate_hz)


def simulated(condition: int, rng: np.random.Generator, spoken: Sequence[Sound]) -> Scene:
    """Simulate one scene of a condition."""
    kind, rt60, snr, name = CONDITIONS[condition]
    room, microphones = ARRAYS[name]
    times = np.arange(0.0, SECONDS + 0.05, 0.1)
    mouths, speaking = acted(kind, room, times, rng)
    identities = np.arange(len(mouths))
    config = {
        "microphone_config": {"audio_sample_rate_hz": FS, "mic_positions_m": microphones.tolist()},
        "room_config": {"room_dimensions_m": room.tolist()},
    }
    truth = [
        Identified(round(float(time), 4), identities, at * [1.0, 1.0, 0.0], mouths=at, speaking=talk.astype(float))
        for time, at, talk in zip(times, mouths.swapaxes(0, 1), speaking.T, strict=True)
    ]
    speech = [spoken[index] for index in rng.permutation(len(spoken))[:3]]
    samples, activity = recorded(Config(config), truth, rt60, speech or None)
    found = [Person(times, at, activity.get(number, [])) for number, at in enumerate(mouths)]
    on = np.zeros(len(samples), bool)
    for begin, end in (span for one in found for span in one.activity):
        on[int(begin * FS) : int(end * FS)] = True
    level = float(np.sqrt(np.mean(samples[on] ** 2)) * 10.0 ** (-snr / 20.0))
    noise = rng.standard_normal(samples.shape, np.float32)
    return Scene(condition, rt60, Array(microphones, FS, room), samples + level * noise, found)


def acted(kind: str, room: np.ndarray, times: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return where each person's mouth is, (people, k, 3) m, and whether it is that person's turn, (people, k) bool.

    Everybody pauses, so that what still rings on in the room, and is nobody any more, takes part in the fit.
    """
    mouths: list[np.ndarray] = []
    turns: list[np.ndarray] = []
    for number in range(2 if kind in ("two", "turns") else 1):
        start = rng.uniform(0.4, room[:2] - 0.4)
        while any(np.linalg.norm(start - other[0, :2]) < 1.0 for other in mouths):
            start = rng.uniform(0.4, room[:2] - 0.4)
        places = np.tile(start, (len(times), 1))
        if kind == "walking" or (number == 0 and rng.random() < 0.3):
            places = walked(start, room, times, rng)
        begin, pause = rng.uniform(0.0, 0.5), rng.uniform(0.4, 0.9)
        middle = rng.uniform(2.0, 3.0)
        speaking = (times >= begin) & ((times < middle) | (times >= middle + pause))
        if kind == "turns":
            speaking = (np.floor(times / 1.3) % 2 == number) & (times % 1.3 < 1.2)
        turns.append(speaking)
        mouths.append(np.column_stack([places, np.full(len(times), rng.uniform(1.1, 1.8))]))
    return np.array(mouths), np.array(turns)


def walked(start: np.ndarray, room: np.ndarray, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the places (k, 2) m of someone who walks to and fro between two places at 0.5 to 1.4 m/s."""
    end = rng.uniform(0.4, room[:2] - 0.4)
    while np.linalg.norm(end - start) < 1.5:
        end = rng.uniform(0.4, room[:2] - 0.4)
    along = rng.uniform(0.5, 1.4) * times / np.linalg.norm(end - start)
    share = 1.0 - np.abs(along % 2.0 - 1.0)
    return start + share[:, None] * (end - start)
