"""Existence is as true as the tracks that it was fitted to: its curve, the fit, the shipped file."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parent / "bench"))

import fit_existence

from avcli.tracking.trust import FITTED, TRUST, Trust

probabilities = st.floats(0.0, 1.0)


@given(probabilities, probabilities, st.floats(0.0, 1e11), st.floats(0.0, 1e11))
def test_who_is_believed_in_more_or_was_seen_later_is_likelier_there(one, other, early, late):
    assert 0 <= TRUST.of(one, early) <= 1
    assert TRUST.of(min(one, other), early) <= TRUST.of(max(one, other), early)
    assert TRUST.of(one, max(early, late)) <= TRUST.of(one, min(early, late))


def test_the_fit_finds_the_curve_that_made_the_truth():
    rng, curve = np.random.default_rng(1), Trust(0.8, 0.6, -1.5)
    believed, unseen = rng.uniform(0, 1, 40000), rng.exponential(1.0, 40000)
    true = rng.uniform(size=40000) < [curve.of(*one) for one in zip(believed.tolist(), unseen.tolist(), strict=True)]
    found = fit_existence.fit(np.column_stack([believed, unseen, true]))
    assert found == pytest.approx(curve, abs=0.1)


def test_the_shipped_curve_made_existence_truer_where_it_was_fitted():
    whole = json.loads(FITTED.read_text())
    assert Trust(**whole["curve"]) == TRUST
    assert whole["fit"]["after"]["brier"] < whole["fit"]["before"]["brier"]
    for count, said, true in whole["fit"]["after"]["bins"]:
        assert count < 400 or said == pytest.approx(true, abs=0.06)
