"""The fitted numbers of the detector: they come from the fit, and describe today's detector."""

import dataclasses
import json
import sys

import numpy as np
import pytest
from conftest import ROOT
from detection_people import ceiling_view

from avcli.detection import fitted
from avcli.detection.body import axis_covariance
from avcli.detection.fitted import AxisLaw, ScoreLaw
from avcli.detection.monocular import KINDS, PART_HEIGHTS, Fitted, stated

sys.path.insert(0, str(ROOT / "tests" / "bench"))
import detection_samples
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


def test_a_fit_that_was_interrupted_goes_on_where_it_was(tmp_path):
    looked: list[int] = []

    def look(k: int) -> detection_samples.Samples:
        looked.append(k)
        return detection_samples.Samples(score=[(float(k), True)])

    kept = detection_samples.folder(tmp_path)
    detection_samples._each("some", range(2), look, kept)
    (kept / "some-2.part").write_bytes(b"half")  # where it was interrupted
    samples = detection_samples._each("some", range(4), look, kept)
    assert looked == [0, 1, 2, 3]
    assert fit_detection.joined(samples, "score") == [(float(k), True) for k in range(4)]


def test_boxes_are_judged_by_the_covariances_that_the_detector_states():
    """The fit takes the covariance apart, so that trying a law costs next to nothing; together it is the detector's."""
    view = ceiling_view(4)
    law = dataclasses.replace(fitted.BOX, spread=1.7, floor_m=0.04, across=0.6)
    samples = []
    for place in np.array([[1.0, 1.2], [3.2, 2.1], [2.4, 3.4]]):
        outline = view.project(KINDS[0].outline * [1, 1, 1.75] + [*place, 0.0]) + 0.5
        parts = view.project(np.column_stack([np.tile(place, (3, 1)), PART_HEIGHTS * 1.75])) + 0.5
        samples.append((np.concatenate([outline.min(axis=0), outline.max(axis=0)]), parts, view, place, 0.9))
    losses = fit_detection.box_loss(law, samples)
    boxes, parts = (np.array(column) for column in list(zip(*samples, strict=True))[:2])
    told = [Fitted(boxes, view, known, law=law, scores=np.full(3, 0.9)).places() for known in (parts, None)]
    places = np.array([sample[3] for sample in samples])
    assert all(one.explained.all() for one in told)
    wanted = [fit_detection.surprise(one.positions - places, one.covariances) for one in told]
    assert losses == pytest.approx(np.mean(wanted, axis=0), abs=1e-6)


def test_a_law_narrows_across_the_line_of_sight_and_widens_by_the_score():
    law = dataclasses.replace(fitted.BOX, across=0.5, sure=0.6, unsure=1.0)
    away = np.array([[3.0, 4.0], [0.0, 0.0]])
    fit = np.tile(0.04 * np.eye(2), (2, 1, 1))
    one, _ = sure = stated(fit, away, law, np.zeros(2))
    assert np.linalg.eigvalsh(one) == pytest.approx([0.0036, 0.0144])
    assert [0.6, 0.8] @ one @ [0.6, 0.8] == pytest.approx(0.0144)
    assert stated(fit, away, law, np.full(2, 0.9)) == pytest.approx(sure * (1.5 / 0.6) ** 2)
    assert stated(fit, away, law, None) == pytest.approx(fit)
