"""The fitted numbers of the detector: they come from the fit, and describe today's detector."""

import dataclasses
import json
import sys

import numpy as np
import pytest
from conftest import ROOT

from avcli.detection import fitted
from avcli.detection.body import axis_covariance
from avcli.detection.fitted import AxisLaw, ScoreLaw

sys.path.insert(0, str(ROOT / "tests" / "bench"))
import fit_detection

KNOWN = json.loads((ROOT / "avcli" / "detection" / "fitted.json").read_text())


def test_the_fit_finds_the_law_that_errors_were_drawn_from():
    rng = np.random.default_rng(1)
    law = AxisLaw(0.05, 0.02, 0.12)
    samples = []
    for _ in range(3000):
        away, visible = rng.normal(0, 1, 2), rng.uniform(0.2, 1.0)
        samples.append((rng.multivariate_normal([0, 0], axis_covariance(away, visible, law)), away, visible))
    found = fit_detection.fit(fitted.AXIS, fit_detection.axis_loss, samples)
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(law), rel=0.08)
    assert fit_detection.axis_loss(found, samples).mean() <= fit_detection.axis_loss(law, samples).mean() + 1e-3


def test_the_fit_finds_the_surface_at_which_a_person_is_as_likely_as_not():
    rng = np.random.default_rng(2)
    surface = np.exp(rng.uniform(np.log(0.003), np.log(0.3), 4000))
    samples = list(zip(surface.tolist(), (rng.random(4000) < surface / (surface + 0.04)).tolist(), strict=True))
    found = fit_detection.fit(ScoreLaw(0.01), fit_detection.score_loss, samples)
    assert found.surface_m2 == pytest.approx(0.04, rel=0.15)


def test_a_few_outliers_cost_little():
    errors = np.random.default_rng(3).normal(0, 0.1, (500, 2))
    errors[:5] = 2.0
    covariances = np.broadcast_to(0.01 * np.eye(2), (500, 2, 2))
    clean = fit_detection.surprise(errors[5:], covariances[5:]).mean()
    assert fit_detection.surprise(errors, covariances).mean() < clean + 0.15


def test_samples_of_one_scene_count_as_one_where_they_are_alike():
    rng = np.random.default_rng(4)
    of_scenes = rng.normal(0, 1, 200)
    mean, alike = fit_detection.gained(np.repeat(of_scenes, 10), [10] * 200)
    assert mean == pytest.approx(of_scenes.mean())
    assert alike == pytest.approx(of_scenes.std() / np.sqrt(200))
    assert fit_detection.gained(rng.normal(0, 1, 2000), [10] * 200)[1] == pytest.approx(1 / np.sqrt(2000), rel=0.2)


def test_the_file_says_what_its_numbers_were_fitted_on():
    origin = KNOWN["fitted_on"]
    assert {"command", "data", "scenes", "frames", "seed", "other_seed", "version", "commit"} <= set(origin)
    assert origin["seed"] != origin["other_seed"]
    for name in fit_detection.LAWS:
        law = origin[name]
        better = law["gain"] > max(fit_detection.SURE * law["gain_standard_error"], 0.0)
        assert law["replaced"] == (better and name not in origin["kept"])
        assert KNOWN[name] == law["refitted"] or not law["replaced"]


@pytest.mark.slow
def test_the_numbers_describe_todays_detector():
    """On a part of the scenes that were fitted to, the detector is as far off as it was then."""
    origin = KNOWN["fitted_on"]
    part = origin["part"]
    samples = fit_detection.collect(part["scenes"], part["frames"], origin["seed"])
    samples += fit_detection.collect_worlds(part["worlds"], part["frames"], origin["world"])
    for name, (law, loss) in fit_detection.LAWS.items():
        losses = loss(law, fit_detection.joined(samples, name))
        assert len(losses) == pytest.approx(part[name]["samples"], abs=1)
        assert losses.mean() == pytest.approx(part[name]["loss"], abs=0.15), name
