"""What a metric is: its fields, how one sequence is scored, how several sequences are combined.

Tables, the schema of metrics records, the manual and the report's legend all read the fields. `avcli.metrics.registry`
lists the metrics.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, Literal, TypeVar

from avcli.metrics.matching import Matches, match
from avcli.metrics.sequence import Sequence as Frames
from avcli.metrics.settings import Settings

Scores = dict[str, Any]
"""Scores by the names of a metric's fields."""


@dataclass(frozen=True)
class Field:
    """One number of a metric.

    Attributes:
        name: its key in the record.
        text: what it is, a phrase for the legend, the manual and the schema.
        unit: "%" for a fraction, which tables show in percent; "count" for a whole number; "m", "s" or any other
            unit; empty for a number without a unit.
        better: "up" or "down": which values are better; empty where neither is.
        summary: it belongs to the record's summary (a curve by its mean).
        column: its heading in a terminal's table, at most 6 characters; empty: tables leave it out.
        kind: a number; a curve, one number for each threshold alpha; a vector, one number for each axis; or a word.
        optional: it is null where it has no meaning.
    """

    name: str
    text: str
    unit: str = ""
    better: Literal["up", "down", ""] = ""
    summary: bool = False
    column: str = ""
    kind: Literal["number", "curve", "vector", "word"] = "number"
    optional: bool = False


@dataclass(frozen=True, eq=False)
class Case:
    """One sequence to score, with what several metrics need of it.

    Attributes:
        sequence: ground truth and tracks.
        settings: d0, and cutoff, order and window of the OSPA family.
    """

    sequence: Frames
    settings: Settings = field(default_factory=Settings)

    @cached_property
    def matches(self) -> Matches:
        """The pairs that CLEAR and the errors of position compare."""
        return match(self.sequence, self.settings.d0)


C = TypeVar("C")


@dataclass(frozen=True)
class Metric(Generic[C]):
    """A metric: a section of the metrics record.

    Attributes:
        name: of the section.
        text: what the section holds, a sentence for the manual and the schema.
        fields: all keys that `score` and `combine` return, the most important first.
        score: scores one sequence.
        combine: scores several sequences together from their scores and, where these do not suffice (a median, say),
            from the sequences themselves; both lists have one entry for each sequence.
    """

    name: str
    text: str
    fields: tuple[Field, ...]
    score: Callable[[C], Scores]
    combine: Callable[[Sequence[Scores], Sequence[C]], Scores]
