"""Fit the scores of avdetect-audio to many arrays, and write them to avcli/localization/fitted.json.

    make setup-bench fit-scores FIT_FLAGS="--noises FOLDER"    # an hour; recordings as bench_steady.py has them
    make fit-scores FIT_FLAGS="--scenes 100 --cache DIR"       # fewer scenes; DIR keeps the simulated ones
    make fit-scores FIT_FLAGS="--only further"                 # the score of further talkers alone
    make fit-scores FIT_FLAGS="--only machine --noises FOLDER" # what tells a machine alone
    make fit-scores FIT_FLAGS="--only after --noises FOLDER"   # what the decisions after one say about its peaks alone

The scenes are those of array_scenes.py, split "decide", and more of them with four to six microphones, each with its
array as it is said to be and as people build it. What is remembered of a decision does not depend on the score, so that
the peaks are the same whatever it is, except for those that are sought since somebody was there later. What the
decisions after one say rests on their scores: it is fitted last, to scenes that are heard again. `make bench-scores`
measures the result on the split "judge".
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace

from bench_scores import Peak, log_loss, options_of, peaks, scenes
from fit_localization import FITTED, commit, logistic, rounded
from fit_localization import log_loss as fit_log_loss

# isort: split
import numpy as np
from array_scenes import MACHINES
from scipy.optimize import minimize

from avcli.localization import uncertainty

TERMS = {
    "first": (
        "one",
        "dilution",
        "residual",
        "support",
        "before",
        "strongest",
        "fall",
        "few",
        "few_residual",
        "few_dilution",
        "doubted",
    ),
    "further": (
        "one",
        "evidence",
        "strongest",
        "fall",
        "new",
        "few",
        "few_support",
        "confirmed",
        "crowded",
        "leading",
        "own",
        "relative",
        "leading_relative",
        "familiar",
    ),
}
"""What a score rests on, see `uncertainty.terms`. Chosen on the split "decide", by scenes that were left out."""
AFTER = {"first": ("one", "score", "doubt", "again", "sought"), "further": ("one", "score", "again", "sought")}
"""What the score of later rests on, see `uncertainty.after_terms`. With "doubt" too, further peaks have a log loss less
by 0.003, but 23 of 2036 scores over 0.9 are wrong in place of 13 of 1849."""
COUNTS = 0.15
"""How much a peak beside a machine counts: its scene a third of one without, which lasts half as long."""
STEPS = 30
"""Of the fit beside what bounds a score."""
PARTS = 6
"""In so many parts the scenes are split; each is predicted from the others."""


def fitted(found: Sequence[Peak], law: uncertainty.Law) -> tuple[uncertainty.Law, dict[str, dict[str, float]]]:
    """Return the law with the scores that fit peaks best, and log losses of evidence, fitted, on scenes left out.

    What tells a machine is fitted after the rest. Scenes with machines enter the score of further peaks, since somebody
    beside a louder machine is one; not that of first ones, which are the machine there.
    """
    score, losses = {}, {}
    for name, names in TERMS.items():
        further = name == "further"
        mine = [one for one in found if one.features.first != further and (further or one.given.act not in MACHINES)]
        weights = dict.fromkeys(names, 0.0)
        x = np.array([uncertainty.terms(one.features, weights, law.evidence(one.features)) for one in mine])
        right, part = np.array([one.right for one in mine]), np.array([one.given.number % PARTS for one in mine])
        weight = np.array([COUNTS if one.given.act in MACHINES else 1.0 for one in mine])
        bound = np.array([law.voice(one.features.steady) * uncertainty.near(one.features) for one in mine])
        bound = bound if further else np.ones(len(mine))
        found_weights = rounded(bounded(x, right, weight, bound))
        score[name] = dict(zip(names, found_weights, strict=True))
        left_out = np.zeros(len(mine))
        for k in range(PARTS):
            here, rest = part == k, part != k
            fit = bounded(x[rest], right[rest], weight[rest], bound[rest])
            left_out[here] = bound[here] * _logistic(x[here] @ fit)
        evidence = _logistic(np.array([law.evidence(one.features) for one in mine]))
        losses[name] = {
            "peaks": len(mine),
            "evidence_alone": round(log_loss(right, evidence), 4),
            "fitted": round(log_loss(right, bound * _logistic(x @ found_weights)), 4),
            "left_out": round(log_loss(right, left_out), 4),
        }
    law = replace(law, score=score)
    if any(one.given.act in MACHINES for one in found):
        law, losses["machine"] = told_apart(found, law)
    return law, losses


def fitted_after(found: Sequence[Peak], law: uncertainty.Law) -> tuple[uncertainty.Law, dict[str, dict[str, float]]]:
    """Return the law with what the decisions after one say about its peaks, and log losses, on scenes left out."""
    after, losses = {}, {}
    for name, names in AFTER.items():
        mine = [one for one in found if one.after and one.features.first == (name == "first")]
        terms = [uncertainty.after_terms(one.after) for one in mine if one.after]
        x = np.array([[term[name] for name in names] for term in terms])
        right, part = np.array([one.right for one in mine]), np.array([one.given.number % PARTS for one in mine])
        weight = np.array([COUNTS if one.given.act in MACHINES else 1.0 for one in mine])
        after[name] = dict(zip([*names, "middle"], rounded(undecided(x, right, weight)), strict=True))
        left_out = np.zeros(len(mine))
        for k in range(PARTS):
            here, rest = part == k, part != k
            *weights, middle = undecided(x[rest], right[rest], weight[rest])
            left_out[here] = _logistic(uncertainty.flattened(x[here] @ weights, middle))
        losses[f"{name} after"] = {
            "peaks": len(mine),
            "at_once": round(log_loss(right, np.array([one.after.score for one in mine if one.after])), 4),
            "left_out": round(log_loss(right, left_out), 4),
        }
    return replace(law, after=after), losses


def undecided(terms: np.ndarray, right: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weights (k + 1,) of greatest likelihood of terms (n, k), and how far their logit is `flattened`."""

    def loss(values: np.ndarray) -> float:
        logit = uncertainty.flattened(terms @ values[:-1], values[-1])
        return float(np.average(np.logaddexp(0.0, np.where(right, -logit, logit)), weights=weight))

    found: np.ndarray = minimize(loss, [*logistic(terms, right, weight), 0.0], method="BFGS").x
    return found


