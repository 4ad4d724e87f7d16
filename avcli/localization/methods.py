"""The door to localization: from a config.json and sound to detections."""

import numpy as np

from avcli.formats.experiment import Config
from avcli.formats.media import Sound
from avcli.formats.records import Detections
from avcli.localization.array import Array
from avcli.localization.settings import METHODS, ClosedFormSettings, SteeredSettings
from avcli.localization.ssl3d import ClosedFormLocalizer
from avcli.localization.steered import SteeredLocalizer
from avcli.localization.stream import Recording

Localizer = SteeredLocalizer | ClosedFormLocalizer
Settings = SteeredSettings | ClosedFormSettings


def localizer(
    config: Config,
    method: str = "srp",
    *,
    seed: int = 0,
    settings: Settings | None = None,
    temperature_c: float | None = None,
) -> Localizer:
    """Make the localizer of a config.json; its `localize` takes a stream block by block.

    Args:
        config: states the microphones and the room.
        method: "srp", steered response power: live, several talkers. "3d-ssl", the thesis's closed form: on whole
            recordings, one talker at a time.
        seed: of the noise from which the detection threshold of "srp" is set.
        settings: SteeredSettings for "srp", ClosedFormSettings for "3d-ssl"; the defaults where None.
        temperature_c: of the air in °C, which sets the speed of sound; None: the config's speed.

    Raises:
        ValueError: the method is unknown, the settings are another method's, a key of the config is missing or wrong,
            or no position can be computed from the microphones.
    """
    if method not in METHODS:
        raise ValueError(f'the method must be one of {", ".join(METHODS)}, not "{method}"')
    settings = METHODS[method]() if settings is None else settings
    array = Array.of(config, temperature_c)
    if method == "srp" and isinstance(settings, SteeredSettings):
        return SteeredLocalizer(array, settings, np.random.default_rng(seed))
    if method == "3d-ssl" and isinstance(settings, ClosedFormSettings):
        return ClosedFormLocalizer(array, settings, config.room.reverberation_time_s)
    raise ValueError(f"{type(settings).__name__} are not the settings of {method}")


def localize(
    config: Config, sound: Sound, *, method: str = "srp", seed: int = 0, settings: Settings | None = None
) -> list[Detections]:
    """Find who speaks where in a recording, for every time step.

    Args:
        config: states the microphones and the room.
        sound: what the microphones heard, a channel for each; its first sample is time 0.
        method, seed, settings: as for `localizer`.

    Returns:
        The detections of the sensor "audio" for each time k / rate of the scene: mouths at the time at which the sound
        left them. A time step in which nobody speaks has none. Where "srp" hears a clear pitch, the feature "voice"
        describes the talker's voice (see avcli.localization.voice).

    Raises:
        ValueError: as for `localizer`, or the sound does not fit the microphones.

    Example:
        >>> import numpy as np
        >>> from avcli.formats.experiment import Config
        >>> from avcli.formats.media import Sound
        >>> from avcli.localization import localize
        >>> corners = [[x, y, z] for x, y, z in ((0, 0, 2.5), (4, 0, 2.5), (0, 5, 2.5), (4, 5, 2.5), (2, 2, 2.4))]
        >>> config = Config({"microphone_config": {"audio_sample_rate_hz": 16000, "mic_positions_m": corners},
        ...                  "room_config": {"room_dimensions_m": [4.0, 5.0, 3.0]}})
        >>> noise, mouth = np.random.default_rng(0).standard_normal(16000), np.array([1.5, 3.0, 1.6])
        >>> frequency = np.fft.rfftfreq(16000, 1 / 16000)
        >>> distance = np.linalg.norm(np.array(corners) - mouth, axis=1)
        >>> turns = np.exp(-2j * np.pi * frequency[:, None] * distance / 343)
        >>> heard = np.fft.irfft(np.fft.rfft(noise)[:, None] * turns / distance, axis=0)
        >>> found = localize(config, Sound(heard, 16000))
        >>> found[5].timestamp, found[5].positions.round(2).tolist()
        (0.5, [[1.5, 3.0, 1.6]])
    """
    recording = Recording(config.microphones)
    count, rate = len(sound.samples), sound.sample_rate_hz
    blocks = recording.piece(
        "the sound", [(sound.samples, rate)], start_sample=0, num_samples=count, tail_samples=sound.tail_samples
    )
    chosen = localizer(config, method, seed=seed, settings=settings)
    return [decision.detections() for decision in chosen.localize(blocks)]
