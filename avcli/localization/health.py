"""What is wrong with an array's channels: found from the talkers' own sound, named once, and put right where it can be.

Two steps lead to a verdict. First a hypothesis test over subsets: which channels must be left out, or turned over, so
that the others agree best on some place? What is doubted is left out from then on, silently. Then, wherever a talker is
clear without them, the channels that are doubted are compared with the sum of the others, steered to the talker: one of
wrong polarity is the opposite of it, a late one correlates later, one that carries another microphone's sound
correlates where that microphone would, and a healthy one is acquitted.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from avcli.localization.array import Array
from avcli.localization.srp import SteeredResponse
from avcli.localization.windows import Band, Correlated

LONGEST_S = 0.06
"""s: the largest delay of a channel that is looked for."""

NEAR_S = 0.00006
"""s: how far from its lag a healthy channel's correlation may have its peak: 2 cm of path."""

MEMORY = 30.0
"""How many windows of sound the evidence is of."""

STARTS, KEEP = 8, 64
"""Around how many places a window's hypotheses are compared, and how many cells the search for them keeps."""

EACH, AFTER, SELDOM = 1, 20, 5
"""Every window is tested at first; after so many windows without a doubt one of a few."""

DOUBT, PRICE = 50.0, 8.0
"""By how much the log likelihood must rise to doubt channels, and what each channel that is doubted costs of it."""

HEARD, PATIENT = 5, 15
"""After how many windows with a clear talker a fault is named, and a channel without one is acquitted or left out."""


@dataclass(frozen=True)
class Fault:
    """What is wrong with a channel.

    Attributes:
        channel: from 1, as in the recording.
        kind: "late", "polarity", "swapped" or "unexplained".
        size: s by which it is late, or the number of the microphone, from 1, whose sound it carries.
        corrected: whether it is put right; a channel that is not is left out.
    """

    channel: int
    kind: str
    size: float | None = None
    corrected: bool = True

    def __str__(self) -> str:
        if self.kind == "late" and self.size is not None:
            way = "late" if self.size > 0.0 else "early"
            return f"channel {self.channel} is {1000.0 * abs(self.size):.2f} ms {way}; this is corrected"
        if self.kind == "polarity":
            return f"channel {self.channel} has the wrong polarity; this is corrected"
        if self.kind == "swapped":
            return f"channel {self.channel} carries the sound of microphone {self.size:.0f}; this is corrected"
        return f"channel {self.channel} does not agree with the others and is left out"


