"""What a tracker can be told: the settings of the command, and how sensors of each kind see people.

This module imports no numpy, so that the command's --help starts quickly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from avcli.formats.sensors import CAMERA, MICROPHONES
from avcli.settings import check, setting
from avcli.tracking.trackers import TRACKERS

if TYPE_CHECKING:
    from avcli.tracking.coverage import Coverage

__all__ = ["SENSORS", "TRACKERS", "Sensor", "Settings", "sensor"]


@dataclass(frozen=True)
class Settings:
    """What the user can decide about a tracker; each is an option of avfuse, but for the last three.

    Attributes:
        motion: "imm" (several motion models that switch) or "cv" (constant velocity).
        process_noise: m/s², of the constant-velocity model.
        birth: "poisson" (a track begins with the first unexplained detection) or "adaptive" (one record later).
        stay: s, mean time that a person stays in the room.
        doors: "walls" or "anywhere".
        hidden: whether a person can be hidden from a sensor for a while.
        show: "likely", "observed" or "all": which people are reported.
        room_margin: m beyond the room's walls where detections are still used.
        rate: Hz of the output, None: from config.json, else from the records.
        max_wait: s of data by which a sensor may lag behind another one of its stream; live: s of wall time, too.
        learn: whether the run learns where people come and leave, how each sensor loses them, its clutter and its
            detection probability.
        newborn: with adaptive birth, people expected to be born in each record.
        hypotheses: joint hypotheses kept in each cluster of interacting people.
    """

    motion: str = setting(
        "imm",
        "imm: people walk, stop and turn (interacting models); cv: constant velocity with --process-noise.",
        choices=("imm", "cv"),
    )
    process_noise: float = setting(
        0.5,
        "Standard deviation, in m/s2, of the acceleration, which is constant over each step.",
        unit="SIGMA",
        above=0.0,
        most=1e6,
        only="cv",
    )
    birth: str = setting(
        "poisson",
        "poisson: a track begins with any unexplained detection; adaptive: one record later (thesis).",
        choices=("poisson", "adaptive"),
    )
    stay: float = setting(
        70.0,
        "Mean time, in s, that a person stays; with --doors walls, people who walk near a wall leave 35 times sooner.",
        unit="S",
        above=0.0,
        most=math.inf,
    )
    doors: str = setting(
        "walls",
        "Where people come and go: mostly within 0.7 m of the walls, or anywhere.",
        choices=("walls", "anywhere"),
    )
    hidden: bool = setting(
        True,
        "--hidden: people can be hidden from a sensor (occluded, silent) for a while. --no-hidden: each record without "
        "a detection of a person speaks against the person.",
        flag="--hidden/--no-hidden",
    )
    show: str = setting(
        "likely",
        "likely: people who are probably there; observed: of those, who was detected since the last record; all: also "
        "people who probably left, with their existence.",
        choices=("likely", "observed", "all"),
    )
    room_margin: float = setting(
        0.5, "Ignore detections more than M metres outside the room of config.json.", unit="M", least=0.0
    )
    rate: float | None = setting(
        None,
        "Output records per second.",
        unit="HZ",
        above=0.0,
        most=1000.0,
        default_text="frame_rate_hz of config.json, else the commonest step of the records",
    )
    max_wait: float = setting(
        1.0,
        "Leave a sensor behind if it lags by more than S seconds of data behind another one of its stream. With "
        "--live, also if it is quiet for so long. inf: wait for all.",
        unit="S",
        least=0.0,
        most=math.inf,
    )
    learn: bool = True
    newborn: float = 0.05
    hypotheses: int = 40

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Sensor:
    """How one sensor sees people.

    Attributes:
        name: the name in its records.
        kind: "camera" or "microphones".
        detection: probability that it detects, in one record, a person who is detectable.
        clutter: false detections expected in one record.
        sigma: m along x and y, noise of detections that carry no covariance.
        floor: m, added (in squares) to the noise of those that do, for what their covariance does not know: body sway,
            calibration, sound and light that do not quite behave as modelled. As much again does not average away.
        hide, show: rates per second at which people become undetectable (occluded, silent) and detectable again;
            hide 0: people are always detectable.
        memory: s, for which an error lasts that does not average away.
        unheard: why people are undetectable, if that holds for all sensors with the same reason at once: who is silent
            is heard by no microphones. Empty: each sensor on its own.
        mouth_offset: m, how far in front of the body's axis the point lies that it localizes (a mouth).
        offset_sd, bias_sd: m, standard deviations of that, and of a bias along x and along y.
        score_within: m, a score is the probability that a detection is so near to a person; inf: anywhere.
        score_nats: how much a low score speaks against a detection at most, in nats. More than one record can tell if
            false detections come again in the same place, as echoes do.
        direction_sd: rad, noise of directions that carry none.
        range_sd: m, the same of distances.
        height, height_sd: m, mean and standard deviation over people of how high the point is that it localizes.
        coverage: where it detects people at all; None: everywhere alike.
    """

    name: str
    kind: str = CAMERA
    detection: float = 0.9
    clutter: float = 0.05
    sigma: tuple[float, float] = (0.15, 0.15)
    floor: float = 0.05
    hide: float = 0.1
    show: float = 1.0
    memory: float = 3.0
    unheard: str = ""
    mouth_offset: float = 0.0
    offset_sd: float = 0.03
    bias_sd: float = 0.02
    score_within: float = math.inf
    score_nats: float = 4.0
    direction_sd: float = math.radians(3.0)
    range_sd: float = 0.3
    height: float = 1.0
    height_sd: float = 0.3
    coverage: Coverage | None = field(default=None, compare=False)

    def field(self, surface: float) -> float:
        """Return the size in m² of what it covers of an area of that size in m²: where its false detections lie."""
        return surface if self.coverage is None or self.coverage.whole else self.coverage.surface

    def detectable(self) -> float:
        """Return the long-run probability that a person in the room is detectable."""
        return self.show / (self.hide + self.show) if self.hide else 1.0


SENSORS = {
    CAMERA: Sensor("", CAMERA),
    MICROPHONES: Sensor(
        "",
        MICROPHONES,
        detection=0.8,
        clutter=0.2,
        sigma=(0.25, 0.25),
        floor=0.1,
        hide=1.0,
        unheard="silent",
        mouth_offset=0.1,
        offset_sd=0.05,
        memory=10.0,
        bias_sd=0.05,
        score_within=0.5,
        score_nats=6.0,
        direction_sd=math.radians(5.0),
        height=1.45,
        height_sd=0.25,
    ),
}
"""The usual sensor of each kind. The values were chosen on generated scenes (`make bench-tracking`, seeds from 100)."""


def sensor(name: str, kind: str = CAMERA, **given: Any) -> Sensor:
    """Return the usual sensor of a kind under a name, with some of its fields given."""
    return replace(SENSORS[kind], name=name, **given)
