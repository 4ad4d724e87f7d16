"""Fit the evidence for avdetect-audio's peaks, judge it on other scenes, and write avcli/localization/fitted.json.

    make fit-localization                    # fit and judge: some minutes
    make fit-localization FIT_FLAGS=--check  # only renew the small check that a test runs

The scenes are of two kinds. Conditions: one or two people who stand, walk, pause or take turns, in rooms of T60 0.1 to
0.6 s, with noise 30 or 10 dB below them, heard by five to twelve microphones. With --speech DIR they speak real
recordings (CMU ARCTIC, one speaker for the fit, another for what judges), also raised and lowered in pitch; without it,
the voices that avsim-audio has. Worlds: avsim-scene's random scenes, where two to four people walk, sit and take turns,
as avsim-audio records them at a T60 of 0.2 to 0.6 s. A detection is right within 0.5 m in x and y of a talker who is
not taken and who sounds within 0.15 s.

A law of fitted.json is replaced only where the new one is better by more than two standard errors, counted by scene, on
other conditions and on other worlds, and where no HOTA of S1 to S4, tracked by ear alone, falls by 0.0005 or more. A
law that is better in the conditions alone may be worse in worlds. The file holds what was refused, too.
bench-localization measures the result with another simulator. The score follows from the evidence and more: make
fit-scores fits it, after this.

--covariance fits the covariances too. They are not fitted by default: 95 % ellipses then hold 96 instead of 99 % of the
errors of people who stand, but avfuse, which assumes that the errors of successive records are independent, tracks
worse (mean HOTA 0.591 instead of 0.626 on five random scenes).
"""

import argparse
import functools
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
import numpy as np  # noqa: E402
from localization_scenes import (  # noqa: E402
    CONDITIONS,
    SECONDS,
    SEEDS,
    SPEAKERS,
    WORLD,
    WORLD_S,
    WORLD_T60,
    Person,
    Scene,
    scenes,
    worlds,
)

import avcli  # noqa: E402
from avcli.formats.experiment import Config  # noqa: E402
from avcli.formats.media import Sound  # noqa: E402
from avcli.formats.records import Identified  # noqa: E402
from avcli.localization import uncertainty  # noqa: E402
from avcli.localization.array import Array, Talker  # noqa: E402
from avcli.localization.noise import NoiseLaw  # noqa: E402
from avcli.localization.places import Judged, PlaceFinder  # noqa: E402
from avcli.localization.settings import ClosedFormSettings, SteeredSettings  # noqa: E402
from avcli.localization.ssl3d import ClosedFormLocalizer  # noqa: E402
from avcli.localization.steered import SteeredLocalizer  # noqa: E402
from avcli.localization.stream import Block  # noqa: E402
from avcli.localization.windows import Heard  # noqa: E402

FITTED = ROOT / "avcli" / "localization" / "fitted.json"
RIGHT_M, NEARBY_S = 0.5, 0.15
SURE = 2.0
"""A law replaces the one that stands if it is better on other scenes by more than so many standard errors."""
FALL = 0.0005
"""HOTA that no scenario may lose."""
SIGNS: dict[str, tuple[float | None, float | None]] = {
    **dict.fromkeys(("residual", "heights", "strayed", "new", "climbed", "pace", "moves", "strongest"), (0.0, None)),
    "agreement": (None, 0.0),
}
"""Bounds of a covariance's weights: what speaks against a place makes it wider, whatever the errors at hand are."""

MEMORIES, SHARPNESSES = (0.18, 0.28, 0.45), (5.0, 8.0, 12.0)
TRIALS: tuple[tuple[str, ...], ...] = (
    ("first", "further", "memory"), ("first",), ("further",), ("memory",), ("closed_form",), ("closed_form_refined",),
    ("spread", "widened", "sharpness"),
)  # fmt: skip
"""The parts of a law that are tried, together or alone, in this order."""


# --- peaks ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One peak: whether it is right, its error (3,) m, and what its score and its covariance are made of.

    Attributes:
        weight: two at once are rarer in a room than in the conditions: there further peaks count twice where one
            talks.
        walks: whether its talker moves.
        others: (3, 3) m² for each of SHARPNESSES, see `Law.covariance`.
        extent: (3,) m, the standard deviation of a place anywhere in the searched volume.
        score: the probability that the evidence of the law in use stands for, see `Law.first`.
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


