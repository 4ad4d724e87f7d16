"""Fit the scores of avdetect-audio to many arrays, and write them to avcli/localization/fitted.json.

    make setup-bench fit-scores                             # half an hour
    make fit-scores FIT_FLAGS="--scenes 100 --cache DIR"    # fewer scenes; DIR keeps the simulated ones

The scenes are those of array_scenes.py, split "decide". What is remembered of a decision does not depend on the score,
so that the peaks are the same whatever it is. `make bench-scores` measures the result on the split "judge".
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace

from bench_scores import Peak, log_loss, options_of, peaks, scenes
from fit_localization import FITTED, commit, logistic, rounded

# isort: split
import numpy as np

from avcli.localization import uncertainty

TERMS = {
    "first": ("one", "dilution", "residual", "support", "before", "strongest", "fall"),
    "further": ("one", "evidence", "strongest", "fall", "new"),
}
"""What a score rests on, see `uncertainty.terms`. Chosen on the split "decide", by scenes that were left out."""
PARTS = 6
"""In so many parts the scenes are split; each is predicted from the others."""


def fitted(found: Sequence[Peak], law: uncertainty.Law) -> tuple[uncertainty.Law, dict[str, dict[str, float]]]:
    """Return the law with the scores that fit peaks best, and log losses of evidence, fitted, on scenes left out."""
    score, losses = {}, {}
    for name, names in TERMS.items():
        mine = [one for one in found if one.features.first == (name == "first")]
        weights = dict.fromkeys(names, 0.0)
        x = np.array([uncertainty.terms(one.features, weights, law.evidence(one.features)) for one in mine])
        right, part = np.array([one.right for one in mine]), np.array([one.given.number % PARTS for one in mine])
        found_weights = rounded(logistic(x, right, np.ones(len(mine))))
        score[name] = dict(zip(names, found_weights, strict=True))
        left_out = np.zeros(len(mine))
        for k in range(PARTS):
            others = logistic(x[part != k], right[part != k], np.ones((part != k).sum()))
            left_out[part == k] = _logistic(x[part == k] @ others)
        evidence = _logistic(np.array([law.evidence(one.features) for one in mine]))
        losses[name] = {
            "peaks": len(mine),
            "evidence_alone": round(log_loss(right, evidence), 4),
            "fitted": round(log_loss(right, _logistic(x @ found_weights)), 4),
            "left_out": round(log_loss(right, left_out), 4),
        }
    return replace(law, score=score), losses


def _logistic(values: np.ndarray) -> np.ndarray:
    chances: np.ndarray = 1.0 / (1.0 + np.exp(-np.clip(values, -30.0, 30.0)))
    return chances


def main() -> None:
    """Fit and write."""
    parser = options_of(__doc__)
    parser.add_argument("--scenes", type=int, default=150)
    options = parser.parse_args()
    stated = json.loads(FITTED.read_bytes())
    standing = uncertainty.Law.of(stated["law"])
    found = peaks(scenes("decide", range(options.scenes), options.speech, options.cache), standing)
    law, losses = fitted(found, standing)
    stated["law"]["score"] = law.score
    stated["fitted_on"]["origin"]["score"] = f"fitted at {commit()}, see fitted_on.score"
    stated["fitted_on"]["score"] = {
        "command": "tests/bench/fit_scores.py",
        "commit": commit(),
        "scenes": options.scenes,
        "split": "decide",
        "speech": "CMU ARCTIC aew, and the built-in voices",
        "log_loss": losses,
    }
    print(json.dumps(stated["fitted_on"]["score"], indent=2), file=sys.stderr)
    FITTED.write_text(json.dumps(stated, indent=2) + "\n")


if __name__ == "__main__":
    main()
