"""The fitted law is that of today's peaks, and the fit finds what it is made to find."""

import json
import sys

import numpy as np
import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "tests" / "bench"))

import fit_localization

from avcli.localization import uncertainty

STATED = json.loads(fit_localization.FITTED.read_bytes())


def test_the_fit_says_what_it_was_made_of_and_is_better_on_scenes_that_took_no_part():
    fit = STATED["fit"]
    assert {"command", "avcli", "commit", "scenes", "seeds", "speech", "conditions", "peaks"} <= set(fit)
    before, after = fit["held_out_before"], fit["held_out_after"]
    assert after["first_log_loss"] <= before["first_log_loss"]
    assert after["further_log_loss"] <= before["further_log_loss"]
    assert after["reported_right"] >= before["reported_right"]


def test_the_law_has_the_terms_that_the_code_has():
    law = uncertainty.fitted_law()
    assert {part: tuple(weights) for part, weights in law.spread.items()} == uncertainty.PARTS
    assert set(law.widened) <= set(uncertainty.PARTS)


def test_a_small_part_of_the_fit_gives_the_same_again():
    """If this fails, the peaks have changed: make fit-localization fits the law again."""
    stated, found = STATED["check"], fit_localization.check(uncertainty.fitted_law())
    assert found["peaks"] == pytest.approx(stated["peaks"], rel=0.05)
    assert found["right"] == pytest.approx(stated["right"], rel=0.05)
    assert found["log_loss"] == pytest.approx(stated["log_loss"], abs=0.02)
    assert found["log_loss_of_its_own_fit"] == pytest.approx(stated["log_loss_of_its_own_fit"], abs=0.02)
    assert found["log_loss_of_its_own_fit"] <= found["log_loss"] + 0.005
    assert found["first"] == pytest.approx(stated["first"], rel=0.15, abs=0.3)


def test_the_logistic_fit_finds_the_weights_that_made_the_data():
    rng = np.random.default_rng(1)
    terms = np.column_stack([np.ones(20000), rng.standard_normal((20000, 2))])
    weights = np.array([0.5, -2.0, 1.0])
    chance = 1.0 / (1.0 + np.exp(-terms @ weights))
    right = rng.random(20000) < chance
    found = fit_localization.logistic(terms, right, np.ones(20000))
    assert found == pytest.approx(weights, abs=0.1)
    fitted = 1.0 / (1.0 + np.exp(-terms @ found))
    assert fit_localization.log_loss(right, fitted) <= fit_localization.log_loss(right, chance)
