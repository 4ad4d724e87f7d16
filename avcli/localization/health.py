"""What is wrong with an array's channels: found from the talkers' own sound, named once, and put right where it can be.

How the channels are connected is tested first, see `rewiring`. A healthy array agrees on where a talker is. Hypotheses
about the channels (these are left out, those are of wrong polarity) are compared by how well the others agree on any
place, window after window. Where leaving channels out helps much, they are listened to: steered to the places on which
the others agree, a late channel correlates with their sum at its delay, and a channel that carries another microphone's
sound does so after the two are exchanged. A correction is believed only if the whole array, so corrected, agrees much
better than the array without the channels.

A compact array is searched over all its directions for each hypothesis, and exchanges of two channels are hypotheses,
too: without these it agrees on some direction in any case. Its microphones are at known places, so that short delays
are told.
"""

from collections import deque
from dataclasses import replace
from itertools import combinations

import numpy as np

from avcli.localization import correlation
from avcli.localization.array import Array
from avcli.localization.directions import RaySearch
from avcli.localization.faults import Fault
from avcli.localization.rewiring import ENOUGH, MOMENTS, Moments, Remedy, Rewiring, exchanged, turned_over
from avcli.localization.srp import SteeredResponse
from avcli.localization.windows import Band, Correlated, Correlator

LONGEST_S = 0.06
"""s: the largest delay of a channel that is looked for."""

TOLD_S, TOLD_COMPACT_S = 0.0005, 0.00006
"""s: the least delay that is told from a microphone that hangs up to 17 cm from where the config says, and of a compact
array, from one that is 2 cm off."""

MEMORY, RECENT = 30.0, 8
"""How many windows of sound the evidence is of, and how many are listened to again for a verdict."""

STARTS, KEEP = 6, 48
"""Around how many places a window's hypotheses are compared, and how many cells the search for them keeps."""

EARLIEST, AFTER, SELDOM = 4, 15, 10
"""How many more windows doubt needs for a verdict; after how many without a doubt one of how many is tested."""

LEVELLED, UNUSUAL_DB, DEAD = 20, 12.0, 5
"""After how many windows the levels are compared, by how many dB a channel differs that is named, and for how many
windows in which somebody is heard a channel without sound is called dead."""

MARGIN, CLEAR = 0.05, 0.3
"""The share of its log likelihood by which a hypothesis about a compact array must be better, since what is not
modelled, such as the body of the array and a second talker, grows with it: three times as much where two channels are
exchanged, since one 0.1 ms late looks like that, and where several are left out, 0.15 of what deaf channels would give;
and the share that an exchange must explain alone, of which right ones in rooms that decided had mostly 0.3 or more, and
wrong ones up to 0.27."""

DOUBT, EACH = 15.0, 4.0
"""By how much the log likelihood must rise to doubt channels, and by how much more for each of them."""

CANDIDATES, RIVAL = 4, 0.75
"""How many hypotheses of a kind are listened to, and the share of the best remedy's gain that makes another a rival."""

WHOLE, DELAYED = 0.75, 0.95
"""The share of the agreement of a healthy array that a corrected one must reach, and where delays were fitted to it."""

PARAMETER = 30.0
"""What a delay that is fitted costs of the log likelihood."""

FITTED = 5
"""How many channels must be left where two or more are doubted or left out for good: four agree on some place although
all are healthy."""

UNSETTLED = 20
"""In how many windows some channels must have been doubted, and in no fewer than half of all, until it is said."""

ORDERED, CHANGED = 0.25, 0.65
"""By what scores are multiplied while the channels are probably in another order, and while some are probably late or
turned over and none is left out: in rooms that decided, 0.24 and 0.46 of what was reported then was right, where scores
said 0.7."""

FEW = 12
"""Up to how many channels two are doubted, or three and four turned over, at once; of more, one after another."""


OUT, OVER, EXCHANGED = range(3)
"""What a hypothesis does to its channels: it leaves them out, turns them over, or exchanges two of them."""


