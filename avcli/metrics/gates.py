"""Gates: least scores that a result must reach."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from avcli.metrics.registry import summary_fields


@dataclass(frozen=True)
class Gate:
    """The least value of a fraction of the summary.

    Attributes:
        tracker: its name; None for every tracker.
        name: of the summary's field.
        percent: least value.
    """

    tracker: str | None
    name: str
    percent: float


def parse_gate(text: str) -> Gate:
    """Read a gate from "[TRACKER:]NAME=PERCENT".

    Raises:
        ValueError: the text has another form, or NAME is not a fraction of the summary.
    """
    names = [field.name for field in summary_fields() if field.unit == "%"]
    found = re.fullmatch(r"(?:(.+):)?(\w+)=(-?\d+(?:\.\d+)?)%?", text)
    if not found or found[2] not in names:
        raise ValueError(f"{text} must be [TRACKER:]NAME=PERCENT, where NAME is one of {', '.join(names)}")
    return Gate(found[1], found[2], float(found[3]))


def missed_gates(gates: Sequence[Gate], records: Sequence[dict]) -> list[str]:
    """Return a phrase for each gate and tracker whose combined score is too low, or that has no tracks."""
    combined = [record for record in records if record["sequence"] == "combined" and "tracker" in record]
    missed = []
    for gate in gates:
        concerned = [record for record in combined if gate.tracker in (None, record["tracker"])]
        if not concerned:
            missed.append(f"there are no tracks of {gate.tracker}")
        for record in concerned:
            percent = 100 * record["summary"][gate.name]
            if percent < gate.percent:
                missed.append(f"{record['tracker']}: {gate.name} is {percent:.2f}, below {gate.percent:g}")
    return missed
