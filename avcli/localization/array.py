"""The microphone array in its room, and what a localizer says about one time step."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from avcli.formats.experiment import Config, Wiring
from avcli.formats.features import Feature
from avcli.formats.records import Detections
from avcli.formats.sensors import MICROPHONES
from avcli.localization.faults import Fault
from avcli.numeric import SPEED_OF_SOUND_M_S, fft_length, speed_of_sound


@dataclass(frozen=True)
class Array:
    """Microphones in a room.

    Attributes:
        microphones: (m, 3) m.
        sample_rate: Hz.
        room: (3,) m, the far corner of a room whose near corner is the origin.
        speed_of_sound: m/s.
        wiring: the microphones' channels, None where each has its own without a fault.
    """

    microphones: np.ndarray
    sample_rate: float
    room: np.ndarray
    speed_of_sound: float = SPEED_OF_SOUND_M_S
    wiring: Wiring | None = None

    @classmethod
    def of(cls, config: Config, temperature_c: float | None = None) -> "Array":
        """Return the microphones and the room of a config.json, with its speed of sound or that at a temperature in °C.

        Raises:
            ValueError: a key is missing or wrong.
        """
        microphones, room = config.microphones, config.room
        speed = room.speed_of_sound_m_s if temperature_c is None else speed_of_sound(temperature_c)
        return cls(microphones.positions, microphones.sample_rate_hz, room.dimensions, speed, microphones.wiring)

    @property
    def usable(self) -> "Array":
        """The microphones whose channels are used, in sound that `put_right` gives."""
        if self.wiring is None:
            return self
        return replace(self, microphones=self.microphones[self.wiring.usable], wiring=None)

    @cached_property
    def spread(self) -> np.ndarray:
        """Standard deviation (3,) m of the microphones along the principal axes of the array, largest first."""
        centred = self.microphones - self.microphones.mean(axis=0)
        return np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred))

    def require(self, *, count: int, solid: bool = False) -> None:
        """Refuse an array from which no position can be computed.

        Args:
            count: the least number of microphones at different places.
            solid: whether to refuse microphones on one line and in one plane, too.

        Raises:
            ValueError: says which dimension is missing.
        """
        distinct = len(np.unique(np.round(self.microphones, 4), axis=0))
        if distinct < count:
            raise ValueError(
                f"{distinct} microphones at different places; a position in x, y and z needs {count} or more"
            )
        if solid and self.spread[1] < 0.01:
            raise ValueError(
                "the microphones are on one line; the closed form cannot decide where about it a talker is; "
                "use the method srp"
            )
        if solid and self.spread[2] < 0.001:
            raise ValueError(
                "the microphones are in one plane; the closed form cannot decide on which side a talker is; "
                "use the method srp"
            )

    def mean_delay(self, low: np.ndarray, high: np.ndarray) -> float:
        """Return the mean travel time in s from the middle of a volume with corners (3,) m to the microphones."""
        middle = 0.5 * (np.asarray(low) + np.asarray(high))
        return float(np.linalg.norm(self.microphones - middle, axis=1).mean() / self.speed_of_sound)


def put_right(samples: np.ndarray, wiring: Wiring, sample_rate: float) -> np.ndarray:
    """Return the sound (n, m) of the usable microphones, (n, u): in their order, of one polarity, none late.

    Where a channel is late, its last samples are zeros.
    """
    samples = samples[:, wiring.order[wiring.usable]] * wiring.sign[wiring.usable]
    delay, size = wiring.delay[wiring.usable], len(samples)
    if not delay.any() or not size:
        return samples
    padded = fft_length(size + int(np.ceil(np.abs(delay).max() * sample_rate)) + 16)
    frequency = np.fft.rfftfreq(padded, 1.0 / sample_rate)
    advanced = np.fft.rfft(samples, padded, axis=0) * np.exp(2j * np.pi * frequency[:, None] * delay)
    return np.fft.irfft(advanced, padded, axis=0)[:size]


@dataclass(frozen=True)
class Ray:
    """A direction, of a talker whose range is not observed.

    Attributes:
        origin: (3,) m.
        direction: (3,) unit vector; z is NaN where it is told on the floor alone.
        sd: rad, across it to each side.
    """

    origin: np.ndarray
    direction: np.ndarray
    sd: float


@dataclass(frozen=True)
class Talker:
    """A talker who was heard at one time.

    Attributes:
        position: (3,) m.
        covariance: (3, 3) m².
        score: probability that it is right.
        ray: from where in which direction, where the range is not observed.
        machine: probability that it is a machine, which the score counts; NaN where it is not known.
    """

    position: np.ndarray
    covariance: np.ndarray
    score: float
    ray: Ray | None = None
    machine: float = np.nan


@dataclass(frozen=True)
class Decision:
    """What was heard at one time.

    Attributes:
        time: s, when the sound was emitted.
        positions: (n, 3) m.
        covariances: (n, 3, 3) m².
        scores: (n,) probability that the detection is right.
        notices: what was noticed about the channels, one sentence each.
        skipped: how many time steps before it were skipped, since the localizer was behind a live stream.
        features: name -> what tells these talkers from others.
        faults: what is known to be wrong with the channels by then.
        rays: (n,) from where in which direction, None of a talker whose range is observed too; empty: of nobody.
        steady: (k, 3) m, where something sounds on and on, such as a fan, that is no talker; unit vectors of directions
            where the array is compact.
        machines: (n,) probability that the detection is a machine, see Talker; empty where there is no talker.
    """

    time: float
    positions: np.ndarray
    covariances: np.ndarray
    scores: np.ndarray
    notices: tuple[str, ...] = ()
    skipped: int = 0
    features: Mapping[str, Feature] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    rays: tuple[Ray | None, ...] = ()
    steady: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    machines: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(
        cls,
        time: float,
        talkers: Sequence[Talker] = (),
        notices: Iterable[str] = (),
        features: Mapping[str, Feature] | None = None,
        faults: tuple[Fault, ...] = (),
        steady: np.ndarray | None = None,
    ) -> "Decision":
        """Make a decision of the talkers that were found."""
        return cls(
            time,
            np.array([talker.position for talker in talkers], dtype=np.float64).reshape(-1, 3),
            np.array([talker.covariance for talker in talkers], dtype=np.float64).reshape(-1, 3, 3),
            np.array([talker.score for talker in talkers], dtype=np.float64),
            tuple(notices),
            features=features or {},
            faults=faults,
            rays=tuple(talker.ray for talker in talkers) if any(talker.ray for talker in talkers) else (),
            steady=np.zeros((0, 3)) if steady is None else steady,
            machines=np.array([talker.machine for talker in talkers], dtype=np.float64),
        )

    def with_talkers(self, talkers: Sequence[Talker], features: Mapping[str, Feature]) -> "Decision":
        """Return it with these talkers and what tells them from others."""
        told = Decision.of(self.time, talkers, self.notices, features, self.faults, self.steady)
        return replace(told, skipped=self.skipped)

    def detections(self, sensor: str = "audio") -> Detections:
        """Return it as what a sensor of this name found."""
        return Detections(
            self.time,
            sensor,
            self.positions,
            self.covariances,
            self.scores,
            kind=MICROPHONES,
            features=self.features,
            machines=self.machines,
            **self._partial(),
        )

    def _partial(self) -> dict[str, np.ndarray]:
        """Return origins (n, 3) m, directions (n, 3) and their standard deviations (n,) rad; nothing without rays."""
        if not self.rays:
            return {}
        unknown = np.full(3, np.nan)
        return {
            "origins": np.array([ray.origin if ray else unknown for ray in self.rays]),
            "directions": np.array([ray.direction if ray else unknown for ray in self.rays]),
            "direction_sds": np.array([ray.sd if ray else np.nan for ray in self.rays]),
        }


def time_steps(begin: int, count: int, sample_rate: float, rate: float, tail: float) -> range:
    """Return the time steps k, at k / rate seconds, that lie in a recording.

    Args:
        begin: the first sample's place on the clock, in samples.
        count: samples.
        sample_rate: Hz.
        rate: steps per second.
        tail: s at the end that are left out.
    """
    first = int(np.ceil(begin / sample_rate * rate - 1e-3))
    last = int(np.floor(((begin + count) / sample_rate - tail) * rate + 1e-3))
    return range(first, last + 1 if count else first)
