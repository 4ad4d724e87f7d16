"""The sound of a scene: from where people are and whose turn it is to what the microphones of the room record.

`hear` does it for a whole scene, `Recorder` step by step.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from avcli.acoustics.images import NEAREST_M
from avcli.acoustics.noise import Noise
from avcli.acoustics.settings import Settings
from avcli.acoustics.signals import SourceSignals, pascal
from avcli.acoustics.speakers import Speakers
from avcli.acoustics.surroundings import surroundings_of
from avcli.acoustics.trajectory import Trajectory
from avcli.formats import media
from avcli.formats.experiment import Config
from avcli.formats.records import Identified

LONGEST_STEP_S = 60.0
"""s; a recording starts at time 0, or with its first time step if that is later than this (a clock of Unix time). Two
time steps are no further apart."""
PIECE = 1 << 16
"""samples that are taken at a time, which bounds the memory."""


def built_in_voices() -> list[media.Sound]:
    """Return the recordings that people speak where no others are given."""
    folder = Path(__file__).with_name("voices")
    return [media.Sound(*media.read_audio(path)) for path in sorted(folder.glob("*.flac"))]


class Recorder:
    """What the microphones of a room record of people who walk and talk in it, step by step.

    Call `step` for each time step, `finish` after the last, and after each call take the sound from `pieces`. The sound
    is the same to the last bit whenever it is taken.

    Args:
        config: room and microphones.
        settings: of the simulation; None: the defaults.
        speech: recordings that the people speak; the person with id i has recording i modulo their number. None: the
            built-in voices.
        trajectories: channel -> path of a microphone that moves.
        seed: seed of all chance.
        say: called with a sentence where the user should be warned.

    Attributes:
        surroundings: the room as it is simulated.
        begin: index of the first sample on the scene's clock, on which sample 0 is time 0.
        end: index after the last piece that was taken.

    Raises:
        ValueError: the room cannot be simulated; see `surroundings_of`.
    """

    def __init__(
        self,
        config: Config,
        settings: Settings | None = None,
        *,
        speech: Sequence[media.Sound] | None = None,
        trajectories: Mapping[int, Trajectory] | None = None,
        seed: int = 0,
        say: Callable[[str], None] = warnings.warn,
    ):
        settings = settings or Settings()
        self._say = say
        self.surroundings = surroundings_of(config, settings, trajectories, say)
        rate = self.surroundings.sample_rate_hz
        recordings = speech or built_in_voices()
        self._speakers = Speakers(
            self.surroundings,
            SourceSignals(recordings, rate, settings.level_db),
            error_db=settings.error_db,
            switch_s=settings.switch_s,
            pause_s=settings.pause_s,
            mouth_height_m=settings.mouth_height_m,
            seed=seed,
        )
        sensor_db, room_db = settings.sensor_noise_db, settings.room_noise_db
        self._noise: Noise | None = None
        if sensor_db is not None or room_db is not None:
            self._noise = Noise(
                self.surroundings.microphones_m,
                rate,
                sensor_pa=0.0 if sensor_db is None else pascal(settings.level_db - sensor_db),
                room_pa=0.0 if room_db is None else pascal(room_db),
                speed_of_sound_m_s=self.surroundings.speed_of_sound_m_s,
                seed=seed,
            )
        self.begin = self.end = 0
        self._scene_end: int | None = None

    @property
    def sample_rate_hz(self) -> int:
        """Sample rate of the sound, Hz."""
        return self.surroundings.sample_rate_hz

    def step(self, people: Identified) -> np.ndarray:
        """Take the ground truth of one time: the people's positions, and whose turn it is from then on.

        Returns:
            The positions of the people's mouths, (n, 3) m.

        Raises:
            ValueError: the time does not increase, or by more than LONGEST_STEP_S.
        """
        last = self._speakers.time
        if last is not None and people.timestamp > last + LONGEST_STEP_S:
            raise ValueError(f"the time {people.timestamp:g} s is more than {LONGEST_STEP_S:g} s after {last:g} s")
        if last is None and people.timestamp >= LONGEST_STEP_S:
            self.begin = self.end = math.ceil(people.timestamp * self.sample_rate_hz)
        return self._speakers.step(people)

    def finish(self) -> None:
        """End the scene at the last time step; what remains is the reverberation."""
        if self._speakers.time is None:
            return
        self._speakers.finish()
        self._scene_end = self._sample_at(self._speakers.time)
        if moved := self._speakers.moved_inside:
            self._say(f"a mouth on a wall or outside the room was moved inside ({_times(moved)})")
        if jumps := self._speakers.jumps:
            self._say(f"a person jumped ({_times(jumps)}); the voice is interrupted there")
        if self._speakers.bounded:
            self._say(f"a mouth came within {1000 * NEAREST_M:g} mm of a microphone; it is heard as from that distance")

    @property
    def work(self) -> tuple[int, int]:
        """How many responses of all microphones were computed so far, and how many more were not needed."""
        return self._speakers.work

    def pieces(self) -> Iterator[np.ndarray]:
        """Yield the sound that is settled and not yet taken, (≤ PIECE, m) Pa each."""
        settled = self._speakers.settled
        if self._scene_end is not None and self._speakers.time is not None:
            settled = self._sample_at(self._speakers.time + self.surroundings.tail_s)
        while self.end < settled:
            begin, self.end = self.end, int(min(settled, self.end + PIECE))
            sound = self._speakers.take(begin, self.end)
            if self._noise is not None:
                sound += self._noise.take(begin, self.end)
            yield sound.T

    def tail_samples(self, begin: int, end: int) -> int:
        """Return how many of the samples from `begin` to before `end` come after the end of the scene."""
        return 0 if self._scene_end is None else max(0, end - max(self._scene_end, begin))

    def activity(self, begin_s: float, end_s: float) -> dict[int, list[list[float]]]:
        """Return when each voice sounds from one time to another: id -> list of [start, end] s."""
        return self._speakers.activity(begin_s, end_s)

    def _sample_at(self, time_s: float) -> int:
        return math.ceil(time_s * self.sample_rate_hz - 1e-4)


def hear(
    config: Config,
    truth: Iterable[Identified],
    *,
    speech: Sequence[media.Sound] | None = None,
    trajectories: Mapping[int, Trajectory] | None = None,
    seed: int = 0,
    settings: Settings | None = None,
    say: Callable[[str], None] = warnings.warn,
) -> media.Sound:
    """Simulate what the microphones of a room record of people who walk and talk in it.

    >>> import numpy as np
    >>> from avcli.acoustics.settings import Settings
    >>> from avcli.formats.experiment import Config
    >>> from avcli.formats.records import Identified
    >>> config = Config({
    ...     "room_config": {"room_dimensions_m": [5.0, 4.0, 3.0]},
    ...     "microphone_config": {"mic_positions_m": [[1, 1, 2], [4, 1, 2]], "audio_sample_rate_hz": 16000},
    ... })
    >>> walk = [Identified(t, np.array([0]), np.array([[1.0 + t, 2.0, 0.0]])) for t in np.arange(11) / 10]
    >>> sound = hear(config, walk, settings=Settings(rt60_s=0.25, error_db=-20.0))
    >>> sound.samples.shape, sound.sample_rate_hz, sound.tail_samples
    ((20000, 2), 16000, 4000)
    >>> levels = 20 * np.log10(sound.samples[:8000].std(axis=0) / 2e-5)  # dB SPL; the walk starts near the first one
    >>> levels.round().tolist()
    [61.0, 58.0]

    Args:
        config: room and microphones.
        truth: the ground truth at increasing times: where people and their mouths are and whose turn it is to speak. A
            mouth that is NaN is `settings.mouth_height_m` above the floor; a person whose `speaking` is NaN speaks.
        speech: recordings that the people speak; the person with id i has recording i modulo their number. None: the
            built-in voices.
        trajectories: channel -> path of a microphone that moves.
        seed: seed of all chance.
        settings: of the simulation; None: the defaults.
        say: called with a sentence where the user should be warned.

    Returns:
        The sound in Pa, float32, the samples that avsim-audio writes to a 32-bit WAV. It lasts as long as the scene and
        its reverberation; `tail_samples` is the length of the latter.

    Raises:
        ValueError: the times do not increase, the first is not within LONGEST_STEP_S, or the room cannot be
            simulated; see `surroundings_of`.

    Source: J. B. Allen and D. A. Berkley, "Image method for efficiently simulating small-room acoustics", JASA 65(4),
    1979; see the modules for what follows from moving sources.
    """
    recorder = Recorder(config, settings, speech=speech, trajectories=trajectories, seed=seed, say=say)
    pieces = [np.zeros((0, len(recorder.surroundings.microphones_m)), np.float32)]
    for people in truth:
        recorder.step(people)
        if recorder.begin:
            raise ValueError(f"the scene starts at {people.timestamp:g} s; subtract its start from all times")
        pieces += [piece.astype(np.float32) for piece in recorder.pieces()]
    recorder.finish()
    pieces += [piece.astype(np.float32) for piece in recorder.pieces()]
    return media.Sound(
        np.concatenate(pieces), recorder.sample_rate_hz, recorder.tail_samples(recorder.begin, recorder.end)
    )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
