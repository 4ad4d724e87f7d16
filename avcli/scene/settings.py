"""Settings of the film that is drawn, and the names of the built-in scenarios. Light: no numpy."""

import dataclasses
from pathlib import Path

from avcli.settings import setting

SCENARIOS = Path(__file__).parent / "scenarios"
BUILT_IN = tuple(sorted(path.stem for path in SCENARIOS.glob("*.json")))
"""Names of the built-in scenarios: each is a file of `SCENARIOS`."""

DEPTH_STEPS_M = {"8": 0.02, "16": 1e-4}
"""Metres of one step of a depth picture by its bits; 8 bits hold 5.1 m, all that the thesis's camera can see."""


@dataclasses.dataclass(frozen=True)
class Drawing:
    """How frames are drawn."""

    samples: int = setting(
        4, "Colour samples per pixel at the outlines of people; 1 draws hard edges, faster.", unit="N", least=1, most=64
    )
    depth_bits: str = setting(
        "16", "Bits of a depth pixel: 16 in steps of 0.1 mm, 8 in steps of 20 mm.", choices=tuple(DEPTH_STEPS_M)
    )
    shutter_s: float = setting(0.0, "Exposure time, s: motion blur.", unit="S", least=0.0, flag="--shutter")

    @property
    def depth_step_m(self) -> float:
        """Metres of one step of a depth picture."""
        return DEPTH_STEPS_M[self.depth_bits]


@dataclasses.dataclass(frozen=True)
class Effects:
    """What a real sensor does to a perfect picture; the defaults change nothing."""

    exposure_ev: float = setting(
        0.0, "Make frames brighter (or darker, negative), in stops.", unit="EV", flag="--exposure"
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
    jpeg_quality: int | None = setting(
        None, "Compress frames as JPEG of this quality would.", unit="Q", least=1, most=100, flag="--jpeg"
    )
