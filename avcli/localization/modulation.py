"""How the level of what sounds at a place changes: a voice rises and falls with each syllable, and a machine does not.

Each band of frequencies is followed by itself, and the median of their changes counts: somebody who speaks beside a
machine is louder than it in some of them only. A change of one band is that of few bins, that of ten is certain after a
few tenths of a second.
"""

from dataclasses import dataclass

import numpy as np

from avcli.localization.windows import Band

LOWEST, HIGHEST, BANDS = 150.0, 7000.0, 10
"""Hz, and in how many bands, alike on a logarithmic scale, levels are taken."""
APART_S = 0.1
"""s between two levels that are compared."""
CHANGE_DB, MOST, UNKNOWN = 4.0, 2.5, 1.0
"""dB: where levels change by less, a machine is likelier than before, else less likely; how much all changes count at
most, so that a voice is soon heard where a machine was; and how much none count."""


class Levels:
    """Takes the levels of the bands.

    Args:
        band: of the windows' spectra.
        sample_rate: Hz.
    """

    def __init__(self, band: Band, sample_rate: float):
        frequencies = np.arange(band.bins.start, band.bins.stop) * sample_rate / band.size
        low, high = max(LOWEST, frequencies[0]), min(HIGHEST, frequencies[-1])
        number = np.zeros(len(frequencies), np.intp)  # one band where the localizer's lies outside
        if low < high:
            number = np.searchsorted(np.geomspace(low, high, BANDS + 1), frequencies, side="right") - 1
        members = number[:, None] == np.arange(BANDS)
        self.members = members[:, members.any(axis=0)].astype(float)

    def __call__(self, coherence: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Return how loud a peak is in each window and band, (windows, bands) dB.

        Args:
            coherence: (windows, bins) of it, see `masks.Masks.coherence`.
            power: (windows, bins).
        """
        levels: np.ndarray = 10.0 * np.log10(np.maximum((coherence * power) @ self.members, 1e-30))
        return levels


@dataclass(frozen=True)
class Course:
    """How steadily something sounded so far.

    Attributes:
        steady: a sum of what its changes tell (Page 1954), from 0 (as a voice) to MOST (as a machine).
        levels: of its latest decisions, (bands,) dB each, the latest last.
    """

    steady: float = UNKNOWN
    levels: tuple[np.ndarray, ...] = ()

    def goes_on(self, levels: np.ndarray, middles: np.ndarray, apart: int) -> tuple["Course", float]:
        """Return the course up to a decision, and how steady it is with what is heard of the time after it.

        Args:
            levels: (windows, bands) dB, around the decision.
            middles: (windows,) s of their middles from it.
            apart: how many decisions there are in APART_S.
        """
        now, steady = _at(levels, middles, 0.0), self.steady
        if now is None:  # that window is too faint beside the others
            return self, steady
        if len(self.levels) == apart:
            steady = _added(steady, self.levels[0], now, 1.0 / apart)
        elif not self.levels:
            steady = _added(steady, _at(levels, middles, -APART_S), now)
        course = Course(steady, (*self.levels, now)[-apart:])
        return course, _added(steady, now, _at(levels, middles, APART_S))


def _at(levels: np.ndarray, middles: np.ndarray, time: float) -> np.ndarray | None:
    """Return the levels (bands,) of the window at a time, s from the decision; None where there is none."""
    nearest = int(np.argmin(np.abs(middles - time)))
    near: np.ndarray | None = levels[nearest] if abs(middles[nearest] - time) < 0.25 * APART_S else None
    return near


def _added(steady: float, one: np.ndarray | None, other: np.ndarray | None, share: float = 1.0) -> float:
    """Return how steady something is that was so before, and whose levels (bands,) changed so; None: not known."""
    if one is None or other is None:
        return steady
    change = float(np.median(np.abs(one - other)))
    return float(np.clip(steady + share * (1.0 - change / CHANGE_DB), 0.0, MOST))
