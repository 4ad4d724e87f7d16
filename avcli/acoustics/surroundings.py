"""The surroundings of a sound: the walls of the room, its air, its microphones, and how far a sound is followed in it.

`surroundings_of` makes them from what config.json states about room and microphones and from the settings.
"""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from avcli.acoustics import absorption as absorptions
from avcli.acoustics import decay
from avcli.acoustics.bands import BANDS_HZ, BEHIND_DB, Bands, reach_samples
from avcli.acoustics.images import MOST_IMAGES, image_count
from avcli.acoustics.settings import Settings
from avcli.acoustics.trajectory import Trajectory
from avcli.formats.experiment import DIRECTIVITIES, Config, Room
from avcli.formats.schema import shown
from avcli.materials.decay import LEAST_ABSORBED, MIDDLE, air_loss, contents_loss, reverberation_time
from avcli.numeric import SPEED_OF_SOUND_M_S
from avcli.settings import DEFAULT_RT60_S, settings_of

STRIDE_M = 0.75
"""m; the audible images are chosen anew after source and microphones have moved by this much."""
MOTION_STEP_S = 0.001
"""s; a microphone moves in a straight line for so long: at 10 m/s² it is wrong by no more than 1.3 µm."""
COST_S, COST_OF_IMAGE_S, COST_OF_SAMPLE_S = 0.02, 1.1e-6, 2e-6
"""s of computing for each microphone and each second of a voice that moves at 1 m/s, for each image of the microphone,
and for each sample of its response: measured at reverberation times from 0 to 0.9 s on one core of a server of 2023."""
AFFORDABLE_IMAGES, AFFORDABLE_IN_BANDS = 300_000, 20_000
"""images of a microphone with which --ism-decay is advised, and with which a room of materials is followed."""
DIFFERENT = 0.1
"""share by which a stated reverberation time may differ from that of the materials before the user is warned."""
LONG_S, MANY_IMAGES = 20.0, 1_000_000
"""s of computing for a second of a moving voice, and images of a microphone; the user is warned of more."""
MOST_SAMPLES = 1 << 25
"""samples of the responses of all microphones; more would take gigabytes."""
BYTES_AN_IMAGE = 100
"""bytes, roughly, that the choice among the images of a microphone takes for each of them."""
DECAY_HEARD_DB = 15.0
"""dB by which the followed reverberation decays below the permitted error: at -45 dB it is followed for all of T60."""


