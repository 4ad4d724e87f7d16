"""Clocks of sensors that disagree: found where people walk, and nothing is said where nobody can tell."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from avcli.formats.records import Detections
from avcli.tracking.agreement import Agreement
from avcli.tracking.fusion import Fusion

Place = Callable[[float], tuple[float, float]]


def walking(t: float) -> tuple[float, float]:
    """Round a room at 1 m/s."""
    return 3 + 2 * math.cos(t / 2), 3 + 2 * math.sin(t / 2)


def standing(t: float) -> tuple[float, float]:
    return 2.0, 3.0


def found(positions: np.ndarray) -> Detections:
    return Detections(0.0, "", positions, np.full((len(positions), 3, 3), math.nan))


def told(place: Place, late: float, seconds: float = 45.0, **moved: float) -> list[str]:
    """What is said of a camera, and of microphones whose times are so many seconds late."""
    rng, agreement, said = np.random.default_rng(0), Agreement(), []
    records = [(t, "camera", place(t)) for t in np.arange(0, seconds, 0.1)]
    records += [(t + late, "microphones", place(t)) for t in np.arange(0, seconds, 0.1) if t % 4 < 3]
    for t, name, xy in sorted(records):
        off = moved.get("x", 0.0) if name == "microphones" else 0.0
        agreement.take(t, name, found(np.array([[xy[0] + off, xy[1], math.nan]]) + 0.1 * rng.standard_normal((1, 3))))
        said += agreement.news(t)
    return said


@pytest.mark.parametrize("late", [3.0, -3.0, 0.8])
def test_clocks_that_disagree_are_named_once_with_their_offset(late: float) -> None:
    (sentence,) = told(walking, late)
    first, second = ("camera", "microphones") if late > 0 else ("microphones", "camera")
    before, _, rest = sentence.partition(f"sensor {second!r} finds people where {first!r} found them ")
    assert before == ""
    assert float(rest.split(" s before")[0]) == pytest.approx(abs(late), abs=0.21)


@pytest.mark.parametrize(
    ("place", "late", "moved"),
    [(walking, 0.0, {}), (walking, 0.1, {}), (standing, 3.0, {})],
)
def test_nothing_is_said_where_clocks_agree_or_nobody_can_tell(place: Place, late: float, moved: dict) -> None:
    assert told(place, late, **moved) == []


@pytest.mark.parametrize(("phase", "late", "says"), [(0.5, 0.0, False), (0.25, 0.0, False), (0.5, 3.0, True)])
def test_records_that_are_never_of_one_time_do_not_pass_for_clocks_that_disagree(
    phase: float, late: float, says: bool
) -> None:
    agreement, said = Agreement(), []
    records = [(t, "eye", walking(t)) for t in np.arange(0.0, 120.0)]
    records += [(t + late, "ear", walking(t)) for t in np.arange(phase, 120.0)]
    for t, name, xy in sorted(records):
        agreement.take(t, name, found(np.array([[*xy, math.nan]])))
        said += agreement.news(t)
    assert bool(said) == says


def test_records_without_positions_and_a_sensor_alone_say_nothing() -> None:
    agreement = Agreement()
    for k in range(400):
        agreement.take(k / 10, "camera", found(np.array([[*walking(k / 10), 1.0]])))
        agreement.take(k / 10, "array", found(np.full((1, 3), math.nan)))
        agreement.take(k / 10, "quiet", found(np.empty((0, 3))))
        assert agreement.news(k / 10) == []


def test_fusion_says_it() -> None:
    said: list[str] = []
    fusion = Fusion(say=said.append)
    nan = np.full((1, 3, 3), np.nan)
    for k in range(250):
        t = k / 10
        here, earlier = (np.array([[*walking(s), 1.0]]) for s in (t, t - 3))
        looks = [("eye", here, "camera"), ("ear", earlier, "microphones")]
        fusion.step(t, [(t, name, Detections(t, name, z, nan, kind=kind)) for name, z, kind in looks])
    (sentence,) = [one for one in said if "do the clocks agree?" in one]
    assert sentence.startswith("sensor 'ear' finds people where 'eye' found them")
