"""Fit the score and the covariance of avdetect-audio, and write them to avcli/localization/fitted.json.

    make fit-localization                    # fit, and measure on scenes that did not take part
    make fit-localization FIT_FLAGS=--check  # only renew the small check that a test runs

Scenes are simulated by avsim-audio: one or two people who stand, walk, pause or take turns, in rooms of T60 0.1 to
0.6 s, with noise 30 or 10 dB below them, heard by five to twelve microphones. With --speech DIR they speak real
recordings (CMU ARCTIC, one speaker for the fit, another for what is held out), also raised and lowered in pitch;
without it, the voices that avsim-audio has. A detection is right within 0.5 m in x and y of a talker who is not taken
and who sounds within 0.15 s. bench-localization then measures the result with another simulator.

--covariance fits the covariances too. That is not done by default: on scenes that were held out, 95 % ellipses
then hold 96 instead of 99 % of the errors of people who stand, but avfuse, which assumes that the errors of successive
records are independent, tracks worse (mean HOTA 0.591 instead of 0.626 on five random scenes).
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from localization_rooms import MICROPHONES, ROOM  # noqa: E402

import avcli  # noqa: E402
from avcli.localization import uncertainty  # noqa: E402
from avcli.localization.array import Array, Talker  # noqa: E402
from avcli.localization.noise import NoiseLaw  # noqa: E402
from avcli.localization.settings import ClosedFormSettings, SteeredSettings  # noqa: E402
from avcli.localization.ssl3d import ClosedFormLocalizer  # noqa: E402
from avcli.localization.steered import Judged, SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402
from avcli.localization.windows import Heard  # noqa: E402

FITTED = ROOT / "avcli" / "localization" / "fitted.json"
FS, SECONDS = 44100, 5.0
RIGHT_M, NEARBY_S = 0.5, 0.15
LEAST_FLOOR_M = 0.02
SEEDS = {"fit": 11, "held out": 4021, "check": 77}
SPEAKERS = {"fit": "aew", "held out": "axb"}
SIGNS: dict[str, tuple[float | None, float | None]] = {
    **dict.fromkeys(("residual", "heights", "strayed", "new", "climbed", "pace", "moves", "strongest"), (0.0, None)),
    "agreement": (None, 0.0),
}
"""Bounds of a covariance's weights: what speaks against a place makes it wider, whatever the errors at hand are."""

MEMORIES, SHARPNESSES = (0.18, 0.28, 0.45), (5.0, 8.0, 12.0)


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


# --- scenes -----------------------------------------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Scene:
    """What an array heard, samples (n, m), of whom."""

    condition: int
    array: Array
    samples: np.ndarray
    people: list[Person]


def scenes(split: str, count: int, speech: Path | None, conditions: Sequence[int] | None = None) -> Iterator[Scene]:
    """Yield so many scenes of each condition."""
    numbers = range(len(CONDITIONS)) if conditions is None else conditions
    with tempfile.TemporaryDirectory() as folder:
        spoken = voices(split, speech, Path(folder))
        for number in range(count):
            for condition in numbers:
                rng = np.random.default_rng([SEEDS[split], condition, number])
                yield simulated(condition, rng, spoken)


def voices(split: str, speech: Path | None, folder: Path) -> list[Path]:
    """Return the recordings of a split's speaker, each as it is and at three other speeds; none without recordings."""
    import soundfile

    found: list[Path] = []
    for path in sorted(speech.glob(f"*_{SPEAKERS[split]}_*.wav")) if speech else []:
        samples, rate = soundfile.read(path)
        for speed in (1.0, 1.25, 0.85, 1.5):
            found.append(folder / f"{path.stem}-{speed}.wav")
            soundfile.write(found[-1], samples, round(rate * speed), subtype="PCM_16")
    return found