class Witness(PlaceFinder):
    """A finder that notes each of its peaks, with what covariances are made of only where `spread`."""

    def __init__(self, finder: PlaceFinder, scene: Scene, *, spread: bool):
        vars(self).update(vars(finder))
        self.scene, self.spread, self.rows = scene, spread, list[Row]()

    def report(self, time: float, judged: list[Judged], heard: Heard, noise: NoiseLaw) -> list[Talker]:
        """Note the peaks of a decision, and report nothing."""
        taken: set[int] = set()
        extent = np.maximum((self.response.high - self.response.low) / np.sqrt(12.0), uncertainty.FLOOR)
        rarer = self.scene.condition != WORLD and sum(person.sounds(time) for person in self.scene.people) < 2
        for one in judged:
            right, nearest, error = match(one.peak.position, time, self.scene.people, taken)
            peak, motion = one.peak, (one.peak.position, one.peak.velocity)
            others = [
                self.response.ambiguity(peak.gccs, heard.offsets, *motion, sharpness / noise.deviation)
                for sharpness in (SHARPNESSES if self.spread else ())
            ]
            person = self.scene.people[nearest]
            walks = bool(np.linalg.norm(person.at(time + 0.1) - person.at(time - 0.1)) > 0.02)
            self.rows.append(
                Row(
                    right,
                    error,
                    one.features,
                    peak.normal,
                    np.array(others),
                    extent,
                    2.0 if rarer and not one.features.first else 1.0,
                    walks,
                    self.scene.condition,
                    1.0 / (1.0 + float(np.exp(-np.clip(one.evidence, -30.0, 30.0)))),
                )
            )
        return []


def match(place: np.ndarray, time: float, people: list[Person], taken: set[int]) -> tuple[bool, int, np.ndarray]:
    """Return whether a place is right, the nearest person, and the error (3,) m; note in `taken` who was matched."""
    errors = place - np.array([person.at(time) for person in people])
    nearest = int(np.argmin(np.hypot(errors[:, 0], errors[:, 1])))
    near = bool(np.hypot(*errors[nearest, :2]) < RIGHT_M) and nearest not in taken
    if near:
        taken.add(nearest)
    return near and people[nearest].sounds(time, NEARBY_S), nearest, errors[nearest]


def peaks(heard: Sequence[Scene], law: uncertainty.Law, *, spread: bool = False) -> list[list[Row]]:
    """Return the peaks that the localizer finds in each scene with a law."""
    found = []
    for scene in heard:
        settings = SteeredSettings(lookahead=0.0)  # what is fitted here is what is known at once
        localizer = SteeredLocalizer(scene.array, settings, np.random.default_rng(0), law)
        if not isinstance(localizer.finder, PlaceFinder):
            raise TypeError("the array observes no ranges")
        localizer.finder = witness = Witness(localizer.finder, scene, spread=spread)
        for _ in localizer.localize([Block(scene.samples)]):
            pass
        found.append(witness.rows)
    return found


def joined(found: Iterable[list[Row]]) -> list[Row]:
    """Return the peaks of all scenes."""
    return [row for rows in found for row in rows]


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


ClosedFormRow = tuple[bool, np.ndarray, tuple[float, float, float], np.ndarray]


@functools.cache
def closed_form_rows(scene: Scene, name: str) -> list[ClosedFormRow]:
    """Return for each time step of 3D-SSL: right, error (3,) m, what tells, scatter (3, 3) m²."""
    localizer = ClosedFormLocalizer(scene.array, closed_form_settings(name), scene.rt60)
    rows: list[ClosedFormRow] = []
    for step, found in localizer.steps(scene.samples).items():
        position, scatter = localizer.gathered(found)
        right, _, error = match(position, step / localizer.settings.rate, scene.people, set())
        rows.append((right, error, localizer.reliability(found, scatter), scatter))
    return rows


def closed_form_settings(name: str) -> ClosedFormSettings:
    """Return the settings whose scores this part of a law gives."""
    return ClosedFormSettings(refine=name == "closed_form_refined")


