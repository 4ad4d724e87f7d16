"""Numbers of the detector that were fitted to renders of random scenes (`make fit-detection` writes fitted.json)."""

import json
from dataclasses import dataclass
from importlib import resources

import numpy as np


@dataclass(frozen=True)
class AxisLaw:
    """How far a position from depth is off: standard deviations, m.

    Attributes:
        radial_m: of a body that is seen whole, along the line of sight.
        tangential_m: across it.
        hidden_m: added in both directions, times the fraction of the body that is hidden.
    """

    radial_m: float
    tangential_m: float
    hidden_m: float


@dataclass(frozen=True)
class BoxLaw:
    """How far a box and a position by a box alone are off.

    Attributes:
        side: standard deviation of a side of a box, as a share of the box's size.
        part: standard deviation of the point of a head, as a share of that of a side; those of torso and foot are
            multiples of it, see avcli.detection.monocular.PART_SPREADS.
        spread: factor on the covariance of the fit, since people sit, bend and stretch out their arms.
        floor_m: standard deviation, m, that is added in both directions.
        across: factor on the standard deviation of the position across the line of sight, where a network gives points.
        part_unsure: where a network gives points with a score of s, their standard deviations grow by this
            times sqrt(1 - s);
        sure, unsure: and that of the position is multiplied by `sure` + `unsure` sqrt(1 - s). These three were chosen
            on 786 detections in 270 random scenes with panels, boxes and people that hide others (seeds 750000 and
            755000), where they gain 0.16 and 0.11 nats a person, with standard errors of 0.07 and 0.05.
        short, short_spread: where a network gives points, the share of a box's size by which it overlooks the legs, on
            average over people, and its standard deviation. Chosen on 1026 boxes of real people in eleven films, where
            they gain 0.26 nats a person, and 302 of drawn ones, which lose 0.11 (see examples/benchmarks/detection.md).

    The command fits `across` alone: the numbers of the fit itself also weigh kinds of bodies and hidden feet.
    """

    side: float
    part: float
    spread: float
    floor_m: float
    across: float
    part_unsure: float
    sure: float
    unsure: float
    short: float
    short_spread: float


@dataclass(frozen=True)
class ScoreLaw:
    """How probable it is that something before the empty room is a person.

    Attributes:
        surface_m2: surface of a body that must be seen, m², for a probability of one half.
    """

    surface_m2: float


@dataclass(frozen=True)
class FaintLaw:
    """How probable it is that a body before the empty room is a person of whom the network by itself is not sure.

    Attributes:
        always: logarithm of the odds where the network says one half.
        network: of the network's own log odds, this part is added.
        stale: is taken away where another body stands of which the network says nothing: then things have come into
            the room since it was recorded empty.
    """

    always: float
    network: float
    stale: float

    def probability(self, scores: np.ndarray, others: np.ndarray, motion: np.ndarray | float = 0.0) -> np.ndarray:
        """Probabilities (n,), by the network's scores (n,), 0 where it says nothing, whether (n,) others stand, and
        what their motion tells, (n,) nats.
        """
        known = np.clip(scores, 0.01, 0.99)
        odds = self.always + self.network * np.log(known / (1 - known)) - self.stale * others + motion
        return np.asarray(1 / (1 + np.exp(-odds)))


FITTED = json.loads((resources.files("avcli.detection") / "fitted.json").read_text())
AXIS, BOX = AxisLaw(**FITTED["axis"]), BoxLaw(**FITTED["box"])
SCORE, FAINT = ScoreLaw(**FITTED["score"]), FaintLaw(**FITTED["faint"])