@dataclass(frozen=True)
class Surroundings:
    """What is around a source: the walls of a room and the microphones in it.

    Attributes:
        room_dimensions_m: (3,) m.
        reflection: (6,) signed pressure coefficients of the walls x0 x1 y0 y1 z0 z1.
        microphones_m: (m, 3) m.
        sample_rate_hz: Hz.
        reach_m: length of the longest path that is followed, m.
        error_db: images that can be left out for this relative error (dB) are left out; None: none are.
        speed_of_sound_m_s: m/s.
        directivities: (m,) a of the microphones' pattern a + (1 − a) cos θ; None: all are omnidirectional.
        orientations: (m, 3) unit vectors in which they look; needed with directivities.
        source_directivity: a of the source's pattern; 1 is omnidirectional.
        rt60_s: reverberation time, s.
        end_s: end of the noise, s: what walls scatter, and what continues the images after reach_m; 0: without noise.
        bands: what walls, air and the source's head do in octave bands, instead of the size of `reflection` and the
            source's pattern; None: the same at all frequencies.
        trajectories: (m,) the paths of the microphones that move, None for one that stands at microphones_m.
    """

    room_dimensions_m: np.ndarray
    reflection: np.ndarray
    microphones_m: np.ndarray
    sample_rate_hz: int
    reach_m: float
    error_db: float | None = None
    speed_of_sound_m_s: float = SPEED_OF_SOUND_M_S
    directivities: np.ndarray | None = None
    orientations: np.ndarray | None = None
    source_directivity: float = 1.0
    rt60_s: float = 0.0
    end_s: float = 0.0
    bands: Bands | None = None
    trajectories: tuple[Trajectory | None, ...] = ()

    @property
    def samples_per_m(self) -> float:
        """Samples in which sound travels a metre."""
        return self.sample_rate_hz / self.speed_of_sound_m_s

    @property
    def spread(self) -> int:
        """Samples before and after an impulse that the octave bands may spread it to."""
        return 0 if self.bands is None else reach_samples(self.sample_rate_hz)

    @property
    def tail_s(self) -> float:
        """How long a sound is heard after its end, s: the reverberation time, or the way through the room."""
        return max(self.rt60_s, float(np.linalg.norm(self.room_dimensions_m)) / self.speed_of_sound_m_s)

    @property
    def longest_delay(self) -> int:
        """Samples that a response lasts, with the source up to STRIDE_M away from where its images were chosen.

        Sound takes longer to a microphone that moves away from it.
        """
        receding = self.fastest_microphone(-np.inf, np.inf) / self.speed_of_sound_m_s
        longest_path = int(np.ceil((self.reach_m + STRIDE_M) / (1 - receding) * self.samples_per_m)) + 1
        return max(longest_path, int(np.ceil(self.end_s * self.sample_rate_hz)) + 1)

    def fastest_microphone(self, begin_s: float, end_s: float) -> float:
        """Return a speed that no microphone exceeds from one time to another, m/s."""
        return max((path.fastest(begin_s, end_s) for path in self.trajectories if path is not None), default=0.0)

    def microphones_at(self, times_s: np.ndarray) -> np.ndarray:
        """Return where the microphones are at k times, (k, m, 3) m; (1, m, 3) where no microphone ever moves."""
        if not any(self.trajectories):
            return self.microphones_m[None]
        positions = np.repeat(self.microphones_m[None], len(times_s), axis=0)
        for microphone, path in enumerate(self.trajectories):
            if path is not None:
                positions[:, microphone] = path.at(times_s)
        return positions

    def microphones_from(self, time_s: float) -> np.ndarray:
        """Return where the microphones are while a sound that is emitted at a time is heard, (k, m, 3) m.

        There is one position for every MOTION_STEP_S; k is 1 where no microphone ever moves.
        """
        if not any(self.trajectories):
            return self.microphones_m[None]
        count = int(np.ceil(self.longest_delay / self.sample_rate_hz / MOTION_STEP_S)) + 2
        return self.microphones_at(time_s + MOTION_STEP_S * np.arange(count))

    def described(self) -> list[str]:
        """Return sentences about the decay of sound here: T60, absorption, number of images, Schroeder frequency."""
        room, absorption = self.room_dimensions_m, 1 - np.asarray(self.reflection) ** 2
        sentences = []
        if self.bands is not None:
            times = ", ".join(f"{time:.2f}" for time in self.bands.rt60_s)
            sentences.append(f"T30 of the octave bands from {BANDS_HZ[0]} Hz: {times} s")
        elif ((absorption > 0) & (absorption < 1)).all():
            seconds = decay.image_rt60(room, absorption, self.speed_of_sound_m_s)
            sentences.append(f"image sources between these walls decay by 60 dB in {seconds:.3f} s (T30)")
        if self.bands is not None and self.bands.scattering is not None:
            sentences.append("what the walls scatter is heard as diffuse noise")
        if self.end_s * self.speed_of_sound_m_s > self.reach_m:
            decay_db = 60 * self.reach_m / (self.rt60_s * self.speed_of_sound_m_s)
            sentences.append(f"images are followed for {decay_db:.0f} dB, then noise decays as they would")
        images = image_count(room, self.reach_m) if (absorption < 1).all() else 1
        sentences.append(
            f"T60 {self.rt60_s:g} s, absorption {np.round(absorption, 4).tolist()}, about {images:.0f} images of a "
            f"microphone, Schroeder frequency {absorptions.schroeder_frequency(room, self.rt60_s):.1f} Hz, "
            f"{self.speed_of_sound_m_s:.1f} m/s"
        )
        return sentences