def simulated(condition: int, rng: np.random.Generator, spoken: Sequence[Path]) -> Scene:
    """Simulate one scene."""
    import soundfile

    kind, rt60, snr, name = CONDITIONS[condition]
    room, microphones = ARRAYS[name]
    times = np.arange(0.0, SECONDS + 0.05, 0.1)
    people = acted(kind, room, times, rng)
    with tempfile.TemporaryDirectory() as folder:
        config = {
            "microphone_config": {"audio_sample_rate_hz": FS, "mic_positions_m": microphones.tolist()},
            "room_config": {"room_dimensions_m": room.tolist()},
        }
        (Path(folder) / "config.json").write_text(json.dumps(config))
        truth = "".join(
            json.dumps({"timestamp": round(float(time), 4), "objects": [at[step] for at in people]}) + "\n"
            for step, time in enumerate(times)
        )
        (Path(folder) / "truth.jsonl").write_text(truth)
        chosen = rng.permutation(len(spoken))[:3]
        options = [part for voice in chosen for part in ("--speech", str(spoken[voice]))]
        options += ["--ism-decay", "30"] if rt60 > 0.4 else []
        program = "from avcli.commands.avsim_audio import main; main()"
        arguments = ["-C", folder, "--rt60", str(rt60), "-q", "-o", f"{folder}/audio.jsonl", f"{folder}/truth.jsonl"]
        subprocess.run([sys.executable, "-c", program, *options, *arguments], check=True, cwd=ROOT)
        record = json.loads((Path(folder) / "audio.jsonl").read_text().splitlines()[0])
        samples, _ = soundfile.read(Path(folder) / record["audio"]["path"], dtype="float32")
    activity = record["activity"]
    found = [
        Person(times, np.array([at["mouth_position"] for at in one]), activity.get(str(number), []))
        for number, one in enumerate(people)
    ]
    on = np.zeros(len(samples), bool)
    for begin, end in (span for one in found for span in one.activity):
        on[int(begin * FS) : int(end * FS)] = True
    level = float(np.sqrt(np.mean(samples[on] ** 2)) * 10.0 ** (-snr / 20.0))
    noise = rng.standard_normal(samples.shape, np.float32)
    return Scene(condition, Array(microphones, FS, room), samples + level * noise, found)


def acted(kind: str, room: np.ndarray, times: np.ndarray, rng: np.random.Generator) -> list[list[dict[str, Any]]]:
    """Return for each person the objects of all ground-truth records.

    Everybody pauses, so that what still rings on in the room, and is nobody any more, takes part in the fit.
    """
    people: list[list[dict[str, Any]]] = []
    starts: list[np.ndarray] = []
    for number in range(2 if kind in ("two", "turns") else 1):
        start = rng.uniform(0.4, room[:2] - 0.4)
        while any(np.linalg.norm(start - other) < 1.0 for other in starts):
            start = rng.uniform(0.4, room[:2] - 0.4)
        starts.append(start)
        places = np.tile(start, (len(times), 1))
        if kind == "walking" or (number == 0 and rng.random() < 0.3):
            places = walked(start, room, times, rng)
        begin, pause = rng.uniform(0.0, 0.5), rng.uniform(0.4, 0.9)
        middle = rng.uniform(2.0, 3.0)
        speaking = (times >= begin) & ((times < middle) | (times >= middle + pause))
        if kind == "turns":
            speaking = (np.floor(times / 1.3) % 2 == number) & (times % 1.3 < 1.2)
        height = rng.uniform(1.1, 1.8)
        people.append(
            [
                {
                    "object_id": number,
                    "position": [x, y, 0.0],
                    "mouth_position": [x, y, height],
                    "speaking": bool(talks),
                }
                for (x, y), talks in zip(places.tolist(), speaking, strict=True)
            ]
        )
    return people


