"""Steady sources, such as fans and projectors: they sound on and on at one place, and are nobody.

What sounds steadily stands at the floor of each frequency, and speech above it. The floor is a quantile of the power of
the last seconds (Stahl, Fischer & Bippus 2000). Windows in which nearly all of the band stands at the floor hold what
is steady alone. The room's own noise comes from everywhere; but where such windows agree on a place, there is a source.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from avcli.localization.directions import APART, RaySearch
from avcli.localization.memory import level_distance
from avcli.localization.noise import NoiseLaw
from avcli.localization.srp import SteeredResponse
from avcli.localization.talkers import NOTCH_M
from avcli.localization.windows import Correlated, Correlator, Heard

SPACING_S = 0.1
"""s between the windows that are taken: nearer ones share their noise, and farther ones do not show what lasts."""
MEMORY_S, LEAST_S, EVERY_S = 5.0, 2.0, 0.5
"""s over which the floor is taken, that must have been heard for it, and after which it is taken again."""
QUANTILE = 0.25
SMOOTHED_HZ = 50.0
"""Hz over which a power is averaged: a single bin of noise is often far below its mean."""
AT_FLOOR, ALONE, LASTING_S = 3.0, 0.7, 0.4
"""Factor between a bin's power and its floor, either way, up to which it stands there; the share of such bins in a
window without speech; and the s for which there must be such windows on end: reverberation does not stand still."""
COUNTS_S, LEAST, DECISION = 5.0, 4.0, 3.0
"""s for which such a window counts, how many must count, and how many a decision has: what no decision would report as
a talker, such as the hiss of a recorded voice, is no source."""
MOST, BESIDE, APART_M = 3, 0.5, 0.5
"""How many sources there may be, the least response of each over that of the one before, and how far apart, in m, two
must be that are named."""
LOUD, SPEECH = 6.0, 0.03
"""Power over the floor from which a bin is loud, and the share of loud bins from which somebody may speak."""
FALSE_ALARM = 1e-4
"""Probability that noise alone makes a source, each time that one is looked for."""


class SteadySources:
    """Finds the place of what sounds on and on, window by window.

    Args:
        correlator: of the array.
        search: of places, or of directions.
        hop: s between windows. If it is longer than a third of `LASTING_S`, nothing is learnt.
        in_room: returns the places (k, 3) m of the room for those of the search; None: they are the same.

    Attributes:
        places: (k, 3) m of the sources; where the search is of directions, at some distance in these.
    """

    def __init__(
        self,
        correlator: Correlator,
        search: SteeredResponse | RaySearch,
        hop: float,
        in_room: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        self.correlator, self.search = correlator, search
        self.in_room = in_room or np.asarray
        self.named = np.zeros((0, 3))
        band = correlator.band
        self.weight = band.weight / band.weight.sum()
        self.half = max(1, round(0.5 * SMOOTHED_HZ * band.size / correlator.sample_rate))
        self.able = hop <= LASTING_S / 3.0
        self.spacing = max(1, round(SPACING_S / hop))
        hop *= self.spacing
        self.memory, self.least, self.every, self.lasting = (
            max(1, round(seconds / hop)) for seconds in (MEMORY_S, LEAST_S, EVERY_S, LASTING_S)
        )
        self.fades = float(np.exp(-hop / COUNTS_S))
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after a gap in the stream."""
        self.history: deque[np.ndarray] = deque(maxlen=self.memory)
        self.passed, self.taken, self.floor = 0, 0, np.zeros(0)
        self.run: list[np.ndarray] = []
        self.total, self.count = np.zeros(0, np.float32), 0.0
        self.places = np.zeros((0, 3))

    def take(self, window: Correlated, noise: Callable[[float], NoiseLaw]) -> None:
        """Take the next window.

        Args:
            window: of which the stream may hold a part; then it tells nothing.
            noise: gives what noise does to so many windows.
        """
        if not self.able or window.part < 0.99:
            return
        self.passed += 1
        if self.passed % self.spacing:
            return
        power = _averaged(window.power, self.half)
        self.history.append(power)
        self.taken += 1
        if self.taken % self.every == 0 and len(self.history) >= self.least:
            lowest = int(QUANTILE * len(self.history))
            self.floor = np.partition(np.array(self.history), lowest, axis=0)[lowest]
        if len(self.floor):
            self._add(window.gcc, power)
        if self.taken % (2 * self.every) == 0 and self.count >= LEAST:
            least = noise(self.count).threshold(FALSE_ALARM), noise(DECISION).threshold(FALSE_ALARM)
            self.places = self._sources(self.total / self.count, max(least))

    def _add(self, gcc: np.ndarray, power: np.ndarray) -> None:
        """Add a window's GCC (pairs, lags) to those without speech if it, and those just before it, hold none."""
        at_floor = (power <= AT_FLOOR * self.floor) & (AT_FLOOR * power >= self.floor)
        if self.weight @ at_floor <= ALONE:
            self.run.clear()
            return
        self.run.append(gcc)
        if len(self.run) < self.lasting:
            return
        for one in self.run:
            self.total = self.fades * self.total + one if self.count else one
            self.count = self.fades * self.count + 1.0
        self.run.clear()

    def _sources(self, gcc: np.ndarray, least: float) -> np.ndarray:
        """Return the places (k, 3) m that answer a GCC (pairs, lags), each without those before it."""
        found: list[np.ndarray] = []
        while len(found) < MOST:
            places, values = self.search.search(gcc)
            if values[0] < least:
                break
            found.append(places[0])
            if isinstance(self.search, RaySearch):
                break
            least = max(least, BESIDE * float(values[0]))
            gcc = self.search.notch(gcc[None], places[:1], NOTCH_M)[0]
        return np.array(found).reshape(-1, 3)

    def beside(self, heard: Heard) -> Heard:
        """Return the windows around a moment with the steady sources, and with what stands above their floor."""
        powers = np.array([_averaged(power, self.half) for power in heard.power])
        above = 1.0 - self.floor / np.maximum(powers, np.maximum(self.floor, np.finfo(float).tiny))
        return replace(heard, steady=self._silent(heard, powers > LOUD * self.floor), above=above.astype(np.float32))

    def _silent(self, heard: Heard, loud: np.ndarray) -> np.ndarray:
        """Return the places (k, 3) m of the sources at which nobody speaks; which bins are loud is (windows, bins).

        A loudspeaker hisses, and so do recordings: what stands out of the floor must come from elsewhere.
        """
        loud = loud * self.weight
        if np.mean(loud.sum(axis=1)) < SPEECH:
            return self.places
        each = [
            self.correlator.gcc(spectra, weight.astype(np.float32)) * np.float32(weight.sum())
            for spectra, weight in zip(heard.spectra, loud, strict=True)
        ]
        speaker = self.search.search(np.mean(each, axis=0))[0][0]
        return self.places[[not self._same(place, speaker) for place in self.places]]

    def _same(self, one: np.ndarray, other: np.ndarray) -> bool:
        """Tell whether two places (3,) m may be of one source."""
        if isinstance(self.search, RaySearch):
            one, other = one - self.search.centre, other - self.search.centre
            return bool(one @ other > np.cos(APART) * np.linalg.norm(one) * np.linalg.norm(other))
        return level_distance(one, other) < APART_M

    def news(self, talkers: Sequence[np.ndarray]) -> list[str]:
        """Return a sentence about each source that has not been named yet, and is not where one of talkers (3,) m is.

        A talker's recording hisses at the talker's place: that is no fan.
        """
        said = []
        for place in self.places:
            if not any(self._same(place, one) for one in [*self.named, *talkers]):
                self.named = np.vstack([self.named, place])
                said.append(f"a steady source, such as a fan, sounds {self._where(place)}: it is no talker")
        return said

    def _where(self, place: np.ndarray) -> str:
        x, y, _ = self.in_room(place[None])[0]
        if isinstance(self.search, RaySearch):
            x, y, _ = place - self.search.centre
            return f"at an azimuth of {np.degrees(np.arctan2(y, x)):.0f} degrees"
        return f"near x = {x:.1f} m, y = {y:.1f} m"

    @property
    def told(self) -> np.ndarray:
        """The places (k, 3) m, or unit vectors of the directions where the search is of these."""
        if not isinstance(self.search, RaySearch) or not len(self.places):
            return self.in_room(self.places)
        away = self.places - self.search.centre
        return away / np.linalg.norm(away, axis=1, keepdims=True)


def _averaged(power: np.ndarray, half: int) -> np.ndarray:
    """Return the mean of each bin (n,) and up to `half` neighbours on each side."""
    total = np.concatenate([[0.0], np.cumsum(power, dtype=np.float64)])
    index = np.arange(len(power))
    first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, len(power))
    return (total[last] - total[first]) / (last - first)