def surroundings_of(
    config: Config,
    settings: Settings,
    trajectories: Mapping[int, Trajectory] | None = None,
    say: Callable[[str], None] = warnings.warn,
) -> Surroundings:
    """Make the surroundings that a configuration and the settings describe.

    Args:
        config: its room and its microphones.
        settings: what is chosen differently.
        trajectories: channel -> path of a microphone that moves; the others stand where the configuration has them.
        say: called with a sentence where the user should be warned.

    Raises:
        ValueError: a number of the configuration is out of the settings' bounds, a microphone is outside the room, the
            room cannot have the reverberation time (with `strict`), or the sound is followed to too many images or for
            too long.
    """
    room, microphones = config.room, config.microphones
    _refuse_beyond_settings(config)
    positions, paths = _microphones(config, trajectories or {})
    speed = settings.speed_of_sound_m_s or room.speed_of_sound_m_s
    bands = bands_of(room, settings, speed)
    room_has_materials = bands is not None
    if bands is None:
        rt60, absorption = walls_of(room, settings, say)
        if settings.source_directivity == "voice":
            bands = Bands(np.repeat(absorption[:, None], 8, axis=1), np.zeros(8), np.array(BEHIND_DB), np.full(8, rt60))
    else:
        rt60, absorption = float(bands.rt60_s.max()), bands.absorption.min(axis=1)
        _compare_stated(config, float(bands.rt60_s[MIDDLE].mean()), say)
    diagonal_m = float(np.linalg.norm(room.dimensions))
    if room_has_materials and settings.ism_decay_db is None:
        settings = _affordable(settings, room, rt60, speed)
    followed_s = rt60 * (DECAY_HEARD_DB - settings.error_db) / 60
    if settings.ism_decay_db is not None:
        followed_s = min(followed_s, rt60 * settings.ism_decay_db / 60)
    reach_m = max(followed_s * speed, diagonal_m)
    continued = settings.ism_decay_db is not None or (bands is not None and bands.scattering is not None)
    surroundings = Surroundings(
        room_dimensions_m=room.dimensions,
        reflection=(-1 if settings.reflection_sign == "negative" else 1) * np.sqrt(1 - absorption),
        microphones_m=positions,
        sample_rate_hz=settings.sample_rate_hz or microphones.sample_rate_hz,
        reach_m=reach_m,
        speed_of_sound_m_s=speed,
        directivities=microphones.directivities,
        orientations=microphones.orientations,
        source_directivity=DIRECTIVITIES.get(settings.source_directivity, 1.0),
        bands=bands,
        rt60_s=rt60,
        end_s=max(rt60, diagonal_m / speed) if continued and rt60 > 0 else 0.0,
        trajectories=paths,
    )
    images = image_count(room.dimensions, reach_m) if (absorption < 1).all() else 1.0
    _check_cost(images, surroundings, settings, say)
    return surroundings


def _refuse_beyond_settings(config: Config) -> None:
    """Refuse numbers of a configuration that the settings of the same meaning could not have."""
    room, bounds = config.room, settings_of(Settings)
    for key, value, name in (
        ("room_config.reverberation_time_s", room.reverberation_time_s, "rt60_s"),
        ("room_config.speed_of_sound_m_s", room.speed_of_sound_m_s, "speed_of_sound_m_s"),
        ("microphone_config.audio_sample_rate_hz", config.microphones.sample_rate_hz, "sample_rate_hz"),
    ):
        least, most = bounds[name][1].least or 0.0, bounds[name][1].most or math.inf
        if value is not None and not least <= value <= most:
            raise ValueError(f'{config.name}: "{key}" must be from {least:g} to {most:g}, found {shown(value)}')