def fit_closed_form(rows: Sequence[ClosedFormRow], kept: uncertainty.ClosedForm) -> uncertainty.ClosedForm:
    """Return the scores of 3D-SSL that fit best, with the covariances that are kept."""
    terms = np.array([uncertainty.closed_form_terms(*told) for _, _, told, _ in rows])
    weights = logistic(terms, np.array([right for right, *_ in rows]), np.ones(len(rows)))
    one, spread, valid, events = rounded(weights)
    return replace(kept, one=one, spread=spread, valid=valid, events=events)


# --- judgement --------------------------------------------------------------------------------------------------------

Judgement = tuple[np.ndarray, dict[str, Any]]
"""Mean losses (scenes,) in nats, NaN where a scene has nothing to judge, and figures of all scenes."""


def judged(heard: Sequence[Scene], law: uncertainty.Law, parts: Sequence[str]) -> Judgement:
    """Judge the parts of a law on scenes."""
    if parts[0].startswith("closed_form"):
        return judged_closed_form(heard, law, parts[0])
    return judged_spread(heard, law) if "spread" in parts else judged_scores(heard, law)


def judged_scores(heard: Sequence[Scene], law: uncertainty.Law) -> Judgement:
    """Judge the scores of peaks: those that a law finds itself, since what it remembers decides what is found."""
    found = peaks(heard, law)
    every = joined(found)
    first = np.array([row.features.first for row in every])
    right, score = np.array([row.right for row in every]), np.array([row.score for row in every])
    return np.array([mean_loss([(row.right, row.score) for row in rows]) for rows in found]), {
        "peaks": len(every),
        "first_log_loss": round(log_loss(right[first], score[first]), 4),
        "further_log_loss": round(log_loss(right[~first], score[~first]), 4),
        "reported": int((score >= 0.5).sum()),
        "reported_right": round(float(right[score >= 0.5].mean()), 4),
    }


def judged_closed_form(heard: Sequence[Scene], law: uncertainty.Law, name: str) -> Judgement:
    """Judge the scores of 3D-SSL."""
    found = [
        [
            (right, law.closed_form_probability(*told, refined=closed_form_settings(name).refine))
            for right, _, told, _ in closed_form_rows(scene, name)
        ]
        for scene in heard
    ]
    every = [one for pairs in found for one in pairs]
    return np.array([mean_loss(pairs) for pairs in found]), {
        "steps": len(every),
        "log_loss": round(mean_loss(every), 4),
    }


def judged_spread(heard: Sequence[Scene], law: uncertainty.Law) -> Judgement:
    """Judge the covariances of the peaks that are right and reported, by likelihood and by their 95 % ellipses."""
    found = [[row for row in rows if row.right and row.score >= 0.5] for rows in peaks(heard, law, spread=True)]
    weights = widest(law.spread, law.widened)
    errors = Errors(joined(found), law.sharpness)
    return np.array([Errors(rows, law.sharpness).loss(weights) if rows else np.nan for rows in found]), {
        "peaks": len(errors.errors),
        "loss": round(errors.loss(weights), 3),
        "in_95_standing": round(errors.held(weights, ~errors.walks), 3),
        "in_95_walking": round(errors.held(weights, errors.walks), 3),
    }


def mean_loss(pairs: Sequence[tuple[bool, float]]) -> float:
    """Return the log loss of pairs of what was and its probability; NaN of none."""
    right, probability = np.array(pairs).reshape(-1, 2).T
    return log_loss(right > 0, probability) if len(right) else np.nan


