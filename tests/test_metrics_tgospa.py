"""T-GOSPA against every course of assignments and known answers."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.metrics.ospa import set_distances
from avcli.metrics.sequence import Sequence
from avcli.metrics.tgospa import tgospa


def walk(n, y=0.0):
    return np.column_stack([np.arange(n) * 0.1, np.full(n, y)])


def frames(*tracks, length):
    return [
        (
            [k for k, row in enumerate(tracks) if t in row],
            np.array([row[t] for row in tracks if t in row]).reshape(-1, 2),
        )
        for t in range(length)
    ]


def by_trying_all(truth, track, length, c, p, gamma):
    """The definition, by going through every course of maps."""
    n, m = len(truth), len(track)
    maps = [s for s in product(range(-1, m), repeat=n) if len({j for j in s if j >= 0}) == sum(j >= 0 for j in s)]
    best = np.inf
    for course in product(maps, repeat=length):
        cost = 0.0
        for t, chosen in enumerate(course):
            for i, j in enumerate(chosen):
                here, there = t in truth[i], j >= 0 and t in track[j]
                if here and there:
                    cost += min(np.linalg.norm(truth[i][t] - track[j][t]), c) ** p
                elif here or there:
                    cost += c**p / 2
            cost += c**p / 2 * sum(t in track[j] for j in range(m) if j not in chosen)
            if t:
                for a, b in zip(course[t - 1], chosen, strict=True):
                    cost += gamma**p * (0 if a == b else 0.5 if -1 in (a, b) else 1)
        best = min(best, cost)
    return best ** (1 / p)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 2.0]), st.sampled_from([0.2, 1.0]))
@settings(max_examples=25, deadline=None)
def test_it_is_the_definition(seed, p, gamma):
    rng = np.random.default_rng(seed)
    length = 3
    truth, track = (
        [{t: rng.uniform(0, 1.5, 2) for t in range(length) if rng.random() < 0.8} for _ in range(2)] for _ in range(2)
    )
    total, _ = tgospa(Sequence.of(frames(*truth, length=length), frames(*track, length=length)), 1.0, p, gamma)
    assert total == pytest.approx(by_trying_all(truth, track, length, 1.0, p, gamma), abs=1e-9)


def test_known_answers():
    path = walk(20)
    truth = [([0], q[None]) for q in path]
    off = tgospa(Sequence.of(truth, [([3], q[None] + [0, 0.25]) for q in path]), 1.0)
    assert off == (pytest.approx(5.0), 0)
    switched = tgospa(Sequence.of(truth, [([t // 10], q[None]) for t, q in enumerate(path)]), 1.0)
    assert switched == (1.0, 1.0)
    nobody = tgospa(Sequence.of(truth, [([], np.zeros((0, 2)))] * 20), 1.0)
    assert nobody == (10.0, 0.0)


def test_without_a_price_for_switches_it_is_gospa():
    rng = np.random.default_rng(1)
    side = lambda: [(range(3), rng.uniform(0, 1.2, (3, 2))) for _ in range(30)]  # noqa: E731
    sequence = Sequence.of(side(), side())
    found = set_distances(sequence, 1.0, 1.0)
    assert tgospa(sequence, 1.0, 1.0, 0.0)[0] == pytest.approx(found.gospa.sum())
    assert tgospa(sequence, 1.0, 1.0, 0.5)[0] > found.gospa.sum()


def test_people_far_apart_are_affordable_and_a_crowd_is_not():
    far = [(range(12), np.column_stack([np.arange(12) * 5.0, np.full(12, t / 10)])) for t in range(40)]
    assert tgospa(Sequence.of(far, far), 1.0)[0] == 0
    crowd = [(range(12), np.column_stack([np.arange(12) / 20, np.full(12, t / 10)])) for t in range(40)]
    assert tgospa(Sequence.of(crowd, crowd), 1.0) is None
