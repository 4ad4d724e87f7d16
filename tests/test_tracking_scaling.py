"""The work of the tracker: in proportion to what is near to each other, bounded in a flood, and the same result."""

import math
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avcli.formats.sensors import MICROPHONES
from avcli.tracking import association, gaussian, scan
from avcli.tracking.association import competing, ranked
from avcli.tracking.densities import Densities
from avcli.tracking.glmb import GLMB
from avcli.tracking.hypotheses import Cluster
from avcli.tracking.model import Population
from avcli.tracking.settings import Settings, sensor


def people_at(positions: np.ndarray, spread: float, speed: float = 1.0) -> Densities:
    """One density with two motion models for each position (n, 2) m, with a standard deviation in m."""
    people, n = Densities.empty(2), len(positions)
    people.mean = np.zeros((n, 2, 4))
    people.mean[..., :2] = positions[:, None]
    people.mean[:, 1, 2:] = speed
    people.cov = np.tile(np.diag([spread**2, 2 * spread**2, 0.5, 0.5]), (n, 2, 1, 1))
    people.mode, people.label = np.tile([0.3, 0.7], (n, 1)), list(range(n))
    return people


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.3), st.floats(0.05, 3.0))
def test_only_pairs_that_are_near_are_computed_with_the_same_result(seed, ahead, size):
    rng = np.random.default_rng(seed)
    people = people_at(rng.uniform(0, 10 * size, (30, 2)), 0.3)
    z, deviation = rng.uniform(0, 10 * size, (40, 2)), rng.uniform(0.05, 0.5, 40)
    noise, unshared = np.square(deviation)[:, None, None] * np.array([[1.0, 0.4], [0.4, 0.5]]), np.full(30, 0.01)
    assert len(people) * len(z) > scan.DENSE
    expected = gaussian.innovation(people.mean, people.cov, ahead, unshared)
    gain, by_model = scan.likelihoods(people.mode, expected, z, noise)
    log, distance = gaussian.loglikelihood(expected, z, noise)
    every = np.where(distance < scan.GATE, np.exp(log), 0.0)
    np.testing.assert_allclose(by_model, every, rtol=1e-12)
    np.testing.assert_allclose(gain, (people.mode[:, None] @ every)[:, 0], rtol=1e-12)
    found = scan.possible(gain)
    assert [j for j, _ in found[0]] == np.flatnonzero(gain[0]).tolist()
    assert sum(map(len, found)) == np.count_nonzero(gain)


def test_likelihoods_cost_what_is_near(monkeypatch):
    counted = []
    log_normal = gaussian.log_normal
    monkeypatch.setattr(gaussian, "log_normal", lambda dx, *rest: counted.append(dx.size) or log_normal(dx, *rest))
    for n in (100, 400):
        z = np.column_stack([3.0 * np.arange(n), np.zeros(n)])
        people, noise = people_at(z, 0.1), np.tile(0.01 * np.eye(2), (n, 1, 1))
        scan.likelihoods(people.mode, gaussian.innovation(people.mean, people.cov), z, noise)
    assert counted == [2 * 100, 2 * 400]


def wanting(wants: list[list[int]]) -> tuple[list[Cluster], dict[int, list[tuple[float, int]]]]:
    """Clusters of one person each who may have caused some detections."""
    clusters = [Cluster([k], [(k,)], [0.0]) for k in range(len(wants))]
    return clusters, {k: [(-0.1 * at, j) for at, j in enumerate([*js, -1])] for k, js in enumerate(wants)}


def test_clusters_that_compete_are_joined_also_through_a_third():
    groups = competing(*wanting([[0], [1], [7], [1, 0], [], [7, 3]]))
    assert [[cluster.labels[0] for cluster in group] for group in groups] == [[1, 0, 3], [4], [2, 5]]


