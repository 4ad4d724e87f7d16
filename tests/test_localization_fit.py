"""The fitted law is that of today's peaks, and the fit finds what it is made to find."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "tests" / "bench"))

import fit_localization

from avcli.localization import uncertainty

STATED = json.loads(fit_localization.FITTED.read_bytes())
FITTED_ON = STATED["fitted_on"]


def test_the_file_says_what_each_part_was_fitted_to():
    assert set(FITTED_ON["origin"]) == set(STATED["law"])


@pytest.mark.parametrize("trial", FITTED_ON.get("trials", []), ids=lambda trial: "+".join(trial["parts"]))
def test_a_part_was_replaced_only_where_it_was_surely_better_on_both_sets_and_no_scenario_was_worse(trial):
    assert {"command", "version", "commit", "seeds", "conditions", "worlds", "peaks", "candidate"} <= set(FITTED_ON)
    sets = [trial["conditions"], trial["worlds"]]
    better = all(one["gain"] > fit_localization.SURE * one["gain_standard_error"] for one in sets)
    assert ("hota" in trial) == better
    if better:
        before, after = trial["hota"]["before"], trial["hota"]["after"]
        better = all(after[name] > before[name] - fit_localization.FALL for name in before)
    assert trial["replaced"] == better
    for part in trial["parts"]:
        assert not better or STATED["law"][part] == FITTED_ON["candidate"][part]


@pytest.mark.parametrize(
    ("gain", "worlds_gain", "fall", "adopted"),
    [(0.1, 0.1, 0.0, True), (0.1, 0.01, 0.0, False), (-0.1, 0.1, 0.0, False), (0.1, 0.1, 0.001, False)],
)
def test_a_part_is_adopted_where_it_is_surely_better_on_both_sets_and_no_scenario_is_worse(
    gain, worlds_gain, fall, adopted
):
    standing = uncertainty.fitted_law()
    candidate = replace(standing, memory=standing.memory + 1.0)
    spread = np.array([-0.05, 0.0, 0.05, 0.0])  # a standard error of 0.02
    gains = {"conditions": gain, "worlds": worlds_gain}

    def judge(heard, law, parts):
        return 1.0 - (spread + gains[heard[0]]) * (law.memory == candidate.memory), {}

    def hotas(law, part):
        return {"s1": 0.9 - fall * (law.memory == candidate.memory)}

    sets = {name: [name] for name in gains}
    law, trials = fit_localization.adopt(standing, candidate, sets, hotas, judge)
    assert law == (candidate if adopted else standing)
    assert {trial["replaced"] for trial in trials} == {adopted}


def test_the_law_has_the_terms_that_the_code_has():
    law = uncertainty.fitted_law()
    assert {part: tuple(weights) for part, weights in law.spread.items()} == uncertainty.PARTS
    assert set(law.widened) <= set(uncertainty.PARTS)


@pytest.mark.parametrize("peak", ["first", "further"])
def test_the_score_is_better_than_the_evidence_alone_on_scenes_that_were_left_out(peak):
    loss = FITTED_ON["score"]["log_loss"][peak]
    assert loss["peaks"] > 4000
    assert loss["fitted"] <= loss["left_out"] < 0.8 * loss["evidence_alone"]
    assert next(iter(STATED["law"]["score"][peak])) == "one"


@pytest.mark.slow
def test_a_small_part_of_the_fit_gives_the_same_again():
    """If this fails, the peaks have changed: make fit-localization fits the law again."""
    stated, found = STATED["check"], fit_localization.check(uncertainty.fitted_law())
    assert found["peaks"] == pytest.approx(stated["peaks"], rel=0.05)
    assert found["right"] == pytest.approx(stated["right"], rel=0.05)
    assert found["log_loss"] == pytest.approx(stated["log_loss"], abs=0.02)
    assert found["log_loss_of_its_own_fit"] == pytest.approx(stated["log_loss_of_its_own_fit"], abs=0.02)
    assert found["log_loss_of_its_own_fit"] <= found["log_loss"] + 0.005


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


@pytest.mark.parametrize("peak", ["first", "further"])
def test_a_peak_is_the_likelier_the_surer_it_and_what_comes_after_it_are(peak):
    law = uncertainty.fitted_law()
    loss = FITTED_ON["score of after"]["log_loss"][f"{peak} after"]
    assert loss["peaks"] > 20000
    assert loss["left_out"] < 0.95 * loss["at_once"]
    chances = np.linspace(0.0, 1.0, 21)
    told = np.array(
        [
            [
                law.borne_out(uncertainty.After(score, (again,) * 3, False), _features(peak == "first"))
                for again in chances
            ]
            for score in chances
        ]
    )
    assert ((told > 0.0) & (told < 1.0)).all()
    assert (np.diff(told, axis=0) >= 0.0).all()
    assert (np.diff(told, axis=1) >= 0.0).all()
    assert told[10, 0] < 0.5 < told[10, -1]


def test_what_is_certainly_a_machine_and_what_is_beside_a_wall_stay_so_afterwards():
    law, sure = uncertainty.fitted_law(), uncertainty.After(0.99, (0.99, 0.99), False)
    assert law.borne_out(sure, _features(True)) > 0.95
    assert law.borne_out(sure, _features(True), edge=True) <= uncertainty.BEYOND_NEAR
    hum = replace(_features(True), steady=3.0)
    assert law.borne_out(sure, hum) <= law.voice(3.0) < 0.1


def _features(first):
    numbers = (2.0, 0.5, 0.8, 0.0, 0.0), (0.0, 0.5, 1.0, 0.0, 1.0), (1.0, 2.0, 0.0, 8.0, 0.0, 0.0)
    still = np.zeros(3)
    return uncertainty.Features(*numbers[0], first, *numbers[1], still, 0.003, still, still, still, *numbers[2])
