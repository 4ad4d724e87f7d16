"""Scenes of many arrays: what the scores of avdetect-audio are calibrated to, and judged on.

Each scene draws its room (3 to 20 m), its reverberation time (0.1 to 1.2 s), an array of 4 to 32 microphones, noise 5
to 40 dB below the voices, and one or two people who stand, walk, talk at once or take turns. It is made by our own
simulator or by pyroomacoustics' image sources with a tail of decaying noise. What judges has another speaker (CMU
ARCTIC) and other seeds than what decides, and one kind of array that decides nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from localization_scenes import Person, Scene, acted, recorded, ring, voices
from scipy.signal import fftconvolve, resample_poly

from avcli.formats.experiment import Config
from avcli.formats.media import Sound, read_audio
from avcli.formats.records import Identified
from avcli.localization.array import Array
from avcli.localization.directions import observes_ranges

SECONDS, SPEED, TAIL_S = 4.0, 343.0, 0.3
SEEDS = {"decide": 22011, "judge": 22922}
SPEAKERS = {"decide": "fit", "judge": "held out"}
"""Whose recordings a split has, by the names of localization_scenes."""
KINDS = ("ring", "ceiling", "table", "wall", "irregular")
JUDGED_KIND = "pairs"
"""A kind of array that only judges."""
COUNTS = (4, 4, 5, 6, 6, 8, 8, 8, 10, 12, 16, 24, 32)
ACTS = ("still", "still", "walking", "two", "two", "turns")
RATES = (16000, 16000, 44100)
LIVE_S = 0.5
"""T60 from which scenes are sampled at the lowest rate, since their simulation is dear."""
MACHINES_FROM, MACHINES = 10000, ("machine", "machine beside a talker")
"""Scenes with a machine are drawn by numbers from here; what they are called."""
MACHINE_S, HUMS = 9.0, 1 / 4
"""s that they last, so that some machines are named within them; the share of them in which the machine hums."""
FEW_FROM, FEW = 20000, (4, 4, 5, 6)
"""Scenes by numbers from here have so few microphones: of the others too few have four, where a score is hardest."""
MISPLACED_M, NOISY, LOUDEST_DB, FAULTS = 0.03, 1 / 3, (-5.0, 10.0), 5
"""m: up to what standard deviation microphones are misplaced in arrays as people build them; the share of these with
one or two noisy channels; the dB by which a voice is over the noise of one; and the number that draws all this."""
DECIDES = {"0", "1"}
"""The recordings of machines that decide, by their numbers; the others judge."""
IMAGES = 12
"""Reflections up to which pyroomacoustics' rooms have images; later ones are a tail."""


@dataclass(frozen=True)
class Given:
    """What a scene has.

    Attributes:
        split, number, simulator: which scene it is; "own" or "pyroomacoustics".
        kind, act: of array, and what people do.
        count: microphones.
        room: (3,) m.
        rt60: s.
        noise_db: noise below the voices.
        rate: Hz.
        misplaced: m, the standard deviation in x, y and z by which microphones are not where they are said to be.
        noisy: how many channels are noise, or drown in it.
    """

    split: str
    number: int
    simulator: str
    kind: str
    act: str
    count: int
    room: np.ndarray
    rt60: float
    noise_db: float
    rate: int
    misplaced: float = 0.0
    noisy: int = 0


