"""Settings of the film that is drawn, and the names of the built-in scenarios. Light: no numpy."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

from avcli.settings import setting

SCENARIOS = Path(__file__).parent / "scenarios"
BUILT_IN = tuple(sorted(path.stem for path in SCENARIOS.glob("*.json")))
"""Names of the built-in scenarios: each is a file of `SCENARIOS`."""

LENSES = ("real", "thesis", "equidistant", "equisolid")
ROOM_KINDS = ("office", "meeting", "corridor", "hall", "workshop", "living")
"""The lenses and the kinds of rooms that a random world may have."""

DEPTH_STEPS_M = {"8": 0.02, "16": 1e-4}
"""The finest step of a depth picture by its bits, m: it holds 5.08 m, all that the thesis's camera sees, or 6.55 m."""


@dataclasses.dataclass(frozen=True)
class Drawing:
    """How frames are drawn."""

    samples: int = setting(
        4, "Colour samples per pixel at the outlines of people; 1 draws hard edges, faster.", unit="N", least=1, most=64
    )
    depth_bits: str = setting(
        "16",
        "Bits of a depth pixel: 16 in steps of 0.1 mm, 8 in steps of 20 mm; longer steps where the room is larger.",
        choices=tuple(DEPTH_STEPS_M),
    )
    pictures: str = setting(
        "both", "Draw and write colour and depth, or one alone, which is quicker.", choices=("both", "rgb", "depth")
    )
    still_px: float = setting(
        0.25,
        "People keep their pose in the pictures until a part of them has moved by more than this; 0 draws every pose.",
        unit="PX",
        least=0.0,
        flag="--still",
    )
    shutter_s: float = setting(0.0, "Exposure time, s: motion blur.", unit="S", least=0.0, flag="--shutter")

    def depth_step_m(self, farthest: float) -> float:
        """Metres of one step of a depth picture: the finest one times 1, 2, 5, 10... that holds the farthest distance.

        Args:
            farthest: m. It is less than the largest number of steps, which stands for "nothing measured".
        """
        finest, most = DEPTH_STEPS_M[self.depth_bits], 2 ** int(self.depth_bits) - 2
        steps = (factor * 10**power * finest for power in itertools.count() for factor in (1, 2, 5))
        return next(step for step in steps if farthest <= most * step)


@dataclasses.dataclass(frozen=True)
class Effects:
    """What a real sensor does to a perfect picture; the defaults change nothing."""

    exposure_ev: float = setting(
        0.0, "Make frames brighter (or darker, negative), in stops.", unit="EV", flag="--exposure"
    )
    white_balance: float = setting(
        0.0, "Balance white automatically, red against blue by at most so many stops.", unit="EV", least=0.0, most=4.0
    )
    vignetting: float = setting(
        0.0, "Fraction of the light that is lost in the farthest corner.", unit="F", least=0.0, most=1.0
    )
    aberration_px: float = setting(
        0.0, "Shift of red and blue against green in the farthest corner, px.", unit="PX", flag="--aberration"
    )
    full_well_e: float = setting(
        0.0, "Electrons that a white pixel holds, for shot noise; 0 for none.", unit="N", least=0.0, flag="--full-well"
    )
    read_noise: float = setting(0.0, "Standard deviation of the read noise, in 1/255 of white.", unit="S", least=0.0)
    blur_px: float = setting(
        0.0, "Standard deviation of the blur of lens and sensor, px.", unit="PX", least=0.0, most=50.0, flag="--blur"
    )
    sharpening: float = setting(
        0.0, "Strength of the camera's sharpening; 1 doubles the finest contrast.", unit="F", least=0.0, most=10.0
    )
    time_stamp: bool = setting(False, "Write date and time into the frames, as cameras do.")
    jpeg_quality: int | None = setting(
        None, "Compress frames as JPEG of this quality would.", unit="Q", least=1, most=100, flag="--jpeg"
    )

    @property
    def differ_by_frame(self) -> bool:
        """Whether two frames of the same drawn picture differ: by noise or time stamp."""
        return bool(self.full_well_e or self.read_noise or self.time_stamp)


SENSORS: dict[str, dict[str, Any]] = {
    "clean": {},
    "webcam": {
        "shutter_s": 0.01, "exposure_ev": 0.15, "white_balance": 0.7, "vignetting": 0.25, "aberration_px": 1.0,
        "full_well_e": 5000.0, "read_noise": 1.2, "blur_px": 0.8, "sharpening": 1.2, "jpeg_quality": 80,
    },
    "ip-camera": {
        "shutter_s": 0.005, "white_balance": 0.7, "vignetting": 0.15, "aberration_px": 0.5, "full_well_e": 8000.0,
        "read_noise": 1.0, "blur_px": 0.6, "sharpening": 0.7, "time_stamp": True, "jpeg_quality": 70,
    },
}  # fmt: skip
"""Sensors by name: the effects that differ from a perfect one's, and the shutter. A webcam is a small sensor in room
light whose pictures come as good JPEGs; an IP camera is better, and compresses more. Both balance white. They were
chosen on a part of real pictures that is not the one on which they were judged: tests/bench/bench_sensor.py."""


def with_sensor(name: str, drawing: Drawing, effects: Effects) -> tuple[Drawing, Effects]:
    """Add a sensor of `SENSORS` to settings: what is not the default in them is kept."""
    wanted = SENSORS[name]

    def filled(settings: Any, kind: type) -> Any:
        usual = kind()
        names = [field.name for field in dataclasses.fields(kind) if field.name in wanted]
        free = [name for name in names if getattr(settings, name) == getattr(usual, name)]
        return dataclasses.replace(settings, **{name: wanted[name] for name in free})

    return filled(drawing, Drawing), filled(effects, Effects)