def _compare_stated(config: Config, found_s: float, say: Callable[[str], None]) -> None:
    """Say where config.json states another reverberation time than its materials have."""
    stated = config.room.reverberation_time_s
    if stated is not None and abs(found_s - stated) > DIFFERENT * found_s:
        say(
            f'{config.name}: "room_config.reverberation_time_s" is {stated:g}, but the materials and contents of the '
            f"room, which are heard, give {found_s:.2f} s from 500 Hz to 2 kHz; --rt60 {stated:g} has the other"
        )


def bands_of(room: Room, settings: Settings, speed_of_sound_m_s: float) -> Bands | None:
    """Return what a room's materials, air and contents do in octave bands; None where its absorption is one number.

    Materials count where they are to be heard (`Room.heard_by_materials`) and the settings state no number.

    Args:
        room: of the configuration.
        settings: of the simulation.
        speed_of_sound_m_s: m/s, from which the temperature of the air follows.
    """
    stated = settings.rt60_s is not None or settings.absorption is not None
    if stated or room.surfaces is None or not room.heard_by_materials:
        return None
    up_to_16_khz = [*range(7), 6]
    absorption = np.clip(room.surfaces.absorption[:, up_to_16_khz], LEAST_ABSORBED, 1 - LEAST_ABSORBED)
    air = air_loss(BANDS_HZ, speed_of_sound_m_s, settings.humidity_percent)
    if room.contents_absorption_m2 is not None:
        air = air + contents_loss(room.dimensions, room.contents_absorption_m2[up_to_16_khz])
    scattering = room.surfaces.scattering[:, up_to_16_khz]
    times = [
        reverberation_time(room.dimensions, of_walls, of_air, speed_of_sound_m_s, scatters)
        for of_walls, of_air, scatters in zip(absorption.T, air, scattering.T, strict=True)
    ]
    behind = np.array(BEHIND_DB) if settings.source_directivity == "voice" else np.zeros(8)
    return Bands(absorption, air, behind, np.array(times), scattering if scattering.any() else None)


def walls_of(room: Room, settings: Settings, say: Callable[[str], None] = warnings.warn) -> tuple[float, np.ndarray]:
    """Return the reverberation time of a room, s, and the absorption of its six walls, (6,) of energy.

    The first that is stated decides: the settings' reverberation time or absorption, the room's absorption, its
    reverberation time; else DEFAULT_RT60_S. A time of 0 is a room without reverberation.

    Args:
        room: of the configuration.
        settings: `rt60_s`, `absorption`, `absorption_model` and `strict` count here.
        say: called with a sentence if the room cannot have the time and is simulated without reverberation.

    Raises:
        ValueError: the room cannot have the time (with `strict`), or its walls absorb nothing.
    """
    rt60 = settings.rt60_s
    stated = room.absorption if settings.absorption is None else settings.absorption
    if rt60 is None and stated is not None:
        absorption = np.asarray(stated, dtype=float)
        rt60 = absorptions.sabine_rt60(room.dimensions, absorption)
        if not math.isfinite(rt60):
            raise ValueError("the walls absorb nothing, so the sound would never end; give an absorption above 0")
        return (rt60 if (absorption < 1).any() else 0.0), absorption
    if rt60 is None:
        rt60 = DEFAULT_RT60_S if room.reverberation_time_s is None else room.reverberation_time_s
    if rt60 == 0:
        return 0.0, np.ones(6)
    speed = settings.speed_of_sound_m_s or room.speed_of_sound_m_s
    try:
        if settings.absorption_model == "image":
            absorption, sentence = decay.wanted_absorption(room.dimensions, rt60, speed)
            if sentence:
                say(sentence)
            return rt60, absorption
        if settings.absorption_model == "sabine":
            return rt60, absorptions.sabine_absorption(room.dimensions, rt60)
        return rt60, absorptions.eyring_absorption(room.dimensions, rt60)
    except ValueError as error:
        if settings.strict:
            raise
        say(f"{error}; simulated without reverberation")
        return 0.0, np.ones(6)


