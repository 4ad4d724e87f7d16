"""Some trials of each kind of `make stress`, the same in every run: nothing is lost."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "bench"))
import stress
from stress_kinds import KINDS, wrong_records

COUNTS = {
    "files": 5,
    "detections": 3,
    "order": 2,
    "sounds": 4,
    "pictures": 4,
    "lens": 40,
    "cameras": 4,
    "rooms": 4,
    "scores": 3,
    "view": 2,
    "worlds": 2,
    "disk": 3,
}
"""`values` is what test_fuzz.py does; `ending` and `hour` take their time."""


FOUND = [("cameras", 106), ("sounds", 17), ("rooms", 6)]
"""Trials that were lost when they were first tried."""


@pytest.mark.parametrize(("kind", "seed"), FOUND)
def test_what_was_lost_once_is_not_lost_again(kind, seed):
    assert not stress.tried(kind, seed, longest_s=1800).lost


@pytest.mark.parametrize("kind", COUNTS)
def test_nothing_is_lost(kind):
    for seed in range(COUNTS[kind]):
        trial = stress.tried(kind, seed, longest_s=1800)
        assert not trial.lost, (seed, trial)


def test_what_is_lost_is_noticed():
    assert "NaN" in wrong_records(b'{"objects": [{"position": [NaN, 0, 0]}]}\n')
    assert "not whole" in wrong_records(b'{"objects": []}\n{"objects"')
    assert "covariance" in wrong_records(b'{"objects": [{"covariance": [[1, 2], [2, 1]]}]}\n')
    assert "probability" in wrong_records(b'{"objects": [{"existence": 1.5}]}\n')
    assert not wrong_records(b'{"objects": [{"covariance": [[1, 0], [0, 2]], "existence": 0.5}]}\n')


def test_a_table_says_how_each_kind_ended():
    found = {"lens": [(0, stress.Trial("a")), (1, stress.Trial("b", refused="no")), (2, stress.Trial("c", lost="x"))]}
    assert stress.table(found).splitlines()[-1].endswith("| 3 | 1 | 1 | 1 |")
    assert np.unique([stress.seed_of(name, 0) for name in KINDS]).size == len(KINDS)
