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

ALIKE_M = 0.25, 0.8
"""m: by how much the distances between microphones may differ in arrays that are taken for the same, where a few of
them are moved and where most are: a tape errs at each of them, and most rings in rooms are nearly their mirror images,
so that echoes fit these by chance."""

FEWEST, MOST = 6, 12
"""From and up to how many channels exchanges are told."""

ENOUGH, MOMENTS, SCREENED, KEPT = 4, 6, 2, 4
"""After how many moments there may be a verdict, of how many of the latest it is, by how many the changes are screened,
and how many of them are compared then."""

CHANGES, BEAM = 4, 3
"""How many changes one after another are believed at once, and how many stories each of them goes on from."""

LEAST, DELAYED = 60.0, 30.0
"""By how much the log likelihood of the moments must rise by each change, and what of it a fitted delay costs."""

POSSIBLE, CLEAR, SURE = 0.2, (0.25, 0.3, 0.4), 5.4
"""From which `Remedy.clarity` a change may be; from which one is believed that only turns channels over, exchanges two,
or does anything else; and by how much the log likelihood must rise then for each pair of microphones. Healthy arrays in
rooms that decided had up to 0.15. Of wrong changes that no delay explained as well, whole orders had up to 0.38,
exchanges that rose by so much 0.26, and one of 0.47 rose by 4.6; every polarity from 0.21 on was wrong indeed."""