def drawn(split: str, number: int) -> tuple[Given, Array, np.random.Generator]:
    """Return what a scene has, its array, and the generator of what else is drawn in it."""
    rng = np.random.default_rng([SEEDS[split], number])
    simulator = ("own", "pyroomacoustics")[number % 2]
    kinds = (*KINDS, JUDGED_KIND) if split == "judge" else KINDS
    kind, count = str(rng.choice(kinds)), int(rng.choice(FEW if number >= FEW_FROM else COUNTS))
    if kind == "table":
        count = min(count, 16)
    while True:
        long = float(np.exp(rng.uniform(np.log(3.0), np.log(20.0))))
        room = np.array(
            [long, max(2.5, long * rng.uniform(0.5, 1.0)), rng.uniform(2.4, 3.5 + 0.1 * max(long - 8.0, 0.0))]
        )
        microphones = placed(kind, count, room, rng)
        array = Array(microphones, int(rng.choice(RATES)), room.round(3), SPEED)
        if observes(array):
            break
    act = str(rng.choice(ACTS))
    rt60 = float(np.exp(rng.uniform(np.log(0.1), np.log(1.2))))
    if rt60 > LIVE_S:
        array = replace(array, sample_rate=RATES[0])
    given = Given(
        split, number, simulator, kind, act, count, array.room, round(rt60, 3), float(rng.uniform(5, 40)),
        int(array.sample_rate),
    )  # fmt: skip
    return given, array, rng


def observes(array: Array) -> bool:
    """Tell whether an array observes places and not mere directions."""
    return bool(
        array.spread[1] > 0.05 and observes_ranges(array, np.array([0, 0, 0.8]), np.array([*array.room[:2], 2.0]))
    )


