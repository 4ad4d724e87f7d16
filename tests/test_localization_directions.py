"""Compact arrays: directions instead of places."""

import numpy as np
import pytest
from localization_rooms import MICROPHONES, ROOM, heard, noisy, voice

from avcli.localization import directions
from avcli.localization.array import Array
from avcli.localization.health import ORDERED
from avcli.localization.settings import SteeredSettings
from avcli.localization.steered import CONTRADICTED, SteeredLocalizer
from avcli.localization.stream import Block

FS = 16000
LARGE = np.array([6.0, 5.0, 3.0])
TURN = 2.0 * np.pi * np.arange(6) / 6
RING = 0.08 * np.column_stack([np.cos(TURN), np.sin(TURN), 0.0 * TURN])
SHAPES = {
    "ring": np.array([2.5, 2.0, 1.1]) + RING,
    "on a wall": np.array([2.5, 0.05, 1.3]) + RING[:, [0, 2, 1]],
    "line on a wall": np.array([[2.5 + 0.04 * k, 0.03, 1.3] for k in range(6)]),
}


def decisions(microphones, *, mouth=(4.2, 3.6, 1.5), seconds=1.0):
    rng = np.random.default_rng(3)
    sound = voice(seconds, FS, rng)
    samples = noisy(heard(mouth, sound, FS, microphones=microphones, reflection=0.5, order=2, room=LARGE), 25, rng)
    localizer = SteeredLocalizer(Array(microphones, FS, LARGE), SteeredSettings(), np.random.default_rng(0))
    return [one for one in localizer.localize([Block(samples)]) if len(one.scores)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_direction_is_found_and_the_range_is_not_claimed(shape):
    """The direction is right, so is what is said of its error, and the ellipse holds the mouth."""
    microphones, mouth = SHAPES[shape], np.array([4.2, 3.6, 1.5])
    found = decisions(microphones)
    assert len(found) >= 6
    away = mouth - microphones.mean(axis=0)
    for decision in found:
        ray = decision.rays[0]
        error = np.angle(np.exp(1j * (np.arctan2(*ray.direction[1::-1]) - np.arctan2(*away[1::-1]))))
        assert abs(np.degrees(error)) < (3.0 if shape == "ring" else 6.0)
        assert abs(error) < 3.5 * ray.sd
        miss, covariance = decision.positions[0] - mouth, decision.covariances[0]
        assert miss @ np.linalg.solve(covariance, miss) < 11.3
        assert np.sqrt(np.linalg.eigvalsh(covariance)[-1]) > 0.4
        assert ((decision.positions[0] > 0.0) & (decision.positions[0] < LARGE)).all()


@pytest.mark.parametrize("height", [0.8, 2.9])
def test_a_line_tells_a_cone_and_no_direction_in_it(height):
    """The bearing of somebody who stands higher or lower than a line is told with the error that this makes."""
    microphones = np.array([[2.5 + 0.04 * k, 0.03, height] for k in range(6)])
    mouth = np.array([4.4, 1.2, 1.5])
    found = decisions(microphones, mouth=mouth)
    away = mouth - microphones.mean(axis=0)
    assert len(found) >= 6
    for decision in found:
        (ray,) = decision.rays
        error = np.arctan2(*ray.direction[1::-1]) - np.arctan2(*away[1::-1])
        assert abs(error) < 2.5 * ray.sd
        miss, covariance = decision.positions[0] - mouth, decision.covariances[0]
        assert miss @ np.linalg.solve(covariance, miss) < 11.3


def test_an_upright_line_tells_no_bearing():
    """Talkers on all sides of it are heard alike: the place is somewhere in the room, and no direction is told."""
    found = decisions(np.array([[2.5, 2.0, 0.9 + 0.05 * k] for k in range(6)]))
    assert len(found) >= 4
    for decision in found:
        assert decision.rays == ()
        assert (np.sqrt(np.diag(decision.covariances[0])[:2]) > 0.8).all()
        miss = decision.positions[0] - [4.2, 3.6, 1.5]
        assert miss @ np.linalg.solve(decision.covariances[0], miss) < 11.3


def test_records_say_that_the_range_is_unknown():
    """What is written for others has the origin, the direction and its standard deviation."""
    found = decisions(SHAPES["ring"])[0].detections()
    assert found.shows_less()
    np.testing.assert_allclose(found.origins[0], [2.5, 2.0, 1.1])
    assert np.hypot(*found.directions[0, :2]) == pytest.approx(1.0, abs=0.2)
    assert 0.0 < found.direction_sds[0] < 0.3


@pytest.mark.parametrize("height", [1.5, 1.9])
def test_the_echo_of_the_wall_behind_a_talker_is_no_second_talker(height):
    """It comes from the azimuth of the talker, and lower than a near mouth above a table."""
    rng = np.random.default_rng(1)
    microphones = np.array([2.5, 2.5, 0.76]) + 0.7 * RING + rng.uniform(-0.02, 0.02, RING.shape)
    for decision in decisions(microphones, mouth=(2.6, 3.5, height), seconds=2.0):
        away = np.array([ray.direction[:2] / np.linalg.norm(ray.direction[:2]) for ray in decision.rays if ray])
        assert len(away) < 2 or (away[0] @ away[1:].T < np.cos(np.radians(9))).all()


def test_a_mirror_image_that_the_room_allows_is_told():
    """An upright plane in the middle of the room hears front and back alike: both are told, each by half."""
    found = decisions(np.array([2.5, 2.0, 1.3]) + RING[:, [0, 2, 1]])
    for decision in found:
        assert decision.scores.max() <= 0.5
        assert decision.rays[0].direction[1] * decision.rays[1].direction[1] < 0.0


def test_a_distributed_array_observes_ranges():
    """The ring on the walls of a room keeps its places, and a table array of 30 cm is compact in a large room."""
    low, high = np.array([0.0, 0.0, 0.8]), np.array([*ROOM[:2], 2.0])
    assert directions.observes_ranges(Array(MICROPHONES, FS, ROOM), low, high)
    table = 2.0 * RING + [3.0, 2.5, 0.8]
    assert not directions.observes_ranges(Array(table, FS, LARGE), low, np.array([*LARGE[:2], 2.0]))


def test_noise_alone_makes_no_directions():
    """Half a minute of noise that differs from channel to channel has nearly no talkers."""
    samples = np.random.default_rng(5).standard_normal((10 * FS, 6))
    localizer = SteeredLocalizer(Array(SHAPES["ring"], FS, LARGE), SteeredSettings(), np.random.default_rng(0))
    found = [one for one in localizer.localize([Block(samples)]) if len(one.scores)]
    assert len(found) <= 2


AWAY = np.array([4.2, 3.6, 1.5])
CIRCLE = np.array([2.5, 2.0, 1.1]) + 0.05 * np.column_stack(
    [np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4), np.zeros(8)]
)