def walked(start: np.ndarray, room: np.ndarray, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the places (k, 2) m of someone who walks to and fro between two places at 0.5 to 1.4 m/s."""
    end = rng.uniform(0.4, room[:2] - 0.4)
    while np.linalg.norm(end - start) < 1.5:
        end = rng.uniform(0.4, room[:2] - 0.4)
    along = rng.uniform(0.5, 1.4) * times / np.linalg.norm(end - start)
    share = 1.0 - np.abs(along % 2.0 - 1.0)
    return start + share[:, None] * (end - start)


# --- peaks ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One peak: whether it is right, its error (3,) m, and what its score and its covariance are made of.

    Attributes:
        weight: two at once are rarer in a room than in these scenes: further peaks count twice where one talks.
        walks: whether its talker moves.
        others: (3, 3) m² for each of SHARPNESSES, see `Law.covariance`.
        extent: (3,) m, the standard deviation of a place anywhere in the searched volume.
        score: by the law that was in use.
    """

    right: bool
    error: np.ndarray
    features: uncertainty.Features
    normal: np.ndarray
    others: np.ndarray
    extent: np.ndarray
    weight: float
    walks: bool
    condition: int
    score: float


class Witness(SteeredLocalizer):
    """A localizer that notes each of its peaks."""

    def __init__(self, scene: Scene, law: uncertainty.Law):
        super().__init__(scene.array, SteeredSettings(), np.random.default_rng(0), law)
        self.scene, self.rows = scene, list[Row]()

    def report(self, time: float, judged: list[Judged], heard: Heard, noise: NoiseLaw) -> list[Talker]:
        """Note the peaks of a decision, and report as always."""
        taken: set[int] = set()
        extent = np.maximum((self.response.high - self.response.low) / np.sqrt(12.0), uncertainty.FLOOR)
        talking = sum(person.sounds(time) for person in self.scene.people)
        for one in judged:
            right, nearest, error = match(one.peak.position, time, self.scene.people, taken)
            peak, motion = one.peak, (one.peak.position, one.peak.velocity)
            others = np.array(
                [
                    self.response.ambiguity(peak.gccs, heard.offsets, *motion, sharpness / noise.deviation)
                    for sharpness in SHARPNESSES
                ]
            )
            person = self.scene.people[nearest]
            walks = bool(np.linalg.norm(person.at(time + 0.1) - person.at(time - 0.1)) > 0.02)
            weight = 2.0 if not one.features.first and talking < 2 else 1.0
            self.rows.append(
                Row(
                    right,
                    error,
                    one.features,
                    peak.normal,
                    others,
                    extent,
                    weight,
                    walks,
                    self.scene.condition,
                    one.score,
                )
            )
        return super().report(time, judged, heard, noise)


def match(place: np.ndarray, time: float, people: list[Person], taken: set[int]) -> tuple[bool, int, np.ndarray]:
    """Return whether a place is right, the nearest person, and the error (3,) m; note in `taken` who was matched."""
    errors = place - np.array([person.at(time) for person in people])
    nearest = int(np.argmin(np.hypot(errors[:, 0], errors[:, 1])))
    near = bool(np.hypot(*errors[nearest, :2]) < RIGHT_M) and nearest not in taken
    if near:
        taken.add(nearest)
    return near and people[nearest].sounds(time, NEARBY_S), nearest, errors[nearest]


def peaks(heard: Sequence[Scene], law: uncertainty.Law) -> list[Row]:
    """Return the peaks that the localizer finds in scenes with a law."""
    rows: list[Row] = []
    for scene in heard:
        witness = Witness(scene, law)
        for _ in witness.localize([Block(scene.samples)]):
            pass
        rows += witness.rows
    return rows


# --- fits -------------------------------------------------------------------------------------------------------------


def log_loss(right: np.ndarray, probability: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Return the mean of -log(probability of what was), in nats."""
    chance = np.clip(probability, 1e-12, 1.0 - 1e-12)
    return float(np.average(-np.where(right, np.log(chance), np.log1p(-chance)), weights=weight))


def supporting(terms: np.ndarray, right: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weights (k,) as `logistic` does, but none below 0 after the first, the constant.

    Every feature is made to speak for a peak. One that would speak against it only balances another one.
    """
    used = np.ones(terms.shape[1], bool)
    while True:
        found = np.zeros(terms.shape[1])
        found[used] = logistic(terms[:, used], right, weight)
        worst = 1 + int(np.argmin(found[1:]))
        if found[worst] >= 0.0:
            return found
        used[worst] = False


def logistic(terms: np.ndarray, right: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weights (k,) of greatest likelihood for terms (n, k), by Newton's method, with a ridge of 1e-3."""
    found = np.zeros(terms.shape[1])
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-np.clip(terms @ found, -30, 30)))
        hessian = (terms * (weight * p * (1 - p))[:, None]).T @ terms + 1e-3 * np.eye(len(found))
        found += np.linalg.solve(hessian, terms.T @ (weight * (right - p)) - 1e-3 * found)
    return found


def fit_scores(rows: Sequence[Row], law: uncertainty.Law) -> tuple[uncertainty.Law, float]:
    """Return the law with the scores that fit the peaks best, and their weighted log loss."""
    total = 0.0
    for first in (True, False):
        mine = [row for row in rows if row.features.first == first]
        names = law.first if first else law.further
        terms = np.array([uncertainty.terms(row.features, names) for row in mine])
        right, weight = np.array([row.right for row in mine]), np.array([row.weight for row in mine])
        found = supporting(terms, right, weight)
        weights = dict(zip(names, rounded(found), strict=True))
        law = replace(law, first=weights) if first else replace(law, further=weights)
        total += weight.sum() * log_loss(right, 1.0 / (1.0 + np.exp(-np.clip(terms @ found, -30, 30))), weight)
    return law, float(total / sum(row.weight for row in rows))


def rounded(values: np.ndarray) -> list[float]:
    """Return numbers with four decimals."""
    return [float(value) for value in np.round(values, 4)]


class Errors:
    """The errors of peaks that are right, and their covariances for any weights.

    Args:
        rows: of peaks that are right.
        sharpness: which of SHARPNESSES.
    """

    def __init__(self, rows: Sequence[Row], sharpness: float):
        self.errors = np.array([row.error for row in rows])
        self.normals = np.array([row.normal for row in rows])
        self.others = np.array([row.others[SHARPNESSES.index(sharpness)] for row in rows])
        self.extent = np.array([row.extent for row in rows])
        self.walks = np.array([row.walks for row in rows])
        every = [
            uncertainty.spread_terms(row.normal, o, row.features) for row, o in zip(rows, self.others, strict=True)
        ]
        self.terms = {part: np.array([terms[part] for terms in every]) for part in uncertainty.PARTS}
        self.motion = np.array([uncertainty.paths(row.features) for row in rows])
        condition = np.array([row.condition for row in rows])
        self.weight = 1.0 / np.bincount(condition)[condition]  # each condition as heavy as another
        self.weight /= self.weight.sum()

    def covariances(self, spread: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return them, (n, 3, 3) m²."""
        return uncertainty.spread(spread, self.terms, self.normals, self.others, self.motion, self.extent)

    def loss(self, spread: Mapping[str, np.ndarray]) -> float:
        """Return the mean of half the logarithm of the determinant and half the squared normalised error."""
        covariances = self.covariances(spread)
        squared = np.einsum("ni,nij,nj->n", self.errors, np.linalg.inv(covariances), self.errors)
        return float(self.weight @ (0.5 * np.linalg.slogdet(covariances)[1] + 0.5 * squared))

    def held(self, spread: Mapping[str, np.ndarray], chosen: np.ndarray) -> float:
        """Return the share of the chosen errors within the 95 % ellipses in x and y."""
        level = np.linalg.inv(self.covariances(spread)[chosen][:, :2, :2])
        errors = self.errors[chosen][:, :2]
        return float((np.einsum("ni,nij,nj->n", errors, level, errors) < 5.991).mean())


def widest(spread: Mapping[str, Mapping[str, float]], widened: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the weights of each part as arrays, widened."""
    weights = {part: np.array(list(names.values())) for part, names in spread.items()}
    for part, wider in widened.items():
        weights[part][0] += wider
    return weights


def fit_spread(errors: Errors, law: uncertainty.Law) -> tuple[dict[str, dict[str, float]], float]:
    """Return the weights of the parts of a covariance of greatest likelihood, and their loss."""
    from scipy.optimize import minimize

    start = np.concatenate([list(law.spread[part].values()) for part in uncertainty.PARTS])
    ends = np.cumsum([len(names) for names in uncertainty.PARTS.values()])[:-1]

    def parts(parameters: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(uncertainty.PARTS, np.split(parameters, ends), strict=True))

    def loss(parameters: np.ndarray) -> float:  # the ridge settles what the errors leave open
        return errors.loss(parts(parameters)) + 1e-4 * float(parameters @ parameters)

    limits = [SIGNS.get(name, (None, None)) for names in uncertainty.PARTS.values() for name in names]
    best = minimize(loss, start, method="L-BFGS-B", bounds=limits, options={"maxiter": 100, "maxfun": 100_000})
    found = parts(best.x)
    named = {part: dict(zip(names, rounded(found[part]), strict=True)) for part, names in uncertainty.PARTS.items()}
    return named, float(best.fun)


def fit_widened(errors: Errors, law: uncertainty.Law) -> dict[str, float]:
    """Return by how much the part of those who stand, then of those who walk, is widened to hold 95 % of the errors."""
    widened = {"motion": 0.0, "level": 0.0}
    for part, chosen in (("level", ~errors.walks), ("motion", errors.walks)):
        low, high = 0.0, 2.0
        for _ in range(12):
            widened[part] = 0.5 * (low + high)
            enough = errors.held(widest(law.spread, widened), chosen) >= 0.95
            low, high = (low, widened[part]) if enough else (widened[part], high)
        widened[part] = round(high if high > 0.001 else 0.0, 3)
    return widened


def fit_closed_form(
    heard: Sequence[Scene], law: uncertainty.Law, *, covariance: bool
) -> tuple[uncertainty.Law, dict[str, Any]]:
    """Return the law with the scores, and if asked for the covariances, of 3D-SSL, and the log losses of the scores."""
    from scipy.optimize import minimize

    losses: dict[str, Any] = {}
    for name, refine in (("closed_form", False), ("closed_form_refined", True)):
        rows = [row for scene in heard for row in closed_form_rows(scene, refine, law)]
        right, before = np.array([row[0] for row in rows]), np.array([row[3] for row in rows])
        terms = np.array([uncertainty.closed_form_terms(*row[2]) for row in rows])
        weights = logistic(terms, right, np.ones(len(right)))
        errors = np.array([row[1] for row in rows])[right]
        scatters = np.array([row[4] for row in rows])[right]

        def loss(parameters: np.ndarray, errors: np.ndarray = errors, scatters: np.ndarray = scatters) -> float:
            floor = max(np.exp(parameters[1]), LEAST_FLOOR_M)
            covariances = np.exp(parameters[0]) * scatters + floor**2 * np.eye(3)
            squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
            return float(np.mean(np.linalg.slogdet(covariances)[1] + squared))

        widened, floor = np.exp(minimize(loss, [0.0, np.log(0.1)], method="Nelder-Mead").x).tolist()
        floor = max(floor, LEAST_FLOOR_M)
        if not covariance:
            kept = law.closed_form_refined if refine else law.closed_form
            widened, floor = kept.widened, kept.floor
        one, spread, valid, events = rounded(weights)
        found = uncertainty.ClosedForm(one, spread, valid, events, round(widened, 3), round(floor, 4))
        law = replace(law, closed_form_refined=found) if refine else replace(law, closed_form=found)
        after = log_loss(right, 1.0 / (1.0 + np.exp(-np.clip(terms @ weights, -30, 30))))
        losses[name] = {"steps": len(right), "before": round(log_loss(right, before), 4), "after": round(after, 4)}
    return law, losses


def closed_form_rows(scene: Scene, refine: bool, law: uncertainty.Law) -> Iterator[tuple]:
    """Yield for each time step of 3D-SSL: right, error (3,), what tells, score, scatter (3, 3)."""
    localizer = ClosedFormLocalizer(scene.array, ClosedFormSettings(refine=refine), CONDITIONS[scene.condition][1], law)
    for step, found in localizer.steps(scene.samples).items():
        position, scatter = localizer.gathered(found)
        right, _, error = match(position, step / localizer.settings.rate, scene.people, set())
        told = localizer.reliability(found, scatter)
        yield right, error, told, law.closed_form_probability(*told, refined=refine), scatter


# --- the whole --------------------------------------------------------------------------------------------------------


def fit(
    heard: Sequence[Scene], law: uncertainty.Law, say: Callable[[str], None], *, covariance: bool
) -> tuple[uncertainty.Law, int]:
    """Return the law that fits scenes best, its covariance only where that is asked for, and the number of their peaks.

    What a decision remembers rests on the coefficients at hand, so that the scores are fitted twice with the new ones:
    on one scene of each condition, with each memory, and then on all.
    """
    few = heard[: len(CONDITIONS)]
    law, _ = fit_scores(peaks(few, law), law)
    tried = []
    for memory in MEMORIES:
        tried.append(fit_scores(peaks(few, replace(law, memory=memory)), replace(law, memory=memory)))
        say(f"memory {memory} s: log loss {tried[-1][1]:.4f}")
    law, _ = min(tried, key=lambda one: one[1])
    rows = peaks(heard, law)
    law, loss = fit_scores(rows, law)
    say(f"scores: log loss {loss:.4f}")
    if not covariance:
        return law, len(rows)
    sure = [row for row in rows if row.right and law.probability(row.features) > 0.5]
    spreads = []
    for sharpness in SHARPNESSES:
        errors = Errors(sure, sharpness)
        spreads.append((*fit_spread(errors, law), sharpness, errors))
        say(f"sharpness {sharpness}: loss {spreads[-1][1]:.4f}")
    spread, _, sharpness, errors = min(spreads, key=lambda one: one[1])
    law = replace(law, spread=spread, sharpness=sharpness)
    return replace(law, widened=fit_widened(errors, law)), len(rows)


def measured(heard: Sequence[Scene], law: uncertainty.Law) -> dict[str, float]:
    """Return how well a law scores and spreads: log losses, and shares of errors within 95 % ellipses."""
    rows = peaks(heard, law)
    first = np.array([row.features.first for row in rows])
    right, score = np.array([row.right for row in rows]), np.array([row.score for row in rows])
    told = [row for row in rows if row.right and row.score >= 0.5]
    nearest = min(SHARPNESSES, key=lambda sharpness: abs(sharpness - law.sharpness))
    errors = Errors(told, nearest)
    weights = widest(law.spread, law.widened)
    return {
        "peaks": len(rows),
        "first_log_loss": round(log_loss(right[first], score[first]), 4),
        "further_log_loss": round(log_loss(right[~first], score[~first]), 4),
        "covariance_loss": round(errors.loss(weights), 3),
        "in_95_standing": round(errors.held(weights, ~errors.walks), 3),
        "in_95_walking": round(errors.held(weights, errors.walks), 3),
        "reported": int((score >= 0.5).sum()),
        "reported_right": round(float(right[score >= 0.5].mean()), 4),
    }


def check(law: uncertainty.Law) -> dict[str, Any]:
    """Return what a small part of the fit gives, with the voices that avsim-audio has: a test runs it again.

    If it no longer gives the same, the peaks are no longer those that the law was fitted on.
    """
    rows = peaks(list(scenes("check", 1, None, conditions=(1, 11))), law)
    again, loss = fit_scores(rows, law)
    return {
        "peaks": len(rows),
        "right": sum(row.right for row in rows),
        "log_loss": round(log_loss(np.array([row.right for row in rows]), np.array([row.score for row in rows])), 4),
        "log_loss_of_its_own_fit": round(loss, 4),
        "first": again.first,
    }


def commit() -> str:
    """Return the commit of the code, empty where it is not known."""
    result = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return result.stdout.strip()


def main() -> None:
    """Fit, check and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    parser.add_argument("--speech", type=Path, default=shared if shared.is_dir() else None, help="folder of recordings")
    parser.add_argument("--scenes", type=int, default=4, help="scenes of each condition, of which the last is held out")
    parser.add_argument("--output", type=Path, default=FITTED, help="where the law goes")
    parser.add_argument("--covariance", action="store_true", help="fit the covariances too")
    parser.add_argument("--check", action="store_true", help="only renew the check")
    options = parser.parse_args()
    say = functools.partial(print, file=sys.stderr, flush=True)
    stated = json.loads(FITTED.read_bytes())
    shipped = uncertainty.Law.of(stated["law"])
    if not options.check:
        count = max(options.scenes - 1, 1)
        heard = list(scenes("fit", count, options.speech))
        held_out = list(scenes("held out", 1, options.speech))
        say(f"{len(heard)} scenes to fit, {len(held_out)} held out")
        law, number = fit(heard, shipped, say, covariance=options.covariance)
        law, closed = fit_closed_form(heard, law, covariance=options.covariance)
        stated = {
            "law": asdict(law),
            "fit": {
                "command": "make fit-localization",
                "avcli": avcli.__version__,
                "commit": commit(),
                "covariance": "fitted" if options.covariance else stated.get("fit", {}).get("covariance", "kept"),
                "scenes": len(heard),
                "seconds_each": SECONDS,
                "seeds": SEEDS,
                "speech": {k: f"CMU ARCTIC {v}" for k, v in SPEAKERS.items()} if options.speech else "built in",
                "conditions": [list(condition) for condition in CONDITIONS],
                "peaks": number,
                "held_out_before": measured(held_out, shipped),
                "held_out_after": measured(held_out, law),
                "closed_form_log_loss": closed,
            },
        }
        say(json.dumps(stated["fit"], indent=1))
    stated["check"] = check(uncertainty.Law.of(stated["law"]))
    options.output.write_text(json.dumps(stated, indent=2) + "\n")


if __name__ == "__main__":
    main()
