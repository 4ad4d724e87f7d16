"""People who walk and talk in a room, and their sound at its microphones."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from avcli.acoustics.delayline import DirectSource
from avcli.acoustics.moving import MovingSource, first_sample
from avcli.acoustics.responses import LONGEST_TAPS
from avcli.acoustics.sampling import Interpolation, Switching, interpolation
from avcli.acoustics.signals import (
    FADE_S,
    FRAME_S,
    QUIET_DB,
    Voice,
    active_level,
    bandwidth,
    frame_levels,
    power_spectrum,
)
from avcli.acoustics.surroundings import Surroundings
from avcli.acoustics.trajectory import FASTEST_M_S
from avcli.formats.records import Identified

WALL_M = 0.05
"""m; a mouth is kept this far from walls, floor and ceiling, and inside the room."""
ANECHOIC_ERROR_DB = -80.0
"""dB; the direct path alone costs little at this error."""


@dataclass
class _Person:
    voice: Voice
    sampling: Interpolation | Switching
    band: float
    quiet: float
    sources: list[MovingSource | DirectSource] = field(
        default_factory=list
    )  # one for each group of microphones; none: silent
    time: float = 0.0
    mouth: np.ndarray = field(default_factory=lambda: np.zeros(3))
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    speaking: bool = False
    activity: list[list[float]] = field(default_factory=list)


class Speakers:
    """People who walk and talk, and their sound at the microphones of a room.

    Positions and turns come in one time step after another. Sound comes out as soon as it is settled, the same to the
    last bit in pieces of any length. A person who is missing from a time step is silent until they come back.

    Args:
        surroundings: the room and the microphones (its error_db is set here).
        voices: source signals at the room's sample rate; the person with object id i has voice i modulo their number.
        error_db: error relative to the sound, dB; without reflection it is at most ANECHOIC_ERROR_DB.
        switch_s: hold a response for so long and switch then, as gpuRIR does, s; None: interpolate.
        pause_s: pause between two repetitions of a recording, s.
        mouth_height_m: height above the floor of a mouth whose position is not stated, m.
        seed: seed of all chance.

    Attributes:
        time: the last time step, s; None before the first.
        moved_inside: how often a mouth on a wall or outside the room was moved inside.
        jumps: how often someone was faster than FASTEST_M_S; the voice fades out there and begins again here.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        voices: Sequence[np.ndarray],
        *,
        error_db: float = -40.0,
        switch_s: float | None = None,
        pause_s: float = 0.15,
        mouth_height_m: float = 1.6,
        seed: int = 0,
    ):
        if not np.any(surroundings.reflection):
            error_db = min(error_db, ANECHOIC_ERROR_DB)
        # Four errors add up: the images left out, the interpolation between nodes (bounded for the worst direction, on
        # average about 10 dB better), the signal above the band, and the responses' own.
        self._surroundings = replace(surroundings, error_db=error_db - 2.8)
        self._groups = _groups(self._surroundings)
        self._voices, self._error_db, self._pause_s = voices, error_db, pause_s
        self._switch_s, self._seed = switch_s, seed
        self._mouth_height_m = mouth_height_m
        self._people: dict[int, _Person] = {}
        self._sources: list[tuple[_Group, MovingSource | DirectSource]] = []
        self._finished = False
        self.time: float | None = None
        self.moved_inside = self.jumps = 0
        self._bounded = False
        self._computed = self._passed = 0

    def step(self, people: Identified) -> np.ndarray:
        """Take the people's positions at a time, and whose turn it is from then on.

        Args:
            people: ground truth. A mouth that is NaN is above the position; a person whose `speaking` is NaN speaks.

        Returns:
            The positions of their mouths, (n, 3) m.

        Raises:
            ValueError: the time does not increase.
        """
        if self.time is not None and people.timestamp <= self.time:
            raise ValueError(f"timestamp {people.timestamp:g} is not later than {self.time:g}")
        self.time = people.timestamp
        mouths = self._mouths(people)
        for identity in self._people.keys() - set(people.ids.tolist()):
            self._leave(self._people[identity])
        talking = ~(people.speaking < 0.5)  # also where it is not known
        for identity, mouth, speaking in zip(people.ids.tolist(), mouths, talking.tolist(), strict=True):
            person = self._people.get(identity)
            if person is None:
                person = self._people[identity] = self._meet(identity)
            elapsed = people.timestamp - person.time
            if person.sources and np.linalg.norm(mouth - person.mouth) > FASTEST_M_S * elapsed:
                self.jumps += 1
                self._leave(person)
            if not person.sources:
                self._begin(person, identity, people.timestamp, mouth)
            else:
                person.velocity = (mouth - person.mouth) / elapsed
                self._speak(person, people.timestamp, mouth, person.speaking)
            person.time, person.mouth, person.speaking = people.timestamp, mouth, speaking
        return mouths

    def finish(self) -> None:
        """End the scene at the last time step: voices fade out, and all sound is settled."""
        for person in self._people.values():
            self._leave(person)
        self._finished = True

    @property
    def settled(self) -> float:
        """The sample before which the sound does not change any more; infinite after `finish`."""
        if self._finished:
            return np.inf
        now = -np.inf if self.time is None else first_sample(self.time, self._surroundings.sample_rate_hz)
        return min([now - self._surroundings.spread - LONGEST_TAPS, *(source.settled for _, source in self._sources)])

    @property
    def bounded(self) -> bool:
        """Whether a mouth was nearer than NEAREST_M to a microphone, which hears it as at that distance."""
        return self._bounded or any(source.bounded for _, source in self._sources)

    @property
    def work(self) -> tuple[int, int]:
        """How many responses were computed, and how many more it would have been if all were new and nobody silent."""
        computed = self._computed + sum(source.computed for _, source in self._sources)
        return computed, self._passed + sum(source.passed for _, source in self._sources) - computed

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return and forget the sound at the microphones from sample `begin` to before `end`, (m, n) Pa."""
        heard = np.zeros((len(self._surroundings.microphones_m), end - begin))
        for group, source in self._sources:
            heard[group.channels] += source.take(begin, end)[group.copies]
        for _, source in self._sources:
            if source.exhausted:
                self._bounded |= source.bounded
                self._computed, self._passed = self._computed + source.computed, self._passed + source.passed
        self._sources = [(group, source) for group, source in self._sources if not source.exhausted]
        return heard

    def activity(self, begin_s: float, end_s: float) -> dict[int, list[list[float]]]:
        """Return when each voice sounds from one time to another: object id -> [start, end] s."""
        return {
            identity: [
                [max(start, begin_s), min(end, end_s)]
                for start, end in person.activity
                if start < end_s and end > begin_s
            ]
            for identity, person in sorted(self._people.items())
        }

    def _mouths(self, people: Identified) -> np.ndarray:
        above = people.positions.copy()
        above[:, 2] = self._mouth_height_m
        mouths = np.where(np.isnan(people.mouths), above, people.mouths)
        room = np.asarray(self._surroundings.room_dimensions_m)
        margin = np.minimum(WALL_M, room / 2)
        inside = np.clip(mouths, margin, room - margin)
        self.moved_inside += int((inside != mouths).any(axis=1).sum())
        return inside

    def _meet(self, identity: int) -> _Person:
        rate, voice = self._surroundings.sample_rate_hz, self._voices[identity % len(self._voices)]
        power, frequencies = power_spectrum(voice, rate)
        sampling: Interpolation | Switching
        if self._switch_s is not None:
            sampling = Switching(self._switch_s)
        else:
            sampling = interpolation(power, frequencies, self._error_db - 6, self._surroundings.speed_of_sound_m_s)
        return _Person(
            voice=Voice(voice, rate, self._pause_s),
            sampling=sampling,
            band=bandwidth(power, frequencies, self._error_db - 10) / rate,
            quiet=active_level(voice, rate) * 10 ** (QUIET_DB / 20),
        )

    def _begin(self, person: _Person, identity: int, time: float, mouth: np.ndarray) -> None:
        for number, group in enumerate(self._groups):
            source: MovingSource | DirectSource
            direct = self._surroundings.bands is None and not np.any(self._surroundings.reflection)
            if direct and isinstance(person.sampling, Interpolation):
                source = DirectSource(group.surroundings)
            else:
                source = MovingSource(
                    group.surroundings,
                    person.sampling,
                    person.band,
                    self._error_db - 15,
                    rng=np.random.default_rng([self._seed, identity % 2**63, *[number] * (number > 0)]),
                )
            source.move(time, mouth)
            person.sources.append(source)
            self._sources.append((group, source))
        person.velocity = np.zeros(3)

    def _speak(self, person: _Person, time: float, mouth: np.ndarray, speaking: bool) -> None:
        """Go on to a position, with or without a voice on the way there."""
        rate = self._surroundings.sample_rate_hz
        first = first_sample(person.time, rate)
        dry = person.voice.emit(first_sample(time, rate) - first, speaking)
        for source in person.sources:
            source.move(time, mouth, dry)
        for frame in np.flatnonzero(frame_levels(dry, rate) > person.quiet):
            start = first / rate + frame * FRAME_S
            end = min(start + FRAME_S, (first + len(dry)) / rate)
            if person.activity and start - person.activity[-1][1] < 2 * FRAME_S:
                person.activity[-1][1] = end
            else:
                person.activity.append([start, end])

    def _leave(self, person: _Person) -> None:
        """Fade out where the path ends."""
        if not person.sources:
            return
        self._speak(person, person.time + FADE_S, person.mouth + person.velocity * FADE_S, False)
        for source in person.sources:
            source.finish()
        person.sources, person.speaking = [], False


@dataclass(frozen=True)
class _Group:
    """Microphones that are simulated together, each position and orientation once.

    Attributes:
        surroundings: the room with the distinct ones of these microphones.
        channels: (m,) their indices among all microphones.
        copies: (m,) the index of each among the distinct ones.
    """

    surroundings: Surroundings
    channels: np.ndarray
    copies: np.ndarray


def _groups(surroundings: Surroundings) -> list[_Group]:
    """Separate the microphones that stand from those that move, which need more responses."""
    paths: list[bytes] = [
        b"" if path is None else path.times_s.tobytes() + path.positions_m.tobytes()
        for path in surroundings.trajectories
    ] or [b""] * len(surroundings.microphones_m)
    moving = np.array([path != b"" for path in paths])
    return [_distinct(surroundings, np.flatnonzero(chosen), paths) for chosen in (~moving, moving) if chosen.any()]


def _distinct(surroundings: Surroundings, channels: np.ndarray, paths: list[bytes]) -> _Group:
    """Take some of the microphones; those with one position, pattern and orientation are taken once."""
    directivities, orientations = surroundings.directivities, surroundings.orientations
    kept: dict[bytes, int] = {}
    copies = []
    for channel in channels.tolist():
        key = paths[channel] or surroundings.microphones_m[channel].tobytes()
        if directivities is not None and orientations is not None and directivities[channel] != 1:
            key += directivities[channel].tobytes() + orientations[channel].tobytes()
        copies.append(list(kept).index(key) if key in kept else len(kept))
        kept.setdefault(key, channel)
    first = list(kept.values())
    distinct = replace(
        surroundings,
        microphones_m=surroundings.microphones_m[first],
        directivities=None if directivities is None else directivities[first],
        orientations=None if orientations is None else orientations[first],
        trajectories=tuple(surroundings.trajectories[channel] for channel in first if paths[channel]),
    )
    return _Group(distinct, channels, np.array(copies))
