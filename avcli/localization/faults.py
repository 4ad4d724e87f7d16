"""What may be wrong with a channel, as it is told to people and written into records."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Fault:
    """What is wrong with a channel.

    Attributes:
        channel: from 1, as in the recording.
        kind: "dead", "late", "polarity", "swapped", "level" or "unexplained".
        delay_s: by which it is late.
        microphone: from 1, whose sound it carries.
        level_db: over the median channel.
        corrected: whether it does no harm any more; a channel whose fault is not corrected is left out.
    """

    channel: int
    kind: str
    delay_s: float | None = None
    microphone: int | None = None
    level_db: float | None = None
    corrected: bool = True

    def __str__(self) -> str:
        if self.delay_s is not None:
            way = "late" if self.delay_s > 0.0 else "early"
            return f"channel {self.channel} is {1000.0 * abs(self.delay_s):.2f} ms {way}; this is corrected"
        if self.microphone is not None:
            if not self.corrected:
                return (
                    f"channel {self.channel} does not fit together with the others, and perhaps carries the sound of "
                    f"microphone {self.microphone}; it is left out"
                )
            return f"channel {self.channel} carries the sound of microphone {self.microphone}; this is corrected"
        if self.level_db is not None:
            way = "louder" if self.level_db > 0.0 else "quieter"
            return f"channel {self.channel} is {abs(self.level_db):.0f} dB {way} than the others; this does no harm"
        if self.kind == "dead":
            return f"channel {self.channel} is dead and left out"
        if self.corrected:
            return f"channel {self.channel} has the wrong polarity; this is corrected"
        return f"channel {self.channel} does not agree with the others and is left out"

    def record(self) -> dict[str, Any]:
        """Return it as an entry of a record's "channel_faults"."""
        sizes = {"delay_s": self.delay_s, "microphone": self.microphone, "level_db": self.level_db}
        told = {name: value for name, value in sizes.items() if value is not None}
        return {"channel": self.channel, "fault": self.kind, **told, "corrected": self.corrected}
