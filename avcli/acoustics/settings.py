"""The settings of the simulated sound of a room. This module imports the standard library alone, for --help."""

from dataclasses import dataclass

from avcli.settings import DEFAULT_RT60_S, check, setting

PATTERNS = ("omni", "subcardioid", "cardioid", "hypercardioid", "bidirectional", "voice")
MODELS = ("image", "sabine", "eyring")


@dataclass(frozen=True)
class Settings:
    """How the sound of a room is simulated; None means that the configuration or its default decides.

    Attributes:
        absorption: (6,) energy that the walls x0 x1 y0 y1 z0 z1 absorb, from 0 to 1, instead of a reverberation time.
        sensor_noise_db: white noise of each microphone, dB below a voice of `level_db` at 1 m; None: without.
        room_noise_db: diffuse pink noise, dB SPL; None: without.
    The other attributes say what they are themselves.

    Raises:
        ValueError: a value is out of its bounds.
    """

    level_db: float = setting(60.0, "Level of a voice, dB SPL at 1 m.", unit="DB", least=-20, most=140, flag="--level")
    pause_s: float = setting(
        0.15, "Pause between two repetitions of a recording, s.", unit="S", least=0, flag="--pause"
    )
    mouth_height_m: float = setting(
        1.6,
        "Height of a mouth above the floor, m, where the ground truth has no mouth_position.",
        unit="M",
        above=0,
        flag="--mouth-height",
    )
    source_directivity: str = setting(
        "omni",
        "Directivity of a talking head, which faces the direction of walking; voice: of a human one, by octave bands.",
        choices=PATTERNS,
    )
    rt60_s: float | None = setting(
        None,
        "Reverberation time, s; 0 simulates the direct path alone.",
        unit="S",
        least=0,
        most=1000,
        flag="--rt60",
        default_text=f"the config's, else {DEFAULT_RT60_S:g}",
    )
    absorption_model: str = setting(
        "image",
        "How the absorption of the walls follows from the reverberation time. image: the simulated sound decays in "
        "that time (T30). sabine, eyring: by the equation of this name.",
        choices=MODELS,
    )
    strict: bool = setting(False, "Fail if the room cannot have the reverberation time, instead of a warning.")
    reflection_sign: str = setting(
        "negative",
        "Whether a wall inverts the pressure; positive lets low frequencies build up.",
        choices=("negative", "positive"),
    )
    speed_of_sound_m_s: float | None = setting(
        None,
        "Speed of sound, m/s.",
        unit="M/S",
        least=100,
        most=10000,
        flag="--speed-of-sound",
        default_text="the config's, else 343",
    )
    humidity_percent: float = setting(
        50.0,
        "Relative humidity of the air, %, which absorbs sound where the room's surfaces have materials.",
        unit="PERCENT",
        least=0,
        most=100,
        flag="--humidity",
    )
    error_db: float = setting(
        -40.0,
        "Largest permitted error relative to the sound, dB; a smaller one takes longer.",
        unit="DB",
        least=-100,
        most=-10,
    )
    ism_decay_db: float | None = setting(
        None,
        "Follow image sources until the sound has decayed by DB, and continue with noise; for very long reverberation.",
        unit="DB",
        least=1,
        most=60,
        flag="--ism-decay",
        default_text="image sources throughout",
    )
    switch_s: float | None = setting(
        None,
        "For comparison, do as gpuRIR: hold the response of a position for S seconds, then switch, with new noise for "
        "--ism-decay each time.",
        unit="S",
        least=0.001,
        flag="--switch",
        default_text="interpolate",
    )
    sample_rate_hz: int | None = setting(
        None, "Sample rate, Hz.", unit="HZ", least=4000, most=384000, flag="--sample-rate", default_text="the config's"
    )
    absorption: tuple[float, ...] | None = None
    sensor_noise_db: float | None = None
    room_noise_db: float | None = None

    def __post_init__(self) -> None:
        check(self)
        if self.absorption is not None and (
            len(self.absorption) != 6 or not all(0 <= value <= 1 for value in self.absorption)
        ):
            raise ValueError(f"absorption must be six numbers from 0 to 1, not {self.absorption}")
