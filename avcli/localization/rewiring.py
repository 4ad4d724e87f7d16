"""Which channel is which microphone's, and of which polarity: found by how well all pairs agree on places.

Channels that are exchanged, moved on or turned over still agree in part, so that leaving them out tells little. Here
the whole array, rewired, is searched for the place that it agrees on, moment after moment, and that agreement is
compared with the array's as it is. Microphones that hang some centimetres from where they are said to be lower the
agreement too, and a wrong wiring may fit them by chance: therefore each lag counts as much as the largest within the
reach of such an error, each microphone may be moved to where it is heard to hang, with the change and without it, and
delays are tried instead. What leaves all distances between the microphones alike cannot be told by sound alone.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from avcli.localization.srp import SteeredResponse, dilated

PLACED_M, FARTHEST_M, FITS = 0.05, 0.15, 2
"""m: the error of a range difference up to which a lag still counts in full; how far from where it is said to be a
microphone may be heard to hang before a change is believed; and how often that is fitted."""

ROUGH = 4
"""Of how many lag steps one is looked at where each stands for all within `PLACED_M`."""

TOLD_M = 0.3
"""m: by how much an exchange changes the ways of the sound at least: less looks like misplaced microphones."""

ALIKE_M = 0.25, 0.5
"""m: by how much the distances between microphones may differ in arrays that are taken for the same, where a few of
them are moved and where most are: a tape errs at each of them."""

FEWEST, MOST = 6, 12
"""From and up to how many channels exchanges are told."""

ENOUGH, MOMENTS, SCREENED, KEPT = 4, 6, 2, 4
"""After how many moments there may be a verdict, of how many of the latest it is, by how many the changes are screened,
and how many of them are compared then."""

CHANGES = 4
"""How many changes one after another are believed at once."""

OVERWHELMING = 120.0
POSSIBLE = 0.5 * OVERWHELMING
"""By how much the log likelihood of the moments must rise by a change that is believed, and that may be."""

HOPELESS = -20.0
"""How the log likelihood of one moment falls where a change is not looked at any more."""

SHARE = 0.1
"""The least share of the log likelihood that a change explains: what is not modelled grows with it."""

RIVAL = 0.8
"""The share of its gain that another change may reach at most."""


@dataclass(frozen=True)
class Remedy:
    """A change of the channels that may put them right.

    Attributes:
        order: (m,) which channel is taken for each microphone, of those as they are now.
        sign: (m,) by which it is multiplied.
        delay: (m,) s by which it is late.
        gain: of the log likelihood over the array as it is.
        certain: whether it is believed, and not one of several that do the same.
    """

    order: np.ndarray
    sign: np.ndarray
    delay: np.ndarray
    gain: float = 0.0
    certain: bool = True

    @property
    def changed(self) -> np.ndarray:
        """Which microphones (m,) it changes."""
        return (self.order != np.arange(len(self.order))) | (self.sign < 0.0) | (self.delay != 0.0)

    def alike(self, other: "Remedy") -> bool:
        """Tell whether another remedy does the same, to within 5 cm of path."""
        same = (self.order == other.order).all() and (self.sign == other.sign).all()
        return bool(same and (np.abs(self.delay - other.delay) < 0.00015).all())


def turned_over(subset: tuple[int, ...], count: int) -> Remedy:
    """Return the remedy that turns some of so many channels over."""
    sign = np.ones(count)
    sign[list(subset)] = -1.0
    return Remedy(np.arange(count), sign, np.zeros(count))


@dataclass(frozen=True)
class Moments:
    """What was heard at some moments that share no window.

    Attributes:
        gccs: (pairs, lags) of each, as much as one window's.
        good: (m,) bool, the channels that are used.
        deviation: of a GCC of noise.
    """

    gccs: list[np.ndarray]
    good: np.ndarray
    deviation: float

    @property
    def clearest(self) -> "Moments":
        """The same moments, those first at which pairs correlate most, wherever that is: others may be of noise."""
        clear = [float(np.minimum(gcc, 10.0 * self.deviation).max(axis=1).sum()) for gcc in self.gccs]
        return replace(self, gccs=[self.gccs[k] for k in np.argsort(clear)[::-1]])


class Rewiring:
    """The changes of one array's wiring that can be told.

    Args:
        response: of the array.
    """

    def __init__(self, response: SteeredResponse):
        self.response = response
        self.count = count = len(response.microphones)
        self.reach = round(PLACED_M * response.steps_per_metre)
        self.rough = SteeredResponse(
            response.microphones, response.low, response.high, response.steps_per_metre / ROUGH, resolution=PLACED_M
        )
        lag = response.half_lags + ROUGH * np.arange(-self.rough.half_lags, self.rough.half_lags + 1)
        self.looked = np.clip(lag, 0, response.lag_count - 1)
        self.row = np.zeros((count, count), np.intp)
        self.row[response.first, response.second] = self.row[response.second, response.first] = np.arange(
            len(response.first)
        )
        away = np.linalg.norm(response.microphones[:, None] - response.microphones, axis=2)
        orders = [*_exchanges(count), *_renumbered(count)] if count <= MOST else _renumbered(count)
        alike = [
            np.abs(away[np.ix_(order, order)] - away).max()
            < ALIKE_M[int((order != np.arange(count)).sum() > count // 2)]
            for order in orders
        ]
        self.twins = [order for order, same in zip(orders, alike, strict=True) if same]
        over = [turned_over((c,), count) for c in range(count)] if count <= MOST else []
        even, on_time = np.ones(count), np.zeros(count)
        told = [Remedy(order, even, on_time) for order, same in zip(orders, alike, strict=True) if not same]
        self.changes = [*told, *over] if count >= FEWEST else []

    def find(self, heard: Moments) -> Remedy | None:
        """Return the remedy under which the array agrees better by far than as it is, if any.

        It is certain where nothing else explains the sound, and gains less than `OVERWHELMING` where it is possible.
        It changes nothing where it is certain that nothing is to be changed.
        """
        heard = heard.clearest
        best = turned_over((), self.count)
        reached = start = self._agreement(best, heard)
        steps: list[Remedy] = []
        rivals: list[tuple[float, Remedy]] = []
        wide = [self._ladders(gcc, heard) for gcc in heard.gccs[:SCREENED]]
        for _ in range(CHANGES):
            likely = self._likely(best, reached, wide, heard)
            answers = [(one, *self._answer(_after(best, one), heard)) for one in likely]
            tried = [(one, value) for one, value, places in answers if self._told(one, places)]
            if not steps:
                rivals = [(float((value - start).sum()), one) for one, value in tried]
            if not steps and max((worth for worth, _ in rivals), default=-np.inf) < HOPELESS * len(heard.gccs):
                return best
            if not tried:
                break
            step, value = max(tried, key=lambda found: float(found[1].mean()))
            gain = value - reached
            if gain.sum() < POSSIBLE or (gain <= 0.0).sum() > len(heard.gccs) // 3:
                break
            best, reached = _after(best, step), value
            steps.append(step)
        gain = float((reached - start).sum())
        if gain < POSSIBLE:
            return None
        twins = [_after(best, Remedy(order, np.ones(self.count), np.zeros(self.count))) for order in self.twins]
        others = [worth for worth, one in rivals if not any(one.alike(known) for known in (*steps, *twins))]
        if max(others, default=0.0) > RIVAL * gain:
            return None
        few = [step for step in steps if step.changed.sum() <= 2]
        if any(self._late(steps, step, float(reached.sum()), heard) for step in few):
            return None
        fitted = [self._settled(one, heard) for one in (best, turned_over((), self.count))]
        gain = min(gain, float((fitted[0] - fitted[1]).sum()))
        if gain < max(POSSIBLE, SHARE * fitted[0].sum()):
            return None
        return self._likelier(replace(best, gain=gain), twins, heard)

    def _likely(self, best: Remedy, reached: np.ndarray, wide: list[np.ndarray], heard: Moments) -> list[Remedy]:
        """Return the changes after which the log likelihood of the first moments rises most, `KEPT` at most.

        Args:
            best, reached: a remedy, and the log likelihood of each moment (k,) by it.
            wide: ladders of the first moments, see `_ladders`.
            heard: the moments.
        """
        found: list[tuple[float, int]] = []
        bounds = [self._bounds(_after(best, one), reached, wide, heard) for one in self.changes]
        for k in sorted(range(len(bounds)), key=lambda k: -bounds[k].sum()):
            least = sorted(found)[-KEPT][0] if len(found) >= KEPT else 0.0
            if bounds[k].sum() < least or bounds[k][0] < HOPELESS:
                continue
            gain, remedy = bounds[k], _after(best, self.changes[k])
            for i, ladders in enumerate(wide):
                ladder = self._taken(remedy, ladders, heard)
                need = max(least - (gain.sum() - gain[i]), HOPELESS if i == 0 else -np.inf)
                enough = self._response(reached[i] + need, remedy, heard)
                answer = self.rough.search(ladder[:, 0], ladder=ladder, least=enough)[1]
                gain[i] = self._likelihood(answer[:1], remedy, heard)[0] - reached[i] if len(answer) else -np.inf
                if gain.sum() < least or gain[0] < HOPELESS:
                    break
            else:
                found.append((float(gain.sum()), k))
        return [self.changes[k] for gain, k in sorted(found, reverse=True)[:KEPT] if gain > 0.0]

    def _bounds(self, remedy: Remedy, reached: np.ndarray, wide: list[np.ndarray], heard: Moments) -> np.ndarray:
        """Return by how much the log likelihood of each of the first moments rises at most, (k,)."""
        most = np.array([self.rough.most(self._taken(remedy, ladders, heard)) for ladders in wide])
        return self._likelihood(most, remedy, heard) - reached[: len(wide)]

    def _likelier(self, best: Remedy, twins: list[Remedy], heard: Moments) -> Remedy:
        """Return the one of remedies between which distances do not tell that moves the channels least."""
        least = min([best, *twins], key=_effort)
        others = [one for one in (best, *twins) if one is not least]
        certain = best.gain >= OVERWHELMING
        if certain and least.changed.sum() > self.count // 2:  # all are moved by either of them
            plain = [self._agreement(one, heard, pooled=False).sum() for one in (least, *others)]
            certain = all(_effort(one) > _effort(least) for one in others) and plain[0] >= max(plain)
        return replace(least, gain=best.gain, certain=bool(certain))

    def _settled(self, remedy: Remedy, heard: Moments) -> np.ndarray:
        """Return the log likelihood of each moment (k,), each microphone moved to where it is heard to hang."""
        reach = round(FARTHEST_M * self.response.steps_per_metre)
        rewired = [self._rewired(remedy, gcc, heard) for gcc in heard.gccs]
        offset, best = np.zeros(self.count, np.intp), np.zeros(len(heard.gccs))
        for _ in range(1 + FITS):
            found, lagged = np.zeros(len(heard.gccs)), np.zeros((self.count, 2 * reach + 1))
            for k, gcc in enumerate(rewired):
                places, values = self.rough.search(self._moved(gcc, offset))
                found[k] = values[0]
                lagged += self._lagged(gcc, places[:1], offset, reach)
            best = np.maximum(best, found)
            offset = lagged.argmax(axis=1) - reach
        return self._likelihood(best, remedy, heard)

    def _late(
        self,
        steps: list[Remedy],
        step: Remedy,
        reached: float,
        heard: Moments,
    ) -> bool:
        """Tell whether delays explain the sound better than a step, which reached so much, or one nearly as well.

        Two channels that are exchanged sound as if both were late, and one delay explains only a part of it.
        """
        rest = turned_over((), self.count)
        for one in steps:
            rest = rest if one is step else _after(rest, one)
        rewired = [self._rewired(rest, gcc, heard) for gcc in heard.gccs]
        changed, half = np.flatnonzero(step.changed), self.response.half_lags
        others = ~(np.isin(self.response.first, changed) | np.isin(self.response.second, changed))[:, None]
        lagged = np.zeros((self.count, 2 * half + 1))
        for gcc in rewired:
            place = self.rough.search(self._pooled(gcc * others))[0][:1]
            lagged += self._lagged(gcc, place, np.zeros(self.count, np.intp), half)
        late = lagged.argmax(axis=1) - half
        likelihood = float(self._agreement(rest, heard).sum())
        explained = []
        for channels in (*changed[:, None], changed):
            offset = np.where(np.isin(np.arange(self.count), channels), late, 0)
            found = np.array([self.rough.search(self._moved(gcc, offset))[1][0] for gcc in rewired])
            explained.append(float(self._likelihood(found, rest, heard).sum()) - likelihood)
        gain = reached - likelihood
        return max(explained[:-1]) > RIVAL * gain or RIVAL * explained[-1] > gain

    def _moved(self, gcc: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the pooled GCCs (pairs, lags) of microphones whose ways are longer by offset (m,) lag steps."""
        shift = (offset[self.response.first] - offset[self.response.second])[:, None]
        at = np.clip(np.arange(gcc.shape[1]) + shift, 0, gcc.shape[1] - 1)
        return self._pooled(np.take_along_axis(gcc, at, axis=1))

    def _pooled(self, gcc: np.ndarray) -> np.ndarray:
        """Return the largest value around each lag of GCCs (pairs, lags), as the rough response takes them."""
        return dilated(gcc[None], self.reach)[0].take(self.looked, axis=1)

    def _lagged(self, gcc: np.ndarray, place: np.ndarray, offset: np.ndarray, reach: int) -> np.ndarray:
        """Return how each microphone agrees with the others on a place (1, 3) m, so late or early, (m, 2 reach + 1)."""
        response, found = self.response, np.zeros((self.count, 2 * reach + 1))
        first, second = response.first, response.second
        lag = np.rint(response.lags(place)).astype(np.intp) + response.half_lags
        late = np.arange(-reach, reach + 1)
        for side, other, turn in ((first, second, 1), (second, first, -1)):
            at = lag + turn * (late - offset[other][:, None])
            inside = (at >= 0) & (at < gcc.shape[1])
            values = np.take_along_axis(gcc, np.clip(at, 0, gcc.shape[1] - 1), axis=1)
            np.add.at(found, side, values * inside)
        return found

    def _told(self, change: Remedy, places: np.ndarray) -> bool:
        """Tell whether a change matters to the sound of places (k, 3) m."""
        moved = change.order != np.arange(self.count)
        ranges = np.linalg.norm(places[:, None] - self.response.microphones, axis=2)
        ways = np.sqrt(((ranges[:, change.order] - ranges) ** 2).mean(axis=0))[moved]
        return not moved.any() or bool(np.median(ways) > TOLD_M)

    def _agreement(self, remedy: Remedy, heard: Moments, *, pooled: bool = True) -> np.ndarray:
        """Return the log likelihood of each moment (k,), the channels put right."""
        return self._answer(remedy, heard, pooled=pooled)[0]

    def _answer(self, remedy: Remedy, heard: Moments, *, pooled: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return the log likelihood of each moment (k,), the channels put right, and its place (k, 3) m."""
        found, places = np.zeros(len(heard.gccs)), np.zeros((len(heard.gccs), 3))
        for k, gcc in enumerate(heard.gccs):
            clipped = self._rewired(remedy, gcc, heard)
            at, values = self.rough.search(self._pooled(clipped)) if pooled else self.response.search(clipped)
            found[k], places[k] = values[0], at[0]
        return self._likelihood(found, remedy, heard), places

    def _likelihood(self, found: np.ndarray, remedy: Remedy, heard: Moments) -> np.ndarray:
        """Return the log likelihood (k,) of responses (k,) of an array that is put right."""
        return 0.5 * (np.maximum(found, 0.0) / self._scale(remedy, heard)) ** 2

    def _response(self, likelihood: float, remedy: Remedy, heard: Moments) -> float:
        """Return a response below which the log likelihood of an array that is put right is less."""
        return (1.0 - 1e-6) * self._scale(remedy, heard) * np.sqrt(2.0 * likelihood) if likelihood > 0.0 else -np.inf

    def _scale(self, remedy: Remedy, heard: Moments) -> float:
        """Return the deviation of the response of noise at one place."""
        good = heard.good[remedy.order]
        kept = good[self.response.first] & good[self.response.second]
        return heard.deviation * np.sqrt(max(kept.sum(), 1)) / len(kept)

    def _rewired(self, remedy: Remedy, gcc: np.ndarray, heard: Moments) -> np.ndarray:
        """Return the GCC of each pair of microphones (pairs, lags), clipped, the channels put right."""
        return self._taken(remedy, np.minimum([gcc, -gcc], 10.0 * heard.deviation)[:, :, None], heard)[:, 0]

    def _ladders(self, gcc: np.ndarray, heard: Moments) -> np.ndarray:
        """Return ladders of clipped and pooled GCCs and of those of channels turned over, (2, pairs, rungs, lags)."""
        clipped = np.minimum([gcc, -gcc], 10.0 * heard.deviation)
        return np.stack([self.rough.ladder(self._pooled(one)) for one in clipped])

    def _taken(self, remedy: Remedy, both: np.ndarray, heard: Moments) -> np.ndarray:
        """Return of ladders and those of channels turned over, (2, pairs, rungs, lags), those of pairs put right."""
        first, second = remedy.order[self.response.first], remedy.order[self.response.second]
        over = remedy.sign[self.response.first] * remedy.sign[self.response.second] < 0.0
        taken = both[over.astype(np.intp), self.row[first, second]]
        turned = np.flatnonzero(first > second)
        for level in range(both.shape[2]):  # a rung that begins at a lag ends so many lags further
            end = both.shape[3] + 1 - (1 << level)
            taken[turned, level, :end] = taken[turned, level, :end][:, ::-1]
        taken[~(heard.good[first] & heard.good[second])] = 0.0
        return taken


def _after(one: Remedy, other: Remedy) -> Remedy:
    """Return what one remedy and then another do."""
    return Remedy(one.order[other.order], one.sign[other.order] * other.sign, one.delay[other.order] + other.delay)


def _effort(remedy: Remedy) -> int:
    """Return how far channels are moved in all, around the array."""
    count = len(remedy.order)
    moved = (remedy.order - np.arange(count)) % count
    return int(np.minimum(moved, count - moved).sum())


def _exchanges(count: int) -> list[np.ndarray]:
    """Return the orders (m,) in which two of so many channels are exchanged."""
    orders = []
    for one, other in combinations(range(count), 2):
        order = np.arange(count)
        order[[one, other]] = other, one
        orders.append(order)
    return orders


def _renumbered(count: int) -> list[np.ndarray]:
    """Return the orders (m,) in which channels are moved on, counted backwards, or left and right are exchanged."""
    whole = np.arange(count)
    shifts = range(1, count) if count <= MOST else (1, count - 1)
    backwards = range(count) if count <= MOST else (0,)
    sides = whole.copy()
    sides[: count // 2 * 2] = sides[: count // 2 * 2].reshape(-1, 2)[:, ::-1].ravel()
    return [*(np.roll(whole, k) for k in shifts), *(np.roll(whole[::-1], k) for k in backwards), sides]
