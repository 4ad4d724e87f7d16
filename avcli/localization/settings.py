"""Settings of the localizers. This module imports the standard library alone, for `--help`."""

from dataclasses import dataclass

from avcli.settings import setting


@dataclass(frozen=True)
class SteeredSettings:
    """How the steered response is taken; the defaults gave the best results in `make bench-localization`.

    Attributes:
        rate: decisions per second, Hz.
        window: s, the length of one Hann window.
        beta: exponent of the phase transform, from 0 to 1.
        separation: m, the least distance in x and y between two talkers.
        occupancy: least share of the band's bins within 40 dB of the strongest; a tone has less.
        candidate: probability that noise alone makes a further peak worth remembering; it is reported if it lasts.
    """

    rate: float = 10.0
    window: float = 0.186
    beta: float = 1.0
    context: float = setting(
        0.1,
        "Use the windows up to this many seconds before and after a decision's own window too; 0 uses one window.",
        unit="S",
        least=0.0,
        most=2.0,
        only="srp",
    )
    band: tuple[float, float] = setting(
        (80.0, 8000.0), "Lowest and highest frequency that is used, in Hz.", unit="LOW HIGH", least=0.0, only="srp"
    )
    tilt: float = setting(
        0.25, "Weight of a frequency f: f to the power -P.", unit="P", least=0.0, most=2.0, only="srp"
    )
    heights: tuple[float, float] = setting(
        (0.8, 2.0), "Lowest and highest mouth, in m above the floor.", unit="LOW HIGH", least=0.0, only="srp"
    )
    cell: float = setting(0.25, "Edge of the search's first, coarsest cells, in m.", unit="M", least=0.02, only="srp")
    resolution: float = setting(
        0.02, "Edge of the search's last, finest cells, in m; a fit refines it.", unit="M", least=0.001, only="srp"
    )
    keep: int = setting(
        24, "Number of cells that each level passes to the next, finer one.", unit="N", least=1, only="srp"
    )
    max_speakers: int = setting(2, "Largest number of talkers at one time.", unit="N", least=1, only="srp")
    lookahead: float = setting(
        0.3,
        "Judge each moment by what is heard up to this many seconds later, too; 0: at once.",
        unit="S",
        least=0.0,
        most=2.0,
        only="srp",
    )
    max_speed: float = setting(1.6, "Largest walking speed, in m/s.", unit="M/S", least=0.0, only="srp")
    false_alarm: float = setting(
        0.01,
        "Share of decisions that may report a talker in noise alone; it sets the threshold.",
        unit="P",
        above=0.0,
        below=1.0,
        only="srp",
    )
    min_score: float = setting(
        0.5,
        "Least probability that a talker is right; less probable talkers are not reported.",
        unit="P",
        least=0.0,
        most=1.0,
        only="srp",
    )
    separation: float = 0.5
    occupancy: float = 0.03
    candidate: float = 0.5


@dataclass(frozen=True)
class ClosedFormSettings:
    """The parameters of 3D-SSL; the defaults are the thesis's (Table 5.2), or stand in for what it leaves open.

    Attributes:
        rate: time steps per second to which the events are gathered, Hz.
        window: s, the length of the Hann windows of energy and correlation.
        beta: exponent of the phase transform, from 0 to 1.
    """

    rate: float = 10.0
    window: float = 0.042
    beta: float = 0.7
    high_pass: float = setting(
        200.0, "Cutoff of the high-pass filter, in Hz; 0: no filter.", unit="HZ", least=0.0, only="3d-ssl"
    )
    threshold: float = setting(
        0.01,
        "Least short-time energy of an event, as a share of the recording's largest.",
        unit="SHARE",
        least=0.0,
        most=1.0,
        only="3d-ssl",
    )
    min_gap: float | None = setting(
        None,
        "Least time between two events, in s.",
        unit="S",
        least=0.0,
        default_text="T60 times the window length in s",
        only="3d-ssl",
    )
    combination: int = setting(
        4,
        "Number of delays in each closed form; every choice of N delays is solved.",
        unit="N",
        least=4,
        most=32,
        only="3d-ssl",
    )
    max_condition: float = setting(
        300.0, "Largest condition number of a closed form that counts as stable.", unit="N", least=1.0, only="3d-ssl"
    )
    refine: bool = setting(
        False,
        "Fit each event's delays by robust maximum likelihood instead of averaging the closed forms.",
        only="3d-ssl",
    )


@dataclass(frozen=True)
class CommonSettings:
    """What both methods have, with a default of each method's own where it is None."""

    rate: float = setting(
        10.0, "Decisions per second, in Hz: one record for each time k / rate.", unit="HZ", least=0.1, most=1000.0
    )
    window: float | None = setting(
        None,
        "Length of the Hann window, in s.",
        unit="S",
        least=0.005,
        most=5.0,
        default_text=f"{SteeredSettings.window} for srp, {ClosedFormSettings.window} for 3d-ssl",
    )
    beta: float | None = setting(
        None,
        "How far spectra are whitened, from 0 (not at all) to 1 (phases alone).",
        unit="B",
        least=0.0,
        most=1.0,
        default_text=f"{SteeredSettings.beta:g} for srp, {ClosedFormSettings.beta} for 3d-ssl",
    )


METHODS = {"srp": SteeredSettings, "3d-ssl": ClosedFormSettings}
"""The methods by the names that --method takes, with the settings of each."""
