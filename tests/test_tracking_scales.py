"""A sensor whose noise is much larger than it is taken for."""

import numpy as np
import pytest

from avcli.formats.sensors import MICROPHONES
from avcli.tracking.glmb import GLMB
from avcli.tracking.model import Population
from avcli.tracking.settings import Settings, sensor


def factors(video=1.0, audio=1.0, clutter=0.0, seconds=10.0, speed=0.3, learn=True, seed=1):
    """Three people walk for some seconds; returns the factors on the variances of camera and microphones.

    video, audio: by how much their standard deviations are larger than what the filter is told, .15 and .25 m.
    """
    rng, size = np.random.default_rng(seed), (10.0, 8.0)
    tracker = GLMB(
        Settings(learn=learn), Population(((0.0, 0.0), size)), [sensor("video"), sensor("ring", MICROPHONES)]
    )
    places, heading = np.array([[2.0, 2.0], [5.0, 6.0], [8.0, 3.0]]), rng.uniform(0, 2 * np.pi, 3)
    for k in range(round(10 * seconds)):
        heading += rng.normal(0, 0.1 / max(speed, 1.0), 3)
        step = 0.1 * speed * np.column_stack([np.cos(heading), np.sin(heading)])
        inside = np.all((places + step > 1) & (places + step < np.array(size) - 1), axis=1)
        places, heading = places + np.where(inside[:, None], step, 0.0), np.where(inside, heading, heading + np.pi)
        for name, sigma, times in (("video", 0.15, video), ("ring", 0.25, audio)):
            z = (places + times * sigma * rng.standard_normal((3, 2)))[rng.random(3) < 0.9]
            z = np.vstack([z, rng.uniform(0, 1, (rng.poisson(clutter), 2)) * size])
            tracker.update(k / 10, name, z, np.tile(sigma**2 * np.eye(2), (len(z), 1, 1)))
    return tracker.errors.factor[:, 0].tolist()


@pytest.mark.parametrize("times", [2.5, 3.0])
def test_larger_noise_of_a_sensor_is_found_though_most_of_its_detections_are_far_from_everybody(times):
    video, audio = factors(audio=times)
    assert 0.4 * times**2 < audio < 2 * times**2
    assert 0.5 < video < 2


def test_larger_noise_of_both_is_found():
    video, audio = factors(video=2.5, audio=2.5)
    assert min(video, audio) > 2.5


@pytest.mark.parametrize("kind", [{}, {"clutter": 5.0}, {"clutter": 20.0, "seconds": 4.0}, {"speed": 4.0}])
def test_noise_as_it_is_told_stays(kind):
    assert max(factors(**kind)) < 2.5


def test_nothing_is_widened_where_nothing_is_learnt():
    assert factors(video=2.5, audio=2.5, learn=False, seconds=2.0) == [1.0, 1.0]