def bounded(terms: np.ndarray, right: np.ndarray, weight: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Return the weights (k,) of greatest likelihood where a peak is right with `bound` times its logistic chance.

    By expectation and maximization: what is wrong may be so for its bound alone.

    Args:
        terms: (n, k).
        right, weight, bound: (n,).
    """
    target, found = right.astype(float), np.zeros(terms.shape[1])
    for _ in range(STEPS if bound.min() < 1.0 else 1):
        found = logistic(terms, target, weight)
        chance = _logistic(terms @ found)
        target = np.where(right, 1.0, chance * (1.0 - bound) / (1.0 - bound * chance))
    return found


def told_apart(found: Sequence[Peak], law: uncertainty.Law) -> tuple[uncertainty.Law, dict[str, float]]:
    """Return the law that tells machines from voices best, and log losses of scenes with machines, before and after."""
    sounding = replace(law, machine={"one": -30.0, "steady": 0.0})  # as if there were no machines
    chance = np.array([sounding.probability(one.features) for one in found])
    right = np.array([one.right for one in found])
    machine = np.array([one.given.act in MACHINES for one in found])
    weight = np.where(machine, COUNTS, 1.0)

    def scores(values: np.ndarray) -> np.ndarray:
        tried = replace(law, machine={"one": float(values[0]), "steady": float(values[1])})
        return chance * np.array([tried.voice(one.features.steady) for one in found])

    def loss(values: np.ndarray) -> float:
        return fit_log_loss(right, scores(values), weight)

    best = np.round(minimize(loss, [-4.0, 10.0], method="Nelder-Mead", options={"maxiter": 150}).x, 2)
    before, after = log_loss(right[machine], chance[machine]), log_loss(right[machine], scores(best)[machine])
    told = {"peaks": int(machine.sum()), "without": round(before, 4), "fitted": round(after, 4)}
    return replace(law, machine={"one": float(best[0]), "steady": float(best[1])}), told


def _logistic(values: np.ndarray) -> np.ndarray:
    chances: np.ndarray = 1.0 / (1.0 + np.exp(-np.clip(values, -30.0, 30.0)))
    return chances


def main() -> None:
    """Fit and write."""
    parser = options_of(__doc__, few=70)
    parser.add_argument("--scenes", type=int, default=150)
    parser.add_argument("--only", choices=(*TERMS, "machine", "after"), help="write the score of these peaks alone")
    options = parser.parse_args()
    stated = json.loads(FITTED.read_bytes())
    standing = uncertainty.Law.of(stated["law"])
    found, _ = peaks(scenes(options, "decide"), standing)
    at_once = [one for one in found if not (one.after and one.after.sought)]
    if options.only == "after":
        law, losses = fitted_after(found, standing)
    elif options.only == "machine":
        law, told_of_machines = told_apart(at_once, standing)
        losses = {"machine": told_of_machines}
    else:
        law, losses = fitted(at_once, standing)
        if not options.only:
            found, _ = peaks(scenes(options, "decide"), law)
            law, told_after = fitted_after(found, law)
            losses |= told_after
    told = {
        "command": "tests/bench/fit_scores.py",
        "commit": commit(),
        "scenes": options.scenes,
        "scenes_with_four_to_six_microphones": options.few,
        "scenes_with_machines": len({one.given.number for one in found if one.given.act in MACHINES}),
        "split": "decide",
        "arrays": "each as it is said to be, and as people build it",
        "speech": "CMU ARCTIC aew, and the built-in voices",
        "log_loss": {name: one for name, one in losses.items() if options.only in (None, "after", name)},
    }
    part, origin, at = "score", stated["fitted_on"]["origin"], f"fitted at {told['commit']}, see fitted_on."
    if options.only == "machine":
        part = "score of machines"
        stated["law"]["machine"] = law.machine
        origin["machine"] = at + part
    elif options.only == "after":
        part = "score of after"
        stated["law"]["after"] = law.after
        origin["after"] = at + part
    elif options.only:
        part = f"score of {options.only}"
        stated["law"]["score"][options.only] = law.score[options.only]
        origin["score"] = f"{origin['score'].partition(';')[0]}; that of {options.only} peaks {at}{part}"
    else:
        stated["law"] |= {"score": law.score, "machine": law.machine, "after": law.after}
        stated["fitted_on"] = {name: of for name, of in stated["fitted_on"].items() if not name.startswith("score of")}
        origin |= dict.fromkeys(["score", "after"] + ["machine"] * ("machine" in losses), at + part)
    stated["fitted_on"][part] = told
    print(json.dumps(told, indent=2), file=sys.stderr)
    FITTED.write_text(json.dumps(stated, indent=2) + "\n")


if __name__ == "__main__":
    main()
