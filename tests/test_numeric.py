"""FFT lengths, the speed of sound, optimal assignment."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avcli import numeric


@given(st.integers(1, 3_000_000))
def test_fft_lengths_are_even_smooth_and_tight(least):
    from scipy.fft import next_fast_len

    length = numeric.fft_length(least)
    assert length % 2 == 0
    assert least <= length <= max(2, 1 << (least - 1).bit_length())
    assert length >= next_fast_len(least, real=False)  # which has the factors 7 and 11 too
    for prime in (2, 3, 5):
        while length % prime == 0:
            length //= prime
    assert length == 1


def test_the_speed_of_sound():
    assert numeric.speed_of_sound(20.0) == pytest.approx(343.2)
    assert numeric.speed_of_sound(0.0) == pytest.approx(331.3, abs=0.05)
    for temperature in (-273.15, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="temperature"):
            numeric.speed_of_sound(temperature)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(-3, 3))
def test_the_assignment_is_that_of_scipy(seed, rows, more):
    from scipy.optimize import linear_sum_assignment

    cost = np.random.default_rng(seed).normal(size=(rows, max(rows + more, 1)))
    np.testing.assert_array_equal(numeric.assign(cost), linear_sum_assignment(cost))


@pytest.mark.parametrize("kind", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(1,), (2,), (9,), (10,), (3, 7), (3, 8)])
def test_medians_are_those_of_numpy(shape, kind):
    values = np.random.default_rng(1).uniform(150, 255, shape).astype(kind)  # two bytes would overflow
    assert np.array_equal(numeric.median(values), np.median(values, axis=-1))
