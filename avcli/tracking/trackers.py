"""The trackers: what each must offer, and the table in which each is registered once.

A new tracker is a module with a class that satisfies `Tracker`, and an entry in `TRACKERS`. The option, the manual,
the bench and `fusion.Fusion` read the table.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np

    from avcli.formats.features import Feature
    from avcli.tracking.model import Population, Track
    from avcli.tracking.partial import Partial
    from avcli.tracking.settings import Sensor, Settings
    from avcli.tracking.smoothing import End


class Tracker(Protocol):
    """A filter that takes the records of several sensors in order of time.

    Attributes:
        sensors: the sensors that may report.
        column: sensor name -> its number in `sensors`.
    """

    sensors: list[Sensor]
    column: dict[str, int]

    def add(self, sensor: Sensor) -> None:
        """Let another sensor report from now on."""

    def predict(self, time: float) -> None:
        """Predict all people to a time in s; a time in the past counts as the present."""

    def update(
        self,
        time: float,
        name: str,
        z: np.ndarray,
        noise: np.ndarray,
        score: np.ndarray | None = None,
        features: Mapping[str, Feature] | None = None,
    ) -> None:
        """Update with one record of one sensor.

        Args:
            time: s, not before the last record's.
            name: a sensor that was added.
            z: detections (J, 2) m.
            noise: their covariances (J, 2, 2) m², positive definite.
            score: (J,) probability that each detection is a person (NaN: unknown), or None.
            features: of the detections, by name; None: there are none.
        """

    def tracks(self, time: float) -> list[Track]:
        """Return the people who probably exist at a time (s) not before the last record, by label."""


@runtime_checkable
class Smoothable(Protocol):
    """A tracker that keeps the history of its densities, so that `smoothing.Delayed` can smooth it."""

    column: dict[str, int]

    def predict(self, time: float) -> None:
        """Predict all people to a time in s."""

    def ends(self) -> Iterator[End]:
        """Yield the latest end of each person's history."""

    def forget(self, time: float) -> None:
        """Drop all history before a time in s."""


class Partly(Protocol):
    """A tracker that takes detections of which some show a direction or a distance alone (`Entry.partial`)."""

    def update(
        self,
        time: float,
        name: str,
        z: np.ndarray,
        noise: np.ndarray,
        score: np.ndarray | None = None,
        features: Mapping[str, Feature] | None = None,
        shown: Partial | None = None,
    ) -> None:
        """Update with one record of one sensor, as `Tracker.update`; shown: what its detections show."""


@runtime_checkable
class Explainable(Protocol):
    """A tracker that can say what each record meant to it."""

    def accounts(self) -> list[dict[str, Any]]:
        """Return one account of each record since the last call, as explain.schema.json describes it."""


@runtime_checkable
class Learning(Protocol):
    """A tracker that learns from its records, and can hand on what it has learnt."""

    def state(self) -> dict[str, Any]:
        """Return what was learnt: numbers, and lists and dictionaries of them."""

    def news(self) -> list[str]:
        """Return sentences for the user, since the last call: what takes somebody away, and input that is not used."""

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what another run in the same room has learnt, before the first record.

        Raises:
            ValueError: it was learnt in a room of another size.
        """


@dataclass(frozen=True)
class Entry:
    """One registered tracker.

    Attributes:
        text: a few words for --help.
        make: function of (settings, population, record, explain); record: keep what smoothing needs; explain: keep
            accounts.
        unused: parameters of avfuse that have no effect with this tracker.
        partial: whether its `update` takes what detections show that have no position, see `partial.Partial`.
    """

    text: str
    make: Callable[[Settings, Population, bool, bool], Tracker]
    unused: frozenset[str] = frozenset()
    partial: bool = False


def _ms_glmb(settings: Settings, population: Population, record: bool, explain: bool) -> Tracker:
    from avcli.tracking.glmb import GLMB

    return GLMB(settings, population, record=record, explain=explain)


def _lmb(settings: Settings, population: Population, record: bool, explain: bool) -> Tracker:
    from avcli.tracking.glmb import GLMB

    return GLMB(settings, population, factorise=True, record=record, explain=explain)


def _gnn(settings: Settings, population: Population, record: bool, explain: bool) -> Tracker:
    from avcli.tracking.gnn import GNN

    return GNN(population)


def _jpda(settings: Settings, population: Population, record: bool, explain: bool) -> Tracker:
    from avcli.tracking.jpda import JPDA

    return JPDA(population)


_NO_HYPOTHESES = frozenset({"lag", "explain", "birth", "stay", "doors", "learn", "no_learn", "map", "show"})

TRACKERS = {
    "ms-glmb": Entry("joint hypotheses", _ms_glmb, partial=True),
    "lmb": Entry("marginals of them", _lmb, partial=True),
    "gnn": Entry("the best assignment", _gnn, _NO_HYPOTHESES | {"hidden", "detection", "clutter"}),
    "jpda": Entry("Stone Soup's", _jpda, _NO_HYPOTHESES | {"motion", "process_noise"}),
}
"""Tracker name -> entry; the first is the default."""


def with_trackers(page: str) -> str:
    """Return avfuse(1) with the names of the trackers, and "Not with" at each option, as `TRACKERS` has them."""
    before, options, rest = page.partition(".Sh OPTIONS")
    entries = re.split(r"^(?=\.It Fl )", rest, flags=re.MULTILINE)
    return before + options + "".join(map(_with_trackers, entries))


def _with_trackers(entry: str) -> str:
    option = re.match(r"\.It Fl -([a-z-]+)", entry)
    if option is None or option[1] == "process-noise":  # that --motion cv alone uses
        return entry
    if option[1] == "tracker":
        return re.sub(r"^.*\n", f".It Fl -tracker Cm {' | '.join(TRACKERS)}\n", entry)
    names = [name for name, one in TRACKERS.items() if option[1].replace("-", "_") in one.unused]
    entry = re.sub(r"^Not with\n.*\n", "", entry, flags=re.MULTILINE)
    text, end, after = entry.partition(".El\n")
    if names:
        text += "Not with\n.Cm " + " No and Cm ".join(filter(None, (" , ".join(names[:-1]), names[-1]))) + " .\n"
    return text + end + after