@pytest.fixture(scope="module")
def talk():
    """3 s of one talker, as a ring of eight microphones of 5 cm radius hears them, with noise 25 dB below."""
    sound = voice(3.0, FS, np.random.default_rng(11))
    samples = heard(AWAY, sound, FS, microphones=CIRCLE, reflection=0.6, order=2, room=LARGE)
    return noisy(samples, 25, np.random.default_rng(12))


def examined(samples, microphones=CIRCLE):
    """Return the decisions, the faults, and whether the last second has the talker's direction alone."""
    localizer = SteeredLocalizer(Array(microphones, FS, LARGE), SteeredSettings(), np.random.default_rng(0))
    found = list(localizer.localize([Block(samples)]))
    true = AWAY - microphones.mean(axis=0)
    errors = [
        np.angle(np.exp(1j * (np.arctan2(*ray.direction[1::-1]) - np.arctan2(*true[1::-1]))))
        for one in found[-10:]
        for ray in one.rays
    ]
    right = len(errors) >= 8 and np.degrees(np.abs(errors)).max() < 6.0
    return found, {(fault.channel, fault.kind) for fault in found[-1].faults}, right, localizer.health


def test_a_healthy_compact_array_is_not_blamed(talk):
    found, faults, right, health = examined(talk)
    assert right
    assert not faults
    assert not health.disputed
    assert not any(one.notices for one in found)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda x: x * np.where(np.arange(8) == 2, -1.0, 1.0), {(3, "polarity")}),
        (lambda x: np.column_stack([np.roll(one, 16 * (c == 5)) for c, one in enumerate(x.T)]), {(6, "late")}),
        (lambda x: np.column_stack([np.roll(one, 2 * (c == 5)) for c, one in enumerate(x.T)]), {(6, "late")}),
        (lambda x: x[:, [0, 4, 2, 3, 1, 5, 6, 7]], {(2, "swapped"), (5, "swapped")}),
        (
            lambda x: np.where(np.arange(8) == 6, x.std() * np.random.default_rng(1).standard_normal(x.shape), x),
            {(7, "unexplained")},
        ),
    ],
    ids=["polarity", "1 ms late", "0.12 ms late", "exchanged", "noise"],
)
def test_a_fault_of_a_compact_array_is_named_and_does_no_harm(talk, spoil, expected):
    found, faults, right, _ = examined(spoil(talk))
    assert faults == expected
    assert right
    notices = [notice for one in found for notice in one.notices]
    assert len(notices) == len(set(notices)) == len(expected)


def test_of_a_compact_array_that_fits_two_orders_nobody_is_believed():
    """A square with two neighbours exchanged is the mirror image of one with the other two exchanged."""
    square = CIRCLE[::2]
    sound = voice(3.0, FS, np.random.default_rng(11))
    samples = noisy(heard(AWAY, sound, FS, microphones=square, order=0, room=LARGE), 25, np.random.default_rng(12))
    found, faults, _, health = examined(samples[:, [0, 2, 1, 3]], square)
    assert not faults
    assert health.trust == ORDERED
    assert not any(len(one.scores) for one in found[-10:])
    assert [notice for one in found for notice in one.notices].count(CONTRADICTED) == 1