HOPELESS = -20.0
"""How the log likelihood of one moment falls where a change is not looked at any more."""

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
        clarity: the share of the log likelihood that it alone explains, with lags that may be off by microphones that
            hang elsewhere, plus the share with exact lags: what is not modelled grows with the likelihood, and with the
            number of pairs, as this does not.
        alone: whether nothing else explains the sound nearly as well.
        clear: whether it explains enough to be believed.
        certain: whether it is believed, and not one of several that do the same.
    """

    order: np.ndarray
    sign: np.ndarray
    delay: np.ndarray
    gain: float = 0.0
    clarity: float = 0.0
    alone: bool = True
    clear: bool = True
    certain: bool = True

    @property
    def changed(self) -> np.ndarray:
        """Which microphones (m,) it changes."""
        return (self.order != np.arange(len(self.order))) | (self.sign < 0.0) | (self.delay != 0.0)

    @property
    def unmoved(self) -> bool:
        """Whether each channel stays that of its microphone."""
        return bool((self.order == np.arange(len(self.order))).all())

    def alike(self, other: "Remedy", within: float = 0.00015) -> bool:
        """Tell whether another remedy does the same, to within so many s of delay, 5 cm of path by default."""
        same = (self.order == other.order).all() and (self.sign == other.sign).all()
        return bool(same and (np.abs(self.delay - other.delay) < within).all())


def turned_over(subset: tuple[int, ...], count: int) -> Remedy:
    """Return the remedy that turns some of so many channels over."""
    sign = np.ones(count)
    sign[list(subset)] = -1.0
    return Remedy(np.arange(count), sign, np.zeros(count))


def exchanged(pair: tuple[int, ...], count: int) -> Remedy:
    """Return the remedy that exchanges two of so many channels."""
    order = np.arange(count)
    order[list(pair)] = pair[::-1]
    return Remedy(order, np.ones(count), np.zeros(count))


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


@dataclass(frozen=True)
class Story:
    """Some changes one after another, and what they explain.

    Attributes:
        remedy: what they do together.
        steps: the changes.
        reached: the log likelihood of each moment (k,), the channels put right by them.
        heard: the moments as they would be heard then.
        worth: by how much the log likelihood of all moments rises by them.
    """

    remedy: Remedy
    steps: tuple[Remedy, ...]
    reached: np.ndarray
    heard: Moments
    worth: float = 0.0

    @property
    def merit(self) -> float:
        """What it is worth beyond what its changes must be worth to be believed."""
        return self.worth - LEAST * len(self.steps)


class Rewiring:
    """The changes of one array's wiring that can be told.

    Args:
        response: of the array.
        speed: m/s, of sound.
    """

    def __init__(self, response: SteeredResponse, speed: float):
        self.response, self.speed = response, speed
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

        It is certain where nothing else explains the sound and it is `CLEAR`; else it is possible. It changes nothing
        where it is certain that nothing is to be changed.
        """
        nothing, heard = turned_over((), self.count), heard.clearest
        best = start = Story(nothing, (), self._agreement(nothing, heard), heard)
        beam, singles = [start], list[Story]()
        for level in range(CHANGES):
            longer = sorted((one for story in beam for one in self._continued(story)), key=lambda one: -one.worth)
            if level == 0:
                singles = longer
                if not longer or longer[0].worth < HOPELESS * len(heard.gccs):
                    return nothing
            beam = _likeliest(longer)
            if not beam:
                break
            best = max([best, *beam], key=lambda one: one.merit)
        gain = best.reached - start.reached
        if best is start or (gain <= 0.0).sum() > len(gain) // 3:
            return None
        twins = self._twins(best.remedy)
        others = [one.worth for one in singles if not any(one.remedy.alike(step) for step in (*best.steps, *twins))]
        alone = max(others, default=0.0) <= RIVAL * best.worth
        for step in best.steps:
            told, sure = self._late(best, step, start)
            alone &= sure
            if told is not best:
                return self._judged(told, heard, alone=alone)
        return self._judged(best, heard, alone=alone)

    def _judged(self, story: Story, heard: Moments, *, alone: bool) -> Remedy | None:
        """Return the remedy of a story where it explains enough.

        Args:
            story: the likeliest one.
            heard: the moments.
            alone: whether no single change explains them nearly as well.
        """
        nothing, delays = turned_over((), self.count), np.count_nonzero(story.remedy.delay)
        fitted = [self._settled(one).sum() for one in (story.heard, heard)]
        worth = min(story.worth, float(fitted[0] - fitted[1])) - DELAYED * delays
        if worth < LEAST:
            return None
        found = self._likelier(story.remedy, self._twins(story.remedy), heard)
        # That each lag counts as much as others near it hides that a wrong order fits nowhere exactly.
        exact = [self._agreement(one, heard, pooled=False).sum() for one in (found, nothing)]
        clarity = float((worth + exact[0] - exact[1]) / fitted[0])
        if exact[0] <= exact[1] or clarity < POSSIBLE:
            return None
        late = np.abs(story.remedy.delay[story.remedy.delay != 0.0]) * self.speed
        # A place takes three of the differences, and as many judge the delays; short ones are of misplaced microphones.
        moved = int((found.order != np.arange(self.count)).sum()) if delays else 0  # as good as so many delays
        fitting = delays + moved <= (self.count - 4) // 2 and (late > FARTHEST_M).all()
        merely = not replace(found, delay=np.zeros(self.count)).changed.any()  # `Health` tells one that is merely late
        alone = alone and bool(fitting) and not merely
        reordered = int((found.order != np.arange(self.count)).sum())
        least = CLEAR[2 if delays else min(reordered // 2, 2)]
        clear = clarity >= least and bool(worth >= SURE * self._pairs(heard))
        certain = found.certain and alone and clear
        return replace(found, gain=worth, clarity=clarity, alone=alone, clear=clear, certain=certain)

    def _twins(self, remedy: Remedy) -> list[Remedy]:
        """Return what a remedy does together with each order that leaves the distances alike."""
        even, on_time = np.ones(self.count), np.zeros(self.count)
        return [_after(remedy, Remedy(order, even, on_time)) for order in self.twins]

    def _continued(self, story: Story) -> list[Story]:
        """Return a story with each of the likeliest changes after it."""
        found = []
        for change in self._likely(story):
            heard = self._put_right(change, story.heard)
            reached, places = self._answer(heard)
            if self._told(change, places):
                worth = story.worth + float((reached - story.reached).sum())
                found.append(Story(_after(story.remedy, change), (*story.steps, change), reached, heard, worth))
        return found

    def _likely(self, story: Story) -> list[Remedy]:
        """Return the changes after which the log likelihood of the first moments rises most, `KEPT` at most.

        The order is changed once at most: of many orders one after another some fit by chance.
        """
        heard, reached = story.heard, story.reached
        ordered = (story.remedy.order != np.arange(self.count)).any()
        changes = [one for one in self.changes if not ordered or (one.sign < 0.0).any()]
        wide = [self._ladders(gcc, heard) for gcc in heard.gccs[:SCREENED]]
        found: list[tuple[float, int]] = []
        bounds = [self._bounds(change, reached, wide, heard) for change in changes]
        for k in sorted(range(len(bounds)), key=lambda k: -bounds[k].sum()):
            least = sorted(found)[-KEPT][0] if len(found) >= KEPT else 0.0
            if bounds[k].sum() < least or bounds[k][0] < HOPELESS:
                continue
            gain = bounds[k]
            for i, ladders in enumerate(wide):
                ladder = self._taken(changes[k], ladders, heard.good)
                need = max(least - (gain.sum() - gain[i]), HOPELESS if i == 0 else -np.inf)
                enough = self._response(reached[i] + need, heard)
                answer = self.rough.search(ladder[:, 0], ladder=ladder, least=enough)[1]
                gain[i] = self._likelihood(answer[:1], heard)[0] - reached[i] if len(answer) else -np.inf
                if gain.sum() < least or gain[0] < HOPELESS:
                    break
            else:
                found.append((float(gain.sum()), k))
        return [changes[k] for gain, k in sorted(found, reverse=True)[:KEPT] if gain > 0.0]

    def _bounds(self, change: Remedy, reached: np.ndarray, wide: list[np.ndarray], heard: Moments) -> np.ndarray:
        """Return by how much the log likelihood of each of the first moments rises at most, (k,).

        Args:
            change: of the channels.
            reached: the log likelihood of each moment (k,) without it.
            wide: ladders of the first moments, see `_ladders`.
            heard: the moments.
        """
        most = np.array([self.rough.most(self._taken(change, ladders, heard.good)) for ladders in wide])
        return self._likelihood(most, heard) - reached[: len(wide)]

    def _likelier(self, best: Remedy, twins: list[Remedy], heard: Moments) -> Remedy:
        """Return the one of remedies between which distances hardly tell that moves the channels least."""
        if best.changed.sum() <= self.count // 2 and not twins:
            return best
        exact = {id(one): float(self._agreement(one, heard, pooled=False).sum()) for one in (best, *twins)}
        least = min([best, *twins], key=lambda one: (_effort(one), -exact[id(one)]))
        certain = True
        if least.changed.sum() > self.count // 2:  # all are moved by either of them
            most = exact[id(least)]
            rest = [one for one in (best, *twins) if one is not least]
            certain = all(exact[id(one)] <= most * (1.0 if _effort(one) > _effort(least) else RIVAL) for one in rest)
        return replace(least, certain=certain)

    def _settled(self, heard: Moments) -> np.ndarray:
        """Return the log likelihood of each moment (k,), each microphone moved to where it is heard to hang."""
        reach = round(FARTHEST_M * self.response.steps_per_metre)
        offset, best = np.zeros(self.count, np.intp), np.zeros(len(heard.gccs))
        for _ in range(1 + FITS):
            found, lagged = np.zeros(len(heard.gccs)), np.zeros((self.count, 2 * reach + 1))
            for k, gcc in enumerate(self._clipped(heard)):
                places, values = self.rough.search(self._pooled(self._moved(gcc, offset)))
                found[k] = values[0]
                lagged += self._lagged(gcc, places[:1], offset, reach)
            best = np.maximum(best, found)
            offset = lagged.argmax(axis=1) - reach
        return self._likelihood(best, heard)

    def _late(self, story: Story, step: Remedy, start: Story) -> tuple[Story, bool]:
        """Return the story, with delays in place of a step where they explain more, and whether one is far better.

        Two channels that are exchanged sound as if one were late and the other early by as much, and one delay explains
        only a part of it: two others must explain much more. So must one in place of a wrong polarity, which has
        nothing that could be fitted.
        """
        changed = np.flatnonzero(step.changed)
        if len(changed) > 2:
            return story, True
        rest = turned_over((), self.count)
        for one in story.steps:
            rest = rest if one is step else _after(rest, one)
        heard = self._put_right(rest, start.heard)
        far = np.isin(self.response.first, changed) | np.isin(self.response.second, changed)
        late = self._lateness(heard, changed, ~far)
        before = float(self._answer(heard)[0].sum())
        told = [self._delayed(story, rest, late, channels, start) for channels in (*changed[:, None], changed)]
        gain = float(story.reached.sum()) - before
        explained = [float(one.reached.sum()) - before for one in told]
        best = int(np.argmax(explained[:-1]))
        much = 1.0 / RIVAL if len(changed) == 1 else 1.0
        opposite = len(changed) == 2 and abs(late[changed].sum()) * self.speed < TOLD_M
        if explained[best] > much * gain:
            channels = changed[best : best + 1]
        elif RIVAL * explained[-1] > gain and not opposite:
            channels = changed
        else:
            return story, explained[best] <= RIVAL * much * gain
        found = self._delayed(story, rest, late, channels, start)
        late = late + self._lateness(found.heard, channels, np.ones_like(far))  # the whole array tells places better
        again = self._delayed(story, rest, late, channels, start)
        return max(found, again, key=lambda one: one.worth), True

    def _delayed(self, story: Story, rest: Remedy, late: np.ndarray, channels: np.ndarray, start: Story) -> Story:
        """Return a story of which some channels are late in s (m,) besides the rest of what is done."""
        late = np.where(np.isin(np.arange(self.count), channels), rest.delay + late, rest.delay)
        remedy = replace(rest, delay=late)
        heard = self._put_right(remedy, start.heard)
        reached = self._answer(heard)[0]
        worth = story.worth + float((reached - story.reached).sum())
        return Story(remedy, story.steps, reached, heard, worth)

    def _lateness(self, heard: Moments, channels: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return by how many s some channels are late, (m,), judged by the places on which kept pairs agree."""
        half = self.response.half_lags
        lagged = np.zeros((self.count, 2 * half + 1))
        for gcc in self._clipped(heard):
            place = self.rough.search(self._pooled(gcc * kept[:, None]))[0][:1]
            lagged += self._lagged(gcc, place, np.zeros(self.count, np.intp), half)
        late = (lagged.argmax(axis=1) - half) / self.response.steps_per_metre / self.speed
        return np.where(np.isin(np.arange(self.count), channels), late, 0.0)

    def _moved(self, gcc: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the GCCs (pairs, lags) of microphones whose ways are longer by offset (m,) lag steps."""
        at = np.arange(gcc.shape[1]) + (offset[self.response.first] - offset[self.response.second])[:, None]
        inside = (at >= 0) & (at < gcc.shape[1])
        return np.take_along_axis(gcc, np.clip(at, 0, gcc.shape[1] - 1), axis=1) * inside

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
            found += (np.arange(self.count)[:, None] == side) @ (values * inside)
        return found

    def _told(self, change: Remedy, places: np.ndarray) -> bool:
        """Tell whether a change matters to the sound of places (k, 3) m."""
        moved = change.order != np.arange(self.count)
        ranges = np.linalg.norm(places[:, None] - self.response.microphones, axis=2)
        ways = np.sqrt(((ranges[:, change.order] - ranges) ** 2).mean(axis=0))[moved]
        return not moved.any() or bool(np.median(ways) > TOLD_M)

    def _agreement(self, remedy: Remedy, heard: Moments, *, pooled: bool = True) -> np.ndarray:
        """Return the log likelihood of each moment (k,), the channels put right."""
        return self._answer(self._put_right(remedy, heard), pooled=pooled)[0]

    def _answer(self, heard: Moments, *, pooled: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Return the log likelihood of each moment (k,), and its place (k, 3) m."""
        found, places = np.zeros(len(heard.gccs)), np.zeros((len(heard.gccs), 3))
        for k, gcc in enumerate(self._clipped(heard)):
            at, values = self.rough.search(self._pooled(gcc)) if pooled else self.response.search(gcc)
            found[k], places[k] = values[0], at[0]
        return self._likelihood(found, heard), places

    def _likelihood(self, found: np.ndarray, heard: Moments) -> np.ndarray:
        """Return the log likelihood (k,) of responses (k,)."""
        return 0.5 * (np.maximum(found, 0.0) / self._scale(heard)) ** 2

    def _response(self, likelihood: float, heard: Moments) -> float:
        """Return a response below which the log likelihood is less."""
        return (1.0 - 1e-6) * self._scale(heard) * np.sqrt(2.0 * likelihood) if likelihood > 0.0 else -np.inf

    def _scale(self, heard: Moments) -> float:
        """Return the deviation of the response of noise at one place."""
        return float(heard.deviation * np.sqrt(max(self._pairs(heard), 1)) / len(self.response.first))

    def _pairs(self, heard: Moments) -> int:
        """Return of how many pairs both channels are used."""
        return int((heard.good[self.response.first] & heard.good[self.response.second]).sum())

    def _put_right(self, remedy: Remedy, heard: Moments) -> Moments:
        """Return the moments as they would be heard, the channels put right."""
        gccs = [self._taken(remedy, np.stack([gcc, -gcc])[:, :, None], heard.good)[:, 0] for gcc in heard.gccs]
        offset = np.rint(remedy.delay * self.speed * self.response.steps_per_metre).astype(np.intp)
        if offset.any():
            gccs = [self._moved(gcc, offset) for gcc in gccs]
        return replace(heard, gccs=gccs, good=heard.good[remedy.order])

    def _clipped(self, heard: Moments) -> list[np.ndarray]:
        """Return the GCCs (pairs, lags) of the moments, cut off well above their noise."""
        return [np.minimum(gcc, np.float32(10.0 * heard.deviation)) for gcc in heard.gccs]

    def _ladders(self, gcc: np.ndarray, heard: Moments) -> np.ndarray:
        """Return ladders of clipped and pooled GCCs and of those of channels turned over, (2, pairs, rungs, lags)."""
        clipped = np.minimum([gcc, -gcc], np.float32(10.0 * heard.deviation))
        return np.stack([self.rough.ladder(self._pooled(one)) for one in clipped])

    def _taken(self, remedy: Remedy, both: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Return of ladders and those of channels turned over, (2, pairs, rungs, lags), those of pairs put right.

        good: (m,) bool, the channels that are used.
        """
        first, second = remedy.order[self.response.first], remedy.order[self.response.second]
        over = remedy.sign[self.response.first] * remedy.sign[self.response.second] < 0.0
        taken = both[over.astype(np.intp), self.row[first, second]]
        turned = np.flatnonzero(first > second)
        for level in range(both.shape[2]):  # a rung that begins at a lag ends so many lags further
            end = both.shape[3] + 1 - (1 << level)
            taken[turned, level, :end] = taken[turned, level, :end][:, ::-1]
        taken[~(good[first] & good[second])] = 0.0
        return taken


def _after(one: Remedy, other: Remedy) -> Remedy:
    """Return what one remedy and then another do."""
    return Remedy(one.order[other.order], one.sign[other.order] * other.sign, one.delay[other.order] + other.delay)


def _likeliest(stories: list[Story]) -> list[Story]:
    """Return those of stories, the best first, from which it is worth going on, no two of the same remedy."""
    found: list[Story] = []
    for one in stories:
        likely = one.worth >= 0.5 * LEAST * len(one.steps)
        if likely and len(found) < BEAM and not any(one.remedy.alike(other.remedy) for other in found):
            found.append(one)
    return found


def _effort(remedy: Remedy) -> int:
    """Return how far channels are moved in all, around the array."""
    count = len(remedy.order)
    moved = (remedy.order - np.arange(count)) % count
    return int(np.minimum(moved, count - moved).sum())


def _exchanges(count: int) -> list[np.ndarray]:
    """Return the orders (m,) in which two of so many channels are exchanged."""
    return [exchanged(pair, count).order for pair in combinations(range(count), 2)]


def _renumbered(count: int) -> list[np.ndarray]:
    """Return the orders (m,) in which channels are moved on, counted backwards, or left and right are exchanged."""
    whole = np.arange(count)
    shifts = range(1, count) if count <= MOST else (1, count - 1)
    backwards = range(count) if count <= MOST else (0,)
    sides = whole.copy()
    sides[: count // 2 * 2] = sides[: count // 2 * 2].reshape(-1, 2)[:, ::-1].ravel()
    return [*(np.roll(whole, k) for k in shifts), *(np.roll(whole[::-1], k) for k in backwards), sides]