@given(st.lists(st.lists(st.integers(0, 12), max_size=3, unique=True), max_size=12))
def test_groups_are_the_connected_parts(wants):
    groups = [{cluster.labels[0] for cluster in group} for group in competing(*wanting(wants))]
    assert sorted(k for group in groups for k in group) == list(range(len(wants)))
    used = [{j for k in group for j in wants[k]} for group in groups]
    assert sum(map(len, used)) == len(set().union(*used))  # no detection in two groups
    for group in groups:
        reach = {min(group)}
        while more := {k for k in group - reach if any(set(wants[k]) & set(wants[one]) for one in reach)}:
            reach |= more
        assert reach == group


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_the_first_ranked_associations_are_those_of_the_whole_list(seed, most):
    rng = np.random.default_rng(seed)
    options = {
        row: sorted([(-rng.exponential(2), -1), *((rng.normal(0, 2), j) for j in range(3))], reverse=True)
        for row in range(4)
    }
    priors = [(-rng.exponential(), tuple(rng.permutation(4)[:3].tolist())) for _ in range(3)]
    whole = ranked(priors, options, span=6.0)
    assert ranked(priors, options, span=6.0, most=most) == whole[:most]
    assert whole[-1][0] >= whole[0][0] - 6.0
    assert [len(pairs) for _, pairs, _ in whole] == [3] * len(whole)
    assert all(row in {r for _, prior in priors for r in prior} for _, pairs, _ in whole for row, _ in pairs)


def test_one_person_costs_few_calls():
    sensors = [sensor("ceiling"), sensor("ring", MICROPHONES)]
    tracker, calls, noise = GLMB(Settings(), Population(), sensors), 0, 0.01 * np.eye(2)[None]

    def count(frame, event, arg):
        nonlocal calls
        calls += event in ("call", "c_call")

    for k in range(60):
        if k == 30:
            sys.setprofile(count)
        for name in ("ceiling", "ring"):
            tracker.update(k / 10, name, np.array([[1 + k / 20, 2.0]]), noise)
        tracker.tracks(k / 10)
    sys.setprofile(None)
    assert calls / 30 < 930  # of Python and of C, operators on arrays not counted


def test_a_large_cluster_keeps_fewer_hypotheses(monkeypatch):
    asked = []
    monkeypatch.setattr(association, "ranked", lambda *given: asked.append(given[2]) or ranked(*given))
    for n in (association.LARGE, 4 * association.LARGE, 1000):
        chain = [[k, k + 1] for k in range(n)]
        clusters, options = wanting(chain)
        (group,) = [association.associate(one, options, [1.0] * (n + 1), 40) for one in competing(clusters, options)]
        assert len(group.labels) == n
    assert asked == [association.BUDGET * most for most in (40, 10, 2)]


@pytest.mark.parametrize("likelihood", [0.0, 1e3, 1e300])
def test_a_ratio_of_many_detections_stays_finite(likelihood):
    n = 500
    ratio, known, parts = scan.plausibility(
        list(range(n)), [1.0] * n, [1.0] * n, [[(k, likelihood)] for k in range(n)], [1e-3] * n, [1e3] * n, 0.9
    )
    assert math.isfinite(ratio)
    assert len(known) == len(parts) == n
    assert np.isfinite(known + parts).all()


def test_a_flood_of_detections_gives_finite_tracks():
    rng = np.random.default_rng(3)
    tracker = GLMB(Settings(), Population(area=((0.0, 0.0), (12.0, 12.0))), [sensor("ceiling")])
    for k in range(4):
        tracker.update(k / 10, "ceiling", rng.uniform(0, 12, (400, 2)), np.tile(0.02 * np.eye(2), (400, 1, 1)))
    tracks = tracker.tracks(0.3)
    assert all(a.label < b.label for a, b in pairwise(tracks))
    assert np.isfinite([np.append(one.state, [one.existence, *one.cov.ravel()]) for one in tracks]).all()
    assert np.isfinite(tracker.people.existence).all()
    assert math.isfinite(tracker.rates[0].blindness.probability)