class Health:
    """The state of an array's channels, and the evidence for it.

    Args:
        array: the microphones.
        band: the frequencies.
        response: of the array.

    Attributes:
        order: (m,) which channel of the recording is taken for each microphone.
        sign: (m,) by which that channel is multiplied.
        delay: (m,) s by which it is late.
        doubted: (m,) bool, which are left out until they are judged.
        faulty: (m,) bool, which are left out for good.
    """

    def __init__(self, array: Array, band: Band, response: SteeredResponse):
        self.array, self.band, self.response = array, band, response
        count = len(array.microphones)
        self.order, self.sign, self.delay = np.arange(count), np.ones(count), np.zeros(count)
        self.doubted, self.faulty, self.acquitted = np.zeros((3, count), bool)
        self.size = round(band.size * band.oversampling)
        self.step = 1.0 / (array.sample_rate * band.oversampling)
        self.reach = min(int(LONGEST_S / self.step), self.size // 2 - 2)
        self.hypotheses, self.weights, self.left = self._hypotheses()
        self.likelihood, self.tested = np.zeros(len(self.hypotheses)), 0
        self._forget()

    def _forget(self) -> None:
        count = len(self.order)
        self.lagged = np.zeros((count, 2 * self.reach + 1))
        self.crossed = np.zeros((count, count))
        self.windows = 0.0

    def _hypotheses(self) -> tuple[list[tuple[tuple[int, ...], bool]], np.ndarray, np.ndarray]:
        """Return which channels each hypothesis doubts and whether it turns them over, the weights of the pairs
        (pairs, hypotheses), and how many pairs are left (hypotheses,)."""
        count, first, second = len(self.order), self.response.first, self.response.second
        sets = [subset for size in (1, 2) for subset in combinations(range(count), size)]
        chosen = [((), False)] + [(subset, False) for subset in sets if count - len(subset) >= 4]
        most = 4 if count <= 8 else 2
        chosen += [(subset, True) for size in range(1, min(most, count // 2) + 1) for subset in combinations(range(count), size)]
        gains = np.ones((len(chosen), count))
        for row, (subset, turned) in zip(gains, chosen, strict=True):
            row[list(subset)] = -1.0 if turned else 0.0
        weights = (gains[:, first] * gains[:, second]).T
        return chosen, weights.astype(np.float32), np.abs(weights).sum(axis=0)

    @property
    def out(self) -> np.ndarray:
        """Which channels (m,) are left out."""
        return self.doubted | self.faulty

    @property
    def turn(self) -> np.ndarray | None:
        """By what the spectra (m, bins) of the ordered channels are multiplied; None where nothing is put right."""
        if not self.delay.any() and (self.sign == 1.0).all():
            return None
        return (self.sign[:, None] * self.band.turned(self.delay, self.array.sample_rate)).astype(np.complex64)

    def doubt(self, window: Correlated, deviation: float) -> None:
        """Test in a window in which something sounds which channels must be left out or turned over.

        The log likelihood of a hypothesis is half the square of its pairs' mean GCC over its standard deviation, at the
        place where that is largest.

        Args:
            window: whose spectra are put right by what was found before.
            deviation: of a GCC of noise.
        """
        self.tested += 1
        if self.tested > AFTER and self.tested % SELDOM:
            return
        good = window.good & ~self.faulty
        first, second = self.response.first, self.response.second
        kept = good[first] & good[second]
        if good.sum() < 5:
            return
        clipped = np.clip(window.gcc, 0.0, 7.0 * deviation) * kept[:, None]
        starts = _apart(self.response.search(clipped, KEEP)[0], STARTS, 0.3)
        gcc = np.minimum(window.gcc, 10.0 * deviation) * kept[:, None]
        best = np.zeros(len(self.hypotheses))
        weights = self.weights * kept[:, None]
        pairs = np.maximum(np.abs(weights).sum(axis=0), 1.0)
        for start in starts:
            points = np.clip(start + _AROUND, self.response.low, self.response.high)
            lag = np.rint(self.response.lags(points)).astype(np.intp) + (self.response.rows + self.response.half_lags)
            sums = gcc.ravel().take(lag).T @ weights
            np.maximum(best, sums.max(axis=0) / (np.sqrt(pairs) * deviation), out=best)
        kept_share = 1.0 - 1.0 / MEMORY
        self.likelihood = kept_share * self.likelihood + 0.5 * best**2
        gain = self.likelihood - self.likelihood[0]
        gain -= [DOUBT * bool(subset) + PRICE * len(subset) + DOUBT * sum(self.acquitted[c] for c in subset) for subset, _ in self.hypotheses]
        gain[[bool(subset) and not good[list(subset)].all() for subset, _ in self.hypotheses]] = -np.inf
        chosen = int(np.argmax(gain))
        if chosen:
            self.doubted[list(self.hypotheses[chosen][0])] = True
            self.likelihood[:], self.tested = 0.0, 0
            self._forget()

    def judge(self, window: Correlated, place: np.ndarray) -> list[Fault]:
        """Compare the channels with those that agree on a talker, and return what is newly found.

        Args:
            window: in which the talker is clear.
            place: (3,) m, where.
        """
        members = window.good & ~self.out
        if members.all() or members.sum() < 3:
            return []
        ranges = np.linalg.norm(place - self.array.microphones, axis=1)
        delays = (ranges - ranges.mean()) / self.array.speed_of_sound
        aligned = window.whitened * self.band.turned(delays, self.array.sample_rate)
        reference = (aligned * members[:, None]).sum(axis=0) - aligned * members[:, None]
        others = members.sum() - members
        weight = self.band.weight / self.band.weight.sum()
        spectrum = np.zeros((len(aligned), self.size // 2 + 1), np.complex64)
        spectrum[:, self.band.bins] = aligned * reference.conj() * weight * (0.5 * self.size / others)[:, None]
        lagged = np.fft.irfft(spectrum, self.size, axis=1)
        lagged = np.concatenate([lagged[:, -self.reach :], lagged[:, : self.reach + 1]], axis=1)
        share = 1.0 - 1.0 / MEMORY
        self.lagged = share * self.lagged + lagged
        lags = np.rint((ranges - ranges[:, None]) / self.array.speed_of_sound / self.step).astype(int)
        at = np.clip(lags, 2 - self.reach, self.reach - 2) + self.reach
        rows = np.arange(len(lagged))[:, None]
        crossed = np.max([lagged[rows, at + k] for k in (-2, -1, 0, 1, 2)], axis=0)
        self.crossed = share * self.crossed + np.where(np.abs(lags) <= self.reach - 2, crossed, 0.0)
        self.windows = share * self.windows + 1.0
        return self._verdicts(members, window.good) if self.windows >= HEARD - 0.5 else []

    def _verdicts(self, members: np.ndarray, good: np.ndarray) -> list[Fault]:
        """Return what the evidence newly says of the channels that are doubted, and put it right."""
        near = max(2, round(NEAR_S / self.step))
        own = self.lagged[:, self.reach - near : self.reach + near + 1].max(axis=1)
        usual = float(np.median(own[members]))
        doubted = [int(c) for c in np.flatnonzero(self.doubted & good)]
        found: list[Fault] = []
        for c, k in combinations(doubted, 2):
            if self.doubted[c] and self.doubted[k] and min(self.crossed[c, k], self.crossed[k, c]) > 0.6 * usual:
                self.order[[c, k]] = self.order[[k, c]]
                self.doubted[[c, k]] = False
                found += [Fault(int(self.order[j]) + 1, "swapped", j + 1) for j in (k, c)]
        for c in doubted:
            if self.doubted[c]:
                found += self._verdict(c, own[c], usual, near)
        if found:
            self.likelihood[:], self.tested = 0.0, 0
        return found

    def _verdict(self, c: int, own: float, usual: float, near: int) -> list[Fault]:
        """Return the faults of one doubted channel, given its own correlation and the usual one."""
        row, channel = self.lagged[c], int(self.order[c]) + 1
        at = int(np.argmax(np.abs(row)))
        lag, height = at - self.reach, abs(row[at])
        late, turned = abs(lag) > near, row[at] < 0.0
        found: list[Fault] = []
        if height > 0.5 * usual and height > 1.5 * own and (late or turned):
            if turned:
                self.sign[c] = -self.sign[c]
                found.append(Fault(channel, "polarity"))
            if late:
                self.delay[c] += lag * self.step
                found.append(Fault(channel, "late", float(self.delay[c])))
        elif self.windows < PATIENT:
            return []
        elif own > 0.3 * usual and own >= 0.8 * height:
            self.acquitted[c] = True
        elif height < 0.35 * usual:
            self.faulty[c] = True
            found.append(Fault(channel, "unexplained", None, False))
        else:
            return []
        self.doubted[c] = False
        self.lagged[c], self.crossed[c] = 0.0, 0.0
        return found


_AROUND = np.array([[x, y, z] for x in np.arange(-6, 7) * 0.025 for y in np.arange(-6, 7) * 0.025 for z in np.arange(-3, 4) * 0.1])
"""m: the places around a start at which hypotheses are compared."""


def _apart(places: np.ndarray, count: int, distance: float) -> list[np.ndarray]:
    """Return the first places (3,) m of (n, 3), no two of them nearer than a distance in m, so many at most."""
    chosen: list[np.ndarray] = []
    for place in places:
        if all(np.linalg.norm(place - one) > distance for one in chosen):
            chosen.append(place)
            if len(chosen) == count:
                break
    return chosen
