"""What a user may set of the scoring. It imports no numpy, so that `--help` stays fast."""

from dataclasses import dataclass

from avcli.settings import check, setting


@dataclass(frozen=True)
class MotSettings:
    """How MOTChallenge files are read."""

    rate: float = setting(10.0, "Frame rate of MOTChallenge input files (.txt or .csv).", unit="HZ", above=0.0)


@dataclass(frozen=True)
class Settings:
    """How tracks and detections are compared with ground truth."""

    dims: int = setting(2, "2 compares x and y, 3 also the height z (ground truth lies on the floor).", choices=(2, 3))
    d0: float = setting(
        2.0,
        "Distance in m at which the similarity 1 - d/d0 reaches zero; CLEAR and Identity match within half of it.",
        unit="M",
        above=0.0,
        most=1e9,
    )
    tolerance: float = setting(0.001, "Records match if their times differ by at most this, in s.", unit="S", least=0.0)
    speaking: bool = setting(False, "Score people only while they speak; tracks of silent people are ignored.")
    cutoff: float | None = setting(
        None,
        "Distance in m that a missed or false point costs in OSPA and GOSPA.",
        unit="M",
        above=0.0,
        most=1e9,
        default_text="half of --d0",
    )
    order: float = setting(
        1.0, "Order of OSPA and GOSPA; above 1, large errors weigh more.", unit="P", least=1.0, most=16.0
    )
    window: int = setting(
        10, "Length in frames of the window over which OSPA2 compares tracks.", unit="FRAMES", least=1
    )

    def __post_init__(self) -> None:
        check(self)

    @property
    def cutoff_m(self) -> float:
        """The cutoff of the OSPA family, m: by default half of d0, within which CLEAR and Identity match."""
        return self.d0 / 2 if self.cutoff is None else self.cutoff