def placed(kind: str, count: int, room: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the microphones (count, 3) m of an array of a kind."""
    if kind == "ring":
        found = ring(room.tolist(), count, rng.uniform(1.6, room[2] - 0.1))
        found = found + rng.normal(0.0, 0.1, found.shape)
    elif kind == "ceiling":
        across = int(np.ceil(np.sqrt(count)))
        grid = np.array([[i % across, i // across] for i in range(count)]) + 0.5
        pitch = min(rng.uniform(0.5, 2.0), 0.9 * room[:2].min() / across)
        found = np.column_stack([room[:2] / 2 + pitch * (grid - grid.mean(axis=0)), np.full(count, room[2] - 0.05)])
        found[:, :2] += rng.normal(0.0, 0.1 * pitch, (count, 2))
    elif kind == "table":
        around = 2.0 * np.pi * (np.arange(count) + rng.uniform(0, 1, count)) / count
        radius = rng.uniform(0.4, 1.2) * np.array([1.0, rng.uniform(0.4, 1.0)])
        middle = rng.uniform(0.35, 0.65, 2) * room[:2]
        found = np.column_stack(
            [middle + radius * np.column_stack([np.cos(around), np.sin(around)]), np.full(count, 0.75)]
        )
        found[:, 2] += rng.uniform(0.0, 0.15, count)
    elif kind == "wall":
        along = np.linspace(-0.5, 0.5, count) * min(rng.uniform(1.5, 5.0), 0.9 * room[0])
        found = np.column_stack(
            [room[0] / 2 + along, np.full(count, 0.05), rng.uniform(0.8, min(2.3, room[2] - 0.1), count)]
        )
        found[:, 1] += rng.uniform(0.0, 0.1, count)
    elif kind == "pairs":
        middle = ring(room.tolist(), (count + 1) // 2, rng.uniform(1.0, room[2] - 0.3))
        found = np.vstack([middle, middle + np.array([0.15, 0.05, 0.1])])[:count]
    else:
        found = rng.uniform([0.05, 0.05, 0.4], room - 0.05, (count, 3))
        side = rng.integers(0, 3, count)
        found[side < 2, side[side < 2]] = np.where(
            rng.random((side < 2).sum()) < 0.5, 0.05, room[side[side < 2]] - 0.05
        )
    return np.clip(found, 0.03, room - 0.03)


def scene(split: str, number: int, speech: Sequence[Sound]) -> tuple[Given, Scene]:
    """Return one scene.

    Args:
        split, number: which.
        speech: recordings of the split's speaker, see `voices`; own scenes of odd numbers have avsim-audio's.
    """
    given, array, rng = drawn(split, number)
    times = np.arange(0.0, SECONDS + 0.05, 0.1)
    mouths, speaking = acted(given.act, array.room, times, rng)
    spoken = [speech[index] for index in rng.permutation(len(speech))[:3]]
    if given.simulator == "own":
        samples, people = own(given, array, times, mouths, speaking, spoken if number % 4 == 0 else None)
    else:
        samples, people = peers(given, array, times, mouths, speaking, spoken, rng)
    on = np.zeros(len(samples), bool)
    for begin, end in (span for one in people for span in one.activity):
        on[int(begin * given.rate) : int(end * given.rate)] = True
    level = float(np.sqrt(np.mean(samples[on] ** 2))) * 10.0 ** (-given.noise_db / 20.0) if on.any() else 1e-4
    noise = rng.standard_normal(samples.shape, np.float32).astype(np.float64)
    if rng.random() < 0.5:  # pink, as rooms have it
        spectrum = np.fft.rfft(noise, axis=0)
        spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))[:, None]
        spectrum[: int(40 * len(noise) / given.rate)] = 0.0
        noise = np.fft.irfft(spectrum, len(noise), axis=0)
        noise /= noise.std()
    return given, Scene(0, given.rt60, array, (samples + level * noise).astype(np.float32), people)


def as_built(given: Given, healthy: Scene) -> tuple[Given, Scene]:
    """Return a scene with an array as people build it: its places come from a tape, and channels may be noisy.

    Half of the noisy channels are noise alone. Of four microphones all are needed, and none is noisy.

    Args:
        given, healthy: what `scene` returns.
    """
    rng = np.random.default_rng([SEEDS[given.split], given.number, FAULTS])
    array, samples, count = healthy.array, healthy.samples.copy(), given.count
    misplaced = float(rng.uniform(0.0, MISPLACED_M))
    while True:
        places = array.microphones + rng.normal(0.0, misplaced, array.microphones.shape)
        if observes(moved := replace(array, microphones=places)):
            break
    noisy = int(rng.integers(1, 3 if count > 5 else 2)) if count > 4 and rng.random() < NOISY else 0
    for channel in rng.choice(count, noisy, replace=False):
        noise = samples[:, channel].std() * rng.standard_normal(len(samples), np.float32)
        drowned = rng.random() < 0.5
        level = 10.0 ** (-rng.uniform(*LOUDEST_DB) / 20.0)
        samples[:, channel] = samples[:, channel] + level * noise if drowned else noise
    given = replace(given, misplaced=round(misplaced, 4), noisy=noisy)
    return given, replace(healthy, array=moved, samples=samples)


def own(
    given: Given, array: Array, times: np.ndarray, mouths: np.ndarray, speaking: np.ndarray, speech: list[Sound] | None
) -> tuple[np.ndarray, list[Person]]:
    """Return the sound (n, m) of a scene by our own simulator, and its people."""
    config = {
        "microphone_config": {"audio_sample_rate_hz": given.rate, "mic_positions_m": array.microphones.tolist()},
        "room_config": {"room_dimensions_m": array.room.tolist()},
    }
    identities = np.arange(len(mouths))
    truth = [
        Identified(round(float(time), 4), identities, at * [1.0, 1.0, 0.0], mouths=at, speaking=talk.astype(float))
        for time, at, talk in zip(times, mouths.swapaxes(0, 1), speaking.T, strict=True)
    ]
    samples, activity = recorded(Config(config), truth, given.rt60, speech)
    return samples, [Person(times, at, activity.get(number, [])) for number, at in enumerate(mouths)]


def peers(
    given: Given,
    array: Array,
    times: np.ndarray,
    mouths: np.ndarray,
    speaking: np.ndarray,
    speech: list[Sound],
    rng: np.random.Generator,
) -> tuple[np.ndarray, list[Person]]:
    """Return the sound (n, m) of a scene by pyroomacoustics, and its people, who speak sentence after sentence.

    Walkers are at places 2 cm apart, between which the sound is faded over.
    """
    size = round((times[-1] + TAIL_S) * given.rate)
    total, people = np.zeros((size, len(array.microphones))), []
    for number, (path, turn) in enumerate(zip(mouths, speaking, strict=True)):
        dry = said(speech[number:] + speech[:number], given.rate, size)
        dry *= np.interp(np.arange(size) / given.rate, times, turn.astype(float), right=0.0)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        count = max(1, int(np.ceil(steps / 0.02)))
        knots = np.linspace(0.0, times[-1], count + 1) if count > 1 else np.array([0.0])
        places = np.column_stack([np.interp(knots, times, column) for column in path.T])
        tail = rng.standard_normal((len(array.microphones), int(given.rt60 * given.rate) + given.rate // 10))
        for k, place in enumerate(places):
            share = np.interp(np.arange(size) / given.rate, knots, np.eye(len(knots))[k]) if count > 1 else 1.0
            piece = dry * share
            lit = np.flatnonzero(piece)
            if not len(lit):
                continue
            first, last = lit[0], lit[-1] + 1
            for m, heard in enumerate(response(given, array, place, tail)):
                wet = fftconvolve(piece[first:last], heard)[: size - first]
                total[first : first + len(wet), m] += wet
        people.append(Person(times, path, sounding(dry, given.rate)))
    return total, people


def response(given: Given, array: Array, place: np.ndarray, tail: np.ndarray) -> np.ndarray:
    """Return the responses (m, n) of a place (3,) m: images, then a tail of noise (m, k) of the room's decay."""
    import pyroomacoustics

    room = array.room
    surface = 2 * (room[0] * room[1] + room[0] * room[2] + room[1] * room[2])
    absorption = min(1 - np.exp(-24 * np.log(10) * room.prod() / (SPEED * surface * given.rt60)), 0.99)
    order = min(IMAGES, int(np.ceil(SPEED * given.rt60 / room.min())))
    box = pyroomacoustics.ShoeBox(room, fs=given.rate, materials=pyroomacoustics.Material(absorption), max_order=order)
    box.set_sound_speed(SPEED)
    box.add_source(place)
    box.add_microphone_array(array.microphones.T)
    box.compute_rir()
    # Up to this time all images are there: those that are not would come later than along the shortest edge.
    complete = int(order * room.min() / SPEED * given.rate)
    found = np.zeros((len(array.microphones), max(complete, 0) + tail.shape[1]))
    decay = np.exp(-6.9 * np.arange(tail.shape[1]) / (given.rt60 * given.rate))
    for m, (one,) in enumerate(box.rir):
        one = one[40 : 40 + found.shape[1]]
        found[m, : len(one)] = one
        direct = int(np.linalg.norm(place - array.microphones[m]) / SPEED * given.rate)
        begin = max(complete, direct + given.rate // 100)
        if begin >= found.shape[1] or given.rt60 < 0.15:
            continue
        span = found[m, max(begin - given.rate // 40, direct + 40) : begin]
        level = float(np.sqrt(np.mean(span**2))) if len(span) > 20 else 0.0
        found[m, begin:] = level * (tail * decay)[m, : found.shape[1] - begin]
    return found


def said(speech: list[Sound], rate: int, size: int) -> np.ndarray:
    """Return sentences with short pauses, (size,), of equal power."""
    each = []
    for one in speech:
        common = np.gcd(rate, one.sample_rate_hz)
        dry = resample_poly(one.samples[:, 0], rate // common, one.sample_rate_hz // common)
        each += [0.05 * dry / np.sqrt(np.mean(dry**2)), np.zeros(int(0.15 * rate))]
    return np.resize(np.concatenate(each), size)


def sounding(dry: np.ndarray, rate: int) -> list[list[float]]:
    """Return when a voice (n,) sounds, [begin, end] s: where 50 ms of it are within 30 dB of the loudest."""
    block = rate // 20
    energy = (dry[: len(dry) // block * block].reshape(-1, block) ** 2).mean(axis=1)
    on = np.concatenate([[0], energy > energy.max() * 1e-3, [0]]).astype(int)
    begins, ends = np.flatnonzero(np.diff(on) == 1), np.flatnonzero(np.diff(on) == -1)
    return [[float(a) * block / rate, float(b) * block / rate] for a, b in zip(begins, ends, strict=True)]


def recordings(split: str, folder: Path) -> list[Sound]:
    """Return the recordings of a split's speaker."""
    return voices(SPEAKERS[split], folder)


def machine_scene(split: str, number: int, speech: Sequence[Sound], noises: Sequence[Sound]) -> tuple[Given, Scene]:
    """Return a scene by pyroomacoustics in which a machine sounds all the time; in every other one somebody talks too.

    Its people are those who talk: the machine is nobody.

    Args:
        split, number: which.
        speech: recordings of the split's speaker.
        noises: recordings of the split's machines.
    """
    given, array, rng = drawn(split, MACHINES_FROM + number)
    given = replace(given, simulator="pyroomacoustics", act=MACHINES[number % 2], rt60=min(given.rt60, 0.6))
    times = np.arange(0.0, MACHINE_S + 0.05, 0.1)
    mouths, speaking = acted("two", array.room, times[times < SECONDS], rng)
    mouths, turn = np.repeat(mouths[:, :1], len(times), axis=1), np.resize(speaking[1:], (1, len(times)))
    if rng.random() < HUMS:
        noise = hum(rng, given.rate)
    else:
        noise = noises[int(rng.integers(len(noises)))]
        begin = int(rng.integers(max(1, len(noise.samples) - round(MACHINE_S * noise.sample_rate_hz))))
        noise = replace(noise, samples=noise.samples[begin:])
    spoken = [speech[index] for index in rng.permutation(len(speech))[:3]]
    level = 10.0 ** (rng.uniform(-10.0, 0.0) / 20.0)
    samples, _ = peers(given, array, times, mouths[:1], np.ones((1, len(times)), bool), [noise], rng)
    people: list[Person] = []
    if number % 2:
        more, people = peers(given, array, times, mouths[1:], turn, spoken, rng)
        samples = more + level * samples
    hiss = 10.0 ** (-given.noise_db / 20.0) * float(samples.std()) * rng.standard_normal(samples.shape, np.float32)
    return given, Scene(0, given.rt60, array, (samples + hiss).astype(np.float32), people)


def hum(rng: np.random.Generator, rate: int) -> Sound:
    """Return a motor that hums: harmonics that fall by 3 to 9 dB an octave and swell slowly, and air that rushes."""
    times = np.arange(round((MACHINE_S + 1.0) * rate)) / rate
    harmonics = np.arange(1, int(0.4 * rate / (lowest := rng.uniform(40.0, 120.0))))
    levels = harmonics ** -rng.uniform(0.5, 1.5) * rng.lognormal(0.0, 0.7, len(harmonics))
    phases = rng.uniform(0.0, 2.0 * np.pi, len(harmonics))
    tone = np.zeros(len(times))
    for number, level, phase in zip(harmonics, levels, phases, strict=True):
        tone += level * np.cos(2.0 * np.pi * number * lowest * times + phase)
    tone = tone * (1.0 + rng.uniform(0.0, 0.2) * np.cos(2.0 * np.pi * rng.uniform(0.2, 2.0) * times))
    rush = 10.0 ** (rng.uniform(-25.0, -5.0) / 20.0) * rng.standard_normal(len(times))
    return Sound((tone / np.std(tone) + rush)[:, None], rate)


def machines(split: str, folder: Path) -> list[Sound]:
    """Return the recordings of a split's machines, NAME_K_PART.wav in a folder, see bench_steady.py."""
    parts: dict[str, dict[int, Path]] = {}
    for path in folder.glob("*_*_*.wav"):
        name, part = path.stem.rsplit("_", 1)
        if (name.split("_")[1] in DECIDES) == (split == "decide"):
            parts.setdefault(name, {})[int(part)] = path
    found = []
    for _, paths in sorted(parts.items()):
        each = [read_audio(paths[k]) for k in sorted(paths)]
        found.append(Sound(np.concatenate([samples for samples, _ in each]), each[0][1]))
    return found
