"""People who walk and talk in a room, as its microphones hear them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from avcli.acoustics.moving import MovingSource, first_sample
from avcli.acoustics.responses import MARGIN, Surroundings
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
from avcli.records import Sources

FASTEST_M_S = 20.0
"""m/s; who would have to be faster has jumped: the sound fades out there and in again here."""
WALL_M = 0.05
"""m; a mouth is kept this far from walls, floor and ceiling, and inside the room."""
ANECHOIC_ERROR_DB = -80.0
"""dB; where there is only the direct path, it costs little to have it so exact."""
MOUTH_HEIGHT_M = 1.6
"""m above the floor, of a mouth whose place is not stated."""


@dataclass
class _Person:
    voice: Voice
    sampling: Interpolation | Switching
    band: float
    quiet: float
    source: MovingSource | None = None
    time: float = 0.0
    mouth: np.ndarray = field(default_factory=lambda: np.zeros(3))
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    speaking: bool = False
    activity: list[list[float]] = field(default_factory=list)


class Speakers:
    """People who walk and talk, recorded by the microphones of a room.

    Places and turns come in one time step after another; sound comes out as soon as it is settled, the same to the last
    bit however it is asked for. Someone who is missing from a time step is silent until they come back.

    Args:
        surroundings: the room and the microphones (its error_db is set here).
        voices: source signals at the room's sample rate; the person with object id i has voice i modulo their number.
        error_db: error of what is heard relative to it, dB; without reflection it is at most ANECHOIC_ERROR_DB.
        switch_s: hold a response for so long and switch then, as gpuRIR does, s; None: interpolate.
        pause_s: between a recording's end and its next beginning, s.
        mouth_height_m: above the floor, of mouths whose place is not stated.
        seed: of all chance.

    Attributes:
        moved_inside: how often a mouth on a wall or outside the room was moved inside.
        jumps: how often someone was faster than FASTEST_M_S.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        voices: Sequence[np.ndarray],
        *,
        error_db: float = -40.0,
        switch_s: float | None = None,
        pause_s: float = 0.15,
        mouth_height_m: float = MOUTH_HEIGHT_M,
        seed: int = 0,
    ):
        if not np.any(surroundings.reflection):
            error_db = min(error_db, ANECHOIC_ERROR_DB)
        # Three errors add up: images left out, interpolation between nodes (which is reckoned for the worst direction
        # and is some 10 dB better over all), and what lies above the band.
        self._surroundings, self._copies = _distinct(replace(surroundings, error_db=error_db - 3.5))
        self._voices, self._error_db, self._pause_s = voices, error_db, pause_s
        self._switch_s, self._seed = switch_s, seed
        self._mouth_height_m = mouth_height_m
        self._people: dict[int, _Person] = {}
        self._sources: list[MovingSource] = []
        self._finished = False
        self.time: float | None = None
        self.moved_inside = self.jumps = 0

    def step(self, people: Sources) -> np.ndarray:
        """Take the people's places at a time, and whose turn it is from then on.

        Returns:
            (n, 3) m, where their mouths are.

        Raises:
            ValueError: the time does not increase.
        """
        if self.time is not None and people.timestamp <= self.time:
            raise ValueError(f"timestamp {people.timestamp:g} does not come after {self.time:g}")
        self.time = people.timestamp
        mouths = self._mouths(people)
        for identity in self._people.keys() - set(people.ids.tolist()):
            self._leave(self._people[identity])
        for identity, mouth, speaking in zip(people.ids.tolist(), mouths, people.speaking.tolist(), strict=True):
            person = self._people.get(identity)
            if person is None:
                person = self._people[identity] = self._meet(identity)
            elapsed = people.timestamp - person.time
            if person.source is not None and np.linalg.norm(mouth - person.mouth) > FASTEST_M_S * elapsed:
                self.jumps += 1
                self._leave(person)
            if person.source is None:
                person.source = MovingSource(
                    self._surroundings,
                    person.sampling,
                    person.band,
                    self._error_db - 15,
                    rng=np.random.default_rng([self._seed, identity % 2**63]),
                )
                person.source.move(people.timestamp, mouth)
                person.velocity = np.zeros(3)
                self._sources.append(person.source)
            else:
                person.velocity = (mouth - person.mouth) / elapsed
                self._speak(person, people.timestamp, mouth, person.speaking)
            person.time, person.mouth, person.speaking = people.timestamp, mouth, speaking
        return mouths

    def finish(self) -> None:
        """End the scene at the last time step: voices fade out, and what is heard of them is settled."""
        for person in self._people.values():
            self._leave(person)
        self._finished = True

    @property
    def settled(self) -> float:
        """The sample before which nothing changes any more; infinite once all is told."""
        if self._finished:
            return np.inf
        now = -np.inf if self.time is None else first_sample(self.time, self._surroundings.sample_rate_hz) - MARGIN
        return min([now, *(source.settled for source in self._sources)])

    def take(self, begin: int, end: int) -> np.ndarray:
        """Return and forget what the microphones hear from sample `begin` to before `end`, (m, n) Pa."""
        heard = np.zeros((len(self._surroundings.microphones_m), end - begin))
        for source in self._sources:
            heard += source.take(begin, end)
        self._sources = [source for source in self._sources if not source.exhausted]
        return heard[self._copies]

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

    def _mouths(self, people: Sources) -> np.ndarray:
        below = people.positions * (1.0, 1.0, 0.0) + (0.0, 0.0, self._mouth_height_m)
        mouths = np.where(np.isnan(people.mouths), below, people.mouths)
        room = np.asarray(self._surroundings.room_dimensions_m)
        margin = np.minimum(WALL_M, room / 2)
        inside = np.clip(mouths, margin, room - margin)
        self.moved_inside += int((inside != mouths).any(axis=1).sum())
        return inside

    def _meet(self, identity: int) -> _Person:
        rate, voice = self._surroundings.sample_rate_hz, self._voices[identity % len(self._voices)]
        sampling: Interpolation | Switching
        if self._switch_s is not None:
            sampling = Switching(self._switch_s)
        else:
            power, frequencies = power_spectrum(voice, rate)
            sampling = interpolation(power, frequencies, self._error_db - 5, self._surroundings.speed_of_sound_m_s)
        return _Person(
            voice=Voice(voice, rate, self._pause_s),
            sampling=sampling,
            band=bandwidth(voice, rate, self._error_db - 10) / rate,
            quiet=active_level(voice, rate) * 10 ** (QUIET_DB / 20),
        )

    def _speak(self, person: _Person, time: float, mouth: np.ndarray, speaking: bool) -> None:
        """Go on to a place, sounding on the way there."""
        rate = self._surroundings.sample_rate_hz
        first = first_sample(person.time, rate)
        dry = person.voice.emit(first_sample(time, rate) - first, speaking)
        person.source.move(time, mouth, dry)
        for frame in np.flatnonzero(frame_levels(dry, rate) > person.quiet):
            start = first / rate + frame * FRAME_S
            end = min(start + FRAME_S, (first + len(dry)) / rate)
            if person.activity and start - person.activity[-1][1] < 2 * FRAME_S:
                person.activity[-1][1] = end
            else:
                person.activity.append([start, end])

    def _leave(self, person: _Person) -> None:
        """Fade out where the way ends."""
        if person.source is None:
            return
        self._speak(person, person.time + FADE_S, person.mouth + person.velocity * FADE_S, False)
        person.source.finish()
        person.source, person.speaking = None, False


def _distinct(surroundings: Surroundings) -> tuple[Surroundings, np.ndarray]:
    """Return the surroundings with each microphone once, and for every microphone which of those it is, (m,)."""
    columns = [surroundings.microphones_m]
    if surroundings.directivities is not None:
        columns += [surroundings.directivities[:, None], surroundings.orientations]
    _, first, copies = np.unique(np.column_stack(columns), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # as they came
    kept, places = first[order], np.argsort(order)
    directional = surroundings.directivities is not None
    distinct = replace(
        surroundings,
        microphones_m=surroundings.microphones_m[kept],
        directivities=surroundings.directivities[kept] if directional else None,
        orientations=surroundings.orientations[kept] if directional else None,
    )
    return distinct, places[copies.ravel()]