def affordable_decay(
    room_dimensions_m: np.ndarray, rt60_s: float, speed_of_sound_m_s: float, images: int = AFFORDABLE_IMAGES
) -> float:
    """Return how far image sources can be followed with so many of each microphone, whole dB, at most 15."""
    reach_m = np.cbrt(images / image_count(room_dimensions_m, 1.0))
    return float(np.floor(min(15.0, 60 * reach_m / max(rt60_s * speed_of_sound_m_s, reach_m))))


def _affordable(settings: Settings, room: Room, rt60_s: float, speed_of_sound_m_s: float) -> Settings:
    """Return settings with which a room whose materials absorb little is affordable: noise continues its images."""
    followed_m = rt60_s * (DECAY_HEARD_DB - settings.error_db) / 60 * speed_of_sound_m_s
    decay_db = affordable_decay(room.dimensions, rt60_s, speed_of_sound_m_s, AFFORDABLE_IN_BANDS)
    if image_count(room.dimensions, followed_m) <= AFFORDABLE_IN_BANDS or decay_db < 1:
        return settings
    return replace(settings, ism_decay_db=decay_db)


def _check_cost(images: float, surroundings: Surroundings, settings: Settings, say: Callable[[str], None]) -> None:
    """Refuse what takes too much memory, and warn of what takes long.

    Args:
        images: of each microphone.
        surroundings: of the sound.
        settings: of the simulation.
        say: called with the warning.
    """
    what = f"T60 {surroundings.rt60_s:g} s: sound reaches {images:.2g} images of each microphone"
    affordable = affordable_decay(surroundings.room_dimensions_m, surroundings.rt60_s, surroundings.speed_of_sound_m_s)
    remedy = f"use --ism-decay {affordable:g}, which follows the strong images and continues with noise"
    if affordable < 1:
        remedy = "use a shorter reverberation time"
    if images > MOST_IMAGES:
        raise ValueError(f"{what}, about {images * BYTES_AN_IMAGE / 2**30:.1f} GiB; {remedy}")
    samples, microphones = surroundings.longest_delay, len(set(map(tuple, surroundings.microphones_m.tolist())))
    if samples * microphones > MOST_SAMPLES:
        raise ValueError(
            f"{microphones} microphones would hear a sound for {samples / surroundings.sample_rate_hz:.3g} s in this "
            "room, which takes too much memory; use a lower sample rate, a shorter reverberation time or fewer of them"
        )
    seconds = microphones * (COST_S + COST_OF_IMAGE_S * images + COST_OF_SAMPLE_S * samples)
    if seconds > LONG_S or images > MANY_IMAGES:
        if COST_OF_IMAGE_S * images < COST_S + COST_OF_SAMPLE_S * samples:
            remedy = "use fewer microphones, a shorter reverberation time or a lower sample rate"
        places = f"{microphones} microphone{'s' if microphones > 1 else ''}"
        say(f"{what}, {places}: about {seconds:.0f} s of computing for a second of a voice that moves; {remedy}")


def _microphones(
    config: Config, trajectories: Mapping[int, Trajectory]
) -> tuple[np.ndarray, tuple[Trajectory | None, ...]]:
    """Return where the microphones are at first, (m, 3) m, and their paths, () if all stand."""
    fixed = config.microphones.positions
    positions = fixed.copy()
    for channel, path in sorted(trajectories.items()):
        if not 0 <= channel < len(fixed):
            raise ValueError(
                f"microphone {channel + 1} does not exist: {config.name} has {len(fixed)}, numbered from 1"
            )
        positions[channel] = path.positions_m[0]
    for channel in range(len(fixed)):
        visited = trajectories[channel].positions_m if channel in trajectories else fixed[[channel]]
        outside = visited[((visited < 0) | (visited > config.room.dimensions)).any(axis=1)]
        if len(outside):
            source = "the path of a microphone" if channel in trajectories else config.name
            raise ValueError(f"{source}: microphone {channel + 1} at {outside[0].tolist()} is outside the room")
    return positions, tuple(trajectories.get(channel) for channel in range(len(fixed))) if trajectories else ()
