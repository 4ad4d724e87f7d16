"""Joint associations of people with the detections of one record: ranked, exact where few and bounded where many."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import itemgetter, or_

import numpy as np

from avcli.tracking.hypotheses import ABSENT, Cluster, Joint
from avcli.tracking.scan import Scan

MISSED = -1  # in the place of a detection: the person was not detected
STRAY = -3  # STRAY - j in its place: detection j is the person's, and lies somewhere near: it says nothing of the place
PRUNE = 1e-3  # weight of a joint hypothesis relative to the best
LOG_PRUNE = math.log(PRUNE)
BUDGET = 3  # partial associations kept while searching, for each hypothesis that is kept in the end
LARGE = 50  # labels of a cluster, beyond which it keeps fewer hypotheses in proportion, so that time is bounded
MANY = 6  # labels that compete, beyond which clusters that do so with a probability below PRUNE are not joined
ROUNDS, SETTLED, MOST_LIKELY = 20, 1e-3, 1e9  # of belief propagation: at most so many; change; ratio of likelihoods
BID = 0.02  # nats by which a bid for a detection exceeds what it is worth, so that bidding ends
SURE = 0.9  # existence of a person by whom the detection probability is learnt

FIRST = itemgetter(0)
NOTHING = (0.0, MISSED)  # the only option of a person who does not exist

Option = tuple[float, int]  # log weight, detection, MISSED, or STRAY less a detection
Options = Mapping[int, Sequence[Option]]  # by row, best first
Pair = tuple[int, int]  # row, the same
Chain = tuple[()] | tuple["Chain", Pair]  # pairs of the first labels, the last one outermost: shared, so not copied
Association = tuple[float, tuple[Pair, ...], int]  # log weight, a pair for each label, bit set of used detections


@dataclass(slots=True)
class Hypothesis:
    """One joint hypothesis after a record, before its densities are computed.

    Attributes:
        weight: log weight.
        pairs: for each label the row before the record and the detection: (ABSENT, MISSED), or the row of a person who
            has just been born and `births.BORN`.
        used: bit set of the detections that it uses.
    """

    weight: float
    pairs: tuple[Pair, ...]
    used: int


@dataclass(slots=True)
class Group:
    """The joint hypotheses, best first, about the labels of clusters that competed for detections."""

    labels: list[int]
    hypotheses: list[Hypothesis]

    def used(self) -> list[int]:
        """Return the detections that some hypothesis uses."""
        return _bits(reduce(or_, [hypothesis.used for hypothesis in self.hypotheses]))


def options(scan: Scan, rows: Iterable[int], background: Sequence[float]) -> dict[int, list[Option]]:
    """Find what each labelled row may have caused.

    Args:
        scan: the record.
        rows: of labelled people.
        background: J densities per m² of detections that no labelled person causes.

    Returns:
        Row -> [(log weight, detection or MISSED)], best first.
    """
    caused_by = {}
    existence, p_detect, likelihoods = scan.existence, scan.p_detect, scan.likelihoods
    for row in rows:
        present = existence[row] * scan.p_hit[row]
        missed = max(1 - existence[row] * p_detect[row], 1e-12)
        least = missed * PRUNE  # the same hypothesis but for a miss is likelier by so much
        caused = [
            (math.log(present * g / background[j]), j)
            for j, g in likelihoods[row]
            if present * g > least * background[j]
        ]
        caused += [
            (math.log(present * g / background[j]), STRAY - j)
            for j, g in scan.strays.get(row, ())
            if present * g > least * background[j]
        ]
        caused_by[row] = sorted([(math.log(missed), MISSED), *caused], reverse=True)
    return caused_by


def detection_of(option: int) -> int:
    """Return the detection that an option uses, negative: none."""
    return STRAY - option if option <= STRAY else option


def _bit(option: int) -> int:
    j = detection_of(option)
    return 0 if j < 0 else 1 << j


def competing(clusters: Iterable[Cluster], options: Options) -> list[list[Cluster]]:
    """Return the clusters in lists, together those that compete for a detection."""
    clusters = list(clusters)
    if len(clusters) < 2:
        return [clusters] * len(clusters)
    groups: dict[int, list[Cluster]] = {}
    joined: list[int] = []  # number of a group -> itself, or another group that it has become part of
    wants: dict[int, int] = {}  # detection -> number of a group that may have caused it
    for number, cluster in enumerate(clusters):
        rows = {row for hypothesis in cluster.hypotheses for row in hypothesis if row >= 0}
        wanted = {j if j >= 0 else detection_of(j) for row in rows for _, j in options[row] if j != MISSED}
        joined.append(number)
        members = [cluster]
        rivals = {wants[j] for j in wanted if j in wants}
        for other in sorted({_last(joined, rival) for rival in rivals}):
            joined[other] = number
            members = groups.pop(other) + members
        wants.update(dict.fromkeys(wanted, number))
        groups[number] = members
    return list(groups.values())


def apart(members: list[Cluster], options: Options, count: int) -> list[tuple[list[Cluster], Options]]:
    """Split clusters that compete for detections into those that do so with a probability that counts.

    In a crowd each may have caused the detection of the next one, and all are one group. Its joint hypotheses are as
    many as the products of all clusters' ones; the few that can be kept leave out most of what is likely, and extra
    people stay who share the detections of others. A cluster that is hardly the one that caused a detection loses it.

    Args:
        members: clusters, of which `competing` says that they compete.
        options: what each row may have caused.
        count: detections of the record.

    Returns:
        The clusters in lists, together those that compete, and what their rows may have caused.
    """
    if len(members) < 2 or sum([len(cluster.labels) for cluster in members]) <= MANY:
        return [(members, options)]
    claims = _claims(members, options, count)
    keeps = ((claims >= PRUNE) | (claims >= claims.max(0))).tolist()
    kept = {
        row: [one for one in options[row] if one[1] == MISSED or keep[detection_of(one[1])]]
        for cluster, keep in zip(members, keeps, strict=True)
        for row in {row for joint in cluster.hypotheses for row in joint if row >= 0}
    }
    return [(some, kept) for some in competing(members, kept)]


def _claims(members: Sequence[Cluster], options: Options, count: int) -> np.ndarray:
    """Return the probabilities (clusters, J) that each cluster has caused each detection, by belief propagation.

    Labels count as independent of each other before the record.

    Source:
        J. L. Williams and R. A. Lau, "Approximate evaluation of marginal association probabilities with belief
        propagation", IEEE TAES 50(4), 2014.
    """
    owners, ratios = [], []
    for number, cluster in enumerate(members):
        for rows in zip(*cluster.hypotheses, strict=True):
            ratio, missed = [0.0] * count, 0.0
            for row, share in zip(rows, cluster.shares, strict=True):
                for gain, option in options[row] if row >= 0 else ((0.0, MISSED),):
                    if option == MISSED:
                        missed += share * math.exp(gain)
                    else:
                        ratio[detection_of(option)] += share * math.exp(min(gain, 300.0))
            owners.append(number)
            ratios.append([min(one / max(missed, 1e-300), MOST_LIKELY) for one in ratio])
    psi = np.array(ratios)  # of having caused a detection to being missed
    free = np.ones_like(psi)  # to a label from a detection: that no other one has it
    for _ in range(ROUNDS):
        told = psi * free
        wants = psi / (1 + told.sum(1, keepdims=True) - told)
        before, free = free, 1 / (1 + wants.sum(0) - wants)
        if abs(free - before).max() < SETTLED:
            break
    told = psi * free
    claims = np.zeros((len(members), count))
    np.add.at(claims, owners, told / (1 + told.sum(1, keepdims=True)))
    return claims


def _last(joined: list[int], number: int) -> int:
    """Return the group that a group has become part of."""
    while joined[number] != number:
        joined[number] = joined[joined[number]]
        number = joined[number]
    return number


def associate(members: Sequence[Cluster], options: Options, unclaimed: list[float], most: int) -> Group:
    """Update the joint hypotheses of clusters that compete for detections.

    Args:
        members: the clusters.
        options: what each row may have caused.
        unclaimed: J probabilities that no labelled person caused the detection; lowered here by those who may have.
        most: hypotheses to keep, of at most LARGE labels.

    Returns:
        The hypotheses, normalised, best first.
    """
    if len(members) == 1 and len(members[0].labels) == len(members[0].hypotheses) == 1:
        row = members[0].hypotheses[0][0]
        choices = options[row] if row >= 0 else [(0.0, MISSED)]
        if len(choices) == 1 or choices[1][0] < choices[0][0] + LOG_PRUNE:  # as of most people in most records
            j = detection_of(choices[0][1])
            if j >= 0:
                unclaimed[j] -= 1.0
            return Group(members[0].labels, [Hypothesis(0.0, ((row, choices[0][1]),), _bit(j))])
    labels = [label for cluster in members for label in cluster.labels]
    most = max(most * LARGE // max(len(labels), LARGE), 1)
    priors = list(zip(members[0].weights, members[0].hypotheses, strict=True))
    for cluster in members[1:]:
        pairs = list(zip(cluster.weights, cluster.hypotheses, strict=True))
        priors = [(w + v, left + right) for w, left in priors for v, right in pairs]
        if len(priors) > most:
            priors.sort(key=lambda prior: -prior[0])
            del priors[most:]
    best = ranked(priors, options, BUDGET * most, -LOG_PRUNE, most)
    top = best[0][0]
    kept = [Hypothesis(*one) for one in best]
    total = top + math.log(math.fsum(math.exp(h.weight - top) for h in kept))
    for hypothesis in kept:
        hypothesis.weight -= total
        share = math.exp(hypothesis.weight)
        for j in _bits(hypothesis.used):
            unclaimed[j] -= share
    return Group(labels, kept)


def _bits(used: int) -> list[int]:
    """Return the numbers of the bits that are set."""
    bits = []
    while used:
        low = used & -used
        bits.append(low.bit_length() - 1)
        used ^= low
    return bits


def ranked(
    priors: Sequence[tuple[float, Joint]],
    options: Options,
    budget: int = 1000,
    span: float = 11.5,
    most: int | None = None,
) -> list[Association]:
    """Find the likeliest joint associations of several prior hypotheses, each detection used at most once.

    A branch and bound over people, breadth first: a partial association is dropped when even its best completion falls
    `span` nats below a feasible association. In that completion each remaining person takes the best detection, used or
    not, and pays its price: where many want the same detections, prices make the bound nearly exact, see `_auction`.
    While no layer holds more than `budget` partial associations the list is exact down to exp(-span) of the best;
    beyond, the layer keeps those with the best bound (a beam, so the time is bounded), and the best association of each
    prior is still known to within BID for each person.

    Args:
        priors: log weight and hypothesis, a tuple of one row per label (ABSENT: no such person).
        options: row -> [(log weight, detection or MISSED)], best first.
        budget: partial associations kept in a layer.
        span: nats.
        most: associations to return, None: all.

    Returns:
        [(log weight, ((row, detection), ...), bit set of the used detections)], best first, down to `span` nats below.

    >>> options = {0: [(-0.1, 0), (-2.0, -1)], 1: [(-0.2, 0), (-1.0, -1)]}  # both may have caused detection 0
    >>> [(round(weight, 1), pairs) for weight, pairs, _ in ranked([(0.0, (0, 1))], options)]
    [(-1.1, ((0, 0), (1, -1))), (-2.2, ((0, -1), (1, 0))), (-3.0, ((0, -1), (1, -1)))]
    """
    if len(priors[0][1]) == 1:
        return _ranked_alone(priors, options, span, most)
    beam: list[tuple[float, int, Chain, int]] = []
    asked: list[Mapping[int, float]] = []
    likely: Association = (-math.inf, (), 0)
    for number, (weight, hypothesis) in enumerate(priors):
        taken = [options[row][0] if row >= 0 else NOTHING for row in hypothesis]
        bound = weight + math.fsum(map(FIRST, taken))
        prices: dict[int, float] = {}
        if bound > likely[0] or len(taken) > MANY:
            used, clash = _used(taken)
            if clash:
                bound = weight + _auction(taken, hypothesis, options, prices)
                used, _ = _used(taken)
            if bound > likely[0]:
                weight += math.fsum(map(FIRST, taken))
                pairs = tuple([(row, option) for row, (_, option) in zip(hypothesis, taken, strict=True)])
                likely = max(likely, (weight, pairs, used), key=FIRST)
        beam.append((bound, number, (), 0))
        asked.append(prices)
    floor = likely[0] - span - 1e-9
    widest = floor - max(beam, key=FIRST)[0]
    for depth in range(len(priors[0][1])):
        steps = _steps(priors, asked, depth, options, widest)
        beam = [
            (bound + loss, number, (chain, pair), used | bit)
            for bound, number, chain, used in beam
            for loss, pair, bit in steps[number]
            if not used & bit and bound + loss >= floor
        ]
        if len(beam) > budget:
            beam.sort(key=FIRST, reverse=True)
            del beam[budget:]
    beam = [(bound - _unpaid(asked[number], used), number, chain, used) for bound, number, chain, used in beam]
    beam.sort(key=FIRST, reverse=True)
    if not beam or beam[0][0] < likely[0] - 1e-9:  # the budget left it out
        return [likely, *_down_to(floor, beam, most and most - 1)]
    return _down_to(beam[0][0] - span, beam, most)


def _down_to(least: float, beam: Sequence[tuple[float, int, Chain, int]], most: int | None) -> list[Association]:
    """Return the first associations of a sorted beam, down to a log weight."""
    return [(weight, _in_order(chain), used) for weight, _, chain, used in beam[:most] if weight >= least]


def _in_order(chain: Chain) -> tuple[Pair, ...]:
    """Return the pairs of a chain, first label first."""
    pairs = []
    while chain:
        chain, pair = chain
        pairs.append(pair)
    return tuple(reversed(pairs))


def _ranked_alone(
    priors: Sequence[tuple[float, Joint]], options: Options, span: float, most: int | None
) -> list[Association]:
    """The same for one person, with whom nobody competes."""
    alone: list[Association] = [
        (weight + gain, ((row, j),), 1 << j if j >= 0 else _bit(j))
        for weight, (row,) in priors
        for gain, j in (options[row] if row >= 0 else ((0.0, MISSED),))
    ]
    alone.sort(key=FIRST, reverse=True)
    least = alone[0][0] - span
    return [one for one in alone[:most] if one[0] >= least]


def _steps(
    priors: Sequence[tuple[float, Joint]],
    asked: Sequence[Mapping[int, float]],
    depth: int,
    options: Options,
    widest: float,
) -> list[list[tuple[float, Pair, int]]]:
    """For each prior: what its label number `depth` may do, and what each choice loses to the best one, to `widest`."""
    free: dict[int, list[tuple[float, Pair, int]]] = {ABSENT: [(0.0, (ABSENT, MISSED), 0)]}  # moves without prices
    steps = []
    for (_, hypothesis), prices in zip(priors, asked, strict=True):
        row = hypothesis[depth]
        moves = None if prices and row >= 0 else free.get(row)
        if moves is None:
            worth = [(_worth(one, prices), one[1]) for one in options[row]]
            best = max(worth)[0]
            moves = [(gain - best, (row, j), _bit(j)) for gain, j in worth if gain - best >= widest]
            if not prices:
                free[row] = moves
        steps.append(moves)
    return steps


def _used(taken: Iterable[Option]) -> tuple[int, bool]:
    """Return the bit set of the detections that people take, and whether two take the same one."""
    used, clash = 0, False
    for _, option in taken:
        bit = _bit(option)
        clash = clash or bool(used & bit)
        used |= bit
    return used, clash


def _auction(taken: list[Option], hypothesis: Joint, options: Options, prices: dict[int, float]) -> float:
    """Let people bid for detections until each has the one that is worth most at its price.

    Args:
        taken: what each person takes, written here: a feasible association, whose log weight is the largest possible
            one to within BID for each person.
        hypothesis: a row per person.
        options: what each row may have caused.
        prices: detection -> price in nats, written here.

    Returns:
        A log weight that no association exceeds.

    Source:
        D. P. Bertsekas, "The auction algorithm: a distributed relaxation method for the assignment problem", Annals of
        Operations Research 14, 1988.
    """
    owner: dict[int, int] = {}
    bidding = [person for person, row in enumerate(hypothesis) if row >= 0]
    everybody = list(bidding)
    while bidding:
        person = bidding.pop()
        best, second, choice = -math.inf, -math.inf, NOTHING
        for one in options[hypothesis[person]]:
            worth = _worth(one, prices)
            if worth > best:
                best, second, choice = worth, best, one
            elif worth > second:
                second = worth
        taken[person] = choice
        j = detection_of(choice[1])
        if j >= 0:
            prices[j] = prices.get(j, 0.0) + best - second + BID
            if j in owner:
                bidding.append(owner[j])
            owner[j] = person
    net = [max([_worth(one, prices) for one in options[hypothesis[person]]]) for person in everybody]
    return math.fsum([*net, *prices.values()])


def _worth(option: Option, prices: Mapping[int, float]) -> float:
    """Return the log weight of an option less what its detection costs."""
    return option[0] - prices.get(detection_of(option[1]), 0.0)


def _unpaid(prices: Mapping[int, float], used: int) -> float:
    """Return what the detections cost that an association does not use."""
    return math.fsum([price for j, price in prices.items() if not used >> j & 1]) if prices else 0.0


def hits_and_misses(groups: Iterable[Group], scan: Scan) -> tuple[float, float]:
    """Return the expected numbers of detected and of missed detectable people, among those who surely exist."""
    hits = misses = 0.0
    for group in groups:
        for row, j in group.hypotheses[0].pairs:
            if row >= 0 and scan.existence[row] > SURE:
                if j != MISSED:
                    hits += 1
                else:
                    p = scan.p_detect[row]
                    misses += p * (1 - scan.p_sensor) / max(scan.p_sensor * (1 - p), 1e-12)
    return hits, misses