def gained(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return the mean gain of scenes (n,), and its standard error; the samples of one scene are not independent."""
    gains = (before - after)[np.isfinite(before - after)]
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains)))


@functools.cache
def scenario(name: str) -> tuple[Config, list[Identified], Sound]:
    """Return a scenario as the command line simulates it: its config, its ground truth and its sound."""
    scene = avcli.simulate(name, video=False)
    truth = list(scene.truth)
    return scene.config, truth, avcli.hear(scene.config, truth)


def by_ear(law: uncertainty.Law, part: str) -> dict[str, float]:
    """Return the HOTA of S1 to S4, tracked by ear alone, with the method to which a part of a law belongs."""
    found = {}
    for name in ("s1", "s2", "s3", "s4"):
        config, truth, sound = scenario(name)
        array, blocks = Array.of(config), [Block(sound.samples, sound.tail_samples / sound.sample_rate_hz)]
        localizer: SteeredLocalizer | ClosedFormLocalizer
        if part.startswith("closed_form"):
            reverberation = config.room.reverberation_time_s
            localizer = ClosedFormLocalizer(array, closed_form_settings(part), reverberation, law)
        else:
            localizer = SteeredLocalizer(array, SteeredSettings(), np.random.default_rng(0), law)
        heard = [decision.detections() for decision in localizer.localize(blocks)]
        found[name] = round(avcli.score(truth, avcli.track(config, heard))["HOTA"] or 0.0, 4)
    return found


def adopt(
    standing: uncertainty.Law,
    candidate: uncertainty.Law,
    others: Mapping[str, Sequence[Scene]],
    hotas: Callable[[uncertainty.Law, str], dict[str, float]] = by_ear,
    judge: Callable[[Sequence[Scene], uncertainty.Law, Sequence[str]], Judgement] = judged,
) -> tuple[uncertainty.Law, list[dict[str, Any]]]:
    """Return the law with the parts of a candidate that are surely better, and what was found about each of TRIALS.

    Args:
        standing: the law in use.
        candidate: the law that was fitted.
        others: sets of scenes that nothing was fitted to; a part must be better on each.
        hotas: gives the HOTA of each scenario with a law; it is asked where a part is better on all sets.
        judge: gives the losses of parts of a law.
    """
    trials: list[dict[str, Any]] = []
    known: dict[tuple, Judgement] = {}
    for parts in TRIALS:
        tried = replace(standing, **{part: getattr(candidate, part) for part in parts})
        if tried == standing:
            continue
        kind = parts[0] if parts[0].startswith("closed_form") else "spread" if "spread" in parts else "scores"
        outcome: dict[str, Any] = {"parts": parts}
        better = True
        for name, heard in others.items():
            key = (kind, name, repr(standing))
            before = known[key] = known.get(key) or judge(heard, standing, parts)
            after = known[(kind, name, repr(tried))] = judge(heard, tried, parts)
            gain, error = gained(before[0], after[0])
            better = better and gain > SURE * error
            figures = {"gain": round(gain, 4), "gain_standard_error": round(error, 4)}
            outcome[name] = {"scenes": len(heard), **figures, "before": before[1], "after": after[1]}
        if better:
            was, now = hotas(standing, parts[0]), hotas(tried, parts[0])
            outcome["hota"] = {"before": was, "after": now}
            better = all(now[name] > was[name] - FALL for name in was)
        outcome["replaced"] = better
        trials.append(outcome)
        print(json.dumps(outcome), file=sys.stderr, flush=True)
        standing = tried if better else standing
    return standing, trials


# --- the whole --------------------------------------------------------------------------------------------------------


def fit(
    heard: Mapping[str, Sequence[Scene]], law: uncertainty.Law, say: Callable[[str], None], *, covariance: bool
) -> tuple[uncertainty.Law, int]:
    """Return the law that fits scenes best, its covariance only where that is asked for, and the number of their peaks.

    What a decision remembers rests on the coefficients at hand, so that the scores are fitted twice with the new ones:
    on one scene of each condition and a few worlds, with each memory, and then on all.
    """
    few = [*heard["conditions"][:WORLD], *heard["worlds"][: WORLD // 4]]
    every = [*heard["conditions"], *heard["worlds"]]
    closed, refined = (
        fit_closed_form([row for scene in every for row in closed_form_rows(scene, name)], getattr(law, name))
        for name in ("closed_form", "closed_form_refined")
    )
    law = replace(law, closed_form=closed, closed_form_refined=refined)
    law, _ = fit_scores(joined(peaks(few, law)), law)
    tried = []
    for memory in MEMORIES:
        remembering = replace(law, memory=memory)
        tried.append(fit_scores(joined(peaks(few, remembering)), remembering))
        say(f"memory {memory} s: log loss {tried[-1][1]:.4f}")
    law, _ = min(tried, key=lambda one: one[1])
    found = joined(peaks(every, law, spread=covariance))
    law, loss = fit_scores(found, law)
    say(f"scores: log loss {loss:.4f}")
    return fit_covariance(found, law, say) if covariance else law, len(found)


def fit_covariance(rows: Sequence[Row], law: uncertainty.Law, say: Callable[[str], None]) -> uncertainty.Law:
    """Return the law with the covariances that fit the peaks best."""
    sure = [row for row in rows if row.right and law.probability(row.features) > 0.5]
    spreads = []
    for sharpness in SHARPNESSES:
        errors = Errors(sure, sharpness)
        spreads.append((*fit_spread(errors, law), sharpness, errors))
        say(f"sharpness {sharpness}: loss {spreads[-1][1]:.4f}")
    spread, _, sharpness, errors = min(spreads, key=lambda one: one[1])
    law = replace(law, spread=spread, sharpness=sharpness)
    return replace(law, widened=fit_widened(errors, law))


def check(law: uncertainty.Law) -> dict[str, Any]:
    """Return what a small part of the fit gives, with the voices that avsim-audio has: a test runs it again.

    If it no longer gives the same, the peaks are no longer those that the law was judged on.
    """
    rows = joined(peaks([*scenes("check", 1, None, conditions=(10,)), *worlds("check", 1)], law))
    _, loss = fit_scores(rows, law)
    return {
        "peaks": len(rows),
        "right": sum(row.right for row in rows),
        "log_loss": round(log_loss(np.array([row.right for row in rows]), np.array([row.score for row in rows])), 4),
        "log_loss_of_its_own_fit": round(loss, 4),
    }


def commit() -> str | None:
    """Return the commit of the code, None where it is not known."""
    result = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return result.stdout.strip() or None


def heard_in(split: str, conditions: int, worlds_: int, speech: Path | None) -> dict[str, list[Scene]]:
    """Return the scenes of a split: so many of each condition, and so many worlds."""
    return {"conditions": list(scenes(split, conditions, speech)), "worlds": list(worlds(split, worlds_))}


def renewed(stated: Mapping[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """Fit, judge, and return what the file shall state."""
    say = functools.partial(print, file=sys.stderr, flush=True)
    standing = uncertainty.Law.of(stated["law"])
    heard = heard_in("fit", options.scenes, options.worlds, options.speech)
    others = heard_in("held out", 1, options.worlds, options.speech)
    say(f"scenes to fit: {[len(one) for one in heard.values()]}, others: {[len(one) for one in others.values()]}")
    candidate, number = fit(heard, standing, say, covariance=options.covariance)
    law, trials = adopt(standing, candidate, others)
    here = commit()
    new = dict.fromkeys((part for one in trials if one["replaced"] for part in one["parts"]), f"fitted at {here}")
    return {
        "law": asdict(law),
        "fitted_on": {
            "command": "tests/bench/fit_localization.py",
            "version": avcli.__version__,
            "commit": here,
            "origin": {**stated["fitted_on"]["origin"], **new},
            "score": stated["fitted_on"]["score"],
            "seeds": SEEDS,
            "conditions": {
                "speech": {k: f"CMU ARCTIC {v}" for k, v in SPEAKERS.items()} if options.speech else "built in",
                "scenes": len(heard["conditions"]),
                "seconds_each": SECONDS,
                "what_t60_s_noise_db_array": [" ".join(map(str, condition)) for condition in CONDITIONS],
            },
            "worlds": {
                "scenes": options.worlds,
                "seconds_each": WORLD_S,
                "t60_s": WORLD_T60,
                "speech": "built in",
            },
            "peaks": number,
            "candidate": asdict(candidate),
            "trials": trials,
        },
    }


def main() -> None:
    """Fit, judge, check and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(os.environ.get("AVCLI_SHARED_DATA", ROOT.parent / "shared" / "data")) / "speech"
    parser.add_argument("--speech", type=Path, default=shared if shared.is_dir() else None, help="folder of recordings")
    parser.add_argument("--scenes", type=int, default=2, help="scenes of each condition to fit to; one more judges")
    parser.add_argument("--worlds", type=int, default=12, help="random worlds to fit to; as many others judge")
    parser.add_argument("--output", type=Path, default=FITTED, help="where the law goes")
    parser.add_argument("--covariance", action="store_true", help="fit the covariances too")
    parser.add_argument("--check", action="store_true", help="only renew the check")
    options = parser.parse_args()
    stated = json.loads(FITTED.read_bytes())
    if not options.check:
        stated = renewed(stated, options)
    stated["check"] = check(uncertainty.Law.of(stated["law"]))
    options.output.write_text(json.dumps(stated, indent=2) + "\n")


if __name__ == "__main__":
    main()