class Health:
    """The state of an array's channels, and the evidence for it.

    Args:
        array: the microphones.
        correlator, response: of the array.

    Attributes:
        order: (m,) which channel of the recording is taken for each microphone.
        sign: (m,) by which that channel is multiplied.
        delay: (m,) s by which it is late.
        doubted: (m,) bool, which are left out as the latest windows have it.
        held: (m,) bool, which are left out since several remedies would do.
        suspected: how the channels are probably exchanged, where it is not certain enough to put them right; they are
            held then.
        faulty: (m,) bool, which are left out for good.
        loud: (m,) dB, by how much the level of each is unusual; else 0.
        silent: (m,) in how many windows up to the last each was without sound.
    """

    def __init__(self, array: Array, correlator: Correlator, response: SteeredResponse | RaySearch):
        self.array, self.correlator, self.response = array, correlator, response
        self.band: Band = correlator.band
        count = len(array.microphones)
        self.order, self.sign, self.delay = np.arange(count), np.ones(count), np.zeros(count)
        self.doubted, self.held, self.faulty = np.zeros((3, count), bool)
        if array.wiring:
            self.order, self.sign, self.delay = array.wiring.order, array.wiring.sign, array.wiring.delay
            self.faulty = ~array.wiring.usable
        self.level, self.loud, self.silent = np.zeros((3, count))
        self.size = round(self.band.size * self.band.oversampling)
        self.step = 1.0 / (array.sample_rate * self.band.oversampling)
        self.reach = min(int(LONGEST_S / self.step), self.size // 2 - 2)
        self.compact = compact = isinstance(response, RaySearch)
        self.told = TOLD_COMPACT_S if compact else TOLD_S
        self.most, self.clear = (np.inf, CLEAR) if compact else (10.0, 0.0)
        self.row = np.zeros((count, count), np.intp)
        self.row[correlator.first, correlator.second] = np.arange(len(correlator.first))
        self.row = np.maximum(self.row, self.row.T)
        self.hypotheses = _hypotheses(count, compact=compact)
        self.after = AFTER if count <= FEW else 0  # many pairs tell much at once, and cost much
        gains = np.ones((len(self.hypotheses), count))
        for row, (subset, kind) in zip(gains, self.hypotheses, strict=True):
            row[list(subset)] = (0.0, -1.0, 1.0)[kind]
        self.weights = (gains[:, correlator.first] * gains[:, correlator.second]).T.astype(np.float32)
        self.price = np.array([(DOUBT + EACH * len(subset)) * bool(subset) for subset, _ in self.hypotheses])
        self.leaving = np.array([len(subset) if kind == OUT else 0 for subset, kind in self.hypotheses])
        kept = np.abs(self.weights).sum(axis=0)
        exchanging = [kind == EXCHANGED for _, kind in self.hypotheses]
        self.margins = np.maximum(MARGIN, MARGIN * np.where(exchanging, 3.0, 3.0 * (kept[0] / kept - 1.0))) * compact
        self.rewiring = None if isinstance(response, RaySearch) else Rewiring(response, array.speed_of_sound)
        self.suspected: Remedy | None = None
        self.around: list[Correlated] = []
        self._forget()

    def _forget(self) -> None:
        self.likelihood, self.windows = np.zeros(len(self.hypotheses)), 0
        self.disputed, self.doubts = 0, np.zeros(len(self.order))  # windows with doubts, and of each channel
        self.patience = self.waited = EARLIEST
        self.recent: deque[Correlated] = deque(maxlen=RECENT)
        self.likely: Remedy | None = None
        self.moments: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=MOMENTS)  # GCCs and good channels of each
        self.heard, self.enough = 0, ENOUGH  # moments so far, and how many are for the next verdict on the wiring
        self.settled = False  # whether the channels are connected as the config says, unless some are doubted
        self.possible: Remedy | None = None  # what the last verdict was that may be wrong, not certain enough to act
        self.moment = self.stale = (
            self.around
        )  # the latest moment's windows, and those from before the channels changed

    @property
    def out(self) -> np.ndarray:
        """Which channels (m,) are left out."""
        return self.doubted | self.held | self.faulty

    @property
    def usable(self) -> int:
        """How many channels are neither left out nor dead."""
        return int((~self.out & (self.silent < DEAD)).sum())

    @property
    def unsettled(self) -> int | None:
        """The channel, from 1, that is doubted most, where some have been most of the time; None where none have."""
        often = self.disputed >= max(UNSETTLED, 0.5 * self.windows)
        return int(self.order[np.argmax(self.doubts)]) + 1 if often else None

    @property
    def trust(self) -> float:
        """By what scores are multiplied; less than 1 while the sound fits the channels much better in another way.

        A wrong polarity or a delay does little harm where channels are left out.
        """
        if self.possible is None:
            return 1.0
        ordered = bool((self.possible.order != np.arange(len(self.order))).any())
        if self.compact or (ordered and self.possible.alone):
            return ORDERED
        return 1.0 if self.doubted.any() else CHANGED

    @property
    def contradicted(self) -> bool:
        """Whether scores are lower for that reason, and it is not clear at once what is to be put right."""
        return self.trust < 1.0 and not (self.compact and self.waited == EARLIEST)

    @property
    def turn(self) -> np.ndarray | None:
        """By what the spectra (m, bins) of the ordered channels are multiplied; None where nothing is put right."""
        if not self.delay.any() and (self.sign == 1.0).all():
            return None
        return self._turned(self.sign, self.delay)

    def _turned(self, sign: np.ndarray, delay: np.ndarray) -> np.ndarray:
        return (sign[:, None] * self.band.turned(delay, self.array.sample_rate)).astype(np.complex64)

    def examine(self, window: Correlated, around: list[Correlated], deviation: float) -> None:
        """Test the channels in a window in which something sounds, and put right or leave out what is faulty.

        The log likelihood of a hypothesis is half the square of its pairs' mean GCC over its standard deviation, at the
        place where that is largest.

        Args:
            window: its channels are put right by what was found before.
            around: it and those around it in which something sounds.
            deviation: of a GCC of noise.
        """
        self.windows += 1
        self.disputed += bool(self.doubted.any())
        self.doubts += self.doubted
        self._weigh(window)
        self.around = around
        if self.suspected or any(window is one for one in self.stale):
            return
        if self._rewire(around, deviation):
            return
        good = window.good & ~self.faulty
        seldom = self.windows > self.after and self.windows % SELDOM and not self.doubted.any()
        if good.sum() < (4 if self.compact else 5) or seldom:
            return
        self.recent.append(window)
        best = self._compared(window.gcc, good, deviation)
        self.likelihood = (1.0 - 1.0 / MEMORY) * self.likelihood + 0.5 * best**2
        gain = (1.0 - self.margins) * self.likelihood - self.likelihood[0] - self.price
        gain[0] = 0.0
        gain[[not good[list(subset)].all() for subset, _ in self.hypotheses]] = -np.inf
        gain[self.leaving > good.sum() - min(FITTED, len(good) - 1)] = -np.inf
        chosen = int(np.argmax(gain))
        subset, kind = self.hypotheses[chosen]
        self.doubted[:] = False
        self.doubted[list(subset)] = True
        if self.compact and (not chosen or kind == EXCHANGED):  # until it is named, nobody is believed
            self.possible = exchanged(subset, len(good)) if chosen else None
        if not chosen or len(self.recent) < RECENT:
            return
        # To turn one half over is to turn the other half over.
        halves = (set(subset), set(range(len(good))) - set(subset))
        rest = [h for h, (other, _) in enumerate(self.hypotheses) if set(other) not in halves]
        if kind == OVER and gain[chosen] > max(1.5 * gain[rest].max(), self.likelihood[0]):
            self._apply(turned_over(subset, len(good)))
            return
        self.patience -= 1
        if self.patience == 0:
            self.waited *= 2
            self.patience = self.waited
            self._diagnose(gain, deviation)

    def _rewire(self, around: list[Correlated], deviation: float) -> bool:
        """Test once in a while whether the channels are connected as the config says; tell whether they are not."""
        if self.rewiring is None or any(one is other for one in around for other in self.moment):
            return False
        self.moment = around
        gcc = np.sum([window.gcc for window in around], axis=0) / np.float32(np.sqrt(len(around)))
        self.moments.append((gcc, np.all([window.good for window in around], axis=0)))
        self.heard += 1
        if self.heard < self.enough or (self.settled and not self.doubted.any()):
            return False
        good = np.all([good for _, good in self.moments], axis=0) & ~self.faulty
        remedy = self.rewiring.find(Moments([gcc for gcc, _ in self.moments], good, deviation))
        if remedy and not remedy.changed.any():
            self.settled, remedy = True, None
        before, self.possible = self.possible, remedy
        # A delay is believed when other moments tell it again.
        told = remedy is not None and (not remedy.delay.any() or (before is not None and remedy.alike(before)))
        if remedy and remedy.certain and told:
            self._apply(remedy)
        elif remedy and remedy.alone and remedy.clear and not remedy.delay.any():
            self.suspected, self.held = remedy, remedy.changed
        else:
            self.settled |= self.heard >= 2 * ENOUGH and remedy is None
            self.enough = self.heard + (MOMENTS if remedy else self.heard)
        return self.suspected is not None or not self.heard

    def _weigh(self, window: Correlated) -> None:
        """Compare the channels' levels: the whitened spectra hide how quiet a channel is."""
        power = (window.spectra.real**2 + window.spectra.imag**2).sum(axis=1, dtype=np.float64)
        self.level = self.level + (10.0 * np.log10(np.maximum(power, 1e-30)) - self.level) / min(self.windows, MEMORY)
        # At the beginning of a sound without noise, it has not reached all channels yet.
        self.silent = np.where(power <= 1e-6 * np.median(power), self.silent + 1, 0)
        if self.windows == LEVELLED and window.good.any():
            above = self.level - np.median(self.level[window.good])  # dead channels are no measure
            self.loud = np.where((np.abs(above) > UNUSUAL_DB) & window.good, above, 0.0)

    def _compared(self, gcc: np.ndarray, good: np.ndarray, deviation: float) -> np.ndarray:
        """Return each hypothesis's mean GCC, in standard deviations of noise, where it is largest.

        Args:
            gcc: (pairs, lags).
            good: (m,) bool, the channels that are used.
            deviation: of a GCC of noise.
        """
        kept = good[self.response.first] & good[self.response.second]
        weights = self.weights * kept[:, None]
        clipped = np.minimum(gcc, self.most * deviation) * kept[:, None]
        sums = [(values.T @ weights).max(axis=0) for values in self._around(clipped, deviation)]
        best = np.max(sums, axis=0)
        if isinstance(self.response, RaySearch):
            for h, (subset, kind) in enumerate(self.hypotheses):
                if kind == EXCHANGED:
                    best[h] = self.response.responses(self._exchanged(clipped, subset)).max() * len(kept)
        scale = np.sqrt(np.maximum(np.abs(weights).sum(axis=0), 1.0)) * deviation
        return np.maximum(best, 0.0) / scale

    def _exchanged(self, gcc: np.ndarray, subset: tuple[int, ...]) -> np.ndarray:
        """Return the GCCs (pairs, lags) as they would be with two channels exchanged."""
        order = np.arange(len(self.order))
        order[list(subset)] = subset[::-1]
        first, second = order[self.response.first], order[self.response.second]
        taken = gcc[self.row[first, second]]
        taken[first > second] = taken[first > second, ::-1]
        return taken

    def _around(self, gcc: np.ndarray, deviation: float) -> list[np.ndarray]:
        """Return what the pairs answer, (pairs, places), around each place that many answer, whatever the others say.

        Of a compact array, these are all its directions.
        """
        response = self.response
        if isinstance(response, RaySearch):
            return [response.answers(gcc)]
        starts = _apart(response.search(np.clip(gcc, 0.0, 7.0 * deviation), KEEP)[0], STARTS, 0.3)
        lags = [response.lags(np.clip(start + _LATTICE, response.low, response.high)) for start in starts]
        return [gcc.ravel().take(np.rint(lag).astype(np.intp) + (response.rows + response.half_lags)) for lag in lags]

    def _diagnose(self, gain: np.ndarray, deviation: float) -> None:
        """Listen to the channels of the likeliest hypotheses in the recent windows, and put right what is clear."""
        gain = np.where(np.isfinite(gain), gain + self.price, 0.0)
        kinds = np.array([len(subset) if kind == OUT else -kind for subset, kind in self.hypotheses])
        sizes = (kinds == 1, kinds == 2, kinds == 3, kinds == -OVER, kinds == -EXCHANGED)
        if self.compact and self.hypotheses[int(np.argmax(gain))][1] != EXCHANGED:
            self.possible = None
        order = [h for kind in sizes for h in np.argsort(-gain * kind)[:CANDIDATES] if gain[h] * kind[h] > 0.0]
        good = np.all([window.good for window in self.recent], axis=0) & ~self.faulty
        healthy = self._reached(turned_over((), len(good)), good, deviation)[0]
        best_out = int(np.argmax(gain * (kinds > 0)))
        remedies, deaf = list[Remedy](), None
        for h in order:
            subset, kind = self.hypotheses[h]
            alone, places = self._left(subset, good, deviation)
            # Put right, every pair of the array agrees as well as those do that agreed without these channels.
            left = good.sum() - len(subset)
            whole = alone * good.sum() * (good.sum() - 1) / max(left * (left - 1), 1) if left >= 4 else 0.0
            if kind != OUT:
                one = turned_over(subset, len(good)) if kind == OVER else exchanged(subset, len(good))
                found = [replace(one, gain=self._reached(one, good, deviation)[0] - healthy)]
            else:
                lagged, usual = self._listened(subset, places, good)
                if deaf is None or h == best_out:
                    deaf = subset if np.abs(lagged).max() < 0.35 * usual else ()
                found = [
                    self._improved(remedy, subset, good, deviation, healthy)
                    for remedy in self._remedies(subset, lagged)
                ]
            shares = [DELAYED if remedy.delay.any() else WHOLE for remedy in found]
            remedies += [
                one
                for one, share in zip(found, shares, strict=True)
                if one.gain + healthy > share * whole and (one.unmoved or one.gain > self.clear * (one.gain + healthy))
            ]
        best = self._chosen([remedy for remedy in remedies if remedy.gain > 2.0 * DOUBT], good, deviation, healthy)
        if best and (not best.delay.any() or (self.likely and best.alike(self.likely, 0.3 * self.told))):
            self._apply(best)
        elif best:  # a delay is believed when other windows tell it again
            self.likely, self.patience = best, EARLIEST
        elif deaf and self.windows >= 2 * RECENT and not (self.possible and self.possible.alone):
            self.faulty[list(deaf)] = True
            self._forget()

    def _chosen(self, remedies: list[Remedy], good: np.ndarray, deviation: float, healthy: float) -> Remedy | None:
        """Return the remedy that is clearly the best, two of them where both are needed, or None."""
        if not remedies:
            return None
        most = max(remedy.gain for remedy in remedies)
        remedies = [remedy for remedy in remedies if remedy.gain > RIVAL * most]
        best = min(remedies, key=lambda remedy: (np.count_nonzero(remedy.delay), remedy.changed.sum(), -remedy.gain))
        # What changes more, and the same channels too, is the same story with more to fit.
        near = 0.3 * self.told
        rivals = [one for one in remedies if not one.alike(best, near) and not one.changed[best.changed].all()]
        for one in rivals:
            if not (one.changed & best.changed).any():
                both = Remedy(
                    np.where(one.changed, one.order, best.order), one.sign * best.sign, one.delay + best.delay
                )
                if self._reached(both, good, deviation)[0] - healthy > 1.3 * best.gain:
                    return both
        if self.compact:
            self.possible = best if rivals else self.possible
            return None if rivals else best
        if rivals and (good & ~self.held & ~best.changed).sum() >= 5:
            self.held = self.held | best.changed
        return None if rivals else best

    def _improved(
        self, remedy: Remedy, subset: tuple[int, ...], good: np.ndarray, deviation: float, healthy: float
    ) -> Remedy:
        """Return a remedy with its gain, its delays fitted again to the places that it leads to."""
        reached, places = self._reached(remedy, good, deviation)
        best = replace(remedy, gain=reached - healthy - PARAMETER * np.count_nonzero(remedy.delay))
        for _ in range(2 * bool(remedy.delay.any())):
            again = self._remedies(subset, self._listened(subset, places, good)[0])
            if not again:
                break
            reached, places = self._reached(again[0], good, deviation)
            gain = reached - healthy - PARAMETER * np.count_nonzero(again[0].delay)
            if gain <= best.gain:
                break
            best = replace(again[0], gain=gain)
        return best

    def _reached(self, remedy: Remedy, good: np.ndarray, deviation: float) -> tuple[float, list[np.ndarray]]:
        """Return the log likelihood of the recent windows, corrected, and the place (3,) m in each."""
        good = good[remedy.order]
        turn = self._turned(remedy.sign, remedy.delay)
        fitted = [
            self._best(self.correlator.gcc(window.whitened[remedy.order] * turn), good, deviation)
            for window in self.recent
        ]
        return sum(0.5 * value**2 for value, _ in fitted), [place for _, place in fitted]

    def _left(self, subset: tuple[int, ...], good: np.ndarray, deviation: float) -> tuple[float, list[np.ndarray]]:
        """Return the log likelihood of the recent windows without some channels, and the place (3,) m in each."""
        kept = good.copy()
        kept[list(subset)] = False
        fitted = [self._best(window.gcc, kept, deviation) for window in self.recent]
        return sum(0.5 * value**2 for value, _ in fitted), [place for _, place in fitted]

    def _listened(
        self, subset: tuple[int, ...], places: list[np.ndarray], good: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Return how some channels correlate with the sum of the others, steered to a place in each recent window.

        Args:
            subset: the channels.
            places: (3,) m for each window.
            good: (m,) bool, the channels that are used.

        Returns:
            (channels, lags) means, lags from -reach to reach, and the median of the others' own at lag 0.
        """
        members = good.copy()
        members[list(subset)] = False
        cross = np.zeros((len(good), len(self.band.weight)), np.complex64)
        for window, place in zip(self.recent, places, strict=True):
            ranges = np.linalg.norm(place - self.array.microphones, axis=1)
            delays = (ranges - ranges.mean()) / self.array.speed_of_sound
            aligned = window.whitened * self.band.turned(delays, self.array.sample_rate)
            total = (aligned * members[:, None]).sum(axis=0)
            cross += aligned * (total - aligned * members[:, None]).conj()
        cross *= self.band.weight / self.band.weight.sum() / (members.sum() - members)[:, None]
        usual = float(np.median(cross.real.sum(axis=1)[members]))
        spectrum = np.zeros((len(subset), self.size // 2 + 1), np.complex64)
        spectrum[:, self.band.bins] = 0.5 * self.size * cross[list(subset)]
        lagged = np.fft.irfft(spectrum, self.size, axis=1)
        return np.concatenate([lagged[:, -self.reach :], lagged[:, : self.reach + 1]], axis=1), usual

    def _remedies(self, subset: tuple[int, ...], lagged: np.ndarray) -> list[Remedy]:
        """Return what may put some channels right, given how they correlate with the others (channels, lags)."""
        count = len(self.order)
        same, sign, delay = np.arange(count), np.ones(count), np.zeros(count)
        for c, row in zip(subset, lagged, strict=True):
            at = int(np.clip(np.argmax(np.abs(row)), 1, len(row) - 2))
            before, peak, after = (np.abs(row[at - 1 : at + 2]) if row[at] > 0.0 else -row[at - 1 : at + 2]).tolist()
            offset = float(correlation.interpolate_peak(*(np.array(value) for value in (before, peak, after))))
            late = (at + offset - self.reach) * self.step
            sign[c] = 1.0 if row[at] > 0.0 else -1.0
            delay[c] = late if abs(late) > self.told else 0.0
        found = [Remedy(same, sign, delay)]
        found = [one for one in found if one.changed.sum() == len(subset)]
        for pair in combinations(subset, 2):
            swapped = same.copy()
            swapped[list(pair)] = pair[::-1]
            rest = ~np.isin(same, pair)
            found.append(Remedy(swapped, np.where(rest, sign, 1.0), np.where(rest, delay, 0.0)))
        fitted = (count - 4) // 2  # a place takes three of the differences, and as many are left to judge the delays
        return [one for one in found if np.count_nonzero(one.delay) <= fitted]

    def _best(self, gcc: np.ndarray, good: np.ndarray, deviation: float) -> tuple[float, np.ndarray]:
        """Return the largest mean GCC of some channels, in standard deviations of noise, and its place (3,) m."""
        kept = good[self.response.first] & good[self.response.second]
        clipped = np.minimum(gcc, self.most * deviation) * kept[:, None]
        if isinstance(self.response, RaySearch):
            place, value = self.response.best(clipped)
        else:
            start = self.response.search(clipped)[0][0]
            place, _, value = self.response.follow(clipped[None], np.zeros(1), start, 0.0)
        return float(value * len(kept) / (np.sqrt(max(kept.sum(), 1)) * deviation)), place

    def _apply(self, remedy: Remedy) -> None:
        """Put the channels right from now on."""
        self.order = self.order[remedy.order]
        self.sign = self.sign[remedy.order] * remedy.sign
        self.delay = self.delay[remedy.order] + remedy.delay
        self.doubted[:] = self.held[:] = False
        self._forget()

    @property
    def faults(self) -> tuple[Fault, ...]:
        """What is known to be wrong, in the order of the microphones."""
        found: list[Fault] = []
        for c, channel in enumerate((self.order + 1).tolist()):
            if self.order[c] != c:
                found.append(Fault(channel, "swapped", microphone=c + 1))
            if self.suspected and self.suspected.order[c] != c:
                seems = int(np.flatnonzero(self.suspected.order == c)[0]) + 1
                found.append(Fault(channel, "swapped", microphone=seems, corrected=False))
            if self.sign[c] < 0.0:
                found.append(Fault(channel, "polarity"))
            if self.delay[c]:
                found.append(Fault(channel, "late", delay_s=float(self.delay[c])))
            if self.faulty[c]:
                found.append(Fault(channel, "unexplained", corrected=False))
            if self.silent[c] >= DEAD:
                found.append(Fault(channel, "dead", corrected=False))
            elif self.loud[c]:
                found.append(Fault(channel, "level", level_db=float(self.loud[c])))
        return tuple(found)


def _hypotheses(count: int, *, compact: bool) -> list[tuple[tuple[int, ...], int]]:
    """Return what each hypothesis about so many channels does to which: nothing, or one of three kinds."""
    largest_out = 3 if 7 <= count <= 8 else 2 if count <= FEW else 1
    out = [subset for size in range(1, 1 + largest_out) for subset in combinations(range(count), size)]
    largest = min(count // 2, 4 if count <= 8 else 2 if count <= FEW else 1)
    over = [subset for size in range(1, largest + 1) for subset in combinations(range(count), size)]
    least = FITTED if compact else min(FITTED, count - 1)
    kept = [(subset, OUT) for subset in out if count - len(subset) >= least]
    swapped = combinations(range(count), 2) if compact and count <= FEW else []
    return [((), OUT), *kept, *[(subset, OVER) for subset in over], *[(subset, EXCHANGED) for subset in swapped]]


_LEVEL = np.arange(-6, 7) * 0.025
_LATTICE = np.array([[x, y, z] for x in _LEVEL for y in _LEVEL for z in np.arange(-3, 4) * 0.1])
"""m: the places around a start at which hypotheses are compared."""


def _apart(places: np.ndarray, count: int, distance: float) -> list[np.ndarray]:
    """Return the first places (3,) m of (n, 3), no two of them nearer than a distance in m, so many at most."""
    chosen: list[np.ndarray] = []
    while len(places) and len(chosen) < count:
        chosen.append(places[0])
        places = places[np.linalg.norm(places - places[0], axis=1) > distance]
    return chosen
